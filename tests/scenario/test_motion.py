"""Models by name: against the textbook's printed matrices, the matrix exponential and quadrature at 50 digits."""

from __future__ import annotations

import copy
import re

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import stochfuse as sf
from stochfuse.kalman.checks import covariance_fault
from stochfuse.scenario.motion import ORDERS, layout_of, process_noise, rates, transition

TURN = "coordinated-turn"
GOOD = {
    "model": {"kind": "constant-velocity", "noise": 0.5, "H": [[1, 0, 0, 0], [0, 0, 1, 0]], "R": 4.0},
    "initial": {"P": 100.0},
    "network": {"agents": 2, "steps": 4, "link": 0.5},
}


def scenario(**model):
    mapping = copy.deepcopy(GOOD)
    mapping["model"] = {key: value for key, value in {**mapping["model"], **model}.items() if value is not None}
    return mapping


def read(**model):
    return sf.load_scenario(scenario(**model))


def generator(kind, axes, rate=0.0):
    """Continuous motion: ẋ = A x + G w, derived from what the states are, not from F."""
    n = ORDERS[kind]
    A, G = np.zeros((axes * n, axes * n)), np.zeros((axes * n, axes))
    for axis in range(axes):
        for order in range(n - 1):
            A[axis * n + order, axis * n + order + 1] = 1.0
        G[axis * n + n - 1, axis] = 1.0
    if kind == TURN:  # the velocity turns from x to y
        A[1, 3], A[3, 1] = -rate, rate
    return A, G


def van_loan(A, G, q, T):
    """F and Q by one matrix exponential (Van Loan 1978)."""
    d = len(A)
    big = expm(np.block([[-A, q * G @ G.T], [np.zeros_like(A), A.T]]) * T)
    F = big[d:, d:].T
    return F, F @ big[:d, d:]


@pytest.mark.parametrize("rate", [0.0, 1e-9, -0.02, 0.7, 3.0])
@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("kind", ORDERS)
def test_continuous_noise_is_that_of_the_matrix_exponential(kind, axes, rate):
    if kind == TURN and axes != 2:
        pytest.skip("a turn is in the plane")
    for T in (0.05, 1.0, 2.5):
        F, Q = van_loan(*generator(kind, axes, rate), 0.3, T)
        np.testing.assert_allclose(transition(kind, T, axes, rate), F, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(process_noise(kind, T, 0.3, "continuous", axes, rate), Q, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rate", [1e-12, 1e-4, 0.3, 0.999, 1.001, 5.0])
def test_a_turns_noise_to_the_last_digit(rate):
    """The integral of the response to a push along x, by quadrature at 50 digits; the push along y is it turned."""
    T, q, w = 1.5, 2.0, mp.mpf(rate)
    with mp.workdps(50):

        def x(s):
            return mp.sin(w * s) / w

        def y(s):
            return (1 - mp.cos(w * s)) / w

        def integral(f):
            return float(q * mp.quad(f, mp.linspace(0, T, 3 + int(rate))))

        # of two pushes, along x and y: places (x, y) and (−y, x), velocities (cos, sin) and (−sin, cos)
        place = integral(lambda s: x(s) ** 2 + y(s) ** 2)
        both = integral(lambda s: x(s) * mp.cos(w * s) + y(s) * mp.sin(w * s))
        turned = integral(lambda s: x(s) * mp.sin(w * s) - y(s) * mp.cos(w * s))
    exact = [
        [place, both, 0, turned],
        [both, q * T, -turned, 0],
        [0, -turned, place, both],
        [turned, 0, both, q * T],
    ]
    np.testing.assert_allclose(process_noise(TURN, T, q, turn_rate=rate), exact, rtol=1e-14, atol=1e-30)


def test_the_textbooks_matrices():
    T = 3.0
    np.testing.assert_array_equal(transition("random-walk", T, 1), [[1]])
    np.testing.assert_array_equal(transition("constant-velocity", T, 1), [[1, 3], [0, 1]])
    np.testing.assert_array_equal(transition("constant-acceleration", T, 1), [[1, 3, 4.5], [0, 1, 3], [0, 0, 1]])
    np.testing.assert_allclose(process_noise("random-walk", T, 2.0, axes=1), [[6]], rtol=1e-15)
    np.testing.assert_allclose(process_noise("constant-velocity", T, 2.0, axes=1), [[18, 9], [9, 6]], rtol=1e-15)
    # Bar-Shalom, Li and Kirubarajan (6.2.3-9): T⁵/20, T⁴/8, T³/6; T³/3, T²/2; T
    third = 2.0 * np.array([[243 / 20, 81 / 8, 27 / 6], [81 / 8, 27 / 3, 9 / 2], [27 / 6, 9 / 2, 3]])
    np.testing.assert_allclose(process_noise("constant-acceleration", T, 2.0, axes=1), third, rtol=1e-15)
    # (6.3.2-8) and (6.3.3-9)
    piecewise = [process_noise(kind, T, 2.0, "piecewise", 1) for kind in list(ORDERS)[:3]]
    np.testing.assert_allclose(piecewise[0], [[36]], rtol=1e-15)
    np.testing.assert_allclose(piecewise[1], 4 * np.array([[81 / 4, 27 / 2], [27 / 2, 9]]), rtol=1e-15)
    third = np.array([[81 / 4, 27 / 2, 9 / 2], [27 / 2, 9, 3], [9 / 2, 3, 1]])
    np.testing.assert_allclose(piecewise[2], 4 * third, rtol=1e-15)
    # (11.7.1-4), in the order x, vx, y, vy, which is the book's
    s, c, w = np.sin(0.6), np.cos(0.6), 0.2
    F = [[1, s / w, 0, -(1 - c) / w], [0, c, 0, -s], [0, (1 - c) / w, 1, s / w], [0, s, 0, c]]
    np.testing.assert_allclose(transition(TURN, T, turn_rate=w), F, rtol=1e-14)


TIMES = st.floats(0.01, 5.0)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(list(ORDERS)), TIMES, TIMES, st.floats(-2.0, 2.0))
def test_irregular_steps_compose(kind, first, second, rate):
    F1, F2, F = (transition(kind, T, 2, rate) for T in (first, second, first + second))
    Q1, Q2, Q = (process_noise(kind, T, 0.7, axes=2, turn_rate=rate) for T in (first, second, first + second))
    np.testing.assert_allclose(F2 @ F1, F, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, rtol=1e-11, atol=1e-11)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(list(ORDERS)), TIMES, st.sampled_from(["continuous", "piecewise"]), st.floats(-9.0, 9.0))
