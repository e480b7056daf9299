"""The Kalman update averaged over the number of arriving measurements: (54) in three numeric forms.

(54) is P = Σ β(m) P_m with P_m = update(P⁻, R/(m+1)) (`stochfuse.simplified` writes it so, and the tests prove
the identity).  None of the forms below builds the P_m; each needs only the averages E and g of `stochfuse.arrivals`.

Scalar state
    P = P⁻ E(P⁻ J), with J = HᵀR⁻¹H.
Measurement space, for any state: with R = C Cᵀ and C⁻¹ H P⁻ HᵀC⁻ᵀ = U diag(s) Uᵀ,
    P = P⁻ − W diag(g(s)) Wᵀ,  W = P⁻HᵀC⁻ᵀU.
    Symmetric matrices are kept as their upper triangles with the batch in the last axis (struct of arrays), so that
    predict and the products with H are one matrix multiplication of a small constant matrix with the whole batch.
Square root, where the measurement is so precise that the subtraction would cancel
    `stochfuse.kalman.update_factor` with E in the place of 1/(1 + s).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stochfuse.arrivals import Arrivals
from stochfuse.kalman import Estimate, predict

_TINY = 1e-300


@lru_cache(maxsize=64)
def triangle(d: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the upper triangle (rows, columns), and the (d, d) map from an entry to its place there."""
    rows, columns = np.triu_indices(d)
    place = np.zeros((d, d), dtype=int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return rows, columns, place


@lru_cache(maxsize=64)
def basis(d: int) -> np.ndarray:
    """A basis of the symmetric d×d matrices, in the order of their upper triangle."""
    rows, columns, _ = triangle(d)
    basis = np.zeros((len(rows), d, d))
    basis[np.arange(len(rows)), rows, columns] = basis[np.arange(len(rows)), columns, rows] = 1.0
    basis.setflags(write=False)
    return basis


def prior_map(F: np.ndarray, Q: np.ndarray, whitened: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and constant that take the upper triangle of P to those of P⁻ = F P Fᵀ + Q, A P⁻ and A P⁻Aᵀ, stacked.

    A = C⁻¹H is `whitened`.  The matrix is read off the kernel's own `predict`, applied to a basis of the symmetric
    matrices; the constant is what Q adds.
    """
    moved = predict(Estimate(None, basis(F.shape[-1])), F, np.zeros_like(Q)).P
    rows = _stack(np.concatenate([moved, Q[None]]), whitened)
    return np.ascontiguousarray(rows[:-1].T), rows[-1:].T


def _stack(P: np.ndarray, A: np.ndarray) -> np.ndarray:
    rows, columns, _ = triangle(P.shape[-1])
    p_rows, p_columns, _ = triangle(len(A))
    AP = A @ P
    S = AP @ A.T
    return np.concatenate([P[:, rows, columns], AP.reshape(len(P), -1), S[:, p_rows, p_columns]], axis=1)


def update_scalar(prior: np.ndarray, J: float, arrivals: Arrivals) -> np.ndarray:
    """P = P⁻ E(P⁻J) for a scalar state, shape (1, items), with J = HᵀR⁻¹H."""
    return prior * arrivals.remaining(prior * J)


def update_measurement_space(stacked: np.ndarray, d: int, p: int, arrivals: Arrivals) -> tuple[np.ndarray, np.ndarray]:
    """Average the update in measurement space.

    Parameters
    ----------
    stacked : (rows, items) the prior as `prior_map` gives it; its first rows are overwritten with P.
    d, p : number of states and of measurements.
    arrivals : distribution of the number of messages, per item.

    Returns
    -------
    P : (d(d+1)/2, items) upper triangle of the averaged posterior.
    left : (items,) smallest share of prior variance that is left in any measured direction.  The subtraction
        loses about log10(1/left) digits.
    """
    n = d * (d + 1) // 2
    prior, AP, S = stacked[:n], stacked[n : n + p * d].reshape(p, d, -1), stacked[n + p * d :]
    s, W = _diagonalise(S, AP, p)
    g = arrivals.gained(s)
    P = prior  # overwritten: the caller made it for this step
    product, first = np.empty((d, P.shape[1])), 0
    for i in range(d):
        # row i of the upper triangle: entries (i, i) … (i, d−1) lie side by side
        row, some = P[first : first + d - i], product[: d - i]
        for j in range(p):
            np.multiply(g[j] * W[j, i], W[j, i:], out=some)
            row -= some
        first += d - i
    return P, 1.0 - (s * g).max(axis=0)


def _diagonalise(S: np.ndarray, AP: np.ndarray, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (p, items) of S and the rows of AP turned into the eigenvectors' directions."""
    if p == 1:
        return np.maximum(S, 0.0), AP
    if p == 2:
        a, b, c = S
        if not b.any():
            return np.maximum(S[::2], 0.0), AP
        half = 0.5 * (c - a)
        # tan of the Jacobi angle, from the smaller rotation: no cancellation for near-equal eigenvalues
        t = np.copysign(b, half * b) / (np.abs(half) + np.sqrt(half * half + b * b) + _TINY)
        cos = 1.0 / np.sqrt(1.0 + t * t)
        sin = t * cos
        s = np.stack([a - t * b, c + t * b])
        W = np.stack([cos * AP[0] - sin * AP[1], sin * AP[0] + cos * AP[1]])
        return np.maximum(s, 0.0), W
    place = triangle(p)[2]
    usable = np.isfinite(S).all(axis=0)
    s, U = np.linalg.eigh(np.moveaxis(np.where(usable, S, 0.0)[place], -1, 0))
    W = np.einsum("bqj,qdb->jdb", U, AP)
    return np.where(usable, np.maximum(s.T, 0.0), np.nan), W


def smallest_pivot(P: np.ndarray, d: int) -> np.ndarray:
    """Smallest conditional variance of a state given those before it, relative to its variance, shape (items,).

    P is given by its upper triangle, (d(d+1)/2, items).  The smaller, the more of the small directions of P is rounding
    that an earlier, larger P left behind.
    """
    rest = P[triangle(d)[2]]
    variances = rest[np.arange(d), np.arange(d)].copy()
    smallest = np.ones(P.shape[1])
    for i in range(d):
        pivot = rest[i, i]
        smallest = np.minimum(smallest, pivot / np.where(variances[i] > 0, variances[i], 1.0))
        column = rest[i + 1 :, i] / np.where(pivot > 0, pivot, np.nan)
        rest[i + 1 :, i + 1 :] -= column[:, None] * rest[i, None, i + 1 :]
    return smallest
