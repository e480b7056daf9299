"""Live agents: equal to replay in every history; bounded; and nothing that comes from elsewhere hurts them."""

from __future__ import annotations

import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.data.draw import Draws
from stochfuse.data.records import arrivals_of
from stochfuse.engines.replay import replay
from stochfuse.estimators.protocol import Late
from stochfuse.estimators.readings import Readings
from stochfuse.questions.messages import in_bytes
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.network import reachable
from stochfuse.scenario.registry import GENERAL
from stochfuse.scenario.scenario import link_rows
from tests.data import udp
from tests.oracles.featured import source as featured

F, Q = [[1.0, 0.5], [0.0, 0.8]], [[0.5, 0.1], [0.1, 0.4]]
H, R, P0 = [[1.0, 0.3]], [[0.8]], [[2.0, 0.3], [0.3, 1.0]]
LIVE = [e.name for e in registry.ESTIMATOR if not e.not_live]


def scenario(agents=3, steps=6, shared=False, **more):
    start = {"P": P0, "x": [1.0, -2.0], **({"correlation": "shared"} if shared else {})}
    network = {"agents": agents, "steps": steps}
    return sf.load_scenario({
        "model": {"F": F, "Q": Q, "H": H, "R": R}, "initial": start, "network": network, **more
    })  # fmt: skip


@st.composite
def histories(draw, name, agents=3, longest=6):
    """Scenario, arrivals (k, receiver, sender, delay), (steps, agents) misses, and what else happens."""
    steps = draw(st.integers(2, longest))
    takes = [capabilities.reason(name, GENERAL, f) is None for f in ("delay", "detection")]
    fate = st.sampled_from([None, None, 0, 0, 1, 3] if takes[0] else [None, 0])
    pairs = [(k, i, j) for k in range(1, steps + 1) for i in range(agents) for j in range(agents) if i != j]
    fates = draw(st.lists(fate, min_size=len(pairs), max_size=len(pairs)))
    came = [(*pair, d) for pair, d in zip(pairs, fates, strict=True) if d is not None and pair[0] + d <= steps]
    missed = draw(st.lists(st.booleans(), min_size=steps * agents, max_size=steps * agents))
    missed = np.reshape(missed, (1, steps, agents)) & takes[1]
    return scenario(agents, steps, draw(st.booleans())), came, missed, draw(st.integers(0, 2**16))


def replayed(s, name, came, missed, z, functions=()):
    heard = [(0, k - 1, i, j) for k, i, j, d in came if d == 0]
    late: dict = {}
    for k, i, j, d in came:
        if d:
            late.setdefault((0, k), []).append(Late(i, d, j))
    heard = np.array(heard, dtype=np.int64).reshape(-1, 4)
    record = arrivals_of(heard, missed, {key: tuple(sorted(each)) for key, each in late.items()})
    first = [None if s.nominal is None else s.nominal[0].reshape(1, -1, 1)] * s.network.agents
    readings = Readings.given(s.system, z, None, functions, first)
    return [stage.estimates for stage in replay(s.system, name, record, readings)]


def lived(s, name, came, missed, z, seed, protocol="acknowledged", restarts=0.3):
    """Estimates of live agents step by step, with shuffled and doubled messages, and restarts."""
    rng, n = np.random.default_rng(seed), s.network.agents
    agents = [sf.Agent(s, i + 1, name, protocol=protocol) for i in range(n)]
    coming: dict = {}

    def restart():
        if rng.random() < restarts:
            i = int(rng.integers(n))
            agents[i] = sf.Agent.load(agents[i].save(), s)

    for k in range(1, missed.shape[1] + 1):
        for i, agent in enumerate(agents if k > 1 else []):
            agent.step(None if missed[0, k - 1, i] else z[i][0, k - 1])
        restart()
        said = [agent.message() for agent in agents]
        for sent, i, j, d in came:
            if sent == k:
                coming.setdefault(k + d, []).append((i, said[j]))
        now = coming.pop(k, [])
        for at in rng.permutation(len(now)):
            i, message = now[at]
            agents[i].receive(message)
            restart()
            if rng.random() < 0.3:
                assert not agents[i].receive(message)
                agents[i].fuse()
        yield [agent.fuse() for agent in agents], agents


