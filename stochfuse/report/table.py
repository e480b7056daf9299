"""A table, and how it looks as text, CSV, Markdown and LaTeX.

Where a report goes: standard output or a file, whole or not at all.
"""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from stochfuse import __version__
from stochfuse.errors import UsageError


@dataclass(frozen=True)
class Table:
    """Text cells under headings.

    Parameters
    ----------
    title : lines that say what the table shows.
    keys : headings of the first columns, which name a row.
    columns : headings of the other columns.
    rows : cells as text, keys first.
    over : what the columns run over, "k" for columns k=1, k=2, …, if they are numbers of one kind: such a table can be
        turned.
    """

    title: tuple[str, ...]
    keys: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    over: str = ""

    @property
    def headings(self) -> tuple[str, ...]:
        """All headings, keys first."""
        return self.keys + self.columns


class Report(NamedTuple):
    """A result on its way to the reader, in every form; what is not asked for is not made.

    Parameters
    ----------
    table : as a table, for a terminal, Markdown and LaTeX.
    csv : as records, with everything that says what a number is.
    json : as one object.
    draw : as a figure, where there is one.
    """

    table: Callable[[], Table | Sequence[Table]]
    csv: Callable[[], str]
    json: Callable[[], Any]
    draw: Callable[[], Any] | None = None

    @classmethod
    def of(cls, shown: Any, table: Callable, csv: Callable, json: Callable, draw: Callable | None = None) -> Report:
        """Return a report of what the forms take."""
        figure = None if draw is None else partial(draw, shown)
        return cls(partial(table, shown), partial(csv, shown), partial(json, shown), figure)

    @classmethod
    def of_rows(cls, title: Sequence[str], headings: Sequence[str], rows: Sequence[Sequence[Any]], json: Any) -> Report:
        """Return a report of a plain list, which a table and CSV show alike, and its JSON object."""
        cells = tuple(tuple("" if cell is None else str(cell) for cell in row) for row in rows)
        return cls(
            lambda: Table(tuple(title), tuple(headings), (), cells), partial(to_csv, headings, rows), lambda: json
        )


def number(value: float, digits: int = 5) -> str:
    """Return a number with so many significant digits, trailing zeros kept."""
    text = f"{value:#.{digits}g}"
    return text[:-1] if text.endswith(".") else text


def counted(number: int, what: str) -> str:
    """Return a number with its noun: "1 point", "1,100 points"."""
    shown = f"{number:,}" if number < 10**15 else f"{number:.3g}"
    return f"{shown} {what}{'s' * (number != 1)}"


MOST_ROWS = 400
"""Rows that a table for a terminal shows; beyond that the middle is left out."""


def to_text(table: Table, width: int | None = 80) -> str:
    """Return the table for a terminal of some width, turned if it is too wide; no width: as it is."""
    output = io.StringIO()
    room = width or 1_000_000
    console = Console(
        file=output, width=room, markup=False, highlight=False, emoji=False, color_system=None, force_jupyter=False
    )
    for line in table.title:
        console.print(line, soft_wrap=width is None)
    table, left_out = _shortened(_fitting(table, room))
    table, text = _aligned(table), _words(table)
    for block in _blocks(table, text, room):
        rich = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
        for index in block:
            # a number must never be cut: it keeps its width whatever the terminal; words may wrap
            rich.add_column(
                table.headings[index],
                justify="left" if text[index] or not table.columns else "right",
                no_wrap=not text[index],
                overflow="fold",
                min_width=_width(table, index) if not text[index] else _longest_word(table, index),
            )
        for row in table.rows:
            rich.add_row(*(row[index] for index in block))
        console.print(rich, crop=False, no_wrap=False)
    if left_out:
        console.print(f"… {left_out:,} rows in the middle are left out; --at picks steps, --format csv has them all")
    return "\n".join(line.rstrip() for line in output.getvalue().split("\n")).rstrip("\n") + "\n"


