"""Expected state estimates for a given measurement record, thesis (53).

With P_m one update with m + 1 measurements, the consistent (53) is

    x̂(k) = x̂⁻ + K̄ (z − H x̂⁻),    K̄ = Σ β(m) K_m,   K_m = P⁻Hᵀ(H P⁻Hᵀ + R/(m+1))⁻¹

for one record z(k) that stands for what every agent measured, as (53) has it.  Agents with records of their own average
over the sets S of senders, x̂_i(k) = Σ_S µ_S µ_¬S update(prior_i; z_i and z_j, j ∈ S), with agent i's prior in the place
of the common one.  m measurements of one kind of sensor are their mean with R/m, and x̂ is linear in it: in the place of
2^(n−1) sets the numbers m of each kind are gone through, with the mean of what arrives given m.  The printed (53) puts
the averaged P(k) in front of the sum; its bias is erratum 1 (see `stochfuse.prediction.simplified`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
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
    measurements : (steps, p): one record that stands for every agent's; or (steps, agents, p): each agent's own, p
        the most that any measures.  The entry of step 1 is not used: nothing is measured before the first exchange.
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
    # what agents without a sensor, or with fewer components than others, are said to measure there does not matter
    widths = set(sees[sees > 0].tolist()) or {z.shape[-1] if z.ndim else 0}
    forms = "(steps, agents, p)" if len(widths) > 1 else "(steps, p) or (steps, agents, p)"
    if (
        z.ndim not in (2, 3)
        or (z.ndim == 2 and len(widths) > 1)
        or len(z) < steps
        or z.shape[-1] != max(widths)
        or (z.ndim == 3 and z.shape[1] != n)
    ):
        raise UsageError(
            f"measurements: expected shape {forms} with {steps} steps, {n} agents and p = {max(widths)}, got {z.shape}"
        )
    seen = np.arange(z.shape[-1]) < sees[:, None]
    if not np.isfinite(z[1:steps] if z.ndim == 2 else z[1:steps, seen]).all():
        raise UsageError("measurements: expected finite numbers, got NaN or infinity")
    if z.ndim == 2 and len(scenario.sensors) == 1 and sees.all():
        x = _one_record(system, rows, z, printed)
    elif printed:
        raise UsageError("(53) as printed takes one record for all agents, of shape (steps, p)")
    else:
        own = np.broadcast_to(z[:, None], (len(z), n, z.shape[-1])) if z.ndim == 2 else z
        x = _own_records(system, rows, np.where(seen, own, 0.0))
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
    """
    steps, n, d = system.network.steps, system.network.agents, system.model.dimension
    if system.error is None:
        return np.zeros((len(rows.link), steps, n, d, 1))
    still = replace(system, x0=system.error, model=replace(system.model, Bu=np.zeros((steps, d, 1))))
    widths = [sensor.H.shape[-2] for sensor in system.sensors]
    if len(widths) == 1:
        return _one_record(still, rows, np.zeros((steps, widths[0])), printed=False)
    return _own_records(still, rows, np.zeros((steps, n, max(widths))))


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


def _own_records(system: System, rows: LinkRows, z: np.ndarray) -> np.ndarray:
    """Expected estimates (rows, steps, agents, d, 1) from each agent's own record, (steps, agents, p)."""
    n, steps = system.agents, system.steps
    P, group_of = _covariances(system, rows)
    senders, own = simplified.measuring(system), np.arange(n)[:, None]
    heard_own = np.ones((len(rows.link), n, 1))
    if system.detects is None:
        senders = np.concatenate([senders, own], axis=1)
    kinds = np.asarray(system.sensor_of)[senders]
    x = np.broadcast_to(system.x0, (len(rows.link), n, *system.x0.shape))
    out = [x]
    for step in range(2, steps + 1):
        heard = simplified.measured(system, rows, step)
        if system.detects is None:
            heard = np.concatenate([heard, heard_own], axis=2)
        arrived = [
            (
                sensor.at(step),
                *_arrived(np.where(kinds == kind, heard, 0.0), z[step - 1, :, : sensor.H.shape[-2]][senders]),
            )
            for kind, sensor in enumerate(system.sensors)
            if sensor.H.any()
        ]
        x = _over_counts(_prior(system, x, P[:, step - 2, group_of], step), arrived)
        out.append(x)
    return np.stack(out, axis=1)


def _arrived(heard: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probability that m = 0, 1 … measurements arrive, (m, rows, agents), and their mean given m, (…, p, 1).

    Parameters
    ----------
    heard, z : how likely each measurement arrives, (rows, agents, senders), and what it is, (agents, senders, p).
    """
    most = int((heard > 0).sum(axis=2).max())
    probability, total = np.zeros((most + 1, *heard.shape[:2])), np.zeros((most + 1, *heard.shape[:2], z.shape[-1]))
    probability[0] = 1.0
    for µ, value in zip(np.moveaxis(heard, 2, 0), np.moveaxis(z, 1, 0), strict=True):
        # one more: with probability µ, and then it adds to what the others were
        more, others = µ * probability[:-1], µ[..., None] * total[:-1]
        probability *= 1.0 - µ
        total *= 1.0 - µ[..., None]
        total[1:] += others + more[..., None] * value
        probability[1:] += more
    numbers = np.arange(most + 1).reshape(-1, 1, 1) * probability
    mean = np.divide(total, numbers[..., None], out=np.zeros_like(total), where=numbers[..., None] > 0)
    return probability, mean[..., None]


def _over_counts(prior: Estimate, arrived: Sequence[tuple[Sensor, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Σ over how many measurements of each kind arrive: linear in them, an estimate needs their mean alone."""
    total, start = np.zeros_like(prior.x), factor(prior.P)
    for counts in product(*(range(len(probability)) for _, probability, _ in arrived)):
        weight = np.prod([p[m] for m, (_, p, _) in zip(counts, arrived, strict=True)], axis=0)
        if not np.any(weight):
            continue
        x, L = prior.x, start
        for m, (sensor, _, mean) in zip(counts, arrived, strict=True):
            if m:  # one kind after the other, so that precise sensors lose nothing
                L = update_factor(L, sensor.H, sensor.R / m)
                x = x + posterior_gain(L, sensor.H, sensor.R / m) @ (mean[m] - sensor.H @ x)
        total = total + np.asarray(weight)[..., None, None] * x
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
