"""What is asked of the page, without a browser: commands, Python and files that say the same, and files that are opened."""

from __future__ import annotations

import gzip
import shlex
import threading
import time

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import ScenarioError, StochfuseError, UsageError
from stochfuse.estimators.progress import Progress, listening
from stochfuse.explore import answers, saved
from stochfuse.explore.answers import QuestionWorker
from stochfuse.explore.network import picture
from stochfuse.explore.saved import PageContents
from stochfuse.explore.state import OpenedScenario, PageInput, begun, field_of, opened, preset, with_log
from stochfuse.scenario.as_toml import to_toml
from stochfuse.scenario.registry import LFG
from tests.cli.command import run, strict_json

EDGES = b"receiver,sender,link\na,b,0.3\nb,a,0.6\n"


def asked(name="thesis-transient", **changed):
    return PageInput(preset(name), **changed)


def answer(question, name):
    return dict([*answers.quick(question), *answers.exact(question), *answers.least(question)])[name]()


def json_of(command):
    return strict_json(run(*shlex.split(command)[1:], "--format", "json").stdout)


ASKED = {
    "as it is": asked(steps=2, link=0.4),
    "options": asked(agents=4, steps=2, q=5.0, r=50.0, p0=20.0, link=0.4, architecture="broadcast", metric="std:x"),
    "radio": asked("road-5", steps=3, power=20.0),
    "own links": asked("orbit-8", steps=2, agent=3),
}


@pytest.mark.parametrize("question", ASKED.values(), ids=ASKED)
def test_curves_are_what_the_commands_print(question):
    commands = question.commands()
    curve = answer(question, "simplified")[0]
    along, *alone = [json_of(command) for command in commands if "--method simplified" in command]
    values = np.array(along["values"])[:, -1]
    points = question.powers("0:1:0.05") if question.kind == "power" else along["link"]
    assert dict(zip(curve.over.x, curve.over.y, strict=True)) == dict(zip(points, values, strict=True))
    present = alone[0]["values"][0] if alone else along["values"][list(points).index(question.power or question.link)]
    assert curve.steps.y.tolist() == present


def test_estimators_sampled_or_exact_are_what_the_commands_print():
    for question, sampled in ((asked(steps=2, link=0.4), False), (asked(agents=5, steps=2, link=0.4), True)):
        curves = answer(question, "estimator local-fusion-graph")
        assert [curve.sampled for curve in curves] == [sampled] * 2
        command = next(c for c in question.commands(["local-fusion-graph"] * sampled) if " compare " in c)
        found = json_of(command)["estimators"]["local-fusion-graph"]
        for curve in curves:
            expected = found["quantities"][curve.quantity]
            assert curve.steps.y.tolist() == expected["values"][-1]
            if sampled:
                error = np.array(expected["standard_error"][-1])
                assert curve.steps.high - curve.steps.y == pytest.approx(1.96 * error, rel=1e-3)


def test_the_rest_is_what_the_commands_print():
    question = asked(steps=2, link=0.4, target=50.0)
    least, load = answer(question, "least"), answer(question, "messages")
    drawn = answer(question, "sensitivity")
    commands = question.commands()
    assert least.value == json_of(next(c for c in commands if "--target" in c))["link"]
    derivative = strict_json(
        run(*shlex.split(next(c for c in commands if "--sensitivity" in c))[1:], "-f", "json").stdout
    )
    assert sorted(drawn.worth.values()) == sorted(link["derivative"] for link in derivative["links"])
    means = [
        json_of(f"{commands[-1]} --rule {rule}")["rules"][rule]["mean"][0] for rule in ("local-fusion-graph", "naive")
    ]
    assert load.value.mean(axis=1) == pytest.approx(means)
    assert "rank 1 of 6" in drawn.about_link((0, 1), question)
    assert drawn.mended() == ""  # all are alike
    one = answer(asked(steps=2, link=0.4, changed=(((0, 1), 0.9), ((1, 0), 0.1))), "sensitivity")
    most = max(one.worth, key=lambda pair: -one.worth[pair] * (1 - one.link[pair]))
    assert f"To mend first: {one.name(most)}; perfect" in one.mended()
    assert "hears 2 other(s), with µ = 0.4" in drawn.about_agent(0, question)


def test_a_file_says_all_that_was_changed(tmp_path):
    question = asked(steps=2, link=0.4, q=3.0, changed=(((0, 1), 0.9),))
    (tmp_path / "page.toml").write_text(question.file())
    assert all(" page.toml" in command for command in question.commands())
    found = strict_json(run("predict", tmp_path / "page.toml", "-f", "json").stdout)
    assert found["scenario"]["network"]["link"] == [[0.0, 0.9, 0.4], [0.4, 0.0, 0.4], [0.4, 0.4, 0.0]]
    assert answer(question, "simplified")[0].steps.y.tolist() == found["values"][0]


