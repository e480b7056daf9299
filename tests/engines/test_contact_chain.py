"""The contact chain against published numbers, brute force over every history, and its own enclosure."""

from __future__ import annotations

from itertools import pairwise, product
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.engines import contact_chain, enclosure
from stochfuse.engines.contact_chain import number_of_paths
from stochfuse.prediction import optimal
from stochfuse.scenario.network import Network, default_rows
from tests.agreement.test_accuracy import CASES
from tests.oracles import strategies, textbook

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


@pytest.mark.slow
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


BURST = {"good_to_bad": 0.2, "bad_to_good": 0.35, "good": 0.95, "bad": 0.1}
UNEVEN = [[0, 0.3, 0.9], [0.6, 0, 0.2], [0.5, 0.8, 0]]
COLUMNS = [[0, 0.7, 0.2], [0.4, 0, 0.2], [0.4, 0.7, 0]]
AGENTS = [{}, {"R": 20.0}, {"R": 350.0}]
NETWORKS = {
    "unequal links": ("ad-hoc", 3, 3, {"link": UNEVEN}, None),
    "unequal links by step": ("ad-hoc", 3, 2, {"link": [UNEVEN, 0.4]}, None),
    "unequal senders": ("broadcast", 3, 3, {"link": COLUMNS}, None),
    "unequal links on a ring": ("cyclic", 3, 4, {"link": UNEVEN}, None),
    "unlike agents": ("ad-hoc", 3, 3, {"link": 0.4}, AGENTS),
    "unlike agents, broadcast": ("broadcast", 3, 3, {"link": COLUMNS}, AGENTS),
    "links by step": ("ad-hoc", 3, 3, {"link": [0.2, 0.9, 0.5]}, None),
    "delays": ("ad-hoc", 2, 4, {"link": 0.6, "delay": [0.5, 0.3, 0.2]}, None),
    "delays, three agents": ("ad-hoc", 3, 2, {"link": 0.6, "delay": [0.4, 0.6]}, None),
    "delays, broadcast": ("broadcast", 3, 3, {"link": 0.6, "delay": [0.4, 0.6]}, None),
    "delays on a ring": ("cyclic", 3, 4, {"link": 0.6, "delay": [0.4, 0.6]}, None),
    "delays and unequal links": ("ad-hoc", 2, 4, {"link": [[0, 0.3], [0.8, 0]], "delay": [0.2, 0.8]}, None),
    "delays and unlike agents": ("broadcast", 3, 3, {"link": 0.6, "delay": [0.4, 0.6]}, AGENTS),
    "unequal delays": ("ad-hoc", 2, 4, {"link": 0.6, "delay": [[0, 1], [[0.2, 0.5, 0.3], 0]]}, None),
    "unequal delays, three agents": ("ad-hoc", 3, 2, {"link": 0.6, "delay": [[0, 1, 0], [0, 0, [0.5, 0.5]], [0, 0, 0]]}, AGENTS),
    "unequal delays, broadcast": ("broadcast", 3, 3, {"link": 0.6, "delay": [[0, 1, [0.3, 0.7]], [0, 0, [0.3, 0.7]], [0, 1, 0]]}, None),
    "unequal delays on a ring": ("cyclic", 3, 4, {"link": 0.6, "delay": [[0, 1, 0], [0, 0, [0.4, 0.6]], [0, 0, 0]]}, None),
    "unequal delays and bursts": ("ad-hoc", 2, 4, {"burst": BURST, "delay": [[0, 1], [[0.5, 0.5], 0]]}, None),
    "bursts": ("ad-hoc", 2, 5, {"burst": BURST}, None),
    "bursts, three agents": ("ad-hoc", 3, 3, {"burst": BURST}, None),
    "bursts, broadcast": ("broadcast", 3, 4, {"burst": BURST}, None),
    "bursts on a ring": ("cyclic", 3, 4, {"burst": BURST}, None),
    "bursts and unlike agents": ("ad-hoc", 3, 3, {"burst": BURST}, AGENTS),
    "bursts and no bursts": ("ad-hoc", 2, 4, {"case": [{"name": "b", "burst": BURST}, {"name": "m", "link": 0.3}]}, None),
    "bursts and delays": ("ad-hoc", 2, 4, {"burst": BURST, "delay": [0.5, 0.3, 0.2]}, None),
    "bursts and delays, three agents": ("ad-hoc", 3, 2, {"burst": BURST, "delay": [0.4, 0.6]}, None),
    "bursts and delays, broadcast": ("broadcast", 3, 3, {"burst": BURST, "delay": [0.4, 0.6]}, AGENTS),
    "bursts and delays on a ring": ("cyclic", 3, 4, {"burst": BURST, "delay": [0.4, 0.6]}, None),
    "bursts, unlike agents, broadcast": ("broadcast", 3, 3, {"burst": BURST}, AGENTS),
}  # fmt: skip


