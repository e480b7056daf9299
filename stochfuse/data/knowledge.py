"""What a live agent knows: nodes, what they rest on, what it may forget, and what it makes of them.

Three ways, one for each kind of estimator:

    Graph      Local Fusion Graph: nodes are local estimates; fused is fuse(own ∪ heard) of `stochfuse.estimators.
               local_fusion_graph`, over those nodes that are held
    Measured   the optimum: nodes are what was measured, HᵀR⁻¹z and HᵀR⁻¹H; fused is one filter over all that is known
    Latest     naive fusion, intersections and whatever else remembers pasts: one node a message, fused by the
               estimator itself

**Memory.**  Every node says what its maker knew (`known`), and so acknowledges it.  C is what all agents are known to
know.  Whatever will be heard rests on C, so that no later search meets a node below the maximal ones of C, but where
the pedigree of a node outside C meets C; by the same closure with which replay forgets.  Graph keeps what is left.
An agent that was not heard of for `horizon` steps is not waited for, and nodes older than that are forgotten: at most
n · (horizon + 1) nodes are held (twice that while messages from agents whose clocks are ahead wait).

**What that costs.**  Nothing as long as no agent is silent for longer.  After a longer silence nodes may be missing
that two pedigrees have in common.  The Graph then takes their common information for unknown: the estimate waits until
what is missing comes, or enters by covariance intersection (`MessageProtocol.missing`; always if what is missing is
older than the horizon, or was done without before).  What follows rests on it, and is exact again
as soon as both sides hold what they share.  The optimum loses measurements that come later than that, and so do the
others estimates.  The same may happen without silence among more than a dozen agents that hear most of what all say,
whose pedigrees have too many intersections to work out.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.messages import LIVES, Kind, Life, MessageProtocol, Name, Node
from stochfuse.errors import MessageError, NoAnswerError, TooManyError, UsageError
from stochfuse.estimators.local_fusion_graph import Pedigrees
from stochfuse.estimators.recursion import Pasts, RecursiveEstimator, RuleError, Worked, worked_out
from stochfuse.estimators.world import Riding, World
from stochfuse.fusion.intersection import fuse_stack
from stochfuse.kalman.kernel import (
    Estimate,
    Information,
    at_step,
    from_information,
    predict,
    predict_information,
    to_information,
    update_information,
)
from stochfuse.scenario.registry import LFG, OPTIMAL, STAND_ALONE

MOST_TERMS = 60_000
"""Intersections that a step's searches go through; beyond, what is heard enters by covariance intersection."""
MOST_SETS = 4_000
"""Intersections of pedigrees that are worked out beforehand; where they are more, the horizon alone forgets."""


Vector = tuple[tuple[Life, int], ...]
"""The latest step of every life that a set of nodes holds."""
Worth = tuple[int, Information]
"""Step of a set's latest node, and what the set is worth there."""


