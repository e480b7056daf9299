"""The crosscheck: finds planted errors, passes honest samples, and says where a file is malformed."""

from __future__ import annotations

import json

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.crosscheck import check_results
from stochfuse.data.results import ResultsError, read_results
from stochfuse.kalman.metrics import metric

LINKS = ["0", "0.25", "0.5", "0.75", "1"]
STEPS = 3


@pytest.fixture(scope="module")
def prediction():
    return sf.predict(sf.load_scenario(steps=STEPS), [float(µ) for µ in LINKS], method="general")


@pytest.fixture(scope="module")
def samples():
    """Claimed covariances (link, run, step, agent) of 30,000 honest runs."""
    s = sf.predict(
        sf.load_scenario(steps=STEPS), [float(µ) for µ in LINKS], method="monte-carlo", runs=30_000, workers=1
    )
    return s.sampled.sample.values.P[s.sampled.sample.which][..., 0, 0]


def results(P):
    """Arrays (link, run, step, agent) as results."""
    link, run, step, agent = (i.ravel() for i in np.indices(P.shape))
    return read_results(
        {"run": run, "agent": agent + 1, "step": step + 1, "link": np.array(LINKS)[link], "covariance": P.ravel()}
    )


def verdict(P, prediction, **kwargs):
    return check_results(results(P), prediction, metric("trace", prediction.scenario.model), **kwargs)


@pytest.mark.slow
def test_honest_samples_pass(samples, prediction):
    """30 samples of 1,000 runs: none may be called wrong (one in a hundred may; the level is one in a thousand)."""
    wrong = [not verdict(samples[:, i * 1000 : (i + 1) * 1000], prediction).agrees for i in range(30)]
    assert sum(wrong) == 0


@pytest.mark.slow
def test_a_large_honest_sample_passes(samples, prediction):
    assert verdict(samples[:, :20_000], prediction).agrees


@pytest.mark.parametrize("cell", [(1, 0), (2, 2), (3, 1), (0, 2), (4, 1)])
def test_two_per_cent_in_one_cell_are_found(samples, prediction, cell):
    P = samples[:, :20_000].copy()
    P[cell[0], :, cell[1]] *= 1.02
    found = verdict(P, prediction)
    assert not found.agrees
    assert [(LINKS.index(c.link), c.step - 1) for c in found.cells if not c.agrees] == [cell]


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"q": 25 * 1.02}, {"r": 98.0}, {"p0": 102.0}])
def test_two_per_cent_in_the_simulators_noise_are_found(prediction, change):
    wrong = sf.load_scenario(steps=STEPS, **change)
    s = sf.predict(wrong, [float(µ) for µ in LINKS], method="monte-carlo", runs=10_000, workers=1).sampled.sample
    assert not verdict(s.values.P[s.which][..., 0, 0], prediction).agrees


def test_a_small_error_everywhere_is_found_together(samples, prediction):
    """0.35 % in every cell that varies: too little for any single cell, not for all of them."""
    P = samples[:, :20_000].copy()
    P[1:4] *= 1.0035
    found = verdict(P, prediction)
    assert not found.agrees
    assert found.p_together < 1e-6


def test_rare_outcomes_that_were_not_seen_are_reckoned_with():
    """At µ = 0.999 ten runs see no loss: a sample without spread, and right all the same."""
    prediction = sf.predict(sf.load_scenario(steps=1), [0.999], method="general")
    flat = read_results({"run": range(10), "step": [1] * 10, "link": [0.999] * 10, "covariance": [100 / 3] * 10})
    assert check_results(flat, prediction, metric("trace", prediction.scenario.model)).agrees


def simulated(scenario, link, runs, seed, of=lambda P: np.trace(P, axis1=-2, axis2=-1)):
    """Honest results of one link probability, as columns."""
    s = sf.predict(scenario, [link], method="monte-carlo", runs=runs, seed=seed, workers=1).sampled.sample
    P = of(s.values.P)[s.which]
    _, run, step, agent = (i.ravel() for i in np.indices(P.shape))
    return {"run": run, "agent": agent + 1, "step": step + 1, "link": np.full(P.size, link), "covariance": P.ravel()}


