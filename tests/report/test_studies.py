"""Studies as tables, CSV, JSON and figures, and what pays in them: against brute force, and what figures are given."""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.report import studies
from stochfuse.report.plot import save
from stochfuse.report.studies import shortened, spoken
from stochfuse.report.study_figures import draw, draw_pareto, edges, levels_of, pareto_report, summary_report
from stochfuse.report.study_slices import thinned
from stochfuse.report.table import to_text
from stochfuse.studies.pareto import Front, front, pareto, rounded
from stochfuse.studies.plan import Axis

LABELS = {
    "claimed.trace": "claimed trace [m²]",
    "claimed.trace.standard_error": "standard error of claimed trace",
    "actual.trace": "actual trace [m²]",
    "consistency.trace": "consistency trace",
    "messages.nodes": "nodes received per agent and step",
}


@dataclass
class FakeResults:
    """Results in memory, of the interface of stochfuse.study.results.Results."""

    plan: SimpleNamespace
    data: dict  # column -> (points, steps), key -> (points,)
    lasts: np.ndarray  # last step of each point; 0 where it failed
    block: int = 7
    path: Path = Path("folder/results.parquet")
    first_errors: tuple = ()
    failed: int = field(init=False)
    rows: int = field(init=False)

    def __post_init__(self):
        self.failed, self.rows = int((self.lasts == 0).sum()), int(self.lasts.sum() + (self.lasts == 0).sum())

    def _there(self):
        for start in range(0, len(self.lasts), self.block):
            some = np.arange(start, min(start + self.block, len(self.lasts)))
            yield some[self.lasts[some] > 0]

    def blocks(self, columns: Sequence[str], step: int | None = None) -> Iterator[dict]:
        for some in self._there():
            if step is not None:
                some = some[self.lasts[some] >= step]
            at = self.lasts[some] if step is None else np.full(len(some), step)
            whole = {"point": some, "step": at}
            yield {
                c: whole[c]
                if c in whole
                else self.data[c][some]
                if self.data[c].ndim == 1
                else self.data[c][some, at - 1]
                for c in columns
            }

    def mean_over_steps(self, column: str) -> Iterator[np.ndarray]:
        for some in self._there():
            yield np.array([self.data[column][i, : self.lasts[i]].mean() for i in some])


def study(
    axes, kind="grid", columns=("claimed.trace", "messages.nodes"), failed=(), steps=3, size=None, accuracy=None, seed=1,
    load=None,
):  # fmt: skip
    """A study with made-up values: rising with R and Q, falling with µ and agents."""
    axes = tuple(axes)
    rng = np.random.default_rng(seed)
    if kind == "grid":
        points = list(itertools.product(*(axis.values for axis in axes)))
        keys = {a.name: np.array([p[i] for p in points], dtype=a.column.dtype) for i, a in enumerate(axes)}
    elif kind == "list":
        keys = {axis.name: axis.column for axis in axes}
    else:
        keys = {a.name: a.shown(a.drawn(rng.permutation((np.arange(size) + rng.random(size)) / size))) for a in axes}
    n = len(next(iter(keys.values())))
    number = {name: values for name, values in keys.items() if values.dtype != object}
    µ, agents = number.get("network.link", np.full(n, 0.5)), number.get("network.agents", np.full(n, 3))
    method = keys.get("method", np.full(n, "simplified", dtype=object))
    values = np.sqrt(number.get("model.R", 1.0)) * (1 + number.get("model.Q", 0.0)) / (1 + µ * (agents - 1))
    values = values * np.where(method == "general", 1.1, 1.0) * np.ones(n) if accuracy is None else accuracy
    k = np.arange(1, steps + 1)
    sent = µ * (agents - 1) * np.ones(n) if load is None else load
    data = {
        **keys,
        "method": method,
        "estimator": keys.get("estimator", np.full(n, "local-fusion-graph", dtype=object)),
        "nature": np.array(
            [{"simplified": "approximate", "monte-carlo": "sampled"}.get(m, "exact") for m in method], dtype=object
        ),
        "claimed.trace": values[:, None] * (1 + 1 / k),
        "actual.trace": values[:, None] * (1.2 + 1 / k),
        "consistency.trace": np.ones((n, 1)) * (1 + k / 10),
        "messages.nodes": sent[:, None] * (1 + k / steps),
        "claimed.trace.standard_error": np.where(method == "monte-carlo", 0.01, np.nan)[:, None] * np.ones(steps),
    }
    quantities = tuple(dict.fromkeys(c.partition(".")[0] for c in columns))
    plan = SimpleNamespace(
        name="study.toml", kind=kind, size=n, axes=axes, quantities=quantities, metrics=("trace",), agent="mean",
        columns=tuple(columns), labels={c: LABELS[c] for c in columns}, scenario_name="cv-2d",
    )  # fmt: skip
    lasts = np.full(n, steps)
    lasts[list(failed)] = 0
    errors = tuple((i, "initial.P: expected a positive definite matrix, got an indefinite one") for i in failed)
    return FakeResults(plan, data, lasts, first_errors=errors)


