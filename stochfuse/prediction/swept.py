"""Predictions of scenarios that differ in one or two numbers, read as one.

A row stands for a point (a combination of the swept values) at one link probability, the links running fastest.  The
parts are predictions of a point each, or one of all points together, where they are items of one system.  They may
differ in agents, steps and state: what a part does not have is not-a-number.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

import stochfuse
from stochfuse.errors import UsageError
from stochfuse.estimators.progress import within
from stochfuse.kalman.metrics import Metric
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.over import Over
from stochfuse.scenario.registry import NATURES
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario

T = TypeVar("T")
Answer = TypeVar("Answer")


def _to(first: str, last: str) -> str:
    """Two texts that differ in words as one."""
    pairs = zip(first.split(" "), last.split(" "), strict=True)
    return " ".join(a if a == b else f"{a} … {b}" for a, b in pairs)


def below_each_other(given: Sequence[np.ndarray], fill: float = np.nan) -> np.ndarray:
    """Return arrays below each other, their further axes lengthened to the longest."""
    shape = np.max([M.shape[1:] for M in given], axis=0).astype(int)

    def lengthened(M: np.ndarray) -> np.ndarray:
        more = [(0, 0), *((0, to - have) for to, have in zip(shape, M.shape[1:], strict=True))]
        return np.pad(M.astype(float), more, constant_values=fill)

    same = all((M.shape[1:] == shape).all() for M in given)
    return np.concatenate(given if same else [lengthened(M) for M in given])


def of_parts(over: Over, parts: Sequence[T], read: Callable[[T], Answer]) -> list[Answer]:
    """Ask something of the part of every point; an error names the point, and whoever listens hears of it."""
    found = []
    for point, part in enumerate(parts):
        with over.at(point), within(over.label(point), point + 1, len(parts)):
            found.append(read(part))
    return found


class PointRows(Protocol):
    """What points have in common that can be read below each other: link, cases, steps and whether agents are alike."""

    @property
    def link(self) -> np.ndarray: ...
    @property
    def cases(self) -> tuple[str, ...] | None: ...
    @property
    def steps(self) -> np.ndarray: ...
    @property
    def alike(self) -> bool: ...


Part = TypeVar("Part", bound=PointRows)


@dataclass(frozen=True, eq=False, repr=False)
class SweptRows(Result, Generic[Part]):
    """Results against the values of one or two keys of the scenario; rows are theirs, links running fastest.

    Parameters
    ----------
    over : the keys and their values, and the scenario of every point.
    parts : results of the points in order, or a single one of all of them.
    """

    over: Over
    parts: tuple[Part, ...]

    @property
    def point(self) -> np.ndarray:
        """(rows,) index of each row's point."""
        counts = [len(part.link) for part in self.parts]
        if len(self.parts) < len(self.over.points):
            counts = [counts[0] // len(self.over.points)] * len(self.over.points)
        return np.repeat(np.arange(len(self.over.points)), counts)

    @property
    def link(self) -> np.ndarray:
        """(rows,) link probability of each row, averaged over the links if they differ."""
        return np.concatenate([part.link for part in self.parts])

    @property
    def cases(self) -> tuple[str, ...] | None:
        """A name per row where rows are cases."""
        if self.parts[0].cases is None:
            return None
        return tuple(name for part in self.parts for name in part.cases or ())

    @property
    def steps(self) -> np.ndarray:
        """(steps,) step numbers, of the point that has most of them."""
        return max((part.steps for part in self.parts), key=len)

    @property
    def scenario(self) -> Scenario:
        """The first point's scenario."""
        return self.over.scenarios[0]

    @property
    def alike(self) -> bool:
        """Whether all agents have the same at every point."""
        return all(part.alike for part in self.parts)


@dataclass(frozen=True, eq=False, repr=False)
class Swept(SweptRows[Prediction]):
    """Predictions against the values of one or two keys of the scenario; see `SweptRows`."""

    @property
    def quantity(self) -> str:
        """What is shown."""
        return self.parts[0].quantity

    @property
    def method(self) -> str:
        """How it was computed."""
        return self.parts[0].method

    @property
    def stage(self) -> str:
        """When: "posterior"."""
        return self.parts[0].stage

    @property
    def estimator(self) -> str:
        """What the agents do with what arrives."""
        return self.parts[0].estimator

    @property
    def nature(self) -> str:
        """Nature of the least certain point."""
        return max((part.nature for part in self.parts), key=NATURES.index)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader should know, each sentence once."""
        found: dict[str, list[str]] = {}
        for note in (note for part in self.parts for note in part.notes):
            # what a sample came to differs from point to point: the first and the last are told
            of_sample = note.startswith(("control: ", "precision "))
            found.setdefault(re.sub(r"\d[\d,.e+-]*", "#", note) if of_sample else note, []).append(note)
        return tuple(_to(texts[0], texts[-1]) for texts in found.values())

    @property
    def forms(self) -> tuple[str, ...]:
        """Numeric forms used."""
        return tuple(sorted({form for part in self.parts for form in part.forms}))

    @property
    def meta(self) -> Mapping[str, Any]:
        """Further facts for programs: what all points have in common once, what has a row each one below another."""
        return {key: self._met(key) for key in self.parts[0].meta}

    def _met(self, key: str) -> Any:
        each = [part.meta.get(key) for part in self.parts]
        if all(isinstance(v, list) and len(v) == len(p.link) for v, p in zip(each, self.parts, strict=True)):
            return [row for value in each for row in value or ()]
        return each[0] if all(value == each[0] for value in each) else each

    @property
    def with_actual(self) -> bool:
        """Whether the moments of the actual error are known."""
        return all(part.with_actual for part in self.parts)

    @property
    def steady_bound(self) -> np.ndarray | None:
        """Proved relative error bound of the steady state, the worst of every row, (rows, 1)."""
        bounds = [part.steady_bound for part in self.parts]
        if any(bound is None for bound in bounds):
            return None
        return np.concatenate([bound.max(axis=1, keepdims=True) for bound in bounds if bound is not None])

    def shown_as(self, quantity: str) -> Swept:
        """Return the same with another quantity of those that were computed."""
        return replace(self, parts=tuple(part.shown_as(quantity) for part in self.parts))

    def values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a metric, shape (rows, steps), not-a-number where a point has no such step; see `Prediction`."""
        return below_each_other(self.each(lambda part: part.values(of, agent)))

    def statistic(self, name: str, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray:
        """Return a statistic of a metric over the outcomes, shape (rows, steps).

        Raises
        ------
        UsageError
            If the points were predicted together: predict them with one_by_one=True.
        """
        if name != "mean" and len(self.parts) < len(self.over.points) and self.parts[0].outcomes is None:
            raise UsageError(f"statistic '{name}': expected points predicted one by one (one_by_one=True)")
        return below_each_other(self.each(lambda part: part.statistic(name, of, agent)))

    def standard_error(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of `values`, 0 where nothing was sampled; None if nothing was at any point."""
        errors = self.each(lambda part: part.standard_error(of, agent))
        if all(error is None for error in errors):
            return None
        shapes = [(len(part.link), len(part.steps)) for part in self.parts]
        return below_each_other([np.zeros(s) if e is None else e for e, s in zip(errors, shapes, strict=True)])

    def steady_values(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return a metric of the steady state, shape (rows,), or None if none was computed."""
        found = [values for values in self.each(lambda part: part.steady_values(of, agent)) if values is not None]
        return np.concatenate(found) if found else None

    def steady_error(self, of: str | Metric = "trace", agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of `steady_values`, 0 where nothing was sampled; None if nothing was at any."""
        errors = [part.steady_error(of, agent) for part in self.parts]
        if all(error is None for error in errors):
            return None
        pairs = zip(errors, self.parts, strict=True)
        return np.concatenate([np.zeros(len(part.link)) if e is None else e for e, part in pairs])

    def table(self, of: str | None = None, agent: int | str = "mean") -> str:
        """Return the table as text, as `stochfuse predict --over` prints it."""
        return stochfuse.shown("text_of", self, of=of, agent=agent)

    def each(self, read: Callable[[Prediction], Answer]) -> list[Answer]:
        """Ask something of every part; an error names the point that it comes from."""
        if len(self.parts) == len(self.over.points):
            return of_parts(self.over, self.parts, read)
        return [read(part) for part in self.parts]
