"""Scenarios from what people already have in Python: arrays, links, frames, graphs, Stone Soup's models.

`scenario` takes a scenario file's tables as arguments.  The others translate: `from_networkx` a graph into [network],
`from_stonesoup` models into [model] and [[agent]], and an architecture into [network] too.  They return mappings with a
file's keys, which can be read, changed and written; every check is the scenario's own.

Stone Soup (read in version 1.9) counts time in microseconds: intervals are rounded to them, as its predictors do.  Its
F, Q, H and R are asked for, never worked out here, and what is not linear is linearised by its own `jacobian` (finite
differences for most models), so that covariances equal those of its predictors and updaters:

    F_k = ∂f/∂x at x*(k−1), over the time from k−1 to k          H_k = ∂h/∂x at x*(k)

with the nominal states x* as they are given, or moved on by the transition model without noise.  Of an architecture a
node is an agent and an edge a link; a message that takes τ is fused ⌈τ/T⌉ steps after it was sent (it is too late for
the fusion at its own step unless τ = 0).  τ is the latency of the edge and of the node that sends; through repeaters it
adds up along the quickest way (`inherit_edges` of 1.9.1 counts the way to the repeater twice, and the simulation of
`NetworkArchitecture` only the last edge).  Departures: sensor nodes send the estimates of filters of their own, where
Stone Soup's send detections; edges there never lose a message, so that the link probability is to be given.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np

from stochfuse.errors import Problem, ScenarioError, UsageError, needed
from stochfuse.kalman.checks import shown
from stochfuse.scenario.links import Links, as_network, links_of_table
from stochfuse.scenario.scenario import Scenario, all_names, as_file

Edge = tuple[int, int]
"""Receiver and sender, from 0."""


def scenario(
    model: Mapping[str, Any] | None = None,
    agents: int | Sequence[Mapping[str, Any]] | None = None,
    network: Mapping[str, Any] | None = None,
    initial: Any = None,
    *,
    name: str = "scenario",
    **tables: Any,
) -> Scenario:
    """Make a scenario of arrays and numbers.

    Parameters
    ----------
    model : keys of [model]: F (d, d), H (p, d), Q (d, d), R (p, p), each also one per step; states, units, …
    agents : their number; or a mapping for each of them, the keys of an [[agent]].
    network : keys of [network]: agents (default: as many as `agents` or the links say), steps, link, ….  `link` may
        also be what `stochfuse.links` returns, or a frame that it takes: names become `nodes`, and who is not known to
        hear another does not hear it (`hears`).
    initial : keys of [initial]; or P alone, (d, d) or a number.
    name : what messages and titles call it.
    **tables : the other tables of a scenario file.

    Raises
    ------
    ScenarioError
        Naming every offending key, what was expected there and what came.

    Examples
    --------
    >>> import numpy as np
    >>> import stochfuse as sf
    >>> model = {"F": np.array([[1, 1], [0, 1]]), "H": [[1, 0]], "Q": 0.1 * np.eye(2), "R": 4}
    >>> link = np.array([[0, 0.9, 0.5], [0.9, 0, 0.2], [0.5, 0.2, 0]])     # receiver, sender
    >>> s = sf.scenario(model, network={"steps": 10, "link": link}, agents=3, initial=9 * np.eye(2))
    >>> float(sf.predict(s).values()[0, -1].round(3))
    1.379
    """
    given = dict(tables)
    if isinstance(agents, Sequence) and not isinstance(agents, str):
        if "agent" in given:
            raise ScenarioError(name, [Problem("agent", "nothing beside a list of agents", "a list")])
        given["agent"], agents = list(agents), len(agents)
    given["network"] = _network(network, agents, all_names(given.get("agent")), name)
    if model is not None:
        given["model"] = model
    if initial is not None:
        given["initial"] = initial if isinstance(initial, Mapping) else {"P": initial}
    return Scenario.from_mapping(given, name)


def _network(network: Any, agents: Any, nodes: Sequence[str] | None, name: str) -> Any:
    """[network] with the number of agents, and with links that are known as numbers."""
    if network is not None and not isinstance(network, Mapping):
        return network
    found = dict(network or {})
    if agents is not None and found.setdefault("agents", agents) != agents:
        raise ScenarioError(name, [Problem("network.agents", f"{agents}, as many as agents", str(found["agents"]))])
    link = found.get("link")
    if hasattr(link, "columns") or hasattr(link, "column_names"):
        link = links_of_table(link)
    if not isinstance(link, Links):
        return found
    if nodes is not None:
        found.setdefault("nodes", nodes)
    return as_network(link, as_file(found, name), name, silent=found.get("architecture", "ad-hoc") == "ad-hoc")


def from_networkx(
    graph: Any, link: str = "weight", *, default: float | None = None, delay: str = "delay", **network: Any
) -> dict[str, Any]:
    """Return the [network] of a graph: nodes are agents, edges lead from sender to receiver.

    Parameters
    ----------
    graph : a networkx `DiGraph`, or a `Graph`, whose edges carry messages both ways.  Attributes of nodes may be the
        agents' keys: `agents=[dict(graph.nodes[n]) for n in graph]`.
    link : attribute of edges that is the link probability.
    default : probability of edges without it.
    delay : attribute of edges that is the delay in steps, or the probabilities of 0, 1, … steps; where an edge has
        none, messages come at once.
    **network : further keys of [network], such as steps.

    Raises
    ------
    UsageError
        If it is no such graph, naming every offending node and edge.

    Examples
    --------
    >>> import stochfuse as sf
    >>> import networkx as nx
    >>> G = nx.DiGraph()
    >>> G.add_weighted_edges_from([("uav", "base", 0.9), ("car", "base", 0.6), ("base", "car", 0.8)])
    >>> network = sf.from_networkx(G, steps=5)
    >>> network["nodes"], network["hears"]
    (['uav', 'base', 'car'], [[], [1, 3], [2]])
    >>> s = sf.scenario(model={"F": 1, "H": 1, "Q": 25, "R": 100}, network=network, initial=100)
    >>> sf.predict(s).values(agent="worst").round(1)
    array([[100. ,  55.6,  44.6,  41. ,  39.8]])
    """
    if not (hasattr(graph, "is_multigraph") and hasattr(graph, "edges")):
        raise UsageError(f"graph: expected a networkx Graph or DiGraph, got {type(graph).__name__}")
    problems = []
    if graph.is_multigraph():
        problems.append(f"graph: expected at most one edge each way, got a {type(graph).__name__}")
    if not len(graph):
        problems.append("graph: expected nodes, got none")
    place = {node: i for i, node in enumerate(graph)}
    chances: dict[Edge, float] = {}
    delays: dict[Edge, Any] = {}
    for sender, receiver, data in graph.edges(data=True):
        edge, µ = f"edge {sender} to {receiver}", data.get(link, default)
        late = np.array(data.get(delay, 0)).tolist()
        if sender == receiver:
            problems.append(f"{edge}: expected two different nodes, got a loop")
        if not _is_probability(µ):
            got = "nothing" if µ is None else repr(µ)
            problems.append(f"{edge}, '{link}': expected a probability between 0 and 1, got {got}")
            continue
        if not (isinstance(late, list) or _is_count(late)):
            problems.append(f"{edge}, '{delay}': expected steps or a list of probabilities, got {late!r}")
        ends = [(place[receiver], place[sender])]
        for end in ends if graph.is_directed() else [*ends, ends[0][::-1]]:
            chances[end], delays[end] = µ, late
    if problems:
        raise UsageError("; ".join(problems))
    return {**_links_of_edges([str(node) for node in graph], delays, chances), **network}


def _is_probability(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and 0 <= float(value) <= 1


def _is_count(value: Any) -> bool:
    return isinstance(value, Real) and float(value).is_integer() and float(value) >= 0


def _links_of_edges(
    nodes: list[str], delays: Mapping[Edge, Any], chances: Mapping[Edge, float] | None = None
) -> dict[str, Any]:
    """[network] of edges: who hears whom where not everybody hears everybody, how likely and how late."""
    n = len(nodes)
    if len(set(nodes)) < n:
        twice = next(node for node in nodes if nodes.count(node) > 1)
        raise UsageError(f"nodes: expected different names, got '{twice}' twice")
    found: dict[str, Any] = {"agents": n, "nodes": nodes}
    if chances is not None:
        found["link"] = [[float(chances.get((i, j), 0.0)) for j in range(n)] for i in range(n)]
    if len(delays) < n * (n - 1):
        found["hears"] = [[j + 1 for j in range(n) if (i, j) in delays] for i in range(n)]
    late = list(delays.values())
    if any(other != late[0] for other in late):
        found["delay"] = [[delays.get((i, j), 0) for j in range(n)] for i in range(n)]
    elif late and late[0] != 0:
        found["delay"] = late[0]
    return found


def from_stonesoup(
    transition_model: Any,
    measurement_models: Any,
    *,
    step: Any = None,
    steps: int | None = None,
    nominal: Any = None,
    **network: Any,
) -> dict[str, Any]:
    """Return tables of a scenario, arguments of `stochfuse.scenario`, from Stone Soup's models.

    Parameters
    ----------
    transition_model : how the state moves, linear or not, with Gaussian noise.
    measurement_models : one model, which all agents have; or one for each agent, None for an agent that measures
        nothing; sensors will do.  Or an architecture, whose nodes with a sensor measure by its model.
    step : time from step to step, in seconds or a `timedelta`; or one per step, the time since the step before (the
        first is not used).  Default: that between the time stamps of the nominal states.
    steps : number of steps; default: as many as `step` or `nominal` has.
    nominal : states that models which are not linear are linearised about: one per step (such as a `GroundTruthPath`),
        or one, of step 1, which the transition model moves on; states of Stone Soup or (d,) arrays.
    **network : of an architecture, further keys of [network], such as link.

    Returns
    -------
    dict
        "model" with F, Q, H and R, (d, d) or (steps, d, d) where they change; for several sensors "agents", a mapping
        each; for an architecture "network", who hears whom and how late.

    Raises
    ------
    UsageError
        If models are none, do not fit each other, or need a nominal state.
    StochfuseError
        If Stone Soup is not installed.

    Examples
    --------
    >>> import stochfuse as sf
    >>> from stonesoup.models.measurement.linear import LinearGaussian
    >>> from stonesoup.models.transition.linear import ConstantVelocity
    >>> position = LinearGaussian(ndim_state=2, mapping=[0], noise_covar=[[4.0]])
    >>> tables = sf.from_stonesoup(ConstantVelocity(0.1), position, step=1.0)
    >>> tables["model"]["F"].tolist()
    [[1.0, 1.0], [0.0, 1.0]]
    >>> s = sf.scenario(**tables, network={"agents": 3, "steps": 5, "link": 0.5}, initial=[[9, 0], [0, 1]])
    >>> float(sf.predict(s).values("var:x1")[0, -1].round(4))
    1.1787
    """
    needed("stonesoup", "stonesoup")
    d = _dimension("transition_model", transition_model, "ndim_state")
    architecture = measurement_models if hasattr(measurement_models, "di_graph") else None
    if network and architecture is None:
        raise UsageError(f"{next(iter(network))}: expected nothing unless there is an architecture")
    nodes = [] if architecture is None else list(_information(architecture).di_graph.nodes)
    sensors = measurement_models if architecture is None else [getattr(node, "sensor", None) for node in nodes]
    several = isinstance(sensors, Sequence)
    each = [_measurement(f"measurement_models[{i}]", s, d) for i, s in enumerate(sensors if several else [sensors], 1)]
    dt, path = _course(transition_model, each, step, steps, nominal)
    F, Q = _transition(transition_model, path, dt)
    seen = [None if model is None else _sensor(model, path) for model in each]
    measured = [sensor for sensor in seen if sensor is not None]
    if not measured:
        raise UsageError("measurement_models: expected a sensor, got none")
    tables: dict[str, Any] = {"model": {"F": F, "Q": Q, **measured[0]}}
    if several:
        tables["agents"] = [{"sensor": False} if sensor is None else sensor for sensor in seen]
    if architecture is not None:
        tables["network"] = {**_network_of_nodes(architecture, nodes, dt), **network}
        if steps is not None:
            tables["network"]["steps"] = steps
    return tables


def _dimension(name: str, model: Any, of: str) -> int:
    if not (hasattr(model, "covar") and hasattr(model, "jacobian") and hasattr(model, of)):
        raise UsageError(f"{name}: expected a model of Stone Soup with Gaussian noise, got {type(model).__name__}")
    return int(getattr(model, of))


def _measurement(name: str, sensor: Any, d: int) -> Any:
    """A measurement model, that of a sensor, or None for none."""
    if sensor is None:
        return None
    model = getattr(sensor, "measurement_model", sensor)
    _dimension(name, model, "ndim_meas")
    if model.ndim_state != d:
        raise UsageError(
            f"{name}: expected a model of the {d} states of transition_model, got {model.ndim_state} states"
        )
    return model


def _linear(model: Any) -> bool:
    return model is None or isinstance(model, needed("stonesoup.models.base", "stonesoup").LinearModel)


def _nominal(nominal: Any, d: int) -> tuple[list[np.ndarray], list[Any]]:
    """Nominal states as columns, and their time stamps if all have one; none where nothing is given."""
    if nominal is None:
        return [], []
    if isinstance(nominal, Sequence) and any(hasattr(state, "state_vector") for state in nominal):
        states = list(nominal)
    elif hasattr(nominal, "state_vector") or _shape(nominal) in ((d,), (d, 1)):
        states = [nominal]
    else:
        states = list(nominal) if isinstance(nominal, Iterable) else [nominal]
    vectors = []
    for k, state in enumerate(states, start=1):
        given = getattr(state, "state_vector", state)
        try:
            vector = np.array(given, dtype=float).reshape(-1, 1)
        except (TypeError, ValueError):
            vector = np.array([[np.nan]])
        if len(vector) != d or not np.isfinite(vector).all():
            raise UsageError(f"nominal[{k}]: expected {d} finite numbers, got {shown(given)}")
        vectors.append(vector)
    stamps = [getattr(state, "timestamp", None) for state in states]
    return vectors, [] if None in stamps else stamps


def _shape(value: Any) -> tuple[int, ...]:
    try:
        return np.shape(value)
    except ValueError:  # rows of different length
        return ()


def _course(
    transition: Any, models: Sequence[Any], step: Any, steps: int | None, nominal: Any
) -> tuple[np.ndarray | None, list[np.ndarray]]:
    """Seconds from step to step, and the nominal states of all steps where there are models that need them."""
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise UsageError(f"steps: expected a whole number of at least 1, got {steps!r}")
    path, stamps = _nominal(nominal, transition.ndim_state)
    dt = _intervals(step, stamps, transition)
    if not path or all(map(_linear, (transition, *models))):
        return dt, []
    per_step = [len(path)] if len(path) > 1 else [] if dt is None or not dt.ndim else [len(dt)]
    count = steps or max(per_step, default=0)
    if not count:
        raise UsageError("steps: expected how many steps the nominal state is moved on, got nothing")
    if any(given < count for given in ([len(dt)] if dt is not None and dt.ndim else []) + per_step):
        raise UsageError(f"step and nominal: expected one for all, or one for each of the {count} steps, got fewer")
    while len(path) < count:
        moved = transition.function(_state(path[-1]), noise=False, time_interval=_interval(dt, len(path)))
        path.append(np.array(moved, dtype=float))
    return dt, path


def _intervals(step: Any, stamps: Sequence[Any], transition_model: Any) -> np.ndarray | None:
    """Seconds from step to step, () or (steps,); None where the model does not depend on time."""
    if step is None and len(stamps) > 1:
        step = [stamps[1] - stamps[0], *(after - before for before, after in pairwise(stamps))]
    if step is None:
        if isinstance(transition_model, needed("stonesoup.models.base", "stonesoup").TimeInvariantModel):
            return None
        raise UsageError("step: expected the seconds between steps, or nominal states with time stamps, got neither")
    try:
        dt = np.array([_seconds(each) for each in step] if isinstance(step, Iterable) else _seconds(step), dtype=float)
    except (TypeError, ValueError):
        dt = np.array(np.nan)
    if dt.ndim > 1 or not dt.size or not np.isfinite(dt).all() or (dt < 0).any():
        raise UsageError(f"step: expected seconds of at least 0, or one such number per step, got {shown(step)}")
    return dt


def _seconds(step: Any) -> Any:
    return step.total_seconds() if isinstance(step, timedelta) else step


def _interval(dt: np.ndarray | None, k: int) -> timedelta | None:
    """The time that ends with step k, counted from 0."""
    return None if dt is None else timedelta(seconds=float(dt if dt.ndim == 0 else dt[k]))


def _state(x: np.ndarray) -> Any:
    # a copy, since some models write into the state that they are given
    return needed("stonesoup.types.state", "stonesoup").State(x.copy())


def _jacobian(model: Any, path: Sequence[np.ndarray], k: int, **time: Any) -> np.ndarray:
    """What a linear model multiplies by, or the derivative of another at the nominal state of step k, from 0."""
    if _linear(model):
        return np.array(model.matrix(**time), dtype=float)
    if not path:
        raise UsageError(f"nominal: expected what {type(model).__name__} is linearised about, got nothing")
    return np.array(model.jacobian(_state(path[k]), **time), dtype=float)


def _transition(model: Any, path: Sequence[np.ndarray], dt: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """F and Q, of every step where they differ; those of step 1, which are not used, are step 2's."""
    count = len(path) if not _linear(model) else dt.size if dt is not None and dt.ndim else 1
    ends = [max(k, min(1, count - 1)) for k in range(max(count, 1))]
    times = [{"time_interval": _interval(dt, k)} for k in ends]
    F = [_jacobian(model, path, max(k - 1, 0), **time) for k, time in zip(ends, times, strict=True)]
    return _once(F), _once([np.array(model.covar(**time), dtype=float) for time in times])


