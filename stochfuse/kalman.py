"""The Kalman kernel: predict and update, the only copy.

In covariance form, thesis (23)–(27),

    predict   x̂⁻ = F x̂ + B u              P⁻ = F P Fᵀ + Q
    update    K = P⁻Hᵀ(H P⁻Hᵀ + R)⁻¹       x̂ = x̂⁻ + K(z − H x̂⁻)     P = (I − KH) P⁻ (I − KH)ᵀ + K R Kᵀ

in information form, with Y = P⁻¹ and y = P⁻¹x̂,

    predict   M = F⁻ᵀ Y F⁻¹                Y⁻ = (I + M Q)⁻¹ M        y⁻ = (I + M Q)⁻¹ F⁻ᵀ y + Y⁻B u
    update    Y = Y⁻ + HᵀR⁻¹H              y = y⁻ + HᵀR⁻¹z

and, for floating point only, in square-root form with P = L Lᵀ.

Departures from the source.  (23) and (25) print the estimator as if it knew the process noise v(k); an estimator
adds B u only.  (26) is printed as P = (I − KH)P⁻; the Joseph form used here equals it for the optimal K and keeps
P symmetric and positive semi-definite in floating point.  Q stands for the noise as it enters the state: where
the model has a noise gain G, the caller passes G Q Gᵀ.  The information form needs an invertible F and takes a
singular Y (no information at all) and a singular Q.

Accuracy.  The covariance form is accurate to rounding relative to P⁻; entries of P far below it (precise sensors:
R ≪ H P⁻Hᵀ) lose relative digits when the state has several dimensions.  The square-root form keeps them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from stochfuse.algebra import NUMPY, Algebra, inverse


class Estimate(NamedTuple):
    """A state estimate x (column, may be None where only the covariance matters) and its covariance P."""

    x: Any
    P: Any


class Information(NamedTuple):
    """The same in information form: y = P⁻¹x (column, may be None) and Y = P⁻¹."""

    y: Any
    Y: Any


def predict(estimate: Estimate, F: Any, Q: Any, Bu: Any = None, *, algebra: Algebra = NUMPY) -> Estimate:
    """Bring an estimate one step forward, thesis (23)/(24).

    Parameters
    ----------
    estimate : Estimate
        x of shape (..., d, 1) or None, P of shape (..., d, d).
    F : (..., d, d) state transition.
    Q : (..., d, d) process noise covariance as it enters the state (G Q Gᵀ).
    Bu : (..., d, 1) known input B u, optional.
    algebra : NUMPY (default), SYMPY or FIELD.

    Returns
    -------
    Estimate
        The predicted (prior) estimate.
    """
    x, P = estimate
    if x is not None:
        x = F @ x if Bu is None else F @ x + Bu
    return Estimate(x, algebra.symmetric(F @ P @ algebra.transpose(F) + Q))


def update(estimate: Estimate, H: Any, R: Any, z: Any = None, *, algebra: Algebra = NUMPY) -> Estimate:
    """Take one measurement into a prior estimate, thesis (25)–(27), covariance in Joseph form.

    Parameters
    ----------
    estimate : Estimate
        The prior: x of shape (..., d, 1) or None, P of shape (..., d, d), positive semi-definite, may be singular.
    H : (..., p, d) measurement matrix.
    R : (..., p, p) measurement noise covariance, positive definite.
    z : (..., p, 1) measurement; needed if the prior has a state.
    algebra : NUMPY (default), SYMPY or FIELD.

    Returns
    -------
    Estimate
        The posterior estimate.

    Raises
    ------
    ValueError
        If the prior has a state and no measurement is given.
    """
    x, P = estimate
    K = gain(P, H, R, algebra=algebra)
    A = algebra.identity_like(P) - K @ H
    posterior = algebra.symmetric(A @ P @ algebra.transpose(A) + K @ R @ algebra.transpose(K))
    if x is None:
        return Estimate(None, posterior)
    if z is None:
        raise ValueError("expected a measurement z for an estimate that has a state; got None")
    return Estimate(x + K @ (z - H @ x), posterior)


def gain(P: Any, H: Any, R: Any, *, algebra: Algebra = NUMPY) -> Any:
    """Kalman gain K = P Hᵀ (H P Hᵀ + R)⁻¹, shape (..., d, p), thesis (27)."""
    HP = H @ P
    return algebra.transpose(algebra.solve(HP @ algebra.transpose(H) + R, HP))


def to_information(estimate: Estimate, *, algebra: Algebra = NUMPY) -> Information:
    """Return the estimate in information form; P must be invertible."""
    Y = algebra.symmetric(inverse(estimate.P, algebra))
    return Information(None if estimate.x is None else Y @ estimate.x, Y)


def from_information(information: Information, *, algebra: Algebra = NUMPY) -> Estimate:
    """Return the estimate in covariance form; Y must be invertible."""
    P = algebra.symmetric(inverse(information.Y, algebra))
    return Estimate(None if information.y is None else P @ information.y, P)


def predict_information(
    information: Information, F: Any, Q: Any, Bu: Any = None, *, algebra: Algebra = NUMPY
) -> Information:
    """Bring an information pair one step forward; F must be invertible, Y and Q may be singular.

    Shapes are those of `predict`.
    """
    y, Y = information
    Ft = algebra.transpose(F)
    M = algebra.transpose(algebra.solve(Ft, algebra.transpose(algebra.solve(Ft, Y))))
    spread = algebra.identity_like(M) + M @ Q
    prior = algebra.symmetric(algebra.solve(spread, M))
    if y is not None:
        y = algebra.solve(spread, algebra.solve(Ft, y))
        y = y if Bu is None else y + prior @ Bu
    return Information(y, prior)


def update_information(
    information: Information, H: Any, R: Any, z: Any = None, *, algebra: Algebra = NUMPY
) -> Information:
    """Add one measurement's information HᵀR⁻¹H; shapes and errors are those of `update`."""
    y, Y = information
    HtRinv = algebra.transpose(algebra.solve(R, H))
    if y is None:
        return Information(None, algebra.symmetric(Y + HtRinv @ H))
    if z is None:
        raise ValueError("expected a measurement z for an estimate that has a state; got None")
    return Information(y + HtRinv @ z, algebra.symmetric(Y + HtRinv @ H))


