"""The command line, as a user meets it."""

from __future__ import annotations

import csv
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import sympy

import stochfuse as sf
from stochfuse.prediction.general import _kept
from tests.cli.command import ENV, run, strict_json


def test_version_and_help():
    assert run("--version").stdout == f"stochfuse {sf.__version__}\n"
    overview = run("--help").stdout
    for command in ("predict", "derive", "scenario"):
        assert command in overview
    for command in (["predict"], ["derive"], ["scenario"], ["scenario", "new"]):
        assert "Usage: stochfuse" in run(*command, "--help").stdout


def test_default_table_says_what_it_shows():
    out = run("predict").stdout
    assert out == (
        "Expected claimed posterior covariance: variance of x [no unit given]\n"
        "thesis-transient: 3 agents, ad-hoc; every agent alike\n"
        "simplified formulation (54); approximate (mean field)\n"
        "\n"
        "    µ       k=1      k=2      k=3      k=4      k=5\n"
        " ──────────────────────────────────────────────────\n"
        "    0    100.00   55.556   44.615   41.043   39.775\n"
        " 0.25    77.083   42.571   34.853   32.616   31.920\n"
        "  0.5    58.333   32.941   27.881   26.609   26.271\n"
        " 0.75    43.750   26.029   22.924   22.259   22.112\n"
        "    1    33.333   21.212   19.365   19.033   18.972\n"
    )


def test_json_is_the_contract():
    result = strict_json(run("predict", "--format", "json", "--link", "0:1:0.5", "--steps", "2").stdout)
    assert list(result)[:9] == [
        "schema",
        "version",
        "method",
        "quantity",
        "metric",
        "link",
        "steps",
        "values",
        "scenario",
    ]
    assert result["schema"] == "stochfuse.prediction/1"
    assert (result["method"], result["quantity"], result["metric"]) == ("simplified", "claimed", "trace")
    assert result["link"] == [0.0, 0.5, 1.0]
    assert result["steps"] == [1, 2]
    np.testing.assert_allclose(result["values"], [[100, 55.5556], [58.3333, 32.9410], [33.3333, 21.2121]], rtol=1e-5)
    assert result["scenario"]["network"]["steps"] == 2
    assert result["meta"]["nature"] == "approximate"
    again = sf.Scenario.from_mapping(result["scenario"])
    np.testing.assert_array_equal(sf.predict(again, result["link"]).values(), result["values"])


def test_fcs_demo_is_readable_at_80_columns_and_complete():
    done = run("predict", "fcs-demo", "--steady")
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert "RMS of x, y (root of the summed variances) [m]" in done.stdout.replace("\n", " ")
    p = sf.predict(sf.load_scenario("fcs-demo"), steady=True)
    assert p.steady_values("rms:x,y") is not None
    for value in [*p.values("rms:x,y").ravel(), *p.steady_values("rms:x,y")]:
        assert f"{value:#.5g}" in done.stdout
    assert len([line for line in lines if "mean µ" in line]) == 1  # one table, not pieces of one
    assert "masked network" in done.stderr
    assert "note: the steady state is proved to lie within a relative 1e-12" in done.stderr


@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_any_terminal_width(columns):
    out = run("predict", "cv-2d", "--steps", "30", env={"COLUMNS": columns}).stdout
    assert max(map(len, out.splitlines())) <= int(columns)
    assert "…" not in out
    headings, values = out.split(), sf.predict(sf.load_scenario("cv-2d", steps=30)).values("rms:x,y")
    for k in range(1, 31):
        assert f"k={k}" in headings or str(k) in headings
    for value in values.ravel():
        assert f"{value:#.5g}" in headings


@pytest.mark.slow
def test_a_steady_state_beside_what_is_exact():
    asked = ("predict", "--estimator", "naive", "--steps", "1", "--link", "0,0.5", "--runs", "30", "--steady")
    rows = list(csv.DictReader(io.StringIO(run(*asked, "-f", "csv").stdout)))
    assert [(row["step"], row["nature"]) for row in rows] == [("1", "exact"), ("steady", "sampled")] * 2
    assert [row["standard_error"] == "" for row in rows] == [True, False] * 2
    done = run(*asked, "--quantity", "claimed,optimal", "-f", "json")
    found = strict_json(done.stdout)["quantities"]
    assert found["claimed"]["steady"] == [float(row["value"]) for row in rows[1::2]]
    assert found["claimed"]["steady_standard_error"] == [float(row["standard_error"]) for row in rows[1::2]]
    assert found["optimal"]["steady_nature"] == ["exact"] * 2
    assert max(found["optimal"]["steady_relative_bound"]) < 1e-9
    assert "note: steady state: sampled at step" in done.stderr
    table = run(*asked, "--quantity", "claimed,optimal").stdout
    assert re.search(r"0\.5 +steady +\S+ ±\S+ +24\.897", table)


