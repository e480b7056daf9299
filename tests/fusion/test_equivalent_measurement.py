"""Equivalent measurement: against 50-digit minimisation, sampled errors, its bounds; the extended Kalman filter around it."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.equivalent import (
    actual_error,
    equivalent_measurement,
    independent_measurement,
)
from stochfuse.fusion.extended import NonlinearModel, extended_filter, extended_step, jacobian
from stochfuse.kalman.kernel import Estimate
from tests.oracles import textbook
from tests.oracles.strategies import covariance, seeds


def sources(rng, N, rank):
    """Integer square roots of R and Δ: mpmath squares them without rounding."""
    return rng.integers(-9, 10, size=(N, N)) + 20 * np.eye(N, dtype=int), rng.integers(-9, 10, size=(N, rank))


def trace_at(R, D, E, log_epsilon):
    e = mp.e**log_epsilon
    fused = mp.inverse(E.T * mp.inverse((1 + e) * R + (1 + 1 / e) * D) * E)
    return sum(fused[i, i] for i in range(fused.rows))


def least_trace(v, d, n):
    """Golden section in ln ε over ±60, 60 digits, on (EᵀS⁻¹E)⁻¹ as printed in handbook, mathematics."""
    with mp.workdps(60):
        R, D, E = (mp.matrix(M.tolist()) for M in (v @ v.T, d @ d.T, np.tile(np.eye(len(v) // n, dtype=int), (n, 1))))
        low, high, ratio = mp.mpf(-60), mp.mpf(60), (mp.sqrt(5) - 1) / 2
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        fa, fb = trace_at(R, D, E, a), trace_at(R, D, E, b)
        for _ in range(40):
            if fa < fb:
                high, b, fb = b, a, fa
                a = high - ratio * (high - low)
                fa = trace_at(R, D, E, a)
            else:
                low, a, fa = a, b, fb
                b = low + ratio * (high - low)
                fb = trace_at(R, D, E, b)
        return float(min(fa, fb))


@pytest.mark.parametrize(
    ("p", "n", "rank"), [(1, 2, 2), (1, 3, 1), (1, 4, 4), (2, 2, 4), (2, 3, 3), (2, 2, 1), (1, 3, 2)]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_epsilon_is_optimal_to_ten_digits(p, n, rank, seed):
    """Singular Δ puts some optima at the end ε → 0, where a combination of sensors is free of the disturbance."""
    v, d = sources(np.random.default_rng([seed, p, n, rank]), p * n, rank)
    got = equivalent_measurement((v @ v.T).astype(float), n, (d @ d.T).astype(float))
    assert got.R.trace() == pytest.approx(least_trace(v, d, n), rel=1e-10)


def test_a_weak_disturbance_is_balanced_and_a_strong_one_avoided():
    """With Δ = ddᵀ there are sensors' combinations without disturbance; they pay only where it is strong."""
    v, d = sources(np.random.default_rng(11), 3, 1)
    R = (v @ v.T).astype(float)
    strong, weak = (equivalent_measurement(R, 3, scale * d @ d.T) for scale in (1e4, 1e-4))
    assert strong.epsilon == 0
    np.testing.assert_allclose(strong.weights @ d, 0, atol=1e-13)
    a, b = (weak.weights @ C @ weak.weights.T for C in (R, 1e-4 * d @ d.T))
    assert weak.epsilon == pytest.approx(np.sqrt(b / a).item(), rel=1e-9)
    assert weak.epsilon > 1e-4


