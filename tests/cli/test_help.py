"""What one meets before anything is computed: help, first lines, words, names that are nearly right, a new scenario."""

from __future__ import annotations

import shlex
from importlib import import_module

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.cli.app import COMMANDS
from stochfuse.cli.options import completed, presets
from stochfuse.report.citations import BIBTEX
from stochfuse.report.explanations import explanations
from stochfuse.scenario import registry
from tests.cli.command import run, strict_json

PLAIN = [name for name in COMMANDS if name != "scenario"]
EVERY = [(name,) for name in PLAIN] + [("scenario", name) for name in ("list", "show", "check", "schema", "new")]


@pytest.mark.parametrize("command", EVERY, ids=" ".join)
def test_help_is_short_and_whole(command):
    lines = run(*command, "--help", env={"COLUMNS": "80"}).stdout.splitlines()
    assert len(lines) < 60
    assert max(map(len, lines)) <= 80
    assert not any(line.endswith("...") for line in lines[1:] if "WORD" not in line)


@pytest.mark.parametrize("command", PLAIN)
def test_two_examples_come_first(command):
    lines = run(command, "--help").stdout.splitlines()
    assert lines[2] == "Examples:"
    assert all(line.startswith(f"  stochfuse {command}") for line in lines[3:5])


def test_rare_options_are_under_help_all():
    short, long = run("predict", "--help").stdout, run("predict", "--help-all").stdout
    for flag in ("--prune", "--digits", "--workers", "--normalise"):
        assert flag not in short
        assert flag in long
    assert "Show 10 more options" in short
    assert short.count("\n") < long.count("\n")


def test_every_option_stands_in_a_panel():
    for command in ("predict", "compare", "solve", "messages", "crosscheck"):
        text = run(command, "--help-all").stdout
        for panel in ("Scenario:", "Network:", "What is shown:", "How it is worked out:", "Output:"):
            assert f"\n{panel}\n" in text, (command, panel)


LONG = ("stochfuse reproduce figure-32 --plot figure-32.png",)
RUN = [
    pytest.param(example, marks=pytest.mark.slow) if example in LONG else example
    for name in PLAIN
    for example in import_module(f"stochfuse.cli.{name}").EXAMPLES
    if not any(word in example for word in (".toml", ".csv", "means.json", "--data"))
]


@pytest.mark.parametrize("example", RUN)
def test_examples_run(example, tmp_path):
    run(*shlex.split(example)[1:], cwd=tmp_path)


def test_alone_it_gets_one_started():
    lines = run().stdout.splitlines()
    assert len(lines) == 5
    for line in lines[1:]:
        assert line.startswith("  stochfuse ")


@pytest.mark.parametrize(
    ("words", "nearest"),
    [
        ("predict --method generl", "general"),
        ("predict --estimator split-cii", "split-ci"),
        ("predict --quantity claimd", "claimed"),
        ("predict --architecture adhoc", "ad-hoc"),
        ("predict thesis-transit", "thesis-transient"),
        ("predict --metric tarce", "trace"),
        ("predict cv-2d --metric rms:xx,y", "x"),
        ("compare --methods simplfied", "simplified"),
        ("compare --estimator naiv,split-ci", "naive"),
        ("explain pedigre", "pedigree"),
        ("reproduce figure-322", "figure-32"),
        ("predct", "predict"),
    ],
)
def test_a_wrong_name_is_answered_with_the_nearest(words, nearest):
    stderr = run(*words.split(), code=2).stderr
    assert "id you mean" in stderr
    assert nearest in stderr.partition("id you mean")[2]


def test_a_wrong_option_is_answered_with_those_that_are_near():
    assert "--steps" in run("predict", "--stepz", "3", code=2).stderr


