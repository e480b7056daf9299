"""`stochfuse reproduce`: what the thesis found, computed here."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from typing import Annotated

import typer

from stochfuse.cli.options import FormatOption, OutputOption, WorkersOption, check_files, write_report


class What(StrEnum):
    """What can be reproduced."""

    timing = "timing"


def reproduce(
    what: Annotated[What, typer.Argument(help="timing: simulation against calculation, thesis 4.3.")],
    workers: WorkersOption = None,
    format: FormatOption = None,
    output: OutputOption = None,
) -> None:
    """Reproduce a result of the thesis and print it beside the thesis' own.

    timing: 1000 Monte Carlo runs of the Local Fusion Graph took 12,000 s there, the simplified formulation 2 s; here
    the same
    pair, and the exact general formulation, for three agents, five steps and the thesis' five link probabilities.
    """
    from stochfuse.report import table
    from stochfuse.reproduction import timing

    check_files(output, None)
    measured = timing(workers=workers)
    headings = ("work", "thesis_s", "here_s")
    write_report(format, output, measured.table, partial(table.to_csv, headings, measured.rows), measured.to_mapping)
