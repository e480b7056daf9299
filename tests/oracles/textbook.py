"""Naive re-derivations, used as oracles.  Nothing here imports stochfuse; everything is written for reading, not for speed."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations, product
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


class FusionGraph:
    """The Local Fusion Graph as the thesis tells it: sets of nodes, recursion, inverses; no sharing of any result.

    parents: node -> set of nodes; a node is (agent, step), or "root" for a shared start.  Estimates are (y, Y) pairs.
    """

    def __init__(self, parents, local, forward):
        self.parents, self.local, self.forward = parents, local, forward

    def ancestors(self, node):
        found, queue = {node}, [node]
        while queue:
            for parent in self.parents.get(queue.pop(), ()):
                if parent not in found:
                    found.add(parent)
                    queue.append(parent)
        return found

    def maximal(self, nodes):
        return {s for s in nodes if not any(s != t and s in self.ancestors(t) for t in nodes)}

    @staticmethod
    def step(node):
        return 1 if node == "root" else node[1]

    def bring(self, pair, since, until):
        for k in range(since + 1, until + 1):
            pair = self.forward(pair, k)
        return pair

    def info(self, nodes, t):
        y, Y = 0, 0
        for size in range(1, len(nodes) + 1):
            for T in combinations(sorted(nodes, key=str), size):
                common = self.common(T, t)
                if common is not None:
                    y, Y = y + (-1) ** (size + 1) * common[0], Y + (-1) ** (size + 1) * common[1]
        return y, Y

    def common(self, T, t):
        if len(T) == 1:
            return self.bring(self.local(T[0]), self.step(T[0]), t)
        M = self.maximal(set.intersection(*(self.ancestors(s) for s in T)))
        if not M:
            return None
        latest = max(map(self.step, M))
        return self.bring(self.info(M, latest), latest, t)


class FusionNetwork:
    """One history of a network, step by step, with the Local Fusion Graph or naively.

    sensors: (H, R) per agent; records: z[step][agent] columns; history: per step a set of (sender, receiver, sent step).
    x0: one for all, or a list of each agent's own.
    """

    def __init__(self, F, Q, sensors, P0, x0, records, history, shared=False, naive=False):
        self.F, self.Q, self.sensors, self.records = F, Q, sensors, records
        n = len(sensors)
        Y0 = np.linalg.inv(P0)
        starts = [(Y0 @ x, Y0) for x in (x0 if isinstance(x0, list) else [x0] * n)]
        self.locals = {"root": starts[0]}
        self.fused = {}
        parents = {(i, 1): ({"root"} if shared else set()) for i in range(n)}
        graph = FusionGraph(parents, lambda node: self.locals[node], self.forward)
        for k, messages in enumerate(history, start=1):
            for i in range(n):
                self.locals[i, k] = starts[i] if k == 1 else self.measure(self.forward(self.fused[i, k - 1], k), i, k)
            for i in range(n):
                received = {(i, k)} | {(j, sent) for j, receiver, sent in messages if receiver == i}
                if naive:
                    pairs = [graph.bring(self.locals[s], s[1], k) for s in sorted(received)]
                    self.fused[i, k] = (sum(y for y, _ in pairs), sum(Y for _, Y in pairs))
                else:
                    self.fused[i, k] = graph.info(graph.maximal(received), k)
                parents[i, k + 1] = set(received)
        self.graph = graph

    def forward(self, pair, k):
        y, Y = pair
        P = np.linalg.inv(Y)
        prior = np.linalg.inv(self.F @ P @ self.F.T + self.Q)
        return prior @ self.F @ P @ y, prior

    def measure(self, pair, i, k):
        H, R = self.sensors[i]
        return pair[0] + H.T @ np.linalg.inv(R) @ self.records[k - 1][i], pair[1] + H.T @ np.linalg.inv(R) @ H

    def covariance(self, i, k):
        return np.linalg.inv(self.fused[i, k][1])

    def state(self, i, k):
        return np.linalg.solve(self.fused[i, k][1], self.fused[i, k][0])


def histories(n, steps, architecture, link, delay=(1.0,)):
    """Every history with its probability: link[k][i][j] from sender j to receiver i at step k + 1.

    delay: probabilities of 0, 1 … steps, of every link or as delay[i][j].
    """
    each = delay if not isinstance(delay[0], float) else [[delay] * n] * n
    draws = []
    for k in range(1, steps + 1):
        if architecture == "ad-hoc":
            draws += [(k, j, (i,)) for i in range(n) for j in range(n) if i != j]
        elif architecture == "broadcast":
            draws += [(k, j, tuple(i for i in range(n) if i != j)) for j in range(n)]
        else:
            draws += [(k, (i + 1) % n, (i,)) for i in range(n)]
    draws = [(k, j, receivers) for k, j, receivers in draws if receivers and link[k - 1][receivers[0]][j] > 0]
    fates = [[None, *range(len(each[receivers[0]][j]))] for _, j, receivers in draws]
    for choice in product(*fates):
        probability, history = 1.0, [set() for _ in range(steps)]
        for (k, j, receivers), fate in zip(draws, choice, strict=True):
            mu = link[k - 1][receivers[0]][j]
            probability *= 1 - mu if fate is None else mu * each[receivers[0]][j][fate]
            if fate is not None and k + fate <= steps:
                history[k + fate - 1] |= {(j, i, k) for i in receivers}
        if probability > 0:
            yield probability, history


def impulses(F, Q, sensors, P0, error, steps, shared):
    """Worlds in which one noise strikes once, with its standard deviation, and one where only the first error is wrong.

    Returns every agent's first estimate, the truth and the measurements, a column for each world: simulated, not derived.
    """
    n, d = len(sensors), len(P0)
    worlds = []  # (first errors per agent, process noise per step, measurement noise per step and agent)

    def world(start=None, process=None, measurement=None):
        worlds.append((start or {}, process or {}, measurement or {}))

    for i in [0] if shared else range(n):
        for column in np.linalg.cholesky(P0).T:
            world(start=dict.fromkeys(range(n), column) if shared else {i: column})
    eigenvalues, vectors = np.linalg.eigh(Q)
    for k in range(2, steps + 1):
        for value, vector in zip(eigenvalues, vectors.T, strict=True):
            world(process={k: np.sqrt(max(value, 0)) * vector})
        for i, (_, R) in enumerate(sensors):
            for column in np.linalg.cholesky(R).T:
                world(measurement={(k, i): column})
    world(start=dict.fromkeys(range(n), error))
    first = [np.column_stack([w[0].get(i, np.zeros(d)) for w in worlds]) for i in range(n)]
    truth, records = [np.zeros((d, len(worlds)))], []
    for k in range(1, steps + 1):
        if k > 1:
            truth.append(F @ truth[-1] + np.column_stack([w[1].get(k, np.zeros(d)) for w in worlds]))
        records.append([
            H @ truth[-1] + np.column_stack([w[2].get((k, i), np.zeros(len(R))) for w in worlds])
            for i, (H, R) in enumerate(sensors)
        ])  # fmt: skip
    return first, truth, records


def error_moments_by_enumeration(
    F, Q, sensors, P0, error, steps, architecture, link, delay=(1.0,), shared=False, naive=False
):
    """Expected actual covariance, bias and mean squared error, [step][agent], over every history, nothing merged."""
    n = len(sensors)
    first, truth, records = impulses(F, Q, sensors, P0, error, steps, shared)
    A, b, M = np.zeros((steps, n, *P0.shape)), np.zeros((steps, n, len(P0), 1)), np.zeros((steps, n, *P0.shape))
    for probability, history in histories(n, steps, architecture, link, delay):
        network = FusionNetwork(F, Q, sensors, P0, first, records, history, shared, naive)
        for k in range(1, steps + 1):
            for i in range(n):
                wrong = network.state(i, k) - truth[k - 1]
                noise, bias = wrong[:, :-1], wrong[:, -1:]
                A[k - 1, i] += probability * noise @ noise.T
                b[k - 1, i] += probability * bias
                M[k - 1, i] += probability * (noise @ noise.T + bias @ bias.T)
    return A, b, M


def expected_by_enumeration(
    F, Q, sensors, P0, x0, records, architecture, link, delay=(1.0,), shared=False, naive=False
):
    """Expected covariance and state, [step][agent], over every history, nothing merged."""
    n, steps = len(sensors), len(records)
    P = np.zeros((steps, n, *P0.shape))
    x = np.zeros((steps, n, *x0.shape))
    for probability, history in histories(n, steps, architecture, link, delay):
        network = FusionNetwork(F, Q, sensors, P0, x0, records, history, shared, naive)
        for k in range(1, steps + 1):
            for i in range(n):
                P[k - 1, i] += probability * network.covariance(i, k)
                x[k - 1, i] += probability * network.state(i, k)
    return P, x


def _full_rate(F, Q, sensors, P0, x0, records, fuse):
    """Fused (x, P) of every agent and step; fuse(j, k, locals, priors, fused) gives (y, Y) of agent j."""
    n, steps = len(sensors), len(records)
    fused, local = {}, {}

    def forward(x, P, steps):
        for _ in range(steps):
            x, P = F @ x, kalman_predict(P, F, Q)
        return x, P

    for k in range(1, steps + 1):
        prior = {}
        for i in range(n):
            if k == 1:
                local[i, k] = (x0, P0)
                continue
            prior[i] = forward(*fused[i, k - 1], 1)
            x, P = prior[i]
            H, R = sensors[i]
            local[i, k] = (kalman_state(x, P, H, R, records[k - 1][i]), kalman_update(P, H, R))
        for j in range(n):
            y, Y = fuse(j, k, local, prior, fused, forward)
            P = np.linalg.inv(Y)
            fused[j, k] = (P @ y, P)
    return fused


def _information(x, P):
    return np.linalg.inv(P) @ x, np.linalg.inv(P)


def _sum(pairs):
    return sum(y for y, _ in pairs), sum(Y for _, Y in pairs)


def full_rate_broadcast(F, Q, sensors, P0, x0, records):
    """(28)–(31): everyone's local estimates less the priors of all others."""
    n = len(sensors)

    def fuse(j, k, local, prior, fused, forward):
        y, Y = _sum([_information(*local[i, k]) for i in range(n)])
        if k > 1:
            b, B = _sum([_information(*prior[i]) for i in range(n) if i != j])
            y, Y = y - b, Y - B
        return y, Y

    return _full_rate(F, Q, sensors, P0, x0, records, fuse)


def full_rate_cyclic(F, Q, sensors, P0, x0, records):
    """(32)–(38), with the inverse that (37) omits."""
    n = len(sensors)

    def fuse(j, k, local, prior, fused, forward):
        nxt = (j + 1) % n
        y, Y = _sum([_information(*local[i, k]) for i in (j, nxt)])
        if k == 1:
            return y, Y
        if k == 2:
            b, B = _information(*forward(*local[nxt, 1], 1))  # (32)/(33)
        else:
            parts = [_information(*local[nxt, k - 1]), _information(*forward(*local[j, k - 2], 1))]
            b, B = _sum(parts)  # (34)/(35)
            if k > 3:  # (36)–(38)
                c, C = _information(*forward(*fused[j, k - 3], 2))
                b, B = b - c, B - C
            P = np.linalg.inv(B)
            b, B = _information(*forward(P @ b, P, 1))
        return y - b, Y - B

    return _full_rate(F, Q, sensors, P0, x0, records, fuse)


def full_rate_stand_alone(F, Q, sensors, P0, x0, records):
    return _full_rate(F, Q, sensors, P0, x0, records, lambda j, k, local, *_: _information(*local[j, k]))
