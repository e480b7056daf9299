"""Cells of a crosscheck: values by quantity, link probability, step and group of like agents, each judged.

Values of like agents in one run are averaged first, so that the runs of a cell are independent, and

    z = (mean − expected) / √(se² + se_expected²)

is nearly standard normal if the simulator is right.  What is expected is said in `stochfuse.data.expected`;
se_expected is 0 but for sampled predictions.  The simulator's standard error is the sample's; where the law of a value
is known, its deviation takes the place of the sample's, so that outcomes too rare to have been seen are reckoned with.

Where runs are few or outcomes are rare the tails are far from normal.  There Chernoff's bound takes the place of
the normal tail, p ≤ 2 exp(−runs · sup_θ [θ·mean − log E exp(θ·value of one agent)]), which holds for any number of
runs and any dependence between the agents.  (Where the law is not known or estimated: Student's t, too.)
"""

from __future__ import annotations

from collections.abc import Sequence
from math import erfc, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from stochfuse.data.expected import ColumnExpectation, Expectations, Family
from stochfuse.data.results import ResultsError, SimulatorResults, dense
from stochfuse.prediction.result import Prediction

NORMAL, ENOUGH_RUNS = 0.3, 200
"""Largest correction of the normal tail for skewness with which it is used; least runs for a spread to be relied on."""
ROUNDING = 1e-9
"""Relative difference that is rounding, besides that of the digits in the file."""
SPARSE = 16
"""Places for values per value up to which runs are laid beside each other."""


class Cell(NamedTuple):
    """One quantity, link probability, step and group of agents.

    Parameters
    ----------
    link : text as in the file.
    row : row of the prediction.
    step : number from 1.
    agents : agents averaged, from 1.
    runs : independent runs.
    mean, error : the simulator's mean and its standard error.
    expected : prediction.
    z, p : z-score, and p-value corrected for the number of cells.
    agrees : whether p is above its share of α.
    quantity : "claimed", "bias", "actual" (mean squared error) or "nees".
    metric : in which sense, of a bias that of its state; "nees" of the NEES.
    column : of the file.
    expected_error : standard error of what is expected, 0 where it is not sampled.
    resolution : what the digits of the file leave open of the mean.
    """

    link: str
    row: int
    step: int
    agents: tuple[int, ...]
    runs: int
    mean: float
    error: float
    expected: float
    z: float = 0.0
    p: float = 1.0
    agrees: bool = True
    quantity: str = "claimed"
    metric: str = "trace"
    column: str = "covariance"
    expected_error: float = 0.0
    resolution: float = 0.0


class Judged(NamedTuple):
    """A cell and what it was made of.

    Parameters
    ----------
    cell : with p of its own, not yet corrected.
    skewness : of the mean.
    runs : (runs of the link,) average over the agents in every run, not-a-number where there is none; None of means.
    drawn : what is expected in every run of a sample, or None.
    given : what the digits of the file leave open of the mean.
    """

    cell: Cell
    skewness: float | None = None
    runs: np.ndarray | None = None
    drawn: np.ndarray | None = None
    given: float = 0.0

    @property
    def total_error(self) -> float:
        """Standard error of the difference."""
        return float(np.hypot(self.cell.error, self.cell.expected_error))

    @property
    def misfit(self) -> float:
        """By how much the sample's own standard error differs from the one that is used, relatively."""
        own = float(np.nanstd(self.runs, ddof=1)) / sqrt(self.cell.runs) if self.runs is not None else 0.0
        return abs(own / self.cell.error - 1.0)


class _LinkValues(NamedTuple):
    """A link's values, brought together once.

    Parameters
    ----------
    averages : a family each, (groups, steps, runs), average over the agents; not-a-number where there is none.
    single : a family each, (groups, steps), deviation of the values of single agents.
    number : a family each, (groups, steps), of values.
    agents : (groups, steps, agents) who was seen.
    """

    averages: list[np.ndarray]
    single: list[np.ndarray]
    number: list[np.ndarray]
    agents: np.ndarray