def test_csv_markdown_and_latex():
    rows = list(
        csv.DictReader(
            io.StringIO(run("predict", "cv-2d", "-f", "csv", "--steps", "2", "--link", "0,1", "--steady").stdout)
        )
    )
    assert [row["step"] for row in rows] == ["1", "2", "steady"] * 2
    assert rows[0] | {"value": ""} == {
        "method": "simplified", "quantity": "claimed", "stage": "posterior", "nature": "approximate", "metric": "rms:x,y",
        "unit": "m", "agent": "mean", "case": "", "link": "0.0", "step": "1", "value": "",
    }  # fmt: skip
    assert float(rows[0]["value"]) == pytest.approx(200**0.5, rel=1e-15)
    markdown = run("predict", "-f", "markdown", "--link", "0.5").stdout
    assert "| µ | k=1 | k=2 | k=3 | k=4 | k=5 |\n| :-- | --: | --: | --: | --: | --: |\n| 0.5 | 58.333 |" in markdown
    latex = run("predict", "cv-2d", "-f", "latex", "--link", "0.5", "--metric", "det").stdout
    assert latex.startswith(
        "\\begin{table}\n  \\caption{Expected claimed posterior covariance: determinant over x, vx, y, vy"
    )
    assert r"m$^2$ (m/s)$^2$" in latex


@pytest.mark.parametrize(
    ("metric", "function"),
    [
        ("trace", np.trace),
        ("det", np.linalg.det),
        ("max-eig", lambda P: np.linalg.eigvalsh(P)[-1]),
        ("var:vx", lambda P: P[1, 1]),
        ("std:y", lambda P: P[2, 2] ** 0.5),
        ("rms:x,y", lambda P: (P[0, 0] + P[2, 2]) ** 0.5),
    ],
)
def test_metrics(metric, function):
    done = run("predict", "cv-2d", "--metric", metric, "-f", "json", "--link", "0.3", "--steps", "3")
    P = sf.predict(sf.load_scenario("cv-2d", steps=3), [0.3]).covariance[0]
    result = strict_json(done.stdout)
    assert result["metric"] == metric
    np.testing.assert_allclose(result["values"][0], [function(P_k) for P_k in P], rtol=1e-12)
    assert ("adds up different units" in done.stderr) == (metric in ("trace", "max-eig"))


def test_normalised_to_no_link():
    result = strict_json(run("predict", "-f", "json", "--normalise", "--steady").stdout)
    assert result["values"][0] == [1.0] * 5
    assert result["steady"][0] == pytest.approx(1.0)
    assert result["values"][-1][0] == pytest.approx(1 / 3)
    assert result["meta"]["normalised"] == "to link probability 0"


def test_agents_that_differ():
    values = {
        a: np.array(strict_json(run("predict", "fcs-demo", "-f", "json", "--agent", a).stdout)["values"])
        for a in ("mean", "worst", "best", "1", "10")
    }
    assert (values["worst"] >= values["mean"] * (1 - 1e-12)).all()
    assert (values["mean"] >= values["best"] * (1 - 1e-12)).all()
    np.testing.assert_array_equal(values["worst"], np.maximum(values["1"], values["10"]))


def test_each_agent_has_a_column_of_its_own(tmp_path):
    asked, p = ("predict", "road-5", "--at", "2,last", "--agent", "each"), sf.predict("road-5")
    alone = [p.values("rms:x,y", i)[:, [1, -1]].tolist() for i in range(1, 6)]
    found = strict_json(run(*asked, "-f", "json").stdout)
    assert [one["agent"] for one in found["agents"]] == list("ABCDE")
    assert [one["values"] for one in found["agents"]] == alone
    assert found["values"] == p.values("rms:x,y")[:, [1, -1]].tolist()
    head, *rows = csv.reader(io.StringIO(run(*asked, "-f", "csv", "--plot", tmp_path / "each.svg").stdout))
    assert head[-6:] == ["step", *"ABCDE"]
    assert [[float(cell) for cell in row[-5:]] for row in rows] == [[one[0][k] for one in alone] for k in range(2)]
    assert "each agent by itself" in (tmp_path / "each.svg").read_text()
    text = run(*asked).stdout.splitlines()
    assert text[2] == "road-5: 5 agents, ad-hoc; each agent by itself"
    assert [len(line.split()) for line in text[5:] if line.strip(" ─")] == [8, 7, 7]