LINK = Axis("network.link", tuple(i / 10 for i in range(11)))
R = Axis("model.R", (1.0, 2.0, 5.0, 10.0, 50.0, 1000.0), scale="log")
AGENTS = Axis("network.agents", (2, 3, 4, 6))
METHOD = Axis("method", ("simplified", "general"))
ARCHITECTURE = Axis("network.architecture", ("ad-hoc", "broadcast", "cyclic"))
MATRICES = Axis("model.Q", ([[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.5], [0.5, 1.0]], [[1.0, 0.0], [0.0, 2.0]]))
LINKS, NOISES = Axis("network.link", None, 0.0, 1.0), Axis("model.R", None, 0.1, 1000.0, "log")


# --- the front ---------------------------------------------------------------------------------------------------------


def dominated(costs: np.ndarray, i: int) -> bool:
    return any((c <= costs[i]).all() and (c < costs[i]).any() for c in costs)


few = st.integers(0, 6).map(float)
any_cost = st.floats(-1e6, 1e6)
pairs = st.one_of(st.lists(st.tuples(few, few), max_size=40), st.lists(st.tuples(any_cost, any_cost), max_size=40))


@given(pairs)
def test_front_is_what_nobody_dominates(costs):
    a, b = np.array([p[0] for p in costs]), np.array([p[1] for p in costs])
    found = front(a, b)
    both = np.stack([a, b], axis=1)
    assert sorted(found.tolist()) == [i for i in range(len(costs)) if not dominated(both, i)]
    assert (np.diff(a[found]) >= 0).all()
    assert (np.diff(b[found]) <= 0).all()


def test_front_keeps_equal_points_in_their_order():
    assert front(np.array([2.0, 1, 1, 3, 2]), np.array([1.0, 2, 2, 1, 1])).tolist() == [1, 2, 0, 4]


def test_front_of_a_hundred_thousand_points_is_found_at_once():
    a, b = np.random.default_rng(1).random((2, 100_000))
    found = front(a, b)
    on = np.zeros(len(a), dtype=bool)
    on[found] = True
    # each point off the front is beaten by the front's last point of no more a
    best = b[found][np.searchsorted(a[found], a, "right") - 1]
    assert (best[~on] <= b[~on]).all()
    assert len(found) < 100


@given(pairs, st.integers(1, 9))
def test_front_of_fronts_is_the_front_of_the_whole(costs, size):
    a, b = np.array([p[0] for p in costs]), np.array([p[1] for p in costs])
    found = Front()
    for i in range(0, len(costs), size):
        here = np.arange(i, min(i + size, len(costs)))
        found = found.add(a[here], b[here], {"point": here})
    assert found.seen == len(costs)
    if costs:
        assert found.columns["point"].tolist() == front(rounded(a), rounded(b)).tolist()
        assert (found.a == a[found.columns["point"]]).all()


def test_rounding_does_not_decide_who_is_better():
    a, b = np.array([0.3, 0.1 + 0.2]), np.array([2.0, 1.0])
    assert front(a, b).tolist() == [0, 1]
    assert Front().add(a, b, {"point": np.arange(2)}).columns["point"].tolist() == [1]
    assert rounded(np.array([0.0, 1.0, -3.5e-200])).tolist() == [0.0, 1.0, rounded(np.array([-3.5e-200]))[0]]
    assert rounded(np.array([np.pi]))[0] == pytest.approx(np.pi, rel=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ([1.0], [1.0, 2.0], r"front: expected two lists of costs of one length, got shapes \(1,\) and \(2,\)"),
        ([np.nan], [1.0], "front: expected finite costs, got NaN or infinity"),
    ],
)
def test_front_refuses(a, b, message):
    with pytest.raises(ValueError, match=message):
        front(np.array(a), np.array(b))


ALTERNATING = (np.linspace(2, 1, 11)[:, None] + 0.05 * (np.add.outer(np.arange(11), np.arange(2)) % 2)).ravel()
"""Accuracy of 11 links and two methods, of which the first and the second are better by turns."""


def brute_force(results, column, step=None):
    """Points that no other dominates, load averaged over all steps."""
    there = np.flatnonzero(results.lasts > 0)
    at = results.lasts[there] if step is None else np.full(len(there), step)
    accuracy = results.data[column][there, at - 1]
    load = np.array([results.data["messages.nodes"][i, : results.lasts[i]].mean() for i in there])
    both = rounded(np.stack([load, accuracy], axis=1))
    return {int(there[i]) for i in range(len(there)) if not dominated(both, i)}


