"""The numbers behind the thesis' figures, each calculated once: claimed covariances, errors, message loads.

Every estimate here is linear in independent noises.  In one outcome of "which messages arrive" its error is x·s, where
s holds the noises in units of their own deviations (and a last entry 1 for the known initial error) and x is the
estimate's noise footprint (`stochfuse.estimators.world`).  Averaged over the outcomes,

    E[error]  = E[x]·s          E[error²] = sᵀ E[x xᵀ] s

for one record s of truth and measurements, which is what the thesis averages (it keeps one record for all its runs),
and with E over s as well, the average over noise.  E[x] and E[x xᵀ] are exact: every outcome is gone through.

A record has, in this order, the agents' initial errors, then for every step 2 … K the process noise and the agents'
measurement noises.  Whose data the agents have, the thesis leaves unsaid:

    "own"      every agent draws its own initial estimate and its own measurements
    "start"    one initial estimate for all agents (fused as if each had its own)
    "all"      one initial estimate and one measurement of each step for all agents

The simplified formulation (53) has one estimate instead of outcomes; its footprint is read off `predict_states` by
giving it unit data, each agent with data of its own.  Its initial estimates are taken as independent, as in (54): of
those at step 1 an agent weighs its own with E[1/(m+1)] and each other one with an equal share of the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.events import bernstein, relabellings
from stochfuse.prediction.general import Outcomes, outcomes
from stochfuse.prediction.method import Settings
from stochfuse.prediction.predict import predict
from stochfuse.prediction.states import predict_states
from stochfuse.questions.messages import MessageLoad, message_load
from stochfuse.scenario.registry import LFG, MONTE_CARLO, SIMPLIFIED
from stochfuse.scenario.scenario import Scenario, link_rows, load_scenario

LINKS = (0.0, 0.25, 0.5, 0.75, 1.0)
ARCHITECTURES = ("ad-hoc", "broadcast", "cyclic")
LIKE_NETWORKS = ARCHITECTURES[:2]
"""Networks that show nearly the same."""
TRUTH = 1000.0
"""True state at step 1, the mean of the thesis' x(0)."""
STATED_WINDOW, WINDOW = (6, 10), (6, 12)
"""Steps over which message loads are averaged: as the thesis says, and as the maxima of its table 3 need."""
TABLE_3 = {
    "ad-hoc": np.array([(0.0, 0, 0.0), (1.820, 22, 2.843), (1.992, 16, 1.974), (1.988, 8, 1.146), (2.0, 2, 0.0)]),
    "broadcast": np.array([(0.0, 0, 0.0), (1.823, 24, 2.896), (1.991, 18, 1.970), (1.982, 9, 1.154), (2.0, 2, 0.0)]),
    "cyclic": np.array([(0.0, 0, 0.0), (1.491, 23, 3.432), (1.858, 21, 2.766), (1.943, 11, 1.694), (2.0, 2, 0.0)]),
}
"""Mean, maximum and standard deviation at µ = 0, 0.25, 0.5, 0.75, 1: thesis table 3, 3 agents, 1000 runs."""


def _shared(scenario: Scenario, data: str) -> np.ndarray:
    """Index of the noise that each entry of s is."""
    n, steps = scenario.network.agents, scenario.network.steps
    index = np.arange(n + (steps - 1) * (n + 1) + 1)
    if data != "own":
        index[:n] = 0
    if data == "all":
        for first in range(n + 1, len(index) - 1, n + 1):
            index[first : first + n] = first
    return index


def spread(scenario: Scenario, data: str = "own", *, initial_error: bool = True) -> np.ndarray:
    """E[s sᵀ] over the noise, (noises, noises), with the known initial error or without."""
    index = _shared(scenario, data)
    out = (index[:, None] == index[None, :]).astype(float)
    out[-1, -1] = float(initial_error)
    return out


def draw(scenario: Scenario, number: int, seed: int, data: str = "own") -> np.ndarray:
    """Return some records s, (records, noises); the first ones are the same whatever their number."""
    index = _shared(scenario, data)
    made = [np.random.default_rng([seed, i]).standard_normal(len(index)) for i in range(number)]
    out = np.stack(made)[:, index]
    out[:, -1] = 1.0
    return out


