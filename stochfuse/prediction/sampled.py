"""Monte Carlo for a scenario: the sample, its means, and how far they can be trusted.

Standard errors are those of the mean over independent runs.  Agents that are alike are averaged within a run first;
their errors are dependent, the runs are not.  For a metric that is not linear in the covariance the error is carried
through by the metric's derivative at the mean (delta method), taken by central differences.

A control takes away what is common and leaves what is rare and skewed.  Of terms of skewness γ the mean over its own
standard error s/√R is not standard normal: E[t] = −γ/(2√R), Var t = 1 + (2 + 7γ²/4)/R to first order (Hall 1992, The
Bootstrap and Edgeworth Expansion, 2.6), though the mean itself is unbiased.  So a corrected sample's error is
(1 + 2(1 + γ²)/R)^½ s/√R, by which E[t²] is 1, of a few runs too.

Wherever it helps, the exact optimum is the sample's control variate (`stochfuse.prediction.control`), and of the
optimum of many agents itself a filter of the numbers heard.  How many runs a
precision takes is found in `stochfuse.prediction.stopping`.

Runs that all met one value say nothing of what they did not meet.  Where they are too few to have met more than the
likeliest, the standard error is all the same not 0: of a sample with a control it is no less than the correction, what
the exact optimum says of all that is missing; of a plain one, if it met one value only, no less than the value times
1/runs, as if outcomes of that probability were off by as much as the value itself.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.events import events, relabellings
from stochfuse.engines.monte_carlo import Experiment, Sample, sample, size_of_block
from stochfuse.errors import UsageError
from stochfuse.estimators.making import kinds_of, make, make_together
from stochfuse.estimators.protocol import Claims, Estimator
from stochfuse.estimators.world import claimed_only, moments
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.control import (
    FEW,
    KIND,
    MOST_HELD,
    WORTH,
    Control,
    ControlExpectation,
    FollowedOptimum,
    coefficients,
    estimated,
    no_control,
)
from stochfuse.prediction.general import groups_alike, spread
from stochfuse.prediction.method import Averaged, Settings, ShownPart, group_of, joined, seconds, share
from stochfuse.prediction.quantities import needed, value
from stochfuse.prediction.stopping import FEWEST, FIRST, Parts, sampled_to
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import LFG, NO_CONTROL, OPTIMAL, STAND_ALONE
from stochfuse.scenario.system import Items, Noises, System

MOST_NUMBERS = 500_000_000
"""Claimed values that a sample may hold."""
MOST_ENTRIES = 200_000_000
"""Entries of the optimum's covariances in a sample."""
DEAR = 40_000
"""Runs times links of a first stage where runs are dear: of the Local Fusion Graph."""
FEW_TOGETHER = 6
"""Agents up to which equal histories, gathered, pay more than following many runs at a time."""
MANY = 10_000
"""Runs, over all rows, from which on another process pays for its start."""
ROUNDING = 1e-13
"""Standard error, relative to the value, that is rounding in runs that are all alike."""
SCARCE, MOST_REDUCED = 5, 1e9
"""Runs unlike the rest that are too few to say how often that is; largest reduction of a variance that is told."""
STEP = 1e-4
"""Share of a run's deviation from the mean over which the derivative of a metric is taken."""