@given(seeds, st.integers(1, 3), st.integers(1, 4))
def test_weights_and_bound_are_the_formula_at_the_epsilon_found(seed, p, n):
    rng = np.random.default_rng(seed)
    R, D = (
        covariance(rng, p * n) + 0.1 * np.eye(p * n),
        10.0 ** rng.uniform(-3, 3) * (covariance(rng, p * n) + np.eye(p * n)),
    )
    got = equivalent_measurement(R, n, D)
    E = np.tile(np.eye(p), (n, 1))
    S = (1 + got.epsilon) * R + (1 + 1 / got.epsilon) * D
    fused = np.linalg.inv(E.T @ np.linalg.inv(S) @ E)
    np.testing.assert_allclose(got.R, fused, atol=1e-8 * fused.trace())
    np.testing.assert_allclose(got.weights, fused @ E.T @ np.linalg.inv(S), atol=1e-7 * np.abs(got.weights).max())
    np.testing.assert_allclose(got.weights @ E, np.eye(p), atol=1e-9)
    for i in range(n):
        own = slice(i * p, (i + 1) * p)
        a, b = R[own, own].trace(), D[own, own].trace()
        assert got.single[i].trace() == pytest.approx((np.sqrt(a) + np.sqrt(b)) ** 2, rel=1e-12)
        assert got.R.trace() <= got.single[i].trace() * (1 + 1e-12)
        at_common = S[own, own] - got.R
        assert np.linalg.eigvalsh(at_common).min() >= -1e-9 * S.trace()


def test_at_their_own_epsilon_single_bounds_need_not_exceed_the_fused_one_in_the_matrix_order():
    """Sensor 0 has hardly any noise and so a large ε; it gives state 0, but ε ≈ 1 serves both states, twice its bound."""
    got = equivalent_measurement(np.diag([1e-9, 1e-9, 1e3, 1.0]), 2, np.diag([1.0, 100.0, 1e3, 1e-9]))
    assert all(got.R.trace() < alone.trace() for alone in got.single)
    assert np.linalg.eigvalsh(got.single[0] - got.R).min() < -0.9


def worst_error(A, R, D):
    """Error covariance of A(v + δ) for the correlation of δ with v that makes its trace largest, E[δδᵀ] = D.

    With A R Aᵀ = L Lᵀ, A D Aᵀ = M Mᵀ and LᵀM = U Σ Vᵀ: of L w + M V Uᵀ w with white w, trace tr A(R + D)Aᵀ + 2 tr Σ.
    """
    # the square root of a zero's rounding would be no rounding
    roots = (
        U * np.sqrt(np.where(values > 1e-14 * values.max(), values, 0.0)) for values, U in map(np.linalg.eigh, (R, D))
    )
    L, M = (A @ root for root in roots)
    U, _, Vt = np.linalg.svd(L.T @ M)
    together = L + M @ Vt.T @ U.T
    return together @ together.T


@given(seeds, st.integers(1, 3), st.integers(1, 3))
def test_worst_error_lies_between_any_correlation_and_the_claim(seed, p, n):
    rng = np.random.default_rng(seed)
    R, D = covariance(rng, p * n) + 0.1 * np.eye(p * n), covariance(rng, p * n, rank=max(1, p * n - 1))
    got = equivalent_measurement(R, n, D)
    worst, alone = worst_error(got.weights, R, D).trace(), actual_error(got.weights, R, D).trace()
    assert alone <= worst * (1 + 1e-9)
    assert worst <= got.R.trace() * (1 + 1e-9)
    if p == 1:
        assert worst == pytest.approx(got.R.trace(), rel=1e-9)
    L, M = np.linalg.cholesky(R), np.linalg.cholesky(D + 1e-13 * np.eye(p * n) * D.trace())
    for _ in range(20):
        Q = np.linalg.qr(rng.normal(size=(p * n, p * n)))[0]
        together = got.weights @ (L + M @ Q)
        assert (together**2).sum() <= worst * (1 + 1e-5)


def test_the_claim_covers_sampled_errors_with_any_correlation():
    """In the matrix order, for Δ attained and fully correlated with v."""
    rng = np.random.default_rng(12)
    R, D = covariance(rng, 4) + np.eye(4), covariance(rng, 4)
    got = equivalent_measurement(R, 2, D)
    for _ in range(200):
        Q = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        error = got.weights @ (np.linalg.cholesky(R) + np.linalg.cholesky(D) @ Q)
        assert np.linalg.eigvalsh(got.R - error @ error.T).min() >= -1e-12 * got.R.trace()


