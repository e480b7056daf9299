"""Mean field: average over the outcomes of a step, then go on from the average.

Applied to the broadcast prior this is the simplified stochastic formulation (53)/(54): in every step the prior is the
prediction of the averaged covariance, the common information of any set of messages is approximated by m times that
prior, and so m arrivals make one Kalman update with m + 1 measurements (`stochfuse.simplified`).

A *form* is one way to carry the recursion numerically: `MeasurementSpace` (scalar models included), `SquareRoot` where
the former would cancel, and `Outcomes` for unlike agents.  An *item* is one column of the batch: a row of link
probabilities, or such a row for one receiver where receivers differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from stochfuse.arrivals import Arrivals
from stochfuse.averaged import prior_map, smallest_pivot, triangle, update_measurement_space, update_scalar
from stochfuse.kalman import (
    Information,
    factor,
    from_factor,
    join_factors,
    predict_factor,
    update_factor,
    update_information,
)
from stochfuse.model import Model, Sensor, at_step

CANCELLATION = 1e-5
"""Share of prior variance left by an update, below which the square-root form takes over: 1e-16/1e-5 of an entry."""

BLOCK = 4096
"""Items that are carried through all steps together: what a core's cache holds for a few states."""

ELEMENTS = 4_000_000
"""Matrix elements over which unlike agents' outcomes are averaged at a time, to bound memory."""

PRECISE = 1e4
"""Information gained in one step, relative to the prior's, above which unlike agents' updates go through an SVD."""


_TINY = 1e-300


class Carried(NamedTuple):
    """A form's state between steps.

    Parameters
    ----------
    value : the form's own representation of P.
    left : (items,) smallest share of variance that is left of what was there before; its inverse times 1e-16 is lost.
    peak : (d, items) largest prior variance of each state so far, looked at in the first step and every eighth.
    """

    value: np.ndarray
    left: np.ndarray
    peak: np.ndarray | None = None


class Form(Protocol):
    """One numeric way to carry the recursion."""

    def start(self) -> Carried:
        """State after the exchange of initial estimates at step 1."""
        ...

    def advance(self, carried: Carried, step: int) -> Carried:
        """State after a step: predict, then the update averaged over arrivals."""
        ...

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        """Covariance of shape (d, d, items), written into `out` if that is given."""
        ...

    def carry(self, P: np.ndarray) -> Carried:
        """State that has the covariance P, shape (items, d, d)."""
        ...


@dataclass(frozen=True)
class Case:
    """What the recursion needs for like agents.

    Parameters
    ----------
    model, sensor : the model and every agent's sensor.
    P0 : (d, d) covariance of an initial estimate.
    shared : whether all agents start from one common estimate.
    arrivals : distribution of the number of messages at each step.
    items : number of items.
    """

    model: Model
    sensor: Sensor
    P0: np.ndarray
    shared: bool
    arrivals: Sequence[Arrivals]
    items: int

    def first_share(self) -> np.ndarray:
        """Share of P0 that the exchange at step 1 leaves, shape (items,): E[1/(m+1)], or 1 for one shared estimate."""
        return np.ones(self.items) if self.shared else self.arrivals[0].reciprocal()

    def take(self, items: np.ndarray | slice) -> Case:
        """Return the same for some of the items."""
        chosen: dict[int, Arrivals] = {}
        for a in self.arrivals:
            chosen.setdefault(id(a), a.take(items))
        return replace(self, arrivals=[chosen[id(a)] for a in self.arrivals], items=len(np.arange(self.items)[items]))


