"""Covariance recursions of many filters with noises of their own, against what others write for one thread.

`python -m tests.benchmarks.kernel [--quick] [--sizes] [--most FILTERS]`.  Every way gets the noises in the layout that suits it, goes
through five steps of predict and update, and returns the last covariances; answers must agree with the literal stacks.  JAX
and Numba (extra `bench`) compile before they are timed, and so do our filters (extra `compiled`), at every size unless
STOCHFUSE_COMPILED says otherwise; what is not installed is named and left out.  Times are CPU time, the ways in turns,
so that other work on the machine hits all alike; the lower quartile is shown.  What is small is done in a row, as it is
where it matters.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import stochfuse as sf
from stochfuse.kalman.compiled import SWITCH
from tests.oracles import textbook

STEPS = 5
OURS, MANY = "stochfuse, kalman.covariances", "stochfuse, predict_many (checked, every step)"
HEADINGS = ("work", *("stacks", "arrays", "stochfuse"), "over stacks", "over arrays")
SIZES = ((1, 1), (2, 1), (2, 2), (4, 1), (4, 2), (4, 4), (6, 2), (6, 6), (9, 3), (9, 6), (15, 3), (15, 6))
LARGEST, LONGEST, FEWEST = 20_000_000, 5.0, 3
"""Numbers in all covariances of a row over sizes (4 GB with all copies), CPU seconds after which it ends, rounds."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
Run = Callable[[], np.ndarray]


class Work(NamedTuple):
    """F (d, d) and H (p, d) of all filters, or (items, ., .) of each; each one's Q, R and P0 (items, ., .)."""

    F: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    P0: np.ndarray

    @property
    def own(self) -> bool:
        """Whether every filter has a model of its own."""
        return self.F.ndim == 3


