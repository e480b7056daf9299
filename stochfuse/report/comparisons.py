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
    values, differences = view.values(), view.differences()
    columns = [p.method, *(f"{m}, Δ{' %' if view.relative else ''}" for m in view.comparison.methods[1:])]
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        for k, step in enumerate(view.views[0].steps):
            cells = []
            for m, value in enumerate(values[:, i, k]):
                difference = f" {_signed(differences[m, i, k], value, digits)}" if m else ""
                cells.append(number(value, digits) + difference + _error(view, m, i, k))
            rows.append((*name, f"{µ:.6g}", str(step), *cells))
    keys = ("µ", "k") if p.cases is None else ("links", "mean µ", "k")
    return Table(view.titles, keys, tuple(columns), tuple(rows))


def _signed(difference: float, value: float, digits: int) -> str:
    """A difference with its sign; what is no more than rounding is nothing."""
    return f"{difference:+.{max(2, digits - 2)}g}" if abs(difference) > 1e-12 * abs(value) else "0"


def _error(view: ComparisonView, method: int, row: int, step: int) -> str:
    errors = view.errors(method)
    if errors is None:
        return ""
    scale = 100.0 / view.values()[0, row, step] if view.relative and method else 1.0
    return f" ±{scale * errors[row, step]:.2g}"


