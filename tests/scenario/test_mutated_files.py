"""Mutated files: whatever is in a scenario or study file, it is read, or refused with a message; nothing else happens."""

from __future__ import annotations

import copy
import json
import math
import random
import re
import tomllib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import stochfuse as sf
from stochfuse.cli.app import app
from stochfuse.scenario.scenario import parse, preset_names, read_text
from stochfuse.studies.evaluation import evaluate
from stochfuse.studies.files import PlanColumns
from stochfuse.studies.reading import load_study

FEW, MANY = 80, 700
"""Examples of a test; two tests each for scenarios and studies."""
MOST_STEPS, MOST_AGENTS = 4, 6
"""What is predicted is cut to that: a scenario may be right and long."""
LONG = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], database=None)
LENGTHS = [FEW, pytest.param(MANY, marks=pytest.mark.slow)]


def each(names: Iterable[str], examples: int, check: Callable[[str, int], None]) -> None:
    """Check so many examples of a name and a seed."""
    drawn = given(st.sampled_from(sorted(names)), st.integers(0, 2**32))
    settings(LONG, max_examples=examples)(drawn(check))()


PRESETS = {name: read_text(name)[1] for name in preset_names()}
SMALL = """
[scenario.model]
F = [[1.0, 1.0], [0.0, 1.0]]
H = [[1.0, 0.0]]
Q = 0.5
R = 4.0
[scenario.initial]
P = [[9.0, 0.0], [0.0, 4.0]]
[scenario.network]
agents = 3
steps = 2
link = 0.5
"""
STUDIES = {
    "grid": f"""
schema = "stochfuse.study/1"
description = "noises and links"
{SMALL}
[vary]
"network.link" = {{ from = 0, to = 1, number = 3 }}
"model.R" = {{ from = 1, to = 1e4, number = 3, scale = "log" }}
method = ["simplified", "general", "optimal"]
[report]
quantity = ["claimed", "messages"]
metric = ["trace", "var:x1"]
agent = "worst"
""",
    "list": f"""
{SMALL}
[vary]
network.agents = [1, 2, 3]
"network.architecture" = ["ad-hoc", "broadcast", "cyclic"]
"model.F" = [[[1, 1], [0, 1]], [[1, 0], [0, 1]], 2]
estimator = ["naive", "covariance-intersection", "stand-alone"]
[design]
kind = "list"
[predict]
method = "general"
criterion = "trace"
max_graphs = 100
prune = false
""",
    "hypercube": f"""
{SMALL}
[vary]
"model.Q" = {{ from = 0, to = 1 }}
"initial.P" = {{ from = 0.1, to = 100, scale = "log" }}
"network.steps" = {{ from = 1, to = 3, whole = true }}
seed = [1, 2]
[design]
kind = "latin-hypercube"
points = 4
seed = 3
[predict]
method = "monte-carlo"
runs = 4
""",
    "preset": """
scenario = "thesis-transient"
[vary]
"network.link" = [0.0, 0.5, 1.0]
"initial.error" = [0, [-1000.0]]
[report]
quantity = ["claimed", "actual", "rms"]
metric = "trace"
""",
}

