"""Steady states of everything: long transient runs, closed forms, 50 digits, Monte Carlo, and what has none."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

import stochfuse as sf
from stochfuse.prediction import limits
from tests.oracles import strategies

BURST = {"good_to_bad": 0.3, "bad_to_good": 0.4, "good": 0.9, "bad": 0.2}
UNEVEN = [[0, 0.3, 0.9], [0.6, 0, 0.2], [0.5, 0.8, 0]]
PERIODS = [
    {"sensor": {"kind": "position", "sigma": 5, "period": 2}},
    {"sensor": {"kind": "position", "sigma": 3, "period": 3, "offset": 1}},
    {"sensor": {"kind": "position", "sigma": 9}},
]


def scalar(agents=3, steps=60, agent=None, F=1, **network):
    source = strategies.mapping(F, 25, 1, 100, 100, agents, steps, **network)
    return sf.Scenario.from_mapping(source | ({"agent": agent} if agent else {}))


def walking(steps, agent=PERIODS, **network):
    model = {"kind": "constant-velocity", "axes": 1, "step": 1.0, "noise": 0.4}
    model["nominal"] = {"position": [0], "velocity": [0]}
    network = {"agents": len(agent), "steps": steps, **network}
    return sf.scenario(model=model, initial={"P": [[100, 0], [0, 9]]}, network=network, agent=agent)


@pytest.mark.parametrize(
    ("scenario", "link"),
    [
        (scalar(), [0.0, 0.2, 0.7, 1.0]),
        (scalar(architecture="cyclic"), [0.3]),
        (scalar(link=UNEVEN), None),
        (scalar(agent=[{}, {"R": 20}, {"sensor": False}]), [0.4]),
        (scalar(delay=[0.5, 0.3, 0.2]), [0.6]),
        (scalar(agents=2, burst=BURST), None),
        (scalar(agents=10), [0.5]),
        pytest.param(sf.load_scenario("cv-2d", steps=60), [0.3], marks=pytest.mark.slow),
    ],
    ids=["like", "ring", "unequal", "unlike", "delays", "bursts", "enclosed", "matrices"],
)
def test_a_long_run_of_the_chain_ends_in_the_steady_optimum(scenario, link):
    p = sf.predict(scenario, link, method="optimal", steady=True)
    long, steady = p.by_group[:, -1], p.steady
    near = 1e-8 if p.nature == "exact" else 2e-6
    assert p.limit.prediction.nature in ("exact", "bound")
    assert (p.steady_bound < 1e-6).all()
    np.testing.assert_allclose(steady, long, rtol=near, atol=near)
    assert p.steady_error() is None


def test_one_agent_that_hears_another_in_closed_form():
    """Agent 1 sees nothing and loses its state at once (F = 0 but for noise): its error is Q, or that of what arrives."""
    scenario = scalar(agents=2, F=0, agent=[{"sensor": False}, {}])
    p = sf.predict(scenario, [0.25], method="optimal", steady=True)
    known = 1 / (1 / 25 + 1 / 100)
    assert p.steady_values("trace", 2)[0] == pytest.approx(known, rel=1e-12)
    assert p.steady_values("trace", 1)[0] == pytest.approx(0.25 * known + 0.75 * 25, rel=1e-12)


def test_a_blind_agent_in_fifty_digits():
    """What it knows depends on how long ago it last heard: a geometric number of steps, each a prediction."""
    µ, F = 0.55, 1.2
    scenario = scalar(agents=2, F=F, agent=[{"sensor": False}, {}])
    with mpmath.workdps(50):
        F2, Q, R = mpmath.mpf(F) ** 2, mpmath.mpf(25), mpmath.mpf(100)
        # P = R(F²P + Q)/(F²P + Q + R)
        b = Q + R - F2 * R
        P = (-b + mpmath.sqrt(b * b + 4 * F2 * Q * R)) / (2 * F2)
        expected, age, seen = mpmath.mpf(0), P, mpmath.mpf(µ)
        for _ in range(600):
            expected, age, seen = expected + seen * age, F2 * age + Q, seen * (1 - mpmath.mpf(µ))
    p = sf.predict(scenario, [µ], method="optimal", steady=True)
    assert p.steady_values("trace", 1)[0] == pytest.approx(float(expected), rel=1e-10)
    assert p.steady_values("trace", 2)[0] == pytest.approx(float(P), rel=1e-10)


def test_stand_alone_is_a_riccati_equation_whatever_the_links():
    p = sf.predict(scalar(steps=2), [0.3, 0.9], estimator="stand-alone", quantity="rms", steady=True)
    expected = (-25 + np.sqrt(25**2 + 4 * 25 * 100)) / 2
    np.testing.assert_allclose(p.steady_values() ** 2, expected, rtol=1e-9)
    np.testing.assert_allclose(p.shown_as("actual").steady_values(), expected, rtol=1e-9)
    np.testing.assert_array_equal(p.shown_as("bias").steady_values(), 0)
    np.testing.assert_allclose(p.shown_as("consistency").steady_values(), 1)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["simplified", "optimal"])
def test_sensors_with_periods_go_round(method):
    """Steps k ≡ 1, 2 … 6 (mod 6) of a long run; its mean is shown."""
    p = sf.predict(walking(6), [0.6], method=method, steady=True)
    long = sf.predict(walking(36 if method == "optimal" else 120), [0.6], method=method)
    assert p.limit.period == 6
    near = 1e-4 if method == "optimal" else 1e-9
    np.testing.assert_allclose(p.limit.values(), long.values()[:, -6:], rtol=near)
    np.testing.assert_allclose(p.steady_values(), long.values()[:, -6:].mean(axis=1), rtol=near)
    assert np.ptp(p.limit.values()) > 0.02 * p.steady_values()[0]
    assert "the cycle of 6 steps, of which the mean is shown, is proved to lie within" in p.limit.notes[0]


@pytest.mark.slow
def test_a_sensor_that_misses():
    agent = [{"sensor": {"kind": "position", "sigma": 5, "detection": 0.6}}, *PERIODS[:1]]
    p = sf.predict(walking(4, agent), [0.7], method="optimal", steady=True)
    long = sf.predict(walking(40, agent), [0.7], method="monte-carlo", estimator="optimal", runs=1500, seed=2)
    assert p.limit.period == 2
    assert p.limit.prediction.nature in ("exact", "bound")
    z = (long.values()[:, -2:] - p.limit.values()) / long.standard_error()[:, -2:]
    assert (np.abs(z) < 4.5).all()


@pytest.mark.slow
def test_what_is_sampled_is_what_a_longer_sample_shows():
    scenario = scalar(steps=2)
    p = sf.predict(scenario, [0.4], method="general", quantity="actual", steady=True, runs=500, seed=3)
    (note,) = p.limit.notes
    assert note.startswith("steady state: sampled at step 16, 500 runs; two samples of the same arrivals")
    long = sf.predict(scalar(steps=20), [0.4], method="monte-carlo", quantity="actual", runs=700, seed=4)
    z = (p.steady_values() - long.values()[:, -1]) / np.hypot(p.steady_error(), long.standard_error()[:, -1])
    assert abs(z[0]) < 4
    # nothing is better than the optimum, and this rule is nearly as good
    best = sf.predict(scenario, [0.4], method="optimal", steady=True).steady_values()
    assert (p.steady_values() + 4 * p.steady_error() > best).all()
    assert 0 < p.steady_error()[0] < 0.02 * best[0]
    assert abs(p.steady_values()[0] / best[0] - 1) < 0.05


def test_samples_without_chance_are_as_good_as_exact():
    p = sf.predict(scalar(steps=2), [0.0, 1.0], method="naive", steady=True, runs=20)
    np.testing.assert_allclose(p.steady_values()[0], (-25 + np.sqrt(25**2 + 4 * 25 * 100)) / 2, rtol=1e-6)
    np.testing.assert_array_equal(p.steady_error(), 0)


def test_what_nodes_measure_of_one_another_along_their_paths_ends():
    with pytest.raises(sf.UsageError, match="got filters or relations that vary with the step"):
        sf.predict("cooperative-pnt", [0.5], method="monte-carlo", estimator="lwin", runs=10, steady=True)


@pytest.mark.slow
def test_parallel_filters_that_never_see_where_they_are_have_none():
    with pytest.raises(sf.NoAnswerError, match="two samples of the same arrivals that start far apart do not agree"):
        sf.predict("parallel-filters", [0.5], method="monte-carlo", estimator="blender", runs=3, steady=True)


@pytest.mark.parametrize("method", ["optimal", "monte-carlo"])
def test_what_grows_without_end_has_none(method):
    """1 − µ of what is F² times as large after a step, at least 1/1.44 = 0.694 of it."""
    scenario = scalar(agents=2, F=1.2, steps=2, agent=[{"sensor": False}, {}])
    with pytest.raises(sf.NoAnswerError, match=r"no steady state: the mode of F with eigenvalue 1.2 grows by a factor"):
        sf.predict(scenario, [0.3], method=method, steady=True, **({"runs": 10} if method == "monte-carlo" else {}))


def test_an_error_without_a_variance_is_not_sampled():
    scenario = scalar(agents=2, F=1.2, steps=2, agent=[{"sensor": False}, {}])
    with pytest.raises(sf.NoAnswerError, match=r"the steady state cannot be sampled: .* has no variance over the outc"):
        sf.predict(scenario, [0.5], method="monte-carlo", runs=10, steady=True)


@pytest.mark.slow
def test_what_does_not_settle_is_said():
    """Without process noise errors shrink for ever, as 1/k: two starts never agree."""
    source = strategies.mapping(1, 0, 1, 100, 100, 2, 2)
    with pytest.raises(sf.NoAnswerError, match="no steady state"):
        sf.predict(sf.Scenario.from_mapping(source), [0.5], method="naive", steady=True, runs=2)


@pytest.mark.parametrize("method", ["simplified", "optimal", "monte-carlo"])
def test_what_ends_with_its_steps_has_none(method):
    message = (
        "a steady state needs a model, sensors and links that do not vary with the step, or sensors with a period; "
    )
    with pytest.raises(sf.UsageError, match=message + "got network.link per step"):
        sf.predict(scalar(steps=2, link=[0.1, 0.2]), method=method, steady=True)
    source = strategies.mapping(1, 1, 1, 1, 1, 2, 4)
    source["model"]["R"] = [[[1.0]], [[2.0]], [[1.0]], [[2.0]]]
    with pytest.raises(sf.UsageError, match=message + "got model.F, Q, H, R per step"):
        sf.predict(sf.Scenario.from_mapping(source), [0.5], method=method, steady=True)
    with pytest.raises(sf.UsageError, match=message):
        sf.predict("two-radars", [0.5], method=method, steady=True)


@pytest.mark.slow
def test_bounds_hold_at_every_length_of_the_paths(monkeypatch):
    """Long before they are tight the bounds enclose the answer."""
    scenario, link = sf.load_scenario("cv-2d", steps=2), [0.05, 0.3]
    exact = sf.predict(scenario, link, method="optimal", steady=True)
    widths = []
    for most in (10, 20):
        monkeypatch.setattr(limits, "MOST_ALONG_PATHS", most)
        monkeypatch.setattr(limits.optimal, "LOOSE", np.inf)
        p = sf.predict(scenario, link, method="optimal", steady=True)
        for x in np.random.default_rng(3).normal(size=(10, 4, 1)):
            true, shown = ((x.T @ q.steady @ x)[..., 0, 0] for q in (exact, p))
            assert (np.abs(true / shown - 1) <= p.steady_bound * (1 + 1e-9)).all()
        widths.append(p.steady_bound[:, 0])
    assert (widths[1] < widths[0]).all()
    assert widths[0].max() > 1e-5
