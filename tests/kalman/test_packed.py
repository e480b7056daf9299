"""Many filters side by side, by NumPy and compiled: against the kernel filter by filter, and against 60 digits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import UsageError
from stochfuse.kalman import compiled, packed
from stochfuse.kalman.kernel import Estimate, predict, update
from tests.agreement.test_accuracy import CASES
from tests.oracles import textbook
from tests.oracles.strategies import model


@pytest.fixture(params=["NumPy", "compiled"])
def way(request, monkeypatch):
    """Everything by NumPy, or everything compiled."""
    if request.param == "compiled" and not compiled.installed():
        pytest.skip("llvmlite is not installed; it comes with the extra 'compiled'")
    monkeypatch.setenv(compiled.SWITCH, str(int(request.param == "compiled")))
    return request.param


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
def test_as_one_by_one(d, p, own, way):
    if way == "compiled" and (d > 9 or (d > 6 and own != "FQHR")):
        pytest.skip("long code takes long to compile: one kind of it is enough")
    rng = np.random.default_rng(10 * d + p)
    models = [model(rng, d, p) for _ in range(11)]
    F, Q, H, R, P = (np.array(M) for M in zip(*models, strict=True))
    F, Q, H, R = (M if name in own else M[0] for name, M in zip("FQHR", (F, Q, H, R), strict=True))
    for steps in (1, 3, 18):
        got = sf.kalman.covariances(P, F, Q, H, R, steps)
        assert textbook.scaled_error(got, one_by_one(P, F, Q, H, R, steps)) < 1e-9
        np.testing.assert_array_equal(got, got.swapaxes(1, 2))


def test_filters_do_not_depend_on_their_company(monkeypatch, way):
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
def test_to_nine_digits(case, way):
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


def test_one_agent_of_many_items_is_a_filter(way):
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


@pytest.mark.parametrize("each", [False, True])
def test_steps_may_differ(each, way):
    """In what they go by and in whether it is each filter's own; the last or all are returned, from scaled beginnings."""
    rng = np.random.default_rng(8)
    models = [model(rng, 3, 2) for _ in range(13)]
    F, Q, H, R, P = (np.array(M) for M in zip(*models, strict=True))
    share = rng.uniform(0.2, 1.0, size=13)
    first, second = packed.Step(F[0], Q, H[0], R), packed.Step(F[1], Q[1], H[1], R[1])
    through, heard = [first] * 10 + [second] * 3 + [first], []
    out, unsound = np.empty((len(through) if each else 1, 3, 3, 13)), np.ones(13, dtype=bool)
    left = packed.carry(P, through, out, share, unsound, heard.append)
    assert ((left > 0) & (left <= 1)).all()
    assert not unsound.any()
    assert heard[-1] == len(through)
    now = P * share[:, None, None]
    for k, step in enumerate(through):
        now = one_by_one(now, *step, 1)
        if each or k + 1 == len(through):
            assert textbook.scaled_error(out[k if each else 0].transpose(2, 0, 1), now) < 1e-12


def test_what_is_no_number_stays_by_itself(way):
    """Filters that grow beyond floating point, or were none, beside others in a group of lanes."""
    rng = np.random.default_rng(4)
    F, Q, H, R, P = model(rng, 4, 2)
    several, steps = np.tile(P, (21, 1, 1)), packed.Step(F, Q, H, R)
    several[3], several[17] = np.nan, 1e305 * np.eye(4)
    out, unsound = np.empty((1, 4, 4, 21)), np.zeros(21, dtype=bool)
    with np.errstate(all="ignore"):
        left = packed.carry(several, [steps] * 9, out, None, unsound)
    assert np.flatnonzero(~(left > packed.CANCELLATION)).tolist() == [3, 17]
    assert unsound[3]
    fine = np.delete(out[0].transpose(2, 0, 1), [3, 17], axis=0)
    np.testing.assert_array_equal(fine, np.broadcast_to(fine[0], fine.shape))
    assert textbook.scaled_error(fine[:1], one_by_one(P[None], F, Q, H, R, 9)) < 1e-12


def test_where_nothing_compiles_numpy_answers(monkeypatch):
    def none(*given):
        raise RuntimeError("no target")

    step = packed.Step(np.eye(2), np.eye(2), np.eye(2), np.eye(2))
    monkeypatch.setenv(compiled.SWITCH, "1")
    monkeypatch.setattr(compiled, "installed", lambda: True)
    monkeypatch.setattr(packed, "Loop", none)
    packed.compiled_step.cache_clear()
    try:
        got = sf.kalman.covariances(np.eye(2)[None], *step, 3)
    finally:
        packed.compiled_step.cache_clear()
    np.testing.assert_allclose(got, one_by_one(np.eye(2)[None], *step, 3), rtol=1e-14)


def test_what_decides(monkeypatch):
    monkeypatch.setattr(compiled, "installed", lambda: True)
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    assert compiled.pays(50_000, 150)
    assert not compiled.pays(5000, 150)
    assert not compiled.pays(50_000, 2000)
    monkeypatch.setenv(compiled.SWITCH, "1")
    assert compiled.pays(1, 2000)
    assert compiled.state() == "always (STOCHFUSE_COMPILED=1)"
    monkeypatch.setenv(compiled.SWITCH, "0")
    assert not compiled.pays(10**9, 10)
    assert compiled.state() == "off (STOCHFUSE_COMPILED=0)"
    monkeypatch.setenv(compiled.SWITCH, "yes")
    with pytest.raises(UsageError, match=r"STOCHFUSE_COMPILED: expected 0 \(never\) or 1 \(always\), got 'yes'"):
        compiled.pays(1, 1)
    monkeypatch.setattr(compiled, "installed", lambda: False)
    monkeypatch.setenv(compiled.SWITCH, "1")
    assert not compiled.pays(10**9, 10)


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