WORDS = (
    "nan", "inf", "-inf", "1e999", "-1", "0", "1e100", "1e-300", "9223372036854775808", "1" * 400, "0x" + "F" * 4000,
    "true", "[]", "{}", '""', "'x'", '"simplified"', "[[]]", "[[1, 2], [3]]", "1979-05-27", "07:32:00", "\x00", "\ud7ff",
    "é", "²", "٣", "\u202e", "=", "[", "]", "[[", "\\", "'''", "#", ",", ".", "{ from = 1, to = 0, number = 2 }",
    "[" * 200 + "]" * 200, "[[agent]]", "[vary]", "[model]", '"\\ud800"', '"\\u0000"', "\ufeff", "\r", "\t",
    "\n[" + ".".join("a" * 600) + "]\n", "\nnetwork" + ".steps" * 400 + " = 1\n",
)  # fmt: skip
NUMBERS = (
    "0",
    "1",
    "2",
    "3",
    "-1",
    "0.5",
    "1.5",
    "-0.0",
    "1e-12",
    "1e12",
    "1e-300",
    "1e100",
    "7",
    "[1, 2]",
    "[[2]]",
    "[0.5, 0.5]",
)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, 2, -1, 3, 7, 0.5, -0.0, 1.5, 1e-300, 1e100, -1e100, 1e150, 5e-324, math.nan, math.inf,
    -math.inf, 2**31, 2**63, 10**30, 10**400, 16**5000, "", "x", "1", "trace", "det", "std:x", "rms:x1,x2", "var:",
    "messages", "consistency", "bias", "optimal", "general", "naive", "monte-carlo", "blender", "itns", "lwin", "split-ci",
    "cyclic", "broadcast", "shared", "\u202e\n", "\x00", "a" * 500, [], [[]], [[[]]], {}, [0], [1, 2], [[1]], [[1, 2]],
    [[1, 0], [0, 1]], [[1, 2], [2, 1]], [[1, 2], [3]], [[[1, 0], [0, 1]]] * 3, [None], ["x"], ["x", "x"], [[0.5] * 3] * 3,
    [0.5] * 5, [math.nan], [[math.inf]], [1e100, -1e100], [0.0] * 300, [[0.0] * 40] * 40, {"from": 0, "to": 1},
    {"from": 0, "to": 1, "number": 2}, {"from": 1, "to": 0, "number": -1}, {"from": 0, "to": 1, "scale": "log"},
    {"from": 1, "to": 9, "whole": True, "number": 3}, {"from": 1e50, "to": 1e60, "whole": True, "number": 2},
    {"from": math.nan, "to": 10**400, "number": 2}, {"a": {"b": 1}}, {"good_to_bad": 0.1, "bad_to_good": 0.5},
    {"good_to_bad": 0, "bad_to_good": 0}, [{}], [{"H": 1}], [{}, {"R": 2}, {"sensor": False}], [1, "a", None, [2], {}],
)  # fmt: skip
KEYS = (
    "F", "H", "Q", "R", "P", "G", "B", "u", "x", "s", "M", "error", "link", "burst", "case", "delay", "hears", "agents",
    "steps", "states", "units", "own", "position", "sensor", "correlation", "disturbance", "process", "metric", "agent",
    "method", "estimator", "runs", "seed", "prune", "network.link", "model.R", "initial.P", "agent[2].R", "agent[9].R",
    "network.burst.good", "network.case[1].link", "report.metric", ".", "..", "[1]", "a.²", "network", "quantity", "points",
    "from", "to", "number", "scale", "whole", "kind", "criterion", "", "é", "point", "step", "claimed.trace", "noise",
    "architecture", "max_graphs", "navigation", "cooperative", "vary", "schema", "description", "name",
)  # fmt: skip


def mutated_text(pick: random.Random, text: str) -> str:
    """The text after one to three changes of lines and characters."""
    for _ in range(pick.choice((1, 1, 2, 3))):
        lines = text.splitlines(keepends=True) or [""]
        i, j = pick.randrange(len(lines)), pick.randrange(len(lines))
        at = pick.randrange(len(text) + 1)
        match pick.choice((0, 1, 2, 3, 4, 5, 6, 7, 7, 7, 8, 8, 8, 8)):
            case 0:
                lines[i : i + pick.randint(1, 3)] = []
            case 1:
                lines.insert(j, lines[i])
            case 2:
                lines[i], lines[j] = lines[j], lines[i]
            case 3:
                lines.insert(i, pick.choice(WORDS))
            case 4:
                text, lines = text[:at] + pick.choice(WORDS) + text[at:], []
            case 5:
                text, lines = text[:at] + text[at + pick.randint(1, 8) :], []
            case 6:
                text, lines = (
                    text[:at] + chr(pick.choice((pick.randrange(128), pick.randrange(0x2100)))) + text[at + 1 :],
                    [],
                )
            case 7:
                # what is right of an equals sign, the likeliest to be read and wrong
                lines[i] = re.sub(r"=.*", lambda _: f"= {pick.choice(pick.choice((NUMBERS, WORDS)))}", lines[i])
            case _:
                numbers = list(re.finditer(r"\d+(\.\d+)?", text))
                if numbers:
                    found = pick.choice(numbers)
                    text, lines = (
                        text[: found.start()]
                        + pick.choice(pick.choice((NUMBERS, NUMBERS, WORDS)))
                        + text[found.end() :],
                        [],
                    )
        text = "".join(lines) if lines else text
    return text


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every place in a mapping that a value may be put into: its container and key."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else []
    return [entry for key in keys for entry in [(value, key), *places(value[key])]]


