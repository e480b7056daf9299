"""The capability table, walked: every estimator and engine with each feature of a scenario, and with each pair of them.

What the table takes gives finite numbers; what it does not take is refused with the table's reason.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from itertools import combinations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.scenario import link_rows
from tests.cli.command import run, strict_json
from tests.oracles import featured

NAMES = [f.name for f in capabilities.FEATURES]
PAIRS = capabilities.pairs()


@cache
def scenario(*features: str) -> sf.Scenario | None:
    """A scenario that has some features, or None where a file cannot have them together."""
    try:
        made = sf.Scenario.from_mapping(json.loads(json.dumps(featured.source(features))))
    except sf.ScenarioError:
        return None
    rows = link_rows(made)
    return made if set(features) <= set(capabilities.features_of(made.system, rows)) else None


def asked(estimator: str, engine: str) -> dict:
    if engine == registry.SIMPLIFIED:
        return {"method": engine}
    return {"method": engine, "estimator": estimator, **({"runs": 2} if engine == registry.MONTE_CARLO else {})}


def refusal(call: Callable[[], object]) -> str:
    """What a call is refused with, or nothing."""
    try:
        call()
    except sf.UsageError as error:
        return str(error)
    return ""


def walk(estimator: str, engine: str, features: tuple[str, ...]) -> str:
    """Whether it was answered or refused, as the table says."""
    made = scenario(*features)
    if made is None:
        return "impossible"
    rows = link_rows(made)
    refused = refusal(lambda: capabilities.require(made.system, rows, estimator, engine))
    if refused:
        assert refusal(lambda: sf.predict(made, **asked(estimator, engine))) == refused
        return "refused"
    assert np.isfinite(sf.predict(made, **asked(estimator, engine)).values()).all()
    return "answered"


@pytest.mark.parametrize(("estimator", "engine"), PAIRS)
def test_each_feature_alone(estimator, engine):
    told = capabilities.matrix()[estimator][engine]
    for name in NAMES:
        found = walk(estimator, engine, (name,))
        assert found != "impossible", name
        if capabilities.features_of(scenario(name).system, link_rows(scenario(name))) == [name]:
            assert (found == "answered") == (told[name] is True), name


@pytest.mark.parametrize(("estimator", "engine"), PAIRS)
def test_some_pairs_of_features(estimator, engine):
    """A third of them, another one with the next estimator."""
    some = list(combinations(NAMES, 2))[PAIRS.index((estimator, engine)) % 3 :: 3]
    found = [walk(estimator, engine, pair) for pair in some]
    assert found.count("answered") > 10
    assert found.count("impossible") < 25


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "engine"), PAIRS)
def test_each_pair_of_features(estimator, engine):
    found = [walk(estimator, engine, pair) for pair in combinations(NAMES, 2)]
    assert found.count("answered") > 40
    assert found.count("impossible") < 60


@pytest.mark.parametrize(("estimator", "engine"), PAIRS)
@pytest.mark.parametrize("features", [("several-states",), ("own-states",)])
def test_a_radio_is_taken_as_its_matrices_are(estimator, engine, features):
    source = featured.source(features)
    del source["network"]["link"]
    source["network"]["radio"] = {
        "transmit_power": 20, "reference_loss": 80, "sensitivity": -85, "fading": "rayleigh", "exponent": 3,
    }  # fmt: skip
    source.setdefault("agent", [{} for _ in range(source["network"]["agents"])])
    for i, table in enumerate(source["agent"]):
        table["position"] = [[4.0 * i, 2.0], [7.0 * i, 3.0]]
    made = sf.Scenario.from_mapping(source)
    assert {"links-per-step", "unequal-links"} <= set(capabilities.features_of(made.system, link_rows(made)))
    short = -85 - 20 + 80 + 30 * np.log10([[[4.0]], [[7.0]]])
    link = np.exp(-(10.0 ** (short / 10))) * np.ones((2, 2))
    other = {key: value for key, value in source["network"].items() if key != "radio"}
    matrices = sf.Scenario.from_mapping({**source, "network": {**other, "link": link.tolist()}})
    how = asked(estimator, engine)
    refused = refusal(lambda: sf.predict(made, **how))
    assert refused == refusal(lambda: sf.predict(matrices, **how))
    if not refused:
        np.testing.assert_allclose(
            sf.predict(made, **how).covariance, sf.predict(matrices, **how).covariance, rtol=1e-13, atol=1e-15
        )


def test_a_refusal_names_the_feature_and_what_takes_it():
    delayed = scenario("delay")
    with pytest.raises(
        sf.UsageError,
        match=r"estimator blender: expected messages without delay, got network\.delay; .*local-fusion-graph.* take delay",
    ):
        sf.predict(delayed, method="general", estimator="blender")
    with pytest.raises(sf.UsageError, match="chain averages the optimum alone; general or monte-carlo takes naive"):
        sf.predict(delayed, method="chain", estimator="naive")


def test_an_estimator_without_a_method_picks_the_exact_engine_and_says_which():
    made = sf.load_scenario(steps=2)
    for estimator, method in (("itns", "general"), ("optimal", "optimal"), ("split-ci", "general")):
        p = sf.predict(made, [0.5], estimator=estimator)
        assert p.method == method
        assert any("is averaged by --method" in note for note in p.notes)
    assert sf.predict(sf.load_scenario(agents=8, steps=3), [0.5], estimator="naive", runs=3).method == "monte-carlo"
    np.testing.assert_array_equal(
        sf.predict(made, [0.5], "chain").covariance, sf.predict(made, [0.5], "optimal").covariance
    )


def test_methods_as_json_and_as_a_table():
    told = strict_json(run("methods", "--format", "json").stdout)
    assert told["schema"] == "stochfuse.methods/1"
    assert {e["name"] for e in told["estimators"]} == set(registry.ESTIMATORS)
    assert [e["name"] for e in told["engines"]] == ["simplified", "general", "chain", "monte-carlo"]
    assert told["matrix"]["local-fusion-graph"]["general"]["delay"] is True
    assert (
        "takes delay" in told["matrix"]["blender"]["general"]["delay"]
        or "take delay" in told["matrix"]["blender"]["general"]["delay"]
    )
    for words in (("methods",), ("methods", "--matrix"), ("methods", "--matrix", "--format", "csv")):
        shown = run(*words, env={"COLUMNS": "80"}).stdout
        assert all(name in shown for name in registry.ESTIMATORS)
        if "csv" not in words:
            assert max(map(len, shown.splitlines())) <= 80
