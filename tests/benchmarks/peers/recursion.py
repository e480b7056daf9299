"""Covariance recursion of many filters, each with its own Q, R and P(k0), that share F and H: what a trade study is.

Every peer does 5 × (predict, update) and returns the last covariances; where it offers two ways, the faster is shown.  Peers that must carry a mean carry one, with
z = 0.  What a peer prepares (models, predictors, updaters) is outside the time measured; only FilterPy and Stone Soup,
which take one filter at a time, get a part of the filters, since their time is that of a loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import simdkalman
from filterpy import kalman as filterpy
from simdkalman import primitives
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

import stochfuse as sf
from stochfuse.kalman import kernel as kalman
from stochfuse.prediction import simplified
from stochfuse.scenario.network import uniform_rows
from stochfuse.scenario.system import Items, Noises
from tests.benchmarks.peers.ways import (
    FILTERPY,
    OURS,
    SIMDKALMAN,
    STONE_SOUP,
    Section,
    Way,
    agreed,
    fastest,
    timed,
)
from tests.oracles import textbook
from tests.oracles.strategies import mapping

STEPS = 5


class Work(NamedTuple):
    """F (d, d) and H (p, d) of all filters, which states H shows, and each one's Q, R and P0 (items, ., .)."""

    F: np.ndarray
    H: np.ndarray
    shown: tuple[int, ...]
    Q: np.ndarray
    R: np.ndarray
    P0: np.ndarray


def scalar(items: int) -> Work:
    """A random walk that is measured."""
    return Work(np.eye(1), np.eye(1), (0,), *_noises(items, 1, 1))


def plane(items: int) -> Work:
    """Constant velocity in the plane, positions measured: x, vx, y, vy."""
    F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    return Work(F, np.eye(4)[[0, 2]], (0, 2), *_noises(items, 4, 2))


