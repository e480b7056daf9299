"""What a study asks: which points, made from which scenario, predicted how, tabulated as what.

Points are numbered from 0.  In a grid the last key of [vary] runs fastest; a list takes the first, the second … value
of every key; a Latin hypercube (SciPy's) takes one value from each of as many equal parts of every key's range as there
are points.  Points are made in chunks, so that no study has to fit in memory; a Latin hypercube's numbers do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, Strict

from stochfuse.errors import UsageError
from stochfuse.kalman.checks import LARGEST, shown
from stochfuse.kalman.metrics import Metric
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.quantities import noun
from stochfuse.prediction.quantities import unit as unit_of
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.over import numbers_of, put
from stochfuse.scenario.registry import (
    CONTROLS,
    CRITERIA,
    ESTIMATORS,
    GENERAL,
    LFG,
    METHODS,
    MONTE_CARLO,
    NAIVE,
    OPTIMAL,
    SIMPLIFIED,
    SUMS,
)
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.schema import Number, StrictTable, problems_of

Words = str | list[str]
EXPECTED = {
    "scenario": "a preset's name, a file, or a table",
    "vary": "a table of keys with their values",
    "report.agent": "mean, worst, best or an agent's number",
    "report.quantity": "a quantity or a list of them",
    "report.metric": "a metric or a list of them",
}
"""What keys take that take several kinds of values."""
MOST_WHOLE = 2**53
"""Largest whole number: the floating-point numbers beyond have gaps."""
WHOLE = ("network.agents", "network.steps", "runs", "seed", "max_graphs")
"""Keys whose ranges have whole numbers only."""
MOST_VALUES = 1_000_000
"""Values that one key may take."""


class RangeTable(StrictTable):
    """Values from … to …: as many as `number`, or any of them in a Latin hypercube."""

    from_: Number = Field(alias="from")
    to: Number
    number: int | None = Field(None, ge=1, strict=True, description="how many, both ends included")
    scale: Literal["linear", "log"] = "linear"
    whole: bool = Field(False, strict=True, description="round to whole numbers")


class DesignTable(StrictTable):
    """How the varied values are combined into points."""

    kind: Literal["grid", "list", "latin-hypercube"] = Field(
        "grid", description="all combinations; the first, the second … values of all; or random ones, evenly spread"
    )
    points: int | None = Field(None, ge=1, strict=True, description="number of points of a Latin hypercube")
    seed: int | None = Field(None, ge=0, strict=True, description="of a Latin hypercube, default 1")


class PredictTable(StrictTable):
    """How every point is predicted; see `stochfuse predict --help`."""

    method: Literal[METHODS] | None = None  # type: ignore[valid-type]
    estimator: Literal[ESTIMATORS] | None = None  # type: ignore[valid-type]
    criterion: Literal[CRITERIA] | None = None  # type: ignore[valid-type]
    runs: int | None = Field(None, ge=2, strict=True)
    seed: int | None = Field(None, ge=0, strict=True)
    precision: float | str | None = Field(None, description="share of every value, 0.002 or 0.2%, in place of runs")
    control: Literal[CONTROLS] | None = None  # type: ignore[valid-type]
    max_graphs: int | None = Field(None, ge=1, strict=True)
    prune: bool | None = Field(None, strict=True)


class StudyReportTable(StrictTable):
    """What is tabulated of every point and step."""

    quantity: Words = Field("claimed", description="as --quantity takes them, and messages (nodes received)")
    metric: Words | None = Field(None, description="as --metric takes them; default: the scenario's, else trace")
    agent: Annotated[int, Strict(), Field(ge=1)] | Literal["mean", "worst", "best"] | None = Field(
        None, description="whose covariance; default: the scenario's, else the mean"
    )


class StudyFile(StrictTable):
    """A stochfuse study."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, title="stochfuse study", populate_by_name=False, serialize_by_alias=True
    )

    schema_: Literal["stochfuse.study/1"] = Field("stochfuse.study/1", alias="schema")
    description: str | None = None
    scenario: str | dict[str, Any] = Field("thesis-transient", description="preset, file (seen from here), or table")
    vary: dict[str, Any] = Field(
        description="what differs: lists of values, '0:1:0.25', or {from, to, number}, by their keys"
    )
    design: DesignTable = Field(default_factory=lambda: DesignTable.model_validate({}))
    predict: PredictTable = Field(default_factory=lambda: PredictTable.model_validate({}))
    report: StudyReportTable = Field(default_factory=lambda: StudyReportTable.model_validate({}))


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
    if isinstance(value, str) and ":" in value:
        try:
            value = numbers_of(path, value)
        except UsageError as error:
            check.note(path, *str(error).removeprefix(f"{path}: expected ").rsplit(", got ", 1))
            return None
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
        check.note(path, "a list of values, '0:1:0.25', or {from, to, number}", shown(value))
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


