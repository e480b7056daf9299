"""The contact chain: the exact expected optimum, in a handful of terms (theory section 6).

If fusion lost nothing, agent i at step k would hold the measurements of every agent up to the last node of it in
its pedigree.  Walk backwards from (i, k): r_t counts the agents whose step-t measurement i holds; before the exchange
at k it is 1, and every exchange lets those join that were heard by one of them,

    ad hoc     r → r + Binomial(n − r, 1 − (1−µ)^r)
    broadcast  r → r + Binomial(n − r, µ)
    cyclic     r → r + Bernoulli(µ) while r < n

so that r_k ≤ … ≤ r_1.  With T_t these transition probabilities at step t,

    E[P_opt(k)] = Σ over paths of T_k(1 → r_k) Π_{t<k} T_t(r_{t+1} → r_t) · P(r_1, …, r_k)
    P(r_1) = P(k0)/r_1      P(r_1 … r_t) = update(TU(P(r_1 … r_{t−1})), R/r_t)

P runs forwards and does not know where the path will end: paths r_1 ≥ r_2 ≥ … are grown step by step with the weight
Π T_t(r_{t+1} → r_t) of their backward transitions, and every step t closes with T_t(1 → r_t).  There are C(n+k−1, k)
of them (fewer on a ring).

Where they are too many, a scalar model is carried as a distribution of P on a grid for every r.  Time update and
measurement update are monotone and concave in P, and so are they after one another.  Putting the mass of a grid cell
at its mean can therefore only raise the expectation, and splitting it between the cell's ends, mean kept, can only
lower it: carried side by side, the two enclose it.  (Rounding, some 1e-13, comes on top.)
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman import Estimate, predict, update
from stochfuse.model import Model, Sensor, at_step

MOST_PATHS = 20_000
"""Paths up to which they are gone through one by one."""
GRID = 1500
"""Grid cells over the range of P; the enclosure's width falls with their square."""
ROUNDING = 1e-13


class Chain(NamedTuple):
    """Expected optimum.

    Parameters
    ----------
    P : (rows, steps, d, d) expectation, or the middle of what encloses it.
    bound : (rows, steps) relative half-width of the enclosure; 0 where every path was gone through.
    """

    P: np.ndarray
    bound: np.ndarray


def transitions(architecture: str, n: int, µ: np.ndarray) -> np.ndarray:
    """T(r → r′) for r, r′ = 1 … n, shape (rows, n, n)."""
    T = np.zeros((len(µ), n, n))
    for r in range(1, n + 1):
        if architecture == "cyclic":
            T[:, r - 1, r - 1] = 1.0 if r == n else 1.0 - µ
            if r < n:
                T[:, r - 1, r] = µ
            continue
        joins = 1.0 - (1.0 - µ) ** r if architecture == "ad-hoc" else µ
        for more in range(n - r + 1):
            T[:, r - 1, r - 1 + more] = comb(n - r, more) * joins**more * (1.0 - joins) ** (n - r - more)
    return T


def number_of_paths(architecture: str, n: int, k: int) -> int:
    """How many paths r_1 ≥ … ≥ r_k there are: C(n+k−1, k), on a ring those that fall by at most 1 and end at 1 or 2."""
    if architecture != "cyclic":
        return comb(n + k - 1, k)
    if n == 1:
        return 1
    # in some of k exchanges one agent joins; the last of n joins at some exchange t, and nothing happens after it
    fewer = sum(comb(k, joins) for joins in range(min(n - 1, k + 1)))
    return fewer + sum(comb(t - 1, n - 2) for t in range(n - 1, k + 1))


def expected_optimum(
    model: Model,
    sensor: Sensor,
    P0: np.ndarray,
    *,
    shared: bool,
    architecture: str,
    agents: int,
    steps: int,
    link: Callable[[int], np.ndarray],
) -> Chain:
    """Expected optimum for like agents.

    Parameters
    ----------
    link : µ of every row at a step, (rows,).

    Raises
    ------
    UsageError
        If there are too many paths and the state has several dimensions.
    """
    T = [transitions(architecture, agents, link(step)) for step in range(1, steps + 1)]
    if comb(agents + steps - 1, steps) <= MOST_PATHS:
        P = _paths(model, sensor, P0, T, shared=shared)
        return Chain(P, np.zeros(P.shape[:2]))
    if model.dimension > 1:
        raise UsageError(
            f"the optimum of {agents} agents after {steps} steps has {comb(agents + steps - 1, steps):.3g} paths, "
            f"at most {MOST_PATHS} are gone through for a state of several dimensions: use fewer steps or agents, or "
            "--method monte-carlo"
        )
    rows = [_enclosed(model, sensor, P0, [t[row] for t in T], shared=shared) for row in range(len(T[0]))]
    low, high = np.array(rows).transpose(1, 0, 2)
    return Chain(0.5 * (low + high)[..., None, None], 0.5 * (high - low) / low + ROUNDING)


