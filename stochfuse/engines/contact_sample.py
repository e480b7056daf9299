"""The optimum of sampled outcomes, many at a time: any network, hundreds of agents.

In one outcome of which messages arrive the best that any linear fusion can do is one filter over all measurements whose
data came through.  With A_k the arrivals of step k, n×n zeros and ones (row: receiver, own entry 1), the sets of agents
whose step-t data the agents hold after step k are the rows of S_t(k),

    S_t(t) = A_t M_t      S_t(k) = A_k S_t(k−1)      (Boolean products; M_t: who measured at t, on the diagonal)

and the filter of agent i runs along its own sets, J_j = H_jᵀR_j⁻¹H_j of step t,

    P_1 = P(k0)/|S_1|        P_t = (I + P⁻J)⁻¹P⁻    P⁻ = F P_{t−1} Fᵀ + Q    J = Σ_{j∈S_t} J_j    t = 2 … k
    b_t = (I + P⁻J)⁻¹F b_{t−1}

A message sent at step s that arrives at k brings the rows that its sender had before its exchange at s.

What makes it fast.  Sets are rows of bits, 64 agents a word, so that a product is one OR for each arrival.  Steps whose
data everybody holds drop out of the products.  At every step an agent's filter is run again only from the first t on
whose set has grown.  Runs are followed in blocks that fit in memory, and blocks by processes; neither changes a number.

Random numbers are those of `stochfuse.engines.monte_carlo`: the same arrivals as of any other estimator.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.contact_chain import AlongPath, LosslessFilter
from stochfuse.engines.events import events
from stochfuse.engines.monte_carlo import (
    RunBlock,
    arrivals,
    blocks_of,
    fates_by_step,
    links_of,
    of_runs,
    quietly,
    stopped_together,
    stream,
)
from stochfuse.engines.precision import suspects
from stochfuse.estimators.progress import listener
from stochfuse.estimators.protocol import StepOutcomes
from stochfuse.kalman.kernel import Estimate, from_factor, taken_in
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.system import Noises, System

MOST_BYTES = 1 << 25
"""Memory that a block of runs takes at a time, about."""
MOST_COUNTED = 8
"""Kinds of sensors up to which the members of a set are counted by kind; beyond, their information is added up."""
MANY = 20_000_000
"""Events drawn, over all rows, from which on another process pays for its start."""
UNPACKED = 4096
"""Sets whose members are unpacked at a time."""
WORD = 64


class OptimumSample(NamedTuple):
    """The optimum of every sampled outcome.

    Parameters
    ----------
    P : (rows, runs, steps, agents, d, d) covariance, what the optimum claims and what it achieves.
    bias : (rows, runs, steps, agents, d, 1) what is left of the system's known initial error; None if there is none.
    heard : (rows, runs, steps, agents) how many agents' data of the step are held right after its exchange.
    """

    P: np.ndarray
    bias: np.ndarray | None
    heard: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean covariance, (rows, steps, agents, d, d)."""
        return self.P.mean(axis=1)

    @property
    def standard_error(self) -> np.ndarray:
        """Standard error of every entry of the mean, (rows, steps, agents, d, d)."""
        return self.P.std(axis=1, ddof=1) / np.sqrt(self.P.shape[1])


