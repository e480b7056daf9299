"""Innovations of one filter over all that was measured: how likely a record is, as it stands and if it were otherwise.

All agents' measurements of a step go one after the other into one (extended) Kalman filter of what the scenario says,
whatever arrived.  Its innovations, each given all before it, are the record's likelihood,

    log p(z) = −½ Σ (νᵀS⁻¹ν + log det S) + const,      S = H P⁻Hᵀ + R

so that w = S^(−½) ν is white of covariance I if the scenario is right.  No rule of fusion has a part in it: what it is
off by is the record's fault, or the scenario's.  A case says what the measurements or noises would be instead; of
measurements z' = a z + b it is the record's likelihood too once log |a| is added for each.  Where agents have states of
their own, or noises in common, each agent has a filter of its own instead.

Cases are worked on side by side.  A measurement that a case has no use for (at the ends of what is shifted in time)
counts as the average of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.estimators.readings import Function
from stochfuse.estimators.world import World, world_of
from stochfuse.kalman.kernel import Estimate, at_step, predict
from stochfuse.scenario.system import System


class Supposition(NamedTuple):
    """What is supposed of a record.

    Parameters
    ----------
    z : by agent, (runs, steps, p) what it measured; NaN where nothing.
    scale : by agent, (p,) by how much that is larger than what the record says.
    noise : by agent, (p,) factors of the variances R.
    process, start : factors of Q and P(k0).
    motion : F and Q in the place of the model's, where agents track one state by a model that does not vary; or None.
    """

    z: tuple[np.ndarray, ...]
    scale: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]
    process: float = 1.0
    start: float = 1.0
    motion: tuple[np.ndarray, np.ndarray] | None = None

    def with_agent(self, agent: int, **changed: np.ndarray) -> Supposition:
        """Return the case with another z, scale or noise of an agent, counted from 0."""
        fields = {}
        for name, value in changed.items():
            values = list(getattr(self, name))
            values[agent] = value
            fields[name] = tuple(values)
        return self._replace(**fields)


class InnovationSetting(NamedTuple):
    """What all cases have in common.

    Parameters
    ----------
    system : what is told.
    functions : by agent, what it measures if that is not linear, or None.
    first : by agent, (runs, d, 1) first estimates, empty where they are the system's.
    together : whether one filter takes what all agents measure, or each has its own.
    truth : (runs, steps, agents, d) true states, about which measurements are then looked at in the place of
        predictions, S = R; or None.
    """

    system: System
    functions: tuple[Function | None, ...]
    first: tuple[np.ndarray, ...]
    together: bool
    truth: np.ndarray | None = None


class Innovations(NamedTuple):
    """Of some cases.

    Parameters
    ----------
    white : (cases, runs, steps, agents, p) innovations in units of what is claimed of them; NaN where there is none.
    likelihood : (cases,) log p, but for a constant, of as many measurements as the first case has; −∞ where the filter
        breaks down.
    counts : (cases,) number of measurements.
    """

    white: np.ndarray
    likelihood: np.ndarray
    counts: np.ndarray

    def of(self, case: int) -> Innovations:
        """Return one case."""
        one = slice(case, case + 1)
        return Innovations(self.white[one], self.likelihood[one], self.counts[one])

    def nis(self, case: int = 0, agent: int | None = None) -> float:
        """Mean squared innovation of a degree of freedom, 1 if all is right; NaN where there is none."""
        white = self.white[case] if agent is None else self.white[case, :, :, agent]
        there = ~np.isnan(white)
        return float((white[there] ** 2).mean()) if there.any() else np.nan


def setting_of(system: System, functions: Sequence[Function | None], first: Sequence[np.ndarray]) -> InnovationSetting:
    """Return what cases of a record have in common; see `InnovationSetting`."""
    functions = tuple(functions) or (None,) * system.agents
    return InnovationSetting(system, functions, tuple(first), together=system.one_state and system.noise is None)


def innovations(setting: InnovationSetting, cases: Sequence[Supposition]) -> Innovations:
    """Filter what each case says was measured; see the module."""
    with np.errstate(all="ignore"):
        return _Filters(setting, cases).run()


def estimates(setting: InnovationSetting, case: Supposition) -> Estimate:
    """Return x (runs, steps − 1, filters, d) and P of the filters of a case, from step 2 on."""
    with np.errstate(all="ignore"):
        filters = _Filters(setting, [case])
        filters.run()
    return Estimate(*(np.stack(each, axis=1) for each in zip(*filters.after, strict=True)))


class _Filters:
    """The filters of all cases, one over all agents or one for each."""

    def __init__(self, setting: InnovationSetting, cases: Sequence[Supposition]) -> None:
        self.world: World = world_of(setting.system)
        self.setting, self.cases = setting, cases
        runs, self.steps = cases[0].z[0].shape[:2]
        n, p = self.world.agents, max(z.shape[-1] for z in cases[0].z)
        self.z = [np.stack([case.z[i] for case in cases]) for i in range(n)]
        self.noise = [np.sqrt(np.stack([case.noise[i] for case in cases]))[:, None] for i in range(n)]
        self.process = np.array([case.process for case in cases])[:, None, None, None]
        self.moved = None
        if any(case.motion is not None for case in cases):
            rows = self.world.states[0]
            told = at_step(self.world.F[0], 2), at_step(self.world.Q, 2)[rows, rows]
            each = [told if case.motion is None else case.motion for case in cases]
            self.moved = tuple(np.stack(matrices)[:, None] for matrices in zip(*each, strict=True))
        self.white = np.full((len(cases), runs, self.steps, n, p), np.nan)
        self.likelihood = np.zeros(len(cases))
        self.counts = np.zeros(len(cases))
        groups = [list(range(n))] if setting.together else [[i] for i in range(n)]
        self.filters = {agents[0]: self._start(agents, runs) for agents in groups}
        self.groups = groups
        self.after: list[Estimate] = []

    def _start(self, agents: list[int], runs: int) -> Estimate:
        system, rows = self.setting.system, self.world.states[agents[0]]
        P = self.world.P0[rows, rows]
        x = np.broadcast_to(system.x0, (runs, *system.x0.shape))
        if self.setting.first:
            given = np.stack([self.setting.first[i] for i in agents])
            x = given.mean(axis=0)
            if len(agents) > 1 and not system.shared and (given != given[0]).any():
                P = P / len(agents)
        if system.error is not None:
            x = x - system.error
        P = P * np.array([case.start for case in self.cases])[:, None, None, None]
        return Estimate(np.broadcast_to(x, (len(P), *x.shape)), np.broadcast_to(P, (len(P), runs, *P.shape[2:])))

    def run(self) -> Innovations:
        for step in range(2, self.steps + 1):
            for agents in self.groups:
                rows = self.world.states[agents[0]]
                told = at_step(self.world.F[agents[0]], step), at_step(self.world.Q, step)[rows, rows]
                F, Q = told if self.moved is None else self.moved
                moved = at_step(self.setting.system.model.Bu, step)
                estimate = predict(self.filters[agents[0]], F, Q * self.process, moved)
                if self.setting.truth is not None:
                    estimate = self._true(self.setting.truth, agents[0], step)
                for agent in agents:
                    estimate = self._measured(estimate, agent, step)
                self.filters[agents[0]] = estimate
            self.after.append(self._last())
        average = self.likelihood / np.maximum(self.counts, 1.0)
        likelihood = self.likelihood + (self.counts[0] - self.counts) * average
        return Innovations(self.white, np.where(np.isfinite(likelihood), likelihood, -np.inf), self.counts)

    def _true(self, truth: np.ndarray, agent: int, step: int) -> Estimate:
        x, P = self.filters[agent]
        now = truth[:, step - 1, min(agent, truth.shape[2] - 1), :, None]
        return Estimate(np.broadcast_to(now, x.shape), np.zeros_like(P))

    def _last(self) -> Estimate:
        """Of the first case, runs × filters."""
        x, P = zip(*self.filters.values(), strict=True)
        return Estimate(np.stack([each[0, ..., 0] for each in x], axis=1), np.stack([each[0] for each in P], axis=1))

    def _measured(self, prior: Estimate, agent: int, step: int) -> Estimate:
        f, z = self.setting.functions[agent], self.z[agent][:, :, step - 1, :, None]
        H = at_step(self.world.H[agent], step)
        there = ~np.isnan(z).any(axis=(-2, -1)) & ~np.isnan(prior.x).any(axis=(-2, -1))
        if not there.any() or (f is None and not H.any()):
            return prior
        x, P = prior
        D = self.noise[agent]
        R = at_step(self.world.R[agent], step) * (D[..., :, None] * D[..., None, :])
        z, x = np.where(there[..., None, None], z, 0.0), np.where(np.isnan(x), 0.0, x)
        H, nu = (H, z - H @ x) if f is None else (f.H(x, step), f.residual(z, f.h(x, step)))
        PH = P @ np.swapaxes(H, -1, -2)
        S = H @ PH + R
        broken = ~np.isfinite(S).all(axis=(-2, -1))
        L, broken = _rooted(np.where(broken[..., None, None], np.eye(S.shape[-1]), S), broken)
        solved = np.linalg.solve(L, np.concatenate([nu, np.swapaxes(PH, -1, -2)], axis=-1))
        w, half = solved[..., :1], solved[..., 1:]
        taken = there & ~broken
        self._tally(agent, step, w[..., 0], L, there, broken)
        gained = np.where(taken[..., None, None], np.swapaxes(half, -1, -2), 0.0)
        return Estimate(x + gained @ w, P - gained @ np.swapaxes(gained, -1, -2))

    def _tally(
        self, agent: int, step: int, w: np.ndarray, L: np.ndarray, there: np.ndarray, broken: np.ndarray
    ) -> None:
        log_det = 2.0 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
        scaled = np.array([np.log(np.abs(case.scale[agent])).sum() for case in self.cases])[:, None]
        log_p = np.where(broken, -np.inf, scaled - 0.5 * ((w**2).sum(axis=-1) + log_det))
        self.likelihood += np.where(there, log_p, 0.0).sum(axis=1)
        self.counts += there.sum(axis=1)
        self.white[:, :, step - 1, agent, : w.shape[-1]] = np.where(there[..., None], w, np.nan)


def _rooted(S: np.ndarray, broken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky factors, and which have none."""
    try:
        return np.linalg.cholesky(S), broken
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(S)
        broken = broken | (values[..., 0] <= 0)
        root = vectors * np.sqrt(np.maximum(values, 1e-300))[..., None, :]
        R = np.linalg.qr(np.swapaxes(root, -1, -2))[1]
        sign = np.where(np.diagonal(R, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
        return np.swapaxes(R * sign[..., :, None], -1, -2), broken
