"""Methods side by side, and estimators side by side: the same scenario, several answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log2
from typing import Any

import numpy as np

from stochfuse.engines.events import events
from stochfuse.errors import NoAnswerError, TooManyError, UsageError
from stochfuse.kalman.metrics import Metric
from stochfuse.prediction.predict import choose, predict
from stochfuse.prediction.quantities import QUANTITIES
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.swept import Swept
from stochfuse.scenario.over import Over
from stochfuse.scenario.over import over as read_over
from stochfuse.scenario.registry import CHAIN, ESTIMATORS, GENERAL, METHODS, MONTE_CARLO, NAIVE, OPTIMAL, SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario

DEFAULT_METHODS = (GENERAL, SIMPLIFIED, NAIVE, MONTE_CARLO)
EXACT_FIRST = (GENERAL, OPTIMAL, SIMPLIFIED, NAIVE, MONTE_CARLO)
"""Which method the others are compared with, if it is not said."""


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """Predictions of several methods.

    Parameters
    ----------
    predictions : one per method, the reference first.
    """

    predictions: tuple[Prediction | Swept, ...]

    @property
    def reference(self) -> Prediction | Swept:
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


@of_scenario
def compare(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | None = None,
    methods: Sequence[str] = DEFAULT_METHODS,
    reference: str | None = None,
    quantity: str = "claimed",
    *,
    over: Mapping[str, Any] | Over | None = None,
    **settings: Any,
) -> Comparison:
    """Predict by several methods.

    Parameters
    ----------
    scenario, link : as for `predict`.
    methods : at least one of `METHODS`.
    reference : the method that the others are compared with; default: general if it is among them, else the most exact.
    quantity : what is compared, as for `predict`.
    over : values of one or two numbers of the scenario by their paths, as for `predict`: the rows.
    **settings : as for `predict`.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        If a method is unknown or named twice, or the request does not fit the scenario.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.compare("thesis-transient", [0.5], ["simplified", "optimal"])
    >>> found.differences()[:, 0, -1].round(3)
    array([0.   , 1.339])
    """
    if not methods:
        raise UsageError(f"methods: expected at least one of {', '.join(METHODS)}, got none")
    for method in methods:
        choose("methods", method, METHODS)
    methods = [OPTIMAL if method == CHAIN else method for method in methods]
    reference = OPTIMAL if reference == CHAIN else reference
    if len(set(methods)) < len(methods):
        raise UsageError(f"methods: expected different ones, got {', '.join(methods)}")
    if quantity == OPTIMAL and len(methods) > 1:
        raise UsageError("quantity: expected one that depends on the method; the optimum is the same for all")
    if reference is None:
        reference = min(methods, key=EXACT_FIRST.index)
    elif reference not in methods:
        raise UsageError(f"reference: expected one of the methods compared ({', '.join(methods)}), got '{reference}'")
    ordered = [reference, *(m for m in methods if m != reference)]
    if over is not None:
        settings["over"] = read_over(scenario, over)
    settings = {"quantity": quantity, **settings}
    return Comparison(tuple(_predict(scenario, link, method, settings) for method in ordered))


def _predict(scenario: Scenario, link: Any, method: str, settings: dict[str, Any]) -> Prediction | Swept:
    try:
        return predict(scenario, link, method, **settings)
    except UsageError as error:
        raise UsageError(f"{method} cannot be compared here, leave it out of the methods: {error}") from None


EASY, EASY_EXCHANGE = 2000, 12
"""Graphs, and binary logarithm of the outcomes of one exchange, up to which outcomes are enumerated unasked."""
SIDE_BY_SIDE = ("claimed", "actual", "consistency")


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorComparison(Result):
    """What several estimators claim and achieve in one scenario.

    Parameters
    ----------
    predictions : one per estimator, each with the moments of its actual error.
    left_out : estimators that were not asked for by name and cannot be had here, with the reason.
    """

    predictions: tuple[Prediction | Swept, ...]
    left_out: tuple[str, ...] = ()

    @property
    def estimators(self) -> tuple[str, ...]:
        """Names of the estimators."""
        return tuple(p.estimator for p in self.predictions)

    def values(self, quantity: str, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a quantity's metric, shape (estimators, links, steps)."""
        return np.stack([p.shown_as(quantity).values(of, agent) for p in self.predictions])


