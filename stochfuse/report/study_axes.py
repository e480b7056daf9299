"""Axes, scales and colours of a study's figures (matplotlib).

Colours are those of cividis, which rise in lightness alone: they are the same in grey print and to the colour-blind.
"""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap
from typing import Any

import numpy as np

from stochfuse.report.study_slices import distinct, is_log, is_text, places
from stochfuse.report.study_words import LONGEST, shortened, words_of
from stochfuse.studies.axes import Axis

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


def wrapped(text: str, width: int) -> str:
    """Return text in lines of a width."""
    return "\n".join(wrap(text, width, break_on_hyphens=False))


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


def levels_of(values: np.ndarray, number: int = 9) -> np.ndarray:
    """Return round levels from below the least value to above the greatest: 1, 2, 5, 10, … on a log scale."""
    from matplotlib.ticker import MaxNLocator

    low, high = float(np.min(values)), float(np.max(values))
    if not wide(values):
        return np.asarray(MaxNLocator(number).tick_values(low, high))
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
