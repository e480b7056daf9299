"""Split covariance intersection, and covariance intersection and the Kalman update as its limits.

Signal i has a mean a_i, an error covariance A_i = A_i1 + A_i2 (possibly correlated with the errors of other signals,
and known to be independent of them) and a map H_i from the fused state.  For weights ω_i ≥ 0 that sum to one,

    C⁻¹ = Σ_i H_iᵀ (A_i1/ω_i + A_i2)⁻¹ H_i           c = C Σ_i H_iᵀ (A_i1/ω_i + A_i2)⁻¹ a_i,

and C is no smaller than the actual covariance of c, whatever the correlations (Julier and Uhlmann's patent, claims
1–5).  With D_i = H_iᵀ(A_i1/ω_i + A_i2)⁻¹ the result of two signals is split again,

    C_2 = C (D_1 A_12 D_1ᵀ + D_2 A_22 D_2ᵀ) C        C_1 = C − C_2.

Each signal is diagonalised once, A_i1 = T diag(α) Tᵀ and A_i2 = T diag(1 − α) Tᵀ, so that a direction brings the
information ω/(α + ω(1 − α)) of its own.  Two plain estimates of the whole state are diagonalised against each other
instead, A = T diag(α) Tᵀ and B = T diag(1 − α) Tᵀ: that leaves a scalar equation in ω and takes a singular A or B.

Departures from the source.  The source drops a term with ω_i = 0.  Here it is the limit ω_i → 0, the same wherever
A_i1 is positive definite: a direction without any correlated error (α = 0) keeps its information at every weight.  A
signal with A_i1 = 0 is therefore weightless: its term is H_iᵀA_i2⁻¹H_i, and the best weights give it 0 where another
signal can use it.  The optimum may be such a limit.  The weighted Lp norm, not defined in the source, is that of the
variances, see `Criterion`.

Signals, criteria and weights from outside: what does not fit is said by name, signals numbered from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.intersection_weights import (
    Criterion,
    DiagonalPairs,
    Directions,
    best_weights,
    certificate,
    diagonalise,
    excess,
    information,
    pair_weights,
    share,
    weights_of,
)
from stochfuse.kalman.algebra import NUMPY, inverse
from stochfuse.kalman.checks import covariance_fault

__all__ = [
    "Criterion",
    "Fused",
    "Signal",
    "Stack",
    "covariance_intersection",
    "fuse_stack",
    "pair_weights",
    "split_covariance_intersection",
]

UNCORRELATED = 1e-13
"""Correlated share of a direction's variance that counts as none."""


class Signal(NamedTuple):
    """One input: mean a (p, 1) or None, possibly correlated A1 and independent A2 (p, p), map H (p, d) or None."""

    a: np.ndarray | None
    A1: np.ndarray
    A2: np.ndarray
    H: np.ndarray | None = None


class Fused(NamedTuple):
    """The fused signal.

    Attributes
    ----------
    c : mean (d, 1), or (d,) where the first signal's is flat; None where the signals have none.
    C : covariance (d, d), which bounds the actual one.
    C1, C2 : its possibly correlated and its independent part, for two signals; else None.
    weights : (n,).
    certificate : residual of the optimality conditions: a bound on how far the criterion lies above its least value,
        relative (of a determinant: in its logarithm).
    """

    c: np.ndarray | None
    C: np.ndarray
    C1: np.ndarray | None
    C2: np.ndarray | None
    weights: np.ndarray
    certificate: float


class Stack(NamedTuple):
    """N fusions of m signals: weights (N, m), C (N, d, d), gains (N, d, p_i), c = Σ gains[i] a_i, certificate (N,)."""

    weights: np.ndarray
    C: np.ndarray
    gains: tuple[np.ndarray, ...]
    certificate: np.ndarray


