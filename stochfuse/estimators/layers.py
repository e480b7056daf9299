"""The Local Fusion Graph of many states at a time, before any number is put in: what the enumeration carries onward.

The states of a layer stand in arrays, a row each: values of nodes, and their pedigrees as bits of one word, older
nodes first, the agents' own ones last.  Everything is done for all rows at once:

    fuse     intersections of pedigrees are words, told by (row, word); equal ones of a set are added up, and what the
             ledger writes is asked for once for every different sum, which its signature tells beforehand
    merge    the nodes that a later search can meet, an order of agents and nodes that like states share, and one state
             in the place of all that are equal in it

The answers are those of `stochfuse.estimators.local_fusion_graph`, which goes on with what does not fit: states with
messages under way, more nodes than a word has bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from stochfuse.estimators.ledger import Ledger, hashes, mapped, numbered
from stochfuse.estimators.protocol import FusionRule

MOST_NODES, MOST_STATES = 48, 1 << 14
"""Nodes of a state, and states, that are told by one word together."""
MOST_AGENTS, MOST_STEPS = 7, 1 << 8
"""Agents and steps of which nodes are told by one word."""
ROUNDS = 2
"""Times that nodes with equal keys are told by their kin, and by the kin of these."""
_LAST = np.iinfo(np.int64).max
_RANDOM = np.random.default_rng(7).integers(1 << 64, size=(2, 4), dtype=np.uint64) | np.uint64(1)


class HeldEstimate(NamedTuple):
    """An agent before an exchange: value of its local estimate and the pedigree it rests on, as a mask of nodes."""

    value: int
    known: int


class GraphState(NamedTuple):
    """What is known before an exchange.

    Parameters
    ----------
    nodes : value and pedigree (itself included) of every older node that can still matter, ancestors first.
    agents : one per agent.
    late : (receiver, steps until it arrives, pedigree) of messages under way.
    """

    nodes: tuple[tuple[int, int], ...]
    agents: tuple[HeldEstimate, ...]
    late: tuple[tuple[int, int, int], ...] = ()


class NaiveState(NamedTuple):
    """Before an exchange: the agents' local estimates, and (receiver, steps left, estimate) of messages under way."""

    agents: tuple[int, ...]
    late: tuple[tuple[int, int, int], ...] = ()


