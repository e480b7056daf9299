"""Fusion rules of one's own: what they are given for nothing, what is named, and two rules from the literature."""

from __future__ import annotations

import importlib.util
import json
import pickle
import re
import sys
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.linalg import inv

import stochfuse as sf
from stochfuse.scenario import own_rules
from tests.cli.command import run

FILE = Path(__file__).parents[2] / "notebooks" / "handbook" / "my_rules.py"
SMALL = {
    "schema": "stochfuse.scenario/1",
    "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.3, 0.1], [0.1, 0.2]], "R": 2},
    "initial": {"P": [[9, 1], [1, 3]], "error": [1, -1]},
    "network": {"agents": 3, "steps": 3, "link": [[0, 0.9, 0.4], [0.2, 0, 0.7], [0.5, 0.6, 0]]},
    "agent": [{}, {"R": 5}, {"sensor": False}],
}


def literature():
    spec = importlib.util.spec_from_file_location("my_rules", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Adds:
    """Everything taken for independent, one fusion at a time."""

    def fuse(self, x, P):
        Y = inv(P)
        C = inv(Y.sum(axis=0))
        return C @ (Y @ x).sum(axis=0), C


class AddsStacks:
    """The same for stacks."""

    batched = True

    def fuse(self, x, P):
        Y = inv(P)
        C = inv(Y.sum(axis=1))
        return C @ (Y @ x).sum(axis=1), C


class OneByOne:
    """Two at a time, the newcomer believed less: the order matters."""

    name, pairs = "one-by-one", True

    def fuse(self, x, P):
        A, B = P
        K = A @ inv(A + 2 * B)
        return x[0] + K @ (x[1] - x[0]), (np.eye(len(A)) - K) @ A + 0.1 * np.eye(len(A))


class Gates:
    """Takes what is near: no weighted sum."""

    def fuse(self, x, P):
        near = [i for i in range(len(x)) if np.abs(x[i] - x[0]).max() < 2]
        return x[near].mean(axis=0), P[0]


@pytest.mark.parametrize("rule", [Adds, AddsStacks()], ids=["class", "stacks"])
def test_the_sum_of_information_written_as_a_rule_is_naive_fusion(rule):
    late = {**SMALL, "network": {"agents": 2, "steps": 3, "link": 0.6, "delay": [0.6, 0.4]}, "agent": [{}, {"R": 5}]}
    for scenario in ({**SMALL, "network": {**SMALL["network"], "steps": 2}}, late):
        ours, theirs = (sf.predict(scenario, None, "general", "rms", estimator=e) for e in (rule, "naive"))
        for quantity in ("claimed", "actual", "consistency", "bias", "rms"):
            for agent in range(1, scenario["network"]["agents"] + 1):
                a, b = (p.shown_as(quantity).values("rms:x1,x2", agent=agent) for p in (ours, theirs))
                np.testing.assert_allclose(a, b, rtol=1e-9)


def test_sampling_replay_states_and_statistics_are_those_of_naive_fusion():
    both = [sf.predict(SMALL, None, "monte-carlo", "actual", estimator=e, runs=20) for e in (Adds, "naive")]
    np.testing.assert_allclose(both[0].values(), both[1].values(), rtol=1e-9)
    s, z = sf.load_scenario(SMALL, steps=2), np.random.default_rng(0).normal(size=(2, 3, 1))
    both = [sf.expected_states(s, z, method="general", estimator=e).x for e in (Adds, "naive")]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)
    found = sf.simulate(s, 40, estimator=[Adds, "naive"], link=0.5)
    rows = [[r for r in found.rows if r.estimator.endswith(name)] for name in ("Adds", "naive")]
    for a, b in zip(*rows, strict=True):
        told = [[r.realised, r.claimed, r.predicted, r.given] for r in (a, b)]
        np.testing.assert_allclose(*told)
    compared = sf.compare_estimators(s, [0.5], [Adds, "naive", OneByOne()])
    assert compared.estimators[2] == "one-by-one"
    np.testing.assert_allclose(compared.values("actual")[0], compared.values("actual")[1])


