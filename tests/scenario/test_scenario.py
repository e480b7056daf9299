"""Scenario files: what is read, and the message for everything that does not fit."""

from __future__ import annotations

import copy
import json
import re

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario.scenario import parse, preset_names, read_text
from stochfuse.scenario.schema import structure_problems

GOOD = {
    "schema": "stochfuse.scenario/1",
    "model": {
        "F": [[1, 1], [0, 1]],
        "H": [[1, 0]],
        "Q": [[1, 0], [0, 1]],
        "R": 4,
        "states": ["x", "v"],
        "units": ["m", "m/s"],
    },
    "initial": {"P": [[9, 0], [0, 4]], "correlation": "shared", "error": [1, 2]},
    "network": {"agents": 3, "steps": 2, "architecture": "broadcast", "link": 0.5, "delay": 0},
}


def changed(path, value):
    mapping = copy.deepcopy(GOOD)
    *tables, key = path.split(".")
    table = mapping
    for name in tables:
        table = table[name]
    if value is None:
        del table[key]
    else:
        table[key] = value
    return mapping


def test_a_good_mapping_is_read_whole():
    s = sf.Scenario.from_mapping(GOOD, "mine")
    assert (s.name, s.correlation, s.network.architecture) == ("mine", "shared", "broadcast")
    assert s.model.states == ("x", "v")
    assert s.error is not None
    assert s.error.ravel().tolist() == [1, 2]
    assert s.sensors[0].R.tolist() == [[4]]
    assert s.to_mapping() == GOOD


def test_arrays_are_frozen():
    s = sf.load_scenario("cv-2d")
    for array in (s.model.F, s.P0, s.sensors[0].H, s.sensors[0].R):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 7.0
    with pytest.raises(AttributeError):
        s.name = "other"  # type: ignore[misc]


