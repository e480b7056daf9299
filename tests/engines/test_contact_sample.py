"""The optimum of sampled outcomes: every outcome against sets and filters gone through one by one, means against chains."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines import contact_sample, monte_carlo
from stochfuse.engines.contact_sample import sample_optimum
from stochfuse.scenario.scenario import link_rows

MATRIX = [[0, 0.2, 0.7, 0], [0.9, 0, 0.4, 1], [0.5, 0.1, 0, 0.3], [0, 0.2, 0.6, 0]]
BURST = {"good_to_bad": 0.2, "bad_to_good": 0.4, "good": 0.9, "bad": 0.1}
SCALAR = {"F": 0.95, "H": 1.0, "Q": 2.0, "R": 5.0}
PLANAR = {"F": [[1, 0.5], [0, 0.9]], "H": [[1, 0]], "Q": [[0.2, 0.1], [0.1, 0.3]], "R": 2.0}
UNLIKE = [{"R": 0.5}, {}, {"H": [[1, 0], [0.3, 1]], "R": [[1, 0.2], [0.2, 2]]}, {"sensor": False}]
PER_STEP = {
    "H": [[[1.0]], [[1.0]], [[0.5]], [[2]]],
    "F": [[[1.0]], [[0.8]], [[1.1]], [[1]]],
    "Q": [[[1.0]], [[2.0]], [[3.0]], [[0]]],
    "R": [[[1.0]], [[4.0]], [[2.0]], [[9]]],
}
THREE = {
    "F": [[1, 1, 0.5], [0, 1, 1], [0, 0, 0.8]],
    "H": [[1, 0, 0], [0, 0, 1]],
    "Q": np.diag([0.1, 0.2, 0.3]).tolist(),
    "R": [[2, 0.5], [0.5, 1]],
}


def case(model, network, P=10.0, agent=None, **initial):
    source = {"model": dict(model), "initial": {"P": P, **initial}, "network": {"agents": 4, "steps": 4, **network}}
    return source if agent is None else source | {"agent": agent}


P2, P3 = [[4, 1], [1, 3]], np.diag([4.0, 2, 1]).tolist()
CASES = {
    "ad hoc": case(SCALAR, {"link": 0.3}),
    "broadcast": case(SCALAR, {"architecture": "broadcast", "link": 0.4}),
    "cyclic": case(SCALAR, {"architecture": "cyclic", "link": 0.6, "steps": 6}),
    "masked": case(SCALAR, {"hears": [[2], [1, 3], [2], []], "link": 0.6}),
    "matrix": case(PLANAR, {"link": MATRIX}, P2),
    "links per step": case(SCALAR, {"link": [0.1, 0.5, 0.9, 0.4]}),
    "delays": case(PLANAR, {"link": 0.5, "delay": [0.5, 0.3, 0.2], "steps": 6}, P2),
    "delays that differ": case(
        SCALAR, {"link": MATRIX, "delay": [[0, 1, 2, 0], [1, 0, 0, 2], [3, 0, 0, 1], [0, 0, 1, 0]], "steps": 6}
    ),
    "late bursts": case(SCALAR, {"burst": BURST, "delay": [0.7, 0.3]}),
    "misses": case(SCALAR | {"sensor": {"detection": 0.5}}, {"link": 0.4, "steps": 5}),
    "unlike": case(PLANAR, {"link": MATRIX}, P2, UNLIKE, error=[1.0, -2.0]),
    "matrices per step": case(PER_STEP, {"link": 0.4}),
    "shared start": case(PLANAR, {"link": 0.4}, P2, correlation="shared"),
    "initial error": case(SCALAR, {"link": 0.4}, error=[3.0]),
    "three states": case(THREE, {"link": 0.4}, P3, error=[1.0, 0, 2]),
    "alone": case(SCALAR, {"agents": 1, "link": 0.5}),
    "words": case(SCALAR, {"agents": 130, "link": 0.01, "steps": 5}),
}


def outcomes(monkeypatch, name, runs, **settings):
    """Sample a case, with what arrived and what was missed in every step of every block of runs."""
    seen, followed = [], contact_sample._followed

    def spied(riccati, steps, size, agents):
        seen.append((size, list(steps)))
        return followed(riccati, iter(seen[-1][1]), size, agents)

    monkeypatch.setattr(contact_sample, "_followed", spied)
    scenario = sf.Scenario.from_mapping(CASES[name])
    return scenario, sample_optimum(scenario.system, link_rows(scenario), runs, 7, workers=1, **settings), seen


def sets_of_a_run(agents, steps, run):
    """What every agent holds after every step, sets of (agent, step), and messages gone through one by one."""
    holds, sent, out = [set() for _ in range(agents)], [], []
    for k, step in enumerate(steps, start=1):
        for i in range(agents):
            if step.missed is None or not step.missed[run, i]:
                holds[i].add((i, k))
        sent.append([frozenset(h) for h in holds])
        for past, then in enumerate(steps[:k], start=1):
            if k - past < len(then.arrived):
                for receiver, sender in zip(*then.arrived[k - past], strict=True):
                    if receiver // agents == run:
                        holds[receiver % agents] |= sent[past - 1][sender % agents]
        out.append([frozenset(h) for h in holds])
    return out


def filtered(system, held, k):
    """One filter over all measurements held, one at a time."""
    first = sum((i, 1) in held for i in range(system.agents))
    P = system.P0 / (1 if system.shared else first)
    x = np.zeros((system.dimension, 1)) if system.error is None else system.error
    for t in range(1, k):
        F = system.model.F[t]
        P, x = F @ P @ F.T + system.model.Q[t], F @ x
        for i in range(system.agents):
            if (i, t + 1) in held:
                sensor = system.sensors[system.sensor_of[i]]
                H, R = sensor.H[t], sensor.R[t]
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                P, x = P - K @ H @ P, x - K @ H @ x
    return P, x


def check_outcomes(scenario, found, seen):
    first, system = 0, scenario.system
    for size, steps in seen:
        for run in range(size):
            sets = sets_of_a_run(system.agents, steps, run)
            for k, each in enumerate(sets, start=1):
                for i in range(min(system.agents, 6)):
                    P, x = filtered(system, each[i], k)
                    np.testing.assert_allclose(found.P[0, first + run, k - 1, i], P, rtol=1e-10, atol=1e-12)
                    if system.error is not None:
                        np.testing.assert_allclose(found.bias[0, first + run, k - 1, i], x, rtol=1e-10, atol=1e-12)
        first += size


@pytest.mark.parametrize("name", CASES)
def test_every_outcome_by_brute_force(name, monkeypatch):
    runs = 3 if name == "words" else 25
    scenario, found, seen = outcomes(monkeypatch, name, runs, most_bytes=1 << 14)
    assert sum(size for size, _ in seen) == runs
    check_outcomes(scenario, found, seen)


@pytest.mark.parametrize("name", ["unlike", "three states", "misses", "initial error"])
@pytest.mark.parametrize("path", ["square roots", "members one by one"])
def test_every_outcome_on_the_other_paths(name, path, monkeypatch):
    """Square roots where rounding may matter; information added up where kinds of sensors are many."""
    if path == "square roots":
        monkeypatch.setattr(contact_sample, "suspects", lambda system, noises: np.array([True]))
    else:
        monkeypatch.setattr(contact_sample, "MOST_COUNTED", 0)
    check_outcomes(*outcomes(monkeypatch, name, 15))


EXACT = ["ad hoc", "broadcast", "cyclic", "matrix", "delays", "delays that differ", "late bursts", "misses", "unlike"]


@pytest.mark.parametrize("name", [*EXACT, "shared start"])
def test_means_are_those_of_the_exact_chain(name):
    scenario = sf.Scenario.from_mapping(CASES[name])
    exact = sf.predict(scenario, method="optimal")
    found = sample_optimum(scenario.system, link_rows(scenario), 3000, 5)
    expected = exact.by_group[:, :, exact.group_of]
    z = (found.mean - expected) / np.maximum(found.standard_error, 1e-9 * np.abs(expected).max())
    assert np.abs(z).max() < 4.7
    assert (z**2).mean() < 2.5


def test_runs_are_those_that_are_gathered_by_history():
    """The same arrivals as the estimator draws that follows Python sets."""
    for name in ("matrix", "delays that differ", "late bursts", "misses", "broadcast"):
        scenario = sf.Scenario.from_mapping(CASES[name])
        sample = sf.predict(scenario, method="monte-carlo", estimator="optimal", runs=1200, seed=3).sampled.sample
        found = sample_optimum(scenario.system, link_rows(scenario), 1200, 3)
        np.testing.assert_allclose(found.P, sample.values.P[sample.which], rtol=1e-12)


@pytest.mark.parametrize("name", ["delays", "unlike", "misses", "late bursts"])
def test_the_sample_depends_on_the_seed_alone(name):
    scenario = sf.Scenario.from_mapping(CASES[name])
    system, links = scenario.system, link_rows(scenario)
    once = sample_optimum(system, links, 60, 1, workers=1)
    for workers, most_bytes in ((2, 1), (3, 1 << 16)):
        again = sample_optimum(system, links, 60, 1, workers=workers, most_bytes=most_bytes)
        np.testing.assert_allclose(again.P, once.P, rtol=1e-13)
    assert (sample_optimum(system, links, 60, 2).P != once.P).any()


def test_more_runs_of_a_seed_begin_with_the_fewer(monkeypatch):
    monkeypatch.setattr(monte_carlo, "BLOCK", 10)
    scenario = sf.Scenario.from_mapping(CASES["matrix"])
    few, many = (sample_optimum(scenario.system, link_rows(scenario), runs, 1) for runs in (10, 30))
    np.testing.assert_allclose(many.P[:, :10], few.P, rtol=1e-13)


def test_links_that_never_and_always_deliver():
    scenario = sf.load_scenario(agents=70, steps=3)
    found = sample_optimum(scenario.system, link_rows(scenario, [0.0, 1.0]), 2, 1)
    for row, n in enumerate((1, 70)):
        P = 100 / n
        for k in range(3):
            P = P if k == 0 else 1 / (1 / (P + 25) + n / 100)
            np.testing.assert_allclose(found.mean[row, k].ravel(), P, rtol=1e-12)
    np.testing.assert_allclose(found.standard_error, 0, atol=1e-12)


def unlike(agents, steps=3, **network):
    """No two agents alike, and everybody hears everybody: 2^n sets."""
    source = case(SCALAR, {"agents": agents, "steps": steps, "link": 0.2, **network}, error=[1.0])
    return sf.Scenario.from_mapping(source | {"agent": [{"R": 1.0 + i} for i in range(agents)]})


def test_beyond_the_chain_the_optimum_is_sampled():
    scenario = unlike(13)
    p = sf.predict(scenario, method="optimal", runs=200, seed=4)
    assert (p.nature, p.method, p.estimator) == ("sampled", "optimal", "optimal")
    assert p.notes[0] == "the contact chain has more than 4096 states: sampled, 200 runs; ± standard error"
    assert p.notes[1].startswith("control: numbers heard; variance 1/")
    drawn = sf.predict(scenario, method="monte-carlo", estimator="optimal", runs=200, seed=4, quantity="rms")
    np.testing.assert_allclose(p.values(), drawn.shown_as("claimed").values(), rtol=1e-12)
    np.testing.assert_allclose(p.standard_error(), drawn.shown_as("actual").standard_error(), rtol=1e-9)
    asked = {"estimator": "optimal", "runs": 200, "seed": 4, "quantity": "rms", "control": "none"}
    plain = sf.predict(scenario, method="monte-carlo", **asked)
    square = (plain.sampled.sample.values.bias**2).reshape(200, 3, 13).mean((0, 2))
    np.testing.assert_allclose(plain.values("rms:x") ** 2, plain.shown_as("actual").values() + square, rtol=1e-12)


def test_like_agents_beyond_sixty_against_the_chain():
    scenario = sf.load_scenario(agents=64, steps=3)
    exact = sf.predict(scenario, [0.02], method="optimal")
    drawn = sf.predict(scenario, [0.02], method="monte-carlo", estimator="optimal", runs=400)
    bound = np.array(exact.meta["relative_bound"]) * exact.values()
    assert (np.abs(drawn.values() - exact.values()) < 4.5 * drawn.standard_error() + bound).all()
    assert (bound < 1e-3).all()


def test_what_a_sample_is_refused():
    with pytest.raises(
        sf.UsageError, match=r"9000000 runs for 1 .* are 3.51e\+08 entries of covariances; expected at most"
    ):
        sf.predict(unlike(13), method="optimal", runs=9_000_000)
    with pytest.raises(
        sf.UsageError, match="is sampled, and what is asked backwards of it would follow the sample's errors"
    ):
        sf.least_link(unlike(13), 3.0, method="optimal")