def test_noises_are_covariances(kind, T, noise_kind, rate):
    Q = process_noise(kind, T, 1.3, noise_kind, 2, rate)
    assert covariance_fault(Q) is None
    assert (Q == Q.T).all()
    rank = np.linalg.matrix_rank(Q, tol=1e-12 * np.trace(Q))
    assert rank == 2 if noise_kind == "piecewise" else covariance_fault(Q, definite=True) is None


def test_stacks_are_their_members():
    T, rate = np.array([0.5, 1.0, 2.0]), np.array([0.1, 0.0, -1.0])
    for k in range(3):
        np.testing.assert_array_equal(transition(TURN, T, turn_rate=rate)[k], transition(TURN, T[k], turn_rate=rate[k]))
        stack = process_noise(TURN, T, 2.0, turn_rate=rate)
        np.testing.assert_array_equal(stack[k], process_noise(TURN, T[k], 2.0, turn_rate=rate[k]))


def test_a_scenario_by_name_is_the_one_written_out():
    s, cv = read(), sf.load_scenario("cv-2d").model
    assert (s.model.states, s.model.units) == (cv.states, cv.units)
    np.testing.assert_array_equal(s.model.F, cv.F)
    np.testing.assert_allclose(s.model.Q, cv.Q, rtol=1e-15)
    s = read(kind="constant-acceleration", axes=1, H=[[1, 0, 0]])
    assert s.model.states == ("x", "vx", "ax")
    assert s.model.units == ("m", "m/s", "m/s²")
    assert read(kind="random-walk", axes=3, H=[[1, 0, 0]]).model.states == ("x", "y", "z")
    with pytest.raises(ValueError, match="read-only"):
        s.model.F[0, 0] = 7.0


def test_times_per_step():
    s = read(step=[99.0, 0.5, 1.0, 2.0])
    for k, T in ((1, 0.5), (2, 1.0), (3, 2.0)):
        np.testing.assert_array_equal(s.model.F[k], transition("constant-velocity", T))
        np.testing.assert_array_equal(s.model.Q[k], process_noise("constant-velocity", T, 0.5))
    alike = read(step=[0.0, 0.5, 0.5, 0.5])
    assert not alike.model.varies
    np.testing.assert_array_equal(alike.model.F, transition("constant-velocity", 0.5))
    turning = read(kind=TURN, turn_rate=[0, 0.1, 0.2, 0.2], step=2.0)
    np.testing.assert_array_equal(turning.model.F[2], transition(TURN, 2.0, turn_rate=0.2))


