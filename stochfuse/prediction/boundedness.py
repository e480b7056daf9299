"""Whether the recursion of (54) stays bounded, with a certificate either way.

Of g(P) = Σ p_S update(F P Fᵀ + Q, what the set S of sensors shows) only what large P do matters.  Since g is concave,

    ĝ(X) = lim g(tX)/t = Σ p_S short_S(F X Fᵀ),    g(P + X) ⪰ g(P) + ĝ(X)

exists for t → ∞: the noises no longer count, and an update leaves the shorted covariance, the largest Z ⪯ Y that is
zero in what S shows (HZ = 0, H the rows of all sensors in S; Anderson and Trapp 1975).  It equals Y − YHᵀ(HYHᵀ)⁺HY.
ĝ is monotone, concave, homogeneous of degree one, and the least of linear maps:

    ĝ(X) = min over gains K of L_K(X),    L_K(X) = Σ p_S A_S X A_Sᵀ,    A_S = (I − K_S H_S) F

Exactly one of these holds, and each is proved by what it names:

* *Bounded*: L_K(X) ≺ X for some gains K and X ≻ 0.  Then, the noises that these gains let in being
  N = Σ p_S [(I − K_S H_S) Q (I − K_S H_S)ᵀ + K_S R_S K_Sᵀ], P = tX has g(P) ⪯ L_K(P) + N ⪯ P for a large t: what begins
  below P stays below it, and since t is any larger number, every beginning is bounded.
* *Growing*: ĝ(X) ⪰ λX for some X ⪰ 0 that is not 0, and λ ≥ 1.  Then what begins above cX is above c λᵏ X after k
  steps; for λ = 1, too, it grows if the process noise reaches X, by g(0) in every step.

For if there is no such P, Y ← ĝ(Y) + I from 0 increases without end, ĝ(Y) ⪰ Y − I along it, and Y/‖Y‖ has a limit
X with ĝ(X) ⪰ X (ĝ, a minimum of continuous maps, jumps only upwards in a limit).  This is the linear matrix
inequality of Sinopoli et al. 2004, for any number of sensors; with one sensor of one component its threshold is
1 − Π|λᵢ|⁻² over the unstable modes, with one that shows the state 1 − max|λᵢ|⁻².

The gains are found by policy iteration for the least spectral radius ρ(L_K): X = (ρ(1+ε) − L_K)⁻¹I, K ← the best for X.

What is certified.  Bounded: g(P) ⪯ P with the gains written down, by more than `ROUNDING` in units of P's own
deviations.  Growing: X = V M Vᵀ on an invariant subspace of F, F V = V A, and ĝ(X) ⪰ X as r×r matrices, by more than
`ROUNDING` and than what V may be off: the rounding in F V = V A over the separation of A from the rest of F.  So a
subspace that rounding alone makes invariant (an eigenvector beside a Jordan block's) proves nothing.  What is zero by
structure, a direction that a sensor does not show, is zero to `STRUCTURE` of the matrix's size: there a
certificate holds for a sensor within rounding of the one given.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from stochfuse.engines.mean_field import Case, UnlikeCase
from stochfuse.kalman.kernel import Estimate, at_step, corrected, gain, predict
from stochfuse.kalman.packed import basis, triangle
from stochfuse.scenario.model import Sensor

ROUNDING = 1e-13
"""By how much an inequality of matrices has to hold, in units of deviations: more than rounding can do."""
STRUCTURE = 1e-10
"""Share of a matrix's size below which an entry is zero by structure."""
ITERATIONS = 60
"""Of the policy iteration, at most: it takes three to ten."""
SLACK = 1e-9
"""ε of the policy iteration: its spectral radius is the least one up to the square of this."""
SMALL = 1e-3
"""Spectral radius below which a better one is not looked for: it is enough to be below 1."""
GAP = 0.1
"""Share of the size before it below which an eigenvalue may begin the null space of a direction of growth."""
NEGLIGIBLE = 1e-8
"""Share of a state or of a matrix below which a direction, or the separation of two spectra, is none."""
RIDGE = 1e-14
"""Noise, relative to the signal, that keeps the gains of exact measurements finite."""


class Recursion(NamedTuple):
    """One receiver's recursion in coordinates z of its own, its outcomes merged by what they show.

    Parameters
    ----------
    F, Q : (d, d) transition and process noise.
    H : (outcomes, d, d) a basis of what each outcome shows, and rows of zeros.
    R : (outcomes, d, d) noise of those rows, at most; 1 in the rows of zeros.
    p : (outcomes,) probabilities.
    T : (d, d) the state is x = T z; to begin with the states' deviations.
    doubt : by how much more than rounding F may be wrong.
    """

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    p: np.ndarray
    T: np.ndarray
    doubt: float = 1.0

    def covariance(self, P: np.ndarray) -> np.ndarray:
        """Return the covariance of x from that of z."""
        return self.T @ P @ self.T.T


