"""Sensors heard over lossy links, fused into one equivalent measurement, then filtered once.

What agents send is what they measured.  At every step an agent makes one measurement of its own and those that it
hears, z̄ = A z with the bound R̄ (`stochfuse.fusion.equivalent`), and takes it into its own filter.  At step
1 nothing has been measured, so that nothing is exchanged.  `IndependentMeasurements` does the same with R̄ as if all
noises were independent and undisturbed.

Nothing of an agent's error comes from another agent's estimate: footprints are not needed, its actual covariance goes
on by itself,  (I − K̄H) A⁻ (I − K̄H)ᵀ + K̄ A (R + Δ) Aᵀ K̄ᵀ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.recursion import FusionStep, PastState, RecursiveEstimator, Worked
from stochfuse.fusion.equivalent import (
    Equivalent,
    actual_error,
    equivalent_measurement,
    independent_measurement,
)
from stochfuse.kalman.kernel import Estimate, at_step, corrected, gain, predict, update

MEASURED, MISSED = "measured", "missed"


class EquivalentMeasurement(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, of which relabellings are not used."""

    def __init__(self, world: Any, kinds: Sequence[int], relabellings: Any = None, *, errors: bool = False) -> None:
        super().__init__(world, range(world.agents), None, errors=errors)
        self._fused: dict[tuple[int, tuple[int, ...]], tuple[Equivalent, np.ndarray]] = {}
        self._rules: dict[tuple[int, int], FusionStep] = {}
        varying = [each.ndim > 2 for each in (*world.R, *world.H)]
        self._varies = any(varying)
        self._sees = [i for i in range(world.agents) if world.H[i].any()]
        for i in self._sees:
            first = world.H[self._sees[0]]
            if world.H[i].shape != first.shape or (world.H[i] != first).any():
                raise UsageError(
                    "estimators of measurements: expected sensors that measure the same (one H), got another H of "
                    f"agent {i + 1}"
                )

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the agent's estimate with all measurements heard."""
        if step == 1:
            return values[agent]
        missed = [self.pasts.rule[value][0] == MISSED for value in values]
        key = (agent, heard & ~sum(1 << j for j, without in enumerate(missed) if without))
        rule = self._rules.get(key)
        if rule is None:
            there = {agent, *self.neighbours(agent, heard)}
            members = [j for j in sorted(there) if j in self._sees and not missed[j]]
            rule = self._rules[key] = (MEASURED, agent, *members)
        before = self.pasts.rests_on[values[agent]][0] if missed[agent] else values[agent]
        return self.pasts.number(step, rule, (before,))

    def rests_on(self, state: PastState) -> Iterator[int]:
        """Of an agent whose sensor missed, what it had before: the state says only that it missed."""
        for value in state.agents:
            missed = self.pasts.rule[value][0] == MISSED
            yield self.pasts.rests_on[value][0] if missed else value

    def renamed(self, state: PastState, names: Mapping[int, int], into: Any) -> PastState:
        """Say again who missed."""
        agents = []
        for value in state.agents:
            rule, before = self.pasts.rule[value], self.pasts.rests_on[value]
            missed = rule[0] == MISSED
            agents.append(into.pasts.number(state.step, rule, (names[before[0]],)) if missed else names[value])
        return PastState(state.step, tuple(agents))

    def onward(self, step: int, agent: int, fused: int, before: int, missed: bool) -> int:
        """The estimate itself: what is measured next, if it is, is taken in with what is heard then."""
        return self.pasts.number(step + 1, (MISSED, agent), (fused,)) if missed else fused

    def first(self, rows: slice) -> Worked:
        """First estimate, with its actual moments."""
        P = self.world.P0[rows, rows][None]
        if self.readings is not None:
            return Worked(P, self.readings.start(rows))
        if not self.errors:
            return Worked(P)
        b = np.zeros((P.shape[-1], 1)) if self.world.error is None else self.world.error[rows]
        return Worked(P, actual=P, bias=b[None])

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Time update and one measurement."""
        name, agent, *members = rules[0]
        (before,), rows = rests_on, self.world.states[agent]
        if name == MISSED:  # only says so of the estimate that it rests on
            return before
        F, Q = at_step(self.world.F[agent], step), at_step(self.world.Q, step)[rows, rows]
        if self.readings is not None:
            return self._on_data(
                step, predict(Estimate(before.x, before.P), F, Q, self.readings.process(step, rows)), members
            )
        prior = predict(Estimate(before.bias, before.P), F, Q)
        truth = None if before.actual is None else predict(Estimate(None, before.actual), F, Q).P
        if not members:
            return Worked(prior.P, actual=truth, bias=prior.x)
        H = at_step(self.world.H[members[0]], step)
        fused, noise = self._measurement(step, tuple(members))
        K = gain(prior.P, H, fused.R)
        P = corrected(prior.P, K, H, fused.R)
        if truth is None:
            return Worked(P)
        return Worked(P, actual=corrected(truth, K, H, noise), bias=prior.x - K @ (H @ prior.x))

    def _on_data(self, step: int, prior: Estimate, members: Sequence[int]) -> Worked:
        """One measurement of what was measured, z̄ = A z."""
        if not members or self.readings is None:
            return Worked(prior.P, prior.x)
        fused, _ = self._measurement(step, tuple(members))
        z = np.concatenate([self.readings.measured(step, j) for j in members], axis=-2)
        x, P = update(prior, at_step(self.world.H[members[0]], step), fused.R, fused.weights @ z)
        return Worked(P, x)

    def _measurement(self, step: int, members: tuple[int, ...]) -> tuple[Equivalent, np.ndarray]:
        """Equivalent measurement of some sensors, and what its error covariance truly is."""
        key = (step if self._varies else 0, members)
        if key not in self._fused:
            which = np.concatenate([np.arange(s.start, s.stop) for s in (self.world.measurements[j] for j in members)])
            R = self.world.joint_noise(step)[np.ix_(which, which)]
            Δ = None if self.world.disturbance is None else self.world.disturbance[np.ix_(which, which)]
            try:
                fused = self.fused_measurement(R, len(members), Δ)
            except UsageError as error:
                agents = ", ".join(str(j + 1) for j in members)
                raise UsageError(f"the noises of agents {agents} ([noise], [[agent]] R): {error}") from None
            self._fused[key] = fused, actual_error(fused.weights, R, Δ)
        return self._fused[key]

    def fused_measurement(self, R: np.ndarray, sensors: int, disturbance: np.ndarray | None) -> Equivalent:
        """One measurement for several, with the bound on its error."""
        return equivalent_measurement(R, sensors, disturbance)


class IndependentMeasurements(EquivalentMeasurement):
    """The estimator; parameters are those of `EquivalentMeasurement`."""

    def fused_measurement(self, R: np.ndarray, sensors: int, disturbance: np.ndarray | None) -> Equivalent:
        """One measurement for several, whose noises are taken for independent and undisturbed."""
        return independent_measurement(R, sensors)
