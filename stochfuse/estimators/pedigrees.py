"""The Local Fusion Graph of many outcomes at a time: pedigrees as rows of latest steps.

A set of nodes that holds with each node its ancestors holds, of every agent, the nodes of its first steps: (j, s) has
(j, s − 1) among its parents, whatever was delayed, lost or not measured.  So it is a row of n small integers, the
latest step of each agent, 0 for none; an intersection is the elementwise minimum of two rows, a union the maximum.
With `shared`, one more column holds the common start.  Of many rows at once,

    max(D)     the latest node left in each row, until none is left that no pedigree of those before it covers
    terms      fuse(D) = Σ c_X · fuse(X) brought forward:  c ← c + [top] − c ∩ top, a node at a time, for all rows
    equal rows are one: the coefficients of equal intersections of a set are added up, and 0 goes
    numbers    the intersections of D are all of earlier steps than D, so that one stack after the other is summed up

Sets met before by the same run, whoever met them and when, are not gone through again.  A row is told by a hash of 64
bits, so that two rows are confused once in 10^19 pairs; among the intersections of one set by 51 of these bits.

The same numbers as those of `stochfuse.estimators.local_fusion_graph`, which writes down what it does before any number
is put in; here sums that cancel meet in floating point, which costs a few digits of the sixteen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.errors import TooManyError
from stochfuse.estimators.ledger import COMMON, Sources, brought_forward, estimated, packed, unpacked
from stochfuse.estimators.protocol import Arrivals
from stochfuse.kalman.kernel import Estimate

AT_A_TIME = 4096
"""Sets of which intersections are sought at a time, at most 2^13."""
CACHED = 1 << 23
"""Bytes of rows that these sets are expected to take."""
MOST_ROWS = 1 << 31
"""Bytes of intersections of the sets at hand beyond which a machine has too little memory."""
NARROW = 8
"""Words of a row up to which they are gone through one by one."""

_RANDOM = np.random.default_rng(5).integers(1 << 64, size=(3, 1 << 13), dtype=np.uint64) | np.uint64(1)


class _Terms(NamedTuple):
    """Intersections in the sums of some sets: of which set, sorted; coefficient; and rows with their hashes."""

    of: np.ndarray
    times: np.ndarray
    rows: np.ndarray
    hashes: np.ndarray


class _Sums(NamedTuple):
    """Σ times · value over the terms of some sets.

    Parameters
    ----------
    places : of the sets.
    first : where the terms of each begin, and where all end.
    times : coefficient of each term.
    which : of each term, the number of its intersection among the different ones.
    levels, keys : latest step and key of the different ones.
    """

    places: np.ndarray
    first: np.ndarray
    times: np.ndarray
    which: np.ndarray
    levels: np.ndarray
    keys: np.ndarray


class GraphTogether:
    """The Local Fusion Graph of some runs; see `stochfuse.estimators.protocol.Together`.

    Parameters
    ----------
    sources : what starts and measurements are worth.
    of : source of every agent.
    shared : whether all agents start from one common estimate.
    runs : number of outcomes.
    steps : number of steps.
    """

    def __init__(self, sources: Sources, of: Sequence[int], shared: bool, runs: int, steps: int) -> None:
        self.sources, self.of, self.runs, self.agents = sources, of, runs, len(of)
        kind = np.uint8 if steps < 256 else np.uint16
        size = 8 // np.dtype(kind).itemsize
        width = -(-(self.agents + shared) // size) * size
        items = runs * self.agents
        self._nodes = np.zeros((steps + 1, items, width), kind)
        self._run = np.repeat(np.arange(runs), self.agents)
        self._known = np.zeros((items, width), kind)
        start = packed(sources.starts[0])
        self._room, self._number = np.zeros((2 * items, *start.shape)), 0
        self._steps = np.zeros(0, dtype=np.intp)
        self._found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._fused = np.zeros(items, dtype=np.intp)
        self._most = 1.0
        if shared:
            self._known[:, self.agents] = 1
            first = self._known[:: self.agents]
            common = packed(sources.starts[COMMON])
            self._add(0, self._keys(_hashes(first), np.arange(runs)), np.repeat(common[None], runs, axis=0))
        self._step, self._schedule = 0, []

    @property
    def size(self) -> int:
        """Numbers held of every run, about."""
        return self._room.size // self.runs + self._nodes.size // (8 * self.runs)

    @property
    def _values(self) -> np.ndarray:
        return self._room[: self._number]

    def exchange(self, now: Arrivals) -> tuple[Estimate, np.ndarray]:
        """Estimates after the next step's exchange, and which of them each agent has, (runs, agents)."""
        self._step += 1
        self._locals(now.missed)
        self._schedule.append(now.arrived)
        self._hear()
        keys = self._keys(_hashes(self._known), self._run)
        first, which = _different(keys)
        places = self._valued(self._known[first], keys[first], self._run[first])
        self._fused = places[which]
        claimed = unpacked(self._values[places], self.sources)
        return estimated(claimed, self._step)[0], which.reshape(self.runs, self.agents)

    def _locals(self, missed: np.ndarray | None) -> None:
        """Open the nodes of a step: a pedigree and a local estimate each."""
        step, everyone = self._step, np.arange(len(self._known))
        rows = self._nodes[step]
        rows[:] = self._known
        rows[everyone, everyone % self.agents] = step
        if step == 1:
            values = np.tile(np.stack([packed(self.sources.starts[of]) for of in self.of]), (self.runs, 1, 1))
        else:
            different, which = np.unique(self._fused, return_inverse=True)
            values = self._brought(different, step)[which]
            kinds = sorted(set(self.of))
            seen = np.stack([packed(self.sources.measured(step, of)) for of in kinds])
            kind_of = np.tile(np.searchsorted(kinds, self.of), self.runs)
            if missed is None:
                values += seen[kind_of]
            else:
                there = ~missed.ravel()
                values[there] += seen[kind_of[there]]
        self._add(step, self._keys(_hashes(rows), self._run), values)

    def _hear(self) -> None:
        """Let everyone know what the nodes that arrive rest on."""
        known = self._nodes[self._step].copy()
        for delay in range(self._step):
            arrived = self._schedule[self._step - 1 - delay]
            if delay < len(arrived) and len(arrived[delay][0]):
                receiver, sender = arrived[delay]
                starts = np.flatnonzero(np.diff(receiver, prepend=-1))
                brought = np.maximum.reduceat(self._nodes[self._step - delay].take(sender, axis=0), starts, axis=0)
                known[receiver[starts]] = np.maximum(known[receiver[starts]], brought)
        self._known = known

    def _valued(self, rows: np.ndarray, keys: np.ndarray, run: np.ndarray) -> np.ndarray:
        """Places of the values of some different sets of the step now."""
        wanted = {self._step: [(rows, keys, run)]}
        sums: list[list[_Sums]] = []
        for level in range(self._step, 0, -1):
            some = wanted.pop(level, [])
            if some:
                sums.append(list(self._summed(level, *(np.concatenate(c) for c in zip(*some, strict=True)), wanted)))
        for level_sums in reversed(sums):
            if level_sums:
                self._evaluate(level_sums)
        return self._places(np.full(len(keys), self._step), keys)

    def _summed(
        self, level: int, rows: np.ndarray, keys: np.ndarray, run: np.ndarray, wanted: dict[int, list]
    ) -> Iterator[_Sums]:
        """Sums of the sets of a level that are new; asks for the new sets that these rest on."""
        first, _ = _different(keys)
        first = first[self._places(np.full(len(first), level), keys[first]) < 0]
        rows, keys, run = rows[first], keys[first], run[first]
        places = self._add(level, keys, 0.0)
        size = int(max(1, min(AT_A_TIME, CACHED // (rows.shape[1] * rows.itemsize * self._most))))
        for begin in range(0, len(rows), size):
            some = slice(begin, begin + size)
            order, terms = self._terms(rows[some], run[some])
            self._most = max(len(terms.of) / len(order), 1.0)
            of_run = run[some][order][terms.of]
            term_keys = self._keys(terms.hashes, of_run)
            first, which = _different(term_keys)
            different = term_keys[first]
            levels = terms.rows[first][:, : self.agents].max(axis=1).astype(np.intp)
            unknown = self._places(levels, different) < 0
            for below in np.unique(levels[unknown]).tolist():
                here = first[unknown & (levels == below)]
                wanted.setdefault(below, []).append((terms.rows[here], term_keys[here], of_run[here]))
            ends = np.searchsorted(terms.of, np.arange(len(order) + 1))
            yield _Sums(places[some][order], ends, terms.times, which, levels, different)

    def _terms(self, sets: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, _Terms]:
        """Intersections of the maximal nodes' pedigrees with their coefficients, and the order of the sets in them."""
        tops, number = self._maximal(sets, run * self.agents)
        order = np.argsort(-number, kind="stable")
        tops, number = tops[:, order], number[order]
        nodes = _words(self._nodes).reshape(-1, _words(sets).shape[1])
        terms = _no_terms(sets)
        finished: list[_Terms] = []
        for each in tops:
            active = len(order) if each[-1] >= 0 else int(np.argmax(each < 0))
            end = int(np.searchsorted(terms.of, active))
            if end < len(terms.of):
                finished.append(_Terms(*(part[end:] for part in terms)))
                terms = _Terms(*(part[:end] for part in terms))
            terms = _joined(terms, nodes.take(each[:active], axis=0).view(sets.dtype))
            if terms.rows.nbytes > MOST_ROWS:
                raise self._too_many(int(number[terms.of[-1]]), len(terms.of))
        parts = [terms, *reversed(finished)]
        return order, _Terms(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _maximal(self, sets: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes without a descendant in each set, latest first, (most, sets), −1 where there is none; and how many."""
        nodes = self._nodes.reshape(-1, sets.shape[1])
        left, found = sets.copy(), []
        everyone, active = np.arange(len(sets)), np.arange(len(sets))
        number = np.zeros(len(sets), dtype=np.intp)
        while len(active):
            agent = left.argmax(axis=1)
            top = left[everyone[: len(active)], agent].astype(np.intp) * len(self._known) + base[active] + agent
            found.append(np.full(len(sets), -1))
            found[-1][active] = top
            number[active] += 1
            left *= nodes.take(top, axis=0) < sets[active]
            more = left.any(axis=1)
            left, active = left[more], active[more]
        return np.array(found), number

    def _evaluate(self, sums: Sequence[_Sums]) -> None:
        """Sum up the values of the sets of one level."""
        from scipy.sparse import csr_array

        places = [self._places(each.levels, each.keys) for each in sums]
        different, which = np.unique(np.concatenate(places), return_inverse=True)
        step = int(self._steps[sums[0].places[0]])
        values = self._brought(different, step).reshape(len(different), -1)
        begin = 0
        for each, some in zip(sums, places, strict=True):
            here = which[begin : begin + len(some)][each.which]
            begin += len(some)
            matrix = csr_array((each.times.astype(float), here, each.first), shape=(len(each.places), len(different)))
            self._values[each.places] = (matrix @ values).reshape(-1, *self._values.shape[1:])

    def _brought(self, places: np.ndarray, step: int) -> np.ndarray:
        """Values brought forward to a step, in the order of their places."""
        since = self._steps[places]
        out = self._values[places]
        for now in range(int(since.min(initial=step)), step):
            some = since <= now
            out[some] = brought_forward(out[some], self.sources, now + 1)
        return out

    def _keys(self, hashes: np.ndarray, run: np.ndarray) -> np.ndarray:
        """Tell rows of different runs apart."""
        return (hashes ^ (run.astype(np.uint64) * _RANDOM[2, 0])) * _RANDOM[2, 1]

    def _places(self, levels: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """Where the values of sets stand, −1 where a set is new."""
        out = np.full(len(keys), -1, dtype=np.intp)
        for level in np.unique(levels).tolist():
            if level in self._found:
                known, places = self._found[level]
                here = np.flatnonzero(levels == level)
                at = np.searchsorted(known, keys[here])
                at[at == len(known)] = 0
                out[here] = np.where(known[at] == keys[here], places[at], -1)
        return out

    def _add(self, level: int, keys: np.ndarray, values: np.ndarray | float) -> np.ndarray:
        """Places of new sets of a level, with their values."""
        places = np.arange(self._number, self._number + len(keys))
        self._number += len(keys)
        if self._number > len(self._room):
            room = np.empty((max(self._number, len(self._room) * 3 // 2), *self._room.shape[1:]))
            room[: places[0]] = self._room[: places[0]]
            self._room = room
        self._room[places] = values
        if level in self._found:
            known, before = self._found[level]
            keys_now, places_now = np.concatenate([known, keys]), np.concatenate([before, places])
        else:
            keys_now, places_now = keys, places
        order = np.argsort(keys_now)
        self._found[level] = keys_now[order], places_now[order]
        self._steps = np.concatenate([self._steps, np.full(len(keys), max(level, 1))])
        return places

    def _too_many(self, heard: int, found: int) -> TooManyError:
        return TooManyError(
            f"step {self._step}: the common information of {heard} received estimates is made of up to 2^{heard} = "
            f"{2.0**heard:.3g} intersections of what they rest on, and {found:,} of them take "
            f"{MOST_ROWS / 2**30:.3g} GiB already: use --method optimal, or --method monte-carlo of the optimum, "
            "--method simplified, or links by which fewer are heard"
        )


def _no_terms(sets: np.ndarray) -> _Terms:
    none = np.zeros(0, dtype=np.intp)
    return _Terms(none, none, sets[:0], none.astype(np.uint64))


def _joined(terms: _Terms, tops: np.ndarray) -> _Terms:
    """Terms of sets with one maximal node more each."""
    width = tops.shape[1]
    shared = np.minimum(terms.rows, _words(tops).take(terms.of, axis=0).view(tops.dtype).reshape(-1, width))
    of = np.concatenate([terms.of, terms.of, np.arange(len(tops))])
    times = np.concatenate([terms.times, -terms.times, np.ones(len(tops), dtype=terms.times.dtype)])
    new = np.concatenate([shared, tops])
    hashes = np.concatenate([terms.hashes, _hashes(new)])
    keys = of.astype(np.uint64) << np.uint64(51) | hashes >> np.uint64(13)
    order = np.argsort(keys)
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    total = np.add.reduceat(times[order], starts)
    first = order[starts]
    kept = (total != 0) & (hashes[first] != 0)  # nothing shared has the hash 0
    first, total = first[kept], total[kept]
    rows = np.concatenate([_words(terms.rows), _words(new)]).take(first, axis=0).view(tops.dtype)
    return _Terms(of[first], total, rows, hashes[first])


def _different(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where one of each of the different keys is, in their order, and the number of every key among them."""
    order = np.argsort(keys)
    sorted_keys = keys[order]
    new = np.concatenate([[True], sorted_keys[1:] != sorted_keys[:-1]])
    which = np.empty(len(keys), dtype=np.intp)
    which[order] = np.cumsum(new) - 1
    return order[new], which


def _words(rows: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rows).view(np.uint64)


def _hashes(rows: np.ndarray) -> np.ndarray:
    """One number of 64 bits for every row, 0 for the empty one."""
    words = _words(rows)
    one, other = _RANDOM[:2, : words.shape[1]]
    half = np.uint64(32)
    if words.shape[1] > NARROW:
        mixed = words * one
        mixed ^= mixed >> half
        mixed *= other
        total = mixed.sum(axis=1)
    else:
        total = np.zeros(len(words), dtype=np.uint64)
        for column, a, b in zip(words.T, one, other, strict=True):
            mixed = column * a
            mixed ^= mixed >> half
            mixed *= b
            total += mixed
    total ^= total >> half
    total *= _RANDOM[2, 2]
    return total