class Claim(NamedTuple):
    """What an agent claims.

    Parameters
    ----------
    estimate, information : in either form.
    known : the pedigree that it rests on.
    apart : how many estimates did not fit in.
    waived : what those that entered by intersection rest on.
    """

    estimate: Estimate
    known: dict[Life, int]
    information: Information | None = None
    apart: int = 0
    waived: Mapping[Life, int] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class AgentSetting:
    """What an agent is told.

    Parameters
    ----------
    world : what the filters are told.
    agent : its number from 0.
    riding : what rides along with covariances: what it measured, or noise footprints.
    kind : of its messages.
    protocol : of its messages.
    shared : whether all agents start from one common estimate.
    """

    world: World
    agent: int
    riding: Riding
    kind: Kind
    protocol: MessageProtocol
    shared: bool = False

    @cached_property
    def _invertible(self) -> np.ndarray:
        """Whether F has an inverse, of every step where it depends on that."""
        return np.atleast_1d(np.linalg.cond(self.world.F[self.agent]) < 1e8)

    @property
    def rows(self) -> slice:
        """Where its state is in the stacked one."""
        return self.world.states[self.agent]

    def transition(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F, Q, and what a prediction adds."""
        F, Q = at_step(self.world.F[self.agent], step), at_step(self.world.Q, step)[self.rows, self.rows]
        return F, Q, self.riding.process(step, self.rows)

    def forward(self, information: Information, step: int) -> Information:
        """Time update of an information pair to a step."""
        F, Q, moved = self.transition(step)
        if self._invertible[step - 1 if self.world.F[self.agent].ndim > 2 else 0]:
            return predict_information(information, F, Q, moved)
        return to_information(predict(from_information(information), F, Q, moved))

    def measured(self, step: int) -> Information:
        """What the agent's own measurement brings."""
        H, R = at_step(self.world.H[self.agent], step), at_step(self.world.R[self.agent], step)
        H, z = self.riding.sensor(step, self.agent, H), self.riding.measured(step, self.agent)
        d = H.shape[-1]
        return update_information(Information(np.zeros((d, z.shape[-1])), np.zeros((d, d))), H, R, z)

    def first(self) -> Information:
        """The first estimate."""
        return to_information(Estimate(self.riding.start(self.rows), self.world.P0[self.rows, self.rows]))


class Knowledge:
    """What all three have in common: the nodes held, the agent's own one, and its clock.

    Parameters
    ----------
    setting : what the agent is told.
    life, step : its name, and the step of its first estimate.
    """

    def __init__(self, setting: AgentSetting, life: Life, step: int) -> None:
        self.setting, self.life, self.now, self.begun = setting, life, step, step
        self.nodes: dict[Name, Node] = {}
        self.worth: dict[Vector, Worth] = {}
        self.waived: dict[Life, int] = {}
        self.own: Node
        self._claim: Claim | None = None

    def claim(self) -> Claim:
        """What is claimed now, with all that was heard."""
        if self._claim is None:
            self._claim = self.fused()
        return self._claim

    def tell(self, nodes: Sequence[Node]) -> bool:
        """Take in the nodes of a message; whether any was new.

        Raises
        ------
        MessageError
            If they cannot be what they say, as far as this agent knows.
        """
        protocol, first = self.setting.protocol, nodes[0]
        if first.step > self.now + protocol.horizon:
            raise MessageError(
                f"message: expected one of step {self.now + protocol.horizon} at most (now: {self.now}; horizon "
                f"{protocol.horizon}), got step {first.step}"
            )
        own = max((node.known.get(self.life, 0) for node in nodes), default=0)
        if own > self.own.step:
            raise MessageError(
                f"message: expected agent {self.life.agent + 1} at step {self.own.step} at most, which it has reached, "
                f"got {own}: do two go by that number?"
            )
        if any(
            node.step > first.step or k > first.known.get(life, 0) for node in nodes for life, k in node.known.items()
        ):
            raise MessageError("message: expected nodes that its first one rests on, got others")
        known, told = set(self.own.known), {life for node in nodes for life in node.known}
        for life in told - known:
            if sum(life.agent == other.agent for other in known | told) > LIVES:
                raise MessageError(
                    f"message: expected {LIVES} lives of agent {life.agent + 1} at most, which are told apart, got more"
                )
        if first.step < self.now - protocol.horizon:
            return False
        new = self.new([node for node in nodes if node.step >= self.now - protocol.horizon])
        if new:
            self._claim = None
        return new

    def new(self, nodes: Sequence[Node]) -> bool:
        """Take in nodes that are neither too old nor impossible."""
        raise NotImplementedError

    def fused(self) -> Claim:
        """What is made of what is known."""
        raise NotImplementedError

    def go_on(self, missed: bool) -> None:
        """The next step: predict, measure unless the sensor missed, forget."""
        raise NotImplementedError

    def local(self, information: Information | None, missed: bool) -> Information:
        """Local estimate of this step, from what was fused in the one before, unless the sensor missed."""
        local = self.setting.forward(information, self.now)  # pyright: ignore[reportArgumentType]
        if missed:
            return local
        self.linearise(from_information(local).x)
        y, Y = self.setting.measured(self.now)
        return Information(local.y + y, local.Y + Y)

    def linearise(self, prior: np.ndarray) -> None:
        """Linearise the agent's sensor about its prediction."""
        at = getattr(self.setting.riding, "linearised", None)
        if at is not None:
            at(self.now, prior)

    def message(self, hearers: Sequence[int]) -> list[Node]:
        """Nodes of a message to some agents, the agent's own first."""
        return [self.own]


class Gossip(Knowledge):
    """Nodes are handed on, and each says what its maker knew."""

    root: Information | None = None

    def arrived(self) -> list[Node]:
        """Nodes that are there by now and that the agent's own does not rest on, latest first."""
        here = [n for n in self.nodes.values() if n.step <= self.now and n.step > self.own.known.get(n.life, 0)]
        return sorted(here, key=lambda node: node.name[::-1], reverse=True)

    def new(self, nodes: Sequence[Node]) -> bool:
        """Nodes that are not held, nor below what all know."""
        known, below = self.own.known, self.common()
        found = [n for n in nodes if n.name not in self.nodes and n.step > below.get(n.life, 0)]
        self.nodes |= {node.name: node for node in found}
        return any(node.step > known.get(node.life, 0) for node in found)

    def message(self, hearers: Sequence[int]) -> list[Node]:
        """By the protocol."""
        own, protocol = self.own, self.setting.protocol
        rest = [n for n in self.nodes.values() if n is not own and n.step <= own.known.get(n.life, 0)]
        if protocol.carries == "window":
            rest = [node for node in rest if node.step > self.now - protocol.window]
        elif protocol.carries != "full":
            told = self.common(hearers)
            rest = [node for node in rest if node.step > told.get(node.life, 0)]
        if protocol.carries == "own":
            rest = [node for node in rest if node.life.agent == own.life.agent]
        return [own, *sorted(rest, key=lambda node: node.name[::-1], reverse=True)]

    def common(self, agents: Iterable[int] | None = None) -> dict[Life, int]:
        """What all of some agents (default: all) are known to know, this one included, but for those long silent."""
        agents = range(self.setting.world.agents) if agents is None else agents
        since, known = self.now - self.setting.protocol.horizon, dict(self.own.known)
        for agent in agents:
            if agent == self.life.agent:
                continue
            told = list(self._told(agent, since))
            if not told and self.begun >= since:
                return {}
            for vector in told:
                known = {life: min(k, vector.get(life, 0)) for life, k in known.items() if life in vector}
        return known

    def _told(self, agent: int, since: int) -> Iterator[Any]:
        """What an agent said that it knew, in each life that was heard of lately and that no later one goes on from."""
        latest = dict(self.own.known)
        for life, step in self.nodes:
            latest[life] = max(step, latest.get(life, 0))
        lives = [(life, k) for life, k in latest.items() if life.agent == agent and k >= since]
        heard = [(life, k, self.nodes[life, k].known) for life, k in lives if (life, k) in self.nodes]
        for life, k, known in heard:
            if not any(other != life and theirs.get(life, 0) >= k for other, _, theirs in heard):
                yield known

    def _step(self, claim: Claim, v: np.ndarray, M: np.ndarray) -> None:
        """Put down the agent's own node of this step."""
        known = {**claim.known, self.life: self.now}
        self._claim = None
        _join(self.waived, claim.waived)
        self.own = self.nodes[self.life, self.now] = Node(self.life, self.now, known, v, (M,))
        self._forget()

    def _forget(self) -> None:
        since = self.now - self.setting.protocol.horizon
        keep = self.kept(self.common())
        latest = {(life, k) for life, k in self.own.known.items()}
        self.nodes = {
            name: node
            for name, node in self.nodes.items()
            if node.step >= since and (name in latest or name in keep or node.step > self.own.known.get(node.life, 0))
        }

    def kept(self, common: dict[Life, int]) -> set[Name]:
        """Names of the nodes that may matter yet."""
        raise NotImplementedError


class Graph(Gossip):
    """The Local Fusion Graph of what is held."""

    def __init__(self, setting: AgentSetting, life: Life, step: int) -> None:
        super().__init__(setting, life, step)
        first = setting.first()
        # a shared first estimate is a common ancestor of all, which everyone has
        self.root = first if setting.shared else None
        self.own = Node(life, step, {life: step}, first.y, (first.Y,))
        self.nodes[self.own.name] = self.own

    def go_on(self, missed: bool) -> None:
        """Local estimate (24)–(27)."""
        claim = self.claim()
        self.now += 1
        self._step(claim, *self.local(claim.information, missed))

    def fused(self) -> Claim:
        """Fuse(own ∪ heard); what that cannot be told of enters by covariance intersection, or waits."""
        arrived, own = self.arrived(), self.own
        held = [own, *(node for node in self.nodes.values() if node.step <= self.now and node is not own)]
        search = self._search(held)
        mask, known, apart, lacks = search.mask(own.name), dict(own.known), [], {}
        whole = mask
        for node in arrived:
            whole |= search.mask(node.name)
        if search.claimed(whole) is not None:
            mask = whole
        for node in arrived:
            more = mask | search.mask(node.name)
            if more != mask and search.claimed(more) is None:
                apart.append(node)
                lacks[node.name] = search.lacks
                continue
            mask = more
            _join(known, node.known)
        information = search.claimed(mask) or Information(own.v, own.M[0])
        apart = [n for n in apart if not any(n is not o and n.step <= o.known.get(n.life, 0) for o in apart)]
        meet = [node for node in apart if not self._comes(lacks[node.name])]
        if not meet:
            return Claim(from_information(information), known, information, len(apart))
        estimate = from_information(information)
        waived: dict[Life, int] = {}
        for node in meet:
            estimate = self._intersected(estimate, node)
            _join(known, node.known)
            _join(waived, node.known)
        return Claim(estimate, known, to_information(estimate), len(apart), waived)

    def _comes(self, lacking: Name | None) -> bool:
        """Whether to wait: not for what all have forgotten, or what was done without before and is taken for known."""
        if lacking is None or self.setting.protocol.missing == "intersect":
            return False
        life, step = lacking
        return (
            life != self.life and step >= self.now - self.setting.protocol.horizon and step > self.waived.get(life, 0)
        )

    def _intersected(self, estimate: Estimate, node: Node) -> Estimate:
        information = Information(node.v, node.M[0])
        try:
            for step in range(node.step + 1, self.now + 1):
                information = self.setting.forward(information, step)
            x, P = from_information(information)
            stack = fuse_stack([estimate.P[None], P[None]], [np.zeros_like(P)[None]] * 2)
        except (UsageError, NoAnswerError, np.linalg.LinAlgError):
            return estimate  # it says nothing that can be used
        own, other = stack.gains
        return Estimate((own @ estimate.x + other @ x)[0], stack.C[0])

    def kept(self, common: dict[Life, int]) -> set[Name]:
        """Nodes that a later search can meet; what it can meet of sets within C is worked out once and for all."""
        search = self._search(self.nodes.values())
        if not common:
            return set(self.nodes)
        pedigrees, below = search.pedigrees, search.pedigrees.below
        C = search.whole(common)
        held = [place for place, name in enumerate(search.order) if name in self.nodes]
        outside = [place for place in held if not C >> place & 1]
        met = _intersections([C, *(below[place] for place in outside)])
        inside = [mask for mask in met or () if not mask & ~C]
        tops = {place for mask in inside for place in pedigrees.maximal(mask)}
        worth = _intersections([*inside, *(below[place] for place in tops)])
        if not met or not worth:
            return set(self.nodes)  # too many to tell
        known = {}
        for mask in worth:
            information = search.claimed(mask)
            if information is not None:
                known[search.vector(mask)] = search.latest(mask), information
        self.worth = known
        return {search.order[place] for place in (*outside, *tops)}

    def _search(self, nodes: Iterable[Node]) -> _Search:
        return _Search(self.setting, list(nodes), self.root, self.worth)


def _intersections(sets: Iterable[int]) -> set[int]:
    """Sets with all their intersections, but for the empty one; nothing if they are too many."""
    found: set[int] = set()
    for mask in set(sets):
        found |= {mask, *(mask & other for other in found)}
        if len(found) > MOST_SETS:
            return set()
    return found - {0}


class UnknownError(Exception):
    """A search met a value that is not held."""

    def __init__(self, value: int) -> None:
        self.value = value


class _InformationSums:
    """Information pairs in the place of a ledger's values, for `Pedigrees`; None: not held."""

    def __init__(self, forward: Callable[[Information, int], Information]) -> None:
        self.step: list[int] = []
        self._forward = forward
        self._at: dict[tuple[int, int], Information | None] = {}

    def add(self, step: int, information: Information | None) -> int:
        """Put a pair down."""
        self._at[len(self.step), step] = information
        self.step.append(step)
        return len(self.step) - 1

    def at(self, value: int, step: int) -> Information:
        """A value brought forward to a step."""
        known = self._at.get((value, step))
        if known is None:
            if step == self.step[value]:
                raise UnknownError(value)
            known = self._at[value, step] = self._forward(self.at(value, step - 1), step)
        return known

    def combine(self, step: int, terms: Iterable[tuple[int, int]]) -> int:
        """Σ times · value."""
        brought = [(self.at(value, step), times) for value, times in terms]
        y = sum(times * information.y for information, times in brought)
        Y = sum(times * information.Y for information, times in brought)
        return self.add(step, Information(y, Y))


class _Search:
    """Pedigrees of nodes, and of those that they name but that are not held, as masks, earlier steps first."""

    def __init__(
        self, setting: AgentSetting, nodes: Sequence[Node], root: Information | None, worth: Mapping[Vector, Worth]
    ) -> None:
        held = {node.name: node for node in nodes}
        named = {name for node in nodes for name in node.known.items()} | {name for vector in worth for name in vector}
        origin: Name = (Life(len(setting.world.F), 0), 0)
        self.order = [origin] * (root is not None) + sorted(held.keys() | named, key=lambda name: name[::-1])
        self._place = {name: place for place, name in enumerate(self.order)}
        self._origin = int(root is not None)
        self._up_to: dict[Life, tuple[list[int], list[int]]] = {}
        for place, (life, step) in enumerate(self.order[self._origin :], start=self._origin):
            steps, masks = self._up_to.setdefault(life, ([], []))
            steps.append(step)
            masks.append((masks[-1] if masks else 0) | 1 << place)
        self.sums = _InformationSums(setting.forward)
        values, below = [], []
        for name in self.order:
            node = held.get(name)
            below.append(self.whole(dict([name]) if node is None else node.known))
            if name == origin and root is not None:
                values.append(self.sums.add(1, root))
            else:
                values.append(self.sums.add(name[1], None if node is None else Information(node.v, node.M[0])))
        self.pedigrees = Pedigrees(self.sums, values, below)  # pyright: ignore[reportArgumentType]
        self.pedigrees.most = MOST_TERMS
        self.lacks: Name | None = None
        for vector, (step, information) in worth.items():
            self.pedigrees.know(self.whole(dict(vector)), self.sums.add(step, information))

    def mask(self, name: Name) -> int:
        """Pedigree of a node."""
        return self.pedigrees.below[self._place[name]]

    def whole(self, known: Mapping[Life, int]) -> int:
        """Nodes that a vector holds, as a mask."""
        mask = self._origin
        for life, step in known.items():
            if life in self._up_to:
                steps, masks = self._up_to[life]
                at = bisect_right(steps, step)
                mask |= masks[at - 1] if at else 0
        return mask

    def vector(self, mask: int) -> Vector:
        """The latest node of every life in a mask."""
        latest: dict[Life, int] = {}
        for place in range(self._origin, mask.bit_length()):
            if mask >> place & 1:
                life, step = self.order[place]
                latest[life] = step
        return tuple(sorted(latest.items()))

    def latest(self, mask: int) -> int:
        """Step of the latest node of a mask."""
        return max(self.order[mask.bit_length() - 1][1], 1)

    def claimed(self, mask: int) -> Information | None:
        """Information of a pedigree; None where that cannot be told from what is held, or is no covariance's.

        `lacks` is then the name of what is missing, if anything is.
        """
        self.lacks = None
        try:
            value = self.pedigrees.fuse(mask)
            information = self.sums.at(value, self.sums.step[value])
            np.linalg.cholesky(information.Y)
        except UnknownError as error:
            self.lacks = self.order[error.value]  # the first values are the nodes'
            return None
        except (TooManyError, np.linalg.LinAlgError):
            return None
        return information if np.isfinite(information.y).all() else None


class Measured(Gossip):
    """All measurements of a pedigree, in one filter; what all hold of them is folded into one estimate."""

    def __init__(self, setting: AgentSetting, life: Life, step: int) -> None:
        super().__init__(setting, life, step)
        first, nothing = setting.first(), Information(*(0.0 * part for part in setting.first()))
        begins = setting.shared and step == 1
        # the one entry: what is folded, up to which step
        self.worth = {(): (1, first) if begins else (0, nothing)}
        y, Y = nothing if begins else first
        self.own = Node(life, step, {life: step}, y, (Y,))
        self.nodes[self.own.name] = self.own

    def go_on(self, missed: bool) -> None:
        """The next measurement."""
        claim = self.claim()
        self.now += 1
        prior = self.setting.forward(claim.information, self.now)  # pyright: ignore[reportArgumentType]
        nothing = Information(0.0 * prior.y, 0.0 * prior.Y)
        if not missed:
            self.linearise(from_information(prior).x)
        y, Y = nothing if missed else self.setting.measured(self.now)
        self._step(claim, y, Y)

    def new(self, nodes: Sequence[Node]) -> bool:
        """But for what comes after its step was folded."""
        return super().new([node for node in nodes if node.step > self.worth[()][0]])

    def fused(self) -> Claim:
        """One filter over all that is known."""
        known = dict(self.own.known)
        for node in self.arrived():
            _join(known, node.known)
        _, information = self._filtered(self.now, known)
        return Claim(from_information(information), known, information)

    def kept(self, common: dict[Life, int]) -> set[Name]:
        """What is not yet folded, and what some do not know; steps of which nothing more can come are folded."""
        since, last = self.now - self.setting.protocol.horizon, self.now - 1
        for agent in range(self.setting.world.agents):
            mine = max((k for life, k in self.own.known.items() if life.agent == agent), default=0)
            if agent != self.life.agent and (mine >= since or self.begun >= since):
                last = min(last, mine)
        last = max(last, since - 1)
        if last > self.worth[()][0]:
            self.worth = {(): self._filtered(last, self.own.known)}
        return {n.name for n in self.nodes.values() if n.step > last or n.step > common.get(n.life, 0)}

    def _filtered(self, last: int, known: Mapping[Life, int]) -> tuple[int, Information]:
        first, total = self.worth[()]
        by_step: dict[int, list[Node]] = {}
        for node in self.nodes.values():
            if first < node.step <= last and node.step <= known.get(node.life, 0):
                by_step.setdefault(node.step, []).append(node)
        for step in range(first + 1, last + 1):
            if total.Y.any():
                total = self.setting.forward(total, step)
            nodes = by_step.get(step, ())
            total = Information(sum((n.v for n in nodes), total.y), sum((n.M[0] for n in nodes), total.Y))
        return last, total


class Latest(Knowledge):
    """One estimate a message, fused by the estimator itself, or added up."""

    def __init__(
        self, setting: AgentSetting, life: Life, step: int, estimator: RecursiveEstimator | None, late: bool
    ) -> None:
        super().__init__(setting, life, step)
        self.seen: dict[Life, set[int]] = {}
        self.estimator, self.late = estimator, late
        if estimator is None:
            self.own = self._node(*setting.first())
            return
        estimator.readings = setting.riding
        self.own = self._of(estimator.first(setting.rows))

    def new(self, nodes: Sequence[Node]) -> bool:
        """The sender's own estimate, once; a late one only where the estimator takes such."""
        life, step = nodes[0].name
        seen = self.seen.setdefault(life, set())
        tells = self.setting.kind.estimator != STAND_ALONE and (step >= self.now or self.late)
        if life.agent == self.life.agent or step in seen or not tells:
            return False
        seen.add(step)
        self.nodes[life, step] = nodes[0]
        return True

    def go_on(self, missed: bool) -> None:
        """Local estimate (23)–(27), or what the estimator does in its place."""
        if self.estimator is None:
            information = self.claim().information
            self._over()
            self.own = self._node(*self.local(information, missed))
            return
        fused, numbers = self._fused(self.estimator)
        before = self.own
        self._over()
        prior = self.estimator.prior(self.now, self.setting.agent, numbers[fused])
        self.linearise(np.asarray(prior.x)[0])
        own = self.estimator.pasts.given(before.step)
        numbers[own] = _worked(before)
        value = self.estimator.onward(self.now - 1, self.setting.agent, fused, own, missed)
        self.own = self._of(self._work(value, numbers))

    def fused(self) -> Claim:
        """Sum (42)/(43), or what the estimator says."""
        known = {self.life: self.now}
        if self.estimator is not None:
            fused, numbers = self._fused(self.estimator)
            return Claim(Estimate(numbers[fused].x[0], numbers[fused].P[0]), known)
        sums = _InformationSums(self.setting.forward)
        terms = [(sums.add(n.step, Information(n.v, n.M[0])), 1) for n in (self.own, *self._here())]
        information = sums.at(sums.combine(self.now, terms), self.now)
        return Claim(from_information(information), known, information)

    def _here(self) -> list[Node]:
        return sorted((n for n in self.nodes.values() if n.step <= self.now), key=lambda node: node.name)

    def _over(self) -> None:
        """What was fused is over, and what is too old to come again is not remembered."""
        self.nodes = {name: node for name, node in self.nodes.items() if node.step > self.now}
        self.now += 1
        self._claim = None
        since = self.now - self.setting.protocol.horizon
        recent = {each: {k for k in steps if k >= since} for each, steps in self.seen.items()}
        self.seen = {each: steps for each, steps in recent.items() if steps}

    def _fused(self, estimator: RecursiveEstimator) -> tuple[int, dict[int, Worked]]:
        """Value of the estimator's fusion of what is here, in a fresh book, with all numbers that it rests on."""
        estimator.pasts, numbers, agent = Pasts(estimator.symmetric), {}, self.setting.agent
        own = estimator.pasts.given(self.now)
        numbers[own] = _worked(self.own)
        values, heard, due = [own] * self.setting.world.agents, 1 << agent, []
        for node in self._here():
            value = estimator.pasts.given(node.step)
            numbers[value] = _worked(node)
            sender = node.life.agent
            if node.step == self.now and not heard >> sender & 1:
                values[sender], heard = value, heard | 1 << sender
                continue
            for step in range(node.step + 1, self.now + 1):
                value = estimator.pasts.number(step, ("forward", estimator.labels[agent]), (value,))
            due.append(value)
        fused = estimator.fuse(self.now, agent, values, heard, due)
        try:
            self._work(fused, numbers)
        except RuleError:
            raise
        except (UsageError, NoAnswerError):
            if not self._here():
                raise
            self.nodes = {name: node for name, node in self.nodes.items() if node.step > self.now}
            return self._fused(estimator)  # what was heard cannot be used
        return fused, numbers

    def _work(self, value: int, numbers: dict[int, Worked]) -> Worked:
        estimator = self.estimator
        if value not in numbers and estimator is not None:
            pasts = estimator.pasts
            before = [self._work(other, numbers) for other in pasts.rests_on[value]]
            estimator.magnified = 1.0
            numbers[value] = worked_out(estimator, pasts.step[value], [pasts.rule[value]], before, [value])
        return numbers[value]

    def _of(self, worked: Worked) -> Node:
        independent = 0.0 * worked.P[0] if worked.independent is None else worked.independent[0]
        return self._node(worked.x[0], *(worked.P[0], independent)[: self.setting.kind.matrices])

    def _node(self, v: np.ndarray, *M: np.ndarray) -> Node:
        return Node(self.life, self.now, {self.life: self.now}, v, M)


def _worked(node: Node) -> Worked:
    """A node as recursions have it."""
    P, *independent = node.M
    return Worked(P[None], node.v[None], independent[0][None] if independent else np.zeros_like(P)[None])


def _join(known: dict[Life, int], more: Any) -> None:
    for life, step in more.items():
        known[life] = max(step, known.get(life, 0))


def knowledge_of(
    setting: AgentSetting, life: Life, step: int, estimator: RecursiveEstimator | None, late: bool
) -> Knowledge:
    """Return what an agent of an estimator knows at its first step.

    Parameters
    ----------
    estimator : one that remembers pasts; None for sums of information.
    late : whether the estimator takes messages that come late.
    """
    if setting.kind.estimator == LFG:
        return Graph(setting, life, step)
    if setting.kind.estimator == OPTIMAL:
        return Measured(setting, life, step)
    return Latest(setting, life, step, estimator, late)
