"""Expected state estimates given what was measured, over what arrives, and how far they lie apart: thesis (48), (53).

    E[x̂(k)] = Σ_S µ_S µ_¬S x̂_S(k)        spread = Σ_S µ_S µ_¬S (x̂_S − E[x̂])(x̂_S − E[x̂])ᵀ

By the general formulation over every outcome S, exactly, or over drawn ones; of every estimator.  The simplified
formulation averages after every step, so that of outcomes no spread is left; its (53) is in
`stochfuse.prediction.states`.

Sensors by name are linearised about the nominal path x*, as for every prediction: what counts as measured is
z − h(x*) + H x*, angles wrapped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from stochfuse.errors import UsageError, nearest
from stochfuse.prediction.general import outcomes
from stochfuse.prediction.method import Settings, group_of
from stochfuse.prediction.sampled import states
from stochfuse.prediction.states import predict_states
from stochfuse.scenario import registry
from stochfuse.scenario.own_rules import estimator_named
from stochfuse.scenario.registry import GENERAL, LFG, MONTE_CARLO, SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario

TAKEN = (SIMPLIFIED, GENERAL, MONTE_CARLO)
"""Methods that average states."""


@dataclass(frozen=True, eq=False, repr=False)
class ExpectedStates(Result):
    """Expected posterior state estimates for a record of measurements.

    Parameters
    ----------
    scenario : what was given.
    method, estimator : how it was averaged, and what.
    nature : "exact", "approximate" or "sampled".
    link : (links,) link probability of each row, averaged over the links if they differ.
    cases : a name per row where the rows are cases, else None.
    steps : (steps,) step numbers, from 1.
    x : (links, steps, agents, d) expected estimates, in the units of the states.
    deviation : (links, steps, agents, d) standard deviations over what arrives; None of the simplified formulation.
    standard_error : of x where it was sampled, else None.
    """

    scenario: Scenario
    method: str
    estimator: str
    nature: str
    link: np.ndarray
    cases: tuple[str, ...] | None
    steps: np.ndarray
    x: np.ndarray
    deviation: np.ndarray | None
    standard_error: np.ndarray | None = None


@of_scenario
def expected_states(
    scenario: Scenario,
    measurements: Any,
    link: Any = None,
    method: str = SIMPLIFIED,
    **settings: Any,
) -> ExpectedStates:
    """Expected state estimates over what arrives, given what every agent measured, thesis (48) or (53).

    Parameters
    ----------
    scenario : its initial.x is the estimate at step 1.
    measurements : (steps, agents, p) each agent's own; the entry of step 1 is not used, nor what an agent without a
        sensor is said to measure.
    link : link probabilities, one row each; default: those of the scenario.
    method : "simplified" (53), "general" (48) or "monte-carlo".
    **settings : estimator (of general and monte-carlo: what the agents do with what arrives), max_graphs, prune, runs,
        seed, control and criterion, as for `predict`.

    Returns
    -------
    ExpectedStates

    Raises
    ------
    UsageError
        If the measurements do not fit the scenario, or the estimator or method does not take it.

    Examples
    --------
    >>> import stochfuse as sf
    >>> z = [[[0.0]] * 3, [[5.0], [4.0], [6.0]]]
    >>> found = sf.expected_states("thesis-transient", z, [0.5], "general")
    Traceback (most recent call last):
    ...
    stochfuse.errors.UsageError: measurements: expected shape (steps, agents, p) = (5, 3, 1), got (2, 3, 1)
    >>> found = sf.expected_states(sf.load_scenario("thesis-transient", steps=2), z, [0.5], "general")
    >>> found.x.shape, found.deviation.shape
    ((1, 2, 3, 1), (1, 2, 3, 1))
    """
    if method not in TAKEN:
        raise UsageError(f"states: expected method {', '.join(TAKEN)}, got {method}")
    rows, z = link_rows(scenario, link), _checked(scenario, measurements)
    more: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
    estimator = estimator_named(settings.get("estimator", LFG))
    how = _settings(method, {**settings, "estimator": estimator} if "estimator" in settings else settings)
    if method == SIMPLIFIED:
        x, estimator = predict_states(scenario, z, rows).x, registry.BROADCAST_PRIOR  # type: ignore[arg-type]
    elif method == GENERAL:
        found = outcomes(scenario.system, rows, how, records=z)
        group = group_of(found.groups)
        x = found.states()[..., 0][:, :, group]
        variance = np.diagonal(found.state_spread(), axis1=-2, axis2=-1)[:, :, group]
        # what is left of equal numbers is rounding
        negligible = 1e-12 * (x**2).max(axis=(0, 1, 2))
        more = (np.sqrt(np.where(variance > negligible, variance, 0.0)), None)
    else:
        sample, terms = states(scenario.system, rows, how, z)
        x, error = terms.mean(axis=1), terms.std(axis=1, ddof=1) / np.sqrt(how.runs)
        more = (sample.std(axis=1, ddof=1), error)
    return ExpectedStates(
        scenario,
        method,
        estimator,
        registry.engine_of(method).nature.partition(" ")[0],
        rows.means(scenario.network),
        rows.names,
        np.arange(1, scenario.network.steps + 1),
        x,
        *more,
    )


def _settings(method: str, given: Mapping[str, Any]) -> Settings:
    known = [field.name for field in fields(Settings)]
    for name in given:
        if name not in known:
            raise UsageError(f"{name}: no such setting{nearest(name, known)}; expected {', '.join(known)}")
    if method == SIMPLIFIED and given:
        raise UsageError(f"{next(iter(given))}: expected method {GENERAL} or {MONTE_CARLO}, got {method}")
    found = Settings(**given)
    if found.precision is not None:
        raise UsageError("precision: expected a quantity of the error, got states: use runs")
    return found


def _checked(scenario: Scenario, measurements: Any) -> np.ndarray:
    """Measurements of every agent's sensor as linearised, (steps, agents, p)."""
    network = scenario.network
    z = np.asarray(measurements, dtype=float)
    sees = [scenario.sensors[kind].H.shape[-2] for kind in scenario.sensor_of]
    p = max([*sees, 1])
    if z.shape != (network.steps, network.agents, p):
        expected = f"(steps, agents, p) = ({network.steps}, {network.agents}, {p})"
        raise UsageError(f"measurements: expected shape {expected}, got {z.shape}")
    if scenario.own:
        raise UsageError("states: expected agents that track one state, got states of their own (model.own)")
    if scenario.system.detects is not None:
        raise UsageError("states: expected sensors that never miss, since what was measured is given; got a detection")
    z = np.array(z)
    for agent, width in enumerate(sees):
        looks = scenario.sensors[scenario.sensor_of[agent]].H.any(axis=(-2, -1)) & (np.arange(network.steps) > 0)
        z[~np.broadcast_to(looks, network.steps), agent] = 0.0
        z[:, agent, width:] = 0.0
        lost = ~np.isfinite(z[:, agent]).all(axis=1)
        if lost.any():
            where = f"agent {agent + 1} at step {int(lost.argmax()) + 1}"
            raise UsageError(
                f"measurements: expected a measurement of {where}, got none; stochfuse run takes records with gaps"
            )
        z[:, agent, :width] = _linear(scenario, agent, z[:, agent, :width])
    return z


def _linear(scenario: Scenario, agent: int, z: np.ndarray) -> np.ndarray:
    """What a sensor by name would have measured linearly, about the nominal path."""
    instrument = scenario.instruments[agent] if scenario.instruments else None
    if instrument is None or scenario.nominal is None:
        return z
    out = z.copy()
    for step in range(2, len(z) + 1):
        at, H = scenario.nominal[step - 1][:, None], scenario.system.sensors[scenario.sensor_of[agent]].H[step - 1]
        if H.any():
            out[step - 1] = (instrument.residual(z[step - 1][:, None], instrument.h(at, step)) + H @ at)[:, 0]
    return out