def work(items: int, d: int, p: int, own: bool = False) -> Work:
    """A chain of d integrators, every (d/p)th of them measured; of each filter slightly different if `own`."""
    rng = np.random.default_rng(0)
    F, H = np.eye(d) + 0.1 * np.eye(d, k=1), np.eye(d)[np.arange(p) * d // p]
    roots = (rng.normal(size=(items, size, size + 1)) for size in (d, p, d))
    Q, R, P0 = (A @ A.swapaxes(1, 2) + 0.1 * np.eye(A.shape[1]) for A in roots)
    if own:
        F, H = (M * rng.uniform(0.9, 1.1, size=(items, 1, 1)) for M in (F, H))
    return Work(F, H, Q, R, P0)


def stacks(given: Work) -> Run:
    """The textbook's lines on (items, d, d)."""

    def run() -> np.ndarray:
        F, H, Q, R, P = given
        Ft, Ht, one = F.swapaxes(-1, -2), H.swapaxes(-1, -2), np.eye(F.shape[-1])
        for _ in range(STEPS):
            prior = F @ P @ Ft + Q
            K = prior @ Ht @ np.linalg.inv(H @ prior @ Ht + R)
            P = (one - K @ H) @ prior
        return P

    return run


def arrays(given: Work) -> Run:
    """Struct of arrays by hand: entries first, filters last, everything written out over the entries."""
    F, H, Q, R, P0 = (M if M.ndim == 2 else np.ascontiguousarray(M.transpose(1, 2, 0)) for M in given)
    d, p = len(F), len(H)

    def times(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """B Aᵀ, (rows of B, rows of A, filters)."""
        return np.matmul(A, B) if A.ndim == 2 else np.einsum("ijb,kjb->kib", A, B)

    def run() -> np.ndarray:
        P = P0
        for _ in range(STEPS):
            prior = times(F, times(F, P).swapaxes(0, 1)) + Q
            PH = times(H, prior)
            S = times(H, PH.swapaxes(0, 1)) + R
            if p == 1:
                K = PH / S
            elif p == 2:
                (a, b), (_, c) = S
                of = 1.0 / (a * c - b * b)
                K = np.stack([(c * PH[:, 0] - b * PH[:, 1]) * of, (a * PH[:, 1] - b * PH[:, 0]) * of], axis=1)
            else:
                K = PH.copy()
                for i in range(p):  # Gauss: S is ours, and definite
                    for j in range(i + 1, p):
                        factor = S[i, j] / S[i, i]
                        S[j, i + 1 :] -= factor * S[i, i + 1 :]
                        K[:, j] -= factor * K[:, i]
                for i in reversed(range(p)):
                    for j in range(i + 1, p):
                        K[:, i] -= S[i, j] * K[:, j]
                    K[:, i] /= S[i, i]
            P = prior
            for i in range(d):
                for q in range(p):
                    P[i] -= K[i, q] * PH[:, q]
        return P

    return lambda: run().transpose(2, 0, 1)


def jax_ways(given: Work) -> dict[str, Run]:
    """Jitted, a filter at a time and mapped over all, and with the filters in the last axis."""
    if importlib.util.find_spec("jax") is None:
        return {}
    jax: Any = importlib.import_module("jax")
    jnp: Any = importlib.import_module("jax.numpy")
    jax.config.update("jax_enable_x64", True)
    p = given.H.shape[-2]

    def solved(S: Any, B: Any) -> Any:
        """S⁻¹B of definite S, of matrices or of entries that are arrays over the filters: written out."""
        S, B = [[S[i, j] for j in range(p)] for i in range(p)], [B[i] for i in range(p)]
        for i in range(p):
            for j in range(i + 1, p):
                factor = S[i][j] / S[i][i]
                S[j] = [S[j][k] - factor * S[i][k] if k > i else S[j][k] for k in range(p)]
                B[j] = B[j] - factor * B[i]
        for i in reversed(range(p)):
            for j in range(i + 1, p):
                B[i] = B[i] - S[i][j] * B[j]
            B[i] = B[i] / S[i][i]
        return jnp.stack(B)

    def one(F: Any, H: Any, Q: Any, R: Any, P: Any) -> Any:
        for _ in range(STEPS):
            prior = F @ P @ F.T + Q
            HP = H @ prior
            P = prior - HP.T @ solved(HP @ H.T + R, HP)
        return P

    def last(F: Any, H: Any, Q: Any, R: Any, P: Any) -> Any:
        def product(A: Any, B: Any) -> Any:
            """A B, summed term by term, so that it can be fused with what comes after."""
            return sum(A[:, j, None] * B[None, j] for j in range(A.shape[1]))

        F, H = (M if M.ndim == 3 else M[..., None] for M in (F, H))
        for _ in range(STEPS):
            prior = product(product(F, P), F.swapaxes(0, 1)) + Q
            HP = product(H, prior)
            P = prior - product(HP.swapaxes(0, 1), solved(product(HP, H.swapaxes(0, 1)) + R, HP))
        return P

    axes = (0 if given.own else None,) * 2 + (0, 0, 0)
    mapped, entries = jax.jit(jax.vmap(one, axes)), jax.jit(last)
    first = [jnp.asarray(M) for M in given]
    moved = [jnp.asarray(M if M.ndim == 2 else M.transpose(1, 2, 0)) for M in given]
    return {
        "JAX, vmap": lambda: np.asarray(mapped(*first)),
        "JAX, batch last": lambda: np.asarray(entries(*moved)).transpose(2, 0, 1),
    }


def numba_ways(given: Work) -> dict[str, Run]:
    """A compiled loop over the filters, matrices in it written out; the dimensions are known when it is compiled."""
    if importlib.util.find_spec("numba") is None:
        return {}
    numba: Any = importlib.import_module("numba")
    F, H, Q, R, P0 = given
    d, p, own, steps = F.shape[-1], H.shape[-2], given.own, STEPS
    F, H = (M if own else M[None] for M in (F, H))

    @numba.njit(fastmath=True)
    def loop(F, H, Q, R, P0, out):
        P, X, HP, S, Y = np.empty((d, d)), np.empty((d, d)), np.empty((p, d)), np.empty((p, p)), np.empty((p, d))
        for n in range(len(P0)):
            f, h = F[n if own else 0], H[n if own else 0]
            P[:] = P0[n]
            for _ in range(steps):
                for i in range(d):
                    for j in range(d):
                        x = 0.0
                        for k in range(d):
                            x += f[i, k] * P[k, j]
                        X[i, j] = x
                for i in range(d):
                    for j in range(i, d):
                        x = Q[n, i, j]
                        for k in range(d):
                            x += X[i, k] * f[j, k]
                        P[i, j] = P[j, i] = x
                for i in range(p):
                    for j in range(d):
                        x = 0.0
                        for k in range(d):
                            x += h[i, k] * P[k, j]
                        HP[i, j] = Y[i, j] = x
                for i in range(p):
                    for j in range(p):
                        x = R[n, i, j]
                        for k in range(d):
                            x += HP[i, k] * h[j, k]
                        S[i, j] = x
                # S = L D Lᵀ; P − Σ y yᵀ/δ with the rows y of L⁻¹HP
                for i in range(p):
                    for j in range(i + 1, p):
                        factor = S[i, j] / S[i, i]
                        for k in range(j, p):
                            S[j, k] -= factor * S[i, k]
                        for k in range(d):
                            Y[j, k] -= factor * Y[i, k]
                    for j in range(d):
                        y = Y[i, j] / S[i, i]
                        for k in range(j, d):
                            P[j, k] -= y * Y[i, k]
                for i in range(d):
                    for j in range(i):
                        P[i, j] = P[j, i]
            out[n] = P
        return out

    @numba.njit
    def plain(F, H, Q, R, P0, out):
        for n in range(len(P0)):
            f, h, P = F[n if own else 0], H[n if own else 0], P0[n]
            for _ in range(steps):
                prior = f @ P @ f.T + Q[n]
                HP = h @ prior
                P = prior - HP.T @ np.linalg.solve(HP @ h.T + R[n], HP)
            out[n] = P
        return out

    return {
        "Numba, matrix by matrix": lambda: plain(F, H, Q, R, P0, np.empty_like(P0)),
        "Numba, written out": lambda: loop(F, H, Q, R, P0, np.empty_like(P0)),
    }


def ours(given: Work) -> dict[str, Run]:
    """The kernel; and, where filters share F and H, the batch of scenarios of one agent, with its checks."""
    F, H, Q, R, P0 = given

    def run() -> np.ndarray:
        return sf.kalman.covariances(P0, F, Q, H, R, STEPS)

    def by_numpy() -> np.ndarray:
        before = os.environ.get(SWITCH, "")
        os.environ[SWITCH] = "0"
        try:
            return run()
        finally:
            os.environ[SWITCH] = before

    ways: dict[str, Run] = {OURS: run, "stochfuse, the same by NumPy alone": by_numpy}
    if not given.own:
        model = {"F": F.tolist(), "H": H.tolist(), "Q": Q[0].tolist(), "R": R[0].tolist()}
        network = {"agents": 1, "steps": STEPS + 1, "link": 0.0}  # step 1 is the exchange of first estimates
        scenario = sf.scenario(model=model, initial=P0[0].tolist(), network=network)
        ways[MANY] = lambda: sf.predict_many(scenario, Q=Q, R=R, P=P0).moments.P[:, -1, 0]
    return ways


def measured(ways: dict[str, Run], units: int, rounds: int) -> dict[str, float]:
    """CPU nanoseconds of a unit, after the answers were compared."""
    expected = ways["NumPy, stacks"]()
    for name, run in ways.items():
        found = textbook.scaled_error(np.asarray(run()), expected)
        if not found < 1e-9:
            raise SystemExit(f"kernel: {name}: expected agreement to 1e-9, got a difference of {found:.3g}")
    times: dict[str, list[float]] = {name: [] for name in ways}
    begin, in_a_row = time.process_time(), max(1, 100_000 // units)
    for done in range(rounds):
        if done >= FEWEST and time.process_time() - begin > LONGEST:
            break
        for name, run in ways.items():
            start = time.process_time()
            for _ in range(in_a_row):
                run()
            times[name].append(time.process_time() - start)
    return {name: float(np.quantile(each, 0.25)) / in_a_row / units * 1e9 for name, each in times.items()}


def at_the_limit(own: bool, quick: bool) -> tuple[str, list[tuple[str, ...]]]:
    """Four states, two measured: every way, the time of a filter's step, and over the kernel's."""
    items, rounds = (500, 1) if quick else (10_000, 60)
    given = work(items, 4, 2, own)
    ways = {"NumPy, stacks": stacks(given), "NumPy, struct of arrays": arrays(given)}
    found = measured(ways | jax_ways(given) | numba_ways(given) | ours(given), items * STEPS, rounds)
    models = "F and H of each filter's own" if own else "common F and H"
    title = (
        f"{items:,} filters of 4 states, 2 measured, {STEPS} steps, own Q, R, P; {models}; CPU time of a filter-step"
    )
    return title, [(name, f"{ns:.0f} ns", f"{ns / found[OURS]:.2f}") for name, ns in found.items()]


def sizes(quick: bool, most: int) -> list[tuple[str, ...]]:
    """Stacks and struct of arrays against the kernel, over states, measurements and filters."""
    rows = []
    for d, p in SIZES[:2] if quick else SIZES:
        for size in (100,) if quick else (100, 1000, 10_000, 100_000, 1_000_000):
            items = min(size, LARGEST // d**2)
            if items > most or items < size // 10:
                continue
            print(f"kernel: {d} states, {p} measured, {items:,} filters", file=sys.stderr)
            given = work(items, d, p)
            ways = {"NumPy, stacks": stacks(given), "NumPy, struct of arrays": arrays(given), OURS: ours(given)[OURS]}
            found = list(measured(ways, items * STEPS, 1 if quick else 60).values())
            name = f"{d} states, {p} measured, {items:,} filters"
            ratios = (f"{found[2] / found[0]:.2f}", f"{found[2] / found[1]:.2f}")
            rows.append((name, *(f"{ns:.3g} ns" for ns in found), *ratios))
    return rows


def absent() -> list[str]:
    """Which compilers are not installed."""
    return [name for name in ("jax", "numba", "llvmlite") if importlib.util.find_spec(name) is None]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.kernel", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few filters, one round: only that it runs and agrees")
    parser.add_argument("--sizes", action="store_true", help="only the table over sizes: ten minutes, 4 GB")
    parser.add_argument("--most", type=int, default=1_000_000, help="filters, of the table over sizes")
    given = parser.parse_args()
    quick = given.quick
    from tests.benchmarks.__main__ import show

    for own in () if given.sizes else (False, True):
        title, rows = at_the_limit(own, quick)
        show(title, ("way", "time", "over stochfuse's"), rows)
    show("Over sizes, common F and H; CPU time of a filter-step", HEADINGS, sizes(quick, given.most))
    for name in absent():
        print(
            f"kernel: {name} is not installed and was left out; it comes with: pip install '.[bench]'", file=sys.stderr
        )


if __name__ == "__main__":
    # libraries read it when they are loaded: begin again
    if os.environ.get("OMP_NUM_THREADS") != "1" or SWITCH not in os.environ:
        flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        os.execve(
            sys.executable,
            [sys.executable, "-m", "tests.benchmarks.kernel", *sys.argv[1:]],
            {**os.environ, **dict.fromkeys(THREADS, "1"), "XLA_FLAGS": flags, SWITCH: os.environ.get(SWITCH, "1")},
        )
    main()
