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
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.distribution import Distribution, parse_statistic
from stochfuse.engines.enumeration import Request, Structure, TooManyError, claimed, enumerate_outcomes, expectation
from stochfuse.engines.events import (
    MOST_AGENTS_RELABELLED,
    Rows,
    bernstein,
    bursty,
    events,
    monomials,
    orbits,
    relabellings,
    weights_for,
)
from stochfuse.engines.precision import change, moved_claims, reach
from stochfuse.engines.progress import Progress
from stochfuse.errors import StochfuseError, UsageError
from stochfuse.estimators.making import SUMS, make
from stochfuse.estimators.protocol import Claims, Made
from stochfuse.estimators.world import error_sources, moments, sources_of
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction.quantities import linear, matrix, number, value
from stochfuse.scenario.network import LinkRows, Network, number_of_senders, uniform_rows
from stochfuse.scenario.scenario import Scenario

MOST_PROBABILITIES = 20_000_000
"""Probabilities that a distribution may hold at a time."""
MOST_AGENTS, MOST_SENDERS = 40, 12
"""Agents, and agents that one of them may hear, up to which outcomes are listed."""


def itself(estimate: Estimate) -> Estimate:
    """Average estimates as they are."""
    return estimate


@dataclass(frozen=True, eq=False)
class Outcomes:
    """All outcomes of a scenario with what is claimed in each.

    Parameters
    ----------
    scenario, rows : what was given.
    groups : agents that are alike, as sorted tuples.
    structure : the outcomes.
    values : numbers for every value in the structure.
    weights : bookkeeping of probabilities.
    of : what is averaged: the estimate itself, or the moments of its error (quantities other than claimed need them).
    again : what the values claim with moved numbers, to be called for; see `stochfuse.engines.precision`.
    """

    scenario: Scenario
    rows: LinkRows
    groups: tuple[tuple[int, ...], ...]
    structure: Structure
    values: Claims
    weights: Any
    of: Callable[[Estimate], Any] = itself
    again: Callable[[], Sequence[Callable[[], Claims]]] = tuple

    @property
    def polynomial(self) -> bool:
        """Whether the expectation is a polynomial in one link probability."""
        return not isinstance(self.weights, Rows)

    @cached_property
    def expectations(self) -> list[list[Any]]:
        """Expected estimate or moments per step and group of agents, on the weights' axis (coefficients A_c, or rows).

        Where outcomes were left out: given that the outcome is one of those that were not.
        """
        return [found for found, _ in self._expected]

    @cached_property
    def _expected(self) -> list[tuple[list[Any], float]]:
        return self._expectations(self.values)

    def _expectations(self, values: Claims) -> list[tuple[list[Any], float]]:
        groups = len(self.groups)
        return [expectation(e, values, self.weights, groups, self.of) for e in self.structure.endings]

    @cached_property
    def rounding(self) -> float:
        """How far rounding may reach in an expected covariance at any link probability, relative to the deviations.

        The larger of what the last inversion of an outcome's information loses, and what moved numbers change.
        """
        lost = 2e-16 * max(magnified for _, magnified in self._expected)
        again = self.again()
        return max(lost, float(reach(lambda seed: self._change(again[seed]()), len(again))))

    def _change(self, values: Claims) -> float:
        """Largest change of an expected covariance if the values claimed others."""
        quantities = ("claimed",) if self.of is itself else ("claimed", "actual", "rms")
        pairs = zip(self._expected, self._expectations(values), strict=True)
        groups = [pair for (found, _), (moved, _) in pairs for pair in zip(found, moved, strict=True)]
        return max(float(change(matrix(q, a), matrix(q, b)).max()) for q in quantities for a, b in groups)

    def coefficients(self, step: int, group: int = 0, quantity: str = "claimed") -> np.ndarray:
        """A_0 … A_L of E[P(step)](µ) = Σ A_c µ^c (1−µ)^(L−c), shape (L + 1, d, d); or of another quantity's matrix.

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
        return matrix(quantity, self.expectations[step - 1][group])

    def covariance(self, link: np.ndarray | None = None, quantity: str = "claimed") -> np.ndarray:
        """Expected covariance, (rows, steps, groups, d, d), at the rows or, of a polynomial, at some link
        probabilities.  Another quantity: its matrix, see `stochfuse.prediction.quantities.matrix`.

        Raises
        ------
        UsageError
            If link probabilities are given and there is no polynomial.
        """
        if link is not None:
            self.coefficients(1)
        return self._stacked([[self._at(matrix(quantity, e), link) for e in step] for step in self.expectations])

    def moments(self, link: np.ndarray | None = None) -> Moments:
        """Expected moments of the error that were averaged, (rows, steps, groups, …), where `covariance` has them."""
        if self.of is itself:
            return Moments(self.covariance(link))
        return Moments(*(self.covariance(link, q) for q in ("claimed", "actual", "bias", "rms")))

    def states(self) -> np.ndarray:
        """Expected state estimates, (rows, steps, groups, d, 1), (48)."""
        return self._stacked([[self._at(e.x, None) for e in step] for step in self.expectations])

    def _stacked(self, by_step: list[list[np.ndarray]]) -> np.ndarray:
        stacked = np.stack([np.stack(by_group, axis=1) for by_group in by_step], axis=1)
        return stacked if self.polynomial else stacked / self._kept()[:, :, None, None, None]

    def derivative(self, quantity: str = "claimed") -> np.ndarray:
        """dE[P]/dµ at the scenario's rows, (rows, steps, groups, d, d); or of another quantity's matrix."""
        µ = self.rows.link
        out = []
        for step in range(1, len(self.expectations) + 1):
            by_group = []
            for group in range(len(self.groups)):
                A = self.coefficients(step, group, quantity)
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
        return np.stack([self.weights.collected(e.weights.sum(axis=0)) for e in self.structure.endings], axis=1)

    def statistic(self, name: str, metric: Metric, groups: Sequence[int], quantity: str = "claimed") -> np.ndarray:
        """Return a statistic of a metric over the outcomes, (rows, steps).

        Parameters
        ----------
        name : "variance", "std", "quantile:P", "at-most:LIMIT" or "derivative" (of the expected metric, in µ).
        groups : groups of agents, each agent as likely as every other.
        quantity : what the metric is taken of, in each outcome.

        Raises
        ------
        UsageError
            If there is no such statistic, or it cannot be had of this metric.
        """
        kind, argument = check_statistic(name, quantity, metric)
        share = [len(self.groups[g]) for g in groups]
        if kind == "derivative":
            slope = np.average(self.derivative(quantity)[:, :, groups], axis=2, weights=share)
            return number(quantity, metric, slope)
        of: dict[str, Callable[[Distribution], np.ndarray]] = {
            "variance": Distribution.variance,
            "std": lambda spread: np.sqrt(spread.variance()),
            "quantile": lambda spread: spread.quantile(argument),
            "at-most": lambda spread: spread.at_most(argument),
        }
        return self.over_outcomes(metric, groups, of[kind], quantity)

    def over_outcomes(
        self,
        metric: Metric,
        groups: Sequence[int],
        of: Callable[[Distribution], np.ndarray],
        quantity: str = "claimed",
    ) -> np.ndarray:
        """Return what a function (rows of it) makes of the distribution at every step, (rows, steps)."""
        columns = []
        for step in range(1, len(self.structure.endings) + 1):
            blocks = self._blocks_of_rows(step)
            columns.append(np.concatenate([of(self.distribution(metric, step, groups, b, quantity)) for b in blocks]))
        return np.stack(columns, axis=1)

    def _blocks_of_rows(self, step: int) -> list[slice]:
        """Rows in blocks small enough that a distribution of each fits in memory."""
        views, rows = self.structure.endings[step - 1].views, len(self.rows.link)
        values = sum(len(view.ids) * len(view.terms[0][1]) for view in views)
        size = max(1, MOST_PROBABILITIES // values)
        return [slice(first, first + size) for first in range(0, rows, size)]

    def distribution(
        self,
        metric: Metric,
        step: int,
        groups: Sequence[int] = (0,),
        rows: slice = slice(None),
        quantity: str = "claimed",
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
                found = value(quantity, metric, Moments(estimate.P) if quantity == "claimed" else self.of(estimate))
            if not np.isfinite(found).all():
                raise StochfuseError(f"{metric.label} is not finite in some outcome: it grows beyond floating point")
            before = self._probability(ending.weights[states], rows)
            cells = np.repeat(self._probability(view.factors, rows), np.diff([*view.starts, found.shape[1]]), axis=1)
            last = sum(part * self._probability(share[None], rows) for share, part in shares)
            values.append(found.ravel())
            both = before[:, :, None] * (cells * last)[:, None, :]
            weights.append(self._collected(both.reshape(len(both), -1), rows))
        merged = Distribution.merged(np.concatenate(values), np.concatenate(weights, axis=1))
        return Distribution(merged.values, merged.probability / merged.probability.sum(axis=1, keepdims=True))

    def _probability(self, table: np.ndarray, rows: slice) -> np.ndarray:
        """Probabilities (rows, entries) of entries given on the weights' axis."""
        if self.polynomial:
            return monomials(table.shape[1] - 1, self.rows.link[rows]) @ table.T
        if not self.weights.memory:
            return table.T[rows]
        links = len(self.rows.link)
        return table.T.reshape(links, -1, len(table))[rows].reshape(-1, len(table))

    def _collected(self, probability: np.ndarray, rows: slice) -> np.ndarray:
        """Sum over what is hidden of the links, (rows, entries)."""
        chosen = len(range(*rows.indices(len(self.rows.link))))
        return probability.reshape(chosen, -1, probability.shape[1]).sum(axis=1)

    def _at(self, expected: np.ndarray, link: np.ndarray | None) -> np.ndarray:
        if not self.polynomial:
            return expected
        return bernstein(expected, len(expected) - 1, self.rows.link if link is None else link)