def mutated_mapping(pick: random.Random, mapping: dict[str, Any]) -> dict[str, Any]:
    """The mapping after one to three changes of keys and values."""
    mapping = copy.deepcopy(mapping)
    for _ in range(pick.choice((1, 1, 1, 2, 3))):
        entries = places(mapping)
        if not entries:
            break
        numbers = [(c, k) for c, k in entries if isinstance(c[k], int | float) and not isinstance(c[k], bool)]
        if numbers and pick.random() < 0.5:
            container, key = pick.choice(numbers)
            container[key] = pick.choice((0, 1, 2, 3, 0.5, -1, 1e-9, 1e-200, 1e60, 1.0 - 1e-16, 10**9))
            continue
        # keys are few beside the entries of matrices
        named = [entry for entry in entries if isinstance(entry[0], dict)]
        container, key = pick.choice(named if named and pick.random() < 0.7 else entries)
        match pick.randrange(8):
            case 0:
                del container[key]
            case 1 if isinstance(container, dict):
                container[pick.choice(KEYS)] = container.pop(key)
            case 2 if isinstance(container, dict):
                container[pick.choice(KEYS)] = copy.deepcopy(pick.choice(VALUES))
            case 3:
                container[key] = [container[key]] * pick.randint(0, 3)
            case 4 if isinstance(container[key], float):
                container[key] = pick.choice((-1, 0.0, 1e-200, 1e60, 0.5, 1 - 1e-16)) * (1 + container[key])
            case 5:
                other, place = pick.choice(entries)
                container[key] = copy.deepcopy(other[place])
            case _:
                container[key] = copy.deepcopy(pick.choice(VALUES))
    return mapping


def told(error: sf.StochfuseError) -> None:
    """A message for people: of some lines, which name something, and nothing of Python."""
    text = str(error)
    assert len(text) > 8
    assert not re.search(r"Traceback|<class|object at 0x|\bNoneType\b|numpy\.|dtype", text), text


def read_and_predict(source: dict[str, Any] | Callable[[], sf.Scenario]) -> str:
    """Read a scenario, and predict the start of it; what became of it."""
    try:
        scenario = source() if callable(source) else sf.Scenario.from_mapping(source)
    except sf.ScenarioError as error:
        told(error)
        return "refused"
    network, d = scenario.network, scenario.model.dimension
    if network.agents > MOST_AGENTS or d > 8 or not (network.link is None or network.link.ndim < 4):
        return "read"
    short = scenario.until(min(network.steps, MOST_STEPS))
    try:
        found = sf.predict(short, None if network.link is not None or network.cases else [0.5], "simplified")
        assert np.isfinite(found.covariance).all()
    except sf.StochfuseError as error:
        told(error)
        return "no answer"
    return "predicted"


@pytest.mark.parametrize("examples", LENGTHS)
def test_scenario_texts(examples):
    def check(name, seed):
        text = mutated_text(random.Random(seed), PRESETS[name])
        read_and_predict(lambda: sf.Scenario.from_mapping(parse("mine.toml", text), "mine.toml"))

    each(PRESETS, examples, check)


@pytest.mark.parametrize("examples", LENGTHS)
def test_scenario_values(examples):
    def check(name, seed):
        read_and_predict(mutated_mapping(random.Random(seed), tomllib.loads(PRESETS[name])))

    each(PRESETS, examples, check)


