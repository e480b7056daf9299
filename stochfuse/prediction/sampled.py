"""Monte Carlo for a scenario: the sample, its means, and how far they can be trusted.

Standard errors are those of the mean over independent runs.  Agents that are alike are averaged within a run first;
their errors are dependent, the runs are not.  For a metric that is not linear in the covariance the error is carried
through by the metric's derivative at the mean (delta method), taken by central differences.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from stochfuse.engines.contact_sample import sample_optimum
from stochfuse.engines.events import events, relabellings
from stochfuse.engines.monte_carlo import Experiment, Sample, sample
from stochfuse.errors import UsageError
from stochfuse.estimators.making import kinds_of, make
from stochfuse.estimators.protocol import Claims, Estimator
from stochfuse.estimators.world import claimed_only, moments
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction.general import groups_alike, spread
from stochfuse.prediction.method import Averaged, Settings, group_of, joined
from stochfuse.prediction.quantities import needed, value
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import OPTIMAL
from stochfuse.scenario.system import Items, Noises, System

MOST_AGENTS, MOST_NUMBERS = 60, 500_000_000
"""Agents whose sets fit a machine word, and claimed values that a sample may hold."""
MOST_OF_OPTIMUM, FEW, MOST_ENTRIES = 1000, 12, 200_000_000
"""Agents of the optimum; those up to which equal histories, gathered, pay; entries of its covariances in a sample."""
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


def averaged(system: System, items: Items, how: Settings, errors: bool) -> Averaged:
    """Draw a sample of an estimator's estimates, as a method; see `Averaged`.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    parts = []
    for members, alone, some in items.by_noises(system):
        found = sampled(alone, some.links, how, errors=errors)
        parts.append(
            (
                members,
                Averaged(
                    moments=found.moments(),
                    group_of=group_of(found.groups),
                    natures=np.full(len(some), "sampled"),
                    estimator=how.estimator,
                    rounding=np.zeros(len(some)),
                    sampled=found,
                    meta={"runs": how.runs, "seed": how.seed},
                ),
            )
        )
    return joined(parts)


def sampled(system: System, links: LinkRows, how: Settings, *, errors: bool = False) -> Sampled:
    """Draw a sample of an estimator's estimates.

    Parameters
    ----------
    how : runs, seed, workers and estimator.
    errors : whether the moments of the actual error are wanted too.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    _check(system, links, how)
    network, kinds = system.network, kinds_of(system, how.estimator)
    permutations = relabellings(network, links, kinds)
    groups = groups_alike(network, links, kinds, permutations)
    if how.estimator == OPTIMAL and network.agents > FEW:
        return _optimum(system, links, how, groups, errors)
    return Sampled(_drawn(system, links, how, permutations, errors=errors), groups)


def states(system: System, links: LinkRows, how: Settings, records: np.ndarray) -> Sample:
    """Draw a sample of an estimator's estimates given what was measured, whatever sensors might have missed.

    Parameters
    ----------
    how : runs, seed, workers and estimator.
    records : (steps, agents, p) measurements.

    Returns
    -------
    Sample
        Of `stochfuse.prediction.general.Spread`.

    Raises
    ------
    UsageError
        If runs, seed or workers are out of range.
    """
    _check(system, links, how)
    permutations = relabellings(system.network, links, range(system.agents))
    return _drawn(system, links, how, permutations, records=records)


def _check(system: System, links: LinkRows, how: Settings) -> None:
    """Raise UsageError if a sample is out of range."""
    given = (("runs", how.runs, 2), ("seed", how.seed, 0), ("workers", 1 if how.workers is None else how.workers, 1))
    for name, value_of, least in given:
        if value_of < least:
            raise UsageError(f"{name}: expected a whole number of at least {least}, got {value_of}")
    network, rows = system.network, len(links.link)
    most = MOST_OF_OPTIMUM if how.estimator == OPTIMAL else MOST_AGENTS
    if network.agents > most:
        raise UsageError(f"method 'monte-carlo' takes at most {most} agents, got {network.agents}")
    numbers = how.runs * rows * network.steps * network.agents
    if numbers > MOST_NUMBERS:
        raise UsageError(
            f"runs: {how.runs} runs for {rows} link probabilities, {network.steps} steps and {network.agents} agents "
            f"are {numbers:.3g} values; expected at most {MOST_NUMBERS:.3g}"
        )


def _drawn(
    system: System,
    links: LinkRows,
    how: Settings,
    permutations: list[tuple[int, ...]],
    *,
    errors: bool = False,
    records: np.ndarray | None = None,
) -> Sample:
    """Draw outcomes, and keep what is claimed in them, moments of the errors, or estimates given measurements."""
    network, rows = system.network, len(links.link)
    steps = range(1, network.steps + 1)
    experiment = Experiment(
        agents=network.agents,
        events=[events(network, links, step) for step in steps],
        detections=[system.detections(step) if records is None else [] for step in steps],
        make=partial(_made, system, how, permutations, errors, records),
        of=spread if records is not None else moments if errors else claimed_only,
        runs=how.runs,
        seed=how.seed,
    )
    workers = how.workers
    if workers is None:
        many = how.runs * rows >= MANY and getattr(how.estimator, "travels", True)
        workers = len(os.sched_getaffinity(0)) if many else 1
    return sample(experiment, rows, workers=workers)


def _optimum(
    system: System, links: LinkRows, how: Settings, groups: tuple[tuple[int, ...], ...], errors: bool
) -> Sampled:
    """Sample the optimum by Boolean products: nearly every history of many agents has a value of its own."""
    n, d, steps, rows = system.agents, system.dimension, system.steps, len(links.link)
    entries = how.runs * rows * steps * n * d**2
    if entries > MOST_ENTRIES:
        raise UsageError(
            f"runs: {how.runs} runs for {rows} link probabilities, {steps} steps and {n} agents of {d} states are "
            f"{entries:.3g} entries of covariances; expected at most {MOST_ENTRIES:.3g}"
        )
    found = sample_optimum(system, links, how.runs, how.seed, workers=how.workers)
    P = found.P.reshape(-1, d, d)
    values = Moments(P)
    if errors:
        bias = np.zeros((len(P), d, 1)) if found.bias is None else found.bias.reshape(-1, d, 1)
        values = Moments(P, P, bias, P + bias @ np.swapaxes(bias, -1, -2))
    which = np.arange(len(P), dtype=np.int32).reshape(found.P.shape[:4])
    return Sampled(Sample(values, which), groups)


def _made(
    system: System, how: Settings, permutations: list[tuple[int, ...]], errors: bool, records: np.ndarray | None
) -> tuple[Estimator, Callable[[], Claims]]:
    """An estimator, and what to call for its numbers."""
    made = make(system, how.estimator, permutations, errors=errors, records=records, criterion=how.criterion)
    return made.estimator, partial(made.claims, system, Noises())
