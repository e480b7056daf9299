"""A prediction: plain arrays with named axes, and what they mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import stochfuse
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Metric, Moments, metric
from stochfuse.prediction.quantities import linear, matrix, number, value
from stochfuse.scenario.registry import BROADCAST_PRIOR
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.system import Noises

if TYPE_CHECKING:
    from stochfuse.prediction.general import Outcomes
    from stochfuse.prediction.interval import Posterior
    from stochfuse.prediction.sampled import MomentSample


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """Expected covariance, or another quantity of the error, against link probability and step.

    Parameters
    ----------
    scenario : what was given.
    method : how it was computed: "simplified", "general", "naive", "optimal" or "monte-carlo".
    quantity : what is shown, one of `stochfuse.prediction.quantities.QUANTITIES`.
    stage : "posterior": after the step's measurement and fusion.
    nature : "exact", "approximate", "bound" or "sampled".
    link : (links,) link probability of each row, averaged over the links if they differ.
    cases : a name per row where the rows are cases, else None.
    steps : (steps,) step numbers, from 1.
    moments : moments of the error, (links, steps, groups, …), per group of agents that are alike.
    group_of : (agents,) index into the groups.
    forms : numeric forms used.
    notes : what the reader should know, one sentence each.
    estimator : what the agents do with what arrives.
    outcomes : all outcomes, where they were enumerated: for distributions and polynomials.
    sampled : the sample, where it was drawn: for standard errors.
    meta : further facts for programs.
    limit : the steady state, or cycle, if it was asked for.
    noises : of each item, where items have noises of their own.
    supported : link probabilities that the log supports and the prediction of them, if an interval was asked for.
    """

    scenario: Scenario
    method: str
    quantity: str
    stage: str
    nature: str
    link: np.ndarray
    cases: tuple[str, ...] | None
    steps: np.ndarray
    moments: Moments
    group_of: np.ndarray
    forms: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    estimator: str = BROADCAST_PRIOR
    outcomes: Outcomes | None = field(default=None, repr=False)
    sampled: MomentSample | None = field(default=None, repr=False)
    meta: Mapping[str, Any] = field(default_factory=dict)
    limit: Limit | None = None
    supported: tuple[Posterior, Prediction] | None = field(default=None, repr=False)
    noises: Noises | None = field(default=None, repr=False)

    @property
    def by_group(self) -> np.ndarray:
        """Covariance per group of agents, shape (links, steps, groups, d, d).

        Of consistency it is the actual covariance, of rms the mean squared error, of bias the vector (…, d, 1).
        """
        return matrix(self.quantity, self.moments)

    @property
    def covariance(self) -> np.ndarray:
        """The same averaged over the agents, shape (links, steps, d, d)."""
        return self.of_agent("mean")

    @property
    def alike(self) -> bool:
        """Whether all agents have the same covariance."""
        return self.by_group.shape[2] == 1

    @property
    def with_actual(self) -> bool:
        """Whether the moments of the actual error are known."""
        return self.moments.actual is not None

    def of_agent(self, agent: int | str = "mean") -> np.ndarray:
        """The same of one agent (numbered from 1) or averaged over all, shape (links, steps, d, d)."""
        return self._select(self.by_group, agent)

    def shown_as(self, quantity: str) -> Prediction:
        """Return the same prediction with another quantity of those that were computed.

        Raises
        ------
        UsageError
            If it was not computed.
        """
        if matrix(quantity, self.moments) is None:
            raise UsageError(f"quantity {quantity}: was not computed; predict it with quantity='{quantity}'")
        limit = self.limit
        limit = None if limit is None else replace(limit, prediction=limit.prediction.shown_as(quantity))
        return replace(self, quantity=quantity, limit=limit)

    def values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a metric of the covariance (or what the quantity makes of it), shape (links, steps).

        Parameters
        ----------
        of : a `stochfuse.kalman.metrics.Metric` or its name.
        agent : "mean" (of the covariance averaged over the agents), a number from 1, a name, or "worst" or "best" (the
            largest or smallest value among the agents, for each link and step).
        """
        return self._reduce(self.moments, of, agent)

    def statistic(self, name: str, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a statistic of a metric over the outcomes, shape (links, steps).

        Parameters
        ----------
        name : "mean", "variance", "std", "quantile:P", "at-most:LIMIT" (the probability that the metric is at most
            that) or "derivative" (of the expected metric in the link probability).
        of : the metric; except for "mean", of the covariance in each outcome.
        agent : as in `values`; "mean" is an agent picked at random.

        Raises
        ------
        UsageError
            If the outcomes were not enumerated, or there is no such statistic of the metric.
        """
        if name == "mean":
            return self.values(of, agent)
        if self.outcomes is None:
            raise UsageError(f"statistic '{name}': expected method general or naive, got {self.method}")
        m = metric(of, self.scenario.model) if isinstance(of, str) else of
        everyone = list(range(self.by_group.shape[2]))
        if agent in ("worst", "best"):
            each = np.stack([self.outcomes.statistic(name, m, [g], self.quantity) for g in everyone])
            return each.max(axis=0) if agent == "worst" else each.min(axis=0)
        chosen = everyone if agent == "mean" else [self._group(agent)]
        return self.outcomes.statistic(name, m, chosen, self.quantity)

    def polynomials(self, of: Metric, agent: int | str = "mean") -> list[np.ndarray] | None:
        """Return A_0 … A_L per step of a linear metric's polynomial Σ A_c µ^c (1−µ)^(L−c); None if there is none."""
        if self.outcomes is None or not self.outcomes.polynomial or agent in ("worst", "best"):
            return None
        if not linear(self.quantity, of):
            return None
        groups = range(self.by_group.shape[2]) if agent == "mean" else [self._group(agent)]
        share = [(self.group_of == g).sum() for g in groups]
        by_step = []
        for k in self.steps:
            each = [self.outcomes.coefficients(int(k), g, self.quantity) for g in groups]
            by_step.append(number(self.quantity, of, np.average(each, axis=0, weights=share)))
        return by_step

    def standard_error(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of `values`, shape (links, steps), or None if nothing was sampled."""
        if self.sampled is None:
            return None
        m = metric(of, self.scenario.model) if isinstance(of, str) else of
        groups = range(len(self.sampled.groups))
        if agent in ("worst", "best"):
            each = np.stack([self.sampled.standard_error(m, [group], self.quantity) for group in groups])
            values = value(self.quantity, m, self.moments)
            chosen = values.argmax(axis=-1) if agent == "worst" else values.argmin(axis=-1)
            return np.take_along_axis(each, chosen[None], axis=0)[0]
        whom = groups if agent == "mean" else [self._group(agent)]
        return self.sampled.standard_error(m, whom, self.quantity)

    def interval(self, of: str | Metric = "trace", agent: int | str = "mean") -> tuple[np.ndarray, np.ndarray] | None:
        """Return low and high end of `values`, each (links, steps), as the log supports them; None if not asked for."""
        if self.supported is None:
            return None
        posterior, moved = self.supported
        ends = posterior.ends(self.values(of, agent)[0], moved.shown_as(self.quantity).values(of, agent))
        return ends[0][None], ends[1][None]

    def low(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the low end of `interval`."""
        ends = self.interval(of, agent)
        return None if ends is None else ends[0]

    def high(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the high end of `interval`."""
        ends = self.interval(of, agent)
        return None if ends is None else ends[1]

    def _group(self, agent: int | str) -> int:
        return int(self.group_of[int(self.scenario.network.agent(agent)) - 1])

    @property
    def steady(self) -> np.ndarray | None:
        """Covariance in the steady state, (links, groups, d, d), of a cycle its mean; None if it was not asked for."""
        return None if self.limit is None else self.limit.last(self.limit.prediction.by_group).mean(axis=1)

    @property
    def steady_bound(self) -> np.ndarray | None:
        """Proved relative error bound of `steady`, (links, groups); None where there is none."""
        return None if self.limit is None else self.limit.bound

    def steady_values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return a metric of the steady state, shape (links,), of a cycle its mean; None if none was computed."""
        return None if self.limit is None else self.limit.values(of, agent).mean(axis=1)

    def steady_error(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of `steady_values`, shape (links,); None if it was not sampled."""
        return None if self.limit is None else self.limit.standard_error(of, agent)

    def table(self, of: str = "trace", agent: int | str = "mean") -> str:
        """Return the table as text, as `stochfuse predict` prints it."""
        return stochfuse.shown("text_of", self, of=of, agent=agent)

    def _reduce(self, moments: Moments, of: str | Metric, agent: int | str) -> np.ndarray:
        m = metric(of, self.scenario.model) if isinstance(of, str) else of
        with np.errstate(over="ignore", invalid="ignore"):
            if agent in ("worst", "best"):
                each = value(self.quantity, m, moments)
                return each.max(axis=-1) if agent == "worst" else each.min(axis=-1)
            return value(self.quantity, m, moments.map(lambda M: self._select(M, agent)))

    def _select(self, M: np.ndarray, agent: int | str) -> np.ndarray:
        if agent != "mean":
            return M[..., self._group(agent), :, :]
        share = np.bincount(self.group_of, minlength=M.shape[-3]) / len(self.group_of)
        return M[..., 0, :, :] if M.shape[-3] == 1 else np.tensordot(M, share, axes=(M.ndim - 3, 0))


@dataclass(frozen=True, eq=False, repr=False)
class Limit:
    """What a prediction tends to: a steady state, or a cycle of as many steps as what is given repeats itself in.

    Parameters
    ----------
    prediction : whose last steps are those of the cycle; its nature is that of the limit.
    period : steps of the cycle; 1 where nothing varies.  Its phases are the steps k ≡ 1, 2 … (mod period).
    bound : (links, groups) proved relative error bound, or None.
    notes : how it was found, one sentence each.
    """

    prediction: Prediction
    period: int = 1
    bound: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def last(self, values: np.ndarray) -> np.ndarray:
        """What a prediction has at the phases, (links, period, …)."""
        return values[:, -self.period :]

    def values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a metric at every phase, shape (links, period)."""
        return self.last(self.prediction.values(of, agent))

    def standard_error(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of the phases' mean, shape (links,), or None if nothing was sampled.

        That of the phases, averaged: how far they depend on one another is not known, and it is no more than that.
        """
        errors = self.prediction.standard_error(of, agent)
        return None if errors is None else self.last(errors).mean(axis=1)
