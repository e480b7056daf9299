"""Sensors that may miss: averaged as links are, against every history of misses gone through by pausing sensors."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.kalman.arrivals import like_senders
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.model import Sensor, over_steps
from tests.oracles import featured, textbook, textbook_estimators


def with_detection(scenario: sf.Scenario, p: list) -> sf.Scenario:
    """The same with each agent's probability of detection: a number, one per step, or None."""
    sensors, of = [], []
    for i, detection in enumerate(p):
        given = scenario.sensors[scenario.sensor_of[i]]
        key = None if detection is None else np.asarray(detection, dtype=float)
        like = [
            k for k, s in enumerate(sensors) if s.H is given.H and s.R is given.R and np.array_equal(s.detection, key)
        ]
        if not like:
            sensors.append(Sensor(given.H, given.R, key))
        of.append(like[0] if like else len(sensors) - 1)
    return replace(scenario, sensors=tuple(sensors), sensor_of=tuple(of))


def with_pauses(scenario: sf.Scenario, seen: np.ndarray) -> sf.Scenario:
    """The same with H = 0 where an agent (columns) misses at a step (rows)."""
    steps = scenario.network.steps
    sensors = []
    for i, kind in enumerate(scenario.sensor_of):
        given = scenario.sensors[kind]
        H = over_steps(given.H, steps) * seen[:, i, None, None]
        sensors.append(Sensor(H, over_steps(given.R, steps)))
    return replace(scenario, sensors=tuple(sensors), sensor_of=tuple(range(len(sensors))))


def histories(p: list, steps: int):
    """Every history of misses from step 2 on, with its probability."""
    table = np.array([np.broadcast_to(1.0 if each is None else each, steps) for each in p]).T
    for some in product([True, False], repeat=(steps - 1) * len(p)):
        seen = np.concatenate([np.ones((1, len(p)), bool), np.array(some).reshape(steps - 1, len(p))])
        probability = np.where(seen, table, 1.0 - table)[1:].prod()
        if probability > 0:
            yield probability, seen


def by_pauses(scenario, p, **asked):
    total = 0.0
    for probability, seen in histories(p, scenario.network.steps):
        total = total + probability * sf.predict(with_pauses(scenario, seen), **asked).covariance
    return total


def small(agents=2, steps=3, features=(), **network):
    source = featured.source({"several-states", *features})
    source["network"] |= {"agents": agents, "steps": steps, **network}
    if "agent" in source:
        source["agent"] += [{}] * (agents - len(source["agent"]))
    return sf.Scenario.from_mapping(source)


