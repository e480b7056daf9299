"""Where a table comes from: CSV, Parquet, JSON, standard input, arrays or a data frame, opened and read.

CSV is read in blocks of whole lines.  pyarrow parses a block where it is installed; what it does not take (and every
block without it) goes through Python's own csv, which has the last word on what is a number and what a message says.
So both give the same.  Lines that are blank or begin with # are skipped.  A comma, a semicolon or a tab separates
cells, whichever separates the headings.  A cell ends on its line.

What the columns are is none of its business: `stochfuse.data.columns` checks them.
"""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError, needed

NUMBER, WHOLE, TEXT, LABEL = "number", "whole", "text", "label"
BLOCK = 8_000_000
"""Bytes of a CSV file that are parsed at once."""
SUFFIXES = (".parquet", ".pq")
_FROM_0, _FROM_1 = ((np.array([0]), np.array([first])) for first in (0, 1))
"""Stretches of rows on adjacent lines, as `Columns` has them: one, numbered from 0 or 1."""


class ColumnsError(UsageError):
    """A table that cannot be used; names line and column."""


class Labels(NamedTuple):
    """A column of texts: which of the different ones each row has.

    Parameters
    ----------
    codes : (rows,) index into `names`; −1: empty.
    names : the different texts, in order of appearance.
    """

    codes: np.ndarray
    names: tuple[str, ...]


class NumberColumn(NamedTuple):
    """Values, not-a-number where a cell is empty or is no number; and which are which."""

    values: np.ndarray
    empty: np.ndarray
    wrong: np.ndarray


class Raw(NamedTuple):
    """Some rows before they are checked.

    `column` gives the values of a column by its place and kind: `NumberColumn`, `Labels`, or a sequence of cells that
    may be anything; `cell` one cell as it was given, which may be asked for before the first column is.
    """

    length: int
    column: Callable[[int, str], Any]
    cell: Callable[[int, int], Any]
    starts: np.ndarray
    firsts: np.ndarray


class OpenedTable(NamedTuple):
    """Where a table comes from, its headings, and its rows part by part, given places and kinds of what is wanted.

    Only CSV has several parts.
    """

    name: str
    what: str
    header: tuple[str, ...]
    parts: Callable[[Mapping[int, str]], Iterator[Raw]]


def opened(source: Any, stack: ExitStack) -> OpenedTable:
    """Return a table from wherever it is.

    Parameters
    ----------
    source : path of a file, "-" for standard input, a mapping of names to arrays, or a data frame.
    stack : what closes a file in the end.

    Raises
    ------
    ColumnsError
        If it cannot be read.
    StochfuseError
        If it is Parquet and pyarrow is not installed.
    """
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
        return _of_parquet(path, stack) if path.suffix.lower() in SUFFIXES else _of_bytes(str(path), stream)
    except FileNotFoundError:
        raise ColumnsError(f"{path}: no such file") from None
    except OSError as error:
        raise ColumnsError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        if isinstance(error, UsageError):
            raise
        raise ColumnsError(f"{str(path)!r}: no name that a file can have") from None


# CSV


def _of_bytes(name: str, stream: IO[bytes]) -> OpenedTable:
    """CSV, or JSON if it begins so."""
    head = stream.read(BLOCK)
    beginning = head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    if beginning in (b"[", b"{"):
        return _of_json(name, head + stream.read())
    blocks = _blocks(name, head, stream)
    first = next(blocks, None)
    if first is None:
        return OpenedTable(name, "line", (), lambda _: iter(()))
    heading, _, rest = first.text.partition(b"\n")
    separator = max(",;\t", key=heading.decode().count)
    header = tuple(cell.strip() for cell in _cells_of(heading, separator))

    def parts(kinds: Mapping[int, str]) -> Iterator[Raw]:
        starts, firsts = first.starts, first.firsts
        # the headings are no row: what follows them begins on the next line that counts
        alone = len(starts) > 1 and starts[1] == 1
        starts = np.concatenate([[0], starts[2:] - 1] if alone else [[0], starts[1:] - 1])
        firsts = np.concatenate([[firsts[1]], firsts[2:]] if alone else [[firsts[0] + 1], firsts[1:]])
        yield _csv_part(name, _LineBlock(rest, first.length - 1, starts, firsts), header, separator, kinds)
        for block in blocks:
            yield _csv_part(name, block, header, separator, kinds)

    return OpenedTable(name, "line", header, parts)


class _LineBlock(NamedTuple):
    """Lines of a file without those that are skipped, and their numbers as in `Columns`."""

    text: bytes
    length: int
    starts: np.ndarray
    firsts: np.ndarray


def _blocks(name: str, head: bytes, stream: IO[bytes]) -> Iterator[_LineBlock]:
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


def _without_comments(text: bytes, line: int, lines: int) -> _LineBlock:
    if not (b"#" in text or b"\n\n" in text or text.startswith(b"\n")):
        return _LineBlock(text, lines, np.array([0]), np.array([line]))
    split = text.split(b"\n")[:-1]
    kept = [i for i, each in enumerate(split) if each and not each.lstrip(b' \t"').startswith(b"#")]
    numbers = np.array(kept, dtype=np.int64) + line
    starts = np.flatnonzero(np.diff(numbers, prepend=-1) != 1)
    return _LineBlock(b"".join(split[i] + b"\n" for i in kept), len(kept), starts, numbers[starts])


def _cells_of(line: bytes, separator: str) -> list[str]:
    return next(csv.reader([line.decode()], delimiter=separator), [])


