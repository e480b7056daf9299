"""Many filters side by side: against the kernel filter by filter, and against 60 digits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import UsageError
from stochfuse.kalman import packed
from stochfuse.kalman.kernel import Estimate, predict, update
from tests.agreement.test_accuracy import CASES
from tests.oracles import textbook
from tests.oracles.strategies import model


def one_by_one(P, F, Q, H, R, steps):
    """The kernel's predict and update, every filter by itself."""
    out = []
    for i, estimate in enumerate(P):
        f, q, h, r = (M if M.ndim == 2 else M[i] for M in (F, Q, H, R))
        for _ in range(steps):
            estimate = update(predict(Estimate(None, estimate), f, q), h, r).P
        out.append(estimate)
    return np.array(out)


@pytest.mark.parametrize("own", ["", "QR", "F", "H", "FQHR"])
@pytest.mark.parametrize(("d", "p"), [(1, 1), (1, 3), (2, 1), (3, 5), (4, 2), (6, 3), (7, 2), (9, 6), (15, 4)])
def test_as_one_by_one(d, p, own):
    rng = np.random.default_rng(10 * d + p)
    models = [model(rng, d, p) for _ in range(11)]
    F, Q, H, R, P = (np.array(M) for M in zip(*models, strict=True))
    F, Q, H, R = (M if name in own else M[0] for name, M in zip("FQHR", (F, Q, H, R), strict=True))
    for steps in (1, 3, 18):
        got = sf.kalman.covariances(P, F, Q, H, R, steps)
        assert textbook.scaled_error(got, one_by_one(P, F, Q, H, R, steps)) < 1e-9
        np.testing.assert_array_equal(got, got.swapaxes(1, 2))


def test_filters_do_not_depend_on_their_company(monkeypatch):
    """In several blocks, the last one smaller, with one that cancels among them."""
    rng = np.random.default_rng(3)
    F, Q, H, R, P = model(rng, 4, 2)
    scale = 10.0 ** rng.uniform(-1, 1, size=(3, 100, 1, 1))
    scale[1, 40] = 1e-14
    whole = sf.kalman.covariances(P * scale[0], F, Q, H, R * scale[1], 4)
    monkeypatch.setattr(packed, "FEWEST", 16)
    monkeypatch.setattr(packed, "CACHE", 0)
    blocks = sf.kalman.covariances(P * scale[0], F, Q, H, R * scale[1], 4)
    np.testing.assert_allclose(blocks, whole, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("case", CASES)
def test_to_nine_digits(case):
    """Alone, and with noises of each filter's own beside harmless ones."""
    F, Q, H, R, P = (np.asarray(M, dtype=float) for M in CASES[case])
    with mp.workdps(60):
        Fm, Qm, Hm, Rm, exact = map(textbook.mp_matrix, (F, Q, H, R, P))
        for _ in range(3):
            exact = textbook.mp_update(Fm * exact * Fm.T + Qm, Hm, Rm)
        expected = np.array(exact.tolist(), dtype=float)
    mild = [np.broadcast_to(np.eye(len(M)), (3, *M.shape)).copy() for M in (P, Q, R)]
    for M, own in zip((P, Q, R), mild, strict=True):
        own[1] = M
    assert textbook.scaled_error(sf.kalman.covariances(P[None], F, Q, H, R, 3)[0], expected) < 1e-9
    assert textbook.scaled_error(sf.kalman.covariances(mild[0], F, mild[1], H, mild[2], 3)[1], expected) < 1e-9


def test_one_agent_of_many_items_is_a_filter():
    """The simplified formulation of an agent that hears nobody is carried the same way."""
    rng = np.random.default_rng(5)
    F, Q, H, R, P = model(rng, 4, 2)
    source = {
        "model": {"F": F.tolist(), "H": H.tolist(), "Q": Q.tolist(), "R": R.tolist()},
        "initial": {"P": P.tolist()},
        "network": {"agents": 1, "steps": 12, "link": 0.5},
    }
    noise = R * rng.uniform(0.5, 2.0, size=(30, 1, 1))
    got = sf.predict_many(sf.Scenario.from_mapping(source), R=noise).covariance
    for step in (2, 12):
        expected = one_by_one(np.broadcast_to(P, (30, 4, 4)), F, Q, H, noise, step - 1)
        assert textbook.scaled_error(got[:, step - 1], expected) < 1e-10


@pytest.mark.parametrize(
    ("changed", "steps", "message"),
    [
        ({"F": np.eye(3)}, 1, r"F: expected shape \(2, 2\) or \(items, …\) as P has, \(items, d, d\), got \(3, 3\)"),
        ({"R": np.ones((4, 1, 1))}, 1, r"R: expected shape \(1, 1\) .* got \(4, 1, 1\)"),
        ({"P": np.eye(2)}, 1, "P: expected shape"),
        ({}, 0, "steps: expected at least 1, got 0"),
    ],
)
def test_what_does_not_fit_is_refused(changed, steps, message):
    given = {"P": np.ones((3, 1, 1)) * np.eye(2), "F": np.eye(2), "Q": np.eye(2), "H": np.eye(2)[:1], "R": np.eye(1)}
    with pytest.raises(UsageError, match=message):
        sf.kalman.covariances(*(given | changed).values(), steps)
