"""Cooperative measurements between two nodes, and the two ways to take them in: LWIN and ITNS.

Nodes i and j at r_i and r_j, u = (r_j − r_i)/d the line of sight from i to j, d its length, T an orthonormal basis of
the directions perpendicular to u (in the plane one column, u turned left):

    range        y = d                            H_j = uᵀ
    direction    y = u, as angles along T         H_j = Tᵀ/d       (bearing in the plane, two angles in space)
    both         range above direction
    difference   y = r_i − r_j                    H_j = −I

and H_i = −H_j throughout.  A direction's noise is σ²I in angle, so that no result depends on the choice of T or on the
frame.  A difference with both standard deviations has R = σ_r²uuᵀ + d²σ_d²TTᵀ and carries exactly the information of
"both"; with σ_range alone its noise is alike in every direction, and the nodes may coincide.

Attitude that is not known: where the observer measures in its own frame, and that is turned by a small φ (from where it
is believed to be; in the plane an angle to the left, in space a vector of three about the common axes), what it sees is
turned by −φ.  So the rows above have, over φ,

    range        0             direction, in the plane   −1        in space   Tᵀ [u×]        difference  y   [y×]φ

(`attitude`).  Clocks: time transfer, there and back, measures the difference of two clock errors whatever the places,

    time         y = b_i − b_j                  H_i = 1, H_j = −1

(`time_transfer`); and any relation that is linear in two states is given by its H_i, H_j and R (`linear`).

Local, with immediate neighbours (LWIN): the neighbour's error is taken for noise,

    R̃ = H_j P_jj H_jᵀ + R        P_i ← update(P_ii, H_i, R̃)

which ignores the correlations that it creates.  Integrated total network solution (ITNS): one covariance P of all
nodes, (27), which a cooperative measurement with H = (… H_i … H_j …) updates as any measurement does.

Source: patent "Cooperative estimator", equations (10)–(18) (LWIN), (23)–(26) (range), (27) (ITNS).  Departures: its
(17) is the short form (I − KH)P, here the kernel's Joseph form; its LOS equations (21), (22) and (28) include the
node's attitude, here an addition to a direction resolved in the common frame; its text gives the gain of ITNS with the
composite covariance (13) of LWIN; here it acts on the joint covariance, as the claims have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.checks import covariance_fault
from stochfuse.kalman.kernel import Estimate, update

KINDS = ("range", "direction", "both", "difference")
COINCIDENT = 1e-9
"""Distance, in units of the nodes' distance from the origin, at which rounding leaves nothing of the direction."""
NEGLIGIBLE = 1e-12
"""Share of the variances that went into an innovation's variance at which it is taken for rounding of zero."""
ROUNDING = 4e-15
"""The same where R is not singular but less than the rounding of H P Hᵀ: only what is rounding itself is left out."""


class Relation(NamedTuple):
    """A cooperative measurement linearised: y = H_i x_i + H_j x_j + s, s ~ N(0, R).

    H_i, H_j of shape (..., p, d) over the positions (or the states that they were spread over), R of shape (p, p) or
    (..., p, p).  Units: m for range and difference, rad for direction, where positions are in m.
    """

    H_i: np.ndarray
    H_j: np.ndarray
    R: np.ndarray


def coincident(r_i: Any, r_j: Any) -> np.ndarray:
    """Whether nodes at r_i and r_j (..., D) are too close for a direction between them; shape (...)."""
    r_i, r_j = _places(r_i, r_j)
    farthest = np.maximum(np.linalg.norm(r_i, axis=-1), np.linalg.norm(r_j, axis=-1))
    return np.linalg.norm(r_j - r_i, axis=-1) <= COINCIDENT * farthest


def observe(kind: str, r_i: Any, r_j: Any) -> np.ndarray:
    """What nodes at r_i and r_j (..., D) would measure without noise, as a column.

    Returns
    -------
    (..., m, 1) array
        "range": the distance; "direction": the D components of the unit vector from i to j; "both": the distance, then
        the unit vector; "difference": r_i − r_j.

    Raises
    ------
    UsageError
        If the kind is unknown, the positions do not fit together, or the nodes coincide and there is no direction.
    """
    _check_kind(kind)
    if kind == "difference":
        r_i, r_j = _places(r_i, r_j)
        return (r_i - r_j)[..., None]
    distance, u = _line_of_sight(r_i, r_j)
    parts = {"range": [distance], "direction": [u], "both": [distance, u]}
    return np.concatenate(parts[kind], axis=-1)[..., None]