CASES = {
    "like": (small(), [0.6, 0.6]),
    "unlike": (small(), [0.3, 0.9]),
    "one certain": (small(), [0.3, None]),
    "by step": (small(), [[1.0, 0.2, 0.7], [1.0, 0.9, 0.0]]),
    "never": (small(), [0.0, 0.5]),
    "delays": (small(delay=[0.5, 0.5]), [0.6, 0.6]),
    "unequal links": (small(link=[[0, 0.3], [0.8, 0]]), [0.6, 0.4]),
    "bursts": (small(link=None, burst={"good_to_bad": 0.2, "bad_to_good": 0.4}), [0.6, 0.6]),
    "cyclic": (small(3, 2, architecture="cyclic"), [0.6, 0.6, 0.3]),
    "broadcast": (small(3, 2, architecture="broadcast"), [0.6, 0.6, 0.3]),
    "shared start": (small(features={"shared-start"}), [0.6, 0.6]),
}
SUMS_AND_PASTS = [e for e in registry.ESTIMATORS if not capabilities.reason(e, registry.GENERAL, "detection")]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("estimator", ["local-fusion-graph", "naive", "optimal", "covariance-intersection", "split-ci"])
def test_every_history_of_misses_by_enumeration(case, estimator):
    scenario, p = CASES[case]
    found = sf.predict(with_detection(scenario, p), method="general", estimator=estimator)
    np.testing.assert_allclose(
        found.covariance, by_pauses(scenario, p, method="general", estimator=estimator), rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("case", CASES)
def test_the_chain_thins_what_is_held(case):
    scenario, p = CASES[case]
    found = sf.predict(with_detection(scenario, p), method="chain").covariance
    np.testing.assert_allclose(found, by_pauses(scenario, p, method="chain"), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("quantity", ["actual", "bias", "rms"])
@pytest.mark.parametrize("estimator", ["local-fusion-graph", "naive", "split-ci", "stand-alone", "lwin", "itns"])
def test_true_errors(quantity, estimator):
    scenario, p = small(features={"initial-error"}), [0.6, 0.3]
    asked = {"method": "general", "estimator": estimator, "quantity": quantity}
    found = sf.predict(with_detection(scenario, p), **asked)
    metric = "std:x1" if quantity == "bias" else "trace"
    total = 0.0
    for probability, seen in histories(p, scenario.network.steps):
        one = sf.predict(with_pauses(scenario, seen), **asked)
        value = one.values(metric)
        total = total + probability * (value**2 if quantity == "rms" and metric == "trace" else value)
    expected = found.values(metric) ** (2 if quantity == "rms" else 1)
    np.testing.assert_allclose(expected, total, rtol=1e-9, atol=1e-12)


class Missing(textbook_estimators.Equivalent):
    """Equivalent measurements of the sensors that measured."""

    seen = np.ones((1, 1), bool)

    def fuse(self, k, i, now, heard, late):
        given = self.t.H
        self.t.H = [H if self.seen[k - 1, j] else H[..., :0, :] for j, H in enumerate(given)]
        try:
            return super().fuse(k, i, now, [j for j in heard if self.seen[k - 1, j]], late)
        finally:
            self.t.H = given


def of_measurements(seen):
    def expected(source, name):
        Missing.seen = seen
        before = textbook_estimators.RULES[name]
        textbook_estimators.RULES[name] = Missing
        try:
            return textbook_estimators.expected(source, name)
        finally:
            textbook_estimators.RULES[name] = before

    return expected


def test_equivalent_measurements_are_of_the_sensors_that_measured():
    source = featured.source({"correlated-noises", "several-states"})
    source["network"] |= {"steps": 3, "link": [[0, 0.3], [0.8, 0]]}
    scenario, p = sf.Scenario.from_mapping(source), [0.6, 0.3]
    total = {"claimed": 0.0, "actual": 0.0}
    for probability, seen in histories(p, 3):
        found = of_measurements(seen)(source, "equivalent-measurement")
        total = {quantity: total[quantity] + probability * found[quantity] for quantity in total}
    for quantity, expected in total.items():
        shown = sf.predict(
            with_detection(scenario, p), method="general", estimator="equivalent-measurement", quantity=quantity
        )
        for agent in (1, 2):
            np.testing.assert_allclose(
                shown.values("trace", agent=agent)[0], np.trace(expected[:, agent - 1], axis1=-2, axis2=-1), rtol=1e-9
            )


@pytest.mark.parametrize("features", [(), ("unlike-noises",), ("shared-start",)])
@pytest.mark.parametrize("p", [[0.6, 0.6, 0.6], [0.9, 0.2, None], [[1, 0.5, 0.1], [1, 1, 1], [1, 0, 0.5]]])
@pytest.mark.parametrize("link", [0.4, "matrix"])
def test_the_mean_field_averages_over_measurements(features, p, link):
    """(54) by all sets of measurements, the agent's own among them."""
    µ = np.random.default_rng(3).uniform(0, 1, (3, 3)) if link == "matrix" else np.full((3, 3), link)
    scenario = small(3, 3, features, link=µ.tolist())
    made = with_detection(scenario, p)
    F, Q, P0 = (np.array(M) for M in (scenario.model.F, scenario.model.Q, scenario.P0))
    table = np.array([np.broadcast_to(1.0 if each is None else each, 3) for each in p]).T.astype(float)
    table[0] = 1.0
    found = sf.predict(made, method="simplified")
    for agent in range(3):
        P, out = np.array(P0), []
        for k in range(3):
            prior = P if k == 0 else textbook.kalman_predict(P, F, Q)
            P = np.zeros_like(P0)
            for arrived in product([False, True], repeat=3):
                chance = np.array([table[k, j] * (1.0 if j == agent else µ[agent, j]) for j in range(3)])
                weight = np.where(arrived, chance, 1.0 - chance).prod()
                one = prior
                if k == 0:
                    one = one if "shared-start" in features else one / max(sum(arrived), 1)
                else:
                    for j in np.flatnonzero(arrived):
                        sensor = scenario.sensors[scenario.sensor_of[j]]
                        one = textbook.kalman_update(one, np.array(sensor.H), np.array(sensor.R))
                P = P + weight * one
            out.append(np.trace(P))
        np.testing.assert_allclose(found.values("trace", agent=agent + 1)[0], out, rtol=1e-12)


def test_many_like_agents_are_averaged_by_their_binomial():
    s = np.geomspace(1e-3, 1e3, 7)[:, None] * np.ones((1, 3))
    µ = np.array([0.0, 0.3, 1.0])
    for senders in (3, 250):
        found = like_senders(senders, µ, 0.7)
        n = np.arange(senders + 2.0)[:, None, None]
        pmf = np.zeros((senders + 2, 3))
        for item, link in enumerate(µ):
            table = np.array([1.0])
            for q in [0.7] + [0.7 * link] * senders:
                table = np.convolve(table, [1 - q, q])
            pmf[:, item] = table
        np.testing.assert_allclose(found.remaining(s), (pmf[:, None] / (1 + n * s)).sum(axis=0), rtol=1e-11)
        np.testing.assert_allclose(found.gained(s), (pmf[:, None] * n / (1 + n * s)).sum(axis=0), rtol=1e-11)


@pytest.mark.parametrize("estimator", ["local-fusion-graph", "naive", "split-ci", "itns", "equivalent-measurement"])
def test_a_sample_agrees_within_its_error(estimator):
    scenario = with_detection(small(2, 3), [0.6, 0.3])
    exact = sf.predict(scenario, method="general", estimator=estimator)
    sampled = sf.predict(scenario, method="monte-carlo", estimator=estimator, runs=4000, seed=5, workers=1)
    error = sampled.standard_error("trace")
    assert (np.abs(sampled.values() - exact.values()) <= 4.5 * error + 1e-12).all()


@pytest.mark.slow
def test_bounds_hold_where_paths_are_too_many():
    for features in ((), ("several-states",)):
        source = featured.source(features)
        source["network"] |= {"agents": 5, "steps": 10, "link": 0.4}
        made = with_detection(sf.Scenario.from_mapping(source), [0.5] * 5)
        found = sf.predict(made, method="chain")
        bound = np.array(found.meta["relative_bound"]).max()
        sampled = sf.predict(made, method="monte-carlo", estimator="optimal", runs=1000, seed=2, workers=1)
        slack = 4.5 * sampled.standard_error("trace") + bound * found.values()
        assert 0 < bound < 0.2
        assert (np.abs(sampled.values() - found.values()) <= slack).all()


def test_the_polynomial_and_its_derivative_have_detections():
    scenario = with_detection(small(link=None), [0.6, 0.6])
    h, µ = 1e-5, np.array([0.3, 0.7])
    found = sf.predict(scenario, µ, "general").statistic("derivative")
    ahead, behind = (sf.predict(scenario, µ + s * h, "general").values() for s in (1, -1))
    np.testing.assert_allclose(found, (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-9)
