"""Many scenarios in one call, as the tests ask for them: link probabilities and noises of items of one scenario."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stochfuse.prediction import general, optimal, simplified
from stochfuse.prediction.method import Averaged, Settings
from stochfuse.scenario.network import LinkRows, restricted, uniform_rows
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.system import Items, Noises


class Covariances(NamedTuple):
    P: np.ndarray
    forms: tuple[str, ...]
    faults: dict[int, str]


def items_of(scenario: Scenario, link: Any, noises: Noises) -> Items:
    return Items(restricted(uniform_rows(link), scenario.network), noises)


def covariances(scenario: Scenario, link: Any, noises: Noises) -> Covariances:
    """(54) of every item, (items, steps, d, d)."""
    found = simplified.averaged(scenario.system, items_of(scenario, link, noises))
    return Covariances(found.moments.P[:, :, 0], found.forms, dict(found.faults))


def averaged(
    method: str, scenario: Scenario, link: Any, noises: Noises, *, errors: bool = False, **settings: Any
) -> Averaged:
    """Moments of every item by method general, naive or optimal."""
    items = items_of(scenario, link, noises)
    if method == "optimal":
        return optimal.averaged(scenario.system, items, Settings(estimator="optimal"), errors)
    how = Settings(**{"estimator": "naive" if method == "naive" else "local-fusion-graph", **settings})
    return general.averaged(scenario.system, items, how, errors)


def outcomes(
    scenario: Scenario, rows: LinkRows, estimator: str = "local-fusion-graph", **more: Any
) -> general.Outcomes:
    """All outcomes of a scenario."""
    return general.outcomes(scenario.system, rows, Settings(estimator=estimator), **more)
