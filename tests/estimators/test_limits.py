"""Where the covariance form of the other estimators ends: precise ranges, vague starts, states known exactly."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import UsageError


def placed(range_, P=4.0, known=False):
    table = {
        "model": {
            "own": True,
            "F": np.eye(2).tolist(),
            "H": np.eye(2).tolist(),
            "Q": (0.1 * np.eye(2)).tolist(),
            "R": np.eye(2).tolist(),
        },
        "initial": {"P": (P * np.eye(2)).tolist()},
        "network": {"agents": 3, "steps": 2},
        "cooperative": {"positions": ["x1", "x2"], "range": range_},
        "agent": [{"position": [0, 0]}, {"position": [10, 2]}, {"position": [3, 8]}],
    }
    if known:
        table["agent"][1] |= {"P": [[0, 0], [0, 0]], "Q": [[0, 0], [0, 0]]}
    return sf.Scenario.from_mapping(table)


@pytest.mark.parametrize("range_", [1e-8, 1e-10, 1e-13, 1e-15, 1e-20, 1e-60])
def test_precise_ranges_measured_twice_are_no_trouble(range_):
    """Node i measures j and j measures i: after the first, the second tells nothing that rounding leaves."""
    exact = sf.predict(placed(1e-4), [0.5, 1.0], "general", "actual", estimator="itns")
    found = sf.predict(placed(range_), [0.5, 1.0], "general", "actual", estimator="itns")
    np.testing.assert_allclose(found.values(), exact.values(), rtol=1e-6)
    np.testing.assert_allclose(found.shown_as("claimed").values(), exact.values(), rtol=1e-6)


def vague(P0, R=1.0):
    table = {
        "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.1, 0], [0, 0.1]], "R": R},
        "initial": {"P": np.diag(P0).tolist()},
        "network": {"agents": 3, "steps": 2},
    }
    return sf.Scenario.from_mapping(table)


def test_what_rounding_leaves_nothing_of_is_refused():
    """At 1e10 the answer is the optimum's; at 1e16 nothing is left of it, and nothing is claimed."""
    for estimator in ("itns", "equivalent-measurement"):
        fine = sf.predict(vague([1e10, 1.0]), [1.0], "general", estimator=estimator).values()[0, 1]
        if estimator == "itns":
            np.testing.assert_allclose(fine, sf.predict(vague([1e10, 1.0]), [1.0], "optimal").values()[0, 1], rtol=1e-5)
    for estimator in ("itns", "split-ci", "stand-alone"):
        with pytest.raises(
            UsageError, match="step 2: rounding has the size of the covariance of an estimate: expected"
        ):
            sf.predict(vague([1e16, 1.0]), [1.0], "general", estimator=estimator)
    with pytest.raises(UsageError, match=r"step 2: .*: expected noises R that are not negligible beside the errors P"):
        sf.predict(vague([1.0, 1.0], 1e-20), [0.5], "general", estimator="itns")


def test_rounding_that_grows_is_told():
    found = sf.predict(vague([1e9, 1.0]), [1.0], "general", estimator="stand-alone")
    assert "ill-conditioned: rounding may reach a relative" in found.notes[0]


def test_intersections_say_what_they_cannot_take():
    with pytest.raises(
        UsageError, match=r"step 1: intersections expect estimates that are known exactly in no direction"
    ):
        sf.predict(placed(1.0, known=True), [1.0], "general", estimator="split-ci")
    for estimator in ("lwin", "itns"):
        assert np.isfinite(sf.predict(placed(1.0, known=True), [1.0], "general", estimator=estimator).values()).all()
