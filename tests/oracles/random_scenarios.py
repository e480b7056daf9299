"""Random scenarios that are valid by the file format, as mappings of plain numbers: short, small, of every feature."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np

import stochfuse as sf

# fcs-demo has ten agents, too many for a walk in seconds
PRESETS = ("beacon-map", "cooperative-pnt", "cv-2d", "gps-ins", "parallel-filters")
ESTIMATORS_OF_REPORT = ("local-fusion-graph", "naive", "covariance-intersection", "stand-alone")


def scenario(rng: np.random.Generator) -> dict[str, Any]:
    """Return the mapping of a random scenario; nearly always one that can be read."""
    kind = rng.choice(["one state", "filters", "own states", "preset"], p=[0.71, 0.13, 0.13, 0.03])
    if kind == "preset":
        made = sf.load_scenario(str(rng.choice(PRESETS))).to_mapping()
        return made | {"network": made["network"] | {"steps": int(rng.choice([1, 2, 3]))}}
    n, steps = int(rng.choice([1, 2, 3, 4], p=[0.1, 0.45, 0.35, 0.1])), int(rng.choice([1, 2, 3, 4]))
    if kind == "own states":
        return _own(rng, n, steps)
    d, p = int(rng.choice([1, 2, 3], p=[0.5, 0.35, 0.15])), int(rng.choice([1, 2], p=[0.7, 0.3]))
    made = {"model": _model(rng, d, p, steps), "initial": _initial(rng, d), "network": _network(rng, n, steps)}
    if kind == "filters":
        made["agent"] = [_filter(rng, d, p) for _ in range(n)]
        if _maybe(rng, 0.3):
            Q = [table.get("Q", made["model"]["Q"]) for table in made["agent"]]
            made["noise"] = {"process": _blocks(Q)} if all(np.ndim(q) == 2 for q in Q) else {}
        made["initial"].pop("correlation", None)
    else:
        if _maybe(rng, 0.35):
            made["agent"] = [_sensor(rng, d, p, steps) for _ in range(n)]
        if _maybe(rng, 0.2):
            made["noise"] = _noise(rng, n, p)
    if _maybe(rng, 0.15):
        made["report"] = _report(rng, n)
    return made


def _maybe(rng: np.random.Generator, probability: float) -> bool:
    return bool(rng.random() < probability)


def _matrix(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    return rng.integers(-15, 16, size=(rows, columns)) / 10


def covariance(rng: np.random.Generator, d: int, *, definite: bool = False) -> list[list[float]]:
    """A covariance of one-digit numbers; unless it must be definite it is sometimes singular, sometimes 0."""
    rank = d if definite or _maybe(rng, 0.85) else int(rng.integers(0, d))
    A = _matrix(rng, d, rank)
    C = A @ A.T + (0.5 * np.eye(d) if rank == d else 0)
    scale = rng.choice([1.0, 100.0, 0.01, 1e6], p=[0.8, 0.1, 0.07, 0.03])
    return (scale * np.round(C, 6)).tolist()


def _transition(rng: np.random.Generator, d: int) -> list[list[float]]:
    F = np.eye(d) + np.triu(_matrix(rng, d, d), 1)
    kind = rng.choice(["integrator", "any", "singular", "unstable"], p=[0.5, 0.3, 0.1, 0.1])
    if kind == "any":
        F = _matrix(rng, d, d) / 2
    if kind == "singular":
        F[-1, -1] = 0.0
    return (1.2 * F if kind == "unstable" else F).tolist()


def _by_step(rng: np.random.Generator, steps: int, draw: Any, probability: float = 0.12) -> Any:
    """A matrix, or now and then one for every step."""
    return [draw() for _ in range(steps)] if _maybe(rng, probability) else draw()


def _measuring(rng: np.random.Generator, p: int, d: int) -> list[list[float]]:
    """H, of zeros now and then."""
    return (_matrix(rng, p, d) if _maybe(rng, 0.9) else np.zeros((p, d))).tolist()


def _model(rng: np.random.Generator, d: int, p: int, steps: int) -> dict[str, Any]:
    made: dict[str, Any] = {
        "F": _by_step(rng, steps, lambda: _transition(rng, d)),
        "H": _by_step(rng, steps, lambda: _measuring(rng, p, d)),
        "Q": _by_step(rng, steps, lambda: covariance(rng, d)),
        "R": _by_step(rng, steps, lambda: covariance(rng, p, definite=True)),
    }
    if _maybe(rng, 0.1):
        columns = int(rng.integers(1, d + 1))
        made |= {"G": _matrix(rng, d, columns).tolist(), "Q": covariance(rng, columns)}
    if _maybe(rng, 0.1):
        made |= {"B": _matrix(rng, d, 1).tolist(), "u": float(rng.integers(-3, 4))}
    if _maybe(rng, 0.2):
        made["units"] = ["m", "m/s", "m/s²"][:d]
    return made


def _initial(rng: np.random.Generator, d: int) -> dict[str, Any]:
    made: dict[str, Any] = {"P": covariance(rng, d)}
    if _maybe(rng, 0.25):
        made["correlation"] = "shared"
    if _maybe(rng, 0.2):
        made["error"] = _matrix(rng, 1, d)[0].tolist()
    if _maybe(rng, 0.1):
        made["x"] = _matrix(rng, 1, d)[0].tolist()
    return made


def _probability(rng: np.random.Generator) -> float:
    return float(rng.choice([0.0, 1.0, 0.5, round(float(rng.random()), 2)], p=[0.15, 0.15, 0.2, 0.5]))


def link(rng: np.random.Generator, n: int, steps: int, architecture: str) -> Any:
    """Link probabilities in one of the forms of a file."""

    def matrix() -> Any:
        if architecture == "broadcast":
            return [[_probability(rng) for _ in range(n)]] * n
        return [[_probability(rng) for _ in range(n)] for _ in range(n)]

    kind = rng.choice(["number", "matrix", "steps", "matrices", "mixed"], p=[0.5, 0.2, 0.15, 0.1, 0.05])
    if kind == "number":
        return _probability(rng)
    if kind == "matrix":
        return matrix()
    if kind == "steps":
        return [_probability(rng) for _ in range(steps)]
    return [matrix() if kind == "matrices" or k % 2 else _probability(rng) for k in range(steps)]


def _burst(rng: np.random.Generator) -> dict[str, float]:
    made = {"good_to_bad": _probability(rng), "bad_to_good": float(rng.choice([0.1, 0.5, 1.0]))}
    return made | ({"good": _probability(rng), "bad": _probability(rng)} if _maybe(rng, 0.5) else {})


def _network(rng: np.random.Generator, n: int, steps: int) -> dict[str, Any]:
    architecture = str(rng.choice(["ad-hoc", "broadcast", "cyclic"], p=[0.6, 0.2, 0.2]))
    made: dict[str, Any] = {"agents": n, "steps": steps, "architecture": architecture}
    kind = rng.choice(["link", "none", "burst", "cases"], p=[0.55, 0.2, 0.12, 0.13])
    if kind == "link":
        made["link"] = link(rng, n, steps, architecture)
    if kind == "burst":
        made["burst"] = _burst(rng)
    if kind == "cases":
        bursty = _maybe(rng, 0.3)
        made["case"] = [
            {"name": name} | ({"burst": _burst(rng)} if bursty and _maybe(rng, 0.5) else {"link": link(rng, n, steps, architecture)})
            for name in ("one", "two")[: int(rng.integers(1, 3))]
        ]  # fmt: skip
    bursts = "burst" in made or any("burst" in case for case in made.get("case", ()))
    if architecture == "ad-hoc" and not bursts and _maybe(rng, 0.2):
        made["hears"] = [[j + 1 for j in range(n) if j != i and _maybe(rng, 0.5)] for i in range(n)]
    if _maybe(rng, 0.15):
        made["delay"] = [0, 1, 2, [0.5, 0.5], [0.6, 0.3, 0.1], [0.0, 0.5, 0.5]][int(rng.integers(6))]
    return made


def _sensor(rng: np.random.Generator, d: int, p: int, steps: int) -> dict[str, Any]:
    kind = rng.choice(["the model's", "none", "R", "H", "both"], p=[0.3, 0.25, 0.2, 0.1, 0.15])
    if kind == "none":
        return {"sensor": False}
    own = int(rng.integers(1, 3)) if kind == "both" else p
    made: dict[str, Any] = {}
    if kind in ("R", "both"):
        made["R"] = _by_step(rng, steps, lambda: covariance(rng, own, definite=True))
    if kind in ("H", "both"):
        made["H"] = _by_step(rng, steps, lambda: _measuring(rng, own, d))
    return made


def _filter(rng: np.random.Generator, d: int, p: int) -> dict[str, Any]:
    """An agent's filter of its own: alike but for its noises, or with a state more."""
    kind = rng.choice(["the model's", "noises", "larger"], p=[0.3, 0.3, 0.4])
    if kind == "the model's":
        return {"sensor": False} if _maybe(rng, 0.2) else {}
    if kind == "noises":
        return {"Q": covariance(rng, d), "P": covariance(rng, d)}
    made = {"F": _transition(rng, d + 1), "Q": covariance(rng, d + 1), "P": covariance(rng, d + 1)}
    made["M"] = np.eye(d, d + 1).tolist()
    if _maybe(rng, 0.2):
        made["s"] = _matrix(rng, 1, d)[0].tolist()
    if _maybe(rng, 0.2):
        return made | {"sensor": False}
    return made | {"H": _measuring(rng, p, d + 1), "R": covariance(rng, p, definite=True)}


