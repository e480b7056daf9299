"""The INS error model: against a nonlinear strapdown mechanisation written here, textbook growth and van Loan's method."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import stochfuse
from stochfuse.errors import UsageError
from stochfuse.fusion.inertial import (
    STATES,
    UNITS,
    ImuGrade,
    InitialErrors,
    compose,
    discretise,
    error_dynamics,
    error_model,
    noise_density,
)
from stochfuse.fusion.trajectory import Leg, Trajectory, geodetic, trajectory
from stochfuse.fusion.trajectory import displaced as moved_on
from stochfuse.kalman.kernel import Estimate, predict, update
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.navigation import read_navigation
from stochfuse.scenario.schema import NavigationTable
from tests.oracles.strategies import seeds

OMEGA, A, E2 = 7.292115e-5, 6378137.0, 6.69437999014e-3
PRESET = next((Path(stochfuse.__file__).parent / "scenario" / "presets").glob("gps-ins.toml*"))
LEGS = [Leg(5, 1.0), Leg(10, 0, np.deg2rad(4)), Leg(10, -0.5, np.deg2rad(-3), 6), Leg(10, 1.0, 0.0, -2)]
# Honeywell HG1700, see the preset gps-ins; in-run instability a tenth of the turn-on bias, over an hour
TACTICAL = ImuGrade.from_data_sheet(
    angle_random_walk=0.125, velocity_random_walk=0.0198, gyro=(1.0, 0.1, 3600.0), accelerometer=(1.0, 0.1, 3600.0)
)
NO_BIAS_DECAY = ImuGrade(0, 0, 0, 0, np.inf, 0, 0, np.inf)
SMALL = InitialErrors(np.full(3, 1e-3), np.full(3, 0.1), np.full(3, 3.0))


# ---- a nonlinear strapdown mechanisation, with curvilinear position and the full ellipsoid


def earth(L, h):
    s = 1 - E2 * np.sin(L) ** 2
    RN, RE = A * (1 - E2) / s**1.5, A / np.sqrt(s)
    g = 9.7803253359 * (1 + 0.001931853 * np.sin(L) ** 2) / np.sqrt(s) / (1 + h / np.sqrt(RN * RE)) ** 2
    return RN + h, RE + h, g


def cross(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def mechanisation(state, gyro, accelerometer):
    """Rates of (C, v, latitude, longitude, height) from what the sensors say, in the vehicle's axes."""
    C, v, L, _, h = state
    RN, RE, g = earth(L, h)
    ie = OMEGA * np.array([np.cos(L), 0, -np.sin(L)])
    en = np.array([v[1] / RE, -v[0] / RN, -v[1] * np.tan(L) / RE])
    C_rate = C @ cross(gyro) - cross(ie + en) @ C
    v_rate = C @ accelerometer + np.array([0, 0, g]) - np.cross(2 * ie + en, v)
    return C_rate, v_rate, v[0] / RN, v[1] / (RE * np.cos(L)), -v[2]


def displaced(state, x):
    """The state of a computer whose errors are x (its first nine)."""
    C, v, L, longitude, h = state
    RN, RE, _ = earth(L, h)
    tilted = Rotation.from_rotvec(x[:3]).as_matrix() @ C
    return tilted, v + x[3:6], L + x[6] / RN, longitude + x[7] / (RE * np.cos(L)), h - x[8]


def errors(computed, true):
    RN, RE, _ = earth(true[2], true[4])
    psi = Rotation.from_matrix(computed[0] @ true[0].T).as_rotvec()
    position = [
        RN * (computed[2] - true[2]),
        RE * np.cos(true[2]) * (computed[3] - true[3]),
        true[4] - computed[4],
    ]
    return np.concatenate([psi, computed[1] - true[1], position])


