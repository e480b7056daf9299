"""A simulator as one may suppose it to be, and what it would show.

A `Simulator` is a system with links, what its agents do with what arrives, and what it shows of their estimates; each
part may differ from what a scenario says, which is how a mistake is written down (`stochfuse.data.mistakes`).  What
it shows is sampled by the Monte Carlo engine: first what arrives and what is fused then, which knows no number; then
numbers for it.  Simulators that differ in numbers alone share their histories, so that the difference between two of
them is known better than either.

    claimed   metric of P         actual   trace of A + b bᵀ over the metric's states
    bias      a state of b        nees     tr P⁻¹(A + b bᵀ)

are the expectations over the noises in one history of arrivals, with A and b from the noise footprint.  Before the
exchange of step k an agent has the prior F P(k−1) Fᵀ + Q, and after its own measurement the local estimate, thesis
(24)–(27); the step's error goes the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.cells import Cell
from stochfuse.engines.events import ChanceEvent, events
from stochfuse.engines.monte_carlo import Experiment, sample
from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import InformationClaims, Ledger, Sources, evaluate
from stochfuse.estimators.making import make, rule_of, sources
from stochfuse.estimators.protocol import Claims, Exchange, Late
from stochfuse.estimators.world import claimed_only, moments
from stochfuse.kalman.kernel import Information, at_step, corrected, gain
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.general import outcomes
from stochfuse.prediction.method import Settings
from stochfuse.scenario import capabilities
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import MONTE_CARLO, SUMS
from stochfuse.scenario.system import Noises, System

CLAIMED, SQUARED, ERROR, NEES = "claimed", "actual", "bias", "nees"
FUSED, PRIOR, LOCAL = "fused", "prior", "local"
"""What is shown of a step: the estimate after the exchange, before the measurement, or between them."""
BOTH_WAYS, OWN_LOST, ALONE, AS_IT_WAS = "both ways", "own lost", "alone", "as it was"
"""Habits: a pair's messages arrive together; an agent's own estimate may be lost; the filter goes on without what was
fused; older information is added and removed without a time update."""

MOST_AGENTS = 3
"""Agents up to which outcomes are listed."""


class LinkMeans(NamedTuple):
    """The cells of one link probability, which are independent of those of others.

    Parameters
    ----------
    link : text as in the file.
    row : row of the links.
    cells : of every step and group of agents.
    values : (runs, cells) what each run has, averaged over a cell's agents; None where only means are given.
    """

    link: str
    row: int
    cells: tuple[Cell, ...]
    values: np.ndarray | None = None


Shown = Callable[[np.ndarray, Cell, "Simulator"], np.ndarray]
"""What is shown in the place of some numbers of a cell."""


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator as it may be.

    Parameters
    ----------
    system, rows : what is true, and how likely links are.
    estimator : what the agents do with what arrives.
    criterion : of estimators with weights.
    habits : of the exchange, see above.
    told : what the filters take for true, where that is another system; of sums of information.
    stage, shift : what is shown of which step: that of the cell plus `shift`.
    from_start : whether, before there was an exchange, the first estimates are shown; else the first fused ones.
    whose : the agent, from 1, that is shown in the place of each; empty: itself.
    shown : what is made of claimed numbers, in turn.
    metric : what is made of claimed covariances first; None: what the cell says.
    nees : factor by which NEES is shown.
    claimed_only : whether stage and shift concern what is claimed alone, and errors are shown as they should be.
    followed : whether errors are looked at.
    """

    system: System
    rows: LinkRows
    estimator: str
    criterion: str = "det"
    habits: frozenset[str] = frozenset()
    told: System | None = None
    stage: str = FUSED
    shift: int = 0
    from_start: bool = True
    whose: tuple[int, ...] = ()
    shown: tuple[Shown, ...] = ()
    metric: Metric | None = None
    nees: float = 1.0
    claimed_only: bool = False
    followed: bool = False

    def structure(self) -> Hashable:
        """Return all that the histories depend on, equal where they are."""
        bursts = None if self.rows.bursts is None else tuple(b if b is None else b.tobytes() for b in self.rows.bursts)
        links = (self.rows.link.shape, self.rows.link.tobytes(), bursts)
        return (*self.system.same_structure(), links, self.estimator, self.criterion, self.habits)


class _EstimateNumbers(NamedTuple):
    numbers: np.ndarray


class _Unseen:
    """Claims that are no more than the numbers of the values claimed."""

    width = 1

    def estimate(self, terms: Sequence[tuple[int, np.ndarray]], step: int) -> tuple[Any, Any]:
        """Return the values themselves."""
        ((_, values),) = terms
        return values, None