def _blocks(Q: list[Any]) -> list[list[float]]:
    sizes = [len(q) for q in Q]
    out = np.zeros((sum(sizes), sum(sizes)))
    for first, q in zip(np.cumsum([0, *sizes]), Q, strict=False):
        out[first : first + len(q), first : first + len(q)] = q
    return out.tolist()


def _noise(rng: np.random.Generator, n: int, p: int) -> dict[str, Any]:
    made: dict[str, Any] = {}
    if _maybe(rng, 0.7):
        made["correlation"] = float(rng.choice([0.0, 0.3, 0.9, -0.2]))
        if _maybe(rng, 0.3):
            made["correlation"] = np.where(np.eye(n, dtype=bool), 1.0, 0.1 * rng.integers(0, 4)).tolist()
    if _maybe(rng, 0.5) or not made:
        made["disturbance"] = 0.5 if _maybe(rng, 0.5) else [0.5] * p
    return made


def _report(rng: np.random.Generator, n: int) -> dict[str, Any]:
    made: dict[str, Any] = {"agent": int(rng.integers(1, n + 1))} if _maybe(rng, 0.5) else {}
    if _maybe(rng, 0.5):
        made["metric"] = str(rng.choice(["trace", "det", "max-eig"]))
    if _maybe(rng, 0.4):
        made["estimator"] = str(rng.choice(ESTIMATORS_OF_REPORT))
    elif _maybe(rng, 0.4):
        made["method"] = str(rng.choice(["simplified", "general", "naive", "optimal"]))
    return made | ({"runs": 4} if "method" not in made and _maybe(rng, 0.3) else {})