def test_a_network_of_one_step_takes_a_list_of_one():
    mapping = scenario(step=[0.0])
    mapping["network"]["steps"] = 1
    assert not sf.load_scenario(mapping).model.varies


def test_names_and_inputs_of_ones_own():
    s = read(states=["east", "ve", "north", "vn"], units=["km", "km/s", "km", "km/s"], B=[[0], [1], [0], [0]], u=2.0)
    assert s.model.states[0] == "east"
    assert s.model.Bu.ravel().tolist() == [0, 2, 0, 0]


def test_layouts():
    assert layout_of("constant-velocity", ["a", "b", "c", "d"]) == ((0, 2), (1, 3), ())
    assert layout_of(None, ["y", "x"]) == ((1, 0), (), ())
    assert layout_of(None, ["x", "vx", "bias"]) == ((0,), (1,), ())
    assert layout_of(None, ["x", "y", "vx"]) == ((0, 1), (), ())
    assert layout_of(None, ["x", "z"]) is None
    assert layout_of(None, ["x1", "x2"]) is None


def nominal(**model):
    return sf.load_scenario(scenario(**model)).nominal


def test_the_nominal_path_is_moved_on():
    path = nominal(nominal={"position": [1, 2], "velocity": [3, -1]}, step=[0, 1, 2, 0.5])
    np.testing.assert_allclose(path, [[1, 3, 2, -1], [4, 3, 1, -1], [10, 3, -1, -1], [11.5, 3, -1.5, -1]], rtol=1e-15)
    path = nominal(nominal={"position": [1, 2]}, B=[[0], [1], [0], [0]], u=2.0)
    np.testing.assert_allclose(path[:, 1], [0, 2, 4, 6], rtol=1e-15)
    path = nominal(
        kind="constant-acceleration",
        axes=1,
        H=[[1, 0, 0]],
        nominal={"position": 1.0, "velocity": 2.0, "acceleration": 4.0},
    )
    np.testing.assert_allclose(path[1], [5, 6, 4], rtol=1e-15)


def test_a_turn_comes_back():
    mapping = scenario(kind=TURN, turn_rate=2 * np.pi / 4, nominal={"position": [0, 0], "velocity": [1, 0]})
    mapping["network"]["steps"] = 5
    path = sf.load_scenario(mapping).nominal
    assert path is not None
    np.testing.assert_allclose(path[4], path[0], atol=1e-14)
    assert path[1][3] == pytest.approx(1.0)  # from x to y


def test_places_per_step_have_the_velocity_that_led_there():
    places = [[0, 0], [1, 0], [3, 4], [3, 6]]
    path = nominal(nominal={"position": places}, step=[0, 1, 2, 0.5])
    assert path is not None
    np.testing.assert_allclose(path[:, [1, 3]], [[1, 0], [1, 0], [1, 2], [0, 4]], rtol=1e-15)
    np.testing.assert_array_equal(path[:, [0, 2]], places)
    path = nominal(nominal={"position": places, "velocity": [7, 8]})
    assert path is not None
    np.testing.assert_array_equal(path[:, [1, 3]], [[7, 8]] * 4)
    np.testing.assert_array_equal(rates(np.zeros((1, 2)), 1.0), [[0, 0]])


