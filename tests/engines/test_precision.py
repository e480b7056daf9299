"""Fast paths on ill-conditioned cases, against 50 digits: they agree, entrywise and scaled, or say that they cannot.

Errors are in units of the states' own standard deviations (`textbook.scaled_error`), but for `kalman.update`, which
promises its digits relative to the prior only, and as far as H P⁻Hᵀ + R is well-conditioned.
"""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.engines.precision import PROMISED, lost
from stochfuse.fusion.intersection import pair_weights
from stochfuse.kalman.checks import covariance_fault
from stochfuse.kalman.kernel import (
    Estimate,
    Information,
    factor,
    from_factor,
    predict,
    predict_factor,
    update,
    update_factor,
    update_information,
)
from stochfuse.prediction.predict import predict_items
from stochfuse.prediction.simplified import reach_of_rounding
from stochfuse.scenario.network import uniform_rows
from stochfuse.scenario.system import Items, Noises
from tests.agreement.test_accuracy import CASES, ODD_H, P0, F, H, Q
from tests.oracles import textbook
from tests.oracles.many import covariances
from tests.oracles.strategies import covariance, mapping, seeds

DIGITS = 50
LINKS = (0.0, 0.5, 1.0)
FOUR = {name: case for name, case in CASES.items() if case[0] is F and case[2] is H}
"""Cases that have transition and sensor in common."""


def correlated(rng, d, condition=1e12):
    """A covariance whose eigenvalues span the condition, along no axis."""
    turn = np.linalg.qr(rng.normal(size=(d, d)))[0]
    P = (turn * np.geomspace(1.0, 1.0 / condition, d)) @ turn.T
    return 0.5 * (P + P.T)


_rng = np.random.default_rng(20)
CONDITIONED = {
    "P0": (F, Q, H, np.eye(2), correlated(_rng, 4)),
    "P0, Q = 0": (F, 0 * Q, H, np.eye(2), correlated(_rng, 4)),
    "P0, Q = 0, R = 1e-14": (F, 0 * Q, H, 1e-14 * np.eye(2), correlated(_rng, 4)),
    "Q": (F, correlated(_rng, 4), H, np.eye(2), P0),
    "R": (F, Q, H, correlated(_rng, 2), P0),
    "R, odd sensor": (F, Q, ODD_H, correlated(_rng, 2), P0),
    "R of one state": (np.eye(1), np.eye(1), np.ones((2, 1)), correlated(_rng, 2), np.eye(1)),
    "F": (correlated(_rng, 4), Q, H, np.eye(2), P0),
    "F, Q = 0": (correlated(_rng, 4), 0 * Q, H, np.eye(2), P0),
    "H": (F, Q, np.array([[1.0, 0, 1, 0], [1.0, 1e-12, 1, 0]]), np.eye(2), P0),
    "H, R = 1e-14": (F, Q, np.array([[1.0, 0, 1, 0], [1.0, 1e-6, 1, 0]]), 1e-14 * np.eye(2), P0),
    "all": (correlated(_rng, 3), correlated(_rng, 3), correlated(_rng, 3), correlated(_rng, 3), correlated(_rng, 3)),
}


def exact(case, agents, mu, steps=3, digits=DIGITS):
    F, Q, H, R, P0 = case
    return textbook.simplified_mpmath(F, Q, H, R, P0, agents, mu, steps, digits=digits)


def numbers(A):
    return np.array([[float(A[i, j]) for j in range(A.cols)] for i in range(A.rows)])


def test_one_batch_of_all_four_state_cases_keeps_nine_digits_and_finds_no_fault():
    """R = 1e-14, P(k0) = 1e12, singular priors, Q = 0, R = 1e12 and benign ones, side by side."""
    cases = [case for case in FOUR.values() for _ in LINKS]
    noises = Noises(*(np.array([case[i] for case in cases]) for i in (1, 3, 4)))
    link = np.array(LINKS * len(FOUR))
    got = covariances(sf.Scenario.from_mapping(mapping(*CASES["benign"], agents=3, steps=3)), link, noises)
    assert got.faults == {}
    assert got.forms == ("measurement-space", "square-root")
    for P, case, mu in zip(got.P, cases, link, strict=True):
        assert textbook.scaled_error(P, exact(case, 3, mu)) < 1e-9


