"""A simulator's results, read from CSV or JSON and checked once; what is wrong is named by line and column."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.scenario.scenario import read_file

RUN_COLUMNS = ("run", "agent", "step", "link", "covariance", "error")
MEAN_COLUMNS = ("agent", "step", "link", "covariance", "count", "std")


class ResultsError(UsageError):
    """A results file that cannot be used; names line and column."""


@dataclass(frozen=True, eq=False)
class SimulatorResults:
    """What a simulator found.

    Parameters
    ----------
    source : where it came from.
    link : (rows,) link probability or name of a case of each row, as text; empty text: not given.
    step, agent : (rows,) numbers from 1; agent 0: not given.
    covariance : (rows,) claimed covariance: of a run, or the mean over `count` runs.
    run : (rows,) number of the run, or None if the rows are means.
    error : (rows,) error of the estimate, not-a-number where not given; or None.
    count, std : (rows,) number of independent runs and one run's standard deviation (NaN: not given) of means, or None.
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


def read_results(source: str | Path) -> SimulatorResults:
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
        under = f" under the headings {', '.join(header)}" if header else ""
        raise ResultsError(f"{name}: no rows{under}; expected columns {', '.join(RUN_COLUMNS)}")
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


def _checked(name: str, header: list[str], rows: Rows, what: str) -> SimulatorResults:
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

    results = SimulatorResults(
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


def _check_different(results: SimulatorResults) -> None:
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
