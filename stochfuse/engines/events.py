"""What may arrive in a step, and how likely: the events of (44)–(46).

A step draws independent events: every ordered pair of agents in an ad hoc network, every sender in a broadcast one,
every agent's one link in a cyclic one.  An event succeeds with probability µ, and everyone it concerns then hears the
sender, at once or after a delay that is drawn with it.  Between the exchanges of two steps a sensor that may miss
draws whether it measures (`stochfuse.scenario.system.Detection`).  Sets of agents are masks, bit i for agent i.

Bookkeeping of how likely outcomes are, while they are gone through.

With equal µ everywhere, an outcome with c successes of L events has probability µ^c (1−µ)^(L−c): the `CountWeights` and
`Coefficients` weights keep the factor of every c apart ((48)/(49)), so that one enumeration answers every µ.
`Rows` keeps one probability per row of link probabilities instead, and `Bursty` one for every row and every way in
which the links can be good and bad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.protocol import Late
from stochfuse.scenario.network import LinkRows, Network, possible_senders, reachable
from stochfuse.scenario.system import Detection

if TYPE_CHECKING:
    from stochfuse.engines.events import ChanceEvent, Fate


MOST_AGENTS_RELABELLED = 7
"""Agents up to which relabellings are looked for: their number grows with the factorial."""


class ChanceEvent(NamedTuple):
    """One draw of a step: who sends, who hears it, with which probability in each row, and after which delay.

    Of a bursty link `probability` is the mean; `burst` (rows, 4) says how it comes about, and `number` which link it is
    among those of every step.
    """

    sender: int
    receivers: tuple[int, ...]
    probability: np.ndarray
    burst: np.ndarray | None = None
    number: int = 0
    delay: tuple[float, ...] = (1.0,)


class Fate(NamedTuple):
    """What became of an event: a delay, or None if nothing will come of it; and the weight of that."""

    delay: int | None
    missed: Any
    arrived: Any


class Outcome(NamedTuple):
    """What becomes of a step.

    Parameters
    ----------
    heard : agents that each agent hears, itself included.
    late : what is under way.
    factor : the outcome's weight.
    missed : agents whose sensor misses at the next step.
    """

    heard: tuple[int, ...]
    late: tuple[Late, ...]
    factor: Any
    missed: int = 0


def events(network: Network, rows: LinkRows, step: int) -> list[ChanceEvent]:
    """Events of a step, those that are impossible in every row left out where links differ."""
    n, senders = network.agents, possible_senders(network.architecture, network.agents)
    µ = rows.matrices(network, step)
    if network.architecture == "broadcast":
        place = {(i, j): p for i in range(n) for p, j in enumerate(senders[i])}
        listeners = {j: tuple(i for i in range(n) if i != j) for j in range(n)}
        drawn = [(j, heard, µ[:, heard[0], place[heard[0], j]]) for j, heard in listeners.items() if heard]
    else:
        drawn = [(int(j), (i,), µ[:, i, p]) for i in range(n) for p, j in enumerate(senders[i])]
    found = [ChanceEvent(j, heard, p, delay=network.delay_of(heard[0], j)) for j, heard, p in drawn]
    if rows.bursts is not None:
        return [e._replace(burst=rows.chain(e.probability), number=number) for number, e in enumerate(found)]
    # with one µ for all links the answer is a polynomial in µ, whatever values of µ are asked for
    return [event for event in found if rows.uniform or (event.probability > 0).any()]


def fates(delay: Sequence[float], left: int) -> list[Fate]:
    """What may become of an event with so many steps left: lost or too late, or heard after each possible delay."""
    in_time = delay[: left + 1]
    too_late = 1.0 - sum(in_time) if left + 1 < len(delay) else 0.0
    return [Fate(None, 1.0, too_late), *(Fate(d, 0.0, p) for d, p in enumerate(in_time) if p > 0)]


def relabellings(network: Network, rows: LinkRows, sources: Sequence[int]) -> list[tuple[int, ...]]:
    """Permutations of the agents that change neither sources, nor who may hear whom, nor how likely."""
    n = network.agents
    if n > MOST_AGENTS_RELABELLED:
        return [tuple(range(n))]
    told = _told(network, rows, sources)
    return [p for p in permutations(range(n)) if _changes_nothing(told, p)]


def alike(network: Network, rows: LinkRows, sources: Sequence[int]) -> list[tuple[int, ...]]:
    """Classes of agents of which any two may change places with nothing else changed, as sorted groups.

    Such transpositions make an equivalence: (a c) = (a b)(b c)(a b).
    """
    n = network.agents
    if rows.uniform and network.delays is None and (network.architecture != "cyclic" or n < 3):
        return [tuple(i for i in range(n) if sources[i] == kind) for kind in dict.fromkeys(sources)]
    told = _told(network, rows, sources)
    ordered = zip(np.sort(told, axis=2).swapaxes(0, 1), np.sort(told, axis=1).transpose(2, 0, 1), strict=True)
    found: dict[tuple[bytes, bytes], list[list[int]]] = {}
    for i, (heard, hears) in enumerate(ordered):
        candidates = found.setdefault((heard.tobytes(), hears.tobytes()), [])
        same = next((c for c in candidates if _twins(told, c[0], i)), None)
        if same is None:
            candidates.append([i])
        else:
            same.append(i)
    return sorted(tuple(c) for candidates in found.values() for c in candidates)


def some_relabellings(network: Network, rows: LinkRows, sources: Sequence[int]) -> list[tuple[int, ...]]:
    """Relabellings of many agents that are easily found: of pairs alike, of all to the next, of all backwards."""
    n = network.agents
    told, everyone = _told(network, rows, sources), list(range(n))
    found = [tuple(everyone[1:] + everyone[:1]), tuple(everyone[::-1])]
    found = [p for p in found if _changes_nothing(told, p)]
    for first, *others in alike(network, rows, sources):
        for other in others:
            p = list(everyone)
            p[first], p[other] = other, first
            found.append(tuple(p))
    return [tuple(everyone), *found]


def _told(network: Network, rows: LinkRows, sources: Sequence[int]) -> np.ndarray:
    """All by which agents and links are told apart, (features, n, n): sources on the diagonal."""
    n, there = network.agents, reachable(replace(network, hears=None))
    steps = range(1, network.steps + 1 if rows.varies else 2)
    link = [rows.at_step(step) for step in steps]
    link = [np.broadcast_to(µ[:, None, None], (len(µ), n, n)) if rows.uniform else µ for µ in link]
    # told apart from a link that does not exist
    features = [*np.where(there, np.concatenate(link) + 1.0, 0.0)]
    if network.delays is not None:
        numbers = {delay: number for number, delay in enumerate(sorted({d for row in network.delays for d in row}))}
        features.append(np.array([[float(numbers[delay]) for delay in row] for row in network.delays]) * there)
    return np.stack([np.where(np.eye(n, dtype=bool), np.asarray(sources, dtype=float), f) for f in features])


def _changes_nothing(told: np.ndarray, p: Sequence[int]) -> bool:
    order = list(p)
    return bool((told == told[:, order][:, :, order]).all())


def _twins(told: np.ndarray, a: int, b: int) -> bool:
    """Whether two agents may change places: nobody else can tell them apart, nor they themselves."""
    others = np.ones(told.shape[-1], dtype=bool)
    others[[a, b]] = False
    rows, columns = told[:, [a, b]], told[:, :, [a, b]]
    return bool(
        (rows[:, 0, others] == rows[:, 1, others]).all()
        and (columns[:, others, 0] == columns[:, others, 1]).all()
        and (told[:, a, b] == told[:, b, a]).all()
        and (told[:, a, a] == told[:, b, b]).all()
    )


def orbits(n: int, permutations: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Agents that some relabelling takes into one another, as sorted groups."""
    group = list(range(n))
    for p in permutations:
        for i, a in enumerate(p):
            low, high = sorted((group[i], group[a]))
            if low < high:
                group = [low if g == high else g for g in group]
    return [tuple(i for i in range(n) if group[i] == g) for g in sorted(set(group))]