def _fitting(table: Table, room: int) -> Table:
    """The table, or where it is too wide its columns downwards: all beside each other, or one row for each number."""
    if not table.over or _total(table) <= room:
        return table
    names = [column.removeprefix(f"{table.over}=") for column in table.columns]
    n = len(table.keys)
    rows = tuple((*row[:n], name, row[n + i]) for row in table.rows for i, name in enumerate(names))
    each = replace(table, keys=(*table.keys, table.over), columns=("value",), rows=rows)
    if len({row[0] for row in table.rows}) < len(table.rows):
        return each
    turned = replace(
        table,
        keys=(table.over,),
        columns=tuple(f"{table.keys[0]}={row[0]}" if n == 1 else row[0] for row in table.rows),
        rows=tuple((name, *(row[n + i] for row in table.rows)) for i, name in enumerate(names)),
    )
    return turned if _total(turned) <= room else each


def _total(table: Table) -> int:
    table = _aligned(table)
    return sum(_width(table, i) + 3 for i in range(len(table.headings)))


def _shortened(table: Table) -> tuple[Table, int]:
    """The table with at most `MOST_ROWS` rows, and how many are left out."""
    left = len(table.rows) - MOST_ROWS
    if left <= 0:
        return table, 0
    half = MOST_ROWS // 2
    gap = ("…",) * len(table.headings)
    return replace(table, rows=(*table.rows[:half], gap, *table.rows[-half:])), left


def _words(table: Table) -> list[bool]:
    """Whether a column holds words, which may wrap."""
    return [key and not all(_numeric(row[i]) for row in table.rows) for i, key in enumerate(_is_key(table))]


def _aligned(table: Table) -> Table:
    """The table with numbers padded so that the decimal points of a column lie below each other."""
    if not table.rows:
        return table
    columns = []
    for column, words in zip(zip(*table.rows, strict=True), _words(table), strict=True):
        parts = [cell.partition(".") for cell in column]
        before = max(len(whole) for whole, _, _ in parts)
        after = max(len(point + rest) for _, point, rest in parts)
        padded = [f"{whole:>{before}}{point + rest:<{after}}" for whole, point, rest in parts]
        columns.append(column if words else padded)
    return replace(table, rows=tuple(zip(*columns, strict=True)))