def brute_force(scenario, rule):
    """Expected claimed and actual covariance of every agent after the last step, outcome by outcome."""
    F, Q, H = (np.array(SMALL["model"][name], float) for name in "FQH")
    n, d, R, µ = 3, 2, np.array([[2.0]]), np.array(scenario["network"]["link"])
    claimed, actual = np.zeros((n, d, d)), np.zeros((n, d, d))
    steps, links = scenario["network"]["steps"], [(i, j) for i in range(n) for j in range(n) if µ[i, j]]
    every = list(product((0, 1), repeat=len(links)))
    P0 = np.array(scenario["initial"]["P"], float)

    def onward(P, joint, step, weight):
        for outcome in every:
            w = weight * np.prod([µ[a] if up else 1 - µ[a] for a, up in zip(links, outcome, strict=True)])
            heard = {a for a, up in zip(links, outcome, strict=True) if up}
            T, fused = np.zeros((n * d, n * d)), []
            for i in range(n):
                C, row = P[i], {i: np.eye(d)}
                for j in (j for j in range(n) if (i, j) in heard):
                    C, K, L = rule(C, P[j])
                    row = {k: K @ M for k, M in row.items()}
                    row[j] = row.get(j, 0) + L
                fused.append(C)
                for j, M in row.items():
                    T[i * d : i * d + d, j * d : j * d + d] = M
            after = T @ joint @ T.T
            if step == steps:
                for i in range(n):
                    claimed[i] += w * fused[i]
                    actual[i] += w * after[i * d : i * d + d, i * d : i * d + d]
                continue
            A, B, now = np.zeros((n * d, n * d)), np.zeros((n * d, n * d)), []
            for i in range(n):
                prior = F @ fused[i] @ F.T + Q
                K = prior @ H.T @ inv(H @ prior @ H.T + R)
                at = slice(i * d, i * d + d)
                A[at, at] = np.eye(d) - K @ H
                B[at, at] = K @ R @ K.T
                now.append((np.eye(d) - K @ H) @ prior)
            big = np.kron(np.eye(n), F)
            onward(now, A @ (big @ after @ big.T + np.kron(np.ones((n, n)), Q)) @ A.T + B, step + 1, w)

    onward([P0] * n, np.kron(np.eye(n), P0), 1, 1.0)
    return claimed, actual


@pytest.mark.parametrize(
    "link",
    [
        [[0, 0.3, 0.6], [0, 0, 0.7], [0, 0, 0]],
        pytest.param([[0, 0.6, 0.6], [0.6, 0, 0.6], [0.6, 0.6, 0]], marks=pytest.mark.slow),
    ],
    ids=["few links", "every agent alike"],
)
def test_a_rule_that_minds_the_order_is_exact_for_every_agent(link):
    def pair(A, B):
        K = A @ inv(A + 2 * B)
        return (np.eye(2) - K) @ A + 0.1 * np.eye(2), np.eye(2) - K, K

    scenario = {key: value for key, value in SMALL.items() if key != "agent"}
    scenario |= {"initial": {"P": SMALL["initial"]["P"]}, "network": {"agents": 3, "steps": 2, "link": link}}
    for quantity, expected in zip(("claimed", "actual"), brute_force(scenario, pair), strict=True):
        found = sf.predict(scenario, None, "general", quantity, estimator=OneByOne)
        for agent in range(3):
            of = found.values("trace", agent=agent + 1)[0, -1]
            assert of == pytest.approx(np.trace(expected[agent]), rel=1e-9)


