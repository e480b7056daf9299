"""Signals, criteria and weights from outside: what does not fit is said by name, signals numbered from 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.algebra import NUMPY
from stochfuse.checks import covariance_fault
from stochfuse.errors import UsageError
from stochfuse.fusion.intersection_slopes import Criterion

CRITERIA = ("det", "trace", "lp", "max-eig")
ROUNDING = 1e-9
"""Asymmetry and negative eigenvalue at unit variances, and excess of the sum of given weights, that are rounding."""


def covariance_part(name: str, value: Any, p: int | None) -> np.ndarray:
    """Read a symmetric positive semi-definite (p, p) matrix."""
    A = np.asarray(value, dtype=float)
    kind = f"a symmetric positive semi-definite {'square' if p is None else f'{p}×{p}'} matrix"
    if A.ndim != 2 or not A.size or A.shape[0] != A.shape[1] or p not in (None, len(A)):
        raise UsageError(f"{name}: expected {kind}, got shape {A.shape}")
    fault = covariance_fault(A)
    if fault is not None:
        raise UsageError(f"{name}: expected {kind}, got {fault}")
    return NUMPY.symmetric(A)


def mean(name: str, value: Any, p: int, wanted: bool) -> np.ndarray | None:
    """Read a mean (p, 1), or None where no signal has one."""
    if (value is not None) != wanted:
        raise UsageError(
            f"{name}: expected a mean in every signal or in none, got {'none' if value is None else 'one'}"
        )
    if value is None:
        return None
    a = np.asarray(value, dtype=float)
    if a.shape != (p, 1) or not np.isfinite(a).all():
        raise UsageError(f"{name}: expected a finite column of shape ({p}, 1), got shape {a.shape}")
    return a


def mapping(name: str, value: Any, p: int, d: int | None, axes: tuple[int, ...] = (2,)) -> np.ndarray | None:
    """Read a map (p, d), in stacks also (N, p, d); d may be open.  None is the identity."""
    wanted = f"a {p}×{'any' if d is None else d} matrix"
    if value is None:
        if d not in (None, p):
            raise UsageError(f"{name}: expected {wanted}, got none (an identity of {p} states)")
        return None
    H = np.asarray(value, dtype=float)
    if H.ndim not in axes or H.shape[-2] != p or not H.size or d not in (None, H.shape[-1]):
        raise UsageError(f"{name}: expected {wanted}, got shape {H.shape}")
    if not np.isfinite(H).all():
        raise UsageError(f"{name}: expected {wanted} of finite numbers, got a value that is not finite")
    return H


def checked_criterion(criterion: Criterion, d: int) -> Criterion:
    """Return the criterion, if it fits d states."""
    name, block, p, weights = criterion
    if name not in CRITERIA:
        raise UsageError(f"criterion: expected one of {', '.join(CRITERIA)}, got {name!r}")
    if block is not None:
        indices = list(block)
        fits = all(isinstance(j, int | np.integer) and 0 <= j < d for j in indices)
        if not indices or not fits or len(set(indices)) != len(indices):
            raise UsageError(f"criterion.block: expected different states from 0 to {d - 1}, got {indices}")
    if not (np.isfinite(p) and p >= 1):
        raise UsageError(f"criterion.p: expected a finite exponent of at least 1, got {p}")
    states = d if block is None else len(block)
    if weights is not None:
        numbers = np.asarray(weights, dtype=float)
        if name != "lp":
            raise UsageError(
                f'criterion.weights: expected none for "{name}" (they belong to "lp"), got {list(weights)}'
            )
        if numbers.shape != (states,) or not np.isfinite(numbers).all() or (numbers <= 0).any():
            raise UsageError(f"criterion.weights: expected {states} positive numbers, got {list(weights)}")
    return criterion


def checked_weights(weights: Sequence[float], n: int) -> np.ndarray:
    """Read given weights (n,), which must lie in the simplex."""
    w = np.asarray(weights, dtype=float)
    expected = f"{n} numbers of at least 0 that sum to 1"
    if w.shape != (n,):
        raise UsageError(f"weights: expected {expected}, got {w.size} of them")
    if not np.isfinite(w).all() or (w < 0).any() or abs(w.sum() - 1.0) > ROUNDING:
        raise UsageError(f"weights: expected {expected}, got {w.tolist()}, sum {w.sum():g}")
    return w