class _Habitual:
    """An estimator with habits."""

    def __init__(self, estimator: Any, habits: frozenset[str], agents: int) -> None:
        self.estimator, self.habits, self.agents = estimator, habits, agents
        self.additive, self.joint = False, estimator.joint
        self.relabellings = [tuple(range(agents))]

    def start(self) -> Any:
        """State before the first exchange."""
        return self.estimator.start()

    def exchange(self, state: Any) -> _HabitualExchange:
        """Open the exchange of the state's step."""
        return _HabitualExchange(self.estimator.exchange(state), self.habits, self.agents)


class _HabitualExchange:
    """One exchange: what was heard is changed on its way to the estimator's own."""

    def __init__(self, exchange: Exchange, habits: frozenset[str], agents: int) -> None:
        self.inner, self.habits, self.agents = exchange, habits, agents

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value that an agent claims."""
        return self.inner.fused(agent, self._heard(heard))

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[Hashable, tuple[int, ...]]:
        """State before the next exchange."""
        return self.inner.after(*self._kept(heard, late), missed)

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> _HabitualExchange:
        """Open the next exchange as it comes."""
        return _HabitualExchange(self.inner.onward(*self._kept(heard, late), missed), self.habits, self.agents)

    def _kept(self, heard: Sequence[int], late: Sequence[Late]) -> tuple[list[int], list[Late]]:
        if ALONE in self.habits:
            return [1 << i for i in range(self.agents)], []
        if BOTH_WAYS in self.habits:
            late = [*late, *(Late(m.sender, m.delay, m.receiver) for m in late)]
        return self._heard(heard), list(late)

    def _heard(self, heard: Sequence[int]) -> list[int]:
        n, found = self.agents, list(heard)
        if BOTH_WAYS in self.habits:
            for i in range(n):
                for j in range(n):
                    found[j] |= (heard[i] >> j & 1) << i
        if OWN_LOST in self.habits:
            # the bits above the agents' say whose own estimate arrived; where nothing did, it is kept
            others = [h & ((1 << n) - 1) & ~(1 << i) for i, h in enumerate(found)]
            found = [o | 1 << i if h >> n or not o else o for i, (o, h) in enumerate(zip(others, found, strict=True))]
        return found


class _AsItWas(Ledger):
    """A ledger that knows no time update between the terms of a sum."""

    def forward(self, value: int, step: int) -> int:
        """Return the value as it was."""
        return value


@dataclass(frozen=True, eq=False)
class _RunArrivals:
    """What arrived in every run: which value each agent then has, and the estimator that wrote the values down."""

    claims: Callable[[System, System | None], Claims]
    which: np.ndarray  # (rows, runs, steps, agents)

    @cached_property
    def steps(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Different values of every step, and which of them each row, run and agent has."""
        found = []
        for k in range(self.which.shape[2]):
            values, index = np.unique(self.which[:, :, k], return_inverse=True)
            found.append((values, index.reshape(self.which[:, :, k].shape)))
        return found


@dataclass(eq=False)
class Sampler:
    """Samples what simulators show; histories are drawn once for all that share them.

    Parameters
    ----------
    runs, seed : size of the sample for each row of links.
    errors : whether the errors of the estimates are followed.
    """

    runs: int
    seed: int = 1
    errors: bool = False
    _known: dict[Hashable, _RunArrivals] = field(default_factory=dict)

    def shown(self, simulator: Simulator, blocks: Sequence[LinkMeans]) -> list[np.ndarray]:
        """Return what a simulator shows in every run, (runs, cells), for each block; not-a-number where nobody knows.

        Raises
        ------
        UsageError, NoAnswerError
            If there is no such simulator: the estimator does not take the system, or some outcome has no covariance.
        """
        claims = {cell.metric for block in blocks for cell in block.cells if cell.quantity == CLAIMED}
        if simulator.metric is not None and claims <= {simulator.metric.name}:
            raise UsageError(f"metric: expected another than {simulator.metric.name}, which is what is shown")
        histories = self._histories(simulator)
        look = _SampledReading(simulator, histories, self.errors)
        return [np.stack([look.at(cell, block.row) for cell in block.cells], axis=1) for block in blocks]

    def _histories(self, simulator: Simulator) -> _RunArrivals:
        key = simulator.structure()
        if key not in self._known:
            self._known[key] = self._drawn(simulator)
        return self._known[key]

    def _drawn(self, simulator: Simulator) -> _RunArrivals:
        system, rows, habits = simulator.system, simulator.rows, simulator.habits
        capabilities.require(system, rows, simulator.estimator, MONTE_CARLO)
        estimator, claims = _made(simulator, self.errors)
        if habits - {AS_IT_WAS}:
            estimator = _Habitual(estimator, habits, system.agents)
        experiment = Experiment(
            agents=system.agents,
            events=[_events(system, rows, step, habits) for step in range(1, system.steps + 1)],
            detections=[system.detections(step) for step in range(1, system.steps + 1)],
            make=lambda: (estimator, _Unseen),  # pyright: ignore[reportArgumentType]  they number what they claim
            of=_EstimateNumbers,  # pyright: ignore[reportArgumentType]  the values claimed, no estimates of them
            runs=self.runs,
            seed=self.seed,
        )
        drawn = sample(experiment, len(rows.link))
        return _RunArrivals(claims, drawn.values.numbers[drawn.which])


