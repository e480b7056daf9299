"""The network estimators of issue 5 against naive re-derivations (`tests/textbook_estimators.py`), and their limits."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.general import outcomes
from stochfuse.scenario import link_rows
from tests import strategies, test_agreement, textbook_estimators

ONE_STATE = tuple(textbook_estimators.RULES)
INTERSECTIONS = ("covariance-intersection", "split-ci")
BLENDERS = ("blender", "joint-blender")
EQUIVALENTS = ("equivalent-measurement", "independent-measurements")
OWN = ("stand-alone", *INTERSECTIONS, "lwin", "itns")
UNLIKE_SENSORS = tuple(name for name in ONE_STATE if name not in EQUIVALENTS)
QUANTITIES = ("claimed", "actual", "bias", "rms")


def matrices(rng, d, p):
    F, Q, H, R, P0 = strategies.model(rng, d, p)
    return dict(zip("FHQR", (M.tolist() for M in (F, H, Q, R)), strict=True)), P0


def one_state(seed, d, p, agents, steps, architecture="ad-hoc", link: object = 0.37, **more):
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


SPARSE = [[0, 0.2, 0.7], [0, 0, 0.45], [0.8, 0, 0]]
TRIANGLE = [[0, 0], [10, 2], [3, 8]]
CASES = {
    "ad hoc, unequal links": (one_state(1, 2, 1, 3, 2, link=SPARSE), ONE_STATE),
    "ad hoc, two agents, three steps": (one_state(2, 2, 2, 2, 3), ONE_STATE),
    "ad hoc, everything by step": (changing(3), ONE_STATE),
    "ad hoc, hears": (one_state(4, 1, 1, 3, 3, network={"hears": [[2, 3], [], [1]]}), ONE_STATE),
    "broadcast": (one_state(5, 2, 1, 3, 2, "broadcast"), ONE_STATE),
    "cyclic": (one_state(6, 1, 1, 3, 3, "cyclic"), ONE_STATE),
    "cyclic, two dimensions": (one_state(7, 2, 1, 3, 2, "cyclic", 0.6), ONE_STATE),
    "unlike noises": (
        one_state(8, 2, 1, 3, 2, "broadcast", agent=[{"R": [[4.0]]}, {}, {"R": [[0.3]]}]), ONE_STATE),
    "unlike sensors": (
        one_state(9, 2, 1, 3, 2, link=SPARSE, agent=[{}, {"H": [[1, 0], [0, 2]], "R": covariance(1, 2)}, {"R": [[2.0]]}]),
        UNLIKE_SENSORS),
    "an agent without a sensor": (
        one_state(10, 2, 1, 3, 3, "cyclic", agent=[{"sensor": False}, {}, {"R": [[0.5]]}]), ONE_STATE),
    "shared start": (one_state(11, 2, 1, 3, 3, "cyclic", initial={"correlation": "shared"}), ONE_STATE),
    "correlated noise": (
        one_state(12, 2, 2, 3, 2, "broadcast", noise={"correlation": [[1, 0.6, 0], [0.6, 1, -0.3], [0, -0.3, 1]]},
                  agent=[{"R": covariance(2, 2)}, {"R": covariance(3, 2)}, {"R": covariance(4, 2)}]),
        ONE_STATE),
    "correlated, like agents": (
        one_state(13, 1, 1, 3, 3, "cyclic", 0.6, noise={"correlation": 0.4}), ONE_STATE),
    "disturbed": (
        one_state(14, 2, 2, 2, 3, link=0.55, noise={"correlation": 0.7, "disturbance": covariance(5, 4)}), ONE_STATE),
    "delays": (one_state(15, 2, 1, 2, 3, link=0.6, network={"delay": [0.5, 0.3, 0.2]}), INTERSECTIONS),
    "delays, unlike agents": (
        one_state(16, 2, 1, 3, 2, "broadcast", network={"delay": [0.6, 0.4]}, agent=[{"R": [[3.0]]}, {}, {}]),
        INTERSECTIONS),
    "own states, ranges": (
        own_states(17, TRIANGLE, 2, SPARSE, [{}, {}, {}], {"positions": ["x", "y"], "range": 0.7}), OWN),
    "own states, directions, cyclic": (
        own_states(18, TRIANGLE, 3, 0.5, [{"R": [[2.0]]}, {"Q": covariance(6, 3), "P": covariance(7, 3, 1.0)},
                                          {"F": np.diag([0.9, 1.0, 0.5]).tolist()}],
                   {"positions": ["z", "x"], "direction": 0.05}, d=3, architecture="cyclic"), OWN),
    "own states in space, moving, unlike pairs": (
        own_states(19, [[[0, 0, 0], [1, 0, 2]], [10, -2, 3], [-4, 8, 1]], 2, 0.45, [{}, {"sensor": False}, {}],
                   {"positions": ["x", "y", "w"], "range": 0.5, "pair": [
                       {"agents": [1, 2], "range": 0.2, "direction": 0.03},
                       {"agents": [3, 2], "direction": 0.1, "both_ways": False},
                       {"agents": [3, 1], "none": True}]}, d=4, architecture="broadcast"), OWN),
    "parallel filters": (parallel_filters(20), BLENDERS),
}  # fmt: skip
MATRIX = [(case, estimator) for case, (_, estimators) in CASES.items() for estimator in estimators]


@cache
def oracle(case, estimator):
    return textbook_estimators.expected(CASES[case][0], estimator)


@cache
def scenario_of(case):
    return sf.Scenario.from_mapping(CASES[case][0])


def close(got, expected, relative=1e-9):
    np.testing.assert_allclose(got, expected, rtol=relative, atol=relative * np.abs(expected).max())


@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_against_every_history(case, estimator):
    p = sf.predict(scenario_of(case), method="general", estimator=estimator, quantity="rms")
    for quantity, expected in oracle(case, estimator).items():
        shown = p.shown_as(quantity)
        for agent in range(expected.shape[1]):
            close(shown.of_agent(agent + 1)[0], expected[:, agent])


@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_nothing_merged(case, estimator):
    scenario, exact = scenario_of(case), oracle(case, estimator)
    found = outcomes(scenario, link_rows(scenario), estimator, errors=True, plain=True)
    for quantity in QUANTITIES:
        close(test_agreement.by_agent(found, found.covariance(quantity=quantity)), exact[quantity])
    without_errors = outcomes(scenario, link_rows(scenario), estimator, plain=True)
    close(test_agreement.by_agent(without_errors, without_errors.covariance()), exact["claimed"])


@pytest.mark.parametrize(("case", "estimator"), MATRIX)
def test_monte_carlo(case, estimator):
    exact = oracle(case, estimator)
    p = sf.predict(
        scenario_of(case), method="monte-carlo", estimator=estimator, quantity="rms", runs=1500, seed=4, workers=1
    )
    for quantity in ("claimed", "actual"):
        shown = p.shown_as(quantity)
        for agent in range(1, exact["claimed"].shape[1] + 1):
            error = shown.standard_error("trace", agent)[0]
            difference = shown.values("trace", agent)[0] - np.trace(exact[quantity][:, agent - 1], axis1=1, axis2=2)
            assert (np.abs(difference) <= 4.5 * error + 1e-9 * np.abs(exact[quantity]).max()).all()