@dataclass(frozen=True, eq=False)
class MomentSample:
    """A sample of claimed covariances, and of the moments of the actual error where they are asked for.

    Parameters
    ----------
    sample : different moments, and which of them each agent has in each run.
    groups : agents that are alike.
    odds : (rows, steps, groups) probability that not just the likeliest becomes of what may reach a group at a step.
    control : the optimum in every run; None where the sample is left as it is.
    """

    sample: Sample
    groups: tuple[tuple[int, ...], ...]
    odds: np.ndarray
    control: Control | None = None
    _judged: dict[Any, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)

    @property
    def runs(self) -> int:
        """Runs per row."""
        return self.sample.which.shape[1]

    def moments(self) -> Moments:
        """Mean moments per group, (rows, steps, groups, …)."""
        values, index = self.sample
        shape = (index.shape[0], index.shape[2], len(self.groups))
        means = values.map(lambda m: np.empty((*shape, *m.shape[1:])))
        for row, step, g in np.ndindex(shape):
            if self.control is not None:
                of_runs, _ = self._corrected(self.in_runs(values, row, step, g), row, step, g)
                for mean, each in zip(means, of_runs, strict=True):
                    if each is not None:
                        mean[row, step, g] = each.mean(axis=0)
                continue
            used, counts = np.unique(self._which(row, step, g), return_counts=True)
            for mean, each in zip(means, values, strict=True):
                if each is not None:
                    mean[row, step, g] = np.tensordot(counts, each[used], axes=1) / counts.sum()
        return means

    def in_runs(self, values: Moments, row: int, step: int, group: int) -> Moments:
        """Moments in every run, as they were drawn, averaged over a group of agents, (runs, …)."""
        which = self._which(row, step, group)
        return values.map(lambda m: m[which].mean(axis=1))

    def _which(self, row: int, step: int, group: int) -> np.ndarray:
        return self.sample.which[row, self.sample.followed(step), step][:, list(self.groups[group])]

    def _corrected(self, y: Moments, row: int, step: int, group: int) -> tuple[Moments, Moments | None]:
        if self.control is None:
            return y, None
        return self.control.corrected(y, row, step, self.groups[group], self.sample.followed(step))

    def standard_error(self, metric: Metric, groups: Sequence[int], quantity: str = "claimed") -> np.ndarray:
        """Standard error of a quantity of the mean over the agents of some groups, (rows, steps)."""
        return self.judged(metric, groups, quantity)[1]

    def judged(self, metric: Metric, groups: Sequence[int], quantity: str) -> tuple[np.ndarray, np.ndarray]:
        """A quantity of the mean over the agents of some groups, and its standard error, each (rows, steps)."""
        asked = metric.name, tuple(groups), quantity
        if asked not in self._judged:
            self._judged[asked] = self._judge(metric, groups, quantity)
        return self._judged[asked]

    def _judge(self, metric: Metric, groups: Sequence[int], quantity: str) -> tuple[np.ndarray, np.ndarray]:
        values, index = needed(quantity, self.sample.values), self.sample.which
        of = partial(value, quantity, metric)
        shown, out = np.empty((2, index.shape[0], index.shape[2]))
        share = np.array([len(self.groups[g]) for g in groups]) / sum(len(self.groups[g]) for g in groups)
        for row, step in np.ndindex(out.shape):
            plain = [self.in_runs(values, row, step, g) for g in groups]
            drawn = _averaged(plain, share)
            both = [self._corrected(p, row, step, g) for p, g in zip(plain, groups, strict=True)]
            terms = _averaged([of_runs for of_runs, _ in both], share)
            moved = [more for _, more in both if more is not None]
            mean = terms.map(lambda m: m.mean(axis=0))
            shown[row, step] = of(mean)
            variance, skewness = _spread(of, mean, terms.map(lambda m: m - m.mean(axis=0)))
            if self.control is not None:
                variance *= 1.0 + 2.0 * (1.0 + skewness**2) / _runs(terms)
            error = np.sqrt(variance + (_spread(of, mean, _averaged(moved, share))[0] if moved else 0.0))
            constant, rounding = all(_constant(m) for m in drawn), ROUNDING * np.abs(shown[row, step])
            if constant or self.control is None:
                error = error if error > rounding else 0.0
            known = self.control is not None and self.control.expected.further is None
            scarce = any(self.scarce(row, step, g) for g in groups)
            if (constant and known) or (scarce and (constant or known)):  # a correction that no run speaks for
                error = max(error, self._unseen(of, mean, drawn))
            if self.control is not None and not constant:
                # what the control takes away whole is still known to rounding only
                error = max(
                    rounding, np.hypot(error, self.control.expected.bound[row, step] * np.abs(shown[row, step]))
                )
            out[row, step] = error
        return shown, out

    def scarce(self, row: int, step: int, group: int) -> bool:
        """Whether hardly any run is expected to have met anything but the likeliest, where there is anything else."""
        return 0.0 < self.odds[row, step, group] * len(self._which(row, step, group)) < SCARCE

    def _unseen(self, of: Callable[[Moments], np.ndarray], mean: Moments, drawn: Moments) -> float:
        """Standard error of a value where hardly any run met anything but the likeliest."""
        if self.control is None or self.control.expected.further is not None:
            return float(np.abs(of(mean))) / _runs(drawn)
        gap = float(np.abs(of(mean) - of(drawn.map(lambda m: m.mean(axis=0)))))
        return gap if gap > ROUNDING * np.abs(of(mean)) else 0.0

    def shown(self, system: System, what: ShownPart) -> tuple[np.ndarray, np.ndarray]:
        """What will be looked at, and its standard errors, each (any, steps that are looked at)."""
        metrics = what.metrics or (metric_of("trace", system.model),)
        everyone = range(len(self.groups))
        if what.agent == "mean":
            whom = [tuple(everyone)]
        else:
            whom = [(g,) for g in everyone if isinstance(what.agent, str) or what.agent - 1 in self.groups[g]]
        steps = np.array(what.steps or range(1, system.steps + 1)) - 1
        found = [
            np.stack(self.judged(m, groups, q))[:, :, steps]
            for q in what.quantities
            for m in metrics
            for groups in whom
        ]
        values, errors = np.concatenate(found, axis=1)
        return values, errors


