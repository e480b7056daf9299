"""Cooperative measurements: geometry by finite differences, LWIN and ITNS against whole-network least squares."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
import sympy
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import stochfuse
from stochfuse.errors import UsageError
from stochfuse.fusion.cooperative import (
    KINDS,
    attitude,
    coincident,
    itns_update,
    linear,
    lwin_update,
    observe,
    over_states,
    place,
    relation,
    residual,
    time_transfer,
    together,
)
from stochfuse.kalman.kernel import Estimate, update
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.cooperative import read_cooperative
from stochfuse.scenario.schema import CooperativeTable
from tests.oracles.strategies import covariance, seeds

SIGMAS = {"range": (0.5, None), "direction": (None, 0.02), "both": (0.5, 0.02), "difference": (0.5, 0.02)}
PRESETS = Path(stochfuse.__file__).parent / "scenario" / "presets"


def two_places(rng, D, *batch, size=10.0):
    return size * rng.normal(size=(*batch, D)), size * rng.normal(size=(*batch, D))


def blocks(*P):
    return np.array(block_diag(*P))


def information(rel):
    """H' R^-1 H over both nodes, whatever the rows are resolved along."""
    H = np.concatenate([rel.H_i, rel.H_j], axis=-1)
    return np.swapaxes(H, -1, -2) @ np.linalg.inv(rel.R) @ H


def moved(f, r, step=1e-4):
    """Central differences of f over the D coordinates of r, as columns."""
    D = r.shape[-1]
    return np.concatenate([(f(r + step * e) - f(r - step * e)) / (2 * step) for e in np.eye(D)], axis=-1)


