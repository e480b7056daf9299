"""The general formulation (49) over exact algebra: E[P(k)](µ) as a closed form.

For n like agents with a scalar state (F = G = H = 1) and one link probability µ.  The enumeration is that of
`stochfuse.engines.enumeration`; its values are worked out over the rational functions in those of q, r and p0 that are
symbols, or over the rational numbers.  The result is a sum over the different covariances that can be claimed,

    E[P(k)](µ) = Σ_v w_v(µ) P_v,      w_v(µ) = Σ_c a_c µ^c (1−µ)^(L−c),

with whole-number outcome counts behind every a_c: a polynomial in µ whose coefficients are rational functions.

Of the actual error the covariance in each outcome is Σ_s c_s² σ_s², over the initial errors, the process noise of every
step and the measurement noises, c_s the estimate that a unit of s alone leads to.  A known initial error b, common to
all agents, leads to c_b b, and the mean squared error is the sum of both; the RMS error is the root of its expectation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from sympy.polys.fields import field

from stochfuse.engines.enumeration import Request, enumerate_outcomes
from stochfuse.engines.events import CountWeights, events, orbits, relabellings
from stochfuse.errors import TooManyError, UsageError
from stochfuse.estimators.ledger import Information, Ledger, Sources, evaluate_exactly
from stochfuse.estimators.making import rule_of
from stochfuse.kalman.algebra import FIELD
from stochfuse.prediction.general import check_size
from stochfuse.scenario.model import Model, Sensor
from stochfuse.scenario.network import Network, uniform_rows
from stochfuse.scenario.registry import AS_FORMULAS, CLAIMED, LFG, OPTIMAL, RMS
from stochfuse.symbolic.simplified import MU, P0, Q, R, exact_number

B = sympy.Symbol("b", real=True)

MOST_OUTCOMES = 2_000_000
"""Outcomes of the last exchanges, over all graphs, up to which they are gone through one by one."""
MOST_COVARIANCES_SYMBOLS, MOST_COVARIANCES_NUMBERS = 60, 300
"""Different covariances up to which a closed form can be read or stored."""


@dataclass(frozen=True)
class GeneralForm:
    """(49) for n like agents with a scalar state, as formulas.

    Parameters
    ----------
    agents, step : number n of agents, and the step.
    architecture : of the network.
    q, r, p0 : variances: SymPy numbers (exact) or the symbols.
    shared : whether all agents start from one common estimate.
    estimator : "local-fusion-graph" or "naive".
    quantity : "claimed", "actual" (covariance of the error), or "rms": the mean squared error.
    error : known initial error b of all agents, for "rms".
    """

    agents: int
    step: int
    architecture: str = "ad-hoc"
    q: Any = Q
    r: Any = R
    p0: Any = P0
    shared: bool = False
    estimator: str = LFG
    quantity: str = CLAIMED
    error: Any = sympy.S.Zero

    def showing(self, quantity: str, initial_error: Any = None) -> GeneralForm:
        """Return the same of another quantity.

        Parameters
        ----------
        quantity : "claimed"; "actual", the covariance of the error; or "rms", of which the form is the mean squared
            error: actual, and the square of the bias from the initial error.
        initial_error : known error b of all initial estimates, for "rms": a number or its text, or None for a symbol.

        Raises
        ------
        UsageError
            If there is no such quantity, a number is none, or the form is that of the optimum, which claims what is
            true.

        Examples
        --------
        >>> import stochfuse as sf
        >>> sf.derive_general(2, 1, 25, 100, 100).showing("rms", -1000).closed()
        1000100 - 50*mu
        """
        if quantity not in AS_FORMULAS:
            raise UsageError(f"quantity: expected one of {', '.join(AS_FORMULAS)}, got '{quantity}'")
        if quantity != CLAIMED and self.estimator == OPTIMAL:
            raise UsageError(f"quantity {quantity}: expected formulation general or naive, got optimal")
        if quantity != RMS and initial_error is not None:
            raise UsageError(f"initial_error: expected quantity rms, got {quantity}")
        error = exact_number("initial_error", initial_error, B, signed=True) if quantity == RMS else sympy.S.Zero
        return replace(self, quantity=quantity, error=error)

    @property
    def symbols(self) -> tuple[sympy.Symbol, ...]:
        """The symbols among q, r, p0 and b."""
        return tuple(s for s in (self.q, self.r, self.p0, self.error) if isinstance(s, sympy.Symbol))

    @cached_property
    def terms(self) -> tuple[tuple[sympy.Poly, sympy.Expr], ...]:
        """Weight, a polynomial in µ, and value of every different covariance, the likeliest at µ = ½ first.

        Raises
        ------
        UsageError
            If there are too many.
        """
        return tuple((_polynomial(coefficients), P.as_expr()) for P, coefficients in self._counted)

    @cached_property
    def bernstein(self) -> tuple[sympy.Expr, ...]:
        """A_0 … A_L of E[P](µ) = Σ A_c µ^c (1−µ)^(L−c), L the number of links drawn up to the step."""
        degree = len(self._counted[0][1]) - 1
        return tuple(
            sympy.Add(*(sympy.Rational(a[c]) * P.as_expr() for P, a in self._counted if a[c]))
            for c in range(degree + 1)
        )

    def closed(self) -> sympy.Expr:
        """E[P(step)](µ): with numbers a polynomial in µ, with symbols a sum over the different covariances."""
        if not self.symbols:
            return self.polynomial().as_expr()
        return sympy.Add(*(sympy.factor(w.as_expr()) * P for w, P in self.terms), evaluate=False)

    def polynomial(self) -> sympy.Poly:
        """E[P(step)] as a polynomial in µ with rational coefficients, or coefficients rational in the symbols."""
        if self.symbols:
            collected = sympy.Add(*(w.as_expr() * P for w, P in self.terms))
            return sympy.Poly(collected, MU)
        total = sympy.Poly(0, MU, domain=sympy.QQ)
        for w, P in self.terms:
            total += w.mul_ground(sympy.QQ.from_sympy(P))
        return total

    def derivative(self) -> sympy.Expr:
        """dE[P(step)]/dµ."""
        if not self.symbols:
            return self.polynomial().diff(MU).as_expr()
        return sympy.Add(*(sympy.factor(w.diff(MU).as_expr()) * P for w, P in self.terms), evaluate=False)

    def lambdify(self) -> Callable[..., np.ndarray]:
        """Return E[P(step)] as a NumPy function of µ and of the symbols among q, r, p0 and b, in that order."""
        covariances = sympy.lambdify(self.symbols, [P.as_expr() for P, _ in self._counted], modules="numpy", cse=True)
        table = np.array([[float(a) for a in coefficients] for _, coefficients in self._counted])
        degree = table.shape[1] - 1
        c = np.arange(degree + 1)

        def function(mu: Any, *values: Any) -> np.ndarray:
            # Bernstein's form: every term is positive, nothing cancels
            µ = np.asarray(mu, dtype=float)[..., None]
            weights = (µ**c * (1 - µ) ** (degree - c)) @ table.T
            P = np.stack(np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in covariances(*values))), axis=-1)
            return (weights * P).sum(axis=-1)

        return function

    @cached_property
    def _enumerated(self) -> tuple[Ledger, dict[int, list[Any]], int]:
        """Ledger, weight by number of arrivals of every value claimed at the step, and number of links L."""
        network = Network(self.agents, self.step, self.architecture, None)
        rows, kinds = uniform_rows([0.5]), (0,) * self.agents
        check_size(network, rows)
        # footprints only say whose noise is whose
        labels = kinds if self.quantity == CLAIMED else tuple(range(self.agents))
        permutations = relabellings(network, rows, kinds)
        drawn = events(network, rows, 1)
        weights = CountWeights(self.step * len(drawn))
        ledger = Ledger(None if self.quantity == CLAIMED else kinds)
        estimator = rule_of(self.estimator)(ledger, labels, shared=self.shared, relabellings=permutations)
        groups = tuple(orbits(self.agents, permutations))
        request = Request(self.agents, self.step, lambda _: drawn, weights, groups, most=20_000)
        try:
            ending = enumerate_outcomes(estimator, request).endings[-1]
        except TooManyError:
            raise UsageError(
                f"step {self.step} of {self.agents} agents has too many outcomes for an exact form: give fewer agents "
                f"or steps"
            ) from None
        if sum(view.ids.shape[0] * len(view.terms[0][1]) for view in ending.views) > MOST_OUTCOMES:
            raise UsageError(f"step {self.step} of {self.agents} agents has too many outcomes for an exact form")
        found: dict[int, list[Any]] = {}
        for view in ending.views:
            # agents are alike, whether or not relabellings were found that show it
            parts = [s * (len(g) / self.agents) for s, g in zip(view.shares, groups, strict=True) if s is not None]
            share = np.sum(parts, axis=0)
            factor_of = np.repeat(view.factors, np.diff([*view.starts, len(view.terms[0][1])]), axis=0)
            for ids, weight in zip(view.ids, ending.weights, strict=True):
                for cell, factor in enumerate(factor_of):
                    parts = [(int(ids[index[cell]]), sign) for sign, index in view.terms]
                    parts += [] if view.always is None else [(view.always, 1)]
                    value = ledger.combine(ending.step, [(v, sign) for v, sign in parts if v >= 0])
                    both = np.convolve(
                        np.convolve(_exact(weight), _exact(factor)),
                        np.array([self._share(s) for s in share], dtype=object),
                    )
                    known = found.setdefault(value, [sympy.S.Zero] * (ending.events + 1))
                    self._check_number(len(found) if self.quantity == CLAIMED else len(found) // self.agents)
                    for c, a in enumerate(_completed(both, ending.events)):
                        known[c] += a
        return ledger, found, ending.events

    def _check_number(self, covariances: int) -> None:
        """Raise UsageError, before any more work, if there are more than a closed form can hold."""
        most = MOST_COVARIANCES_SYMBOLS if self.symbols else MOST_COVARIANCES_NUMBERS
        if covariances > most:
            instead = "give numbers for q, r and p0, or fewer agents or steps" if self.symbols else "give fewer steps"
            raise UsageError(
                f"step {self.step} of {self.agents} agents has more than {most} different covariances, too many for a "
                f"closed form: {instead}, or use `stochfuse predict --method general`"
            )

    def _share(self, share: float) -> Any:
        return sympy.Rational(round(share * self.agents), self.agents)

    @cached_property
    def _counted(self) -> list[tuple[Any, list[Any]]]:
        """Every different covariance (an element of an exact field) with its coefficients a_0 … a_L."""
        ledger, found, degree = self._enumerated
        generators = self.symbols or (sympy.Symbol("unused"),)
        made: Any = field(generators, sympy.QQ)
        K, named = made[0], dict(zip(generators, made[1:], strict=True))
        q, r, p0, b = (
            named[v] if v in named else K(sympy.QQ.from_sympy(v)) for v in (self.q, self.r, self.p0, self.error)
        )
        sources, squares = self._sources(K.one, q, r, p0, b)
        values = evaluate_exactly(ledger, sources)
        counted: dict[Any, list[Any]] = {}
        for value, coefficients in found.items():
            y, Y = values[value]
            P = 1 / Y[0, 0]
            if y is not None:
                P = sum((s * (P * c) ** 2 for s, c in zip(squares, y[0], strict=True)), 0 * P)
            known = counted.get(P)
            counted[P] = coefficients if known is None else [a + b for a, b in zip(known, coefficients, strict=True)]
        self._check_number(len(counted))
        likely = {P: sympy.Add(*coefficients) / sympy.Integer(2) ** degree for P, coefficients in counted.items()}
        return sorted(counted.items(), key=lambda item: (-likely[item[0]], str(item[0])))

    def _sources(self, one: Any, q: Any, r: Any, p0: Any, b: Any) -> tuple[Sources, list[Any]]:
        """What the ledger's atoms stand for; of errors a unit of each noise in a column, with the noises' variances."""
        unit = np.array([[one]], dtype=object)
        model = Model(unit, q * unit, 0 * unit, ("x",), ("",))
        if self.quantity == CLAIMED:
            return Sources(model, [Sensor(unit, r * unit)], [Information(None, unit / p0)], algebra=FIELD), []
        n, steps = self.agents, range(1, self.step + 1)
        squares = [b**2 if self.quantity == RMS else 0 * one]
        count = 1 + (1 if self.shared else n) + self.step * (1 + n)

        def column(square: Any) -> np.ndarray:
            squares.append(square)
            return np.array([[one if c == len(squares) - 1 else 0 * one for c in range(count)]], dtype=object)

        common = np.array([[one, *[0 * one] * (count - 1)]], dtype=object)
        first = [column(p0) for _ in range(1 if self.shared else n)]
        starts = [Information((common + first[0 if self.shared else i]) / p0, unit / p0) for i in range(n)]
        # the last start is the one that agents have in common
        model = replace(model, Bu=np.stack([column(q) for _ in steps]))
        records = [[column(r) for _ in range(n)] for _ in steps]
        return Sources(model, [Sensor(unit, r * unit)] * n, starts, records, algebra=FIELD), squares


def derive_general(
    agents: int = 2,
    step: int = 3,
    q: Any = None,
    r: Any = None,
    p0: Any = None,
    *,
    architecture: str = "ad-hoc",
    correlation: str = "independent",
    estimator: str = LFG,
) -> GeneralForm:
    """Return (49) as formulas, for like agents with a scalar state.

    Parameters
    ----------
    agents, step : number of agents and step, at least 1.
    q, r, p0 : process noise, measurement noise and initial variance: a number or its text, or None for a symbol.
    architecture : "ad-hoc", "broadcast" or "cyclic".
    correlation : "independent" or "shared" initial estimates.
    estimator : "local-fusion-graph", "naive" or "optimal".

    Returns
    -------
    GeneralForm

    Raises
    ------
    UsageError
        If a number is out of range.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.derive_general(agents=2, step=2, q=25, r=100, p0=100).closed()
    -20*mu**3/9 + 120*mu**2/7 - 850*mu/21 + 500/9
    """
    for name, value in (("agents", agents), ("step", step)):
        if value < 1:
            raise UsageError(f"{name}: expected at least 1, got {value}")
    numbers = [exact_number(n, v, s) for n, v, s in (("q", q, Q), ("r", r, R), ("p0", p0, P0))]
    for name, number in (("r", numbers[1]), ("p0", numbers[2])):
        if number == 0:
            raise UsageError(f"{name}: expected a positive number, got 0")
    return GeneralForm(agents, step, architecture, *numbers, shared=correlation == "shared", estimator=estimator)


def _exact(coefficients: np.ndarray) -> np.ndarray:
    return np.array([sympy.Integer(round(a)) for a in coefficients], dtype=object)


def _completed(coefficients: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients with events that do not matter counted in."""
    free = degree + 1 - len(coefficients)
    return np.convolve(coefficients, np.array([sympy.binomial(free, c) for c in range(free + 1)], dtype=object))


def _polynomial(coefficients: list[Any]) -> sympy.Poly:
    degree = len(coefficients) - 1
    total = sympy.Poly(0, MU, domain=sympy.QQ)
    one, µ = sympy.Poly(1 - MU, MU, domain=sympy.QQ), sympy.Poly(MU, MU, domain=sympy.QQ)
    for c, a in enumerate(coefficients):
        if a:
            total += (µ**c * one ** (degree - c)).mul_ground(sympy.QQ.from_sympy(a))
    return total
