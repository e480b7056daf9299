"""The contact chain itself: whose measurements an agent holds, walked backwards.

Agent i at step k holds the measurements of its pedigree.  Walk backwards from (i, k): the set S of agents whose
step-t data i holds grows at every step by those that one of S heard there.  With equal links and like agents only the
size r of S matters,

    ad hoc     r → r + Binomial(n − r, 1 − (1−µ)^r)
    broadcast  r → r + Binomial(n − r, µ)
    cyclic     r → r + Bernoulli(µ) while r < n

and otherwise S itself: j ∉ S joins unless all its links into S fail, and different j are independent.  Agents that no
link, delay or sensor tells apart are counted: any two of them may change places, so that of the sets with as many
members of every such class each is as likely as its like, and what joins of a class is binomial.  Only states that can
be reached are followed, on a line the intervals, on a ring the arcs.  So it is their number that counts, not n: 2^n
where all are unlike and everybody hears everybody, Π(n_c + 1) in subnets of n_c, n(n+1)/2 on a line.

Delays.  A message sent at step t that is under way for δ steps counts if its receiver's step-(t+δ) fusion is in the
pedigree: if the receiver joined at least δ steps ago, counted backwards.  The state then holds the age of every member,
the steps since it joined, up to the longest delay D; a link into a member of age a succeeds with µ·P(δ ≤ a).

Bursty links (Gilbert and Elliott).  A link j → i is looked at as long as i is in and j is not, and has failed every
time; a stationary chain of two states looks the same backwards, so what is known of the link is how often it
failed: the age of i.  The link succeeds with the probability of a delivery after so many failures in a row.  With
delays as well, a failure at age a is a message that was lost or came later than a steps.

Detections.  Of the r agents in S at step t ≥ 2 only those count whose sensors measured there, each with its probability
by itself: Binomial(r, p) of every kind.  Who is in S does not depend on it, so that a state is split by what was
measured in it (`_measured`).

The contact chain: the exact expected optimum, in a handful of terms.

If fusion lost nothing, an agent's covariance would be that of one filter with everything it holds,

    E[P_opt(k)] = Σ over paths of T_k(start → s_k) Π_{t<k} T_t(s_{t+1} → s_t) · P(r_1, …, r_k)
    P(r_1) = P(k0)/r_1      P(r_1 … r_t) = update(TU(P(r_1 … r_{t−1})), R/r_t)

where r_t counts the agents whose step-t measurement is held in state s_t of the chain
(`stochfuse.engines.contact_chain`;
with unlike agents one count for each kind).  The chain runs backwards and the filter forwards.  So the chain is
reversed: paths r_1, r_2 … are grown step by step, each with its weight, the vector

    W(s_t) = Σ over s_1 … s_{t−1} with those counts of Π_{τ<t} T_τ(s_{τ+1} → s_τ),

and every step t closes with T_t(start → s_t).  For like agents and equal links there are C(n+k−1, k) paths (fewer on a
ring), and W is one number.  The bias follows the same paths: b(r_1 … r_t) = (I − KH) F b(r_1 … r_{t−1}).

Where paths are too many, `stochfuse.engines.enclosure` gives bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from math import comb, prod
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.events import alike
from stochfuse.errors import UsageError
from stochfuse.estimators.progress import listener
from stochfuse.kalman.algebra import NUMPY
from stochfuse.kalman.kernel import (
    AsTheyAre,
    Estimate,
    SquareRootNumbers,
    at_step,
    from_factor,
    posterior_gain,
    predict,
    predict_factor,
    taken_in,
    update_factor,
)
from stochfuse.scenario.model import Model, Sensor
from stochfuse.scenario.network import LinkRows, Network, delivery_after_failures, number_of_senders, reachable
from stochfuse.scenario.system import System

MOST_STATES = 4096
"""States of the chain."""
NO_MEASUREMENT = 1e-150
MOST_COUNTED = 1000
"""Agents of a class up to which binomial coefficients fit a number."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """States of the chain and how likely they follow one another.

    Parameters
    ----------
    held : (states, kinds) numbers of agents of each kind whose data is held.
    starts : state before the exchange at the last step, for each group of agents.
    transition : T(s → s′) at a step, shape (rows, states, states), for some of the rows.
    constant : whether it is the same at every step.
    """

    held: np.ndarray
    starts: tuple[int, ...]
    transition: Callable[[int, slice | np.ndarray], np.ndarray]
    constant: bool


def contacts(
    network: Network,
    rows: LinkRows,
    kinds: Sequence[int],
    groups: Sequence[tuple[int, ...]],
    detects: np.ndarray | None = None,
) -> Contacts:
    """Return the chain of a network.

    Parameters
    ----------
    kinds : kind of sensor of every agent.
    groups : agents that are alike, one start for each.
    detects : (steps, kinds) probability that a sensor measures; None where all is certain.

    Raises
    ------
    TooManyStatesError
        If the states are too many.
    """
    # a bursty link remembers for how long it has failed
    remembered = network.steps if rows.bursts is not None else min(len(network.delay), network.steps)
    found = _of_classes(network, rows, kinds, groups, remembered)
    return found if detects is None else _measured(found, detects[:, sorted(set(kinds))], network)


def _measured(all_held: Contacts, detects: np.ndarray, network: Network) -> Contacts:
    """Split every state by how many agents of each kind measured in it."""
    missing = detects.min(axis=0) < 1.0
    ranges = [
        [range(r + 1) if missing[kind] else (r,) for kind, r in enumerate(counts)] for counts in all_held.held.tolist()
    ]
    if sum(prod(map(len, each)) for each in ranges) > MOST_STATES:
        raise too_many_states(network.agents)
    split = [(state, counts) for state, each in enumerate(ranges) for counts in product(*each)]
    of, counts = np.array([state for state, _ in split]), np.array([counts for _, counts in split])
    held = all_held.held[of]
    ways = np.array([prod(map(comb, *pair)) for pair in zip(held.tolist(), counts.tolist(), strict=True)], dtype=float)

    def share(step: int) -> np.ndarray:
        """Probability of what was measured in each state."""
        p = detects[step - 1]
        return ways * (p**counts * (1.0 - p) ** (held - counts)).prod(axis=1)

    def transition(step: int, some: slice | np.ndarray) -> np.ndarray:
        return all_held.transition(step, some)[:, of][:, :, of] * share(step)

    # what is measured at the last step is no part of what an agent holds before its exchange
    starts = tuple(int(np.flatnonzero(of == start)[0]) for start in all_held.starts)
    return Contacts(counts, starts, transition, constant=False)


def by_age(delay: Sequence[float], µ: np.ndarray, burst: np.ndarray | None, oldest: int) -> np.ndarray:
    """Probability that a link into a member of age 0 … oldest brings its sender in, (rows, ages).

    Parameters
    ----------
    delay : probabilities of a delay of 0, 1, 2 … steps.
    """
    in_time = np.cumsum(delay)[np.minimum(range(oldest + 1), len(delay) - 1)]
    return µ[:, None] * in_time if burst is None else delivery_after_failures(burst, in_time)


@dataclass(frozen=True, eq=False)
class _Classes:
    """Agents in classes whose members no link and no sensor tells apart: then only how many of each are in matters.

    Parameters
    ----------
    network, rows : whose links.
    members : agents of every class.
    ages : ages 0 … that are told apart.
    """

    network: Network
    rows: LinkRows
    members: Sequence[tuple[int, ...]]
    ages: int

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Receiver and sender that stand for a pair of classes, (classes, classes) each; of one agent, itself."""
        first = np.array([c[0] for c in self.members])
        receiver, sender = np.meshgrid(first, first, indexing="ij")
        np.fill_diagonal(sender, [c[-1] for c in self.members])
        return receiver, sender

    @cached_property
    def possible(self) -> np.ndarray:
        """Whether a receiver of one class may ever hear a sender of another, (classes, classes)."""
        there, link = reachable(self.network)[self.pairs], self.rows.link
        if self.rows.uniform or self.rows.bursts is not None:
            return there
        return there & np.any(link.reshape(-1, *link.shape[-2:]) > 0, axis=0)[self.pairs]

    def failing(self, step: int, some: slice | np.ndarray, states: np.ndarray) -> np.ndarray:
        """Probability that an agent of a class does not join, (rows, states, classes).

        Parameters
        ----------
        states : (states, classes, ages) members of each class and age.
        """
        µ = self.rows.at_step(step)
        lost: dict[tuple[Any, ...], np.ndarray] = {}
        out = np.ones((len(µ[some]), len(states), len(self.members)))
        everyone = states.sum(axis=1)
        for (c, into), may in np.ndenumerate(self.possible.T):
            if not may:
                continue
            receiver, sender = (int(each[into, c]) for each in self.pairs)
            # equal links are worked out once
            delay, key = self.network.delay_of(receiver, sender), () if self.rows.uniform else (receiver, sender)
            if (delay, key) not in lost:
                p = µ[(slice(None), *key)]
                lost[delay, key] = 1.0 - by_age(delay, p, self.rows.chain(p), self.ages - 1)[some]
            failed = lost[delay, key]
            if self.network.architecture == "broadcast":  # heard by all or by none: by the oldest, too
                out[:, :, c] = failed[:, self.ages - 1 - (everyone[:, ::-1] > 0).argmax(axis=1)]
                continue
            for age in range(self.ages):
                present = np.flatnonzero(states[:, into, age])
                out[:, present, c] *= failed[:, age, None] ** states[present, into, age]
        return out