@pytest.mark.parametrize("block", [1, 7, 1000])
@pytest.mark.parametrize("step", [None, 2])
def test_pareto_of_a_study_is_the_brute_force_one(block, step):
    results = study([LINK, AGENTS, METHOD], failed=(0, 11, 30), accuracy=np.random.default_rng(5).random(88))
    results.block = block
    found = pareto(results, step=step)
    assert set(found.points.tolist()) == brute_force(results, "claimed.trace", step)
    assert found.compared == 85
    assert (found.steps == (step or 3)).all()
    for i, point in enumerate(found.points):
        assert found.accuracy[i] == results.data["claimed.trace"][point, (step or 3) - 1]
        assert found.load[i] == results.data["messages.nodes"][point].mean()
        assert all(found.keys[key][i] == results.data[key][point] for key in found.keys)
        assert (found.method[i], found.nature[i]) == (results.data["method"][point], results.data["nature"][point])


def test_pareto_takes_the_column_asked_for():
    results = study([LINK, R], columns=("claimed.trace", "actual.trace", "messages.nodes"))
    assert pareto(results).column == "claimed.trace"
    assert set(pareto(results, "actual.trace").points.tolist()) == brute_force(results, "actual.trace")


def test_pareto_says_what_must_be_minded():
    two = study([LINK, METHOD], accuracy=ALTERNATING)
    assert any(
        "unlike things: its points are of methods general, simplified (approximate, exact)" in n
        for n in pareto(two).notes
    )
    sampled = study([Axis("method", ("monte-carlo",)), LINK])
    assert pareto(sampled).notes == ("sampled values scatter: the luckier of two equal points is on the front",)
    naive = pareto(study([Axis("estimator", ("naive", "local-fusion-graph")), LINK])).notes
    assert len(naive) == 1
    assert naive[0].startswith("claimed is what an estimator believes of itself, which is not what naive achieves")
    actual = study([Axis("estimator", ("naive",)), LINK], columns=("actual.trace", "messages.nodes"))
    assert pareto(actual).notes == ()
    assert pareto(study([LINK])).notes == ()


@pytest.mark.parametrize(
    ("results", "options", "message"),
    [
        (
            study([LINK], columns=("claimed.trace",)),
            {},
            "report.quantity: expected messages among them for --pareto, got claimed",
        ),
        (
            study([LINK], columns=("consistency.trace", "messages.nodes")),
            {},
            "report.quantity: expected claimed, actual, optimal or rms for --pareto, got consistency, messages",
        ),
        (study([LINK]), {"column": "actual.trace"}, "column: expected claimed.trace, got actual.trace"),
        (study([LINK]), {"column": "messages.nodes"}, "column: expected claimed.trace, got messages.nodes"),
        (study([LINK]), {"step": 9}, "step: expected a step that every point has, got 9"),
    ],
)
def test_pareto_refuses(results, options, message):
    with pytest.raises(UsageError, match=f"^{message}$"):
        pareto(results, **options)


def test_pareto_refuses_a_step_that_some_points_lack():
    results = study([LINK])
    results.lasts[3] = 2
    with pytest.raises(UsageError, match="step: expected a step that every point has, got 3"):
        pareto(results, step=3)


def test_nothing_to_compare_is_no_answer():
    with pytest.raises(NoAnswerError, match="no point of the study has a value: 11 failed"):
        pareto(study([LINK], failed=range(11)))


# --- tables, CSV, JSON -------------------------------------------------------------------------------------------------


def records(text: str) -> list[dict]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_summary_names_the_extremes_and_where_they_are(block):
    results = study([LINK, R, METHOD], failed=(4, 9), accuracy=np.random.default_rng(2).random(132))
    results.block = block
    last = np.where(results.lasts > 0, results.data["claimed.trace"][:, 2], np.nan)
    found = {(r["column"], r["extreme"]): r for r in records(studies.summary_csv(results))}
    for extreme, point in (("least", np.nanargmin(last)), ("greatest", np.nanargmax(last))):
        r = found["claimed.trace", extreme]
        assert (int(r["point"]), float(r["value"]), int(r["step"])) == (point, last[point], 3)
        assert float(r["model.R"]) == results.data["model.R"][point]
        assert r["method"] == results.data["method"][point]
        assert r["nature"] == results.data["nature"][point]
        assert (r["points"], r["rows"], r["failed"]) == ("132", "392", "2")
    assert found["messages.nodes", "least"]["point"] == "0"  # the first of equal ones


