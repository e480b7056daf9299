"""`stochfuse reproduce`: what the thesis found, computed here."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import (
    DigitsOption,
    Format,
    FormatOption,
    OutputOption,
    PlotOption,
    WorkersOption,
    check_files,
    chosen_format,
    write_report,
)

if TYPE_CHECKING:
    from stochfuse.report.reproductions import Sheet
    from stochfuse.thesis import Bench


def complete_item(incomplete: str) -> list[str]:
    """Return the keys that begin so, for the shell."""
    from stochfuse.thesis import listing

    keys = [key for key, _ in listing()] + ["statements", "all", "timing"]
    return [key for key in keys if key.startswith(incomplete)]


def reproduce(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="KEY",
            help="figure-32 (or 32), table-3, statements, all or timing; without one: the list of all.",
            autocompletion=complete_item,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the records of truth and measurements.")] = 1,
    digits: DigitsOption = 5,
    workers: WorkersOption = None,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Reproduce a figure or table of the thesis and judge what the thesis says about it.

    KEY: the data behind the figure, exact where the thesis sampled, and each statement of the thesis about it with our
    numbers: agrees, differs, explained or open.  --plot draws it on the thesis' axes.

    statements: all statements on one page, in some minutes.

    all: data and plots of everything, into the directory of --output.

    timing: 1000 Monte Carlo runs of the Local Fusion Graph took 12,000 s there, the simplified formulation 2 s; here
    the same pair, and the exact general formulation.
    """
    from stochfuse.errors import UsageError
    from stochfuse.thesis import Bench, find, sheet

    if plot is not None and what in (None, "statements", "all", "timing"):
        raise UsageError("--plot: expected the key of a figure, such as figure-32, to draw")
    if what == "all":
        _everything(Bench(seed=seed), output, format)
        return
    check_files(output, plot)
    if what is None:
        _list(format, output)
    elif what == "timing":
        _timing(format, output, workers)
    else:
        if what != "statements":
            item = find(what)
            if plot is not None and item.panels is None:
                raise UsageError(f"--plot: {item.key.replace('-', ' ')} is a table of parameters, with nothing to draw")
        bench = Bench(seed=seed)
        if what == "statements":
            _statements(bench, format, output)
            return
        found = sheet(what, bench)
        if plot is not None:
            from stochfuse.report.reproductions import plot_sheet

            plot_sheet(found, plot)
        _write_sheet(found, format, output, digits)


def _list(format: Format | None, output: Path | None) -> None:
    from stochfuse.report import reproductions as report
    from stochfuse.report.table import to_csv
    from stochfuse.thesis import listing

    entries = listing()
    write_report(
        format,
        output,
        partial(report.listing_table, entries),
        partial(to_csv, ("key", "title"), entries),
        partial(report.listing_json, entries),
    )


def _statements(bench: Bench, format: Format | None, output: Path | None) -> None:
    from stochfuse.report import reproductions as report
    from stochfuse.thesis import page

    findings = page(bench)
    title = ("Statements of the thesis' chapters 3 and 4, in our words, and what our numbers say to them",)
    write_report(
        format,
        output,
        partial(report.findings_table, findings, title),
        partial(report.findings_csv, findings),
        partial(report.findings_json, findings),
    )


def _timing(format: Format | None, output: Path | None, workers: int | None) -> None:
    from stochfuse.report import table
    from stochfuse.thesis import timing

    measured = timing(workers=workers)
    headings = ("work", "thesis_s", "here_s")
    write_report(format, output, measured.table, partial(table.to_csv, headings, measured.rows), measured.to_mapping)


def _write_sheet(found: Sheet, format: Format | None, output: Path | None, digits: int) -> None:
    from stochfuse.report import reproductions as report
    from stochfuse.report.table import render, terminal_width, to_json, write_text

    kind = chosen_format(format, output)
    if kind == Format.csv.value:
        text = report.sheet_csv([found])
    elif kind == Format.json.value:
        text = to_json(report.sheet_json(found))
    else:
        text = "\n".join(render(table, kind, terminal_width()) for table in report.sheet_tables(found, digits))
    write_text(text, output)


def _everything(bench: Bench, output: Path | None, format: Format | None) -> None:
    """Write data, statements and plot of every figure and table into a directory."""
    from stochfuse.errors import UsageError
    from stochfuse.report.reproductions import plot_sheet
    from stochfuse.report.table import SUFFIXES
    from stochfuse.thesis import listing, sheet

    if output is None or not output.is_dir():
        got = "nothing" if output is None else f"'{output}'"
        raise UsageError(f"reproduce all: expected --output with a directory that exists, got {got}")
    kind = format or Format.json
    suffix = next(ending for ending, name in SUFFIXES.items() if name == kind.value)
    for key, _ in listing():
        found = sheet(key, bench)
        _write_sheet(found, kind, output / f"{key}{suffix}", 5)
        if found.panels:
            plot_sheet(found, output / f"{key}.png")
    _statements(bench, kind, output / f"statements{suffix}")