def check_statistic(name: str, quantity: str, metric: Metric) -> tuple[str, float]:
    """Return kind and number of a statistic.

    Raises
    ------
    UsageError
        If there is no such statistic, or it cannot be had of this metric.
    """
    kind, number = parse_statistic(name)
    if kind == "derivative" and not linear(quantity, metric):
        raise UsageError(
            "derivative: expected metric trace or var:STATE of quantity claimed or actual, or the bias of one state, "
            f"got '{metric.name}' of {quantity}"
        )
    return kind, number


def outcomes(
    scenario: Scenario,
    rows: LinkRows,
    estimator: str = "local-fusion-graph",
    *,
    records: np.ndarray | None = None,
    errors: bool = False,
    max_graphs: int = 100_000,
    prune: bool = False,
    plain: bool = False,
    criterion: str = "det",
    progress: Progress | None = None,
) -> Outcomes:
    """Enumerate all outcomes of a scenario.

    Parameters
    ----------
    rows : rows of link probabilities.
    estimator : one of `stochfuse.prediction.predict.ESTIMATORS`.
    records : measurements (steps, agents, p) where states are wanted.
    errors : whether the moments of the actual error are wanted too; not with records.
    max_graphs : states that may be carried from step to step.
    prune : leave the least likely states out where there are more.
    plain : merge nothing.
    criterion : what the weights of an intersection minimise, see `stochfuse.estimators.making.make`.
    progress : told how far the work is.

    Raises
    ------
    UsageError
        If the outcomes are too many, or a covariance has no inverse.
    """
    found = enumerated(
        scenario,
        rows,
        estimator,
        records=records,
        errors=errors,
        max_graphs=max_graphs,
        prune=prune,
        plain=plain,
        criterion=criterion,
        progress=progress,
    )
    of, again = moments if errors else itself, tuple
    if estimator in SUMS:
        sources = partial(error_sources, scenario) if errors else partial(sources_of, scenario, records)
        again = partial(moved_claims, scenario, found.made.estimator.ledger, sources)
    return Outcomes(scenario, rows, found.groups, found.structure, found.made.claims(), found.weights, of, again)


