"""The averages over the number of arrivals, against 50-digit sums, and the distributions against brute force."""

from __future__ import annotations

from functools import cache
from itertools import product

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stochfuse.kalman.arrivals import SUM_UP_TO, Binomial, Counts, like_senders, poisson_binomial
from tests.oracles.strategies import probabilities, seeds

NOISES = (0.0, 1e-14, 1e-8, 1e-3, 0.3, 1.0, 10.0, 1e4, 1e9, 1e14)
LINKS = (0.0, 1e-7, 1e-3, 0.03, 0.1, 0.5, 0.9, 0.9999, 1.0)


@cache
def terms(N, link):
    """Numbers of arrivals with their probabilities; those are left out that cannot matter at 25 digits."""
    with mp.workdps(50):
        mu = mp.mpf(link)
        spread = int(14 * (N * link * (1 - link)) ** 0.5) + 60
        numbers = range(max(0, int(N * link) - spread), min(N, int(N * link) + spread) + 1)
        return [(m, mp.binomial(N, m) * mu**m * (1 - mu) ** (N - m)) for m in numbers]


def exact(N, link, s, gained):
    with mp.workdps(50):
        s = mp.mpf(s)
        return float(mp.fsum(p * ((m + 1) if gained else 1) / (1 + (m + 1) * s) for m, p in terms(N, link)))


@pytest.mark.parametrize("N", [0, 1, 2, 49, SUM_UP_TO, SUM_UP_TO + 1, 400, 3000])
@pytest.mark.parametrize("gained", [False, True])
def test_averages_over_arrivals_to_rounding(N, gained):
    arrivals = like_senders(N, np.array(LINKS))
    s = np.array(NOISES)[:, None] * np.ones(len(LINKS))
    got = arrivals.gained(s) if gained else arrivals.remaining(s)
    for i, noise in enumerate(NOISES):
        for j, link in enumerate(LINKS):
            assert got[i, j] == pytest.approx(exact(N, link, noise, gained), rel=5e-15), (N, link, noise)


def test_sum_and_integral_are_the_same_function():
    link = np.linspace(0, 1, 11)
    s = np.geomspace(1e-6, 1e6, 13)[:, None] * np.ones(11)
    table, integral = like_senders(60, link), Binomial(60, link)
    assert isinstance(table, Counts)
    np.testing.assert_allclose(table.remaining(s), integral.remaining(s), rtol=1e-14)
    np.testing.assert_allclose(table.gained(s), integral.gained(s), rtol=1e-14)
    np.testing.assert_allclose(table.reciprocal(), integral.reciprocal(), rtol=1e-14)


@pytest.mark.parametrize("N", [0, 1, 5, 99, 101, 1000])
def test_step_one_in_closed_form(N):
    """Theory section 10: E[1/(1+K)] = (1 − (1−µ)^(N+1))/((N+1)µ)."""
    link = np.array([1e-9, 0.1, 0.5, 0.9, 1.0])
    with mp.workdps(50):
        expected = [float((1 - (1 - mp.mpf(m)) ** (N + 1)) / ((N + 1) * mp.mpf(m))) for m in link]
    np.testing.assert_allclose(like_senders(N, link).reciprocal(), expected, rtol=1e-14)
    assert like_senders(N, np.zeros(1)).reciprocal()[0] == 1.0


@given(st.lists(probabilities, min_size=0, max_size=7))
def test_poisson_binomial_against_every_set(links):
    expected = np.zeros(len(links) + 1)
    for heard in product([0, 1], repeat=len(links)):
        expected[sum(heard)] += np.prod([m if h else 1 - m for m, h in zip(links, heard, strict=True)])
    np.testing.assert_allclose(poisson_binomial(np.array(links)), expected, atol=1e-15)


@given(seeds, st.integers(0, 150))
def test_averages_are_linked_and_bounded(seed, N):
    rng = np.random.default_rng(seed)
    link, s = rng.uniform(size=4), rng.lognormal(sigma=3, size=(2, 4))
    arrivals = like_senders(N, link)
    E, g = arrivals.remaining(s), arrivals.gained(s)
    np.testing.assert_allclose(E, 1 - s * g, rtol=0, atol=1e-13)
    tiny = 1e-13
    assert (1 / (1 + s) * (1 + tiny) >= E).all()  # never worse than alone
    assert (1 / (1 + (N + 1) * s) * (1 - tiny) <= E).all()  # never better than with everyone's measurement
    assert (1 / (1 + (1 + N * link) * s) * (1 - tiny) <= E).all()  # Jensen


def test_taking_items_keeps_their_distributions():
    link, s = np.linspace(0, 1, 7), np.full((1, 3), 0.7)
    for arrivals in (like_senders(4, link), like_senders(1000, link)):
        items = np.array([6, 0, 3])
        np.testing.assert_array_equal(
            arrivals.take(items).remaining(s), arrivals.remaining(np.full((1, 7), 0.7))[:, items]
        )
