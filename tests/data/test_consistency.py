"""Averages of normalised squared errors, and what a consistent filter keeps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from stochfuse.data.consistency import MANY, Series, band


def series(squared, freedom=2):
    out = Series(squared.shape[1], squared.shape[2], np.full(squared.shape[2], freedom))
    out.add(squared)
    return out


@pytest.mark.parametrize("runs", [1, 40])
def test_independent_ones_have_the_textbooks_interval(runs):
    rng = np.random.default_rng(runs)
    squared = rng.chisquare(2, size=(runs, 2000 // runs, 1))
    average = series(squared).average(0)
    N = squared.size
    assert average.mean == pytest.approx(squared.mean())
    assert average.number == N
    low, high = chi2.ppf([0.025, 0.975], N * 2) / N
    assert average.low == pytest.approx(low, rel=0.02)
    assert average.high == pytest.approx(high, rel=0.02)
    assert average.verdict == "consistent"


def test_a_band_is_a_quantile():
    assert band(3, 7) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 21) / 7))


@pytest.mark.slow
@pytest.mark.parametrize("runs", [1, 3 * MANY])
def test_intervals_keep_their_promise_where_errors_last(runs):
    """Errors that stay alike for some steps, and agents that have them in common: 95 % of averages lie within."""
    rng = np.random.default_rng(7 + runs)
    steps, inside, trials = (1000, 0, 200) if runs == 1 else (12, 0, 300)
    for _ in range(trials):
        white = rng.standard_normal((runs, steps, 2))
        e = lfilter([0.6], [1.0, -0.8], white, axis=1, zi=0.8 * rng.standard_normal((runs, 1, 2)))[0]
        squared = (e**2).sum(axis=2)[:, :, None]
        both = series(np.concatenate([squared, squared], axis=2)).average(None)
        inside += both.low <= both.mean <= both.high
        assert both.independent < 0.6 * both.number
    # binomial: 95 % less three standard deviations, and what is lost by finding out how alike errors are
    assert 0.89 <= inside / trials <= 0.99


def test_who_claims_too_much_and_too_little():
    rng = np.random.default_rng(3)
    squared = rng.chisquare(2, size=(50, 20, 1))
    assert series(1.5 * squared).average(0).verdict == "overconfident"
    assert series(0.6 * squared).average(0).verdict == "cautious"


def test_what_is_missing_is_not_counted():
    squared = np.full((2, 3, 2), np.nan)
    assert series(squared).average(0) is None
    squared[0, 1, 0] = 4.0
    found = series(squared)
    assert found.average(0).mean == 4.0
    assert found.average(None).number == 1
    assert found.average(1) is None
    assert np.isnan(found.by_step()[0])
    assert found.by_step()[1] == 4.0


def test_batches_add_up():
    rng = np.random.default_rng(9)
    squared = rng.chisquare(2, size=(60, 8, 2))
    whole, parts = series(squared), Series(8, 2, np.full(2, 2))
    for some in np.split(squared, [13, 40]):
        parts.add(some)
    for agent in (None, 0, 1):
        assert parts.average(agent) == pytest.approx(whole.average(agent))
