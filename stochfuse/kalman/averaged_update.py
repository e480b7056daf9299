"""The Kalman update averaged over the number of arriving measurements: (54) in three numeric forms.

(54) is P = Σ β(m) P_m with P_m = update(P⁻, R/(m+1)) (`stochfuse.prediction.simplified` writes it so, and the tests
prove the identity).  None of the forms below builds the P_m; each needs only the averages E and g of
`stochfuse.kalman.arrivals`.

Scalar state
    P = P⁻ E(P⁻ J), with J = HᵀR⁻¹H.
Measurement space, for any state: with R = C Cᵀ and C⁻¹ H P⁻ HᵀC⁻ᵀ = U diag(s) Uᵀ,
    P = P⁻ − W diag(g(s)) Wᵀ,  W = P⁻HᵀC⁻ᵀU.
    Symmetric matrices are kept as their upper triangles with the batch in the last axis (struct of arrays), so that
    predict and the products with H are one matrix multiplication of a small constant matrix with the whole batch.
    Where every item has an R of its own, that matrix holds H itself, and C⁻¹ is applied afterwards.
Square root, where the measurement is so precise that the subtraction would cancel
    `stochfuse.kalman.kernel.update_factor` with E in the place of 1/(1 + s).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stochfuse.kalman.arrivals import Arrivals
from stochfuse.kalman.checks import INDEFINITE
from stochfuse.kalman.kernel import Estimate, predict

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


def upper(P: np.ndarray) -> np.ndarray:
    """Upper triangles (d(d+1)/2, items) of P (items, d, d)."""
    rows, columns, _ = triangle(P.shape[-1])
    return np.ascontiguousarray(P[:, rows, columns].T)


def noise_factor(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C of R = C Cᵀ for R of shape (items, p, p), and how nearly singular R is.

    Returns
    -------
    C : (p, p, items), lower triangular.
    left : (items,) smallest conditional variance of a noise given those before it, relative to its variance: about
        log10(1/left) digits are lost where C⁻¹ is applied to what has been rounded.  Not positive, or NaN, where R is
        singular to rounding.
    """
    C, left = np.zeros((*R.shape[1:], len(R))), np.ones(len(R))
    with np.errstate(all="ignore"):
        for i in range(len(C)):
            pivot = R[:, i, i] - (C[i, :i] ** 2).sum(axis=0)
            left = np.minimum(left, pivot / R[:, i, i])
            C[i, i] = np.sqrt(pivot)
            for j in range(i + 1, len(C)):
                C[j, i] = (R[:, j, i] - (C[j, :i] * C[i, :i]).sum(axis=0)) / C[i, i]
    return C, left


def solve_lower(C: np.ndarray, B: np.ndarray) -> np.ndarray:
    """C⁻¹B for lower triangles C (p, p, items) and B (p, columns, items or 1), by forward substitution."""
    out = np.empty((*B.shape[:2], C.shape[-1]))
    for i in range(len(out)):
        out[i] = B[i]
        for j in range(i):
            out[i] -= C[i, j] * out[j]
        out[i] /= C[i, i]
    return out


def update_scalar(prior: np.ndarray, J: float | np.ndarray, arrivals: Arrivals) -> np.ndarray:
    """P = P⁻ E(P⁻J) for a scalar state, shape (1, items), with J = HᵀR⁻¹H, one number or (items,).

    NaN where P⁻J is beyond floating point.
    """
    s = prior * J
    P = prior * arrivals.remaining(s)
    return P if np.isfinite(s.max(initial=0.0)) else np.where(np.isfinite(s), P, np.nan)


