"""What a right simulator's values are distributed like, in one run and of one agent: over outcomes and over noise.

Given what arrived, a linear estimate's error is normal, e ~ N(b, A), and the covariance P that it claims is fixed.  So
with independent standard normal ξ a value is, in every outcome,

    claimed         m(P)                                         of a metric m
    error           b_x + √A_xx ξ                                of a state x
    squared error   Σ (√λ_i ξ_i + m_i)²                          A_SS = V diag(λ) Vᵀ, m = Vᵀ b_S, of a metric's states S
    NEES            the same of L⁻¹ A L⁻ᵀ and L⁻¹ b              P = L Lᵀ

Over the outcomes that is a mixture (`Law`), whose mean is what the simulator's mean is compared with:

    E[m(P)],   E[b],   E[tr_S(A + b bᵀ)],   E[tr(P⁻¹ (A + b bᵀ))]

An engine that lists outcomes knows it; a sample of outcomes estimates it, and has a standard error of its own; of an
engine that gives averages alone the law is taken to be that of one average outcome (which has the right mean where
that is linear in the moments).  The noise is taken to be normal; where runs are many a simulator's own spread counts if
it is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from stochfuse.data.results import Observed
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.sampled import MomentSample
from stochfuse.scenario.registry import OPTIMAL

FLAT = 1e-12
"""Deviation, relative to the mean, that is rounding."""


class Parts(NamedTuple):
    """What a value is in every outcome: constant + deviation ξ₀ + Σ (√λ_i ξ_i + m_i)².

    Parameters
    ----------
    constant, deviation : (outcomes,)
    scale, shift : (outcomes, d) λ and m² of the squares; d may be 0.
    """

    constant: np.ndarray
    deviation: np.ndarray
    scale: np.ndarray
    shift: np.ndarray

    @property
    def cumulants(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean, variance and third central moment in every outcome."""
        λ, s = self.scale, self.shift
        mean = self.constant + (λ + s).sum(axis=-1)
        variance = self.deviation**2 + (2 * λ**2 + 4 * λ * s).sum(axis=-1)
        return mean, variance, (8 * λ**3 + 24 * λ**2 * s).sum(axis=-1)

    def take(self, chosen: np.ndarray | slice) -> Parts:
        """Return some outcomes'."""
        return Parts(*(each[chosen] for each in self))


class Law(NamedTuple):
    """Distribution of a value: outcomes with their probabilities."""

    probability: np.ndarray
    parts: Parts

    def tail(self, mean: float, runs: int) -> float:
        """Chernoff's bound on the probability that the mean of independent runs is as far off, on either side.

        It holds for the average over agents of any dependence within a run, too.
        """
        possible = self.probability > 0
        log_p, parts = np.log(self.probability[possible]), self.parts.take(possible)
        means, variances, _ = parts.cumulants
        v = means - mean
        size = float(np.abs(v).max() + np.sqrt(variances.max()))
        fixed = not variances.any()
        if size == 0:
            return 1.0
        if fixed and (v.max() < -1e-9 * size or v.min() > 1e-9 * size):
            return 0.0
        largest = float(parts.scale.max()) if parts.scale.size else 0.0

        def cumulant(t: float) -> float:
            t = t / size
            with np.errstate(divide="ignore", invalid="ignore"):
                left = 1.0 - 2.0 * t * parts.scale
                squares = (-0.5 * np.log(left) + t * parts.shift / left).sum(axis=-1)
            terms = log_p + t * (parts.constant - mean) + 0.5 * (t * parts.deviation) ** 2 + squares
            top = terms.max()
            return float(top + np.log(np.exp(terms - top).sum()))

        high = min(1e4, 0.5 * size / largest * (1 - 1e-9)) if largest > 0 else 1e4
        least: Any = minimize_scalar(cumulant, bounds=(-1e4, high), method="bounded", options={"xatol": 1e-6})
        return min(1.0, 2.0 * float(np.exp(min(0.0, runs * least.fun))))


