"""The blender: published numbers, least squares with the full joint covariance, real filters sampled, singular cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.blender import blend, blend_all, blend_tree, semidefinite
from stochfuse.fusion.parallel import ParallelFilter, cross_covariance, parallel_filters
from tests.oracles.strategies import covariance, seeds

ONE = np.eye(1)
SCALAR = ParallelFilter(ONE, ONE, ONE, ONE, ONE)


def least_squares(J, n):
    """Generalised least squares (Bar-Shalom–Campo for n = 2): weights and covariance, J invertible."""
    E = np.tile(np.eye(len(J) // n), (n, 1))
    P = np.linalg.inv(E.T @ np.linalg.inv(J) @ E)
    return P @ E.T @ np.linalg.inv(J), P


def bordered(J, n):
    """Minimum of tr B J Bᵀ with Σ B_i = I by Lagrange multipliers, J may be singular."""
    D = len(J) // n
    E = np.tile(np.eye(D), (n, 1))
    system = np.block([[J, E], [E.T, np.zeros((D, D))]])
    B = np.linalg.lstsq(system, np.vstack([np.zeros((n * D, D)), np.eye(D)]), rcond=1e-12)[0][: n * D].T
    return B @ J @ B.T


def test_published_known_cross_covariance():
    P1, P2 = np.array([[9.0, -2], [-2, 2]]), np.array([[2.0, 2], [2, 9]])
    got = blend(P1, P2, np.array([[1.0, 1], [-1, 1]]))
    np.testing.assert_allclose(got.P, np.array([[8, -7], [-7, 16]]) / 9, rtol=1e-13)


def test_published_scalar_filters_without_exchange():
    """k counts updates: its first one falls on step 2."""
    run = parallel_filters([SCALAR, SCALAR], 4, Q_cross={(0, 1): ONE})
    np.testing.assert_allclose(run.joint[1:, 0, 0], [2 / 3, 5 / 8, 13 / 21], rtol=1e-14)
    np.testing.assert_allclose(run.joint[1:, 1, 1], [2 / 3, 5 / 8, 13 / 21], rtol=1e-14)
    np.testing.assert_allclose(run.joint[1:, 0, 1], [1 / 9, 5 / 32, 74 / 441], rtol=1e-14)
    np.testing.assert_array_equal(run.joint[0], np.eye(2))
    np.testing.assert_array_equal(run.gains[0][0], 0)


@given(seeds, st.integers(1, 4), st.integers(1, 4))
def test_blend_of_all_is_least_squares_with_the_joint_covariance(seed, n, D):
    rng = np.random.default_rng(seed)
    J = covariance(rng, n * D) + 0.1 * np.eye(n * D)
    B, P = least_squares(J, n)
    got = blend_all(J, n)
    np.testing.assert_allclose(got.P, P, atol=1e-10 * np.abs(J).max())
    np.testing.assert_allclose(np.hstack(got.weights), B, atol=1e-10 * np.abs(B).max())
    if n == 2:
        P1, P2, P12 = J[:D, :D], J[D:, D:], J[:D, D:]
        B2 = (P1 - P12) @ np.linalg.inv(P1 + P2 - P12 - P12.T)
        pair = blend(P1, P2, P12)
        np.testing.assert_allclose(pair.weights[1], B2, atol=1e-10 * np.abs(B2).max())
        np.testing.assert_allclose(pair.P, P1 - B2 @ (P1 - P12.T), atol=1e-10 * np.abs(J).max())


@given(seeds, st.integers(1, 3), st.integers(1, 3), st.data())
def test_weights_sum_to_identity_and_singular_joints_reach_the_optimum(seed, n, D, data):
    rng = np.random.default_rng(seed)
    J = covariance(rng, n * D, rank=data.draw(st.integers(0, n * D)))
    for got in (blend_all(J, n), blend_tree(J, n)):
        np.testing.assert_allclose(sum(got.weights), np.eye(D), atol=1e-9)
        np.testing.assert_array_equal(got.P, got.P.T)
        assert np.linalg.eigvalsh(got.P).min() >= -1e-10 * max(1.0, np.abs(J).max())
    np.testing.assert_allclose(blend_all(J, n).P, bordered(J, n), atol=1e-7 * max(1.0, np.abs(J).max()))


@given(seeds, st.sampled_from([((0, 1), 2), (2, (1, 0)), ((0, 2), (1, 3)), (0, ((1, 2), 3)), (((0, 1), 2), 3)]))
def test_a_tree_is_never_better_than_the_joint_optimum(seed, tree):
    n = 3 if tree in (((0, 1), 2), (2, (1, 0))) else 4
    J = covariance(np.random.default_rng(seed), 2 * n) + 0.01 * np.eye(2 * n)
    got, best = blend_tree(J, n, tree), blend_all(J, n)
    assert np.linalg.eigvalsh(got.P - best.P).min() >= -1e-9 * np.abs(J).max()
    B = np.hstack(got.weights)
    np.testing.assert_allclose(B @ J @ B.T, got.P, atol=1e-10 * np.abs(J).max())


def test_a_tree_equals_blends_one_after_the_other():
    """By hand, with cross-covariances of the intermediate blend; in general strictly worse than the optimum."""
    J = covariance(np.random.default_rng(3), 6) + 0.1 * np.eye(6)
    first = blend(J[:2, :2], J[2:4, 2:4], J[:2, 2:4])
    cross = first.weights[0] @ J[:2, 4:] + first.weights[1] @ J[2:4, 4:]
    second = blend(first.P, J[4:, 4:], cross)
    got = blend_tree(J, 3)
    np.testing.assert_allclose(got.P, second.P, rtol=1e-12)
    np.testing.assert_allclose(got.weights[1], second.weights[0] @ first.weights[1], rtol=1e-11)
    np.testing.assert_array_equal(blend_tree(J, 3, ((0, 1), 2)).P, got.P)
    assert got.P.trace() > blend_all(J, 3).P.trace() * 1.01
    np.testing.assert_allclose(blend_tree(J[:4, :4], 2, (1, 0)).P, first.P, rtol=1e-12)
    np.testing.assert_array_equal(blend_tree(J[:2, :2], 1, 0).P, J[:2, :2])


def test_a_lost_filter_leaves_the_blend_of_the_rest():
    J = covariance(np.random.default_rng(4), 8) + 0.1 * np.eye(8)
    rest = np.r_[0:2, 4:8]
    np.testing.assert_allclose(blend_all(J, 4, [0, 2, 3]).P, least_squares(J[np.ix_(rest, rest)], 3)[1], rtol=1e-10)
    np.testing.assert_array_equal(blend_all(J, 4, [0, 2, 3]).weights[1], 0)
    tree = blend_tree(J, 4, ((0, 1), (2, 3)), [0, 2, 3])
    np.testing.assert_allclose(tree.P, blend_tree(J[np.ix_(rest, rest)], 3, (0, (1, 2))).P, rtol=1e-12)
    np.testing.assert_array_equal(tree.weights[1], 0)
    for blender in (blend_all, blend_tree):
        alone = blender(J, 4, arrived=[2])
        np.testing.assert_allclose(alone.P, J[4:6, 4:6], rtol=1e-14)
        np.testing.assert_array_equal(alone.weights[2], np.eye(2))


def test_equal_filters_blend_into_one_of_them():
    P = covariance(np.random.default_rng(5), 3) + np.eye(3)
    for scale in (1e-12, 1.0, 1e12):
        got = blend(scale * P, scale * P, scale * P)
        np.testing.assert_allclose(got.P, scale * P, rtol=1e-12)
        np.testing.assert_allclose(sum(got.weights), np.eye(3), atol=1e-14)


def test_an_exact_filter_is_taken_alone():
    P, zero = covariance(np.random.default_rng(6), 3) + np.eye(3), np.zeros((3, 3))
    for got, exact in ((blend(zero, P, zero), 0), (blend(P, zero, zero), 1)):
        np.testing.assert_allclose(got.P, 0, atol=1e-15)
        np.testing.assert_allclose(got.weights[exact], np.eye(3), atol=1e-15)
    both = blend(zero, zero, zero)
    np.testing.assert_array_equal(both.P, 0)
    np.testing.assert_array_equal(sum(both.weights), np.eye(3))


def test_filters_that_differ_in_one_direction_alone():
    """e_1 = c + u a, e_2 = c + u b with independent scalars a, b: the best is c with a and b blended as scalars."""
    rng = np.random.default_rng(7)
    common, u = covariance(rng, 3), rng.normal(size=(3, 1))
    P1, P2 = common + 2.0 * u @ u.T, common + 3.0 * u @ u.T
    got = blend(P1, P2, common)
    np.testing.assert_allclose(got.P, common + 1.2 * u @ u.T, rtol=1e-11)
    np.testing.assert_allclose(got.weights[1] @ u, 0.4 * u, rtol=1e-10)


def test_what_differs_little_is_still_blended():
    """e_1 = c + a, e_2 = c + b with c ten thousand times as large as a and b: P is c's with a and b blended."""
    rng = np.random.default_rng(18)
    common, A, B = 1e8 * covariance(rng, 2), covariance(rng, 2) + np.eye(2), covariance(rng, 2) + np.eye(2)
    got = blend(common + A, common + B, common)
    np.testing.assert_allclose(got.weights[1], A @ np.linalg.inv(A + B), rtol=1e-5)
    np.testing.assert_allclose(got.P - common, A @ np.linalg.inv(A + B) @ B, rtol=1e-5)


