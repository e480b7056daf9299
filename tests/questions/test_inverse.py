"""Questions asked backwards: against closed forms, 50-digit arithmetic, brute force and finite differences."""

from __future__ import annotations

import csv
import io
import json
from itertools import pairwise
from math import comb

import mpmath as mp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from typer.testing import CliRunner

import stochfuse as sf
from stochfuse.cli.app import app
from stochfuse.questions.agents_needed import agents_needed
from stochfuse.questions.least_link import intervals, least_link, remembered, scanned, separated
from stochfuse.questions.question import question
from stochfuse.questions.sensitivity import sensitivity, share_of_gain
from stochfuse.report.solutions import sensitivity_sheet
from stochfuse.scenario.network import LinkRows
from tests.oracles import textbook
from tests.oracles.strategies import mapping, model


def scenario(*matrices, error=None, correlation="independent", sensors=None, **network):
    source = mapping(*matrices, **network)
    source["initial"]["correlation"] = correlation
    if error is not None:
        source["initial"]["error"] = error
    if sensors is not None:
        source["agent"] = sensors
    return sf.Scenario.from_mapping(source)


def thesis(**network):
    return scenario(1.0, 25.0, 1.0, 100.0, 100.0, **{"steps": 5, **network})


# --- crossings ------------------------------------------------------------------------------------------------------


def bernstein_of(roots, degree):
    """Bernstein coefficients of Π (x − root), raised to a degree, by interpolation in 50 digits."""
    with mp.workdps(50):
        nodes = [mp.mpf(i) / degree for i in range(degree + 1)]
        values = mp.matrix([mp.fprod(x - r for r in map(mp.mpf, roots)) for x in nodes])
        basis = mp.matrix(
            [[mp.binomial(degree, c) * x**c * (1 - x) ** (degree - c) for c in range(degree + 1)] for x in nodes]
        )
        return np.array([float(b) for b in mp.lu_solve(basis, values)])


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.001, 0.999), min_size=1, max_size=6))
def test_every_root_of_a_polynomial_has_a_cell_of_its_own(roots):
    roots = sorted(roots)
    assume(all(b - a > 1e-3 for a, b in pairwise(roots)))
    cells = separated(bernstein_of(roots, 12))
    assert cells[0] == 0
    assert cells[-1] == 1
    for a, b in pairwise(cells):
        assert sum(a < r < b for r in roots) <= 1


def test_polynomial_intervals_are_those_between_the_roots():
    roots = [0.2, 0.2001, 0.7]
    f = lambda x: np.prod([x - r for r in roots], axis=0)  # noqa: E731
    found = intervals(f, separated(bernstein_of(roots, 8)), 0.0)
    np.testing.assert_allclose(found, [(0.0, 0.2), (0.2001, 0.7)], atol=1e-10)


def test_a_polynomial_that_only_touches_the_target_is_not_cut_without_end():
    assert len(separated(bernstein_of([0.3, 0.3], 4))) < 200
    assert separated(np.ones(7)).tolist() == [0.0, 1.0]
    noise = np.random.default_rng(1).normal(size=40) * 1e-16
    assert len(separated(noise)) < 2**20


def test_a_scan_follows_dips_between_its_points():
    centre, depth = 0.4321 + 1e-4 / 3, 1e-9
    f = lambda x: (x - centre) ** 2  # noqa: E731
    found = intervals(f, scanned(f, depth), depth)
    np.testing.assert_allclose(found, [(centre - np.sqrt(depth), centre + np.sqrt(depth))], atol=1e-9)
    above = lambda x: -((x - centre) ** 2)  # noqa: E731
    found = intervals(above, scanned(above, -depth), -depth)
    np.testing.assert_allclose(found, [(0, centre - np.sqrt(depth)), (centre + np.sqrt(depth), 1)], atol=1e-9)


@pytest.mark.parametrize(
    "f",
    [
        lambda x: np.exp(12 * (0.3 - x)),
        lambda x: np.where(x < 0.25, np.inf, 1 / (np.abs(x - 0.25) + 1e-9)) - 1e8 + 1,
        lambda x: 1 - (x - 0.7) ** 9,
        lambda x: 2.0 - (x >= 0.123),
    ],
)
def test_what_costs_much_is_asked_seldom_and_closed_in_on_as_tightly(f):
    asked = []
    costly = remembered(lambda x: (asked.extend(x), f(x))[1])
    ends = np.array([0.0, 1.0])
    np.testing.assert_allclose(intervals(costly, ends, 1.0, 2), intervals(f, ends, 1.0), rtol=0, atol=1e-15)
    assert len(set(asked)) == len(asked) < 66  # halving alone takes 54


