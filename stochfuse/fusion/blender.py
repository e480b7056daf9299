"""The blender: several filters on one platform, their estimates joined with known cross-covariance.

Filters 1, 2, … run side by side, each on its own state x_i with its own model; none hears of the others.  Shaped into
the full state, ŝ_i = M_i x̂_i + s_i, they are blended (Layh and Gebre-Egziabher 2017, appendix A, (19)–(30)):

    x̂ = B_1 ŝ_1 + B_2 ŝ_2,  B_1 + B_2 = I,  least variance:
    B_2 = (P_1 − P_12)(P_1 + P_2 − P_12 − P_21)⁺        P = P_1 − B_2 (P_1 − P_21)

P_12 comes from the filters' own recursion, see `stochfuse.fusion.parallel`.

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

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.algebra import NUMPY
from stochfuse.kalman.checks import covariance_fault

RANK = 1e-12
"""Largest eigenvalue of the differences' covariance, in units of the filters' variances, that is taken for zero."""

Tree = int | tuple["Tree", "Tree"]


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
            f"P1, P2, P12: expected three matrices of one size, got {size_of(P1)}, {size_of(P2)} and {size_of(P12)}"
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
        raise UsageError(f"{wanted} one of {size_of(A)}")
    fault = covariance_fault(A)
    if fault is not None:
        raise UsageError(f"{wanted} {fault}")
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
        raise UsageError(f"joint: expected {filters} filters' blocks of one size, got a {size_of(joint)} matrix")
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


def size_of(A: np.ndarray) -> str:
    """Return the shape in words."""
    return "×".join(map(str, np.shape(A))) or "no dimension"