def outcomes(
    drawn: Sequence[ChanceEvent], agents: int, left: int, weights: Weights, detections: Sequence[Detection] = ()
) -> list[Outcome]:
    """Every outcome of a step that has a positive probability in some row.

    Parameters
    ----------
    drawn : the step's events.
    left : steps left after this one; what arrives later does not matter.
    detections : draws of what is measured at the next step.
    """
    whole = [Outcome(tuple(1 << i for i in range(agents)), (), weights.none())]
    for event in drawn:
        options = [(fate, weights.factor(event, fate)) for fate in fates(event.delay, left)]
        if isinstance(weights, Rows):
            options = [(fate, factor) for fate, factor in options if np.any(factor)]
        whole = [
            Outcome(
                _heard(outcome.heard, event, fate),
                outcome.late + _late(event, fate),
                weights.both(outcome.factor, factor),
            )
            for outcome in whole
            for fate, factor in options
        ]
    for agent, p in detections:
        options = [(mask, weights.chance(q)) for mask, q in ((0, p), (1 << agent, 1.0 - p)) if q > 0]
        whole = [
            o._replace(missed=o.missed | mask, factor=weights.both(o.factor, factor))
            for o in whole
            for mask, factor in options
        ]
    return whole


def number_of_outcomes(drawn: Sequence[ChanceEvent], left: int, detections: Sequence[Detection] = ()) -> int:
    """How many outcomes a step has, likely or not; parameters as of `outcomes`."""
    return prod(len(fates(event.delay, left)) for event in drawn) << len(detections)


