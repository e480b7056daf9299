"""Scenarios from arrays, links, frames, graphs and Stone Soup: the same as from a file, and as the others compute."""

from __future__ import annotations

import copy
import inspect
import pickle
import subprocess
import sys
from datetime import datetime, timedelta
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import stochfuse as sf

F, Q = np.array([[1.0, 1.0], [0.0, 1.0]]), 0.1 * np.eye(2)
MODEL = {"F": F, "H": np.array([[1.0, 0.0]]), "Q": Q, "R": np.float64(4)}
P0 = np.diag([9.0, 1.0])
LINK = np.array([[0, 0.9, 0.5], [0.8, 0, 0.2], [0.4, 0.3, 0]])
FILE = {
    "model": {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.1, 0], [0, 0.1]], "R": 4},
    "initial": {"P": [[9, 0], [0, 1]]},
    "network": {"agents": 3, "steps": 3, "link": LINK.tolist()},
}


def values(scenario, **asked):
    return sf.predict(scenario, method="general", **asked).covariance


# the door


@pytest.mark.parametrize(
    "first",
    [
        "import stochfuse as sf",
        "import stochfuse.scenario.links; import stochfuse as sf",
        "import stochfuse as sf, importlib; importlib.reload(importlib.import_module('stochfuse.scenario'))",
    ],
)
def test_the_door_is_there_before_and_after_imports(first):
    """In a process of its own, since here everything has been imported."""
    code = (
        f"{first}\n"
        "s = sf.scenario(model=dict(F=1, H=1, Q=25, R=100), initial=100, network=dict(agents=3, steps=2))\n"
        "import stochfuse.scenario.links, stochfuse.scenario.scenario\n"
        "from stochfuse import scenario\n"
        "assert stochfuse.scenario.links.Links is type(sf.links('road-5'))\n"
        "assert isinstance(s, stochfuse.scenario.scenario.Scenario)\n"
        "assert callable(sf.scenario) and sf.scenario is stochfuse.scenario is scenario\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_the_door_is_room_and_function():
    from stochfuse.scenario import adapters

    assert isinstance(sf.scenario, ModuleType)
    assert sf.scenario.__name__ == "stochfuse.scenario"
    assert pickle.loads(pickle.dumps(sf.scenario)) is sf.scenario
    assert copy.deepcopy(sf.scenario) is sf.scenario
    assert inspect.signature(sf.scenario) == inspect.signature(adapters.scenario)
    assert "network" in inspect.signature(sf.scenario).parameters
    assert inspect.getdoc(sf.scenario).startswith("What is given")
    assert {"Scenario", "scenario"} <= set(dir(sf))
    with pytest.raises(AttributeError):
        sf.scenario.nothing  # noqa: B018


# arrays and numbers


def test_arrays_make_the_scenario_that_a_file_makes():
    file = sf.load_scenario(FILE)
    for made in (
        sf.scenario(model=MODEL, initial={"P": P0}, network={"agents": 3, "steps": 3, "link": LINK}),
        sf.scenario(MODEL, 3, {"steps": np.int64(3), "link": LINK}, P0),
        sf.scenario(MODEL, [{}, {}, {}], {"steps": 3, "link": LINK.tolist()}, P0.tolist()),
    ):
        np.testing.assert_array_equal(values(made), values(file))
        np.testing.assert_array_equal(values(sf.load_scenario(made.to_mapping())), values(file))
    assert sf.scenario(MODEL, 3, {"steps": 3}, 4, name="mine").name == "mine"
    np.testing.assert_array_equal(sf.scenario(MODEL, 3, {"steps": 3}, 4).P0, 4 * np.eye(2))


def test_agents_and_other_tables_are_those_of_a_file():
    agents = [{"R": 9.0}, {"sensor": False}, {"H": np.eye(2), "R": np.diag([1.0, 2.0])}]
    noise = {"correlation": 0.0}
    made = sf.scenario(
        MODEL,
        agents,
        {"steps": 3, "link": 0.5},
        {"P": P0, "correlation": "shared"},
        noise=noise,
        report={"metric": "std:x1"},
    )
    lists = [{"R": 9.0}, {"sensor": False}, {"H": [[1, 0], [0, 1]], "R": [[1, 0], [0, 2]]}]
    file = {**FILE, "agent": lists, "network": {"agents": 3, "steps": 3, "link": 0.5}, "noise": noise}
    file = {**file, "initial": {**FILE["initial"], "correlation": "shared"}}
    assert made.metric == "std:x1"
    np.testing.assert_array_equal(values(made), values(file))


def test_frames_stand_for_matrices():
    pandas = pytest.importorskip("pandas")
    names = ["x", "v"]
    model = {**MODEL, "F": pandas.DataFrame(F, names, names), "Q": pandas.DataFrame(Q)}
    made = sf.scenario(model, network=FILE["network"], initial=pandas.DataFrame(P0))
    np.testing.assert_array_equal(values(made), values(FILE))


PACKETS = [(s, r, k) for s in "abc" for r in "abc" if s != r and (s, r) != ("a", "c") for k in range(10)]
LOG = {
    "seq": [k for _, _, k in PACKETS],
    "sender": [s for s, _, _ in PACKETS],
    "receiver": [r for _, r, _ in PACKETS],
    "received": [int(k < 6) for _, _, k in PACKETS],
}


def test_links_of_a_log_are_taken_with_their_names_and_what_is_unknown_is_not_heard():
    pandas = pytest.importorskip("pandas")
    found = sf.links(LOG)
    matrix = found.to_dataframe().pivot(index="receiver", columns="sender", values="link")
    by_hand = np.array([[0, 0.6, 0.6], [0.6, 0, 0.6], [0, 0.6, 0]])
    for link in (found, pandas.DataFrame(LOG), found.to_dataframe(), matrix):
        s = sf.scenario(MODEL, network={"steps": 3, "link": link}, initial=P0)
        np.testing.assert_allclose(s.network.link, by_hand)
        assert s.to_mapping()["network"]["nodes"] == ["a", "b", "c"]
        assert not s.network.hears[2, 0]
        assert s.network.hears.sum() == 5
        np.testing.assert_allclose(
            values(s), values({**FILE, "network": {"agents": 3, "steps": 3, "link": by_hand}}), rtol=1e-12
        )
    p = sf.predict(sf.scenario(MODEL, network={"steps": 3, "link": found}, initial=P0), interval=0.95)
    assert (p.low() < p.values()).all()
    assert (p.values() < p.high()).all()
    named = [{"name": "c"}, {"name": "b", "R": 9.0}]
    assert sf.scenario(MODEL, named, {"steps": 3, "link": found}, P0).network.names == ("c", "b")
    two = sf.scenario(MODEL, network={"steps": 3, "link": found, "nodes": ["b", "a"]}, initial=P0)
    assert two.network.agents == 2
    assert two.network.hears is None
    delayed = sf.links({**LOG, "sent_time": LOG["seq"], "received_time": [k + 1.5 for k in LOG["seq"]]}, step=1.0)
    assert sf.scenario(MODEL, network={"steps": 3, "link": delayed}, initial=P0).network.delay == (0.0, 1.0)


def test_links_of_another_scenario_are_taken_step_by_step():
    road = sf.links("road-5")
    s = sf.scenario(MODEL, network={"steps": 4, "link": road}, initial=P0)
    np.testing.assert_array_equal(s.network.link, np.nan_to_num(road.link[:4]))
    with pytest.raises(sf.ScenarioError, match=r"network.link: expected one probability for each link, got bursts or"):
        sf.scenario(MODEL, network={"steps": 2, "link": sf.links("fcs-demo")}, initial=P0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, r"network.agents: expected a value, got nothing"),
        ({"agents": 2, "network": {"agents": 3}}, r"network.agents: expected 2, as many as agents, got 3"),
        ({"agents": "x"}, r"network.agents: expected a whole number, got 'x'"),
        ({"agents": 3.5}, r"network.agents: expected a whole number, got 3.5"),
        ({"network": 5}, r"network: expected a table, got 5"),
        ({"netwrk": {}}, r"netwrk: expected a known key, got an unknown one, 'netwrk' \(did you mean 'network'\?\)"),
        ({"agents": [{}], "agent": [{}]}, r"agent: expected nothing beside a list of agents, got a list"),
        ({"agents": [{"R": -1}, {"sensr": 1}], "network": {"steps": 2}}, r"(?s)agent\[2\].sensr.*agent\[1\].R"),
        ({"initial": np.array([[1.0, 2.0], [0.0, 1.0]])}, r"initial.P: expected a symmetric"),
        ({"network": {"steps": 2, "link": sf.links(LOG), "agents": 2}}, r"network.agents: expected 3, the nodes of table"),
        ({"network": {"steps": 2, "link": sf.links(LOG), "nodes": ["q"]}}, r"network.link: .* got 'q'"),
        ({"network": {"steps": 2, "link": sf.links(LOG), "architecture": "cyclic"}}, r"nothing known of a to c"),
        ({"network": {"steps": 2, "link": sf.links(LOG), "hears": [[2], [1], [1]]}}, r"nothing known of a to c"),
        ({"network": {"agents": 2, "steps": 2, "link": [[0, 1.5], [0, 0]]}}, r"network.link: expected probabilities"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named_by_its_key(given, message):
    with pytest.raises(sf.ScenarioError, match=message):
        sf.scenario(**{"model": MODEL, "initial": P0, **given})


# graphs


@pytest.fixture(scope="module")
def nx():
    return pytest.importorskip("networkx")


def test_a_directed_graph_is_read_from_sender_to_receiver(nx):
    G = nx.DiGraph()
    G.add_nodes_from(["c", "a", "b"])
    G.add_weighted_edges_from([("a", "b", 0.9), ("c", "b", np.float32(0.5)), ("b", "a", 1)])
    network = sf.from_networkx(G, steps=3)
    assert network == {
        "agents": 3,
        "nodes": ["c", "a", "b"],
        "link": [[0, 0, 0], [0, 0, 1], [0.5, 0.9, 0]],
        "hears": [[], [3], [1, 2]],
        "steps": 3,
    }
    made = sf.scenario(MODEL, network=network, initial=P0)
    by_hand = {"agents": 3, "steps": 3, "link": [[0, 0, 0], [0, 0, 1], [0.5, 0.9, 0]]}
    np.testing.assert_allclose(values(made), values({**FILE, "network": by_hand}), rtol=1e-12)


def test_an_undirected_graph_carries_messages_both_ways(nx):
    G = nx.complete_graph(3)
    assert sf.from_networkx(G, default=0.5) == {
        "agents": 3,
        "nodes": ["0", "1", "2"],
        "link": [[0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]],
    }
    G = nx.path_graph(3)
    nx.set_edge_attributes(G, {(0, 1): 0.7}, "pdr")
    network = sf.from_networkx(G, "pdr", default=0.2, steps=4, architecture="ad-hoc")
    assert network["link"] == [[0, 0.7, 0], [0.7, 0, 0.2], [0, 0.2, 0]]
    assert network["hears"] == [[2], [1, 3], [2]]
    assert sf.scenario(MODEL, network=network, initial=P0).network.steps == 4


def test_attributes_of_nodes_may_be_the_agents_keys(nx):
    G = nx.DiGraph()
    G.add_node("uav", R=1.0)
    G.add_node("relay", sensor=False)
    G.add_edge("uav", "relay", weight=0.5)
    agents = [dict(G.nodes[n]) for n in G]
    s = sf.scenario(MODEL, agents, sf.from_networkx(G, steps=2), P0)
    assert s.sensors[s.sensor_of[0]].R == 1.0
    assert s.sensors[s.sensor_of[1]].H.shape == (0, 2)


@pytest.mark.parametrize(
    ("delays", "expected"),
    [
        ((None, None, None), None),
        ((0, None, 0), None),
        ((2, 2, 2), 2),
        (([0.5, 0.5], [0.5, 0.5], np.array([0.5, 0.5])), [0.5, 0.5]),
        ((2, None, np.int64(1)), [[0, 2, 0], [0, 0, 0], [1, 0, 0]]),
        ((2, [0.5, 0.5], 0), [[0, 2, 0], [0, 0, [0.5, 0.5]], [0, 0, 0]]),
    ],
)
def test_delays_of_edges_are_one_or_a_matrix_of_receiver_and_sender(nx, delays, expected):
    G = nx.DiGraph()
    G.add_nodes_from("abc")
    for ends, delay in zip(["ba", "cb", "ac"], delays, strict=True):
        G.add_edge(*ends, weight=0.5, **({} if delay is None else {"delay": delay}))
    network = sf.from_networkx(G, steps=3)
    assert network.get("delay") == expected
    made = sf.scenario(MODEL, network=network, initial=P0).network
    for i, j in ((0, 1), (1, 2), (2, 0)):
        given = expected[i][j] if isinstance(expected, list) and len(expected) == 3 else expected or 0
        wanted = given if isinstance(given, list) else [0.0] * given + [1.0]
        assert made.delay_of(i, j)[: len(wanted)] == tuple(wanted)


def graph_of(nx, kind="DiGraph", **edge):
    G = getattr(nx, kind)()
    G.add_edge("a", "b", **edge)
    return G


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda nx: 5, "graph: expected a networkx Graph or DiGraph, got int"),
        (lambda nx: nx.DiGraph(), "graph: expected nodes, got none"),
        (lambda nx: graph_of(nx, "MultiDiGraph", weight=0.5), "graph: expected at most one edge each way, got a MultiDiGraph"),
        (lambda nx: graph_of(nx), "edge a to b, 'weight': expected a probability between 0 and 1, got nothing"),
        (lambda nx: graph_of(nx, weight=1.5), "edge a to b, 'weight': expected a probability between 0 and 1, got 1.5"),
        (lambda nx: graph_of(nx, weight=float("nan")), "edge a to b, 'weight': .* got nan"),
        (lambda nx: graph_of(nx, weight="0.5"), "edge a to b, 'weight': .* got '0.5'"),
        (lambda nx: graph_of(nx, weight=True), "edge a to b, 'weight': .* got True"),
        (lambda nx: graph_of(nx, weight=1, delay=0.5), "edge a to b, 'delay': expected steps or a list of probabilities, got 0.5"),
        (lambda nx: graph_of(nx, weight=1, delay=float("inf")), "edge a to b, 'delay': .* got inf"),
        (lambda nx: nx.DiGraph([(1, "1", {"weight": 1})]), "nodes: expected different names, got '1' twice"),
        (lambda nx: nx.Graph([("a", "a"), ("a", "b")]), "edge a to a: expected two different nodes, got a loop; .*edge a to b, 'weight'"),
    ],
)  # fmt: skip
def test_graphs_that_are_no_networks(nx, make, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.from_networkx(make(nx))


# Stone Soup


@pytest.fixture(scope="module")
def soup():
    return pytest.importorskip("stonesoup")


START = datetime(2024, 1, 1)
IRREGULAR = [1.0, 0.5, 2.25, 0.125, 1.0, 3.5]


def linear_models():
    from stonesoup.models.transition import linear as t

    combined = t.CombinedLinearGaussianTransitionModel
    return {
        "constant velocity": combined([t.ConstantVelocity(0.1), t.ConstantVelocity(0.3)]),
        "mixed": combined([t.ConstantAcceleration(0.05), t.RandomWalk(0.5)]),
        "turn": t.KnownTurnRate([0.1, 0.2], 0.15),
        "turn, sandwich": t.KnownTurnRateSandwich([0.1, 0.2], -0.3, [t.RandomWalk(0.4)]),
        "decay": combined([t.OrnsteinUhlenbeck(0.2, 0.5), t.Singer(0.1, 0.2)]),
        "invariant": t.LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=np.array([[1, 0.3], [0, 0.9]]), covariance_matrix=np.diag([0.1, 0.2])
        ),
    }


