"""Columns of a table by name, from wherever the table is: CSV, Parquet, JSON, standard input, arrays or a data frame.

The reader says what it wants as `Field`s, and gets NumPy columns that need no further check:

    number   float64; NaN where the cell is empty
    whole    int64
    text     codes into a tuple of different texts, in order of appearance; −1 where the cell is empty
    label    whole numbers if the first cell is one, else text: numbers or names of runs

Everything else is refused with its place: "results.csv, line 7, column 'step': expected …, got …".  Lines of CSV and
records of JSON and Parquet count from 1; rows of arrays and data frames from 0, as `iloc` does.

CSV is read in blocks of whole lines, Parquet in batches, so that `read_chunks` needs no more memory for a long file
than for a short one.  pyarrow parses a block where it is installed; what it does not take (and every block without it)
goes through Python's own csv, which has the last word on what is a number and what a message says.  So both give the
same.  Lines that are blank or begin with # are skipped.  A comma, a semicolon or a tab separates cells, whichever
separates the headings.  A cell ends on its line.
"""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError, nearest, needed

NUMBER, WHOLE, TEXT, LABEL = "number", "whole", "text", "label"
BLOCK = 8_000_000
"""Bytes of a CSV file that are parsed at once."""
BATCH = 500_000
"""Rows of a Parquet file, of arrays or of records that are looked at together."""
SAMPLE = 10_000
"""Cells whose texts are kept, to see with how many digits they are given."""
SUFFIXES = (".parquet", ".pq")


class ColumnsError(UsageError):
    """A table that cannot be used; names line and column."""


class Field(NamedTuple):
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


class Labels(NamedTuple):
    """A column of texts: which of the different ones each row has.

    Parameters
    ----------
    codes : (rows,) index into `names`; −1: empty.
    names : the different texts, in order of appearance.
    """

    codes: np.ndarray
    names: tuple[str, ...]


Fields = Sequence[Field] | Callable[[Sequence[str]], Sequence[Field]]
"""What is wanted; or what says so once the names of the columns are known."""


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

    def error(self, row: int, column: str, expected: str, got: object) -> ColumnsError:
        """Return the error of a cell that a reader cannot use."""
        return ColumnsError(f"{self.at(row, column)}: expected {expected}, got {got}")

    def resolution(self, name: str) -> float:
        """Return half a unit in the last decimal place that a column is written with; 0 for powers of ten."""
        texts = [text.strip().lower() for text in self.written.get(name, ())]
        if not texts or any("e" in text for text in texts):
            return 0.0
        return 0.5 * 10.0 ** -max(len(text.partition(".")[2]) for text in texts)

    def part(self, start: int, stop: int) -> Columns:
        """Return some rows that follow each other."""
        stop = min(stop, self.length)
        first = int(np.searchsorted(self.starts, start, side="right")) - 1
        last = int(np.searchsorted(self.starts, stop, side="left"))
        starts = np.maximum(self.starts[first:last], start)
        return replace(
            self,
            length=stop - start,
            number={name: values[start:stop] for name, values in self.number.items()},
            text={name: Labels(codes[start:stop], names) for name, (codes, names) in self.text.items()},
            blank={name: mask[start:stop] for name, mask in self.blank.items()},
            starts=starts - start,
            firsts=self.firsts[first:last] + starts - self.starts[first:last],
        )


