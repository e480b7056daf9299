"""What reaches the user when something goes wrong that nobody foresaw, and what is said before any work begins."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest
from typer.testing import CliRunner

from stochfuse.cli import progress
from stochfuse.cli.app import app
from stochfuse.prediction import predict as predictions


def run(*words):
    return CliRunner().invoke(app, words)


def fault(*_, **__):
    raise ZeroDivisionError("nobody\nforesaw this")


def test_an_unforeseen_error_is_one_line(monkeypatch):
    monkeypatch.setattr(predictions, "predict_several", fault)
    result = run("predict", "--steps", "2")
    assert result.exit_code == 1
    assert result.stderr == "internal error: ZeroDivisionError: nobody foresaw this; --debug shows where\n"
    assert result.stdout == ""


@pytest.mark.parametrize(
    "words", [("--debug", "predict"), ("predict", "--debug"), ("predict", "--steps", "2", "--debug")]
)
def test_debug_shows_where_wherever_it_stands(monkeypatch, words):
    monkeypatch.setattr(predictions, "predict_several", fault)
    result = run(*words)
    assert isinstance(result.exception, ZeroDivisionError)


def test_agents_that_hear_nobody_have_links_of_probability_0(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(
        "[model]\nF=1\nH=1\nQ=1\nR=1\n[initial]\nP=1\n[network]\nagents=2\nsteps=2\nhears=[[],[]]\nlink=0.5\n"
    )
    for form in ("table", "csv", "json", "markdown", "latex"):
        result = run("predict", str(path), "--format", form)
        assert result.exit_code == 0, result.stderr
        assert "nan" not in result.stdout.lower()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("compare --quantity actual --agent 0 --link 0.5", "agent"),
        ("predict --steps 60 --agents 9 --method monte-carlo --agent 20", "agent"),
        ("solve --target 3 --method general --agent 99", "agent"),
        ("predict --method general --metric var:nothing", "no state 'nothing'"),
        ("predict --method general --plot figure.docx", "figure.docx"),
        ("compare --estimator naive,split-ci --agent 7 --link 0.5", "agent"),
        ("messages --accuracy --agent 12", "agent"),
        ("predict --steps 10000000 --link 0:1:0.0001", "10,000,000 steps of 10,001 link probabilities take about"),
        ("compare --steps 10000000 --link 0:1:0.0001", "GB of memory, and this machine has"),
        ("messages --steps 10000000 --link 0:1:0.0001", "or --format csv"),
    ],
)
def test_what_is_wrong_is_said_before_any_work(words, message):
    began = time.process_time()
    result = run(*words.split())
    assert result.exit_code == 2
    assert message in result.stderr
    assert time.process_time() - began < 2.0


@pytest.fixture
def patience(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    # as often as it takes: how long imports and machine need does not matter
    monkeypatch.setattr(progress, "LINES", tuple(0.05 * i for i in range(1, 1200)))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("predict --method general --quantity consistency --steps 4 --link 0.5", "note: step"),
        ("compare --methods monte-carlo,simplified --runs 4000 --link 0.5", "note: "),
        ("predict --steps 20000 --link 0.5 --format csv", "note: step, "),
        ("derive general --agents 3 --step 3 --q 1 --r 1 --p0 1", "note: "),
    ],
)
def test_long_work_gives_signs_of_life(patience, words, said):
    result = run(*words.split())
    assert result.exit_code == 0, result.stderr
    assert said in result.stderr
    assert " s so far" in result.stderr
    assert "so far" not in result.stdout


def test_what_is_quick_says_nothing():
    assert run("predict", "--steps", "2").stderr == ""


def test_ctrl_c_ends_long_work_within_a_second():
    words = [sys.executable, "-m", "stochfuse", "compare", "--quantity", "consistency"]
    work = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    time.sleep(2)
    start = time.monotonic()
    work.send_signal(signal.SIGINT)
    _, stderr = work.communicate(timeout=10)
    assert time.monotonic() - start < 1.5
    assert work.returncode == 130
    assert stderr.splitlines()[-1] == "interrupted"