def check_history(name, history, protocol="acknowledged"):
    s, came, missed, seed = history
    z = [np.random.default_rng(seed + i).normal(size=(1, s.network.steps, 1)) for i in range(s.network.agents)]
    stages = replayed(s, name, came, missed, z)
    for stage, (claims, _) in zip(stages, lived(s, name, came, missed, z, seed, protocol), strict=True):
        for estimate, (x, P) in zip(stage, claims, strict=True):
            np.testing.assert_allclose(P, estimate.P[0], rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(x, estimate.x[0, :, 0], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("name", ["local-fusion-graph", "naive", "optimal", "split-ci"])
@settings(max_examples=4, deadline=None)
@given(st.data())
def test_in_every_history_it_is_replay(name, data):
    check_history(name, data.draw(histories(name, longest=4)))


@pytest.mark.slow
@pytest.mark.parametrize("name", LIVE)
@settings(max_examples=12, deadline=None)
@given(st.data())
def test_in_every_longer_history_it_is_replay(name, data):
    check_history(name, data.draw(histories(name, 3, 9)))


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(histories("local-fusion-graph", 4, 6))
def test_messages_that_carry_everything_say_no_more(history):
    check_history("local-fusion-graph", history, "full")
    check_history("local-fusion-graph", history)


@pytest.mark.slow
@pytest.mark.parametrize("link", [0.4, 1.0])
@pytest.mark.parametrize("name", ["local-fusion-graph", "optimal"])
def test_beyond_the_horizon_it_is_replay_too_and_holds_little(name, link):
    """80 steps, far more than the horizon of 32: nothing that was forgotten is missed."""
    s, rng = scenario(3, 80), np.random.default_rng(3)
    came = [(k, i, j, 0) for k in range(1, 81) for i in range(3) for j in range(3) if i != j and rng.random() < link]
    missed, z = np.zeros((1, 80, 3), dtype=bool), [rng.normal(size=(1, 80, 1)) for _ in range(3)]
    stages, most = replayed(s, name, came, missed, z), 0
    for stage, (claims, agents) in zip(stages, lived(s, name, came, missed, z, 1, restarts=0.02), strict=True):
        for estimate, (x, P) in zip(stage, claims, strict=True):
            np.testing.assert_allclose(P, estimate.P[0], rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(x, estimate.x[0, :, 0], rtol=1e-7, atol=1e-8)
        most = max(most, *(agent.nodes for agent in agents))
    assert most <= 60  # of 240


def test_sensors_that_are_not_linear_are_linearised_as_in_a_run():
    s = sf.load_scenario("two-radars").until(7)
    n, steps = s.network.agents, s.network.steps
    made = next(Draws(s, ("1",), link_rows(s, [0.5]), 3).batches())
    came = [(k, i, j, 0) for k in range(1, steps + 1) for i in range(n) for j in range(n) if i != j and (k + i) % 3]
    stages = replayed(s, "local-fusion-graph", came, made.missed, made.z, s.instruments)
    agents = [sf.Agent(s, i + 1) for i in range(n)]
    for k, stage in enumerate(stages, start=1):
        for i, agent in enumerate(agents if k > 1 else []):
            agent.step(None if made.missed[0, k - 1, i] else made.z[i][0, k - 1])
        said = [agent.message() for agent in agents]
        for sent, i, j, _ in came:
            if sent == k:
                agents[i].receive(said[j])
        for estimate, agent in zip(stage, agents, strict=True):
            x, P = agent.fuse()
            np.testing.assert_allclose(P, estimate.P[0], rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(x, estimate.x[0, :, 0], rtol=1e-6, atol=1e-6)


def forward(P, steps):
    for _ in range(steps):
        P = np.array(F) @ P @ np.array(F).T + np.array(Q)
    return P


FEATURES = [f.name for f in capabilities.FEATURES if f.name not in ("detection", "bursts", "cases", "own-states")]


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["ad-hoc", "cyclic"])
@pytest.mark.parametrize("name", LIVE)
def test_every_feature_that_the_table_takes_is_taken_live(name, architecture):
    """Known inputs among them."""
    for number, feature in enumerate([*FEATURES, "input"]):
        if feature != "input" and capabilities.reason(name, GENERAL, feature) is not None:
            continue
        made = featured([] if feature == "input" else [feature])
        made["network"] = {**made["network"], **({"architecture": architecture} if feature != "masks" else {})}
        if feature == "input":
            d = len(np.atleast_2d(made["model"]["F"]))
            made["model"] = {**made["model"], "B": np.eye(d).tolist(), "u": list(range(1, d + 1))}
        try:
            s = sf.load_scenario(made)
            agents = [sf.Agent(s, i + 1, name) for i in range(s.network.agents)]
        except (sf.UsageError, sf.ScenarioError):
            continue  # what the estimator or the scenario itself refuses, or filters that have no common input
        rng, steps, there = np.random.default_rng(number), s.network.steps, reachable(s.network)
        came = [(k, i, j, 0) for k in range(1, steps + 1) for i, j in np.argwhere(there).tolist() if rng.random() < 0.6]
        H = [s.system.sensors[kind].H for kind in s.system.sensor_of]
        z = [rng.normal(size=(1, steps, each.shape[1])) for each in H]
        missed = np.zeros((1, steps, len(agents)), dtype=bool)
        for k, stage in enumerate(replayed(s, name, came, missed, z), start=1):
            for i, agent in enumerate(agents if k > 1 else []):
                agent.step(z[i][0, k - 1] if H[i][k - 1].any() else None)
            said = [agent.message() for agent in agents]
            for sent, i, j, _ in came:
                if sent == k:
                    agents[i].receive(said[j])
            for estimate, agent in zip(stage, agents, strict=True):
                x, P = agent.fuse()
                np.testing.assert_allclose(P, estimate.P[0], rtol=1e-7, atol=1e-9, err_msg=feature)
                np.testing.assert_allclose(x, estimate.x[0, :, 0], rtol=1e-6, atol=1e-7, err_msg=feature)


def exchanged(name="local-fusion-graph", steps=6, agents=3, protocol="acknowledged", seed=1):
    """Agents that have talked with some loss, and all that was said."""
    s, rng = scenario(agents), np.random.default_rng(seed)
    live, said = [sf.Agent(s, i + 1, name, protocol=protocol) for i in range(agents)], []
    for k in range(1, steps + 1):
        for agent in live if k > 1 else []:
            agent.step(rng.normal())
        now = [agent.message() for agent in live]
        said += now
        for i, agent in enumerate(live):
            for j, message in enumerate(now):
                if i != j and rng.random() < 0.6:
                    agent.receive(message)
    return live, said


def summed(body):
    return body + struct.pack("<I", zlib.crc32(body))


def hostile(rng, said):
    """A message that was damaged, with a checksum that fits in two of three."""
    data = bytearray(said[rng.integers(len(said))])
    kind = rng.integers(6)
    if kind == 0:
        data = data[: rng.integers(len(data))]
    elif kind == 1:
        data += rng.bytes(int(rng.integers(1, 40)))
    elif kind == 2:  # counts and versions
        place = int(rng.integers(2, 20))
        data[place : place + 2] = rng.bytes(2)
    elif kind == 3:  # numbers
        place = len(data) - 4 - 8 * int(rng.integers(1, 10))
        value = rng.choice([np.nan, np.inf, -np.inf, -1.0, 1e300, -1e-300, 0.0])
        data[place : place + 8] = struct.pack("<d", value)
    elif kind == 4:
        for place in rng.integers(len(data), size=int(rng.integers(1, 6))):
            data[place] = rng.integers(256)
    else:
        data = bytearray(rng.bytes(int(rng.integers(200))))
    return bytes(data) if rng.random() < 1 / 3 else summed(bytes(data[:-4]))


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("local-fusion-graph", 500),
        pytest.param("local-fusion-graph", 10_000, marks=pytest.mark.slow),
        pytest.param("optimal", 3_000, marks=pytest.mark.slow),
        pytest.param("split-ci", 3_000, marks=pytest.mark.slow),
    ],
)
def test_hostile_messages_are_refused_or_do_no_harm(name, number):
    """Refused by MessageError, nothing changed; what is sound by chance is used, and nothing breaks."""
    live, said = exchanged(name)
    rng, agent, refused = np.random.default_rng(7), live[0], 0
    before, (x, P) = agent.save(), agent.fuse()
    start = time.process_time()
    for _ in range(number):
        try:
            new = agent.receive(hostile(rng, said))
        except sf.MessageError:
            new, refused = False, refused + 1
        if new:  # possible though untrue: the agent goes on with it, and this test with the agent as it was
            x_now, P_now = agent.fuse()
            agent.step(0.0)
            assert np.isfinite(x_now).all()
            assert np.linalg.eigvalsh(P_now).min() > 0
            agent = sf.Agent.load(before, agent.scenario)
    assert time.process_time() - start < 1e-3 * number
    assert refused > 0.7 * number
    for now, then in zip(agent.fuse(), (x, P), strict=True):
        np.testing.assert_array_equal(now, then)


def test_what_was_heard_before_tells_nothing_and_changes_nothing():
    live, said = exchanged()
    agent = live[0]
    for message in said:
        agent.receive(message)
    before = agent.save()
    assert not any(agent.receive(message) for message in said)
    assert agent.save() == before


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        (lambda m: "hello", "expected bytes, got str"),
        (lambda m: b"", "at least 24 bytes, got 0"),
        (lambda m: summed(b"SF\x09" + m[3:-4]), "version 1 of a message, got version 9"),
        (lambda m: b"PK" + m[2:], "got other bytes"),
        (lambda m: m[:-1] + bytes([m[-1] ^ 1]), "got damaged ones"),
        (lambda m: summed(m[:8] + b"\x04\x00" + m[10:-4]), "another network's, model's or estimator's"),
        (lambda m: summed(m[:18] + b"\xff\xff" + m[20:-4]), "nodes that fit into"),
        (lambda m: summed(m[:16] + b"\xff\xff" + m[18:-4]), "nodes that fit into"),
        (lambda m: summed(m[:-12] + struct.pack("<d", np.nan)), "finite numbers"),
        (lambda m: summed(m[:-12] + struct.pack("<d", -1.0)), "definite matrices"),
        (lambda m: summed(m[:-4] + b"0"), "bytes of numbers"),
        (lambda m: summed(m[:12] + b"\xff\xff\xff\xff" + m[16:-4]), "a first node of step 4294967295"),
        (lambda m: b"0" * 10_000_000, "at most .* bytes, got 10000000"),
    ],
)
def test_a_message_that_is_none_is_refused_with_the_reason(changed, match):
    live, _ = exchanged()
    message, before = live[1].message(), live[0].save()
    with pytest.raises(sf.MessageError, match=match):
        live[0].receive(changed(message))
    assert live[0].save() == before


