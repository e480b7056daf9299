"""The expected optimum enclosed from both sides, where the contact chain has too many paths.

Scalar models carry a distribution of P on a grid, one for each state of the chain.  Time update and measurement update
are monotone and concave in P, and so are they after one another.  Putting the mass of a grid cell at its mean can
therefore only raise the expectation, and splitting it between the cell's ends, mean kept, can only lower it: carried
side by side, the two enclose it, and the gap falls with the square of the cell's width.

Matrix models merge paths that agree in their last counts.  P(r_1 … r_t) falls, in the positive-definite order, with
every count, and no count grows with time.  Among all paths r_1 ≥ … ≥ r_t with the last L counts given, the one whose
earlier counts are the least possible has the largest P and the one whose earlier counts are the greatest possible the
smallest; so with counts of what was measured where sensors may miss, whose least and greatest are 0 and all after any
count.  The filter forgets, so that the two are close; they are carried instead of the rest.  L is the largest for which
the paths are few.  (Pruning: a count that no row of links makes possible is not followed.)

Rounding, some 1e-13, comes on top of either.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import numpy as np

from stochfuse.engines.contact_chain import (
    AlongPath,
    Chain,
    Contacts,
    LosslessFilter,
    blocks_of_rows,
    by_counts,
    check_size,
    closing,
    leading,
    transitions,
)
from stochfuse.engines.progress import listener
from stochfuse.kalman.kernel import factor, from_factor

GRID = 800
"""Grid cells over the range of P."""
MOST_MERGED = 10_000
"""Different last counts that are carried."""
ROUNDING = 1e-13
NOTHING = 1e-150
"""Probabilities that are left out, far below rounding: the processor is slow on products of smaller ones."""


def enclosed_optimum(given: LosslessFilter, contacts: Contacts, steps: int, rows: int) -> Chain:
    """Enclose the expected optimum.

    Raises
    ------
    TooManyPathsError
        If a state of several dimensions meets unlike agents: their counts have no order.
    """
    enclose = _on_a_grid if given.model.dimension == 1 else _by_last_counts
    parts = [enclose(given, contacts, steps, some) for some in blocks_of_rows(contacts, rows)]
    low, high = (np.concatenate(side) for side in zip(*parts, strict=True))
    middle = 0.5 * (low + high)
    return Chain(middle, None, None, _half_width(high - low, middle) + ROUNDING, None)


def _half_width(gap: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Least ε with gap ≤ 2ε·middle in the positive-definite order, the worst of all groups."""
    whiten = np.linalg.pinv(factor(middle))
    return 0.5 * np.linalg.eigvalsh(whiten @ gap @ np.swapaxes(whiten, -1, -2))[..., -1].max(axis=2)


def _on_a_grid(given: LosslessFilter, contacts: Contacts, steps: int, some: slice) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper expectations, (rows, steps, groups, 1, 1), of a scalar model."""
    counts, states = by_counts(contacts)

    def after(P: np.ndarray, step: int) -> np.ndarray:
        """P(t) in every state from P(t−1), (..., states, any)."""
        out = np.empty(np.broadcast_shapes(P.shape, (len(contacts.held), 1)))
        P = np.broadcast_to(P, out.shape)[..., None, None]
        if counts.shape[1] == 1:
            return given.after(AlongPath(None, P), contacts.held[:, None], step).root[..., 0, 0]
        for count, here in zip(counts, states, strict=True):
            out[..., here, :] = given.after(AlongPath(None, P[..., here, :, :, :]), count, step).root[..., 0, 0]
        return out

    # at step 1 everybody has a first estimate: what a state without one would start from does not matter
    start = np.full(len(contacts.held), given.covariance(given.start(counts[-1])).item())
    for count, here in zip(counts, states, strict=True):
        if count.any():
            start[here] = given.covariance(given.start(count)).item()
    nodes = _nodes(start, after, steps)
    shape = (len(range(*some.indices(some.stop))), len(start), len(nodes))
    low = _split(nodes, np.broadcast_to(start[:, None], (*shape[:2], 1)), np.ones((*shape[:2], 1)))
    mass = _gather(nodes, np.broadcast_to(start[:, None], (*shape[:2], 1)), np.ones((*shape[:2], 1)))
    moment, before = mass * start[:, None], np.empty(0)
    lower, upper, starts = [], [], list(contacts.starts)
    constant = not given.model.varies and not any(sensor.varies for sensor in given.sensors)
    at_nodes = np.empty(0)
    for step, T in enumerate(transitions(contacts, steps, some), start=1):
        if step > 1:
            low, mass, moment = np.split(_flushed(before @ np.concatenate([low, mass, moment], axis=2)), 3, axis=2)
            at_nodes = at_nodes if constant and at_nodes.size else np.broadcast_to(after(nodes, step), shape)
            mean = np.divide(moment, mass, out=np.broadcast_to(nodes, shape).copy(), where=mass > 0)
            low = _split(nodes, at_nodes, low)
            P = after(mean, step)
            mass, moment = _gather(nodes, P, mass), _gather(nodes, P, mass * P)
        lower.append((T @ (low @ nodes)[..., None])[:, starts, 0])
        upper.append((T @ moment.sum(axis=2)[..., None])[:, starts, 0])
        before = _flushed(T.copy())
    return np.stack(lower, axis=1)[..., None, None], np.stack(upper, axis=1)[..., None, None]


def _nodes(start: np.ndarray, after: Callable[[np.ndarray, int], np.ndarray], steps: int) -> np.ndarray:
    least, most = start.min(), start.max()
    extremes, progress = [least, most], listener()
    for step in range(2, steps + 1):
        progress.advance("bounds", step, steps)
        least, most = after(np.array([least]), step).min(), after(np.array([most]), step).max()
        extremes += [least, most]
    # 0 below all: what is moved down from anywhere can only lower the expectation
    first = max(min(extremes) * 0.98, np.finfo(float).tiny)
    return np.concatenate([[0.0], np.geomspace(first, max(max(extremes) * 1.02, 2 * first), GRID - 1)])


def _flushed(mass: np.ndarray) -> np.ndarray:
    mass[mass < NOTHING] = 0.0
    return mass


def _cells(nodes: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(nodes, P, side="right") - 1, 0, len(nodes) - 2)


def _gather(nodes: np.ndarray, P: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Mass at values P, (rows, states, any), in their cells, (rows, states, nodes)."""
    return _added(nodes, _cells(nodes, P), mass)


