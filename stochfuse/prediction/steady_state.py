"""Questions about the recursion as a whole: the steady state.

The steady state of the simplified formulation solves P = g_µ(P) with g_µ(P) = Σ β(m) update(F P Fᵀ + Q, R/(m+1)), a
modified algebraic Riccati equation.  g_µ is monotone and concave in P; where the stand-alone filter converges it has
one fixed point.  The recursion is run for a while and then finished by Newton's method, the derivative of g_µ taken
by central differences over a basis of the symmetric matrices (one batched call).

The answer carries its own proof.  By monotonicity, g(P₋) ≥ P₋ puts the fixed point above P₋ and g(P₊) ≤ P₊ below P₊, in
the positive-definite order; P₋ = (1−ε)P and P₊ = (1+ε)P are tried for ε = 1e-12, 1e-11, … and the first ε that brackets
is reported as the relative bound.  A bracket counts only if it holds by more than rounding can do: by `ROUNDING`, in
units of the states' standard deviations, with g evaluated in square-root form, whose error there is below 1e-14.

That there is none is proved by a direction that grows (`stochfuse.prediction.boundedness`): at no cost by a mode of F,
before anything is tried, and in full for what does not settle soon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stochfuse.engines.mean_field import CANCELLATION, Case, Form, MeasurementSpace, SquareRoot, UnlikeCase
from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.estimators.progress import listener
from stochfuse.kalman.packed import basis, triangle
from stochfuse.prediction import simplified
from stochfuse.prediction.boundedness import decide, growing, growing_mode, hidden_mode, recursions
from stochfuse.scenario.model import Model, Sensor
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.result import brief
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario
from stochfuse.scenario.system import Items

TOLERANCE = 1e-12
WARM_UP = 40
ROUNDING = 1e-13
STALLED = 1e-8
NEWTON = 30
PLAIN = 20_000
DOUBTFUL = 5 * WARM_UP
"""Steps after which a proof is tried that what has not settled never will."""
MOST_PROOFS = 8
"""Items for which it is tried."""


class SteadyState(NamedTuple):
    """Fixed points of the simplified formulation.

    Parameters
    ----------
    link : (links,) mean link probability.
    P : (links, groups, d, d) claimed posterior covariance that reproduces itself.
    group_of : index into the groups for every agent.
    residual : (links, groups) largest |g(P) − P|, in units of the states' own standard deviations.
    bound : (links, groups) ε such that the fixed point lies between (1−ε)P and (1+ε)P; infinite where not proved.
    """

    link: np.ndarray
    P: np.ndarray
    group_of: np.ndarray
    residual: np.ndarray
    bound: np.ndarray

    def __repr__(self) -> str:
        """One line."""
        return brief(self, self._fields)


@of_scenario
def steady_state(scenario: Scenario, link: Sequence[float] | LinkRows | None = None) -> SteadyState:
    """Solve P = g_µ(P) for every row of link probabilities.

    Parameters
    ----------
    scenario : must not vary with the step.
    link : link probabilities, one row each; default: those of the scenario.

    Returns
    -------
    SteadyState

    Raises
    ------
    UsageError
        If the model, a sensor or a link varies with the step.
    NoAnswerError
        If the stand-alone filter diverges: an unstable mode is not observed.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.steady_state("thesis-steady", [0.5])
    >>> found.P.ravel().round(4)
    array([26.1467])
    """
    rows = link if isinstance(link, LinkRows) else link_rows(scenario, link)
    sensors = scenario.sensors
    if scenario.model.varies or any(s.varies for s in sensors) or rows.varies:
        raise UsageError("a steady state needs a model, sensors and links that do not vary with the step")
    brief = replace(scenario, network=replace(scenario.network, steps=2))
    parts, groups = [], simplified.groups(brief.system, Items(rows))
    for group in groups:
        if isinstance(group.case, Case):
            _require_detectable(scenario.model, group.case.sensor.at(2), scenario.P0)
        else:
            _require_bounded(group.case)
        P = _solve(group.case)
        residual, bound = _certify(group.case, P)
        shape = (len(rows.link), group.columns)
        parts.append((P.reshape(*shape, *P.shape[1:]), residual.reshape(shape), bound.reshape(shape)))
    P, residual, bound = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
    group_of = simplified.index_of_groups(groups, scenario.network.agents)
    return SteadyState(rows.means(scenario.network), P, group_of, residual, bound)


def _require_detectable(model: Model, sensor: Sensor, P0: np.ndarray) -> None:
    sd = np.sqrt(np.diagonal(P0 + model.Q))
    sd = np.where(sd > 0, sd, 1.0)
    eigenvalue = hidden_mode(model.F * sd / sd[:, None], sensor.H * sd)
    if eigenvalue is not None:
        raise NoAnswerError(
            f"no steady state: the stand-alone filter does not converge, since the mode of F with eigenvalue "
            f"{eigenvalue:.6g} is not observed by H"
        )


def _require_bounded(case: UnlikeCase) -> None:
    """Raise NoAnswerError where a mode must grow: at a glance, for all items."""
    found = growing_mode(case)
    if found is not None:
        eigenvalue, growth = found
        raise NoAnswerError(
            f"no steady state: the mode of F with eigenvalue {eigenvalue:.6g} grows by a factor of at least "
            f"{growth:.6g} in every step, on average over what arrives: too often nothing that arrives shows it"
        )


def _require_settling(case: Case | UnlikeCase, unsettled: np.ndarray) -> None:
    """Raise NoAnswerError where some direction must grow: for a few of the items that have not settled yet."""
    for recursion in recursions(case.take(unsettled[:MOST_PROOFS])):
        proof = growing(recursion, decide(recursion)[1])
        if proof is not None:
            raise NoAnswerError(
                f"no steady state: a direction of rank {proof.rank} grows by a factor of at least {proof.factor:.6g} "
                "in every step, on average over what arrives: too often too little that arrives shows it"
            )


def _apply(case: Case | UnlikeCase, P: np.ndarray) -> np.ndarray:
    """g_µ(P) for P of shape (items, d, d), in the form that its conditioning asks for."""
    if isinstance(case, UnlikeCase):
        return _advance(case, P)
    with np.errstate(all="ignore"):
        form = MeasurementSpace(case)
        carried = form.advance(form.carry(P), 2)
    if (carried.left > CANCELLATION).all():
        return np.moveaxis(form.covariance(carried), -1, 0)
    return _advance(SquareRoot(case), P)


def _advance(form: Form, P: np.ndarray) -> np.ndarray:
    return np.moveaxis(form.covariance(form.advance(form.carry(P), 2)), -1, 0)


def _deviations(P: np.ndarray) -> np.ndarray:
    """sd_i sd_j of P, shape (items, d, d), and 1 where a state has no variance."""
    sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    sd = np.where(sd > 0, sd, 1.0)
    return sd[:, :, None] * sd[:, None, :]


def _residual(gP: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.abs((gP - P) / _deviations(gP)).max(axis=(-2, -1))


def _solve(case: Case | UnlikeCase) -> np.ndarray:
    items = case.items
    P = np.broadcast_to(case.P0 + np.eye(len(case.P0)) * np.trace(case.P0) * 1e-3, (items, *case.P0.shape))
    steps, before = 0, np.inf
    while steps < PLAIN:
        for _ in range(WARM_UP):
            P = _apply(case, P)
        steps += WARM_UP
        listener().advance("steady state", steps, PLAIN)
        if not np.isfinite(P).all() or np.abs(P).max() > 1e200:
            break
        P, residual = _newton(case, P)
        P = _vanishing(case, P)
        worst = float(residual.max())
        if steps == DOUBTFUL:
            _require_settling(case, np.flatnonzero(residual > TOLERANCE))
        if worst <= TOLERANCE or (worst <= STALLED and worst >= 0.5 * before):
            return P
        before = worst
    raise NoAnswerError(
        f"no steady state: the averaged covariance does not settle within {PLAIN} steps; the links that are needed to "
        "observe every mode are too unlikely"
    )


def _vanishing(case: Case | UnlikeCase, P: np.ndarray) -> np.ndarray:
    """P, and 0 where it shrinks towards it without end: where there is no process noise, 0 reproduces itself."""
    zero = np.zeros_like(P)
    start = np.diagonal(case.P0).max() + np.finfo(float).tiny
    gone = (_apply(case, zero) == 0).all(axis=(1, 2)) & (np.abs(P).max(axis=(1, 2)) < 1e-8 * start)
    return np.where(gone[:, None, None], zero, P)


def _newton(case: Case | UnlikeCase, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Newton steps as long as they help; returns the best iterate and its residual, per item."""
    gP = _apply(case, P)
    residual = _residual(gP, P)
    for _ in range(NEWTON):
        if (residual <= TOLERANCE / 10).all():
            break
        trial = _newton_step(case, P, gP)
        gT = _apply(case, trial)
        new = _residual(gT, trial)
        better = new < residual
        if not better.any():
            break
        P = np.where(better[:, None, None], trial, P)
        gP = np.where(better[:, None, None], gT, gP)
        residual = np.where(better, new, residual)
    return P, residual