def test_no_disturbance_is_least_squares_and_no_noise_is_least_squares_with_delta():
    C = covariance(np.random.default_rng(13), 6) + np.eye(6)
    E = np.tile(np.eye(2), (3, 1))
    fused = np.linalg.inv(E.T @ np.linalg.inv(C) @ E)
    for got, epsilon in (
        (equivalent_measurement(C, 3), 0.0),
        (equivalent_measurement(C, 3, np.zeros((6, 6))), 0.0),
        (equivalent_measurement(np.zeros((6, 6)), 3, C), np.inf),
    ):
        assert got.epsilon == epsilon
        np.testing.assert_allclose(got.R, fused, rtol=1e-11)
        np.testing.assert_allclose(got.weights, fused @ E.T @ np.linalg.inv(C), atol=1e-12)


def test_a_sensor_without_disturbance_is_taken_alone_where_that_is_best():
    got = equivalent_measurement(np.diag([1.0, 2, 3]), 3, np.diag([40.0, 0, 90]))
    np.testing.assert_allclose(got.weights, [[0, 1, 0]], atol=1e-14)
    assert got.R.item() == pytest.approx(2)
    assert got.epsilon == 0
    mirrored = equivalent_measurement(np.diag([40.0, 0, 90]), 3, np.diag([1.0, 2, 3]))
    assert mirrored.R.item() == pytest.approx(2)
    assert mirrored.epsilon == np.inf


def test_units_and_one_sensor():
    rng = np.random.default_rng(14)
    R, D = covariance(rng, 4) + np.eye(4), covariance(rng, 4)
    big, small = equivalent_measurement(R, 2, D), equivalent_measurement(1e-18 * R, 2, 1e-18 * D)
    np.testing.assert_allclose(small.R, 1e-18 * big.R, rtol=1e-9)
    assert small.epsilon == pytest.approx(big.epsilon, rel=1e-6)
    one = equivalent_measurement(R, 1, D)
    np.testing.assert_allclose(one.weights, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(one.R, one.single[0], rtol=1e-12)


def test_a_given_epsilon_is_used_and_refused_where_a_single_sensor_is_better():
    R, D = np.diag([1.0, 1.0]), np.diag([1.0, 1.0])
    given_one = equivalent_measurement(R, 2, D, epsilon=1.0)
    assert given_one.epsilon == 1
    assert given_one.R.item() == pytest.approx(2)
    assert equivalent_measurement(R, 2, D, epsilon=2.0).R.item() == pytest.approx(2.25)
    with pytest.raises(
        NoAnswerError,
        match=r"epsilon: expected a bound no larger than that of any single sensor, got trace 6\.05 at "
        r"epsilon = 0\.1, where sensors\[0\] alone has 4",
    ):
        equivalent_measurement(R, 2, D, epsilon=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-np.eye(2), 2), "R: expected a positive semi-definite matrix, got a variance of -1 on the diagonal"),
        (
            (np.eye(2), 2, np.array([[1.0, 2], [2, 1]])),
            r"Delta: expected a positive semi-definite matrix, got an indefinite one \(smallest eigenvalue.* -1\)",
        ),
        ((np.eye(2), 2, np.eye(3)), "Delta: expected a 2×2 matrix as R is, got 3×3"),
        ((np.eye(3), 2), "R: expected 2 sensors' blocks of one size, got a 3×3 matrix"),
        ((np.eye(3), 0), "R: expected 0 sensors' blocks of one size, got a 3×3 matrix"),
        ((np.stack([np.eye(2)] * 3), 2), "R: expected 2 sensors' blocks of one size, got a 3×2×2 matrix"),
        ((np.ones((2, 2)), 2), r"R \+ Delta: expected a positive definite matrix, got a singular one"),
        ((np.diag([1.0, 0]), 2, np.diag([1.0, 0])), r"R \+ Delta: expected a positive definite matrix, got a singular"),
        ((np.eye(2), 2, np.eye(2), 0.0), "epsilon: expected a positive finite number, got 0.0"),
        ((np.eye(2), 2, np.eye(2), np.nan), "epsilon: expected a positive finite number, got nan"),
        ((np.eye(2), 2, np.eye(2), np.inf), "epsilon: expected a positive finite number, got inf"),
    ],
)
def test_wrong_use(arguments, message):
    with pytest.raises(UsageError, match=message):
        equivalent_measurement(*arguments)


