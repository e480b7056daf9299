"""A prediction as table, records and JSON, with everything the reader must know beside the numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.errors import StochfuseError, UsageError
from stochfuse.metrics import Metric
from stochfuse.prediction import Prediction
from stochfuse.report.table import Table, number, to_csv

SCHEMA = "stochfuse.prediction/1"
METHOD_TITLES = {"simplified": "simplified formulation (54)"}
NATURES = {
    ("simplified", "approximate"): "approximate (mean field)",
}


@dataclass(frozen=True)
class View:
    """What of a prediction is shown.

    Parameters
    ----------
    prediction : the prediction.
    metric : the number shown.
    agent : "mean", "worst", "best" or a number from 1.
    baseline : the same prediction at link probability 0, to normalise by, or None.
    digits : significant digits in tables.
    """

    prediction: Prediction
    metric: Metric
    agent: int | str = "mean"
    baseline: Prediction | None = None
    digits: int = 5

    @property
    def unit(self) -> str:
        """Unit of the values; empty where there is none."""
        return "" if self.baseline else self.metric.unit

    def values(self) -> np.ndarray:
        """Values shown, shape (links, steps)."""
        values = self.prediction.values(self.metric, self.agent)
        return _finite(self._normalised(values, self.baseline and self.baseline.values(self.metric, self.agent)))

    def steady(self) -> np.ndarray | None:
        """Steady-state values, shape (links,), or None."""
        values = self.prediction.steady_values(self.metric, self.agent)
        if values is None:
            return None
        return _finite(self._normalised(values, self.baseline and self.baseline.steady_values(self.metric, self.agent)))

    def _normalised(self, values: np.ndarray, by: np.ndarray | None) -> np.ndarray:
        if by is None:
            return values
        if (by == 0).any():
            raise UsageError(f"{self.metric.label} is 0 at link probability 0 and cannot be normalised to it")
        return values / by

    @property
    def what(self) -> str:
        """One line: which covariance, of which states, in which unit."""
        p = self.prediction
        unit = f" [{self.unit}]" if self.unit else ", relative to link probability 0" if self.baseline else ""
        if not unit:
            unit = " [mixed units]" if self.metric.mixed else "" if any(p.scenario.model.units) else " [no unit given]"
        return f"Expected {p.quantity} {p.stage} covariance: {self.metric.label}{unit}"

    @property
    def whom(self) -> str:
        """One line: the scenario and whose covariance."""
        scenario = self.prediction.scenario
        n = scenario.network.agents
        return f"{scenario.name}: {n} agent{'s' * (n > 1)}, {scenario.network.architecture}; {self._of}"

    @property
    def _of(self) -> str:
        if self.prediction.alike:
            return "every agent alike" if len(self.prediction.group_of) > 1 else "alone"
        texts = {
            "mean": "covariance averaged over the agents",
            "worst": "the agent with the largest value",
            "best": "the agent with the smallest value",
        }
        return texts.get(str(self.agent), f"agent {self.agent}")

    @property
    def how(self) -> str:
        """One line: the method and how exact it is."""
        p = self.prediction
        return f"{METHOD_TITLES[p.method]}; {NATURES[p.method, p.nature]}"


def _finite(values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise StochfuseError("the prediction is not finite: the values grow beyond floating point")
    return values


def predict_table(view: View) -> Table:
    """Return rows of link probabilities (or cases) against columns of steps."""
    p = view.prediction
    values, steady = view.values(), view.steady()
    columns = [f"k={k}" for k in p.steps] + (["steady"] if steady is not None else [])
    uniform = p.cases is None and _uniform(p)
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        shown = [*values[i], *([] if steady is None else [steady[i]])]
        rows.append((*name, f"{µ:.6g}" if uniform else f"{µ:.4g}", *(number(v, view.digits) for v in shown)))
    mean = "µ" if uniform else "mean µ"
    keys = (mean,) if p.cases is None else ("links", mean)
    return Table((view.what, view.whom, view.how), keys, tuple(columns), tuple(rows))


def _uniform(p: Prediction) -> bool:
    return p.scenario.network.link is None or p.scenario.network.link.ndim == 0


def predict_csv(view: View) -> str:
    """One line per link probability and step, with everything that says what the value is."""
    p = view.prediction
    values, steady = view.values(), view.steady()
    metric = view.metric.name + ("/at-link-0" if view.baseline else "")
    labels = (p.method, p.quantity, p.stage, p.nature, metric, view.unit, view.agent)
    rows = []
    for i, µ in enumerate(p.link):
        case = "" if p.cases is None else p.cases[i]
        rows += [(*labels, case, float(µ), int(k), float(v)) for k, v in zip(p.steps, values[i], strict=True)]
        if steady is not None:
            rows.append((*labels, case, float(µ), "steady", float(steady[i])))
    headings = ("method", "quantity", "stage", "nature", "metric", "unit", "agent", "case", "link", "step", "value")
    return to_csv(headings, rows)


def predict_json(view: View) -> dict[str, Any]:
    """Return the object of schema stochfuse.prediction/1."""
    p = view.prediction
    model, steady = p.scenario.model, view.steady()
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "method": p.method,
        "quantity": p.quantity,
        "metric": view.metric.name,
        "link": p.link.tolist(),
        "steps": p.steps.tolist(),
        "values": view.values().tolist(),
        "scenario": p.scenario.to_mapping(),
        "meta": {
            "description": [view.what, view.whom, view.how],
            "stage": p.stage,
            "nature": p.nature,
            "unit": view.unit or None,
            "normalised": "to link probability 0" if view.baseline else None,
            "agent": view.agent,
            "states": list(model.states),
            "units": list(model.units),
            "forms": list(p.forms),
            "notes": list(p.notes),
        },
    }
    if p.cases is not None:
        result["cases"] = list(p.cases)
    if steady is not None and p.steady_bound is not None:
        worst = p.steady_bound.max(axis=1)
        result["steady"] = steady.tolist()
        result["steady_relative_bound"] = [float(b) if np.isfinite(b) else None for b in worst]
    return result
