"""`stochfuse derive`: the equations themselves."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from stochfuse.cli.options import OutputOption


class Formulation(StrEnum):
    """Formulations that can be derived."""

    simplified = "simplified"


class FormulaFormat(StrEnum):
    """How formulas are written."""

    text = "text"
    latex = "latex"
    json = "json"


class Correlation(StrEnum):
    """Initial estimates."""

    independent = "independent"
    shared = "shared"


_Number = typer.Option(metavar="X", help="A number, exact as typed; left out, a symbol.")


def derive(
    formulation: Annotated[Formulation, typer.Argument(help="Which formulation.")] = Formulation.simplified,
    agents: Annotated[int, typer.Option(min=1, help="Number of like agents.")] = 3,
    step: Annotated[int, typer.Option(min=1, help="The step whose covariance is derived.")] = 2,
    q: Annotated[str | None, _Number] = None,
    r: Annotated[str | None, _Number] = None,
    p0: Annotated[str | None, _Number] = None,
    correlation: Annotated[Correlation, typer.Option(help="Initial estimates.")] = Correlation.independent,
    latex: Annotated[bool, typer.Option("--latex", help="The same as --format latex.")] = False,
    format: Annotated[
        FormulaFormat | None,
        typer.Option("--format", "-f", help="text (default): two-dimensional in a terminal, one line each when piped."),
    ] = None,
    output: OutputOption = None,
) -> None:
    """Print the equations: chain, rational function of µ, derivative, series at µ = 0 and 1, fixed point.

    For like agents with a scalar state, F = G = H = 1. Forms too large to expand are given as a chain of named
    sub-expressions; with numbers for q, r and p0 they stay small.
    """
    import sys

    from stochfuse.errors import UsageError
    from stochfuse.report.export import check_writable, terminal_width, to_json, write_text

    if latex and format not in (None, FormulaFormat.latex):
        raise UsageError("--latex and --format: expected one of them, got both")
    check_writable(output)
    from stochfuse.report import derivation
    from stochfuse.symbolic import derive_simplified

    form = derive_simplified(agents, step, q, r, p0, correlation=correlation.value)
    if latex or format is FormulaFormat.latex:
        text = derivation.to_latex(form)
    elif format is FormulaFormat.json:
        text = to_json(derivation.to_mapping(form))
    elif output is None and sys.stdout.isatty():
        text = derivation.to_pretty(form, terminal_width())
    else:
        text = derivation.to_plain(form)
    if not form.expandable:
        typer.echo(
            f"note: step {step} is given as a chain of named sub-expressions; the expanded form would fill pages "
            "(numbers for q, r and p0 keep it small)",
            err=True,
        )
    write_text(text, output)
