"""The exact optimum as control variate: unbiased, honest, and what it leaves of the variance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines.contact_sample import sample_optimum
from stochfuse.engines.events import events
from stochfuse.engines.monte_carlo import Sample, draw_fates, stream
from stochfuse.kalman.metrics import metric
from stochfuse.prediction import control
from stochfuse.prediction.method import Settings, ShownPart
from stochfuse.scenario.scenario import link_rows
from tests.agreement.test_detection import with_detection

SOURCE = {
    "model": {"F": 1, "H": 1, "Q": 25, "R": 100},
    "initial": {"P": 100, "error": -30.0},
    "network": {"agents": 3, "steps": 3},
}
BURST = {"good_to_bad": 0.3, "bad_to_good": 0.4, "good": 0.9, "bad": 0.2}
UNEQUAL = [[0, 0.9, 0.4], [0.8, 0, 0.3], [0.5, 0.6, 0]]


def small(network=None, **more):
    """A scenario of three agents with a known initial error, and what differs from that."""
    return sf.Scenario.from_mapping({**SOURCE, **more, "network": {**SOURCE["network"], **(network or {})}})


def drawn(scenario, link, **settings):
    return sf.predict(scenario, link, "monte-carlo", **settings)


@pytest.mark.parametrize("off", [0.0, 1.0])
def test_coefficients_are_those_of_the_other_blocks(off):
    """Literally: for every run a least-squares slope without the runs of its block, drawn to 1 by a mean far off."""
    rng = np.random.default_rng(3)
    x = off + rng.normal(size=60)
    y = 3.0 * x + rng.normal(size=60)
    found = control.coefficients(y, x)
    block = np.repeat(np.arange(25), np.diff(np.arange(26) * 60 // 25))
    for run in range(60):
        a, b = x[block != block[run]], y[block != block[run]]
        n = len(a)
        beyond = max(0.0, n * a.mean() ** 2 - 25 * a.var())
        assert (beyond > 0) == (off > 0)
        slope = (np.cov(a, b)[0, 1] * (n - 1) + beyond) / (a.var() * n + beyond)
        assert found[run] == pytest.approx(slope, rel=1e-12)


def test_a_control_that_never_varies_has_the_usual_coefficient():
    np.testing.assert_array_equal(control.coefficients(np.ones(8), np.full(8, 2.0)), 1.0)
    np.testing.assert_array_equal(control.coefficients(np.ones(8), np.zeros(8), 0.0), 0.0)


@pytest.mark.parametrize(
    ("estimator", "quantity", "least"),
    [
        ("local-fusion-graph", "claimed", 40),
        pytest.param("local-fusion-graph", "actual", 350, marks=pytest.mark.slow),
        ("naive", "claimed", 14),
        pytest.param("covariance-intersection", "actual", 14, marks=pytest.mark.slow),
    ],
)
def test_what_it_leaves_of_the_variance(estimator, quantity, least):
    """At equal runs, by the standard errors; that these are true is tested elsewhere."""
    asked = {"estimator": estimator, "quantity": quantity, "runs": 300}
    scenario = sf.load_scenario("thesis-transient")
    plain, found = (drawn(scenario, [0.25, 0.5, 0.75], control=c, **asked) for c in ("none", "optimum"))
    ratio = (plain.standard_error() / found.standard_error())[:, -1] ** 2
    assert ratio.min() > 0.7 * least  # the ratio of two estimates
    assert found.meta["control"]["kind"] == "exact optimum"
    assert found.meta["control"]["expected"] == "exact"
    assert found.meta["control"]["variance_reduction"] > least
    assert found.notes[0].startswith("control: exact optimum; variance 1/")
    assert plain.meta["control"] == {"kind": "none", "variance_reduction": 1.0, "expected": None}


def parts(sample, runs):
    """Samples of so many runs each that a large one consists of."""
    for first in range(0, sample.runs, runs):
        some = slice(first, first + runs)
        own = replace(sample.control, runs=sample.control.runs.map(lambda m, some=some: m[:, some]))
        yield replace(sample, sample=Sample(sample.sample.values, sample.sample.which[:, some]), control=own)


CASES = {
    "graph": (small(), [0.4], "local-fusion-graph"),
    "naive": (small(), [0.3], "naive"),
    "intersection": (small(), [0.5], "covariance-intersection"),
    "delay": (small({"agents": 2, "delay": [0.6, 0.4]}), [0.4], "local-fusion-graph"),
    "burst": (small({"agents": 2, "burst": BURST}), None, "local-fusion-graph"),
    "unlike": (small({"link": UNEQUAL}, agent=[{}, {"R": 400}, {"R": 25}]), None, "local-fusion-graph"),
    "matrices per step": (
        small(model={"F": [[[1]], [[1.2]], [[0.8]]], "H": 1, "Q": [[[25]], [[100]], [[5]]], "R": 100}),
        [0.5],
        "local-fusion-graph",
    ),
    "detections": (with_detection(small({"steps": 2}), [0.6] * 3), [0.5], "local-fusion-graph"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_it_is_unbiased_and_its_error_is_honest(case):
    """z-scores of 400 samples of 400 runs against the enumeration."""
    runs = 400
    scenario, link, estimator = CASES[case]
    exact = sf.predict(scenario, link, "general", "rms", estimator=estimator)
    found = drawn(
        scenario, link, quantity="rms", estimator=estimator, runs=400 * runs, shown=ShownPart(("claimed", "rms"))
    )
    everyone, trace = range(len(found.sampled.groups)), metric("trace", scenario.model)
    for quantity in ("claimed", "actual", "bias") + ("consistency", "rms") * (case == "graph"):
        wanted = exact.shown_as(quantity).values()
        each = [part.judged(trace, everyone, quantity) for part in parts(found.sampled, runs)]
        values, errors = (np.array(some) for some in zip(*each, strict=True))
        uncertain = errors.mean(axis=0) > 1e-8 * np.abs(wanted)
        np.testing.assert_allclose(values.mean(axis=0)[~uncertain], wanted[~uncertain], rtol=1e-7)
        z = (values - wanted)[:, uncertain] / errors[:, uncertain]
        assert (np.abs(z.mean(axis=0)) < 0.15 + 0.03).all()
        # 400 z-scores know their own deviation to 4 %, and how often they are small to 1.1 %
        assert (np.abs(z.std(axis=0) - 1.0) < 0.1 + 0.04).all()
        assert (np.abs((np.abs(z) < 1.96).mean(axis=0) - 0.95) < 0.02 + 0.015).all()


def test_two_levels(monkeypatch):
    """Where the optimum's expectation has to be estimated: against the exact answer, further runs told."""
    monkeypatch.setattr(control, "MOST_SETS", 1)
    scenario, link, _ = CASES["unlike"]
    exact = sf.predict(scenario, link, "general", "actual").values()
    found = drawn(scenario, link, quantity="actual", runs=150)
    assert found.meta["control"]["expected"] == "estimated"
    assert found.meta["control"]["variance_reduction"] > 5
    assert "of its own" in found.notes[0]
    assert (np.abs(found.values() - exact) < 4.5 * found.standard_error()).all()
    again = drawn(scenario, link, quantity="actual", runs=150, workers=2)
    np.testing.assert_allclose(again.values(), found.values(), rtol=1e-12)