def test_a_message_from_the_far_future_is_refused_and_a_near_one_waits():
    s = scenario(2)
    ahead, behind = (sf.Agent(s, i) for i in (1, 2))
    first = ahead.message()
    for _ in range(2):
        ahead.step()
    assert behind.receive(ahead.message())
    np.testing.assert_allclose(behind.fuse()[1], np.array(P0) / 2)  # of what it carries step 1 alone is no future
    for _ in range(2):
        behind.step()
    assert not behind.receive(first)  # what came later rests on it
    assert np.trace(behind.fuse()[1]) < np.trace(ahead.fuse()[1])
    np.testing.assert_allclose(behind.fuse()[1], forward(np.array(P0) / 2, 2), rtol=1e-9)
    for _ in range(33):
        ahead.step()
    with pytest.raises(sf.MessageError, match=r"step 35 at most \(now: 3; horizon 32\), got step 36"):
        behind.receive(ahead.message())


def test_two_that_go_by_one_number_are_told_apart():
    s = scenario(2)
    one, twin, other = sf.Agent(s, 1), sf.Agent(s, 1), sf.Agent(s, 2)
    twin.step(1.0)
    other.step(0.0)
    other.receive(twin.message())
    other.step(0.0)
    with pytest.raises(sf.MessageError, match="do two go by that number"):
        one.receive(other.message())


