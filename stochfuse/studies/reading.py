"""A study file, read and checked: what fits together becomes a plan.

    schema = "stochfuse.study/1"
    scenario = "cv-2d"                                    # a preset, a file, or a [scenario] table
    [vary]                                                # scenario keys, and method, estimator, …
    "network.link" = { from = 0, to = 1, number = 11 }
    "model.R" = { from = 1, to = 1e4, number = 13, scale = "log" }
    method = ["simplified", "general"]
    [design]                                              # default: the grid of all combinations
    kind = "latin-hypercube"
    points = 1000
    [predict]                                             # what holds for every point
    [report]                                              # what is tabulated
    quantity = ["claimed", "messages"]

Its structure is declared in `stochfuse.studies.plan`.  Whether the values of a key fit the scenario is found out point
by point (`stochfuse.studies.evaluation`); here, whether there is such a key.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from stochfuse import __version__
from stochfuse.errors import Problem, ScenarioError, StochfuseError, UsageError
from stochfuse.kalman.checks import shown
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.method import share
from stochfuse.prediction.quantities import QUANTITIES
from stochfuse.prediction.quantities import check as check_quantity
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.over import KEY, PATH, put
from stochfuse.scenario.registry import CONTROLS, CRITERIA, ESTIMATORS, METHODS
from stochfuse.scenario.scenario import Scenario, folder_of, is_preset, parse, read_file, read_text, with_links
from stochfuse.scenario.schema import problems_of, structure_problems
from stochfuse.studies.plan import EXPECTED, MESSAGES, SETTINGS, Axis, Plan, StudyFile, read_axes

_WORDS = {"method": METHODS, "estimator": ESTIMATORS, "criterion": CRITERIA, "control": CONTROLS}
_LEAST = {"runs": 2, "seed": 0, "max_graphs": 1}
MOST_POINTS = 1_000_000_000
MOST_DRAWN = 20_000_000
"""Numbers of a Latin hypercube, points times keys."""


def software() -> dict[str, str]:
    """Versions on which the last bits of results depend."""
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
        folder = folder_of(inside)
    else:
        base, scenario_name = scenario, "its own scenario"
    # workers read no files: what a file says of the links goes into the record
    base = with_links(base, name, folder)
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
    if "precision" in settings:
        _check_share(check, "predict.precision", settings["precision"])
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
        path, values = f"vary.{axis.name}", axis.given or (axis.low,)
        if axis.name in _WORDS:
            unknown = [v for v in values if v not in _WORDS[axis.name]]
            if unknown:
                check.note(path, "one of " + ", ".join(_WORDS[axis.name]), shown(unknown[0]))
        elif axis.name in _LEAST:
            least = _LEAST[axis.name]
            if axis.kind != "int" or min(values) < least:
                check.note(path, f"whole numbers of at least {least}", shown(min(values, key=str)))
        elif axis.name == "precision":
            for given in values:
                _check_share(check, path, given)
        elif axis.name == "prune":
            if not all(isinstance(v, bool) for v in values):
                check.note(path, "true or false", shown(values[0]))
        elif "." not in axis.name or not PATH.fullmatch(axis.name):
            check.note(path, f"{KEY}, or one of {', '.join(SETTINGS)}", f"'{axis.name}'")


def _check_share(check: Checker, path: str, given: Any) -> None:
    try:
        share(given)
    except UsageError:
        check.note(path, "a share between 0 and 1, such as 0.2% or 0.002", shown(given))


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
        raise ScenarioError(name, [_varied(problem, first) for problem in error.problems]) from None
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
