"""The plain baselines: (54) as printed, batched over link probabilities; (49) outcome by outcome, nothing merged."""

from __future__ import annotations

from itertools import combinations, product
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


def general(q, r, p0, agents, link, steps):
    """(49) for a scalar model, ad hoc: every outcome of every step is gone through, depth first; one link probability.

    Each outcome's common information comes from its own search; only what outcomes with the same beginning share by
    being visited together is not repeated.  Returns the expected covariance per step.
    """
    links = [(i, j) for i in range(agents) for j in range(agents) if i != j]
    outcomes = []
    for arrived in product((0, 1), repeat=len(links)):
        heard = [[i] for i in range(agents)]
        for (i, j), yes in zip(links, arrived, strict=True):
            if yes:
                heard[i].append(j)
        outcomes.append((link ** sum(arrived) * (1 - link) ** (len(links) - sum(arrived)), heard))
    expected = [0.0] * steps

    def forward(Y, since, until):
        for _ in range(until - since):
            Y = 1 / (1 / Y + q)
        return Y

    def info(below, step, value, mask, t):
        tops, rest = [], mask
        while rest:
            top = rest.bit_length() - 1
            tops.append(top)
            rest &= ~below[top]
        Y = 0.0
        for size in range(1, len(tops) + 1):
            for T in combinations(tops, size):
                if size == 1:
                    Y += forward(value[T[0]], step[T[0]], t)
                    continue
                shared = -1
                for s in T:
                    shared &= below[s]
                if shared:
                    latest = step[shared.bit_length() - 1]
                    Y += (-1) ** (size + 1) * forward(info(below, step, value, shared, latest), latest, t)
        return Y

    def visit(k, probability, below, step, value, known, fused):
        first = len(value)
        now = [1 / p0 if k == 1 else 1 / (1 / Y + q) + 1 / r for Y in fused]
        below = below + [mask | 1 << first + i for i, mask in enumerate(known)]
        step, value = step + [k] * agents, value + now
        for weight, heard in outcomes:
            masks = [0] * agents
            for i in range(agents):
                for j in heard[i]:
                    masks[i] |= below[first + j]
            Ys = [info(below, step, value, mask, k) for mask in masks]
            expected[k - 1] += probability * weight * sum(1 / Y for Y in Ys) / agents
            if k < steps:
                visit(k + 1, probability * weight, below, step, value, masks, Ys)

    visit(1, 1.0, [], [], [], [0] * agents, [0.0] * agents)
    return expected