def residual(kind: str, measured: Any, r_i: Any, r_j: Any) -> np.ndarray:
    """What was measured less what nodes at r_i and r_j would measure, in the rows of `relation`.

    Parameters
    ----------
    measured : (..., m, 1), as `observe` returns it.

    Returns
    -------
    (..., p, 1) array
        A direction's residual is the angle in rad from the predicted to the measured line of sight: in (−π, π] in the
        plane, resolved along the tangent basis in space (of an opposite direction all along its first vector).
    """
    expected, measured = observe(kind, r_i, r_j), np.asarray(measured, dtype=float)
    if kind in ("range", "difference"):
        return measured - expected
    along = measured[..., 1:, :] if kind == "both" else measured
    u = _line_of_sight(r_i, r_j)[1]
    across = np.swapaxes(_tangent(u), -1, -2) @ along
    sine = np.linalg.norm(across, axis=-2, keepdims=True)
    angle = np.arctan2(sine, u[..., None, :] @ along)
    heading = np.where(sine > 0, across / np.where(sine > 0, sine, 1.0), np.eye(across.shape[-2])[:, :1])
    turned = angle * heading
    if kind == "direction":
        return turned
    return np.concatenate([measured[..., :1, :] - expected[..., :1, :], turned], axis=-2)


def relation(
    kind: str, r_i: Any, r_j: Any, sigma_range: float | None = None, sigma_direction: float | None = None
) -> Relation:
    """Linearise a cooperative measurement about the nominal places of its two nodes.

    Parameters
    ----------
    kind : "range", "direction", "both" or "difference".
    r_i, r_j : (..., 2) or (..., 3) nominal places of observer and neighbour; leading axes (steps, say) broadcast.
    sigma_range : standard deviation of the distance, in the unit of the places.
    sigma_direction : standard deviation of each angle, in rad.

    Returns
    -------
    Relation
        H_i and H_j of shape (..., p, D); p is 1, D − 1, D and D for the four kinds.

    Raises
    ------
    UsageError
        If the kind is unknown, a standard deviation that the kind takes is missing or not positive (or one is given
        that it does not take), the places do not fit together, or the nodes coincide.
    """
    _check_kind(kind)
    _check_sigmas(kind, sigma_range, sigma_direction)
    if kind == "difference" and sigma_range is not None and sigma_direction is None:
        r_i, r_j = _places(r_i, r_j)
        one = np.broadcast_to(np.eye(r_i.shape[-1]), (*r_i.shape, r_i.shape[-1])).copy()
        return Relation(one, -one, sigma_range**2 * np.eye(r_i.shape[-1]))
    distance, u = _line_of_sight(r_i, r_j)
    T = _tangent(u)
    rows, sigmas = [], []
    if sigma_range is not None:
        rows.append(u[..., None, :])
        sigmas.append(sigma_range)
    if sigma_direction is not None:
        rows.append(np.swapaxes(T, -1, -2) / distance[..., None])
        sigmas += [sigma_direction] * T.shape[-1]
    H_j, R = np.concatenate(rows, axis=-2), np.diag(np.square(sigmas))
    if kind == "difference":
        # the inverse of "both": along the line of sight as far as the range errs, across it as far as the angles do
        to_places = -np.concatenate([u[..., None], T * distance[..., None]], axis=-1)
        H_j = np.broadcast_to(-np.eye(u.shape[-1]), H_j.shape).copy()
        R = (to_places * np.diagonal(R)) @ np.swapaxes(to_places, -1, -2)
    return Relation(-H_j, H_j, R)


