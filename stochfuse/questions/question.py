"""A number that depends on the links, as questions asked backwards take it: which one, when, whose, by which method.

Smaller is better in all of them: of a bias, which has a sign, the size is meant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np

from stochfuse.engines.contact_chain import MOST_STATES
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Metric, metric
from stochfuse.prediction.predict import choose
from stochfuse.prediction.predict import predict as predict_
from stochfuse.prediction.quantities import noun
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.swept import Swept
from stochfuse.scenario.over import Over
from stochfuse.scenario.registry import CHAIN, METHODS, MONTE_CARLO, NO_CONTROL, OPTIMAL, SIMPLIFIED
from stochfuse.scenario.scenario import Scenario

SLACK = 8 * np.finfo(float).eps
"""Relative rounding that is allowed for, so that a value that was printed in full is a target that can be met."""
MONOTONE = {(SIMPLIFIED, "claimed"), (SIMPLIFIED, "actual"), (OPTIMAL, "claimed"), (OPTIMAL, OPTIMAL)}
"""Methods and quantities whose numbers are proved never to rise with µ, see `stochfuse.questions.least_link`."""


@dataclass(frozen=True, eq=False)
class Question:
    """A number that depends on the links: make one with `question`.

    Parameters
    ----------
    scenario : what is given, up to the step asked about.
    step : the step, or None for the steady state.
    metric, agent, method, quantity, settings : as in `stochfuse.predict` and `Prediction.values`.
    """

    scenario: Scenario
    step: int | None
    metric: Metric
    agent: int | str
    method: str
    quantity: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    def predict(self, link: Any) -> Prediction:
        """Return the prediction at some links."""
        found = predict_(self.scenario, link, self.method, self.quantity, **self._more)
        _not_sampled([found])
        return found

    def sweep(self, link: Any, over: Over) -> Swept:
        """Return the predictions of what was swept at some links."""
        found = predict_(self.scenario, link, self.method, self.quantity, over=over, **self._more)
        _not_sampled(found.parts)
        return found

    @property
    def _more(self) -> dict[str, Any]:
        # two runs tell that it would be a sample
        few = {"runs": 2, "workers": 1, "control": NO_CONTROL} if self.method == OPTIMAL else {}
        return {**few, **self.settings} | ({"steady": True} if self.step is None else {})

    def read(self, prediction: Prediction, agent: int | str | None = None) -> np.ndarray:
        """Return the number asked for in every row of a prediction, shape (links,)."""
        whose = self.agent if agent is None else agent
        if self.step is None:
            steady = prediction.steady_values(self.metric, whose)
            return np.empty(0) if steady is None else steady
        return self.by_step(prediction, whose)[:, -1]

    def by_step(self, prediction: Prediction, agent: int | str | None = None) -> np.ndarray:
        """Return the number at every step of a prediction, shape (links, steps)."""
        values = prediction.values(self.metric, self.agent if agent is None else agent)
        return np.abs(values) if self.quantity == "bias" else values

    def at(self, link: Any) -> np.ndarray:
        """Return the number asked for at some links, shape (links,)."""
        return self.read(self.predict(link))

    @property
    def when(self) -> str:
        """At a step, or in the steady state, in words."""
        return "steady state" if self.step is None else f"step {self.step}"

    @property
    def monotone(self) -> bool:
        """Whether the number is proved never to rise with µ, nor with the number of agents."""
        return (self.method, self.quantity) in MONOTONE


def _not_sampled(predictions: Sequence[Prediction]) -> None:
    """Raise UsageError where the optimum is sampled, of agents of which a chain would have too many states."""
    found = [*predictions, *(p.limit.prediction for p in predictions if p.limit is not None)]
    if any(p.sampled is not None for p in found):
        raise UsageError(
            "method optimal: the optimum of so many unlike agents or links is sampled, and what is asked backwards of "
            f"it would follow the sample's errors: expected a contact chain of at most {MOST_STATES} states, or method "
            "simplified"
        )


def question(
    scenario: Scenario,
    *,
    step: int | None = None,
    steady: bool = False,
    method: str = SIMPLIFIED,
    quantity: str = "claimed",
    of: str | None = None,
    agent: int | str = "mean",
    one_link: bool = True,
    **settings: Any,
) -> Question:
    """Check and return what is asked about.

    Parameters
    ----------
    scenario : from `load_scenario`.
    step : the step asked about; default: the last.
    steady : ask about the steady state instead (of the simplified formulation, or of the optimum).
    method, quantity, **settings : see `stochfuse.predict`; every method but "monte-carlo".
    of : name of the metric; default: the scenario's, else trace.
    agent : "mean", "worst", "best" or a number from 1.
    one_link : whether the question is about one probability a link, so that links must have no memory.

    Raises
    ------
    UsageError
        If it does not fit the scenario or the method.
    """
    choose("method", method, METHODS)
    last = scenario.network.steps
    method = OPTIMAL if method == CHAIN else method
    if method == MONTE_CARLO:
        raise UsageError(
            "method: expected simplified, general, optimal or naive, got monte-carlo: its values are sampled, and what "
            "is asked backwards of them would follow the sample's errors"
        )
    if steady and step is not None:
        raise UsageError(f"step: expected none with the steady state, got {step}")
    if step is not None and not 1 <= step <= last:
        raise UsageError(f"step: expected a number from 1 to {last} (network.steps), got {step}")
    bursts = scenario.network.burst, *scenario.network.case_bursts
    if one_link and any(burst is not None for burst in bursts):
        raise UsageError(
            "network.burst: expected links without memory, since the question is about one probability a link"
        )
    chosen = metric(of or scenario.metric or "trace", scenario.model)
    at = None if steady else step or last
    if quantity == OPTIMAL or (method, quantity) == (OPTIMAL, "claimed"):
        method = quantity = OPTIMAL  # the optimum is the same whatever the method
    if steady and method not in (SIMPLIFIED, OPTIMAL):
        raise UsageError(
            f"steady: expected method {SIMPLIFIED} or {OPTIMAL}, whose steady states are enclosed, got {method}, whose "
            "steady states are sampled: predict --steady shows them"
        )
    return Question(scenario.until(at or 1), at, chosen, agent, method, quantity, settings)


def named(asked: Question) -> str:
    """Name the number asked about, in words."""
    words = {"bias": "size of the bias,", "rms": "RMS error,", "consistency": "actual / claimed,"}
    return f"{words.get(asked.quantity, asked.quantity)} {noun(asked.quantity, asked.metric)}"


def described(asked: Question) -> str:
    """Name the number asked about, when and by which method, in words."""
    when = f"in the {asked.when}" if asked.step is None else f"at {asked.when}"
    return f"{named(asked)} {when} ({asked.method})"


def relative_bound(prediction: Prediction, row: int) -> float:
    """Relative bound on a row's value at the last step, or in the steady state if there is one; 0 if none is given."""
    if prediction.steady_bound is not None:
        return float(prediction.steady_bound[row].max())
    return float(prediction.meta["relative_bound"][row][-1]) if "relative_bound" in prediction.meta else 0.0


def check_target(target: float) -> None:
    """Raise UsageError if a target is none."""
    if not isinstance(target, Real) or not (isfinite(target) and target >= 0):
        got = f"{target:g}" if isinstance(target, Real) else repr(target)
        raise UsageError(f"target: expected a finite number of at least 0, got {got}")


def require_like_links(scenario: Scenario) -> None:
    """Raise UsageError if links differ in a scenario, so that there is no one µ to be asked for."""
    network = scenario.network
    if network.cases or (network.link is not None and network.link.ndim):
        what = "network.case" if network.cases else "link probabilities that differ in network.link"
        raise UsageError(
            f"target: expected a scenario with one link probability for all links and steps, or none, got {what}; "
            "ask --over network.scale=0:1 for the factor on all of them, --sensitivity which link to improve, or take "
            "the links out of the scenario"
        )
