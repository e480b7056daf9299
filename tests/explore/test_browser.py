"""The page in a real browser: numbers are the command line's, whatever is done to it."""

from __future__ import annotations

import csv
import io
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

import stochfuse as sf
from stochfuse.scenario.as_toml import to_toml
from tests.cli.command import run, strict_json

pytestmark = pytest.mark.slow
pytest.importorskip("bokeh", reason="the page needs Bokeh: pip install 'stochfuse[page]'")
api = pytest.importorskip("playwright.sync_api", reason="a browser is driven by Playwright: pip install playwright")
LONG = 60_000
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
if CHROMIUM is None:
    pytest.skip("no browser: apt-get install chromium", allow_module_level=True)

LOG = "seq,sender,receiver,received\n" + "".join(
    f"{k},{s},{r},{int((k * 7 + len(s + r)) % 10 < got)}\n"
    for k in range(40)
    for s, r, got in (("<b>a</b>", "car", 8), ("car", "<b>a</b>", 5))
)
SCRIPT = "<img src=x onerror=window.hit=1><script>window.hit=1</script>"


@contextmanager
def served(*words):
    words = [sys.executable, "-m", "stochfuse", "explore", *map(str, words), "--no-browser"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as server:
        try:
            line = server.stderr.readline()
            assert line.startswith("http://127.0.0.1:"), line + server.stderr.read()
            yield server, line.split()[0]
        finally:
            server.kill()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A scenario that exact engines answer at once."""
    path = tmp_path_factory.mktemp("given") / "small.toml"
    path.write_text(to_toml(sf.load_scenario("thesis-transient", steps=3).to_mapping()))
    return path


@pytest.fixture(scope="module")
def url(small):
    with served(small) as (server, url):
        yield url
        server.terminate()
        said = server.stderr.read()
        assert "Traceback" not in said, said


@pytest.fixture(scope="module")
def browser():
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Window:
    """A page, and how it is read."""

    def __init__(self, browser, url, width=1280, scheme="light"):
        self.context = browser.new_context(
            viewport={"width": width, "height": 1000}, color_scheme=scheme, accept_downloads=True
        )
        self.page = self.context.new_page()
        self.asked, self.faults = [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.set_default_timeout(LONG)
        self.page.goto(url)
        self.done()

    def done(self):
        self.page.get_by_text("all answers are here").wait_for(timeout=LONG)

    def value(self, name="simplified", quantity="claimed"):
        """The number in the table, and what it is of."""
        row = self.page.locator("tr", has_text=name).filter(has_text=quantity).first
        return float(row.locator("td.n").inner_text().split()[0])

    def at(self, text):
        self.page.get_by_role("region", name="Numbers").filter(has_text=text).first.wait_for(timeout=LONG)
        self.done()

    def field(self, label):
        return self.page.get_by_label(label, exact=True)

    def fill(self, label, text):
        self.field(label).fill(text)
        self.field(label).press("Enter")
        self.field(label).press("Tab")

    def saved(self, button):
        with self.page.expect_download() as download:
            self.page.get_by_role("button", name=button).click()
        return download.value.suggested_filename, download.value.path().read_text(encoding="utf-8")


@pytest.fixture
def window(browser, url):
    made = Window(browser, url)
    yield made
    assert made.faults == []
    assert all(asked.startswith((url, "data:", "blob:")) for asked in made.asked)
    made.context.close()


def predicted(*words):
    words = words if words[0] in ("thesis-steady",) else ("thesis-transient", "--steps", "3", *words)
    return strict_json(run("predict", *words, "--format", "json").stdout)["values"][-1][-1]


def near(number):
    return pytest.approx(number, rel=1e-4)  # five digits are shown


def test_it_starts_with_the_numbers_of_the_command_line(window):
    assert window.value() == near(predicted("--link", "0.5"))
    assert window.value("optimal") == near(predicted("--link", "0.5", "--method", "optimal"))
    assert window.page.get_by_text("small.toml --link 0:1:0.05,0.5 --method simplified").first.is_visible()
    assert window.page.get_by_text("Least µ for").is_visible()


def test_a_change_is_answered_in_new_numbers_by_keyboard_alone(window):
    window.fill("Agents", "10")
    window.at("10 agents")
    assert window.value() == near(predicted("--agents", "10", "--link", "0.5"))
    handle = window.page.get_by_role("slider", name="Link probability µ")
    handle.focus()
    handle.press("ArrowRight")
    window.page.get_by_text("at µ = 0.51").wait_for()
    assert window.value() == near(predicted("--agents", "10", "--link", "0.51"))


def test_old_numbers_never_stand_beside_new_input(window):
    window.page.evaluate(
        """() => { window.seen = []; const all = (n, f) => { for (const e of n.querySelectorAll("*")) { f(e);
        if (e.shadowRoot) all(e.shadowRoot, f); } };
        window.timer = setInterval(() => { let at = "", v = ""; all(document, e => {
          if (e.tagName === "DIV" && /at µ = /.test(e.textContent) && !e.children.length === false) at = e.textContent;
          if (e.tagName === "TD" && e.className === "n" && !v) v = e.textContent; });
          const m = at.match(/at µ = ([0-9.]+)/); if (m && v) window.seen.push(m[1] + ":" + v); }, 5); }"""
    )
    handle = window.page.get_by_role("slider", name="Link probability µ")
    handle.focus()
    for _ in range(8):
        handle.press("ArrowRight")
    window.page.get_by_text("at µ = 0.58").wait_for()
    window.done()
    seen = set(window.page.evaluate("() => { clearInterval(window.timer); return window.seen; }"))
    assert len(seen) >= 2
    for µ, value in (pair.split(":") for pair in seen):
        assert float(value.split()[0]) == near(predicted("--link", µ))


def test_dragging_the_target_moves_the_least_link(window):
    def place():
        return window.page.evaluate(
            """() => { const doc = Bokeh.documents[0];
            const span = [...doc._all_models.values()].find(m => m.type === "Span" && m.editable);
            const plot = [...doc._all_models.values()].find(m => m.type === "Figure" && m.center.includes(span));
            const view = Bokeh.index.find_one(plot), box = view.el.getBoundingClientRect(), frame = view.frame;
            return [box.x + frame.bbox.x_center, box.y + frame.y_scale.compute(span.location)]; }"""
        )

    before = float(window.field("Target to be met").input_value())
    x, y = place()
    mouse = window.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x, y - 20, steps=5)
    mouse.move(x, y - 40, steps=5)
    mouse.up()
    window.page.get_by_text(f"Least µ for {before:g}:").wait_for(state="detached")
    window.page.get_by_text("Least µ for").wait_for()
    target = float(window.field("Target to be met").input_value())
    assert target > before
    text = window.page.get_by_text(f"Least µ for {target:g}:").inner_text()
    found = strict_json(run("solve", "--steps", "3", "--target", f"{target:g}", "--format", "json").stdout)
    assert float(re.search(r": ([0-9.]+)", text).group(1)) == pytest.approx(found["link"], abs=1e-8)


def test_a_link_is_explained_and_changed(window):
    window.page.get_by_label("Link or agent").select_option("link 1 → 2")
    window.page.get_by_text("rank 1 of 6").wait_for()
    window.fill("µ of this link", "0.9")
    window.page.get_by_text("at its own links").wait_for()
    window.done()
    window.page.get_by_role("button", name="File").click()
    name, text = window.saved("Save scenario")
    assert name == "page.toml"
    found = strict_json(run("predict", "-", "--format", "json", input=text).stdout)
    assert window.value() == near(found["values"][0][-1])
    assert found["scenario"]["network"]["link"][1][0] == 0.9


def test_an_agent_is_explained_and_changed_and_changes_are_undone(window):
    before = window.value()
    window.field("Link or agent").select_option("agent 2")
    window.page.get_by_text("Agent 2 measures with standard deviation 10").wait_for()
    window.fill("its noise R, times", "0.25")
    window.page.get_by_text("Agent 2 measures with standard deviation 5").wait_for()
    window.done()
    assert window.value() < before
    _, text = window.saved("Save scenario")
    found = strict_json(run("predict", "-", "--link", "0.5", "--format", "json", input=text).stdout)
    assert window.value() == near(found["values"][0][-1])
    window.page.get_by_role("checkbox", name="measures").press(" ")
    window.page.get_by_text("Agent 2 measures nothing itself").wait_for()
    window.done()
    assert window.value() > before
    window.page.get_by_role("button", name="Undo changes").press("Enter")
    window.page.get_by_text("Agent 2 measures with standard deviation 10").wait_for()
    assert window.value() == near(before)


def test_a_scenario_and_a_packet_log_are_opened(window, tmp_path):
    mapping = sf.load_scenario("thesis-transient", steps=2).to_mapping()
    mapping["agent"] = [{"name": f"{SCRIPT}{i}"} for i in range(3)]
    mapping["model"]["states"] = [SCRIPT]
    (tmp_path / "mine.toml").write_text(to_toml(mapping))
    window.field("Open a scenario or packet log").set_input_files(tmp_path / "mine.toml")
    window.at("mine.toml: 3 agents")
    assert window.value() == near(
        strict_json(run("predict", "--steps", "2", "--link", "0.5", "-f", "json").stdout)["values"][0][-1]
    )
    assert window.page.evaluate("() => window.hit") is None
    assert window.page.get_by_role("region", name="Numbers").get_by_text("<script>").is_visible()
    (tmp_path / "log.csv").write_text(LOG)
    window.field("Open a scenario or packet log").set_input_files(tmp_path / "log.csv")
    message = window.page.get_by_role("alert").get_by_text("network.link.file: expected links of network.nodes")
    message.wait_for()  # names of agents that are no nodes of the log
    window.field("Scenario").select_option("thesis-steady")
    window.at("thesis-steady: 3 agents")
    window.field("Open a scenario or packet log").set_input_files([])
    window.field("Open a scenario or packet log").set_input_files(tmp_path / "log.csv")
    window.at("page.toml: 2 agents")
    (tmp_path / "s.toml").write_text(
        re.sub(r"agents = 3", 'agents = 2\nnodes = ["<b>a</b>", "car"]\nlink = { file = "log.csv" }',
               to_toml(sf.load_scenario("thesis-steady").to_mapping()))
    )  # fmt: skip
    given = strict_json(run("predict", tmp_path / "s.toml", "--format", "json").stdout)
    assert window.value() == near(given["values"][0][-1])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("w.toml", "[model]\nF = 1\n", "model.H"),
        ("w.toml", "[model\n", "w.toml: not valid TOML"),
        ("w.exe", "x", "w.exe: expected a scenario or a packet log"),
        ("far.toml", '[network]\nagents = 3\nsteps = 2\nlink = { file = "/etc/passwd" }\n', "opened here before"),
        ("big.toml", "#" * 2_000_001, "a file of at most 2000000 bytes"),
    ],
)
def test_a_wrong_file_is_marked_at_its_field(window, tmp_path, name, content, message):
    before = window.value()
    (tmp_path / name).write_text(content)
    window.field("Open a scenario or packet log").set_input_files(tmp_path / name)
    window.page.get_by_text(message).first.wait_for()
    assert window.value() == before  # which is still what the other fields ask


def test_wrong_input_is_marked_with_the_words_of_the_command_line(window):
    window.fill("Metric", "var:y")
    said = run("predict", "--metric", "var:y", code=2).stderr.removeprefix("error: ").strip()
    window.page.get_by_role("alert").get_by_text(said).wait_for()
    assert window.page.locator("td.n").count() == 0
    window.fill("Metric", "std:x")
    window.at("standard deviation of x")
    window.fill("Process noise Q", "-1")
    window.page.get_by_role("alert").get_by_text("model.Q").wait_for()
    window.fill("Process noise Q", "many")
    window.page.get_by_role("alert").get_by_text("q: expected a finite number, got 'many'").wait_for()
    window.fill("Process noise Q", "4")
    window.at("standard deviation of x")
    assert window.value() == near(predicted("--metric", "std:x", "--q", "4", "--link", "0.5"))


def test_what_is_saved_has_the_numbers_shown(window):
    name, text = window.saved("Save CSV")
    rows = [row for row in csv.DictReader(io.StringIO(text)) if row["series"] == "simplified"]
    assert name == "page.csv"
    assert float(rows[-1]["value"]) == near(window.value())
    name, text = window.saved("Save figure")
    assert name == "page.svg"
    assert "<svg" in text
    name, text = window.saved("Save report")
    assert name == "page.html"
    assert "small.toml --link 0:1:0.1,0.5 --estimator local-fusion-graph" in text


def test_two_pages_and_a_reload_do_not_disturb_each_other(browser, url, window):
    other = Window(browser, url)
    other.field("Scenario").select_option("thesis-steady")
    other.at("thesis-steady")
    assert other.value() == near(predicted("thesis-steady", "--link", "0.5"))
    assert window.value() == near(predicted("--link", "0.5"))
    other.page.reload()
    other.done()
    assert other.value() == near(predicted("--link", "0.5"))
    other.context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off_at_800_and_words_can_be_read(browser, url, scheme):
    window = Window(browser, url, 800, scheme)
    time.sleep(0.3)
    wide, shown, colours = window.page.evaluate(
        """() => [document.documentElement.scrollWidth, innerWidth,
        [getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]]"""
    )
    assert wide <= shown
    ink, back = ([int(part) / 255 for part in re.findall(r"\d+", colour)[:3]] for colour in colours)

    def luminance(rgb):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    light, dark = sorted((luminance(ink), luminance(back)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) > 7
    assert (luminance(back) < 0.1) == (scheme == "dark")
    window.context.close()


def test_a_killed_server_is_said_and_numbers_are_dimmed(browser):
    with served() as (server, url):
        window = Window(browser, url)
        server.send_signal(signal.SIGINT)
        window.page.get_by_text("The server has ended").wait_for(timeout=10_000)
        assert server.wait(10) == 130
        assert server.stderr.read() == "interrupted\n"
        window.context.close()