SETTINGS = ("method", "estimator", "criterion", "runs", "seed", "precision", "control", "max_graphs", "prune")
"""Names in [vary] that are no scenario keys."""
MESSAGES, NODES = "messages", "messages.nodes"
ERROR = ".standard_error"
CHUNK = {SIMPLIFIED: 16384, GENERAL: 256, NAIVE: 256, OPTIMAL: 256, MONTE_CARLO: 4}
"""Points that are evaluated, and written, together."""
LEAST_PARTS = 16
"""Chunks of a study, if it has as many points, of which single ones may take long."""
CHUNK_OF_PASTS = 16
"""The same for estimators whose numbers are worked point by point."""
MOST_NUMBERS = 4_000_000
"""Entries of the covariances of a chunk."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A checked study; make one with `load_study` or `plan_of`.

    Parameters
    ----------
    name : the file's name.
    kind : "grid", "list" or "latin-hypercube".
    axes : the varied keys.
    size : number of points.
    base : the scenario's mapping, before points change it.
    scenario_name : its name.
    settings : what holds for every point, by the names of `SETTINGS`.
    quantities, metrics, agent : what is tabulated.
    example : the scenario of a point that can be made, for names and units.
    seed : of a Latin hypercube.
    record : the whole as JSON takes it: what `plan_of` makes the same plan from.
    """

    name: str
    kind: str
    axes: tuple[Axis, ...]
    size: int
    base: Mapping[str, Any]
    scenario_name: str
    settings: Mapping[str, Any]
    quantities: tuple[str, ...]
    metrics: tuple[str, ...]
    agent: int | str
    example: Scenario
    seed: int
    record: Mapping[str, Any] = field(repr=False)

    @cached_property
    def labels(self) -> Mapping[str, str]:
        """For people: what every value column holds, with its unit."""
        found = {}
        for quantity in self.quantities:
            if quantity == MESSAGES:
                found[NODES] = "nodes received per agent and step"
                continue
            for m in map(self.metric, self.metrics):
                unit = unit_of(quantity, m)
                found[f"{quantity}.{m.name}"] = f"{quantity} {noun(quantity, m)}{f' [{unit}]' if unit else ''}"
                if MONTE_CARLO in self.methods:
                    found[f"{quantity}.{m.name}{ERROR}"] = f"standard error of {found[f'{quantity}.{m.name}']}"
        return found

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the value columns."""
        return tuple(self.labels)

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that points are predicted by."""
        return self._taken("method", (default_method(self.example, self._given),))

    @property
    def _given(self) -> set[str]:
        return {*self.settings, *(axis.name for axis in self.axes)}

    def _taken(self, name: str, default: tuple[Any, ...]) -> tuple[Any, ...]:
        """Values that a setting takes among the points."""
        for axis in self.axes:
            if axis.name == name:
                return axis.given or ()
        return (self.settings[name],) if name in self.settings else default

    @cached_property
    def chunk(self) -> int:
        """Points that are evaluated together, the same whoever does it: so results are the same to the last bit."""
        estimators = self._taken("estimator", (self.example.estimator or LFG,))
        most = min(CHUNK[method] for method in self.methods)
        if set(self.methods) & {GENERAL} and not set(estimators) <= set(SUMS):
            most = min(most, CHUNK_OF_PASTS)
        if set(self.methods) & {GENERAL, NAIVE, OPTIMAL}:
            # a few points can be hours of work, of which some should be kept, and which workers should share
            most = min(most, -(-self.size // LEAST_PARTS))
        steps = next((a for a in self.axes if a.name == "network.steps"), None)
        longest = self.example.network.steps
        if steps is not None and steps.kind in ("int", "float"):
            longest = int(max(steps.given or (steps.high,)))
        d = self.example.model.dimension
        return max(1, min(most, MOST_NUMBERS // max(1, longest * d * d)))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.size // self.chunk)

    def range_of(self, chunk: int) -> range:
        """Points of a chunk."""
        return range(chunk * self.chunk, min(self.size, (chunk + 1) * self.chunk))

    def codes(self, points: range) -> dict[str, np.ndarray]:
        """What every key is at some points: codes of listed values, or the values of a range; see `Axis.shown`."""
        number = np.arange(points.start, points.stop)
        if self.kind == "grid":
            sizes = tuple(len(axis.given or ()) for axis in self.axes)
            return {a.name: c for a, c in zip(self.axes, np.unravel_index(number, sizes), strict=True)}
        if self.kind == "list":
            return {axis.name: number for axis in self.axes}
        return {axis.name: axis.drawn(u) for axis, u in zip(self.axes, self._hypercube[number].T, strict=True)}

    @cached_property
    def _hypercube(self) -> np.ndarray:
        from scipy.stats import qmc

        return qmc.LatinHypercube(len(self.axes), rng=self.seed).random(self.size)

    def mapping(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the scenario's mapping with some keys' values in it.

        Raises
        ------
        ScenarioError
            If a path leads nowhere.
        """
        return put(self.base, values)

    def metric(self, name: str) -> Metric:
        """Return one of the metrics."""
        return metric_of(name, self.example.model)


def default_method(scenario: Scenario, given: set[str]) -> str:
    """Return the method where none is named: the scenario's, or the one that what is named belongs to."""
    if scenario.method is not None:
        return scenario.method
    return MONTE_CARLO if {"runs", "precision"} & given else GENERAL if "estimator" in given else SIMPLIFIED
