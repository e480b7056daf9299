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
from itertools import islice
from typing import NamedTuple

import numpy as np

from stochfuse.errors import TooManyError
from stochfuse.estimators.ledger import COMMON, Sources, brought_forward, estimated, packed, unpacked
from stochfuse.estimators.protocol import StepOutcomes
from stochfuse.estimators.together import measured_too
from stochfuse.kalman.kernel import Estimate

LISTED = 4
"""Maximal nodes of a set of which all intersections are listed before equal ones are put together."""
AT_A_TIME, MOST_SETS = 1 << 16, 1 << 13
"""Terms, about, and sets that are at hand at a time."""
TOLD = np.uint64(51)
"""Bits that tell the intersections of one set apart; the others number the sets."""
MOST_ROWS = 1 << 30
"""Bytes of intersections beyond which, gone through several times, a machine has too little memory."""
NARROW = 8
"""Words of a row up to which they are gone through one by one."""

_RANDOM = np.random.default_rng(5).integers(1 << 64, size=(3, 1 << 13), dtype=np.uint64) | np.uint64(1)


class _Terms(NamedTuple):
    """Intersections in the sums of some sets.

    Parameters
    ----------
    keys : number of the set, and from the bit `TOLD` down a hash of the intersection; sorted.
    times : coefficient.
    rows : latest steps.
    """

    keys: np.ndarray
    times: np.ndarray
    rows: np.ndarray

    @property
    def of(self) -> np.ndarray:
        """Number of the set."""
        return (self.keys >> TOLD).astype(np.intp)


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
    steps : number of steps.
    runs : number of outcomes.
    """

    def __init__(self, sources: Sources, of: Sequence[int], shared: bool, steps: int, runs: int) -> None:
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
        self._each: dict[int, float] = {}
        self._fused = np.zeros(items, dtype=np.intp)
        if shared:
            self._known[:, self.agents] = 1
            first = self._known[:: self.agents]
            common = packed(sources.starts[COMMON])
            self._add(0, self._keys(_hashes(_words(first)), np.arange(runs)), np.repeat(common[None], runs, axis=0))
        self._step, self._schedule = 0, []

    @property
    def size(self) -> int:
        """Numbers held of every run, about."""
        return self._room.size // self.runs + self._nodes.size // (8 * self.runs)

    @property
    def _values(self) -> np.ndarray:
        return self._room[: self._number]

    def exchange(self, now: StepOutcomes) -> tuple[Estimate, np.ndarray]:
        """Estimates after the next step's exchange, and which of them each agent has, (runs, agents)."""
        self._step += 1
        self._locals(now.missed)
        self._schedule.append(now.arrived)
        self._hear()
        keys = self._keys(_hashes(_words(self._known)), self._run)
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
            measured_too(values, self.sources, self.of, step, missed)
        self._add(step, self._keys(_hashes(_words(rows)), self._run), values)

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
                rows_now, keys_now, run_now = (np.concatenate(column) for column in zip(*some, strict=True))
                sums.append(list(self._summed(level, rows_now, keys_now, run_now, wanted)))
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
        tops, number = self._maximal(rows, run * self.agents)
        for heard in np.flatnonzero(np.bincount(number)).tolist():
            members = np.flatnonzero(number == heard)
            begin = 0
            while begin < len(members):
                # as many as are expected to make so many terms, judged by the last ones
                each = self._each.get(heard) or max(2.0 ** min(heard, LISTED), 3.0 * self._each.get(heard - 1, 1.0))
                some = members[begin : begin + min(MOST_SETS, int(AT_A_TIME / each) + 1)]
                begin += len(some)
                terms = self._terms(tops[:heard, some])
                of = terms.of
                self._each[heard] = max(len(of) / len(some), 2.0 ** min(heard, LISTED))
                term_keys = self._keys(_hashes(_words(terms.rows)), run[some][of])
                first, which = _different(term_keys)
                different, levels = term_keys[first], terms.rows[first, : self.agents].max(axis=1).astype(np.intp)
                unknown = self._places(levels, different) < 0
                for below in np.flatnonzero(np.bincount(levels[unknown])).tolist():
                    here = first[unknown & (levels == below)]
                    wanted.setdefault(below, []).append((terms.rows[here], term_keys[here], run[some][of[here]]))
                ends = np.searchsorted(of, np.arange(len(some) + 1))
                yield _Sums(places[some], ends, terms.times, which, levels, different)

    def _terms(self, tops: np.ndarray) -> _Terms:
        """Intersections of the pedigrees of sets' maximal nodes (number, sets), latest first, with coefficients."""
        nodes = _words(self._nodes).reshape(-1, self._nodes.shape[-1] * self._nodes.itemsize // 8)
        # the small pedigrees first: what they leave is soon alike
        brought = (nodes.take(top, axis=0).view(self._nodes.dtype) for top in tops[::-1])
        terms = _listed(list(islice(brought, LISTED)))
        for each in brought:
            terms = _joined(terms, each)
            if terms.rows.nbytes > MOST_ROWS:
                raise self._too_many(len(tops), len(terms.keys))
        return terms

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
        for level in np.flatnonzero(np.bincount(levels)).tolist():
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
            f"{2.0**heard:.3g} intersections of what they rest on, of each set of them that somebody has in common; "
            f"{found:,} take {MOST_ROWS / 2**30:.3g} GiB already. Expected links by which fewer are heard, or "
            "--method optimal, --method simplified, or --method monte-carlo --estimator optimal"
        )


