"""A live agent: the estimators of this package in a vehicle, that sends and hears bytes.

    agent = sf.Agent(scenario, 2)        # at step 1
    agent.step(z)                        # the next step: predict what was fused, update with z unless it is None
    m = agent.message()                  # bytes
    other.receive(m)                     # True if it told something new
    x, P = other.fuse()                  # what it knows now; the next step goes on from here

A message says what its agent had before the exchange of the step, whatever it has heard since, as in replay
(`stochfuse.engines.replay`): in every history of messages in any order, twice, late or never, agents claim what replay
claims for that record of arrivals.  Messages of agents whose clocks are ahead wait until it is time.  What is carried,
and for how long anything is kept: `stochfuse.data.messages.MessageProtocol`, `stochfuse.data.knowledge`.

An agent that is started again from what it saved goes on under another name, so that nobody takes its estimates for
those that it made before and no longer knows of; what it had measured in between must not be given to it again.
"""

from __future__ import annotations

import json
import secrets
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.knowledge import AgentSetting, Knowledge, Latest, knowledge_of
from stochfuse.data.messages import Kind, Life, MessageProtocol, Node, decode, encode
from stochfuse.errors import MessageError, UsageError
from stochfuse.estimators.making import make_for_data
from stochfuse.estimators.readings import Readings
from stochfuse.estimators.recursion import RecursiveEstimator
from stochfuse.estimators.world import Riding, World, world_of
from stochfuse.kalman.checks import covariance_fault
from stochfuse.kalman.kernel import Estimate, Information, at_step
from stochfuse.prediction.predict import choose
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.network import default_rows, reachable
from stochfuse.scenario.own_rules import estimator_named
from stochfuse.scenario.scenario import Scenario, ScenarioLike, load_scenario

SAVED = b"SFA1"


class Start(NamedTuple):
    """How an agent begins.

    Parameters
    ----------
    step : of its first estimate.
    x, P : (d,) and (d, d) first estimate; default: the scenario's, x from initial.x or where its nominal path begins.
    """

    step: int = 1
    x: Any = None
    P: Any = None


class _Facts(NamedTuple):
    """What is saved of an agent besides nodes; what it has seen, where it does not hand them on."""

    agent: int
    estimator: str
    criterion: str
    protocol: Mapping[str, Any]
    now: int
    begun: int
    waived: list[list[int]]
    seen: list[list[Any]] | None = None


