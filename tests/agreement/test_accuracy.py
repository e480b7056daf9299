"""Ill-conditioned cases, entrywise in units of the states' own standard deviations, against 60-digit arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from tests.oracles import textbook
from tests.oracles.strategies import mapping

dt = 1.0
F = np.array([[1, dt, 0, 0], [0, 1, 0, 0], [0, 0, 1, dt], [0, 0, 0, 1]])
H = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
Q = 0.5 * np.kron(np.eye(2), [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
P0 = np.diag([100.0, 9.0, 100.0, 9.0])
ODD_H = np.array([[1.0, 0.3, -0.2, 0.1], [0.4, 0.0, 1.0, -0.7]])
"""A sensor that measures no state by itself."""

CASES = {
    "benign": (F, Q, H, 25 * np.eye(2), P0),
    "scalar benign": (np.eye(1), 25 * np.eye(1), np.eye(1), 100 * np.eye(1), 100 * np.eye(1)),
    "R = 1e-4": (F, Q, H, 1e-4 * np.eye(2), P0),
    "R = 1e-8": (F, Q, H, 1e-8 * np.eye(2), P0),
    "R = 1e-14": (F, Q, H, 1e-14 * np.eye(2), P0),
    "R = 1e-14 and 1e3": (F, Q, H, np.diag([1e-14, 1e3]), P0),
    "R = 1e12": (F, Q, H, 1e12 * np.eye(2), P0),
    "P0 = 1e12": (F, Q, H, 25 * np.eye(2), 1e12 * np.eye(4)),
    "P0 = 1e12, R = 1e-14": (F, Q, H, 1e-14 * np.eye(2), 1e12 * np.eye(4)),
    "P0 = 0": (F, Q, H, 25 * np.eye(2), np.zeros((4, 4))),
    "P0 = 0, Q = 0": (F, 0 * Q, H, 25 * np.eye(2), np.zeros((4, 4))),
    "Q = 0": (F, 0 * Q, H, 25 * np.eye(2), P0),
    "prior singular": (F, 0 * Q, H, 25 * np.eye(2), np.diag([100.0, 0, 100, 0])),
    "prior singular, R = 1e-14": (F, 0 * Q, H, 1e-14 * np.eye(2), np.diag([100.0, 0, 100, 0])),
    "rank one": (F, 0 * Q, H, np.eye(2), np.outer([1.0, 2, 3, 4], [1.0, 2, 3, 4])),
    "odd sensor, R = 1e-8": (F, Q, ODD_H, 1e-8 * np.eye(2), P0),
    "odd sensor, R = 1e-14": (F, Q, ODD_H, 1e-14 * np.eye(2), P0),
    "odd sensor, P0 = 1e12": (F, Q, ODD_H, np.eye(2), 1e12 * np.eye(4)),
    "one sensor, R = 1e-14": (F[:2, :2], Q[:2, :2], H[:1, :2], 1e-14 * np.eye(1), P0[:2, :2]),
    "three sensors, R = 1e-10": (F, Q, np.vstack([ODD_H, [1, 1, 1, 1]]), 1e-10 * np.eye(3), P0),
    "scalar, R = 1e-14": (np.eye(1), 25 * np.eye(1), np.eye(1), 1e-14 * np.eye(1), 1e12 * np.eye(1)),
    "mixed units": (
        F,
        Q * np.outer([1e6, 1, 1e-6, 1e-12], [1e6, 1, 1e-6, 1e-12]),
        H,
        np.eye(2),
        np.diag([1e10, 1, 1e-8, 1e-16]),
    ),
}
for _T, _P, _R in ((10, 1e6, 1e-8), (10, 1e12, 1e-14), (1e4, 1e12, 1e-8)):
    # two precise fixes a long time apart make the speed a trillion times better known
    _F = np.array([[1.0, _T], [0.0, 1.0]])
    CASES[f"T = {_T}, P0 = {_P}, R = {_R}"] = (_F, np.zeros((2, 2)), H[:1, :2], _R * np.eye(1), _P * np.eye(2))
CASES["correlated P0, T = 2e4"] = (
    np.array([[1, -2e4], [0, 1]]), np.zeros((2, 2)), H[:1, :2], 8e-9 * np.eye(1), np.array([[1.2e-7, 0.08], [0.08, 6e4]])
)  # fmt: skip
CASES["three sensors of one state, the middle form useless"] = (
    np.eye(2), np.zeros((2, 2)), np.ones((3, 2)), np.diag([1, 1e-8, 1e-13]), 2e4 * np.eye(2)
)  # fmt: skip
LINKS = (0.0, 0.1, 0.5, 1.0)


@pytest.mark.parametrize("agents", [3, 10])
@pytest.mark.parametrize("case", CASES)
def test_to_nine_digits(case, agents):
    given = CASES[case]
    got = sf.predict(sf.Scenario.from_mapping(mapping(*given, agents=agents, steps=3)), LINKS).covariance
    for i, mu in enumerate(LINKS):
        exact = textbook.simplified_mpmath(*given, agents, mu, 3)
        assert textbook.scaled_error(got[i], exact) < 1e-9


@pytest.mark.parametrize(
    "case", ["benign", "R = 1e-8", "R = 1e-14", "P0 = 1e12", "prior singular", "odd sensor, R = 1e-8"]
)
def test_unlike_agents_to_nine_digits(case):
    """Two of three agents have the same sensor, the third one twice the noise: updates one after the other."""
    F, Q, H, R, P0 = CASES[case]
    source = mapping(F, Q, H, R, P0, agents=3, steps=3)
    source["agent"] = [{}, {}, {"R": (2 * R).tolist()}]
    got = sf.predict(sf.Scenario.from_mapping(source), [0.5])
    import mpmath as mp

    with mp.workdps(60):
        Fm, Qm, Hm, Rm, P = map(textbook.mp_matrix, (F, Q, H, R, P0))
        P = P * mp.mpf(7) / 12  # E[1/(m+1)] for two senders at one half
        for k in range(1, 3):
            prior = Fm * P * Fm.T + Qm
            own = textbook.mp_update(prior, Hm, 2 * Rm)
            with_one, with_two = (textbook.mp_update(own, Hm, Rm / m) for m in (1, 2))
            P = own / 4 + with_one / 2 + with_two / 4
            exact = np.array([[float(P[i, j]) for j in range(4)] for i in range(4)])
            assert textbook.scaled_error(got.of_agent(3)[0, k], exact) < 1e-9


def test_digits_lost_by_degrees_are_noticed():
    """Every step leaves most of the variance, but a direction known to 1e12 at first ends at 1."""
    steps = 8
    H = np.array([[[1.0, -1.0]]] * 4 + [[[1.0, 1.0]]] * 4)
    R = np.array([[[r]] for r in (1, 1e8, 1e4, 1, 1e8, 1e4, 1, 1)])
    source = mapping(np.eye(2), np.zeros((2, 2)), H, R, 1e12 * np.eye(2), agents=1, steps=steps)
    got = sf.predict(sf.Scenario.from_mapping(source), [0.0])
    assert got.forms == ("square-root",)
    import mpmath as mp

    with mp.workdps(60):
        P = textbook.mp_matrix(1e12 * np.eye(2))
        for k in range(1, steps):
            P = textbook.mp_update(P, textbook.mp_matrix(H[k]), textbook.mp_matrix(R[k]))
            exact = np.array([[float(P[i, j]) for j in range(2)] for i in range(2)])
            assert textbook.scaled_error(got.covariance[0, k], exact) < 1e-9


@pytest.mark.parametrize("precise", [1e-14, 1e-20])
def test_precise_and_coarse_sensors_mixed(precise):
    P0 = np.eye(4)
    P0[0, 2] = P0[2, 0] = 1.0
    H, Q = np.eye(4)[[0, 2]], np.diag([1.0, 1, 1, 0])
    source = mapping(np.eye(4), Q, H, np.eye(2), P0, agents=2, steps=2)
    source["initial"]["correlation"] = "shared"
    source["agent"] = [{"R": [[1, 0], [0, precise]]}, {}]
    got = sf.predict(sf.Scenario.from_mapping(source), [1.0]).of_agent(1)[0, 1]
    import mpmath as mp

    with mp.workdps(60):
        P = textbook.mp_matrix(P0) + textbook.mp_matrix(Q)
        for noise in (np.diag([1, precise]), np.eye(2)):
            P = textbook.mp_update(P, textbook.mp_matrix(H), textbook.mp_matrix(noise))
        exact = np.array([[float(P[i, j]) for j in range(4)] for i in range(4)])
    assert textbook.scaled_error(got, exact) < 1e-9


def test_the_form_is_chosen_by_conditioning():
    def forms(R):
        return sf.predict(sf.Scenario.from_mapping(mapping(F, Q, H, R * np.eye(2), P0)), LINKS).forms

    assert forms(25.0) == ("measurement-space",)
    assert forms(1e-14) == ("square-root",)


@pytest.mark.slow
def test_a_hundred_steps_stay_symmetric_and_definite():
    s = sf.Scenario.from_mapping(mapping(F, Q, H, 25 * np.eye(2), P0, agents=50, steps=300))
    P = sf.predict(s, LINKS).covariance
    np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2))
    assert np.linalg.eigvalsh(P).min() > 0
    exact = textbook.simplified_mpmath(F, Q, H, 25 * np.eye(2), P0, 50, 0.5, 30, digits=40)
    assert textbook.scaled_error(P[2, :30], exact) < 1e-12