def test_single_agents_measure_otherwise(tmp_path):
    question = asked(steps=2, link=0.4, sensors=((0, 0.25), (1, None), (7, None)))
    given = {**preset("thesis-transient").mapping, "agent": [{"R": 25}, {"sensor": False}, {}]}
    expected = sf.predict(given | {"network": {"agents": 3, "steps": 2}}, [0.4])
    assert answer(question, "simplified")[0].steps.y[-1] == pytest.approx(expected.values()[0, -1])
    (tmp_path / "page.toml").write_text(question.file())
    assert all(" page.toml" in command for command in question.commands())
    assert sf.load_scenario(tmp_path / "page.toml").sensors[0].R.tolist() == [[25.0]]
    drawn = answer(question, "network")
    assert "measures with standard deviation 5" in drawn.about_agent(0, question)
    assert "measures nothing itself" in drawn.about_agent(1, question)
    radar = asked("road-5", steps=2, sensors=((0, 9.0), (2, 1.0))).scenario
    assert [np.diag(radar.sensors[i].R).tolist() for i in radar.sensor_of[:3]] == [[36.0, 36.0], [4.0, 4.0], [4.0, 4.0]]
    named = asked("two-radars", sensors=((0, 4.0),)).scenario
    assert np.allclose(
        np.sqrt(np.diag(named.sensors[0].R[-1] if named.sensors[0].R.ndim == 3 else named.sensors[0].R)), [40, 0.02]
    )
    bare = OpenedScenario(
        "x.toml",
        given
        | {
            "model": {"F": 1, "Q": 1, "states": ["x"]},
            "agent": [{"H": 1, "R": 1}, {"H": 1, "R": 1}, {"sensor": False}],
        },
    )
    with pytest.raises(StochfuseError, match=r"agent\[3\]\.R: expected a sensor of its own or of the model") as error:
        PageInput(bare, sensors=((2, 1.0),)).scenario  # noqa: B018
    assert field_of(error.value) == "times"


def test_python_runs_and_prints_the_same(capsys):
    question = asked(steps=2, link=0.4, agents=2, metric="std:x")
    exec(compile(question.python(), "page", "exec"), {})
    assert f"{answer(question, 'simplified')[0].steps.y[-1]:.5f}"[:6] in capsys.readouterr().out


def test_csv_has_every_number():
    question = asked(steps=2, link=0.4)
    curves = [*answer(question, "simplified"), *answer(question, "estimator local-fusion-graph")]
    lines = saved.records(curves).splitlines()
    assert lines[0].startswith("series,method,quantity")
    assert len(lines) == 1 + 22 * 2 + 2 * 12 * 2


def test_a_page_to_be_sent_has_all_that_is_shown():
    question = asked(steps=2, link=0.4, target=50.0, sensors=((0, 4.0),), estimators=("local-fusion-graph", "naive"))
    found = [answer(question, name) for name in ("simplified", "estimator local-fusion-graph", "estimator naive")]
    found[2][0] = found[2][0]._replace(sampled=True)  # of other links than those that are exact
    shown = PageContents(
        [c for some in found for c in some], *(answer(question, n) for n in ("sensitivity", "messages", "least"))
    )
    page = saved.page_of(question, shown)
    assert "# page.toml is the scenario below\nstochfuse predict page.toml --link 0:1:0.05,0.4" in page
    assert "stochfuse compare page.toml --link 0:1:0.1,0.4 --estimator local-fusion-graph" in page
    for text in (
        "What links are worth",
        "1 → 2",
        "Least µ for 50",
        "Nodes new to an agent",
        f"{found[0][0].steps.y[-1]:#.5g}",
    ):
        assert text in page
    assert page.count("<svg") == 1


def test_opened_files_are_content_alone(tmp_path):
    mapping = preset("thesis-steady").mapping
    text = to_toml({**mapping, "network": {"steps": 2, "nodes": ["a", "b"], "link": {"file": "e.csv"}}}).encode()
    made = opened("x.toml", text, {"e.csv": EDGES})
    assert made["network"]["link"] == [[0.0, 0.3], [0.6, 0.0]]
    (tmp_path / "e.csv").write_bytes(EDGES)
    for file in (str(tmp_path / "e.csv"), "../e.csv", "/etc/passwd"):
        with pytest.raises(ScenarioError, match=r"network\.link\.file: expected one that was opened here before"):
            opened("x.toml", text.replace(b"e.csv", file.encode()), {"e.csv": EDGES})
    assert opened("e.csv", EDGES, {}) is None
    assert PageInput(with_log(preset("thesis-steady"), "e.csv", {"e.csv": EDGES})).scenario.network.agents == 2


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.exe", b"", r"a\.exe: expected a scenario or a packet log, by a name that ends in \.toml"),
        ("a.toml", b"\xff", r"a\.toml: not a text file in UTF-8"),
        ("a.csv", gzip.compress(b"0" * 9_000_000), r"a\.csv: expected text, got a compressed file"),
        ("a.csv", b"x,y\n1,2\n", r"^a\.csv: expected columns seq"),
        ("a.toml", b"#" * 2_000_001, r"a\.toml: expected a file of at most 2,000,000 bytes, got 2,000,001"),
        ("a.json", b"{", r"a\.json: not valid JSON"),
    ],
)
def test_what_is_no_scenario_is_refused(name, content, message):
    with pytest.raises(StochfuseError, match=message):
        opened(name, content, {})


