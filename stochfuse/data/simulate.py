"""Simulate a scenario: draw truth, measurements and arrivals, and run estimators on them, beside the prediction.

What is drawn: `stochfuse.data.draw`.  The estimators are those of every other engine, on data
(`stochfuse.engines.replay`); with sensors by name the truth is measured by the true functions, and the filters are
extended ones, so that the realised error says how far the linearisation of a prediction carries.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from stochfuse.data.draw import Draws
from stochfuse.data.run import RunResult, asked_links, run_records, way_of
from stochfuse.data.writing import ARRIVALS, ESTIMATES, FIRST, MEASUREMENTS, TRUTH, EstimatesFile, RecordFiles
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.scenario.scenario import Scenario, of_scenario

FILES = (MEASUREMENTS, ARRIVALS, TRUTH, FIRST, ESTIMATES)


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
        return replace(run_records(replace(draws, write=files.write), shown, how, estimates.write), simulated=True)


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
