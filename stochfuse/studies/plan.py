"""What a study asks: which points, made from which scenario, predicted how, tabulated as what.

Points are numbered from 0.  In a grid the last key of [vary] runs fastest; a list takes the first, the second … value
of every key; a Latin hypercube (SciPy's) takes one value from each of as many equal parts of every key's range as there
are points.  Points are made in chunks, so that no study has to fit in memory; a Latin hypercube's numbers do.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.checks import Checker, shown
from stochfuse.errors import Problem, ScenarioError, StochfuseError, UsageError
from stochfuse.metrics import Metric
from stochfuse.metrics import metric as metric_of
from stochfuse.names import CRITERIA, ESTIMATORS, METHODS
from stochfuse.quantities import QUANTITIES, noun
from stochfuse.quantities import check as check_quantity
from stochfuse.quantities import unit as unit_of
from stochfuse.rules import SUMS
from stochfuse.scenario import Scenario, is_preset, parse, read_file, read_text
from stochfuse.studies.axes import Axis, read_axes
from stochfuse.studies.schema import EXPECTED, StudyFile
from stochfuse.tables.schema import problems_of, structure_problems

SCHEMA = "stochfuse.study/1"
SETTINGS = ("method", "estimator", "criterion", "runs", "seed", "max_graphs", "prune")
"""Names in [vary] that are no scenario keys."""
_WORDS = {"method": METHODS, "estimator": ESTIMATORS, "criterion": CRITERIA}
_KEY = "a key of the scenario such as network.link or agent[2].R (of the second agent table)"
_LEAST = {"runs": 2, "seed": 0, "max_graphs": 1}
_PATH = re.compile(r"[^.\[\]]+(\[[1-9][0-9]{0,8}\])?(\.[^.\[\]]+(\[[1-9][0-9]{0,8}\])?)*")
MESSAGES, NODES = "messages", "messages.nodes"
ERROR = ".standard_error"
MOST_POINTS = 1_000_000_000
MOST_DRAWN = 20_000_000
"""Numbers of a Latin hypercube, points times keys."""
CHUNK = {"simplified": 16384, "general": 256, "naive": 256, "optimal": 256, "monte-carlo": 4}
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
                if "monte-carlo" in self.methods:
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
        estimators = self._taken("estimator", (self.example.estimator or "local-fusion-graph",))
        most = min(CHUNK[method] for method in self.methods)
        if set(self.methods) & {"general"} and not set(estimators) <= set(SUMS):
            most = min(most, CHUNK_OF_PASTS)
        if set(self.methods) & {"general", "naive", "optimal"}:
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
    return "monte-carlo" if "runs" in given else "general" if "estimator" in given else "simplified"


def put(mapping: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario's mapping with values at paths, `network.link` or `agent[2].R`, less what they replace."""
    found = json.loads(json.dumps(mapping))
    for path, value in values.items():
        *tables, last = _parts(path)
        place: Any = found
        for part in tables:
            place = _entered(path, place, part)
        if not isinstance(place, dict) or not isinstance(last, str):
            raise _nowhere(path)
        place[last] = value
        # a link probability takes the place of everything else that says how likely messages are
        if path == "network.link":
            for other in ("case", "burst"):
                place.pop(other, None)
        elif path.startswith("network.burst"):
            found["network"].pop("link", None)
            found["network"].pop("case", None)
    return found


def _parts(path: str) -> list[str | int]:
    return [key or int(place) - 1 for place, key in re.findall(r"\[([0-9]+)\]|([^.\[\]]+)", path)]


def _entered(path: str, place: Any, part: str | int) -> Any:
    if isinstance(part, str) and isinstance(place, dict):
        return place.setdefault(part, {})
    if isinstance(part, int) and isinstance(place, list) and 0 <= part < len(place):
        return place[part]
    raise _nowhere(path)


def _nowhere(path: str) -> ScenarioError:
    return ScenarioError("study", [Problem(f"vary.{path}", _KEY, shown(path))])


def software() -> dict[str, str]:
    """Versions on which the last bits of results depend."""
    import scipy

    return {"stochfuse": __version__, "numpy": np.__version__, "scipy": scipy.__version__}


