"""The blender: several filters on one platform, their estimates joined with known cross-covariance.

Filters 1, 2, … run side by side, each on its own state x_i with its own model; none hears of the others.  Shaped into
the full state, ŝ_i = M_i x̂_i + s_i, they are blended (Layh and Gebre-Egziabher 2017, appendix A, (19)–(30)):

    x̂ = B_1 ŝ_1 + B_2 ŝ_2,  B_1 + B_2 = I,  least variance:
    B_2 = (P_1 − P_12)(P_1 + P_2 − P_12 − P_21)⁺        P = P_1 − B_2 (P_1 − P_21)
    P_12 ← (I − K_1H_1)(F_1 P_12 F_2ᵀ + Q_12)(I − K_2H_2)ᵀ + K_1 R_12 K_2ᵀ

B_i is unbiased only if every shaped estimate is, E[ŝ_i] = x: what M_i leaves out must be known through s_i.

More than two filters: a tree of two-input blenders (the source's form), or all at once, the B = [B_1 B_2 …] with
Σ B_i = I that minimises B J Bᵀ, J the joint covariance of the shaped errors.  Any such B is B_0 − X T, where B_0 takes
each state from one filter and T J Tᵀ is the covariance of the filters' differences from it, so that

    B = B_0 − B_0 J Tᵀ (T J Tᵀ)⁺ T

which for two filters is the formula above.  B_0 takes each state from the filter that knows it best: a useless filter
then leaves no rounding behind in the blend of good ones.

Where differences are singular.  T J Tᵀ is scaled by the variances whose differences it holds, and eigenvalues up to
`RANK` are taken for zero: the filters agree there to a millionth of their deviations, and either serves.  Any symmetric
generalised inverse gives the same P, because B_0 J Tᵀ has its rows in the range of T J Tᵀ; the weights are then not
unique.

Departures from the source.  P is evaluated as B J Bᵀ, which equals the form printed above for the optimal B and is
positive semi-definite, and what B truly leaves, for any other.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.algebra import NUMPY
from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.kalman import Estimate, gain, predict
from stochfuse.model import at_step

RANK = 1e-12
"""Largest eigenvalue of the differences' covariance, in units of the filters' variances, that is taken for zero."""
INDEFINITE = -1e-9
"""Most negative eigenvalue, scaled to unit variances, that is taken for rounding of a singular covariance."""

Tree = int | tuple["Tree", "Tree"]
Cross = Mapping[tuple[int, int], np.ndarray]


class Blend(NamedTuple):
    """Weights B_1, B_2, … (each (..., D, D), their sum the identity) and the covariance P (..., D, D) they leave."""

    weights: tuple[np.ndarray, ...]
    P: np.ndarray


def blend(P1: np.ndarray, P2: np.ndarray, P12: np.ndarray) -> Blend:
    """Blend two estimates of one state.

    Parameters
    ----------
    P1, P2 : (..., D, D) their error covariances.
    P12 : (..., D, D) their cross-covariance E[e_1 e_2ᵀ].

    Returns
    -------
    Blend
        Weights B_1, B_2 and the covariance of the blend.

    Raises
    ------
    UsageError
        Where the three do not fit together or are no covariance of two errors.
    """
    if not P1.shape[-2:] == P2.shape[-2:] == P12.shape[-2:]:
        raise UsageError(
            f"P1, P2, P12: expected three matrices of one size, got {_size(P1)}, {_size(P2)} and {_size(P12)}"
        )
    P1, P2, P12 = np.broadcast_arrays(P1, P2, P12)
    upper = np.concatenate([P1, P12], axis=-1)
    below = np.concatenate([NUMPY.transpose(P12), P2], axis=-1)
    return blend_all(np.concatenate([upper, below], axis=-2), 2)


def blend_all(joint: np.ndarray, filters: int, arrived: Collection[int] | None = None) -> Blend:
    """Blend any number of estimates of one state at once: the best that any weights can do.

    Parameters
    ----------
    joint : (..., n·D, n·D) covariance of all shaped errors, may be singular.
    filters : how many estimates n there are.
    arrived : zero-based indices of those that are there; the others get the weight zero.  All by default.

    Returns
    -------
    Blend
        One weight for each filter and the covariance of the blend.

    Raises
    ------
    UsageError
        If the joint covariance is none or cannot be cut into n parts, or nothing arrived.
    """
    joint, D, there = _joint(joint, filters, arrived)
    taken = np.concatenate([np.arange(i * D, (i + 1) * D) for i in there])
    B = np.zeros((*joint.shape[:-2], D, filters * D))
    B[..., taken] = _least(joint[..., taken[:, None], taken], len(there))
    return _blend(B, joint, filters)


def blend_tree(
    joint: np.ndarray, filters: int, tree: Tree | None = None, arrived: Collection[int] | None = None
) -> Blend:
    """Blend in a tree of two-input blenders, each the best for its two inputs, their correlation carried exactly.

    Parameters
    ----------
    joint, filters, arrived : as for `blend_all`.  A blender with one input missing hands the other on.
    tree : nested pairs of zero-based filter indices, such as ((0, 1), 2); by default that fold from the left.

    Returns
    -------
    Blend
        One weight for each filter (a leaf), the product of the weights above it, and the covariance at the root.

    Raises
    ------
    UsageError
        As for `blend_all`, and if the tree does not hold each filter once.
    """
    joint, D, there = _joint(joint, filters, arrived)
    if tree is None:
        tree = 0
        for i in range(1, filters):
            tree = (tree, i)
    leaves = _leaves(tree)
    if sorted(leaves) != list(range(filters)):
        got = ", ".join(map(str, leaves))
        raise UsageError(f"tree: expected each of {', '.join(map(str, range(filters)))} once, got {got}")
    return _blend(_branch(_pruned(tree, there), joint, D), joint, filters)


def semidefinite(name: str, A: np.ndarray) -> np.ndarray:
    """Return stacks of covariances, exactly symmetric.

    Raises
    ------
    UsageError
        If one is not square, not finite, not symmetric or not positive semi-definite; singular ones pass.
    """
    A = np.asarray(A, dtype=float)
    wanted = f"{name}: expected a positive semi-definite matrix, got"
    if A.ndim < 2 or A.shape[-1] != A.shape[-2]:
        raise UsageError(f"{wanted} one of {_size(A)}")
    if not np.isfinite(A).all():
        raise UsageError(f"{wanted} a value that is not finite (NaN or infinity)")
    diagonal = np.diagonal(A, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = A / (scale[..., :, None] * scale[..., None, :])
    if A.size and np.abs(scaled - NUMPY.transpose(scaled)).max() > -INDEFINITE:
        raise UsageError(f"{wanted} an asymmetric one")
    smallest = np.linalg.eigvalsh(NUMPY.symmetric(scaled)).min(initial=np.inf)
    if smallest < INDEFINITE:
        raise UsageError(f"{wanted} an indefinite one (smallest eigenvalue, scaled to unit variances, {smallest:.3g})")
    return NUMPY.symmetric(A)


def references(J: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """B_0, (..., D, n·D), each state from the filter with its least variance; T, (..., n·D, n·D), the differences."""
    D = J.shape[-1] // n
    variances = np.diagonal(J, axis1=-2, axis2=-1).reshape(*J.shape[:-2], n, D)
    chosen = variances.argmin(axis=-2)[..., None, :] == np.arange(n)[:, None]
    start = (chosen[..., None, :, :] * np.eye(D)[:, None, :]).reshape(*J.shape[:-2], D, n * D)
    return start, np.tile(start, (n, 1)) - np.eye(n * D)


def least_covariance(B: np.ndarray, T: np.ndarray, J: np.ndarray) -> np.ndarray:
    """B − B J Tᵀ (T J Tᵀ)⁺ T: among all B − X T the one with the least covariance."""
    Tt = NUMPY.transpose(T)
    variances = (T * T) @ np.diagonal(J, axis1=-2, axis2=-1)[..., None]
    values, vectors, scale = spectrum(T @ J @ Tt, variances[..., 0])
    inverted = np.divide(1.0, values, out=np.zeros_like(values), where=values > RANK)
    vectors = vectors * scale[..., :, None]
    return B - ((B @ J @ Tt) @ vectors * inverted[..., None, :]) @ NUMPY.transpose(vectors) @ T


def spectrum(A: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of A scaled to units in which `variances` are one, and that scale."""
    scale = 1.0 / np.sqrt(np.where(variances > 0, variances, 1.0))
    values, vectors = np.linalg.eigh(NUMPY.symmetric(A) * scale[..., :, None] * scale[..., None, :])
    return values, vectors, scale