def _averaged(parts: Sequence[Moments], share: np.ndarray) -> Moments:
    """Moments averaged over groups of agents."""
    if len(parts) == 1:
        return parts[0]
    return Moments(
        *(None if m[0] is None else np.tensordot(share, np.array(m), axes=1) for m in zip(*parts, strict=True))
    )


def _spread(of: Callable[[Moments], np.ndarray], mean: Moments, deviations: Moments) -> tuple[float, float]:
    """Variance of a value of a mean, from what each independent part deviates from it, (parts, …); their skewness."""
    above, below = (
        of(Moments(*(m if m is None else m + h * d for m, d in zip(mean, deviations, strict=True))))
        for h in (STEP, -STEP)
    )
    slope = (above - below) / (2 * STEP)
    square = float((slope**2).mean())
    return square / (len(slope) - 1), float(((slope / np.sqrt(square)) ** 3).mean()) if square > 0 else 0.0


def _runs(of_runs: Moments) -> int:
    return len(next(m for m in of_runs if m is not None))


def _constant(m: np.ndarray | None) -> bool:
    """Whether all runs met the same, but for rounding."""
    return m is None or bool((np.abs(m - m[0]) <= ROUNDING * np.abs(m).max()).all())


def averaged(system: System, items: Items, how: Settings, errors: bool) -> Averaged:
    """Draw a sample of an estimator's estimates, as a method; see `Averaged`.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    parts = []
    for members, alone, some in items.by_noises(system):
        found, notes, meta = sampled(alone, some.links, how, errors=errors)
        parts.append(
            (
                members,
                Averaged(
                    moments=found.moments(),
                    group_of=group_of(found.groups),
                    natures=np.full(len(some), "sampled"),
                    estimator=how.estimator,
                    rounding=np.zeros(len(some)),
                    notes=notes if items.noises.common else (),
                    sampled=found,
                    meta={"runs": found.runs, "seed": how.seed, **meta},
                ),
            )
        )
    return joined(parts)


def sampled(
    system: System, links: LinkRows, how: Settings, *, errors: bool = False
) -> tuple[MomentSample, tuple[str, ...], dict[str, Any]]:
    """Draw a sample of an estimator's estimates; also what to say of it, to readers and to programs.

    Parameters
    ----------
    how : runs or precision, seed, workers, estimator and control.
    errors : whether the moments of the actual error are wanted too.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    shown = how.shown if how.shown.quantities else replace(how.shown, quantities=("actual" if errors else "claimed",))
    _check(system, links, how)
    network, kinds = system.network, kinds_of(system, how.estimator)
    permutations = relabellings(network, links, kinds)
    groups = groups_alike(network, links, kinds, permutations)
    odds = _odds(system, links, groups, how.estimator)
    optimum = FollowedOptimum(system, links, how)
    dear = system.agents > FEW_TOGETHER and how.estimator == LFG

    def draw(before: Sample | None, runs: int, first: int, upto: int = system.steps) -> Sample:
        now = replace(how, runs=runs)
        if how.estimator == OPTIMAL and network.agents > FEW:
            return _extended(before, _optimum(optimum, system, len(links.link), now, first, errors))
        return _extended(before, _drawn(system, links, now, permutations, first=first, errors=errors, upto=upto))

    def judge(drawn: Sample, parts: Parts) -> tuple[tuple[MomentSample, str, Reduced], np.ndarray]:
        found = helped(system, links, how, MomentSample(drawn, groups, odds), parts, shown, optimum)
        values, error = found[0].shown(system, shown)
        with np.errstate(divide="ignore"):  # no error but 0 is a share of 0
            shares = np.divide(error, np.abs(values), out=np.zeros_like(error), where=error > 0).max(axis=0)
        of_steps = np.zeros(system.steps)
        of_steps[np.array(shown.steps or range(1, system.steps + 1)) - 1] = shares
        return found, of_steps if dear else of_steps.max(keepdims=True)

    if how.precision is None:
        (found, said, control), _ = judge(draw(None, how.runs, 0), [(how.runs, 0)])
        return found, tuple(filter(None, (said, *rare(system, links, found)))), {"control": control._asdict()}
    numbers = len(links.link) * system.steps * system.agents
    most = min(MOST_NUMBERS // numbers, MOST_HELD // numbers // system.dimension**2)
    first = max(FEWEST, min(FIRST, DEAR // system.agents**2)) if dear else FIRST
    limit = None if how.at_most is None else seconds(how.at_most)
    block = size_of_block(system.agents)
    (found, said, control), reached = sampled_to(share(how.precision), limit, (first, most), block, draw, judge)
    meta = {"control": control._asdict(), "precision": reached.for_programs}
    told = f"precision {100 * reached.reached:.2g} % of each value after {found.runs:,} runs"
    whole = len(found.sample.which[0, found.sample.followed(-1)])
    told += f" ({whole:,} of them to the last step)" if whole < found.runs else ""
    told += f", {100 * reached.asked:.3g} % asked for: {reached.stopped}" if reached.stopped else ""
    return found, tuple(filter(None, (told, said, *rare(system, links, found)))), meta


class Reduced(NamedTuple):
    """What a control does, for programs.

    Parameters
    ----------
    kind : of the control.
    variance_reduction : variance of what is shown without it over that with it.
    expected : whether its expectation is "exact" or "estimated"; None without a control.
    """

    kind: str = NO_CONTROL
    variance_reduction: float = 1.0
    expected: str | None = None


def helped(
    system: System,
    links: LinkRows,
    how: Settings,
    plain: MomentSample,
    parts: Parts,
    shown: ShownPart,
    optimum: FollowedOptimum,
) -> tuple[MomentSample, str, Reduced]:
    """Correct a sample by the optimum, or what stands in for it, where that helps; also what to say of it."""
    how = replace(how, runs=plain.runs)
    why = no_control(system, links, how)
    if why is not None or not plain.odds.any():
        return plain, f"control: none; {why}" if why else "", Reduced()
    expected = optimum.expected_beside(plain.runs)
    if expected is None and how.estimator == OPTIMAL:
        return plain, "", Reduced()
    runs = optimum.in_runs(parts)
    # of an unknown expectation as if it were the sample's mean, to see whether further runs are worth their time
    own = ControlExpectation(runs.map(lambda m: m.mean(axis=1)), np.zeros(plain.odds.shape[:2]))
    found = replace(plain, control=Control(runs, expected or own))
    reduction = _reduction(plain, found, system, shown)
    if expected is None and reduction >= WORTH:
        expected = estimated(system, links, how, 1.0 - 1.0 / reduction, optimum)
        found = replace(plain, control=Control(runs, expected))
        reduction = _reduction(plain, found, system, shown)
    if reduction == 0.0:  # nothing is uncertain
        return plain, "", Reduced()
    if reduction < WORTH or expected is None:
        takes = "takes" if optimum.kind == KIND else "take"
        why = f"the {optimum.kind} {takes} away too little of the variance (1/{reduction:.2f})"
        return plain, f"control: none; {why}", Reduced()
    mean = "exact" if expected.further is None else "estimated"
    by = "" if mean == "exact" else f"; its mean from {expected.runs / plain.runs:.3g} times as many runs of its own"
    told = f"1/{float(f'{reduction:.3g}'):,g}" if reduction < 1e6 else "less than a millionth"
    return (
        found,
        f"control: {optimum.kind}; variance {told}{by}",
        Reduced(optimum.kind, min(reduction, MOST_REDUCED), mean),
    )


def _reduction(plain: MomentSample, found: MomentSample, system: System, shown: ShownPart) -> float:
    """Variance of what is shown, relative to its values, without a control over that with it; 0 of none."""
    (values, error), (_, less) = plain.shown(system, shown), found.shown(system, shown)
    there = (error > 0) & (values != 0)
    before, after = (((e[there] / values[there]) ** 2).sum() for e in (error, less))
    return 0.0 if before == 0 else float(before / max(after, before / MOST_REDUCED))


def _odds(system: System, links: LinkRows, groups: Sequence[tuple[int, ...]], estimator: str) -> np.ndarray:
    """Probability that not just the likeliest becomes of what may reach groups at a step, (rows, steps, groups)."""
    likeliest = np.ones((len(links.link), system.steps, len(groups)))
    group, of_links = group_of(groups), np.ones((len(links.link), len(groups)))
    for step in range(1, system.steps + 1):
        if step == 1 or links.varies:
            of_links = np.ones((len(links.link), len(groups)))
            for event in [] if estimator == STAND_ALONE else events(system.network, links, step):
                likely = np.maximum(1.0 - event.probability, event.probability * max(event.delay))
                for g in {int(group[i]) for i in event.receivers}:
                    of_links[:, g] *= likely
        likeliest[:, step - 1] = of_links
        for agent, p in system.detections(step):
            likeliest[:, step - 1, group[agent]] *= max(p, 1.0 - p)
    return np.where(likeliest < 1.0, 1.0 - likeliest, 0.0)


def rare(system: System, links: LinkRows, found: MomentSample) -> list[str]:
    """What to say of steps at which nearly all runs met one value: what is rarer than they are many may be missing."""
    said, claimed = [], Moments(found.sample.values.P)
    for row, µ in enumerate(links.means(system.network)):
        others = [
            found.runs - np.unique(np.round(traces / (np.abs(traces).max() or 1.0), 12), return_counts=True)[1].max()
            for step, g in np.ndindex(found.odds.shape[1:])
            if found.scarce(row, step, g)
            for traces in [np.trace(found.in_runs(claimed, row, step, g).P, axis1=-2, axis2=-1)]
        ]
        if others and min(others) < SCARCE:
            met = "one value" + (f" but for {min(others)}" if min(others) else "")
            said.append(
                f"µ = {µ:.6g}: at some step all {found.runs:,} runs met {met}; outcomes of a probability of up to "
                f"{3.0 / found.runs:.2g} together may be missing"
            )
    return said


def _extended(before: Sample | None, more: Sample) -> Sample:
    """A sample with further runs of every row."""
    if before is None:
        return more
    columns = zip(before.values, more.values, strict=True)
    values = type(more.values)(*(None if a is None else np.concatenate([a, b]) for a, b in columns))
    which = np.full((*more.which.shape[:2], *before.which.shape[2:]), -1, np.int32)
    which[:, :, : more.which.shape[2]] = more.which + len(before.values[0])
    return Sample(values, np.concatenate([before.which, which], axis=1))


def states(system: System, links: LinkRows, how: Settings, records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw a sample of an estimator's estimates given what was measured, whatever sensors might have missed.

    Parameters
    ----------
    how : runs, seed, workers, estimator and control.
    records : (steps, agents, p) measurements.

    Returns
    -------
    x, terms : ndarray
        (rows, runs, steps, agents, d) estimates, and what they are corrected to by the variances of the optimum where
        these are known exactly; their mean and its standard error are those of the expected estimate.
    """
    _check(system, links, how)
    permutations = relabellings(system.network, links, range(system.agents))
    drawn = _drawn(system, links, how, permutations, records=records)
    x = drawn.values.x[..., 0][drawn.which]
    optimum = FollowedOptimum(system, links, how)
    expected = None if no_control(system, links, how) is not None else optimum.expected
    if expected is None:
        return x, x
    # variances say of an estimate only how it hangs together with them: there is no usual coefficient
    of, mean = (np.diagonal(P, axis1=-2, axis2=-1) for P in (optimum.in_runs([(how.runs, 0)]).P, expected.mean.P))
    off = of - mean[:, None]
    return x, np.stack([x[r] - coefficients(x[r], off[r], 0.0) * off[r] for r in range(len(x))])


def _check(system: System, links: LinkRows, how: Settings) -> None:
    """Raise UsageError if a sample is out of range."""
    given = (("runs", how.runs, 2), ("seed", how.seed, 0), ("workers", 1 if how.workers is None else how.workers, 1))
    for name, value_of, least in given:
        if value_of < least:
            raise UsageError(f"{name}: expected a whole number of at least {least}, got {value_of}")
    network, rows = system.network, len(links.link)
    numbers = how.runs * rows * network.steps * network.agents
    if numbers > MOST_NUMBERS:
        raise UsageError(
            f"runs: {how.runs} runs for {rows} link probabilities, {network.steps} steps and {network.agents} agents "
            f"are {numbers:.3g} values; expected at most {MOST_NUMBERS:.3g}"
        )


def _drawn(
    system: System,
    links: LinkRows,
    how: Settings,
    permutations: list[tuple[int, ...]],
    *,
    first: int = 0,
    errors: bool = False,
    records: np.ndarray | None = None,
    upto: int | None = None,
) -> Sample:
    """Draw outcomes, and keep what is claimed in them, moments of the errors, or estimates given measurements.

    Parameters
    ----------
    upto : last step that is followed, if not the system's.
    """
    network, rows = system.network, len(links.link)
    how = replace(how, shown=ShownPart())  # metrics do not travel to other processes
    steps = range(1, network.steps + 1)
    drawn = [events(network, links, step) for step in (steps if links.varies else steps[:1])]
    experiment = Experiment(
        agents=network.agents,
        events=(drawn if links.varies else drawn * network.steps)[:upto],
        detections=[system.detections(step) if records is None else [] for step in steps[:upto]],
        make=partial(_made, system, how, permutations, errors, records),
        of=spread if records is not None else moments if errors else claimed_only,
        runs=how.runs,
        seed=how.seed,
        first=first,
        together=make_together(system, how.estimator, errors=errors, records=records, criterion=how.criterion)
        if network.agents > FEW_TOGETHER
        else None,
    )
    workers = how.workers
    if workers is None:
        links_of_a_run = network.agents ** (2 if how.estimator == LFG else 1)
        outcomes = how.runs * rows * (1 if experiment.together is None else links_of_a_run)
        many = outcomes >= MANY and getattr(how.estimator, "travels", True)
        workers = len(os.sched_getaffinity(0)) if many else 1
    return sample(experiment, rows, workers=workers)


def _optimum(optimum: FollowedOptimum, system: System, rows: int, how: Settings, first: int, errors: bool) -> Sample:
    """Sample the optimum by Boolean products: nearly every history of many agents has a value of its own."""
    n, d, steps = system.agents, system.dimension, system.steps
    entries = how.runs * rows * steps * n * d**2
    if entries > MOST_ENTRIES:
        raise UsageError(
            f"runs: {how.runs} runs for {rows} link probabilities, {steps} steps and {n} agents of {d} states are "
            f"{entries:.3g} entries of covariances; expected at most {MOST_ENTRIES:.3g}"
        )
    found = optimum.drawn(how.runs, first)
    P = found.P.reshape(-1, d, d)
    values = Moments(P)
    if errors:
        bias = np.zeros((len(P), d, 1)) if found.bias is None else found.bias.reshape(-1, d, 1)
        values = Moments(P, P, bias, P + bias @ np.swapaxes(bias, -1, -2))
    return Sample(values, np.arange(len(P), dtype=np.int32).reshape(found.P.shape[:4]))


def _made(
    system: System, how: Settings, permutations: list[tuple[int, ...]], errors: bool, records: np.ndarray | None
) -> tuple[Estimator, Callable[[], Claims]]:
    """An estimator, and what to call for its numbers."""
    made = make(system, how.estimator, permutations, errors=errors, records=records, criterion=how.criterion)
    return made.estimator, partial(made.claims, system, Noises())