def scenario_of(name, d=1, **initial):
    architecture, agents, steps, network, agent = NETWORKS[name]
    rng = np.random.default_rng(list(NETWORKS).index(name))
    F, Q, H, R, P0 = strategies.model(rng, d, 1)
    source = strategies.mapping(F, Q, H, R, P0, agents, steps, architecture=architecture, **network)
    source["initial"] |= {"error": rng.normal(size=d).tolist(), **initial}
    return sf.Scenario.from_mapping(source | ({"agent": agent} if agent else {}))


@pytest.mark.parametrize("network", NETWORKS)
def test_against_enumeration_of_the_optimum(network):
    """The enumeration goes forwards through every outcome and asks the pedigrees; the chain goes backwards."""
    scenario = scenario_of(network, d=2)
    chain = sf.predict(scenario, method="optimal", quantity="rms")
    every = sf.predict(scenario, method="general", estimator="optimal", quantity="rms")
    for agent in range(1, scenario.network.agents + 1):
        for quantity in ("actual", "claimed", "bias", "rms"):
            expected = every.shown_as(quantity).of_agent(agent)
            np.testing.assert_allclose(chain.shown_as(quantity).of_agent(agent), expected, rtol=1e-10, atol=1e-13)
    assert chain.nature == "exact"


@pytest.mark.parametrize("network", ["unequal links", "delays, three agents", "bursts, three agents", "unlike agents"])
def test_against_monte_carlo(network):
    scenario = scenario_of(network, correlation="shared")
    chain = sf.predict(scenario, method="optimal")
    sample = sf.predict(scenario, method="monte-carlo", quantity="optimal", runs=8000, seed=5, workers=1)
    for agent in range(1, scenario.network.agents + 1):
        z = np.abs(sample.values("trace", agent) - chain.values("trace", agent))
        assert (z <= 4.5 * sample.standard_error("trace", agent) + 1e-12).all()


def burst_by_hand(burst, steps):
    """E[P] of two agents, by every state and every delivery of both links, filtered centrally."""
    to_bad, to_good = burst["good_to_bad"], burst["bad_to_good"]
    stationary = {0: to_good / (to_bad + to_good), 1: to_bad / (to_bad + to_good)}
    move = {(0, 0): 1 - to_bad, (0, 1): to_bad, (1, 0): to_good, (1, 1): 1 - to_good}
    deliver = {0: burst["good"], 1: burst["bad"]}
    patterns = {}
    for states in product((0, 1), repeat=steps):
        weight = stationary[states[0]] * np.prod([move[pair] for pair in pairwise(states)])
        for arrived in product((False, True), repeat=steps):
            p = np.prod([deliver[s] if a else 1 - deliver[s] for s, a in zip(states, arrived, strict=True)])
            patterns[arrived] = patterns.get(arrived, 0.0) + weight * p
    total = 0.0
    for (first, p), (second, q) in product(patterns.items(), repeat=2):
        held = [{0: 0, 1: -1}, {0: -1, 1: 0}]  # latest step of each agent's data, 0-based
        for k in range(steps):
            held[0][0], held[1][1] = k, k
            before = [dict(h) for h in held]
            for i, arrived in ((0, first[k]), (1, second[k])):
                if arrived:
                    held[i] = {j: max(held[i][j], before[1 - i][j]) for j in (0, 1)}
        P = 100.0 / (1 + (held[0][1] >= 0))
        for k in range(1, steps):
            P = 1.0 / (1.0 / (P + 25.0) + (1 + (held[0][1] >= k)) / 100.0)
        total += p * q * P
    return total


def test_bursts_by_hand():
    source = strategies.mapping(1, 25, 1, 100, 100, 2, 4, burst=BURST)
    for method, quantity in (("optimal", "claimed"), ("general", "optimal")):
        p = sf.predict(sf.Scenario.from_mapping(source), method=method, quantity=quantity)
        np.testing.assert_allclose(p.values()[0, -1], burst_by_hand(BURST, 4), rtol=1e-12)
    np.testing.assert_allclose(p.link, (0.35 * 0.95 + 0.2 * 0.1) / 0.55)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("link", [0.0, 0.07, 0.5, 1.0])