def test_each_agent_of_a_sample_has_its_standard_error():
    asked = ("--link", "0.5", "--steps", "2", "--method", "monte-carlo", "--runs", "4", "--control", "none")
    head, first, _ = csv.reader(io.StringIO(run("predict", *asked, "--agent", "each", "-f", "csv").stdout))
    assert head[-6:] == [f"agent {i}{more}" for i in (1, 2, 3) for more in ("", " standard_error")]
    _, alone, _ = csv.reader(io.StringIO(run("predict", *asked, "--agent", "2", "-f", "csv").stdout))
    assert first[-4:-2] == alone[-2:]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--quantity", "claimed,actual"), "--agent each: expected one --quantity, got claimed,actual"),
        (
            ("--over", "network.agents=2:4:1"),
            "--agent each: expected as many agents in every row, got --over network.agents=2:4:1",
        ),
    ],
)
def test_each_agent_is_refused_where_there_is_no_column(words, message):
    assert run("predict", "--agent", "each", *words, code=2).stderr == f"error: {message}\n"


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ("link = 0.3", None),
        ("link = [0.3, 0.4]", "network.link (one per step)"),
        ("link = [[0, 0.4], [1, 0]]", "network.link (a matrix)"),
        ("link = [[[0, 0.4], [1, 0]], 0.5]", "network.link (a matrix per step)"),
        ('link = { file = "nowhere.csv" }', "network.link (those of nowhere.csv)"),
        ("link = 0.3\nburst = { good_to_bad = 0.1, bad_to_good = 0.5 }", "network.burst (bursts)"),
        ("[network.radio]\ntransmit_power = 20", "network.radio (a link budget)"),
    ],
)
def test_a_link_says_what_it_takes_the_place_of(own, said):
    text = f"[model]\nF=1\nH=1\nQ=1\nR=1\n[initial]\nP=1\n[network]\nagents = 2\nsteps = 2\n{own}\n"
    done = run("predict", "-", "--link", "0.6", "-f", "csv", input=text)
    told = [line for line in done.stderr.splitlines() if "--link" in line]
    assert told == [f"note: --link takes the place of the scenario's own links: {said}"] * (said is not None)
    assert done.stdout == run("predict", "-", "--link", "0.6", "-f", "csv", input=text.replace(own, "")).stdout


def test_scenario_from_standard_input_file_and_json(tmp_path):
    text = run("scenario", "show", "cv-2d").stdout
    (tmp_path / "mine.toml").write_text(text)
    from_file = run("predict", str(tmp_path / "mine.toml"), "-f", "csv").stdout
    from_stdin = run("predict", "-", "-f", "csv", input=text).stdout
    from_json = run("predict", "-", "-f", "csv", input=run("scenario", "show", "cv-2d", "--json").stdout).stdout
    assert from_file == from_stdin == from_json == run("predict", "cv-2d", "-f", "csv").stdout


def test_scenario_commands(tmp_path):
    listing = strict_json(run("scenario", "list", "-f", "json").stdout)
    assert [entry["name"] for entry in listing] == [
        "beacon-map",
        "cooperative-attitude",
        "cooperative-pnt",
        "cv-2d",
        "fcs-demo",
        "gps-ins",
        "orbit-8",
        "orbit-8-noisy",
        "parallel-filters",
        "road-5",
        "thesis-steady",
        "thesis-transient",
        "two-radars",
    ]
    assert "fcs-demo" in run("scenario", "list").stdout
    assert (
        run("scenario", "check", "fcs-demo").stdout
        == "fcs-demo: ok: 10 agents, ad-hoc, 10 steps, state (x, vx, y, vy)\n"
    )
    schema = strict_json(run("scenario", "schema").stdout)
    assert set(schema["properties"]) == {
        "schema",
        "description",
        "model",
        "initial",
        "navigation",
        "network",
        "noise",
        "cooperative",
        "agent",
        "report",
    }
    new = tmp_path / "new.toml"
    run("scenario", "new", "--output", str(new))
    assert "ok: 3 agents" in run("scenario", "check", str(new)).stdout
    assert "new.toml exists already" in run("scenario", "new", "--output", str(new), code=2).stderr
    assert "no preset 'nothing'; the presets are beacon-map" in run("scenario", "new", "nothing", code=2).stderr