def recursion(transition, measurement, x, P, times, kind="Kalman"):
    """Covariances by Stone Soup's own predictor and updater, the innovations 0, from a first estimate at times[0]."""
    from stonesoup.predictor import kalman as predictors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater import kalman as updaters

    predictor = getattr(predictors, f"{kind}Predictor")(transition)
    updater = getattr(updaters, f"{kind}Updater")(measurement)
    state = GaussianState(x, P, timestamp=times[0])
    out = [np.array(state.covar, dtype=float)]
    for time in times[1:]:
        prior = predictor.predict(state, timestamp=time)
        z = Detection(measurement.function(prior, noise=False), timestamp=time, measurement_model=measurement)
        state = updater.update(SingleHypothesis(prior, z))
        out.append(np.array(state.covar, dtype=float))
    return np.array(out)


def stand_alone(tables, P, steps):
    s = sf.scenario(**tables, initial=P, network={"agents": 2, "steps": steps, "link": 0.5})
    return sf.predict(s, [0.5], "general", estimator="stand-alone").covariance[0]


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12 * np.abs(theirs).max())


@pytest.mark.parametrize("name", ["constant velocity", "mixed", "turn", "turn, sandwich", "decay", "invariant"])
@pytest.mark.parametrize("step", [1.0, 0.1, IRREGULAR], ids=str)
def test_linear_models_give_stone_soups_covariances(soup, name, step):
    from stonesoup.models.measurement.linear import LinearGaussian

    model = linear_models()[name]
    d, steps = model.ndim_state, len(IRREGULAR)
    sensor = LinearGaussian(d, [0, d - 1], np.array([[4.0, 0.5], [0.5, 2.0]]))
    P = np.diag(np.arange(1.0, d + 1)) + 0.1
    seconds = np.cumsum(step[1:] if isinstance(step, list) else [step] * (steps - 1)).tolist()
    times = [START, *(START + timedelta(seconds=t) for t in seconds)]
    tables = sf.from_stonesoup(model, sensor, step=step)
    varies = name != "invariant" and isinstance(step, list)
    assert tables["model"]["F"].shape == ((steps, d, d) if varies else (d, d))
    np.testing.assert_array_equal(tables["model"]["H"], sensor.matrix())
    close(stand_alone(tables, P, steps), recursion(model, sensor, np.zeros(d), P, times))


