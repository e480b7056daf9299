"""Tables at every width: no cell is ever cut."""

from __future__ import annotations

import pytest

import stochfuse as sf
from stochfuse.kalman.metrics import metric
from stochfuse.report.predictions import PredictionView, predict_table
from stochfuse.report.table import Table, to_latex, to_markdown, to_text


def table_of(preset, links=None, **options):
    s = sf.load_scenario(preset, **options)
    return predict_table(PredictionView(sf.predict(s, links, steady=True), metric(s.metric or "trace", s.model)))


TABLES = {
    "thesis": lambda: table_of("thesis-transient", steps=12),
    "cv-2d": lambda: table_of("cv-2d"),
    "fcs-demo": lambda: table_of("fcs-demo"),
    "wide numbers": lambda: table_of("thesis-transient", [0.123456, 1e-6, 1], p0=1e12, agents=1000),
}


@pytest.mark.parametrize("name", TABLES)
def test_every_cell_is_whole_at_every_width(name):
    table = TABLES[name]()
    for width in (*range(40, 80, 2), *range(80, 131, 5), 200, None):
        text = to_text(table, width)
        body = text.split("\n\n", 1)[1]
        if width is not None:
            assert max(map(len, text.splitlines())) <= width, width
        words = body.split()
        for row in table.rows:
            for cell in row[len(table.keys) :]:
                assert words.count(cell) >= sum(r.count(cell) for r in table.rows), (width, cell)
            name = row[len(table.keys) - 1]
            assert name in words or f"µ={name}" in words or row[0].split()[0] in words, (width, row)
        for heading in table.columns:  # beside each other, or turned
            assert words.count(heading) == 1 or heading.removeprefix("k=") in words, (width, heading)
        # one table at every width: nothing is broken into pieces
        assert len([line for line in body.splitlines() if set(line.strip()) == {"─"}]) == 1


def test_words_wrap_but_are_not_broken():
    table = Table(("t",), ("name", "text"), (), (("fcs-demo", "some words that are longer than the room there is"),))
    assert "fcs-demo" in to_text(table, 40).split()
    assert max(map(len, to_text(table, 40).splitlines())) <= 40


def test_markup_of_other_languages_is_escaped():
    table = Table(("a_b & 50 %",), ("x|y",), ("z",), (("[bold]", "1"),))
    assert "x\\|y" in to_markdown(table)
    assert r"a\_b \& 50 \%" in to_latex(table)
    assert "[bold]" in to_text(table)
