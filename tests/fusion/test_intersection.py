"""Split covariance intersection against its definition, other optimisers and random correlations."""

from __future__ import annotations

from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize, minimize_scalar

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.fusion.intersection import (
    Criterion,
    Signal,
    covariance_intersection,
    fuse_stack,
    pair_weights,
    split_covariance_intersection,
)
from stochfuse.kalman import kernel as kalman

SMOOTH = [
    Criterion("det"),
    Criterion("trace"),
    Criterion("lp", p=3.0, weights=(1.0, 0.2, 4.0)),
    Criterion("det", block=(2, 0)),
    Criterion("trace", block=(1,)),
    Criterion("lp", block=(0, 1), p=1.5),
]
LARGEST = [Criterion("max-eig"), Criterion("max-eig", block=(0, 2))]
A = np.diag([3.0, 0.4])
B = np.array([[2.0, -0.8], [-0.8, 1.0]])


def covariances(rng, N, d, size=1.0):
    X = rng.normal(size=(N, d, d + 1))
    return size * X @ X.swapaxes(1, 2)


def random_signals(rng, m, d=3, square=True):
    """Signals of different sizes and maps; the first sees the whole state."""
    rows = [d] + [d if square else int(rng.integers(1, d + 1)) for _ in range(m - 1)]
    return [
        Signal(
            rng.normal(size=(p, 1)), covariances(rng, 1, p)[0], covariances(rng, 1, p, 0.3)[0], rng.normal(size=(p, d))
        )
        for p in rows
    ]


def naive(signals, weights):
    """C and c as printed, terms without weight left out."""
    d = signals[0].A1.shape[0] if signals[0].H is None else signals[0].H.shape[1]
    Y, y = np.zeros((d, d)), np.zeros((d, 1))
    for (a, A1, A2, H), w in zip(signals, weights, strict=True):
        if w > 0:
            D = (np.eye(d) if H is None else H).T @ np.linalg.inv(A1 / w + A2)
            Y, y = Y + D @ (np.eye(d) if H is None else H), y + D @ a
    C = np.linalg.inv(Y)
    return C, C @ y


def size_of(C, criterion):
    states = range(len(C)) if criterion.block is None else criterion.block
    S = C[np.ix_(list(states), list(states))]
    variances = np.diag(S) * (1.0 if criterion.weights is None else np.array(criterion.weights))
    return {
        "det": lambda: np.linalg.slogdet(S)[1],
        "trace": lambda: np.trace(S),
        "lp": lambda: (variances**criterion.p).sum() ** (1 / criterion.p),
        "max-eig": lambda: np.linalg.eigvalsh(S)[-1],
    }[criterion.name]()


def worse_by(signals, criterion, weights):
    """How much the weights are worse than SciPy's best, relative (of log det: absolute)."""

    def value(w):
        w = np.maximum(w, 1e-13)
        return size_of(naive(signals, w / w.sum())[0], criterion)

    n = len(signals)
    found = minimize(
        value,
        np.full(n, 1 / n),
        bounds=[(0, 1)] * n,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 300},
    )
    mine = size_of(naive(signals, weights)[0], criterion)
    return (mine - found.fun) / (1.0 if criterion.name == "det" else found.fun)


# --- published numbers


def test_published_split_determinant():
    first = np.array([[4.0, 0, 1], [0, 4, 0], [1, 0, 4]])
    fused = split_covariance_intersection(
        [
            Signal(np.array([[2.0], [2], [1]]), 4 * np.eye(3), first),
            Signal(np.array([[-4.0], [-4], [-2]]), 4 * np.eye(3), 2 * first),
        ]
    )
    assert fused.weights == pytest.approx([2 / 3, 1 / 3], abs=1e-10)
    assert fused.c == pytest.approx(np.zeros((3, 1)), abs=1e-9)
    assert pytest.approx(2 / 3 * first, abs=1e-9) == fused.C2
    assert pytest.approx(4 * np.eye(3), abs=1e-9) == fused.C1
    assert np.linalg.det(fused.C) == pytest.approx(293.3333, abs=5e-5)
    assert fused.certificate < 1e-13


