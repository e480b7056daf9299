"""A prediction as table, records and JSON, with everything the reader must know beside the numbers.

Several quantities of one prediction side by side: claimed beside actual, and what follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.engines.distribution import parse_statistic
from stochfuse.errors import StochfuseError, UsageError
from stochfuse.kalman.metrics import Metric, power
from stochfuse.prediction.predict import predict
from stochfuse.prediction.quantities import OVERCONFIDENT, expectation, noun, title
from stochfuse.prediction.quantities import unit as unit_of
from stochfuse.prediction.result import Limit, Prediction
from stochfuse.prediction.swept import Swept
from stochfuse.report.plot import (
    DASHES,
    MARKERS,
    MOST_MARKED,
    band,
    below,
    canvas,
    direct,
    entry,
    labelled,
    shades,
    spread,
    titled,
    wrapped,
)
from stochfuse.report.rows import ResultRows, ShownCurve, whose
from stochfuse.report.table import Report, Table, counted, listed, number, stamped, to_csv
from stochfuse.scenario.registry import OPTIMAL, SIMPLIFIED
from stochfuse.scenario.registry import title as method_title

SCHEMA = "stochfuse.prediction/1"
STEADY = ("steady", "steady_relative_bound", "steady_standard_error", "steady_nature", "steady_cycle")
"""What JSON says of a steady state."""
STATISTICS = {
    "variance": "variance over the outcomes of the {what}",
    "std": "standard deviation over the outcomes of the {what}",
    "quantile": "{number}-quantile over the outcomes of the {what}",
    "at-most": "probability that the {what} is at most {number}{unit}",
    "derivative": "derivative in µ of the expected {what}",
}
LEVEL = 0.95
NOTHING = 1e-12
"""Standard error, relative to the value, that is rounding."""
WIDTH_95 = 1.959963984540054
"""Half-width of a 95 % confidence interval in standard errors."""


@dataclass(frozen=True)
class PredictionView:
    """What of a prediction is shown.

    Parameters
    ----------
    prediction : the prediction.
    metric : the number shown.
    agent : "mean", "worst", "best" or a number from 1.
    baseline : the same prediction at link probability 0, to normalise by, or None.
    digits : significant digits in tables.
    statistic : "mean", or what of the metric's distribution over the outcomes, see `Prediction.statistic`.
    at : steps shown, in order; default: all.
    """

    prediction: Prediction | Swept
    metric: Metric
    agent: int | str = "mean"
    baseline: Prediction | Swept | None = None
    digits: int = 5
    statistic: str = "mean"
    at: tuple[int, ...] | None = None

    @cached_property
    def rows(self) -> ResultRows:
        """What the rows stand for."""
        return ResultRows(self.prediction)

    @cached_property
    def parts(self) -> tuple[Prediction, ...]:
        """The prediction, or those of what was swept."""
        return self.prediction.parts if isinstance(self.prediction, Swept) else (self.prediction,)

    @property
    def sampled(self) -> bool:
        """Whether some of the values are sampled."""
        return any(part.sampled is not None for part in self.parts)

    @property
    def there(self) -> np.ndarray:
        """(rows, steps) whether a row has such a step: what is swept may be the number of steps."""
        steps = np.concatenate([np.full(len(part.link), part.steps[-1]) for part in self.parts])
        return self.steps <= steps[:, None]

    @property
    def steps(self) -> np.ndarray:
        """Steps shown."""
        return self.prediction.steps if self.at is None else np.array(self.at)

    def _at(self, values: np.ndarray) -> np.ndarray:
        return values if self.at is None else values[:, self.steps - 1]

    @property
    def unit(self) -> str:
        """Unit of the values; empty where there is none."""
        if self.baseline or self.statistic.startswith("at-most"):
            return ""
        own = unit_of(self.prediction.quantity, self.metric)
        return power(own, 2) if self.statistic == "variance" else own

    def errors(self) -> np.ndarray | None:
        """Standard errors of the values where they are sampled, shape (links, steps)."""
        errors = self.prediction.standard_error(self.metric, self.agent)
        if errors is None or self.baseline is None:
            return None if errors is None else self._at(errors)
        return self._at(self._normalised(errors, self.baseline.values(self.metric, self.agent)))

    def ends(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Low and high end of the values as a log supports them, each (links, steps); None if not asked for."""
        if isinstance(self.prediction, Swept):
            return None
        found = self.prediction.interval(self.metric, self.agent)
        return None if found is None else (self._at(found[0]), self._at(found[1]))

    def values(self) -> np.ndarray:
        """Values shown, shape (links, steps)."""
        if self.prediction.meta.get("faults"):  # items without an answer stay what they are
            return self._at(self.prediction.values(self.metric, self.agent))
        if self.statistic != "mean":
            return self._finite(self._at(self.prediction.statistic(self.statistic, self.metric, self.agent)))
        values = self.prediction.values(self.metric, self.agent)
        by = self.baseline and self.baseline.values(self.metric, self.agent)
        return self._finite(self._at(self._normalised(values, by)))

    def _finite(self, values: np.ndarray) -> np.ndarray:
        _finite(values[self.there])
        return values

    def overconfidence(self) -> str:
        """Return a sentence if more is claimed than is true by over 5 %, where both are known; else nothing."""
        p = self.prediction
        if not p.with_actual or p.method in (SIMPLIFIED, OPTIMAL):
            return ""
        ratio = p.shown_as("consistency").values(self.metric, self.agent)
        if np.nanmax(ratio) <= OVERCONFIDENT:
            return ""
        row, step = np.unravel_index(np.nanargmax(ratio), ratio.shape)
        where = self.rows.name(int(row)) if self.rows.over or p.cases is not None else f"µ = {p.link[row]:.6g}"
        return (
            f"overconfident: the actual {self.metric.label} is up to {np.nanmax(ratio):.3g} times the claimed one "
            f"({where}, step {p.steps[step]})"
        )

    def steady(self) -> np.ndarray | None:
        """Steady-state values, shape (links,), or None."""
        values = self.prediction.steady_values(self.metric, self.agent)
        if values is None:
            return None
        return _finite(self._normalised(values, self.baseline and self.baseline.steady_values(self.metric, self.agent)))

    @property
    def limits(self) -> list[Limit]:
        """What all parts tend to, if that was asked for."""
        return [part.limit for part in self.parts if part.limit is not None]

    def steady_error(self) -> np.ndarray | None:
        """Standard errors of the steady values where they are sampled, shape (links,), or None."""
        errors = self.prediction.steady_error(self.metric, self.agent)
        by = self.baseline and self.baseline.steady_values(self.metric, self.agent)
        return None if errors is None else self._normalised(errors, by)

    @property
    def steady_cells(self) -> list[str] | None:
        """The steady values as they are shown, of every row."""
        values, errors = self.steady(), self.steady_error()
        if values is None:
            return None
        each = zip(values, np.zeros(len(values)) if errors is None else errors, strict=True)
        return [number(value, self.digits) + (f" ±{error:.2g}" if error else "") for value, error in each]

    def cells(self, *, sure: bool = True) -> list[list[str]]:
        """Return the values as they are shown, of every row and step; `sure`: with standard errors and intervals."""
        values, errors, ends = self.values(), self.errors(), self.ends()
        shown = []
        for i, row in enumerate(values):
            cells = [number(value, self.digits) for value in row]
            if sure and errors is not None:
                cells = [f"{cell} {plus_minus(*each)}" for cell, *each in zip(cells, errors[i], row, strict=True)]
            if sure and ends is not None:
                low, high = ([number(end, self.digits) for end in each[i]] for each in ends)
                cells = [f"{cell} [{a}, {b}]" for cell, a, b in zip(cells, low, high, strict=True)]
            shown.append(cells)
        return shown

    def _normalised(self, values: np.ndarray, by: np.ndarray | None) -> np.ndarray:
        if by is None:
            return values
        # of what was swept every point is relative to itself at link probability 0
        by = by[self.rows.point]
        if (by == 0).any():
            raise UsageError(f"{self.full_noun} is 0 at link probability 0 and cannot be normalised to it")
        return values / by

    @property
    def what(self) -> str:
        """One line: which quantity, of which states, in which unit."""
        p = self.prediction
        unit = f" [{self.unit}]" if self.unit else ", relative to link probability 0" if self.baseline else ""
        if not unit and p.quantity != "consistency":
            unit = " [mixed units]" if self.metric.mixed else "" if any(p.scenario.model.units) else " [no unit given]"
        if self.statistic == "mean":
            text, heading = self.noun, "expected " * expectation(p.quantity) + title(p.quantity, p.stage)
        else:
            kind, number = parse_statistic(self.statistic)
            own = unit_of(p.quantity, self.metric)
            text = STATISTICS[kind].format(what=self.full_noun, number=f"{number:.12g}", unit=f" {own}" if own else "")
            heading, unit = title(p.quantity, p.stage), "" if kind == "at-most" else unit
        return f"{heading[0].upper()}{heading[1:]}: {text}{unit}"

    @property
    def noun(self) -> str:
        """What of the quantity is shown, in words."""
        return noun(self.prediction.quantity, self.metric)

    @property
    def full_noun(self) -> str:
        """What is shown where the quantity is not named beside it."""
        before = {"bias": "bias of ", "rms": "RMS error of ", "consistency": "actual / claimed, "}
        return before.get(self.prediction.quantity, "") + self.noun

    @property
    def axis(self) -> str:
        """Label of an axis along which the values lie."""
        unit = f" [{self.unit}]" if self.unit else ", relative to µ = 0" if self.baseline else ""
        return self.full_noun.partition(" (")[0] + unit

    @property
    def whom(self) -> str:
        """One line: the scenario and whose covariance."""
        return f"{self.rows.agents}{self._links}; {self._of}{self.rows.common}"

    @property
    def _links(self) -> str:
        """What the µ of a row does not say of the links."""
        networks = [part.scenario.network for part in self.parts]
        bursty = any(any(burst is not None for burst in (n.burst, *n.case_bursts)) for n in networks)
        return ", bursty links" * bursty + ", delays" * any(n.delay != (1.0,) for n in networks)

    @property
    def _of(self) -> str:
        if self.prediction.alike:
            return "every agent alike" if any(len(part.group_of) > 1 for part in self.parts) else "alone"
        random = self.statistic not in ("mean", "derivative") and self.agent == "mean"
        return "of an agent picked at random" if random else whose(self.agent, self.prediction.scenario.network.names)

    @property
    def how(self) -> str:
        """One line: the method and how exact it is."""
        p = self.prediction
        natures = list(dict.fromkeys(map(self._nature, self.parts)))
        # of many different ones the first and the last
        nature = " … ".join([natures[0], natures[-1]] if len(natures) > 1 else natures)
        return f"{method_title(p.method, p.estimator)}; {nature}{self._supported}"

    @property
    def _supported(self) -> str:
        """What an interval is, in words."""
        if isinstance(self.prediction, Swept) or self.prediction.supported is None:
            return ""
        posterior, _ = self.prediction.supported
        by = f"{len(posterior.rows.link):,} draws of the links" if posterior.drawn else "derivatives in the links"
        return f"; [ ]: {100 * posterior.level:.6g} % interval for what the log leaves unknown, by {by}"

    def _nature(self, p: Prediction) -> str:
        """How exact the values are, in words."""
        if p.sampled is not None:
            return f"sampled, {p.sampled.runs:,} runs, seed {p.meta['seed']}; ± one standard error"
        if p.method == OPTIMAL:
            nature = "exact" if p.nature == "exact" else "enclosed in proved bounds"
            return nature if p.meta["paths"] is None else f"{nature}, {counted(p.meta['paths'], 'path')}"
        if p.method == SIMPLIFIED:
            return "approximate (mean field)"
        # of noises that differ outcomes are listed without being counted together
        everything = f", {counted(p.meta['outcomes'], 'outcome')}" if "outcomes" in p.meta else ""
        if p.nature == "exact" or "left_out" not in p.meta:
            return f"{p.nature}{everything}"
        return f"approximate{everything} less those of probability up to {np.max(p.meta['left_out']):.2g}"


