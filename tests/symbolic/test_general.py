"""The general formulation over exact algebra, against rational brute force over every history."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import sympy

import stochfuse as sf
from stochfuse.errors import UsageError
from stochfuse.report import derivation
from stochfuse.symbolic.general import derive_general
from stochfuse.symbolic.simplified import MU, P0, Q, R
from tests.oracles import textbook


def coefficients_by_brute_force(n, steps, architecture, q, r, p0, *, shared=False, naive=False):
    """A_c in exact rational arithmetic: sum of P over the histories with c arrivals, averaged over the agents."""

    def forward(pair, _):
        return 0, 1 / (1 / pair[1] + q)

    draws = n if architecture != "ad-hoc" else n * (n - 1)
    A = [Fraction(0)] * (steps * draws + 1)
    for _, history in textbook.histories(n, steps, architecture, np.full((steps, n, n), 0.5)):
        locals_, fused = {"root": (0, 1 / p0)}, {}
        parents = {(i, 1): ({"root"} if shared else set()) for i in range(n)}
        graph = textbook.FusionGraph(parents, locals_.__getitem__, forward)
        for k, messages in enumerate(history, start=1):
            for i in range(n):
                locals_[i, k] = (0, 1 / p0) if k == 1 else (0, forward(fused[i, k - 1], k)[1] + 1 / r)
            for i in range(n):
                received = {(i, k)} | {(j, k) for j, receiver, _ in messages if receiver == i}
                fused[i, k] = (0, sum(locals_[s][1] for s in received)) if naive else graph.info(received, k)
                parents[i, k + 1] = received
        heard_by_each = n - 1 if architecture == "broadcast" else 1
        arrivals = sum(map(len, history)) // heard_by_each
        A[arrivals] += sum(1 / fused[i, steps][1] for i in range(n)) / n
    return A


@pytest.mark.parametrize(
    ("agents", "step", "architecture", "options"),
    [
        (2, 3, "ad-hoc", {}),
        (3, 2, "ad-hoc", {}),
        (3, 3, "broadcast", {}),
        (3, 3, "cyclic", {}),
        (3, 2, "broadcast", {"correlation": "shared"}),
        (2, 3, "ad-hoc", {"estimator": "naive"}),
    ],
)
def test_polynomial_with_rational_coefficients(agents, step, architecture, options):
    q, r, p0 = Fraction(7, 3), Fraction(5), Fraction(11, 2)
    form = derive_general(agents, step, "7/3", "5", "11/2", architecture=architecture, **options)
    expected = coefficients_by_brute_force(
        agents, step, architecture, q, r, p0, shared="correlation" in options, naive="estimator" in options
    )
    assert [Fraction(int(a.p), int(a.q)) for a in form.bernstein] == expected
    L = len(expected) - 1
    polynomial = sum(sympy.Rational(a) * MU**c * (1 - MU) ** (L - c) for c, a in enumerate(expected))
    assert form.polynomial() == sympy.Poly(polynomial, MU, domain="QQ")
    assert sympy.expand(form.derivative() - sympy.diff(polynomial, MU)) == 0


@pytest.mark.parametrize(("agents", "step"), [(2, 3), (3, 2), (1, 3)])
def test_symbols_agree_with_numbers_and_with_the_numeric_side(agents, step):
    form = derive_general(agents, step)
    values = {Q: 25, R: 100, P0: 100}
    numbers = derive_general(agents, step, 25, 100, 100)
    at = [sympy.Rational(n, 7) for n in range(8)]
    closed = form.closed()
    for µ in at:
        assert closed.subs(values).subs(MU, µ) == numbers.polynomial().eval(µ)
    link = np.array([float(µ) for µ in at])
    scenario = sf.load_scenario(agents=agents, steps=step)
    expected = sf.predict(scenario, link, method="general").values()[:, -1]
    np.testing.assert_allclose(form.lambdify()(link, 25.0, 100.0, 100.0), expected, rtol=1e-13)
    np.testing.assert_allclose(numbers.lambdify()(link), expected, rtol=1e-13)


def test_weights_are_probabilities():
    form = derive_general(3, 2)
    assert sum((w for w, _ in form.terms), sympy.Poly(0, MU)).as_expr() == 1


def test_limits_are_broadcast_fusion_and_the_kalman_filter():
    form = derive_general(3, 2)
    prior = P0 + Q
    closed = form.closed()
    assert sympy.cancel(closed.subs(MU, 0) - 1 / (1 / prior + 1 / R)) == 0
    assert sympy.cancel(closed.subs(MU, 1) - 1 / (1 / (P0 / 3 + Q) + 3 / R)) == 0


def test_printed_forms_can_be_read_back():
    made = derivation.derivation(derive_general(2, 2, 25, 100, 100))
    names = {
        line.split(" = ")[0]: line.split(" = ")[1]
        for line in derivation.to_plain(made).splitlines()
        if " = " in line and line[0] != "#"
    }
    assert sympy.sympify(names["P_2"]).subs("mu", 1) == 30
    assert sum(sympy.sympify(names[f"A_{c}"]) for c in range(5)) / 16 == sympy.sympify(names["P_2"]).subs(
        "mu", sympy.Rational(1, 2)
    )
    latex = derivation.to_latex(made)
    assert r"P(2) = " in latex
    assert r"\frac{\mathrm{d}P(2)}{\mathrm{d}\mu} = " in latex
    mapping = derivation.to_mapping(made)
    assert mapping["method"] == "general"
    assert "exact: every outcome" in mapping["description"]
    assert "naive fusion" in derivation.to_pretty(derivation.derivation(derive_general(2, 2, estimator="naive")), 80)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1), "agents: expected at least 1, got 0"),
        ((2, 0), "step: expected at least 1, got 0"),
        ((2, 2, "x"), "q: expected a number, got 'x'"),
        ((2, 2, 1, 0), "r: expected a positive number, got 0"),
        ((2, 2, 1, 1, 0), "p0: expected a positive number, got 0"),
    ],
)
def test_bad_requests(arguments, message):
    with pytest.raises(sf.UsageError, match=message):
        derive_general(*arguments)


def test_forms_that_would_fill_books_are_refused():
    with pytest.raises(
        sf.UsageError, match="more than 60 different covariances, too many for a closed form: give numbers"
    ):
        derive_general(3, 3).closed()
    with pytest.raises(sf.UsageError, match="too many for a closed form: give fewer steps"):
        derive_general(3, 5, 25, 100, 100, architecture="cyclic").closed()


@pytest.mark.slow
def test_outcomes_too_many_for_an_exact_form_are_refused():
    with pytest.raises(
        sf.UsageError, match="step 3 of 5 agents has too many outcomes for an exact form: give fewer agents"
    ):
        derive_general(5, 3, 25, 100, 100).closed()


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("correlation", ["independent", "shared"])
def test_the_optimum_as_a_polynomial(architecture, correlation):
    """The contact chain's paths against the enumeration of the optimum, A_c by A_c, in rational numbers."""
    steps = 2 if architecture == "ad-hoc" else 3
    given = {"architecture": architecture, "correlation": correlation}
    chain = sf.derive_optimal(3, steps, "7/3", "5", "11/2", **given)
    assert chain.bernstein == derive_general(3, steps, "7/3", "5", "11/2", estimator="optimal", **given).bernstein


