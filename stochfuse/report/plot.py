"""What all figures have in common: names outside the axes, titles that wrap, colours that grey tells apart.

Nothing is written on a curve: a few curves are named at their right ends (`direct`), others in a legend below the axes
(`below`).  matplotlib is the extra `plot`, and is imported when a figure is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse.errors import needed
from stochfuse.report.table import write_file

MOST_CURVES, MOST_MARKED = 8, 30
"""Curves of a figure, and points up to which a curve has marks."""
MARKERS = "osD^vP*X"
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 3)))
"""Patterns of lines, so that curves are told apart without colour."""
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8A6D00")
"""Colours that the colour-blind can tell apart (Okabe and Ito), the yellow one darkened for print."""
PER_INCH = {"medium": 11.5, "small": 13.5, "x-small": 16.0}
"""Letters that an inch holds."""


def figure_class() -> Any:
    """Return matplotlib's Figure.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    return needed("matplotlib.figure", "plot", "plots need").Figure


def save(draw: Callable[[], Any], output: Path) -> None:
    """Write a figure to a file.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    UsageError
        If the file cannot be written.
    """
    figure_class()
    figure = draw()
    write_file(output, lambda path: figure.savefig(path, dpi=150))


def canvas(width: float, height: float, layout: str = "constrained") -> Any:
    """Return an empty figure of a size in inches, not registered with pyplot."""
    return figure_class()(figsize=(width, height), layout=layout)


def look(place: int) -> dict[str, Any]:
    """Colour and dashes of one of several curves."""
    return {"color": COLORS[place % len(COLORS)], "linestyle": DASHES[place % len(DASHES)]}


def entry(label: str, **style: Any) -> Any:
    """Return an entry of a legend that no single curve stands for."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def band(axes: Any, x: Any, low: Any, high: Any, color: Any, alpha: float = 0.15) -> None:
    """Lay a pale band between two curves."""
    axes.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0)


def labelled(axes: Any, x: str | None, y: str | None, *, whole: bool = False, zero: bool = False) -> None:
    """Name axes and lay a grid under them.

    Parameters
    ----------
    x, y : names; None leaves an axis as it is.
    whole : whether x has whole numbers only.
    zero : whether y begins at 0.
    """
    axes.set(**{key: text for key, text in (("xlabel", x), ("ylabel", y)) if text is not None})
    if whole:
        axes.xaxis.get_major_locator().set_params(integer=True)
    if zero:
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)


def spread(n: int) -> list[int]:
    """At most `MOST_CURVES` indices out of n, first and last included."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, MOST_CURVES))})


def shades(n: int) -> Any:
    """Return n colours from dark to light, whose order grey keeps."""
    from matplotlib import colormaps

    return colormaps["viridis"](np.linspace(0, 0.85, n))


def wrapped(text: str, width: int) -> str:
    """Return text in lines of a width."""
    return "\n".join(wrap(text, width, break_on_hyphens=False))


def titled(figure: Any, title: str, *lines: str) -> None:
    """Write title and explanation above everything, wrapped to the figure's width."""
    room = int((figure.get_figwidth() - 0.4) * PER_INCH["medium"])
    figure.suptitle("\n".join(wrapped(line, room) for line in (title, *lines) if line), fontsize="medium")


def below(figure: Any, handles: Sequence[Any] | None = None, title: str | None = None) -> None:
    """Put the legend below all axes, in as many columns as fit."""
    if handles is None:
        handles = [h for axes in figure.axes for h in axes.get_legend_handles_labels()[0]]
    if not handles:
        return
    longest = max(len(str(handle.get_label())) for handle in handles) + 7
    columns = max(1, min(len(handles), int(figure.get_figwidth() * PER_INCH["small"] / longest)))
    figure.legend(handles=handles, title=title, fontsize="small", ncols=columns, loc="outside lower center")


def direct(axes: Any, lines: Sequence[Any], names: Sequence[str], title: str | None = None) -> None:
    """Name curves at the right end of their axes, the names moved apart where they would meet."""
    low, high = axes.get_ylim()
    ends = np.array([(line.get_ydata()[-1] - low) / (high - low) for line in lines], dtype=float)
    # in shares of the axes' height: a line of small text and a little air
    places = apart(ends, 0.058 * 5.0 / axes.figure.get_figheight())
    for line, name, end, place in zip(lines, names, ends, places, strict=True):
        arrow = {"arrowstyle": "-", "color": line.get_color(), "linestyle": line.get_linestyle(), "relpos": (0.0, 0.5)}
        axes.annotate(
            name,
            xy=(1.0, end),
            xytext=(1.07, place),
            xycoords="axes fraction",
            va="center",
            fontsize="small",
            annotation_clip=False,
            arrowprops={**arrow, "linewidth": 1.0, "shrinkA": 1, "shrinkB": 0},
        )
    if title:
        axes.annotate(title, (1.07, -0.06), xycoords="axes fraction", fontsize="small", annotation_clip=False)


def apart(wanted: np.ndarray, least: float) -> np.ndarray:
    """Places as near to the wanted ones as they can be, at least so far from each other, in the same order."""
    order = np.argsort(wanted, kind="stable")
    groups: list[list[int]] = []
    for i in order:
        groups.append([int(i)])
        # neighbours that would meet share their room about their common middle
        while len(groups) > 1 and _first(groups[-1], wanted, least) - _last(groups[-2], wanted, least) < least:
            groups[-2:] = [groups[-2] + groups[-1]]
    places = np.empty(len(wanted))
    for group in groups:
        places[group] = _first(group, wanted, least) + least * np.arange(len(group))
    return places


def _first(group: list[int], wanted: np.ndarray, least: float) -> float:
    return float(wanted[group].mean()) - least * (len(group) - 1) / 2


def _last(group: list[int], wanted: np.ndarray, least: float) -> float:
    return float(wanted[group].mean()) + least * (len(group) - 1) / 2
