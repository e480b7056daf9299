"""Methods side by side as table, CSV, JSON and figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.comparison import Comparison
from stochfuse.report.export import write_file
from stochfuse.report.plot import MARKERS, figure_class, spread
from stochfuse.report.predictions import View
from stochfuse.report.table import Table, number, to_csv

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
    views: tuple[View, ...]
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


def compare_table(view: ComparisonView) -> Table:
    """Return rows of link probability and step, columns of methods."""
    p, digits = view.comparison.reference, view.views[0].digits
    values, differences = view.values(), view.differences()
    columns = [p.method, *(f"{m}, Δ{' %' if view.relative else ''}" for m in view.comparison.methods[1:])]
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        for k, step in enumerate(p.steps):
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
            for k, step in enumerate(p.steps):
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
        "steps": p.steps.tolist(),
        "methods": methods,
        "scenario": p.scenario.to_mapping(),
        "meta": {"description": list(view.titles), "stage": p.stage, "unit": first.unit or None, "agent": first.agent},
    }


def plot_comparison(view: ComparisonView, output: Path) -> None:
    """Draw values and differences against link probability (or step, where there is one row), colour by step."""
    figure = draw(view)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def draw(view: ComparisonView):
    """Return the figure."""
    from matplotlib import colormaps
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    p, first = view.comparison.reference, view.views[0]
    values, differences = view.values(), view.differences()
    against_link = p.cases is None and len(p.link) > 1
    if against_link:
        order = np.argsort(p.link)
        x, along = p.link[order], lambda a, c: a[order, c]
        chosen, names = spread(len(p.steps)), [f"k = {k}" for k in p.steps]
    else:
        x, along = p.steps, lambda a, c: a[c]
        chosen, names = spread(len(p.link)), list(p.cases or [f"mean µ = {µ:.3g}" for µ in p.link])
    figure = figure_class()(figsize=(11, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colors = colormaps["viridis"](np.linspace(0, 0.9, len(chosen)))
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
    left.legend(handles=[*methods, *steps], fontsize="small", ncols=2)
    bars = "; bars: 95 % confidence" if any(view.errors(m) is not None for m in range(len(view.views))) else ""
    figure.suptitle("\n".join(wrap(first.what, 100)) + f"\n{first.whom}{bars}", fontsize="medium")
    return figure