def test_summary_table_says_what_the_study_is():
    results = study([LINK, MATRICES], failed=(4, 9))
    table = studies.summary_table(results)
    title = "\n".join(table.title)
    for said in (
        "Study study.toml: grid of 33 points over network.link (11), model.Q (3)",
        "Scenario cv-2d; covariance averaged over the agents",
        "results.parquet: 95 rows, 2 points failed",
        "failed: points 4, 9: initial.P: expected a positive definite matrix",
        "approximate: 31 points",
        "claimed.trace: expected claimed posterior trace [m²]",
    ):
        assert said in title
    assert table.headings == ("column", "", "value", "point", "k", "network.link", "model.Q")
    assert table.rows[0][-1] == "[[1,0],[0,1]]"
    assert max(map(len, to_text(table, 80).splitlines())) <= 80


def test_summary_json_is_one_object_without_nan():
    columns = ("claimed.trace", "claimed.trace.standard_error", "messages.nodes")
    results = study([LINK, MATRICES], failed=(4,), columns=columns)
    text = json.dumps(studies.summary_json(results), allow_nan=False)
    found = json.loads(text)
    assert (found["schema"], found["points"], found["rows"], found["failed"]) == (
        "stochfuse.study-summary/1",
        33,
        97,
        1,
    )
    assert found["axes"][1]["values"][1] == [[1.0, 0.5], [0.5, 1.0]]
    assert found["columns"]["claimed.trace"]["least"]["keys"]["model.Q"] == [[1.0, 0.0], [0.0, 1.0]]
    assert set(found["columns"]["claimed.trace.standard_error"]) == {"label"}  # nothing was sampled
    assert found["first_errors"] == [{"point": 4, "reason": results.first_errors[0][1]}]
    assert found["natures"] == {"approximate": 32}


def test_summary_of_a_study_that_failed_altogether():
    results = study([LINK], failed=range(11))
    assert studies.summary_table(results).rows == ()
    assert to_text(studies.summary_table(results), 80)
    assert json.dumps(studies.summary_json(results), allow_nan=False)


def test_pareto_table_csv_and_json_hold_the_front():
    method = Axis("method", ("monte-carlo", "general"))
    columns = ("claimed.trace", "claimed.trace.standard_error", "messages.nodes")
    results = study([LINK, method], columns=columns, accuracy=ALTERNATING)
    found = pareto(results)
    table = studies.pareto_table(found, results)
    assert table.headings == ("point", "load", "accuracy", "network.link", "method", "nature")
    assert [row[0] for row in table.rows] == [str(p) for p in found.points]
    assert all(("±0.01" in row[2]) == (row[4] == "monte-carlo") for row in table.rows)
    assert "± one standard error" in table.title[-1]
    lines = records(studies.pareto_csv(found, results))
    assert [float(r["load"]) for r in lines] == found.load.tolist()
    assert [float(r["accuracy"]) for r in lines] == found.accuracy.tolist()
    assert [r["standard_error"] for r in lines] == ["0.01" if r["method"] == "monte-carlo" else "" for r in lines]
    whole = json.loads(json.dumps(studies.pareto_json(found, results), allow_nan=False))
    assert (whole["schema"], whole["column"], whole["compared"]) == ("stochfuse.pareto/1", "claimed.trace", 22)
    assert [p["point"] for p in whole["front"]] == found.points.tolist()
    assert [p["keys"]["network.link"] for p in whole["front"]] == found.keys["network.link"].tolist()
    assert all(("standard_error" in p) == (p["nature"] == "sampled") for p in whole["front"])
    assert whole["meta"]["notes"] == list(found.notes)


def test_a_front_of_one_point_is_said_to_be_one():
    results = study([R])
    assert "than this one" in studies.pareto_table(pareto(results), results).title[0]


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("claimed.trace", "expected claimed posterior trace [m²]"),
        ("consistency.trace", "posterior consistency, actual / claimed (> 1: overconfident): trace"),
        ("claimed.trace.standard_error", "standard error of claimed trace"),
        ("messages.nodes", "nodes received per agent and step"),
    ],
)
def test_columns_are_called_what_they_are(column, words):
    assert spoken(study([LINK], columns=(column,)).plan, column) == words


def test_long_values_are_cut_with_their_place():
    long = [json.dumps([[i, 0.25, 0.125], [3.5, 4.5, 5.5]]) for i in (1.0, 1.5)]
    assert [shortened(v, long) for v in long] == ["[[1,0.25,0.125],…(1)", "[[1.5,0.25,0.125…(2)"]
    assert shortened(0.1 + 0.2) == "0.3"


# --- figures -----------------------------------------------------------------------------------------------------------


