"""The system: a scenario translated once for all that computes.

Engines and estimators take a `System` and `Items`, and know no scenario.  The system holds what all items have in
common:

    F, Q, Bu of every step, H and R of every step and kind of sensor, as stacks (steps, …)
    starts P(k0), x(k0) and a known initial error
    who may hear whom, and what becomes of a message under way (`Network`)
    which agents are alike

and the items what they may differ in: link probabilities and noises.  One scenario against many link probabilities is
the case of one set of noises, a study that of many; there is no other way through the engines.

An agent without a sensor measures nothing: one component with H = 0.  So no engine has to know of it.  A sensor that
may miss is a chance event of its agent and step (`System.detections`), as a link is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stochfuse.fusion.cooperative import Relation
from stochfuse.scenario.model import Filter, Model, NoiseCorrelation, Sensor, over_steps
from stochfuse.scenario.network import LinkRows, Network

if TYPE_CHECKING:
    from stochfuse.scenario.scenario import Scenario


class Detection(NamedTuple):
    """A draw of a step: whether an agent's sensor measures; or else the agent predicts only."""

    agent: int
    probability: float


class Noises(NamedTuple):
    """Noises of items of their own, which hold at all steps; None where the system's are meant.

    Parameters
    ----------
    Q : (items, d, d) process noise as it enters the state.
    R : (items, p, p) measurement noise of every agent's sensor, positive definite.
    P0 : (items, d, d) covariance of the first estimates.
    """

    Q: np.ndarray | None = None
    R: np.ndarray | None = None
    P0: np.ndarray | None = None

    @property
    def common(self) -> bool:
        """Whether no item has a noise of its own."""
        return all(M is None for M in self)

    def take(self, items: np.ndarray | slice) -> Noises:
        """Return the noises of some of the items."""
        return Noises(*(None if M is None else M[items] for M in self))

    def different(self) -> tuple[np.ndarray, np.ndarray]:
        """First item of every different set of noises, and which of the sets each item has."""
        flat = np.concatenate([M.reshape(len(M), -1) for M in self if M is not None], axis=1)
        _, first, of = np.unique(flat, axis=0, return_index=True, return_inverse=True)
        return first, of.ravel()


@dataclass(frozen=True, eq=False)
class Items:
    """What is evaluated side by side: rows of link probabilities, with noises of their own or the system's.

    Parameters
    ----------
    links : one row per item.
    noises : of as many items, or None in the place of each.
    """

    links: LinkRows
    noises: Noises = Noises()  # noqa: RUF009  an empty tuple is immutable

    def __len__(self) -> int:
        return len(self.links.link)

    def take(self, items: np.ndarray | slice) -> Items:
        """Return some of the items."""
        return Items(self.links.take(items), self.noises.take(items))

    def by_noises(self, system: System) -> Iterator[tuple[np.ndarray, System, Items]]:
        """Items of equal noises together: their places, the system with those noises, and the items without."""
        if self.noises.common:
            yield np.arange(len(self)), system, self
            return
        first, of = self.noises.different()
        order = np.argsort(of, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(of[order])) + 1):
            theirs = Noises(*(None if M is None else M[first[of[members[0]]]] for M in self.noises))
            yield members, system.with_noises(theirs), Items(self.links.take(members))