def _newton_step(case: Case | UnlikeCase, P: np.ndarray, gP: np.ndarray) -> np.ndarray:
    items, d = P.shape[:2]
    rows, columns, place = triangle(d)
    unit = _deviations(P)
    h = 1e-5
    change = h * basis(d)[:, None] * unit
    moved = np.concatenate([P + change, P - change])
    values = _apply(case.take(np.tile(np.arange(items), len(moved))), moved.reshape(-1, d, d))
    plus, minus = values.reshape(2, len(rows), items, d, d)
    slope = ((plus - minus) / (2 * h * unit))[:, :, rows, columns].transpose(1, 2, 0)
    gap = ((gP - P) / unit)[:, rows, columns]
    try:
        step = np.linalg.solve(np.eye(len(rows)) - slope, gap[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return gP
    trial = P + step[:, place] * unit
    usable = np.isfinite(trial).all(axis=(1, 2))
    trial = np.where(usable[:, None, None], trial, gP)
    definite = np.linalg.eigvalsh(trial / _deviations(gP)).min(axis=-1) > -1e-12
    return np.where(definite[:, None, None], trial, gP)


def _certify(case: Case | UnlikeCase, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual, and the smallest ε for which (1−ε)P and (1+ε)P bracket the fixed point."""
    form = SquareRoot(case) if isinstance(case, Case) else case
    bound = np.where((P == 0).all(axis=(1, 2)) & (_advance(form, P) == 0).all(axis=(1, 2)), 0.0, np.inf)
    for ε in 10.0 ** np.arange(-12, -1):
        low, high = (1 - ε) * P, (1 + ε) * P
        unit = _deviations(P)
        rises = np.linalg.eigvalsh((_advance(form, low) - low) / unit).min(axis=-1) >= ROUNDING
        falls = np.linalg.eigvalsh((high - _advance(form, high)) / unit).min(axis=-1) >= ROUNDING
        bound = np.where(np.isinf(bound) & rises & falls, ε, bound)
        if np.isfinite(bound).all():
            break
    return _residual(_advance(form, P), P), bound
