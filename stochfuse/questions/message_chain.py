"""How many new nodes reach an agent in a step, walked backwards; see `stochfuse.questions.messages` for what is
counted.

Pedigrees hold with every node all earlier ones of its agent, so an agent's knowledge is the
latest node it has of every agent.  Walk backwards from (i, k), as the contact chain does: B_t ∋ i are the agents whose
node of step t is known to i after the exchange of step k, and A_t ⊆ B_t those whose node of step t was known before it,

    load of i at k = Σ_{t=1..k} (|B_t| − |A_t|)      A_k = {i}, B_k = {i} ∪ those heard by i at k
    t < k:  B_t = B_{t+1} ∪ those heard at t by a member of B_{t+1}, A_t likewise; once A = B nothing more is added

(A, B) is a Markov chain, for like agents in their numbers alone, and sizes are added up along it.  It gives the same
distribution as the forward chain of the latest nodes that everyone knows of everyone, from four states for three like
agents, n(n−1)/2 + 1 for n, for all rows of link probabilities at once.  Every term is positive.

A naive message is one node, so that a naive load is the number of arrivals, Poisson-binomial.

Message loads sampled: follow the latest node of every agent that every agent knows; see `stochfuse.questions.messages`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import comb

import numpy as np

from stochfuse.engines.events import ChanceEvent, concerning
from stochfuse.errors import UsageError
from stochfuse.estimators.progress import listener
from stochfuse.kalman.arrivals import poisson_binomial
from stochfuse.scenario.network import LinkRows, Network, number_of_senders, possible_senders

MOST_STATES, MOST_NUMBERS = 2500, 100_000_000
"""States of the walk, and numbers in its transitions, up to which they are carried."""


def like_agents(network: Network, rows: LinkRows, aside: int | None = None) -> list[list[int]]:
    """Groups of agents that are alike: any two may be exchanged without a change in who hears whom how likely.

    Parameters
    ----------
    aside : an agent that keeps its place and is in no group; None: of all agents, a ring of like links counting as
        alike because it may be turned.
    """
    n, others = network.agents, [i for i in range(network.agents) if i != aside]
    if rows.uniform and (aside is None or network.architecture != "cyclic"):
        return [others] if others else []
    senders, steps = possible_senders(network.architecture, n), range(1, network.steps + 1 if rows.varies else 2)
    link = np.full((len(steps), len(rows.link), n, n), -1.0)
    for k, step in enumerate(steps):
        np.put_along_axis(link[k], senders[None], rows.matrices(network, step), axis=2)
    groups: list[list[int]] = []
    for i in others:
        for group in groups:
            order = np.arange(n)
            order[[i, group[0]]] = group[0], i
            if (link[:, :, order][..., order] == link).all():
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def naive_load(network: Network, rows: LinkRows, drawn: list[list[ChanceEvent]], agent: int) -> np.ndarray:
    """Distribution of the number of arrivals, (rows, steps, sizes)."""
    out = np.zeros((len(rows.link), len(drawn), number_of_senders(network.architecture, network.agents) + 1))
    for k, now in enumerate(drawn if rows.varies else drawn[:1]):
        µ = [event.probability for event in concerning(now, [agent])]
        found = poisson_binomial(np.stack(µ)) if µ else np.ones((1, len(out)))
        out[:, k : k + 1 if rows.varies else None, : len(found)] = found.T[:, None]
    return out


def walked_load(network: Network, rows: LinkRows, drawn: list[list[ChanceEvent]], agent: int) -> np.ndarray:
    """Distribution of the load by the backward walk, (rows, steps, sizes)."""
    walk = _Walk(agent, like_agents(network, rows, agent), drawn if rows.varies else drawn[:1], len(rows.link))
    largest = (network.agents - 1) * network.steps
    if not rows.varies:
        # where every step draws alike, one walk passes the answer of every step
        return np.stack(list(walk.back(network.steps, largest)), axis=1)
    return np.stack([list(walk.back(k, largest))[-1] for k in range(1, network.steps + 1)], axis=1)


class _Walk:
    """The chain of (A, B) behind one agent; a state is how many agents of every class are in A and in B, (2, classes).

    Parameters
    ----------
    agent : i.
    classes : the other agents, those that are alike together.
    drawn : events of every step, or of one where all steps draw alike.
    rows : number of rows.
    """

    def __init__(self, agent: int, classes: list[list[int]], drawn: list[list[ChanceEvent]], rows: int) -> None:
        self.agent, self.classes, self.rows, self.drawn = agent, classes, rows, len(drawn)
        self._check(max((comb(len(members) + 2, 2) for members in classes), default=1))
        # per step and sender: whom each event reaches, and the probability that it fails
        self.by_sender: list[dict[int, list[tuple[set[int], np.ndarray]]]] = []
        for now in drawn:
            senders: dict[int, list[tuple[set[int], np.ndarray]]] = {}
            for event in now:
                senders.setdefault(event.sender, []).append((set(event.receivers), 1.0 - event.probability))
            self.by_sender.append(senders)
        self.states: list[np.ndarray] = []
        self.index: dict[bytes, int] = {}
        nobody = np.zeros((2, len(classes)), dtype=np.int16)
        self.starts: list[tuple[list[int], np.ndarray]] = []
        for step in range(self.drawn):
            heard, weights = self._moves(step, nobody)
            heard[:, 0] = 0
            self.starts.append((self._places(heard), weights))
        self._explore()

    def back(self, last: int, largest: int) -> Iterator[np.ndarray]:
        """Distributions (rows, sizes) of what is counted down to steps last, last − 1 … 1."""
        gaps = np.array([int(b.sum() - a.sum()) for a, b in self.states] + [0])
        mass = np.zeros((self.rows, len(gaps), largest + 1))
        places, weights = self.starts[self._drawn_at(last)]
        mass[:, places, gaps[places]] = weights.T
        yield mass.sum(axis=1)
        for step in range(last - 1, 0, -1):
            listener().advance("message load", last - step, last)
            moved = np.matmul(self.transitions[self._drawn_at(step)], mass)
            mass = np.zeros_like(moved)
            for gap in np.unique(gaps):
                mass[:, gaps == gap, gap:] = moved[:, gaps == gap, : largest + 1 - gap]
            yield mass.sum(axis=1)

    def _drawn_at(self, step: int) -> int:
        return min(step, self.drawn) - 1

    def _places(self, targets: np.ndarray) -> list[int]:
        """Numbers of states, new ones in line to be explored; −1 where A = B."""
        places = []
        for state, over in zip(targets, (targets[:, 0] == targets[:, 1]).all(axis=1), strict=True):
            place = -1 if over else self.index.setdefault(state.tobytes(), len(self.index))
            if place == len(self.states):
                self.states.append(state)
            places.append(place)
        self._check(len(self.states))
        return places

    def _explore(self) -> None:
        """Find the states that can be reached, and their transitions (steps, rows, to, from); the last is A = B."""
        found = []
        for place, state in enumerate(self.states):  # grows on the way
            for step in range(self.drawn):
                targets, weights = self._moves(step, state)
                found.append((step, place, self._places(targets), weights))
        self.transitions = np.zeros((self.drawn, self.rows, len(self.states) + 1, len(self.states) + 1))
        self.transitions[:, :, -1, -1] = 1.0
        for step, place, places, weights in found:
            going, over = np.array(places) >= 0, np.array(places) < 0
            self.transitions[step, :, np.array(places)[going], place] = weights[going]
            self.transitions[step, :, -1, place] = weights[over].sum(axis=0)

    def _check(self, states: int) -> None:
        if states > MOST_STATES or states**2 * self.rows * self.drawn > MOST_NUMBERS:
            raise UsageError(
                f"message load: the exact walk for {sum(map(len, self.classes)) + 1} agents passes {states} states or "
                f"more for each of {self.rows} link probabilities: use --method monte-carlo, fewer agents or fewer "
                "link probabilities"
            )

    def _moves(self, step: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a state goes when the exchange of a step is added: targets (m, 2, classes), weights (m, rows)."""
        A, B = ({self.agent, *self._members(counts)} for counts in state.tolist())
        targets, weights = state[None], np.ones((1, self.rows))
        for c, members in enumerate(self.classes):
            in_A, in_B = state[:, c].tolist()
            if in_A == len(members):
                continue
            # the last of a class joins last, and stands for all that have not joined
            fails = self.by_sender[step].get(members[-1], [])
            by_A = _product([q for to, q in fails if to & A], self.rows)
            by_rest = _product([q for to, q in fails if to & B and not to & A], self.rows)
            joins = _joins(len(members) - in_B, in_B - in_A, by_A, by_rest)
            more = np.argwhere(joins.any(axis=-1))
            targets = np.repeat(targets, len(more), axis=0)
            targets[:, :, c] += np.tile(more, (len(weights), 1)).astype(np.int16)
            weights = (weights[:, None] * joins[more[:, 0], more[:, 1]]).reshape(-1, self.rows)
            self._check(len(weights))
        return targets, weights

    def _members(self, counts: list[int]) -> Iterator[int]:
        for members, count in zip(self.classes, counts, strict=True):
            yield from members[:count]


