"""Methods side by side as table, CSV, JSON and figure.

Estimators side by side: what each claims beside what is true, as table, CSV, JSON and figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.kalman.metrics import Metric
from stochfuse.prediction.compare import Comparison, EstimatorComparison
from stochfuse.report.plot import COLORS, MARKERS, MOST_MARKED, below, canvas, entry, labelled, titled, wrapped
from stochfuse.report.predictions import NOTHING, RATIO, WIDTH_95, PredictionView, plus_minus, predict_csv
from stochfuse.report.rows import Curves
from stochfuse.report.table import Report, Table, listed, number, stamped, to_csv

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
    return f"{difference:+.{max(2, digits - 2)}g}" if abs(difference) > NOTHING * abs(value) else "0"


def _error(view: ComparisonView, method: int, row: int, step: int) -> str:
    errors = view.errors(method)
    if errors is None:
        return ""
    scale = 100.0 / view.values()[0, row, step] if view.relative and method else 1.0
    return f" {plus_minus(scale * errors[row, step], scale * view.values()[method, row, step])}"


def compare_csv(view: ComparisonView) -> str:
    """One line per method, link probability and step."""
    first, rows, values = view.views[0], [], view.values()
    for m, each in enumerate(view.views):
        p, errors = each.prediction, view.errors(m)
        labels = (p.method, p.quantity, p.stage, p.nature, first.metric.name, first.unit, first.agent)
        for i, k in np.argwhere(first.there):
            value, reference = float(values[m, i, k]), float(values[0, i, k])
            relative = (value - reference) / reference if reference else None
            error = None if errors is None else float(errors[i, k])
            where = (*first.rows.record(i), int(first.steps[k]))
            rows.append((*labels, *where, value, value - reference, relative, error))
    headings = (
        "method", "quantity", "stage", "nature", "metric", "unit", "agent", *first.rows.headings, "step", "value",
        "difference", "relative_difference", "standard_error",
    )  # fmt: skip
    return to_csv(headings, rows)


def compare_json(view: ComparisonView) -> dict[str, Any]:
    """Return the object of schema stochfuse.comparison/1."""
    p, first, values = view.comparison.reference, view.views[0], view.values()
    methods = {}
    for m, each in enumerate(view.views):
        errors = view.errors(m)
        methods[each.prediction.method] = {
            "nature": each.prediction.nature,
            "description": each.how,
            "values": listed(values[m]),
            "difference": listed(values[m] - values[0]),
            **({} if errors is None else {"standard_error": listed(errors)}),
            "meta": {"notes": list(each.prediction.notes), **each.prediction.meta},
        }
    return stamped(
        SCHEMA,
        quantity=p.quantity,
        metric=first.metric.name,
        reference=p.method,
        **first.rows.facts,
        steps=first.steps.tolist(),
        methods=methods,
        scenario=p.scenario.to_mapping(),
        meta={"description": list(view.titles), "stage": p.stage, "unit": first.unit or None, "agent": first.agent},
    )


def draw(view: ComparisonView) -> Any:
    """Return the figure: values, and beside them the differences from the reference."""
    p, first = view.comparison.reference, view.views[0]
    values, differences, errors = view.values(), view.differences(), [each.errors() for each in view.views]
    curves = first.rows.curves(first.steps)
    figure = canvas(11, 5.4)
    left, right = figure.subplots(1, 2)
    styles: list[dict[str, Any]] = [
        {"linestyle": ("-", "--", ":", "none")[m % 4], "marker": MARKERS[m], "markersize": 4}
        for m in range(len(view.views))
    ]
    for m, (style, error) in enumerate(zip(styles, errors, strict=True)):
        for curve in curves.shown():
            left.plot(curve.x, values[m][curve.pick], color=curve.color, **style)
            if m:
                scale = 100.0 / values[0][curve.pick] if view.relative else 1.0
                bars = None if error is None else WIDTH_95 * error[curve.pick] * scale
                right.errorbar(curve.x, differences[m][curve.pick], bars, color=curve.color, capsize=2, **style)
    right.axhline(0, color="0.3", linewidth=0.8)
    unit = " [%]" if view.relative else f" [{first.unit}]" if first.unit else ""
    labelled(left, curves.label, first.axis, whole=curves.whole, zero=np.nanmin(values) >= 0)
    labelled(right, curves.label, f"difference from {p.method}{unit}", whole=curves.whole)
    each = zip(view.comparison.predictions, styles, strict=True)
    below(figure, [*(entry(f"{q.method}, {q.nature}", color="0.2", **style) for q, style in each), *curves.entries()])
    bars = "; bars: 95 % confidence" if any(error is not None for error in errors) else ""
    titled(figure, first.what + (f", {curves.at}" if curves.at else ""), first.whom + bars)
    return figure


ESTIMATORS_SCHEMA = "stochfuse.estimators/1"
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
    # a ratio's error is left out, for room
    cells = [[each.cells(sure=each.prediction.quantity != "consistency") for each in views] for views in view.views]
    rows = []
    for i, there in enumerate(first.there):
        for k in np.flatnonzero(there)[slice(None) if stepwise else slice(-1, None)]:
            step = (str(first.steps[k]),) if stepwise else ()
            for estimator, shown in zip(view.comparison.estimators, cells, strict=True):
                rows.append((*first.rows.cells(i), *step, estimator, *(each[i][k] for each in shown)))
    columns = tuple("ratio" if q == "consistency" else q for q in view.quantities)
    return Table(view.titles, (*first.rows.keys, *(("k",) if stepwise else ()), "estimator"), columns, tuple(rows))


def estimator_csv(view: EstimatorView) -> str:
    """Return one record per estimator, quantity, link probability and step."""
    out = []
    for estimator, views in zip(view.comparison.estimators, view.views, strict=True):
        for each in views:
            first, *records = predict_csv(each).splitlines()
            out += [] if out else [f"estimator,{first}"]
            out += [f"{estimator},{record}" for record in records]
    return "\n".join(out) + "\n"


def estimator_json(view: EstimatorView) -> dict[str, Any]:
    """Return the object of schema stochfuse.estimators/1."""
    first, found = view.views[0][0], {}
    for p, views in zip(view.comparison.predictions, view.views, strict=True):
        quantities = {}
        for name, each in zip(view.quantities, views, strict=True):
            errors = each.errors()
            more = {} if errors is None else {"standard_error": listed(errors)}
            quantities[name] = {"values": listed(each.values()), **more}
        meta = {key: p.meta[key] for key in ("runs", "seed", "outcomes") if key in p.meta}
        meta |= {"notes": list(p.notes)}
        found[p.estimator] = {"method": p.method, "nature": p.nature, "quantities": quantities, "meta": meta}
    return stamped(
        ESTIMATORS_SCHEMA,
        metric=view.metric.name,
        **first.rows.facts,
        steps=first.steps.tolist(),
        estimators=found,
        scenario=first.prediction.scenario.to_mapping(),
        meta={
            "description": list(view.titles),
            "stage": first.prediction.stage,
            "unit": first.unit or None,
            "agent": view.agent,
            "left_out": list(view.comparison.left_out),
        },
    )


MOST_GROUPS = 4
"""Rows of panels, where what is swept has a second axis."""


def draw_estimators(view: EstimatorView) -> Any:
    """Return the figure: a panel for quantities with the metric's unit, one for the ratio; a row of them a group."""
    axis_of = [RATIO if q == "consistency" else view.views[0][c].axis for c, q in enumerate(view.quantities)]
    panels = list(dict.fromkeys(axis_of))
    first = view.views[0][0]
    curves, cases = _drawn(first)
    chosen = curves.shown()[:MOST_GROUPS]
    figure = canvas(2.0 + 4.6 * len(panels), 1.4 + 4.0 * len(chosen))
    grid = figure.subplots(len(chosen), len(panels), squeeze=False)
    looks = [{"color": COLORS[e % len(COLORS)], "marker": _marker(e)} for e in range(len(view.views))]
    for row, curve in zip(grid, chosen, strict=True):
        axes_of = dict(zip(panels, row, strict=True))
        for views, look in zip(view.views, looks, strict=True):
            for axis, quantity, each in zip(axis_of, view.quantities, views, strict=True):
                # cases are no sequence: claimed is a hollow marker there
                style = {**look, "linestyle": "" if cases else STYLES[quantity], "markersize": 5}
                if cases and quantity == "claimed":
                    style |= {"markersize": 9, "markerfacecolor": "none"}
                if len(curve.x) > MOST_MARKED:
                    style["marker"] = None
                axes_of[axis].plot(curve.x, each.values()[curve.pick], **style)
        for label, axes in axes_of.items():
            _finish(axes, label, curves, cases)
            if len(chosen) > 1:
                axes.set_title(curve.name, fontsize="small")
    each = zip(view.comparison.estimators, looks, strict=True)
    kinds = {q: q + " (hollow)" * (bool(cases) and q == "claimed") for q in view.quantities if q != "consistency"}
    below(
        figure,
        [
            *(entry(name, markersize=5, **look) for name, look in each),
            *(entry(name, color="0.2", linestyle=STYLES[q]) for q, name in kinds.items()),
        ],
    )
    titled(figure, f"What estimators claim and what is true, {curves.at or first.rows.name(0)}; {first.whom}")
    return figure


def _drawn(first: PredictionView) -> tuple[Curves, tuple[str, ...]]:
    """Along what estimators are drawn, and the cases if along these, one beside another."""
    cases = first.prediction.cases
    if cases is None or len(cases) == 1 or first.rows.over is not None:
        return first.rows.curves(first.steps, last=True), ()
    rows = np.arange(len(cases))
    return Curves([rows], "", [""], [(rows, -1)], "rows", at=f"after step {first.steps[-1]}"), cases


def _finish(axes: Any, label: str, curves: Curves, cases: Sequence[str]) -> None:
    labelled(axes, None if cases else curves.label, label, whole=curves.whole)
    if label == RATIO:
        axes.axhline(1.0, color="0.3", linewidth=0.8)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.9), max(high, 1.1))
    elif axes.get_ylim()[0] > 0:
        axes.set_ylim(bottom=0)
    if cases:
        axes.set_xticks(range(len(cases)), [wrapped(case, 16) for case in cases], fontsize="small")


def _marker(number: int) -> str:
    """Marker of a curve; together with its colour there is none like it among 64."""
    return MARKERS[(number + 3 * (number // len(COLORS))) % len(MARKERS)]
