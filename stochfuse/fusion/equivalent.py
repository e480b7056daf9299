"""One equivalent measurement for several sensors with correlated and uncertain noise.

Sensors z_i = H x + v_i + δ_i on one platform (a paper on an extended Kalman filter with fusion under uncertain noise;
the copy at hand has lost its formulas, these are derived here).  The noises v have the joint covariance R; of
the disturbances δ only a bound E[δδᵀ] ≤ Δ is known, and nothing of their correlation with v.  For any ε > 0

    cov(v + δ) ≤ S_ε = (1 + ε) R + (1 + 1/ε) Δ
    z̄ = A z,   A = (EᵀS_ε⁻¹E)⁻¹EᵀS_ε⁻¹,   R̄ = A S_ε Aᵀ = (EᵀS_ε⁻¹E)⁻¹,   E = [I I … I]ᵀ

with ε chosen to minimise tr R̄.

The bound holds for each z̄ by itself.  A filter that takes R̄ for white noise averages it down over time, which is right
for disturbances that come anew with every measurement and too good for one that persists.

The optimum is global.  Put t = 1/(1 + ε); then (1 + ε) a + (1 + 1/ε) b = a/t + b/(1 − t), and

    φ(A, t) = tr(A R Aᵀ)/t + tr(A Δ Aᵀ)/(1 − t)

is a sum of squares over something linear, so convex in A and t *together*, on the convex set Σ A_i = I, 0 < t < 1.  Its
minimum over A, which is tr R̄, is therefore convex in t: it has one valley, and where its slope is zero it is lowest.
By the envelope theorem the slope has the sign of b − ε²a, with a = tr A R Aᵀ and b = tr A Δ Aᵀ at the best A for ε: one
root, found by Brent's method in ln ε.  There ε = √(b/a) and tr R̄ = (√a + √b)²; for any other A as well that is the
least bound that some ε gives, so a rounded root still yields a bound.

The optimum may lie at an end: a combination without disturbance can be worth taking alone (ε → 0), or one without
noise (ε → ∞).  Then A minimises b first and a among what is left, or the other way round.  The ends are taken where no
root lies within a factor `REACH` of √(tr Δ / tr R).

Bound condition.  The fused bound shall not exceed that of any single sensor.  At one common ε this holds in the matrix
order, R̄ ≤ S_ε,ii, since the sensor alone is one of the candidates A.  At each sensor's *own* best ε_i it holds for the
traces, if ε is optimal; the matrix order need not hold there.  What is required is tr R̄ ≤ tr R̄_i for every i.  A
caller's own ε may break it, and is refused if it does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.blender import RANK, blend_all, references, semidefinite, size_of, spectrum
from stochfuse.kalman.algebra import NUMPY

REACH = 1e8
"""Largest factor between ε and √(tr Δ / tr R) for which it is sought."""
NEGLIGIBLE = 1e-13
"""Largest singular value of differences, in units of standard deviations, that is taken for zero."""
ROUNDING = 1e-9
"""Largest relative excess over a single sensor's bound that is taken for rounding."""


class Equivalent(NamedTuple):
    """One measurement z̄ = A z in place of several.

    weights : (p, n·p), A, the sensors side by side.
    R : (p, p), what is claimed of the error of z̄: the bound R̄.
    epsilon : ε, 0 where S = R (no disturbance in z̄), inf where S = Δ (no noise in z̄).
    single : for each sensor the bound (p, p) on its own error, at its own best ε.
    """

    weights: np.ndarray
    R: np.ndarray
    epsilon: float
    single: tuple[np.ndarray, ...]