def test_published_plain():
    estimates = [(np.array([[1.0], [-2.0]]), A), (np.array([[-2.0], [-1.0]]), B)]
    fused = covariance_intersection(estimates, Criterion("det"))
    assert fused.weights[0] == pytest.approx(35 / 62, abs=1e-12)
    assert fused.c.ravel() == pytest.approx([-0.445154767, -1.881992237], abs=5e-10)
    assert pytest.approx(np.zeros((2, 2)), abs=0) == fused.C2
    assert covariance_intersection(estimates, Criterion("trace")).weights[0] == pytest.approx(0.403702906, abs=5e-10)


# --- limits


@pytest.mark.parametrize("m", [2, 3, 5])
def test_without_correlated_parts_it_is_the_kalman_update(m):
    rng = np.random.default_rng(m)
    d = 4
    prior = kalman.Estimate(rng.normal(size=(d, 1)), covariances(rng, 1, d)[0])
    sensors = [(rng.normal(size=(2, d)), covariances(rng, 1, 2)[0], rng.normal(size=(2, 1))) for _ in range(m - 1)]
    signals = [Signal(prior.x, np.zeros((d, d)), prior.P, None)]
    signals += [Signal(z, np.zeros((2, 2)), R, H) for H, R, z in sensors]
    expected = prior
    for H, R, z in sensors:
        expected = kalman.update(expected, H, R, z)
    for weights in (None, np.eye(m)[0]):
        fused = split_covariance_intersection(signals, weights=weights)
        assert pytest.approx(expected.P, rel=1e-10, abs=1e-10) == fused.C
        assert fused.c == pytest.approx(expected.x, rel=1e-10, abs=1e-10)
    assert split_covariance_intersection(signals).weights == pytest.approx(np.full(m, 1 / m))
    if m == 2:
        assert pytest.approx(expected.P, abs=1e-10) == fused.C2
        assert pytest.approx(np.zeros((d, d)), abs=1e-10) == fused.C1


@pytest.mark.parametrize("name", ["det", "trace"])
def test_without_independent_parts_it_is_covariance_intersection(name):
    rng = np.random.default_rng(5)
    P, Q = covariances(rng, 1, 4)[0], covariances(rng, 1, 4)[0]
    plain = covariance_intersection([(None, P), (None, Q)], Criterion(name))
    # a written-out identity takes the general way
    general = split_covariance_intersection(
        [Signal(None, P, 0 * P, np.eye(4)), Signal(None, Q, 0 * Q, np.eye(4))], Criterion(name)
    )
    w = plain.weights[0]
    assert pytest.approx(np.linalg.inv(w * np.linalg.inv(P) + (1 - w) * np.linalg.inv(Q)), rel=1e-10) == plain.C
    assert general.weights == pytest.approx(plain.weights, abs=1e-11)
    assert pytest.approx(plain.C, rel=1e-10) == general.C
    assert plain.c is None


def test_a_weightless_signal_leaves_the_weight_to_others():
    sensor = Signal(np.array([[0.5]]), np.zeros((1, 1)), np.eye(1), np.array([[1.0, 0.0]]))
    track = Signal(np.zeros((2, 1)), A, np.zeros((2, 2)))
    fused = split_covariance_intersection([sensor, track], Criterion("trace"))
    expected = kalman.update(kalman.Estimate(np.zeros((2, 1)), A), sensor.H, np.eye(1), sensor.a)
    assert fused.weights == pytest.approx([0, 1], abs=0)
    assert pytest.approx(expected.P, abs=1e-12) == fused.C
    assert fused.c == pytest.approx(expected.x, abs=1e-12)


def test_a_partly_independent_direction_keeps_its_information_at_weight_zero():
    part = Signal(None, np.diag([2.0, 0.0]), np.diag([1.0, 0.5]))
    fused = split_covariance_intersection([part, Signal(None, A, 0 * A)], weights=(0, 1))
    assert pytest.approx(np.linalg.inv(np.linalg.inv(A) + np.diag([0, 2.0])), abs=1e-12) == fused.C
    near = split_covariance_intersection([part, Signal(None, A, 0 * A)], weights=(1e-9, 1 - 1e-9))
    assert pytest.approx(fused.C, abs=1e-8) == near.C


