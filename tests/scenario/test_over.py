"""Numbers at their paths, and the scenarios that they make."""

from __future__ import annotations

import copy
import re

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import NoAnswerError, ScenarioError, UsageError
from stochfuse.scenario import over as module
from stochfuse.scenario.over import over, put, unit_of
from stochfuse.scenario.schema import ScenarioFile, fields_at, key_paths

TWO = {
    "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[1, 0], [0, 2]], "R": 4},
    "initial": {"P": [[9, 0], [0, 1]]},
    "network": {"agents": 2, "steps": 3, "link": [[0, 0.4], [0.7, 0]]},
    "agent": [{}, {"R": 9}],
}


def test_numbers_are_put_at_tables_lists_and_entries_of_matrices():
    found = put(TWO, {"agent[2].R": 5, "model.Q[2][2]": 7, "network.link[1][2]": 0.9, "initial.correlation": "shared"})
    expected = copy.deepcopy(TWO)
    expected["agent"][1]["R"] = 5
    expected["model"]["Q"][1][1] = 7
    expected["network"]["link"][0][1] = 0.9
    expected["initial"]["correlation"] = "shared"
    assert found == expected
    assert TWO["agent"][1]["R"] == 9


def test_a_link_takes_the_place_of_what_else_says_how_likely_messages_are():
    base = {"network": {"agents": 2, "case": [], "burst": {}, "radio": {}, "delay": 1}}
    assert put(base, {"network.link": 0.5}) == {"network": {"agents": 2, "delay": 1, "link": 0.5}}
    base = {"network": {"agents": 2, "case": [], "link": 0.5}}
    assert put(base, {"network.burst.good": 0.5}) == {"network": {"agents": 2, "burst": {"good": 0.5}}}


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("agent[3].R", "lists no 3 there"),
        ("network.link[3][1]", "lists no 3 there"),
        ("network.agents.more", "it leads through what is no table"),
        ("network.agents.more.yet", "it leads nowhere"),
    ],
)
def test_a_path_that_leads_nowhere(path, why):
    with pytest.raises(ScenarioError, match="expected a key of the scenario such as") as raised:
        put(TWO, {path: 1})
    assert raised.value.problems[0].path == path
    assert why in str(raised.value)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("network.delay", "steps"),
        ("cooperative.direction", "rad"),
        ("navigation.imu.velocity_random_walk", "m/s/√h"),
        ("navigation.leg[2].acceleration", "m/s²"),
        ("navigation.height", "m"),
        ("navigation.imu.gyro_bias", "°/h"),
        ("network.agents", ""),
        ("network.link", ""),
        ("model.R", ""),
        ("agent[2].sensor.sigma", ""),
    ],
)
def test_units_come_from_the_schema(name, unit):
    assert unit_of(name) == unit


def test_every_key_of_the_schema_is_found_by_its_path():
    for path in key_paths(ScenarioFile):
        assert fields_at(ScenarioFile, path.split(".")), path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("network.dely", r"got 'network\.dely' \(did you mean 'network\.delay'\?\)"),
        ("angle_random_walk", r"did you mean 'navigation\.imu\.angle_random_walk'"),
        ("network.agents.x", "got 'network.agents.x'"),
        ("agent[0].R", r"got 'agent\[0\]\.R' \(did you mean 'agent\.R'"),
        ("model.r", r"did you mean 'model\.R'"),
        ("", "got ''"),
    ],
)
def test_unknown_keys(name, message):
    with pytest.raises(UsageError, match=message):
        over(sf.load_scenario(), {name: [1]})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "expected one or two keys, got 0"),
        ({"model.Q": 1, "model.R": 1, "initial.P": 1}, "expected one or two keys, got 3"),
        ({"model.Q": []}, r"over model\.Q: expected at least one value"),
        ({"model.Q": ["a"]}, r"over model\.Q: expected finite numbers, got 'a'"),
        ({"model.Q": [True]}, "expected finite numbers, got True"),
        ({"model.Q": [np.nan]}, "expected finite numbers, got nan"),
        ({"model.Q": [[1]]}, r"expected finite numbers, got \[\[1\]\]"),
        (
            {"model.Q": range(1, 200), "model.R": range(1, 200)},
            "at most 10,000 scenarios, got 39,601; see `stochfuse st",
        ),
    ],
)
def test_values_that_are_none(given, message):
    with pytest.raises(UsageError, match=message):
        over(sf.load_scenario(), given)


def test_points_run_with_the_last_key_fastest_and_are_named():
    found = over(sf.load_scenario(), {"model.Q": np.array([1.0, 2.5]), "network.agents": np.array([2, 3, 4])})
    assert found.points == [(q, n) for q in (1.0, 2.5) for n in (2, 3, 4)]
    assert found.label(4) == "model.Q=2.5, network.agents=3"
    assert [s.network.agents for s in found.scenarios] == [2, 3, 4, 2, 3, 4]
    assert [float(s.model.Q[0, 0]) for s in found.scenarios] == [1, 1, 1, 2.5, 2.5, 2.5]
    assert found.longest is found.scenarios[2]


