"""Who may hear whom, and how likely.

Architectures (thesis 3.1): *ad-hoc* draws every ordered pair of agents, *broadcast* draws every sender once and
everyone hears it, *cyclic* lets agent j hear agent j+1 only.  A matrix of link probabilities has the receiver in
its row and the sender in its column, µ_ij of (44); its diagonal is ignored.

Bursty links follow the two-state model of Gilbert and Elliott: every link is good or bad on its own, goes from good to
bad with probability g and from bad to good with probability b in each step, and delivers with a probability of each
state.  It starts from its stationary distribution, (b, g)/(g + b), and so delivers with the same mean probability at
every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from stochfuse.errors import UsageError, nearest

if TYPE_CHECKING:
    from stochfuse.scenario.radio import Radio

ARCHITECTURES = ("ad-hoc", "broadcast", "cyclic")
WHOSE = ("mean", "worst", "best")
"""Whose value is asked for, where it is not that of one agent."""
DEFAULT_LINKS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The link probabilities of the thesis, tabulated where neither the scenario nor the caller names any."""


@dataclass(frozen=True)
class Network:
    """The agents and their links.

    Parameters
    ----------
    agents, steps : numbers of agents and of time steps.
    architecture : one of `ARCHITECTURES`.
    link : probability of shape (), (n, n), (steps,) or (steps, n, n); None where it is to be tabulated.
    cases : named alternatives to `link`.
    delay : probabilities of a delay of 0, 1, 2 … steps; of unequal delays the longest are told by its length.
    counts : (n, n) packets sent to and received by each agent (receiver, sender), behind `link`; None if not known.
    scale : factor on what was counted that `link` already has, as network.scale.
    delays : the same from each sender to each receiver, by (receiver, sender); None where all have one.
    burst : (4,) good→bad, bad→good, delivery in good, delivery in bad; None for links without memory.
    case_bursts : the same for each of the cases.
    hears : (n, n) whether agent i may hear agent j, or None where all may hear whom the architecture lets them hear.
    names : names of the agents; empty where they have none but their numbers.
    places : of every agent (D,) or (steps, D), in m; empty where they are not given.
    radio : what the link probabilities come from, with the places; None where they are given.
    """

    agents: int
    steps: int
    architecture: str
    link: np.ndarray | None
    cases: tuple[tuple[str, np.ndarray], ...] = ()
    delay: tuple[float, ...] = (1.0,)
    burst: np.ndarray | None = None
    case_bursts: tuple[np.ndarray | None, ...] = ()
    hears: np.ndarray | None = None
    names: tuple[str, ...] = ()
    places: tuple[np.ndarray, ...] = ()
    radio: Radio | None = None
    delays: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    counts: tuple[np.ndarray, np.ndarray] | None = None
    scale: float = 1.0

    def delay_of(self, receiver: int, sender: int) -> tuple[float, ...]:
        """Probabilities of a delay of 0, 1, 2 … steps of a link."""
        return self.delay if self.delays is None else self.delays[receiver][sender]

    def agent(self, asked: int | str, words: Sequence[str] = WHOSE) -> int | str:
        """Return who is asked for: one of the words, or an agent's number from 1, which may be given by its name.

        Raises
        ------
        UsageError
            If there is no such agent.
        """
        if isinstance(asked, str) and asked in words:
            return asked
        if isinstance(asked, str) and asked in self.names:
            return self.names.index(asked) + 1
        if isinstance(asked, int | np.integer) and not isinstance(asked, bool) and 1 <= asked <= self.agents:
            return int(asked)
        number = " or ".join([*filter(None, [", ".join(words)]), f"a number from 1 to {self.agents}"])
        named = f", or one of {', '.join(self.names)}" if self.names else ""
        raise UsageError(f"agent: expected {number}{named}, got '{asked}'{nearest(str(asked), self.names)}")