def _noises(items: int, d: int, p: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    roots = (rng.normal(size=(items, size, size + 1)) for size in (d, p, d))
    return tuple(A @ A.swapaxes(1, 2) + 0.1 * np.eye(A.shape[1]) for A in roots)


def literal(work: Work) -> np.ndarray:
    """The textbook's lines on stacks."""
    F, H, _, Q, R, P = work
    identity = np.eye(len(F))
    for _ in range(STEPS):
        prior = F @ P @ F.T + Q
        K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
        P = (identity - K @ H) @ prior
    return P


def simdkalman_primitives(work: Work) -> np.ndarray:
    F, H, _, Q, R, P = work
    x, z = np.zeros((len(P), len(F), 1)), np.zeros((len(P), len(H), 1))
    for _ in range(STEPS):
        x, P = primitives.predict(x, P, F, Q)
        x, P = primitives.update(x, P, H, R, z)
    return P


def simdkalman_filter(work: Work) -> np.ndarray:
    F, H, _, Q, R, P = work
    x, z = np.zeros((len(P), len(F), 1)), np.zeros((len(P), len(H), 1))
    many: Any = simdkalman.KalmanFilter(F, Q, H, R)
    for _ in range(STEPS):
        x, P = many.predict_next(x, P)
        x, P, _ = many.update(x, P, z)
    return P


def filterpy_functions(work: Work) -> np.ndarray:
    F, H, _, Q, R, P0 = work
    predict: Any = filterpy.predict  # its annotations are of scalars
    update: Any = filterpy.update
    z, out = np.zeros((len(H), 1)), np.empty_like(P0)
    for i, P in enumerate(P0):
        x = np.zeros((len(F), 1))
        for _ in range(STEPS):
            x, P = predict(x, P, F, Q[i])
            x, P = update(x, P, z, R[i], H)
        out[i] = P
    return out


def filterpy_object(work: Work) -> np.ndarray:
    F, H, _, Q, R, P0 = work
    z, out = np.zeros((len(H), 1)), np.empty_like(P0)
    one = filterpy.KalmanFilter(len(F), len(H))
    one.F, one.H = F, H
    for i, P in enumerate(P0):
        one.x, one.P, one.Q, one.R = np.zeros((len(F), 1)), P, Q[i], R[i]
        for _ in range(STEPS):
            one.predict()
            one.update(z)
        out[i] = one.P
    return out


class StoneSoup:
    """A predictor and an updater for every filter, made once."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self.parts = [
            (
                KalmanPredictor(
                    LinearGaussianTimeInvariantTransitionModel(transition_matrix=work.F, covariance_matrix=Q)
                ),
                KalmanUpdater(LinearGaussian(ndim_state=len(work.F), mapping=work.shown, noise_covar=R)),
            )
            for Q, R in zip(work.Q, work.R, strict=True)
        ]

    def __call__(self) -> np.ndarray:
        x, z, out = np.zeros((len(self.work.F), 1)), np.zeros((len(self.work.H), 1)), np.empty_like(self.work.P0)
        for i, (predictor, updater) in enumerate(self.parts):
            state: Any = GaussianState(x, self.work.P0[i])
            for _ in range(STEPS):
                state = updater.update(SingleHypothesis(predictor.predict(state), Detection(z)))
            out[i] = state.covar
        return out


def kernel(work: Work) -> np.ndarray:
    """stochfuse's plain predict and update on the stack."""
    estimate = kalman.Estimate(None, work.P0)
    for _ in range(STEPS):
        estimate = kalman.update(kalman.predict(estimate, work.F, work.Q), work.H, work.R)
    return estimate.P


class Batch:
    """stochfuse's batch of scenarios: step 1 is the initial exchange, so one step more than the filters have."""

    def __init__(self, work: Work, agents: int = 1, µ: float = 0.0) -> None:
        F, H, _, Q, R, P0 = work
        given = mapping(F, Q[0], H, R[0], P0[0], agents=agents, steps=STEPS + 1)
        self.scenario = sf.Scenario.from_mapping(given)
        self.link, self.noises = np.full(len(Q), µ), Noises(Q, R, P0)

    def __call__(self) -> np.ndarray:
        return simplified.covariances(self.scenario.system, Items(uniform_rows(self.link), self.noises)).P[:, -1, 0]


def one_by_one(work: Work, agents: int, µ: float) -> np.ndarray:
    """The same of a network, each scenario by itself with `sf.predict`."""
    F, H, _, Q, R, P0 = work
    given = [mapping(F, Q[i], H, R[i], P0[i], agents=agents, steps=STEPS + 1) for i in range(len(Q))]
    return np.array([sf.predict(sf.Scenario.from_mapping(one), [µ]).covariance[0, -1] for one in given])


def part(work: Work, items: int) -> Work:
    return work._replace(Q=work.Q[:items], R=work.R[:items], P0=work.P0[:items])


def section(name: str, work: Work, few: int, rounds: int) -> Section:
    """Agreement of all ways, then their times."""
    all_of_it, some = len(work.Q) * STEPS, part(work, few)
    batch, network = Batch(work), Batch(work, agents=3, µ=0.5)
    ours = Way(OURS, "batch of scenarios", batch, all_of_it)
    ways = [
        Way("NumPy", "literal, by hand", lambda: literal(work), all_of_it),
        Way(SIMDKALMAN, "primitives", lambda: simdkalman_primitives(work), all_of_it),
        Way(SIMDKALMAN, "KalmanFilter", lambda: simdkalman_filter(work), all_of_it),
        Way(FILTERPY, "predict, update", lambda: filterpy_functions(some), few * STEPS),
        Way(FILTERPY, "KalmanFilter", lambda: filterpy_object(some), few * STEPS),
        Way(STONE_SOUP, "KalmanPredictor, KalmanUpdater", StoneSoup(some), few * STEPS),
        Way(OURS, "kalman.predict, update", lambda: kernel(work), all_of_it),
        ours,
    ]
    expected = literal(work)
    differences = ["the reference"]
    for way in ways[1:]:
        got = np.asarray(way.run())
        found = textbook.scaled_error(got, expected[: len(got)])
        differences.append(agreed(f"{name}, {way.who} ({way.how})", found, 1e-9))
    single = one_by_one(part(work, 5), 3, 0.5)
    found = textbook.scaled_error(network()[:5], single)
    ways.append(Way(OURS, "the same of 3 agents, µ = 0.5", network, all_of_it))
    differences.append(agreed(f"{name}, 3 agents", found, 1e-9))
    rows = fastest(timed(ways, differences, ours, rounds))
    return Section(f"{name}: {len(work.Q):,} filters × {STEPS} steps; per filter-step", rows)
