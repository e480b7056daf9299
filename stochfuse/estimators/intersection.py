"""Split covariance intersection, and covariance intersection, as rules of a fusion network.

What an agent's own measurement brought in this step, K R Kᵀ, is its independent part; all else, prior and process
noise, may be correlated with anything.  So at step 1, where nothing has been measured, an estimate has no independent
part, even in a scenario whose first estimates are independent: the rule does not use that.  Plain covariance
intersection takes nothing for independent.  Where measurement noises are correlated between agents, the split is wrong
and the claim may be too small.

Agents that track one state fuse the estimates heard.  Agents with states of their own fuse their estimate with what
they measured of each neighbour, z − H_j x̂_j, a signal about H_i x_i whose correlated part is H_j A_j1 H_jᵀ and whose
independent part is H_j A_j2 H_jᵀ + R.

Weights minimise the determinant, or another criterion.  A message that comes late is brought forward, and nothing of it
is independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.recursion import FusionStep, RecursiveEstimator, Worked
from stochfuse.estimators.world import World
from stochfuse.fusion.intersection import Criterion, Stack, fuse_stack

TOGETHER, RELATED = "intersection", "related intersection"


class SplitCovarianceIntersection(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, and the criterion that the weights minimise."""

    symmetric, gathers = (TOGETHER,), TOGETHER
    split = True
    """Whether anything is taken for independent."""

    def __init__(
        self,
        world: World,
        kinds: Sequence[int],
        relabellings: Sequence[tuple[int, ...]] | None = None,
        *,
        errors: bool = False,
        criterion: str = "det",
    ) -> None:
        super().__init__(world, kinds, relabellings, errors=errors)
        self.criterion = Criterion(criterion)

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the intersection of everything heard."""
        others = self.neighbours(agent, heard)
        if not others and not due:
            return values[agent]
        if self.world.own:
            return self.pasts.number(step, (RELATED, agent, *others), [values[j] for j in (agent, *others)])
        return self.pasts.number(step, (TOGETHER,), [values[agent], *(values[j] for j in others), *due])

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Fuse a batch with the weights that are best for each."""
        split = [self._split(each) for each in rests_on]
        known, independent = [c for c, _ in split], [i for _, i in split]
        if rules[0][0] == TOGETHER:
            stack = self._stack(step, known, independent)
            x = None if rests_on[0].x is None else _sum(stack.gains, [each.x for each in rests_on])
            return Worked(stack.C, x)
        return self._related(step, rules[0][1:], rests_on, known, independent)

    def _stack(self, step: int, known: Any, independent: Any, maps: Any = None) -> Stack:
        try:
            return fuse_stack(known, independent, maps, self.criterion)
        except UsageError as error:
            raise UsageError(
                f"step {step}: intersections expect estimates that are known exactly in no direction (initial.P, "
                f"model.Q, [[agent]] P and Q positive definite); got {error}"
            ) from None

    def _split(self, worked: Worked) -> tuple[np.ndarray, np.ndarray]:
        nothing = np.zeros_like(worked.P)
        independent = nothing if worked.independent is None or not self.split else worked.independent
        return worked.P - independent, independent

    def _related(
        self,
        step: int,
        agents: Sequence[int],
        rests_on: list[Worked],
        known: list[np.ndarray],
        independent: list[np.ndarray],
    ) -> Worked:
        agent, *others = agents
        maps: list[Any] = [None]
        signals = [None if rests_on[0].x is None else rests_on[0].x]
        for place, j in enumerate(others, start=1):
            H_i, H_j, R = self.world.between(step, (agent, j))
            maps.append(H_i)
            known[place] = H_j @ known[place] @ H_j.T + (0.0 if self.split else R)
            independent[place] = H_j @ independent[place] @ H_j.T + (R if self.split else 0.0 * R)
            if self.riding is not None:
                signals.append(self.riding.related(step, (agent, j)) - H_j @ rests_on[place].x)
        stack = self._stack(step, known, independent, maps)
        return Worked(stack.C, None if self.riding is None else _sum(stack.gains, signals))


class CovarianceIntersection(SplitCovarianceIntersection):
    """The estimator; parameters are those of `SplitCovarianceIntersection`."""

    split = False


def _sum(gains: Sequence[np.ndarray], signals: Sequence[Any]) -> np.ndarray:
    return np.sum([K @ a for K, a in zip(gains, signals, strict=True)], axis=0)
