"""Columns of a table by name, from wherever the table is: CSV, Parquet, JSON, standard input, arrays or a data frame.

The reader says what it wants as `ColumnField`s, and gets NumPy columns that need no further check:

    number   float64; NaN where the cell is empty
    whole    int64
    text     codes into a tuple of different texts, in order of appearance; −1 where the cell is empty
    label    whole numbers if the first cell is one, else text: numbers or names of runs

Everything else is refused with its place: "results.csv, line 7, column 'step': expected …, got …".  Lines of CSV and
records of JSON and Parquet count from 1; rows of arrays and data frames from 0, as `iloc` does.

How files are read, and what separates cells and lines, is said in `stochfuse.data.tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.tables import (
    LABEL,
    NUMBER,
    TEXT,
    WHOLE,
    ColumnsError,
    Labels,
    NumberColumn,
    OpenedTable,
    Raw,
    opened,
    plain,
)
from stochfuse.errors import nearest

EXACT = 2.0**53
"""Largest whole number up to which all are told apart."""
SAMPLE = 10_000
"""Cells whose texts are kept, to see with how many digits they are given."""


class ColumnField(NamedTuple):
    """What a reader wants of a column.

    Parameters
    ----------
    name : of the column.
    kind : NUMBER, WHOLE, TEXT or LABEL.
    least : smallest number that is allowed.
    required : whether the column must be there.
    blank : whether cells may be empty.
    free : whether not-a-number, infinity and what is less than `least` are values like others, for the reader to judge.
    """

    name: str
    kind: str = NUMBER
    least: float = -np.inf
    required: bool = True
    blank: bool = False
    free: bool = False

    @property
    def expected(self) -> str:
        """What a cell should be, in words."""
        if self.kind == TEXT:
            return "a text"
        noun = "a number" if self.kind == NUMBER else "a whole number"
        return f"{noun} of at least {self.least:g}" if np.isfinite(self.least) else noun


Fields = Sequence[ColumnField] | Callable[[Sequence[str]], Sequence[ColumnField]]
"""What is wanted; or what says so once the names of the columns are known."""
Renamed = Mapping[str, str] | Callable[[Sequence[str]], Mapping[str, str]]
"""The table's names for columns by the fields'; or what says so once they are known."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Some rows of a table.

    Parameters
    ----------
    source : where they came from.
    length : number of rows.
    number : columns of numbers by name, (rows,).
    text : columns of texts by name.
    blank : which cells are empty, (rows,), by the name of a column of numbers that has such.
    written : the first cells of columns of numbers, as texts.
    skipped : names of columns that are there and were not wanted.
    what : what `line` counts: "line", "record" or "row".
    starts, firsts : first row and its line of every stretch of rows on adjacent lines.
    """

    source: str
    length: int
    number: Mapping[str, np.ndarray]
    text: Mapping[str, Labels]
    blank: Mapping[str, np.ndarray]
    written: Mapping[str, tuple[str, ...]]
    skipped: tuple[str, ...]
    what: str
    starts: np.ndarray
    firsts: np.ndarray

    def __len__(self) -> int:
        return self.length

    def __contains__(self, name: str) -> bool:
        return name in self.number or name in self.text

    def line(self, row: int) -> int:
        """Return the line or record of a row."""
        stretch = int(np.searchsorted(self.starts, row, side="right")) - 1
        return int(self.firsts[stretch] + row - self.starts[stretch])

    def at(self, row: int, column: str = "") -> str:
        """Return where a row (and one of its columns) is, as messages begin."""
        where = f"{self.source}, {self.what} {self.line(row)}"
        return f"{where}, column '{column}'" if column else where

    def said(self, row: int, column: str) -> str:
        """Return what a cell says: a number, or a text in quotation marks."""
        if column in self.number:
            return f"{self.number[column][row]:g}"
        codes, names = self.text[column]
        return f"'{names[codes[row]]}'"

    def refuse(self, wrong: np.ndarray, column: str, expected: str, more: Callable[[str], str] = str) -> None:
        """Raise the error of the first row that is wrong (rows,), if one is; `more` adds to what its cell says."""
        if wrong.any():
            row = int(wrong.argmax())
            raise self.error(row, column, expected, more(self.said(row, column)))

    def error(self, row: int, column: str, expected: str, got: object) -> ColumnsError:
        """Return the error of a cell that a reader cannot use."""
        return ColumnsError(f"{self.at(row, column)}: expected {expected}, got {got}")

    def resolution(self, name: str) -> float:
        """Return half a unit in the last decimal place that a column is written with; 0 for powers of ten."""
        texts = [text.strip().lower() for text in self.written.get(name, ())]
        if not texts or any("e" in text for text in texts):
            return 0.0
        return 0.5 * 10.0 ** -max(len(text.partition(".")[2]) for text in texts)


def read_columns(
    source: Any,
    fields: Fields,
    renamed: Renamed | None = None,
    *,
    others: bool = True,
    empty: bool = False,
) -> Columns:
    """Read a table.

    Parameters
    ----------
    source : path of a CSV, JSON or Parquet file; "-" for standard input; a mapping of names to arrays; or a data frame
        (anything with `columns` that gives an array by name).  JSON is a list of records, or an object with one list
        per column; either may be in an object as "results".
    fields : what is wanted, or a function that makes it of the names of the columns.
    renamed : names that the table has for columns, by the names of the fields; or a function that says which of the
        names of the columns.
    others : whether other columns may be there.
    empty : whether there may be no rows under the headings.

    Returns
    -------
    Columns
        At least one row, unless `empty`.

    Raises
    ------
    ColumnsError
        If the table cannot be read or is malformed; names line and column.
    StochfuseError
        If pyarrow is needed and not installed.

    Examples
    --------
    >>> from stochfuse.data.columns import WHOLE, Field, read_columns
    >>> found = read_columns({"step": [1, 2], "z1": [0.5, None]}, [Field("step", WHOLE), Field("z1", blank=True)])
    >>> found.number["step"], found.number["z1"]
    (array([1, 2]), array([0.5, nan]))
    """
    with ExitStack() as stack:
        return _joined(list(_parts(opened(source, stack), fields, renamed or {}, others, empty)))


def _parts(table: OpenedTable, fields: Fields, renamed: Renamed, others: bool, empty: bool) -> Iterator[Columns]:
    places, wanted, skipped = _matched(table, fields, renamed, others)
    known: dict[str, dict[str, int]] = {field.name: {} for field in wanted}
    kinds = {place: field.kind for place, field in zip(places, wanted, strict=True)}
    written: dict[str, tuple[str, ...]] = {}
    rows = 0
    for raw in table.parts(kinds):
        if not raw.length:
            continue
        if not rows:
            wanted = [_settled(field, raw, place) for place, field in zip(places, wanted, strict=True)]
            kinds.update({place: field.kind for place, field in zip(places, wanted, strict=True)})
        part = Columns(table.name, raw.length, {}, {}, {}, written, skipped, table.what, raw.starts, raw.firsts)
        checked = _checked(part, raw, places, wanted, known)
        if not rows:
            for place, field in zip(places, wanted, strict=True):
                if field.kind == NUMBER:
                    written[field.name] = _written(raw, place)
        rows += raw.length
        yield checked
    if not rows and empty:
        yield _nothing(table, wanted, skipped)
    elif not rows:
        under = f" under the headings {', '.join(table.header)}" if table.header else ""
        raise ColumnsError(f"{table.name}: no rows{under}; expected columns {_names(wanted)}")


def _nothing(table: OpenedTable, wanted: Sequence[ColumnField], skipped: tuple[str, ...]) -> Columns:
    """No rows, but with headings."""
    number = {f.name: np.zeros(0, float if f.kind == NUMBER else np.int64) for f in wanted if f.kind != TEXT}
    text = {field.name: Labels(np.zeros(0, dtype=np.int32), ()) for field in wanted if field.kind == TEXT}
    none = np.zeros(0, dtype=np.int64)
    return Columns(table.name, 0, number, text, {}, {}, skipped, table.what, none, none)


def _written(raw: Raw, place: int) -> tuple[str, ...]:
    cells = (raw.cell(row, place) for row in range(min(raw.length, SAMPLE)))
    return tuple("" if _empty(cell) else str(cell) for cell in cells)


def _names(wanted: Sequence[ColumnField]) -> str:
    return ", ".join(field.name for field in wanted)


def _matched(
    table: OpenedTable, fields: Fields, renamed: Renamed, others: bool
) -> tuple[list[int], list[ColumnField], tuple[str, ...]]:
    """Places and fields of the columns that are wanted and there, and the names of the others."""
    header = list(table.header)
    if not header:
        raise ColumnsError(
            f"{table.name}: empty; expected columns {_names(fields(()) if callable(fields) else fields)}"
        )
    if len(set(header)) < len(header):
        raise ColumnsError(f"{table.name}: a column is named twice: {', '.join(header)}")
    names: list[str | None] = list(header)
    renamed = renamed(header) if callable(renamed) else renamed
    for ours, theirs in renamed.items():
        place = _place(theirs, header)
        if place is None:
            raise ColumnsError(
                f"{table.name}: no column '{theirs}'{nearest(theirs, header)}, to be used as '{ours}'; the columns are "
                f"{', '.join(header)}"
            )
        replaced = _place(ours, names)
        if replaced is not None and replaced != place:
            names[replaced] = None
        names[place] = ours
    there = [name for name in names if name is not None]
    asked = fields(there) if callable(fields) else fields
    for ours in renamed:
        if ours not in {field.name for field in asked}:
            known = [field.name for field in asked]
            raise ColumnsError(f"columns: unknown column '{ours}'{nearest(ours, known)}; expected {', '.join(known)}")
    found = [(place, field) for field in asked if (place := _place(field.name, names)) is not None]
    used = {place for place, _ in found}
    for field in asked:
        if field.required and _place(field.name, names) is None:
            left = [header[i] for i in range(len(header)) if i not in used]
            raise ColumnsError(
                f"{table.name}: expected columns {_names(asked)}; column '{field.name}' is missing from "
                f"{', '.join(header)}{nearest(field.name, left)}; --columns OURS=THEIRS names others"
            )
    skipped = tuple(header[i] for i in range(len(header)) if i not in used)
    unknown = [name for i, name in enumerate(names) if i not in used and name is not None]
    if unknown and not others:
        near = nearest(unknown[0], [field.name for field in asked])
        raise ColumnsError(f"{table.name}: unknown column '{unknown[0]}'{near}; expected {_names(asked)}")
    return [place for place, _ in found], [field for _, field in found], skipped


def _place(name: str, names: Sequence[str | None]) -> int | None:
    """Where a name is, in exactly these letters or else in any case."""
    if name in names:
        return names.index(name)
    low = [None if other is None else other.lower() for other in names]
    return low.index(name.lower()) if name.lower() in low else None


def _settled(field: ColumnField, raw: Raw, place: int) -> ColumnField:
    """The field, of labels as its first cell says: whole numbers or texts."""
    if field.kind != LABEL:
        return field
    number = _number(raw.cell(0, place))
    return field._replace(kind=WHOLE if number is not None and number == round(number) else TEXT)


def _checked(
    part: Columns, raw: Raw, places: Sequence[int], wanted: Sequence[ColumnField], known: dict[str, dict[str, int]]
) -> Columns:
    number, text, blank = {}, {}, {}
    for place, field in zip(places, wanted, strict=True):
        found = raw.column(place, field.kind)
        if field.kind == TEXT:
            labels = found if isinstance(found, Labels) else _labelled(found)
            labels = _global(labels, known[field.name])
            bad = labels.codes < 0
            if bad.any() and not field.blank:
                row = int(bad.argmax())
                raise part.error(row, field.name, field.expected, repr(raw.cell(row, place)))
            text[field.name] = labels
            continue
        values, empty, wrong = found if isinstance(found, NumberColumn) else _numbers(found)
        bad = np.zeros(len(values), dtype=bool) if field.free else ~np.isfinite(values) | (values < field.least)
        if field.kind == WHOLE:
            bad |= (values != np.round(values)) | (np.abs(values) > EXACT)
        bad[empty] = not field.blank
        bad |= wrong
        if bad.any():
            row = int(bad.argmax())
            raise part.error(row, field.name, field.expected, repr(plain(raw.cell(row, place))))
        number[field.name] = values if field.kind == NUMBER or empty.any() else values.astype(np.int64)
        if empty.any():
            blank[field.name] = empty
    return replace(part, number=number, text=text, blank=blank)


def _number(cell: Any) -> float | None:
    """A cell as a number; None if it is none."""
    if isinstance(cell, bool | np.bool_):
        return None
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None


def _empty(cell: Any) -> bool:
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return True
    # frames have several words for what is not there
    return type(cell).__name__ in ("NAType", "NaTType")


def _numbers(cells: Sequence[Any] | np.ndarray) -> NumberColumn:
    """Cells of any kind as numbers; not-a-number that is no text is an empty cell."""
    none = np.zeros(len(cells), dtype=bool)
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "iuf":
        values = cells.astype(float)
        return NumberColumn(values, np.isnan(values), none)
    kinds = set(map(type, cells))
    if kinds <= {int, float}:
        return _numbers(np.array(cells, dtype=float))
    if kinds == {str}:
        try:
            return NumberColumn(np.array(cells, dtype=float), none, none)
        except ValueError:
            texts = np.char.strip(np.array(cells, dtype=str))
            empty = texts == ""
            try:
                return NumberColumn(np.where(empty, "nan", texts).astype(float), empty, none)
            except ValueError:
                pass
    found = [_number(cell) for cell in cells]
    values = np.array([np.nan if number is None else number for number in found])
    empty = np.array([_empty(cell) or (number != number and not isinstance(cell, str))
                      for cell, number in zip(cells, found, strict=True)], dtype=bool)  # fmt: skip
    wrong = np.array([number is None for number in found], dtype=bool) & ~empty
    return NumberColumn(values, empty, wrong)


def _labelled(cells: Any) -> Labels:
    """Cells of any kind as texts; only the different ones are looked at."""
    seen: dict[Any, int] = {}
    try:
        places = [seen.setdefault(cell, len(seen)) for cell in (cells.tolist() if hasattr(cells, "tolist") else cells)]
    except TypeError:  # lists and the like, which are no texts anyway
        return _labelled([str(cell) for cell in cells])
    texts = ["" if _empty(cell) or cell != cell else str(cell).strip() for cell in seen]
    names = tuple(name for name in dict.fromkeys(texts) if name)
    index = {name: i for i, name in enumerate(names)} | {"": -1}
    return Labels(np.array([index[text] for text in texts], dtype=np.int32)[places], names)


def _global(labels: Labels, known: dict[str, int]) -> Labels:
    """The same with the codes of all parts so far."""
    codes = np.empty(len(labels.names) + 1, dtype=np.int32)
    codes[-1] = -1
    for i, name in enumerate(labels.names):
        codes[i] = known.setdefault(name.strip(), len(known)) if name.strip() else -1
    return Labels(codes[labels.codes], tuple(known))


def _joined(parts: list[Columns]) -> Columns:
    if len(parts) == 1:
        return parts[0]
    first, offsets = parts[0], np.cumsum([0, *(part.length for part in parts)])
    number, text, blank = {}, {}, {}
    for name in first.text:
        text[name] = Labels(np.concatenate([part.text[name].codes for part in parts]), parts[-1].text[name].names)
    for name in first.number:
        if any(name in part.blank for part in parts):
            blank[name] = np.concatenate([part.blank.get(name, np.zeros(part.length, bool)) for part in parts])
        number[name] = np.concatenate([part.number[name] for part in parts])
    return replace(
        first,
        length=int(offsets[-1]),
        number=number,
        text=text,
        blank=blank,
        starts=np.concatenate([part.starts + offset for part, offset in zip(parts, offsets, strict=False)]),
        firsts=np.concatenate([part.firsts for part in parts]),
    )
