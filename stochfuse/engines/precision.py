"""How far rounding can reach: the same computation again, every number moved by an ulp or some.

Simplified formulation.  The square-root form subtracts nothing, so that what it loses is what its own numbers, rounded
as they are, no longer tell: correlated noises whose difference a sensor resolves, say.  The form is run again with

* every factor, after each prediction and before it, moved by a relative ε in each entry;
* R moved by a relative ε in each entry, as its Cholesky factor is by rounding;
* the factors of P(k0) and Q moved as rounding of their decomposition moves them: by ε sd_i sd_p/L_pp in entry i of a
  column whose pivot is L_pp, but only where an entry is not zero, since zeros are exact,

with |ε| ≤ 2⁻⁵², and the largest change of the covariances is returned, in units of the states' standard deviations.
The same ε serve all items, so that an item's answer does not depend on its company.

Exact methods.  The general formulation works with sums of information, which lose what is weakly known beside what is
known precisely; the optimum works in square-root form.  Either is run again with moved numbers, and the largest change
counts, in the same units.

Four runs in the place of one are worth their time only where rounding may matter.  `suspects` tells by how much
rounding may grow: first by a bound that costs next to nothing and clears most scenarios, then by the covariances of an
agent that always hears nobody, and of one that always hears all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from stochfuse.engines.mean_field import BLOCK, Case, SquareRoot, run
from stochfuse.errors import StochfuseError
from stochfuse.estimators.ledger import InformationClaims, Ledger, Sources, evaluate
from stochfuse.kalman.algebra import inverse
from stochfuse.kalman.kernel import Estimate, Information, at_step, factor, predict, predict_information, update
from stochfuse.scenario.model import Sensor
from stochfuse.scenario.system import Noises, System

DRAWS = 3
"""Runs with moved numbers, of which the largest change counts."""

PROMISED = 1e-9
"""Largest relative error that is called none: where thrice the change is more, digits are lost."""

MOVE = 8
"""Ulps by which numbers are moved, unless it is said otherwise."""

_ULP = 2.0**-52


def ulps(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Relative errors of `MOVE` ulps, more or less, up or down: none so small that it is rounded away."""
    return rng.choice([-_ULP, _ULP], size=shape) * rng.uniform(0.5 * MOVE, 1.5 * MOVE, size=shape)


