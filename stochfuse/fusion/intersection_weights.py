"""Weights of (split) covariance intersection: convex minimisation over the simplex, with a certificate.

Newton's method runs on faces of the simplex: a weight that reaches zero is held there, and released when its slope
asks for it.  All problems of a stack move together, each with its own face.  The largest eigenvalue is smoothed
(`stochfuse.fusion.intersection_slopes`) with µ falling to 1e-11 of its value; at a double eigenvalue a small µ leaves a
bias of µ and amplifies rounding to 1e-16/µ, so the weights of least certificate among the last stages are kept.

Certificate.  Convexity gives φ(ω*) ≥ φ(ω) + min_i ∂φ/∂ω_i − Σ ω_i ∂φ/∂ω_i at any ω; what is missing to equality is the
residual of the optimality conditions and bounds the excess over the optimum.
"""

from __future__ import annotations

import numpy as np

from stochfuse.algebra import NUMPY
from stochfuse.errors import NoAnswerError
from stochfuse.fusion.intersection_slopes import (
    Criterion,
    Directions,
    Slopes,
    by_signal,
    information,
    measure,
    slopes_at,
    square,
)

FINE = 2e-6
"""µ of the largest eigenvalue, relative to its size at equal weights, from which on weights are worth keeping."""
SETTLED = 1e-13
"""Newton step, in units of the weights, that ends the search."""
NOISE = 4e-15
"""Slope, in units of the criterion, that is taken for rounding: along it the criterion is flat."""
SINGULAR = 2e-15
"""Least eigenvalue of Y, relative to Y at equal weights, of a C that is still bounded."""
UNKNOWN = 1e-11
"""The same at the best weights, for a block that would leave another state unknown."""
MOST_STEPS = 300
CHUNK = 4096