# --- optimality


@pytest.mark.parametrize("criterion", SMOOTH + LARGEST)
@pytest.mark.parametrize("m", [2, 3, 5])
def test_no_other_optimiser_does_better(m, criterion):
    rng = np.random.default_rng(17 * m)
    for square in (True, False):
        signals = random_signals(rng, m, square=square)
        fused = split_covariance_intersection(signals, criterion)
        C, c = naive(signals, fused.weights)
        assert pytest.approx(C, rel=1e-9, abs=1e-11) == fused.C
        assert fused.c == pytest.approx(c, rel=1e-9, abs=1e-11)
        assert fused.certificate < (1e-8 if criterion.name == "max-eig" else 1e-12)
        assert worse_by(signals, criterion, fused.weights) < 1e-9


@pytest.mark.parametrize("criterion", SMOOTH)
@pytest.mark.parametrize("m", [2, 3, 5])
def test_slopes_agree_with_finite_differences(m, criterion):
    """Moving weight from any signal that has some to any other does not pay."""
    signals = random_signals(np.random.default_rng(3 * m), m)
    w = split_covariance_intersection(signals, criterion).weights
    step = 1e-5
    for i in np.flatnonzero(w > 10 * step):
        for j in set(range(m)) - {i}:
            move = np.eye(m)[j] - np.eye(m)[i]
            ahead = size_of(naive(signals, w + step * move)[0], criterion)
            here = size_of(naive(signals, w)[0], criterion)
            assert ahead - here > -1e-12 * max(1, abs(here))
            if w[j] > 10 * step:
                behind = size_of(naive(signals, w - step * move)[0], criterion)
                curved = abs(ahead - 2 * here + behind)
                # the least value of the parabola through three points lies within 1e-8 of the middle
                assert abs(ahead - behind) / 2 < curved * 1e-3 + 1e-14 * abs(here)


@pytest.mark.parametrize("criterion", SMOOTH)
def test_weights_of_two_are_the_root_of_the_derivative(criterion):
    """50 digits: the derivative of the literal criterion, differentiated by mpmath."""
    rng = np.random.default_rng(29)
    signals = random_signals(rng, 2)
    got = split_covariance_intersection(signals, criterion).weights[0]
    with mp.workdps(50):
        parts = [(mp.matrix(s.A1), mp.matrix(s.A2), mp.matrix(s.H)) for s in signals]
        states = range(3) if criterion.block is None else criterion.block
        units = [1] * len(states) if criterion.weights is None else criterion.weights

        def value(w):
            Y = sum(
                (H.T * (A1 / x + A2) ** -1 * H for (A1, A2, H), x in zip(parts, (w, 1 - w), strict=True)), mp.zeros(3)
            )
            C = Y**-1
            S = mp.matrix([[C[i, j] for j in states] for i in states])
            if criterion.name == "det":
                return mp.log(mp.det(S))
            p = 1 if criterion.name == "trace" else mp.mpf(criterion.p)
            return sum((mp.mpf(u) * S[j, j]) ** p for j, u in enumerate(units)) ** (1 / p)

        root = mp.findroot(lambda w: mp.diff(value, w), (mp.mpf(got) - mp.mpf("1e-4"), mp.mpf(got) + mp.mpf("1e-4")))
    assert 1e-3 < root < 1 - 1e-3
    assert got == pytest.approx(float(root), abs=1e-10)


def test_trace_of_three_states_to_fifty_digits():
    rows = [[4, 1, 0], [1, 3, 1], [0, 1, 1]], [[1, 0, 0.5], [0, 5, 1], [0.5, 1, 6]]
    got = covariance_intersection([(None, np.array(r)) for r in rows], Criterion("trace")).weights[0]
    with mp.workdps(50):
        P, Q = (mp.matrix(r) ** -1 for r in rows)

        def slope(w):
            C = (w * P + (1 - w) * Q) ** -1
            G = C * (P - Q) * C
            return sum(G[i, i] for i in range(3))

        root = mp.findroot(slope, (0.1, 0.9), solver="anderson", tol=mp.mpf("1e-90"))
    assert got == pytest.approx(float(root), abs=1e-14)


