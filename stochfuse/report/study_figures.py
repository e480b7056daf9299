"""A study's values over one or two keys, and accuracy against message load, as figures (matplotlib, extra `plot`).

Colours are those of cividis, which rise in lightness alone: they are the same in grey print and to the colour-blind.
Cells of a heat map meet half way between neighbouring values, on a log axis at their geometric mean, and reach as far
outwards at the ends; contours go through the values themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.report import studies
from stochfuse.report.plot import COLORS, DASHES, MARKERS, canvas, labelled, spread, wrapped
from stochfuse.report.rows import whose
from stochfuse.report.studies import LONGEST, load_label, shortened, spoken, words_of
from stochfuse.report.study_slices import (
    MARKED,
    MOST_DRAWN,
    Slice,
    distinct,
    is_log,
    is_text,
    places,
    size_of,
    sliced,
    thinned,
)
from stochfuse.report.table import Report, counted, number
from stochfuse.studies.pareto import ParetoFront
from stochfuse.studies.plan import NODES, Axis, Plan

if TYPE_CHECKING:
    from stochfuse.studies.files import Results


KINDS = ("heat", "contour")
SIZE = (7.5, 5.6)
MANY = 1000
"""Scattered points from which on they are drawn small, and as pixels even in vector files."""


COLOURS = "cividis"
RATIO = 30.0
"""Ratio of the greatest to the least number above which they are drawn on a log scale."""
SMALL = 9
"""Points of the smaller print."""
BELOW: dict[str, Any] = {"fontsize": SMALL, "loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "frameon": False}
"""A legend below the axes, where it hides nothing."""
MOST_TICKS = 14
NAMES = {
    "network.link": "link probability µ",
    "network.agents": "number of agents",
    "network.steps": "number of steps",
    "network.architecture": "architecture",
    "model.R": "measurement noise R",
    "model.Q": "process noise Q",
    "initial.P": "initial covariance P(k0)",
}
MOST_ACROSS, MOST_DOWN = 11, 16
"""Cells up to which each has its number written in it."""
MARGIN, APART = 0.03, 0.06
"""Shares of the axes: of the rim without labels, and of the distance between labels."""
MANY_POINTS = 500
"""Points of a front's figure from which on they are drawn small, and as pixels even in vector files."""
NUMBERS_APART, DIGIT = 0.02, 0.013
"""Shares of the axes: between the numbers of points, and of the width of a digit."""


def summary_report(results: Results, digits: int, drawn: tuple[Any, ...] = ()) -> Report:
    """Return what a study found in every form.

    Parameters
    ----------
    drawn : keys, column, kind, fixed values and step of the figure, see `draw`.
    """
    table = partial(studies.summary_table, digits=digits)
    return Report.of(results, table, studies.summary_csv, studies.summary_json, lambda _: draw(results, *drawn))


def pareto_report(found: ParetoFront, results: Results, digits: int) -> Report:
    """Return a Pareto front in every form."""
    return Report(
        partial(studies.pareto_table, found, results, digits),
        partial(studies.pareto_csv, found, results),
        partial(studies.pareto_json, found, results),
        partial(draw_pareto, found, results),
    )


