"""The page's server: whom it answers, and how it says what it cannot do."""

from __future__ import annotations

import http.client
import re
import socket
import subprocess
import sys
from html import escape

import pytest

from tests.cli.command import run

NO_BOKEH = "the page needs Bokeh: pip install 'stochfuse[page]'"


def test_without_bokeh_one_line_says_what_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "bokeh", None)
    done = run("explore", "--no-browser", code=1)
    assert done.stderr == "error: the page needs bokeh: pip install 'stochfuse[page]'\n"


def test_a_wrong_scenario_is_said_before_anything_is_served():
    assert run("explore", "thesis-transiet", code=2).stderr.startswith("error: thesis-transiet: no such file")


def test_a_port_that_is_taken_is_one_line():
    pytest.importorskip("bokeh", reason=NO_BOKEH)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run("explore", "--no-browser", "--port", port, code=2)
    assert done.stderr == f"error: --port: expected one that is free, got {port} (Address already in use)\n"


@pytest.fixture
def page():
    """A window without a browser."""
    pytest.importorskip("bokeh", reason=NO_BOKEH)
    from bokeh.document import Document

    from stochfuse.explore.page import Page
    from stochfuse.explore.state import preset

    made = Page(Document(), preset("thesis-transient"))
    made._work.ask = lambda asked: setattr(made._work, "number", made._work.number + 1)
    made._work_least.ask = lambda asked: None
    return made


def test_a_change_takes_every_number_away_and_late_answers_are_dropped(page):
    from stochfuse.explore import answers

    page._ask()
    number = page._work.number
    found = dict(answers.quick(page.asked))
    page._answered(page._work, number, "simplified", found["simplified"]())
    page._answered(page._work, number, "network", found["network"]())
    assert "58.333" not in page._numbers.text
    assert "26.271" in page._numbers.text
    page._fields["agents"].value = 4
    assert page._numbers.text == page._this.text == ""
    assert "working" in page._status.text
    page._ask()
    page._answered(page._work, number, "simplified", found["simplified"]())
    assert page._numbers.text == ""
    assert page.asked.agents == 4


def test_words_of_a_file_stay_words(page):
    from stochfuse.explore import answers
    from stochfuse.explore.state import OpenedScenario

    script = "<script>alert(1)</script>"
    mapping = {**page._given.mapping, "agent": [{"name": f"{script}{i}"} for i in range(3)]}
    mapping["model"] = {**mapping["model"], "states": [script]}
    page.asked = page._begin(OpenedScenario(f"{script}.toml", mapping))
    page._ask()
    for name, job in answers.quick(page.asked):
        page._answered(page._work, page._work.number, name, job())
    page._point("agent 0")
    texts = [page._numbers.text, page._about.text, page._this.text, page._status.text, page._keys[0].text]
    assert all("<script" not in text for text in texts)
    assert sum(escape(script) in text for text in texts) >= 3


@pytest.mark.slow
def test_pages_of_others_are_not_answered():
    pytest.importorskip("bokeh", reason=NO_BOKEH)
    words = [sys.executable, "-m", "stochfuse", "explore", "--no-browser"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as server:
        try:
            host = re.search(r"http://(127\.0\.0\.1:\d+)/", server.stderr.readline()).group(1)
            codes = {}
            for origin in (f"http://{host}", "http://evil.example"):
                asked = http.client.HTTPConnection(host, timeout=60)
                asked.request("GET", "/ws", headers={
                    "Upgrade": "websocket", "Connection": "Upgrade", "Origin": origin, "Sec-WebSocket-Version": "13",
                    "Sec-WebSocket-Key": "x3JJHMbDL1EzLkh9GBhXDw==", "Sec-WebSocket-Protocol": "bokeh, none",
                })  # fmt: skip
                codes[origin] = asked.getresponse().status
                asked.close()
            assert codes["http://evil.example"] == 403
            assert codes[f"http://{host}"] != 403
        finally:
            server.kill()
