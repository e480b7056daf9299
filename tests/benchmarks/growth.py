"""How cost grows: seconds, slopes and figures."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

Growth = dict[str, tuple[list[int], list[float]]]
"""Sizes and seconds by what grows."""


def seconds(function, rounds: int) -> float:
    """Least time of some rounds, after one that is not counted."""
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def slopes(found: Growth) -> list[tuple[str, ...]]:
    """Name, first and last time, and the slope of the upper half in a doubly logarithmic plot."""
    rows = []
    for name, (sizes, times) in found.items():
        upper = slice(len(sizes) // 2, None) if len(sizes) > 2 else slice(None)
        slope = np.polyfit(np.log(sizes[upper]), np.log(times[upper]), 1)[0]
        rows.append(
            (name, f"{sizes[0]}: {times[0] * 1e3:.3g} ms", f"{sizes[-1]}: {times[-1] * 1e3:.3g} ms", f"{slope:.1f}")
        )
    return rows


def draw(panels: dict[str, Growth], output: Path, sizes: str, cost: str) -> None:
    """Draw one panel per title, doubly logarithmic, each curve with the slope of its upper half."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5 * len(panels), 4.8), layout="constrained")
    for axes, (title, found) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for (name, (x, y)), slope, style in zip(
            found.items(), slopes(found), ("o-", "s-", "^-", "o--", "s--"), strict=False
        ):
            axes.loglog(x, y, style, label=f"{name}: slope {slope[-1]}")
        axes.set(xlabel=sizes, ylabel=cost, title=title)
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    figure.savefig(output, dpi=150)
