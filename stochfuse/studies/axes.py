"""What a study varies: listed values of a key, or a range of a Latin hypercube."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.checks import LARGEST, Checker, shown
from stochfuse.studies.schema import RangeTable
from stochfuse.tables.schema import problems_of

MOST_WHOLE = 2**53
"""Largest whole number: the floating-point numbers beyond have gaps."""
WHOLE = ("network.agents", "network.steps", "runs", "seed", "max_graphs")
"""Keys whose ranges have whole numbers only."""
MOST_VALUES = 1_000_000
"""Values that one key may take."""


@dataclass(frozen=True, eq=False)
class Axis:
    """One varied key.

    Parameters
    ----------
    name : path of a scenario key, "network.link" or "agent[2].R", or the name of a setting, "method".
    values : the listed values in order, or None for a range that a Latin hypercube draws from.
    low, high : ends of the range.
    scale : "linear" or "log".
    whole : whether the range has whole numbers only.
    """

    name: str
    given: tuple[Any, ...] | None = field(repr=False)
    low: float = 0.0
    high: float = 1.0
    scale: str = "linear"
    whole: bool = False

    @property
    def values(self) -> tuple[Any, ...] | None:
        """Listed values as tables show them: numbers and words as they are, others as JSON."""
        return None if self.given is None else tuple(self.column.tolist())

    @property
    def kind(self) -> str:
        """What a column of values holds: "int", "float" or "text"."""
        if self.given is None:
            return "int" if self.whole else "float"
        if all(_is_number(v) and isinstance(v, int) for v in self.given):
            return "int"
        return "float" if all(map(_is_number, self.given)) else "text"

    @cached_property
    def column(self) -> np.ndarray:
        """Listed values as an array, of numbers or of objects that are text."""
        given = () if self.given is None else self.given
        if self.kind == "text":
            return np.array([v if isinstance(v, str) else json.dumps(v) for v in given], dtype=object)
        return np.array(given, dtype=np.int64 if self.kind == "int" else float)

    def drawn(self, u: np.ndarray) -> np.ndarray:
        """Codes of listed values, or values of the range, from numbers that are uniform in [0, 1)."""
        if self.given is not None:
            return np.minimum((u * len(self.given)).astype(np.int64), len(self.given) - 1)
        if self.scale == "log":
            values = np.exp(np.log(self.low) + u * (np.log(self.high) - np.log(self.low)))
        elif self.whole:
            return np.minimum(np.floor(self.low + u * (self.high - self.low + 1)), self.high).astype(np.int64)
        else:
            values = self.low + u * (self.high - self.low)
        return np.rint(values).astype(np.int64) if self.whole else values

    def shown(self, codes: np.ndarray) -> np.ndarray:
        """Values of points, as tables show them, from their codes (a range's codes are its values)."""
        return codes if self.given is None else self.column[codes]

    def value(self, code: Any) -> Any:
        """Return one value as a scenario takes it."""
        if self.given is not None:
            return self.given[code]
        return int(code) if self.whole else float(code)


def read_axes(check: Checker, vary: Mapping[str, Any], kind: str) -> tuple[Axis, ...]:
    """Read [vary]; problems are noted in the checker."""
    found = [_axis(check, name, value, kind) for name, value in _flattened(vary)]
    names = [axis.name for axis in found if axis is not None]
    for name in sorted({name for name in names if names.count(name) > 1}):
        check.note(f"vary.{name}", "each key once", "it twice")
    if not found and not check.problems:
        check.note("vary", "at least one key with its values", "nothing")
    return tuple(axis for axis in found if axis is not None)


def _flattened(vary: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Keys by their paths: `"model.R" = …` and `model.R = …` are the same."""
    found = []
    for key, value in vary.items():
        path = f"{prefix}.{key}" if prefix else key
        if isinstance(value, dict) and not {"from", "to", "number"} & set(value) and value:
            found += _flattened(value, path)
        else:
            found.append((path, value))
    return found


def _axis(check: Checker, name: str, value: Any, kind: str) -> Axis | None:
    path = f"vary.{name}"
    if isinstance(value, list):
        if not value:
            check.note(path, "at least one value", "an empty list")
            return None
        if len(value) > MOST_VALUES:
            check.note(path, f"at most {MOST_VALUES} values", str(len(value)))
            return None
        wrong = [v for v in value if _is_number(v) and not abs(v) <= (MOST_WHOLE if isinstance(v, int) else LARGEST)]
        if wrong:
            check.note(path, f"numbers of at most {LARGEST:g} in size, whole ones of {MOST_WHOLE}", shown(wrong[0]))
            return None
        return Axis(name, tuple(value))
    if not isinstance(value, dict):
        check.note(path, "a list of values, or {from, to, number}", shown(value))
        return None
    problems = problems_of(RangeTable, value)
    for problem in problems:
        check.note(f"{path}.{problem.path}", problem.expected, problem.got)
    return None if problems else _range(check, name, RangeTable.model_validate(value), kind)


def _range(check: Checker, name: str, given: RangeTable, kind: str) -> Axis | None:
    given = given.model_copy(update={"whole": given.whole or name in WHOLE})
    path, known = f"vary.{name}", len(check.problems)
    low, high = given.from_, given.to
    for key, end in (("from", low), ("to", high)):
        most = MOST_WHOLE if given.whole else LARGEST
        if not abs(end) <= most:
            check.note(f"{path}.{key}", f"a number of at most {most:g} in size", shown(end))
        elif given.scale == "log" and end <= 0:
            check.note(f"{path}.{key}", "a number above 0 on a log scale", f"{end:g}")
        elif given.whole and end != int(end):
            check.note(f"{path}.{key}", "a whole number, since whole = true", f"{end:g}")
    if len(check.problems) == known and high < low:
        check.note(f"{path}.to", f"at least from, {low:g}", f"{high:g}")
    if kind != "latin-hypercube":
        if given.number is None:
            check.note(f"{path}.number", "how many values", "nothing")
        elif given.number > MOST_VALUES:
            check.note(f"{path}.number", f"at most {MOST_VALUES}", str(given.number))
    elif given.number is not None:
        check.note(f"{path}.number", "nothing, since a Latin hypercube draws from the whole range", str(given.number))
    if len(check.problems) > known:
        return None
    if given.number is None:
        return Axis(name, None, float(low), float(high), given.scale, given.whole)
    return Axis(name, _spread(float(low), float(high), given), scale=given.scale)


def _spread(low: float, high: float, given: RangeTable) -> tuple[float | int, ...]:
    number = given.number or 1
    values = np.geomspace(low, high, number) if given.scale == "log" else np.linspace(low, high, number)
    if given.whole:
        return tuple(np.unique(np.rint(values).astype(np.int64)).tolist())
    # twelve digits, so that 0.3 is called 0.3
    return tuple(float(f"{value:.12g}") for value in values)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