NAN = float("nan")
BAD = [
    ("model.F", None, "model.F: expected a value, got nothing"),
    ("model.Z", 3, "model.Z: expected a known key, got an unknown one, 'Z'"),
    ("colour", 3, "colour: expected a known key, got an unknown one, 'colour'"),
    ("schema", "other/2", "schema: expected one of \"stochfuse.scenario/1\", got 'other/2'"),
    ("model", 5, "model: expected a table, got 5"),
    (
        "model.F",
        "fast",
        "model.F: expected a number or a matrix (a list of rows), or one such matrix per step, got 'fast'",
    ),
    (
        "model.F",
        [1, 2],
        "model.F: expected a number or a matrix (a list of rows), or one such matrix per step, got [1, 2]",
    ),
    (
        "model.F",
        [[1, 2], [3]],
        "model.F: expected a number or a matrix (a list of rows), or one such matrix per step, got [[1, 2], [3]] (rows of",
    ),
    ("model.F", [[1, 2, 3], [4, 5, 6]], "model.F: expected a square matrix, got a 2×3 matrix"),
    (
        "model.F",
        [[1, NAN], [0, 1]],
        "model.F: expected a number or a matrix (a list of rows), or one such matrix per step, got a value that is not finite",
    ),
    ("model.F", [[[1, 0], [0, 1]]], "model.F: expected one matrix for each of the 2 steps, got 1 matrices"),
    (
        "model.H",
        [[1, 0, 0]],
        "model.H: expected a number or a matrix with 2 columns (a list of rows), or one such matrix per step, got a 1×3 matrix",
    ),
    (
        "model.Q",
        [[1]],
        "model.Q: expected a number or a 2×2 matrix (a list of rows), or one such matrix per step, got a 1×1 matrix",
    ),
    (
        "model.Q",
        [[1, 2], [2, 1]],
        "model.Q: expected a symmetric positive semi-definite matrix, got an indefinite one (smallest eigenvalue, scaled to unit variances, -1)",
    ),
    (
        "model.Q",
        [[1, 0.5], [0, 1]],
        "model.Q: expected a symmetric positive semi-definite matrix, got an asymmetric one",
    ),
    (
        "model.Q",
        -1,
        "model.Q: expected a symmetric positive semi-definite matrix, got a variance of -1 on the diagonal",
    ),
    ("model.R", 0, "model.R: expected a symmetric positive definite matrix, got a variance of 0 on the diagonal"),
    (
        "model.R",
        float("inf"),
        "model.R: expected a number or a 1×1 matrix (a list of rows), or one such matrix per step, got a value that is not finite (NaN or infinity)",
    ),
    ("model.R", True, "model.R: expected a number or a matrix (a list of rows), or one such matrix per step, got True"),
    ("model.u", [1], "model.B: expected an input matrix, since model.u is given, got nothing"),
    ("model.states", ["x"], "model.states: expected 2 names, one per state, got 1"),
    ("model.states", ["x", "x"], "model.states: expected different names, got ['x', 'x']"),
    ("model.units", ["m", "s", "kg"], "model.units: expected 2 names, one per state, got 3"),
    ("initial.P", None, "initial.P: expected a value, got nothing"),
    (
        "initial.P",
        [[1, 0], [0, -1]],
        "initial.P: expected a symmetric positive semi-definite matrix, got a variance of -1 on the diagonal",
    ),
    (
        "initial.P",
        [[[1, 0], [0, 1]]] * 2,
        "initial.P: expected a number or a 2×2 matrix (a list of rows), got [[[1, 0]",
    ),
    ("initial.correlation", "some", 'initial.correlation: expected one of "independent", "shared", got \'some\''),
    ("initial.error", [1], "initial.error: expected a list of 2 numbers, got [1]"),
    ("initial.x", [1, 2, 3], "initial.x: expected a list of 2 numbers, got [1, 2, 3]"),
    ("network.agents", 0, "network.agents: expected a whole number of at least 1, got 0"),
    ("network.agents", 2.5, "network.agents: expected a whole number, got 2.5"),
    ("network.steps", "five", "network.steps: expected a whole number, got 'five'"),
    (
        "network.architecture",
        "star",
        'network.architecture: expected one of "ad-hoc", "broadcast", "cyclic", got \'star\'',
    ),
    ("network.link", 1.5, "network.link: expected probabilities between 0 and 1, got 1.5"),
    ("network.link", -0.1, "network.link: expected probabilities between 0 and 1, got -0.1"),
    ("network.link", NAN, "network.link: expected a probability, a 3×3 matrix"),
    (
        "network.link",
        [0.5],
        "network.link: expected a probability, a 3×3 matrix of them (row: receiver, column: sender), or one of either for each of the 2 steps, got 1 entries",
    ),
    (
        "network.link",
        [[0, 1], [1, 0]],
        "network.link: expected a probability, a 3×3 matrix of them (row: receiver, column: sender), or one of either for each of the 2 steps, got an array of 2×2",
    ),
    (
        "network.link",
        "high",
        "network.link: expected a probability, a matrix of them, or one of either per step, got 'high'",
    ),
    ("network.link", [[0, 0.2, 0.3], [0.1, 0, 0.3], [0.1, 0.2, 0]], None),
    (
        "network.link",
        [[0, 0.9, 0.3], [0.1, 0, 0.3], [0.1, 0.2, 0]],
        "network.link: expected equal probabilities in each column (a broadcast is heard by all or by none), got unequal ones",
    ),
    (
        "network.delay",
        -1,
        "network.delay: expected a whole number of steps, or the probabilities of 0, 1, 2 … steps, got -1",
    ),
    (
        "network.delay",
        [0.5, 0.4],
        "network.delay: expected probabilities of 0, 1, 2 … steps that sum to 1, got [0.5, 0.4]",
    ),
    ("network.case", [{"name": "a", "link": 2}], "network.case[1].link: expected probabilities between 0 and 1, got 2"),
    ("network.case", [{"link": 0.2}], "network.case[1].name: expected a value, got nothing"),
    ("agent", [{}], "agent: expected one [[agent]] table for each of the 3 agents, got 1"),
    ("agent", [{}, {"R": 0}, {}], "agent[2].R: expected a symmetric positive definite matrix, got a variance of 0"),
    (
        "agent",
        [{}, {"H": [[1, 0], [0, 1]]}, {}],
        "agent[2].R: expected a 2×2 matrix, to go with its own H, got nothing",
    ),
    ("agent", [{}, {"Z": 1}, {}], "agent[2].Z: expected a known key, got an unknown one, 'Z'"),
    ("report", {"metric": 3}, "report.metric: expected text, got 3"),
    (
        "report",
        {"metric": "std:z"},
        "report.metric: expected a metric of this model, got 'std:z' (metric 'std:z': no state 'z'",
    ),
    ("network.agents", 10**30, "network.agents: expected at most 10000000, got 1000000"),
    ("model.R", 1e200, "model.R: expected numbers of at most 1e+100 in size, got 1e+200"),
    ("model.R", 10**400, "model.R: expected"),
    (
        "model.states",
        ["x", "a:b"],
        "model.states[2]: expected printable text, not empty, without comma and colon, got 'a:b'",
    ),
    ("model.units", ["m", "a\nb"], "model.units[2]: expected printable text, got 'a\\nb'"),
    ("network.case", [{"name": "a"}, {"name": "a"}], "network.case[2].name: expected a name of its own, got 'a'"),
]


@pytest.mark.parametrize(("path", "value", "message"), BAD, ids=[f"{b[0]}={str(b[1])[:30]}" for b in BAD])
def test_each_kind_of_mistake_has_its_message(path, value, message):
    mapping = changed(path, value)
    if message is None:
        sf.Scenario.from_mapping(mapping)
        return
    with pytest.raises(sf.ScenarioError, match=re.escape(message)):
        sf.Scenario.from_mapping(mapping, "mine")