def mesh_of(figure):
    return next(c for c in figure.axes[0].collections if type(c).__name__ == "QuadMesh")


def words_in(figure) -> str:
    labels = [text for a in figure.axes for text in (a.get_title(), a.get_ylabel())]
    return " ".join("\n".join([figure.get_suptitle(), *labels]).split("\n"))


@pytest.mark.parametrize(
    ("values", "log", "expected"),
    [
        ([0, 1, 3], False, [-0.5, 0.5, 2, 4]),
        ([1, 10, 1000], True, [10**-0.5, 10**0.5, 100, 10000]),
        ([5], False, [4.5, 5.5]),
        ([1], True, [np.exp(-0.5), np.exp(0.5)]),
    ],
)
def test_cells_meet_half_way(values, log, expected):
    assert edges(values, log) == pytest.approx(expected)


def test_heat_map_has_each_value_in_its_cell():
    results = study([LINK, R], failed=(3, 17, 18))
    figure = draw(results, step=2)
    mesh, axes = mesh_of(figure), figure.axes[0]
    values = mesh.get_array()
    expected = results.data["claimed.trace"][:, 1].reshape(11, 6).T  # point = 6 link + R
    gone = (results.lasts == 0).reshape(11, 6).T
    assert (np.ma.getmaskarray(values) == gone).all()
    assert (values[~gone] == expected[~gone]).all()
    x, y = mesh.get_coordinates()[0, :, 0], mesh.get_coordinates()[:, 0, 1]
    assert np.allclose(x, np.arange(-0.05, 1.06, 0.1), rtol=0, atol=1e-12)
    assert np.allclose(y[1:-1], np.sqrt([2, 10, 50, 500, 50000]), rtol=1e-12)
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    assert axes.get_xlim() == pytest.approx((-0.05, 1.05))
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["no value: 3 points failed"]
    hatched = next(c for c in axes.collections if c.get_hatch())
    assert len(hatched.get_paths()) == 3
    assert {t.get_text() for t in axes.texts} == {f"{v:#.3g}".rstrip(".") for v in expected[~gone]}
    assert axes.get_xlabel() == "link probability µ (network.link)"
    for said in (
        "expected claimed posterior trace [m²]",
        "Study study.toml, scenario cv-2d",
        "after step 2; approximate: simplified",
    ):
        assert said in words_in(figure)


def test_heat_map_over_words_labels_its_cells():
    figure = draw(study([ARCHITECTURE, METHOD]), ("method", "network.architecture"))
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["simplified", "general"]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["ad-hoc", "broadcast", "cyclic"]
    assert mesh_of(figure).get_array().shape == (3, 2)
    assert axes.get_ylim() == (2.5, -0.5)
    assert "approximate: simplified; exact: general" in words_in(figure)


@pytest.mark.parametrize("given", [10, 10.0, "10", "10.0", "1e1"])
def test_where_fixes_a_key_as_number_or_text(given):
    results = study([LINK, AGENTS, R])
    figure = draw(results, ("network.link", "network.agents"), where={"model.R": given})
    expected = results.data["claimed.trace"][:, 2].reshape(11, 4, 6)[:, :, 3].T
    assert (mesh_of(figure).get_array() == expected).all()
    assert "model.R = 10;" in words_in(figure)
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["2", "3", "4", "6"]


@pytest.mark.parametrize(("wide", "norm"), [(1000.0, "LogNorm"), (2.0, "Normalize")])
def test_colours_are_on_a_log_scale_where_values_are_far_apart(wide, norm):
    mesh = mesh_of(draw(study([LINK, AGENTS], accuracy=np.geomspace(1, wide, 44))))
    assert type(mesh.norm).__name__ == norm
    assert mesh.get_clim() == pytest.approx((4 / 3, wide * 4 / 3))
    assert mesh.get_cmap().name == "cividis"


def test_colours_rise_in_lightness_alone():
    colours = matplotlib.colormaps["cividis"](np.linspace(0, 1, 50))[:, :3]
    assert (np.diff(colours @ (0.299, 0.587, 0.114)) > 0).all()


def test_contours_go_through_the_values_with_round_levels():
    results = study([LINK, R], failed=(17,))
    figure = draw(results, kind="contour")
    axes = figure.axes[0]
    filled, lines = (c for c in axes.collections if type(c).__name__ == "QuadContourSet")
    assert filled.levels.tolist() == lines.levels.tolist() == [0.2, 0.5, 1, 2, 5, 10, 20, 50]
    shown = [t for t in axes.texts if t.get_visible()]
    assert {t.get_text() for t in shown} <= {"0.5", "1", "2", "5", "10", "20"}
    assert len(shown) >= 3
    # 4/3 √R / (1 + 2 µ) is the value: along a line it is the level, up to interpolation between the points
    for level, path in zip(lines.levels, lines.get_paths(), strict=True):
        µ, noise = path.vertices.T
        where = np.isin(noise, R.values)
        assert 4 / 3 * np.sqrt(noise[where]) / (1 + 2 * µ[where]) == pytest.approx(level, rel=0.02)
    cross = axes.lines[0]
    assert (cross.get_xdata().tolist(), cross.get_ydata().tolist()) == ([0.2], [1000.0])
    assert "no value: 1 point failed" in [t.get_text() for t in axes.get_legend().get_texts()]


