"""Is a simulator right?  Its results against the prediction, cell by cell and as a whole.

A cell is a link probability, a step and a group of like agents.  Covariances of like agents in one run are averaged
first, so that the runs of a cell are independent, and

    z = (mean − expected) / standard error

is standard normal if the simulator is right.  The standard error is the sample's; where the prediction knows the
exact variance over the
outcomes, that variance takes the place of a single agent's sample variance, so that outcomes too rare to have been
seen are reckoned with.  Two tests share the level α, Bonferroni's way:

    the largest |z|, corrected for the number of cells (finds an error anywhere)
    the sum of z² over cells and steps, decorrelated within the runs of a link (Hotelling's T²; finds a small error
    everywhere)

The simulator disagrees if either does.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import erfc, sqrt
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.metrics import Metric
from stochfuse.prediction import Prediction
from stochfuse.scenario import read_file

ALPHA = 0.001
RUN_COLUMNS = ("run", "agent", "step", "link", "covariance", "error")
MEAN_COLUMNS = ("agent", "step", "link", "covariance", "count", "std")
ROUNDING = 1e-9
"""Relative difference that is rounding, besides that of the digits in the file."""


class ResultsError(UsageError):
    """A results file that cannot be used; names line and column."""


@dataclass(frozen=True, eq=False)
class Results:
    """What a simulator found.

    Parameters
    ----------
    source : where it came from.
    link : (rows,) link probability or name of a case of each row, as text; empty text: not given.
    step, agent : (rows,) numbers from 1; agent 0: not given.
    covariance : (rows,) claimed covariance: of a run, or the mean over `count` runs.
    run : (rows,) number of the run, or None if the rows are means.
    error : (rows,) error of the estimate, not-a-number where not given; or None.
    count, std : (rows,) number of runs and their standard deviation (NaN: not given) of means, or None.
    line, what : (rows,) number of the line or record of each row, and which of the two it is.
    resolution : half a unit in the last decimal place that the covariances are given with.
    """

    source: str
    link: np.ndarray
    step: np.ndarray
    agent: np.ndarray
    covariance: np.ndarray
    run: np.ndarray | None
    error: np.ndarray | None
    count: np.ndarray | None
    std: np.ndarray | None
    line: np.ndarray
    what: str
    resolution: float

    def at(self, row: int) -> str:
        """Where a row is."""
        return f"{self.source}, {self.what} {self.line[row]}"

    @property
    def links(self) -> list[str]:
        """Different link probabilities or cases, in order of appearance."""
        return list(dict.fromkeys(self.link.tolist()))


class Cell(NamedTuple):
    """One link probability, step and group of agents.

    Parameters
    ----------
    link : text as in the file.
    row : row of the prediction.
    step : number from 1.
    agents : agents averaged, from 1.
    runs : independent runs.
    mean, error : mean covariance and its standard error.
    expected : prediction.
    z, p : z-score, and p-value corrected for the number of cells.
    agrees : whether p is above its share of α.
    """

    link: str
    row: int
    step: int
    agents: tuple[int, ...]
    runs: int
    mean: float
    error: float
    expected: float
    z: float
    p: float
    agrees: bool


class Verdict(NamedTuple):
    """The crosscheck's outcome.

    Parameters
    ----------
    agrees : whether neither test rejects at its share of α.
    alpha : probability that a right simulator is called wrong.
    cells : one per link probability, step and group.
    p_largest : p-value of the largest |z|, corrected for the number of cells.
    p_together : p-value of all cells together, or None where only means are given.
    consistency : per link text, mean squared error over mean claimed covariance, where errors are given.
    """

    agrees: bool
    alpha: float
    cells: list[Cell]
    p_largest: float
    p_together: float | None
    consistency: Mapping[str, float]


def read_results(source: str | Path) -> Results:
    """Read a simulator's results, CSV or JSON.

    Columns run, agent, step, link, covariance and optionally error, one row per run; or, already averaged, step, link,
    covariance, count and optionally agent and std.  JSON: a list of such objects, or an object with one list per
    column.

    Raises
    ------
    ResultsError
        If it is malformed; names line and column.
    """
    name, text = read_file(source)
    if not text.strip():
        raise ResultsError(f"{name}: empty; expected columns {', '.join(RUN_COLUMNS)}")
    if text.lstrip("\ufeff \t\r\n")[:1] in "[{":
        header, rows, what = _from_json(name, text.lstrip("\ufeff"))
    else:
        header, rows, what = _from_csv(name, text.lstrip("\ufeff"))
    if not rows:
        raise ResultsError(f"{name}: no rows under the headings {', '.join(header)}")
    return _checked(name, header, rows, what)


Rows = list[tuple[int, Sequence[Any]]]


def _from_csv(name: str, text: str) -> tuple[list[str], Rows, str]:
    reader = csv.reader(text.splitlines())
    header: list[str] = []
    rows: Rows = []
    for cells in reader:
        if not cells or (cells[0].lstrip().startswith("#")):
            continue
        if not header:
            header = [cell.strip().lower() for cell in cells]
            continue
        if len(cells) != len(header):
            raise ResultsError(f"{name}, line {reader.line_num}: expected {len(header)} cells, got {len(cells)}")
        rows.append((reader.line_num, cells))
    return header, rows, "line"


def _from_json(name: str, text: str) -> tuple[list[str], Rows, str]:
    try:
        made = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ResultsError(f"{name}: not valid JSON: {error}") from None
    if isinstance(made, dict) and isinstance(made.get("results"), list):
        made = made["results"]
    if isinstance(made, dict):
        lengths = {key: len(column) if isinstance(column, list) else None for key, column in made.items()}
        if len(set(lengths.values())) != 1 or None in lengths.values():
            raise ResultsError(f"{name}: expected lists of one length, one per column, got {lengths}")
        header = [str(key).lower() for key in made]
        return header, list(enumerate(zip(*made.values(), strict=True), start=1)), "record"
    if not isinstance(made, list):
        raise ResultsError(f"{name}: expected a list of records, got {type(made).__name__}")
    header, rows = [], []
    for number, record in enumerate(made, start=1):
        if not isinstance(record, dict):
            raise ResultsError(f"{name}, record {number}: expected an object, got {record!r:.40}")
        keys = [str(key).lower() for key in record]
        header = header or keys
        if set(keys) != set(header):
            raise ResultsError(f"{name}, record {number}: expected keys {', '.join(header)}, got {', '.join(keys)}")
        low = {str(key).lower(): value for key, value in record.items()}
        rows.append((number, [low[key] for key in header]))
    return header, rows, "record"


def _checked(name: str, header: list[str], rows: Rows, what: str) -> Results:
    if len(set(header)) < len(header):
        raise ResultsError(f"{name}: a column is named twice: {', '.join(header)}")
    means = "count" in header
    known = MEAN_COLUMNS if means else RUN_COLUMNS
    needed = ("step", "covariance", "count") if means else ("run", "step", "covariance")
    for column in needed:
        if column not in header:
            raise ResultsError(
                f"{name}: expected columns {', '.join(RUN_COLUMNS)} (one row per run), or {', '.join(MEAN_COLUMNS)} "
                f"(means); "
                f"column '{column}' is missing from {', '.join(header)}"
            )
    for column in header:
        if column not in known:
            raise ResultsError(f"{name}: unknown column '{column}'; expected {', '.join(known)}")
    columns = {key: [cells[i] for _, cells in rows] for i, key in enumerate(header)}
    line = np.array([number for number, _ in rows])

    def numbers(column: str, kind: str, least: float, *, optional: bool = False) -> np.ndarray:
        cells = columns[column]
        try:
            if what != "line":
                raise ValueError("JSON has values that are no numbers although NumPy makes numbers of them")
            found = np.array(cells, dtype=float)
        except ValueError:
            found = np.array([_number_or_bad(cell, optional) for cell in cells])
        bad = np.isinf(found) | (found < least) | (np.isnan(found) & ~(optional & _blank(cells)))
        if kind == "a whole number":
            bad |= found != np.round(found)
        if bad.any():
            first = int(bad.argmax())
            text = f"{kind} of at least {least:g}" if np.isfinite(least) else kind
            raise ResultsError(
                f"{name}, {what} {line[first]}, column '{column}': expected {text}, got {cells[first]!r}"
            )
        return found

    def whole(column: str, least: int) -> np.ndarray:
        return numbers(column, "a whole number", least).astype(np.int64)

    results = Results(
        source=name,
        link=np.array([_link(cell) for cell in columns["link"]] if "link" in header else [""] * len(rows)),
        step=whole("step", 1),
        agent=whole("agent", 1) if "agent" in header else np.zeros(len(rows), dtype=np.int64),
        covariance=numbers("covariance", "a number", 0.0),
        run=None if means else whole("run", 0),
        error=numbers("error", "a number", -np.inf, optional=True) if "error" in header else None,
        count=whole("count", 2) if means else None,
        std=numbers("std", "a number", 0.0, optional=True) if "std" in header else None,
        line=line,
        what=what,
        resolution=_resolution(columns["covariance"]),
    )
    _check_different(results)
    return results


def _number_or_bad(cell: Any, optional: bool) -> float:
    if optional and (cell is None or cell == ""):
        return np.nan
    try:
        return -np.inf if isinstance(cell, bool) else float(cell)
    except (TypeError, ValueError):
        return -np.inf


def _blank(cells: Sequence[Any]) -> np.ndarray:
    return np.array([cell is None or cell == "" for cell in cells])


def _resolution(cells: Sequence[Any]) -> float:
    texts = [str(cell).strip().lower() for cell in cells[:10_000]]
    if any("e" in text for text in texts):
        return 0.0
    return 0.5 * 10.0 ** -max(len(text.partition(".")[2]) for text in texts)


def _link(cell: Any) -> str:
    text = str(cell).strip()
    try:
        return f"{float(text):.12g}"
    except ValueError:
        return text


def _check_different(results: Results) -> None:
    run = results.run if results.run is not None else np.zeros(len(results.step), dtype=np.int64)
    _, link = np.unique(results.link, return_inverse=True)
    order = np.lexsort((results.line, results.step, results.agent, run, link))
    keys = np.stack([link, run, results.agent, results.step])[:, order]
    same = (keys[:, 1:] == keys[:, :-1]).all(axis=0)
    if same.any():
        place = int(same.argmax())
        again = order[place : place + 2]
        raise ResultsError(
            f"{results.at(again[1])}: expected one row for each run, agent, step and link, got one that {results.what} "
            f"{results.line[again[0]]} has too"
        )


def check_results(results: Results, prediction: Prediction, metric: Metric, alpha: float = ALPHA) -> Verdict:
    """Compare a simulator's results with a prediction.

    Parameters
    ----------
    results : from `read_results`.
    prediction : with one row for each of `results.links`, in their order, and steps up to the largest.
    metric : what the column "covariance" holds.
    alpha : probability that a right simulator is called wrong.

    Returns
    -------
    Verdict

    Raises
    ------
    UsageError
        If the results do not fit the prediction.
    """
    if not 0 < alpha < 1:
        raise UsageError(f"alpha: expected a probability between 0 and 1, got {alpha:g}")
    agents = len(prediction.group_of)
    if results.agent.max() > agents:
        first = int((results.agent > agents).argmax())
        raise ResultsError(f"{results.at(first)}, column 'agent': expected 1 to {agents}, got {results.agent[first]}")
    groups = [
        tuple((np.flatnonzero(prediction.group_of == g) + 1).tolist()) for g in range(prediction.by_group.shape[2])
    ]
    if results.agent.max() == 0 and len(groups) > 1:
        raise ResultsError(f"{results.source}: the agents differ: expected a column 'agent', got none")
    raw, together = _cells_of_means(results, prediction, metric, groups), None
    if results.run is not None:
        raw, together = _cells_of_runs(results, prediction, metric, groups)
    level = alpha / 2 if together is not None else alpha
    cells = [cell._replace(p=min(1.0, cell.p * len(raw)), agrees=cell.p * len(raw) > level) for cell in raw]
    largest = min(cell.p for cell in cells)
    agrees = largest > level and (together is None or together > level)
    return Verdict(agrees, alpha, cells, largest, together, _consistency(results))


def _cells_of_runs(
    results: Results, prediction: Prediction, metric: Metric, groups: Sequence[tuple[int, ...]]
) -> tuple[list[Cell], float]:
    cells, statistic, freedom = [], 0.0, 0
    known = _exact_deviations(prediction, metric)
    run = results.run if results.run is not None else np.zeros(0, dtype=np.int64)
    for row, link in enumerate(results.links):
        here = results.link == link
        of_link, deviations = [], []
        for g, agents in enumerate(groups):
            mine = here & (np.isin(results.agent, agents) | (results.agent == 0))
            expected = prediction.of_agent(int(agents[0]))[row]
            for step in np.unique(results.step[mine]):
                chosen = mine & (results.step == step)
                runs, of_run = np.unique(run[chosen], return_inverse=True)
                values = np.bincount(of_run, results.covariance[chosen]) / np.bincount(of_run)
                if len(runs) < 2:
                    raise ResultsError(f"{results.source}: link {link}, step {step}: expected at least 2 runs, got 1")
                single = float(results.covariance[chosen].std(ddof=1))
                error = _standard_error(values, single, None if known is None else known[g][row, step - 1])
                target = float(metric.of(expected[step - 1]))
                mean, exact = float(values.mean()), results.resolution
                of_link.append(_cell(link, row, int(step), agents, len(runs), mean, error, target, exact))
                deviations.append((runs, values))
        cells += of_link
        t, f = _together(of_link, deviations)
        statistic, freedom = statistic + t, freedom + f
    return cells, _chi_squared_tail(statistic, freedom)


def _cells_of_means(
    results: Results, prediction: Prediction, metric: Metric, groups: Sequence[tuple[int, ...]]
) -> list[Cell]:
    cells = []
    if results.count is None:
        return cells
    known = _exact_deviations(prediction, metric)
    for place in range(len(results.step)):
        agent, step, row = int(results.agent[place]), int(results.step[place]), results.links.index(results.link[place])
        group = int(prediction.group_of[max(0, agent - 1)])
        std = np.nan if results.std is None else float(results.std[place])
        exact = None if known is None else float(known[group][row, step - 1])
        if np.isnan(std) and exact is None:
            raise ResultsError(
                f"{results.at(place)}, column 'std': expected a number, since method {prediction.method} does not "
                f"know the "
                "spread over the outcomes"
            )
        deviation = std if exact is None else exact
        count = int(results.count[place])
        expected = float(metric.of(prediction.by_group[row, step - 1, group]))
        agents = (agent,) if agent else groups[group]
        error = deviation / sqrt(count)
        mean = float(results.covariance[place])
        text = str(results.link[place])
        cells.append(_cell(text, row, step, agents, count, mean, error, expected, results.resolution))
    return cells


def _cell(
    link: str,
    row: int,
    step: int,
    agents: Sequence[int],
    runs: int,
    mean: float,
    error: float,
    expected: float,
    resolution: float,
) -> Cell:
    difference = mean - expected
    if abs(difference) <= ROUNDING * abs(expected) + (resolution if error == 0 else 0.0):
        z = 0.0
    else:
        z = difference / error if error > 0 else float(np.copysign(np.inf, difference))
    return Cell(link, row, step, tuple(map(int, agents)), runs, mean, error, expected, z, erfc(abs(z) / sqrt(2)), True)


def _exact_deviations(prediction: Prediction, metric: Metric) -> list[np.ndarray] | None:
    """Standard deviation of one agent's covariance over the outcomes, (rows, steps) per group, where it is known."""
    if prediction.outcomes is None:
        return None
    return [prediction.outcomes.statistic("std", metric, [g]) for g in range(prediction.by_group.shape[2])]