def radar(x=0.0, y=0.0):
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.types.array import StateVector

    return CartesianToBearingRange(
        ndim_state=4, mapping=(0, 2), noise_covar=np.diag([0.02**2, 5.0**2]), translation_offset=StateVector([[x], [y]])
    )


@pytest.mark.parametrize("step", [1.0, IRREGULAR], ids=str)
def test_what_is_not_linear_is_linearised_about_a_state_that_moves(soup, step):
    from stonesoup.models.transition.nonlinear import ConstantTurn
    from stonesoup.types.state import State

    steps, x = len(IRREGULAR), np.array([50.0, 3.0, 80.0, -2.0])
    seconds = np.cumsum(step[1:] if isinstance(step, list) else [step] * (steps - 1)).tolist()
    times = [START, *(START + timedelta(seconds=t) for t in seconds)]
    P = np.diag([25.0, 1.0, 16.0, 2.0])
    cv = linear_models()["constant velocity"]
    for nominal in (x, x[:, None], x.tolist(), State(x), State(x, timestamp=START)):
        tables = sf.from_stonesoup(cv, radar(10, -20), step=step, steps=steps, nominal=nominal)
        assert tables["model"]["H"].shape == (steps, 2, 4)
        close(stand_alone(tables, P, steps), recursion(cv, radar(10, -20), x, P, times, "ExtendedKalman"))
    turn = ConstantTurn(linear_noise_coeffs=[0.1, 0.2], turn_noise_coeff=0.01)
    from stonesoup.models.measurement.linear import LinearGaussian

    x, P = np.array([50.0, 3.0, 80.0, -2.0, 0.1]), np.diag([25.0, 1.0, 16.0, 2.0, 0.01])
    sensor = LinearGaussian(5, [0, 2], np.eye(2) * 4.0)
    tables = sf.from_stonesoup(turn, sensor, step=step, steps=steps, nominal=x)
    close(stand_alone(tables, P, steps), recursion(turn, sensor, x, P, times, "ExtendedKalman"))