@dataclass(frozen=True)
class LinkRows:
    """The rows of a table over link probability.

    Parameters
    ----------
    names : a name per row where rows are cases, else None.
    link : probabilities of shape (rows,), (rows, steps), (rows, n, n) or (rows, steps, n, n); of bursty links the mean.
    bursts : (rows,) bursts, None for a row of links without memory; None if there is no other row.
    """

    names: tuple[str, ...] | None
    link: np.ndarray
    bursts: tuple[np.ndarray | None, ...] | None = None

    def take(self, rows: np.ndarray | slice) -> LinkRows:
        """Return some of the rows."""
        chosen = np.arange(len(self.link))[rows]
        names = None if self.names is None else tuple(self.names[i] for i in chosen)
        bursts = None if self.bursts is None else tuple(self.bursts[i] for i in chosen)
        return LinkRows(names, self.link[chosen], bursts)

    @property
    def uniform(self) -> bool:
        """Whether in every row all links of a step are equally likely."""
        return self.link.ndim <= 2

    @property
    def varies(self) -> bool:
        """Whether the probabilities depend on the step."""
        return self.link.ndim in (2, 4)

    def chain(self, µ: np.ndarray) -> np.ndarray | None:
        """Good→bad, bad→good, delivery in good and in bad, (rows, 4), of a link of mean probability µ in each row.

        None if no row has a memory; a row without is one whose two states deliver alike.
        """
        if self.bursts is None:
            return None
        return np.array([(0.5, 0.5, m, m) if b is None else b for m, b in zip(µ, self.bursts, strict=True)])

    def common(self, network: Network) -> np.ndarray | None:
        """Probability that all possible links have in common at all steps, (rows,); None if they differ or remember."""
        if self.varies or self.bursts is not None:
            return None
        if self.uniform:
            return self.link
        there = reachable(network)
        inside, outside = self.link[:, there], self.link[:, ~there & ~np.eye(network.agents, dtype=bool)]
        if not there.any() or (outside > 0).any() or (inside != inside[:, :1]).any():
            return None
        return inside[:, 0]

    def at_step(self, step: int) -> np.ndarray:
        """Probabilities at a step, shape (rows,) if uniform, else (rows, receiver, sender)."""
        return self.link[:, step - 1] if self.varies else self.link

    def matrices(self, network: Network, step: int) -> np.ndarray:
        """Probabilities from every possible sender at a step, shape (rows, receiver, possible sender)."""
        n, now = network.agents, self.at_step(step)
        full = np.broadcast_to(now[:, None, None], (len(now), n, n)) if self.uniform else now
        return np.take_along_axis(full, possible_senders(network.architecture, n)[None], axis=2)

    def means(self, network: Network) -> np.ndarray:
        """Link probability of each row, averaged over its possible links and over the steps, shape (rows,)."""
        if number_of_senders(network.architecture, network.agents) == 0:
            return np.zeros(len(self.link)) if not self.uniform else self.link.reshape(len(self.link), -1)[:, 0]
        if self.uniform:
            return self.link.mean(axis=1) if self.varies else self.link
        steps = range(1, network.steps + 1 if self.varies else 2)
        there = np.take_along_axis(reachable(network), possible_senders(network.architecture, network.agents), axis=1)
        if not there.any():  # nobody hears anybody: as good as links of probability 0
            return np.zeros(len(self.link))
        return np.mean(
            [self.matrices(network, k)[:, there].reshape(len(self.link), -1).mean(axis=1) for k in steps], axis=0
        )


def stacked_rows(names: tuple[str, ...] | None, links: Sequence[np.ndarray], network: Network) -> LinkRows:
    """Rows from probabilities of shape (), (n, n), (steps,) or (steps, n, n), which may be mixed."""
    n, steps = network.agents, network.steps
    matrix, varies = any(a.ndim >= 2 for a in links), any(a.ndim in (1, 3) for a in links)
    shape = ((steps,) if varies else ()) + ((n, n) if matrix else ())
    full = [a[:, None, None] if a.ndim == 1 and matrix else a for a in links]
    return LinkRows(names, np.stack([np.broadcast_to(a, shape) for a in full]))


