"""Monte Carlos of a network, as a user of Stone Soup and as an engineer with NumPy would write them, against the exact answer.

Three agents of thesis-transient measure a random walk.  What an agent holds is a set of measurements; a message brings
everything that its sender holds (handbook: contact chain), and an agent's estimate is a Kalman filter over all it holds, run
again from the first step at which something new arrived.  An initial estimate travels as a measurement of its own
covariance.  Both simulators are the same code around another filter; noises are drawn with NumPy, which takes less time
than Stone Soup's models do.

Two questions are asked of each run: what the filters claim (their covariance), and what is true (their squared error), which
chance spreads much more.  The time of an answer is that of a run, times the runs that the wanted standard error takes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

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
IN_A_ROW = 20
"""Exact answers timed together: one alone is mostly the time in which a processor gets its caches filled."""

SENSOR = LinearGaussian(ndim_state=1, mapping=(0,), noise_covar=np.array([[R]]))
ESTIMATE = LinearGaussian(ndim_state=1, mapping=(0,), noise_covar=np.array([[P0]]))
PREDICTOR = KalmanPredictor(
    LinearGaussianTimeInvariantTransitionModel(transition_matrix=np.eye(1), covariance_matrix=np.array([[Q]]))
)
UPDATER = KalmanUpdater(SENSOR)


class Measurement(NamedTuple):
    """A number, and its noise's variance."""

    z: float
    R: float


class Filter(Protocol):
    """The filter that a simulator is written around."""

    name: str

    def first(self, z: Measurement) -> Any:
        """An agent's own first estimate."""
        ...

    def predict(self, state: Any) -> Any:
        """A step on."""
        ...

    def update(self, state: Any, z: Measurement) -> Any:
        """With one measurement more."""
        ...

    def read(self, state: Any) -> tuple[float, float]:
        """Mean and variance."""
        ...


class OnStoneSoup:
    """Stone Soup's predictor and updater."""

    name = STONE_SOUP

    def first(self, z: Measurement) -> Any:
        return GaussianState([[z.z]], np.array([[z.R]]))

    def predict(self, state: Any) -> Any:
        return PREDICTOR.predict(state)

    def update(self, state: Any, z: Measurement) -> Any:
        measured: Any = Detection([[z.z]], measurement_model=SENSOR if z.R == R else ESTIMATE)
        return UPDATER.update(SingleHypothesis(state, measured))

    def read(self, state: Any) -> tuple[float, float]:
        return float(state.state_vector[0, 0]), float(state.covar[0, 0])


class OnNumPy:
    """The textbook's lines on NumPy's matrices, for any model."""

    name = f"NumPy {np.__version__}"
    F, H, Q = np.eye(1), np.eye(1), np.array([[Q]])

    def first(self, z: Measurement) -> Any:
        return np.array([z.z]), np.array([[z.R]])

    def predict(self, state: Any) -> Any:
        x, P = state
        return self.F @ x, self.F @ P @ self.F.T + self.Q

    def update(self, state: Any, z: Measurement) -> Any:
        (x, P), H = state, self.H
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + z.R)
        return x + K @ (z.z - H @ x), (np.eye(1) - K @ H) @ P

    def read(self, state: Any) -> tuple[float, float]:
        return state[0][0], state[1][0, 0]


Held = list[dict[int, Measurement]]
"""Measurements of step 1, 2, …, by the agent that made them."""


class Agent:
    """An agent: its first estimate, what it holds, and its filter's state after every step."""

    def __init__(self, number: int, first: Measurement, by: Filter) -> None:
        self.number, self.by = number, by
        self.prior = by.first(first)
        self.held: Held = [{number: first}]
        self.states: list[Any] = [self.prior]

    def measure(self, measurement: Measurement) -> None:
        self.held.append({self.number: measurement})

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

    def _filtered(self, step: int) -> Any:
        state = self.by.predict(self.states[step - 1]) if step else self.prior
        for source, measurement in self.held[step].items():
            if step or source != self.number:  # the agent's own first estimate is the prior
                state = self.by.update(state, measurement)
        return state