WRONG = [
    ({"kind": "straight"}, 'model.kind: expected one of "random-walk", "constant-velocity", "constant-acceleration", '
     "\"coordinated-turn\", got 'straight'"),
    ({"F": [[1]]}, "model.F: expected nothing, since model.kind gives F and Q, got [[1]]"),
    ({"Q": 1}, "model.Q: expected nothing, since model.kind gives F and Q, got 1"),
    ({"G": 1}, "model.G: expected nothing, since model.kind gives F and Q, got 1"),
    ({"noise": None}, "model.noise: expected a density (continuous) or a standard deviation (piecewise) of at least 0, got nothing"),
    ({"noise": -1}, "model.noise: expected a density (continuous) or a standard deviation (piecewise) of at least 0, got -1"),
    ({"noise": "loud"}, "model.noise: expected a number, got 'loud'"),
    ({"noise_kind": "jerky"}, 'model.noise_kind: expected one of "continuous", "piecewise", got \'jerky\''),
    ({"axes": 4}, "model.axes: expected 1, 2 or 3, got 4"),
    ({"axes": 0}, "model.axes: expected a whole number of at least 1, got 0"),
    ({"kind": TURN, "axes": 3, "turn_rate": 1}, "model.axes: expected 2, the plane of a coordinated turn, got 3"),
    ({"kind": TURN}, "model.turn_rate: expected the turn rate in rad/s, or one per step, got nothing"),
    ({"kind": TURN, "turn_rate": [0.1]}, "model.turn_rate: expected one number for each of the 4 steps, got 1 numbers"),
    ({"turn_rate": 0.1}, 'model.turn_rate: expected nothing unless model.kind is "coordinated-turn", got 0.1'),
    ({"step": 0}, "model.step: expected a time from 1e-12 to 1e+09 s, or one per step, got 0"),
    ({"step": [0, 1, -1, 1]}, "model.step: expected a time from 1e-12 to 1e+09 s, or one per step, got -1"),
    ({"step": [1, 1]}, "model.step: expected one number for each of the 4 steps, got 2 numbers"),
    ({"step": [[1, 1, 1, 1]]}, "model.step: expected a number, or one per step, got [[1, 1, 1, 1]]"),
    ({"kind": None, "F": 1, "Q": 1, "H": 1, "R": 1}, "model.noise: expected nothing without model.kind, got 0.5"),
    ({"kind": None}, "model.F: expected a value, got nothing"),
    ({"nominal": {"velocity": [1, 1]}}, "model.nominal.position: expected a value, got nothing"),
    ({"nominal": {"position": [1, 2, 3]}}, "model.nominal.position: expected a list of 2 numbers, or one such list per step, got [1, 2, 3]"),
    ({"nominal": {"position": [[1, 2]]}}, "model.nominal.position: expected one list for each of the 4 steps, got 1 lists"),
    ({"nominal": {"position": [1, 2], "velocity": [[1, 2]] * 4}}, "model.nominal.velocity: expected a list of 2 numbers, got [[1, 2]"),
    ({"nominal": {"position": [1, 2], "speed": 3}}, "model.nominal.speed: expected a known key, got an unknown one, 'speed'"),
    ({"nominal": {"position": [1, 2], "acceleration": [0, 0]}}, "model.nominal.acceleration: expected nothing, since the model has no acceleration, got [0, 0]"),
    ({"nominal": {"position": [1, 2], "velocity": [1e100, 1e100]}}, "model.nominal: expected a path that stays within 1e+100, got one that model.F takes beyond"),
    ({"H": None, "R": None}, "model.H: expected a value, got nothing"),
    ({"R": None}, "model.R: expected a value, got nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("model", "message"), WRONG)
def test_what_does_not_fit_is_named_once(model, message):
    with pytest.raises(sf.ScenarioError, match=re.escape(message)) as caught:
        read(**model)
    paths = [problem.path for problem in caught.value.problems]
    assert len(paths) == len(set(paths)), paths


def test_a_nominal_path_needs_states_that_tell_the_place():
    with pytest.raises(
        sf.ScenarioError, match=r"model.nominal: expected model.kind, or states named x, y and z .*got states x1, x2"
    ):
        read(kind=None, noise=None, F=[[1, 0], [0, 1]], Q=1, H=[[1, 0]], R=1, nominal={"position": [0, 0]})


def test_noise_from_the_command_line():
    s = sf.load_scenario(scenario(), q=8.0)
    np.testing.assert_array_equal(s.model.Q, process_noise("constant-velocity", 1.0, 8.0))
    s = sf.load_scenario(scenario(noise_kind="piecewise"), q=9.0)
    np.testing.assert_array_equal(s.model.Q, process_noise("constant-velocity", 1.0, 3.0, "piecewise"))
    # as G Q Gᵀ with a Q of 9 is
    hand = scenario(
        kind=None, noise=None, F=s.model.F, G=[[0.5, 0], [1, 0], [0, 0.5], [0, 1]], Q=1.0, states=list(s.model.states)
    )
    np.testing.assert_array_equal(sf.load_scenario(hand, q=9.0).model.Q, s.model.Q)
    with pytest.raises(sf.ScenarioError, match=r"model.noise: expected a density .* got -1"):
        sf.load_scenario(scenario(noise_kind="piecewise"), q=-1.0)
    assert sf.load_scenario(scenario(), p0=3.0).P0.tolist() == (3.0 * np.eye(4)).tolist()
