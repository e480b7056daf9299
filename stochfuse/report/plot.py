"""A prediction as a figure (matplotlib, extra `plot`)."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap

import numpy as np

from stochfuse.errors import StochfuseError
from stochfuse.report.export import write_file
from stochfuse.report.predictions import View

MOST_CURVES = 8
_MARKERS = "osD^vP*X"


def plot_prediction(view: View, output: Path) -> None:
    """Draw the values against link probability, one curve per step, or against the step where rows are cases.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    figure = draw(view)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def draw(view: View):
    """Return the figure, not shown and not registered with pyplot."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator
    except ImportError:
        raise StochfuseError("plots need matplotlib: pip install 'stochfuse[plot]'") from None
    p, values = view.prediction, view.values()
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.add_subplot()
    if p.cases is None and len(p.link) > 1:
        chosen = _spread(len(p.steps))
        order = np.argsort(p.link)
        curves = [(f"k = {p.steps[i]}", p.link[order], values[order, i]) for i in chosen]
        axes.set_xlabel("link probability µ")
        legend = "step" if len(chosen) == len(p.steps) else f"step ({len(chosen)} of {len(p.steps)})"
    else:
        chosen = _spread(len(p.link))
        names = p.cases or [f"mean µ = {µ:.3g}" for µ in p.link]
        curves = [(names[i], p.steps, values[i]) for i in chosen]
        axes.set_xlabel("step k")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        legend = "links" if len(chosen) == len(p.link) else f"links ({len(chosen)} of {len(p.link)})"
    _draw_curves(axes, curves)
    short = view.metric.label.partition(" (")[0]
    axes.set_ylabel(short + (f" [{view.unit}]" if view.unit else ", relative to µ = 0" if view.baseline else ""))
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(title=legend, fontsize="small")
    figure.suptitle("\n".join(wrap(view.what, 80)), fontsize="medium")
    axes.set_title(f"{view.whom}\n{view.how}", fontsize="small")
    return figure


def _draw_curves(axes, curves: list[tuple[str, np.ndarray, np.ndarray]]) -> None:
    from matplotlib import colormaps

    colors = colormaps["viridis"](np.linspace(0, 0.9, len(curves)))
    for i, (label, x, y) in enumerate(curves):
        few = len(x) <= 30
        axes.plot(x, y, color=colors[i], label=label, marker=_MARKERS[i % len(_MARKERS)] if few else None, markersize=4)


def _spread(n: int) -> list[int]:
    """At most `MOST_CURVES` indices out of n, first and last included."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, MOST_CURVES))})
