"""The plain baseline: (54) as printed, with batched inverses and no Python loop over link probabilities."""

from __future__ import annotations

from math import comb

import numpy as np


def simplified(F, Q, H, R, P0, agents, link, steps):
    """Averaged covariance of shape (links, steps, d, d)."""
    inv = np.linalg.inv
    d, m = len(F), np.arange(agents)
    weights = np.array([[comb(agents - 1, int(i)) * mu**i * (1 - mu) ** (agents - 1 - i) for i in m] for mu in link])
    P = np.einsum("lm,mij->lij", weights, inv((m + 1)[:, None, None] * inv(P0)))
    out = np.empty((len(link), steps, d, d))
    out[:, 0] = P
    more, less = (m + 1)[:, None, None], m[:, None, None]
    for k in range(1, steps):
        prior = F @ P @ F.T + Q
        K = prior @ H.T @ inv(H @ prior @ H.T + R)
        local = (np.eye(d) - K @ H) @ prior
        fused = inv(more * inv(local)[:, None] - less * inv(prior)[:, None])
        P = np.einsum("lm,lmij->lij", weights, fused)
        out[:, k] = P
    return out
