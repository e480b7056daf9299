"""Cooperative estimators under lossy links: LWIN and ITNS (a patent's two approaches).

LWIN (local, with immediate neighbours): agent i takes what it measured of each neighbour into its own estimate, with
the neighbour's claimed covariance as noise.  ITNS (integrated total network solution): a centre keeps one covariance
for all agents, and every local and cooperative measurement corrects all of them.  A cooperative measurement y_ij is
there if agent i hears agent j.  All measurements of a step use the estimates from before the exchange.

Where all agents track one state there is nothing to measure between them; agreement itself, x_i − x_j = 0, takes the
place of a cooperative measurement (H_i = I, H_j = −I, R = 0).  LWIN is then naive fusion (42)/(43).  ITNS then takes
local residuals for known to the centre whatever arrives, as its source does: only agreement depends on the links.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.estimators.protocol import Late
from stochfuse.estimators.recursion import FusionStep, PastExchange, PastState, RecursiveEstimator, Worked
from stochfuse.fusion.cooperative import itns_update, lwin_update
from stochfuse.kalman.kernel import Estimate, at_step, factor, predict

AGREED, RELATED, JOINT, JOINT_LOCAL, BLOCK = "agreed", "related", "joint", "joint local", "block"


class Lwin(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`."""

    symmetric = (AGREED,)

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the agent's estimate with what it measured of the agents heard."""
        others = self.neighbours(agent, heard)
        if not others:
            return values[agent]
        rule = (RELATED, agent, *others) if self.world.own else (AGREED,)
        return self.pasts.number(step, rule, [values[j] for j in (agent, *others)])

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """One neighbour after the other."""
        own, *neighbours = (Estimate(each.x, each.P) for each in rests_on)
        _, *agents = rules[0]
        # agreement is the same between any two
        pairs = [(agents[0], j) for j in agents[1:]] if agents else [(0, 1)] * len(neighbours)
        for pair, neighbour in zip(pairs, neighbours, strict=True):
            z = None if self.riding is None else self.riding.related(step, pair)
            own = lwin_update(own, neighbour, *self.world.between(step, pair), z)
        return Worked(own.P, own.x)


