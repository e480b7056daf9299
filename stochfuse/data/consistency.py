"""Are estimates as good as they claim?  Normalised squared errors of many runs and steps, and what they may come to.

    NEES   ε = (x̂ − x)ᵀ P⁻¹ (x̂ − x)      NIS   ε = νᵀ S⁻¹ ν,   S = H P⁻ Hᵀ + R

of d (or p) degrees of freedom if the claim is right (Bar-Shalom, Li and Kirubarajan, section 5.4).  The average of N
independent ones times N is χ² of N·d, so that a consistent filter keeps it, 95 times in 100, between

    χ²_{N·d}(0.025)/N   and   χ²_{N·d}(0.975)/N

Errors of one run at different steps, and of agents that fuse with each other, are not independent.  N is then the
number that would make the average as uncertain as it is: relative to its square the mean of N independent ones has
the variance 2/(N d), and the data tell how large it is,

    many runs        from the spread of the runs' own averages, since runs are independent
    few              from the autocovariances over the steps, summed up while pairs of them are positive (Geyer 1992)

It never exceeds the number of what was averaged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

LEVEL = 0.95
MANY = 30
"""Runs from which on their own averages tell how uncertain the average over all is."""
LAGS = 200
"""Steps over which errors may be alike."""
CONSISTENT, OVERCONFIDENT, CAUTIOUS = "consistent", "overconfident", "cautious"


class Average(NamedTuple):
    """An average of normalised squared errors, per degree of freedom times their number.

    Parameters
    ----------
    mean : the average.
    low, high : what a consistent filter keeps, 95 times in 100.
    freedom : degrees of freedom of one.
    independent : as how many independent ones it counts.
    number : how many were averaged.
    """

    mean: float
    low: float
    high: float
    freedom: float
    independent: float
    number: int

    @property
    def verdict(self) -> str:
        """Whether the claim is consistent, overconfident or cautious."""
        if self.low <= self.mean <= self.high:
            return CONSISTENT
        return OVERCONFIDENT if self.mean > self.high else CAUTIOUS


def band(freedom: float, independent: float) -> tuple[float, float]:
    """Return between what the average of independent ones lies, 95 times in 100."""
    tail = (1.0 - LEVEL) / 2.0
    N = max(independent, 1e-9)
    return float(chdtri(N * freedom, 1.0 - tail)) / N, float(chdtri(N * freedom, tail)) / N


class Series:
    """Gathers normalised squared errors (runs, steps, agents), batch after batch, NaN where there is none.

    Parameters
    ----------
    steps, agents : their numbers.
    freedom : (agents,) degrees of freedom.
    """

    def __init__(self, steps: int, agents: int, freedom: np.ndarray) -> None:
        self.freedom = np.asarray(freedom, dtype=float)
        self.total, self.count = np.zeros((steps, agents)), np.zeros((steps, agents), dtype=np.int64)
        self._runs: list[np.ndarray] = []
        self._numbers: list[np.ndarray] = []
        lags = min(LAGS, steps - 1)
        # sums of products, of either factor, and their number, at every lag; the last column is the agents' mean
        self._lagged = np.zeros((4, lags + 1, agents + 1))

    def add(self, squared: np.ndarray) -> None:
        """Add some runs."""
        there = ~np.isnan(squared)
        self.total += np.where(there, squared, 0.0).sum(axis=0)
        self.count += there.sum(axis=0)
        relative = squared / self.freedom
        known = there.any(axis=2)
        mean = np.divide(
            np.where(there, relative, 0.0).sum(axis=2), there.sum(axis=2), where=known, out=np.zeros(known.shape)
        )
        series = np.concatenate([relative, np.where(known, mean, np.nan)[..., None]], axis=2)
        has = ~np.isnan(series)
        filled = np.where(has, series, 0.0)
        self._runs.append(filled.sum(axis=1))
        self._numbers.append(has.sum(axis=1))
        steps = squared.shape[1]
        for lag in range(self._lagged.shape[1]):
            a, b = filled[:, : steps - lag], filled[:, lag:]
            both = has[:, : steps - lag] & has[:, lag:]
            parts = ((a * b * both), a * both, b * both, both)
            self._lagged[:, lag] += np.stack([part.sum(axis=(0, 1)) for part in parts])

    def average(self, agent: int | None) -> Average | None:
        """Return the average of an agent counted from 0, or over all agents; None if there is nothing."""
        place = slice(None) if agent is None else slice(agent, agent + 1)
        count = int(self.count[:, place].sum())
        if not count:
            return None
        column = -1 if agent is None else agent
        weights = self.count[:, place].sum(axis=0)
        freedom = float((self.freedom[place] * weights).sum() / weights.sum())
        mean = float(self.total[:, place].sum() / count)
        independent = self._independent(column, freedom, count)
        low, high = band(freedom, independent)
        return Average(mean, low, high, freedom, independent, count)

    def _independent(self, column: int, freedom: float, count: int) -> float:
        sums, numbers = (np.concatenate(parts)[:, column] for parts in (self._runs, self._numbers))
        there = numbers > 0
        sums, numbers = sums[there], numbers[there]
        mean = sums.sum() / numbers.sum()
        if mean <= 0:
            return float(count)
        if len(sums) >= MANY:
            # a run of few numbers tells little of the mean
            off = sums - mean * numbers
            relative = float((off**2).sum() / numbers.sum() ** 2 / mean**2) * len(sums) / (len(sums) - 1)
        else:
            products, a, b, n = self._lagged[:, :, column]
            used = n > 0
            covariance = np.divide(products, n, where=used, out=np.zeros(len(n))) - np.divide(
                a * b, n * n, where=used, out=np.zeros(len(n))
            )
            relative = _initial_positive(covariance) / numbers.sum() / mean**2
        return float(count) if relative <= 0 else float(min(count, 2.0 / (freedom * relative)))

    def by_step(self) -> np.ndarray:
        """Return the average over runs and agents at every step, (steps,)."""
        total, count = self.total.sum(axis=1), self.count.sum(axis=1)
        return np.divide(total, count, where=count > 0, out=np.full(len(total), np.nan))


def _initial_positive(covariance: np.ndarray) -> float:
    """Sum of autocovariances of both signs of the lag, up to the first pair whose sum is not positive."""
    total = float(covariance[0])
    for lag in range(1, len(covariance) - 1, 2):
        pair = float(covariance[lag] + covariance[lag + 1])
        if pair <= 0:
            break
        total += 2.0 * pair
    return total