class MeasurementSpace:
    """Upper triangles with the items in the last axis; see `stochfuse.averaged`."""

    def __init__(self, case: Case):
        self.case = case

    def start(self) -> Carried:
        rows, columns, _ = triangle(self.case.model.dimension)
        P = self.case.P0[rows, columns][:, None] * self.case.first_share()
        return Carried(P, np.ones(self.case.items))

    def advance(self, carried: Carried, step: int) -> Carried:
        model, sensor = self.case.model, self.case.sensor
        matrix, constant, J = _prior_map(model, sensor, step if model.varies or sensor.varies else 2)
        prior = matrix @ carried.value
        prior += constant
        d, arrivals = model.dimension, self.case.arrivals[step - 1]
        if d == 1:
            return Carried(update_scalar(prior, J, arrivals), carried.left)
        diagonal = triangle(d)[2].diagonal()
        peak = carried.peak
        if peak is None or step % 8 == 0:
            peak = prior[diagonal] if peak is None else np.maximum(peak, prior[diagonal])
        P, left = update_measurement_space(prior, d, sensor.H.shape[-2], arrivals)
        left = np.minimum(carried.left, left)
        # digits are lost by degrees, too: to a variance far below its peak, or over many steps in a nearly singular P
        last = step == len(self.case.arrivals)
        if last or step % 8 == 0:
            left = np.minimum(left, ((P[diagonal] + _TINY) / (peak + _TINY)).min(axis=0))
        if step >= 8 and (last or step % 8 == 0):
            left = np.minimum(left, smallest_pivot(P, d))
        return Carried(P, left, peak)

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        return np.take(carried.value, triangle(self.case.model.dimension)[2], axis=0, out=out, mode="clip")

    def carry(self, P: np.ndarray) -> Carried:
        rows, columns, _ = triangle(self.case.model.dimension)
        return Carried(np.ascontiguousarray(P[:, rows, columns].T), np.ones(len(P)))


@lru_cache(maxsize=1024)
def _prior_map(model: Model, sensor: Sensor, step: int) -> tuple[np.ndarray, np.ndarray, float]:
    """`prior_map` of a step (a scalar state needs its first row only), and the information HᵀR⁻¹H of a scalar state."""
    F, Q, H, R = (at_step(M, step) for M in (model.F, model.Q, sensor.H, sensor.R))
    whitened = np.linalg.solve(np.linalg.cholesky(R), H)
    matrix, constant = prior_map(F, Q, whitened)
    rows = 1 if model.dimension == 1 else len(matrix)
    return matrix[:rows], constant[:rows], float(np.vdot(whitened, whitened))


class SquareRoot:
    """Factors L of P = L Lᵀ, shape (items, d, d)."""

    def __init__(self, case: Case):
        self.case = case

    def start(self) -> Carried:
        share = np.sqrt(self.case.first_share())
        return Carried(factor(self.case.P0) * share[:, None, None], np.ones(self.case.items))

    def advance(self, carried: Carried, step: int) -> Carried:
        model, sensor, arrivals = self.case.model, self.case.sensor, self.case.arrivals[step - 1]
        prior = predict_factor(carried.value, at_step(model.F, step), factor(at_step(model.Q, step)))
        L = update_factor(prior, at_step(sensor.H, step), at_step(sensor.R, step), lambda s: arrivals.remaining(s.T).T)
        return Carried(L, carried.left)

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        return _from_factors(carried.value, out)

    def carry(self, P: np.ndarray) -> Carried:
        return Carried(factor(P), np.ones(len(P)))