class ColumnExpectation(NamedTuple):
    """What is expected of one column, at one step and of one group of agents, in every row of the prediction.

    Parameters
    ----------
    mean : (rows,)
    deviation, skewness : (rows,) of one agent in one run; None where they are not known.
    law : the law in a row, None where it is not known.
    exact : whether it is the law, not an estimate or a stand-in.
    drawn : (rows, runs) average of the mean over the agents in every run of a sample, None where nothing was sampled.
    """

    mean: np.ndarray
    deviation: np.ndarray | None = None
    skewness: np.ndarray | None = None
    law: Callable[[int], Law] | None = None
    exact: bool = False
    drawn: np.ndarray | None = None

    def error(self, row: int) -> float:
        """Standard error of the mean, 0 where nothing was sampled."""
        if self.drawn is None:
            return 0.0
        runs = self.drawn.shape[1]
        error = float(self.drawn[row].std(ddof=1)) / np.sqrt(runs)
        return float(error) if error > FLAT * abs(float(self.mean[row])) else 0.0


class Family(NamedTuple):
    """One thing that is compared: a column, of which quantity and in which sense.

    Parameters
    ----------
    column : name in the file.
    quantity : "claimed", "bias", "actual" (of the mean squared error) or "nees".
    metric : name of the metric; "nees" of the NEES.
    values : (rows,) a simulator's values, not-a-number where there is none.
    std : (rows,) of means, or None.
    resolution : what rounding in the file may do to a mean.
    parts : what a value is in every outcome.
    linear : whether its mean follows from average moments.
    """

    column: str
    quantity: str
    metric: str
    values: np.ndarray
    std: np.ndarray | None
    resolution: float
    parts: Callable[[Moments], Parts]
    linear: bool = True

    @property
    def noisy(self) -> bool:
        """Whether a value depends on noise besides what arrived."""
        return self.quantity != "claimed"


def claimed_parts(metric: Metric, moments: Moments) -> Parts:
    """What a claimed covariance's metric is in every outcome."""
    values = metric.of(moments.P)
    none = np.zeros((len(values), 0))
    return Parts(values, np.zeros(len(values)), none, none)


def error_parts(state: int, moments: Moments) -> Parts:
    """What an error of one state is."""
    none = np.zeros((len(moments.P), 0))
    return Parts(moments.bias[:, state, 0], np.sqrt(np.maximum(moments.actual[:, state, state], 0.0)), none, none)


def square_parts(states: Sequence[int], moments: Moments) -> Parts:
    """What a squared error over some states is."""
    chosen = list(states)
    return _squares(moments.actual[:, chosen][:, :, chosen], moments.bias[:, chosen])


def nees_parts(moments: Moments) -> Parts:
    """What a NEES is."""
    try:
        L = np.linalg.cholesky(moments.P)
    except np.linalg.LinAlgError:
        raise UsageError(
            "column 'nees': expected claimed covariances that can be inverted, got a singular one in some outcome"
        ) from None
    half = np.linalg.solve(L, moments.actual)
    return _squares(np.linalg.solve(L, np.swapaxes(half, -1, -2)), np.linalg.solve(L, moments.bias))


def _squares(A: np.ndarray, b: np.ndarray) -> Parts:
    λ, V = np.linalg.eigh((A + np.swapaxes(A, -1, -2)) / 2)
    shift = (np.swapaxes(V, -1, -2) @ b)[..., 0] ** 2
    nothing = np.zeros(len(A))
    return Parts(nothing, nothing, np.maximum(λ, 0.0), shift)


class Expectations:
    """What a prediction expects of some families, step by step; see `ColumnExpectation`.

    Parameters
    ----------
    prediction : of the moments that the families need.
    """

    def __init__(self, prediction: Prediction, families: Sequence[Family]) -> None:
        self.prediction, self.families = prediction, families
        self._drawn: list[Parts] = []
        if prediction.sampled is not None:
            self._drawn = [family.parts(prediction.sampled.sample.values) for family in families]

    def at(self, step: int, group: int) -> list[ColumnExpectation]:
        """Return what is expected at a step (from 1) of a group of agents, a family each."""
        p = self.prediction
        if p.outcomes is not None:
            probability, moments = p.outcomes.listed(step, group)
            parts = [family.parts(moments) for family in self.families]
            return [_of_outcomes(probability, each, len(p.link)) for each in parts]
        if p.sampled is not None:
            return [_of_sample(p.sampled, parts, step, group) for parts in self._drawn]
        moments = p.moments.map(lambda M: M[:, step - 1, group])
        return [self._of_averages(family, moments) for family in self.families]

    def _of_averages(self, family: Family, moments: Moments) -> ColumnExpectation:
        if family.quantity == "claimed":
            return ColumnExpectation(family.parts(moments).constant)
        parts = family.parts(moments)
        mean, variance, third = parts.cumulants
        one = np.ones(1)
        # the optimum claims what it achieves, in every outcome
        exact = family.quantity == "nees" and self.prediction.method == OPTIMAL
        return ColumnExpectation(
            mean,
            np.sqrt(variance),
            _skewness(variance, third),
            lambda row: Law(one, parts.take(slice(row, row + 1))),
            exact,
        )


