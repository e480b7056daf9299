"""Naive re-derivations, used as oracles.  Nothing here imports stochfuse; everything is written for reading, not for speed."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from math import comb

import mpmath as mp
import numpy as np


def kalman_predict(P, F, Q):
    return F @ P @ F.T + Q


def kalman_update(P, H, R):
    """Short form, one measurement, as in any textbook."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return (np.eye(len(P)) - K @ H) @ P


def kalman_state(x, P, H, R, z):
    return x + P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ (z - H @ x)


def information_fusion(Ps, prior_count, prior):
    """Thesis (3): sum of informations less `prior_count` times the shared prior's."""
    Y = sum(np.linalg.inv(P) for P in Ps)
    if prior_count:
        Y = Y - prior_count * np.linalg.inv(prior)
    return np.linalg.inv(Y)


def binomial(m, N, mu):
    return comb(N, m) * mu**m * (1 - mu) ** (N - m)


def simplified_literal(F, Q, H, R, P0, agents, mu, steps, shared=False):
    """(54) as printed, with inverses, one link probability."""
    N = agents - 1
    own = [np.linalg.inv((m + 1) * np.linalg.inv(P0)) for m in range(agents)]
    P = P0 if shared else sum(binomial(m, N, mu) * own[m] for m in range(agents))
    out = [P]
    for _ in range(steps - 1):
        prior = kalman_predict(P, F, Q)
        local = kalman_update(prior, H, R)
        P = sum(binomial(m, N, mu) * information_fusion([local] * (m + 1), m, prior) for m in range(agents))
        out.append(P)
    return np.array(out)


def simplified_subsets(F, Q, sensors, P0, links, steps, agent, shared=False):
    """(54) for unlike agents and links: agent's average over all sets of senders, by stacked measurements.

    sensors: a list of (H, R) per agent; links: per step a full matrix, receiver in the row.
    """
    n = len(sensors)
    others = [j for j in range(n) if j != agent]

    def sets(link):
        for heard in product([False, True], repeat=len(others)):
            weight = 1.0
            for j, h in zip(others, heard, strict=True):
                weight *= link[agent][j] if h else 1 - link[agent][j]
            yield weight, [j for j, h in zip(others, heard, strict=True) if h]

    P = P0 if shared else sum(w * P0 / (len(S) + 1) for w, S in sets(links[0]))
    out = [P]
    for k in range(1, steps):
        prior = kalman_predict(P, F, Q)
        P = np.zeros_like(P0)
        for weight, S in sets(links[k]):
            posterior = prior
            for j in [agent, *S]:
                posterior = kalman_update(posterior, *sensors[j])
            P = P + weight * posterior
        out.append(P)
    return np.array(out)


def simplified_scalar_fractions(q, r, p0, agents, mu, steps):
    """(54) for a scalar model in exact rational arithmetic."""
    q, r, p0, mu = map(Fraction, (q, r, p0, mu))
    N = agents - 1
    P = sum(binomial(m, N, mu) * p0 / (m + 1) for m in range(agents))
    out = [P]
    for _ in range(steps - 1):
        prior = P + q
        local = prior * r / (prior + r)
        P = sum(binomial(m, N, mu) / ((m + 1) / local - m / prior) for m in range(agents))
        out.append(P)
    return out


def mp_matrix(A):
    return mp.matrix([[mp.mpf(float(v)) for v in row] for row in np.atleast_2d(A)])


def mp_update(P, H, R):
    HP = H * P
    return P - HP.T * mp.inverse(HP * H.T + R) * HP


def simplified_mpmath(F, Q, H, R, P0, agents, mu, steps, digits=60):
    """(54) through updates with R/(m+1), which needs no invertible prior, in high precision."""
    with mp.workdps(digits):
        F, Q, H, R, P0 = map(mp_matrix, (F, Q, H, R, P0))
        mu, N = mp.mpf(float(mu)), agents - 1
        weights = [mp.binomial(N, m) * mu**m * (1 - mu) ** (N - m) for m in range(agents)]
        P = P0 * mp.fsum(w / (m + 1) for m, w in enumerate(weights))
        out = [P]
        for _ in range(steps - 1):
            prior = F * P * F.T + Q
            P = mp.zeros(len(P0))
            for m, w in enumerate(weights):
                P += w * mp_update(prior, H, R / (m + 1))
            out.append(P)
        return np.array([[[float(P[i, j]) for j in range(P.cols)] for i in range(P.rows)] for P in out])


def scaled_error(P, reference):
    """Largest entrywise error in units of the states' own standard deviations."""
    sd = np.sqrt(np.diagonal(reference, axis1=-2, axis2=-1))
    unit = sd[..., :, None] * sd[..., None, :]
    error = np.abs(P - reference)
    return float(np.max(np.where(unit > 0, error / np.where(unit > 0, unit, 1.0), error)))