class Enumerated(NamedTuple):
    """All outcomes of a scenario before any number is put in.

    Parameters
    ----------
    groups : agents that are alike.
    structure : the outcomes.
    made : the estimator that has written them down, and what its values claim.
    weights : bookkeeping of probabilities.
    """

    groups: tuple[tuple[int, ...], ...]
    structure: Structure
    made: Made
    weights: Any


def enumerated(
    scenario: Scenario,
    rows: LinkRows,
    estimator: str,
    *,
    records: np.ndarray | None = None,
    errors: bool = False,
    max_graphs: int = 100_000,
    prune: bool = False,
    plain: bool = False,
    criterion: str = "det",
    progress: Progress | None = None,
    polynomial: bool = False,
) -> Enumerated:
    """Enumerate all outcomes of a scenario; parameters and errors are those of `outcomes`.

    Parameters
    ----------
    polynomial : count successes although links differ: those that there are, are equally likely.
    """
    network = scenario.network
    check_size(network)
    # records tell like agents apart
    kinds = scenario.kind_of if records is None else tuple(range(network.agents))
    permutations = relabellings(network, rows, kinds)
    # a bursty link keeps its state where it is: nobody may change places
    fixed = plain or rows.bursts is not None
    made = make(
        scenario, estimator, None if fixed else permutations, errors=errors, records=records, criterion=criterion
    )
    per_step = [events(network, rows, step) for step in range(1, network.steps + 1)]
    if rows.bursts is not None:
        weights = bursty(per_step[0], len(rows.link))
    else:
        alike = uniform_rows([0.5]) if polynomial else rows
        weights = Rows(len(rows.link)) if prune else weights_for(network, alike, sum(map(len, per_step)))
    groups = groups_alike(network, rows, kinds, permutations)
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
    return Enumerated(groups, enumerate_outcomes(made.estimator, request, progress), made, weights)


def groups_alike(
    network: Network, rows: LinkRows, labels: Sequence[int], permutations: Sequence[tuple[int, ...]]
) -> tuple[tuple[int, ...], ...]:
    """Groups of agents that some relabelling takes into one another; of too many to look, all or none."""
    if network.agents > MOST_AGENTS_RELABELLED and rows.uniform and len(set(labels)) == 1:
        return (tuple(range(network.agents)),)
    return tuple(orbits(network.agents, permutations))


def check_size(network: Network) -> None:
    """Raise TooManyError if there are too many agents to list what one of them may hear."""
    if number_of_senders(network.architecture, network.agents) > MOST_SENDERS or network.agents > MOST_AGENTS:
        raise TooManyError(
            f"every outcome is gone through for at most {MOST_AGENTS} agents that hear at most {MOST_SENDERS} "
            f"others each, got {network.agents} agents, {network.architecture}: use --method optimal or "
            "--method monte-carlo"
        )