def test_a_useless_filter_does_not_spoil_the_others():
    good = covariance(np.random.default_rng(8), 4) + np.eye(4)
    J = np.zeros((6, 6))
    J[:2, :2], J[2:, 2:] = 1e13 * np.eye(2), good
    np.testing.assert_allclose(blend_all(J, 3).P, least_squares(good, 2)[1], rtol=1e-11)


@given(seeds, st.integers(1, 3))
def test_change_of_coordinates(seed, D):
    rng = np.random.default_rng(seed)
    J = covariance(rng, 3 * D) + 0.1 * np.eye(3 * D)
    units = np.diag(10.0 ** rng.uniform(-5, 5, D)) @ np.linalg.qr(rng.normal(size=(D, D)))[0]
    T = np.kron(np.eye(3), units)
    deviations = np.sqrt(np.diag(units @ J[:D, :D] @ units.T))
    moved = T @ J @ T.T
    for blender in (blend_all, blend_tree):
        got, was = blender(0.5 * (moved + moved.T), 3), blender(J, 3)
        error = (got.P - units @ was.P @ units.T) / deviations[:, None] / deviations
        np.testing.assert_allclose(error, 0, atol=1e-9)


def test_any_leading_batch_shape():
    rng = np.random.default_rng(9)
    J = np.array([[covariance(rng, 6, rank=r) for r in (6, 4, 2)] for _ in range(2)])
    for blender in (blend_all, blend_tree):
        batch = blender(J, 3)
        for i, j in np.ndindex(2, 3):
            np.testing.assert_allclose(batch.P[i, j], blender(J[i, j], 3).P, atol=1e-12)
    pair = blend(J[..., :2, :2], J[..., 2:4, 2:4], J[..., :2, 2:4])
    np.testing.assert_allclose(pair.P, blend_all(J[..., :4, :4], 2).P)
    assert blend(J[..., :2, :2], np.eye(2), np.zeros((2, 2))).P.shape == (2, 3, 2, 2)