def _split(nodes: np.ndarray, P: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Mass at values P put on the two nodes around each, the mean kept (beyond the last one, on that)."""
    left = _cells(nodes, P)
    share = np.clip((P - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0)
    return _added(nodes, left, mass * (1.0 - share)) + _added(nodes, left + 1, mass * share)


def _added(nodes: np.ndarray, place: np.ndarray, mass: np.ndarray) -> np.ndarray:
    rows, states, _ = mass.shape
    offset = len(nodes) * np.arange(rows * states).reshape(rows, states, 1)
    total = np.bincount((place + offset).ravel(), mass.ravel(), minlength=rows * states * len(nodes))
    return total.reshape(rows, states, len(nodes))


def _by_last_counts(
    given: LosslessFilter, contacts: Contacts, steps: int, some: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper expectations, (rows, steps, groups, d, d), by paths merged to their last counts."""
    counts, states = by_counts(contacts)
    if counts.shape[1] > 1:
        check_size(np.inf)
    n = len(counts)  # in order: more agents, a smaller P

    def merged(L: int) -> int:
        return comb(n + L - 1, L) if contacts.falling else n**L

    window = max(L for L in range(1, steps + 1) if L == 1 or merged(L) <= MOST_MERGED)
    classes: dict[int, _Merged] = {}
    lower, upper, before = [], [], np.empty(0)
    for step, T in enumerate(transitions(contacts, steps, some), start=1):
        if step == 1:
            for c in np.flatnonzero(counts.any(axis=1)).tolist():
                L = given.start(counts[c]).root
                classes[c] = _Merged(np.array([[c]]), L, L, np.ones((len(T), len(states[c]), 1)))
        else:
            classes = _grown(given, classes, before, counts, states, step, window)
        last = {c: closing(T, contacts.starts, states[c], merged.weight) for c, merged in classes.items()}
        lower.append(sum(np.tensordot(last[c], from_factor(merged.low), axes=1) for c, merged in classes.items()))
        upper.append(sum(np.tensordot(last[c], from_factor(merged.high), axes=1) for c, merged in classes.items()))
        before = T
    return np.stack(lower, axis=1), np.stack(upper, axis=1)


class _Merged(NamedTuple):
    """Paths that end with one count, those with the same last counts taken together.

    Parameters
    ----------
    last : (paths, window) last counts, as numbers of classes.
    low, high : (paths, d, d) square roots of the smallest and the largest covariance.
    weight : (rows, states, paths).
    """

    last: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray


def _grown(
    given: LosslessFilter,
    classes: dict[int, _Merged],
    T: np.ndarray,
    counts: np.ndarray,
    states: list[np.ndarray],
    step: int,
    window: int,
) -> dict[int, _Merged]:
    """Every path with every count that may follow."""
    grown = {}
    for c, here in enumerate(states):
        parts = [
            (np.column_stack([m.last[alive], np.full(len(alive), c)]), m.low[alive], m.high[alive], weight)
            for m, alive, weight in leading(classes, T, here, states)
        ]
        if parts:
            lasts, lows, highs, weights = zip(*parts, strict=True)
            last, weight = np.concatenate(lasts), np.concatenate(weights, axis=2)
            # by the last counts, then by the one that is forgotten now: the smallest has the largest covariance
            order = np.lexsort(last.T)
            kept = last[order][:, -window:]
            first = np.flatnonzero(np.concatenate([[True], (np.diff(kept, axis=0) != 0).any(axis=1)]))
            end = np.append(first[1:], len(kept)) - 1
            low = given.after(AlongPath(None, np.concatenate(lows)[order[end]]), counts[c], step).root
            high = given.after(AlongPath(None, np.concatenate(highs)[order[first]]), counts[c], step).root
            grown[c] = _Merged(kept[first], low, high, np.add.reduceat(weight[:, :, order], first, axis=2))
    return grown