class _Growth(NamedTuple):
    """All that says which states there are.  A state is the numbers of members of every class and age.

    Parameters
    ----------
    sizes : how many agents each class has.
    possible : whether a receiver of one class may ever hear a sender of another, (classes, classes).
    everyone : whether all hear what one hears.
    ages : ages 0 … that are told apart.
    """

    sizes: tuple[int, ...]
    possible: tuple[tuple[bool, ...], ...]
    everyone: bool
    ages: int

    def following(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Classes that may join a state, and the states that may follow, (states, classes, ages).

        Every number that may join of the first such class with every one of the next, the last one fastest.
        """
        inside = state.sum(axis=1)
        joining = np.flatnonzero((inside < self.sizes) & np.array(self.possible)[inside > 0].any(axis=0))
        left = (self.sizes - inside)[joining]
        number = prod((left + 1).tolist())
        if number > MOST_STATES:
            raise too_many_states(sum(self.sizes))
        joined = np.indices(left + 1).reshape(len(left), number).T
        after = np.zeros((number, *state.shape), dtype=state.dtype)
        after[:, :, 1:] = state[:, :-1]
        after[:, :, -1] += state[:, -1]
        after[:, joining, 0] += joined.astype(state.dtype)
        return joining, self.alike(after)

    def alike(self, states: np.ndarray) -> np.ndarray:
        """Give one age to all members whose ages no longer matter: nobody is left whom they may hear, or who is heard
        by some older one too.
        """
        if self.ages == 1:
            return states
        inside = states.sum(axis=2)
        waiting = inside < self.sizes
        if self.everyone:
            waits = np.broadcast_to(waiting.any(axis=1)[:, None], inside.shape)
            oldest = self.ages - 1 - (states.sum(axis=1)[:, ::-1] > 0).argmax(axis=1)
            same, age = np.ones_like(waits), np.where(waits, oldest[:, None], self.ages - 1)
        else:
            same, age = ~(waiting @ np.transpose(self.possible)), np.full(inside.shape, self.ages - 1)
        one = np.zeros_like(states)
        np.put_along_axis(one, age[:, :, None], inside[:, :, None], axis=2)
        return np.where(same[:, :, None], one, states)


@lru_cache(maxsize=2)
def _reached(
    growth: _Growth, first: Sequence[int]
) -> tuple[np.ndarray, list[int], list[tuple[np.ndarray, np.ndarray]]]:
    """States that may be reached, where a member of each of some classes starts, and what may follow every state.

    Kept, since it is the same for all link probabilities.
    """
    number: dict[bytes, int] = {}
    found: list[np.ndarray] = []

    def numbers(states: np.ndarray) -> np.ndarray:
        """Number of every state, a new one of those that are new."""
        size = states[0].nbytes
        keys = np.ascontiguousarray(states).reshape(len(states), -1).view(f"V{size}").ravel().tolist()
        out = np.array([number.setdefault(key, len(number)) for key in keys])
        if len(number) > MOST_STATES:
            raise too_many_states(sum(growth.sizes))
        for place in np.flatnonzero(out >= len(found)):
            if out[place] == len(found):
                found.append(states[place])
        return out

    begin = np.zeros((len(first), len(growth.sizes), growth.ages), dtype=np.int16)
    begin[np.arange(len(first)), first, 0] = 1
    starts = numbers(growth.alike(begin)).tolist()
    follow: list[tuple[np.ndarray, np.ndarray]] = []
    while len(follow) < len(found):
        joining, after = growth.following(found[len(follow)])
        follow.append((joining, numbers(after)))
    return np.array(found), starts, follow


def _of_classes(
    network: Network, rows: LinkRows, kinds: Sequence[int], groups: Sequence[tuple[int, ...]], ages: int
) -> Contacts:
    """The chain, its states split by classes and ages."""
    classes = _Classes(network, rows, alike(network, rows, kinds), ages)
    class_of = {agent: c for c, members in enumerate(classes.members) for agent in members}
    sizes = tuple(map(len, classes.members))
    growth = _Growth(sizes, tuple(map(tuple, classes.possible.tolist())), network.architecture == "broadcast", ages)
    states, starts, follow = _reached(growth, tuple(class_of[agents[0]] for agents in groups))
    left = (sizes - states.sum(axis=2)).tolist()

    def transition(step: int, some: slice | np.ndarray) -> np.ndarray:
        failed = classes.failing(step, some, states)
        T = np.zeros((len(failed), len(states), len(states)))
        for s, (joining, targets) in enumerate(follow):
            probability = np.ones((len(T), 1))
            for c in joining:
                share = _binomial(left[s][c], failed[:, s, c])
                probability = (probability[:, :, None] * share[:, None]).reshape(len(T), -1)
            T[:, s, targets] = probability
        return T

    kind_of = np.array([kinds[members[0]] for members in classes.members])
    inside = states.sum(axis=2)
    held = np.stack([inside[:, kind_of == kind].sum(axis=1) for kind in sorted(set(kinds))], axis=1).astype(int)
    return Contacts(held, tuple(starts), transition, not rows.varies)


def _binomial(n: int, failed: np.ndarray) -> np.ndarray:
    """Probability that 0 … n of n join, each of which does not with a given probability, (rows, n + 1)."""
    if n == 1:
        return np.stack([failed, 1.0 - failed], axis=1)
    joined, p = np.arange(n + 1), failed[:, None]
    if n <= MOST_COUNTED:
        return np.array([comb(n, j) for j in range(n + 1)], dtype=float) * (1.0 - p) ** joined * p ** (n - joined)
    ways = np.concatenate([[0.0], np.cumsum(np.log(np.arange(n, 0, -1) / np.arange(1, n + 1)))])
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.where(m > 0, m * np.log(q), 0.0) for m, q in ((joined, 1.0 - p), (n - joined, p))]
    return np.exp(ways + logs[0] + logs[1])


def too_many_states(agents: int) -> TooManyStatesError:
    """Return the error of a chain that is too large."""
    return TooManyStatesError(
        f"method 'optimal': the contact chain of {agents} agents has more than {MOST_STATES} states with these "
        "links: expected fewer agents or steps, or links and sensors that tell fewer of them apart; or use --method "
        "monte-carlo with --estimator optimal"
    )


def by_number(system: System, links: LinkRows) -> bool:
    """Whether only the number of agents matters whose data is held: like agents and equal links."""
    return len(set(system.sensor_of)) == 1 and links.uniform and system.network.delays is None


def number_of_paths(network: Network) -> int:
    """How many paths r_1 ≥ … ≥ r_k there are for like agents: C(n+k−1, k); on a ring those that fall by at most 1."""
    n, k = network.agents, network.steps
    if number_of_senders(network.architecture, n) == 0:
        return 1
    if network.architecture != "cyclic":
        return comb(n + k - 1, k)
    # in some of k exchanges one agent joins; the last of n joins at some exchange t, and nothing happens after it
    fewer = sum(comb(k, joins) for joins in range(min(n - 1, k + 1)))
    return fewer + sum(comb(t - 1, n - 2) for t in range(n - 1, k + 1))


MOST_PATHS = 20_000
"""Paths up to which they are gone through one by one."""
MOST_NUMBERS = 20_000_000
"""Transition probabilities, or weights of paths, that are held at a time."""


class AlongPath(NamedTuple):
    """What is left of the initial error, (..., d, 1), and the covariance: its square root for several components.

    A covariance of several components would lose the digits of precise sensors to the subtraction in its update.  The
    error is None where it is not asked for.
    """

    x: Any
    root: np.ndarray


class LosslessFilter(NamedTuple):
    """What an agent that loses nothing would compute.

    One filter for all rows of link probabilities, or one for each: then noises have an axis of rows, see
    `stochfuse.scenario.system.Noises`, and so has what is carried, after that of the paths.

    Parameters
    ----------
    model : state transition and process noise.
    sensors : sensor of each kind of agent.
    P0 : covariance of one initial estimate, (d, d) or (rows, d, d).
    shared : whether all agents start from one common estimate.
    error : (d, 1) initial error that all agents share, or None.
    numbers : what the numbers go through.
    first : covariance to start from by the counts held, in the place of that of first estimates.
    """

    model: Model
    sensors: Sequence[Sensor]
    P0: np.ndarray
    shared: bool
    error: np.ndarray | None = None
    numbers: SquareRootNumbers = AsTheyAre()
    first: Mapping[tuple[int, ...], np.ndarray] | None = None

    def begins(self, counts: np.ndarray) -> list[int]:
        """Places of the counts that a path may start with: at step 1 everybody has a first estimate."""
        return np.flatnonzero(counts.any(axis=1) | (self.first is not None)).tolist()

    @classmethod
    def of(cls, system: System) -> LosslessFilter:
        """Return the filter of a system's agents."""
        return cls(system.model, system.sensors, system.P0, system.shared, system.error)

    def start(self, counts: np.ndarray) -> AlongPath:
        """Estimate from so many agents' initial ones, and what it leaves of the error."""
        first = self.P0 if self.shared or self.first is not None else self.P0 / counts.sum()
        P = (first if self.first is None else self.first[tuple(counts.tolist())])[None]
        x = None if self.error is None else np.broadcast_to(self.error, (*P.shape[:-1], 1))
        return AlongPath(x, P if self.scalar else self.numbers.factor(P))

    def after(self, before: AlongPath, counts: np.ndarray, step: int) -> AlongPath:
        """Predict to a step and take in the measurements of so many agents of each kind; of errors, if there are.

        The numbers may be a stack (..., kinds) that goes with the estimate's.
        """
        F, Q = at_step(self.model.F, step), at_step(self.model.Q, step)
        given = self.numbers
        sensors = [(given.rounded(at_step(s.H, step)), given.noise(at_step(s.R, step))) for s in self.sensors]
        arrived = [(H, R, n) for kind, (H, R) in enumerate(sensors) if (n := counts[..., kind]).any()]
        if self.scalar:
            x, P = predict(Estimate(*before), F, Q)
            # all that measurements of a scalar say, whatever their size
            J = sum((n * (H.T @ NUMPY.solve(R, H))[..., 0, 0] for H, R, n in arrived), np.zeros(()))
            P, x = taken_in(P[None, None, ..., 0, 0], J, None if x is None else x[None, ..., 0, 0])
            return AlongPath(None if x is None else x[0, ..., None, None], P[0, 0, ..., None, None])
        x, L = before.x, given.rounded(predict_factor(given.rounded(before.root), F, given.factor(Q)))
        x = x if x is None else F @ x
        for H, R, n in arrived:
            L = update_factor(L, H, R, lambda s: 1.0 / (1.0 + n[..., None] * s))  # noqa: B023
            x = x if x is None else x - posterior_gain(L, H, R / _at_least(n)[..., None, None]) @ (H @ x)
        return AlongPath(x, L)

    def covariance(self, carried: AlongPath) -> np.ndarray:
        """Covariance of what is carried."""
        return carried.root if self.scalar else from_factor(carried.root)

    @property
    def scalar(self) -> bool:
        """Whether the state has one component."""
        return self.model.dimension == 1


def _at_least(n: np.ndarray) -> np.ndarray:
    """Numbers of measurements to divide noise by, where in a stack some are none."""
    return np.maximum(n, NO_MEASUREMENT)


class Chain(NamedTuple):
    """Expected optimum.

    Parameters
    ----------
    P : (rows, steps, groups, d, d) expectation, or the middle of what encloses it.
    bias : (rows, steps, groups, d, 1), or None where it is not known.
    square : (rows, steps, groups, d, d) E[P + b bᵀ], or None.
    bound : (rows, steps) relative half-width of the enclosure; 0 where every path was gone through.
    paths : number of paths gone through, or None.
    rounding : (rows,) how far rounding may reach in the covariance, relative to the standard deviations.
    """

    P: np.ndarray
    bias: np.ndarray | None
    square: np.ndarray | None
    bound: np.ndarray
    paths: int | None
    rounding: np.ndarray | float = 0.0


class TooManyStatesError(UsageError):
    """More states of the chain than can be gone through."""


class TooManyPathsError(UsageError):
    """More paths than can be gone through one by one."""


def by_counts(contacts: Contacts) -> tuple[np.ndarray, list[np.ndarray]]:
    """Different counts (classes, kinds), and the states of each."""
    states: dict[tuple[int, ...], list[int]] = {}
    for state, held in enumerate(contacts.held.tolist()):
        states.setdefault(tuple(held), []).append(state)
    return np.array(sorted(states)), [np.array(states[held]) for held in sorted(states)]


def blocks_of_rows(contacts: Contacts, rows: int) -> Iterator[slice]:
    """Rows in blocks whose transition probabilities fit in memory."""
    size = max(1, MOST_NUMBERS // len(contacts.held) ** 2)
    return (slice(first, min(first + size, rows)) for first in range(0, rows, size))


def transitions(contacts: Contacts, steps: int, some: slice | np.ndarray) -> Iterator[np.ndarray]:
    """T of every step in turn."""
    T = contacts.transition(1, some)
    progress = listener()
    for step in range(1, steps + 1):
        progress.advance("contact chain", step, steps)
        yield T
        if step < steps and not contacts.constant:
            T = contacts.transition(step + 1, some)


def closing(T: np.ndarray, starts: Sequence[int], here: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Probability of every path that ends in some states, (rows, groups, paths), from its weight there."""
    return T[:, list(starts)][:, :, here] @ weight


def leading(
    classes: Mapping[int, Any], T: np.ndarray, here: np.ndarray, states: Sequence[np.ndarray]
) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
    """Classes of paths that may lead to the states here: the class, which of its paths do, and their weight here."""
    rows_here = T[:, here]
    from_here = np.asarray(rows_here.any(axis=(0, 1)))
    for before, paths in classes.items():
        if from_here[states[before]].any():
            weight = rows_here[:, :, states[before]] @ paths.weight
            alive = np.flatnonzero(weight.any(axis=(0, 1)))
            if len(alive):
                yield paths, alive, weight[:, :, alive]


def expected_optimum(given: LosslessFilter, contacts: Contacts, steps: int, rows: int) -> Chain:
    """Go through every path.

    Parameters
    ----------
    steps, rows : numbers of steps, and of rows of link probabilities.

    Raises
    ------
    TooManyPathsError
        If there are more than `MOST_PATHS`.
    """
    return joined([over_paths(given, contacts, steps, some) for some in blocks_of_rows(contacts, rows)])


def joined(found: Sequence[tuple[list[np.ndarray], int]]) -> Chain:
    """Return what `over_paths` found for all blocks of rows."""
    P, *errors = (np.concatenate(moment) for moment in zip(*(moments for moments, _ in found), strict=True))
    b, M = errors or (np.zeros((*P.shape[:-1], 1)), P)
    return Chain(P, b, M, np.zeros(P.shape[:2]), found[0][1])


def over_paths(
    given: LosslessFilter, contacts: Contacts, steps: int, some: slice | np.ndarray
) -> tuple[list[np.ndarray], int]:
    """E[P] and, where errors are followed, E[b] and E[P + b bᵀ] of some rows, each (rows, steps, groups, …); and the
    number of paths.

    Parameters
    ----------
    given : one filter for all rows, or one for each of these.

    Raises
    ------
    TooManyPathsError
        If there are more than `MOST_PATHS`.
    """
    counts, states = by_counts(contacts)
    first = given.begins(counts)
    single = len(states) == len(contacts.held)
    paths = _PathsOfStates(states, first) if single else _PathsOfCounts(states, first)
    x, roots = zip(*(given.start(counts[c]) for c in first), strict=True)
    carried = AlongPath(None if x[0] is None else np.concatenate(x), np.concatenate(roots))
    out, before = [], np.empty(0)
    for step, T in enumerate(transitions(contacts, steps, some), start=1):
        if step > 1:
            parent = paths.grow(before)
            n = counts[paths.counts]
            n = n if carried.root.ndim == 3 else n[:, None]  # a filter for each row
            x = None if carried.x is None else carried.x[parent]
            carried = given.after(AlongPath(x, carried.root[parent]), n, step)
        weight, P, x = paths.closing(T, contacts.starts), given.covariance(carried), carried.x
        moments = (P,) if x is None else (P, x, P + x @ np.swapaxes(x, -1, -2))
        out.append([_over(weight, moment) for moment in moments])
        before = T
    return [np.stack(moment, axis=1) for moment in zip(*out, strict=True)], len(carried.root)


class _PathsOfStates:
    """Paths and their weights (rows, paths), where every state has counts of its own.

    Parameters
    ----------
    states : states of the different counts.
    counts : place of those that every path begins with, and ends with later.
    """

    def __init__(self, states: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        self.counts, self._state, self._weight = np.array(counts), np.concatenate(states), np.ones((1, len(counts)))

    def grow(self, T: np.ndarray) -> np.ndarray:
        """Let all counts follow that may, and return which path each was before."""
        now = self._state[self.counts]
        after, parent = np.asarray(T.any(axis=0))[self._state][:, now].nonzero()
        check_size(0, len(T) * len(after))
        weight = self._weight[:, parent] * T[:, self._state[after], now[parent]]
        alive = weight.any(axis=0)
        if not alive.all():
            after, parent, weight = after[alive], parent[alive], weight[:, alive]
        self.counts, self._weight = after, weight
        check_size(len(after))
        return parent

    def closing(self, T: np.ndarray, starts: Sequence[int]) -> np.ndarray:
        """Probability of every path, (rows, groups, paths)."""
        return T[:, list(starts)][:, :, self._state[self.counts]] * self._weight[:, None]


class _Class(NamedTuple):
    """Paths that end with the same counts, one after another: which is the first, and weights (rows, states, paths)."""

    first: int
    weight: np.ndarray


class _PathsOfCounts:
    """The same where several states may have the same counts: a path's weight is a vector over these."""

    def __init__(self, states: Sequence[np.ndarray], counts: Sequence[int]) -> None:
        self._states, self.counts = states, np.array(counts)
        self._classes = {c: _Class(first, np.ones((1, len(states[c]), 1))) for first, c in enumerate(counts)}

    def grow(self, T: np.ndarray) -> np.ndarray:
        """Let all counts follow that may, and return which path each was before."""
        grown: dict[int, _Class] = {}
        parents, paths, numbers = [], 0, 0
        for c, here in enumerate(self._states):
            weights = []
            for before, alive, weight in leading(self._classes, T, here, self._states):
                parents.append(before.first + alive)
                weights.append(weight)
            if weights:
                grown[c] = _Class(paths, np.concatenate(weights, axis=2))
                paths, numbers = paths + grown[c].weight.shape[2], numbers + grown[c].weight.size
                check_size(paths, numbers)
        self._classes = grown
        self.counts = np.repeat(list(grown), [paths.weight.shape[2] for paths in grown.values()])
        return np.concatenate(parents)

    def closing(self, T: np.ndarray, starts: Sequence[int]) -> np.ndarray:
        """Probability of every path, (rows, groups, paths)."""
        each = [closing(T, starts, self._states[c], paths.weight) for c, paths in self._classes.items()]
        return np.concatenate(each, axis=2)


def _over(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    if values.ndim == 4:  # a filter for each row
        return np.einsum("rgp,prij->rgij", weight, values)
    paths = len(values)
    return (weight.reshape(-1, paths) @ values.reshape(paths, -1)).reshape(*weight.shape[:-1], *values.shape[1:])


def check_size(paths: float, numbers: float = 0.0) -> None:
    """Raise TooManyPathsError beyond `MOST_PATHS` paths or `MOST_NUMBERS` weights."""
    if paths > MOST_PATHS or numbers > MOST_NUMBERS:
        raise TooManyPathsError(
            f"the contact chain has {paths:.3g} paths or more, at most {MOST_PATHS} are gone through one by one: use "
            "fewer steps or agents, or --method monte-carlo with --estimator optimal"
        )
