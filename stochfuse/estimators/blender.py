"""Blended parallel filters under lossy links (theory section 9; appendix A of a paper on parallel filters).

Every agent runs a filter of its own that nothing feeds back into, so that the joint covariance of all filters is known
beforehand, whatever arrives (`stochfuse.fusion.blender.cross_covariance`).  An agent blends its own output with the
outputs that it hears, shaped into the full state; what it blends is what it claims and is forgotten after the step.

`Blender` is a tree of two-input blenders, the agent's own filter first, then the others in their order; `JointBlender`
is the best blend of all at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.estimators.recursion import RecursiveEstimator, Rule, Worked
from stochfuse.fusion.blender import Blend, blend_all, blend_tree, cross_covariance
from stochfuse.kalman import gain
from stochfuse.model import at_step

BLEND = "blend"


class Blender(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, of which relabellings are not used."""

    def __init__(self, world: Any, kinds: Sequence[int], relabellings: Any = None, *, errors: bool = False) -> None:
        super().__init__(world, range(world.agents), None, errors=errors)
        self._joint = {1: world.P0}

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the blend of everything heard."""
        members = (agent, *self.neighbours(agent, heard))
        return self.pasts.number(step, (BLEND, *members), [values[j] for j in members])

    def onward(self, step: int, agent: int, fused: int, before: int) -> int:
        """The agent's own filter, into which the blend is not fed back."""
        return self.pasts.number(step + 1, ("local", agent), (before,))

    def work(self, step: int, rules: Sequence[Rule], rests_on: list[Worked]) -> Worked:
        """Blend the shaped outputs with the weights of the joint covariance."""
        members = rules[0][1:]
        M = [self._shape(j) for j in members]
        joint = self.joint(step)
        shaped = np.block(
            [
                [A @ joint[self.world.states[i], self.world.states[j]] @ B.T for j, B in zip(members, M, strict=True)]
                for i, A in zip(members, M, strict=True)
            ]
        )
        found = self.blended(shaped, len(members))
        x = None
        if self.footprints is not None:
            x = np.sum([B @ A @ each.x for B, A, each in zip(found.weights, M, rests_on, strict=True)], axis=0)
        return Worked(np.broadcast_to(found.P, (len(rules), *found.P.shape)), x)

    def blended(self, joint: np.ndarray, filters: int) -> Blend:
        """Weights of a tree of two-input blenders."""
        return blend_tree(joint, filters)

    def joint(self, step: int) -> np.ndarray:
        """Joint covariance of all filters' errors at a step, each on its own."""
        if step not in self._joint:
            self._joint[step] = self._updated(self.joint(step - 1), step)
        return self._joint[step]

    def _shape(self, agent: int) -> np.ndarray:
        rows = self.world.states[agent]
        return np.eye(rows.stop - rows.start) if self.world.M is None else self.world.M[agent]

    def _updated(self, before: np.ndarray, step: int) -> np.ndarray:
        world, Q, noise = self.world, at_step(self.world.Q, step), self.world.joint_noise(step)
        F, H, R = ([at_step(M, step) for M in each] for each in (world.F, world.H, world.R))
        K = []
        for i, rows in enumerate(world.states):
            K.append(gain(F[i] @ before[rows, rows] @ F[i].T + Q[rows, rows], H[i], R[i]))
        out = np.empty_like(before)
        for i, rows in enumerate(world.states):
            for j, columns in enumerate(world.states):
                noises = noise[world.measurements[i], world.measurements[j]]
                out[rows, columns] = cross_covariance(
                    before[rows, columns], F[i], F[j], Q[rows, columns], K[i], H[i], K[j], H[j], noises
                )
        return out


class JointBlender(Blender):
    """The estimator; parameters are those of `Blender`."""

    def blended(self, joint: np.ndarray, filters: int) -> Blend:
        """Weights of the best blend of all at once."""
        return blend_all(joint, filters)
