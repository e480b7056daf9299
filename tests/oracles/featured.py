"""Small scenarios with chosen features, as mappings of plain numbers: two or three agents, two or three steps."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

Mapping = dict[str, Any]

PLAIN = 0.6
"""Link probability where nothing else is asked for."""


def source(features: Collection[str]) -> Mapping:
    """Return the least scenario that has all of some features, as far as they can stand in one file."""
    agents = 61 if "many-agents" in features else 3 if {"no-sensor"} & set(features) and set(features) & _UNLIKE else 2
    steps = 3 if "sensor-pauses" in features else 2
    made: Mapping = {
        "model": {"F": [[0.9]], "H": [[1.0]], "Q": [[0.5]], "R": [[0.8]]},
        "initial": {"P": [[2.0]]},
        "network": {"agents": agents, "steps": steps, "link": PLAIN},
    }
    for name, put in _PUT.items():
        if name in features:
            put(made)
    _links(made, features)
    return made


def _two_states(made: Mapping) -> None:
    if len(made["model"]["F"]) == 1:
        made["model"] |= {"F": [[1.0, 0.5], [0.0, 0.8]], "H": [[1.0, 0.3]], "Q": [[0.5, 0.1], [0.1, 0.4]]}
        made["initial"]["P"] = [[2.0, 0.3], [0.3, 1.0]]


def _tables(made: Mapping) -> list[Mapping]:
    return made.setdefault("agent", [{} for _ in range(made["network"]["agents"])])


def _own_states(made: Mapping) -> None:
    _two_states(made)
    made["model"] |= {"own": True, "states": ["x", "y"]}
    made["cooperative"] = {"positions": ["x", "y"], "range": 0.5}
    for i, table in enumerate(_tables(made)):
        table["position"] = [10.0 * i, 3.0 * i * i]


def _singular(table: str, key: str) -> Callable[[Mapping], None]:
    def put(made: Mapping) -> None:
        _two_states(made)
        made[table][key] = [[1.0, 0.0], [0.0, 0.0]]

    return put


def _singular_prediction(made: Mapping) -> None:
    _two_states(made)
    made["model"] |= {"F": [[1.0, 0.5], [0.0, 0.0]], "Q": [[1.0, 0.0], [0.0, 0.0]]}


def _own_filters(made: Mapping) -> None:
    d = len(made["model"]["F"])
    _tables(made)[0]["Q"] = [[0.7 if i == j else 0.0 for j in range(d)] for i in range(d)]
    if made["model"]["Q"][-1][-1] == 0.0:
        _tables(made)[0]["Q"][-1][-1] = 0.0


def _common_process(made: Mapping) -> None:
    _own_filters(made)
    d, n = len(made["model"]["F"]), made["network"]["agents"]
    full = [[0.0] * (d * n) for _ in range(d * n)]
    for a, table in enumerate(_tables(made)):
        Q = table.get("Q", made["model"]["Q"])
        for i in range(d):
            for j in range(d):
                full[a * d + i][a * d + j] = Q[i][j]
    full[0][d] = full[d][0] = 0.2
    made["noise"] = {**made.get("noise", {}), "process": full}


def _sensor_pauses(made: Mapping) -> None:
    H = made["model"]["H"]
    _tables(made)[0]["H"] = [H, [[0.0] * len(H[0])], H]


def _no_sensor(made: Mapping) -> None:
    table = _tables(made)[-1]
    table |= {"sensor": False}


def _detection(made: Mapping) -> None:
    for table in _tables(made):
        if table.get("sensor") is not False:
            table["sensor"] = {"detection": 0.7}


def _unlike_noises(made: Mapping) -> None:
    _tables(made)[0]["R"] = [[1.7]]


def _unlike_sensors(made: Mapping) -> None:
    H = made["model"]["H"]
    _tables(made)[1]["H"] = [[2.0, *H[0][1:]]]


def _by_step(made: Mapping) -> None:
    model, steps = made["model"], made["network"]["steps"]
    for key in ("F", "R"):
        model[key] = [[[x * (1 + 0.1 * k) for x in row] for row in model[key]] for k in range(steps)]


def _noise(**what: float) -> Callable[[Mapping], None]:
    return lambda made: made.setdefault("noise", {}).update(what)


def _initial(**what: Any) -> Callable[[Mapping], None]:
    return lambda made: made["initial"].update(what)


def _error(made: Mapping) -> None:
    made["initial"]["error"] = [1.0] * len(made["initial"]["P"])


def _network(**what: Any) -> Callable[[Mapping], None]:
    return lambda made: made["network"].update(what)


def _unequal_delays(made: Mapping) -> None:
    n = made["network"]["agents"]
    # a broadcast is heard by all at once: equal delays in each column
    made["network"]["delay"] = [[[0.3, 0.7] if j == 0 and i != j else 0 for j in range(n)] for i in range(n)]


def _masks(made: Mapping) -> None:
    n = made["network"]["agents"]
    made["network"]["hears"] = [[j for j in range(1, n + 1) if j != i and i % 2 == 1] for i in range(1, n + 1)]


_PUT: dict[str, Callable[[Mapping], None]] = {
    "several-states": _two_states,
    "singular-P": _singular("initial", "P"),
    "singular-F": _singular("model", "F"),
    "singular-Q": _singular("model", "Q"),
    "own-states": _own_states,
    "own-filters": _own_filters,
    "common-process": _common_process,
    "unlike-noises": _unlike_noises,
    "unlike-sensors": _unlike_sensors,
    "sensor-pauses": _sensor_pauses,
    "no-sensor": _no_sensor,
    "detection": _detection,
    "matrices-per-step": _by_step,
    "shared-start": _initial(correlation="shared"),
    "initial-error": _error,
    "correlated-noises": _noise(correlation=0.3),
    "disturbance": _noise(disturbance=0.5),
    "delay": _network(delay=[0.5, 0.5]),
    "unequal-delays": _unequal_delays,
    "masks": _masks,
    "broadcast": _network(architecture="broadcast"),
    "cyclic": _network(architecture="cyclic"),
}
_PUT["singular-prediction"] = _singular_prediction
_UNLIKE = {"unlike-noises", "unlike-sensors", "correlated-noises"}


def _links(made: Mapping, features: Collection[str]) -> None:
    network = made["network"]
    n, steps = network["agents"], network["steps"]
    link: Any = PLAIN
    if "unequal-links" in features:
        # a broadcast is heard by all or by none: one probability a column
        link = [[0.3 + 0.4 * j / (n - 1) for j in range(n)] for _ in range(n)]
    if "links-per-step" in features:
        scaled = lambda k: [[x * k for x in row] for row in link] if isinstance(link, list) else link * k  # noqa: E731
        link = [scaled(1 - 0.2 * k) for k in range(steps)]
    network["link"] = link
    burst = {"good_to_bad": 0.4, "bad_to_good": 0.5, "good": 0.9, "bad": 0.2}
    if "cases" in features:
        del network["link"]
        network["case"] = [{"name": "one", "link": link}]
        if "bursts" in features:
            network["case"].append({"name": "bursty", "burst": burst})
    elif "bursts" in features:
        del network["link"]
        network["burst"] = burst
