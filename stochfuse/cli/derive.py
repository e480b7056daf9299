"""`stochfuse derive`: the equations themselves."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from stochfuse.cli.options import Architecture, OutputOption


class Formulation(StrEnum):
    """Formulations that can be derived."""

    simplified = "simplified"
    general = "general"
    naive = "naive"
    optimal = "optimal"


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
    architecture: Annotated[
        Architecture, typer.Option(help="general, naive, optimal: who may hear whom.")
    ] = Architecture.ad_hoc,
    correlation: Annotated[Correlation, typer.Option(help="Initial estimates.")] = Correlation.independent,
    latex: Annotated[bool, typer.Option("--latex", help="The same as --format latex.")] = False,
    format: Annotated[
        FormulaFormat | None,
        typer.Option("--format", "-f", help="text (default): two-dimensional in a terminal, one line each when piped."),
    ] = None,
    output: OutputOption = None,
) -> None:
    """Print the equations, exact.

    For like agents with a scalar state, F = G = H = 1. simplified: chain, rational function of µ, derivative, series at
    µ = 0 and 1, fixed point. general: a polynomial in µ (a sum over every covariance that can be claimed), derivative,
    and coefficients by number of arrivals; naive: the same for naive fusion; optimal: for the best that linear fusion
    can do. Forms too large to expand stay small with numbers for q, r and p0.
    """
    import sys

    from stochfuse.errors import UsageError
    from stochfuse.report.table import check_writable, terminal_width, to_json, write_text

    if latex and format not in (None, FormulaFormat.latex):
        raise UsageError("--latex and --format: expected one of them, got both")
    check_writable(output)
    from stochfuse.report import derivation
    from stochfuse.symbolic.simplified import SimplifiedForm, derive_simplified

    if formulation is Formulation.simplified:
        if architecture is Architecture.cyclic:
            raise UsageError("--architecture cyclic: expected formulation general, got simplified")
        form = derive_simplified(agents, step, q, r, p0, correlation=correlation.value)
    elif formulation is Formulation.optimal:
        from stochfuse.symbolic.optimal import derive_optimal

        form = derive_optimal(agents, step, q, r, p0, architecture=architecture.value, correlation=correlation.value)
    else:
        from stochfuse.symbolic.general import derive_general

        estimator = "naive" if formulation is Formulation.naive else "local-fusion-graph"
        start = correlation.value
        form = derive_general(
            agents, step, q, r, p0, architecture=architecture.value, correlation=start, estimator=estimator
        )
    made = derivation.derivation(form)
    if latex or format is FormulaFormat.latex:
        text = derivation.to_latex(made)
    elif format is FormulaFormat.json:
        text = to_json(derivation.to_mapping(made))
    elif output is None and sys.stdout.isatty():
        text = derivation.to_pretty(made, terminal_width())
    else:
        text = derivation.to_plain(made)
    if isinstance(form, SimplifiedForm) and not form.expandable:
        typer.echo(
            f"note: step {step} is given as a chain of named sub-expressions; the expanded form would fill pages "
            "(numbers for q, r and p0 keep it small)",
            err=True,
        )
    write_text(text, output)