def test_inverse_covariance_intersection_is_the_published_rule():
    from scipy.optimize import minimize_scalar

    rule, rng = literature().InverseCovarianceIntersection(), np.random.default_rng(3)
    for _ in range(5):
        common, *own = (M @ M.T + 0.1 * np.eye(3) for M in rng.normal(size=(3, 3, 3)))
        A, B = (inv(inv(common) + inv(M)) for M in own)  # each holds the common estimate, and one of its own
        x, P = rule.fuse(np.eye(6).reshape(2, 3, 6), np.stack([A, B]))
        K, L = x[:, :3], x[:, 3:]
        best = minimize_scalar(
            lambda ω, A=A, B=B: np.trace(inv(inv(A) + inv(B) - inv(ω * A + (1 - ω) * B))),
            bounds=(0, 1), method="bounded", options={"xatol": 1e-9},
        )  # fmt: skip
        assert np.trace(P) == pytest.approx(best.fun, rel=1e-7)
        # theorem of the paper: whatever is common, the claim covers the error, and claims less than intersection
        cross = A @ inv(common) @ B
        true = K @ A @ K.T + L @ B @ L.T + K @ cross @ L.T + L @ cross.T @ K.T
        assert np.linalg.eigvalsh(P - true).min() > -1e-9
        ci = min(np.trace(inv(w * inv(A) + (1 - w) * inv(B))) for w in np.linspace(0, 1, 101))
        assert np.trace(P) <= ci + 1e-9
        np.testing.assert_allclose(K + L, np.eye(3), atol=1e-9)


def test_diffusion_follows_the_network_covariance_of_the_paper():
    """Cattivelli and Sayed 2010: P ← 𝓒ᵀ 𝓜 (𝓕 P 𝓕ᵀ + 11ᵀ⊗Q) 𝓜ᵀ 𝓒 + 𝓒ᵀ K R Kᵀ 𝓒 over the stacked errors."""
    rule, n, d, steps = literature().DiffusionKalman, 3, 2, 6
    # each hears the next one in a ring
    ring = np.roll(np.eye(n), 1, axis=1)
    scenario = {**SMALL, "network": {"agents": n, "steps": steps, "link": ring.tolist()}}
    scenario["initial"] = {"P": SMALL["initial"]["P"]}
    scenario["agent"] = [{"R": 2}, {"R": 5}, {"R": 0.5}]
    F, Q, H = (np.array(SMALL["model"][name], float) for name in "FQH")
    mixes, own = np.kron((np.eye(n) + ring) / 2, np.eye(d)), [np.array(SMALL["initial"]["P"], float)] * n
    joint = mixes @ np.kron(np.eye(n), own[0]) @ mixes.T
    for _ in range(steps - 1):
        big, noise = np.zeros((n * d, n * d)), np.zeros((n * d, n * d))
        for i, R in enumerate((2.0, 5.0, 0.5)):
            prior, at = F @ own[i] @ F.T + Q, slice(i * d, i * d + d)
            own[i] = inv(inv(prior) + H.T @ H / R)
            big[at, at] = own[i] @ inv(prior)
            noise[at, at] = own[i] @ H.T @ H @ own[i] / R
        joint = np.kron(np.eye(n), F) @ joint @ np.kron(np.eye(n), F).T + np.kron(np.ones((n, n)), Q)
        joint = mixes @ (big @ joint @ big.T + noise) @ mixes.T
    found = sf.predict(scenario, None, "general", "actual", estimator=rule)
    for agent in range(n):
        at = slice(agent * d, agent * d + d)
        assert found.values("trace", agent=agent + 1)[0, -1] == pytest.approx(np.trace(joint[at, at]), rel=1e-9)


# R. Forsling, "Track fusion design in decentralized target tracking", poster, Linköping University, November 2023:
# root of the trace of the claim of the third agent at k = 2, 5, 8, 11, from github.com/robinforsling/dtt (commit f0f5660),
# poster/matlab/data/data__design_evaluation_results_rmt.tex; scenario and fusion rules: poster/matlab/track_fusion_design.m
FORSLING = {
    "naive": (8.129, 5.165, 4.832, 4.820),
    "covariance-intersection": (12.713, 8.395, 7.912, 7.893),
    "inverse covariance intersection": (11.812, 7.640, 7.359, 7.356),
}


