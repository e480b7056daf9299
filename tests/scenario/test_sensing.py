"""Sensors by name: derivatives at 50 digits, scenarios against the same written out, and a sampled fly-by."""

from __future__ import annotations

import copy
import json
import re
from itertools import product

import mpmath as mp
import numpy as np
import pytest

import stochfuse as sf
from stochfuse.scenario.capabilities import features_of, reason
from stochfuse.scenario.registry import ESTIMATORS
from stochfuse.scenario.scenario import link_rows
from stochfuse.scenario.sensing import KINDS, Sight, observe, residual, slope
from stochfuse.studies.evaluation import evaluate
from stochfuse.studies.reading import load_study

AXES = {kind: (2, 3) if "bearing" in kind else (3,) if "elevation" in kind else (1, 2, 3) for kind in KINDS}
CASES = [(kind, axes) for kind, several in AXES.items() for axes in several]


# --- the functions ---------------------------------------------------------------------------------------------------


def truth(kind, p, v, a, va):
    """What each kind measures, written out for mpmath."""
    delta, axes = [x - y for x, y in zip(p, a, strict=True)], len(p)
    distance = mp.sqrt(mp.fsum(x**2 for x in delta))
    found = []
    for name in kind.split("-"):
        if name in ("position", "velocity"):
            found += p if name == "position" else v
        elif name == "range":
            found.append(distance)
        elif name in ("bearing", "azimuth"):
            found.append(mp.atan2(delta[1], delta[0]))
        elif name == "elevation":
            found.append(mp.asin(delta[2] / distance))
        elif name == "rate":  # how the distance changes: range along the relative way, differentiated
            moved = [x - y for x, y in zip(v, va, strict=True)]
            found.append(mp.fsum(x * w for x, w in zip(delta, moved, strict=True)) / distance)
    if kind == "range-rate":
        found = found[1:]
    assert len(found) == len(observe(kind, Sight(*[np.ones(axes), np.ones(axes), np.zeros(axes), np.zeros(axes)])))
    return found


def sight(rng, axes):
    scale = [1000.0, 100.0, 1000.0, 30.0]
    return [rng.uniform(-1, 1, axes) * s for s in scale]


@pytest.mark.parametrize(("kind", "axes"), CASES)
def test_values_and_derivatives(kind, axes):
    rng = np.random.default_rng(axes + 10 * list(KINDS).index(kind))
    for _ in range(3):
        given = sight(rng, axes)
        with mp.workdps(50):
            exact = [[mp.mpf(float(x)) for x in part] for part in given]
            values = np.array(truth(kind, *exact), dtype=float)

            def along(part, axis, row, exact=exact):
                def moved(t):
                    parts = [list(x) for x in exact]
                    parts[part][axis] = t
                    return truth(kind, *parts)[row]

                return float(mp.diff(moved, exact[part][axis]))

            place, velocity = (
                np.array([[along(part, axis, row) for axis in range(axes)] for row in range(len(values))])
                for part in (0, 1)
            )
        np.testing.assert_allclose(observe(kind, Sight(*given))[:, 0], values, rtol=1e-12)
        found = slope(kind, Sight(*given))
        np.testing.assert_allclose(found.place, place, rtol=1e-11, atol=1e-15)
        np.testing.assert_allclose(found.velocity, velocity, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("kind", "axes"), CASES)
def test_stacks_are_their_members(kind, axes):
    rng = np.random.default_rng(5)
    many = [np.array(both) for both in zip(*(sight(rng, axes) for _ in range(4)), strict=True)]
    fixed = [many[0], many[1], many[2][0], np.zeros(axes)]
    for k in range(4):
        one = Sight(many[0][k], many[1][k], many[2][0], np.zeros(axes))
        np.testing.assert_array_equal(observe(kind, Sight(*fixed))[k], observe(kind, one))
        for stack, member in zip(slope(kind, Sight(*fixed)), slope(kind, one), strict=True):
            np.testing.assert_array_equal(stack[k], member)


def test_differences_of_angles_are_wrapped():
    z, expected = np.array([[10.0], [3.1]]), np.array([[4.0], [-3.1]])
    np.testing.assert_allclose(residual("range-bearing", z, expected, 2), [[6.0], [6.2 - 2 * np.pi]])
    np.testing.assert_allclose(residual("position", z, expected, 2), [[6.0], [6.2]])
    assert residual("bearing", np.array([[np.pi]]), np.array([[0.0]]), 2) == -np.pi


# --- scenarios -------------------------------------------------------------------------------------------------------