def attitude(kind: str, r_i: Any, r_j: Any) -> np.ndarray:
    """How a measurement in the observer's own frame changes as that frame turns: H over its attitude's errors.

    Parameters
    ----------
    kind, r_i, r_j : as for `relation`, in whose rows this is; of a difference by its components.

    Returns
    -------
    (..., p, 1) or (..., p, 3) array
        In the plane over the angle by which the observer is turned left, in space over the small rotation about the
        common axes, rad.
    """
    _check_kind(kind)
    if kind == "difference":
        r_i, r_j = _places(r_i, r_j)
        return _turned(r_i - r_j)
    _, u = _line_of_sight(r_i, r_j)
    rows = np.swapaxes(_tangent(u), -1, -2) @ _turned(u)
    along = np.zeros((*rows.shape[:-2], 1, rows.shape[-1]))
    return np.concatenate({"range": [along], "direction": [rows], "both": [along, rows]}[kind], axis=-2)


def _turned(y: np.ndarray) -> np.ndarray:
    """What −φ × y is of φ: [y×] in space, a column in the plane."""
    if y.shape[-1] == 2:
        return np.stack([y[..., 1:], -y[..., :1]], axis=-2)
    x, y_, z = (y[..., k] for k in range(3))
    none = np.zeros_like(x)
    return np.stack([none, -z, y_, z, none, -x, -y_, x, none], axis=-1).reshape(*y.shape, 3)


def time_transfer(sigma: float) -> Relation:
    """Difference of two clock errors, b_i − b_j, of a standard deviation in their unit; over the clock errors alone.

    Raises
    ------
    UsageError
        If the standard deviation is not positive.
    """
    if not 0 < sigma < np.inf:
        raise UsageError(f"sigma: expected a positive standard deviation, got {sigma}")
    return Relation(np.eye(1), -np.eye(1), np.array([[float(sigma) ** 2]]))


def linear(H_i: Any, H_j: Any, R: Any) -> Relation:
    """Any relation that is linear in the two states, y = H_i x_i + H_j x_j + s with s ~ N(0, R).

    Parameters
    ----------
    H_i, H_j : (p, d_i) and (p, d_j).
    R : (p, p) positive semi-definite.

    Raises
    ------
    UsageError
        If the shapes do not fit together, or R is no covariance.
    """
    H_i, H_j, R = (np.asarray(M, dtype=float) for M in (H_i, H_j, R))
    p = H_i.shape[0] if H_i.ndim == 2 else -1
    if H_j.ndim != 2 or H_j.shape[0] != p or R.shape != (p, p):
        raise UsageError(
            f"H_i, H_j, R: expected shapes (p, d_i), (p, d_j) and (p, p), got {H_i.shape}, {H_j.shape} and {R.shape}"
        )
    fault = covariance_fault(R)
    if fault is not None or not (np.isfinite(H_i).all() and np.isfinite(H_j).all()):
        raise UsageError(f"H_i, H_j, R: expected finite matrices and a covariance R, got {fault or 'others'}")
    return Relation(H_i, H_j, R)


def together(*parts: Relation) -> Relation:
    """Several relations between the same two states measured at once, with independent noises, one above the other."""
    leading = np.broadcast_shapes(*(part.H_i.shape[:-2] for part in parts))
    H_i, H_j = (
        np.concatenate([np.broadcast_to(M, (*leading, *M.shape[-2:])) for M in matrices], axis=-2)
        for matrices in ([part.H_i for part in parts], [part.H_j for part in parts])
    )
    leading = np.broadcast_shapes(*(part.R.shape[:-2] for part in parts))
    R, first = np.zeros((*leading, H_i.shape[-2], H_i.shape[-2])), 0
    for part in parts:
        rows = slice(first, first + part.R.shape[-1])
        R[..., rows, rows], first = part.R, rows.stop
    return Relation(H_i, H_j, R)


def over_states(H: np.ndarray, positions: Sequence[int], d: int) -> np.ndarray:
    """Spread H (..., p, D) over a local state of d components of which `positions` are the place: (..., p, d)."""
    spread = np.zeros((*H.shape[:-1], d))
    spread[..., list(positions)] = H
    return spread


