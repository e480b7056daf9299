"""`stochfuse explain`: what a word means."""

from __future__ import annotations

from typing import Annotated

import typer

from stochfuse.cli.options import Listed, completed

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
    to: Listed = Listed(),
) -> None:
    """Explain a word that commands and outputs use, in a paragraph."""
    from stochfuse.report.explanations import explained
    from stochfuse.report.table import terminal_width, write_text

    to.check()
    text, report = explained(" ".join(word) if word else None, terminal_width())
    if to.kind == "table":
        write_text(text, to.output)
    else:
        to.write(report)
