"""Expected states given measurements, (48) and (53), and their spread over what arrives."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario.registry import ESTIMATORS
from tests.cli.command import run, strict_json
from tests.oracles import textbook

F, Q = np.array([[1.0, 0.5], [0.0, 0.8]]), np.array([[0.5, 0.1], [0.1, 0.4]])
H, R, P0 = np.array([[1.0, 0.3]]), np.array([[0.8]]), np.array([[2.0, 0.3], [0.3, 1.0]])
X0 = np.array([[1.0], [-2.0]])
STEPS, N = 3, 2
Z = np.random.default_rng(3).normal(size=(STEPS, N, 1))


def scenario(**network):
    return sf.load_scenario({
        "model": {"F": F, "Q": Q, "H": H, "R": R, "states": ["x", "v"]},
        "initial": {"P": P0, "x": X0[:, 0]},
        "network": {"agents": N, "steps": STEPS, **network},
    })  # fmt: skip


@pytest.mark.parametrize("name", ["local-fusion-graph", "naive"])
@pytest.mark.parametrize("delay", [(1.0,), (0.7, 0.3)])
def test_mean_and_spread_are_those_of_the_textbooks_outcomes(name, delay):
    records = [[Z[k, i][:, None] for i in range(N)] for k in range(STEPS)]
    link = np.full((STEPS, N, N), 0.3).tolist()
    weights, x = [], []
    for weight, history in textbook.histories(N, STEPS, "ad-hoc", link, delay):
        network = textbook.FusionNetwork(F, Q, [(H, R)] * N, P0, X0, records, history, naive=name == "naive")
        weights.append(weight)
        x.append([[network.state(i, k)[:, 0] for i in range(N)] for k in range(1, STEPS + 1)])
    weights, x = np.array(weights)[:, None, None, None], np.array(x)
    mean = (weights * x).sum(axis=0)
    deviation = np.sqrt((weights * (x - mean) ** 2).sum(axis=0))
    found = sf.expected_states(scenario(delay=list(delay)), Z, [0.3], "general", estimator=name)
    np.testing.assert_allclose(found.x[0], mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(found.deviation[0], deviation, rtol=1e-6, atol=1e-7)
    assert found.nature == "exact"


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_sample_agrees_with_every_outcome(name):
    exact = sf.expected_states(scenario(), Z, [0.4], "general", estimator=name)
    drawn = sf.expected_states(scenario(), Z, [0.4], "monte-carlo", estimator=name, runs=2000, seed=4)
    error = np.where(drawn.standard_error > 1e-10, drawn.standard_error, np.inf)
    assert (np.abs(drawn.x - exact.x) / error < 4.5).all()
    np.testing.assert_allclose(drawn.deviation, exact.deviation, rtol=0.1, atol=1e-7)


def test_nothing_is_spread_at_the_ends():
    found = sf.expected_states(scenario(), Z, [0.0, 1.0], "general")
    assert (found.deviation == 0.0).all()
    alone = sf.expected_states(scenario(), Z, [0.7], "general", estimator="stand-alone")
    np.testing.assert_allclose(found.x[0], alone.x[0], rtol=1e-12)


def test_the_simplified_one_is_53():
    found = sf.expected_states(scenario(), Z, [0.2, 0.9])
    np.testing.assert_array_equal(found.x, sf.predict_states(scenario(), Z, [0.2, 0.9]).x)
    assert found.deviation is None
    assert found.nature == "approximate"


@pytest.mark.parametrize("method", ["simplified", "general"])
def test_agents_may_measure_less_than_others(method):
    # the second of two agents sees the velocity too: as one component that tells next to nothing, or not at all
    both, one = {"H": np.eye(2).tolist(), "R": np.eye(2).tolist()}, {"H": [[1.0, 0.0]], "R": [[1.0]]}
    blind = {"H": np.eye(2).tolist(), "R": [[1.0, 0.0], [0.0, 1e12]]}
    z = np.array([[[0.0, 0.0]] * 2, [[1.0, 2.0], [3.0, -1.0]], [[2.0, 0.5], [4.0, 1.0]]])
    less, more = (
        sf.load_scenario({
            "model": {"F": F, "Q": Q, "H": H, "R": R},
            "initial": {"P": P0},
            "network": {"agents": 2, "steps": 3},
            "agent": [first, both],
        })
        for first in (one, blind)
    )  # fmt: skip
    found = sf.expected_states(less, z, [0.4], method).x
    np.testing.assert_allclose(found, sf.expected_states(more, z, [0.4], method).x, rtol=1e-9)
    if method == "simplified":
        with pytest.raises(
            sf.UsageError, match=r"expected shape \(steps, agents, p\) with 3 steps, 2 agents and p = 2"
        ):
            sf.predict_states(less, z[:, 0], [0.4])


def test_sensors_by_name_are_linearised_about_the_nominal_path():
    s = sf.load_scenario("two-radars", steps=3)
    h = np.zeros((3, 2, 2))
    for k in range(3):
        for i in range(2):
            h[k, i] = s.instruments[i].h(s.nominal[k][:, None], k + 1)[:, 0]
    on_path = sf.load_scenario({**s.to_mapping(), "initial": {**s.to_mapping()["initial"], "x": s.nominal[0].tolist()}})
    found = sf.expected_states(on_path, h, [0.5], "general")
    np.testing.assert_allclose(found.x[0], np.broadcast_to(s.nominal[:3, None], (3, 2, 4)), rtol=1e-9, atol=1e-6)
    off = h.copy()
    off[1:, :, 1] += 2 * np.pi  # an angle once around is the same angle
    np.testing.assert_allclose(sf.expected_states(on_path, off, [0.5], "general").x, found.x, rtol=1e-9)


WRONG = [
    ({"measurements": np.ones((3, 1))}, r"expected shape \(steps, agents, p\) = \(3, 2, 1\), got \(3, 1\)"),
    ({"method": "chain"}, "states: expected method simplified, general, monte-carlo, got chain"),
    ({"estimater": "naive"}, r"estimater: no such setting \(did you mean 'estimator'\?\)"),
    ({"runs": 5}, "runs: expected method general or monte-carlo, got simplified"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_what_is_wrong_is_said(given, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.expected_states(scenario(), **{"measurements": Z, **given})


def test_a_gap_is_named():
    z = Z.copy()
    z[2, 1] = np.nan
    with pytest.raises(
        sf.UsageError, match="expected a measurement of agent 2 at step 3, got none; stochfuse run takes"
    ):
        sf.expected_states(scenario(), z)


FILE = "step,agent,z1\n2,1,3.1\n2,2,4.0\n3,1,9.6\n3,2,8.1\n"
WORDS = ("predict", "thesis-steady", "--agents", 2, "--steps", 3, "--quantity", "state", "--measurements", "-")


def test_the_command_line_says_the_same():
    s = sf.load_scenario("thesis-steady", agents=2, steps=3)
    z = [[[0.0], [0.0]], [[3.1], [4.0]], [[9.6], [8.1]]]
    found = sf.expected_states(s, z, [0.5], "general")
    made = strict_json(run(*WORDS, "--method", "general", "--link", 0.5, "--format", "json", input=FILE).stdout)
    assert (made["schema"], made["quantity"], made["method"]) == ("stochfuse.prediction/1", "state", "general")
    np.testing.assert_allclose(made["values"], found.x.mean(axis=2)[..., 0])
    assert made["spread"] is None
    one = strict_json(run(*WORDS, "--method", "general", "--link", 0.5, "--agent", 2, "-f", "json", input=FILE).stdout)
    np.testing.assert_allclose(one["values"], found.x[:, :, 1, 0])
    np.testing.assert_allclose(one["spread"], found.deviation[:, :, 1, 0])
    lines = run(*WORDS, "--link", 0.5, "--format", "csv", input=FILE).stdout.splitlines()
    assert lines[0] == "link,step,agent,state,unit,expected,spread,standard_error,method,estimator,nature"
    assert len(lines) == 1 + 3 * 2


ODD = [
    (("--metric", "det"), "--metric: expected without --quantity state"),
    (("--agent", "worst"), "--agent: expected mean or a number with --quantity state, got worst"),
    (("--method", "optimal"), "states: expected method simplified, general, monte-carlo, got optimal"),
]


@pytest.mark.parametrize(("words", "message"), ODD)
def test_what_the_command_does_not_take(words, message):
    assert message in run(*WORDS, "--link", 0.5, *words, input=FILE, code=2).stderr


def test_state_and_measurements_go_together():
    assert "expected --measurements FILE to go with it" in run("predict", "--quantity", "state", code=2).stderr
    assert "--measurements: expected --quantity state" in run("predict", "--measurements", "z.csv", code=2).stderr
    assert "expected state by itself" in run("predict", "--quantity", "state,claimed", code=2).stderr
    two = "run,step,agent,z1\n1,2,1,1\n2,2,1,1\n"
    assert "measurements: expected one run, got 2" in run(*WORDS, "--link", 0.5, input=two, code=2).stderr