def _made(simulator: Simulator, errors: bool) -> tuple[Any, Callable[[System, System | None], Claims]]:
    """An estimator, and what makes numbers of all that it has written down."""
    system, name = simulator.system, simulator.estimator
    if name not in SUMS:
        made = make(system, name, errors=errors, criterion=simulator.criterion)
        return made.estimator, lambda true, told: made.claims(true if told is None or errors else told, Noises())
    ledger = (_AsItWas if AS_IT_WAS in simulator.habits else Ledger)(system.sensor_of if errors else None)
    labels = tuple(range(system.agents)) if errors else system.sensor_of
    estimator = rule_of(name)(ledger, labels, shared=system.shared)
    return estimator, lambda true, told: InformationClaims(evaluate(ledger, _believed(true, told, errors)))


def _believed(true: System, told: System | None, errors: bool) -> Sources:
    """What sources are worth to filters that are told of another system than the true one."""
    if told is None or not errors:
        return sources(true if told is None else told, Noises(), errors)
    real, believed = sources(true, Noises(), True), sources(told, Noises(), True)
    starts = [
        Information(b.Y @ np.linalg.solve(r.Y, r.y), b.Y) for r, b in zip(real.starts, believed.starts, strict=True)
    ]
    return Sources(replace(believed.model, Bu=real.model.Bu), believed.sensors, starts, real.records)


def _events(system: System, rows: LinkRows, step: int, habits: frozenset[str]) -> list[ChanceEvent]:
    network, n = system.network, system.agents
    found = events(network, rows, step)
    if BOTH_WAYS in habits:
        found = [event for event in found if event.receivers[0] < event.sender]
    if OWN_LOST in habits and n > 1:
        µ = rows.matrices(network, step).mean(axis=2)
        found += [ChanceEvent(n + i, (i,), µ[:, i]) for i in range(n)]
    return found


class _Place(NamedTuple):
    """Where a cell's numbers come from: the fused estimates of a step, brought to a stage of the next or as they are.

    A step of 0 means the first estimates.
    """

    step: int
    stage: str


class _Reading:
    """What a simulator shows of moments."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator

    def place(self, cell: Cell) -> _Place:
        """Where the numbers of a cell come from."""
        s = self.simulator
        plain = s.claimed_only and cell.quantity != CLAIMED
        step, stage = cell.step + (0 if plain else s.shift), FUSED if plain else s.stage
        if step < 1 or (step == 1 and stage != FUSED):
            return _Place(0 if s.from_start else 1, FUSED)
        return _Place(step if stage == FUSED else step - 1, stage)

    def agent(self, agent: int) -> int:
        """Whom, from 0, an agent's numbers show."""
        return self.simulator.whose[agent] - 1 if self.simulator.whose else agent

    def numbers(self, cell: Cell, place: _Place, agent: int, m: Moments) -> np.ndarray:
        """Numbers of a cell from an agent's moments at a place."""
        seen = m if place.stage == FUSED else self._before(m, place.step + 1, agent, place.stage)
        numbers = self._number(cell, seen)
        for make_of in self.simulator.shown if cell.quantity == CLAIMED else ():
            numbers = make_of(numbers, cell, self.simulator)
        return numbers

    def _before(self, m: Moments, step: int, agent: int, stage: str) -> Moments:
        """Moments before the exchange of a step, of fused estimates of the step before."""
        s = self.simulator
        true, told = s.system, s.told or s.system
        F, Q = at_step(told.model.F, step), at_step(told.model.Q, step)
        G, W = at_step(true.model.F, step), at_step(true.model.Q, step)
        P = F @ m.P @ F.T + Q
        A = None if m.actual is None else G @ m.actual @ G.T + W
        b = None if m.bias is None else G @ m.bias
        if stage == LOCAL:
            sensor, real = (each.sensors[each.sensor_of[agent]].at(step) for each in (told, true))
            K = gain(P, sensor.H, sensor.R)
            P = corrected(P, K, sensor.H, sensor.R)
            A = None if A is None else corrected(A, K, real.H, real.R)
            b = None if b is None else b - K @ (real.H @ b)
        return Moments(P) if A is None or b is None else Moments.of(P, A, b)

    def _number(self, cell: Cell, m: Moments) -> np.ndarray:
        if cell.quantity == NEES:
            return np.trace(np.linalg.solve(m.P, m.square), axis1=-2, axis2=-1) * self.simulator.nees
        sense = metric_of(cell.metric, self.simulator.system.model)
        if cell.quantity == CLAIMED:
            return (self.simulator.metric or sense).of(m.P)
        states = list(sense.states)
        if cell.quantity == SQUARED:
            return np.trace(np.asarray(m.square)[..., states, :][..., states], axis1=-2, axis2=-1)
        return np.asarray(m.bias)[..., states[0], 0]


