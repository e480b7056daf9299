"""[model], [network], [[agent]] and [noise] of a scenario file, read and checked.

What fits together becomes a model, a network, sensors, filters of agents' own, and noises that hang together.  Models
and sensors by name, [network.radio] and [cooperative] are read in files of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from stochfuse.kalman.checks import shown
from stochfuse.scenario.checker import Checker, table_of
from stochfuse.scenario.model import Filter, Model, NoiseCorrelation, Sensor
from stochfuse.scenario.motion import KEYS, read_motion, read_step
from stochfuse.scenario.network import ARCHITECTURES, Network, mean_delivery, possible_senders
from stochfuse.scenario.radio import links_between, read_places, read_radio
from stochfuse.scenario.sensing import is_named, sometimes

MOST_DELAY = 10_000
"""Largest delay of a message, in steps."""


Tables = Sequence[Mapping[str, Any]]
"""The [[agent]] tables; none where there are none."""


def read_network(check: Checker, table: Mapping[str, Any], agent_tables: Tables = ()) -> Network | None:
    """Read [network], names and places from [[agent]]; None where something essential is wrong, which is noted."""
    agents = check.integer("network.agents", table.get("agents"), 1)
    steps = check.integer("network.steps", table.get("steps"), 1)
    architecture = check.choice("network.architecture", table.get("architecture", "ad-hoc"), ARCHITECTURES)
    if agents is None or steps is None or architecture is None:
        if isinstance(table.get("link"), int | float):
            check.link("network.link", table["link"], 1, 1)
        return None
    hears = _hears(check, table.get("hears"), agents, architecture)
    counts = _counts(check, table, agents)
    given = table.get("link")
    if counts is not None and given is None:
        given = _ratios(check, *counts, hears)
    link = read_link(check, "network.link", given, agents, steps, architecture)
    radio = read_radio(check, table.get("radio"))
    places = read_places(check, agent_tables, agents, steps, needed=table.get("radio") is not None)
    if table.get("radio") is not None and table.get("link") is not None:
        check.note("network.radio", "either a link probability or a radio", "both")
    elif radio is not None and places:
        link = links_between(radio, places)
        _check_broadcast(check, "network.radio", link, agents, architecture)
    scale = _scale(check, table)
    burst = _scaled_burst(_burst(check, "network", table), scale)
    link = _scaled(link, scale) if burst is None else mean_delivery(burst)

    def read(path: str, given: Any) -> np.ndarray | None:
        return _scaled(read_link(check, path, given, agents, steps, architecture), scale)

    cases, bursts = _cases(check, table, link, burst, scale, read)
    delay, delays = _delays(check, table.get("delay"), agents, architecture)
    if hears is not None and any(b is not None for b in (burst, *bursts)):
        check.note("network.hears", "links without memory (no burst)", "a burst")
    names = _agent_names(check, table.get("nodes"), agent_tables, agents)
    return Network(
        agents=agents,
        steps=steps,
        architecture=architecture,
        link=link,
        cases=cases,
        delay=delay,
        burst=burst,
        case_bursts=bursts,
        hears=hears,
        names=names,
        places=places,
        radio=radio,
        delays=delays,
        counts=counts,
        scale=1.0 if scale is None else scale,
    )


def _cases(
    check: Checker,
    table: Mapping[str, Any],
    link: np.ndarray | None,
    burst: np.ndarray | None,
    scale: float | None,
    read: Callable[[str, Any], np.ndarray | None],
) -> tuple[tuple[tuple[str, np.ndarray], ...], tuple[np.ndarray | None, ...]]:
    """Read the alternatives, by name, and their bursts: what one does not say is as in the network."""
    cases: list[tuple[str, np.ndarray]] = []
    bursts: list[np.ndarray | None] = []
    given = table.get("case")
    for i, case in enumerate(given if isinstance(given, list) else [], start=1):
        if not isinstance(case, Mapping):
            continue
        path = f"network.case[{i}]"
        own, bursty = link, burst
        if case.get("link") is not None:
            own, bursty = read(f"{path}.link", case["link"]), None
        if case.get("burst") is not None:
            bursty = _scaled_burst(_burst(check, path, case), scale)
            own = own if bursty is None else mean_delivery(bursty)
        given_name = case.get("name", i)
        name = given_name if isinstance(given_name, str) else str(i)
        check.name(f"{path}.name", name)
        if name in [other for other, _ in cases]:
            check.note(f"{path}.name", "a name of its own", shown(name))
        if own is None and all(where is None for where in (case.get("link"), case.get("burst"), table.get("radio"))):
            check.note(f"{path}.link", "a link probability here or in network.link", "nothing")
        elif own is not None:
            cases.append((name, own))
            bursts.append(bursty)
    return tuple(cases), tuple(bursts)


def _scale(check: Checker, table: Mapping[str, Any]) -> float | None:
    """Read network.scale, the factor on every link probability that the scenario names."""
    given = table.get("scale")
    if given is None:
        return None
    if all(table.get(key) is None for key in ("link", "radio", "sent", "burst", "case")):
        check.note("network.scale", "link probabilities in the scenario that it scales", "none")
    expected = "a finite number of at least 0"
    return check.number("network.scale", given, expected, lambda scale: scale >= 0)


def _scaled(link: np.ndarray | None, scale: float | None) -> np.ndarray | None:
    return link if link is None or scale is None else np.minimum(1.0, scale * link)


def _scaled_burst(burst: np.ndarray | None, scale: float | None) -> np.ndarray | None:
    """Return a bursty link whose deliveries, in good and in bad, are scaled."""
    if burst is None or scale is None:
        return burst
    return np.concatenate([burst[:2], np.minimum(1.0, scale * burst[2:])])


def _counts(check: Checker, table: Mapping[str, Any], agents: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Read numbers of packets sent and received, (agents, agents) each."""
    if table.get("sent") is None and table.get("received") is None:
        return None
    found, expected = [], f"a {agents}×{agents} matrix of whole numbers of packets"
    for key in ("sent", "received"):
        array = check.array(f"network.{key}", table.get(key), expected) if table.get(key) is not None else None
        if array is not None and array.ndim == 0 and key == "sent":
            array = array * (1.0 - np.eye(agents))
        if array is None or array.shape != (agents, agents) or (array < 0).any() or (array != np.rint(array)).any():
            check.note(f"network.{key}", expected, "nothing" if table.get(key) is None else shown(table[key]))
        else:
            found.append(array)
    if len(found) < 2:
        return None
    sent, received = found
    if (received > sent).any():
        i, j = np.argwhere(received > sent)[0].tolist()
        check.note(
            "network.received", f"at most what was sent, {sent[i, j]:g}", f"{received[i, j]:g} ({i + 1}, {j + 1})"
        )
        return None
    others = ("burst", "radio") if _are_ratios(table.get("link"), sent, received) else ("link", "burst", "radio")
    for key in others:
        if table.get(key) is not None:
            check.note(f"network.{key}", "either numbers of packets (network.sent, network.received) or this", "both")
    return sent, received


