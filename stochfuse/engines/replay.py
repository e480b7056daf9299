"""Replay: follow records of what arrived, instead of averaging over what may.

A record is one outcome of (45)/(46) with what was measured in it.  The estimator goes through its exchanges as it does
for every other engine; its values are put in numbers step by step, for many runs side by side
(`stochfuse.estimators.readings`):

    x̂_i(k), P_i(k)        what agent i claims after the exchange of step k, of thesis (2)/(3) or another rule
    ν = z − H x̂⁻          innovation of its measurement of step k, about the prediction of what it claimed before,
    νᵀ(H P⁻ Hᵀ + R)⁻¹ν    and its normalised square (NIS): of p degrees of freedom if the claim is consistent

Averaged over outcomes with their probabilities, x̂ and P are (48) and (49).  What is forgotten: as soon as a step is
over, all that no later exchange can rest on, so that a record may have any length; after some steps the values that are
left are written into an empty book.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.making import make, make_for_data
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.readings import Readings, given_again, numbers_of
from stochfuse.estimators.world import moments
from stochfuse.kalman.kernel import Estimate, at_step, predict
from stochfuse.kalman.metrics import Moments
from stochfuse.scenario import capabilities
from stochfuse.scenario.network import default_rows
from stochfuse.scenario.registry import GENERAL
from stochfuse.scenario.system import Noises, System

WRITTEN = 20_000
"""Values that are written down before the book is begun anew."""


@dataclass(frozen=True, eq=False)
class ArrivalRecord:
    """What arrived, and which sensors missed, in some runs.

    Parameters
    ----------
    heard : by run and step, mask of the agents that each agent heard in the step that they sent in, itself included.
    missed : by run and step, mask of the agents whose sensors missed.
    late : by (run, step that it was sent in), messages that took longer.
    """

    heard: Sequence[Sequence[tuple[int, ...]]]
    missed: Sequence[Sequence[int]]
    late: Mapping[tuple[int, int], tuple[Late, ...]] = field(default_factory=dict)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.heard)

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.heard[0])


class Stage(NamedTuple):
    """What the agents claim after the exchange of a step.

    Parameters
    ----------
    step : number from 1.
    estimates : by agent, x (runs, d, 1) and P (runs, d, d).
    nis : (runs, agents) normalised squared innovation of the step's own measurement; NaN where there is none.
    measured : (agents,) components of a measurement, its degrees of freedom.
    """

    step: int
    estimates: tuple[Estimate, ...]
    nis: np.ndarray
    measured: np.ndarray


def replay(
    system: System, name: str, arrivals: ArrivalRecord, readings: Readings, criterion: str = "det"
) -> Iterator[Stage]:
    """Follow an estimator through records.

    Parameters
    ----------
    name : of the estimator.
    arrivals : what arrived in each run.
    readings : what was measured in each, see `stochfuse.estimators.readings.Readings.given`.
    criterion : what the weights of an intersection minimise.

    Raises
    ------
    UsageError
        If the estimator is not one for such a system, or for such a record.
    NoAnswerError
        If in some run the estimator claims no covariance.
    """
    require(system, name, arrivals, any(f is not None for f in readings.functions))
    estimator = make_for_data(system, name, criterion)
    numbers = numbers_of(estimator, system, readings, arrivals.runs)
    states, state_of = [estimator.start()], np.zeros(arrivals.runs, dtype=np.int64)
    everyone, limit = np.arange(arrivals.runs), WRITTEN
    prediction = _Predictions(system, readings)
    for step in range(1, arrivals.steps + 1):
        claimed, states, state_of = _exchanged(estimator, states, state_of, arrivals, step)
        numbers.work(claimed.T.ravel(), np.tile(everyone, system.agents))
        estimates = tuple(numbers.estimates(values, step) for values in claimed.T)
        yield Stage(step, estimates, prediction.nis, prediction.measured)
        if step == arrivals.steps:
            return
        prediction.go_on(step + 1, estimates, arrivals)
        rests_on = [sorted(set(estimator.rests_on(state))) for state in states]
        pairs = [np.array(rests_on[state], dtype=np.int64) for state in state_of]
        values, runs = np.concatenate(pairs), np.repeat(everyone, [len(each) for each in pairs])
        numbers.work(values, runs)
        numbers.keep(values, runs)
        if len(estimator.book.step) > limit:
            fresh = make_for_data(system, name, criterion)
            names = given_again(estimator, fresh, (value for each in rests_on for value in each))
            states = [estimator.renamed(state, names, fresh) for state in states]
            numbers, estimator = numbers.renamed(fresh, names), fresh
            limit = WRITTEN + len(estimator.book.step)


def _exchanged(
    estimator: Any, states: Sequence[Any], state_of: np.ndarray, arrivals: ArrivalRecord, step: int
) -> tuple[np.ndarray, list[Any], np.ndarray]:
    """Values claimed, (runs, agents), the different states before the next exchange, and that of each run."""
    last = step == arrivals.steps
    different: dict[Any, int] = {}
    history_of = np.empty(arrivals.runs, dtype=np.int64)
    for run, state in enumerate(state_of.tolist()):
        missed = 0 if last else arrivals.missed[run][step]
        key = (state, arrivals.heard[run][step - 1], arrivals.late.get((run, step), ()), missed)
        history_of[run] = different.setdefault(key, len(different))
    opened = {state: estimator.exchange(states[state]) for state in {key[0] for key in different}}
    agents, claimed, after = range(len(arrivals.heard[0][0])), [], []
    following: dict[Any, int] = {}
    for state, heard, late, missed in different:
        exchange = opened[state]
        claimed.append([exchange.fused(agent, heard) for agent in agents])
        if not last:
            reached, _ = exchange.after(heard, late, missed)
            after.append(following.setdefault(reached, len(following)))
    state_of = np.array(after, dtype=np.int64)[history_of] if after else state_of
    return np.array(claimed, dtype=np.int64)[history_of], list(following), state_of


class _Predictions:
    """Predictions of what was claimed, and `nis` of what was measured at the step that is to come, (runs, agents)."""

    def __init__(self, system: System, readings: Readings) -> None:
        self.readings, self.world = readings, readings.world
        # a filter of a part of the state predicts no claim about all of it
        self._whole = system.one_state or system.own
        self.measured = np.array([z.shape[-1] for z in readings.z])
        self.nis = np.full((len(readings.z[0]), system.agents), np.nan)

    def go_on(self, step: int, claimed: Sequence[Estimate], arrivals: ArrivalRecord) -> None:
        """Predict what was claimed to the next step, linearise sensors there, and meet its measurements."""
        runs = np.arange(arrivals.runs)
        readings = self.readings.of(runs)
        out = np.full(self.nis.shape, np.nan)
        missed = [arrivals.missed[run][step - 1] for run in runs.tolist()]
        for agent, estimate in enumerate(claimed):
            rows = self.world.states[agent]
            if not self._whole:
                continue
            F, Q = at_step(self.world.F[agent], step), at_step(self.world.Q, step)[rows, rows]
            prior = predict(estimate, F, Q, readings.process(step, rows))
            self.readings.linearised(step, agent, prior.x)
            H = readings.sensor(step, agent, at_step(self.world.H[agent], step))
            there = np.array([not mask >> agent & 1 for mask in missed]) & H.any(axis=(-2, -1))
            if there.any():
                R, z = at_step(self.world.R[agent], step), readings.measured(step, agent)
                innovation = z - H @ prior.x
                S = H @ prior.P @ np.swapaxes(H, -1, -2) + R
                squared = (innovation * np.linalg.solve(S, innovation)).sum(axis=(-2, -1))
                out[:, agent] = np.where(there, squared, np.nan)
        self.nis = out


def moments_given(system: System, name: str, arrivals: ArrivalRecord, criterion: str = "det") -> Moments:
    """Claimed covariance, actual covariance and bias of the errors given what arrived, whatever is measured.

    Parameters
    ----------
    system, name, arrivals, criterion : as for `replay`; sensors are taken for linear.

    Returns
    -------
    Moments
        Of shape (runs, steps, agents, d, …); expectations over noises alone.

    Raises
    ------
    UsageError
        As `replay`, and if footprints of so many steps are too large.
    """
    require(system, name, arrivals)
    made = make(system, name, errors=True, criterion=criterion)
    estimator = made.estimator
    states, state_of, found = [estimator.start()], np.zeros(arrivals.runs, dtype=np.int64), []
    for step in range(1, arrivals.steps + 1):
        claimed, states, state_of = _exchanged(estimator, states, state_of, arrivals, step)
        found.append(claimed)
    claims = made.claims(system, Noises())
    stages = [moments(claims.estimate([(1, values)], step)[0]) for step, values in enumerate(found, start=1)]
    return Moments(*(None if part[0] is None else np.stack(part, axis=1) for part in zip(*stages, strict=True)))  # pyright: ignore[reportArgumentType]


def require(system: System, name: str, arrivals: ArrivalRecord, extended: bool = False) -> None:
    """Raise UsageError if an estimator does not take a system, or a record of it.

    Parameters
    ----------
    extended : whether sensors are linearised about estimates.
    """
    capabilities.require(system, default_rows(system.network), name, GENERAL)
    has = [capabilities.LATE] if arrivals.late else []
    if extended:
        has.append(capabilities.BY_NAME)
    if any(mask for run in arrivals.missed for mask in run[1:]):
        has.append(capabilities.GAPS)
    why = capabilities.not_on_data(name, has)
    if why is not None:
        raise UsageError(why)