def test_independent_fusion_claims_what_it_does_not_hold():
    """Two alike sensors with correlation 0.9: claims half the variance, truly leaves 0.95 of it."""
    R = np.array([[1.0, 0.9], [0.9, 1.0]])
    got = independent_measurement(R, 2)
    np.testing.assert_allclose(got.weights, [[0.5, 0.5]])
    assert got.R.item() == pytest.approx(0.5)
    assert actual_error(got.weights, R) == pytest.approx(0.95)
    assert actual_error(got.weights, R, np.ones((2, 2))) == pytest.approx(1.95)
    unlike = independent_measurement(np.diag([1.0, 4.0, 3.0, 4.0]), 2)
    np.testing.assert_allclose(unlike.R, np.diag([0.75, 2.0]))
    np.testing.assert_array_equal(unlike.single[1], np.diag([3.0, 4.0]))


# ---- the extended Kalman filter


def test_linear_functions_give_the_kalman_filter():
    F, H = np.array([[1.0, 1], [0, 1]]), np.array([[1.0, 0]])
    Q, R = np.diag([0.05, 0.01]), np.array([[0.25]])
    z = np.array([np.nan, 0.9, 2, 3.1, 3.9, 5.2])[:, None, None]
    start = Estimate(np.array([[0.0], [1.0]]), np.eye(2))
    x, P = start
    for measured in z[1:]:
        prior = textbook.kalman_predict(P, F, Q)
        x, P = textbook.kalman_state(F @ x, prior, H, R, measured), textbook.kalman_update(prior, H, R)
    for jacobians in ((lambda x, k: F, lambda x, k: H), (None, None)):
        track = extended_filter(start, NonlinearModel(lambda x, k: F @ x, lambda x, k: H @ x, *jacobians), Q, R, z)
        np.testing.assert_allclose(track.x[-1], x, atol=1e-9)
        np.testing.assert_allclose(track.P[-1], P, atol=1e-9)
        np.testing.assert_allclose(track.x[-1].ravel(), [5.116244352839, 1.045095743855], atol=1e-9)


def test_nothing_arrived_leaves_the_prediction_and_half_a_measurement_is_refused():
    start = Estimate(np.ones((2, 1)), np.eye(2))
    got = extended_step(
        start, NonlinearModel(lambda x: x**2, lambda x: x, lambda x: np.diag(2 * x[:, 0])), np.eye(2), np.eye(2), None
    )
    np.testing.assert_array_equal(got.x, start.x)
    np.testing.assert_array_equal(got.P, 5 * np.eye(2))
    z = np.full((3, 2, 1), np.nan)
    track = extended_filter(start, NonlinearModel(lambda x, k: k * x, lambda x, k: x), 0 * np.eye(2), np.eye(2), z)
    np.testing.assert_allclose(track.x[:, 0, 0], [1, 2, 6])
    z[2, 0] = 1.0
    with pytest.raises(UsageError, match="z: expected at step 3 all entries or all NaN, got 1 NaN of 2"):
        extended_filter(start, NonlinearModel(lambda x, k: x, lambda x, k: x), np.eye(2), np.eye(2), z)
    with pytest.raises(UsageError, match="z: expected a column of 1 rows as R has, got an innovation of 2×1"):
        extended_step(start, NonlinearModel(lambda x: x, lambda x: x), np.eye(2), np.eye(1), np.ones((2, 1)))


def transition(x, step):
    """A damped pendulum, 0.1 s: angle and rate."""
    return np.concatenate(
        [x[..., :1, :] + 0.1 * x[..., 1:, :], 0.98 * x[..., 1:, :] - 0.981 * np.sin(x[..., :1, :])], -2
    )


def range_bearing(x, step):
    """From (1.5, -0.5) to the bob at the end of 1 m: nonlinear in the angle, two sensors' worth of position."""
    across, up = np.sin(x[..., :1, :]) - 1.5, -np.cos(x[..., :1, :]) + 0.5
    return np.concatenate([np.hypot(across, up), np.arctan2(up, across)], axis=-2)