def test_the_enclosure_holds_the_exact_value(architecture, link, monkeypatch):
    scenario = sf.load_scenario(architecture=architecture, agents=5, steps=7)
    exact = sf.predict(scenario, [link], method="optimal")
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 0)
    enclosed = sf.predict(scenario, [link], method="optimal")
    bound = np.array(enclosed.meta["relative_bound"])
    assert enclosed.nature == "bound"
    assert (bound < 1e-6).all()
    assert (np.abs(enclosed.values() / exact.values() - 1) <= bound * (1 + 1e-9) + 1e-14).all()


@pytest.mark.parametrize("case", CASES)
def test_precise_sensors_and_vague_starts(case):
    """Where nothing is left to chance the optimum is the Kalman filter's, here in 60 digits."""
    scenario = sf.Scenario.from_mapping(strategies.mapping(*CASES[case], agents=3, steps=4))
    got = sf.predict(scenario, [0.0, 1.0], "optimal").covariance
    for P, link in zip(got, (0.0, 1.0), strict=True):
        assert textbook.scaled_error(P, textbook.simplified_mpmath(*CASES[case], 3, link, 4)) < 1e-9


def test_redundant_sensors_of_a_scalar():
    scenario = sf.Scenario.from_mapping(strategies.mapping(1, 1e12, [[1], [1]], [[1e-4, 0], [0, 1e-4]], 1e12, 3, 3))
    np.testing.assert_allclose(sf.predict(scenario, [0.0, 1.0], "optimal").values()[:, 2], [5e-5, 5e-5 / 3], rtol=1e-12)


def test_pruned_bursts():
    """A hidden state that cannot be does not count as a row that must keep an outcome."""
    burst = {"good_to_bad": 0.0, "bad_to_good": 0.5, "good": 0.9, "bad": 0.0}
    source = strategies.mapping(1, 1, 1, 1, 4, 3, 4, architecture="broadcast", burst=burst)
    scenario = sf.Scenario.from_mapping(source)
    exact = sf.predict(scenario, method="general")
    pruned = sf.predict(scenario, method="general", prune=True, max_graphs=20)
    kept = 1 - np.array(pruned.meta["left_out"])
    assert 0 < 1 - kept.min() < 0.2
    low = exact.values() - (1 - kept) * exact.values()[:, :1]  # what is left out claims between 0 and P(k0)
    assert (pruned.values() * kept >= low).all()
    assert (pruned.values() * kept <= exact.values() + 1e-12).all()


def test_many_agents_and_steps():
    p = sf.predict(sf.load_scenario(agents=50, steps=50), [0.05], method="optimal")
    assert np.max(p.meta["relative_bound"]) < 1e-6
    assert "the optimum is proved to lie within a relative" in p.notes[0]


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("merged", [9, 60, 400])
def test_the_enclosure_of_a_matrix_model(architecture, merged, monkeypatch):
    scenario = sf.load_scenario("cv-2d", architecture=architecture, agents=4, steps=7)
    link = [0.0, 0.1, 0.5, 1.0]
    exact = sf.predict(scenario, link, method="optimal").covariance
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 0)
    monkeypatch.setattr(enclosure, "MOST_MERGED", merged)
    monkeypatch.setattr(optimal, "LOOSE", np.inf)
    enclosed = sf.predict(scenario, link, method="optimal")
    bound = np.array(enclosed.meta["relative_bound"])[..., None]
    for x in np.random.default_rng(1).normal(size=(20, 4, 1)):  # in every direction
        true, shown = (np.einsum("ia,lkij,jb->lkab", x, P, x)[..., 0] for P in (exact, enclosed.covariance))
        assert (np.abs(true / shown - 1) <= bound * (1 + 1e-9) + 1e-13).all()
    assert bound.max() < {9: 1.0, 60: 0.2, 400: 1e-12}[merged]


@pytest.mark.parametrize("network", ["unequal links", "delays, three agents", "bursts, broadcast", "unlike agents"])
def test_the_enclosure_of_sets_and_ages(network, monkeypatch):
    exact = sf.predict(scenario_of(network), method="optimal")
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 0)
    enclosed = sf.predict(scenario_of(network), method="optimal")
    bound = np.array(enclosed.meta["relative_bound"])
    assert (enclosed.nature, exact.nature) == ("bound", "exact")
    assert bound.max() < 1e-5
    for agent in range(1, enclosed.scenario.network.agents + 1):
        true = exact.values("trace", agent)
        assert (np.abs(true / enclosed.values("trace", agent) - 1) <= bound * (1 + 1e-9) + 1e-13).all()


