"""Replay: one record of arrivals, with numbers or without."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.records import arrivals_of
from stochfuse.engines import replay as engine
from stochfuse.engines.replay import moments_given, replay
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.readings import Readings
from stochfuse.scenario import capabilities
from stochfuse.scenario.registry import ESTIMATORS, GENERAL, INTERSECTIONS
from tests.oracles import textbook
from tests.oracles.featured import source as featured

F, Q = np.array([[1.0, 0.5], [0.0, 0.8]]), np.array([[0.5, 0.1], [0.1, 0.4]])
H, R, P0 = np.array([[1.0, 0.3]]), np.array([[0.8]]), np.array([[2.0, 0.3], [0.3, 1.0]])
X0 = np.array([[1.0], [-2.0]])


def scenario(agents=2, steps=3, **network):
    return sf.load_scenario({
        "model": {"F": F, "Q": Q, "H": H, "R": R},
        "initial": {"P": P0, "x": X0[:, 0]},
        "network": {"agents": agents, "steps": steps, **network},
    })  # fmt: skip


def arrivals(histories, n):
    """Arrivals of histories as the textbook has them: per step a set of (sender, receiver, sent step)."""
    heard, late = [], {}
    for run, history in enumerate(histories):
        for k, messages in enumerate(history):
            for sender, receiver, sent in messages:
                if sent == k + 1:
                    heard.append((run, k, receiver, sender))
                else:
                    late.setdefault((run, sent), []).append(Late(receiver, k + 1 - sent, sender))
    missed = np.zeros((len(histories), len(histories[0]), n), dtype=bool)
    heard = np.array(heard, dtype=np.int64).reshape(-1, 4)
    return arrivals_of(heard, missed, {key: tuple(sorted(messages)) for key, messages in late.items()})


def same_for_all(z, runs):
    """One record (steps, agents, p) for all runs."""
    return [np.broadcast_to(z[:, i], (runs, *z[:, i].shape)) for i in range(z.shape[1])]


@pytest.mark.parametrize("name", ["local-fusion-graph", "naive"])
@pytest.mark.parametrize("delay", [(1.0,), (0.6, 0.4)])
def test_every_outcome_is_the_textbooks(name, delay):
    n, steps = 2, 3
    link = np.full((steps, n, n), 0.5).tolist()
    histories = [history for _, history in textbook.histories(n, steps, "ad-hoc", link, delay)]
    z = np.random.default_rng(1).normal(size=(steps, n, 1))
    records = [[z[k, i][:, None] for i in range(n)] for k in range(steps)]
    system = scenario(n, steps).system
    found = list(replay(system, name, arrivals(histories, n), Readings.given(system, same_for_all(z, len(histories)))))
    for run, history in enumerate(histories):
        network = textbook.FusionNetwork(F, Q, [(H, R)] * n, P0, X0, records, history, naive=name == "naive")
        for k in range(1, steps + 1):
            for i in range(n):
                estimate = found[k - 1].estimates[i]
                np.testing.assert_allclose(estimate.P[run], network.covariance(i, k), rtol=1e-11, atol=1e-12)
                np.testing.assert_allclose(estimate.x[run], network.state(i, k), rtol=1e-9, atol=1e-11)


FEATURES = [f.name for f in capabilities.FEATURES if f.name not in ("detection", "bursts", "cases", "many-agents")]


PAIRS = [
    pytest.param(name, feature, marks=pytest.mark.slow if (e + f) % 3 else ())
    for f, feature in enumerate(FEATURES)
    for e, name in enumerate(ESTIMATORS)
]


@pytest.mark.parametrize(("name", "feature"), PAIRS)
def test_averaged_over_outcomes_it_is_the_enumeration(name, feature):
    """(49) of claimed and of actual covariances, for each feature of a scenario that the table says is taken."""
    if capabilities.reason(name, GENERAL, feature) is not None:
        pytest.skip("refused by the table")
    s = sf.load_scenario(featured([feature]))
    n, steps = s.network.agents, s.network.steps
    link = np.ones((steps, n, n)) * (0.6 if s.network.link is None else _per_step(s.network.link))
    if s.network.hears is not None:
        link = link * s.network.hears
    delay = s.network.delays or s.network.delay
    made = list(textbook.histories(n, steps, s.network.architecture, link.tolist(), delay))
    weights = np.array([weight for weight, _ in made])
    try:
        record = arrivals([history for _, history in made], n)
        z = [np.zeros((len(made), steps, H.shape[-2])) for H in (s.system.sensors[k].H for k in s.system.sensor_of)]
        relations = {pair: np.zeros((len(made), steps, r.R.shape[-1])) for pair, r in s.system.relations.items()}
        stages = list(replay(s.system, name, record, Readings.given(s.system, z, relations)))
        given = moments_given(s.system, name, record)
    except sf.UsageError:
        # what the estimator itself refuses, it refuses of a prediction too
        with pytest.raises(sf.UsageError):
            sf.predict(s, estimator=name, method="general")
        return
    claimed = sf.predict(s, estimator=name, method="general")
    actual = sf.predict(s, estimator=name, method="general", quantity="actual")
    for k, stage in enumerate(stages):
        for i, estimate in enumerate(stage.estimates):
            P = np.tensordot(weights, estimate.P, axes=1)
            np.testing.assert_allclose(P, claimed.of_agent(i + 1)[0, k], rtol=1e-9, atol=1e-12)
    A = np.tensordot(weights, given.actual, axes=1)
    for k in range(steps):
        for i in range(n):
            np.testing.assert_allclose(A[k, i], actual.of_agent(i + 1)[0, k], rtol=1e-9, atol=1e-12)


def _per_step(link):
    """Link probabilities as (steps or 1, n or 1, n or 1)."""
    return link[:, None, None] if link.ndim == 1 else link


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_long_record_is_forgotten_without_a_trace(name, monkeypatch):
    """Beginning the book anew changes nothing but rounding, with late messages and misses where they are taken."""
    n, steps, runs = 3, 25, 3
    s = scenario(n, steps)
    rng = np.random.default_rng(5)
    takes = [capabilities.reason(name, GENERAL, f) is None for f in ("delay", "detection")]
    record = drawn(rng, runs, steps, n, *takes)
    z = [rng.normal(size=(runs, steps, 1)) for _ in range(n)]

    def followed():
        stages = replay(s.system, name, record, Readings.given(s.system, z))
        return [(np.stack([e.x for e in st.estimates]), np.stack([e.P for e in st.estimates])) for st in stages]

    whole = followed()
    monkeypatch.setattr(engine, "WRITTEN", 30)
    for (x, P), (x_again, P_again) in zip(whole, followed(), strict=True):
        np.testing.assert_allclose(x_again, x, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(P_again, P, rtol=1e-9, atol=1e-12)


def drawn(rng, runs, steps, n, late=True, misses=True):
    heard, under_way = [], {}
    for run in range(runs):
        for k in range(steps):
            for i in range(n):
                for j in range(n):
                    fate = rng.random() if i != j else 1.0
                    if fate < 0.3:
                        heard.append((run, k, i, j))
                    elif fate < 0.45 and late:
                        message = Late(i, int(rng.integers(1, 4)), j)
                        under_way[run, k + 1] = tuple(sorted((*under_way.get((run, k + 1), ()), message)))
    missed = (rng.random((runs, steps, n)) < 0.2) & misses & (np.arange(steps) > 0)[:, None]
    return arrivals_of(np.array(heard), missed, under_way)


def test_the_optimum_is_one_filter_over_all_that_was_heard():
    """Brute force: sets of (step, agent) carried by every message, and one Kalman filter over each set."""
    n, steps, runs = 3, 12, 4
    rng = np.random.default_rng(8)
    record = drawn(rng, runs, steps, n)
    z = [rng.normal(size=(runs, steps, 1)) for _ in range(n)]
    system = scenario(n, steps).system
    stages = list(replay(system, "optimal", record, Readings.given(system, z)))
    for run in range(runs):
        held = [{(0, i)} for i in range(n)]
        waiting = []
        for k in range(steps):
            if k:
                held = [own | ({(k, i)} if not record.missed[run][k] >> i & 1 else set()) for i, own in enumerate(held)]
            before = list(held)
            for i in range(n):
                senders = [j for j in range(n) if record.heard[run][k][i] >> j & 1]
                came = [what for due, to, what in waiting if (due, to) == (k, i)]
                held[i] = before[i].union(*(before[j] for j in senders), *came)
            waiting += [(k + m.delay, m.receiver, before[m.sender]) for m in record.late.get((run, k + 1), ())]
            for i in range(n):
                P, x = P0 / sum((0, j) in held[i] for j in range(n)), X0
                for t in range(1, k + 1):
                    x, P = F @ x, F @ P @ F.T + Q
                    for j in range(n):
                        if (t, j) in held[i]:
                            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                            x, P = x + K @ (z[j][run, t][:, None] - H @ x), P - K @ H @ P
                np.testing.assert_allclose(stages[k].estimates[i].x[run], x, rtol=1e-9, atol=1e-11)
                np.testing.assert_allclose(stages[k].estimates[i].P[run], P, rtol=1e-9)


def test_nis_is_of_what_was_claimed_before():
    n, steps, runs = 2, 4, 5
    rng = np.random.default_rng(2)
    record = drawn(rng, runs, steps, n, late=False, misses=True)
    z = [rng.normal(size=(runs, steps, 1)) for _ in range(n)]
    system = scenario(n, steps).system
    stages = list(replay(system, "covariance-intersection", record, Readings.given(system, z)))
    assert np.isnan(stages[0].nis).all()
    for before, stage in pairwise(stages):
        k = stage.step - 1
        for i, estimate in enumerate(before.estimates):
            for run in range(runs):
                prior = F @ estimate.P[run] @ F.T + Q
                gone = z[i][run, k, 0] - (H @ F @ estimate.x[run])[0, 0]
                expected = gone**2 / (H @ prior @ H.T + R)[0, 0]
                expected = np.nan if record.missed[run][k] >> i & 1 else expected
                np.testing.assert_allclose(stage.nis[run, i], expected, rtol=1e-10)


class Twice:
    """A sensor that shows twice what its matrix says, as a function."""

    def h(self, x, step):
        return 2.0 * (H @ x)

    def H(self, x, step):  # noqa: N802
        return np.broadcast_to(2.0 * H, (len(x), *H.shape))

    def residual(self, measured, expected):
        return measured - expected


@pytest.mark.parametrize("name", [e for e in ESTIMATORS if "blender" not in e and "measurement" not in e])
def test_an_extended_filter_of_a_linear_function_is_the_linear_one(name):
    n, steps, runs = 2, 5, 6
    rng = np.random.default_rng(4)
    record = drawn(rng, runs, steps, n, late=False)
    z = [rng.normal(size=(runs, steps, 1)) for _ in range(n)]
    doubled = {"model": {"F": F, "Q": Q, "H": 2 * H, "R": R}, "initial": {"P": P0, "x": X0[:, 0]}}
    linear = sf.load_scenario({**doubled, "network": {"agents": n, "steps": steps}}).system
    plain = scenario(n, steps).system
    expected = list(replay(linear, name, record, Readings.given(linear, z)))
    found = list(replay(plain, name, record, Readings.given(plain, z, functions=[Twice()] * n)))
    for one, other in zip(expected, found, strict=True):
        for a, b in zip(one.estimates, other.estimates, strict=True):
            np.testing.assert_allclose(b.x, a.x, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(b.P, a.P, rtol=1e-9)
        np.testing.assert_allclose(other.nis, one.nis, rtol=1e-9)


def test_what_a_record_has_is_refused_by_the_table():
    s = scenario(2, 3)
    z = [np.zeros((1, 3, 1))] * 2
    late = arrivals([[set(), {(1, 0, 1)}, set()]], 2)
    with pytest.raises(
        sf.UsageError, match="the record has messages that came late: estimator lwin: expected messages"
    ):
        next(replay(s.system, "lwin", late, Readings.given(s.system, z)))
    missed = np.zeros((1, 3, 2), dtype=bool)
    missed[0, 1, 0] = True
    gap = arrivals_of(np.zeros((0, 4), dtype=np.int64), missed)
    with pytest.raises(
        sf.UsageError, match="the record has measurements that are missing: estimator blender: the joint"
    ):
        next(replay(s.system, "blender", gap, Readings.given(s.system, z)))
    assert set(INTERSECTIONS) <= set(ESTIMATORS)
