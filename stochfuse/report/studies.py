"""What a study found, in a few numbers, and what pays in it (Pareto), as table, CSV and JSON.

Every form is made from the same records, one for each extreme or point of the front.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stochfuse.report.rows import whose
from stochfuse.report.table import Table, counted, listed, number, records_csv, stamped
from stochfuse.scenario.registry import OPTIMAL
from stochfuse.studies.pareto import ParetoFront
from stochfuse.studies.plan import ERROR, NODES, Plan

if TYPE_CHECKING:
    from stochfuse.studies.files import Results

SCHEMA = "stochfuse.study-summary/1"
PARETO_SCHEMA = "stochfuse.pareto/1"
EXPECTED = ("claimed", "actual", OPTIMAL)
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


ROUNDING = 1e-12
"""Relative difference of values that are equal: which is the larger is the machine's business."""


class Extreme(NamedTuple):
    """The least or greatest value of a column after each point's last step, and where it is.

    Parameters
    ----------
    column, extreme : which column, "least" or "greatest".
    value, point, step : the value, its point and that point's last step.
    keys : the point's values of every varied key.
    how : method, estimator and nature, see `HOW`.
    """

    column: str
    extreme: str
    value: float
    point: int
    step: int
    keys: Mapping[str, Any]
    how: Mapping[str, str]


class Summary(NamedTuple):
    """What a study found, in a few numbers.

    Parameters
    ----------
    extremes : of every value column.
    natures : how many points are exact, approximate, bound, sampled.
    """

    extremes: tuple[Extreme, ...]
    natures: Mapping[str, int]


def summarise(results: Results) -> Summary:
    """Go through the results once, block by block; of extremes that are equal to rounding the first point is named."""
    plan = results.plan
    keys = [axis.name for axis in plan.axes]
    asked = tuple(dict.fromkeys(["point", "step", *keys, *HOW, *plan.columns]))
    found: dict[tuple[str, str], Extreme] = {}
    natures: dict[str, int] = {}
    for block in results.blocks(asked):
        for name, count in zip(*np.unique(block["nature"].astype(str), return_counts=True), strict=True):
            natures[str(name)] = natures.get(str(name), 0) + int(count)
        for column in plan.columns:
            values = np.asarray(block[column], dtype=float)
            if np.isnan(values).all():  # standard errors of points that are not sampled
                continue
            for extreme, sign in (("least", 1), ("greatest", -1)):
                best = found.get((column, extreme))
                end = sign * np.nanmin(sign * values)
                i = int((np.abs(values - end) <= ROUNDING * np.abs(end)).argmax())
                if best is None or sign * (best.value - values[i]) > ROUNDING * abs(best.value):
                    at, how = ({name: plain(block[name][i]) for name in names} for names in (keys, HOW))
                    point, step = int(block["point"][i]), int(block["step"][i])
                    found[column, extreme] = Extreme(column, extreme, float(values[i]), point, step, at, how)
    order = [(column, extreme) for column in plan.columns for extreme in ("least", "greatest")]
    return Summary(tuple(found[at] for at in order if at in found), dict(sorted(natures.items())))


def summary_table(results: Results, digits: int = 5) -> Table:
    """Return least and greatest value of every value column, with the point where, under what the study is."""
    summary = summarise(results)
    known = {axis.name: words_of(axis.values) for axis in results.plan.axes}
    rows = tuple(
        (
            *(e.column, e.extreme, number(e.value, digits), str(e.point), str(e.step)),
            *(shortened(value, known[key]) for key, value in e.keys.items()),
        )
        for e in summary.extremes
    )
    return Table(titles(results, summary), ("column", ""), ("value", "point", "k", *known), rows)


def titles(results: Results, summary: Summary) -> tuple[str, ...]:
    """Lines that say what the study is, how much of it there is and what the columns mean."""
    plan = results.plan
    natures = "; ".join(f"{nature}: {counted(n, 'point')}" for nature, n in summary.natures.items())
    more = results.failed - len(results.first_errors)
    return (
        f"Study {plan.name}: {design(plan)}",
        f"Scenario {plan.scenario_name}; {whose(plan.agent)}",
        f"{results.path.name}: {counted(results.rows, 'row')}, {failures(results.failed)}",
        *(f"failed: {points}: {reason}" for points, reason in _together(results.first_errors)),
        *([f"failed: {counted(more, 'point')} more"] if more else []),
        *([natures] if natures else []),
        *(f"{column}: {spoken(plan, column)}" for column in plan.columns),
        "least and greatest after each point's last step",
    )


def _together(errors: Sequence[tuple[int, str]]) -> list[tuple[str, str]]:
    """Points that failed for the same reason, and the reason."""
    found: dict[str, list[str]] = {}
    for point, reason in errors:
        found.setdefault(reason, []).append(str(point))
    return [(f"point{'s' * (len(points) > 1)} {', '.join(points)}", reason) for reason, points in found.items()]


