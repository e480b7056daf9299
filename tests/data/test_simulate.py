"""Simulated records: what is drawn is what the prediction is about, and what is written is what is read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import chi2, kstest

import stochfuse as sf
from stochfuse.data.run import Way, stages
from stochfuse.data.simulate import Draws
from stochfuse.engines.replay import moments_given
from stochfuse.scenario import capabilities
from stochfuse.scenario.registry import ESTIMATORS, GENERAL
from stochfuse.scenario.scenario import link_rows
from tests.cli.command import run as command
from tests.oracles.featured import source as featured

FEATURES = [f.name for f in capabilities.FEATURES if f.name not in ("many-agents", "cases", "own-filters")]


def draws(scenario, runs, seed=1, link=None):
    return Draws(scenario, tuple(map(str, range(runs))), link_rows(scenario, link), seed)


def worst_z(scenario, name, runs):
    """Largest of (mean squared error − what is expected given the arrivals) over its standard error, entrywise."""
    (batch,) = draws(scenario, runs).batches()
    expected = moments_given(scenario.system, name, batch.arrivals).square
    worst = 0.0
    for stage in stages(draws(scenario, runs), batch, batch.arrivals, name, "det"):
        for i, estimate in enumerate(stage.estimates):
            error = estimate.x[..., 0] - batch.truth[:, stage.step - 1, i]
            off = error**2 - np.diagonal(expected[:, stage.step - 1, i], axis1=-2, axis2=-1)
            deviation = off.std(axis=0, ddof=1)
            z = np.abs(off.mean(axis=0)) / np.where(deviation > 1e-12, deviation / np.sqrt(runs), np.inf)
            worst = max(worst, float(z.max()))
    return worst


def of_feature(name, feature):
    s = sf.load_scenario(featured([feature]))
    try:
        capabilities.require(s.system, link_rows(s), name, GENERAL)
    except sf.UsageError:
        pytest.skip("refused by the table")
    return s


PAIRS = [(name, feature) for f, feature in enumerate(FEATURES) for e, name in enumerate(ESTIMATORS) if (e + f) % 6 == 0]


@pytest.mark.parametrize(("name", "feature"), PAIRS)
def test_errors_are_what_is_expected_of_them(name, feature):
    assert worst_z(of_feature(name, feature), name, 400) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_errors_are_what_is_expected_of_them_for_each_estimator_and_feature(name, feature):
    assert worst_z(of_feature(name, feature), name, 2000) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_mean_square_of_2000_runs_is_the_actual_error(name):
    """`--quantity rms` of the thesis' scenario, agents and steps averaged, within four standard errors."""
    s = sf.load_scenario("thesis-steady", steps=4)
    (batch,) = draws(s, 2000, 3, [0.5]).batches()
    p = sf.predict(s, [0.5], estimator=name, quantity="rms")
    expected = p.moments.square[0, :, p.group_of].mean(axis=0)[:, 0, 0]
    squared = np.zeros((2000, 4))
    for stage in stages(draws(s, 2000, 3, [0.5]), batch, batch.arrivals, name, "det"):
        x = np.stack([estimate.x[:, 0, 0] for estimate in stage.estimates], axis=1)
        squared[:, stage.step - 1] = ((x - batch.truth[:, stage.step - 1, :, 0]) ** 2).mean(axis=1)
    sampled = 0.0 if p.sampled is None else p.standard_error("trace")[0]
    error = np.hypot(squared.std(axis=0, ddof=1) / np.sqrt(2000), sampled)
    assert (np.abs(squared.mean(axis=0) - expected) < 4.0 * error).all()


def test_nees_of_the_optimum_is_chi_squared():
    s = sf.load_scenario("cv-2d", steps=4)
    (batch,) = draws(s, 600, 5, [0.4]).batches()
    for stage in stages(draws(s, 600, 5, [0.4]), batch, batch.arrivals, "optimal", "det"):
        for i, estimate in enumerate(stage.estimates):
            e = estimate.x - batch.truth[:, stage.step - 1, i, :, None]
            nees = (e * np.linalg.solve(estimate.P, e)).sum(axis=(1, 2))
            assert kstest(nees, chi2(4).cdf).pvalue > 1e-4
        if stage.step > 1:
            nis = stage.nis.ravel()
            assert kstest(nis, chi2(int(stage.measured[0])).cdf).pvalue > 1e-4