def best_weights(directions: Directions, criterion: Criterion) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N, m) of least criterion and their certificate (N,).

    Where the optimum is not unique, the weights are those that the search from equal weights meets first: equal
    signals get equal weights.

    Raises
    ------
    NoAnswerError
        If no weights make C bounded, or if the best ones for a block leave another state unknown.
    """
    count = len(directions.V)
    found = [_best(_cut(directions, slice(k, k + CHUNK)), criterion) for k in range(0, count, CHUNK)]
    if not found:
        return np.zeros(directions.alpha.shape[:2]), np.zeros(0)
    weights, residual = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return weights, residual


def certificate(directions: Directions, criterion: Criterion, weights: np.ndarray) -> np.ndarray:
    """Residual of the optimality conditions (N,) at given weights: a bound on the relative excess of the criterion."""
    scaled, E = _in_units_of_equal_weights(directions, criterion)
    stages = [mu for mu in _stages(criterion) if mu < FINE]
    return np.min([_residual(scaled, E, criterion, weights, mu) for mu in stages], axis=0)


def _stages(criterion: Criterion) -> list[float]:
    return np.logspace(-1, -11, 21).tolist() if criterion.name == "max-eig" else [0.0]


def _best(directions: Directions, criterion: Criterion) -> tuple[np.ndarray, np.ndarray]:
    scaled, E = _in_units_of_equal_weights(directions, criterion)
    N, m = directions.alpha.shape[:2]
    weights, free = np.full((N, m), 1.0 / m), np.ones((N, m), dtype=bool)
    best, residual = weights.copy(), np.full(N, np.inf)
    for mu in _stages(criterion):
        weights, free = _descend(scaled, E, criterion, weights, free, mu)
        if mu < FINE:
            reached = _residual(scaled, E, criterion, weights, mu)
            better = reached < residual
            best[better], residual[better] = weights[better], reached[better]
    if (np.linalg.eigvalsh(information(scaled, best))[:, 0] < UNKNOWN).any():
        raise NoAnswerError(
            "criterion: expected one whose best weights leave every state known, got one that is least where "
            "C is unbounded outside the block (take the whole state, or give the weights)"
        )
    return best, residual


def _cut(directions: Directions, rows: slice | np.ndarray) -> Directions:
    return Directions(directions.V[rows], directions.alpha[rows])


def _in_units_of_equal_weights(directions: Directions, criterion: Criterion) -> tuple[Directions, np.ndarray]:
    """Coordinates in which Y = I at equal weights, and E (N, d, b) that makes the criterion of order one."""
    N, m = directions.alpha.shape[:2]
    d = directions.V.shape[1]
    Y = information(directions, np.full((N, m), 1.0 / m))
    diagonal = np.diagonal(Y, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    Y = Y / (scale[:, :, None] * scale[:, None, :])
    if not np.isfinite(Y).all() or (np.linalg.eigvalsh(Y)[:, 0] < SINGULAR * d).any():
        raise NoAnswerError("signals: expected maps H that observe every state together, got an unbounded C")
    L = np.linalg.cholesky(Y)
    V = np.linalg.solve(L, directions.V / scale[:, :, None])
    block = np.arange(d) if criterion.block is None else np.asarray(criterion.block)
    E = np.linalg.solve(L, np.eye(d)[:, block] / scale[:, :, None])
    if criterion.name == "det":  # of any coordinates of the block: orthonormal ones
        return Directions(V, directions.alpha), np.linalg.qr(E)[0]
    size = measure(criterion, NUMPY.transpose(E) @ E, 0.0)[0]
    return Directions(V, directions.alpha), E / np.sqrt(size)[:, None, None]


def _value(directions: Directions, E: np.ndarray, criterion: Criterion, weights: np.ndarray, mu: float) -> np.ndarray:
    """Criterion, shape (N,); infinite where C is unbounded."""
    Y = information(directions, weights)
    bounded = np.linalg.eigvalsh(Y)[:, 0] > SINGULAR
    Y[~bounded] = np.eye(Y.shape[-1])
    S = NUMPY.symmetric(NUMPY.transpose(E) @ np.linalg.solve(Y, E))
    return np.where(bounded, measure(criterion, S, mu)[0], np.inf)


def _newton(slopes: Slopes, weights: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Newton step (N, m) on each problem's face, zero along flat directions, and its size (N,) in units of the weights.

    Each weight is measured in a unit of its own, its size or the range over which its slope would change the
    criterion by one, so that a nearly exact signal, whose weight matters at 1e-12, is no stiffer than others.
    """
    unit = np.where(free, np.maximum(weights, 1.0 / (1.0 + np.abs(slopes.gradient))), 0.0)
    normal = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    within = np.eye(unit.shape[-1]) - normal[:, :, None] * normal[:, None, :]
    level = (weights * slopes.gradient).sum(axis=-1, keepdims=True)
    slope = (within @ (unit * (slopes.gradient - level))[..., None])[..., 0]
    bend = within @ (unit[:, :, None] * slopes.hessian * unit[:, None, :]) @ within
    curvature, axes = np.linalg.eigh(NUMPY.symmetric(bend))
    along = (NUMPY.transpose(axes) @ slope[..., None])[..., 0]
    stiff = np.maximum(curvature, 1e-13 * np.maximum(curvature[:, -1:], 1e-3))
    step = np.where(np.abs(along) > NOISE * slopes.S.shape[-1], -along / stiff, 0.0)
    scaled = (axes @ step[..., None])[..., 0]
    return unit * scaled, np.abs(scaled).max(axis=-1)