def load_study(source: str | Path | Mapping[str, Any]) -> Plan:
    """Read a study.

    Parameters
    ----------
    source : a TOML or JSON file's path, "-" for standard input, or a mapping with a study file's keys.

    Raises
    ------
    ScenarioError
        If the file is missing or malformed, or naming every offending key.
    UsageError
        If what is to be tabulated does not fit the scenario.
    """
    if isinstance(source, Mapping):
        name, mapping, folder = "study", dict(source), Path()
    else:
        name, text = read_file(source)
        mapping, folder = parse(name, text, "`stochfuse scenario schema --study`"), Path(source).parent
    try:
        return _resolved(name, mapping, folder)
    except RecursionError:
        raise ScenarioError(name, "nested too deeply") from None


def _resolved(name: str, mapping: Mapping[str, Any], folder: Path) -> Plan:
    problems = problems_of(StudyFile, mapping, EXPECTED)
    if problems:
        raise ScenarioError(name, problems)
    scenario = mapping.get("scenario", "thesis-transient")
    if isinstance(scenario, str):
        inside = scenario if is_preset(scenario) else folder / scenario
        try:
            base = parse(*read_text(inside if is_preset(scenario) else str(inside)))
        except ScenarioError as error:
            raise ScenarioError(name, [Problem("scenario", "a scenario", str(error))]) from None
        scenario_name = scenario if is_preset(scenario) else Path(scenario).name
    else:
        base, scenario_name = scenario, "its own scenario"
    resolved = {k: v for k, v in mapping.items() if k not in ("schema", "description")}
    record = {
        "name": Path(name).name,
        "scenario_name": scenario_name,
        "study": _plain(name, {**resolved, "scenario": base}),
        "software": software(),
    }
    return _built(record, name)


@lru_cache(maxsize=4)
def plan_of(record: str) -> Plan:
    """Make the plan of a record in JSON: how a worker gets it."""
    loaded = json.loads(record)
    return _built(loaded, loaded["name"])


def _plain(name: str, value: Any) -> Any:
    """Return what JSON gives back of a mapping: dates as text."""
    try:
        return json.loads(json.dumps(value, default=str))
    except ValueError:
        raise ScenarioError(name, "a number has too many digits") from None


def _built(record: Mapping[str, Any], name: str) -> Plan:
    given = StudyFile.model_validate(record["study"])
    check = Checker()
    kind = given.design.kind
    axes = read_axes(check, given.vary, kind)
    _check_settings(check, axes)
    size = _size(check, axes, kind, given.design.points)
    if kind != "latin-hypercube" and given.design.seed is not None:
        check.note("design.seed", f"nothing for a {kind}", str(given.design.seed))
    if check.problems:
        raise ScenarioError(name, check.problems)
    base = record["study"]["scenario"]
    example = _example(name, base, axes)
    settings = {key: value for key, value in given.predict.model_dump().items() if value is not None}
    for key in set(settings) & {axis.name for axis in axes}:
        check.note(f"predict.{key}", "nothing, since it is varied", shown(settings[key]))
    varied = {axis.name for axis in axes}
    fixed = example.network.link is not None or example.network.burst is not None
    if example.network.cases or not (fixed or "network.link" in varied):
        check.note("vary.network.link", "link probabilities, since the scenario does not name one", "nothing")
    if check.problems:
        raise ScenarioError(name, check.problems)
    report = given.report
    metric = (example.metric or "trace") if report.metric is None else report.metric
    # the command line separates quantities by commas; those of a metric are part of it
    quantities = _several(report.quantity.split(",") if isinstance(report.quantity, str) else report.quantity)
    metrics = _several(metric)
    _check_report(name, quantities, metrics, example)
    if isinstance(report.agent, int) and report.agent > example.network.agents and "network.agents" not in varied:
        expected = f"an agent from 1 to {example.network.agents}"
        raise ScenarioError(name, [Problem("report.agent", expected, str(report.agent))])
    return Plan(
        name=record["name"],
        kind=kind,
        axes=axes,
        size=size,
        base=base,
        scenario_name=record["scenario_name"],
        settings=settings,
        quantities=quantities,
        metrics=metrics,
        agent=report.agent or example.agent or "mean",
        example=example,
        seed=1 if given.design.seed is None else given.design.seed,
        record=record,
    )


def _several(words: str | list[str]) -> tuple[str, ...]:
    return (words,) if isinstance(words, str) else tuple(word.strip() for word in words)


