"""The least or greatest value of a key, against closed forms and brute force."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.optimize import brentq

import stochfuse as sf
from stochfuse.errors import NoAnswerError, ScenarioError, UsageError

SCALAR = {
    "model": {"F": 1, "H": 1, "Q": 1, "R": 4},
    "initial": {"P": 10},
    "network": {"agents": 2, "steps": 2, "link": 0.25},
}


def closed_form(R, Q=1.0, P=10.0, µ=0.25):
    """(54) of two agents at step 2: both steps averaged over a message that comes or not."""
    first = (1 - µ) * P + µ * P / 2
    prior = first + Q
    return (1 - µ) * prior * R / (prior + R) + µ * prior * R / 2 / (prior + R / 2)


@pytest.mark.parametrize("target", [0.5, 2.0, 3.5])
def test_the_greatest_noise_of_a_scalar_filter(target):
    found = sf.least_value(SCALAR, target, "model.R", (0.1, 50))
    expected = brentq(lambda r: closed_form(r) - target, 0.1, 50, xtol=1e-14)
    assert found.direction == "greatest"
    assert found.proof == "monotone"
    assert found.at == pytest.approx(expected, rel=1e-12)
    assert found.value <= target < found.beside[1]
    assert 0 < found.beside[0] - found.at < 1e-12 * found.at
    assert closed_form(found.at) == pytest.approx(target, rel=1e-12)
    assert found.question.scenario.sensors[0].R[0, 0] == found.at


def test_the_least_link_is_least_link():
    by_key = sf.least_value("thesis-transient", 30.0, "network.link", (0, 1))
    assert by_key.direction == "least"
    assert by_key.at == pytest.approx(sf.least_link("thesis-transient", 30.0).link, abs=1e-12)


def test_links_of_the_scenario_or_one_given():
    at = sf.least_value("thesis-transient", 30.0, "model.R", (50, 200), 0.7).at
    mapping = sf.load_scenario("thesis-transient").to_mapping()
    mapping["network"]["link"] = 0.7
    assert sf.least_value(mapping, 30.0, "model.R", (50, 200)).at == at
    with pytest.raises(UsageError, match="expected one link probability, since the scenario has 5 rows of links"):
        sf.least_value("thesis-transient", 30.0, "model.R", (50, 200))


@pytest.mark.parametrize(
    ("key", "low", "high", "target", "settings"),
    [
        ("network.agents", 1, 8, 3.0, {}),
        ("network.steps", 1, 6, 4.0, {}),
        ("network.delay", 0, 4, 4.2, {"method": "general", "quantity": "actual"}),
    ],
)
def test_whole_numbers_against_all_of_them(key, low, high, target, settings):
    base = copy.deepcopy(SCALAR)
    base["network"]["steps"] = 3
    name = key.split(".")[1]
    values = {}
    for v in range(low, high + 1):
        mapping = copy.deepcopy(base)
        mapping["network"][name] = v
        values[v] = float(sf.predict(mapping, **settings).values()[0, -1])
    met = [v for v in values if values[v] <= target]
    found = sf.least_value(base, target, key, (low, high), **settings)
    assert found.proof == "every"
    assert isinstance(found.at, int)
    assert found.at == (min(met) if found.direction == "least" else max(met))
    assert values[found.at] == found.value
    misses = found.at + (1 if found.direction == "greatest" else -1)
    assert found.beside == (None if misses not in values else (misses, values[misses]))


def test_many_whole_numbers_are_halved():
    found = sf.least_value(SCALAR, 0.05, "network.agents", (1, 2000), 0.5)
    below = copy.deepcopy(SCALAR)
    below["network"]["agents"] = found.at - 1
    assert found.proof == "monotone"
    assert found.value <= 0.05 < float(sf.predict(below, [0.5]).values()[0, -1])
    assert found.beside[0] == found.at - 1


def test_a_number_that_goes_up_and_down_is_found_on_a_grid():
    base = {**SCALAR, "initial": {"P": 10, "error": 1.0}}
    asked = {"quantity": "bias", "link": 0.25}
    found = sf.least_value(base, 0.5, "initial.error", (-7, 10), **asked)
    assert found.proof == "grid"
    slope = abs(float(sf.predict(base, [0.25], quantity="bias").values()[0, -1]))
    assert found.met == ((pytest.approx(-0.5 / slope, rel=1e-12), pytest.approx(0.5 / slope, rel=1e-12)),)
    assert found.direction == "greatest"
    assert found.at == found.met[0][1]
    # narrower than a cell of the grid
    narrow = sf.least_value(base, 1e-3, "initial.error", (-7, 10), **asked)
    assert narrow.at == pytest.approx(1e-3 / slope, rel=1e-9)


def test_the_steady_state_and_where_there_is_none():
    base = {
        "model": {"F": 1.5, "H": 1, "Q": 1, "R": 4}, "initial": {"P": 10}, "network": {"agents": 2, "steps": 2, "link": 0.5},
    }  # fmt: skip
    ends = sf.predict(base, over={"model.F": [0.2, 1.4]}, steady=True).steady_values()
    target = float(ends.mean())
    found = sf.least_value(base, target, "model.F", (0.2, 1.4), steady=True)
    assert found.direction == "greatest"
    for v, expected in ((found.at, True), (found.beside[0], False)):
        mapping = copy.deepcopy(base)
        mapping["model"]["F"] = v
        assert (float(sf.predict(mapping, steady=True).steady_values()[0]) <= target) is expected


def test_a_target_that_was_printed_in_full_is_met():
    best = float(sf.predict(SCALAR, over={"model.R": [0.5]}).values()[0, -1])
    assert sf.least_value(SCALAR, best, "model.R", (0.5, 9)).at == pytest.approx(0.5, rel=1e-9)
    everywhere = sf.least_value(SCALAR, 100.0, "model.R", (0.5, 9))
    assert everywhere.at == 9
    assert everywhere.beside is None


@pytest.mark.parametrize(
    ("error", "message", "target", "key", "between", "asked"),
    [
        (NoAnswerError, r"is 0\.417644817 at best, at model\.R = 0\.5; expected a target of at least that, got 0\.1", 0.1, "model.R", (0.5, 9), {}),
        (UsageError, "expected a least and a greatest value, LO:HI with LO < HI", 1, "model.R", (2, 1), {}),
        (UsageError, "expected a least and a greatest value", 1, "model.R", (1, 2, 3), {}),
        (UsageError, r"did you mean 'model\.R'", 1, "model.r", (1, 2), {}),
        (UsageError, "step: expected none with over network.steps", 1, "network.steps", (1, 2), {"step": 1}),
        (UsageError, "got monte-carlo: its values are sampled", 1, "model.R", (1, 2), {"method": "monte-carlo"}),
        (ScenarioError, r"model\.R=-1:\n  model\.R: expected", 1, "model.R", (-1, 2), {}),
    ],
)  # fmt: skip
def test_what_has_no_answer(error, message, target, key, between, asked):
    with pytest.raises(error, match=message):
        sf.least_value(SCALAR, target, key, between, **asked)


def test_bursty_links_are_no_hindrance():
    base = copy.deepcopy(SCALAR)
    del base["network"]["link"]
    base["network"] |= {"burst": {"good_to_bad": 0.2, "bad_to_good": 0.4}, "steps": 3}
    found = sf.least_value(base, 2.0, "model.R", (0.5, 20), method="general", quantity="actual")
    values = []
    for r in np.linspace(0.5, 20, 16):
        mapping = copy.deepcopy(base)
        mapping["model"]["R"] = float(r)
        values.append((r, float(sf.predict(mapping, method="general", quantity="actual").values()[0, -1])))
    assert max(r for r, v in values if v <= 2.0) <= found.at < min(r for r, v in values if v > 2.0)