def draw(
    results: Results,
    keys: Sequence[str] | None = None,
    column: str | None = None,
    kind: str = "heat",
    where: Mapping[str, Any] | None = None,
    step: int | None = None,
) -> Any:
    """Draw a value column over one or two keys, and return the figure.

    Parameters
    ----------
    results, keys, column, where, step : see `stochfuse.report.study_slices.sliced`.
    kind : over two keys of a grid "heat", a cell for each point, or "contour", lines of equal value.  Points of lists
        and Latin hypercubes are scattered; filled contours are laid under them where two ranges vary and nothing else.

    Raises
    ------
    UsageError
        If a name or value is unknown, a key of a grid varies that is neither shown nor fixed, or contours are asked for
        over words.
    NoAnswerError
        If no point has a value.
    StochfuseError
        If matplotlib is not installed.
    """
    if kind not in KINDS:
        raise UsageError(f"kind: expected {' or '.join(KINDS)}, got {kind}")
    shown = sliced(results, keys, column, where, step)
    if kind == "contour":
        _check_contours(shown)
    figure = canvas(*SIZE)
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
    _entitle(axes, spoken(shown.plan, shown.column), shown.plan, _about(shown))
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
    over_two, many = len(shown.over) == 2, len(x) > MANY
    style: dict[str, Any] = {"s": 8 if many else 22, "rasterized": many}
    if over_two:
        y = positions(shown.over[1], shown.data[shown.over[1].name])
        draw_triangles(axes, shown, x, y)
        style |= {"s": 9 if many else 30, "linewidth": 0.0 if many else 0.5, "edgecolor": "black"}
        style |= {"cmap": COLOURS, "norm": norm_of(shown.values)}
    else:
        y = shown.values
    drawn = []
    for i, (name, there) in enumerate(groups_of(shown.data, shown.marked)):
        colour = {"c": shown.values[there]} if over_two else {"color": COLORS[i % len(COLORS)]}
        drawn.append(axes.scatter(x[there], y[there], marker=MARKERS[i % len(MARKERS)], label=name, **colour, **style))
    if over_two:
        colour_bar(axes, drawn[0], shown.values, spoken(shown.plan, shown.column))
    else:
        _value_axis(axes, shown)
    if shown.marked:
        legend = axes.legend(title=shown.marked, ncols=4, **BELOW)
        for handle in legend.legend_handles:
            handle.set(sizes=[30], **({"facecolor": "0.5", "array": None} if over_two else {}))


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
        style["linestyle"] = "none" if is_text(axis) else DASHES[i % len(DASHES)]
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
    if wide(shown.values):
        axes.set_yscale("log")
    zero = not wide(shown.values) and shown.values.min() >= 0
    labelled(axes, None, wrapped(spoken(shown.plan, shown.column), 50), zero=zero)


def _about(shown: Slice) -> list[str]:
    """When, how and how exact it is; what else there is."""
    plan, steps = shown.plan, shown.data["step"]
    first, last = int(steps.min()), int(steps.max())
    when = f"after step {first}" if first == last else f"after each point's last step ({first} to {last})"
    fixed = [f"{name} = {shortened(value)}" for name, value in shown.fixed.items()]
    unseen = [axis.name for axis in shown.also if axis.name != shown.marked]
    more = [f"also varying: {', '.join(unseen)}"] if unseen and plan.kind != "grid" else []
    more += [f"about one of {shown.one_in} points drawn"] if shown.one_in > 1 else []
    more += [_not_drawn(shown.failed)] if shown.failed and plan.kind != "grid" else []
    return ["; ".join([when, *fixed, natures_of(shown.data)]), "; ".join(more)]


def _not_drawn(failed: int) -> str:
    return f"{counted(failed, 'failed point')} not drawn"


def _entitle(axes: Any, title: str, plan: Plan, lines: Sequence[str]) -> None:
    """Write the title, and under it which study it is and the lines that are not empty."""
    axes.figure.suptitle(wrapped(title[0].upper() + title[1:], 80), fontsize="medium")
    whole = [f"Study {plan.name}, scenario {plan.scenario_name}; {whose(plan.agent)}", *filter(None, lines)]
    axes.set_title("\n".join(wrapped(line, 95) for line in whole), fontsize=SMALL)


def wide(values: np.ndarray) -> bool:
    """Whether numbers are above 0 and so far apart that a log scale shows them better."""
    return bool(np.min(values) > 0 and np.max(values) > RATIO * np.min(values))


def norm_of(values: np.ndarray) -> Any:
    """Return how values become colours: on a log scale if they are far apart."""
    from matplotlib.colors import LogNorm, Normalize

    low, high = float(np.min(values)), float(np.max(values))
    if wide(values):
        return LogNorm(low, high)
    around = 0.5 * abs(low or 1.0)
    return Normalize(low, high) if high > low else Normalize(low - around, low + around)


def levels_of(values: np.ndarray) -> np.ndarray:
    """Return round levels from below the least value to above the greatest: 1, 2, 5, 10, … on a log scale."""
    from matplotlib.ticker import MaxNLocator

    low, high = float(np.min(values)), float(np.max(values))
    if not wide(values):
        return np.asarray(MaxNLocator(9).tick_values(low, high))
    # one decade more at both ends, since logarithms are rounded
    decades = np.arange(np.floor(np.log10(low)) - 1, np.ceil(np.log10(high)) + 2)
    digits = (1.0, 2.0, 5.0) if high <= 1e4 * low else (1.0,)
    levels = np.array([float(f"{digit:g}e{int(decade)}") for decade in decades for digit in digits])
    first, last = np.searchsorted(levels, low, "right") - 1, np.searchsorted(levels, high, "left")
    return levels[first : last + 1]


