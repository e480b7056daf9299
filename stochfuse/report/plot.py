"""A prediction as a figure (matplotlib, extra `plot`)."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse.errors import StochfuseError
from stochfuse.report.export import write_file
from stochfuse.report.predictions import View

MOST_CURVES = 8
MARKERS = "osD^vP*X"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8A6D00")
"""Colours that the colour-blind can tell apart (Okabe and Ito), the yellow one darkened for print."""


def plot_prediction(view: View, output: Path) -> None:
    """Draw the values against link probability, one curve per step, or against the step where rows are cases.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    figure = draw(view)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def figure_class() -> Any:
    """Return matplotlib's Figure.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise StochfuseError("plots need matplotlib: pip install 'stochfuse[plot]'") from None
    return Figure


def draw(view: View):
    """Return the figure, not shown and not registered with pyplot."""
    Figure = figure_class()
    from matplotlib.ticker import MaxNLocator

    p, values = view.prediction, view.values()
    order = np.argsort(p.link)
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.add_subplot()
    if p.cases is None and len(p.link) > 1:
        chosen = spread(len(p.steps))
        curves = [(f"k = {p.steps[i]}", p.link[order], values[order, i]) for i in chosen]
        axes.set_xlabel("link probability µ")
        legend = "step" if len(chosen) == len(p.steps) else f"step ({len(chosen)} of {len(p.steps)})"
    else:
        chosen = spread(len(p.link))
        names = p.cases or [f"mean µ = {µ:.3g}" for µ in p.link]
        curves = [(names[i], p.steps, values[i]) for i in chosen]
        axes.set_xlabel("step k")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        legend = "links" if len(chosen) == len(p.link) else f"links ({len(chosen)} of {len(p.link)})"
    errors = view.errors()
    bars: list[Any] = [None] * len(curves)
    if errors is not None:
        against_link = p.cases is None and len(p.link) > 1
        bars = [1.96 * (errors[order, i] if against_link else errors[i]) for i in chosen]
    _draw_curves(axes, curves, bars)
    if view.statistic == "mean":
        axes.set_ylabel(view.axis)
    else:
        axes.set_ylabel("\n".join(wrap(view.what.partition(": ")[2].partition(" [no unit")[0], 45)))
    if values.min() >= 0:
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(title=legend, fontsize="small")
    figure.suptitle("\n".join(wrap(view.what, 80)), fontsize="medium")
    axes.set_title(
        "\n".join([view.whom, *wrap(view.how + ("; bars: 95 % confidence" if errors is not None else ""), 100)]),
        fontsize="small",
    )
    return figure


def _draw_curves(axes, curves: list[tuple[str, np.ndarray, np.ndarray]], bars: list[Any]) -> None:
    from matplotlib import colormaps

    colors = colormaps["viridis"](np.linspace(0, 0.9, len(curves)))
    for i, (label, x, y) in enumerate(curves):
        few = len(x) <= 30
        marker = MARKERS[i % len(MARKERS)] if few else None
        axes.errorbar(x, y, bars[i], color=colors[i], label=label, marker=marker, markersize=4, capsize=2)


def spread(n: int) -> list[int]:
    """At most `MOST_CURVES` indices out of n, first and last included."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, MOST_CURVES))})