def _product(factors: list[np.ndarray], rows: int) -> np.ndarray:
    return np.prod(factors, axis=0) if factors else np.ones(rows)


def _joins(outside: int, middle: int, by_A: np.ndarray, by_rest: np.ndarray) -> np.ndarray:
    """Probability that x agents of a class join A and y join B, (x, y, rows).

    Parameters
    ----------
    outside, middle : agents of the class outside B, and in B but not in A.
    by_A, by_rest : probability that nobody in A hears one of them, and that nobody in B hears it who is not in A.
    """
    heard = 1.0 - by_A
    new = {(0, 0): by_A * by_rest, (0, 1): by_A * (1.0 - by_rest), (1, 1): heard}
    known = {(0, 0): by_A, (1, 0): heard}
    out = np.ones((1, 1, len(heard)))
    for one in [new] * outside + [known] * middle:
        x, y, _ = out.shape
        grown = np.zeros((x + 1, y + (one is new), len(heard)))
        for (in_A, in_B), weight in one.items():
            grown[in_A : in_A + x, in_B : in_B + y] += weight * out
        out = grown
    return out


MOST_NUMBERS = 100_000_000
"""Numbers in a sample."""
MOST_UPDATES = 20_000_000_000
"""Updates up to which loads are sampled: some two minutes."""
BLOCK = 250
"""Runs drawn from one seed."""


