"""One history of a network as a Local Fusion Graph that explains itself, thesis 2.4.

A history says which message went from whom to whom, when it was sent and when it arrived.  The graph answers what each
agent knows, what any estimates have in common, and how a fused estimate comes about: which shared nodes were removed,
with which sign, brought forward from when.  The search is that of `stochfuse.estimators.local_fusion_graph`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import stochfuse
from stochfuse.errors import ScenarioError, UsageError
from stochfuse.estimators.ledger import Ledger, check_definite, evaluate
from stochfuse.estimators.local_fusion_graph import LocalFusionGraph, Pedigrees
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.world import sources_of
from stochfuse.kalman.checks import shown
from stochfuse.kalman.kernel import Estimate, from_information
from stochfuse.scenario.capabilities import require
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.registry import GENERAL, LFG
from stochfuse.scenario.scenario import Scenario, link_rows, parse, read_file

SCHEMA = "stochfuse.history/1"
MOST_NODES = 2000
_HISTORIES = Path(__file__).parent / "histories"

Node = tuple[int, int]
"""(agent, step), both counted from 1; (0, 1) is a common start."""


class Message(NamedTuple):
    """A message that arrived: agents from 1, steps from 1."""

    sender: int
    receiver: int
    sent: int
    arrives: int


@dataclass(frozen=True)
class History:
    """Which messages arrived, and when; make one with `load_history` or `History.from_mapping`."""

    agents: int
    steps: int
    messages: tuple[Message, ...]

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], name: str = "history") -> History:
        """Check a mapping with a history file's keys and make the history.

        Raises
        ------
        ScenarioError
            Naming every offending key, what was expected there and what came.
        """
        check = Checker()
        for key in mapping:
            if key not in ("schema", "agents", "steps", "message"):
                check.note(str(key), "one of schema, agents, steps, message", "an unknown key")
        if mapping.get("schema", SCHEMA) != SCHEMA:
            check.note("schema", f'"{SCHEMA}"', shown(mapping["schema"]))
        for key in ("agents", "steps"):
            if key not in mapping:
                check.note(key, "a whole number of at least 1", "nothing")
        agents = check.integer("agents", mapping.get("agents"), 1)
        steps = check.integer("steps", mapping.get("steps"), 1)
        if agents and steps and agents * steps > MOST_NODES:
            check.note("agents and steps", f"at most {MOST_NODES} nodes", f"{agents} × {steps}")
        given = mapping.get("message", [])
        if not isinstance(given, list):
            check.note("message", "a list of messages, each with from, to, sent and optionally arrives", shown(given))
            given = []
        messages: list[Message] = []
        for i, entry in enumerate(given, start=1):
            messages += _messages(check, f"message[{i}]", entry, agents or 1, steps or 1)
        if check.problems:
            raise ScenarioError(name, check.problems)
        return cls(agents or 1, steps or 1, tuple(messages))


def _messages(check: Checker, path: str, entry: Any, agents: int, steps: int) -> list[Message]:
    keys = ("from", "to", "sent", "arrives")
    if not isinstance(entry, dict):
        check.note(path, "a table with from, to, sent and optionally arrives", shown(entry))
        return []
    before = len(check.problems)
    for key in entry:
        if key not in keys:
            check.note(f"{path}.{key}", f"one of {', '.join(keys)}", "an unknown key")
    for key in keys[:3]:
        if key not in entry:
            check.note(f"{path}.{key}", "a whole number", "nothing")
    to = entry.get("to")
    receivers = to if isinstance(to, list) else [] if to is None else [to]
    sent: Any = entry.get("sent")
    arrives: Any = entry.get("arrives", sent)
    for key, value, most in (
        ("from", entry.get("from"), agents),
        *(("to", receiver, agents) for receiver in receivers),
        ("sent", sent, steps),
        ("arrives", arrives, steps),
    ):
        number = check.integer(f"{path}.{key}", value, 1)
        if number is not None and number > most:
            check.note(f"{path}.{key}", f"a whole number from 1 to {most}", f"{number}")
    if len(check.problems) == before and arrives < sent:
        check.note(f"{path}.arrives", f"a step from {sent} on, when it is sent", f"{arrives}")
    if len(check.problems) == before and entry["from"] in receivers:
        check.note(f"{path}.to", "another agent than the sender", f"{entry['from']}")
    if len(check.problems) > before:
        return []
    return [Message(entry["from"], receiver, sent, arrives) for receiver in receivers]


def history_names() -> list[str]:
    """Names of the histories that come with the package."""
    return sorted(path.stem for path in _HISTORIES.glob("*.toml"))


def load_history(source: str | Path | Mapping[str, Any] = "thesis-example") -> History:
    """Read a history: a name that comes with the package, a TOML or JSON file, "-" for standard input, or a mapping.

    Raises
    ------
    ScenarioError
        If the file is missing or malformed, or naming every offending key.

    Examples
    --------
    >>> import stochfuse as sf
    >>> graph = sf.FusionGraph(sf.load_history("thesis-example"))
    >>> len(graph.explain(agent=1, step=3).terms)
    3
    """
    if isinstance(source, Mapping):
        return History.from_mapping(source)
    if source in history_names():
        text = (_HISTORIES / f"{source}.toml").read_text(encoding="utf-8")
        return History.from_mapping(parse(str(source), text), str(source))
    name, text = read_file(source, f"no such file, and no history of that name (known: {', '.join(history_names())})")
    return History.from_mapping(parse(name, text), name)


class Term(NamedTuple):
    """One summand of a fused estimate.

    Parameters
    ----------
    coefficient : how often it is added; negative: removed.
    nodes : the nodes whose information it is, fused with each other where they are several.
    since, until : the step at which they are fused, and the step that the result is brought forward to.
    shared_by : the sets of estimates that have just these nodes in common; empty for an estimate itself.
    parts : the summands of the nodes' own fusion, where they are several.
    """

    coefficient: int
    nodes: tuple[Node, ...]
    since: int
    until: int
    shared_by: tuple[tuple[Node, ...], ...]
    parts: tuple[Term, ...]


class Explanation(NamedTuple):
    """How a fused estimate comes about.

    Parameters
    ----------
    agent, step : whose estimate, and when.
    fused : the estimates that are fused.
    superseded : estimates received whose pedigree was known already; they change nothing, (19) → (20).
    terms : the summands, those that cancel left out.
    """

    agent: int
    step: int
    fused: tuple[Node, ...]
    superseded: tuple[Node, ...]
    terms: tuple[Term, ...]


class FusionGraph:
    """The Local Fusion Graph of a history.

    Parameters
    ----------
    history : which messages arrived.
    shared : whether all agents start from one common estimate, the node (0, 1).
    """

    def __init__(self, history: History, *, shared: bool = False) -> None:
        self.history, self.shared = history, shared
        self.ledger = Ledger()
        n = history.agents
        estimator = LocalFusionGraph(self.ledger, tuple(range(n)), shared=shared)
        exchange = estimator.exchange(estimator.start())
        self._fused: dict[Node, int] = {}
        for step in range(1, history.steps + 1):
            heard, late = [1 << i for i in range(n)], []
            for sender, receiver, sent, arrives in history.messages:
                if sent == arrives == step:
                    heard[receiver - 1] |= 1 << sender - 1
                elif sent == step:
                    late.append(Late(receiver - 1, arrives - sent, sender - 1))
            for i in range(n):
                self._fused[i + 1, step] = exchange.fused(i, heard)
            if step < history.steps:
                exchange = exchange.onward(heard, late)
        self.pedigrees: Pedigrees = exchange.pedigrees
        self.nodes: list[Node] = [(0, 1)] * shared + [
            (i, step) for step in range(1, history.steps + 1) for i in range(1, n + 1)
        ]
        self._number = {node: number for number, node in enumerate(self.nodes)}

    def received(self, agent: int, step: int) -> tuple[Node, ...]:
        """Nodes that an agent has at hand for a fusion: its own estimate and those that arrive, in order."""
        self._check(agent, step)
        arrived = {(m.sender, m.sent) for m in self.history.messages if (m.receiver, m.arrives) == (agent, step)}
        return ((agent, step), *sorted(arrived, key=lambda node: (-node[1], node[0])))

    def parents(self, node: Node) -> tuple[Node, ...]:
        """Nodes that an estimate rests on directly: what its agent fused a step before."""
        agent, step = node
        if step == 1 or agent == 0:
            return ((0, 1),) if self.shared and agent else ()
        return self.received(agent, step - 1)

    def ancestors(self, node: Node) -> frozenset[Node]:
        """Return the pedigree of a node: itself and all that it rests on."""
        return frozenset(self._nodes(self.pedigrees.below[self._number[node]]))

    def common(self, nodes: Iterable[Node]) -> tuple[Node, ...]:
        """Return the latest nodes that some estimates have in common, earliest first; empty if they share nothing."""
        return self._latest(self._shared(nodes))

    def explain(self, agent: int, step: int) -> Explanation:
        """How an agent's fused estimate comes about.

        Raises
        ------
        UsageError
            If there is no such agent or step.
        """
        at_hand = self.received(agent, step)
        fused = self._latest(self._union(at_hand))
        return Explanation(agent, step, fused, tuple(n for n in at_hand if n not in fused), self._terms(fused, step))

    def text(self, agent: int, step: int) -> str:
        """Return in words how an agent's fused estimate comes about, as `stochfuse graph` prints it."""
        return stochfuse.shown("graph_text", self, agent, step)

    def plot(self, agent: int, step: int) -> Any:
        """Return a figure of the graph of an agent's fused estimate, as `stochfuse graph --plot` draws it."""
        return stochfuse.shown("graph_figure", self, agent, step)

    def estimates(self, scenario: Scenario, measurements: Any = None) -> dict[Node, Estimate]:
        """Every agent's fused estimate at every step, with a scenario's model, sensors and first estimates.

        Parameters
        ----------
        measurements : (steps, agents, p) what each agent measured, or None for covariances alone; the entry of step 1
            is not used.

        Returns
        -------
        dict
            (agent, step) → Estimate with P (d, d) as claimed, and x (d, 1) or None.

        Raises
        ------
        UsageError
            If the scenario or the measurements have other numbers of agents or too few steps, or the Local Fusion
            Graph does not take what the scenario has.
        NoAnswerError
            If the graph claims information that is not positive definite, which it can in several dimensions.
        """
        n, steps = self.history.agents, self.history.steps
        if scenario.network.agents != n or scenario.network.steps < steps:
            raise UsageError(
                f"scenario: expected {n} agents and at least {steps} steps, got {scenario.network.agents} and "
                f"{scenario.network.steps}"
            )
        records = None if measurements is None else np.asarray(measurements, dtype=float)
        if records is not None and (records.ndim != 3 or records.shape[0] < steps or records.shape[1] != n):
            raise UsageError(
                f"measurements: expected shape (steps, agents, p) = ({steps}, {n}, p), got {records.shape}"
            )
        require(scenario.system, link_rows(scenario), LFG, GENERAL)
        values = evaluate(self.ledger, sources_of(scenario.system, records, by_agent=True))
        for (_, step), value in self._fused.items():
            check_definite(values.Y[value], step)
        found = from_information(values)
        x = found.x
        return {node: Estimate(None if x is None else x[value], found.P[value]) for node, value in self._fused.items()}

    def _terms(self, nodes: Sequence[Node], step: int) -> tuple[Term, ...]:
        below = self.pedigrees.below
        shared_by: dict[int, list[tuple[Node, ...]]] = {}
        for size in range(2, len(nodes) + 1):
            for some in combinations(nodes, size):
                shared_by.setdefault(self._shared(some), []).append(some)
        own = {below[self._number[node]] for node in nodes}
        terms = []
        for shared, times in self.pedigrees.terms(self._union(nodes)).items():
            if times:
                latest = self._latest(shared)
                since = max(k for _, k in latest)
                parts = self._terms(latest, since) if len(latest) > 1 else ()
                by = () if shared in own else tuple(shared_by.get(shared, ()))
                terms.append(Term(times, latest, since, step, by, parts))
        return tuple(sorted(terms, key=lambda term: (bool(term.shared_by), -term.coefficient, -term.since, term.nodes)))

    def _shared(self, nodes: Iterable[Node]) -> int:
        mask = -1
        for node in nodes:
            mask &= self.pedigrees.below[self._number[node]]
        return mask

    def _union(self, nodes: Iterable[Node]) -> int:
        mask = 0
        for node in nodes:
            mask |= self.pedigrees.below[self._number[node]]
        return mask

    def _latest(self, mask: int) -> tuple[Node, ...]:
        return tuple(
            sorted((self.nodes[n] for n in self.pedigrees.maximal(mask)), key=lambda node: (-node[1], node[0]))
        )

    def _nodes(self, mask: int) -> list[Node]:
        return [node for number, node in enumerate(self.nodes) if mask >> number & 1]

    def _check(self, agent: int, step: int) -> None:
        for name, value, most in (("agent", agent, self.history.agents), ("step", step, self.history.steps)):
            if not 1 <= value <= most:
                raise UsageError(f"{name}: expected a whole number from 1 to {most}, got {value}")
