"""--over on predict, compare, messages and solve, as a user meets it."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.report.predictions import PredictionView
from stochfuse.report.rows import ResultRows
from tests.cli.command import run, strict_json

THREE = ("--link", "0.5", "--steps", "3")


def by_hand(key, value, link=0.5, steps=3, **asked):
    mapping = sf.load_scenario("thesis-transient", steps=steps).to_mapping()
    table, name = key.split(".")
    mapping[table][name] = value
    return sf.predict(mapping, [link], **asked).values()[0]


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_the_table_names_the_key_with_its_unit_and_the_link():
    text = run("predict", "--over", "network.delay=0:2:1", *THREE, "--method", "general").stdout
    assert "thesis-transient: 3 agents, ad-hoc, delays; every agent alike; µ = 0.5\n" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["network.delay", "[steps]", "k=1", "k=2", "k=3"] in lines
    shown = next(line for line in lines if line[:1] == ["2"])
    np.testing.assert_allclose(
        [float(cell) for cell in shown[1:]], by_hand("network.delay", 2, method="general"), rtol=1e-4
    )


def test_json_has_a_row_per_value():
    found = strict_json(run("predict", "--over", "model.R=50:100:25", *THREE, "--format", "json").stdout)
    assert found["schema"] == "stochfuse.prediction/1"
    assert found["over"] == [{"key": "model.R", "unit": None, "values": [50, 75, 100]}]
    assert found["points"] == [[50], [75], [100]]
    assert found["link"] == [0.5, 0.5, 0.5]
    assert found["steps"] == [1, 2, 3]
    for row, r in zip(found["values"], (50, 75, 100), strict=True):
        np.testing.assert_allclose(row, by_hand("model.R", r), rtol=1e-12)


def test_json_of_two_keys_of_several_links_and_of_steps_that_differ():
    found = strict_json(
        run("predict", "--over", "network.steps=1,3", "--over", "model.Q=-0,2.5", "--link", "0.2,0.5", "--format",
            "json", "--method", "monte-carlo", "--runs", "10").stdout
    )  # fmt: skip
    assert [entry["key"] for entry in found["over"]] == ["network.steps", "model.Q"]
    assert found["points"] == [[k, q] for k in (1, 3) for q in (0, 2.5) for _ in range(2)]
    assert found["link"] == [0.2, 0.5] * 4
    assert [row.count(None) for row in found["values"]] == [2] * 4 + [0] * 4
    assert [row.count(None) for row in found["standard_error"]] == [2] * 4 + [0] * 4


def test_csv_names_the_key_in_its_header():
    text = run("predict", "--over", "network.delay=0,1", *THREE, "--method", "general", "--format", "csv").stdout
    assert text.splitlines()[0] == (
        "method,quantity,stage,nature,metric,unit,agent,network.delay [steps],case,link,step,value"
    )
    values = [float(row["value"]) for row in rows_of(text) if row["network.delay [steps]"] == "1"]
    np.testing.assert_allclose(values, by_hand("network.delay", 1, method="general"), rtol=1e-12)
    text = run("predict", "--over", "network.steps=1,3", "--link", "0.5", "--format", "csv").stdout
    assert [(row["network.steps"], row["step"]) for row in rows_of(text)] == [("1", "1"), *(("3", k) for k in "123")]


def test_quantities_side_by_side_statistics_and_normalised():
    text = run(
        "predict", "--over", "model.R=50,100", *THREE, "--method", "naive", "--quantity", "claimed,actual"
    ).stdout
    assert " model.R   k   claimed   actual\n" in text
    done = run(
        "predict", "--over", "model.R=50,100", *THREE, "--method", "general", "--statistic", "std", "--format", "json"
    )
    alone = run("predict", "--r", "50", *THREE, "--method", "general", "--statistic", "std", "--format", "json")
    np.testing.assert_allclose(
        strict_json(done.stdout)["values"][0], strict_json(alone.stdout)["values"][0], rtol=1e-12
    )
    found = strict_json(run("predict", "--over", "model.R=50,100", *THREE, "--normalise", "--format", "json").stdout)
    for row, r in zip(found["values"], (50, 100), strict=True):
        np.testing.assert_allclose(row, by_hand("model.R", r) / by_hand("model.R", r, link=0.0), rtol=1e-12)


def test_negative_numbers_and_steps_that_do_not_end_on_the_last():
    found = strict_json(
        run("predict", "--over", "initial.error=-0.5:1:0.4", *THREE, "--quantity", "bias", "--format", "json").stdout
    )
    assert found["over"][0]["values"] == [-0.5, -0.1, 0.3, 0.7, 1.0]
    np.testing.assert_allclose(found["values"][1], by_hand("initial.error", -0.1, quantity="bias"), rtol=1e-12)


def test_an_agent_that_only_some_values_have():
    run("predict", "--over", "network.agents=4,5", *THREE, "--agent", "4")
    done = run("predict", "--over", "network.agents=3,4", *THREE, "--agent", "4", code=2)
    assert done.stderr.startswith("error: network.agents=3: agent: expected mean, worst, best or a number from 1 to 3")


def test_compare_methods():
    found = strict_json(
        run("compare", "--over", "model.R=50,100", *THREE, "--methods", "simplified,optimal", "--format", "json").stdout
    )
    assert found["over"][0]["key"] == "model.R"
    for name in ("simplified", "optimal"):
        for row, r in zip(found["methods"][name]["values"], (50, 100), strict=True):
            np.testing.assert_allclose(row, by_hand("model.R", r, method=name), rtol=1e-9)
    text = run(
        "compare", "--over", "model.R=50,100", *THREE, "--methods", "simplified,optimal", "--format", "csv"
    ).stdout
    assert ",agent,model.R,case,link,step,value,difference," in text.splitlines()[0]
    assert " model.R   k   " in run("compare", "--over", "model.R=50", *THREE, "--methods", "simplified,optimal").stdout


def test_compare_estimators():
    words = (
        "compare",
        "--over",
        "network.agents=2,3",
        "--link",
        "0.5",
        "--steps",
        "2",
        "--estimator",
        "naive,split-ci",
    )
    found = strict_json(run(*words, "--format", "json").stdout)
    for name in ("naive", "split-ci"):
        for row, n in zip(found["estimators"][name]["quantities"]["actual"]["values"], (2, 3), strict=True):
            asked = {"method": "general", "estimator": name, "quantity": "actual"}
            np.testing.assert_allclose(row, by_hand("network.agents", n, steps=2, **asked), rtol=1e-12)
    assert " network.agents   estimator   " in run(*words).stdout
    header = run(*words, "--format", "csv").stdout.splitlines()[0]
    assert header.startswith("estimator,method,quantity,stage,nature,metric,unit,agent,network.agents,case,link,")


def test_messages():
    words = ("messages", "--over", "network.agents=2:4:1", *THREE)
    found = strict_json(run(*words, "--format", "json").stdout)
    assert found["points"] == [[2], [3], [4]]
    for n, mean in zip((2, 3, 4), found["rules"]["local-fusion-graph"]["mean"], strict=True):
        alone = sf.message_load(sf.load_scenario("thesis-transient", steps=3, agents=n), [0.5])
        assert mean == pytest.approx(alone.mean()[0], rel=1e-12)
    assert run(*words, "--format", "csv").stdout.startswith("rule,nature,agent,network.agents,case,link,from_step")
    assert " network.agents   LFG mean " in run(*words).stdout
    assert " rule    nodes   network.agents = 2   " in run(*words, "--cdf").stdout


def test_solve():
    words = ("solve", "--target", "30", "--over", "model.R=50:200", "--link", "0.5")
    found = strict_json(run(*words, "--format", "json").stdout)
    over = found["over"]
    assert (found["question"], over["key"], over["unit"], over["direction"], over["proof"]) == (
        "least-value", "model.R", None, "greatest", "monotone",
    )  # fmt: skip
    assert by_hand("model.R", over["value"], steps=5)[-1] == pytest.approx(30, rel=1e-12)
    assert by_hand("model.R", over["value"] * (1 + 1e-9), steps=5)[-1] > 30
    assert "Greatest model.R: 122.799112186, at and below which claimed variance of x" in run(*words).stdout
    delay = run(
        "solve", "--target", "36", "--over", "network.delay=0:2", *THREE, "--method", "general", "--format", "csv"
    )
    assert rows_of(delay.stdout)[0]["network.delay [steps]"] == "2"
    done = run("solve", "--target", "1", "--over", "model.R=50:200", "--link", "0.5", code=3)
    assert "at best, at model.R = 50; expected a target of at least that, got 1" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("predict --over network.dely=1", "got 'network.dely' (did you mean 'network.delay'?)"),
        ("predict --over model.Q", "--over: expected KEY=SPEC such as network.delay=0:3:1"),
        ("predict --over =1", "--over: expected KEY=SPEC such as"),
        ("predict --over model.Q=a", "--over model.Q: expected 0.5, 0.2,0.5 or 0:1:0.25, got 'a'"),
        ("predict --over model.Q=1:2", "--over model.Q: expected 0.5, 0.2,0.5 or 0:1:0.25, got '1:2'"),
        ("predict --over model.Q=3:1:1", "--over model.Q: expected first:last:step with first ≤ last and step > 0"),
        ("predict --over model.Q=1,inf", "--over model.Q: expected finite numbers, got '1,inf'"),
        ("predict --over model.Q=0:inf:1", "--over model.Q: expected first:last:step with first ≤ last"),
        ("predict --over model.Q=0:1:1e-9", "--over model.Q: expected at most 1000000 values, got 1e+09"),
        ("predict --over model.Q=1 --over model.Q=2", "--over: expected different keys, got model.Q twice"),
        ("predict --over a=1 --over b=2 --over c=3", "--over: expected it once or twice, got it 3 times"),
        ("predict --over network.link=0.5 --link 0.5", "--over network.link: expected without --link"),
        ("predict --over network.agents=2 --agents 3", "--over network.agents: expected without --agents"),
        ("messages --over model.Q=2 --q 3", "--over model.Q: expected without --q"),
        ("predict --over network.link=0.1,2", "network.link=2:\n  network.link: expected probabilities between 0 and 1"),
        ("compare --over model.R=0", "model.R=0:\n  model.R: expected a symmetric positive definite matrix"),
        ("predict --over network.architecture=1", "network.architecture: expected one of \"ad-hoc\", \"broadcast\""),
        ("predict --over model.states=1", "model.states: expected a list, got 1"),
        ("predict --over network=1", "network: expected a table, got 1"),
        ("predict --over agent[2].R=1", "agent[2].R: expected a key of the scenario such as"),
        ("predict --over network.agents=2.5", "network.agents: expected a whole number, got 2.5"),
        ("predict --over network.delay=0:3:1", "network.delay=1: method simplified: it is derived without delay"),
        ("messages --over network.delay=0,1", "network.delay=1: network.delay: expected none for message loads"),
        ("predict --over network.link=0.5 --normalise", "--normalise: expected without --over network.link"),
        ("solve --over model.R=1:2", "--over: expected --target X or --critical with it, got no --target"),
        ("solve --gain --over model.R=1:2", "--over: expected --target X or --critical with it, got --gain"),
        ("solve --target 3 --over model.R=1:2 --over model.Q=1:2", "--over: expected it once with --target, got it 2"),
        ("solve --target 3 --over model.R=2:1", "--over model.R: expected LO:HI with LO < HI, got '2:1'"),
        ("solve --target 3 --over model.R=1:2:3", "--over: expected KEY=LO:HI such as model.R=50:200"),
        ("solve --target 3 --over model.R=1:2 --r 3", "--over model.R: expected without --r"),
        ("solve --target 3 --over model.R=1:2", "expected one link probability, since the scenario has 5 rows of links"),
    ],
)  # fmt: skip
def test_wrong_use_is_one_message(words, message):
    done = run(*words.split(), code=2)
    assert done.stdout == ""
    assert message in done.stderr
    assert done.stderr.startswith("error: ")


def test_figures_run_along_the_key():
    swept = sf.predict("thesis-transient", [0.5], over={"network.agents": [2, 3, 5]})
    curves = ResultRows(swept).curves(swept.steps)
    assert curves.label == "network.agents"
    assert curves.whole
    assert curves.names == [f"k = {k}" for k in range(1, 6)]
    axes = swept.plot().axes[0]
    assert axes.get_xlabel() == "network.agents"
    line = axes.lines[-1]
    assert line.get_xdata().tolist() == [2, 3, 5]
    np.testing.assert_allclose(line.get_ydata(), swept.values()[:, -1])
    assert sf.predict("thesis-transient", over={"network.delay": [0, 1]}, method="optimal").plot().axes[
        0
    ].get_xlabel() == ("network.delay [steps]")


def test_a_second_key_or_link_makes_a_curve_each_at_the_last_step():
    swept = sf.predict("thesis-transient", [0.2, 0.5], over={"model.R": [50, 100], "network.steps": [2, 3]})
    curves = ResultRows(swept).curves(swept.steps)
    assert curves.names == [
        f"network.steps = {k}, µ = {µ}" for k, µ in ((2, 0.2), (2, 0.5), (3, 0.2), (3, 0.5))
    ]  # fmt: skip
    assert curves.at == "after the last step"
    drawn = [line for line in swept.plot().axes[0].lines if len(line.get_xdata()) == 2]
    for line, pick in zip(drawn, curves.picks, strict=True):
        expected = [by_hand("model.R", r, link=µ, steps=k)[-1] for r in (50, 100) for k, µ in [_named(swept, pick)]]
        np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)


def _named(swept, pick):
    row = int(pick[0][0])
    return swept.over.points[swept.point[row]][1], float(swept.link[row])


@pytest.mark.parametrize(
    "words",
    [
        "predict --over model.R=50,100 --link 0.5 --quantity claimed,actual --method naive --steps 2",
        "predict --over model.R=50 --link 0.5",
        "predict --over model.R=50 --link 0.2,0.5",
        "compare --over model.R=50,100 --over model.Q=1,2 --link 0.5 --methods simplified,optimal --steps 2",
        "compare --over model.R=50,100 --over model.Q=1,2 --link 0.5 --estimator naive,split-ci --steps 2",
        "messages --over network.agents=2,3 --link 0.2,0.5 --steps 2",
        "messages --over network.agents=2 --link 0.5 --steps 2",
        "messages --over network.agents=2,3 --link 0.5 --steps 2 --accuracy",
        "messages --over network.agents=2,3 --link 0.5 --steps 2 --distribution",
        "solve --target 30 --over model.R=50:200 --link 0.5",
    ],
)
def test_every_figure_is_drawn(words, tmp_path):
    run(*words.split(), "--plot", tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_the_link_is_said_row_by_row_where_it_differs():
    from stochfuse.kalman.metrics import metric

    mapping = sf.load_scenario("thesis-transient", agents=2).to_mapping()
    mapping["network"]["link"] = [[0, 0.4], [0.6, 0]]
    swept = sf.predict(mapping, over={"network.link[1][2]": [0.2, 0.8]})
    assert ResultRows(swept).keys == ("network.link[1][2]", "mean µ")
    assert swept.link.tolist() == pytest.approx([0.4, 0.7])
    view = PredictionView(swept, metric("trace", swept.scenario.model))
    assert "; µ = " not in view.whom
