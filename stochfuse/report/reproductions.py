"""What the thesis found beside what is found here, as tables, CSV, JSON and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from stochfuse.report.plot import DASHES, MARKERS, band, canvas, labelled, shades, titled, wrapped
from stochfuse.report.table import Report, Table, number, stamped, to_csv

SCHEMA = "stochfuse.reproduction/1"
VERDICTS = ("agrees", "differs", "explained", "open")
MEANING = (
    "agrees: our numbers meet the criterion; differs: they do not; explained: the thesis' finding and its cause are "
    "both shown by numbers; open: not decided"
)


@dataclass(frozen=True, eq=False)
class DrawnCurve:
    """One curve of a panel.

    Parameters
    ----------
    name : what it is.
    y : (points,) values.
    low, high : (points,) ends of a band around it, or None.
    at : (points,) abscissae of its own, where the panel's x only names the points; or None.
    """

    name: str
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    at: np.ndarray | None = None

    def rows(self, x_label: str) -> list[tuple[str, np.ndarray]]:
        """Name and values of everything that the curve consists of."""
        parts = ((x_label, self.at), ("", self.y), ("lowest", self.low), ("highest", self.high))
        return [(f"{self.name}{', ' * bool(what)}{what}", v) for what, v in parts if v is not None]


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over one axis.

    Parameters
    ----------
    title : what is shown: claimed or actual, exact or sampled, averaged over what.
    x_label, y_label : axes, with units.
    points : heading of every point in tables.
    x : (points,) abscissae.
    curves : the curves.
    y_range : ends of the ordinate as the thesis has it, where that is known.
    bars : whether bars are drawn, as in a histogram.
    """

    title: str
    x_label: str
    y_label: str
    points: tuple[str, ...]
    x: np.ndarray
    curves: tuple[DrawnCurve, ...]
    y_range: tuple[float, float] | None = None
    bars: bool = False


@dataclass(frozen=True)
class Finding:
    """A statement of the thesis and what our numbers say to it.

    Parameters
    ----------
    items : keys of the figures and tables that it is about.
    thesis : the statement, in our words.
    ours : our numbers.
    criterion : what the verdict follows from.
    verdict : one of `VERDICTS`.
    """

    items: tuple[str, ...]
    thesis: str
    ours: str
    criterion: str
    verdict: str


@dataclass(frozen=True)
class Sheet:
    """A figure or table of the thesis with everything that is shown for it.

    Parameters
    ----------
    key : "figure-32" or "table-3".
    title : what the thesis shows there, in our words.
    notes : what the reader should know, one sentence each.
    panels : data.
    facts : (name, in the thesis, here) for tables of parameters.
    findings : statements about it.
    """

    key: str
    title: str
    notes: tuple[str, ...] = ()
    panels: tuple[Panel, ...] = ()
    facts: tuple[tuple[str, str, str], ...] = ()
    findings: tuple[Finding, ...] = ()


def name_of(key: str) -> str:
    """Return a key for people: "figure 32"."""
    return key.replace("-", " ")


def data_tables(sheet: Sheet, digits: int = 5) -> list[Table]:
    """Return a table per panel (rows of curves, columns of points), or of the facts."""
    head = (f"Thesis {name_of(sheet.key)}: {sheet.title}", *(f"note: {note}" for note in sheet.notes))
    if sheet.facts:
        return [Table(head, ("parameter", "thesis", "here"), (), sheet.facts)]
    tables = []
    for i, panel in enumerate(sheet.panels):
        rows = [
            (name, *(number(value, digits) if value else "0" for value in values))
            for curve in panel.curves
            for name, values in curve.rows(panel.x_label)
        ]
        title = (*(head if i == 0 else ()), f"{panel.title}: {panel.y_label}, by {panel.x_label}")
        tables.append(Table(title, ("curve",), panel.points, tuple(rows)))
    return tables


def sheet_report(sheet: Sheet, digits: int = 5) -> Report:
    """Return an item in every form, the statements after its data; a figure only where it has panels."""

    def tables() -> list[Table]:
        stated = [findings_table(sheet.findings, everywhere=False)] if sheet.findings else []
        return [*data_tables(sheet, digits), *stated]

    figure = partial(draw, sheet) if sheet.panels else None
    return Report(tables, partial(_sheet_csv, sheet), partial(_sheet_json, sheet), figure)


def findings_report(findings: Sequence[Finding], title: Sequence[str] = ()) -> Report:
    """Return statements of the thesis beside our numbers in every form."""
    rows = [(" ".join(f.items), f.thesis, f.ours, f.criterion, f.verdict) for f in findings]
    csv = partial(to_csv, ("items", "thesis", "ours", "criterion", "verdict"), rows)
    record = stamped(SCHEMA, what="statements", verdicts=MEANING, statements=list(map(asdict, findings)))
    return Report(partial(findings_table, findings, title), csv, lambda: record)


def listing_report(entries: Sequence[tuple[str, str]]) -> Report:
    """Return what can be reproduced in every form."""
    title = ("What of the thesis can be reproduced: `stochfuse reproduce KEY`",)
    table = Table(title, ("key", "what it shows"), (), tuple(entries))
    record = stamped(SCHEMA, what="list", items=[{"key": key, "title": what} for key, what in entries])
    return Report(lambda: table, partial(to_csv, ("key", "title"), entries), lambda: record)


