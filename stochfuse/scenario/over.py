"""Any number of a scenario by its path, and the scenarios that one or two such numbers make.

A path is written as errors write it: `network.delay`, `agent[2].R` (of the second agent table), `network.link[1][2]`
(an entry of a matrix).  A number is put at its path in the mapping that the scenario was made from, and the scenario is
read again: whatever follows from the number follows, and what does not fit is refused by the scenario itself.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from itertools import product
from math import floor, inf, isfinite, log10
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, Problem, ScenarioError, StochfuseError, UsageError, nearest
from stochfuse.kalman.checks import shown
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.scenario import Scenario, as_file, link_rows
from stochfuse.scenario.system import Items, Noises

LINK = "network.link"
KEY = "a key of the scenario such as network.link or agent[2].R (of the second agent table)"
_PART = r"[^.\[\]=]+(\[[1-9][0-9]{0,8}\])*"
PATH = re.compile(rf"{_PART}(\.{_PART})*")
_LIKELIHOODS = ("link", "burst", "radio")
"""Keys of [network] that say how likely messages are."""
MOST_KEYS, MOST_POINTS = 2, 10_000
"""What is swept at once; for more there are studies."""
MOST_LINKS = 1_000_000


def numbers_of(flag: str, text: str, low: float = -inf, high: float = inf) -> list[float]:
    """Numbers of `0.5`, `0.2,0.5` or `0:1:0.25` (both ends included); whole where all that is written is whole."""
    values: list[float] = []
    for part in text.split(","):
        try:
            numbers = [number(piece) for piece in part.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            values += numbers
        elif len(numbers) == 3:
            values += _range(flag, text, (numbers[0], numbers[1], numbers[2]), low, high)
        else:
            raise UsageError(f"{flag}: expected 0.5, 0.2,0.5 or 0:1:0.25, got '{text}'")
    return values


def number(text: str) -> float:
    """A number, whole where it is written so."""
    try:
        return int(text)
    except ValueError:
        return float(text)


def _range(flag: str, text: str, ends: tuple[float, float, float], low: float, high: float) -> list[float]:
    first, last, step = ends
    if not (step > 0 and last >= first and first >= low and last <= high and isfinite(last - first)):
        bounds = f"{low:g} ≤ first ≤ last ≤ {high:g}" if isfinite(low) else "first ≤ last"
        raise UsageError(f"{flag}: expected first:last:step with {bounds} and step > 0, got '{text}'")
    count = (last - first) / step
    if count > MOST_LINKS:
        what = "link probabilities" if flag == "--link" else "values"
        raise UsageError(f"{flag}: expected at most {MOST_LINKS} {what}, got {count:.3g} from '{text}'")
    if all(isinstance(number, int) for number in ends):
        return [*range(int(first), int(last), int(step)), last]
    # twelve digits of the largest, so that 0.3 is called 0.3
    decimals = 12 - floor(log10(max(abs(first), abs(last), step)))
    values = [round(first + i * step, decimals) for i in range(int(count + 1e-9) + 1)]
    return values if values[-1] >= last - 0.1**decimals else [*values, last]


def put(mapping: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario's mapping with values at paths, less what they replace.

    Raises
    ------
    ScenarioError
        If a path leads nowhere.
    """
    found = json.loads(json.dumps(mapping))
    for path, value in values.items():
        *tables, last = parts(path)
        place: Any = found
        for part in tables:
            place = _entered(path, place, part)
        if isinstance(last, int):
            _entered(path, place, last)
        elif not isinstance(place, dict):
            raise _nowhere(path, "it leads through what is no table")
        place[last] = value
        _replaced(found, path)
    return found


def _replaced(mapping: dict[str, Any], path: str) -> None:
    """Take away what a value at a path replaces: who says how likely messages are is the only one to say it."""
    table, _, key = path.partition(".")
    key = re.split(r"[.\[]", key)[0]
    if table == "network" and key in _LIKELIHOODS:
        for other in (*_LIKELIHOODS, "case", "sent", "received"):
            if other != key:
                mapping["network"].pop(other, None)


def parts(path: str) -> list[str | int]:
    """Keys and places (from 0) of a path."""
    return [key or int(place) - 1 for place, key in re.findall(r"\[([0-9]+)\]|([^.\[\]]+)", path)]


