"""The world behind the agents' filters: what each filter is told, and how all the noises truly hang together.

Agent i estimates x_i of dimension d_i.  Stacked over the agents, with one matrix for all of them,

    x(k) = diag(F_i) x(k−1) + v(k)      cov v = Q      start: cov = P0
    z_i(k) = H_i x_i(k) + w_i(k) + δ_i(k)               cov w = [c_ij L_i L_jᵀ],  R_i = L_i L_iᵀ      cov δ ≤ Δ

Agents that track one common state have Q = 1⊗Q (every block is the same noise); agents with states of their own a
block diagonal one; parallel filters whatever is common to them.  c is 1 on the diagonal.

Errors of linear estimates are carried along as noise footprints, the coefficients of independent unit noises, as
`stochfuse.estimators.world` does it: a factor of each joint covariance, one agent's rows at a time.  The true
disturbance is taken to be as large as its bound, white and independent of w.

What a scenario's sources are worth: information for the claimed covariance, noise footprints for the actual error.

The error of every linear estimate obeys the estimate's own equations in a world whose state is zero,

    start        e = Σ L_0 ε            P(k0) = L_0 L_0ᵀ       (and the known initial error b)
    prediction   e⁻ = F e − L_Q ε       Q = L_Q L_Qᵀ           (the same ε for all agents)
    measurement  z = C ε                R = C Cᵀ

with independent ε of unit variance.  So the noise footprint, the coefficients of every ε in the error, is carried along
by the recursion that carries state estimates, with one column for each ε and a last one for b:

    actual covariance = X Xᵀ over the columns X of the noises       bias = the last column

Departure from the source: footprints are kept whitened (in units of each noise's own deviation), which makes the sum
over sources a product of matrices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import Sources
from stochfuse.kalman.kernel import Estimate, Information, at_step, factor, to_information
from stochfuse.kalman.metrics import Moments
from stochfuse.scenario.model import Filter, once
from stochfuse.scenario.system import Noises, System


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


class Riding(Protocol):
    """What rides along with covariances, in the place of a state estimate: noise footprints, or what was measured.

    All are columns (d, columns), or stacks of them, one for each estimate that is worked on.
    """

    def start(self, rows: slice) -> np.ndarray:
        """First estimates, some rows of the stacked state."""
        ...

    def process(self, step: int, rows: slice) -> np.ndarray:
        """What a prediction adds."""
        ...

    def sensor(self, step: int, agent: int, H: np.ndarray) -> np.ndarray:
        """What an agent's sensor sees of its state, where the model says H."""
        ...

    def measured(self, step: int, agent: int) -> np.ndarray:
        """What an agent measures."""
        ...

    def related(self, step: int, pair: tuple[int, int]) -> np.ndarray:
        """What one agent measures of another."""
        ...

    def shift(self, agent: int) -> np.ndarray:
        """S of a filter whose output M x + s is the state."""
        ...


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

    def sensor(self, step: int, agent: int, H: np.ndarray) -> np.ndarray:
        """What the model says."""
        return H

    def shift(self, agent: int) -> np.ndarray:
        """No error comes of it."""
        return np.zeros((1, 1))

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


def sources_of(system: System, records: np.ndarray | None = None, *, by_agent: bool = False) -> Sources:
    """Return what start and measurements of every source are worth.

    Parameters
    ----------
    records : measurements (steps, agents, p); with them every agent is a source of its own.  Of an agent that measures
        less than others what is left over does not matter.
    by_agent : whether that is so anyway; else every kind of sensor is one.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    start = _start(system, None if records is None else system.x0)
    sensors = system.sensors
    if by_agent or records is not None:
        sensors = [system.sensors[kind] for kind in system.sensor_of]
    columns = None
    if records is not None:
        widths = [sensor.H.shape[-2] for sensor in sensors]
        columns = [[z[:p, None] for z, p in zip(step, widths, strict=True)] for step in records]
    return Sources(system.model, sensors, [start] * len(sensors), columns)


def error_sources(system: System, noises: Noises | None = None) -> Sources:
    """Return the same for every agent, with noise footprints in the place of data; see `moments`.

    Parameters
    ----------
    noises : of a batch, P0 among them, in the place of the system's.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    unit, told = (system, system) if noises is None else (_unit(system, noises), system.with_noises(noises))
    LQ, LR, LP = _roots(noises)
    world = world_of(unit)
    footprints, steps, everyone = Footprints(world), range(2, world.steps + 1), range(world.agents)
    starts = [_start(told, _in_units(LP, footprints.start(rows))) for rows in world.states]
    # all agents see one process noise, so that the first agent's rows are everyone's
    moved = [_in_units(LQ, footprints.process(step, world.states[0])) for step in steps]
    inputs = np.stack(np.broadcast_arrays(np.zeros((system.model.dimension, footprints.columns)), *moved))
    nothing = [np.zeros((H.shape[-2], footprints.columns)) for H in world.H]
    measured = ([_in_units(LR, footprints.measured(step, agent)) for agent in everyone] for step in steps)
    sensors = [told.sensors[kind] for kind in told.sensor_of]
    return Sources(replace(told.model, Bu=inputs), sensors, starts, [nothing, *measured])