# --- least link probability -----------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 12), st.floats(1e-6, 1.0))
def test_step_one_has_a_closed_form(n, µ):
    """E[1/(1+K)] = (1 − (1−µ)^n)/(nµ)."""
    target = 7.0 * -np.expm1(n * np.log1p(-µ)) / (n * µ) if µ < 1 else 7.0 / n
    found = least_link(scenario(1.0, 1.0, 1.0, 1.0, 7.0, agents=n), target, step=1)
    assert found.link == pytest.approx(µ, abs=1e-9)
    assert found.value <= target * (1 + 1e-14)
    assert found.proof == "monotone"


def in_fifty_digits(µ, q, r, p0, n, steps, shared):
    weights = [mp.binomial(n - 1, m) * µ**m * (1 - µ) ** (n - 1 - m) for m in range(n)]
    P = mp.mpf(p0) if shared else mp.fsum(w * p0 / mp.mpf(m + 1) for m, w in enumerate(weights))
    for _ in range(steps - 1):
        P = mp.fsum(w / (1 / (P + q) + (m + 1) / mp.mpf(r)) for m, w in enumerate(weights))
    return P


magnitudes = st.floats(-3, 3).map(lambda x: float(10**x))


@settings(max_examples=25, deadline=None)
@given(
    magnitudes, st.floats(-3, 8).map(lambda x: float(10**x)), magnitudes, st.integers(2, 6), st.integers(2, 5),
    st.booleans(), st.floats(0.001, 0.999),
)  # fmt: skip
def test_any_target_within_reach_converges_to_1e_9(q, r, p0, n, steps, shared, share):
    """However flat the curve: r up to 1e8 times the rest makes values differ in their last digits only."""
    with mp.workdps(50):
        zero, one = (in_fifty_digits(mp.mpf(µ), q, r, p0, n, steps, shared) for µ in (0, 1))
        target = float(zero + share * (one - zero))
        assume(one + 1e-13 * one < target < zero - 1e-13 * zero)
        low, high = mp.mpf(0), mp.mpf(1)
        for _ in range(100):
            middle = (low + high) / 2
            met = in_fifty_digits(middle, q, r, p0, n, steps, shared) <= target
            low, high = (low, middle) if met else (middle, high)
    s = scenario(1.0, q, 1.0, r, p0, agents=n, steps=steps, correlation="shared" if shared else "independent")
    found = least_link(s, target)
    assert abs(found.link - high) < 1e-9
    assert found.enclosure[0] - 1e-16 <= high <= found.enclosure[1] + 1e-16
    assert found.reachable == pytest.approx((float(zero), float(one)), rel=1e-12)
    assert found.share == pytest.approx(float((zero - target) / (zero - one)), abs=1e-12 * float(zero / (zero - one)))


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("method", ["simplified", "general", "naive", "optimal"])
@pytest.mark.parametrize("of", ["trace", "det", "max-eig", "std:x2", "rms:x1,x2"])
def test_the_value_at_the_answer_is_the_target(architecture, method, of):
    s = scenario(*model(np.random.default_rng(5), 2, 1), steps=3, agents=3, architecture=architecture)
    ends = sf.predict(s, [0.0, 1.0], method).values(of)[:, -1]
    target = 0.4 * ends[0] + 0.6 * ends[1]
    found = least_link(s, target, method=method, of=of)
    again = sf.predict(s, [max(found.link - 1e-6, 0), found.link, found.link + 1e-6], method).values(of)[:, -1]
    assert again[1] == pytest.approx(target, rel=1e-12)
    assert again[0] > target > again[2]
    assert found.below > target >= found.above
    assert found.value == pytest.approx(target, rel=1e-14)
    assert found.reachable == pytest.approx(tuple(ends), rel=1e-12)
    assert found.proof == {"simplified": "monotone", "optimal": "monotone"}.get(
        method, "polynomial" if of == "trace" else "scan"
    )


def test_exact_answers_of_the_thesis_tables():
    """Theory section 10: general, ad hoc, step 3: 25.52113 at 0.5; broadcast, step 4: 30.22397 at 0.25; cyclic 2: 31.34155 at .75."""
    for architecture, step, value, µ in (
        ("ad-hoc", 3, 25.52113, 0.5),
        ("broadcast", 4, 30.22397, 0.25),
        ("cyclic", 2, 31.34155, 0.75),
    ):
        found = least_link(thesis(architecture=architecture), value, step=step, method="general")
        assert found.link == pytest.approx(µ, abs=1e-6)
        assert found.prediction.nature == "exact"


def test_delays_are_the_general_formulation_s():
    s = thesis(agents=2, steps=3, delay=[0.5, 0.5])
    found = least_link(s, 38.0, method="general")
    link = np.full((2, 2), found.link)
    P, _ = textbook.expected_by_enumeration(
        np.eye(1), 25 * np.eye(1), [(np.eye(1), 100 * np.eye(1))] * 2, 100 * np.eye(1), np.zeros((1, 1)),
        np.zeros((3, 2, 1, 1)), "ad-hoc", [link] * 3, (0.5, 0.5),
    )  # fmt: skip
    assert P[-1].mean() == pytest.approx(38.0, rel=1e-12)


