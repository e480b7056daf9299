"""The page that can be sent: whole, by itself, escaped, and with the numbers of every other format."""

from __future__ import annotations

import csv
import io
import re
import sys
import tomllib
from html.parser import HTMLParser

import pytest

import stochfuse as sf
from stochfuse.report.document import DocumentNote, document
from stochfuse.report.results import report_of
from stochfuse.scenario.as_toml import to_toml
from stochfuse.scenario.scenario import preset_names
from tests.cli.command import run
from tests.data.robot_records import write

MEANS = "link,step,covariance,count\n0.5,1,58.2,1000\n0.5,2,32.9,1000\n"
SCRIPT = "<script>alert(1)</script>"


class Page(HTMLParser):
    """Tags, attributes and text of a page; every tag is closed in order."""

    VOID = ("meta", "input", "img", "path", "use", "rect", "br")

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.cells, self.attributes, self.text = [], [], [], [], ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


def page_of(path):
    text = path.read_text(encoding="utf-8")
    assert len(text) < 3_000_000
    page = Page(text)
    assert "script" not in page.tags
    for name, value in page.attributes:
        # nothing is loaded from anywhere: a name space is a name, and a part of the figure is referred to by #
        if name in ("href", "src", "xlink:href"):
            assert value.startswith(("#", "data:image/png;base64,"))
        assert not name.startswith("on")
    assert not re.search(r"url\(\s*['\"]?(?!#)", text)
    return page


def test_numbers_are_those_of_the_other_formats(tmp_path):
    words = ("predict", "--link", "0.2,0.8", "--steps", "3", "--report", tmp_path / "r.html")
    records = csv.DictReader(io.StringIO(run(*words, "--format", "csv").stdout))
    page = page_of(tmp_path / "r.html")
    for record in records:
        assert f"{float(record['value']):#.5g}" in page.cells
    for said in ("Expected claimed posterior covariance", "simplified formulation (54)", sf.__version__, "martin2005"):
        assert said in page.text
    assert "stochfuse predict --link 0.2,0.8 --steps 3 --report" in page.text
    assert "steps = 3" in page.text  # what an option changed
    assert "What a filter believes of itself" in page.text
    assert "svg" in page.tags


@pytest.mark.parametrize("format", ["table", "csv", "json", "markdown", "latex"])
def test_standard_output_is_the_same_beside_it(format, tmp_path):
    words = ("predict", "--link", "0.5", "--steps", "2", "--format", format)
    assert run(*words, "--report", tmp_path / "r.htm").stdout == run(*words).stdout
    page_of(tmp_path / "r.htm")


def test_compare_methods_and_estimators(tmp_path):
    run("compare", "--methods", "general,simplified", "--link", "0.5", "--steps", "2", "--report", tmp_path / "m.html")
    assert "general formulation (49)" in page_of(tmp_path / "m.html").text
    words = (
        "compare",
        "--estimator",
        "naive,optimal",
        "--link",
        "0.8",
        "--steps",
        "2",
        "--report",
        tmp_path / "e.html",
    )
    warning = run(*words).stderr.splitlines()[-1]
    text = page_of(tmp_path / "e.html").text
    assert warning.startswith("warning: naive: overconfident")
    assert warning in text
    assert "nothing removed" in text


@pytest.mark.slow
def test_crosscheck_that_disagrees_writes_the_page_all_the_same(tmp_path):
    run("crosscheck", "-", "--agents", "2", "--report", tmp_path / "c.html", input=MEANS, code=1)
    text = page_of(tmp_path / "c.html").text
    assert "DISAGREE" in text
    assert "the results disagree with the prediction" in text
    assert "“-” is standard input" in text


