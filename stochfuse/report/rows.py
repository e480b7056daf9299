"""What the rows of a result stand for, and along what its curves are drawn: the same in every table and figure.

Rows are link probabilities, named cases, or the values of swept keys (`stochfuse.scenario.over`), with the link beside
them where it is not the same in all rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.protocols import ProtocolLoad
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.swept import Swept
from stochfuse.questions.messages import Load, SweptLoad
from stochfuse.report.plot import entry, shades, spread
from stochfuse.report.table import counted
from stochfuse.scenario.over import LINK, Over

Cells = tuple[Any, ...]


def whose(agent: int | str, names: Sequence[str] = ()) -> str:
    """Whose covariance it is, in words; `names` of the agents, where they have some."""
    texts = {
        "mean": "covariance averaged over the agents",
        "worst": "the agent with the largest value",
        "best": "the agent with the smallest value",
        "each": "each agent by itself",
    }
    named = f" ({names[agent - 1]})" if names and isinstance(agent, int) else ""
    return texts.get(str(agent), f"agent {agent}{named}")


@dataclass(frozen=True)
class ResultRows:
    """The rows of a result.

    Parameters
    ----------
    result : the result.
    """

    result: Prediction | Swept | Load | ProtocolLoad

    @cached_property
    def over(self) -> Over | None:
        """What was swept, or None."""
        return self.result.over if isinstance(self.result, Swept | SweptLoad) else None

    @cached_property
    def point(self) -> np.ndarray:
        """(rows,) index of every row's point of what was swept."""
        if isinstance(self.result, Swept | SweptLoad):
            return self.result.point
        return np.zeros(len(self.result.link), dtype=int)

    @property
    def mean(self) -> str:
        """What a row's link probability is: that of all links, or their mean."""
        link = self.result.scenario.network.link
        return "µ" if self.result.cases is None and (link is None or link.ndim == 0) else "mean µ"

    @cached_property
    def linked(self) -> bool:
        """Whether tables say each row's link: not where what is swept is the link, or has none to do with it."""
        if self.over is None:
            return True
        if self.result.cases is not None:
            return True
        return any(key.name != LINK for key in self.over.keys) and len(set(self.result.link.tolist())) > 1

    @property
    def common(self) -> str:
        """The link of all rows, where tables do not say it row by row: `; µ = 0.5`."""
        if self.linked or (self.over is not None and any(key.name == LINK for key in self.over.keys)):
            return ""
        return f"; {self.mean} = {self.result.link[0]:.4g}"

    @property
    def sizes(self) -> list[int]:
        """Numbers of agents, rising."""
        return sorted({s.network.agents for s in (self.over.scenarios if self.over else (self.result.scenario,))})

    @property
    def agents(self) -> str:
        """The scenario, and how many agents: `thesis-transient: 2 to 4 agents, ad-hoc`."""
        scenario, numbers = self.result.scenario, self.sizes
        several = f"{numbers[0]} to " if len(numbers) > 1 else ""
        return f"{scenario.name}: {several}{counted(numbers[-1], 'agent')}, {scenario.network.architecture}"

    @property
    def keys(self) -> tuple[str, ...]:
        """Headings of a table's columns that name a row."""
        swept = () if self.over is None else tuple(key.title for key in self.over.keys)
        return (*swept, *(("links",) if self.result.cases else ()), *((self.mean,) if self.linked else ()))

    def cells(self, row: int) -> tuple[str, ...]:
        """Cells of those columns."""
        µ = self.result.link[row]
        case = () if self.result.cases is None else (self.result.cases[row],)
        return (*self._numbers(row), *case, *((f"{µ:.6g}" if self.mean == "µ" else f"{µ:.4g}",) if self.linked else ()))

    def _numbers(self, row: int) -> tuple[str, ...]:
        return () if self.over is None else tuple(f"{value:.6g}" for value in self.over.points[self.point[row]])

    @property
    def headings(self) -> tuple[str, ...]:
        """Headings of a CSV's columns that name a row."""
        return (*(() if self.over is None else (key.title for key in self.over.keys)), "case", "link")

    def record(self, row: int) -> Cells:
        """Cells of those columns, in full precision."""
        case = "" if self.result.cases is None else self.result.cases[row]
        return (*(() if self.over is None else self.over.points[self.point[row]]), case, float(self.result.link[row]))

    @property
    def facts(self) -> dict[str, Any]:
        """Entries of a JSON object that name the rows."""
        found: dict[str, Any] = {"link": self.result.link.tolist()}
        if self.result.cases is not None:
            found["cases"] = list(self.result.cases)
        if self.over is not None:
            found["over"] = [
                {"key": key.name, "unit": key.unit or None, "values": list(key.values)} for key in self.over.keys
            ]
            # values of the keys in every row
            found["points"] = [list(self.over.points[point]) for point in self.point]
        return found

    def name(self, row: int) -> str:
        """Name a row in a legend."""
        if self.result.cases is not None and self.over is None:
            return self.result.cases[row]
        link = [f"{self.mean} = {self.result.link[row]:.3g}"] if self.linked else []
        case = [] if self.result.cases is None else [self.result.cases[row]]
        return ", ".join([*self._named(row, range(len(self.over.keys) if self.over else 0)), *(case or link)])

    def _named(self, row: int, keys: Sequence[int]) -> list[str]:
        if self.over is None:
            return []
        return [f"{self.over.keys[k].name} = {self.over.points[self.point[row]][k]:.6g}" for k in keys]

    @property
    def sequence(self) -> bool:
        """Whether there is something to draw rows along."""
        if self._main is not None:
            return True
        return self.result.cases is None and len(set(self.result.link.tolist())) > 1

    @property
    def _main(self) -> int | None:
        """The swept key that curves run along."""
        several = [] if self.over is None else [k for k, key in enumerate(self.over.keys) if len(key.values) > 1]
        return several[0] if several else None

    def _last(self, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Place of the last of some steps that each row has."""
        if not isinstance(self.result, Swept):
            return np.full(len(rows), len(steps) - 1)
        own = np.concatenate([np.full(len(part.link), part.steps[-1]) for part in self.result.parts])
        return np.searchsorted(steps, own[rows], side="right") - 1

    def curves(self, steps: np.ndarray | None, *, last: bool = False) -> Curves:
        """Return along what values (rows, steps) are drawn; without steps they are (rows,).

        Parameters
        ----------
        last : whether rows that are drawn along something are drawn at their last step only.
        """
        if self.over is not None and self._main is not None:
            return self._along_key(self.over, self._main, steps, last)
        if self.result.cases is None and len(self.result.link) > 1:
            order = np.argsort(self.result.link, kind="stable")
            if last and steps is not None:
                at = f"after step {steps[-1]}"
                picks = [(order, self._last(order, steps))]
                return Curves([self.result.link[order]], "link probability µ", [""], picks, "rows", at=at)
            return _by_step(self.result.link[order], order, steps, "link probability µ")
        names = [self.name(row) for row in range(len(self.result.link))]
        if steps is None:
            raise ValueError("rows that are no sequence are drawn against steps")
        picks = [(row, slice(None)) for row in range(len(names))]
        return Curves([steps] * len(names), "step k", names, picks, "rows", whole=True)

    def _along_key(self, over: Over, main: int, steps: np.ndarray | None, last: bool) -> Curves:
        """Draw along a swept key: a curve a step, or where rows differ in more, a curve for each of that."""
        others = [k for k in range(len(over.keys)) if k != main and len(over.keys[k].values) > 1]
        groups: dict[Any, list[int]] = {}
        each = len(self.point) // len(over.points)
        for row, point in enumerate(self.point):
            groups.setdefault((row % each, *(over.points[point][k] for k in others)), []).append(row)
        x = np.array([over.points[point][main] for point in self.point], dtype=float)
        rows = [np.array(members)[np.argsort(x[members], kind="stable")] for members in groups.values()]
        key = over.keys[main]
        if len(rows) == 1 and not (last and steps is not None):
            return _by_step(x[rows[0]], rows[0], steps, key.title, whole=key.whole)
        names = [", ".join([*self._named(int(some[0]), others), *self._beside(int(some[0]), each)]) for some in rows]
        label, x = key.title, [x[some] for some in rows]
        if steps is None:
            return Curves(x, label, names, [(some,) for some in rows], "rows", key.whole)
        ends = [self._last(some, steps) for some in rows]
        at = f"after step {steps[-1]}" if np.concatenate(ends).min() == len(steps) - 1 else "after the last step"
        return Curves(x, label, names, list(zip(rows, ends, strict=True)), "rows", key.whole, at)

    def _beside(self, row: int, each: int) -> list[str]:
        """Which of a point's several links a row is of."""
        if each == 1:
            return []
        return [f"µ = {self.result.link[row]:.3g}" if self.result.cases is None else self.result.cases[row]]


class Curves(NamedTuple):
    """Curves through values (rows, steps).

    Parameters
    ----------
    x : of each curve.
    label : of the axis along which they run.
    names : of each curve.
    picks : index of each curve's values.
    what : what there is a curve of, "steps" or "rows".
    whole : whether x are whole numbers.
    at : where the values are taken, in words, if that is not said by the names.
    """

    x: list[np.ndarray]
    label: str
    names: list[str]
    picks: list[Any]
    what: str
    whole: bool = False
    at: str = ""

    def shown(self) -> list[ShownCurve]:
        """Return those that are drawn, at most eight from first to last."""
        chosen = spread(len(self.names))
        each = zip(chosen, shades(len(chosen)), strict=True)
        return [ShownCurve(self.names[c], self.x[c], self.picks[c], color) for c, color in each]

    def entries(self) -> list[Any]:
        """Return what a legend says of their colours."""
        return [entry(curve.name, color=curve.color, linewidth=3) for curve in self.shown()]


class ShownCurve(NamedTuple):
    """A curve that is drawn: its name, its x, the index of its values, and its colour."""

    name: str
    x: np.ndarray
    pick: Any
    color: Any


def _by_step(x: np.ndarray, rows: np.ndarray, steps: np.ndarray | None, label: str, *, whole: bool = False) -> Curves:
    if steps is None:
        return Curves([x], label, [""], [(rows,)], "rows", whole)
    names, picks = [f"k = {k}" for k in steps], [(rows, c) for c in range(len(steps))]
    return Curves([x] * len(steps), label, names, picks, "steps", whole)
