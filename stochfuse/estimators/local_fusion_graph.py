"""The Local Fusion Graph, thesis chapter 2 and appendix A: the common information of every set of estimates.

Nodes are local estimates.  The parents of node (i, k+1) are (i, k) and every node that i received at step k; a node
comes with its whole pedigree.  What a pedigree, a set D of nodes closed under ancestors, is worth at the step t of its
latest node:

    fuse(D) = Σ over non-empty T ⊆ max(D) of (−1)^(|T|+1) · [ fuse(∩ anc(s), s ∈ T) brought forward to t ]

where max(D) are the nodes of D without a descendant in D and fuse of one node's pedigree is that node's information.
This is the six-step search of section 2.4 with the three valuation rules of appendix A: one common node is brought
forward; several of one step are fused there and then brought forward; several of different steps are brought to the
latest one's step, fused, and brought forward.  Agent i's fused estimate is fuse of everything that it knows.  Delayed
and out-of-order messages need nothing new.

Departures from the source.  The search is written on pedigrees (bit masks) instead of the pointers of figures 6–15;
equal intersections are counted together before anything is evaluated, which is how (19) becomes (20).

Which states behave alike.  A later search only meets nodes that are maximal in an intersection of two or more
pedigrees: of agents, of messages under way, or of nodes met before.  (The maximal elements of a union of pedigrees are
among the maximal elements of each, so that intersections of two suffice.)  `GraphExchange.after` drops all other
nodes, forgets who made the rest (their value says all that is used), and takes like agents in one order.  The order is
a relabelling of the true state whatever it is, so that states found equal are; the property tests compare with plain
enumeration.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from stochfuse.errors import TooManyError
from stochfuse.estimators.layers import GraphLayer, GraphState, HeldEstimate, reachable
from stochfuse.estimators.ledger import COMMON, Ledger
from stochfuse.estimators.protocol import AdditiveLayer, FusionRule, Late, best_relabelling


class Pedigrees:
    """Nodes with their ancestors, and what any set of them is worth.

    Parameters
    ----------
    ledger : where values are written.
    values : value of each node.
    below : pedigree of each node, itself included, as a mask; every ancestor has a smaller number, and steps never
        fall.
    older : pedigrees that have the first nodes in common with these, so that what is known of them holds here.

    Attributes
    ----------
    most : intersections that searches may go through from here on; then TooManyError is raised.
    """

    def __init__(
        self, ledger: Ledger, values: Sequence[int], below: Sequence[int], older: Pedigrees | None = None
    ) -> None:
        self.ledger, self.values, self.below, self._older = ledger, values, below, older
        self._new = 1 << len(older.values) if older else 0
        self._known: dict[int, int] = {}
        self.most = sys.maxsize

    def maximal(self, mask: int) -> Iterator[int]:
        """Nodes of a mask without a descendant in it, latest first."""
        while mask:
            top = mask.bit_length() - 1
            yield top
            mask &= ~self.below[top]

    def terms(self, mask: int) -> dict[int, int]:
        """Inclusion–exclusion (1) over the maximal nodes: the coefficient of every intersection."""
        terms: dict[int, int] = {}
        for top in self.maximal(mask):
            if len(terms) > self.most:
                raise TooManyError("common information: more intersections of pedigrees than are gone through")
            below = self.below[top]
            found = [(below, 1)]
            found += [(other & below, -times) for other, times in terms.items() if other & below]
            for shared, times in found:
                terms[shared] = terms.get(shared, 0) + times
        self.most -= len(terms)
        return terms

    def fuse(self, mask: int) -> int:
        """Value of a pedigree at its latest node's step."""
        if mask < self._new and self._older:
            return self._older.fuse(mask)
        known = self._known.get(mask)
        if known is None:
            top = mask.bit_length() - 1
            if mask == self.below[top]:
                known = self.values[top]
            else:
                terms = [(self.fuse(shared), times) for shared, times in self.terms(mask).items() if times]
                known = self.ledger.combine(self.ledger.step[self.values[top]], terms)
            self._known[mask] = known
        return known

    def know(self, mask: int, value: int) -> None:
        """Remember what a pedigree is worth, so that no search goes below it."""
        self._known[mask] = value


