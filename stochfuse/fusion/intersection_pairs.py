"""Plain covariance intersection of pairs: one scalar equation each.

Two covariances are diagonalised against each other in the metric of their sum,

    A = T diag(α) Tᵀ      B = T diag(β) Tᵀ      β = 1 − α,

so that (ωA⁻¹ + (1 − ω)B⁻¹)⁻¹ = T diag(αβ/q) Tᵀ with q = ωβ + (1 − ω)α, whichever of A and B is singular.  With
δ = β − α and c = |columns of T|², the slopes to be zero are

    det      −Σ δ/q             trace    −Σ c αβ δ/q²,

both increasing in ω.  Their signs at the ends say whether ω is 0, 1 or between; there Newton's method, kept within a
bracket by bisection, moves the pairs that are not settled.

δ comes from T⁻¹(B − A)T⁻ᵀ, so that equal matrices are equal to the last bit.  Where A (or B) has a zero variance the
determinant, zero at every weight, is that of the other directions times the rate at which it vanishes: the limit of
slightly larger variances.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stochfuse.algebra import NUMPY
from stochfuse.errors import UsageError

MOST_STEPS = 200
EQUAL = 2e-15
"""Largest |δ| per dimension of two covariances that are equal to rounding."""


class Pairs(NamedTuple):
    """N pairs: T (N, d, d), empty where it was not asked for, and α, β, δ = β − α (N, d)."""

    T: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray


def pair_weights(A: np.ndarray, B: np.ndarray, criterion: str = "det") -> np.ndarray:
    """Weights (N,) of A in the covariance intersection of the pairs A, B (N, d, d); B has the rest.

    Parameters
    ----------
    A, B : positive semi-definite with a positive definite sum; symmetric (not checked).
    criterion : "det" or "trace" of the fused covariance.

    Returns
    -------
    ndarray
        ½ where A and B are equal, 1 where A ≤ B, 0 where B ≤ A.

    Raises
    ------
    UsageError
        If the shapes do not fit, a matrix is indefinite or a sum is singular.
    """
    if criterion not in ("det", "trace"):
        raise UsageError(f'criterion: expected "det" or "trace", got {criterion!r}')
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    if A.ndim != 3 or A.shape[-1] != A.shape[-2] or A.shape != B.shape or not A.shape[-1]:
        raise UsageError(
            f"pairs: expected stacks A and B of N square matrices each, got shapes {A.shape} and {B.shape}"
        )
    return weights_of(diagonalise(A, B, basis=criterion == "trace"), criterion)


def diagonalise(A: np.ndarray, B: np.ndarray, *, basis: bool = True) -> Pairs:
    """Bring each pair to diagonal form, T only if the basis is wanted.

    Raises
    ------
    UsageError
        If a matrix is indefinite or a sum singular.
    """
    total = A + B
    diagonal = np.diagonal(total, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    rows, columns = scale[:, :, None], scale[:, None, :]
    try:
        L = np.linalg.cholesky(total / rows / columns)
    except np.linalg.LinAlgError:
        raise UsageError("pairs: expected positive definite sums A + B, got a singular or indefinite one") from None
    whiten = np.linalg.inv(L) / columns
    difference = NUMPY.symmetric(whiten @ (B - A) @ NUMPY.transpose(whiten))
    if basis:
        delta, U = np.linalg.eigh(difference)
        T = rows * (L @ U)
    else:
        delta, T = np.linalg.eigvalsh(difference), np.empty((len(A), 0, 0))
    if delta.size and np.abs(delta).max() > 1.0 + 1e-6:
        raise UsageError("pairs: expected positive semi-definite matrices, got an indefinite one")
    delta = np.clip(delta, -1.0, 1.0)
    return Pairs(T, 0.5 * (1.0 - delta), 0.5 * (1.0 + delta), delta)


def weights_of(pairs: Pairs, name: str) -> np.ndarray:
    """Weights (N,) of A of least determinant ("det") or trace."""
    shares = _shares(pairs, name)
    q0, q1, delta = (np.ascontiguousarray(part.T) for part in (pairs.alpha, pairs.beta, pairs.delta))
    power = 1 if name == "det" else 2
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (-np.where(shares > 0, shares * delta / q**power, 0.0).sum(axis=0) for q in (q0, q1))
    weights = np.where(first >= 0, 0.0, 1.0)
    equal = (np.abs(delta).max(axis=0) <= EQUAL * len(delta)) | ((first == 0) & (last == 0))
    weights[equal] = 0.5
    inside = np.flatnonzero((first < 0) & (last > 0) & ~equal)
    weights[inside] = _root(shares[:, inside], q0[:, inside], delta[:, inside], power)
    return weights


def excess(pairs: Pairs, name: str, weights: np.ndarray) -> np.ndarray:
    """Bound (N,) on the excess of the criterion, relative (of log det): slope times way to the better end."""
    shares = _shares(pairs, name)
    q = weights * pairs.beta.T + (1.0 - weights) * pairs.alpha.T
    known = (q > 0) & (shares > 0)
    q = np.where(known, q, 1.0)
    slope = -np.where(known, shares * pairs.delta.T / q ** (1 if name == "det" else 2), 0.0).sum(axis=0)
    size = 1.0 if name == "det" else np.where(known, shares / q, 0.0).sum(axis=0)
    gap = np.maximum(slope * weights, -slope * (1.0 - weights))
    return np.divide(gap, size, out=np.zeros_like(gap), where=np.asarray(size) > 0)


def _shares(pairs: Pairs, name: str) -> np.ndarray:
    """What multiplies δ/q (det) or δ/q² (trace), shape (d, N)."""
    if name == "det":
        return np.ones(pairs.delta.shape[::-1])
    return np.ascontiguousarray(((pairs.T * pairs.T).sum(axis=1) * pairs.alpha * pairs.beta).T)


def _root(shares: np.ndarray, alpha: np.ndarray, delta: np.ndarray, power: int) -> np.ndarray:
    """Zero in (0, 1) of the increasing slope −Σ shares δ/(α + ωδ)^power, arrays (d, n)."""
    n = delta.shape[1]
    found, w, low, high = np.full(n, 0.5), np.full(n, 0.5), np.zeros(n), np.ones(n)
    moving = np.arange(n)
    for _ in range(MOST_STEPS):
        ratio = delta / (alpha + w * delta)
        terms = shares * ratio if power == 1 else shares * ratio * ratio / delta
        slope, bend = -terms.sum(axis=0), power * (terms * ratio).sum(axis=0)
        low, high = np.where(slope < 0, w, low), np.where(slope < 0, high, w)
        new = w - slope / bend
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        step = np.abs(new - w)
        found[moving] = w = new
        # Newton errs by (step / distance to a pole)², and no pole is nearer than the ends
        on = (step > 3e-8 * np.minimum(w, 1.0 - w)) & (high - low > 4e-16 * w)
        if not on.any():
            break
        if on.sum() < 0.75 * len(on):
            moving, w, low, high = moving[on], w[on], low[on], high[on]
            shares, alpha, delta = shares[:, on], alpha[:, on], delta[:, on]
    return found