def _gathered(
    results: SimulatorResults, here: Any, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> _LinkValues:
    """Values of some rows, those of one link."""
    groups, steps, agents = prediction.by_group.shape[2], len(prediction.steps), len(prediction.group_of)
    cell, seen = results.step[here] - 1, np.zeros((groups * steps, agents), dtype=bool)
    if who is not None:
        agent = who[here] - 1
        cell = cell + prediction.group_of[agent] * steps
        seen = np.bincount(cell * agents + agent, minlength=seen.size).reshape(seen.shape) > 0
    run = dense(_runs(results)[here])
    if groups * steps * (int(run.max()) + 1) > SPARSE * len(run) + 1_000_000:
        run = _within(cell, run)
    width = int(run.max()) + 1
    key, size = cell * width + run, groups * steps * width
    averages, single, number = [], [], []
    for family in families:
        values, k, c = family.values[here], key, cell
        missing = np.isnan(values)
        if missing.any():
            values, k, c = values[~missing], key[~missing], cell[~missing]
        count, each = np.bincount(k, minlength=size), np.bincount(c, minlength=groups * steps)
        with np.errstate(invalid="ignore", divide="ignore"):
            averages.append((np.bincount(k, values, size) / count).reshape(groups, steps, width))
            values = values - (np.bincount(c, values, groups * steps) / each)[c]
            spread = np.sqrt(np.bincount(c, values**2, groups * steps) / (each - 1))
        single.append(spread.reshape(groups, steps))
        number.append(each.reshape(groups, steps))
    return _LinkValues(averages, single, number, seen.reshape(groups, steps, agents))


def _within(cell: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Numbers of runs within each cell: where hardly a run has more than one cell there is nothing to hang together."""
    order = np.lexsort((run, cell))
    c, r = cell[order], run[order]
    new = np.concatenate([[True], (c[1:] != c[:-1]) | (r[1:] != r[:-1])])
    number = np.cumsum(new) - 1
    first = np.concatenate([[True], c[1:] != c[:-1]])
    out = np.empty(len(run), dtype=np.int64)
    out[order] = number - number[first][np.cumsum(first) - 1]
    return out


def _rows_by_link(results: SimulatorResults) -> list[Any]:
    """Rows of every link."""
    links = len(results.links)
    if links == 1:
        return [slice(None)]
    order = np.argsort(results.link.codes, kind="stable")
    return np.split(order, np.searchsorted(results.link.codes[order], np.arange(1, links)))


def _runs(results: SimulatorResults) -> np.ndarray:
    return results.run if results.run is not None else np.zeros(0, dtype=np.int64)


def _members(prediction: Prediction, group: int) -> tuple[int, ...]:
    return tuple((np.flatnonzero(prediction.group_of == group) + 1).tolist())


def of_runs(
    results: SimulatorResults, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> list[Judged]:
    """Return the cells of a file with a row per run.

    Parameters
    ----------
    who : (rows,) number of every row's agent, from 1; None: not given.
    prediction, families : what is compared, and with what.

    Raises
    ------
    ResultsError
        If a cell has a single run, and nothing else is wrong with the file.
    """
    found = [_gathered(results, here, who, prediction, families) for here in _rows_by_link(results)]
    expectations, judged = Expectations(prediction, families), []
    for group, step in np.ndindex(*found[0].number[0].shape):
        if not any(each[group, step] for link in found for each in link.number):
            continue
        expected = expectations.at(step + 1, group)
        for row, link in enumerate(found):
            whose = tuple((np.flatnonzero(link.agents[group, step]) + 1).tolist()) or _members(prediction, group)
            for i, family in enumerate(families):
                runs = link.averages[i][group, step]
                values = runs[~np.isnan(runs)]
                if len(values) < 2:
                    if len(values) and not results.evidence:
                        where = f"{results.source}: link {results.links[row]}, step {step + 1}"
                        raise ResultsError(f"{where}: expected at least 2 runs, got 1")
                    continue
                share = _share(float(values.std(ddof=1)), float(link.single[i][group, step]), len(values),
                               int(link.number[i][group, step]))  # fmt: skip
                cell = Cell(results.links[row], row, step + 1, whose, len(values), float(values.mean()),
                            float(values.std(ddof=1)), 0.0)  # fmt: skip
                judged.append(_judged(cell, family, expected[i], share)._replace(runs=runs))
                if judged[-1].skewness is None:
                    judged[-1] = judged[-1]._replace(skewness=_skewness(values))
    return judged


def of_means(
    results: SimulatorResults, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> list[Judged]:
    """Return the cells of a file of means, one for each row and family; parameters as of `of_runs`.

    Raises
    ------
    ResultsError
        If a standard deviation is missing that the prediction does not know either.
    """
    counts = results.count if results.count is not None else np.zeros(0, dtype=np.int64)
    group_of = np.zeros(len(counts), dtype=int) if who is None else prediction.group_of[who - 1]
    expectations, judged = Expectations(prediction, families), []
    for step in np.unique(results.step).tolist():
        for group in np.unique(group_of[results.step == step]).tolist():
            expected = expectations.at(step, group)
            for place in np.flatnonzero((results.step == step) & (group_of == group)).tolist():
                whose = _members(prediction, group) if who is None else (int(who[place]),)
                row = int(results.link.codes[place])
                for family, each in zip(families, expected, strict=True):
                    if np.isnan(family.values[place]):
                        continue
                    std = np.nan if family.std is None else float(family.std[place])
                    if np.isnan(std) and (each.deviation is None or not each.exact):
                        name = "std" if family.std is not None or len(families) == 1 else f"std:{family.column}"
                        raise ResultsError(
                            f"{results.at(place, name)}: expected a number, since method {prediction.method} does not "
                            "know the spread over the outcomes"
                        )
                    mean = float(family.values[place])
                    cell = Cell(results.links[row], row, step, whose, int(counts[place]), mean, std, 0.0)
                    judged.append(_judged(cell, family, each, 1.0))
    return judged


def _share(averaged: float, single: float, runs: int, values: int) -> float:
    """By how much the average over a run's like agents varies less than one agent: only a large sample says."""
    if runs < ENOUGH_RUNS or not single > 0:
        return 1.0
    return float(np.clip(averaged / single, sqrt(runs / values), 1.0))


def _skewness(values: np.ndarray) -> float:
    """Skewness of the mean of a sample."""
    deviation = values - values.mean()
    variance = float((deviation**2).mean())
    return float((deviation**3).mean()) / variance**1.5 / sqrt(len(values)) if variance > 0 else 0.0


def _judged(cell: Cell, family: Family, expected: ColumnExpectation, share: float) -> Judged:
    """Complete a cell that comes with the sample's standard deviation of a run in the place of the standard error."""
    row, runs, wanted = cell.row, cell.runs, float(expected.mean[cell.row])
    deviation, known = cell.error, expected.deviation is not None
    if expected.deviation is not None:
        law = share * float(expected.deviation[row])
        # what the law leaves open, noise that is not normal and outcomes that a sample missed, the sample may show
        safe = expected.exact and not (family.noisy and runs >= ENOUGH_RUNS)
        deviation = law if safe or np.isnan(cell.error) else max(law, cell.error)
    own, other = deviation / sqrt(runs), expected.error(row)
    error, difference = float(np.hypot(own, other)), cell.mean - wanted
    given = family.resolution + ROUNDING * abs(wanted)
    beyond = float(np.copysign(max(0.0, abs(difference) - given), difference))
    z = beyond / error if error > 0 else 0.0 if beyond == 0 else float(np.copysign(np.inf, beyond))
    p = erfc(abs(z) / sqrt(2)) if expected.exact else 2.0 * float(stdtr(runs - 1, -abs(z)))
    skewness = None if expected.skewness is None else abs(float(expected.skewness[row])) / sqrt(runs)
    if skewness and 0 < abs(z) < np.inf and skewness * abs(z) ** 3 / 6 > NORMAL and (expected.exact or family.noisy):
        shift = max(0.0, abs(beyond) - 2.0 * other)
        if expected.law is not None:
            p = max(p, expected.law(row).tail(wanted + float(np.copysign(shift, beyond)), runs))
    done = cell._replace(
        error=own,
        expected=wanted,
        z=z,
        p=p,
        quantity=family.quantity,
        metric=family.metric,
        column=family.column,
        expected_error=other,
        resolution=family.resolution,
    )
    drawn = None if expected.drawn is None else expected.drawn[row]
    return Judged(done, skewness if known else None, None, drawn, given)
