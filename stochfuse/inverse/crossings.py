"""Where a function on [0, 1] is at most a target: every interval, its ends narrowed down to rounding.

[0, 1] is cut into cells in which the function f crosses the target at most once (`separated` for polynomials, by proof;
`scanned` for anything else, by looking closely); every crossing is then narrowed down between a point that misses the
target and one that meets it, so that each end found meets the target itself.

A polynomial is given in Bernstein's form, f(µ) = Σ b_c C(L, c) µ^c (1−µ)^(L−c): by Descartes' rule of signs it has at
most as many roots in the cell as the b_c have changes of sign, and de Casteljau's halving gives the b_c of both halves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Function = Callable[[np.ndarray], np.ndarray]

SCAN = 2049
SECTIONS = 64
NARROWEST = 2.0**-44
"""Width of a cell that is cut no further: two roots so close are one."""
MOST_CELLS = 4096
"""Cells that may be undecided at a time: more are rounding, where the function is as good as constant."""


def intervals(
    value: Function, cells: np.ndarray, target: float, sections: int = SECTIONS
) -> tuple[tuple[float, float], ...]:
    """Return the intervals of [0, 1] in which the target is met.

    Parameters
    ----------
    value : the function, of many points at once.
    cells : increasing points from 0 to 1 between which the function crosses the target at most once.
    sections : cells into which a crossing's is cut at a time; 2 where each point costs as much as the next.
    """
    met = value(cells) <= target
    ends = [0.0] if met[0] else []
    for i in np.flatnonzero(met[1:] != met[:-1]):
        ends.append(_narrowed(value, target, cells[i], cells[i + 1], rises=bool(met[i]), sections=sections))
    if met[-1]:
        ends.append(1.0)
    return tuple(zip(ends[::2], ends[1::2], strict=True))


def _narrowed(value: Function, target: float, a: float, b: float, *, rises: bool, sections: int) -> float:
    """Where the target begins (or, if the function rises, ceases) to be met between a and b: a point that meets it."""
    while b - a > 2 * np.spacing(b):
        points = np.linspace(a, b, sections + 1)
        inside = (value(points[1:-1]) <= target) != rises
        # the first that is no longer as a is
        i = int(np.argmax(inside)) + 1 if inside.any() else sections
        if points[i] - points[i - 1] >= b - a:
            break
        a, b = float(points[i - 1]), float(points[i])
    return a if rises else b


def separated(b: np.ndarray) -> np.ndarray:
    """Return points between which a polynomial has at most one root.

    Parameters
    ----------
    b : (degree + 1,) coefficients in Bernstein's form on [0, 1].
    """
    left, width, cells, points = np.zeros(1), 1.0, b[None], [np.array([0.0, 1.0])]
    while True:
        signs = cells > 0
        open_ = (signs[:, 1:] != signs[:, :-1]).sum(axis=1) > 1
        left, cells = left[open_], cells[open_]
        if not len(left) or len(left) > MOST_CELLS or width < NARROWEST:
            # what is still open at this width touches the target, or nearly so
            return np.unique(np.concatenate([*points, left + width / 2]))
        width /= 2
        points.append(left + width)
        cells = np.concatenate(_halves(cells))
        left = np.concatenate([left, left + width])


def _halves(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """De Casteljau: coefficients on the left and on the right half of every cell."""
    first, last = [b[:, 0]], [b[:, -1]]
    while b.shape[1] > 1:
        b = 0.5 * (b[:, :-1] + b[:, 1:])
        first.append(b[:, 0])
        last.append(b[:, -1])
    return np.stack(first, axis=1), np.stack(last[::-1], axis=1)


def scanned(value: Function, target: float) -> np.ndarray:
    """Return points between which a function crosses the target at most once, as far as looking closely can tell.

    Dips and peaks that do not reach the target on the scan's points, but might between them, are followed down to their
    bottom or top.
    """
    points = np.linspace(0.0, 1.0, SCAN)
    f = value(points) - target
    more = []
    for sign in (1.0, -1.0):
        g = sign * f
        dip = (g[1:-1] > 0) & (g[1:-1] <= np.minimum(g[:-2], g[2:]))
        # a parabola through three points goes below the middle one by at most an eighth of what the steeper side falls
        near = g[1:-1] < np.maximum(g[:-2], g[2:]) - g[1:-1]
        for i in np.flatnonzero(dip & near) + 1:
            more.append(lowest(lambda µ, s=sign: s * value(µ), points[i - 1], points[i + 1]))
    return np.unique(np.concatenate([points, more]))


def lowest(value: Function, a: float, b: float) -> float:
    """Return the point of [a, b] with the least value, where there is one dip in it."""
    while True:
        points = np.linspace(a, b, SECTIONS + 1)
        i = int(np.argmin(value(points)))
        if b - a < 1e-9:  # values at a bottom differ by the square of that
            return float(points[i])
        a, b = float(points[max(i - 1, 0)]), float(points[min(i + 1, SECTIONS)])
