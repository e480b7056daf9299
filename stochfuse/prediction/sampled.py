"""Monte Carlo for a scenario: the sample, its means, and how far they can be trusted.

Standard errors are those of the mean over independent runs.  Agents that are alike are averaged within a run first;
their
errors are dependent, the runs are not.  For a metric that is not linear in the covariance the error is carried through
by the metric's derivative at the mean (delta method), taken by central differences.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial

import numpy as np

from stochfuse.engines.events import events, relabellings
from stochfuse.engines.monte_carlo import Experiment, Sample, sample
from stochfuse.engines.progress import Progress
from stochfuse.errors import UsageError
from stochfuse.estimators.making import make
from stochfuse.estimators.world import claimed_only, moments
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction.general import groups_alike
from stochfuse.prediction.quantities import needed, value
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.scenario import Scenario

MOST_AGENTS, MOST_NUMBERS = 60, 500_000_000
"""Agents whose sets fit a machine word, and claimed values that a sample may hold."""
MANY = 10_000
"""Runs, over all rows, from which on another process pays for its start."""
ROUNDING = 1e-13
"""Standard error, relative to the value, that is rounding in runs that are all alike."""
STEP = 1e-4
"""Share of a run's deviation from the mean over which the derivative of a metric is taken."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """A sample of claimed covariances, and of the moments of the actual error where they are asked for.

    Parameters
    ----------
    sample : different moments, and which of them each agent has in each run.
    groups : agents that are alike.
    """

    sample: Sample
    groups: tuple[tuple[int, ...], ...]

    @property
    def runs(self) -> int:
        """Runs per row."""
        return self.sample.which.shape[1]

    def moments(self) -> Moments:
        """Mean moments per group, (rows, steps, groups, …)."""
        values, index = self.sample
        shape = (index.shape[0], index.shape[2], len(self.groups))
        means = values.map(lambda m: np.empty((*shape, *m.shape[1:])))
        for row, step, g in np.ndindex(shape):
            used, counts = np.unique(index[row, :, step][:, list(self.groups[g])], return_counts=True)
            for mean, each in zip(means, values, strict=True):
                if each is not None:
                    mean[row, step, g] = np.tensordot(counts, each[used], axes=1) / counts.sum()
        return means

    def standard_error(self, metric: Metric, agents: tuple[int, ...], quantity: str = "claimed") -> np.ndarray:
        """Standard error of a quantity of the mean over some agents, (rows, steps)."""
        values, index = needed(quantity, self.sample.values), self.sample.which
        out = np.empty((index.shape[0], index.shape[2]))
        for row in range(len(index)):
            for step in range(index.shape[2]):
                which = index[row, :, step][:, list(agents)]
                runs = values.map(lambda m: m[which].mean(axis=1))  # noqa: B023
                above, below = (
                    value(quantity, metric, runs.map(lambda m: m.mean(axis=0) + h * (m - m.mean(axis=0))))  # noqa: B023
                    for h in (STEP, -STEP)
                )
                slope = (above - below) / (2 * STEP)
                error = np.sqrt((slope**2).sum() / (self.runs - 1) / self.runs)
                out[row, step] = error if error > ROUNDING * np.abs(above).max() else 0.0
        return out


def sampled(
    scenario: Scenario,
    rows: LinkRows,
    estimator: str = "local-fusion-graph",
    *,
    errors: bool = False,
    runs: int = 1000,
    seed: int = 1,
    workers: int | None = None,
    criterion: str = "det",
    progress: Progress | None = None,
) -> Sampled:
    """Draw a sample of an estimator's claimed covariances.

    Parameters
    ----------
    errors : whether the moments of the actual error are wanted too.
    runs : independent runs for every row, at least 2.
    seed : of the random numbers; the same seed gives the same sample, whatever the number of workers.
    workers : processes; default: one for small samples, else one per processor.
    criterion : what the weights of an intersection minimise, see `stochfuse.estimators.making.make`.
    progress : told how many parts of the work are done.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    for name, given, least in (("runs", runs, 2), ("seed", seed, 0), ("workers", 1 if workers is None else workers, 1)):
        if given < least:
            raise UsageError(f"{name}: expected a whole number of at least {least}, got {given}")
    network, kinds = scenario.network, scenario.kind_of
    if network.agents > MOST_AGENTS:
        raise UsageError(f"method 'monte-carlo' takes at most {MOST_AGENTS} agents, got {network.agents}")
    numbers = runs * len(rows.link) * network.steps * network.agents
    if numbers > MOST_NUMBERS:
        raise UsageError(
            f"runs: {runs} runs for {len(rows.link)} link probabilities, {network.steps} steps and "
            f"{network.agents} agents are "
            f"{numbers:.3g} values; expected at most {MOST_NUMBERS:.3g}"
        )
    permutations = relabellings(network, rows, kinds)
    experiment = Experiment(
        agents=network.agents,
        events=[events(network, rows, step) for step in range(1, network.steps + 1)],
        delay=network.delay,
        make=partial(make, scenario, estimator, permutations, errors=errors, criterion=criterion),
        of=moments if errors else claimed_only,
        runs=runs,
        seed=seed,
    )
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if runs * len(rows.link) >= MANY else 1
    told = None if progress is None else lambda done, total: progress.advance(0, done, total)
    drawn = sample(experiment, len(rows.link), workers=workers, progress=told)
    return Sampled(drawn, groups_alike(network, rows, kinds, permutations))
