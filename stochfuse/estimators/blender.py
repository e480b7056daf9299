"""Blended parallel filters under lossy links (appendix A of a paper on parallel filters).

Every agent runs a filter of its own that nothing feeds back into, so that the joint covariance of all filters is known
beforehand, whatever arrives (`stochfuse.fusion.parallel`).  An agent blends its own output with the
outputs that it hears, shaped into the full state; what it blends is what it claims and is forgotten after the step.

`Blender` is a tree of two-input blenders, the agent's own filter first, then the others in their order; `JointBlender`
is the best blend of all at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.estimators.recursion import FusionStep, RecursiveEstimator, Worked
from stochfuse.estimators.world import World
from stochfuse.fusion.blender import Blend, blend_all, blend_tree
from stochfuse.fusion.parallel import ParallelFilter, ParallelFilters, parallel_filters

BLEND = "blend"


class Blender(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, of which relabellings are not used."""

    def __init__(self, world: Any, kinds: Sequence[int], relabellings: Any = None, *, errors: bool = False) -> None:
        super().__init__(world, range(world.agents), None, errors=errors)
        self._filters = _side_by_side(world)

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the blend of everything heard."""
        members = (agent, *self.neighbours(agent, heard))
        return self.pasts.number(step, (BLEND, *members), [values[j] for j in members])

    def onward(self, step: int, agent: int, fused: int, before: int, missed: bool) -> int:
        """The agent's own filter, into which the blend is not fed back."""
        return self.pasts.number(step + 1, ("local", agent), (before,))

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Blend the shaped outputs with the weights of the joint covariance."""
        members, D = rules[0][1:], len(self._shape(0))
        rows = np.concatenate([np.arange(j * D, (j + 1) * D) for j in members])
        found = self.blended(self._filters.shaped(step)[np.ix_(rows, rows)], len(members))
        x = None
        if self.riding is not None:
            terms = zip(found.weights, members, rests_on, strict=True)
            x = np.sum([B @ (self._shape(j) @ each.x + self.riding.shift(j)) for B, j, each in terms], axis=0)
        return Worked(np.broadcast_to(found.P, (len(rules), *found.P.shape)), x)

    def blended(self, joint: np.ndarray, filters: int) -> Blend:
        """Weights of a tree of two-input blenders."""
        return blend_tree(joint, filters)

    def _shape(self, agent: int) -> np.ndarray:
        rows = self.world.states[agent]
        return np.eye(rows.stop - rows.start) if self.world.M is None else self.world.M[agent]


def _side_by_side(world: World) -> ParallelFilters:
    """All agents' own filters, and how their errors hang together."""
    noise = np.stack([world.joint_noise(step) for step in range(1, world.steps + 1)])
    filters, Q_cross, R_cross, P0_cross = [], {}, {}, {}
    for i, (rows, p) in enumerate(zip(world.states, world.measurements, strict=True)):
        M = None if world.M is None else world.M[i]
        filters.append(
            ParallelFilter(world.F[i], world.H[i], world.Q[..., rows, rows], world.R[i], world.P0[rows, rows], M)
        )
        for j in range(i):
            columns = world.states[j]
            Q_cross[i, j], P0_cross[i, j] = world.Q[..., rows, columns], world.P0[rows, columns]
            R_cross[i, j] = noise[:, p, world.measurements[j]]
    return parallel_filters(filters, world.steps, Q_cross, R_cross, P0_cross)


class JointBlender(Blender):
    """The estimator; parameters are those of `Blender`."""

    def blended(self, joint: np.ndarray, filters: int) -> Blend:
        """Weights of the best blend of all at once."""
        return blend_all(joint, filters)
