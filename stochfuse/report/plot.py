"""A prediction as a figure (matplotlib, extra `plot`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.errors import StochfuseError
from stochfuse.report.table import write_file

MOST_CURVES = 8
MARKERS = "osD^vP*X"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8A6D00")
"""Colours that the colour-blind can tell apart (Okabe and Ito), the yellow one darkened for print."""


def figure_class() -> Any:
    """Return matplotlib's Figure.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise StochfuseError("plots need matplotlib: pip install 'stochfuse[plot]'") from None
    return Figure


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


def spread(n: int) -> list[int]:
    """At most `MOST_CURVES` indices out of n, first and last included."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, MOST_CURVES))})