def _standard_error(values: np.ndarray, single: float, exact: float | None) -> float:
    sampled = float(values.std(ddof=1))
    if exact is None:
        return sampled / sqrt(len(values))
    # the average over like agents varies less than one agent: how much less, only the sample says
    return exact * (sampled / single if single > 0 else 1.0) / sqrt(len(values))


def _together(cells: Sequence[Cell], samples: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, int]:
    """Hotelling's T² of a link's cells over the runs that all of them have, a χ² value, and its degrees of freedom."""
    varying = [i for i, cell in enumerate(cells) if cell.error > 0 and np.isfinite(cell.z)]
    if not varying:
        return 0.0, 0
    runs = samples[varying[0]][0]
    for i in varying[1:]:
        runs = np.intersect1d(runs, samples[i][0])
    if len(runs) <= 4 * len(varying):
        return 0.0, 0
    X = np.stack([samples[i][1][np.searchsorted(samples[i][0], runs)] for i in varying], axis=1)
    seen = X.std(axis=0) > ROUNDING * np.abs(X.mean(axis=0))  # what did not vary says nothing about correlation
    if not seen.any():
        return 0.0, 0
    z = np.array([cells[i].z for i in varying])[seen]
    values, vectors = np.linalg.eigh(np.corrcoef(X[:, seen], rowvar=False).reshape(len(z), len(z)))
    # directions that hardly vary are rounding
    firm = values > 1e-6
    components = (vectors.T @ z)[firm] / np.sqrt(values[firm])
    return float((components**2).sum()), int(firm.sum())


def _chi_squared_tail(statistic: float, freedom: int) -> float:
    from scipy.special import chdtrc

    return float(chdtrc(freedom, statistic)) if freedom else 1.0


def _consistency(results: Results) -> dict[str, float]:
    if results.error is None:
        return {}
    out = {}
    for link in results.links:
        chosen = (results.link == link) & ~np.isnan(results.error)
        if chosen.any():
            out[link] = float((results.error[chosen] ** 2).mean() / results.covariance[chosen].mean())
    return out
