"""The network estimators against naive re-derivations (`tests/oracles/textbook_estimators.py`), and their limits."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario.registry import ESTIMATOR
from stochfuse.scenario.scenario import link_rows
from tests.agreement import test_matrix
from tests.oracles import strategies, textbook, textbook_estimators
from tests.oracles.many import outcomes

ONE_STATE = tuple(textbook_estimators.RULES)
INTERSECTIONS = ("covariance-intersection", "split-ci")
BLENDERS = ("blender", "joint-blender")
EQUIVALENTS = ("equivalent-measurement", "independent-measurements")
OWN = ("stand-alone", *INTERSECTIONS, "lwin", "itns")
SINGULAR = tuple(name for name in ONE_STATE if name not in INTERSECTIONS)
UNLIKE_SENSORS = tuple(name for name in ONE_STATE if name not in EQUIVALENTS)
QUANTITIES = ("claimed", "actual", "bias", "rms")


def matrices(rng, d, p):
    F, Q, H, R, P0 = strategies.model(rng, d, p)
    return dict(zip("FHQR", (M.tolist() for M in (F, H, Q, R)), strict=True)), P0


def one_state(seed, d, p, agents, steps, architecture="ad-hoc", link: object = 0.37, **more) -> dict[str, Any]:
    """A random scenario of agents that track one state, with a known first error."""
    rng = np.random.default_rng(seed)
    model, P0 = matrices(rng, d, p)
    initial = {"P": P0.tolist(), "error": (3 * rng.normal(size=d)).tolist()}
    network = {"agents": agents, "steps": steps, "architecture": architecture, "link": link}
    network |= more.pop("network", {})
    return {"model": model, "initial": initial | more.pop("initial", {}), "network": network, **more}


def covariance(seed, d, least=0.1):
    rng = np.random.default_rng(seed)
    return (strategies.covariance(rng, d) + least * np.eye(d)).tolist()


def changing(seed):
    """Every matrix its own at every step."""
    source = one_state(seed, 2, 1, 2, 3, link=[[[0, 0.3], [0.8, 0]], [[0, 0.6], [0.2, 0]], [[0, 0.9], [0.4, 0]]])
    each = [matrices(np.random.default_rng(seed + k), 2, 1)[0] for k in range(3)]
    source["model"] = {name: [one[name] for one in each] for name in "FHQR"}
    return source


def own_states(seed, places, steps, link, agents, cooperative, d=2, architecture="ad-hoc"):
    """Random agents with states of their own that measure each other."""
    source = one_state(seed, d, 1, len(places), steps, architecture, link)
    states = ["x", "y", "z", "w"][:d]
    source["model"] |= {"own": True, "states": states}
    source["agent"] = [{"position": place, **table} for place, table in zip(places, agents, strict=True)]
    return source | {"cooperative": cooperative}


def parallel_filters(seed):
    """Three filters: of the state, of a state and a half, of a part of the state in other units; all noises related."""
    rng = np.random.default_rng(seed)
    source = one_state(seed, 2, 1, 3, 3, "broadcast", [[0, 0.3, 0.6], [0.7, 0, 0.6], [0.7, 0.3, 0]])
    sizes, agents = (2, 3, 2), []
    for d in sizes:
        F, Q, H, R, P0 = strategies.model(rng, d, 1)
        M = rng.normal(size=(2, d))
        agents.append({"F": F, "Q": Q, "H": H, "R": R, "P": P0, "M": M})
    process = strategies.covariance(rng, sum(sizes))
    ends = np.cumsum((0, *sizes))
    for agent, a, b in zip(agents, ends[:-1], ends[1:], strict=True):
        agent["Q"] = process[a:b, a:b]
    agents[0] |= {"M": np.eye(2)}
    source["agent"] = [{key: M.tolist() for key, M in agent.items()} for agent in agents]
    c = [[1, 0.5, -0.2], [0.5, 1, 0.3], [-0.2, 0.3, 1]]
    return source | {"noise": {"process": process.tolist(), "correlation": c, "disturbance": 0.3}}


def singular(seed, **given):
    """Two states, some of whose matrices are singular."""
    source = one_state(seed, 2, 1, 2, 2, link=[[0, 0.6], [0.3, 0]])
    source["initial"] |= {key: M for key, M in given.items() if key == "P"}
    source["model"] |= {key: M for key, M in given.items() if key != "P"}
    return source


SPARSE = [[0, 0.2, 0.7], [0, 0, 0], [0.8, 0, 0]]
ONE_WAY = [[0, 0.5, 0], [0, 0, 0.7], [0, 0, 0]]
TRIANGLE = [[0, 0], [10, 2], [3, 8]]
CASES = {
    "ad hoc, unequal links": (one_state(1, 2, 1, 3, 2, link=SPARSE), ONE_STATE),
    "ad hoc, two agents, three steps": (one_state(2, 2, 2, 2, 3), ONE_STATE),
    "ad hoc, everything by step": (changing(3), ONE_STATE),
    "ad hoc, hears": (one_state(4, 1, 1, 3, 2, network={"hears": [[2, 3], [], [1]]}), ONE_STATE),
    "broadcast": (one_state(5, 2, 1, 3, 2, "broadcast"), ONE_STATE),
    "cyclic": (one_state(6, 1, 1, 3, 3, "cyclic", ONE_WAY), ONE_STATE),
    "cyclic, two dimensions": (one_state(7, 2, 1, 3, 2, "cyclic", 0.6), ONE_STATE),
    "unlike noises": (
        one_state(8, 2, 1, 3, 2, "broadcast", agent=[{"R": [[4.0]]}, {}, {"R": [[0.3]]}]), ONE_STATE),
    "unlike sensors": (
        one_state(9, 2, 1, 3, 2, link=SPARSE, agent=[{}, {"H": [[1, 0], [0, 2]], "R": covariance(1, 2)}, {"R": [[2.0]]}]),
        UNLIKE_SENSORS),
    "an agent without a sensor": (
        one_state(10, 2, 1, 3, 3, "cyclic", ONE_WAY, agent=[{"sensor": False}, {}, {"R": [[0.5]]}]), ONE_STATE),
    "shared start": (one_state(11, 2, 1, 2, 3, link=0.7, initial={"correlation": "shared"}), ONE_STATE),
    "correlated noise": (
        one_state(12, 2, 2, 3, 2, "broadcast", noise={"correlation": [[1, 0.6, 0], [0.6, 1, -0.3], [0, -0.3, 1]]},
                  agent=[{"R": covariance(2, 2)}, {"R": covariance(3, 2)}, {"R": covariance(4, 2)}]),
        ONE_STATE),
    "correlated, like agents": (
        one_state(13, 1, 1, 2, 3, link=0.6, noise={"correlation": 0.4}), ONE_STATE),
    "disturbed": (
        one_state(14, 2, 2, 2, 3, link=0.55, noise={"correlation": 0.7, "disturbance": covariance(5, 4)}), ONE_STATE),
    "delays": (one_state(15, 2, 1, 2, 3, link=0.6, network={"delay": [0.5, 0.3, 0.2]}), INTERSECTIONS),
    "delays, unlike agents": (
        one_state(16, 2, 1, 3, 2, "broadcast", network={"delay": [0.6, 0.4]}, agent=[{"R": [[3.0]]}, {}, {}]),
        INTERSECTIONS),
    "own states, ranges": (
        own_states(17, TRIANGLE, 2, SPARSE, [{}, {}, {}], {"positions": ["x", "y"], "range": 0.7}), OWN),
    "own states, directions, cyclic": (
        own_states(18, TRIANGLE, 3, ONE_WAY, [{"R": [[2.0]]}, {"Q": covariance(6, 3), "P": covariance(7, 3, 1.0)},
                                          {"F": np.diag([0.9, 1.0, 0.5]).tolist()}],
                   {"positions": ["z", "x"], "direction": 0.05}, d=3, architecture="cyclic"), OWN),
    "own states in space, moving, unlike pairs": (
        own_states(19, [[[0, 0, 0], [1, 0, 2]], [10, -2, 3], [-4, 8, 1]], 2, 0.45, [{}, {"sensor": False}, {}],
                   {"positions": ["x", "y", "w"], "range": 0.5, "pair": [
                       {"agents": [1, 2], "range": 0.2, "direction": 0.03},
                       {"agents": [3, 2], "direction": 0.1, "both_ways": False},
                       {"agents": [3, 1], "none": True}]}, d=4, architecture="broadcast"), OWN),
    "parallel filters": (parallel_filters(20), BLENDERS),
    "delays, unequal": (
        one_state(21, 2, 1, 2, 3, link=0.6, network={"delay": [[0, [0.3, 0.7]], [1, 0]]}), INTERSECTIONS),
    "a sensor that pauses": (
        one_state(22, 2, 1, 2, 3, link=0.6, agent=[{"H": [[[1, 0.5]], [[0, 0]], [[1, 0.5]]]}, {}]), UNLIKE_SENSORS),
    "a direction without process noise": (singular(23, Q=[[1.0, 0.5], [0.5, 0.25]]), ONE_STATE),
    "a direction that is forgotten": (singular(24, F=[[1.0, 0.5], [2.0, 1.0]]), ONE_STATE),
    "a direction known from the start": (singular(25, P=[[4.0, 2.0], [2.0, 1.0]]), SINGULAR),
    "a direction known from step 2 on": (
        singular(26, F=[[1.0, 0.5], [0.0, 0.0]], Q=[[1.0, 0.0], [0.0, 0.0]]), SINGULAR),
}  # fmt: skip
MATRIX = [(case, estimator) for case, (_, estimators) in CASES.items() for estimator in estimators]
MATRIX += [
    (case, estimator)
    for case, (source, estimators) in CASES.items()
    for estimator in textbook_estimators.PEDIGREES
    if estimators in (ONE_STATE, UNLIKE_SENSORS) and not (estimator == "optimal" and "noise" in source)
]
MATRIX += [("delays, unequal", "optimal")]


@cache
def oracle(case, estimator):
    return textbook_estimators.expected(CASES[case][0], estimator)


@cache
def scenario_of(case):
    return sf.Scenario.from_mapping(CASES[case][0])


def close(got, expected, relative=1e-10):
    np.testing.assert_allclose(got, expected, rtol=relative, atol=relative * np.abs(expected).max())


@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_against_every_history(case, estimator):
    p = sf.predict(scenario_of(case), method="general", estimator=estimator, quantity="rms")
    for quantity, expected in oracle(case, estimator).items():
        shown = p.shown_as(quantity)
        for agent in range(expected.shape[1]):
            close(shown.of_agent(agent + 1)[0], expected[:, agent])


@pytest.mark.slow
@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_nothing_merged(case, estimator):
    scenario, exact = scenario_of(case), oracle(case, estimator)
    found = outcomes(scenario, link_rows(scenario), estimator, errors=True, plain=True)
    for quantity in QUANTITIES:
        close(test_matrix.by_agent(found, found.covariance(quantity=quantity)), exact[quantity])
    without_errors = outcomes(scenario, link_rows(scenario), estimator, plain=True)
    close(test_matrix.by_agent(without_errors, without_errors.covariance()), exact["claimed"])


@pytest.mark.slow
@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_monte_carlo(case, estimator):
    exact = oracle(case, estimator)
    p = sf.predict(
        scenario_of(case), method="monte-carlo", estimator=estimator, quantity="rms", runs=600, seed=4, workers=1
    )
    for quantity in ("claimed", "actual"):
        shown = p.shown_as(quantity)
        for agent in range(1, exact["claimed"].shape[1] + 1):
            error = np.asarray(shown.standard_error("trace", agent))[0]
            difference = shown.values("trace", agent)[0] - np.trace(exact[quantity][:, agent - 1], axis1=1, axis2=2)
            assert (np.abs(difference) <= 4.5 * error + 1e-9 * np.abs(exact[quantity]).max()).all()


EVERY = (*ONE_STATE, *textbook_estimators.PEDIGREES)
TAKEN = [(estimator, engine) for estimator in EVERY for engine in ("general", "monte-carlo")] + [("optimal", "chain")]


def agrees(p, row, expected):
    """Claims of one row of links are those expected, exactly or within their error."""
    for agent in range(1, expected.shape[1] + 1):
        if p.sampled is None:
            close(p.of_agent(agent)[row], expected[:, agent - 1])
            continue
        exact = np.trace(expected[:, agent - 1], axis1=1, axis2=2)
        error = np.asarray(p.standard_error("trace", agent))[row]
        assert (np.abs(p.values("trace", agent)[row] - exact) <= 4.5 * error + 1e-9 * exact).all()


def asked(estimator, engine):
    sampled = {"runs": 600, "seed": 4, "workers": 1} if engine == "monte-carlo" else {}
    return {"method": engine, "estimator": estimator, **sampled}


@pytest.mark.parametrize(("estimator", "engine"), TAKEN)
def test_cases_are_scenarios_of_their_own(estimator, engine):
    source, links = one_state(31, 2, 1, 2, 2), {"calm": [[0, 0.7], [0.6, 0]], "storm": [[0, 0.3], [0.4, 0]]}
    del source["network"]["link"]
    cases = [{"name": name, "link": link} for name, link in links.items()]
    both = sf.Scenario.from_mapping({**source, "network": {**source["network"], "case": cases}})
    p = sf.predict(both, **asked(estimator, engine))
    for row, link in enumerate(links.values()):
        alone = {**source, "network": {**source["network"], "link": link}}
        agrees(p, row, textbook_estimators.expected(alone, estimator)["claimed"])


BURSTY = one_state(32, 2, 1, 2, 2)
del BURSTY["network"]["link"]
CHAIN = {"good_to_bad": 0.3, "bad_to_good": 0.4, "good": 0.9, "bad": 0.2}


@cache
def with_bursts(estimator):
    """Claims over every way in which the two links can be good and bad, each a scenario with links by step."""
    total, start, stay = 0.0, np.array([4 / 7, 3 / 7]), np.array([[0.7, 0.3], [0.4, 0.6]])
    for one, other in product(product((0, 1), repeat=2), repeat=2):
        probability = start[one[0]] * stay[one] * start[other[0]] * stay[other]
        link = [[[0, (0.9, 0.2)[a]], [(0.9, 0.2)[b], 0]] for a, b in zip(one, other, strict=True)]
        way = {**BURSTY, "network": {**BURSTY["network"], "link": link}}
        total = total + probability * textbook_estimators.expected(way, estimator)["claimed"]
    return total


@pytest.mark.parametrize(("estimator", "engine"), TAKEN)
def test_bursts_are_links_that_change_by_chance(estimator, engine):
    bursty = {**BURSTY, "network": {**BURSTY["network"], "burst": CHAIN}}
    agrees(sf.predict(sf.Scenario.from_mapping(bursty), **asked(estimator, engine)), 0, with_bursts(estimator))


def moments(source, link, estimator, method="general"):
    """Claimed and actual covariance and bias, of [agent], each (steps, …), at one link probability of all links."""
    scenario = sf.Scenario.from_mapping(source)
    n = scenario.network.agents
    # a matrix: where links are certain only what is certain is gone through
    p = sf.predict(scenario, np.full((1, n, n), link), method, "bias", estimator=estimator)
    return [[p.shown_as(quantity).of_agent(agent + 1)[0] for quantity in QUANTITIES[:3]] for agent in range(n)]


def same(one, other, relative=1e-10):
    for mine, yours in zip(one, other, strict=True):
        for a, b in zip(mine, yours, strict=True):
            close(a, b, relative)


def without(source, *tables):
    return {key: value for key, value in source.items() if key not in tables}


COMMON: Any = one_state(30, 2, 2, 3, 3)
RELATED: Any = CASES["own states, directions, cyclic"][0]


@pytest.mark.parametrize("estimator", [name for name in ONE_STATE if name != "itns"])
def test_nothing_arrives(estimator):
    same(moments(COMMON, 0.0, estimator), moments(COMMON, 0.0, "stand-alone"))
    same(moments(COMMON, 0.0, "stand-alone"), moments(COMMON, 0.9, "stand-alone"))
    P = np.array(COMMON["initial"]["P"])
    for step, claimed in enumerate(moments(COMMON, 0.0, estimator)[0][0], start=1):
        P = P if step == 1 else next_covariance(COMMON["model"], P)
        close(claimed, P, 1e-10)


def next_covariance(model, P, times=1):
    F, Q, H, R = (np.array(model[name], float) for name in "FQHR")
    P = textbook.kalman_predict(P, F, Q)
    for _ in range(times):
        P = textbook.kalman_update(P, H, R)
    return P


@pytest.mark.parametrize("estimator", OWN)
def test_nothing_arrives_at_states_of_their_own(estimator):
    same(moments(RELATED, 0.0, estimator), moments(RELATED, 0.0, "stand-alone"))


def joint_filter(source, agree):
    """Covariance of one filter over the stacked state of all agents, step by step; all measurements of each other."""
    t = textbook_estimators.Truth(source)
    F, H = np.zeros((t.x[-1].stop, t.x[-1].stop)), np.zeros((t.z[-1].stop, t.x[-1].stop))
    for i in range(t.n):
        F[t.x[i], t.x[i]], H[t.z[i], t.x[i]] = t.F[i], t.H[i]
    P, found = t.Sigma[t.column["start"], t.column["start"]], []
    for k in range(1, t.steps + 1):
        if k > 1:
            P = textbook.kalman_update(textbook.kalman_predict(P, F, t.together(k)), H, t.told_noise(k))
        for (i, j), steps in t.related.items() if agree else ():
            row = np.zeros((len(steps[k - 1][2]), len(P)))
            row[:, t.x[i]], row[:, t.x[j]] = steps[k - 1][:2]
            P = textbook.kalman_update(P, row, steps[k - 1][2])
        found.append(P)
    return [np.array([P[x, x] for P in found]) for x in t.x]


def test_itns_is_the_joint_filter():
    for agent, P in enumerate(joint_filter(COMMON, agree=False)):
        claimed, actual, _ = moments(COMMON, 0.0, "itns")[agent]
        close(claimed, P, 1e-10)
        close(actual, P, 1e-10)
        assert np.trace(moments(COMMON, 0.0, "stand-alone")[agent][0][2] - P[2]) > 0
    everyone = RELATED | {"network": RELATED["network"] | {"architecture": "ad-hoc"}}
    for agent, P in enumerate(joint_filter(everyone, agree=True)):
        claimed, actual, _ = moments(everyone, 1.0, "itns")[agent]
        close(claimed, P, 1e-10)
        close(actual, P, 1e-10)


def test_itns_is_the_optimum_where_all_agree():
    best = sf.predict(sf.Scenario.from_mapping(COMMON), [1.0], "optimal").covariance[0]
    for claimed, actual, _ in moments(COMMON, 1.0, "itns"):
        close(claimed, best, 1e-10)
        close(actual, best, 1e-10)


@pytest.mark.parametrize("estimator", EQUIVALENTS)
def test_all_measurements_of_independent_noise_are_all_measurements(estimator):
    P, expected = np.array(COMMON["initial"]["P"]), []
    for step in (1, 2, 3):
        P = P if step == 1 else next_covariance(COMMON["model"], P, times=3)
        expected.append(P)
    for claimed, actual, _ in moments(COMMON, 1.0, estimator):
        close(claimed, expected, 1e-10)
        close(actual, expected, 1e-10)


def test_two_blenders_are_one():
    for source in (one_state(31, 2, 1, 2, 3), CASES["disturbed"][0]):
        same(moments(source, 0.6, "blender"), moments(source, 0.6, "joint-blender"), 1e-9)


@pytest.mark.parametrize("case", ["unlike sensors", "unlike noises", "shared start", "disturbed", "ad hoc, hears"])
def test_lwin_of_one_state_is_naive_fusion(case):
    source = CASES[case][0]
    same(moments(source, 0.6, "lwin"), moments(source, 0.6, "naive"))


def test_nothing_is_independent_where_nothing_is_measured():
    blind = COMMON | {"agent": [{"sensor": False}] * 3}
    same(moments(blind, 0.6, "split-ci"), moments(blind, 0.6, "covariance-intersection"))


def test_intersections_of_like_agents_claim_nothing_new():
    """Covariance intersection of equal covariances is that covariance, whatever arrives; its error is less."""
    alone, fused = moments(COMMON, 0.0, "stand-alone")[0], moments(COMMON, 0.6, "covariance-intersection")[0]
    close(fused[0], alone[0], 1e-10)
    assert (np.trace(alone[1] - fused[1], axis1=1, axis2=2) > 0).all()


def drawn(rng, source):
    """The same with links that are up or down for certain: one history."""
    n, steps = source["network"]["agents"], source["network"]["steps"]
    link = rng.integers(0, 2, (steps, n, n)).astype(float)
    if source["network"]["architecture"] == "broadcast":
        link[:] = link[:, :1]
    return source | {"network": source["network"] | {"link": link.tolist()}}


def consistent(source, estimator, equal=False, relative=1e-9):
    p = sf.predict(sf.Scenario.from_mapping(source), method="general", estimator=estimator, quantity="actual")
    for agent in range(1, source["network"]["agents"] + 1):
        actual, claimed = p.of_agent(agent)[0], p.shown_as("claimed").of_agent(agent)[0]
        scale = np.abs(claimed).max()
        assert np.linalg.eigvalsh(claimed - actual).min() >= -relative * scale
        if equal:
            np.testing.assert_allclose(actual, claimed, rtol=relative, atol=relative * scale)


@pytest.mark.parametrize("seed", range(8))
def test_what_is_claimed_is_not_too_good(seed):
    rng = np.random.default_rng(100 + seed)
    d, architecture = int(rng.integers(1, 4)), ["ad-hoc", "broadcast"][seed % 2]
    start = {"correlation": ["independent", "shared"][seed // 2 % 2]}
    source = drawn(rng, one_state(seed, d, 2, 3, 4, architecture, initial=start))
    unlike: dict[str, Any] = source | {"agent": [{"R": covariance(seed + i, 2)} for i in range(3)]}
    related: dict[str, Any] = unlike | {"noise": {"correlation": float(rng.uniform(-0.45, 0.9))}}
    disturbed = related | {"noise": related["noise"] | {"disturbance": covariance(seed, 6)}}
    for estimator in INTERSECTIONS:
        consistent(unlike, estimator)
    consistent(related, "covariance-intersection")
    for estimator in BLENDERS:
        consistent(related, estimator, equal=True)
    for one in (unlike, related):
        consistent(one, "equivalent-measurement", equal=True)
    consistent(disturbed, "equivalent-measurement")
    consistent(unlike, "itns", equal=True)
    late = unlike | {"network": unlike["network"] | {"delay": 1}}
    for estimator in INTERSECTIONS:
        consistent(late, estimator)
    places = rng.normal(scale=5, size=(3, 2)).tolist()
    own = drawn(rng, own_states(seed, places, 4, 0.5, [{}, {"sensor": False}, {"R": covariance(seed, 1)}],
                                {"positions": ["x", "y"], "range": 0.5, "direction": 0.2}, d=2 + seed % 2))  # fmt: skip
    for estimator in INTERSECTIONS:
        consistent(own, estimator)
    consistent(own, "itns", equal=True)


def overconfident(source, estimator):
    claimed, actual, _ = moments(source, 1.0, estimator)[0]
    return np.linalg.eigvalsh(claimed - actual).min() < -1e-3 * np.abs(actual).max()


def test_what_is_claimed_too_good():
    """Naive rules forget correlations, split ones take noises for independent that are not."""
    assert overconfident(COMMON, "lwin")
    assert overconfident(RELATED, "lwin")
    related = COMMON | {"noise": {"correlation": 0.9}}
    for estimator in ("independent-measurements", "itns", "split-ci"):
        assert overconfident(related, estimator)
    assert not overconfident(related, "covariance-intersection")


@pytest.mark.parametrize("estimator", [name for name in ONE_STATE if name != "itns"])
def test_nothing_is_better_than_the_optimum(estimator):
    scenario = scenario_of("unlike noises")
    best = sf.predict(scenario, [0.4], "optimal")
    p = sf.predict(scenario, [0.4], "general", "actual", estimator=estimator)
    for agent in (1, 2, 3):
        gap = p.of_agent(agent)[0] - best.of_agent(agent)[0]
        assert np.linalg.eigvalsh(gap).min() >= -1e-10 * np.abs(best.covariance).max()


@pytest.mark.parametrize(
    ("case", "estimator"),
    [(case, name) for case in ("correlated noise", "unlike sensors", "ad hoc, hears") for name in CASES[case][1]
     if name != "blender"] + [("own states in space, moving, unlike pairs", name) for name in OWN],
)  # fmt: skip
def test_agents_by_other_names(case, estimator):
    """Only the tree of blenders depends on who comes first."""
    source, order = CASES[case][0], [2, 0, 1]
    network, renamed = source["network"], dict(source)
    link = np.array(network["link"])
    renamed["network"] = dict(network)
    if link.ndim == 2:
        renamed["network"]["link"] = link[np.ix_(order, order)].tolist()
    place = {old + 1: new + 1 for new, old in enumerate(order)}
    if "hears" in network:
        renamed["network"]["hears"] = [[place[j] for j in network["hears"][old]] for old in order]
    if "agent" in source:
        renamed["agent"] = [source["agent"][old] for old in order]
    if "noise" in source:
        renamed["noise"] = {"correlation": np.array(source["noise"]["correlation"])[np.ix_(order, order)].tolist()}
    if "cooperative" in source:
        pairs = [pair | {"agents": [place[a] for a in pair["agents"]]} for pair in source["cooperative"]["pair"]]
        renamed["cooperative"] = source["cooperative"] | {"pair": pairs}
    predicted = [sf.predict(sf.Scenario.from_mapping(s), method="general", estimator=estimator, quantity="rms")
                 for s in (source, renamed)]  # fmt: skip
    for quantity in QUANTITIES:
        for old, new in place.items():
            before, after = (p.shown_as(quantity).of_agent(a) for p, a in zip(predicted, (old, new), strict=True))
            close(after, before)


@pytest.mark.parametrize("estimator", ONE_STATE)
def test_other_coordinates(estimator):
    source = CASES["ad hoc, two agents, three steps"][0]
    T = np.array([[2.0, 0.3], [-0.7, 0.5]])
    S, model, initial = np.linalg.inv(T), source["model"], source["initial"]
    turned = source | {
        "model": {
            "F": (T @ model["F"] @ S).tolist(),
            "H": (model["H"] @ S).tolist(),
            "Q": (T @ model["Q"] @ T.T).tolist(),
            "R": model["R"],
        },
        "initial": {"P": (T @ initial["P"] @ T.T).tolist(), "error": (T @ initial["error"]).tolist()},
    }
    for (P, A, b), found in zip(moments(source, 0.6, estimator), moments(turned, 0.6, estimator), strict=True):
        for expected, got in zip((T @ P @ T.T, T @ A @ T.T, T @ b), found, strict=True):
            close(got, expected, 1e-8)


def test_a_known_error_of_other_units_is_the_same_error():
    """A filter in other units, x = M x_i, starts with the error M⁻¹ b, and its blend with itself is no other."""
    source = one_state(40, 2, 1, 2, 3)
    M = np.diag([2.0, 0.25])
    S, model = np.linalg.inv(M), {key: np.array(value) for key, value in source["model"].items()}
    P = np.array(source["initial"]["P"])
    scaled = {"M": M, "F": S @ model["F"] @ M, "Q": S @ model["Q"] @ S, "H": model["H"] @ M, "P": S @ P @ S}
    other = {key: value.tolist() for key, value in scaled.items()}
    plain = source | {"agent": [{"P": P.tolist()}] * 2}
    same(moments(source | {"agent": [{}, other]}, 0.6, "blender"), moments(plain, 0.6, "blender"), 1e-9)


def refused(source, message, estimator="stand-alone", **more):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict(sf.Scenario.from_mapping(source), [0.5], "general", estimator=estimator, **more)


@pytest.mark.parametrize("estimator", [e.name for e in ESTIMATOR if not e.sums and e.name not in INTERSECTIONS])
def test_late_messages_are_refused(estimator):
    source = COMMON | {"network": COMMON["network"] | {"delay": [0.5, 0.5]}}
    refused(source, f"^estimator {estimator}: expected messages without delay, got network.delay", estimator)


@pytest.mark.parametrize("estimator", INTERSECTIONS)
def test_late_measurements_of_each_other_are_refused(estimator):
    source = RELATED | {"network": RELATED["network"] | {"delay": [0.5, 0.5]}}
    refused(source, f"^estimator {estimator}: expected messages without delay", estimator)


def test_estimators_that_do_not_fit():
    for name in (*BLENDERS, *EQUIVALENTS, "naive", "local-fusion-graph", "optimal"):
        refused(RELATED, f"estimator {name}: expected agents that track one state, got states of their own", name)
    for name in ("stand-alone", "split-ci", "lwin", "itns", "naive", "equivalent-measurement"):
        refused(
            CASES["parallel filters"][0],
            f"estimator {name}: expected one model for all agents, got parallel filters",
            name,
        )
    refused(
        COMMON | {"noise": {"correlation": 0.2}},
        "estimator optimal: expected independent measurement noises, got .noise. with a correlation or a disturbance",
        "optimal",
    )
    for name in EQUIVALENTS:
        refused(
            CASES["unlike sensors"][0],
            r"expected sensors that measure the same \(one H\), got another H; ",
            name,
        )


def test_agents_that_measure_nothing_of_each_other_learn_nothing():
    nothing = [{"agents": [i, j], "none": True} for i, j in ((1, 2), (1, 3), (2, 3))]
    source = RELATED | {"cooperative": RELATED["cooperative"] | {"pair": nothing}}
    for estimator in OWN:
        same(moments(source, 0.8, estimator), moments(source, 0.8, "stand-alone"))


def test_nobody_has_a_sensor():
    blind = COMMON | {"agent": [{"sensor": False}] * 3}
    F, Q = np.array(COMMON["model"]["F"]), np.array(COMMON["model"]["Q"])
    first = np.array(COMMON["initial"]["P"])
    later = textbook.kalman_predict(first, F, Q)
    for estimator in ("stand-alone", *EQUIVALENTS):
        close(moments(blind, 0.5, estimator)[0][1][:2], [first, later], 1e-12)
    # all agree on the mean of three at once
    together = textbook.kalman_predict(first / 3, F, Q)
    close(moments(blind, 1.0, "itns")[0][1][:2], [first / 3, together], 1e-10)


@pytest.mark.parametrize("estimator", ONE_STATE)
def test_one_agent_is_a_kalman_filter(estimator):
    source = one_state(50, 2, 1, 1, 3)
    P, expected = np.array(source["initial"]["P"]), []
    for step in (1, 2, 3):
        P = P if step == 1 else next_covariance(source["model"], P)
        expected.append(P)
    claimed, actual, _ = moments(source, 0.5, estimator)[0]
    close(claimed, expected, 1e-10)
    close(actual, expected, 1e-10)


def table(name, **entries):
    """A table of the common scenario with some entries."""
    return COMMON | {name: COMMON.get(name, {}) | entries}


def filters(agent, drop=(), **entries):
    """The parallel filters with one agent's table changed."""
    source = CASES["parallel filters"][0]
    agents = [dict(each) for each in source["agent"]]
    agents[agent - 1] |= entries
    for key in drop:
        del agents[agent - 1][key]
    return source | {"agent": agents}


