"""Studies: what is asked, what is answered, what is written."""

from __future__ import annotations

import csv
import itertools
import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import stochfuse as sf
from stochfuse.scenario.over import put
from stochfuse.studies import evaluation
from stochfuse.studies.files import packed, unpacked
from stochfuse.studies.reading import load_study, plan_of

THREE = {"network.link": [0.0, 0.3, 1.0], "model.R": [1.0, 100.0], "network.agents": [2, 3]}


def asked(vary=THREE, **more):
    return {"scenario": "thesis-transient", "vary": vary, **more}


def run(tmp_path, mapping, name="result.csv", **settings):
    results = sf.study(mapping, tmp_path / name, **settings)
    with results.path.open(newline="") as file:
        return results, list(csv.DictReader(file))


def test_values_are_written_as_on_the_command_line(tmp_path):
    """`0:1:0.5`, both ends included, is the list of these numbers."""
    written, listed = (
        run(tmp_path, asked({"network.link": v, "model.R": [50, 100]}), f"{i}.csv")[1]
        for i, v in enumerate(("0:1:0.5", [0, 0.5, 1]))
    )
    assert written == listed
    assert len({row["point"] for row in written}) == 6


def expected(row, scenario="thesis-transient", quantity="claimed", metric="trace", **settings):
    """What `predict` says of a row of a result, made from the file's own columns."""
    keys = {"network.agents": "agents", "network.architecture": "architecture", "network.steps": "steps"}
    keys |= {"model.Q": "q", "model.R": "r", "initial.P": "p0"}
    numbers = {"agents": int, "steps": int, "architecture": str}
    overrides = {o: numbers.get(o, float)(row[k]) for k, o in keys.items() if row.get(k)}
    given = sf.load_scenario(scenario, uniform_link="network.link" in row, **overrides)
    link = [float(row["network.link"])] if "network.link" in row else None
    p = sf.predict(given, link, row["method"], quantity, **settings)
    return p.values(metric)[0, int(row["step"]) - 1]


@pytest.fixture
def sizes(monkeypatch):
    """Sizes of the batches that are predicted."""
    sizes, predict = [], evaluation.predict_items

    def spy(scenario, link, noises, *arguments, **settings):
        sizes.append(len(link))
        return predict(scenario, link, noises, *arguments, **settings)

    monkeypatch.setattr(evaluation, "predict_items", spy)
    return sizes


# what is asked


def test_a_grid_has_every_combination_the_last_key_fastest():
    plan = load_study(asked())
    codes = plan.codes(range(plan.size))
    got = list(zip(*(axis.shown(codes[axis.name]).tolist() for axis in plan.axes), strict=True))
    assert got == list(itertools.product(*THREE.values()))


def test_a_list_takes_the_values_side_by_side():
    plan = load_study(asked({"network.link": [0.1, 0.2, 0.3], "model.R": [1, 2, 3]}, design={"kind": "list"}))
    assert plan.size == 3
    assert {name: c.tolist() for name, c in plan.codes(range(3)).items()} == {
        "network.link": [0, 1, 2],
        "model.R": [0, 1, 2],
    }


def test_a_latin_hypercube_takes_one_value_of_each_part():
    vary = {
        "network.link": {"from": 0, "to": 1},
        "model.R": {"from": 1, "to": 1e4, "scale": "log"},
        "network.agents": {"from": 2, "to": 6, "whole": True},
        "method": ["simplified", "general"],
    }
    plan = load_study(asked(vary, design={"kind": "latin-hypercube", "points": 100, "seed": 3}))
    codes = plan.codes(range(100))
    assert sorted((codes["network.link"] * 100).astype(int)) == list(range(100))
    assert sorted((np.log10(codes["model.R"]) / 4 * 100).astype(int)) == list(range(100))
    assert np.bincount(codes["network.agents"])[2:].tolist() == [20] * 5
    assert np.bincount(codes["method"]).tolist() == [50, 50]
    parts = [plan.codes(range(first, first + 7))["model.R"] for first in range(0, 98, 7)]
    assert np.array_equal(np.concatenate(parts), codes["model.R"][:98])


