"""Weights of (split) covariance intersection: convex minimisation over the simplex, with a certificate.

Newton's method runs on faces of the simplex: a weight that reaches zero is held there, and released when its slope
asks for it.  All problems of a stack move together, each with its own face.  The largest eigenvalue is smoothed
(below) with µ falling to 1e-11 of its value; at a double eigenvalue a small µ leaves a bias of µ and amplifies
rounding to 1e-16/µ, so the weights of least certificate among the last stages are kept.

Certificate.  Convexity gives φ(ω*) ≥ φ(ω) + min_i ∂φ/∂ω_i − Σ ω_i ∂φ/∂ω_i at any ω; what is missing to equality is the
residual of the optimality conditions and bounds the excess over the optimum.

The criteria as functions of the weights, with their first and second derivatives.  Each signal is a sum of directions
v of information, so that

    Y(ω) = C⁻¹ = Σ_k g_k(ω) v_k v_kᵀ       g(ω) = ω/(α + ω(1 − α))       0 ≤ α ≤ 1,

α being the possibly correlated share of the direction's variance (α = 1 in plain covariance intersection).  g is
concave, C is operator convex, and with S = EᵀC E for the states asked for (E selects them) each criterion φ(S) is
convex in ω:

    det       log det S                            trace    Σ S_jj
    lp        (Σ (weight_j S_jj)^p)^(1/p)          max-eig  largest eigenvalue of S

With u_k = EᵀC v_k and Z = ∂φ/∂S the derivatives are sums over pairs of directions,

    ∂φ/∂ω_i = − Σ_k∈i g_k′ u_kᵀZ u_k
    ∂²φ/∂ω_i∂ω_j = 2 Σ_k∈i Σ_l∈j g_k′ g_l′ (v_kᵀC v_l)(u_kᵀZ u_l) − δ_ij Σ_k∈i g_k″ u_kᵀZ u_k + φ″[∂_iS, ∂_jS].

The largest eigenvalue is not smooth where it is multiple, and there the optimum likes to be.  It is replaced by
min_t {t − µ log det(tI − S)}, whose Z = µ(tI − S)⁻¹ has trace one.

Plain covariance intersection of pairs: one scalar equation each.

Two covariances are diagonalised against each other in the metric of their sum,

    A = T diag(α) Tᵀ      B = T diag(β) Tᵀ      β = 1 − α,

so that (ωA⁻¹ + (1 − ω)B⁻¹)⁻¹ = T diag(αβ/q) Tᵀ with q = ωβ + (1 − ω)α, whichever of A and B is singular.  With
δ = β − α and c = |columns of T|², the slopes to be zero are

    det      −Σ δ/q             trace    −Σ c αβ δ/q²,

both increasing in ω.  Their signs at the ends say whether ω is 0, 1 or between; there Newton's method, kept within a
bracket by bisection, moves the pairs that are not settled.

δ comes from T⁻¹(B − A)T⁻ᵀ, so that equal matrices are equal to the last bit.  Where A (or B) has a zero variance the
determinant, zero at every weight, is that of the other directions times the rate at which it vanishes: the limit of
slightly larger variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.kalman.algebra import NUMPY, inverse

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


class Criterion(NamedTuple):
    """What the weights make small.

    Attributes
    ----------
    name : "det", "trace", "lp" or "max-eig".
    block : indices of the states whose block of C is measured; None takes all.
    p : exponent of "lp", at least 1.
    weights : positive weights of "lp", one for each state of the block; None takes ones.

    The weighted Lp norm is that of the variances, (Σ_j (weight_j C_jj)^p)^(1/p): a weight carries the unit of its
    state (one over an acceptable variance), p = 1 is the weighted trace and p → ∞ the largest weighted variance.  A
    norm of the eigenvalues would mix states of different units.
    """

    name: str = "det"
    block: Sequence[int] | None = None
    p: float = 2.0
    weights: Sequence[float] | None = None


class Directions(NamedTuple):
    """Information of m signals of at most p directions in N problems.

    Attributes
    ----------
    V : (N, d, m·p), the directions v as columns, signal by signal; zero where a signal has fewer.
    alpha : (N, m, p), the possibly correlated share of each; zero where a signal has fewer.
    """

    V: np.ndarray
    alpha: np.ndarray


class Slopes(NamedTuple):
    """Value (N,), gradient (N, m), Hessian (N, m, m), what the certificate needs, and the gradient at ω_i = 0."""

    value: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    S: np.ndarray
    Z: np.ndarray
    u: np.ndarray
    first: np.ndarray
    at_zero: np.ndarray


def share(alpha: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """g(ω) of each direction, shape (N, m, p); 1 whatever ω where α = 0, which is the limit."""
    w = weights[..., None]
    return np.where(alpha > 0, w / np.where(alpha > 0, alpha + w * (1.0 - alpha), 1.0), 1.0)


def information(directions: Directions, weights: np.ndarray) -> np.ndarray:
    """Y(ω), shape (N, d, d)."""
    V = directions.V
    g = share(directions.alpha, weights).reshape(len(V), 1, V.shape[-1])
    return NUMPY.symmetric((V * g) @ NUMPY.transpose(V))


def measure(criterion: Criterion, S: np.ndarray, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """φ(S), shape (N,), and Z = ∂φ/∂S; with mu > 0 the smooth form of the largest eigenvalue."""
    if criterion.name == "det":
        return np.linalg.slogdet(S)[1], NUMPY.symmetric(inverse(S))
    if criterion.name == "max-eig":
        return _largest(S, mu)
    units, p = _units(criterion, S.shape[-1])
    v = units * np.diagonal(S, axis1=-2, axis2=-1)
    top = v.max(axis=-1, keepdims=True)
    value = top * ((v / top) ** p).sum(axis=-1, keepdims=True) ** (1.0 / p)
    return value[:, 0], (units * (v / value) ** (p - 1.0))[:, None, :] * np.eye(S.shape[-1])


def _units(criterion: Criterion, b: int) -> tuple[np.ndarray, float]:
    if criterion.name == "trace":
        return np.ones(b), 1.0
    return np.ones(b) if criterion.weights is None else np.asarray(criterion.weights, dtype=float), criterion.p


def _largest(S: np.ndarray, mu: float) -> tuple[np.ndarray, np.ndarray]:
    eigenvalues, U = np.linalg.eigh(S)
    if mu == 0.0:
        return eigenvalues[:, -1], U[:, :, -1:] @ NUMPY.transpose(U[:, :, -1:])
    gap = eigenvalues[:, -1:] - eigenvalues
    above = np.full((len(S), 1), mu)
    for _ in range(25):  # Newton on Σ µ/(above + gap) = 1 from the left: monotone
        part = mu / (above + gap)
        above += (part.sum(axis=-1, keepdims=True) - 1.0) / (part / (above + gap)).sum(axis=-1, keepdims=True)
    value = eigenvalues[:, -1] + above[:, 0] - mu * np.log(above + gap).sum(axis=-1)
    part = mu / (above + gap)
    part /= part.sum(axis=-1, keepdims=True)
    return value, (U * part[:, None, :]) @ NUMPY.transpose(U)


def slopes_at(directions: Directions, E: np.ndarray, criterion: Criterion, weights: np.ndarray, mu: float) -> Slopes:
    """Value, gradient and Hessian at the weights; E (N, d, b), and mu > 0 for the largest eigenvalue only."""
    V, alpha = directions
    N, m, p = alpha.shape
    C = NUMPY.symmetric(inverse(information(directions, weights)))
    bottom = np.where(alpha > 0, alpha + weights[..., None] * (1.0 - alpha), 1.0)
    first = (alpha / bottom**2).reshape(N, -1)
    second = -2.0 * alpha * (1.0 - alpha) / bottom**3
    CV = C @ V
    u = NUMPY.transpose(E) @ CV
    S = NUMPY.symmetric(NUMPY.transpose(E) @ C @ E)
    value, Z = measure(criterion, S, mu)
    gram = NUMPY.transpose(u) @ Z @ u
    own = np.diagonal(gram, axis1=-2, axis2=-1)

    def blocks(pairs: np.ndarray) -> np.ndarray:
        weighted = first[:, :, None] * pairs * first[:, None, :]
        return weighted.reshape(N, m, p, m, p).sum(axis=(2, 4))

    hessian = blocks(2.0 * gram * (NUMPY.transpose(V) @ CV))
    hessian[:, range(m), range(m)] -= (second * own.reshape(N, m, p)).sum(axis=-1)
    if criterion.name == "det":
        hessian -= blocks(gram * gram)
    elif criterion.name == "max-eig":
        across = by_signal(first * ((Z @ u) ** 2).sum(axis=1), m)
        hessian += (blocks(gram * gram) - across[:, :, None] * across[:, None, :] / square(Z)) / mu
    else:
        hessian += _norm_curvature(criterion, S, value, u, first, m)
    at_zero = np.where(alpha > 0, own.reshape(N, m, p) / np.where(alpha > 0, alpha, 1.0), 0.0)
    return Slopes(value, -by_signal(first * own, m), NUMPY.symmetric(hessian), S, Z, u, first, -at_zero.sum(axis=-1))


def _norm_curvature(
    criterion: Criterion, S: np.ndarray, value: np.ndarray, u: np.ndarray, first: np.ndarray, m: int
) -> np.ndarray:
    """φ″ of the weighted Lp norm along the signals, shape (N, m, m)."""
    units, p = _units(criterion, S.shape[-1])
    v = units * np.diagonal(S, axis1=-2, axis2=-1) / value[:, None]
    moved = by_signal(units[:, None] * first[:, None, :] * u * u, m)
    tilt = (moved * (v ** (p - 1.0))[:, :, None]).sum(axis=1)
    bend = np.einsum("nbi,nb,nbj->nij", moved, v ** (p - 2.0), moved)
    return (p - 1.0) / value[:, None, None] * (bend - tilt[:, :, None] * tilt[:, None, :])


def by_signal(values: np.ndarray, m: int) -> np.ndarray:
    """Sum over the directions of each signal: (..., m·p) to (..., m)."""
    return values.reshape(*values.shape[:-1], m, -1).sum(axis=-1)


def square(Z: np.ndarray) -> np.ndarray:
    """Sum of squares of the entries, shape (N, 1, 1)."""
    return (Z * Z).sum(axis=(-2, -1), keepdims=True)


MOST_PAIR_STEPS = 200
EQUAL = 2e-15
"""Largest |δ| per dimension of two covariances that are equal to rounding, and 1 − |δ| of which one has no error."""


class DiagonalPairs(NamedTuple):
    """N pairs: T (N, d, d), empty where it was not asked for, and α, β, δ = β − α (N, d)."""

    T: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray


def pair_weights(A: np.ndarray, B: np.ndarray, criterion: str = "det") -> np.ndarray:
    """Weights (N,) of A in the covariance intersection of the pairs A, B (N, d, d); B has the rest.

    Parameters
    ----------
    A, B : positive semi-definite with a positive definite sum; symmetric (not checked).
    criterion : "det" or "trace" of the fused covariance.

    Returns
    -------
    ndarray
        ½ where A and B are equal, 1 where A ≤ B, 0 where B ≤ A.

    Raises
    ------
    UsageError
        If the shapes do not fit, a matrix is indefinite or a sum is singular.
    """
    if criterion not in ("det", "trace"):
        raise UsageError(f'criterion: expected "det" or "trace", got {criterion!r}')
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    if A.ndim != 3 or A.shape[-1] != A.shape[-2] or A.shape != B.shape or not A.shape[-1]:
        raise UsageError(
            f"pairs: expected stacks A and B of N square matrices each, got shapes {A.shape} and {B.shape}"
        )
    return weights_of(diagonalise(A, B, basis=criterion == "trace"), criterion)


def diagonalise(A: np.ndarray, B: np.ndarray, *, basis: bool = True) -> DiagonalPairs:
    """Bring each pair to diagonal form, T only if the basis is wanted.

    Raises
    ------
    UsageError
        If a matrix is indefinite or a sum singular.
    """
    total = A + B
    diagonal = np.diagonal(total, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    rows, columns = scale[:, :, None], scale[:, None, :]
    try:
        L = np.linalg.cholesky(total / rows / columns)
    except np.linalg.LinAlgError:
        raise UsageError("pairs: expected positive definite sums A + B, got a singular or indefinite one") from None
    whiten = np.linalg.inv(L) / columns
    difference = NUMPY.symmetric(whiten @ (B - A) @ NUMPY.transpose(whiten))
    if basis:
        delta, U = np.linalg.eigh(difference)
        T = rows * (L @ U)
    else:
        delta, T = np.linalg.eigvalsh(difference), np.empty((len(A), 0, 0))
    if delta.size and np.abs(delta).max() > 1.0 + 1e-6:
        raise UsageError("pairs: expected positive semi-definite matrices, got an indefinite one")
    # what rounding leaves of a direction without error is none: it would call for a weight of its square root
    certain = 1.0 - np.abs(delta) <= EQUAL * delta.shape[-1]
    delta = np.where(certain, np.sign(delta), np.clip(delta, -1.0, 1.0))
    return DiagonalPairs(T, 0.5 * (1.0 - delta), 0.5 * (1.0 + delta), delta)


def weights_of(pairs: DiagonalPairs, name: str) -> np.ndarray:
    """Weights (N,) of A of least determinant ("det") or trace."""
    shares = _shares(pairs, name)
    q0, q1, delta = (np.ascontiguousarray(part.T) for part in (pairs.alpha, pairs.beta, pairs.delta))
    power = 1 if name == "det" else 2
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (-np.where(shares > 0, shares * delta / q**power, 0.0).sum(axis=0) for q in (q0, q1))
    weights = np.where(first >= 0, 0.0, 1.0)
    equal = (np.abs(delta).max(axis=0) <= EQUAL * len(delta)) | ((first == 0) & (last == 0))
    weights[equal] = 0.5
    inside = np.flatnonzero((first < 0) & (last > 0) & ~equal)
    weights[inside] = _root(shares[:, inside], q0[:, inside], delta[:, inside], power)
    return weights


def excess(pairs: DiagonalPairs, name: str, weights: np.ndarray) -> np.ndarray:
    """Bound (N,) on the excess of the criterion, relative (of log det): slope times way to the better end."""
    shares = _shares(pairs, name)
    q = weights * pairs.beta.T + (1.0 - weights) * pairs.alpha.T
    known = (q > 0) & (shares > 0)
    q = np.where(known, q, 1.0)
    slope = -np.where(known, shares * pairs.delta.T / q ** (1 if name == "det" else 2), 0.0).sum(axis=0)
    size = 1.0 if name == "det" else np.where(known, shares / q, 0.0).sum(axis=0)
    gap = np.maximum(slope * weights, -slope * (1.0 - weights))
    return np.divide(gap, size, out=np.zeros_like(gap), where=np.asarray(size) > 0)


def _shares(pairs: DiagonalPairs, name: str) -> np.ndarray:
    """What multiplies δ/q (det) or δ/q² (trace), shape (d, N)."""
    if name == "det":
        return np.ones(pairs.delta.shape[::-1])
    return np.ascontiguousarray(((pairs.T * pairs.T).sum(axis=1) * pairs.alpha * pairs.beta).T)


def _root(shares: np.ndarray, alpha: np.ndarray, delta: np.ndarray, power: int) -> np.ndarray:
    """Zero in (0, 1) of the increasing slope −Σ shares δ/(α + ωδ)^power, arrays (d, n)."""
    n = delta.shape[1]
    found, w, low, high = np.full(n, 0.5), np.full(n, 0.5), np.zeros(n), np.ones(n)
    moving = np.arange(n)
    for _ in range(MOST_PAIR_STEPS):
        at = alpha + w * delta
        ratio = delta / at
        terms = shares * ratio if power == 1 else shares * ratio / at
        slope, bend = -terms.sum(axis=0), power * (terms * ratio).sum(axis=0)
        low, high = np.where(slope < 0, w, low), np.where(slope < 0, high, w)
        new = w - slope / bend
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        step = np.abs(new - w)
        found[moving] = w = new
        # Newton errs by (step / distance to a pole)², and no pole is nearer than the ends
        on = (step > 3e-8 * np.minimum(w, 1.0 - w)) & (high - low > 4e-16 * w)
        if not on.any():
            break
        if on.sum() < 0.75 * len(on):
            moving, w, low, high = moving[on], w[on], low[on], high[on]
            shares, alpha, delta = shares[:, on], alpha[:, on], delta[:, on]
    return found