class Itns(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, of which relabellings are not used.

    Footprints live for one step: the joint estimate is all that goes on, so that a factor of its actual covariance
    takes their place at the next.
    """

    joint = True
    mixed = (JOINT,)

    def __init__(self, world: Any, kinds: Sequence[int], relabellings: Any = None, *, errors: bool = False) -> None:
        super().__init__(world, range(world.agents), None, errors=errors)

    def start(self) -> PastState:
        """The joint first estimate; every agent's value is the joint one."""
        return PastState(1, (self.pasts.number(1, (JOINT_LOCAL,)),) * self.world.agents)

    def exchange(self, state: PastState) -> JointExchange:
        """Open the exchange of the state's step."""
        return JointExchange(self, state)

    def batch(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Work a batch out."""
        name = rules[0][0]
        if name == JOINT_LOCAL:
            return self._first() if step == 1 else self._local(step, rests_on[0], rules[0][1:])
        if name == BLOCK:
            rows = self.world.states[rules[0][1]]
            (joint,) = rests_on
            if self.readings is not None:
                return Worked(joint.P[:, rows, rows], joint.x[:, rows])
            if joint.actual is None:
                return Worked(joint.P[:, rows, rows])
            return Worked(joint.P[:, rows, rows], actual=joint.actual[:, rows, rows], bias=joint.bias[:, rows])
        joint = self._exchanged(step, rules, rests_on[0])
        return joint.settled() if self.errors and self.readings is None else joint

    def _first(self) -> Worked:
        world = self.world
        if self.readings is not None:
            return Worked(world.P0[None], self.readings.start(slice(None)))
        if not self.errors:
            return Worked(world.P0[None])
        b = np.zeros((len(world.P0), 1)) if world.error is None else world.error
        return Worked(world.P0[None], self._with_columns(1, factor(world.P0)[None], b[None])[0])

    def _local(self, step: int, before: Worked, missed: Sequence[int]) -> Worked:
        """Time update of the whole and all local measurements, but those of agents whose sensor misses."""
        world, data = self.world, self.readings
        x, w, v = None, None, None
        if data is not None:
            x, w = before.x, data.process(step, slice(None))
        elif self.errors:
            x, (w, v) = self._with_columns(
                step,
                factor(before.actual),
                before.bias,
                -factor(at_step(world.Q, step)),
                factor(world.true_noise(step)),
            )
        prior = predict(Estimate(x, before.P), world.joint_transition(step), at_step(world.Q, step), w)
        estimate = prior
        for agent, rows in enumerate(world.measurements):
            if rows.stop > rows.start and agent not in missed:
                H, R, z = world.joint_sensor(agent, step), at_step(world.R[agent], step), None
                if data is not None:
                    H, z = data.sensor(step, agent, H), data.measured(step, agent)
                elif v is not None:
                    z = v[rows]
                estimate = itns_update(estimate, H, R, z)
        self.grown(prior.P, estimate.P)
        return Worked(estimate.P, estimate.x)

    def _with_columns(
        self, step: int, root: np.ndarray, bias: np.ndarray, *noises: np.ndarray
    ) -> tuple[Any, list[Any]]:
        """Errors and the step's noises, each in columns of its own, with columns left for measurements of others."""
        related = self._related_columns(step)
        width = root.shape[-1] + sum(n.shape[1] for n in noises) + related + 1
        x = np.zeros((*root.shape[:-1], width))
        x[..., : root.shape[-1]], x[..., -1:] = root, bias
        placed, first = [], root.shape[-1] + related
        for noise in noises:
            placed.append(np.zeros((len(noise), width)))
            placed[-1][:, first : first + noise.shape[1]] = noise
            first += noise.shape[1]
        return x, placed

    def _related_columns(self, step: int) -> int:
        return sum(at_step(relation.R, step).shape[-1] for relation in self.world.relations.values())

    def _exchanged(self, step: int, rules: Sequence[FusionStep], before: Worked) -> Worked:
        """Take in what was measured between agents: each rule says between whom, receiver and sender in turn."""
        P, x = before.P.copy(), None if before.x is None else before.x.copy()
        measured = [set(zip(rule[1::2], rule[2::2], strict=True)) for rule in rules]
        first = len(self.world.P0)
        pairs = self.world.relations if self.world.own else sorted(set().union(*measured))
        for pair in pairs:
            here = np.array([pair in m for m in measured])
            H, R = self._between(step, pair)
            columns = slice(first, first + (len(R) if self.world.own else 0))
            first = columns.stop
            if not here.any():
                continue
            z = None
            if self.readings is not None:
                z = self.readings.related(step, pair)
                z = z[here] if z.ndim > 2 and len(z) == len(here) else z
            elif x is not None:
                z = np.zeros((len(H), x.shape[-1]))
                if self.world.own:
                    z[:, columns] = factor(R)
            estimate = itns_update(Estimate(None if x is None else x[here], P[here]), H, R, z)
            P[here] = estimate.P
            if x is not None:
                x[here] = estimate.x
        return Worked(P, x)

    def _between(self, step: int, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """What one agent measures of another, over the joint state, and its noise."""
        (i, j), states = pair, self.world.states
        H_i, H_j, R = self.world.between(step, pair)
        H = np.zeros((len(R), len(self.world.P0)))
        H[:, states[i]], H[:, states[j]] = H_i, H_j
        return H, R


class JointExchange(PastExchange):
    """One exchange of all agents with the centre."""

    estimator: Itns

    def _joint(self, heard: Sequence[int]) -> int:
        """Value of the joint estimate after an exchange."""
        step, (value, *_), _ = self.state
        arrived = [(i, j) for i, mask in enumerate(heard) for j in range(len(heard)) if mask >> j & 1 and i != j]
        return self.estimator.pasts.number(step, (JOINT, *(agent for pair in arrived for agent in pair)), (value,))

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value of the agent's block of the joint estimate."""
        return self.estimator.pasts.number(self.state.step, (BLOCK, agent), (self._joint(heard),))

    def _next(self, heard: Sequence[int], late: Sequence[Late], missed: int) -> PastState:
        step, agents = self.state.step + 1, range(len(heard))
        rule = (JOINT_LOCAL, *(i for i in agents if missed >> i & 1))
        return PastState(step, (self.estimator.pasts.number(step, rule, (self._joint(heard),)),) * len(agents))
