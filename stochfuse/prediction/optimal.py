"""The exact expected optimum, by the contact chain: what no fusion rule can beat.

The contact chain (`stochfuse.engines.contact_chain`) has one path for every history of counts, the same for every item.
The filter runs along each path, in square-root form, once for all items or, where they have noises of their own, for
each of them; every item's paths are weighed with its own link probabilities.  Where paths are too many for that, the
optimum is enclosed in bounds (`stochfuse.engines.enclosure`); where agents or links are unlike and sets of agents too
many for a chain, it is sampled (`stochfuse.engines.contact_sample`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stochfuse.engines.contact_chain import (
    MOST_STATES,
    Chain,
    Contacts,
    LosslessFilter,
    TooManyPathsError,
    TooManyStatesError,
    by_counts,
    by_number,
    check_size,
    contacts,
    expected_optimum,
    joined,
    number_of_paths,
    over_paths,
)
from stochfuse.engines.enclosure import enclosed_optimum
from stochfuse.engines.events import relabellings
from stochfuse.engines.precision import PROMISED, Moving, change, notes, reach, suspects
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction import sampled
from stochfuse.prediction.general import groups_alike
from stochfuse.prediction.method import Averaged, Settings, group_of
from stochfuse.prediction.method import joined as joined_items
from stochfuse.scenario.capabilities import require
from stochfuse.scenario.model import Model, Sensor
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import CHAIN, OPTIMAL
from stochfuse.scenario.system import Items, Noises, System

LOOSE = 0.01
"""Relative half-width from which on a sample is worth more than bounds."""
BLOCK = 1 << 19
"""Numbers that covariances, weights or transitions of a block of items take."""


def averaged(system: System, items: Items, how: Settings, errors: bool) -> Averaged:
    """Return the expected optimum by the contact chain; parameters are those of every method, see `Averaged`.

    Raises
    ------
    UsageError
        If the chain's states or paths are too many.
    """
    links, network = items.links, system.network
    system = system if errors else replace(system, error=None)
    groups = groups_of(system, links)
    try:
        chain = contacts(network, links, system.sensor_of, groups, system.detects)
    except TooManyStatesError:
        return _sampled(system, items, how, errors, f"the contact chain has more than {MOST_STATES} states")
    paths = number_of_paths(network) if counted(system, links) else None
    try:
        if paths is not None:
            check_size(paths)
        found = _every_path(system, items, chain, paths)
    except TooManyPathsError:
        if not items.noises.common:
            return joined_items([(m, averaged(alone, some, how, errors)) for m, alone, some in items.by_noises(system)])
        if errors:
            return _sampled(system, items, how, errors, "the optimum's bias is followed along every path only")
        try:
            found = _with_rounding(
                system, Noises(), lambda given: enclosed_optimum(given, chain, system.steps, len(items))
            )
        except TooManyPathsError as error:
            return _sampled(system, items, how, errors, str(error))
        if float(found.bound.max()) > LOOSE:
            return _sampled(system, items, how, errors, f"bounds on the optimum would be {found.bound.max():.1g} apart")
    bound, far = float(found.bound.max()), np.asarray(found.rounding)
    said = [f"the optimum is proved to lie within a relative {bound:.0e} of the value shown"] if bound else []
    return Averaged(
        # what the optimum claims is what it achieves
        moments=Moments(found.P, found.P, found.bias, found.square) if errors else Moments(found.P),
        group_of=group_of(groups),
        natures=np.where(far > PROMISED, "approximate", "bound" if bound else "exact"),
        estimator=OPTIMAL,
        rounding=far,
        notes=(*said, *notes(float(far.max()))),
        meta={"paths": found.paths if paths is None else paths, "relative_bound": found.bound.tolist()},
    )


def _sampled(system: System, items: Items, how: Settings, errors: bool, why: str) -> Averaged:
    """Sample the optimum where a chain does not take it, and say why."""
    found = sampled.averaged(system, items, replace(how, estimator=OPTIMAL), errors)
    return found._replace(notes=(f"{why}: sampled, {found.meta['runs']:,} runs; ± standard error", *found.notes))


def _every_path(system: System, items: Items, chain: Contacts, paths: int | None) -> Chain:
    """Go through every path, for items with noises of their own a few at a time."""
    steps, own = system.steps, items.noises
    if own.common:
        return _with_rounding(system, own, lambda given: expected_optimum(given, chain, steps, len(items)))
    noises = own._replace(P0=np.broadcast_to(system.P0 if own.P0 is None else own.P0, (len(items), *system.P0.shape)))
    size = _items(chain, _paths_of(system, chain) if paths is None else paths, system.dimension)
    blocks = [np.arange(first, min(first + size, len(items))) for first in range(0, len(items), size)]

    def block(some: np.ndarray) -> Chain:
        def go(given: LosslessFilter, places: np.ndarray = some) -> Chain:
            return joined([over_paths(given, chain, steps, places)])

        return _with_rounding(system, noises.take(some), go, some)

    found = [block(some) for some in blocks]
    P, b, M, bound, rounding = (
        np.concatenate([getattr(f, name) for f in found]) for name in ("P", "bias", "square", "bound", "rounding")
    )
    return Chain(P, b, M, bound, found[0].paths, rounding)


def _with_rounding(system: System, noises: Noises, go: Callable[..., Chain], places: np.ndarray | None = None) -> Chain:
    """Find the optimum, and how far rounding may reach in it, (rows,).

    Parameters
    ----------
    go : finds the optimum of a filter; of noises of items' own, of the items at some places.
    places : of the items, where they have noises of their own.
    """
    found = go(filter_of(system.with_noises(noises)))
    far = np.zeros(len(found.P))
    suspect = np.flatnonzero(suspects(system, noises if noises.P0 is not None else Noises(P0=system.P0[None])))
    if not len(suspect):
        return found._replace(rounding=far)
    if places is None:
        return found._replace(rounding=far + rounding(filter_of(system), found, go))
    P, b, M, bound = (m if m is None else m[suspect] for m in found[:4])
    theirs = found._replace(P=P, bias=b, square=M, bound=bound)
    moved = filter_of(system.with_noises(noises.take(suspect)))
    far[suspect] = rounding(moved, theirs, lambda given: go(given, places[suspect]))
    return found._replace(rounding=far)


def rounding(given: LosslessFilter, found: Chain, go: Callable[[LosslessFilter], Chain]) -> np.ndarray:
    """How far rounding may reach in each row's optimum at some step, (rows,).

    Parameters
    ----------
    go : finds the optimum of a filter.
    """

    def again(seed: int) -> np.ndarray:
        moved = go(given._replace(numbers=Moving(seed)))
        pairs = [(found.P, moved.P), (found.square, moved.square)]
        return np.max([change(P, M).max(axis=(1, 2)) for P, M in pairs if P is not None and M is not None], axis=0)

    return np.broadcast_to(reach(again), len(found.P))


def groups_of(system: System, links: LinkRows) -> tuple[tuple[int, ...], ...]:
    """Return the agents that are alike, whose optimum is the same."""
    require(system, links, OPTIMAL, CHAIN)
    network, kinds = system.network, system.sensor_of
    if by_number(system, links):
        return (tuple(range(network.agents)),)
    return groups_alike(network, links, kinds, relabellings(network, links, kinds))


def filter_of(system: System) -> LosslessFilter:
    """Return the filter of an agent that loses nothing."""
    return LosslessFilter.of(system)


def counted(system: System, links: LinkRows) -> bool:
    """Whether `number_of_paths` is that of the system's chain."""
    plain = system.network.delay == (1.0,) and links.bursts is None and system.detects is None
    return plain and by_number(system, links)


def _paths_of(system: System, chain: Contacts) -> int:
    """How many paths the chain has, followed with the simplest of filters for one row."""
    one = np.ones((1, 1))
    sensors = [Sensor(one, one)] * len(set(system.sensor_of))
    simplest = LosslessFilter(Model(one, one, 0 * one, ("x",), ("",)), sensors, one, False)
    return over_paths(simplest, chain, system.steps, slice(0, 1))[1]


def _items(chain: Contacts, paths: int, dimension: int) -> int:
    """How many items are worked on at a time."""
    states = max(len(here) for here in by_counts(chain)[1])
    return max(1, BLOCK // max(len(chain.held) ** 2, paths * states, paths * dimension**2))
