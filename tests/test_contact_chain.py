"""The contact chain against published numbers, brute force over every history, and its own enclosure."""

from __future__ import annotations

from itertools import pairwise, product
from math import comb

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines import contact_chain
from tests import strategies, textbook

PUBLISHED = {
    ("ad-hoc", 0.25): (77.083, 39.984, 32.577, 30.779, 30.335),
    ("broadcast", 0.5): (58.333, 30.666, 26.190, 25.318, 25.145),
    ("cyclic", 0.75): (62.5, 32.277, 27.380, 26.457, 26.281),
}


@pytest.mark.parametrize(("architecture", "link"), PUBLISHED)
def test_published_numbers(architecture, link):
    p = sf.predict(sf.load_scenario(architecture=architecture), [link], method="optimal")
    np.testing.assert_allclose(p.values()[0], PUBLISHED[architecture, link], atol=5.1e-4)
    assert (p.nature, p.quantity) == ("exact", "optimal")


def optimum_by_brute_force(F, Q, H, R, P0, n, steps, architecture, link, shared):
    """Every history; the measurements in each agent's pedigree, filtered centrally."""
    expected = np.zeros((steps, *P0.shape))
    full = np.broadcast_to(np.reshape(link, (-1, 1, 1)), (steps, n, n))
    for probability, history in textbook.histories(n, steps, architecture, full):
        held = [{(i, 1)} for i in range(n)]
        for k in range(1, steps + 1):
            for i in range(n):
                held[i] = held[i] | {(i, k)}
            held = [held[i].union(*(held[j] for j, receiver, _ in history[k - 1] if receiver == i)) for i in range(n)]
            for i in range(n):
                count = [sum(node[1] == t for node in held[i]) for t in range(1, k + 1)]
                P = P0 if shared else P0 / count[0]
                for r in count[1:]:
                    P = textbook.kalman_predict(P, F, Q)
                    for _ in range(r):
                        P = textbook.kalman_update(P, H, R)
                expected[k - 1] += probability * P / n
    return expected


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("architecture", "agents", "steps"),
    [("ad-hoc", 2, 4), ("ad-hoc", 3, 2), ("broadcast", 3, 3), ("cyclic", 3, 3), ("cyclic", 4, 3)],
)
def test_against_every_history(architecture, agents, steps, shared):
    rng = np.random.default_rng(agents + steps)
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    link = rng.uniform(0.2, 0.8, steps)
    source = strategies.mapping(F, Q, H, R, P0, agents, steps, architecture=architecture, link=link.tolist())
    source["initial"]["correlation"] = "shared" if shared else "independent"
    got = sf.predict(sf.Scenario.from_mapping(source), method="optimal").covariance[0]
    expected = optimum_by_brute_force(F, Q, H, R, P0, agents, steps, architecture, link, shared)
    np.testing.assert_allclose(got, expected, rtol=1e-10)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("link", [0.0, 0.07, 0.5, 1.0])
def test_the_enclosure_holds_the_exact_value(architecture, link, monkeypatch):
    scenario = sf.load_scenario(architecture=architecture, agents=5, steps=7)
    exact = sf.predict(scenario, [link], method="optimal")
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 1)
    enclosed = sf.predict(scenario, [link], method="optimal")
    bound = np.array(enclosed.meta["relative_bound"])
    assert enclosed.nature == "bound"
    assert (bound < 1e-6).all()
    assert (np.abs(enclosed.values() / exact.values() - 1) <= bound * (1 + 1e-9) + 1e-14).all()


def test_many_agents_and_steps():
    p = sf.predict(sf.load_scenario(agents=50, steps=50), [0.05], method="optimal")
    assert np.max(p.meta["relative_bound"]) < 1e-6
    assert "the optimum is proved to lie within a relative" in p.notes[0]


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
def test_number_of_paths(architecture):
    for n, k in product(range(1, 5), range(1, 6)):
        falls = range(n) if architecture != "cyclic" else range(2)
        paths = {
            r for r in product(range(1, n + 1), repeat=k)
            if r[-1] - 1 in falls and all(a - b in falls for a, b in pairwise(r))
        }  # fmt: skip
        assert contact_chain.number_of_paths(architecture, n, k) == len(paths)
    assert contact_chain.number_of_paths("ad-hoc", 3, 5) == comb(7, 5) == 21


def test_limits_and_order():
    """µ = 0: the Kalman filter; µ = 1: broadcast fusion; between, never above the general formulation's simplified cousin."""
    scenario, link = sf.load_scenario(steps=4), np.linspace(0, 1, 11)
    optimal, simplified = (sf.predict(scenario, link, m).values() for m in ("optimal", "simplified"))
    np.testing.assert_allclose(optimal[[0, -1]], simplified[[0, -1]], rtol=1e-12)
    assert (np.diff(optimal, axis=0) < 1e-12).all()
    assert (optimal <= simplified + 1e-12).all()


def test_what_the_chain_does_not_take():
    with pytest.raises(sf.UsageError, match="method 'optimal' does not take links that differ yet"):
        sf.predict(sf.load_scenario("fcs-demo", steps=2), method="optimal")
    source = strategies.mapping(1, 25, 1, 100, 100, 2, 2, delay=[0.5, 0.5], link=0.5)
    with pytest.raises(sf.UsageError, match=r"does not take network.delay yet"):
        sf.predict(sf.Scenario.from_mapping(source), method="optimal")
    source = strategies.mapping(1, 25, 1, 100, 100, 2, 2, link=0.5) | {"agent": [{}, {"R": 1}]}
    with pytest.raises(sf.UsageError, match="does not take unlike agents yet"):
        sf.predict(sf.Scenario.from_mapping(source), method="optimal")
    with pytest.raises(sf.UsageError, match="paths, at most 20000 are gone through for a state of several dimensions"):
        sf.predict(sf.load_scenario("cv-2d", agents=20, steps=20), [0.5], method="optimal")