def navigators():
    """A filter of position and velocity, and one of position alone whose velocity is known: correlated noises."""
    F = np.array([[1.0, 0.5], [0.0, 0.9]])
    full = ParallelFilter(F, np.array([[1.0, 0.0]]), np.diag([0.3, 0.2]), np.array([[2.0]]), np.diag([4.0, 1.0]))
    short = ParallelFilter(
        np.array([[1.0]]),
        np.array([[1.0], [0.5]]),
        np.array([[0.5]]),
        np.diag([1.0, 3.0]),
        np.array([[3.0]]),
        np.array([[1.0], [0.0]]),
        np.array([[0.0], [2.0]]),
    )
    return (
        full,
        short,
        {(0, 1): np.array([[0.3], [0.1]])},
        {(1, 0): np.array([[0.8], [-0.5]])},
        {(0, 1): np.ones((2, 1))},
    )


def test_cross_recursion_against_two_real_filters_sampled():
    """400 000 noise records through both filters' textbook error recursions, with the standard error."""
    full, short, Q_cross, R_cross, P0_cross = navigators()
    run = parallel_filters([full, short], 5, Q_cross, R_cross, P0_cross)
    rng, N = np.random.default_rng(10), 400_000

    def draw(a, b, cross):
        return rng.multivariate_normal(np.zeros(3), np.block([[a, cross], [cross.T, b]]), N, method="cholesky").T

    e = draw(full.P0, short.P0, P0_cross[0, 1])
    e1, e2, P1, P2 = e[:2], e[2:], full.P0, short.P0
    for k in range(1, 5):
        w, v = draw(full.Q, short.Q, Q_cross[0, 1]), draw(full.R, short.R, R_cross[1, 0].T)
        e1, e2 = full.F @ e1 + w[:2], short.F @ e2 + w[2:]
        P1, P2 = full.F @ P1 @ full.F.T + full.Q, short.F @ P2 @ short.F.T + short.Q
        K1 = P1 @ full.H.T @ np.linalg.inv(full.H @ P1 @ full.H.T + full.R)
        K2 = P2 @ short.H.T @ np.linalg.inv(short.H @ P2 @ short.H.T + short.R)
        e1, e2 = e1 - K1 @ (full.H @ e1 + v[:1]), e2 - K2 @ (short.H @ e2 + v[1:])
        P1, P2 = P1 - K1 @ full.H @ P1, P2 - K2 @ short.H @ P2
        sample = np.concatenate([e1, e2])
        products = sample[:, None] * sample[None]
        error = products.std(axis=-1) / np.sqrt(N)
        assert np.abs((products.mean(axis=-1) - run.joint[k]) / error).max() < 4.5
        np.testing.assert_allclose(run.gains[1][k], K2, rtol=1e-12)
        np.testing.assert_allclose(run.joint[k, :2, :2], P1, rtol=1e-12)


