"""Mean field: average over the outcomes of a step, then go on from the average.

Applied to the broadcast prior this is the simplified stochastic formulation (53)/(54): in every step the prior is the
prediction of the averaged covariance, the common information of any set of messages is approximated by m times that
prior, and so m arrivals make one Kalman update with m + 1 measurements (`stochfuse.prediction.simplified`).

A *form* is one way to carry the recursion numerically: `MeasurementSpace` (scalar models included), `SquareRoot` where
the former would cancel, and `UnlikeCase` for unlike agents.  An *item* is one column of the batch: a row of link
probabilities, or such a row for one receiver where receivers differ.  Items may have noises Q, R and P(k0) of their own
(`Case.noises`): what depends on them is then an array over the items where it is a number or a constant matrix else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from stochfuse.estimators.progress import listener
from stochfuse.kalman.arrivals import Arrivals, nobody_else
from stochfuse.kalman.averaged_update import update_measurement_space, update_scalar
from stochfuse.kalman.kernel import (
    AsTheyAre,
    Information,
    SquareRootNumbers,
    at_step,
    factor,
    from_factor,
    join_factors,
    predict_factor,
    taken_in,
    update_factor,
    update_information,
)
from stochfuse.kalman.packed import (
    CANCELLATION,
    Step,
    carry,
    noise_factor,
    prior_map,
    smallest_pivot,
    solve_lower,
    sound,
    triangle,
    unpack,
    upper,
)
from stochfuse.scenario.model import Model, Sensor, varies
from stochfuse.scenario.system import Noises

BLOCK = 4096
"""Items that are carried through all steps together: what a core's cache holds for a few states."""

ELEMENTS = 4_000_000
"""Matrix elements over which unlike agents' outcomes are averaged at a time, to bound memory."""

PRECISE = 1e4
"""Information gained in one step, relative to the prior's, above which unlike agents' updates go through an SVD."""