def error_rates(x, state, gyro, accelerometer):
    """d/dt of the nine errors when the computer's errors are x and its sensors' biases x[9:]."""
    wrong, right = displaced(state, x), state
    there = mechanisation(wrong, gyro + x[9:12], accelerometer + x[12:])
    here = mechanisation(right, gyro, accelerometer)
    step = 1e-4  # s: differences of the errors along both ways, central in time
    ahead, back = (
        errors(
            tuple(a + sign * step * b for a, b in zip(wrong, there, strict=True)),
            tuple(a + sign * step * b for a, b in zip(right, here, strict=True)),
        )
        for sign in (1, -1)
    )
    return (ahead - back) / (2 * step)


def rotation_rates(x, state, gyro, accelerometer):
    """The attitude's error rate exactly: of (I + ψ×) = computed·trueᵀ to first order."""
    wrong = displaced(state, x)
    there = mechanisation(wrong, gyro + x[9:12], accelerometer + x[12:])[0]
    here = mechanisation(state, gyro, accelerometer)[0]
    change = there @ state[0].T + wrong[0] @ here.T
    return 0.5 * np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_error_dynamics_are_the_derivative_of_a_nonlinear_mechanisation(seed):
    rng = np.random.default_rng(seed)
    C = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    v = rng.normal(size=3) * [150, 150, 20]
    state = (C, v, rng.uniform(-1.2, 1.2), 0.3, rng.uniform(0, 1e4))
    gyro, accelerometer = rng.normal(size=3) * 0.2, rng.normal(size=3) * 10
    path = Trajectory(*(np.array([a]) for a in (0.0, state[2], state[4], np.zeros(3), v, C @ accelerometer, gyro, C)))
    F = error_dynamics(path, NO_BIAS_DECAY)[0]
    scales = np.repeat([1e-4, 1.0, 100.0, 1e-4, 1e-1], 3)
    for column, scale in enumerate(scales):
        x = np.zeros(15)
        x[column] = scale
        slope = (error_rates(x, state, gyro, accelerometer) - error_rates(-x, state, gyro, accelerometer)) / (2 * scale)
        slope[:3] = rotation_rates(x, state, gyro, accelerometer) - rotation_rates(-x, state, gyro, accelerometer)
        slope[:3] /= 2 * scale
        # R_N, R_E and gravity vary with latitude, by 1 % over one Earth radius, which F leaves out: v/R²·1e-2, g/R·5e-3,
        # v/R·1e-2 at some 500 m/s
        left_out = np.repeat([2e-13, 1.2e-8, 2e-6], 3) if 6 <= column < 9 else np.zeros(9)
        rounding = np.repeat([1e-15, 1e-9, 1e-5], 3) / scale
        np.testing.assert_array_less(np.abs(slope - F[:9, column]), 1e-6 * np.abs(slope) + left_out + rounding)
    assert not F[9:].any()


def test_biases_relax_with_their_correlation_times():
    path = trajectory([Leg(1)], speed=0, latitude=0.5)
    imu = ImuGrade(0, 0, 1, 2e-6, 50.0, 1, 3e-4, 20.0)
    np.testing.assert_allclose(error_dynamics(path, imu)[0, 9:, 9:], -np.diag([1 / 50] * 3 + [1 / 20] * 3))
    # stationary: the driving noise restores the variance that decays
    assert noise_density(imu)[9] == pytest.approx(2 * (2e-6) ** 2 / 50)
    assert noise_density(imu)[14] == pytest.approx(2 * (3e-4) ** 2 / 20)
    F, Q, *_ = error_model(path, imu, SMALL, 2, 100)
    np.testing.assert_allclose(np.diag(F[1] @ np.diag([0.0] * 9 + [4e-12] * 3 + [9e-8] * 3) @ F[1].T + Q[1])[9:],
                               [4e-12] * 3 + [9e-8] * 3, rtol=1e-8)  # fmt: skip


