"""Covariance recursions of many filters with noises of their own, against what others write for one thread.

`python -m tests.benchmarks.kernel [--quick]`.  Every way gets the noises in the layout that suits it, goes through five
steps of predict and update, and returns the last covariances; answers must agree with the literal stacks.  JAX and Numba
(extra `bench`) compile before they are timed; one that is not installed is named and left out.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

STEPS = 5
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

    return {"Numba": lambda: loop(F, H, Q, R, P0, np.empty_like(P0))}