class GraphLayer:
    """Some states' exchanges, nothing under way.

    Parameters
    ----------
    estimator : whose states they are.
    states : at most `MOST_STATES`, of at most `MOST_NODES` nodes with those of the agents; see `fits`.
    """

    def __init__(self, estimator: FusionRule, states: Sequence[GraphState]) -> None:
        self.estimator, self.states, self.agents = estimator, states, len(estimator.sources)
        numbers = np.array([len(state.nodes) for state in states])
        self.first = int(numbers.max())
        shape = (len(states), self.first + self.agents)
        self.values, self.below = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
        older = np.arange(self.first) < numbers[:, None]
        nodes = _flat([state.nodes for state in states])
        self.values[:, : self.first][older], self.below[:, : self.first][older] = nodes.T
        agents = _flat([state.agents for state in states]).reshape(len(states), -1, 2)
        self.values[:, self.first :] = agents[..., 0]
        self.below[:, self.first :] = agents[..., 1] | 1 << self.first + np.arange(self.agents)

    @staticmethod
    def fits(estimator: FusionRule, states: Sequence[GraphState]) -> bool:
        """Whether the states can stand in arrays."""
        agents, step = len(estimator.sources), estimator.ledger.step[states[0].agents[0].value]
        most = max(len(state.nodes) for state in states) + agents
        small = len(states) <= MOST_STATES and most <= MOST_NODES and agents <= MOST_AGENTS and step < MOST_STEPS
        return small and not any(state.late for state in states)

    def commons(self, clauses: Sequence[Sequence[int]]) -> np.ndarray:
        """Values of what agents that heard some sets have in common, (states, sets of sets); −1 where it is nothing."""
        sets = sorted({heard for clause in clauses for heard in clause})
        masks = dict(zip(sets, self._masks(sets).T, strict=True))
        common = [np.bitwise_and.reduce([masks[heard] for heard in clause]) for clause in clauses]
        return self._fuse(np.stack(common, axis=1))

    def after(self, heard: np.ndarray, missed: np.ndarray) -> tuple[np.ndarray, list[GraphState]]:
        """Which state follows on each state and outcome, (states, outcomes), and these; see `AdditiveLayer`."""
        sets, index = np.unique(heard, return_inverse=True)
        index = index.reshape(heard.shape)
        masks = self._masks(sets.tolist())
        values = _locals(self.estimator, self._fuse(masks), index, missed)
        of = np.repeat(np.arange(len(self.states)), len(heard))
        known = masks[:, index].reshape(-1, self.agents)
        which, states = _Merging(self, of, known, values).merged()
        return which.reshape(len(self.states), -1), states

    def _masks(self, heard: Sequence[int]) -> np.ndarray:
        """Unions of the pedigrees of some sets of agents, (states, sets)."""
        own = self.below[:, self.first :]
        members = [[i for i in range(self.agents) if h >> i & 1] for h in heard]
        return np.stack([np.bitwise_or.reduce(own[:, some], axis=1) for some in members], axis=1)

    def _fuse(self, masks: np.ndarray) -> np.ndarray:
        """Values of pedigrees (states, any number), −1 for the empty one."""
        row, place = np.nonzero(masks)
        out = np.full(masks.shape, -1)
        out[row, place] = self._fused(row, masks[row, place])
        return out

    def _fused(self, row: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Values of pedigrees of some rows."""
        keys, which = np.unique(self._keys(row, mask), return_inverse=True)
        row, mask = keys >> self.below.shape[1], keys & (1 << self.below.shape[1]) - 1
        top = highest(mask)
        values = self.values[row, top]
        many = np.flatnonzero(mask != self.below[row, top])
        if len(many):
            of, shared, times = self._terms(row[many], mask[many])
            terms = self._fused(row[many][of], shared)
            values[many] = self.estimator.ledger.combined(values[many], of, terms, times)
        return values[which]

    def _terms(self, row: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inclusion–exclusion over the maximal nodes of sets: number of the set, intersection, coefficient."""
        of = shared = times = np.zeros(0, dtype=np.int64)
        left, active = mask.copy(), np.arange(len(mask))
        while len(active):
            below = np.zeros_like(mask)
            below[active] = self.below[row[active], highest(left[active])]
            left[active] &= ~below[active]
            both = shared & below[of]
            keys = np.concatenate(
                [self._keys(of, shared), self._keys(of[both > 0], both[both > 0]), self._keys(active, below[active])]
            )
            keys, place = np.unique(keys, return_inverse=True)
            counted = np.concatenate([times, -times[both > 0], np.ones(len(active), dtype=np.int64)])
            times = np.zeros(len(keys), dtype=np.int64)
            np.add.at(times, place, counted)
            keys, times = keys[times != 0], times[times != 0]
            of, shared = keys >> self.below.shape[1], keys & (1 << self.below.shape[1]) - 1
            active = active[left[active] != 0]
        return of, shared, times

    def _keys(self, row: np.ndarray, mask: np.ndarray) -> np.ndarray:
        return row << self.below.shape[1] | mask


class _Merging:
    """States after an exchange, in the order that like ones share.

    Parameters
    ----------
    of : row of each item's state in the layer.
    known, values : (items, agents) pedigree and value of every agent's next local estimate.
    """

    def __init__(self, layer: GraphLayer, of: np.ndarray, known: np.ndarray, values: np.ndarray) -> None:
        ledger, n = layer.estimator.ledger, layer.agents
        self.ledger, self.values = ledger, values
        self.permutations = np.array(layer.estimator.relabellings)
        below = layer.below[of]
        same, one = numbered(hashes(np.concatenate([np.sort(known, axis=1), below], axis=1)))
        structures = zip(below[one].tolist(), known[one].tolist(), strict=True)
        kept = np.array([reachable(*structure) for structure in structures])[same]
        bits = np.arange(layer.below.shape[1])
        self.known, self.kept = known & kept[:, None], kept[:, None] >> bits & 1 == 1
        self.nodes, self.below = layer.values[of], (below & kept[:, None]) * self.kept
        # ancestors first: an earlier step, or fewer ancestors within one
        rank = ledger.steps[self.nodes] << 6 | np.bitwise_count(self.below).astype(np.int64)
        self.rank = (rank << 32 | _invariants(ledger, self.nodes)) << n
        self.holders = self.known[:, None, :] >> bits[:, None] & 1
        self.most = int(self.kept.sum(axis=1).max())

    def merged(self) -> tuple[np.ndarray, list[GraphState]]:
        """Number of every item's state among the different ones, and these."""
        item, order = np.nonzero(self._candidates())
        places = np.argsort(self.permutations, axis=1)[order]
        who = self.rank[item] | (self.holders[item] << places[:, None, :]).sum(axis=-1)
        who[~self.kept[item]] = _LAST
        at = self._sequence(item, who)[:, : self.most]
        rows = self._rows(item, order, at)
        which, first = _one_of_each(item, rows)
        return which, _states([part[first] for part in rows])

    def _sequence(self, item: np.ndarray, who: np.ndarray) -> np.ndarray:
        """Nodes in the order of their keys, equal ones by the keys of their ancestors and descendants."""
        at = np.argsort(who, axis=1, kind="stable")
        found = np.take_along_axis(who, at, axis=1)
        same = np.flatnonzero(((found[:, 1:] == found[:, :-1]) & (found[:, 1:] < _LAST)).any(axis=1))
        above = self.below[item[same]][:, :, None] >> np.arange(who.shape[1]) & 1
        above = above.astype(np.uint64)
        kin = who[same].astype(np.uint64)
        for _ in range(ROUNDS):
            over = np.einsum("spq,sq->sp", above, mixed(kin, 0)) + np.einsum("spq,sp->sq", above, mixed(kin, 1))
            kin = mixed(over + mixed(kin, 2), 3)
        at[same] = np.lexsort((kin, who[same]))
        for _ in range(ROUNDS):  # what is alike still, by the places that its ancestors have now
            place = np.argsort(at[same], axis=1)
            by_place = np.einsum("spq,sq->sp", above, mixed(place, 0)) - mixed(place, 0)
            at[same] = np.lexsort((by_place, kin, who[same]))
        return at

    def _candidates(self) -> np.ndarray:
        """Relabellings that put the agents of each item into their least order, (items, relabellings)."""
        tokens = mixed(self.rank + self.holders.sum(axis=-1), 3)
        theirs = (self.holders.astype(np.uint64) * tokens[:, :, None]).sum(axis=1)
        return _least(mixed(theirs + mixed(_invariants(self.ledger, self.values), 2), 1), self.permutations)

    def _rows(self, item: np.ndarray, order: np.ndarray, at: np.ndarray) -> list[np.ndarray]:
        """Values and pedigrees of nodes, −1 and 0 beyond the last, and of agents, renamed."""
        taken, real = self.permutations[order], np.take_along_axis(self.kept[item], at, axis=1)
        nodes = np.where(real, np.take_along_axis(self.nodes[item], at, axis=1), -1)
        agents = np.take_along_axis(self.values[item], taken, axis=1)
        nodes, agents = (_moved(self.ledger, part, order, self.permutations) for part in (nodes, agents))
        below = np.where(real, np.take_along_axis(self.below[item], at, axis=1), 0)
        known = np.take_along_axis(self.known[item], taken, axis=1)
        return [nodes, _renumbered(below, at), agents, _renumbered(known, at)]


class NaiveLayer:
    """Some states' exchanges in naive fusion, nothing under way; see `GraphLayer`."""

    def __init__(self, estimator: FusionRule, states: Sequence[NaiveState]) -> None:
        self.estimator = estimator
        self.values = np.array([state.agents for state in states])

    def commons(self, clauses: Sequence[Sequence[int]]) -> np.ndarray:
        """Values of the sums of some sets of agents, (states, sets), each a clause of its own: nothing is common."""
        states, out = np.arange(len(self.values)), []
        for (h,) in clauses:
            members = [i for i in range(self.values.shape[1]) if h >> i & 1]
            terms, of = self.values[:, members].ravel(), np.repeat(states, len(members))
            ones = np.ones(len(terms), dtype=np.int64)
            out.append(self.estimator.ledger.combined(self.values[:, 0], of, terms, ones) if members[1:] else terms)
        return np.stack(out, axis=1)

    def after(self, heard: np.ndarray, missed: np.ndarray) -> tuple[np.ndarray, list[NaiveState]]:
        """Which state follows on each state and outcome, (states, outcomes), and these; see `AdditiveLayer`."""
        ledger, permutations = self.estimator.ledger, np.array(self.estimator.relabellings)
        sets, index = np.unique(heard, return_inverse=True)
        values = _locals(self.estimator, self.commons(sets[:, None].tolist()), index.reshape(heard.shape), missed)
        item, order = np.nonzero(_least(mixed(_invariants(ledger, values), 1), permutations))
        agents = np.take_along_axis(values[item], permutations[order], axis=1)
        agents = _moved(ledger, agents, order, permutations)
        which, first = _one_of_each(item, [agents])
        return which.reshape(len(self.values), -1), [NaiveState(tuple(row)) for row in agents[first].tolist()]


def _locals(estimator: FusionRule, unions: np.ndarray, index: np.ndarray, missed: np.ndarray) -> np.ndarray:
    """Values of the agents' next local estimates, (states · outcomes, agents).

    Parameters
    ----------
    unions : (states, sets) what is fused.
    index : (outcomes, agents) number of the set that each agent hears.
    missed : (outcomes,) agents whose sensors miss, as masks.
    """
    seen: list[int | None] = [*estimator.sources, *([None] if missed.any() else [])]
    local = {source: estimator.ledger.locals(unions, source) for source in dict.fromkeys(seen)}
    values = [local[source][:, index[:, i]] for i, source in enumerate(estimator.sources)]
    if missed.any():
        values = [np.where(missed >> i & 1, local[None][:, index[:, i]], own) for i, own in enumerate(values)]
    return np.stack(values, axis=-1).reshape(-1, len(values))


def _least(keys: np.ndarray, permutations: np.ndarray) -> np.ndarray:
    """Which permutations put rows of keys into their least order, (rows, permutations)."""
    least = np.ones((len(keys), len(permutations)), dtype=bool)
    for agent in permutations.T:
        theirs = keys[:, agent]
        least &= theirs == np.where(least, theirs, np.iinfo(np.uint64).max).min(axis=1)[:, None]
    return least


def _moved(ledger: Ledger, values: np.ndarray, order: np.ndarray, permutations: np.ndarray) -> np.ndarray:
    """Values (rows, any number) after the agents changed places, by each row's permutation."""
    out = np.empty_like(values)
    for number in np.unique(order).tolist():
        here, permutation = np.flatnonzero(order == number), tuple(permutations[number].tolist())
        out[here] = mapped(values[here], lambda some: [ledger.moved(value, permutation) for value in some])  # noqa: B023
    return out


def _invariants(ledger: Ledger, values: np.ndarray) -> np.ndarray:
    return mapped(values, lambda some: [ledger.invariant(value) for value in some])


def _one_of_each(item: np.ndarray, rows: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Number of every item's row among the different ones, and where one of each of these is.

    Of several rows of an item, which are next to each other, one that all items of a kind agree upon.
    """
    keys = hashes(np.concatenate(rows, axis=1))
    first = np.lexsort((keys[0], item))
    first = first[np.flatnonzero(np.diff(item[first], prepend=-1))]
    which, one = numbered(keys[:, first])
    return which, first[one]


def _states(rows: Sequence[np.ndarray]) -> list[GraphState]:
    numbers = (rows[0] >= 0).sum(axis=1).tolist()
    nodes, below, agents, known = (part.tolist() for part in rows)
    return [
        GraphState(tuple(zip(v[:m], b[:m], strict=True)), tuple(map(HeldEstimate, a, k)))
        for m, v, b, a, k in zip(numbers, nodes, below, agents, known, strict=True)
    ]


def reachable(below: Sequence[int], known: Sequence[int], kept: int = 0) -> int:
    """Nodes that a later search can meet: given ones, and the maximal ones of any two pedigrees' intersection.

    Parameters
    ----------
    below : pedigree of each node.
    known : pedigrees that a search can begin with.
    kept : nodes that it can meet whatever else it does.
    """
    done: set[int] = set()
    members = [*known, *(below[n] for n in range(kept.bit_length()) if kept >> n & 1)]
    i = 1
    while i < len(members):
        mask = members[i]
        for other in members[:i]:
            shared = mask & other
            if shared in done:
                continue
            done.add(shared)
            while shared:
                top = shared.bit_length() - 1
                if not kept >> top & 1:
                    kept |= 1 << top
                    members.append(below[top])
                shared &= ~below[top]
        i += 1
    return kept


def _renumbered(masks: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Masks (rows, any number) with node at[:, k] in the place of bit k."""
    out = np.zeros_like(masks)
    for place in range(at.shape[1]):
        out |= (masks >> at[:, place, None] & 1) << place
    return out


def _flat(pairs: Sequence[Sequence[tuple[int, int]]]) -> np.ndarray:
    """Pairs of whole numbers one after the other, (pairs, 2)."""
    return np.fromiter(chain.from_iterable(chain.from_iterable(pairs)), dtype=np.int64).reshape(-1, 2)


def highest(masks: np.ndarray) -> np.ndarray:
    """Number of the highest bit of masks that are not 0, of less than 53 bits."""
    return np.frexp(masks.astype(float))[1].astype(np.int64) - 1


def mixed(numbers: np.ndarray, way: int) -> np.ndarray:
    """Whole numbers scattered over 64 bits, in one of some ways."""
    out = numbers.astype(np.uint64) * _RANDOM[0, way]
    out ^= out >> np.uint64(32)
    out *= _RANDOM[1, way]
    return out ^ out >> np.uint64(29)
