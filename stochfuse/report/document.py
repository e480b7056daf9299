"""A result as one file to be sent: what was asked, tables, a figure, notes, what the words mean, how to do it again.

A page of HTML that needs nothing beside it, neither a network nor a script, and that prints on A4.  Everything that is
written in it is escaped; its content policy lets nothing be loaded or run.  The figure is drawn as vectors, or in dots
where those would be large, and is enlarged by a box that is ticked.
"""

from __future__ import annotations

import base64
import io
import re
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

from stochfuse import __version__
from stochfuse.errors import StochfuseError
from stochfuse.report.citations import cited
from stochfuse.report.explanations import explanations
from stochfuse.report.plot import figure_class
from stochfuse.report.table import Report, Table, to_html
from stochfuse.scenario.as_toml import to_toml

MOST_VECTORS, MOST_SCENARIO = 1_000_000, 200_000
"""Letters up to which a figure is drawn as vectors, and a scenario is shown."""
PLAIN_WORDS = {
    "stand-alone", "cyclic", "broadcast", "state", "mean", "variance", "std", "trace", "det", "burst", "delay",
}  # fmt: skip
"""Words that mean themselves in a heading."""
STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 2rem auto; max-width: 60rem;
  padding: 0 1rem; }
h1 { font-size: 1.45rem; line-height: 1.25; margin-bottom: .3rem; }
h2 { font-size: 1.1rem; margin: 1.8rem 0 .5rem; border-bottom: 1px solid #bbb; }
pre { background: #f4f4f4; padding: .6rem .8rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .7rem; text-align: right; vertical-align: top; border-bottom: 1px solid #e2e2e2; }
thead th { border-bottom: 1px solid #555; vertical-align: bottom; }
th.key, td.key { text-align: left; }
figure { margin: 0; }
figure svg, figure img { width: 100%; height: auto; max-width: 52rem; }
#larger:checked ~ figure { overflow: auto; }
#larger:checked ~ figure svg, #larger:checked ~ figure img { width: 220%; max-width: none; }
dt { font-weight: 600; } dd { margin: 0 0 .5rem 1.5rem; }
footer { margin-top: 2rem; color: #555; font-size: .85rem; }
@page { size: A4; margin: 16mm 14mm; }
@media print {
  body { font-size: 10pt; margin: 0; max-width: none; padding: 0; }
  h2, dt, .scroll div > div { break-after: avoid; }
  figure, tr, dt { break-inside: avoid; } thead { display: table-header-group; }
  th, td { padding: .1rem .5rem; } .scroll { overflow: visible; } .screen { display: none; }
  figure svg, figure img { width: 100% !important; max-width: none !important; max-height: 120mm; }
}
"""
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


class DocumentNote(NamedTuple):
    """What is told with a result.

    Parameters
    ----------
    words : of the command line that repeats it, without the program's name.
    scenario : with a scenario file's keys, and with what options changed in it.
    said : notes and warnings.
    lines : several commands that repeat it, in the place of `words`.
    """

    words: Sequence[str]
    scenario: Mapping[str, Any]
    said: Sequence[str] = ()
    lines: Sequence[str] = ()


def document(report: Report, told: DocumentNote) -> str:
    """Return a result as a page of HTML.

    Parameters
    ----------
    report : the result in every form.
    told : what stands beside it.
    """
    tables = report.table()
    tables = [tables] if isinstance(tables, Table) else list(tables)
    title = next((line for table in tables for line in table.title), "stochfuse")
    figure, why = _figure(report, title)
    notes = [*(note.removeprefix("note: ") for note in told.said), *([why] if why else [])]
    parts = {
        "Result": f'<div class="scroll">{to_html(tables)}</div>',
        "Figure": figure,
        "Notes": "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>" if notes else "",
        "What the numbers are": _words(tables, told.words),
        "The command": _again(told),
        "Scenario": _scenario(told.scenario),
        "How to cite": f"<pre>{escape(cited(told.words))}</pre>",
    }
    body = "".join(f"<section><h2>{name}</h2>{text}</section>\n" for name, text in parts.items() if text)
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n<body><main><h1>{escape(title)}</h1>\n"
        f"{body}</main>\n<footer>stochfuse {escape(__version__)}</footer></body></html>\n"
    )
    return page.encode("utf-8", "replace").decode("utf-8")


def _figure(report: Report, title: str) -> tuple[str, str]:
    """The figure within the page, and why there is none."""
    if report.draw is None:
        return "", ""
    try:
        figure_class()
        drawn = report.draw()
    except StochfuseError as error:
        return "", f"no figure: {error}"
    svg = vectors(drawn)
    label = escape(f"Figure: {title}", quote=True)
    if len(svg) <= MOST_VECTORS:
        picture = svg[svg.index("<svg") :].replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    else:
        dots = io.BytesIO()
        drawn.savefig(dots, format="png", dpi=150)
        picture = f'<img alt="{label}" src="data:image/png;base64,{base64.b64encode(dots.getvalue()).decode()}">'
    box = '<input type="checkbox" id="larger" class="screen"><label for="larger" class="screen"> larger</label>'
    return f"{box}<figure>{picture}</figure>", ""


def vectors(figure: Any) -> str:
    """Return a figure of matplotlib's as SVG, the same whenever it is drawn."""
    from matplotlib import rc_context

    out = io.StringIO()
    with rc_context({"svg.hashsalt": "stochfuse"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return out.getvalue()


def _words(tables: Sequence[Table], asked: Sequence[str]) -> str:
    """What the words mean that stand in titles, headings and names of rows, and in the command."""
    shown = [text for table in tables for text in (*table.title, *table.headings)]
    shown += [cell for table in tables for row in table.rows[:100] for cell in row[: len(table.keys)]]
    text = " ".join((*shown, *asked))
    found = [
        one for word, one in explanations().items()
        if word not in PLAIN_WORDS and re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", text)
    ]  # fmt: skip
    listed = "".join(f"<dt>{escape(one.word)}</dt><dd>{escape(one.text)}</dd>" for one in found)
    return f"<dl>{listed}</dl>" if found else ""


def _again(told: DocumentNote) -> str:
    """The command that does it again."""
    lines = told.lines or [shlex.join(("stochfuse", *told.words))]
    text = f"<pre>{escape(chr(10).join(lines))}</pre>"
    if "-" in told.words:
        text += "<p>“-” is standard input.</p>"
    return text


def _scenario(mapping: Mapping[str, Any]) -> str:
    text = to_toml(mapping) if mapping else ""
    if not text:
        return ""
    if len(text) > MOST_SCENARIO:
        return f"<p>The scenario is not shown: it has {len(text):,} letters.</p>"
    return f"<pre>{escape(text)}</pre>"
