"""What is wrong with a record is told first; honest records are hardly ever accused."""

from __future__ import annotations

import copy
import math
import re
from functools import cache

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.innovations import Supposition, innovations, setting_of
from stochfuse.data.simulate import Draws
from stochfuse.data.suspicions import suspicions
from stochfuse.scenario.scenario import link_rows
from tests.cli.command import run as command
from tests.cli.command import strict_json

PRESETS = {
    "two-radars": ({"steps": 60}, 1, [0.5]),
    "cv-2d": ({"steps": 30}, 1, [0.5]),
    "thesis-steady": ({"steps": 40}, 3, [0.5]),
    "road-5": ({}, 3, None),
    "cooperative-pnt": ({}, 3, [0.5]),
}


@cache
def scenario(name):
    return sf.load_scenario(name, **PRESETS[name][0])


def drawn(name, seed=1):
    _, runs, link = PRESETS[name]
    s = scenario(name)
    return next(Draws(s, tuple(map(str, range(runs))), link_rows(s, link), seed).batches())


def told(name, batch, s=None):
    s = s or scenario(name)
    return suspicions(s, batch, np.arange(s.model.dimension))


def altered(agent, component, f):
    """Change a component of what an agent (None: each) measured."""

    def spoil(batch):
        z = [each.copy() for each in batch.z]
        for i in range(len(z)) if agent is None else [agent - 1]:
            z[i][..., component] = f(z[i][..., component])
        return batch._replace(z=tuple(z))

    return spoil


def moved(agent, by):
    """Write down what an agent measured some steps later."""

    def spoil(batch):
        z, missed, i = list(batch.z), batch.missed.copy(), agent - 1
        z[i], missed[:, :, i] = np.roll(z[i], by, axis=1), np.roll(missed[:, :, i], by, axis=1)
        missed[:, by, i] = True
        missed[:, 0] = False
        return batch._replace(z=tuple(z), missed=missed)

    return spoil


def swapped(i, j):
    def spoil(batch):
        z, missed = list(batch.z), batch.missed.copy()
        z[i - 1], z[j - 1] = z[j - 1], z[i - 1]
        missed[:, :, [i - 1, j - 1]] = missed[:, :, [j - 1, i - 1]]
        return batch._replace(z=tuple(z), missed=missed)

    return spoil


def of_truth(f):
    return lambda batch: batch._replace(truth=f(batch.truth))


def later(truth):
    return np.concatenate([np.full_like(truth[:, :1], np.nan), truth[:, :-1]], axis=1)


def earlier(truth):
    return np.concatenate([truth[:, 1:], np.full_like(truth[:, :1], np.nan)], axis=1)