def read_and_evaluate(mapping: dict[str, Any]) -> str:
    """Read a study, and evaluate some of its points; what became of it."""
    try:
        plan = load_study(mapping)
    except sf.StochfuseError as error:
        told(error)
        return "refused"
    json.dumps(plan.record)
    longest = [axis for axis in plan.axes if axis.name in ("network.steps", "network.agents", "runs")]
    numbers = [v for axis in longest for v in (axis.given or (axis.high,)) if isinstance(v, int | float)]
    network = plan.example.network
    runs = plan.settings.get("runs", 2) if "monte-carlo" in plan.methods else 2
    if max([network.steps, network.agents, *numbers]) > 12 or max(runs, network.agents**2 * network.steps) > 50:
        return "read"
    points = range(min(plan.size, plan.chunk, 4))
    found = evaluate(plan, points)
    columns = PlanColumns(plan).of(points, found)
    assert all(len(values) == found.rows.sum() for values, _ in columns.values())
    assert len(found.steps) == len(points)
    assert set(found.errors) == {points[i] for i in np.flatnonzero(found.steps == 0)}
    for reason in found.errors.values():
        assert reason
        assert "\n" not in reason
        assert not re.search(r"Error:|Exception:", reason), reason
    fine = np.repeat(found.steps > 0, found.rows)
    errors = np.array([name.endswith(".standard_error") for name in plan.columns])
    assert np.isfinite(found.values[fine][:, ~errors]).all()
    return "evaluated"


@pytest.mark.parametrize("examples", LENGTHS)
def test_study_texts(examples):
    def check(name, seed):
        text = mutated_text(random.Random(seed), STUDIES[name])
        try:
            mapping = parse("mine.toml", text)
        except sf.ScenarioError as error:
            told(error)
            return
        read_and_evaluate(mapping)

    each(STUDIES, examples, check)


@pytest.mark.parametrize("examples", LENGTHS)
def test_study_values(examples):
    def check(name, seed):
        read_and_evaluate(mutated_mapping(random.Random(seed), tomllib.loads(STUDIES[name])))

    each(STUDIES, examples, check)


@pytest.mark.slow
def test_mutations_are_neither_harmless_nor_hopeless():
    """A good share passes the reading, so that what comes after it is tested too."""
    found = [
        read_and_evaluate(mutated_mapping(random.Random(seed), tomllib.loads(STUDIES[name])))
        for name in STUDIES
        for seed in range(40)
    ]
    found += [
        read_and_predict(mutated_mapping(random.Random(seed), tomllib.loads(PRESETS[name])))
        for name in ("thesis-steady", "cv-2d", "parallel-filters", "beacon-map")
        for seed in range(40)
    ]
    counts = {outcome: found.count(outcome) for outcome in set(found)}
    assert counts["refused"] > 100, counts
    assert counts["evaluated"] > 40, counts
    assert counts["predicted"] > 20, counts


@pytest.mark.parametrize("seed", range(16))
def test_the_commands_say_what_is_wrong(seed, tmp_path):
    pick, runner = random.Random(seed), CliRunner()
    scenario, study = tmp_path / "scenario.toml", tmp_path / "study.toml"
    # the small ones, so that those that can be read are quick
    names = ("thesis-transient", "thesis-steady", "cv-2d")
    scenario.write_text(mutated_text(pick, PRESETS[pick.choice(names)]), "utf-8", "surrogatepass")
    study.write_text(mutated_text(pick, STUDIES[pick.choice(("grid", "preset"))]), "utf-8", "surrogatepass")
    for arguments in (
        ["predict", str(scenario)],
        ["messages", str(scenario)],
        ["study", str(study), "-o", str(tmp_path / "result.csv")],
    ):
        done = runner.invoke(app, arguments)
        assert done.exit_code in (0, 1, 2, 3), done.output
        assert done.exception is None or isinstance(done.exception, SystemExit)
        assert "Traceback" not in done.output
        assert done.exit_code == 0 or done.stderr.strip()


