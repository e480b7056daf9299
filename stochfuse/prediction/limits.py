"""The steady state of any prediction: what it tends to as the steps go on.

    simplified                 the fixed point P = g_µ(P) (`stochfuse.prediction.steady_state`)
    the optimum, stand-alone   the contact chain's geometric tail, enclosed (`stochfuse.prediction.steady_chain`)
    everything else            sampled at a step by which where it began no longer matters

An optimal filter's error is what it claims, and a known initial error is forgotten: actual = claimed = rms², bias 0.

Where sensors have periods the limit is a cycle.  Its phases are the steps k ≡ 1, 2 … (mod the least common period); the
fixed point is then enclosed by two runs of (54), from P = 0 and from one so large that it falls from period to period.

Burn-in.  Two samples hear the same arrivals.  One starts from P(k0)/100, common to all agents, with the known initial
error, the other from 100 P(k0), independent, without it.  The step is doubled until every variance of the two, at two
cycles of steps, differs by less than a tenth of its standard error, and is the same at twice the steps within six of
them: what is claimed may settle while the true error grows.  Then the runs are independent, and the standard error
of the sample at that step is that of the steady state.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from typing import Any

import numpy as np

from stochfuse.engines.contact_chain import (
    Contacts,
    TooManyPathsError,
    TooManyStatesError,
    contacts,
    over_paths,
)
from stochfuse.engines.enclosure import ROUNDING, enclosed, half_width
from stochfuse.engines.precision import PROMISED
from stochfuse.errors import NoAnswerError, ScenarioError, StochfuseError, UsageError
from stochfuse.estimators.progress import listener, within
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction import optimal
from stochfuse.prediction.method import Settings, group_of
from stochfuse.prediction.result import Limit, Prediction
from stochfuse.prediction.steady_chain import Starts, growing, starts
from stochfuse.scenario import capabilities
from stochfuse.scenario.network import LinkRows, delivery_after_failures
from stochfuse.scenario.registry import CHAIN, MONTE_CARLO, OPTIMAL, SIMPLIFIED, STAND_ALONE
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.system import System

LONGEST_PERIOD = 60
"""Steps that a cycle may have."""
TIGHT, TIGHT_BETWEEN, STALLED = 1e-10, 1e-7, 0.5
"""Relative width at which bounds are close enough, along every path and not; and what is left where they stay apart."""
MOST_STEPS, MOST_ALONG_PATHS = 512, 1024
"""Steps after which a limit is not reached, and those where the paths are few."""
NEVER_AGAIN = 1e-14
"""Change of the probability that a bursty link delivers, after one more failure, that is none."""
PILOT = 100
"""Runs by which a burn-in is found."""
CLOSE, MOVED = 0.1, 6.0
"""Standard errors by which two starts may differ, and one start at twice the steps: the largest of many."""
FAR = 100.0
"""Factor on P(k0) by which two starts differ from it."""


def limit(prediction: Prediction, rows: LinkRows, how: Settings) -> Limit:
    """Return what a prediction tends to.

    Raises
    ------
    UsageError
        If what is given varies with the step, other than by sensors with periods.
    NoAnswerError
        If there is no limit, or none that is reached within the steps that are tried.
    """
    scenario = prediction.scenario
    period = period_of(scenario, rows)
    if prediction.method == SIMPLIFIED:
        return (_fixed_point if period == 1 else _fixed_cycle)(prediction, rows, period)
    name = prediction.estimator
    alone = replace(rows, link=np.zeros(len(rows.link)), bursts=None) if name == STAND_ALONE else rows
    if name in (OPTIMAL, STAND_ALONE) and capabilities.takes(scenario.system, alone, OPTIMAL, CHAIN):
        found = _by_chain(prediction, alone, period)
        if found is not None:
            return found
    if period == 1 and capabilities.takes(scenario.system, rows, OPTIMAL, CHAIN):
        _require_bounded(scenario, rows, sampled=True)  # nothing is better than the optimum
    return _by_sampling(prediction, rows, period, how)


def period_of(scenario: Scenario, rows: LinkRows) -> int:
    """Return after how many steps what is given repeats itself: 1 where nothing varies.

    Raises
    ------
    UsageError
        If it never does.
    """
    capabilities.require_endless(scenario.system, rows, periodic=True)
    if any((M[1:] != M[1:2]).any() for M in _by_step(scenario)):
        raise UsageError(
            f"a steady state needs {capabilities.ENDLESS}; got filters or relations that vary with the step"
        )
    if not (scenario.model.varies or any(sensor.varies for sensor in scenario.sensors)):
        return 1
    steps = 3 * LONGEST_PERIOD + 1
    try:
        system = prolonged(scenario, steps).system
    except ScenarioError:  # matrices are given for so many steps and no more
        system = scenario.system
    varying = [system.model.F, system.model.Q, *(M for s in system.sensors for M in (s.H, s.R))]
    varying += [] if system.detects is None else [system.detects]
    for period in range(1, LONGEST_PERIOD + 1 if system.steps == steps else 1):
        if all((M[1 + period :] == M[1:-period]).all() for M in varying):
            return period
    capabilities.require_endless(scenario.system, rows, periodic=False)
    raise TypeError("what varies is refused")


def prolonged(scenario: Scenario, steps: int) -> Scenario:
    """Return the same with another number of steps; sensors with periods go on."""
    network = replace(scenario.network, steps=steps)
    if any(µ is not None and µ.ndim in (1, 3) for µ in (network.link, *(µ for _, µ in network.cases))):
        network = replace(network, link=None, cases=())  # other links are asked about
    if not (scenario.model.varies or any(sensor.varies for sensor in scenario.sensors) or _by_step(scenario)):
        return replace(scenario, network=network)
    mapping = scenario.to_mapping()
    mapping["network"] = {**mapping.get("network", {}), "steps": steps}
    made = Scenario.from_mapping(mapping, scenario.name)
    names = ("model", "sensors", "nominal", "filters", "noise", "process", "relations")
    return replace(scenario, network=network, **{name: getattr(made, name) for name in names})


def _by_step(scenario: Scenario) -> list[np.ndarray]:
    """Matrices of filters and of what agents measure of one another that are written down for every step."""
    matrices = [M for f in scenario.filters for M in (f.F, f.Q)] + [M for M in (scenario.process,) if M is not None]
    matrices += [M for relation in scenario.relations.values() for M in relation if isinstance(M, np.ndarray)]
    return [M for M in matrices if M.ndim > 2]


def _found(prediction: Prediction, P: np.ndarray, nature: str) -> Prediction:
    """A prediction of the phases, of an estimate that is as good as it claims: P (rows, period, groups, d, d)."""
    nothing = np.zeros((*P.shape[:-1], 1))
    moments = Moments(P, P, nothing, P) if prediction.with_actual else Moments(P)
    steps = np.arange(1, P.shape[1] + 1)
    return replace(prediction, moments=moments, steps=steps, nature=nature, sampled=None, outcomes=None)


def _proved(worst: float, period: int) -> str:
    what = "steady state is" if period == 1 else f"cycle of {period} steps, of which the mean is shown, is"
    if worst < 1:
        return f"the {what} proved to lie within a relative {worst:.0e} of the value shown"
    return f"the {what} found: its residual is at rounding level, but no bound on it could be proved"


def _fixed_point(prediction: Prediction, rows: LinkRows, period: int) -> Limit:
    from stochfuse.prediction.steady_state import steady_state

    fixed = steady_state(prediction.scenario, rows)
    found = _found(prediction, fixed.P[:, None], prediction.nature)
    return Limit(found, period, fixed.bound, (_proved(fixed.bound.max(), period),))


def _fixed_cycle(prediction: Prediction, rows: LinkRows, period: int) -> Limit:
    """Run (54) from below and from above until both are in the same cycle."""
    from stochfuse.prediction.predict import predict

    P0 = prediction.scenario.P0
    large = 1e6 * np.diag(np.diagonal(P0 + np.eye(len(P0)) * np.trace(P0)))
    for steps in _doubling(period):
        try:
            low, high = (
                predict(replace(prolonged(prediction.scenario, steps), P0=start), rows, SIMPLIFIED).by_group
                for start in (0.0 * P0, large)
            )
        except StochfuseError:  # it grows beyond floating point
            break
        middle, falls = 0.5 * (low + high)[:, -period:], (high[:, -2 * period : -period] - high[:, -period:])
        bound = half_width((high - low)[:, -period:], middle).max() + ROUNDING
        if bound <= TIGHT and half_width(-falls, middle).max() <= TIGHT:
            bounds = np.full((len(middle), middle.shape[2]), bound)
            return Limit(_found(prediction, middle, prediction.nature), period, bounds, (_proved(bound, period),))
    raise NoAnswerError(f"no cycle: the averaged covariance does not settle within {MOST_STEPS} steps")


def _doubling(period: int, least: int = 16, most: int = MOST_STEPS) -> Iterator[int]:
    """Numbers of steps to try, whole periods each."""
    steps = period * -(-max(least, 2 * period + 2) // period)
    while steps <= max(most, 8 * period):
        listener().advance("steady state", steps, most)
        yield steps
        steps *= 2


def _chain_of(system: System, rows: LinkRows, groups: tuple[tuple[int, ...], ...], period: int) -> Contacts:
    """The contact chain, also of the last of no end of steps."""
    remembered = len(system.network.delay)
    for burst in rows.bursts or ():
        if burst is not None:
            p = delivery_after_failures(burst[None], np.ones(MOST_STEPS))[0]
            remembered = max(remembered, 2 + int((np.abs(p - p[-1]) > NEVER_AGAIN).sum()))
    detects = system.detects
    if detects is not None:  # the first step is one of many
        detects = np.tile(np.roll(detects[1 : period + 1], 1, axis=0), (2 * MOST_ALONG_PATHS // period + 2, 1))
    return contacts(replace(system.network, steps=remembered), rows, system.sensor_of, groups, detects)


def _require_bounded(scenario: Scenario, rows: LinkRows, *, sampled: bool) -> None:
    """Raise NoAnswerError where even the optimum grows without end, as far as that can be told; or has no variance."""
    if np.abs(np.linalg.eigvals(scenario.system.model.F[-1])).max() < 1.0:
        return
    system = prolonged(scenario, 4).system
    groups = optimal.groups_of(system, rows)
    try:
        chain = _chain_of(system, rows, groups, 1)
    except TooManyStatesError:
        return
    for row, moment in product(range(len(rows.link)), (1, 2) if sampled else (1,)):
        found = growing(optimal.filter_of(system), chain, row, moment)
        if found is None:
            continue
        where = f"(link probability {rows.means(scenario.network)[row]:g})"
        if moment == 1:
            raise NoAnswerError(
                f"no steady state: the mode of F with eigenvalue {found[0]:.6g} grows by a factor of at least "
                f"{found[1]:.6g} in every step, on average over what arrives, for the optimum too: too often nothing "
                f"that arrives shows it {where}"
            )
        raise NoAnswerError(
            "the steady state cannot be sampled: the covariance, even the optimum's, has no variance over the "
            f"outcomes, since the square of what the mode of F with eigenvalue {found[0]:.6g} adds grows by a factor "
            f"of at least {found[1]:.6g} in every step {where}"
        )


def _by_chain(prediction: Prediction, rows: LinkRows, period: int) -> Limit | None:
    """The optimum, enclosed; None where there are too many states or paths to enclose it well."""
    scenario = prediction.scenario
    system = prolonged(scenario, max(period + 1, 2)).system
    groups = optimal.groups_of(system, rows)
    try:
        chain, given = _chain_of(system, rows, groups, period), optimal.filter_of(system)
        everywhere = starts(given, chain, period, None)
        parts, n = [], len(rows.link)
        for some in [slice(0, n)] if everywhere else [slice(row, row + 1) for row in range(n)]:
            if everywhere is None and period == 1:
                _require_bounded(scenario, rows.take(some), sampled=False)
            begin = everywhere or starts(given, chain, period, some.start)
            if begin is None:
                raise NoAnswerError(
                    "no steady state of the optimum is known: bounds on it do not settle, links or filters are too "
                    f"slow (link probability {rows.means(scenario.network)[some.start]:g})"
                )
            parts.append(_between(scenario, chain, begin, some, period))
    except (TooManyStatesError, TooManyPathsError):
        return None
    low, high = (np.concatenate(side) for side in zip(*parts, strict=True))
    middle = 0.5 * (low + high)
    bound = half_width(high - low, middle) + ROUNDING
    if not bound.max() <= optimal.LOOSE:
        return None
    nature = "exact" if bound.max() <= PROMISED else "bound"
    bounds = np.tile(bound.max(axis=1)[:, None], (1, middle.shape[2]))
    found = replace(_found(prediction, middle, nature), group_of=group_of(groups))
    return Limit(found, period, bounds, (_proved(bound.max(), period),))


def _between(
    scenario: Scenario, chain: Contacts, begin: Starts, some: slice, period: int
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of some rows at the phases, by ever longer paths."""
    every, before, found, ends = True, np.inf, None, []
    for steps in _doubling(period, 8, MOST_ALONG_PATHS):
        given = optimal.filter_of(prolonged(scenario, steps + 1).system)
        sides = [given._replace(first=first) for first in begin]
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                ends = [over_paths(side, chain, steps + 1, some)[0][0] for side in sides] if every else []
            except TooManyPathsError:
                every = False
            ends = ends if every else enclosed(sides[0], chain, steps + 1, some, sides[1])
        # step 1 is one of those ≡ 1: the last period ends at ≡ 1
        low, high = (np.roll(side[:, -period:], 1, axis=1) for side in ends)
        if not np.isfinite(high).all():  # what is hardly ever left unabsorbed grows beyond floating point
            break
        found = low, high
        width = float(half_width(high - low, 0.5 * (low + high)).max())
        if width <= (TIGHT if every else TIGHT_BETWEEN) or not (every or width < STALLED * before):
            break
        before = width
    if found is None:
        raise TooManyPathsError("bounds on the steady optimum grow beyond floating point")
    return found