def _are_ratios(link: Any, sent: np.ndarray, received: np.ndarray) -> bool:
    """Whether link probabilities say no more than the numbers of packets, as those of a log do."""
    try:
        given = np.array(link, dtype=float)
    except (TypeError, ValueError):
        return True  # which is noted where links are read
    return given.shape == sent.shape and np.allclose(np.where(sent > 0, given, 0.0) * sent, received)


def _ratios(check: Checker, sent: np.ndarray, received: np.ndarray, hears: np.ndarray | None) -> list[list[float]]:
    unknown = np.argwhere((sent == 0) & (~np.eye(len(sent), dtype=bool) if hears is None else hears))
    if len(unknown):
        i, j = unknown[0].tolist()
        check.note(f"network.sent[{i + 1}][{j + 1}]", "packets, or network.hears without this link", "0")
    return np.divide(received, sent, out=np.zeros_like(sent), where=sent > 0).tolist()


def _agent_names(check: Checker, nodes: Any, tables: Tables, agents: int) -> tuple[str, ...]:
    """Names of the agents from network.nodes and [[agent]], which must not differ; empty where there are none."""
    own = {i: table["name"] for i, table in enumerate(tables, start=1) if isinstance(table.get("name"), str)}
    if not isinstance(nodes, list):
        named = [(f"agent[{i}].name", own.get(i, str(i))) for i in range(1, agents + 1)] if own else []
    elif len(nodes) != agents:
        check.note("network.nodes", f"{agents} names, one for each agent", str(len(nodes)))
        return ()
    else:
        named = [(f"network.nodes[{i}]", str(node)) for i, node in enumerate(nodes, start=1)]
        for i, name in own.items():
            if i <= agents and name != nodes[i - 1]:
                check.note(f"agent[{i}].name", f"'{nodes[i - 1]}' as in network.nodes, or nothing", shown(name))
    seen: set[str] = set()
    for path, name in named:
        check.name(path, name)
        if not name.strip() or name in seen:
            check.note(path, "a name of its own" if name.strip() else "a name, not empty", shown(name))
        seen.add(name)
    return tuple(name for _, name in named)


