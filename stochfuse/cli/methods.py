"""`stochfuse methods`: what there is, what takes what, and why not."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from stochfuse.cli.options import FormatOption, OutputOption, check_files, write_report


def methods(
    matrix: Annotated[bool, typer.Option("--matrix", help="Which estimator takes what, by which engine.")] = False,
    format: FormatOption = None,
    output: OutputOption = None,
) -> None:
    """Show what there is: estimators, engines, quantities, and what takes what.

    --estimator says what the agents do with what arrives, --method how chance is averaged.

    Example: stochfuse methods --matrix
    """
    from stochfuse.report.methods import methods_csv, methods_json, methods_table

    check_files(output, None)
    write_report(
        format, output, partial(methods_table, matrix=matrix), partial(methods_csv, matrix=matrix), methods_json
    )
