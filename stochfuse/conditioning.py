"""How far rounding reaches in the exact methods: the same computation again, every number moved by an ulp.

The general formulation works with sums of information, which lose what is weakly known beside what is known precisely;
the optimum works in square-root form, which loses what the given numbers, rounded as they are, no longer tell.  Either
is measured as `stochfuse.engines.rounding` does it: run again with moved numbers, the largest change of the covariances
counts, in units of the standard deviations.

Four runs in the place of one are worth their time only where rounding may matter.  Two cheap looks tell (`suspects`,
`suspects_in_square_root`): at the given numbers, whether R or F is ill-conditioned; and at the filter of an agent that
always hears nobody, and of one that always hears all, once as they are and once with moved numbers.  The second look
takes the information form for the general formulation and, for the optimum, the covariance form, which loses no less
than the square-root form and costs a fraction of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from stochfuse.engines.rounding import DRAWS, PROMISED, Moving
from stochfuse.errors import StochfuseError
from stochfuse.information import COMMON, InformationClaims, Ledger, Sources, evaluate
from stochfuse.kalman import Estimate, Information, from_information, predict, update
from stochfuse.model import Noises, at_step
from stochfuse.scenario import Scenario
from stochfuse.sources import batched, sources_of

SUSPECT = 1e-11
"""Relative change of the cheap look from which the whole is run again."""
CONDITION = 1e4
"""Condition number of R (in units of its deviations) or F from which it is run again anyway."""
MARGIN = 3.0
"""The largest of a few changes may be exceeded by so much."""
NO_DIGIT = 1.0
"""Relative rounding of which no more is said than that it leaves no digit."""

_ULP = 2.0**-52


def told(reach: float) -> str:
    """Say how far rounding may reach."""
    return f"ill-conditioned: rounding may reach a relative {reach:.0e}, in units of the standard deviations"


def notes(reach: float) -> list[str]:
    """Say it where it is more than what is called none."""
    return [told(reach)] if not reach <= PROMISED else []


def change(P: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Largest change of each covariance (..., d, d) in units of its standard deviations, (...); at most `NO_DIGIT`."""
    with np.errstate(all="ignore"):
        sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        unit = sd[..., :, None] * sd[..., None, :]
        relative = (np.abs(moved - P) / np.where(unit > 0, unit, 1.0)).max(axis=(-2, -1))
    return np.where(relative <= NO_DIGIT, relative, NO_DIGIT)


def reach(again: Callable[[int], np.ndarray | float]) -> np.ndarray | float:
    """How far rounding may reach, from the change that each of a few runs with moved numbers makes.

    Parameters
    ----------
    again : change with the numbers moved by a given seed; what raises an error has left no digit.
    """
    found: np.ndarray | float = 0.0
    for seed in range(DRAWS):
        try:
            found = np.maximum(found, again(seed))
        except (StochfuseError, np.linalg.LinAlgError):
            return NO_DIGIT
    return np.minimum(MARGIN * found, NO_DIGIT)


class MovedSources(Sources):
    """Sources whose numbers are moved: what is given, and every information that is computed from it.

    Parameters
    ----------
    given : the sources.
    seed : of the errors.  The items of a batch share them, so that an item's answer does not depend on its company.
    share : (items, 1, 1) how much of the errors each item gets.  Then what is given stays as it is.
    """

    def __init__(self, given: Sources, seed: int, share: np.ndarray | None = None) -> None:
        super().__init__(given.model, given.sensors, given.starts, given.records, given.algebra)
        self._rng, self._share = np.random.default_rng(seed), 1.0 if share is None else share
        self._items = given.starts[0].Y.ndim - 2
        if share is None:
            moving = Moving(seed)
            F, Q = moving.rounded(self.model.F), self._symmetric(self.model.Q)
            self.model = replace(self.model, F=F, Q=Q)
            self.sensors = [replace(sensor, R=moving.noise(sensor.R)) for sensor in self.sensors]
        # one for all where there is one for all
        unique = {id(start): start for start in self.starts}
        moved = {key: self._moved(start) for key, start in unique.items()}
        self.starts = [moved[id(start)] for start in self.starts]

    def measured(self, step: int, source: int) -> Information:
        """Information of one measurement, moved."""
        return self._moved(super().measured(step, source))

    def forward(self, information: Information, step: int) -> Information:
        """Time update of moved information, moved."""
        return self._moved(super().forward(self._moved(information), step))

    def _moved(self, information: Information) -> Information:
        y, Y = information
        return Information(None if y is None else y * (1.0 + self._share * self._errors(y)), self._symmetric(Y))

    def _symmetric(self, M: np.ndarray) -> np.ndarray:
        errors = np.triu(self._errors(M))
        return M * (1.0 + self._share * (errors + np.swapaxes(np.triu(errors, 1), -1, -2)))

    def _errors(self, M: np.ndarray) -> np.ndarray:
        """Errors of each value's own, the same for all items."""
        stacked = M.shape[: max(M.ndim - 2 - self._items, 0)]
        shape = (*stacked, *(1,) * (M.ndim - 2 - len(stacked)), *M.shape[-2:])
        return _ULP * self._rng.uniform(-1.0, 1.0, size=shape)


def moved_claims(scenario: Scenario, ledger: Ledger, sources: Callable[[], Sources]) -> Iterator[Callable[[], InformationClaims]]:
    """What a ledger's values claim with moved numbers, a few times; not at all where rounding does not matter."""
    if suspects(scenario, Noises(P0=scenario.P0[None])).any():
        given = sources()
        for seed in range(DRAWS):
            yield partial(_evaluated, ledger, given, seed)


def _evaluated(ledger: Ledger, given: Sources, seed: int) -> InformationClaims:
    return InformationClaims(evaluate(ledger, MovedSources(given, seed)))


