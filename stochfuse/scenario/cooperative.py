"""Reading [cooperative] and the agents' places: who measures what of whom, linearised about the nominal places.

    [cooperative]  positions (names of 2 or 3 states), range and direction (standard deviations, of every pair),
                   attitude (1 or 3 states: a direction is measured in the observer's own frame), clock (a state), time
    [[cooperative.pair]]  agents = [observer, other], range, direction, time; or H_i, H_j, R; or none; both_ways
    [[agent]]      position: nominal place, or one per step

A pair's own table takes the place of range, direction and time of [cooperative] altogether: what it leaves out, the
pair does not measure.  Places are needed where a range or a direction is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.fusion.cooperative import (
    Relation,
    attitude,
    coincident,
    linear,
    over_states,
    relation,
    time_transfer,
    together,
)
from stochfuse.kalman.checks import shown
from stochfuse.scenario.checker import Checker, tables_of

Relations = dict[tuple[int, int], Relation]
"""What observer i measures of other j, counted from 0, over the full state: H_i, H_j of shape (p, d), or (steps, p, d)
where a place is given per step, and R (p, p).  An ordered pair that is left out measures nothing.
"""


class _RelationNoise(NamedTuple):
    range: float | None
    direction: float | None
    time: float | None

    @property
    def kind(self) -> str:
        """What of the places is measured."""
        if self.range is None:
            return "" if self.direction is None else "direction"
        return "range" if self.direction is None else "both"


class _StateIndices(NamedTuple):
    """Indices of the states that are the place, the attitude and the clock of an agent, and how many states it has."""

    positions: tuple[int, ...]
    attitude: tuple[int, ...]
    clock: tuple[int, ...]
    d: int


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
    nodes = tables_of(agent_tables)
    if not isinstance(table, Mapping):
        placed = [i for i, node in enumerate(nodes, start=1) if node.get("position") is not None]
        if table is None and placed:
            check.note("cooperative", f"a table, since agent[{placed[0]}].position is given", "nothing")
        return None
    noises = _noises(check, table, agents, len(states))
    where = _states(check, table, states, list(noises.values()))
    if where is None:
        return None
    if noises and not any(isinstance(noise, _RelationNoise) and noise.kind for noise in noises.values()):
        return {pair: _related(noise, where, None, None) for pair, noise in noises.items()}
    places = _places(check, nodes, len(where.positions), agents, steps)
    return None if places is None else _relations(check, noises, places, where)


def _states(
    check: Checker, table: Mapping[str, Any], states: Sequence[str], related: Sequence[_RelationNoise | Relation]
) -> _StateIndices | None:
    """States by their names; None where one that is needed is not there."""
    before, measured = len(check.problems), [noise for noise in related if isinstance(noise, _RelationNoise)]
    place: tuple[int, ...] = ()
    if table.get("positions") is not None or any(noise.kind for noise in measured) or not related:
        expected = "the names of the 2 or 3 states that are the place"
        place = _named(check, table, "positions", states, (2, 3), expected)
    turned: tuple[int, ...] = ()
    if table.get("attitude") is not None:
        count = 1 if len(place) == 2 else 3
        what = "the name of the state that turns" if count == 1 else "the names of the 3 states that turn"
        turned = _named(check, table, "attitude", states, (count,), f"{what} an agent's frame")
        if not any(noise.direction for noise in measured):
            check.note("cooperative.attitude", "a direction that is measured in that frame", "none")
    clock: tuple[int, ...] = ()
    if any(noise.time for noise in measured) or table.get("clock") is not None:
        one = {"clock": [table["clock"]] if table.get("clock") is not None else None}
        clock = _named(check, one, "clock", states, (1,), "the name of the state that is the clock's error")
        if not any(noise.time for noise in measured) and table.get("time") is None:
            check.note("cooperative.clock", "a time that is measured", "none")
    return None if len(check.problems) > before else _StateIndices(place, turned, clock, len(states))


def _named(
    check: Checker, table: Mapping[str, Any], key: str, states: Sequence[str], counts: tuple[int, ...], expected: str
) -> tuple[int, ...]:
    """Indices of states that are named under a key of [cooperative]; empty where that is noted as wrong."""
    path, names = f"cooperative.{key}", table.get(key)
    if not isinstance(names, list | tuple) or len(names) not in counts or len(set(map(str, names))) < len(names):
        check.note(path, expected, "nothing" if names is None else shown(names))
        return ()
    known = [check.choice(f"{path}[{k}]", name, states) for k, name in enumerate(names, start=1)]
    return () if None in known else tuple(states.index(name) for name in names)


def _noises(
    check: Checker, table: Mapping[str, Any], agents: int, d: int
) -> dict[tuple[int, int], _RelationNoise | Relation]:
    """Return what each ordered pair measures; pairs that measure nothing are left out."""
    if not _measures(table) and not table.get("pair"):
        expected = "a standard deviation here, in cooperative.direction or in [[cooperative.pair]]"
        check.note("cooperative.range", expected, "nothing")
    common = _noise(check, "cooperative", table)
    noises: dict[tuple[int, int], Any] = dict.fromkeys(permutations(range(agents), 2), common)
    listed = set()
    given = table.get("pair")
    for k, pair in enumerate(given if isinstance(given, list | tuple) else (), start=1):
        if not isinstance(pair, Mapping):
            continue
        path = f"cooperative.pair[{k}]"
        noise = _pair_noise(check, path, pair, d)
        ends = _ends(check, f"{path}.agents", pair.get("agents"), agents)
        if ends is None:
            continue
        ways = {ends, ends[::-1]} if pair.get("both_ways", True) else {ends}
        if ways & listed:
            check.note(f"{path}.agents", "every pair once", f"{shown(pair['agents'])} again")
        listed |= ways
        noises.update(dict.fromkeys(ways, noise))
    return {pair: noise for pair, noise in noises.items() if noise is not None}


def _measures(table: Mapping[str, Any]) -> bool:
    return any(table.get(key) is not None for key in _RelationNoise._fields)


def _pair_noise(check: Checker, path: str, pair: Mapping[str, Any], d: int) -> _RelationNoise | Relation | None:
    matrices = [pair.get(key) for key in Relation._fields]
    if any(M is not None for M in matrices):
        return _linear(check, path, pair, d)
    if pair.get("none"):
        if _measures(pair):
            check.note(path, "either a standard deviation or none = true", "both")
        return None
    if not _measures(pair):
        check.note(path, "range, direction, time, H_i with H_j and R, or none = true", "none of them")
    return _noise(check, path, pair)


def _linear(check: Checker, path: str, pair: Mapping[str, Any], d: int) -> Relation | None:
    """A relation given by its matrices."""
    if pair.get("none") or _measures(pair):
        check.note(path, "either H_i, H_j and R or another measurement", "both")
        return None
    R = check.array(f"{path}.R", pair.get("R"), "a covariance (p, p), or a number")
    p = 1 if R is None or R.ndim == 0 else len(R)
    expected = f"a matrix of {p} row{'s' * (p > 1)} (of R) and {d} column{'s' * (d > 1)} (of the states)"
    H_i, H_j = (check.array(f"{path}.{key}", pair.get(key), expected) for key in ("H_i", "H_j"))
    if R is None or H_i is None or H_j is None:
        for key in Relation._fields:
            if pair.get(key) is None:
                check.note(f"{path}.{key}", "a matrix beside the others of H_i, H_j and R", "nothing")
        return None
    for key, M in (("H_i", H_i), ("H_j", H_j)):
        if np.atleast_2d(M).shape != (p, d):
            check.note(f"{path}.{key}", expected, shown(pair[key]))
            return None
    try:
        return linear(np.atleast_2d(H_i), np.atleast_2d(H_j), np.atleast_2d(R))
    except UsageError:
        check.note(f"{path}.R", "a covariance", shown(pair["R"]))
        return None


def _noise(check: Checker, path: str, table: Mapping[str, Any]) -> _RelationNoise | None:
    expected = "a positive standard deviation"
    noise = _RelationNoise(
        *(check.number(f"{path}.{key}", table.get(key), expected, lambda σ: σ > 0) for key in _RelationNoise._fields)
    )
    return noise if any(sigma is not None for sigma in noise) else None


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


def _places(
    check: Checker, nodes: Sequence[Mapping[str, Any]], coordinates: int, agents: int, steps: int
) -> list[np.ndarray] | None:
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
        place = check.place(path, node.get("position"), coordinates, steps)
        places += [] if place is None else [place]
    return places if len(places) == agents else None


def _relations(
    check: Checker,
    noises: Mapping[tuple[int, int], _RelationNoise | Relation],
    places: Sequence[np.ndarray],
    where: _StateIndices,
) -> Relations:
    related, refused = {}, set()
    for (i, j), noise in noises.items():
        if isinstance(noise, Relation) or not noise.kind:
            related[i, j] = _related(noise, where, None, None)
            continue
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
        related[i, j] = _related(noise, where, places[i], places[j])
    return related


def _related(noise: _RelationNoise | Relation, where: _StateIndices, r_i: Any, r_j: Any) -> Relation:
    """What a pair measures, over its full states."""
    if isinstance(noise, Relation):
        return noise
    parts = []
    if noise.kind:
        H_i, H_j, R = relation(noise.kind, r_i, r_j, noise.range, noise.direction)
        H_i, H_j = (over_states(H, where.positions, where.d) for H in (H_i, H_j))
        if where.attitude:
            H_i = H_i + over_states(attitude(noise.kind, r_i, r_j), where.attitude, where.d)
        parts.append(Relation(H_i, H_j, R))
    if noise.time is not None:
        H_i, H_j, R = time_transfer(noise.time)
        parts.append(Relation(over_states(H_i, where.clock, where.d), over_states(H_j, where.clock, where.d), R))
    return together(*parts)
