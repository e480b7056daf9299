"""Many outcomes at a time: the sample that history by history gives, and that of a textbook search."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines import monte_carlo
from stochfuse.engines.events import events
from stochfuse.errors import NoAnswerError, TooManyError
from stochfuse.estimators import pedigrees, together
from stochfuse.prediction import sampled
from stochfuse.scenario.scenario import link_rows
from tests.oracles import textbook

LINK = np.array([[0, 0.3, 0.6, 0.4], [0.5, 0, 0.2, 0.7], [0.4, 0.6, 0, 0.5], [0.3, 0.4, 0.5, 0]])
TWO_STATES = {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.3, 0.5], [0.5, 1]]}
UNLIKE = [{"R": 50}, {"R": 200}, {"R": 70}, {"H": [[0, 1]], "R": 30}]
CASES = {
    "unlike agents": {"agent": UNLIKE},
    "delays, misses, bursts": {
        "network": {
            "delay": [0.5, 0.3, 0.2],
            "burst": {"good": 0.8, "bad": 0.1, "good_to_bad": 0.3, "bad_to_good": 0.4},
        },
        "agent": [{"sensor": {"detection": 0.6}, **each} for each in UNLIKE],
    },
    "masks, shared start, late": {
        "network": {"hears": [[2], [3, 4], [1, 4], [2]], "link": 0.6, "delay": [0.7, 0.3]},
        "initial": {"P": [[90, 5], [5, 12]], "correlation": "shared"},
    },
    "noise of each step, initial error": {
        "model": {**TWO_STATES, "R": [[[40.0 * k]] for k in range(1, 6)]},
        "initial": {"P": [[90, 5], [5, 12]], "error": [9, -2]},
    },
}
ESTIMATORS = ("local-fusion-graph", "naive", "covariance-intersection", "split-ci", "stand-alone")


def scenario(name, steps=5):
    source = {
        "model": {**TWO_STATES, "R": 100},
        "initial": {"P": [[90, 5], [5, 12]]},
        "network": {"link": LINK.tolist()},
        "agent": [{}, {}, {}, {}],
    }
    source |= CASES[name]
    source["network"] |= {"agents": 4, "steps": steps}
    return sf.Scenario.from_mapping(source)


def drawn(given, monkeypatch, few, **how):
    """What every agent of every run has, history by history where `few` agents are more than there are."""
    monkeypatch.setattr(sampled, "FEW_TOGETHER", few)
    how = {"method": "monte-carlo", "runs": 12, "seed": 3, "workers": 1, **how}
    found = sf.predict(given, **how).sampled.sample
    return [each[found.which] for each in found.values if each is not None]


@pytest.mark.parametrize("quantity", ["claimed", "actual"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("case", CASES)
def test_the_sample_is_that_of_single_histories(case, estimator, quantity, monkeypatch):
    given = scenario(case, steps=4 if estimator in ESTIMATORS[:2] else 3)
    if estimator == "stand-alone" and given.network.delay != (1.0,):
        pytest.skip("no fusion takes no delay")
    how = {"estimator": estimator, "quantity": quantity}
    one, other = drawn(given, monkeypatch, 0, **how), drawn(given, monkeypatch, 10**6, **how)
    for many, single in zip(one, other, strict=True):
        np.testing.assert_allclose(many, single, rtol=1e-9, atol=1e-9)


def test_the_sample_is_that_of_the_textbook(monkeypatch):
    """Sets of nodes, recursion, inverses: delays, unlike agents, a run at a time."""
    F, Q, P0 = np.array([[1.0, 1], [0, 1]]), np.array([[0.3, 0.5], [0.5, 1]]), np.array([[90.0, 5], [5, 12]])
    agents = [(np.array([[1.0, 0]]), np.array([[R]])) for R in (50.0, 200, 70, 30)]
    source = {
        "model": {"F": F.tolist(), "H": [[1, 0]], "Q": Q.tolist(), "R": 1},
        "initial": {"P": P0.tolist()},
        "network": {"agents": 4, "steps": 4, "link": LINK.tolist(), "delay": [0.6, 0.3, 0.1]},
        "agent": [{"R": float(R[0, 0])} for _, R in agents],
    }
    given = sf.Scenario.from_mapping(source)
    (claimed,) = drawn(given, monkeypatch, 0, runs=6)
    now = [events(given.network, link_rows(given), step) for step in range(1, 5)]
    fates, _ = monte_carlo.draw_fates(monte_carlo.stream(3, 0, 0), now, [[]] * 4, (6, 4))
    for run in range(6):
        history = [set() for _ in range(4)]
        for step, (drawn_now, fate) in enumerate(zip(now, fates, strict=True)):
            for event, what in zip(drawn_now, fate[run], strict=True):
                if what and step + what - 1 < 4:
                    history[step + what - 1].add((event.sender, event.receivers[0], step + 1))
        oracle = textbook.FusionNetwork(F, Q, agents, P0, np.zeros((2, 1)), np.zeros((4, 4, 1, 1)), history)
        for step in range(4):
            for agent in range(4):
                expected = oracle.covariance(agent, step + 1)
                np.testing.assert_allclose(claimed[0, run, step, agent], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("estimator", ["local-fusion-graph", "split-ci"])
def test_how_many_are_at_hand_changes_nothing(estimator, monkeypatch):
    given = scenario("delays, misses, bursts")
    how = {"estimator": estimator, "quantity": "actual", "runs": 4}
    expected = drawn(given, monkeypatch, 0, **how)
    for room, name, value in (
        (pedigrees, "AT_A_TIME", 5),
        (together, "MOST_NUMBERS", 3000),
        (monte_carlo, "MOST_TOGETHER", 2),
        (monte_carlo, "DRAWN", 3),
    ):
        monkeypatch.setattr(room, name, value)
    for some, whole in zip(drawn(given, monkeypatch, 0, **how), expected, strict=True):
        np.testing.assert_allclose(some, whole, rtol=1e-10, atol=1e-11)


def test_states_given_data(monkeypatch):
    given = scenario("unlike agents")
    records = np.random.default_rng(0).normal(size=(5, 4, 1))
    found = []
    for few in (0, 10**6):
        monkeypatch.setattr(sampled, "FEW_TOGETHER", few)
        found.append(sf.expected_states(given, records, method="monte-carlo", runs=20, workers=1).x)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-9)


def test_what_would_not_fit_is_refused_with_the_number(monkeypatch):
    monkeypatch.setattr(pedigrees, "MOST_ROWS", 1 << 16)
    monkeypatch.setattr(pedigrees, "AT_A_TIME", 1)
    expected = r"of (\d+) received estimates is made of up to 2\^\1 = .* intersections .* --method optimal"
    with pytest.raises(TooManyError, match=expected):
        sf.predict(sf.load_scenario(agents=30, steps=3), [0.6], method="monte-carlo", runs=2)


def test_a_set_that_was_met_is_not_gone_through_again(monkeypatch):
    placed, met = pedigrees.GraphTogether._placed, []

    def watched(self, levels, keys, run):
        places, new = placed(self, levels, keys, run)
        met.extend((id(self), int(levels[i]), int(keys[i])) for i in new)
        return places, new

    monkeypatch.setattr(pedigrees.GraphTogether, "_placed", watched)
    drawn(scenario("unlike agents"), monkeypatch, few=2)
    assert len(met) > 400
    assert len(set(met)) == len(met)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_hundreds_of_agents(estimator):
    """A chain in which everyone hears the one before: after step 1 two starts, whatever the rule makes of them."""
    n = 70
    link = np.zeros((n, n))
    link[np.arange(1, n), np.arange(n - 1)] = 1
    source = {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}}
    source["network"] = {"agents": n, "steps": 2, "link": link.tolist()}
    p = sf.predict(sf.Scenario.from_mapping(source), method="monte-carlo", runs=2, estimator=estimator)
    got = p.sampled.sample.values.P[p.sampled.sample.which][0, 0, :, :, 0, 0]
    adds = estimator in ("local-fusion-graph", "naive")
    np.testing.assert_allclose(got[0], [100] + [50 if adds else 100] * (n - 1), rtol=1e-12)
    alone = 1 / (1 / 125 + 1 / 100)
    assert got[1, 0] == pytest.approx(alone, rel=1e-12)
    if estimator == "local-fusion-graph":  # what neighbours have in common is the start of the one between them
        local = [alone] + [1 / (1 / 75 + 1 / 100)] * (n - 1)
        fused = [alone, *(1 / (1 / a + 1 / b - 1 / 125) for a, b in pairwise(local))]
        np.testing.assert_allclose(got[1], fused, rtol=1e-12)


@pytest.mark.parametrize("estimator", ["local-fusion-graph", "covariance-intersection"])
def test_processes_share_the_runs_of_a_block(estimator, monkeypatch):
    given = scenario("delays, misses, bursts", steps=3)
    one, two = (
        drawn(given, monkeypatch, 0, estimator=estimator, quantity="actual", runs=7, workers=workers)
        for workers in (1, 2)
    )
    for alone, shared in zip(one, two, strict=True):
        np.testing.assert_allclose(shared, alone, rtol=1e-11, atol=1e-12)


def test_runs_of_many_agents_are_drawn_in_smaller_blocks(monkeypatch):
    """As many links in each, about, as in one of a thousand runs of sixty agents."""
    monkeypatch.setattr(monte_carlo, "MOST_OF_BLOCK", 0)
    monkeypatch.setattr(monte_carlo, "BLOCK", 3)
    blocks = monte_carlo.blocks_of(5, 4, 2)
    assert [(b.row, b.number, b.first, b.size) for b in blocks] == [
        (row, number, number, 1) for row in range(2) for number in range(5)
    ]
    monkeypatch.setattr(monte_carlo, "MOST_OF_BLOCK", 4)
    assert [b.size for b in monte_carlo.blocks_of(5, 8, 1)] == [1] * 5
    assert [(b.first, b.size) for b in monte_carlo.blocks_of(5, 4, 1)] == [(0, 3), (3, 2)]


@pytest.mark.parametrize("R", [1, 100])
def test_sets_that_meet_in_pairs_alone_leave_less_than_nothing(R):
    """Four agents each know three starts, every two of them one in common: 4 (f(3) + 1/R) − 6 f(1), f brings forward."""
    first, second = np.zeros((2, 7, 7))
    for agent, heard in enumerate([[3, 4], [0, 5], [1, 4], [2, 5]]):
        first[agent, heard] = 1
    second[0, 1:4] = 1
    source = {"model": {"F": 1, "H": 1, "Q": 9, "R": R}, "initial": {"P": 1}}
    network = {"agents": 7, "steps": 2, "link": [first.tolist(), second.tolist()]}
    given = sf.Scenario.from_mapping(source | {"network": network})
    information = 4 * (1 / (Fraction(1, 3) + 9) + Fraction(1, R)) - 6 * 1 / (1 + Fraction(9))
    if information > 0:
        found = sf.predict(given, method="monte-carlo", runs=2).values(agent=1)[0, 1]
        assert found == pytest.approx(float(1 / information), rel=1e-12)
        return
    assert information == Fraction(-23, 175)
    message = (
        "^run 1: at step 2 the information of agent 1 is not positive definite .the Local Fusion Graph's own answer"
    )
    with pytest.raises(NoAnswerError, match=message):
        sf.predict(given, method="monte-carlo", runs=2)
