"""Who may hear whom, and how likely.

Architectures (thesis 3.1): *ad-hoc* draws every ordered pair of agents, *broadcast* draws every sender once and
everyone hears it, *cyclic* lets agent j hear agent j+1 only.  A matrix of link probabilities has the receiver in
its row and the sender in its column, µ_ij of (44); its diagonal is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ARCHITECTURES = ("ad-hoc", "broadcast", "cyclic")
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
    delay : probabilities of a delay of 0, 1, 2 … steps.
    """

    agents: int
    steps: int
    architecture: str
    link: np.ndarray | None
    cases: tuple[tuple[str, np.ndarray], ...] = ()
    delay: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class LinkRows:
    """The rows of a table over link probability.

    Parameters
    ----------
    names : a name per row where rows are cases, else None.
    arrays : per row a probability of shape (), (n, n), (steps,) or (steps, n, n).
    """

    names: tuple[str, ...] | None
    arrays: tuple[np.ndarray, ...]

    @property
    def uniform(self) -> bool:
        """Whether in every row all links of a step are equally likely."""
        return all(a.ndim in (0, 1) for a in self.arrays)

    def at_step(self, step: int) -> np.ndarray:
        """Uniform link probability per row at a step, shape (rows,)."""
        return np.array([float(a) if a.ndim == 0 else float(a[step - 1]) for a in self.arrays])

    def matrices(self, network: Network, step: int) -> np.ndarray:
        """Link probabilities from every possible sender at a step, shape (rows, receiver, sender)."""
        n = network.agents
        full = np.stack([_at(a, n, step) for a in self.arrays])
        if network.architecture == "cyclic":
            receivers = np.arange(n)
            return full[:, receivers, (receivers + 1) % n][:, :, None][:, :, : min(1, n - 1)]
        return full[:, ~np.eye(n, dtype=bool)].reshape(len(full), n, n - 1)

    def means(self, network: Network) -> np.ndarray:
        """Link probability of each row, averaged over its possible links and over the steps, shape (rows,)."""
        if self.uniform:
            return np.array([a.mean() for a in self.arrays])
        steps = range(1, network.steps + 1)
        return np.mean([self.matrices(network, k).mean(axis=(1, 2)) for k in steps], axis=0)


def _at(link: np.ndarray, agents: int, step: int) -> np.ndarray:
    now = link[step - 1] if link.ndim in (1, 3) else link
    return np.broadcast_to(now, (agents, agents))


def possible_senders(architecture: str, agents: int) -> np.ndarray:
    """Whom each agent may hear: indices of shape (agents, number of possible senders)."""
    everyone = np.arange(agents)
    if architecture == "cyclic":
        return ((everyone + 1) % agents)[:, None][:, : min(1, agents - 1)]
    return np.broadcast_to(everyone, (agents, agents))[~np.eye(agents, dtype=bool)].reshape(agents, agents - 1)


def number_of_senders(architecture: str, agents: int) -> int:
    """How many messages an agent can receive in a step."""
    return min(1, agents - 1) if architecture == "cyclic" else agents - 1


def default_rows(network: Network) -> LinkRows:
    """Rows that a scenario asks for itself: its cases, its link probability, or the thesis' five."""
    if network.cases:
        names, arrays = zip(*network.cases, strict=True)
        return LinkRows(names, arrays)
    if network.link is not None:
        return LinkRows(None, (network.link,))
    return uniform_rows(DEFAULT_LINKS)


def uniform_rows(link: Sequence[float]) -> LinkRows:
    """One row per link probability, the same for every link and step."""
    return LinkRows(None, tuple(np.asarray(float(µ)) for µ in link))