def _paths(model: Model, sensor: Sensor, P0: np.ndarray, T: list[np.ndarray], *, shared: bool) -> np.ndarray:
    n = T[0].shape[1]
    last = np.arange(1, n + 1)
    P = np.stack([P0 if shared else P0 / r for r in last])
    weight = np.ones((len(T[0]), n))
    out = []
    for step, now in enumerate(T, start=1):
        if step > 1:
            # every path r_1 … r_{t−1} goes on to r_t = 1 … r_{t−1}
            parent = np.repeat(np.arange(len(last)), last)
            following = np.arange(len(parent)) - np.repeat(np.cumsum(last) - last, last) + 1
            weight = weight[:, parent] * T[step - 2][:, following - 1, last[parent] - 1]
            prior = predict(Estimate(None, P), at_step(model.F, step), at_step(model.Q, step)).P[parent]
            R = at_step(sensor.R, step) / following[:, None, None]
            P, last = update(Estimate(None, prior), at_step(sensor.H, step), R).P, following
        out.append(np.tensordot(weight * now[:, 0, last - 1], P, axes=1))
    return np.stack(out, axis=1)


def _enclosed(
    model: Model, sensor: Sensor, P0: np.ndarray, T: list[np.ndarray], *, shared: bool
) -> tuple[list[float], list[float]]:
    """Lower and upper bounds of the expectation at every step, one row, scalar model."""
    n, p0 = len(T[0]), P0.item()
    r = np.arange(1, n + 1)

    def after(P: np.ndarray | float, step: int) -> np.ndarray:
        """P(t) for every r_t, shape (n, any), from P(t−1), the same for all r_t or one row for each."""
        F, Q = at_step(model.F, step).item(), at_step(model.Q, step).item()
        H, R = at_step(sensor.H, step), at_step(sensor.R, step)
        J = (H.T @ np.linalg.solve(R, H)).item()
        prior = F * F * P + Q
        return prior / (1.0 + r[:, None] * J * prior)

    start = np.full(n, p0) if shared else p0 / r
    least, most = start.min(), start.max()
    extremes = [least, most]
    for step in range(2, len(T) + 1):
        least, most = after(least, step)[-1, 0], after(most, step)[0, 0]
        extremes += [least, most]
    # 0 below all: what is moved down from anywhere can only lower the expectation
    nodes = np.concatenate([[0.0], np.geomspace(min(extremes) * 0.98, max(extremes) * 1.02, GRID - 1)])
    low = np.stack([_split(nodes, start[i : i + 1], np.ones(1)) for i in range(n)])  # mass at the nodes
    mass, moment = np.zeros((2, n, GRID))  # mass and mass·P of the cells
    cells = _cells(nodes, start)
    mass[r - 1, cells], moment[r - 1, cells] = 1.0, start
    lower, upper = [], []
    for step, now in enumerate(T, start=1):
        if step > 1:
            before = T[step - 2]
            low, mass, moment = before @ low, before @ mass, before @ moment
            mean = np.divide(moment, mass, out=np.broadcast_to(nodes, mass.shape).copy(), where=mass > 0)
            at_nodes, at_means = after(nodes, step), after(mean, step)
            low = np.stack([_split(nodes, P, m) for P, m in zip(at_nodes, low, strict=True)])
            cells = (_cells(nodes, at_means) + GRID * (r[:, None] - 1)).ravel()
            mass, moment = (
                np.bincount(cells, weights.ravel(), minlength=n * GRID).reshape(n, GRID)
                for weights in (mass, mass * at_means)
            )
        lower.append(float(now[0] @ (low @ nodes)))
        upper.append(float(now[0] @ moment.sum(axis=1)))
    return lower, upper


def _cells(nodes: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(nodes, P, side="right") - 1, 0, len(nodes) - 1)


def _split(nodes: np.ndarray, P: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Mass at values P put on the two nodes around each, the mean kept (beyond the last one, on that)."""
    left = np.minimum(_cells(nodes, P), len(nodes) - 2)
    share = np.clip((P - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0)
    found = np.bincount(left, mass * (1.0 - share), minlength=len(nodes))
    return found + np.bincount(left + 1, mass * share, minlength=len(nodes))