DEEP = 3000


@pytest.mark.parametrize("place", ["F", "x", "states"])
@pytest.mark.parametrize("kind", ["table", "list"])
def test_deep_nesting_is_refused(kind, place):
    deep: Any = {} if kind == "table" else []
    for _ in range(DEEP):
        deep = {"a": deep} if kind == "table" else [deep]
    mapping = tomllib.loads(PRESETS["thesis-transient"])
    mapping["model"][place] = deep
    with pytest.raises(sf.ScenarioError, match=r"nested too deeply|model"):
        sf.Scenario.from_mapping(mapping)
    with pytest.raises(sf.ScenarioError, match=r"nested too deeply|vary|model"):
        load_study({"scenario": mapping, "vary": {"network.link": [0.5]}})
    with pytest.raises(sf.ScenarioError, match=r"nested too deeply|vary|model"):
        load_study({"vary": {"model": {place: deep}}})


HOPELESS = [
    ("network", "delay", 1e100),
    ("network", "delay", 10**9),
    ("network", "hears", [1, 2, 3]),
    ("network", "hears", [None, [1], "x"]),
    ("model", "states", [[1]]),
    ("model", "units", [{}]),
    ("network", "agents", 16**6000),
]


@pytest.mark.parametrize(
    ("table", "key", "value"), HOPELESS, ids=lambda value: repr(value)[:20] if not isinstance(value, int) else ""
)
def test_what_took_the_reader_down_once(table, key, value):
    mapping = tomllib.loads(PRESETS["thesis-transient"])
    mapping[table][key] = value
    with pytest.raises(sf.ScenarioError, match=rf"{table}\.{key}.*: expected"):
        sf.Scenario.from_mapping(mapping)


def test_links_of_many_agents_are_not_laid_out():
    mapping = tomllib.loads(PRESETS["thesis-transient"])
    mapping["network"] |= {"agents": 10_000_000, "steps": 2, "link": [0.5, [[0.1]]]}
    with pytest.raises(sf.ScenarioError, match=r"network\.link: expected"):
        sf.Scenario.from_mapping(mapping)


NO_STUDY = [
    ({".": [1]}, r"vary\.\."),
    ({"agent.²": [1]}, r"agent.*: expected a list"),
    ({f"agent[{'1' * 5000}].R": [1]}, "vary"),
    ({"model.R": [1, 10**30, 10**400]}, r"vary\.model\.R"),
    ({"model.R": [1.0, 10**400]}, r"vary\.model\.R"),
    ({"model.R": {"from": 10**400, "to": 1, "number": 2}}, r"vary\.model\.R\.from"),
    ({"model.R": {"from": 1e50, "to": 1e60, "number": 2, "whole": True}}, r"vary\.model\.R"),
    ({"model.R": [1.0, math.nan]}, r"vary\.model\.R"),
]


@pytest.mark.parametrize(("vary", "message"), NO_STUDY, ids=range(len(NO_STUDY)))
def test_what_took_the_reader_of_studies_down_once(vary, message):
    with pytest.raises(sf.ScenarioError, match=message):
        load_study({"scenario": tomllib.loads(SMALL)["scenario"], "vary": vary})


@pytest.mark.parametrize("agent", [0, -1, 4, 99])
def test_an_agent_that_is_not_there(agent):
    with pytest.raises(sf.StochfuseError, match=r"report\.agent"):
        load_study(
            {"scenario": tomllib.loads(SMALL)["scenario"], "vary": {"model.R": [1.0]}, "report": {"agent": agent}}
        )


def test_an_agent_that_some_points_have_fails_the_others_only():
    small = tomllib.loads(SMALL)["scenario"]
    plan = load_study({"scenario": small, "vary": {"network.agents": [3, 1, 3]}, "report": {"agent": 3}})
    found = evaluate(plan, range(3))
    assert list(found.errors) == [1]
    assert "number from 1 to 1" in found.errors[1]
    assert found.steps.tolist() == [2, 0, 2]