@given(st.floats(1e-6, 1e6), st.floats(1e-9, 1e8))
def test_levels_enclose_the_values(low, ratio):
    values = np.array([low, low * (1 + ratio)])
    levels = levels_of(values)
    assert levels[0] <= values[0] * (1 + 1e-9)
    assert levels[-1] >= values[1] * (1 - 1e-9)
    assert (np.diff(levels) > 0).all()
    assert 2 <= len(levels) <= 20


def test_a_line_for_each_method():
    results = study([LINK, METHOD], failed=(3,))
    axes = draw(results).axes[0]
    expected = results.data["claimed.trace"][:, 2].reshape(11, 2)
    simplified, general, gone = axes.lines
    assert simplified.get_ydata().tolist() == expected[:, 0].tolist()
    assert np.isnan(general.get_ydata()[1])
    assert np.delete(general.get_ydata(), 1).tolist() == np.delete(expected[:, 1], 1).tolist()
    assert gone.get_xdata().tolist() == [0.1]
    assert [t.get_text() for t in axes.get_legend().get_texts()] == [
        "simplified",
        "general",
        "no value: 1 point failed",
    ]
    assert simplified.get_linestyle() != general.get_linestyle()
    assert simplified.get_marker() != general.get_marker()


def test_lines_of_many_values_are_some_of_them():
    axes = draw(study([LINK, Axis("network.agents", tuple(range(2, 30)))]), ("network.link",)).axes[0]
    assert len(axes.lines) == 8
    assert axes.get_legend().get_title().get_text() == "network.agents (8 of 28)"
    assert [t.get_text() for t in axes.get_legend().get_texts()][::7] == ["2", "29"]


def test_words_along_a_line_plot_are_not_joined():
    axes = draw(study([ARCHITECTURE, METHOD]), ("network.architecture",)).axes[0]
    assert all(line.get_linestyle() == "None" for line in axes.lines)
    assert [t.get_text() for t in axes.get_xticklabels()] == ["ad-hoc", "broadcast", "cyclic"]


def test_hypercube_of_two_ranges_has_contours_under_its_points():
    results = study([LINKS, NOISES], "latin-hypercube", size=200, failed=(3,))
    figure = draw(results)
    axes = figure.axes[0]
    names = [type(c).__name__ for c in axes.collections]
    assert names == ["TriContourSet", "TriContourSet", "PathCollection"]
    points = axes.collections[2]
    there = results.lasts > 0
    assert (
        points.get_offsets() == np.stack([results.data["network.link"], results.data["model.R"]], axis=1)[there]
    ).all()
    assert (points.get_array() == results.data["claimed.trace"][there, 2]).all()
    assert axes.get_yscale() == "log"
    assert "1 failed point not drawn" in words_in(figure)


def test_hypercube_of_more_keys_is_scattered_with_markers():
    figure = draw(study([LINKS, NOISES, METHOD], "latin-hypercube", size=60), ("model.R", "network.link"))
    axes = figure.axes[0]
    assert [type(c).__name__ for c in axes.collections] == ["PathCollection"] * 2
    assert sum(len(c.get_offsets()) for c in axes.collections) == 60
    assert {t.get_text() for t in axes.get_legend().get_texts()} == {"simplified", "general"}
    assert axes.collections[0].get_paths()[0].vertices.shape != axes.collections[1].get_paths()[0].vertices.shape
    figure = draw(study([LINKS, NOISES, METHOD], "latin-hypercube", size=60), ("network.link",))
    assert "also varying: model.R" in words_in(figure)


def test_points_on_one_line_have_no_contours():
    same = study([LINKS, NOISES], "latin-hypercube", size=20)
    same.data["model.R"] = np.exp(same.data["network.link"])
    assert [type(c).__name__ for c in draw(same).axes[0].collections] == ["PathCollection"]