def _sensor(model: Any, path: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """H and R, H of every step where it differs."""
    H = [_jacobian(model, path, k) for k in range(1 if _linear(model) else max(len(path), 1))]
    return {"H": _once(H), "R": np.array(model.covar(), dtype=float)}


def _once(stack: Sequence[np.ndarray]) -> np.ndarray:
    """Matrices of every step, or the one that all of them are."""
    array = np.stack(stack)
    return array[0] if (array == array[0]).all() else array


def _information(architecture: Any) -> Any:
    """Who hears whom: the architecture, or that of the information in one of a network."""
    return getattr(architecture, "information_arch", None) or architecture


def _network_of_nodes(architecture: Any, nodes: Sequence[Any], dt: np.ndarray | None) -> dict[str, Any]:
    """[network] of an architecture: who hears whom, and how late."""
    late = {edge: _steps_late(τ, dt) for edge, τ in _latencies(architecture, nodes).items()}
    return _links_of_edges([" ".join(node.label.split()) for node in nodes], late)


def _latencies(architecture: Any, nodes: Sequence[Any]) -> dict[Edge, float]:
    """Seconds that a message takes, of every (receiver, sender)."""
    place, whole = {id(node): i for i, node in enumerate(nodes)}, _information(architecture)
    nx = needed("networkx", "stonesoup")
    ways = nx.DiGraph()
    for edge in architecture.edges:
        known = ways.get_edge_data(*edge.nodes, {"τ": np.inf})["τ"]
        ways.add_edge(*edge.nodes, τ=min(known, edge.ovr_latency))
    relays = [node for node in ways if id(node) not in place]
    found = {}
    for sender, receiver in whole.edges.edge_list:
        between = ways.subgraph([sender, receiver, *relays])
        try:
            τ = nx.shortest_path_length(between, sender, receiver, weight="τ")
        except nx.NetworkXException:
            names = f"{sender.label!r} to {receiver.label!r}"
            raise UsageError(f"architecture: expected a way from {names} through repeaters, got none") from None
        found[place[id(receiver)], place[id(sender)]] = float(τ)
    return found


def _steps_late(τ: float, dt: np.ndarray | None) -> int:
    """Steps after which a message is fused that takes τ seconds."""
    if τ == 0:
        return 0
    if dt is None or (dt.ndim and (dt[1:] != dt[-1]).any()) or dt.flat[-1] <= 0:
        got = "nothing" if dt is None else "different ones"
        raise UsageError(f"step: expected one time between all steps, to count latencies in steps, got {got}")
    # a latency of n steps is n steps, in spite of rounding
    return int(np.ceil(τ / dt.flat[-1] - 1e-9))