class Agent:
    """One agent of a scenario, live.

    Parameters
    ----------
    scenario : a preset, a path, a mapping or a `Scenario`; its links do not matter.
    agent : number from 1, or name.
    estimator : default: the scenario's, else "local-fusion-graph".  One whose fusion needs more than estimates that
        were heard (a centre, measurements of each other) is refused.
    protocol : "acknowledged" (default), "full", "own", "window:W", or a `MessageProtocol`, which has a horizon too.
    start : of an agent that joins later, a `Start`; its first estimate is taken for independent of all others.
    criterion : what the weights of an intersection minimise: "det", "trace" or "max-eig".

    Raises
    ------
    UsageError
        If the scenario has no such agent, or its estimator cannot be one live.

    Examples
    --------
    >>> import stochfuse as sf
    >>> one, two = (sf.Agent("thesis-steady", i) for i in (1, 2))
    >>> two.receive(one.message())
    True
    >>> x, P = two.fuse()
    >>> P.round(3)
    array([[37.5]])
    """

    def __init__(
        self,
        scenario: ScenarioLike,
        agent: int | str,
        estimator: Any = None,
        *,
        protocol: str | MessageProtocol = "acknowledged",
        start: Start | None = None,
        criterion: str = "det",
    ) -> None:
        given = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        name = estimator_named(estimator or given.estimator or registry.LFG)
        choose("criterion", criterion, registry.CRITERIA)
        self.scenario, self.estimator, self.criterion = given, name, criterion
        number, start = _number(given, agent), Start() if start is None else start
        world = _begun(given, number, start)
        live = Live(given, number, start)
        self._set(MessageProtocol.of(protocol), world, live, number, start)
        self._live: Live | None = live

    @classmethod
    def riding(
        cls, scenario: Scenario, agent: int, estimator: str, protocol: MessageProtocol, world: World, riding: Riding
    ) -> Agent:
        """Return an agent (numbered from 0) that carries something else along in the place of measurements.

        Parameters
        ----------
        world : the scenario's, so that agents share it.
        riding : noise footprints, for instance, see `stochfuse.estimators.world`.
        """
        out = cls.__new__(cls)
        out.scenario, out.estimator, out.criterion = scenario, estimator, "det"
        out._set(protocol, world, riding, agent, Start())
        out._live = None
        return out

    def _set(self, protocol: MessageProtocol, world: World, riding: Riding, agent: int, start: Start) -> None:
        system, name = self.scenario.system, self.estimator
        entry = registry.estimator(name)
        capabilities.require(system, default_rows(system.network), name, registry.GENERAL)
        why = capabilities.not_live(name, system)
        if why is not None:
            raise UsageError(why)
        made = None if entry.sums else make_for_data(system, name, self.criterion)
        if isinstance(made, RecursiveEstimator):
            made.world = world
        sizes, n = tuple(rows.stop - rows.start for rows in world.states), system.agents
        matrices = 2 if getattr(made, "split", False) else 1
        definite = (entry.sums or entry.weighs) and name != registry.OPTIMAL
        kind = Kind(name, sizes, matrices, definite, n * 2 * (protocol.horizon + 1), _told(world))
        shared = system.shared and start.step == 1 and start.P is None
        self._setting = AgentSetting(world, agent, riding, kind, protocol, shared)
        late = capabilities.reason(name, registry.GENERAL, "delay") is None
        self._knows: Knowledge = knowledge_of(self._setting, Life(agent, 0), start.step, made, late)
        moves = any(f is not None and not f.stands for f in self.scenario.instruments)
        varies = system.model.varies or moves or any(M.ndim > 2 for M in (*world.H, *world.R))
        self._last = system.steps if varies or entry.own_filters else None

    @property
    def number(self) -> int:
        """Of the agent, from 1."""
        return self._setting.agent + 1

    @property
    def now(self) -> int:
        """The step that it is at."""
        return self._knows.now

    @property
    def protocol(self) -> MessageProtocol:
        """Of its messages."""
        return self._setting.protocol

    @property
    def nodes(self) -> int:
        """How many estimates (or measurements) of its own and of others it holds."""
        return len(self._knows.nodes)

    def __repr__(self) -> str:
        return f"Agent({self.number} of {self.scenario.name}, {self.estimator}, step {self.now}, {self.nodes} nodes)"

    def step(self, z: Any = None) -> None:
        """Go on to the next step: from what is fused, predict, and update with a measurement.

        Parameters
        ----------
        z : (p,) measurement of the new step, or a number; None, or NaN alone, if there is none.

        Raises
        ------
        UsageError
            If z is no measurement of this agent's sensor, or the estimator cannot do without one.
        """
        step, where = self.now + 1, f"agent {self.number}, step {self.now + 1}"
        if self._last is not None and step > self._last:
            raise UsageError(
                f"{where}: expected {self._last} steps at most (network.steps): model or sensors depend on the step"
            )
        H = at_step(self._setting.world.H[self._setting.agent], step)
        if self._live is None:
            self._knows.go_on(not H.any())
            return
        measured = self._measured(z, H, where)
        self._live.meet(measured)
        if measured is None and H.any():
            why = capabilities.not_on_data(self.estimator, [capabilities.GAPS])
            if why is not None:
                raise UsageError(why)
        self._knows.go_on(measured is None)

    def _measured(self, z: Any, H: np.ndarray, where: str) -> np.ndarray | None:
        if z is None:
            return None
        try:
            array = np.asarray(z, dtype=float).reshape(-1, 1)
        except (TypeError, ValueError):
            raise UsageError(f"{where}: expected numbers for z, got {type(z).__name__}") from None
        if array.size and np.isnan(array).all():
            return None
        nonlinear = self._live is not None and self._live.function is not None
        if not H.any() and not nonlinear:
            raise UsageError(f"{where}: expected no z, its sensor measures nothing then")
        if len(array) != len(H) or not np.isfinite(array).all():
            expected = f"{len(H)} finite number{'s' if len(H) > 1 else ''} for z, or None"
            raise UsageError(f"{where}: expected {expected}, got {array.ravel().tolist()}")
        return array

    def message(self, to: int | str | Sequence[int | str] | None = None) -> bytes:
        """Return what it has to say in this step, for all that hear it.

        Parameters
        ----------
        to : number or name of whom it is for, or several; what they are known to know is left out.
        """
        return encode(self.says(to), self._setting.kind)

    def says(self, to: int | str | Sequence[int | str] | None = None) -> list[Node]:
        """Return the nodes of that message, the agent's own first."""
        if to is None:
            hearers = np.flatnonzero(reachable(self.scenario.network)[:, self._setting.agent]).tolist()
        else:
            hearers = [
                _number(self.scenario, one)
                for one in ([to] if isinstance(to, str) or not isinstance(to, Sequence) else to)
            ]
        return self._knows.message(hearers)

    def receive(self, message: bytes) -> bool:
        """Take in a message.

        Returns
        -------
        bool
            Whether it told something new.

        Raises
        ------
        MessageError
            If it is no message for this agent, or says what cannot be; nothing has changed then.
        """
        return self.hear(decode(message, self._setting.kind))

    def hear(self, nodes: Sequence[Node]) -> bool:
        """Take in the nodes of a message, see `receive`."""
        return self._knows.tell(nodes)

    def fuse(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what it claims now, with all that arrived.

        Returns
        -------
        x, P
            (d,) and (d, d); of a blender those of the full state.
        """
        x, P = self.claimed()
        return x[:, 0].copy(), P.copy()

    def claimed(self) -> Estimate:
        """Return the same as it is carried along, x of shape (d, columns)."""
        return self._knows.claim().estimate

    @property
    def apart(self) -> int:
        """How many estimates that were heard rest on others that are not there, see `MessageProtocol.missing`."""
        return self._knows.claim().apart

    @property
    def kind(self) -> Kind:
        """What all messages of its network have in common."""
        return self._setting.kind

    def save(self) -> bytes:
        """Return all that it needs to go on from here; see `load`."""
        knows, kind = self._knows, self._saved_kind()
        nodes = [knows.own, *(node for name, node in knows.nodes.items() if name != knows.own.name)]
        for place, (vector, (step, information)) in enumerate(sorted(knows.worth.items(), key=lambda item: item[0])):
            # as a node of nobody's, one step later than what it rests on
            nobody = Life(self.scenario.network.agents, place)
            known = {**dict(vector), nobody: step + 1}
            nodes.append(Node(nobody, step + 1, known, information.y, (information.Y,)))
        waived = [[*life, step] for life, step in sorted(knows.waived.items())]
        seen = None
        if isinstance(knows, Latest):
            seen = [[*life, sorted(steps)] for life, steps in sorted(knows.seen.items())]
        protocol = asdict(self.protocol)
        facts = _Facts(self.number, self.estimator, self.criterion, protocol, knows.now, knows.begun, waived, seen)
        told = {name: value for name, value in facts._asdict().items() if value is not None}
        head = json.dumps(told, separators=(",", ":")).encode()
        whole = SAVED + len(head).to_bytes(4, "little") + head + encode(nodes, kind)
        return whole + zlib.crc32(whole).to_bytes(4, "little")

    @classmethod
    def load(cls, data: bytes, scenario: ScenarioLike, estimator: Any = None) -> Agent:
        """Start an agent again from what it saved.

        Parameters
        ----------
        data : of `save`, by an agent of this scenario.
        estimator : the rule of your own that it had: what was saved loads no code.

        Raises
        ------
        MessageError
            If it is not that.
        """
        whole, check = (bytes(data[:-4]), bytes(data[-4:])) if isinstance(data, bytes | bytearray) else (b"", b"")
        if whole[:4] != SAVED or zlib.crc32(whole).to_bytes(4, "little") != check:
            raise MessageError("saved agent: expected what Agent.save returned, got other or damaged bytes")
        end = 8 + int.from_bytes(whole[4:8], "little")
        try:
            facts = _Facts(**json.loads(whole[8:end]))
            protocol, criterion = MessageProtocol(**facts.protocol), facts.criterion
            name = facts.estimator if estimator is None else estimator_named(estimator)
            if name != facts.estimator or (estimator is None and name not in registry.ESTIMATORS):
                got = "none" if estimator is None else f"'{name}'"
                raise MessageError(f"saved agent: expected estimator '{facts.estimator}' to be given, got {got}")
            agent = cls(scenario, facts.agent, name, protocol=protocol, criterion=criterion)
            try:
                nodes = decode(whole[end:], agent._saved_kind())
            except MessageError:
                raise MessageError("saved agent: expected one of this scenario (agents, F, Q), got another's") from None
            agent._restore(facts, nodes)
        except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise MessageError(f"saved agent: expected what Agent.save returned, got other facts: {error}") from None
        return agent

    def _restore(self, facts: _Facts, nodes: list[Node]) -> None:
        knows = self._knows
        knows.life = Life(self._setting.agent, secrets.randbelow(2**32 - 1) + 1)
        knows.now, knows.begun, knows.own = facts.now, facts.begun, nodes[0]
        knows.waived = {Life(agent, number): step for agent, number, step in facts.waived}
        if isinstance(knows, Latest):
            knows.seen = {Life(agent, number): set(steps) for agent, number, steps in facts.seen or ()}
            nodes = nodes[1:]
        nobody = self.scenario.network.agents
        knows.nodes = {node.name: node for node in nodes if node.life.agent != nobody}
        knows.worth = {
            tuple((life, k) for life, k in sorted(node.known.items()) if life.agent != nobody): (
                node.step - 1,
                Information(node.v, node.M[0]),
            )
            for node in nodes
            if node.life.agent == nobody
        }

    def _saved_kind(self) -> Kind:
        kind = self._setting.kind
        own = kind.dimensions[self._setting.agent]
        return kind._replace(estimator=f"{kind.estimator}, saved", dimensions=(*kind.dimensions, own), most=100_000)


class Live:
    """What a live agent measures, in the place of a record; see `stochfuse.estimators.world.Riding`."""

    def __init__(self, scenario: Scenario, agent: int, start: Start) -> None:
        system = scenario.system
        still = [np.zeros((1, 1, 1)) for _ in range(system.agents)]
        first = start.x if scenario.nominal is None or system.x0.any() or start.x is not None else scenario.nominal[0]
        first = None if first is None else np.asarray(first, dtype=float).reshape(1, -1, 1)
        self._readings = Readings.given(system, still, first=[first] * system.agents)
        self._inputs = self._readings.inputs if system.model.varies else self._readings.inputs[0]
        self.function = scenario.instruments[agent] if scenario.instruments else None
        self._widths = [H.shape[-2] for H in self._readings.world.H]
        self._z = self._H = None

    def meet(self, z: np.ndarray | None) -> None:
        """Put down what the next step measures."""
        self._z, self._H = z, None

    def start(self, rows: slice) -> np.ndarray:
        """First estimate."""
        return self._readings.x0[0, rows]

    def process(self, step: int, rows: slice) -> np.ndarray:
        """Known input."""
        return at_step(self._inputs, step)[rows]

    def sensor(self, step: int, agent: int, H: np.ndarray) -> np.ndarray:
        """As the model says, or as linearised."""
        return H if self._H is None else self._H

    def measured(self, step: int, agent: int) -> np.ndarray:
        """The measurement; anything where H is zero."""
        return np.zeros((self._widths[agent], 1)) if self._z is None else self._z

    def related(self, step: int, pair: tuple[int, int]) -> np.ndarray:
        """That all track one state."""
        return self._readings.related(step, pair)

    def shift(self, agent: int) -> np.ndarray:
        """S of an agent's filter."""
        return self._readings.shift(agent)

    def linearised(self, step: int, prior: np.ndarray) -> None:
        """Linearise the sensor about a prediction (d, 1)."""
        f, z = self.function, self._z
        if f is None or z is None:
            return
        self._H = f.H(prior, step)
        self._z = f.residual(z, f.h(prior, step)) + self._H @ prior


def _number(scenario: Scenario, agent: int | str) -> int:
    """Agent's number from 0."""
    return int(scenario.network.agent(agent, ())) - 1


def _told(world: World) -> str:
    """F and Q of the first agent's first step, to digits that no arithmetic of another machine changes."""
    F, Q = (M if M.ndim == 2 else M[min(1, len(M) - 1)] for M in (world.F[0], world.Q))
    rows = world.states[0]
    return " ".join(f"{value + 0.0:.6e}" for value in (*F.ravel(), *Q[rows, rows].ravel()))


def _begun(scenario: Scenario, agent: int, start: Start) -> World:
    """What the filters are told, with the agent's own first estimate."""
    world = world_of(scenario.system)
    # what stands is linearised anew at every step; along the nominal path it is only for those who have no data
    still = [f is not None and f.stands for f in scenario.instruments or (None,) * len(world.H)]
    world = replace(world, H=tuple(H[-1] if one and H.ndim > 2 else H for H, one in zip(world.H, still, strict=True)))
    counted = isinstance(start, Start) and isinstance(start.step, int | np.integer) and start.step >= 1
    if not counted or (start.x is None) != (start.P is None):
        raise UsageError(f"start: expected Start(step of at least 1, and both x and P or neither), got {start!r}")
    if start.P is None:
        return world
    rows = world.states[agent]
    d = rows.stop - rows.start
    try:
        P, x = np.asarray(start.P, dtype=float), np.asarray(start.x, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"start: expected numbers for x and P, got {start.x!r} and {start.P!r}") from None
    if P.shape != (d, d) or x.size != d or not np.isfinite(x).all():
        raise UsageError(f"start: expected x of {d} numbers and P of {d}×{d}, got {x.shape} and {P.shape}")
    fault = covariance_fault(P, definite=True)
    if fault is not None:
        raise UsageError(f"start.P: expected a covariance, got {fault}")
    P0 = world.P0.copy()
    P0[rows, rows] = P
    return replace(world, P0=P0)
