"""Accuracy against message load as a figure: all points of a study, and the front of those that pay (matplotlib)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.report.export import write_file
from stochfuse.report.plot import COLORS, MARKERS, figure_class
from stochfuse.report.predictions import counted
from stochfuse.report.study_axes import BELOW, SMALL, groups_of, natures_of, wide, wrapped
from stochfuse.report.study_slices import MARKED, MOST_DRAWN, size_of, thinned
from stochfuse.report.study_words import load_label, shortened, spoken, whose
from stochfuse.studies.pareto import ParetoFront
from stochfuse.studies.plan import NODES

if TYPE_CHECKING:
    from stochfuse.studies.results import Results

MANY = 500
"""Points from which on they are drawn small, and as pixels even in vector files."""
APART, DIGIT = 0.02, 0.013
"""Shares of the axes: between the numbers of points, and of the width of a digit."""


def plot_pareto(found: ParetoFront, results: Results, file: Path) -> None:
    """Draw all points, and the front as a line of steps: the best accuracy at no more than so much load.

    Raises
    ------
    UsageError
        If the file cannot be written.
    StochfuseError
        If matplotlib is not installed.
    """
    figure = draw_pareto(found, results)
    write_file(file, lambda path: figure.savefig(path, dpi=150))


def draw_pareto(found: ParetoFront, results: Results) -> Any:
    """Return the figure that `plot_pareto` writes."""
    figure = figure_class()(figsize=(7.5, 5.6), layout="constrained")
    axes = figure.add_subplot()
    one_in = -(-found.compared // MOST_DRAWN)
    load, accuracy = _all(found, results, one_in)
    for which, values in (("x", np.append(load, found.load)), ("y", np.append(accuracy, found.accuracy))):
        axes.set(**{f"{which}scale": "log" if wide(values) else "linear"})
    share = f"about one of {one_in} of " if one_in > 1 else ""
    style: dict[str, Any] = {"s": 6 if len(load) > MANY else 16, "rasterized": len(load) > MANY, "linewidth": 0}
    name = f"{share}{counted(found.compared, 'point')}"
    axes.scatter(load, accuracy, color="0.75", label=name, zorder=1, **style)
    axes.plot(
        found.load,
        found.accuracy,
        color="black",
        linewidth=1,
        drawstyle="steps-post",
        zorder=2,
        label="front, with numbers of points",
    )
    _front(axes, found, results)
    axes.set_xlabel(wrapped(load_label(results.plan), 80))
    axes.set_ylabel(wrapped(spoken(results.plan, found.column), 50))
    for which in "xy":
        if getattr(axes, f"get_{which}scale")() == "linear":
            axes.set(**{f"{which}lim": (0, None)})
    axes.grid(alpha=0.3)
    axes.legend(ncols=3, **BELOW)
    _name(axes, found)
    _title(figure, axes, found, results)
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


def _front(axes: Any, found: ParetoFront, results: Results) -> None:
    """Mark the front's points, by method, estimator or architecture if one of these varies."""
    marked = next((axis.name for axis in results.plan.axes if axis.name in MARKED and size_of(axis) > 1), None)
    data = {**found.keys, "point": found.points}
    for i, (name, there) in enumerate(groups_of(data, marked)):
        style: dict[str, Any] = {
            "marker": MARKERS[i % len(MARKERS)],
            "color": COLORS[i % len(COLORS)],
            "zorder": 3,
            "clip_on": False,
        }
        label = f"front, {name}" if name else "not dominated"
        axes.scatter(found.load[there], found.accuracy[there], s=32, label=label, **style)
    if found.error is not None:
        bars = np.where(np.isfinite(found.error), 1.96 * found.error, 0.0)
        axes.errorbar(found.load, found.accuracy, bars, fmt="none", ecolor="black", capsize=2, linewidth=0.8, zorder=2)


def _name(axes: Any, found: ParetoFront) -> None:
    """Write the points' numbers beside them, where there is room."""
    to_axes = axes.transData - axes.transAxes
    places = to_axes.transform(np.stack([found.load, found.accuracy], axis=1))
    right, low = -1.0, 2.0
    for point, load, accuracy, place in zip(found.points, found.load, found.accuracy, places, strict=True):
        if place[0] > right + APART or place[1] < low - 2 * APART:
            at: dict[str, Any] = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 8}
            axes.annotate(str(point), (load, accuracy), **at)
            right, low = place[0] + DIGIT * len(str(point)), place[1]


def _title(figure: Any, axes: Any, found: ParetoFront, results: Results) -> None:
    plan = results.plan
    when = "each point's last step" if found.step is None else f"step {found.step}"
    data = {"nature": found.nature, "method": found.method, "estimator": found.estimator}
    lines = [
        f"Study {plan.name}, scenario {plan.scenario_name}; {whose(plan)}",
        f"after {when}; front: {natures_of(data)}",
    ]
    more = ["bars: 95 % confidence"] if found.error is not None else []
    more += [f"{counted(results.failed, 'failed point')} not drawn"] if results.failed else []
    more += [f"{name} = {shortened(value)}" for name, value in found.fixed.items()]
    lines += ["; ".join(more)] if more else []
    figure.suptitle("Accuracy against message load: what no other point beats in both", fontsize="medium")
    axes.set_title("\n".join(wrapped(line, 95) for line in lines), fontsize=SMALL)