def own(name, **entries):
    """The scenario of own states with some entries of a table changed."""
    return RELATED | {name: RELATED[name] | entries}


def own_agent(agent, **entries):
    agents = [dict(each) for each in RELATED["agent"]]
    agents[agent - 1] |= entries
    return RELATED | {"agent": agents}


def listeners(hears, **network):
    return table("network", hears=hears, **network)


A_MATRIX = r"expected a number, or a symmetric 3×3 matrix of correlations with 1 on its diagonal"
WRONG = [
    (table("noise", correlation=[[1, 0.5, 0], [0.4, 1, 0], [0, 0, 1]]), f"noise.correlation: {A_MATRIX}"),
    (table("noise", correlation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), f"noise.correlation: {A_MATRIX}"),
    (table("noise", correlation=[[1, 0], [0, 1]]), f"noise.correlation: {A_MATRIX}"),
    (table("noise", correlation=-0.9), r"noise.correlation: .* \(smallest eigenvalue -0.8\)"),
    (table("noise", correlation=1.5), r"noise.correlation: .* \(smallest eigenvalue -0.5\)"),
    (table("noise", correlation="x"), r"noise.correlation: expected a number or a matrix \(a list of rows\), got 'x'"),
    (table("noise", correlation=0.2) | {"agent": [{"H": [[1, 0]], "R": [[1]]}, {}, {}]},
     "noise.correlation: expected sensors with as many components .*, got 1 of agent 1 and 2 of agent 2"),
    (table("noise", disturbance=[1, 2, 3]), "noise.disturbance: expected 2 variances, one for each component, got 3"),
    (table("noise", disturbance=[[1, 2], [2, 1]]), "noise.disturbance: expected a number or a 6×6 matrix"),
    (table("noise", disturbance=-1.0), "noise.disturbance: expected .* positive semi-definite .*, got a variance of -1"),
    (table("noise", disturbance=(np.eye(6) - 0.5).tolist()), "noise.disturbance: .*, got an indefinite one"),
    (table("noise", process=np.eye(6).tolist()), "noise.process: expected nothing unless agents have parallel filters"),
    (table("noise", colour=1), "noise.colour: expected a known key, got an unknown one, 'colour'"),
    (RELATED | {"noise": {"process": np.eye(9).tolist()}}, "noise.process: expected nothing unless"),
    (filters(1, Q=[[9, 0], [0, 9]]), "noise.process: expected the process noise of agent 1's own filter as its diagonal"),
    (CASES["parallel filters"][0] | {"noise": {"process": np.eye(5).tolist()}}, "noise.process: expected a .*7×7 matrix"),
    (filters(2, F=[[1, 0, 0], [0, 1, 0]]), r"agent\[2\].F: expected a square matrix, got a 2×3 matrix"),
    (filters(2, drop="Q"), r"agent\[2\].Q: expected a 3×3 covariance, to go with its own F, got nothing"),
    (filters(2, drop="P"), r"agent\[2\].P: expected a 3×3 covariance, to go with its own F, got nothing"),
    (filters(2, drop="M"), r"agent\[2\].M: expected a 2×3 mapping into the state, since the filter has 3 states"),
    (filters(2, drop="H"), r"agent\[2\].H: expected .*, got nothing"),
    (filters(2, drop="R"), r"agent\[2\].R: expected .*, got nothing"),
    (filters(2, M=[[1, 0], [0, 1]]), r"agent\[2\].M: expected .*2×3 matrix .*, got a 2×2 matrix"),
    (filters(2, s=[1, 2, 3]), r"agent\[2\].s: expected a list of 2 numbers, got \[1, 2, 3\]"),
    (filters(2, P=(np.eye(3) - 0.6).tolist()), r"agent\[2\].P: expected .*, got an indefinite one"),
    (filters(1) | {"initial": COMMON["initial"] | {"correlation": "shared"}},
     'initial.correlation: expected "independent", since agents have states or filters of their own'),
    (own("initial", correlation="shared"), 'initial.correlation: expected "independent", since agents have states'),
    (own_agent(1, F=[[1.0]], Q=[[1.0]], P=[[1.0]]), r"agent\[1\].F: expected a number or a 3×3 matrix"),
    (own_agent(1, M=np.eye(3).tolist()), r"agent\[1\].M: expected nothing"),
    (own_agent(1, Q=np.eye(3).tolist(), s=[1, 1, 1]), r"agent\[1\].s: expected nothing"),
    (without(RELATED, "cooperative"), r"cooperative: expected a table, since agent\[1\].position is given"),
    (without(RELATED, "cooperative", "agent"), "cooperative: expected what agents with states of their own measure"),
    (own("model", own=False), "model.own: expected true, since agents measure each other's own places, got false"),
    (own_agent(2, position=[0, 0]), r"agent\[2\].position: expected a place different from agent 1's"),
    (own("cooperative", positions=["x", "q"]), r'cooperative.positions\[2\]: expected one of "x", "y", "z", got .q.'),
    (own("cooperative", range=-1), "cooperative.range: expected a positive standard deviation, got -1"),
    (listeners([[2], [], []], architecture="cyclic"), "network.hears: expected nothing unless .* is .ad-hoc., got .cyclic."),
    (listeners([[2], []]), "network.hears: expected one list for each of the 3 agents, got 2"),
    (listeners([[1], [], []]), r"network.hears\[1\]: expected other agents from 1 to 3, each once, got \[1\]"),
    (listeners([[], [4], []]), r"network.hears\[2\]: expected other agents from 1 to 3, each once, got \[4\]"),
    (listeners([[2], [], []], link=None, burst={"good_to_bad": 0.2, "bad_to_good": 0.5}),
     r"network.hears: expected links without memory \(no burst\), got a burst"),
    (COMMON | {"agent": [{"sensor": False, "H": [[1, 0]]}, {}, {}]},
     r"agent\[1\].H: expected nothing, since sensor = false, got \[\[1, 0\]\]"),
    (COMMON | {"agent": [{"sensor": 0}, {}, {}]}, r"agent\[1\].sensor: expected true, false, or a table, got 0"),
    (COMMON | {"agent": [{}, {}]}, r"agent: expected one \[\[agent\]\] table for each of the 3 agents, got 2"),
    (COMMON | {"report": {"agent": 4}}, "report.agent: expected an agent from 1 to 3, got 4"),
]  # fmt: skip