def summary_csv(results: Results) -> str:
    """One line per value column and extreme, with the point where it is."""
    plan = results.plan
    of_study = {"study": plan.name, "points": plan.size, "rows": results.rows, "failed": results.failed}
    records = [
        {
            **of_study,
            **{"column": e.column, "label": spoken(plan, e.column), "extreme": e.extreme},
            **{"value": e.value, "point": e.point, "step": e.step, **e.how, **e.keys},
        }
        for e in summarise(results).extremes
    ]
    keys = [axis.name for axis in plan.axes]
    told = ("column", "label", "extreme", "value", "point", "step")
    return records_csv((*of_study, *told, *keys, *(name for name in HOW if name not in keys)), records)


def summary_json(results: Results) -> dict[str, Any]:
    """Return the object of schema stochfuse.study-summary/1."""
    summary, plan = summarise(results), results.plan
    columns: dict[str, Any] = {column: {"label": spoken(plan, column)} for column in plan.columns}
    for e in summary.extremes:
        keys = {key: json_of(value) for key, value in e.keys.items()}
        columns[e.column][e.extreme] = {"value": e.value, "point": e.point, "step": e.step, "keys": keys, **e.how}
    return stamped(
        SCHEMA,
        **study_json(plan),
        file=str(results.path),
        points=plan.size,
        rows=results.rows,
        failed=results.failed,
        first_errors=[{"point": point, "reason": reason} for point, reason in results.first_errors],
        natures=dict(summary.natures),
        columns=columns,
        meta={"description": list(titles(results, summary))},
    )


def _front(found: ParetoFront) -> Iterator[dict[str, Any]]:
    """A record for each point of the front, by rising load: its costs, its keys, and how it was predicted."""
    for i, point in enumerate(found.points.tolist()):
        error = None if found.error is None else listed(found.error[i])
        yield {
            "point": point,
            "step": int(found.steps[i]),
            "load": float(found.load[i]),
            "accuracy": float(found.accuracy[i]),
            "standard_error": error,
            "keys": {key: plain(values[i]) for key, values in found.keys.items()},
            **{name: str(getattr(found, name)[i]) for name in HOW},
        }


def pareto_titles(found: ParetoFront, results: Results) -> tuple[str, ...]:
    """Lines that say what is compared and how exact it is."""
    plan, n = results.plan, len(found.points)
    these = "this one" if n == 1 else f"these {n:,}"
    natures = ", ".join(sorted(set(found.nature.tolist())))
    when = "each point's last step" if found.step is None else f"step {found.step}"
    fixed = "".join(f", {name} = {shortened(value)}" for name, value in _fixed(found, plan).items())
    return (
        f"Study {plan.name}: accuracy against message load; no point does better in both than {these}",
        f"Scenario {plan.scenario_name}; {whose(plan.agent)}; {counted(found.compared, 'point')} compared{fixed}, "
        f"{failures(results.failed)}",
        f"load: {load_label(plan)}",
        f"accuracy: {spoken(plan, found.column)}, after {when}; {natures}"
        + ("; ± one standard error" if found.error is not None else ""),
    )


def pareto_table(found: ParetoFront, results: Results, digits: int = 5) -> Table:
    """Return the front by rising load, with the keys of its points, under what is compared."""
    told = _fixed(found, results.plan)
    known = {axis.name: words_of(axis.values) for axis in results.plan.axes if axis.name not in told}
    # what all points have in common, or a key says, is no column
    how = [name for name in HOW if name not in found.keys and len(set(getattr(found, name).tolist())) > 1]
    rows = []
    for p in _front(found):
        sampled = "" if p["standard_error"] is None else f" ±{p['standard_error']:.2g}"
        load = number(p["load"], digits) if p["load"] else "0"
        keys = [shortened(p["keys"][key], words) for key, words in known.items()]
        rows.append((str(p["point"]), load, number(p["accuracy"], digits) + sampled, *keys, *(p[name] for name in how)))
    return Table(pareto_titles(found, results), ("point",), ("load", "accuracy", *known, *how), tuple(rows))


def _fixed(found: ParetoFront, plan: Plan) -> dict[str, Any]:
    """Keys that have one value at all points compared, and that value."""
    single = {axis.name: axis.values[0] for axis in plan.axes if axis.values and len(set(axis.values)) == 1}
    return {**single, **found.fixed}


def pareto_csv(found: ParetoFront, results: Results) -> str:
    """One line per point of the front, with everything that says what it is."""
    of_study = {"study": results.plan.name, "column": found.column, "label": spoken(results.plan, found.column)}
    how = [name for name in HOW if name not in found.keys]
    told = ("study", "point", "step", "load", "column", "label", "accuracy", "standard_error")
    return records_csv((*told, *found.keys, *how), ({**of_study, **point, **point["keys"]} for point in _front(found)))


def pareto_json(found: ParetoFront, results: Results) -> dict[str, Any]:
    """Return the object of schema stochfuse.pareto/1."""
    points = []
    for point in _front(found):
        point["keys"] = {key: json_of(value) for key, value in point["keys"].items()}
        points.append({name: value for name, value in point.items() if value is not None})
    return stamped(
        PARETO_SCHEMA,
        **study_json(results.plan),
        column=found.column,
        accuracy=spoken(results.plan, found.column),
        load=load_label(results.plan),
        step=found.step,
        where={name: json_of(value) for name, value in found.fixed.items()},
        compared=found.compared,
        failed=results.failed,
        front=points,
        meta={"description": list(pareto_titles(found, results)), "notes": list(found.notes)},
    )