STEPS = 6
GOOD = {
    "model": {
        "kind": "constant-velocity",
        "noise": 2.0,
        "step": 0.5,
        "nominal": {"position": [-300.0, 400.0], "velocity": [60.0, -5.0]},
    },
    "initial": {"P": [[900.0, 0, 0, 0], [0, 100.0, 0, 0], [0, 0, 900.0, 0], [0, 0, 0, 100.0]]},
    "network": {"agents": 2, "steps": STEPS, "link": 0.6},
    "agent": [
        {"position": [0.0, 0.0], "sensor": {"kind": "range-bearing", "sigma": [5.0, 0.02], "period": 2}},
        {"position": [300.0, 0.0], "sensor": {"kind": "bearing", "sigma": 0.01, "period": 3, "offset": 1}},
    ],
}


def scenario(first=None, **changes):
    """The good scenario with changes in the first agent's sensor, and in whole tables."""
    mapping = copy.deepcopy(GOOD)
    mapping["agent"][0]["sensor"] |= first or {}
    for path, value in changes.items():
        *tables, key = path.split("__")
        place = mapping
        for name in tables:
            place = place[int(name)] if name.isdigit() else place[name]
        if value is None:
            del place[key]
        else:
            place[key] = value
    return mapping


def seen(mapping, agent=0):
    """Steps at which an agent measures, from 1, told by its H."""
    s = sf.load_scenario(mapping)
    H = s.system.sensors[s.sensor_of[agent]].H
    steps = [k + 1 for k in range(1, len(H)) if H[k].any()]
    assert steps == (np.flatnonzero(s.instruments[agent].seen) + 1).tolist()
    return steps


