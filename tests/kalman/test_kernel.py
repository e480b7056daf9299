"""The kernel: against the textbook, published cases and 50-digit arithmetic; the same functions over symbols."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
import sympy
from hypothesis import given
from hypothesis import strategies as st

from stochfuse.kalman.algebra import FIELD, SYMPY
from stochfuse.kalman.kernel import (
    Estimate,
    Information,
    factor,
    from_factor,
    from_information,
    join_factors,
    predict,
    predict_factor,
    predict_information,
    to_information,
    update,
    update_factor,
    update_information,
)
from tests.oracles import textbook
from tests.oracles.strategies import covariance, model, same, seeds


@given(seeds, st.integers(1, 5), st.integers(1, 4))
def test_predict_and_update_match_the_textbook_in_every_form(seed, d, p):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P = model(rng, d, p)
    F = F + 2.0 * np.eye(d)  # the information form needs an inverse of F
    x, z, Bu = rng.normal(size=(d, 1)), rng.normal(size=(p, 1)), rng.normal(size=(d, 1))
    prior_P = textbook.kalman_predict(P, F, Q)
    prior_x = F @ x + Bu
    posterior_P = textbook.kalman_update(prior_P, H, R)
    posterior_x = textbook.kalman_state(prior_x, prior_P, H, R, z)

    got = update(predict(Estimate(x, P), F, Q, Bu), H, R, z)
    scale = np.abs(prior_P).max()
    np.testing.assert_allclose(got.P, posterior_P, atol=1e-9 * scale)
    np.testing.assert_allclose(got.x, posterior_x, atol=1e-8 * (1 + np.abs(posterior_x).max()))

    by_information = from_information(
        update_information(predict_information(to_information(Estimate(x, P)), F, Q, Bu), H, R, z)
    )
    np.testing.assert_allclose(by_information.P, posterior_P, atol=1e-7 * scale)
    np.testing.assert_allclose(by_information.x, posterior_x, atol=1e-6 * (1 + np.abs(posterior_x).max()))

    L = update_factor(predict_factor(factor(P), F, factor(Q)), H, R)
    np.testing.assert_allclose(from_factor(L), posterior_P, atol=1e-9 * scale)


@given(seeds, st.integers(1, 5), st.integers(1, 4))
def test_results_are_symmetric_and_positive_semidefinite_even_for_singular_input(seed, d, p):
    rng = np.random.default_rng(seed)
    F, _, H, R, _ = model(rng, d, p)
    P, Q = covariance(rng, d, rank=max(0, d - 1)), np.zeros((d, d))
    prior = predict(Estimate(None, P), F, Q)
    posterior = update(prior, H, R)
    for got in (prior.P, posterior.P, from_factor(update_factor(factor(P), H, R))):
        np.testing.assert_array_equal(got, got.T)
        assert np.linalg.eigvalsh(got).min() >= -1e-12 * max(1.0, np.abs(got).max())
    gain_in_information = prior.P - posterior.P
    assert np.linalg.eigvalsh(gain_in_information).min() >= -1e-10 * max(1.0, np.abs(prior.P).max())


def test_any_leading_batch_shape():
    rng = np.random.default_rng(1)
    models = [[model(rng, 3, 2) for _ in range(4)] for _ in range(2)]
    F, Q, H, R, P = (np.array([[m[i] for m in row] for row in models]) for i in range(5))
    batch = update(predict(Estimate(np.zeros((2, 4, 3, 1)), P), F, Q), H, R, np.ones((2, 4, 2, 1)))
    for i in range(2):
        for j in range(4):
            one = update(
                predict(Estimate(np.zeros((3, 1)), P[i, j]), F[i, j], Q[i, j]), H[i, j], R[i, j], np.ones((2, 1))
            )
            np.testing.assert_allclose(batch.P[i, j], one.P, rtol=1e-12, atol=1e-14)
            np.testing.assert_allclose(batch.x[i, j], one.x, rtol=1e-12, atol=1e-14)


def test_information_form_starts_from_no_information_at_all():
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    nothing = Information(np.zeros((2, 1)), np.zeros((2, 2)))
    information = nothing
    for z in (3.0, 5.0):
        information = update_information(
            predict_information(information, F, np.zeros((2, 2))), H, np.eye(1), np.array([[z]])
        )
    x, P = from_information(information)
    np.testing.assert_allclose(x.ravel(), [5.0, 2.0], atol=1e-12)  # the line through both measurements
    np.testing.assert_allclose(P, [[1.0, 1.0], [1.0, 2.0]], atol=1e-12)


@pytest.mark.parametrize("function", [update, update_information])
def test_a_state_without_a_measurement_is_an_error(function):
    given_estimate = (Estimate if function is update else Information)(np.zeros((1, 1)), np.eye(1))
    with pytest.raises(ValueError, match="expected a measurement z for an estimate that has a state; got None"):
        function(given_estimate, np.eye(1), np.eye(1))


EXTREMES = [
    (P, R, q) for P in (0.0, 1e-6, 1.0, 1e6, 1e12) for R in (1e-14, 1e-7, 1.0, 1e6, 1e12) for q in (0.0, 1e-9, 1.0)
]


@pytest.mark.parametrize(("P", "R", "q"), EXTREMES)
def test_scalar_kernel_against_50_digits(P, R, q):
    with mp.workdps(50):
        prior = mp.mpf(1.25) ** 2 * mp.mpf(P) + mp.mpf(q)
        exact = prior * mp.mpf(R) / (prior + mp.mpf(R))
    F, one = np.array([[1.25]]), np.eye(1)
    got = update(predict(Estimate(None, P * one), F, q * one), one, R * one).P[0, 0]
    root = from_factor(update_factor(predict_factor(factor(P * one), F, factor(q * one)), one, R * one))[0, 0]
    assert got == pytest.approx(float(exact), rel=1e-14, abs=0)
    assert root == pytest.approx(float(exact), rel=1e-13, abs=0)
    if P + q > 0:
        information = update_information(Information(None, one / (1.25**2 * P + q)), one, R * one)
        assert from_information(information).P[0, 0] == pytest.approx(float(exact), rel=1e-14, abs=0)


@pytest.mark.parametrize(("P", "R", "q"), EXTREMES)
@pytest.mark.parametrize("singular", [False, True])
def test_matrix_kernel_in_square_root_form_against_50_digits(P, R, q, singular):
    """Constant velocity with a position sensor; entrywise, scaled by the states' own standard deviations."""
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    P = P * (np.array([[1.0, 1.0], [1.0, 1.0]]) if singular else np.diag([1.0, 0.5]))
    Q, R = q * np.array([[1 / 3, 0.5], [0.5, 1.0]]), R * np.eye(1)
    with mp.workdps(50):
        Fm, Hm = textbook.mp_matrix(F), textbook.mp_matrix(H)
        exact = textbook.mp_update(Fm * textbook.mp_matrix(P) * Fm.T + textbook.mp_matrix(Q), Hm, textbook.mp_matrix(R))
        exact = np.array([[float(exact[i, j]) for j in range(2)] for i in range(2)])
    got = from_factor(update_factor(predict_factor(factor(P), F, factor(Q)), H, R))
    assert textbook.scaled_error(got, exact) < 1e-9
    joseph = update(predict(Estimate(None, P), F, Q), H, R).P
    # the covariance form promises rounding relative to the prior only
    assert np.abs(joseph - exact).max() <= 1e-15 * textbook.kalman_predict(P, F, Q).max()


