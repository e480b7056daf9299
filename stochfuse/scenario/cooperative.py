"""Reading [cooperative] and the agents' places: who measures what of whom, linearised about the nominal places.

    [cooperative]  positions (names of 2 or 3 states), range and direction (standard deviations, of every pair)
    [[cooperative.pair]]  agents = [observer, other], range, direction, none, both_ways, where a pair differs
    [[agent]]      position: nominal place, or one per step

A pair's own table takes the place of range and direction of [cooperative] altogether: what it leaves out, the pair
does not measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from stochfuse.fusion.cooperative import Relation, coincident, over_states, relation
from stochfuse.kalman.checks import shown
from stochfuse.scenario.checker import Checker


class Relations(NamedTuple):
    """The cooperative measurements of a network.

    Parameters
    ----------
    positions : indices of the states that are the place.
    pairs : for observer i and other j, counted from 0, the relation over the full state: H_i, H_j of shape (p, d), or
        (steps, p, d) where a place is given per step, and R (p, p).  An ordered pair that is left out measures nothing.
    """

    positions: tuple[int, ...]
    pairs: dict[tuple[int, int], Relation]


class _Noise(NamedTuple):
    range: float | None
    direction: float | None

    @property
    def kind(self) -> str:
        return "range" if self.direction is None else "direction" if self.range is None else "both"


def read_cooperative(
    check: Checker,
    table: Mapping[str, Any] | None,
    agent_tables: Sequence[Any] | None,
    states: Sequence[str],
    agents: int,
    steps: int,
) -> Relations | None:
    """Read [cooperative] and every agent's position.

    Parameters
    ----------
    check : remembers what is wrong, by path.
    table : [cooperative], or None where the scenario has none.
    agent_tables : the [[agent]] tables, or None.
    states : names of the states of one agent.
    agents, steps : size of the network.

    Returns
    -------
    Relations or None
        None without [cooperative], or where something essential is wrong, which the checker has noted.
    """
    nodes = [node if isinstance(node, dict) else {} for node in _listed(agent_tables)]
    if not isinstance(table, Mapping):
        placed = [i for i, node in enumerate(nodes, start=1) if node.get("position") is not None]
        if table is None and placed:
            check.note("cooperative", f"a table, since agent[{placed[0]}].position is given", "nothing")
        return None
    positions = _positions(check, table.get("positions"), states)
    noises = _noises(check, table, agents)
    if positions is None:
        return None
    places = _places(check, nodes, len(positions), agents, steps)
    if places is None:
        return None
    return Relations(positions, _relations(check, noises, places, positions, len(states)))


def _positions(check: Checker, names: Any, states: Sequence[str]) -> tuple[int, ...] | None:
    expected = "the names of the 2 or 3 states that are the place"
    if not isinstance(names, list | tuple) or len(names) not in (2, 3) or len(set(map(str, names))) < len(names):
        check.note("cooperative.positions", expected, "nothing" if names is None else shown(names))
        return None
    known = [check.choice(f"cooperative.positions[{k}]", name, states) for k, name in enumerate(names, start=1)]
    return None if None in known else tuple(states.index(name) for name in names)


def _noises(check: Checker, table: Mapping[str, Any], agents: int) -> dict[tuple[int, int], _Noise]:
    """Return what each ordered pair measures; pairs that measure nothing are left out."""
    if not _measures(table) and not table.get("pair"):
        expected = "a standard deviation here, in cooperative.direction or in [[cooperative.pair]]"
        check.note("cooperative.range", expected, "nothing")
    common = _noise(check, "cooperative", table)
    noises = dict.fromkeys(permutations(range(agents), 2), common)
    listed = set()
    for k, pair in enumerate(_listed(table.get("pair")), start=1):
        if not isinstance(pair, dict):
            continue
        path = f"cooperative.pair[{k}]"
        noise = _pair_noise(check, path, pair)
        ends = _ends(check, f"{path}.agents", pair.get("agents"), agents)
        if ends is None:
            continue
        ways = {ends, ends[::-1]} if pair.get("both_ways", True) else {ends}
        if ways & listed:
            check.note(f"{path}.agents", "every pair once", f"{shown(pair['agents'])} again")
        listed |= ways
        noises.update(dict.fromkeys(ways, noise))
    return {pair: noise for pair, noise in noises.items() if noise is not None}


def _listed(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else ()


def _measures(table: Mapping[str, Any]) -> bool:
    return table.get("range") is not None or table.get("direction") is not None


def _pair_noise(check: Checker, path: str, pair: Mapping[str, Any]) -> _Noise | None:
    if pair.get("none"):
        if _measures(pair):
            check.note(path, "either a standard deviation or none = true", "both")
        return None
    if not _measures(pair):
        check.note(path, "range, direction or none = true", "none of them")
    return _noise(check, path, pair)


def _noise(check: Checker, path: str, table: Mapping[str, Any]) -> _Noise | None:
    noise = _Noise(*(_deviation(check, f"{path}.{key}", table.get(key)) for key in _Noise._fields))
    return None if noise == (None, None) else noise


def _deviation(check: Checker, path: str, value: Any) -> float | None:
    expected = "a positive standard deviation"
    array = check.array(path, value, expected)
    if array is None:
        return None
    if array.ndim or array <= 0:
        check.note(path, expected, shown(value))
        return None
    return float(array)


def _ends(check: Checker, path: str, value: Any, agents: int) -> tuple[int, int] | None:
    expected = f"two different agents of 1 to {agents}"
    if not isinstance(value, list | tuple) or len(value) != 2:
        check.note(path, expected, "nothing" if value is None else shown(value))
        return None
    first, second = (check.integer(f"{path}[{k}]", agent, 1) for k, agent in enumerate(value, start=1))
    if first is None or second is None:
        return None
    if first == second or max(first, second) > agents:
        check.note(path, expected, shown(value))
        return None
    return first - 1, second - 1


def _places(check: Checker, nodes: list[Any], coordinates: int, agents: int, steps: int) -> list[np.ndarray] | None:
    """Return every agent's place, (D,) or (steps, D)."""
    if len(nodes) != agents:
        # reading the sensors notes a wrong number of tables, but not that there are none
        if not any(problem.path == "agent" for problem in check.problems):
            expected = f"one [[agent]] table with a position for each of the {agents} agents"
            check.note("agent", expected, str(len(nodes)) if nodes else "nothing")
        return None
    places, noted = [], {problem.path for problem in check.problems}
    for i, node in enumerate(nodes, start=1):
        path = f"agent[{i}].position"
        if path in noted:
            continue
        if node.get("position") is None:
            check.note(path, f"a list of {coordinates} numbers, since [cooperative] is given", "nothing")
        place = check.vector(path, node.get("position"), coordinates, steps)
        if place is not None:
            places.append(place[:steps, :, 0] if place.ndim == 3 else place[:, 0])
    return places if len(places) == agents else None


def _relations(
    check: Checker,
    noises: Mapping[tuple[int, int], _Noise],
    places: Sequence[np.ndarray],
    positions: tuple[int, ...],
    d: int,
) -> dict[tuple[int, int], Relation]:
    related, refused = {}, set()
    for (i, j), noise in noises.items():
        meeting = np.atleast_1d(coincident(places[i], places[j]))
        if meeting.any():
            first, second = sorted((i, j))
            if (first, second) not in refused:
                step = int(meeting.argmax())
                when = f" at step {step + 1}" if len(meeting) > 1 else ""
                place = places[second] if places[second].ndim == 1 else places[second][step]
                expected = f"a place different from agent {first + 1}'s"
                check.note(f"agent[{second + 1}].position", expected, f"{place.tolist()}{when} (no direction)")
            refused.add((first, second))
            continue
        H_i, H_j, R = relation(noise.kind, places[i], places[j], noise.range, noise.direction)
        related[i, j] = Relation(over_states(H_i, positions, d), over_states(H_j, positions, d), R)
    return related