def _finite(values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise StochfuseError("the prediction is not finite: the values grow beyond floating point")
    return values


def report(views: Sequence[PredictionView]) -> Report:
    """Return one quantity of a prediction, or several side by side, in every form."""
    if len(views) > 1:
        return Report.of(views, side_table, side_csv, side_json, draw_side)
    return Report.of(views[0], predict_table, predict_csv, predict_json, draw)


def predict_table(view: PredictionView) -> Table:
    """Return rows of link probabilities (or cases) against columns of steps."""
    steady, cells = view.steady_cells, view.cells()
    columns = [f"k={k}" for k in view.steps] + (["steady"] if steady is not None else [])
    rows = []
    for i, there in enumerate(view.there):
        shown = [cell if is_there else "" for cell, is_there in zip(cells[i], there, strict=True)]
        rows.append((*view.rows.cells(i), *shown, *([] if steady is None else [steady[i]])))
    return Table((view.what, view.whom, view.how), view.rows.keys, tuple(columns), tuple(rows), over="k")


def plus_minus(error: float, value: float) -> str:
    """A standard error for people; what is no more than rounding is nothing."""
    return f"±{error if abs(error) > NOTHING * abs(value) else 0.0:.2g}"


def predict_csv(view: PredictionView) -> str:
    """One line per link probability and step, with everything that says what the value is."""
    headings, rows, _ = _records(view)
    return to_csv(headings, rows)


def _records(view: PredictionView) -> tuple[tuple[str, ...], list[tuple[Any, ...]], int]:
    """Headings and cells of a CSV, and how many of the last ones are the value and its error."""
    p = view.prediction
    values, errors, steady = view.values(), view.errors(), view.steady()
    metric = view.metric.name + ("/at-link-0" if view.baseline else "")
    metric = metric if view.statistic == "mean" else f"{view.statistic}({metric})"
    labels = (p.method, p.quantity, p.stage, p.nature, metric, view.unit, view.agent)
    natures = [limit.prediction.nature for limit in view.limits for _ in limit.prediction.link]
    rows, ends, steady_error = [], view.ends(), view.steady_error()
    more: dict[str, np.ndarray | None] = {}
    if ends is not None:
        more = {"low": ends[0], "high": ends[1]}
    elif errors is not None or steady_error is not None:
        more = {"standard_error": errors}
    for i, there in enumerate(view.there):
        record = view.rows.record(i)
        for c in np.flatnonzero(there):
            error = (None if each is None else float(each[i, c]) for each in more.values())
            rows.append((*labels, *record, int(view.steps[c]), float(values[i, c]), *error))
        if steady is not None:
            # a limit has no interval
            error = (None if ends is not None or steady_error is None else float(steady_error[i]) for _ in more)
            rows.append((*labels[:3], natures[i], *labels[4:], *record, "steady", float(steady[i]), *error))
    what = ("method", "quantity", "stage", "nature", "metric", "unit", "agent")
    return (*what, *view.rows.headings, "step", "value", *more), rows, 1 + len(more)


def predict_json(view: PredictionView) -> dict[str, Any]:
    """Return the object of schema stochfuse.prediction/1."""
    p = view.prediction
    model, steady = p.scenario.model, view.steady()
    result = stamped(
        SCHEMA,
        method=p.method,
        quantity=p.quantity,
        metric=view.metric.name,
        **view.rows.facts,
        steps=view.steps.tolist(),
        values=listed(view.values()),
        scenario=p.scenario.to_mapping(),
        meta={
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
            "estimator": p.estimator,
            **p.meta,
        },
    )
    if view.statistic != "mean":
        result["statistic"] = view.statistic
    errors, ends = view.errors(), view.ends()
    if ends is not None and isinstance(p, Prediction) and p.supported is not None:
        result |= {"low": listed(ends[0]), "high": listed(ends[1]), "level": p.supported[0].level}
    if errors is not None:
        half = WIDTH_95 * errors
        result["standard_error"] = listed(errors)
        low, high = listed(view.values() - half), listed(view.values() + half)
        result["interval"] = {"level": LEVEL, "low": low, "high": high}
    elif isinstance(p, Prediction) and view.metric.linear and view.statistic == "mean" and not view.baseline:
        polynomials = p.polynomials(view.metric, view.agent)
        if polynomials is not None:
            # E(µ) = sum over c of coefficients[c] µ^c (1−µ)^(L−c), L + 1 = len(coefficients), one list per step
            result["bernstein"] = [polynomials[k - 1].tolist() for k in view.steps]
    if steady is not None:
        result |= _steady_json(view, steady)
    return result


def _steady_json(view: PredictionView, steady: np.ndarray) -> dict[str, Any]:
    """Return the steady state of every row, or of a cycle its mean, and how sure it is."""
    found: dict[str, Any] = {"steady": steady.tolist()}
    limits = view.limits
    if view.prediction.steady_bound is not None:
        found["steady_relative_bound"] = listed(view.prediction.steady_bound.max(axis=1))
    errors = view.steady_error()
    if errors is not None:
        found["steady_standard_error"] = errors.tolist()
    found["steady_nature"] = [limit.prediction.nature for limit in limits for _ in limit.prediction.link]
    if any(limit.period > 1 for limit in limits) and view.baseline is None:
        found["steady_cycle"] = [row.tolist() for limit in limits for row in limit.values(view.metric, view.agent)]
    return found


def each_report(view: PredictionView) -> Report:
    """Return one quantity of all agents beside each other; `view` is of their mean, which JSON has too."""
    named, n = view.prediction.scenario.network.names, view.rows.sizes[0]
    names = named or tuple(f"agent {i}" for i in range(1, n + 1))
    views = [replace(view, agent=i) for i in range(1, n + 1)]
    titles = (view.what, replace(view, agent="each").whom, view.how)

    def csv() -> str:
        (headings, rows, last), *others = map(_records, views)
        kept = [i for i, heading in enumerate(headings[:-last]) if heading != "agent"]
        beside = [name if heading == "value" else f"{name} {heading}" for name in names for heading in headings[-last:]]
        cells = (
            [*(each[0][i] for i in kept), *(cell for row in each for cell in row[-last:])]
            for each in zip(rows, *(more for _, more, _ in others), strict=True)
        )
        return to_csv([*(headings[i] for i in kept), *beside], cells)

    def json() -> dict[str, Any]:
        each = zip(named or range(1, n + 1), views, strict=True)
        agents = [{"agent": name, **_numbers(predict_json(one))} for name, one in each]
        return {**predict_json(view), "agents": agents}

    return Report(lambda: _beside(views, titles, names), csv, json, lambda: _draw_each(views, titles, names))


def _draw_each(views: Sequence[PredictionView], titles: Sequence[str], names: Sequence[str]) -> Any:
    """Return the figure: a curve for each agent, at the last step, or against the steps where rows are no sequence."""
    curves, figure = views[0].rows.curves(views[0].steps, last=True), canvas(7.5, 5.4)
    axes, chosen, handles = figure.add_subplot(), spread(len(views)), []
    for color, i in zip(shades(len(chosen)), chosen, strict=True):
        for style, curve in zip(DASHES, curves.shown(), strict=False):
            _curve(axes, views[i], curve._replace(color=color), linestyle=style, marker=MARKERS[i % len(MARKERS)])
        handles.append(entry(names[i], color=color, linewidth=3))
    rows = zip(DASHES, curves.shown(), strict=False)
    handles += [entry(row.name, color="0.2", linestyle=style) for style, row in rows if len(curves.names) > 1]
    zero = all(np.nanmin(view.values()) >= 0 for view in views)
    labelled(axes, curves.label, views[0].axis, whole=curves.whole, zero=zero)
    below(figure, handles)
    titled(figure, titles[0] + (f", {curves.at}" if curves.at else ""), *titles[1:])
    return figure


STYLES = ("-", "--", ":", "-.")
RATIO = "actual / claimed"


def side_table(views: Sequence[PredictionView]) -> Table:
    """Return rows of link probability and step, columns of quantities."""
    titles = (*(view.what for view in views), views[0].whom, *dict.fromkeys(view.how for view in views))
    return _beside(views, titles, [view.prediction.quantity for view in views])


def _beside(views: Sequence[PredictionView], titles: Sequence[str], columns: Sequence[str]) -> Table:
    """Return rows of link probability and step, and a column for every view."""
    cells, steady = [view.cells() for view in views], [view.steady_cells for view in views]
    rows, names = [], views[0].rows
    for i, there in enumerate(views[0].there):
        for k in np.flatnonzero(there):
            rows.append((*names.cells(i), str(views[0].steps[k]), *(shown[i][k] for shown in cells)))
        if any(steady):
            rows.append((*names.cells(i), "steady", *("" if found is None else found[i] for found in steady)))
    return Table(tuple(titles), (*names.keys, "k"), tuple(columns), tuple(rows))


def side_csv(views: Sequence[PredictionView]) -> str:
    """Return the records of one quantity after the other."""
    first, *others = (predict_csv(view) for view in views)
    return first + "".join(text.partition("\n")[2] for text in others)


def side_json(views: Sequence[PredictionView]) -> dict[str, Any]:
    """Return the object of the first quantity, with all of them under `quantities`."""
    each = {view.prediction.quantity: predict_json(view) for view in views}
    return {
        **each[views[0].prediction.quantity],
        "quantities": {
            name: {
                **_numbers(found),
                **{key: found["meta"][key] for key in ("description", "nature", "unit")},
            }
            for name, found in each.items()
        },
    }


def _numbers(found: dict[str, Any]) -> dict[str, Any]:
    """What of an object for JSON is not the same for all that stand beside each other."""
    kept = ("values", "standard_error", "interval", "low", "high", "level", "bernstein", *STEADY)
    return {key: found[key] for key in kept if key in found}


def draw_side(views: Sequence[PredictionView]) -> Any:
    """Return the figure, one panel for each unit."""
    curves = views[0].rows.curves(views[0].steps)
    units = list(dict.fromkeys(_axis(view) for view in views))
    figure = canvas(1.5 + 5.0 * len(units), 5.6)
    panels = dict(zip(units, figure.subplots(1, len(units), squeeze=False)[0], strict=True))
    styles: list[dict[str, Any]] = [{"linestyle": STYLES[v % 4], "marker": MARKERS[v]} for v in range(len(views))]
    for view, style in zip(views, styles, strict=True):
        for curve in curves.shown():
            _curve(panels[_axis(view)], view, curve, **style)
    for label, axes in panels.items():
        shown = [view for view in views if _axis(view) == label]
        zero = label != RATIO and all(np.nanmin(view.values()) >= 0 for view in shown)
        labelled(axes, curves.label, label, whole=curves.whole, zero=zero)
    each = zip(views, styles, strict=True)
    quantities = [entry(view.prediction.quantity, color="0.2", markersize=4, **style) for view, style in each]
    below(figure, [*quantities, *curves.entries()])
    p, at = views[0].prediction, f", {curves.at}" if curves.at else ""
    sampled = "; bands: 95 % confidence" if views[0].sampled else ""
    how = dict.fromkeys(f"{view.how}{sampled}" for view in views)
    titled(figure, f"{views[0].whom}; expected {p.stage} covariances and errors{at}", *how)
    return figure


def _axis(view: PredictionView) -> str:
    return RATIO if view.prediction.quantity == "consistency" else view.axis


def draw(view: PredictionView) -> Any:
    """Return the figure, not shown and not registered with pyplot."""
    figure = canvas(7.5, 5.0)
    at = draw_on(figure.add_subplot(), view)
    bars = "; bands: 95 % confidence" if view.sampled else ""
    titled(figure, view.what + (f", {at}" if at else ""), view.whom, view.how.replace("; [ ]:", "; band:") + bars)
    return figure


def draw_on(axes: Any, view: PredictionView) -> str:
    """Draw the values on some axes, and return where they are taken if the curves' names do not say it.

    Against link probability or a swept key, a curve a step or a further key's value; or against the step, a curve a
    row.
    """
    curves = view.rows.curves(view.steps)
    shown, whole = curves.shown(), len(curves.names)
    fine = _smooth(view) if curves.what == "steps" and view.rows.over is None else None
    lines = [
        _curve(axes, view, curve, fine=fine, linestyle=DASHES[i], marker=MARKERS[i]) for i, curve in enumerate(shown)
    ]
    label = view.axis
    if view.statistic != "mean":
        label = wrapped(view.what.partition(": ")[2].partition(" [no unit")[0], 45)
    labelled(axes, curves.label, label, whole=curves.whole, zero=np.nanmin(view.values()) >= 0)
    left_out = f"{len(shown)} of {whole} {curves.what}" if len(shown) < whole else None
    direct(axes, lines, [curve.name for curve in shown], left_out)
    return curves.at


def _curve(
    axes: Any,
    view: PredictionView,
    curve: ShownCurve,
    *,
    fine: PredictionView | None = None,
    marker: str,
    linestyle: Any,
) -> Any:
    """Draw one curve: a line, the asked points, a band."""
    x, y, errors, ends = curve.x, view.values()[curve.pick], view.errors(), view.ends()
    color, points = curve.color, {"marker": marker if len(curve.x) <= MOST_MARKED else None, "markersize": 4}
    if fine is None:
        (line,) = axes.plot(x, y, color=color, linestyle=linestyle, **points)
    else:
        _, step = curve.pick
        (line,) = axes.plot(fine.prediction.link, fine.values()[:, step], color=color, linestyle=linestyle)
        axes.plot(x, y, linestyle="none", color=color, **points)
    if errors is not None:
        reach = WIDTH_95 * errors[curve.pick]
        band(axes, x, y - reach, y + reach, color, 0.2)
    if ends is not None:
        band(axes, x, ends[0][curve.pick], ends[1][curve.pick], color, 0.2)
    return line


SMOOTH = 101
"""Link probabilities of a smooth curve."""


def _smooth(view: PredictionView) -> PredictionView | None:
    """The same at many link probabilities, where that is cheap; None where it is not, or rows are not one µ each."""
    p = view.prediction
    if isinstance(p, Swept):
        return None
    cheap = p.method == SIMPLIFIED or (p.outcomes is not None and p.outcomes.polynomial)
    if not cheap or view.rows.mean != "µ" or view.baseline is not None or len(p.link) >= SMOOTH:
        return None
    link = np.union1d(p.link, np.linspace(p.link.min(), p.link.max(), SMOOTH))
    asked: dict[str, Any] = {} if p.method == SIMPLIFIED else {"estimator": p.estimator}
    again = predict(p.scenario, link, p.method, p.quantity, **asked)
    fine = replace(view, prediction=again)
    # rows that were whole matrices are shown by their means, which say less
    same = np.allclose(fine.values()[np.searchsorted(link, p.link)], view.values(), rtol=1e-9)
    return fine if same else None
