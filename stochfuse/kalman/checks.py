"""Numbers from outside, turned into arrays: finite, of the right shape, definite where they must be.

A `Checker` collects every problem it meets, so that one message can name all offending keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.kalman.packed import INDEFINITE, smallest_pivot, triangle

SYMMETRY = 1e-9
"""Largest |A − Aᵀ|, in units of the standard deviations, that is taken for rounding."""
LARGEST = 1e100
"""Largest size of a number: its square and the square's products stay within floating point."""
MOST = 10_000_000
"""Most agents and most steps."""


def shown(value: Any) -> str:
    """Return a value as it came, cut to a readable length."""
    try:
        text = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    except (RecursionError, ValueError):
        return "something too large to show"
    return text if len(text) <= 60 else text[:57] + "..."


def size(shape: Sequence[int]) -> str:
    """Return a shape in words: '2×3', '5 of 2×3'."""
    if len(shape) == 3:
        return f"{shape[0]} of {shape[1]}×{shape[2]}"
    return "×".join(map(str, shape))


def covariance_fault(array: np.ndarray, *, definite: bool = False) -> str | None:
    """Return why stacks of square matrices (..., n, n) are no covariances, or None if they are, up to rounding.

    Parameters
    ----------
    definite : whether singular ones are none either.
    """
    if array.ndim > 2 and _all_fine(array, 1e-12 if definite else INDEFINITE):
        return None
    if not np.isfinite(array).all():
        return "a value that is not finite (NaN or infinity)"
    diagonal = np.diagonal(array, axis1=-2, axis2=-1)
    if (diagonal < 0).any() or (definite and (diagonal <= 0).any()):
        return f"a variance of {diagonal.min():g} on the diagonal"
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = array / (scale[..., :, None] * scale[..., None, :])
    if np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(initial=0.0) > SYMMETRY:
        return "an asymmetric one"
    even = 0.5 * (scaled + np.swapaxes(scaled, -1, -2))
    smallest = float(np.linalg.eigvalsh(even).min(initial=np.inf))
    if smallest < INDEFINITE:
        return f"an indefinite one (smallest eigenvalue, scaled to unit variances, {smallest:.3g})"
    return "a singular one" if definite and smallest <= 1e-15 else None


def _all_fine(stack: np.ndarray, beyond: float) -> bool:
    """Whether all matrices are finite and symmetric, and their eigenvalues larger than that: a tenth of the time."""
    d = stack.shape[-1]
    rows, columns, place = triangle(d)
    flat = stack.reshape(-1, d * d).T
    P, mirrored = flat[rows * d + columns], flat[columns * d + rows]
    with np.errstate(all="ignore"):
        variances = P[place.diagonal()]
        if (mirrored != P).any():
            scale = np.sqrt(np.where(variances > 0, variances, 1.0))
            if not (np.abs(P - mirrored) <= SYMMETRY * scale[rows] * scale[columns]).all():
                return False
            P = 0.5 * (P + mirrored)
        return bool((variances >= 0).all() and (smallest_pivot(P, d, -beyond) > 0).all())


def first_fault(P: np.ndarray) -> tuple[int, str] | None:
    """Return the first step whose matrices P[step − 1] are no covariances, and why; see `covariance_fault`."""
    faults = ((step, covariance_fault(now)) for step, now in enumerate(P, start=1))
    return next(((step, fault) for step, fault in faults if fault is not None), None)
