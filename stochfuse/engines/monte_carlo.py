"""Monte Carlo: draw the events, evaluate the estimator, average.  The cross-check; it imports no other engine.

Runs with equal histories are evaluated once: at every step runs are gathered by (state, what arrived), and states
that will behave alike are taken together while that saves work.  Random numbers are drawn in blocks, each with its own
seed, so that the sample depends on the seed alone and not on the number of workers.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from itertools import pairwise, repeat
from math import log2
from multiprocessing import active_children
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.events import ChanceEvent
from stochfuse.errors import NoAnswerError
from stochfuse.estimators.progress import listener, uncollected
from stochfuse.estimators.protocol import Claims, Estimator, Exchange, Late, StepOutcomes, Together
from stochfuse.kalman.kernel import Estimate
from stochfuse.scenario.system import Detection

BLOCK, MOST_OF_BLOCK = 1000, 60
"""Runs drawn from one seed, of networks of at most so many agents; see `blocks_of`."""
MOST_BLOCKS = 50
"""Blocks that a process has in hand at a time."""
MOST_TOGETHER, MOST_NUMBERS = 200, 1 << 26
"""Runs that are followed at a time, and numbers that are held for them."""
DRAWN = 1 << 20
"""Random numbers that are drawn at a time."""
MERGE_BELOW = 0.2
"""Different histories per run up to which states are merged: beyond, nearly every run goes its own way."""


class Experiment(NamedTuple):
    """What is sampled; can be sent to another process.

    Parameters
    ----------
    agents : number of agents.
    events : events of every step.
    detections : draws of what is measured at every step.
    make : makes the estimator, and what to call for its numbers once all runs have been followed.
    of : makes what is kept of every estimate, a named tuple of arrays or Nones, of a stack of estimates.
    runs, seed : size of the sample per row, and its seed.
    first : block that the sample begins with: those before are of an earlier sample that this one goes on with.
    together : makes what follows so many runs at a time in the estimator's place; None where histories are gathered.
    """

    agents: int
    events: list[list[ChanceEvent]]
    detections: list[list[Detection]]
    make: Callable[[], tuple[Estimator, Callable[[], Claims]]]
    of: Callable[[Estimate], Any]
    runs: int
    seed: int
    first: int = 0
    together: Callable[[int], Together] | None = None


class RunBlock(NamedTuple):
    """Runs drawn from one seed.

    Parameters
    ----------
    row : of link probabilities.
    number : of the block among the row's.
    first : number of its first run among the row's.
    size : how many runs it has.
    runs : those of them that are meant.
    """

    row: int
    number: int
    first: int
    size: int
    runs: range


class Sample(NamedTuple):
    """What is kept of the estimates of every run.

    Parameters
    ----------
    values : named tuple of arrays (values, …), the different ones.
    which : (rows, runs, steps, agents) which of them each agent has, −1 at steps to which a run was not followed.
    """

    values: Any
    which: np.ndarray

    def followed(self, step: int) -> np.ndarray | slice:
        """Runs that were followed to a step, counted from 0: the same of every row."""
        there = self.which[0, :, step, 0] >= 0
        return slice(None) if there.all() else there


def sample(experiment: Experiment, rows: int, *, workers: int = 1) -> Sample:
    """Draw `runs` histories for every row.

    Parameters
    ----------
    workers : processes that share the work; the sample does not depend on them.
    """
    blocks = blocks_of(experiment.runs, experiment.agents, rows, experiment.first)
    if experiment.together is not None:  # outcomes are dear, and to draw a block's again is not
        pieces = -(-workers // len(blocks))
        blocks = [piece for block in blocks for piece in _split(block, pieces)]
    # few large parts: the more runs a process has in hand, the more histories it meets twice
    share = min(MOST_BLOCKS, max(1, -(-len(blocks) // max(1, workers))))
    parts = [blocks[first : first + share] for first in range(0, len(blocks), share)]
    index = np.empty((rows, experiment.runs, len(experiment.events), experiment.agents), np.int32)
    values: list[Any] = []
    pool: Any = (
        ProcessPoolExecutor(min(workers, len(parts)), initializer=quietly)
        if min(workers, len(parts)) > 1
        else nullcontext()
    )
    with pool as executor, stopped_together():
        if executor is None:
            found = map(run_blocks, repeat(experiment), parts)
        else:
            tasks = [executor.submit(run_blocks, experiment, part) for part in parts]
            found = (task.result() for task in tasks)
        for done, (part, (kept, which)) in enumerate(zip(parts, found, strict=True), start=1):
            which, first = which + sum(len(v[0]) for v in values), 0
            for block in part:
                here = slice(block.first + block.runs.start, block.first + block.runs.stop)
                index[block.row, here] = which[first : first + len(block.runs)]
                first += len(block.runs)
            values.append(kept)
            listener().advance("sampling", done, len(parts))
    columns = zip(*values, strict=True)
    return Sample(type(values[0])(*(None if c[0] is None else np.concatenate(c) for c in columns)), index)


def size_of_block(agents: int) -> int:
    """Return the runs that are drawn from one seed: fewer where agents, and so links, are many."""
    return BLOCK if agents <= MOST_OF_BLOCK else max(1, BLOCK * MOST_OF_BLOCK**2 // agents**2)


def blocks_of(runs: int, agents: int, rows: int, begin: int = 0) -> list[RunBlock]:
    """Blocks of so many runs of every row, numbered from some number on."""
    size = size_of_block(agents)
    starts = range(0, runs, size)
    sizes = [min(size, runs - first) for first in starts]
    return [
        RunBlock(row, number, first, size, range(size))
        for row in range(rows)
        for number, (first, size) in enumerate(zip(starts, sizes, strict=True), start=begin)
    ]


def _split(block: RunBlock, pieces: int) -> list[RunBlock]:
    ends = [block.size * piece // pieces for piece in range(pieces + 1)]
    return [block._replace(runs=range(a, b)) for a, b in pairwise(ends) if a < b]


@contextmanager
def stopped_together() -> Iterator[None]:
    """Let no process go on working for a result that nobody waits for."""
    try:
        yield
    except BaseException:
        for child in active_children():
            child.terminate()
        raise


def quietly() -> None:
    """Let Ctrl-C end a worker without a traceback: the parent tells the user."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run_blocks(experiment: Experiment, blocks: Sequence[RunBlock]) -> tuple[Any, np.ndarray]:
    """What is kept, and its index (runs, steps, agents), for some blocks."""
    with uncollected():
        return (_run_blocks if experiment.together is None else _run_together)(experiment, blocks)


