"""The contact chain itself: whose measurements an agent holds, walked backwards (theory section 6).

Agent i at step k holds the measurements of its pedigree.  Walk backwards from (i, k): the set S of agents whose
step-t data i holds grows at every step by those that one of S heard there.  With equal links and like agents only the
size r of S matters,

    ad hoc     r → r + Binomial(n − r, 1 − (1−µ)^r)
    broadcast  r → r + Binomial(n − r, µ)
    cyclic     r → r + Bernoulli(µ) while r < n

and otherwise S itself, at most 2^n states: j ∉ S joins unless all its links into S fail, and different j are
independent.

Delays.  A message sent at step t that is under way for δ steps counts if its receiver's step-(t+δ) fusion is in the
pedigree: if the receiver joined at least δ steps ago, counted backwards.  The state then holds the age of every member,
the steps since it joined, up to the longest delay D; a link into a member of age a succeeds with µ·P(δ ≤ a).

Bursty links (Gilbert and Elliott).  A link j → i is looked at as long as i is in and j is not, and has failed every
time; a stationary chain of two states looks the same backwards, so what is known of the link is how often it
failed: the age of i.  The link succeeds with the probability of a delivery after so many failures in a row.  With
delays as well, a failure at age a is a message that was lost or came later than a steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.events import Event, events
from stochfuse.network import LinkRows, Network, delivery_after_failures, number_of_senders

MOST_STATES = 4096
"""States of the chain."""
MOST_AGENTS, MOST_UNLIKE = 500, 12
"""Agents that are alike, and agents that are not."""


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
    transition: Callable[[int, slice], np.ndarray]
    constant: bool


def contacts(network: Network, rows: LinkRows, kinds: Sequence[int], groups: Sequence[tuple[int, ...]]) -> Contacts:
    """Return the chain of a network.

    Parameters
    ----------
    kinds : kind of sensor of every agent.
    groups : agents that are alike, one start for each.

    Raises
    ------
    UsageError
        If the states are too many.
    """
    bursty = rows.bursts is not None
    oldest = network.steps - 1 if bursty else min(len(network.delay), network.steps) - 1
    if len(set(kinds)) == 1 and rows.uniform:
        return _of_counts(network, rows, oldest)
    return _of_sets(network, rows, kinds, groups, oldest)


def by_age(network: Network, µ: np.ndarray, burst: np.ndarray | None, oldest: int) -> np.ndarray:
    """Probability that a link into a member of age 0 … oldest brings its sender in, (rows, ages)."""
    in_time = np.cumsum(network.delay)[np.minimum(range(oldest + 1), len(network.delay) - 1)]
    return µ[:, None] * in_time if burst is None else delivery_after_failures(burst, in_time)


def _of_counts(network: Network, rows: LinkRows, oldest: int) -> Contacts:
    """Like agents and equal links.  A state is the ages of the members, of those whose links still matter."""
    n = network.agents
    if n > MOST_AGENTS:
        raise UsageError(f"method 'optimal' takes at most {MOST_AGENTS} agents, got {n}")
    states = list(_ages(network, oldest))
    if len(states) > MOST_STATES:
        raise _too_many(network)
    number = {state: s for s, state in enumerate(states)}
    targets = [
        [number[_older(network, state, joined, oldest)] for joined in range(_joiners(network, state[0]) + 1)]
        for state in states
    ]

    def transition(step: int, some: slice) -> np.ndarray:
        µ = rows.at_step(step)
        success = by_age(network, µ, rows.chain(µ), oldest)[some]
        T = np.zeros((len(success), len(states), len(states)))
        for s, (_, ages) in enumerate(states):
            failed = (1.0 - success[:, list(ages)]).prod(axis=1)
            out = len(targets[s]) - 1
            for joined, target in enumerate(targets[s]):
                T[:, s, target] += comb(out, joined) * (1.0 - failed) ** joined * failed ** (out - joined)
        return T

    held = np.array([[r] for r, _ in states])
    return Contacts(held, (number[1, (0,)],), transition, not rows.varies)


def _ages(network: Network, oldest: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """States (r, ages that matter): of all members ad hoc, of the oldest in a broadcast, of the last one on a ring."""
    n = network.agents
    for r in range(1, n):
        if oldest == 0 or network.architecture != "ad-hoc":
            yield from ((r, (age,) * (r if network.architecture == "ad-hoc" else 1)) for age in range(oldest + 1))
            continue
        if comb(r + oldest, oldest) > MOST_STATES:
            raise _too_many(network)
        for ages in combinations_with_replacement(range(oldest, -1, -1), r):
            yield r, ages
    yield n, () if n > 1 else (0,)


def _joiners(network: Network, r: int) -> int:
    return min(network.agents - r, 1) if network.architecture == "cyclic" else network.agents - r


def _older(
    network: Network, state: tuple[int, tuple[int, ...]], joined: int, oldest: int
) -> tuple[int, tuple[int, ...]]:
    r, ages = state
    if r + joined == network.agents:
        return r + joined, () if network.agents > 1 else (0,)
    older = tuple(min(age + 1, oldest) for age in ages)
    if network.architecture == "ad-hoc":
        older += (0,) * joined
    elif network.architecture == "cyclic" and joined:
        older = (0,)
    return r + joined, older


def _too_many(network: Network) -> UsageError:
    return UsageError(
        f"method 'optimal': the contact chain of {network.agents} agents has more than {MOST_STATES} states with these "
        "links: expected fewer agents or steps, or equal links without delay; or use --method monte-carlo with "
        "--estimator optimal"
    )


def _of_sets(
    network: Network, rows: LinkRows, kinds: Sequence[int], groups: Sequence[tuple[int, ...]], oldest: int
) -> Contacts:
    """Unequal links or unlike agents.  A state is a number with a digit per agent: 0, or 1 + its age if it is in."""
    n, base = network.agents, oldest + 2
    if n > MOST_UNLIKE:
        raise UsageError(
            f"method 'optimal' takes at most {MOST_UNLIKE} agents where they or their links differ, got {n}: use "
            "--method monte-carlo with --estimator optimal"
        )
    place = base ** np.arange(n, dtype=np.int64)
    starts = [int(place[agents[0]]) for agents in groups]
    found = np.array(sorted(set(starts)), dtype=np.int64)
    while True:
        digits = found[:, None] // place % base
        new = [_subsets(_aged(d, base) @ place, place[d == 0]) for d in digits]
        grown = np.unique(np.concatenate([found, *new]))
        if len(grown) > MOST_STATES:
            raise _too_many(network)
        if len(grown) == len(found):
            break
        found = grown
    targets = [np.searchsorted(found, t) for t in new]

    def transition(step: int, some: slice) -> np.ndarray:
        drawn = events(network, rows, step)
        success = [by_age(network, e.probability, e.burst, oldest)[some] for e in drawn]
        T = np.zeros((len(rows.link[some]), len(found), len(found)))
        for s, state in enumerate(digits):
            probability = np.ones((len(T), 1))
            for sender in np.flatnonzero(state == 0):
                failed = _failed(drawn, success, int(sender), state, len(T))
                probability = np.concatenate(
                    [probability * failed[:, None], probability * (1.0 - failed)[:, None]], axis=1
                )
            T[:, s, targets[s]] = probability
        return T

    held = np.stack([((digits > 0) & (np.asarray(kinds) == kind)).sum(axis=1) for kind in sorted(set(kinds))], axis=1)
    return Contacts(held, tuple(np.searchsorted(found, starts).tolist()), transition, not rows.varies)


def _aged(digits: np.ndarray, base: int) -> np.ndarray:
    return np.where(digits > 0, np.minimum(digits + 1, base - 1), 0)


def _subsets(state: Any, joining: np.ndarray) -> np.ndarray:
    """State with every subset of the joining digits set to age 0; a later one is a higher bit of the place."""
    total = np.array([state], dtype=np.int64)
    for digit in joining:
        total = np.concatenate([total, total + digit])
    return total


def _failed(
    drawn: Sequence[Event], success: Sequence[np.ndarray], sender: int, state: np.ndarray, rows: int
) -> np.ndarray:
    """Probability that a sender does not join a state, (rows,)."""
    failed = np.ones(rows)
    for event, by_ages in zip(drawn, success, strict=True):
        if event.sender == sender:
            age = max((int(state[i]) for i in event.receivers), default=0) - 1
            if age >= 0:
                failed = failed * (1.0 - by_ages[:, age])
    return failed


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
