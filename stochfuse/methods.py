"""The methods by the names that users ask for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stochfuse import simplified
from stochfuse.errors import UsageError
from stochfuse.prediction import Prediction
from stochfuse.scenario import Scenario, link_rows

METHODS = ("simplified",)
QUANTITIES = ("claimed",)


def predict(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | None = None,
    method: str = "simplified",
    quantity: str = "claimed",
    *,
    steady: bool = False,
) -> Prediction:
    """Predict the expected fused covariance against link probability.

    Parameters
    ----------
    scenario : from `load_scenario`.
    link : link probabilities, one row of the result each; an array of shape (rows, agents, agents) gives a matrix µ_ij
        (receiver, sender) per row.  Default: the scenario's cases, else its link, else 0, 0.25, 0.5, 0.75 and 1.
    method : "simplified": thesis (50)–(54), approximate (mean field).
    quantity : "claimed": the covariance that the fusion rule itself reports.
    steady : also solve for the steady state.

    Returns
    -------
    Prediction

    Raises
    ------
    UsageError
        If the request does not fit the scenario.
    NoAnswerError
        If a steady state is asked for and there is none.
    """
    _choose("method", method, METHODS)
    _choose("quantity", quantity, QUANTITIES)
    rows = link_rows(scenario, link)
    result = simplified.covariances(scenario, rows)
    prediction = Prediction(
        scenario=scenario,
        method=method,
        quantity=quantity,
        stage="posterior",
        nature="approximate",
        link=rows.means(scenario.network),
        cases=rows.names,
        steps=np.arange(1, scenario.network.steps + 1),
        by_group=result.P,
        group_of=result.group_of,
        forms=result.forms,
        notes=tuple(simplified.departures(scenario, rows)),
    )
    if not steady:
        return prediction
    from stochfuse.questions import steady_state

    fixed = steady_state(scenario, rows)
    return prediction.with_steady(fixed.P, fixed.bound)


def _choose(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise UsageError(f"{name}: expected one of {', '.join(choices)}, got '{value}'")
