"""A study's values over one or two keys as a figure (matplotlib, extra `plot`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.report.export import write_file
from stochfuse.report.front_plots import plot_pareto
from stochfuse.report.plot import COLORS, MARKERS, figure_class, spread
from stochfuse.report.predictions import counted
from stochfuse.report.study_axes import (
    BELOW,
    COLOURS,
    SMALL,
    colour_bar,
    dress,
    groups_of,
    natures_of,
    norm_of,
    positions,
    wide,
    wrapped,
)
from stochfuse.report.study_maps import draw_contour, draw_heat, draw_triangles, lost
from stochfuse.report.study_slices import Slice, distinct, is_text, places, sliced
from stochfuse.report.study_words import shortened, spoken, whose, words_of

if TYPE_CHECKING:
    from stochfuse.studies.results import Results

__all__ = ["draw", "plot_over", "plot_pareto"]

KINDS = ("heat", "contour")
STYLES = ("-", "--", ":", "-.")
MANY = 1000
"""Scattered points from which on they are drawn small, and as pixels even in vector files."""


def plot_over(
    results: Results,
    keys: Sequence[str] | None,
    column: str | None,
    kind: str,
    where: Mapping[str, Any] | None,
    step: int | None,
    file: Path,
) -> None:
    """Draw a value column over one or two keys into a PNG, SVG or PDF file.

    Parameters
    ----------
    results, keys, column, where, step : see `stochfuse.report.study_slices.sliced`.
    kind : over two keys of a grid "heat", a cell for each point, or "contour", lines of equal value.  Points of lists
        and Latin hypercubes are scattered; filled contours are laid under them where two ranges vary and nothing else.

    Raises
    ------
    UsageError
        If a name or value is unknown, a key of a grid varies that is neither shown nor fixed, contours are asked for
        over words, or the file cannot be written.
    NoAnswerError
        If no point has a value.
    StochfuseError
        If matplotlib is not installed.
    """
    figure = draw(results, keys, column, kind, where, step)
    write_file(file, lambda path: figure.savefig(path, dpi=150))


def draw(
    results: Results,
    keys: Sequence[str] | None = None,
    column: str | None = None,
    kind: str = "heat",
    where: Mapping[str, Any] | None = None,
    step: int | None = None,
) -> Any:
    """Return the figure that `plot_over` writes."""
    Figure = figure_class()
    if kind not in KINDS:
        raise UsageError(f"kind: expected {' or '.join(KINDS)}, got {kind}")
    shown = sliced(results, keys, column, where, step)
    if kind == "contour":
        _check_contours(shown)
    figure = Figure(figsize=(7.5, 5.6), layout="constrained")
    axes = figure.add_subplot()
    # scales first: labels of contours are placed on them
    for which, axis in zip("xy", shown.over, strict=False):
        dress(axes, which, axis)
    if shown.plan.kind != "grid":
        _scatter(axes, shown)
    elif len(shown.over) == 1:
        _lines(axes, shown)
    else:
        (draw_heat if kind == "heat" else draw_contour)(axes, shown)
    title = spoken(shown.plan, shown.column)
    figure.suptitle(wrapped(title[0].upper() + title[1:], 80), fontsize="medium")
    axes.set_title("\n".join(wrapped(text, 95) for text in _about(shown)), fontsize=SMALL)
    return figure


def _check_contours(shown: Slice) -> None:
    if len(shown.over) < 2:
        raise UsageError(f"kind: expected heat over one key ({', '.join(a.name for a in shown.over)}), got contour")
    for axis in shown.over:
        if is_text(axis):
            raise UsageError(f"kind: expected heat over {axis.name}, whose values are words, got contour")


def _scatter(axes: Any, shown: Slice) -> None:
    """Draw the points of a list or Latin hypercube, coloured by value over two keys."""
    x = positions(shown.over[0], shown.data[shown.over[0].name])
    many = len(x) > MANY
    groups = groups_of(shown.data, shown.marked)
    if len(shown.over) == 1:
        for i, (name, there) in enumerate(groups):
            style: dict[str, Any] = {"s": 8 if many else 22, "color": COLORS[i % len(COLORS)], "rasterized": many}
            axes.scatter(x[there], shown.values[there], marker=MARKERS[i % len(MARKERS)], label=name, **style)
        _value_axis(axes, shown)
    else:
        y = positions(shown.over[1], shown.data[shown.over[1].name])
        draw_triangles(axes, shown, x, y)
        style = {"s": 9 if many else 30, "linewidth": 0.0 if many else 0.5, "edgecolor": "black", "cmap": COLOURS}
        style |= {"norm": norm_of(shown.values), "rasterized": many}
        drawn = []
        for i, (name, there) in enumerate(groups):
            style |= {"c": shown.values[there], "marker": MARKERS[i % len(MARKERS)]}
            drawn.append(axes.scatter(x[there], y[there], label=name, **style))
        colour_bar(axes, drawn[0], shown.values, spoken(shown.plan, shown.column))
    if shown.marked:
        legend = axes.legend(title=shown.marked, ncols=4, **BELOW)
        for handle in legend.legend_handles:
            handle.set(sizes=[30])
            if len(shown.over) == 2:
                handle.set(facecolor="0.5", array=None)


def _lines(axes: Any, shown: Slice) -> None:
    """Draw a line over one key of a grid, or one for each value of another key."""
    axis, other = shown.over[0], shown.also[0] if shown.also else None
    listed: list[Any] = [None] if other is None else distinct(other)
    chosen = spread(len(listed))
    at, x = places(axis, shown.data[axis.name]), positions(axis)
    gone = np.zeros((len(chosen), len(x)), dtype=bool)
    for i, c in enumerate(chosen):
        there = np.ones(len(at), dtype=bool) if other is None else shown.data[other.name] == listed[c]
        y = np.full(len(x), np.nan)
        y[at[there]] = shown.values[there]
        gone[i] = np.isnan(y)
        style: dict[str, Any] = {"color": COLORS[i], "marker": MARKERS[i] if len(x) <= 40 else None, "markersize": 5}
        style["linestyle"] = "none" if is_text(axis) else STYLES[i % len(STYLES)]
        axes.plot(x, y, label=shortened(listed[c], words_of(listed)) if other else None, **style)
    if gone.any():
        some = x[gone.any(axis=0)]
        foot = {"transform": axes.get_xaxis_transform(), "clip_on": False}
        axes.plot(some, np.full(len(some), 0.02), "kx", label=lost(gone), **foot)
    if other is not None or gone.any():
        left_out = f" ({len(chosen)} of {len(listed)})" if len(chosen) < len(listed) else ""
        axes.legend(title=None if other is None else other.name + left_out, fontsize=SMALL)
    _value_axis(axes, shown)


def _value_axis(axes: Any, shown: Slice) -> None:
    axes.set_ylabel(wrapped(spoken(shown.plan, shown.column), 50))
    axes.grid(alpha=0.3)
    if wide(shown.values):
        axes.set_yscale("log")
    elif shown.values.min() >= 0:
        axes.set_ylim(bottom=0)


def _about(shown: Slice) -> list[str]:
    """Which study; when, how and how exact; what else there is."""
    plan, steps = shown.plan, shown.data["step"]
    first, last = int(steps.min()), int(steps.max())
    when = f"after step {first}" if first == last else f"after each point's last step ({first} to {last})"
    fixed = [f"{name} = {shortened(value)}" for name, value in shown.fixed.items()]
    lines = [f"Study {plan.name}, scenario {plan.scenario_name}; {whose(plan)}"]
    lines.append("; ".join([when, *fixed, natures_of(shown.data)]))
    unseen = [axis.name for axis in shown.also if axis.name != shown.marked]
    more = [f"also varying: {', '.join(unseen)}"] if unseen and plan.kind != "grid" else []
    more += [f"about one of {shown.one_in} points drawn"] if shown.one_in > 1 else []
    more += [f"{counted(shown.failed, 'failed point')} not drawn"] if shown.failed and plan.kind != "grid" else []
    return [*lines, "; ".join(more)] if more else lines
