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
    require_one_state(scenario, "the optimum")
    require_independent_noise(scenario, "the optimum")
    network, kinds = scenario.network, scenario.sensor_of
    alike = len(set(kinds)) == 1 and rows.uniform
    groups = (
        (tuple(range(network.agents)),)
        if alike
        else groups_alike(network, rows, kinds, relabellings(network, rows, kinds))
    )
    chain = contacts(network, rows, kinds, groups)
    given = Filter(scenario.model, scenario.sensors, scenario.P0, scenario.correlation == "shared", scenario.error)
    plain = alike and network.delay == (1.0,) and rows.bursts is None
    try:
        if plain:
            check_size(number_of_paths(network))
        found = expected_optimum(given, chain, network.steps, len(rows.link))
    except TooManyPathsError:
        found = enclosed_optimum(given, chain, network.steps, len(rows.link))
    return found._replace(paths=number_of_paths(network)) if plain else found, groups
