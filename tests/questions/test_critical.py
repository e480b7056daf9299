"""The critical link probability: closed forms, published examples, 50 digits, and the recursion itself, run for long."""

from __future__ import annotations

import csv
import io
import json
from itertools import product

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stochfuse as sf
from tests.cli.command import run, strict_json


def network(F, sensors, *, Q=None, R=2.5, **more):
    """Agents with a sensor each, rows of H, or None for none; everyone hears everyone unless more is said."""
    F = np.atleast_2d(np.asarray(F, dtype=float))
    d = len(F)
    agents = [
        {"sensor": False} if H is None else {"H": np.atleast_2d(H), "R": R * np.eye(len(np.atleast_2d(H)))}
        for H in sensors
    ]
    return {
        "model": {"F": F, "H": np.ones((1, d)), "Q": np.eye(d) if Q is None else Q, "R": R},
        "initial": {"P": np.eye(d)},
        "network": {"agents": len(sensors), "steps": 2, **more},
        "agent": agents,
    }


def remote(F, H, **more):
    """Sinopoli's estimator: the second agent measures nothing and lives on what it hears of the first."""
    return network(F, [H, None], **more)


def unstable(rng, d, largest):
    F = rng.normal(size=(d, d))
    return F * largest / np.abs(np.linalg.eigvals(F)).max()


def encloses(found, truth, width):
    assert found.low <= truth <= found.high
    assert found.low <= found.critical <= found.high
    assert found.high - found.low < width
    assert found.critical == pytest.approx(truth, abs=1e-9)


# --- closed forms ---------------------------------------------------------------------------------------------------


@settings(max_examples=12, deadline=None)
@given(st.floats(1.001, 50.0), st.sampled_from([-1.0, 1.0]), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_of_a_scalar_it_is_one_minus_one_over_the_square(a, sign, Q, R):
    encloses(sf.critical(remote(sign * a, 1.0, Q=Q, R=R)), 1 - 1 / a**2, 1e-11)


@pytest.mark.parametrize("d", range(1, 7))
def test_of_one_component_it_is_the_product_of_the_unstable_modes(d):
    # Elia 2005, Schenato et al. 2007: the mean-square capacity of an erasure channel
    rng = np.random.default_rng(d)
    for _ in range(3):
        F = unstable(rng, d, rng.uniform(1.05, 1.5))
        modes = np.maximum(np.abs(np.linalg.eigvals(F)), 1.0)
        encloses(sf.critical(remote(F, rng.normal(size=(1, d)))), 1 - 1 / np.prod(modes) ** 2, 1e-6)


@pytest.mark.parametrize("d", [2, 3, 5])
def test_where_one_message_shows_the_state_it_is_the_largest_mode(d):
    rng = np.random.default_rng(d)
    F = unstable(rng, d, 1.3)
    encloses(sf.critical(remote(F, rng.normal(size=(d + 1, d)))), 1 - 1 / 1.3**2, 1e-9)


@pytest.mark.parametrize("n", [1, 2, 3, 10])
def test_of_several_senders_one_is_enough(n):
    found = sf.critical(network(1.5, [1.0] * n + [None]))
    encloses(found, 1 - 1.5 ** (-2 / n), 1e-11)
    assert found.agents == (n + 1,)


@pytest.mark.parametrize(
    ("F", "H", "truth"),
    [
        (-1.25, 1.0, 0.36),  # Sinopoli et al. 2004, the scalar example
        ([[1.25, 1, 0], [0, 0.9, 7], [0, 0, 0.6]], [[1, 0, 2]], 0.36),  # one unstable mode: both of its bounds
        ([[1.25, 0], [1, 1.1]], [[1, 1]], 1 - 1 / (1.25 * 1.1) ** 2),  # two: its upper bound, 0.471; its lower is 0.36
    ],
)
def test_the_published_examples(F, H, truth):
    d = len(np.atleast_2d(F))
    encloses(sf.critical(remote(F, H, Q=20 * np.eye(d), R=2.5)), truth, 1e-10)


# --- against the recursion itself -----------------------------------------------------------------------------------


def naive(F, Q, sensors, R, receiver, µ):
    """One step of (54) for one receiver, set by set in information form, without a line of the package."""
    J = [np.zeros_like(F) if H is None else np.atleast_2d(H).T @ np.atleast_2d(H) / R for H in sensors]
    others = [j for j in range(len(sensors)) if j != receiver]

    def step(P):
        prior, total = np.linalg.inv(F @ P @ F.T + Q), np.zeros_like(P)
        for arrived in product((0, 1), repeat=len(others)):
            p = np.prod([µ if a else 1 - µ for a in arrived])
            gained = J[receiver] + sum(a * J[j] for a, j in zip(arrived, others, strict=True))
            total += p * np.linalg.inv(prior + gained)
        return (total + total.T) / 2

    return step


@pytest.mark.parametrize("seed", range(6))
def test_it_parts_what_settles_from_what_grows(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 4))
    F = unstable(rng, d, rng.uniform(1.1, 1.4))
    sensors = [rng.normal(size=(1, d)), rng.normal(size=(1, d)), None]
    found = sf.critical(network(F, sensors, R=1.0), agent=3)
    assert 0 < found.low < found.high < 1
    for µ, settles in ((found.critical + 0.01, True), (found.critical - 0.01, False)):
        step, P, sizes = naive(F, np.eye(d), sensors, 1.0, 2, µ), np.eye(d), []
        for _ in range(1200):
            P = step(P)
            sizes.append(np.trace(P))
            if sizes[-1] > 1e9:
                break
        assert (sizes[-1] < 1e9 and sizes[-1] == pytest.approx(sizes[-100], rel=1e-2)) == settles