def _csv_part(name: str, block: _LineBlock, header: Sequence[str], separator: str, kinds: Mapping[int, str]) -> Raw:
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

    return Raw(block.length, column, cell, block.starts, block.firsts)


def _line(block: _LineBlock, row: int) -> int:
    stretch = int(np.searchsorted(block.starts, row, side="right")) - 1
    return int(block.firsts[stretch] + row - block.starts[stretch])


def _check_quotes(name: str, block: _LineBlock) -> None:
    if b'"' not in block.text:
        return
    text = np.frombuffer(block.text, dtype=np.uint8)
    ends = np.flatnonzero(text == ord("\n"))
    odd = np.searchsorted(np.flatnonzero(text == ord('"')), ends) % 2 == 1
    if odd.any():
        row = int(odd.argmax())
        line = block.text.split(b"\n")[row].decode()
        raise ColumnsError(f"{name}, line {_line(block, row)}: expected quotation marks in pairs, got {line!r:.60}")


def _by_csv(name: str, block: _LineBlock, header: Sequence[str], separator: str) -> list[tuple[str, ...]]:
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
    """The wanted columns by pyarrow, or None where it does not take them; without threads, since engines fork."""
    pa, pa_csv = _arrow("pyarrow"), _arrow("pyarrow.csv")
    if pa is None or pa_csv is None or not kinds:
        return None
    words = pa.dictionary(pa.int32(), pa.string())
    types = {str(place): words if kind == TEXT else pa.float64() for place, kind in kinds.items()}
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(text),
            read_options=pa_csv.ReadOptions(
                use_threads=False, column_names=[str(i) for i in range(width)], block_size=len(text) + 1
            ),
            parse_options=pa_csv.ParseOptions(delimiter=separator),
            convert_options=pa_csv.ConvertOptions(
                column_types=types, include_columns=list(types), null_values=[""], strings_can_be_null=True
            ),
        )
    except pa.ArrowInvalid:
        return None

    return lambda place, kind: _of_arrow(table.column(str(place)), kind)


def _of_arrow(column: Any, kind: str) -> Any:
    """A column of pyarrow as what `Raw.column` gives."""
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
        return NumberColumn(filled, empty, np.zeros(len(filled), dtype=bool))
    return column.to_pylist()


def _in_order(labels: Labels) -> Labels:
    """The same with the texts in order of appearance, each once."""
    used, first = np.unique(labels.codes, return_index=True)
    order = [int(code) for code in used[np.argsort(first)] if code >= 0]
    codes = np.full(len(labels.names) + 1, -1, dtype=np.int32)
    codes[order] = np.arange(len(order))
    return Labels(codes[labels.codes], tuple(labels.names[code] for code in order))


# Parquet, JSON, arrays


def _of_parquet(path: Path, stack: ExitStack) -> OpenedTable:
    needed("pyarrow.parquet", "study", f"{path}: Parquet needs")
    pq, pa = import_module("pyarrow.parquet"), import_module("pyarrow")
    try:
        file = stack.enter_context(pq.ParquetFile(path, pre_buffer=False))
    except (pa.ArrowInvalid, OSError) as error:
        raise ColumnsError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}") from None
    header = tuple(file.schema_arrow.names)

    def parts(kinds: Mapping[int, str]) -> Iterator[Raw]:
        table = file.read([header[place] for place in kinds], use_threads=False)
        yield Raw(
            table.num_rows,
            lambda place, kind: _of_arrow(table.column(header[place]), kind),
            lambda row, place: table.column(header[place])[row].as_py(),
            *_FROM_1,
        )

    return OpenedTable(str(path), "record", header, parts)


def _of_json(name: str, text: bytes) -> OpenedTable:
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
    return _of_lists(name, "record", _FROM_1, {str(key): column for key, column in made.items()})


def _of_records(name: str, records: list[Any]) -> dict[str, list[Any]]:
    header: list[str] = []
    for number, record in enumerate(records, start=1):
        if not isinstance(record, dict):
            raise ColumnsError(f"{name}, record {number}: expected an object, got {record!r:.40}")
        header = header or list(record)
        if record.keys() != set(header):
            raise ColumnsError(f"{name}, record {number}: expected keys {', '.join(header)}, got {', '.join(record)}")
    return {key: [record[key] for record in records] for key in header}


def _of_arrays(source: Any) -> OpenedTable:
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
    return _of_lists(name, "row", _FROM_0, columns)


def _of_lists(name: str, what: str, lines: tuple[np.ndarray, np.ndarray], columns: Mapping[str, Any]) -> OpenedTable:
    header = tuple(key.strip() for key in columns)
    lists = list(columns.values())

    def parts(kinds: Mapping[int, str]) -> Iterator[Raw]:
        length = len(lists[0]) if lists else 0
        yield Raw(length, lambda place, kind: _list(lists[place], kind), lambda row, place: lists[place][row], *lines)

    return OpenedTable(name, what, header, parts)


def _list(cells: Any, kind: str) -> Any:
    """Texts of numbers (names of runs, link probabilities) by the different ones alone."""
    if kind == TEXT and isinstance(cells, np.ndarray) and cells.dtype.kind in "iuf":
        used, codes = np.unique(cells, return_inverse=True)
        names = tuple("" if value != value else str(plain(value)) for value in used)
        return _in_order(Labels(codes.astype(np.int32), names))
    return cells


def plain(cell: Any) -> Any:
    """Return a NumPy scalar as a Python one, anything else as it is."""
    return cell.item() if isinstance(cell, np.generic) else cell
