"""Bookkeeping of how likely outcomes are, while they are gone through.

With equal µ everywhere, an outcome with c successes of L events has probability µ^c (1−µ)^(L−c): the `Counts` and
`Coefficients` weights keep the factor of every c apart (theory section 5), so that one enumeration answers every µ.
`Rows` keeps one probability per row of link probabilities instead, and `Bursty` one for every row and every way in
which the links can be good and bad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.network import LinkRows, Network

if TYPE_CHECKING:
    from stochfuse.events import Event, Fate

MOST_HIDDEN = 1 << 14
"""Rows times ways in which bursty links can be good and bad."""


class _Memoryless:
    """Weights of links whose steps are independent."""

    memory = False

    def between(self, weights: list[Any]) -> list[Any]:
        """Weights of states before the next step's exchange, from those after this one's."""
        return weights

    def collected(self, total: np.ndarray) -> np.ndarray:
        """Return what is known on the weights' axis without what is hidden."""
        return total


class _Polynomial(_Memoryless):
    """Coefficients A_c of µ^c (1−µ)^(L−c) on an axis of L + 1 entries."""

    def product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Weights of two independent parts together."""
        return np.convolve(a, b)

    def total(self, states: np.ndarray, cells: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Σ states · cells · values over states and groups of cells, shape (degrees + 1, …)."""
        flat = values.reshape(*values.shape[:2], -1)
        first = np.tensordot(states.T, flat, axes=1)
        pairs = np.einsum("hm,chv->cmv", cells, first)
        out = np.zeros((sum(pairs.shape[:2]) - 1, pairs.shape[2]))
        for c, row in enumerate(pairs):
            out[c : c + len(row)] += row
        return out.reshape(-1, *values.shape[2:])

    def weighed(self, total: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Σ_c total times an independent part's weight."""
        out = np.zeros((len(total) + len(weight) - 1, *total.shape[1:]))
        for c, w in enumerate(weight):
            out[c : c + len(total)] += w * total
        return out

    def completed(self, total: np.ndarray, degree: int) -> np.ndarray:
        """Return the same with events that do not matter counted in, so that L is the degree."""
        while len(total) <= degree:
            grown = np.zeros((len(total) + 1, *total.shape[1:]))
            grown[:-1] += total
            grown[1:] += total
            total = grown
        return total


@dataclass(frozen=True)
class Counts(_Polynomial):
    """Weights by number of successes, equal µ: outcomes counted exactly, packed into one integer, `bits` apiece."""

    bits: int

    def one(self) -> int:
        """Weight of the start."""
        return 1

    def factor(self, event: Event, fate: Fate) -> Any:
        """Shift of one event's fate."""
        return 0 if fate.delay is None else self.bits

    def both(self, a: Any, b: Any) -> Any:
        """Shift of two events together."""
        return a + b

    def none(self) -> Any:
        """Shift of no event."""
        return 0

    def times(self, weight: int, factor: int) -> int:
        """Weight after an outcome."""
        return weight << factor

    def table(self, weights: Sequence[Any], degree: int) -> np.ndarray:
        """Numbers of outcomes by number of successes, shape (weights, degree + 1)."""
        return np.array(self.exactly(weights, degree), dtype=float)

    def exactly(self, weights: Sequence[Any], degree: int) -> list[list[int]]:
        """Return the same as integers."""
        mask = (1 << self.bits) - 1
        return [[w >> c * self.bits & mask for c in range(degree + 1)] for w in weights]

    def factors(self, factors: Sequence[Any], degree: int) -> np.ndarray:
        """Outcomes' factors as coefficients, shape (factors, degree + 1)."""
        return np.eye(degree + 1)[[factor // self.bits for factor in factors]]


@dataclass(frozen=True)
class Coefficients(_Polynomial):
    """Weights by number of successes, equal µ with delays: coefficients of µ^c (1−µ)^(L−c)."""

    def one(self) -> np.ndarray:
        """Weight of the start, or of no event."""
        return np.ones(1)

    none = one

    def factor(self, event: Event, fate: Fate) -> np.ndarray:
        """Coefficients of one event's fate."""
        return np.array([fate.missed, fate.arrived])

    def both(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Coefficients of two events together."""
        return np.convolve(a, b)

    times = both

    def table(self, weights: Sequence[Any], degree: int) -> np.ndarray:
        """Coefficients, shape (weights, degree + 1)."""
        return np.array(weights)

    factors = table


@dataclass(frozen=True)
class Rows(_Memoryless):
    """Weights as one probability per row."""

    rows: int

    def one(self) -> np.ndarray:
        """Weight of the start, or of no event."""
        return np.ones(self.rows)

    none = one

    def factor(self, event: Event, fate: Fate) -> np.ndarray:
        """Probabilities of one event's fate."""
        µ = event.probability
        return fate.missed * (1.0 - µ) + fate.arrived * µ

    def both(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Probabilities of two events together."""
        return a * b

    times = both
    product = both

    def table(self, weights: Sequence[Any], degree: int) -> np.ndarray:
        """Probabilities, shape (weights, rows)."""
        return np.array(weights)

    factors = table

    def total(self, states: np.ndarray, cells: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Σ states · cells · values over states and groups of cells, shape (rows, …)."""
        flat = values.reshape(*values.shape[:2], -1)
        return np.einsum("gr,hr,ghv->rv", states, cells, flat, optimize=True).reshape(-1, *values.shape[2:])

    def weighed(self, total: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Total times an independent part's weight."""
        return total * weight.reshape(-1, *(1,) * (total.ndim - 1))

    def completed(self, total: np.ndarray, degree: int) -> np.ndarray:
        """Return the total: probabilities are complete."""
        return total


@dataclass(frozen=True)
class Bursty(Rows):
    """Weights as one probability per row and hidden state, which says of every link (bit by its number) if it is bad.

    Parameters
    ----------
    rows : entries of the axis: rows times hidden states.
    links : number of links.
    moves : (links, rows proper, 2, 2) probability to go from state to state (0 good, 1 bad).
    """

    links: int
    moves: np.ndarray

    memory = True

    def one(self) -> np.ndarray:
        """Stationary distribution of the hidden states, in every row."""
        total = np.ones((self.moves.shape[1], 1))
        for move in self.moves:  # a later link is a higher bit
            bad = move[:, 0, 1] / (move[:, 0, 1] + move[:, 1, 0])
            total = np.concatenate([total * (1.0 - bad)[:, None], total * bad[:, None]], axis=1)
        return total.ravel()

    def factor(self, event: Event, fate: Fate) -> np.ndarray:
        """Probabilities of one event's fate in every hidden state."""
        if event.burst is None:
            raise ValueError("expected an event of a bursty link")
        bad = np.arange(1 << self.links) >> event.number & 1
        µ = np.where(bad, event.burst[:, 3:], event.burst[:, 2:3]).ravel()
        return fate.missed * (1.0 - µ) + fate.arrived * µ

    def between(self, weights: list[Any]) -> list[Any]:
        """Let every link stay or change."""
        rows, links = self.moves.shape[1], self.links
        table = np.array(weights)
        for link, move in enumerate(self.moves):
            parts = table.reshape(len(weights), rows, 1 << (links - 1 - link), 2, 1 << link)
            table = np.einsum("wrasb,rst->wratb", parts, move).reshape(len(weights), -1)
        return list(table)

    def collected(self, total: np.ndarray) -> np.ndarray:
        """Sum over the hidden states."""
        return total.reshape(self.moves.shape[1], -1, *total.shape[1:]).sum(axis=1)


Weights = Counts | Coefficients | Rows


def bursty(drawn: Sequence[Event], rows: int) -> Bursty:
    """Return the bookkeeping for bursty links.

    Raises
    ------
    UsageError
        If the hidden states are too many.
    """
    if rows << len(drawn) > MOST_HIDDEN:
        raise UsageError(
            f"{len(drawn)} bursty links are good and bad in 2^{len(drawn)} ways, for {rows} rows too many to go "
            f"through (at most {MOST_HIDDEN}): use --method optimal or --method monte-carlo"
        )
    bursts = [event.burst for event in drawn if event.burst is not None]
    moves = np.array([[[[1 - g, g], [b, 1 - b]] for g, b, _, _ in burst] for burst in bursts])
    return Bursty(rows << len(drawn), len(drawn), moves.reshape(len(drawn), rows, 2, 2))


def weights_for(network: Network, rows: LinkRows, number_of_events: int) -> Weights:
    """Return the cheapest exact bookkeeping: by number of successes where all µ are equal, else by row."""
    if not rows.uniform or rows.varies:
        return Rows(len(rows.link))
    return Counts(number_of_events + 1) if network.delay == (1.0,) else Coefficients()


def bernstein(coefficients: np.ndarray, degree: int, link: np.ndarray) -> np.ndarray:
    """Σ_c A_c µ^c (1−µ)^(L−c) for every µ.

    Parameters
    ----------
    coefficients : (degree + 1, ...) A_c.
    link : (rows,) µ.

    Returns
    -------
    ndarray
        (rows, ...)
    """
    return np.tensordot(monomials(degree, link), coefficients, axes=1)


def monomials(degree: int, link: np.ndarray) -> np.ndarray:
    """µ^c (1−µ)^(L−c) for c = 0 … L, shape (rows, degree + 1)."""
    c = np.arange(degree + 1)
    return link[:, None] ** c * (1.0 - link[:, None]) ** (degree - c)