def read_columns(
    source: Any, fields: Fields, renamed: Mapping[str, str] | None = None, *, others: bool = True
) -> Columns:
    """Read a table.

    Parameters
    ----------
    source : path of a CSV, JSON or Parquet file; "-" for standard input; a mapping of names to arrays; or a data frame
        (anything with `columns` that gives an array by name).  JSON is a list of records, or an object with one list
        per column; either may be in an object as "results".
    fields : what is wanted, or a function that makes it of the names of the columns.
    renamed : names that the table has for columns, by the names of the fields.
    others : whether other columns may be there.

    Returns
    -------
    Columns
        At least one row.

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
    return _joined(list(_parts(source, fields, renamed or {}, others)))


def read_chunks(
    source: Any,
    fields: Fields,
    renamed: Mapping[str, str] | None = None,
    *,
    others: bool = True,
    rows: int = BATCH,
) -> Iterator[Columns]:
    """Read a table in chunks of at most some rows, as `read_columns` does; memory is bounded but for JSON.

    Codes of texts keep their meaning from chunk to chunk.
    """
    for part in _parts(source, fields, renamed or {}, others):
        for start in range(0, part.length, rows):
            yield part.part(start, start + rows)


class _Numbers(NamedTuple):
    """Values, not-a-number where a cell is empty or is no number; and which are which."""

    values: np.ndarray
    empty: np.ndarray
    wrong: np.ndarray


class _Raw(NamedTuple):
    """Some rows before they are checked.

    `column` gives the values of a column by its place and kind: `_Numbers`, `Labels`, or a sequence of cells that may
    be anything; `cell` one cell as it was given, which may be asked for before the first column is.
    """

    length: int
    column: Callable[[int, str], Any]
    cell: Callable[[int, int], Any]
    starts: np.ndarray
    firsts: np.ndarray


class _Table(NamedTuple):
    """Where a table comes from, its headings, and its rows part by part, given places and kinds of what is wanted."""

    name: str
    what: str
    header: tuple[str, ...]
    parts: Callable[[Mapping[int, str]], Iterator[_Raw]]


def _parts(source: Any, fields: Fields, renamed: Mapping[str, str], others: bool) -> Iterator[Columns]:
    with ExitStack() as stack:
        yield from _parts_of(_opened(source, stack), fields, renamed, others)


def _parts_of(table: _Table, fields: Fields, renamed: Mapping[str, str], others: bool) -> Iterator[Columns]:
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
    if not rows:
        under = f" under the headings {', '.join(table.header)}" if table.header else ""
        raise ColumnsError(f"{table.name}: no rows{under}; expected columns {_names(wanted)}")


def _written(raw: _Raw, place: int) -> tuple[str, ...]:
    cells = (raw.cell(row, place) for row in range(min(raw.length, SAMPLE)))
    return tuple("" if _empty(cell) else str(cell) for cell in cells)


def _names(wanted: Sequence[Field]) -> str:
    return ", ".join(field.name for field in wanted)


def _matched(
    table: _Table, fields: Fields, renamed: Mapping[str, str], others: bool
) -> tuple[list[int], list[Field], tuple[str, ...]]:
    """Places and fields of the columns that are wanted and there, and the names of the others."""
    header = list(table.header)
    if not header:
        raise ColumnsError(
            f"{table.name}: empty; expected columns {_names(fields(()) if callable(fields) else fields)}"
        )
    if len(set(header)) < len(header):
        raise ColumnsError(f"{table.name}: a column is named twice: {', '.join(header)}")
    names: list[str | None] = list(header)
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
                f"{', '.join(header)}{nearest(field.name, left)}"
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


def _settled(field: Field, raw: _Raw, place: int) -> Field:
    """The field, of labels as its first cell says: whole numbers or texts."""
    if field.kind != LABEL:
        return field
    number = _number(raw.cell(0, place))
    return field._replace(kind=WHOLE if number is not None and number == round(number) else TEXT)


def _checked(
    part: Columns, raw: _Raw, places: Sequence[int], wanted: Sequence[Field], known: dict[str, dict[str, int]]
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
        values, empty, wrong = found if isinstance(found, _Numbers) else _numbers(found)
        bad = np.zeros(len(values), dtype=bool) if field.free else ~np.isfinite(values) | (values < field.least)
        if field.kind == WHOLE:
            bad |= values != np.round(values)
        bad[empty] = not field.blank
        bad |= wrong
        if bad.any():
            row = int(bad.argmax())
            raise part.error(row, field.name, field.expected, repr(_plain(raw.cell(row, place))))
        number[field.name] = values if field.kind == NUMBER or empty.any() else values.astype(np.int64)
        if empty.any():
            blank[field.name] = empty
    return replace(part, number=number, text=text, blank=blank)


def _plain(cell: Any) -> Any:
    return cell.item() if isinstance(cell, np.generic) else cell


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


def _numbers(cells: Sequence[Any] | np.ndarray) -> _Numbers:
    """Cells of any kind as numbers; not-a-number that is no text is an empty cell."""
    none = np.zeros(len(cells), dtype=bool)
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "iuf":
        values = cells.astype(float)
        return _Numbers(values, np.isnan(values), none)
    kinds = set(map(type, cells))
    if kinds <= {int, float}:
        return _numbers(np.array(cells, dtype=float))
    if kinds == {str}:
        try:
            return _Numbers(np.array(cells, dtype=float), none, none)
        except ValueError:
            texts = np.char.strip(np.array(cells, dtype=str))
            empty = texts == ""
            try:
                return _Numbers(np.where(empty, "nan", texts).astype(float), empty, none)
            except ValueError:
                pass
    found = [_number(cell) for cell in cells]
    values = np.array([np.nan if number is None else number for number in found])
    empty = np.array([_empty(cell) or (number != number and not isinstance(cell, str))
                      for cell, number in zip(cells, found, strict=True)], dtype=bool)  # fmt: skip
    wrong = np.array([number is None for number in found], dtype=bool) & ~empty
    return _Numbers(values, empty, wrong)


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


def _opened(source: Any, stack: ExitStack) -> _Table:
    if not isinstance(source, str | Path):
        return _of_arrays(source)
    if source == "-":
        stream = sys.stdin
        if stream is None:
            raise ColumnsError("standard input: closed")
        return _of_bytes("standard input", getattr(stream, "buffer", None) or io.BytesIO(stream.read().encode()))
    if str(source) == "":
        raise ColumnsError("expected a file, got nothing")
    path = Path(source)
    try:
        stream = stack.enter_context(path.open("rb"))
        return _of_parquet(path, stream) if path.suffix.lower() in SUFFIXES else _of_bytes(str(path), stream)
    except FileNotFoundError:
        raise ColumnsError(f"{path}: no such file") from None
    except OSError as error:
        raise ColumnsError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        if isinstance(error, UsageError):
            raise
        raise ColumnsError(f"{str(path)!r}: no name that a file can have") from None


# CSV


def _of_bytes(name: str, stream: IO[bytes]) -> _Table:
    """CSV, or JSON if it begins so."""
    head = stream.read(BLOCK)
    beginning = head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    if beginning in (b"[", b"{"):
        return _of_json(name, head + stream.read())
    blocks = _blocks(name, head, stream)
    first = next(blocks, None)
    if first is None:
        return _Table(name, "line", (), lambda _: iter(()))
    heading, _, rest = first.text.partition(b"\n")
    separator = max(",;\t", key=heading.decode().count)
    header = tuple(cell.strip() for cell in _cells_of(heading, separator))

    def parts(kinds: Mapping[int, str]) -> Iterator[_Raw]:
        starts, firsts = first.starts, first.firsts
        # the headings are no row: what follows them begins on the next line that counts
        alone = len(starts) > 1 and starts[1] == 1
        starts = np.concatenate([[0], starts[2:] - 1] if alone else [[0], starts[1:] - 1])
        firsts = np.concatenate([[firsts[1]], firsts[2:]] if alone else [[firsts[0] + 1], firsts[1:]])
        yield _csv_part(name, _Block(rest, first.length - 1, starts, firsts), header, separator, kinds)
        for block in blocks:
            yield _csv_part(name, block, header, separator, kinds)

    return _Table(name, "line", header, parts)


class _Block(NamedTuple):
    """Lines of a file without those that are skipped, and their numbers as in `Columns`."""

    text: bytes
    length: int
    starts: np.ndarray
    firsts: np.ndarray


def _blocks(name: str, head: bytes, stream: IO[bytes]) -> Iterator[_Block]:
    """Whole lines, each ended by a newline."""
    kept, line, place = b"", 1, 0
    data = head.removeprefix(b"\xef\xbb\xbf")
    while data or kept:
        whole = kept + data
        data = stream.read(BLOCK)
        if data:
            end = whole.rfind(b"\n") + 1
            whole, kept = whole[:end], whole[end:]
        else:
            kept = b""
        if not whole:
            continue
        try:
            whole.decode()
        except UnicodeDecodeError as error:
            raise ColumnsError(f"{name}: not a text file in UTF-8 (byte {place + error.start})") from None
        place += len(whole)
        if b"\r" in whole:
            whole = whole.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        whole += b"" if whole.endswith(b"\n") else b"\n"
        lines = whole.count(b"\n")
        block = _without_comments(whole, line, lines)
        line += lines
        if block.length:
            yield block


def _without_comments(text: bytes, line: int, lines: int) -> _Block:
    if not (b"#" in text or b"\n\n" in text or text.startswith(b"\n")):
        return _Block(text, lines, np.array([0]), np.array([line]))
    split = text.split(b"\n")[:-1]
    kept = [i for i, each in enumerate(split) if each and not each.lstrip(b' \t"').startswith(b"#")]
    numbers = np.array(kept, dtype=np.int64) + line
    starts = np.flatnonzero(np.diff(numbers, prepend=-1) != 1)
    return _Block(b"".join(split[i] + b"\n" for i in kept), len(kept), starts, numbers[starts])


def _cells_of(line: bytes, separator: str) -> list[str]:
    return next(csv.reader([line.decode()], delimiter=separator), [])


def _csv_part(name: str, block: _Block, header: Sequence[str], separator: str, kinds: Mapping[int, str]) -> _Raw:
    """Lines that are parsed when the first column is asked for, by when the kinds are settled."""
    lines: list[bytes] = []
    parsed: list[Any] = []

    def cell(row: int, place: int) -> str:
        if not lines:
            lines.extend(block.text.split(b"\n"))
        cells = _cells_of(lines[row], separator)
        return cells[place] if place < len(cells) else ""

    def column(place: int, kind: str) -> Any:
        if not parsed:
            _check_quotes(name, block)
            by_arrow = _by_arrow(block.text, len(header), separator, kinds)
            columns = _by_csv(name, block, header, separator) if by_arrow is None else []
            parsed.append(by_arrow or (lambda place, kind: columns[place]))
        return parsed[0](place, kind)

    return _Raw(block.length, column, cell, block.starts, block.firsts)


def _line(block: _Block, row: int) -> int:
    stretch = int(np.searchsorted(block.starts, row, side="right")) - 1
    return int(block.firsts[stretch] + row - block.starts[stretch])


def _check_quotes(name: str, block: _Block) -> None:
    if b'"' not in block.text:
        return
    text = np.frombuffer(block.text, dtype=np.uint8)
    ends = np.flatnonzero(text == ord("\n"))
    odd = np.searchsorted(np.flatnonzero(text == ord('"')), ends) % 2 == 1
    if odd.any():
        row = int(odd.argmax())
        line = block.text.split(b"\n")[row].decode()
        raise ColumnsError(f"{name}, line {_line(block, row)}: expected quotation marks in pairs, got {line!r:.60}")


def _by_csv(name: str, block: _Block, header: Sequence[str], separator: str) -> list[tuple[str, ...]]:
    """All columns as texts."""
    rows = list(csv.reader(io.StringIO(block.text.decode(), newline=""), delimiter=separator))
    lengths = np.fromiter(map(len, rows), dtype=np.int64, count=len(rows))
    wrong = lengths != len(header)
    if wrong.any():
        row = int(wrong.argmax())
        raise ColumnsError(f"{name}, line {_line(block, row)}: expected {len(header)} cells, got {lengths[row]}")
    return list(zip(*rows, strict=True))


def _arrow(module: str) -> Any:
    """A module of pyarrow, or None where it is not installed."""
    try:
        return import_module(module)
    except ImportError:
        return None


def _by_arrow(text: bytes, width: int, separator: str, kinds: Mapping[int, str]) -> Callable[[int, str], Any] | None:
    """The wanted columns by pyarrow, or None where it does not take them."""
    pa, pa_csv = _arrow("pyarrow"), _arrow("pyarrow.csv")
    if pa is None or pa_csv is None or not kinds:
        return None
    words = pa.dictionary(pa.int32(), pa.string())
    types = {str(place): words if kind == TEXT else pa.float64() for place, kind in kinds.items()}
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(text),
            read_options=pa_csv.ReadOptions(column_names=[str(i) for i in range(width)], block_size=len(text) + 1),
            parse_options=pa_csv.ParseOptions(delimiter=separator),
            convert_options=pa_csv.ConvertOptions(
                column_types=types, include_columns=list(types), null_values=[""], strings_can_be_null=True
            ),
        )
    except pa.ArrowInvalid:
        return None

    return lambda place, kind: _of_arrow(table.column(str(place)), kind)


def _of_arrow(column: Any, kind: str) -> Any:
    """A column of pyarrow as what `_Raw.column` gives."""
    pa = import_module("pyarrow")
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    column = column.chunk(0) if isinstance(column, pa.ChunkedArray) else column
    words = pa.types.is_dictionary(column.type)
    if kind == TEXT and not (words or pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        return column.to_pylist()
    if kind == TEXT:
        column = column if words else column.dictionary_encode()
        codes = column.indices.fill_null(-1).to_numpy(zero_copy_only=False)
        return _in_order(Labels(codes, tuple("" if n is None else str(n) for n in column.dictionary.to_pylist())))
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_decimal(column.type):
        values = column.cast(pa.float64(), safe=False)
        empty = values.is_null().to_numpy(zero_copy_only=False)
        filled = values.fill_null(np.nan).to_numpy(zero_copy_only=False).copy()
        return _Numbers(filled, empty, np.zeros(len(filled), dtype=bool))
    return column.to_pylist()


def _in_order(labels: Labels) -> Labels:
    """The same with the texts in order of appearance, each once."""
    used, first = np.unique(labels.codes, return_index=True)
    order = [int(code) for code in used[np.argsort(first)] if code >= 0]
    codes = np.full(len(labels.names) + 1, -1, dtype=np.int32)
    codes[order] = np.arange(len(order))
    return Labels(codes[labels.codes], tuple(labels.names[code] for code in order))


# Parquet, JSON, arrays


def _of_parquet(path: Path, stream: IO[bytes]) -> _Table:
    needed("pyarrow.parquet", "study", f"{path}: Parquet needs")
    pq, pa = import_module("pyarrow.parquet"), import_module("pyarrow")
    try:
        file = pq.ParquetFile(stream)
    except (pa.ArrowInvalid, OSError) as error:
        raise ColumnsError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}") from None
    header = tuple(file.schema_arrow.names)

    def parts(kinds: Mapping[int, str]) -> Iterator[_Raw]:
        done, wanted = 0, [header[place] for place in kinds]
        for batch in file.iter_batches(BATCH, columns=wanted):
            yield _Raw(
                batch.num_rows,
                lambda place, kind, batch=batch: _of_arrow(batch.column(header[place]), kind),
                lambda row, place, batch=batch: batch.column(header[place])[row].as_py(),
                np.array([0]),
                np.array([done + 1]),
            )
            done += batch.num_rows

    return _Table(str(path), "record", header, parts)


def _of_json(name: str, text: bytes) -> _Table:
    try:
        made = json.loads(text.removeprefix(b"\xef\xbb\xbf").decode())
    except UnicodeDecodeError as error:
        raise ColumnsError(f"{name}: not a text file in UTF-8 (byte {error.start})") from None
    except (ValueError, RecursionError) as error:
        raise ColumnsError(f"{name}: not valid JSON: {error}") from None
    if isinstance(made, dict) and isinstance(made.get("results"), list | dict):
        made = made["results"]
    if isinstance(made, list):
        made = _of_records(name, made)
    lengths = {key: len(column) if isinstance(column, list) else None for key, column in made.items()}
    if len(set(lengths.values())) > 1 or None in lengths.values():
        raise ColumnsError(f"{name}: expected lists of one length, one per column, got {lengths}")
    return _of_lists(name, "record", 1, {str(key): column for key, column in made.items()})


def _of_records(name: str, records: list[Any]) -> dict[str, list[Any]]:
    header: list[str] = []
    for number, record in enumerate(records, start=1):
        if not isinstance(record, dict):
            raise ColumnsError(f"{name}, record {number}: expected an object, got {record!r:.40}")
        header = header or list(record)
        if record.keys() != set(header):
            raise ColumnsError(f"{name}, record {number}: expected keys {', '.join(header)}, got {', '.join(record)}")
    return {key: [record[key] for record in records] for key in header}


def _of_arrays(source: Any) -> _Table:
    """A mapping of arrays, or a data frame."""
    name = "data frame" if not isinstance(source, Mapping) else "arrays"
    names = list(source if isinstance(source, Mapping) else getattr(source, "columns", ()))
    if not isinstance(source, Mapping) and not names:
        raise ColumnsError(
            f"expected a file, a mapping of names to arrays or a data frame with columns, got {type(source).__name__}"
        )
    columns = {}
    for key in names:
        column = source[key]
        if getattr(column, "ndim", 1) != 1 or isinstance(column, str) or not hasattr(column, "__len__"):
            raise ColumnsError(f"{name}, column '{key}': expected an array of one axis, got {type(column).__name__}")
        kind = getattr(getattr(column, "dtype", None), "kind", "")
        if kind in ("i", "u", "f") and hasattr(column, "to_numpy") and not isinstance(column.dtype, np.dtype):
            # pandas' numbers that may be missing
            column = column.to_numpy(dtype=float, na_value=np.nan)
        columns[str(key)] = np.asarray(column) if hasattr(column, "dtype") else list(column)
    lengths = {key: len(column) for key, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ColumnsError(f"{name}: expected arrays of one length, got {lengths}")
    return _of_lists(name, "row", 0, columns)


def _of_lists(name: str, what: str, first: int, columns: Mapping[str, Any]) -> _Table:
    header = tuple(key.strip() for key in columns)
    lists = list(columns.values())
    length = len(lists[0]) if lists else 0

    def parts(kinds: Mapping[int, str]) -> Iterator[_Raw]:
        for start in range(0, length, BATCH):
            yield _Raw(
                min(BATCH, length - start),
                lambda place, kind, start=start: _list_part(lists[place][start : start + BATCH], kind),
                lambda row, place, start=start: lists[place][start + row],
                np.array([0]),
                np.array([start + first]),
            )

    return _Table(name, what, header, parts)


def _list_part(cells: Any, kind: str) -> Any:
    """Texts of numbers (names of runs, link probabilities) by the different ones alone."""
    if kind == TEXT and isinstance(cells, np.ndarray) and cells.dtype.kind in "iuf":
        used, codes = np.unique(cells, return_inverse=True)
        names = tuple("" if value != value else str(_plain(value)) for value in used)
        return _in_order(Labels(codes.astype(np.int32), names))
    return cells