def test_the_expectation_of_further_runs_is_corrected_by_the_numbers_heard(monkeypatch):
    """Against the chain, which takes so few; and how much less is left uncertain than of as many runs alone."""
    scenario = small({"agents": 5, "link": (0.8 * np.random.default_rng(1).random((5, 5))).tolist()})
    rows, how = link_rows(scenario), Settings(runs=100, estimator="local-fusion-graph")
    exact = control.expectation(scenario.system, rows)
    optimum = control.FollowedOptimum(scenario.system, rows, how)
    found = control.estimated(scenario.system, rows, how, 0.99, optimum)
    monkeypatch.setattr(control.FollowedOptimum, "heard", None)
    alone = control.estimated(scenario.system, rows, how, 0.99, control.FollowedOptimum(scenario.system, rows, how))
    for known, mean, blocks, plain in zip(exact.mean, found.mean, found.further, alone.further, strict=True):
        error, without = (each.std(axis=1, ddof=1) / np.sqrt(each.shape[1]) for each in (blocks, plain))
        bound = found.bound[0, :, None, None, None] * np.abs(known)
        assert (np.abs(mean - known) <= 4.5 * error + bound + 1e-12).all()
        assert np.median(without[:, 1:] ** 2 * alone.runs / (error[:, 1:] ** 2 * found.runs)) > 10


