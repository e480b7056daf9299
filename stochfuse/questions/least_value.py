"""A question asked backwards of any number of a scenario: its least, or greatest, value that meets a target.

With E(v) the number asked about where the key at a path is v, at given links,

    v* = min {v in [low, high] : E(v) ≤ target}      where E falls with v (a transmit power), or
    v* = max {v in [low, high] : E(v) ≤ target}      where E rises with v (a delay, a noise)

Nothing is known beforehand of E: it is evaluated on a grid of `GRID` values, and which of the two is meant is what it
does from low to high.  Why the answer is right comes with it:

* `every`: a key of whole numbers, each of which was evaluated.
* `monotone`: E never rises (or never falls) along the grid, so that it crosses the target in one cell.  There Brent's
  root finder (SciPy) closes in on the crossing, which is certified by its two sides: a value that meets the target, the
  answer, and one beside it that misses it.
* `grid`: E goes up and down.  Every cell whose ends differ is narrowed down likewise, but what happens between two
  values of the grid is not known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np

from stochfuse.errors import NoAnswerError, ScenarioError, UsageError
from stochfuse.kalman.checks import shown
from stochfuse.prediction.result import Prediction
from stochfuse.questions.question import SLACK, Question, check_target, described, question
from stochfuse.scenario.over import over, unit_of, with_numbers
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, of_scenario

GRID = 65
MOST_WHOLE = 257
"""Whole numbers up to which all are evaluated."""
ROUNDING = 1e-12
"""Relative rise along the grid that is rounding."""
STEPS = "network.steps"
EPS = float(np.finfo(float).eps)

Function = Callable[[float], float]


@dataclass(frozen=True, eq=False, repr=False)
class LeastValue(Result):
    """The least or greatest value of a key that meets a target.

    Parameters
    ----------
    question : what was asked about; its scenario has that value.
    target : the number to be met.
    key, unit : the key and its unit, empty where none is known.
    at : the value found.
    value : the number asked about there.
    direction : "least" or "greatest".
    proof : "every", "monotone" or "grid".
    beside : the nearest value that misses the target, and the number there; None where no value of the range misses.
    met : intervals of values in which the target is met, as far as the grid tells.
    grid : (2, values) what was evaluated, and the numbers there; infinite where there is no steady state.
    prediction : the prediction at the value.
    """

    question: Question
    target: float
    key: str
    unit: str
    at: float
    value: float
    direction: str
    proof: str
    beside: tuple[float, float] | None
    met: tuple[tuple[float, float], ...]
    grid: np.ndarray
    prediction: Prediction


@of_scenario
def least_value(
    scenario: Scenario, target: float, key: str, between: Sequence[float], link: float | None = None, **asked: Any
) -> LeastValue:
    """Return the least or greatest value of a key at which the number asked about is at most the target.

    Parameters
    ----------
    target : in the unit of the metric (of the quantity).
    key : path of a number in the scenario, "network.delay" or "agent[2].R".
    between : least and greatest value looked at.
    link : link probability of all links; default: the scenario's links, of which there must be one row.
    **asked : see `stochfuse.questions.question.question`.

    Raises
    ------
    UsageError, ScenarioError
        If the request does not fit the scenario.
    NoAnswerError
        If no value meets the target; says what the best is.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.least_value("thesis-transient", 30.0, "model.R", (50, 200), 0.5)
    >>> found.direction, round(found.at, 6)
    ('greatest', 122.799112)
    """
    check_target(target)
    unit, (low, high) = unit_of(key), _range(key, between)
    if key == STEPS and asked.get("step") is not None:
        raise UsageError(f"step: expected none with over {STEPS}, whose last step is asked about")
    about = question(scenario, one_link=False, **asked)
    E = _Objective(about, key, link)
    whole = _takes_whole_numbers_only(about.scenario, key, low, high)
    grid = _grid(low, high, whole)
    values = E.at(grid)
    proof = "every" if whole and len(grid) == int(high) - int(low) + 1 else _shape(values)
    falls = values[0] >= values[-1]
    if not whole and proof == "grid" and values.min() > target:
        grid, values = _with_lowest(E, grid, values)
    # a value that was printed in full is a target that can be met
    limit = next((t for t in (target, target * (1.0 + SLACK)) if values.min() <= t), None)
    if limit is None:
        raise NoAnswerError(_unreachable(about, target, key, unit, grid, values))
    spans, beside = _spans(E, grid, values, limit, whole)
    at, missed = (spans[0][0], beside[0][0]) if falls else (spans[-1][1], beside[-1][1])
    found = with_numbers(about.scenario, {key: at})
    about = replace(about, scenario=found, step=found.network.steps if key == STEPS and about.step else about.step)
    prediction = about.predict(None if link is None else [link])
    return LeastValue(
        question=about,
        target=float(target),
        key=key,
        unit=unit,
        at=at,
        value=float(about.read(prediction)[0]),
        direction="least" if falls else "greatest",
        proof=proof,
        beside=missed,
        met=spans,
        grid=np.array([grid, values], dtype=float),
        prediction=prediction,
    )


def _range(key: str, between: Sequence[float]) -> tuple[float, float]:
    ends = tuple(between)
    if len(ends) != 2 or not all(isinstance(end, Real) and isfinite(end) for end in ends) or ends[0] >= ends[1]:
        raise UsageError(f"over {key}: expected a least and a greatest value, LO:HI with LO < HI, got {shown(between)}")
    return ends


@dataclass(frozen=True)
class _Objective:
    """E(v): the number asked about, where a key is v."""

    asked: Question
    key: str
    link: float | None

    def __call__(self, v: float) -> float:
        return float(self.at([v])[0])

    def at(self, values: Sequence[float]) -> np.ndarray:
        """E of several values, together where that can be; infinite where there is no steady state."""
        try:
            return self._together(values)
        except NoAnswerError:
            if self.asked.step is not None:
                raise
            return np.concatenate([self._steady(v) for v in values])

    def _together(self, values: Sequence[float]) -> np.ndarray:
        found = over(self.asked.scenario, {self.key: values})
        swept = self.asked.sweep(None if self.link is None else [self.link], found)
        if len(swept.link) != len(values):
            each = len(swept.link) // len(values)
            raise UsageError(f"link: expected one link probability, since the scenario has {each} rows of links")
        return np.concatenate(swept.each(self.asked.read))

    def _steady(self, v: float) -> np.ndarray:
        try:
            return self._together([v])
        except NoAnswerError:
            return np.array([np.inf])


def _takes_whole_numbers_only(scenario: Scenario, key: str, low: float, high: float) -> bool:
    """Whether a key refuses what lies between whole numbers, and takes these."""

    def taken(v: float) -> bool:
        try:
            with_numbers(scenario, {key: v})
        except ScenarioError:
            return False
        return True

    if low != int(low) or high != int(high):
        return False
    return not taken(low + 0.5) and (taken(int(low)) or taken(int(high)))


def _grid(low: float, high: float, whole: bool) -> list[float]:
    if not whole:
        return [float(v) for v in np.linspace(low, high, GRID)]
    low, high = int(low), int(high)
    if high - low < MOST_WHOLE:
        return list(range(low, high + 1))
    return np.unique(np.rint(np.linspace(low, high, GRID)).astype(int)).tolist()


def _shape(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    small = ROUNDING * np.abs(finite).max() if len(finite) else 0.0
    # infinite values: differences of two of them are none
    rises = np.diff(np.where(np.isfinite(values), values, np.finfo(float).max))
    return "monotone" if (rises <= small).all() or (rises >= -small).all() else "grid"


def _with_lowest(E: Function, grid: list[float], values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Return the grid with the bottom of the dip about its lowest value."""
    from scipy.optimize import minimize_scalar

    i = int(np.argmin(values))
    ends = grid[max(i - 1, 0)], grid[min(i + 1, len(grid) - 1)]
    found: Any = minimize_scalar(E, bounds=ends, method="bounded", options={"xatol": 1e-9 * (ends[1] - ends[0])})
    lowest = float(found.x)
    place = int(np.searchsorted(grid, lowest))
    return [*grid[:place], lowest, *grid[place:]], np.insert(values, place, found.fun)