def subnets(seed, sizes, **network):
    """Agents of a few kinds, told apart by their subnet alone, in an order of their own."""
    rng = np.random.default_rng(seed)
    of = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    link = rng.uniform(0.1, 0.9, (len(sizes), len(sizes)))[of][:, of]
    R = rng.uniform(20, 200, len(sizes))[of]
    source = strategies.mapping(1, 25, 1, 100, 100, len(of), 3, link=link.tolist(), **network)
    return source | {"agent": [{"R": r} for r in R]}


@settings(max_examples=12)
@given(strategies.seeds, st.sampled_from([(2, 3), (1, 2, 2), (4, 1), (5,)]), st.booleans())
def test_agents_alike_are_counted(seed, sizes, late):
    """Whether agents alike are counted or sets are told apart, the answer is the same; and as they are called."""
    source = subnets(seed, sizes, **({"delay": [0.6, 0.4]} if late else {}))
    scenario, n = sf.Scenario.from_mapping(source), sum(sizes)
    apart, groups = [(i,) for i in range(n)], [(i,) for i in range(n)]
    system, rows = scenario.system, default_rows(scenario.network)
    found = []
    for classes in (contact_chain.alike(scenario.network, rows, system.sensor_of), apart):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(contact_chain, "alike", lambda *_, classes=classes: classes)
            chain = contact_chain.contacts(scenario.network, rows, system.sensor_of, groups)
        found.append(contact_chain.expected_optimum(optimal.filter_of(system), chain, 3, 1).P)
        assert len(classes) in (len(sizes), n)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
    order = np.random.default_rng(seed).permutation(n)
    renamed = source | {"agent": [source["agent"][i] for i in order]}
    link = np.array(source["network"]["link"])[order][:, order]
    renamed["network"] = source["network"] | {"link": link.tolist()}
    p, q = (sf.predict(sf.Scenario.from_mapping(s), method="optimal") for s in (source, renamed))
    for place, i in enumerate(order):
        np.testing.assert_allclose(q.of_agent(place + 1), p.of_agent(int(i) + 1), rtol=1e-12)


def on_a_line(n, steps, hears, **model):
    link = np.zeros((n, n))
    for i, j in hears:
        link[i, j] = 0.35 + 0.5 * ((3 * i + 5 * j) % 7) / 7
    return sf.Scenario.from_mapping(strategies.mapping(1, 25, 1, 100, 100, n, steps, link=link.tolist(), **model))


@pytest.mark.parametrize(
    ("scenario", "states", "groups"),
    [
        (on_a_line(20, 5, [(i, i + d) for i in range(20) for d in (-1, 1) if 0 <= i + d < 20]), 210, 20),
        (sf.load_scenario("fcs-demo", steps=3), 26, 2),
        (sf.Scenario.from_mapping(subnets(3, (6, 5, 4))), 7 * 6 * 5 - 1, 3),
        (sf.load_scenario(agents=30, architecture="cyclic", steps=4), 30, 1),
    ],
    ids=["line", "fcs-demo", "subnets", "ring"],
)
def test_many_agents_with_structure(scenario, states, groups):
    """As many states as can be reached, whatever the number of agents; against the sampled optimum."""
    system, rows = scenario.system, default_rows(scenario.network)
    alike = optimal.groups_of(system, rows)
    assert len(contact_chain.contacts(scenario.network, rows, system.sensor_of, alike).held) == states
    assert len(alike) == groups
    p = sf.predict(scenario, method="optimal")
    drawn = sf.predict(scenario, method="monte-carlo", estimator="optimal", runs=600, seed=3)
    bound = np.array(p.meta["relative_bound"]) if p.nature == "bound" else 0
    for agent in (1, scenario.network.agents // 2, scenario.network.agents):
        z = np.abs(drawn.values("trace", agent) - p.values("trace", agent))
        assert (z <= 4.5 * drawn.standard_error("trace", agent) + bound * p.values() + 1e-12).all()


def test_bounds_for_unlike_agents_of_several_states(monkeypatch):
    """Sensors that see different things: nobody's counts are the smaller ones."""
    source = sf.load_scenario("cv-2d", agents=4, steps=5).to_mapping()
    source["agent"] = [{"H": [[1, 0, 0, 0]], "R": 25}, {"H": [[0, 0, 1, 0]], "R": 9}, {}, {"R": [[1, 0], [0, 400]]}]
    scenario, link = sf.Scenario.from_mapping(source), [0.1, 0.4, 0.9]
    exact = sf.predict(scenario, link, method="optimal")
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 0)
    monkeypatch.setattr(enclosure, "MOST_MERGED", 300)
    monkeypatch.setattr(optimal, "LOOSE", np.inf)
    enclosed = sf.predict(scenario, link, method="optimal")
    bound = np.array(enclosed.meta["relative_bound"])[:, :, None, None]
    assert (exact.nature, enclosed.nature) == ("exact", "bound")
    for x in np.random.default_rng(2).normal(size=(20, 4, 1)):
        true, shown = (x.T @ p.by_group @ x for p in (exact, enclosed))
        assert (np.abs(true / shown - 1) <= bound[..., None] * (1 + 1e-9) + 1e-13).all()
    assert 1e-3 < bound[0].max() < 0.2
    assert bound[-1].max() < 1e-5


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
def test_number_of_paths(architecture):
    for n, k in product(range(1, 5), range(1, 6)):
        falls = range(n) if architecture != "cyclic" else range(2)
        paths = {
            r for r in product(range(1, n + 1), repeat=k)
            if r[-1] - 1 in falls and all(a - b in falls for a, b in pairwise(r))
        }  # fmt: skip
        assert number_of_paths(Network(n, k, architecture, None)) == len(paths)
    assert number_of_paths(Network(3, 5, "ad-hoc", None)) == comb(7, 5) == 21