class Bounded(NamedTuple):
    """A proof that the recursion is bounded: g(P) ⪯ (1 − margin) P.

    Parameters
    ----------
    P : (d, d) a covariance below which the recursion stays once it is there.
    gains : (outcomes, d, d) gains that prove it.
    margin : smallest eigenvalue of P − g(P), in units of P's deviations.
    """

    P: np.ndarray
    gains: np.ndarray
    margin: float


class Growing(NamedTuple):
    """A proof that the recursion has no bound: ĝ(X) ⪰ λX.

    Parameters
    ----------
    X : (d, d) the direction.
    rank : its rank.
    factor : λ ≥ 1.
    """

    X: np.ndarray
    rank: int
    factor: float


def recursions(case: Case | UnlikeCase) -> list[Recursion]:
    """Return the recursion of every item of a case, at its second step."""
    F, Q = at_step(case.model.F, 2), at_step(case.model.Q, 2)
    unit = np.sqrt(np.diagonal(case.P0 + Q))
    unit = np.where(unit > 0, unit, 1.0)
    if isinstance(case, Case):  # what else may come shows no more than the first measurement does
        sensors, counts = (case.sensor,), np.array([[1], [0]])
        nothing = np.broadcast_to(case.arrivals[1].nothing, case.items)
        weights = np.stack([1.0 - nothing, nothing])
    else:
        sensors, counts, weights = case.sensors, case.counts, case.weights[1]
    H, R, of = _shown(sensors, counts.shape, (counts > 0).tobytes(), unit.tobytes())
    p = np.zeros((len(H), case.items))
    np.add.at(p, of, weights)
    F, Q = F * unit / unit[:, None], Q / np.outer(unit, unit)
    return [Recursion(F, Q, H[q > 0], R[q > 0], q[q > 0], np.diag(unit)) for q in p.T]


