"""`stochfuse derive`: the equations themselves."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import (
    ARCHITECTURE,
    NETWORK,
    OUTPUT,
    SCENARIO,
    SHOWN,
    OutputOption,
    choice,
    completed,
    one_of,
    option,
)
from stochfuse.cli.values import options_for, tell
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import AS_FORMULAS, CLAIMED, GENERAL, LFG, NAIVE, OPTIMAL, SIMPLIFIED

if TYPE_CHECKING:
    from stochfuse.symbolic.general import GeneralForm
    from stochfuse.symbolic.simplified import SimplifiedForm

FORMULATIONS = (SIMPLIFIED, GENERAL, NAIVE, OPTIMAL)
TEXT, LATEX, JSON = FORMATS = ("text", "latex", "json")
CORRELATIONS = ("independent", "shared")
EXAMPLES = (
    "stochfuse derive simplified --agents 3 --step 2",
    "stochfuse derive general --agents 2 --step 2 --r 100 --quantity rms --latex",
)
Number = Annotated[str | None, option("A number, exact as typed; left out, a symbol.", SCENARIO, metavar="X")]


def derive(
    formulation: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help=f"{', '.join(FORMULATIONS)}; default: simplified.",
            callback=one_of(FORMULATIONS),
            autocompletion=completed(FORMULATIONS),
            show_default=False,
        ),
    ] = SIMPLIFIED,
    agents: Annotated[int, option("Number of like agents; default: 3.", NETWORK, min=1, metavar="N")] = 3,
    step: Annotated[int, option("The step whose covariance is derived; default: 2.", NETWORK, min=1, metavar="K")] = 2,
    architecture: Annotated[str, ARCHITECTURE] = "ad-hoc",
    q: Number = None,
    r: Number = None,
    p0: Number = None,
    correlation: Annotated[
        str, choice(CORRELATIONS, f"Initial estimates: {' or '.join(CORRELATIONS)}; default: independent.", SCENARIO)
    ] = "independent",
    quantity: Annotated[
        str | None,
        choice(AS_FORMULAS, "Of general and naive: claimed, actual, or rms of the error; default: claimed.", SHOWN),
    ] = None,
    initial_error: Annotated[
        str | None, option("Known error of all initial estimates, for rms; left out, b.", SCENARIO, metavar="X")
    ] = None,
    latex: Annotated[bool, option("The same as --format latex.", OUTPUT, "--latex")] = False,
    format: Annotated[
        str | None,
        choice(
            FORMATS,
            "text (two-dimensional in a terminal, one line each when piped), latex, json.",
            OUTPUT,
            "--format",
            "-f",
        ),
    ] = None,
    output: OutputOption = None,
) -> None:
    """Print the equations, exact.

    For like agents with a scalar state, F = G = H = 1. simplified: chain, rational function of µ, derivative, series at
    µ = 0 and 1, fixed point. general: a polynomial in µ (a sum over every covariance that can be claimed), derivative,
    and coefficients by number of arrivals; naive: the same for naive fusion; optimal: for the best that linear fusion
    can do. Forms too large to expand stay small with numbers for q, r and p0.
    """
    from stochfuse.report.table import check_writable, terminal_width, to_json, write_text

    if formulation in (SIMPLIFIED, OPTIMAL) and (quantity not in (None, CLAIMED) or initial_error is not None):
        raise UsageError(f"--quantity and --initial-error: expected formulation general or naive, got {formulation}")
    if latex and format not in (None, LATEX):
        raise UsageError("--latex and --format: expected one of them, got both")
    check_writable(output)
    from stochfuse.report import derivation
    from stochfuse.symbolic.simplified import SimplifiedForm

    with options_for("q", "r", "p0", "initial_error"):
        form = _form(formulation, agents, step, (q, r, p0), architecture, correlation)
        if not isinstance(form, SimplifiedForm) and formulation != OPTIMAL:
            form = form.showing(quantity or CLAIMED, initial_error)
    made = derivation.derivation(form)
    if latex or format == LATEX:
        text = derivation.to_latex(made)
    elif format == JSON:
        text = to_json(derivation.to_mapping(made))
    elif output is None and sys.stdout.isatty():
        text = derivation.to_pretty(made, terminal_width())
    else:
        text = derivation.to_plain(made)
    if isinstance(form, SimplifiedForm) and not form.expandable:
        tell(
            [
                f"note: step {step} is given as a chain of named sub-expressions; the expanded form would fill pages "
                "(numbers for q, r and p0 keep it small)"
            ]
        )
    write_text(text, output)


def _form(
    formulation: str, agents: int, step: int, numbers: Sequence[str | None], architecture: str, correlation: str
) -> SimplifiedForm | GeneralForm:
    """Return the formulas of a formulation; numbers are q, r and p0."""
    if formulation == SIMPLIFIED:
        if architecture == "cyclic":
            raise UsageError("--architecture cyclic: expected formulation general, got simplified")
        from stochfuse.symbolic.simplified import derive_simplified

        return derive_simplified(agents, step, *numbers, correlation=correlation)
    more = {"architecture": architecture, "correlation": correlation}
    if formulation == OPTIMAL:
        from stochfuse.symbolic.optimal import derive_optimal

        return derive_optimal(agents, step, *numbers, **more)
    from stochfuse.symbolic.general import derive_general

    return derive_general(agents, step, *numbers, **more, estimator=NAIVE if formulation == NAIVE else LFG)
