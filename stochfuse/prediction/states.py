"""Expected state estimates for a given measurement record, thesis (53).

With P_m one update with m + 1 measurements, the consistent (53) is

    x̂(k) = x̂⁻ + K̄ (z − H x̂⁻),    K̄ = Σ β(m) K_m,   K_m = P⁻Hᵀ(H P⁻Hᵀ + R/(m+1))⁻¹

for one record z(k) that stands for what every agent measured, as (53) has it.  Agents with records of their own average
over the sets S of senders, x̂_i(k) = Σ_S µ_S µ_¬S update(prior_i; z_i and z_j, j ∈ S), with agent i's prior in the place
of the common one.  The printed (53) puts the averaged P(k) in front of the sum; its bias is erratum 1 (see
`stochfuse.prediction.simplified`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, combinations
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.mean_field import Case
from stochfuse.errors import StochfuseError, UsageError
from stochfuse.kalman.arrivals import Arrivals
from stochfuse.kalman.kernel import (
    Estimate,
    at_step,
    factor,
    posterior_gain,
    predict,
    to_information,
    update,
    update_factor,
)
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction import simplified
from stochfuse.prediction.method import Averaged
from stochfuse.scenario.model import Sensor
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.result import brief
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario
from stochfuse.scenario.system import Items, System

SELF_CONSISTENT = (
    "the simplified formulation takes for granted that agents share the broadcast prior and nothing else: by its own "
    "assumptions the actual covariance is the claimed one; for what is true see method general"
)
MOST_AGENTS = 12
"""Agents up to which records of their own are averaged over all sets of senders."""


class States(NamedTuple):
    """Expected posterior state estimates.

    Parameters
    ----------
    link : (links,) mean link probability of each row.
    steps : (steps,) step numbers.
    x : (links, steps, agents, d) expected estimate of every agent, in the units of the model.
    names : names of the d states.
    """

    link: np.ndarray
    steps: np.ndarray
    x: np.ndarray
    names: tuple[str, ...]

    def __repr__(self) -> str:
        """One line."""
        return brief(self, self._fields)


@of_scenario
def predict_states(
    scenario: Scenario, measurements: Any, link: Sequence[float] | None = None, *, printed: bool = False
) -> States:
    """Expected state estimates of the simplified formulation for a record of measurements, thesis (53).

    Parameters
    ----------
    scenario : the scenario; its initial.x is the estimate at step 1.
    measurements : (steps, p): one record that stands for every agent's; or (steps, agents, p): each agent's own, for at
        most 12 agents.  The entry of step 1 is not used: nothing is measured before the first exchange.
    link : link probabilities, one row each; default: those of the scenario.
    printed : evaluate (53) as the thesis prints it, with P(k) in front of the sum (one record only).

    Returns
    -------
    States

    Raises
    ------
    UsageError
        If the record does not fit the scenario.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.predict_states(sf.load_scenario("thesis-transient", steps=2), [[0.0], [10.0]], [0.5])
    >>> found.x.shape[:2]
    (1, 2)
    """
    rows = link_rows(scenario, link)
    z = np.asarray(measurements, dtype=float)
    system = scenario.system
    steps, n = system.steps, system.agents
    sees = np.array([scenario.sensors[kind].H.shape[-2] for kind in scenario.sensor_of])
    # what agents without a sensor are said to measure does not matter
    widths = set(sees[sees > 0].tolist()) or {z.shape[-1] if z.ndim else 0}
    expected = (
        f"(steps, p) or (steps, agents, p) with {steps} steps, {n} agents and p = {', '.join(map(str, sorted(widths)))}"
    )
    if len(widths) > 1 or z.ndim not in (2, 3) or len(z) < steps or z.shape[-1] not in widths:
        raise UsageError(f"measurements: expected shape {expected}, got {z.shape}")
    if z.ndim == 3 and z.shape[1] != n:
        raise UsageError(f"measurements: expected shape {expected}, got {z.shape}")
    if not np.isfinite(z[1:steps] if z.ndim == 2 else z[1:steps, sees > 0]).all():
        raise UsageError("measurements: expected finite numbers, got NaN or infinity")
    if z.ndim == 2 and len(scenario.sensors) == 1 and sees.all():
        x = _one_record(system, rows, z, printed)
    elif printed:
        raise UsageError("(53) as printed takes one record for all agents, of shape (steps, p)")
    else:
        own = np.broadcast_to(z[:, None], (len(z), n, z.shape[-1])) if z.ndim == 2 else z
        blank = np.zeros(1)
        x = _own_records(system, rows, [[r if s else blank for r, s in zip(now, sees, strict=True)] for now in own])
    return States(rows.means(scenario.network), np.arange(1, steps + 1), x[..., 0], scenario.model.states)


def with_errors(system: System, items: Items, found: Averaged) -> Averaged:
    """Add what the simplified formulation says of the error itself: by its own assumptions no more than it claims."""
    # one agent of each group stands for all of it
    first = np.unique(found.group_of, return_index=True)[1]
    bias = np.concatenate([mean_error(alone, some.links)[:, :, first] for _, alone, some in items.by_noises(system)])
    order = np.argsort(np.concatenate([members for members, _, _ in items.by_noises(system)]))
    moments = Moments.of(found.moments.P, found.moments.P, bias[order])
    return found._replace(moments=moments, notes=(*found.notes, SELF_CONSISTENT))


def mean_error(system: System, rows: LinkRows) -> np.ndarray:
    """What (53) leaves of the scenario's known initial error, shape (links, steps, agents, d, 1).

    An error obeys the equations of an estimate in a world whose state is zero: b(k) = (I − K̄H) F b(k−1) for like
    agents.

    Raises
    ------
    UsageError
        If unlike agents are too many to average over all sets of senders.
    """
    steps, n, d = system.network.steps, system.network.agents, system.model.dimension
    if system.error is None:
        return np.zeros((len(rows.link), steps, n, d, 1))
    still = replace(system, x0=system.error, model=replace(system.model, Bu=np.zeros((steps, d, 1))))
    widths = [sensor.H.shape[-2] for sensor in system.sensors]
    if len(widths) == 1:
        return _one_record(still, rows, np.zeros((steps, widths[0])), printed=False)
    return _own_records(still, rows, [[np.zeros(widths[kind]) for kind in system.sensor_of]] * steps)


def _one_record(system: System, rows: LinkRows, z: np.ndarray, printed: bool) -> np.ndarray:
    (group,) = simplified.groups(system, Items(rows))
    case = group.case
    if not isinstance(case, Case):
        raise TypeError("like agents make one Case")
    P, group_of = _covariances(system, rows)
    steps, d = system.network.steps, system.model.dimension
    items = P.transpose(1, 0, 2, 3, 4).reshape(steps, -1, d, d)
    x = np.broadcast_to(system.x0, (items.shape[1], d, 1))
    if printed and not case.shared:
        x = x * (case.first_share() * case.arrivals[0].gained(np.zeros(case.items)))[:, None, None]
    out = [x]
    for step in range(2, steps + 1):
        prior, sensor = _prior(system, x, items[step - 2], step), case.sensor.at(step)
        arrivals, now = case.arrivals[step - 1], z[step - 1][:, None]
        if printed:
            x = _printed(prior, sensor, arrivals, now, items[step - 1])
        else:
            x = prior.x + mean_gain(prior.P, sensor, arrivals) @ (now - sensor.H @ prior.x)
        out.append(x)
    by_group = np.stack(out).reshape(steps, len(rows.link), -1, d, 1).transpose(1, 0, 2, 3, 4)
    if by_group.shape[2] == 1:
        return np.broadcast_to(by_group, (*by_group.shape[:2], len(group_of), d, 1))
    return by_group[:, :, group_of]


def mean_gain(P: np.ndarray, sensor: Sensor, arrivals: Arrivals) -> np.ndarray:
    """K̄ = Σ β(m) K_m for priors P of shape (items, d, d), shape (items, d, p)."""
    C = np.linalg.cholesky(sensor.R)
    A = np.linalg.solve(C, sensor.H)
    s, U = np.linalg.eigh(A @ P @ A.T)
    g = arrivals.gained(np.maximum(s, 0.0).T).T
    return P @ A.T @ (U * g[:, None, :]) @ np.swapaxes(U, -1, -2) @ np.linalg.inv(C)


def _printed(prior: Estimate, sensor: Sensor, arrivals: Arrivals, z: np.ndarray, P: np.ndarray) -> np.ndarray:
    try:
        before = to_information(prior)
        local = to_information(update(prior, sensor.H, sensor.R, z))
    except np.linalg.LinAlgError:
        raise UsageError("(53) as printed needs an invertible prior covariance; use the consistent form") from None
    measured = arrivals.gained(np.zeros(len(P)))[:, None, None]  # g(0) = E[m + 1]
    return P @ (before.y + measured * (local.y - before.y))


def _own_records(system: System, rows: LinkRows, z: Sequence[Sequence[np.ndarray]] | np.ndarray) -> np.ndarray:
    network, d = system.network, system.model.dimension
    if network.agents > MOST_AGENTS:
        raise UsageError(
            f"records of each agent's own are averaged over all sets of senders, for at most {MOST_AGENTS} agents; "
            f"got {network.agents}. Give one record of shape (steps, p)"
        )
    P, group_of = _covariances(system, rows)
    senders = simplified.measuring(system)
    x = [np.broadcast_to(system.x0, (len(rows.link), d, 1))] * network.agents
    out = [np.stack(x, axis=1)]
    for step in range(2, network.steps + 1):
        heard = simplified.measured(system, rows, step)
        kinds = [sensor.at(step) for sensor in system.sensors]
        sensors = [(kinds[kind].H, kinds[kind].R) for kind in system.sensor_of]
        x = [
            _over_subsets(
                _prior(system, x[i], P[:, step - 2, group_of[i]], step),
                () if system.detects is not None else (i,),
                senders[i],
                heard[:, i],
                sensors,
                z[step - 1],
            )
            for i in range(network.agents)
        ]
        out.append(np.stack(x, axis=1))
    return np.stack(out, axis=1)


def _over_subsets(
    prior: Estimate,
    certain: Sequence[int],
    senders: np.ndarray,
    heard: np.ndarray,
    sensors: list[tuple[np.ndarray, np.ndarray]],
    z: Sequence[np.ndarray] | np.ndarray,
) -> np.ndarray:
    total, start = np.zeros_like(prior.x), factor(prior.P)
    places = range(len(senders))
    for subset in chain.from_iterable(combinations(places, m) for m in range(len(senders) + 1)):
        inside = np.isin(places, subset)
        x, L = prior.x, start
        for j in (*certain, *senders[inside]):
            # one measurement after the other, so that precise sensors lose nothing
            H, R = sensors[j]
            L = update_factor(L, H, R)
            x = x + posterior_gain(L, H, R) @ (z[j][:, None] - H @ x)
        total = total + np.where(inside, heard, 1.0 - heard).prod(axis=1)[:, None, None] * x
    return total


def _prior(system: System, x: np.ndarray, P: np.ndarray, step: int) -> Estimate:
    model = system.model
    return predict(Estimate(x, P), at_step(model.F, step), at_step(model.Q, step), at_step(model.Bu, step))


def _covariances(system: System, rows: LinkRows) -> tuple[np.ndarray, np.ndarray]:
    """Averaged covariances (rows, steps, groups, d, d), and the group of every agent."""
    found = simplified.covariances(system, Items(rows))
    if found.faults:
        raise StochfuseError(f"method simplified: {min(found.faults.items())[1]}")
    return found.P, found.group_of
