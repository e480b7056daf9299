"""The exact optimum as control variate of a sample: what a sample of few runs does with the work of many.

In every outcome that is drawn the optimum's covariance X is found beside what is asked for, Y, from the same arrivals
(`stochfuse.engines.contact_sample`), and its expectation is known: exactly by the contact chain, or well from N ≫ R
runs that carry the optimum alone.  Entry by entry of covariances, biases and states, for each row, step and group of
like agents,

    E[Y] ≈ 1/R Σ_r Y_r − β_(r) w (X_r − E[X])            w = 1        where E[X] is exact
                                                         w = 1 − R/N  where it is that of the N − R further runs

Of the optimum itself, sampled, X is a filter of the numbers heard (`stochfuse.engines.heard`), of known expectation for
any network; by it the mean of further runs is corrected, too.  At step 1 both are one.  Where nearly all that varies
is taken away, what is left comes of outcomes so rare that a sample may not have met one: at later steps so much is
added to the error, `UNMET`.

The coefficient β_(r) = cov(Y, X)/var(X) is that of all blocks of runs but the one that r is in (splitting: Nelson 1990,
Operations Research 38, 974; Avramidis and Wilson 1993, Operations Research Letters 14, 187).  So it is independent of
what it corrects: the mean is unbiased at any R, and the terms of the sum, each a prediction error outside the runs that
β is from, carry the uncertainty of β in their spread.  Their standard error is to first order that of the jackknife
over blocks.  A metric that is not linear is carried through as in a plain sample, by its derivative.

Two levels: with costs c_Y and c_X of a run with and without the estimator the variance is least at a given time for
N/R = sqrt(c_Y ρ² / (c_X (1 − ρ²))), the R among the N (Peherstorfer, Willcox and Gunzburger 2016, SIAM Journal on
Scientific Computing 38, A3163).  The costs are measured ones, kept as a constant, so that a seed gives one answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from stochfuse.engines.contact_chain import (
    LosslessFilter,
    TooManyPathsError,
    by_number,
    check_size,
    contacts,
    expected_optimum,
    number_of_paths,
)
from stochfuse.engines.contact_sample import OptimumSample, sample_optimum
from stochfuse.engines.enclosure import enclosed_optimum
from stochfuse.engines.heard import Heard
from stochfuse.engines.monte_carlo import size_of_block
from stochfuse.engines.precision import suspects
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction.method import Settings
from stochfuse.scenario import capabilities
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import CHAIN, NO_CONTROL, OPTIMAL, STAND_ALONE, SUMS
from stochfuse.scenario.system import Noises, System

KIND, HEARD = "exact optimum", "numbers heard"
WORTH = 1.2
"""Reduction of the variance below which a sample is left as it is."""
BLOCKS = 25
"""Blocks of runs; β of one is from all the others."""
UNLIKELY = 5.0
"""Standard errors of the optimum's mean from its expectation that tell of outcomes that were not met."""
UNMET = 0.004
"""What the numbers heard leave of an outcome too rare to be met, about, relative to the value; so rare: 1/runs."""
LEFT = 0.01
"""What they leave of the optimum's variance, about."""
FLAT = 1e-12
"""Least eigenvalue of a covariance, scaled to unit variances, that is rounding."""
MOST_NUMBERS, MOST_STATES, MOST_SETS = 20_000_000, 600, 8
"""Transition probabilities of all steps, states, and unlike agents up to which the chain is cheap beside a sample."""
TIGHT = 1e-6
"""Relative half-width of an enclosure of the optimum that may stand for its expectation."""
COSTS = (30.0, 8.0)
"""What a run of an estimator that removes what is common, or of another one, costs in runs of the optimum, about."""
FURTHER = (4.0, 40.0)
"""Least and most further runs of the optimum for every run."""
FEW = 12
"""Agents of the optimum up to which equal histories, gathered, pay, and its expectation is known anyway."""
MOST_HELD = 100_000_000
"""Entries of the optimum's covariances that are held."""
SEPARATE = 1 << 20
"""First block of the further runs: beyond any that a sample comes to."""


