"""The contact chain over exact algebra: the expected optimum as a polynomial in µ.

For n like agents with a scalar state (F = G = H = 1) and one link probability µ, every path r_1 ≥ … ≥ r_k of
`stochfuse.engines.contact_chain` is one covariance, a rational function in those of q, r and p0 that are symbols, with

    weight = Π T(r → r′),   T(r → r + m) = C(n−r, m) (1 − f)^m f^(n−r−m),   f = (1−µ)^r ad hoc, 1 − µ otherwise,

a polynomial in µ that is brought into the form Σ a_c µ^c (1−µ)^(L−c) of `stochfuse.symbolic.general`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from math import comb
from typing import Any

import sympy

from stochfuse.engines.contact_chain import check_size, number_of_paths
from stochfuse.engines.events import events
from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import Ledger
from stochfuse.scenario.network import Network, uniform_rows
from stochfuse.scenario.registry import OPTIMAL
from stochfuse.symbolic.general import GeneralForm, derive_general
from stochfuse.symbolic.simplified import MU

MOST_DEGREE = 400
"""Degree of the polynomials in µ: links drawn up to the step."""


@dataclass(frozen=True)
class OptimalForm(GeneralForm):
    """The expected optimum for n like agents with a scalar state, as formulas; parameters as of `GeneralForm`."""

    @cached_property
    def _enumerated(self) -> tuple[Ledger, dict[int, list[Any]], int]:
        """Ledger, weight by number of arrivals of every path's covariance, and number of links L."""
        network = Network(self.agents, self.step, self.architecture, None)
        degree = self.step * len(events(network, uniform_rows([0.5]), 1))
        check_size(number_of_paths(network))
        if degree > MOST_DEGREE:
            raise UsageError(
                f"{degree} links make polynomials of degree {degree}, at most {MOST_DEGREE} are worked out: expected "
                "fewer agents or steps"
            )
        ledger = Ledger()
        start = ledger.start(0)
        # value of the path so far, with the weight of its backward transitions, by the last count
        paths = {
            (r, ledger.combine(1, [(start, 1 if self.shared else r)])): sympy.Poly(1, MU, domain=sympy.QQ)
            for r in range(1, self.agents + 1)
        }
        for _ in range(2, self.step + 1):
            grown: dict[tuple[int, int], sympy.Poly] = {}
            for (before, value), weight in paths.items():
                for r in range(1, before + 1):
                    new = weight * self._transition(r, before)
                    if not new.is_zero:
                        key = (r, ledger.measured(value, (0,) * r))
                        grown[key] = grown[key] + new if key in grown else new
            paths = grown
        found: dict[int, sympy.Poly] = {}
        for (r, value), weight in paths.items():
            last = weight * self._transition(1, r)
            found[value] = found[value] + last if value in found else last
        return ledger, {v: _bernstein(w, degree) for v, w in found.items() if not w.is_zero}, degree

    def _transition(self, r: int, later: int) -> sympy.Poly:
        """T(r → later)."""
        µ = sympy.Poly(MU, MU, domain=sympy.QQ)
        failed = (1 - µ) ** r if self.architecture == "ad-hoc" else 1 - µ
        out = self.agents - r if self.architecture != "cyclic" else min(1, self.agents - r)
        joined = later - r
        if joined > out:
            return sympy.Poly(0, MU, domain=sympy.QQ)
        return (1 - failed) ** joined * failed ** (out - joined) * comb(out, joined)


def derive_optimal(
    agents: int = 2,
    step: int = 3,
    q: Any = None,
    r: Any = None,
    p0: Any = None,
    *,
    architecture: str = "ad-hoc",
    correlation: str = "independent",
) -> OptimalForm:
    """Return the expected optimum as formulas; parameters and errors are those of `derive_general`.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.derive_optimal(agents=2, step=2, q=25, r=100, p0=100).closed()
    800*mu**2/63 - 2410*mu/63 + 500/9
    """
    form = derive_general(agents, step, q, r, p0, architecture=architecture, correlation=correlation, estimator=OPTIMAL)
    return OptimalForm(**{field.name: getattr(form, field.name) for field in fields(form)})


def _bernstein(weight: sympy.Poly, degree: int) -> list[Any]:
    """a_0 … a_L of Σ a_c µ^c (1−µ)^(L−c), from powers of µ: µ^j = Σ_c C(L−j, c−j) µ^c (1−µ)^(L−c)."""
    out = [sympy.S.Zero] * (degree + 1)
    for (j,), a in weight.terms():
        for c in range(j, degree + 1):
            out[c] += a * comb(degree - j, c - j)
    return out
