"""What every method is told and what it gives back, so that all are asked alike.

A method averages over chance for a `stochfuse.scenario.system.System` and `Items` of it, and answers with `Averaged`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stochfuse.kalman.checks import covariance_fault, first_fault
from stochfuse.kalman.metrics import Moments
from stochfuse.scenario.registry import LFG

if TYPE_CHECKING:
    from stochfuse.prediction.general import Outcomes
    from stochfuse.prediction.sampled import Sampled

MOST_GRAPHS = 100_000
RUNS, SEED = 1000, 1


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
    """

    estimator: str = LFG
    max_graphs: int = MOST_GRAPHS
    prune: bool = False
    runs: int = RUNS
    seed: int = SEED
    workers: int | None = None
    criterion: str = "det"


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
    sampled: Sampled | None = None
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
