"""No fusion at all: every agent's own filter, whatever arrives.  The limit µ = 0 of all others."""

from __future__ import annotations

from collections.abc import Sequence

from stochfuse.estimators.recursion import RecursiveEstimator


class StandAlone(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`."""

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the agent's own estimate."""
        return values[agent]