@pytest.mark.parametrize("F", [[[1.25, 0], [1, 1.1]], [[0.9, 0.9], [-0.9, 0.9]]])
def test_the_steady_state_exists_above_it_and_is_refused_below_it(F):
    source = remote(F, [[1, 0.5]])
    found = sf.critical(source)
    steady = sf.steady_state(source, [found.critical + 1e-3])
    assert np.isfinite(steady.P).all()
    assert (steady.bound < 1e-3).all()
    # sharper than the mode alone, of which 1 − 1/max|λ|² is the limit
    assert found.critical > 1 - 1 / np.abs(np.linalg.eigvals(F)).max() ** 2 + 0.05
    with pytest.raises(
        sf.NoAnswerError, match=r"no steady state: a direction of rank 2 grows by a factor of at least 1\.00"
    ):
        sf.steady_state(source, [found.critical - 1e-3])


def test_the_proofs_hold_in_fifty_digits():
    F, H, R = [[1.25, 0], [1, 1.1]], [[1, 1]], 2.5
    found = sf.critical(remote(F, H, Q=20 * np.eye(2), R=R), agent=2)
    with mp.workdps(50):
        F, H, Q = mp.matrix(F), mp.matrix(H), 20 * mp.eye(2)
        P, X = mp.matrix(found.bounded[0].P.tolist()), mp.matrix(found.growing.X.tolist())
        µ = mp.mpf(found.high)
        prior = F * P * F.T + Q
        left = prior - prior * H.T * H * prior / ((H * prior * H.T)[0] + R)
        assert min(mp.eigsy(P - (1 - µ) * prior - µ * left, eigvals_only=True)) > 0
        µ = mp.mpf(found.low)
        Y = F * X * F.T
        left = Y - Y * H.T * H * Y / (H * Y * H.T)[0]
        assert min(mp.eigsy((1 - µ) * Y + µ * left - X, eigvals_only=True)) > 0
        truth = 1 - 1 / (mp.mpf(1.25) * mp.mpf(1.1)) ** 2
        assert found.low < truth < found.high


def test_a_bound_stays_one():
    source = network([[1.2, 0.3], [0.1, 1.1]], [[[1, 0]], [[0, 1]], None], R=1.0)
    found = sf.critical(source, agent=3)
    step = naive(np.array(source["model"]["F"]), np.eye(2), [[[1, 0]], [[0, 1]], None], 1.0, 2, found.high + 0.02)
    above = sf.critical(network([[1.2, 0.3], [0.1, 1.1]], [[[1, 0]], [[0, 1]], None], R=1.0), agent=3).bounded[0].P
    P = np.eye(2)
    for _ in range(50):
        P = step(P)
        assert np.linalg.eigvalsh(above - P).min() > 0


# --- who, and which links -------------------------------------------------------------------------------------------

COMPLEMENTARY = network([[1.2, 0], [0, 1.3]], [[[1, 0]], [[0, 1]]])
"""The first agent sees the weaker mode and waits for messages about the stronger one; the second the other way round."""


@pytest.mark.parametrize(
    ("agent", "mode", "agents"),
    [("mean", 1.3, (1,)), ("worst", 1.3, (1,)), ("best", 1.2, (2,)), (1, 1.3, (1,)), (2, 1.2, (2,))],
)
def test_whose_covariance_is_asked_about(agent, mode, agents):
    found = sf.critical(COMPLEMENTARY, agent=agent)
    encloses(found, 1 - 1 / mode**2, 1e-11)
    assert (found.agents, found.agent) == (agents, agent)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
