"""What a scenario's sources are worth: information for the claimed covariance, noise footprints for the actual error.

The error of every linear estimate obeys the estimate's own equations in a world whose state is zero,

    start        e = Σ L_0 ε            P(k0) = L_0 L_0ᵀ       (and the known initial error b)
    prediction   e⁻ = F e − L_Q ε       Q = L_Q L_Qᵀ           (the same ε for all agents)
    measurement  z = C ε                R = C Cᵀ

with independent ε of unit variance.  So the noise footprint of theory section 7, the coefficients of every ε in the
error, is carried along by the recursion that carries state estimates, with one column for each ε and a last one for b:

    actual covariance = X Xᵀ over the columns X of the noises       bias = the last column

Departure from the source: footprints are kept whitened (in units of each noise's own deviation), which makes the sum
over sources a product of matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.information import Sources
from stochfuse.kalman import Estimate, Information, factor, to_information
from stochfuse.model import Filter, Noises, at_step
from stochfuse.quantities import Moments
from stochfuse.scenario import Scenario
from stochfuse.world import Footprints, World


def sources_of(scenario: Scenario, records: np.ndarray | None = None, *, by_agent: bool = False) -> Sources:
    """Return what start and measurements of every source are worth.

    Parameters
    ----------
    records : measurements (steps, agents, p); with them every agent is a source of its own.
    by_agent : whether that is so anyway; else every kind of sensor is one.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    start = _start(scenario, None if records is None else scenario.x0)
    sensors = scenario.sensors
    if by_agent or records is not None:
        sensors = [scenario.sensors[kind] for kind in scenario.sensor_of]
    columns = None if records is None else [[z[..., None] for z in step] for step in records]
    return Sources(scenario.model, sensors, [start] * len(sensors), columns)


def error_sources(scenario: Scenario, noises: Noises | None = None) -> Sources:
    """Return the same for every agent, with noise footprints in the place of data; see `moments`.

    Parameters
    ----------
    noises : of a batch, P0 among them, in the place of the scenario's.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    unit, told = (scenario, scenario) if noises is None else (_unit(scenario, noises), batched(scenario, noises))
    LQ, LR, LP = _roots(noises)
    world = world_of(unit)
    footprints, steps, everyone = Footprints(world), range(2, world.steps + 1), range(world.agents)
    starts = [_start(told, _in_units(LP, footprints.start(rows))) for rows in world.states]
    # all agents see one process noise, so that the first agent's rows are everyone's
    moved = [_in_units(LQ, footprints.process(step, world.states[0])) for step in steps]
    inputs = np.stack(np.broadcast_arrays(np.zeros((scenario.model.dimension, footprints.columns)), *moved))
    nothing = [np.zeros((H.shape[-2], footprints.columns)) for H in world.H]
    measured = ([_in_units(LR, footprints.measured(step, agent)) for agent in everyone] for step in steps)
    sensors = [told.sensors[kind] for kind in told.sensor_of]
    return Sources(replace(told.model, Bu=inputs), sensors, starts, [nothing, *measured])


def batched(scenario: Scenario, noises: Noises) -> Scenario:
    """Return the scenario with the noises of a batch in the place of its own: for the numbers only.

    P0 is then of shape (items, d, d) and, where the noises have them, Q of (steps, items, d, d) and R of
    (steps, items, p, p).
    """
    steps, (Q, R, P0) = scenario.network.steps, noises
    model, sensors = scenario.model, scenario.sensors
    return replace(
        scenario,
        model=model if Q is None else replace(model, Q=np.broadcast_to(Q, (steps, *Q.shape))),
        sensors=sensors if R is None else tuple(replace(s, R=np.broadcast_to(R, (steps, *R.shape))) for s in sensors),
        P0=scenario.P0 if P0 is None else P0,
    )


def _unit(scenario: Scenario, noises: Noises) -> Scenario:
    """Return the scenario with unit noises in the place of a batch's."""
    units = (None if M is None else np.eye(M.shape[-1]) for M in noises)
    return batched(scenario, Noises(*units))


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


def world_of(scenario: Scenario) -> World:
    """Return what the agents' filters are told, and how all noises truly hang together."""
    n, steps, model = scenario.network.agents, scenario.network.steps, scenario.model
    sensors = [scenario.sensors[kind] for kind in scenario.sensor_of]
    filters = scenario.filters or (_filter(scenario),) * n
    together = np.ones((n, n)) if not scenario.own and not scenario.filters else np.eye(n)
    shared = np.ones((n, n)) if scenario.correlation == "shared" else np.eye(n)
    if scenario.filters:
        Q, P0 = _stacked([f.Q for f in filters], steps), _stacked([f.P0 for f in filters], steps)
    else:
        Q, P0 = np.kron(together, model.Q), np.kron(shared, scenario.P0)
    b = scenario.error
    return World(
        steps=steps,
        F=tuple(f.F for f in filters),
        H=tuple(s.H for s in sensors),
        R=tuple(s.R for s in sensors),
        Q=Q if scenario.process is None else scenario.process,
        P0=P0,
        correlation=None if scenario.noise is None else scenario.noise.correlation,
        disturbance=None if scenario.noise is None else scenario.noise.disturbance,
        error=None if b is None else np.concatenate([np.linalg.pinv(f.M) @ b for f in filters]),
        own=scenario.own,
        relations=scenario.relations,
        M=tuple(f.M for f in filters) if scenario.filters and not scenario.own else None,
    )


def _filter(scenario: Scenario) -> Filter:
    d = scenario.model.dimension
    return Filter(scenario.model.F, scenario.model.Q, scenario.P0, np.eye(d), np.zeros((d, 1)))


def _stacked(blocks: Sequence[np.ndarray], steps: int) -> np.ndarray:
    """Block diagonal matrix, per step where one of the blocks is."""
    from scipy.linalg import block_diag

    if any(block.ndim > 2 for block in blocks):
        return np.array([block_diag(*(at_step(block, step) for block in blocks)) for step in range(1, steps + 1)])
    return np.asarray(block_diag(*blocks))


def moments(estimate: Estimate | Moments) -> Moments:
    """Moments of the error from an estimate whose state is a noise footprint, x of shape (..., d, columns)."""
    if isinstance(estimate, Moments):
        return estimate
    return Moments.of_footprint(estimate.P, estimate.x)


def claimed_only(estimate: Estimate | Moments) -> Moments:
    """Moments of an estimate whose error is not asked for."""
    return Moments(estimate.P)


def _start(scenario: Scenario, x: np.ndarray | None) -> Information:
    try:
        start = to_information(Estimate(x, scenario.P0))
    except np.linalg.LinAlgError:
        start = None
    if start is None or not np.isfinite(start.Y).all():
        raise UsageError("initial.P: expected an invertible covariance for the Local Fusion Graph, got a singular one")
    return start
