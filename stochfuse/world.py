"""The world behind the agents' filters: what each filter is told, and how all the noises truly hang together.

Agent i estimates x_i of dimension d_i.  Stacked over the agents, with one matrix for all of them,

    x(k) = diag(F_i) x(k−1) + v(k)      cov v = Q      start: cov = P0
    z_i(k) = H_i x_i(k) + w_i(k) + δ_i(k)               cov w = [c_ij L_i L_jᵀ],  R_i = L_i L_iᵀ      cov δ ≤ Δ

Agents that track one common state have Q = 1⊗Q (every block is the same noise); agents with states of their own a
block diagonal one; parallel filters whatever is common to them.  c is 1 on the diagonal.

Errors of linear estimates are carried along as noise footprints, the coefficients of independent unit noises, as
`stochfuse.sources` does it: a factor of each joint covariance, one agent's rows at a time.  The true disturbance is
taken to be as large as its bound, white and independent of w.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from stochfuse.kalman import factor
from stochfuse.model import at_step


@dataclass(frozen=True, eq=False)
class World:
    """What is told and what is true.

    Parameters
    ----------
    steps : number of steps.
    F, H, R : per agent, (d, d), (p, d) and (p, p), each constant or with a leading step axis; p may be 0.
    Q, P0 : joint process noise (D, D), constant or per step, and joint covariance of the first estimates (D, D).
    correlation : (n, n) correlation c of the agents' measurement noises, or None if independent.
    disturbance : (Σp, Σp) bound Δ of the uncertain disturbance, or None.
    error : (D, 1) known error of the first estimates, or None.
    own : whether every agent has a state of its own.
    relations : what agent i measures of agent j, (i, j) → anything with H_i, H_j, R, constant or per step; empty where
        all track one state.
    M : shaping x = M_i x_i + s_i of each agent's state into the full one; None where it is the identity.
    """

    steps: int
    F: tuple[np.ndarray, ...]
    H: tuple[np.ndarray, ...]
    R: tuple[np.ndarray, ...]
    Q: np.ndarray
    P0: np.ndarray
    correlation: np.ndarray | None = None
    disturbance: np.ndarray | None = None
    error: np.ndarray | None = None
    own: bool = False
    relations: Mapping[tuple[int, int], Any] = field(default_factory=dict)
    M: tuple[np.ndarray, ...] | None = None

    @property
    def agents(self) -> int:
        """Number of agents."""
        return len(self.F)

    @cached_property
    def states(self) -> list[slice]:
        """Where each agent's state is in the stacked one."""
        return _slices([F.shape[-1] for F in self.F])

    @cached_property
    def measurements(self) -> list[slice]:
        """Where each agent's measurement is in the stacked one."""
        return _slices([H.shape[-2] for H in self.H])

    def joint_noise(self, step: int) -> np.ndarray:
        """Covariance (Σp, Σp) of all measurement noises w together."""
        roots = [np.linalg.cholesky(at_step(R, step)) for R in self.R]
        p = self.measurements[-1].stop
        out = np.zeros((p, p))
        for i, (rows, Li) in enumerate(zip(self.measurements, roots, strict=True)):
            for j, (columns, Lj) in enumerate(zip(self.measurements, roots, strict=True)):
                c = float(i == j) if self.correlation is None else self.correlation[i, j]
                if c and Li.size and Lj.size:
                    out[rows, columns] = c * Li @ Lj.T
        return out

    def true_noise(self, step: int) -> np.ndarray:
        """The same with the disturbance."""
        noise = self.joint_noise(step)
        return noise if self.disturbance is None else noise + self.disturbance

    def joint_transition(self, step: int) -> np.ndarray:
        """Transition (D, D) of the stacked state."""
        out = np.zeros_like(self.P0)
        for rows, F in zip(self.states, self.F, strict=True):
            out[rows, rows] = at_step(F, step)
        return out

    def joint_sensor(self, agent: int, step: int) -> np.ndarray:
        """What an agent's sensor sees of the stacked state, (p, D)."""
        H = at_step(self.H[agent], step)
        out = np.zeros((len(H), len(self.P0)))
        out[:, self.states[agent]] = H
        return out

    def between(self, step: int, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What an agent measures of another, H_i, H_j and R; where all track one state agreement, x_i − x_j = 0."""
        if self.own:
            H_i, H_j, R = (at_step(M, step) for M in self.relations[pair])
            return H_i, H_j, R
        same = np.eye(self.states[0].stop)
        return same, -same, 0.0 * same


class Footprints:
    """Noise footprints of a world: columns of unit noises, and a last one for the known initial error."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._start = _root(world.P0)
        self._process: dict[int, np.ndarray] = {}
        self._noise: dict[int, np.ndarray] = {}
        self._relation: dict[tuple[int, int, int], np.ndarray] = {}
        self._first: dict[Any, int] = {}
        width = self._start.shape[1]
        for step in range(2, world.steps + 1):
            self._process[step], self._noise[step] = _root(at_step(world.Q, step)), _root(world.true_noise(step))
            self._first["process", step] = width
            self._first["noise", step] = width = width + self._process[step].shape[1]
            width += self._noise[step].shape[1]
        for step in range(1, world.steps + 1):
            for pair, relation in world.relations.items():
                self._relation[(step, *pair)] = root = _root(at_step(relation.R, step))
                self._first["relation", (step, *pair)] = width
                width += root.shape[1]
        self.columns = width + 1

    def start(self, rows: slice) -> np.ndarray:
        """Errors of the first estimates, for some rows of the stacked state."""
        x = self._placed(self._start[rows], 0)
        if self._world.error is not None:
            x[:, -1:] = self._world.error[rows]
        return x

    def process(self, step: int, rows: slice) -> np.ndarray:
        """What prediction leaves out, for some rows of the stacked state."""
        return self._placed(-self._process[step][rows], self._first["process", step])

    def measured(self, step: int, agent: int) -> np.ndarray:
        """Noise of an agent's measurement."""
        return self._placed(self._noise[step][self._world.measurements[agent]], self._first["noise", step])

    def related(self, step: int, pair: tuple[int, int]) -> np.ndarray:
        """Noise of what one agent measures of another; agreement has none."""
        if not self._world.own:
            return np.zeros((self._world.states[0].stop, self.columns))
        return self._placed(self._relation[(step, *pair)], self._first["relation", (step, *pair)])

    def _placed(self, block: np.ndarray, first: int) -> np.ndarray:
        out = np.zeros((len(block), self.columns))
        out[:, first : first + block.shape[1]] = block
        return out


def _root(P: np.ndarray) -> np.ndarray:
    """Factor with as many columns as P has rank."""
    L = factor(P)
    return L[:, L.any(axis=0)]


def _slices(sizes: list[int]) -> list[slice]:
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]
