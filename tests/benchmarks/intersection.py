"""Covariance intersection: a batch of pairs against a loop of SciPy's bounded minimiser, and the error in the weight.

A minimiser of values cannot know where the least value lies to better than the root of the rounding, so SciPy's weight
is right to about 1e-7 only, however small its tolerance.  The error in the weight is therefore taken from the root of the
derivative (`scipy.optimize.root_scalar` on the literal expression; 50 digits for nearly singular pairs), on a sample.
"""

from __future__ import annotations

import time

import mpmath as mp
import numpy as np
from scipy.optimize import minimize_scalar, root_scalar

from stochfuse.fusion.intersection import Criterion, fuse_stack, pair_weights
from tests.benchmarks.chain import seconds

D = 4
HEADINGS = (
    "pairs",
    "criterion",
    "SciPy loop",
    "weights",
    "times faster",
    "whole fusion",
    "bound",
    "SciPy differs by",
    "error",
)


def random_pairs(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    X, Y = (rng.normal(size=(count, D, D + 1)) for _ in range(2))
    return X @ X.swapaxes(1, 2), Y @ Y.swapaxes(1, 2)


def equal(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    A, _ = random_pairs(rng, count)
    return A, A.copy()


def nested(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A ≤ B, and the other way round in every other pair."""
    A, more = random_pairs(rng, count)
    swap = (np.arange(count) % 2 == 1)[:, None, None]
    return np.where(swap, A + more, A), np.where(swap, A, A + more)


def nearly_singular(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A of condition number 1e12."""
    turn = np.linalg.qr(rng.normal(size=(count, D, D)))[0]
    A = (turn * np.geomspace(3.0, 3e-12, D)) @ turn.swapaxes(1, 2)
    return 0.5 * (A + A.swapaxes(1, 2)), random_pairs(rng, count)[1]


def scipy_loop(A: np.ndarray, B: np.ndarray, criterion: str, tolerance: float) -> np.ndarray:
    """The literal way, one pair after the other."""
    found = np.empty(len(A))
    for k, (a, b) in enumerate(zip(np.linalg.inv(A), np.linalg.inv(B), strict=True)):
        if criterion == "det":

            def value(w, a=a, b=b):
                return -np.linalg.slogdet(w * a + (1 - w) * b)[1]
        else:

            def value(w, a=a, b=b):
                return np.trace(np.linalg.inv(w * a + (1 - w) * b))

        found[k] = minimize_scalar(value, bounds=(0, 1), method="bounded", options={"xatol": tolerance}).x
    return found


def by_derivative(a: np.ndarray, b: np.ndarray, criterion: str) -> float:
    """Root of the derivative of the literal criterion, or the end that it points to."""
    a, b = np.linalg.inv(a), np.linalg.inv(b)

    def slope(w: float) -> float:
        C = np.linalg.inv(w * a + (1 - w) * b)
        return float(np.trace(C @ (b - a) @ (C if criterion == "trace" else np.eye(len(a)))))

    return 0.0 if slope(0.0) >= 0 else 1.0 if slope(1.0) <= 0 else root_scalar(slope, bracket=(0, 1), xtol=1e-15).root


def to_fifty_digits(a: np.ndarray, b: np.ndarray, criterion: str) -> float:
    """The same by bisection with mpmath."""
    with mp.workdps(50):
        P, Q = mp.matrix(a) ** -1, mp.matrix(b) ** -1
        low, high = mp.mpf(0), mp.mpf(1)
        for _ in range(45):
            w = (low + high) / 2
            C = (w * P + (1 - w) * Q) ** -1
            G = C * (Q - P) * (C if criterion == "trace" else mp.eye(len(a)))
            low, high = (w, high) if sum(G[i, i] for i in range(len(a))) < 0 else (low, w)
        return float(low)


def errors(kind: str, A: np.ndarray, B: np.ndarray, criterion: str, w: np.ndarray, sample: int) -> float:
    """Largest error of the weights: known ones where pairs are equal or nested, else roots on a sample."""
    if kind == "equal":
        return float(np.abs(w - 0.5).max())
    if kind == "nested":
        return float(np.abs(w - (np.arange(len(w)) % 2 == 0)).max())
    exact = to_fifty_digits if kind == "nearly singular" else by_derivative
    few = range(min(sample // 20 if kind == "nearly singular" else sample, len(w)))
    return max(abs(exact(A[k], B[k], criterion) - w[k]) for k in few)


def report(quick: bool) -> list[tuple[str, ...]]:
    """Rows of `HEADINGS`: seconds of the loop, of the weights, their ratio, seconds with C and gains; errors in ω."""
    count, rounds = (200, 1) if quick else (10_000, 7)
    rng = np.random.default_rng(0)
    kinds = {"random": random_pairs, "equal": equal, "nested": nested, "nearly singular": nearly_singular}
    rows = []
    for kind, make in kinds.items():
        A, B = make(rng, count)
        none = np.zeros_like(A)
        for criterion in ("det", "trace"):
            w = pair_weights(A, B, criterion)
            start = time.perf_counter()
            plain = scipy_loop(A, B, criterion, 1e-10)
            loop = time.perf_counter() - start
            mine = seconds(lambda: pair_weights(A, B, criterion), rounds)  # noqa: B023
            whole = seconds(lambda: fuse_stack([A, B], [none, none], None, Criterion(criterion)), rounds)  # noqa: B023
            differs = "" if kind == "equal" else f"{np.abs(plain - w).max():.0e}"
            error = errors(kind, A, B, criterion, w, 40 if quick else 1000)
            times = f"{loop:.3g} s", f"{mine * 1e3:.3g} ms", f"{loop / mine:.0f}", f"{whole * 1e3:.3g} ms"
            rows.append((f"{count:,} {kind}", criterion, *times, "≥ 40, 1e-9", differs, f"{error:.0e}"))
    return rows