class _SampledReading:
    """What can be seen of the estimates of a simulator, worked out once for every different estimate."""

    def __init__(self, simulator: Simulator, histories: _RunArrivals, errors: bool) -> None:
        self.simulator, self.histories, self.reading = simulator, histories, _Reading(simulator)
        self.of = moments if errors else claimed_only
        self.claims = histories.claims(simulator.system, simulator.told)
        self._fused: dict[int, Moments] = {}
        self._seen: dict[Hashable, np.ndarray] = {}

    def at(self, cell: Cell, row: int) -> np.ndarray:
        """What every run of a row shows in a cell, (runs,)."""
        return np.mean([self._one(cell, row, self.reading.agent(a - 1)) for a in cell.agents], axis=0)

    def _one(self, cell: Cell, row: int, agent: int) -> np.ndarray:
        s, runs = self.simulator, self.histories.which.shape[1]
        if AS_IT_WAS in s.habits and cell.quantity != CLAIMED:
            # what was not brought forward is wrong by the true state's own motion, which no footprint knows
            return np.full(runs, np.nan)
        place = self.reading.place(cell)
        if place.step == 0:
            start = self.reading.numbers(cell, place, agent, _start(s, self.of is moments))
            return np.full(runs, float(start))
        kind = s.system.sensor_of[agent] if place.stage == LOCAL else -1
        key = (place, kind, cell.quantity, cell.metric, cell.step, cell.runs, cell.agents)
        if key not in self._seen:
            self._seen[key] = self.reading.numbers(cell, place, agent, self._at(place.step))
        return self._seen[key][self.histories.steps[place.step - 1][1][row, :, agent]]

    def _at(self, step: int) -> Moments:
        """Moments of every different fused estimate of a step."""
        if step not in self._fused:
            values = self.histories.steps[step - 1][0]
            self._fused[step] = self.of(self.claims.estimate([(1, values)], step)[0])
        return self._fused[step]


def exactly(simulator: Simulator, blocks: Sequence[LinkMeans]) -> list[np.ndarray] | None:
    """Return what a simulator shows on average, (cells,) for each block, over all outcomes; None if they are too many.

    Of what is claimed, by simulators without habits.

    Raises
    ------
    UsageError, NoAnswerError
        If there is no such simulator.
    """
    s, network = simulator, simulator.system.network
    claimed = all(cell.quantity == CLAIMED for block in blocks for cell in block.cells)
    hard = network.agents > MOST_AGENTS or (network.agents == MOST_AGENTS and (len(network.delay) > 1 or s.rows.bursts))
    if s.habits or s.told is not None or hard or not claimed or s.system.detects is not None:
        return None
    reading = _Reading(s)
    found = outcomes(s.system, s.rows, Settings(estimator=s.estimator, criterion=s.criterion))
    seen: dict[Hashable, np.ndarray] = {}

    def one(cell: Cell, agent: int) -> np.ndarray:
        place = reading.place(cell)
        if place.step == 0:
            start = reading.numbers(cell, place, agent, _start(s, False))
            return np.full(len(s.rows.link), float(start))
        group = next(g for g, members in enumerate(found.groups) if agent in members)
        key = (place, group, cell.metric, cell.step, cell.runs, cell.agents)
        if key not in seen:
            sense = metric_of(cell.metric, s.system.model)
            shown = replace(sense, of=lambda P: reading.numbers(cell, place, agent, Moments(P)))
            seen[key] = found.distribution(shown, place.step, [group]).mean()
        return seen[key]

    return [
        np.array([np.mean([one(cell, reading.agent(a - 1))[block.row] for a in cell.agents]) for cell in block.cells])
        for block in blocks
    ]


def _start(s: Simulator, errors: bool) -> Moments:
    """Moments of a first estimate, before anything was exchanged."""
    system, P = s.system, (s.told or s.system).P0
    if not errors:
        return Moments(P)
    b = np.zeros((system.dimension, 1)) if system.error is None else system.error
    return Moments.of(P, system.P0, b)