# --- geometry ---


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("D", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_are_the_slopes_of_what_the_nodes_would_measure(kind, D, batch):
    r_i, r_j = two_places(np.random.default_rng(D), D, *batch)
    H_i, H_j, R = relation(kind, r_i, r_j, *SIGMAS[kind])
    p = {"range": 1, "direction": D - 1}.get(kind, D)
    assert H_i.shape == H_j.shape == (*batch, p, D)
    assert R.shape[-2:] == (p, p)
    by_i = moved(lambda r: residual(kind, observe(kind, r, r_j), r_i, r_j), r_i)
    by_j = moved(lambda r: residual(kind, observe(kind, r_i, r), r_i, r_j), r_j)
    np.testing.assert_allclose(H_i, by_i, atol=1e-8)
    np.testing.assert_allclose(H_j, by_j, atol=1e-8)


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize("D", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_attitude_is_the_slope_of_what_is_seen_from_a_turned_frame(kind, D, batch):
    r_i, r_j = two_places(np.random.default_rng(D), D, *batch)

    def seen(angles):
        turned = np.concatenate([np.zeros(3 - len(angles)), angles])
        C = Rotation.from_rotvec(turned).as_matrix()[:D, :D].T  # the vector in the axes of the frame that was turned
        measured = observe(kind, r_i, r_j)
        rest = measured[..., :1, :] if kind == "both" else measured[..., :0, :]
        vector = measured if kind == "range" else C @ measured[..., -D:, :]
        return residual(kind, np.concatenate([rest, vector], axis=-2), r_i, r_j)

    expected = moved(seen, np.zeros(1 if D == 2 else 3))
    found = attitude(kind, r_i, r_j)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_clocks_and_linear_relations_refuse_what_is_none():
    np.testing.assert_array_equal(np.concatenate(time_transfer(0.5)), [[1], [-1], [0.25]])
    for sigma in (0, -1, float("nan")):
        with pytest.raises(UsageError, match=f"sigma: expected a positive standard deviation, got {sigma}"):
            time_transfer(sigma)
    with pytest.raises(
        UsageError, match=r"expected shapes \(p, d_i\), \(p, d_j\) and \(p, p\), got \(1, 2\), \(2, 2\)"
    ):
        linear([[1, 0]], np.eye(2), 1.0)
    for matrices in (([[1, 0]], [[0, 1]], [[-1]]), ([[np.inf, 0]], [[0, 1]], [[1]])):
        with pytest.raises(UsageError, match="expected finite matrices and a covariance R"):
            linear(*matrices)
    both = together(relation("range", [[0, 0], [1, 1]], [3, 4], 2.0), linear([[1, 0]], [[0, 1]], [[9]]))
    assert both.H_i.shape == (2, 2, 2)
    np.testing.assert_array_equal(both.R, np.diag([4, 9]))


TURNED = {
    "schema": "stochfuse.scenario/1",
    "model": {
        "own": True, "states": ["x", "y", "h", "b"], "F": np.eye(4).tolist(), "Q": np.diag([0.2, 0.2, 1e-3, 0.5]).tolist(),
        "H": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], "R": np.diag([4.0, 4, 9]).tolist(),
    },
    "initial": {"P": np.diag([50.0, 60, 0.02, 100]).tolist()},
    "network": {"agents": 3, "steps": 3, "link": 1.0},
    "cooperative": {
        "positions": ["x", "y"], "attitude": ["h"], "clock": "b",
        "pair": [
            {"agents": [1, 2], "range": 1.0, "direction": 0.01, "time": 0.7},
            {"agents": [3, 1], "direction": 0.02, "both_ways": False},
            {"agents": [2, 3], "H_i": [[1, 0, 0, 2]], "H_j": [[0, -1, 0.5, 0]], "R": [[2.0]], "both_ways": False},
        ],
    },
    "agent": [{"position": [0, 0]}, {"position": [30, 5], "sensor": False}, {"position": [[9, 20], [12, 22], [15, 20]]}],
}  # fmt: skip


def test_turned_frames_clocks_and_linear_relations_are_the_least_squares_of_the_whole_network():
    """Every measurement of all steps at once, with slopes of the bearing in the observer's own frame."""
    places = [np.array(agent["position"], float) for agent in TURNED["agent"]]
    steps, n, d, rows = 3, 3, 4, []
    # certain links: every run is the same
    found = [stochfuse.predict(TURNED, None, "monte-carlo", q, estimator="itns", runs=2) for q in ("claimed", "actual")]

    def at(step, node):
        return slice((step * n + node) * d, (step * n + node + 1) * d)

    def add(H_of, R):
        H = np.zeros((len(R), steps * n * d))
        for where, M in H_of:
            H[:, where] += M
        rows.append(H.T @ np.linalg.inv(R) @ H)

    def bearing(i, j, step):
        r = [p if p.ndim == 1 else p[step] for p in (places[i], places[j])]

        def f(x):  # of both nodes' states
            to = (r[1] + x[d : d + 2]) - (r[0] + x[:2])
            return np.array([np.arctan2(to[1], to[0]) - x[2], np.hypot(*to), x[3] - x[d + 3]])

        slopes = [(f(e) - f(-e)) / 2e-6 for e in 1e-6 * np.eye(2 * d)]
        return np.stack(slopes, axis=1)

    own, model = np.eye(d), TURNED["model"]
    for step in range(steps):
        for node in range(n):
            if step == 0:
                add([(at(0, node), own)], np.array(TURNED["initial"]["P"]))
            else:
                add([(at(step, node), own), (at(step - 1, node), -own)], np.array(model["Q"]))
                if node != 1:
                    add([(at(step, node), np.array(model["H"], float))], np.array(model["R"]))
        for i, j, keep, R in (
            (0, 1, [0, 1, 2], [1e-4, 1, 0.49]),
            (1, 0, [0, 1, 2], [1e-4, 1, 0.49]),
            (2, 0, [0], [4e-4]),
        ):
            J = bearing(i, j, step)[keep]
            add([(at(step, i), J[:, :d]), (at(step, j), J[:, d:])], np.diag(R))
        add([(at(step, 1), np.array([[1.0, 0, 0, 2]])), (at(step, 2), np.array([[0, -1, 0.5, 0]]))], np.array([[2.0]]))
        # what later steps would tell is not known yet
        P = np.linalg.inv(sum(rows)[: at(step, n).start, : at(step, n).start])
        for node in range(n):
            for prediction in found:
                for k, name in enumerate("xyhb"):
                    value = prediction.values(f"var:{name}", agent=node + 1)[0, step]
                    assert value == pytest.approx(P[at(step, node), at(step, node)][k, k], rel=1e-6)


@pytest.mark.parametrize("D", [2, 3])
def test_range_is_the_distance_and_its_jacobian_points_along_it(D):
    r_i, r_j = two_places(np.random.default_rng(5), D)
    d = np.sqrt(((r_i - r_j) ** 2).sum())
    H_i, H_j, R = relation("range", r_i, r_j, 0.5)
    assert observe("range", r_i, r_j) == pytest.approx(np.array([[d]]), rel=1e-14)
    np.testing.assert_allclose(H_i, [(r_i - r_j) / d], rtol=1e-13)
    np.testing.assert_array_equal(H_j, -H_i)
    np.testing.assert_array_equal(R, [[0.25]])


@pytest.mark.parametrize("degrees", [0, 30, 89, 90, 91, 150, 180, 200, 270, 300, 359])
def test_in_the_plane_a_direction_is_a_bearing_counted_to_the_left(degrees):
    r_i = np.array([3.0, -2.0])
    step = 7.0 * np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
    H_i, H_j, R = relation("direction", r_i, r_i + step, sigma_direction=0.02)
    np.testing.assert_allclose(H_j, [[-step[1] / 49, step[0] / 49]], atol=1e-15)
    np.testing.assert_array_equal(H_i, -H_j)
    np.testing.assert_allclose(R, [[4e-4]])
    for turn in (-179.0, -30.0, 0.0, 1.0, 120.0, 180.0):
        seen = np.deg2rad(degrees + turn)
        measured = np.array([[np.cos(seen)], [np.sin(seen)]])
        got = np.rad2deg(residual("direction", measured, r_i, r_i + step))
        assert np.abs(got) == pytest.approx(abs(turn), abs=1e-9)
        if abs(turn) < 180:
            assert got == pytest.approx(turn, abs=1e-9)


def test_an_opposite_direction_is_half_a_turn_away():
    here, there = np.zeros(3), np.array([1.0, 0.0, 0.0])
    assert np.linalg.norm(residual("direction", -observe("direction", here, there), here, there)) == np.pi


@given(seeds, st.sampled_from([2, 3]))
def test_directions_do_not_depend_on_the_tangent_basis(seed, D):
    """In full: both angles know what lies across the line of sight, alike in all directions, at 1/(d sigma)^2."""
    rng = np.random.default_rng(seed)
    r_i, r_j = two_places(rng, D)
    if seed % 3 == 0:  # along an axis of the frame, either way
        r_j = r_i + rng.choice([-4.0, 4.0]) * np.eye(D)[rng.integers(D)]
    d = np.linalg.norm(r_j - r_i)
    u = ((r_j - r_i) / d)[:, None]
    across = (np.eye(D) - u @ u.T) / (0.02 * d) ** 2
    whole = np.block([[across, -across], [-across, across]])
    rel = relation("direction", r_i, r_j, sigma_direction=0.02)
    np.testing.assert_allclose(information(rel), whole, atol=1e-11 * np.abs(whole).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_rotation_of_the_frame_changes_nothing(kind):
    rng = np.random.default_rng(11)
    turn = Rotation.from_rotvec([0.4, -1.1, 2.7]).as_matrix()
    for _ in range(50):
        r_i, r_j = two_places(rng, 3)
        P_i, P_j = covariance(rng, 3), covariance(rng, 3)
        straight = relation(kind, r_i, r_j, *SIGMAS[kind])
        turned = relation(kind, turn @ r_i, turn @ r_j, *SIGMAS[kind])
        both = blocks(turn, turn)
        whole = both @ information(straight) @ both.T
        np.testing.assert_allclose(information(turned), whole, atol=1e-11 * np.abs(whole).max())
        first = lwin_update(Estimate(None, P_i), Estimate(None, P_j), *straight).P
        second = lwin_update(Estimate(None, turn @ P_i @ turn.T), Estimate(None, turn @ P_j @ turn.T), *turned).P
        np.testing.assert_allclose(second, turn @ first @ turn.T, atol=1e-11 * np.abs(P_i).max())


@pytest.mark.parametrize("D", [2, 3])
def test_a_difference_amounts_to_range_and_direction(D):
    r_i, r_j = two_places(np.random.default_rng(2), D, 6)
    both = information(relation("both", r_i, r_j, 0.5, 0.02))
    difference = relation("difference", r_i, r_j, 0.5, 0.02)
    np.testing.assert_array_equal(difference.H_i, np.broadcast_to(np.eye(D), (6, D, D)))
    np.testing.assert_allclose(information(difference), both, atol=1e-11 * np.abs(both).max())


def test_a_difference_with_one_standard_deviation_takes_coinciding_nodes():
    here = np.array([1.0, 2.0])
    H_i, H_j, R = relation("difference", here, here, 3.0)
    np.testing.assert_array_equal(H_i, np.eye(2))
    np.testing.assert_array_equal(H_j, -np.eye(2))
    np.testing.assert_array_equal(R, 9 * np.eye(2))
    np.testing.assert_array_equal(observe("difference", here, here), np.zeros((2, 1)))


def test_a_constant_place_goes_with_one_per_step():
    r_i, r_j = np.array([0.0, 0.0]), np.array([[3.0, 4.0], [5.0, 12.0]])
    H_j = relation("range", r_i, r_j, 1.0).H_j
    np.testing.assert_allclose(H_j[:, 0], [[0.6, 0.8], [5 / 13, 12 / 13]])


@pytest.mark.parametrize("kind", ["range", "direction", "both"])
@pytest.mark.parametrize("shift", [0.0, 1e-8])
def test_coincident_nodes_have_no_direction(kind, shift):
    r_i = np.array([[1.0, 2.0, 3.0], [100.0, 0.0, 0.0]])
    r_j = np.array([[0.0, 0.0, 0.0], [100.0, shift, 0.0]])
    np.testing.assert_array_equal(coincident(r_i, r_j), [False, True])
    message = r"expected two nodes at different places, got \[100.0, 0.0, 0.0\] and \[100.0, .*\] \(no direction\)"
    with pytest.raises(UsageError, match=message):
        relation(kind, r_i, r_j, *SIGMAS[kind])
    with pytest.raises(UsageError, match=message):
        observe(kind, r_i, r_j)


def test_nodes_close_together_near_the_origin_have_a_direction():
    H_j = relation("range", [0.0, 0.0], [3e-12, 4e-12], 1.0).H_j
    np.testing.assert_allclose(H_j, [[0.6, 0.8]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("angle", [0, 0], [1, 0], 1.0),
            'kind: expected one of "range", "direction", "both", "difference", got \'angle\'',
        ),
        (("range", [0, 0], [1, 0]), "sigma_range: expected a positive standard deviation, got None"),
        (("range", [0, 0], [1, 0], 0.0), r"sigma_range: expected a positive standard deviation, got 0\.0"),
        (("range", [0, 0], [1, 0], np.nan), "sigma_range: expected a positive standard deviation, got nan"),
        (
            ("range", [0, 0], [1, 0], 1.0, 0.1),
            'sigma_direction: expected none for a measurement of kind "range", got 0.1',
        ),
        (("direction", [0, 0], [1, 0], 1.0, 0.1), 'sigma_range: expected none for a measurement of kind "direction"'),
        (("both", [0, 0], [1, 0], 1.0), "sigma_direction: expected a positive standard deviation, got None"),
        (("difference", [0, 0], [1, 0], None, 0.1), "sigma_range: expected a positive standard deviation, got None"),
        (
            ("range", [0, 0], [1, 0, 0], 1.0),
            r"expected 2 or 3 coordinates for both nodes, got shapes \(2,\) and \(3,\)",
        ),
        (("range", [0], [1], 1.0), r"expected 2 or 3 coordinates for both nodes, got shapes \(1,\) and \(1,\)"),
        (("range", 0.0, 1.0, 1.0), r"expected 2 or 3 coordinates for both nodes, got shapes \(\) and \(\)"),
    ],
)
def test_relations_say_what_does_not_fit(arguments, message):
    with pytest.raises(UsageError, match=message):
        relation(*arguments)


def test_observing_checks_the_kind():
    with pytest.raises(UsageError, match="kind: expected one of"):
        observe("velocity", [0, 0], [1, 0])


# --- the joint state ---


def test_place_puts_each_jacobian_at_its_nodes_positions():
    H_i, H_j = np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(place(H_i, 2, H_j, 0, 3, 3, (0, 2)), [[3.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0, 0.0, 2.0]])
    np.testing.assert_array_equal(place(H_i, 0, H_j, 1, 2, 2), [[1.0, 2.0, 3.0, 4.0]])
    stack = place(np.stack([H_i, 2 * H_i]), 0, H_j, 1, 2, 2)
    np.testing.assert_array_equal(stack, [[[1.0, 2.0, 3.0, 4.0]], [[2.0, 4.0, 3.0, 4.0]]])
    np.testing.assert_array_equal(over_states(H_i, (2, 0), 3), [[2.0, 0.0, 1.0]])


@pytest.mark.parametrize(("i", "j"), [(1, 1), (0, 3), (-1, 2)])
def test_place_wants_two_nodes_of_the_network(i, j):
    H = np.ones((1, 2))
    with pytest.raises(UsageError, match=rf"i, j: expected two different nodes of 0 to 2, got {i} and {j}"):
        place(H, i, H, j, 3, 2)


# --- published numbers ---


def exact_traces(mutual):
    """The same in rational numbers: every product of two components of a unit vector is one."""
    Y = sympy.zeros(4, 4)
    for k, (x, y) in enumerate([(3, 3), (7, 6)]):
        for ax, ay in [(0, 0), (10, 0), (0, 10)]:
            step = sympy.Matrix([x - ax, y - ay])
            Y[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += step * step.T / step.dot(step)
    if mutual:
        step = sympy.Matrix([-4, -3, 4, 3])
        Y += step * step.T / 25
    P = Y.inv()
    return [P[0, 0] + P[1, 1], P[2, 2] + P[3, 3]]


def test_ranging_numbers_without_and_with_the_mutual_range():
    """Theory section 10; ranges to the anchors alone, no prior: least squares, then one ITNS update.

    Section 10 prints the last of the four as 1.1288213747.  It is 9968273/8830692 = 1.1288212747: one digit is wrong
    there, in the seventh decimal.  The other three agree to all their digits.
    """
    anchors = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    agents = np.array([[3.0, 3.0], [7.0, 6.0]])
    alone = []
    for agent in agents:
        H = relation("range", agent, anchors, 1.0).H_i[:, 0, :]
        alone.append(np.linalg.inv(H.T @ H))
    without = [np.trace(P) for P in alone]
    H_i, H_j, R = relation("range", agents[0], agents[1], 1.0)
    P = itns_update(Estimate(None, blocks(*alone)), place(H_i, 0, H_j, 1, 2, 2), R).P
    both = [np.trace(P[:2, :2]), np.trace(P[2:, 2:])]
    assert without == pytest.approx([1.3637837838, 1.4046610169], abs=5e-11)
    assert both[0] == pytest.approx(1.1322625609, abs=5e-11)
    assert exact_traces(mutual=True)[1] == sympy.Rational(9968273, 8830692)
    assert without == pytest.approx([float(t) for t in exact_traces(mutual=False)], rel=1e-13)
    assert both == pytest.approx([float(t) for t in exact_traces(mutual=True)], rel=1e-13)


# --- LWIN and ITNS ---


@given(seeds, st.sampled_from([2, 3]), st.integers(2, 4))
def test_itns_is_least_squares_over_the_whole_network(seed, D, n):
    """All at once: initial estimates and every measurement stacked, each row divided by its standard deviation."""
    rng = np.random.default_rng(seed)
    places = 10.0 * np.eye(n, D) + rng.normal(size=(n, D)) + np.arange(n)[:, None]
    P0 = blocks(*(covariance(rng, D) + 0.1 * np.eye(D) for _ in range(n)))
    x0 = rng.normal(size=(n * D, 1))
    root = np.linalg.inv(np.linalg.cholesky(P0))
    rows, right = [root], [root @ x0]
    joint = Estimate(x0, P0)
    for _ in range(6):
        i, j = rng.choice(n, 2, replace=False)
        kind = rng.choice(KINDS)
        H_i, H_j, R = relation(kind, places[i], places[j], *SIGMAS[kind])
        z = rng.normal(size=(len(R), 1))
        H = np.zeros((len(R), n * D))
        H[:, i * D : (i + 1) * D], H[:, j * D : (j + 1) * D] = H_i, H_j
        root = np.linalg.inv(np.linalg.cholesky(R))
        rows.append(root @ H)
        right.append(root @ z)
        joint = itns_update(joint, place(H_i, i, H_j, j, n, D), R, z)
    stacked = np.concatenate(rows)
    x = np.linalg.lstsq(stacked, np.concatenate(right), rcond=None)[0]
    P = np.linalg.inv(stacked.T @ stacked)
    np.testing.assert_allclose(joint.P, P, atol=1e-10 * np.abs(P0).max())
    np.testing.assert_allclose(joint.x, x, atol=1e-10 * np.abs(P0).max() * (1 + np.abs(right[-1]).max()))


@pytest.mark.parametrize("kind", KINDS)
def test_lwin_with_a_perfectly_known_neighbour_is_a_kalman_update(kind):
    rng = np.random.default_rng(4)
    r_i, r_j = two_places(rng, 3, 5)
    H_i, H_j, R = relation(kind, r_i, r_j, *SIGMAS[kind])
    P, x, x_j = covariance(rng, 3), rng.normal(size=(3, 1)), rng.normal(size=(3, 1))
    z = rng.normal(size=(H_i.shape[-2], 1))
    got = lwin_update(Estimate(x, P), Estimate(x_j, np.zeros((3, 3))), H_i, H_j, R, z)
    wanted = update(Estimate(x, P), H_i, R, z - H_j @ x_j)
    np.testing.assert_array_equal(got.P, wanted.P)
    np.testing.assert_array_equal(got.x, wanted.x)


@given(seeds, st.sampled_from(KINDS), st.sampled_from([2, 3]))
def test_lwins_first_exchange_is_the_joint_updates_block(seed, kind, D):
    rng = np.random.default_rng(seed)
    r_i, r_j = np.zeros(D), np.arange(1.0, D + 1) + rng.uniform(0, 3, size=D)
    H_i, H_j, R = relation(kind, r_i, r_j, *SIGMAS[kind])
    P_i, P_j = (covariance(rng, D) + 0.01 * np.eye(D) for _ in range(2))
    x, z = rng.normal(size=(2 * D, 1)), rng.normal(size=(len(R), 1))
    joint = itns_update(Estimate(x, blocks(P_i, P_j)), place(H_i, 0, H_j, 1, 2, D), R, z)
    scale = max(np.abs(P_i).max(), np.abs(P_j).max(), 1.0)
    first = lwin_update(Estimate(x[:D], P_i), Estimate(x[D:], P_j), H_i, H_j, R, z)
    second = lwin_update(Estimate(x[D:], P_j), Estimate(x[:D], P_i), H_j, H_i, R, z)
    np.testing.assert_allclose(first.P, joint.P[:D, :D], atol=1e-10 * scale)
    np.testing.assert_allclose(second.P, joint.P[D:, D:], atol=1e-10 * scale)
    # the innovation weighs in standard deviations of the noise
    weight = scale * np.abs(np.linalg.solve(R, H_i)).max()
    np.testing.assert_allclose(first.x, joint.x[:D], atol=1e-10 * weight)
    np.testing.assert_allclose(second.x, joint.x[D:], atol=1e-10 * weight)


def test_repeated_exchange_makes_lwin_overconfident_and_leaves_itns_true():
    """Two nodes 20 m apart see each other ten times over; nothing tells where the two of them are."""
    H_i, H_j, R = relation("both", [0.0, 0.0], [20.0, 0.0], 0.5, 0.02)
    d, exchanges = 2, 10
    P0 = np.diag([9.0, 4.0])
    root, noise = np.linalg.cholesky(P0), np.linalg.cholesky(R)
    columns = 2 * d + 2 * exchanges * d  # initial errors, then each measurement's noise, of either observer
    footprints = np.zeros((2, d, columns))
    footprints[0, :, :d] = footprints[1, :, d : 2 * d] = root
    nodes = [Estimate(footprints[0], P0), Estimate(footprints[1], P0)]
    joint = Estimate(np.concatenate(footprints), blocks(P0, P0))
    J = blocks(P0, P0)  # the truth by another way: the joint covariance of LWIN's errors under its own gains
    ratios = []
    for exchange in range(exchanges):
        seen = np.zeros((2, d, columns))
        for observer in range(2):
            at = 2 * d + (2 * exchange + observer) * d
            seen[observer, :, at : at + d] = noise
        A, B = np.eye(2 * d), np.zeros((2 * d, 2 * d))
        updated = []
        for me, other, H_me, H_other in ((0, 1, H_i, H_j), (1, 0, H_j, H_i)):
            P_i, P_j = nodes[me].P, nodes[other].P
            K = P_i @ H_me.T @ np.linalg.inv(H_me @ P_i @ H_me.T + H_other @ P_j @ H_other.T + R)
            A[me * d : (me + 1) * d] -= K @ place(H_me, me, H_other, other, 2, d)
            B[me * d : (me + 1) * d, me * d : (me + 1) * d] = K
            updated.append(lwin_update(nodes[me], nodes[other], H_me, H_other, R, seen[me]))
            joint = itns_update(joint, place(H_me, me, H_other, other, 2, d), R, seen[me])
        nodes = updated
        J = A @ J @ A.T + B @ blocks(R, R) @ B.T
        actual = nodes[0].x @ nodes[0].x.T
        np.testing.assert_allclose(actual, J[:d, :d], atol=1e-12)
        np.testing.assert_allclose(joint.x @ joint.x.T, joint.P, atol=1e-12)
        ratios.append(np.trace(actual) / np.trace(nodes[0].P))
    assert ratios[0] == pytest.approx(1.0, abs=1e-12)  # independent until they met
    assert (np.diff(ratios) > 0).all()
    assert ratios[-1] > 10
    # at best the two know their mean place, half of one's variance; LWIN claims far less
    assert np.trace(joint.P[:d, :d]) > np.trace(P0) / 2 > 10 * np.trace(nodes[0].P)
    assert np.linalg.eigvalsh(nodes[0].x @ nodes[0].x.T - joint.P[:d, :d]).min() > -1e-12


@given(seeds, st.sampled_from(KINDS), st.sampled_from([2, 3]), st.integers(0, 6), st.floats(-3, 3))
def test_results_are_symmetric_and_positive_semidefinite_even_from_singular_covariances(seed, kind, D, rank, power):
    rng = np.random.default_rng(seed)
    P = covariance(rng, 2 * D, rank=rank, scale=10.0**power)
    H_i, H_j, R = relation(kind, np.zeros(D), np.arange(1.0, D + 1), *SIGMAS[kind])
    H = place(H_i, 0, H_j, 1, 2, D)
    for noise in (R, np.zeros_like(R)):
        joint = itns_update(Estimate(None, P), H, noise).P
        np.testing.assert_array_equal(joint, joint.T)
        assert np.linalg.eigvalsh(joint).min() >= -1e-9 * np.abs(P).max()
        assert np.trace(joint) <= np.trace(P) * (1 + 1e-9)
    own = lwin_update(Estimate(None, P[:D, :D]), Estimate(None, P[D:, D:]), H_i, H_j, R).P
    np.testing.assert_array_equal(own, own.T)
    assert np.linalg.eigvalsh(own).min() >= -1e-12 * np.abs(P).max()
    assert np.linalg.eigvalsh(P[:D, :D] - own).min() >= -1e-9 * np.abs(P).max()


def test_updates_take_stacks():
    rng = np.random.default_rng(9)
    r_i, r_j = two_places(rng, 2, 3)
    P = np.stack([covariance(rng, 4) for _ in range(3)])
    H_i, H_j, R = relation("both", r_i, r_j, 0.5, 0.02)
    H = place(H_i, 0, H_j, 1, 2, 2)
    whole = itns_update(Estimate(None, P), H, R).P
    own = lwin_update(Estimate(None, P[:, :2, :2]), Estimate(None, P[:, 2:, 2:]), H_i, H_j, R).P
    for k in range(3):
        single = Estimate(None, P[k])
        np.testing.assert_allclose(whole[k], itns_update(single, H[k], R).P, atol=1e-13)
        pair = Estimate(None, P[k, :2, :2]), Estimate(None, P[k, 2:, 2:])
        np.testing.assert_allclose(own[k], lwin_update(*pair, H_i[k], H_j[k], R).P, atol=1e-13)


# --- R = 0: the pseudo-inverse ---


def test_exact_agreement_twice_is_exact_agreement_once():
    P = blocks(np.diag([9.0, 4.0]), np.diag([1.0, 4.0]))
    H = place(np.eye(2), 0, -np.eye(2), 1, 2, 2)
    once = itns_update(Estimate(np.arange(4.0)[:, None], P), H, np.zeros((2, 2)), np.zeros((2, 1)))
    np.testing.assert_allclose(once.P, np.kron(np.ones((2, 2)), np.diag([0.9, 2.0])), atol=1e-14)
    again = itns_update(once, H, np.zeros((2, 2)), np.zeros((2, 1)))
    np.testing.assert_allclose(again.P, once.P, atol=1e-14)
    np.testing.assert_allclose(again.x, once.x, atol=1e-14)


def test_lwin_takes_the_neighbours_estimate_itself_and_learns_nothing_between_the_certain():
    one, none = np.eye(2), np.zeros((2, 2))
    own, other = np.diag([9.0, 0.0]), np.diag([4.0, 0.0])
    x, y = np.array([[1.0], [5.0]]), np.array([[2.0], [5.0]])
    got = lwin_update(Estimate(x, own), Estimate(y, other), one, -one, none, np.zeros((2, 1)))
    np.testing.assert_allclose(got.P, np.diag([36 / 13, 0.0]), atol=1e-14)
    np.testing.assert_allclose(got.x, [[22 / 13], [5.0]], rtol=1e-14)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_singular_innovation_takes_the_pseudo_inverse(unit):
    """Against NumPy's, for one measurement given twice over with one noise, and for one exact row beside a noisy one."""
    rng = np.random.default_rng(6)
    P = unit**2 * (covariance(rng, 4) + np.eye(4))
    h = rng.normal(size=(2, 4))
    cases = [
        (h[[0, 0]], unit**2 * np.full((2, 2), 0.3)),
        (np.stack([h[0], np.zeros(4)]), unit**2 * np.diag([0.2, 0.0])),
        (h, unit**2 * np.diag([0.0, 0.5])),
    ]
    for H, R in cases:
        K = P @ H.T @ np.linalg.pinv(H @ P @ H.T + R, rcond=1e-10)
        got = itns_update(Estimate(None, P), H, R).P
        np.testing.assert_allclose(got, P - K @ H @ P, atol=1e-11 * unit**2)
    stacked = itns_update(Estimate(None, P), np.stack([H for H, _ in cases]), np.stack([R for _, R in cases])).P
    for k, (H, R) in enumerate(cases):
        np.testing.assert_allclose(stacked[k], itns_update(Estimate(None, P), H, R).P, atol=1e-13 * unit**2)


def test_a_small_noise_is_never_taken_for_none():
    """A vague prior: the second look is far more precise than rounding of the first covariance would suggest."""
    P = 1e12 * np.eye(2)
    H = np.array([[1.0, -1.0]])
    first = itns_update(Estimate(None, P), H, np.array([[1.0]]))
    second = itns_update(first, H, np.array([[1e-6]]))
    assert (H @ second.P @ H.T).item() < 1e-3  # rounding of 1e12, no longer the 1 of the first look


def test_a_state_without_a_measurement_is_refused():
    H_i, H_j, R = relation("range", [0.0, 0.0], [1.0, 0.0], 1.0)
    some = Estimate(np.zeros((2, 1)), np.eye(2))
    for other, z in ((some, None), (Estimate(None, np.eye(2)), np.zeros((1, 1)))):
        with pytest.raises(ValueError, match="expected a measurement z for an estimate that has a state"):
            lwin_update(some, other, H_i, H_j, R, z)
    with pytest.raises(ValueError, match="expected a measurement z for an estimate that has a state"):
        itns_update(Estimate(np.zeros((4, 1)), np.eye(4)), place(H_i, 0, H_j, 1, 2, 2), R)


# --- [cooperative] ---

STATES = ("x", "vx", "y")
NODES = [{"position": [0, 0]}, {"position": [3.0, 4.0]}, {"position": [[0, 5], [0, 6], [0, 7]]}]


def read(table, nodes=NODES, agents=3, steps=2, states=STATES, skip=()):
    check = Checker(skip=set(skip))
    relations = read_cooperative(check, table, nodes, states, agents, steps)
    return relations, [str(problem) for problem in check.problems]


def test_reading_spreads_every_pair_over_the_state():
    relations, problems = read({"positions": ["x", "y"], "range": 2, "direction": 0.1})
    assert not problems
    assert relations is not None
    assert sorted(relations) == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    H_i, H_j, R = relations[0, 1]
    np.testing.assert_allclose(H_j, [[0.6, 0, 0.8], [-0.16, 0, 0.12]], atol=1e-15)
    np.testing.assert_array_equal(H_i, -H_j)
    np.testing.assert_allclose(R, np.diag([4, 0.01]))
    assert relations[0, 2].H_i.shape == (2, 2, 3)
    np.testing.assert_allclose(relations[2, 0].H_j[:, 1], [[1 / 5, 0, 0], [1 / 6, 0, 0]], atol=1e-15)


def test_a_pairs_own_table_takes_the_place_of_the_common_one():
    pairs = [
        {"agents": [1, 2], "direction": 0.5, "both_ways": False},
        {"agents": [3, 1], "none": True, "both_ways": False},
    ]
    relations, problems = read({"positions": ["x", "y"], "range": 2, "pair": pairs})
    assert not problems
    assert relations is not None
    assert sorted(relations) == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 1)]
    np.testing.assert_array_equal(relations[0, 1].R, [[0.25]])
    np.testing.assert_array_equal(relations[1, 0].R, [[4.0]])