COMMON = Noises()
"""No item has a noise of its own."""

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
    noises : each item's own noises, at all steps, in the place of those of the model, the sensor and P0.
    """

    model: Model
    sensor: Sensor
    P0: np.ndarray
    shared: bool
    arrivals: Sequence[Arrivals]
    items: int
    noises: Noises = COMMON

    def first_share(self) -> np.ndarray:
        """Share of P0 that the exchange at step 1 leaves, shape (items,): E[1/(m+1)], or 1 for one shared estimate."""
        return np.ones(self.items) if self.shared else self.arrivals[0].reciprocal()

    def take(self, items: np.ndarray | slice) -> Case:
        """Return the same for some of the items."""
        chosen: dict[int, Arrivals] = {}
        for a in self.arrivals:
            chosen.setdefault(id(a), a.take(items))
        return replace(
            self,
            arrivals=[chosen[id(a)] for a in self.arrivals],
            items=len(np.arange(self.items)[items]),
            noises=self.noises.take(items),
        )


class MeasurementSpace:
    """Upper triangles with the items in the last axis; see `stochfuse.kalman.averaged_update`."""

    def __init__(self, case: Case):
        self.case = case
        self._own = None if case.noises.Q is None and case.noises.R is None else _OwnNoises(case)

    def start(self) -> Carried:
        P0 = self.case.noises.P0
        P = upper(self.case.P0[None] if P0 is None else P0) * self.case.first_share()
        return Carried(P, np.ones(self.case.items) if self._own is None else self._own.left)

    def advance(self, carried: Carried, step: int) -> Carried:
        model, sensor = self.case.model, self.case.sensor
        at, C_inv = step if model.varies or sensor.varies else 2, None
        if self._own is None:
            matrix, constant, J = _prior_map(model, sensor, at)
            prior = matrix @ carried.value
            prior += constant
        else:
            prior, J, C_inv = self._own.prior(carried.value, at), self._own.information(at), self._own.C_inv
        d, arrivals = model.dimension, self.case.arrivals[step - 1]
        if d == 1:
            return Carried(update_scalar(prior, J, arrivals), carried.left)
        diagonal = triangle(d)[2].diagonal()
        peak = carried.peak
        if peak is None or step % 8 == 0:
            peak = prior[diagonal] if peak is None else np.maximum(peak, prior[diagonal])
        P, left = update_measurement_space(prior, d, sensor.H.shape[-2], arrivals, C_inv)
        left = np.minimum(carried.left, left)
        # digits are lost by degrees, too: to a variance far below its peak, or over many steps in a nearly singular P
        last = step == len(self.case.arrivals)
        if last or step % 8 == 0:
            left = np.minimum(left, ((P[diagonal] + _TINY) / (peak + _TINY)).min(axis=0))
        if step >= 8 and (last or step % 8 == 0):
            left = np.minimum(left, smallest_pivot(P, d))
        return Carried(P, left, peak)

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        d = self.case.model.dimension
        out = np.empty((d, d, carried.value.shape[1])) if out is None else out
        unpack(carried.value, d, out)
        return out

    def carry(self, P: np.ndarray) -> Carried:
        return Carried(upper(P), np.ones(len(P)) if self._own is None else self._own.left)


class _OwnNoises:
    """Noises of the items' own in `MeasurementSpace`: laid out once for all steps.

    H is common to all items, so that the matrices remain common too.  What depends on Q is added between them, what
    depends on R comes after them.
    """

    def __init__(self, case: Case):
        self._case = case
        self._Q = None if case.noises.Q is None else upper(case.noises.Q)
        self._C, self._J = None, None
        self.C_inv, self.left = None, np.ones(case.items)
        if case.noises.R is not None:
            self._C, self.left = noise_factor(case.noises.R)
            self.C_inv = solve_lower(self._C, np.eye(len(self._C))[..., None])

    def prior(self, P: np.ndarray, step: int) -> np.ndarray:
        """Rows of `prior_map`, (rows, items); those of A P⁻ and A P⁻Aᵀ with H for A where C is an item's own."""
        case = self._case
        moves, added, measures = _prior_parts(case.model, case.sensor, step, self._C is None)
        n = len(moves)
        rows = np.empty((n + len(measures), P.shape[1]))
        np.matmul(moves, P, out=rows[:n])
        rows[:n] += added if self._Q is None else self._Q
        np.matmul(measures, rows[:n], out=rows[n:])
        return rows

    def information(self, step: int) -> np.ndarray | float:
        """HᵀR⁻¹H of a scalar state; of others it is not needed."""
        model, sensor = self._case.model, self._case.sensor
        if self._C is None or model.dimension > 1:
            return _prior_map(model, sensor, step)[2]
        if self._J is None or varies(sensor.H):
            self._J = (solve_lower(self._C, at_step(sensor.H, step)[..., None]) ** 2).sum(axis=(0, 1))
        return self._J


@lru_cache(maxsize=1024)
def _prior_map(model: Model, sensor: Sensor, step: int) -> tuple[np.ndarray, np.ndarray, float]:
    """`prior_map` of a step (a scalar state needs its first row only), and the information HᵀR⁻¹H of a scalar state."""
    F, Q, H, R = (at_step(M, step) for M in (model.F, model.Q, sensor.H, sensor.R))
    whitened = np.linalg.solve(np.linalg.cholesky(R), H)
    matrix, constant = prior_map(F, Q, whitened)
    rows = 1 if model.dimension == 1 else len(matrix)
    return matrix[:rows], constant[:rows], float(np.vdot(whitened, whitened))