def concerning(drawn: Sequence[ChanceEvent], agents: Sequence[int]) -> list[ChanceEvent]:
    """Events that concern some agents."""
    return [event for event in drawn if set(event.receivers) & set(agents)]


def _heard(heard: tuple[int, ...], event: ChanceEvent, fate: Fate) -> tuple[int, ...]:
    if fate.delay != 0:
        return heard
    return tuple(h | 1 << event.sender if i in event.receivers else h for i, h in enumerate(heard))


def _late(event: ChanceEvent, fate: Fate) -> tuple[Late, ...]:
    if not fate.delay:
        return ()
    return tuple(Late(receiver, fate.delay, event.sender) for receiver in event.receivers)


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

    def pairs(self, states: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Weights of every state with every factor, (states, factors, width)."""
        width = states.shape[1] + factors.shape[1] - 1
        out = np.zeros((len(states), len(factors), width))
        for c, column in enumerate(factors.T):
            for factor in np.flatnonzero(column).tolist():
                out[:, factor, c : c + states.shape[1]] += column[factor] * states
        return out

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
class CountWeights(_Polynomial):
    """Weights by number of successes, equal µ: outcomes counted exactly, packed into one integer.

    Parameters
    ----------
    events : largest number of events.
    """

    events: int

    @cached_property
    def bits(self) -> int:
        """Bits of each count, whole bytes."""
        return 8 * (self.events // 8 + 1)

    def one(self) -> int:
        """Weight of the start."""
        return 1

    def factor(self, event: ChanceEvent, fate: Fate) -> Any:
        """Shift of one event's fate."""
        return 0 if fate.delay is None else self.bits

    def chance(self, probability: float) -> Any:
        """There is nothing else by chance where outcomes are counted."""
        raise ValueError("expected coefficients where not all outcomes of as many successes are as likely")

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
        size = self.bits // 8
        packed = b"".join([w.to_bytes(size * (degree + 1), "little") for w in weights])
        digits = np.frombuffer(packed, np.uint8).reshape(len(weights), degree + 1, size)
        used = 1 + np.flatnonzero(digits.any(axis=(0, 1))).max()
        return digits[..., :used] @ np.array([256.0**place for place in range(used)])

    def factors(self, factors: Sequence[Any], degree: int) -> np.ndarray:
        """Outcomes' factors as coefficients, shape (factors, degree + 1)."""
        return np.eye(degree + 1)[[factor // self.bits for factor in factors]]


@dataclass(frozen=True)
class Coefficients(_Polynomial):
    """Weights by number of successes, equal µ with delays or detections: coefficients of µ^c (1−µ)^(L−c)."""

    def one(self) -> np.ndarray:
        """Weight of the start, or of no event."""
        return np.ones(1)

    none = one

    def factor(self, event: ChanceEvent, fate: Fate) -> np.ndarray:
        """Coefficients of one event's fate."""
        return np.array([fate.missed, fate.arrived])

    def chance(self, probability: float) -> np.ndarray:
        """Coefficients of what is as likely whatever µ is."""
        return np.array([probability])

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

    def factor(self, event: ChanceEvent, fate: Fate) -> np.ndarray:
        """Probabilities of one event's fate."""
        µ = event.probability
        return fate.missed * (1.0 - µ) + fate.arrived * µ

    def chance(self, probability: float) -> np.ndarray:
        """Probabilities of what is as likely in every row."""
        return np.full(self.rows, probability)

    def both(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Probabilities of two events together."""
        return a * b

    times = both
    product = both

    def table(self, weights: Sequence[Any], degree: int) -> np.ndarray:
        """Probabilities, shape (weights, rows)."""
        return np.array(weights)

    factors = table

    def pairs(self, states: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Weights of every state with every factor, (states, factors, rows)."""
        return states[:, None] * factors

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

    def factor(self, event: ChanceEvent, fate: Fate) -> np.ndarray:
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


Weights = CountWeights | Coefficients | Rows


def bursty(drawn: Sequence[ChanceEvent], rows: int) -> Bursty:
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


def weights_for(network: Network, number_of_events: int, certain: bool = True) -> Weights:
    """Return the cheapest exact bookkeeping by number of successes, where all µ are equal.

    Parameters
    ----------
    certain : whether sensors never miss.
    """
    return CountWeights(number_of_events) if certain and network.delay == (1.0,) else Coefficients()


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