def _hears(check: Checker, value: Any, agents: int, architecture: str) -> np.ndarray | None:
    if not isinstance(value, list):
        return None
    if architecture != "ad-hoc":
        check.note("network.hears", 'nothing unless network.architecture is "ad-hoc"', f'"{architecture}"')
    if len(value) != agents:
        check.note("network.hears", f"one list for each of the {agents} agents", f"{len(value)}")
        return None
    hears = np.zeros((agents, agents), dtype=bool)
    for i, others in enumerate(value):
        others = others if isinstance(others, list) else []
        known = [j for j in others if isinstance(j, int) and 1 <= j <= agents and j != i + 1]
        if len(set(known)) < len(others):
            check.note(f"network.hears[{i + 1}]", f"other agents from 1 to {agents}, each once", shown(others))
        hears[i, [j - 1 for j in known]] = True
    return hears


def _burst(check: Checker, path: str, table: Mapping[str, Any]) -> np.ndarray | None:
    given = table.get("burst")
    if not isinstance(given, dict):
        return None
    path = f"{path}.burst"
    if table.get("link") is not None or table.get("radio") is not None:
        what = "a link probability" if table.get("link") is not None else "a radio"
        check.note(path, f"either {what} or a burst", "both")
    keys = {"good_to_bad": None, "bad_to_good": None, "good": 1.0, "bad": 0.0}
    values = []
    for key, default in keys.items():
        value = given.get(key, default)
        if value is None:
            check.note(f"{path}.{key}", "a probability", "nothing")
            continue
        number = check.number(f"{path}.{key}", value, "a probability", lambda p: 0 <= p <= 1)
        values += [] if number is None else [number]
    if len(values) < len(keys):
        return None
    if values[0] + values[1] == 0:
        check.note(path, "good_to_bad or bad_to_good above 0, so that the share of good steps is known", "0 for both")
        return None
    return np.array(values)


def read_link(check: Checker, path: str, value: Any, agents: int, steps: int, architecture: str) -> np.ndarray | None:
    """Read link probabilities of shape (), (n, n), (steps,) or (steps, n, n)."""
    link = check.link(path, value, agents, steps)
    _check_broadcast(check, path, link, agents, architecture)
    return link


def _check_broadcast(check: Checker, path: str, link: np.ndarray | None, agents: int, architecture: str) -> None:
    if link is not None and link.ndim >= 2 and architecture == "broadcast":
        others = np.where(np.eye(agents, dtype=bool), np.nan, link)
        with np.errstate(invalid="ignore"):
            uneven = agents > 2 and (np.nanmax(others, axis=-2) != np.nanmin(others, axis=-2)).any()
        if uneven:
            expected = "equal probabilities in each column (a broadcast is heard by all or by none)"
            if path == "network.radio":
                expected += ', or network.architecture "ad-hoc"'
            check.note(path, expected, "unequal ones")


Delay = tuple[float, ...]


def _delays(
    check: Checker, value: Any, agents: int, architecture: str
) -> tuple[Delay, tuple[tuple[Delay, ...], ...] | None]:
    """Read network.delay: what all links have in common, or (mean, by receiver and sender) where they differ."""
    if not (isinstance(value, list) and any(isinstance(row, list) for row in value)):
        return _delay(check, "network.delay", value), None
    if len(value) != agents or any(not isinstance(row, list) or len(row) != agents for row in value):
        expected = f"a number of steps, probabilities of 0, 1, 2 … steps, or a {agents}×{agents} matrix of either"
        check.note("network.delay", expected, shown(value))
        return (1.0,), None
    found = [
        [(1.0,) if i == j else _delay(check, f"network.delay[{i + 1}][{j + 1}]", cell) for j, cell in enumerate(row)]
        for i, row in enumerate(value)
    ]
    longest = max(len(delay) for row in found for delay in row)
    padded = [[delay + (0.0,) * (longest - len(delay)) for delay in row] for row in found]
    there = [(i, int(j)) for i, senders in enumerate(possible_senders(architecture, agents)) for j in senders]
    different = {padded[i][j] for i, j in there}
    if len(different) <= 1:
        return found[there[0][0]][there[0][1]] if there else (1.0,), None
    if architecture == "broadcast":
        uneven = [j for j in range(agents) if len({padded[i][j] for i in range(agents) if i != j}) > 1]
        if uneven:
            expected = "equal delays in each column (a broadcast is heard by all at once)"
            check.note("network.delay", expected, f"unequal ones in column {uneven[0] + 1}")
    mean = tuple(np.mean([padded[i][j] for i, j in there], axis=0).tolist())
    return mean, tuple(map(tuple, padded))


