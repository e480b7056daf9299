"""What a log leaves unknown goes on into the answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import beta

import stochfuse as sf
from tests.cli.command import run, strict_json
from tests.oracles import featured

TRUE = np.array([[0.0, 0.7, 0.4], [0.8, 0.0, 0.9], [0.5, 0.6, 0.0]])


def counted(rng, packets, true=TRUE, **network):
    source = featured.source(())
    n = len(true)
    sent = np.full((n, n), packets) * (1 - np.eye(n, dtype=int))
    received = rng.binomial(sent, true)
    source["network"] = {"agents": n, "steps": 4, "sent": sent.tolist(), "received": received.tolist(), **network}
    return sf.Scenario.from_mapping(source)


def test_two_agents_by_hand():
    """Of one uncertain link the interval is that of µ through a falling function."""
    source = featured.source(())
    source["network"] = {
        "agents": 2,
        "steps": 2,
        "sent": [[0, 20], [0, 0]],
        "received": [[0, 12], [0, 0]],
        "hears": [[2], []],
    }
    s = sf.Scenario.from_mapping(source)
    ends = beta.ppf([0.975, 0.025], 12.5, 8.5)
    matrices = [[[0, µ], [0, 0]] for µ in ends]
    expected = sf.predict(s, matrices, "simplified").values(agent=1)
    p = sf.predict(s, method="simplified", interval=0.95)
    np.testing.assert_allclose([p.low(agent=1)[0], p.high(agent=1)[0]], expected, rtol=0.02)
    np.testing.assert_array_equal(p.low(agent=2), p.high(agent=2))
    assert s.network.link[0, 1] == 0.6


@pytest.mark.parametrize("method", ["simplified", "general"])
@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_a_scaled_network_has_the_scaled_ends(scale, method):
    """Of one counted link scaled by c the interval is that of min(1, c µ)."""
    source = featured.source(())
    only = {"sent": [[0, 400], [0, 0]], "received": [[0, 300], [0, 0]], "hears": [[2], []], "scale": scale}
    source["network"] = {"agents": 2, "steps": 2, **only}
    found = sf.predict(source, method=method, interval=0.95)
    ends = [[[0, min(1.0, scale * µ)], [0, 0]] for µ in beta.ppf([0.975, 0.025], 300.5, 100.5)]
    expected = sf.predict(source, ends, method).values(agent=1)
    if scale == 0.5:
        np.testing.assert_allclose([found.low(agent=1)[0], found.high(agent=1)[0]], expected, rtol=0.005)
    else:
        np.testing.assert_allclose([found.low(agent=1)[0], found.high(agent=1)[0]], expected, rtol=1e-12)
    shown = sf.links(sf.load_scenario(source))
    assert shown.low[0, 1] <= shown.link[0, 1] <= shown.high[0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("packets", [200, 2000])
def test_draws_and_derivatives_agree_where_much_is_known(packets):
    s = counted(np.random.default_rng(1), packets)
    drawn = sf.predict(s, method="optimal", interval="95%")
    moved = sf.predict(s, method="general", estimator="optimal", interval="95%")
    np.testing.assert_allclose(drawn.values(), moved.values(), rtol=1e-10)
    width = drawn.high() - drawn.low()
    np.testing.assert_allclose(moved.high() - moved.low(), width, rtol=0.12)
    assert (np.abs(drawn.high() + drawn.low() - moved.high() - moved.low()) < 0.2 * width).all()
    assert (drawn.low() < drawn.values()).all()
    assert (drawn.values() < drawn.high()).all()


def test_more_packets_and_a_lower_level_make_it_narrower():
    few, many = (counted(np.random.default_rng(1), n) for n in (50, 5000))
    wide, narrow, half = (sf.predict(s, interval=level) for s, level in ((few, 0.95), (many, 0.95), (few, 0.5)))
    spans = [(p.high() - p.low()).max() for p in (wide, narrow, half)]
    assert spans[1] < 0.2 * spans[0]
    assert spans[2] < 0.5 * spans[0]


def coverage(method, logs, packets, true=TRUE):
    rng, inside = np.random.default_rng(7), 0
    source = featured.source(())
    source["network"] = {"agents": len(true), "steps": 4, "link": true.tolist()}
    truth = sf.predict(sf.Scenario.from_mapping(source), method=method).values()[0, -1]
    for _ in range(logs):
        p = sf.predict(counted(rng, packets, true), method=method, interval=0.95)
        inside += p.low()[0, -1] <= truth <= p.high()[0, -1]
    return inside / logs


@pytest.mark.slow
@pytest.mark.parametrize("method", ["simplified", "optimal"])
def test_intervals_hold_the_true_value_as_often_as_they_say(method):
    assert 0.91 <= coverage(method, 200, 60) <= 0.98


@pytest.mark.slow
def test_intervals_by_derivatives_hold_the_true_value():
    assert 0.91 <= coverage("general", 200, 60, TRUE[:2, :2]) <= 0.98


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sent": None}, r"network\.sent: expected a 2×2 matrix of whole numbers of packets, got nothing"),
        ({"received": [[0, 30], [3, 0]]}, r"network\.received: expected at most what was sent, 20, got 30"),
        ({"sent": [[0, 0.5], [1, 0]]}, r"network\.sent: expected a 2×2 matrix of whole numbers"),
        ({"sent": [[0, 0], [20, 0]], "received": [[0, 0], [3, 0]]}, r"network\.sent\[1\]\[2\]: expected packets, or"),
        ({"link": 0.2}, r"network\.link: expected either numbers of packets .* or this, got both"),
        ({"link": [[0, 0.6], [0.2, 0]]}, r"network\.link: expected either numbers of packets .* or this, got both"),
        ({"burst": {"good_to_bad": 0.1, "bad_to_good": 0.5}}, r"network\.burst: expected either numbers of packets"),
    ],
)
def test_bad_counts(change, message):
    source = featured.source(())
    source["network"] = {"agents": 2, "steps": 2, "sent": [[0, 20], [20, 0]], "received": [[0, 12], [3, 0]]} | change
    source["network"] = {key: value for key, value in source["network"].items() if value is not None}
    with pytest.raises(sf.ScenarioError, match=message):
        sf.Scenario.from_mapping(source)


def test_what_an_interval_needs():
    s = counted(np.random.default_rng(1), 50)
    for asked, message in (
        ({"interval": 1.5}, "interval: expected a probability between 0 and 1, such as 95% or 0.95, got 1.5"),
        ({"interval": "many"}, "got 'many'"),
        ({"interval": 0.9, "method": "monte-carlo"}, "whose own error is beside it"),
        ({"interval": 0.9, "link": [0.5]}, "expected the scenario's own links"),
    ):
        with pytest.raises(sf.UsageError, match=message):
            sf.predict(s, **asked)
    with pytest.raises(sf.UsageError, match="expected links with numbers of packets"):
        sf.predict("thesis-transient", interval=0.95)
    with pytest.raises(sf.UsageError, match="broadcast"):
        sf.predict(counted(np.random.default_rng(1), 50, np.full((2, 2), 1.0), architecture="broadcast"), interval=0.95)
    assert sf.predict(s).interval() is None


def test_the_command_line_shows_both_ends(tmp_path):
    rng = np.random.default_rng(2)
    rows = [f"{k},{s},{r},{int(rng.random() < 0.6)}" for s in "abc" for r in "abc" if s != r for k in range(30)]
    (tmp_path / "log.csv").write_text("\n".join(["seq,sender,receiver,received", *rows]))
    text = '[model]\nF = 1\nH = 1\nQ = 1\nR = 1\n[initial]\nP = 1\n[network]\nagents = 3\nsteps = 3\nlink = { file = "log.csv" }\n'
    (tmp_path / "net.toml").write_text(text)
    file = tmp_path / "net.toml"
    found = strict_json(
        run("predict", file, "--interval", "90%", "--quantity", "claimed,optimal", "--format", "json").stdout
    )
    assert found["level"] == 0.9
    for each in (found, *found["quantities"].values()):
        low, value, high = (np.array(each[key]) for key in ("low", "values", "high"))
        assert low.shape == value.shape == (1, 3)
        assert (low < value).all()
        assert (value < high).all()
    table = run("predict", file, "--interval", "0.9", env={"COLUMNS": "80"}).stdout
    assert "90 % interval for what the log leaves unknown, by 1,000 draws" in " ".join(table.split())
    assert f"[{found['low'][0][0]:.5g}" in table
    header, first, *_ = run("predict", file, "--interval", "90%", "--format", "csv").stdout.splitlines()
    assert header.endswith("step,value,low,high")
    assert float(first.split(",")[-1]) == pytest.approx(found["high"][0][0])
    run("predict", file, "--interval", "90%", "--plot", tmp_path / "band.png")
    for more, message in (
        (("--normalise",), "--normalise"),
        (("--over", "model.Q=1,2"), "--over"),
        (("--link", "0.5"), "own links"),
    ):
        assert message in run("predict", file, "--interval", "90%", *more, code=2).stderr