def _own(rng: np.random.Generator, n: int, steps: int) -> dict[str, Any]:
    """Agents with states of their own that measure each other."""
    d, p = int(rng.choice([2, 3])), int(rng.choice([1, 2]))
    made = {"model": _model(rng, d, p, steps), "initial": _initial(rng, d), "network": _network(rng, n, steps)}
    made["model"] |= {"own": True, "states": ["x", "y", "z"][:d]}
    made["initial"].pop("correlation", None)
    made["cooperative"] = {"positions": ["x", "y", "z"][:d]}
    made["cooperative"] |= [{"range": 0.5}, {"direction": 0.01}, {"range": 0.5, "direction": 0.01}][
        int(rng.integers(3))
    ]
    if n > 1 and _maybe(rng, 0.3):
        pair: dict[str, Any] = {"agents": [1, 2]} | ({"none": True} if _maybe(rng, 0.5) else {"range": 0.1})
        made["cooperative"]["pair"] = [pair | ({"both_ways": False} if _maybe(rng, 0.3) else {})]
    made["agent"] = []
    for i in range(n):
        place = [10.0 * i, float(rng.integers(-20, 21)), float(5 * i)][:d]
        moving = _maybe(rng, 0.2)
        table: dict[str, Any] = {"position": [[place[0] + k, *place[1:]] for k in range(steps)] if moving else place}
        table |= {"sensor": False} if _maybe(rng, 0.3) else {}
        table |= {"Q": covariance(rng, d)} if _maybe(rng, 0.2) else {}
        made["agent"].append(table | ({"P": covariance(rng, d)} if _maybe(rng, 0.2) else {}))
    return made


def smaller(made: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Scenarios with one thing less, for the search of the least one that still fails."""
    network = made["network"]
    for steps in range(1, network["steps"]):
        yield _with(made, "network", "steps", steps)
    for agents in range(1, network["agents"]):
        yield _without_agents(made, agents)
    for table, content in made.items():
        if table not in ("model", "initial", "network"):
            yield {key: value for key, value in made.items() if key != table}
        for key in list(content) if isinstance(content, dict) else []:
            less = copy.deepcopy(made)
            del less[table][key]
            yield less
            if key not in ("agents", "steps"):
                yield from (_with(made, table, key, value) for value in _simpler(content[key]))
    for i, agent in enumerate(made.get("agent", ())):
        for key in agent:
            less = copy.deepcopy(made)
            del less["agent"][i][key]
            yield less
            for value in _simpler(agent[key]):
                less = copy.deepcopy(made)
                less["agent"][i][key] = value
                yield less


def _with(made: dict[str, Any], table: str, key: str, value: Any) -> dict[str, Any]:
    return made | {table: made[table] | {key: value}}


def _simpler(value: Any) -> Iterator[Any]:
    if isinstance(value, float | int | str) and value not in (0.5, 1.0, 0.0):
        yield from (0.5, 1.0)
    elif isinstance(value, list) and value:
        array = np.array(value, dtype=object)
        if array.ndim == 3:
            yield value[0]
        if array.ndim == 2 and array.shape[0] == array.shape[1] and value != np.eye(len(value)).tolist():
            yield np.eye(len(value)).tolist()
        yield from (1.0, 0.5)


def _without_agents(made: dict[str, Any], agents: int) -> dict[str, Any]:
    less = copy.deepcopy(made)
    less["network"]["agents"] = agents
    if "agent" in less:
        less["agent"] = less["agent"][:agents]
    if "hears" in less["network"]:
        less["network"]["hears"] = [[j for j in row if j <= agents] for row in less["network"]["hears"][:agents]]
    return less
