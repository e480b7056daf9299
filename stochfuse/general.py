"""The general stochastic formulation, thesis (44)–(49): every outcome, every common prior, exactly.

    (49)  E[P(k)] = Σ_S µ_S µ_¬S P_S(k)        (48)  E[x̂(k)] = Σ_S µ_S µ_¬S x̂_S(k)

over the outcomes S of "which messages arrive, in all steps up to k", (45)/(46).  P_S and x̂_S are what the Local
Fusion Graph claims in that outcome (or naive fusion, (42)/(43), with its estimator).  With one µ for all links,

    E[P(k)](µ) = Σ_c A_c µ^c (1−µ)^(L−c)

is a polynomial whose coefficients are found once; with unequal µ_ij(k) every row of link probabilities is summed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.distribution import Distribution, parse_statistic
from stochfuse.engines import Progress
from stochfuse.engines.enumeration import (
    Request,
    Structure,
    claimed,
    enumerate_outcomes,
    expectation,
)
from stochfuse.errors import StochfuseError, UsageError
from stochfuse.estimators.local_fusion_graph import LocalFusionGraph
from stochfuse.estimators.naive import NaiveFusion
from stochfuse.events import (
    MOST_AGENTS_RELABELLED,
    Rows,
    bernstein,
    events,
    monomials,
    orbits,
    relabellings,
    weights_for,
)
from stochfuse.information import Information, Ledger, Sources, evaluate
from stochfuse.kalman import Estimate, to_information
from stochfuse.metrics import Metric
from stochfuse.network import LinkRows, Network, number_of_senders
from stochfuse.scenario import Scenario

MOST_PROBABILITIES = 20_000_000
"""Probabilities that a distribution may hold at a time."""
MOST_AGENTS, MOST_SENDERS = 40, 12
"""Agents, and agents that one of them may hear, up to which outcomes are listed."""
ESTIMATORS = {"local-fusion-graph": LocalFusionGraph, "naive": NaiveFusion}


@dataclass(frozen=True, eq=False)
class Outcomes:
    """All outcomes of a scenario with what is claimed in each.

    Parameters
    ----------
    scenario, rows : what was given.
    groups : agents that are alike, as sorted tuples.
    structure : the outcomes.
    values : information of every value in the structure.
    weights : bookkeeping of probabilities.
    """

    scenario: Scenario
    rows: LinkRows
    groups: tuple[tuple[int, ...], ...]
    structure: Structure
    values: Information
    weights: Any

    @property
    def polynomial(self) -> bool:
        """Whether the expectation is a polynomial in one link probability."""
        return not isinstance(self.weights, Rows)

    @cached_property
    def expectations(self) -> list[list[Estimate]]:
        """Expected estimate per step and group of agents, on the weights' axis (coefficients A_c, or rows).

        Where outcomes were left out: given that the outcome is one of those that were not.
        """
        return [found for found, _ in self._expected]

    @cached_property
    def _expected(self) -> list[tuple[list[Estimate], float]]:
        return [expectation(ending, self.values, self.weights, len(self.groups)) for ending in self.structure.endings]

    @property
    def rounding(self) -> float:
        """Estimate of the largest relative rounding error of an outcome's covariance."""
        return 2e-16 * max(magnified for _, magnified in self._expected)

    def coefficients(self, step: int, group: int = 0) -> np.ndarray:
        """A_0 … A_L of E[P(step)](µ) = Σ A_c µ^c (1−µ)^(L−c), shape (L + 1, d, d).

        Raises
        ------
        UsageError
            If links differ, so that there is no single µ.
        """
        if not self.polynomial:
            raise UsageError(
                "a polynomial in µ: expected one link probability for all links and steps, and every outcome; got "
                "links that differ, or outcomes left out"
            )
        return self.expectations[step - 1][group].P

    def covariance(self, link: np.ndarray | None = None) -> np.ndarray:
        """Expected covariance, (rows, steps, groups, d, d), at the rows or, of a polynomial, at some link
        probabilities.

        Raises
        ------
        UsageError
            If link probabilities are given and there is no polynomial.
        """
        if link is not None:
            self.coefficients(1)
        return self._stacked([[self._at(e.P, link) for e in step] for step in self.expectations])

    def states(self) -> np.ndarray:
        """Expected state estimates, (rows, steps, groups, d, 1), (48)."""
        return self._stacked([[self._at(e.x, None) for e in step] for step in self.expectations])

    def _stacked(self, by_step: list[list[np.ndarray]]) -> np.ndarray:
        stacked = np.stack([np.stack(by_group, axis=1) for by_group in by_step], axis=1)
        return stacked if self.polynomial else stacked / self._kept()[:, :, None, None, None]

    def derivative(self) -> np.ndarray:
        """dE[P]/dµ at the scenario's rows, (rows, steps, groups, d, d)."""
        µ = self.rows.link
        out = []
        for step in range(1, len(self.expectations) + 1):
            by_group = []
            for group in range(len(self.groups)):
                A = self.coefficients(step, group)
                L = len(A) - 1
                c = np.arange(L + 1).reshape(-1, 1, 1)
                # d/dµ Σ A_c µ^c (1−µ)^(L−c), by Bernstein's form of degree L − 1
                slope = (c * A)[1:] - ((L - c) * A)[:-1] if L else np.zeros((1, *A.shape[1:]))
                by_group.append(bernstein(slope, max(L - 1, 0), µ))
            out.append(np.stack(by_group, axis=1))
        return np.stack(out, axis=1)

    @property
    def left_out(self) -> np.ndarray:
        """Probability of the outcomes left out, (rows, steps)."""
        if self.polynomial:
            return np.zeros((len(self.rows.link), len(self.structure.endings)))
        return 1.0 - self._kept()

    def _kept(self) -> np.ndarray:
        return np.stack([ending.weights.sum(axis=0) for ending in self.structure.endings], axis=1)

    def statistic(self, name: str, metric: Metric, groups: Sequence[int]) -> np.ndarray:
        """Return a statistic of a metric over the outcomes, (rows, steps).

        Parameters
        ----------
        name : "variance", "std", "quantile:P", "at-most:LIMIT" or "derivative" (of the expected metric, in µ).
        groups : groups of agents, each agent as likely as every other.

        Raises
        ------
        UsageError
            If there is no such statistic, or it cannot be had of this metric.
        """
        kind, number = parse_statistic(name)
        share = [len(self.groups[g]) for g in groups]
        if kind == "derivative":
            if not metric.linear:
                raise UsageError(f"derivative: expected metric trace or var:STATE, got '{metric.name}'")
            return metric.of(np.average(self.derivative()[:, :, groups], axis=2, weights=share))
        of: dict[str, Callable[[Distribution], np.ndarray]] = {
            "variance": Distribution.variance,
            "std": lambda spread: np.sqrt(spread.variance()),
            "quantile": lambda spread: spread.quantile(number),
            "at-most": lambda spread: spread.at_most(number),
        }
        return self.over_outcomes(metric, groups, of[kind])

    def over_outcomes(
        self, metric: Metric, groups: Sequence[int], of: Callable[[Distribution], np.ndarray]
    ) -> np.ndarray:
        """Return what a function (rows of it) makes of the distribution at every step, (rows, steps)."""
        columns = [
            np.concatenate([of(self.distribution(metric, step, groups, rows)) for rows in self._blocks_of_rows(step)])
            for step in range(1, len(self.structure.endings) + 1)
        ]
        return np.stack(columns, axis=1)

    def _blocks_of_rows(self, step: int) -> list[slice]:
        """Rows in blocks small enough that a distribution of each fits in memory."""
        views, rows = self.structure.endings[step - 1].views, len(self.rows.link)
        values = sum(len(view.ids) * len(view.terms[0][1]) for view in views)
        size = max(1, MOST_PROBABILITIES // values)
        return [slice(first, first + size) for first in range(0, rows, size)]

    def distribution(
        self, metric: Metric, step: int, groups: Sequence[int] = (0,), rows: slice = slice(None)
    ) -> Distribution:
        """Values of a metric over all outcomes of a step, with their probabilities in some rows (default: every one).

        Several groups of agents: of an agent picked at random.
        """
        ending = self.structure.endings[step - 1]
        agents = sum(len(self.groups[g]) for g in groups)
        values, weights = [], []
        for view, states, estimate, _ in claimed(ending, self.values):
            shares = [(view.shares[g], len(self.groups[g]) / agents) for g in groups if view.shares[g] is not None]
            if not shares:
                continue
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):
                value = metric.of(estimate.P)
            if not np.isfinite(value).all():
                raise StochfuseError(f"{metric.label} is not finite in some outcome: it grows beyond floating point")
            before = self._probability(ending.weights[states], rows)
            cells = np.repeat(self._probability(view.factors, rows), np.diff([*view.starts, value.shape[1]]), axis=1)
            last = sum(part * self._probability(share[None], rows) for share, part in shares)
            values.append(value.ravel())
            weights.append((before[:, :, None] * (cells * last)[:, None, :]).reshape(len(before), -1))
        found = Distribution.merged(np.concatenate(values), np.concatenate(weights, axis=1))
        return Distribution(found.values, found.probability / found.probability.sum(axis=1, keepdims=True))

    def _probability(self, table: np.ndarray, rows: slice) -> np.ndarray:
        """Probabilities (rows, entries) of entries given on the weights' axis."""
        if self.polynomial:
            return monomials(table.shape[1] - 1, self.rows.link[rows]) @ table.T
        return table.T[rows]

    def _at(self, expected: np.ndarray, link: np.ndarray | None) -> np.ndarray:
        if not self.polynomial:
            return expected
        return bernstein(expected, len(expected) - 1, self.rows.link if link is None else link)