def _joint(joint: np.ndarray, filters: int, arrived: Collection[int] | None) -> tuple[np.ndarray, int, list[int]]:
    """The joint covariance, checked; the size D of the full state; the indices of what arrived."""
    joint = semidefinite("joint", joint)
    if filters < 1 or joint.shape[-1] % filters or not joint.shape[-1]:
        raise UsageError(f"joint: expected {filters} filters' blocks of one size, got a {_size(joint)} matrix")
    there = sorted(set(range(filters) if arrived is None else arrived))
    if not there or there[0] < 0 or there[-1] >= filters:
        raise UsageError(f"arrived: expected at least one of the filters 0 to {filters - 1}, got {there}")
    return joint, joint.shape[-1] // filters, there


def _blend(B: np.ndarray, joint: np.ndarray, filters: int) -> Blend:
    """Blend of the weights B side by side."""
    return Blend(tuple(np.split(B, filters, axis=-1)), NUMPY.symmetric(B @ joint @ NUMPY.transpose(B)))


def _least(J: np.ndarray, n: int) -> np.ndarray:
    """Weights side by side, (..., D, n·D), that minimise B J Bᵀ with Σ B_i = I."""
    start, T = references(J, n)
    return least_covariance(start, T, J)


def _leaves(tree: Tree) -> list[int]:
    """Return the filters of a tree from left to right."""
    if isinstance(tree, int | np.integer) and not isinstance(tree, bool):
        return [int(tree)]
    if not isinstance(tree, tuple | list) or len(tree) != 2:
        raise UsageError(f"tree: expected nested pairs such as ((0, 1), 2), got {tree!r}")
    return _leaves(tree[0]) + _leaves(tree[1])