def test_the_optimum_with_symbols():
    form = sf.derive_optimal(3, 3)
    value = form.lambdify()(np.array([0.3, 0.8]), 25.0, 100.0, 100.0)
    np.testing.assert_allclose(value, sf.predict(sf.load_scenario(), [0.3, 0.8], "optimal").values()[:, 2], rtol=1e-12)
    assert len(sf.derive_optimal(3, 5, 25, 100, 100).terms) == 21
    made = derivation.derivation(form)
    assert "expected optimal posterior covariance P_k after step k (exact: every path" in made.title
    assert made.facts["quantity"] == "optimal"
    with pytest.raises(sf.UsageError, match="450 links make polynomials of degree 450, at most 400 are worked out"):
        sf.derive_optimal(10, 5, 1, 1, 1).polynomial()
    with pytest.raises(sf.UsageError, match="paths or more, at most 20000"):
        sf.derive_optimal(30, 9, 1, 1, 1).polynomial()


def _errors_of_naive(agents: int, steps: int, q: Fraction, r: Fraction, p0: Fraction, b: Fraction) -> list[Fraction]:
    """Mean squared error of naive fusion by number of arrivals: every outcome, x̂ as weights of noises, by hand."""
    pairs = [(k, i, j) for k in range(steps) for i in range(agents) for j in range(agents) if i != j]
    variances = {"b": b * b} | {("x", i): p0 for i in range(agents)}
    total = [Fraction(0)] * (len(pairs) + 1)
    for arrives in itertools.product((0, 1), repeat=len(pairs)):
        heard = dict(zip(pairs, arrives, strict=True))
        state = [({"b": Fraction(1), ("x", i): Fraction(1)}, p0) for i in range(agents)]
        for k in range(steps):
            if k:
                local = []
                for i, (weights, P) in enumerate(state):
                    prior = P + q
                    gain = prior / (prior + r)
                    moved = {s: (1 - gain) * c for s, c in weights.items()}
                    moved["w", k] = moved.get(("w", k), Fraction(0)) - (1 - gain)
                    moved["v", k, i] = gain
                    variances |= {("w", k): q, ("v", k, i): r}
                    local.append((moved, (1 - gain) * prior))
                state = local
            fused = []
            for i in range(agents):
                together = [state[i]] + [state[j] for j in range(agents) if j != i and heard[k, i, j]]
                P = 1 / sum(1 / other for _, other in together)
                weights = {}
                for other, own in together:
                    for s, c in other.items():
                        weights[s] = weights.get(s, Fraction(0)) + P / own * c
                fused.append((weights, P))
            state = fused
        total[sum(arrives)] += sum(variances[s] * c * c for weights, _ in state for s, c in weights.items()) / agents
    return total


