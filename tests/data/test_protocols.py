"""Messages that do not carry everything: loads and accuracy of live agents."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.draw import drawn_arrivals
from stochfuse.engines.replay import moments_given
from stochfuse.kalman.metrics import metric
from stochfuse.scenario.scenario import link_rows
from tests.cli.command import run, strict_json
from tests.data.test_agent import scenario

LFG = "local-fusion-graph"


@pytest.mark.parametrize(
    ("name", "protocol"),
    [(LFG, "acknowledged"), (LFG, "full"), ("optimal", "acknowledged"), ("covariance-intersection", "full")],
)
def test_what_they_claim_and_truly_have_is_replays_where_nothing_is_missing(name, protocol):
    late = {} if name == "covariance-intersection" else {"delay": [0.7, 0.3]}
    s = scenario(3, 5, network={"agents": 3, "steps": 5, **late})
    found = sf.protocol_load(s, [0.5], protocol, estimator=name, runs=5, seed=4)
    record = drawn_arrivals(s.system, link_rows(s, [0.5]), np.zeros((5, 5, 3), dtype=bool), 4)
    given = moments_given(s.system, name, record)
    np.testing.assert_allclose(found.lived[0].P[0], given.P, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(found.lived[0].actual[0], given.actual, rtol=1e-8, atol=1e-11)
    assert not found.lived[0].apart.any()


def test_what_is_left_out_costs_accuracy_and_saves_bytes():
    s = sf.load_scenario("thesis-transient", steps=5)
    protocols = ["full", "acknowledged", "own", "window:2", "window:1"]
    found = sf.protocol_load(s, [0.6], protocols, runs=20).between(3, 5)
    trace = metric("trace", s.model)
    size = [found.load(p, "bytes").values[0] for p in range(5)]
    actual = [found.accuracy(p, trace).values[0] for p in range(5)]
    apart = [found.load(p, "apart").values[0] for p in range(5)]
    assert size[0] > size[1] > size[2] > size[3] > size[4]
    assert actual[0] == actual[1] < actual[3] < actual[4]
    assert apart[:2] == [0, 0]
    assert apart[4] > apart[3] > 0
    # one node a message: µ times two senders
    nodes = found.load(4)
    assert abs(nodes.values[0] - 1.2) < 4 * nodes.error[0]
    assert found.accuracy(4, trace, "consistency").values[0] < 1.05


def test_a_standard_error_is_that_of_the_mean_where_that_is_what_is_shown():
    s = sf.load_scenario("thesis-transient", steps=2)
    found = sf.protocol_load(s, [0.5], "window:1", runs=40)
    runs = found.lived[0].nodes[0].mean(axis=(1, 2))
    groups = np.array([runs[np.arange(40) % 20 == group].mean() for group in range(20)])
    np.testing.assert_allclose(found.load(0).error[0], groups.std(ddof=1) / np.sqrt(20), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["wait", "intersect"])
def test_after_a_silence_longer_than_the_horizon_all_is_as_if_there_had_been_none(missing):
    """Cautious while nobody holds what both share, exact again some steps later; with a longer horizon exact throughout."""
    steps, n = 46, 3
    link = np.full((steps, n, n), 0.6) * (1 - np.eye(n))
    link[9:32, 2] = link[9:32, :, 2] = 0  # the third is silent, and deaf, in steps 10 to 32
    model = {"F": [[1]], "H": [[1]], "Q": [[25]], "R": [[100]]}
    network = {"agents": n, "steps": steps, "link": link.tolist()}
    s = sf.load_scenario({"model": model, "initial": {"P": [[100]]}, "network": network})
    policies = [sf.MessageProtocol(horizon=horizon) for horizon in (8, 40)]
    short, long = sf.protocol_load(s, None, policies, runs=5, missing=missing).lived
    assert not long.apart.any()
    np.testing.assert_allclose(short.P[:, :, :32], long.P[:, :, :32], rtol=1e-8)
    assert short.apart[:, :, 32:36].any()
    assert short.actual[:, :, 32:36].mean() < 1.05 * short.P[:, :, 32:36].mean()
    assert not short.apart[:, :, -3:].any()
    np.testing.assert_allclose(short.P[:, :, -1].mean(), long.P[:, :, -1].mean(), rtol=0.01)


def test_on_the_command_line():
    asked = ("--steps", "3", "--runs", "10", "--link", "0,1")
    found = strict_json(
        run("messages", "--protocol", "acknowledged,window:1", "--accuracy", *asked, "--format", "json").stdout
    )
    assert found["protocol"] == "acknowledged"
    assert found["load"]["mean"] == found["protocols"][0]["load"]["mean"]
    assert found["load"]["mean"][0] == 0
    assert found["accuracy"]["quantity"] == "actual"
    three = sf.load_scenario("thesis-transient", steps=3)
    exact = sf.predict(three, [0, 1], "general", "actual").values()[:, :3].mean(axis=1)
    np.testing.assert_allclose(found["accuracy"]["values"], exact, rtol=1e-9)  # nothing is left to chance there
    assert [each["protocol"] for each in found["protocols"]] == ["acknowledged", "window:1"]
    text = run("messages", "--protocol", "window:1", *asked, "--missing", "intersect").stdout
    assert "apart: estimates heard that rest on others that are not there (intersect)" in text
    line = run("messages", "--protocol", "own", *asked, "--accuracy", "--format", "csv").stdout.splitlines()[1]
    assert line.startswith("own,wait,local-fusion-graph,sampled,10,mean")


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (("--protocol", "some"), "protocol: expected full, acknowledged, own or window:W (W steps), got 'some'"),
        (("--protocol", "window:99"), "window: expected 1 to 32 steps (the horizon), got 99"),
        (("--protocol", "own", "--rule", "naive"), "--rule: expected without --protocol"),
        (("--missing", "wait"), "--missing: expected --protocol, which it is for"),
    ],
)
def test_refusals(more, match):
    assert match in " ".join(run("messages", *more, code=2).stderr.split())
