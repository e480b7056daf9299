"""The expected optimum in the steady state, enclosed: the contact chain's geometric tail.

Going backwards from a step, the set of agents whose data is held grows until nobody is left who could join it, after a
time with a geometric tail.  Let V(s) ≥ E[P_t | s_t = s] ≥ L be bounds that hold at every step of the steady state.
Then E[P_k] lies between what paths of m steps bring about that start, m steps ago, from L and from V(s): a sum over the
paths until absorption, whose rest is the probability of not being absorbed by then times V − L, as far as m updates
leave anything of it (`stochfuse.engines.contact_chain` and `enclosure` go through the paths).

    L     the filter that holds every measurement, from P = 0 on: fewer measurements, a larger covariance
    V(s)  V = (1+ε)V̂ where G(V) ≤ V, with      G(V)(s) = update(TU(Σ_s' T(s → s') V(s')), counts of s)

TU and update are monotone and concave, so that by Jensen's inequality E[P_t | s] ≤ G(E[P_t−1 | ·])(s): what starts
below V stays there.  V̂ is G's fixed point; where the filters of all sets settle by themselves, the same with T = 1 is
one bound for all rows of link probabilities.  If nothing settles: in a set that goes on with probability p and does not
show a mode λ of F, E[P] grows by p|λ|² in every step, and p|λ|² ≥ 1 is a proof that there is no steady state.  Where
p|λ|⁴ ≥ 1 there may be one, but P has no variance over the outcomes: no sample's standard error means anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from stochfuse.engines.contact_chain import AlongPath, Contacts, LosslessFilter, by_counts
from stochfuse.kalman.kernel import at_step
from stochfuse.prediction.boundedness import hidden_mode

LARGE = 1e4
"""Variances that bounds settle from, in those of first estimates and process noise."""
SETTLED, MOST_PERIODS, FEW_PERIODS = 1e-6, 10_000, 300
SHARE = 1e-12
"""What rounding may add to the lower start, relative."""


class Starts(NamedTuple):
    """Bounds on the covariance by the counts held, to start from."""

    low: Mapping[tuple[int, ...], np.ndarray]
    high: Mapping[tuple[int, ...], np.ndarray]


def starts(given: LosslessFilter, contacts: Contacts, period: int, row: int | None) -> Starts | None:
    """Bounds that hold in the steady state at all steps ≡ 1 (mod period); None if none settles.

    Parameters
    ----------
    given : over at least period + 1 steps, periodic from step 1 on.
    row : of link probabilities; None for bounds that hold at all of them.
    """
    counts, states = by_counts(contacts)
    T = [contacts.transition(step, slice(row, row + 1))[0] for step in range(1, period + 1)] if row is not None else []

    def on(V: np.ndarray) -> np.ndarray:
        """G over a whole period."""
        for step in range(2, period + 2):
            V = np.tensordot(T[step - 2], V, axes=1) if T else V
            V = _after(given, V, contacts.held, step)
        return V

    sd = np.sqrt(np.diagonal(given.P0) + np.diagonal(given.model.Q, axis1=-2, axis2=-1).max(axis=0))
    large = np.tile(LARGE * np.diag(np.where(sd > 0, sd, 1.0) ** 2), (len(contacts.held), 1, 1))
    V = _settled(on, large, MOST_PERIODS if T else FEW_PERIODS)
    if V is None:
        return None
    d, high = V.shape[-1], {}
    for count, here in zip(counts.tolist(), states, strict=True):
        # P ≤ d diag(P): of several states one bound
        high[tuple(count)] = V[here[0]] if len(here) == 1 else d * np.diag(np.diagonal(V[here], 0, 1, 2).max(axis=0))
    low = np.zeros_like(given.P0)[None]
    for _ in range(MOST_PERIODS):
        before = low
        for step in range(2, period + 2):
            low = _after(given, low, counts.max(axis=0), step)
        if np.abs(low - before).max() <= SHARE * np.abs(low).max():
            break
    return Starts(dict.fromkeys(high, (1.0 - SHARE) * low[0]), high)


def _after(given: LosslessFilter, P: np.ndarray, counts: np.ndarray, step: int) -> np.ndarray:
    root = P if given.scalar else given.numbers.factor(P)
    return given.covariance(given.after(AlongPath(None, root), counts, step))


def _settled(on: Callable[[np.ndarray], np.ndarray], V: np.ndarray, most: int) -> np.ndarray | None:
    """V with G(V) ≤ V a little above G's fixed point, from what is large; None if that does not settle."""
    largest, unit = V.max(), np.ones_like(V)
    for _ in range(most):
        before, V = V, on(V)
        if not np.isfinite(V).all() or V.max() > 1e12 * largest:
            return None
        sd = np.sqrt(np.diagonal(V, axis1=-2, axis2=-1))
        unit = np.maximum(sd[..., :, None] * sd[..., None, :], 1e-300)
        if (np.abs(V - before) <= SETTLED * unit).all():
            break
    else:
        return None
    for ε in (1e-3, 0.03, 1.0):
        high = (1.0 + ε) * V
        after = high
        for _ in range(2 * V.shape[-1]):
            after = on(after)
        if np.linalg.eigvalsh((high - after) / unit).min() > 0:
            return high
    return None


def growing(given: LosslessFilter, contacts: Contacts, row: int, moment: int = 1) -> tuple[complex, float] | None:
    """Return a mode of F that no steady state keeps bounded, and by how much it grows in a step; or None.

    The model and what is measured must not vary with the step.

    Parameters
    ----------
    moment : 1 for E[P], 2 for E[P²].
    """
    T = contacts.transition(2, slice(row, row + 1))[0]
    F, sd = at_step(given.model.F, 2), np.sqrt(np.diagonal(given.P0) + np.diagonal(at_step(given.model.Q, 2)))
    sd = np.where(sd > 0, sd, 1.0)
    reached = np.zeros(len(T), dtype=bool)
    reached[list(contacts.starts)] = True
    for _ in range(len(T)):
        reached, before = reached | (reached @ (T > 0)), reached
        if (reached == before).all():
            break
    for s in np.flatnonzero(reached):
        seen = [at_step(sensor.H, 2) for sensor, n in zip(given.sensors, contacts.held[s], strict=True) if n]
        H = np.concatenate([*seen, np.zeros((1, len(F)))])
        mode = hidden_mode(F * sd / sd[:, None], H * sd)
        factor = 0.0 if mode is None else float(T[s, s] * abs(mode) ** (2 * moment))
        if mode is not None and factor >= 1.0:
            return mode, factor
    return None
