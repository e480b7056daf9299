"""The Local Fusion Graph of many outcomes at a time: pedigrees as rows of latest steps.

A set of nodes that holds with each node its ancestors holds, of every agent, the nodes of its first steps: (j, s) has
(j, s − 1) among its parents, whatever was delayed, lost or not measured.  So it is a row of n small integers, the
latest step of each agent, 0 for none; an intersection is the elementwise minimum of two rows, a union the maximum.
With `shared`, one more column holds the common start.  Of many rows at once,

    max(D)     the latest node left in each row, until none is left that no pedigree of those before it covers
    terms      fuse(D) = Σ c_X · fuse(X) brought forward, over a family A_1 … A_m of pedigrees, the largest first:
               c(A_1 … A_m) = Σ_j [A_j] − c(the largest of A_1 ∩ A_j … A_{j−1} ∩ A_j), all sets and families at once;
               what lies in another of a family changes no union, so that most of these are of one intersection
    equal rows are one: the coefficients of equal intersections of a set are added up, and 0 goes
    numbers    the intersections of D are all of earlier steps than D, so that one stack after the other is summed up

Sets met before by the same run, whoever met them and when, are not gone through again.  A row is told by a hash of 64
bits, so that two rows are confused once in 10^19 pairs; among the intersections of one set by 51 of these bits.

The same numbers as those of `stochfuse.estimators.local_fusion_graph`, which writes down what it does before any number
is put in; here sums that cancel meet in floating point, which costs a few digits of the sixteen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stochfuse.errors import TooManyError
from stochfuse.estimators.ledger import COMMON, Sources, brought_forward, estimated, packed, unpacked
from stochfuse.estimators.protocol import StepOutcomes
from stochfuse.estimators.together import measured_too
from stochfuse.kalman.kernel import Estimate

AT_A_TIME, MOST_SETS = 1 << 22, 1 << 12
"""Bytes, about, of intersections, and sets, that are at hand at a time."""
TOLD = np.uint64(51)
"""Bits that tell the intersections of one set apart; the others number the sets."""
MOST_ROWS = 1 << 30
"""Bytes of intersections beyond which, gone through several times, a machine has too little memory."""

_RANDOM = np.random.default_rng(5).integers(1 << 64, size=(3, 1 << 13), dtype=np.uint64) | np.uint64(1)


class _Terms(NamedTuple):
    """Intersections in the sums of some sets.

    Parameters
    ----------
    of : number of the set, in order.
    times : coefficient.
    rows : latest steps.
    hashes : of the rows.
    """

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
        self._sizes = np.zeros((steps + 1) * items, dtype=np.intp)
        self._run = np.repeat(np.arange(runs), self.agents)
        self._known = np.zeros((items, width), kind)
        start = packed(sources.starts[0])
        self._room, self._number = np.zeros((2 * items, *start.shape)), 0
        self._steps = np.zeros(0, dtype=np.intp)
        self._found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
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
        self._sizes[step * len(rows) : (step + 1) * len(rows)] = _sizes(rows)
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
        for first, tops, of in self._in_parts(*self._maximal(rows, run * self.agents)):
            terms = self._terms(tops, of)
            term_runs = run[first + terms.of]
            term_keys = self._keys(terms.hashes, term_runs)
            one, which = _different(term_keys)
            different, levels = term_keys[one], terms.rows[one, : self.agents].max(axis=1).astype(np.intp)
            unknown = self._places(levels, different) < 0
            for below in np.flatnonzero(np.bincount(levels[unknown])).tolist():
                here = one[unknown & (levels == below)]
                wanted.setdefault(below, []).append((terms.rows[here], term_keys[here], term_runs[here]))
            ends = np.searchsorted(terms.of, np.arange(of[-1] + 2))
            yield _Sums(places[first : first + of[-1] + 1], ends, terms.times, which, levels, different)

    def _in_parts(self, tops: np.ndarray, of: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Maximal nodes of as many sets as are at hand at a time: number of the first set, nodes, numbers from there."""
        number = np.bincount(of)
        size = number * (number - 1) // 2 * self._known.strides[0]
        part = np.cumsum(np.maximum(size, AT_A_TIME // MOST_SETS)) // AT_A_TIME
        starts = np.flatnonzero(np.diff(part, prepend=-1))
        ends = np.cumsum(number)
        for first, beyond in pairwise([*starts.tolist(), len(number)]):
            some = slice(ends[first] - number[first], ends[beyond - 1])
            yield first, tops[some], of[some] - first

    def _terms(self, tops: np.ndarray, of: np.ndarray) -> _Terms:
        """Intersections of the pedigrees of sets' maximal nodes, the largest first, with coefficients.

        Parameters
        ----------
        tops : the nodes.
        of : number of the set that each is of, in order.
        """
        rows, family, sign = self._nodes.reshape(-1, self._nodes.shape[-1]).take(tops, axis=0), of, 1
        found = [(rows, of, np.ones(len(of), dtype=np.intp))]
        while True:
            sizes = np.bincount(family)
            before = np.arange(len(family)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
            family = np.repeat(np.arange(len(rows)), before)
            if not len(family):
                break
            if len(family) * rows.strides[0] > MOST_ROWS:
                raise self._too_many(int(np.bincount(of).max()), len(family))
            other = np.arange(len(family)) - np.repeat(np.cumsum(before) - before, before)
            other += (np.arange(len(rows)) - before).take(family)
            shared = np.minimum(rows.take(other, axis=0), rows.take(family, axis=0))
            largest = _largest(shared, family)
            rows, family = shared.take(largest, axis=0), family.take(largest)
            of, sign = of.take(family), -sign
            found.append((rows, of, np.full(len(of), sign)))
        return _together(*(np.concatenate(part) for part in zip(*found, strict=True)))

    def _maximal(self, sets: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes without a descendant in each set, the largest first, and the number of the set that each is of."""
        nodes = self._nodes.reshape(-1, sets.shape[1])
        left, found, of = sets.copy(), [], []
        active = np.arange(len(sets))
        while len(active):
            agent = left.argmax(axis=1)
            top = left[np.arange(len(active)), agent].astype(np.intp) * len(self._known) + base[active] + agent
            found.append(top)
            of.append(active)
            left *= nodes.take(top, axis=0) < sets[active]
            more = left.any(axis=1)
            left, active = left[more], active[more]
        tops, number = np.concatenate(found), np.concatenate(of)
        order = np.argsort((number << 32) - self._sizes.take(tops))
        return tops[order], number[order]

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


def _largest(rows: np.ndarray, family: np.ndarray) -> np.ndarray:
    """Rows that lie in no other of their family, one of equal ones and none that is empty: by family, largest first."""
    sizes = _sizes(rows)
    left, found = np.flatnonzero(sizes), [np.zeros(0, dtype=np.intp)]
    while len(left):
        starts = np.flatnonzero(np.diff(family.take(left), prepend=-1))
        # a largest one lies in no other
        found.append(np.maximum.reduceat(sizes.take(left) << 32 | left, starts) & (1 << 32) - 1)
        largest = np.repeat(found[-1], np.diff(starts, append=len(left)))
        some = rows.take(left, axis=0)
        beyond = _words(np.minimum(rows.take(largest, axis=0), some)) != _words(some)
        left = left[np.einsum("ij->i", beyond)]
    largest = np.concatenate(found)
    return largest[np.argsort(family[largest], kind="stable")]


def _sizes(rows: np.ndarray) -> np.ndarray:
    """Number of nodes in each set."""
    return np.einsum("ij->i", rows, dtype=np.uint32, casting="unsafe").astype(np.intp)


def _together(rows: np.ndarray, of: np.ndarray, times: np.ndarray) -> _Terms:
    """Terms of sets, of each set equal ones added up."""
    hashes = _hashes(_words(rows))
    keys = of.astype(np.uint64) << TOLD | hashes >> np.uint64(64) - TOLD
    order = np.argsort(keys)
    keys = keys.take(order)
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    total = np.add.reduceat(times.take(order), starts)
    kept = np.flatnonzero(total)
    one = order.take(starts.take(kept))
    return _Terms(of.take(one), total.take(kept), rows.take(one, axis=0), hashes.take(one))


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
    mixed = words * one
    mixed ^= mixed >> np.uint64(32)
    total = np.einsum("ij,j->i", mixed, other)
    total ^= total >> np.uint64(32)
    total *= _RANDOM[2, 2]
    return total