def test_like_agents_need_no_link(architecture):
    found = sf.critical(network([[1.2, 1], [0, 1.1]], [[[1, 0]]] * 3, architecture=architecture))
    assert (found.critical, found.low, found.high, found.growing) == (0, 0, 0, None)
    assert "bounded at link 0" in found.certificate


def test_a_ring_hears_one_only():
    # agent 3 hears agent 1, and agent 2 hears agent 3, which has nothing to tell: it needs none, it measures
    encloses(sf.critical(network(1.5, [1.0, 1.0, None], architecture="cyclic")), 1 - 1 / 1.5**2, 1e-11)


def test_masks_and_zeros_of_a_matrix_stay():
    masked = network(1.5, [1.0, 1.0, None], hears=[[2, 3], [1, 3], [1]])
    zeros = network(1.5, [1.0, 1.0, None], link=[[0, 0.3, 0.1], [0.2, 0, 0.1], [0.9, 0, 0]])
    for source in (masked, zeros):
        encloses(sf.critical(source), 1 - 1 / 1.5**2, 1e-11)
    encloses(sf.critical(network(1.5, [1.0, 1.0, None], link=0.7)), 1 - 1 / 1.5, 1e-11)


def test_a_mode_on_the_circle_needs_next_to_nothing():
    found = sf.critical(remote([[1, 1], [0, 1]], [[1, 0]]))
    assert (found.critical, found.low, found.growing) == (0, 0, None)
    assert 0 < found.high < 1e-6


def test_the_units_of_the_states_do_not_matter():
    F, H, S = np.array([[1.25, 0], [1, 1.1]]), np.array([[1.0, 1.0]]), np.diag([1e6, 1e-5])
    S_inv = np.linalg.inv(S)
    encloses(sf.critical(remote(S @ F @ S_inv, H @ S_inv, Q=S @ S)), 1 - 1 / (1.25 * 1.1) ** 2, 1e-9)


def test_any_probability_can_be_swept():
    def one_link(x):
        return sf.load_scenario(network(1.5, [1.0, 1.0, None], link=[[0, 0.5, 0], [0.5, 0, 0], [x, 0.2, 0]]))

    found = sf.critical(one_link(0.5), one_link, name="link[3,1]")
    encloses(found, 1 - 1 / (0.8 * 1.5**2), 1e-11)
    assert "bounded at link[3,1] 0.44" in found.certificate


# --- refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            network([[1.2, 0], [0, 1.3]], [[[1, 0]]] * 2),
            "agents 1, 2 is not bounded, since no measurement .* eigenvalue 1.3",
        ),
        (network(1.5, [None, None]), "no measurement that gets there shows the mode of F with eigenvalue 1.5"),
        (network(1.5, [1.0, None], hears=[[2], []]), "agent 2 is not bounded"),
        (network([[1, 1], [0, 1]], [[[0, 1]], None]), "eigenvalue 1$"),
    ],
)
def test_where_not_even_every_message_helps_there_is_no_answer(source, message):
    with pytest.raises(sf.NoAnswerError, match=f"no critical link: even at 1 .*{message}"):
        sf.critical(source)


def test_too_rare_whatever_is_swept():
    def weak(x):
        return sf.load_scenario(network(1.5, [1.0, None], link=[[0, 0.5], [0.5 * x, 0]]))

    with pytest.raises(
        sf.NoAnswerError, match=r"grows by a factor of 1\.125 in every step, since what shows it comes too rarely"
    ):
        sf.critical(weak(1.0), weak)


