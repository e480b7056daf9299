"""How many messages arrive, and the two averages over that number that (54) needs.

If m of N possible messages arrive, (54) leaves of a direction with signal-to-noise ratio s the share
1/(1 + (m+1)s) of its prior variance.  Averaged over the distribution β of m,

    E(s) = Σ β(m) / (1 + (m+1)s)            what remains of the variance
    g(s) = Σ β(m) (m+1) / (1 + (m+1)s)      what is gained, per unit of s:   E = 1 − s g

Up to a hundred senders the sums are evaluated as they stand.  For more like senders they are integrals over t from
0 to ∞, with φ(t) = 1 − µ + µe^(−ts) the generating function of one message,

    E = ∫ e^(−t(1+s)) φ(t)^N dt             g = ∫ e^(−t(1+s)) φ(t)^N (1 + Nµ e^(−ts)/φ(t)) dt

and a fixed double-exponential rule gives them to rounding, at a cost that does not depend on N, without a binomial
coefficient that could overflow and exactly at µ = 0 and µ = 1.

Where the agent's own sensor may miss, as those of the senders, the number n of measurements takes the place of m + 1,
and may be 0: nothing is gained then.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Protocol

import numpy as np

SUM_UP_TO = 100
"""Number of senders up to which the sum over m is as cheap as the nodes of the integral."""

_STEP = 0.1
_X = np.arange(-4.0, 6.2, _STEP)
_NODES = np.exp(_X - np.exp(-_X))
_WEIGHTS = _STEP * _NODES * (1.0 + np.exp(-_X))
_TINY = 1e-290
_BLOCK = 128
_FEW = 8


class Arrivals(Protocol):
    """Distribution of the number of arriving messages, one per item of the last axis.

    Attributes
    ----------
    nothing : (items,) probability of no measurement at all, not even the agent's own; or 0.
    """

    @property
    def nothing(self) -> np.ndarray | float:
        """Probability of no measurement at all."""
        ...

    def remaining(self, s: np.ndarray) -> np.ndarray:
        """E(s) for s ≥ 0 of shape (..., items)."""
        ...

    def gained(self, s: np.ndarray) -> np.ndarray:
        """g(s) for s ≥ 0 of shape (..., items)."""
        ...

    def reciprocal(self) -> np.ndarray:
        """E[1/(m+1)], shape (items,): what remains at step 1, where independent initial estimates are averaged."""
        ...

    def take(self, items: np.ndarray | slice) -> Arrivals:
        """Return the distributions of some items."""
        ...


@dataclass(frozen=True)
class Counts:
    """Any distribution of the number of messages, as a table.

    Parameters
    ----------
    weights : (N + 1, items) probability of m = 0 … N arrivals, that is of m + 1 measurements.
    nothing : (items,) probability of no measurement at all; or 0.
    """

    weights: np.ndarray
    nothing: np.ndarray | float = 0.0

    @classmethod
    def of_measurements(cls, pmf: np.ndarray) -> Counts:
        """Return the distribution of 0, 1, 2 … measurements, (numbers, items)."""
        return cls(pmf[1:], pmf[0])

    def remaining(self, s: np.ndarray) -> np.ndarray:
        """E(s)."""
        return self._average(s, self.weights) + self.nothing

    def gained(self, s: np.ndarray) -> np.ndarray:
        """g(s)."""
        return self._average(s, self._gains)

    def reciprocal(self) -> np.ndarray:
        """E[1/(m+1)]."""
        return (self.weights / self._arrived).sum(axis=0)

    def take(self, items: np.ndarray | slice) -> Counts:
        """Return the distributions of some items."""
        nothing = self.nothing[items] if isinstance(self.nothing, np.ndarray) else self.nothing
        return Counts(self.weights[:, items], nothing)

    @cached_property
    def _gains(self) -> np.ndarray:
        return self.weights * self._arrived

    @property
    def _arrived(self) -> np.ndarray:
        return np.arange(1.0, len(self.weights) + 1)[:, None]

    def _average(self, s: np.ndarray, numerator: np.ndarray) -> np.ndarray:
        noise = 1.0 / np.maximum(s, _TINY)
        if len(numerator) <= _FEW:
            return self._average_few(noise, numerator)
        columns = (-1, *(1,) * (noise.ndim - 1), numerator.shape[-1])
        total = np.zeros_like(noise)
        for first in range(0, len(numerator), _BLOCK):
            block = numerator[first : first + _BLOCK].reshape(columns)
            terms = np.add.outer(np.arange(first + 1.0, first + len(block) + 1), noise)
            total += np.divide(block, terms, out=terms).sum(axis=0)
        return total * noise

    def _average_few(self, noise: np.ndarray, numerator: np.ndarray) -> np.ndarray:
        """The same, term by term: for a few counts the three-dimensional arrays cost more than they save."""
        total, term = np.zeros_like(noise), np.empty_like(noise)
        for m, weight in enumerate(numerator):
            np.add(noise, m + 1.0, out=term)
            total += np.divide(weight, term, out=term)
        total *= noise
        return total


@dataclass(frozen=True)
class Binomial:
    """Many like senders, each heard with probability µ, thesis (50), by the integrals.

    Parameters
    ----------
    senders : N, the number of possible messages.
    link : (items,) the link probability µ.
    """

    senders: int
    link: np.ndarray
    nothing: float = 0.0

    def remaining(self, s: np.ndarray) -> np.ndarray:
        """E(s)."""
        return self._integral(s, gained=False)

    def gained(self, s: np.ndarray) -> np.ndarray:
        """g(s)."""
        return self._integral(s, gained=True)

    def reciprocal(self) -> np.ndarray:
        """(1 − (1−µ)^n)/(nµ) with n = N + 1."""
        n = self.senders + 1
        positive = self.link > 0
        µ = np.where(positive, self.link, 1.0)
        with np.errstate(divide="ignore"):
            return np.where(positive, -np.expm1(n * np.log1p(-µ)) / (n * µ), 1.0)

    def take(self, items: np.ndarray | slice) -> Binomial:
        """Return the distributions of some items."""
        return Binomial(self.senders, self.link[items])

    def _integral(self, s: np.ndarray, *, gained: bool) -> np.ndarray:
        N, µ = self.senders, self.link
        rate = 1.0 + s + N * µ * s
        total = np.zeros_like(rate)
        with np.errstate(divide="ignore", under="ignore"):
            for node, weight in zip(_NODES, _WEIGHTS, strict=True):
                t = node / rate
                missing = np.expm1(-t * s)
                log_φ = np.log1p(µ * missing)
                term = weight * np.exp(N * log_φ - t * (1.0 + s))
                if gained:
                    term += term * (N * µ) * (1.0 + missing) * np.exp(-np.maximum(log_φ, -700.0))
                total += term
        return total / rate


def nobody_else(arrivals: Arrivals) -> bool:
    """Whether the agent's own measurement, and none but that, is certain."""
    return isinstance(arrivals, Counts) and len(arrivals.weights) == 1 and not np.any(arrivals.nothing)