def within_an_ulp(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Relative errors of up to an ulp, up or down."""
    return _ULP * rng.uniform(-1.0, 1.0, size=shape)


class Moving:
    """What moves the numbers of a recursion in square-root form, see `stochfuse.kalman.kernel.SquareRootNumbers`.

    Parameters
    ----------
    seed : of the errors.
    errors : draws relative errors of a shape.
    """

    def __init__(self, seed: int, errors: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray] = ulps) -> None:
        self._rng, self._draw = np.random.default_rng(seed), errors

    def factor(self, P: np.ndarray) -> np.ndarray:
        """Square root of a covariance, moved as rounding of its decomposition moves it."""
        L = factor(P)
        sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))[..., None]
        # the row of a column's pivot has the largest variance that the columns before it left
        square = L * L
        row = (sd * sd - np.cumsum(square, axis=-1) + square).argmax(axis=-2)[..., None, :]
        pivot = np.abs(np.take_along_axis(L, row, axis=-2))
        before = np.take_along_axis(np.broadcast_to(sd, L.shape), row, axis=-2)
        grown = np.divide(before, pivot, out=np.zeros_like(pivot), where=pivot > 0)
        return L + np.where(L != 0, sd * grown, 0.0) * self._errors(L)

    def rounded(self, L: np.ndarray) -> np.ndarray:
        """Return a matrix with each entry moved."""
        return L * (1.0 + self._errors(L))

    def noise(self, R: np.ndarray) -> np.ndarray:
        """Return a covariance with each entry moved."""
        errors = np.triu(self._errors(R))
        moved = R * (1.0 + errors + np.triu(errors, 1).T)
        # one that is no longer definite has no digits to lose: without its correlations it will show
        alone = R * np.eye(R.shape[-1])
        return np.where(definite(moved)[..., None, None], moved, alone)

    def _errors(self, M: np.ndarray) -> np.ndarray:
        return self._draw(self._rng, M.shape[-2:])


def definite(R: np.ndarray) -> np.ndarray:
    """Whether matrices (..., p, p) can be factored by Cholesky's decomposition, shape (...)."""
    try:
        np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        if R.ndim == 2:
            return np.array(False)
        # halves, until those are found that cannot
        half = (len(R) + 1) // 2
        return np.concatenate([definite(R[:half]), definite(R[half:])]) if len(R) > 1 else definite(R[0])[None]
    return np.ones(R.shape[:-2], dtype=bool)


def rounding(case: Case, P: np.ndarray) -> np.ndarray:
    """Relative error that rounding may cause in some step's covariance of each item, shape (items,).

    Parameters
    ----------
    P : (steps, d, d, items) covariances as `stochfuse.engines.mean_field.run_like` gives them; NaN is returned where
        they are not finite.
    """
    reach = np.zeros(case.items)
    for first in range(0, case.items, BLOCK):
        block = np.s_[first : first + BLOCK]
        part, given = case.take(block), P[..., block]
        sd = np.sqrt(np.einsum("kiib->kib", given))
        unit = sd[:, :, None] * sd[:, None, :]
        unit = np.where(unit > 0, unit, 1.0)
        moved = np.empty_like(given)
        with np.errstate(all="ignore"):
            for seed in range(DRAWS):
                run(SquareRoot(part, Moving(seed, within_an_ulp)), len(P), moved)
                reach[block] = np.maximum(reach[block], (np.abs(moved - given) / unit).max(axis=(0, 1, 2)))
    return reach


def lost(reach: np.ndarray) -> np.ndarray:
    """Whether more than `PROMISED` may be lost, from what `rounding` returns."""
    return ~(3.0 * reach <= PROMISED)


MARGIN = 3.0
"""The largest of a few changes, in proportion to the moves, may be exceeded by so much."""
NO_DIGIT = 1.0
"""Relative rounding of which no more is said than that it leaves no digit."""
BENIGN = 1e5
"""Growth of rounding up to which nothing is lost that matters: 16 ulps of it are 4e-10."""


def told(reach: float) -> str:
    """Say how far rounding may reach."""
    return f"ill-conditioned: rounding may reach a relative {reach:.0e}, in units of the standard deviations"


def notes(reach: float) -> list[str]:
    """Say it where it is more than what is called none."""
    return [told(reach)] if not reach <= PROMISED else []


def change(P: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Largest change of each covariance (..., d, d) in units of its standard deviations, (...); at most `NO_DIGIT`."""
    with np.errstate(all="ignore"):
        sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        unit = sd[..., :, None] * sd[..., None, :]
        relative = (np.abs(moved - P) / np.where(unit > 0, unit, 1.0)).max(axis=(-2, -1))
    return np.where(relative <= NO_DIGIT, relative, NO_DIGIT)


def reach(again: Callable[[int], np.ndarray | float], runs: int = DRAWS) -> np.ndarray | float:
    """How far rounding may reach, from the change that each of a few runs with moved numbers makes.

    Parameters
    ----------
    again : change with the numbers moved by a given seed; what raises an error has left no digit.
    """
    found: np.ndarray | float = 0.0
    for seed in range(runs):
        try:
            found = np.maximum(found, again(seed))
        except (StochfuseError, np.linalg.LinAlgError):
            return NO_DIGIT
    return np.where(found < NO_DIGIT, MARGIN / MOVE * found, NO_DIGIT)


class MovedSources(Sources):
    """Sources whose numbers are moved: what is given, and every information that is computed from it.

    Parameters
    ----------
    given : the sources.
    seed : of the errors.  The items of a batch share them, so that an item's answer does not depend on its company.
    """

    def __init__(self, given: Sources, seed: int) -> None:
        super().__init__(given.model, given.sensors, given.starts, given.records, given.algebra)
        self._rng, self._items = np.random.default_rng(seed), given.starts[0].Y.ndim - 2
        moving = Moving(seed)
        F, Q = moving.rounded(self.model.F), self._symmetric(self.model.Q)
        self.model = replace(self.model, F=F, Q=Q)
        self.sensors = [replace(sensor, R=moving.noise(sensor.R)) for sensor in self.sensors]
        # one for all where there is one for all
        unique = {id(start): start for start in self.starts}
        moved = {key: self._moved(start) for key, start in unique.items()}
        self.starts = [moved[id(start)] for start in self.starts]

    def measured(self, step: int, source: int) -> Information:
        """Information of one measurement, moved."""
        return self._moved(super().measured(step, source))

    def forward(self, information: Information, step: int) -> Information:
        """Time update of moved information, moved."""
        information = self._moved(information)
        if not self._invertible(step):
            return self._moved(super().forward(information, step))
        F, Q, Bu = (at_step(M, step) for M in (self.model.F, self.model.Q, self.model.Bu))
        # one large entry makes F⁻ᵀYF⁻¹ of rank one however it is moved: what rounding does to that must show, too
        transported = self._moved(predict_information(information, F, 0.0 * Q))
        return self._moved(predict_information(transported, np.eye(F.shape[-1]), Q, Bu))

    def _moved(self, information: Information) -> Information:
        y, Y = information
        return Information(None if y is None else y * (1.0 + self._errors(y)), self._symmetric(Y))

    def _symmetric(self, M: np.ndarray) -> np.ndarray:
        errors = np.triu(self._errors(M))
        return M * (1.0 + errors + np.swapaxes(np.triu(errors, 1), -1, -2))

    def _errors(self, M: np.ndarray) -> np.ndarray:
        """Errors of each value's own, the same for all items."""
        stacked = M.shape[: max(M.ndim - 2 - self._items, 0)]
        shape = (*stacked, *(1,) * (M.ndim - 2 - len(stacked)), *M.shape[-2:])
        return ulps(self._rng, shape)


def moved_claims(
    system: System, ledger: Ledger, sources: Callable[[], Sources]
) -> Sequence[Callable[[], InformationClaims]]:
    """What a ledger's values claim with moved numbers, a few times; not at all where rounding does not matter."""
    if not suspects(system, Noises(P0=system.P0[None])).any():
        return ()
    given = sources()
    return [partial(_evaluated, ledger, given, seed) for seed in range(DRAWS)]


def _evaluated(ledger: Ledger, given: Sources, seed: int) -> InformationClaims:
    return InformationClaims(evaluate(ledger, MovedSources(given, seed)))


def suspects(system: System, noises: Noises) -> np.ndarray:
    """Whether rounding may matter, (items,).

    Parameters
    ----------
    noises : each item's own, P0 among them.
    """
    items = 1 if noises.P0 is None else len(noises.P0)
    if system.model.dimension == 1 and all(sensor.R.shape[-1] == 1 for sensor in system.sensors):
        # numbers are added and divided, which rounding does not harm
        return np.zeros(items, dtype=bool)
    with np.errstate(all="ignore"):
        found = np.broadcast_to(~(_growth(system, noises) <= BENIGN), (items,)).copy()
        rest = np.flatnonzero(found)
        if len(rest):
            found[rest] = ~(_growth_of_filters(system, noises.take(rest)) <= BENIGN)
    return found


def _growth(system: System, noises: Noises) -> np.ndarray:
    """By how much rounding may grow, (items,) or (1,): bounds D_ii of P_ii times bounds of Y_ii, and R_ii (R⁻¹)_ii.

    Nothing that was ever heard reduces the one, and no noise the other:

        √D_i(k) = Σ_j |F_ij| √D_j(k−1), plus Q_ii        √y_j(k) = Σ_i |(F⁻¹)_ij| √y_i(k−1), plus (n HᵀR⁻¹H)_jj

    An error ε √(Y_ii Y_jj) in every entry of Y = P⁻¹ makes one of at most ε d² max P_ii Y_ii in P, in units of its
    deviations.
    """
    model, network, kinds = system.model, system.network, system.sensor_of
    F = _used(model.F)
    Q, Q_varies = (model.Q, model.Q.ndim > 2) if noises.Q is None else (noises.Q, False)
    P0 = system.P0 if noises.P0 is None else noises.P0
    try:
        F_inv, Y0 = np.linalg.inv(F), np.linalg.inv(P0)
        measured = [_measured(sensor, noises, kinds.count(kind)) for kind, sensor in enumerate(system.sensors)]
    except np.linalg.LinAlgError:
        return np.array([np.inf])
    D, y, Q = np.abs(_diagonal(P0)), np.abs(_diagonal(Y0)) * network.agents, np.abs(_diagonal(Q))
    F, F_inv = np.swapaxes(np.abs(F), -1, -2), np.abs(F_inv)
    grown = np.maximum((D * y).max(axis=-1), np.max([scaled for _, _, scaled in measured], axis=0))
    for step in range(2, network.steps + 1):
        D = (np.sqrt(D) @ at_step(F, step)) ** 2 + (Q[step - 1] if Q_varies else Q)
        y = (np.sqrt(y) @ at_step(F_inv, step)) ** 2 + sum(J[step - 1] if varies else J for J, varies, _ in measured)
        grown = np.maximum(grown, (D * y).max(axis=-1))
    return np.atleast_1d(grown)


def _measured(sensor: Sensor, noises: Noises, agents: int) -> tuple[np.ndarray, bool, np.ndarray]:
    """Diagonal of n HᵀR⁻¹H, (…, d), whether a first axis is that of the steps, and largest R_ii (R⁻¹)_ii."""
    H, R = _used(sensor.H), _used(sensor.R) if noises.R is None else noises.R
    varies = H.ndim > 2 or (noises.R is None and R.ndim > 2)
    if H.ndim > 2 and noises.R is not None:
        H = H[:, None]
    R_inv = np.linalg.inv(R)
    scaled = np.abs(_diagonal(R) * _diagonal(R_inv)).max(axis=-1)
    return agents * np.abs((H * (R_inv @ H)).sum(axis=-2)), varies, scaled if noises.R is not None else scaled.max()


def _used(M: np.ndarray) -> np.ndarray:
    """Return a model's matrix with what is used in the place of the entry of step 1, which is not."""
    return M if M.ndim == 2 or len(M) == 1 else np.concatenate([M[1:2], M[1:]])


def _diagonal(M: np.ndarray) -> np.ndarray:
    return np.diagonal(M, axis1=-2, axis2=-1)


def ill_noise(system: System) -> bool:
    """Whether rounding may grow in some measurement noise R."""
    try:
        found = [_measured(sensor, Noises(), 1)[2] for sensor in system.sensors if sensor.R.shape[-1] > 1]
    except np.linalg.LinAlgError:
        return True
    return not max(found, default=0.0) <= BENIGN


def _growth_of_filters(system: System, noises: Noises) -> np.ndarray:
    """Growth of rounding, (items,) or (1,), for agents that hear nobody, or everyone, at all steps.

    P⁻_ii (M + n HᵀR⁻¹H)_ii with M = (F P Fᵀ)⁻¹, what information there is before the process noise comes to it.
    """
    given, kinds = system.with_noises(noises), system.sensor_of
    model, d = given.model, system.model.dimension
    heard = [Counter([kind]) for kind in sorted(set(kinds))] + [Counter(kinds)]
    counts = np.array([[n[kind] for n in heard] for kind in range(len(given.sensors))], dtype=float)[
        ..., None, None, None
    ]
    try:
        grown = np.max([_measured(sensor, noises, 1)[2] for sensor in system.sensors], axis=0)
        P = given.P0.reshape(-1, d, d) / (1.0 if system.shared else counts.sum(axis=0))
        P = np.broadcast_to(P, (len(heard), *P.shape[-3:]))
        grown = np.maximum(grown, (_diagonal(P) * _diagonal(inverse(P))).max(axis=(0, -1)))
        for step in range(2, system.steps + 1):
            F, Q = at_step(model.F, step), at_step(model.Q, step)
            moved = predict(Estimate(None, P), F, 0.0 * Q).P
            P, Y = moved + Q, inverse(moved)
            variance = _diagonal(P)
            for sensor, n in zip(given.sensors, counts, strict=True):
                H, R = at_step(sensor.H, step), at_step(sensor.R, step)
                Y = Y + n * (np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H))
                P = np.where(n > 0, update(Estimate(None, P), H, R / np.maximum(n, 1.0)).P, P)
            grown = np.maximum(grown, np.abs(variance * _diagonal(Y)).max(axis=(0, -1)))
    except np.linalg.LinAlgError:
        return np.array([np.inf])
    return grown
