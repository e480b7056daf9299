"""Agents that exchange estimates over lossy links, written with Stone Soup as its users write: naive fusion.

A received estimate is taken for one more measurement of the whole state, with its covariance for a noise.
"""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

DENSITY, SIGMA2, P0 = 0.5, 9.0, np.diag([50.0, 4.0])
SCENARIO = {
    "model": {
        "F": [[1, 1], [0, 1]], "H": [[1, 0]], "R": SIGMA2, "states": ["x", "v"],
        "Q": [[DENSITY / 3, DENSITY / 2], [DENSITY / 2, DENSITY]],
    },
    "initial": {"P": P0.tolist()},
    "network": {"agents": 2, "steps": 3},
}  # fmt: skip


def fuse(updater, mine, others):
    """One after the other, each a measurement of the state."""
    for other in others:
        model = LinearGaussian(ndim_state=2, mapping=(0, 1), noise_covar=other.covar)
        detection = Detection(other.state_vector, timestamp=mine.timestamp, measurement_model=model)
        prediction = GaussianStatePrediction(mine.state_vector, mine.covar, timestamp=mine.timestamp)
        mine = updater.update(SingleHypothesis(prediction, detection))
    return mine


def simulate(runs, link, seed=0, fault=None):
    """Columns run, agent, step, link, covariance (trace) and squared_error of a file."""
    rng = np.random.default_rng(seed)
    n, steps = SCENARIO["network"]["agents"], SCENARIO["network"]["steps"]
    truth_model = CombinedLinearGaussianTransitionModel([ConstantVelocity(DENSITY)])
    model = truth_model
    if fault == "process-noise-left-out":
        model = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.0)])
    sensor = LinearGaussian(ndim_state=2, mapping=(0,), noise_covar=np.array([[SIGMA2]]))
    predictor, updater = KalmanPredictor(model), KalmanUpdater(sensor)
    µ = 1 - link if fault == "one-minus-link" else link
    Q = truth_model.covar(time_interval=timedelta(seconds=1))
    F = truth_model.matrix(time_interval=timedelta(seconds=1))
    rows = []
    for run in range(runs):
        now = datetime(2024, 1, 1)
        x = rng.multivariate_normal([0.0, 0.0], P0)
        tracks = [GaussianState(x + rng.multivariate_normal([0.0, 0.0], P0), P0, timestamp=now) for _ in range(n)]
        for k in range(1, steps + 1):
            local, shown = list(tracks), list(tracks)
            if k > 1:
                now += timedelta(seconds=1)
                x = F @ x + rng.multivariate_normal([0.0, 0.0], Q)
                shown = [predictor.predict(track, timestamp=now) for track in tracks]
                local = []
                for prediction in shown:
                    z = np.array([[x[0] + np.sqrt(SIGMA2) * rng.normal()]])
                    detection = Detection(z, timestamp=now, measurement_model=sensor)
                    local.append(updater.update(SingleHypothesis(prediction, detection)))
            tracks = []
            for i in range(n):
                others = [local[j] for j in range(n) if j != i and rng.random() < µ]
                if fault == "own-message-lost" and others and rng.random() >= µ:
                    tracks.append(fuse(updater, others[0], others[1:]))
                else:
                    tracks.append(fuse(updater, local[i], others))
            for i, track in enumerate(shown if fault == "prior-for-posterior" else tracks):
                P = float(np.trace(track.covar))
                P = P**0.5 if fault == "deviation-for-variance" else P
                wrong = np.asarray(track.state_vector, dtype=float).ravel() - x
                rows.append((run, i + 1, k, link, P, float(wrong @ wrong)))
    names = ("run", "agent", "step", "link", "covariance", "squared_error")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
