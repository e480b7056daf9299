"""The extended Kalman filter: the kernel of `stochfuse.kalman.kernel` around functions of the state.

    predict   x̂⁻ = f(x̂)                    P⁻ = F P Fᵀ + Q             F = ∂f/∂x at x̂
    update    x̂ = x̂⁻ + K(z − h(x̂⁻))        P and K as for a linear H     H = ∂h/∂x at x̂⁻

The update is that of an error state: the kernel takes the innovation as the measurement of an error whose estimate is
zero, so that no large h(x̂⁻) is added and taken away again.  The covariance is that of the linearised problem: a claim,
true as far as f and h are straight over the spread of the errors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.kernel import Estimate, at_step, predict, update

STEP = float(np.cbrt(np.finfo(float).eps))
"""Step of a central difference in units of the state's size: errors of rounding and of curvature are then alike."""

Function = Callable[[np.ndarray], np.ndarray]


class NonlinearModel(NamedTuple):
    """What the filter is told of a motion and a sensor.

    Parameters
    ----------
    f, h : transition and measurement as functions of the state, columns to columns; for `extended_filter` of the state
        and of the step (counted from 1) that they lead to.
    F, H : their Jacobians, functions of the same; by central differences where None.
    residual : innovation of z and h(x̂⁻); their difference by default.  Angles need one that wraps.
    """

    f: Callable[..., np.ndarray]
    h: Callable[..., np.ndarray]
    F: Callable[..., np.ndarray] | None = None
    H: Callable[..., np.ndarray] | None = None
    residual: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.subtract

    def at(self, step: int) -> NonlinearModel:
        """Return the functions of the state alone that lead to a step."""

        def there(g: Callable[..., np.ndarray] | None) -> Any:
            return None if g is None else lambda x: g(x, step)

        return NonlinearModel(there(self.f), there(self.h), there(self.F), there(self.H), self.residual)


class Track(NamedTuple):
    """Estimates over all steps: x (steps, ..., d, 1) and P (steps, ..., d, d), after each step's update."""

    x: np.ndarray
    P: np.ndarray


def jacobian(f: Function, x: np.ndarray) -> np.ndarray:
    """Derivative (..., m, d) of f at x by central differences.

    Parameters
    ----------
    f : takes a stack of columns (..., d, 1) to a stack of columns (..., m, 1).
    x : (..., d, 1).  Each state is moved by `STEP` times its size, or times one where that is larger.
    """
    step = STEP * np.maximum(np.abs(x), 1.0)
    columns = []
    for i in range(x.shape[-2]):
        above, below = x.copy(), x.copy()
        above[..., i, :] += step[..., i, :]
        below[..., i, :] -= step[..., i, :]
        columns.append((f(above) - f(below)) / (above - below)[..., i : i + 1, :])
    return np.concatenate(columns, axis=-1)


def extended_step(
    estimate: Estimate, model: NonlinearModel, Q: np.ndarray, R: np.ndarray, z: np.ndarray | None
) -> Estimate:
    """Predict, and take in a measurement where there is one.

    Parameters
    ----------
    estimate : x (..., d, 1) and P (..., d, d) after the previous step.
    model : transition and measurement as functions of the state.
    Q, R : process and measurement noise covariances, (..., d, d) and (..., p, p).
    z : (..., p, 1) measurement, None where nothing arrived.

    Returns
    -------
    Estimate
        The posterior; the prior without a measurement.

    Raises
    ------
    UsageError
        If the innovation does not fit R.
    """
    x, P = estimate
    f, h, F, H, residual = model
    prior = Estimate(f(x), predict(Estimate(None, P), jacobian(f, x) if F is None else F(x), Q).P)
    if z is None:
        return prior
    innovation = residual(z, h(prior.x))
    if innovation.shape[-2:] != (R.shape[-1], 1):
        raise UsageError(
            f"z: expected a column of {R.shape[-1]} rows as R has, got an innovation of "
            f"{'×'.join(map(str, innovation.shape[-2:]))}"
        )
    H_here = jacobian(h, prior.x) if H is None else H(prior.x)
    error = update(Estimate(np.zeros_like(prior.x), prior.P), H_here, R, innovation)
    return Estimate(prior.x + error.x, error.P)


def extended_filter(start: Estimate, model: NonlinearModel, Q: np.ndarray, R: np.ndarray, z: np.ndarray) -> Track:
    """Run the extended filter over a record of measurements.

    Step 1 holds the first estimate; from step 2 on predict, update.

    Parameters
    ----------
    start : the estimate of step 1, x (..., d, 1) and P (..., d, d).
    model : its functions are of the state and of the step (counted from 1) that they lead to.
    Q, R : constant, or per step with the step on the first axis.
    z : (steps, ..., p, 1) record; the entry of step 1 is not used, and a step whose entries are all NaN had none.

    Returns
    -------
    Track
        The estimates of all steps.

    Raises
    ------
    UsageError
        If a measurement is only partly NaN, or does not fit R.
    """
    estimates = [start]
    for step, measured in enumerate(z[1:], start=2):
        missing = np.isnan(measured)
        if missing.any() and not missing.all():
            raise UsageError(
                f"z: expected at step {step} all entries or all NaN, got {missing.sum()} NaN of {missing.size}"
            )
        estimates.append(
            extended_step(
                estimates[-1],
                model.at(step),
                at_step(Q, step),
                at_step(R, step),
                None if missing.all() else measured,
            )
        )
    P = np.broadcast_arrays(*(estimate.P for estimate in estimates))
    x = np.broadcast_arrays(*(estimate.x for estimate in estimates))
    return Track(np.stack(x), np.stack(P))