@pytest.mark.parametrize("criterion", LARGEST)
def test_largest_eigenvalue_of_two_against_a_scalar_search(criterion):
    rng = np.random.default_rng(8)
    for _ in range(8):
        signals = random_signals(rng, 2)
        fused = split_covariance_intersection(signals, criterion)
        found = minimize_scalar(
            lambda w: size_of(naive(signals, (w, 1 - w))[0], criterion),  # noqa: B023
            bounds=(0, 1),
            method="bounded",
            options={"xatol": 1e-11},
        )
        assert size_of(fused.C, criterion) <= found.fun * (1 + 1e-9)
        assert fused.weights[0] == pytest.approx(found.x, abs=2e-6)


def test_largest_eigenvalue_where_it_is_double():
    """diag(1, 4) with diag(4, 1): the least largest variance is where both are equal, w = ½."""
    fused = covariance_intersection([(None, np.diag([1.0, 4])), (None, np.diag([4.0, 1]))], Criterion("max-eig"))
    assert fused.weights == pytest.approx([0.5, 0.5], abs=1e-12)
    fused = covariance_intersection([(None, np.diag([1.0, 4])), (None, np.diag([2.0, 1]))], Criterion("max-eig"))
    # 1/λ = w + (1−w)/2 = w/4 + (1−w)
    assert fused.weights[0] == pytest.approx(0.4, abs=1e-10)
    assert fused.certificate < 1e-9


def test_certificate_of_given_weights_bounds_the_excess():
    rng = np.random.default_rng(31)
    for criterion in SMOOTH + LARGEST:
        signals = random_signals(rng, 3)
        best = split_covariance_intersection(signals, criterion)
        given_weights = split_covariance_intersection(signals, criterion, (0.2, 0.5, 0.3))
        excess = size_of(given_weights.C, criterion) - size_of(best.C, criterion)
        excess /= 1.0 if criterion.name == "det" else size_of(given_weights.C, criterion)
        assert 0 <= excess <= given_weights.certificate * (1 + 1e-6)
        assert given_weights.weights == pytest.approx([0.2, 0.5, 0.3], abs=0)


# --- what the bound promises


@settings(max_examples=24, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    m=st.sampled_from([2, 3, 5]),
    name=st.sampled_from(["det", "trace", "lp"]),
    spare=st.integers(0, 4),
)
def test_claimed_is_no_smaller_than_actual(seed, m, name, spare):
    """400 random correlations an example: the A1 parts correlated through few common sources, as strongly as can be."""
    rng = np.random.default_rng(seed)
    N, d, rows = 400, 3, [3, *rng.integers(1, 4, size=m - 1)]
    cuts = np.cumsum([0, *rows])
    X = rng.normal(size=(N, cuts[-1], 3 + spare)) * np.exp(rng.normal(size=(N, cuts[-1], 1)))
    joint = X @ X.swapaxes(1, 2)
    A1 = [joint[:, a:b, a:b] for a, b in pairwise(cuts)]
    A2 = [covariances(rng, N, p, np.exp(2 * rng.normal())) for p in rows]
    H = [rng.normal(size=(N, p, d)) for p in rows]
    fused = fuse_stack(A1, A2, H, Criterion(name))
    K = np.concatenate(fused.gains, axis=-1)
    actual = K @ joint @ K.swapaxes(1, 2)
    for gain, second in zip(fused.gains, A2, strict=True):
        actual += gain @ second @ gain.swapaxes(1, 2)
    scale = np.sqrt(np.diagonal(fused.C, axis1=1, axis2=2))
    margin = (fused.C - actual) / (scale[:, :, None] * scale[:, None, :])
    assert np.linalg.eigvalsh(margin).min() >= -1e-9
    unbiased = K @ np.concatenate(H, axis=1) - np.eye(d)
    assert np.abs(unbiased * scale[:, None, :] / scale[:, :, None]).max() < 1e-6
    assert fused.certificate.max() < 1e-10