BOTH = slice(None)
SPOILT = [
    ("two-radars", altered(2, 1, np.rad2deg), "degrees", 2, r"agent 2: z2 in degrees, not radians would explain it \(NIS of one joint filter"),
    ("two-radars", altered(None, 1, np.rad2deg), "degrees", None, "all agents: z2 in degrees"),
    ("two-radars", altered(1, 0, lambda z: z / 1000), "kilometres", 1, "agent 1: z1 in kilometres, not metres"),
    ("two-radars", altered(None, 0, lambda z: z / 1000), "kilometres", None, "all agents: z1 in kilometres"),
    ("two-radars", altered(1, 1, lambda z: -z), "sign", 1, "agent 1: z2 of the wrong sign"),
    ("two-radars", altered(1, 1, lambda z: np.pi / 2 - z), "compass", 1, "agent 1: z2 counted clockwise"),
    ("two-radars", altered(1, 0, lambda z: z + 100), "bias", 1, r"agent 1: a bias of z1 by (8\d|9\d|1[01]\d) m"),
    ("two-radars", altered(2, 1, lambda z: z + 0.1), "bias", 2, r"agent 2: a bias of z2 by 0\.(09|10|1)\d* rad"),
    ("two-radars", altered(2, BOTH, lambda z: z[..., ::-1]), "components-swapped", 2, "z1 and z2 in each other's"),
    ("two-radars", swapped(1, 2), "agents-swapped", 1, "agents 1 and 2 in each other's place"),
    ("two-radars", of_truth(later), "truth-late", None, "the truth: its states one step late"),
    ("cv-2d", altered(2, BOTH, lambda z: z / 1000), "kilometres", 2, "agent 2: z1, z2 in kilometres"),
    ("cv-2d", altered(None, BOTH, lambda z: z / 1000), "kilometres", None, "all agents: z1, z2 in kilometres"),
    ("cv-2d", altered(3, BOTH, lambda z: -z), "sign", 3, "agent 3: z1, z2 of the wrong sign"),
    ("cv-2d", altered(None, 0, lambda z: z + 40), "bias", None, r"all agents: a bias of z1 by (3[89]|4[012])\.?\d* m.*, or of the truth"),
    ("cv-2d", of_truth(lambda x: x / 0.3048), "truth-feet", None, "the truth: in feet, not metres"),
    ("cv-2d", of_truth(lambda x: x / 1000), "truth-thousandth", None, "the truth: 1000 times too small"),
    ("thesis-steady", altered(2, 0, lambda z: z / 1000), "thousandth", 2, "agent 2: z1 1000 times too small"),
    ("thesis-steady", altered(1, 0, lambda z: z + 30), "bias", 1, r"agent 1: a bias of z1 by (2[89]|3[012])"),
    ("road-5", moved(2, 1), "late", 2, r"agent 2 \(B\): its clock one step late"),
    ("road-5", moved(2, -1), "early", 2, r"agent 2 \(B\): its clock one step early"),
    ("road-5", altered(1, 0, lambda z: -z), "sign", 1, "z1 of the wrong sign"),
    ("road-5", of_truth(later), "truth-late", None, "the truth: its states one step late"),
    ("road-5", of_truth(earlier), "truth-early", None, "the truth: its states one step early"),
    ("cooperative-pnt", altered(1, BOTH, lambda z: z / 1000), "kilometres", 1, "agent 1: z1, z2, z3 in kilometres"),
    ("cooperative-pnt", altered(4, BOTH, lambda z: z * 1000), "millimetres", 4, "agent 4: z1, z2, z3 in millimetres"),
    ("cooperative-pnt", altered(4, BOTH, lambda z: z + 20), "bias", 4, r"bias of z1 by (1|2)\d\.?\d* m"),
    ("cooperative-pnt", swapped(1, 4), "agents-swapped", 1, "agents 1 and 4"),
    ("cooperative-pnt", of_truth(later), "truth-late", None, "the truth: its states one step late"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "expected", "agent", "text"), SPOILT)
def test_what_was_spoilt_is_told_first(name, spoil, expected, agent, text):
    first = told(name, spoil(drawn(name)))[0]
    assert (first.suspicion, first.agent, first.explains) == (expected, agent, True)
    assert re.search(text, first.text), first.text


def rewritten(name, change):
    source = copy.deepcopy(scenario(name).to_mapping())
    change(source)
    return sf.load_scenario(source)


def noise(key, f):
    return lambda source: source["model"].update({key: f(source["model"][key])})


def sigmas(power):
    def change(source):
        for agent in source["agent"]:
            agent["sensor"]["sigma"] = [sigma**power for sigma in agent["sensor"]["sigma"]]

    return change