def _delay(check: Checker, path: str, value: Any) -> Delay:
    array = check.array(path, value, "a number of steps or a list of probabilities")
    if array is None:
        return (1.0,)
    if array.ndim == 0:
        if array < 0 or array != int(array):
            check.note(path, "a whole number of steps, or the probabilities of 0, 1, 2 … steps", shown(value))
            return (1.0,)
        if array > MOST_DELAY:
            check.note(path, f"at most {MOST_DELAY} steps", shown(value))
            return (1.0,)
        return (0.0,) * int(array) + (1.0,)
    if array.ndim != 1 or not array.size or (array < 0).any() or abs(array.sum() - 1) > 1e-9:
        check.note(path, "probabilities of 0, 1, 2 … steps that sum to 1", shown(value))
        return (1.0,)
    return tuple(array.tolist())


def read_model(check: Checker, table: Mapping[str, Any], steps: int) -> tuple[Model | None, Sensor | None]:
    """Read [model]: the model, and the sensor of agents that have no other."""
    motion = None
    if table.get("kind") is not None:
        motion = read_motion(check, table, steps)
        F, Q = (None, None) if motion is None else (motion.F, motion.Q)
    else:
        F, Q = _matrices(check, table, steps)
    d = None if F is None else F.shape[-1]
    B = check.matrix("model.B", table.get("B"), d, None, steps)
    u = check.vector("model.u", table.get("u"), None if B is None else B.shape[-1], steps)
    if table.get("u") is not None and table.get("B") is None:
        check.note("model.B", "an input matrix, since model.u is given", "nothing")
    states = _names(check, "model.states", table.get("states"), d)
    units = _names(check, "model.units", table.get("units"), d)
    default = _sensor(check, "model", table, d, steps, None)
    if F is None or Q is None or d is None:
        return None, default
    model = Model(
        F=F,
        Q=Q,
        Bu=np.zeros((d, 1)) if B is None or u is None else B @ u,
        states=states or (motion.states if motion else tuple("x" if d == 1 else f"x{i}" for i in range(1, d + 1))),
        units=units or (motion.units if motion else ("",) * d),
    )
    return model, default