@pytest.mark.parametrize(("network", "link"), [({}, 0.2), ({"architecture": "cyclic"}, 0.9)])
def test_the_optimum_of_many_agents_is_corrected_by_the_numbers_heard(network, link):
    """z-scores of 60 samples against the chain, which takes like agents; what is left of the variance."""
    scenario = small({"agents": 13, "steps": 4, **network})
    exact = sf.predict(scenario, [link], "optimal").values()
    found = drawn(scenario, [link], estimator="optimal", runs=60 * 150)
    assert found.meta["control"]["kind"] == "numbers heard"
    assert found.meta["control"]["expected"] == "exact"
    assert found.meta["control"]["variance_reduction"] > 50
    trace, everyone = metric("trace", scenario.model), range(len(found.sampled.groups))
    each = [part.judged(trace, everyone, "claimed") for part in parts(found.sampled, 150)]
    values, errors = (np.array(some)[:, 0] for some in zip(*each, strict=True))
    np.testing.assert_allclose(values[:, 0], exact[0, 0], rtol=1e-12)  # step 1 is known
    z = (values - exact[0])[:, 1:] / errors[:, 1:]
    assert np.abs(z.mean(axis=0)).max() < 0.15 + 3 / np.sqrt(60)
    assert np.abs(z.std(axis=0) - 1.0).max() < 0.1 + 3 / np.sqrt(120)


def test_what_hardly_ever_happens():
    """µ = 0.999: of 100 runs all met one value somewhere; a plain sample says so, a control knows what it misses."""
    scenario = sf.load_scenario("thesis-transient", steps=3)
    exact = sf.predict(scenario, [0.999], "general").values()
    for seed in (1, 2, 3):
        plain, found = (drawn(scenario, [0.999], runs=100, seed=seed, control=c) for c in ("none", "optimum"))
        assert (plain.standard_error() > 0).all()
        assert (np.abs(plain.values() - exact) < 4 * plain.standard_error()).all()
        assert "outcomes of a probability of up to 0.03 together may be missing" in plain.notes[0]
        np.testing.assert_allclose(found.values(), exact, rtol=1e-8)
        assert (found.standard_error() > np.abs(found.values() - exact)).all()


def test_a_covariance_is_that_of_the_values_shown():
    """Entries are corrected one by one; matrices stay covariances, and metrics are theirs."""
    found = drawn(sf.load_scenario("cv-2d", steps=3), [0.5], runs=100)
    P = found.covariance
    np.testing.assert_allclose(P, np.swapaxes(P, -1, -2), rtol=1e-12)
    assert (np.linalg.eigvalsh(P) > 0).all()
    np.testing.assert_allclose(found.values("det"), np.linalg.det(P), rtol=1e-12)
    np.testing.assert_allclose(found.values("std:x"), np.sqrt(P[..., 0, 0]), rtol=1e-12)


