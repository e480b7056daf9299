"""Is a simulator right?  Its results against the prediction, cell by cell and as a whole.

A cell is a link probability, a step and a group of like agents.  Covariances of like agents in one run are averaged
first, so that the runs of a cell are independent, and

    z = (mean − expected) / standard error

is nearly standard normal if the simulator is right.  Expected is the mean of the metric over the outcomes, where the
prediction knows them, else the metric of the expected covariance.  The standard error is the sample's; where the
outcomes are known, their variance takes the place of a single agent's sample variance, so that outcomes too rare to
have been seen are reckoned with.

Where runs are few or outcomes are rare the tails are far from normal.  There Chernoff's bound takes the place of
the normal tail, p ≤ 2 exp(−runs · sup_θ [θ·mean − log E exp(θ·covariance of one agent)]), which holds for any number of
runs and any dependence between the agents.  (Without known outcomes: Student's t.)

Two tests share the level α, Bonferroni's way:

    the smallest p, corrected for the number of cells (finds an error anywhere)
    all cells together: Hotelling's T² over the steps of a link, over links by Fisher's method (finds a small error
    everywhere); only of cells with enough runs for it, and not where only means are given

The simulator disagrees if either does.  Digits that the file does not give are never held against it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import erfc, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc, fdtrc, stdtr

from stochfuse.engines.distribution import Distribution
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Metric
from stochfuse.prediction.result import Prediction
from stochfuse.questions.results import ResultsError, SimulatorResults
from stochfuse.scenario.result import brief

if TYPE_CHECKING:
    from stochfuse.prediction.general import Outcomes

ALPHA = 0.001
NORMAL, ENOUGH_RUNS, SKEWED = 0.3, 200, 0.1
"""Largest correction of the normal tail for skewness with which it is used; least runs, largest skewness for T²."""
ROUNDING = 1e-9
"""Relative difference that is rounding, besides that of the digits in the file."""


class Cell(NamedTuple):
    """One link probability, step and group of agents.

    Parameters
    ----------
    link : text as in the file.
    row : row of the prediction.
    step : number from 1.
    agents : agents averaged, from 1.
    runs : independent runs.
    mean, error : mean covariance and its standard error.
    expected : prediction.
    z, p : z-score, and p-value corrected for the number of cells.
    agrees : whether p is above its share of α.
    """

    link: str
    row: int
    step: int
    agents: tuple[int, ...]
    runs: int
    mean: float
    error: float
    expected: float
    z: float
    p: float
    agrees: bool


class Verdict(NamedTuple):
    """The crosscheck's outcome.

    Parameters
    ----------
    agrees : whether neither test rejects at its share of α.
    alpha : probability that a right simulator is called wrong.
    cells : one per link probability, step and group.
    p_largest : p-value of the largest |z|, corrected for the number of cells.
    p_together : p-value of all cells together, or None where there are too few runs for it, or only means.
    consistency : per link text, mean squared error over mean claimed covariance, where errors are given.
    """

    agrees: bool
    alpha: float
    cells: list[Cell]
    p_largest: float
    p_together: float | None
    consistency: Mapping[str, float]

    def __repr__(self) -> str:
        """One line."""
        return brief(self, self._fields)


def check_results(results: SimulatorResults, prediction: Prediction, metric: Metric, alpha: float = ALPHA) -> Verdict:
    """Compare a simulator's results with a prediction.

    Parameters
    ----------
    results : from `read_results`.
    prediction : with one row for each of `results.links`, in their order, and steps up to the largest.
    metric : what the column "covariance" holds.
    alpha : probability that a right simulator is called wrong.

    Returns
    -------
    Verdict

    Raises
    ------
    UsageError
        If the results do not fit the prediction.
    """
    if not 0 < alpha < 1:
        raise UsageError(f"alpha: expected a probability between 0 and 1, got {alpha:g}")
    agents = len(prediction.group_of)
    if results.agent.max() > agents:
        first = int((results.agent > agents).argmax())
        raise ResultsError(f"{results.at(first)}, column 'agent': expected 1 to {agents}, got {results.agent[first]}")
    groups = [
        tuple((np.flatnonzero(prediction.group_of == g) + 1).tolist()) for g in range(prediction.by_group.shape[2])
    ]
    if results.agent.max() == 0 and len(groups) > 1:
        raise ResultsError(f"{results.source}: the agents differ: expected a column 'agent', got none")
    known = _known(prediction, metric)
    raw, together = _cells_of_means(results, prediction, known, metric, groups), None
    if results.run is not None:
        raw, together = _cells_of_runs(results, prediction, known, metric, groups)
    level = alpha / 2 if together is not None else alpha
    cells = [cell._replace(p=min(1.0, cell.p * len(raw)), agrees=cell.p * len(raw) > level) for cell in raw]
    largest = min(cell.p for cell in cells)
    agrees = largest > level and (together is None or together > level)
    return Verdict(agrees, alpha, cells, largest, together, _consistency(results))


class _Known(NamedTuple):
    """Mean, standard deviation and skewness of an agent's metric over the outcomes, (rows, steps), and the outcomes."""

    mean: np.ndarray
    deviation: np.ndarray
    skewness: np.ndarray
    outcomes: Outcomes
    group: int


