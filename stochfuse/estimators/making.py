"""Makes an estimator by its name, and the numbers of what it has written down, for a system.

Estimators whose estimates are sums of information write them into a ledger (`stochfuse.estimators.ledger`); the others
write down pasts (`stochfuse.estimators.recursion`).  Which is which, and where each is, says the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import InformationClaims, Ledger, Sources, evaluate
from stochfuse.estimators.pedigrees import GraphTogether
from stochfuse.estimators.protocol import Made, Together
from stochfuse.estimators.readings import Readings
from stochfuse.estimators.recursion import PastClaims, Pasts, RecursiveEstimator
from stochfuse.estimators.together import NaiveTogether, PastsTogether
from stochfuse.estimators.world import World, error_sources, sources_of, world_of
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.network import default_rows
from stochfuse.scenario.own_rules import OwnRule
from stochfuse.scenario.system import Noises, System

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
    name : one of `stochfuse.scenario.registry.ESTIMATORS`, or an `OwnRule`.
    relabellings : permutations of the agents that change nothing; None if nobody may change places.
    errors : whether noise footprints are carried along, see `stochfuse.estimators.world`.
    records : measurements (steps, agents, p) where states are wanted; of agents that measure less than others what
        is too much does not matter.
    criterion : what the weights of an intersection minimise: "det", "trace" or "max-eig".

    Raises
    ------
    UsageError
        If the estimator is not one for such a system.
    """
    capabilities.require(system, default_rows(system.network), name, registry.GENERAL)
    if errors:
        _check_footprints(system, name)
    entry, rule = registry.estimator(name), rule_of(name)
    if not entry.sums:
        more = {"criterion": criterion} if entry.weighs else {}
        build = partial(rule, kinds=kinds_of(system, name), relabellings=relabellings, errors=errors, **more)
        if records is not None:  # which tell like agents apart
            build = partial(rule, kinds=range(system.agents), relabellings=relabellings, errors=True, **more)
        estimator = build(world_of(system))
        return Made(name, estimator, partial(_of_pasts, build, estimator.pasts, records))
    everyone = tuple(range(system.agents))
    # records tell like agents apart; footprints only say whose noise is whose
    labels = everyone if errors or records is not None else system.sensor_of
    ledger = Ledger(system.sensor_of if errors else None)
    estimator = rule(ledger, labels, shared=system.shared, relabellings=relabellings)
    return Made(name, estimator, partial(_of_sums, ledger, errors, records))


def make_together(
    system: System, name: str, *, errors: bool = False, records: np.ndarray | None = None, criterion: str = "det"
) -> Callable[[int], Together] | None:
    """Make what follows so many outcomes at a time in an estimator's place; None if nothing does.

    Parameters and errors are those of `make`.
    """
    entry, rule = registry.estimator(name), rule_of(name)
    if entry.sums:
        labels = tuple(range(system.agents)) if errors or records is not None else system.sensor_of
        if name == registry.LFG:
            return partial(
                GraphTogether, sources(system, Noises(), errors, records), labels, system.shared, system.steps
            )
        if name == registry.NAIVE:
            return partial(NaiveTogether, sources(system, Noises(), errors, records), labels, system.shared)
    elif (entry.weighs or name == registry.STAND_ALONE) and not (system.own or system.filters) and records is None:
        if errors:
            _check_footprints(system, name)
        more = {"criterion": criterion} if entry.weighs else {}
        return partial(PastsTogether, rule(world_of(system), system.labels, errors=errors, **more))
    return None


def make_for_data(system: System, name: str, criterion: str = "det") -> Any:
    """Make an estimator whose values are of agents, not of kinds of them: their data tell them apart.

    What its values come to: `stochfuse.estimators.readings`.
    """
    entry, rule, everyone = registry.estimator(name), rule_of(name), tuple(range(system.agents))
    if entry.sums:
        return rule(Ledger(), everyone, shared=system.shared)
    more = {"criterion": criterion} if entry.weighs else {}
    return rule(world_of(system), everyone, errors=True, **more)


def rule_of(name: str) -> Any:
    """Return an estimator's class, its file imported when it is asked for."""
    file, kind = registry.estimator(name).place
    found = getattr(import_module(f"stochfuse.estimators.{file}"), kind)
    return partial(found, rule=name) if isinstance(name, OwnRule) else found


def kinds_of(system: System, name: str) -> Sequence[int]:
    """Kind of every agent; all differ where an estimator minds the order of those heard, which is that of numbers."""
    return range(system.agents) if getattr(name, "ordered", False) else system.labels


def _of_pasts(
    build: Callable[[World], RecursiveEstimator],
    pasts: Pasts,
    records: np.ndarray | None,
    system: System,
    noises: Noises,
) -> PastClaims:
    if not noises.common:
        raise UsageError("an estimator of pasts takes one set of noises at a time")
    estimator = build(world_of(system))
    estimator.pasts = pasts
    if records is not None:
        widths = [H.shape[-2] for H in estimator.world.H]
        z = [records[None, :, i, :width] for i, width in enumerate(widths)]
        estimator.readings = Readings.given(system, z)
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
    if registry.estimator(name).footprints and numbers > MOST_COEFFICIENTS:
        raise UsageError(
            f"estimator {name}: the actual error after {steps} steps of {d} states has {numbers} coefficients on "
            f"noises, expected at most {MOST_COEFFICIENTS}: take fewer steps, or quantity claimed"
        )