def split_covariance_intersection(
    signals: Sequence[Signal], criterion: Criterion | None = None, weights: Sequence[float] | None = None
) -> Fused:
    """Fuse n ≥ 2 signals whose correlated parts are correlated in an unknown way.

    Parameters
    ----------
    signals : means of shape (p, 1) or (p,), split covariances and maps; A1 + A2 positive definite, except that one of
        two plain estimates of the whole state may be singular under "det" or "trace".
    criterion : what the weights make small; the determinant of C by default.
    weights : (n,) given weights instead of the best ones.

    Raises
    ------
    UsageError
        If the signals, the criterion or the weights do not fit; the message names them, signals numbered from 1.
    NoAnswerError
        If the signals do not observe every state together, or the best weights for a block do not.
    """
    checked = _checked(signals)
    A1, A2 = [s.A1[None] for s in checked], [s.A2[None] for s in checked]
    criterion = checked_criterion(criterion or Criterion(), _states(checked[0]))
    given = None if weights is None else checked_weights(weights, len(checked))[None]
    stack, independent = _fuse(A1, A2, [s.H for s in checked], criterion, given)
    terms = [K[0] @ s.a for K, s in zip(stack.gains, checked, strict=True) if s.a is not None]
    c, C = (np.sum(terms, axis=0) if terms else None), stack.C[0]
    first = signals[0][0]
    if c is not None and first is not None and np.ndim(first) == 1:
        c = c[:, 0]  # as the means came
    split = (NUMPY.symmetric(C - independent[0]), independent[0]) if len(checked) == 2 else (None, None)
    return Fused(c, C, *split, stack.weights[0], float(stack.certificate[0]))


def covariance_intersection(
    estimates: Sequence[tuple[np.ndarray | None, np.ndarray]],
    criterion: Criterion | None = None,
    weights: Sequence[float] | None = None,
) -> Fused:
    """Fuse n ≥ 2 estimates (a, A) of the whole state: split_covariance_intersection without independent parts."""
    signals = [Signal(a, np.asarray(A, dtype=float), np.zeros(np.shape(A))) for a, A in estimates]
    return split_covariance_intersection(signals, criterion, weights)


def fuse_stack(
    A1: Sequence[np.ndarray],
    A2: Sequence[np.ndarray],
    H: Sequence[np.ndarray | None] | None = None,
    criterion: Criterion | None = None,
) -> Stack:
    """Fuse N problems of m ≥ 2 signals at a time.

    Parameters
    ----------
    A1, A2 : m arrays (N, p_i, p_i), the parts of each signal; symmetric (not checked).
    H : m maps (p_i, d) or (N, p_i, d), or None for the identity; None for identities throughout.
    criterion : as for split_covariance_intersection.

    Raises
    ------
    UsageError, NoAnswerError
        As split_covariance_intersection does, if any of the problems gives a reason.
    """
    given: list = [None] * len(A1) if H is None else list(H)
    maps: list[np.ndarray | None] = []
    if len(A1) < 2 or len(A2) != len(A1) or len(given) != len(A1):
        raise UsageError(
            f"signals: expected two or more A1, as many A2 and H, got {len(A1)}, {len(A2)} and {len(given)}"
        )
    first, second = ([np.asarray(part, dtype=float) for part in parts] for parts in (A1, A2))
    d = None
    for i, (one, two) in enumerate(zip(first, second, strict=True)):
        if one.ndim != 3 or one.shape[-1] != one.shape[-2] or one.shape != two.shape or len(one) != len(first[0]):
            wanted = f"stacks A1 and A2 of {len(first[0])} square matrices"
            raise UsageError(f"signals[{i + 1}]: expected {wanted}, got shapes {one.shape} and {two.shape}")
        M = mapping(f"signals[{i + 1}].H", given[i], one.shape[-1], d, axes=(2, 3))
        d = one.shape[-1] if M is None else M.shape[-1]
        maps.append(M)
    return _fuse(first, second, maps, checked_criterion(criterion or Criterion(), d or 0), None)[0]


def _fuse(
    A1: Sequence[np.ndarray],
    A2: Sequence[np.ndarray],
    H: Sequence[np.ndarray | None],
    criterion: Criterion,
    given: np.ndarray | None,
) -> tuple[Stack, np.ndarray]:
    """The stack and the independent part C_2 (N, d, d) of its C."""
    plain = all(M is None for M in H) and not any(part.any() for part in A2)
    if len(A1) == 2 and plain and criterion.block is None and criterion.name in ("det", "trace"):
        pairs = diagonalise(A1[0], A1[1])
        return _fuse_pairs(pairs, criterion.name, given), np.zeros_like(A1[0])
    directions, bases = _directions(A1, A2, H)
    weights, residual = (given, None) if given is not None else best_weights(directions, criterion)
    g = share(directions.alpha, weights)
    C = _bounded_inverse(information(directions, weights))
    if residual is None:
        residual = certificate(directions, criterion, weights)
    m, p = directions.alpha.shape[1:]
    CV = (C @ directions.V).reshape(*C.shape[:2], m, p)
    gains = tuple(
        (CV[:, :, i, : S.shape[-1]] * g[:, None, i, : S.shape[-1]]) @ NUMPY.transpose(S) for i, S in enumerate(bases)
    )
    independent = (CV * (g * np.sqrt(1.0 - directions.alpha))[:, None]).reshape(*C.shape[:2], m * p)
    return Stack(weights, C, gains, residual), independent @ NUMPY.transpose(independent)


