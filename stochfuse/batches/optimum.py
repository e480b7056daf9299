"""The exact expected optimum of many scenarios that differ in link probability and noises only.

The contact chain (`stochfuse.engines.contact_chain`) has one path for every history of counts, the same for every item.
The filter runs along each path for all items at once, in square-root form, and every item's paths are weighed with its
own link probability.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from stochfuse.batches.claims import Key, typical_rows
from stochfuse.batches.general import check_batch, with_starts
from stochfuse.engines.contact_chain import (
    Contacts,
    Filter,
    TooManyPathsError,
    by_counts,
    check_size,
    contacts,
    joined,
    number_of_paths,
    over_paths,
)
from stochfuse.engines.precision import suspects
from stochfuse.errors import NotABatchError
from stochfuse.estimators.world import batched
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction.optimal import counted, filter_of, groups_of, rounding
from stochfuse.scenario.model import Model, Noises, Sensor
from stochfuse.scenario.network import restricted, uniform_rows
from stochfuse.scenario.scenario import Scenario

BLOCK = 1 << 19
"""Numbers that covariances, weights or transitions of a block of items take."""
MOST_KEPT = 64
"""Sizes of chains kept for the batches to come."""


class Found(NamedTuple):
    """Expected optimum of a batch.

    Parameters
    ----------
    moments : (items, steps, groups, …); what the optimum claims is what it achieves.
    groups : agents that are alike.
    paths : number of paths gone through.
    bound : (items, steps) relative half-width of what encloses it: 0.
    rounding : (items,) how far rounding may reach in the covariance, relative to the standard deviations.
    """

    moments: Moments
    groups: tuple[tuple[int, ...], ...]
    paths: int
    bound: np.ndarray
    rounding: np.ndarray


def moments(scenario: Scenario, link: np.ndarray, noises: Noises, *, errors: bool = False) -> Found:
    """Return the expected optimum of many scenarios that differ in link probability and noises.

    Parameters
    ----------
    scenario, link, noises : as for `stochfuse.batches.general.moments`.
    errors : whether bias and mean squared error are wanted too.

    Raises
    ------
    NotABatchError
        If they cannot be evaluated together: links that differ or are bursty, unlike sensors with noises R of their
        own, more paths than can be gone through one by one, a number that is not finite.
    UsageError
        As `stochfuse.prediction.optimal.optimum`, if that would raise it for one item.
    """
    check_batch(scenario, link, noises)
    network = scenario.network
    groups = groups_of(scenario, typical_rows(network))
    rows = restricted(uniform_rows(link), network)
    chain = contacts(network, rows, scenario.sensor_of, groups)
    paths = _number_of_paths(Key.of(scenario), groups)
    noises = with_starts(scenario, noises, len(link))
    size = _items(chain, paths, scenario.model.dimension)
    blocks = [slice(first, min(first + size, len(link))) for first in range(0, len(link), size)]
    found = [_block(scenario, noises.take(some), chain, some) for some in blocks]
    reached = np.concatenate([far for _, far in found])
    found = joined([part for part, _ in found])
    if not np.isfinite(found.P).all():
        raise NotABatchError("a batch by method optimal: expected a finite optimum, got one that is not")
    of = Moments(found.P, found.P, found.bias, found.square) if errors else Moments(found.P)
    return Found(of, groups, paths, found.bound, reached)


def _block(
    scenario: Scenario, noises: Noises, chain: Contacts, some: slice
) -> tuple[tuple[list[np.ndarray], int], np.ndarray]:
    """What `over_paths` finds for some items, and how far rounding may reach in each, (items,)."""
    steps = scenario.network.steps
    found = over_paths(filter_of(batched(scenario, noises)), chain, steps, some)
    far = np.zeros(len(found[0][0]))
    suspect = np.flatnonzero(suspects(scenario, noises))
    if len(suspect):
        given = filter_of(batched(scenario, noises.take(suspect)))
        theirs = joined([([moment[suspect] for moment in found[0]], found[1])])
        rows: Any = some.start + suspect
        far[suspect] = rounding(given, theirs, lambda moved: joined([over_paths(moved, chain, steps, rows)]))
    return found, far


@lru_cache(maxsize=MOST_KEPT)
def _number_of_paths(key: Key, groups: tuple[tuple[int, ...], ...]) -> int:
    """How many paths the chain has for any link probabilities but 0 and 1.

    Raises
    ------
    NotABatchError
        If they are too many.
    """
    network, kinds = key.scenario.network, key.scenario.sensor_of
    rows = typical_rows(network)
    try:
        if counted(key.scenario, rows):
            check_size(number_of_paths(network))
            return number_of_paths(network)
        one = np.ones((1, 1))
        simplest = Filter(Model(one, one, 0 * one, ("x",), ("",)), [Sensor(one, one)] * len(set(kinds)), one, False)
        return over_paths(simplest, contacts(network, rows, kinds, groups), network.steps, slice(0, 1))[1]
    except TooManyPathsError as reason:
        raise NotABatchError(f"a batch by method optimal: {reason}") from None


def _items(chain: Contacts, paths: int, dimension: int) -> int:
    """How many items are worked on at a time."""
    states = max(len(here) for here in by_counts(chain)[1])
    return max(1, BLOCK // max(len(chain.held) ** 2, paths * states, paths * dimension**2))