def _numeric(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return not cell
    return True


def _is_key(table: Table) -> list[bool]:
    return [i < len(table.keys) for i in range(len(table.headings))]


def _width(table: Table, index: int) -> int:
    return max(len(row[index]) for row in (table.headings, *table.rows))


def _longest_word(table: Table, index: int) -> int:
    return max((len(word) for row in (table.headings, *table.rows) for word in row[index].split()), default=0)


def _blocks(table: Table, text: Sequence[bool], room: int) -> Iterator[list[int]]:
    """Column indices of each block, keys repeated; at least one further column a block."""
    beside = 3  # what rich puts around a cell
    widths = [beside + (_longest_word if text[i] else _width)(table, i) for i in range(len(table.headings))]
    keys = list(range(len(table.keys)))
    start = used = sum(widths[i] for i in keys)
    # words wrap only where even one further column would not fit beside them unwrapped
    for i in keys:
        whole = beside + _width(table, i)
        if start + whole - widths[i] + max(widths[len(keys) :], default=0) <= room:
            start = used = start + whole - widths[i]
            widths[i] = whole
    block = list(keys)
    for i in range(len(keys), len(widths)):
        if used + widths[i] > room and len(block) > len(keys):
            yield block
            block, used = list(keys), start
        block.append(i)
        used += widths[i]
    yield block


def to_csv(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return comma-separated values, numbers in full precision; None is an empty cell."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    return output.getvalue()


def records_csv(headings: Sequence[str], records: Iterable[Mapping[str, object]]) -> str:
    """Return comma-separated values of the entries of records that the headings name."""
    return to_csv(headings, ([record[name] for name in headings] for record in records))


def to_markdown(table: Table) -> str:
    """Return a Markdown table under its title."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = [":--" if i < len(table.keys) else "--:" for i in range(len(table.headings))]
    body = [line(table.headings), line(rule), *(line(row) for row in table.rows)]
    return "\n".join([*("" + text + "  " for text in table.title), "", *body]) + "\n"


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "µ": r"$\mu$", "²": r"$^2$", "³": r"$^3$", "∞": r"$\infty$",
    "×": r"$\times$", "·": r"$\cdot$", "≥": r"$\geq$", "≤": r"$\leq$", "−": "$-$",
}  # fmt: skip


def latex_text(text: str) -> str:
    """Escape text for LaTeX."""
    return "".join(_LATEX.get(character, character) for character in text)


def to_latex(table: Table) -> str:
    r"""Return a LaTeX table environment with caption; needs no package."""
    align = "l" * len(table.keys) + "r" * len(table.columns)

    def line(cells: Sequence[str]) -> str:
        return "    " + " & ".join(map(latex_text, cells)) + r" \\"

    return "\n".join(
        [
            r"\begin{table}",
            r"  \caption{" + latex_text(". ".join(table.title)) + ".}",
            r"  \begin{tabular}{" + align + "}",
            r"    \hline",
            line(table.headings),
            r"    \hline",
            *(line(row) for row in table.rows),
            r"    \hline",
            r"  \end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def render(table: Table | Sequence[Table], format: str, width: int) -> str:
    """Return a table, or several below each other, as text of a width, Markdown or LaTeX."""
    if not isinstance(table, Table):
        return "\n".join(render(each, format, width) for each in table)
    if format == "markdown":
        return to_markdown(table)
    return to_latex(table) if format == "latex" else to_text(table, width)


def to_html(table: Table | Sequence[Table]) -> str:
    """Return an HTML table under its title, as notebooks show it."""
    if not isinstance(table, Table):
        return "".join(map(to_html, table))
    keys = len(table.keys)

    def line(kind: str, cells: Sequence[str]) -> str:
        named = [' class="key"'] * keys + [""] * (len(cells) - keys)
        pairs = zip(named, cells, strict=True)
        return "<tr>" + "".join(f"<{kind}{name}>{escape(cell)}</{kind}>" for name, cell in pairs) + "</tr>"

    title = "".join(f"<div>{escape(text)}</div>" for text in table.title)
    shown, left_out = _shortened(table)
    body = "".join(line("td", row) for row in shown.rows)
    more = f"<div>… {left_out:,} rows in the middle are left out</div>" if left_out else ""
    return f"<div>{title}<table><thead>{line('th', table.headings)}</thead><tbody>{body}</tbody></table>{more}</div>"


SUFFIXES = {".csv": "csv", ".json": "json", ".md": "markdown", ".tex": "latex", ".txt": "table"}
PLOT_SUFFIXES = (".png", ".svg", ".pdf")


def to_json(value: Any) -> str:
    """One object, indented; NaN and infinity are an error."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def stamped(schema: str, **facts: Any) -> dict[str, Any]:
    """Return an object for JSON that says which schema it follows and which version wrote it."""
    return {"schema": schema, "version": __version__, **facts}


def listed(values: Any) -> Any:
    """Return a number or nested lists of numbers for JSON and CSV, None in the place of what is not finite."""
    values = np.asarray(values)
    missing = ~np.isfinite(values)
    if not missing.any():
        return values.tolist()
    out = values.astype(object)
    out[missing] = None
    return out.tolist()


def terminal_width() -> int:
    """Columns of the terminal, COLUMNS if set, else 80; at least 40."""
    return max(40, shutil.get_terminal_size((80, 24)).columns)


def write_text(text: str, output: Path | None) -> None:
    """Write to a file, or to standard output without one."""
    if output is None:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_file(output, lambda path: path.write_text(text, encoding="utf-8"))


def write_file(output: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under another name and put it in place when it is complete.

    Raises
    ------
    UsageError
        If the file cannot be written.
    """
    target = output.resolve() if output.is_symlink() else output
    special = target.exists() and not target.is_file()
    partial = target if special else target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        write(partial)
        if not special:
            partial.replace(target)
    except OSError as error:
        raise UsageError(f"cannot write {output}: {error.strerror or error}") from None
    finally:
        if not special:
            partial.unlink(missing_ok=True)


def check_writable(output: Path | None, suffixes: tuple[str, ...] = ()) -> None:
    """Raise UsageError early, before the work, if a file of that name can never be written."""
    if output is None:
        return
    if suffixes and output.suffix.lower() not in suffixes:
        raise UsageError(f"{output}: expected a name that ends in {', '.join(suffixes)}")
    if output.is_dir():
        raise UsageError(f"cannot write {output}: it is a directory")
    if not output.parent.is_dir():
        raise UsageError(f"cannot write {output}: there is no directory {output.parent}")