@pytest.mark.parametrize(
    ("source", "asked", "message"),
    [
        (
            network(1.5, [1.0, None], link=[[[0, 1], [1, 0]]] * 2),
            {},
            "links that do not vary with the step, got network.link per step",
        ),
        (network(1.5, [1.0, None], case=[{"name": "a", "link": 0.1}]), {}, "expected no network.case"),
        (
            network(1.5, [1.0, None], burst={"good_to_bad": 0.1, "bad_to_good": 0.2}),
            {},
            "without memory, got network.burst",
        ),
        (network(1.5, [1.0, None], delay=1), {}, "without delay"),
        (COMPLEMENTARY, {"agent": 3}, "agent: expected mean, worst, best or a number from 1 to 2, got '3'"),
        (COMPLEMENTARY, {"agent": True}, "agent: expected mean"),
        (
            COMPLEMENTARY,
            {"parameter": lambda x: sf.load_scenario(COMPLEMENTARY)},
            "expected one link probability in the scenario, got 5",
        ),
    ],
)
def test_what_does_not_fit_is_refused(source, asked, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.critical(source, **asked)


def test_models_that_vary_with_the_step_are_refused():
    source = network(1.5, [1.0, None])
    source["model"]["F"] = [[[1.5]], [[1.2]]]
    with pytest.raises(sf.UsageError, match="a model, sensors and links that do not vary with the step"):
        sf.critical(source)


# --- on its way to the reader ---------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "remote.json"
    source = remote([[1.25, 0], [1, 1.1]], [[1, 1]], Q=20 * np.eye(2))
    path.write_text(json.dumps(source, default=lambda a: a.tolist()))
    return path


def test_json_csv_and_table(file):
    truth = 1 - 1 / (1.25 * 1.1) ** 2
    found = strict_json(run("solve", file, "--critical", "--format", "json").stdout)
    assert found["schema"] == "stochfuse.critical/1"
    assert found["low"] <= truth <= found["high"]
    assert found["critical"] == pytest.approx(truth, abs=1e-9)
    assert found["agents"] == [2]
    assert "bounded at link 0.4710743801" in found["certificate"]
    assert "a direction X of rank 2" in found["certificate"]
    row = next(csv.DictReader(io.StringIO(run("solve", file, "--critical", "--format", "csv").stdout)))
    assert float(row["critical"]) == found["critical"]
    text = run("solve", file, "--critical").stdout
    assert text.startswith("Critical link probability: µ = 0.471074380165, above which")
    assert "of all agents; the last: 2" in text


def test_an_agent_that_measures_needs_none(file):
    assert "No link is needed" in run("solve", file, "--critical", "--agent", "1").stdout
    assert "No link is needed" in run("solve", "--critical").stdout
    assert strict_json(run("solve", "--critical", "--format", "json").stdout)["critical"] == 0


def test_exit_codes(file, tmp_path):
    hopeless = tmp_path / "hopeless.json"
    hopeless.write_text(json.dumps(network(1.5, [None, None]), default=lambda a: a.tolist()))
    assert run("solve", hopeless, "--critical", code=3).stderr.startswith("no answer: no critical link: even at 1")
    for words, message in (
        ("--link 0.5", "--link: expected with --agents-needed"),
        ("--step 2", "--step: expected with --target"),
        ("--metric det", "--metric: expected with --target"),
        ("--method general", "--method: expected with --target"),
        ("--quantity actual", "--quantity: expected with --target"),
        ("--target 3", "expected one question a call, got --target and --critical"),
    ):
        assert message in run("solve", file, "--critical", *words.split(), code=2).stderr


def test_figure_and_results(file):
    pytest.importorskip("matplotlib")
    found = sf.critical(str(file))
    _, growth = found.curve(11)
    assert growth[0] == pytest.approx(1.25**2)  # nothing arrives
    assert growth[-1] < 1
    assert (np.diff(growth) < 0).all()
    assert found.plot() is not None
    assert "critical=0.471" in repr(found)
    assert found.to_dataframe().critical[0] == found.critical


def sinopoli(a, p, **more):
    source = {
        "model": {"F": a, "H": 1.0, "Q": 1.0, "R": 2.5, "sensor": {"detection": p}},
        "initial": {"P": 1.0},
        "network": {"agents": 1, "steps": 40, "link": 0.5},
    }
    return sf.load_scenario({**source, **more})


@pytest.mark.parametrize("a", [1.01, 1.25, 2.0, 7.0])
def test_the_critical_detection_of_one_sensor(a):
    """Sinopoli's recursion itself: 1 − 1/a², of a sensor that may miss instead of a link that may lose."""
    found = sf.critical(sinopoli(a, 1.0), lambda p: sinopoli(a, p), name="model.sensor.detection")
    assert found.critical == pytest.approx(1 - 1 / a**2, abs=1e-9)
    assert found.low <= 1 - 1 / a**2 <= found.high
    assert "model.sensor.detection" in found.certificate


@pytest.mark.parametrize("p", [0.0, 0.3, 0.5, 0.9])
def test_one_sensor_that_may_miss_follows_sinopoli(p):
    a, P, out = 1.25, 1.0, [1.0]
    for _ in range(39):
        prior = a * P * a + 1.0
        P = prior - p * prior**2 / (prior + 2.5)
        out.append(P)
    np.testing.assert_allclose(sf.predict(sinopoli(a, p), [0.5]).values()[0], out, rtol=1e-12)
    if p > 0.37:
        np.testing.assert_allclose(sf.steady_state(sinopoli(a, p), [0.5]).P.item(), out[-1], rtol=1e-2)
    else:
        with pytest.raises(sf.NoAnswerError):
            sf.steady_state(sinopoli(a, p), [0.5])
