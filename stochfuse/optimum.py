"""The exact expected optimum of a scenario, theory section 6: what no fusion rule can beat."""

from __future__ import annotations

from stochfuse.engines.contact_chain import Chain, Filter, TooManyPathsError, check_size, expected_optimum
from stochfuse.engines.contacts import contacts, number_of_paths
from stochfuse.engines.enclosure import enclosed_optimum
from stochfuse.events import relabellings
from stochfuse.general import groups_alike
from stochfuse.network import LinkRows
from stochfuse.scenario import Scenario, require_independent_noise, require_one_state


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
    try:
        if plain:
            check_size(number_of_paths(network))
        found = expected_optimum(given, chain, network.steps, len(rows.link))
    except TooManyPathsError:
        found = enclosed_optimum(given, chain, network.steps, len(rows.link))
    return found._replace(paths=number_of_paths(network)) if plain else found, groups


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