def test_split_result_underestimates_the_independent_part():
    """C_2 is what A_12 and A_22 leave in the fused error, to rounding; C_1 takes the rest."""
    rng = np.random.default_rng(2)
    for criterion in SMOOTH:
        signals = random_signals(rng, 2, square=False)
        fused = split_covariance_intersection(signals, criterion)
        D = [
            s.H.T @ np.linalg.inv(s.A1 / w + s.A2) if w else np.zeros((3, len(s.A1)))
            for s, w in zip(signals, fused.weights, strict=True)
        ]
        expected = sum(fused.C @ d @ s.A2 @ d.T @ fused.C for d, s in zip(D, signals, strict=True))
        assert pytest.approx(expected, rel=1e-9, abs=1e-12) == fused.C2
        assert pytest.approx(fused.C, rel=1e-14, abs=1e-15) == fused.C1 + fused.C2
        assert np.linalg.eigvalsh(fused.C1).min() > -1e-12
        assert np.linalg.eigvalsh(fused.C2).min() > -1e-12


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), m=st.integers(2, 5))
def test_coordinates_and_order_do_not_matter(seed, m):
    rng = np.random.default_rng(seed)
    signals = random_signals(rng, m)
    T = np.linalg.qr(rng.normal(size=(3, 3)))[0] * np.array([1.0, 30.0, 0.02])
    fused = split_covariance_intersection(signals)
    turned = split_covariance_intersection([s._replace(H=s.H @ np.linalg.inv(T)) for s in signals])
    assert turned.weights == pytest.approx(fused.weights, abs=1e-8)
    assert pytest.approx(turned.C, rel=1e-7, abs=1e-9 * np.abs(turned.C).max()) == T @ fused.C @ T.T
    order = rng.permutation(m)
    other = split_covariance_intersection([signals[k] for k in order])
    assert other.weights == pytest.approx(fused.weights[order], abs=1e-8)


def test_stack_is_its_items():
    rng = np.random.default_rng(11)
    N = 40
    A1, A2 = ([covariances(rng, N, p, size) for p in (3, 2, 1)] for size in (1.0, 0.2))
    H = [None, rng.normal(size=(2, 3)), rng.normal(size=(N, 1, 3))]
    for criterion in SMOOTH + LARGEST:
        stack = fuse_stack(A1, A2, H, criterion)
        for k in (0, 7, 39):
            signals = [
                Signal(rng.normal(size=(len(a[k]), 1)), a[k], b[k], h if h is None or h.ndim == 2 else h[k])
                for a, b, h in zip(A1, A2, H, strict=True)
            ]
            one = split_covariance_intersection(signals, criterion)
            tolerance = 1e-5 if criterion.name == "max-eig" else 1e-10
            assert stack.weights[k] == pytest.approx(one.weights, abs=tolerance)
            assert stack.C[k] == pytest.approx(one.C, rel=tolerance, abs=tolerance)
            c = sum(gain[k] @ s.a for gain, s in zip(stack.gains, signals, strict=True))
            assert c == pytest.approx(one.c, rel=10 * tolerance, abs=10 * tolerance)


# --- equal, nested, nearly singular and singular


@pytest.mark.parametrize("criterion", [*SMOOTH, *LARGEST])
@pytest.mark.parametrize("m", [2, 3, 5])
def test_equal_signals_share_the_weight(m, criterion):
    rng = np.random.default_rng(1)
    one = Signal(None, covariances(rng, 1, 3)[0], np.zeros((3, 3)), rng.normal(size=(3, 3)))
    fused = split_covariance_intersection([one] * m, criterion)
    assert fused.weights == pytest.approx(np.full(m, 1 / m), abs=1e-10)


def test_two_equal_signals_of_three_have_equal_weights():
    rng = np.random.default_rng(4)
    first, second = (Signal(None, covariances(rng, 1, 3)[0], np.zeros((3, 3))) for _ in range(2))
    w = split_covariance_intersection([first, second, first], Criterion("trace")).weights
    assert w[0] == pytest.approx(w[2], abs=1e-10)
    pair = covariance_intersection([(None, first.A1), (None, second.A1)], Criterion("trace")).weights
    assert w[0] + w[2] == pytest.approx(pair[0], abs=1e-10)


