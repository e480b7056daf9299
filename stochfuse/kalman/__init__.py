"""The ground: the Kalman filter's equations, once for numbers and symbols, and covariances as numbers.

Doors: `kernel` (predict, update, in covariance, information and square-root form; the only copy), `packed` (its
covariances of many filters side by side, at speed) and `metrics` (one number out of a covariance, moments of an error).
`compiled` makes machine code of a recursion where llvmlite is installed; `packed` uses it when there is enough to do.
`averaged_update` and `arrivals` average the update over a number of arriving measurements, (54); `algebra` is what
differs between NumPy and SymPy; `checks` says why a matrix is no covariance.

It knows nothing but NumPy: no scenario, no network, no chance but the number of arrivals.  A new form of predict or
update goes into `kernel`, over the same `algebra`; a new metric into `metrics`, with its entry in
`stochfuse.scenario.registry`.

For arrays of one's own: `predict` and `update` here take means of shape (d,) or (d, 1), and batches in front;
`covariances` carries many filters through steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman import kernel
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.packed import covariances

__all__ = ["Estimate", "covariances", "predict", "update"]


def predict(estimate: Any, F: Any, Q: Any, Bu: Any = None) -> Estimate:
    """Predict one step, (23)/(24): x = F x + Bu, P = F P Fᵀ + Q.

    Parameters
    ----------
    estimate : (x, P): x of shape (..., d) or (..., d, 1), or None; P of shape (..., d, d).
    F, Q : (..., d, d) transition and process noise covariance.
    Bu : (..., d) or (..., d, 1) known input, or None.

    Returns
    -------
    Estimate
        The prior; its mean in the layout of the mean that was given.

    Raises
    ------
    UsageError
        If the mean does not fit the covariance.

    Examples
    --------
    >>> import stochfuse as sf
    >>> x, P = sf.kalman.predict(([1.0, 2.0], [[1, 0], [0, 1]]), [[1, 1], [0, 1]], [[0, 0], [0, 0]])
    >>> x
    array([3., 2.])
    >>> P
    array([[2., 1.],
           [1., 1.]])
    """
    given, flat = _columns(estimate)
    known = None if Bu is None else _column("Bu", Bu, given.P.shape[-1])[0]
    return _laid_out(kernel.predict(given, np.asarray(F, dtype=float), np.asarray(Q, dtype=float), known), flat)


def update(estimate: Any, H: Any, R: Any, z: Any = None) -> Estimate:
    """Take in a measurement z = H x + v, (25)–(27), Joseph form.

    Parameters
    ----------
    estimate : (x, P) as for `predict`.
    H, R : (..., p, d) measurement matrix, (..., p, p) measurement noise covariance.
    z : (..., p) or (..., p, 1); not used where there is no mean.

    Returns
    -------
    Estimate
        The posterior; its mean in the layout of the mean that was given.

    Raises
    ------
    UsageError
        If a mean does not fit its covariance.

    Examples
    --------
    >>> import stochfuse as sf
    >>> x, P = sf.kalman.update(([0.0], [[1.0]]), [[1.0]], [[1.0]], [2.0])
    >>> float(x[0]), float(P[0, 0])
    (1.0, 0.5)
    """
    given, flat = _columns(estimate)
    R = np.asarray(R, dtype=float)
    measured = None if z is None else _column("z", z, R.shape[-1])[0]
    return _laid_out(kernel.update(given, np.asarray(H, dtype=float), R, measured), flat)


def _columns(estimate: Any) -> tuple[Estimate, bool]:
    x, P = estimate
    P = np.asarray(P, dtype=float)
    if x is None:
        return Estimate(None, P), False
    column, flat = _column("x", x, P.shape[-1])
    return Estimate(column, P), flat


def _column(name: str, value: Any, d: int) -> tuple[np.ndarray, bool]:
    """A mean as columns (..., d, 1), and whether it came as (..., d)."""
    array = np.asarray(value, dtype=float)
    if array.ndim > 1 and array.shape[-2:] == (d, 1):
        return array, False
    if array.ndim and array.shape[-1] == d:
        return array[..., None], True
    raise UsageError(f"{name}: expected shape (..., {d}) or (..., {d}, 1), got {array.shape}")


def _laid_out(estimate: Estimate, flat: bool) -> Estimate:
    return Estimate(estimate.x[..., 0], estimate.P) if flat and estimate.x is not None else estimate