def _by_sampling(prediction: Prediction, rows: LinkRows, period: int, how: Settings) -> Limit:
    """Sample at a step by which two starts that are far apart no longer differ."""
    scenario, wanted = prediction.scenario, _Wanted(prediction, rows, period)
    few = replace(how, runs=min(how.runs, PILOT))
    share, settled = np.sqrt(few.runs / how.runs), None
    takes = ""
    for steps in _doubling(period):
        one, other = _two(prolonged(scenario, steps))
        began = time.monotonic()
        with within(f"burn-in of {steps} steps{takes}", 1, 2):
            near = wanted.at(one, few)
        takes = f"; the sample takes {(time.monotonic() - began) * how.runs / few.runs:.0f} s or more"
        if settled is not None and wanted.apart(near, settled[1], 1.0) <= MOVED:
            at, _, gap = settled
            note = (
                f"steady state: sampled at step {at}, {how.runs:,} runs; two samples of the same arrivals, from "
                f"P(k0)/{FAR:g} and from {FAR:g} P(k0), differ there by at most {gap:.1g} standard errors"
            )
            cycle = f"the limit is a cycle of {period} steps, of which the mean is shown"
            with within(f"sample at step {at}{takes}", 1, 1):
                found = wanted.at(prolonged(scenario, at), how)
            return Limit(found, period, None, (note, *[cycle] * (period > 1)))
        with within(f"burn-in of {steps} steps{takes}", 2, 2):
            gap = wanted.apart(near, wanted.at(other, few), share)
        settled = (steps, near, gap) if gap <= CLOSE else None
    raise NoAnswerError(
        f"no steady state: within {MOST_STEPS} steps two samples of the same arrivals that start far apart do not "
        "agree, or the error grows; it mixes too slowly, or there is none"
    )


