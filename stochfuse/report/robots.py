"""What robots' estimators made of a record: realised, claimed and predicted errors over the link probability, NEES."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.data.robot_errors import Channel
from stochfuse.data.robot_run import RobotRow, RobotRun
from stochfuse.report.plot import COLORS, MARKERS, below, canvas, labelled, titled
from stochfuse.report.runs import SCHEMA
from stochfuse.report.table import Report, Table, number, stamped, to_csv

METRIC = "rms:x,y"
POINTS = 400
"""Points of a curve over time."""
CHANNELS = (("speed", "of speed"), ("turn", "of turn rate"), ("range", "of range"), ("bearing", "rad"))


def robot_report(found: RobotRun, digits: int = 3) -> Report:
    """Return a run of robots in every form."""
    return Report.of(found, partial(_tables, digits=digits), _csv, robot_json, draw_robots)


def _titles(found: RobotRun) -> tuple[str, ...]:
    record = found.record
    seen = np.unique(record.sightings.subject)
    landmarks = int((seen >= len(record.robots)).sum())
    end = (record.steps - 1) * record.interval
    return (
        f"Robots of {Path(record.source).name}: root mean square error of position [m], mean over robots",
        f"{len(record.robots)} robots, {landmarks} landmarks; noises identified on the first {found.until:g} s, with "
        f"the truth{', and taken for white' if found.white else ''}; shown: the rest, to {end:g} s",
        "realised: x̂ − x, over draws of arrivals; predicted: over noises and arrivals, without the truth",
    )


def _means(found: RobotRun) -> list[RobotRow]:
    return [row for row in found.rows if row.agent is None]


def _tables(found: RobotRun, digits: int) -> list[Table]:
    errors, averages, keys = [], [], ("estimator", "µ")
    for row in _means(found):
        key = (row.estimator, f"{row.link:g}")
        values = (row.realised, row.claimed, row.predicted)
        errors.append((*key, *(number(value, digits) for value in values)))
        nees = (row.nees.mean, row.nees.low, row.nees.high, row.predicted_nees)
        averages.append((*key, *(number(value, 3) for value in nees), row.verdict))
    title = (
        "NEES: the average, what a consistent filter keeps 95 times in 100, and what is predicted; 3 if all is known"
    )
    return [
        Table(_titles(found), keys, ("realised", "claimed", "predicted"), tuple(errors)),
        Table((title,), keys, ("NEES", "from", "to", "predicted", "verdict"), tuple(averages)),
        _noises(found),
    ]


def _noises(found: RobotRun) -> Table:
    """What was identified; robots differ in their constants alone."""
    rows = []
    for name, unit in CHANNELS:
        channel: Channel = getattr(found.noises, name)
        variance = float(channel.variance.mean())
        shares = []
        for process in (channel.common, channel.subject):
            share = float(process.variance.mean()) / variance
            shares.append(f"{share:.0%}, {process.time:.2g} s" if share > 0.005 else "–")
        constants = " ".join(f"{value:+.3f}" for value in channel.mean)
        rows.append((name, f"{variance**0.5:.3f} {unit}", *shares, f"{channel.alike.mean():.1f}", constants))
    title = (
        "What sensors' errors are: deviation, shares that stay alike (of the robot, of each subject seen) and for how "
        "long, factor by which they count more than white ones, constants by robot"
    )
    return Table((title,), ("channel",), ("deviation", "robot", "subject", "factor", "constants"), tuple(rows))


HEADINGS = (
    "estimator", "agent", "link", "realised", "claimed", "predicted", "nees", "nees_low", "nees_high", "verdict",
    "predicted_nees",
)  # fmt: skip


def _values(row: RobotRow) -> tuple[Any, ...]:
    errors = (row.realised, row.claimed, row.predicted)
    nees = (row.nees.mean, row.nees.low, row.nees.high)
    return row.estimator, row.agent, row.link, *errors, *nees, row.verdict, row.predicted_nees


def _csv(found: RobotRun) -> str:
    return to_csv(HEADINGS, map(_values, found.rows))


def robot_json(found: RobotRun) -> dict[str, Any]:
    """Return the object of schema stochfuse.run/1; agent is null for the mean over robots."""
    noises = {}
    for name, _ in CHANNELS:
        c: Channel = getattr(found.noises, name)
        processes = {
            kind: {"variance": p.variance.tolist(), "time": p.time}
            for kind, p in (("common", c.common), ("subject", c.subject))
        }
        noises[name] = {"constant": c.mean.tolist(), "doubt": c.doubt.tolist(), "white": c.white.tolist(), **processes}
    return stamped(
        SCHEMA,
        metric=METRIC,
        runs=found.runs,
        steps=found.record.steps,
        arrivals="drawn",
        rows=[dict(zip(HEADINGS, _values(row), strict=True)) for row in found.rows],
        noises=noises | {"turning_loss": found.noises.turning_loss, "gross": found.noises.gross},
        meta={"description": list(_titles(found))},
    )


def draw_robots(found: RobotRun) -> Any:
    """Return the figure: errors over the link probability, and each robot alone with what was predicted of it."""
    robots = found.record.robots
    figure = canvas(10.5, 6.4)
    grid = figure.add_gridspec(len(robots), 2)
    left = figure.add_subplot(grid[:, 0])
    names = list(dict.fromkeys(row.estimator for row in found.rows))
    for place, name in enumerate(names):
        rows = [row for row in _means(found) if row.estimator == name]
        link = [row.link for row in rows]
        style = {"color": COLORS[place % len(COLORS)], "marker": MARKERS[place % len(MARKERS)], "linewidth": 1.3}
        left.plot(link, [row.predicted for row in rows], dashes=(4, 2), markersize=4, markerfacecolor="w", **style)
        left.plot(link, [row.realised for row in rows], markersize=5, label=name, **style)
    labelled(left, "link probability µ", "RMS of position [m]", zero=True)
    left.set_title("realised (filled), predicted (dashed)", fontsize="small")
    below(figure)
    shown = slice(None, None, max(1, found.record.steps // POINTS))
    seconds = np.arange(found.record.steps)[shown] * found.record.interval
    first = None
    for place, robot in enumerate(robots):
        right = first = figure.add_subplot(grid[place, 1], sharex=first, sharey=first)
        right.axvspan(0, found.until, color="0.9", linewidth=0)
        right.plot(seconds, np.hypot(*found.alone[shown, place, :2].T), color="k", linewidth=1.2)
        deviation = np.hypot(*found.alone_deviation[shown, place, :2].T)
        right.plot(seconds, deviation, color=COLORS[0], linewidth=1.2, dashes=(4, 2))
        right.set_ylabel(f"robot {robot} [m]", fontsize="small")
        right.tick_params(labelbottom=place == len(robots) - 1)
        right.grid(alpha=0.3)
        if not place:
            title = "robots alone: realised, predicted deviation (dashed); grey: noises identified"
            right.set_title(title, fontsize="small")
    if first is not None:
        first.set_ylim(bottom=0)
        first.set_xlabel("time [s]")
    titled(figure, *_titles(found)[:2])
    return figure
