"""Filters that run side by side, and the joint covariance of all their errors.

Nothing is fed back into a filter, so that what each does is known beforehand, and with it how their errors hang
together (Layh and Gebre-Egziabher 2017, appendix A):

    P_12 ← (I − K_1H_1)(F_1 P_12 F_2ᵀ + Q_12)(I − K_2H_2)ᵀ + K_1 R_12 K_2ᵀ

with the process noise Q_12 and the measurement noise R_12 that two filters have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.blender import semidefinite, size_of
from stochfuse.kalman.algebra import NUMPY
from stochfuse.kalman.kernel import Estimate, at_step, gain, predict

Cross = Mapping[tuple[int, int], np.ndarray]


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
        joint[k] = NUMPY.symmetric(cross_covariance(joint[k - 1], (F[k], F[k]), Q[k], (K, K), (H[k], H[k]), R[k]))
    return ParallelFilters(joint, tuple(gains), M, np.concatenate(parts["s"], axis=-2))


Pair = tuple[np.ndarray, np.ndarray]
"""A matrix of the one filter, and of the other."""


def cross_covariance(P12: np.ndarray, F: Pair, Q12: np.ndarray, K: Pair, H: Pair, R12: np.ndarray) -> np.ndarray:
    """Carry the cross-covariance of two filters' errors through one step, prediction and update.

    Parameters
    ----------
    P12 : (..., d_1, d_2) after the previous step.
    F, Q12 : transitions (F_1, F_2) and the process noises' cross-covariance (..., d_1, d_2).
    K, H, R12 : gains (K_1, K_2), measurement matrices (H_1, H_2), and the measurement noises' cross-covariance
        (..., p_1, p_2).

    Returns
    -------
    numpy.ndarray
        (..., d_1, d_2) after the update.  With F1 = F2 = F and so on, a filter's own covariance for any gain.
    """
    (F1, F2), (K1, K2), (H1, H2) = F, K, H
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
        raise UsageError(f"{path}: expected a matrix, or one per step, got an array of {size_of(array)}")
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
