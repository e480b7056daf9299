"""`stochfuse run`: what comes in wrong is named, and what comes out is what estimates and truth come to by hand."""

from __future__ import annotations

import csv
import re
import signal
import subprocess
import sys
import unicodedata
from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import stochfuse as sf
from stochfuse.report.runs import draw
from tests.cli.command import run as command
from tests.cli.command import strict_json
from tests.report.test_figures import extent, legends_of, texts_of

Z = "run,step,agent,z1\n1,2,1,3.0\n1,3,2,4.5\n"
HEARD = "run,step,receiver,sender\n1,2,1,2\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three runs of a tracker in the plane, its files and what was said of them."""
    folder = tmp_path_factory.mktemp("made")
    words = ["cv-2d", "--steps", 3, "--link", 0.5, "--runs", 3, "--seed", 4, "--estimator", "naive"]
    command("simulate", *words, "-o", folder)
    return folder


def files_of(folder, truth=True):
    names = ("measurements", "arrivals", *(["truth"] if truth else []))
    return [word for name in names for word in (f"--{name}", folder / f"{name}.csv")]


def rows_of(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def refused(folder, *words, **texts):
    """What is said of files with these texts."""
    given = []
    for name, text in texts.items():
        path = folder / f"{name}.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        given += [f"--{name}", path]
    return command("run", "thesis-steady", "--link", 0.5, "--estimator", "stand-alone", *given, *words, code=2).stderr


MEASUREMENTS = [
    ("", r"empty; expected columns run, step, agent, z1"),
    ("run,step,agent,z1\n", r"no rows under the headings run, step, agent, z1"),
    (bytes(range(256)), r"not a text file in UTF-8 \(byte 128\)"),
    (Z.encode("utf-16"), r"not a text file in UTF-8 \(byte 0\)"),
    ("run,step,z1\n1,2,3\n", r"column 'agent' is missing from run, step, z1"),
    (HEARD, r"column 'agent' is missing from run, step, receiver, sender"),
    ("step,agent,z1\n2,1,inf\n", r"line 2, column 'z1': expected a finite number or nothing, got inf"),
    ("step,agent,z1\n2,1,1e300\n", r"column 'z1': expected a finite number or nothing, below 1e\+100 in size, got 1e\+300"),
    ("step,agent,z1\n2,1,3\n2,1,4\n", r"line 3: expected one row for each run, step and agent, got another than in line 2"),
    ("step,agent,z1\n2,bob,3\n", r"line 2, column 'agent': expected an agent from 1 to 3, got 'bob'"),
    ("step,agent,z1\n-2,1,3\n", r"line 2, column 'step': expected a whole number of at least 1, got '-2'"),
    ("step,agent,z1\n2.5,1,3\n", r"line 2, column 'step': expected a whole number of at least 1, got '2.5'"),
    ("step,agent,z1\ntwo,1,3\n", r"line 2, column 'step': expected a whole number of at least 1, got 'two'"),
    ("step,agent,z1\n2,1,3\n1000000000,1,3\n", r"line 3, column 'step': .* got step 1000000000 where .* 2 steps; are these times\?"),
    ("step,agent,z1\n1e30,1,3\n", r"line 2, column 'step': expected a whole number of at least 1, got '1e30'"),
    ("step;agent;z1\n2;1;3,5\n", r"line 2, column 'z1': expected a number, got '3,5'"),
    ("step,agent,z1\n2,1\n", r"line 2: expected 3 cells, got 2"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MEASUREMENTS)
def test_measurements_that_cannot_be_used(text, message, tmp_path):
    assert re.search(message, refused(tmp_path, measurements=text))


OTHERS = [
    ({"truth": Z}, r"truth: expected states as columns, some of x; got run, step, agent, z1"),
    ({"truth": "step,x\n2,1e300\n"}, r"column 'x': expected a number or nothing, below 1e\+100 in size"),
    ({"truth": "run,step,x\n7,2,1\n"}, r"run '7' is not in .*measurements.csv; expected the same runs in all files"),
    ({"arrivals": Z}, r"column 'receiver' is missing from run, step, agent, z1"),
    ({"arrivals": "step,receiver,sender\n2,1,1\n"}, r"column 'receiver': expected another agent than the sender"),
    ({"arrivals": "step,receiver,sender,sent_step\n2,1,2,3\n"}, r"column 'sent_step': expected a step up to 2, got 3"),
    ({"estimates": "step,agent,x\n2,1,0\n"}, r"column 'var:x' is missing from step, agent, x"),
    ({"estimates": "step,agent,x,var:x\n2,1,0,-1\n"}, r"line 2, column 'var:x': expected variances and cov.* got -1"),
    ({"initial": "agent,x\n1,0\n2,0\n"}, r"expected a first estimate of every agent, got none of agent 3"),
    ({"initial": "run,agent,x\n1,1,0\n1,2,0\n1,3,0\n2,1,0\n"}, r"got none of agent 2 in run '2'"),
]


@pytest.mark.parametrize(("texts", "message"), OTHERS)
def test_other_files_that_cannot_be_used(texts, message, tmp_path):
    assert re.search(message, refused(tmp_path, measurements=Z, **texts))


WORDS = [
    (["--columns", "z1=nothing"], r"columns: no file has a column 'nothing', to be used as 'z1'"),
    (["--columns", "zz=z1"], r"columns: unknown column 'zz'"),
    (["--columns", "z1"], r"--columns: expected OURS=THEIRS, got 'z1'"),
    (["--criterion", "dett"], r"criterion: expected one of det, trace, max-eig, got 'dett' \(did you mean 'det'\?\)"),
    (["--estimator", "navie"], r"got 'navie' \(did you mean 'naive'\?\)"),
    (["--metric", "foo"], r"metric: expected trace, det, .* got 'foo'"),
    (["--link", "1.5"], r"--link: expected probabilities between 0 and 1, got 1.5"),
    (["--link", "0,1"], r"--link: expected one link probability, got 2"),
    (["--covariance"], r"--covariance: expected --output FILE to write them to"),
    (["--output", "there.txt"], r"there.txt: expected a name that ends in .csv, .parquet"),
    (["--output", "nowhere/there.csv"], r"cannot write nowhere/there.csv: there is no directory nowhere"),
    (["--truth", "-", "--initial", "-"], r"expected at most one file on standard input, got - for several"),
]


@pytest.mark.parametrize(("words", "message"), WORDS)
def test_words_that_cannot_be_meant(words, message, tmp_path):
    assert re.search(message, refused(tmp_path, *words, measurements=Z))


def test_an_output_never_replaces_an_input(made):
    z = made / "measurements.csv"
    before = z.read_bytes()
    done = command("run", "cv-2d", *files_of(made), "--output", z, code=2)
    assert "--output: expected another file than the input" in done.stderr
    assert z.read_bytes() == before


SAME = {
    "windows": lambda text: text.replace("\n", "\r\n"),
    "old mac": lambda text: text.replace("\n", "\r"),
    "bom": lambda text: "\ufeff" + text,
    "semicolons": lambda text: text.replace(",", ";"),
    "comments": lambda text: "# a remark\n\n" + text,
}


@pytest.mark.parametrize("how", SAME)
def test_files_in_other_dress_are_the_same(how, made, tmp_path):
    plain = command("run", "cv-2d", *files_of(made), "--estimator", "naive", "--format", "csv").stdout
    for name in ("measurements", "arrivals", "truth", "initial"):
        text = SAME[how]((made / f"{name}.csv").read_text(encoding="utf-8"))
        (tmp_path / f"{name}.csv").write_bytes(text.encode())
    assert command("run", "cv-2d", *files_of(tmp_path), "--estimator", "naive", "--format", "csv").stdout == plain


def test_columns_have_other_names_on_standard_input_too():
    z = "k,who,range\n2,1,3.0\n3,2,4.0\n"
    words = [
        "run",
        "thesis-steady",
        "--measurements",
        "-",
        "--link",
        0,
        "--estimator",
        "stand-alone",
        "--format",
        "json",
    ]
    done = command(*words, "--columns", "step=k,agent=who,z1=range", input=z)
    assert strict_json(done.stdout)["steps"] == 3


def test_nothing_may_have_arrived(tmp_path):
    (tmp_path / "heard.csv").write_text("run,step,receiver,sender,sent_step\n")
    (tmp_path / "z.csv").write_text(Z)
    files = ["--measurements", tmp_path / "z.csv", "--arrivals", tmp_path / "heard.csv", "--format", "json"]
    alone, fused = (
        strict_json(command("run", "thesis-steady", *files, "--estimator", name).stdout)["rows"][0]["claimed"]
        for name in ("stand-alone", "local-fusion-graph")
    )
    assert fused == pytest.approx(alone, rel=1e-12)


def test_components_that_no_sensor_has_are_told(tmp_path):
    wide = "step,agent," + ",".join(f"z{i}" for i in range(1, 2001)) + "\n2,1," + ",".join(["1"] * 2000) + "\n"
    (tmp_path / "z.csv").write_text(wide)
    done = command("run", "thesis-steady", "--measurements", tmp_path / "z.csv", "--link", 0, "--estimator", "naive")
    assert "not used is z2, z3, z4, …: sensors of the scenario measure at most 1" in done.stderr


def test_json_and_parquet_are_as_good_as_csv(made, tmp_path):
    import json

    import pandas as pd

    plain = command("run", "cv-2d", *files_of(made, truth=False), "--estimator", "naive", "--format", "csv").stdout
    for suffix in ("json", "parquet"):
        frame = pd.read_csv(made / "measurements.csv")
        path = tmp_path / f"measurements.{suffix}"
        if suffix == "json":
            path.write_text(json.dumps(frame.to_dict("list")))
        else:
            frame.to_parquet(path)
        (tmp_path / "initial.csv").write_bytes((made / "initial.csv").read_bytes())
        words = ["--measurements", path, "--arrivals", made / "arrivals.csv", "--estimator", "naive", "--format", "csv"]
        assert command("run", "cv-2d", *words).stdout == plain


# what comes out


def by_hand(folder, estimates, metric_states):
    """RMS, claimed RMS and mean NEES of every agent, from the files alone, row by row."""
    truth = {(row["run"], row["step"]): row for row in rows_of(folder / "truth.csv")}
    squares, claims, nees = defaultdict(list), defaultdict(list), defaultdict(list)
    states = ["x", "vx", "y", "vy"]
    for row in rows_of(estimates):
        true = truth[row["run"], row["step"]]
        error = np.array([float(row[s]) - float(true[s]) for s in states])
        P = np.array(
            [
                [
                    float(row[f"var:{a}"] if i == j else row[f"cov:{states[min(i, j)]}:{states[max(i, j)]}"])
                    for j, _ in enumerate(states)
                ]
                for i, a in enumerate(states)
            ]
        )
        squares[row["agent"]].append(sum(error[states.index(s)] ** 2 for s in metric_states))
        claims[row["agent"]].append(sum(float(row[f"var:{s}"]) for s in metric_states))
        nees[row["agent"]].append(float(error @ np.linalg.inv(P) @ error))
        assert float(row["nees"]) == pytest.approx(nees[row["agent"]][-1], rel=1e-8)
    return {
        agent: (np.sqrt(np.mean(squares[agent])), np.sqrt(np.mean(claims[agent])), np.mean(nees[agent]))
        for agent in squares
    }


@pytest.mark.parametrize("estimator", ["naive", "local-fusion-graph", "covariance-intersection"])
def test_rows_are_what_estimates_and_truth_come_to(estimator, made, tmp_path):
    estimates = tmp_path / "estimates.csv"
    words = ["--estimator", estimator, "--metric", "rms:x,y", "--covariance", "--output", estimates]
    done = command("run", "cv-2d", *files_of(made), *words, "--format", "json")
    hand = by_hand(made, estimates, ["x", "y"])
    rows = {row["agent"]: row for row in strict_json(done.stdout)["rows"]}
    for agent, (realised, claimed, nees) in hand.items():
        row = rows[int(agent)]
        assert row["realised"] == pytest.approx(realised, rel=1e-10)
        assert row["claimed"] == pytest.approx(claimed, rel=1e-10)
        assert row["nees"] == pytest.approx(nees, rel=1e-8)
    assert rows[None]["realised"] == pytest.approx(np.sqrt(np.mean([h[0] ** 2 for h in hand.values()])), rel=1e-10)
    assert rows[None]["nees"] == pytest.approx(np.mean([h[2] for h in hand.values()]), rel=1e-8)


def test_estimates_of_ones_own_are_judged_as_ours_are(made, tmp_path):
    """What a run wrote, read back under other names: the same errors, claims and NEES, also of some rows alone."""
    own = tmp_path / "own.csv"
    command("run", "cv-2d", *files_of(made), "--estimator", "naive", "--covariance", "--output", own)
    header, *lines = own.read_text().splitlines(keepends=True)
    names = {"x": "x_hat", "cov:x:y": "P_xy"}
    truth = tmp_path / "truth.csv"
    truth.write_text((made / "truth.csv").read_text().replace(",x,", ",east,", 1))
    header = ",".join(names.get(name, name) for name in header.split(","))
    words = ["--truth", truth, "--estimates", own, "--columns", "x=east|x_hat,cov:x:y=P_xy"]
    for kept in (lines, lines[::2]):
        own.write_text(header + "".join(kept))
        done = command("run", "cv-2d", *files_of(made, truth=False), *words, "--estimator", "naive", "--format", "json")
        rows = strict_json(done.stdout)["rows"]
        theirs = [row for row in rows if row["estimator"] == "recorded"]
        if kept is lines:
            for row, ours in zip(theirs, rows, strict=False):
                for key in ("realised", "claimed", "nees", "nees_low", "nees_high"):
                    assert row[key] == pytest.approx(ours[key], rel=1e-9)
        back = tmp_path / "back.csv"
        back.write_text(own.read_text().replace("x_hat", "x").replace("P_xy", "cov:x:y"))
        for agent, (_, _, nees) in by_hand(made, back, ["x", "y"]).items():
            assert theirs[int(agent)]["nees"] == pytest.approx(nees, rel=1e-8)
        assert [row["predicted"] for row in theirs] == [None] * 4


def test_json_has_the_keys_of_its_schema(made):
    found = strict_json(
        command("run", "cv-2d", *files_of(made), "--estimator", "naive,optimal", "--format", "json").stdout
    )
    assert found["schema"] == "stochfuse.run/1"
    assert found["suspicions"] == []
    keys = {
        "estimator",
        "agent",
        "link",
        "realised",
        "claimed",
        "predicted",
        "nees",
        "nees_low",
        "nees_high",
        "verdict",
    }
    assert all(keys <= row.keys() for row in found["rows"])
    named = [(row["estimator"], row["agent"]) for row in found["rows"]]
    assert named == [(name, agent) for name in ("naive", "optimal") for agent in (None, 1, 2, 3)]
    for row in found["rows"]:
        inside = row["nees_low"] <= row["nees"] <= row["nees_high"]
        assert (row["verdict"] == "consistent") == inside
        assert row["link"] is None
        assert row["predicted"] is None


def test_without_truth_innovations_judge(made):
    words = ["--estimator", "optimal", "--format", "json"]
    rows, known = (
        strict_json(command("run", "cv-2d", *files_of(made, truth), *words).stdout)["rows"] for truth in (False, True)
    )
    for row, other in zip(rows, known, strict=True):
        assert row["realised"] is None
        assert row["nees"] is None
        assert row["nis"] == pytest.approx(other["nis"], rel=1e-12)
        expected = "consistent" if row["nis_low"] <= row["nis"] <= row["nis_high"] else None
        assert expected is None or row["verdict"] == expected


def test_estimates_as_parquet_are_those_as_csv(made, tmp_path):
    import pandas as pd

    for suffix in ("csv", "parquet"):
        words = ["--estimator", "naive", "--covariance", "--output", tmp_path / f"estimates.{suffix}"]
        command("run", "cv-2d", *files_of(made), *words)
    one, other = pd.read_csv(tmp_path / "estimates.csv"), pd.read_parquet(tmp_path / "estimates.parquet")
    states = ["x", "vx", "y", "vy"]
    named = [f"cov:{a}:{b}" for a, b in sorted(combinations(states, 2), key=lambda ab: states.index(ab[1]))]
    assert list(one.columns) == [
        "run",
        "step",
        "agent",
        "estimator",
        *states,
        *(f"var:{s}" for s in states),
        *named,
        "nees",
    ]
    assert list(other.columns) == list(one.columns)
    for name in one.columns:
        if name in ("run", "step", "agent", "estimator"):
            assert [str(v) for v in one[name]] == [str(v) for v in other[name]]
        else:
            np.testing.assert_array_equal(one[name], other[name])


def test_many_runs_in_batches_are_each_as_alone(monkeypatch, tmp_path):
    """300 runs in batches of 7 and at once: the same rows; and a run alone has its own estimates."""
    generator = np.random.default_rng(2)
    runs = np.repeat(np.arange(300), 6)
    z = {"run": runs, "step": np.tile([2, 2, 3, 3, 4, 4], 300), "agent": np.tile([1, 2], 900),
         "z1": generator.normal(size=1800)}  # fmt: skip
    s = sf.load_scenario("thesis-steady", agents=2, steps=4)
    whole = sf.run(s, z, link=0.5, estimator="naive", predicted=False)
    monkeypatch.setattr("stochfuse.data.records.NUMBERS", 7 * 8)
    parts = sf.run(s, z, link=0.5, estimator="naive", predicted=False)
    for one, other in zip(whole.rows, parts.rows, strict=True):
        assert one.claimed == pytest.approx(other.claimed, rel=1e-12)
        assert one.nis.mean == pytest.approx(other.nis.mean, rel=1e-12)
    assert whole.runs == 300


def test_narrow_terminals(made):
    for width in ("40", "80"):
        done = command("run", "cv-2d", *files_of(made), "--estimator", "naive", env={"COLUMNS": width})
        shown = "".join(char for char in done.stdout if not unicodedata.combining(char))
        assert max(map(len, shown.splitlines())) <= int(width)


def test_interrupted_it_leaves_no_file(made, tmp_path):
    program = (
        "import os, signal, sys; from stochfuse.data import run; from stochfuse.cli import main;"
        "run.predict = lambda *a, **k: signal.raise_signal(signal.SIGINT);"
        "sys.argv = ['stochfuse', *sys.argv[1:]]; main()"
    )
    words = ["run", "cv-2d", *files_of(made), "--link", "0.5", "--estimator", "naive", "--output", tmp_path / "e.csv"]
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, words)], capture_output=True, text=True, check=False
    )
    assert done.returncode in (130, -signal.SIGINT), done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "estimators"),
    [("cv-2d", ["naive", "optimal"]), ("cooperative-pnt", ["lwin"]), ("gps-ins", ["equivalent-measurement"])],
)
@pytest.mark.parametrize("truth", [True, False])
def test_nothing_in_the_figure_lies_on_another(preset, estimators, truth, tmp_path):
    s = sf.load_scenario(preset, steps=6)
    sf.simulate(s, 2, link=0.5, estimator=estimators[0], folder=tmp_path, predicted=False)
    paths = [tmp_path / f"{name}.csv" for name in ("measurements", "arrivals", "truth")]
    found = sf.run(s, *paths[: 3 if truth else 2], estimator=estimators, predicted=False)
    figure = draw(found)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = [(str(artist), extent(artist, renderer)) for artist in (*texts_of(figure), *legends_of(figure))]
    for (name, one), (other, two) in combinations(boxes, 2):
        assert not one.shrunk(0.98, 0.9).overlaps(two.shrunk(0.98, 0.9)), (name, other)
    for name, box in boxes:
        assert figure.bbox.x0 - 1 <= box.x0 <= box.x1 <= figure.bbox.x1 + 1, name