@pytest.mark.parametrize("name", ["det", "trace"])
def test_equal_and_nested_pairs(name):
    rng = np.random.default_rng(6)
    P = covariances(rng, 50, 4)
    more = P + covariances(rng, 50, 4, 1e-6)
    line = rng.normal(size=(50, 4, 1))
    assert pair_weights(P, P, name) == pytest.approx(np.full(50, 0.5), abs=0)
    assert pair_weights(P, more, name) == pytest.approx(np.ones(50), abs=0)
    assert pair_weights(more, P, name) == pytest.approx(np.zeros(50), abs=0)
    assert pair_weights(P, P + line @ line.swapaxes(1, 2), name) == pytest.approx(np.ones(50), abs=1e-9)
    fused = fuse_stack([P, more], [0 * P, 0 * P], None, Criterion(name))
    assert pytest.approx(P, rel=1e-9, abs=1e-9) == fused.C
    general = fuse_stack([P, more], [0 * P, 0 * P], [np.eye(4), None], Criterion(name))
    assert general.weights == pytest.approx(np.eye(2)[[0] * 50], abs=1e-12)


@pytest.mark.parametrize("name", ["det", "trace"])
def test_pairs_against_the_root_of_the_derivative(name):
    rng = np.random.default_rng(12)
    P, Q = covariances(rng, 300, 4), covariances(rng, 300, 4)
    w = pair_weights(P, Q, name)
    general = fuse_stack([P, Q], [0 * P, 0 * Q], [np.eye(4), None], Criterion(name))
    assert general.weights[:, 0] == pytest.approx(w, abs=1e-10)
    for a, b, got in zip(np.linalg.inv(P), np.linalg.inv(Q), w, strict=True):

        def slope(x, a=a, b=b):
            C = np.linalg.inv(x * a + (1 - x) * b)
            return -np.trace(C @ (a - b) @ (C if name == "trace" else np.eye(4)))

        expected = 0.0 if slope(0) >= 0 else 1.0 if slope(1) <= 0 else brentq(slope, 0, 1, xtol=1e-15)
        assert got == pytest.approx(expected, abs=1e-10)


def exact_weight(P, Q, name):
    """Root of the derivative by bisection in 50 digits."""
    with mp.workdps(50):
        a, b = mp.matrix(P) ** -1, mp.matrix(Q) ** -1
        low, high = mp.mpf(0), mp.mpf(1)
        for _ in range(60):
            w = (low + high) / 2
            C = (w * a + (1 - w) * b) ** -1
            G = C * (b - a) * (C if name == "trace" else mp.eye(len(P)))
            low, high = (w, high) if sum(G[i, i] for i in range(len(P))) < 0 else (low, w)
        return float(low)


@pytest.mark.parametrize("name", ["det", "trace"])
def test_nearly_singular_pairs(name):
    """One of the two of condition number 1e12: 1e-9 against 50 digits."""
    rng = np.random.default_rng(13)
    for _ in range(8):
        turn, other = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
        P = turn * np.array([1.0, 1e-3, 1e-12]) @ turn.T
        Q = other * np.array([0.01, 0.3, 1.0]) @ other.T
        P, Q = (P + P.T) / 2, (Q + Q.T) / 2
        expected = exact_weight(P, Q, name)
        assert pair_weights(P[None], Q[None], name)[0] == pytest.approx(expected, abs=1e-9)
        assert pair_weights(Q[None], P[None], name)[0] == pytest.approx(1 - expected, abs=1e-9)


@pytest.mark.parametrize("name", ["det", "trace"])
def test_two_nearly_singular_of_a_pair(name):
    """Both of condition number 1e12: no farther from 50 digits than a rounding of the entries moves the exact weight."""
    rng = np.random.default_rng(14)
    for _ in range(4):
        turn, other = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
        P = turn * np.array([1.0, 1e-3, 1e-12]) @ turn.T
        Q = other * np.array([1e-12, 0.3, 1.0]) @ other.T
        P, Q = (P + P.T) / 2, (Q + Q.T) / 2
        expected = exact_weight(P, Q, name)
        moves = []
        for _ in range(4):
            E, F = (rng.choice([-1, 1], size=(3, 3)) * 1.1e-16 for _ in range(2))
            moves.append(abs(exact_weight(P + E + E.T, Q + F + F.T, name) - expected))
        assert abs(pair_weights(P[None], Q[None], name)[0] - expected) < 1e-9 + 5 * max(moves)