def place(
    H_i: np.ndarray, i: int, H_j: np.ndarray, j: int, n: int, d: int, position_states: Sequence[int] | None = None
) -> np.ndarray:
    """Spread the Jacobians of one relation over the joint state of all nodes, (x_1, …, x_n) one above the other.

    Parameters
    ----------
    H_i, H_j : (..., p, D) Jacobians of nodes i and j (counted from 0).
    n, d : number of nodes, and of states of each.
    position_states : indices of the D positions among the d states; default all d, in order.

    Returns
    -------
    (..., p, n·d) array

    Raises
    ------
    UsageError
        If i and j are not two different nodes of 0 … n−1.
    """
    if i == j or not 0 <= min(i, j) <= max(i, j) < n:
        raise UsageError(f"i, j: expected two different nodes of 0 to {n - 1}, got {i} and {j}")
    positions = range(d) if position_states is None else position_states
    columns = {node: [node * d + state for state in positions] for node in (i, j)}
    return over_states(H_i, columns[i], n * d) + over_states(H_j, columns[j], n * d)


def lwin_update(
    own: Estimate, neighbour: Estimate, H_i: np.ndarray, H_j: np.ndarray, R: np.ndarray, z: Any = None
) -> Estimate:
    """Take a cooperative measurement into node i alone, with node j's error as noise, patent (10)–(17).

    The claimed covariance is right only while the two errors are independent: the update itself correlates them.
    Where both claim to be certain of what they measure, the pseudo-inverse applies as in `itns_update`.

    Parameters
    ----------
    own, neighbour : estimates of nodes i and j, P of shape (..., d, d), x of shape (..., d, columns) or None.  Columns
        are states, or the noise footprints of the errors.
    H_i, H_j : (..., p, d) Jacobians.
    R : (..., p, p) measurement noise covariance, positive semi-definite (0 where the neighbour's estimate itself is
        the measurement, with H_i = I and H_j = −I).
    z : (..., p, columns) measurement, or its noise's footprint; needed if the estimates have states.

    Returns
    -------
    Estimate
        Node i's estimate, x_i + K(z − H_i x_i − H_j x_j).

    Raises
    ------
    ValueError
        If node i has a state, and node j has none or no measurement is given.
    """
    composite = H_j @ neighbour.P @ np.swapaxes(H_j, -1, -2) + R
    seen = None if z is None or neighbour.x is None else z - H_j @ neighbour.x
    return _update(own, H_i, composite, seen)


def itns_update(joint: Estimate, H: np.ndarray, R: np.ndarray, z: Any = None) -> Estimate:
    """Take a measurement of any nodes into the joint estimate of all, patent (27) on the joint covariance.

    The kernel's update of the joint covariance.  Where R is singular, S = H P Hᵀ + R can be so too: two nodes that
    have met exactly (R = 0) agree, and measuring that again tells nothing.  The gain is then P Hᵀ S⁺ with the
    pseudo-inverse: the innovation's directions without variance are left out.

    Parameters
    ----------
    joint : P of shape (..., n·d, n·d), x of shape (..., n·d, columns) or None.
    H : (..., p, n·d), for a cooperative measurement from `place`.
    R : (..., p, p) measurement noise covariance, positive semi-definite.
    z : (..., p, columns) measurement, or its noise's footprint; needed if the estimate has a state.

    Raises
    ------
    ValueError
        If the estimate has a state and no measurement is given.
    """
    return _update(joint, H, R, z)


def _update(estimate: Estimate, H: np.ndarray, R: np.ndarray, z: Any) -> Estimate:
    """The kernel's update, with the pseudo-inverse of the innovation covariance where R leaves that singular."""
    if not _definite(R):
        H, R, z = _without_certainties(estimate.P, H, R, z, NEGLIGIBLE)
    elif _drowned(estimate.P, H, R):
        H, R, z = _without_certainties(estimate.P, H, R, z, ROUNDING)
    return update(estimate, H, R, z)