def positions(axis: Axis, values: np.ndarray | None = None) -> np.ndarray:
    """Where a key's values, or all listed ones, lie along an axis: words at 0, 1, 2, …"""
    if is_text(axis):
        return np.arange(len(distinct(axis))) if values is None else places(axis, values)
    return np.asarray(distinct(axis) if values is None else values, dtype=float)


def colour_bar(axes: Any, mappable: Any, values: np.ndarray, label: str) -> None:
    """Draw the scale of colours, with round numbers on it."""
    bar = axes.figure.colorbar(mappable, ax=axes)
    if wide(values):
        levels = levels_of(values)
        low, high = bar.mappable.norm.vmin, bar.mappable.norm.vmax
        inside = getattr(mappable, "levels", levels[(levels >= low) & (levels <= high)])
        bar.set_ticks(inside, labels=[f"{level:g}" for level in inside])
        bar.minorticks_off()
    bar.set_label(wrapped(label, 50))


def dress(axes: Any, which: str, axis: Axis) -> None:
    """Scale and label one axis of a figure for a key; words, and a few whole numbers, are named one by one."""
    name = NAMES.get(axis.name)
    values = distinct(axis)
    if is_text(axis):
        words = [wrapped(shortened(value, words_of(values)), 14 if which == "x" else LONGEST) for value in values]
        getattr(axes, f"set_{which}ticks")(range(len(words)), words, fontsize=SMALL)
        if which == "y":
            axes.invert_yaxis()
    elif is_log(axis):
        axes.set(**{f"{which}scale": "log"})
    elif all(isinstance(v, int) for v in values) and _apart(values):
        getattr(axes, f"set_{which}ticks")(values)
    axes.set(**{f"{which}label": f"{name} ({axis.name})" if name else axis.name})


def _apart(values: list[int]) -> bool:
    """Whether each of the numbers has room as a tick."""
    return len(values) > 1 and bool(min(np.diff(values)) * MOST_TICKS >= values[-1] - values[0])


def natures_of(data: Mapping[str, np.ndarray]) -> str:
    """How exact points are and by which methods: 'approximate: simplified; exact: general'."""
    found: dict[str, set[str]] = {}
    for nature, method in {*zip(data["nature"].tolist(), data["method"].tolist(), strict=True)}:
        found.setdefault(nature, set()).add(method)
    text = "; ".join(f"{nature}: {', '.join(sorted(methods))}" for nature, methods in sorted(found.items()))
    estimators = sorted(set(data["estimator"].tolist()))
    return f"{text}; of {estimators[0]}" if len(estimators) == 1 else f"{text}; of {len(estimators)} estimators"


def groups_of(data: Mapping[str, np.ndarray], marked: str | None) -> list[tuple[str, np.ndarray]]:
    """Return names and masks of the points that share a value of a key; all of them without a key."""
    if marked is None:
        return [("", np.ones(len(data["point"]), dtype=bool))]
    values = data[marked].astype(str)
    return [(name, values == name) for name in dict.fromkeys(values.tolist())]


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
    filled = _contours(axes, axes.contourf, axes.contour, (x, y, values), inside)
    colour_bar(axes, filled, inside, spoken(shown.plan, shown.column))
    missing = np.ma.getmaskarray(values)
    if missing.any():
        row, column = np.nonzero(missing)
        axes.plot(x[column], y[row], "kx", markersize=7, label=lost(missing), clip_on=False)
        axes.legend(**BELOW)


def _contours(axes: Any, fill: Any, draw_lines: Any, field: tuple[Any, ...], values: np.ndarray) -> Any:
    """Draw round levels of a field, filled and as lines with their values on them; return what is filled."""
    levels = levels_of(values)
    filled = fill(*field, levels=levels, cmap=COLOURS, norm=norm_of(values))
    _label(axes, draw_lines(*field, levels=levels, colors="black", linewidths=0.8))
    return filled


