"""A simulator's results: what it claims, how far off it is, and how the two compare, per run or already averaged.

    covariance, covariance:METRIC          claimed after fusion
    squared_error, squared_error:METRIC    of what the metric says: of the trace the squared length of the error
    error:STATE, or error of one state     signed error: its mean is the bias, its mean square the actual variance
    nees                                   eᵀ P⁻¹ e, the squared error in units of what is claimed

METRIC is named as everywhere (`stochfuse.kalman.metrics`); without one it is that of the request.  One row per run,
agent, step and link; or means over `count` independent runs, with one run's deviation as `std` (of the first column)
or std:COLUMN.  A value that cannot be (a negative covariance, a NEES that is no number) is no reason to stop reading:
it is kept as evidence and left out of what is compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.columns import LABEL, NUMBER, TEXT, WHOLE, ColumnField, Columns, ColumnsError, Labels, read_columns

MEASURED = ("covariance", "error", "squared_error", "nees")
"""Columns of values, in the order in which they are compared; what follows a colon says of what."""
NOUNS = {
    "covariance": "covariances",
    "squared_error": "squared errors",
    "error": "errors",
    "nees": "NEES",
}
ResultsError = ColumnsError
"""A results file that cannot be used; names line and column."""


class Observed(NamedTuple):
    """One column of values.

    Parameters
    ----------
    column : its name.
    values : (rows,) not-a-number where there is none that can be compared.
    std : (rows,) of means one run's standard deviation, not-a-number where not given; None: of no row.
    resolution : half a unit in the last decimal place that it is written with.
    """

    column: str
    values: np.ndarray
    std: np.ndarray | None
    resolution: float

    @property
    def kind(self) -> str:
        """One of `MEASURED`."""
        return self.column.partition(":")[0]

    @property
    def of(self) -> str:
        """What follows the colon: a metric or a state; empty if nothing does."""
        return self.column.partition(":")[2]


@dataclass(frozen=True, eq=False)
class SimulatorResults:
    """What a simulator found.

    Parameters
    ----------
    table : where it came from.
    link : link probability or name of a case of each row; empty text: not given.
    step : (rows,) numbers from 1.
    agent : (rows,) number from 1 or name of each row's agent; None: not given.
    run : (rows,) number of the run, or None if the rows are means.
    count : (rows,) number of independent runs of means, or None.
    observed : columns of values, at least one.
    evidence : values that cannot be, in words.
    """

    table: Columns
    link: Labels
    step: np.ndarray
    agent: np.ndarray | Labels | None
    run: np.ndarray | None
    count: np.ndarray | None
    observed: tuple[Observed, ...]
    evidence: tuple[str, ...] = ()

    @property
    def source(self) -> str:
        """Where it came from."""
        return self.table.source

    def at(self, row: int, column: str = "") -> str:
        """Where a row is."""
        return self.table.at(row, column)

    @property
    def links(self) -> list[str]:
        """Different link probabilities or cases, in order of appearance."""
        return list(self.link.names)


def read_results(source: Any, columns: Mapping[str, str] | None = None) -> SimulatorResults:
    """Read a simulator's results.

    Parameters
    ----------
    source : path of a CSV, JSON or Parquet file, "-" for standard input, a mapping of names to arrays, or a data frame.
        Columns run, agent, step, link (all but run and step may be left out) and at least one of values, a row per run;
        or step, count, optionally agent, link and std, and at least one of values, already averaged.
    columns : names that the table has for columns, by the names here; with it, columns of other names may be there.

    Raises
    ------
    ResultsError
        If it is malformed; names line and column.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.read_results({"run": [1, 2], "step": [1, 1], "P": [50.0, 52.0]}, columns={"covariance": "P"})
    >>> [each.column for each in found.observed], found.links
    (['covariance'], [''])
    """
    table = read_columns(source, _fields, columns, others=bool(columns))
    named = [name for name in table.number if name.partition(":")[0] in MEASURED]
    named.sort(key=lambda name: MEASURED.index(name.partition(":")[0]))
    evidence: list[str] = []
    observed = tuple(_observed(table, name, named, evidence) for name in named)
    evidence += _without_values(table, named)
    results = SimulatorResults(
        table=table,
        link=_links(table),
        step=table.number["step"],
        agent=table.number["agent"] if "agent" in table.number else table.text.get("agent"),
        run=_run(table),
        count=table.number.get("count"),
        observed=observed,
        evidence=tuple(evidence),
    )
    _check_different(results)
    return results


def _fields(names: Sequence[str]) -> list[ColumnField]:
    """Columns that there must and may be; of values those that the table has."""
    low = [name.lower() for name in names]
    found = [f"{kind}:{of}" if of else kind for name in names for kind, of in [_measured(name)] if kind]
    # a row may leave something out where it has something else to say
    several = len(found) > 1
    values = [_value(name, required=True, blank=several or name == "error") for name in found or ["covariance"]]
    values += [_value(name, required=False) for name in MEASURED if name not in (found or ["covariance"])]
    fields = [
        ColumnField("agent", LABEL, 1, required=False),
        ColumnField("step", WHOLE, 1),
        ColumnField("link", TEXT, required=False, blank=True),
        *values,
    ]
    if "count" not in low:
        return [ColumnField("run", LABEL, 0), *fields]
    deviations = dict.fromkeys(["std", *(name for name in low if name.startswith("std:"))])
    spread = [ColumnField(name, NUMBER, 0, required=False, blank=True) for name in deviations]
    return [*fields, ColumnField("count", WHOLE, 2), *spread]


def _value(name: str, *, required: bool, blank: bool = True) -> ColumnField:
    least = -np.inf if name.partition(":")[0] == "error" else 0.0
    return ColumnField(name, NUMBER, least, required=required, blank=blank, free=True)


def _measured(name: str) -> tuple[str, str]:
    """What a column has values of, and of which metric or state; empty texts if it has none."""
    kind, colon, of = (part.strip() for part in name.partition(":"))
    if kind.lower() not in MEASURED or (colon and not of) or (colon and kind.lower() == "nees"):
        return "", ""
    return kind.lower(), of


def _observed(table: Columns, name: str, named: Sequence[str], evidence: list[str]) -> Observed:
    values = table.number[name].astype(float)
    blank = table.blank.get(name, np.zeros(len(values), dtype=bool))
    given, kind = int((~blank).sum()), name.partition(":")[0]
    what = name if len([other for other in named if other.startswith(kind)]) > 1 else NOUNS[kind]
    bad = np.zeros(len(values), dtype=bool)
    for text, found in (
        ("not a number", np.isnan(values) & ~blank),
        ("infinite", np.isinf(values)),
        ("negative", (values < 0) & ~np.isinf(values) & (kind != "error")),
    ):
        if found.any():
            number, first = int(found.sum()), table.line(int(found.argmax()))
            be, where = ("is", "at") if number == 1 else ("are", "first at")
            evidence.append(f"{number} of {given} {what} {be} {text}, {where} {table.what} {first}")
            bad |= found
    std = table.number.get(f"std:{name.lower()}")
    if std is None and name == named[0]:
        std = table.number.get("std")
    return Observed(name, np.where(bad, np.nan, values), std, table.resolution(name))


def _without_values(table: Columns, named: Sequence[str]) -> list[str]:
    if any(name not in table.blank for name in named):
        return []
    empty = np.all([table.blank[name] for name in named], axis=0)
    if not empty.any():
        return []
    number, first = int(empty.sum()), table.line(int(empty.argmax()))
    hold, where = ("holds", "at") if number == 1 else ("hold", "first at")
    return [f"{number} of {table.length} rows {hold} no {' and no '.join(named)}, {where} {table.what} {first}"]


def _run(table: Columns) -> np.ndarray | None:
    return table.text["run"].codes if "run" in table.text else table.number.get("run")


def _links(table: Columns) -> Labels:
    """Link probabilities written alike, 0.50 as 0.5."""
    if "link" not in table.text:
        return Labels(np.zeros(table.length, dtype=np.int32), ("",))
    codes, names = table.text["link"]
    if (codes < 0).any():
        if len(names):
            table.refuse(codes < 0, "link", "a link probability or a case, as in other rows", lambda _: "nothing")
        return Labels(np.zeros(table.length, dtype=np.int32), ("",))
    texts = [_link(name) for name in names]
    alike = list(dict.fromkeys(texts))
    return Labels(np.array([alike.index(text) for text in texts], dtype=np.int32)[codes], tuple(alike))


def _link(text: str) -> str:
    try:
        return f"{float(text):.12g}"
    except ValueError:
        return text


def _check_different(results: SimulatorResults) -> None:
    """Raise ResultsError if a row says again what another has said."""
    rows = len(results.step)
    key = results.link.codes.astype(np.int64)
    agent = results.agent.codes if isinstance(results.agent, Labels) else results.agent
    for numbers in (results.step, agent, results.run):
        if numbers is None:
            continue
        numbers = dense(numbers)
        key = key * (int(numbers.max()) + 1) + numbers
        if key.max() > 4 * rows + 1_000_000:
            key = dense(key)
    if rows and np.bincount(key).max() > 1:
        order = np.argsort(key, kind="stable")
        same = key[order][1:] == key[order][:-1]
        # of all that come again the one that does so first
        again = order[1:][same]
        second = int(again.min())
        first = int(np.flatnonzero(key == key[second])[0])
        line = results.table.line(first)
        raise ResultsError(
            f"{results.at(second)}: expected one row for each run, agent, step and link, got one that "
            f"{results.table.what} {line} has too"
        )


def dense(numbers: np.ndarray) -> np.ndarray:
    """Return numbers from 0 on in the place of some whole numbers, in their order; without sorting where it can be."""
    low, high = int(numbers.min()), int(numbers.max())
    if high - low > 4 * len(numbers) + 1_000_000:
        return np.unique(numbers, return_inverse=True)[1]
    there = np.zeros(high - low + 1, dtype=bool)
    there[numbers - low] = True
    place = np.cumsum(there, dtype=np.int64) - 1
    return place[numbers - low]