@pytest.mark.slow
def test_nees_is_what_the_rules_consistency_predicts():
    """Of one state ε = (x̂ − x)²/P: naive fusion's average is E[actual given arrivals / claimed]."""
    s = sf.load_scenario("thesis-steady", steps=4)
    found = sf.simulate(s, 3000, link=0.5, estimator="naive", seed=2)
    (batch,) = draws(s, 3000, 2, [0.5]).batches()
    given = moments_given(s.system, "naive", batch.arrivals)
    expected = (given.square / given.P)[..., 0, 0].mean()
    nees = found.rows[0].nees
    error = (nees.high - nees.low) / 4.0 * nees.mean
    assert abs(nees.mean - expected) < 4.0 * error
    assert found.rows[0].verdict == "overconfident"


def test_a_linearised_prediction_carries_where_the_target_is_far():
    """Range and bearing of two radars: extended filters realise what is predicted, within a few per cent."""
    s = sf.load_scenario("two-radars", steps=12, p0=400.0)
    found = sf.simulate(s, 300, link=0.6, estimator="stand-alone", metric="rms:x,y")
    row = found.rows[0]
    assert row.predicted == pytest.approx(row.realised, rel=0.06)
    assert row.verdict == "consistent"


def test_seed_and_number_alone_decide_a_run():
    s = sf.load_scenario("thesis-steady", agents=2, steps=3)
    few, many = (next(draws(s, runs, 4, [0.5]).batches()) for runs in (7, 230))
    np.testing.assert_array_equal(few.truth, many.truth[:7])
    np.testing.assert_array_equal(few.z[1], many.z[1][:7])
    assert few.arrivals.heard == many.arrivals.heard[:7]
    other = next(draws(s, 7, 5, [0.5]).batches())
    assert (few.truth != other.truth).any()