def wrapped(z, expected):
    """Innovation whose second component is an angle."""
    difference = z - expected
    difference[..., 1, :] = (difference[..., 1, :] + np.pi) % (2 * np.pi) - np.pi
    return difference


Q, NOISE = np.diag([1e-5, 4e-4]), np.diag([0.02**2, 0.03**2])
STEPS, RUNS = 30, 400


def truth(rng):
    """Runs of the pendulum from a drawn start; noisy transitions."""
    start = np.array([[0.4], [0.0]])
    P0 = np.diag([0.05**2, 0.1**2])
    x = start + np.linalg.cholesky(P0) @ rng.normal(size=(RUNS, 2, 1))
    states = [x]
    for step in range(2, STEPS + 1):
        states.append(transition(states[-1], step) + np.linalg.cholesky(Q) @ rng.normal(size=(RUNS, 2, 1)))
    first = Estimate(np.broadcast_to(start, (RUNS, 2, 1)), P0)
    return first, np.array(states)


def squared(track, states):
    """NEES of each run at each step."""
    error = states - track.x
    return (np.swapaxes(error, -1, -2) @ np.linalg.solve(track.P, error))[..., 0, 0]


PENDULUM = NonlinearModel(transition, range_bearing, residual=wrapped)


def test_jacobian_of_a_stack():
    x = np.random.default_rng(15).normal(size=(5, 2, 1))
    got = jacobian(lambda x: transition(x, 1), x)
    want = np.stack([[[1, 0.1], [-0.981 * np.cos(angle), 0.98]] for angle in x[:, 0, 0]])
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_a_pendulum_seen_by_range_and_bearing_is_consistent():
    """NEES of 400 runs: its mean at each step is chi-square with 800 degrees of freedom over 400."""
    rng = np.random.default_rng(16)
    first, states = truth(rng)
    z = range_bearing(states, 0) + np.linalg.cholesky(NOISE) @ rng.normal(size=states.shape)
    z[:, :, 1, :] = (z[:, :, 1, :] + np.pi) % (2 * np.pi) - np.pi
    track = extended_filter(first, PENDULUM, Q, NOISE, z)
    mean = squared(track, states).mean(axis=1)
    low, high = chi2.ppf([0.001 / STEPS, 1 - 0.001 / STEPS], 2 * RUNS) / RUNS
    assert low < mean.min()
    assert mean.max() < high
    blind = extended_filter(first, PENDULUM, Q, NOISE, np.full_like(z, np.nan))
    assert (track.P[-1].trace(axis1=-2, axis2=-1) < 0.5 * blind.P[-1].trace(axis1=-2, axis2=-1)).all()


def test_equivalent_measurement_inside_the_filter_against_independent_fusion():
    """Two angle sensors on one shaking platform: noise correlation 0.8 and a common disturbance at each step."""
    rng = np.random.default_rng(17)
    first, states = truth(rng)
    R = 0.03**2 * np.array([[1.0, 0.8], [0.8, 1.0]])
    D = 0.02**2 * np.ones((2, 2))
    noise = np.linalg.cholesky(R) @ rng.normal(size=(STEPS, RUNS, 2, 1))
    offset = 0.02 * rng.normal(size=(STEPS, RUNS, 1, 1))
    z = np.sin(states[:, :, :1, :]) + noise + offset

    def sight(x, step):
        return np.sin(x[..., :1, :])

    ratio = {}
    for name, fused in (
        ("equivalent", equivalent_measurement(R, 2, D)),
        ("independent", independent_measurement(R, 2)),
    ):
        track = extended_filter(first, NonlinearModel(transition, sight), Q, fused.R, fused.weights @ z)
        error = states - track.x
        ratio[name] = (error[5:, :, 0, 0] ** 2).mean() / track.P[5:, ..., 0, 0].mean()
        mean = squared(track, states)[5:].mean()
        ratio[name + " NEES"] = mean / 2
    assert ratio["independent"] > 1.2
    assert ratio["independent NEES"] > 1.2
    assert ratio["equivalent"] < 1.0
    assert ratio["equivalent NEES"] < 1.0