@pytest.mark.parametrize(
    ("scenario", "estimator", "why"),
    [
        (small(noise={"correlation": 0.3}), "naive", "expected independent measurement noises"),
        (small(), "covariance-intersection", "takes away too little of the variance"),
    ],
)
def test_where_there_is_none_the_sample_is_plain(scenario, estimator, why):
    found, plain = (drawn(scenario, [0.5], estimator=estimator, runs=50, control=c) for c in ("optimum", "none"))
    np.testing.assert_array_equal(found.values(), plain.values())
    assert found.meta["control"]["kind"] == "none"
    if found.standard_error().any():
        assert why in found.notes[0]


def test_states_are_corrected_too():
    z = np.array([[[0.0]] * 3, [[5.0], [-14.0], [20.0]], [[25.0], [-4.0], [6.0]]])
    scenario = sf.load_scenario("thesis-transient", steps=3)
    exact = sf.expected_states(scenario, z, [0.5], "general").x
    plain, found = (sf.expected_states(scenario, z, [0.5], "monte-carlo", control=c) for c in ("none", "optimum"))
    assert (np.abs(found.x - exact) <= 4.5 * found.standard_error + 1e-12).all()
    np.testing.assert_array_equal(found.deviation, plain.deviation)
    assert (found.standard_error <= 1.02 * plain.standard_error).all()
    assert found.standard_error.sum() < 0.95 * plain.standard_error.sum()


def test_the_same_arrivals_for_more_agents_than_words_have_bits():
    """Step 1 by hand from the very draws that other estimators are given: P(k0) over the number of arrivals."""
    scenario = sf.load_scenario("thesis-transient", agents=70, steps=1)
    links = link_rows(scenario, [0.1])
    found = sample_optimum(scenario.system, links, 5, 3, first=2)
    happens = events(scenario.network, links, 1)
    (fates,), _ = draw_fates(stream(3, 0, 2), [happens], [[]], (5, 70))
    heard = np.ones((5, 70))
    for event, fate in zip(happens, fates.T, strict=True):
        heard[:, event.receivers[0]] += fate
    np.testing.assert_allclose(found.P[0, :, 0, :, 0, 0], 100 / heard, rtol=1e-12)


def test_what_is_shown_does_not_depend_on_the_number_of_processes():
    scenario = sf.load_scenario("thesis-transient", steps=2)
    shown = ShownPart(metrics=(metric("rms:x", scenario.model),))
    one, two = (drawn(scenario, [0.3, 0.7], runs=600, workers=w, shown=shown).values("rms:x") for w in (1, 2))
    np.testing.assert_allclose(two, one, rtol=1e-12)


def test_a_control_is_asked_for_by_name():
    with pytest.raises(sf.UsageError, match="control: expected one of optimum, none, got 'antithetic'"):
        drawn(small(), [0.5], control="antithetic")
    with pytest.raises(sf.UsageError, match="control: expected method monte-carlo, whose values are sampled, got gen"):
        sf.predict(small(), [0.5], "general", control="none")


@pytest.mark.parametrize("seed", [1, 3])
def test_a_correction_that_no_run_speaks_for_is_no_certainty(seed):
    # agent 1 takes nothing from agent 2, whose estimate is worse; only the optimum differs, in outcomes not met here
    source = {
        "model": {"F": 1, "H": 1, "Q": 1, "R": 1},
        "initial": {"P": 50},
        "network": {"agents": 2, "steps": 4, "link": [0.5, 0.9, 0.9, 0.7]},
        "agent": [{}, {"sensor": False}],
    }
    asked = {"estimator": "covariance-intersection"}
    drawn = sf.predict(source, method="monte-carlo", runs=300, seed=seed, **asked)
    exact = sf.predict(source, method="general", **asked).values(agent=1)
    off = np.abs(drawn.values(agent=1) - exact)
    assert (off > 1e-6 * exact).any()
    assert (off <= 1.01 * drawn.standard_error(agent=1) + 1e-9 * exact).all()