TOLD = [
    (
        "thesis-steady",
        noise("R", np.sqrt),
        "deviation-for-variance",
        "R has standard deviations where variances belong",
    ),
    ("thesis-steady", noise("R", np.square), "variance-for-deviation", "R has squared variances"),
    ("thesis-steady", noise("R", lambda R: 3 * R), "R-scaled", r"all agents: an R of 0\.3\d? times the scenario's"),
    ("thesis-steady", noise("Q", lambda Q: Q / 100), "Q-scaled", r"a Q of (1e\+02|[89]\d|1\.[12]e\+02) times"),
    ("thesis-steady", noise("Q", lambda Q: 10 * Q), "Q-scaled", r"a Q of 0\.(0[89]|1)\d* times the scenario's"),
    ("two-radars", sigmas(2.0), "variance-for-deviation", r"R has squared variances \(sigma given as a variance\)"),
    ("two-radars", sigmas(0.5), "deviation-for-variance", "all agents: R has standard deviations"),
]


@pytest.mark.parametrize(("name", "change", "expected", "text"), TOLD)
def test_noises_that_are_told_wrong(name, change, expected, text):
    first = told(name, drawn(name), rewritten(name, change))[0]
    assert (first.suspicion, first.agent, first.explains) == (expected, None, True)
    assert re.search(text, first.text), first.text