def part(columns, first, last):
    """Results of some of the runs."""
    some = (columns["run"] >= first) & (columns["run"] < last)
    return read_results({name: column[some] for name, column in columns.items()})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("architecture", "agents", "link", "runs"),
    [("ad-hoc", 3, 0.98, 2), ("ad-hoc", 2, 0.98, 200), ("broadcast", 2, 0.02, 200), ("ad-hoc", 3, 0.005, 100), ("cyclic", 3, 0.99, 20)],
)  # fmt: skip
def test_few_runs_and_rare_outcomes_raise_no_false_alarm(architecture, agents, link, runs):
    """120 honest samples far from normal; at the level 0.001 two alarms have a probability of 0.7 %."""
    scenario = sf.load_scenario(architecture=architecture, agents=agents, steps=3)
    prediction = sf.predict(scenario, [link], method="general")
    m = metric("trace", scenario.model)
    every = simulated(scenario, link, 120 * runs, 1)
    wrong = [not check_results(part(every, i * runs, (i + 1) * runs), prediction, m).agrees for i in range(120)]
    assert sum(wrong) <= 1


@pytest.mark.parametrize("name", ["std:x", "det"])
def test_metrics_that_are_not_linear(name):
    """The mean of a metric over the outcomes is not the metric of the mean."""
    scenario = sf.load_scenario(steps=3)
    m = metric(name, scenario.model)
    results = read_results(simulated(scenario, 0.5, 5000, 4, m.of))
    assert check_results(results, sf.predict(scenario, [0.5], method="general"), m).agrees


def test_rounded_files_of_any_spread_pass(tmp_path):
    scenario = sf.load_scenario(steps=3)
    prediction, m = sf.predict(scenario, [0.98], method="general"), metric("trace", scenario.model)
    honest = read_results(simulated(scenario, 0.98, 5000, 5))
    for digits in (0, 1, 2):
        rows = zip(honest.run, honest.agent, honest.step, honest.observed[0].values, strict=True)
        text = "run,agent,step,link,covariance\n" + "".join(f"{r},{a},{k},0.98,{P:.{digits}f}\n" for r, a, k, P in rows)
        (tmp_path / "r.csv").write_text(text)
        assert check_results(read_results(tmp_path / "r.csv"), prediction, m).agrees


def test_means(samples, prediction, tmp_path):
    P = samples[:, :5000].mean(axis=1)
    rows = [
        {"link": float(µ), "step": k + 1, "agent": a + 1, "covariance": P[i, k, a], "count": 5000}
        for i, µ in enumerate(LINKS) for k in range(STEPS) for a in range(3)
    ]  # fmt: skip
    (tmp_path / "means.json").write_text(json.dumps(rows))
    m = metric("trace", prediction.scenario.model)
    assert check_results(read_results(tmp_path / "means.json"), prediction, m).agrees
    rows[20]["covariance"] *= 1.05
    (tmp_path / "means.json").write_text(json.dumps({key: [row[key] for row in rows] for key in rows[0]}))
    found = check_results(read_results(tmp_path / "means.json"), prediction, m)
    assert not found.agrees
    assert [cell.agrees for cell in found.cells].count(False) == 1


def test_digits_of_the_file_are_no_error(tmp_path):
    prediction = sf.predict(sf.load_scenario(steps=2), [1.0], method="general")
    m = metric("trace", prediction.scenario.model)
    text = "run,step,link,covariance\n" + "".join(f"{r},1,1,33.33\n{r},2,1,{{}}\n" for r in range(5))
    (tmp_path / "r.csv").write_text(text.format(*["21.21"] * 5))
    assert check_results(read_results(tmp_path / "r.csv"), prediction, m).agrees
    (tmp_path / "r.csv").write_text(text.format(*["21.30"] * 5))
    assert not check_results(read_results(tmp_path / "r.csv"), prediction, m).agrees


