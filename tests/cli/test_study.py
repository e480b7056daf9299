"""`stochfuse study` as a user meets it."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys

import pytest

from tests.cli.command import run, strict_json

STUDY = """
scenario = "thesis-transient"
[vary]
"network.link" = [0, 0.5, 1]
"model.R" = [1, 100, 0]
"network.agents" = [2, 3]
[report]
quantity = ["claimed", "messages"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("study")
    (made / "trade.toml").write_text(STUDY)
    return made


def trade(folder, *arguments, **settings):
    return run("study", str(folder / "trade.toml"), *arguments, **settings)


def test_a_study_writes_its_result_and_says_what_it_is(folder):
    done = trade(folder)
    assert done.stdout.startswith(
        "Study trade.toml: grid of 18 points over network.link (3), model.R (3),\nnetwork.agents (2)\n"
        "Scenario thesis-transient; covariance averaged over the agents\n"
        "trade.parquet: 66 rows, 6 points failed"
    )
    assert done.stderr.startswith(
        "warning: 6 of 18 points failed; the first, point 4: model.R: expected a symmetric positive definite matrix, "
    )
    assert (folder / "trade.parquet").exists()
    out = strict_json(trade(folder, "--format", "json").stdout)
    assert out["schema"] == "stochfuse.study-summary/1"
    assert trade(folder, "--format", "csv").stdout.startswith("study,points,rows,failed,column,label,extreme,value")


def test_the_front_in_every_format_and_as_a_figure(folder, tmp_path):
    out = strict_json(trade(folder, "--pareto", "--where", "model.R=100", "--format", "json").stdout)
    assert (out["schema"], out["where"], out["compared"]) == ("stochfuse.pareto/1", {"model.R": 100}, 6)
    loads = [point["load"] for point in out["front"]]
    values = [point["accuracy"] for point in out["front"]]
    assert loads == sorted(loads)
    assert values == sorted(values, reverse=True)
    done = trade(folder, "--pareto", "--plot", str(tmp_path / "front.png"))
    assert "no point does better in both" in " ".join(done.stdout.split())
    assert (tmp_path / "front.png").stat().st_size > 10_000
    assert trade(folder, "--pareto", "--format", "latex").stdout.count("tabular") == 2


@pytest.mark.parametrize("kind", ["heat", "contour"])
def test_a_column_over_two_keys(folder, tmp_path, kind):
    keys = ("--over", "network.link,model.R", "--where", "network.agents=3", "--kind", kind)
    trade(folder, "--plot", str(tmp_path / "map.svg"), "--column", "claimed.trace", "--step", "3", *keys)
    assert "link probability" in (tmp_path / "map.svg").read_text() or (tmp_path / "map.svg").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--over", "model.R"], "error: --over: expected --plot without --pareto"),
        (["--where", "model.R=1"], "error: --where: expected --plot or --pareto"),
        (["--step", "2"], "error: --step: expected --plot or --pareto"),
        (["--column", "claimed.trace"], "error: --column: expected --plot or --pareto"),
        (["--kind", "heat", "--pareto"], "error: --kind: expected --plot without --pareto"),
        (["--pareto", "--where", "model.R=1", "--where", "model.R=0"], "error: --where: expected each key once, got"),
        (["--pareto", "--where", "model.R"], "error: --where: expected KEY=VALUE, got 'model.R'"),
        (["--pareto", "--where", "model.R=7"], "error: --where model.R: expected 0 or 1 or 100, got 7"),
        (["--pareto", "--where", "model.S=7"], "error: --where: expected a key that varies (network.link, model.R, "),
        (["--pareto", "--column", "x"], "error: column: expected claimed.trace, got x"),
        (["--plot", "x.png"], "error: network.agents takes 2 values (2, 3): fix it with --where network.agents=2"),
        (["--plot", "x.gif"], "error: x.gif: expected a name that ends in .png, .svg, .pdf"),
        (["--output", "x.json"], "error: --output x.json: expected a name that ends in .parquet or .csv"),
        (["--output", "nowhere/x.csv"], "error: cannot write nowhere/x.csv: there is no directory nowhere"),
        (["--dask", "tcp://127.0.0.1:1", "--workers", "2"], "error: --workers: expected nothing with --dask, whose"),
    ],
)
def test_wrong_usage(folder, arguments, message, tmp_path):
    done = trade(folder, *arguments, code=2)
    assert done.stdout == ""
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_a_changed_study_is_refused(folder, tmp_path):
    (tmp_path / "trade.toml").write_text(STUDY)
    trade(tmp_path, "--output", str(tmp_path / "r.csv"))
    (tmp_path / "trade.toml").write_text(STUDY.replace("[1, 100, 0]", "[1, 100]"))
    done = trade(tmp_path, "--output", str(tmp_path / "r.csv"), code=2)
    assert "vary.model.R was [1, 100, 0] and is [1, 100]; begin anew with --restart" in done.stderr
    trade(tmp_path, "--output", str(tmp_path / "r.csv"), "--restart")
    assert len((tmp_path / "r.csv").read_text().splitlines()) == 61


def test_a_study_without_messages_has_no_front(tmp_path):
    (tmp_path / "trade.toml").write_text(STUDY.replace(', "messages"', ""))
    done = trade(tmp_path, "--pareto", code=2)
    assert "report.quantity: expected messages among them for --pareto, got claimed" in done.stderr


def test_the_schema_of_a_study():
    schema = json.loads(run("scenario", "schema", "--study").stdout)
    assert schema["title"] == "stochfuse study"
    assert set(schema["properties"]) >= {"scenario", "vary", "design", "predict", "report"}


@pytest.mark.slow
def test_a_terminal_shows_a_bar_with_rate_and_remaining_time(tmp_path):
    """The bar goes to standard error, and leaves nothing behind."""
    many = STUDY.replace("[0, 0.5, 1]", "{from = 0, to = 1, number = 10_000}")
    (tmp_path / "trade.toml").write_text(many)
    master, terminal = pty.openpty()
    command = [sys.executable, "-m", "stochfuse", "study", str(tmp_path / "trade.toml"), "--format", "csv"]
    env = {**os.environ, "COLUMNS": "80", "TERM": "xterm"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=terminal, env=env) as process:
        os.close(terminal)
        seen = b""
        while True:
            try:
                piece = os.read(master, 65536)
            except OSError:
                break
            if not piece:
                break
            seen += piece
        assert process.stdout.read().startswith(b"study,")
        assert process.wait() == 0
    os.close(master)
    text = seen.decode()
    assert "computing" in text
    assert "/60000" in text
    assert "/s" in text
