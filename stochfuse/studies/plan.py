"""What a study asks: which points, made from which scenario, predicted how, tabulated as what.

Points are numbered from 0.  In a grid the last key of [vary] runs fastest; a list takes the first, the second … value
of every key; a Latin hypercube (SciPy's) takes one value from each of as many equal parts of every key's range as there
are points.  Points are made in chunks, so that no study has to fit in memory; a Latin hypercube's numbers do.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.checks import shown
from stochfuse.errors import Problem, ScenarioError
from stochfuse.metrics import Metric
from stochfuse.metrics import metric as metric_of
from stochfuse.quantities import noun
from stochfuse.quantities import unit as unit_of
from stochfuse.rules import SUMS
from stochfuse.scenario import Scenario
from stochfuse.studies.axes import Axis

SETTINGS = ("method", "estimator", "criterion", "runs", "seed", "max_graphs", "prune")
"""Names in [vary] that are no scenario keys."""
KEY = "a key of the scenario such as network.link or agent[2].R (of the second agent table)"
MESSAGES, NODES = "messages", "messages.nodes"
ERROR = ".standard_error"
CHUNK = {"simplified": 16384, "general": 256, "naive": 256, "optimal": 256, "monte-carlo": 4}
"""Points that are evaluated, and written, together."""
LEAST_PARTS = 16
"""Chunks of a study, if it has as many points, of which single ones may take long."""
CHUNK_OF_PASTS = 16
"""The same for estimators whose numbers are worked point by point."""
MOST_NUMBERS = 4_000_000
"""Entries of the covariances of a chunk."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A checked study; make one with `load_study` or `plan_of`.

    Parameters
    ----------
    name : the file's name.
    kind : "grid", "list" or "latin-hypercube".
    axes : the varied keys.
    size : number of points.
    base : the scenario's mapping, before points change it.
    scenario_name : its name.
    settings : what holds for every point, by the names of `SETTINGS`.
    quantities, metrics, agent : what is tabulated.
    example : the scenario of a point that can be made, for names and units.
    seed : of a Latin hypercube.
    record : the whole as JSON takes it: what `plan_of` makes the same plan from.
    """

    name: str
    kind: str
    axes: tuple[Axis, ...]
    size: int
    base: Mapping[str, Any]
    scenario_name: str
    settings: Mapping[str, Any]
    quantities: tuple[str, ...]
    metrics: tuple[str, ...]
    agent: int | str
    example: Scenario
    seed: int
    record: Mapping[str, Any] = field(repr=False)

    @cached_property
    def labels(self) -> Mapping[str, str]:
        """For people: what every value column holds, with its unit."""
        found = {}
        for quantity in self.quantities:
            if quantity == MESSAGES:
                found[NODES] = "nodes received per agent and step"
                continue
            for m in map(self.metric, self.metrics):
                unit = unit_of(quantity, m)
                found[f"{quantity}.{m.name}"] = f"{quantity} {noun(quantity, m)}{f' [{unit}]' if unit else ''}"
                if "monte-carlo" in self.methods:
                    found[f"{quantity}.{m.name}{ERROR}"] = f"standard error of {found[f'{quantity}.{m.name}']}"
        return found

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the value columns."""
        return tuple(self.labels)

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that points are predicted by."""
        return self._taken("method", (default_method(self.example, self._given),))

    @property
    def _given(self) -> set[str]:
        return {*self.settings, *(axis.name for axis in self.axes)}

    def _taken(self, name: str, default: tuple[Any, ...]) -> tuple[Any, ...]:
        """Values that a setting takes among the points."""
        for axis in self.axes:
            if axis.name == name:
                return axis.given or ()
        return (self.settings[name],) if name in self.settings else default

    @cached_property
    def chunk(self) -> int:
        """Points that are evaluated together, the same whoever does it: so results are the same to the last bit."""
        estimators = self._taken("estimator", (self.example.estimator or "local-fusion-graph",))
        most = min(CHUNK[method] for method in self.methods)
        if set(self.methods) & {"general"} and not set(estimators) <= set(SUMS):
            most = min(most, CHUNK_OF_PASTS)
        if set(self.methods) & {"general", "naive", "optimal"}:
            # a few points can be hours of work, of which some should be kept, and which workers should share
            most = min(most, -(-self.size // LEAST_PARTS))
        steps = next((a for a in self.axes if a.name == "network.steps"), None)
        longest = self.example.network.steps
        if steps is not None and steps.kind in ("int", "float"):
            longest = int(max(steps.given or (steps.high,)))
        d = self.example.model.dimension
        return max(1, min(most, MOST_NUMBERS // max(1, longest * d * d)))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.size // self.chunk)

    def range_of(self, chunk: int) -> range:
        """Points of a chunk."""
        return range(chunk * self.chunk, min(self.size, (chunk + 1) * self.chunk))

    def codes(self, points: range) -> dict[str, np.ndarray]:
        """What every key is at some points: codes of listed values, or the values of a range; see `Axis.shown`."""
        number = np.arange(points.start, points.stop)
        if self.kind == "grid":
            sizes = tuple(len(axis.given or ()) for axis in self.axes)
            return {a.name: c for a, c in zip(self.axes, np.unravel_index(number, sizes), strict=True)}
        if self.kind == "list":
            return {axis.name: number for axis in self.axes}
        return {axis.name: axis.drawn(u) for axis, u in zip(self.axes, self._hypercube[number].T, strict=True)}

    @cached_property
    def _hypercube(self) -> np.ndarray:
        from scipy.stats import qmc

        return qmc.LatinHypercube(len(self.axes), rng=self.seed).random(self.size)

    def mapping(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the scenario's mapping with some keys' values in it.

        Raises
        ------
        ScenarioError
            If a path leads nowhere.
        """
        return put(self.base, values)

    def metric(self, name: str) -> Metric:
        """Return one of the metrics."""
        return metric_of(name, self.example.model)


def default_method(scenario: Scenario, given: set[str]) -> str:
    """Return the method where none is named: the scenario's, or the one that what is named belongs to."""
    if scenario.method is not None:
        return scenario.method
    return "monte-carlo" if "runs" in given else "general" if "estimator" in given else "simplified"


def put(mapping: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario's mapping with values at paths, `network.link` or `agent[2].R`, less what they replace."""
    found = json.loads(json.dumps(mapping))
    for path, value in values.items():
        *tables, last = _parts(path)
        place: Any = found
        for part in tables:
            place = _entered(path, place, part)
        if not isinstance(place, dict) or not isinstance(last, str):
            raise _nowhere(path)
        place[last] = value
        # a link probability takes the place of everything else that says how likely messages are
        if path == "network.link":
            for other in ("case", "burst"):
                place.pop(other, None)
        elif path.startswith("network.burst"):
            found["network"].pop("link", None)
            found["network"].pop("case", None)
    return found


def _parts(path: str) -> list[str | int]:
    return [key or int(place) - 1 for place, key in re.findall(r"\[([0-9]+)\]|([^.\[\]]+)", path)]


def _entered(path: str, place: Any, part: str | int) -> Any:
    if isinstance(part, str) and isinstance(place, dict):
        return place.setdefault(part, {})
    if isinstance(part, int) and isinstance(place, list) and 0 <= part < len(place):
        return place[part]
    raise _nowhere(path)


def _nowhere(path: str) -> ScenarioError:
    return ScenarioError("study", [Problem(f"vary.{path}", KEY, shown(path))])