@pytest.mark.parametrize("name", [name for name in CASES if name not in FOUR])
def test_cases_that_keep_nine_digits_one_by_one_keep_them_in_a_batch(name):
    _, Q, _, R, P0 = CASES[name]
    noises = Noises(*(np.array([M] * 3) for M in (Q, R, P0)))
    got = covariances(sf.Scenario.from_mapping(mapping(*CASES[name], agents=10, steps=3)), np.array(LINKS), noises)
    assert got.faults == {}
    for P, mu in zip(got.P, LINKS, strict=True):
        assert textbook.scaled_error(P, exact(CASES[name], 10, mu)) < 1e-9


@pytest.mark.parametrize("name", CONDITIONED)
def test_a_condition_of_1e12_is_borne_or_noticed(name):
    """The prediction of one scenario, and the batch with noises of its own beside a benign item."""
    case = CONDITIONED[name]
    scenario, benign = sf.Scenario.from_mapping(mapping(*case, agents=3, steps=3)), np.eye
    one = sf.predict(scenario, LINKS).covariance
    reach = reach_of_rounding(scenario.system, Items(uniform_rows(LINKS)))
    d, p = case[2].shape[::-1]
    noises = Noises(*(np.array([M, M, M, benign(n)]) for M, n in ((case[1], d), (case[3], p), (case[4], d))))
    got = covariances(scenario, np.array([*LINKS, 0.5]), noises)
    assert set(got.faults) <= {0, 1, 2} | ({3} if "F" in name or "all" in name else set())
    for i, mu in enumerate(LINKS):
        expected = exact(case, 3, mu)
        assert lost(reach)[i] or textbook.scaled_error(one[i], expected) < 1e-9
        assert i in got.faults or textbook.scaled_error(got.P[i], expected) < 1e-9


@pytest.mark.parametrize("unlike", [False, True])
def test_a_prediction_beyond_floating_point_is_refused_with_step_and_link(unlike):
    source = mapping(1e40 * np.eye(2), np.eye(2), [[1.0, 0.0]], 1.0, 1e100 * np.eye(2), agents=2, steps=5)
    if unlike:
        source["agent"] = [{}, {"R": 2.0}]
    message = r"method simplified: the covariance at step 4 is not finite: .* \(link probability 0.25\)"
    with pytest.raises(sf.StochfuseError, match=message):
        sf.predict(sf.Scenario.from_mapping(source), [0.25, 0.5])


def ill(rng, d):
    """Some covariance that asks for trouble: singular, tiny, huge, in unlike units, or of condition 1e12."""
    units = 10.0 ** rng.integers(-6, 7, size=d)
    v = rng.integers(-3, 4, size=(d, 1)).astype(float)
    P = [
        np.zeros((d, d)),
        1e-14 * np.eye(d),
        1e12 * np.eye(d),
        v @ v.T,
        correlated(rng, d) * 10.0 ** rng.integers(-3, 4),
        covariance(rng, d) * units[:, None] * units,
        np.diag(10.0 ** rng.uniform(-14, 12, size=d)),
        covariance(rng, d) + 0.1 * np.eye(d),
    ][rng.integers(8)]
    return 0.5 * (P + P.T)


@pytest.mark.slow
@settings(max_examples=60)
@given(seeds, st.sampled_from([(1, 1), (1, 2), (2, 1), (2, 2), (4, 2), (3, 3)]))
def test_no_mixture_in_a_batch_is_silently_wrong(seed, shape):
    rng = np.random.default_rng(seed)
    d, p = shape
    F = [np.eye(d), np.eye(d) + 1e3 * np.eye(d, k=1), rng.normal(size=(d, d))][rng.integers(3)]
    H = [np.eye(p, d), rng.normal(size=(p, d)), np.ones((p, d))][rng.integers(3)]
    noise = [R for R in (ill(rng, p) for _ in range(40)) if covariance_fault(R, definite=True) is None][:3]
    noises = Noises(np.array([ill(rng, d) for _ in noise]), np.array(noise), np.array([ill(rng, d) for _ in noise]))
    link = rng.choice([0.0, 0.3, 1.0], size=len(noise))
    scenario = sf.Scenario.from_mapping(mapping(F, np.eye(d), H, np.eye(p), np.eye(d), agents=3, steps=3))
    got = covariances(scenario, link, noises)
    for i, mu in enumerate(link):
        Q, R, P0 = (np.asarray(M)[i] for M in noises)
        error = textbook.scaled_error(got.P[i], textbook.simplified_mpmath(F, Q, H, R, P0, 3, mu, 3, digits=70))
        assert i in got.faults or error < PROMISED