def _entered(path: str, place: Any, part: str | int) -> Any:
    if isinstance(part, str) and isinstance(place, dict):
        return place.setdefault(part, {})
    if isinstance(part, int) and isinstance(place, list) and 0 <= part < len(place):
        return place[part]
    raise _nowhere(path, f"the scenario lists no {part + 1} there" if isinstance(part, int) else "it leads nowhere")


def _nowhere(path: str, why: str) -> ScenarioError:
    return ScenarioError("scenario", [Problem(path, KEY, f"{shown(path)}, but {why}")])


class Key(NamedTuple):
    """A swept key.

    Parameters
    ----------
    name : its path.
    unit : of its numbers; empty where there is none, or none is known.
    values : the numbers, in order.
    """

    name: str
    unit: str
    values: tuple[float, ...]

    @property
    def title(self) -> str:
        """Its path with its unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def whole(self) -> bool:
        """Whether all values are whole numbers."""
        return all(isinstance(value, int) for value in self.values)


@dataclass(frozen=True, eq=False)
class Over:
    """Scenarios that differ in one or two numbers; make one with `over`.

    Parameters
    ----------
    keys : the swept keys.
    scenarios : one per point: all combinations of values, the last key's running fastest.
    """

    keys: tuple[Key, ...]
    scenarios: tuple[Scenario, ...]

    @cached_property
    def points(self) -> list[tuple[float, ...]]:
        """Values of the keys at every point."""
        return list(product(*(key.values for key in self.keys)))

    def label(self, point: int) -> str:
        """Name a point: `network.delay=3, model.Q=2`."""
        return _label([key.name for key in self.keys], self.points[point])

    @property
    def longest(self) -> Scenario:
        """The scenario with the most steps, of these the one with the most agents."""
        return max(self.scenarios, key=lambda s: (s.network.steps, s.network.agents))

    @contextmanager
    def at(self, point: int) -> Iterator[None]:
        """Name the point in errors of the work inside, which stay what they are."""
        with _named(self.label(point)):
            yield

    def check(self, link: Any) -> None:
        """Raise UsageError if a link probability is swept and given too."""
        if link is not None and any(key.name == LINK for key in self.keys):
            raise UsageError(f"over {LINK}: expected no link probabilities beside it")

    def items(self, link: Any) -> Items | None:
        """All points at their links as items of the first scenario's system, link rows running fastest.

        None where they differ in more than constant noises of like agents and in link probabilities, or differ in how
        many rows of links they have.
        """
        first = self.scenarios[0]
        if any(_differ(_without_items(first), _without_items(s)) for s in self.scenarios[1:]):
            return None
        rows = _rows_of([link_rows(s, link) for s in self.scenarios])
        noises = Noises(
            _stacked([s.model.Q for s in self.scenarios]),
            _stacked([s.sensors[0].R for s in self.scenarios]),
            _stacked([s.P0 for s in self.scenarios]),
        )
        if rows is None or any(M is not None and M.ndim != 3 for M in noises):
            return None
        if not noises.common and not _simple(first):
            return None
        points = len(self.scenarios)
        return Items(rows, noises.take(np.repeat(np.arange(points), len(rows.link) // points)))


def _label(names: Sequence[str], values: Sequence[float]) -> str:
    return ", ".join(f"{name}={value:.12g}" for name, value in zip(names, values, strict=True))


@contextmanager
def _named(label: str) -> Iterator[None]:
    try:
        yield
    except ScenarioError as error:
        raise ScenarioError(label, error.problems or str(error)) from None
    except NoAnswerError as error:
        raise NoAnswerError(f"{label}: {error}") from None
    except StochfuseError as error:
        raise type(error)(f"{label}: {error}") from None


def over(scenario: Scenario, given: Mapping[str, Any] | Over) -> Over:
    """Make the scenarios of one or two swept numbers.

    Parameters
    ----------
    scenario : what holds beside them; it is read again with each, from the mapping that it was made from.
    given : values by path; an `Over` is returned as it is.

    Raises
    ------
    UsageError
        If there are not one or two keys, one is unknown, or its values are no numbers.
    ScenarioError
        What the scenario itself says of a number, under the number's name.
    """
    if isinstance(given, Over):
        return given
    if not 1 <= len(given) <= MOST_KEYS:
        raise UsageError(f"over: expected one or two keys, got {len(given)}; for more see `stochfuse study`")
    keys = tuple(Key(name, unit_of(name), _values(name, values)) for name, values in given.items())
    points = list(product(*(key.values for key in keys)))
    if len(points) > MOST_POINTS:
        raise UsageError(
            f"over: expected at most {MOST_POINTS:,} scenarios, got {len(points):,}; see `stochfuse study`"
        )
    return Over(keys, tuple(with_numbers(scenario, dict(zip(given, point, strict=True))) for point in points))


def with_numbers(scenario: Scenario, numbers: Mapping[str, float]) -> Scenario:
    """Read a scenario again with numbers at paths; errors name them."""
    with _named(_label(list(numbers), list(numbers.values()))):
        return Scenario.from_mapping(put(scenario.source, numbers), scenario.name)


def _values(name: str, given: Any) -> tuple[float, ...]:
    values = as_file(list(given) if isinstance(given, Sequence | np.ndarray) and np.ndim(given) == 1 else [given], name)
    for value in values:
        if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
            raise UsageError(f"over {name}: expected finite numbers, got {shown(value)}")
    if not values:
        raise UsageError(f"over {name}: expected at least one value, got none")
    return tuple(values)


def unit_of(name: str) -> str:
    """Unit of a key's numbers, as the schema says it; empty where it says none.

    Raises
    ------
    UsageError
        If there is no such key; names the nearest.
    """
    from stochfuse.scenario.schema import ScenarioFile, fields_at, key_paths, unit

    found = fields_at(ScenarioFile, parts(name)) if PATH.fullmatch(name) else []
    if not found:
        known = key_paths(ScenarioFile)
        plain = re.sub(r"\[[0-9]+\]", "", name)
        same = [path for path in known if path.lower() == plain.lower()]
        ends = [path for path in known if path.rpartition(".")[2] == plain.rpartition(".")[2]]
        first = next(iter(same or ([] if nearest(plain, known) else ends)), None)
        near = f" (did you mean '{first}'?)" if first else nearest(plain, known)
        raise UsageError(f"over: expected {KEY}, got '{name}'{near}")
    return next(filter(None, map(unit, found)), "")


def _stacked(given: Sequence[np.ndarray]) -> np.ndarray | None:
    """Matrices of all points as a stack, None where they are the same."""
    return None if all(M is given[0] or np.array_equal(M, given[0]) for M in given) else np.stack(given)


def _rows_of(given: Sequence[LinkRows]) -> LinkRows | None:
    """Rows of all points below each other, None where they are of different kinds."""
    if len({rows.link.shape for rows in given}) > 1 or len({rows.names is None for rows in given}) > 1:
        return None
    names = None if given[0].names is None else tuple(name for rows in given for name in rows.names or ())
    bursts = tuple(burst for rows in given for burst in rows.bursts or (None,) * len(rows.link))
    link = np.concatenate([rows.link for rows in given])
    return LinkRows(names, link, None if all(burst is None for burst in bursts) else bursts)


def _simple(scenario: Scenario) -> bool:
    """Whether one Q, R and P are those of everybody."""
    plain = not scenario.own and not scenario.filters and not scenario.relations
    return plain and scenario.noise is None and scenario.process is None and len(scenario.sensors) == 1


def _without_items(scenario: Scenario) -> Scenario:
    """The scenario less what items may differ in: what is left must be equal."""
    blank = np.zeros(0)
    sensors = scenario.sensors
    return replace(
        scenario,
        model=replace(scenario.model, Q=blank),
        sensors=(replace(sensors[0], R=blank),) if len(sensors) == 1 else sensors,
        P0=blank,
        network=replace(scenario.network, link=None, cases=(), burst=None, case_bursts=(), radio=None, counts=None),
        source={},
    )


def _differ(a: Any, b: Any) -> bool:
    """Whether two values differ anywhere, arrays compared entry by entry."""
    if type(a) is not type(b):
        return True
    if isinstance(a, np.ndarray):
        return not np.array_equal(a, b)
    if is_dataclass(a):
        return any(_differ(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, Mapping):
        return a.keys() != b.keys() or any(_differ(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return len(a) != len(b) or any(map(_differ, a, b))
    return bool(a != b)