MOVING = {
    "model": {"states": ["x", "v"], "F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.05, 0.1], [0.1, 0.2]], "R": 4},
    "initial": {"P": [[100, 0], [0, 25]]},
    "network": {"agents": 3, "steps": 60, "link": 0.6},
}
PLANE = {
    "kind": "constant-velocity", "axes": 2, "step": 1.0, "noise": 0.3, "sensor": {"kind": "position", "sigma": 2},
}  # fmt: skip


@pytest.mark.parametrize(
    ("model", "change", "expected", "text"),
    [
        (MOVING["model"], {"F": [[1, 2], [0, 1]]}, "step-length", r"steps 0\.5 times as long .*\(NEES"),
        (
            MOVING["model"],
            {"F": [[1, 0], [0, 1]]},
            "coupling",
            r"the motion: (1|0\.9\d?|1\.1) v that goes into x .*\(NIS",
        ),
        (PLANE, {"step": 10.0}, "step-length", r"the motion: steps 0\.1 times as long as .*\(NIS"),
        (PLANE, {"step": 0.5}, "Q-scaled", r"a Q of .* times the scenario's, or the motion: steps 2 times as long as"),
    ],
)
def test_motion_that_is_told_wrong(model, change, expected, text):
    """Drawn by one motion and told another; of places alone longer steps and more noise look alike."""
    start = {"P": np.kron(np.eye(len(model.get("states", "abcd")) // 2), MOVING["initial"]["P"]).tolist()}
    s, wrong = (sf.load_scenario(MOVING | {"initial": start, "model": m}) for m in (model, model | change))
    batch = next(Draws(s, ("1", "2", "3"), link_rows(s), 1).batches())
    assert told("", batch, s) == ()
    first = told("", batch, wrong)[0]
    assert (first.suspicion, first.agent, first.explains) == (expected, None, True)
    assert re.search(text, first.text), first.text


def test_two_faults_are_told_one_after_the_other():
    batch = altered(2, 1, np.rad2deg)(drawn("two-radars"))
    batch = altered(1, 0, lambda z: z + 150)(batch)
    found = told("two-radars", batch)
    assert [(each.suspicion, each.agent, each.explains) for each in found] == [
        ("degrees", 2, False),
        ("bias", 1, True),
    ]
    assert "would explain part of it" in found[0].text


def test_what_nothing_explains_is_said_with_the_worst_agent():
    """Agent 3 of one state measures something else altogether."""
    generator = np.random.default_rng(1)
    batch = drawn("thesis-steady")
    wild = 300.0 * np.abs(generator.standard_cauchy(batch.z[2].shape)) ** 3
    (found,) = told("thesis-steady", batch._replace(z=(*batch.z[:2], wild)))
    assert (found.suspicion, found.agent, found.explains) == ("unknown", 3, False)
    assert re.search(r"nothing tried explains the innovations .*; the worst is agent 3 \(NIS (0\.9|1\.)", found.text)


def test_likelihood_is_that_of_the_joint_normal_distribution():
    """Of a scalar walk, all measurements at once: z ~ N(0, C), C by hand, to the last digit but for 2π."""
    s = sf.load_scenario("thesis-steady", agents=2, steps=4, p0=7.0, q=3.0, r=2.0)
    generator = np.random.default_rng(3)
    z = [generator.normal(size=(1, 4, 1)) for _ in range(2)]
    for each in z:
        each[:, 0] = np.nan
    z[1][:, 2] = np.nan
    ones = (np.ones(1),) * 2
    found = innovations(setting_of(s.system, (), ()), [Supposition(tuple(z), ones, ones)])
    at = [(k, i) for k in range(4) for i in range(2) if not np.isnan(z[i][0, k, 0])]
    C = np.array([[7.0 + 3.0 * min(k, m) + 2.0 * ((k, i) == (m, j)) for m, j in at] for k, i in at])
    v = np.array([z[i][0, k, 0] for k, i in at])
    expected = -0.5 * (v @ np.linalg.solve(C, v) + np.linalg.slogdet(C)[1])
    assert found.likelihood[0] == pytest.approx(expected, rel=1e-12)
    assert found.nis() == pytest.approx(v @ np.linalg.solve(C, v) / len(v), rel=1e-12)
    assert int(found.counts[0]) == len(v)


def test_other_units_are_as_likely_as_they_are():
    """A record in other units has the likelihood of the record, less log a for each measurement."""
    batch, s = drawn("cv-2d"), scenario("cv-2d")
    z = tuple(np.where((np.arange(30) > 0)[:, None], each, np.nan) for each in batch.z)
    ones = (np.ones(2),) * 3
    setting = setting_of(s.system, (), batch.first)
    true = innovations(setting, [Supposition(z, ones, ones)])
    thousand = tuple(np.full(2, 1000.0) for _ in z)
    small = innovations(setting, [Supposition(z, thousand, ones)])
    assert small.likelihood[0] - true.likelihood[0] == pytest.approx(3 * 29 * 2 * np.log(1000.0), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_honest_records_are_hardly_ever_accused(name):
    assert sum(bool(told(name, drawn(name, seed))) for seed in range(100)) <= 2


def test_a_known_first_error_is_no_fault():
    """First estimates far from the truth, as the scenario says: estimators are overconfident, the record is right."""
    s = sf.load_scenario("thesis-transient", steps=12)
    batch = next(Draws(s, ("1", "2"), link_rows(s, [0.5]), 1).batches())
    assert told("", batch, s) == ()


def test_the_command_tells(tmp_path):
    folder = tmp_path / "made"
    command("simulate", "two-radars", "--steps", 40, "--link", 0.5, "--estimator", "stand-alone", "-o", folder)
    rows = [line.split(",") for line in (folder / "measurements.csv").read_text().splitlines()]
    for row in rows[1:]:
        if row[2] == "2":
            row[4] = repr(math.degrees(float(row[4])))
    (folder / "degrees.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    files = ["--measurements", folder / "degrees.csv", "--arrivals", folder / "arrivals.csv"]
    done = command("run", "two-radars", *files, "--estimator", "stand-alone", "--format", "json")
    assert "note: agent 2: z2 in degrees, not radians would explain it (NIS" in done.stderr
    (found,) = strict_json(done.stdout)["suspicions"]
    assert found.keys() == {"suspicion", "agent", "text", "explains"}
    assert (found["suspicion"], found["agent"], found["explains"]) == ("degrees", 2, True)
    honest = ["--measurements", folder / "measurements.csv", "--arrivals", folder / "arrivals.csv"]
    done = command("run", "two-radars", *honest, "--estimator", "stand-alone", "--format", "json")
    assert strict_json(done.stdout)["suspicions"] == []
    off = sf.run(
        sf.load_scenario("two-radars"), *files[1::2], estimator="stand-alone", predicted=False, suspected=False
    )
    assert off.suspicions == ()
