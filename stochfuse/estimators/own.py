"""A fusion rule of one's own: how two or more estimates become one; all else is the package's.

A rule is any object with one method:

    def fuse(self, x, P):        # x (m, d, c): c columns of each of m estimates, the agent's own the first
        return fused_x, fused_P  # P (m, d, d) their covariances; back: (d, c) and (d, d)

Between fusions every agent runs its own Kalman filter and goes on from what it fused; messages that come late are
brought forward and are among the estimates.  With data (`run`, `simulate`) x holds the estimates, c = 1, and may be
fused in any way.  Predictions need no data: where

    x̂ = Σ K_i x̂_i       with weights K_i that depend on the P_i alone, and Σ K_i = I

the weights are found by fusing unit columns, and everything that rides along follows by them: the actual covariance is
then exact (footprints of the noises, `stochfuse.estimators.world`).  Where the fused P depends on the x̂_i nothing can
be predicted, where x̂ is no such sum nothing but the claim; both are looked for, and named.

What else a rule may say, as attributes:

    pairs = True        fuse two at a time: own and first heard, the result and the next, …
    ordered = True      the order of those heard matters; they come by number.  Otherwise it must not, which is checked
    batched = True      x (items, m, d, c) and P (items, m, d, d) come in stacks, and go back so
    name, title, source how it is called
    refuses = {…}       features of a scenario (`stochfuse methods --matrix`) that it does not take, and why

Inputs cannot be written to.  What comes back is checked: shapes, numbers, symmetry, no negative variance; a rule that
does otherwise, or raises an error, is named with step and agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from traceback import extract_tb
from typing import NamedTuple

import numpy as np

from stochfuse.estimators.recursion import FusionStep, RecursiveEstimator, RuleError, Worked
from stochfuse.estimators.world import World
from stochfuse.kalman.checks import covariance_fault, shown, size
from stochfuse.scenario.own_rules import OwnRule

TOGETHER = "own rule"
LINEAR = 1e-6
"""Relative difference from a weighted sum that is taken for rounding."""
SAME = 1e-3
"""The same for the order of those heard: weights that an iteration finds are no better known."""
SMALL, LARGE = 1e-3, 1e3
"""Sizes, in standard deviations, of the columns by which a weighted sum is recognised beside the unit ones."""
DATA_ALONE = "run and simulate, which have data, take such a rule"


class Weighed(NamedTuple):
    """Stacks of fusions as weights: K (items, m, d, d) with x̂ = Σ K_i x̂_i, and the fused P (items, d, d)."""

    K: np.ndarray
    P: np.ndarray


class OwnFusion(RecursiveEstimator):
    """The estimator; parameters are those of `RecursiveEstimator`, and the rule."""

    def __init__(
        self,
        world: World,
        kinds: Sequence[int],
        relabellings: Sequence[tuple[int, ...]] | None = None,
        *,
        errors: bool = False,
        rule: OwnRule,
    ) -> None:
        self.headed = () if rule.ordered else (TOGETHER,)
        super().__init__(world, kinds, relabellings, errors=errors)
        self.name, self.rule = rule, rule.rule
        self.pairs, self.ordered = getattr(self.rule, "pairs", False), rule.ordered
        self.batched = getattr(self.rule, "batched", False)

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value of the fusion of everything heard."""
        others = [*(values[j] for j in self.neighbours(agent, heard)), *due]
        if not others:
            return values[agent]
        value = self.pasts.number(step, (TOGETHER,), (values[agent], *others))
        self.pasts.agent_of.setdefault(value, agent)
        return value

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Fuse a batch: the numbers themselves where there are data, else by weights."""
        P = np.stack([each.P for each in rests_on], axis=1)
        x = None if rests_on[0].x is None else np.stack(np.broadcast_arrays(*(e.x for e in rests_on)), axis=1)
        if self.readings is not None and x is not None:
            return Worked(*reversed(self._all(x, P)))
        weighed = self._weighed(P)
        if P.shape[1] > 2 and not self.ordered:
            self._check_order(P[:1], weighed)
        return Worked(weighed.P, None if x is None else (weighed.K @ x).sum(axis=1))

    def _all(self, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fuse estimates (items, m, d, c) and covariances, all at once or two at a time."""
        if not self.pairs:
            return self._fused(x, P)
        fused = x[:, 0], P[:, 0]
        for j in range(1, P.shape[1]):
            fused = self._fused(np.stack([fused[0], x[:, j]], axis=1), np.stack([fused[1], P[:, j]], axis=1))
        return fused

    def _weighed(self, P: np.ndarray) -> Weighed:
        """Weights of a batch, from unit columns; in units of the deviations, so that no number is far from 1."""
        items, m, d, _ = P.shape
        unit = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1).max(axis=1))
        unit = np.where(unit > 0, unit, 1.0)
        some = np.random.default_rng(1).normal(size=(m, d, 2)) * (SMALL, LARGE)
        columns = np.concatenate([np.eye(m * d).reshape(m, d, m * d), some], axis=-1)
        x, fused = self._all(unit[:, None, :, None] * columns, P)
        K = x[..., : m * d].reshape(items, d, m, d).swapaxes(1, 2) / unit[:, None, None, :]
        if self.errors:
            self._check_weights(K, x[..., m * d :], some, unit)
        for column in range(2):  # by itself, as an estimate comes with data
            one = slice(column, column + 1)
            alone = self._all(unit[:1, None, :, None] * some[..., one], P[:1])
            if not _alike(alone[1][0], fused[0], LINEAR):
                raise RuleError(f"expected a P that depends on the P_i alone, got another for other x; {DATA_ALONE}")
            if self.errors:
                self._check_weights(K[:1], alone[0], some[..., one], unit[:1])
        return Weighed(K, fused)

    def _check_weights(self, K: np.ndarray, found: np.ndarray, some: np.ndarray, unit: np.ndarray) -> None:
        given = unit[:, None, :, None] * some
        away = np.abs(found - (K @ given).sum(axis=1)) / unit[..., None]
        sizes = (np.abs(K) @ np.abs(given)).sum(axis=1) / unit[..., None] + np.abs(some).max(axis=(0, 1))
        wrong = (away > LINEAR * sizes).any(axis=(1, 2))
        if wrong.any():
            raise RuleError(
                f"the actual error is known of a fused x that is a sum Σ K_i x_i of weights that depend "
                f"on the P_i alone, got none; {DATA_ALONE}",
                int(wrong.argmax()),
            )
        scaled = K.sum(axis=1) * unit[:, None, :] / unit[:, :, None]
        wrong = (np.abs(scaled - np.eye(K.shape[-1])) > LINEAR).any(axis=(1, 2))
        if wrong.any():
            total = shown(np.round(K.sum(axis=1)[wrong.argmax()], 6))
            raise RuleError(
                f"expected weights with Σ K_i = I, got {total}: the error would hold the state itself",
                int(wrong.argmax()),
            )

    def _check_order(self, P: np.ndarray, weighed: Weighed) -> None:
        """Fuse the first of a batch with those heard in the opposite order."""
        other = self._weighed(np.concatenate([P[:, :1], P[:, :0:-1]], axis=1))
        back = np.concatenate([other.K[0, :1], other.K[0, :0:-1]])
        if not _alike(other.P[0], weighed.P[0], SAME) or (self.errors and not _alike(back, weighed.K[0], SAME)):
            raise RuleError(
                "its result depends on the order of those heard; say so by ordered = True, which tells "
                "agents apart and takes longer"
            )

    def _fused(self, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Call the rule, and see what comes back."""
        items, _, d, c = x.shape
        if self.batched:
            found = self._called(x, P, 0, ((items, d, c), (items, d, d)))
        else:
            each = [self._called(x[i], P[i], i, ((d, c), (d, d))) for i in range(items)]
            found = np.stack([one for one, _ in each]), np.stack([one for _, one in each])
        fine = np.isfinite(found[0]).all() and covariance_fault(found[1]) is None
        for item in () if fine else range(items):
            fault = covariance_fault(found[1][item])
            if fault is not None:
                raise RuleError(f"expected a fused P that is a covariance, got {fault}", item)
            if not np.isfinite(found[0][item]).all():
                raise RuleError("expected a fused x, got values that are not finite", item)
        return found[0], 0.5 * (found[1] + np.swapaxes(found[1], -1, -2))

    def _called(
        self, x: np.ndarray, P: np.ndarray, item: int, shapes: tuple[tuple[int, ...], ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        own = np.array(x), np.array(P)
        for array in own:
            array.flags.writeable = False
        expected = "expected (x, P) of shapes " + " and ".join(f"({', '.join(map(str, s))})" for s in shapes)
        try:
            with np.errstate(all="ignore"):
                found = self.rule.fuse(*own)
        except Exception as error:
            raise RuleError(self._told(error), item) from None
        if not (np.array_equal(own[0], x) and np.array_equal(own[1], P)):
            raise RuleError("changes its inputs in place", item)
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise RuleError(f"{expected}, got {type(found).__name__}", item)
        try:
            arrays = [np.asarray(each) for each in found]
        except ValueError:
            raise RuleError(f"{expected}, got what is no array", item) from None
        for array, shape in zip(arrays, shapes, strict=True):
            if array.dtype.kind not in "fiu" or array.shape != shape:
                got = size(array.shape) or "a number" if array.dtype.kind in "fiu" else f"{array.dtype} numbers"
                raise RuleError(f"{expected}, got {got}", item)
        return arrays[0].astype(float), arrays[1].astype(float)

    def _told(self, error: Exception) -> str:
        """What a rule's own error says, and where in the rule's file it happened."""
        code = getattr(getattr(self.rule.fuse, "__func__", self.rule.fuse), "__code__", None)
        lines = [f for f in extract_tb(error.__traceback__) if code is not None and f.filename == code.co_filename]
        where = f" (line {lines[-1].lineno} of {lines[-1].filename.rpartition('/')[2]})" if lines else ""
        if isinstance(error, ValueError) and "read-only" in str(error):
            return f"changes its inputs in place{where}; expected new arrays"
        return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"


def _alike(A: np.ndarray, B: np.ndarray, within: float) -> bool:
    return bool(np.abs(A - B).max() <= within * max(np.abs(A).max(), np.abs(B).max()))
