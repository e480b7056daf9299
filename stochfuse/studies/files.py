"""The answers of a study as a file, written part by part and read in blocks of points.

One row per point and step, with every key and every quantity:

    point     number of the point, from 0
    …         the varied keys, by their names; matrices and the like as JSON
    method, estimator, nature     how it was predicted; nature is exact, approximate, bound or sampled, of several
              quantities that of the least certain
    step      number of the step, from 1; empty where the point failed
    …         value columns, "claimed.trace"; empty where the point failed
    error     why the point failed, else empty

A Parquet file has one row group per chunk of points, and in its metadata the labels of the columns and the study.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.scenario.result import Result
from stochfuse.studies.evaluation import Answers
from stochfuse.studies.plan import Plan

LINES = 100_000
"""Lines of a CSV file that are held at a time."""


@dataclass(frozen=True, eq=False, repr=False)
class Results(Result):
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


FORMATS = (".parquet", ".csv")
NO_PARQUET = "Parquet files need pyarrow: pip install 'stochfuse[study]', or name an --output that ends in .csv"
FIRST_ERRORS = 5


def packed(answers: Answers) -> bytes:
    """Return answers as bytes."""
    file = io.BytesIO()
    words = json.dumps([answers.kinds, list(answers.errors.items())]).encode()
    np.savez(
        file,
        allow_pickle=False,
        steps=answers.steps,
        values=answers.values,
        what=answers.what,
        words=np.frombuffer(words, dtype=np.uint8),
    )
    return file.getvalue()


def unpacked(data: bytes) -> Answers:
    """Return the answers that bytes stand for."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        kinds, errors = json.loads(file["words"].tobytes())
        return Answers(file["steps"], file["values"], file["what"], tuple(map(tuple, kinds)), dict(errors))


def check_format(path: Path) -> None:
    """Raise UsageError unless files of such a name can be written here."""
    if path.suffix.lower() not in FORMATS:
        raise UsageError(f"--output {path}: expected a name that ends in {' or '.join(FORMATS)}")
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError:
            raise UsageError(NO_PARQUET) from None


PlanRows = dict[str, tuple[np.ndarray, Any]]
"""Columns of some rows: values and None, or of words the codes and the words that they stand for."""


class PlanColumns:
    """The columns of a plan's file, chunk by chunk."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        keys = [axis.name for axis in plan.axes]
        self.kinds = [name for name in ("method", "estimator", "nature") if name not in keys]
        self.names = ("point", *keys, *self.kinds, "step", *plan.columns, "error")

    def of(self, points: range, answers: Answers) -> PlanRows:
        """Columns of some points."""
        rows = answers.rows
        first = np.concatenate([[0], np.cumsum(rows)])[:-1]
        failed = np.repeat(answers.steps == 0, rows)
        found: PlanRows = {"point": (np.repeat(np.array(points), rows), None)}
        for axis, codes in zip(self.plan.axes, self.plan.codes(points).values(), strict=True):
            words = axis.column if axis.kind == "text" else None
            found[axis.name] = (np.repeat(codes if words is not None else axis.shown(codes), rows), words)
        for place, name in enumerate(("method", "estimator", "nature")):
            if name in self.kinds:
                words = [kind[place] for kind in answers.kinds]
                unsaid = np.array([not word for word in words])[answers.what]
                found[name] = (np.ma.array(np.repeat(answers.what, rows), mask=np.repeat(unsaid, rows)), words)
        step = np.arange(1, len(failed) + 1) - np.repeat(first, rows)
        found["step"] = (np.ma.array(step, mask=failed), None)
        for place, name in enumerate(self.plan.columns):
            value = answers.values[:, place]
            found[name] = (np.ma.array(value, mask=np.isnan(value)), None)
        reasons = list(dict.fromkeys(answers.errors.values()))
        place_of = {reason: place for place, reason in enumerate(reasons)}
        codes = np.zeros(len(failed), dtype=np.int32)
        for point, reason in answers.errors.items():
            codes[first[point - points.start]] = place_of[reason]
        found["error"] = (np.ma.array(codes, mask=~failed), reasons or [""])
        return found


def write_result(plan: Plan, answers: Iterator[tuple[range, Answers]], path: Path) -> dict[str, Any]:
    """Write points and their answers, in their order, as Parquet or CSV by the file's name.

    Returns
    -------
    dict
        Numbers of points, rows and failed points, and the first reasons.
    """
    columns, rows, failed = PlanColumns(plan), 0, 0
    first: list[tuple[int, str]] = []
    with (_parquet_file if path.suffix.lower() == ".parquet" else _csv_file)(path, columns) as write:
        for points, found in answers:
            write(columns.of(points, found))
            rows, failed = rows + int(found.rows.sum()), failed + len(found.errors)
            first += list(found.errors.items())[: FIRST_ERRORS - len(first)]
    return {"points": plan.size, "rows": rows, "failed": failed, "first_errors": first}


@contextmanager
def _parquet_file(path: Path, columns: PlanColumns) -> Iterator[Callable[[PlanRows], None]]:
    """A Parquet file, to which one row group after the other is written."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    plan, words = columns.plan, pa.dictionary(pa.int32(), pa.string())
    kinds = {"int": pa.int64(), "float": pa.float64(), "text": words}
    types: dict[str, Any] = {"point": pa.int64(), "step": pa.int32(), "error": words}
    types |= {axis.name: kinds[axis.kind] for axis in plan.axes}
    types |= dict.fromkeys(columns.kinds, words) | dict.fromkeys(plan.columns, pa.float64())
    labels = {name: {"label": label} for name, label in plan.labels.items()}
    fields = [pa.field(name, types[name], metadata=labels.get(name)) for name in columns.names]
    schema = pa.schema(fields, metadata={"stochfuse.study": json.dumps(plan.record)})
    text: Any = [name for name in columns.names if types[name] == words]
    with pq.ParquetWriter(path, schema, use_dictionary=text, compression="zstd") as file:
        yield lambda rows: file.write_table(pa.table([_arrow(pa, *column) for column in rows.values()], schema=schema))


def _arrow(pa: Any, values: np.ndarray, words: Any) -> Any:
    mask = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None
    plain = np.ma.getdata(values)
    if words is None:
        return pa.array(plain, mask=mask, type=pa.int32() if mask is not None and plain.dtype.kind == "i" else None)
    codes = pa.array(plain.astype(np.int32), mask=mask)
    return pa.DictionaryArray.from_arrays(codes, pa.array(words, type=pa.string()))


@contextmanager
def _csv_file(path: Path, columns: PlanColumns) -> Iterator[Callable[[PlanRows], None]]:
    """A CSV file, to which rows are written."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns.names)
        yield lambda rows: writer.writerows(zip(*(_cells(*column) for column in rows.values()), strict=True))


def _cells(values: np.ndarray, words: Any) -> list[Any]:
    cells = values.tolist()  # None where masked
    return cells if words is None else [None if cell is None else words[cell] for cell in cells]
