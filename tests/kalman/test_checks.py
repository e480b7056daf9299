"""What is a covariance: stacks, which go a quicker way, against each matrix by itself."""

from __future__ import annotations

import numpy as np
import pytest

from stochfuse.kalman.checks import covariance_fault
from tests.oracles.strategies import model

BASE = model(np.random.default_rng(2), 3, 2)[4]
LOW = np.array([[1.0, 0.5, 0.2], [0.3, 2.0, 0.1], [0.0, 0.4, 1.0]])


def changed(i: int, j: int, by: float) -> np.ndarray:
    M = BASE.copy()
    M[i, j] += by
    return M


@pytest.mark.parametrize("definite", [False, True])
@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (BASE, ""),
        (1e-80 * BASE, ""),
        (changed(0, 1, 1e-13), ""),
        (changed(0, 1, 1e-3), "an asymmetric one"),
        (changed(2, 1, np.nan), "not finite"),
        (changed(1, 1, np.inf), "not finite"),
        (changed(1, 1, -1e6), "a variance of -"),
        (LOW @ np.diag([1.0, 1.0, 0.0]) @ LOW.T, "a singular one"),
        (np.diag([1.0, 0.0, 1.0]), "a variance of 0"),
        (LOW @ np.diag([1.0, 1.0, -1e-3]) @ LOW.T, "an indefinite one"),
        (LOW @ np.diag([1.0, 1.0, -1e-12]) @ LOW.T, "a singular one"),
    ],
)
def test_a_stack_is_judged_as_its_matrices(matrix, fault, definite):
    found = covariance_fault(matrix, definite=definite)
    expected = "" if not definite and ("singular" in fault or fault.endswith("of 0")) else fault
    assert expected in (found or "")
    assert (found is None) == (not expected)
    for stack in (np.array([BASE, matrix, BASE]), np.array([[BASE, BASE], [BASE, matrix]])):
        assert covariance_fault(stack, definite=definite) == found


def test_nothing_is_no_fault():
    assert covariance_fault(np.empty((0, 2, 2))) is None
