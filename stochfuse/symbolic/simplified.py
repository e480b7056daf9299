"""The simplified formulation (54) with symbols: the equations of `stochfuse.prediction.simplified` over exact algebra.

For n like agents with a scalar state (F = G = H = 1) and a link probability µ.  Closed forms come from polynomial
arithmetic, never from `simplify`:

* numerator and denominator are carried apart in one of SymPy's polynomial rings (`Ratio`): with symbols they stay
  coprime by themselves, and a gcd at every step would cost everything; with numbers one gcd at the end is cheap;
* where the expanded form would fill pages, a chain of named sub-expressions takes its place, which is also the right
  thing to `lambdify`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
import sympy
from sympy.polys.fields import field
from sympy.polys.rings import ring as polynomial_ring

from stochfuse.errors import UsageError
from stochfuse.kalman.algebra import FIELD, SYMPY, Algebra
from stochfuse.kalman.kernel import Estimate, predict
from stochfuse.prediction.simplified import average, outcome_by_information

MU = sympy.Symbol("mu")
Q, R, P0 = sympy.symbols("q r p0", positive=True)
FIXED = sympy.Symbol("P", positive=True)

MOST_FACTORS_SYMBOLS = 9
"""Factors of the denominator, n^(step−1), up to which P(step) is expanded with q, r and p0 all symbols."""
MOST_FACTORS_NUMBERS = 250
"""The same where only µ and at most one other symbol is left."""


MOST_DEGREE = 250
"""Degree in µ up to which P(step) is expanded."""
MOST_AGENTS_CLEARED = 12
"""Agents up to which the fixed-point equation is cleared of its denominators."""
MOST_AGENTS_OR_STEPS = 100
"""Agents and steps up to which even the chain is written down."""


class Ratio:
    """A fraction of polynomials that is never reduced: numerator and denominator, for terms known to be coprime."""

    def __init__(self, numerator: Any, denominator: Any):
        self.numerator, self.denominator = numerator, denominator

    def __add__(self, other: Ratio) -> Ratio:
        if self.denominator == other.denominator:
            return Ratio(self.numerator + other.numerator, self.denominator)
        return Ratio(
            self.numerator * other.denominator + other.numerator * self.denominator,
            self.denominator * other.denominator,
        )

    def __rsub__(self, other: int) -> Ratio:
        return Ratio(other * self.denominator - self.numerator, self.denominator)

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, Ratio):
            return Ratio(self.numerator * other.numerator, self.denominator * other.denominator)
        return Ratio(self.numerator * other, self.denominator) if isinstance(other, int) else NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, other: Ratio | int) -> Ratio:
        if isinstance(other, Ratio):
            return Ratio(self.numerator * other.denominator, self.denominator * other.numerator)
        return Ratio(self.numerator, self.denominator * other)

    def __pow__(self, exponent: int) -> Ratio:
        return Ratio(self.numerator**exponent, self.denominator**exponent)


def recursion(
    agents: int, steps: int, q: Any, r: Any, p0: Any, mu: Any, *, shared: bool, algebra: Algebra
) -> list[Any]:
    """P(1) … P(steps) of (54) for a scalar model, by the shared kernel.

    Parameters
    ----------
    q, r, p0, mu : 1×1 matrices and the scalar µ, all of one algebra.
    """
    one = algebra.identity_like(r)
    weights = [comb(agents - 1, m) * mu**m * (1 - mu) ** (agents - 1 - m) for m in range(agents)]
    P = p0 if shared else average([Estimate(None, p0 / (m + 1)) for m in range(agents)], weights).P
    out = [P]
    for _ in range(steps - 1):
        prior = predict(Estimate(None, out[-1]), one, q, algebra=algebra)
        outcomes = [outcome_by_information(prior, one, r, m, algebra=algebra) for m in range(agents)]
        out.append(average(outcomes, weights).P)
    return out


@dataclass(frozen=True)
class SimplifiedForm:
    """(54) for n like agents with a scalar state, as formulas.

    Parameters
    ----------
    agents : number n of agents.
    step : the last step.
    q, r, p0 : variances: SymPy numbers (exact) or the symbols `Q`, `R`, `P0`.
    shared : whether all agents start from one common estimate.
    """

    agents: int
    step: int
    q: Any = Q
    r: Any = R
    p0: Any = P0
    shared: bool = False

    @property
    def symbols(self) -> tuple[sympy.Symbol, ...]:
        """The symbols among q, r and p0."""
        return tuple(s for s in (self.q, self.r, self.p0) if isinstance(s, sympy.Symbol))

    @property
    def expandable(self) -> bool:
        """Whether the closed form of the last step is of a size that can be read or stored."""
        few = len(self.symbols) <= 1
        if self.agents ** (self.step - 1) > (MOST_FACTORS_NUMBERS if few else MOST_FACTORS_SYMBOLS):
            return False
        return self.step == 1 or (self.agents - 1) * self.agents ** (self.step - 1) <= MOST_DEGREE

    @cached_property
    def fractions(self) -> tuple[tuple[sympy.Poly, sympy.Poly], ...]:
        """Numerator and denominator of P(1) … P(step), as polynomials in µ.

        Raises
        ------
        UsageError
            If the closed form would be too large; the `chain` is not.
        """
        if not self.expandable:
            raise UsageError(
                f"the expanded form of step {self.step} for {self.agents} agents has a denominator of "
                f"{self.agents ** (self.step - 1)} factors; use the chain of sub-expressions or numbers for q, r and p0"
            )
        made: Any = polynomial_ring((*self.symbols, MU), sympy.QQ)
        ring, generators = made[0], made[1:]
        named = dict(zip((*self.symbols, MU), generators, strict=True))
        q, r, p0 = (named[v] if v in named else ring(_rational(v)) for v in (self.q, self.r, self.p0))
        q, r, p0 = (_cell(Ratio(v, ring.one)) for v in (q, r, p0))
        µ = Ratio(named[MU], ring.one)
        out = recursion(self.agents, self.step, q, r, p0, µ, shared=self.shared, algebra=FIELD)
        return tuple(self._as_polynomials(P[0, 0]) for P in out)

    def closed(self, step: int | None = None) -> sympy.Expr:
        """P(step) as a rational function of µ."""
        numerator, denominator = self.fractions[(step or self.step) - 1]
        return _ratio(numerator, denominator)

    def derivative(self) -> sympy.Expr:
        """dP(step)/dµ, as (N′D − N D′)/D² with N and D the numerator and denominator of P(step)."""
        N, D = self.fractions[-1]
        if not self.symbols:
            return _ratio(*(N.diff(MU) * D - N * D.diff(MU)).cancel(D**2, include=True))
        n, d = N.as_expr(), D.as_expr()
        return (N.diff(MU).as_expr() * d - n * D.diff(MU).as_expr()) / d**2

    def series(self, at: int, terms: int = 3) -> sympy.Expr:
        """Taylor polynomial of P(step) in µ at 0, or in (1 − µ) at 1.

        Raises
        ------
        UsageError
            If `at` is neither 0 nor 1.
        """
        if at not in (0, 1):
            raise UsageError(f"series: expected µ = 0 or 1, got {at}")
        N, D = self.fractions[-1]
        if at == 1:
            N, D = (f.compose(sympy.Poly(1 - MU, MU, domain=f.domain)) for f in (N, D))
        n, d = (f.all_coeffs()[::-1] for f in (N, D))
        coefficients: list[Any] = []
        for j in range(terms):
            known = sum((c * d[j - i] for i, c in enumerate(coefficients) if j - i < len(d)), sympy.S.Zero)
            value = ((n[j] if j < len(n) else 0) - known) / d[0]
            coefficients.append(_reduced(value, self.symbols))
        variable = MU if at == 0 else 1 - MU
        # unevaluated, since SymPy multiplies a number into 1 − µ
        summands = [sympy.Mul(c, variable**j, evaluate=False) if j else c for j, c in enumerate(coefficients)]
        return sympy.Add(*summands, evaluate=False)

    @cached_property
    def chain(self) -> tuple[tuple[sympy.Symbol, sympy.Expr], ...]:
        """Named sub-expressions: each prior P_k_prior = P(k|k−1) and each P_k = P(k), in order."""
        links: list[tuple[sympy.Symbol, sympy.Expr]] = []
        P = sympy.Symbol("P_1", positive=True)
        q, r, p0 = (sympy.Matrix([[v]]) for v in (self.q, self.r, self.p0))
        first = recursion(self.agents, 1, q, r, p0, MU, shared=self.shared, algebra=SYMPY)
        links.append((P, first[0][0, 0]))
        for k in range(2, self.step + 1):
            prior = sympy.Symbol(f"P_{k}_prior", positive=True)
            links.append((prior, P + self.q))
            P = sympy.Symbol(f"P_{k}", positive=True)
            links.append((P, self._mixture(prior)))
        return tuple(links)

    def fixed_point(self) -> Any:
        """P = g_µ(P), the steady state's equation."""
        return sympy.Eq(FIXED, self._mixture(FIXED + self.q))

    def fixed_point_polynomial(self) -> sympy.Poly:
        """The same with the denominators cleared: a polynomial in P that vanishes at the steady state."""
        gens = (FIXED, *(s for s in (self.q, self.r) if isinstance(s, sympy.Symbol)), MU)
        made: Any = field(gens, sympy.QQ)
        K, elements = made[0], made[1:]
        named = dict(zip(gens, elements, strict=True))
        q, r = (named[s] if s in named else K(_rational(s)) for s in (self.q, self.r))
        # with p0 = P shared by all agents, the second step of the recursion is g_µ(P)
        g = recursion(self.agents, 2, _cell(q), _cell(r), _cell(named[FIXED]), named[MU], shared=True, algebra=FIELD)[
            1
        ][0, 0]
        return sympy.Poly((g - named[FIXED]).numer.as_expr(), FIXED)

    def lambdify(self) -> Callable[..., np.ndarray]:
        """Return P(step) as a NumPy function of µ and of the symbols among q, r and p0, in that order.

        It evaluates the chain, never the expanded form, which loses digits and time.
        """
        *before, (_, last) = self.chain
        named: Any = lambda expr: (before, expr)  # noqa: E731 - SymPy takes a function here, its annotation does not say so
        function = sympy.lambdify((MU, *self.symbols), last, modules="numpy", cse=named)
        # where P does not depend on µ SymPy returns one number, whatever the shape of µ
        return lambda mu, *values: function(mu, *values) + 0.0 * np.asarray(mu)

    def _mixture(self, prior: sympy.Expr) -> sympy.Expr:
        one, r = sympy.eye(1), sympy.Matrix([[self.r]])
        N = self.agents - 1
        weights = [sympy.Integer(comb(N, m)) * MU**m * (1 - MU) ** (N - m) for m in range(self.agents)]
        given = Estimate(None, sympy.Matrix([[prior]]))
        outcomes = [outcome_by_information(given, one, r, m, algebra=SYMPY) for m in range(self.agents)]
        return average(outcomes, weights).P[0, 0]

    def _as_polynomials(self, fraction: Ratio) -> tuple[sympy.Poly, sympy.Poly]:
        """Numerator and denominator with integer coefficients, as polynomials in µ, the last generator."""
        parts = [fraction.numerator, fraction.denominator]
        scale = sympy.ilcm(*(part.clear_denoms()[0] for part in parts))
        parts = [part.mul_ground(scale).set_ring(part.ring.clone(domain=sympy.ZZ)) for part in parts]
        content = sympy.igcd(*(part.content() for part in parts))
        N, D = (_in_mu(part.quo_ground(content)) for part in parts)
        reduced: Any = (N, D) if self.symbols else N.cancel(D, include=True)
        return reduced


