"""Rules of fusion for many outcomes at a time, numbers and all: naive fusion, intersections, no fusion.

Estimates are stacks with a row for every run and agent; what arrives is a list of rows.  Naive fusion adds up rows, one
sparse product for all; intersections take rows that fuse equally many in one stack.  Late messages are brought forward
while they are under way.  In an intersection the estimates stand in the order of the agents, late ones after them: it
decides only where several weights are equally good.

The Local Fusion Graph is in `stochfuse.estimators.pedigrees`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stochfuse.estimators.ledger import COMMON, Sources, brought_forward, estimated, packed, unpacked
from stochfuse.estimators.protocol import StepOutcomes
from stochfuse.estimators.recursion import FusionStep, RecursiveEstimator, Worked, worked_out
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.metrics import Moments

MOST_NUMBERS = 1 << 24
"""Numbers that are gathered at a time to be fused."""
Pairs = tuple[np.ndarray, np.ndarray]
"""Rows of receivers and of senders."""


class NaiveTogether:
    """Naive fusion of some runs; see `stochfuse.estimators.protocol.Together`.

    Parameters
    ----------
    sources : what starts and measurements are worth.
    of : source of every agent.
    shared : whether all agents start from one common estimate.
    runs : number of outcomes.
    """

    def __init__(self, sources: Sources, of: Sequence[int], shared: bool, runs: int) -> None:
        self.sources, self.of, self.runs, self._step = sources, of, runs, 0
        starts = [packed(sources.starts[COMMON if shared else each]) for each in of]
        self._values = np.tile(np.stack(starts), (runs, 1, 1))
        self._late: list[tuple[np.ndarray, list[Pairs]]] = []

    @property
    def size(self) -> int:
        """Numbers held of every run, about."""
        return (3 + 2 * len(self._late)) * self._values.size // self.runs

    def exchange(self, now: StepOutcomes) -> tuple[Estimate, np.ndarray]:
        """Estimates after the next step's exchange, and which of them each agent has, (runs, agents)."""
        from scipy.sparse import csr_array

        self._step += 1
        if self._step > 1:
            self._values = brought_forward(self._values, self.sources, self._step)
            measured_too(self._values, self.sources, self.of, self._step, now.missed)
            self._late = [(brought_forward(v, self.sources, self._step), left) for v, left in self._late]
        self._late.append((self._values, list(now.arrived)))
        fused = self._values.copy()
        for values, left in self._late:
            receiver, sender = left.pop(0)
            ones = np.ones(len(receiver))
            matrix = csr_array((ones, (receiver, sender)), shape=(len(fused), len(fused)))
            fused += (matrix @ values.reshape(len(fused), -1)).reshape(fused.shape)
        self._late = [(values, left) for values, left in self._late if left]
        self._values = fused
        which = np.arange(len(fused)).reshape(self.runs, -1)
        return estimated(unpacked(fused, self.sources), self._step)[0], which


def measured_too(values: np.ndarray, sources: Sources, of: Sequence[int], step: int, missed: np.ndarray | None) -> None:
    """Add to the information (runs · agents, …) of every run's agents, in place, what they measure at a step.

    Parameters
    ----------
    of : source of every agent.
    missed : (runs, agents) whose sensors miss, or None if nobody's.
    """
    kinds = sorted(set(of))
    seen = np.stack([packed(sources.measured(step, kind)) for kind in kinds])[np.searchsorted(kinds, of)]
    by_run = values.reshape(-1, *seen.shape)
    by_run += seen if missed is None else seen * ~missed[:, :, None, None]


