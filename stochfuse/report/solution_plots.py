"""Answers to questions asked backwards as figures (matplotlib, extra `plot`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse.inverse.agents_needed import AgentsNeeded
from stochfuse.inverse.least_link import LeastLink
from stochfuse.inverse.question import named
from stochfuse.inverse.sensitivity import Sensitivity, ShareOfGain
from stochfuse.report.export import write_file
from stochfuse.report.plot import MARKERS, figure_class, spread
from stochfuse.report.solutions import Sheet, receivers

MOST_BARS = 12


def plot_solution(sheet: Sheet, found: Any, output: Path) -> None:
    """Draw an answer.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    figure = draw(sheet, found)
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def draw(sheet: Sheet, found: Any) -> Any:
    """Return the figure of an answer under what it means."""
    figure = figure_class()(figsize=(7.5, 5.4), layout="constrained")
    axes = figure.add_subplot()
    drawn: dict[str, Callable[..., None]] = {
        "least-link": _draw_least_link,
        "agents-needed": _draw_agents,
        "sensitivity": _draw_sensitivity,
        "gain": _draw_gain,
        "steady": _draw_steady,
    }
    drawn[sheet.kind](axes, sheet, found)
    figure.suptitle("\n".join(wrap(sheet.answer[0], 80)), fontsize="medium")
    about = sheet.titles[len(sheet.answer) :]
    axes.set_title("\n".join(line for text in about for line in wrap(text, 100)), fontsize="small")
    return figure


def _label(sheet: Sheet) -> str:
    unit = f" [{sheet.view.unit}]" if sheet.view.unit else ""
    return f"{named(sheet.question).partition(' (')[0]}{unit}"


def _draw_least_link(axes: Any, sheet: Sheet, found: LeastLink) -> None:
    µ, values = found.curve()
    axes.plot(µ, values, color="C0", label=f"value, {sheet.question.when}")
    axes.axhline(found.target, color="C3", linestyle="--", linewidth=1, label=f"target {found.target:.6g}")
    for i, (a, b) in enumerate(found.met):
        axes.axvspan(a, b, color="C2", alpha=0.12, linewidth=0, label="met" if i == 0 else None)
    axes.plot([found.link], [found.value], "o", color="C3", label=f"least µ = {found.link:.6g}")
    axes.axvline(found.link, color="C3", linestyle=":", linewidth=1)
    _finish(axes, "link probability µ", _label(sheet))
    axes.legend(fontsize="small")


def _draw_agents(axes: Any, sheet: Sheet, found: AgentsNeeded) -> None:
    axes.plot(*found.tried, "o-", color="C0", markersize=3, label=f"value at µ = {found.link:g}")
    axes.axhline(found.target, color="C3", linestyle="--", linewidth=1, label=f"target {found.target:.6g}")
    axes.plot([found.agents], [found.value], "D", color="C3", label=f"{found.agents:,} agents")
    if found.tried[0].max() > 30:
        axes.set_xscale("log")
        axes.set_yscale("log")
    _finish(axes, "agents", _label(sheet))
    axes.legend(fontsize="small")


def _draw_sensitivity(axes: Any, sheet: Sheet, found: Sensitivity) -> None:
    label = f"d ({named(sheet.question).partition(' (')[0]}) / dµ"
    if len(found.links) <= MOST_BARS:
        order = found.order[::-1]
        names = [f"{found.links[i][0]} to {receivers(found, int(i))}" for i in order]
        axes.barh(names, found.derivative[order], color=["C3" if int(i) in found.first else "C0" for i in order])
        axes.axvline(0, color="0.3", linewidth=0.8)
        _finish(axes, label + "; red: improve first", "link")
        return
    n = found.question.scenario.network.agents
    grid = np.full((n, n), np.nan)
    for (sender, heard), slope in zip(found.links, found.derivative, strict=True):
        grid[[i - 1 for i in heard], sender - 1] = slope
    image = axes.imshow(grid, cmap="viridis")
    axes.figure.colorbar(image, ax=axes, label=label)
    axes.set_xticks(range(n), range(1, n + 1))
    axes.set_yticks(range(n), range(1, n + 1))
    axes.set_xlabel("from agent")
    axes.set_ylabel("to agent")


def _draw_gain(axes: Any, sheet: Sheet, found: ShareOfGain) -> None:
    p = found.prediction
    names = ["steady"] if found.steps is None else [f"k = {k}" for k in found.steps]
    if p.cases is None:
        order = np.argsort(p.link)
        for i, c in enumerate(spread(len(names))):
            axes.plot(p.link[order], 100 * found.share[order, c], marker=MARKERS[i], markersize=4, label=names[c])
        axes.plot([0, 1], [0, 100], color="0.6", linewidth=0.8, linestyle=":")
        _finish(axes, "link probability µ", "share of the gain [%]")
    else:
        for i, row in enumerate(spread(len(p.cases))):
            axes.plot(names, 100 * found.share[row], marker=MARKERS[i], markersize=4, label=p.cases[row])
        _finish(axes, "step", "share of the gain [%]")
    axes.legend(fontsize="small")


def _draw_steady(axes: Any, sheet: Sheet, found: Any) -> None:
    p, values = sheet.prediction, sheet.question.read(sheet.prediction)
    if p.cases is None:
        order = np.argsort(p.link)
        axes.plot(p.link[order], values[order], "o-", color="C0", markersize=4)
        _finish(axes, "link probability µ", f"{_label(sheet)}, steady state")
    else:
        axes.bar(p.cases, values, color="C0")
        _finish(axes, "links", f"{_label(sheet)}, steady state")
    axes.set_ylim(bottom=0)


def _finish(axes: Any, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
