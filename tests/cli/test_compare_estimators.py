"""`stochfuse compare --estimator`: what each estimator claims beside what is true, and how it is shown."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import UsageError
from stochfuse.report.comparisons import EstimatorView, draw_estimators
from stochfuse.scenario.registry import CRITERIA, ESTIMATORS
from tests.cli.command import run, strict_json


def test_all_estimators_on_one_lossy_network():
    done = run("compare", "--estimator", "all", "--steps", "2", "--link", "0,0.5,1", "-f", "json")
    found = strict_json(done.stdout)
    assert found["schema"] == "stochfuse.estimators/1"
    assert tuple(found["estimators"]) == ESTIMATORS
    assert found["link"] == [0, 0.5, 1]
    assert found["steps"] == [1, 2]
    for name, estimator in found["estimators"].items():
        claimed, actual = (np.array(estimator["quantities"][q]["values"]) for q in ("claimed", "actual"))
        assert claimed.shape == actual.shape == (3, 2)
        assert estimator["nature"] == "exact"
        if name not in ("naive", "lwin", "local-fusion-graph"):
            assert (actual <= claimed * (1 + 1e-12)).all()
    assert "warning: naive: overconfident: the actual variance of x is up to 2.26 times" in done.stderr


def test_table_csv_and_python_agree():
    names = "naive,split-ci"
    command = ("compare", "--estimator", names, "--steps", "2", "--link", "0.5")
    found = sf.compare_estimators(sf.load_scenario(steps=2), [0.5], names.split(","))
    records = list(csv.DictReader(io.StringIO(run(*command, "-f", "csv").stdout)))
    for name, values in zip(found.estimators, found.values("actual"), strict=True):
        shown = [float(r["value"]) for r in records if r["estimator"] == name and r["quantity"] == "actual"]
        np.testing.assert_array_equal(shown, values[0])
    table = run(*command).stdout
    assert "after step 2, thesis-transient: 3 agents, ad-hoc; every agent alike" in table
    assert "exact: naive, split-ci" in table
    assert [line.split()[1] for line in table.splitlines() if line.startswith(" 0.5")] == ["naive", "split-ci"]
    every = run(*command, "--all-steps").stdout
    assert [line.split()[:3] for line in every.splitlines() if line.startswith(" 0.5")] == [
        ["0.5", k, name] for k in "12" for name in ("naive", "split-ci")
    ]


def test_what_is_too_much_to_enumerate_is_sampled_with_the_same_arrivals():
    s = sf.load_scenario("thesis-transient")
    found = sf.compare_estimators(s, [0.5], ["naive", "lwin", "blender"])
    assert [p.nature for p in found.predictions] == ["sampled", "sampled", "exact"]
    assert sf.compare_estimators(s, [0.5], ["blender"], runs=20).predictions[0].nature == "sampled"
    naive, lwin, _ = found.values("actual")
    np.testing.assert_allclose(naive, lwin, rtol=1e-9)
    exact = sf.compare_estimators(s.until(3), [0.5], ["naive"], "general")
    error = found.predictions[0].shown_as("actual").standard_error()[0, :3]
    assert (np.abs(naive[0, :3] - exact.values("actual")[0, 0]) < 4.5 * error).all()


def test_scenarios_for_other_estimators_are_compared_without_being_asked():
    done = run("compare", "parallel-filters", "--steps", "12")
    assert "fault: filter 2 lost from step 7" in done.stdout
    assert "blender" in done.stdout
    assert "left out: local-fusion-graph, naive, optimal" in done.stderr
    assert "got parallel filters ([[agent]] F, Q, P, M or s)" in done.stderr
    shown = run("predict", "parallel-filters").stdout
    assert "general formulation (49) of a tree of blenders; exact" in shown
    assert "; agent 1" in shown


def test_a_lost_filter_leaves_the_blend_of_the_others():
    s = sf.load_scenario("parallel-filters")
    lost = sf.predict(s).values("std:place", agent=1)[3]
    two = sf.predict(s, np.array([[[0, 0, 1], [0, 0, 0], [0, 0, 0.0]]])).values("std:place", agent=1)[0]
    np.testing.assert_allclose(lost[6:], two[6:], rtol=1e-12)
    assert (lost[:6] < two[:6]).any()


def test_criteria_of_an_intersection():
    s = sf.load_scenario("cooperative-pnt", steps=2)
    of = {
        c: sf.compare_estimators(
            s, [1.0], ["covariance-intersection", "stand-alone"], "monte-carlo", runs=2, criterion=c
        )
        for c in CRITERIA
    }
    traces = {c: found.values("claimed", "trace", agent=3)[0, 0, -1] for c, found in of.items()}
    largest = {c: found.values("claimed", "max-eig", agent=3)[0, 0, -1] for c, found in of.items()}
    assert traces["trace"] < traces["det"]
    assert largest["max-eig"] < largest["det"]


@pytest.mark.parametrize("against", ["link", "step"])
def test_figure(against):
    found = sf.compare_estimators(
        sf.load_scenario(steps=2), [0.0, 0.5, 1.0] if against == "link" else [0.5], ["naive", "split-ci"]
    )
    from stochfuse.kalman.metrics import metric

    figure = draw_estimators(EstimatorView(found, metric("trace", found.predictions[0].scenario.model)))
    values, ratio = figure.axes
    assert values.get_xlabel() == ratio.get_xlabel() == ("link probability µ" if against == "link" else "step k")
    assert ratio.get_ylabel() == "actual / claimed"
    claimed = found.values("claimed")[0]
    np.testing.assert_array_equal(values.lines[0].get_ydata(), claimed[:, -1] if against == "link" else claimed[0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimator", "naive,magic"], "estimator: expected one of local-fusion-graph, naive"),
        (["--estimator", "naive,naive"], "estimator: expected different ones, got naive, naive"),
        (["--estimator", "naive,split-ci", "--methods", "general,naive"], "--methods: expected one with several"),
        (["--estimator", "naive,split-ci", "--methods", "optimal"], "methods: expected one of general, monte-carlo"),
        (["--estimator", "naive,split-ci", "--reference", "naive"], "--reference: expected methods to compare"),
        (["--estimator", "naive,split-ci", "--relative"], "--relative: expected methods to compare"),
        (["--estimator", "naive,split-ci", "--quantity", "optimal"], "quantity: expected one of claimed"),
        (["--all-steps"], "--all-steps: expected several estimators"),
        (["--estimator", "split-ci", "--methods", "simplified"], "--estimator: expected method general or monte-carlo"),
        (["beacon-map", "--estimator", "naive,lwin"], "estimator naive: expected agents that track one state"),
        (["parallel-filters", "--estimator", "split-ci,blender"], "estimator split-ci: expected one model for all"),
        (["--estimator", "naive,blender", "--criterion", "trace"], "--criterion: expected estimator covariance-inter"),
        (["--criterion", "size"], "expected one of det, trace, max-eig, got 'size'"),
    ],
)
def test_wrong_use(arguments, message):
    assert message in " ".join(run("compare", *arguments, code=2).stderr.split())


def test_a_scenario_that_names_an_estimator_is_predicted_by_it(tmp_path):
    file = tmp_path / "mine.toml"
    text = run("scenario", "show", "thesis-transient").stdout.replace("steps = 5", "steps = 2")
    file.write_text(text + '\n[report]\nestimator = "split-ci"\n')
    assert "of split covariance intersection; exact" in run("predict", str(file)).stdout
    assert (
        "Monte Carlo of naive fusion"
        in run("predict", str(file), "--method", "monte-carlo", "--estimator", "naive", "--runs", "5").stdout
    )
    file.write_text(text + '\n[report]\nestimator = "split-ci"\nruns = 7\n')
    assert "sampled, 7 runs" in run("predict", str(file)).stdout
    file.write_text(text + '\n[report]\nestimator = "split-ci"\nmethod = "simplified"\n')
    message = 'report.estimator: expected report.method "general" or "monte-carlo", which average it, got "simplified"'
    assert message in run("predict", str(file), code=2).stderr


def test_no_two_curves_look_alike():
    found = sf.compare_estimators(sf.load_scenario(steps=1), [0.0, 1.0])
    from stochfuse.kalman.metrics import metric

    figure = draw_estimators(EstimatorView(found, metric("trace", found.predictions[0].scenario.model)))
    looks = [(line.get_color(), line.get_marker()) for line in figure.axes[1].lines[:-1]]
    assert len(set(looks)) == len(looks) == len(ESTIMATORS)


def test_message_load_is_of_agents_that_track_one_state():
    assert "message load: expected agents that track one state" in run("messages", "beacon-map", code=2).stderr


def test_methods_that_cannot_take_a_scenario_say_so():
    s = sf.load_scenario("cooperative-pnt")
    for method, who in (("simplified", "method simplified"), ("optimal", "the optimum")):
        with pytest.raises(UsageError, match=f"{who}: expected agents that track one state by one model"):
            sf.predict(s, [0.5], method)
    with pytest.raises(UsageError, match=r"the optimum: expected independent measurement noises, got \[noise\]"):
        sf.predict(sf.load_scenario("gps-ins"), [0.5], "optimal")
    with pytest.raises(UsageError, match="coefficients on noises, expected at most 20000"):
        sf.predict(sf.load_scenario("gps-ins"), [0.5], "monte-carlo", "actual", estimator="split-ci")