def like_senders(senders: int, link: np.ndarray, detection: float = 1.0) -> Arrivals:
    """Distribution of arrivals from N senders that are heard with the same probability, thesis (50).

    Parameters
    ----------
    senders : N ≥ 0.
    link : (items,) probability µ of each item.
    detection : probability that a sensor measures, the agent's own or a sender's.
    """
    if detection < 1.0:
        heard = _binomial(senders, link * detection)
        nobody = np.zeros((1, len(link)))
        own = np.concatenate([nobody, detection * heard])
        return Counts.of_measurements(own + np.concatenate([(1.0 - detection) * heard, nobody]))
    if senders > SUM_UP_TO:
        return Binomial(senders, link)
    weights = np.ones((senders + 1, len(link)))
    heard, missed = np.ones(len(link)), np.ones(len(link))
    for m in range(1, senders + 1):
        heard = heard * link
        missed = missed * (1.0 - link)
        weights[m] *= float(comb(senders, m)) * heard
        weights[senders - m] *= missed
    return Counts(weights / weights.sum(axis=0))


def _binomial(N: int, p: np.ndarray) -> np.ndarray:
    """Binomial distribution, (N + 1, items), for any N."""
    from scipy.special import gammaln, xlog1py, xlogy

    m = np.arange(N + 1.0)[:, None]
    ways = gammaln(N + 1.0) - gammaln(m + 1.0) - gammaln(N - m + 1.0)
    pmf = np.exp(ways + xlogy(m, p) + xlog1py(N - m, -p))
    return pmf / pmf.sum(axis=0)


def poisson_binomial(link: np.ndarray) -> np.ndarray:
    """Distribution of the number of arrivals over unequal links, thesis (45)/(46) summed by count.

    Parameters
    ----------
    link : (N, ...) probability of each of N independent messages.

    Returns
    -------
    ndarray
        (N + 1, ...) probability of 0 … N arrivals.  Every term is positive: no cancellation.
    """
    pmf = np.zeros((len(link) + 1, *link.shape[1:]))
    pmf[0] = 1.0
    for j, µ in enumerate(link):
        pmf[1 : j + 2] = pmf[1 : j + 2] * (1.0 - µ) + pmf[: j + 1] * µ
        pmf[0] *= 1.0 - µ
    return pmf
