"""What the thesis measured, measured here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

from stochfuse import __version__
from stochfuse.prediction.predict import predict
from stochfuse.report.reproductions import SCHEMA
from stochfuse.report.table import Report, Table, to_csv
from stochfuse.scenario.registry import GENERAL, MONTE_CARLO, SIMPLIFIED
from stochfuse.scenario.scenario import load_scenario

THESIS_SIMULATION, THESIS_MODEL = 12_000.0, 2.0
"""Seconds for 1000 runs of the Local Fusion Graph, and for one run of the stochastic model, thesis 4.3."""
RUNS = 1000


@dataclass(frozen=True)
class Timing:
    """Seconds for the same work in the thesis and here.

    Parameters
    ----------
    rows : (work, seconds in the thesis or None, seconds here).
    """

    rows: tuple[tuple[str, float | None, float], ...]

    def table(self) -> Table:
        """Return the table shown."""
        title = (
            "Thesis 4.3: run time for three agents, five steps, µ = 0, 0.25, 0.5, 0.75, 1 (ad hoc, transient scenario)",
            "sampled and approximate values are those of `stochfuse compare`; seconds, wall clock, measured now",
        )
        cells = tuple(
            (work, "-" if there is None else f"{there:,.0f}", f"{here:.4g}") for work, there, here in self.rows
        )
        return Table(title, ("work",), ("thesis [s]", "here [s]"), cells)

    def report(self) -> Report:
        """Return it in every form."""
        csv = partial(to_csv, ("work", "thesis_s", "here_s"), self.rows)
        return Report(self.table, csv, self.to_mapping)

    def to_mapping(self) -> dict[str, Any]:
        """Return the same for programs."""
        rows = [{"work": work, "thesis_s": there, "here_s": here} for work, there, here in self.rows]
        return {"schema": SCHEMA, "version": __version__, "what": "timing", "rows": rows}


def timing(*, workers: int | None = None) -> Timing:
    """Measure the thesis' pair: simulation and stochastic model, and the exact general formulation beside them."""
    scenario = load_scenario("thesis-transient")
    work: tuple[tuple[str, float | None, dict[str, Any]], ...] = (
        (
            f"{RUNS} Monte Carlo runs of the Local Fusion Graph",
            THESIS_SIMULATION,
            {"method": MONTE_CARLO, "runs": RUNS},
        ),
        ("simplified formulation (54)", THESIS_MODEL, {"method": SIMPLIFIED}),
        ("general formulation (49), every outcome", None, {"method": GENERAL}),
    )
    rows = []
    for name, there, how in work:
        start = perf_counter()
        settings: dict[str, Any] = {"workers": workers} if how["method"] == MONTE_CARLO else {}
        predict(scenario, None, **how, **settings)
        rows.append((name, there, perf_counter() - start))
    return Timing(tuple(rows))