def _without_certainties(
    P: np.ndarray, H: np.ndarray, R: np.ndarray, z: Any, negligible: float
) -> tuple[np.ndarray, np.ndarray, Any]:
    """Return the measurement (H, R, z) without the directions in which the innovation has no variance.

    They stay as rows of zeros with noise 1, so that stacks keep their shape; the kernel's gain is then P Hᵀ S⁺.
    """
    deviations = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))[..., None]
    # H P Hᵀ is known to rounding of what it is a difference of: the scale of what counts as zero
    size = (np.abs(H) @ deviations) ** 2 + np.diagonal(R, axis1=-2, axis2=-1)[..., None]
    scale = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    H, R = scale * H, scale * R * np.swapaxes(scale, -1, -2)
    values, vectors = np.linalg.eigh(H @ P @ np.swapaxes(H, -1, -2) + R)
    certain = (vectors * (values <= negligible)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    keep = np.eye(H.shape[-2]) - certain
    return keep @ H, keep @ R @ keep + certain, None if z is None else keep @ (scale * z)


def _drowned(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> bool:
    """Whether some noise is no more than the rounding of what H P Hᵀ is a difference of."""
    deviations = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))[..., None]
    size = ((np.abs(H) @ deviations) ** 2)[..., 0]
    return bool((np.diagonal(R, axis1=-2, axis2=-1) <= ROUNDING * size).any())


def _definite(R: np.ndarray) -> bool:
    variances = np.diagonal(R, axis1=-2, axis2=-1)
    if (variances <= 0).any():
        return False
    deviations = np.sqrt(variances)
    scaled = R / (deviations[..., :, None] * deviations[..., None, :])
    return R.shape[-1] == 1 or bool(np.linalg.eigvalsh(scaled).min() > NEGLIGIBLE)


def _places(r_i: Any, r_j: Any) -> tuple[np.ndarray, np.ndarray]:
    r_i, r_j = np.asarray(r_i, dtype=float), np.asarray(r_j, dtype=float)
    coordinates = {r.shape[-1] if r.ndim else 0 for r in (r_i, r_j)}
    if coordinates not in ({2}, {3}):
        raise UsageError(
            f"r_i, r_j: expected 2 or 3 coordinates for both nodes, got shapes {r_i.shape} and {r_j.shape}"
        )
    r_i, r_j = np.broadcast_arrays(r_i, r_j)
    return r_i, r_j


def _line_of_sight(r_i: Any, r_j: Any) -> tuple[np.ndarray, np.ndarray]:
    """Distance (..., 1) and unit vector (..., D) from i to j."""
    r_i, r_j = _places(r_i, r_j)
    close = coincident(r_i, r_j)
    if close.any():
        first, second = (r[close][0].tolist() for r in (r_i, r_j))
        raise UsageError(f"r_i, r_j: expected two nodes at different places, got {first} and {second} (no direction)")
    distance = np.linalg.norm(r_j - r_i, axis=-1, keepdims=True)
    return distance, (r_j - r_i) / distance


def _tangent(u: np.ndarray) -> np.ndarray:
    """Orthonormal basis (..., D, D−1) of what is perpendicular to the unit vectors u; in the plane u turned left.

    The columns but the first of the reflection that takes ±u to the first axis, the sign such that nothing cancels.
    """
    sign = np.where(u[..., :1] < 0, -1.0, 1.0)[..., None]
    v = u[..., None].copy()
    v[..., :1, :] += sign
    reflection = np.eye(u.shape[-1]) - v @ np.swapaxes(v, -1, -2) / (1.0 + np.abs(u[..., :1, None]))
    return sign * reflection[..., 1:]


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise UsageError("kind: expected one of " + ", ".join(f'"{k}"' for k in KINDS) + f", got {kind!r}")


def _check_sigmas(kind: str, sigma_range: float | None, sigma_direction: float | None) -> None:
    needed = {"range": kind != "direction", "direction": kind in ("direction", "both")}
    taken = {**needed, "direction": kind != "range"}
    for name, sigma in (("range", sigma_range), ("direction", sigma_direction)):
        if sigma is None and not needed[name]:
            continue
        if not taken[name]:
            raise UsageError(f'sigma_{name}: expected none for a measurement of kind "{kind}", got {sigma}')
        if sigma is None or not 0 < sigma < np.inf:
            raise UsageError(f"sigma_{name}: expected a positive standard deviation, got {sigma}")
