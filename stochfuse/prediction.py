"""A prediction: plain arrays with named axes, and what they mean."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.metrics import Metric, metric
from stochfuse.scenario import Scenario


@dataclass(frozen=True)
class Prediction:
    """Expected covariance against link probability and step.

    Parameters
    ----------
    scenario : what was given.
    method : how it was computed: "simplified".
    quantity : which covariance: "claimed".
    stage : "posterior": after the step's measurement and fusion.
    nature : "exact", "approximate", "bound" or "sampled".
    link : (links,) link probability of each row, averaged over the links if they differ.
    cases : a name per row where the rows are cases, else None.
    steps : (steps,) step numbers, from 1.
    by_group : (links, steps, groups, d, d) covariance per group of agents that are alike.
    group_of : (agents,) index into the groups.
    forms : numeric forms used.
    notes : what the reader should know, one sentence each.
    steady : (links, groups, d, d) steady-state covariance if it was asked for.
    steady_bound : (links, groups) proved relative error bound of `steady`.
    """

    scenario: Scenario
    method: str
    quantity: str
    stage: str
    nature: str
    link: np.ndarray
    cases: tuple[str, ...] | None
    steps: np.ndarray
    by_group: np.ndarray
    group_of: np.ndarray
    forms: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    steady: np.ndarray | None = None
    steady_bound: np.ndarray | None = field(default=None, repr=False)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance averaged over the agents, shape (links, steps, d, d)."""
        return self.of_agent("mean")

    @property
    def alike(self) -> bool:
        """Whether all agents have the same covariance."""
        return self.by_group.shape[2] == 1

    def of_agent(self, agent: int | str = "mean") -> np.ndarray:
        """Covariance of one agent (numbered from 1) or averaged over all, shape (links, steps, d, d)."""
        return _select(self.by_group, self.group_of, agent)

    def values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a metric of the covariance, shape (links, steps).

        Parameters
        ----------
        of : a `stochfuse.metrics.Metric` or its name.
        agent : "mean" (of the covariance averaged over the agents), a number from 1, or "worst" or "best" (the largest
            or smallest value among the agents, for each link and step).
        """
        return self._reduce(self.by_group, of, agent)

    def steady_values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return a metric of the steady state, shape (links,), or None if none was computed."""
        return None if self.steady is None else self._reduce(self.steady, of, agent)

    def table(self, of: str = "trace", agent: int | str = "mean") -> str:
        """Return the table as text, as `stochfuse predict` prints it."""
        from stochfuse.report.predictions import View, predict_table
        from stochfuse.report.table import to_text

        return to_text(predict_table(View(self, metric(of, self.scenario.model), agent)), width=None)

    def with_steady(self, P: np.ndarray, bound: np.ndarray) -> Prediction:
        """Return the same with its steady state."""
        return replace(self, steady=P, steady_bound=bound)

    def _reduce(self, P: np.ndarray, of: str | Metric, agent: int | str) -> np.ndarray:
        m = metric(of, self.scenario.model) if isinstance(of, str) else of
        with np.errstate(over="ignore", invalid="ignore"):
            if agent in ("worst", "best"):
                each = m.of(P)
                return each.max(axis=-1) if agent == "worst" else each.min(axis=-1)
            return m.of(_select(P, self.group_of, agent))


def _select(P: np.ndarray, group_of: np.ndarray, agent: int | str) -> np.ndarray:
    if agent == "mean":
        share = np.bincount(group_of, minlength=P.shape[-3]) / len(group_of)
        return P[..., 0, :, :] if P.shape[-3] == 1 else np.tensordot(P, share, axes=(P.ndim - 3, 0))
    if isinstance(agent, int | np.integer) and 1 <= agent <= len(group_of):
        return P[..., group_of[agent - 1], :, :]
    raise UsageError(f"agent: expected mean, worst, best or a number from 1 to {len(group_of)}, got '{agent}'")