def _pruned(tree: Tree, there: list[int]) -> Any:
    """Return the tree of what arrived: a blender with one input missing hands the other on, None if both are."""
    if not isinstance(tree, tuple | list):
        return tree if tree in there else None
    left, right = (_pruned(part, there) for part in tree)
    return right if left is None else left if right is None else (left, right)


def _branch(tree: Tree, joint: np.ndarray, D: int) -> np.ndarray:
    """Weights (..., D, n·D) on all filters of what leaves a branch."""
    if not isinstance(tree, tuple | list):
        leaf = np.eye(D, joint.shape[-1], k=int(tree) * D)
        return np.broadcast_to(leaf, (*joint.shape[:-2], *leaf.shape))
    both = np.concatenate([_branch(part, joint, D) for part in tree], axis=-2)
    return _least(NUMPY.symmetric(both @ joint @ NUMPY.transpose(both)), 2) @ both


def _size(A: np.ndarray) -> str:
    """Return the shape in words."""
    return "×".join(map(str, np.shape(A))) or "no dimension"


class ParallelFilter(NamedTuple):
    """One of the filters that run side by side; every matrix constant or per step, with the step on the first axis.

    F (d, d), H (p, d), Q (d, d), R (p, p): its model.  P0 (d, d): its error covariance at step 1, constant.
    M (D, d), s (D, 1): its shape in the full state, x = M x_i + s; identity and zero where None.
    """

    F: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    P0: np.ndarray
    M: np.ndarray | None = None
    s: np.ndarray | None = None