def test_exactly_singular_pairs():
    """A knows the first state exactly: the fused estimate does too, at any weight, also in the limit of weight zero."""
    P, Q = np.diag([0.0, 2.0]), np.array([[1.0, 0.3], [0.3, 1.0]])
    for name in ("det", "trace"):
        w = pair_weights(P[None], Q[None], name)[0]
        near = pair_weights(P[None] + 1e-13 * np.eye(2), Q[None], name)[0]
        assert w == pytest.approx(near, abs=1e-6)
        fused = covariance_intersection([(np.array([[5.0], [0.0]]), P), (np.zeros((2, 1)), Q)], Criterion(name))
        assert fused.C[0] == pytest.approx([0, 0], abs=1e-15)
        assert fused.c[0, 0] == pytest.approx(5.0)
    crossed = np.diag([0.0, 1.0])[None], np.diag([1.0, 0.0])[None]
    assert pair_weights(*crossed, "det") == pytest.approx([0.5])
    assert pair_weights(*crossed, "trace") == pytest.approx([0.5])


@pytest.mark.parametrize("name", ["det", "trace"])
def test_a_direction_that_two_know_alike_does_not_move_the_weight(name):
    """Also one that is exactly alike, as of agents that start with one speed: δ = 0."""
    P, Q = np.diag([4.0, 1.0, 9.0]), np.diag([1.0, 1.0, 16.0])
    assert pair_weights(P[None], Q[None], name)[0] == pytest.approx(exact_weight(P, Q, name), abs=1e-9)


def test_empty_stacks():
    none = np.zeros((0, 3, 3))
    assert pair_weights(none, none).shape == (0,)
    assert fuse_stack([none, none], [none, none], None).C.shape == (0, 3, 3)
    assert fuse_stack([none] * 3, [none] * 3, None, Criterion("trace")).weights.shape == (0, 3)


# --- messages

GOOD = Signal(np.zeros((2, 1)), A, B)


@pytest.mark.parametrize(
    ("signals", "message"),
    [
        ([GOOD], r"signals: expected two or more, got 1"),
        (
            [GOOD, GOOD._replace(A1=np.diag([1.0, -1.0]))],
            r"signals\[2\]\.A1: expected .*semi-definite 2?.*a variance of -1",
        ),
        (
            [GOOD, GOOD._replace(A2=np.array([[1.0, 0.5], [0.0, 1.0]]))],
            r"signals\[2\]\.A2: expected .*, got an asymmetric",
        ),
        (
            [GOOD._replace(A1=np.full((2, 2), np.nan)), GOOD],
            r"signals\[1\]\.A1: expected .*got a value that is not finite",
        ),
        ([GOOD, GOOD._replace(A2=np.eye(3))], r"signals\[2\]\.A2: expected a .* 2×2 matrix, got shape \(3, 3\)"),
        ([GOOD, GOOD._replace(A1=np.ones(2))], r"signals\[2\]\.A1: expected .* square matrix, got shape \(2,\)"),
        ([GOOD, GOOD._replace(H=np.ones((3, 2)))], r"signals\[2\]\.H: expected a 2×2 matrix, got shape \(3, 2\)"),
        ([GOOD._replace(H=np.ones((2, 3))), GOOD], r"signals\[2\]\.H: expected a 2×3 matrix, got none"),
        ([GOOD, GOOD._replace(H=np.full((2, 2), np.inf))], r"signals\[2\]\.H: expected .*finite numbers"),
        ([GOOD, GOOD._replace(a=None)], r"signals\[2\]\.a: expected a mean in every signal or in none, got none"),
        ([GOOD._replace(a=None), GOOD], r"signals\[2\]\.a: expected a mean in every signal or in none, got one"),
        (
            [GOOD, GOOD._replace(a=np.zeros(3))],
            r"signals\[2\]\.a: expected a finite column of shape \(2, 1\), got shape",
        ),
        (
            [GOOD, Signal(GOOD.a, 0 * A, 0 * A)],
            r"signals\[2\]: expected a positive definite sum A1 \+ A2, got a singular",
        ),
    ],
)
def test_signals_that_do_not_fit(signals, message):
    with pytest.raises(UsageError, match=message):
        split_covariance_intersection(signals)