@pytest.mark.slow
def test_run_and_study(tmp_path):
    drawn = ("--steps", "3", "--link", "0.5")
    run("simulate", *drawn, "-o", tmp_path / "sim", "--report", tmp_path / "simulate.html")
    measurements = tmp_path / "sim" / "measurements.csv"
    run("run", *drawn, "--measurements", measurements, "--report", tmp_path / "run.html")
    for name in ("simulate", "run"):
        page = page_of(tmp_path / f"{name}.html")
        assert "Normalised estimation error squared" in page.text
        assert f"stochfuse {name} --steps 3" in page.text
        assert "svg" in page.tags
    (tmp_path / "s.toml").write_text('scenario = "thesis-transient"\n[vary]\n"network.link" = [0.2, 0.8]\n')
    run("study", "s.toml", "-o", "s.csv", "--report", "s.html", cwd=tmp_path)
    page = page_of(tmp_path / "s.html")
    assert "network.link" in page.text
    assert "svg" in page.tags


@pytest.mark.slow
def test_robots_have_a_page_without_a_scenario(tmp_path):
    write(tmp_path, 1, landmarks=6, seconds=61.0, interval=0.5)
    asked = ("--data", tmp_path, "--until", "30", "--link", "0,1", "--estimator", "stand-alone", "--runs", "1")
    run("run", "utias", *asked, "--report", tmp_path / "r.html")
    page = page_of(tmp_path / "r.html")
    assert "Robots of" in page.text
    assert "How to cite" in page.text
    assert "Scenario" not in page.text
    assert "svg" in page.tags


@pytest.mark.slow
def test_expected_states(tmp_path):
    run("simulate", "--steps", "3", "--link", "0.5", "-o", tmp_path / "sim")
    run("predict", "--steps", "3", "--quantity", "state", "--measurements", tmp_path / "sim" / "measurements.csv",
        "--report", tmp_path / "r.html")  # fmt: skip
    assert "Expected" in page_of(tmp_path / "r.html").text


def test_scenario_of_standard_input_and_scripts_stay_text(tmp_path):
    mapping = sf.load_scenario("thesis-transient", steps=2).to_mapping()
    mapping["description"] = SCRIPT
    mapping["model"]["states"] = [SCRIPT]
    mapping["agent"] = [{"name": f"{SCRIPT}&{i}"} for i in range(3)]
    run("predict", "-", "--report", tmp_path / "r.html", input=to_toml(mapping))
    page = page_of(tmp_path / "r.html")
    assert page.text.count(SCRIPT) >= 5
    assert "<script" not in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("r.pdf", "r.pdf: expected a name that ends in .html, .htm"),
        ("none/r.html", "cannot write none/r.html: there is no directory none"),
        ("d.html", "cannot write d.html: it is a directory"),
        ("o.html", "--report: expected another file than o.html, which it would overwrite"),
    ],
)
def test_what_cannot_be_written_is_said_before_any_work(name, message, tmp_path):
    (tmp_path / "d.html").mkdir()
    done = run("predict", "-o", "o.html", "--report", name, code=2, cwd=tmp_path)
    assert done.stderr == f"error: {message}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["d.html"]


def test_without_matplotlib_the_page_says_why_there_is_no_figure(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    text = Page(document(report_of(sf.predict("thesis-transient", [0.5])), DocumentNote(("predict",), {}))).text
    assert "no figure: plots need matplotlib: pip install 'stochfuse[plot]'" in text


def test_a_large_figure_is_drawn_in_dots(monkeypatch):
    monkeypatch.setattr("stochfuse.report.document.MOST_VECTORS", 100)
    text = document(report_of(sf.predict("thesis-transient", [0.5])), DocumentNote(("predict",), {}))
    assert 'src="data:image/png;base64,' in text
    assert "<svg" not in text


@pytest.mark.parametrize("preset", preset_names())
def test_a_scenario_reads_back_from_its_text(preset):
    mapping = sf.load_scenario(preset).to_mapping()
    assert tomllib.loads(to_toml(mapping)) == mapping


def test_awkward_words_and_numbers_read_back():
    mapping = {
        "schema": "a\"b\\\x7f\n€𝄞", "x": {"a.b": 1e-300, "ä": [[1, 2.5], []], "y": {"z": {"q": True}, "w": {}}},
        "agent": [{"name": "# [x]"}, {}],
    }  # fmt: skip
    assert tomllib.loads(to_toml(mapping)) == mapping
