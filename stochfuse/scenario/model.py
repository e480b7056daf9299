"""The linear-Gaussian model and its sensors, thesis (21)/(22).

    x(k) = F x(k−1) + B u + G v      v ~ N(0, Q)
    z(k) = H x(k) + w                w ~ N(0, R)

Every matrix is either constant or given per step, with the step on the first axis.  The entry of step 1 of
F, Q, G, B, u, H and R is never used: at step 1 the agents exchange their initial estimates, before any
prediction or measurement (see `stochfuse.scenario.scenario`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stochfuse.kalman.kernel import at_step


def varies(M: np.ndarray) -> bool:
    """Whether a matrix depends on the step: a stack, and not one matrix seen at every step (`over_steps`)."""
    return M.ndim > 2 and M.strides[0] != 0


def over_steps(M: np.ndarray, steps: int) -> np.ndarray:
    """Return a matrix, constant or per step, as a stack over the steps; a constant one takes no memory more."""
    return np.broadcast_to(M, (steps, *M.shape)) if M.ndim == 2 else M[:steps]


def once(M: np.ndarray) -> np.ndarray:
    """Return a matrix that is the same at every step as one matrix, what depends on the step as it is."""
    return M if M.ndim == 2 or varies(M) else M[0]


@dataclass(frozen=True, eq=False)
class Sensor:
    """What an agent measures.

    Parameters
    ----------
    H, R : (p, d) and (p, p), each constant or with a leading step axis.
    detection : probability that it measures anything at a step, () or (steps,); None where that is certain.
    """

    H: np.ndarray
    R: np.ndarray
    detection: np.ndarray | None = None

    def at(self, step: int) -> Sensor:
        """Return what it measures at a step, if it measures."""
        detection = self.detection
        now = detection if detection is None or detection.ndim == 0 else detection[step - 1]
        return Sensor(at_step(self.H, step), at_step(self.R, step), now)

    @property
    def varies(self) -> bool:
        """Whether H, R or the detection depends on the step."""
        return varies(self.H) or varies(self.R) or (self.detection is not None and self.detection.ndim > 0)


@dataclass(frozen=True, eq=False)
class Filter:
    """An agent's own filter, of a state x_i of its own or of a part of the state, x = M x_i + s.

    Parameters
    ----------
    F, Q : (d_i, d_i) or (steps, d_i, d_i) transition and process noise.
    P0 : (d_i, d_i) covariance of the first estimate.
    M, s : (d, d_i) and (d, 1), how the filter's output is shaped into the state.
    """

    F: np.ndarray
    Q: np.ndarray
    P0: np.ndarray
    M: np.ndarray
    s: np.ndarray

    @property
    def dimension(self) -> int:
        """Number d_i of state components."""
        return self.F.shape[-1]


@dataclass(frozen=True, eq=False)
class NoiseCorrelation:
    """How the agents' measurement noises hang together.

    Parameters
    ----------
    correlation : (n, n) correlation of the agents' noises, component by component in units of their own deviations.
    disturbance : (Σp, Σp) bound on the covariance of an uncertain disturbance, or None.
    """

    correlation: np.ndarray
    disturbance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """How the state moves, and what its components are called.

    Parameters
    ----------
    F : (d, d) or (steps, d, d) state transition.
    Q : (d, d) or (steps, d, d) process noise as it enters the state, G Q Gᵀ.
    Bu : (d, 1) or (steps, d, 1) known input B u.
    states, units : d names and d units; a unit may be empty.
    """

    F: np.ndarray
    Q: np.ndarray
    Bu: np.ndarray
    states: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def dimension(self) -> int:
        """Number d of state components."""
        return self.F.shape[-1]

    @property
    def varies(self) -> bool:
        """Whether any matrix depends on the step."""
        return any(map(varies, (self.F, self.Q, self.Bu)))
