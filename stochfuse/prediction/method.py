"""What every method is told and what it gives back, so that all are asked alike.

A method averages over chance for a `stochfuse.scenario.system.System` and `Items` of it, and answers with `Averaged`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.checks import covariance_fault, first_fault
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.scenario.registry import LFG, OPTIMUM

if TYPE_CHECKING:
    from stochfuse.prediction.general import Outcomes
    from stochfuse.prediction.sampled import MomentSample

MOST_GRAPHS = 100_000
RUNS, SEED = 1000, 1


@dataclass(frozen=True)
class ShownPart:
    """What of a prediction will be looked at: what a precision is asked of.

    Parameters
    ----------
    quantities : names; default: the one that is predicted.
    metrics : numbers that are made of it; default: the scenario's metric, else the trace.
    agent : "mean", "worst", "best" or a number from 1.
    steps : which of them; default: all.
    """

    quantities: tuple[str, ...] = ()
    metrics: tuple[Metric, ...] = ()
    agent: int | str = "mean"
    steps: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Settings:
    """How a method goes about its work.

    Parameters
    ----------
    estimator : what the agents do with what arrives, one of `stochfuse.scenario.registry.ESTIMATORS`; or a rule of
        your own, by "package.module:Class", as a class or as an object, see `stochfuse.estimators.own`.
    max_graphs : general: different graphs that may be carried from step to step.
    prune : general: leave the least likely graphs out where there are more, instead of giving up.
    runs, seed : monte-carlo: independent runs per link probability, and the seed.
    workers : monte-carlo: processes; default: one for small samples, else one per processor.
    criterion : covariance-intersection, split-ci: what the weights minimise, "det", "trace" or "max-eig",
        in each fusion by itself: over several steps that need not be the least.
    control : monte-carlo: "optimum", the exact optimum as control variate wherever that helps, or "none".
    precision : monte-carlo: draw until every standard error shown is below that share of its value, 0.002 or "0.2%",
        in the place of `runs`; where an exact engine takes the scenario it is used.
    at_most : with a precision: seconds after which no more is drawn, 60 or "60s"; the runs then depend on the machine.
    exact_first : with a precision: whether an exact engine is used where it is cheap.
    shown : with a precision: what of the prediction it is asked of.
    """

    estimator: str = LFG
    max_graphs: int = MOST_GRAPHS
    prune: bool = False
    runs: int = RUNS
    seed: int = SEED
    workers: int | None = None
    criterion: str = "det"
    control: str = OPTIMUM
    precision: float | str | None = None
    at_most: float | str | None = None
    exact_first: bool = True
    shown: ShownPart = ShownPart()


class Averaged(NamedTuple):
    """What a method found.

    Parameters
    ----------
    moments : of the error, (items, steps, groups, …).
    group_of : (agents,) index into the groups of like agents.
    natures : (items,) "exact", "approximate", "bound" or "sampled".
    estimator : what the agents do with what arrives.
    rounding : (items,) how far rounding may reach in a covariance, relative to the standard deviations.
    faults : why an item has no answer, by its place.
    notes : what the reader should know, one sentence each.
    forms : numeric forms used.
    outcomes, sampled : all outcomes where they were enumerated, the sample where one was drawn.
    meta : further facts for programs.
    """

    moments: Moments
    group_of: np.ndarray
    natures: np.ndarray
    estimator: str
    rounding: np.ndarray
    faults: Mapping[int, str] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    forms: tuple[str, ...] = ()
    outcomes: Outcomes | None = None
    sampled: MomentSample | None = None
    meta: Mapping[str, Any] = MappingProxyType({})


def joined(parts: Sequence[tuple[np.ndarray, Averaged]]) -> Averaged:
    """Return what was found of some items at a time, in the items' order.

    Parameters
    ----------
    parts : places of items, and what was found of them.
    """
    if len(parts) == 1:
        return parts[0][1]
    places = np.concatenate([members for members, _ in parts])
    back, first = np.argsort(places), parts[0][1]
    columns = zip(*(found.moments for _, found in parts), strict=True)
    return first._replace(
        moments=Moments(*(None if m[0] is None else np.concatenate(m)[back] for m in columns)),
        natures=np.concatenate([found.natures for _, found in parts])[back],
        rounding=np.concatenate([found.rounding for _, found in parts])[back],
        faults={int(members[place]): why for members, found in parts for place, why in found.faults.items()},
        notes=tuple(dict.fromkeys(note for _, found in parts for note in found.notes)),
        forms=tuple(sorted({form for _, found in parts for form in found.forms})),
        outcomes=None,
        sampled=None,
        meta={},
    )


def group_of(groups: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Index of every agent among groups of agents."""
    index = np.zeros(sum(map(len, groups)), dtype=int)
    for group, agents in enumerate(groups):
        index[list(agents)] = group
    return index


def faults_of(moments: Moments) -> dict[int, str]:
    """Items with a matrix that is no covariance, by their place, and why."""
    found = {}
    for name, M in (("claimed", moments.P), ("actual", moments.actual)):
        if M is None or covariance_fault(M) is None:
            continue
        for item, first in enumerate(map(first_fault, M)):
            if first is not None:
                found.setdefault(item, f"the {name} covariance at step {first[0]} is {first[1]}")
    return found


def share(value: float | str) -> float:
    """Return a precision as a share: of 0.002, "0.002" or "0.2%".

    Raises
    ------
    UsageError
        If it is none, or not between 0 and 1.
    """
    text = str(value).strip()
    try:
        found = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        found = 0.0
    if not 0.0 < found < 1.0:
        raise UsageError(f"precision: expected a share between 0 and 1, such as 0.2% or 0.002, got '{value}'")
    return found


def seconds(value: float | str) -> float:
    """Return a time in seconds: of 60, "60s" or "2min".

    Raises
    ------
    UsageError
        If it is none, or not positive.
    """
    text = str(value).strip()
    unit = next((u for u in ("min", "s", "h") if text.endswith(u)), "")
    try:
        found = float(text.removesuffix(unit)) * {"min": 60.0, "h": 3600.0}.get(unit, 1.0)
    except ValueError:
        found = 0.0
    if not 0.0 < found < inf:
        raise UsageError(f"at-most: expected a time such as 60s or 2min, got '{value}'")
    return found