def test_the_squared_error_of_naive_fusion_is_that_of_every_outcome_by_hand():
    numbers = [Fraction(7), Fraction(90), Fraction(130)]
    form = sf.derive_general(2, 3, *map(str, numbers), estimator="naive").showing("rms", "-15/2")
    expected = _errors_of_naive(2, 3, *numbers, Fraction(-15, 2))
    assert list(form.bernstein) == [sympy.Rational(a.numerator, a.denominator) for a in expected]


@pytest.mark.parametrize("start", ["independent", "shared"])
@pytest.mark.parametrize("architecture", ["ad-hoc", "cyclic"])
@pytest.mark.parametrize("quantity", ["actual", "rms"])
def test_errors_as_formulas_are_those_that_are_predicted(quantity, architecture, start):
    scenario = sf.load_scenario(
        {
            "model": {"F": 1.0, "H": 1.0, "Q": 7.0, "R": 90.0},
            "initial": {"P": 130.0, "correlation": start, "error": -10.0},
            "network": {"agents": 3, "steps": 2, "architecture": architecture},
        }
    )
    form = sf.derive_general(3, 2, 7, 90, 130, architecture=architecture, correlation=start)
    found = float(form.showing(quantity, -10 if quantity == "rms" else None).polynomial().eval(0.3))
    predicted = sf.predict(scenario, [0.3], "general", quantity).values()[0, -1]
    assert (found if quantity == "actual" else found**0.5) == pytest.approx(predicted, rel=1e-12)


def test_symbols_of_the_squared_error_are_put_in_by_their_order():
    form = sf.derive_general(2, 2, r=100).showing("rms")
    assert [str(s) for s in form.symbols] == ["q", "p0", "b"]
    numbers = sf.derive_general(2, 2, 25, 100, 64).showing("rms", -3)
    assert form.lambdify()(0.4, 25, 64, -3) == pytest.approx(float(numbers.polynomial().eval(0.4)), rel=1e-12)


def test_what_a_quantity_is_refused_with():
    with pytest.raises(UsageError, match="quantity: expected one of claimed, actual, rms, got 'bias'"):
        sf.derive_general(2, 2).showing("bias")
    with pytest.raises(UsageError, match="quantity actual: expected formulation general or naive, got optimal"):
        sf.derive_optimal(2, 2).showing("actual")
    with pytest.raises(UsageError, match="initial_error: expected quantity rms, got actual"):
        sf.derive_general(2, 2).showing("actual", 1)
    with pytest.raises(UsageError, match="initial_error: expected a number, got 'x'"):
        sf.derive_general(2, 2).showing("rms", "x")
