"""Estimators side by side: what each claims beside what is true, as table, CSV, JSON and figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.comparison import EstimatorComparison
from stochfuse.metrics import Metric
from stochfuse.report import predictions
from stochfuse.report.export import write_file
from stochfuse.report.plot import COLORS, MARKERS, figure_class
from stochfuse.report.predictions import View
from stochfuse.report.table import Table, number

SCHEMA = "stochfuse.estimators/1"
RATIO = "actual / claimed"
STYLES: dict[str, Any] = {"claimed": "--", "actual": "-", "consistency": "-", "bias": ":", "rms": "-."}


@dataclass(frozen=True)
class EstimatorView:
    """What of a comparison of estimators is shown.

    Parameters
    ----------
    comparison : the comparison.
    metric, agent, digits : as for `View`.
    quantities : one column each.
    every_step : whether the table shows every step, or only the last.
    """

    comparison: EstimatorComparison
    metric: Metric
    agent: int | str = "mean"
    digits: int = 5
    quantities: Sequence[str] = ("claimed", "actual", "consistency")
    every_step: bool = False

    @cached_property
    def views(self) -> list[list[View]]:
        """A view of every quantity of every estimator."""
        return [
            [View(p.shown_as(q), self.metric, self.agent, None, self.digits) for q in self.quantities]
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
        step = "" if self.every_step else f"after step {self.comparison.predictions[0].steps[-1]}, "
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


def estimator_table(view: EstimatorView) -> Table:
    """Return rows of link probability, step and estimator, columns of quantities."""
    p = view.comparison.predictions[0]
    steps = range(len(p.steps)) if view.every_step else [len(p.steps) - 1]
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        for k in steps:
            for estimator, values, errors in zip(view.comparison.estimators, view.values, view.errors, strict=True):
                cells = [
                    number(value[i, k], view.digits)
                    + ("" if error is None or quantity == "consistency" else f" ±{error[i, k]:.2g}")
                    for quantity, value, error in zip(view.quantities, values, errors, strict=True)
                ]
                step = (str(p.steps[k]),) if view.every_step else ()
                rows.append((*name, f"{µ:.6g}", *step, estimator, *cells))
    keys = ("µ",) if p.cases is None else ("links", "mean µ")
    columns = tuple("ratio" if q == "consistency" else q for q in view.quantities)
    return Table(view.titles, (*keys, *(("k",) if view.every_step else ()), "estimator"), columns, tuple(rows))


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
        "schema": SCHEMA,
        "version": __version__,
        "metric": view.metric.name,
        "link": p.link.tolist(),
        **({} if p.cases is None else {"cases": list(p.cases)}),
        "steps": p.steps.tolist(),
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


def plot_estimators(view: EstimatorView, output: Path) -> None:
    """Draw what is claimed and what is true after the last step, against link probability or case, or a row's steps."""
    figure = draw(view)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def draw(view: EstimatorView):
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
    x = p.steps if not over_rows else p.link[order] if p.cases is None else order
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
    figure.legend(handles=[*names, *kinds], fontsize="small", loc="outside lower center", ncols=4)
    where = f"after step {p.steps[-1]}" if over_rows else p.cases[0] if p.cases else f"µ = {p.link[0]:.3g}"
    title = f"What estimators claim and what is true, {where}; {view.views[0][0].whom}"
    lines = wrap(title, 45 * len(panels) + 15, break_on_hyphens=False)
    figure.suptitle("\n".join(lines), fontsize="medium")
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
