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

import numpy as np

from stochfuse.kalman.arrivals import Arrivals
from stochfuse.kalman.packed import subtract, triangle

_TINY = 1e-300


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
    subtract(prior, g[:, None] * W, W, np.empty_like(prior), prior)  # overwritten: the caller made it for this step
    return prior, left


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