def test_limits_and_order():
    """µ = 0: the Kalman filter; µ = 1: broadcast fusion; between, never above the general formulation's simplified cousin."""
    scenario, link = sf.load_scenario(steps=4), np.linspace(0, 1, 11)
    optimal, simplified = (sf.predict(scenario, link, m).values() for m in ("optimal", "simplified"))
    np.testing.assert_allclose(optimal[[0, -1]], simplified[[0, -1]], rtol=1e-12)
    assert (np.diff(optimal, axis=0) < 1e-12).all()
    assert (optimal <= simplified + 1e-12).all()


def test_an_order_that_the_thesis_left_open():
    """Claimed below optimal below actual, for the Local Fusion Graph: it is slightly overconfident after gaps."""
    scenario, link = sf.load_scenario(steps=4), [0.25, 0.5, 0.75]
    claimed, actual = (sf.predict(scenario, link, "general", q).values() for q in ("claimed", "actual"))
    optimal = sf.predict(scenario, link, "optimal").values()
    assert (claimed[:, 1:] < optimal[:, 1:]).all()
    assert (optimal[:, 1:] < actual[:, 1:]).all()
    assert (actual / optimal < 1.01).all()


def test_what_the_chain_does_not_take(monkeypatch):
    link = np.linspace(0.1, 0.3, 169).reshape(13, 13)
    network = sf.Scenario.from_mapping(strategies.mapping(1, 25, 1, 100, 100, 13, 2, link=link.tolist())).network
    with pytest.raises(
        sf.UsageError, match="the contact chain of 13 agents has more than 4096 states with these links"
    ):
        contact_chain.contacts(network, default_rows(network), [0] * 13, [(i,) for i in range(13)])
    monkeypatch.setattr(contact_chain, "MOST_STATES", 10)
    monkeypatch.setattr(contact_chain, "MOST_PATHS", 10)
    monkeypatch.setattr(optimal, "LOOSE", 0.0)
    like = sf.load_scenario(steps=4)
    sampled = {
        "the contact chain has more than": (sf.Scenario.from_mapping(subnets(1, (3, 3))), None, "claimed"),
        "bounds on the optimum would be": (like, [0.05], "claimed"),
        "the optimum's bias is followed along every path only": (like, [0.5], "bias"),
    }
    for why, (scenario, link, quantity) in sampled.items():
        p = sf.predict(scenario, link, method="optimal", quantity=quantity, runs=10)
        assert p.nature == "sampled"
        assert p.notes[0].startswith(why)
    source = strategies.mapping(1, 25, 1, 100, 100, 2, 2, burst=BURST)
    with pytest.raises(
        sf.UsageError, match=r"method simplified: it does not take bursty links \(network.burst\): it averages"
    ):
        sf.predict(sf.Scenario.from_mapping(source))
    source = strategies.mapping(1, 25, 1, 100, 100, 4, 2, burst=BURST)
    with pytest.raises(sf.UsageError, match=r"12 bursty links are good and bad in 2\^12 ways"):
        sf.predict(sf.Scenario.from_mapping(source | {"network": source["network"] | {"case": [
            {"name": str(i), "burst": BURST} for i in range(5)]}}), method="general")  # fmt: skip