def _check_settings(check: Checker, axes: tuple[Axis, ...]) -> None:
    for axis in axes:
        path = f"vary.{axis.name}"
        if axis.name in _WORDS:
            unknown = [v for v in axis.given or (axis.low,) if v not in _WORDS[axis.name]]
            if unknown:
                check.note(path, "one of " + ", ".join(_WORDS[axis.name]), shown(unknown[0]))
        elif axis.name in ("runs", "seed", "max_graphs"):
            least = _LEAST[axis.name]
            if axis.kind != "int" or min(axis.given or (axis.low,)) < least:
                check.note(path, f"whole numbers of at least {least}", shown(min(axis.given or (axis.low,), key=str)))
        elif axis.name == "prune":
            if not all(isinstance(v, bool) for v in axis.given or (axis.low,)):
                check.note(path, "true or false", shown((axis.given or (axis.low,))[0]))
        elif "." not in axis.name or not _PATH.fullmatch(axis.name):
            check.note(path, f"{_KEY}, or one of {', '.join(SETTINGS)}", f"'{axis.name}'")


def _size(check: Checker, axes: tuple[Axis, ...], kind: str, points: int | None) -> int:
    if check.problems:
        return 0
    if kind == "latin-hypercube":
        if points is None:
            check.note("design.points", "the number of points", "nothing")
            return 0
        if points * len(axes) > MOST_DRAWN:
            check.note("design.points", f"at most {MOST_DRAWN // len(axes)} for {len(axes)} keys", str(points))
        return points
    if points is not None:
        check.note("design.points", f"nothing for a {kind}, whose values say it", str(points))
    lengths = [len(axis.given or ()) for axis in axes]
    if kind == "list" and len(set(lengths)) > 1:
        counts = ", ".join(f"{axis.name} has {n}" for axis, n in zip(axes, lengths, strict=True))
        check.note("vary", "lists of the same length, since design.kind is list", counts)
    size = prod(lengths) if kind == "grid" else lengths[0]
    if size > MOST_POINTS:
        check.note("vary", f"at most {MOST_POINTS} points", str(size))
    return size


def _example(name: str, base: Mapping[str, Any], axes: tuple[Axis, ...]) -> Scenario:
    """Return the scenario of the first point, or of one that can be made, where it is only its values that fail."""
    keys = [axis for axis in axes if axis.name not in SETTINGS]
    first = {axis.name: axis.given[0] if axis.given is not None else axis.value(axis.low) for axis in keys}
    last = {axis.name: axis.given[-1] if axis.given is not None else axis.value(axis.high) for axis in keys}
    try:
        problems = structure_problems(put(base, first))
    except ScenarioError as error:
        raise ScenarioError(name, error.problems) from None
    if problems:
        raise ScenarioError(name, [_varied(problem, first) for problem in problems])
    failed: StochfuseError | None = None
    for values in (first, last, {}):
        try:
            return Scenario.from_mapping(put(base, values), name)
        except StochfuseError as error:
            failed = failed or error
    raise failed or UsageError("no point can be made")


def _varied(problem: Problem, values: Mapping[str, Any]) -> Problem:
    """Return a scenario's problem by the key of [vary] that it comes from."""
    key = next((k for k in values if k == problem.path or k.startswith((f"{problem.path}.", f"{problem.path}["))), None)
    return problem if key is None else problem._replace(path=f"vary.{key}")


def _check_report(name: str, quantities: tuple[str, ...], metrics: tuple[str, ...], example: Scenario) -> None:
    check = Checker()
    for key, words in (("quantity", quantities), ("metric", metrics)):
        if not words or len(set(words)) < len(words):
            check.note(f"report.{key}", "at least one, each once", shown(list(words)))
    for quantity in quantities:
        if quantity not in (*QUANTITIES, MESSAGES):
            check.note("report.quantity", "one of " + ", ".join((*QUANTITIES, MESSAGES)), f"'{quantity}'")
    if not set(quantities) - {MESSAGES}:
        check.note("report.quantity", "a quantity of the error beside messages", shown(list(quantities)))
    try:
        for metric in metrics:
            for quantity in set(quantities) & set(QUANTITIES):
                check_quantity(quantity, metric_of(metric, example.model))
    except UsageError as error:
        check.note("report.metric", "a metric of this model", str(error))
    if check.problems:
        raise ScenarioError(name, check.problems)
