"""Methods side by side."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.kalman.metrics import metric
from stochfuse.prediction.compare import compare
from stochfuse.report import comparisons
from stochfuse.report.plot import save
from stochfuse.report.predictions import PredictionView


@pytest.fixture(scope="module")
def found():
    return compare(sf.load_scenario(steps=3), [0.25, 0.75], runs=200)


def test_differences_are_signed_and_from_the_reference(found):
    assert found.methods == ("general", "simplified", "naive", "monte-carlo")
    difference = found.differences()
    assert (difference[0] == 0).all()
    assert (difference[1, :, 1:] > 0).all()  # the simplified formulation is cautious here
    assert (difference[2, :, 1:] < 0).all()  # naive fusion claims too much
    values = {p.method: p.values() for p in found.predictions}
    np.testing.assert_array_equal(difference[2], values["naive"] - values["general"])


def view(found, relative=False):
    m = metric("trace", found.reference.scenario.model)
    return comparisons.ComparisonView(found, tuple(PredictionView(p, m) for p in found.predictions), relative)


def test_table(found):
    table = comparisons.compare_table(view(found))
    assert table.columns == ("general", "simplified, Δ", "naive, Δ", "monte-carlo, Δ")
    assert table.rows[1][:4] == ("0.25", "2", "39.379", "42.571 +3.19")
    assert " ±" in table.rows[1][-1]
    relative = comparisons.compare_table(view(found, relative=True))
    assert relative.rows[1][3] == "42.571 +8.1"
    sampled = compare(sf.load_scenario(steps=2), [0.5], ["general", "monte-carlo"], "monte-carlo", runs=50)
    assert " ±" in comparisons.compare_table(view(sampled)).rows[0][2]
    assert any(line.endswith("in per cent of it") for line in relative.title)


def test_csv_and_json_carry_the_same(found):
    lines = comparisons.compare_csv(view(found)).splitlines()
    assert len(lines) == 1 + 4 * 2 * 3
    result = comparisons.compare_json(view(found))
    assert result["reference"] == "general"
    assert result["methods"]["naive"]["nature"] == "exact"
    assert result["methods"]["simplified"]["nature"] == "approximate"
    assert result["methods"]["monte-carlo"]["nature"] == "sampled"
    np.testing.assert_allclose(result["methods"]["simplified"]["difference"], found.differences()[1])


def test_figure(found, tmp_path):
    figure = comparisons.draw(view(found))
    left, right = figure.axes
    assert len(left.lines) >= 4 * 3
    assert right.get_ylabel() == "difference from general"
    save(comparisons.comparison_report(view(found)).draw, tmp_path / "compare.pdf")
    assert (tmp_path / "compare.pdf").stat().st_size > 1000


def test_reference_can_be_chosen():
    found = compare(sf.load_scenario(steps=2), [0.5], ["simplified", "naive"], "naive")
    assert found.methods == ("naive", "simplified")
    assert compare(sf.load_scenario(steps=2), [0.5], ["naive", "simplified"]).methods == ("simplified", "naive")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((["guess"],), "methods: expected one of simplified, general, chain, optimal, naive, monte-carlo, got 'guess'"),
        (([],), "methods: expected at least one of"),
        ((["naive", "naive"],), "methods: expected different ones, got naive, naive"),
        ((["naive"], "general"), r"reference: expected one of the methods compared \(naive\), got 'general'"),
    ],
)
def test_bad_requests(arguments, message):
    with pytest.raises(sf.UsageError, match=message):
        compare(sf.load_scenario(), [0.5], *arguments)