def test_derive_agrees_with_predict(tmp_path):
    text = run("derive", "simplified", "--agents", "3", "--step", "4", "--q", "25", "--r", "100", "--p0", "100").stdout
    lines = dict(line.split(" = ", 1) for line in text.splitlines() if line.startswith("P_4 = ("))
    closed = sympy.sympify(lines["P_4"])
    expected = sf.predict(sf.load_scenario(), [0.25]).values()[0, 3]
    assert float(closed.subs("mu", sympy.Rational(1, 4))) == pytest.approx(expected, rel=1e-14)
    names = [
        f["key"]
        for f in strict_json(run("derive", "simplified", "--agents", "3", "--step", "2", "-f", "json").stdout)[
            "formulas"
        ]
    ]
    assert names == [
        "P_1",
        "P_2_prior",
        "P_2",
        "closed",
        "derivative",
        "series_at_0",
        "series_at_1",
        "fixed_point",
        "fixed_point_polynomial",
    ]
    latex = run("derive", "--latex", "--agents", "2").stdout
    assert latex.count(r"\begin{equation*}") == latex.count(r"\end{equation*}") == 9
    assert r"\frac{\mathrm{d}P(2)}{\mathrm{d}\mu} = " in latex
    assert "P(2|1) = P(1) + q" in latex
    long = run("derive", "--step", "7", "--output", str(tmp_path / "chain.txt"))
    assert "note: step 7 is given as a chain of named sub-expressions" in long.stderr
    assert long.stdout == ""
    assert "P_7_prior = P_6 + q" in (tmp_path / "chain.txt").read_text()


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_plots(tmp_path, suffix):
    file = tmp_path / f"figure.{suffix}"
    run("predict", "fcs-demo" if suffix == "png" else "thesis-steady", "--plot", str(file))
    start = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    assert file.read_bytes().startswith(start)
    assert [f.name for f in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize(
    ("name", "format"),
    [("a.csv", "csv"), ("a.json", "json"), ("a.md", "markdown"), ("a.tex", "latex"), ("a.txt", "table")],
)
def test_output_goes_to_a_file_in_the_format_of_its_name(tmp_path, name, format):
    done = run("predict", "--output", str(tmp_path / name))
    assert done.stdout == ""
    assert (tmp_path / name).read_text() == run("predict", "--format", format).stdout


BAD = [
    (["predict", "nothing.toml"], "error: nothing.toml: no such file, and no preset of that name"),
    (["predict", "--link", "1.5"], "error: --link: expected probabilities between 0 and 1, got 1.5"),
    (["predict", "--link", "a"], "error: --link: expected 0.5, 0.2,0.5 or 0:1:0.25, got 'a'"),
    (["predict", "--link", "0:1"], "error: --link: expected 0.5, 0.2,0.5 or 0:1:0.25, got '0:1'"),
    (["predict", "--link", "0:1:-1"], "error: --link: expected first:last:step with"),
    (["predict", "--link", "0:1:1e-12"], "error: --link: expected at most 1000000 link probabilities"),
    (["predict", "--link", "nan"], "error: --link: expected probabilities between 0 and 1, got nan"),
    (["predict", "--agents", "0"], "Invalid value for '--agents'"),
    (["predict", "--agents", "many"], "Invalid value for '--agents'"),
    (["predict", "--r", "-1"], "model.R: expected a symmetric positive definite matrix, got a variance of -1"),
    (["predict", "--q", "nan"], "model.Q: expected a number or a 1×1 matrix"),
    (["predict", "--architecture", "star"], "Invalid value for '--architecture'"),
    (["predict", "--method", "guess"], "Invalid value for '--method'"),
    (
        ["predict", "--metric", "size"],
        "error: metric: expected trace, det, max-eig, var:STATE, std:STATE or rms:STATE,STATE,…, got 'size'",
    ),
    (["predict", "--metric", "var:y"], "error: metric 'var:y': no state 'y'; the states are x"),
    (["predict", "cv-2d", "--metric", "var:x,y"], "expected one state, got 2; use rms: for several"),
    (
        ["predict", "fcs-demo", "--agent", "11"],
        "error: agent: expected mean, worst, best or a number from 1 to 10, got '11'",
    ),
    (
        ["predict", "fcs-demo", "--agent", "some"],
        "error: agent: expected mean, worst, best or a number from 1 to 10, got 'some'",
    ),
    (["predict", "--output", "/nowhere/x.csv"], "error: cannot write /nowhere/x.csv: there is no directory /nowhere"),
    (["predict", "--output", "/tmp"], "error: cannot write /tmp: it is a directory"),
    (["predict", "--plot", "x.bmp"], "error: x.bmp: expected a name that ends in .png, .svg, .pdf"),
    (["predict", "--output", "x.png", "--plot", "x.png"], "error: --output and --plot: expected different files"),
    (["predict", "--p0", "0", "--q", "0", "--normalise"], "is 0 at link probability 0 and cannot be normalised to it"),
    (["predict", ""], "error: scenario: expected a file or a preset's name, got nothing"),
    (["scenario", "new", "--output", "x.json"], "error: x.json: a new scenario is TOML"),
    (["derive", "--latex", "--format", "json"], "error: --latex and --format: expected one of them, got both"),
    (["derive", "--agents", "100000"], "error: agents: expected 1 to 100 for formulas, got 100000"),
    (["derive", "--q", "abc"], "error: --q: expected a number, got 'abc'"),
    (["derive", "guess"], "Invalid value for"),
    (["scenario", "check", "nothing.toml"], "no such file"),
    (["nonsense"], "no command 'nonsense'; commands: predict, compare"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(b[0]) for b in BAD])
def test_wrong_usage_exits_2_with_a_message_and_no_output(arguments, message, tmp_path):
    done = run(*arguments, code=2, cwd=tmp_path)
    assert done.stdout == ""
    assert message in " ".join(done.stderr.split())
    assert list(tmp_path.iterdir()) == []


def test_a_bad_file_names_every_key_and_leaves_no_output(tmp_path):
    (tmp_path / "bad.toml").write_text(
        "[model]\nF = 1\nH = 1\nQ = -1\nR = 0\n[initial]\nP = nan\n[network]\nagents = 3\nsteps = 2\nlink = 7\n"
    )
    done = run("predict", "bad.toml", "--output", "out.csv", code=2, cwd=tmp_path)
    for key in ("model.Q", "model.R", "initial.P", "network.link"):
        assert f"\n  {key}: expected " in done.stderr
    assert not (tmp_path / "out.csv").exists()


def test_no_steady_state_exits_3(tmp_path):
    file = tmp_path / "drift.toml"
    file.write_text("[model]\nF = 2\nH = 0\nQ = 1\nR = 1\n[initial]\nP = 1\n[network]\nagents = 2\nsteps = 2\n")
    done = run("predict", str(file), "--steady", code=3)
    assert done.stderr.startswith("no answer: no steady state: the stand-alone filter does not converge")
    assert done.stdout == ""


def test_a_covariance_beyond_floating_point_is_a_failure_not_a_nan(tmp_path):
    file = tmp_path / "drift.toml"
    file.write_text("[model]\nF = 2\nH = 0\nQ = 1\nR = 1\n[initial]\nP = 1\n[network]\nagents = 2\nsteps = 600\n")
    done = run("predict", str(file), "--format", "json", code=1)
    assert (
        "error: method simplified: the covariance at step 513 is not finite: it grows beyond floating point (link "
        in (done.stderr)
    )
    assert done.stdout == ""


@pytest.mark.skipif(os.geteuid() == 0 and not Path("/proc/self/mem").exists(), reason="root may write anywhere")
def test_an_unwritable_output_is_said_without_traceback(tmp_path):
    done = run("predict", "--output", "/proc/self/nothing.csv", code=2)
    assert "error: cannot write /proc/self/nothing.csv: " in done.stderr


def test_an_existing_file_survives_a_failure(tmp_path):
    target = tmp_path / "kept.csv"
    target.write_text("precious")
    run("predict", "--link", "2", "--output", str(target), code=2)
    assert target.read_text() == "precious"
    run("predict", "--output", str(target))
    assert target.read_text().startswith("method,")


@pytest.mark.parametrize("command", ["predict", "--help", "--version", "scenario schema"])
def test_a_full_or_closed_standard_output_is_a_failure_in_one_line(command):
    for redirect in (">/dev/full", ">&-"):
        done = subprocess.run(
            ["bash", "-c", f"{sys.executable} -m stochfuse {command} {redirect}"],
            capture_output=True,
            text=True,
            env=ENV,
        )
        assert done.returncode == 1
        # A busy machine may have shown progress first.
        (line,) = (line for line in done.stderr.splitlines() if not line.startswith("note: working"))
        assert "standard output" in line


def test_a_closed_pipe_is_quiet():
    command = f"{sys.executable} -m stochfuse predict --link 0:1:0.002 --format csv | head -1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True, env=ENV)
    # a machine that has much else to do is told that it takes a while
    assert (done.returncode, re.sub(r"note: .* so far\n", "", done.stderr)) == (0, "")
    assert done.stdout.startswith("method,")


SIMPLIFIED = ["predict", "cv-2d", "--agents", "500", "--link", "0:1:0.001", "--steps", "5000"]
GENERAL = ["predict", "--method", "general"]
MONTE_CARLO = ["predict", "--method", "monte-carlo", "--runs", "500000", "--workers", "2"]


@pytest.mark.parametrize(
    ("work", "timer", "seconds"),
    [*((SIMPLIFIED, "PROF", s) for s in (0.01, 0.1, 0.3, 1.0)), (GENERAL, "PROF", 1.5), (MONTE_CARLO, "REAL", 2.5)],
)
def test_ctrl_c_is_quiet(work, timer, seconds):
    """After so much processor time of the command line, imports included; where workers do the work, after so long."""
    # again after two more seconds, as a user would: CPython drops an interrupt that hits one of its own callbacks
    name = {"PROF": "SIGPROF", "REAL": "SIGALRM"}[timer]
    code = (
        f"import signal, sys, stochfuse.cli; sys.argv = ['stochfuse', *{work}]\n"
        f"signal.signal(signal.{name}, lambda *_: signal.raise_signal(signal.SIGINT))\n"
        f"signal.setitimer(signal.ITIMER_{timer}, {seconds}, 2.0)\n"
        "stochfuse.cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENV, timeout=120)
    assert (done.returncode, done.stdout) == (130, "")
    assert "Traceback" not in done.stderr.partition("Exception ignored")[0]


def test_completion_knows_commands_and_presets():
    env = {"_STOCHFUSE_COMPLETE": "complete_bash", "COMP_WORDS": "stochfuse predict fcs", "COMP_CWORD": "2"}
    assert "fcs-demo" in run(env=env).stdout


def test_no_command_imports_what_it_does_not_need():
    def imported(*arguments):
        code = f"import sys; sys.argv = ['stochfuse', *{arguments!r}]\ntry:\n    import stochfuse.cli; stochfuse.cli.main()\nexcept SystemExit: pass\nprint(*sys.modules, file=sys.stderr)"
        return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENV).stderr.split())

    for arguments in (["--help"], ["--version"]):
        assert not imported(*arguments) & {"numpy", "scipy", "sympy", "matplotlib", "pydantic"}
    # some versions of Typer import pydantic themselves; ours is the schema's
    assert not imported("predict") & {"scipy", "sympy", "matplotlib", "stochfuse.scenario.schema"}
    assert "scipy" not in imported("derive")