@pytest.mark.parametrize(
    ("weights", "got"),
    [
        ((0.5, 0.2, 0.3), "got 3 of them"),
        ((1.5, -0.5), r"got \[1\.5, -0\.5\]"),
        ((np.nan, 1), "got .*nan"),
        ((0.5, 0.6), r"sum 1\.1"),
    ],
)
def test_impossible_weights(weights, got):
    with pytest.raises(UsageError, match=f"weights: expected 2 numbers of at least 0 that sum to 1, .*{got}"):
        split_covariance_intersection([GOOD, GOOD], weights=weights)


@pytest.mark.parametrize(
    ("criterion", "message"),
    [
        (Criterion("size"), r"criterion: expected one of det, trace, lp, max-eig, got 'size'"),
        (Criterion(block=(0, 2)), r"criterion\.block: expected different states from 0 to 1, got \[0, 2\]"),
        (Criterion(block=(0, 0)), r"criterion\.block: expected different states"),
        (Criterion(block=()), r"criterion\.block: expected different states"),
        (Criterion("lp", p=0.5), r"criterion\.p: expected a finite exponent of at least 1, got 0\.5"),
        (Criterion("lp", weights=(1.0, -1.0)), r"criterion\.weights: expected 2 positive numbers, got"),
        (Criterion("lp", weights=(1.0,)), r"criterion\.weights: expected 2 positive numbers, got"),
        (Criterion("det", weights=(1.0, 1.0)), r'criterion\.weights: expected none for "det"'),
    ],
)
def test_criteria_that_do_not_fit(criterion, message):
    with pytest.raises(UsageError, match=message):
        split_covariance_intersection([GOOD, GOOD], criterion)
    with pytest.raises(UsageError, match=message):
        fuse_stack([A[None], B[None]], [A[None], B[None]], None, criterion)


def test_what_the_signals_do_not_observe():
    seen = Signal(None, np.eye(1), np.eye(1), np.array([[1.0, 0.0]]))
    with pytest.raises(NoAnswerError, match="observe every state together, got an unbounded C"):
        split_covariance_intersection([seen, seen])
    other = seen._replace(H=np.array([[0.0, 1.0]]))
    assert split_covariance_intersection([seen, other], Criterion("trace")).weights == pytest.approx([0.5, 0.5])
    with pytest.raises(NoAnswerError, match="weights and maps H that make every state known"):
        split_covariance_intersection([seen, other], weights=(1, 0))
    with pytest.raises(NoAnswerError, match="least where C is unbounded outside the block"):
        split_covariance_intersection([seen, other], Criterion("trace", block=(0,)))


def test_stacks_and_pairs_that_do_not_fit():
    P = A[None]
    with pytest.raises(UsageError, match="signals: expected two or more A1, as many A2 and H, got 1, 1 and 1"):
        fuse_stack([P], [P])
    with pytest.raises(UsageError, match=r"signals\[2\]: expected stacks A1 and A2 of 1 square matrices, got shapes"):
        fuse_stack([P, A], [P, A])
    with pytest.raises(UsageError, match=r"signals\[2\]\.H: expected a 2×2 matrix, got shape"):
        fuse_stack([P, P], [P, P], [None, np.ones((1, 2))])
    with pytest.raises(
        UsageError, match=r"signals\[1\]\.A2: expected positive semi-definite matrices, got an indefinite"
    ):
        fuse_stack([5 * P, P], [-P, P])
    with pytest.raises(UsageError, match="pairs: expected stacks A and B of N square matrices each, got shapes"):
        pair_weights(A, B)
    with pytest.raises(UsageError, match='criterion: expected "det" or "trace", got \'lp\''):
        pair_weights(P, P, "lp")
    with pytest.raises(UsageError, match=r"pairs: expected positive definite sums A \+ B, got a singular"):
        pair_weights(0 * P, 0 * P)
    with pytest.raises(UsageError, match="pairs: expected positive semi-definite matrices, got an indefinite one"):
        pair_weights(5 * P, -P)
