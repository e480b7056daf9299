"""What may arrive in a step, and how likely: the events of (44)–(46).

A step draws independent events: every ordered pair of agents in an ad hoc network, every sender in a broadcast one,
every agent's one link in a cyclic one.  An event succeeds with probability µ, and everyone it concerns then hears the
sender, at once or after a delay that is drawn with it.  Sets of agents are masks, bit i for agent i.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from stochfuse.estimators import Late
from stochfuse.network import LinkRows, Network, possible_senders
from stochfuse.weights import Rows, Weights

MOST_AGENTS_RELABELLED = 7
"""Agents up to which relabellings are looked for: their number grows with the factorial."""


class Event(NamedTuple):
    """One draw of a step: who sends, who hears it, and with which probability in each row.

    Of a bursty link `probability` is the mean; `burst` (rows, 4) says how it comes about, and `number` which link it is
    among those of every step.
    """

    sender: int
    receivers: tuple[int, ...]
    probability: np.ndarray
    burst: np.ndarray | None = None
    number: int = 0


class Fate(NamedTuple):
    """What became of an event: a delay, or None if nothing will come of it; and the weight of that."""

    delay: int | None
    missed: Any
    arrived: Any


class Outcome(NamedTuple):
    """Which agents each agent hears in a step (itself included), what is under way, and the outcome's factor."""

    heard: tuple[int, ...]
    late: tuple[Late, ...]
    factor: Any


def events(network: Network, rows: LinkRows, step: int) -> list[Event]:
    """Events of a step, those that are impossible in every row left out where links differ."""
    n, senders = network.agents, possible_senders(network.architecture, network.agents)
    µ = rows.matrices(network, step)
    if network.architecture == "broadcast":
        place = {(i, j): p for i in range(n) for p, j in enumerate(senders[i])}
        listeners = {j: tuple(i for i in range(n) if i != j) for j in range(n)}
        found = [Event(j, heard, µ[:, heard[0], place[heard[0], j]]) for j, heard in listeners.items() if heard]
    else:
        found = [Event(int(j), (i,), µ[:, i, p]) for i in range(n) for p, j in enumerate(senders[i])]
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
    steps = range(1, network.steps + 1 if rows.varies else 2)
    link = np.zeros((len(steps), len(rows.link), n, n))
    for k, step in enumerate(steps):
        for i, (senders, µ) in enumerate(
            zip(possible_senders(network.architecture, n), np.moveaxis(rows.matrices(network, step), 1, 0), strict=True)
        ):
            link[k][:, i, senders] = µ + 1.0  # told apart from a link that does not exist
    found = []
    for p in permutations(range(n)):
        order = list(p)
        if all(sources[a] == sources[i] for i, a in enumerate(p)) and (link == link[..., order, :][..., order]).all():
            found.append(p)
    return found


def orbits(n: int, permutations: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Agents that some relabelling takes into one another, as sorted groups."""
    group = list(range(n))
    for p in permutations:
        for i, a in enumerate(p):
            low, high = sorted((group[i], group[a]))
            group = [low if g == high else g for g in group]
    return [tuple(i for i in range(n) if group[i] == g) for g in sorted(set(group))]


def outcomes(drawn: Sequence[Event], agents: int, delay: Sequence[float], left: int, weights: Weights) -> list[Outcome]:
    """Every outcome of a step that has a positive probability in some row.

    Parameters
    ----------
    drawn : the step's events.
    left : steps left after this one; what arrives later does not matter.
    """
    choices = fates(delay, left)
    whole = [Outcome(tuple(1 << i for i in range(agents)), (), weights.none())]
    for event in drawn:
        options = [(fate, weights.factor(event, fate)) for fate in choices]
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
    return whole


def concerning(drawn: Sequence[Event], agents: Sequence[int]) -> list[Event]:
    """Events that concern some agents."""
    return [event for event in drawn if set(event.receivers) & set(agents)]


def _heard(heard: tuple[int, ...], event: Event, fate: Fate) -> tuple[int, ...]:
    if fate.delay != 0:
        return heard
    return tuple(h | 1 << event.sender if i in event.receivers else h for i, h in enumerate(heard))


def _late(event: Event, fate: Fate) -> tuple[Late, ...]:
    if not fate.delay:
        return ()
    return tuple(Late(receiver, fate.delay, event.sender) for receiver in event.receivers)