class ControlExpectation(NamedTuple):
    """The optimum's expectation.

    Parameters
    ----------
    mean : moments, (rows, steps, agents, …).
    bound : (rows, steps) proved relative half-width of it.
    further : the same of blocks of runs that carry the optimum alone, (rows, blocks, steps, agents, …), their mean the
        mean; None where it is known.
    runs : how many further runs there are.
    """

    mean: Moments
    bound: np.ndarray
    further: Moments | None = None
    runs: int = 0

    def weight(self, runs: int) -> float:
        """How much of the difference of so many runs' mean and the expectation is corrected, w."""
        return 1.0 if self.further is None else self.runs / (self.runs + runs)


@dataclass(frozen=True, eq=False)
class Control:
    """The optimum in the runs of a sample, and its expectation.

    Parameters
    ----------
    runs : moments in every run, (rows, runs, steps, agents, …); None for those that there are none of.
    expected : its expectation.
    """

    runs: Moments
    expected: ControlExpectation

    def corrected(
        self, y: Moments, row: int, step: int, group: Sequence[int], followed: np.ndarray | slice
    ) -> tuple[Moments, Moments | None]:
        """Terms of the sum, (runs, …), and what the further runs do to their mean, block by block, (blocks, …).

        Parameters
        ----------
        y : what is asked for in every run followed to the step, averaged over a group of agents, (runs, …).
        followed : these runs.
        """
        terms, moved, agents = [], [], list(group)
        further = self.expected.further or Moments(*(None,) * len(y))
        for m, x, mean, more in zip(y, self.runs, self.expected.mean, further, strict=True):
            if m is None or x is None:
                terms.append(m)
                moved.append(m if m is None else 0.0 * m[:1])
                continue
            off = x[row, followed, step][:, agents].mean(axis=1) - mean[row, step][agents].mean(axis=0)
            β, weight = coefficients(m, off), self.expected.weight(len(m))
            corrected = m - weight * β * off
            if _indefinite(corrected) and not _indefinite(m):
                β, corrected = 0.0 * β, m
            terms.append(corrected)
            if more is not None:
                blocks = more[row, :, step][:, agents].mean(axis=1)
                moved.append(weight * β.mean(axis=0) * (blocks - blocks.mean(axis=0)))
        return Moments(*terms), None if self.expected.further is None else Moments(*moved)

    def applied(
        self, y: np.ndarray, row: int, step: int, group: Sequence[int], followed: np.ndarray | slice
    ) -> np.ndarray:
        """Terms (runs,) of a number that every run has, corrected by the trace of the optimum; where that is exact."""
        if self.expected.further is not None:
            return y
        x, mean = (
            np.trace(P, axis1=-2, axis2=-1) for P in (self.runs.P[row, followed, step], self.expected.mean.P[row, step])
        )
        off = x[:, list(group)].mean(axis=1) - mean[list(group)].mean()
        return y - coefficients(y, off, 0.0) * off


def coefficients(y: np.ndarray, x: np.ndarray, usual: float = 1.0) -> np.ndarray:
    """β of all blocks of runs but a run's own, for every run and entry, (runs, …).

    Parameters
    ----------
    y, x : (runs, …) what is corrected, and the control less its expectation.
    usual : β_0, what β is where the runs do not say it: 1 of covariances, which move with the optimum's; 0 of what has
        other units.

    Notes
    -----
    β = (Σ (x − x̄)(y − ȳ) + β_0 f) / (Σ (x − x̄)² + f) with f = n x̄² − 25 Σ (x − x̄)²/n, 0 where that is less, that is
    unless x̄ lies beyond five of its standard errors from 0: where outcomes that matter are too rare to have been met,
    β tends to what is usual.
    """
    starts, left, block_of = _blocks(len(x))
    left = left.reshape(-1, *(1,) * (x.ndim - 1))

    def sums(m: np.ndarray) -> np.ndarray:
        """Σ of all blocks but each."""
        by_block = np.add.reduceat(m, starts, axis=0)
        return by_block.sum(axis=0) - by_block

    u, v = x - x.mean(axis=0), y - y.mean(axis=0)
    U = sums(u)
    variance, common = sums(u * u) - U * U / left, sums(u * v) - U * sums(v) / left
    far = np.maximum(sums(x) ** 2 / left - (UNLIKELY**2 / left) * variance, 0.0)
    total = variance + far
    β = np.divide(common + usual * far, total, out=np.full_like(total, usual), where=total > 0)
    return β[block_of]


