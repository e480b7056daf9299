"""`stochfuse methods`: what there is, what takes what, and why not."""

from __future__ import annotations

from typing import Annotated

from stochfuse.cli.options import SHOWN, FormatOption, OutputOption, check_files, chosen_format, option, write_report

EXAMPLES = ("stochfuse methods", "stochfuse methods --matrix")


def methods(
    matrix: Annotated[bool, option("Which estimator takes what, by which engine.", SHOWN, "--matrix")] = False,
    format: FormatOption = None,
    output: OutputOption = None,
) -> None:
    """Show what there is: estimators, engines, quantities, and what takes what.

    --estimator says what the agents do with what arrives, --method how chance is averaged.
    """
    from stochfuse.report.methods import methods_report

    check_files(output, None)
    write_report(methods_report(matrix), chosen_format(format, output), output)