def by_hand():
    """The good scenario written out: F and Q from the textbook, H by complex steps."""
    T, q = 0.5, 2.0
    F, Q = np.kron(np.eye(2), [[1, T], [0, 1]]), q * np.kron(np.eye(2), [[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    mapping = scenario()
    mapping["model"] = {"F": F.tolist(), "Q": Q.tolist(), "states": ["x", "vx", "y", "vy"], "units": ["m", "m/s"] * 2}
    places = [(0.0, 0.0), (300.0, 0.0)]
    H = [np.zeros((STEPS, 2, 4)), np.zeros((STEPS, 1, 4))]
    for k in range(1, STEPS + 1):
        x = np.array([-300.0 + 60 * T * (k - 1), 400.0 - 5 * T * (k - 1)])
        for axis in range(2):
            z = x.astype(complex)
            z[axis] += 1e-30j
            dx, dy = z - places[0]
            if (k - 1) % 2 == 0:
                H[0][k - 1, :, 2 * axis] = np.imag([np.sqrt(dx**2 + dy**2), np.arctan(dy / dx)]) / 1e-30
            dx, dy = z - places[1]
            if (k - 2) % 3 == 0:
                H[1][k - 1, :, 2 * axis] = np.imag(np.arctan(dy / dx)) / 1e-30
    mapping["agent"] = [
        {"H": H[0].tolist(), "R": [[25.0, 0.0], [0.0, 0.0004]]},
        {"H": H[1].tolist(), "R": [[0.0001]]},
    ]
    return mapping


METHODS = [
    {"method": "simplified"},
    {"method": "general"},
    {"method": "general", "quantity": "actual"},
    {"method": "optimal"},
    {"method": "general", "estimator": "naive", "quantity": "actual"},
    {"method": "general", "estimator": "stand-alone"},
    {"method": "monte-carlo", "runs": 50, "seed": 4},
]


@pytest.mark.parametrize("how", METHODS, ids=lambda how: "-".join(map(str, how.values())))
def test_by_name_is_as_by_hand(how):
    named, hand = (sf.predict(mapping, [0.3, 1.0], **how) for mapping in (scenario(), by_hand()))
    np.testing.assert_allclose(named.covariance, hand.covariance, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(
        [named.values("trace", agent) for agent in (1, 2)],
        [hand.values("trace", agent) for agent in (1, 2)],
        rtol=1e-12,
    )


def test_matrices_are_those_by_hand():
    named, hand = sf.load_scenario(scenario()), sf.load_scenario(by_hand())
    for mine, theirs in zip(named.sensors, hand.sensors, strict=True):
        np.testing.assert_allclose(mine.H, theirs.H, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(mine.R, theirs.R, rtol=1e-15)


@pytest.mark.parametrize("method", ["simplified", "general"])
def test_agents_may_change_places(method):
    mapping = scenario()
    other = scenario()
    other["agent"].reverse()
    one, two = (sf.predict(m, [0.4], method) for m in (mapping, other))
    for agent in (1, 2):
        np.testing.assert_allclose(one.values("trace", agent), two.values("trace", 3 - agent), rtol=1e-12)


def test_alike_sensors_are_one_kind():
    mapping = scenario()
    mapping["agent"][1] = copy.deepcopy(mapping["agent"][0])
    s = sf.load_scenario(mapping)
    assert (len(s.sensors), s.sensor_of) == (1, (0, 0))
    mapping["agent"][1]["sensor"]["detection"] = 0.9
    assert len(sf.load_scenario(mapping).sensors) == 2


def test_positions_need_neither_place_nor_path():
    mapping = scenario(model__nominal=None)
    del mapping["agent"]
    mapping["model"]["sensor"] = {"kind": "position", "sigma": 5.0}
    s = sf.load_scenario(mapping)
    assert not s.sensors[0].varies
    np.testing.assert_array_equal(s.sensors[0].H, [[1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_array_equal(s.sensors[0].R, 25 * np.eye(2))
    assert len(s.instruments) == 2
    assert s.nominal is None
    cv = sf.load_scenario("cv-2d", agents=2, steps=STEPS)
    named = {**mapping, "initial": cv.source["initial"], "model": {**mapping["model"], "noise": 0.5, "step": 1.0}}
    found, expected = sf.predict(named, [0.5], steady=True), sf.predict(cv, [0.5], steady=True)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-13)
    np.testing.assert_allclose(found.steady_values("trace"), expected.steady_values("trace"), rtol=1e-9)


def test_the_models_sensor_at_every_place():
    mapping = scenario()
    mapping["model"]["sensor"] = mapping["agent"][0].pop("sensor")
    del mapping["agent"][1]["sensor"]
    s, own = sf.load_scenario(mapping), scenario()
    own["agent"][1]["sensor"] = own["agent"][0]["sensor"]
    for mine, theirs in zip(s.sensors, sf.load_scenario(own).sensors, strict=True):
        np.testing.assert_array_equal(mine.H, theirs.H)
    mapping["agent"][1] |= {"H": [[1, 0, 0, 0]], "R": 4.0}
    assert sf.load_scenario(mapping).sensors[1].H.shape == (1, 4)
    mapping["agent"][1] = {"sensor": False}
    assert sf.load_scenario(mapping).sensors[1].H.shape == (0, 4)


def test_an_agent_says_when_it_measures_with_the_models_sensor():
    mapping, common = scenario(), {"kind": "range-bearing", "sigma": [5.0, 0.02], "period": 2}
    mapping["model"]["sensor"] = common
    mapping["agent"][0]["sensor"], mapping["agent"][1]["sensor"] = {"detection": 0.5}, {"period": 3, "offset": 1}
    own = scenario()
    own["agent"][0]["sensor"] = {**common, "detection": 0.5}
    own["agent"][1]["sensor"] = {**common, "period": 3, "offset": 1}
    assert seen(mapping, 1) == [2, 5]
    np.testing.assert_array_equal(sf.predict(mapping).by_group, sf.predict(own).by_group)


@pytest.mark.parametrize(
    ("table", "meant"),
    [
        ({}, {"sensor": {"period": 2, "detection": 0.5}}),
        ({"sensor": {"period": 1}}, {"sensor": {"detection": 0.5}}),
        ({"R": 9.0, "sensor": {"detection": 1.0}}, {"R": 9.0, "sensor": {"period": 2}}),
        ({"R": 9.0}, {"R": 9.0, "sensor": {"period": 2, "detection": 0.5}}),
        ({"H": 3.0}, {"H": 3.0, "sensor": {"period": 2, "detection": 0.5}}),
        ({"H": 3.0, "R": 9.0}, {"H": 3.0, "R": 9.0}),
        ({"sensor": False}, {"sensor": False}),
    ],
)
def test_when_matrices_of_the_model_measure(table, meant):
    source = {"model": {"F": 1, "H": 1, "Q": 1, "R": 1}, "initial": {"P": 4}, "network": {"agents": 2, "steps": 5}}
    common = {**source, "model": {**source["model"], "sensor": {"period": 2, "detection": 0.5}}}
    last = {"H": 2.0, "R": 3.0}
    found = sf.predict({**common, "agent": [table, last]}, [0.3])
    np.testing.assert_array_equal(found.by_group, sf.predict({**source, "agent": [meant, last]}, [0.3]).by_group)


def test_velocities():
    mapping = scenario(model__nominal=None)
    mapping["agent"] = [{"sensor": {"kind": "position-velocity", "sigma": [1, 1, 2, 2]}}, {"sensor": False}]
    np.testing.assert_array_equal(sf.load_scenario(mapping).sensors[0].H, np.eye(4)[[0, 2, 1, 3]])


def test_states_written_out_tell_the_place_by_their_names():
    mapping = by_hand()
    del mapping["agent"]
    # y before x, and a bias that no sensor sees
    order = [2, 3, 0, 1]
    F, Q = (np.array(mapping["model"][key])[np.ix_(order, order)] for key in ("F", "Q"))
    mapping["model"] |= {
        "F": np.block([[F, np.zeros((4, 1))], [np.zeros((1, 4)), np.ones((1, 1))]]).tolist(),
        "Q": np.block([[Q, np.zeros((4, 1))], [np.zeros((1, 4)), np.ones((1, 1))]]).tolist(),
        "states": ["y", "vy", "x", "vx", "bias"],
        "nominal": GOOD["model"]["nominal"],
        "step": 0.5,
    }
    del mapping["model"]["units"]
    mapping["initial"] = {"P": 900.0}
    mapping["agent"] = GOOD["agent"]
    found, expected = sf.load_scenario(mapping).sensors, sf.load_scenario(scenario()).sensors
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine.H[:, :, [2, 3, 0, 1]], theirs.H, rtol=1e-13)
        assert not mine.H[:, :, 4].any()


def test_periods_and_offsets():
    assert seen(scenario()) == [3, 5]
    assert seen(scenario({"period": 2, "offset": 1})) == [2, 4, 6]
    assert seen(scenario(), 1) == [2, 5]
    assert seen(scenario({"period": 1})) == [2, 3, 4, 5, 6]
    assert seen(scenario({"period": 100})) == []
    assert seen(scenario({"period": 2, "offset": 3})) == [2, 4, 6]


def test_range_and_field_of_view():
    # distances 500, 479.4, 460.9 …; bearings from 2.21 downwards
    path = np.array([[-300 + 30 * k, 400 - 2.5 * k] for k in range(STEPS)])
    distance, bearing = np.hypot(*path.T), np.arctan2(path[:, 1], path[:, 0])
    every = {"period": 1}
    assert seen(scenario({**every, "range": 450.0})) == [k + 1 for k in range(1, STEPS) if distance[k] <= 450]
    assert seen(scenario({**every, "range": 1e6})) == [2, 3, 4, 5, 6]
    view = {**every, "field_of_view": 0.2, "heading": 2.0}
    assert seen(scenario(view)) == [k + 1 for k in range(1, STEPS) if abs(bearing[k] - 2.0) <= 0.1] != []
    # the same seen across the cut at π, and a heading that follows
    assert seen(scenario({**view, "heading": 2.0 - 2 * np.pi})) == seen(scenario(view))
    assert seen(scenario({**every, "field_of_view": 1e-6, "heading": bearing.tolist()})) == [2, 3, 4, 5, 6]
    assert seen(scenario({**every, "field_of_view": 2 * np.pi, "heading": 17.0})) == [2, 3, 4, 5, 6]
    assert seen(scenario({"kind": "position", "sigma": 1.0, "range": 450.0, **every})) == [4, 5, 6]


def test_across_the_cut():
    mapping = scenario({"period": 1, "field_of_view": 0.4, "heading": 3.1})
    mapping["model"]["nominal"] = {"position": [-400.0, 30.0], "velocity": [0.0, -30.0]}
    # bearings 3.07, 3.10, 3.14, −3.10, −3.07, −3.03
    assert seen(mapping) == [2, 3, 4, 5, 6]


def test_noise_stays_where_nothing_is_seen():
    s = sf.load_scenario(scenario())
    assert s.system.sensors[0].R[1].tolist() == [[25.0, 0.0], [0.0, 0.0004]]
    assert "sensor-pauses" in features_of(s.system, link_rows(s))
    s = sf.load_scenario(scenario({"period": 100}))
    assert "no-sensor" in features_of(s.system, link_rows(s))


def test_a_sensor_that_never_sees_is_as_none():
    never, none = scenario({"period": 100}), scenario()
    none["agent"][0] = {"sensor": False}
    for how in ({"method": "general", "quantity": "actual"}, {"method": "simplified"}, {"method": "optimal"}):
        found, expected = (sf.predict(m, [0.5], **how).covariance for m in (never, none))
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_sensor_on_the_move():
    """Range rate has the sensor's own velocity, the difference of its places over the step that led there."""
    step = [0.0, 0.5, 1.0, 0.25, 0.5, 0.5]
    places = [[0.0, 0.0], [10.0, 0.0], [10.0, 20.0], [11.0, 21.0], [11.0, 21.0], [0.0, 5.0]]
    mapping = scenario({"kind": "range-bearing-rate", "sigma": [5, 0.01, 1], "period": 1}, agent__0__position=places)
    mapping["model"]["step"] = step
    s = sf.load_scenario(mapping)
    H, nominal = s.sensors[0].H, s.nominal
    assert nominal is not None
    for k in range(1, STEPS):
        own = (np.array(places[k]) - places[k - 1]) / step[k]
        x = nominal[k]
        expected = slope("range-bearing-rate", Sight(x[[0, 2]], x[[1, 3]], np.array(places[k]), own))
        np.testing.assert_allclose(H[k][:, [0, 2]], expected.place, rtol=1e-14)
        np.testing.assert_allclose(H[k][:, [1, 3]], expected.velocity, rtol=1e-14)
        instrument = s.instruments[0]
        assert instrument is not None
        np.testing.assert_allclose(instrument.H(x[:, None], k + 1), H[k], rtol=1e-14)
        z = instrument.h(x[:, None], k + 1)
        assert z.shape == (3, 1)
        np.testing.assert_allclose(
            z, observe("range-bearing-rate", Sight(x[[0, 2]], x[[1, 3]], np.array(places[k]), own))
        )
        assert np.abs(instrument.residual(z, z + 7.0)[1]) <= np.pi


def test_in_space():
    mapping = scenario(
        model__axes=3,
        model__nominal={"position": [-300.0, 400.0, 90.0], "velocity": [60.0, -5.0, 1.0]},
        initial__P=900.0,
        agent__0__position=[0, 0, 5.0],
        agent__1__position=[300.0, 0, 0],
    )
    mapping["agent"][0]["sensor"] = {"kind": "azimuth-elevation", "sigma": [0.01, 0.02]}
    s = sf.load_scenario(mapping)
    assert s.sensors[0].H.shape == (STEPS, 2, 6)
    assert s.sensors[1].H[1, 0, 4] == 0  # a bearing does not see the height
    assert np.isfinite(sf.predict(s, [0.5]).covariance).all()


def test_detection_is_read():
    s = sf.load_scenario(scenario({"detection": 0.8}))
    assert s.sensors[0].detection == 0.8
    assert s.sensors[1].detection is None
    assert s.system.sensors[0].detection == 0.8
    assert sf.load_scenario(scenario({"detection": 1.0})).sensors[0].detection is None
    each = [0.0, 0.5, 0.6, 0.7, 0.8, 1.0]
    sensor = sf.load_scenario(scenario({"detection": each})).sensors[0]
    assert sensor.detection is not None
    assert sensor.detection.tolist() == each
    assert sensor.at(3).detection == 0.6


# --- noises that hang together ---------------------------------------------------------------------------------------


PAUSING = [
    e
    for e in ESTIMATORS
    if all(reason(e, "general", f) is None for f in ("sensor-pauses", "unlike-sensors", "correlated-noises"))
]


@pytest.mark.parametrize("quantity", ["claimed", "actual"])
@pytest.mark.parametrize("estimator", PAUSING)
def test_pauses_leak_nothing_of_correlated_noises(estimator, quantity):
    """In a pause nothing is measured: whatever R is there, and however it hangs together with other noises."""
    mapping = scenario(noise={"correlation": 0.7}, agent__1__sensor={"kind": "range-bearing", "sigma": [5.0, 0.02]})
    mapping["network"]["steps"] = 3
    sensors = sf.load_scenario(mapping).sensors
    found = [sf.predict(mapping, [0.5], "general", estimator=estimator, quantity=quantity).covariance]
    for loudness in (1.0, 100.0):
        R = [[s.R * (1.0 if h.any() else loudness) for h in s.H] for s in sensors]
        agents = [{"H": s.H, "R": r} for s, r in zip(sensors, R, strict=True)]
        hand = {**mapping, "agent": agents}
        found.append(sf.predict(hand, [0.5], "general", estimator=estimator, quantity=quantity).covariance)
    np.testing.assert_allclose(found[1:], found[:1] * 2, rtol=1e-10)


def test_estimators_of_measurements_refuse_pauses():
    with pytest.raises(sf.UsageError, match=r"expected sensors that measure the same \(one H\)"):
        sf.predict(scenario(), [0.5], "general", estimator="equivalent-measurement")


# --- a fly-by --------------------------------------------------------------------------------------------------------


def sampled_fly_by(rng, runs, steps, link):
    """Squared error of place of the best that an agent can do with what reached it: everything drawn, naively.

    Own truth, own matrices (finite differences of range and bearing), sets of measurements passed on whole, and one
    textbook Kalman filter over each agent's set.
    """
    T, q = 0.05, 10.0
    F = np.array([[1, T, 0, 0], [0, 1, 0, 0], [0, 0, 1, T], [0, 0, 0, 1]])
    one = q * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    Q = np.block([[one, np.zeros((2, 2))], [np.zeros((2, 2)), one]])
    P0 = np.diag([200.0**2, 50.0**2] * 2)
    places, R = [(0.0, 0.0), (2000.0, 0.0)], [np.diag([400.0, 1e-4]), np.diag([100.0, 4e-4])]

    def matrix(i, k):
        def h(x, y):
            return np.array(
                [np.hypot(x - places[i][0], y - places[i][1]), np.arctan2(y - places[i][1], x - places[i][0])]
            )

        x, y = -500 + 250 * T * (k - 1), 2000.0
        H = np.zeros((2, 4))
        H[:, 0], H[:, 2] = (h(x + 0.01, y) - h(x - 0.01, y)) / 0.02, (h(x, y + 0.01) - h(x, y - 0.01)) / 0.02
        return H

    measuring = [range(3, steps + 1, 2), range(2, steps + 1, 5)]
    H = {(i, k): matrix(i, k) for i in (0, 1) for k in measuring[i]}
    roots = [np.linalg.cholesky(M) for M in (P0, Q, *R)]
    squared, claimed = np.zeros((runs, 2)), np.zeros((runs, 2))
    for run in range(runs):
        x = roots[0] @ rng.normal(size=4)
        first = [x + roots[0] @ rng.normal(size=4) for _ in (0, 1)]
        known, z = [{("first", 0)}, {("first", 1)}], {}
        for k in range(1, steps + 1):
            if k > 1:
                x = F @ x + roots[1] @ rng.normal(size=4)
            for i in (0, 1):
                if (i, k) in H:
                    z[i, k] = H[i, k] @ x + roots[2 + i] @ rng.normal(size=2)
                    known[i].add((i, k))
            sent = [set(s) for s in known]
            for i in (0, 1):
                if rng.uniform() < link:
                    known[i] |= sent[1 - i]
        for i in (0, 1):
            starts = [j for j in (0, 1) if ("first", j) in known[i]]
            P, estimate = P0 / len(starts), np.mean([first[j] for j in starts], axis=0)
            for k in range(2, steps + 1):
                P, estimate = F @ P @ F.T + Q, F @ estimate
                for j in (0, 1):
                    if (j, k) in known[i]:
                        h = H[j, k]
                        K = P @ h.T @ np.linalg.inv(h @ P @ h.T + R[j])
                        estimate, P = estimate + K @ (z[j, k] - h @ estimate), P - K @ h @ P
            e = estimate - x
            squared[run, i], claimed[run, i] = e[0] ** 2 + e[2] ** 2, P[0, 0] + P[2, 2]
    return squared, claimed


def test_two_radars_fly_by():
    steps, link, runs = 12, 0.4, 1500
    squared, claimed = sampled_fly_by(np.random.default_rng(8), runs, steps, link)
    s = sf.load_scenario("two-radars", steps=steps)
    exact = sf.predict(s, [link], "optimal")
    drawn = sf.predict(s, [link], "monte-carlo", estimator="optimal", runs=1500, seed=2)
    for agent in (1, 2):
        expected = sum(exact.values(f"var:{axis}", agent)[0, -1] for axis in "xy")
        for sample in (squared, claimed):
            error = sample[:, agent - 1].std(ddof=1) / np.sqrt(runs)
            assert abs(sample[:, agent - 1].mean() - expected) <= 4 * error
        mean, error = drawn.values("trace", agent)[0, -1], drawn.standard_error("trace", agent)[0, -1]
        assert abs(mean - exact.values("trace", agent)[0, -1]) <= 4 * error


# --- what does not fit -----------------------------------------------------------------------------------------------

PLACES = "model.kind, or states named x, y and z (as many as there are; vx … their velocities), that tell the place"
WRONG = [
    ({"kind": "sonar"}, {}, "agent[1].sensor.kind: expected one of \"position\", \"velocity\""),
    ({"sigma": 5}, {}, "agent[1].sensor.sigma: expected 2 standard deviations above 0, a list in m, rad, got 5"),
    ({"sigma": [5, 0]}, {}, "agent[1].sensor.sigma: expected 2 standard deviations above 0, a list in m, rad, got [5, 0]"),
    ({"sigma": [5, 1, 1]}, {}, "agent[1].sensor.sigma: expected 2 standard deviations above 0, a list in m, rad, got [5, 1, 1]"),
    ({"kind": "position", "sigma": -1}, {}, "agent[1].sensor.sigma: expected a standard deviation above 0 in m, or a list of 2, got -1"),
    ({"kind": "bearing", "sigma": "wide"}, {}, "agent[1].sensor.sigma: expected a standard deviation, or a list of them, got 'wide'"),
    ({"range": 0}, {}, "agent[1].sensor.range: expected a distance above 0 in m, got 0"),
    ({"range": [1, 2]}, {}, "agent[1].sensor.range: expected a number, got [1, 2]"),
    ({"field_of_view": 7}, {}, "agent[1].sensor.field_of_view: expected a full width in rad above 0, at most 2π, got 7"),
    ({"heading": 1.0}, {}, "agent[1].sensor.heading: expected nothing without a field_of_view, got 1.0"),
    ({"heading": [1.0], "field_of_view": 1}, {}, "agent[1].sensor.heading: expected one number for each of the 6 steps, got 1 numbers"),
    ({"period": 0}, {}, "agent[1].sensor.period: expected a whole number of at least 1, got 0"),
    ({"offset": -1}, {}, "agent[1].sensor.offset: expected a whole number of at least 0, got -1"),
    ({"offset": 0.5}, {}, "agent[1].sensor.offset: expected a whole number, got 0.5"),
    ({"detection": 1.2}, {}, "agent[1].sensor.detection: expected a probability, or one per step, got 1.2"),
    ({"detection": [0.5]}, {}, "agent[1].sensor.detection: expected one number for each of the 6 steps, got 1 numbers"),
    ({"gain": 3}, {}, "agent[1].sensor.gain: expected a known key, got an unknown one, 'gain'"),
    ({}, {"agent__0__sensor": 5}, "agent[1].sensor: expected true, false, or a table, got 5"),
    ({}, {"agent__0__sensor": {"sigma": 3}}, "or H and R with period, offset, detection alone, got nothing"),
    ({}, {"agent__0__H": [[1, 0, 0, 0]]}, "agent[1].H: expected nothing beside a sensor by name, got [[1, 0, 0, 0]]"),
    ({}, {"agent__0__R": 4}, "agent[1].R: expected nothing beside a sensor by name, got 4"),
    ({}, {"agent__0__position": None}, "agent[1].position: expected the place of its sensor, 2 coordinates or as many per step, got nothing"),
    ({}, {"agent__0__position": [1, 2, 3]}, "agent[1].position: expected a list of 2 numbers, or one such list per step, got [1, 2, 3]"),
    ({}, {"agent__0__position": [[1, 2]]}, "agent[1].position: expected one list for each of the 6 steps, got 1 lists"),
    ({}, {"model__nominal": None}, "model.nominal: expected a nominal path (position, velocity), about which agent[1].sensor (range-bearing) is linearised, got nothing"),
    ({}, {"model__nominal": {"position": "there"}}, "model.nominal.position: expected a list of coordinates, or one such list per step, got 'there'"),
    ({"period": 1}, {"agent__0__position": [-240, 395]}, "agent[1].position: expected a place away from the target's, for a range-bearing to it, got [-240.0, 395.0] with the target at [-240.0, 395.0] at step 3"),
    ({"kind": "azimuth-elevation"}, {}, 'agent[1].sensor.kind: expected 3 axes for a "azimuth-elevation", got 2'),
    ({"kind": "range-bearing-rate", "sigma": [1, 1, 1]}, {"model__kind": "random-walk", "model__nominal": {"position": [1, 1]}, "initial__P": 1}, 'agent[1].sensor.kind: expected a model with velocities for a "range-bearing-rate", got states x, y'),
    ({}, {"model": {"F": [[1, 0], [0, 1]], "Q": 1, "states": ["u", "v"]}, "initial__P": 1}, f'agent[1].sensor.kind: expected {PLACES}, for a "range-bearing", got states u, v'),
    ({}, {"agent__0__F": [[1, 0], [0, 1]], "agent__0__P": 1, "agent__0__Q": 1, "agent__0__M": [[1, 0], [0, 0], [0, 1], [0, 0]]}, "agent[1].F: expected nothing beside a sensor by name, which measures the model's states; or H and R instead of it, got [[1, 0], [0, 1]]"),
    ({}, {"noise": {"correlation": 0.3}}, "noise.correlation: expected sensors with as many components where they are correlated, got 2 of agent 1 and 1 of agent 2"),
    ({}, {"model__sensor": {"kind": "position", "sigma": 1}, "model__H": [[1, 0, 0, 0]]}, "model.H: expected nothing beside a sensor by name, got [[1, 0, 0, 0]]"),
    ({}, {"model__own": True, "cooperative": {"positions": ["x", "y"], "range": 1.0}}, 'agent[1].sensor: expected one that does not look from a place, since the states are the agents\' own (model.own), got "range-bearing"'),
]  # fmt: skip


@pytest.mark.parametrize(("first", "changes", "message"), WRONG)
def test_what_does_not_fit_is_named_once(first, changes, message):
    with pytest.raises(sf.ScenarioError, match=re.escape(message)) as caught:
        sf.load_scenario(scenario(first, **changes))
    paths = [problem.path for problem in caught.value.problems]
    assert len(paths) == len(set(paths)), paths


def test_one_message_for_a_path_that_all_need():
    mapping = scenario(model__nominal=None)
    with pytest.raises(sf.ScenarioError) as caught:
        sf.load_scenario(mapping)
    assert [problem.path for problem in caught.value.problems] == ["model.nominal"]


def test_the_models_sensor_needs_places_and_says_once_what_is_wrong_with_it():
    mapping = scenario()
    mapping["model"]["sensor"] = {"kind": "range", "sigma": -3}
    for table in mapping["agent"]:
        del table["sensor"]
    with pytest.raises(sf.ScenarioError) as caught:
        sf.load_scenario(mapping)
    assert [problem.path for problem in caught.value.problems] == ["model.sensor.sigma"]
    mapping["model"]["sensor"]["sigma"] = 3
    del mapping["agent"]
    with pytest.raises(
        sf.ScenarioError,
        match=r"agent: expected one \[\[agent\]\] table with a position for each, where model.sensor is",
    ):
        sf.load_scenario(mapping)


def test_a_place_that_only_matters_before_it_measures():
    """At step 1 nothing is measured, so that the target may stand where the sensor is; nor does a pause look."""
    assert seen(scenario({"period": 1}, agent__0__position=[-300, 400])) == [2, 3, 4, 5, 6]
    assert seen(scenario({"period": 2}, agent__0__position=[-270, 397.5])) == [3, 5]


def test_a_line_has_no_bearings():
    mapping = scenario(model__axes=1, model__nominal={"position": 5.0, "velocity": 1.0}, initial__P=1.0)
    mapping["agent"] = [
        {"position": 0.0, "sensor": {"kind": "range", "sigma": 1.0}},
        {"position": [[9.0]] * STEPS, "sensor": {"kind": "range-rate", "sigma": 1.0}},
    ]
    s = sf.load_scenario(mapping)
    assert s.sensors[0].H.tolist() == [[1.0, 0.0]]
    assert s.sensors[1].H.tolist() == [[0.0, -1.0]]
    mapping["agent"][0]["sensor"]["field_of_view"] = 1.0
    with pytest.raises(
        sf.ScenarioError, match=r"field_of_view: expected nothing on a line, which has no bearings, got 1.0"
    ):
        sf.load_scenario(mapping)


def test_steps_have_an_end():
    with pytest.raises(sf.ScenarioError, match=r"network.steps: expected at most 100000 with sensors by name"):
        sf.load_scenario(scenario(network__steps=10_000_000))


def test_variances_from_the_command_line():
    mapping = scenario(model__nominal=None)
    del mapping["agent"]
    mapping["model"]["sensor"] = {"kind": "position", "sigma": 5.0}
    assert sf.load_scenario(mapping, r=9.0).sensors[0].R.tolist() == [[9, 0], [0, 9]]
    assert sf.load_scenario(mapping, r=np.int64(9)).sensors[0].R.tolist() == [[9, 0], [0, 9]]
    assert mapping["model"]["sensor"]["sigma"] == 5.0
    with pytest.raises(
        sf.UsageError, match=r"r: expected a variance, in the place of a standard deviation, got \[4, 9\]"
    ):
        sf.load_scenario(mapping, r=[4, 9])
    with pytest.raises(sf.ScenarioError, match=r"model.sensor.sigma: expected a standard deviation above 0 in m"):
        sf.load_scenario(mapping, r=-9.0)
    with pytest.raises(
        sf.UsageError, match=r"r: expected a sensor of the model \(model.R or model.sensor\), got agents"
    ):
        sf.load_scenario(scenario(), r=9.0)
    mapping["model"]["sensor"] = {"kind": "range-bearing", "sigma": [1, 1]}
    with pytest.raises(
        sf.ScenarioError, match=r"model.sensor.sigma: expected 2 standard deviations above 0, a list in m, rad"
    ):
        sf.load_scenario(mapping, r=9.0)


def test_a_scenario_survives_json_and_shortening():
    s = sf.load_scenario(json.loads(json.dumps(sf.load_scenario(scenario()).to_mapping())))
    np.testing.assert_array_equal(s.sensors[0].H, sf.load_scenario(scenario()).sensors[0].H)
    short = sf.predict(s.until(3), [0.5]).covariance
    np.testing.assert_allclose(short, sf.predict(s, [0.5]).covariance[:, :3], rtol=1e-14)


def test_a_study_varies_them():
    vary = {"model.noise": [2.0, 3.0], "agent[1].sensor.period": [1, 2]}
    plan = load_study({"scenario": scenario(), "vary": vary, "report": {"metric": "trace"}})
    found = evaluate(plan, range(4))
    for point, (noise, period) in enumerate(product(*vary.values())):
        expected = sf.predict(scenario({"period": period}, model__noise=noise)).values("trace")[0]
        np.testing.assert_allclose(found.values.reshape(4, STEPS)[point], expected, rtol=1e-12)