def equivalent_measurement(
    R: np.ndarray, sensors: int, Delta: np.ndarray | None = None, epsilon: float | None = None
) -> Equivalent:
    """Fuse the measurements of several sensors into one, with a bound on its error.

    Parameters
    ----------
    R : (n·p, n·p) joint covariance of the sensors' noises.
    sensors : how many sensors n there are.
    Delta : (n·p, n·p) bound on E[δδᵀ]; none by default.
    epsilon : ε > 0; by default the one with the least trace of the bound.

    Returns
    -------
    Equivalent
        Weights, bound, ε and the single sensors' bounds.

    Raises
    ------
    UsageError
        If R or Δ is not positive semi-definite or does not fit, R + Δ is singular, or ε is not positive and finite.
    NoAnswerError
        If at the given ε the bound's trace exceeds that of some single sensor.
    """
    R, D = _checked(R, Delta, sensors)
    if epsilon is not None and not (np.isfinite(epsilon) and epsilon > 0):
        raise UsageError(f"epsilon: expected a positive finite number, got {epsilon}")
    start, T = references(R + D, sensors)
    T = T[T.any(axis=-1)]
    v, d = _square_root(R), _square_root(D)
    best = _best(start, T, v, d) if epsilon is None else [_least(start, T, _joined(epsilon, v, d))]
    A = min(best, key=lambda A: _bound(A, v, d)[0].trace())
    single = tuple(_bound(part, v, d)[0] for part in np.split(np.eye(len(R)), sensors))
    answer = Equivalent(A, *_bound(A, v, d, epsilon), single)
    _check_bound(answer)
    return answer


def independent_measurement(R: np.ndarray, sensors: int) -> Equivalent:
    """Fuse as if the sensors' noises were independent and nothing else disturbed them, for comparison.

    Parameters
    ----------
    R : (n·p, n·p) joint covariance of the noises, of which the diagonal blocks alone are used.
    sensors : how many sensors n there are.

    Returns
    -------
    Equivalent
        A_i = (Σ R_jj⁻¹)⁻¹R_ii⁻¹, and (Σ R_jj⁻¹)⁻¹ as the error it claims; `actual_error` tells the true one.
    """
    R, _ = _checked(R, None, sensors)
    p = len(R) // sensors
    own = R * np.kron(np.eye(sensors), np.ones((p, p)))
    fused = blend_all(own, sensors)
    single = tuple(R[i : i + p, i : i + p] for i in range(0, len(R), p))
    return Equivalent(np.concatenate(fused.weights, axis=-1), fused.P, 0.0, single)


def actual_error(weights: np.ndarray, R: np.ndarray, disturbance: np.ndarray | None = None) -> np.ndarray:
    """True error covariance A (R + D) Aᵀ of z̄, (..., p, p), where the disturbance has covariance D ≤ Δ.

    Parameters
    ----------
    weights : (..., p, n·p) A.
    R, disturbance : (..., n·p, n·p) covariances of v and of δ, uncorrelated with one another.
    """
    total = R if disturbance is None else R + disturbance
    return NUMPY.symmetric(weights @ total @ NUMPY.transpose(weights))


def _checked(R: np.ndarray, Delta: np.ndarray | None, sensors: int) -> tuple[np.ndarray, np.ndarray]:
    """R and Δ as checked matrices."""
    R = semidefinite("R", R)
    if R.ndim != 2 or sensors < 1 or not R.size or len(R) % sensors:
        raise UsageError(f"R: expected {sensors} sensors' blocks of one size, got a {size_of(R)} matrix")
    D = np.zeros_like(R) if Delta is None else semidefinite("Delta", Delta)
    if D.shape != R.shape:
        raise UsageError(f"Delta: expected a {len(R)}×{len(R)} matrix as R is, got {size_of(D)}")
    if spectrum(R + D, np.diagonal(R + D))[0].min() <= RANK:
        raise UsageError("R + Delta: expected a positive definite matrix, got a singular one")
    return R, D


def _best(start: np.ndarray, T: np.ndarray, v: np.ndarray, d: np.ndarray) -> list[np.ndarray]:
    """Weights among which those of the least (√a + √b)² are; v and d are square roots of R and Δ."""
    if not v.any() or not d.any():
        return [_least(start, T, v + d)]
    unit = np.log(np.linalg.norm(d) / np.linalg.norm(v))

    def weights(log_epsilon: float) -> np.ndarray:
        return _least(start, T, _joined(np.exp(log_epsilon), v, d))

    root, end = _root(lambda u: _slope(weights(u), u, v, d), unit - np.log(REACH), unit + np.log(REACH))
    if not end:
        return [weights(root)]
    return [weights(root), _in_turn(start, T, d, v) if end < 0 else _in_turn(start, T, v, d)]


