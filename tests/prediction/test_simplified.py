"""(54): published numbers, brute force over sets of senders, exact fractions, and what must hold for every model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

import stochfuse as sf
from stochfuse.kalman.kernel import Estimate
from stochfuse.prediction.simplified import outcome, outcome_as_printed, outcome_by_information
from tests.oracles import textbook
from tests.oracles.strategies import covariance, mapping, model, probabilities, seeds

LINKS = (0.0, 0.25, 0.5, 0.75, 1.0)


def scenario(F, Q, H, R, P0, **network):
    return sf.Scenario.from_mapping(mapping(F, Q, H, R, P0, **network))


@given(seeds, st.integers(1, 4), st.integers(1, 3), st.integers(1, 6), st.booleans())
def test_like_agents_match_the_printed_form(seed, d, p, agents, shared):
    rng = np.random.default_rng(seed)
    given_model = model(rng, d, p)
    source = mapping(*given_model, agents=agents, steps=4)
    source["initial"]["correlation"] = "shared" if shared else "independent"
    got = sf.predict(sf.Scenario.from_mapping(source), LINKS).covariance
    F, Q, H, R, P0 = given_model
    for i, mu in enumerate(LINKS):
        expected = textbook.simplified_literal(F, Q, H, R, P0, agents, mu, 4, shared)
        assert textbook.scaled_error(got[i], expected) < 1e-8


@pytest.mark.parametrize("agents", [1, 2, 3, 7])
def test_scalar_model_against_exact_fractions(agents):
    link = [0.0, 0.125, 0.5, 0.875, 1.0]
    s = scenario(1.0, 25.0, 1.0, 100.0, 100.0, agents=agents, steps=4)
    got = sf.predict(s, link).values()
    for i, mu in enumerate(link):
        expected = [float(v) for v in textbook.simplified_scalar_fractions(25, 100, 100, agents, mu, 4)]
        np.testing.assert_allclose(got[i], expected, rtol=2e-15)


@given(seeds, st.integers(1, 3), st.integers(2, 4), st.sampled_from(["like", "unlike", "two kinds"]), st.booleans())
def test_unequal_links_and_unlike_agents_match_every_set_of_senders(seed, d, agents, kind, time_varying):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, d, 2)
    steps = 3
    links = (
        rng.choice([0.0, 1.0, 0.3, 0.8], size=(steps, agents, agents))
        if time_varying
        else rng.uniform(size=(agents, agents))
    )
    source = mapping(F, Q, H, R, P0, agents=agents, steps=steps, link=links.tolist())
    sensors = [(H, R)] * agents
    if kind != "like":
        own = [(rng.normal(size=(p, d)), covariance(rng, p) + 0.1 * np.eye(p)) for p in (1, 2, 3, 1)]
        chosen = [own[j % 2] if kind == "two kinds" else own[j] for j in range(agents)]
        sensors = chosen
        source["agent"] = [{"H": H_j.tolist(), "R": R_j.tolist()} for H_j, R_j in chosen]
    p = sf.predict(sf.Scenario.from_mapping(source))
    per_step = links if time_varying else [links] * steps
    for i in range(agents):
        expected = textbook.simplified_subsets(F, Q, sensors, P0, per_step, steps, i)
        assert textbook.scaled_error(p.of_agent(i + 1)[0], expected) < 1e-8
    np.testing.assert_allclose(
        p.covariance, np.mean([p.of_agent(i + 1) for i in range(agents)], axis=0), rtol=1e-12, atol=1e-14
    )


def test_cyclic_network_hears_the_next_agent_only():
    rng = np.random.default_rng(3)
    F, Q, H, R, P0 = model(rng, 2, 1)
    links = rng.uniform(size=(4, 4))
    p = sf.predict(scenario(F, Q, H, R, P0, agents=4, steps=3, architecture="cyclic", link=links.tolist()))
    only_next = np.zeros((4, 4))
    for j in range(4):
        only_next[j, (j + 1) % 4] = links[j, (j + 1) % 4]
    for i in range(4):
        expected = textbook.simplified_subsets(F, Q, [(H, R)] * 4, P0, [only_next] * 3, 3, i)
        np.testing.assert_allclose(p.of_agent(i + 1)[0], expected, rtol=1e-9)
    assert "on a cyclic one it is an approximation outside its derivation" in p.notes[0]
    one_sender = sf.predict(scenario(F, Q, H, R, P0, agents=2, steps=3), [0.4])
    cyclic = sf.predict(scenario(F, Q, H, R, P0, agents=9, steps=3, architecture="cyclic"), [0.4])
    np.testing.assert_allclose(cyclic.covariance, one_sender.covariance, rtol=1e-13)


def test_masked_network_is_noted_and_a_full_one_is_not():
    rng = np.random.default_rng(4)
    matrix = [[0, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0]]
    masked = sf.predict(scenario(*model(rng, 1, 1), agents=3, steps=2, link=matrix))
    unlike = (
        "agents or links differ: (54) lets an agent's own prior stand for the others', so that only links to it count, "
        "and may be tens of per cent off; --method general or monte-carlo tells"
    )
    assert masked.notes == (
        "some links have probability 0: on a masked network (54) is an approximation outside its derivation, "
        "evaluated with the possible senders of each agent",
        unlike,
    )
    full = sf.predict(
        scenario(*model(rng, 1, 1), agents=3, steps=2, link=[[0, 0.5, 0.1], [0.2, 0, 0.1], [0.2, 0.5, 0]])
    )
    assert full.notes == (unlike,)
    assert sf.predict(scenario(*model(rng, 1, 1), agents=3, steps=2), [0.5]).notes == ()


def test_equal_entries_of_a_matrix_are_the_same_as_one_number():
    rng = np.random.default_rng(5)
    given_model = model(rng, 3, 2)
    number = sf.predict(scenario(*given_model, agents=5, steps=4), [0.3])
    matrix = sf.predict(scenario(*given_model, agents=5, steps=4, link=np.full((5, 5), 0.3).tolist()))
    broadcast = sf.predict(scenario(*given_model, agents=5, steps=4, architecture="broadcast"), [0.3])
    per_step = sf.predict(scenario(*given_model, agents=5, steps=4, link=[0.3] * 4))
    mixed = sf.predict(scenario(*given_model, agents=5, steps=4, link=[0.3, np.full((5, 5), 0.3).tolist(), 0.3, 0.3]))
    for other in (matrix, broadcast, per_step, mixed):
        np.testing.assert_allclose(other.covariance, number.covariance, rtol=1e-12)
        assert other.link == pytest.approx([0.3])


def test_links_that_vary_by_step():
    rng = np.random.default_rng(6)
    F, Q, H, R, P0 = model(rng, 2, 1)
    link = [0.9, 0.1, 0.0, 1.0]
    got = sf.predict(scenario(F, Q, H, R, P0, agents=3, steps=4, link=link)).covariance[0]
    links = [np.full((3, 3), mu) for mu in link]
    np.testing.assert_allclose(got, textbook.simplified_subsets(F, Q, [(H, R)] * 3, P0, links, 4, 0), rtol=1e-9)


def test_models_that_vary_by_step():
    rng = np.random.default_rng(7)
    models = [model(rng, 2, 1) for _ in range(4)]
    F, Q, H, R = (np.array([m[i] for m in models]) for i in range(4))
    P0 = models[0][4]
    got = sf.predict(scenario(F, Q, H, R, P0, agents=3, steps=4), [0.4]).covariance[0]
    P = P0 * sum(textbook.binomial(m, 2, 0.4) / (m + 1) for m in range(3))
    np.testing.assert_allclose(got[0], P, rtol=1e-12)
    for k in range(1, 4):
        prior = textbook.kalman_predict(P, F[k], Q[k])
        P = sum(textbook.binomial(m, 2, 0.4) * textbook.kalman_update(prior, H[k], R[k] / (m + 1)) for m in range(3))
        np.testing.assert_allclose(got[k], P, rtol=1e-9)


def test_noise_gain_enters_the_state():
    G = np.array([[0.5], [1.0]])
    base = mapping([[1, 1], [0, 1]], 2.0 * G @ G.T, [[1, 0]], 3.0, np.eye(2))
    gained = mapping([[1, 1], [0, 1]], 2.0, [[1, 0]], 3.0, np.eye(2))
    gained["model"]["G"] = G.tolist()
    a, b = (sf.predict(sf.Scenario.from_mapping(m), [0.5]).covariance for m in (base, gained))
    np.testing.assert_allclose(a, b, rtol=1e-14)


@given(seeds, st.integers(1, 3), st.integers(1, 5))
def test_limits_no_link_is_the_kalman_filter_and_full_link_is_broadcast_fusion(seed, d, agents):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, d, 2)
    alone, together = sf.predict(scenario(F, Q, H, R, P0, agents=agents, steps=3), [0.0, 1.0]).covariance
    filter_P, broadcast_P = P0, textbook.information_fusion([P0] * agents, 0, None)  # (28)
    for k in range(3):
        if k:
            filter_P = textbook.kalman_update(textbook.kalman_predict(filter_P, F, Q), H, R)
            prior = textbook.kalman_predict(broadcast_P, F, Q)
            local = textbook.kalman_update(prior, H, R)
            broadcast_P = textbook.information_fusion([local] * agents, agents - 1, prior)  # (30)
        assert textbook.scaled_error(alone[k], filter_P) < 1e-9
        assert textbook.scaled_error(together[k], broadcast_P) < 1e-8


@given(seeds, st.integers(1, 3), st.integers(2, 5), probabilities, probabilities)
def test_more_link_never_hurts_and_results_are_covariances(seed, d, agents, a, b):
    rng = np.random.default_rng(seed)
    low, high = sorted((a, b))
    P = sf.predict(scenario(*model(rng, d, 2), agents=agents, steps=4), [0.0, low, high, 1.0]).covariance
    np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2))
    scale = np.abs(P[0]).max()
    assert np.linalg.eigvalsh(P).min() >= -1e-12 * scale
    for worse, better in ((0, 1), (1, 2), (2, 3)):
        assert np.linalg.eigvalsh(P[worse] - P[better]).min() >= -1e-10 * scale


@given(seeds, st.integers(1, 3), probabilities)
def test_change_of_coordinates(seed, d, mu):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, d, 2)
    T = rng.normal(size=(d, d)) + 2 * np.eye(d)
    inverse = np.linalg.inv(T)
    if np.linalg.cond(T) > 1e3:
        return
    plain = sf.predict(scenario(F, Q, H, R, P0), [mu]).covariance
    turned = sf.predict(scenario(T @ F @ inverse, T @ Q @ T.T, H @ inverse, R, T @ P0 @ T.T), [mu]).covariance
    np.testing.assert_allclose(turned, T @ plain @ T.T, rtol=1e-7, atol=1e-9 * np.abs(turned).max())


@given(seeds)
def test_relabelled_agents(seed):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, 2, 1)
    links, order = rng.uniform(size=(4, 4)), rng.permutation(4)
    sensors = [{"R": [[float(r)]]} for r in rng.choice([1.0, 2.0, 5.0], size=4)]

    def run(arrange):
        source = mapping(F, Q, H, R, P0, agents=4, steps=3, link=links[np.ix_(arrange, arrange)].tolist())
        source["agent"] = [sensors[j] for j in arrange]
        return sf.predict(sf.Scenario.from_mapping(source))

    plain, relabelled = run(np.arange(4)), run(order)
    for place, agent in enumerate(order):
        np.testing.assert_allclose(relabelled.of_agent(place + 1), plain.of_agent(int(agent) + 1), rtol=1e-10)


@pytest.mark.parametrize("agents", [10**3, 10**5, 10**6])
@pytest.mark.parametrize("d", [1, 4])
def test_up_to_a_million_agents(agents, d):
    """At µ = 1 all measurements arrive: a Kalman filter with R/n; elsewhere between that and Jensen's bound."""
    s = sf.load_scenario("thesis-transient" if d == 1 else "cv-2d", agents=agents, steps=5)
    p = sf.predict(s, [0.0, 1e-7, 1e-3, 0.5, 1.0])
    kalman = sf.predict(sf.load_scenario(s.name, agents=1, steps=5), [0.0]).covariance[0]
    np.testing.assert_allclose(p.covariance[0], kalman, rtol=1e-10)
    F, Q, H, R = s.model.F, s.model.Q, s.sensors[0].H, s.sensors[0].R
    P = s.P0 / agents
    for k in range(5):
        P = P if k == 0 else textbook.kalman_update(textbook.kalman_predict(P, F, Q), H, R / agents)
        np.testing.assert_allclose(p.covariance[-1, k], P, rtol=1e-6, atol=1e-9 * np.abs(P).max())
    values = p.values()
    assert (np.diff(values, axis=0) <= 1e-9 * values[0]).all()
    few = sf.predict(sf.load_scenario(s.name, agents=round(1 + 0.5 * (agents - 1)), steps=5), [1.0]).values()[0]
    np.testing.assert_allclose(values[3], few, rtol=20 / agents)