def restricted(rows: LinkRows, network: Network) -> LinkRows:
    """Return the rows with probability 0 where an agent cannot hear another (network.hears)."""
    if network.hears is None:
        return rows
    link = rows.link[..., None, None] if rows.uniform else rows.link
    return replace(rows, link=link * network.hears)


@lru_cache(maxsize=4)
def possible_senders(architecture: str, agents: int) -> np.ndarray:
    """Whom each agent may hear: indices of shape (agents, number of possible senders), not to be written to."""
    everyone = np.arange(agents)
    if architecture == "cyclic":
        found = ((everyone + 1) % agents)[:, None][:, : min(1, agents - 1)]
    else:
        found = np.broadcast_to(everyone, (agents, agents))[~np.eye(agents, dtype=bool)].reshape(agents, agents - 1)
    found.setflags(write=False)
    return found


def reachable(network: Network) -> np.ndarray:
    """Whether agent i may hear agent j, (n, n): by the architecture, and by network.hears."""
    n, there = network.agents, np.zeros((network.agents, network.agents), dtype=bool)
    there[np.arange(n)[:, None], possible_senders(network.architecture, n)] = True
    return there if network.hears is None else there & network.hears


def number_of_senders(architecture: str, agents: int) -> int:
    """How many messages an agent can receive in a step."""
    return min(1, agents - 1) if architecture == "cyclic" else agents - 1


def require_memoryless(rows: LinkRows, who: str, why: str) -> None:
    """Raise UsageError if some links are bursty."""
    if rows.bursts is not None:
        raise UsageError(f"{who} does not take bursty links (network.burst): {why}")


def mean_delivery(burst: np.ndarray) -> np.ndarray:
    """Stationary probability of a delivery, from (..., 4) bursts."""
    good_to_bad, bad_to_good, good, bad = np.moveaxis(burst, -1, 0)
    return (bad_to_good * good + good_to_bad * bad) / (good_to_bad + bad_to_good)


def delivery_after_failures(burst: np.ndarray, in_time: np.ndarray) -> np.ndarray:
    """Probability of a delivery in time after 0, 1 … failures in a row, of (rows, 4) bursts, shape (rows, failures).

    A chain of two states is reversible, so that the row of failures may lie in the past or in the future.

    Parameters
    ----------
    in_time : (failures,) probability that a delivery after so many failures is in time; a late one is a failure too.
    """
    good_to_bad, bad_to_good, *delivery = np.moveaxis(burst, -1, 0)
    deliver = np.stack(delivery, axis=1)
    move = np.array([[1.0 - good_to_bad, good_to_bad], [bad_to_good, 1.0 - bad_to_good]]).transpose(2, 0, 1)
    state = np.stack([bad_to_good, good_to_bad], axis=1) / (good_to_bad + bad_to_good)[:, None]
    out = []
    for share in in_time:
        out.append((state * deliver * share).sum(axis=1))
        failed = state * (1.0 - deliver * share)
        total = failed.sum(axis=1, keepdims=True)
        # where failures cannot happen, what would follow them does not matter
        state = np.divide(failed, total, out=state.copy(), where=total > 0)
        state = np.einsum("rs,rst->rt", state, move)
    return np.stack(out, axis=1)


def default_rows(network: Network) -> LinkRows:
    """Rows that a scenario asks for itself: its cases, its link probability, or the thesis' five."""
    return restricted(_default_rows(network), network)


def _default_rows(network: Network) -> LinkRows:
    if network.cases:
        names, arrays = zip(*network.cases, strict=True)
        rows = stacked_rows(names, arrays, network)
        return replace(rows, bursts=network.case_bursts if any(b is not None for b in network.case_bursts) else None)
    if network.link is not None:
        rows = stacked_rows(None, [network.link], network)
        return rows if network.burst is None else replace(rows, bursts=(network.burst,))
    return uniform_rows(DEFAULT_LINKS)


def uniform_rows(link: Sequence[float] | np.ndarray) -> LinkRows:
    """One row per link probability, the same for every link and step."""
    return LinkRows(None, np.array(link, dtype=float))
