"""Steady state: fixed points against long runs, SciPy's Riccati solver and their own certificate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

import stochfuse as sf
from tests.oracles import textbook
from tests.oracles.strategies import mapping, model, seeds

LINKS = (0.0, 0.3, 1.0)


@settings(max_examples=25)
@given(seeds, st.integers(1, 4), st.integers(1, 5))
def test_no_link_and_full_link_are_riccati_equations(seed, d, agents):
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = model(rng, d, 2)
    steady = sf.steady_state(sf.Scenario.from_mapping(mapping(F, Q, H, R, P0, agents=agents)), LINKS)
    for row, noise in ((0, R), (-1, R / agents)):
        prior = solve_discrete_are(F.T, H.T, Q, noise)
        expected = textbook.kalman_update(prior, H, noise)
        np.testing.assert_allclose(steady.P[row, 0], expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
    assert (steady.residual < 1e-11).all()
    assert (steady.bound <= 1e-8).all()


@pytest.mark.parametrize("preset", ["thesis-transient", "thesis-steady", "cv-2d", "fcs-demo"])
def test_presets_settle_where_a_long_run_ends(preset):
    s = sf.load_scenario(preset, steps=200)
    p = sf.predict(s, steady=True)
    assert p.steady is not None
    np.testing.assert_allclose(p.steady, p.by_group[:, -1], rtol=1e-9, atol=1e-9)
    assert (p.steady_bound <= 1e-9).all()


def test_slow_filters_are_finished_by_newton():
    """Q/R = 1e-8 would take about 1e5 plain steps to 1e-12."""
    s = sf.Scenario.from_mapping(mapping(1.0, 1e-8, 1.0, 1.0, 1.0))
    steady = sf.steady_state(s, [0.0, 1.0])
    for P, noise in zip(steady.P[:, 0, 0, 0], (1.0, 1 / 3), strict=True):
        q = 1e-8
        prior = (q + np.sqrt(q * q + 4 * q * noise)) / 2  # P⁻ = P⁻R/(P⁻ + R) + q
        assert pytest.approx(prior - q, rel=1e-9) == P
    assert (steady.bound <= 1e-6).all()


def test_unlike_agents_and_a_critical_link_probability():
    """Agent 2 sees nothing by itself: with F = 1.2 it needs 1 − µ < 1/1.44 from agent 1 to stay bounded."""
    source = mapping(1.2, 1.0, 1.0, 1.0, 1.0, agents=2, steps=2)
    source["agent"] = [{}, {"H": 1.0, "R": 1e15}]
    s = sf.Scenario.from_mapping(source)
    steady = sf.steady_state(s, [0.6])
    P = steady.P[0, steady.group_of[1], 0, 0]
    prior = 1.44 * P + 1
    assert pytest.approx(0.6 * prior / (1 + prior) + 0.4 * prior, rel=1e-9) == P


@pytest.mark.parametrize(
    ("F", "H", "mode"),
    [([[1, 1], [0, 1]], [[0, 1]], "1"), (1.5, [[0.0]], "1.5"), ([[0.5, 0], [0, -1.1]], [[1, 0]], "-1.1")],
)
def test_an_unobserved_mode_has_no_steady_state(F, H, mode):
    d = np.atleast_2d(F).shape[0]
    s = sf.Scenario.from_mapping(mapping(F, np.eye(d), H, np.eye(1), np.eye(d)))
    with pytest.raises(
        sf.NoAnswerError, match=f"no steady state: .* the mode of F with eigenvalue {mode} is not observed by H"
    ):
        sf.steady_state(s)


def test_the_units_of_the_states_do_not_matter():
    plain = mapping(np.diag([1.1, 0.5]), np.eye(2), [[1, 1]], 1.0, np.eye(2))
    scaled = mapping(np.diag([1.1, 0.5]), np.diag([1e22, 1]), [[1e-11, 1]], 1.0, np.diag([1e22, 1]))
    a, b = (sf.steady_state(sf.Scenario.from_mapping(m), [0.5]).P[0, 0] for m in (plain, scaled))
    np.testing.assert_allclose(b / np.outer([1e11, 1], [1e11, 1]), a, rtol=1e-9)


def test_without_process_noise_the_steady_state_is_zero():
    steady = sf.steady_state(sf.Scenario.from_mapping(mapping(1.0, 0.0, 1.0, 1.0, 1.0)), [0.0, 0.7])
    assert steady.P.ravel().tolist() == [0.0, 0.0]
    assert steady.bound.ravel().tolist() == [0.0, 0.0]


def test_what_varies_with_the_step_has_none():
    for change in ({"link": [0.1, 0.2, 0.3, 0.4]}, {}):
        source = mapping(1.0, 1.0, 1.0, 1.0, 1.0, **change)
        if not change:
            source["model"]["R"] = [[[1.0]]] * 4
        with pytest.raises(sf.UsageError, match="a steady state needs a model, sensors and links that do not vary"):
            sf.steady_state(sf.Scenario.from_mapping(source))


def blind_and_seeing(F, H, link):
    """Two agents of which the first measures nothing, so that it lives on what it hears."""
    d = len(F)
    return sf.Scenario.from_mapping(
        {
            "model": {"F": F, "H": H, "Q": np.eye(d).tolist(), "R": 1},
            "initial": {"P": np.eye(d).tolist()},
            "network": {"agents": 2, "steps": 2, "link": link},
            "agent": [{"sensor": False}, {}],
        }
    )


@pytest.mark.parametrize("F", [[[1.2]], [[1.2, 0.3], [0, 0.9]], [[1.2, 1.0], [0, 1.2]], [[0.9, 0.9], [-0.9, 0.9]]])
def test_a_blind_agent_has_a_steady_state_above_the_critical_link_probability(F):
    # whatever arrives shows every mode within d steps, and what grows is hidden with probability 1 - µ in one step
    H = [[1.0] * len(F)] if len(F) == 1 else [[1.0, 0.5]]
    critical = 1 - 1 / max(abs(np.linalg.eigvals(F))) ** 2
    with pytest.raises(sf.NoAnswerError, match="grows by a factor of at least 1"):
        sf.steady_state(blind_and_seeing(F, H, critical - 1e-4))
    steady = sf.steady_state(blind_and_seeing(F, H, critical + 0.5 * (1 - critical)))
    assert np.isfinite(steady.P).all()


def test_nothing_grows_where_there_is_no_noise_to_begin_with():
    s = blind_and_seeing([[1.0]], [[1.0]], 0.0)
    with pytest.raises(sf.NoAnswerError, match="eigenvalue 1 grows by a factor of at least 1 in every step"):
        sf.steady_state(s)