@pytest.mark.parametrize("rule", FORSLING)
def test_claims_of_three_trackers_in_a_ring_are_the_published_numbers(rule):
    wide, turn = np.diag([100.0, 25.0]), np.array([[0.5, -np.sqrt(0.75)], [np.sqrt(0.75), 0.5]])
    still, moves = np.eye(4), np.kron([[1, 1], [0, 1]], np.eye(2))
    Q = 4 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1]], np.eye(2))
    talks = [np.zeros((3, 3)), *(np.eye(3)[:, [(k + 1) % 3]] @ np.eye(3)[[k % 3]] for k in range(12))]
    scenario = {
        "schema": "stochfuse.scenario/1",
        # the poster starts every agent from its own first measurement: one step more, from next to no knowledge
        "model": {
            "F": np.stack([still, still, *[moves] * 11]).tolist(),
            "Q": np.stack([0 * still, 0 * still, *[Q] * 11]).tolist(),
            "H": np.eye(2, 4).tolist(),
            "R": 1,
        },
        "initial": {"P": np.diag([1e9, 1e9, 100, 100]).tolist()},
        "network": {"agents": 3, "steps": 13, "link": np.stack(talks).tolist()},
        "agent": [{"R": R.tolist()} for R in (wide, turn @ wide @ turn.T, turn.T @ wide @ turn)],
    }
    how = {"estimator": rule, "criterion": "trace"} if rule == "covariance-intersection" else {"estimator": rule}
    if rule.startswith("inverse"):
        how["estimator"] = literature().InverseCovarianceIntersection
    found = sf.predict(scenario, None, "general", "claimed", **how)
    claims = np.sqrt(found.values("trace", agent=3)[0, [2, 5, 8, 11]])
    assert claims == pytest.approx(FORSLING[rule], abs=6e-4)  # three decimals are printed


def test_diffusion_settles_where_the_paper_says():
    """Cattivelli and Sayed 2010, steady state: P = 𝓕 P 𝓕ᵀ + 𝓖, solved, of filters that have settled (Riccati)."""
    from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

    F, H, Q = (np.array(SMALL["model"][name], float) for name in "FHQ")
    mixes, every = np.array([[1, 1, 0], [1, 1, 1], [0, 1, 1]]) / [[2], [3], [2]], (2.0, 5.0, 0.5)
    priors = [solve_discrete_are(F.T, H.T, Q, np.array([[R]])) for R in every]
    K = [prior @ H.T / (H @ prior @ H.T + R) for prior, R in zip(priors, every, strict=True)]
    keeps = np.stack([np.eye(2) - gain @ H for gain in K])
    moves = np.block([[c * A @ F for c, A in zip(row, keeps, strict=True)] for row in mixes])
    shared = np.concatenate([np.tensordot(row, keeps, 1) for row in mixes])
    noise = sum(
        R * np.kron(np.outer(mixes[:, i], mixes[:, i]), K[i] @ K[i].T) for i, R in enumerate(every)
    )  # fmt: skip
    settled = solve_discrete_lyapunov(moves, shared @ Q @ shared.T + noise)

    scenario = {**SMALL, "network": {"agents": 3, "steps": 60, "link": [[0, 1, 0], [1, 0, 1], [0, 1, 0]]}}
    scenario["initial"], scenario["agent"] = {"P": SMALL["initial"]["P"]}, [{"R": R} for R in every]
    found = sf.predict(scenario, None, "general", "actual", estimator=literature().DiffusionKalman)
    traces = [found.values("trace", agent=i + 1)[0, -1] for i in range(3)]
    assert traces == pytest.approx(np.diag(settled).reshape(3, 2).sum(axis=1), rel=1e-9)
    mean = np.mean(traces)  # the paper's network mean square deviation
    assert mean == pytest.approx(np.trace(settled) / 3, rel=1e-9)


def rule_of(fuse, **says):
    return SimpleNamespace(fuse=fuse, name="mine", **says)


def changed(x, P):
    P[0] *= 2
    return x[0], P[0]


def skew(x, P):
    return x[0], P[0] + np.array([[0, 1], [0, 0]])


