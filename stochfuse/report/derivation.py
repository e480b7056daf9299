"""Formulas as plain text, for a terminal, as LaTeX and as JSON."""

from __future__ import annotations

import textwrap
from typing import Any, NamedTuple

import sympy

from stochfuse import __version__
from stochfuse.symbolic import FIXED, MOST_AGENTS_CLEARED, MU, SimplifiedForm

SCHEMA = "stochfuse.derivation/1"


class Formula(NamedTuple):
    """One line: a key, what it says, and name = expression."""

    key: str
    says: str
    name: sympy.Basic
    expression: sympy.Basic


def title(form: SimplifiedForm) -> str:
    """Say what the formulas are."""
    start = "shared" if form.shared else "independent"
    agents = "1 agent" if form.agents == 1 else f"{form.agents} like agents"
    return (
        f"Simplified formulation (54), {agents}, scalar state with F = G = H = 1, {start} initial estimates: expected "
        f"claimed posterior covariance P_k after step k (approximate: mean field). mu: link probability, q, r: process "
        f"and measurement noise variance, p0: variance of the initial estimates"
    )


def formulas(form: SimplifiedForm) -> list[Formula]:
    """Return the formulas that fit on pages: closed forms where they do, the chain where not."""
    k = form.step
    P_k, derivative = sympy.Symbol(f"P_{k}"), sympy.Symbol(f"dP_{k}_dmu")
    lines = []
    for name, expression in form.chain:
        prior = str(name).endswith("_prior")
        text = (
            f"prior of step {str(name).split('_')[1]}, P(k|k-1)"
            if prior
            else "average over the number of arrivals, (54)"
        )
        lines.append(Formula(str(name), text, name, expression))
    if form.expandable:
        lines += [
            Formula("closed", f"P_{k} as a rational function of mu", P_k, form.closed()),
            Formula("derivative", f"derivative of P_{k} in mu", derivative, form.derivative()),
            Formula("series_at_0", f"P_{k} near mu = 0, up to mu^2", P_k, form.series(0)),
            Formula("series_at_1", f"P_{k} near mu = 1, up to (1 - mu)^2", P_k, form.series(1)),
        ]
    steady = form.fixed_point()
    lines.append(Formula("fixed_point", "steady state P: fixed-point equation", FIXED, steady.rhs))
    if form.agents <= MOST_AGENTS_CLEARED:
        cleared = form.fixed_point_polynomial().as_expr()
        lines.append(Formula("fixed_point_polynomial", "the same, cleared of denominators", sympy.Integer(0), cleared))
    return lines


def to_plain(form: SimplifiedForm) -> str:
    """One `name = expression` per line, which SymPy can read back, with comments between."""
    lines = textwrap.wrap(title(form), 100, initial_indent="# ", subsequent_indent="# ")
    for formula in formulas(form):
        lines += [f"# {formula.says}", f"{formula.name} = {formula.expression}"]
    return "\n".join(lines) + "\n"


def to_pretty(form: SimplifiedForm, width: int) -> str:
    """Two-dimensional Unicode for a terminal."""
    blocks = [textwrap.fill(title(form), width)]
    for formula in formulas(form):
        equation = sympy.Eq(formula.name, formula.expression, evaluate=False)
        shown = sympy.pretty(equation, use_unicode=True, num_columns=width, wrap_line=True)
        blocks.append(f"{formula.says}:\n\n{shown}")
    return "\n\n".join(blocks) + "\n"


def to_latex(form: SimplifiedForm) -> str:
    """One equation environment per formula."""
    names = {MU: r"\mu"}
    lines = [f"% {title(form)}"]
    for formula in formulas(form):
        left = _latex_name(formula.key, form.step) or sympy.latex(formula.name)
        right = sympy.latex(formula.expression, symbol_names={**names, **_priors(form)})
        lines += [f"% {formula.says}", r"\begin{equation*}", f"  {left} = {right}", r"\end{equation*}"]
    return "\n".join(lines) + "\n"


def to_mapping(form: SimplifiedForm) -> dict[str, Any]:
    """Return an object of texts that SymPy can read back."""
    return {
        "schema": SCHEMA,
        "version": __version__,
        "method": "simplified",
        "quantity": "claimed",
        "description": title(form),
        "agents": form.agents,
        "step": form.step,
        "symbols": ["mu", *map(str, form.symbols)],
        "formulas": [
            {"key": f.key, "says": f.says, "name": str(f.name), "expression": str(f.expression)} for f in formulas(form)
        ],
    }


def _priors(form: SimplifiedForm) -> dict[sympy.Symbol, str]:
    return {name: _latex_name(str(name), form.step) for name, _ in form.chain}


def _latex_name(key: str, step: int) -> str:
    if key.endswith("_prior"):
        k = int(key.split("_")[1])
        return f"P({k}|{k - 1})"
    if key.startswith("P_"):
        return f"P({key[2:]})"
    if key == "derivative":
        return rf"\frac{{\mathrm{{d}}P({step})}}{{\mathrm{{d}}\mu}}"
    return f"P({step})" if key in ("closed", "series_at_0", "series_at_1") else ""