def _run_together(experiment: Experiment, blocks: Sequence[RunBlock]) -> tuple[Any, np.ndarray]:
    if experiment.together is None:
        raise ValueError("nothing that follows many runs at a time")
    links = links_of(experiment.events, experiment.agents)
    parts, found, values, size = [], [], 0, 1
    done, total = 0, sum(len(block.runs) for block in blocks)
    for block in blocks:
        first, runs = block.runs.start, block.runs.stop
        drawn = _drawn_by_step(experiment, block)
        steps = [arrivals(link, *now) for link, now in zip(links, drawn, strict=True)]
        while first < runs:
            some = slice(first, min(runs, first + size))
            follows = experiment.together(some.stop - first)
            which = np.empty((some.stop - first, len(links), experiment.agents), np.int32)
            for step, now in enumerate(steps):
                try:
                    estimate, index = follows.exchange(of_runs(now, some, experiment.agents))
                except NoAnswerError as error:
                    before = block.number * size_of_block(experiment.agents) + first + 1
                    raise NoAnswerError("".join(f"run {before + run}: " for run in error.items) + f"{error}") from None
                parts.append(experiment.of(estimate))
                which[:, step] = index + values
                values += len(parts[-1][0])
            found.append(which)
            done += len(which)
            listener().advance("runs", done, total)
            # what the runs take is known once one has been followed
            first, size = some.stop, max(1, min(MOST_TOGETHER, MOST_NUMBERS // follows.size))
    columns = zip(*parts, strict=True)
    kept = type(parts[0])(*(None if c[0] is None else np.concatenate(c) for c in columns))
    return kept, np.concatenate(found)


def arrivals(links: StepLinks, fates: np.ndarray, missed: np.ndarray) -> StepOutcomes:
    """What becomes of a step, from fates and misses as they are drawn."""
    return StepOutcomes(links.arrived(fates), missed.astype(bool) if missed.any() else None)


def of_runs(now: StepOutcomes, runs: slice, agents: int) -> StepOutcomes:
    """What becomes of a step in some of the runs."""
    found = []
    for receiver, sender in now.arrived:
        some = slice(*np.searchsorted(receiver, [runs.start * agents, runs.stop * agents]).tolist())
        found.append((receiver[some] - runs.start * agents, sender[some] - runs.start * agents))
    return StepOutcomes(found, None if now.missed is None else now.missed[runs])


def _run_blocks(experiment: Experiment, blocks: Sequence[RunBlock]) -> tuple[Any, np.ndarray]:
    estimator, claims = experiment.make()
    drawn = [_draw(experiment, block) for block in blocks]
    runs = sum(len(fates[0]) for fates, _ in drawn)
    claimed = np.empty((runs, len(experiment.events), experiment.agents), np.int32)
    exchanges, exchange_of = [estimator.exchange(estimator.start())], np.zeros(runs, dtype=np.int64)
    place_of = np.tile(np.arange(experiment.agents), (runs, 1))
    for step in range(1, len(experiment.events) + 1):
        listener().advance("histories", step, len(experiment.events))
        events = experiment.events[step - 1]
        fates = _moved(np.concatenate([fates[step - 1] for fates, _ in drawn]), events, place_of)
        # what is measured at the next step is drawn with what arrives at this one
        missed = np.concatenate([missed[step] for _, missed in drawn]) if step < len(experiment.events) else None
        if missed is not None and missed.any():
            fates = np.concatenate([fates, np.take_along_axis(missed, np.argsort(place_of, axis=1), axis=1)], axis=1)
        different, history_of = _distinct(exchange_of, fates, 1 + max(len(e.delay) for e in events) if events else 2)
        histories = _StepPairs(estimator, events, experiment.agents, exchanges, different)
        claimed[:, step - 1] = np.take_along_axis(histories.fused()[history_of], place_of, axis=1)
        if step < len(experiment.events):
            if len(different) < MERGE_BELOW * runs:
                exchanges, after, moved = histories.merged()
                exchange_of, place_of = after[history_of], np.take_along_axis(moved[history_of], place_of, axis=1)
            else:
                exchanges, exchange_of = histories.onward(), history_of
    index = np.unique(claimed, return_inverse=True)[1]
    kept = _kept(experiment, claims(), claimed)
    return kept, index.reshape(claimed.shape).astype(np.int32)


def _kept(experiment: Experiment, claims: Claims, claimed: np.ndarray) -> Any:
    """What is kept of every value claimed by some run, in the order of the values."""
    parts, order = [], []
    for step in range(1, claimed.shape[1] + 1):
        listener().advance("estimates", step, claimed.shape[1])
        values = np.unique(claimed[:, step - 1])
        parts.append(experiment.of(claims.estimate([(1, values)], step)[0]))
        order.append(values)
    columns = zip(*parts, strict=True)
    kept = type(parts[0])(*(None if c[0] is None else np.concatenate(c) for c in columns))
    place = np.argsort(np.concatenate(order))
    if (place == np.arange(len(place))).all():  # most estimators number their values in order of time
        return kept
    return type(kept)(*(None if c is None else c[place] for c in kept))


class _StepPairs:
    """Different (exchange, fates) pairs of one step.

    Parameters
    ----------
    different : (pairs, 1 + events) number of the exchange and fate of each event, in the order of exchanges; where a
        sensor misses before the next exchange a column more for every agent.
    """

    def __init__(
        self,
        estimator: Estimator,
        events: Sequence[ChanceEvent],
        agents: int,
        exchanges: Sequence[Exchange],
        different: np.ndarray,
    ) -> None:
        self.estimator, self.agents = estimator, agents
        fates = different[:, 1 : 1 + len(events)]
        # masks of more agents than an integer of the machine has bits are Python's own
        kind = np.int64 if agents < 63 else object
        missing = different[:, 1 + len(events) :].astype(kind)
        missed = missing @ np.array([1 << i for i in range(missing.shape[1])], dtype=kind)
        heard = np.tile(np.array([1 << i for i in range(agents)], dtype=kind), (len(different), 1))
        late: list[list[Late]] = [[] for _ in range(len(different))]
        for event, fate in zip(events, fates.T, strict=True):
            for receiver in event.receivers:
                heard[:, receiver] |= (fate == 1).astype(kind) * (1 << event.sender)
                for pair in np.flatnonzero(fate > 1):
                    late[pair].append(Late(receiver, int(fate[pair]) - 1, event.sender))
        of = [exchanges[exchange] for exchange in different[:, 0]]
        self.each = list(zip(of, heard.tolist(), late, missed.tolist(), strict=True))

    def fused(self) -> np.ndarray:
        """What is claimed at every place, (pairs, agents)."""
        return np.array([[x.fused(i, heard) for i in range(self.agents)] for x, heard, *_ in self.each], np.int32)

    def merged(self) -> tuple[list[Exchange], np.ndarray, np.ndarray]:
        """Next exchanges of the different states, each pair's number, and where its agents moved, (pairs, agents)."""
        states: dict[Any, int] = {}
        after, moved = np.empty(len(self.each), dtype=np.int64), np.empty((len(self.each), self.agents), dtype=np.int64)
        for pair, (exchange, heard, late, missed) in enumerate(self.each):
            state, order = exchange.after(heard, late, missed)
            after[pair] = states.setdefault(state, len(states))
            moved[pair, order] = range(self.agents)
        return [self.estimator.exchange(state) for state in states], after, moved

    def onward(self) -> list[Exchange]:
        """Next exchange of every pair."""
        return [exchange.onward(heard, late, missed) for exchange, heard, late, missed in self.each]


class StepLinks:
    """Events of a step as arrays: who hears whom in which.

    Parameters
    ----------
    drawn : events of the step.
    agents : number of agents.
    """

    def __init__(self, drawn: Sequence[ChanceEvent], agents: int) -> None:
        each = sorted((i, e.sender, number) for number, e in enumerate(drawn) for i in e.receivers)
        self.agents, self.delays = agents, max((len(event.delay) for event in drawn), default=1)
        self.receiver, self.sender, number = np.array(each, dtype=np.intp).reshape(-1, 3).T
        self.event = None if np.array_equal(number, range(len(drawn))) else number

    def arrived(self, fates: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pairs of what arrived after each delay, see `StepOutcomes`.

        Parameters
        ----------
        fates : (runs, events), 0 lost, 1 + delay otherwise.
        """
        fates = fates if self.event is None else fates[:, self.event]
        found = []
        for delay in range(self.delays):
            run, pair = np.divmod(np.flatnonzero(fates == 1 + delay), max(1, fates.shape[1]))
            run *= self.agents
            found.append((run + self.receiver[pair], run + self.sender[pair]))
        return found


def links_of(events: Sequence[Sequence[ChanceEvent]], agents: int) -> list[StepLinks]:
    """Links of every step; steps with the same list of events share them."""
    different = {id(now): now for now in events}
    links = {key: StepLinks(now, agents) for key, now in different.items()}
    return [links[id(now)] for now in events]


def _moved(fates: np.ndarray, events: Sequence[ChanceEvent], place_of: np.ndarray) -> np.ndarray:
    """Fates of the events among places, from those among agents, (runs, events)."""
    number = {(event.sender, event.receivers): e for e, event in enumerate(events)}
    different, run_of = np.unique(place_of, axis=0, return_inverse=True)
    if len(different) == 1 and (different[0] == np.arange(len(different[0]))).all():
        return fates
    to = [[number[int(p[e.sender]), tuple(sorted(int(p[r]) for r in e.receivers))] for e in events] for p in different]
    out = np.empty_like(fates)
    np.put_along_axis(out, np.array(to).reshape(len(different), -1)[run_of.ravel()], fates, axis=1)
    return out


def _distinct(exchange_of: np.ndarray, fates: np.ndarray, options: int) -> tuple[np.ndarray, np.ndarray]:
    """Different (exchange, fates) pairs, in the order of exchanges, and the number of each run's pair."""
    table = np.concatenate([exchange_of[:, None], fates], axis=1)
    if log2(exchange_of.max() + 1) + fates.shape[1] * log2(options) < 62:
        code = exchange_of.copy()
        for fate in fates.T:
            code = code * options + fate
        _, first, pair_of = np.unique(code, return_index=True, return_inverse=True)
        return table[first], pair_of
    different, pair_of = np.unique(table, axis=0, return_inverse=True)
    return different, pair_of.ravel()


def _draw(experiment: Experiment, block: RunBlock) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Fates and misses of a block, see `draw_fates`."""
    fates, missed = zip(*_drawn_by_step(experiment, block), strict=True)
    return list(fates), list(missed)


def _drawn_by_step(experiment: Experiment, block: RunBlock) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    generator = stream(experiment.seed, block.row, block.number)
    size = block.size, experiment.agents
    return fates_by_step(generator, experiment.events, experiment.detections, size, block.row)


def stream(seed: int, row: int, number: int) -> np.random.Generator:
    """Random numbers of a block of runs, or of one run, of a row."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(row, number)))


def draw_fates(
    generator: np.random.Generator,
    events: Sequence[Sequence[ChanceEvent]],
    detections: Sequence[Sequence[Detection]],
    size: tuple[int, int],
    row: int = 0,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Draw what becomes of messages and measurements.

    Parameters
    ----------
    generator : of random numbers.
    events, detections : of every step.
    size : numbers of runs and agents.
    row : of link probabilities.

    Returns
    -------
    fates, missed : list of ndarray
        Per step: fates of the events (runs, events), 0 lost, 1 + delay otherwise; and which agents' sensors miss,
        (runs, agents).
    """
    fates, missed = zip(*fates_by_step(generator, events, detections, size, row), strict=True)
    return list(fates), list(missed)


def fates_by_step(
    generator: np.random.Generator,
    events: Sequence[Sequence[ChanceEvent]],
    detections: Sequence[Sequence[Detection]],
    size: tuple[int, int],
    row: int = 0,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Draw the same, a step at a time."""
    (runs, agents), bad = size, None
    chances: dict[int, tuple[np.ndarray, np.ndarray, int]] = {}
    for now, draws in zip(events, detections, strict=True):
        missed = np.zeros((runs, agents), dtype=np.int64)
        for agent, p in draws:
            missed[:, agent] = generator.random(runs) >= p
        if id(now) not in chances:
            bursts = np.array([event.burst[row] for event in now if event.burst is not None])
            longest = max((len(event.delay) for event in now), default=1)
            chances = {id(now): (np.array([event.probability[row] for event in now]), bursts, longest)}
        µ, bursts, longest = chances[id(now)]
        if len(bursts):
            to_bad, to_good, good_µ, bad_µ = bursts.T
            change = to_bad / (to_bad + to_good) if bad is None else np.where(bad, 1.0 - to_good, to_bad)
            bad = _comes_about(generator, change, (runs, len(now)))
            µ = np.where(bad, bad_µ, good_µ)
        fates = _comes_about(generator, µ, (runs, len(now))).view(np.uint8)
        yield (fates if longest == 1 else np.where(fates, 1 + _delays(now, runs, generator), 0)), missed


def _comes_about(generator: np.random.Generator, p: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Whether what has a probability comes about, (runs, events): some runs at a time, so that memory does."""
    out, size = np.empty(shape, dtype=bool), max(1, DRAWN // max(1, shape[1]))
    for first in range(0, shape[0], size):
        some = slice(first, first + size)
        np.less(generator.random(out[some].shape), p[some] if p.ndim == 2 else p, out=out[some])
    return out


def _delays(events: Sequence[ChanceEvent], runs: int, generator: np.random.Generator) -> np.ndarray:
    """Steps that each message takes, (runs, events)."""
    drawn, late = generator.random((runs, len(events))), np.empty((runs, len(events)), dtype=np.uint8)
    for place, event in enumerate(events):
        within = np.searchsorted(np.cumsum(event.delay), drawn[:, place], side="right")
        late[:, place] = np.minimum(within, len(event.delay) - 1)
    return late