def sampled_loads(agents: int, drawn: Sequence[Sequence[ChanceEvent]], rows: int, runs: int, seed: int) -> np.ndarray:
    """Loads of simulated agents, (rows, runs, steps, agents); all rows are drawn from the same random numbers."""
    numbers = max(rows * runs * len(drawn) * agents, rows * min(runs, BLOCK) * agents**2)
    if numbers > MOST_NUMBERS:
        raise UsageError(
            f"runs: {runs} runs for {rows} link probabilities, {len(drawn)} steps and {agents} agents are "
            f"{numbers:.3g} values; expected at most {MOST_NUMBERS:.3g}"
        )
    updates = rows * runs * agents * sum(len(event.receivers) for now in drawn for event in now)
    if updates > MOST_UPDATES:
        raise UsageError(
            f"runs: {runs} runs for {rows} link probabilities, {len(drawn)} steps and {agents} agents are "
            f"{updates:.3g} updates of what an agent knows of another; expected at most {MOST_UPDATES:.3g}"
        )
    parts = []
    for block in range(-(-runs // BLOCK)):
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(block,)))
        parts.append(_simulated(agents, drawn, rows, min(BLOCK, runs - block * BLOCK), generator))
    return np.concatenate(parts, axis=1)


def _simulated(
    agents: int, drawn: Sequence[Sequence[ChanceEvent]], rows: int, runs: int, generator: np.random.Generator
) -> np.ndarray:
    """Follow the latest node of every agent that every agent knows, (rows, runs, agent, of agent); 0: none."""
    known = np.zeros((rows, runs, agents, agents), dtype=np.int32)
    loads = np.empty((rows, runs, len(drawn), agents), dtype=np.int32)
    for step, now in enumerate(drawn, start=1):
        known[..., range(agents), range(agents)] = step
        after = known.copy()
        for event in now:
            arrived = generator.random(runs) < event.probability[:, None]
            sent = np.where(arrived[..., None], known[:, :, event.sender], 0)
            for receiver in event.receivers:
                np.maximum(after[:, :, receiver], sent, out=after[:, :, receiver])
        loads[:, :, step - 1] = (after - known).sum(axis=-1)
        known = after
    return loads


def frequencies(sample: np.ndarray, groups: list[list[int]]) -> np.ndarray:
    """Shares of each load, (rows, steps, groups, sizes)."""
    sizes = int(sample.max()) + 1
    rows, _, steps, _ = sample.shape
    out = np.empty((rows, steps, len(groups), sizes))
    cells = np.arange(rows * steps).reshape(rows, 1, steps, 1) * sizes
    for g, group in enumerate(groups):
        counts = np.bincount((sample[..., group] + cells).ravel(), minlength=rows * steps * sizes)
        out[:, :, g] = counts.reshape(rows, steps, sizes) / (sample.shape[1] * len(group))
    return out