def test_pairs_alone_are_enough_and_communicating_nodes_may_coincide():
    nodes = [{"position": [0, 0, 1]}, {"position": [0, 0, 1]}, {"position": [0, 5, 1]}]
    table = {"positions": ["x", "y", "vx"], "pair": [{"agents": [1, 3], "range": 1.0}]}
    relations, problems = read(table, nodes)
    assert not problems
    assert relations is not None
    assert sorted(relations) == [(0, 2), (2, 0)]


def test_without_a_table_there_is_nothing():
    assert read(None, nodes=None) == (None, [])
    assert read(None, nodes=[{}, {}, {}]) == (None, [])
    assert read("all", nodes=NODES) == (None, [])  # the schema has named it
    _, problems = read(None)
    assert problems == ["cooperative: expected a table, since agent[1].position is given, got nothing"]


GOOD = {"positions": ["x", "y"], "range": 2.0}
LINEAR = {"agents": [1, 2], "H_i": [[1, 0, 0]], "H_j": [[0, 0, 2]], "R": 3.0}
DEVIATION = "expected a positive standard deviation"


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"positions": None},
            "cooperative.positions: expected the names of the 2 or 3 states that are the place, got nothing",
        ),
        (
            {"positions": ["x"]},
            "cooperative.positions: expected the names of the 2 or 3 states that are the place, got ['x']",
        ),
        (
            {"positions": ["x", "x"]},
            "cooperative.positions: expected the names of the 2 or 3 states that are the place, got ['x', 'x']",
        ),
        ({"positions": ["x", "q"]}, 'cooperative.positions[2]: expected one of "x", "vx", "y", got \'q\''),
        (
            {"range": None},
            "cooperative.range: expected a standard deviation here, in cooperative.direction or in [[cooperative.pair]], "
            "got nothing",
        ),
        ({"range": 0}, f"cooperative.range: {DEVIATION}, got 0"),
        ({"direction": -0.1}, f"cooperative.direction: {DEVIATION}, got -0.1"),
        ({"range": [1.0]}, f"cooperative.range: {DEVIATION}, got [1.0]"),
        ({"range": float("nan")}, f"cooperative.range: {DEVIATION}, got a value that is not finite (NaN or infinity)"),
        ({"pair": [{"agents": [1, 2], "range": 0.0}]}, f"cooperative.pair[1].range: {DEVIATION}, got 0.0"),
        (
            {"pair": [{"range": 1.0}]},
            "cooperative.pair[1].agents: expected two different agents of 1 to 3, got nothing",
        ),
        (
            {"pair": [{"agents": [1, 4], "range": 1.0}]},
            "cooperative.pair[1].agents: expected two different agents of 1 to 3, got [1, 4]",
        ),
        (
            {"pair": [{"agents": [2, 2], "range": 1.0}]},
            "cooperative.pair[1].agents: expected two different agents of 1 to 3, got [2, 2]",
        ),
        (
            {"pair": [{"agents": [1, 2, 3], "range": 1.0}]},
            "cooperative.pair[1].agents: expected two different agents of 1 to 3, got [1, 2, 3]",
        ),
        (
            {"pair": [{"agents": [0, 2], "range": 1.0}]},
            "cooperative.pair[1].agents[1]: expected a whole number of at least 1, got 0",
        ),
        (
            {"pair": [{"agents": [1, 2]}]},
            "cooperative.pair[1]: expected range, direction, time, H_i with H_j and R, or none = true, got none of them",
        ),
        (
            {"pair": [{"agents": [1, 2], "none": True, "range": 1.0}]},
            "cooperative.pair[1]: expected either a standard deviation or none = true, got both",
        ),
        (
            {"pair": [{"agents": [1, 2], "range": 1.0}, {"agents": [2, 1], "none": True}]},
            "cooperative.pair[2].agents: expected every pair once, got [2, 1] again",
        ),
        (
            {"attitude": ["vx"]},
            "cooperative.attitude: expected a direction that is measured in that frame, got none",
        ),
        (
            {"attitude": ["vx", "x", "y"], "direction": 0.1},
            "cooperative.attitude: expected the name of the state that turns an agent's frame, got ['vx', 'x', 'y']",
        ),
        (
            {"attitude": ["h"], "direction": 0.1},
            'cooperative.attitude[1]: expected one of "x", "vx", "y", got \'h\'',
        ),
        ({"time": 1.0}, "cooperative.clock: expected the name of the state that is the clock's error, got nothing"),
        ({"clock": "vx"}, "cooperative.clock: expected a time that is measured, got none"),
        ({"time": -1.0, "clock": "vx"}, f"cooperative.time: {DEVIATION}, got -1.0"),
        (
            {"pair": [{**LINEAR, "range": 1.0}]},
            "cooperative.pair[1]: expected either H_i, H_j and R or another measurement, got both",
        ),
        (
            {"pair": [{**LINEAR, "H_j": [[1, 0]]}]},
            "cooperative.pair[1].H_j: expected a matrix of 1 row (of R) and 3 columns (of the states), got [[1, 0]]",
        ),
        ({"pair": [{**LINEAR, "R": [[-1.0]]}]}, "cooperative.pair[1].R: expected a covariance, got [[-1.0]]"),
    ],
)
def test_reading_names_what_is_wrong_in_the_table(changes, problem):
    assert read({**GOOD, **changes})[1] == [problem]


