"""What may be wrong with a record, or with what the scenario says of it, if innovations are far from what is claimed.

Each suspicion says what the measurements (or noises) would be if it were true; the record's likelihood says how well it
explains them (`stochfuse.data.innovations`).  One is told if

    2 (log p − log p of the record as it stands) − k log N  >  2 · MARGIN

with k numbers that were fitted to N innovations (Schwarz 1978): of a suspicion without any the chance that an honest
record speaks for it so strongly is below exp(−MARGIN).  Records whose innovations are nearly what they should be are
not looked at: mean squares within `NEAR` of 1, means and autocorrelations below `LOW`.  What is told first explains
best; what it leaves is looked at again.

A truth is suspected where innovations are right and errors about it are not, and would be about the truth one step
earlier or later.

A bounded part of a record is looked at, at its beginning: `RUNS` runs, `STEPS` steps and `MEASURED` measurements at
most.  Sensors of one or several components, linear or by name; not parallel filters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from stochfuse.data.consistency import Series
from stochfuse.data.innovations import Innovations, InnovationSetting, Supposition, estimates, innovations, setting_of
from stochfuse.data.records import RecordedRuns
from stochfuse.errors import StochfuseError
from stochfuse.scenario.over import with_numbers
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.sensing import Instrument, parts_of
from stochfuse.scenario.system import System

RUNS, STEPS, MEASURED = 20, 2_000, 2_000
MARGIN = 10.0
"""Least gain of log-likelihood for a suspicion to be told."""
CHANCE = 1e-5
"""How often honest innovations are looked at again."""
NEAR, LOW = 0.2, 0.15
"""Least departure that is looked at: of a mean square from 1, of a mean or autocorrelation from 0."""
AGENTS = 6
"""Agents suspected one by one: those that are farthest off."""
COMMON = {"Q-scaled": ("process", "process noise: a Q"), "P-scaled": ("start", "first estimates: a P")}
"""Covariances that all agents have in common: factors of a `Supposition`, and what they are called."""
SWALLOW = ("R-scaled", *COMMON)
"""What explains anything to some degree."""
LIKE = {"step-length", "Q-scaled"}
"""What may explain the same."""
ROUNDS = 3
"""Suspicions told of a record at most."""
HANGING, FAR, VERY_FAR = 3.0, 1.5, 5.0
"""Errors of adjacent steps that tell as much as one does at most; least mean squares that are looked at, and told of
though nothing explains them."""
SLIGHT = 2.0
"""Least gain of log-likelihood of measurements for another truth that errors speak for."""
FEW = 30
"""Pairs of steps below which autocorrelations are not looked at."""
FACTORS = 10.0 ** (np.arange(-10, 11) / 2.0)
"""Factors of noises that are tried first."""
LENGTHS = (0.001, 1.0 / 60.0, 0.1, 0.5, 2.0, 10.0, 60.0, 1000.0)
"""How much longer steps may be than the scenario says."""
COUPLED = 4
"""States up to which entries of F are suspected."""
FACTOR, BIAS = 1.4, 0.3
"""Least factor of a noise, and least bias in its deviations, that are told."""


class Suspicion(NamedTuple):
    """What is suspected.

    Parameters
    ----------
    suspicion : its name.
    agent : number from 1, or None for all of them or the scenario.
    text : in one line.
    explains : whether innovations are as they should be then.
    """

    suspicion: str
    agent: int | None
    text: str
    explains: bool


class Affine(NamedTuple):
    """What should have been written is a z + b, in components of a unit; None: of any, "": of none that is known."""

    name: str
    text: str
    unit: str | None
    a: float
    b: float = 0.0


AFFINE = (
    Affine("degrees", "in degrees, not radians", "rad", np.pi / 180.0),
    Affine("compass", "counted clockwise from north, not counterclockwise from the first axis", "rad", -1.0, np.pi / 2),
    Affine("kilometres", "in kilometres, not metres", "m", 1000.0),
    Affine("millimetres", "in millimetres, not metres", "m", 0.001),
    Affine("feet", "in feet, not metres", "m", 0.3048),
    Affine("kilometres-per-hour", "in km/h, not m/s", "m/s", 1.0 / 3.6),
    Affine("thousandfold", "1000 times too large", "", 0.001),
    Affine("thousandth", "1000 times too small", "", 1000.0),
    Affine("degrees", "in degrees, not radians", "", np.pi / 180.0),
    Affine("sign", "of the wrong sign", None, -1.0),
)
"""Measurements in other units or of another sense."""


class FittedCase(NamedTuple):
    """A case, what it is called, and how many numbers were fitted for it."""

    name: str
    agent: int | None
    text: str
    case: Supposition
    fitted: int = 0


def suspicions(scenario: Scenario, batch: RecordedRuns, known: np.ndarray) -> tuple[Suspicion, ...]:
    """Say what would explain innovations, or errors, that are not what they should be.

    Parameters
    ----------
    scenario : what the estimators are told.
    batch : the first runs.
    known : (states,) states of which the truth is known.

    Returns
    -------
    tuple of Suspicion
        The one that explains most first; one named "unknown" if nothing that was tried explains what is wrong, none if
        nothing is.
    """
    system = scenario.system
    if system.steps < 2 or (system.filters and not system.own):
        return ()
    runs, steps = _part(batch, system)
    functions = scenario.instruments or (None,) * system.agents
    z = tuple(
        np.where(_measured(system, batch, i, functions[i])[:runs, :steps, None], each[:runs, :steps], np.nan)
        for i, each in enumerate(batch.z)
    )
    setting = setting_of(system, functions, [x[:runs] for x in batch.first])
    ones = tuple(np.ones(each.shape[-1]) for each in z)
    trial = _CaseSuspicions(scenario, setting, Supposition(z, ones, ones))
    if _wrong(trial.now):
        return _explained(trial)
    if batch.truth is not None:
        return tuple(_of_truth(trial, batch.truth[:runs, :steps], known))
    return ()


def _explained(trial: _CaseSuspicions) -> tuple[Suspicion, ...]:
    """What explains it, one after the other; a noise that swallows everything only alone, and if nothing else does."""
    found, value = _path(trial, ())
    if any(each.suspicion in SWALLOW for each in found):
        other, other_value = _path(trial, SWALLOW)
        found = other if other_value > value or len(found) > 1 else found
    return tuple(found) or (_unknown(trial),)


def _path(trial: _CaseSuspicions, without: Sequence[str]) -> tuple[list[Suspicion], float]:
    """Suspicions, each the likeliest after those before, and the likelihood in the end; none if that is not right."""
    found, cost = [], 0.0
    for _ in range(ROUNDS):
        if not _wrong(trial.now):
            break
        best = _best(trial, without=without)
        if best is None:
            break
        tried, after = best
        now = trial.now
        explains = not _wrong(after) or abs(after.nis() - 1.0) <= NEAR
        joint = trial.setting.together and len(trial.all) > 1
        how = _how("NIS of one joint filter" if joint else "NIS", now.nis(), after.nis(), explains=explains)
        found.append(Suspicion(tried.name, tried.agent, tried.text + how, explains))
        cost += 0.5 * tried.fitted * np.log(now.counts[0])
        trial = trial.of(tried.case, after)
    if not found or not found[-1].explains:
        return [], -np.inf
    return found, float(trial.now.likelihood[0]) - cost


def _part(batch: RecordedRuns, system: System) -> tuple[int, int]:
    """How many runs and steps are looked at."""
    n = system.agents
    steps = min(system.steps, STEPS, max(20, MEASURED // n))
    return min(len(batch.runs), RUNS, max(1, MEASURED // (steps * n))), steps


def _measured(system: System, batch: RecordedRuns, agent: int, f: object) -> np.ndarray:
    """Whether an agent measured something, (runs, steps)."""
    there = ~batch.missed[:, :, agent]
    H = system.sensors[system.sensor_of[agent]].H
    looked = np.array(H.any(axis=(-2, -1))) if f is None or not H.any() else np.ones(len(H), dtype=bool)
    looked[0] = False
    return there & looked


def _unknown(trial: _CaseSuspicions) -> Suspicion:
    """Nothing explains it; the worst is the agent without which the others agree best."""
    setting, case, now = trial.setting, trial.case, trial.now
    said = f"nothing tried explains the innovations (NIS {now.nis():.3g}, expected 1)"
    seeing = [i for i, z in enumerate(case.z) if not np.isnan(z).all()]
    if len(seeing) == 1:
        return Suspicion("unknown", None, said, explains=False)
    without = innovations(setting, [case.with_agent(i, z=np.full_like(case.z[i], np.nan)) for i in seeing])
    off = [abs(np.log(max(without.nis(place), 1e-300))) for place in range(len(seeing))]
    place = int(np.argmin(np.where(np.isnan(off), np.inf, off)))
    text = f"{said}; the worst is agent {seeing[place] + 1} (NIS {without.nis(place):.3g} without it)"
    return Suspicion("unknown", seeing[place] + 1, text, explains=False)


def _wrong(now: Innovations) -> bool:
    """Whether innovations are by far not white of variance 1, of all agents or one."""
    white = now.white[0]
    n = white.shape[2]
    looks = n * (1 + 2 * white.shape[3]) + 1
    far = -ndtri(CHANCE / looks / 2.0)
    for agents in [slice(None), *(slice(i, i + 1) for i in range(n))]:
        some = white[:, :, agents]
        values = some[~np.isnan(some)]
        if not len(values):
            continue
        if not np.isfinite(values).all():
            return True
        number, mean = len(values), float((values**2).mean())
        low, high = chdtri(number, 1.0 - CHANCE / looks) / number, chdtri(number, CHANCE / looks) / number
        if abs(mean - 1.0) > NEAR and not low <= mean <= high:
            return True
    for i in range(n):
        for w in np.moveaxis(white[:, :, i], -1, 0):
            pairs = w[:, 1:] * w[:, :-1]
            for values, least in ((w[~np.isnan(w)], 1), (pairs[~np.isnan(pairs)], FEW)):
                if len(values) >= least and abs(values.mean()) > max(LOW, far / np.sqrt(len(values))):
                    return True
    return False


def _best(
    trial: _CaseSuspicions, *, alone: bool = False, without: Sequence[str] = ()
) -> tuple[FittedCase, Innovations] | None:
    """What explains most, if anything does; of one agent alone, or a bias of all; without those of some names."""
    tried = list(trial.cases())
    first = innovations(trial.setting, [trial.case, *(each.case for each in tried)])
    more = list(trial.fitted(tried, first))
    second = innovations(trial.setting, [trial.case, *(each.case for each in more)])
    both = [(each, found, i) for of, found in ((tried, first), (more, second)) for i, each in enumerate(of, start=1)]
    number = max(1, int((~np.isnan(trial.now.white)).sum()))
    base = trial.now.likelihood[0]
    gains = []
    for each, found, i in both:
        if not each.name or each.name in without or (alone and each.agent is None and each.name != "bias"):
            continue
        value = found.likelihood[i]
        gain = np.inf if not np.isfinite(base) and np.isfinite(value) else 2.0 * (value - base)
        gain -= each.fitted * np.log(number)
        gains.append((gain, each, found, i))
    gain, best, found, i = max(gains, key=lambda one: one[0], default=(-np.inf, None, first, 0))
    if best is None or gain <= 2.0 * MARGIN:
        return None
    # what is seen of places alone tells longer steps hardly from more noise
    like = [one for one in gains if one[0] > gain - 2.0 * MARGIN and {one[1].name, best.name} == LIKE]
    if like:
        best = best._replace(text=f"{best.text}, or {max(like, key=lambda one: one[0])[1].text},")
    return best, found.of(i)


def _of_truth(trial: _CaseSuspicions, truth: np.ndarray, known: np.ndarray) -> list[Suspicion]:
    """What may be wrong with a record, or with the truth, that innovations alone do not tell."""
    truth = truth[:, :, : 1 if trial.setting.together else None]
    now = _errors(trial.setting, trial.case, truth, known)
    whole = len(known) == truth.shape[-1]
    about = trial.about(truth) if whole else None
    far = now is not None and now.far
    if now is None or not (far or (about is not None and _wrong(about.now))):
        return []
    if about is not None and _wrong(about.now):
        return _about_truth(trial, about, truth)
    best = _best(trial)
    if best is not None:
        tried, _ = best
        after = _errors(trial.setting, tried.case, truth, known)
        if after is not None and after.mean < now.mean:
            how = _how("NEES", now.mean, after.mean, explains=not after.far)
            return [Suspicion(tried.name, tried.agent, tried.text + how, not after.far)]
    found = [
        (name, said, _errors(trial.setting, trial.case, other, known))
        for name, said, other in _truths(truth)
        if about is None or _gain(trial, about, other)[0] > SLIGHT
    ]
    if not found:
        return [_untrue("NEES", now.mean)] if now.mean > VERY_FAR else []
    name, said, after = min(found, key=lambda each: np.inf if each[2] is None else abs(np.log(each[2].mean)))
    if after is not None and after.mean < now.mean / 2.0:
        how = _how("NEES", now.mean, after.mean, explains=not after.far)
        return [Suspicion(name, None, f"the truth: {said}{how}", not after.far)]
    return [_untrue("NEES", now.mean)] if now.mean > VERY_FAR else []


def _about_truth(trial: _CaseSuspicions, about: _CaseSuspicions, truth: np.ndarray) -> list[Suspicion]:
    """What explains measurements that are not what the true states would show."""
    choices, now = [], about.now
    if len(trial.all) > 1:
        best = _best(about, alone=True)
        if best is not None:
            tried, after = best
            if tried.agent is None:
                tried = tried._replace(text=f"{tried.text}, or of the truth the other way,")
            choices.append((after.likelihood[0] - 0.5 * tried.fitted * np.log(truth.size), tried, after))
    for name, said, other in _truths(truth):
        gain, after = _gain(trial, about, other)
        choices.append((now.likelihood[0] + gain, FittedCase(name, None, f"the truth: {said}", trial.case), after))
    value, tried, after = max(choices, key=lambda each: each[0])
    if value < now.likelihood[0] + MARGIN or abs(np.log(after.nis())) > abs(np.log(now.nis())):
        return [_untrue("squared deviations", now.nis())] if now.nis() > VERY_FAR else []
    explains = not _wrong(after)
    how = _how("squared deviations from the truth", now.nis(), after.nis(), explains=explains)
    return [Suspicion(tried.name, tried.agent, tried.text + how, explains)]


def _gain(trial: _CaseSuspicions, about: _CaseSuspicions, truth: np.ndarray) -> tuple[float, Innovations]:
    """By how much another truth makes measurements likelier, for as many of them, and deviations from it."""
    after = innovations(trial.setting._replace(truth=truth), [trial.case])
    now = about.now
    return float(after.likelihood[0] / max(after.counts[0], 1.0) * now.counts[0] - now.likelihood[0]), after


def _truths(truth: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    """What else the truth may be."""
    yield "truth-late", "its states one step late", _moved(truth, -1)
    yield "truth-early", "its states one step early", _moved(truth, 1)
    yield "truth-thousandth", "1000 times too small (kilometres for metres?)", 1000.0 * truth
    yield "truth-thousandfold", "1000 times too large (millimetres for metres?)", 0.001 * truth
    yield "truth-feet", "in feet, not metres?", 0.3048 * truth
    yield "truth-metres", "in metres, not feet?", truth / 0.3048
    yield "truth-sign", "of the wrong sign", -truth


def _moved(values: np.ndarray, by: int) -> np.ndarray:
    """Values (runs, steps, …) a step earlier, by = −1, or later; NaN where there is none."""
    out = np.full_like(values, np.nan)
    kept, put = (slice(1, None), slice(None, -1)) if by < 0 else (slice(None, -1), slice(1, None))
    out[:, put] = values[:, kept]
    return out


def _how(what: str, before: float, after: float, *, explains: bool) -> str:
    return f" would explain {'it' if explains else 'part of it'} ({what} {before:.3g} → {after:.3g})"


def _untrue(what: str, value: float) -> Suspicion:
    text = f"the truth is not what innovations speak for ({what} {value:.3g}, expected 1); nothing tried explains it"
    return Suspicion("truth", None, text, explains=False)


class _MeanNees(NamedTuple):
    """Mean NEES of a degree of freedom, and whether that is far from 1."""

    mean: float
    far: bool


def _errors(setting: InnovationSetting, case: Supposition, truth: np.ndarray, known: np.ndarray) -> _MeanNees | None:
    with np.errstate(all="ignore"):
        x, P = estimates(setting, case)
    P, error = P[..., known, :][..., known], (x - truth[:, 1:])[..., known]
    _, steps, filters, d = error.shape
    there = ~np.isnan(error).any(axis=-1)
    if not there.any() or d == 0:
        return None
    squared = np.full(there.shape, np.nan)
    solved = np.linalg.pinv(P[there], hermitian=True) @ error[there][..., None]
    squared[there] = (error[there] * solved[..., 0]).sum(axis=-1)
    series = Series(steps, filters, np.full(filters, d))
    series.add(squared)
    average = series.average(None)
    if average is None:
        return None
    # steps that are close hang together more than a short series tells
    number = d * max(1.0, min(average.independent, average.number / HANGING))
    high = float(chdtri(number, CHANCE)) / number
    mean = average.mean / d
    return _MeanNees(mean, mean > max(high, FAR))


class _CaseSuspicions:
    """Everything that is suspected of a case."""

    def __init__(
        self, scenario: Scenario, setting: InnovationSetting, case: Supposition, now: Innovations | None = None
    ) -> None:
        now = innovations(setting, [case]) if now is None else now
        self.scenario, self.setting, self.case, self.now = scenario, setting, case, now
        self.units = [_units(scenario, i) for i in range(len(case.z))]
        self.names = scenario.network.names
        self.R = [np.diagonal(setting.system.sensors[kind].R[-1]) for kind in setting.system.sensor_of]
        seeing = [i for i, z in enumerate(case.z) if not np.isnan(z).all()]
        off = {i: abs(np.log(max(now.nis(0, i), 1e-300))) for i in seeing}
        self.agents = sorted(sorted(seeing, key=lambda i: -off[i])[:AGENTS])
        self.all = seeing

    def about(self, truth: np.ndarray) -> _CaseSuspicions:
        """Return the same of deviations from what the true states would show."""
        setting = self.setting._replace(truth=truth)
        return _CaseSuspicions(self.scenario, setting, self.case)

    def of(self, case: Supposition, now: Innovations) -> _CaseSuspicions:
        """Return the same of another case, whose innovations are known."""
        return _CaseSuspicions(self.scenario, self.setting, case, now)

    def cases(self) -> Iterator[FittedCase]:
        """Those without anything to fit, and those that others are fitted by, which have no name."""
        for who in self._who():
            for affine in AFFINE:
                yield from self._affine(affine, who)
            yield from self._noises(who)
        for agent in self.agents:
            yield from self._shifted(agent)
            if self.case.z[agent].shape[-1] > 1:
                yield from self._exchanged(agent)
            yield from self._probes(agent)
        for i, j in combinations(self.agents, 2):
            yield from self._swapped(i, j)
        for factor in FACTORS[FACTORS != 1.0]:
            for name in COMMON:
                yield self._scaled_common(name, factor)
        model, system = self.scenario.model, self.setting.system
        if system.one_state and not model.varies and self.case.motion is None and self.setting.truth is None:
            yield from self._step_lengths()
            if model.dimension <= COUPLED:
                for i, j in np.argwhere(model.F == 0.0) if model.dimension > 1 else ():
                    yield from (self._coupled(i, j, sign * f) for f in FACTORS[6:13] for sign in (-1.0, 1.0))

    def _step_lengths(self) -> Iterator[FittedCase]:
        """Steps of another length: by the kind of motion, or by the matrix that F is the exponential of."""
        from scipy.linalg import expm, logm

        source = self.scenario.source.get("model", {})
        step = source.get("step", 1.0)
        for times in LENGTHS:
            try:
                if "kind" in source:
                    model = with_numbers(self.scenario, {"model.step": times * step}).model
                    F, Q = model.F, model.Q
                else:
                    root: Any = logm(self.scenario.model.F)
                    F, Q = expm(times * root), self.scenario.model.Q
            except (StochfuseError, TypeError, ValueError):
                return
            if np.isfinite(F).all() and not np.iscomplexobj(F) and not np.allclose(F, self.scenario.model.F):
                text = f"the motion: steps {times:.3g} times as long as the scenario's"
                yield FittedCase("step-length", None, text, self.case._replace(motion=(F, Q)))

    def _coupled(self, i: int, j: int, value: float) -> FittedCase:
        """An entry of F that is 0 in the scenario."""
        F, states = self.scenario.model.F.copy(), self.scenario.model.states
        F[i, j] = value
        text = f"the motion: {value:.2g} {states[j]} that goes into {states[i]} in every step (model.F)"
        return FittedCase("coupling", None, text, self.case._replace(motion=(F, self.scenario.model.Q)), 1)

    def _who(self) -> Iterator[Sequence[int]]:
        yield from ([i] for i in self.agents)
        if len(self.all) > 1:
            yield self.all

    def _called(self, who: Sequence[int]) -> tuple[int | None, str]:
        """Number for one agent, and what they are called."""
        if len(who) > 1:
            return None, "all agents"
        alone = len(self.case.z) == 1
        name = f" ({self.names[who[0]]})" if self.names else ""
        return who[0] + 1, "the agent" if alone else f"agent {who[0] + 1}{name}"

    def _affine(self, affine: Affine, who: Sequence[int]) -> Iterator[FittedCase]:
        agent, called = self._called(who)
        choices = [{i: [c for c, unit in enumerate(self.units[i]) if affine.unit in (None, unit)] for i in who}]
        if len(who) == 1 and len(choices[0][who[0]]) > 1:
            choices += [{who[0]: [c]} for c in choices[0][who[0]]]
        for places in choices:
            if not all(places.values()):
                continue
            case = self.case
            for i, components in places.items():
                z, scale = case.z[i].copy(), case.scale[i].copy()
                z[..., components] = affine.a * z[..., components] + affine.b
                scale[components] *= affine.a
                case = case.with_agent(i, z=z, scale=scale)
            yield FittedCase(affine.name, agent, f"{called}: {self._components(places)} {affine.text}", case)

    def _components(self, places: dict[int, list[int]]) -> str:
        different = {tuple(components) for components in places.values()}
        if len(different) > 1:
            return "measurements"
        return ", ".join(f"z{c + 1}" for c in different.pop())

    def _noises(self, who: Sequence[int]) -> Iterator[FittedCase]:
        """R with deviations where variances belong, the other way, or by a factor."""
        agent, called = self._called(who)
        squared, rooted = ([R[i] ** power for i in who] for R, power in ((self.R, 1.0), (self.R, -0.5)))
        for name, said, factors in (
            ("deviation-for-variance", "R has standard deviations where variances belong", squared),
            ("variance-for-deviation", "R has squared variances (sigma given as a variance)", rooted),
        ):
            if max(float(np.abs(np.log(f)).max()) for f in factors) > np.log(FACTOR):
                yield FittedCase(name, agent, f"{called}: {said}, which", self._noisier(who, factors))
        for factor in FACTORS[FACTORS != 1.0]:
            yield self._scaled_noise(who, factor)

    def _scaled_noise(self, who: Sequence[int], factor: float) -> FittedCase:
        agent, called = self._called(who)
        case = self._noisier(who, [np.full(len(self.R[i]), factor) for i in who])
        return FittedCase("R-scaled", agent, f"{called}: an R of {factor:.2g} times the scenario's", case, 1)

    def _noisier(self, who: Sequence[int], factors: Sequence[np.ndarray]) -> Supposition:
        case = self.case
        for i, factor in zip(who, factors, strict=True):
            case = case.with_agent(i, noise=case.noise[i] * factor)
        return case

    def _scaled_common(self, name: str, factor: float) -> FittedCase:
        field, said = COMMON[name]
        case = self.case._replace(**{field: getattr(self.case, field) * factor})
        return FittedCase(name, None, f"{said} of {factor:.2g} times the scenario's", case, 1)

    def _shifted(self, agent: int) -> Iterator[FittedCase]:
        number, called = self._called([agent])
        for by, name in ((-1, "late"), (1, "early")):
            z = _moved(self.case.z[agent], by)
            z[:, 0] = np.nan
            yield FittedCase(name, number, f"{called}: its clock one step {name}", self.case.with_agent(agent, z=z))

    def _exchanged(self, agent: int) -> Iterator[FittedCase]:
        number, called = self._called([agent])
        for i, j in combinations(range(self.case.z[agent].shape[-1]), 2):
            z = self.case.z[agent].copy()
            z[..., [i, j]] = z[..., [j, i]]
            text = f"{called}: z{i + 1} and z{j + 1} in each other's place"
            yield FittedCase("components-swapped", number, text, self.case.with_agent(agent, z=z))

    def _swapped(self, i: int, j: int) -> Iterator[FittedCase]:
        system, z = self.setting.system, self.case.z
        if z[i].shape != z[j].shape or (system.one_state and system.labels[i] == system.labels[j]):
            return
        case = self.case.with_agent(i, z=z[j]).with_agent(j, z=z[i])
        yield FittedCase("agents-swapped", i + 1, f"agents {i + 1} and {j + 1} in each other's place", case)

    def _probes(self, agent: int) -> Iterator[FittedCase]:
        """Biases of one deviation, from which the likeliest is found: innovations are linear in it."""
        for component, R in enumerate(self.R[agent]):
            z = self.case.z[agent].copy()
            z[..., component] -= np.sqrt(R)
            yield FittedCase("", agent, f"{component}", self.case.with_agent(agent, z=z))

    def fitted(self, tried: Sequence[FittedCase], found: Innovations) -> Iterator[FittedCase]:
        """Those that rest on what was found of the first."""
        for who in self._who():
            alike = len({tuple(self.units[i]) for i in who}) == 1
            if alike and set(who) <= set(self.agents):
                yield from self._biased(who, tried, found)
            number, _ = self._called(who)
            for factor in self._between("R-scaled", number, tried, found):
                yield self._scaled_noise(who, factor)
        for name in COMMON:
            for factor in self._between(name, None, tried, found):
                yield self._scaled_common(name, factor)
        coupled = [(found.likelihood[i], each.case) for i, each in enumerate(tried, start=1) if each.name == "coupling"]
        motion = max(coupled, key=lambda each: each[0])[1].motion if coupled else None
        if motion is not None:
            ((i, j),) = np.argwhere(motion[0] != self.scenario.model.F)
            yield from (self._coupled(i, j, motion[0][i, j] * 10.0 ** (n / 24.0)) for n in range(-6, 7))

    def _biased(self, who: Sequence[int], tried: Sequence[FittedCase], found: Innovations) -> Iterator[FittedCase]:
        """Biases of an agent, or of all alike, that make innovations least."""
        base, deviations = found.white[0].ravel(), np.sqrt(np.stack([self.R[i] for i in who]))
        slopes = np.zeros((base.size, deviations.shape[1]))
        for agent, of in zip(who, deviations, strict=True):
            places = [i for i, each in enumerate(tried, start=1) if not each.name and each.agent == agent]
            slopes += np.stack([found.white[i].ravel() - base for i in places], axis=-1) / of
        there = np.isfinite(base) & np.isfinite(slopes).all(axis=-1)
        if not there.any():
            return
        number, called = self._called(who)
        components = range(deviations.shape[1])
        for some in [[c] for c in components] + ([list(components)] if len(components) > 1 else []):
            bias = np.zeros(len(components))
            bias[some] = -np.linalg.lstsq(slopes[there][:, some], base[there], rcond=None)[0]
            if np.abs(bias / deviations).max() < BIAS:
                continue
            case = self.case
            for i in who:
                case = case.with_agent(i, z=self.case.z[i] - bias)
            said = ", ".join(f"z{c + 1} by {bias[c]:.3g}{_in(self.units[who[0]][c])}" for c in some)
            yield FittedCase("bias", number, f"{called}: a bias of {said}", case, len(some))

    def _between(self, name: str, agent: int | None, tried: Sequence[FittedCase], found: Innovations) -> list[float]:
        """Factors about the likeliest of those of a name that were tried."""
        which = [i for i, each in enumerate(tried, start=1) if (each.name, each.agent) == (name, agent)]
        factors = FACTORS[FACTORS != 1.0]
        likelihood = found.likelihood[which]
        if not np.isfinite(likelihood).any():
            return []
        best = float(np.log10(factors[int(np.argmax(likelihood))]))
        near = 10.0 ** (best + np.arange(-6, 7) / 12.0)
        return [factor for factor in near.tolist() if abs(np.log(factor)) > np.log(FACTOR)]


def _in(unit: str) -> str:
    return f" {unit}" if unit else ""


def _units(scenario: Scenario, agent: int) -> list[str]:
    """Units of the components of an agent's measurements, "" where they are not known."""
    f = scenario.instruments[agent] if scenario.instruments else None
    if isinstance(f, Instrument):
        return [part.unit for part in parts_of(f.kind, f.layout.axes)]
    system = scenario.system
    H = system.sensors[system.sensor_of[agent]].H[-1]
    out = []
    for row in H:
        units = {scenario.model.units[state] for state in np.flatnonzero(row)}
        out.append(units.pop() if len(units) == 1 else "")
    return out
