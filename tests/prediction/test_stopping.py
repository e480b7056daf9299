"""Sampling to a precision: reached, honest, within a time, and refused where it means nothing."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.stats import chi2

import stochfuse as sf
from stochfuse.kalman.metrics import metric
from stochfuse.prediction import sampled, stopping
from stochfuse.prediction.method import ShownPart, seconds, share
from tests.cli.command import run, strict_json


@pytest.mark.parametrize(("runs", "excess"), [(50, 2.0), (400, 1.3), (400, 5.0), (10_000, 1.01)])
def test_a_stage_is_as_long_as_the_first_stage_may_have_been_lucky(runs, excess):
    wanted = runs * excess**2 / (chi2.ppf(0.025, runs - 1) / (runs - 1))
    assert stopping.stage(runs, excess) == pytest.approx(wanted, rel=2e-3)


def test_a_stage_is_not_endless():
    assert stopping.stage(400, 1e6) == stopping.stage(400, np.inf) == 16_000


@pytest.mark.parametrize("seed", range(20))
def test_runs_of_two_lengths_follow_fewest_steps(seed):
    """Against every way to follow some runs up to a step and the others to the end."""
    rng = np.random.default_rng(seed)
    wanted = rng.integers(5, 100, size=rng.integers(1, 9))
    found = stopping.lengths(wanted)
    ways = [np.where(np.arange(len(wanted)) < k, wanted.max(), wanted[k:].max()) for k in range(len(wanted))]
    enough = [way for way in ways if (way >= wanted).all()]
    assert any((found == way).all() for way in enough)
    assert found.sum() == min(way.sum() for way in enough)


def test_runs_that_only_early_steps_need_end_there(monkeypatch):
    """What varies most is what is brought forward for the first time: against a sample of another seed."""
    link = 0.55 * np.random.default_rng(2).random((8, 8)) * (1 - np.eye(8))
    model = {"F": 1, "H": 1, "Q": 25, "R": 100}
    network = {"agents": 8, "steps": 6, "link": link.tolist()}
    scenario = sf.Scenario.from_mapping({"model": model, "initial": {"P": 100}, "network": network})
    monkeypatch.setattr(sampled, "DEAR", 40 * 8**2)
    found = sf.predict(scenario, None, "monte-carlo", precision=0.002, seed=2)
    which = found.sampled.sample.which[0, :, :, 0]
    followed = (which >= 0).sum(axis=0)
    assert followed[0] == found.sampled.runs > followed[-1] >= 40
    assert (np.diff(followed) <= 0).all()
    assert f"({followed[-1]:,} of them to the last step)" in found.notes[0]
    # followed to a step is followed to those before
    assert (np.diff((which >= 0).astype(int), axis=1) <= 0).all()
    assert (found.standard_error() <= 0.002 * found.values()).all()
    plain = sf.predict(scenario, None, "monte-carlo", runs=800, seed=5)
    z = (found.values() - plain.values()) / np.hypot(found.standard_error(), plain.standard_error())
    assert np.abs(z).max() < 4.5


@pytest.mark.parametrize(("value", "found"), [("0.2%", 0.002), (0.002, 0.002), ("0.002", 0.002), (" 5 % ", 0.05)])
def test_a_share(value, found):
    assert share(value) == pytest.approx(found)


@pytest.mark.parametrize(("value", "found"), [(60, 60), ("60s", 60), ("2min", 120), ("0.5h", 1800)])
def test_a_time(value, found):
    assert seconds(value) == found


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"precision": 0}, "precision: expected a share between 0 and 1, such as 0.2% or 0.002, got '0'"),
        ({"precision": -0.1}, "precision: expected a share between 0 and 1, .* got '-0.1'"),
        ({"precision": "2 apples"}, "precision: expected a share between 0 and 1, .* got '2 apples'"),
        ({"precision": "nan"}, "precision: expected a share between 0 and 1, .* got 'nan'"),
        ({"precision": 0.1, "at_most": "soon"}, "at-most: expected a time such as 60s or 2min, got 'soon'"),
        ({"at_most": 60}, "at-most: expected a precision to go with it, got 60 alone"),
        ({"precision": 0.1, "runs": 10}, "runs: expected without precision, which says how many it takes, got 10"),
        ({"precision": 0.1, "method": "general"}, "precision: expected method monte-carlo, .*, got general"),
    ],
)
def test_what_is_no_precision(settings, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict(sf.load_scenario(), [0.5], **{"method": "monte-carlo", **settings})
    if "method" not in settings:
        with pytest.raises(sf.UsageError, match="precision: expected monte-carlo among the methods, got simplified"):
            sf.compare(sf.load_scenario(), [0.5], ["simplified", "optimal"], precision=0.1)


def test_every_error_shown_is_below_its_share():
    scenario = sf.load_scenario("thesis-transient", steps=3)
    asked = {"precision": "0.4%", "exact_first": False}
    agents = sf.Scenario.from_mapping(
        {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}, "agent": [{}, {"R": 400}]}
        | {"network": {"agents": 2, "steps": 3, "link": 0.5}}
    )
    for given, link, settings, agent in (
        (scenario, [0.2, 0.6], {"estimator": "naive", "quantity": "actual"}, "mean"),
        (agents, None, {"shown": ShownPart(metrics=(metric("std:x", agents.model),), agent=2)}, 2),
    ):
        for control in ("optimum", "none"):
            p = sf.predict(given, link, "monte-carlo", control=control, **{**asked, **settings})
            of = "std:x" if agent == 2 else "trace"
            reached = (p.standard_error(of, agent) / p.values(of, agent)).max()
            assert reached <= 0.004
            assert p.meta["precision"] == {"asked": 0.004, "reached": pytest.approx(reached)}
            assert p.meta["runs"] == p.sampled.runs
            assert p.notes[0].startswith(f"precision {100 * reached:.2g} % of each value after {p.sampled.runs:,} runs")
    # the more the control takes away, the fewer runs
    assert p.sampled.runs > 400


def test_the_same_seed_gives_the_same_answer():
    asked = {"estimator": "naive", "precision": 0.01, "exact_first": False, "control": "none"}
    one, two = (sf.predict("thesis-transient", [0.5], workers=w, seed=4, **asked) for w in (1, 2))
    assert one.sampled.runs == two.sampled.runs > 400
    np.testing.assert_allclose(one.values(), two.values(), rtol=1e-13)


def test_many_agents_begin_with_few_runs():
    """Far too many outcomes for an exact engine, and for a power of two of them in floating point."""
    scenario = sf.load_scenario("thesis-transient", agents=40, steps=2)
    found = sf.predict(scenario, [0.05], "monte-carlo", precision=0.05)
    assert found.nature == "sampled"
    assert found.sampled.runs == 25 < stopping.FIRST
    assert found.meta["precision"]["reached"] < 0.05


def test_an_exact_engine_is_used_where_that_is_easy():
    scenario = sf.load_scenario("thesis-transient", steps=2)
    found = sf.predict(scenario, [0.5], "monte-carlo", precision=0.001)
    assert (found.method, found.nature) == ("general", "exact")
    assert found.meta["precision"] == {"asked": 0.001, "reached": 0.0}
    assert found.notes[0] == "precision: nothing had to be drawn, method general takes this scenario: exact"
    np.testing.assert_array_equal(found.values(), sf.predict(scenario, [0.5], "general").values())
    chain = sf.predict(scenario, [0.5], precision=0.001, estimator="optimal")
    assert chain.method == "optimal"
    compared = sf.compare(scenario, [0.5], ["simplified", "monte-carlo"], precision=0.01)
    assert compared.predictions[1].meta["precision"]["reached"] < 0.01


def test_a_time_is_a_limit_and_says_what_was_reached():
    scenario = sf.load_scenario("thesis-transient", agents=5, steps=8)
    begun = time.monotonic()
    found = sf.predict(scenario, [0.5], precision=1e-5, at_most=1, control="none", estimator="naive")
    assert time.monotonic() - begun < 20  # on a machine that others load
    assert found.meta["precision"]["reached"] > 1e-5
    assert "0.001 % asked for: 1 s were over" in found.notes[0]


@pytest.mark.slow
def test_stopping_does_not_bias():
    """z-scores of 120 samples whose size was chosen by their first stage, without the control that would hide it."""
    scenario = sf.load_scenario("thesis-transient", steps=2)
    exact = sf.predict(scenario, [0.4], "naive").values()[0, -1]
    asked = {"estimator": "naive", "precision": 0.007, "exact_first": False, "control": "none"}
    found = [sf.predict(scenario, [0.4], seed=seed, **asked) for seed in range(120)]
    assert len({p.sampled.runs for p in found}) > 50
    z = np.array([(p.values() - exact)[0, -1] / p.standard_error()[0, -1] for p in found])
    assert abs(z.mean()) < 3.5 / np.sqrt(120)
    assert abs(z.std() - 1) < 3.5 / np.sqrt(240)
    assert (np.abs(z) < 1.96).mean() > 0.95 - 3.5 * np.sqrt(0.05 * 0.95 / 120)


def test_the_command_line():
    line = "predict --precision 0.5% --steps 4 --link 0.5 --estimator lwin --format json"
    found = strict_json(run(*line.split()).stdout)
    assert found["meta"]["precision"]["reached"] <= 0.005
    told = run(*["predict", "--agents", "5", "--steps", "2", "--link", "0.5", "--precision", "0.1%", "--at", "2"])
    assert "note: precision 0.0" in told.stderr
    assert "note: control: exact optimum; variance 1/" in told.stderr
    refused = run("predict", "--precision", "0.2%", "--method", "general", code=2)
    assert "--precision: expected method monte-carlo, got general" in refused.stderr