def knows(prediction: Prediction, family: Family) -> bool:
    """Whether a prediction knows the mean of what is compared: listed or sampled outcomes, or averages that suffice."""
    if prediction.outcomes is not None or prediction.sampled is not None:
        return True
    if family.quantity == "nees":
        # where in every outcome the claim is true the NEES is the number of states
        bias = prediction.moments.bias
        return prediction.method == OPTIMAL and bias is not None and not bias.any()
    return family.linear


def _of_outcomes(probability: Callable[[int], np.ndarray], parts: Parts, rows: int) -> ColumnExpectation:
    means, variances, thirds = parts.cumulants
    mean, variance, third = np.empty(rows), np.empty(rows), np.empty(rows)
    for row in range(rows):
        p = probability(row)
        mean[row] = p @ means
        variance[row], third[row] = _central(p, means - mean[row], variances, thirds)
    deviation = _deviation(mean, variance)
    skewness = _skewness(deviation**2, third)
    return ColumnExpectation(mean, deviation, skewness, lambda row: Law(probability(row), parts), exact=True)


def _of_sample(sampled: MomentSample, parts: Parts, step: int, group: int) -> ColumnExpectation:
    agents, followed = list(sampled.groups[group]), sampled.sample.followed(step - 1)
    index = sampled.sample.which[:, followed, step - 1][:, :, agents]
    means, variances, thirds = parts.cumulants
    rows, runs = index.shape[:2]
    drawn, variance, third = np.empty((rows, runs)), np.empty(rows), np.empty(rows)
    for row in range(rows):
        drawn[row] = means[index[row]].mean(axis=1)
        if sampled.control is not None:
            drawn[row] = sampled.control.applied(drawn[row], row, step - 1, agents, followed)
        used, counts = np.unique(index[row], return_counts=True)
        deviations = means[used] - drawn[row].mean()
        variance[row], third[row] = _central(counts / counts.sum(), deviations, variances[used], thirds[used])

    def law(row: int) -> Law:
        used, counts = np.unique(index[row], return_counts=True)
        return Law(counts / counts.sum(), parts.take(used))

    mean = drawn.mean(axis=1)
    deviation = _deviation(mean, variance)
    return ColumnExpectation(mean, deviation, _skewness(deviation**2, third), law, drawn=drawn)


def _central(p: np.ndarray, v: np.ndarray, variances: np.ndarray, thirds: np.ndarray) -> tuple[float, float]:
    """Variance and third central moment of a mixture of parts whose means are off by v."""
    return float(p @ (variances + v**2)), float(p @ (thirds + 3 * v * variances + v**3))


def _deviation(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    deviation = np.sqrt(variance)
    return np.where(deviation > FLAT * np.abs(mean), deviation, 0.0)


def _skewness(variance: np.ndarray, third: np.ndarray) -> np.ndarray:
    return np.divide(third, variance**1.5, out=np.zeros_like(third), where=variance > 0)


def families_of(observed: Observed, metric: Metric, *, means: bool) -> list[Family]:
    """Return what is compared of a column of values.

    Parameters
    ----------
    metric : what the column is of; of an error the variance of its state.
    means : whether the values are means over runs.
    """
    column, values, std, resolution = observed
    make = partial(Family, column)
    if observed.kind == "covariance":
        of = partial(claimed_parts, metric)
        return [make("claimed", metric.name, values, std, resolution, of, metric.linear)]
    if observed.kind == "nees":
        return [make("nees", "nees", values, std, resolution, nees_parts)]
    squares = partial(square_parts, metric.states)
    if observed.kind == "squared_error":
        return [make("actual", metric.name, values, std, resolution, squares)]
    signed = make("bias", metric.name, values, std, resolution, partial(error_parts, metric.states[0]))
    # the mean of an error says nothing of the mean of its square
    return [signed] if means else [signed, make("actual", metric.name, values**2, None, resolution**2, squares)]