def derive_simplified(
    agents: int = 3,
    step: int = 2,
    q: Any = None,
    r: Any = None,
    p0: Any = None,
    *,
    correlation: str = "independent",
) -> SimplifiedForm:
    """Return (54) as formulas, for like agents with a scalar state.

    Parameters
    ----------
    agents, step : number of agents and last step, at least 1.
    q, r, p0 : process noise, measurement noise and initial variance: a number or its text ("0.1" and 0.1 are exactly
        1/10), or None for a symbol.
    correlation : "independent" or "shared" initial estimates.

    Returns
    -------
    SimplifiedForm

    Raises
    ------
    UsageError
        If a number is out of range.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.derive_simplified(agents=3, step=1).closed()
    mu**2*p0/3 - mu*p0 + p0
    """
    for name, value in (("agents", agents), ("step", step)):
        if not 1 <= value <= MOST_AGENTS_OR_STEPS:
            raise UsageError(f"{name}: expected 1 to {MOST_AGENTS_OR_STEPS} for formulas, got {value}")
    numbers = [exact_number(n, v, s) for n, v, s in (("q", q, Q), ("r", r, R), ("p0", p0, P0))]
    if numbers[1] == 0:
        raise UsageError("r: expected a positive number, got 0")
    if numbers[0] == 0 and numbers[2] == 0:
        raise UsageError("q and p0: expected at least one of them positive, got 0 for both")
    return SimplifiedForm(agents, step, *numbers, shared=correlation == "shared")


