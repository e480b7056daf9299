"""The cells of a crosscheck together: how those of a link hang together, and one p-value of all.

    T² = zᵀ C⁻¹ z      over the cells of a link, with the correlations C of its runs (Hotelling)

finds a small error that is everywhere; over links by Fisher's method, or Bonferroni's where one seed for all links
makes them alike.  Only cells take part that have enough runs for it, and only directions in which they vary more than
what rounding, or the difference of known and sampled deviations, may do.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from stochfuse.data.cells import ENOUGH_RUNS, ROUNDING, Judged

SKEWED = 0.1
"""Largest skewness of a mean with which it takes part."""
ALIKE = 4.5
"""Correlation of two links' runs, in standard errors, from which on they are not taken for independent."""
MOST_TOGETHER = 1500
"""Cells of a link whose correlations are worked out; of more, as many spread over all of them."""


class LinkCells(NamedTuple):
    """Cells of one link, whose runs are the same.

    Parameters
    ----------
    cells : their places among a verdict's cells.
    correlation : (cells, cells) of what their z-scores are made of, mean less expected.
    """

    cells: tuple[int, ...]
    correlation: np.ndarray


def blocks_of(judged: Sequence[Judged]) -> tuple[LinkCells, ...]:
    """Cells of every link and how they hang together."""
    found = []
    for row in sorted({j.cell.row for j in judged if j.runs is not None}):
        cells = [i for i, j in enumerate(judged) if j.cell.row == row]
        if len(cells) > MOST_TOGETHER:
            cells = [cells[i] for i in np.unique(np.linspace(0, len(cells) - 1, MOST_TOGETHER).astype(int))]
        found.append(LinkCells(tuple(cells), _correlation([judged[i] for i in cells])))
    return tuple(found)


def _correlation(judged: Sequence[Judged]) -> np.ndarray:
    """Correlations of mean less expected, of the runs and samples that cells share."""
    total = np.zeros((len(judged), len(judged)))
    for rows, errors in (
        ([j.runs for j in judged], [j.cell.error for j in judged]),
        ([j.drawn for j in judged], [j.cell.expected_error for j in judged]),
    ):
        for shape in {row.shape for row in rows if row is not None}:
            there = [(i, row) for i, row in enumerate(rows) if row is not None and row.shape == shape]
            some = [i for i, _ in there]
            X = np.stack([row for _, row in there])
            X = X - np.nanmean(X, axis=1, keepdims=True)
            X[np.isnan(X)] = 0.0
            length = np.sqrt((X**2).sum(axis=1))
            scale = np.array([errors[i] for i in some]) / np.where(length > 0, length, 1.0)
            X *= scale[:, None]
            total[np.ix_(some, some)] += X @ X.T
    deviation = np.sqrt(np.diag(total))
    deviation[deviation == 0] = 1.0
    correlation = total / np.outer(deviation, deviation)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def together(judged: Sequence[Judged], blocks: Sequence[LinkCells]) -> float | None:
    """Hotelling's T² of every link's cells, then over links; None if there are too few runs for it."""
    by_link = []
    for block in blocks:
        fit = [place for place, i in enumerate(block.cells) if _fit(judged[i])]
        if not fit:
            continue
        some = [judged[block.cells[place]] for place in fit]
        z = np.array([j.cell.z for j in some])
        values, vectors = np.linalg.eigh(block.correlation[np.ix_(fit, fit)])
        # in directions that hardly vary (a squared error is the sum of its parts) nothing is seen but rounding, in the
        # file or in here, and by how much deviations that are known differ from the sample's, with its correlations
        blur = max(j.given / j.total_error for j in some)
        misfit = max(j.misfit for j in some)
        firm = values > max(1e-6, (5.0 * blur) ** 2, (3.0 * misfit) ** 2 * values.max())
        components = (vectors.T @ z)[firm] / np.sqrt(values[firm])
        n = min(min(j.cell.runs, j.cell.runs if j.drawn is None else len(j.drawn)) for j in some)
        d = int(firm.sum())
        if d and n - d >= ENOUGH_RUNS / 2:
            by_link.append(float(fdtrc(d, n - d, float((components**2).sum()) * (n - d) / (d * (n - 1)))))
    if not by_link:
        return None
    if _drawn_alike(judged, blocks):
        return min(1.0, len(by_link) * min(by_link))
    return float(chdtrc(2 * len(by_link), -2.0 * float(np.log(np.maximum(by_link, 1e-300)).sum())))


def _drawn_alike(judged: Sequence[Judged], blocks: Sequence[LinkCells]) -> bool:
    """Whether runs of one number are drawn alike for several links, by one seed for all: links that tell the same."""
    found = []
    for block in blocks:
        cells = [judged[i] for i in block.cells]
        found.append({(j.cell.column, j.cell.quantity, j.cell.agents, j.cell.step): j.runs for j in cells})
    for one, other in pairwise(found):
        for key, x in one.items():
            y = other.get(key)
            if x is None or y is None or x.shape != y.shape:
                continue
            both = ~np.isnan(x + y)
            x, y = x[both] - x[both].mean(), y[both] - y[both].mean()
            length = float(np.sqrt((x @ x) * (y @ y)))
            if length > 0 and abs(float(x @ y)) / length * sqrt(len(x)) > ALIKE:
                return True
    return False


def _fit(judged: Judged) -> bool:
    """Whether a cell's mean is near enough to normal."""
    cell, values = judged.cell, judged.runs
    if values is None or cell.runs < ENOUGH_RUNS or abs(judged.skewness or 0.0) >= SKEWED or not np.isfinite(cell.z):
        return False
    return bool(np.nanstd(values) > ROUNDING * abs(np.nanmean(values))) and cell.error > 0