def _fuse_pairs(pairs: DiagonalPairs, name: str, given: np.ndarray | None) -> Stack:
    w = weights_of(pairs, name) if given is None else given[:, 0]
    a, b = w[:, None] * pairs.beta, (1.0 - w[:, None]) * pairs.alpha
    bottom = a + b  # zero where one is exact and has no weight: it decides in the limit
    first = np.where(bottom > 0, a / np.where(bottom > 0, bottom, 1.0), pairs.alpha <= pairs.beta)
    variances = np.where(bottom > 0, pairs.alpha * pairs.beta / np.where(bottom > 0, bottom, 1.0), 0.0)
    T = pairs.T
    C = (T * variances[:, None, :]) @ NUMPY.transpose(T)
    back = np.linalg.inv(T)
    gains = ((T * first[:, None, :]) @ back, (T * (1.0 - first)[:, None, :]) @ back)
    return Stack(np.stack([w, 1.0 - w], axis=-1), C, gains, excess(pairs, name, w))


def _directions(
    A1: Sequence[np.ndarray], A2: Sequence[np.ndarray], H: Sequence[np.ndarray | None]
) -> tuple[Directions, list[np.ndarray]]:
    """Directions of information, and for each signal the S (N, p, p) with (A1/ω + A2)⁻¹ = S diag(g(ω)) Sᵀ."""
    N, p = len(A1[0]), max(A.shape[-1] for A in A1)
    d = A1[0].shape[-1] if H[0] is None else np.shape(H[0])[-1]
    V, alpha = np.zeros((N, d, len(A1), p)), np.zeros((N, len(A1), p))
    bases = []
    for i, (first, second, M) in enumerate(zip(A1, A2, H, strict=True)):
        own = first.shape[-1]
        S, alpha[:, i, :own] = _split(i, first, second)
        V[:, :, i, :own] = S if M is None else NUMPY.transpose(M) @ S
        bases.append(S)
    return Directions(V.reshape(N, d, len(A1) * p), alpha), bases