Missed = tuple[float, float] | None


def _spans(
    E: Function, grid: Sequence[float], values: np.ndarray, target: float, whole: bool
) -> tuple[tuple[tuple[float, float], ...], list[tuple[Missed, Missed]]]:
    """Intervals in which the target is met, and what misses it just before and just after each."""
    met = values <= target
    ends: list[float] = [grid[0]] if met[0] else []
    missed: list[Missed] = [None] if met[0] else []
    for i in np.flatnonzero(met[1:] != met[:-1]).tolist():
        misses, meets = (grid[i], grid[i + 1]) if met[i + 1] else (grid[i + 1], grid[i])
        misses, meets = (_halved if whole else _closed_in)(E, target, misses, meets)
        ends.append(meets)
        missed.append((misses, E(misses)))
    if met[-1]:
        ends.append(grid[-1])
        missed.append(None)
    pairs = zip(ends[::2], ends[1::2], strict=True), zip(missed[::2], missed[1::2], strict=True)
    return tuple(pairs[0]), list(pairs[1])


def _halved(E: Function, target: float, misses: float, meets: float) -> tuple[float, float]:
    """Neighbouring whole numbers of which one misses and one meets the target."""
    while abs(meets - misses) > 1:
        middle = int(misses + meets) // 2
        misses, meets = (misses, middle) if E(middle) <= target else (middle, meets)
    return misses, meets


def _closed_in(E: Function, target: float, misses: float, meets: float) -> tuple[float, float]:
    """Values as near each other as rounding allows, of which one misses and one meets the target."""
    from scipy.optimize import bisect, brentq

    least = 4 * EPS * max(abs(misses), abs(meets))
    # where there is no steady state there is no value to interpolate by
    finder = brentq if isfinite(E(misses)) else bisect
    root = float(finder(lambda v: E(v) - target, misses, meets, xtol=least, rtol=4 * EPS))  # type: ignore[arg-type]
    towards, step = np.sign(meets - misses), least
    while step < abs(meets - misses):
        a, b = root - towards * step, root + towards * step
        a = a if (a - misses) * towards > 0 else misses
        b = b if (meets - b) * towards > 0 else meets
        if E(a) > target >= E(b):
            return float(a), float(b)
        step *= 4
    return misses, meets


def _unreachable(asked: Question, target: float, key: str, unit: str, grid: Sequence[float], values: np.ndarray) -> str:
    i = int(np.argmin(values))
    digits = 9 if f"{values[i]:.9g}" != f"{target:.9g}" else 17
    where = f"{key} = {grid[i]:.6g}{f' {unit}' if unit else ''}"
    return (
        f"{described(asked)} is {values[i]:.{digits}g} at best, at {where}; expected a target of at least that, "
        f"got {target:.{digits}g}"
    )