def sample_optimum(
    system: System,
    links: LinkRows,
    runs: int,
    seed: int,
    *,
    workers: int | None = None,
    most_bytes: int = MOST_BYTES,
    first: int = 0,
) -> OptimumSample:
    """Draw outcomes and follow the optimum in each.

    Parameters
    ----------
    links : rows of link probabilities, `runs` outcomes for each.
    runs, seed : size of the sample per row, and its seed; more runs of a seed begin with the fewer.
    workers : processes that share the work; default: one for small samples, else one per processor.
    most_bytes : memory that a block of runs may take; the sample does not depend on it.
    first : block of `stochfuse.engines.monte_carlo` that the sample begins with.

    Notes
    -----
    The system's agents track one state, with independent noises: see `stochfuse.scenario.capabilities`.
    """
    d, n, K, rows = system.dimension, system.agents, system.steps, len(links.link)
    P = np.empty((rows, runs, K, n, d, d))
    bias = None if system.error is None else np.empty((rows, runs, K, n, d, 1))
    heard = np.empty((rows, runs, K, n), np.uint16)
    size = max(1, most_bytes // _bytes_of_a_run(system))
    blocks = blocks_of(runs, n, rows, first)
    outcomes = _ContactOutcomes(system, links, seed)
    work = _ContactWork(outcomes, _Riccati(system), system, size)
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if rows * runs * sum(map(len, outcomes.events)) >= MANY else 1
    for done, (row, start, now, left, number) in enumerate(
        _all_followed(work, blocks, min(workers, len(blocks))), start=1
    ):
        P[row, start : start + len(now)] = now
        if bias is not None:
            bias[row, start : start + len(now)] = left
        heard[row, start : start + len(now)] = number
        listener().advance("sampling", done, len(blocks))
    return OptimumSample(P, bias, heard)


class _ContactWork(NamedTuple):
    """What a process needs to follow blocks of runs, so many runs at a time."""

    outcomes: _ContactOutcomes
    riccati: _Riccati
    system: System
    size: int

    def follow(self, block: RunBlock) -> tuple[int, int, np.ndarray, np.ndarray | None, np.ndarray]:
        """Row and first run of a block, covariances (runs, steps, agents, d, d), biases (…, d, 1), numbers heard."""
        runs, system = block.size, self.system
        P = np.empty((runs, system.steps, system.agents, system.dimension, system.dimension))
        bias = None if system.error is None else np.empty((*P.shape[:-1], 1))
        heard = np.empty(P.shape[:3], np.uint16)
        drawn = self.outcomes.of(block)
        for first in range(0, runs, self.size):
            part = slice(first, min(first + self.size, runs))
            steps = (of_runs(now, part, system.agents) for now in drawn)
            for k, (now, left, number) in enumerate(_followed(self.riccati, steps, part.stop - first, system.agents)):
                P[part, k], heard[part, k] = now, number
                if bias is not None:
                    bias[part, k] = left
        return block.row, block.first, P, bias, heard


def _all_followed(work: _ContactWork, blocks: Sequence[RunBlock], workers: int) -> Iterator[Any]:
    """Every block followed, in order: by processes that share them, or here."""
    if workers == 1:
        yield from map(work.follow, blocks)
        return
    with ProcessPoolExecutor(workers, initializer=_begin, initargs=(work,)) as pool, stopped_together():
        yield from pool.map(_follow, blocks)


_shared: list[_ContactWork] = []
"""What a process that follows blocks was started with: too large to be sent with every block."""


def _begin(work: _ContactWork) -> None:
    quietly()
    _shared[:] = [work]


def _follow(block: RunBlock) -> Any:
    return _shared[0].follow(block)


def _bytes_of_a_run(system: System) -> int:
    n, K, d = system.agents, system.steps, system.dimension
    sets = 8 * K * (-(-n // WORD)) * (2 + len(system.network.delay))
    return n * (sets + 8 * K * (d * d + d) + 40 * d * d)


# what becomes of messages and measurements


class _ContactOutcomes:
    """What outcomes are drawn from: those of `monte_carlo`, the same as of any other estimator."""

    def __init__(self, system: System, links: LinkRows, seed: int) -> None:
        steps = range(1, system.steps + 1)
        drawn = [events(system.network, links, step) for step in (steps if links.varies else steps[:1])]
        self.agents, self.seed = system.agents, seed
        self.events = drawn if links.varies else drawn * system.steps
        self.detections = [system.detections(step) for step in steps]
        self.links = links_of(self.events, system.agents)

    def of(self, block: RunBlock) -> list[StepOutcomes]:
        """What becomes of every step in the runs of a block."""
        random, size = stream(self.seed, block.row, block.number), (block.size, self.agents)
        drawn = fates_by_step(random, self.events, self.detections, size, block.row)
        return [arrivals(link, *now) for link, now in zip(self.links, drawn, strict=True)]


# whose measurements are held


def _followed(
    riccati: _Riccati, steps: Iterator[StepOutcomes], runs: int, agents: int
) -> Iterator[tuple[np.ndarray, np.ndarray | None, np.ndarray]]:
    """Covariance (runs, agents, d, d), bias (runs, agents, d, 1) and number heard (runs, agents) after every step.

    The sets of the steps from `low` on, the first whose data not everybody holds, are rows of words
    (runs·agents, steps, words); what they were before an exchange is kept as long as messages are under way.
    """
    own = _own_bits(agents)
    sets, low = np.zeros((runs * agents, 0, own.shape[1]), dtype=np.uint64), 0
    most: list[np.ndarray] = []
    before: list[tuple[int, np.ndarray]] = []
    schedule: list[list[tuple[np.ndarray, np.ndarray]]] = []
    filters = riccati.blank(runs * agents)
    for k, step in enumerate(steps):
        new = np.tile(own, (runs, 1))
        if step.missed is not None:
            new[step.missed.ravel()] = 0
        most.append(np.bitwise_or.reduce(new.reshape(runs, agents, -1), axis=1))
        held = np.concatenate([sets, new[:, None]], axis=1)
        before.append((low, held))
        schedule.append(step.arrived)
        sets = held.copy()
        for delay in range(min(k + 1, max(map(len, schedule)))):
            if delay < len(schedule[k - delay]):
                _joined(sets, low, before[k - delay], schedule[k - delay][delay])
        grown = _in_any_word(sets[:, :-1] != held[:, :-1])
        first = np.where(grown.any(axis=1), grown.argmax(axis=1) if grown.shape[1] else 0, k - low)
        yield *riccati.after(filters, sets, low, first, (runs, agents)), _members(sets[:, -1]).reshape(runs, agents)
        while sets.shape[1] and (sets[:, 0].reshape(runs, agents, -1) == most[low][:, None]).all():
            sets, low = sets[:, 1:], low + 1
        _forget(before, schedule, k)


def _in_any_word(words: np.ndarray) -> np.ndarray:
    """Whether any of the words on the last axis is true: few words, so that one after the other is fastest."""
    return np.logical_or.reduce([words[..., word] for word in range(words.shape[-1])])


def _members(sets: np.ndarray) -> np.ndarray:
    """Numbers of members of sets (..., words)."""
    total = np.zeros(sets.shape[:-1])
    for word in range(sets.shape[-1]):
        total += np.bitwise_count(sets[..., word])
    return total


def _own_bits(agents: int) -> np.ndarray:
    """Row of words of every agent that has its own bit alone, (agents, words)."""
    i = np.arange(agents)
    bits = np.zeros((agents, -(-agents // WORD)), dtype=np.uint64)
    bits[i, i // WORD] = np.uint64(1) << (i % WORD).astype(np.uint64)
    return bits


def _forget(before: list, schedule: list, k: int) -> None:
    """Let go of what no message under way brings any more."""
    longest = max(map(len, schedule))
    if k + 1 >= longest:
        gone = k + 1 - longest
        before[gone] = (0, np.empty((0, 0, 0), dtype=np.uint64))
        schedule[gone] = []


def _joined(sets: np.ndarray, low: int, sent: tuple[int, np.ndarray], pairs: tuple[np.ndarray, np.ndarray]) -> None:
    """Let receivers hold, in place, what senders held when they sent."""
    since, held = sent
    held = held[:, low - since :]
    receiver, sender = pairs
    if not held.shape[1] or not len(receiver):
        return
    starts = np.flatnonzero(np.diff(receiver, prepend=-1))
    number = np.diff(starts, append=len(receiver))
    # those that hear most come first: all that are left at every round are then the first so many
    order = np.argsort(-number, kind="stable")
    starts, rounds = starts[order], np.cumsum(np.bincount(number)[::-1])[::-1]
    flat = np.ascontiguousarray(held).reshape(len(held), -1)
    brought = flat.take(sender[starts], axis=0)
    for heard in range(1, len(rounds) - 1):
        brought[: rounds[heard + 1]] |= flat.take(sender[starts[: rounds[heard + 1]] + heard], axis=0)
    sets[receiver[starts], : held.shape[1]] |= brought.reshape(-1, *held.shape[1:])


# the filter along them


class _Kept(NamedTuple):
    """Filters after every step t, (steps, d, d, items); what is left of the known initial error, (steps, d, items)."""

    P: np.ndarray
    x: np.ndarray | None


class _Riccati:
    """The filter of an agent along its sets."""

    def __init__(self, system: System) -> None:
        self.system = system
        kinds, self.agents = np.array(system.sensor_of), system.agents
        J = [[s.H[t].T @ np.linalg.solve(s.R[t], s.H[t]) for s in system.sensors] for t in range(system.steps)]
        self.J = np.array(J)
        bits = _own_bits(system.agents)
        self.of_kind = np.array(
            [np.bitwise_or.reduce(bits[kinds == kind], axis=0) for kind in range(len(system.sensors))]
        )
        self.counted = len(system.sensors) <= MOST_COUNTED
        if not self.counted:
            self.J = self.J[:, kinds]
        self.lossless = LosslessFilter.of(system)
        self.precise = bool(suspects(system, Noises(P0=system.P0[None])).any())

    def blank(self, items: int) -> _Kept:
        """Room for the filters of so many agents."""
        d, K = self.system.dimension, self.system.steps
        return _Kept(np.empty((K, d, d, items)), None if self.system.error is None else np.empty((K, d, items)))

    def after(
        self, kept: _Kept, sets: np.ndarray, low: int, first: np.ndarray, shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Filters after a step, run again, in place, from the first set on that has grown.

        Parameters
        ----------
        sets : (items, steps, words) of the steps after `low` ones.
        first : (items,) place of the first of them that has grown.
        """
        for place in range(first.min(), sets.shape[1]):
            some = np.flatnonzero(first <= place)
            some = slice(None) if len(some) == len(first) else some
            self._advance(kept, some, sets[some, place], low + place)
        P, x = kept.P[low + sets.shape[1] - 1], None if kept.x is None else kept.x[low + sets.shape[1] - 1]
        d = len(P)
        P = np.moveaxis(P.reshape(d, d, *shape), (0, 1), (-2, -1))
        P = from_factor(P) if self._roots else P
        return P, None if x is None else np.moveaxis(x.reshape(d, 1, *shape), (0, 1), (-2, -1))

    def _advance(self, kept: _Kept, some: np.ndarray | slice, held: np.ndarray, t: int) -> None:
        """Filters of some items after step t + 1, from those after t, with the measurements of the agents held."""
        x, P = kept.x, kept.P
        if t == 0:
            start = self._start(_members(held))
        else:
            before = Estimate(None if x is None else x[t - 1][:, some], P[t - 1][..., some])
            start = self._in_roots(before, held, t) if self.precise else self._in_information(before, held, t)
        P[t][..., some] = start.P
        if x is not None:
            x[t][:, some] = start.x

    def _start(self, number: np.ndarray) -> Estimate:
        """First estimates, each from those of so many agents."""
        given = self.lossless
        P0 = given.numbers.factor(given.P0) if self._roots else given.P0
        number = np.ones_like(number) if given.shared else np.sqrt(number) if self._roots else number
        return Estimate(given.error, P0[..., None] / number)

    def _in_information(self, before: Estimate, held: np.ndarray, t: int) -> Estimate:
        F, Q, d = self.system.model.F[t], self.system.model.Q[t], self.system.dimension
        prior = (np.kron(F, F) @ before.P.reshape(d * d, -1)).reshape(before.P.shape) + Q[..., None]
        P, x = taken_in(prior, self._information(held, t), None if before.x is None else F @ before.x)
        return Estimate(x, P)

    def _in_roots(self, before: Estimate, held: np.ndarray, t: int) -> Estimate:
        x = None if before.x is None else before.x.T[..., None]
        counts = np.moveaxis(self._counts(held), 0, -1)
        found = self.lossless.after(AlongPath(x, np.moveaxis(before.P, -1, 0)), counts, t + 1)
        return Estimate(None if x is None else found.x[..., 0].T, np.moveaxis(found.root, 0, -1))

    @property
    def _roots(self) -> bool:
        """Whether square roots are kept in the place of covariances."""
        return self.precise and not self.lossless.scalar

    def _counts(self, held: np.ndarray) -> np.ndarray:
        """How many members of sets are of each kind, (kinds, items)."""
        return np.array([_members(held & mask) for mask in self.of_kind])

    def _information(self, held: np.ndarray, t: int) -> np.ndarray:
        """Σ of J_j over sets of agents, (d, d, items)."""
        J = self.J[t]
        flat = J.reshape(len(J), -1).T
        if self.counted:
            return (flat @ self._counts(held)).reshape(*J.shape[1:], -1)
        out = np.empty((len(flat), len(held)))
        for first in range(0, len(held), UNPACKED):
            words = np.ascontiguousarray(held[first : first + UNPACKED]).astype("<u8").view(np.uint8)
            members = np.unpackbits(words, axis=-1, bitorder="little")[:, : self.agents]
            out[:, first : first + UNPACKED] = flat @ members.T.astype(float)
        return out.reshape(*J.shape[1:], -1)