def _unit(system: System, noises: Noises) -> System:
    """Return the system with unit noises in the place of the items'."""
    units = (None if M is None else np.eye(M.shape[-1]) for M in noises)
    return system.with_noises(Noises(*units))


def _roots(noises: Noises | None) -> tuple[np.ndarray | None, ...]:
    """Square roots of the noises of a batch, None where there are none."""
    Q, R, P0 = noises or Noises()
    # correlations of measurement noises are those of this very root's units, see `World.joint_noise`
    root = None if R is None else np.linalg.cholesky(R)
    return None if Q is None else factor(Q), root, None if P0 is None else factor(P0)


def _in_units(root: np.ndarray | None, footprint: np.ndarray) -> np.ndarray:
    """Footprint of unit noises in units of a batch's: (..., rows, columns), the last of them the known error."""
    if root is None:
        return footprint
    noises = root @ footprint[:, :-1]
    return np.concatenate([noises, np.broadcast_to(footprint[:, -1:], (*noises.shape[:-1], 1))], axis=-1)


def world_of(system: System) -> World:
    """Return what the agents' filters are told, and how all noises truly hang together."""
    n, steps, model = system.agents, system.steps, system.model
    sensors = [system.sensors[kind] for kind in system.sensor_of]
    filters = system.filters or (_filter(system),) * n
    together = np.ones((n, n)) if not system.own and not system.filters else np.eye(n)
    shared = np.ones((n, n)) if system.shared else np.eye(n)
    if system.filters:
        Q, P0 = _stacked([f.Q for f in filters], steps), _stacked([f.P0 for f in filters], steps)
    else:
        Q, P0 = np.kron(together, once(model.Q)), np.kron(shared, system.P0)
    b = system.error
    return World(
        steps=steps,
        F=tuple(f.F for f in filters),
        H=tuple(once(s.H) for s in sensors),
        R=tuple(once(s.R) for s in sensors),
        Q=Q if system.process is None else system.process,
        P0=P0,
        correlation=None if system.noise is None else system.noise.correlation,
        disturbance=None if system.noise is None else system.noise.disturbance,
        error=None if b is None else np.concatenate([np.linalg.pinv(f.M) @ b for f in filters]),
        own=system.own,
        relations=system.relations,
        M=tuple(f.M for f in filters) if system.filters and not system.own else None,
    )


def _filter(system: System) -> Filter:
    d = system.model.dimension
    return Filter(once(system.model.F), once(system.model.Q), system.P0, np.eye(d), np.zeros((d, 1)))


def _stacked(blocks: Sequence[np.ndarray], steps: int) -> np.ndarray:
    """Block diagonal matrix, per step where one of the blocks is."""
    times = (steps,) if any(block.ndim > 2 for block in blocks) else ()
    ends = np.cumsum([(0, 0), *(block.shape[-2:] for block in blocks)], axis=0)
    out = np.zeros((*times, *ends[-1]))
    for block, (row, column), (end, last) in zip(blocks, ends, ends[1:], strict=False):
        out[..., row:end, column:last] = block[:steps] if block.ndim > 2 else block
    return out


def moments(estimate: Estimate | Moments) -> Moments:
    """Moments of the error from an estimate whose state is a noise footprint, x of shape (..., d, columns)."""
    if isinstance(estimate, Moments):
        return estimate
    return Moments.of_footprint(estimate.P, estimate.x)


def claimed_only(estimate: Estimate | Moments) -> Moments:
    """Moments of an estimate whose error is not asked for."""
    return Moments(estimate.P)


def _start(system: System, x: np.ndarray | None) -> Information:
    try:
        start = to_information(Estimate(x, system.P0))
    except np.linalg.LinAlgError:
        start = None
    if start is None or not np.isfinite(start.Y).all():
        raise UsageError("initial.P: expected an invertible covariance for the Local Fusion Graph, got a singular one")
    return start