def _label(axes: Any, lines: Any) -> None:
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
    found = Triangulation(x, y, triangles)
    _contours(axes, axes.tricontourf, axes.tricontour, (found, shown.values), shown.values)


def draw_pareto(found: ParetoFront, results: Results) -> Any:
    """Draw all points, and the front as a line of steps: the best accuracy at no more than so much load."""
    figure = canvas(*SIZE)
    axes = figure.add_subplot()
    one_in = -(-found.compared // MOST_DRAWN)
    load, accuracy = _all(found, results, one_in)
    for which, values in (("x", np.append(load, found.load)), ("y", np.append(accuracy, found.accuracy))):
        axes.set(**{f"{which}scale": "log" if wide(values) else "linear"})
    name = f"about one of {one_in} of " if one_in > 1 else ""
    many = len(load) > MANY_POINTS
    style: dict[str, Any] = {"s": 6 if many else 16, "rasterized": many, "linewidth": 0, "color": "0.75", "zorder": 1}
    axes.scatter(load, accuracy, label=f"{name}{counted(found.compared, 'point')}", **style)
    style = {"color": "black", "linewidth": 1, "drawstyle": "steps-post", "zorder": 2}
    axes.plot(found.load, found.accuracy, label="front, with numbers of points", **style)
    _mark_front(axes, found, results.plan)
    labelled(axes, wrapped(load_label(results.plan), 80), wrapped(spoken(results.plan, found.column), 50))
    for which in "xy":
        if getattr(axes, f"get_{which}scale")() == "linear":
            axes.set(**{f"{which}lim": (0, None)})
    axes.legend(ncols=3, **BELOW)
    _number_points(axes, found)
    when = "each point's last step" if found.step is None else f"step {found.step}"
    data = {name: getattr(found, name) for name in studies.HOW}
    more = ["bars: 95 % confidence"] if found.error is not None else []
    more += [_not_drawn(results.failed)] if results.failed else []
    more += [f"{name} = {shortened(value)}" for name, value in found.fixed.items()]
    title = "Accuracy against message load: what no other point beats in both"
    _entitle(axes, title, results.plan, [f"after {when}; front: {natures_of(data)}", "; ".join(more)])
    return figure


def _all(found: ParetoFront, results: Results, one_in: int) -> tuple[np.ndarray, np.ndarray]:
    """Load and accuracy of all points, or of one in so many."""
    loads, accuracies = [], []
    blocks = results.blocks(("point", found.column, *found.fixed), found.step)
    for block, load in zip(blocks, results.mean_over_steps(NODES), strict=True):
        some = thinned(block["point"], one_in) & found.there(block)
        loads.append(load[some])
        accuracies.append(block[found.column][some])
    return np.concatenate(loads), np.concatenate(accuracies)


def _mark_front(axes: Any, found: ParetoFront, plan: Plan) -> None:
    """Mark the front's points, by method, estimator or architecture if one of these varies."""
    marked = next((axis.name for axis in plan.axes if axis.name in MARKED and size_of(axis) > 1), None)
    for i, (name, there) in enumerate(groups_of({**found.keys, "point": found.points}, marked)):
        style: dict[str, Any] = {"marker": MARKERS[i % len(MARKERS)], "color": COLORS[i % len(COLORS)], "s": 32}
        label = f"front, {name}" if name else "not dominated"
        axes.scatter(found.load[there], found.accuracy[there], label=label, zorder=3, clip_on=False, **style)
    if found.error is not None:
        bars = np.where(np.isfinite(found.error), 1.96 * found.error, 0.0)
        axes.errorbar(found.load, found.accuracy, bars, fmt="none", ecolor="black", capsize=2, linewidth=0.8, zorder=2)


def _number_points(axes: Any, found: ParetoFront) -> None:
    """Write the points' numbers beside them, where there is room."""
    to_axes = axes.transData - axes.transAxes
    places = to_axes.transform(np.stack([found.load, found.accuracy], axis=1))
    right, low = -1.0, 2.0
    for point, load, accuracy, place in zip(found.points, found.load, found.accuracy, places, strict=True):
        if place[0] > right + NUMBERS_APART or place[1] < low - 2 * NUMBERS_APART:
            at: dict[str, Any] = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 8}
            axes.annotate(str(point), (load, accuracy), **at)
            right, low = place[0] + DIGIT * len(str(point)), place[1]