def test_clocks_and_linear_relations_need_no_places():
    relations, problems = read({"clock": "vx", "time": 0.5, "pair": [LINEAR]}, nodes=None)
    assert problems == []
    for pair, expected in (
        ((0, 1), ([[1, 0, 0]], [[0, 0, 2]], [[3]])),
        ((2, 1), ([[0, 1, 0]], [[0, -1, 0]], [[0.25]])),
    ):
        for M, of in zip(relations[pair], expected, strict=True):
            np.testing.assert_array_equal(M, of)
    assert len(relations) == 6
    assert read({**GOOD, "pair": [{"agents": [1, 2], "H_i": [[1, 0, 0]], "R": 1.0}]})[1] == [
        "cooperative.pair[1].H_j: expected a matrix beside the others of H_i, H_j and R, got nothing"
    ]


def test_small_angles_in_space_turn_what_is_seen():
    states = ("x", "y", "z", "a", "b", "c")
    table = {"positions": ["x", "y", "z"], "attitude": ["a", "b", "c"], "direction": 0.1}
    nodes = [{"position": [0, 0, 0]}, {"position": [3, 4, 12]}]
    relations, problems = read(table, nodes, 2, states=states)
    assert not problems
    H_i, H_j, _ = relations[0, 1]
    # to turn about the line of sight is not seen; about anything else as far as the line of sight goes round
    np.testing.assert_allclose(H_i[:, 3:] @ [3, 4, 12], 0, atol=1e-12)
    assert np.linalg.norm(H_i[:, 3:] @ np.array([4, -3, 0]) / 5) == pytest.approx(1.0)
    # turned left by φ, what moves left by distance times φ stays where it is seen
    left = np.cross([0, 0, 1], [3, 4, 12])
    np.testing.assert_allclose(H_i[:, 3:] @ [0, 0, 1] + H_j[:, :3] @ left, 0, atol=1e-12)
    np.testing.assert_array_equal(H_j[:, 3:], 0)