@pytest.mark.parametrize("method", ["general", "naive"])
def test_all_intervals_of_a_curve_that_first_rises(method):
    """RMS error with a common initial bias, handbook: what is true: brute force on a fine grid finds the same."""
    s = thesis(steps=3, agents=2)
    s = scenario(1.0, 25.0, 1.0, 100.0, 100.0, steps=3, agents=2, error=-1000.0)
    grid = np.linspace(0, 1, 20_001)
    values = sf.predict(s, grid, method, "rms").values()[:, -1]
    peak = values.max()
    assert peak > 1.01 * values[0]
    for target in (0.5 * (values[0] + peak), 0.5 * (values[0] + values[-1])):
        found = least_link(s, target, method=method, quantity="rms")
        met = values <= target
        changes = grid[1:][met[1:] != met[:-1]]
        ends = np.array(found.met).ravel()
        np.testing.assert_allclose(ends[(ends > 0) & (ends < 1)], changes, atol=1e-4)
        assert (found.link == 0) == bool(met[0])
        assert found.proof == "scan"


def test_the_least_value_need_not_be_at_either_end():
    """Step 3 of the bias: it rises, falls; of a target below everything the best is told."""
    s = scenario(1.0, 25.0, 1.0, 100.0, 100.0, steps=3, agents=2, error=-1000.0)
    best = np.abs(sf.predict(s, np.linspace(0, 1, 1001), "general", "bias").values()[:, -1]).min()
    with pytest.raises(
        sf.NoAnswerError, match=rf"size of the bias, x at step 3 \(general\) is {best:.6g}\d* at best, at µ = 1"
    ):
        least_link(s, 1.0, method="general", quantity="bias")


def test_what_no_link_already_meets_needs_none():
    found = least_link(thesis(), 1e6)
    assert (found.link, found.met, found.share, found.enclosure) == (0.0, ((0.0, 1.0),), 0.0, (0.0, 0.0))


@pytest.mark.parametrize("method", ["simplified", "general", "optimal"])
def test_a_target_out_of_reach_says_what_is_within(method):
    s = thesis(steps=3)
    best = sf.predict(s, [1.0], method).values()[0, -1]
    with pytest.raises(
        sf.NoAnswerError,
        match=rf"variance of x at step 3 \({method}\) is {best:.9g} at best, at µ = 1; expected a target of at least that, got 3",
    ):
        least_link(s, 3.0, method=method)
    assert least_link(s, best, method=method).link == pytest.approx(1.0, abs=1e-9)  # as printed in full


def test_one_agent_alone_has_nothing_to_choose():
    s = thesis(agents=1, steps=2)
    value = sf.predict(s, [0.0]).values()[0, -1]
    found = least_link(s, value * 1.01)
    assert (found.link, found.share) == (0.0, None)
    with pytest.raises(sf.NoAnswerError, match="at best"):
        least_link(s, value * 0.99)


@pytest.mark.parametrize("mu", [0.05, 0.4, 0.9])
def test_steady_state_against_its_own_equation(mu):
    """For a given P, P = Σ β(m) P_m(P) is an equation in µ alone."""
    P = sf.steady_state(thesis(), [mu]).P.item()
    found = least_link(thesis(), P, steady=True)

    def equation(µ):
        return sum(textbook.binomial(m, 2, µ) / (1 / (P + 25) + (m + 1) / 100) for m in range(3)) - P

    assert found.link == pytest.approx(brentq(equation, 0, 1, xtol=1e-14), abs=1e-11)
    assert found.bound <= 1e-11
    assert found.enclosure[0] <= mu <= found.enclosure[1]


@pytest.mark.slow
def test_steady_state_of_unlike_agents():
    """Agent 2 sees little by itself: with F = 1.2 it lives on what agent 1 sends it."""
    s = scenario(1.2, 1.0, 1.0, 1.0, 1.0, agents=2, steps=2, sensors=[{}, {"H": 1.0, "R": 1e4}])
    found = least_link(s, 5.0, steady=True, agent=2)
    steady = sf.steady_state(s, [found.link - 1e-9, found.link])
    before, at = steady.P[:, steady.group_of[1], 0, 0]
    assert at == pytest.approx(5.0, rel=1e-11)
    assert before > 5.0
    assert found.reachable[0] > 1000


# --- sensitivities --------------------------------------------------------------------------------------------------


def by_enumeration(architecture, links, steps, n, naive=False):
    E = np.eye(1)
    P, _ = textbook.expected_by_enumeration(
        E, 25 * E, [(E, 100 * E)] * n, 100 * E, np.zeros((1, 1)), np.zeros((steps, n, 1, 1)), architecture,
        [links] * steps, naive=naive,
    )  # fmt: skip
    return P[-1, :, 0, 0]