def test_import_of_the_package_is_light():
    code = "import sys, stochfuse; print(*sys.modules)"
    modules = set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split())
    assert not modules & {"numpy", "scipy", "sympy", "pydantic"}
    for name in sf.__all__:
        assert getattr(sf, name) is not None
    with pytest.raises(AttributeError, match="module 'stochfuse' has no attribute 'nothing'"):
        _ = sf.nothing  # type: ignore[attr-defined]


def test_general_method_says_what_it_shows():
    _kept.cache_clear()  # what is known already is not announced
    done = run("predict", "--method", "general", "--steps", "3", "--link", "0.5")
    assert "general formulation (49) of the Local Fusion Graph; exact, 262,144 outcomes" in done.stdout
    assert "0.5   58.333   29.835   25.521" in done.stdout
    assert done.stderr == "note: 262,144 outcomes; about 15 different graphs to carry\n"
    naive = run("predict", "--method", "naive", "--steps", "2", "--link", "1").stdout
    assert "general formulation (49) of naive fusion (42)/(43); exact, 4,096 outcomes" in naive
    assert "12.281" in naive


def test_statistics_over_the_outcomes():
    def shown(name, *more):
        wide = {"COLUMNS": "200"}
        arguments = ("predict", "--method", "general", "--steps", "2", "--link", "0.5", "--statistic", name, *more)
        return run(*arguments, env=wide).stdout

    assert "probability that the variance of x is at most 30" in shown("at-most:30")
    assert "0.9-quantile over the outcomes of the variance of x" in shown("quantile:0.9")
    assert "derivative in µ of the expected variance of x" in shown("derivative")
    assert "standard deviation over the outcomes of the variance of x" in shown("std")
    record = next(csv.DictReader(io.StringIO(shown("at-most:60", "--format", "csv"))))
    assert (record["metric"], float(record["value"])) == ("at-most:60(trace)", pytest.approx(0.75, rel=1e-15))
    result = strict_json(shown("variance", "--format", "json"))
    assert result["statistic"] == "variance"
    assert "bernstein" not in result


