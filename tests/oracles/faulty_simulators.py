"""Simulators as strangers write them, in plain NumPy, right or with one planted mistake.  Nothing here imports stochfuse.

Runs with equal histories are worked out together, a column of data for each run; what agents have in common is found by
plain inclusion-exclusion over pedigrees (`textbook.FusionGraph`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.oracles import textbook


@dataclass(frozen=True)
class World:
    """Model, agents and network of a simulation."""

    F: Any
    H: Any
    Q: Any
    R: Any
    P0: Any
    agents: int
    steps: int
    shared: bool = False
    naive: bool = False
    architecture: str = "ad-hoc"
    sensors: tuple = ()

    def matrices(self):
        return [np.atleast_2d(np.array(M, dtype=float)) for M in (self.F, self.H, self.Q, self.R, self.P0)]

    def source(self):
        """As a scenario file has it."""
        names = ["a", "b", "c", "d"][: len(np.atleast_2d(self.F))]
        tables = {
            "model": {"F": self.F, "H": self.H, "Q": self.Q, "R": self.R, "states": names},
            "initial": {"P": self.P0, "correlation": "shared" if self.shared else "independent"},
            "network": {"agents": self.agents, "steps": self.steps, "architecture": self.architecture},
        }
        if self.sensors:
            tables["agent"] = [{} if R is None else {"R": R} for R in self.sensors]
        return tables


@dataclass
class Ways:
    """How the simulation goes about it; every deviation from the defaults is a mistake."""

    q: float = 1.0
    r: float = 1.0
    p0: float = 1.0
    brought: bool = True
    once: bool = False
    own_lost: bool = False
    delay: int = 0
    frozen: bool = False
    bursts: float = 0.0
    measured_first: bool = False
    fed_back: bool = True
    silent: bool = False
    transposed: bool = False


class Network:
    """One history of a network; x columns are runs."""

    def __init__(self, world, ways, sensors, starts, records, heard):
        self.F, _, self.Q, _, P0 = world.matrices()
        self.F = self.F.T if ways.transposed else self.F
        self.Q, P0 = ways.q * self.Q, ways.p0 * P0
        self.sensors, self.ways = sensors, ways
        n, Y0 = world.agents, np.linalg.inv(P0)
        self.local, self.fused, self.prior, parents = {}, {}, {}, {}
        self.locals = {"root": (Y0 @ starts[0], Y0)}
        for i in range(n):
            parents[i, 1] = {"root"} if world.shared else set()
        graph = textbook.FusionGraph(parents, lambda node: self.locals[node], self.forward)
        if not ways.brought:
            graph.bring = lambda pair, since, until: pair
        kept = {}
        for k in range(1, world.steps + 1):
            for i in range(n):
                if k == 1:
                    self.prior[i, k] = (Y0 @ starts[i], Y0)
                    known = self.prior[i, k]
                    self.locals[i, k] = self.measured(known, records, i, k) if ways.measured_first else known
                else:
                    self.prior[i, k] = self.forward(kept[i], k)
                    self.locals[i, k] = self.measured(self.prior[i, k], records, i, k)
            for i in range(n):
                received = {(j, sent) for j, receiver, sent in heard[k - 1] if receiver == i}
                if not ways.own_lost or not received:
                    received |= {(i, k)}
                if world.naive:
                    pairs = [graph.bring(self.locals[s], s[1], k) for s in sorted(received)]
                    self.fused[i, k] = (sum(y for y, _ in pairs), sum(Y for _, Y in pairs))
                else:
                    self.fused[i, k] = graph.info(graph.maximal(received), k)
                parents[i, k + 1] = set(received) if ways.fed_back else {(i, k)}
            for i in range(n):
                kept[i] = self.fused[i, k] if ways.fed_back else self.locals[i, k]

    def forward(self, pair, k):
        y, Y = pair
        P = np.linalg.inv(Y)
        prior = np.linalg.inv(self.F @ P @ self.F.T + self.Q)
        return prior @ self.F @ P @ y, prior

    def measured(self, pair, records, i, k):
        H, R = self.sensors[i]
        return pair[0] + H.T @ np.linalg.solve(R, records[k - 1][i]), pair[1] + H.T @ np.linalg.solve(R, H)


def draws(world, ways, link, runs, rng):
    """(runs, steps, receiver, sender) whether a message arrives."""
    n, K = world.agents, world.steps
    µ = np.broadcast_to(link, (n, n))
    u = rng.random((runs, K, n, n))
    if world.architecture == "broadcast":
        u = np.broadcast_to(rng.random((runs, K, 1, n)), u.shape)
    arrived = u < µ
    if ways.frozen:
        arrived = np.broadcast_to(arrived[:, :1], arrived.shape)
    if ways.bursts:
        arrived = arrived.copy()
        for k in range(1, K):
            stay = rng.random((runs, n, n)) < ways.bursts
            arrived[:, k] = np.where(stay, arrived[:, k - 1], arrived[:, k])
    if ways.once:
        upper = np.triu(np.ones((n, n), bool), 1)
        arrived = np.where(upper, arrived, np.swapaxes(arrived, -1, -2))
    if ways.silent:
        arrived = arrived.copy()
        arrived[:, 0] = False
    own = np.eye(n, dtype=bool)
    arrived = np.where(own, arrived if ways.own_lost else True, arrived)
    if world.architecture == "cyclic":
        arrived = arrived & (own | np.roll(own, 1, axis=1))
    return arrived


def simulate(world, link, runs, seed=0, ways=None, show="fused", errors=False):
    """Claimed covariances (runs, steps, agents, d, d) and errors (runs, steps, agents, d) of what is shown."""
    ways = ways or Ways()
    rng = np.random.default_rng([seed, 7])
    F, H, Q, R, P0 = world.matrices()
    n, K, d = world.agents, world.steps, len(F)
    each = [R if r is None else np.atleast_2d(np.array(r, float)) for r in (world.sensors or [None] * n)]
    noises = [ways.r * r for r in each]
    arrived = draws(world, ways, link, runs, rng)
    x = np.zeros((K, d, runs))
    root = np.linalg.cholesky(ways.p0 * P0)
    common = root @ rng.normal(size=(d, runs))
    starts = [common if world.shared else root @ rng.normal(size=(d, runs)) for _ in range(n)]
    w, v = np.linalg.eigh(ways.q * Q)
    rootQ = v * np.sqrt(np.maximum(w, 0))
    for k in range(1, K):
        x[k] = F @ x[k - 1] + rootQ @ rng.normal(size=(d, runs))
    z = [
        [H @ x[k] + np.linalg.cholesky(noises[i]) @ rng.normal(size=(len(H), runs)) for i in range(n)] for k in range(K)
    ]
    P, e = np.empty((runs, K, n, d, d)), np.empty((runs, K, n, d))
    flat = np.packbits(arrived.reshape(runs, -1), axis=1)
    _, first, of = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(of.ravel(), kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(of.ravel()))[:-1])
    for one, members in zip(first, groups, strict=True):
        heard = [set() for _ in range(K)]
        for k, i, j in np.argwhere(arrived[one]):
            late = 0 if i == j else ways.delay
            if k + late < K:
                heard[k + late].add((int(j), int(i), int(k) + 1))
        columns = members if errors else members[:1]
        network = Network(
            world, ways, [(H, r) for r in noises], [s[:, columns] for s in starts],
            [[z[k][i][:, columns] for i in range(n)] for k in range(K)], heard,
        )  # fmt: skip
        for k in range(K):
            for i in range(n):
                y, Y = {"fused": network.fused, "prior": network.prior, "local": network.locals}[show][i, k + 1]
                P[members, k, i] = np.linalg.inv(Y)
                if errors:
                    e[members, k, i] = (np.linalg.solve(Y, y) - x[k][:, columns]).T
    return P, e


def trace(P):
    return np.trace(P, axis1=-2, axis2=-1)


def faulty(world, fault, link, runs, seed=0, errors=False):
    """What a simulator with a planted mistake writes into its file: (runs, steps, agents) numbers, and errors."""
    from dataclasses import replace

    def plain(ways=None, other=world, µ=link, show="fused"):
        P, e = simulate(other, µ, runs, seed, ways, show, errors)
        return trace(P), e

    def shown(change):
        P, e = plain()
        return change(P), e

    if fault == "step-off-by-one":
        P, e = plain(other=replace(world, steps=world.steps + 1))
        return P[:, 1:], e[:, 1:]
    if fault == "noise-for-covariance":
        R = trace(np.atleast_2d(np.array(world.R, float)))
        return shown(lambda P: np.full_like(P, R))
    if fault == "dependent-runs":
        few = max(20, runs // 10)
        P, e = simulate(world, link, few, seed, None, "fused", errors)
        again = np.arange(runs) % few
        return trace(P)[again], e[again]
    table = {
        "honest": lambda: plain(),
        "prior-for-posterior": lambda: plain(show="prior"),
        "local-for-fused": lambda: plain(show="local"),
        "measured-at-step-1": lambda: plain(Ways(measured_first=True)),
        "shared-start": lambda: plain(other=replace(world, shared=True)),
        "independent-start": lambda: plain(other=replace(world, shared=False)),
        "nothing-removed": lambda: plain(other=replace(world, naive=True)),
        "not-brought-forward": lambda: plain(Ways(brought=False)),
        "pair-drawn-once": lambda: plain(Ways(once=True)),
        "own-message-lost": lambda: plain(Ways(own_lost=True)),
        "delay-of-one": lambda: plain(Ways(delay=1)),
        "one-minus-link": lambda: plain(µ=1 - np.asarray(link)),
        "squared-link": lambda: plain(µ=np.asarray(link) ** 2),
        "wrong-link": lambda: plain(µ=0.6 * np.asarray(link) + 0.05),
        "deviation-for-variance": lambda: shown(np.sqrt),
        "three-sigma": lambda: shown(lambda P: 3 * np.sqrt(P)),
        "sum-for-mean": lambda: shown(lambda P: world.agents * P),
        "Q-scaled": lambda: plain(Ways(q=1.3)),
        "R-scaled": lambda: plain(Ways(r=0.7)),
        "P-scaled": lambda: plain(Ways(p0=1.5)),
        "process-noise-left-out": lambda: plain(Ways(q=0.0)),
        "not-fed-back": lambda: plain(Ways(fed_back=False)),
        "links-drawn-once": lambda: plain(Ways(frozen=True)),
        "bursts": lambda: plain(Ways(bursts=0.7)),
        "silent-at-step-1": lambda: plain(Ways(silent=True)),
        "F-transposed": lambda: plain(Ways(transposed=True)),
        "wrong-architecture": lambda: plain(other=replace(world, architecture="broadcast")),
        "agents-swapped": lambda: (lambda P, e: (P[:, :, ::-1], e))(*plain()),
    }
    return table[fault]()
