"""Formulas as plain text, for a terminal, as LaTeX and as JSON."""

from __future__ import annotations

import textwrap
from typing import Any, NamedTuple

import sympy

from stochfuse.report.table import stamped
from stochfuse.scenario.registry import CLAIMED, GENERAL, LFG, NAIVE, OPTIMAL, RMS, SIMPLIFIED
from stochfuse.symbolic.general import GeneralForm
from stochfuse.symbolic.simplified import FIXED, MOST_AGENTS_CLEARED, MU, SimplifiedForm

SCHEMA = "stochfuse.derivation/1"


class Formula(NamedTuple):
    """One line: a key, what it says, and name = expression."""

    key: str
    says: str
    name: sympy.Basic
    expression: sympy.Basic


class Derivation(NamedTuple):
    """Formulas with what they are.

    Parameters
    ----------
    title : what the formulas are.
    formulas : in the order of reading.
    facts : method, agents, step and symbols.
    latex : names that LaTeX writes differently.
    """

    title: str
    formulas: list[Formula]
    facts: dict[str, Any]
    latex: dict[str, str]


def derivation(form: SimplifiedForm | GeneralForm) -> Derivation:
    """Return the formulas of a form that fit on pages."""
    method = _METHODS[form.estimator] if isinstance(form, GeneralForm) else SIMPLIFIED
    facts = {
        "method": method,
        "quantity": OPTIMAL if method == OPTIMAL else getattr(form, "quantity", CLAIMED),
        "agents": form.agents,
        "step": form.step,
        "symbols": ["mu", *map(str, form.symbols)],
    }
    if isinstance(form, GeneralForm):
        return Derivation(_title(form), _general_formulas(form), facts, _latex_names(form.step))
    priors = {str(name): _latex_prior(str(name)) for name, _ in form.chain if str(name).endswith("_prior")}
    return Derivation(_title(form), _simplified_formulas(form), facts, _latex_names(form.step) | priors)


def _agents(n: int) -> str:
    return "1 agent" if n == 1 else f"{n} like agents"


_METHODS = {LFG: GENERAL, NAIVE: NAIVE, OPTIMAL: OPTIMAL}
_SYMBOLS = "mu: link probability, q, r: process and measurement noise variance, p0: variance of the initial estimates"


def _title(form: SimplifiedForm | GeneralForm) -> str:
    if isinstance(form, SimplifiedForm):
        what, exact = "Simplified formulation (54)", "approximate: mean field"
        quantity, agents = "claimed posterior covariance P_k", _agents(form.agents)
    else:
        rule = "naive fusion (42)/(43)" if form.estimator == NAIVE else "the Local Fusion Graph"
        what, exact = f"General formulation (49) of {rule}", "exact: every outcome"
        quantity = f"{form.quantity} posterior covariance P_k"
        agents = f"{_agents(form.agents)}, {form.architecture}"
        if form.estimator == OPTIMAL:
            what, exact = "Contact chain", "exact: every path; the best that linear fusion can do"
            quantity = f"{OPTIMAL} posterior covariance P_k"
        elif form.quantity == RMS:
            quantity = "squared posterior error M_k (noise, and the bias from the initial error b)"
    start = "shared" if form.shared else "independent"
    return (
        f"{what}, {agents}, scalar state with F = G = H = 1, {start} initial estimates: expected {quantity} "
        f"after step k ({exact}). {_SYMBOLS}"
    )


def _general_formulas(form: GeneralForm) -> list[Formula]:
    k, letter = form.step, "M" if form.quantity == RMS else "P"
    P_k, derivative = sympy.Symbol(f"{letter}_{k}"), sympy.Symbol(f"d{letter}_{k}_dmu")
    says = f"{P_k} as a polynomial in mu"
    if form.symbols:
        what = "squared error that can be made" if form.quantity == RMS else "covariance that can be claimed"
        what = what.replace("claimed", "reached") if form.estimator == OPTIMAL or form.quantity != CLAIMED else what
        says = f"{P_k}: every {what}, times the probability that it is, a polynomial in mu"
    lines = [
        Formula("closed", says, P_k, form.closed()),
        Formula("derivative", f"derivative of {P_k} in mu", derivative, form.derivative()),
    ]
    if form.quantity == RMS:
        root = sympy.sqrt(sympy.Symbol(f"M_{k}", positive=True))
        lines.append(Formula("rms", "root-mean-square error", sympy.Symbol(f"RMS_{k}"), root))
    if not form.symbols:
        L = len(form.bernstein) - 1
        for c, A in enumerate(form.bernstein):
            text = f"sum of {P_k} over the outcomes in which exactly {c} of {L} messages arrive"
            lines.append(Formula(f"A_{c}", text, sympy.Symbol(f"A_{c}"), A))
    return lines


def _simplified_formulas(form: SimplifiedForm) -> list[Formula]:
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


def to_plain(made: Derivation) -> str:
    """One `name = expression` per line, which SymPy can read back, with comments between."""
    lines = textwrap.wrap(made.title, 100, initial_indent="# ", subsequent_indent="# ")
    for formula in made.formulas:
        lines += [f"# {formula.says}", f"{formula.name} = {formula.expression}"]
    return "\n".join(lines) + "\n"


def to_pretty(made: Derivation, width: int) -> str:
    """Two-dimensional Unicode for a terminal."""
    blocks = [textwrap.fill(made.title, width)]
    for formula in made.formulas:
        equation = sympy.Eq(formula.name, formula.expression, evaluate=False)
        shown = sympy.pretty(equation, use_unicode=True, num_columns=width, wrap_line=True)
        blocks.append(f"{formula.says}:\n\n{shown}")
    return "\n\n".join(blocks) + "\n"


def to_latex(made: Derivation) -> str:
    """One equation environment per formula."""
    names = {MU: r"\mu", **{sympy.Symbol(key, positive=True): text for key, text in made.latex.items()}}
    lines = [f"% {made.title}"]
    for formula in made.formulas:
        left = made.latex.get(str(formula.name)) or sympy.latex(formula.name)
        right = sympy.latex(formula.expression, symbol_names=names)
        lines += [f"% {formula.says}", r"\begin{equation*}", f"  {left} = {right}", r"\end{equation*}"]
    return "\n".join(lines) + "\n"


def to_mapping(made: Derivation) -> dict[str, Any]:
    """Return an object of texts that SymPy can read back."""
    formulas = [
        {"key": f.key, "says": f.says, "name": str(f.name), "expression": str(f.expression)} for f in made.formulas
    ]
    return stamped(SCHEMA, **made.facts, description=made.title, formulas=formulas)


def _latex_names(step: int) -> dict[str, str]:
    names = {f"{letter}_{k}": f"{letter}({k})" for letter in "PM" for k in range(1, step + 1)}
    names |= {f"d{letter}_{step}_dmu": rf"\frac{{\mathrm{{d}}{letter}({step})}}{{\mathrm{{d}}\mu}}" for letter in "PM"}
    return names | {f"RMS_{step}": rf"\mathrm{{RMS}}({step})"}


def _latex_prior(key: str) -> str:
    k = int(key.split("_")[1])
    return f"P({k}|{k - 1})"