def test_a_linearised_bearing_and_range_are_the_textbooks(soup):
    x = np.array([50.0, 3.0, 80.0, -2.0])
    H = sf.from_stonesoup(linear_models()["constant velocity"], radar(10, -20), step=1, steps=1, nominal=x)["model"][
        "H"
    ]
    dx, dy = 40.0, 100.0
    ρ = np.hypot(dx, dy)
    np.testing.assert_allclose(H, [[-dy / ρ**2, 0, dx / ρ**2, 0], [dx / ρ, 0, dy / ρ, 0]], atol=1e-6)


def test_a_path_gives_states_and_times(soup):
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState

    cv, steps = linear_models()["constant velocity"], 5
    times = [START + timedelta(seconds=t) for t in (0, 1, 1.5, 4, 4.25)]
    x = [[10.0 * k, 1.0, 50 - k**2, 0.0] for k in range(steps)]
    path = GroundTruthPath([GroundTruthState(s, timestamp=t) for s, t in zip(x, times, strict=True)])
    tables = sf.from_stonesoup(cv, [radar(), None, radar(5, 5)], nominal=path)
    same = sf.from_stonesoup(
        cv, [radar(), None, radar(5, 5)], nominal=np.array(x), step=[9, 1, 0.5, 2.5, timedelta(seconds=0.25)]
    )
    for key in "FQHR":
        np.testing.assert_array_equal(tables["model"][key], same["model"][key])
    for k in range(1, steps):
        dt = times[k] - times[k - 1]
        np.testing.assert_array_equal(tables["model"]["F"][k], cv.matrix(time_interval=dt))
        np.testing.assert_array_equal(tables["model"]["Q"][k], cv.covar(time_interval=dt))
        np.testing.assert_array_equal(tables["agents"][2]["H"][k], radar(5, 5).jacobian(path[k]))
    assert tables["agents"][1] == {"sensor": False}
    s = sf.scenario(**tables, network={"steps": steps, "link": 0.5}, initial=100 * np.eye(4))
    assert s.network.agents == 3
    assert sf.predict(s).values("trace").shape == (1, steps)