def _known(prediction: Prediction, metric: Metric) -> list[_Known | None]:
    """What is known of every group of agents."""
    groups = range(prediction.by_group.shape[2])
    outcomes = prediction.outcomes
    if outcomes is None:
        return [None for _ in groups]
    return [
        _Known(
            outcomes.over_outcomes(metric, [g], Distribution.mean),
            np.sqrt(outcomes.over_outcomes(metric, [g], Distribution.variance)),
            outcomes.over_outcomes(metric, [g], Distribution.skewness),
            outcomes,
            g,
        )
        for g in groups
    ]


def _cells_of_runs(
    results: SimulatorResults,
    prediction: Prediction,
    known: Sequence[_Known | None],
    metric: Metric,
    groups: Sequence[tuple[int, ...]],
) -> tuple[list[Cell], float | None]:
    cells, by_link = [], []
    run = results.run if results.run is not None else np.zeros(0, dtype=np.int64)
    for row, link in enumerate(results.links):
        here = results.link == link
        of_link, samples, skewed = [], [], []
        for g, agents in enumerate(groups):
            mine = here & (np.isin(results.agent, agents) | (results.agent == 0))
            for step in np.unique(results.step[mine]).tolist():
                chosen = mine & (results.step == step)
                runs, of_run = np.unique(run[chosen], return_inverse=True)
                values = np.bincount(of_run, results.covariance[chosen]) / np.bincount(of_run)
                if len(runs) < 2:
                    raise ResultsError(f"{results.source}: link {link}, step {step}: expected at least 2 runs, got 1")
                deviation, exact = float(values.std(ddof=1)), known[g]
                if exact is not None:
                    share = _share(deviation, results.covariance[chosen], len(runs))
                    deviation = _deviation(exact, row, step) * share
                found = np.unique(results.agent[chosen]).tolist()
                whose = tuple(found) if found != [0] else agents
                expected = float(metric.of(prediction.by_group[row, step - 1, g]))
                cell = Cell(link, row, step, whose, len(runs), float(values.mean()), deviation, expected, 0, 0, True)
                of_link.append(_judged(cell, known[g], metric, results.resolution))
                samples.append((runs, values))
                skewed.append(_skewness(values, known[g], row, step) / sqrt(len(runs)))
        cells += of_link
        p = _together(of_link, samples, skewed)
        by_link += [] if p is None else [p]
    if not by_link:
        return cells, None
    return cells, _chi_squared_tail(-2.0 * float(np.log(np.maximum(by_link, 1e-300)).sum()), 2 * len(by_link))


def _cells_of_means(
    results: SimulatorResults,
    prediction: Prediction,
    known: Sequence[_Known | None],
    metric: Metric,
    groups: Sequence[tuple[int, ...]],
) -> list[Cell]:
    cells = []
    if results.count is None:
        return cells
    for place in range(len(results.step)):
        agent, step, row = int(results.agent[place]), int(results.step[place]), results.links.index(results.link[place])
        group = int(prediction.group_of[max(0, agent - 1)])
        of_group = known[group]
        std = np.nan if results.std is None else float(results.std[place])
        if np.isnan(std) and of_group is None:
            raise ResultsError(
                f"{results.at(place)}, column 'std': expected a number, since method {prediction.method} does not "
                f"know the "
                "spread over the outcomes"
            )
        deviation = std if of_group is None else _deviation(of_group, row, step)
        expected = float(metric.of(prediction.by_group[row, step - 1, group]))
        whose = (agent,) if agent else groups[group]
        runs, mean, text = int(results.count[place]), float(results.covariance[place]), str(results.link[place])
        cell = Cell(text, row, step, whose, runs, mean, deviation, expected, 0, 0, True)
        cells.append(_judged(cell, of_group, metric, results.resolution))
    return cells


