"""The expected optimum enclosed from both sides, where the contact chain has too many paths.

Scalar models carry a distribution of P on a grid, one for each state of the chain.  Time update and measurement update
are monotone and concave in P, and so are they after one another.  Putting the mass of a grid cell at its mean can
therefore only raise the expectation, and splitting it between the cell's ends, mean kept, can only lower it: carried
side by side, the two enclose it, and the gap falls with the square of the cell's width.

Matrix models carry a pair of covariances for every path, at first equal.  Where paths are too many, the likeliest half
is kept; of the others those that agree in their last L counts are taken together, L as large as their number allows,
and what they carry is put between bounds in the positive-definite order: with A = L_A L_Aᵀ, B = L_B L_Bᵀ and the
singular values L_A⁻¹L_B = U diag(s) Vᵀ, of all that is at least (at most) A and B

    L_A U diag(max(s, 1))² Uᵀ L_Aᵀ       (L_A U diag(min(s, 1))² Uᵀ L_Aᵀ)

is a least (a greatest) one, and is A or B itself where these are ordered, as they are if one path's counts are nowhere
less than the other's.  Updates keep the order, the filter forgets, so that the two are close, and what is least likely
counts least.  Nothing is asked of the counts: sensors may be unlike or miss.  (Pruning: a count that no row of links
makes possible is not followed.)

Rounding, some 1e-13, comes on top of either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stochfuse.engines.contact_chain import (
    AlongPath,
    Chain,
    Contacts,
    LosslessFilter,
    TooManyPathsError,
    blocks_of_rows,
    by_counts,
    closing,
    leading,
    transitions,
)
from stochfuse.estimators.progress import listener
from stochfuse.kalman.kernel import factor, from_factor

GRID = 800
"""Grid cells over the range of P."""
MOST_MERGED, LAST = 10_000, 24
"""Paths that are carried, and their last counts that are remembered."""
NEGLIGIBLE = 1e-16
"""Weight of a path that is not worth to be followed by itself."""
WORTHLESS = 1e-6
"""Rounding beyond which a bound is none."""
ROUNDING = 1e-13
NOTHING = 1e-150
"""Probabilities that are left out, far below rounding: the processor is slow on products of smaller ones."""


def enclosed_optimum(given: LosslessFilter, contacts: Contacts, steps: int, rows: int) -> Chain:
    """Enclose the expected optimum.

    Raises
    ------
    TooManyPathsError
        If different counts are too many, or covariances too near to singular ones to be told apart.
    """
    parts = [enclosed(given, contacts, steps, some) for some in blocks_of_rows(contacts, rows)]
    low, high = (np.concatenate(side) for side in zip(*parts, strict=True))
    middle = 0.5 * (low + high)
    return Chain(middle, None, None, half_width(high - low, middle) + ROUNDING, None)


def enclosed(
    given: LosslessFilter, contacts: Contacts, steps: int, some: slice, above: LosslessFilter | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper expectations of some rows, (rows, steps, groups, d, d).

    Parameters
    ----------
    above : what the upper one starts from, if that is something else.
    """
    if given.model.dimension > 1:
        return _by_last_counts(given, contacts, steps, some, above or given)
    low, high = _on_a_grid(given, contacts, steps, some)
    return low, high if above is None else _on_a_grid(above, contacts, steps, some)[1]