@dataclass(frozen=True)
class Outcomes:
    """Unlike agents: every count of arrivals per kind of sensor, with its weight; thesis (45)/(46) merged by kind.

    Parameters
    ----------
    model, sensors : the model and the kinds of sensors.
    P0, shared : as in `Case`.
    counts : (outcomes, kinds) how many measurements of each kind are fused, the agent's own included.
    weights : probability of each outcome at each step, shapes (outcomes, items).
    """

    model: Model
    sensors: tuple[Sensor, ...]
    P0: np.ndarray
    shared: bool
    counts: np.ndarray
    weights: Sequence[np.ndarray]

    @property
    def items(self) -> int:
        """Number of items."""
        return self.weights[0].shape[1]

    def take(self, items: np.ndarray) -> Outcomes:
        """Return the same for some of the items."""
        chosen: dict[int, np.ndarray] = {}
        for w in self.weights:
            chosen.setdefault(id(w), w[:, items])
        return replace(self, weights=[chosen[id(w)] for w in self.weights])

    def start(self) -> Carried:
        items = self.items
        share = np.ones(items) if self.shared else (self.weights[0] / self.counts.sum(axis=1)[:, None]).sum(axis=0)
        return Carried(factor(self.P0) * np.sqrt(share)[:, None, None], np.ones(items))

    def advance(self, carried: Carried, step: int) -> Carried:
        F, Q = at_step(self.model.F, step), at_step(self.model.Q, step)
        prior = predict_factor(carried.value, F, factor(Q))
        sensors = [Sensor(at_step(s.H, step), at_step(s.R, step)) for s in self.sensors]
        nothing = Information(None, np.zeros_like(prior))
        gained = np.stack([update_information(nothing, s.H @ prior, s.R).Y for s in sensors])
        weights = self.weights[step - 1]
        if (self.counts @ np.trace(gained, axis1=-2, axis2=-1)).max() > PRECISE:
            return Carried(self._precise(prior, sensors, weights), carried.left)
        left, nothing_gained = np.zeros_like(prior), np.eye(self.model.dimension)
        block = max(1, ELEMENTS // prior.size)
        for first in range(0, len(self.counts), block):
            some = np.s_[first : first + block]
            total = np.tensordot(self.counts[some].astype(float), gained, axes=1)
            left += np.einsum("ci,cijk->ijk", weights[some], np.linalg.inv(nothing_gained + total))
        return Carried(prior @ factor(left), carried.left)

    def _precise(self, prior: np.ndarray, sensors: list[Sensor], weights: np.ndarray) -> np.ndarray:
        whitened = [np.linalg.solve(np.linalg.cholesky(s.R), s.H) for s in sensors]
        joined, waiting = [], []
        for count, weight in zip(self.counts, weights, strict=True):
            H = np.concatenate([np.sqrt(c) * W for c, W in zip(count, whitened, strict=True)])
            waiting.append(update_factor(prior, H, np.eye(len(H))) * np.sqrt(weight)[:, None, None])
            if len(waiting) == 64:
                joined, waiting = [join_factors(*joined, *waiting)], []
        return join_factors(*joined, *waiting)

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        return _from_factors(carried.value, out)

    def carry(self, P: np.ndarray) -> Carried:
        return Carried(factor(P), np.ones(len(P)))


def _from_factors(L: np.ndarray, out: np.ndarray | None) -> np.ndarray:
    P = np.moveaxis(from_factor(L), 0, -1)
    if out is None:
        return P
    out[...] = P
    return out


def run(form: Form, steps: int, out: np.ndarray) -> np.ndarray:
    """Carry a form through the steps.

    Parameters
    ----------
    out : (steps, d, d, items), filled with the averaged posterior covariances.

    Returns
    -------
    ndarray
        (items,) smallest share of prior variance that any update left.
    """
    carried = form.start()
    form.covariance(carried, out[0])
    for step in range(2, steps + 1):
        carried = form.advance(carried, step)
        form.covariance(carried, out[step - 1])
    return carried.left


def run_like(case: Case, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Run like agents in measurement space, and again in square-root form where that cancels.

    Returns
    -------
    covariance : (steps, d, d, items).
    cancelled : (items,) whether the square-root form was needed.
    """
    d = case.model.dimension
    covariances, left = np.empty((steps, d, d, case.items)), np.empty(case.items)
    with np.errstate(all="ignore"):
        for first in range(0, case.items, BLOCK):
            block = np.s_[first : first + BLOCK]
            part = case if case.items <= BLOCK else case.take(block)
            left[block] = run(MeasurementSpace(part), steps, covariances[..., block])
    cancelled = ~(left > CANCELLATION) | ~np.isfinite(covariances[-1]).all(axis=(0, 1))
    if cancelled.any():
        again = np.flatnonzero(cancelled)
        redone = np.empty((steps, d, d, len(again)))
        run(SquareRoot(case.take(again)), steps, redone)
        covariances[..., again] = redone
    return covariances, cancelled
