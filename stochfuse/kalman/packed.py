"""Many Kalman filters side by side: covariances as packed rows, a block of filters in the last axis.

A symmetric matrix is kept as the rows of its upper triangle, one array (entries, filters) for a block of filters that a
core's cache holds.  A step of all filters is then a few long operations:

    P⁻ = F P Fᵀ + Q,  P⁻Hᵀ and S = H P⁻Hᵀ + R     one product of a small constant matrix with all rows (`prior_map`),
                                                   or two where that has more to multiply or F is a filter's own
    S = L diag(δ) Lᵀ,  W = P⁻Hᵀ L⁻ᵀ                 no square root, no inverse
    P = P⁻ − W diag(1/δ) Wᵀ

which is (24) and (26) for the optimal gain.  That subtraction loses about log10(1/left) digits where it leaves the
share `left` of a variance.  What is left at least is read off the rows as they pass, and off the first and the last of
them, so that no step pays for a check; filters that may have lost too much are done again in square-root form
(`stochfuse.kalman.kernel.update_factor`).

Where there is a compiler and enough to do, the same lines run compiled (`stochfuse.kalman.compiled`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.compiled import LANES, Loop, address, padded, pays
from stochfuse.kalman.kernel import Estimate, factor, from_factor, predict, predict_factor, update_factor

CANCELLATION = 1e-5
"""Share of prior variance left by an update, below which the square-root form takes over: 1e-16/1e-5 of an entry."""
CACHE = 170_000
"""Numbers that a block may hold: what a core keeps near.  Fewer, larger calls beat smaller blocks."""
FEWEST = 512
"""Filters in a block at least: a call costs as much as some hundred of them."""
ONE_PRODUCT = 6
"""States up to which one product for all rows is less work than two for each side."""
INDEFINITE = -1e-9
"""Most negative eigenvalue, scaled to unit diagonal, that is taken for rounding of a singular matrix."""
EVERY = 8
"""Steps between two looks at what is left."""
_TINY = 1e-300


@lru_cache(maxsize=64)
def triangle(d: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the upper triangle (rows, columns), and the (d, d) map from an entry to its place there."""
    rows, columns = np.triu_indices(d)
    place = np.zeros((d, d), dtype=int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return rows, columns, place


@lru_cache(maxsize=64)
def basis(d: int) -> np.ndarray:
    """A basis of the symmetric d×d matrices, in the order of their upper triangle."""
    rows, columns, _ = triangle(d)
    basis = np.zeros((len(rows), d, d))
    basis[np.arange(len(rows)), rows, columns] = basis[np.arange(len(rows)), columns, rows] = 1.0
    basis.setflags(write=False)
    return basis


def upper(P: np.ndarray) -> np.ndarray:
    """Upper triangles (d(d+1)/2, items) of P (items, d, d)."""
    d = P.shape[-1]
    rows, columns, _ = triangle(d)
    return P.reshape(-1, d * d).T[rows * d + columns] if d > 1 else P.reshape(1, -1)


def prior_map(F: np.ndarray, Q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and constant that take the rows of P to those of P⁻ = F P Fᵀ + Q, A P⁻ and A P⁻Aᵀ, one below another.

    A is H, or C⁻¹H.  The matrix is read off the kernel's own `predict`, applied to a basis of the symmetric matrices;
    the constant is what Q adds.
    """
    moved = predict(Estimate(None, basis(F.shape[-1])), F, np.zeros_like(Q)).P
    rows = _stack(np.concatenate([moved, Q[None]]), A)
    return np.ascontiguousarray(rows[:-1].T), rows[-1:].T


def _stack(P: np.ndarray, A: np.ndarray) -> np.ndarray:
    rows, columns, _ = triangle(P.shape[-1])
    p_rows, p_columns, _ = triangle(len(A))
    AP = A @ P
    return np.concatenate([P[:, rows, columns], AP.reshape(len(P), -1), (AP @ A.T)[:, p_rows, p_columns]], axis=1)


class Step(NamedTuple):
    """What a step of all filters goes by; each matrix is common, (rows, columns), or has the filters in front.

    Parameters
    ----------
    F, Q : (d, d) transition and process noise.
    H, R : (p, d) and (p, p) measurement matrix and noise.
    """

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray

    def take(self, items: slice) -> Step:
        """Return the same for some of the filters."""
        return Step(*(M if M.ndim == 2 else M[items] for M in self))


def covariances(P: np.ndarray, F: np.ndarray, Q: np.ndarray, H: np.ndarray, R: np.ndarray, steps: int) -> np.ndarray:
    """Posterior covariances of many filters after some steps of predict and update, (24) and (26).

    Parameters
    ----------
    P : (items, d, d) covariances to begin with.
    F, Q, H, R : transition (d, d), process noise (d, d), measurement matrix (p, d) and noise (p, p) at every step: of
        all filters, or one for each, (items, ., .).
    steps : number of steps, at least 1.

    Returns
    -------
    ndarray
        (items, d, d).

    Raises
    ------
    UsageError
        If shapes do not fit.

    Examples
    --------
    >>> import stochfuse as sf
    >>> P = np.full((3, 1, 1), 100.0)
    >>> sf.kalman.covariances(P, [[1.0]], [[25.0]], [[1.0]], np.array([50.0, 100.0, 200.0])[:, None, None], 4)[:, 0, 0]
    array([25.94594595, 41.17647059, 60.98360656])
    """
    P, *given = (np.asarray(M, dtype=float) for M in (P, F, Q, H, R))
    step = Step(*given)
    d, p = P.shape[-1], step.R.shape[-1]
    shapes = ((d, d), (d, d), (d, d), (p, d), (p, p))
    for name, M, shape in zip(("P", *Step._fields), (P, *step), shapes, strict=True):
        if (M.shape != shape and M.shape != (len(P), *shape)) or P.ndim != 3:
            raise UsageError(f"{name}: expected shape {shape} or (items, …) as P has, (items, d, d), got {M.shape}")
    if steps < 1:
        raise UsageError(f"steps: expected at least 1, got {steps}")
    out = np.empty((1, d, d, len(P)))
    with np.errstate(all="ignore"):
        left = carry(P, [step] * steps, out)
        if not left.min(initial=1.0) > CANCELLATION:
            suspects = np.flatnonzero(~(left > CANCELLATION))
            some = Step(*(M if M.ndim == 2 else M[suspects] for M in step))
            L, noise = factor(P[suspects]), factor(some.Q)
            for _ in range(steps):
                L = update_factor(predict_factor(L, some.F, noise), some.H, some.R)
            out[0, ..., suspects] = from_factor(L)
    return out[0].transpose(2, 0, 1)


def carry(
    P: np.ndarray,
    through: Sequence[Step],
    out: np.ndarray,
    share: np.ndarray | None = None,
    unsound: np.ndarray | None = None,
    after: Callable[[int], object] = lambda step: None,
) -> np.ndarray:
    """Carry covariances of filters through steps of predict and update.

    Parameters
    ----------
    P : (items, d, d) covariances to begin with, or one of all.
    through : a step after another, the same object again where nothing changes.
    out : (1, d, d, items) for the last posterior, or (steps, d, d, items) for all of them: filled.
    share : (items,) factors of P.
    unsound : (items,) set where the last covariance is not finite, or no covariance.
    after : hears how many steps of a block have been done.

    Returns
    -------
    ndarray
        (items,) smallest share of variance that is left of what was there before; at most what it is.
    """
    d, p, items = out.shape[1], through[0].H.shape[-2], out.shape[-1]
    pay = d > 1 and items > 0 and pays(items * len(through), d * d * (3 * d + 1) // 2 + 2 * p * d * (d + p))
    own = any(step.F.ndim == 3 or step.H.ndim == 3 for step in {id(step): step for step in through}.values())
    loop = compiled_step(d, p, own) if pay else None
    if loop is not None:
        return _carry_compiled(loop, P, through, out, share, unsound, after)
    heights = _heights(d, p, own)
    blocks = -(-items // max(FEWEST, CACHE // sum(heights)))
    size = max(1, -(-items // (8 * max(blocks, 1))) * 8)
    left, memory = np.empty(items), _aligned(sum(heights) * min(size, items))
    for first in range(0, items, size):
        block = np.s_[first : min(first + size, items)]
        width = block.stop - first
        whole, arrays, end = memory[: sum(heights) * width].reshape(-1, width), [], 0
        for height in heights:
            arrays.append(whole[end : end + height])
            end += height
        rows = arrays[0]
        rows[:] = upper(P[block] if P.ndim == 3 else P)
        if isinstance(share, np.ndarray):
            rows *= share[block]
        held = _Scalars(rows, arrays[1]) if d == 1 else _FilterBlock(d, p, *arrays)
        for k, step in enumerate(through):
            if not k or step is not through[k - 1]:
                held.prepare(step.take(block))
            held.advance(k, k + 1 == len(through))
            if k + 1 >= len(through) or len(out) > 1:
                held.write(out[k if len(out) > 1 else 0, ..., block])
            after(k + 1)
        left[block] = held.left
        if unsound is not None:
            unsound[block] = ~sound(rows, d)
    return left


def _carry_compiled(
    loop: Loop,
    P: np.ndarray,
    through: Sequence[Step],
    out: np.ndarray,
    share: np.ndarray | None,
    unsound: np.ndarray | None,
    after: Callable[[int], object],
) -> np.ndarray:
    """Do the same as `carry` in a compiled loop, at most `EVERY` steps at a time."""
    d, p, items, each = out.shape[1], through[0].H.shape[-2], out.shape[-1], len(out) > 1
    P = np.broadcast_to(P, (items, d, d)) if P.ndim == 2 else P
    if share is not None and not (share == 1.0).all():
        P = P * share[:, None, None]
    cuts = [k for k in range(1, len(through)) if k % EVERY == 0 or through[k] is not through[k - 1]]
    size = padded(min(items, max(LANES, CACHE // (d * d * (EVERY if each else 1) + d + p))))
    left, watched, memory = np.ones(items), np.empty((p + d, size)), np.empty((EVERY if each else 0, d, d, size))
    for first in range(0, items, size):
        block = np.s_[first : min(first + size, items)]
        width, now, made = block.stop - first, P[block], out[..., block]
        watched[:] = _TINY
        watch = _Watch(d, p, watched[:p, :width], watched[p:, :width])
        for k, end in pairwise([0, *cuts, len(through)]):
            step = through[k].take(block)
            if not k or through[k] is not through[k - 1]:
                watch.begin(step.R)
            made = memory[: end - k, ..., :width] if each else made
            loop(now, watched, step, end - k, made)
            if each:
                out[k:end, ..., block] = made
            now = made[-1].transpose(2, 0, 1)
            if end % EVERY == 0 or end == len(through):
                watch.look(made[-1][triangle(d)[:2]], end)
            after(end)
        watch.close()
        left[block] = watch.left
        if unsound is not None:
            unsound[block] = ~sound(made[-1][triangle(d)[:2]], d)
    return left


@lru_cache(maxsize=64)
def compiled_step(d: int, p: int, own: bool) -> Loop | None:
    """The step of `_FilterBlock`, compiled for F and H of all or of each; None where this machine compiles nothing."""
    triangles, place = triangle(p)[2].ravel(), triangle(d)[2]

    def step(P: np.ndarray, seen: np.ndarray, F: np.ndarray, Q: np.ndarray, H: np.ndarray, R: np.ndarray) -> tuple:
        block = _FilterBlock(d, p, *(np.zeros((height, 1), dtype=object) for height in _heights(d, p, True)))
        block.F, block.H = F.reshape(d, d, 1), H.reshape(p, d, 1)
        block.P[:, 0], block.C[: len(Q), 0], block.C[-p * p :, 0] = P, Q, R[triangles]
        block.congruences()
        now = [*block.shown[:, 0], *block.prior[block.diagonal, 0]]
        block.correct()
        return block.P[:, 0], [new.largest(before) for new, before in zip(now, seen, strict=True)]

    upper_d, upper_p = (tuple(zip(*triangle(size)[:2], strict=True)) for size in (d, p))
    given = (tuple(np.ndindex(d, d)), upper_d, tuple(np.ndindex(p, d)), upper_p)
    try:
        return Loop(place, p + d, given, () if own else (0, 2), step)
    except (OSError, RuntimeError):
        return None


@lru_cache(maxsize=64)
def _heights(d: int, p: int, own: bool) -> list[int]:
    """Rows of the arrays that a block works with: P, the prior's, constants, products, and two of passing use."""
    n = d * (d + 1) // 2
    whole = n + p * d + p * p
    full = 2 * d * d if own or d > ONE_PRODUCT else 0
    if d == 1:
        return [1, 1]
    return [n, whole, whole, n, max(full, (p - 1) * max(d, p), 1), p * d + 2 * p + d]


def _aligned(size: int) -> np.ndarray:
    """Memory whose rows begin where a cache line does."""
    memory = np.empty(size + 8)
    first = -address(memory) // 8 % 8
    return memory[first : first + size]


class _Watch:
    """How much of the variances of a block of filters is left.

    Parameters
    ----------
    d, p : numbers of states and of measurements.
    most : (p, width) for the largest S_ii while the noise stays the same, `_TINY`.
    peak : (d, width) for the largest prior variances, `_TINY`.
    """

    def __init__(self, d: int, p: int, most: np.ndarray, peak: np.ndarray) -> None:
        self.d, self.p, self.most, self.peak = d, p, most, peak
        self.left, self.R = np.ones(peak.shape[1]), np.empty((0, 0))

    def begin(self, R: np.ndarray) -> None:
        """Steps with the noise R are to come."""
        self.close()
        self.R = upper(R)

    def look(self, P: np.ndarray, steps: int) -> None:
        """Look at the upper triangles after all steps so far.

        Digits are lost by degrees, too: to a variance far below its peak, or in a P that is nearly singular.
        """
        kept = (P[triangle(self.d)[2].diagonal()] + _TINY) / self.peak
        self.left = np.minimum(self.left, np.minimum.reduce(kept))
        if steps >= EVERY:
            self.left = np.minimum(self.left, smallest_pivot(P, self.d))

    def close(self) -> None:
        """Account for the updates since the noise was laid out: 1/(1 + s) of the largest s is left, or more.

        s ≤ Σ (S_ii − R_ii)/R_ii where the noises are independent; where they are not, it grows as R is singular.
        """
        if not len(self.R):
            return
        if self.p == 1:
            left = self.R[0] / self.most[0]
        else:
            gained = np.add.reduce(self.most / self.R[triangle(self.p)[2].diagonal()]) - self.p
            left = smallest_pivot(self.R, self.p) / (1.0 + gained)
        self.left, self.R = np.minimum(self.left, left), self.R[:0]
        self.most[:] = _TINY


class _FilterBlock:
    """A block of filters with several states, and the memory that it works in."""

    def __init__(
        self, d: int, p: int, P: np.ndarray, X: np.ndarray, C: np.ndarray, T: np.ndarray, V: np.ndarray, U: np.ndarray
    ) -> None:
        n, width = P.shape
        self.d, self.p, self.P, self.X, self.C, self.T, self.V = d, p, P, X, C, T, V
        self.prior, self.S = X[:n], X[n + p * d :].reshape(p, p, width)
        self.W, self.U = X[n : n + p * d].reshape(p, d, width), U[: p * d].reshape(p, d, width)
        self.turn, self.shown = U[p * d : p * d + p], X[n + p * d :: p + 1]
        self.diagonal = triangle(d)[2].diagonal()
        U[p * d + p :] = _TINY
        self.watch = _Watch(d, p, U[p * d + p : p * d + 2 * p], U[p * d + 2 * p :])

    @property
    def left(self) -> np.ndarray:
        """Smallest share of variance that is left, (width,)."""
        return self.watch.left

    def prepare(self, step: Step) -> None:
        """Lay out what the steps to come go by."""
        F, Q, H, R = step
        d, p, n = self.d, self.p, len(self.P)
        self.one = d <= ONE_PRODUCT and F.ndim == H.ndim == 2
        if self.one:
            self.matrix, noise = _maps(F.tobytes(), H.tobytes(), d)
            np.matmul(noise, Q.reshape(-1, d * d).T, out=self.C if Q.ndim == 3 else self.C[:, :1])
        else:
            self.C[:n] = upper(Q)
            self.F, self.H = (M if M.ndim == 2 else np.ascontiguousarray(M.transpose(1, 2, 0)) for M in (F, H))
            self.C[n:] = 0.0
        if self.one and Q.ndim == 2:
            self.C[:, 1:] = self.C[:, :1]
        self.watch.begin(R)
        self.C[n + p * d :] += self.watch.R if p == 1 else self.watch.R[triangle(p)[2].ravel()]

    def advance(self, k: int, last: bool) -> None:
        """Predict and update, the k-th time, counted from 0."""
        if self.one:
            np.matmul(self.matrix, self.P, out=self.X)
            np.add(self.X, self.C, out=self.X)
        else:
            self.congruences()
        watch = self.watch
        if k % EVERY == 0:
            np.maximum(watch.peak, self.prior[self.diagonal], out=watch.peak)
        np.maximum(watch.most, self.shown, out=watch.most)
        self.correct()
        if last or (k + 1) % EVERY == 0:
            watch.look(self.P, k + 1)
        if last:
            watch.close()

    def correct(self) -> None:
        """P from P⁻, H P⁻ and S."""
        _eliminate(self.S, self.W, self.turn, self.V)
        np.multiply(self.W, self.turn[:, None], out=self.U)
        subtract(self.prior, self.U, self.W, self.T, self.P)

    def congruences(self) -> None:
        """F P Fᵀ + Q, H P⁻ and H P⁻Hᵀ + R from both sides, one after the other."""
        d, p, n, F, H = self.d, self.p, len(self.P), self.F, self.H
        full, moved = (M.reshape(d, d, -1) for M in np.split(self.V[: 2 * d * d], 2))
        flat = full.reshape(d * d, -1)
        np.take(self.P, triangle(d)[2].ravel(), axis=0, out=flat, mode="clip")
        _product(F, full, moved)
        for i, first in enumerate(self.diagonal):
            rows = self.prior[first : first + d - i]
            if F.ndim == 2:
                np.matmul(F[i:], moved[i], out=rows)
            else:
                np.einsum("kb,jkb->jb", moved[i], F[i:], out=rows)
        self.prior += self.C[:n]
        np.take(self.prior, triangle(d)[2].ravel(), axis=0, out=flat, mode="clip")
        _product(H, full, self.W)
        if H.ndim == 2:
            np.matmul(H, self.W, out=self.S)
        else:
            np.einsum("qkb,rkb->qrb", self.W, H, out=self.S)
        self.S += self.C[n + p * d :].reshape(self.S.shape)

    def write(self, out: np.ndarray) -> None:
        """Write the covariances, (d, d, width)."""
        unpack(self.P, self.d, out)


class _Scalars:
    """The same of one state: nothing to cancel."""

    def __init__(self, P: np.ndarray, X: np.ndarray) -> None:
        self.P, self.left, self.total = P[0], np.ones(P.shape[1]), X[0]

    def prepare(self, step: Step) -> None:
        F, Q, H, R = step
        self.square, self.Q = F[..., 0, 0] ** 2, Q[..., 0, 0]
        if R.shape[-1] == 1:
            self.J = H[..., 0, 0] ** 2 / R[..., 0, 0]
        else:
            C, left = noise_factor(R if R.ndim == 3 else R[None])
            H = (H if H.ndim == 3 else H[None]).transpose(1, 2, 0)
            self.J, self.left = (solve_lower(C, H) ** 2).sum(axis=(0, 1)), np.minimum(self.left, left)

    def advance(self, k: int, last: bool) -> None:
        P, total = self.P, self.total
        P *= self.square
        P += self.Q
        np.multiply(P, self.J, out=total)
        total += 1.0
        P /= total
        if last:
            P[~np.isfinite(total)] = np.nan  # what is beyond floating point leaves nothing, whatever J is

    def write(self, out: np.ndarray) -> None:
        out[0, 0] = self.P


def _product(A: np.ndarray, B: np.ndarray, out: np.ndarray) -> None:
    """A B for A (rows, d), or (rows, d, items), and B (d, columns, items)."""
    if A.ndim == 2:
        np.matmul(A, B.reshape(len(B), -1), out=out.reshape(len(A), -1))
    else:
        np.einsum("ijb,jkb->ikb", A, B, out=out)


@lru_cache(maxsize=256)
def _maps(F: bytes, H: bytes, d: int) -> tuple[np.ndarray, np.ndarray]:
    """`prior_map` with all of S, of P and of Q as it is given, whole matrices."""
    A, given = (np.frombuffer(M).reshape(-1, d) for M in (F, H))
    rows, columns, _ = triangle(d)
    before = len(rows) + given.size
    all_of_it = np.concatenate([np.arange(before), before + triangle(len(given))[2].ravel()])
    noise = np.zeros((len(all_of_it), d * d))
    noise[:, rows * d + columns] = prior_map(np.eye(d), np.zeros((d, d)), given)[0][all_of_it]
    return prior_map(A, np.zeros((d, d)), given)[0][all_of_it], noise


def _eliminate(S: np.ndarray, W: np.ndarray, turn: np.ndarray, passing: np.ndarray) -> None:
    """S = L diag(δ) Lᵀ: 1/δ into `turn` (p, items), W (p, d, items) into L⁻¹W; S is used up."""
    p, d, items = W.shape
    for i in range(p):
        np.divide(1.0, S[i, i], out=turn[i])
        rest = p - i - 1
        if rest:
            column = np.multiply(S[i + 1 :, i], turn[i], out=S[i + 1 :, i])
            product = passing[: rest * d].reshape(rest, d, items)
            W[i + 1 :] -= np.multiply(column[:, None], W[i], out=product)
            product = passing[: rest * rest].reshape(rest, rest, items)
            S[i + 1 :, i + 1 :] -= np.multiply(column[:, None], S[i, i + 1 :], out=product)


def subtract(prior: np.ndarray, U: np.ndarray, W: np.ndarray, product: np.ndarray, out: np.ndarray) -> None:
    """P⁻ − Σ u wᵀ into `out`, rows of upper triangles; U and W (p, d, items) with a symmetric sum."""
    d, first = U.shape[1], 0
    for i in range(d):
        some = product[first : first + d - i]
        if len(U) == 1:
            np.multiply(U[0, i], W[0, i:], out=some)
        else:
            np.einsum("pb,pjb->jb", U[:, i], W[:, i:], out=some)
        first += d - i
    np.subtract(prior, product, out=out)


def unpack(P: np.ndarray, d: int, out: np.ndarray) -> None:
    """Write upper triangles (d(d+1)/2, items) into `out`, (d, d, items)."""
    place = triangle(d)[2]
    if out.flags.c_contiguous:
        np.take(P, place, axis=0, out=out, mode="clip")
        return
    for i in range(d):
        for j in range(d):
            out[i, j] = P[place[i, j]]


def noise_factor(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C of R = C Cᵀ for R of shape (items, p, p), and how nearly singular R is.

    Returns
    -------
    C : (p, p, items), lower triangular.
    left : (items,) smallest conditional variance of a noise given those before it, relative to its variance: about
        log10(1/left) digits are lost where C⁻¹ is applied to what has been rounded.  Not positive, or NaN, where R is
        singular to rounding.
    """
    C, left = np.zeros((*R.shape[1:], len(R))), np.ones(len(R))
    with np.errstate(all="ignore"):
        for i in range(len(C)):
            pivot = R[:, i, i] - (C[i, :i] ** 2).sum(axis=0)
            left = np.minimum(left, pivot / R[:, i, i])
            C[i, i] = np.sqrt(pivot)
            for j in range(i + 1, len(C)):
                C[j, i] = (R[:, j, i] - (C[j, :i] * C[i, :i]).sum(axis=0)) / C[i, i]
    return C, left


def solve_lower(C: np.ndarray, B: np.ndarray) -> np.ndarray:
    """C⁻¹B for lower triangles C (p, p, items) and B (p, columns, items), of which either may have one item for all."""
    out = np.empty((*B.shape[:2], max(B.shape[-1], C.shape[-1])))
    for i in range(len(out)):
        out[i] = B[i]
        for j in range(i):
            out[i] -= C[i, j] * out[j]
        out[i] /= C[i, i]
    return out


def smallest_pivot(P: np.ndarray, d: int, more: float = 0.0) -> np.ndarray:
    """Smallest conditional variance of a state given those before it, relative to its variance, shape (items,).

    P is given by its upper triangle, (d(d+1)/2, items).  The smaller, the more of the small directions of P is rounding
    that an earlier, larger P left behind.

    Parameters
    ----------
    more : what to add to P first, in units of each state's variance (1 where it has none): all pivots are positive
        where no eigenvalue, scaled to unit variances, is below −more.  NaN where a pivot is not positive.
    """
    rest, diagonal = P.copy(), triangle(d)[2].diagonal()
    variances = np.where(rest[diagonal] > 0, rest[diagonal], 1.0)
    if more:
        rest[diagonal] += more * variances
    smallest = np.ones(P.shape[1])
    for i, first in enumerate(diagonal):
        pivot, row = rest[first], rest[first + 1 : first + d - i]
        smallest = np.minimum(smallest, pivot / variances[i])
        column = row / np.where(pivot > 0, pivot, np.nan)
        for j, start in enumerate(diagonal[i + 1 :]):
            rest[start : start + len(row) - j] -= column[j] * row[j:]
    return smallest


def sound(P: np.ndarray, d: int) -> np.ndarray:
    """Whether upper triangles (d(d+1)/2, items) are finite and positive semi-definite up to rounding, shape (items,).

    Cheap, and never satisfied with what `stochfuse.kalman.checks.covariance_fault` is not.
    """
    if d == 1:
        return np.isfinite(P[0]) & (P[0] >= 0)
    with np.errstate(all="ignore"):
        return (smallest_pivot(P, d, -INDEFINITE) > 0) & (P[triangle(d)[2].diagonal()] >= 0).all(axis=0)
