"""Draw what chance decides in a run: arrivals, misses and noises, and with them truth and measurements.

    x(k) = F x(k−1) + B u + v      v ~ N(0, Q)             one for all agents where they track one state
    z_i(k) = h_i(x_i) + w_i        w ~ N(0, [c_ij L_i L_jᵀ] + Δ)         (thesis (21)/(22) where h_i(x) = H_i x)
    z_ij(k) = H_i x_i + H_j x_j + v_ij                      what agents with states of their own measure of each other
    x̂_i(1) = x_i(1) + e_i          e ~ N(b, P(k0))          one error for all where the start is shared

The truth begins at the scenario's initial.x (or where its nominal path does), first estimates lie about it; of what
a parallel filter has beside its output (a slip, an offset) the estimate begins at 0, and the truth lies about it.
Sensors look when the scenario says that they do, about its nominal path; what they show is the true function of the
true state.

Every run has streams of random numbers of its own, so that it depends on the seed and its number alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stochfuse.data.records import NUMBERS, RecordedRuns, arrivals_of
from stochfuse.engines.events import events
from stochfuse.engines.monte_carlo import draw_fates
from stochfuse.engines.replay import ArrivalRecord
from stochfuse.errors import UsageError
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.readings import Function, Readings
from stochfuse.estimators.world import World
from stochfuse.kalman.kernel import at_step, factor
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.system import System

ARRIVALS, NOISES, DETECTIONS = 0, 1, 2
"""What a stream of random numbers is for."""
DEPARTS = 1e-6
"""Largest part of its size by which a nominal path may depart from the model without a word."""


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
    size = (1, system.agents)
    of_runs = [draw_fates(stream, by_step, [[]] * steps, size)[0] for stream in _streams(seed, ARRIVALS, first, runs)]
    heard: list[np.ndarray] = []
    late: dict[tuple[int, int], list[Late]] = {}
    for step, now in enumerate(by_step):
        fates = np.concatenate([fates[step] for fates in of_runs]).astype(np.int64)
        for event, fate in zip(now, fates.T, strict=True):
            came = np.flatnonzero(fate == 1)
            for receiver in event.receivers:
                rows = np.full((len(came), 4), (0, step, receiver, event.sender))
                rows[:, 0] = came
                heard.append(rows)
            for run in np.flatnonzero((fate > 1) & (step + fate - 1 < steps)).tolist():
                messages = late.setdefault((run, step + 1), [])
                messages += [Late(receiver, int(fate[run]) - 1, event.sender) for receiver in event.receivers]
    rows = np.concatenate(heard) if heard else np.zeros((0, 4), dtype=np.int64)
    return arrivals_of(rows, missed, {key: tuple(sorted(messages)) for key, messages in late.items()})


def _streams(seed: int, what: int, first: int, runs: int) -> Iterator[np.random.Generator]:
    """Random numbers of every run."""
    for run in range(first, first + runs):
        yield np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(what, run)))


@dataclass(frozen=True, eq=False)
class Draws:
    """Records that are drawn, in the form of those that are read (`stochfuse.data.records.Records`).

    Parameters
    ----------
    scenario : what is simulated.
    names : of the runs.
    links : one row of link probabilities.
    seed : of everything.
    write : what is told every batch, its runs' names, and by agent which measurements are there.
    """

    scenario: Scenario
    names: tuple[str, ...]
    links: LinkRows
    seed: int
    write: Callable[[RecordedRuns, Sequence[str], Callable[[int], np.ndarray]], None] | None = None

    given, with_truth = True, True
    """Whether arrivals come with the records, and whether the truth does."""

    @property
    def known(self) -> np.ndarray:
        """States of which the truth is known: all."""
        return np.arange(self.scenario.model.dimension)

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of the draws."""
        nominal, model = self.scenario.nominal, self.scenario.system.model
        if nominal is None or len(model.F) < 2:
            return ()
        nominal = nominal[: len(model.F)]
        moved = (model.F[1:] @ nominal[:-1, :, None] + model.Bu[1:])[..., 0]
        off = float(np.abs(moved - nominal[1:]).max())
        if off <= DEPARTS * float(np.abs(nominal).max()):
            return ()
        return (f"the truth follows the model; the nominal path departs from it by up to {off:.3g} in a step",)

    def batches(self) -> Iterator[RecordedRuns]:
        """Draw some runs at a time."""
        system, runs = self.scenario.system, len(self.names)
        size = max(1, NUMBERS // (system.agents * system.steps))
        for first in range(0, runs, size):
            yield self._batch(first, min(size, runs - first))

    def _batch(self, first: int, count: int) -> RecordedRuns:
        system, nominal = self.scenario.system, self.scenario.nominal
        functions = self.scenario.instruments or (None,) * system.agents
        start = system.x0 if nominal is None else nominal[0][:, None]
        missed = _misses(system, count, self.seed, first)
        truth, z, relations, begun = _Runs(system, functions, start, _streams(self.seed, NOISES, first, count)).drawn()
        if system.filters and not system.own:
            _check_one_truth(truth)
        for agent, each in enumerate(z):
            each[missed[:, :, agent]] = np.nan
            if functions[agent] is not None:  # its matrices are made where it measures, whatever the nominal path says
                missed[:, 1:, agent] = np.isnan(each[:, 1:, 0])
        batch = RecordedRuns(
            np.arange(first, first + count),
            tuple(np.nan_to_num(each) for each in z),
            relations,
            drawn_arrivals(system, self.links, missed, self.seed, first),
            missed,
            truth,
            tuple(begun),
        )
        if self.write is not None:
            seen = [~np.isnan(each[..., 0]) for each in z]
            self.write(batch, self.names[first : first + count], seen.__getitem__)
        return batch


def _misses(system: System, runs: int, seed: int, first: int) -> np.ndarray:
    """Which sensors that look see nothing, (runs, steps, agents)."""
    if system.detects is None:
        return np.zeros((runs, system.steps, system.agents), dtype=bool)
    p = system.detects[:, list(system.sensor_of)]
    return np.stack([stream.random(p.shape) >= p for stream in _streams(seed, DETECTIONS, first, runs)])


def _check_one_truth(truth: np.ndarray) -> None:
    """Raise UsageError unless the states of parallel filters, as they are shaped, are one state."""
    apart = np.abs(truth - truth[:, :, :1]).max()
    if apart > 1e-9 * np.abs(truth).max():
        raise UsageError(
            "simulate: expected filters that follow one true state, got parallel filters whose process noises "
            "([[agent]] Q, noise.process) move their states apart; predicted are errors, each about its own state"
        )


class _Runs:
    """Truth and measurements of some runs, each with its own random numbers."""

    def __init__(
        self,
        system: System,
        functions: Sequence[Function | None],
        start: np.ndarray,
        streams: Iterator[np.random.Generator],
    ) -> None:
        still = [np.zeros((1, 1, 1)) for _ in range(system.agents)]
        readings = Readings.given(system, still, first=[start[None]] * system.agents)
        self.system, self.functions = system, functions
        self.world: World = readings.world
        self.start, self.inputs, self.shifts = readings.x0, readings.inputs, readings.shifts
        D, p = len(self.world.P0), self.world.measurements[-1].stop
        related = sum(at_step(relation.R, 1).shape[-1] for relation in self.world.relations.values())
        total = D + system.steps * (D + p + related)
        self._normal, self._used = np.stack([stream.standard_normal(total) for stream in streams]), 0
        self._roots: dict[bytes, np.ndarray] = {}

    def drawn(self) -> tuple[np.ndarray, list[np.ndarray], dict[tuple[int, int], np.ndarray], list[np.ndarray]]:
        """Truth, measurements, relations and first estimates."""
        world, steps = self.world, self.system.steps
        noise = self._noise(world.P0)
        x = np.broadcast_to(self.start, (len(self._normal), *self.start.shape[1:])) - self._hidden(noise)
        error = noise + (0.0 if world.error is None else world.error)
        begun = [self._state(i, x + error) for i in range(world.agents)]
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
        z = [np.stack([now[i] for now in measured], axis=1) for i in range(world.agents)]
        return np.stack(truth, axis=1), z, {pair: np.stack(e, axis=1) for pair, e in relations.items()}, begun

    def _hidden(self, error: np.ndarray) -> np.ndarray:
        """Part of the first errors that no output M x + s of a filter shows: there it is the truth that is drawn."""
        out = np.zeros_like(error)
        for rows, M in zip(self.world.states, self.world.M or (), strict=False):
            out[:, rows] = error[:, rows] - np.linalg.pinv(M) @ M @ error[:, rows]
        return out

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
        """A draw for each run, (runs, …, 1)."""
        key = covariance.tobytes()
        if key not in self._roots:  # most are the same at every step
            self._roots[key] = factor(covariance)
        unit = self._normal[:, self._used : self._used + len(covariance), None]
        self._used += len(covariance)
        return self._roots[key] @ unit
