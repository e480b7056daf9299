"""What reaches the user when something goes wrong that nobody foresaw, and what is said before any work begins."""

from __future__ import annotations

import time

import pytest
from typer.testing import CliRunner

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
    ],
)
def test_what_is_wrong_is_said_before_any_work(words, message):
    began = time.process_time()
    result = run(*words.split())
    assert result.exit_code == 2
    assert message in result.stderr
    assert time.process_time() - began < 2.0
