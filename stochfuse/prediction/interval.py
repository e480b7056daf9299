"""What a packet log leaves unknown of its links, carried on into the answer: credible intervals.

Of n packets s arrived, so that µ_ij ~ Beta(s + ½, n − s + ½) (Jeffreys), every link by itself.  The number shown, f(µ),
then has a distribution too:

    draws         its quantiles over draws of all µ_ij, as many rows of one prediction
    derivatives   f(µ̂) ± z √Σ_ij Δ_ij²,   Δ_ij = ½ [f(µ_ij + σ_ij) − f(µ_ij − σ_ij)],  σ_ij the posterior deviation

The first is exact but for its draws; the second, with two rows a link, is for methods to which rows are dear (general
lists outcomes for each).  Both hold the method and the scenario for true: only the links are uncertain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.scenario.network import LinkRows, Network, reachable, restricted
from stochfuse.scenario.registry import MONTE_CARLO, OPTIMAL, SIMPLIFIED

DRAWS, SEED = 1000, 1
CHEAP = (SIMPLIFIED, OPTIMAL)
"""Methods to which a row of link probabilities costs little."""


class Posterior(NamedTuple):
    """Rows of link probabilities that a log supports.

    Parameters
    ----------
    level : probability that the interval holds what is true.
    rows : draws of all links; or a pair for every uncertain link, moved up and down by its deviation.
    drawn : which of the two.
    """

    level: float
    rows: LinkRows
    drawn: bool

    def ends(self, centre: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Low and high end, (steps,), from the number at the links as they are, (steps,), and at the rows."""
        if self.drawn:
            low, high = np.quantile(values, [(1 - self.level) / 2, (1 + self.level) / 2], axis=0)
            return low, high
        from scipy.special import ndtri

        half = 0.5 * (values[::2] - values[1::2])
        reach = ndtri((1 + self.level) / 2) * np.sqrt((half**2).sum(axis=0))
        return centre - reach, centre + reach


def posterior(network: Network, level: float, method: str, draws: int = DRAWS) -> Posterior:
    """Return the link probabilities that the counts of a network support.

    Raises
    ------
    UsageError
        If links are not counted, or the method or network is not one for it.
    """
    if network.counts is None or network.link is None:
        raise UsageError(
            "interval: expected links with numbers of packets (network.link = { file = … } of a packet log, or "
            "network.sent and network.received), got links without"
        )
    if method == MONTE_CARLO:
        raise UsageError(
            "interval: expected method simplified, general or optimal, got monte-carlo, whose own error is beside it"
        )
    if network.cases:
        raise UsageError("interval: expected one network, got cases")
    if network.architecture == "broadcast":
        raise UsageError('interval: expected network.architecture "ad-hoc" or "cyclic", got "broadcast"')
    sent, received = network.counts
    unsure = (sent > 0) & reachable(network)
    if not unsure.any():
        raise UsageError("interval: expected a link that somebody may hear and of which packets are counted, got none")
    a, b = received[unsure] + 0.5, (sent - received)[unsure] + 0.5
    drawn = method in CHEAP
    if drawn:
        delivered = np.random.default_rng(SEED).beta(a, b, (draws, len(a)))
    else:
        deviation = np.sqrt(a * b / (a + b + 1)) / (a + b)
        moves = np.stack([np.diag(deviation), -np.diag(deviation)], axis=1).reshape(-1, len(a))
        delivered = np.clip((received / np.maximum(sent, 1))[unsure] + moves, 0.0, 1.0)
    rows = np.broadcast_to(network.link, (len(delivered), *network.link.shape)).copy()
    rows[:, unsure] = np.minimum(1.0, network.scale * delivered)
    return Posterior(level, restricted(LinkRows(None, rows), network), drawn)


def level_of(text: str | float) -> float:
    """Return a level as a probability, from 95% or 0.95.

    Raises
    ------
    UsageError
        If it is neither.
    """
    try:
        level = float(text[:-1]) / 100 if isinstance(text, str) and text.endswith("%") else float(text)
    except ValueError:
        raise UsageError(f"interval: expected a probability such as 95% or 0.95, got '{text}'") from None
    if not 0 < level < 1:
        raise UsageError(f"interval: expected a probability between 0 and 1, such as 95% or 0.95, got {text}")
    return level