@lru_cache(maxsize=1024)
def _prior_parts(model: Model, sensor: Sensor, step: int, whiten: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`prior_map` in two: what moves P to P⁻ and adds Q, and what takes P⁻ to A P⁻ and A P⁻Aᵀ, A = C⁻¹H or H."""
    F, Q, A = (at_step(M, step) for M in (model.F, model.Q, sensor.H))
    if whiten:
        A = np.linalg.solve(np.linalg.cholesky(at_step(sensor.R, step)), A)
    d = model.dimension
    n = d * (d + 1) // 2
    matrix, constant = prior_map(F, Q, A)
    measures = prior_map(np.eye(d), np.zeros_like(Q), A)[0][n:]
    return matrix[:n], constant[:n], measures[:0] if d == 1 else measures


class SquareRoot:
    """Factors L of P = L Lᵀ, shape (items, d, d).

    Parameters
    ----------
    case : what the recursion needs.
    numbers : what its numbers go through.
    """

    def __init__(self, case: Case, numbers: SquareRootNumbers = AsTheyAre()):  # noqa: B008
        self.case, self.numbers = case, numbers

    def start(self) -> Carried:
        share, P0 = np.sqrt(self.case.first_share()), self.case.noises.P0
        return Carried(
            self.numbers.factor(self.case.P0 if P0 is None else P0) * share[:, None, None], np.ones(self.case.items)
        )

    def advance(self, carried: Carried, step: int) -> Carried:
        model, sensor, arrivals = self.case.model, self.case.sensor, self.case.arrivals[step - 1]
        Q, R, _ = self.case.noises
        Q = self.numbers.factor(at_step(model.Q, step) if Q is None else Q)
        R = self.numbers.noise(at_step(sensor.R, step) if R is None else R)
        prior = self.numbers.rounded(predict_factor(self.numbers.rounded(carried.value), at_step(model.F, step), Q))

        def shrink(s: np.ndarray) -> np.ndarray:
            # a ratio beyond floating point would leave nothing, whatever R is
            return arrivals.remaining(np.where(np.isfinite(s), s, np.nan).T).T

        return Carried(update_factor(prior, at_step(sensor.H, step), R, shrink), carried.left)

    def covariance(self, carried: Carried, out: np.ndarray | None = None) -> np.ndarray:
        return _from_factors(carried.value, out)

    def carry(self, P: np.ndarray) -> Carried:
        return Carried(factor(P), np.ones(len(P)))


@dataclass(frozen=True)
class UnlikeCase:
    """Unlike agents: every count of arrivals per kind of sensor, with its weight; thesis (45)/(46) merged by kind.

    Parameters
    ----------
    model, sensors : the model and the kinds of sensors.
    P0, shared : as in `Case`.
    counts : (outcomes, kinds) how many measurements of each kind are fused, the agent's own included; at step 1 first
        estimates.
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

    def take(self, items: np.ndarray) -> UnlikeCase:
        """Return the same for some of the items."""
        chosen: dict[int, np.ndarray] = {}
        for w in self.weights:
            chosen.setdefault(id(w), w[:, items])
        return replace(self, weights=[chosen[id(w)] for w in self.weights])

    def start(self) -> Carried:
        items = self.items
        fused = np.maximum(self.counts.sum(axis=1), 1)  # everybody has a first estimate
        share = np.ones(items) if self.shared else (self.weights[0] / fused[:, None]).sum(axis=0)
        return Carried(factor(self.P0) * np.sqrt(share)[:, None, None], np.ones(items))

    def advance(self, carried: Carried, step: int) -> Carried:
        F, Q = at_step(self.model.F, step), at_step(self.model.Q, step)
        prior = predict_factor(carried.value, F, factor(Q))
        sensors = [s.at(step) for s in self.sensors]
        nothing = Information(None, np.zeros_like(prior))
        gained = np.stack([update_information(nothing, s.H @ prior, s.R).Y for s in sensors])
        weights = self.weights[step - 1]
        if (self.counts[-1] @ np.trace(gained, axis1=-2, axis2=-1)).max() > PRECISE:  # everybody is heard
            return Carried(self._precise(prior, sensors, weights), carried.left)
        left, before = np.zeros_like(prior), np.eye(self.model.dimension)[..., None, None]
        gained, block = gained.transpose(2, 3, 1, 0), max(1, ELEMENTS // prior.size)
        for first in range(0, len(self.counts), block):
            some = np.s_[first : first + block]
            after = taken_in(before, gained @ self.counts[some].T.astype(float))[0]
            left += np.einsum("jkic,ci->ijk", after, weights[some])
        return Carried(prior @ factor(left), carried.left)

    def _precise(self, prior: np.ndarray, sensors: list[Sensor], weights: np.ndarray) -> np.ndarray:
        whitened = [np.linalg.solve(np.linalg.cholesky(s.R), s.H) for s in sensors]
        joined, block = [], 64
        for first in range(0, len(self.counts), block):
            some = np.s_[first : first + block]
            n = np.sqrt(self.counts[some], dtype=float)[:, None, :, None, None]
            H = np.concatenate([n[:, :, kind] * W for kind, W in enumerate(whitened)], axis=-2)
            roots = update_factor(prior, H, np.eye(H.shape[-2])) * np.sqrt(weights[some])[..., None, None]
            joined = [join_factors(*joined, *roots)]
        return joined[0]

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


def run(form: Form, steps: int, out: np.ndarray) -> Carried:
    """Carry a form through the steps, and return its last state.

    Parameters
    ----------
    out : (steps, d, d, items), filled with the averaged posterior covariances.
    """
    carried, progress = form.start(), listener()
    form.covariance(carried, out[0])
    for step in range(2, steps + 1):
        carried = form.advance(carried, step)
        form.covariance(carried, out[step - 1])
        progress.advance("step", step, steps)
    return carried


class Like(NamedTuple):
    """What was found of like agents.

    Parameters
    ----------
    covariance : (steps, d, d, items); not finite where it grows beyond floating point.
    cancelled : (items,) whether the square-root form was needed.
    unsound : (items,) where a covariance may be none; all others have been looked at.
    """

    covariance: np.ndarray
    cancelled: np.ndarray
    unsound: np.ndarray


def run_like(case: Case, steps: int) -> Like:
    """Run like agents in measurement space, and again in square-root form where that cancels.

    An agent that hears nobody averages over nothing: its filter is carried by itself.
    """
    d = case.model.dimension
    covariances = np.empty((steps, d, d, case.items))
    again, unsound, cancelled = np.arange(case.items), *np.zeros((2, case.items), dtype=bool)
    with np.errstate(all="ignore"):
        if steps > 1 and all(nobody_else(a) for a in case.arrivals[1:steps]):
            again = np.flatnonzero(~(_run_alone(case, covariances, unsound) > CANCELLATION) | unsound)
        for form in (MeasurementSpace, SquareRoot):
            left, whole = np.ones(len(again)), len(again) == case.items
            for first in range(0, len(again), BLOCK):
                block = np.s_[first : first + BLOCK]
                some = block if whole else again[block]
                part = case if whole and case.items <= BLOCK else case.take(some)
                redone = covariances[..., some] if whole else np.empty((steps, d, d, part.items))
                left[block] = run(form(part), steps, redone).left
                unsound[some] = ~sound(redone[-1][triangle(d)[:2]], d)
                if not whole:
                    covariances[..., some] = redone
            lost = ~(left > CANCELLATION) | ~np.isfinite(covariances[-1][..., again]).all(axis=(0, 1))
            again = again[lost]
            if form is MeasurementSpace:
                cancelled[again] = True
        for variances in np.diagonal(covariances, axis1=1, axis2=2).transpose(2, 0, 1):
            if not variances.min(initial=0.0) >= 0:
                unsound |= ~(variances >= 0).all(axis=0)
    return Like(covariances, cancelled, unsound)


def _run_alone(case: Case, out: np.ndarray, unsound: np.ndarray) -> np.ndarray:
    """Carry filters that hear nobody through all steps; return the share of variance that is left at least."""
    model, sensor, (Q, R, P0), steps = case.model, case.sensor, case.noises, len(out)
    P0 = case.P0 if P0 is None else P0

    def at(step: int) -> Step:
        F, H = at_step(model.F, step), at_step(sensor.H, step)
        return Step(F, at_step(model.Q, step) if Q is None else Q, H, at_step(sensor.R, step) if R is None else R)

    varying = model.varies or sensor.varies
    through = [at(step) for step in range(2, steps + 1)] if varying else [at(2)] * (steps - 1)
    share, progress = case.first_share(), listener()
    out[0] = np.moveaxis(P0, 0, -1) if P0.ndim == 3 else P0[..., None]
    if not (share == 1.0).all():
        out[0] *= share
    return carry(P0, through, out[1:], share, unsound, lambda k: progress.advance("step", k + 1, steps))
