"""The finished file of a study, read in blocks of points."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.studies.plan import Plan

LINES = 100_000
"""Lines of a CSV file that are held at a time."""


@dataclass(frozen=True, eq=False)
class Results:
    """A finished study.

    Parameters
    ----------
    plan : what was asked.
    path : the file.
    rows, failed : numbers of rows and of failed points.
    first_errors : number and reason of the first points that failed.
    """

    plan: Plan
    path: Path
    rows: int
    failed: int
    first_errors: tuple[tuple[int, str], ...]

    def blocks(self, columns: Sequence[str], step: int | None = None) -> Iterator[dict[str, np.ndarray]]:
        """Columns of successive points at a step (default: each point's last), without the points that failed.

        Raises
        ------
        UsageError
            If there is no such column.
        """
        for rows in self._whole_points(columns):
            fine = rows["step"] > 0
            point = rows["point"]
            last = np.append(point[1:] != point[:-1], True) if step is None else rows["step"] == step
            yield {name: rows[name][fine & last] for name in columns}

    def mean_over_steps(self, column: str) -> Iterator[np.ndarray]:
        """Mean of a value column over all steps of a point, block by block as `blocks` has them."""
        for rows in self._whole_points([column]):
            fine = rows["step"] > 0
            _, place = np.unique(rows["point"][fine], return_inverse=True)
            counts = np.bincount(place)
            yield np.bincount(place, weights=rows[column][fine]) / np.maximum(counts, 1)

    def _whole_points(self, columns: Sequence[str]) -> Iterator[dict[str, np.ndarray]]:
        wanted = list(dict.fromkeys([*columns, "point", "step"]))
        read = _parquet if self.path.suffix.lower() == ".parquet" else _csv
        known = {axis.name for axis in self.plan.axes} | {"point", "step", "method", "estimator", "nature", "error"}
        for name in wanted:
            if name not in known and name not in self.plan.columns:
                raise UsageError(f"no column '{name}': the value columns are {', '.join(self.plan.columns)}")
        return read(self.path, wanted, self.plan)


def _parquet(path: Path, columns: Sequence[str], plan: Plan) -> Iterator[dict[str, np.ndarray]]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        for group in range(file.num_row_groups):
            table = file.read_row_group(group, columns=list(columns))
            yield {name: _column(table[name]) for name in columns}


def _column(column: Any) -> np.ndarray:
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_dictionary(column.type):
        return np.array(column.to_pylist(), dtype=object)
    if pa.types.is_integer(column.type):
        return pc.fill_null(column, 0).to_numpy()
    return column.to_numpy()


def _csv(path: Path, columns: Sequence[str], plan: Plan) -> Iterator[dict[str, np.ndarray]]:
    kinds = {axis.name: axis.kind for axis in plan.axes} | dict.fromkeys(plan.columns, "float")
    kinds |= {"point": "int", "step": "int"}
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        header = next(reader)
        places, point = [header.index(name) for name in columns], header.index("point")
        held: list[list[str]] = []
        while lines := list(islice(reader, LINES)):
            held += lines
            # the last point may go on in the next lines
            last = next(i for i in range(len(held) - 1, -1, -1) if i == 0 or held[i - 1][point] != held[-1][point])
            if last:
                yield _parsed(held[:last], places, columns, kinds)
                held = held[last:]
        if held:
            yield _parsed(held, places, columns, kinds)


def _parsed(
    lines: list[list[str]], places: Sequence[int], columns: Sequence[str], kinds: dict[str, str]
) -> dict[str, np.ndarray]:
    found = {}
    for place, name in zip(places, columns, strict=True):
        cells = [line[place] for line in lines]
        kind = kinds.get(name, "text")
        if kind == "int":
            found[name] = np.array([int(cell or 0) for cell in cells])
        elif kind == "float":
            found[name] = np.array([float(cell or "nan") for cell in cells])
        else:
            found[name] = np.array([cell or None for cell in cells], dtype=object)
    return found