def test_a_scenario_of_the_command_line_does_not_reach_out_of_its_folder(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "e.csv").write_bytes(EDGES)
    text = to_toml({**preset("thesis-steady").mapping, "network": {"steps": 2, "link": {"file": "../e.csv"}}})
    (tmp_path / "in" / "s.toml").write_text(text)
    with pytest.raises(ScenarioError, match=r"network\.link\.file: expected a file within .*/in, got '\.\./e\.csv'"):
        begun(str(tmp_path / "in" / "s.toml"))
    (tmp_path / "s.toml").write_text(text.replace("../", ""))
    assert PageInput(begun(str(tmp_path / "s.toml"))).scenario.network.agents == 2


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"q": -1.0}, "q"), ({"p0": -1.0}, "p0"), ({"agents": 61}, "agents"), ({"steps": 501}, "steps"),
        ({"metric": "var:y"}, "metric"),
    ],
)  # fmt: skip
def test_errors_find_their_fields(changed, field):
    with pytest.raises((UsageError, ScenarioError)) as error:
        asked(**changed).measure  # noqa: B018
    assert field_of(error.value) == field


def test_a_network_is_drawn_where_it_is():
    drawn = picture(asked("road-5", steps=3))
    assert drawn.names == ("A", "B", "C", "D", "E")
    assert drawn.metres
    assert drawn.step == 3
    place = sf.links(sf.load_scenario("road-5", steps=3)).places[0]
    assert drawn.places[0].tolist() == place[-1].tolist()
    arc = drawn.arc(0, 1)
    assert arc[0].tolist() == drawn.places[1].tolist()
    assert arc[-1].tolist() == drawn.places[0].tolist()
    assert np.isnan(picture(asked("parallel-filters")).errors).all()  # which (54) does not take


@pytest.mark.slow
def test_what_is_no_longer_asked_is_given_up_and_never_handed_on():
    heard, over = [], threading.Event()

    def deliver(number, name, found):
        heard.append((number, name, found))
        if name == "done":
            over.set()

    work = QuestionWorker(deliver)
    first = work.ask(asked(agents=8, link=0.5))  # takes a minute
    time.sleep(0.3)
    second = work.ask(asked(steps=2, link=0.5))
    asked_at = len(heard)
    assert over.wait(60)
    assert first != second
    assert {number for number, *_ in heard[asked_at:]} == {second}
    names = [name for _, name, _ in heard[asked_at:] if name != "progress"]
    assert names == [
        "simplified",
        "network",
        "sensitivity",
        "optimal",
        "messages",
        "estimator local-fusion-graph",
        "done",
    ]
    deadline = time.monotonic() + 20
    while any(thread.name.startswith("stochfuse-page") for thread in threading.enumerate()):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_sample_is_there_soon_and_then_again_and_tells_of_itself_step_by_step():
    question = asked(agents=5, steps=4, link=0.5)
    jobs, told = list(answers.exact(question)), []

    class Told(Progress):
        def advance(self, what, done, total):
            told.append((what, done))

    names = [name for name, _ in jobs]
    assert names == [f"estimator {LFG}", "optimal", "messages", f"estimator {LFG}"]
    with listening(Told()):
        (soon, _), (later, _) = jobs[0][1](), jobs[-1][1]()
    assert {(what, k) for what in ("histories", "information", "estimates") for k in range(1, 5)} <= set(told)
    assert "20 runs" in soon.how
    assert "100 runs" in later.how
    width = [line.high[-1] - line.low[-1] for line in (soon.steps, later.steps)]
    assert 0 < width[1] < width[0] / 2
    assert abs(soon.steps.y[-1] - later.steps.y[-1]) < 1.5 * width[0]
    assert [name for name, _ in answers.exact(asked(steps=2, link=0.5))] == ["optimal", "messages", f"estimator {LFG}"]


def test_a_refusal_is_an_answer():
    heard = []
    work = QuestionWorker(lambda number, name, found: heard.append((name, found)))
    work.number = 1
    work._follow(1, asked("beacon-map", link=0.5, estimators=()))
    assert "expected agents that track one state" in str(dict(heard)["simplified"])


@pytest.mark.slow
def test_quick_answers_for_ten_agents_take_less_than_a_fifth_of_a_second():
    for question in (asked(agents=10, link=0.5), asked("cv-2d", agents=10, link=0.5), asked("orbit-8")):
        times = []
        for _ in range(3):
            start = time.process_time()
            for name, job in answers.quick(question):
                job()
                if name == "network":
                    times.append(time.process_time() - start)
        assert min(times) < 0.2
