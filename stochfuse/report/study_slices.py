"""What of a study a figure shows: along which keys, the others fixed at which values, and the points that are left."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.report.studies import HOW, shortened, words_of
from stochfuse.studies.pareto import holds
from stochfuse.studies.plan import ERROR, Axis, Plan

if TYPE_CHECKING:
    from stochfuse.studies.files import Results

MOST_DRAWN = 5_000
"""Scattered points beyond which a figure shows only some."""
MOST_NAMED = 6
"""Values of a key that a message names."""
MARKED = ("method", "estimator", "network.architecture")
"""Keys by which points get markers, the first of them that varies."""
_MIX = 2654435769


@dataclass(frozen=True, eq=False)
class Slice:
    """The points of a study that a figure shows.

    Parameters
    ----------
    plan : the study.
    column : the value column.
    over : the one or two keys along which it is shown.
    fixed : the keys that are held, and at which value.
    also : keys that vary beyond those.
    step : the step, or None for each point's last.
    data : the points' values of column, keys, "point", "step", "method", "estimator" and "nature".
    one_in : which fraction of the points is there, one in so many.
    failed : points of the whole study without a value.
    """

    plan: Plan
    column: str
    over: tuple[Axis, ...]
    fixed: Mapping[str, Any]
    also: tuple[Axis, ...]
    step: int | None
    data: Mapping[str, np.ndarray]
    one_in: int
    failed: int

    @property
    def values(self) -> np.ndarray:
        """The values, (points,)."""
        return np.asarray(self.data[self.column], dtype=float)

    @property
    def marked(self) -> str | None:
        """The key by which scattered points get markers."""
        return next((name for name in MARKED if name in {axis.name for axis in self.also}), None)


def sliced(
    results: Results,
    keys: Sequence[str] | None = None,
    column: str | None = None,
    where: Mapping[str, Any] | None = None,
    step: int | None = None,
) -> Slice:
    """Choose what is shown, and read it.

    Parameters
    ----------
    results : the study's.
    keys : one or two keys to show values along; default: the first two that vary, but of two one whose values are
        words makes a line each.
    column : a value column; default: the first.
    where : values of other keys, as they are or as text.
    step : default: each point's last.

    Raises
    ------
    UsageError
        If a name or value is unknown, or a key of a grid varies that is neither shown nor fixed.
    NoAnswerError
        If no point has a value.
    """
    plan = results.plan
    column = _column(plan, column)
    fixed = fixed_values(plan, where or {})
    varying = [axis for axis in plan.axes if axis.name not in fixed and size_of(axis) > 1]
    over = _over(plan, varying, keys, fixed)
    also = tuple(axis for axis in varying if axis not in over)
    most = 1 if plan.kind == "grid" and len(over) == 1 else 0
    if plan.kind == "grid" and len(also) > most:
        raise UsageError("; ".join(map(_free, also)))
    one_in = 1 if plan.kind == "grid" else -(-plan.size // MOST_DRAWN)
    names = dict.fromkeys([column, *(a.name for a in plan.axes), "point", "step", *HOW])
    data = _read(results, tuple(names), fixed, step, one_in)
    if not len(data["point"]):
        if step is not None and results.rows:
            raise UsageError(f"step: expected a step that a point has, got {step}")
        raise NoAnswerError(f"no point has a value to draw: {results.failed} failed")
    return Slice(plan, column, over, fixed, also, step, data, one_in, results.failed)


def fixed_values(plan: Plan, where: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys' own values that are meant by given ones, perhaps texts.

    Raises
    ------
    UsageError
        If a key or a value is unknown.
    """
    return {name: _value(plan, name, given) for name, given in where.items()}


def distinct(axis: Axis) -> list[Any]:
    """Listed values of a key, each once: numbers by size, words in their order; none of a range."""
    values = list(dict.fromkeys(axis.values or ()))
    return values if is_text(axis) else sorted(values)


def is_text(axis: Axis) -> bool:
    """Whether a key's values are words, or matrices, rather than numbers."""
    return any(isinstance(value, str) for value in axis.values or ())


def places(axis: Axis, values: np.ndarray) -> np.ndarray:
    """Places of values among the key's listed ones, see `distinct`."""
    listed = distinct(axis)
    if is_text(axis):
        place = {value: i for i, value in enumerate(listed)}
        return np.array([place[value] for value in values.tolist()], dtype=int)
    return np.searchsorted(np.array(listed, dtype=float), np.asarray(values, dtype=float))


