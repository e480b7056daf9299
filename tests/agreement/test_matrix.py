"""Every estimator × engine × network that should agree, one matrix.

The oracle goes through every history of a network with the textbook's set-based graphs and inverses, merging nothing.
Engines: the enumeration with its states merged, the same with nothing merged, and Monte Carlo within its error.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario.scenario import link_rows
from tests.oracles import strategies, textbook
from tests.oracles.many import outcomes


class Case(NamedTuple):
    architecture: str
    agents: int
    steps: int
    dimension: int = 1
    link: str = "equal"
    unlike: bool = False
    shared: bool = False
    delay: tuple = (1.0,)


NETWORKS = {
    "ad hoc": Case("ad-hoc", 3, 2),
    "ad hoc, two agents, three steps": Case("ad-hoc", 2, 3, dimension=2),
    "ad hoc, unequal links": Case("ad-hoc", 3, 2, link="sparse"),
    "ad hoc, links by step": Case("ad-hoc", 2, 3, link="per-step"),
    "ad hoc, masked": Case("ad-hoc", 4, 2, link="chain"),
    "ad hoc, unlike agents": Case("ad-hoc", 3, 2, link="sparse", unlike=True),
    "ad hoc, shared start": Case("ad-hoc", 3, 2, link="sparse", shared=True),
    "ad hoc, delays": Case("ad-hoc", 2, 3, dimension=2, delay=(0.5, 0.3, 0.2)),
    "ad hoc, delays and unequal links": Case("ad-hoc", 2, 3, link="per-step-matrix", delay=(0.0, 1.0)),
    "ad hoc, unequal delays": Case("ad-hoc", 2, 3, dimension=2, delay=((0, (0.3, 0.5, 0.2)), (1, 0))),
    "ad hoc, unequal delays and links": Case("ad-hoc", 3, 2, link="sparse", delay=((0, 0, 1), (0, 0, (0.4, 0.6)), (1, 0, 0))),
    "broadcast, unequal delays": Case("broadcast", 2, 3, delay=((0, (0.3, 0.7)), (0, 0))),
    "cyclic, unequal delays": Case("cyclic", 3, 2, delay=((0, 1, 0), (0, 0, (0.3, 0.7)), (0, 0, 0))),
    "broadcast": Case("broadcast", 3, 3, dimension=2),
    "broadcast, unlike agents, delays, shared start": Case("broadcast", 2, 3, unlike=True, delay=(0.6, 0.4), shared=True),
    "cyclic": Case("cyclic", 3, 3),
    "cyclic, four agents": Case("cyclic", 4, 2, dimension=2),
    "cyclic, delays": Case("cyclic", 3, 2, delay=(0.7, 0.3)),
    "one agent": Case("ad-hoc", 1, 3),
}  # fmt: skip
LONG = ("ad hoc", "ad hoc, delays")
"""Networks with thousands of histories; two agents for three steps, unequal links and unequal delays are there too."""
ESTIMATORS = ("local-fusion-graph", "naive")


def links(case, rng):
    """Probabilities as a scenario file has them."""
    n, steps = case.agents, case.steps
    if case.link == "equal":
        return 0.37
    if case.link == "per-step":
        return rng.uniform(0, 1, steps).tolist()
    if case.link == "chain":
        return [[0.6 if i - j in (1, -1, 3) and i != 1 else 0.0 for j in range(n)] for i in range(n)]
    if case.link == "sparse":  # four of six links, so that the oracle is done in a second
        return (rng.uniform(0, 1, (n, n)) * [[0, 1, 1], [0, 0, 1], [1, 0, 0]]).tolist()
    shape = (n, n) if case.link == "matrix" else (steps, n, n)
    return rng.uniform(0, 1, shape).tolist()


def plain(delay):
    """Lists for tuples."""
    return [plain(each) for each in delay] if isinstance(delay, tuple) else delay


def spread(case):
    """Probabilities of 0, 1 … steps, of every link where they differ."""
    if isinstance(case.delay[0], float):
        return case.delay
    return [[d if isinstance(d, tuple) else (0.0,) * d + (1.0,) for d in row] for row in case.delay]


@cache
def given(name):
    """Scenario, records, and the pieces that the oracle takes."""
    case = NETWORKS[name]
    rng = np.random.default_rng(list(NETWORKS).index(name))
    F, Q, H, R, P0 = strategies.model(rng, case.dimension, 1)
    link = links(case, rng)
    x0, records = rng.normal(size=(case.dimension, 1)), rng.normal(size=(case.steps, case.agents, 1, 1))
    sensors = [(H, R * (1 + case.unlike * i)) for i in range(case.agents)]
    source = strategies.mapping(
        F, Q, H, R, P0, case.agents, case.steps, architecture=case.architecture, link=link, delay=plain(case.delay)
    )
    source["initial"] |= {"x": x0[:, 0].tolist(), "correlation": "shared" if case.shared else "independent"}
    if case.unlike:
        source["agent"] = [{"R": r.tolist()} for _, r in sensors]
    full = np.array(link)
    full = full[:, None, None] if full.ndim == 1 else full
    full = np.broadcast_to(full, (case.steps, case.agents, case.agents))
    return (
        case,
        sf.Scenario.from_mapping(source),
        (F, Q, sensors, P0, x0, records, case.architecture, full, spread(case)),
    )


@cache
def oracle(name, estimator):
    case, _, pieces = given(name)
    return textbook.expected_by_enumeration(*pieces, shared=case.shared, naive=estimator == "naive")


def by_agent(found, values):
    """(steps, groups, …) as (steps, agents, …)."""
    group_of = np.zeros(sum(map(len, found.groups)), dtype=int)
    for g, agents in enumerate(found.groups):
        group_of[list(agents)] = g
    return values[0][:, group_of]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("engine", ["merged", "plain", "states", "monte-carlo"])
@pytest.mark.parametrize(
    "network", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in NETWORKS]
)
def test_agreement(network, engine, estimator):
    case, scenario, pieces = given(network)
    P, x = oracle(network, estimator)
    rows = link_rows(scenario)
    if engine == "monte-carlo":
        p = sf.predict(scenario, method="monte-carlo", estimator=estimator, runs=1500, seed=3, workers=1)
        for agent in range(1, case.agents + 1):
            error = p.standard_error("trace", agent)[0]
            difference = p.values("trace", agent)[0] - np.trace(P[:, agent - 1], axis1=-2, axis2=-1)
            assert (np.abs(difference) <= 4.5 * error + 1e-12).all()
        return
    records = pieces[5][..., 0] if engine == "states" else None
    found = outcomes(scenario, rows, estimator, records=records, plain=engine == "plain")
    np.testing.assert_allclose(by_agent(found, found.covariance()), P, rtol=1e-12, atol=1e-13)
    if engine == "states":
        np.testing.assert_allclose(by_agent(found, found.states()), x, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast"])
@pytest.mark.parametrize("link", [0.0, 1.0])
def test_simplified_and_general_agree_where_nothing_is_left_to_chance(architecture, link):
    for preset in ("thesis-transient", "cv-2d"):
        scenario = sf.load_scenario(preset, steps=4, architecture=architecture)
        simplified, general = (sf.predict(scenario, [link], method).covariance for method in ("simplified", "general"))
        np.testing.assert_allclose(general, simplified, rtol=1e-9, atol=1e-12)


def test_step_one_is_the_same_for_all_methods():
    scenario = sf.load_scenario(steps=2, agents=4)
    values = [sf.predict(scenario, [0.2, 0.8], m).values()[:, 0] for m in ("simplified", "general", "naive")]
    np.testing.assert_allclose(values[1:], values[:1] * 2, rtol=1e-14)