def test_cross_covariance_is_that_of_the_joint_recursion():
    full, short, Q_cross, R_cross, P0_cross = navigators()
    run = parallel_filters([full, short], 4, Q_cross, R_cross, P0_cross)
    P12, K1, K2 = P0_cross[0, 1], run.gains[0][1], run.gains[1][1]
    for k in range(1, 4):
        K1, K2 = run.gains[0][k], run.gains[1][k]
        P12 = cross_covariance(P12, (full.F, short.F), Q_cross[0, 1], (K1, K2), (full.H, short.H), R_cross[1, 0].T)
        np.testing.assert_allclose(run.joint[k, :2, 2:], P12, rtol=1e-12)
    batch = cross_covariance(
        np.stack([P12, P12]), (full.F, short.F), Q_cross[0, 1], (K1, K2), (full.H, short.H), R_cross[1, 0].T
    )
    assert batch.shape == (2, 2, 1)


def test_shaped_estimates_and_a_mapping_without_a_direction():
    """The short filter claims its velocity exactly, so the blend's velocity is exact: singular, and right."""
    full, short, *cross = navigators()
    run = parallel_filters([full, short], 3, *cross)
    shaped = run.shaped(3)
    assert shaped.shape == (4, 4)
    np.testing.assert_allclose(shaped[:3, :3], run.joint[2])
    np.testing.assert_array_equal(shaped[3], 0)
    np.testing.assert_array_equal(run.s[2], [[0], [0], [0], [2]])
    np.testing.assert_allclose(blend_all(shaped, 2).P, bordered(shaped, 2), atol=1e-12)


def test_matrices_per_step():
    constant = parallel_filters([SCALAR, SCALAR], 3, Q_cross={(0, 1): ONE})
    each = np.broadcast_to(ONE, (3, 1, 1))
    stacked = ParallelFilter(each, each, each, each, ONE, each, 0 * each)
    varying = parallel_filters([SCALAR, stacked], 3, Q_cross={(1, 0): np.ones((3, 1, 1))})
    np.testing.assert_array_equal(constant.joint, varying.joint)
    R = np.array([9.0, 1.0, 4.0])[:, None, None]
    later = parallel_filters([SCALAR._replace(R=R)], 3).joint[:, 0, 0]
    np.testing.assert_allclose(later, [1, 2 / 3, 1 / (3 / 5 + 1 / 4)], rtol=1e-14)


TWO, THREE = np.eye(2), np.eye(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"M": TWO[:, :1]}, r"filters\[2\]\.M: expected 3 rows, got 2"),
        ({"M": np.ones((3, 2))}, r"filters\[2\]\.M: expected 1 column, got 2"),
        ({"s": np.ones((2, 1))}, r"filters\[2\]\.s: expected 3 rows, got 2"),
        ({"F": np.ones((1, 2))}, r"filters\[2\]\.F: expected 2 rows, got 1"),
        ({"R": TWO}, r"filters\[2\]\.R: expected 1 row, got 2"),
        ({"R": np.ones(1)}, r"filters\[2\]\.R: expected a matrix, or one per step, got an array of 1"),
        ({"Q": np.ones((2, 1, 1))}, r"filters\[2\]\.Q: expected one matrix for each of the 5 steps, got 2"),
        (
            {"P0": -ONE},
            r"filters\[2\]\.P0: expected a positive semi-definite matrix, got a variance of -1 on the diagonal",
        ),
        ({"H": np.full((1, 1), np.nan)}, r"filters\[2\]\.H: expected finite numbers, got a value that is not finite"),
    ],
)
def test_filters_that_do_not_fit(change, message):
    full = ParallelFilter(THREE, THREE[:1], THREE, ONE, THREE)
    third = SCALAR._replace(M=np.ones((3, 1)), s=np.zeros((3, 1)))._replace(**change)
    with pytest.raises(UsageError, match=message):
        parallel_filters([full, full, third], 5)