def size_of(axis: Axis) -> float:
    """How many values a key takes; a range takes infinitely many."""
    return np.inf if axis.values is None else len(set(axis.values))


def is_log(axis: Axis) -> bool:
    """Whether a key is drawn on a log axis: it is spread so, or lists three or more numbers > 0 over two decades."""
    if axis.scale == "log" or is_text(axis) or axis.values is None:
        return axis.scale == "log"
    values = distinct(axis)
    return len(values) > 2 and values[0] > 0 and values[-1] >= 100 * values[0]


def _column(plan: Plan, column: str | None) -> str:
    if column is not None and column not in plan.columns:
        raise UsageError(f"column: expected {' or '.join(plan.columns)}, got {column}")
    return column or next(c for c in plan.columns if not c.endswith(ERROR))


def _over(
    plan: Plan, varying: Sequence[Axis], keys: Sequence[str] | None, fixed: Mapping[str, Any]
) -> tuple[Axis, ...]:
    names = ", ".join(axis.name for axis in varying) or "none"
    if keys is None:
        if not varying:
            raise UsageError("--over: expected a key that varies, got none: all are fixed")
        numbers = [axis for axis in varying if not is_text(axis)]
        lines = plan.kind == "grid" and len(varying) == 2 and len(numbers) == 1
        return tuple(numbers if lines else varying[:2])
    if len(keys) not in (1, 2) or len(set(keys)) < len(keys):
        raise UsageError(f"--over: expected one or two different keys, got {', '.join(keys) or 'none'}")
    of = {axis.name: axis for axis in plan.axes}
    for name in keys:
        if name in fixed:
            raise UsageError(f"--over: expected keys that --where does not fix, got {name}")
        if name not in of or of[name] not in varying:
            raise UsageError(f"--over: expected keys that vary ({names}), got {name}")
    return tuple(of[name] for name in keys)


def _value(plan: Plan, name: str, given: Any) -> Any:
    """Return the axis' own value that is meant by a given one, perhaps a text."""
    axis = next((axis for axis in plan.axes if axis.name == name), None)
    if axis is None:
        known = ", ".join(axis.name for axis in plan.axes)
        raise UsageError(f"--where: expected a key that varies ({known}), got {name}")
    if axis.values is None:
        raise UsageError(f"--where: expected a key with listed values, got {name}, which varies continuously")
    for value in axis.values:
        if str(value) == str(given) or _meant(value) == _meant(given):
            return value
    raise UsageError(f"--where {name}: expected {_listed(axis, ' or ')}, got {given}")


def _meant(value: Any) -> Any:
    """A value as it is or as text: the same number or list, however it is written; else the text."""
    for read in (float, json.loads):
        try:
            return read(value)
        except (TypeError, ValueError):
            continue
    return str(value)


def _listed(axis: Axis, between: str = ", ") -> str:
    values = distinct(axis)
    words = [shortened(value, words_of(values)) for value in values[:MOST_NAMED]]
    if len(values) <= MOST_NAMED:
        return between.join(words)
    return f"{', '.join(words[:-1])}, … {shortened(values[-1], words_of(values))}"


def _free(axis: Axis) -> str:
    values = distinct(axis)
    return f"{axis.name} takes {len(values)} values ({_listed(axis)}): fix it with --where {axis.name}={values[0]}"


def _read(
    results: Results, names: Sequence[str], fixed: Mapping[str, Any], step: int | None, one_in: int
) -> dict[str, np.ndarray]:
    """Columns of the points where keys are fixed at their values, one point in so many."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for block in results.blocks(tuple(names), step):
        there = thinned(block["point"], one_in) & holds(fixed, block)
        for name in names:
            parts[name].append(np.asarray(block[name])[there])
    return {name: np.concatenate(arrays) if arrays else np.empty(0) for name, arrays in parts.items()}


def thinned(points: np.ndarray, one_in: int) -> np.ndarray:
    """Whether a point is among the one in so many that are drawn: by its number alone, in no pattern."""
    mixed = (np.asarray(points).astype(np.uint64) * np.uint64(_MIX)) % np.uint64(2**32)
    return mixed < np.uint64(2**32 // one_in)
