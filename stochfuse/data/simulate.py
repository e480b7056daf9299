"""Simulate a scenario: draw truth, measurements and arrivals, and run estimators on them, beside the prediction.

What is drawn: `stochfuse.data.draw`.  The estimators are those of every other engine, on data
(`stochfuse.engines.replay`); with sensors by name the truth is measured by the true functions, and the filters are
extended ones, so that the realised error says how far the linearisation of a prediction carries.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.data.draw import drawn, drawn_arrivals
from stochfuse.data.records import NUMBERS, RecordedRuns
from stochfuse.data.run import RunResult, asked_links, run_records, way_of
from stochfuse.data.writing import ARRIVALS, ESTIMATES, FIRST, MEASUREMENTS, TRUTH, EstimatesFile, RecordFiles
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.scenario import Scenario, of_scenario

FILES = (MEASUREMENTS, ARRIVALS, TRUTH, FIRST, ESTIMATES)
DEPARTS = 1e-6
"""Largest part of its size by which a nominal path may depart from the model without a word."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Records that are drawn, in the form of those that are read (`stochfuse.data.records.Records`).

    Parameters
    ----------
    scenario : what is simulated.
    names : of the runs.
    links : one row of link probabilities.
    seed : of everything.
    files : where they are written to, or None.
    """

    scenario: Scenario
    names: tuple[str, ...]
    links: LinkRows
    seed: int
    files: RecordFiles | None = None
    given: bool = True
    """Whether arrivals come with the records."""

    @property
    def known(self) -> np.ndarray:
        """States of which the truth is known: all."""
        return np.arange(self.scenario.model.dimension)

    @property
    def with_truth(self) -> bool:
        """Whether the truth is known."""
        return True

    @property
    def notes(self) -> tuple[str, ...]:
        """What should be known of the draws."""
        nominal, model = self.scenario.nominal, self.scenario.system.model
        if nominal is None or len(model.F) < 2:
            return ()
        nominal = nominal[: len(model.F)]
        moved = (model.F[1:] @ nominal[:-1, :, None] + model.Bu[1:])[..., 0]
        off = float(np.abs(moved - nominal[1:]).max())
        if off <= DEPARTS * float(np.abs(nominal).max()):
            return ()
        return (f"the truth follows the model; the nominal path departs from it by up to {off:.3g} in a step",)

    def batches(self) -> Iterator[RecordedRuns]:
        """Draw some runs at a time."""
        system, runs = self.scenario.system, len(self.names)
        size = max(1, NUMBERS // (system.agents * system.steps))
        nominal = self.scenario.nominal
        start = system.x0 if nominal is None else nominal[0][:, None]
        for first in range(0, runs, size):
            count = min(size, runs - first)
            found = drawn(system, self.scenario.instruments, start, count, self.seed, first)
            arrivals = drawn_arrivals(system, self.links, found.missed, self.seed, first)
            batch = RecordedRuns(
                np.arange(first, first + count),
                tuple(np.nan_to_num(z) for z in found.z),
                found.relations,
                arrivals,
                found.missed,
                found.truth,
                found.first,
            )
            if self.files is not None:
                seen = [~np.isnan(z[..., 0]) for z in found.z]
                self.files.write(batch, self.names[first : first + count], seen.__getitem__)
            yield batch


@of_scenario
def simulate(
    scenario: Scenario,
    runs: int = 1,
    *,
    metric: str | None = None,
    folder: str | Path | None = None,
    force: bool = False,
    **way: Any,
) -> RunResult:
    """Simulate runs of a scenario, and run estimators on them, beside what is predicted.

    Parameters
    ----------
    runs : how many.
    metric : what errors are shown in; default: the scenario's, else trace.
    folder : where truth, measurements, arrivals, first estimates and estimates are written; made if need be.
    force : whether files that are there may be replaced.
    **way : estimator (a name or several), link, seed (of everything), criterion, predicted, see
        `stochfuse.data.run.Way`.

    Returns
    -------
    RunResult

    Raises
    ------
    UsageError
        If the scenario has no one link probability, or the folder has such files already.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.simulate(sf.load_scenario("thesis-steady", agents=2, steps=3), 50, link=0.5, estimator="optimal")
    >>> found.rows[0].verdict
    'consistent'
    """
    how = replace(way_of(way, scenario), suspected=False)
    if runs < 1:
        raise UsageError(f"runs: expected at least 1, got {runs}")
    links = asked_links(scenario, how.link)
    if len(links.link) != 1:
        cases = f" or --case with one of {', '.join(links.names)}" if links.names else ""
        raise UsageError(f"link: expected one link probability to simulate, got {len(links.link)}; give --link{cases}")
    shown = metric_of(metric or scenario.metric or "trace", scenario.model)
    draws = Draws(scenario, tuple(str(i + 1) for i in range(runs)), links, how.seed)
    if folder is None:
        return replace(run_records(draws, shown, how), simulated=True)
    where = Path(folder)
    _check_folder(where, force)
    with ExitStack() as stack:
        files = stack.enter_context(RecordFiles(where, scenario))
        estimates = stack.enter_context(EstimatesFile(where / ESTIMATES, scenario, truth=True))
        return replace(run_records(replace(draws, files=files), shown, how, estimates.write), simulated=True)


def _check_folder(folder: Path, force: bool) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder {folder}: {error.strerror or error}") from None
    there = [name for name in FILES if (folder / name).exists()]
    if there and not force:
        raise UsageError(
            f"{folder}: expected a folder without {', '.join(there)}, as they would be replaced; force replaces them"
        )
