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

from dataclasses import replace

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.information import Sources
from stochfuse.kalman import Estimate, Information, factor, to_information
from stochfuse.model import at_step
from stochfuse.quantities import Moments
from stochfuse.scenario import Scenario


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


def error_sources(scenario: Scenario) -> Sources:
    """Return the same for every agent, with noise footprints in the place of data; see `moments`.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    n, d, steps = scenario.network.agents, scenario.model.dimension, scenario.network.steps
    sensors = [scenario.sensors[kind] for kind in scenario.sensor_of]
    shared = scenario.correlation == "shared"
    widths = [[d] * (1 if shared else n)]
    widths += [[d, *(at_step(sensor.R, step).shape[-1] for sensor in sensors)] for step in range(2, steps + 1)]
    first = np.cumsum([0, *(width for step in widths for width in step)])
    columns = int(first[-1]) + 1

    def placed(block: np.ndarray, number: int) -> np.ndarray:
        out = np.zeros((len(block), columns))
        out[:, first[number] : first[number] + block.shape[1]] = block
        return out

    L0 = factor(scenario.P0)
    starts = []
    for agent in range(n):
        x = placed(L0, 0 if shared else agent)
        x[:, -1:] = 0.0 if scenario.error is None else scenario.error
        starts.append(_start(scenario, x))
    inputs = np.zeros((steps, d, columns))
    records = [[np.zeros((at_step(s.R, 1).shape[-1], columns)) for s in sensors]]
    number = len(widths[0])
    for step in range(2, steps + 1):
        inputs[step - 1] = placed(-factor(at_step(scenario.model.Q, step)), number)
        noises = [np.linalg.cholesky(at_step(sensor.R, step)) for sensor in sensors]
        records.append([placed(C, number + 1 + i) for i, C in enumerate(noises)])
        number += 1 + n
    return Sources(replace(scenario.model, Bu=inputs), sensors, starts, records)


def moments(estimate: Estimate) -> Moments:
    """Moments of the error from an estimate whose state is a noise footprint, x of shape (..., d, columns)."""
    noises, bias = estimate.x[..., :-1], estimate.x[..., -1:]
    return Moments.of(estimate.P, noises @ np.swapaxes(noises, -1, -2), bias)


def claimed_only(estimate: Estimate) -> Moments:
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