def _split(i: int, A1: np.ndarray, A2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S and α with SᵀA1 S = diag(α) and SᵀA2 S = diag(1 − α)."""
    total = A1 + A2
    diagonal = np.diagonal(total, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    try:
        L = np.linalg.cholesky(total * scale[:, :, None] * scale[:, None, :])
    except np.linalg.LinAlgError:
        raise UsageError(
            f"signals[{i + 1}]: expected a positive definite sum A1 + A2, got a singular or indefinite one"
        ) from None
    whiten = np.linalg.inv(L) * scale[:, None, :]
    alpha, U = np.linalg.eigh(NUMPY.symmetric(whiten @ A1 @ NUMPY.transpose(whiten)))
    if alpha.size and (alpha.min() < -1e-6 or alpha.max() > 1.0 + 1e-6):
        part = "A1" if alpha.min() < -1e-6 else "A2"
        raise UsageError(f"signals[{i + 1}].{part}: expected positive semi-definite matrices, got an indefinite one")
    return NUMPY.transpose(whiten) @ U, np.where(alpha < UNCORRELATED, 0.0, np.minimum(alpha, 1.0))


def _bounded_inverse(Y: np.ndarray) -> np.ndarray:
    try:
        C = NUMPY.symmetric(inverse(Y))
    except np.linalg.LinAlgError:
        C = np.full_like(Y, np.nan)
    if not np.isfinite(C).all() or (np.diagonal(C, axis1=-2, axis2=-1) <= 0).any():
        raise NoAnswerError("signals: expected weights and maps H that make every state known, got an unbounded C")
    return C


def _checked(signals: Sequence[Signal]) -> list[Signal]:
    if len(signals) < 2:
        raise UsageError(f"signals: expected two or more, got {len(signals)}")
    checked: list[Signal] = []
    for i, (a, A1, A2, H) in enumerate(signals):
        name = f"signals[{i + 1}]"
        first = covariance_part(f"{name}.A1", A1, None)
        p = len(first)
        second = covariance_part(f"{name}.A2", A2, p)
        H = mapping(f"{name}.H", H, p, _states(checked[0]) if checked else None)
        checked.append(Signal(mean(f"{name}.a", a, p, signals[0][0] is not None), first, second, H))
    return checked


def _states(signal: Signal) -> int:
    return signal.A1.shape[-1] if signal.H is None else signal.H.shape[-1]


CRITERIA = ("det", "trace", "lp", "max-eig")
ROUNDING = 1e-9
"""Asymmetry and negative eigenvalue at unit variances, and excess of the sum of given weights, that are rounding."""


def covariance_part(name: str, value: Any, p: int | None) -> np.ndarray:
    """Read a symmetric positive semi-definite (p, p) matrix."""
    A = np.asarray(value, dtype=float)
    kind = f"a symmetric positive semi-definite {'square' if p is None else f'{p}×{p}'} matrix"
    if A.ndim != 2 or not A.size or A.shape[0] != A.shape[1] or p not in (None, len(A)):
        raise UsageError(f"{name}: expected {kind}, got shape {A.shape}")
    fault = covariance_fault(A)
    if fault is not None:
        raise UsageError(f"{name}: expected {kind}, got {fault}")
    return NUMPY.symmetric(A)


def mean(name: str, value: Any, p: int, wanted: bool) -> np.ndarray | None:
    """Read a mean (p, 1) or (p,) as (p, 1), or None where no signal has one."""
    if (value is not None) != wanted:
        raise UsageError(
            f"{name}: expected a mean in every signal or in none, got {'none' if value is None else 'one'}"
        )
    if value is None:
        return None
    a = np.asarray(value, dtype=float)
    a = a[:, None] if a.ndim == 1 else a
    if a.shape != (p, 1) or not np.isfinite(a).all():
        raise UsageError(f"{name}: expected a finite column of shape ({p}, 1), got shape {a.shape}")
    return a


def mapping(name: str, value: Any, p: int, d: int | None, axes: tuple[int, ...] = (2,)) -> np.ndarray | None:
    """Read a map (p, d), in stacks also (N, p, d); d may be open.  None is the identity."""
    wanted = f"a {p}×{'any' if d is None else d} matrix"
    if value is None:
        if d not in (None, p):
            raise UsageError(f"{name}: expected {wanted}, got none (an identity of {p} states)")
        return None
    H = np.asarray(value, dtype=float)
    if H.ndim not in axes or H.shape[-2] != p or not H.size or d not in (None, H.shape[-1]):
        raise UsageError(f"{name}: expected {wanted}, got shape {H.shape}")
    if not np.isfinite(H).all():
        raise UsageError(f"{name}: expected {wanted} of finite numbers, got a value that is not finite")
    return H


def checked_criterion(criterion: Criterion, d: int) -> Criterion:
    """Return the criterion, if it fits d states."""
    name, block, p, weights = criterion
    if name not in CRITERIA:
        raise UsageError(f"criterion: expected one of {', '.join(CRITERIA)}, got {name!r}")
    if block is not None:
        indices = list(block)
        fits = all(isinstance(j, int | np.integer) and 0 <= j < d for j in indices)
        if not indices or not fits or len(set(indices)) != len(indices):
            raise UsageError(f"criterion.block: expected different states from 0 to {d - 1}, got {indices}")
    if not (np.isfinite(p) and p >= 1):
        raise UsageError(f"criterion.p: expected a finite exponent of at least 1, got {p}")
    states = d if block is None else len(block)
    if weights is not None:
        numbers = np.asarray(weights, dtype=float)
        if name != "lp":
            raise UsageError(
                f'criterion.weights: expected none for "{name}" (they belong to "lp"), got {list(weights)}'
            )
        if numbers.shape != (states,) or not np.isfinite(numbers).all() or (numbers <= 0).any():
            raise UsageError(f"criterion.weights: expected {states} positive numbers, got {list(weights)}")
    return criterion


def checked_weights(weights: Sequence[float], n: int) -> np.ndarray:
    """Read given weights (n,), which must lie in the simplex."""
    w = np.asarray(weights, dtype=float)
    expected = f"{n} numbers of at least 0 that sum to 1"
    if w.shape != (n,):
        raise UsageError(f"weights: expected {expected}, got {w.size} of them")
    if not np.isfinite(w).all() or (w < 0).any() or abs(w.sum() - 1.0) > ROUNDING:
        raise UsageError(f"weights: expected {expected}, got {w.tolist()}, sum {w.sum():g}")
    return w
