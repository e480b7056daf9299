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

Accuracy.  The covariance form is accurate to rounding relative to P⁻, times the condition number of H P⁻Hᵀ + R in units
of its own deviations: precise sensors (R ≪ H P⁻Hᵀ) that measure nearly the same direction lose more.  Entries of P far
below P⁻ lose relative digits when the state has several dimensions.  The square-root form keeps them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from stochfuse.kalman.algebra import NUMPY, Algebra, inverse


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
    posterior = corrected(P, K, H, R, algebra=algebra)
    if x is None:
        return Estimate(None, posterior)
    if z is None:
        raise ValueError("expected a measurement z for an estimate that has a state; got None")
    return Estimate(x + K @ (z - H @ x), posterior)


def corrected(P: Any, K: Any, H: Any, R: Any, *, algebra: Algebra = NUMPY) -> Any:
    """Covariance after a correction with any gain K, (I − KH) P (I − KH)ᵀ + K R Kᵀ; shapes as for `update`."""
    A = algebra.identity_like(P) - K @ H
    return algebra.symmetric(A @ P @ algebra.transpose(A) + K @ R @ algebra.transpose(K))


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


def taken_in(P: np.ndarray, J: np.ndarray, x: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Covariance after measurements that bring information J, (I + PJ)⁻¹P, and (I + PJ)⁻¹x of an error x.

    For floating point only, of many small matrices side by side: their entries are on the *first* axes.  P and J may be
    singular.  As accurate as the condition number of I + PJ lets it be.

    Parameters
    ----------
    P, J : (d, d, ...) prior covariance, and HᵀR⁻¹H of the measurements together.
    x : (d, ...) prior error, or None.
    """
    d = len(P)
    if d == 1:
        left = 1.0 / (1.0 + P * J)
        return P * left, None if x is None else x * left[0]
    M = np.einsum("ij...,jk...->ik...", P, J)
    M[range(d), range(d)] += 1.0
    both = P if x is None else np.concatenate([P, x[:, None]], axis=1)
    if d == 2:
        adjugate = np.array([[M[1, 1], -M[0, 1]], [-M[1, 0], M[0, 0]]])
        both = np.einsum("ij...,jk...->ik...", adjugate, both) / (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0])
    else:
        solved = np.linalg.solve(np.moveaxis(M, (0, 1), (-2, -1)), np.moveaxis(both, (0, 1), (-2, -1)))
        both = np.moveaxis(solved, (-2, -1), (0, 1))
    P = both[:, :d]
    return 0.5 * (P + P.swapaxes(0, 1)), None if x is None else both[:, d]


def factor(P: np.ndarray) -> np.ndarray:
    """Square root L of a positive semi-definite P, P = L Lᵀ, for stacks (..., d, d), singular ones included.

    Cholesky's decomposition, the largest remaining variance first: exact to rounding in units of each state's own
    standard deviation, and small independent errors stay in columns of their own.
    """
    rest = np.array(P, dtype=float)
    d = rest.shape[-1]
    L = np.zeros_like(rest)
    negligible = 2e-16 * d * np.diagonal(rest, axis1=-2, axis2=-1)
    for column in range(d):
        variances = np.diagonal(rest, axis1=-2, axis2=-1)
        variances = np.where(variances > negligible, variances, 0.0)
        pivot = variances.argmax(axis=-1)[..., None]
        variance = np.take_along_axis(variances, pivot, axis=-1)
        chosen = np.take_along_axis(rest, pivot[..., None], axis=-1)[..., 0]
        safe = np.sqrt(np.where(variance > 0, variance, 1.0))
        L[..., column] = np.where(variance > 0, chosen / safe, 0.0)
        rest -= L[..., :, None, column] * L[..., None, :, column]
        np.put_along_axis(rest, np.broadcast_to(pivot[..., None], (*rest.shape[:-1], 1)), 0.0, axis=-1)
        np.put_along_axis(rest, np.broadcast_to(pivot[..., None], (*rest.shape[:-2], 1, d)), 0.0, axis=-2)
    return L


def join_factors(*blocks: np.ndarray) -> np.ndarray:
    """Square factor, shape (..., d, d), of Σ B Bᵀ over blocks B of shape (..., d, any); nothing is squared.

    Reflections bring the sources of error (the columns) together, the largest first, for the states in the order of
    their size (Powell and Reid): that keeps the relative accuracy of small sources beside large ones, which a
    library's QR decomposition does not.
    """
    batch = np.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    stacked = np.concatenate([np.broadcast_to(b, batch + b.shape[-2:]) for b in blocks], axis=-1)
    d, columns = stacked.shape[-2:]
    if columns < d:
        stacked = np.concatenate([stacked, np.zeros((*batch, d, d - columns))], axis=-1)
    order = np.argsort(-(stacked * stacked).sum(axis=-1), axis=-1, kind="stable")[..., None]
    stacked = np.take_along_axis(stacked, order, axis=-2)
    for i in range(d):
        _turn_onto_column(i, stacked)
    L = np.empty((*batch, d, d))
    np.put_along_axis(L, np.broadcast_to(order, L.shape), stacked[..., :d], axis=-2)
    return L


def predict_factor(L: np.ndarray, F: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Square-root form of (24): the factor of F L LᵀFᵀ + Q, with `noise` a factor of Q."""
    return join_factors(F @ L, noise)


def update_factor(
    L: np.ndarray, H: np.ndarray, R: np.ndarray, shrink: Callable[[np.ndarray], np.ndarray] = lambda s: 1.0 / (1.0 + s)
) -> np.ndarray:
    """Square-root form of (26), without an inverse and without a subtraction.

    With R = C Cᵀ and C⁻¹H L = U Σ Vᵀ the posterior factor is L V diag(√shrink(σ²), 1, …).

    U comes from one-sided Jacobi rotations and V from Householder reflections that are applied to L one after the
    other, the largest component first.  A general SVD knows V to rounding only; a reflection keeps the *relative* size
    of its small components, and with them states that become a trillion times better known than they were.

    Parameters
    ----------
    L : (..., d, d) factor of the prior covariance.
    H, R : measurement matrix (..., p, d) and noise covariance (..., p, p), positive definite.
    shrink : what remains of the prior variance in a direction whose signal-to-noise ratio is s = σ²;
        takes and returns arrays of shape (..., min(p, d)).  One measurement, the default, leaves 1/(1 + s).
    """
    d = L.shape[-1]
    whitened = np.linalg.solve(np.linalg.cholesky(R), H)
    rows, turned = _orthogonal_rows(whitened @ L, whitened)
    k = min(rows.shape[-2], d)
    sigma = np.sqrt((rows[..., :k, :] ** 2).sum(axis=-1))
    L = np.broadcast_to(L, (*rows.shape[:-2], d, d)).copy()
    for i in range(k):
        _turn_onto_column(i, rows, L)
        rows[..., i + 1 :, i] = 0.0  # the rows are orthogonal
    _show_exactly(turned[..., :k, :], L, sigma)
    left = np.ones((*sigma.shape[:-1], d))
    left[..., :k] = np.sqrt(shrink(sigma**2))
    return L * left[..., None, :]


def posterior_gain(L: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Kalman gain K = P HᵀR⁻¹ from the factor of the posterior P = L Lᵀ, shape (..., d, p), for precise sensors."""
    return L @ (np.swapaxes(L, -1, -2) @ np.swapaxes(np.linalg.solve(R, H), -1, -2))


def _show_exactly(turned: np.ndarray, L: np.ndarray, sigma: np.ndarray) -> None:
    """Take out of L, in place, what rounding left of it in measured directions where Uᵀ C⁻¹H L should be 0.

    A state that is measured by itself with σ = 1e8 would otherwise keep an error of 1e-16·σ.  Where the product is
    itself no more than rounding, there is nothing to take out.
    """
    k = sigma.shape[-1]
    excess = turned @ L
    shown = excess[..., np.arange(k), np.arange(k), None].copy()
    excess[..., np.arange(k), np.arange(k)] = 0.0
    noise = 1e-15 * (np.abs(turned) @ np.abs(L))
    strong = (sigma > 1e3)[..., None] & (np.abs(excess) > noise)
    weights = np.where(strong, excess / np.where(shown != 0, shown, 1.0), 0.0)
    L -= L[..., :k] @ weights


def _orthogonal_rows(A: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """UᵀA with orthogonal rows, the longest first, and UᵀW; U a product of Jacobi rotations, A, W (..., p, d)."""
    p, d = A.shape[-2:]
    both = np.concatenate([A, np.broadcast_to(W, (*A.shape[:-2], *W.shape[-2:]))], axis=-1)
    for _ in range(12 if p > 1 else 0):
        largest = 0.0
        for i in range(p - 1):
            for j in range(i + 1, p):
                x, y = both[..., i, :], both[..., j, :]
                a, c = (x[..., :d] ** 2).sum(axis=-1), (y[..., :d] ** 2).sum(axis=-1)
                b = (x[..., :d] * y[..., :d]).sum(axis=-1)
                size = np.sqrt(a) * np.sqrt(c)
                largest = max(largest, float(np.divide(np.abs(b), size, out=np.zeros_like(b), where=size > 0).max()))
                half = 0.5 * (c - a)
                t = np.copysign(b, half * b) / (np.abs(half) + np.sqrt(half * half + b * b) + 1e-300)
                cos = (1.0 / np.sqrt(1.0 + t * t))[..., None]
                sin = t[..., None] * cos
                both[..., i, :], both[..., j, :] = cos * x - sin * y, sin * x + cos * y
        if largest < 1e-15:
            break
    order = np.argsort(-(both[..., :d] ** 2).sum(axis=-1), axis=-1, kind="stable")
    both = np.take_along_axis(both, order[..., None], axis=-2)
    return both[..., :d].copy(), both[..., d:]


def _turn_onto_column(i: int, rows: np.ndarray, *others: np.ndarray) -> None:
    """Reflect in place: row i of `rows` gets its length from column i on into column i; `others` go with it."""
    pivot = (i + np.abs(rows[..., i, i:]).argmax(axis=-1))[..., None, None]
    for M in (rows, *others):
        index = np.broadcast_to(pivot, (*M.shape[:-1], 1))
        chosen = np.take_along_axis(M, index, axis=-1)
        np.put_along_axis(M, index, M[..., i : i + 1].copy(), axis=-1)
        M[..., i : i + 1] = chosen
    v = rows[..., i, i:].copy()
    largest = np.abs(v).max(axis=-1, keepdims=True)
    v /= np.where(largest > 0, largest, 1.0)
    v[..., 0] += np.copysign(np.sqrt((v * v).sum(axis=-1)), v[..., 0])
    square = (v * v).sum(axis=-1)
    scale = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0)
    for M in (rows[..., i:, i:], *(other[..., :, i:] for other in others)):
        M -= (scale[..., None] * (M @ v[..., None])[..., 0])[..., None] * v[..., None, :]
    rows[..., i, i + 1 :] = 0.0


def from_factor(L: np.ndarray) -> np.ndarray:
    """P = L Lᵀ, symmetric to the last bit."""
    return NUMPY.symmetric(L @ np.swapaxes(L, -1, -2))


def at_step(matrix: np.ndarray, step: int) -> np.ndarray:
    """Return the matrix that holds at a step, counted from 1: itself if constant, else its entry."""
    return matrix if matrix.ndim == 2 else matrix[step - 1]


class SquareRootNumbers(Protocol):
    """What the numbers of a recursion in square-root form go through."""

    def factor(self, P: np.ndarray) -> np.ndarray:
        """Square root of a given covariance."""
        ...

    def rounded(self, L: np.ndarray) -> np.ndarray:
        """Return a factor that has been computed, or another matrix with errors of rounding."""
        ...

    def noise(self, R: np.ndarray) -> np.ndarray:
        """Return a given noise covariance, which is about to be factored."""
        ...


class AsTheyAre:
    """Numbers as they are; `stochfuse.engines.precision.Moving` moves them."""

    def factor(self, P: np.ndarray) -> np.ndarray:
        """Square root of a given covariance."""
        return factor(P)

    def rounded(self, L: np.ndarray) -> np.ndarray:
        """Return the same."""
        return L

    def noise(self, R: np.ndarray) -> np.ndarray:
        """Return the same."""
        return R