def information(latencies, label=str):
    from stonesoup.architecture import InformationArchitecture
    from stonesoup.architecture.edge import Edge, Edges
    from stonesoup.architecture.node import SensorNode
    from stonesoup.sensor.radar.radar import RadarBearingRange
    from stonesoup.types.array import StateVector

    def sensor(i):
        place = StateVector([[10.0 * i], [-20.0]])
        return RadarBearingRange((0, 2), np.diag([0.01, 1.0]), ndim_state=4, position=place)

    nodes = {name: SensorNode(sensor(i), label=label(name)) for i, name in enumerate("abc")}
    nodes["a"].latency = 0.3
    edges = [Edge((nodes[s], nodes[r]), edge_latency=τ) for (s, r), τ in latencies.items()]
    return InformationArchitecture(edges=Edges(edges), current_time=START)


LATENCIES = {("a", "b"): 0.0, ("b", "a"): 1.0, ("c", "b"): 2.2, ("a", "c"): 0.7, ("b", "c"): 0.0}


def test_an_architecture_is_late_by_the_steps_that_stone_soup_simulates(soup):
    pytest.importorskip("graphviz")
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState

    cv, architecture = linear_models()["constant velocity"], information(LATENCIES)
    tables = sf.from_stonesoup(cv, architecture, step=1.0, steps=6, nominal=[0, 1, 50, 0.5], link=0.5)
    network = tables["network"]
    assert network["nodes"] == ["a", "b", "c"]
    assert network["hears"] == [[2], [1, 3], [1, 2]]
    assert (network["steps"], network["link"]) == (6, 0.5)
    assert [set(agent) for agent in tables["agents"]] == [{"H", "R"}] * 3
    states = [GroundTruthState([k, 1, 50 + k / 2, 0.5], timestamp=START + timedelta(seconds=k)) for k in range(8)]
    simulated = {}
    for k in range(8):
        architecture.measure([GroundTruthPath(states[: k + 1])], noise=False)
        architecture.propagate(time_increment=1)
        for node in architecture.all_nodes:
            for sent, pieces in node.data_held["unfused"].items():
                for piece in pieces:
                    late = k - round((sent - START).total_seconds())
                    simulated.setdefault((node.label, piece.originator.label, sent), late)
    assert len({(receiver, sender) for receiver, sender, _ in simulated}) == len(LATENCIES)
    for (receiver, sender, _), late in simulated.items():
        assert network["delay"]["abc".index(receiver)]["abc".index(sender)] == late
    made = sf.scenario(**tables, initial=np.diag([100.0, 1.0, 100.0, 1.0])).network
    assert made.delay_of(1, 2).index(1.0) == 3  # b from c, 2.2 s


