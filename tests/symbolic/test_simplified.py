"""Proofs by SymPy, and agreement of formulas with numbers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy.polys.fields import field

import stochfuse as sf
from stochfuse.kalman.algebra import FIELD, SYMPY, inverse
from stochfuse.kalman.kernel import Estimate, predict, to_information, update
from stochfuse.prediction.simplified import average, outcome, outcome_as_printed, outcome_by_information
from stochfuse.symbolic.simplified import MU, P0, Q, R, derive_simplified
from tests.oracles import textbook
from tests.oracles.strategies import mapping, same


def scalar_field():
    K, p, h, r, z, x = field("p,h,r,z,x", sympy.QQ)
    cell = lambda value: np.array([[value]], dtype=object)  # noqa: E731
    return K, Estimate(cell(x), cell(p)), cell(h), cell(r), cell(z)


def matrix_field(measurements=1):
    names = "a,b,c,h11,h12,h21,h22,r11,r12,r22,z1,z2,x1,x2"
    K, a, b, c, h11, h12, h21, h22, r11, r12, r22, z1, z2, x1, x2 = field(names, sympy.QQ)
    obj = lambda rows: np.array(rows, dtype=object)  # noqa: E731
    prior = Estimate(obj([[x1], [x2]]), obj([[a, b], [b, c]]))
    if measurements == 1:
        return K, prior, obj([[h11, h12]]), obj([[r11]]), obj([[z1]])
    return K, prior, obj([[h11, h12], [h21, h22]]), obj([[r11, r12], [r12, r22]]), obj([[z1], [z2]])


@pytest.mark.parametrize("make", [scalar_field, matrix_field])
@pytest.mark.parametrize("m", [0, 1, 2, 3])
def test_m_arrivals_make_one_update_with_m_plus_1_measurements(make, m):
    """[(m+1) P⁻¹(k|k) − m P⁻¹(k|k−1)]⁻¹ = update(P(k|k−1), R/(m+1)), covariance and state, for any symbols."""
    _, prior, H, R_, z = make()
    printed = outcome_as_printed(prior, H, R_, m, z, algebra=FIELD)
    by_update = outcome(prior, H, R_, m, z, algebra=FIELD)
    assert same(printed.P, by_update.P)
    assert same(printed.x, by_update.x)
    by_information = outcome_by_information(Estimate(None, prior.P), H, R_, m, algebra=FIELD)
    assert same(printed.P, by_information.P)


def test_the_identity_for_two_states_and_two_measurements_is_the_information_sum():
    """In information form the 2×2 identity is (m+1)(Y + J) − mY = Y + (m+1)J, entry by entry, with J = HᵀR⁻¹H."""
    _, prior, H, R_, _ = matrix_field(measurements=2)
    before = to_information(Estimate(None, prior.P), algebra=FIELD).Y
    J = H.T @ FIELD.solve(R_, H)
    local = before + J
    for m in range(4):
        combined = H.T @ FIELD.solve(R_ / (m + 1), H)
        assert same((m + 1) * local - m * before, before + combined)


def weights(agents, mu):
    return [sympy.binomial(agents - 1, m) * mu**m * (1 - mu) ** (agents - 1 - m) for m in range(agents)]


@pytest.mark.parametrize("agents", [2, 3, 4])
def test_the_consistent_state_equation_is_unbiased_and_the_printed_one_is_not(agents):
    """If prior and measurement are unbiased, E[x̂] of the consistent (53) is the true state x; the printed form gives
    E[P_m] E[P_m⁻¹] x.
    """
    p, r, x, mu = sympy.symbols("p r x mu", positive=True)
    one, cell = sympy.eye(1), lambda v: sympy.Matrix([[v]])
    prior = Estimate(cell(x), cell(p))  # E[x̂⁻] = x, E[z] = x
    w = weights(agents, mu)
    outcomes = [outcome_as_printed(prior, one, cell(r), m, cell(x), algebra=SYMPY) for m in range(agents)]
    consistent = average(outcomes, w)
    assert sympy.cancel(consistent.x[0, 0] - x) == 0
    mean_P = consistent.P[0, 0]
    information = sum(wi * (inverse(o.P, SYMPY) @ o.x)[0, 0] for wi, o in zip(w, outcomes, strict=True))
    mean_information = sum(wi * inverse(o.P, SYMPY)[0, 0] for wi, o in zip(w, outcomes, strict=True))
    printed = mean_P * information
    assert sympy.cancel(printed / x - mean_P * mean_information) == 0
    bias = sympy.cancel(printed / x)
    half = {p: 1, r: 1, mu: sympy.Rational(1, 2)}
    assert bias.subs(half) > 1
    assert bias.subs(mu, 0) == 1
    assert sympy.cancel(bias.subs(mu, 1)) == 1


def test_the_bias_factor_at_step_one_is_7_6():
    """Erratum 1: 1.1667 at µ = 1/2, n = 3."""
    w = [v.subs(MU, sympy.Rational(1, 2)) for v in weights(3, MU)]
    factor = sum(v / (m + 1) for m, v in enumerate(w)) * sum(v * (m + 1) for m, v in enumerate(w))
    assert factor == sympy.Rational(7, 6)


@pytest.mark.parametrize("make", [scalar_field, matrix_field])
@pytest.mark.parametrize("agents", [2, 3])
def test_limits_are_broadcast_fusion_and_the_kalman_filter(make, agents):
    """(54) at µ = 1 is (30); at µ = 0 the Kalman filter."""
    K, prior, H, R_, _ = make()
    prior = Estimate(None, prior.P)
    outcomes = [outcome(prior, H, R_, m, algebra=FIELD) for m in range(agents)]
    local = update(prior, H, R_, algebra=FIELD)
    at_0 = average(outcomes, [K(int(v.subs(MU, 0))) for v in weights(agents, MU)])
    assert same(at_0.P, local.P)
    at_1 = average(outcomes, [K(int(v.subs(MU, 1))) for v in weights(agents, MU)])
    informations = [to_information(e, algebra=FIELD).Y for e in (local, prior)]
    broadcast = inverse(agents * informations[0] - (agents - 1) * informations[1], FIELD)
    assert same(at_1.P, broadcast)


@pytest.mark.parametrize(("agents", "step"), [(1, 4), (2, 3), (3, 1), (3, 2), (3, 3), (5, 2)])
def test_closed_forms_with_symbols_are_exact(agents, step):
    form = derive_simplified(agents, step)
    values = {Q: Fraction(25, 3), R: Fraction(7), P0: Fraction(90), MU: Fraction(2, 7)}
    exact = textbook.simplified_scalar_fractions(values[Q], values[R], values[P0], agents, values[MU], step)
    at = {s: sympy.Rational(v.numerator, v.denominator) for s, v in values.items()}
    for k in range(1, step + 1):
        assert form.closed(k).subs(at) == sympy.Rational(exact[k - 1].numerator, exact[k - 1].denominator)


def test_closed_forms_with_numbers_are_exact_rational_functions_of_mu():
    form = derive_simplified(3, 5, q="25", r=100, p0="0.1")
    numerator, denominator = sympy.fraction(form.closed())
    assert numerator.free_symbols == denominator.free_symbols == {MU}
    assert sympy.gcd(numerator, denominator) == 1
    exact = textbook.simplified_scalar_fractions(25, 100, Fraction(1, 10), 3, Fraction(1, 3), 5)[-1]
    assert form.closed().subs(MU, sympy.Rational(1, 3)) == sympy.Rational(exact.numerator, exact.denominator)


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{}, {"q": 25, "r": 100, "p0": 100}, {"r": 2}])
def test_derivative_and_series(numbers):
    form = derive_simplified(3, 2, **numbers)
    at = {Q: 25, R: 100, P0: 100}
    point = sympy.Rational(3, 10)
    function = form.closed().subs(at)
    assert form.derivative().subs(at).subs(MU, point) == sympy.diff(function, MU).subs(MU, point)
    for place in (0, 1):
        series = form.series(place).subs(at).doit()
        for order in range(3):
            assert sympy.diff(series, MU, order).subs(MU, place) == sympy.diff(function, MU, order).subs(MU, place)
    with pytest.raises(sf.UsageError, match="series: expected µ = 0 or 1, got 2"):
        form.series(2)


def test_fixed_point_equation_and_polynomial_hold_at_the_numeric_steady_state():
    form = derive_simplified(3, 2, q=25, r=100)
    steady = sf.steady_state(sf.load_scenario(), [0.5]).P[0, 0, 0, 0]
    P = next(iter(form.fixed_point().lhs.free_symbols))
    at = {P: steady, MU: 0.5}
    assert float(form.fixed_point().rhs.subs(at)) == pytest.approx(steady, rel=1e-13)
    polynomial = form.fixed_point_polynomial()
    scale = sum(abs(c.subs(MU, 0.5)) * steady**power for (power,), c in polynomial.terms())
    assert abs(polynomial.as_expr().subs(at)) <= 1e-13 * scale


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.integers(1, 6),
    st.integers(1, 6),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 1e3),
    st.booleans(),
)
def test_lambdified_chain_equals_the_numeric_form(agents, step, q, r, p0, shared):
    correlation = "shared" if shared else "independent"
    link = np.array([0.0, 0.2, 0.7, 1.0])
    formula = derive_simplified(agents, step, correlation=correlation).lambdify()
    source = mapping(1.0, q, 1.0, r, p0, agents=agents, steps=step)
    source["initial"]["correlation"] = correlation
    numeric = sf.predict(sf.Scenario.from_mapping(source), link).values()[:, -1]
    np.testing.assert_allclose(formula(link, q, r, p0) * np.ones(4), numeric, rtol=1e-12)


@pytest.mark.parametrize("form", [derive_simplified(1, 2), derive_simplified(3, 1, correlation="shared")])
def test_lambdified_functions_keep_the_shape_of_mu(form):
    assert form.lambdify()(np.array([0.0, 0.5, 1.0]), 1.0, 1.0, 1.0).shape == (3,)


def test_the_chain_goes_on_where_the_expanded_form_stops():
    form = derive_simplified(3, 8)
    assert not form.expandable
    assert [str(name) for name, _ in form.chain[:3]] == ["P_1", "P_2_prior", "P_2"]
    with pytest.raises(sf.UsageError, match=r"step 8 for 3 agents has a denominator of 2187 factors; use the chain"):
        form.closed()
    value = form.lambdify()(0.5, 25.0, 100.0, 100.0)
    assert value == pytest.approx(sf.predict(sf.load_scenario(steps=8), [0.5]).values()[0, -1], rel=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"agents": 0}, "agents: expected 1 to 100 for formulas, got 0"),
        ({"step": 0}, "step: expected 1 to 100 for formulas, got 0"),
        ({"q": "abc"}, "q: expected a number, got 'abc'"),
        ({"step": 101}, "step: expected 1 to 100 for formulas, got 101"),
        ({"q": "1e99999"}, "q: expected a number, got '1e99999'"),
        ({"q": -1}, "q: expected a number of at least 0, got -1"),
        ({"q": "nan"}, "q: expected a number"),
        ({"p0": "1/0"}, "p0: expected a number"),
        ({"r": 0}, "r: expected a positive number, got 0"),
        ({"q": 0, "p0": 0}, "q and p0: expected at least one of them positive"),
    ],
)
def test_bad_requests(arguments, message):
    with pytest.raises(sf.UsageError, match=message):
        derive_simplified(**arguments)


def test_the_kernel_predicts_symbols_like_the_recursion_says():
    p, q = sympy.symbols("p q")
    prior = predict(Estimate(None, sympy.Matrix([[p]])), sympy.eye(1), sympy.Matrix([[q]]), algebra=SYMPY)
    assert sympy.Matrix([[p + q]]) == prior.P