def test_json_of_the_general_method_has_the_polynomial():
    result = strict_json(
        run("predict", "--method", "general", "--steps", "2", "--link", "0.3", "--format", "json").stdout
    )
    A = result["bernstein"][1]
    assert len(A) == 13
    assert sum(a * 0.3**c * 0.7 ** (12 - c) for c, a in enumerate(A)) == pytest.approx(
        result["values"][0][1], rel=1e-13
    )
    assert result["meta"]["nature"] == "exact"
    assert result["meta"]["outcomes"] == 4096


def test_monte_carlo_shows_its_error():
    arguments = ("predict", "--method", "monte-carlo", "--link", "0.5", "--steps", "2", "--runs", "400", "--seed", "5")
    table = run(*arguments).stdout
    assert "sampled, 400 runs, seed 5; ± one standard error" in table.replace("\n", " ")
    assert " ±" in table.splitlines()[-1]
    (_, row) = csv.DictReader(io.StringIO(run(*arguments, "--format", "csv").stdout))
    result = strict_json(run(*arguments, "--format", "json").stdout)
    assert float(row["standard_error"]) == result["standard_error"][0][1] > 0
    low, high = result["interval"]["low"][0][1], result["interval"]["high"][0][1]
    assert low < result["values"][0][1] < high
    assert high - low == pytest.approx(2 * 1.96 * result["standard_error"][0][1], rel=1e-4)