@lru_cache(maxsize=32)
def _shown(
    sensors: tuple[Sensor, ...], shape: tuple[int, int], seen: bytes, units: bytes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bases of what outcomes show, the noise of the rows, and which of these each outcome has; see `Recursion`.

    Outcomes that show the same are one, with the sum of their noises: at least that of each.

    Parameters
    ----------
    shape, seen : (outcomes, kinds) whether an outcome has a measurement of a kind of sensor.
    units : (d,) units of the states.
    """
    unit = np.frombuffer(units)
    patterns, pattern_of = np.unique(np.frombuffer(seen, dtype=bool).reshape(shape), axis=0, return_inverse=True)
    d, bases, noises, index, of = len(unit), [], [], {}, []
    for pattern in patterns:
        H, R = _basis([s.at(2) for s, there in zip(sensors, pattern, strict=True) if there], unit)
        same = index.setdefault(np.rint(1e7 * H.T @ H).astype(int).tobytes(), len(bases))
        if same == len(bases):
            bases.append(np.concatenate([H, np.zeros((d - len(H), d))]))
            noises.append(np.diag((np.arange(d) >= len(H)).astype(float)))
        turned = bases[same][: len(H)] @ H.T  # the same space, perhaps by another basis
        noises[same][: len(H), : len(H)] += turned @ R @ turned.T
        of.append(same)
    return np.array(bases), np.array(noises), np.array(of)[pattern_of.ravel()]


def _basis(sensors: list[Sensor], unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal rows that span what sensors show, and the noise with which they show it."""
    rows, noises = [np.zeros((0, len(unit)))], []
    for s in sensors:
        size = np.linalg.norm(s.H * unit, axis=1)
        there = size > 0
        rows.append((s.H * unit)[there] / size[there, None])
        noises.append((s.R / np.outer(np.where(there, size, 1.0), np.where(there, size, 1.0)))[np.ix_(there, there)])
    H = np.concatenate(rows)
    if not len(H):
        return H, np.zeros((0, 0))
    left, size, right = np.linalg.svd(H, full_matrices=False)
    rank = int((size > STRUCTURE * size[0]).sum())
    T, first = left[:, :rank].T / size[:rank, None], 0
    R = np.zeros((rank, rank))
    for noise in noises:
        part = T[:, first : first + len(noise)]
        R, first = R + part @ noise @ part.T, first + len(noise)
    return right[:rank], R


def hidden_mode(F: np.ndarray, H: np.ndarray) -> complex | None:
    """Return an eigenvalue of F, on or outside the unit circle, that H does not show (Hautus), or None.

    Parameters
    ----------
    F, H : (d, d) and (p, d), in units of the states' deviations.
    """
    H = H / np.maximum(np.linalg.norm(H, axis=1, keepdims=True), 1e-300)
    for eigenvalue in np.linalg.eigvals(F):
        if abs(eigenvalue) >= 1.0 - 1e-9:
            hautus = np.concatenate([eigenvalue * np.eye(len(F)) - F, H])
            if np.linalg.svd(hautus, compute_uv=False)[-1] < STRUCTURE * max(1.0, abs(eigenvalue)):
                return eigenvalue
    return None


def growing_mode(case: UnlikeCase) -> tuple[complex, float] | None:
    """Return an eigenvalue of F whose mode alone must grow in some item, and by how much in a step; or None.

    The direction of growth is X = w wᴴ of an eigenvector w, so that ĝ(X) ⪰ p |λ|² X, p the probability that nothing
    that arrives shows w.  It is no more than a glance, but at all items.
    """
    F, Q, weights = at_step(case.model.F, 2), at_step(case.model.Q, 2), case.weights[1]
    for eigenvalue, w in zip(*_eigen(F), strict=True):
        if abs(eigenvalue) < 1.0:
            continue
        seen = np.array([np.linalg.norm(s.at(2).H @ w) > STRUCTURE * np.linalg.norm(s.at(2).H) for s in case.sensors])
        unseen = (case.counts[:, seen] == 0).all(axis=1)
        growth = float(weights[unseen].sum(axis=0).max()) * abs(eigenvalue) ** 2
        certain = 1.0 - 1e-12 if np.linalg.eigvalsh(Q)[0] > 0 else 1.0 + 1e-12
        if growth >= certain:
            return (eigenvalue.real if eigenvalue.imag == 0 else eigenvalue), growth
    return None


def _eigen(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues of F, and its eigenvectors as rows."""
    eigenvalues, vectors = np.linalg.eig(F)
    return eigenvalues, vectors.T


def decide(of: Recursion, gains: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Return the least spectral radius ρ of L_K, up to rounding, and the gains K that have it.

    Parameters
    ----------
    gains : where to begin; default: at what is best for X = I.
    """
    d = len(of.F)
    K = _best(of, np.eye(d)) if gains is None or len(gains) != len(of.p) else gains
    least, found = np.inf, K
    for _ in range(ITERATIONS):
        L = _linear(of, K)
        ρ = float(np.abs(np.linalg.eigvals(L)).max())
        if not ρ < least * (1.0 - 1e-14):
            break
        least, found = ρ, K
        X = _over(L, ρ, d)
        if X is None:
            break
        K = _best(of, X)
    return least, found


def _over(L: np.ndarray, ρ: float, d: int) -> np.ndarray | None:
    """(λ − L)⁻¹I for a λ just above the spectral radius, which is known as well as rounding lets it be; or None."""
    for slack in (SLACK, 1e-6, 1e-3):
        X = _resolvent(L, max(ρ * (1.0 + slack), SMALL), np.eye(d))
        if X is not None and _least(X, X) > 0:
            return X
    return None


def _best(of: Recursion, X: np.ndarray) -> np.ndarray:
    """Gains K_S that make Σ p_S A_S X A_Sᵀ least."""
    Y = of.F @ X @ of.F.T
    signal = np.einsum("oij,jk,oik->oi", of.H, Y, of.H)
    R = RIDGE * signal + ~of.H.any(axis=-1)
    R = np.where(R > 0, R, 1.0)
    return gain(Y, of.H, R[:, :, None] * np.eye(len(Y)))


def _linear(of: Recursion, K: np.ndarray) -> np.ndarray:
    """L_K as a matrix on upper triangles."""
    d = len(of.F)
    rows, columns, _ = triangle(d)
    A = (np.eye(d) - K @ of.H) @ of.F
    flat = A.reshape(-1, d * d)
    full = ((flat.T * of.p) @ flat).reshape(d, d, d, d).swapaxes(1, 2).reshape(d * d, d * d)
    return full[rows * d + columns] @ basis(d).reshape(-1, d * d).T


def _resolvent(L: np.ndarray, λ: float, W: np.ndarray) -> np.ndarray | None:
    """(λ − L)⁻¹W, or None where it is beyond rounding."""
    rows, columns, place = triangle(len(W))
    try:
        X = np.linalg.solve(λ * np.eye(len(L)) - L, W[rows, columns])[place]
    except np.linalg.LinAlgError:
        return None
    return X if np.isfinite(X).all() else None


def stable(of: Recursion, gains: np.ndarray) -> bool:
    """Whether ρ(L_K) < 1 of some gains: X − L_K(X) = I has a solution X ≻ 0, which no error of an eigenvalue blurs."""
    return _below(_linear(of, gains), np.eye(len(of.F))) is not None


def bounded(of: Recursion, gains: np.ndarray) -> Bounded | None:
    """Return a proof that a recursion is bounded, by some gains; None if they give none."""
    L, W = _linear(of, gains), np.eye(len(of.F))
    X = _below(L, W)
    for _ in range(2):
        if X is None:
            return None
        # what is added should be as large as X in each state, so that the proof holds in units of its deviations
        W = np.diag(np.diagonal(X) / np.diagonal(X).max())
        X = _below(L, W)
    if X is None:
        return None
    N = _after(of, gains, np.zeros_like(X)) / np.sqrt(np.outer(np.diagonal(W), np.diagonal(W)))
    P = 2.0 * max(float(np.linalg.eigvalsh(N).max()), 1.0) * X
    margin = _least(P - _after(of, gains, P), P)
    return Bounded(of.covariance(P), gains, margin) if margin >= ROUNDING * of.doubt else None


def conditioned(of: Recursion, gains: np.ndarray) -> Recursion | None:
    """Return the recursion in coordinates in which large covariances are no longer than broad; None if they are so.

    What grows in a direction that is shown but faintly is much larger along it than across, and proofs in units of the
    states' deviations then have less to stand on than rounding.
    """
    X = _dominant(of, gains)
    variance = np.maximum(np.diagonal(X), NEGLIGIBLE**2 * np.diagonal(X).max())
    if variance.min() < 1e-2 * variance.max():
        # powers of two: nothing is rounded, and what is zero stays so
        return rebased(of, np.diag(np.exp2(np.rint(0.5 * np.log2(variance)))))
    size, V = np.linalg.eigh(X)
    there = size[size > NEGLIGIBLE * size.max()]
    if there.min() > 1e-3 * there.max():
        return None
    return rebased(of, V * np.sqrt(np.maximum(size, 0.1 * there.min()) / there.max()))


def rebased(of: Recursion, C: np.ndarray) -> Recursion:
    """Return the recursion in other coordinates, z = C (new z)."""
    back = np.linalg.inv(C)
    F = back @ of.F @ C
    turned = np.count_nonzero(C) > len(C)
    doubt = np.linalg.norm(np.abs(back) @ np.abs(of.F) @ np.abs(C)) / np.linalg.norm(F) if turned else 1.0
    return of._replace(F=F, Q=back @ of.Q @ back.T, H=of.H @ C, T=of.T @ C, doubt=of.doubt * max(float(doubt), 1.0))


def _below(L: np.ndarray, W: np.ndarray) -> np.ndarray | None:
    """X ≻ 0 with X − L(X) = W, or None."""
    X = _resolvent(L, 1.0, W)
    return X if X is not None and _least(X, X) > 0 else None


def _after(of: Recursion, K: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return the next covariance with some gains, L_K(P) + N: at least g(P)."""
    prior = predict(Estimate(None, P), of.F, of.Q).P
    return np.tensordot(of.p, corrected(prior, K, of.H, of.R), axes=1)


def _least(D: np.ndarray, P: np.ndarray) -> float:
    """Smallest eigenvalue of D in units of the deviations of P."""
    variance = np.diagonal(P)
    if not (variance > 0).all():
        return -np.inf
    sd = np.sqrt(variance)
    return float(np.linalg.eigvalsh(D / np.outer(sd, sd)).min())


def growing(of: Recursion, gains: np.ndarray) -> Growing | None:
    """Return a proof that a recursion has no bound, from the best gains; None if none is found."""
    for V in _directions(of, gains):
        there = np.linalg.norm(V, axis=1) > NEGLIGIBLE
        if of.F[np.ix_(~there, there)].any():
            there[:] = True
        found = _on_subspace(of, there, V[there])
        if found is not None:
            return Growing(of.covariance(found[0]), V.shape[1], found[1])
    return None


def _directions(of: Recursion, gains: np.ndarray) -> Iterator[np.ndarray]:
    """Bases of nearly invariant subspaces of F in which something may grow: of what grows most, and single modes."""
    size, V = np.linalg.eigh(_dominant(of, gains))
    size, V = size[::-1], V[:, ::-1]
    for rank in range(1, len(size) + 1):
        if rank == len(size) or size[rank] <= GAP * size[rank - 1]:
            yield V[:, :rank]
    for eigenvalue, w in zip(*_eigen(of.F), strict=True):
        unseen = np.abs(of.H @ w).max(axis=1) < STRUCTURE
        if eigenvalue.imag >= 0 and of.p[unseen].sum() * abs(eigenvalue) ** 2 > 1.0:
            parts = [w.real, w.imag] if eigenvalue.imag > 0 else [w.real]
            yield np.linalg.qr(np.stack(parts, axis=1))[0]


def _dominant(of: Recursion, gains: np.ndarray) -> np.ndarray:
    """X that L_K multiplies by its spectral radius, by inverse iteration from I; trace 1."""
    L = _linear(of, gains)
    λ = max(float(np.abs(np.linalg.eigvals(L)).max()) * (1.0 + SLACK), SMALL)
    X = np.eye(len(of.F))
    for _ in range(3):
        further = _resolvent(L, λ, X)
        if further is None:
            break
        X = further / np.trace(further)
    return X


def _invariant(F: np.ndarray, V: np.ndarray, doubt: float) -> tuple[np.ndarray, float]:
    """Orthonormal basis of the invariant subspace of F next to one that is nearly so, and how far it may be off.

    By Newton's method; the error is that of F V = V A over the separation of A from the rest of F (Stewart 1973).
    """
    d, r = V.shape
    if r == d:
        return np.eye(d), 0.0
    size, separation = float(np.linalg.norm(F)), np.inf
    for _ in range(4):
        U = np.linalg.qr(np.concatenate([V, np.eye(d)], axis=1))[0]
        turned = U.T @ F @ U
        slope = np.kron(turned[r:, r:], np.eye(r)) - np.kron(np.eye(d - r), turned[:r, :r].T)
        separation = float(np.linalg.svd(slope, compute_uv=False)[-1])
        if separation <= NEGLIGIBLE * size:
            return V, np.inf
        step = np.linalg.solve(slope, -turned[r:, :r].ravel()).reshape(-1, r)
        V = np.linalg.qr(U[:, :r] + U[:, r:] @ step)[0]
    left = np.linalg.norm(F @ V - V @ (V.T @ F @ V)) + 1e-15 * d * size * doubt
    return V, 2.0 * left / separation


def _on_subspace(of: Recursion, there: np.ndarray, V: np.ndarray) -> tuple[np.ndarray, float] | None:
    """X = V M Vᵀ in some of the states, which F does not leave, and λ ≥ 1 with ĝ(X) ⪰ λX; or None."""
    F = of.F[np.ix_(there, there)]
    V, off = _invariant(F, V, of.doubt)
    A = V.T @ F @ V
    H, shown = _restricted(of.H[:, :, there], V)
    part = Recursion(A, A, H, np.zeros_like(H), of.p, V)
    M = _dominant(part, decide(part)[1])
    M = _dominant(part, _best(part, M)) if _least(M, M) > ROUNDING else M
    if not _least(M, M) > ROUNDING:
        return None
    sd = np.sqrt(np.diagonal(M))
    root = sd[:, None] * np.linalg.cholesky(M / np.outer(sd, sd))
    left, wrong = _shorted(H, shown, A @ root)
    grown = np.tensordot(part.p, left, axes=1)
    moved = 4.0 * len(A) * np.linalg.norm(F) * np.linalg.norm(A * sd / sd[:, None]) * off * sd.max() / sd.min()
    if not _least(grown - M, M) >= ROUNDING * of.doubt * wrong + moved:
        return None
    X, share = np.zeros_like(of.F), np.linalg.solve(root, grown)
    X[np.ix_(there, there)] = V @ M @ V.T
    return X, float(np.linalg.eigvalsh(np.linalg.solve(root, share.T)).min())


def _restricted(H: np.ndarray, V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What outcomes show of a subspace: (outcomes, r, r) orthonormal rows, then rows of zeros, and how many."""
    _, size, rows = np.linalg.svd(H @ V)
    there = np.zeros(rows.shape[:2], dtype=bool)
    there[:, : size.shape[1]] = size > STRUCTURE
    return rows * there[..., None], there.sum(axis=1)


def _shorted(H: np.ndarray, shown: np.ndarray, L: np.ndarray) -> tuple[np.ndarray, float]:
    """short_S(L Lᵀ) of every outcome, and by how much more than rounding it may be wrong."""
    _, size, rows = np.linalg.svd(H @ L)
    unseen = np.arange(len(L)) >= shown[:, None]
    free = L @ (np.swapaxes(rows, -1, -2) * unseen[:, None, :])
    smallest = np.where(unseen, np.inf, size).min(axis=1)
    worst = np.where(np.isfinite(smallest), size[:, 0] / smallest, 1.0).max()
    return free @ np.swapaxes(free, -1, -2), float(worst)