def _joined(epsilon: float, v: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return a square root of εR + Δ, which is S_ε up to a factor."""
    return np.concatenate([np.sqrt(epsilon) * v, d], axis=-1)


def _least(start: np.ndarray, T: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Among all A = start − X T the one with the least A C Aᵀ, C = root rootᵀ, by least squares.

    Nothing is squared: ε may take R far below Δ, or above, before the smaller of the two drowns.
    """
    scale, differences = _scaled(T @ root)
    X = np.linalg.lstsq(differences.T, (start @ root).T, rcond=NEGLIGIBLE)[0].T
    return start - X @ (scale * T)


def _in_turn(start: np.ndarray, T: np.ndarray, first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Weights that minimise A C Aᵀ for the first covariance, and for the other among those that do; by square roots.

    T must have independent rows: of what is left free none may be rounding.
    """
    scale, differences = _scaled(T @ first)
    U, values, _ = np.linalg.svd(differences)
    rank = int((values > NEGLIGIBLE * values[0]).sum())
    A = _least(start, T, first)
    return _least(A, U[:, rank:].T @ (scale * T), then) if rank < len(T) else A


def _scaled(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors (rows, 1) that make rows of unit length, and the rows; what is zero stays."""
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    scale = 1.0 / np.where(length > 0, length, 1.0)
    return scale, scale * rows


def _square_root(C: np.ndarray) -> np.ndarray:
    """L with C = L Lᵀ, rounding of a singular C left out: A C Aᵀ from it can be as small as the squares of rounding."""
    values, vectors, scale = spectrum(C, np.diagonal(C, axis1=-2, axis2=-1))
    kept = np.sqrt(np.where(values > 1e-15 * C.shape[-1], values, 0.0))
    return vectors * kept[..., None, :] / scale[..., :, None]


def _slope(A: np.ndarray, log_epsilon: float, v: np.ndarray, d: np.ndarray) -> float:
    """(ε²a − b)/(ε²a + b), of the sign of d tr R̄/dε."""
    a, b = np.exp(2 * log_epsilon) * ((A @ v) ** 2).sum(), ((A @ d) ** 2).sum()
    return float((a - b) / (a + b))


def _root(slope: Callable[[float], float], low: float, high: float) -> tuple[float, int]:
    """Where the slope changes its sign; or the end where it is lowest, and which: −1 the lower, 1 the upper, else 0."""
    if slope(low) >= 0:
        return low, -1
    if slope(high) <= 0:
        return high, 1
    return root_scalar(slope, bracket=(low, high), method="brentq", xtol=1e-13).root, 0


def _bound(A: np.ndarray, v: np.ndarray, d: np.ndarray, epsilon: float | None = None) -> tuple[np.ndarray, float]:
    """A S_ε Aᵀ, at the ε given or that of the least trace for this A; and ε.  v, d: square roots of R and Δ."""
    noise, disturbance = _without_rounding(A, v), _without_rounding(A, d)
    a, b = np.linalg.norm(noise), np.linalg.norm(disturbance)
    if b == 0 and epsilon is None:
        return noise @ noise.T, 0.0
    if a == 0 and epsilon is None:
        return disturbance @ disturbance.T, np.inf
    e = float(b / a) if epsilon is None else epsilon
    return (1 + e) * noise @ noise.T + (1 + 1 / e) * disturbance @ disturbance.T, e


def _without_rounding(A: np.ndarray, L: np.ndarray) -> np.ndarray:
    """A L, zero where all of it is rounding."""
    product = A @ L
    return product if (np.abs(product) > 1e-14 * (np.abs(A) @ np.abs(L))).any() else np.zeros_like(product)


def _check_bound(answer: Equivalent) -> None:
    """Refuse a bound whose trace exceeds a single sensor's."""
    trace = answer.R.trace()
    for i, alone in enumerate(answer.single):
        if trace > alone.trace() * (1 + ROUNDING):
            raise NoAnswerError(
                f"epsilon: expected a bound no larger than that of any single sensor, got trace {trace:.6g} at "
                f"epsilon = {answer.epsilon:.6g}, where sensors[{i}] alone has {alone.trace():.6g}"
            )
