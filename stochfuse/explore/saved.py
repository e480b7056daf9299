"""What the page shows, to be kept: CSV, a figure, and a report of all of it.

What curves are called, how they are dashed and coloured, and what axes and tables say, is said here once for the page
and for the files.
"""

from __future__ import annotations

import csv
import io
import shlex
from collections.abc import Sequence
from typing import Any, NamedTuple

from stochfuse.explore.answers import Curve, Line, PageAnswer
from stochfuse.explore.network import Picture
from stochfuse.explore.state import FILE, PageInput
from stochfuse.prediction.compare import EstimatorComparison
from stochfuse.questions.messages import RULES
from stochfuse.report import document
from stochfuse.report.comparisons import EstimatorView, estimator_table
from stochfuse.report.plot import COLORS, band, below, canvas, labelled, titled
from stochfuse.report.predictions import predict_csv, predict_table
from stochfuse.report.table import Report, Table, number, to_csv
from stochfuse.scenario.registry import ESTIMATORS, OPTIMAL, SIMPLIFIED

DASH = {"claimed": "dashed", "actual": "solid", "consistency": "solid", "bias": "dotted", "rms": "dotdash"}
KINDS = {"link": "link probability µ of all links", "own": "µ of all links, if alike", "power": "radio power [dBm]"}


class PageContents(NamedTuple):
    """What the page shows; what is not there yet is None.

    Parameters
    ----------
    curves : of every engine and estimator.
    picture : the network.
    load : messages, by rule and step.
    least : the least link probability for the target.
    """

    curves: Sequence[Curve]
    picture: Picture | None = None
    load: PageAnswer | None = None
    least: PageAnswer | None = None


def colour(name: str, colors: Sequence[str]) -> str:
    """Colour of a series, the same whatever else is shown."""
    place = {SIMPLIFIED: 0, OPTIMAL: 6}.get(name)
    if place is None:
        place = 1 + ESTIMATORS.index(name)
    return colors[place % len(colors)]


def lines_of(curves: Sequence[Curve], colors: Sequence[str], along: str) -> list[tuple[str, str, str, Line]]:
    """Name, colour, dashes and line of every curve, along "over" or "steps"."""
    return [
        (
            c.name if c.name in (SIMPLIFIED, OPTIMAL) and c.quantity == "claimed" else f"{c.name}, {c.quantity}",
            colour(c.name, colors),
            "dotted" if c.name == OPTIMAL and c.quantity == "claimed" else DASH[c.quantity],
            getattr(c, along),
        )
        for c in curves
    ]


def axes_of(asked: PageInput, curves: Sequence[Curve]) -> tuple[str, str]:
    """What stands along the axis of links, and up the axis of values."""
    y = curves[0].views[0].axis if curves and len(asked.quantities) == 1 else asked.measure.label
    unit = f" [{asked.measure.unit}]" if asked.measure.unit and "[" not in y else ""
    return KINDS[asked.kind], y + unit


def numbers(asked: PageInput, curves: Sequence[Curve]) -> Table:
    """The present numbers, at the last step."""
    at = {"link": f" at µ = {asked.link:g}" if asked.link is not None else ""}.get(asked.kind, " at its own links")
    view = curves[0].views[-1] if curves else None
    what = "" if view is None else f"{view.what.partition(': ')[2]}; {view.whom}"
    rows = tuple((c.name, c.quantity, _value(c.steps), c.how.replace("; ± one standard error", "")) for c in curves)
    title = f"{what}, step {asked.scenario.network.steps}{at}"
    return Table((title,), ("by", "quantity", "value [95 %]", "how exact"), (), rows)


def _value(line: Line) -> str:
    """The last value of a line, with the ends of its band."""
    text = f"{line.y[-1]:#.5g}"
    if line.low is None or line.high is None:
        return text
    return f"{text} [{line.low[-1]:.5g}, {line.high[-1]:.5g}]"


def notes(curves: Sequence[Curve]) -> list[str]:
    """What is said of the curves, once."""
    return list(dict.fromkeys(note for c in curves for view in c.views for note in view.prediction.notes))


