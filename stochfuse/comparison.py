"""Methods side by side: the same quantity of one scenario, and what each differs from the reference by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.methods import METHODS, choose, predict
from stochfuse.metrics import Metric
from stochfuse.prediction import Prediction
from stochfuse.scenario import Scenario

DEFAULT_METHODS = ("general", "simplified", "naive", "monte-carlo")
EXACT_FIRST = ("general", "optimal", "simplified", "naive", "monte-carlo")
"""Which method the others are compared with, if it is not said."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Predictions of several methods.

    Parameters
    ----------
    predictions : one per method, the reference first.
    """

    predictions: tuple[Prediction, ...]

    @property
    def reference(self) -> Prediction:
        """Return what the others are compared with."""
        return self.predictions[0]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods, the reference first."""
        return tuple(p.method for p in self.predictions)

    def values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a metric, shape (methods, links, steps)."""
        return np.stack([p.values(of, agent) for p in self.predictions])

    def differences(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return each method's metric less the reference's, shape (methods, links, steps)."""
        values = self.values(of, agent)
        return values - values[0]


def compare(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | None = None,
    methods: Sequence[str] = DEFAULT_METHODS,
    reference: str | None = None,
    quantity: str = "claimed",
    **settings: Any,
) -> Comparison:
    """Predict by several methods.

    Parameters
    ----------
    scenario, link : as for `predict`.
    methods : at least one of `METHODS`.
    reference : the method that the others are compared with; default: general if it is among them, else the most exact.
    quantity : what is compared, as for `predict`.
    **settings : as for `predict`.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        If a method is unknown or named twice, or the request does not fit the scenario.
    """
    if not methods:
        raise UsageError(f"methods: expected at least one of {', '.join(METHODS)}, got none")
    for method in methods:
        choose("methods", method, METHODS)
    if len(set(methods)) < len(methods):
        raise UsageError(f"methods: expected different ones, got {', '.join(methods)}")
    if quantity == "optimal" and len(methods) > 1:
        raise UsageError("quantity: expected one that depends on the method; the optimum is the same for all")
    if reference is None:
        reference = min(methods, key=EXACT_FIRST.index)
    elif reference not in methods:
        raise UsageError(f"reference: expected one of the methods compared ({', '.join(methods)}), got '{reference}'")
    ordered = [reference, *(m for m in methods if m != reference)]
    settings = {"quantity": quantity, **settings}
    return Comparison(tuple(_predict(scenario, link, method, settings) for method in ordered))


def _predict(scenario: Scenario, link: Any, method: str, settings: dict[str, Any]) -> Prediction:
    try:
        return predict(scenario, link, method, **settings)
    except UsageError as error:
        raise UsageError(f"{method} cannot be compared here, leave it out of the methods: {error}") from None
