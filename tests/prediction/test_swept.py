"""Predictions over values of keys against each value by hand, through a mapping that this file edits itself."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.estimators.progress import Progress, listening
from stochfuse.questions.messages import accuracy

BASE = {
    "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.25, 0.5], [0.5, 1]], "R": 4, "states": ["p", "v"],
              "units": ["m", "m/s"]},
    "initial": {"P": [[9, 0], [0, 4]], "error": [3, 0]},
    "network": {"agents": 3, "steps": 3, "architecture": "broadcast", "link": 0.6},
}  # fmt: skip
UNLIKE = {**BASE, "agent": [{}, {"R": 9}, {"sensor": False}]}


def edited(base, *changes):
    found = copy.deepcopy(base)
    for place, key, value in changes:
        table = found
        for part in place:
            table = table[part]
        table[key] = value
    return found


# what is swept, and the same by hand
CASES = {
    "noises": (BASE, "model.R", [2, 4.5, 9], lambda v: [(["model"], "R", v)]),
    "noise, a multiple of the identity": (BASE, "model.Q", [0.1, 1], lambda v: [(["model"], "Q", v)]),
    "start": (BASE, "initial.P", [2, 8], lambda v: [(["initial"], "P", v)]),
    "agents": (BASE, "network.agents", [1, 2, 4], lambda v: [(["network"], "agents", v)]),
    "steps": (BASE, "network.steps", [2, 4], lambda v: [(["network"], "steps", v)]),
    "link": (BASE, "network.link", [0, 0.3, 1], lambda v: [(["network"], "link", v)]),
    "one agent's noise": (UNLIKE, "agent[2].R", [1, 16], lambda v: [(["agent", 1], "R", v)]),
    "an entry": (BASE, "model.F[1][2]", [0.5, 2], lambda v: [(["model", "F", 0], 1, v)]),
}
WAYS = [
    ("simplified", {}),
    ("general", {}),
    ("naive", {}),
    ("optimal", {}),
    ("monte-carlo", {"runs": 12, "seed": 4}),
    ("general", {"estimator": "split-ci"}),
]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("method", "settings"), WAYS, ids=str)
def test_each_value_by_hand(case, method, settings):
    base, key, values, change = CASES[case]
    if method == "monte-carlo" and "error" in base["initial"]:
        base = edited(base, ([], "initial", {"P": base["initial"]["P"]}))
    quantity = "claimed" if method in ("optimal", "monte-carlo") else "actual"
    swept = sf.predict(base, None, method, quantity, over={key: values}, **settings)
    found = swept.values("trace")
    assert found.shape[0] == len(values)
    for row, value in zip(found, values, strict=True):
        alone = sf.predict(edited(base, *change(value)), None, method, quantity, **settings)
        np.testing.assert_allclose(row[: len(alone.steps)], alone.values("trace")[0], rtol=1e-11)
        assert np.isnan(row[len(alone.steps) :]).all()


@pytest.mark.parametrize("agent", ["mean", "worst", "best", 2])
@pytest.mark.parametrize("of", ["trace", "det", "std:v"])
def test_agents_and_metrics(agent, of):
    swept = sf.predict(UNLIKE, [0.2, 0.8], "general", "actual", over={"agent[2].R": [1, 16]})
    rows = [
        sf.predict(edited(UNLIKE, (["agent", 1], "R", v)), [0.2, 0.8], "general", "actual").values(of, agent)
        for v in (1, 16)
    ]
    np.testing.assert_allclose(swept.values(of, agent), np.concatenate(rows), rtol=1e-12)
    assert swept.link.tolist() == [0.2, 0.8, 0.2, 0.8]
    assert swept.point.tolist() == [0, 0, 1, 1]


def test_two_keys_and_standard_errors_and_steady_state():
    swept = sf.predict(BASE, [0.5], "monte-carlo", over={"network.agents": [2, 3], "model.R": [1, 9]}, runs=20)
    values, errors = swept.values(), swept.standard_error()
    steady = sf.predict(BASE, [0.5], over={"network.agents": [2, 3], "model.R": [1, 9]}, steady=True).steady_values()
    for row, (n, r) in enumerate((n, r) for n in (2, 3) for r in (1, 9)):
        mapping = edited(BASE, (["network"], "agents", n), (["model"], "R", r))
        alone = sf.predict(mapping, [0.5], "monte-carlo", runs=20)
        np.testing.assert_array_equal(values[row], alone.values()[0])
        np.testing.assert_array_equal(errors[row], alone.standard_error()[0])
        np.testing.assert_allclose(steady[row], sf.predict(mapping, [0.5], steady=True).steady_values()[0], rtol=1e-12)


def test_all_points_are_predicted_together_where_noises_alone_differ(monkeypatch):
    together = sf.predict(BASE, [0.2, 0.6], "general", over={"model.R": [1, 2, 3]})
    assert len(together.parts) == 1
    one_by_one = sf.predict(BASE, [0.2, 0.6], "general", over={"model.R": [1, 2, 3]}, one_by_one=True)
    assert len(one_by_one.parts) == 3
    np.testing.assert_allclose(together.values(), one_by_one.values(), rtol=1e-12)
    assert together.nature == one_by_one.nature == "exact"
    with pytest.raises(UsageError, match="expected points predicted one by one"):
        together.statistic("std")
    assert (one_by_one.statistic("std")[:, -1] > 0).all()


def test_statistics_of_outcomes_are_those_of_each_value():
    swept = sf.predict(BASE, [0.5], "general", over={"model.R": [1, 9]}, one_by_one=True)
    for row, r in zip(swept.statistic("quantile:0.9"), (1, 9), strict=True):
        alone = sf.predict(edited(BASE, (["model"], "R", r)), [0.5], "general")
        np.testing.assert_allclose(row, alone.statistic("quantile:0.9")[0], rtol=1e-12)


def test_refusals_come_through_with_the_value_that_failed():
    with pytest.raises(UsageError, match=r"^network\.delay=1: method simplified: it is derived without delay"):
        sf.predict(BASE, over={"network.delay": [0, 1]})
    with pytest.raises(UsageError, match=r"^over network\.link: expected no link probabilities beside it$"):
        sf.predict(BASE, [0.5], over={"network.link": [0.1]})
    with pytest.raises(
        UsageError, match=r"^network\.agents=2: agent: expected mean, worst, best or a number from 1 to 2"
    ):
        sf.predict(BASE, over={"network.agents": [3, 2]}).values(agent=3)
    with pytest.raises(NoAnswerError, match=r"^model\.F=2: "):
        sf.predict(
            {"model": {"F": 1, "H": 0, "Q": 1, "R": 1}, "initial": {"P": 1}, "network": {"agents": 2, "steps": 2}},
            [0.5], over={"model.F": [0.5, 2]}, steady=True,
        )  # fmt: skip


def test_compare_and_its_reference():
    found = sf.compare(BASE, methods=["simplified", "general"], over={"model.R": [1, 9]})
    assert found.methods == ("general", "simplified")
    for m, method in enumerate(found.methods):
        for row, r in enumerate((1, 9)):
            alone = sf.predict(edited(BASE, (["model"], "R", r)), None, method)
            np.testing.assert_allclose(found.values()[m, row], alone.values()[0], rtol=1e-12)


def test_estimators_are_averaged_by_one_engine_at_all_values():
    found = sf.compare_estimators(BASE, None, ["naive", "split-ci"], over={"network.agents": [2, 3]})
    assert found.estimators == ("naive", "split-ci")
    for p, name in zip(found.predictions, found.estimators, strict=True):
        for row, n in enumerate((2, 3)):
            alone = sf.predict(edited(BASE, (["network"], "agents", n)), None, "general", "actual", estimator=name)
            np.testing.assert_allclose(p.shown_as("actual").values()[row], alone.values()[0], rtol=1e-12)


@pytest.mark.parametrize("rule", ["local-fusion-graph", "naive"])
def test_message_loads(rule):
    swept = sf.message_load(BASE, [0.3, 0.6], rule, over={"network.agents": [2, 3], "network.steps": [2, 3]})
    row = 0
    for n in (2, 3):
        for k in (2, 3):
            mapping = edited(BASE, (["network"], "agents", n), (["network"], "steps", k))
            alone = sf.message_load(mapping, [0.3, 0.6], rule)
            for name in ("mean", "std", "maximum"):
                np.testing.assert_allclose(
                    getattr(swept, name)()[row : row + 2], getattr(alone, name)(), rtol=1e-12, err_msg=name
                )
            size = len(alone.sizes)
            np.testing.assert_allclose(swept.distribution()[row : row + 2, :size], alone.distribution(), rtol=1e-12)
            assert (swept.distribution()[row : row + 2, size:] == 0).all()
            assert (swept.cdf()[row : row + 2, size:] == 1).all()
            row += 2
    assert row == len(swept.link)
    last = swept.between(2, 3)
    alone = sf.message_load(edited(BASE, (["network"], "steps", 2), (["network"], "agents", 2)), [0.3, 0.6], rule)
    np.testing.assert_allclose(last.mean()[:2], alone.between(2, 2).mean(), rtol=1e-12)


def test_accuracy_beside_the_load():
    swept = accuracy(sf.message_load(BASE, over={"network.agents": [2, 3]}), metric="trace")
    for row, n in enumerate((2, 3)):
        alone = accuracy(sf.message_load(edited(BASE, (["network"], "agents", n))), metric="trace")
        np.testing.assert_allclose(swept.values[row], alone.values[0], rtol=1e-12)


def test_long_sweeps_say_where_they_are():
    class Heard(Progress):
        said: list[str]

        def advance(self, what, done, total):
            self.said.append(what)

    heard = Heard()
    heard.said = []
    with listening(heard):
        sf.predict(BASE, None, "general", over={"network.agents": [2, 3]})
    assert "network.agents=2 (1 of 2)" in heard.said
    assert any(what.startswith("network.agents=3 (2 of 2): ") for what in heard.said)


def test_frames_and_arrays_name_the_key():
    pytest.importorskip("xarray")
    swept = sf.predict(BASE, over={"network.delay": [0, 1, 2]}, method="general")
    array = swept.to_xarray()
    assert array.dims == ("network.delay", "step", "agent", "row", "column")
    assert array["network.delay"].attrs["units"] == "steps"
    np.testing.assert_allclose(
        np.trace(array.sel({"network.delay": 1}).mean("agent").values, axis1=-2, axis2=-1), swept.values()[1]
    )
    assert swept.to_dataframe()["network.delay"].unique().tolist() == [0, 1, 2]
    two = sf.predict(BASE, [0.2, 0.5], over={"network.agents": [2, 3], "network.steps": [2, 3]}).to_xarray()
    assert two.dims == ("network.agents", "network.steps", "link", "step", "agent", "row", "column")
    assert two.sel({"network.agents": 2, "network.steps": 2, "step": 3}).isnull().all()
    assert two.sel({"network.agents": 2, "agent": 3}).isnull().all()
    compared = sf.compare(BASE, methods=["simplified", "general"], over={"model.R": [1, 9]}).to_xarray()
    assert compared.dims[:2] == ("method", "model.R")
    load = sf.message_load(BASE, over={"network.agents": [2, 3]})
    assert load.to_dataframe()["network.agents"].tolist() == [2, 3]


def test_tables_and_the_short_name():
    swept = sf.predict(BASE, over={"network.delay": [0, 1]}, method="general")
    assert "network.delay [steps]" in swept.table()
    assert repr(swept).startswith("Swept(over=")
    assert "network.delay [steps]" in swept._repr_html_()
    assert swept.over.keys[0].values == (0, 1)