def _share(averaged: float, each: np.ndarray, runs: int) -> float:
    """By how much the average over a run's like agents varies less than one agent: only a large sample says."""
    single = float(each.std(ddof=1))
    if runs < ENOUGH_RUNS or single == 0:
        return 1.0
    return float(np.clip(averaged / single, sqrt(runs / len(each)), 1.0))


def _deviation(known: _Known, row: int, step: int) -> float:
    return float(known.deviation[row, step - 1])


def _skewness(values: np.ndarray, known: _Known | None, row: int, step: int) -> float:
    if known is not None:
        return float(known.skewness[row, step - 1])
    deviation = values - values.mean()
    variance = float((deviation**2).mean())
    return float((deviation**3).mean()) / variance**1.5 if variance > 0 else 0.0


def _judged(cell: Cell, known: _Known | None, metric: Metric, resolution: float) -> Cell:
    """Complete a cell that comes with the standard deviation of a run in the place of the standard error."""
    expected = cell.expected if known is None else float(known.mean[cell.row, cell.step - 1])
    error = cell.error / sqrt(cell.runs)
    difference = cell.mean - expected
    given = resolution + ROUNDING * abs(expected)
    beyond = float(np.copysign(max(0.0, abs(difference) - given), difference))
    z = beyond / error if error > 0 else 0.0 if beyond == 0 else float(np.copysign(np.inf, beyond))
    if known is None:
        p = 2.0 * float(stdtr(cell.runs - 1, -abs(z)))
    else:
        skewness = abs(float(known.skewness[cell.row, cell.step - 1]))
        p = erfc(abs(z) / sqrt(2))
        if 0 < abs(z) < np.inf and skewness * abs(z) ** 3 / (6 * sqrt(cell.runs)) > NORMAL:
            p = max(p, _chernoff(known, metric, cell, expected + beyond))
    return cell._replace(expected=expected, error=error, z=z, p=p)


def _chernoff(known: _Known, metric: Metric, cell: Cell, mean: float) -> float:
    """Chernoff's bound on the probability that the mean of independent runs is as far off on either side."""
    rows = slice(cell.row, cell.row + 1)
    spread = known.outcomes.distribution(metric, cell.step, [known.group], rows)
    probability = spread.probability[0]
    possible = probability > 0
    log_p, v = np.log(probability[possible]), spread.values[possible] - mean
    scale = np.abs(v).max()
    if v.max() < -1e-9 * scale or v.min() > 1e-9 * scale:
        return 0.0

    def cumulant(t: float) -> float:
        terms = log_p + t * v / scale
        largest = terms.max()
        return float(largest + np.log(np.exp(terms - largest).sum()))

    least = minimize_scalar(cumulant, bounds=(-1e4, 1e4), method="bounded", options={"xatol": 1e-6})
    return min(1.0, 2.0 * float(np.exp(min(0.0, cell.runs * least.fun))))


def _together(
    cells: Sequence[Cell], samples: Sequence[tuple[np.ndarray, np.ndarray]], skewed: Sequence[float]
) -> float | None:
    """Hotelling's T² of a link's cells over the runs that they share: its p-value, None if there are too few runs."""
    fit = [
        i
        for i, cell in enumerate(cells)
        if cell.runs >= ENOUGH_RUNS and abs(skewed[i]) < SKEWED and np.isfinite(cell.z)
    ]
    fit = [i for i in fit if samples[i][1].std() > ROUNDING * abs(samples[i][1].mean())]
    if not fit:
        return None
    runs = samples[fit[0]][0]
    for i in fit[1:]:
        runs = np.intersect1d(runs, samples[i][0])
    if len(runs) < ENOUGH_RUNS:
        return None
    X = np.stack([samples[i][1][np.searchsorted(samples[i][0], runs)] for i in fit], axis=1)
    z = np.array([cells[i].z for i in fit])
    values, vectors = np.linalg.eigh(np.corrcoef(X, rowvar=False).reshape(len(z), len(z)))
    # directions that hardly vary are rounding
    firm = values > 1e-6
    components = (vectors.T @ z)[firm] / np.sqrt(values[firm])
    n, d = len(runs), int(firm.sum())
    return float(fdtrc(d, n - d, float((components**2).sum()) * (n - d) / (d * (n - 1))))


def _chi_squared_tail(statistic: float, freedom: int) -> float:
    return float(chdtrc(freedom, statistic))


def _consistency(results: SimulatorResults) -> dict[str, float]:
    if results.error is None:
        return {}
    out = {}
    for link in results.links:
        chosen = (results.link == link) & ~np.isnan(results.error)
        if chosen.any():
            out[link] = float((results.error[chosen] ** 2).mean() / results.covariance[chosen].mean())
    return out