class LocalFusionGraph(FusionRule):
    """The estimator; parameters are those of `FusionRule`."""

    removes, additive = True, True

    def start(self) -> GraphState:
        """Everyone's initial estimate; a shared one is a common ancestor of all."""
        if self.shared:
            root = self.ledger.start(COMMON)
            return GraphState(((root, 1),), tuple(HeldEstimate(root, 1) for _ in self.sources))
        return GraphState((), tuple(HeldEstimate(self.ledger.start(source), 0) for source in self.sources))

    def exchange(self, state: GraphState) -> GraphExchange:
        """Open the exchange of the state's step."""
        values, below = [value for value, _ in state.nodes], [below for _, below in state.nodes]
        return GraphExchange(self, Pedigrees(self.ledger, values, below), state.agents, state.late)

    def together(self, states: Sequence[GraphState]) -> AdditiveLayer | None:
        """Open the exchanges of many states, where they can stand in arrays."""
        return GraphLayer(self, states) if GraphLayer.fits(self, states) else None

    def rests_on(self, state: GraphState) -> Iterator[int]:
        """Values that a state rests on."""
        yield from (value for value, _ in state.nodes)
        yield from (agent.value for agent in state.agents)

    def renamed(self, state: GraphState, names: Mapping[int, int], into: LocalFusionGraph) -> GraphState:
        """Return the state with the numbers that another one of these has for its values."""
        nodes = tuple((names[value], below) for value, below in state.nodes)
        agents = tuple(agent._replace(value=names[agent.value]) for agent in state.agents)
        return state._replace(nodes=nodes, agents=agents)