def _matrices(check: Checker, table: Mapping[str, Any], steps: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """F, and Q as it enters the state, of a model that is written out."""
    check.absent("model", table, KEYS, "nothing without model.kind")
    read_step(check, table, steps)
    F = check.matrix("model.F", table.get("F"), None, None, steps)
    if F is not None and F.shape[-1] != F.shape[-2]:
        check.note("model.F", "a square matrix", f"a {F.shape[-2]}×{F.shape[-1]} matrix")
        F = None
    d = None if F is None else F.shape[-1]
    G = check.matrix("model.G", table.get("G"), d, None, steps, identity=True)
    noises = G.shape[-1] if G is not None else None if table.get("G") is not None else d
    Q = check.covariance("model.Q", table.get("Q"), noises, steps)
    return F, Q if G is None or Q is None else G @ Q @ np.swapaxes(G, -1, -2)


def _names(check: Checker, path: str, value: Any, d: int | None) -> tuple[str, ...] | None:
    if not isinstance(value, list) or d is None or not all(isinstance(name, str) for name in value):
        return None
    if len(value) != d:
        check.note(path, f"{d} names, one per state", f"{len(value)}")
        return None
    if path.endswith("states") and len(set(value)) < d:
        check.note(path, "different names", shown(value))
    for i, name in enumerate(value, start=1):
        check.name(f"{path}[{i}]", str(name), of_state=path.endswith("states"))
    return tuple(map(str, value))


def _sensor(
    check: Checker, path: str, table: Mapping[str, Any], d: int | None, steps: int, default: Sensor | None
) -> Sensor | None:
    if table.get("H") is None and default is not None:
        H = default.H
    else:
        H = check.matrix(f"{path}.H", table.get("H"), None, d, steps)
    if table.get("R") is None and default is not None:
        R = default.R
        if H is not None and R.shape[-1] != H.shape[-2]:
            check.note(f"{path}.R", f"a {H.shape[-2]}×{H.shape[-2]} matrix, to go with its own H", "nothing")
    else:
        R = check.covariance(f"{path}.R", table.get("R"), None if H is None else H.shape[-2], steps, definite=True)
    if H is None or R is None:
        return None
    return sometimes(check, f"{path}.sensor", table.get("sensor"), Sensor(H, R), steps)


def read_sensors(
    check: Checker,
    agents: Tables,
    default: Sensor | None,
    d: int | None,
    filters: Sequence[Filter],
    network: Network | None,
    named: Mapping[int, Sensor | None],
    model: Mapping[str, Any],
) -> tuple[tuple[Sensor, ...], tuple[int, ...]]:
    """Read [[agent]]: the different sensors, and which of them every agent has.

    When an agent measures that has not both H and R of its own is what model.sensor says, but for what its own sensor
    table says.

    Parameters
    ----------
    model : [model].
    named : sensors by name, by agent counted from 0; None where something is wrong with one.
    """
    default = named.get(0) if named and not agents else default
    if network is None or (default is None and not agents):
        return (), ()
    if not agents:
        return (default,) if default else (), (0,) * network.agents
    if len(agents) != network.agents:
        check.note("agent", f"one [[agent]] table for each of the {network.agents} agents", f"{len(agents)}")
        return (), ()
    different: dict[tuple[Any, ...], int] = {}
    sensors, sensor_of = [], []
    when = {} if is_named(model.get("sensor")) or check.problems else table_of(model, "sensor")
    if when:
        default = _sensor(Checker(), "model", {"H": model.get("H"), "R": model.get("R")}, d, network.steps, None)
    for i, table in enumerate(agents, start=1):
        path = f"agent[{i}]"
        size = filters[i - 1].dimension if filters else d
        if i - 1 in named:
            sensor = named[i - 1]
        elif table.get("sensor") is False:
            sensor = Sensor(np.zeros((0, size or 1)), np.zeros((0, 0)))
            check.absent(path, table, ("H", "R"), "nothing, since sensor = false")
        else:
            # the model's sensor is for filters that have as many states as the model
            fitting = default if default is None or default.H.shape[-1] == size else None
            for key in ("H", "R"):
                if fitting is None and key not in table:
                    check.note(f"{path}.{key}", "a sensor of its own, or sensor = false", "nothing")
            if when and fitting is not None and None in (table.get("H"), table.get("R")):
                table = {**table, "sensor": {**when, **table_of(table, "sensor")}}
            sensor = _sensor(check, path, table, size, network.steps, fitting)
        if sensor is None:
            continue
        detection = None if sensor.detection is None else sensor.detection.tobytes()
        key = (sensor.H.shape, sensor.H.tobytes(), sensor.R.shape, sensor.R.tobytes(), detection)
        if key not in different:
            different[key] = len(sensors)
            sensors.append(sensor)
        sensor_of.append(different[key])
    return tuple(sensors), tuple(sensor_of)


def read_filters(
    check: Checker, tables: Tables, model: Model | None, P0: np.ndarray | None, own: bool, network: Network | None
) -> tuple[Filter, ...]:
    """Read the agents' own filters from [[agent]]; none where all have the model's."""
    keys = ("F", "Q", "P") if own else ("F", "Q", "P", "M", "s")
    if model is None or P0 is None or network is None:
        return ()
    for i, table in enumerate(tables, start=1):
        for key in ("M", "s"):
            if own and key in table:
                check.note(f"agent[{i}].{key}", "nothing, since every agent has a state of its own", shown(table[key]))
    if not any(key in table for table in tables for key in keys):
        return ()
    size = model.dimension if own else None
    found = [
        _filter(check, f"agent[{i}]", table, model, P0, network.steps, size) for i, table in enumerate(tables, start=1)
    ]
    filters = tuple(f for f in found if f is not None)
    return filters if len(filters) == len(found) else ()


def _filter(
    check: Checker, path: str, table: Mapping[str, Any], model: Model, P0: np.ndarray, steps: int, size: int | None
) -> Filter | None:
    F = check.matrix(f"{path}.F", table.get("F"), size, size, steps) if "F" in table else model.F
    if F is None or F.shape[-1] != F.shape[-2]:
        if F is not None:
            check.note(f"{path}.F", "a square matrix", f"a {F.shape[-2]}×{F.shape[-1]} matrix")
        return None
    d, D = F.shape[-1], model.dimension
    Q = _own(check, f"{path}.Q", table.get("Q"), d, steps, model.Q if d == D else None)
    P = _own(check, f"{path}.P", table.get("P"), d, 0, P0 if d == D else None)
    M = check.matrix(f"{path}.M", table.get("M"), D, d, 0) if "M" in table else np.eye(D) if d == D else None
    s = check.vector(f"{path}.s", table.get("s"), D)
    if M is None and "M" not in table:
        check.note(f"{path}.M", f"a {D}×{d} mapping into the state, since the filter has {d} states", "nothing")
    if Q is None or P is None or M is None:
        return None
    return Filter(F, Q, P, M, np.zeros((D, 1)) if s is None else s)


def _own(check: Checker, path: str, value: Any, d: int, steps: int, default: np.ndarray | None) -> np.ndarray | None:
    if value is not None:
        return check.covariance(path, value, d, steps)
    if default is None:
        check.note(path, f"a {d}×{d} covariance, to go with its own F", "nothing")
    return default


def read_noise(
    check: Checker, table: Mapping[str, Any], sensors: Sequence[Sensor], filters: Sequence[Filter], own: bool
) -> tuple[NoiseCorrelation | None, np.ndarray | None]:
    """Read [noise]: measurement noises that hang together, and the process noise of all parallel filters."""
    process = None
    if table.get("process") is not None:
        process = check.covariance("noise.process", table["process"], sum(f.dimension for f in filters) or None, 0)
        if own or not filters:
            check.note("noise.process", "nothing unless agents have parallel filters ([[agent]] F, Q, M)", "a matrix")
        elif process is not None:
            _check_blocks(check, process, [f.Q for f in filters])
    if table.get("correlation") is None and table.get("disturbance") is None:
        return None, process
    sizes = [sensor.H.shape[-2] for sensor in sensors]
    correlation = _correlation(check, table.get("correlation"), sizes)
    disturbance = _disturbance(check, table.get("disturbance"), sizes)
    return (None if correlation is None else NoiseCorrelation(correlation, disturbance)), process


def _check_blocks(check: Checker, process: np.ndarray, own: Sequence[np.ndarray]) -> None:
    first = 0
    for i, Q in enumerate(own, start=1):
        rows = slice(first, first + Q.shape[-1])
        first = rows.stop
        if not np.allclose(process[rows, rows], Q, rtol=1e-9, atol=0):
            check.note("noise.process", f"the process noise of agent {i}'s own filter as its diagonal block", "another")


def _correlation(check: Checker, value: Any, sizes: Sequence[int]) -> np.ndarray | None:
    n = len(sizes)
    expected = f"a number, or a symmetric {n}×{n} matrix of correlations with 1 on its diagonal"
    c = check.array("noise.correlation", 0.0 if value is None else value, expected)
    if c is None:
        return None
    if c.ndim == 0:
        c = np.where(np.eye(n, dtype=bool), 1.0, c)
    if c.shape != (n, n) or not np.allclose(c, c.T) or not np.allclose(np.diagonal(c), 1.0):
        check.note("noise.correlation", expected, shown(value))
        return None
    sees = [i for i in range(n) if sizes[i]]
    smallest = float(np.linalg.eigvalsh(c[np.ix_(sees, sees)]).min()) if sees else 1.0
    if smallest < -1e-9 or np.abs(c).max() > 1:
        kind = "correlations that can be (a positive semi-definite matrix)"
        check.note("noise.correlation", kind, f"{shown(value)} (smallest eigenvalue {smallest:.3g})")
        return None
    unlike = [(i, j) for i in sees for j in sees if c[i, j] and sizes[i] != sizes[j]]
    if unlike:
        i, j = unlike[0]
        got = f"{sizes[i]} of agent {i + 1} and {sizes[j]} of agent {j + 1}"
        check.note("noise.correlation", "sensors with as many components where they are correlated", got)
        return None
    return c


def _disturbance(check: Checker, value: Any, sizes: Sequence[int]) -> np.ndarray | None:
    total, expected = sum(sizes), "a variance, one sensor's variances, or a matrix over all components"
    array = check.array("noise.disturbance", value, expected)
    if array is None:
        return None
    if array.ndim == 1:
        if any(size not in (0, len(array)) for size in sizes):
            check.note("noise.disturbance", f"{max(sizes)} variances, one for each component", f"{len(array)}")
            return None
        array = np.diag(np.concatenate([array[:size] for size in sizes]))
    return check.covariance("noise.disturbance", array, total, 0)
