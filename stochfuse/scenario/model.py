"""The linear-Gaussian model and its sensors, thesis (21)/(22).

    x(k) = F x(k−1) + B u + G v      v ~ N(0, Q)
    z(k) = H x(k) + w                w ~ N(0, R)

Every matrix is either constant or given per step, with the step on the first axis.  The entry of step 1 of
F, Q, G, B, u, H and R is never used: at step 1 the agents exchange their initial estimates, before any
prediction or measurement (see `stochfuse.scenario.scenario`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True, eq=False)
class Sensor:
    """What an agent measures: H (p, d) and R (p, p), each constant or with a leading step axis."""

    H: np.ndarray
    R: np.ndarray

    @property
    def varies(self) -> bool:
        """Whether H or R depends on the step."""
        return max(self.H.ndim, self.R.ndim) > 2


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
class Noise:
    """How the agents' measurement noises hang together.

    Parameters
    ----------
    correlation : (n, n) correlation of the agents' noises, component by component in units of their own deviations.
    disturbance : (Σp, Σp) bound on the covariance of an uncertain disturbance, or None.
    """

    correlation: np.ndarray
    disturbance: np.ndarray | None = None


class Noises(NamedTuple):
    """Noises of a batch of scenarios that have everything else in common; None where the scenario's own are meant.

    Parameters
    ----------
    Q : (items, d, d) process noise as it enters the state.
    R : (items, p, p) measurement noise of every agent's sensor, positive definite.
    P0 : (items, d, d) covariance of the first estimates.
    """

    Q: np.ndarray | None = None
    R: np.ndarray | None = None
    P0: np.ndarray | None = None

    def take(self, items: np.ndarray | slice) -> Noises:
        """Return the noises of some of the items."""
        return Noises(*(None if M is None else M[items] for M in self))


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
        return max(self.F.ndim, self.Q.ndim, self.Bu.ndim) > 2