class PastsTogether:
    """An estimator that remembers pasts, for some runs; see `stochfuse.estimators.protocol.Together`.

    Parameters
    ----------
    estimator : one whose agents track one state by one model, and fuse by its `gathers` or not at all.
    runs : number of outcomes.
    """

    def __init__(self, estimator: RecursiveEstimator, runs: int) -> None:
        self.estimator, self.runs, self._step = estimator, runs, 0
        world = estimator.world
        first = [estimator.first(rows) for rows in world.states]
        self._label = np.tile(estimator.labels, runs)
        self._now = Worked(
            *(None if p[0] is None else np.tile(np.concatenate(p), (runs, 1, 1)) for p in zip(*first, strict=True))
        )
        self._late: list[tuple[Worked, list[Pairs]]] = []

    @property
    def size(self) -> int:
        """Numbers held of every run, about."""
        held = sum(part.size for part in self._now if part is not None)
        return (3 + 2 * len(self._late)) * held // self.runs

    def exchange(self, now: StepOutcomes) -> tuple[Estimate | Moments, np.ndarray]:
        """Estimates after the next step's exchange, and which of them each agent has, (runs, agents)."""
        self._step += 1
        if self._step > 1:
            self._now = self._onward(self._now, now.missed)
            none = np.ones((self.runs, len(self._label) // self.runs), dtype=bool)
            self._late = [(self._onward(sent, none), left) for sent, left in self._late]
        if self.estimator.gathers is not None:
            self._late.append((self._now, list(now.arrived)))
            self._now = self._fused([(sent, left.pop(0)) for sent, left in self._late])
            self._late = [(sent, left) for sent, left in self._late if left]
        which = np.arange(len(self._label)).reshape(self.runs, -1)
        settled = self._now.settled()
        if settled.actual is None:
            return Estimate(None, settled.P), which
        return Moments.of(settled.P, settled.actual, settled.bias), which

    def _onward(self, before: Worked, missed: np.ndarray | None) -> Worked:
        """Estimates of the next step: predicted, and measured where no sensor misses."""
        missing = np.zeros(len(self._label), dtype=bool) if missed is None else missed.ravel()
        rules: list[FusionStep] = []
        rows: list[np.ndarray] = []
        for label in np.unique(self._label).tolist():
            for name, some in (("local", ~missing), ("forward", missing)):
                here = np.flatnonzero((self._label == label) & some)
                if len(here):
                    rules.append((name, label))
                    rows.append(here)
        parts = [self._worked(rule, [_taken(before, here)]) for rule, here in zip(rules, rows, strict=True)]
        return _filled(before, rows, parts)

    def _fused(self, arrived: list[tuple[Worked, Pairs]]) -> Worked:
        """Fuse the rows that are heard; the last of what arrived was sent now."""
        own = self._now
        items, agents = len(self._label), len(self._label) // self.runs
        everyone = np.arange(items)
        receiver = [everyone, *(pairs[0] for _, pairs in arrived)]
        sender = [everyone, *(pairs[1] for _, pairs in arrived)]
        late = np.repeat(np.arange(len(receiver) - 1, -1, -1), [len(r) for r in receiver])
        late[:items] = 0  # the own estimate stands among those that were sent now
        receiver, sender = np.concatenate(receiver), np.concatenate(sender)
        order = np.lexsort((sender % agents, late, receiver))
        receiver, sender, late = receiver[order], sender[order], late[order]
        pool = [sent for sent, _ in reversed(arrived)]
        first, number = np.searchsorted(receiver, everyone), np.bincount(receiver, minlength=items)
        per_row = sum(part[0].size for part in own if part is not None)
        rows, parts = [], []
        for heard in np.unique(number[number > 1]).tolist():
            members = np.flatnonzero(number == heard)
            size = max(1, MOST_NUMBERS // (heard * per_row))
            for begin in range(0, len(members), size):
                some = members[begin : begin + size]
                places = [first[some] + place for place in range(heard)]
                rests_on = [_of_pool(pool, late[place], sender[place]) for place in places]
                rows.append(some)
                parts.append(self._worked((self.estimator.gathers,), rests_on))
        return _filled(own, rows, parts)

    def _worked(self, rule: FusionStep, rests_on: list[Worked]) -> Worked:
        return worked_out(self.estimator, self._step, [rule], rests_on)


def _taken(worked: Worked, rows: np.ndarray) -> Worked:
    return Worked(*(None if part is None else part.take(rows, axis=0) for part in worked))


def _of_pool(pool: Sequence[Worked], number: np.ndarray, rows: np.ndarray) -> Worked:
    """Rows of several stacks, each of the one with its number."""
    found = _taken(pool[0], rows)
    for other in range(1, len(pool)):
        here = np.flatnonzero(number == other)
        if len(here):
            found = _filled(found, [here], [_taken(pool[other], rows[here])])
    return found


def _filled(before: Worked, rows: Sequence[np.ndarray], parts: Sequence[Worked]) -> Worked:
    """Return stacks with some rows replaced; what a rule says nothing of, the independent part, is nothing there."""
    out = Worked(*(None if part is None else part.copy() for part in before))
    for here, part in zip(rows, parts, strict=True):
        for whole, new in zip(out, part, strict=True):
            if whole is not None:
                whole[here] = 0.0 if new is None else np.broadcast_to(new, (len(here), *whole.shape[1:]))
    return out