def test_ranges_list_their_values():
    vary = {
        "network.link": {"from": 0, "to": 1, "number": 11},
        "model.R": {"from": 1, "to": 1e4, "number": 5, "scale": "log"},
        "network.agents": {"from": 2, "to": 6, "number": 3, "whole": True},
    }
    link, R, agents = load_study(asked(vary)).axes
    assert link.values == (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    assert R.values == (1.0, 10.0, 100.0, 1000.0, 10000.0)
    assert agents.values == (2, 4, 6)
    assert (link.kind, R.kind, agents.kind) == ("float", "float", "int")


def test_nested_tables_are_paths_too():
    plan = load_study(asked({"network": {"link": [0.5]}, "model": {"R": [1, 2]}}))
    assert [axis.name for axis in plan.axes] == ["network.link", "model.R"]


def test_a_worker_makes_the_same_plan_from_the_record():
    vary = {"network.link": {"from": 0, "to": 1}, "model.R": {"from": 1, "to": 2}}
    plan = load_study(asked(vary, design={"kind": "latin-hypercube", "points": 50}))
    again = plan_of(json.dumps(plan.record))
    for name, codes in plan.codes(range(50)).items():
        assert np.array_equal(codes, again.codes(range(50))[name])


def test_a_link_takes_the_place_of_cases_and_bursts():
    base = {"network": {"link": 0.1, "case": [], "burst": {"good_to_bad": 0.1, "bad_to_good": 0.3}}}
    assert put(base, {"network.link": 0.5}) == {"network": {"link": 0.5}}
    assert put(base, {"network.burst.bad_to_good": 0.5})["network"] == {
        "burst": {"good_to_bad": 0.1, "bad_to_good": 0.5}
    }


def test_a_scenario_file_is_looked_for_beside_the_study(tmp_path):
    (tmp_path / "mine.toml").write_text(
        "[model]\nF=1\nH=1\nQ=1\nR=1\n[initial]\nP=1\n[network]\nagents=2\nsteps=2\nlink=0.5\n"
    )
    (tmp_path / "study.toml").write_text('scenario = "mine.toml"\n[vary]\n"model.R" = [1, 2]\n')
    results = sf.study(tmp_path / "study.toml")
    assert results.path == tmp_path / "study.parquet"
    assert results.plan.scenario_name == "mine.toml"
    assert results.rows == 4


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, r"vary: expected a table of keys with their values, got nothing"),
        (asked({}), r"vary: expected at least one key with its values, got nothing"),
        (asked({"model.R": []}), r"vary\.model\.R: expected at least one value, got an empty list"),
        (asked({"model.R": 3}), r"vary\.model\.R: expected a list of values, '0:1:0.25', or .*, got 3"),
        (
            asked({"model.R": "1:0:0.1"}),
            r"vary\.model\.R: expected first:last:step with first ≤ last and step > 0, got",
        ),
        (asked({"model.S": [1]}), r"vary\.model\.S: expected a known key, got an unknown one, 'S'"),
        (asked({"modle.R": [1]}), r"vary\.modle\.R: expected a known key, got an unknown one"),
        (
            asked({"methods": ["simplified"]}),
            r"vary\.methods: expected a key of the scenario such as network\.link or agent\[2\]\.R .*, or one of",
        ),
        (asked({"method": ["simplest"]}), r"vary\.method: expected one of simplified, .*, got 'simplest'"),
        (asked({"network.link": {"from": 0, "to": 1}}), r"vary\.network\.link\.number: expected how many values"),
        (asked({"network.link": {"from": 1, "to": 0, "number": 2}}), r"link\.to: expected at least from, 1, got 0"),
        (asked({"model.R": {"from": 0, "to": 1, "number": 2, "scale": "log"}}), r"from: expected a number above 0 on"),
        (asked({"model.R": {"from": 0.5, "to": 2, "number": 2, "whole": True}}), r"from: expected a whole number"),
        (asked({"model.R": {"from": 1, "to": 2, "number": 2, "by": 1}}), r"model\.R\.by: expected a known key"),
        (asked({"model.R": {"from": float("nan"), "to": 1, "number": 2}}), r"from: expected a number of at most 1e"),
        (asked({"model.R": [1, 2], "model": {"R": [1]}}), r"vary\.model\.R: expected each key once, got it twice"),
        (asked({"network.link": [0, 1], "model.R": [1]}, design={"kind": "list"}), r"lists of the same length"),
        (asked(design={"kind": "latin-hypercube"}), r"design\.points: expected the number of points, got nothing"),
        (asked(design={"kind": "latin-hypercube", "points": 10**9}), r"design\.points: expected at most 6666666 for 3"),
        (asked(design={"points": 5}), r"design\.points: expected nothing for a grid, whose values say it, got 5"),
        (asked(design={"seed": 5}), r"design\.seed: expected nothing for a grid, got 5"),
        (asked({"model.R": [1]}), r"vary\.network\.link: expected link probabilities, since the scenario does not"),
        (asked({"model.R": [1], "agent[3].R": [1]}), r"vary\.agent\[3\]\.R: expected a key of the scenario"),
        (asked(scenario_file=1), r"scenario_file: expected a known key"),
        (asked(predict={"method": "general"}, vary={"method": ["naive"], "network.link": [0]}), r"since it is varied"),
        (asked(predict={"runs": 1}), r"predict\.runs: expected a whole number of at least 2, got 1"),
        (asked(report={"quantity": "truth"}), r"report\.quantity: expected one of claimed, .*messages, got 'truth'"),
        (asked(report={"quantity": ["claimed", "claimed"]}), r"report\.quantity: expected at least one, each once"),
        (asked(report={"quantity": "messages"}), r"expected a quantity of the error beside messages"),
        (asked(report={"metric": "var:y"}), r"report\.metric: expected a metric of this model, got metric 'var:y'"),
        ({**asked(), "scenario": "nowhere.toml"}, r"scenario: expected a scenario, got nowhere\.toml: no such file"),
        ({**asked(), "scenario": {"model": {}}}, r"model\.F: expected a value, got nothing"),
        ({**asked(), "schema": "stochfuse.study/2"}, r'schema: expected one of "stochfuse.study/1"'),
    ],
)
def test_what_does_not_fit_is_named(mapping, message):
    with pytest.raises(sf.ScenarioError, match=message):
        load_study(mapping)


