"""Covariance intersection of pairs with the best weight.

FilterPy and simdkalman have none.  Stone Soup's `CovarianceIntersection` and `ChernoffUpdater` take the weight as
given: it is timed with stochfuse's weight put in, and with SciPy's bounded minimiser around it, as its user would.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mpmath as mp
import numpy as np
from scipy.optimize import minimize_scalar
from stonesoup.mixturereducer.gaussianmixture import CovarianceIntersection
from stonesoup.types.state import GaussianState

from stochfuse.fusion.intersection import Criterion, Stack, fuse_stack
from tests.benchmarks.intersection import D, random_pairs, scipy_loop
from tests.benchmarks.peers.ways import OURS, STONE_SOUP, Row, Section, Way, agreed, timed
from tests.oracles import textbook

TOLERANCE = 1e-10
SETTLED = 50
"""Pairs whose criteria are compared in 50 digits."""
OF: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "det": np.linalg.det,
    "trace": lambda C: np.trace(C, axis1=-2, axis2=-1),
}


def literal(A: np.ndarray, B: np.ndarray, criterion: str) -> tuple[np.ndarray, np.ndarray]:
    """Weights by a loop over SciPy's minimiser, and the fused covariances."""
    w = scipy_loop(A, B, criterion, TOLERANCE)
    return w, fused(A, B, w)


def fused(A: np.ndarray, B: np.ndarray, w: np.ndarray) -> np.ndarray:
    """C of given weights, as it is written."""
    return np.linalg.inv(w[:, None, None] * np.linalg.inv(A) + (1 - w)[:, None, None] * np.linalg.inv(B))


def whole(A: np.ndarray, B: np.ndarray, criterion: str) -> Stack:
    """stochfuse: weights, covariances, gains and a certificate of each."""
    none = np.zeros_like(A)
    return fuse_stack([A, B], [none, none], None, Criterion(criterion))


def states(A: np.ndarray) -> list[GaussianState]:
    return [GaussianState(np.zeros((D, 1)), covariance) for covariance in A]


def merged(a: GaussianState, b: GaussianState, w: float) -> np.ndarray:
    state: Any = CovarianceIntersection.merge_components(a, b, weights=[w, 1 - w])
    return state.covar


def given_weights(pairs: list[tuple[GaussianState, GaussianState]], w: np.ndarray) -> np.ndarray:
    """Stone Soup as it is."""
    return np.array([merged(a, b, v) for (a, b), v in zip(pairs, w, strict=True)])


def around_stone_soup(
    pairs: list[tuple[GaussianState, GaussianState]], criterion: str
) -> tuple[np.ndarray, np.ndarray]:
    """SciPy's minimiser around Stone Soup; the logarithm of the determinant as in the literal loop."""
    of = OF[criterion]
    found, out = np.empty(len(pairs)), np.empty((len(pairs), D, D))
    for k, (a, b) in enumerate(pairs):

        def value(w: float, a: GaussianState = a, b: GaussianState = b) -> float:
            size = float(of(merged(a, b, w)))
            return float(np.log(size)) if criterion == "det" else size

        options = {"xatol": TOLERANCE}
        found[k] = minimize_scalar(value, bounds=(0, 1), method="bounded", options=options).x
        out[k] = merged(a, b, found[k])
    return found, out


def section(criterion: str, items: int, few: int, rounds: int) -> Section:
    """Agreement of weights, covariances and criteria, then times."""
    A, B = random_pairs(np.random.default_rng(0), items)
    pairs = list(zip(states(A[:few]), states(B[:few]), strict=True))
    name = f"covariance intersection by {criterion}"
    mine = whole(A, B, criterion)
    w = mine.weights[:, 0]
    ours = Way(OURS, "fuse_stack (ω, C, gains)", lambda: whole(A, B, criterion), items)
    by_hand = Way("NumPy, SciPy", "minimize_scalar, pair by pair", lambda: literal(A, B, criterion), items)
    as_given = Way(STONE_SOUP, "merge_components, ω given", lambda: given_weights(pairs, w[:few]), few)
    around = Way(STONE_SOUP, "merge_components in minimize_scalar", lambda: around_stone_soup(pairs, criterion), few)
    differences = [
        agreement(f"{name}, {who}", A, B, criterion, theirs, w)
        for who, theirs in (
            ("SciPy", literal(A, B, criterion)[0]),
            (STONE_SOUP, around_stone_soup(pairs, criterion)[0]),
        )
    ]
    found = textbook.scaled_error(given_weights(pairs, w[:few]), mine.C[:few])
    given = agreed(f"{name}, {as_given.who}", found, 1e-9)
    rows: list[Row] = timed([by_hand, around, as_given, ours], [*differences, given, ""], ours, rounds)
    return Section(f"{name}: {items:,} pairs of {D}×{D}; per pair", rows)


def agreement(what: str, A: np.ndarray, B: np.ndarray, criterion: str, theirs: np.ndarray, w: np.ndarray) -> str:
    """Difference of the weights; and nowhere may theirs make the criterion smaller.

    That comparison drowns in rounding where a pair is ill conditioned, so the worst ones are decided by 50 digits.
    """
    few = len(theirs)
    A, B, w = A[:few], B[:few], w[:few]
    excess = OF[criterion](fused(A, B, w)) / OF[criterion](fused(A, B, theirs)) - 1
    worst = np.argsort(excess)[-SETTLED:]
    agreed(f"{what}, criterion above theirs", float(np.delete(excess, worst).max(initial=0.0)), 1e-12)
    for k in worst:
        mine, other = (to_fifty(A[k], B[k], float(v[k]), criterion) for v in (w, theirs))
        agreed(f"{what}, criterion of pair {k} above theirs", float(mine / other - 1), 1e-15)
    return agreed(f"{what}, ω", float(np.abs(theirs - w).max()), 1e-6)


def to_fifty(a: np.ndarray, b: np.ndarray, w: float, criterion: str) -> Any:
    """The criterion at a weight, to 50 digits."""
    with mp.workdps(50):
        C = (w * mp.matrix(a) ** -1 + (1 - mp.mpf(w)) * mp.matrix(b) ** -1) ** -1
        return mp.det(C) if criterion == "det" else sum(C[i, i] for i in range(D))