class ParallelFilters(NamedTuple):
    """Filters run side by side, over all steps.

    joint : (steps, Σd, Σd) covariance of all filters' errors in their own states, after each step's update.
    gains : per filter (steps, d, p), zero at step 1.
    M : (steps, n·D, Σd), the filters' mappings as one block-diagonal matrix.
    s : (steps, n·D, 1), their offsets one below the other.
    """

    joint: np.ndarray
    gains: tuple[np.ndarray, ...]
    M: np.ndarray
    s: np.ndarray

    def shaped(self, step: int) -> np.ndarray:
        """Joint covariance (n·D, n·D) of the errors of the shaped estimates at a step, counted from 1."""
        M = at_step(self.M, step)
        return NUMPY.symmetric(M @ at_step(self.joint, step) @ M.T)


def parallel_filters(
    filters: Sequence[ParallelFilter],
    steps: int,
    Q_cross: Cross | None = None,
    R_cross: Cross | None = None,
    P0_cross: Cross | None = None,
) -> ParallelFilters:
    """Run filters side by side and carry the joint covariance of their errors.

    Step 1 holds the initial errors; from step 2 on every filter predicts and updates.

    Parameters
    ----------
    filters : the filters; their matrices are true of their own states.
    steps : number of steps.
    Q_cross, R_cross, P0_cross : cross-covariances of the process noises, measurement noises and initial errors: (i, j),
        zero-based, to a matrix of filter i's rows and filter j's columns, constant or per step.  Zero where left out.

    Returns
    -------
    ParallelFilters
        The joint covariance and the gains of each step.

    Raises
    ------
    UsageError
        For matrices that do not fit, or noises that are no joint covariance.
    NoAnswerError
        If a filter has no gain, its innovation being singular.
    """
    if not filters or steps < 1:
        raise UsageError(f"parallel_filters: expected at least one filter and one step, got {len(filters)} and {steps}")
    parts = _read(filters, steps)
    F, H, M = (_blocks(parts[name]) for name in ("F", "H", "M"))
    Q, R, P0 = (
        semidefinite(f"{name} of all filters", _blocks(parts[name], _crossed(name, cross, parts[name])))
        for name, cross in (("Q", Q_cross), ("R", R_cross), ("P0", P0_cross))
    )
    joint = np.broadcast_to(P0, (steps, *P0.shape[1:])).copy()
    gains = [np.zeros((steps, *NUMPY.transpose(h).shape[-2:])) for h in parts["H"]]
    for k in range(1, steps):
        for i, own in enumerate(_slices(parts["F"])):
            prior = predict(Estimate(None, joint[k - 1, own, own]), parts["F"][i][k], parts["Q"][i][k]).P
            gains[i][k] = _gain(i, k, prior, parts["H"][i][k], parts["R"][i][k])
        K = _blocks([g[k : k + 1] for g in gains])[0]
        joint[k] = NUMPY.symmetric(cross_covariance(joint[k - 1], F[k], F[k], Q[k], K, H[k], K, H[k], R[k]))
    return ParallelFilters(joint, tuple(gains), M, np.concatenate(parts["s"], axis=-2))


def cross_covariance(
    P12: np.ndarray,
    F1: np.ndarray,
    F2: np.ndarray,
    Q12: np.ndarray,
    K1: np.ndarray,
    H1: np.ndarray,
    K2: np.ndarray,
    H2: np.ndarray,
    R12: np.ndarray,
) -> np.ndarray:
    """Carry the cross-covariance of two filters' errors through one step, prediction and update.

    Parameters
    ----------
    P12 : (..., d_1, d_2) after the previous step.
    F1, F2, Q12 : transitions and the process noises' cross-covariance (..., d_1, d_2).
    K1, H1, K2, H2, R12 : gains, measurement matrices, and the measurement noises' cross-covariance (..., p_1, p_2).

    Returns
    -------
    numpy.ndarray
        (..., d_1, d_2) after the update.  With F1 = F2 = F and so on, a filter's own covariance for any gain.
    """
    A1, A2 = NUMPY.identity_like(K1) - K1 @ H1, NUMPY.identity_like(K2) - K2 @ H2
    prior = F1 @ P12 @ NUMPY.transpose(F2) + Q12
    return A1 @ prior @ NUMPY.transpose(A2) + K1 @ R12 @ NUMPY.transpose(K2)