def half_width(gap: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Least ε with gap ≤ 2ε·middle in the positive-definite order, the worst of all groups."""
    whiten = np.linalg.pinv(factor(middle))
    return 0.5 * np.linalg.eigvalsh(whiten @ gap @ np.swapaxes(whiten, -1, -2))[..., -1].max(axis=2)


def _on_a_grid(given: LosslessFilter, contacts: Contacts, steps: int, some: slice) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper expectations, (rows, steps, groups, 1, 1), of a scalar model."""
    counts, states = by_counts(contacts)

    def after(P: np.ndarray, step: int) -> np.ndarray:
        """P(t) in every state from P(t−1), (..., states, any)."""
        P = np.broadcast_to(P, np.broadcast_shapes(P.shape, (len(contacts.held), 1)))[..., None, None]
        return given.after(AlongPath(None, P), contacts.held[:, None], step).root[..., 0, 0]

    # what a state without a first estimate would start from does not matter
    start = np.full(len(contacts.held), given.covariance(given.start(counts[-1])).item())
    for c in given.begins(counts):
        start[states[c]] = given.covariance(given.start(counts[c])).item()
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
    given: LosslessFilter, contacts: Contacts, steps: int, some: slice, above: LosslessFilter
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper expectations, (rows, steps, groups, d, d), by paths merged to their last counts."""
    counts, states = by_counts(contacts)
    if len(counts) > MOST_MERGED / 2:
        raise TooManyPathsError(f"the contact chain has {len(counts)} different counts, too many to enclose its paths")
    classes: dict[int, _Merged] = {}
    lower, upper, before = [], [], np.empty(0)
    for step, T in enumerate(transitions(contacts, steps, some), start=1):
        if step == 1:
            for c in given.begins(counts):
                low, high = given.start(counts[c]).root, above.start(counts[c]).root
                classes[c] = _Merged(np.full((1, LAST), c), low, high, np.ones((len(T), len(states[c]), 1)))
        else:
            classes = _grown(given, classes, before, counts, states, step)
        last = {c: closing(T, contacts.starts, states[c], merged.weight) for c, merged in classes.items()}
        lower.append(sum(np.tensordot(last[c], from_factor(merged.low), axes=1) for c, merged in classes.items()))
        upper.append(sum(np.tensordot(last[c], from_factor(merged.high), axes=1) for c, merged in classes.items()))
        before = T
    return np.stack(lower, axis=1), np.stack(upper, axis=1)


class _Merged(NamedTuple):
    """Paths that end with one count, of some those with the same last counts taken together.

    Parameters
    ----------
    last : (paths, LAST) last counts, as numbers of classes.
    low, high : (paths, d, d) square roots of the smallest and the largest covariance.
    weight : (rows, states, paths).
    """

    last: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray

    def alone(self, others: np.ndarray, window: int) -> _Merged:
        """Take those of the others together that have as many last counts in common."""
        if not others.any():
            return self
        _, group = np.unique(self.last[others][:, LAST - window :], axis=0, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        some, group = np.flatnonzero(others)[order], group.ravel()[order]
        first = np.flatnonzero(np.diff(group, prepend=-1))
        together = _Merged(
            self.last[some[first]],
            _together(self.low[some], group, above=False),
            _together(self.high[some], group, above=True),
            np.add.reduceat(self.weight[:, :, some], first, axis=2),
        )
        kept = ~others
        return _Merged(
            np.concatenate([self.last[kept], together.last]),
            np.concatenate([self.low[kept], together.low]),
            np.concatenate([self.high[kept], together.high]),
            np.concatenate([self.weight[:, :, kept], together.weight], axis=2),
        )


def _together(roots: np.ndarray, group: np.ndarray, *, above: bool) -> np.ndarray:
    """Square root of a bound above or below all of each group, in the groups' order; see the module."""
    while True:
        place = np.arange(len(group)) - np.searchsorted(group, group)
        odd = np.flatnonzero(place % 2)
        if not len(odd):
            return roots
        A, B = roots[odd - 1], roots[odd]
        sd = np.sqrt((A * A).sum(axis=-1) + (B * B).sum(axis=-1))[..., None]
        sd = np.where(sd > 0, sd, 1.0)
        try:
            inverse = np.linalg.inv(A / sd)
        except np.linalg.LinAlgError:
            raise TooManyPathsError("covariances of paths are singular: they cannot be put between bounds") from None
        U, s, _ = np.linalg.svd(inverse @ (B / sd))
        # what rounding may make of singular values
        reach = 1e-15 * np.sqrt((inverse**2).sum(axis=(-2, -1))) * len(sd[0])
        if not (reach < WORTHLESS).all():
            raise TooManyPathsError("covariances of paths are nearly singular: they cannot be put between bounds")
        reach = reach[:, None]
        s = np.maximum(s, 1.0) * (1.0 + reach) if above else np.minimum(s, 1.0) * (1.0 - reach)
        roots = np.delete(roots, odd, axis=0)
        roots[odd - 1 - np.arange(len(odd))] = A @ (U * s[..., None, :])
        group = np.delete(group, odd)


def _grown(
    given: LosslessFilter,
    classes: dict[int, _Merged],
    T: np.ndarray,
    counts: np.ndarray,
    states: list[np.ndarray],
    step: int,
) -> dict[int, _Merged]:
    """Every path with every count that may follow."""
    grown = {}
    for c, here in enumerate(states):
        parts = [
            (np.column_stack([m.last[alive, 1:], np.full(len(alive), c)]), m.low[alive], m.high[alive], weight)
            for m, alive, weight in leading(classes, T, here, states)
        ]
        if parts:
            last, low, high, weights = zip(*parts, strict=True)
            joined = (np.concatenate(column) for column in (last, low, high))
            grown[c] = _Merged(*joined, weight=np.concatenate(weights, axis=2))
    for c, merged in _fewer(grown).items():
        high = low = given.after(AlongPath(None, merged.low), counts[c], step).root
        if merged.high is not merged.low and (merged.high != merged.low).any():
            high = given.after(AlongPath(None, merged.high), counts[c], step).root
        grown[c] = merged._replace(low=low, high=high)
    return grown


def _fewer(classes: dict[int, _Merged]) -> dict[int, _Merged]:
    """At most `MOST_MERGED` paths, if there are no more counts than that; all together that hardly ever come about."""
    likely = {c: m.weight.max(axis=(0, 1)) for c, m in classes.items()}
    likelihoods, half, least = np.concatenate(list(likely.values())), MOST_MERGED // 2, NEGLIGIBLE
    if np.count_nonzero(likelihoods > least) > MOST_MERGED:
        least = np.partition(likelihoods, -half)[-half]
    others = {c: w <= least for c, w in likely.items()}
    if least == NEGLIGIBLE:
        return {c: m.alone(others[c], 1) for c, m in classes.items()}
    last = np.concatenate([m.last[others[c]] for c, m in classes.items()])
    last = last[np.lexsort(last.T)][:, ::-1]
    # how many different ones there are by the last 1, 2 … counts: those that differ from the one before by then
    differ = (np.diff(last, axis=0) != 0).cumsum(axis=1) > 0
    window = max(1, int((1 + differ.sum(axis=0) <= half).sum()))
    return {c: m.alone(others[c], window) for c, m in classes.items()}
