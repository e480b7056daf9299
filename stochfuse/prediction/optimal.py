"""The exact expected optimum of a scenario, theory section 6: what no fusion rule can beat."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stochfuse.engines.contact_chain import (
    Chain,
    Filter,
    TooManyPathsError,
    check_size,
    contacts,
    expected_optimum,
    number_of_paths,
)
from stochfuse.engines.enclosure import enclosed_optimum
from stochfuse.engines.events import relabellings
from stochfuse.engines.precision import Moving, change, reach, suspects
from stochfuse.prediction.general import groups_alike
from stochfuse.scenario.model import Noises
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.scenario import Scenario, require_independent_noise, require_one_state


def optimum(scenario: Scenario, rows: LinkRows) -> tuple[Chain, tuple[tuple[int, ...], ...]]:
    """Return the expected optimum by the contact chain, and the groups of agents that it holds for.

    Exact where the chain's paths can be gone through one by one, else enclosed in bounds.

    Raises
    ------
    UsageError
        If the chain's states or paths are too many.
    """
    network = scenario.network
    groups = groups_of(scenario, rows)
    chain, given = contacts(network, rows, scenario.sensor_of, groups), filter_of(scenario)
    plain = counted(scenario, rows)

    def every_path(given: Filter) -> Chain:
        return expected_optimum(given, chain, network.steps, len(rows.link))

    def bounds(given: Filter) -> Chain:
        return enclosed_optimum(given, chain, network.steps, len(rows.link))

    go = every_path
    try:
        if plain:
            check_size(number_of_paths(network))
        found = every_path(given)
    except TooManyPathsError:
        found, go = bounds(given), bounds
    if suspects(scenario, Noises(P0=scenario.P0[None])).any():
        found = found._replace(rounding=float(rounding(given, found, go).max()))
    return found._replace(paths=number_of_paths(network)) if plain else found, groups


def rounding(given: Filter, found: Chain, go: Callable[[Filter], Chain]) -> np.ndarray:
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


def groups_of(scenario: Scenario, rows: LinkRows) -> tuple[tuple[int, ...], ...]:
    """Return the agents that are alike, whose optimum is the same.

    Raises
    ------
    UsageError
        If the contact chain is not one for such a scenario.
    """
    require_one_state(scenario, "the optimum")
    require_independent_noise(scenario, "the optimum")
    network, kinds = scenario.network, scenario.sensor_of
    if _alike(scenario, rows):
        return (tuple(range(network.agents)),)
    return groups_alike(network, rows, kinds, relabellings(network, rows, kinds))


def filter_of(scenario: Scenario) -> Filter:
    """Return the filter of an agent that loses nothing."""
    return Filter(scenario.model, scenario.sensors, scenario.P0, scenario.correlation == "shared", scenario.error)


def counted(scenario: Scenario, rows: LinkRows) -> bool:
    """Whether `number_of_paths` is that of the scenario's chain."""
    return _alike(scenario, rows) and scenario.network.delay == (1.0,) and rows.bursts is None


def _alike(scenario: Scenario, rows: LinkRows) -> bool:
    return len(set(scenario.sensor_of)) == 1 and rows.uniform