def timing_report(rows: Sequence[tuple[str, float | None, float]]) -> Report:
    """Return seconds for the same work in the thesis and here, (work, there or None, here), in every form."""
    title = (
        "Thesis 4.3: run time for three agents, five steps, µ = 0, 0.25, 0.5, 0.75, 1 (ad hoc, transient scenario)",
        "sampled and approximate values are those of `stochfuse compare`; seconds, wall clock, measured now",
    )
    keys = ("work", "thesis_s", "here_s")
    cells = tuple((work, "-" if there is None else f"{there:,.0f}", f"{here:.4g}") for work, there, here in rows)
    table = Table(title, ("work",), ("thesis [s]", "here [s]"), cells)
    record = stamped(SCHEMA, what="timing", rows=[dict(zip(keys, row, strict=True)) for row in rows])
    return Report(lambda: table, partial(to_csv, keys, rows), lambda: record)


def findings_table(findings: Sequence[Finding], title: Sequence[str] = (), *, everywhere: bool = True) -> Table:
    """Return the statements of the thesis beside our numbers, with verdicts.

    Parameters
    ----------
    everywhere : whether it is said what each statement is about.
    """
    rows = [(where(f.items), f.thesis, f"{f.ours} [{f.criterion}]", f.verdict) for f in findings]
    keys = ("where", "the thesis finds", "here [criterion]", "verdict")
    first = 0 if everywhere else 1
    return Table((*title, MEANING), keys[first:], (), tuple(row[first:] for row in rows))


def where(items: Sequence[str]) -> str:
    """Return the short names of some items: "fig. 20, 21, table 3"."""
    kinds: dict[str, list[str]] = {}
    for item in items:
        kind, _, rest = item.partition("-")
        kinds.setdefault("fig." if kind == "figure" else kind, []).append(rest)
    return ", ".join(f"{kind} {', '.join(numbers)}".strip() for kind, numbers in kinds.items())


def _sheet_csv(sheet: Sheet) -> str:
    """One line per fact, and per point of every curve."""
    rows = [(sheet.key, "", name, "", "", there, here, "") for name, there, here in sheet.facts]
    for panel in sheet.panels:
        for curve in panel.curves:
            for name, values in curve.rows(panel.x_label):
                rows += [
                    (sheet.key, panel.title, name, panel.x_label, float(x), "", float(y), panel.y_label)
                    for x, y in zip(panel.x, values, strict=True)
                ]
    return to_csv(("item", "panel", "curve", "x_name", "x", "thesis", "value", "value_name"), rows)


def _sheet_json(sheet: Sheet) -> dict[str, Any]:
    return stamped(
        SCHEMA,
        what=sheet.key,
        title=sheet.title,
        notes=list(sheet.notes),
        panels=[_panel_json(panel) for panel in sheet.panels],
        facts=[{"name": name, "thesis": there, "here": here} for name, there, here in sheet.facts],
        statements=list(map(asdict, sheet.findings)),
    )


def _panel_json(panel: Panel) -> dict[str, Any]:
    curves = [
        {
            "name": curve.name,
            "y": curve.y.tolist(),
            **{key: getattr(curve, key).tolist() for key in ("low", "high", "at") if getattr(curve, key) is not None},
        }
        for curve in panel.curves
    ]
    axes = {"x_label": panel.x_label, "y_label": panel.y_label, "x": panel.x.tolist()}
    return {"title": panel.title, **axes, "points": list(panel.points), "curves": curves}


def draw(sheet: Sheet):
    """Return the figure, not shown and not registered with pyplot."""
    n = max(1, len(sheet.panels))
    columns = min(n, 2)
    figure = canvas(6.2 * columns + 0.6, 4.6 * -(-n // columns) + 0.6)
    titled(figure, f"Thesis {name_of(sheet.key)}: {sheet.title}")
    for i, panel in enumerate(sheet.panels, start=1):
        _draw_panel(figure.add_subplot(-(-n // columns), columns, i), panel)
    return figure


def _draw_panel(axes, panel: Panel) -> None:
    colors = shades(len(panel.curves))
    width = 0.8 / len(panel.curves)
    for i, (curve, color) in enumerate(zip(panel.curves, colors, strict=True)):
        x = panel.x if curve.at is None else curve.at
        style: dict[str, Any] = {"color": color, "label": curve.name}
        if panel.bars:
            axes.bar(x + (i - (len(panel.curves) - 1) / 2) * width, curve.y, width, **style)
            continue
        style |= {"linestyle": DASHES[i % len(DASHES)], "marker": MARKERS[i % len(MARKERS)], "markersize": 4}
        axes.plot(x, curve.y, **style)
        if curve.low is not None and curve.high is not None:
            band(axes, x, curve.low, curve.high, color)
    if all(curve.at is None for curve in panel.curves):
        axes.set_xticks(panel.x, panel.points)
    labelled(axes, panel.x_label, wrapped(panel.y_label, 45))
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    axes.set_title(wrapped(panel.title, 60), fontsize="small")
    few = len(panel.curves) <= 4 or len(panel.points) > 6
    axes.legend(fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2 if few else 3)