def test_equal_latencies_are_one_delay_that_can_be_predicted(soup):
    pytest.importorskip("graphviz")
    every = {(s, r): 0.0 if s == "a" else 0.3 for s in "abc" for r in "abc" if s != r}
    tables = sf.from_stonesoup(
        linear_models()["constant velocity"], information(every), step=0.25, steps=3, nominal=[0, 1, 50, 0.5], link=0.5
    )
    assert tables["network"]["delay"] == 2
    assert "hears" not in tables["network"]
    s = sf.scenario(**tables, initial=np.eye(4))
    assert s.network.delay == (0.0, 0.0, 1.0)
    labelled = information(every, label=lambda name: f"Sensor\n{name}")
    again = sf.from_stonesoup(linear_models()["constant velocity"], labelled, step=1, steps=3, nominal=[0, 1, 50, 0.5])
    assert again["network"]["nodes"] == ["Sensor a", "Sensor b", "Sensor c"]
    assert again["network"]["delay"] == 1
    assert "link" not in again["network"]


def relayed():
    from stonesoup.architecture import NetworkArchitecture
    from stonesoup.architecture.edge import Edge, Edges
    from stonesoup.architecture.node import FusionNode, RepeaterNode, SensorNode
    from stonesoup.models.measurement.linear import LinearGaussian

    sensor = SimpleNamespace(measurement_model=LinearGaussian(4, [0, 2], np.eye(2)))
    eye = SensorNode(sensor, label="eye", latency=0.5)
    slow, fast = RepeaterNode(label="slow"), RepeaterNode(label="fast", latency=0.25)
    centre = FusionNode(SimpleNamespace(detector=None), label="centre")
    edges = [((eye, slow), 1.0), ((slow, centre), 5.0), ((eye, fast), 0.25), ((fast, centre), 2.0)]
    return NetworkArchitecture(Edges([Edge(nodes, edge_latency=τ) for nodes, τ in edges]), current_time=START)


