"""Several quantities of one prediction side by side: claimed beside actual, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse.report import predictions
from stochfuse.report.export import write_file
from stochfuse.report.plot import MARKERS, figure_class, spread
from stochfuse.report.predictions import View
from stochfuse.report.table import Table, number

STYLES = ("-", "--", ":", "-.")
RATIO = "actual / claimed"


def side_table(views: Sequence[View]) -> Table:
    """Return rows of link probability and step, columns of quantities."""
    p = views[0].prediction
    values, errors = [view.values() for view in views], [view.errors() for view in views]
    rows = []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        for k, step in enumerate(p.steps):
            cells = [
                number(value[i, k], views[0].digits) + ("" if error is None else f" ±{error[i, k]:.2g}")
                for value, error in zip(values, errors, strict=True)
            ]
            rows.append((*name, f"{µ:.6g}", str(step), *cells))
    keys = ("µ", "k") if p.cases is None else ("links", "mean µ", "k")
    how = dict.fromkeys(view.how for view in views)
    titles = (*(view.what for view in views), views[0].whom, *how)
    return Table(titles, keys, tuple(view.prediction.quantity for view in views), tuple(rows))


def side_csv(views: Sequence[View]) -> str:
    """Return the records of one quantity after the other."""
    first, *others = (predictions.predict_csv(view) for view in views)
    return first + "".join(text.partition("\n")[2] for text in others)


def side_json(views: Sequence[View]) -> dict[str, Any]:
    """Return the object of the first quantity, with all of them under `quantities`."""
    each = {view.prediction.quantity: predictions.predict_json(view) for view in views}
    kept = ("values", "standard_error", "interval", "bernstein")
    return {
        **each[views[0].prediction.quantity],
        "quantities": {
            name: {
                **{key: found[key] for key in kept if key in found},
                **{key: found["meta"][key] for key in ("description", "nature", "unit")},
            }
            for name, found in each.items()
        },
    }


def plot_side(views: Sequence[View], output: Path) -> None:
    """Draw the quantities against link probability, colour by step, or against the step where there is one row."""
    figure = draw(views)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def draw(views: Sequence[View]):
    """Return the figure, one panel for each unit."""
    from matplotlib import colormaps
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MaxNLocator

    p = views[0].prediction
    against_link = p.cases is None and len(p.link) > 1
    order = np.argsort(p.link)
    chosen = spread(len(p.steps)) if against_link else spread(len(p.link))
    names = [f"k = {k}" for k in p.steps] if against_link else list(p.cases or [f"mean µ = {µ:.3g}" for µ in p.link])
    units = list(dict.fromkeys(_axis(view) for view in views))
    figure = figure_class()(figsize=(1.5 + 5.0 * len(units), 5.2), layout="constrained")
    panels = dict(zip(units, figure.subplots(1, len(units), squeeze=False)[0], strict=True))
    colors = colormaps["viridis"](np.linspace(0, 0.9, len(chosen)))
    for v, view in enumerate(views):
        axes, values, errors = panels[_axis(view)], view.values(), view.errors()
        for c, color in zip(chosen, colors, strict=True):
            x, y = (p.link[order], values[order, c]) if against_link else (p.steps, values[c])
            bars = None if errors is None else 1.96 * (errors[order, c] if against_link else errors[c])
            marker = MARKERS[v] if len(x) <= 30 else None
            axes.errorbar(x, y, bars, color=color, linestyle=STYLES[v % 4], marker=marker, markersize=4, capsize=2)
    for label, axes in panels.items():
        axes.set_ylabel(label)
        axes.set_xlabel("link probability µ" if against_link else "step k")
        if not against_link:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if label != RATIO and all(view.values().min() >= 0 for view in views if _axis(view) == label):
            axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    quantities = [
        Line2D(
            [], [], color="0.2", linestyle=STYLES[v % 4], marker=MARKERS[v], markersize=4, label=w.prediction.quantity
        )
        for v, w in enumerate(views)
    ]
    curves = [Line2D([], [], color=color, linewidth=3, label=names[c]) for c, color in zip(chosen, colors, strict=True)]
    panels[units[0]].legend(handles=[*quantities, *curves], fontsize="small", ncols=2)
    sampled = "; bars: 95 % confidence" if p.sampled is not None else ""
    how = [line for view in dict.fromkeys(v.how for v in views) for line in wrap(view + sampled, 50 * len(units) + 30)]
    what = f"expected {p.stage} covariances and errors"
    figure.suptitle("\n".join([f"{views[0].whom}; {what}", *how]), fontsize="medium")
    return figure


def _axis(view: View) -> str:
    return RATIO if view.prediction.quantity == "consistency" else view.axis