def test_many_points_are_thinned_evenly():
    results = study([LINKS, NOISES, METHOD], "latin-hypercube", size=40_000)
    results.block = 10_000
    figure = draw(results, ("network.link", "model.R"))
    drawn = np.concatenate([c.get_offsets()[:, 0] for c in figure.axes[0].collections])
    assert 4_800 < len(drawn) < 5_200
    assert np.histogram(drawn, 10, (0, 1))[0] == pytest.approx(500, rel=0.2)
    assert "about one of 8 points drawn" in words_in(figure)
    assert all(c.get_rasterized() for c in figure.axes[0].collections)


def test_a_list_is_scattered():
    results = study(
        [Axis("network.link", (0.1, 0.5, 0.5, 0.9)), Axis("method", ("general", "general", "simplified", "general"))],
        "list",
    )
    axes = draw(results).axes[0]
    assert axes.collections[0].get_offsets().tolist() == [[0.1, 0], [0.5, 0], [0.5, 1], [0.9, 0]]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["general", "simplified"]


@pytest.mark.parametrize(
    ("axes", "options", "message"),
    [
        ([LINK, AGENTS, R], {}, r"model.R takes 6 values \(1, 2, 5, 10, 50, 1000\): fix it with --where model.R=1.0"),
        (
            [LINK, AGENTS, R, METHOD],
            {"keys": ("model.R",)},
            r"network.link takes 11 values \(0, 0.1, 0.2, 0.3, 0.4, … 1\): fix it with --where network.link=0.0; "
            r"network.agents takes 4 values \(2, 3, 4, 6\): fix it with --where network.agents=2; "
            r"method takes 2 values \(simplified, general\): fix it with --where method=simplified",
        ),
        ([LINK, AGENTS], {"keys": ("model.R", "network.link")}, r"--over: expected keys that vary \(network.link, network.agents\), got model.R"),
        ([LINK, AGENTS], {"keys": ("network.link",) * 2}, "--over: expected one or two different keys, got network.link, network.link"),
        ([LINK, AGENTS], {"keys": ()}, "--over: expected one or two different keys, got none"),
        (
            [LINK, AGENTS],
            {"keys": ("network.link", "network.agents"), "where": {"network.agents": 2}},
            "--over: expected keys that --where does not fix, got network.agents",
        ),
        ([LINK], {"where": {"network.link": 0.5}}, "--over: expected a key that varies, got none: all are fixed"),
        ([LINK, AGENTS], {"where": {"model.R": 1}}, r"--where: expected a key that varies \(network.link, network.agents\), got model.R"),
        ([LINK, AGENTS], {"where": {"network.agents": "5"}}, "--where network.agents: expected 2 or 3 or 4 or 6, got 5"),
        ([LINK, METHOD], {"where": {"method": "naive"}}, "--where method: expected simplified or general, got naive"),
        ([LINK, AGENTS], {"column": "actual.trace"}, "column: expected claimed.trace or messages.nodes, got actual.trace"),
        ([LINK, AGENTS], {"kind": "pie"}, "kind: expected heat or contour, got pie"),
        ([LINK], {"kind": "contour"}, r"kind: expected heat over one key \(network.link\), got contour"),
        (
            [ARCHITECTURE, AGENTS],
            {"kind": "contour", "keys": ("network.agents", "network.architecture")},
            "kind: expected heat over network.architecture, whose values are words, got contour",
        ),
        (
            [AGENTS, Axis("model.F", (1.0, 2.0))],
            {"kind": "contour", "column": "messages.nodes", "where": {}, "flat": True},
            "kind: expected heat where values do not differ along both keys, got contour",
        ),
        ([LINK, AGENTS], {"step": 4}, "step: expected a step that a point has, got 4"),
    ],
)  # fmt: skip
def test_figures_refuse(axes, options, message):
    flat = options.pop("flat", False)
    size = int(np.prod([len(a.values) for a in axes]))
    results = study(axes, load=np.ones(size) if flat else None)
    with pytest.raises(UsageError, match=f"^{message}$"):
        draw(results, **options)


def test_a_range_cannot_be_fixed():
    with pytest.raises(
        UsageError, match=r"--where: expected a key with listed values, got model.R, which varies contin"
    ):
        draw(study([LINKS, NOISES], "latin-hypercube", size=9), where={"model.R": 1})


def test_nothing_to_draw_is_no_answer():
    with pytest.raises(NoAnswerError, match="no point has a value to draw: 11 failed"):
        draw(study([LINK], failed=range(11)))


def test_one_value_everywhere_can_be_drawn():
    figure = draw(study([LINK, AGENTS], accuracy=np.ones(44)))
    assert (mesh_of(figure).get_array() == 4 / 3).all()
    zero = draw(study([LINK, AGENTS], accuracy=np.zeros(44)))
    zero.savefig(io.BytesIO())


