"""`stochfuse explain`: what a word means."""

from __future__ import annotations

from typing import Annotated

import typer

from stochfuse.cli.options import FormatOption, OutputOption, check_files, chosen_format, completed, write_report

EXAMPLES = ("stochfuse explain claimed", "stochfuse explain split-ci")


def _words() -> list[str]:
    from stochfuse.report.explanations import explanations

    return list(explanations())


def explain(
    word: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="WORD",
            help="An estimator, a method, a quantity, a metric, or a word of the output; without one: all.",
            autocompletion=completed(_words),
        ),
    ] = None,
    format: FormatOption = None,
    output: OutputOption = None,
) -> None:
    """Explain a word that commands and outputs use, in a paragraph."""
    from stochfuse.report.explanations import explained
    from stochfuse.report.table import terminal_width, write_text

    check_files(output, None)
    kind = chosen_format(format, output)
    text, report = explained(" ".join(word) if word else None, terminal_width())
    if kind == "table":
        write_text(text, output)
    else:
        write_report(report, kind, output)