def integrate(state, path, ticks, gyro_bias, accelerometer_bias):
    """Runge–Kutta over pairs of ticks, with the sensors of the nominal path plus constant biases."""
    h = 2 * (path.time[1] - path.time[0])
    force = np.einsum("tji,tj->ti", path.attitude, path.specific_force) + accelerometer_bias
    rate = path.rate + gyro_bias

    def moved(state, slope, by):
        return tuple(a + by * b for a, b in zip(state, slope, strict=True))

    for k in range(0, ticks, 2):
        k1 = mechanisation(state, rate[k], force[k])
        k2 = mechanisation(moved(state, k1, h / 2), rate[k + 1], force[k + 1])
        k3 = mechanisation(moved(state, k2, h / 2), rate[k + 1], force[k + 1])
        k4 = mechanisation(moved(state, k3, h), rate[k + 2], force[k + 2])
        mean = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
        state = moved(state, mean, h)
    return state


@pytest.fixture(scope="module")
def flown():
    return trajectory(LEGS, speed=80, latitude=np.deg2rad(50), heading=0.4, height=300)


def nominal(path, tick):
    longitude = 0.0
    return (path.attitude[tick], path.velocity[tick], path.latitude[tick], longitude, path.height[tick])


def test_the_nominal_sensors_reproduce_the_nominal_way(flown):
    C, v, L, longitude, h = integrate(nominal(flown, 0), flown, 3000, 0, 0)
    RN, RE, _ = earth(L, h)
    np.testing.assert_allclose(v, flown.velocity[3000], atol=3e-3)
    np.testing.assert_allclose(C, flown.attitude[3000], atol=1e-5)
    np.testing.assert_allclose(RN * (L - flown.latitude[3000]), 0, atol=0.05)
    np.testing.assert_allclose(h, flown.height[3000], atol=0.05)
    assert longitude * RE * np.cos(L) == pytest.approx(flown.displacement[3000, 1], rel=1e-3)


def test_composed_transition_carries_the_errors_of_a_nonlinear_mechanisation(flown):
    model = error_model(flown, NO_BIAS_DECAY, SMALL, 11, 100)
    Phi = np.linalg.multi_dot(model.F[:0:-1])
    rng = np.random.default_rng(5)
    true = integrate(nominal(flown, 0), flown, 1000, 0, 0)
    for block in range(5):  # one kind of error at a time, so that none hides another
        x = np.zeros(15)
        x[3 * block : 3 * block + 3] = rng.normal(size=3) * [1e-4, 0.1, 10, 1e-6, 1e-3][block]
        ends = [
            integrate(displaced(nominal(flown, 0), sign * x), flown, 1000, sign * x[9:12], sign * x[12:])
            for sign in (1, -1)
        ]
        found = 0.5 * (errors(ends[0], true) - errors(ends[1], true))
        expected = (Phi @ x)[:9]
        for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
            size = np.abs(expected[part]).max()
            # what a wrong position does to attitude and velocity leaves out how radii and gravity vary: 1 %
            near = 1e-2 if block == 2 and part.start < 6 else 1e-5
            np.testing.assert_allclose(found[part], expected[part], rtol=0, atol=near * size)


# ---- discretisation


def van_loan(F, density, t):
    d = len(F)
    block = expm(np.block([[-F, np.diag(density)], [np.zeros((d, d)), F.T]]) * t)
    Phi = block[d:, d:].T
    return Phi, Phi @ block[:d, d:]


def test_discretisation_matches_van_loan():
    path = trajectory([Leg(1)], speed=0, latitude=0.7)
    F, density = error_dynamics(path, TACTICAL), noise_density(TACTICAL)
    Phi, Q = compose(*discretise(F, density, 0.01), 100)
    exact_Phi, exact_Q = van_loan(F[0], density, 1.0)
    scale = np.sqrt(np.diag(exact_Q))
    np.testing.assert_allclose(Phi[0] * scale / scale[:, None], exact_Phi * scale / scale[:, None], atol=1e-6)
    np.testing.assert_allclose(Q[0] / np.outer(scale, scale), exact_Q / np.outer(scale, scale), atol=1e-6)