@pytest.mark.parametrize(
    ("nodes", "problem"),
    [
        (None, "agent: expected one [[agent]] table with a position for each of the 3 agents, got nothing"),
        (NODES[:2], "agent: expected one [[agent]] table with a position for each of the 3 agents, got 2"),
        (
            [NODES[0], {}, NODES[2]],
            "agent[2].position: expected a list of 2 numbers, since [cooperative] is given, got nothing",
        ),
        (
            [NODES[0], {"position": [1, 2, 3]}, NODES[2]],
            "agent[2].position: expected a list of 2 numbers, or one such list per step, got [1, 2, 3]",
        ),
        (
            [NODES[0], {"position": [[1, 2]]}, NODES[2]],
            "agent[2].position: expected one list for each of the 2 steps, got 1 lists",
        ),
        (
            [NODES[0], {"position": [0.0, 0.0]}, NODES[2]],
            "agent[2].position: expected a place different from agent 1's, got [0.0, 0.0] (no direction)",
        ),
        (
            [NODES[0], NODES[1], {"position": [[0, 5], [3, 4]]}],
            "agent[3].position: expected a place different from agent 2's, got [3.0, 4.0] at step 2 (no direction)",
        ),
    ],
)
def test_reading_names_what_is_wrong_with_the_places(nodes, problem):
    assert read(GOOD, nodes)[1] == [problem]