@pytest.mark.parametrize(("source", "message"), WRONG, ids=[message[:40] for _, message in WRONG])
def test_wrong_tables(source, message):
    with pytest.raises(sf.ScenarioError, match=message):
        sf.Scenario.from_mapping(source)


def navigated(where="", drop="", **entries):
    """The GPS/INS preset, short and coarse, with entries of one of its tables changed."""
    source = sf.load_scenario("gps-ins", steps=3).to_mapping()
    source["navigation"]["rate"] = 10
    place = source["navigation"] if where != "model" else source
    place = place if where in ("", "model") else place[where]
    place |= entries
    if drop:
        del place[drop]
    return source


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (navigated("model", model=COMMON["model"]), r"model: expected nothing beside .navigation., which takes its place"),
        (navigated(latitude=90), "navigation.latitude: expected a number of at least -85 and at most 85 °.*, got 90"),
        (navigated(leg=[{"duration": 1}]), "navigation.leg: expected legs of at least 2 s together, for 3 steps of 1 s, got 1"),
        (navigated(leg=[]), r"navigation.leg: expected at least one \[\[navigation.leg\]\] table, got none"),
        (navigated(leg=[{"duration": 100, "acceleration": -1}]), r"navigation.leg: .*leg 1: expected a ground speed of at least 0"),
        (navigated(rate=10.5), "navigation.rate: expected a whole number of ticks in each interval of 1 s, got 10.5 at 10.5 Hz"),
        (navigated(rate=1e5, interval=100, leg=[{"duration": 1e4}]), "navigation.rate: expected at most 1000000 ticks in all"),
        (navigated(drop="speed"), "navigation.speed: expected a value, got nothing"),
        (navigated("imu", gyro_time=0), r"navigation.imu.gyro_time: expected a number of at least 0.001 .* s, got 0"),
        (navigated("imu", drop="gyro_time"), "navigation.imu.gyro_time: expected a value, got nothing"),
        (navigated("initial", attitude=[0, 1, 1]), "navigation.initial.attitude: expected three standard deviations"),
        (navigated("initial", attitude=[1, 1]), r"navigation.initial.attitude: expected a list of 3 numbers, got \[1, 1\]"),
        (navigated("model", agent=[{}, {}, {}]), r"agent\[1\].H: expected .*, got nothing"),
    ],
)  # fmt: skip
def test_wrong_navigation(source, message):
    with pytest.raises(sf.ScenarioError, match=message):
        sf.Scenario.from_mapping(source)