def test_pareto_figure_has_the_front_as_steps_over_all_points():
    results = study([LINK, AGENTS, METHOD], failed=(4,), accuracy=np.random.default_rng(8).random(88))
    found = pareto(results)
    figure = draw_pareto(found, results)
    axes = figure.axes[0]
    line = axes.lines[0]
    assert line.get_drawstyle() == "steps-post"
    assert (line.get_xdata() == found.load).all()
    assert (line.get_ydata() == found.accuracy).all()
    grey, *marked = (c for c in axes.collections if type(c).__name__ == "PathCollection")
    fine = results.lasts > 0
    assert (grey.get_offsets()[:, 0] == results.data["messages.nodes"][fine].mean(axis=1)).all()
    assert (grey.get_offsets()[:, 1] == results.data["claimed.trace"][fine, 2]).all()
    names = [t.get_text() for t in axes.get_legend().get_texts()]
    assert names[:2] == ["87 points", "front, with numbers of points"]
    assert set(names[2:]) == {f"front, {m}" for m in set(found.method.tolist())}
    assert sum(len(c.get_offsets()) for c in marked) == len(found.points)
    assert {t.get_text() for t in axes.texts} <= {str(p) for p in found.points}
    assert "1 failed point not drawn" in words_in(figure)
    assert axes.get_xlabel() == "nodes received per agent and step, mean over all steps"
    assert axes.get_ylabel() == "expected claimed posterior trace [m²]"


def test_pareto_figure_takes_log_axes_where_numbers_are_far_apart_and_thins_points():
    results = study([LINKS, NOISES, ARCHITECTURE], "latin-hypercube", size=20_000)
    results.block = 5_000
    axes = draw_pareto(pareto(results), results).axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert 4_700 < len(axes.collections[0].get_offsets()) < 5_300
    assert axes.get_legend().get_texts()[0].get_text() == "about one of 4 of 20,000 points"


def test_pareto_figure_shows_confidence_of_sampled_points():
    columns = ("claimed.trace", "claimed.trace.standard_error", "messages.nodes")
    results = study([LINK, Axis("method", ("monte-carlo",))], columns=columns)
    found = pareto(results)
    figure = draw_pareto(found, results)
    bars = next(c for c in figure.axes[0].collections if type(c).__name__ == "LineCollection")
    height = np.array([np.ptp(segment[:, 1]) for segment in bars.get_segments()])
    assert height == pytest.approx(2 * 1.96 * 0.01, rel=1e-3)
    assert "bars: 95 % confidence" in words_in(figure)


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_figures_are_written_whole(tmp_path, suffix):
    results = study([LINK, AGENTS], failed=(3,))
    first, second = tmp_path / f"over.{suffix}", tmp_path / f"front.{suffix}"
    save(summary_report(results, 5).draw, first)
    save(pareto_report(pareto(results), results, 5).draw, second)
    start = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    assert all(file.read_bytes().startswith(start) for file in (first, second))
    assert {file.name for file in tmp_path.iterdir()} == {first.name, second.name}


@pytest.mark.parametrize("make", [
    lambda: draw(study([LINK, R], failed=(3,))),
    lambda: draw(study([LINK, R]), kind="contour"),
    lambda: draw(study([LINK, METHOD])),
    lambda: draw(study([LINKS, NOISES, METHOD], "latin-hypercube", size=60), ("model.R", "network.link")),
    lambda: draw_pareto(pareto(study([LINK, METHOD])), study([LINK, METHOD])),
])  # fmt: skip
def test_print_is_large_enough_and_nothing_lies_on_the_title(make):
    figure = make()
    figure.savefig(io.BytesIO(), format="png")
    words = [t for t in figure.findobj(matplotlib.text.Text) if t.get_text() and t.get_visible()]
    assert min(t.get_fontsize() for t in words if "mathdefault" not in t.get_text()) >= 8
    axes = figure.axes[0]
    title, above = axes.title.get_window_extent(), figure._suptitle.get_window_extent()
    assert not title.overlaps(above)
    page = figure.bbox
    legend = axes.get_legend()
    for part in (title, above, axes.xaxis.label.get_window_extent(), *([legend.get_window_extent()] if legend else [])):
        assert part.x0 >= page.x0
        assert part.x1 <= page.x1
        assert part.y0 >= page.y0
        assert part.y1 <= page.y1
    if legend:
        assert not legend.get_window_extent().overlaps(axes.xaxis.label.get_window_extent())


def test_thinning_takes_no_pattern_of_a_grid():
    points = np.arange(1_000_000)
    taken = thinned(points, 200)
    assert taken.sum() == pytest.approx(5000, rel=0.02)
    for period in (2, 8, 100, 200):
        assert np.bincount(points[taken] % period, minlength=period).min() > 0
    assert thinned(points, 1).all()