def ill_noise(scenario: Scenario, noises: Noises | None = None) -> np.ndarray:
    """Whether some measurement noise R is ill-conditioned in units of its deviations, (items,) or (1,)."""
    given = [sensor.R for sensor in scenario.sensors] if noises is None or noises.R is None else [noises.R[:, None]]
    given = [R if R.ndim == 4 else R.reshape(1, -1, *R.shape[-2:]) for R in given]
    found = [_ill(R).any(axis=-1) for R in given if R.shape[-1] > 1]
    return np.logical_or.reduce(found) if found else np.zeros(1, dtype=bool)


def _ill(R: np.ndarray) -> np.ndarray:
    """Whether covariances (..., p, p) are ill-conditioned in units of their deviations, (...)."""
    sd = np.sqrt(np.diagonal(R, axis1=-2, axis2=-1))
    values = np.linalg.eigvalsh(R / (sd[..., :, None] * sd[..., None, :]))
    return ~(values[..., -1] <= CONDITION * values[..., 0])


def _harsh(scenario: Scenario, noises: Noises) -> np.ndarray:
    """Whether R or F is ill-conditioned, (items,)."""
    transition = scenario.model.dimension > 1 and bool((np.linalg.cond(scenario.model.F) > CONDITION).any())
    return np.broadcast_to(ill_noise(scenario, noises) | transition, (_items(noises),))


def _items(noises: Noises) -> int:
    return 1 if noises.P0 is None else len(noises.P0)


def _numbers_alone(scenario: Scenario) -> bool:
    """Whether state and measurements are numbers, of which rounding takes nothing: all is added and divided."""
    return scenario.model.dimension == 1 and all(sensor.R.shape[-1] == 1 for sensor in scenario.sensors)


def suspects(scenario: Scenario, noises: Noises) -> np.ndarray:
    """Whether rounding may matter in sums of information, (items,).

    Parameters
    ----------
    noises : each item's own, P0 among them.
    """
    items = _items(noises)
    if _numbers_alone(scenario):
        return np.zeros(items, dtype=bool)
    harsh = _harsh(scenario, noises)
    if harsh.all():
        return harsh
    twice = noises.take(np.concatenate([np.arange(items)] * 2))
    share = np.repeat([0.0, 1.0], items)[:, None, None]
    network = scenario.network
    ledger = _extremes(scenario.sensor_of, network.steps, scenario.correlation == "shared")
    try:
        Y = evaluate(ledger, MovedSources(sources_of(batched(scenario, twice)), 0, share)).Y
        P = from_information(Information(None, Y)).P
    except (StochfuseError, np.linalg.LinAlgError):
        return np.ones(items, dtype=bool)
    return harsh | (change(P[:, :items], P[:, items:]).max(axis=0) > SUSPECT)


@lru_cache(maxsize=64)
def _extremes(kinds: tuple[int, ...], steps: int, shared: bool) -> Ledger:
    """What an agent of each kind knows that hears nobody, and one that hears everyone, at all steps."""
    ledger = Ledger()
    for heard in _heard(kinds):
        start = [(ledger.start(COMMON), 1)] if shared else [(ledger.start(kind), 1) for kind in heard]
        value = ledger.combine(1, start)
        for _ in range(2, steps + 1):
            value = ledger.measured(value, heard)
    return ledger


def _heard(kinds: Sequence[int]) -> list[tuple[int, ...]]:
    return [*((kind,) for kind in sorted(set(kinds))), tuple(kinds)]


def suspects_in_square_root(scenario: Scenario, noises: Noises) -> np.ndarray:
    """Whether rounding may matter in the optimum's square-root form, (items,); parameters as for `suspects`."""
    items = _items(noises)
    if _numbers_alone(scenario):
        return np.zeros(items, dtype=bool)
    harsh = _harsh(scenario, noises)
    if harsh.all():
        return harsh
    try:
        with np.errstate(all="ignore"):
            return harsh | (_change_of_covariance_form(batched(scenario, noises)) > SUSPECT)
    except np.linalg.LinAlgError:
        return np.ones(items, dtype=bool)


def _change_of_covariance_form(scenario: Scenario) -> np.ndarray:
    """Largest change, (items,), of the covariances of an agent that hears nobody, or everyone, at all steps."""
    heard = [Counter(kinds) for kinds in _heard(scenario.sensor_of)]
    counts = np.array([[n[kind] for kind in range(len(scenario.sensors))] for n in heard], dtype=float)
    counts = counts.T[:, :, None, None, None, None]
    rng, share = np.random.default_rng(0), np.array([0.0, 1.0])[:, None, None, None]
    d = scenario.model.dimension

    def moved(P: np.ndarray) -> np.ndarray:
        errors = np.triu(rng.uniform(-_ULP, _ULP, size=(d, d)))
        return P * (1.0 + share * (errors + np.triu(errors, 1).T))

    P0 = scenario.P0.reshape(-1, d, d)
    P = moved(P0 if scenario.correlation == "shared" else P0 / counts.sum(axis=0))
    P, found = np.broadcast_to(P, (len(heard), *P.shape[-4:])), np.zeros(len(P0))
    for step in range(2, scenario.network.steps + 1):
        P = moved(predict(Estimate(None, P), at_step(scenario.model.F, step), at_step(scenario.model.Q, step)).P)
        for sensor, n in zip(scenario.sensors, counts, strict=True):
            H, R = at_step(sensor.H, step), at_step(sensor.R, step)
            P = np.where(n > 0, update(Estimate(None, P), H, R / np.maximum(n, 1.0)).P, P)
        found = np.maximum(found, change(P[:, 0], P[:, 1]).max(axis=0))
    return found
