"""Draw what chance decides in a run: arrivals, misses and noises, and with them truth and measurements.

    x(k) = F x(k−1) + B u + v      v ~ N(0, Q)             one for all agents where they track one state
    z_i(k) = h_i(x_i) + w_i        w ~ N(0, [c_ij L_i L_jᵀ] + Δ)         (thesis (21)/(22) where h_i(x) = H_i x)
    z_ij(k) = H_i x_i + H_j x_j + v_ij                      what agents with states of their own measure of each other
    x̂_i(1) = x_i(1) + e_i          e ~ N(b, P(k0))          one error for all where the start is shared

The truth begins at the scenario's initial.x (or where its nominal path does), first estimates lie about it.  Sensors
look when the scenario says that they do, about its nominal path; what they show is the true function of the true state.

Random numbers are drawn in blocks of runs, each with a seed of its own, so that a run depends on the seed and its
number alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.data.records import arrivals_of
from stochfuse.engines.events import events
from stochfuse.engines.monte_carlo import draw_fates
from stochfuse.engines.replay import ArrivalRecord
from stochfuse.errors import UsageError
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.readings import Function, Readings
from stochfuse.estimators.world import World
from stochfuse.kalman.kernel import at_step, factor
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.system import System

BLOCK = 100
"""Runs drawn from one seed."""
ARRIVALS, NOISES, DETECTIONS = 0, 1, 2
"""What a stream of random numbers is for."""


class Drawn(NamedTuple):
    """Truth and measurements of some runs.

    Parameters
    ----------
    truth : (runs, steps, agents, d) true states.
    z : by agent, (runs, steps, p) measurements; NaN where nothing was measured.
    relations : by pair of agents, (runs, steps, p) what one measured of the other.
    missed : (runs, steps, agents) whether an agent that has a sensor measured nothing, unless by its very H.
    first : by agent, (runs, d, 1) first estimates.
    """

    truth: np.ndarray
    z: tuple[np.ndarray, ...]
    relations: dict[tuple[int, int], np.ndarray]
    missed: np.ndarray
    first: tuple[np.ndarray, ...]


def drawn_arrivals(system: System, links: LinkRows, missed: np.ndarray, seed: int, first: int = 0) -> ArrivalRecord:
    """Draw what arrives in some runs.

    Parameters
    ----------
    links : one row of link probabilities.
    missed : (runs, steps, agents) which sensors missed.
    seed, first : seed of all runs, and the number of the first of these.
    """
    runs, steps, _ = missed.shape
    by_step = [events(system.network, links, step) for step in range(1, 1 + (steps if links.varies else 1))]
    by_step = by_step if links.varies else by_step * steps
    heard: list[np.ndarray] = []
    late: dict[tuple[int, int], list[Late]] = {}
    for place, number, block in _blocks(seed, ARRIVALS, first, runs):
        fates, _ = draw_fates(block, by_step, [[]] * steps, (BLOCK, system.agents))
        for step, (drawn, now) in enumerate(zip(fates, by_step, strict=True)):
            mine = drawn[number]
            for event, fate in zip(now, mine.T, strict=True):
                came = np.flatnonzero(fate == 1)
                for receiver in event.receivers:
                    rows = np.full((len(came), 4), (0, step, receiver, event.sender))
                    rows[:, 0] = place.start + came
                    heard.append(rows)
                for run in np.flatnonzero((fate > 1) & (step + fate - 1 < steps)).tolist():
                    messages = late.setdefault((place.start + run, step + 1), [])
                    messages += [Late(receiver, int(fate[run]) - 1, event.sender) for receiver in event.receivers]
    rows = np.concatenate(heard) if heard else np.zeros((0, 4), dtype=np.int64)
    return arrivals_of(rows, missed, {key: tuple(sorted(messages)) for key, messages in late.items()})


def _blocks(seed: int, what: int, first: int, runs: int) -> list[tuple[slice, slice, np.random.Generator]]:
    """For every block of runs that is met: places among these runs, places in the block, and its random numbers."""
    out = []
    for block in range(first // BLOCK, (first + runs - 1) // BLOCK + 1):
        start, stop = max(first, block * BLOCK), min(first + runs, (block + 1) * BLOCK)
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(what, block)))
        out.append((slice(start - first, stop - first), slice(start - block * BLOCK, stop - block * BLOCK), generator))
    return out


def drawn(
    system: System,
    functions: Sequence[Function | None],
    start: np.ndarray,
    runs: int,
    seed: int,
    first: int = 0,
) -> Drawn:
    """Draw truth and measurements of some runs.

    Parameters
    ----------
    functions : by agent, what its sensor measures where that is not linear; may be empty.
    start : (d, 1) true state at step 1.
    runs, seed, first : how many runs, the seed of all, and the number of the first of these.
    """
    functions = tuple(functions) or (None,) * system.agents
    missed = np.zeros((runs, system.steps, system.agents), dtype=bool)
    for place, number, generator in _blocks(seed, DETECTIONS, first, runs):
        steps = range(1, system.steps + 1)
        size = (BLOCK, system.agents)
        _, missing = draw_fates(generator, [[]] * system.steps, [system.detections(k) for k in steps], size)
        missed[place] = np.stack(missing, axis=1)[number]
    parts = []
    for _, number, generator in _blocks(seed, NOISES, first, runs):
        parts.append(_Block(system, functions, start, generator).drawn(number))
    truth, z, relations, begun = zip(*parts, strict=True)
    if system.filters and not system.own:
        _check_one_truth(np.concatenate(truth))
    measured = tuple(np.concatenate(each) for each in zip(*z, strict=True))
    for agent, each in enumerate(measured):
        each[missed[:, :, agent]] = np.nan
        if (
            functions[agent] is not None
        ):  # whose matrices are those of the estimate, also where the nominal path has none
            missed[:, 1:, agent] = np.isnan(each[:, 1:, 0])
    return Drawn(
        np.concatenate(truth),
        measured,
        {pair: np.concatenate([each[pair] for each in relations]) for pair in system.relations},
        missed,
        tuple(np.concatenate(each) for each in zip(*begun, strict=True)),
    )


def _check_one_truth(truth: np.ndarray) -> None:
    """Raise UsageError unless the states of parallel filters, as they are shaped, are one state."""
    apart = np.abs(truth - truth[:, :, :1]).max()
    if apart > 1e-9 * np.abs(truth).max():
        raise UsageError(
            "simulate: expected filters that follow one true state, got parallel filters whose process noises "
            "([[agent]] Q, noise.process) move their states apart; predicted are errors, each about its own state"
        )


class _Block:
    """Truth and measurements of a block of runs."""

    def __init__(
        self, system: System, functions: Sequence[Function | None], start: np.ndarray, generator: np.random.Generator
    ) -> None:
        still = [np.zeros((1, 1, 1)) for _ in range(system.agents)]
        readings = Readings.given(system, still, first=[start[None]] * system.agents)
        self.system, self.functions, self.generator = system, functions, generator
        self.world: World = readings.world
        self._roots: dict[bytes, np.ndarray] = {}
        self.start, self.inputs, self.shifts = readings.x0, readings.inputs, readings.shifts

    def drawn(
        self, which: slice
    ) -> tuple[np.ndarray, list[np.ndarray], dict[tuple[int, int], np.ndarray], list[np.ndarray]]:
        """Truth, measurements, relations and first estimates of some runs of the block."""
        world, steps = self.world, self.system.steps
        x = np.broadcast_to(self.start, (BLOCK, *self.start.shape[1:]))
        error = self._noise(world.P0) + (0.0 if world.error is None else world.error)
        begun = [self._state(i, x + error)[which] for i in range(world.agents)]
        truth, measured = [], []
        relations: dict[tuple[int, int], list[np.ndarray]] = {pair: [] for pair in world.relations}
        for step in range(1, steps + 1):
            if step > 1:
                moved = world.joint_transition(step) @ x + at_step(self.inputs, step)
                x = moved + self._noise(at_step(world.Q, step))
            truth.append(np.stack([self._state(i, x)[..., 0] for i in range(world.agents)], axis=1))
            measured.append(self._measured(step, x))
            for pair in world.relations:
                H_i, H_j, R = world.between(step, pair)
                own, other = (x[:, world.states[i]] for i in pair)
                relations[pair].append((H_i @ own + H_j @ other + self._noise(R))[..., 0])
        z = [np.stack([now[i] for now in measured], axis=1)[which] for i in range(world.agents)]
        related = {pair: np.stack(each, axis=1)[which] for pair, each in relations.items()}
        return np.stack(truth, axis=1)[which], z, related, begun

    def _measured(self, step: int, x: np.ndarray) -> list[np.ndarray]:
        """What every agent measures, NaN where its sensor does not look."""
        world, out = self.world, []
        noise = self._noise(world.true_noise(step))
        for agent, rows in enumerate(world.measurements):
            H, own, f = at_step(world.H[agent], step), x[:, world.states[agent]], self.functions[agent]
            seen = (H @ own if f is None else f.h(own, step)) + noise[:, rows]
            out.append(seen[..., 0] if H.any() and step > 1 else np.full(seen.shape[:2], np.nan))
        return out

    def _state(self, agent: int, x: np.ndarray) -> np.ndarray:
        """State of an agent's filter as it is shaped into the full one."""
        own, M = x[:, self.world.states[agent]], self.world.M
        return own + self.shifts[agent] if M is None else M[agent] @ own + self.shifts[agent]

    def _noise(self, covariance: np.ndarray) -> np.ndarray:
        """A draw for each run of the block, (runs, …, 1)."""
        key = covariance.tobytes()
        if key not in self._roots:  # most are the same at every step
            self._roots[key] = factor(covariance)
        return self._roots[key] @ self.generator.standard_normal((BLOCK, len(covariance), 1))
