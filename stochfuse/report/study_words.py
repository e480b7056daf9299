"""What a study and its columns are, in words, and its keys' values as tables, figures and JSON have them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from stochfuse.report.predictions import counted
from stochfuse.studies.plan import ERROR, NODES, Plan

EXPECTED = ("claimed", "actual", "optimal")
"""Quantities that are themselves expectations."""
HOW = ("method", "estimator", "nature")
"""Columns that say how a point was predicted."""
MOST_LISTED = 1000
"""Values of a key that JSON lists."""
LONGEST = 20
"""Characters of a value in a table, beyond which it is cut."""


def design(plan: Plan) -> str:
    """Which points there are, in words."""
    kinds = {"grid": "grid", "list": "list", "latin-hypercube": "Latin hypercube"}
    several = [f"{axis.name} ({'range' if axis.values is None else len(axis.values)})" for axis in plan.axes]
    return f"{kinds[plan.kind]} of {counted(plan.size, 'point')} over {', '.join(several)}"


def whose(plan: Plan) -> str:
    """Whose covariance it is, in words."""
    texts = {
        "mean": "covariance averaged over the agents",
        "worst": "the agent with the largest value",
        "best": "the agent with the smallest value",
    }
    return texts.get(str(plan.agent), f"agent {plan.agent}")


def spoken(plan: Plan, column: str) -> str:
    """What a value column holds, in words: 'expected claimed posterior variance of x [m²]'."""
    label, quantity = plan.labels[column], column.partition(".")[0]
    if column.endswith(ERROR) or not label.startswith(quantity):
        return label
    words = {
        "rms": "root-mean-square posterior error,",
        "consistency": "posterior consistency, actual / claimed (> 1: overconfident):",
        **{q: f"expected {q} posterior" for q in EXPECTED},
    }
    return words.get(quantity, f"posterior {quantity}") + label.removeprefix(quantity)


def load_label(plan: Plan) -> str:
    """What the load is, in words."""
    return f"{plan.labels[NODES]}, mean over all steps"


def failures(failed: int) -> str:
    """How many points failed, in words."""
    return f"{counted(failed, 'point')} failed" if failed else "none failed"


def shortened(value: Any, known: Sequence[str] = ()) -> str:
    """Return a key's value as tables and figures show it: long ones cut, with their place among those known."""
    text = f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
    if text[:1] == "[":
        text = re.sub(r"\.0\b|\s", "", text)
    if len(text) <= LONGEST:
        return text
    place = f"({known.index(str(value)) + 1})" if str(value) in known else ""
    return f"{text[: LONGEST - 1 - len(place)]}…{place}"


def words_of(values: Iterable[Any] | None) -> tuple[str, ...]:
    """Return listed values as text."""
    return () if values is None else tuple(map(str, values))


def plain(value: Any) -> Any:
    """Return a key's value as Python has it."""
    return value.item() if isinstance(value, np.generic) else value


def json_of(value: Any) -> Any:
    """Return a key's value as JSON has it: text that was made from a list is one again."""
    return json.loads(value) if isinstance(value, str) and value[:1] in ("[", "{") else plain(value)


def study_json(plan: Plan) -> dict[str, Any]:
    """Return what says which study it is."""
    axes = []
    for axis in plan.axes:
        values = axis.values
        listed = {} if values is None or len(values) > MOST_LISTED else {"values": list(map(json_of, values))}
        number = None if values is None else len(values)
        axes.append({"key": axis.name, "number": number, **listed, "scale": axis.scale})
    return {
        "study": plan.name,
        "scenario": plan.scenario_name,
        "design": plan.kind,
        "axes": axes,
        "quantities": list(plan.quantities),
        "metrics": list(plan.metrics),
        "agent": plan.agent,
    }