def test_joining_factors_sums_their_covariances_without_squaring():
    rng = np.random.default_rng(2)
    A, B = rng.normal(size=(5, 3, 2)), rng.normal(size=(3, 7))
    joined = join_factors(A, B)
    assert joined.shape == (5, 3, 3)
    np.testing.assert_allclose(from_factor(joined), A @ np.swapaxes(A, -1, -2) + B @ B.T, atol=1e-12)
    narrow = join_factors(np.array([[1e-9], [0.0]]))
    np.testing.assert_allclose(from_factor(narrow), np.diag([1e-18, 0.0]), rtol=1e-12)


def test_the_same_functions_over_symbols():
    p1, p2, c, r, q, z = sympy.symbols("p1 p2 c r q z")
    F, H = sympy.Matrix([[1, 1], [0, 1]]), sympy.Matrix([[1, 0]])
    P = sympy.Matrix([[p1, c], [c, p2]])
    x = sympy.Matrix([0, 1])
    prior = predict(Estimate(x, P), F, q * sympy.eye(2), algebra=SYMPY)
    posterior = update(prior, H, sympy.Matrix([[r]]), sympy.Matrix([[z]]), algebra=SYMPY)
    values = {p1: 3.0, p2: 2.0, c: 0.5, r: 1.5, q: 0.25, z: 0.7}
    numeric = update(
        predict(
            Estimate(np.array([[0.0], [1.0]]), np.array([[3.0, 0.5], [0.5, 2.0]])), np.array(F, float), 0.25 * np.eye(2)
        ),
        np.array(H, float),
        np.array([[1.5]]),
        np.array([[0.7]]),
    )
    np.testing.assert_allclose(np.array(posterior.P.subs(values), float), numeric.P, rtol=1e-13)
    np.testing.assert_allclose(np.array(posterior.x.subs(values), float), numeric.x, rtol=1e-13)


def test_joseph_short_and_information_form_are_one_over_an_exact_field():
    from sympy.polys.fields import field

    K, a, b, c, r = field("a,b,c,r", sympy.QQ)
    P = np.array([[a, c], [c, b]], dtype=object)
    H = np.array([[K.one, K(2)]], dtype=object)
    R = np.array([[r]], dtype=object)
    joseph = update(Estimate(None, P), H, R, algebra=FIELD).P
    information = update_information(to_information(Estimate(None, P), algebra=FIELD), H, R, algebra=FIELD)
    assert same(joseph, from_information(information, algebra=FIELD).P)
    PH = P @ H.T
    short = P - (PH @ PH.T) / (H @ PH + R)[0, 0]
    assert same(joseph, short)