def test_repeaters_pass_on_along_the_quickest_way_and_fusion_nodes_have_no_sensor(soup):
    pytest.importorskip("graphviz")
    tables = sf.from_stonesoup(linear_models()["constant velocity"], relayed(), step=1.0, steps=4)
    assert tables["network"] == {
        "agents": 2,
        "nodes": ["eye", "centre"],
        "hears": [[], [1]],
        "delay": 3,  # 0.5 + 0.25 + 0.25 + 2.0 s
        "steps": 4,
    }
    assert tables["agents"][1] == {"sensor": False}
    np.testing.assert_array_equal(tables["agents"][0]["H"], [[1, 0, 0, 0], [0, 0, 1, 0]])
    s = sf.scenario(**tables, initial=np.eye(4))
    P = sf.predict(s, [1.0], "general").values("trace", agent=2)[0]
    assert P[3] < P[2]  # what was sent at step 1 comes at step 4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda cv, z: sf.from_stonesoup(5, z, step=1), "transition_model: expected a model of Stone Soup with Gaussian noise, got int"),
        (lambda cv, z: sf.from_stonesoup(cv, [z, 5], step=1), r"measurement_models\[2\]: expected a model of Stone Soup with Gaussian noise, got int"),
        (lambda cv, z: sf.from_stonesoup(cv, cv, step=1), r"measurement_models\[1\]: expected a model of Stone Soup"),
        (lambda cv, z: sf.from_stonesoup(cv.model_list[0], z, step=1), r"measurement_models\[1\]: expected a model of the 2 states of transition_model, got 4"),
        (lambda cv, z: sf.from_stonesoup(cv, [None], step=1), "measurement_models: expected a sensor, got none"),
        (lambda cv, z: sf.from_stonesoup(cv, [], step=1), "measurement_models: expected a sensor, got none"),
        (lambda cv, z: sf.from_stonesoup(cv, z), "step: expected the seconds between steps, or nominal states with time stamps"),
        (lambda cv, z: sf.from_stonesoup(cv, z, step=-1), "step: expected seconds of at least 0, .* got -1"),
        (lambda cv, z: sf.from_stonesoup(cv, z, step="fast"), "step: expected seconds of at least 0, .* got 'fast'"),
        (lambda cv, z: sf.from_stonesoup(cv, z, step=1, steps=0), "steps: expected a whole number of at least 1, got 0"),
        (lambda cv, z: sf.from_stonesoup(cv, z, step=1, link=0.5), "link: expected nothing unless there is an architecture"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1), "nominal: expected what CartesianToBearingRange is linearised about, got nothing"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1, nominal=[1, 2, 3, 4]), "steps: expected how many steps the nominal state is moved on"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1, steps=3, nominal=[1, 2]), r"nominal\[1\]: expected 4 finite numbers, got 1"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1, steps=3, nominal=[[1, 2], [3]]), r"nominal\[1\]: expected 4 finite numbers, got \[1, 2\]"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1, steps=3, nominal="there"), r"nominal\[1\]: expected 4 finite numbers, got 't'"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=1, steps=3, nominal=np.ones((2, 4))), "expected one for all, or one for each of the 3 steps, got fewer"),
        (lambda cv, z: sf.from_stonesoup(cv, radar(), step=[1, 1], steps=3, nominal=np.ones(4)), "expected one for all, or one for each of the 3 steps, got fewer"),
    ],
)  # fmt: skip
def test_models_that_do_not_fit(soup, call, message):
    from stonesoup.models.measurement.linear import LinearGaussian

    with pytest.raises(sf.UsageError, match=message):
        call(linear_models()["constant velocity"], LinearGaussian(4, [0], np.eye(1)))


def test_latencies_need_one_time_between_all_steps(soup):
    pytest.importorskip("graphviz")
    cv, nominal = linear_models()["constant velocity"], [0, 1, 50, 0.5]
    with pytest.raises(sf.UsageError, match=r"step: expected one time between all steps, .* got different ones"):
        sf.from_stonesoup(cv, information(LATENCIES), step=[1, 1, 2], nominal=nominal)
    at_once = information(dict.fromkeys([("a", "b"), ("b", "c"), ("c", "a")], 0.0))
    for node in at_once.all_nodes:
        node.latency = 0.0
    assert "delay" not in sf.from_stonesoup(cv, at_once, step=[1, 1, 2], nominal=nominal)["network"]


def test_a_missing_stone_soup_is_named_with_the_line_that_installs_it(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr("stochfuse.errors.import_module", missing)
    with pytest.raises(sf.StochfuseError, match=r"this needs stonesoup: pip install 'stochfuse\[stonesoup\]'"):
        sf.from_stonesoup(None, None)
