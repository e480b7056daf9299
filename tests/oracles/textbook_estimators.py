"""Naive re-derivation of the network estimators, used as an oracle.  Nothing here imports stochfuse.

`Truth` reads a scenario's mapping literally.  Every estimate carries its claimed covariance and its error as explicit
coefficients over one long vector of all noises (first errors, process, measurements, measurements between agents), with
a last column for the known first error; Σ is the covariance of that vector, never factorised.  Weights of
intersections come from SciPy's SLSQP, polished until the optimality conditions hold; blends from least squares; ε from
a root finder.  Histories are those of `textbook.histories`: every one, nothing merged.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize, root_scalar

from tests.oracles import textbook


class Local(NamedTuple):
    """Claimed covariance P, error coefficients e, and the part K R Kᵀ of P that this step's measurement brought."""

    P: Any
    e: Any
    fresh: Any = 0.0


def at(M, k):
    return M if M.ndim == 2 else M[k - 1]


def slices(sizes):
    ends = np.cumsum([0, *sizes])
    return [slice(a, b) for a, b in pairwise(ends)]


class Truth:
    """Everything that is told and true, from the mapping of a scenario file (matrices, not numbers)."""

    def __init__(self, source):
        model, network, noise = source["model"], source["network"], source.get("noise", {})
        n, self.steps = network["agents"], network["steps"]
        self.n, self.own, self.architecture = n, model.get("own", False), network.get("architecture", "ad-hoc")
        tables = source.get("agent", [{}] * n)
        first = np.array(source["initial"]["P"], float)
        D = len(first)

        def each(key, default):
            return [np.array(table.get(key, default), float) for table in tables]

        self.F, self.Qs, self.P0s = each("F", model["F"]), each("Q", model["Q"]), each("P", first)
        self.M = each("M", np.eye(D))
        self.H, self.R = each("H", model["H"]), each("R", model["R"])
        for i, table in enumerate(tables):
            if not table.get("sensor", True):
                self.H[i], self.R[i] = np.zeros((0, self.F[i].shape[-1])), np.zeros((0, 0))
        self.parallel = not self.own and any({"F", "Q", "P", "M"} & set(table) for table in tables)
        self.x, self.z = slices([F.shape[-1] for F in self.F]), slices([H.shape[-2] for H in self.H])
        self.shared = source["initial"].get("correlation") == "shared"
        c = np.array(noise.get("correlation", 0.0), float)
        self.c = c if c.ndim else c + (1 - c) * np.eye(n)
        disturbance = noise.get("disturbance")
        self.disturbance = None
        if disturbance is not None:
            full = np.array(disturbance, float)
            p = self.z[-1].stop
            if full.ndim == 0:
                full = full * np.eye(p)
            elif full.ndim == 1:
                full = np.diag(np.tile(full, p // len(full)))
            self.disturbance = full
        self.process = noise.get("process")
        b = np.array(source["initial"].get("error", [0.0] * D), float)
        self.b = [np.linalg.lstsq(M, b, rcond=None)[0] for M in self.M]
        self.related = self._relations(source.get("cooperative"), tables, model.get("states"))
        self.link = self._link(network)
        delay = network.get("delay", [1.0])
        unequal = isinstance(delay, list) and isinstance(delay[0], list)
        self.delay = [list(map(self._spread, row)) for row in delay] if unequal else self._spread(delay)
        self._lay_out()

    @staticmethod
    def _spread(delay):
        return tuple(delay) if isinstance(delay, list) else (*[0.0] * delay, 1.0)

    def _link(self, network):
        link = np.array(network["link"], float)
        if link.ndim == 1:
            link = link[:, None, None]
        link = np.broadcast_to(link, (self.steps, self.n, self.n)).copy()
        if "hears" in network:
            for i, others in enumerate(network["hears"]):
                for j in range(self.n):
                    if j + 1 not in others:
                        link[:, i, j] = 0.0
        return link

    def _relations(self, table, tables, states):
        """(i, j) -> per step (H_i, H_j, R): range and angles, differentiated by hand."""
        if table is None:
            return {}
        where = [states.index(name) for name in table["positions"]]
        kinds = {(i, j): table for i in range(self.n) for j in range(self.n) if i != j}
        for pair in table.get("pair", []):
            i, j = (a - 1 for a in pair["agents"])
            for ends in [(i, j), (j, i)][: 2 if pair.get("both_ways", True) else 1]:
                kinds[ends] = pair
        out = {}
        for (i, j), kind in kinds.items():
            if kind.get("none"):
                continue
            out[i, j] = []
            for k in range(1, self.steps + 1):
                ri, rj = (np.array(tables[a]["position"], float) for a in (i, j))
                ri, rj = (r if r.ndim == 1 else r[k - 1] for r in (ri, rj))
                out[i, j].append(self._relation(ri, rj, kind, where, len(states)))
        return out

    @staticmethod
    def _relation(ri, rj, kind, where, d):
        away = rj - ri
        distance = np.sqrt(away @ away)
        rows, variances = [], []
        if "range" in kind:
            rows.append(away / distance)
            variances.append(kind["range"] ** 2)
        if "direction" in kind:
            # any two angles in a plane perpendicular to the line of sight: null space of the line
            across = np.linalg.svd(away[None])[2][1:]
            rows += list(across / distance)
            variances += [kind["direction"] ** 2] * len(across)
        Hj = np.zeros((len(rows), d))
        Hj[:, where] = rows
        return -Hj, Hj, np.diag(variances)

    def told_noise(self, k):
        """R_ij = c_ij L_i L_jᵀ of all sensors."""
        L = [np.linalg.cholesky(at(R, k)) if R.size else R for R in self.R]
        rows = [[self.c[i, j] * L[i] @ L[j].T if self.c[i, j] else np.zeros((len(L[i]), len(L[j])))
                 for j in range(self.n)] for i in range(self.n)]  # fmt: skip
        return np.block(rows)

    def together(self, k):
        """Joint process noise."""
        if self.process is not None:
            return np.array(self.process, float)
        blocks = [at(Q, k) for Q in self.Qs]
        if self.own or self.parallel:
            return block_diag(*blocks)
        return np.block([[blocks[0]] * self.n] * self.n)

    def _lay_out(self):
        """Columns of every noise, Σ of all (true), and the same as a filter with independent δ = 0 is told."""
        self.column, blocks, told, width = {}, [], [], 0

        def add(key, true, claimed=None):
            nonlocal width
            self.column[key] = slice(width, width + len(true))
            width += len(true)
            blocks.append(true)
            told.append(true if claimed is None else claimed)

        add("start", np.block([[self.P0s[0]] * self.n] * self.n) if self.shared else block_diag(*self.P0s))
        for k in range(1, self.steps + 1):
            if k > 1:
                add(("v", k), self.together(k))
                R = self.told_noise(k)
                add(("w", k), R if self.disturbance is None else R + self.disturbance, R)
            for pair, steps in self.related.items():
                add(("s", k, pair), steps[k - 1][2])
        self.Sigma, self.told, self.width = block_diag(*blocks), block_diag(*told), width

    def rows(self, key, rows):
        out = np.zeros((rows.stop - rows.start, self.width + 1))
        out[:, range(*self.column[key].indices(self.width))] = np.eye(self.column[key].stop - self.column[key].start)[
            rows
        ]
        return out

    def first(self, i):
        e = self.rows("start", self.x[i])
        e[:, -1] = self.b[i]
        return Local(self.P0s[i], e, 0 * self.P0s[i])

    def forward(self, i, k, one):
        F = at(self.F[i], k)
        return Local(
            textbook.kalman_predict(one.P, F, at(self.Qs[i], k)), F @ one.e - self.rows(("v", k), self.x[i]), 0 * one.P
        )

    def measured(self, i, k, prior):
        H, R = at(self.H[i], k), at(self.R[i], k)
        K = prior.P @ H.T @ np.linalg.inv(H @ prior.P @ H.T + R)
        left = np.eye(len(prior.P)) - K @ H
        P = left @ prior.P @ left.T + K @ R @ K.T
        return Local(P, left @ prior.e + K @ self.rows(("w", k), self.z[i]), K @ R @ K.T)

    def local(self, i, k, one):
        return self.measured(i, k, self.forward(i, k, one))

    def moments(self, P, e):
        noise, b = e[:, :-1], e[:, -1:]
        A = noise @ self.Sigma @ noise.T
        return P, A, b, A + b @ b.T


# ---------------------------------------------------------------------------------------------- intersections


_WEIGHTS = {}


def intersect(signals):
    """Gains and C of split covariance intersection with the least determinant; signals (A1, A2, H)."""

    def information(w):
        return sum(x * H.T @ np.linalg.inv(A1 + x * A2) @ H for x, (A1, A2, H) in zip(w, signals, strict=True))

    def slope(w):
        C, out = np.linalg.inv(information(w)), []
        for x, (A1, A2, H) in zip(w, signals, strict=True):
            inverse = np.linalg.inv(A1 + x * A2)
            out.append(-np.trace(C @ H.T @ inverse @ A1 @ inverse @ H))
        return np.array(out)

    key = tuple(np.round(part / np.abs(signals[0][0]).max(), 13).tobytes() for one in signals for part in one)
    w = _WEIGHTS[key] if key in _WEIGHTS else _WEIGHTS.setdefault(key, _weights(signals, information, slope))
    C = np.linalg.inv(information(w))
    return [x * C @ H.T @ np.linalg.inv(A1 + x * A2) for x, (A1, A2, H) in zip(w, signals, strict=True)], C


def _weights(signals, information, slope):
    n = len(signals)
    w = np.full(n, 1.0 / n)
    if np.ptp(slope(w)) > 1e-11:
        w = _minimised(lambda w: -np.linalg.slogdet(information(w))[1], slope, w)
        # among equal signals any split of their weight is as good: equal ones are the estimator's choice
        w = np.array(
            [np.mean([x for x, other in zip(w, signals, strict=True) if _equal(one, other)]) for one in signals]
        )
    return w


def _equal(one, other):
    return all(
        a.shape == b.shape and np.allclose(a, b, rtol=1e-10, atol=1e-12) for a, b in zip(one, other, strict=True)
    )


def _minimised(value, slope, start):
    """Brent's method between two weights.  Of more, SLSQP, then Newton's method on those above zero until their slopes
    are equal; the others' must not be lower.
    """
    n = len(start)
    if n == 2:
        return _between(lambda w: np.subtract(*slope(np.array([w, 1 - w]))))
    found = minimize(
        value, start, jac=slope, method="SLSQP", bounds=[(0, 1)] * n, options={"ftol": 1e-15, "maxiter": 500},
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1, "jac": lambda w: np.ones(n)},
    )  # fmt: skip
    w = np.maximum(found.x, 0) / np.maximum(found.x, 0).sum()
    free, g = w > 1e-5, slope(w)
    for _ in range(20):
        w = _polished(slope, np.where(free, w, 0.0) / np.where(free, w, 0.0).sum(), free)
        g = slope(w)
        released = ~free & (g < g[free].min() - 1e-10)
        if (w > 0).sum() == free.sum() and not released.any():
            break
        free = (w > 0) | released
        w = np.where(released, 1e-3, w)
    if np.ptp(g[w > 0]) > 1e-9 * np.abs(g).max() or (g[w == 0] < g[w > 0].min() - 1e-9 * np.abs(g).max()).any():
        raise AssertionError(f"weights {w} with slopes {g} are not the best ones")
    return w


def _between(rise):
    tiny = 1e-12
    if rise(tiny) >= 0 or rise(1 - tiny) <= 0:
        return np.array([0.0, 1.0]) if rise(tiny) >= 0 else np.array([1.0, 0.0])
    w = root_scalar(rise, bracket=(tiny, 1 - tiny), xtol=1e-15, rtol=1e-15).root
    return np.array([w, 1 - w])


def _polished(slope, w, free):
    """Newton on the free weights with least-norm steps and differences for second derivatives."""
    index = np.flatnonzero(free)
    if len(index) == 1:
        return w
    N = np.linalg.svd(np.ones((1, len(index))))[2][1:].T  # directions that keep the sum
    for _ in range(8):
        g, h, columns = slope(w)[index], 1e-6, []
        for direction in N.T:
            move = np.zeros_like(w)
            move[index] = direction * min(h, 0.5 * w[index].min())
            columns.append(N.T @ (slope(w + move) - slope(w - move))[index] / (2 * min(h, 0.5 * w[index].min())))
        step = N @ np.linalg.pinv(np.array(columns).T, rcond=1e-7) @ (N.T @ g)
        if np.abs(step).max() < 1e-13:
            break
        new = w.copy()
        new[index] -= step
        if (new < 0).any():
            w = np.maximum(new, 0)
            return w / w.sum()
        w = new
    return w


# ---------------------------------------------------------------------------------------------- estimators


class Rule:
    """What one estimator does with one step's arrivals: claims and errors of every agent."""

    def __init__(self, truth):
        self.t, self.locals = truth, {}

    def begin(self) -> Any:
        return [self.t.first(i) for i in range(self.t.n)]

    def go_on(self, k, fused, before) -> Any:
        return [self.t.local(i, k, one) for i, one in enumerate(fused)]

    def exchange(self, k, now, heard, late) -> Any:
        """Fused Locals; heard[i] others heard in order, late[i] Locals brought forward that come late."""
        return [self.fuse(k, i, now, heard[i], late[i]) for i in range(self.t.n)]

    def shown(self, k, fused) -> Any:
        return [(one.P, one.e) for one in fused]

    def fuse(self, k, i, now, heard, late) -> Any:
        raise NotImplementedError


class StandAlone(Rule):
    def fuse(self, k, i, now, heard, late):
        return now[i]


class SplitCi(Rule):
    split = True

    def fuse(self, k, i, now, heard, late):
        t, d = self.t, len(now[i].P)
        own = (now[i].P - self.part(now[i]), self.part(now[i]), np.eye(d))
        signals, errors = [own], [now[i].e]
        if t.own:
            for j in (j for j in heard if (i, j) in t.related):
                Hi, Hj, R = t.related[i, j][k - 1]
                fresh = Hj @ self.part(now[j]) @ Hj.T + self.split * R
                signals.append((Hj @ now[j].P @ Hj.T + R - fresh, fresh, Hi))
                errors.append(t.rows(("s", k, (i, j)), slice(0, len(R))) - Hj @ now[j].e)
        else:
            for one in [*(now[j] for j in heard), *late]:
                signals.append((one.P - self.part(one), self.part(one), np.eye(d)))
                errors.append(one.e)
        if len(signals) == 1:
            return now[i]
        gains, C = intersect(signals)
        return Local(C, sum(K @ e for K, e in zip(gains, errors, strict=True)), 0 * C)

    def part(self, one):
        return one.fresh if self.split else 0 * one.P


class PlainCi(SplitCi):
    split = False


class Blender(Rule):
    def go_on(self, k, fused, before):
        return [self.t.local(i, k, one) for i, one in enumerate(before)]

    def fuse(self, k, i, now, heard, late):
        t, members = self.t, [i, *heard]
        e = [t.M[j] @ now[j].e for j in members]
        weights = self.weights([each[:, :-1] for each in e])
        blended = np.sum([B @ each for B, each in zip(weights, e, strict=True)], axis=0)
        return Local(blended[:, :-1] @ t.told @ blended[:, :-1].T, blended, 0)

    def weights(self, e):
        """A tree of two-input blenders: B_2 = (P_1 − P_12)(P_1 + P_2 − P_12 − P_21)⁺."""
        one, D = e[0], len(e[0])
        weights: list[Any] = [np.eye(D)]
        for other in e[1:]:
            P1, P2, P12 = (a @ self.t.told @ b.T for a, b in ((one, one), (other, other), (one, other)))
            B = (P1 - P12) @ np.linalg.pinv(P1 + P2 - P12 - P12.T, rcond=1e-11, hermitian=True)
            weights = [*((np.eye(D) - B) @ W for W in weights), B]
            one = one + B @ (other - one)
        return weights


class JointBlender(Blender):
    def weights(self, e):
        """Least tr B J Bᵀ with Σ B_i = I, by the equations of Lagrange."""
        D, n = len(e[0]), len(e)
        all_e = np.concatenate(e)
        J = all_e @ self.t.told @ all_e.T
        E = np.tile(np.eye(D), (n, 1))
        scale = np.trace(J) / len(J)
        equations = np.block([[J / scale, E], [E.T, np.zeros((D, D))]])
        right = np.concatenate([np.zeros((n * D, D)), np.eye(D)])
        B = np.linalg.lstsq(equations, right, rcond=1e-12)[0][: n * D].T
        return np.split(B, n, axis=1)


class Equivalent(Rule):
    def go_on(self, k, fused, before):
        return [self.t.forward(i, k, one) for i, one in enumerate(fused)]

    def fuse(self, k, i, now, heard, late):
        t = self.t
        members = [j for j in [i, *heard] if t.H[j].shape[-2]]
        if k == 1 or not members:
            return now[i]
        index = np.concatenate([np.arange(t.z[j].start, t.z[j].stop) for j in members])
        R = t.told_noise(k)[np.ix_(index, index)]
        Delta = None if t.disturbance is None else t.disturbance[np.ix_(index, index)]
        A, bound = self.measurement(R, Delta, len(members))
        H, P = at(t.H[members[0]], k), now[i].P
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + bound)
        left = np.eye(len(P)) - K @ H
        w = np.concatenate([t.rows(("w", k), t.z[j]) for j in members])
        return Local(left @ P, left @ now[i].e + K @ A @ w, 0)

    def measurement(self, R, Delta, n):
        E = np.tile(np.eye(len(R) // n), (n, 1))

        def fused(S):
            bound = np.linalg.inv(E.T @ np.linalg.inv(S) @ E)
            return bound @ E.T @ np.linalg.inv(S), bound

        if Delta is None or not Delta.any():
            return fused(R)

        def bounded(epsilon):
            return fused((1 + epsilon) * R + (1 + 1 / epsilon) * Delta)

        def slope(u):
            A = bounded(np.exp(u))[0]
            return np.trace(A @ (R - Delta * np.exp(-2 * u)) @ A.T)

        return bounded(np.exp(root_scalar(slope, bracket=(-20, 20), xtol=1e-15, rtol=1e-15).root))


class Independent(Equivalent):
    def measurement(self, R, Delta, n):
        p = len(R) // n
        own = block_diag(*(R[a : a + p, a : a + p] for a in range(0, len(R), p)))
        return Equivalent.measurement(self, own, None, n)


class Lwin(Rule):
    def fuse(self, k, i, now, heard, late):
        t, P, e = self.t, now[i].P, now[i].e
        for j in heard:
            if t.own and (i, j) not in t.related:
                continue
            d = len(P)
            Hi, Hj, R = t.related[i, j][k - 1] if t.own else (np.eye(d), -np.eye(d), np.zeros((d, d)))
            s = t.rows(("s", k, (i, j)), slice(0, len(R))) if t.own else 0.0
            noise = Hj @ now[j].P @ Hj.T + R
            K = P @ Hi.T @ np.linalg.pinv(Hi @ P @ Hi.T + noise, rcond=1e-11, hermitian=True)
            P, e = (np.eye(d) - K @ Hi) @ P, e + K @ (s - Hj @ now[j].e - Hi @ e)
        return Local(P, e, 0)


class Itns(Rule):
    """One covariance over the stacked state; all that arrived in a step at once, with a pseudo-inverse."""

    def begin(self):
        t = self.t
        start = t.column["start"]
        return Local(t.Sigma[start, start], np.concatenate([t.first(i).e for i in range(t.n)]), 0)

    def go_on(self, k, fused, before):
        t = self.t
        F, Q = block_diag(*(at(F, k) for F in t.F)), t.together(k)
        P, e = textbook.kalman_predict(fused.P, F, Q), F @ fused.e
        e = e - np.concatenate([t.rows(("v", k), x) for x in t.x])
        H, R = block_diag(*(at(H, k) for H in t.H)), block_diag(*(at(R, k) for R in t.R))
        w = np.concatenate([t.rows(("w", k), z) for z in t.z])
        return self.corrected(P, e, H, R, w)

    def corrected(self, P, e, H, R, w):
        K = P @ H.T @ np.linalg.pinv(H @ P @ H.T + R, rcond=1e-11, hermitian=True)
        left = np.eye(len(P)) - K @ H
        return Local(left @ P @ left.T + K @ R @ K.T, left @ e + K @ w, 0)

    def exchange(self, k, now, heard, late):
        t, D = self.t, len(now.P)
        H, R, w = [np.zeros((0, D))], [np.zeros((0, 0))], [np.zeros((0, t.width + 1))]
        for i in range(t.n):
            for j in heard[i]:
                if t.own and (i, j) not in t.related:
                    continue
                d = t.x[i].stop - t.x[i].start
                Hi, Hj, noise = t.related[i, j][k - 1] if t.own else (np.eye(d), -np.eye(d), np.zeros((d, d)))
                row = np.zeros((len(noise), D))
                row[:, t.x[i]], row[:, t.x[j]] = Hi, Hj
                H.append(row)
                R.append(noise)
                w.append(t.rows(("s", k, (i, j)), slice(0, len(noise))) if t.own else np.zeros((d, t.width + 1)))
        H = np.concatenate(H)
        return now if not len(H) else self.corrected(now.P, now.e, H, block_diag(*R[1:]), np.concatenate(w))

    def shown(self, k, fused):
        return [(fused.P[x, x], fused.e[x]) for x in self.t.x]


RULES = {
    "stand-alone": StandAlone,
    "covariance-intersection": PlainCi,
    "split-ci": SplitCi,
    "blender": Blender,
    "joint-blender": JointBlender,
    "equivalent-measurement": Equivalent,
    "independent-measurements": Independent,
    "lwin": Lwin,
    "itns": Itns,
}


# ---------------------------------------------------------------------------------------------- what pedigrees tell


class Graph:
    """One history with the Local Fusion Graph as the thesis tells it, sets of nodes and inverses; or naively."""

    naive = False

    def __init__(self, t, history):
        self.t = t
        starts = [self.pair(t.first(i)) for i in range(t.n)]
        self.locals, self.fused = {"root": starts[0]}, {}
        parents: dict[Any, set[Any]] = {(i, 1): ({"root"} if t.shared else set()) for i in range(t.n)}
        graph = textbook.FusionGraph(parents, lambda node: self.locals[node], self.forward)
        for k, messages in enumerate(history, start=1):
            for i in range(t.n):
                self.locals[i, k] = starts[i] if k == 1 else self.measure(self.forward(self.fused[i, k - 1], k), i, k)
            for i in range(t.n):
                received = {(i, k)} | {(j, sent) for j, receiver, sent in messages if receiver == i}
                if self.naive:
                    pairs = [graph.bring(self.locals[node], node[1], k) for node in sorted(received)]
                    self.fused[i, k] = sum(y for y, _ in pairs), sum(Y for _, Y in pairs)
                else:
                    self.fused[i, k] = graph.info(graph.maximal(received), k)
                parents[i, k + 1] = set(received)

    @staticmethod
    def pair(one):
        Y = np.linalg.inv(one.P)
        return Y @ one.e, Y

    @staticmethod
    def local(pair):
        P = np.linalg.inv(pair[1])
        return Local(P, P @ pair[0])

    def forward(self, pair, k):
        return self.pair(self.t.forward(0, k, self.local(pair)))

    def measure(self, pair, i, k):
        H, R = at(self.t.H[i], k), at(self.t.R[i], k)
        G = H.T @ np.linalg.inv(R)
        return pair[0] + G @ self.t.rows(("w", k), self.t.z[i]), pair[1] + G @ H

    def shown(self, i, k):
        return self.local(self.fused[i, k])[:2]


class Naive(Graph):
    naive = True


class Best:
    """One history with the best linear unbiased estimate from every first estimate and measurement in the pedigree."""

    def __init__(self, t, history):
        self.t, self.known, local = t, {}, {}
        for k, messages in enumerate(history, start=1):
            for i in range(t.n):
                own = {("start", 0 if t.shared else i)} if k == 1 else self.known[i, k - 1] | {(k, i)}
                local[i, k] = frozenset(own)
            for i in range(t.n):
                heard = [local[j, sent] for j, receiver, sent in messages if receiver == i]
                self.known[i, k] = local[i, k].union(*heard)

    def shown(self, i, k):
        t, d = self.t, len(self.t.P0s[0])
        # the state as a linear function of the first one and of the noises since
        of_first, of_noise = {1: np.eye(d)}, {1: np.zeros((d, t.width + 1))}
        for m in range(2, k + 1):
            F = at(t.F[0], m)
            of_first[m], of_noise[m] = F @ of_first[m - 1], F @ of_noise[m - 1] + t.rows(("v", m), t.x[0])
        A, N = [], []
        for m, j in sorted(self.known[i, k], key=str):
            H = np.eye(d) if m == "start" else at(t.H[j], m)
            A.append(H @ of_first[1 if m == "start" else m])
            N.append(t.first(j).e if m == "start" else H @ of_noise[m] + t.rows(("w", m), t.z[j]))
        A, N, wanted = np.concatenate(A), np.concatenate(N), of_noise[k]
        S, c = N[:, :-1] @ t.Sigma @ N[:, :-1].T, N[:, :-1] @ t.Sigma @ wanted[:, :-1].T
        equations = np.block([[S, A], [A.T, np.zeros((d, d))]])
        W = np.linalg.lstsq(equations, np.concatenate([c, of_first[k].T]), rcond=1e-13)[0][: len(S)].T
        e = W @ N - wanted
        return e[:, :-1] @ t.Sigma @ e[:, :-1].T, e


PEDIGREES = {"local-fusion-graph": Graph, "naive": Naive, "optimal": Best}


def of_pedigrees(source, name):
    """The same as `of_histories`, of what the pedigrees tell: every whole history for itself."""
    t = Truth(source)
    for probability, history in textbook.histories(t.n, t.steps, t.architecture, t.link, t.delay):
        network = PEDIGREES[name](t, history)
        for k in range(1, t.steps + 1):
            yield k, probability, [t.moments(*network.shown(i, k)) for i in range(t.n)]


def of_histories(source, name):
    """(claimed, actual, bias, mean square) of every agent after each history, and its probability, step by step."""
    if name in PEDIGREES:
        yield from of_pedigrees(source, name)
        return
    t = Truth(source)
    rule = RULES[name](t)
    likely = {}
    for probability, history in textbook.histories(t.n, t.steps, t.architecture, t.link, t.delay):
        for k in range(1, t.steps + 1):
            key = tuple(map(frozenset, history[:k]))
            likely[key] = likely.get(key, 0.0) + probability
    reached, opened = {(): (None, [])}, {}
    for key, probability in sorted(likely.items(), key=lambda item: len(item[0])):
        k, past = len(key), key[:-1]
        if past not in opened:
            fused, befores = reached[past]
            opened[past] = [*befores, rule.begin() if k == 1 else rule.go_on(k, fused, befores[-1])]
        befores = opened[past]
        heard = [sorted(j for j, r, sent in key[-1] if r == i and sent == k) for i in range(t.n)]
        late = [[_brought(t, i, befores[sent - 1][j], sent, k) for j, r, sent in sorted(key[-1]) if r == i and sent < k]
                for i in range(t.n)]  # fmt: skip
        fused = rule.exchange(k, befores[-1], heard, late)
        reached[key] = fused, befores
        yield k, probability, [t.moments(*each) for each in rule.shown(k, fused)]


def _brought(t, i, one, sent, k):
    for step in range(sent + 1, k + 1):
        one = t.forward(i, step, one)
    return one


def expected(source, name):
    """Expected claimed and actual covariance, bias and mean squared error, each [step][agent]."""
    total: dict[str, Any] = {}
    for k, probability, agents in of_histories(source, name):
        for q, quantity in enumerate(("claimed", "actual", "bias", "rms")):
            found = probability * np.array([moments[q] for moments in agents])
            total.setdefault(quantity, {})
            total[quantity][k] = total[quantity].get(k, 0.0) + found
    return {quantity: np.array([by[k] for k in sorted(by)]) for quantity, by in total.items()}