def test_discretisation_is_of_second_order_along_a_manoeuvre():
    path = trajectory(LEGS, speed=80, latitude=0.9, rate=1600)
    found = []
    for thinned in (1, 64, 32, 16):  # 1600, 25, 50 and 100 Hz along the same way
        thin = Trajectory(*(a[::thinned] for a in path))
        model = error_model(thin, TACTICAL, SMALL, 4, 8000 // thinned)
        scale = np.sqrt(np.diag(model.Q[3]))
        found.append(np.concatenate([model.F[3] * scale / scale[:, None], model.Q[3] / np.outer(scale, scale)]))
    errors_of = [np.abs(each - found[0]).max() for each in found[1:]]
    assert errors_of[0] < 1e-3
    assert errors_of[1] < errors_of[0] / 3.5
    assert errors_of[2] < errors_of[1] / 3.5


@given(seeds, st.integers(1, 4), st.integers(1, 13))
def test_composition_is_the_plain_loop(seed, groups, count):
    rng = np.random.default_rng(seed)
    Phi = np.eye(3) + 0.3 * rng.normal(size=(groups * count, 3, 3))
    root = rng.normal(size=(groups * count, 3, 3))
    Q = root @ np.swapaxes(root, -1, -2)
    all_Phi, all_Q = compose(Phi, Q, count)
    for group in range(groups):
        F, noise = np.eye(3), np.zeros((3, 3))
        for k in range(group * count, (group + 1) * count):
            F, noise = Phi[k] @ F, Phi[k] @ noise @ Phi[k].T + Q[k]
        np.testing.assert_allclose(all_Phi[group], F, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(all_Q[group], noise, rtol=1e-10, atol=1e-10 * np.abs(noise).max())


def test_process_noise_is_symmetric_and_positive_semi_definite(flown):
    model = error_model(flown, TACTICAL, SMALL, 36, 100)
    np.testing.assert_array_equal(model.Q, np.swapaxes(model.Q, 1, 2))
    scale = np.sqrt(np.diagonal(model.Q, axis1=1, axis2=2)[1:])
    scaled = model.Q[1:] / (scale[:, :, None] * scale[:, None, :])
    assert np.linalg.eigvalsh(scaled).min() > 0
    np.testing.assert_array_equal(model.F[0], np.eye(15))
    assert not model.Q[0].any()


def test_blocks_of_ticks_do_not_show():
    path = trajectory([*LEGS, Leg(80, 0, 0.02)], speed=80, latitude=0.9)
    short = trajectory([*LEGS, Leg(80, 0, 0.02)], speed=80, latitude=0.9, duration=2)
    long, part = (error_model(p, TACTICAL, SMALL, n, 50) for p, n in ((path, 231), (short, 4)))
    np.testing.assert_allclose(part.F[1:], long.F[1:4], rtol=1e-12, atol=1e-12)
    tick = 0.01
    late = slice(200 * 50, 201 * 50 + 1)
    Phi, _ = discretise(error_dynamics(Trajectory(*(a[late] for a in path)), TACTICAL), noise_density(TACTICAL), tick)
    np.testing.assert_allclose(np.linalg.multi_dot(Phi[::-1]), long.F[201], rtol=1e-10, atol=1e-10)


# ---- what the textbooks say of an unaided system


def test_schuler_period_of_a_vehicle_at_rest():
    latitude = np.deg2rad(45)
    path = trajectory([Leg(1)], speed=0, latitude=latitude)
    F = error_dynamics(path, NO_BIAS_DECAY)[0]
    RN, RE, g = earth(latitude, 0.0)
    eigenvalues = np.linalg.eigvals(F[:9, :9])
    swings = np.sort(eigenvalues.imag[eigenvalues.imag > 2 * OMEGA])
    schuler = np.sqrt(g / np.sqrt(RN * RE))
    assert 2 * np.pi / schuler / 60 == pytest.approx(84.4, abs=0.1)
    assert 2 * np.pi / swings.mean() / 60 == pytest.approx(84.4, abs=0.2)
    # its plane turns as Foucault's pendulum does, which splits the frequency by ±Ω sin L
    np.testing.assert_allclose(np.diff(swings), 2 * OMEGA * np.sin(latitude), rtol=1e-2)
    # the vertical channel runs away with √(2g/R)
    assert eigenvalues.real.max() == pytest.approx(np.sqrt(2) * schuler, rel=1e-2)


def test_a_tilt_swings_as_one_minus_cosine():
    path = trajectory([Leg(1)], speed=0, latitude=0.0)
    F = error_dynamics(path, NO_BIAS_DECAY)[0]
    RN, _, g = earth(0.0, 0.0)
    schuler = np.sqrt(g / RN)
    for part in (0.05, 0.25, 0.5):  # of a period, about east, into the north channel
        swing = expm(F * part * 2 * np.pi / schuler)[6, 1]
        assert swing == pytest.approx(-RN * (1 - np.cos(2 * np.pi * part)), rel=2e-2)


def drift(imu, source=None, deviation=0.0, t=100):
    """Standard deviations of the errors after t seconds at rest, facing north, from one source alone."""
    path = trajectory([Leg(t)], speed=0, latitude=np.deg2rad(45))
    model = error_model(path, imu, SMALL, t + 1, 100)
    P = np.zeros((15, 15))
    if source is not None:
        P[STATES.index(source), STATES.index(source)] = deviation**2
    now = Estimate(None, P)
    for F, Q in zip(model.F[1:], model.Q[1:], strict=True):
        now = predict(now, F, Q)
    return dict(zip(STATES, np.sqrt(np.diag(now.P)), strict=True))


G45 = 9.80620


@pytest.mark.parametrize(
    ("imu", "source", "deviation", "state", "expected"),
    [
        (NO_BIAS_DECAY, "accX", 0.01, "pN", 0.5 * 0.01 * 100**2),
        (NO_BIAS_DECAY, "accY", 0.01, "pE", 0.5 * 0.01 * 100**2),
        (NO_BIAS_DECAY, "accZ", 0.01, "pD", 0.5 * 0.01 * 100**2),
        (NO_BIAS_DECAY, "gyroY", 5e-6, "pN", G45 * 5e-6 * 100**3 / 6),
        (NO_BIAS_DECAY, "gyroX", 5e-6, "pE", G45 * 5e-6 * 100**3 / 6),
        (NO_BIAS_DECAY, "gyroZ", 5e-6, "yaw", 5e-6 * 100),
        (NO_BIAS_DECAY, "tiltE", 1e-3, "pN", 0.5 * G45 * 1e-3 * 100**2),
        (NO_BIAS_DECAY, "vE", 0.1, "pE", 0.1 * 100),
        (ImuGrade(0, 3e-4, 0, 0, np.inf, 0, 0, np.inf), None, 0, "pN", 3e-4 * np.sqrt(100**3 / 3)),
        (ImuGrade(0, 3e-4, 0, 0, np.inf, 0, 0, np.inf), None, 0, "vE", 3e-4 * np.sqrt(100)),
        (ImuGrade(4e-5, 0, 0, 0, np.inf, 0, 0, np.inf), None, 0, "pN", G45 * 4e-5 * np.sqrt(100**5 / 20)),
        (ImuGrade(4e-5, 0, 0, 0, np.inf, 0, 0, np.inf), None, 0, "yaw", 4e-5 * np.sqrt(100)),
    ],
)
def test_free_inertial_errors_grow_as_the_textbook_says(imu, source, deviation, state, expected):
    assert drift(imu, source, deviation)[state] == pytest.approx(expected, rel=1.5e-2)


def aided(path):
    """Standard deviations after fixes of 3 m and 0.1 m/s in every step, and the model."""
    model = error_model(path, TACTICAL, InitialErrors(np.full(3, 0.02), np.full(3, 0.1), np.full(3, 3.0)), 61, 100)
    now = Estimate(None, model.P0)
    for F, Q in zip(model.F[1:], model.Q[1:], strict=True):
        now = update(predict(now, F, Q), model.H_gps, np.diag([9.0] * 3 + [0.01] * 3))
    return dict(zip(STATES, np.sqrt(np.diag(now.P)), strict=True))


def test_heading_shows_only_in_manoeuvres():
    straight = aided(trajectory([Leg(60)], speed=60, latitude=0.8))
    turning = aided(trajectory([Leg(20, 1.0), Leg(20, 0, 0.05), Leg(20, 0, -0.05)], speed=60, latitude=0.8))
    assert straight["yaw"] > 0.019
    assert turning["yaw"] < 0.005
    assert max(turning[name] for name in ("pN", "pE", "pD")) < 1.5


# ---- the nominal way


def test_a_coordinated_turn_presses_across_the_wings_alone():
    path = trajectory([Leg(40, 0, np.deg2rad(3))], speed=75, latitude=0.8)
    body = np.einsum("tji,tj->ti", path.attitude, path.specific_force)
    np.testing.assert_allclose(body[:, 1], 0, atol=1e-12)
    assert (body[:, 2] < -9.8).all()
    bank = np.arctan2(path.attitude[:, 2, 1], path.attitude[:, 2, 2])
    # the Coriolis force adds 2Ωv, a thousandth of g
    np.testing.assert_allclose(bank, np.arctan(75 * np.deg2rad(3) / 9.81), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(path.velocity, axis=1), 75, rtol=1e-12)
    np.testing.assert_allclose(path.rate[100:-100, 2], np.deg2rad(3) * np.cos(bank[100:-100]), atol=2e-4)


def test_legs_do_what_they_say(flown):
    speeds = np.linalg.norm(flown.velocity[:, :2], axis=1)
    heading = np.unwrap(np.arctan2(flown.velocity[:, 1], flown.velocity[:, 0]))
    # between two legs the roll-in is shared: in the middle of a leg the manoeuvre is its own
    for tick, speed, course in ((1000, 85, 0.4 + np.deg2rad(20)), (2000, 82.5, 0.4 + np.deg2rad(40 - 15))):
        assert speeds[tick] == pytest.approx(speed, rel=1e-3)
        assert heading[tick] == pytest.approx(course, abs=1e-3)
    assert -flown.velocity[2000, 2] == pytest.approx(3.0, abs=0.02)
    assert -flown.velocity[-1, 2] == pytest.approx(-2.0, abs=0.02)
    np.testing.assert_allclose(np.gradient(flown.displacement, 0.01, axis=0)[1:-1], flown.velocity[1:-1], atol=1e-3)
    acceleration = np.gradient(flown.velocity, 0.01, axis=0)[1:-1]
    g = earth(flown.latitude[1:-1], flown.height[1:-1])[2]
    coriolis = flown.specific_force[1:-1] + g[:, None] * [0, 0, 1] - acceleration
    assert np.abs(coriolis).max() < 2.1 * OMEGA * 90
    np.testing.assert_allclose(
        flown.attitude @ np.swapaxes(flown.attitude, 1, 2), np.tile(np.eye(3), (3501, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(flown.attitude), 1)


@pytest.mark.parametrize(
    ("legs", "given", "message"),
    [
        ([], {}, "legs: expected at least one leg, got none"),
        ([Leg(5), Leg(-1)], {}, "leg 2: expected a positive duration, got -1 s"),
        ([Leg(5), Leg(10, -7)], {}, r"leg 2: expected a ground speed of at least 0, got -10 m/s at its end"),
        ([Leg(5)], {"duration": 6}, "legs: expected at least 6 s together, got 5 s"),
        ([Leg(0.01)], {}, r"legs: expected at least 0.02 s together, got 0.01 s"),
        ([Leg(10, 0, 0, -98)], {}, "legs: expected manoeuvres with at least 1 m/s² of specific force across"),
        ([Leg(5)], {"latitude": 1.56}, "legs: expected a way that keeps a degree from the poles"),
    ],
)
def test_ways_that_cannot_be_taken(legs, given, message):
    with pytest.raises(UsageError, match=message):
        trajectory(legs, **{"speed": 60, "latitude": 0.5, **given})


def test_geodetic_places_are_as_far_apart_as_the_way_is_long(flown):
    def ecef(where):
        L, λ, h = where.T
        transverse = A / np.sqrt(1 - E2 * np.sin(L) ** 2)
        across = (transverse + h) * np.cos(L)
        return np.stack([across * np.cos(λ), across * np.sin(λ), ((1 - E2) * transverse + h) * np.sin(L)], axis=1)

    path = flown
    where = geodetic(path, 50)
    gone = path.velocity[1:] + path.velocity[:-1]
    ways = np.linalg.norm(np.diff(ecef(geodetic(path)), axis=0), axis=1)
    np.testing.assert_allclose(ways, np.linalg.norm(gone, axis=1) / 2 * np.diff(path.time), rtol=1e-5)
    L, λ, _ = where.T
    north = np.stack([-np.sin(L) * np.cos(λ), -np.sin(L) * np.sin(λ), np.cos(L)], axis=1)
    east = np.stack([-np.sin(λ), np.cos(λ), 0 * λ], axis=1)
    up = np.cross(east, north)
    moved = ecef(moved_on(where, np.tile([3.0, -5.0, 7.0], (len(where), 1)))) - ecef(where)
    np.testing.assert_allclose(moved, 3 * north - 5 * east - 7 * up, atol=1e-4)


def test_a_vehicle_comes_to_rest_and_stays():
    path = trajectory([Leg(3.333, -3.0), Leg(5)], speed=9.999, latitude=0.5)
    assert np.isfinite(path.attitude).all()
    assert np.abs(path.velocity[-1]).max() < 0.02
    np.testing.assert_allclose(path.attitude[-1], np.eye(3), atol=1e-3)


def test_a_trajectory_shorter_than_the_steps():
    with pytest.raises(UsageError, match="trajectory: expected one of 12 steps of 100 ticks, got one of 11"):
        error_model(trajectory([Leg(10)], speed=1, latitude=0.5), TACTICAL, SMALL, 12, 100)


# ---- the table of a scenario file


@pytest.fixture(scope="module")
def preset():
    return tomllib.loads(PRESET.read_text(encoding="utf-8"))


def test_the_preset_is_read(preset):
    NavigationTable.model_validate(preset["navigation"])
    check = Checker()
    model = read_navigation(check, preset["navigation"], preset["network"]["steps"])
    assert not check.problems
    assert model is not None
    assert model.F.shape == model.Q.shape == (101, 15, 15)
    assert len(model.trajectory.time) == 10_001
    assert model.states == STATES
    assert model.units == UNITS
    sigma = dict(zip(STATES, np.sqrt(np.diag(model.P0)), strict=True))
    assert sigma["yaw"] == pytest.approx(np.pi / 180)
    assert sigma["pD"] == pytest.approx(6.6)
    assert sigma["gyroZ"] == pytest.approx(np.hypot(1, 0.1) * np.pi / 180 / 3600)
    assert sigma["accX"] == pytest.approx(np.hypot(1, 0.1) * 9.80665e-3)
    for receiver in preset["agent"][1:]:
        np.testing.assert_array_equal(receiver["H"], model.H_gps)
        assert np.linalg.eigvalsh(receiver["R"]).min() > 0


def test_the_tactical_grade_in_si_units():
    # as IS4S NavToolkit's hg1700_model has them
    assert TACTICAL.angle_random_walk == pytest.approx(3.6361e-5, rel=1e-4)
    assert TACTICAL.velocity_random_walk == pytest.approx(3.302e-4, rel=1e-3)
    assert TACTICAL.gyro_bias == pytest.approx(4.8481e-6, rel=1e-4)
    assert TACTICAL.accelerometer_bias == pytest.approx(9.81e-3, rel=1e-3)


def test_one_step_needs_no_way(preset):
    check = Checker()
    model = read_navigation(check, preset["navigation"], 1)
    assert not check.problems
    assert model is not None
    np.testing.assert_array_equal(model.F, np.eye(15)[None])


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("latitude", 91, r"navigation.latitude: expected a number of at least -85 and at most 85 °.*, got 91"),
        ("speed", -3.0, r"navigation.speed: expected a number of at least 0 and at most 10000 m/s, got -3.0"),
        ("speed", float("nan"), r"navigation.speed: expected a number .*, got a value that is not finite"),
        ("rate", 0, r"navigation.rate: expected a number above 0 and at most 100000 Hz, got 0"),
        ("rate", 99.5, r"navigation.rate: expected a whole number of ticks in each interval of 1 s, got 99.5 at 99.5 Hz"),
        ("rate", 20_000, r"navigation.rate: expected at most 1000000 ticks in all, got 2000000"),
        ("interval", 0.005, r"navigation.rate: expected a whole number of ticks .* of 0.005 s, got 0.5 at 100 Hz"),
        ("interval", 2, r"navigation.leg: expected legs of at least 200 s together, for 101 steps of 2 s, got 100 s"),
        ("leg", [], r"navigation.leg: expected at least one \[\[navigation.leg\]\] table, got none"),
        ("leg.1.duration", -30, r"navigation.leg\[2\].duration: expected a number above 0 .* s, got -30"),
        ("leg.4.acceleration", -9, r"navigation.leg: expected a way that a vehicle can take, got \(leg 5: expected a ground"),
        ("imu.gyro_bias", -1, r"navigation.imu.gyro_bias: expected a number of at least 0 .* °/h, got -1"),
        ("imu.gyro_time", 0, r"navigation.imu.gyro_time: expected a number of at least 0.001 .* s, got 0"),
        ("initial.velocity", [1, 2], r"navigation.initial.velocity: expected a list of 3 numbers, got \[1, 2\]"),
        ("initial.position", [1, -2, 1], r"navigation.initial.position: expected three standard deviations, each a number above 0"),
    ],
)  # fmt: skip
def test_problems_are_named_by_their_path(preset, path, value, message):
    table = copy.deepcopy(preset["navigation"])
    *way, last = path.split(".")
    place = table
    for part in way:
        place = place[int(part)] if part.isdigit() else place[part]
    place[last] = value
    check = Checker()
    assert read_navigation(check, table, 101) is None
    with pytest.raises(UsageError, match=message):
        raise UsageError("; ".join(map(str, check.problems)))
    assert len(check.problems) == 1


@pytest.mark.parametrize("broken", [{}, {"leg": 3, "imu": 4, "initial": [5]}, {"leg": [6]}])
def test_a_table_of_the_wrong_structure_is_left_to_the_schema(broken):
    check = Checker()
    assert read_navigation(check, broken, 5) is None
    with pytest.raises(ValidationError):
        NavigationTable.model_validate(broken)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"speeed": 3}, "extra_forbidden"),
        ({"speed": "fast"}, "float_type"),
        ({"speed": True}, "float_type"),
        ({"leg": [{"acceleration": 1}]}, "missing"),
        ({"imu": {}}, "missing"),
    ],
)
def test_the_schema_rejects(preset, change, kind):
    with pytest.raises(ValidationError) as caught:
        NavigationTable.model_validate({**preset["navigation"], **change})
    assert kind in {entry["type"] for entry in caught.value.errors()}
