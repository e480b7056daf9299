"""A Monte Carlo of a network on Stone Soup's Kalman components, as a user would write it, against the exact answer.

Three agents of thesis-transient measure a random walk.  What an agent holds is a set of measurements; a message brings
everything that its sender holds (handbook: contact chain), and an agent's estimate is a Kalman filter over all it holds, run
again from the first step at which something new arrived.  An initial estimate travels as a measurement of its own
covariance.  Noises are drawn with NumPy, which takes less time than Stone Soup's models do.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

import stochfuse as sf
from tests.benchmarks.__main__ import medians
from tests.benchmarks.peers.ways import OURS, STONE_SOUP, Row, Section, agreed

PRESET, AGENTS, STEPS, µ = "thesis-transient", 3, 5, 0.5
Q, R, P0 = 25.0, 100.0, 100.0
ACCURACY = 0.01

SENSOR = LinearGaussian(ndim_state=1, mapping=(0,), noise_covar=np.array([[R]]))
ESTIMATE = LinearGaussian(ndim_state=1, mapping=(0,), noise_covar=np.array([[P0]]))
PREDICTOR = KalmanPredictor(
    LinearGaussianTimeInvariantTransitionModel(transition_matrix=np.eye(1), covariance_matrix=np.array([[Q]]))
)
UPDATER = KalmanUpdater(SENSOR)

Held = list[dict[int, Detection]]
"""Measurements of step 1, 2, …, by the agent that made them."""


class Agent:
    """An agent: its first estimate, what it holds, and its filter's state after every step."""

    def __init__(self, number: int, first: Detection) -> None:
        self.number = number
        self.prior = GaussianState(first.state_vector, np.array([[P0]]))
        self.held: Held = [{number: first}]
        self.states: list[GaussianState] = [self.prior]

    def measure(self, detection: Detection) -> None:
        self.held.append({self.number: detection})

    def take(self, messages: Sequence[Held]) -> None:
        """Hear some messages, and run the filter again from the first step that they change."""
        changed = len(self.held) - 1
        for message in messages:
            for step, (own, brought) in enumerate(zip(self.held, message, strict=True)):
                if brought.keys() - own.keys():
                    own.update(brought)
                    changed = min(changed, step)
        self.states = self.states[:changed]
        for step in range(changed, len(self.held)):
            self.states.append(self._filtered(step))

    def _filtered(self, step: int) -> GaussianState:
        state: Any = PREDICTOR.predict(self.states[step - 1]) if step else self.prior
        for source, detection in self.held[step].items():
            if step or source != self.number:  # the agent's own first estimate is the prior
                state = UPDATER.update(SingleHypothesis(state, detection))
        return state


def run(rng: np.random.Generator) -> np.ndarray:
    """One run: the agents' mean covariance after every step's exchange, (steps,)."""
    truth, out = 0.0, np.empty(STEPS)
    agents = [Agent(i, Detection([[rng.normal(truth, P0**0.5)]], measurement_model=ESTIMATE)) for i in range(AGENTS)]
    for step in range(STEPS):
        if step:
            truth = rng.normal(truth, Q**0.5)
            for agent in agents:
                agent.measure(Detection([[rng.normal(truth, R**0.5)]], measurement_model=SENSOR))
        arrived = rng.random((AGENTS, AGENTS)) < µ
        sent = [[dict(of_step) for of_step in agent.held] for agent in agents]
        for i, agent in enumerate(agents):
            agent.take([sent[j] for j in range(AGENTS) if j != i and arrived[i, j]])
        out[step] = np.mean([agent.states[-1].covar[0, 0] for agent in agents])
    return out


def runs_needed(sample: np.ndarray) -> int:
    """Runs for a standard error of 1 % of the mean at every step."""
    return int(np.ceil((sample.std(axis=0, ddof=1) / sample.mean(axis=0) / ACCURACY).max() ** 2))


def worst(sample: np.ndarray, exact: np.ndarray) -> float:
    """Largest difference of a sample's mean, in its standard errors."""
    error = sample.std(axis=0, ddof=1) / len(sample) ** 0.5
    return float((np.abs(sample.mean(axis=0) - exact) / error).max())


def section(quick: bool, rounds: int) -> Section:
    """Agreement of the sampled means with the exact answer, then the time to the same accuracy."""
    scenario, rng = sf.load_scenario(PRESET, agents=AGENTS, steps=STEPS), np.random.default_rng(0)
    exact = sf.predict(scenario, [µ], "optimal", "optimal").values()[0]
    pilot = np.array([run(rng) for _ in range(100)])
    runs = 100 if quick else runs_needed(pilot)
    start = time.perf_counter()
    sample = np.array([run(rng) for _ in range(runs)])
    theirs = time.perf_counter() - start
    off = worst(sample, exact)
    agreed("Monte Carlo on Stone Soup, in standard errors", off, 4.0)

    def sampled() -> np.ndarray:
        return sf.predict(scenario, [µ], "monte-carlo", estimator="optimal", runs=runs, workers=1).values()[0]

    error = sample.std(axis=0, ddof=1) / runs**0.5  # the spread of a run is the same
    own = float((np.abs(sampled() - exact) / error).max())
    agreed("stochfuse's Monte Carlo, in standard errors", own, 4.0)
    mine, best = medians(sampled, lambda: sf.predict(scenario, [µ], "optimal", "optimal").values(), rounds=rounds)
    count, reached = f"{runs:,} runs", f"{100 * (error / exact).max():.2g} % s.e."
    rows = [
        Row(STONE_SOUP, f"a simulator on it, {reached}", count, theirs, theirs / best, f"{off:.1f} s.e."),
        Row(OURS, f"predict, monte-carlo, {reached}", count, mine, mine / best, f"{own:.1f} s.e."),
        Row(OURS, "predict, optimal: exact", "1", best, 1.0, ""),
    ]
    work = f"Monte Carlo, {PRESET}: {AGENTS} agents ad hoc, {STEPS} steps, µ = {µ}; per answer"
    return Section(work, rows)