def records(curves: Sequence[Curve]) -> str:
    """Return all curves' numbers as the command line's CSV has them, the series' names before them."""
    rows: list[dict[str, str]] = []
    for curve in curves:
        for view in curve.views:
            rows += [{"series": curve.name, **row} for row in csv.DictReader(io.StringIO(predict_csv(view)))]
    headings = list(dict.fromkeys(key for row in rows for key in row))
    return to_csv(headings, [[row.get(key, "") for key in headings] for row in rows])


def _tables(asked: PageInput, shown: PageContents) -> list[Table]:
    """The present numbers, the curves', what links are worth, and the messages."""
    views = {c.name: c.views for c in shown.curves}
    found = [numbers(asked, shown.curves)]
    found += [predict_table(view) for name in (SIMPLIFIED, OPTIMAL) for view in views.get(name, ())]
    for some, *_ in asked.groups([c.name for c in shown.curves if c.sampled]):
        compared = tuple(views[name][0].prediction for name in some if name in views)
        if compared:
            view = EstimatorView(EstimatorComparison(compared), asked.measure, asked.agent, quantities=asked.quantities)
            found.append(estimator_table(view))
    if shown.picture is not None and shown.picture.worth:
        title = ("What links are worth: the slope of the value in the probability of one link (simplified)",)
        found.append(Table(title, ("link",), ("µ", "dE/dµ", "perfect, to first order"), tuple(_worth(shown.picture))))
    if shown.load is not None:
        rows = zip(RULES, shown.load.value, strict=True)
        cells = tuple((rule, *(number(value) for value in values)) for rule, values in rows)
        columns = tuple(f"k={k + 1}" for k in range(shown.load.value.shape[1]))
        found.append(Table((shown.load.text,), ("rule",), columns, cells))
    return found


def _worth(picture: Picture) -> list[tuple[str, ...]]:
    """Links with their slopes, those first that would lower the value most if they were perfect."""
    found = [(pair, float(picture.link[pair]), slope) for pair, slope in picture.worth.items()]
    return [
        (picture.name(pair), f"{µ:.4g}", number(slope), f"{slope * (1 - µ):+.3g}")
        for pair, µ, slope in sorted(found, key=lambda one: one[2] * (1 - one[1]))
    ]


def page_of(asked: PageInput, shown: PageContents) -> str:
    """Return a page to be sent, of all that is shown."""
    lines = asked.commands([c.name for c in shown.curves if c.sampled])
    if any(FILE in line for line in lines):
        lines = [f"# {FILE} is the scenario below", *lines]
    words = [word for line in lines if not line.startswith("#") for word in shlex.split(line)[1:]]
    said = [*([shown.least.text] if shown.least is not None else []), *notes(shown.curves)]
    tables = _tables(asked, shown)
    report = Report(lambda: tables, lambda: records(shown.curves), lambda: None, lambda: _figure(asked, shown.curves))
    return document.document(report, document.DocumentNote(words, asked.scenario.to_mapping(), said, lines))


def figure_of(asked: PageInput, curves: Sequence[Curve]) -> str:
    """Return the curves as a figure, SVG.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    """
    return document.vectors(_figure(asked, curves))


def _figure(asked: PageInput, curves: Sequence[Curve]) -> Any:
    figure = canvas(10.0, 4.6)
    x, y = axes_of(asked, curves)
    for axes, along, label in zip(figure.subplots(1, 2), ("over", "steps"), (x, "step k"), strict=True):
        for name, color, dash, line in lines_of(curves, COLORS, along):
            style = "dashdot" if dash == "dotdash" else dash
            axes.plot(line.x, line.y, color=color, linestyle=style, label=name if along == "over" else None)
            if line.low is not None and line.high is not None:
                band(axes, line.x, line.low, line.high, color)
        labelled(axes, label, y)
    titled(figure, numbers(asked, curves).title[0])
    below(figure)
    return figure
