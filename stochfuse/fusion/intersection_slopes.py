"""Criteria of (split) covariance intersection as functions of the weights, with their first and second derivatives.

Each signal is a sum of directions v of information, so that

    Y(ω) = C⁻¹ = Σ_k g_k(ω) v_k v_kᵀ       g(ω) = ω/(α + ω(1 − α))       0 ≤ α ≤ 1,

α being the possibly correlated share of the direction's variance (α = 1 in plain covariance intersection).  g is
concave, C is operator convex, and with S = EᵀC E for the states asked for (E selects them) each criterion φ(S) is
convex in ω:

    det       log det S                            trace    Σ S_jj
    lp        (Σ (weight_j S_jj)^p)^(1/p)          max-eig  largest eigenvalue of S

With u_k = EᵀC v_k and Z = ∂φ/∂S the derivatives are sums over pairs of directions,

    ∂φ/∂ω_i = − Σ_k∈i g_k′ u_kᵀZ u_k
    ∂²φ/∂ω_i∂ω_j = 2 Σ_k∈i Σ_l∈j g_k′ g_l′ (v_kᵀC v_l)(u_kᵀZ u_l) − δ_ij Σ_k∈i g_k″ u_kᵀZ u_k + φ″[∂_iS, ∂_jS].

The largest eigenvalue is not smooth where it is multiple, and there the optimum likes to be.  It is replaced by
min_t {t − µ log det(tI − S)}, whose Z = µ(tI − S)⁻¹ has trace one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.algebra import NUMPY, inverse


class Criterion(NamedTuple):
    """What the weights make small.

    Attributes
    ----------
    name : "det", "trace", "lp" or "max-eig".
    block : indices of the states whose block of C is measured; None takes all.
    p : exponent of "lp", at least 1.
    weights : positive weights of "lp", one for each state of the block; None takes ones.

    The weighted Lp norm is that of the variances, (Σ_j (weight_j C_jj)^p)^(1/p): a weight carries the unit of its
    state (one over an acceptable variance), p = 1 is the weighted trace and p → ∞ the largest weighted variance.  A
    norm of the eigenvalues would mix states of different units.
    """

    name: str = "det"
    block: Sequence[int] | None = None
    p: float = 2.0
    weights: Sequence[float] | None = None


class Directions(NamedTuple):
    """Information of m signals of at most p directions in N problems.

    Attributes
    ----------
    V : (N, d, m·p), the directions v as columns, signal by signal; zero where a signal has fewer.
    alpha : (N, m, p), the possibly correlated share of each; zero where a signal has fewer.
    """

    V: np.ndarray
    alpha: np.ndarray


class Slopes(NamedTuple):
    """Value (N,), gradient (N, m), Hessian (N, m, m), what the certificate needs, and the gradient at ω_i = 0."""

    value: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    S: np.ndarray
    Z: np.ndarray
    u: np.ndarray
    first: np.ndarray
    at_zero: np.ndarray


def share(alpha: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """g(ω) of each direction, shape (N, m, p); 1 whatever ω where α = 0, which is the limit."""
    w = weights[..., None]
    return np.where(alpha > 0, w / np.where(alpha > 0, alpha + w * (1.0 - alpha), 1.0), 1.0)


def information(directions: Directions, weights: np.ndarray) -> np.ndarray:
    """Y(ω), shape (N, d, d)."""
    V = directions.V
    g = share(directions.alpha, weights).reshape(len(V), 1, V.shape[-1])
    return NUMPY.symmetric((V * g) @ NUMPY.transpose(V))


def measure(criterion: Criterion, S: np.ndarray, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """φ(S), shape (N,), and Z = ∂φ/∂S; with mu > 0 the smooth form of the largest eigenvalue."""
    if criterion.name == "det":
        return np.linalg.slogdet(S)[1], NUMPY.symmetric(inverse(S))
    if criterion.name == "max-eig":
        return _largest(S, mu)
    units, p = _units(criterion, S.shape[-1])
    v = units * np.diagonal(S, axis1=-2, axis2=-1)
    top = v.max(axis=-1, keepdims=True)
    value = top * ((v / top) ** p).sum(axis=-1, keepdims=True) ** (1.0 / p)
    return value[:, 0], (units * (v / value) ** (p - 1.0))[:, None, :] * np.eye(S.shape[-1])


def _units(criterion: Criterion, b: int) -> tuple[np.ndarray, float]:
    if criterion.name == "trace":
        return np.ones(b), 1.0
    return np.ones(b) if criterion.weights is None else np.asarray(criterion.weights, dtype=float), criterion.p


def _largest(S: np.ndarray, mu: float) -> tuple[np.ndarray, np.ndarray]:
    eigenvalues, U = np.linalg.eigh(S)
    if mu == 0.0:
        return eigenvalues[:, -1], U[:, :, -1:] @ NUMPY.transpose(U[:, :, -1:])
    gap = eigenvalues[:, -1:] - eigenvalues
    above = np.full((len(S), 1), mu)
    for _ in range(25):  # Newton on Σ µ/(above + gap) = 1 from the left: monotone
        part = mu / (above + gap)
        above += (part.sum(axis=-1, keepdims=True) - 1.0) / (part / (above + gap)).sum(axis=-1, keepdims=True)
    value = eigenvalues[:, -1] + above[:, 0] - mu * np.log(above + gap).sum(axis=-1)
    part = mu / (above + gap)
    part /= part.sum(axis=-1, keepdims=True)
    return value, (U * part[:, None, :]) @ NUMPY.transpose(U)


def slopes_at(directions: Directions, E: np.ndarray, criterion: Criterion, weights: np.ndarray, mu: float) -> Slopes:
    """Value, gradient and Hessian at the weights; E (N, d, b), and mu > 0 for the largest eigenvalue only."""
    V, alpha = directions
    N, m, p = alpha.shape
    C = NUMPY.symmetric(inverse(information(directions, weights)))
    bottom = np.where(alpha > 0, alpha + weights[..., None] * (1.0 - alpha), 1.0)
    first = (alpha / bottom**2).reshape(N, -1)
    second = -2.0 * alpha * (1.0 - alpha) / bottom**3
    CV = C @ V
    u = NUMPY.transpose(E) @ CV
    S = NUMPY.symmetric(NUMPY.transpose(E) @ C @ E)
    value, Z = measure(criterion, S, mu)
    gram = NUMPY.transpose(u) @ Z @ u
    own = np.diagonal(gram, axis1=-2, axis2=-1)

    def blocks(pairs: np.ndarray) -> np.ndarray:
        weighted = first[:, :, None] * pairs * first[:, None, :]
        return weighted.reshape(N, m, p, m, p).sum(axis=(2, 4))

    hessian = blocks(2.0 * gram * (NUMPY.transpose(V) @ CV))
    hessian[:, range(m), range(m)] -= (second * own.reshape(N, m, p)).sum(axis=-1)
    if criterion.name == "det":
        hessian -= blocks(gram * gram)
    elif criterion.name == "max-eig":
        across = by_signal(first * ((Z @ u) ** 2).sum(axis=1), m)
        hessian += (blocks(gram * gram) - across[:, :, None] * across[:, None, :] / square(Z)) / mu
    else:
        hessian += _norm_curvature(criterion, S, value, u, first, m)
    at_zero = np.where(alpha > 0, own.reshape(N, m, p) / np.where(alpha > 0, alpha, 1.0), 0.0)
    return Slopes(value, -by_signal(first * own, m), NUMPY.symmetric(hessian), S, Z, u, first, -at_zero.sum(axis=-1))


def _norm_curvature(
    criterion: Criterion, S: np.ndarray, value: np.ndarray, u: np.ndarray, first: np.ndarray, m: int
) -> np.ndarray:
    """φ″ of the weighted Lp norm along the signals, shape (N, m, m)."""
    units, p = _units(criterion, S.shape[-1])
    v = units * np.diagonal(S, axis1=-2, axis2=-1) / value[:, None]
    moved = by_signal(units[:, None] * first[:, None, :] * u * u, m)
    tilt = (moved * (v ** (p - 1.0))[:, :, None]).sum(axis=1)
    bend = np.einsum("nbi,nb,nbj->nij", moved, v ** (p - 2.0), moved)
    return (p - 1.0) / value[:, None, None] * (bend - tilt[:, :, None] * tilt[:, None, :])


def by_signal(values: np.ndarray, m: int) -> np.ndarray:
    """Sum over the directions of each signal: (..., m·p) to (..., m)."""
    return values.reshape(*values.shape[:-1], m, -1).sum(axis=-1)


def square(Z: np.ndarray) -> np.ndarray:
    """Sum of squares of the entries, shape (N, 1, 1)."""
    return (Z * Z).sum(axis=(-2, -1), keepdims=True)