def run(rng: np.random.Generator, by: Filter) -> np.ndarray:
    """One run: the agents' mean variance and mean squared error after every step's exchange, (2, steps)."""
    truth, out = 0.0, np.empty((2, STEPS))
    agents = [Agent(i, Measurement(rng.normal(truth, P0**0.5), P0), by) for i in range(AGENTS)]
    for step in range(STEPS):
        if step:
            truth = rng.normal(truth, Q**0.5)
            for agent in agents:
                agent.measure(Measurement(rng.normal(truth, R**0.5), R))
        arrived = rng.random((AGENTS, AGENTS)) < µ
        sent = [[dict(of_step) for of_step in agent.held] for agent in agents]
        for i, agent in enumerate(agents):
            agent.take([sent[j] for j in range(AGENTS) if j != i and arrived[i, j]])
        x, P = np.transpose([by.read(agent.states[-1]) for agent in agents])
        out[:, step] = P.mean(), ((x - truth) ** 2).mean()
    return out


def standard_error(sample: np.ndarray) -> np.ndarray:
    return sample.std(axis=0, ddof=1) / len(sample) ** 0.5


def section(quick: bool, rounds: int) -> Section:
    """Agreement of the sampled means with the exact answer, then the time to the same accuracy."""
    scenario = sf.load_scenario(PRESET, agents=AGENTS, steps=STEPS)
    exact = sf.predict(scenario, [µ], "optimal", "optimal").values()[0]  # what is claimed of it is true
    rng = np.random.default_rng(1)
    pilot = np.array([run(rng, OnNumPy()) for _ in range(100 if quick else 4000)])
    needed = np.ceil((pilot.std(axis=0, ddof=1) / exact / ACCURACY).max(axis=-1) ** 2).astype(int)
    questions = ("claimed", "actual")
    (in_a_row, *sampled) = medians(
        lambda: [sf.predict(scenario, [µ], "optimal", "optimal").values() for _ in range(IN_A_ROW)],
        *(
            lambda asked=asked, runs=runs: ours(scenario, asked, int(runs)).values()
            for asked, runs in zip(questions, needed, strict=True)
        ),
        rounds=rounds,
        clock=time.process_time,
    )
    rows, best = [], in_a_row / IN_A_ROW
    for index, (asked, mine) in enumerate(zip(questions, sampled, strict=True)):
        count = f"{needed[index]:,} runs"
        for by, runs in ((OnStoneSoup(), 100 if quick else 1000), (OnNumPy(), 100 if quick else 4000)):
            rng = np.random.default_rng(2 + index)
            start = time.process_time()
            sample = np.array([run(rng, by) for _ in range(runs)])[:, index]
            theirs = (time.process_time() - start) / runs * needed[index]
            off = float((np.abs(sample.mean(axis=0) - exact) / standard_error(sample)).max())
            agreed(f"Monte Carlo on {by.name}, {asked}, in standard errors", off, 4.0)
            rows.append(Row(by.name, f"a simulator on it: {asked}", count, theirs, theirs / best, f"{off:.1f} s.e."))
        found = ours(scenario, asked, int(needed[index]))
        own = float((np.abs(found.values()[0] - exact) / found.standard_error()[0]).max())
        agreed(f"stochfuse's Monte Carlo, {asked}, in standard errors", own, 4.0)
        rows.append(Row(OURS, f"predict, monte-carlo: {asked}", count, mine, mine / best, f"{own:.1f} s.e."))
    rows.append(Row(OURS, "predict, optimal: both, exact", f"{IN_A_ROW} in a row", best, 1.0, ""))
    work = (
        f"Monte Carlo to 1 % standard error, {PRESET}: {AGENTS} agents ad hoc, {STEPS} steps, µ = {µ}; per answer for "
        "all steps"
    )
    return Section(work, rows)


def ours(scenario: sf.Scenario, asked: str, runs: int) -> Any:
    """The same number of runs by stochfuse."""
    return sf.predict(scenario, [µ], "monte-carlo", asked, estimator="optimal", runs=runs, workers=1)