@pytest.mark.parametrize(
    ("cross", "message"),
    [
        (
            {"Q_cross": {(0, 1): 2 * ONE}},
            "Q of all filters: expected a positive semi-definite matrix, got an indefinite",
        ),
        (
            {"R_cross": {(0, 1): 2 * ONE}},
            "R of all filters: expected a positive semi-definite matrix, got an indefinite",
        ),
        ({"P0_cross": {(0, 1): 2 * ONE}}, "P0 of all filters: expected a positive semi-definite matrix, got an indef"),
        ({"Q_cross": {(0, 2): ONE}}, r"Q_cross\[\(0, 2\)\]: expected two different filters of 0 to 1, got 0 and 2"),
        ({"Q_cross": {(1, 1): ONE}}, r"Q_cross\[\(1, 1\)\]: expected two different filters of 0 to 1, got 1 and 1"),
        (
            {"R_cross": {(0, 1): ONE, (1, 0): ONE}},
            r"R_cross\[\(1, 0\)\]: expected one of \(1, 0\) and \(0, 1\), got both",
        ),
        ({"P0_cross": {(0, 1): TWO}}, r"P0_cross\[\(0, 1\)\]: expected 1 row, got 2"),
    ],
)
def test_crosses_that_do_not_fit(cross, message):
    with pytest.raises(UsageError, match=message):
        parallel_filters([SCALAR, SCALAR], 3, **cross)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: parallel_filters([], 3), "expected at least one filter and one step, got 0 and 3"),
        (lambda: parallel_filters([SCALAR], 0), "expected at least one filter and one step, got 1 and 0"),
        (lambda: blend(TWO, TWO, ONE), "P1, P2, P12: expected three matrices of one size, got 2×2, 2×2 and 1×1"),
        (lambda: blend(ONE, ONE, 2 * ONE), "joint: expected a positive semi-definite matrix, got an indefinite one"),
        (lambda: blend_all(THREE, 2), "joint: expected 2 filters' blocks of one size, got a 3×3 matrix"),
        (lambda: blend_all(THREE, 0), "joint: expected 0 filters' blocks of one size, got a 3×3 matrix"),
        (lambda: blend_all(THREE, 3, []), r"arrived: expected at least one of the filters 0 to 2, got \[\]"),
        (lambda: blend_all(THREE, 3, [1, 3]), r"arrived: expected at least one of the filters 0 to 2, got \[1, 3\]"),
        (lambda: blend_tree(THREE, 3, ((0, 1), 1)), "tree: expected each of 0, 1, 2 once, got 0, 1, 1"),
        (lambda: blend_tree(THREE, 3, (0, 1)), "tree: expected each of 0, 1, 2 once, got 0, 1"),
        (
            lambda: blend_tree(THREE, 3, (0, 1, 2)),  # pyright: ignore[reportArgumentType]
            r"tree: expected nested pairs such as .* got \(0, 1, 2\)",
        ),
        (lambda: semidefinite("X", np.ones((2, 3))), "X: expected a positive semi-definite matrix, got one of 2×3"),
        (lambda: semidefinite("X", np.array([[1.0, 0], [0.1, 1]])), "X: .*, got an asymmetric one"),
        (lambda: semidefinite("X", np.array([[np.inf]])), r"X: .*, got a value that is not finite \(NaN or infinity\)"),
    ],
)
def test_wrong_use(call, message):
    with pytest.raises(UsageError, match=message):
        call()


def test_a_filter_without_a_gain():
    exact = ParallelFilter(ONE, ONE, 0 * ONE, 0 * ONE, 0 * ONE)
    with pytest.raises(NoAnswerError, match=r"filters\[1\]: expected a gain at step 2, got a singular innovation"):
        parallel_filters([SCALAR, exact], 3)