def update_measurement_space(
    stacked: np.ndarray, d: int, p: int, arrivals: Arrivals, C_inv: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Average the update in measurement space.

    Parameters
    ----------
    stacked : (rows, items) the prior as `prior_map` gives it; its first rows are overwritten with P.
    d, p : number of states and of measurements.
    arrivals : distribution of the number of messages, per item.
    C_inv : (p, p, items) lower triangle C⁻¹ of every item, or None if `stacked` is whitened already.

    Returns
    -------
    P : (d(d+1)/2, items) upper triangle of the averaged posterior.
    left : (items,) smallest share of prior variance that is left in any measured direction.  The subtraction
        loses about log10(1/left) digits.
    """
    n = d * (d + 1) // 2
    prior, AP, S = stacked[:n], stacked[n : n + p * d].reshape(p, d, -1), stacked[n + p * d :]
    s, W, squares = _diagonalise(S, AP, p, C_inv)
    g = arrivals.gained(s)
    left = 1.0 - (s * g).max(axis=0)
    if squares is not None:
        g *= squares
    P = prior  # overwritten: the caller made it for this step
    product, first = np.empty((d, P.shape[1])), 0
    for i in range(d):
        # row i of the upper triangle: entries (i, i) … (i, d−1) lie side by side
        row, some = P[first : first + d - i], product[: d - i]
        for j in range(p):
            np.multiply(g[j] * W[j, i], W[j, i:], out=some)
            row -= some
        first += d - i
    return P, left


def _diagonalise(
    S: np.ndarray, AP: np.ndarray, p: int, C_inv: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Eigenvalues s (p, items) of the whitened S, and AP turned into the eigenvectors' directions, rows W.

    The third is None, or the factors (p, items) by which the squares of W are still to be multiplied: where nothing
    turns, whitening is left to them.
    """
    if p > 2:
        return (*_diagonalise_stack(S, AP, p, C_inv), None)
    if C_inv is not None:
        S = _whitened(S, C_inv)
    if p == 1:
        return np.maximum(S, 0.0), AP, None if C_inv is None else C_inv[0] ** 2
    a, b, c = S
    if not b.any() and (C_inv is None or not C_inv[1, 0].any()):
        squares = None if C_inv is None else np.stack([C_inv[0, 0] ** 2, C_inv[1, 1] ** 2])
        return np.maximum(S[::2], 0.0), AP, squares
    half = 0.5 * (c - a)
    # tan of the Jacobi angle, from the smaller rotation: no cancellation for near-equal eigenvalues
    t = np.copysign(b, half * b) / (np.abs(half) + np.sqrt(half * half + b * b) + _TINY)
    cos = 1.0 / np.sqrt(1.0 + t * t)
    sin = t * cos
    s = np.stack([a - t * b, c + t * b])
    U = ((cos, -sin), (sin, cos))
    if C_inv is not None:
        U = tuple((u * C_inv[0, 0] + v * C_inv[1, 0], v * C_inv[1, 1]) for u, v in U)
    W = np.empty_like(AP)
    for row, (u, v) in zip(W, U, strict=True):
        np.multiply(u, AP[0], out=row)
        row += v * AP[1]
    return np.maximum(s, 0.0), W, None


def _whitened(S: np.ndarray, C_inv: np.ndarray) -> np.ndarray:
    """C⁻¹S C⁻ᵀ of one or two measurements, S and the result as upper triangles (p(p+1)/2, items)."""
    if len(C_inv) == 1:
        return S * C_inv[0] ** 2
    (first, _), (mixed, second) = C_inv
    a, b, c = S
    # first S, then its square: the mixed terms cancel as they do in C⁻¹(S C⁻ᵀ)
    turned = mixed * a + second * b
    return np.stack([first * first * a, first * turned, mixed * turned + second * (mixed * b + second * c)])


def _diagonalise_stack(
    S: np.ndarray, AP: np.ndarray, p: int, C_inv: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    S = np.moveaxis(S[triangle(p)[2]], -1, 0)
    C_inv = None if C_inv is None else np.moveaxis(C_inv, -1, 0)
    if C_inv is not None:
        S = C_inv @ S @ np.swapaxes(C_inv, -1, -2)
    usable = np.all(np.isfinite(S), axis=(1, 2))
    s, U = np.linalg.eigh(np.where(usable[:, None, None], S, 0.0))
    if C_inv is not None:
        U = np.swapaxes(C_inv, -1, -2) @ U
    W = np.einsum("bqj,qdb->jdb", U, AP)
    return np.where(usable, np.maximum(s.T, 0.0), np.nan), W


def smallest_pivot(P: np.ndarray, d: int, more: float = 0.0) -> np.ndarray:
    """Smallest conditional variance of a state given those before it, relative to its variance, shape (items,).

    P is given by its upper triangle, (d(d+1)/2, items).  The smaller, the more of the small directions of P is rounding
    that an earlier, larger P left behind.

    Parameters
    ----------
    more : what to add to P first, in units of each state's variance (1 where it has none): all pivots are positive
        where no eigenvalue, scaled to unit variances, is below −more.  NaN where a pivot is not positive.
    """
    rest, diagonal = P.copy(), triangle(d)[2].diagonal()
    variances = np.where(rest[diagonal] > 0, rest[diagonal], 1.0)
    if more:
        rest[diagonal] += more * variances
    smallest = np.ones(P.shape[1])
    for i, first in enumerate(diagonal):
        pivot, row = rest[first], rest[first + 1 : first + d - i]
        smallest = np.minimum(smallest, pivot / variances[i])
        column = row / np.where(pivot > 0, pivot, np.nan)
        for j, start in enumerate(diagonal[i + 1 :]):
            rest[start : start + len(row) - j] -= column[j] * row[j:]
    return smallest


def sound(P: np.ndarray) -> np.ndarray:
    """Whether each of P (d, d, items) is finite and positive semi-definite up to rounding, shape (items,).

    Cheap, and never satisfied with what `stochfuse.kalman.checks.covariance_fault` is not.
    """
    if len(P) == 1:
        return np.isfinite(P[0, 0]) & (P[0, 0] >= 0)
    rows, columns, _ = triangle(len(P))
    with np.errstate(all="ignore"):
        return (smallest_pivot(P[rows, columns], len(P), -INDEFINITE) > 0) & (np.diagonal(P) >= 0).all(axis=1)