def factor(P: np.ndarray) -> np.ndarray:
    """Square root L of a positive semi-definite P, P = L Lᵀ, for stacks (..., d, d), singular ones included.

    The matrix is scaled to unit diagonal first, so that the error is small in units of each state's own
    standard deviation, whatever their ratio.
    """
    scale = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    safe = np.where(scale > 0, scale, 1.0)
    eigenvalues, V = np.linalg.eigh(P / (safe[..., :, None] * safe[..., None, :]))
    return scale[..., :, None] * V * np.sqrt(np.maximum(eigenvalues, 0.0))[..., None, :]


def join_factors(*blocks: np.ndarray) -> np.ndarray:
    """Square factor, shape (..., d, d), of Σ B Bᵀ over blocks B of shape (..., d, any), by QR: nothing is squared."""
    batch = np.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    stacked = np.concatenate([np.broadcast_to(b, batch + b.shape[-2:]) for b in blocks], axis=-1)
    d, columns = stacked.shape[-2:]
    if columns < d:
        stacked = np.concatenate([stacked, np.zeros((*batch, d, d - columns))], axis=-1)
    return np.swapaxes(np.linalg.qr(np.swapaxes(stacked, -1, -2), mode="r"), -1, -2)


def predict_factor(L: np.ndarray, F: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Square-root form of (24): the factor of F L LᵀFᵀ + Q, with `noise` a factor of Q."""
    return join_factors(F @ L, noise)


def update_factor(
    L: np.ndarray, H: np.ndarray, R: np.ndarray, shrink: Callable[[np.ndarray], np.ndarray] = lambda s: 1.0 / (1.0 + s)
) -> np.ndarray:
    """Square-root form of (26), without an inverse and without a subtraction.

    With R^(−½) H L = U Σ Vᵀ the posterior factor is L V diag(√shrink(σ²), 1, …).

    Parameters
    ----------
    L : (..., d, d) factor of the prior covariance.
    H, R : measurement matrix (p, d) and noise covariance (p, p), positive definite.
    shrink : what remains of the prior variance in a direction whose signal-to-noise ratio is s = σ²;
        takes and returns arrays of shape (..., min(p, d)).  One measurement, the default, leaves 1/(1 + s).
    """
    whitened = np.linalg.solve(np.linalg.cholesky(R), H)
    U, sigma, Vt = np.linalg.svd(whitened @ L, full_matrices=True)
    k = sigma.shape[-1]
    U, V = U[..., :k], np.swapaxes(Vt, -1, -2)
    left = np.ones((*sigma.shape[:-1], L.shape[-1]))
    left[..., :k] = np.sqrt(shrink(sigma**2))
    posterior = L @ V * left[..., None, :]
    # V is orthogonal to rounding only, which in a direction measured with σ = 1e8 is an error of σ·1e-16: the posterior
    # must show the sensor exactly UΣ√shrink, and what differs is taken out along the measured directions
    shown = np.zeros((*sigma.shape[:-1], H.shape[-2], L.shape[-1]))
    shown[..., :k] = U * (sigma * left[..., :k])[..., None, :]
    strong = sigma > 1e-3 * np.maximum(sigma[..., :1], 1e3)
    inverse = np.where(strong, 1.0 / np.where(strong, sigma, 1.0), 0.0)
    excess = np.swapaxes(U, -1, -2) @ (whitened @ posterior - shown)
    return posterior - L @ V[..., :k] @ (inverse[..., None] * excess)


def from_factor(L: np.ndarray) -> np.ndarray:
    """P = L Lᵀ, symmetric to the last bit."""
    return NUMPY.symmetric(L @ np.swapaxes(L, -1, -2))
