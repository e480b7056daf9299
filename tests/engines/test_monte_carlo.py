"""Monte Carlo: reproducible whatever the workers, with honest errors."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines import monte_carlo


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
def test_the_sample_depends_on_the_seed_alone(architecture, monkeypatch):
    """Not on the number of processes, nor on whether equal histories are merged."""
    scenario = sf.load_scenario(architecture=architecture, steps=4)
    kwargs = {"method": "monte-carlo", "runs": 2500, "seed": 11}
    one = sf.predict(scenario, [0.3, 0.6], workers=1, **kwargs)
    two = sf.predict(scenario, [0.3, 0.6], workers=2, **kwargs)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-13)
    for merge_below in (0.0, 10.0):
        monkeypatch.setattr(monte_carlo, "MERGE_BELOW", merge_below)
        other = sf.predict(scenario, [0.3, 0.6], workers=1, **kwargs)
        sample, first = other.sampled.sample, one.sampled.sample
        np.testing.assert_allclose(sample.values.P[sample.which], first.values.P[first.which], rtol=1e-12)
    different = sf.predict(scenario, [0.3, 0.6], method="monte-carlo", runs=2500, seed=12)
    assert (different.values() != one.values()).any()


def test_more_runs_of_a_seed_begin_with_the_fewer():
    few, many = (
        sf.predict(sf.load_scenario(), [0.5], method="monte-carlo", runs=n).sampled.sample for n in (1000, 3000)
    )
    np.testing.assert_allclose(many.values.P[many.which[:, :1000]], few.values.P[few.which], rtol=1e-12)


@pytest.mark.slow
def test_standard_errors_are_honest():
    """z-scores of 60 samples against the exact answer have mean 0 and variance 1; two-thirds of the intervals hold."""
    scenario = sf.load_scenario(steps=3)
    exact = sf.predict(scenario, [0.4], method="general").values()
    z = []
    for seed in range(60):
        p = sf.predict(scenario, [0.4], method="monte-carlo", runs=300, seed=seed, control="none")
        z.append((p.values() - exact) / p.standard_error())
    z = np.array(z)[:, 0]
    assert (np.abs(z.mean(axis=0)) < 4 / np.sqrt(60)).all()
    assert (np.abs((z**2).mean(axis=0) - 1) < 4 * np.sqrt(2 / 60)).all()


@pytest.mark.parametrize("metric", ["trace", "det", "max-eig", "std:x", "rms:x,y"])
def test_errors_of_any_metric(metric):
    """The delta method against the spread of the metric of the mean over many small samples."""
    scenario = sf.load_scenario("cv-2d", steps=2)
    plain = {"method": "monte-carlo", "runs": 400, "control": "none"}
    samples = [sf.predict(scenario, [0.5], seed=s, **plain) for s in range(40)]
    spread = np.std([p.values(metric) for p in samples], axis=0, ddof=1)
    claimed = np.mean([p.standard_error(metric) for p in samples], axis=0)
    np.testing.assert_allclose(claimed, spread, rtol=0.45)


@pytest.mark.parametrize(("architecture", "agents"), [("broadcast", 60), ("ad-hoc", 33), ("cyclic", 40)])
def test_many_agents(architecture, agents):
    """Step 1 in closed form: P(k0)/(m + 1) for m arrivals."""
    p = sf.predict(
        sf.load_scenario(architecture=architecture, agents=agents, steps=1), [0.2], method="monte-carlo", runs=200
    )
    heard = 2 if architecture == "cyclic" else agents
    expected = 100 * (1 - 0.8**heard) / (heard * 0.2)
    assert abs(p.values()[0, 0] - expected) < 4.5 * p.standard_error()[0, 0]


def test_certain_outcomes_have_no_error():
    scenario = sf.load_scenario(steps=3)
    p = sf.predict(scenario, [0.0, 1.0], method="monte-carlo", runs=10)
    np.testing.assert_allclose(p.standard_error(), 0, atol=1e-12)
    np.testing.assert_allclose(p.values(), sf.predict(scenario, [0.0, 1.0], method="general").values(), rtol=1e-12)


def test_errors_of_one_agent_and_of_the_worst():
    source = {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}, "agent": [{}, {"R": 400}]}
    source["network"] = {"agents": 2, "steps": 3, "link": 0.5}
    p = sf.predict(sf.Scenario.from_mapping(source), method="monte-carlo", runs=500)
    assert (p.values("trace", "worst")[:, 1:] == p.values("trace", 2)[:, 1:]).all()
    np.testing.assert_array_equal(p.standard_error("trace", "worst")[:, 1:], p.standard_error("trace", 2)[:, 1:])
    assert (p.standard_error("trace", "mean") > 0).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"runs": 1}, "runs: expected a whole number of at least 2, got 1"),
        ({"seed": -1}, "seed: expected a whole number of at least 0, got -1"),
        (
            {"runs": 10**12},
            "runs: 1000000000000 runs for 1 link probabilities, 5 steps and 3 agents are 1.5e.13 values; expected at most",
        ),
        ({"workers": 0}, "workers: expected a whole number of at least 1, got 0"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict(sf.load_scenario(), [0.5], method="monte-carlo", **settings)