def outcomes(
    scenario: Scenario,
    rows: LinkRows,
    estimator: str = "local-fusion-graph",
    *,
    records: np.ndarray | None = None,
    max_graphs: int = 100_000,
    prune: bool = False,
    plain: bool = False,
    progress: Progress | None = None,
) -> Outcomes:
    """Enumerate all outcomes of a scenario.

    Parameters
    ----------
    rows : rows of link probabilities.
    estimator : "local-fusion-graph" or "naive".
    records : measurements (steps, agents, p) where states are wanted.
    max_graphs : states that may be carried from step to step.
    prune : leave the least likely states out where there are more.
    plain : merge nothing.
    progress : told how far the work is.

    Raises
    ------
    UsageError
        If the outcomes are too many, or a covariance has no inverse.
    """
    network = scenario.network
    alike = records is None
    labels = scenario.sensor_of if alike else tuple(range(network.agents))
    ledger = Ledger()
    check_size(network)
    permutations = relabellings(network, rows, labels)
    made = ESTIMATORS[estimator](
        ledger, labels, shared=scenario.correlation == "shared", relabellings=None if plain else permutations
    )
    per_step = [events(network, rows, step) for step in range(1, network.steps + 1)]
    weights = Rows(len(rows.link)) if prune else weights_for(network, rows, sum(map(len, per_step)))
    groups = groups_alike(network, rows, labels, permutations)
    request = Request(
        agents=network.agents,
        steps=network.steps,
        delay=network.delay,
        events=lambda step: per_step[step - 1],
        weights=weights,
        groups=groups,
        most=max_graphs,
        prune=prune,
        plain=plain,
    )
    sources = sources_of(scenario, records)
    structure = enumerate_outcomes(made, request, progress)
    return Outcomes(scenario, rows, groups, structure, evaluate(ledger, sources), weights)