def truth(scenario: Scenario, records: np.ndarray) -> np.ndarray:
    """True state of some records, (records, steps)."""
    n, steps = scenario.network.agents, scenario.network.steps
    moves = records[:, n : -1 : n + 1] * np.sqrt(scenario.model.Q.item())
    return TRUTH + np.concatenate([np.zeros((len(records), 1)), np.cumsum(moves, axis=1)], axis=1)[:, :steps]


@dataclass(frozen=True)
class ThesisCase:
    """A scenario of the thesis: a preset, with another process noise where a figure asks for it.

    Parameters
    ----------
    name : "transient" or "steady".
    q : variance of the process noise; default: that of the preset.
    """

    name: str
    q: float | None = None


TRANSIENT, STEADY = ThesisCase("transient"), ThesisCase("steady")


class Averages(NamedTuple):
    """What is averaged over the outcomes at a step, as coefficients A_c of Σ A_c µ^c (1−µ)^(L−c).

    Parameters
    ----------
    P : (L + 1,) claimed covariance.
    first : (L + 1, noises) E[x]; no noises where errors are not wanted.
    second : (L + 1, noises, noises) E[x xᵀ].
    extremes : smallest and largest claimed covariance of any outcome.
    """

    P: np.ndarray
    first: np.ndarray
    second: np.ndarray
    extremes: tuple[float, float]

    def symmetric(self, turns: Sequence[np.ndarray]) -> Averages:
        """Return the same averaged over the orders of the noises that relabellings of the agents make.

        Outcomes that differ by a relabelling are gone through once, whoever is called what; for one record, where the
        agents' noises are different numbers, each of them counts.
        """
        if not self.first.shape[1]:
            return self
        first = np.mean([self.first[:, turn] for turn in turns], axis=0)
        second = np.mean([self.second[:, turn[:, None], turn] for turn in turns], axis=0)
        return self._replace(first=first, second=second)


class Weights(NamedTuple):
    """Moments of the noise footprint over the outcomes, averaged over the agents.

    Parameters
    ----------
    first : (links, steps, noises) E[x].
    second : (links, steps, noises, noises) E[x xᵀ].
    """

    first: np.ndarray
    second: np.ndarray

    def rms(self, spread: np.ndarray) -> np.ndarray:
        """RMS error averaged over the noise, (links, steps), with E[s sᵀ] = spread of shape (noises, noises)."""
        return np.sqrt((self.second * spread).sum(axis=(-2, -1)))

    def rms_given(self, records: np.ndarray) -> np.ndarray:
        """RMS error over the outcomes for records s of shape (records, noises), (records, links, steps)."""
        square = np.einsum("ri,lkij,rj->rlk", records, self.second, records, optimize=True)
        return np.sqrt(np.maximum(square, 0.0))

    def mean_given(self, records: np.ndarray) -> np.ndarray:
        """Mean error over the outcomes for records s, (records, links, steps)."""
        return np.einsum("ri,lki->rlk", records, self.first)


