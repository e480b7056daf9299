"""How far rounding can reach in the simplified formulation: the square-root form again, every number moved by an ulp.

The square-root form subtracts nothing, so that what it loses is what its own numbers, rounded as they are, no longer
tell: correlated noises whose difference a sensor resolves, say.  That is measured.  The form is run again with

* every factor, after each prediction and before it, moved by a relative ε in each entry;
* R moved by a relative ε in each entry, as its Cholesky factor is by rounding;
* the factors of P(k0) and Q moved as rounding of their decomposition moves them: by ε sd_i sd_p/L_pp in entry i of a
  column whose pivot is L_pp, but only where an entry is not zero, since zeros are exact,

with |ε| ≤ 2⁻⁵², and the largest change of the covariances is returned, in units of the states' standard deviations.
The same ε serve all items, so that an item's answer does not depend on its company.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stochfuse.engines.mean_field import BLOCK, Case, SquareRoot, run
from stochfuse.kalman import factor

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
    """What moves the numbers of a recursion in square-root form, see `stochfuse.engines.numbers.Numbers`.

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
    P : (steps, d, d, items) covariances as `run_like` gives them; NaN is returned where they are not finite.
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