def test_one_message_names_every_offending_key():
    mapping = changed("model.R", -1)
    mapping["model"]["colour"] = 1
    mapping["initial"]["P"] = "big"
    mapping["network"] |= {"link": 2, "agents": 3}
    with pytest.raises(sf.ScenarioError) as caught:
        sf.Scenario.from_mapping(mapping, "mine")
    assert [p.path for p in caught.value.problems] == ["model.colour", "initial.P", "network.link", "model.R"]
    assert str(caught.value).startswith("mine:\n  model.colour: ")
    assert str(caught.value).count("\n") == 4


@pytest.mark.parametrize("value", [[], "text", 3, None])
def test_not_even_a_table(value):
    with pytest.raises(sf.ScenarioError, match="expected a table"):
        sf.Scenario.from_mapping(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty; see `stochfuse scenario new`"),
        ("[model\nF = 1", r"not valid TOML: .*\(at line 1, column 7\)"),
        ("[model]\nF = 1\nF = 2", "not valid TOML: Cannot overwrite a value"),
        ("[]", "not valid TOML"),
        ('{"model": 1,}', r"not valid JSON: .* line 1 column"),
        ("{" + '"a":{' * 100_000, "not valid JSON|nested too deeply"),
    ],
)
def test_malformed_files_name_the_place(tmp_path, text, message):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(sf.ScenarioError, match=message):
        sf.load_scenario(file)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(
        sf.ScenarioError, match=r"nothing.toml: no such file, and no preset of that name \(presets: beacon-map"
    ):
        sf.load_scenario(tmp_path / "nothing.toml")
    with pytest.raises(sf.ScenarioError, match="cannot be read: Is a directory"):
        sf.load_scenario(tmp_path)
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(sf.ScenarioError, match=r"not a text file in UTF-8 \(byte 0\)"):
        sf.load_scenario(tmp_path / "binary")


@pytest.mark.parametrize("name", preset_names())
def test_presets_pass_the_check_that_their_loading_skips_and_survive_json(name, tmp_path):
    mapping = parse(*read_text(name))
    assert structure_problems(mapping) == []
    loaded = sf.load_scenario(name)
    file = tmp_path / "again.json"
    file.write_text(json.dumps(loaded.to_mapping()))
    again = sf.load_scenario(file)
    assert again.to_mapping() == loaded.to_mapping()
    few = min(loaded.network.steps, 4)
    np.testing.assert_array_equal(sf.predict(again.until(few)).covariance, sf.predict(loaded.until(few)).covariance)


def test_a_name_that_cannot_be_printed_is_told_in_one_line():
    with pytest.raises(sf.ScenarioError, match=r"^'a\\nb': no such file, and no preset of that name"):
        sf.load_scenario("a\nb")


def test_overrides_take_the_place_of_keys():
    s = sf.load_scenario("thesis-transient", agents=5, steps=7, architecture="cyclic", q=1.0, r=2.0, p0=3.0)
    assert (s.network.agents, s.network.steps, s.network.architecture) == (5, 7, "cyclic")
    assert (s.model.Q.item(), s.sensors[0].R.item(), s.P0.item()) == (1, 2, 3)
    many = sf.load_scenario("cv-2d", r=2.0)
    assert many.sensors[0].R.tolist() == [[2, 0], [0, 2]]
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        sf.load_scenario(colour=1)
    with pytest.raises(sf.ScenarioError, match=r"network.link: expected .* a 4×4 matrix .* got an array of 10×10"):
        sf.load_scenario("fcs-demo", agents=4)
    assert sf.load_scenario("fcs-demo", agents=4, uniform_link=True).network.agents == 4


def test_a_number_is_that_multiple_of_the_identity():
    s = sf.Scenario.from_mapping(changed("model.Q", 2.5))
    assert s.model.Q.tolist() == [[2.5, 0], [0, 2.5]]


def test_a_tiny_asymmetry_from_printing_is_mended():
    s = sf.Scenario.from_mapping(changed("initial.P", [[1, 0.3333333333], [0.33333333333, 1]]))
    np.testing.assert_array_equal(s.P0, s.P0.T)


@pytest.mark.parametrize("agents", [[{"R": 2.0}, {"R": 5.0}], [{"R": 2.0}, {"sensor": False}]])
def test_r_is_of_agents_without_their_own(agents):
    source = {"model": {"F": 1, "H": 1, "Q": 1, "R": 1}, "initial": {"P": 4}, "network": {"agents": 2, "steps": 3}}
    with pytest.raises(sf.UsageError, match=r"r: expected a sensor of the model .* got agents with their own alone"):
        sf.load_scenario({**source, "agent": agents}, r=7.0)
    other = sf.load_scenario({**source, "agent": [agents[0], {}]}, r=7.0)
    assert other.sensors[other.sensor_of[1]].R == 7.0