@dataclass(frozen=True, eq=False)
class Bench:
    """What the figures are made from; remembers what it has calculated.

    Parameters
    ----------
    steps : number of time steps, 5 in the thesis.
    seed : of the records of truth and measurements.
    """

    steps: int = 5
    seed: int = 1
    known: dict[Any, Any] = field(default_factory=dict, repr=False)

    def once(self, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return what was made for a key, made now if it was not."""
        if key not in self.known:
            self.known[key] = make()
        return self.known[key]

    def scenario(self, case: ThesisCase, architecture: str) -> Scenario:
        """Return a scenario of the thesis."""
        return load_scenario(f"thesis-{case.name}", architecture=architecture, steps=self.steps, q=case.q)

    def averages(self, case: ThesisCase, architecture: str, rule: str = LFG, *, errors: bool = True) -> list[Averages]:
        """What is averaged over the outcomes, per step; perhaps without footprints, where errors are not wanted."""

        def make() -> list[Averages]:
            scenario = self.scenario(case, architecture)
            found = outcomes(scenario.system, link_rows(scenario, LINKS), Settings(estimator=rule), errors=errors)
            turns = [
                noise_order(p, self.steps) for p in relabellings(scenario.network, found.links, scenario.sensor_of)
            ]
            return [_averages(found, step).symmetric(turns) for step in range(1, self.steps + 1)]

        key = ("averages", case, architecture, rule)
        return self.known.get((*key, True)) or self.once((*key, errors), make)

    def claimed(
        self, case: ThesisCase, architecture: str, links: Sequence[float] = LINKS, rule: str = LFG
    ) -> np.ndarray:
        """Expected claimed covariance, (links, steps): exact, or approximate by (54) for the simplified rule."""
        if rule == SIMPLIFIED:
            return predict(self.scenario(case, architecture), list(links), method=SIMPLIFIED).values()
        found = self.averages(case, architecture, rule, errors=False)
        return np.stack([_at(step.P, links) for step in found], axis=1)

    def weights(self, case: ThesisCase, architecture: str, links: Sequence[float] = LINKS, rule: str = LFG) -> Weights:
        """Moments of the footprint at some link probabilities."""

        def make() -> Weights:
            if rule == SIMPLIFIED:
                x = _simplified_footprint(self.scenario(case, architecture), links)
                return Weights(x.mean(axis=2), np.einsum("lkai,lkaj->lkij", x, x) / x.shape[2])
            found = self.averages(case, architecture, rule)
            first = np.stack([_at(step.first, links) for step in found], axis=1)
            return Weights(first, np.stack([_at(step.second, links) for step in found], axis=1))

        return self.once(("weights", case, architecture, tuple(links), rule), make)

    def sample(self, case: ThesisCase, architecture: str, links: Sequence[float], runs: int) -> np.ndarray:
        """Covariance that agent 1 claims in some sampled runs, (links, runs, steps)."""
        scenario = self.scenario(case, architecture)
        found = predict(scenario, list(links), method=MONTE_CARLO, runs=runs, seed=self.seed).sampled
        if found is None:
            raise TypeError("a sample was asked for")
        return found.sample.values.P[found.sample.which[..., 0]][..., 0, 0]

    def messages(self, architecture: str, rule: str = LFG) -> MessageLoad:
        """Message load at steps 1 to 12, at the thesis' link probabilities."""
        scenario = load_scenario("thesis-transient", architecture=architecture, steps=WINDOW[1])
        return self.once(("messages", architecture, rule), lambda: message_load(scenario, list(LINKS), rule))

    def table_3(self, architecture: str, window: tuple[int, int]) -> np.ndarray:
        """Exact mean, largest possible value and standard deviation of the message size, laid out as `TABLE_3`."""
        load = self.messages(architecture).between(*window)
        return np.stack([load.mean(), load.maximum(), load.std()], axis=1)


class Sweep(NamedTuple):
    """A network of a scenario and what its agents do, over link probabilities: what can be asked about it.

    Parameters
    ----------
    bench : has the numbers.
    case, architecture, rule : scenario, network, and fusion rule or "simplified".
    links : link probabilities.
    """

    bench: Bench
    case: ThesisCase
    architecture: str = "ad-hoc"
    rule: str = LFG
    links: Sequence[float] = LINKS

    def by(self, rule: str) -> Sweep:
        """Return the same with another rule."""
        return self._replace(rule=rule)

    @property
    def network(self) -> str:
        """The network's name in words."""
        return self.architecture.replace("-", " ")

    @property
    def scenario(self) -> Scenario:
        """The scenario, with this network."""
        return self.bench.scenario(self.case, self.architecture)

    @property
    def claimed(self) -> np.ndarray:
        """Expected claimed covariance, (links, steps)."""
        return self.bench.claimed(self.case, self.architecture, self.links, self.rule)

    @property
    def weights(self) -> Weights:
        """Moments of the noise footprint."""
        return self.bench.weights(self.case, self.architecture, self.links, self.rule)

    @property
    def bias(self) -> np.ndarray:
        """Mean error, averaged over links and noise, (links, steps)."""
        return self.weights.first[..., -1]

    def rms(self, data: str = "own", *, initial_error: bool = True) -> np.ndarray:
        """RMS error, averaged over links and noise, (links, steps)."""
        return self.weights.rms(spread(self.scenario, data, initial_error=initial_error))

    def averaged(self, data: str = "own", *, initial_error: bool = True) -> np.ndarray:
        """The same averaged over time, (links,)."""
        return time_average(self.rms(data, initial_error=initial_error))

    def records(self, number: int, data: str = "own") -> np.ndarray:
        """Return the first records of truth and measurements, (records, noises)."""
        return draw(self.scenario, number, self.bench.seed, data)

    def rms_given(self, number: int, data: str = "own") -> np.ndarray:
        """RMS error for the first records, averaged over links alone as the thesis does, (records, links, steps)."""
        return self.weights.rms_given(self.records(number, data))

    def size(self, window: tuple[int, int] = WINDOW) -> np.ndarray:
        """Mean message size in nodes at the thesis' link probabilities, (links,)."""
        return self.bench.messages(self.architecture, self.rule).between(*window).mean()


def time_average(rms: np.ndarray) -> np.ndarray:
    """RMS errors averaged over the steps but the first, as the thesis averages them; (..., steps) to (...)."""
    return rms[..., 1:].mean(axis=-1)


def _averages(found: Outcomes, step: int) -> Averages:
    """Average a step over the outcomes, of which all agents are alike."""
    least, most, total = np.inf, 0.0, [0.0, 0.0, 0.0]
    for weights, estimate, _ in found.found.shared_out(step, found.values):
        P, weight = estimate.P[..., 0], weights[0]
        least, most = min(least, P.min()), max(most, P.max())
        x = np.zeros((len(P), 0)) if estimate.x is None else estimate.x[:, 0]
        parts = [weight @ P, weight @ x, np.stack([(w[:, None] * x).T @ x for w in weight])]
        total = [before + part for before, part in zip(total, parts, strict=True)]
    P, first, products = (np.asarray(part) for part in total)
    return Averages(P[:, 0], first, products, (float(least), float(most)))


def noise_order(agents: Sequence[int], steps: int) -> np.ndarray:
    """Places of the noises when agents change places: place p is taken by agents[p]."""
    n = len(agents)
    order = np.arange(n + (steps - 1) * (n + 1) + 1)
    for first in (0, *range(n + 1, len(order) - 1, n + 1)):
        order[first : first + n] = first + np.asarray(agents)
    return order


def _at(coefficients: np.ndarray, links: Sequence[float]) -> np.ndarray:
    """Value of Σ A_c µ^c (1−µ)^(L−c) at some link probabilities, (links, …)."""
    return bernstein(coefficients, len(coefficients) - 1, np.asarray(links, dtype=float))


def _simplified_footprint(scenario: Scenario, links: Sequence[float]) -> np.ndarray:
    """Footprint of (53), (links, steps, agents, noises), columns as a record has them."""
    n, steps = scenario.network.agents, scenario.network.steps
    zeros = np.zeros((steps, n, 1))
    one, none = replace(scenario, x0=np.ones((1, 1))), replace(scenario, x0=np.zeros((1, 1)))
    links = list(links)
    start = predict_states(one, zeros, links).x[..., 0]
    P1 = predict(scenario, links, method=SIMPLIFIED).values()[:, 0]
    own = P1 / scenario.P0.item()
    noises = n + (steps - 1) * (n + 1) + 1
    x = np.zeros((len(links), steps, n, noises))
    deviation = np.sqrt([scenario.P0.item(), scenario.model.Q.item(), scenario.sensors[0].R.item()])
    for i in range(n):
        for j in range(n):
            share = own if i == j else (1.0 - own) / (n - 1)
            x[:, :, i, j] = deviation[0] * start[:, :, i] * share[:, None]
    before = start.copy()  # weight of everything that knew the truth before a step
    for t in range(1, steps):
        place = n + (t - 1) * (n + 1)
        x[:, t:, :, place] = -deviation[1] * before[:, t:]
        for j in range(n):
            unit = zeros.copy()
            unit[t, j] = 1.0
            weight = predict_states(none, unit, links).x[..., 0]
            x[..., place + 1 + j] = deviation[2] * weight
            before = before + weight
    x[..., -1] = start * (0.0 if scenario.error is None else scenario.error.item())
    return x