SCENARIOS = {
    "named agents, delays and misses": {
        "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.1, 0], [0, 0.1]], "R": 1.0},
        "initial": {"P": [[4, 0], [0, 1]], "correlation": "shared"},
        "network": {"agents": 2, "steps": 4, "link": 0.6, "nodes": ["a", "b"], "delay": [0.7, 0.3]},
        "agent": [{"sensor": {"detection": 0.7}}, {"sensor": False}],
    },
    "own states": featured(["own-states"]),
    "two radars": {
        "model": {"kind": "constant-velocity", "axes": 2, "step": 1.0, "noise": 1.0,
                  "nominal": {"position": [0, 500], "velocity": [10, 0]}},
        "initial": {"P": [[100, 0, 0, 0], [0, 10, 0, 0], [0, 0, 100, 0], [0, 0, 0, 10]]},
        "network": {"agents": 2, "steps": 4, "link": 0.5},
        "agent": [{"position": [0, 0], "sensor": {"kind": "bearing", "sigma": 0.01, "period": 2}},
                  {"position": [300, 0], "sensor": {"kind": "range-bearing", "sigma": [5, 0.02]}}],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", SCENARIOS)
def test_run_on_simulated_files_gives_the_same_estimates(name, tmp_path):
    path, folder = tmp_path / "s.json", tmp_path / "made"
    path.write_text(json.dumps(SCENARIOS[name]))
    estimator = "split-ci" if name == "own states" else "local-fusion-graph"
    command("simulate", path, "--runs", 5, "--seed", 3, "--estimator", estimator, "-o", folder)
    files = {f"--{option}": folder / f"{option}.csv" for option in ("measurements", "arrivals", "truth")}
    again = command(
        "run",
        path,
        *(word for pair in files.items() for word in pair),
        "--estimator",
        estimator,
        "-o",
        tmp_path / "e.csv",
    )
    assert f"note: first estimates from {folder / 'initial.csv'}" in again.stderr
    assert (tmp_path / "e.csv").read_bytes() == (folder / "estimates.csv").read_bytes()


def test_a_simulated_run_in_which_nothing_was_measured_can_be_run(tmp_path):
    seldom = [{"sensor": {"detection": 0.3}}, {"sensor": False}]
    source = sf.load_scenario("thesis-steady", agents=2, steps=2).to_mapping() | {"agent": seldom}
    made = sf.simulate(source, 6, link=0.5, folder=tmp_path)
    measured, drawn = ((tmp_path / f"{name}.csv").read_text() for name in ("measurements", "initial"))
    assert measured.count("\n") < 1 + 6 < drawn.count("\n")
    files = [tmp_path / f"{name}.csv" for name in ("measurements", "arrivals", "truth")]
    again = sf.run(source, *files, initial=tmp_path / "initial.csv", predicted=False)
    assert [row.realised for row in again.rows] == pytest.approx([row.realised for row in made.rows], rel=1e-12)
    with pytest.raises(sf.UsageError, match="expected the same runs in all files"):
        sf.run(source, *files, predicted=False)


def test_a_folder_with_such_files_is_not_written_over(tmp_path):
    s = sf.load_scenario("thesis-steady", agents=2, steps=2)
    sf.simulate(s, 2, link=0.5, folder=tmp_path)
    before = (tmp_path / "truth.csv").read_text()
    with pytest.raises(sf.UsageError, match=r"expected a folder without measurements\.csv, .*; force replaces them"):
        sf.simulate(s, 2, link=0.5, folder=tmp_path, seed=2)
    assert (tmp_path / "truth.csv").read_text() == before
    sf.simulate(s, 2, link=0.5, folder=tmp_path, seed=2, force=True)
    assert (tmp_path / "truth.csv").read_text() != before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_what_only_a_filter_of_its_own_knows_is_wrong_at_first_as_it_claims():
    """A parallel filter's slip and offset: the estimate begins at 0, the truth about it."""
    source = {
        key: value for key, value in sf.load_scenario("parallel-filters").to_mapping().items() if key != "network"
    }
    source["network"] = {"agents": 3, "steps": 8, "hears": [[2, 3], [], []], "link": 0.5}
    assert worst_z(sf.load_scenario(source), "joint-blender", 800) < 4.5


def test_a_case_of_the_scenario_is_simulated_by_its_name(tmp_path):
    lost = "fault: filter 2 lost from step 7"
    found = sf.simulate("parallel-filters", 3, link=lost, estimator="blender")
    assert found.heard[:, 0, 1].tolist() == [True] * 6 + [False] * 6
    words = (
        "simulate",
        "parallel-filters",
        "--runs",
        "3",
        "--estimator",
        "blender",
        "--format",
        "json",
        "--case",
        lost,
    )
    assert json.loads(command(*words).stdout)["rows"][0]["realised"] == found.rows[0].realised
    assert "--case: expected no --link beside it" in command(*words, "--link", "0.5", code=2).stderr
    with pytest.raises(sf.UsageError, match="or --case with one of filter 1 alone, outputs arrive half the time"):
        sf.simulate("parallel-filters")
    with pytest.raises(sf.UsageError, match=r"case: expected one of filter 1 alone, .*, got 'fault'"):
        sf.simulate("parallel-filters", link="fault")
    with pytest.raises(
        sf.UsageError, match=r"case: expected a scenario with \[\[network.case\]\], got none with a case"
    ):
        sf.simulate("thesis-steady", link="fault")


def test_what_cannot_be_simulated_is_said():
    with pytest.raises(sf.UsageError, match="link: expected one link probability to simulate, got 5; give --link"):
        sf.simulate("thesis-steady")
    with pytest.raises(sf.UsageError, match="runs: expected at least 1, got 0"):
        sf.simulate("thesis-steady", 0, link=0.5)
    with pytest.raises(sf.UsageError, match=r"estimator: expected one of .*, got 'naiv' \(did you mean 'naive'\?\)"):
        sf.simulate("thesis-steady", link=0.5, estimator="naiv")
    with pytest.raises(sf.UsageError, match=r"sead: no such setting \(did you mean 'seed'\?\)"):
        sf.simulate("thesis-steady", link=0.5, sead=3)
    with pytest.raises(
        sf.UsageError, match="simulate: expected filters that follow one true state, got parallel filters"
    ):
        sf.simulate(featured(["own-filters"]), estimator="blender")
    assert Way().estimators == ("local-fusion-graph",)
