"""The distribution of a metric over the outcomes, and the statistics that can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stochfuse.errors import UsageError


@dataclass(frozen=True, eq=False)
class Distribution:
    """Distribution of a metric over the outcomes.

    Parameters
    ----------
    values : (values,) different values, ascending.
    probability : (rows, values) probability of each.
    """

    values: np.ndarray
    probability: np.ndarray

    @classmethod
    def merged(cls, values: np.ndarray, weights: np.ndarray) -> Distribution:
        """Take values together that differ by rounding only (1e-12 relative)."""
        order = np.argsort(values, kind="stable")
        values = values[order]
        new = np.concatenate([[True], np.diff(values) > 1e-12 * np.abs(values[1:])])
        starts = np.flatnonzero(new)
        return cls(values[starts], np.add.reduceat(weights[:, order], starts, axis=1))

    def mean(self) -> np.ndarray:
        """Expected metric, (rows,): the mean of the metric, not the metric of the mean covariance."""
        return self.probability @ self.values

    def variance(self) -> np.ndarray:
        """Variance of the metric over the outcomes, (rows,)."""
        return (self.probability * (self.values - self.mean()[:, None]) ** 2).sum(axis=1)

    def skewness(self) -> np.ndarray:
        """Third central moment over the standard deviation cubed, (rows,); 0 where nothing varies."""
        variance = self.variance()
        third = (self.probability * (self.values - self.mean()[:, None]) ** 3).sum(axis=1)
        return np.divide(third, variance**1.5, out=np.zeros_like(third), where=variance > 0)

    def quantile(self, level: float) -> np.ndarray:
        """Least value that is not exceeded with at least that probability, (rows,)."""
        from_below, from_above = (
            np.cumsum(self.probability, axis=1),
            np.cumsum(self.probability[:, ::-1], axis=1)[:, ::-1],
        )
        # of both tails the nearer one counts, so that rounding of the sum does not hide rare values; values without any
        # probability are none
        reached = np.where(level > 0.5, from_above - self.probability <= 1.0 - level, from_below >= level)
        return self.values[(reached & (self.probability > 0)).argmax(axis=1)]

    def at_most(self, limit: float) -> np.ndarray:
        """P(metric ≤ limit), (rows,)."""
        return self.probability[:, self.values <= limit + 1e-12 * abs(limit)].sum(axis=1)


def parse_statistic(name: str) -> tuple[str, float]:
    """Return kind and number of a statistic's name.

    Raises
    ------
    UsageError
        If there is no such statistic.
    """
    kind, colon, text = name.partition(":")
    if kind in ("variance", "std", "derivative") and not colon:
        return kind, 0.0
    if kind in ("quantile", "at-most"):
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if np.isfinite(number) and (kind == "at-most" or 0 <= number <= 1):
            return kind, number
    raise UsageError(
        f"statistic: expected mean, variance, std, quantile:P with P from 0 to 1, at-most:LIMIT or "
        f"derivative, got '{name}'"
    )