def test_compare(tmp_path):
    done = run("compare", "--steps", "2", "--link", "0.25,0.75", "--runs", "100", "--plot", str(tmp_path / "c.png"))
    assert "Δ: difference from general, signed" in done.stdout
    assert "0.25   2    39.379    42.571 +3.19" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert (tmp_path / "c.png").stat().st_size > 10_000
    result = strict_json(run("compare", "--steps", "2", "--methods", "simplified,naive", "--format", "json").stdout)
    assert (result["reference"], list(result["methods"])) == ("simplified", ["simplified", "naive"])


def test_crosscheck_verdict_is_the_exit_code(tmp_path):
    rows = ["run,step,link,covariance", *(f"{r},1,1,33.3333333333\n{r},2,1,21.2121212121" for r in range(20))]
    (tmp_path / "good.csv").write_text("\n".join(rows))
    done = run("crosscheck", str(tmp_path / "good.csv"))
    assert "AGREE (smallest p over 2 cells" in done.stdout.replace("\n", " ")
    (tmp_path / "bad.csv").write_text("\n".join(rows).replace("21.21", "21.61"))
    done = run("crosscheck", str(tmp_path / "bad.csv"), "--format", "json", code=1)
    assert strict_json(done.stdout)["verdict"] == "disagree"
    assert done.stderr.endswith("the results disagree with the prediction\n")
    done = run("crosscheck", str(tmp_path / "good.csv"), "--steps", "1", code=2)
    assert "line 3, column 'step': expected at most the scenario's 1 steps, got 2; see --steps" in done.stderr
    done = run("crosscheck", "-", code=2, input="run,step,link,covariance\n1,1,1.5,3\n")
    assert "line 2, column 'link': expected a probability between 0 and 1, got '1.5'" in done.stderr
    run("crosscheck", "-", "-", code=2, input="")


def test_crosscheck_says_what_would_have_shown():
    """P is 100, 50 or 100/3 with 1/4, 1/2, 1/4: a deviation of 25; 3.2905 of them in 1,000 by chance, 100 runs."""
    done = run("crosscheck", "-", input="link,step,agent,covariance,count\n0.5,1,1,58.4,100\n").stdout
    assert f"would have shown: a cell that is off by {100 * 3.2905 * 2.5 / 58.333:.2g} %\n" in done


def test_agents_go_by_name_too():
    by_name, by_number = (run("predict", "road-5", "--agent", agent, "--at", "last").stdout for agent in ("B", "2"))
    assert by_name == by_number
    assert "; agent 2 (B)\n" in by_name
    refused = run("predict", "road-5", "--agent", "b", code=2).stderr
    assert "a number from 1 to 5, or one of A, B, C, D, E, got 'b'\n" in refused


def test_crosscheck_by_case(tmp_path):
    (tmp_path / "s.toml").write_text(
        "model = {F = 1, H = 1, Q = 25, R = 100}\ninitial = {P = 100}\n"
        "[network]\nagents = 2\nsteps = 2\n[[network.case]]\nname = 'full'\nlink = 1\n[[network.case]]\nname = 'none'\nlink = 0\n"
    )
    text = "run,step,link,covariance\n" + "".join(f"{r},1,none,100\n{r},1,full,50\n" for r in range(3))
    (tmp_path / "r.csv").write_text(text)
    assert "AGREE" in run("crosscheck", str(tmp_path / "r.csv"), str(tmp_path / "s.toml")).stdout
    (tmp_path / "r.csv").write_text(text.replace("none", "nine"))
    done = run("crosscheck", str(tmp_path / "r.csv"), str(tmp_path / "s.toml"), code=2)
    assert "expected a probability between 0 and 1, or a case (full, none), got 'nine'" in done.stderr


