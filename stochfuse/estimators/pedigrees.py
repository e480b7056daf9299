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
bits, so that two rows are confused once in 10^19 pairs.

Where sets meet in pairs alone the rule subtracts more than there is: four sets of three starts each, every two with one
in common, leave 4 (f(3/P0) + J) − 6 f(1/P0) with f(Y) = Y/(1 + QY), −23/175 at P0 = 1, Q = 9, R = 100.  Not rounding,
and refused: dense networks of twenty agents and two states meet it in nearly every outcome.

The same numbers as those of `stochfuse.estimators.local_fusion_graph`, which writes down what it does before any number
is put in; here sums that cancel meet in floating point, which costs a few digits of the sixteen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, TooManyError
from stochfuse.estimators.ledger import COMMON, Sources, brought_forward, estimated, hashes, numbered, packed, unpacked
from stochfuse.estimators.protocol import StepOutcomes
from stochfuse.estimators.together import measured_too
from stochfuse.kalman.kernel import Estimate

AT_A_TIME = 1 << 22
"""Bytes, about, of intersections that are at hand at a time."""
MOST_ROWS = 1 << 30
"""Bytes of intersections beyond which, gone through several times, a machine has too little memory."""
DOUBTFUL = 1e-9
"""Eigenvalue of information, relative to the largest there is, that may be rounding."""

_RUN, _MIX = np.random.default_rng(5).integers(1 << 64, size=2, dtype=np.uint64) | np.uint64(1)