class GraphExchange:
    """One exchange: the agents' nodes are numbered after the older ones."""

    def __init__(
        self,
        estimator: LocalFusionGraph,
        older: Pedigrees,
        agents: Sequence[HeldEstimate],
        late: Sequence[tuple[int, int, int]] = (),
        *,
        keep: bool = False,
    ) -> None:
        self.estimator, self.late = estimator, late
        first = len(older.values)
        self.current = [agent.known | 1 << first + i for i, agent in enumerate(agents)]
        self.pedigrees = Pedigrees(
            estimator.ledger,
            [*older.values, *(agent.value for agent in agents)],
            [*older.below, *self.current],
            older if keep else None,
        )
        self._unions: dict[int, int] = {}
        self._due = [0] * len(agents)
        for receiver, left, mask in late:
            if left == 0:
                self._due[receiver] |= mask

    def common(self, clauses: Sequence[int]) -> int:
        """Value of what agents that heard those sets have in common, −1 if nothing."""
        mask = -1
        for heard in clauses:
            mask &= self.mask(heard)
        return self.pedigrees.fuse(mask) if mask else -1

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value that an agent claims after hearing some agents, with what else is due."""
        return self.pedigrees.fuse(self.known(agent, heard[agent]))

    def known(self, agent: int, heard: int) -> int:
        """Pedigree of an agent after hearing some agents, with what else is due."""
        return self.mask(heard) | self._due[agent]

    def mask(self, heard: int) -> int:
        """Union of the pedigrees of some agents."""
        known = self._unions.get(heard)
        if known is None:
            known = 0
            for i, current in enumerate(self.current):
                if heard >> i & 1:
                    known |= current
            self._unions[heard] = known
        return known

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[GraphState, tuple[int, ...]]:
        """State before the next exchange, in the order that like states share, and the agent at each place of it."""
        return self._merged(*self._next(heard, late, missed))

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> GraphExchange:
        """Open the next exchange as it comes, with every node kept."""
        agents, waiting = self._next(heard, late, missed)
        under_way = [(receiver, left, mask) for (receiver, left), mask in waiting.items()]
        return GraphExchange(self.estimator, self.pedigrees, agents, under_way, keep=True)

    def _next(
        self, heard: Sequence[int], late: Sequence[Late], missed: int
    ) -> tuple[list[HeldEstimate], dict[tuple[int, int], int]]:
        known = [self.known(i, h) for i, h in enumerate(heard)]
        local, fuse = self.estimator.ledger.local, self.pedigrees.fuse
        agents = [
            HeldEstimate(local(fuse(mask), s), mask) for s, mask in zip(self.estimator.seen(missed), known, strict=True)
        ]
        waiting: dict[tuple[int, int], int] = {}
        if late or self.late:
            under_way = [(r, left - 1, mask) for r, left, mask in self.late if left > 0]
            under_way += [(m.receiver, m.delay - 1, self.current[m.sender]) for m in late]
            for receiver, left, mask in under_way:
                if mask & ~known[receiver]:  # what is known already will change nothing
                    waiting[receiver, left] = waiting.get((receiver, left), 0) | mask
        return agents, waiting

    def _merged(
        self, agents: Sequence[HeldEstimate], waiting: dict[tuple[int, int], int]
    ) -> tuple[GraphState, tuple[int, ...]]:
        kept = 0
        for mask in waiting.values():  # a message's own node is met when it arrives
            for node in self.pedigrees.maximal(mask):
                kept |= 1 << node
        kept = reachable(self.pedigrees.below, [*(agent.known for agent in agents), *waiting.values()], kept)
        nodes = [node for node in range(kept.bit_length()) if kept >> node & 1]
        ledger, n = self.estimator.ledger, len(agents)
        values, below, step, moved = self.pedigrees.values, self.pedigrees.below, ledger.step, ledger.moved
        held = [[i for i, agent in enumerate(agents) if agent.known >> node & 1] for node in nodes]
        carried = [
            tuple(sorted((r, left) for (r, left), mask in waiting.items() if mask >> node & 1)) if waiting else ()
            for node in nodes
        ]
        # ancestors first: an earlier step, or fewer ancestors within one; in one number, which is compared at once
        rank = [
            ((step[values[node]] << 16 | (below[node] & kept).bit_count()) << 32 | ledger.invariant(values[node])) << n
            for node in nodes
        ]
        theirs: list[list[int]] = [[] for _ in agents]
        for place, holders in enumerate(held):
            for i in holders:
                theirs[i].append(rank[place] | len(holders))
        invariants = [
            (ledger.invariant(agent.value), sorted(theirs[i]), sorted(left for r, left in waiting if r == i))
            for i, agent in enumerate(agents)
        ]
        best: tuple[GraphState, tuple[int, ...]] | None = None
        for order in best_relabelling(invariants, self.estimator.relabellings):
            bit, place_of = [0] * n, [0] * n
            for place, i in enumerate(order):
                place_of[i], bit[i] = place, 1 << place
            who = [rank[p] | sum([bit[i] for i in holders]) for p, holders in enumerate(held)]
            keys: list[Any] = who
            if waiting:
                keys = [
                    (w, tuple(sorted((place_of[r], left) for r, left in c))) for w, c in zip(who, carried, strict=True)
                ]
            sequence = _sequence(keys, nodes, below)
            new = {nodes[p]: 1 << place for place, p in enumerate(sequence)}
            state = GraphState(
                tuple([(moved(values[nodes[p]], order), _moved(below[nodes[p]] & kept, new)) for p in sequence]),
                tuple(
                    [HeldEstimate(moved(agents[i].value, order), _moved(agents[i].known & kept, new)) for i in order]
                ),
                tuple(sorted((place_of[r], left, _moved(m & kept, new)) for (r, left), m in waiting.items())),
            )
            if best is None or state < best[0]:
                best = state, order
        if best is None:
            raise ValueError("no relabelling given")
        return best


def _sequence(keys: Sequence[Any], nodes: Sequence[int], below: Sequence[int]) -> list[int]:
    """Places of nodes in the order of their keys, equal ones by the keys of their ancestors and descendants."""
    places = range(len(keys))
    if len(set(keys)) == len(keys):
        return sorted(places, key=keys.__getitem__)
    kin = [
        (
            key,
            sorted([keys[q] for q in places if below[nodes[p]] >> nodes[q] & 1]),
            sorted([keys[q] for q in places if below[nodes[q]] >> nodes[p] & 1]),
        )
        for p, key in enumerate(keys)
    ]
    return sorted(places, key=kin.__getitem__)


def _moved(mask: int, new: dict[int, int]) -> int:
    """A mask's nodes by their new bits."""
    moved = 0
    while mask:
        top = mask.bit_length() - 1
        moved |= new[top]
        mask ^= 1 << top
    return moved