def differences(f, M, i, j, h=1e-3):
    """Central differences of order four, exact for polynomials of degree four; one-sided at the ends."""

    def at(x):
        changed = M.copy()
        changed[i, j] = x
        return f(changed)

    x = np.atleast_1d(M[i, j])[0]
    if x - 2 * h < 0 or x + 2 * h > 1:
        s = 1 if x < 0.5 else -1
        terms = zip((-25 / 12, 4, -3, 4 / 3, -1 / 4), range(5), strict=True)
        return s * sum(w * at(x + s * m * h) for w, m in terms) / h
    return (8 * (at(x + h) - at(x - h)) - (at(x + 2 * h) - at(x - 2 * h))) / (12 * h)


LINKS = {
    "ad-hoc": np.array([[0, 0.3], [1.0, 0]]),
    "broadcast": np.array([[0, 0.6, 0.0], [0.2, 0, 0.0], [0.2, 0.6, 0]]),
    "cyclic": np.array([[0, 0.6, 0.5], [0.5, 0, 1.0], [0.2, 0.5, 0]]),
}


@pytest.mark.parametrize("architecture", LINKS)
@pytest.mark.parametrize("method", ["general", "naive"])
def test_exact_sensitivities_against_differences_of_a_naive_enumeration(architecture, method):
    M = LINKS[architecture]
    n, steps = len(M), 3 if architecture == "ad-hoc" else 2
    found = sensitivity(thesis(agents=n, steps=steps, architecture=architecture), M, method=method, agent=1)
    senders = {"ad-hoc": n * (n - 1), "broadcast": n, "cyclic": n}
    assert len(found.links) == senders[architecture]
    assert found.exact
    for (sender, heard), slope, µ in zip(found.links, found.derivative, found.link, strict=True):
        rows = [i - 1 for i in heard]
        assert M[rows[0], sender - 1] == µ
        expected = differences(
            lambda links: by_enumeration(architecture, links, steps, n, method == "naive")[0], M, rows, sender - 1
        )
        assert slope == pytest.approx(expected, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("agent", [1, 3, "mean", "worst"])
def test_simplified_sensitivities_of_unlike_agents(agent):
    rng = np.random.default_rng(3)
    F, Q, H, R, P0 = model(rng, 2, 1)
    sensors = [(H, R), (H, 4 * R), (H, 0.25 * R)]
    s = scenario(F, Q, H, R, P0, agents=3, steps=4, sensors=[{"R": r.tolist()} for _, r in sensors])
    M = rng.uniform(0.1, 0.9, size=(3, 3))

    def value(links):
        traces = [np.trace(textbook.simplified_subsets(F, Q, sensors, P0, [links] * 4, 4, i)[-1]) for i in range(3)]
        return (
            {"mean": np.mean(traces), "worst": np.max(traces)}.get(agent)
            if isinstance(agent, str)
            else traces[agent - 1]
        )

    found = sensitivity(s, M, agent=agent)
    assert not found.exact
    assert found.value == pytest.approx(value(M), rel=1e-12)
    for (sender, (receiver,)), slope in zip(found.links, found.derivative, strict=True):
        assert slope == pytest.approx(differences(value, M, receiver - 1, sender - 1), rel=1e-7, abs=1e-9)
    best = found.links[found.first[0]]
    assert found.derivative[found.order[0]] == found.derivative.min() < 0
    assert (
        f"Improve first: the link from agent {best[0]} to {best[1][0]}; +0.01 there lowers"
        in sensitivity_sheet(found).answer[0]
    )
    most = max(range(len(found.links)), key=lambda i: -found.derivative[i] * (1 - found.link[i]))
    sheet = sensitivity_sheet(found)
    told = [line for line in sheet.answer if line.startswith("Perfect, the link from agent ")]
    assert len(told) == (most not in found.first)
    if told:
        (sender, (receiver,)) = found.links[most]
        assert told[0].startswith(f"Perfect, the link from agent {sender} to {receiver} would lower it most: by about ")
    gains = [link["gain_if_perfect"] for link in sheet.facts["links"]]
    assert max(gains) == pytest.approx(-found.derivative[most] * (1 - found.link[most]), rel=1e-12)


@pytest.mark.parametrize(("of", "rate"), [("std:x1", None), ("det", None), ("max-eig", None)])
def test_metrics_that_are_not_linear(of, rate):
    s = scenario(*model(np.random.default_rng(8), 2, 1), agents=2, steps=3)
    M = np.array([[0, 0.35], [0.8, 0]])
    found = sensitivity(s, M, method="general", of=of)
    value = lambda links: sf.predict(s, links[None], "general").values(of)[0, -1]  # noqa: E731
    for (sender, (receiver,)), slope in zip(found.links, found.derivative, strict=True):
        assert slope == pytest.approx(differences(value, M, receiver - 1, sender - 1), rel=1e-7)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("method", ["simplified", "general"])
@pytest.mark.parametrize("mu", [0.0, 0.4, 1.0])
def test_like_links_share_the_derivative_in_their_common_probability(architecture, method, mu):
    s = thesis(steps=2, architecture=architecture)
    together = sensitivity(s, mu, method=method)
    apart = np.mean([sensitivity(s, mu, method=method, agent=i).derivative for i in (1, 2, 3)], axis=0)
    np.testing.assert_allclose(together.derivative, apart, rtol=1e-9)
    assert len(set(together.derivative)) == 1
    assert together.first == (() if mu == 1 else tuple(range(len(together.links))))


def test_steady_sensitivities():
    found = sensitivity(thesis(agents=2), 0.5, steady=True, agent=1)
    h = 1e-4
    value = lambda µ: sf.steady_state(thesis(agents=2), [µ]).P.item()  # noqa: E731
    # with two agents what agent 1 hears is its one link
    assert found.derivative[0] == pytest.approx((value(0.5 + h) - value(0.5 - h)) / (2 * h), rel=1e-6)
    assert found.links[0] == (2, (1,))
    assert found.derivative[1] == 0.0


PER_STEP = [[[0, 0.3], [1.0, 0]], [[0, 0.9], [0.0, 0]], [[0, 0.02], [0.5, 0]]]


def test_exact_sensitivities_of_links_per_step():
    """E is affine in each µ_ij(k): its derivatives are differences of E at 1 and 0, summed over the steps."""
    s = thesis(agents=2, steps=3, link=PER_STEP)
    found = sensitivity(s, method="general")
    assert found.exact
    np.testing.assert_allclose(found.link, [np.mean([0.3, 0.9, 0.02]), 0.5], rtol=1e-12)
    for (sender, (receiver,)), slope in zip(found.links, found.derivative, strict=True):
        wanted = 0.0
        for k in range(3):
            ends = np.tile(np.array(PER_STEP), (2, 1, 1, 1))
            ends[:, k, receiver - 1, sender - 1] = [0.0, 1.0]
            wanted += float(np.diff(sf.predict(s, LinkRows(None, ends), "general").values()[:, -1])[0])
        assert slope == pytest.approx(wanted, rel=1e-9)


def test_simplified_sensitivities_of_twenty_agents_and_of_links_per_step():
    """Against differences of `predict`, the link moved in all steps at once, as far as it can be."""
    n, h = 20, 1e-4
    link = np.random.default_rng(4).uniform(0.05, 0.95, size=(3, n, n))
    link[0, 3, 4], link[1, 3, 4] = 0.0, 1.0  # no room to move all
    sensors = [{"R": 100.0 + 300.0 * (i % 2)} for i in range(n)]
    s = scenario(1.0, 25.0, 1.0, 100.0, 100.0, agents=n, steps=3, sensors=sensors, link=link.tolist())
    found = sensitivity(s, of="std:x")
    assert len(found.links) == n * (n - 1)
    for sender, receiver in ((5, 4), (1, 20)):
        moves = np.array([[h] * 3, [-h] * 3])
        if sender == 5:
            moves = np.array([[h, 0, h], [0, 0, 0], [0, 0, 0], [0, -h, 0]])
        rows = np.tile(link, (len(moves), 1, 1, 1))
        rows[:, :, receiver - 1, sender - 1] += moves
        E = sf.predict(s, LinkRows(None, rows)).values("std:x")[:, -1]
        # one-sided where it cannot be central, to first order in h
        wanted = (E[0] - E[1]) / (2 * h) if sender == 1 else (E[0] - E[1]) / h + (E[2] - E[3]) / h
        (place,) = [i for i, of in enumerate(found.links) if of == (sender, (receiver,))]
        assert found.derivative[place] == pytest.approx(wanted, rel=1e-6 if sender == 1 else 1e-3)


def test_a_link_that_is_not_heard_is_none():
    s = thesis(agents=3, steps=2, link=0.5, hears=[[2], [1, 3], [2]])
    assert {(i, j) for i, (j,) in sensitivity(s).links} == {(2, 1), (1, 2), (3, 2), (2, 3)}


@pytest.mark.slow
def test_the_steady_optimum_asked_backwards():
    """Against what the contact chain gives after so many steps that the first no longer matter."""
    found = least_link(thesis(steps=2), 30.0, steady=True, method="optimal")
    late = sf.predict(thesis(steps=8), [found.link], "optimal").values()[0]
    assert late[-1] == pytest.approx(30.0, rel=1e-4)
    assert abs(late[-1] - 30.0) < abs(late[-3] - 30.0)
    assert found.enclosure[1] - found.enclosure[0] < 1e-8
    slope = sensitivity(thesis(), found.link, steady=True, method="optimal").derivative.sum()
    assert slope == pytest.approx((found.above - found.below) / 2e-9, rel=1e-4)


def test_where_several_are_the_worst_no_single_link_helps():
    found = sensitivity(thesis(), 0.5, agent="worst")
    assert found.first == ()
    assert "where several agents are the worst, all of them must get better" in sensitivity_sheet(found).answer[0]
    best = sensitivity(thesis(), 0.5, agent="best")
    assert (best.derivative < 0).all()


# --- agents needed --------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.floats(0.3, 1.0), st.floats(0.25, 1.2), st.integers(1, 4))
def test_agents_needed_against_counting(µ, share, step):
    one, hundred = np.eye(1), 100 * np.eye(1)

    def value(n):
        return textbook.simplified_literal(one, 25.0, one, hundred, hundred, n, µ, step)[-1].item()

    target, n = share * value(1), 1
    while value(n) > target:
        n += 1
    assume(
        all(abs(value(m) / target - 1) > 1e-12 for m in (n - 1, n) if m)
    )  # what is equal but for rounding may be either
    found = agents_needed(thesis(), target, µ, step=step)
    assert found.agents == n
    assert found.value <= target
    assert (found.fewer is None) if n == 1 else found.fewer > target
    assert found.question.scenario.to_mapping()["network"]["agents"] == n


def test_agents_needed_of_the_optimum_and_in_the_steady_state():
    s = thesis(steps=3)
    found = agents_needed(s, 8.0, 0.3, method="optimal")
    values = [
        sf.predict(thesis(steps=3, agents=n), [0.3], "optimal").values()[0, -1] for n in range(1, found.agents + 1)
    ]
    assert [v <= 8.0 for v in values] == [False] * (found.agents - 1) + [True]
    steady = agents_needed(thesis(), 10.0, 0.5, steady=True)
    below, at = (sf.steady_state(thesis(agents=n), [0.5]).P.item() for n in (steady.agents - 1, steady.agents))
    assert at <= 10.0 < below


def test_agents_that_are_never_enough():
    with pytest.raises(
        sf.NoAnswerError,
        match=r"variance of x at step 5 \(simplified\) is still [\d.]+ with 50 agents at µ = 0.5; expected",
    ):
        agents_needed(thesis(), 0.01, 0.5, max_agents=50)
    limit = sf.predict(thesis(architecture="cyclic", agents=2), [0.5]).values()[0, -1]
    with pytest.raises(sf.NoAnswerError, match=rf"is still {limit:.9g} with 1,000,000 agents"):
        agents_needed(thesis(architecture="cyclic"), 0.9 * limit, 0.5)


# --- share of the gain ----------------------------------------------------------------------------------------------


def test_share_of_the_gain_of_the_thesis_scenario():
    """Theory section 10: at µ = 0.5 between 62.5 and 66.3 per cent by the simplified formulation, 75 to 76 by the general one."""
    found = share_of_gain(thesis(), [0, 0.5, 1])
    table = {
        0: (100, 55.556, 44.615, 41.043, 39.775),
        0.5: (58.333, 32.941, 27.881, 26.609, 26.271),
        1: (33.333, 21.212, 19.365, 19.033, 18.972),
    }
    zero, half, one = (np.array(table[µ]) for µ in (0, 0.5, 1))
    np.testing.assert_allclose(found.share, [np.zeros(5), (zero - half) / (zero - one), np.ones(5)], atol=1e-4)
    general = share_of_gain(thesis(steps=3), [0.5], method="general", step=3)
    assert general.share == pytest.approx(np.array([[(44.615 - 25.52113) / (44.615 - 19.365)]]), abs=1e-4)
    steady = share_of_gain(thesis(), [0.5], steady=True)
    ends = sf.steady_state(thesis(), [0, 0.5, 1]).P.ravel()
    assert steady.share.item() == pytest.approx((ends[0] - ends[1]) / (ends[0] - ends[2]), rel=1e-9)


def test_one_agent_alone_has_nothing_to_gain():
    with pytest.raises(sf.NoAnswerError, match="with every link probability: nothing to gain"):
        share_of_gain(thesis(agents=1))


# --- what does not fit ----------------------------------------------------------------------------------------------

MATRIX = [[0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]]


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: least_link(thesis(), np.nan), "target: expected a finite number of at least 0, got nan"),
        (lambda: least_link(thesis(), -1.0), "target: expected a finite number of at least 0, got -1"),
        (lambda: least_link(thesis(link=MATRIX), 20.0), "one link probability for all links and steps, or none, got link probabilities that differ"),
        (lambda: least_link(thesis(case=[{"name": "a", "link": 0.5}]), 20.0), "or none, got network.case"),
        (lambda: least_link(thesis(), 20.0, step=6), r"step: expected a number from 1 to 5 \(network.steps\), got 6"),
        (lambda: least_link(thesis(), 20.0, step=2, steady=True), "step: expected none with the steady state, got 2"),
        (lambda: least_link(thesis(), 20.0, steady=True, method="general"), "steady: expected method simplified or optimal, whose steady states are enclosed, got general"),
        (lambda: least_link(thesis(), 20.0, method="monte-carlo"), "got monte-carlo: its values are sampled"),
        (lambda: least_link(thesis(), 20.0, method="best"), "method: expected one of simplified, general.* got 'best'"),
        (lambda: least_link(thesis(), 20.0, of="area"), "metric: expected trace.* got 'area'"),
        (lambda: least_link(thesis(), 20.0, quantity="hoped"), "quantity: expected one of claimed.* got 'hoped'"),
        (lambda: sensitivity(thesis()), "sensitivity: expected links to start from, got none here nor in network.link"),
        (lambda: sensitivity(thesis(agents=1), 0.5), "sensitivity: expected agents that hear one another, got no link"),
        (
            lambda: sensitivity(scenario(1.0, 1.0, 1.0, 1.0, 1.0, agents=60, sensors=[{"R": 1.0 + i % 5} for i in range(60)]), 0.5),
            r"takes 5.\de\+10 updates, at most 2e\+08 are made: expected fewer steps or kinds of sensors, or links alike",
        ),
        (lambda: sensitivity(thesis(), [[0, 1], [1, 0]]), "a 3×3 matrix of them .*, or one of either for each of the 5 steps, got an array of 2×2"),
        (lambda: sensitivity(thesis(), 1.5), "link: expected probabilities between 0 and 1, got 1.5"),
        (lambda: sensitivity(thesis(), case="a"), "case: expected none, as the scenario has no cases, got 'a'"),
        (lambda: sensitivity(thesis(), 0.5, case="a"), "case: expected none beside link probabilities of one's own, got 'a'"),
        (lambda: sensitivity(thesis(case=[{"name": "b", "link": 0.5}]), case="a"), "case: expected one of 'b', got 'a'"),
        (lambda: agents_needed(thesis(), 20.0, 1.5), "link: expected a probability between 0 and 1, got 1.5"),
        (lambda: agents_needed(thesis(), 20.0, 0.5, method="general"), "expected method simplified or optimal.* got general"),
        (lambda: agents_needed(thesis(), 20.0, 0.5, agent=2), "expected agent mean, worst or best, got 2"),
        (lambda: agents_needed(thesis(), 20.0, 0.5, max_agents=0), "max_agents: expected a whole number of at least 1, got 0"),
        (lambda: agents_needed(thesis(link=MATRIX), 20.0, 0.5), "one link probability for all links and steps"),
        (
            lambda: agents_needed(scenario(1.0, 1.0, 1.0, 1.0, 1.0, sensors=[{}, {}, {"R": 2.0}]), 20.0, 0.5),
            r"agents needed: expected like agents, got \[\[agent\]\] tables",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_said(ask, message):
    with pytest.raises(sf.UsageError, match=message):
        ask()


def test_a_case_is_a_place_to_start_from():
    s = thesis(case=[{"name": "b", "link": MATRIX}])
    assert sensitivity(s, case="b").link.tolist() == [0.5] * 6


def test_the_question_knows_what_is_monotone():
    assert question(thesis(), method="general", quantity="optimal").monotone
    assert not question(thesis(), method="general").monotone


# --- the command line -----------------------------------------------------------------------------------------------


def solve(*arguments, code=0):
    done = CliRunner().invoke(app, ["solve", *arguments])
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.output
    return done


def in_json(*arguments):
    return json.loads(solve(*arguments, "--format", "json").stdout, parse_constant=pytest.fail)


def test_least_link_on_the_command_line():
    text = solve("--target", "30").stdout
    assert "Least link probability: µ = 0.326331070527, from which on claimed variance of x" in text
    assert "Proved: the value never rises with the link" in text
    assert "approximate (mean field)" in text
    found = in_json("--target", "30", "--step", "3", "--method", "general")
    assert (found["schema"], found["question"], found["nature"], found["step"]) == (
        "stochfuse.solution/1",
        "least-link",
        "exact",
        3,
    )
    assert found["certificate"]["below"]["value"] > 30 >= found["certificate"]["above"]["value"]
    assert found["met"] == [[found["link"], 1.0]]
    value = sf.predict(sf.load_scenario(steps=3), [found["link"]], "general").values()[0, 2]
    assert value == pytest.approx(30, rel=1e-12)


def test_other_questions_on_the_command_line():
    rows = list(csv.DictReader(io.StringIO(solve("fcs-demo", "--sensitivity", "--format", "csv").stdout)))
    assert len(rows) == 90
    assert [int(r["rank"]) for r in rows] == list(range(1, 91))
    assert {rows[0]["sender"], rows[0]["receiver"]} == {"9", "10"}
    assert (rows[0]["nature"], rows[0]["unit"]) == ("approximate", "m")
    table = solve("--sensitivity", "--link", "0.5").stdout
    assert "No link is better to improve than another: +0.01 on any one" in table
    assert "At µ = 0.5 it is 62.5 to 66.3 % (the thesis" in solve("--gain").stdout
    steady = in_json("--steady", "--link", "0,1")
    assert steady["values"] == pytest.approx(sf.steady_state(sf.load_scenario(), [0, 1]).P.ravel().tolist())
    assert max(steady["relative_bound"]) <= 1e-11
    needed = in_json("--target", "1", "--agents-needed", "--link", "0.5")
    assert needed["value_with_one_fewer"] > 1 >= needed["value"]
    assert needed["agents"] == 193
    by_subnet = in_json("fcs-demo", "--gain", "--step", "2")
    assert by_subnet["cases"][-1] == "all links at maximum"
    assert by_subnet["share_of_gain"][-1] == [pytest.approx(1.0)]


@pytest.mark.parametrize("format", ["markdown", "latex"])
def test_other_formats(format):
    out = solve("--target", "30", "--format", format).stdout
    assert "0.326331070527" in out
    assert ("| result" in out) == (format == "markdown")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ((), 2, "expected a question: --target X"),
        (("--target", "30", "--gain"), 2, "expected one question a call, got --target and --gain"),
        (("--agents-needed",), 2, "--agents-needed: expected --target X and --link P with it"),
        (
            ("--target", "30", "--agents-needed"),
            2,
            "--link: expected one link probability with --agents-needed, got none",
        ),
        (
            ("--sensitivity", "--link", "0,1"),
            2,
            "--link: expected one link probability with --sensitivity, got 2 of them",
        ),
        (
            ("--target", "30", "--link", "0.5"),
            2,
            "--link: expected with --agents-needed, --sensitivity, --gain, --steady",
        ),
        (("--target", "30", "--max-agents", "5"), 2, "--max-agents: expected with --agents-needed"),
        (("--gain", "--case", "a"), 2, "--case: expected with --sensitivity"),
        (("--target", "1", "--agents-needed", "--link", "0.5", "--agents", "3"), 2, "--agents: expected with"),
        (("--target", "much"), 2, "Invalid value for '--target'"),
        (("--target", "30", "--estimator", "naive"), 2, "--estimator: expected method general"),
        (
            ("--target", "3"),
            3,
            "no answer: claimed variance of x at step 5 (simplified) is 18.9716507 at best, at µ = 1",
        ),
        (("--target", "0.001", "--agents-needed", "--link", "0.5", "--max-agents", "9"), 3, "with 9 agents at µ = 0.5"),
        (("--gain", "--agents", "1"), 3, "nothing to gain"),
    ],
)
def test_exit_codes_and_messages(arguments, code, message):
    done = solve(*arguments, code=code)
    assert message in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ("--target", "30"),
        ("--target", "1", "--agents-needed", "--link", "0.5"),
        ("--sensitivity", "--link", "0.5", "--architecture", "broadcast", "--agent", "2"),
        ("fcs-demo", "--sensitivity", "--case", "subnet averages"),
        ("--gain",),
        ("fcs-demo", "--gain"),
        ("--steady",),
        ("fcs-demo", "--steady"),
    ],
)
def test_figures(arguments, tmp_path):
    file = tmp_path / "figure.svg"
    solve(*arguments, "--plot", str(file))
    assert file.read_text(encoding="utf-8").rstrip().endswith("</svg>")


def test_binomial_counts_are_what_the_closed_form_says():
    """The oracle of this file is right: Σ C(N, m) µ^m (1−µ)^(N−m)/(m+1)."""
    µ, n = 0.3, 5
    direct = sum(comb(n - 1, m) * µ**m * (1 - µ) ** (n - 1 - m) / (m + 1) for m in range(n))
    assert direct == pytest.approx((1 - (1 - µ) ** n) / (n * µ), rel=1e-14)


@pytest.mark.parametrize("agent", ["worst", "best"])
def test_sensitivity_of_the_worst_agent_where_all_are_equal_and_links_perfect(agent):
    scenario, h = sf.load_scenario(steps=2), 1e-6
    found = sensitivity(scenario, 1.0, method="general", agent=agent)
    for (sender, (receiver,)), slope in zip(found.links, found.derivative, strict=True):
        link = np.ones((3, 3))
        link[receiver - 1, sender - 1] -= h
        below = sf.predict(scenario, link[None], "general").values(agent=agent)[0, -1]
        assert slope == pytest.approx((found.value - below) / h, rel=1e-4, abs=1e-4)