class _Sums(NamedTuple):
    """Σ times · value over the terms of some sets.

    Parameters
    ----------
    places : of the sets.
    terms : places of the different intersections.
    times : coefficients, a sparse matrix (sets, different intersections).
    """

    places: np.ndarray
    terms: np.ndarray
    times: Any


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
        self._steps, self._of_run = np.zeros((2, len(self._room)), dtype=np.intp)
        self._found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._fused = np.zeros(items, dtype=np.intp)
        if shared:
            self._known[:, self.agents] = 1
            keys = self._keys(self._known[:: self.agents], np.arange(runs))
            places, _ = self._placed(np.zeros(runs, dtype=np.intp), keys, np.arange(runs))
            self._values[places] = packed(sources.starts[COMMON])
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
        keys = self._keys(self._known, self._run)
        which, first = numbered(keys[None])
        places = self._valued(keys[first], self._known[first], self._run[first])
        self._fused = places[which]
        try:
            claimed, _ = estimated(unpacked(self._values[places], self.sources), self._step)
        except NoAnswerError:
            raise self._indefinite(self._values[places], places, self._step, first % self.agents) from None
        return claimed, which.reshape(self.runs, self.agents)

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
        keys = self._keys(rows, self._run)
        places, _ = self._placed(np.full(len(keys), step), keys, self._run)
        self._values[places] = values

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

    def _valued(self, keys: np.ndarray, rows: np.ndarray, run: np.ndarray) -> np.ndarray:
        """Places of the values of some different sets of the step now, by their keys."""
        places, new = self._placed(np.full(len(keys), self._step), keys, run)
        wanted = {self._step: [(places[new], rows[new], run[new])]}
        sums = [list(self._summed(wanted.pop(level), wanted)) for level in range(self._step, 0, -1) if level in wanted]
        for some in reversed(sums):
            if some:
                self._evaluate(some)
        return places

    def _summed(self, some: list[tuple[np.ndarray, ...]], wanted: dict[int, list]) -> Iterator[_Sums]:
        """Sums of new sets of a level, given by place, row and run; asks for the new sets that these rest on."""
        from scipy.sparse import coo_array

        places, rows, run = (np.concatenate(column) for column in zip(*some, strict=True))
        if not len(places):
            return
        for first, tops, of in self._in_parts(*self._maximal(rows, run * self.agents)):
            sets, shared, times = self._terms(tops, of)
            run_of = run.take(first + sets)
            keys = self._keys(shared, run_of)
            which, one = numbered(keys[None])
            matrix = coo_array((times, (sets, which)), shape=(of[-1] + 1, len(one))).tocsr()
            matrix.eliminate_zeros()
            used = np.bincount(matrix.indices, minlength=len(one)) > 0
            matrix.indices = (np.cumsum(used) - 1)[matrix.indices]
            one = one[used]
            levels = shared[one, : self.agents].max(axis=1).astype(np.intp)
            terms, new = self._placed(levels, keys[one], run_of[one])
            for level in np.flatnonzero(np.bincount(levels[new])).tolist():
                here = new[levels[new] == level]
                wanted.setdefault(level, []).append((terms[here], shared[one[here]], run_of[one[here]]))
            yield _Sums(places[first : first + of[-1] + 1], terms, matrix)

    def _in_parts(self, tops: np.ndarray, of: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Maximal nodes of as many sets as are at hand at a time: first set, nodes, numbers of sets from there."""
        number = np.bincount(of)
        part = np.cumsum(number * number // 2 * self._known.strides[0]) // AT_A_TIME
        starts = np.flatnonzero(np.diff(part, prepend=-1))
        ends = np.cumsum(number)
        for first, beyond in pairwise([*starts.tolist(), len(number)]):
            some = slice(ends[first] - number[first], ends[beyond - 1])
            yield first, tops[some], of[some] - first

    def _terms(self, tops: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersections of the pedigrees of sets' maximal nodes: number of the set, row, and coefficient.

        Parameters
        ----------
        tops : the nodes, the largest first.
        of : number of the set that each is of, in order.
        """
        rows, family, sign = self._nodes.reshape(-1, self._nodes.shape[-1]).take(tops, axis=0), of, 1
        found = [(of, rows, np.ones(len(of)))]
        while True:
            sizes = np.bincount(family)
            before = np.arange(len(family)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
            family = np.repeat(np.arange(len(rows)), before)
            if not len(family):
                sets, intersections, times = zip(*found, strict=True)
                return np.concatenate(sets), np.concatenate(intersections), np.concatenate(times)
            if len(family) * rows.strides[0] > MOST_ROWS:
                raise self._too_many(int(np.bincount(found[0][0]).max()), len(family))
            other = np.arange(len(family)) - np.repeat(np.cumsum(before) - before, before)
            other += (np.arange(len(rows)) - before).take(family)
            shared = np.minimum(rows.take(other, axis=0), rows.take(family, axis=0))
            largest = _largest(shared, family)
            rows, family = shared.take(largest, axis=0), family.take(largest)
            of, sign = of.take(family), -sign
            found.append((of, rows, np.full(len(of), float(sign))))

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
            more = np.einsum("ij->i", _words(left) != 0)
            left, active = left[more], active[more]
        tops, number = np.concatenate(found), np.concatenate(of)
        order = np.argsort((number << 32) - self._sizes.take(tops))
        return tops[order], number[order]

    def _evaluate(self, sums: Sequence[_Sums]) -> None:
        """Sum up the values of the sets of one level."""
        from scipy.sparse import csr_array

        different, which = np.unique(np.concatenate([each.terms for each in sums]), return_inverse=True)
        values = self._brought(different, int(self._steps[sums[0].places[0]])).reshape(len(different), -1)
        begin = 0
        for places, terms, times in sums:
            columns = which[begin : begin + len(terms)][times.indices]
            begin += len(terms)
            matrix = csr_array((times.data, columns, times.indptr), shape=(len(places), len(different)))
            self._values[places] = (matrix @ values).reshape(-1, *self._values.shape[1:])

    def _brought(self, places: np.ndarray, step: int) -> np.ndarray:
        """Values brought forward to a step, in the order of their places."""
        since = self._steps[places]
        out = self._values[places]
        for now in range(int(since.min(initial=step)), step):
            some = since <= now
            try:
                out[some] = brought_forward(out[some], self.sources, now + 1)
            except NoAnswerError:
                raise self._indefinite(out[some], places[some], now) from None
        return out

    def _keys(self, rows: np.ndarray, run: np.ndarray) -> np.ndarray:
        """Tell rows apart, and those of different runs."""
        return (hashes(_words(rows), 1)[0] ^ (run.astype(np.uint64) * _RUN)) * _MIX

    def _placed(self, levels: np.ndarray, keys: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places of the values of different sets, given by level, key and run; and which of them are new."""
        out, new = np.empty(len(keys), dtype=np.intp), []
        for level in np.flatnonzero(np.bincount(levels)).tolist():
            here = np.flatnonzero(levels == level)
            here = here[np.argsort(keys[here])]
            if level not in self._found:
                self._found[level] = np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.intp)
            (known, places), keys_now = self._found[level], keys[here]
            at = np.searchsorted(known, keys_now)
            within = np.minimum(at, len(known) - 1)
            unknown = np.flatnonzero(known[within] != keys_now) if len(known) else np.arange(len(here))
            fresh = np.arange(self._number, self._number + len(unknown))
            if len(known):
                out[here] = places[within]
            out[here[unknown]] = fresh
            at = at[unknown]
            self._found[level] = np.insert(known, at, keys_now[unknown]), np.insert(places, at, fresh)
            self._open(max(level, 1), run[here[unknown]])
            new.append(here[unknown])
        return out, np.concatenate([np.zeros(0, dtype=np.intp), *new])

    def _open(self, step: int, run: np.ndarray) -> None:
        """Make room for some values more of a step, each of a run."""
        first, self._number = self._number, self._number + len(run)
        if self._number > len(self._room):
            more = max(self._number, len(self._room) * 3 // 2) - len(self._room)
            self._room = np.concatenate([self._room, np.empty((more, *self._room.shape[1:]))])
            self._steps, self._of_run = (
                np.concatenate([each, np.empty(more, dtype=np.intp)]) for each in (self._steps, self._of_run)
            )
        self._steps[first : self._number], self._of_run[first : self._number] = step, run

    def _indefinite(
        self, values: np.ndarray, places: np.ndarray, step: int, agents: np.ndarray | None = None
    ) -> NoAnswerError:
        """What to say of information that is not positive definite, of agents or of what several have in common."""
        Y = unpacked(values, self.sources).Y
        unit = np.sqrt(np.abs(np.diagonal(Y, axis1=-2, axis2=-1)).max(axis=0).clip(1e-300))
        least = np.linalg.eigvalsh(Y / np.outer(unit, unit))[:, 0]
        worst = int(least.argmin())
        whose = "shared by several agents" if agents is None else f"of agent {agents[worst] + 1}"
        why = "the Local Fusion Graph's own answer" if least[worst] < -DOUBTFUL else "singular to rounding"
        return NoAnswerError(
            f"at step {step} the information {whose} is not positive definite ({why}: where many sets meet in pairs, "
            "what is taken for common exceeds what is known), and no covariance follows. Expected links by which fewer "
            "are heard, another estimator, --method optimal or --method simplified",
            [int(self._of_run[places[worst]])],
        )

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
        of = family.take(left)
        starts = np.flatnonzero(np.concatenate([[True], of[1:] != of[:-1]]))
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


def _words(rows: np.ndarray) -> np.ndarray:
    """Rows of latest steps in words of 64 bits, that move and compare faster."""
    return np.ascontiguousarray(rows).view(np.uint64)
