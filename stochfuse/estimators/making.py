"""The estimators by the names that users ask for: what each is made of, for a system.

local-fusion-graph        common information removed by the graph (thesis chapter 2)
naive                     estimates added up, nothing removed, (42)/(43)
optimal                   the best that any linear fusion could do with what arrived (theory section 6)
covariance-intersection   everything taken for possibly correlated (theory section 9, as all that follow)
split-ci                  everything but the step's own measurement
blender, joint-blender    parallel filters, in a tree or all at once
equivalent-measurement    measurements exchanged, their noises correlated and uncertain
independent-measurements  the same as if they were independent
lwin, itns                cooperative measurements, local or central
stand-alone               no fusion
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import InformationClaims, Ledger, Sources, evaluate
from stochfuse.estimators.local_fusion_graph import LocalFusionGraph
from stochfuse.estimators.naive import NaiveFusion
from stochfuse.estimators.optimal import OptimalFusion
from stochfuse.estimators.protocol import Made
from stochfuse.estimators.recursion import PastClaims, Pasts, RecursiveEstimator
from stochfuse.estimators.world import World, error_sources, sources_of, world_of
from stochfuse.scenario.registry import INTERSECTIONS
from stochfuse.scenario.system import Noises, System

SUMS: dict[str, Any] = {
    "local-fusion-graph": LocalFusionGraph,
    "naive": NaiveFusion,
    "optimal": OptimalFusion,
}
"""Estimators whose estimates are sums of information."""
PASTS = {
    "covariance-intersection": ("intersection", "CovarianceIntersection"),
    "split-ci": ("intersection", "SplitCovarianceIntersection"),
    "blender": ("blender", "Blender"),
    "joint-blender": ("blender", "JointBlender"),
    "equivalent-measurement": ("equivalent", "EquivalentMeasurement"),
    "independent-measurements": ("equivalent", "IndependentMeasurements"),
    "lwin": ("cooperative", "Lwin"),
    "itns": ("cooperative", "Itns"),
    "stand-alone": ("stand_alone", "StandAlone"),
}
"""Estimators that remember pasts: module in `stochfuse.estimators.protocol`, and class; imported when asked for."""
WITH_OWN_STATES = ("covariance-intersection", "split-ci", "lwin", "itns", "stand-alone")
WITH_OWN_FILTERS = ("blender", "joint-blender")
WITHOUT_FOOTPRINTS = ("equivalent-measurement", "independent-measurements", "itns")
MOST_COEFFICIENTS = 20_000
"""Coefficients on noises that an estimate may carry along."""


def make(
    system: System,
    name: str,
    relabellings: Sequence[tuple[int, ...]] | None = None,
    *,
    errors: bool = False,
    records: np.ndarray | None = None,
    criterion: str = "det",
) -> Made:
    """Make an estimator for a system.

    Parameters
    ----------
    name : one of `stochfuse.prediction.predict.ESTIMATORS`.
    relabellings : permutations of the agents that change nothing; None if nobody may change places.
    errors : whether noise footprints are carried along, see `stochfuse.estimators.world`.
    records : measurements (steps, agents, p) where states are wanted, for estimators of sums of information.
    criterion : what the weights of an intersection minimise: "det", "trace" or "max-eig".

    Raises
    ------
    UsageError
        If the estimator is not one for such a system.
    """
    check(system, name)
    if errors:
        _check_footprints(system, name)
    if name in PASTS:
        if records is not None:
            raise UsageError(f"estimator {name}: its states cannot be had for a record of measurements")
        module, kind = PASTS[name]
        rule = getattr(import_module(f"stochfuse.estimators.{module}"), kind)
        more = {"criterion": criterion} if name in INTERSECTIONS else {}
        build = partial(rule, kinds=system.labels, relabellings=relabellings, errors=errors, **more)
        estimator = build(world_of(system))
        return Made(name, estimator, partial(_of_pasts, build, estimator.pasts))
    everyone = tuple(range(system.agents))
    # records tell like agents apart; footprints only say whose noise is whose
    labels = everyone if errors or records is not None else system.sensor_of
    ledger = Ledger(system.sensor_of if errors else None)
    estimator = SUMS[name](ledger, labels, shared=system.shared, relabellings=relabellings)
    return Made(name, estimator, partial(_of_sums, ledger, errors, records))


def _of_pasts(build: Callable[[World], RecursiveEstimator], pasts: Pasts, system: System, noises: Noises) -> PastClaims:
    if not noises.common:
        raise UsageError("an estimator of pasts takes one set of noises at a time")
    estimator = build(world_of(system))
    estimator.pasts = pasts
    return PastClaims(estimator)


def _of_sums(
    ledger: Ledger, errors: bool, records: np.ndarray | None, system: System, noises: Noises
) -> InformationClaims:
    return InformationClaims(evaluate(ledger, sources(system, noises, errors, records)))


def sources(system: System, noises: Noises, errors: bool = False, records: np.ndarray | None = None) -> Sources:
    """Return what the atoms of a ledger stand for: information, with noise footprints or data beside it.

    Parameters
    ----------
    noises : of items, P0 among them where there are any; then everything has the items' axis.
    errors : whether noise footprints are carried along, see `stochfuse.estimators.world`.
    records : measurements (steps, agents, p) where states are wanted.
    """
    if errors:
        return error_sources(system, None if noises.common else noises)
    return sources_of(system.with_noises(noises), records)


def _check_footprints(system: System, name: str) -> None:
    """Raise UsageError if an estimate's coefficients on all noises are too many to carry along."""
    d, n, steps = system.model.dimension, system.network.agents, system.network.steps
    measured = sum(system.sensors[kind].H.shape[-2] for kind in system.sensor_of)
    numbers = d * (n * d + (steps - 1) * (d + measured))
    if name not in WITHOUT_FOOTPRINTS and numbers > MOST_COEFFICIENTS:
        raise UsageError(
            f"estimator {name}: the actual error after {steps} steps of {d} states has {numbers} coefficients on "
            f"noises, expected at most {MOST_COEFFICIENTS}: take fewer steps, or quantity claimed"
        )


def require_independent_noise(system: System, who: str) -> None:
    """Raise UsageError if measurement noises hang together."""
    if system.noise is not None:
        raise UsageError(
            f"{who}: expected independent measurement noises, got [noise] with a correlation or a disturbance"
        )


def require_one_state(system: System, who: str) -> None:
    """Raise UsageError unless all agents track the state of one model."""
    if not system.one_state:
        what = "states of their own (model.own)" if system.own else "filters of their own"
        raise UsageError(f"{who}: expected agents that track one state by one model, got agents with {what}")


def check(system: System, name: str) -> None:
    """Raise UsageError if an estimator is not one for such a system."""
    who = f"estimator {name}"
    if system.own and name not in WITH_OWN_STATES:
        raise UsageError(f"{who}: expected agents that track one state, got states of their own (model.own)")
    if system.filters and not system.own and name not in WITH_OWN_FILTERS:
        raise UsageError(f"{who}: expected one model for all agents, got parallel filters ([[agent]] F, Q, P, M or s)")
    if name == "optimal":
        require_independent_noise(system, who)
    takes_late = name in SUMS or (name in INTERSECTIONS and not system.own)
    if not takes_late and system.network.delay != (1.0,):
        raise UsageError(f"{who}: expected messages without delay, got network.delay")