def _read(filters: Sequence[ParallelFilter], steps: int) -> dict[str, list[np.ndarray]]:
    """Every filter's matrices by name, each of shape (steps, rows, columns); P0 (1, d, d)."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ParallelFilter._fields}
    D = np.shape(filters[0].F if filters[0].M is None else filters[0].M)[-2]
    for i, one in enumerate(filters):
        d, p = np.shape(one.F)[-1], np.shape(one.H)[-2]
        M = np.eye(d) if one.M is None else one.M
        s = np.zeros((D, 1)) if one.s is None else one.s
        wanted = {"F": (d, d), "H": (p, d), "Q": (d, d), "R": (p, p), "P0": (d, d), "M": (D, d), "s": (D, 1)}
        for (name, shape), value in zip(wanted.items(), (*one[:5], M, s), strict=True):
            path = f"filters[{i}].{name}"
            array = _stack(path, value, shape, 1 if name == "P0" else steps)
            parts[name].append(semidefinite(path, array) if name in ("Q", "R", "P0") else array)
    return parts


def _stack(path: str, value: np.ndarray, shape: tuple[int, int], steps: int) -> np.ndarray:
    """One matrix for each step, the same one where it is constant."""
    array = np.asarray(value, dtype=float)
    if array.ndim not in (2, 3):
        raise UsageError(f"{path}: expected a matrix, or one per step, got an array of {_size(array)}")
    for axis, what in ((-2, "row"), (-1, "column")):
        if array.shape[axis] != shape[axis]:
            n = shape[axis]
            raise UsageError(f"{path}: expected {n} {what}{'' if n == 1 else 's'}, got {array.shape[axis]}")
    if array.ndim == 3 and len(array) < steps:
        raise UsageError(f"{path}: expected one matrix for each of the {steps} steps, got {len(array)}")
    if not np.isfinite(array).all():
        raise UsageError(f"{path}: expected finite numbers, got a value that is not finite (NaN or infinity)")
    return np.broadcast_to(array if array.ndim == 2 else array[:steps], (steps, *shape))


def _crossed(name: str, cross: Cross | None, own: list[np.ndarray]) -> dict[tuple[int, int], np.ndarray]:
    """The cross-covariances, each for every step and once in either order."""
    blocks: dict[tuple[int, int], np.ndarray] = {}
    for (i, j), value in (cross or {}).items():
        path = f"{name}_cross[({i}, {j})]"
        if i == j or not (0 <= i < len(own) and 0 <= j < len(own)):
            raise UsageError(f"{path}: expected two different filters of 0 to {len(own) - 1}, got {i} and {j}")
        if (i, j) in blocks:
            raise UsageError(f"{path}: expected one of ({i}, {j}) and ({j}, {i}), got both")
        block = _stack(path, value, (own[i].shape[-1], own[j].shape[-1]), len(own[i]))
        blocks[i, j], blocks[j, i] = block, NUMPY.transpose(block)
    return blocks


def _blocks(diagonal: Sequence[np.ndarray], cross: Mapping[tuple[int, int], np.ndarray] | None = None) -> np.ndarray:
    """Blocks down the diagonal, and beside it, of one matrix for each step; as many steps as the blocks have."""
    rows, columns = _slices(diagonal, -2), _slices(diagonal, -1)
    whole = np.zeros((len(diagonal[0]), rows[-1].stop, columns[-1].stop))
    for i, block in enumerate(diagonal):
        whole[:, rows[i], columns[i]] = block
    for (i, j), block in (cross or {}).items():
        whole[:, rows[i], columns[j]] = block
    return whole


def _slices(blocks: Sequence[np.ndarray], axis: int = -1) -> list[slice]:
    """Return where each block lies when they are set one after the other."""
    ends = np.cumsum([block.shape[axis] for block in blocks]).tolist()
    return [slice(end - block.shape[axis], end) for end, block in zip(ends, blocks, strict=True)]


def _gain(i: int, k: int, prior: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Filter i's gain at step k + 1."""
    try:
        return gain(prior, H, R)
    except np.linalg.LinAlgError:
        raise NoAnswerError(
            f"filters[{i}]: expected a gain at step {k + 1}, got a singular innovation covariance H P Hᵀ + R"
        ) from None