@dataclass(frozen=True, eq=False)
class System:
    """What all items have in common; see the module.

    Parameters
    ----------
    model : F and Q (steps, d, d), Bu (steps, d, 1).
    sensors : the different sensors among the agents, H (steps, p, d) and R (steps, p, p).
    sensor_of : index into `sensors` for every agent.
    P0, x0 : (d, d) covariance of each agent's initial estimate, and (d, 1) that estimate.
    shared : whether all agents start from one common estimate.
    error : (d, 1) known initial error, or None.
    network : who may hear whom.
    labels : kind of every agent; those of one kind may change places.
    own : whether every agent has a state of its own.
    filters : each agent's own filter, where they differ from the model; else empty.
    noise : how measurement noises hang together, or None if they are independent.
    process : (Σd_i, Σd_i) process noise of all parallel filters together, or None if they have nothing in common.
    relations : what agent i measures of agent j, by (i, j) counted from 0.
    """

    model: Model
    sensors: tuple[Sensor, ...]
    sensor_of: tuple[int, ...]
    P0: np.ndarray
    x0: np.ndarray
    shared: bool
    error: np.ndarray | None
    network: Network
    labels: tuple[int, ...]
    own: bool = False
    filters: tuple[Filter, ...] = ()
    noise: NoiseCorrelation | None = None
    process: np.ndarray | None = None
    relations: Mapping[tuple[int, int], Relation] = field(default_factory=dict)

    @classmethod
    def of(cls, scenario: Scenario) -> System:
        """Translate a scenario."""
        steps, model = scenario.network.steps, scenario.model
        return cls(
            model=replace(model, **{name: over_steps(getattr(model, name), steps) for name in ("F", "Q", "Bu")}),
            sensors=tuple(_seen(sensor, steps) for sensor in scenario.sensors),
            sensor_of=scenario.sensor_of,
            P0=scenario.P0,
            x0=scenario.x0,
            shared=scenario.correlation == "shared",
            error=scenario.error,
            network=scenario.network,
            labels=_labels(scenario),
            own=scenario.own,
            filters=scenario.filters,
            noise=_noise(scenario),
            process=scenario.process,
            relations=scenario.relations,
        )

    @property
    def agents(self) -> int:
        """Number of agents."""
        return self.network.agents

    @property
    def steps(self) -> int:
        """Number of steps."""
        return self.network.steps

    @property
    def dimension(self) -> int:
        """Number d of state components."""
        return self.model.dimension

    @cached_property
    def one_state(self) -> bool:
        """Whether all agents track the state of one model."""
        return not self.own and not self.filters

    @cached_property
    def detects(self) -> np.ndarray | None:
        """Probability that each kind of sensor measures at each step, (steps, kinds); None where all is certain.

        1 where there is nothing to miss: at step 1, without a sensor, and where a sensor pauses.
        """
        if all(sensor.detection is None for sensor in self.sensors):
            return None
        columns = []
        for sensor in self.sensors:
            p = np.array(1.0) if sensor.detection is None else sensor.detection
            now = p[: self.steps] if p.ndim else np.broadcast_to(p, self.steps)
            columns.append(np.where(sensor.H.any(axis=(-2, -1)), now, 1.0))
        found = np.stack(columns, axis=1)
        found[0] = 1.0
        return None if (found == 1.0).all() else found

    def detections(self, step: int) -> list[Detection]:
        """Draws of a step's measurements; none of those that are certain."""
        if self.detects is None or step > self.steps:
            return []
        p = self.detects[step - 1]
        return [Detection(i, float(p[kind])) for i, kind in enumerate(self.sensor_of) if p[kind] < 1.0]

    def with_noises(self, noises: Noises) -> System:
        """Return the system with noises of items in the place of its own: for the numbers only.

        Q is then (steps, items, d, d), R (steps, items, p, p) and P0 (items, d, d); of a single item (one set of
        noises, without an axis of items) as they were.
        """
        Q, R, P0 = noises
        if noises.common:
            return self
        model, sensors = self.model, self.sensors
        return replace(
            self,
            model=model if Q is None else replace(model, Q=_at_all(Q, self.steps)),
            sensors=sensors if R is None else tuple(replace(s, R=_at_all(R, self.steps)) for s in sensors),
            P0=self.P0 if P0 is None else P0,
        )

    def same_structure(self) -> tuple[object, ...]:
        """Return all of it that outcomes, and what agents have in common in each, depend on; equal where that is."""
        network = self.network
        hears = None if network.hears is None else network.hears.tobytes()
        links = (network.agents, network.steps, network.architecture, network.delay, network.delays, hears)
        detects = None if self.detects is None else self.detects.tobytes()
        return (*links, self.labels, self.sensor_of, self.shared, detects)


def _at_all(M: np.ndarray, steps: int) -> np.ndarray:
    return np.broadcast_to(M, (steps, *M.shape))


def _seen(sensor: Sensor, steps: int) -> Sensor:
    """Matrices over the steps; what measures nothing, one component that says nothing."""
    H, R = sensor.H, sensor.R
    if H.shape[-2] == 0:
        H, R = np.zeros((1, H.shape[-1])), np.eye(1)
    return replace(sensor, H=over_steps(H, steps), R=over_steps(R, steps))


def _labels(scenario: Scenario) -> tuple[int, ...]:
    alike = not scenario.own and not scenario.filters
    if scenario.noise is not None:
        c = scenario.noise.correlation
        alike &= len(set(c[~np.eye(len(c), dtype=bool)])) <= 1 and scenario.noise.disturbance is None
    return scenario.sensor_of if alike else tuple(range(scenario.network.agents))


def _noise(scenario: Scenario) -> NoiseCorrelation | None:
    """How noises hang together, those of agents without a sensor independent of all others."""
    noise = scenario.noise
    widths = [scenario.sensors[kind].H.shape[-2] for kind in scenario.sensor_of]
    if noise is None or all(widths):
        return noise
    seeing = np.array(widths) > 0
    correlation = np.where(np.outer(seeing, seeing) | np.eye(len(widths), dtype=bool), noise.correlation, 0.0)
    return NoiseCorrelation(correlation, None if noise.disturbance is None else _spread(noise.disturbance, widths))


def _spread(disturbance: np.ndarray, widths: Sequence[int]) -> np.ndarray:
    """Put a row and a column of zeros where an agent without a sensor measures nothing."""
    there = np.concatenate([np.full(max(width, 1), width > 0) for width in widths])
    out = np.zeros((len(there), len(there)))
    out[np.ix_(there, there)] = disturbance
    return out