def test_an_agent_that_restarts_from_an_old_copy_goes_on_under_another_name():
    """It knows no more what it had said since, and what it makes then is not taken for that."""
    s = scenario(2)
    one, two = sf.Agent(s, 1), sf.Agent(s, 2)
    old = one.save()
    for z in (0.3, 0.1):
        one.step(z)
        two.step(z)
        two.receive(one.message())
    again = sf.Agent.load(old, s)
    for _ in range(3):
        again.step()
    two.step(0.2)
    said = two.message()
    assert again.receive(said)
    # all that two knew, its own measurements and those of one before it was started again, and nothing twice
    np.testing.assert_allclose(again.fuse()[1][0, 0] / two.fuse()[1][0, 0], 1.0, rtol=0.1)
    assert two.receive(again.message())


def test_the_long_silent_come_back_by_intersection_and_memory_stays_bounded():
    s, rng = scenario(3), np.random.default_rng(2)
    policy = sf.MessageProtocol("acknowledged", horizon=5)
    live = [sf.Agent(s, i, protocol=policy) for i in (1, 2, 3)]
    for k in range(1, 61):
        for agent in live if k > 1 else []:
            agent.step(rng.normal())
        said = [agent.message() for agent in live]
        silent = 10 < k <= 40
        for i, agent in enumerate(live):
            for j, message in enumerate(said):
                if i != j and not (silent and 2 in (i, j)) and rng.random() < 0.7:
                    agent.receive(message)
        for agent in live:
            assert np.linalg.eigvalsh(agent.fuse()[1]).min() > 0
            assert agent.nodes <= 3 * 6
        assert max(map(len, said)) < 3 * 6 * 60 + 100
        alone = live[2].fuse()[1] if k == 40 else alone if k > 40 else None  # noqa: F821
    assert np.trace(live[2].fuse()[1]) < np.trace(alone)  # it takes part again