@of_scenario
def compare_estimators(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | None = None,
    estimators: Sequence[str] | None = None,
    method: str | None = None,
    *,
    quantities: Sequence[str] = SIDE_BY_SIDE,
    over: Mapping[str, Any] | Over | None = None,
    **settings: Any,
) -> EstimatorComparison:
    """Predict what several estimators claim and what their errors truly are, on the same lossy network.

    Parameters
    ----------
    scenario, link : as for `predict`.
    estimators : names out of `stochfuse.prediction.predict.ESTIMATORS`; default: all that the scenario takes.
    method : "general" or "monte-carlo"; default: exact where up to `EASY` graphs (or `max_graphs`) have to be carried
        and no runs are asked for, else sampled, with the same arrivals for all estimators.
    over : values of one or two numbers of the scenario by their paths, as for `predict`: the rows.
    quantities : what is to be compared; bias and rms make a note of an initial error that is not known.
    **settings : as for `predict`.

    Raises
    ------
    UsageError
        If an estimator is unknown, named twice, or cannot be had for the scenario; or if none can.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.compare_estimators(sf.load_scenario("thesis-transient", steps=2), [0.5], ["naive", "split-ci"])
    >>> [round(float(ratio[0, -1]), 3) for ratio in found.values("consistency")]
    [1.272, 0.75]
    """
    for name in estimators or ():
        choose("estimator", name, ESTIMATORS)
    if len(set(estimators or ())) < len(estimators or ()):
        raise UsageError(f"estimator: expected different ones, got {', '.join(estimators or ())}")
    if method is not None:
        choose("methods", method, (GENERAL, MONTE_CARLO))
    for quantity in quantities:
        choose("quantity", quantity, tuple(q for q in QUANTITIES if q != OPTIMAL))
    hardest = max(quantities, key=("claimed", "actual", "consistency", "bias", "rms").index)
    if over is not None:
        settings["over"] = read_over(scenario, over)
    found: list[Prediction | Swept] = []
    left_out: dict[str, list[str]] = {}
    for name in estimators or ESTIMATORS:
        try:
            found.append(_estimated(scenario, link, name, method, hardest, settings).shown_as(quantities[0]))
        except (UsageError, NoAnswerError) as error:
            reason = str(error).removeprefix(f"estimator {name}: ")
            if estimators:
                raise type(error)(f"estimator {name}: {reason}") from None
            left_out.setdefault(reason, []).append(name)
    if not found:
        raise UsageError("no estimator can be had here:\n  " + "\n  ".join(left_out))
    return EstimatorComparison(tuple(found), tuple(f"{', '.join(n)}: {reason}" for reason, n in left_out.items()))


def _estimated(
    scenario: Scenario, link: Any, estimator: str, method: str | None, quantity: str, settings: dict[str, Any]
) -> Prediction | Swept:
    if method is not None:
        return predict(scenario, link, method, quantity, estimator=estimator, **settings)
    easy = {"max_graphs": EASY, **settings}
    every = settings["over"].scenarios if "over" in settings else (scenario,)
    bits = max(exchange(some, link) for some in every)
    if {"runs", "seed", "workers"} & set(settings) or bits > EASY_EXCHANGE:
        return predict(scenario, link, MONTE_CARLO, quantity, estimator=estimator, **settings)
    try:
        return predict(scenario, link, GENERAL, quantity, estimator=estimator, **easy)
    except TooManyError:
        return predict(scenario, link, MONTE_CARLO, quantity, estimator=estimator, **settings)


def exchange(scenario: Scenario, link: Any) -> float:
    """Binary logarithm of the outcomes of one exchange."""
    network = scenario.network
    return len(events(network, link_rows(scenario, link), 1)) * log2(len(network.delay) + 1)
