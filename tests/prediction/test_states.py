"""(53): expected states for a measurement record."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

import stochfuse as sf
from tests.agreement.test_detection import with_detection
from tests.oracles import textbook
from tests.oracles.strategies import mapping, model

STEPS = 4


def setup(seed=0, d=2, p=1, agents=3, **network):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, d, p)
    source = mapping(F, Q, H, R, P0, agents=agents, steps=STEPS, **network)
    source["initial"]["x"] = rng.normal(size=d).tolist()
    return source, (F, Q, H, R, P0), np.array(source["initial"]["x"])[:, None], rng


def literal(given, x0, z, agents, mu, printed):
    """(53) with inverses, for one record; (54) beside it for the averaged covariance."""
    F, Q, H, R, P0 = given
    weights = [textbook.binomial(m, agents - 1, mu) for m in range(agents)]
    inv = np.linalg.inv
    P_m = [P0 / (m + 1) for m in range(agents)]
    P = sum(w * Pm for w, Pm in zip(weights, P_m, strict=True))
    x = sum(
        w * (P if printed else Pm) @ ((m + 1) * inv(P0) @ x0)
        for m, (w, Pm) in enumerate(zip(weights, P_m, strict=True))
    )
    out = [x]
    for k in range(1, len(z)):
        prior_x, prior = F @ x, textbook.kalman_predict(P, F, Q)
        local_x = textbook.kalman_state(prior_x, prior, H, R, z[k][:, None])
        local = textbook.kalman_update(prior, H, R)
        P_m = [inv((m + 1) * inv(local) - m * inv(prior)) for m in range(agents)]
        P = sum(w * Pm for w, Pm in zip(weights, P_m, strict=True))
        x = sum(
            w * (P if printed else Pm) @ ((m + 1) * inv(local) @ local_x - m * inv(prior) @ prior_x)
            for m, (w, Pm) in enumerate(zip(weights, P_m, strict=True))
        )
        out.append(x)
    return np.array(out)[..., 0]


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize(("d", "p", "agents"), [(1, 1, 3), (2, 1, 3), (3, 2, 5)])
def test_one_record_against_the_literal_form(d, p, agents, printed):
    source, given, x0, rng = setup(d, d, p, agents)
    z = rng.normal(size=(STEPS, p))
    states = sf.predict_states(sf.Scenario.from_mapping(source), z, [0.0, 0.3, 1.0], printed=printed)
    assert states.x.shape == (3, STEPS, agents, d)
    for i, mu in enumerate((0.0, 0.3, 1.0)):
        expected = literal(given, x0, z, agents, mu, printed)
        np.testing.assert_allclose(states.x[i, :, 0], expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_array_equal(states.x[i, :, 0], states.x[i, :, -1])


def test_the_printed_form_is_biased_by_7_6_at_step_one():
    source = mapping(1.0, 25.0, 1.0, 100.0, 100.0, steps=2)
    source["initial"]["x"] = 1000.0
    s = sf.Scenario.from_mapping(source)
    z = np.full((2, 1), 1000.0)
    assert sf.predict_states(s, z, [0.5], printed=True).x[0, 0, 0, 0] == pytest.approx(7000 / 6)
    np.testing.assert_allclose(sf.predict_states(s, z, [0.5]).x, 1000.0)


def test_published_kalman_case():
    """Theory section 10 gives x̂ = (5.116244352839, 1.045095743855) after five measurements; exact rational arithmetic
    gives 5.116244345838…, 1.045095737855…: the page is right to eight digits only.
    """
    exact = rational_filter(["0.9", "2", "3.1", "3.9", "5.2"])
    assert [float(v) for v in exact] == pytest.approx([5.116244345837822, 1.045095737854621], rel=1e-15)
    source = mapping([[1, 1], [0, 1]], np.diag([0.05, 0.01]), [[1, 0]], 0.25, np.eye(2), agents=1, steps=6)
    source["initial"]["x"] = [0, 1]
    z = np.array([[np.nan], [0.9], [2.0], [3.1], [3.9], [5.2]])  # step 1 has no measurement
    states = sf.predict_states(sf.Scenario.from_mapping(source), z, [0.0])
    np.testing.assert_allclose(states.x[0, -1, 0], [float(v) for v in exact], rtol=1e-14)
    np.testing.assert_allclose(states.x[0, -1, 0], [5.116244352839, 1.045095743855], rtol=6e-9)


def rational_filter(measurements):
    """The textbook filter of that case in exact rational arithmetic."""
    F, H = sympy.Matrix([[1, 1], [0, 1]]), sympy.Matrix([[1, 0]])
    Q, R = sympy.diag(sympy.Rational("0.05"), sympy.Rational("0.01")), sympy.Matrix([[sympy.Rational("0.25")]])
    x, P = sympy.Matrix([0, 1]), sympy.eye(2)
    for z in measurements:
        x, P = F * x, F * P * F.T + Q
        K = P * H.T * (H * P * H.T + R).inv()
        x, P = x + K * (sympy.Matrix([sympy.Rational(z)]) - H * x), (sympy.eye(2) - K * H) * P
    return x


@pytest.mark.parametrize("unlike", [False, True])
def test_own_records_are_averaged_over_every_set_of_senders(unlike):
    source, (F, Q, H, R, _), x0, rng = setup(5, 2, 1, 3)
    links = rng.uniform(size=(3, 3))
    source["network"]["link"] = links.tolist()
    noises = [1.0, 2.0, 5.0] if unlike else [float(R[0, 0])] * 3
    if unlike:
        source["agent"] = [{"R": r} for r in noises]
    z = rng.normal(size=(STEPS, 3, 1))
    s = sf.Scenario.from_mapping(source)
    states = sf.predict_states(s, z)
    covariance = sf.predict(s)
    for i in range(3):
        others = [j for j in range(3) if j != i]
        x = x0
        for k in range(1, STEPS):
            prior_x = F @ x
            prior = textbook.kalman_predict(covariance.of_agent(i + 1)[0, k - 1], F, Q)
            x = np.zeros_like(x0)
            for a in (False, True):
                for b in (False, True):
                    weight = np.prod(
                        [links[i, j] if h else 1 - links[i, j] for j, h in zip(others, (a, b), strict=True)]
                    )
                    now_x, now_P = prior_x, prior
                    for j in [i] + [j for j, h in zip(others, (a, b), strict=True) if h]:
                        now_x = textbook.kalman_state(now_x, now_P, H, np.array([[noises[j]]]), z[k, j][:, None])
                        now_P = textbook.kalman_update(now_P, H, np.array([[noises[j]]]))
                    x = x + weight * now_x
            np.testing.assert_allclose(states.x[0, k, i], x[:, 0], rtol=1e-9, atol=1e-11)


def test_a_record_that_all_share_is_the_same_as_equal_own_records():
    source, _, _, rng = setup(6, 2, 1, 3, link=[[0, 0.2, 0.9], [0.5, 0, 0.1], [1, 0.3, 0]])
    z = rng.normal(size=(STEPS, 1))
    s = sf.Scenario.from_mapping(source)
    shared, own = sf.predict_states(s, z), sf.predict_states(s, np.repeat(z[:, None], 3, axis=1))
    np.testing.assert_allclose(shared.x, own.x, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("R", [1e-8, 1e-14])
def test_own_records_of_precise_sensors_keep_their_digits(R):
    """Measurements with R, R and R make the same estimate as their mean with R/3, in 60 digits."""
    F, H, Q, P0 = np.array([[1.0, 1], [0, 1]]), np.array([[1.0, 0]]), np.diag([0.1, 0.5]), np.diag([100.0, 9])
    z = np.random.default_rng(11).normal(size=(3, 3, 1)) * 100
    source = mapping(F, Q, H, R, P0, agents=3, steps=3)
    got = sf.predict_states(sf.Scenario.from_mapping(source), z, [1.0]).x[0]
    import mpmath as mp

    with mp.workdps(60):
        Fm, Hm, Qm, P = map(textbook.mp_matrix, (F, H, Q, P0 / 3))
        x = mp.matrix([0, 0])
        for k in (1, 2):
            x, P = Fm * x, Fm * P * Fm.T + Qm
            mean = mp.fsum(mp.mpf(float(v)) for v in z[k, :, 0]) / 3
            gain = P * Hm.T / ((Hm * P * Hm.T)[0] + mp.mpf(R) / 3)
            x = x + gain * (mean - (Hm * x)[0])
            P = textbook.mp_update(P, Hm, mp.matrix([[mp.mpf(R) / 3]]))
            for agent in range(3):
                np.testing.assert_allclose(got[k, agent], [float(x[0]), float(x[1])], rtol=1e-9)


def test_a_known_input_moves_the_state():
    source = mapping([[1, 1], [0, 1]], np.eye(2), [[1, 0]], 1e9, np.eye(2), agents=1, steps=3)
    source["model"] |= {"B": [[0.5], [1.0]], "u": [2.0]}
    states = sf.predict_states(sf.Scenario.from_mapping(source), np.zeros((3, 1)), [0.0])
    np.testing.assert_allclose(states.x[0, :, 0], [[0, 0], [1, 2], [4, 4]], atol=1e-6)


@pytest.mark.parametrize(
    ("z", "options", "message"),
    [
        (
            np.zeros((2, 1)),
            {},
            r"measurements: expected shape \(steps, p\) or \(steps, agents, p\) with 4 steps, 3 agents and p = 1",
        ),
        (np.zeros((4, 2)), {}, r"got \(4, 2\)"),
        (np.zeros((4, 5, 1)), {}, r"got \(4, 5, 1\)"),
        (np.full((4, 1), np.nan), {}, "measurements: expected finite numbers"),
        (np.zeros((4, 3, 1)), {"printed": True}, r"\(53\) as printed takes one record for all agents"),
    ],
)
def test_records_that_do_not_fit(z, options, message):
    source, *_ = setup()
    with pytest.raises(sf.UsageError, match=message):
        sf.predict_states(sf.Scenario.from_mapping(source), z, **options)


@pytest.mark.parametrize("detection", [1.0, 0.7])
def test_own_records_of_many_agents(detection):
    """Twenty agents with two kinds of sensor, against 1,500 drawn sets of senders."""
    source, (F, Q, H, R, _), x0, rng = setup(7, 2, 1, 20)
    n, agent = 20, 7
    links, z = rng.uniform(size=(n, n)), rng.normal(size=(2, n, 1))
    source["network"] |= {"link": links.tolist(), "steps": 2}
    noises = [float(R[0, 0]) * (1 + 3 * (i % 2)) for i in range(n)]
    source["agent"] = [{"R": r} for r in noises]
    s = sf.Scenario.from_mapping(source)
    s = s if detection == 1.0 else with_detection(s, [detection] * n)
    got = sf.predict_states(s, z).x[0, 1, agent]
    prior = textbook.kalman_predict(sf.predict(s).of_agent(agent + 1)[0, 0], F, Q)
    drawn = []
    for arrives in rng.uniform(size=(1500, n)) < detection * np.where(np.arange(n) == agent, 1.0, links[agent]):
        Y = np.linalg.inv(prior) + sum(H.T @ H / noises[j] for j in np.flatnonzero(arrives))
        y = np.linalg.solve(prior, F @ x0) + sum(H.T @ z[1, j][:, None] / noises[j] for j in np.flatnonzero(arrives))
        drawn.append(np.linalg.solve(Y, y)[:, 0])
    off = np.abs(np.mean(drawn, axis=0) - got) / (np.std(drawn, axis=0) / np.sqrt(1500))
    assert off.max() < 4.5


def test_a_singular_prior_is_refused_as_printed():
    singular = mapping(1.0, 0.0, 1.0, 1.0, 0.0)
    with pytest.raises(sf.UsageError, match=r"\(53\) as printed needs an invertible prior covariance"):
        sf.predict_states(sf.Scenario.from_mapping(singular), np.zeros((4, 1)), printed=True)
