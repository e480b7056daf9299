"""Simulators in plain NumPy, written from the textbook: what the crosscheck is tried on.

They import nothing of the package.
"""

from __future__ import annotations

from itertools import product

import numpy as np

F = np.array([[1.0, 1.0], [0.0, 1.0]])
H = np.array([[1.0, 0.0]])
Q = np.array([[0.25, 0.5], [0.5, 1.25]])
R = 9.0
P0 = np.array([[16.0, 1.0], [1.0, 4.0]])
STEPS = 3
SCENARIO = {
    "model": {"F": F.tolist(), "H": H.tolist(), "Q": Q.tolist(), "R": R, "states": ["x", "v"]},
    "initial": {"P": P0.tolist()},
    "network": {"agents": 2, "steps": STEPS},
}
"""The same as a file of the package has it."""


def naive(µ, runs, rng, agents=2, error=(0.0, 0.0), noise=1.0):
    """Kalman filters that take what they hear for independent: claimed covariances and errors of every step.

    In the first step nothing is measured.  Every message is heard with probability µ, and all that is heard in a step
    is fused by inverse covariances; the fused estimate is the next step's prior.  What is measured has `noise` times the
    variance that the filters take it to have.
    """
    truth = np.zeros((runs, 2))
    x = rng.normal(size=(runs, agents, 2)) @ np.linalg.cholesky(P0).T + np.array(error)
    P = np.broadcast_to(P0, (runs, agents, 2, 2))
    steps = []
    for k in range(STEPS):
        if k > 0:
            truth = truth @ F.T + rng.normal(size=(runs, 2)) @ np.linalg.cholesky(Q).T
            x, P = x @ F.T, F @ P @ F.T + Q
            z = (truth @ H.T)[:, None] + np.sqrt(noise * R) * rng.normal(size=(runs, agents, 1))
            K = P @ H.T / (H @ P @ H.T + R)
            x = x + (K @ (z - x @ H.T)[..., None])[..., 0]
            P = P - K @ H @ P
        heard = (rng.random((runs, agents, agents)) < µ) | np.eye(agents, dtype=bool)
        information = np.linalg.inv(P)
        P = np.linalg.inv(np.einsum("rij,rjab->riab", heard, information))
        x = np.einsum("riab,rib->ria", P, np.einsum("rij,rjab,rjb->ria", heard, information, x))
        steps.append((P, x - truth[:, None]))
    return steps


def best(µ, runs, rng):
    """Two agents, each with the best linear estimate of all that has reached it: least squares over the trajectory.

    A source is a first estimate or a measurement; a message holds all sources that its sender has.
    """
    steps, agents = STEPS, 2
    x = np.empty((runs, steps, 2))
    x[:, 0] = 0.0
    for k in range(1, steps):
        x[:, k] = x[:, k - 1] @ F.T + rng.normal(size=(runs, 2)) @ np.linalg.cholesky(Q).T
    first = rng.normal(size=(runs, agents, 2)) @ np.linalg.cholesky(P0).T
    z = x[:, :, None, 0] + np.sqrt(R) * rng.normal(size=(runs, steps, agents))
    heard = rng.random((runs, steps, agents)) < µ
    found = [(np.empty((runs, agents, 2, 2)), np.empty((runs, agents, 2))) for _ in range(steps)]
    for pattern in product((False, True), repeat=steps * agents):
        mine = (heard.reshape(runs, -1) == pattern).all(axis=1)
        if not mine.any():
            continue
        has = [{("first", a)} for a in range(agents)]
        for k in range(steps):
            if k > 0:
                has = [has[a] | {(k, a)} for a in range(agents)]
            arrived = pattern[k * agents : (k + 1) * agents]
            has = [has[a] | has[1 - a] if arrived[a] else has[a] for a in range(agents)]
            for a in range(agents):
                P, estimate = _least_squares(has[a], k, first[mine], z[mine])
                found[k][0][mine, a] = P
                found[k][1][mine, a] = estimate - x[mine, k]
    return found


def _least_squares(sources, last, first, z):
    """Covariance and estimate of the state at a step, from first estimates, measurements and the motion between."""
    size = 2 * (last + 1)
    information, vector = np.zeros((size, size)), np.zeros((len(first), size))
    for k in range(1, last + 1):
        rows = np.zeros((2, size))
        rows[:, 2 * k : 2 * k + 2], rows[:, 2 * k - 2 : 2 * k] = np.eye(2), -F
        information += rows.T @ np.linalg.inv(Q) @ rows
    for when, agent in sources:
        if when == "first":
            information[:2, :2] += np.linalg.inv(P0)
            vector[:, :2] += first[:, agent] @ np.linalg.inv(P0)
        else:
            information[2 * when, 2 * when] += 1 / R
            vector[:, 2 * when] += z[:, when, agent] / R
    P = np.linalg.inv(information)
    return P[-2:, -2:], (vector @ P)[:, -2:]


def table(simulator, links, runs, rng, **how):
    """Columns of a file, a row for every run, agent and step."""
    parts = []
    for µ in links:
        for k, (P, e) in enumerate(simulator(µ, runs, rng, **how)):
            run, agent = (i.ravel() for i in np.indices(P.shape[:2]))
            whole = np.ones(len(run))
            parts.append(
                {
                    "run": run,
                    "agent": agent + 1,
                    "step": (k + 1) * whole.astype(int),
                    "link": µ * whole,
                    "covariance": np.trace(P, axis1=-2, axis2=-1).ravel(),
                    "covariance:det": np.linalg.det(P).ravel(),
                    "squared_error": (e**2).sum(axis=-1).ravel(),
                    "error:x": e[..., 0].ravel(),
                    "error:v": e[..., 1].ravel(),
                    "nees": np.einsum("ria,riab,rib->ri", e, np.linalg.inv(P), e).ravel(),
                }
            )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