@pytest.mark.parametrize("name", [*CASES, *CONDITIONED])
def test_the_kernels_forms_keep_what_they_promise(name):
    """Covariance form: rounding relative to the prior, times the condition of the sensors' correlation.

    Square-root form: relative to the posterior itself.
    """
    F, Q, H, R, P0 = (CASES | CONDITIONED)[name]
    with mp.workdps(DIGITS):
        Fm, Qm, Hm, Rm, P = map(textbook.mp_matrix, (F, Q, H, R, P0))
        exact_prior = Fm * P * Fm.T + Qm
        prior_P, posterior_P = numbers(exact_prior), numbers(textbook.mp_update(exact_prior, Hm, Rm))
    prior = predict(Estimate(None, P0), F, Q).P
    assert textbook.scaled_error(prior, prior_P) < 1e-12
    got = update(Estimate(None, prior), H, R).P
    sd, S = np.sqrt(np.diagonal(prior_P)), H @ prior_P @ H.T + R
    scaled = S / np.sqrt(np.outer(np.diagonal(S), np.diagonal(S)))
    promised = max(1e-14, 1e-15 * min(np.linalg.cond(scaled), 1e15))
    assert (np.abs(got - posterior_P) <= promised * sd[:, None] * sd).all()
    if name not in CONDITIONED:
        L = update_factor(predict_factor(factor(P0), F, factor(Q)), H, R)
        assert textbook.scaled_error(from_factor(L), posterior_P) < 1e-9
    if name in ("benign", "R = 1e-14", "P0 = 1e12", "R = 1e-14 and 1e3"):
        Y = update_information(Information(None, np.linalg.inv(prior)), H, R).Y
        with mp.workdps(DIGITS):
            assert textbook.scaled_error(Y, numbers(mp.inverse(textbook.mp_matrix(posterior_P)))) < 1e-6


@pytest.mark.parametrize("mu", [0.0, 1.0])
@pytest.mark.parametrize("method", ["optimal", "general", "simplified"])
@pytest.mark.parametrize("name", [*CASES, *CONDITIONED])
def test_exact_methods_agree_or_say_that_they_cannot(name, method, mu):
    """At µ = 0 and µ = 1 all methods are a Kalman filter, with one agent's measurements or everyone's."""
    case = (CASES | CONDITIONED)[name]
    scenario = sf.Scenario.from_mapping(mapping(*case, agents=2, steps=3))
    try:
        prediction = sf.predict(scenario, [mu], method)
    except sf.StochfuseError:
        return
    error = textbook.scaled_error(prediction.covariance[0], exact(case, 2, mu))
    said = any("ill-conditioned" in note for note in prediction.notes)
    assert error < 1e-9 or said
    assert prediction.nature == ("approximate" if said or method == "simplified" else "exact")


def some_case(seed):
    """A random model of which some matrices ask for trouble, a link that is down or up, and what is true of it."""
    rng = np.random.default_rng(seed)
    d, p = [(1, 2), (2, 1), (2, 2), (3, 2), (4, 2)][rng.integers(5)]
    F = [np.eye(d), np.eye(d) + np.eye(d, k=1), np.eye(d) + 1e3 * np.eye(d, k=1), rng.normal(size=(d, d))]
    H = [np.eye(p, d), rng.normal(size=(p, d)), np.ones((p, d)) + 1e-5 * rng.normal(size=(p, d))]
    size = 10.0 ** rng.integers(-14, 13, size=3)

    def noise(n, size, definite=True):
        found = (M for M in (ill(rng, n) for _ in range(100)) if covariance_fault(M, definite=definite) is None)
        return next(found) if rng.random() < 0.4 else size * (covariance(rng, n) + 0.1 * np.eye(n))

    case = (F[rng.integers(4)], noise(d, size[0], False), H[rng.integers(3)], noise(p, size[1]), noise(d, size[2]))
    return case, float(rng.integers(2))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["optimal", "general", "simplified"])
