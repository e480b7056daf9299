"""Methods side by side as table, CSV, JSON and figure.

Estimators side by side: what each claims beside what is true, as table, CSV, JSON and figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.kalman.metrics import Metric
from stochfuse.prediction.compare import Comparison, EstimatorComparison
from stochfuse.report import predictions
from stochfuse.report.plot import COLORS, MARKERS, below, figure_class, shades, spread, titled
from stochfuse.report.predictions import PredictionView
from stochfuse.report.rows import Curves
from stochfuse.report.table import Report, Table, number, to_csv

SCHEMA = "stochfuse.comparison/1"


@dataclass(frozen=True)
class ComparisonView:
    """What of a comparison is shown.

    Parameters
    ----------
    comparison : the comparison.
    views : a view of each prediction, the reference first.
    relative : whether differences are shown in per cent of the reference.
    """

    comparison: Comparison
    views: tuple[PredictionView, ...]
    relative: bool = False

    def values(self) -> np.ndarray:
        """Values shown, shape (methods, links, steps)."""
        return np.stack([view.values() for view in self.views])

    def differences(self) -> np.ndarray:
        """Signed differences from the reference, or per cent of it, shape (methods, links, steps)."""
        values = self.values()
        difference = values - values[0]
        if not self.relative:
            return difference
        return 100.0 * np.divide(difference, values[0], out=np.zeros_like(difference), where=values[0] != 0)

    def errors(self, method: int) -> np.ndarray | None:
        """Standard errors of a method's values where they are sampled."""
        return self.views[method].errors()

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is compared."""
        first = self.views[0]
        unit = "in per cent of it" if self.relative else "signed"
        return (
            first.what,
            first.whom,
            *(f"{view.prediction.method}: {view.how}" for view in self.views),
            f"Δ: difference from {self.comparison.reference.method}, {unit}",
        )


def comparison_report(view: ComparisonView) -> Report:
    """Return methods side by side in every form."""
    return Report.of(view, compare_table, compare_csv, compare_json, draw)


def compare_table(view: ComparisonView) -> Table:
    """Return rows of link probability and step, columns of methods."""
    p, digits = view.comparison.reference, view.views[0].digits
    values, differences, names = view.values(), view.differences(), view.views[0].rows
    columns = [p.method, *(f"{m}, Δ{' %' if view.relative else ''}" for m in view.comparison.methods[1:])]
    rows = []
    for i, there in enumerate(view.views[0].there):
        for k in np.flatnonzero(there):
            cells = []
            for m, value in enumerate(values[:, i, k]):
                difference = f" {_signed(differences[m, i, k], value, digits)}" if m else ""
                cells.append(number(value, digits) + difference + _error(view, m, i, int(k)))
            rows.append((*names.cells(i), str(view.views[0].steps[k]), *cells))
    return Table(view.titles, (*names.keys, "k"), tuple(columns), tuple(rows))


def _signed(difference: float, value: float, digits: int) -> str:
    """A difference with its sign; what is no more than rounding is nothing."""
    return f"{difference:+.{max(2, digits - 2)}g}" if abs(difference) > 1e-12 * abs(value) else "0"


def _error(view: ComparisonView, method: int, row: int, step: int) -> str:
    errors = view.errors(method)
    if errors is None:
        return ""
    scale = 100.0 / view.values()[0, row, step] if view.relative and method else 1.0
    return f" {predictions.plus_minus(scale * errors[row, step], scale * view.values()[method, row, step])}"


def compare_csv(view: ComparisonView) -> str:
    """One line per method, link probability and step."""
    first = view.views[0]
    values = view.values()
    rows = []
    for m, each in enumerate(view.views):
        errors = view.errors(m)
        for i, there in enumerate(first.there):
            for k in np.flatnonzero(there):
                difference = values[m, i, k] - values[0, i, k]
                rows.append(
                    (
                        each.prediction.method,
                        each.prediction.quantity,
                        each.prediction.stage,
                        each.prediction.nature,
                        first.metric.name,
                        first.unit,
                        first.agent,
                        *first.rows.record(i),
                        int(first.steps[k]),
                        float(values[m, i, k]),
                        float(difference),
                        float(difference / values[0, i, k]) if values[0, i, k] else "",
                        "" if errors is None else float(errors[i, k]),
                    )
                )
    headings = (
        "method", "quantity", "stage", "nature", "metric", "unit", "agent", *first.rows.headings, "step", "value",
        "difference", "relative_difference", "standard_error",
    )  # fmt: skip
    return to_csv(headings, rows)


def compare_json(view: ComparisonView) -> dict[str, Any]:
    """Return the object of schema stochfuse.comparison/1."""
    p, first = view.comparison.reference, view.views[0]
    values = view.values()
    methods = {}
    for m, each in enumerate(view.views):
        errors = view.errors(m)
        methods[each.prediction.method] = {
            "nature": each.prediction.nature,
            "description": each.how,
            "values": predictions.listed(values[m]),
            "difference": predictions.listed(values[m] - values[0]),
            **({} if errors is None else {"standard_error": predictions.listed(errors)}),
            "meta": {"notes": list(each.prediction.notes), **each.prediction.meta},
        }
    return {
        "schema": SCHEMA,
        "version": __version__,
        "quantity": p.quantity,
        "metric": first.metric.name,
        "reference": p.method,
        **first.rows.facts,
        "steps": first.steps.tolist(),
        "methods": methods,
        "scenario": p.scenario.to_mapping(),
        "meta": {"description": list(view.titles), "stage": p.stage, "unit": first.unit or None, "agent": first.agent},
    }


def draw(view: ComparisonView):
    """Return the figure."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    p, first = view.comparison.reference, view.views[0]
    values, differences = view.values(), view.differences()
    curves = first.rows.curves(first.steps)
    chosen = spread(len(curves.names))
    figure = figure_class()(figsize=(11, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colors = shades(len(chosen))
    styles: list[Any] = ["-", "--", ":", "none"]
    for m in range(len(view.views)):
        errors = view.errors(m)
        style: dict[str, Any] = {"linestyle": styles[m % 4], "marker": MARKERS[m], "markersize": 4}
        for c, color in zip(chosen, colors, strict=True):
            x, pick = curves.x[c], curves.picks[c]
            left.plot(x, values[m][pick], color=color, **style)
            if m and errors is None:
                right.plot(x, differences[m][pick], color=color, **style)
            elif m and errors is not None:
                scale = 100.0 / values[0][pick] if view.relative else 1.0
                bars = 1.96 * errors[pick] * scale
                right.errorbar(x, differences[m][pick], bars, color=color, capsize=2, **style)
    unit = f" [{first.unit}]" if first.unit else ""
    left.set_ylabel(first.axis)
    if np.nanmin(values) >= 0:
        left.set_ylim(bottom=0)
    right.axhline(0, color="0.3", linewidth=0.8)
    right.set_ylabel(f"difference from {p.method}" + (" [%]" if view.relative else unit))
    for axes in (left, right):
        axes.set_xlabel(curves.label)
        if curves.whole:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    methods = [
        Line2D(
            [],
            [],
            color="0.2",
            linestyle=styles[m % 4],
            marker=MARKERS[m],
            markersize=4,
            label=f"{q.method}, {q.nature}",
        )
        for m, q in enumerate(view.comparison.predictions)
    ]
    shown = zip(chosen, colors, strict=True)
    steps = [Line2D([], [], color=color, linewidth=3, label=curves.names[c]) for c, color in shown]
    below(figure, [*methods, *steps])
    bars = "; bars: 95 % confidence" if any(view.errors(m) is not None for m in range(len(view.views))) else ""
    titled(figure, first.what + (f", {curves.at}" if curves.at else ""), first.whom + bars)
    return figure


ESTIMATORS_SCHEMA = "stochfuse.estimators/1"
RATIO = "actual / claimed"
STYLES: dict[str, Any] = {"claimed": "--", "actual": "-", "consistency": "-", "bias": ":", "rms": "-."}


@dataclass(frozen=True)
class EstimatorView:
    """What of a comparison of estimators is shown.

    Parameters
    ----------
    comparison : the comparison.
    metric, agent, digits : as for `PredictionView`.
    quantities : one column each.
    every_step : whether the table shows every step, or only the last.
    at : steps shown, in order; default: all.
    """

    comparison: EstimatorComparison
    metric: Metric
    agent: int | str = "mean"
    digits: int = 5
    quantities: Sequence[str] = ("claimed", "actual", "consistency")
    every_step: bool = False
    at: tuple[int, ...] | None = None

    @cached_property
    def views(self) -> list[list[PredictionView]]:
        """A view of every quantity of every estimator."""
        return [
            [
                PredictionView(p.shown_as(q), self.metric, self.agent, digits=self.digits, at=self.at)
                for q in self.quantities
            ]
            for p in self.comparison.predictions
        ]

    @cached_property
    def values(self) -> list[list[np.ndarray]]:
        """Values shown, (links, steps), of every quantity of every estimator."""
        return [[view.values() for view in views] for views in self.views]

    @cached_property
    def errors(self) -> list[list[np.ndarray | None]]:
        """Their standard errors where they are sampled."""
        return [[view.errors() for view in views] for views in self.views]

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is shown."""
        first = self.views[0]
        step = "" if self.every_step or self.at else f"after step {self.comparison.predictions[0].steps[-1]}, "
        sampled = {f"± one standard error, {p.meta['runs']} runs" for p in self._sampled}
        return (
            *(view.what for view in first),
            step + first[0].whom,
            "; ".join(f"{nature}: {', '.join(names)}" for nature, names in self._natures.items()),
            *sorted(sampled),
        )

    @property
    def _natures(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for p in self.comparison.predictions:
            found.setdefault(p.nature, []).append(p.estimator)
        return found

    @property
    def _sampled(self) -> list[Any]:
        return [view[0].prediction for view in self.views if view[0].sampled]


def estimator_report(view: EstimatorView) -> Report:
    """Return estimators side by side in every form."""
    return Report.of(view, estimator_table, estimator_csv, estimator_json, draw_estimators)


def estimator_table(view: EstimatorView) -> Table:
    """Return rows of link probability, step and estimator, columns of quantities."""
    first, stepwise = view.views[0][0], view.every_step or view.at is not None
    rows = []
    for i, there in enumerate(first.there):
        for k in np.flatnonzero(there)[slice(None) if stepwise else slice(-1, None)]:
            for estimator, values, errors in zip(view.comparison.estimators, view.values, view.errors, strict=True):
                cells = [
                    number(value[i, k], view.digits)
                    + (
                        ""
                        if error is None or quantity == "consistency"
                        else f" {predictions.plus_minus(error[i, k], value[i, k])}"
                    )
                    for quantity, value, error in zip(view.quantities, values, errors, strict=True)
                ]
                step = (str(first.steps[k]),) if stepwise else ()
                rows.append((*first.rows.cells(i), *step, estimator, *cells))
    columns = tuple("ratio" if q == "consistency" else q for q in view.quantities)
    return Table(view.titles, (*first.rows.keys, *(("k",) if stepwise else ()), "estimator"), columns, tuple(rows))


def estimator_csv(view: EstimatorView) -> str:
    """Return one record per estimator, quantity, link probability and step."""
    out = []
    for estimator, views in zip(view.comparison.estimators, view.views, strict=True):
        for each in views:
            first, *records = predictions.predict_csv(each).splitlines()
            out += [] if out else [f"estimator,{first}"]
            out += [f"{estimator},{record}" for record in records]
    return "\n".join(out) + "\n"


def estimator_json(view: EstimatorView) -> dict[str, Any]:
    """Return the object of schema stochfuse.estimators/1."""
    p = view.comparison.predictions[0]
    found = {}
    for q, values, errors in zip(view.comparison.predictions, view.values, view.errors, strict=True):
        quantities = {}
        for name, value, error in zip(view.quantities, values, errors, strict=True):
            quantities[name] = {"values": predictions.listed(value)}
            if error is not None:
                quantities[name]["standard_error"] = predictions.listed(error)
        meta = {key: q.meta[key] for key in ("runs", "seed", "outcomes") if key in q.meta}
        found[q.estimator] = {
            "method": q.method,
            "nature": q.nature,
            "quantities": quantities,
            "meta": {**meta, "notes": list(q.notes)},
        }
    return {
        "schema": ESTIMATORS_SCHEMA,
        "version": __version__,
        "metric": view.metric.name,
        **view.views[0][0].rows.facts,
        "steps": view.views[0][0].steps.tolist(),
        "estimators": found,
        "scenario": p.scenario.to_mapping(),
        "meta": {
            "description": list(view.titles),
            "stage": p.stage,
            "unit": view.views[0][0].unit or None,
            "agent": view.agent,
            "left_out": list(view.comparison.left_out),
        },
    }


MOST_GROUPS = 4
"""Rows of panels, where what is swept has a second axis."""


def draw_estimators(view: EstimatorView):
    """Return the figure: a panel for quantities with the metric's unit, one for the ratio; a row of them a group."""
    Figure = figure_class()
    from matplotlib.lines import Line2D

    axis_of = [RATIO if q == "consistency" else view.views[0][c].axis for c, q in enumerate(view.quantities)]
    panels = list(dict.fromkeys(axis_of))
    first = view.views[0][0]
    curves, cases = _drawn(first)
    chosen = spread(len(curves.names))[:MOST_GROUPS]
    figure = Figure(figsize=(2.0 + 4.6 * len(panels), 1.4 + 4.0 * len(chosen)), layout="constrained")
    grid = figure.subplots(len(chosen), len(panels), squeeze=False)
    colors = [COLORS[e % len(COLORS)] for e in range(len(view.values))]
    for row, c in zip(grid, chosen, strict=True):
        axes_of = dict(zip(panels, row, strict=True))
        for e, (values, color) in enumerate(zip(view.values, colors, strict=True)):
            for q, quantity in enumerate(view.quantities):
                style = "" if cases else STYLES[quantity]
                # cases are no sequence: claimed is a hollow marker there
                hollow = bool(cases) and quantity == "claimed"
                axes_of[axis_of[q]].plot(
                    curves.x[c],
                    values[q][curves.picks[c]],
                    color=color,
                    linestyle=style,
                    marker=_marker(e) if len(curves.x[c]) <= 30 else None,
                    markersize=9 if hollow else 5,
                    markerfacecolor="none" if hollow else color,
                )
        for label, axes in axes_of.items():
            _finish(axes, label, curves, cases)
            if len(chosen) > 1:
                axes.set_title(curves.names[c], fontsize="small")
    names = [
        Line2D([], [], color=color, marker=_marker(e), markersize=5, label=name)
        for e, (name, color) in enumerate(zip(view.comparison.estimators, colors, strict=True))
    ]
    kinds = [
        Line2D([], [], color="0.2", linestyle=STYLES[q], label=q + " (hollow)" * (bool(cases) and q == "claimed"))
        for q in view.quantities
        if q != "consistency"
    ]
    below(figure, [*names, *kinds])
    where = curves.at or first.rows.name(0)
    title = f"What estimators claim and what is true, {where}; {first.whom}"
    titled(figure, title)
    return figure


def _drawn(first: PredictionView) -> tuple[Curves, tuple[str, ...]]:
    """Along what estimators are drawn, and the cases if along these, one beside another."""
    cases = first.prediction.cases
    if cases is None or len(cases) == 1 or first.rows.over is not None:
        return first.rows.curves(first.steps, last=True), ()
    rows = np.arange(len(cases))
    return Curves([rows], "", [""], [(rows, -1)], "rows", at=f"after step {first.steps[-1]}"), cases


def _finish(axes: Any, label: str, curves: Curves, cases: Sequence[str]) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if label == RATIO:
        axes.axhline(1.0, color="0.3", linewidth=0.8)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.9), max(high, 1.1))
    elif axes.get_ylim()[0] > 0:
        axes.set_ylim(bottom=0)
    if cases:
        axes.set_xticks(range(len(cases)), ["\n".join(wrap(case, 16)) for case in cases], fontsize="small")
    else:
        axes.set_xlabel(curves.label)
    if curves.whole:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _marker(number: int) -> str:
    """Marker of a curve; together with its colour there is none like it among 64."""
    return MARKERS[(number + 3 * (number // len(COLORS))) % len(MARKERS)]