def compare_csv(view: ComparisonView) -> str:
    """One line per method, link probability and step."""
    p, first = view.comparison.reference, view.views[0]
    values = view.values()
    rows = []
    for m, each in enumerate(view.views):
        errors = view.errors(m)
        for i, µ in enumerate(p.link):
            case = "" if p.cases is None else p.cases[i]
            for k, step in enumerate(first.steps):
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
                        case,
                        float(µ),
                        int(step),
                        float(values[m, i, k]),
                        float(difference),
                        float(difference / values[0, i, k]) if values[0, i, k] else "",
                        "" if errors is None else float(errors[i, k]),
                    )
                )
    headings = (
        "method", "quantity", "stage", "nature", "metric", "unit", "agent", "case", "link", "step", "value",
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
            "values": values[m].tolist(),
            "difference": (values[m] - values[0]).tolist(),
            **({} if errors is None else {"standard_error": errors.tolist()}),
            "meta": {"notes": list(each.prediction.notes), **each.prediction.meta},
        }
    return {
        "schema": SCHEMA,
        "version": __version__,
        "quantity": p.quantity,
        "metric": first.metric.name,
        "reference": p.method,
        "link": p.link.tolist(),
        **({} if p.cases is None else {"cases": list(p.cases)}),
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
    against_link = p.cases is None and len(p.link) > 1
    if against_link:
        order = np.argsort(p.link)
        x, along = p.link[order], lambda a, c: a[order, c]
        chosen, names = spread(len(first.steps)), [f"k = {k}" for k in first.steps]
    else:
        x, along = first.steps, lambda a, c: a[c]
        chosen, names = spread(len(p.link)), list(p.cases or [f"mean µ = {µ:.3g}" for µ in p.link])
    figure = figure_class()(figsize=(11, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colors = shades(len(chosen))
    styles: list[Any] = ["-", "--", ":", "none"]
    for m in range(len(view.views)):
        errors = view.errors(m)
        style: dict[str, Any] = {"linestyle": styles[m % 4], "marker": MARKERS[m], "markersize": 4}
        for c, color in zip(chosen, colors, strict=True):
            left.plot(x, along(values[m], c), color=color, **style)
            if m and errors is None:
                right.plot(x, along(differences[m], c), color=color, **style)
            elif m:
                scale = 100.0 / along(values[0], c) if view.relative else 1.0
                bars = 1.96 * along(errors, c) * scale
                right.errorbar(x, along(differences[m], c), bars, color=color, capsize=2, **style)
    unit = f" [{first.unit}]" if first.unit else ""
    left.set_ylabel(first.axis)
    if values.min() >= 0:
        left.set_ylim(bottom=0)
    right.axhline(0, color="0.3", linewidth=0.8)
    right.set_ylabel(f"difference from {p.method}" + (" [%]" if view.relative else unit))
    for axes in (left, right):
        axes.set_xlabel("link probability µ" if against_link else "step k")
        if not against_link:
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
    steps = [Line2D([], [], color=color, linewidth=3, label=names[c]) for c, color in zip(chosen, colors, strict=True)]
    below(figure, [*methods, *steps])
    bars = "; bars: 95 % confidence" if any(view.errors(m) is not None for m in range(len(view.views))) else ""
    titled(figure, first.what, first.whom + bars)
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
        return [p for p in self.comparison.predictions if p.sampled is not None]


def estimator_report(view: EstimatorView) -> Report:
    """Return estimators side by side in every form."""
    return Report.of(view, estimator_table, estimator_csv, estimator_json, draw_estimators)


def estimator_table(view: EstimatorView) -> Table:
    """Return rows of link probability, step and estimator, columns of quantities."""
    p = view.comparison.predictions[0]
    steps, stepwise = view.views[0][0].steps, view.every_step or view.at is not None
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        for k in range(len(steps)) if stepwise else [len(steps) - 1]:
            for estimator, values, errors in zip(view.comparison.estimators, view.values, view.errors, strict=True):
                cells = [
                    number(value[i, k], view.digits)
                    + ("" if error is None or quantity == "consistency" else f" ±{error[i, k]:.2g}")
                    for quantity, value, error in zip(view.quantities, values, errors, strict=True)
                ]
                step = (str(steps[k]),) if stepwise else ()
                rows.append((*name, f"{µ:.6g}", *step, estimator, *cells))
    keys = ("µ",) if p.cases is None else ("links", "mean µ")
    columns = tuple("ratio" if q == "consistency" else q for q in view.quantities)
    return Table(view.titles, (*keys, *(("k",) if stepwise else ()), "estimator"), columns, tuple(rows))


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
            quantities[name] = {"values": value.tolist()}
            if error is not None:
                quantities[name]["standard_error"] = error.tolist()
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
        "link": p.link.tolist(),
        **({} if p.cases is None else {"cases": list(p.cases)}),
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


def draw_estimators(view: EstimatorView):
    """Return the figure: a panel for quantities with the metric's unit, one for the ratio."""
    Figure = figure_class()
    from matplotlib.lines import Line2D

    p = view.comparison.predictions[0]
    axis_of = [RATIO if q == "consistency" else view.views[0][c].axis for c, q in enumerate(view.quantities)]
    panels = list(dict.fromkeys(axis_of))
    figure = Figure(figsize=(2.0 + 4.6 * len(panels), 5.4), layout="constrained")
    axes_of = dict(zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True))
    colors = [COLORS[e % len(COLORS)] for e in range(len(view.values))]
    over_rows = len(p.link) > 1
    order = np.argsort(p.link, kind="stable") if p.cases is None else np.arange(len(p.link))
    steps = view.views[0][0].steps
    x = steps if not over_rows else p.link[order] if p.cases is None else order
    for e, (values, color) in enumerate(zip(view.values, colors, strict=True)):
        for c, quantity in enumerate(view.quantities):
            y = values[c][order, -1] if over_rows else values[c][0]
            style = "" if over_rows and p.cases is not None else STYLES[quantity]
            # cases are no sequence: claimed is a hollow marker there
            face = "none" if not style and quantity == "claimed" else color
            marker = _marker(e) if len(x) <= 30 else None
            size = 9 if not style and quantity == "claimed" else 5
            axes_of[axis_of[c]].plot(
                x, y, color=color, linestyle=style, marker=marker, markersize=size, markerfacecolor=face
            )
    for label, axes in axes_of.items():
        _finish(axes, label, view, over_rows)
    names = [
        Line2D([], [], color=color, marker=_marker(e), markersize=5, label=name)
        for e, (name, color) in enumerate(zip(view.comparison.estimators, colors, strict=True))
    ]
    hollow = over_rows and p.cases is not None
    kinds = [
        Line2D([], [], color="0.2", linestyle=STYLES[q], label=q + " (hollow)" * (hollow and q == "claimed"))
        for q in view.quantities
        if q != "consistency"
    ]
    below(figure, [*names, *kinds])
    where = f"after step {steps[-1]}" if over_rows else p.cases[0] if p.cases else f"µ = {p.link[0]:.3g}"
    title = f"What estimators claim and what is true, {where}; {view.views[0][0].whom}"
    titled(figure, title)
    return figure


def _finish(axes: Any, label: str, view: EstimatorView, over_rows: bool) -> None:
    from matplotlib.ticker import MaxNLocator

    p = view.comparison.predictions[0]
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if label == RATIO:
        axes.axhline(1.0, color="0.3", linewidth=0.8)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.9), max(high, 1.1))
    elif axes.get_ylim()[0] > 0:
        axes.set_ylim(bottom=0)
    if over_rows and p.cases is not None:
        axes.set_xticks(range(len(p.cases)), ["\n".join(wrap(case, 16)) for case in p.cases], fontsize="small")
    else:
        axes.set_xlabel("link probability µ" if over_rows else "step k")
    if not over_rows:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _marker(number: int) -> str:
    """Marker of a curve; together with its colour there is none like it among 64."""
    return MARKERS[(number + 3 * (number // len(COLORS))) % len(MARKERS)]