RUBBISH = {
    "no pair": (lambda x, P: x[0], r"expected \(x, P\) of shapes \(2, 6\) and \(2, 2\), got ndarray"),
    "one number": (lambda x, P: (x[0], 1.0), r"of shapes \(2, 6\) and \(2, 2\), got a number"),
    "wrong shape": (lambda x, P: (x, P[0]), r"expected \(x, P\) of shapes .*, got 2 of 2×6"),
    "complex": (lambda x, P: (x[0] * 1j, P[0]), "got complex128 numbers"),
    "text": (lambda x, P: ("x", "P"), "got <U1 numbers"),
    "ragged": (lambda x, P: ([[1], [1, 2]], P[0]), "got what is no array"),
    "not a number": (lambda x, P: (x[0], np.log(-P[0])), r"a covariance, got a value that is not finite"),
    "infinite": (lambda x, P: (x[0] / 0, P[0]), "expected a fused x, got values that are not finite"),
    "asymmetric": (skew, "a covariance, got an asymmetric one"),
    "indefinite": (lambda x, P: (x[0], P[0] - 2 * P[1]), "a covariance, got a variance of -"),
    "in place": (changed, r"changes its inputs in place \(line \d+ of test_own_rules.py\)"),
    "an error": (lambda x, P: {}["a"], r"KeyError: 'a' \(line \d+ of test_own_rules.py\)"),
    "biased": (lambda x, P: (x[0] + 0.5 * x[1], P[0]), r"expected weights with Σ K_i = I, got \[\[1.5"),
    "affine": (lambda x, P: (x[0] + 1, P[0]), "a sum Σ K_i x_i of weights"),
    "gating": (Gates().fuse, r"a sum Σ K_i x_i of weights that depend on the P_i alone, got none; run and simulate"),
    "wider for x": (lambda x, P: (x[0], P[0] * (1 + np.abs(x).max())), "expected a P that depends on the P_i alone"),
    "order": (lambda x, P: (x[-1], P[-1]), "its result depends on the order of those heard; say so by ordered = True"),
}


@pytest.mark.parametrize("what", RUBBISH)
def test_rubbish_is_named_with_step_and_agent(what):
    fuse, why = RUBBISH[what]
    scenario = {**SMALL, "network": {**SMALL["network"], "steps": 2}}
    if what == "order":  # of more than two
        scenario = {**SMALL, "network": {"agents": 3, "steps": 2, "link": 1.0}}
    with pytest.raises(sf.UsageError, match=rf"^estimator mine: step [12], agent \d: .*{why}") as error:
        sf.predict(scenario, None, "general", "actual", estimator=rule_of(fuse))
    assert "\n" not in str(error.value)


def test_rubbish_of_the_second_step_names_it():
    def late(x, P):
        return (x[0], P[0]) if P[0, 0, 0] == 9 else (x[0], -P[0])

    with pytest.raises(sf.UsageError, match=r"^estimator mine: step 2, agent 1: .* got a variance of -"):
        sf.predict(SMALL, None, "monte-carlo", estimator=rule_of(late), runs=5)


def test_a_gate_runs_on_data_and_is_not_predicted():
    found = sf.simulate(sf.load_scenario(SMALL, steps=2), 20, estimator=Gates(), link=0.5)
    assert found.rows[0].realised > 0
    assert found.rows[0].predicted is None
    assert any("run and simulate, which have data, take such a rule" in note for note in found.notes)


def test_a_rule_refuses_what_it_says():
    rule = rule_of(Adds().fuse, refuses={"delay": "late messages are old news"})
    late = {**SMALL, "network": {**SMALL["network"], "delay": [0.5, 0.5]}}
    with pytest.raises(sf.UsageError, match=r"estimator mine: late messages are old news; .* take"):
        sf.predict(late, None, "general", estimator=rule)
    with pytest.raises(sf.UsageError, match=r"refuses: expected features of no-sensor, .*, got 'weather'"):
        sf.predict(SMALL, None, "general", estimator=rule_of(Adds().fuse, refuses={"weather": "rain"}))
    with pytest.raises(sf.UsageError, match=r"estimator .*Adds: expected agents that track one state, got states of"):
        sf.predict("beacon-map", None, "general", estimator=Adds)


