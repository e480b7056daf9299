"""A verdict's cells with the runs behind them, as whoever looks for causes wants them.

Runs in which a cell has no value are left out, unless most would be: then the cells are taken as means.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stochfuse.data.columns import Labels
from stochfuse.data.results import SimulatorResults, dense
from stochfuse.data.supposed import SQUARED, CellMean, LinkMeans
from stochfuse.kalman.metrics import metric

if TYPE_CHECKING:
    from stochfuse.data.crosscheck import Verdict

STEPS = 8
"""First steps that are looked at, or the first one there is."""
COMPLETE = 0.5
"""Share of runs with a value in every cell from which on the runs are taken."""


def blocks_behind(verdict: Verdict) -> tuple[LinkMeans, ...]:
    """Return the cells of every link probability, of the first steps, with what each run has."""
    if not verdict.cells:
        return ()
    results, model = verdict.results, verdict.prediction.scenario.model
    last = max(STEPS, min(cell.step for cell in verdict.cells))
    resolutions = {o.column: o.resolution for o in results.observed}
    who = _numbers(results, verdict.prediction.scenario.network.names)
    found = []
    for row in sorted({cell.row for cell in verdict.cells}):
        mine = [cell for cell in verdict.cells if cell.row == row and cell.step <= last and np.isfinite(cell.mean)]
        cells, columns = [], []
        for cell in mine:
            squared = cell.column.partition(":")[0] == "error" and cell.quantity == SQUARED
            sense = model.states[0] if cell.metric == "nees" else None
            resolution = resolutions[cell.column]
            cells.append(
                CellMean(
                    quantity=cell.quantity,
                    metric=metric(cell.metric if sense is None else f"var:{sense}", model),
                    step=cell.step,
                    agents=cell.agents,
                    runs=cell.runs,
                    mean=cell.mean,
                    error=cell.error if np.isfinite(cell.error) else 0.0,
                    expected=cell.expected,
                    resolution=resolution**2 if squared else resolution,
                    expected_error=cell.expected_error,
                )
            )
            columns.append((cell.column, cell.step, cell.agents, squared))
        if cells:
            values = None if results.run is None else _values(results, who, row, columns)
            found.append(LinkMeans(mine[0].link, row, tuple(cells), values))
    return tuple(found)


def _numbers(results: SimulatorResults, names: tuple[str, ...]) -> np.ndarray | None:
    """Number of every row's agent, from 1; None where none is given.  That they are agents is checked before."""
    if not isinstance(results.agent, Labels):
        return results.agent
    numbers = [names.index(name) + 1 if name in names else int(name) for name in results.agent.names]
    return np.array(numbers)[results.agent.codes]


def _values(
    results: SimulatorResults,
    who: np.ndarray | None,
    row: int,
    columns: list[tuple[str, int, tuple[int, ...], bool]],
) -> np.ndarray | None:
    """What each run has, (runs, cells), averaged over a cell's agents; None if too many runs have not all."""
    here = results.link.codes == row
    if results.run is None:
        return None
    run, by_column = dense(results.run[here]), {o.column: o.values[here] for o in results.observed}
    step, width = results.step[here], int(run.max()) + 1
    agent = None if who is None else who[here]
    found = []
    for column, k, agents, squared in columns:
        values = by_column[column] ** 2 if squared else by_column[column]
        chosen = (step == k) & ~np.isnan(values)
        if agent is not None:
            chosen &= np.isin(agent, agents)
        count = np.bincount(run[chosen], minlength=width)
        with np.errstate(invalid="ignore"):
            found.append(np.bincount(run[chosen], values[chosen], width) / count)
    table = np.stack(found, axis=1)
    complete = ~np.isnan(table).any(axis=1)
    return table[complete] if complete.mean() >= COMPLETE and complete.sum() > 1 else None