def test_a_misspelt_key_of_a_scenario_is_answered_with_the_nearest(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("[model]\nF=1\nH=1\nQ=1\nR=1\n[initial]\nP=1\n[network]\nagnets=2\nsteps=2\n")
    assert "did you mean 'agents'?" in run("scenario", "check", path, code=2).stderr


def test_shells_complete_names():
    assert completed(presets)("thesis-t") == ["thesis-transient"]
    assert completed(registry.QUANTITIES)("claimed,act") == ["claimed,actual"]


@pytest.mark.parametrize("word", sorted(explanations()))
def test_every_word_is_explained(word):
    text = run("explain", *word.split()).stdout
    assert text.startswith(word)
    assert text.rstrip().endswith(".")
    found = strict_json(run("explain", *word.split(), "--format", "json").stdout)
    assert found["explanations"][0]["word"] == word


def test_words_that_outputs_use_can_be_explained():
    known = explanations()
    for name in (*registry.ESTIMATORS, *registry.METHODS, *registry.QUANTITIES, *registry.NATURES):
        assert name in known


def test_doctor_says_what_is_missing_and_how_to_get_it(monkeypatch):
    from stochfuse.cli import doctor

    have = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "matplotlib" else have(name) or "1.0")
    out = run("doctor").stdout
    assert "pip install 'stochfuse[plot]'" in out
    assert sf.__version__ in out
    found = strict_json(run("doctor", "--format", "json").stdout)
    assert {p["package"] for p in found["packages"] if p["version"] == "missing"} == {"matplotlib"}


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        ("--cite", {"stochfuse", "martin2005"}),
        ("predict --estimator split-ci --cite", {"stochfuse", "martin2005", "julier2004"}),
        ("compare --cite --estimator=blender,itns", {"stochfuse", "martin2005", "layh2017", "li2021"}),
        ("compare --estimator all --cite", set(BIBTEX)),
    ],
)
def test_sources_are_cited(words, keys):
    out = run(*words.split()).stdout
    assert {line.partition("{")[2].rstrip(",") for line in out.splitlines() if line.startswith("@")} == keys
    assert out.count("{") == out.count("}")


@pytest.mark.parametrize(
    "flags",
    [
        "--agents 5 --link 0.7",
        "--model constant-velocity --axes 2 --sigma 30 --noise 0.5 --unit km --steps 4",
        "--model random-walk --axes 3 --architecture cyclic",
    ],
)
def test_a_new_scenario_runs_and_is_what_was_asked_for(flags, tmp_path):
    path = tmp_path / "new.toml"
    run("scenario", "new", *flags.split(), "--output", path)
    assert "#" in path.read_text()
    asked = dict(zip(flags.split()[::2], flags.split()[1::2], strict=True))
    s = sf.load_scenario(path)
    assert s.network.agents == int(asked.get("--agents", 3))
    assert s.network.steps == int(asked.get("--steps", 10))
    d = int(asked.get("--axes", 1)) * (2 if "constant-velocity" in flags else 1)
    assert s.model.dimension == d
    run("predict", path, "--steps", "2")
    run("scenario", "new", *flags.split(), "--output", path, code=2)  # never overwritten


def test_steps_are_picked():
    full, some = (strict_json(run("predict", "--format", "json", *at).stdout) for at in ((), ("--at", "last,2")))
    assert some["steps"] == [2, 5]
    assert some["values"] == [[row[1], row[4]] for row in full["values"]]
    header = run("predict", "--at", "1,last").stdout.splitlines()[4]
    assert header.split() == ["µ", "k=1", "k=5"]
    assert "--at: expected steps from 1 to 5, or last, got '6'" in run("predict", "--at", "6", code=2).stderr


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_a_new_scenario_moves_alike_in_every_direction(tmp_path, axes):
    path = str(tmp_path / "s.toml")
    run("scenario", "new", "--model", "constant-velocity", "--axes", str(axes), "--noise", "0.5", "--output", path)
    model = sf.load_scenario(path).model
    each = 0.25 * np.array([[0.25, 0.5], [0.5, 1.0]])  # of an acceleration that stands for a step
    np.testing.assert_allclose(model.Q, np.kron(np.eye(axes), each), rtol=1e-15)
    np.testing.assert_array_equal(model.F, np.kron(np.eye(axes), [[1.0, 1.0], [0.0, 1.0]]))