def test_the_reason_of_a_refusal_is_told():
    with pytest.raises(sf.UsageError, match=r"estimator itns: a live agent fuses estimates that it hears; .* a centre"):
        sf.Agent("thesis-steady", 1, "itns")
    with pytest.raises(sf.UsageError, match=r"agent: expected a number from 1 to 3, got '4'"):
        sf.Agent("thesis-steady", 4)
    with pytest.raises(sf.UsageError, match=r"protocol: expected full, .* got 'window'"):
        sf.Agent("thesis-steady", 1, protocol="window")
    with pytest.raises(sf.UsageError, match="expected 1 finite number for z, or None, got"):
        sf.Agent("thesis-steady", 1).step([1.0, 2.0])
    with pytest.raises(sf.UsageError, match=r"expected 1 finite number for z, or None, got \[\]"):
        sf.Agent("thesis-steady", 1).step([])
    with pytest.raises(sf.UsageError, match=r"agent: expected a number from 1 to 3, got '2\.5'"):
        sf.Agent("thesis-steady", 1).message(to=2.5)
    for start in (5, sf.Start(2.5), sf.Start(3, [0.0])):
        with pytest.raises(
            sf.UsageError, match=r"start: expected Start\(step of at least 1, and both x and P or neither"
        ):
            sf.Agent("thesis-steady", 1, start=start)
    with pytest.raises(sf.UsageError, match=r"start: expected numbers for x and P, got \['a'\] and"):
        sf.Agent("thesis-steady", 1, start=sf.Start(3, ["a"], [[1.0]]))
    with pytest.raises(sf.UsageError, match=r"start\.P: expected a covariance, got "):
        sf.Agent("thesis-steady", 1, start=sf.Start(3, [0.0], [[-1.0]]))
    with pytest.raises(sf.UsageError, match="start: expected x of 1 numbers"):
        sf.Agent("thesis-steady", 1, start=sf.Start(3, [0.0], [[1.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(sf.MessageError, match=r"expected what Agent\.save returned"):
        sf.Agent.load(b"nonsense", "thesis-steady")


def test_agents_of_another_model_are_refused_where_all_sizes_agree():
    here, there = scenario(2), sf.scenario(model={"F": [[1, 1], [0, 1]], "Q": Q, "H": H, "R": R}, initial=P0,
                                           network={"agents": 2, "steps": 6})  # fmt: skip
    with pytest.raises(sf.MessageError, match="the same F and Q, got another network's, model's"):
        sf.Agent(here, 1).receive(sf.Agent(there, 2).message())
    with pytest.raises(sf.MessageError, match="saved agent: expected one of this scenario"):
        sf.Agent.load(sf.Agent(there, 1).save(), here)
    assert sf.Agent(scenario(2, 9), 1).receive(sf.Agent(here, 2).message())  # steps do not matter


@pytest.mark.parametrize("kind", ["position", "range-bearing"])
def test_sensors_that_stand_go_on_beyond_the_scenarios_steps(kind):
    """As in a scenario that is long enough; a sensor that moves ends with its path."""

    def at(steps, positions=((0, 0), (90, 0))):
        looks = {"position": {"kind": kind, "sigma": 3}, "range-bearing": {"kind": kind, "sigma": [3, 0.02]}}[kind]
        return sf.scenario(
            model={"kind": "constant-velocity", "axes": 2, "noise": 0.1,
                   "nominal": {"position": [50, 40], "velocity": [2, 1]}},
            initial=np.diag([25, 1, 25, 1]), network={"agents": 2, "steps": steps},
            agent=[{"position": list(p), "sensor": looks} for p in positions],
        )  # fmt: skip

    live = [[sf.Agent(at(steps), i) for i in (1, 2)] for steps in (2, 8)]
    for k in range(2, 9):
        for one, two in live:
            one.step([52.0 + 2 * k, 41.0 + k] if kind == "position" else [60.0 + k, 0.6])
            two.step()
            two.receive(one.message())
            two.fuse()
    for (x, P), (y, C) in zip(*(map(sf.Agent.fuse, pair) for pair in live), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9)
        np.testing.assert_allclose(P, C, rtol=1e-9, atol=1e-12)
    moving = sf.Agent(at(2, ([[0, 0], [1, 0]], (90, 0))), 1)
    moving.step()
    with pytest.raises(sf.UsageError, match=r"step 3: expected 2 steps at most \(network\.steps\): model or sensors"):
        moving.step()


def test_who_joins_late_is_an_independent_source():
    """Information adds up: Y = Y_1 + Y_2 where one begins at step 3 by itself."""
    s = scenario(2)
    one, joined = sf.Agent(s, 1), sf.Agent(s, 2, start=sf.Start(3, [0.0, 1.0], [[4.0, 0.0], [0.0, 9.0]]))
    one.step(0.5)
    one.step(0.2)
    x, P = one.fuse()
    assert one.receive(joined.message())
    Y = np.linalg.inv(P) + np.diag([1 / 4, 1 / 9])
    together, cov = one.fuse()
    np.testing.assert_allclose(np.linalg.inv(cov), Y, rtol=1e-12)
    np.testing.assert_allclose(Y @ together, np.linalg.inv(P) @ x + [0.0, 1 / 9], rtol=1e-10)


@pytest.mark.slow
def test_three_processes_that_talk_udp_send_and_claim_what_is_predicted():
    """200 steps, every other message lost; the prediction is of steps 11 to 16, which are as good as any later one."""
    found = udp.together(0.5, 200)
    s = udp.scenario(16)
    heard = np.mean([each["heard"] for each in found])
    assert abs(heard - 1.0) < 5 * np.sqrt(2 * 0.25 / (3 * 190))
    claimed = sf.predict(s, [0.5], "monte-carlo", estimator="local-fusion-graph", runs=60)
    expected, error = (each[0, 10:].mean() for each in (claimed.values("var:x1"), claimed.standard_error("var:x1")))
    assert abs(np.mean([each["claimed"] for each in found]) - expected) < 4 * error + 0.03 * expected
    assert 0.5 < np.mean([each["square"] for each in found]) / expected < 1.6
    load, number = (sf.message_load(s, [0.5], rule).between(11, 16) for rule in ("local-fusion-graph", "naive"))
    least = in_bytes(load, number, header=33).mean[0]
    assert least < np.mean([each["bytes"] for each in found]) < 5 * least
    assert max(each["most_held"] for each in found) <= 3 * 33
    assert max(each["longest"] for each in found) < 3 * 33 * 44


class Adds:
    """Naive fusion as a rule of one's own: information is added up."""

    def fuse(self, x, P):
        Y = np.linalg.inv(P)
        total = np.linalg.inv(Y.sum(axis=0))
        return total @ (Y @ x).sum(axis=0), total


class Halves:
    """A rule that claims a negative variance once it hears somebody."""

    def fuse(self, x, P):
        return x[0], P[0] if len(P) == 1 else -P[0]


def both(rule):
    return [sf.Agent(scenario(2), i, estimator=rule) for i in (1, 2)]


def test_a_rule_of_ones_own_is_alive():
    random = np.random.default_rng(4)
    mine, naive = both(Adds), both("naive")
    for k in range(5):
        z = random.normal(size=2)
        for pair in (mine, naive):
            if k:
                for agent, measured in zip(pair, z, strict=True):
                    agent.step([measured])
            if k != 2:
                pair[1].receive(pair[0].message())
            pair[0].receive(pair[1].message())
        if k == 3:
            with pytest.raises(sf.MessageError, match=r"expected estimator .tests\.data\.test_agent:Adds. to be given"):
                sf.Agent.load(mine[0].save(), scenario(2))
            mine[0] = sf.Agent.load(mine[0].save(), scenario(2), Adds)
        for a, b in zip(mine, naive, strict=True):
            np.testing.assert_allclose(a.fuse()[0], b.fuse()[0], atol=1e-12)
            np.testing.assert_allclose(a.fuse()[1], b.fuse()[1], atol=1e-12)


def test_a_rule_that_returns_rubbish_is_named_by_a_live_agent():
    one, other = both(Halves)
    other.receive(one.message())
    with pytest.raises(
        sf.UsageError, match=r"estimator tests\.data\.test_agent:Halves: step 1, agent 2: expected a fused P"
    ):
        other.fuse()