def groups_alike(
    network: Network, rows: LinkRows, labels: Sequence[int], permutations: Sequence[tuple[int, ...]]
) -> tuple[tuple[int, ...], ...]:
    """Groups of agents that some relabelling takes into one another; of too many to look, all or none."""
    if network.agents > MOST_AGENTS_RELABELLED and rows.uniform and len(set(labels)) == 1:
        return (tuple(range(network.agents)),)
    return tuple(orbits(network.agents, permutations))


def check_size(network: Network) -> None:
    """Raise UsageError if there are too many agents to list what one of them may hear."""
    if number_of_senders(network.architecture, network.agents) > MOST_SENDERS or network.agents > MOST_AGENTS:
        raise UsageError(
            f"every outcome is gone through for at most {MOST_AGENTS} agents that hear at most {MOST_SENDERS} "
            f"others each, got {network.agents} agents, {network.architecture}: use --method optimal or "
            "--method monte-carlo"
        )


def sources_of(scenario: Scenario, records: np.ndarray | None = None, *, by_agent: bool = False) -> Sources:
    """Return what start and measurements of every source are worth.

    Parameters
    ----------
    records : measurements (steps, agents, p); with them every agent is a source of its own.
    by_agent : whether that is so anyway; else every kind of sensor is one.

    Raises
    ------
    UsageError
        If the initial covariance has no inverse.
    """
    x0 = None if records is None else scenario.x0
    try:
        start = to_information(Estimate(x0, scenario.P0))
    except np.linalg.LinAlgError:
        start = None
    if start is None or not np.isfinite(start.Y).all():
        raise UsageError("initial.P: expected an invertible covariance for the Local Fusion Graph, got a singular one")
    sensors = scenario.sensors
    if by_agent or records is not None:
        sensors = [scenario.sensors[kind] for kind in scenario.sensor_of]
    columns = None if records is None else [[z[..., None] for z in step] for step in records]
    return Sources(scenario.model, sensors, [start] * len(sensors), columns)