def exact_number(name: str, value: Any, symbol: sympy.Symbol, *, signed: bool = False) -> sympy.Expr:
    """Return a number exactly as typed, or the symbol for None.

    Raises
    ------
    UsageError
        If it is no number, or negative and not signed.
    """
    if value is None:
        return symbol
    try:
        if len(str(value)) > 60 or re.search(r"e[+-]?0*\d{4,}", str(value), re.IGNORECASE):
            raise ValueError("more digits than a formula can use")
        number = sympy.Rational(str(value))
    except (TypeError, ValueError, ZeroDivisionError):
        raise UsageError(f"{name}: expected a number, got '{value}'") from None
    if not number.is_finite or (number < 0 and not signed):
        raise UsageError(f"{name}: expected a number of at least 0, got {value}")
    return number


def _in_mu(polynomial: Any) -> sympy.Poly:
    """Return an element of ZZ[…, µ] as a polynomial in µ, with coefficients in ZZ[…]."""
    if len(polynomial.ring.gens) == 1:
        return sympy.Poly(dict(polynomial.terms()), MU, domain=sympy.ZZ)
    coefficients = polynomial.ring.drop(len(polynomial.ring.gens) - 1)
    collected: dict[int, dict[tuple[int, ...], Any]] = {}
    for (*powers, m), c in polynomial.terms():
        collected.setdefault(m, {})[tuple(powers)] = c
    domain = coefficients.to_domain()
    return sympy.Poly({(m,): coefficients.from_dict(c) for m, c in collected.items()}, MU, domain=domain)


def _cell(value: Any) -> np.ndarray:
    return np.array([[value]], dtype=object)


def _rational(number: sympy.Expr) -> Any:
    return sympy.QQ.from_sympy(number)


def _ratio(N: sympy.Poly, D: sympy.Poly) -> sympy.Expr:
    return N.as_expr() / D.as_expr()


def _reduced(value: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    """Return a rational number or function in lowest terms, by polynomial arithmetic."""
    return sympy.cancel(value, *symbols) if symbols else value
