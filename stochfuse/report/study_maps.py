"""Heat maps and contours of a study's values over two keys (matplotlib).

Cells of a heat map meet half way between neighbouring values, on a log axis at their geometric mean, and reach as far
outwards at the ends; contours go through the values themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.report.predictions import counted
from stochfuse.report.study_axes import BELOW, COLOURS, colour_bar, levels_of, norm_of, positions
from stochfuse.report.study_slices import Slice, distinct, is_log, places
from stochfuse.report.study_words import spoken
from stochfuse.report.table import number
from stochfuse.studies.axes import Axis

MOST_ACROSS, MOST_DOWN = 11, 16
"""Cells up to which each has its number written in it."""
MARGIN, APART = 0.03, 0.06
"""Shares of the axes: of the rim without labels, and of the distance between labels."""


def edges(values: Sequence[float] | np.ndarray, log: bool = False) -> np.ndarray:
    """Return the ends of the cells around rising values: half way between neighbours, of their logarithms if log."""
    centres = np.asarray(values, dtype=float)
    centres = np.log(centres) if log else centres
    if len(centres) == 1:
        found = centres[0] + np.array([-0.5, 0.5])
    else:
        half = np.diff(centres) / 2
        found = np.concatenate([[centres[0] - half[0]], centres[:-1] + half, [centres[-1] + half[-1]]])
    return np.exp(found) if log else found


def grid_of(shown: Slice) -> np.ma.MaskedArray:
    """Values of a grid over two keys, (values of the second, values of the first), masked where there is none."""
    x, y = (distinct(axis) for axis in shown.over)
    found = np.full((len(y), len(x)), np.nan)
    column, row = (places(axis, shown.data[axis.name]) for axis in shown.over)
    found[row, column] = shown.values
    return np.ma.masked_invalid(found)


def draw_heat(axes: Any, shown: Slice) -> None:
    """Draw a cell for each point of a grid, hatched where it failed, with its number in it where there is room."""
    values = grid_of(shown)
    ends = [edges(positions(axis), is_log(axis)) for axis in shown.over]
    inside = values.compressed()
    mesh = axes.pcolormesh(*ends, values, cmap=COLOURS, norm=norm_of(inside), rasterized=values.size > 2500)
    colour_bar(axes, mesh, inside, spoken(shown.plan, shown.column))
    missing = np.ma.getmaskarray(values)
    if missing.any():
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Patch

        style: dict[str, Any] = {"hatch": "xxx", "edgecolor": "0.35", "linewidth": 0}
        axes.pcolor(*ends, np.ma.masked_where(~missing, missing), cmap=ListedColormap(["white"]), **style)
        axes.legend(handles=[Patch(facecolor="white", label=lost(missing), **style)], **BELOW)
    if values.shape[1] <= MOST_ACROSS and values.shape[0] <= MOST_DOWN:
        _numbers(axes, shown, values, mesh)
    for which, end in zip("xy", ends, strict=True):
        axes.set(
            **{f"{which}lim": (end[-1], end[0]) if getattr(axes, f"{which}axis_inverted")() else (end[0], end[-1])}
        )


def lost(missing: np.ndarray) -> str:
    """How many points have no value, in words."""
    return f"no value: {counted(int(missing.sum()), 'point')} failed"


def _numbers(axes: Any, shown: Slice, values: np.ma.MaskedArray, mesh: Any) -> None:
    """Write each cell's number in it, black or white, whichever can be read."""
    x, y = (positions(axis) for axis in shown.over)
    for row, column in zip(*np.nonzero(~np.ma.getmaskarray(values)), strict=True):
        light = float(np.dot(mesh.cmap(mesh.norm(values[row, column]))[:3], (0.299, 0.587, 0.114)))
        text = number(float(values[row, column]), 3)
        colour = "black" if light > 0.5 else "white"
        axes.text(x[column], y[row], text, ha="center", va="center", fontsize=8, color=colour, clip_on=True)


def draw_contour(axes: Any, shown: Slice) -> None:
    """Draw lines of equal value over a grid, filled; failed points leave a hole with a cross in it.

    Raises
    ------
    UsageError
        If there are no such lines: one value along a key, or the same value everywhere.
    """
    values = grid_of(shown)
    x, y = (positions(axis) for axis in shown.over)
    inside = values.compressed()
    if min(values.shape) < 2 or inside.min() == inside.max():
        raise UsageError("kind: expected heat where values do not differ along both keys, got contour")
    levels = levels_of(inside)
    filled = axes.contourf(x, y, values, levels=levels, cmap=COLOURS, norm=norm_of(inside))
    label(axes, axes.contour(x, y, values, levels=levels, colors="black", linewidths=0.8))
    colour_bar(axes, filled, inside, spoken(shown.plan, shown.column))
    missing = np.ma.getmaskarray(values)
    if missing.any():
        row, column = np.nonzero(missing)
        axes.plot(x[column], y[row], "kx", markersize=7, label=lost(missing), clip_on=False)
        axes.legend(**BELOW)


def label(axes: Any, lines: Any) -> None:
    """Write its value on every line that has room for it, away from the rim and from other labels."""
    from matplotlib.patheffects import withStroke

    to_axes = axes.transData - axes.transAxes
    kept: list[np.ndarray] = []
    for text in axes.clabel(lines, fmt=lambda level: f"{level:.4g}", fontsize=8, inline=False):
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        place = to_axes.transform(text.get_position())
        near = any(np.hypot(*(place - other)) < APART for other in kept)
        if near or place.min() < MARGIN or place.max() > 1 - MARGIN:
            text.set_visible(False)
        else:
            kept.append(place)


def draw_triangles(axes: Any, shown: Slice, x: np.ndarray, y: np.ndarray) -> None:
    """Lay filled contours under scattered points, if two ranges vary and nothing else."""
    if shown.also or any(axis.values is not None for axis in shown.over) or len(np.unique(shown.values)) < 2:
        return
    from matplotlib.tri import Triangulation

    def unit(axis: Axis, v: np.ndarray) -> np.ndarray:
        v = np.log(v) if is_log(axis) else v
        return (v - v.min()) / (np.ptp(v) or 1.0)

    try:
        # Delaunay of the places on paper, since units of the keys differ
        triangles = Triangulation(unit(shown.over[0], x), unit(shown.over[1], y)).triangles
    except (RuntimeError, ValueError):  # fewer than three points, or all on one line
        return
    levels, found = levels_of(shown.values), Triangulation(x, y, triangles)
    axes.tricontourf(found, shown.values, levels=levels, cmap=COLOURS, norm=norm_of(shown.values))
    label(axes, axes.tricontour(found, shown.values, levels=levels, colors="black", linewidths=0.8))
