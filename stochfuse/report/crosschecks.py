"""A crosscheck as table, CSV and JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.questions.crosscheck import Cell, Verdict
from stochfuse.questions.results import SimulatorResults
from stochfuse.report.predictions import PredictionView, counted
from stochfuse.report.table import Report, Table, number, to_csv

SCHEMA = "stochfuse.crosscheck/1"


@dataclass(frozen=True)
class CrosscheckView:
    """What is shown: the results, what was expected of them, and the verdict."""

    results: SimulatorResults
    view: PredictionView
    verdict: Verdict

    @property
    def says(self) -> str:
        """The verdict in one line."""
        v = self.verdict
        off = [cell for cell in v.cells if not cell.agrees]
        together = "" if v.p_together is None else f", p of all cells together {_p(v.p_together)}"
        cells = counted(len(v.cells), "cell")
        text = f"smallest p over {cells}, corrected: {_p(v.p_largest)}{together}; level {v.alpha:g}"
        if v.agrees:
            return f"AGREE ({text})"
        where = f"{len(off)} of {cells} differ" if off else "no single cell, but all of them together"
        return f"DISAGREE: {where} ({text})"

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is compared with what."""
        return (
            f"Crosscheck of {self.results.source}: {self.says}",
            f"against: {self.view.what}",
            self.view.whom.partition(";")[0],
            self.view.how,
            "±: standard error of the mean; p corr.: p-value times the number of cells",
        )


def _p(p: float) -> str:
    return f"{p:.2g}" if p > 1e-300 else "0"


def _agents(cell: Cell) -> str:
    first, last = cell.agents[0], cell.agents[-1]
    if cell.agents == tuple(range(first, last + 1)):
        return str(first) if first == last else f"{first}-{last}"
    return ",".join(map(str, cell.agents))


def crosscheck_report(shown: CrosscheckView) -> Report:
    """Return a verdict in every form."""
    return Report.of(shown, crosscheck_table, crosscheck_csv, crosscheck_json)


def crosscheck_table(shown: CrosscheckView) -> Table:
    """Return one row per cell."""
    digits = shown.view.digits
    rows = []
    for cell in shown.verdict.cells:
        rows.append(
            (
                cell.link,
                str(cell.step),
                _agents(cell),
                str(cell.runs),
                number(cell.mean, digits),
                f"{cell.error:.2g}",
                number(cell.expected, digits),
                f"{cell.z:+.2f}" if np.isfinite(cell.z) else "+∞" if cell.z > 0 else "−∞",
                _p(cell.p) + ("" if cell.agrees else " differs"),
            )
        )
    return Table(
        shown.titles,
        ("µ", "k", "agents"),
        ("runs", "mean", "±", "expected", "z", "p corr."),
        tuple(rows),
    )


def crosscheck_csv(shown: CrosscheckView) -> str:
    """One line per cell."""
    rows = [
        (c.link, c.step, _agents(c), c.runs, c.mean, c.error, c.expected, c.z, c.p, "agrees" if c.agrees else "differs")
        for c in shown.verdict.cells
    ]
    headings = ("link", "step", "agents", "runs", "mean", "standard_error", "expected", "z", "p_corrected", "verdict")
    return to_csv(headings, rows)


def crosscheck_json(shown: CrosscheckView) -> dict[str, Any]:
    """Return the object of schema stochfuse.crosscheck/1; a z-score that is infinite is null."""
    p, v = shown.view.prediction, shown.verdict
    return {
        "schema": SCHEMA,
        "version": __version__,
        "verdict": "agree" if v.agrees else "disagree",
        "alpha": v.alpha,
        "p_largest": v.p_largest,
        "p_together": v.p_together,
        "method": p.method,
        "quantity": p.quantity,
        "metric": shown.view.metric.name,
        "cells": [
            {
                "link": _value(c.link),
                "step": c.step,
                "agents": list(c.agents),
                "runs": c.runs,
                "mean": c.mean,
                "standard_error": c.error,
                "expected": c.expected,
                "z": c.z if np.isfinite(c.z) else None,
                "p_corrected": c.p,
                "agrees": c.agrees,
            }
            for c in v.cells
        ],
        "consistency": dict(v.consistency),
        "scenario": p.scenario.to_mapping(),
        "meta": {"description": list(shown.titles), "nature": p.nature, "notes": list(p.notes)},
    }


def _value(link: str) -> float | str:
    try:
        return float(link)
    except ValueError:
        return link