def _two(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """The same from two starts that are far apart."""

    def begun(factor: float, correlation: str, error: Any) -> Scenario:
        filters = tuple(replace(f, P0=factor * f.P0) for f in scenario.filters)
        alike = scenario.correlation if scenario.own or filters else correlation
        return replace(scenario, P0=factor * scenario.P0, filters=filters, correlation=alike, error=error)

    return begun(1.0 / FAR, "shared", scenario.error), begun(FAR, "independent", None)


class _Wanted:
    """What is sampled of a prediction's quantity, and compared."""

    def __init__(self, prediction: Prediction, rows: LinkRows, period: int) -> None:
        self.prediction, self.rows, self.period = prediction, rows, period
        self.metrics = [f"var:{state}" for state in prediction.scenario.model.states]

    def at(self, scenario: Scenario, how: Settings) -> Prediction:
        """Sample as many steps as a scenario has."""
        from stochfuse.prediction.predict import predict

        how = replace(how, estimator=self.prediction.estimator, precision=None, at_most=None)
        settings = {field.name: getattr(how, field.name) for field in fields(how)}
        quantity = "rms" if self.prediction.with_actual else "claimed"
        found = predict(scenario, self.rows, MONTE_CARLO, quantity, **settings)
        shown = self.prediction.quantity
        return found.shown_as("claimed" if shown == OPTIMAL else shown)

    def apart(self, one: Prediction, other: Prediction, share: float) -> float:
        """How far two samples are apart at the last two cycles, at most, in standard errors times a share of them."""
        found, last = [], -2 * self.period
        for quantity in ("claimed", "rms") if self.prediction.with_actual else ("claimed",):
            a, b = one.shown_as(quantity), other.shown_as(quantity)
            for metric in self.metrics:
                x, y, error = a.values(metric), b.values(metric), a.standard_error(metric)
                error = np.zeros_like(x) if error is None else error
                # where nothing is left to chance, digits are asked for
                unit = np.maximum(share * error[:, last:], 1e-7 * np.abs(x[:, last:]) + 1e-300)
                found.append((np.abs(x[:, last:] - y[:, last:]) / unit).max())
        return float(np.max(found))
