"""What estimators made of records: realised, claimed and predicted errors, consistency, and each over the steps."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from stochfuse.data.consistency import Average
from stochfuse.data.run import Row, RunResult, Trace
from stochfuse.report.plot import band, below, canvas, labelled, look, titled
from stochfuse.report.table import Report, Table, counted, number, records_csv, stamped

SCHEMA = "stochfuse.run/1"
MOST_AGENTS = 6
"""Agents that a table shows one by one, and a figure draws."""


def run_report(found: RunResult, digits: int = 5) -> Report:
    """Return a run in every form."""
    return Report.of(found, partial(run_tables, digits=digits), run_csv, run_json, draw)


def _titles(found: RunResult) -> tuple[str, ...]:
    network, metric = found.scenario.network, found.metric
    unit = f" [{metric.unit}]" if metric.unit else ""
    arrivals = "arrivals drawn from the links" if found.drawn or found.simulated else "arrivals as recorded"
    runs = f"{counted(found.runs, 'run')} of {network.steps:,} steps"
    truth = any(row.realised is not None for row in found.rows)
    return (
        f"Estimators on data of {found.scenario.name}: {metric.label}{unit}; posterior, mean over steps",
        f"{network.agents} agents, {runs}, {arrivals}",
        "realised: x̂ − x, sampled; predicted: over noises and arrivals; given: over noises, for these arrivals"
        if truth
        else "the truth is not known: no realised error, no NEES",
    )


def run_tables(found: RunResult, digits: int = 5) -> list[Table]:
    """Return errors, and averages of NEES and NIS, each with a row for every estimator and agent."""
    rows, keys = _shown(found), ("estimator", "agent")
    errors = tuple(
        (*_named(row), *(_number(value, digits) for value in (row.realised, row.claimed, row.predicted, row.given)))
        for row in rows
    )
    tables = [Table((*_titles(found), *_beside(found)), keys, ("realised", "claimed", "predicted", "given"), errors)]
    about = {"NEES": "of x̂ − x, where the truth is known", "NIS": "of innovations, about predictions of the claim"}
    for name, averages in (("NEES", [row.nees for row in rows]), ("NIS", [row.nis for row in rows])):
        lines = tuple(
            (*_named(row), *_average(average), average.verdict)
            for row, average in zip(rows, averages, strict=True)
            if average is not None
        )
        title = f"{name} {about[name]}: the average, and what a consistent filter keeps 95 times in 100"
        if lines:
            tables.append(Table((title,), keys, (name, "from", "to", "verdict"), lines))
    return tables


def _beside(found: RunResult) -> tuple[str, ...]:
    """How far predictions are from what was realised, and by what they were made."""
    means = [row for row in found.rows if row.agent is None or found.scenario.network.agents == 1]
    away = [f"{row.estimator} {_share(row)}" for row in means if row.realised and row.predicted is not None]
    made = [f"{row.estimator} by {row.method}" for row in means if row.method]
    lines = (
        f"prediction {', '.join(away)} simulated" if found.simulated else f"prediction {', '.join(away)} realised",
    )
    return (lines if away else ()) + ((f"predicted: {'; '.join(made)}",) if made else ())


def _share(row: Row) -> str:
    share = 100.0 * (row.predicted / row.realised - 1.0)  # type: ignore[operator]
    size = f"{abs(share):.2g}" if abs(share) < 99.5 else f"{abs(share):,.0f}"
    return f"{size} % {'below' if share < 0 else 'above'}"


def _shown(found: RunResult) -> list[Row]:
    if found.scenario.network.agents <= MOST_AGENTS:
        return list(found.rows)
    return [row for row in found.rows if row.agent is None]


def _named(row: Row) -> tuple[str, str]:
    return row.estimator, "mean" if row.agent is None else str(row.agent)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else number(value, digits)


def _average(average: Average) -> tuple[str, str, str]:
    return number(average.mean, 4), number(average.low, 4), number(average.high, 4)


def _record(row: Row) -> dict[str, Any]:
    """What is known of an estimator and an agent, None for the mean over the agents and for what cannot be known."""
    averages = {}
    for name, average in (("nees", row.nees), ("nis", row.nis)):
        ends = (None, None, None) if average is None else (average.mean, average.low, average.high)
        averages |= dict(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
    return {
        "estimator": row.estimator,
        "agent": row.agent,
        "link": row.link,
        "realised": row.realised,
        "claimed": row.claimed,
        "predicted": row.predicted,
        "given_arrivals": row.given,
        "method": row.method or None,
        **averages,
        "verdict": row.verdict,
    }


def run_csv(found: RunResult) -> str:
    """One line for every estimator and agent; agent is empty for the mean over the agents."""
    of_run = {"metric": found.metric.name, "runs": found.runs, "steps": found.scenario.network.steps}
    records = [_record(row) | of_run for row in found.rows]
    return records_csv(tuple(records[0]), records)


def run_json(found: RunResult) -> dict[str, Any]:
    """Return the object of schema stochfuse.run/1; what cannot be known is null."""
    return stamped(
        SCHEMA,
        metric=found.metric.name,
        runs=found.runs,
        steps=found.scenario.network.steps,
        arrivals="drawn" if found.drawn else "recorded",
        rows=list(map(_record, found.rows)),
        suspicions=[each._asdict() for each in found.suspicions],
        scenario=found.scenario.to_mapping(),
        meta={"description": list(_titles(found)), "notes": list(found.notes)},
    )


def draw(found: RunResult) -> Any:
    """Return the figure: error and ±2σ of every agent over the steps, below it what arrived, and NEES with its band.

    Without a truth: estimates in the place of errors, and NIS in that of NEES.  Of an inertial navigation system: its
    position instead, see `stochfuse.report.navigation`.
    """
    if "navigation" in found.scenario.source and not np.isnan(found.traces[0].truth).any():
        from stochfuse.report.navigation import draw_navigation

        return draw_navigation(found, _titles(found)[:2], _averages)
    n = found.scenario.network.agents
    agents = range(min(n, MOST_AGENTS))
    columns = min(len(agents), 3)
    rows = -(-len(agents) // columns)
    known = any(not np.isnan(trace.nees).all() for trace in found.traces)
    checked = known or any(not np.isnan(trace.nis).all() for trace in found.traces)
    heights = [3.0, 1.0] * rows + ([2.2] if checked else [])
    figure = canvas(4.2 * columns + 0.6, 0.95 * sum(heights) + 1.6)
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    handles: list[Any] = []
    for place, agent in enumerate(agents):
        row, column = 2 * (place // columns), place % columns
        above = figure.add_subplot(grid[row, column])
        lines = _errors(above, found, agent)
        handles = handles or lines
        _arrived(figure.add_subplot(grid[row + 1, column], sharex=above), found, agent)
    if checked:
        _averages(figure.add_subplot(grid[len(heights) - 1, :]), found, "NEES" if known else "NIS")
    below(figure, handles)
    what = f"of the first of {found.runs:,} runs" if found.runs > 1 else "of the run"
    shown = "errors" if known else "estimates, since the truth is not known,"
    titled(figure, *_titles(found)[:2], f"{shown} and ±2σ (grey: {found.traces[0].estimator}) {what}")
    return figure


def _errors(axes: Any, found: RunResult, agent: int) -> list[Any]:
    """Errors of an agent, or its estimates where the truth is not known, with ±2σ of the first estimator."""
    state = found.metric.states[0] if found.metric.states else 0
    model = found.scenario.model
    known = not np.isnan(found.traces[0].truth[:, :, state]).all()
    k = np.arange(1, found.scenario.network.steps + 1)
    for place, trace in enumerate(found.traces):
        shown = _of(trace, agent, state, known)
        if place == 0:
            sigma = 2.0 * np.sqrt(trace.variance[:, agent, state])
            middle = np.zeros_like(sigma) if known else shown
            axes.fill_between(k, middle - sigma, middle + sigma, color="0.85", label="±2σ claimed", linewidth=0)
        axes.plot(k, shown, linewidth=1.3, label=trace.estimator, **look(place))
    unit = model.units[state]
    name = f"{'error of ' if known else ''}{model.states[state]}"
    labelled(axes, None, f"{name} [{unit}]" if unit else name)
    names = found.scenario.network.names
    axes.set_title(f"agent {names[agent] if names else agent + 1}", fontsize="small")
    axes.tick_params(labelbottom=False)
    return axes.get_legend_handles_labels()[0]


def _of(trace: Trace, agent: int, state: int, known: bool) -> np.ndarray:
    x = trace.x[:, agent, state]
    return x - trace.truth[:, min(agent, trace.truth.shape[1] - 1), state] if known else x


def _arrived(axes: Any, found: RunResult, agent: int) -> None:
    """What an agent heard, a row for each sender."""
    n = found.heard.shape[1]
    senders = [j for j in range(n) if j != agent]
    heard = found.heard[:, agent][:, senders].T
    sender, step = np.nonzero(heard)
    size = max(0.6, min(6.0, 120.0 / found.scenario.network.steps))
    axes.plot(step + 1, sender, "s", color="k", markersize=size, linestyle="none")
    names = found.scenario.network.names or [str(j + 1) for j in range(n)]
    if len(senders) <= MOST_AGENTS:
        axes.set_yticks(range(len(senders)), [names[j] for j in senders], fontsize="x-small")
    axes.set_ylim(len(senders) - 0.5, -0.5)
    axes.set_ylabel("heard", fontsize="small")
    axes.set_xlabel("step k")
    axes.xaxis.get_major_locator().set_params(integer=True)


def _averages(axes: Any, found: RunResult, name: str) -> None:
    """Averages of NEES or NIS over runs and agents, with what they keep if the agents of a run are one."""
    k = np.arange(1, found.scenario.network.steps + 1)
    each = [(trace.nees, trace.band) if name == "NEES" else (trace.nis, trace.nis_band) for trace in found.traces]
    for place, (average, kept) in enumerate(each):
        there = ~np.isnan(average)
        axes.plot(k[there], average[there], linewidth=1.3, **look(place))
        if place == 0:
            band(axes, k[there], kept[there, 0], kept[there, 1], "0.85", 1.0)
    if max(float(np.nanmax(average)) for average, _ in each) > 20.0 * float(np.nanmax(each[0][1])):
        axes.set_yscale("log")
    labelled(axes, "step k", name, whole=True)
    axes.set_title(f"{name}, mean over runs and agents (grey: where 95 % of consistent filters' lie)", fontsize="small")