def test_reading_goes_on_past_what_the_schema_has_named():
    table = {"positions": ["x", "y"], "range": "far", "pair": ["1-2"]}
    assert read(table, skip=["cooperative.range"])[1] == []
    assert read({**GOOD, "pair": 5})[1] == []
    assert read(None, nodes=5) == (None, [])
    check = Checker()
    check.note("agent", "3 tables", "2")
    assert read_cooperative(check, GOOD, NODES[:2], STATES, 3, 2) is None
    assert len(check.problems) == 1


def test_coincident_agents_are_named_once_though_each_sees_the_other():
    nodes = [{"position": [1, 1]}] * 3
    named = [problem.split(":")[0] for problem in read(GOOD, nodes)[1]]
    assert named == ["agent[2].position", "agent[3].position"]


@pytest.mark.parametrize(
    "table",
    [
        {"positions": ["x", "y"], "rnage": 1.0},
        {"positions": ["x", "y"], "range": "1"},
        {"positions": ["x", "y"], "attitude": "heading"},
        {"clock": ["b"]},
        {"positions": ["x", "y"], "range": True},
        {"positions": ["x", "y"], "pair": [{"range": 1.0}]},
        {"positions": ["x", "y"], "pair": [{"agents": [1.0, 2], "range": 1.0}]},
        {"positions": ["x", "y"], "pair": [{"agents": [1, 2], "none": "yes"}]},
    ],
)
def test_the_schema_refuses_unknown_keys_and_wrong_kinds(table):
    with pytest.raises(ValidationError):
        CooperativeTable.model_validate(table)


@pytest.mark.parametrize(("name", "D", "pairs"), [("cooperative-pnt", 3, 16), ("beacon-map", 2, 6)])
def test_the_presets_can_be_read(name, D, pairs):
    (path,) = PRESETS.glob(f"{name}.toml*")
    mapping = tomllib.loads(path.read_text(encoding="utf-8"))
    table, network = mapping["cooperative"], mapping["network"]
    CooperativeTable.model_validate(table)
    relations, problems = read(table, mapping["agent"], network["agents"], network["steps"], mapping["model"]["states"])
    assert not problems
    assert relations is not None
    assert len(relations) == pairs