@settings(max_examples=40)
@given(seeds)
def test_no_prediction_and_no_batch_is_silently_wrong(method, seed):
    case, mu = some_case(seed)
    scenario = sf.Scenario.from_mapping(mapping(*case, agents=2, steps=3))
    # like sensors of one state, R = 1e-13 and P(k0) = 1e12 cost the textbook's update 50 digits
    expected = exact(case, 2, mu, digits=100)
    for found, said in answers(scenario, method, mu, case):
        assert said or textbook.scaled_error(found, expected) < 1e-8


def answers(scenario, method, mu, case):
    """Covariances by a prediction and by a batch, as far as there are any, and whether they are said to be wrong."""
    try:
        prediction = sf.predict(scenario, [mu], method)
        yield prediction.covariance[0], any("ill-conditioned" in note for note in prediction.notes)
        with np.errstate(all="ignore"):
            own = Noises(*(case[i][None] for i in (1, 3, 4)))
            batch = predict_items(scenario, Items(uniform_rows([mu]), own), method, ["claimed"])
        said = bool(batch.faults) or (method != "simplified" and batch.natures[0] != "exact")
        yield batch.predictions[0].covariance[0], said
    except sf.StochfuseError:
        return


@pytest.mark.slow
def test_weights_of_intersections_are_optimal_to_fifty_digits_or_refused():
    """Pairs of very unlike size and condition; the criterion at the weight found against a search with mpmath."""
    rng = np.random.default_rng(7)
    pairs = [
        (np.diag([1e-14, 1.0]), np.eye(2)),
        (np.diag([1e12, 1e-3]), np.diag([1.0, 1.0])),
        (np.diag([0.0, 1.0]), np.diag([1.0, 0.1])),
        (correlated(rng, 2), correlated(rng, 2)),
        (correlated(rng, 4), np.eye(4)),
        (1e12 * covariance(rng, 3) + 1e12 * np.eye(3), covariance(rng, 3) + np.eye(3)),
        # of rank one exactly: a product of rounded factors has eigenvalues of 1e-16 or none, as the machine rounds
        (np.outer([3.0, -1.0, 2.0], [3.0, -1.0, 2.0]), covariance(rng, 3) + np.eye(3)),
    ]
    for A, B in pairs:
        try:
            found = float(pair_weights(A[None], B[None], "trace")[0])
        except sf.StochfuseError:
            continue
        with mp.workdps(DIGITS):
            value, best = fused_trace(A, B, found), least_trace(A, B)
            assert value <= best * (1 + mp.mpf("1e-9"))


def fused_trace(A, B, w):
    """Trace of (wA⁻¹ + (1−w)B⁻¹)⁻¹ = A((1−w)A + wB)⁻¹B, which a singular A or B does not harm."""
    Am, Bm = textbook.mp_matrix(A), textbook.mp_matrix(B)
    # the ends are limits: a direction without error keeps its information
    w = min(max(mp.mpf(w), mp.mpf("1e-30")), 1 - mp.mpf("1e-30"))
    P = Am * mp.inverse((1 - w) * Am + w * Bm) * Bm
    return sum(P[i, i] for i in range(len(A)))


def least_trace(A, B):
    """Golden-section search: the trace is convex in w."""
    low, high, ratio = mp.mpf(0), mp.mpf(1), (mp.sqrt(5) - 1) / 2
    for _ in range(150):
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        if fused_trace(A, B, left) <= fused_trace(A, B, right):
            high = right
        else:
            low = left
    return min(fused_trace(A, B, w) for w in (0, 1, (low + high) / 2))