def test_the_three_forms_of_an_outcome_agree():
    rng = np.random.default_rng(8)
    _, _, H, R, P = model(rng, 3, 2)
    x, z = rng.normal(size=(3, 1)), rng.normal(size=(2, 1))
    for m in range(4):
        by_update, printed = outcome(Estimate(x, P), H, R, m, z), outcome_as_printed(Estimate(x, P), H, R, m, z)
        np.testing.assert_allclose(by_update.P, printed.P, rtol=1e-10)
        np.testing.assert_allclose(by_update.x, printed.x, rtol=1e-9)
        np.testing.assert_allclose(outcome_by_information(Estimate(None, P), H, R, m).P, printed.P, rtol=1e-10)


def test_one_agent_alone_with_a_matrix_of_links():
    p = sf.predict(sf.Scenario.from_mapping(mapping(1.0, 1.0, 1.0, 1.0, 1.0, agents=1, steps=2, link=[[0.5]])))
    assert p.link.tolist() == [0.0]
    assert p.values()[0].tolist() == [1.0, pytest.approx(2 / 3)]


def test_delay_is_refused_with_the_reason():
    source = mapping(1.0, 1.0, 1.0, 1.0, 1.0, delay=[0.5, 0.5])
    with pytest.raises(sf.UsageError, match=r"method simplified: it is derived without delay \(thesis 4.2\)"):
        sf.predict(sf.Scenario.from_mapping(source))