def _listed(tops: Sequence[np.ndarray]) -> _Terms:
    """Terms of sets with few maximal nodes: every intersection, then equal ones together."""
    rows, times = tops[0][None], np.ones(1, dtype=np.intp)
    for each in tops[1:]:
        rows = np.concatenate([rows, np.minimum(rows, each), each[None]])
        times = np.concatenate([times, -times, [1]])
    sets = np.arange(len(tops[0]))
    return _together(
        _words(rows.reshape(-1, rows.shape[-1])), np.repeat(times, len(sets)), np.tile(sets, len(times)), rows.dtype
    )


def _joined(terms: _Terms, tops: np.ndarray) -> _Terms:
    """Terms of sets with one maximal node more each."""
    of = terms.of
    shared = _words(np.minimum(terms.rows, _words(tops).take(of, axis=0).view(tops.dtype)))
    rows = np.concatenate([_words(terms.rows), shared, _words(tops)])
    times = np.concatenate([terms.times, -terms.times, np.ones(len(tops), dtype=np.intp)])
    return _together(rows, times, np.concatenate([of, of, np.arange(len(tops))]), tops.dtype)


def _together(words: np.ndarray, times: np.ndarray, of: np.ndarray, kind: np.dtype) -> _Terms:
    """Terms of sets, of each set equal ones added up."""
    keys = of.astype(np.uint64) << TOLD | _hashes(words) >> np.uint64(64) - TOLD
    order = np.argsort(keys)
    keys = keys.take(order)
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    total, keys = np.add.reduceat(times.take(order), starts), keys.take(starts)
    # where nothing is shared the hash is 0
    kept = np.flatnonzero((total != 0) & (keys << np.uint64(64) - TOLD != 0))
    rows = words.take(order.take(starts.take(kept)), axis=0).view(kind)
    return _Terms(keys.take(kept), total.take(kept), rows)


def _different(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where one of each of the different keys is, in their order, and the number of every key among them."""
    order = np.argsort(keys)
    sorted_keys = keys[order]
    new = np.concatenate([[True], sorted_keys[1:] != sorted_keys[:-1]])
    which = np.empty(len(keys), dtype=np.intp)
    which[order] = np.cumsum(new) - 1
    return order[new], which


def _words(rows: np.ndarray) -> np.ndarray:
    """Rows of latest steps in words of 64 bits, that move and compare faster."""
    return np.ascontiguousarray(rows).view(np.uint64)


def _hashes(words: np.ndarray) -> np.ndarray:
    """One number of 64 bits for every row of words, 0 for the empty one."""
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
