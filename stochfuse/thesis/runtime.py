"""What the thesis measured, measured here."""

from __future__ import annotations

from time import perf_counter
from typing import Any, NamedTuple

from stochfuse.prediction.predict import predict
from stochfuse.report.reproductions import timing_report
from stochfuse.report.table import Report
from stochfuse.scenario.registry import GENERAL, MONTE_CARLO, SIMPLIFIED

RUNS = 1000


class Timing(NamedTuple):
    """Seconds for the same work in the thesis and here: (work, seconds in the thesis or None, seconds here)."""

    rows: tuple[tuple[str, float | None, float], ...]

    def report(self) -> Report:
        """Return it in every form."""
        return timing_report(self.rows)


def timing(*, workers: int | None = None) -> Timing:
    """Measure the pair of thesis 4.3, simulation and stochastic model, and the exact general formulation."""
    work: tuple[tuple[str, float | None, dict[str, Any]], ...] = (
        (
            f"{RUNS} Monte Carlo runs of the Local Fusion Graph",
            12_000.0,
            {"method": MONTE_CARLO, "runs": RUNS, "workers": workers},
        ),
        ("simplified formulation (54)", 2.0, {"method": SIMPLIFIED}),
        ("general formulation (49), every outcome", None, {"method": GENERAL}),
    )
    rows = []
    for name, there, how in work:
        start = perf_counter()
        predict("thesis-transient", None, **how)
        rows.append((name, there, perf_counter() - start))
    return Timing(tuple(rows))