def test_too_many_points_are_refused():
    many = {"from": 0, "to": 1, "number": 40_000}
    with pytest.raises(sf.ScenarioError, match=r"vary: expected at most 1000000000 points, got 1600000000"):
        load_study(asked({"network.link": many, "model.R": many}))


# what is answered


@pytest.mark.parametrize(
    ("scenario", "vary", "quantity", "metric", "settings"),
    [
        ("thesis-transient", THREE, "claimed", "trace", {}),
        ("thesis-transient", {**THREE, "method": ["general", "optimal", "naive"]}, "claimed", "trace", {}),
        ("thesis-transient", {**THREE, "method": ["general", "naive"]}, "consistency", "trace", {}),
        ("thesis-transient", THREE, "optimal", "trace", {}),
        ("cv-2d", {"network.link": [0.2, 0.9], "model.R": [4.0, 400.0], "model.Q": [0.1]}, "claimed", "rms:x,y", {}),
        ("cv-2d", {"network.link": [0.2, 0.9], "initial.P": [4.0, 400.0]}, "claimed", "det", {}),
        ("thesis-transient", {**THREE, "network.architecture": ["cyclic", "broadcast"]}, "claimed", "trace", {}),
        ("thesis-transient", {**THREE, "network.steps": [1, 4]}, "claimed", "trace", {}),
        ("thesis-transient", {"network.link": [0.0, 0.5]}, "claimed", "trace", {"method": "monte-carlo", "runs": 20}),
        ("thesis-transient", THREE, "actual", "trace", {}),
        (
            "thesis-transient",
            {"network.link": [0.5], "model.R": [4.0, 400.0]},
            "actual",
            "trace",
            {"method": "general", "estimator": "split-ci"},
        ),
    ],
)
def test_every_row_is_what_predict_says(tmp_path, scenario, vary, quantity, metric, settings):
    vary = {**vary, "network.steps": vary.get("network.steps", [3])}
    mapping = {"scenario": scenario, "vary": vary, "report": {"quantity": quantity, "metric": metric}}
    results, rows = run(tmp_path, {**mapping, "predict": settings})
    more = {k: v for k, v in settings.items() if k != "method"}
    assert results.failed == 0
    assert len(rows) == results.rows
    assert results.plan.size == np.prod([len(v) for v in vary.values()])
    for row in rows[:: max(1, len(rows) // 60)]:
        want = expected(row, scenario, quantity, metric, **more)
        assert float(row[f"{quantity}.{metric}"]) == pytest.approx(want, rel=1e-10)


def test_like_points_are_one_batch(sizes):
    values = {"from": 1, "to": 10, "number": 10}
    vary = {"model.Q": values, "network.agents": [2, 3], "network.link": [0.1, 0.5], "model.R": values}
    vary["network.steps"] = [3]
    for method in ("simplified", "general", "optimal"):
        plan = load_study(asked(vary, predict={"method": method}))
        evaluation.evaluate(plan, range(plan.size))
    assert sizes == [200, 200] * 3


def test_unlike_agents_and_matrices_are_answered_one_by_one(tmp_path):
    base = {
        "model": {"F": 1, "H": 1, "Q": 25, "R": 100},
        "initial": {"P": 100},
        "network": {"agents": 2, "steps": 3},
        "agent": [{"R": 50}, {}],
    }
    vary = {"network.link": [0.2, [[0, 0.3], [0.6, 0]]], "agent[1].R": [10, 1000], "model.R": [1, 100]}
    _, rows = run(tmp_path, {"scenario": base, "vary": vary, "report": {"agent": 1}})
    assert {row["network.link"] for row in rows} == {"0.2", "[[0, 0.3], [0.6, 0]]"}
    for row in rows:
        one = {**base, "network": {**base["network"], "link": json.loads(row["network.link"])}}
        one |= {"agent": [{"R": float(row["agent[1].R"])}, {}], "model": {**base["model"], "R": float(row["model.R"])}}
        want = sf.predict(sf.Scenario.from_mapping(one)).values("trace", 1)[0, int(row["step"]) - 1]
        assert float(row["claimed.trace"]) == pytest.approx(want, rel=1e-12)


def test_a_failing_point_is_recorded_and_does_not_stop_the_rest(tmp_path):
    vary = {"model.R": [100, 0, -1], "network.link": [0.5, 1.5], "network.agents": [3, 30], "network.steps": [2]}
    results, rows = run(tmp_path, asked(vary, predict={"method": "general"}))
    fine = [row for row in rows if not row["error"]]
    assert {(row["model.R"], row["network.link"], row["network.agents"]) for row in fine} == {("100", "0.5", "3")}
    assert len(fine) == 2
    failed = [row for row in rows if row["error"]]
    assert results.failed == len(failed) == 11
    assert all(row["step"] == row["claimed.trace"] == row["nature"] == "" for row in failed)
    reason = {(row["model.R"], row["network.link"], row["network.agents"]): row["error"] for row in failed}
    assert reason["0", "0.5", "3"].startswith("model.R: expected a symmetric positive definite matrix, got a variance")
    assert reason["100", "1.5", "3"].startswith("network.link: expected probabilities between 0 and 1, got 1.5")
    assert "outcomes, too many to go through: use --method" in reason["100", "0.5", "30"]
    assert reason["0", "1.5", "3"].count("expected") == 2
    assert results.first_errors[0][0] == int(failed[0]["point"])


def test_what_grows_beyond_floating_point_is_an_error_and_no_nan(tmp_path):
    base = {
        "model": {"F": 1e100, "H": 0, "Q": 1, "R": 1},
        "initial": {"P": 1},
        "network": {"agents": 2, "steps": 5},
    }
    results, rows = run(tmp_path, {"scenario": base, "vary": {"network.link": [0.5], "initial.P": [1e-300, 1e90]}})
    assert results.failed == 2
    assert "is not finite: it grows beyond floating point" in rows[0]["error"]


def test_the_message_load_is_that_of_messages(tmp_path):
    vary = {"network.link": [0.0, 0.4, 1.0], "method": ["simplified", "general", "naive"], "network.steps": [4]}
    _, rows = run(tmp_path, asked(vary, report={"quantity": ["claimed", "messages"]}))
    scenario = sf.load_scenario("thesis-transient", steps=4)
    for row in rows:
        rule = "local-fusion-graph" if row["method"] == "general" else "naive"
        k, load = int(row["step"]), sf.message_load(scenario, [float(row["network.link"])], rule)
        assert float(row["messages.nodes"]) == pytest.approx(load.between(k, k).mean("mean")[0], abs=1e-12)


def test_samples_have_standard_errors(tmp_path):
    vary = {"network.link": [0.5], "method": ["monte-carlo", "simplified"]}
    _, rows = run(tmp_path, asked(vary, predict={"runs": 50}))
    for row in rows:
        sampled = row["method"] == "monte-carlo"
        assert (row["nature"] == "sampled") == sampled == bool(row["claimed.trace.standard_error"])
    p = sf.predict(sf.load_scenario("thesis-transient"), [0.5], "monte-carlo", runs=50)
    assert float(rows[2]["claimed.trace.standard_error"]) == pytest.approx(p.standard_error("trace")[0, 2])


def test_answers_are_the_same_whatever_the_chunks():
    vary = {"network.link": {"from": 0, "to": 1}, "model.R": {"from": 1, "to": 1e4}, "network.agents": [2, 3, 40]}
    plan = load_study(asked(vary, design={"kind": "latin-hypercube", "points": 60}))
    whole = evaluation.evaluate(plan, range(60))
    parts = [evaluation.evaluate(plan, range(first, first + 6)) for first in range(0, 60, 6)]
    assert np.allclose(np.concatenate([p.values for p in parts]), whole.values, rtol=1e-14)


def test_answers_survive_packing():
    plan = load_study(asked({"network.link": [0.5, 2.0]}))
    answers = evaluation.evaluate(plan, range(2))
    again = unpacked(packed(answers))
    assert np.array_equal(again.values, answers.values, equal_nan=True)
    assert (again.kinds, again.errors) == (answers.kinds, answers.errors)
    assert again.steps.tolist() == answers.steps.tolist() == [5, 0]


# what is written


def test_parquet_says_what_it_is(tmp_path):
    vary = {"network.link": [0.5, 7.0], "network.agents": [2, 3], "network.architecture": ["ad-hoc", "cyclic"]}
    results = sf.study(asked(vary), tmp_path / "r.parquet")
    table = pq.read_table(results.path)
    assert table.column_names == [
        *("point", "network.link", "network.agents", "network.architecture", "method", "estimator", "nature"),
        *("step", "claimed.trace", "error"),
    ]
    field = table.schema.field("claimed.trace")
    assert field.metadata == {b"label": b"claimed variance of x"}
    assert json.loads(table.schema.metadata[b"stochfuse.study"])["study"]["vary"] == vary
    frame = pd.read_parquet(results.path)
    assert frame["network.agents"].dtype == np.int64
    assert frame["claimed.trace"].isna().sum() == frame["step"].isna().sum() == frame["error"].notna().sum() == 4
    assert np.isfinite(frame["claimed.trace"].dropna()).all()
    described = json.loads((tmp_path / "r.parquet.study.json").read_text())
    assert described["facts"]["failed"] == 4
    assert not (tmp_path / "r.parquet.parts").exists()


def test_csv_and_parquet_hold_the_same(tmp_path):
    mapping = asked({**THREE, "model.R": [1.0, 0.0]}, report={"quantity": ["claimed", "messages"]})
    _, rows = run(tmp_path, mapping)
    frame = pd.read_parquet(sf.study(mapping, tmp_path / "r.parquet").path)
    assert len(frame) == len(rows)
    for name in ("network.link", "claimed.trace", "messages.nodes", "step"):
        want = np.array([float(row[name] or "nan") for row in rows])
        assert np.array_equal(frame[name].to_numpy(dtype=float), want, equal_nan=True)
    for name in ("method", "nature", "error"):
        assert frame[name].astype(object).where(frame[name].notna(), "").tolist() == [row[name] for row in rows]


@pytest.mark.parametrize("name", ["r.csv", "r.parquet"])
def test_results_are_read_in_blocks(tmp_path, name, monkeypatch):
    monkeypatch.setattr("stochfuse.studies.files.LINES", 7)
    monkeypatch.setattr("stochfuse.studies.plan.CHUNK", {"simplified": 5})
    vary = {"network.steps": [1, 4], "network.link": [0.1, 0.2, 0.3], "model.R": [1.0, -1.0]}
    results = sf.study(asked(vary, report={"quantity": ["claimed", "messages"]}), tmp_path / name)

    def column(name, step=None):
        return np.concatenate([b[name] for b in results.blocks([name], step)]).tolist()

    assert column("point") == [0, 2, 4, 6, 8, 10]
    assert column("step") == [1, 1, 1, 4, 4, 4]
    assert column("step", 4) == [4, 4, 4]
    assert column("network.link") == pytest.approx([0.1, 0.2, 0.3] * 2)
    assert column("method") == ["simplified"] * 6
    load = np.concatenate(list(results.mean_over_steps("messages.nodes")))
    assert load == pytest.approx([0.2, 0.4, 0.6] * 2)
    with pytest.raises(sf.UsageError, match=r"no column 'actual': the value columns are claimed\.trace"):
        list(results.blocks(["actual"]))


def test_a_finished_study_is_not_done_again(tmp_path, monkeypatch):
    first = sf.study(asked(), tmp_path / "r.csv")
    monkeypatch.setattr("stochfuse.studies.running.evaluate", None)
    again = sf.study(asked(), tmp_path / "r.csv")
    assert (again.rows, again.failed) == (first.rows, 0)


def test_a_changed_study_is_refused_with_the_reason(tmp_path):
    sf.study(asked(), tmp_path / "r.csv")
    other = asked({**THREE, "model.R": [1.0, 50.0]})
    message = (
        r"r\.csv is not the result of study as it is now: vary\.model\.R was \[1\.0, 100\.0\] and is \[1\.0, 50\.0\]"
    )
    with pytest.raises(sf.UsageError, match=message):
        sf.study(other, tmp_path / "r.csv")
    assert sf.study(other, tmp_path / "r.csv", restart=True).rows == 60


def test_files_of_others_are_left_alone(tmp_path):
    (tmp_path / "r.csv").write_text("mine")
    with pytest.raises(sf.UsageError, match=r"r\.csv exists and is not the result of a study; begin anew with --resta"):
        sf.study(asked(), tmp_path / "r.csv")
    assert (tmp_path / "r.csv").read_text() == "mine"
    with pytest.raises(sf.UsageError, match=r"r\.txt: expected a name that ends in \.parquet or \.csv"):
        sf.study(asked(), tmp_path / "r.txt")
    with pytest.raises(sf.UsageError, match=r"output: expected a file for the result, got nothing"):
        sf.study(asked())
    with pytest.raises(sf.UsageError, match=r"workers: expected a whole number of at least 1, got 0"):
        sf.study(asked(), tmp_path / "x.csv", workers=0)
    (tmp_path / "r.csv").unlink()
    sf.study(asked(), tmp_path / "r.csv")
    with (tmp_path / "r.csv").open("a") as file:
        file.write("more\n")
    with pytest.raises(sf.UsageError, match=r"r\.csv is not the result of .*: the file has been changed since"):
        sf.study(asked(), tmp_path / "r.csv")


def test_points_that_take_more_for_common_than_there_is_are_known_at_once(sizes):
    ranges = {"model.Q": {"from": 0.1, "to": 100, "scale": "log"}, "model.R": {"from": 1, "to": 1e4, "scale": "log"}}
    vary = {**ranges, "initial.P": {"from": 1, "to": 1e4, "scale": "log"}, "network.steps": [3]}
    base = sf.load_scenario("cv-2d").to_mapping()
    base["network"] |= {"link": 0.5}
    design = {"kind": "latin-hypercube", "points": 240}
    plan = load_study({"scenario": base, "vary": vary, "design": design, "predict": {"method": "general"}})
    answers = evaluation.evaluate(plan, range(240))
    assert 0 < len(answers.errors) < 24
    assert len(sizes) <= 4
    assert sizes[-1] == 240 - len(answers.errors)
    codes = plan.codes(range(240))
    for point in (*answers.errors, *[p for p in range(0, 240, 60) if p not in answers.errors]):
        numbers = {"q": codes["model.Q"][point], "r": codes["model.R"][point], "p0": codes["initial.P"][point]}
        scenario = sf.load_scenario("cv-2d", steps=3, **{key: float(value) for key, value in numbers.items()})
        if point in answers.errors:
            with pytest.raises(sf.NoAnswerError, match="exceeds what is known"):
                sf.predict(scenario, [0.5], "general")
        else:
            value = answers.values[np.repeat(np.arange(240), answers.rows) == point, 0]
            assert value == pytest.approx(sf.predict(scenario, [0.5], "general").values("rms:x,y")[0], rel=1e-9)


def test_a_point_without_an_answer_does_not_take_its_batch_along(sizes):
    variances = [float(P) for P in range(1, 33)]
    variances[5] = 0.0  # the Local Fusion Graph needs its inverse
    vary = {"network.link": [0.5], "network.steps": [2], "initial.P": variances}
    plan = load_study(asked(vary, predict={"method": "general"}))
    answers = evaluation.evaluate(plan, range(plan.size))
    assert list(answers.errors) == [5]
    assert "initial.P: expected an invertible covariance" in answers.errors[5]
    assert sizes == [32, 16, 8, 4, 4, 2, 1, 1, 2, 8, 16]