@lru_cache(maxsize=8)
def _blocks(runs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First run of every block, how many runs are left without it, and the block of every run."""
    starts = np.arange(min(BLOCKS, runs)) * runs // min(BLOCKS, runs)
    return starts, runs - np.diff(starts, append=runs), np.searchsorted(starts, np.arange(runs), side="right") - 1


def _indefinite(m: np.ndarray) -> bool:
    """Whether the mean of matrices (runs, d, d) is no covariance: entries are corrected one by one."""
    if m.ndim < 3 or m.shape[-1] != m.shape[-2] or m.shape[-1] == 1:
        return False
    P = m.mean(axis=0)
    sd = np.sqrt(np.abs(np.diagonal(P)))
    return bool(np.diagonal(P).min() < 0 or np.linalg.eigvalsh(P / np.outer(sd, sd).clip(1e-300))[0] < -FLAT)


def no_control(system: System, links: LinkRows, how: Settings) -> str | None:
    """Why there is no control for a sample, in words, empty where nothing needs to be said; None if there is one."""
    if how.control == NO_CONTROL or how.estimator == STAND_ALONE or (how.estimator == OPTIMAL and system.agents <= FEW):
        return ""
    try:
        capabilities.require(system, links, OPTIMAL, CHAIN)
    except UsageError as error:
        return str(error)
    entries = how.runs * len(links.link) * system.steps * system.agents * system.dimension**2
    if entries > MOST_HELD:
        return f"the optimum of every run would take {entries:.3g} entries, at most {MOST_HELD:.3g} are held"
    return None


class FollowedOptimum:
    """What goes with the runs of a sample that may grow: the optimum, or of that itself what stands in for it.

    Parameters
    ----------
    how : seed, workers and estimator.
    """

    def __init__(self, system: System, links: LinkRows, how: Settings) -> None:
        self._asked, self._waiting = (system, links, how), []
        self._found: list[np.ndarray | None] = []
        self._parts = 0
        self.kind = HEARD if how.estimator == OPTIMAL else KIND

    @cached_property
    def expected(self) -> ControlExpectation | None:
        """What is expected of it; None where that is not cheap."""
        system, links, _ = self._asked
        if self.kind == KIND:
            return expectation(system, links)
        if self.heard is None:
            return None
        return ControlExpectation(self.heard.expected(), np.zeros((len(links.link), system.steps)))

    def expected_beside(self, runs: int) -> ControlExpectation | None:
        """What is expected of it, and how far a mean of so many runs may be off by what they did not meet."""
        found = self.expected
        if found is None or self.kind == KIND:
            return found
        return found._replace(bound=found.bound + _unmet(self._asked[0], runs))

    @cached_property
    def heard(self) -> Heard | None:
        """What stands in for the optimum; None where rounding may matter."""
        system, links, _ = self._asked
        return None if suspects(system, Noises(P0=system.P0[None])).any() else Heard(system, links)

    def drawn(self, runs: int, first: int) -> OptimumSample:
        """Draw the optimum of a further part of the sample: number of runs, and first block of random numbers."""
        system, links, how = self._asked
        found = sample_optimum(system, links, runs, how.seed, workers=how.workers, first=first)
        if self.kind == HEARD:
            self._waiting.append(found.heard)
        return found

    def in_runs(self, parts: Sequence[tuple[int, int]]) -> Moments:
        """Moments in the runs of a sample of such parts, (rows, runs, steps, agents, …), each followed once."""
        for runs, first in parts[self._parts :]:
            if self.kind == KIND:
                found = self.drawn(runs, first)
                more = found.P, found.bias
            else:
                if self.heard is None:
                    raise ValueError("nothing stands in for the optimum")
                more = self.heard.of(self._waiting.pop(0))
            before = self._found or [None if m is None else m[:, :0] for m in more]
            pairs = zip(before, more, strict=True)
            self._found = [None if m is None or n is None else np.concatenate([m, n], axis=1) for m, n in pairs]
            self._parts += 1
        return Moments.of_optimum(*self._found)


def expectation(system: System, links: LinkRows) -> ControlExpectation | None:
    """Return the optimum's expectation by the contact chain; None where that is not cheap, or no better than bounds."""
    n, steps, rows = system.agents, system.steps, len(links.link)
    alike = by_number(system, links)
    if not alike and n > MOST_SETS:
        return None
    groups = [tuple(range(n))] if alike else [(i,) for i in range(n)]
    try:
        chain = contacts(system.network, links, system.sensor_of, groups, system.detects)
        if len(chain.held) > MOST_STATES or len(chain.held) ** 2 * steps * rows > MOST_NUMBERS:
            return None
        given = LosslessFilter.of(system)
        try:
            if alike and len(chain.held) == n:
                check_size(number_of_paths(system.network))
            found = expected_optimum(given, chain, steps, rows)
        except TooManyPathsError:
            if system.dimension > 1 or not alike or system.error is not None:
                return None
            found = enclosed_optimum(given, chain, steps, rows)
    except UsageError:  # more states than the chain takes
        return None
    if found.bound.max() > TIGHT:
        return None
    # of every agent, whose group it is in
    P, b, M = (m if m is None else np.repeat(m, n, axis=2) if alike else m for m in found[:3])
    return ControlExpectation(Moments(P, P, None, P) if system.error is None else Moments(P, P, b, M), found.bound)


def estimated(
    system: System, links: LinkRows, how: Settings, correlation: float, optimum: FollowedOptimum
) -> ControlExpectation:
    """Estimate the optimum's expectation from further runs that carry it alone, with the numbers heard as its control.

    Parameters
    ----------
    correlation : ρ² of the optimum and what is asked for, about.
    optimum : what goes with the sample's own runs.
    """
    least, most = FURTHER
    left = 1.0 if optimum.heard is None else LEFT
    best = sqrt(left * COSTS[how.estimator not in SUMS] * correlation / max(1.0 - correlation, 1e-9)) - 1.0
    further = min(max(best, least), most)
    runs = ceil(further * how.runs)
    numbers = len(links.link) * system.steps * system.agents * system.dimension**2
    size = max(2, min(size_of_block(system.agents), -(-runs // (2 * BLOCKS)), MOST_HELD // numbers))
    blocks = -(-runs // size)
    follow = partial(sample_optimum, system, links, size, how.seed, workers=how.workers)
    means, stand_in = [], []
    for block in range(blocks):
        drawn = follow(first=SEPARATE + block)
        means.append(_mean(drawn.P, drawn.bias))
        if optimum.heard is not None:
            stand_in.append(_mean(*optimum.heard.of(drawn.heard)))
    bound, means = np.zeros((len(links.link), system.steps)), _by_block(means)
    if optimum.heard is not None:
        bound += _unmet(system, blocks * size)
        by_block = zip(means, _by_block(stand_in), optimum.heard.expected(), strict=True)
        means = Moments(*(None if m is None else _corrected_blocks(m, x, mean) for m, x, mean in by_block))
    return ControlExpectation(means.map(lambda m: m.mean(axis=1)), bound, means, blocks * size)


def _mean(P: np.ndarray, bias: np.ndarray | None) -> Moments:
    """Mean moments of the optimum in some runs, (rows, steps, agents, …)."""
    return Moments.of_optimum(P, bias).map(lambda m: m.mean(axis=1))


def _by_block(found: Sequence[Moments]) -> Moments:
    return Moments(*(None if m[0] is None else np.stack(m, axis=1) for m in zip(*found, strict=True)))


def _corrected_blocks(m: np.ndarray, x: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Means of blocks (rows, blocks, …), corrected by what stands in for them and its expectation (rows, …)."""
    off = x - mean[:, None]
    return np.stack([of_row - coefficients(of_row, by) * by for of_row, by in zip(m, off, strict=True)])


def _unmet(system: System, runs: int) -> np.ndarray:
    """How far, relatively, a mean corrected by the numbers heard may be off by what its runs did not meet, (steps,)."""
    first = np.arange(system.steps) == 0  # where they say all
    return np.where(first, 0.0, UNMET / runs)