def _descend(
    directions: Directions,
    E: np.ndarray,
    criterion: Criterion,
    weights: np.ndarray,
    free: np.ndarray,
    mu: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Move every problem to its optimum; returns weights and faces."""
    weights, free = weights.copy(), free.copy()
    small = np.zeros(len(weights), dtype=int)
    moving = np.arange(len(weights))
    for _ in range(MOST_STEPS):
        part, selected = _cut(directions, moving), E[moving]
        slopes = slopes_at(part, selected, criterion, weights[moving], mu)
        step, size = _newton(slopes, weights[moving], free[moving])
        small[moving] = np.where(size < 1e-8, small[moving] + 1, 0)
        settled = (size <= SETTLED) | (small[moving] > 3)
        new, blocked, moved = _search(part, selected, criterion, weights[moving], step, slopes, mu)
        settled |= ~moved
        weights[moving] = new
        free[moving[~settled]] &= ~blocked[~settled]
        released = _release(slopes, weights[moving], free[moving]) & settled[:, None]
        free[moving] |= released
        small[moving[released.any(axis=-1)]] = 0
        moving = moving[~settled | released.any(axis=-1)]
        if not len(moving):
            break
    return weights, free


def _release(slopes: Slopes, weights: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The held weight, if any, whose slope most asks for more, shape (N, m)."""
    level = (weights * slopes.gradient).sum(axis=-1, keepdims=True)
    wanted = np.where(free, 0.0, slopes.gradient - level)
    worst = wanted == wanted.min(axis=-1, keepdims=True)
    return worst & (wanted < -1e-13 * slopes.S.shape[-1])


def _search(
    directions: Directions,
    E: np.ndarray,
    criterion: Criterion,
    weights: np.ndarray,
    step: np.ndarray,
    slopes: Slopes,
    mu: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longest step of 1, ½, ¼, … that keeps to the simplex and lowers the criterion.

    Returns the new weights, which of them were stopped at zero, and which problems found a step.
    """
    downhill = step < 0
    reach = np.where(downhill, -weights / np.where(downhill, step, -1.0), np.inf)
    # a nearly exact signal is needed although its weight is too great: shrink it, for zero would lose it
    level = (weights * slopes.gradient).sum(axis=-1, keepdims=True)
    needed = (slopes.at_zero < np.minimum(level, 2.0 * slopes.gradient)) & (weights > 0)
    reach = np.where(needed, 0.98 * reach, reach)
    length = np.minimum(1.0, reach.min(axis=-1))
    blocking = (reach <= length[:, None]) & ~needed
    promised = (slopes.gradient * step).sum(axis=-1)
    new, blocked = weights.copy(), np.zeros(weights.shape, dtype=bool)
    pending = np.arange(len(weights))
    # promises below the rounding of the criterion: only the slopes can tell, and Newton's method has converged
    certain = (np.abs(promised) < 1e-12) & (mu == 0.0)
    for halving in range(60):
        trial = np.maximum(weights[pending] + length[pending, None] * step[pending], 0.0)
        if halving == 0:
            trial[blocking] = 0.0
        trial /= trial.sum(axis=-1, keepdims=True)
        value = _value(_cut(directions, pending), E[pending], criterion, trial, mu)
        allowed = slopes.value[pending] + 1e-4 * length[pending] * promised[pending] + 1e-14 * E.shape[-1]
        accepted = (value <= allowed) | (certain[pending] & np.isfinite(value))
        new[pending[accepted]] = trial[accepted]
        if halving == 0:
            blocked[accepted] = blocking[accepted]
        pending = pending[~accepted]
        if not len(pending):
            break
        length[pending] *= 0.5
    moved = np.ones(len(weights), dtype=bool)
    moved[pending] = False
    return new, blocked, moved


def _residual(
    directions: Directions, E: np.ndarray, criterion: Criterion, weights: np.ndarray, mu: float
) -> np.ndarray:
    """Excess over the optimum that the slopes allow: relative, or of log det."""
    slopes = slopes_at(directions, E, criterion, weights, mu)
    gradient, Z = slopes.gradient, slopes.Z
    missing = 0.0
    size = 1.0 if criterion.name == "det" else measure(criterion, slopes.S, 0.0)[0]
    if criterion.name == "max-eig":
        Z = _dual(slopes, _newton(slopes, weights, weights > 0)[0], mu)
        gradient = -by_signal(slopes.first * (slopes.u * (Z @ slopes.u)).sum(axis=1), weights.shape[-1])
        missing = size - (Z * slopes.S).sum(axis=(-2, -1))
    gap = (weights * gradient).sum(axis=-1) - gradient.min(axis=-1)
    return np.maximum(gap + missing, 0.0) / size


def _dual(slopes: Slopes, step: np.ndarray, mu: float) -> np.ndarray:
    """Z after a Newton step to first order, of trace one and positive semi-definite.

    At a multiple eigenvalue Z turns by 1e-16/µ under the rounding of ω, so the step must be taken without moving ω.
    """
    scaled = (slopes.first * np.repeat(step, slopes.first.shape[-1] // step.shape[-1], axis=-1))[:, None, :]
    Zu = slopes.Z @ slopes.u
    turned = -(Zu * scaled) @ NUMPY.transpose(Zu)
    trace = np.trace(turned, axis1=-2, axis2=-1)[:, None, None]
    Z = slopes.Z + (turned - trace * slopes.Z @ slopes.Z / square(slopes.Z)) / mu
    eigenvalues, U = np.linalg.eigh(NUMPY.symmetric(Z))
    eigenvalues = np.maximum(eigenvalues, 0.0)
    return (U * (eigenvalues / eigenvalues.sum(axis=-1, keepdims=True))[:, None, :]) @ NUMPY.transpose(U)
