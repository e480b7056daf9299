"""How well some numbers explain a simulator's results: Hotelling's T², and how the runs are spread.

With the results' means x̄, the covariance C of these from the runs themselves, and numbers m known to within C_m,

    T² = (x̄ − m)ᵀ (C + C_m)⁻¹ (x̄ − m)

over the cells of a link.  Links are independent; the T² of each becomes a χ² of equal probability, and these add up.
Cells that do not vary have to be met to their digits.  Where only means are given, or runs do not vary that should, the
covariance is that of what is supposed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, log1p
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from stochfuse.data.supposed import CLAIMED, LinkMeans

MOST_APART = 100.0
"""Most that the spread of one cell counts."""
FIRM = 1e-6
"""Share of a direction's variance below which it is rounding."""
ROUNDING = 1e-6
"""Relative difference of cells that do not vary which is rounding."""


class Fit(NamedTuple):
    """How well some numbers explain the results: T², freedom, p, how far cells are off, the largest |z|, and of how
    many cells nothing is said.
    """

    distance: float
    freedom: int
    p: float
    off: float
    largest: float
    where: str
    untold: int


class Means(NamedTuple):
    """What a simulator shows, per block: means, covariance of these, and covariance of a run."""

    mean: list[np.ndarray]
    noise: list[np.ndarray]
    spread: list[np.ndarray]
    shown: list[np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class Fits:
    """A simulator's results, and how well numbers explain them.

    Parameters
    ----------
    blocks : one for each link probability.
    """

    blocks: tuple[LinkMeans, ...]

    @property
    def errors(self) -> bool:
        """Whether some cell is of the true error."""
        return any(cell.quantity != CLAIMED for block in self.blocks for cell in block.cells)

    @property
    def runs(self) -> int:
        """Runs of the largest cell."""
        return max(cell.runs for block in self.blocks for cell in block.cells)

    @property
    def expected(self) -> Means:
        """What the prediction expects."""
        mean = [np.array([cell.expected for cell in block.cells]) for block in self.blocks]
        noise = [np.diag([cell.expected_error**2 for cell in block.cells]) for block in self.blocks]
        return Means(mean, noise, [np.zeros_like(m) for m in noise])

    def judge(self, means: Means, estimated: int = 0, runs: Sequence[float] | None = None) -> Fit:
        """How well some means explain the results.

        Parameters
        ----------
        runs : per block, number of runs that are as good as independent; default: all.
        """
        distance, freedom, exact, off, largest, where, untold = 0.0, 0, 0, 0.0, -1.0, "", 0
        for b, block in enumerate(self.blocks):
            r, C = np.array([cell.mean for cell in block.cells]) - means.mean[b], means.noise[b]
            known, floor = np.flatnonzero(~np.isnan(r)), self._floor(b)
            # cells of which a mistake says nothing are as far off as they were; of none it explains nothing
            wrong = [cell for cell, unknown in zip(block.cells, np.isnan(r), strict=True) if unknown]
            untold += len(wrong)
            off += sum(log1p(((c.mean - c.expected) / c.error) ** 2) for c in wrong if c.error > 0)
            if not len(known):
                continue
            C = (self._covariance(b, means.spread[b], runs) + C)[np.ix_(known, known)]
            r, floor = r[known], floor[known]
            deviation = np.sqrt(np.maximum(np.diagonal(C), 0.0))
            fixed = deviation <= floor
            beyond = np.maximum(0.0, np.abs(r) - floor)
            z = beyond / np.where(fixed, floor, np.where(deviation > 0, deviation, 1.0))
            off += float(np.log1p(z**2).sum())
            if z.max() > largest:
                largest, cell = float(z.max()), block.cells[int(known[z.argmax()])]
                where = f"k = {cell.step}" if not block.link else f"µ = {block.link}, k = {cell.step}"
            loose = np.flatnonzero(~fixed)
            exact += int(fixed.sum())
            T, d = _hotelling(np.copysign(beyond, r)[loose], C[np.ix_(loose, loose)], self._sample(b, runs))
            distance, freedom = distance + T + float((z[fixed] ** 2).sum()), freedom + d
        left = max(freedom - (0 if exact else estimated), 1)
        if not where:
            return Fit(0.0, left, 0.0, inf, 0.0, "", untold)
        return Fit(distance, left, float(chdtrc(left, distance)), off, largest, where, untold)

    def scales(self, means: Means) -> list[np.ndarray]:
        """Matrix W of every block, such that |W r|² is about the T² of a difference r from means like these."""
        found = []
        for b in range(len(self.blocks)):
            C, floor = self._covariance(b, means.spread[b], None) + means.noise[b], self._floor(b)
            deviation = np.maximum(np.sqrt(np.maximum(np.diagonal(C), 0.0)), floor)
            correlation = C / np.outer(deviation, deviation)
            np.fill_diagonal(correlation, 1.0)
            values, vectors = np.linalg.eigh(np.nan_to_num(correlation))
            firm = values > FIRM
            found.append((vectors[:, firm] / np.sqrt(values[firm])).T / deviation)
        return found

    def apart(self, means: Means) -> float:
        """How unlike the runs are spread over the cells of claimed numbers, as a χ²; 0 where only means are given."""
        total = 0.0
        for b, block in enumerate(self.blocks):
            for i, cell in enumerate(block.cells):
                if block.values is not None and means.shown is not None and cell.quantity == CLAIMED:
                    slack = 4.0 * cell.error + self._floor(b)[i]
                    total += min(MOST_APART, _unlike(block.values[:, i], means.shown[b][:, i], slack))
        return total

    def _sample(self, b: int, runs: Sequence[float] | None) -> float:
        return float(runs[b]) if runs is not None else float(min(cell.runs for cell in self.blocks[b].cells))

    def _floor(self, b: int) -> np.ndarray:
        means = np.array([cell.mean for cell in self.blocks[b].cells])
        given = np.array([cell.resolution for cell in self.blocks[b].cells])
        return given + ROUNDING * np.maximum(np.abs(means), 1e-300)

    def _covariance(self, b: int, spread: np.ndarray, runs: Sequence[float] | None) -> np.ndarray:
        """Covariance of a block's means: the runs' own, where they vary; else that of the simulator supposed."""
        block = self.blocks[b]
        count = np.array([float(cell.runs) for cell in block.cells])
        each = count if runs is None else np.full(len(count), float(runs[b]))
        supposed = spread / np.sqrt(np.outer(each, each))
        if block.values is None:
            errors = np.array(
                [cell.error if cell.quantity != CLAIMED or not spread.any() else 0.0 for cell in block.cells]
            )
            return supposed + np.diag(np.maximum(0.0, errors**2 - np.diagonal(supposed) * (errors > 0)))
        C = self._of_runs[b] / np.sqrt(np.outer(each, each))
        still = np.diagonal(C) <= self._floor(b) ** 2
        C[still] = C[:, still] = 0.0
        C[np.ix_(still, still)] = supposed[np.ix_(still, still)]
        return C

    @cached_property
    def _of_runs(self) -> list[np.ndarray]:
        """Covariance of a run's values, per block."""
        return [np.zeros(0) if x.values is None else np.atleast_2d(np.cov(x.values, rowvar=False)) for x in self.blocks]


def _unlike(one: np.ndarray, other: np.ndarray, slack: float) -> float:
    """4 λ² of Kolmogorov and Smirnov's test of two samples, whose values may be off by some slack."""
    one, other = np.sort(one), np.sort(other)

    def below(sample: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.searchsorted(sample, x, side="right") / len(sample)

    far = max(
        float((below(one, one) - below(other, one + slack)).max(initial=0.0)),
        float((below(other, other) - below(one, other + slack)).max(initial=0.0)),
    )
    return 4.0 * far**2 * len(one) * len(other) / (len(one) + len(other))


def _hotelling(r: np.ndarray, C: np.ndarray, runs: float) -> tuple[float, int]:
    """T² as a χ² of equal probability, and its freedom; directions that hardly vary are rounding."""
    if not len(r):
        return 0.0, 0
    deviation = np.sqrt(np.diagonal(C))
    correlation = C / np.outer(deviation, deviation)
    # few runs know less of a correlation than of a deviation
    shrink = min(1.0, len(r) / max(runs, 1.0))
    values, vectors = np.linalg.eigh((1.0 - shrink) * correlation + shrink * np.eye(len(r)))
    firm = values > FIRM
    T = float((((vectors.T @ (r / deviation))[firm]) ** 2 / values[firm]).sum())
    d = int(firm.sum())
    if runs <= d + 2:
        return T, d
    p = float(fdtrc(d, runs - d, T * (runs - d) / (d * (runs - 1.0))))
    return (float(chdtri(d, p)) if p > 1e-280 else T), d


def covariance_of(X: np.ndarray) -> np.ndarray:
    """Return the covariance of a sample's columns, 0 where a column varies by rounding alone."""
    C = np.atleast_2d(np.cov(X, rowvar=False))
    tiny = 1e-24 * np.maximum(np.abs(X).max(axis=0) ** 2, 1e-300)
    still = np.diagonal(C) <= tiny
    C[still] = C[:, still] = 0.0
    return C