def test_names_travel_and_are_equal_only_with_one_rule():
    one, two = own_rules.estimator_named(Adds), own_rules.estimator_named(Adds)
    assert one == two == "tests.estimators.test_own_rules:Adds"
    assert own_rules.estimator_named(one) is one
    other = own_rules.OwnRule(str(one), Adds())
    assert other != one
    back = pickle.loads(pickle.dumps(one))
    assert type(back.rule) is Adds
    assert str(back) == str(one)
    assert one.travels
    assert not own_rules.estimator_named(rule_of(Adds().fuse)).entry.sums
    with pytest.raises(sf.UsageError, match="expected different ones, got mine, mine"):
        own_rules.estimators_named([rule_of(Adds().fuse), rule_of(Gates().fuse)])


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("os:system", r"or a class, or an object, with a method fuse\(x, P\), got os:system, which has none"),
        ("nowhere.at_all:Mine", r"got 'nowhere.at_all:Mine' \(ModuleNotFoundError"),
        ("math:Mine", r"got 'math:Mine' \(AttributeError"),
        ("naiv", r"expected one of .*, or package.module:Class, got 'naiv' \(did you mean 'naive'\?\)"),
        ("mine.Mine", r"or package.module:Class, got 'mine.Mine' \(did you mean 'mine:Mine'\?\)"),
        ("./mine.py:Mine", r"names and no path of a file, got './mine.py:Mine' \(did you mean 'mine:Mine'\?\)"),
        ("mine:", r"names and no path of a file, got 'mine:'$"),
        (
            rule_of(lambda x: (x[0], 1)),
            r"estimator mine: expected a method fuse\(self, x, P\), got one called by fuse\(x\)",
        ),
        (3, r"with a method fuse\(x, P\), got builtins:int, which has none"),
        (type("Needs", (Adds,), {"__init__": lambda self, weight: None}), "made without arguments, or an object of it"),
    ],
)
def test_what_is_no_rule_is_named(given, why):
    with pytest.raises(sf.UsageError, match=why):
        sf.predict(SMALL, None, "general", estimator=given)


def test_entry_points_give_short_names(monkeypatch):
    point = SimpleNamespace(name="adds", load=lambda: Adds)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == own_rules.GROUP else [])
    found = sf.predict("thesis-transient", [0.5], "monte-carlo", estimator="adds", runs=2)
    assert found.estimator == "adds"
    assert type(found.estimator.rule) is Adds


def test_the_command_line_finds_rules_in_its_folder_and_scenario_files_never_do(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "here_rules.py").write_text(
        "print('loaded')\nclass Mine:\n    'What I do.'\n    def fuse(self, x, P):\n        return x[0], P[0]\n"
    )
    small = {**SMALL, "network": {**SMALL["network"], "steps": 2}}
    (tmp_path / "s.json").write_text(json.dumps({**small, "report": {"estimator": "here_rules:Mine"}}))
    done = run("predict", "s.json", code=2, cwd=tmp_path)
    assert re.search("report.estimator: expected one of .*, got 'here_rules:Mine'", done.stderr)
    assert "loaded" not in done.stdout
    (tmp_path / "s.json").write_text(json.dumps(small))
    words = ("predict", "s.json", "--estimator", "here_rules:Mine", "--format", "json")
    shown = run(*words, cwd=tmp_path).stdout.removeprefix("loaded\n")
    alone = run(*words[:3], "stand-alone", *words[4:], cwd=tmp_path).stdout
    assert json.loads(shown)["meta"]["estimator"] == "here_rules:Mine"
    np.testing.assert_allclose(json.loads(shown)["values"], json.loads(alone)["values"])
    listed = json.loads(run("methods", "--estimator", "here_rules:Mine", "--format", "json", cwd=tmp_path).stdout)
    assert {"name": "here_rules:Mine", "title": "What I do", "source": "here_rules"} in listed["estimators"]
    assert listed["matrix"]["here_rules:Mine"]["general"]["delay"] is True
    assert "states of their own" in listed["matrix"]["here_rules:Mine"]["general"]["own-states"]
    bad = run(*words[:3], "here_rules:Yours", code=2, cwd=tmp_path)
    assert bad.stderr.startswith("error: --estimator: expected package.module:Class to load, got 'here_rules:Yours'")


@pytest.mark.slow
def test_workers_import_a_rule_and_the_sample_is_the_same():
    few, many = (
        sf.predict(SMALL, None, "monte-carlo", "actual", estimator=Adds, runs=400, workers=w).values() for w in (1, 2)
    )
    np.testing.assert_array_equal(few, many)
