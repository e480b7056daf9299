"""The thesis' figures and tables: all there, their data right, their verdicts following from the numbers."""

from __future__ import annotations

import csv
import io
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import stochfuse as sf
from stochfuse.cli import reproduce as command
from stochfuse.cli.app import app
from stochfuse.cli.options import Written
from stochfuse.errors import UsageError
from stochfuse.report import plot
from stochfuse.report import reproductions as report
from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis import Bench, about_covariance, about_records, catalogue, find, sheet
from stochfuse.thesis import bench as records
from stochfuse.thesis.bench import ARCHITECTURES, LINKS, STEADY, TRANSIENT, Sweep, ThesisCase, time_average
from stochfuse.thesis.catalogue import NOT_COVERED, statements
from stochfuse.thesis.statements import explained, judged
from tests.cli.command import run, strict_json
from tests.oracles import textbook

SLOW = "ad-hoc"
ONE = np.eye(1)


@pytest.fixture(scope="module")
def bench():
    """The thesis' five steps: for broadcast and cyclic networks."""
    return Bench()


@pytest.fixture(scope="module")
def short():
    """Three steps: for ad hoc networks."""
    return Bench(steps=3)


def out(*arguments):
    """What the command prints, in this process."""
    done = CliRunner().invoke(app, ["reproduce", *arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def curves(made, panel=0):
    return {curve.name: curve.y for curve in made.panels[panel].curves}


def test_every_figure_and_table_is_there_or_said_to_have_no_numbers():
    keys = [item.key for item in catalogue()]
    wanted = [f"figure-{i}" for i in (*range(19, 63), *range(65, 73))] + ["table-2", "table-3", "table-4"]
    assert keys == wanted
    rest = {f"figure-{i}" for i in range(1, 76)} | {f"table-{i}" for i in range(1, 5)}
    assert rest - set(keys) == set(NOT_COVERED)
    about = {item for statement in statements() for item in statement.items}
    assert about <= set(keys)
    # parameters, and figures that the text shows without a word on them
    assert set(keys) - about == {"table-2", "table-4", "figure-54", "figure-55"}


@pytest.mark.parametrize("name", ["figure-32", "fig32", "Fig. 32", "32", "figure 32", "figure32"])
def test_names_of_figures(name):
    assert find(name).key == "figure-32"


def test_names_of_tables_and_of_what_is_not_there():
    assert find("table-3").key == find("tab 3").key == "table-3"
    with pytest.raises(UsageError, match=r"figure 64 is a drawing of the simulation model; it has no numbers"):
        find("64")
    for name in ("figure-99", "table-9", "chart-3", "", "3.2"):
        with pytest.raises(
            UsageError, match=r"reproduce: expected figure-19 to figure-62, .* statements, all or timing, got"
        ):
            find(name)


@pytest.mark.parametrize("key", [item.key for item in catalogue()])
def test_every_item_makes_its_data(short, key):
    made = find(key).sheet(short)
    assert bool(made.panels) != bool(made.facts)
    for panel in made.panels:
        assert panel.x_label
        assert panel.y_label
        assert len(panel.points) == len(panel.x)
        assert len({curve.name for curve in panel.curves}) == len(panel.curves)
        for curve in panel.curves:
            for _, values in curve.rows(panel.x_label):
                assert values.shape == panel.x.shape
                assert np.isfinite(values).all()


GENERAL = {
    # published numbers, general (49), claimed, P(k0) = 100
    "figure-21": {
        "25 %": (77.08333, 39.70478, 32.05569, 30.22397, 29.84359),
        "50 %": (58.33333, 30.31415, 25.81867, 25.01889, 24.89674),
        "75 %": (43.75, 24.72526, 22.0427, 21.58531, 21.50537),
    },
    "figure-22": {
        "25 %": (87.5, 46.13638, 36.64332, 33.92131, 33.17008),
        "50 %": (75, 38.08235, 30.76495, 29.21189, 28.98359),
        "100 %": (50, 25.86207, 23.95098, 23.6054, 23.42564),
    },
}


@pytest.mark.parametrize("key", GENERAL)
def test_covariance_figures_show_published_numbers(bench, key):
    made = curves(find(key).sheet(bench))
    for name, values in GENERAL[key].items():
        np.testing.assert_allclose(made[name], values, rtol=2e-7)


def test_ad_hoc_figures_show_both_methods(short):
    made = find("figure-65").sheet(short)
    np.testing.assert_allclose(curves(made)["25 %"], (77.08333, 39.37944, 31.68171), rtol=2e-7)
    np.testing.assert_allclose(curves(made, 1)["25 %"], (77.083, 42.571, 34.853), rtol=2e-5)


def test_normalised_figures_are_relative_to_no_links(bench):
    P, made = curves(find("figure-21").sheet(bench)), curves(find("figure-24").sheet(bench))
    for step in range(5):
        wanted = [P[name][step] / P["0 %"][step] for name in ("0 %", "25 %", "50 %", "75 %", "100 %")]
        np.testing.assert_allclose(made[f"k={step + 1}"], wanted, rtol=1e-12)


def outcomes_of_record(bench, case, architecture, link, naive, s):
    """Error of every agent in every outcome of one record with equal initial estimates, by the textbook."""
    scenario = bench.scenario(case, architecture)
    n, steps = 3, bench.steps
    q, r = scenario.model.Q.item(), scenario.sensors[0].R.item()
    x = records.TRUTH + np.cumsum([0.0, *(np.sqrt(q) * s[3 + 4 * k] for k in range(steps - 1))])
    z = [[np.zeros((1, 1))] * n]
    for k in range(1, steps):
        z.append([np.array([[x[k] + np.sqrt(r) * s[4 + 4 * (k - 1) + i]]]) for i in range(n)])
    error = 0.0 if scenario.error is None else scenario.error.item()
    x0 = np.array([[records.TRUTH + np.sqrt(scenario.P0.item()) * s[0] + error]])
    first, second = np.zeros(steps), np.zeros(steps)
    links = [np.full((n, n), link)] * steps
    for probability, history in textbook.histories(n, steps, architecture, links):
        network = textbook.FusionNetwork(
            ONE, scenario.model.Q, [(ONE, scenario.sensors[0].R)] * n, scenario.P0, x0, z, history, naive=naive
        )
        for k in range(steps):
            away = np.array([network.state(i, k + 1).item() for i in range(n)]) - x[k]
            first[k] += probability * away.mean()
            second[k] += probability * (away**2).mean()
    return x, first, np.sqrt(second)


@pytest.mark.parametrize("case", [TRANSIENT, STEADY], ids=lambda case: case.name)
@pytest.mark.parametrize(
    ("architecture", "steps", "rule"),
    [("broadcast", 3, LFG), ("cyclic", 3, LFG), ("broadcast", 2, NAIVE), ("cyclic", 2, NAIVE)],
)
def test_errors_of_one_record_are_those_of_every_outcome(case, architecture, steps, rule):
    bench = Bench(steps=steps)
    scenario = bench.scenario(case, architecture)
    drawn = records.draw(scenario, 1, 5, "start")
    weights = bench.weights(case, architecture, (0.3,), rule)
    for s, mean, rms in zip(drawn, weights.mean_given(drawn), weights.rms_given(drawn), strict=True):
        x, first, second = outcomes_of_record(bench, case, architecture, 0.3, rule == NAIVE, s)
        np.testing.assert_allclose(records.truth(scenario, s[None])[0], x, rtol=1e-12)
        np.testing.assert_allclose(mean[0], first, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(rms[0], second, rtol=1e-8)


@pytest.mark.parametrize("case", [TRANSIENT, STEADY], ids=lambda case: case.name)
@pytest.mark.parametrize("architecture", ["broadcast", "cyclic"])
def test_averages_over_noise_are_those_of_predict(bench, case, architecture):
    scenario = bench.scenario(case, architecture)
    weights = bench.weights(case, architecture)
    wanted = sf.predict(scenario, LINKS, method="general", quantity="rms").values()
    np.testing.assert_allclose(weights.rms(records.spread(scenario)), wanted, rtol=1e-10)
    np.testing.assert_allclose(
        weights.rms(records.spread(scenario, initial_error=False)) ** 2,
        sf.predict(scenario, LINKS, method="general", quantity="actual").values(),
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        weights.first[..., -1], sf.predict(scenario, LINKS, method="general", quantity="bias").values(), atol=1e-8
    )


@pytest.mark.parametrize("data", about_records.READINGS)
@pytest.mark.parametrize("rule", [LFG, SIMPLIFIED])
def test_average_over_noise_is_that_of_many_records(bench, data, rule):
    scenario = bench.scenario(STEADY, "broadcast")
    weights = bench.weights(STEADY, "broadcast", rule=rule)
    square = weights.rms_given(records.draw(scenario, 4000, 3, data)) ** 2
    error = square.std(axis=0) / np.sqrt(len(square))
    assert (np.abs(square.mean(axis=0) - weights.rms(records.spread(scenario, data)) ** 2) < 4.5 * error).all()


def test_more_records_begin_with_the_same_ones(bench):
    scenario = bench.scenario(STEADY, "cyclic")
    np.testing.assert_array_equal(records.draw(scenario, 3, 1), records.draw(scenario, 5, 1)[:3])
    assert (records.draw(scenario, 3, 2) != records.draw(scenario, 3, 1))[:, :-1].all()
    shared = records.draw(scenario, 4, 1, "all")
    assert (shared[:, :3] == shared[:, :1]).all()
    assert (shared[:, 4:7] == shared[:, 4:5]).all()


def test_simplified_footprint_is_what_predict_states_gives(bench):
    scenario = bench.scenario(STEADY, "broadcast")
    s = records.draw(scenario, 1, 7, "start")
    x = records.truth(scenario, s)[0]
    z = np.zeros((5, 3, 1))
    for k in range(1, 5):
        z[k, :, 0] = x[k] + 10 * s[0, 4 + 4 * (k - 1) : 7 + 4 * (k - 1)]
    start = x[0] + np.sqrt(45) * s[0, 0]
    moved = sf.predict_states(scenario, z - start, LINKS).x[..., 0] + start  # its x0 is 0
    wanted = moved.mean(axis=2) - x
    np.testing.assert_allclose(bench.weights(STEADY, "broadcast", rule=SIMPLIFIED).mean_given(s)[0], wanted, atol=1e-9)


def test_both_methods_agree_where_nothing_is_lost(bench):
    for case in (TRANSIENT, STEADY):
        here, simplified = (bench.weights(case, "broadcast", (0.0, 1.0), rule) for rule in (LFG, SIMPLIFIED))
        np.testing.assert_allclose(here.second, simplified.second, atol=1e-8 * np.abs(here.second).max())


def test_known_algorithms_are_the_textbooks(bench):
    scenario = bench.scenario(TRANSIENT, "cyclic")
    model, sensor = scenario.model, scenario.sensors[0]
    given = (model.F, model.Q, [(sensor.H, sensor.R)] * 3, scenario.P0, np.zeros((1, 1)), [[np.zeros((1, 1))] * 3] * 5)
    for ours, theirs in (
        (about_covariance.full_rate_cyclic(scenario), textbook.full_rate_cyclic(*given)),
        (about_covariance.full_rate(scenario, 3), textbook.full_rate_broadcast(*given)),
        (about_covariance.full_rate(scenario, 1), textbook.full_rate_stand_alone(*given)),
    ):
        np.testing.assert_allclose(ours, [theirs[0, k][1].item() for k in range(1, 6)], rtol=1e-12)


def test_the_initial_error_explains_figures_32_and_33(bench):
    """Theory section 7: peaks near 12.5 % for broadcast and 25 % for cyclic; without initial error it falls."""
    fine = (0.0, 0.125, 0.25, 0.375, 0.5)
    sweeps = {a: Sweep(bench, TRANSIENT, a, links=fine) for a in ("broadcast", "cyclic")}
    broadcast, cyclic = (sweep.averaged() for sweep in sweeps.values())
    assert fine[broadcast.argmax()] == 0.125
    assert fine[cyclic.argmax()] == 0.25
    assert cyclic[4] > cyclic[0]
    for a, peak in (("broadcast", 1), ("cyclic", 2)):
        bias = np.abs(bench.weights(TRANSIENT, a, fine).first[..., -1])[:, 1:].mean(axis=1)
        assert bias.argmax() == peak
        assert (bias[4] > bias[0]) == (a == "cyclic")
    for sweep in sweeps.values():
        assert (np.diff(sweep.averaged(initial_error=False)) < 0).all()


def test_process_noise_shrinks_the_rise(bench):
    """Theory section 7: the bias alone gives a rise at Q/R = 1/4 and 1/16 and none at 4 (at the thesis' levels)."""
    rises = [Sweep(bench, ThesisCase("transient", q=q), "broadcast").averaged() for q in (6.25, 25.0, 400.0)]
    assert [r[1] > r[0] for r in rises] == [True, True, False]


def test_single_steady_records_seldom_rise_unless_data_are_shared(bench):
    seen = {}
    for data in about_records.READINGS:
        found = time_average(about_records.given(Sweep(bench, STEADY, "broadcast"), data))
        seen[data] = np.mean(found[:, 1] > found[:, 0])
    # binomial standard errors of 2000 records are 0.004 and 0.009
    assert seen["own"] < 0.05
    assert seen["start"] < 0.06
    assert seen["all"] > 0.7


def test_verdicts_follow_from_what_is_seen():
    assert judged(True, "1") == ("agrees", "1")
    assert judged(False, "1") == ("differs", "1")
    assert judged(np.False_, "1", "open") == ("open", "1")
    assert explained(True, True, "1") == ("explained", "1")
    assert explained(True, False, "1") == ("agrees", "1")
    assert explained(False, True, "1") == ("differs", "1")
    seen, none = (
        {d: np.array([True, False]) for d in about_records.READINGS},
        {d: np.array([False]) for d in about_records.READINGS},
    )
    averages = {d: np.array([1.0]) for d in about_records.READINGS}
    assert about_records.of_records(seen, averages, True)[0] == "agrees"
    assert about_records.of_records(seen, averages, False)[0] == "open"
    assert about_records.of_records(none, averages, False)[0] == "differs"
    assert "in 50.0 % (own data)" in about_records.of_records(seen, averages, False)[1]


def test_a_verdict_changes_with_the_numbers():
    """A straight line from 0 to 100 % connectivity gives half of the reduction at 50 %, not 70 %."""
    line = np.linspace(100, 20, 5)[:, None] * np.ones(5)
    straight = SimpleNamespace(steps=5, claimed=lambda *_, **__: line)
    (statement,) = [s for s in statements() if "70 %" in s.thesis and s.items == ("figure-24",)]
    assert statement.judge(straight).verdict == "differs"
    assert "on average 50.0 %" in statement.judge(straight).ours
    assert statement.judge(Bench()).verdict == "agrees"  # a broadcast network: quick


VERDICTS = {
    "figure-21": ["agrees"] * 3,
    "figure-22": ["agrees"] * 3,
    "figure-30": ["differs", "explained"],
    "figure-31": ["differs", "explained"],
    "figure-34": ["open"],
    "figure-35": ["open"],
    "figure-37": ["agrees"] * 4,
    "figure-43": ["differs", "agrees"],
    "figure-46": ["open", "agrees"],
    "figure-48": ["open"] * 4,
    "figure-51": ["agrees"] * 2,
}


@pytest.mark.parametrize("key", VERDICTS)
def test_verdicts_of_statements_about_one_network(bench, key):
    """Those that need no ad hoc network."""
    about = [
        s for s in statements() if key in s.items and getattr(s.check, "keywords", {}).get("architecture", SLOW) != SLOW
    ]
    assert [s.judge(bench).verdict for s in about] == VERDICTS[key]


def test_every_statement_is_judged(short):
    for statement in statements():
        finding = statement.judge(short)
        assert finding.verdict in report.VERDICTS
        assert finding.criterion
        assert "nan" not in finding.ours


def test_table_3_is_explained(bench):
    verdicts = {f.thesis: f.verdict for f in sheet("table-3", bench).findings}
    assert verdicts["10 steps, of which the first five are left out."] == "explained"
    assert [v for t, v in verdicts.items() if t.startswith("The ad hoc column")] == ["explained"]
    assert [v for t, v in verdicts.items() if t.startswith("The cyclic column")] == ["differs"]
    made = find("table-3").sheet(bench)
    assert len(made.panels) == 3
    np.testing.assert_array_equal(curves(made)["mean, thesis"], [0, 1.820, 1.992, 1.988, 2])


def test_plots_have_the_axes_of_the_thesis(bench):
    figure = report.draw(find("figure-46").sheet(bench))
    assert [axes.get_xlabel() for axes in figure.axes] == ["time step"] * 2
    assert [axes.get_ylabel() for axes in figure.axes] == ["RMS error (actual)"] * 2
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [
        "0 %",
        "25 %",
        "50 %",
        "75 %",
        "100 %",
    ]
    axes = report.draw(find("figure-24").sheet(bench)).axes[0]
    assert axes.get_xlabel() == "average connectivity"
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["0 %", "25 %", "50 %", "75 %", "100 %"]
    axes = report.draw(find("figure-54").sheet(bench)).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("nodes per message", "cumulative probability")
    assert axes.get_ylim() == (0, 1)
    assert report.draw(find("figure-50").sheet(bench)).axes[0].patches


def test_bands_and_abscissae_of_their_own_are_drawn_and_listed():
    y = np.array([1.0, 2.0])
    curve = report.DrawnCurve("a", y, y - 1, y + 1, np.array([5.0, 7.0]))
    panel = report.Panel("p", "size", "error", ("0 %", "1 %"), np.array([0.0, 1.0]), (curve,))
    made = report.Sheet("figure-61", "t", panels=(panel,))
    axes = report.draw(made).axes[0]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [5, 7])
    assert len(axes.collections) == 1
    (table,) = report.data_tables(made)
    assert [row[0] for row in table.rows] == ["a, size", "a", "a, lowest", "a, highest"]
    assert report.where(("figure-20", "figure-21", "table-3")) == "fig. 20, 21, table 3"


def test_command_lists_everything():
    listed = run("reproduce").stdout
    assert "figure-72" in listed
    assert max(map(len, listed.splitlines())) <= 80
    listed = strict_json(out("--format", "json"))["items"]
    assert [entry["key"] for entry in listed] == [item.key for item in catalogue()]


def test_command_prints_data_and_verdicts(tmp_path):
    done = run("reproduce", "fig22", "--plot", str(tmp_path / "22.png"))
    assert "Thesis figure 22" in done.stdout
    assert "agrees" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert (tmp_path / "22.png").read_bytes().startswith(b"\x89PNG")
    made = strict_json(out("22", "--format", "json"))
    assert (made["schema"], made["what"]) == ("stochfuse.reproduction/1", "figure-22")
    assert made["panels"][0]["x"] == [1, 2, 3, 4, 5]
    rows = list(csv.DictReader(io.StringIO(out("22", "--format", "csv"))))
    assert len(rows) == 25
    assert float(rows[0]["value"]) == pytest.approx(100)
    assert out("table-4", "--format", "markdown").count("| Q | 25 | 25 |") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["figure-99"], "reproduce: expected figure-19 to figure-62"),
        (["figure-5"], "figure 5 explains the method; see `stochfuse graph`"),
        (["statements", "--plot", "x.png"], "--plot: expected the key of a figure"),
        (["table-4", "--plot", "x.png"], "table 4 is a table of parameters, with nothing to draw"),
        (["24", "--plot", "x.doc"], "x.doc: expected a name that ends in .png, .svg, .pdf"),
        (["all"], "reproduce all: expected --output with a directory that exists, got nothing"),
        (["all", "--output", "nowhere"], "got 'nowhere'"),
    ],
)
def test_wrong_requests(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["reproduce", *arguments])
    assert done.exit_code == 2
    assert message in done.stderr.replace("\n", " ")
    assert not done.stdout


@pytest.mark.slow
def test_everything_goes_into_a_directory(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plot, "save", lambda draw, path: drawn.append((draw.args[0].key, path.name)))
    command._everything(Bench(steps=2), Written(output=tmp_path))
    keys = [item.key for item in catalogue()]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{key}.json" for key in [*keys, "statements"])
    assert drawn == [(key, f"{key}.png") for key in keys if key not in ("table-2", "table-4")]
    assert strict_json((tmp_path / "figure-48.json").read_text())["statements"]


def test_the_room_is_a_door():
    assert sf.thesis.Bench is Bench
    assert sf.thesis.statements() == statements()


def test_architectures_are_those_of_the_thesis():
    assert ARCHITECTURES == ("ad-hoc", "broadcast", "cyclic")