def test_graph(tmp_path):
    text = run("graph", "--agent", "3", "--step", "4", "--scenario", "thesis-transient").stdout
    assert text.startswith("agent 3 at step 4 fuses {(2,k4), (3,k4)}\n")
    assert "claimed covariance, variance of x: 23.229" in text
    assert run("graph", "--agent", "3", "--step", "4", "--format", "dot").stdout.startswith(
        'digraph "agent 3 at step 4" {'
    )
    assert len(strict_json(run("graph", "--format", "json").stdout)["fusions"]) == 12
    run("graph", "--agent", "1", "--step", "4", "--plot", str(tmp_path / "g.svg"))
    assert "<svg" in (tmp_path / "g.svg").read_text()
    assert "expected --agent and --step" in run("graph", "--format", "dot", code=2).stderr
    assert "agent: expected a whole number from 1 to 3, got 4" in run("graph", "--agent", "4", code=2).stderr


def test_derive_general():
    text = run("derive", "general", "--agents", "2", "--step", "2", "--q", "25", "--r", "100", "--p0", "100").stdout
    assert "P_2 = -20*mu**3/9 + 120*mu**2/7 - 850*mu/21 + 500/9" in text
    assert strict_json(run("derive", "naive", "--step", "1", "--format", "json").stdout)["method"] == "naive"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("predict", "--agent"), "error: agent: expected mean, worst, best or a number from 1 to 3, got '"),
        (("messages", "--agent"), "error: agent: expected mean or a number from 1 to 3, got '"),
        (("predict", "--at"), "error: --at: expected steps from 1 to 5, or last, got '"),
    ],
)
@pytest.mark.parametrize("number", ["²", "½", "9" * 5000, "0", "-1"])
def test_what_looks_like_a_number_and_is_none_of_ours(words, message, number):
    assert run(*words, number, code=2).stderr == f"{message}{number}'\n"


@pytest.mark.slow
def test_reproduce_timing():
    rows = strict_json(run("reproduce", "timing", "--format", "json").stdout)["rows"]
    assert [row["thesis_s"] for row in rows] == [12_000, 2, None]
    assert all(row["here_s"] > 0 for row in rows)


def test_an_input_is_never_overwritten(tmp_path):
    (tmp_path / "r.csv").write_text("run,step,link,covariance\n1,1,0,100\n2,1,0,100\n")
    run("scenario", "new", "--output", str(tmp_path / "s.toml"))
    for arguments in (
        ["crosscheck", "r.csv", "-o", "r.csv"],
        ["predict", "s.toml", "-o", "s.toml"],
        ["compare", "s.toml", "-o", "s.toml"],
    ):
        before = (tmp_path / arguments[-1]).read_text()
        assert "which it would overwrite" in run(*arguments, code=2, cwd=tmp_path).stderr
        assert (tmp_path / arguments[-1]).read_text() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["predict", "--estimator", "naive", "--method", "simplified"], "--estimator: expected method general or monte-carlo, got simplified"),
        (["predict", "--method", "general", "--runs", "5"], "--runs: expected method monte-carlo, got general"),
        (["predict", "--method", "monte-carlo", "--prune"], "--prune: expected method general or naive, got monte-carlo"),
        (["compare", "--methods", "general,naive", "--seed", "5"], "--seed: expected method monte-carlo, got general, naive"),
        (["crosscheck", "nowhere.csv", "--method", "simplified", "--max-graphs", "5"], "--max-graphs: expected method general or naive, got simplified"),
        (["compare", "fcs-demo"], "general cannot be compared here, leave it out of the methods"),
        (["predict", "road-5", "--steady"], "a steady state needs a model, sensors and links that do not vary with the step"),
        (["predict", "--statistic", "std"], "--statistic std: expected --method general or naive, got simplified"),
        (["predict", "--method", "general", "--statistic", "mode"], "statistic: expected mean, variance, std, quantile:P"),
        (["predict", "--method", "general", "--statistic", "quantile:2"], "statistic: expected mean, variance, std, quantile:P"),
        (["predict", "cv-2d", "--method", "general", "--steps", "2", "--statistic", "derivative"], "derivative: expected metric trace or var:STATE of quantity claimed or actual, or the bias of one state, got 'rms:x,y' of claimed"),
        (["predict", "--method", "general", "--steps", "9"], "more than --max-graphs 100000"),
        (["predict", "--method", "monte-carlo", "--runs", "1"], "Invalid value for '--runs'"),
        (["compare", "--methods", "simplified,guess"], "methods: expected one of simplified, general, chain, optimal, naive, monte-carlo, got 'guess'"),
        (["crosscheck", "nowhere.csv"], "nowhere.csv: no such file"),
        (["graph", "nowhere.toml"], "no such file, and no history of that name (known: thesis-example)"),
        (["derive", "general", "--step", "3"], "too many for a closed form"),
    ],
)  # fmt: skip
def test_bad_requests_to_the_general_formulation(arguments, message):
    done = run(*arguments, code=2)
    assert message in done.stderr
    assert done.stdout == ""
