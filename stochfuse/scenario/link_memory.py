"""Whether losses on a link come in bursts, and the two states that explain them best.

Of successive packets n_ab followed an a by a b (0 lost, 1 received).  Without memory the second does not depend on the
first; the likelihood ratio 2 Σ n_ab ln(n_ab n / n_a· n_·b) is then χ² of one degree of freedom.  Where it says
otherwise, a link is fitted by two states, good and bad,

    Gilbert          delivery 1 and 0: p = n_10 / n_1·, r = n_01 / n_0·
    Gilbert–Elliott  deliveries of their own, by Baum–Welch from several starts,

and the Bayesian information criterion −2 ln L + k ln n chooses between none (k = 1), Gilbert (2) and Gilbert–Elliott
(4).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MEMORY = 3.841458820694124
"""95 % point of χ² with one degree of freedom."""
LONGEST, RESTARTS, ROUNDS = 2000, 4, 100
"""Packets of a link that Baum–Welch looks at, its starts, and its steps."""

TwoStates = dict[str, float]
"""good_to_bad, bad_to_good, good and bad, as network.burst has them."""


def memory_of(
    pair: np.ndarray, seq: np.ndarray, got: np.ndarray, n: int
) -> tuple[np.ndarray, dict[tuple[int, int], TwoStates] | None]:
    """Likelihood ratio for memory of every link, and the two-state models of those that have some.

    Parameters
    ----------
    pair : (packets,) number of each packet's link, receiver times n plus sender.
    seq, got : (packets,) its number, and whether it arrived.
    n : number of nodes.

    Returns
    -------
    ratio, models
        (n, n), NaN where no packet follows another; by (receiver, sender), None if no link has a memory.
    """
    order = np.lexsort((seq, pair))
    pair, got = pair[order], got[order].astype(int)
    same = pair[1:] == pair[:-1]
    counts = np.zeros((n * n, 2, 2))
    np.add.at(counts, (pair[1:][same], got[:-1][same], got[1:][same]), 1)
    total = counts.sum(axis=(1, 2), keepdims=True)
    expected = counts.sum(axis=2, keepdims=True) * counts.sum(axis=1, keepdims=True) / np.maximum(total, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(counts > 0, counts * np.log(counts / expected), 0.0)
    ratio = 2 * terms.sum(axis=(1, 2))
    # where the criterion prefers no memory to the best chain, two hidden states need not be tried
    remembering = np.flatnonzero(ratio > np.maximum(MEMORY, np.log(np.maximum(total[:, 0, 0], 1))))
    starts = np.searchsorted(pair, remembering), np.searchsorted(pair, remembering, side="right")
    records = [got[a:b][:LONGEST] for a, b in zip(*starts, strict=True)]
    fits = dict(zip(remembering.tolist(), _two_states(records, counts[remembering]), strict=True))
    found = {divmod(place, n): fit for place, fit in fits.items() if fit is not None}
    shown = np.where(total[:, 0, 0] > 0, ratio, np.nan).reshape(n, n)
    return shown, found or None


def _two_states(records: Sequence[np.ndarray], counts: np.ndarray) -> list[TwoStates | None]:
    """The two-state model that BIC prefers for each record of 0 and 1; None where it prefers none."""
    if not records:
        return []
    fitted = _baum_welch(records)
    out: list[TwoStates | None] = []
    for record, whole, (model, likelihood) in zip(records, counts, fitted, strict=True):
        n, s = len(record), int(record.sum())
        none, c = _log(s, n), np.zeros((2, 2))
        np.add.at(c, (record[:-1], record[1:]), 1)
        p, r = (whole[1, 0] / max(whole[1].sum(), 1), whole[0, 1] / max(whole[0].sum(), 1))
        first = np.log(max(s if record[0] else n - s, 1) / n)
        gilbert = first + _log(c[1, 0], c[1].sum()) + _log(c[0, 1], c[0].sum())
        scores = {
            "none": np.log(n) - 2 * none,
            "gilbert": 2 * np.log(n) - 2 * gilbert,
            "elliott": 4 * np.log(n) - 2 * likelihood,
        }
        best = min(scores, key=lambda name: scores[name])
        if best == "gilbert" and 0 < p < 1 and 0 < r < 1:
            out.append({"good_to_bad": float(p), "bad_to_good": float(r), "good": 1.0, "bad": 0.0})
        elif best == "elliott":
            out.append(model)
        else:
            out.append(None)
    return out


def _log(s: float, n: float) -> float:
    """Log-likelihood of s of n at their own ratio."""
    if not n or s in (0, n):
        return 0.0
    return float(s * np.log(s / n) + (n - s) * np.log(1 - s / n))


def _baum_welch(records: Sequence[np.ndarray]) -> list[tuple[TwoStates, float]]:
    """Gilbert–Elliott models of largest likelihood, all records and starts side by side."""
    longest = max(map(len, records))
    seen = np.zeros((len(records), longest), dtype=int)
    there = np.zeros((len(records), longest), dtype=bool)
    for i, record in enumerate(records):
        seen[i, : len(record)], there[i, : len(record)] = record, True
    seen, there = np.repeat(seen, RESTARTS, axis=0), np.repeat(there, RESTARTS, axis=0)
    starts = np.array([(0.1, 0.1, 0.95, 0.2), (0.3, 0.3, 0.9, 0.4), (0.02, 0.2, 0.99, 0.05), (0.2, 0.02, 0.8, 0.1)])
    p, r, good, bad = np.tile(starts[:RESTARTS], (len(records), 1)).T.copy()
    likelihood = np.full(len(p), -np.inf)
    for _ in range(ROUNDS):
        T = np.stack([np.stack([1 - p, p], -1), np.stack([r, 1 - r], -1)], axis=1)  # (items, from, to), good first
        E = np.stack([good, bad], -1)
        emitted = np.where(seen[:, :, None] == 1, E[:, None], 1 - E[:, None])
        emitted = np.where(there[:, :, None], emitted, 1.0)
        alpha, scale = np.empty((longest, len(p), 2)), np.empty((longest, len(p)))
        state = np.stack([r, p], -1) / (p + r)[:, None]
        for t in range(longest):
            state = state * emitted[:, t] if t == 0 else (state[:, None] @ T)[:, 0] * emitted[:, t]
            scale[t] = state.sum(axis=1)
            state = state / scale[t][:, None]
            alpha[t] = state
        new = np.where(there.T, np.log(scale), 0.0).sum(axis=0)
        if (new - likelihood < 1e-6 * np.maximum(1, np.abs(new))).all():
            break
        likelihood = new
        beta = np.ones((len(p), 2))
        moves, visits, hits = np.zeros((len(p), 2, 2)), np.zeros((len(p), 2)), np.zeros((len(p), 2))
        for t in range(longest - 1, -1, -1):
            gamma = alpha[t] * beta
            gamma /= gamma.sum(axis=1, keepdims=True)
            visits += np.where(there[:, t, None], gamma, 0)
            hits += np.where((there[:, t] & (seen[:, t] == 1))[:, None], gamma, 0)
            if t:
                flow = alpha[t - 1][:, :, None] * T * (emitted[:, t] * beta)[:, None] / scale[t][:, None, None]
                moves += np.where(there[:, t, None, None], flow, 0)
                beta = (T @ (emitted[:, t] * beta)[:, :, None])[:, :, 0] / scale[t][:, None]
        out = moves.sum(axis=2)
        tiny = 1e-6
        p, r = (np.clip(moves[:, a, 1 - a] / np.maximum(out[:, a], 1e-12), tiny, 1 - tiny) for a in (0, 1))
        good, bad = (np.clip(hits[:, a] / np.maximum(visits[:, a], 1e-12), tiny, 1 - tiny) for a in (0, 1))
    best = likelihood.reshape(-1, RESTARTS).argmax(axis=1) + RESTARTS * np.arange(len(records))
    found = []
    for i in best:
        model = {"good_to_bad": p[i], "bad_to_good": r[i], "good": good[i], "bad": bad[i]}
        if model["good"] < model["bad"]:
            model = {"good_to_bad": r[i], "bad_to_good": p[i], "good": bad[i], "bad": good[i]}
        found.append(({key: float(value) for key, value in model.items()}, float(likelihood[i])))
    return found