def test_too_many_unlike_agents_are_refused_with_the_number():
    source = mapping(1.0, 1.0, 1.0, 1.0, 1.0, agents=30, steps=2)
    source["agent"] = [{"R": float(j)} for j in range(1, 31)]
    with pytest.raises(
        sf.UsageError, match=r"unlike agents make 536870912 sets of senders to average over, of 150 probabilities"
    ):
        sf.predict(sf.Scenario.from_mapping(source))


def test_eighteen_unlike_agents_against_an_integral_over_all_sets_of_senders():
    """1/x = ∫ t^(x−1) dt over t from 0 to 1, so that E[1/(1 + Σ s_j)] is the integral of a product over the senders."""
    µ, R = 0.4, np.linspace(20.0, 300.0, 18)
    source = mapping(1.0, 25.0, 1.0, 100.0, 100.0, agents=18, steps=2, link=µ) | {"agent": [{"R": r} for r in R]}
    p = sf.predict(sf.Scenario.from_mapping(source), method="simplified")
    prior = 100.0 * (1 - (1 - µ) ** 18) / (18 * µ) + 25.0
    for i in (0, 17):
        others = prior / np.delete(R, i)
        left, _ = quad(lambda t, i=i, s=others: t ** (prior / R[i]) * np.prod(1 - µ + µ * t**s), 0.0, 1.0, epsabs=1e-12)
        assert p.values(agent=i + 1)[0, 1] == pytest.approx(prior * left, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"link": [1.5]}, "link: expected probabilities between 0 and 1, got 1.5"),
        ({"link": [-0.5, 0.2]}, "link: expected probabilities between 0 and 1, got -0.5"),
        ({"link": [float("nan")]}, "a value that is not finite"),
        ({"link": [[0.5, 0.2]]}, r"one 3×3 matrix of them per row, got an array of shape \(1, 2\)"),
        ({"link": np.zeros((2, 4, 4))}, "link: expected .* 3×3 matrix .* got an array of 4×4"),
        ({"link": "high"}, "link: expected link probabilities"),
        ({"link": []}, "link"),
        (
            {"method": "guess"},
            "method: expected one of simplified, general, chain, optimal, naive, monte-carlo, got 'guess'",
        ),
        (
            {"quantity": "hope"},
            "quantity: expected one of claimed, actual, optimal, consistency, bias, rms, got 'hope'",
        ),
    ],
)
def test_bad_requests(arguments, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict(sf.load_scenario(), **arguments)


def test_a_matrix_per_row():
    s = sf.load_scenario(agents=3)
    matrices = np.stack([np.full((3, 3), 0.25), np.eye(3)])
    p = sf.predict(s, matrices)
    np.testing.assert_allclose(p.values(), sf.predict(s, [0.25, 0.0]).values(), rtol=1e-13)
    np.testing.assert_allclose(p.link, [0.25, 0.0])
