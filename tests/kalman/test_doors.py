"""`sf.kalman` and `sf.fusion`, as one who has arrays of one's own calls them."""

from __future__ import annotations

import doctest
from importlib import import_module

import numpy as np
import pytest

import stochfuse as sf
from tests.oracles import textbook

F, Q = np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.1, 0.2])
H, R = np.array([[1.0, 0.0]]), np.array([[0.5]])
X, P0 = np.array([1.0, -2.0]), np.array([[2.0, 0.3], [0.3, 1.0]])


def test_means_come_back_as_they_were_given():
    prior = textbook.kalman_predict(P0, F, Q)
    z = np.array([0.7])
    for x, shape in ((X, (2,)), (X[:, None], (2, 1)), (X.tolist(), (2,))):
        moved = sf.kalman.predict((x, P0), F, Q)
        assert moved.x.shape == shape
        np.testing.assert_allclose(np.ravel(moved.x), F @ X, rtol=1e-14)
        np.testing.assert_allclose(moved.P, prior, rtol=1e-14)
        fused = sf.kalman.update(moved, H, R, z)
        assert fused.x.shape == shape
        np.testing.assert_allclose(
            np.ravel(fused.x), textbook.kalman_state(F @ X[:, None], prior, H, R, z[:, None]).ravel(), rtol=1e-12
        )
        np.testing.assert_allclose(fused.P, textbook.kalman_update(prior, H, R), rtol=1e-12)
    assert sf.kalman.update((None, prior), H, R).x is None


def test_batches_stand_in_front():
    x, P = np.stack([X, 2 * X, 3 * X]), np.stack([P0, 2 * P0, 3 * P0])
    batch = sf.kalman.update(sf.kalman.predict((x, P), F, Q), H, R, np.ones((3, 1)))
    for i in range(3):
        one = sf.kalman.update(sf.kalman.predict((x[i], P[i]), F, Q), H, R, [1.0])
        np.testing.assert_allclose(batch.x[i], one.x, rtol=1e-14)
        np.testing.assert_allclose(batch.P[i], one.P, rtol=1e-14)


def test_a_mean_that_does_not_fit_is_named():
    with pytest.raises(sf.UsageError, match=r"x: expected shape \(..., 2\) or \(..., 2, 1\), got \(3,\)"):
        sf.kalman.predict((np.ones(3), P0), F, Q)
    with pytest.raises(sf.UsageError, match=r"z: expected shape \(..., 1\) or \(..., 1, 1\), got \(2,\)"):
        sf.kalman.update((X, P0), H, R, np.ones(2))


def test_fusion_is_a_door():
    a, b = (X, P0), (2 * X, np.diag([1.0, 3.0]))
    flat, columns = (
        sf.fusion.covariance_intersection([a, b]),
        sf.fusion.covariance_intersection([(x[:, None], P) for x, P in (a, b)]),
    )
    assert flat.c.shape == (2,)
    np.testing.assert_allclose(flat.c, columns.c[:, 0], rtol=1e-14)
    for name in dir(sf.fusion):
        assert callable(getattr(sf.fusion, name))
        assert getattr(sf.fusion, name).__doc__
    with pytest.raises(AttributeError, match=r"module 'stochfuse.fusion' has no attribute 'kalman_gain'"):
        sf.fusion.kalman_gain  # noqa: B018


NEEDS = {"from_networkx": "networkx", "from_stonesoup": "stonesoup"}
"""Packages without which an example cannot run."""


@pytest.mark.parametrize("name", [n for n in sf.__all__ if n[0].islower()])
def test_public_functions_are_documented_with_an_example_that_runs(name):
    function = getattr(sf, name)
    assert function.__doc__
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    (test,) = [t for t in doctest.DocTestFinder(recurse=False).find(function, name, globs={}) if t.examples] or [None]
    if test is None:
        assert name in ("study", "read_results", "check_results"), "has no example"
        return
    found = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test)
    assert found.failed == 0


@pytest.mark.parametrize("module", ["stochfuse", "stochfuse.kalman"])
def test_examples_of_modules_run(module):
    assert doctest.testmod(import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE).failed == 0