def test_errors_are_reported_as_consistency(tmp_path):
    prediction = sf.predict(sf.load_scenario(steps=1), [0.0], method="general")
    (tmp_path / "r.csv").write_text("run,step,link,covariance,error\n1,1,0,100,10\n2,1,0,100,\n3,1,0,100,-10\n")
    found = check_results(read_results(tmp_path / "r.csv"), prediction, metric("trace", prediction.scenario.model))
    assert found.consistency == {"0": pytest.approx(1.0)}


HEAD = "run,agent,step,link,covariance\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty; expected columns run, agent, step, link, covariance, error"),
        (HEAD, "no rows under the headings"),
        (HEAD + "1,1,1,0.5,abc\n", r"line 2, column 'covariance': expected a number of at least 0, got 'abc'"),
        (HEAD + "1,1,1.5,0.5,3\n", r"line 2, column 'step': expected a whole number of at least 1, got '1.5'"),
        (HEAD + "1,0,1,0.5,3\n", r"line 2, column 'agent': expected a whole number of at least 1, got '0'"),
        (HEAD + "1,1,1,0.5\n", "line 2: expected 5 cells, got 4"),
        (HEAD + "1,1,1,0.5,3\n\n1,1,1,0.5,4\n", "line 4: expected one row for each run, agent, step and link, got one that line 2 has too"),
        ("run,step,covariance,colour\n1,1,3,red\n", "unknown column 'colour'"),
        ("run,run,step,covariance\n1,1,1,3\n", "a column is named twice"),
        ("step,covariance\n1,3\n", "column 'run' is missing from step, covariance"),
        ("step,covariance,count\n1,3,1\n", "line 2, column 'count': expected a whole number of at least 2, got '1'"),
        ("[{\"run\": 1, \"step\": 1, \"covariance\": true}]", "record 1, column 'covariance': expected a number of at least 0, got True"),
        ("[{\"run\": 1, \"step\": 1, \"covariance\": 1}, {\"run\": 1}]", "record 2: expected keys run, step, covariance, got run"),
        ("[7]", "record 1: expected an object, got 7"),
        ("{\"run\": [1], \"step\": [1, 2]}", "expected lists of one length"),
        ("{\"run\": ", "not valid JSON"),
    ],
)  # fmt: skip
def test_malformed_files(text, message, tmp_path):
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(ResultsError, match=message):
        read_results(tmp_path / "r.csv")


def test_results_that_do_not_fit(prediction, tmp_path):
    m = metric("trace", prediction.scenario.model)
    (tmp_path / "r.csv").write_text(HEAD + "1,9,1,0,100\n2,9,1,0,100\n")
    with pytest.raises(ResultsError, match=r"line 2, column 'agent': expected 1 to 3, got 9"):
        check_results(read_results(tmp_path / "r.csv"), prediction, m)
    (tmp_path / "r.csv").write_text(HEAD + "1,1,1,0,100\n")
    with pytest.raises(ResultsError, match="link 0, step 1: expected at least 2 runs, got 1"):
        check_results(read_results(tmp_path / "r.csv"), prediction, m)
    (tmp_path / "r.csv").write_text("step,link,covariance,count\n1,0,100,50\n")
    simplified = sf.predict(sf.load_scenario(steps=STEPS), [0.0])
    with pytest.raises(ResultsError, match=r"line 2, column 'std': expected a number, since method simplified"):
        check_results(read_results(tmp_path / "r.csv"), simplified, m)
    with pytest.raises(sf.UsageError, match="alpha: expected a probability between 0 and 1, got 2"):
        check_results(read_results(tmp_path / "r.csv"), prediction, m, alpha=2)
