"""The critical value of a probability, as table, CSV, JSON and figure, with its proofs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stochfuse.questions.critical import Critical
from stochfuse.report.plot import below, canvas, labelled, titled
from stochfuse.report.table import Report, Table, number, stamped, to_csv

SCHEMA = "stochfuse.critical/1"
PRECISE = 12
"""Significant digits of probabilities."""


def critical_report(found: Critical) -> Report:
    """Return an answer in every form."""
    return Report.of(found, critical_table, critical_csv, critical_json, draw)


def critical_table(found: Critical) -> Table:
    """Return the critical value and what brackets it, under what it means and why it is so."""
    rows = [
        (f"critical {found.name}", number(found.critical, PRECISE) if found.critical else "0"),
        ("unbounded at", number(found.low, PRECISE) if found.growing is not None else "none"),
        ("bounded at", number(found.high, PRECISE) if found.high else "0"),
    ]
    return Table(_titles(found), ("result",), ("value",), tuple(rows))


def _titles(found: Critical) -> tuple[str, ...]:
    what = "the averaged covariance stays bounded"
    symbol = "µ" if found.name == "link" else found.name
    if found.high == 0:
        answer = f"No {found.name} is needed: {what} at {symbol} = 0"
    else:
        name = "link probability" if found.name == "link" else found.name
        value = number(found.critical, PRECISE) if found.critical else "0"
        answer = f"Critical {name}: {symbol} = {value}, above which {what}"
    how = "simplified formulation (54): claimed, posterior, approximate"
    return answer, f"Proved: {found.certificate}", _whom(found), how


def _whom(found: Critical) -> str:
    if isinstance(found.agent, int):
        return f"of agent {found.agent}"
    agents = _listed(found.agents)
    if found.agent == "best":
        return f"of the agent that needs least: {agents}"
    return "of all agents" + (f"; the last: {agents}" if len(found.agents) < found.scenario.network.agents else "")


def _listed(agents: Sequence[int]) -> str:
    some = ", ".join(map(str, agents[:10]))
    return some if len(agents) <= 10 else f"{some} and {len(agents) - 10} more"


def critical_csv(found: Critical) -> str:
    """One line with the answer."""
    headings = ("question", "method", "parameter", "agent", "critical", "low", "high", "certificate")
    row = ("critical", "simplified", found.name, found.agent, found.critical, found.low, found.high, found.certificate)
    return to_csv(headings, [row])


def critical_json(found: Critical) -> dict[str, Any]:
    """Return the object of schema stochfuse.critical/1."""
    grows = found.growing
    unbounded = grows and {"at": found.low, "direction": grows.X.tolist(), "rank": grows.rank, "factor": grows.factor}
    return stamped(
        SCHEMA,
        parameter=found.name,
        method="simplified",
        quantity="claimed",
        agent=found.agent,
        critical=found.critical,
        low=found.low,
        high=found.high,
        certificate=found.certificate,
        agents=list(found.agents),
        unbounded=unbounded,
        bounded={
            "at": found.high,
            "covariances": [proof.P.tolist() for proof in found.bounded],
            "margin": min(proof.margin for proof in found.bounded),
        },
        scenario=found.scenario.to_mapping(),
        meta={"description": list(_titles(found))},
    )


def draw(found: Critical) -> Any:
    """Return the figure: by what factor large covariances grow in a step, against the probability."""
    figure = canvas(7.5, 5.4)
    axes = figure.add_subplot()
    x, growth = found.curve()
    axes.plot(x, growth, color="C0", label="growth of large covariances per step")
    axes.axhline(1.0, color="C3", linestyle="--", linewidth=1, label="neither grows nor shrinks")
    axes.plot([found.critical], [np.interp(found.critical, x, growth)], "o", color="C3", label="critical")
    labelled(axes, "link probability µ" if found.name == "link" else found.name, "factor per step", zero=True)
    below(figure)
    answer, _, *about = _titles(found)
    titled(figure, answer, *about)
    return figure