def test_a_number_that_does_not_fit_is_named_and_keeps_its_problems():
    with pytest.raises(ScenarioError, match=r"^model\.R=0:\n  model\.R: expected a symmetric") as raised:
        over(sf.load_scenario(), {"model.R": [1, 0]})
    assert [problem.path for problem in raised.value.problems] == ["model.R"]


def test_errors_keep_their_type_under_the_points_name():
    found = over(sf.load_scenario(), {"model.Q": [1]})
    for kind in (UsageError, NoAnswerError):
        with pytest.raises(kind, match=r"^model\.Q=1: why$"), found.at(0):
            raise kind("why")


@pytest.mark.parametrize(
    ("source", "given", "together"),
    [
        ("thesis-transient", {"model.Q": [1, 2], "model.R": [1, 2]}, True),
        ("thesis-transient", {"initial.P": [1, 2], "network.link": [0.1, 0.2]}, True),
        ("thesis-transient", {"network.delay": [0, 1]}, False),
        ("thesis-transient", {"initial.error": [0, 1]}, False),
        ("thesis-transient", {"model.F": [1, 2]}, False),
        ("thesis-transient", {"model.H": [1, 2]}, False),
        (TWO, {"network.link[1][2]": [0.1, 0.2]}, True),
        (TWO, {"agent[2].R": [1, 2]}, False),
        (TWO, {"model.Q[1][1]": [1, 2]}, False),
    ],
)
def test_what_is_predicted_together(source, given, together):
    items = over(sf.load_scenario(source), given).items(None)
    assert (items is not None) is together


def test_items_hold_every_points_numbers():
    found = over(sf.load_scenario(), {"model.R": [3, 5]})
    items = found.items([0.2, 0.4, 0.6])
    assert items is not None
    assert items.links.link.tolist() == [0.2, 0.4, 0.6] * 2
    assert items.noises.R is not None
    assert items.noises.R.ravel().tolist() == [3, 3, 3, 5, 5, 5]
    assert items.noises.Q is None
    assert items.noises.P0 is None
    assert module.MOST_KEYS == 2


@pytest.mark.parametrize("scale", [0.0, 0.5, 1.5, 3.0])
def test_a_factor_on_all_links_is_the_links_times_it(scale):
    µ = np.array([[1, 0.5, 0.9], [0.5, 1, 0.3], [0.7, 0.2, 1]])
    given = {
        "model": {"F": 1, "H": 1, "Q": 1, "R": 4},
        "initial": {"P": 10},
        "network": {"agents": 3, "steps": 3, "link": µ.tolist(), "case": [{"name": "weak", "link": 0.4}]},
    }
    scaled = copy.deepcopy(given)
    scaled["network"]["scale"] = scale
    by_hand = copy.deepcopy(given)
    by_hand["network"] |= {
        "link": np.minimum(1, scale * µ).tolist(),
        "case": [{"name": "weak", "link": min(1, scale * 0.4)}],
    }
    np.testing.assert_array_equal(
        sf.predict(scaled, method="optimal").covariance, sf.predict(by_hand, method="optimal").covariance
    )


def test_a_factor_on_bursty_links_is_one_on_what_they_deliver():
    def with_burst(good, bad, **more):
        burst = {"good_to_bad": 0.1, "bad_to_good": 0.3, "good": good, "bad": bad}
        return {
            "model": {"F": 1, "H": 1, "Q": 1, "R": 4},
            "initial": {"P": 10},
            "network": {"agents": 2, "steps": 3, "burst": burst, **more},
        }

    expected = sf.predict(with_burst(1.0, 0.4), method="general")
    found = sf.predict(with_burst(0.8, 0.2, scale=2), method="general")
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    np.testing.assert_allclose(found.link, 0.75 * 1.0 + 0.25 * 0.4, rtol=1e-15)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ({"scale": 2}, "network.scale: expected link probabilities in the scenario that it scales, got none"),
        ({"link": 0.5, "scale": -1}, "network.scale: expected a finite number of at least 0, got -1"),
        ({"link": 0.5, "scale": [1, 2]}, "network.scale: expected a number, got"),
    ],
)
def test_a_factor_that_scales_nothing_or_is_none(network, message):
    given = {"model": {"F": 1, "H": 1, "Q": 1, "R": 4}, "initial": {"P": 10}, "network": {"agents": 2, "steps": 3}}
    given["network"] |= network
    with pytest.raises(ScenarioError, match=re.escape(message)):
        sf.load_scenario(given)
