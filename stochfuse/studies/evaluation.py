"""The answers of some points of a study, in batches.

Points that differ in link probability and in noises given as numbers (model.Q, model.R, initial.P) only are items of
one system (`stochfuse.prediction.predict.predict_items`).  Where they have no answer together, noises are gone through
one by one, all link probabilities of one together; and where that has no answer, point by point, so that an error is
its point's alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.precision import told
from stochfuse.errors import NoAnswerError, ScenarioError, StochfuseError, TooManyError
from stochfuse.kalman.checks import LARGEST, covariance_fault, first_fault
from stochfuse.prediction.compare import OF_SAMPLES
from stochfuse.prediction.method import ShownPart
from stochfuse.prediction.predict import WORTHLESS, predict_items, predict_several
from stochfuse.prediction.result import Prediction
from stochfuse.questions.messages import message_load
from stochfuse.scenario.network import restricted, uniform_rows
from stochfuse.scenario.over import LINK, put
from stochfuse.scenario.registry import LFG, MONTE_CARLO, NAIVE, NATURES, OPTIMAL, STAND_ALONE
from stochfuse.scenario.scenario import Scenario
from stochfuse.scenario.system import Items, Noises
from stochfuse.studies.plan import ERROR, MESSAGES, NODES, SETTINGS, Plan, default_method

Q, R, P0 = "model.Q", "model.R", "initial.P"
BATCHED = (LINK, Q, R, P0)
"""Keys whose numbers make a batch; a noise's number is that multiple of the identity."""
PEDIGREES = (LFG, OPTIMAL)
"""Estimators whose messages bring all that is new to the receiver; the others send their latest estimate."""
FAILED = 0
"""Number of steps of a point without an answer: it has one row."""


Kind = tuple[str, str, str]
"""Method, estimator and nature."""


class Answers(NamedTuple):
    """What became of some points, in their order.

    Parameters
    ----------
    steps : (points,) number of steps, or `FAILED`.
    values : (rows, columns) value columns; one row per step of every point, and one for a failed point.
    what : (points,) index into `kinds`.
    kinds : method, estimator and nature that some points have in common.
    errors : reason, by the number of the point.
    """

    steps: np.ndarray
    values: np.ndarray
    what: np.ndarray
    kinds: tuple[Kind, ...]
    errors: Mapping[int, str]

    @property
    def rows(self) -> np.ndarray:
        """Rows of every point, (points,)."""
        return np.maximum(self.steps, 1)


class _Group(NamedTuple):
    """Points of one structure.

    Parameters
    ----------
    values : (points, steps, columns).
    what : (points,) code of each point's kind.
    kinds : codes of kinds.
    errors : reasons by place in the group.
    """

    values: np.ndarray
    what: np.ndarray
    kinds: dict[Kind, int]
    errors: dict[int, str]

    @classmethod
    def empty(cls, size: int, steps: int, columns: int, kind: Kind) -> _Group:
        """Points without answers yet."""
        return cls(np.full((size, steps, columns), np.nan), np.zeros(size, dtype=np.int32), {kind: 0}, {})

    def mark(self, items: np.ndarray, kind: Kind) -> None:
        """Say what kind the answers of some points are of."""
        self.what[items] = self.kinds.setdefault(kind, len(self.kinds))


def evaluate(plan: Plan, points: range) -> Answers:
    """Evaluate some points of a study.

    Returns
    -------
    Answers
        The same to the last bit whenever the same points are asked for together.
    """
    codes = plan.codes(points)
    batched = [axis for axis in plan.axes if axis.name in BATCHED and axis.kind != "text"]
    others = [axis for axis in plan.axes if axis not in batched]
    found = []
    for members in _alike([codes[axis.name] for axis in others], len(points)):
        values = {axis.name: axis.value(codes[axis.name][members[0]]) for axis in others}
        numbers = {axis.name: axis.shown(codes[axis.name][members]).astype(float) for axis in batched}
        found.append((members, _group(plan, values, numbers, len(members))))
    return _together(plan, points, found)


def _alike(columns: Sequence[np.ndarray], size: int) -> list[np.ndarray]:
    """Places of points whose entries are equal in every column, in the order of their first."""
    if not columns:
        return [np.arange(size)]
    codes = [np.unique(column, return_inverse=True)[1] for column in columns]
    _, group = np.unique(np.stack(codes, axis=1), axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    found = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    return sorted(found, key=lambda members: members[0])


def _together(plan: Plan, points: range, found: Sequence[tuple[np.ndarray, _Group]]) -> Answers:
    steps, what = np.zeros((2, len(points)), dtype=np.int32)
    kinds: dict[Kind, int] = {}
    errors: dict[int, str] = {}
    for members, group in found:
        fine = np.ones(len(members), dtype=bool)
        fine[list(group.errors)] = False
        steps[members[fine]] = group.values.shape[1]
        what[members] = np.array([kinds.setdefault(kind, len(kinds)) for kind in group.kinds])[group.what]
        errors |= {points[members[place]]: reason for place, reason in group.errors.items()}
    first = np.concatenate([[0], np.cumsum(np.maximum(steps, 1))])
    values = np.full((first[-1], len(plan.columns)), np.nan)
    for members, group in found:
        fine = np.flatnonzero(steps[members])
        rows = first[members[fine]][:, None] + np.arange(group.values.shape[1])
        values[rows] = group.values[fine]
    return Answers(steps, values, what, tuple(kinds), dict(sorted(errors.items())))


class _Points(NamedTuple):
    """The points of a group, how they are predicted, and what becomes of them.

    Parameters
    ----------
    plan, method, settings : how.
    mapping : the scenario that they have in common.
    unit : the same with 1 for the numbers in which they differ: with their shapes, and the identities that numbers are
        multiples of.
    numbers : those numbers, (points,) by key.
    group : the answers.
    """

    plan: Plan
    method: str
    settings: Mapping[str, Any]
    mapping: Mapping[str, Any]
    unit: Scenario
    numbers: Mapping[str, np.ndarray]
    group: _Group

    @property
    def quantities(self) -> list[str]:
        """Quantities of the error."""
        return [q for q in self.plan.quantities if q != MESSAGES]

    def scenario(self, numbers: Mapping[str, float]) -> Scenario:
        """Make a scenario of some numbers."""
        return Scenario.from_mapping(put(self.mapping, numbers), self.plan.scenario_name)

    def fail(self, items: np.ndarray, error: Exception) -> None:
        """Note why some points have no answer."""
        self.group.errors.update(dict.fromkeys(items.tolist(), _reason(error)))


def _group(plan: Plan, values: Mapping[str, Any], numbers: Mapping[str, np.ndarray], size: int) -> _Group:
    """Evaluate points that have `values` in common and differ in `numbers`."""
    keys = {path: value for path, value in values.items() if path not in SETTINGS}
    settings = {**plan.settings, **{name: value for name, value in values.items() if name in SETTINGS}}
    method = settings.pop("method", None) or default_method(plan.example, set(settings))
    if method != MONTE_CARLO:
        settings = {name: value for name, value in settings.items() if name not in OF_SAMPLES}
    kind = (method, "", "")
    try:
        mapping = put(plan.base, keys)
        unit = Scenario.from_mapping(put(mapping, dict.fromkeys(numbers, 1.0)), plan.scenario_name)
    except StochfuseError as error:
        failed = _Group.empty(size, 0, len(plan.columns), kind)
        failed.errors.update(dict.fromkeys(range(size), _reason(error)))
        return failed
    group = _Group.empty(size, unit.network.steps, len(plan.columns), kind)
    asked = _Points(plan, method, {"workers": 1, **settings}, mapping, unit, numbers, group)
    inside = _inside(numbers, size)
    rest = _batch(asked, np.flatnonzero(inside)) if inside.any() else np.arange(0)
    _by_noises(asked, np.union1d(rest, np.flatnonzero(~inside)))
    if MESSAGES in plan.quantities:
        _messages(asked)
    return group


def _reason(error: Exception) -> str:
    """Return what went wrong, on one line."""
    if isinstance(error, ScenarioError) and error.problems:
        return "; ".join(map(str, error.problems))
    text = str(error) if isinstance(error, StochfuseError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def _inside(numbers: Mapping[str, np.ndarray], size: int) -> np.ndarray:
    """Which points have numbers that a scenario takes; what is wrong with the others it says itself."""
    fine = np.ones(size, dtype=bool)
    for path, value in numbers.items():
        fine &= np.isfinite(value) & (value >= 0) & (value <= (1.0 if path == LINK else LARGEST))
        if path == R:
            fine &= value > 0
    return fine


def _batch(asked: _Points, items: np.ndarray) -> np.ndarray:
    """Evaluate items in one batch, or in as few as it takes to part those without an answer; return these."""
    unit, numbers, group = asked.unit, asked.numbers, asked.group

    def times(path: str, M: np.ndarray) -> np.ndarray | None:
        return numbers[path][items][:, None, None] * M if path in numbers else None

    if _alone(asked):
        return items
    common = _common_link(unit)
    constant = all(M.ndim == 2 for M in (unit.model.Q, *(s.R for s in unit.sensors)))
    if not constant or len(unit.sensors) != 1 or (LINK not in numbers and common is None):
        return items
    link = numbers[LINK][items] if LINK in numbers else np.full(len(items), common)
    noises = Noises(times(Q, unit.model.Q), times(R, unit.sensors[0].R), times(P0, unit.P0))
    try:
        rows = restricted(uniform_rows(link), unit.network)
        found = predict_items(unit, Items(rows, noises), asked.method, asked.quantities, **asked.settings)
        _fill(asked, found.predictions, items)
    except TooManyError as error:  # numbers have no say in that
        asked.fail(items, error)
        return items[:0]
    except Exception as error:
        without = items[list(error.items)] if isinstance(error, NoAnswerError) else items[:0]
        if len(without):
            asked.fail(without, error)
            parts = [np.setdiff1d(items, without)]
        elif len(items) == 1:
            return items
        else:
            parts = np.array_split(items, 2)
        return np.concatenate([items[:0], *(_batch(asked, part) for part in parts if len(part))])
    for place, reason in found.faults.items():
        group.errors[int(items[place])] = reason
    for nature in (nature for nature in NATURES if (found.natures == nature).any()):
        group.mark(items[found.natures == nature], (*_kind(asked, found.predictions)[:2], nature))
    return items[:0]


def _common_link(scenario: Scenario) -> float | None:
    """Link probability of a scenario that has one for all links and steps."""
    link = scenario.network.link
    return None if link is None or link.ndim or scenario.network.burst is not None else float(link)


def _by_noises(asked: _Points, items: np.ndarray) -> None:
    """Evaluate items, those of equal noises together."""
    numbers = asked.numbers
    noises = [path for path in numbers if path != LINK]
    for members in _alike([numbers[path][items] for path in noises], len(items)) if len(items) else []:
        some = items[members]
        possible = _inside({LINK: numbers[LINK][some]}, len(some)) if LINK in numbers else np.ones(len(some), bool)
        values = {path: float(numbers[path][some[0]]) for path in noises}
        if possible.any():
            _of_noises(asked, values, some[possible])
        for item in some[~possible]:
            try:
                asked.scenario({**values, LINK: float(numbers[LINK][item])})
            except StochfuseError as error:
                asked.fail(np.array([item]), error)


def _of_noises(asked: _Points, values: Mapping[str, float], items: np.ndarray) -> None:
    """Evaluate items of equal noises, together if that has an answer, else one by one."""
    try:
        # what its own link probability is does not matter: the items' are predicted
        scenario = asked.scenario({**values, LINK: 0.5} if LINK in asked.numbers else values)
    except StochfuseError as error:
        asked.fail(items, error)
        return
    if _alone(asked) or not _several(asked, scenario, items):
        for item in items:
            _several(asked, scenario, np.array([item]))


def _alone(asked: _Points) -> bool:
    """Whether the answer of a point depends on the company it is asked in."""
    return asked.method == MONTE_CARLO or bool(asked.settings.get("prune", False))


def _several(asked: _Points, scenario: Scenario, items: np.ndarray) -> bool:
    """Predict items of one scenario; what is wrong with a single one is its error."""
    links, rows = None, np.zeros(len(items), dtype=int)
    if LINK in asked.numbers:
        links, rows = np.unique(asked.numbers[LINK][items], return_inverse=True)
    try:
        # what the optimum claims is the optimum
        names = [OPTIMAL if asked.method == OPTIMAL and q == "claimed" else q for q in asked.quantities]
        different = list(dict.fromkeys(names))
        shown = ShownPart(metrics=tuple(map(asked.plan.metric, asked.plan.metrics)), agent=asked.plan.agent)
        several = predict_several(scenario, links, asked.method, different, **{**asked.settings, "shown": shown})
        found = [several[different.index(name)] for name in names]
        _fill(asked, found, items, rows)
    except Exception as error:
        if len(items) > 1:
            return False
        asked.fail(items, error)
        return True
    asked.group.mark(items, _kind(asked, found))
    for p in found:
        _check(p, rows, items, asked.group)
    return True


def _fill(
    asked: _Points, found: Sequence[Prediction], items: np.ndarray, rows: np.ndarray | slice = slice(None)
) -> None:
    """Write the value columns of items, and note what is not finite."""
    plan, group = asked.plan, asked.group
    for quantity, p in zip(asked.quantities, found, strict=True):
        for m in map(plan.metric, plan.metrics):
            name = f"{quantity}.{m.name}"
            values = p.values(m, plan.agent)[rows]
            group.values[items, :, plan.columns.index(name)] = values
            for place, step in np.argwhere(~np.isfinite(values)):
                reason = f"{quantity} {m.label} at step {step + 1} is not finite: it grows beyond floating point"
                group.errors.setdefault(int(items[place]), reason)
            if p.sampled is not None and name + ERROR in plan.columns:
                error = p.standard_error(m, plan.agent)
                if error is not None:
                    group.values[items, :, plan.columns.index(name + ERROR)] = error[rows]


def _kind(asked: _Points, found: Sequence[Prediction]) -> Kind:
    """Return method, estimator and nature of answers: of several quantities the nature of the least certain."""
    own = next((p for p in found if p.quantity != OPTIMAL), found[0])
    return asked.method, own.estimator, max((p.nature for p in found), key=NATURES.index)


def _check(p: Prediction, rows: np.ndarray, items: np.ndarray, group: _Group) -> None:
    """Note as its points' error what is no answer: an indefinite covariance, or one that is rounding."""
    if p.outcomes is not None and p.outcomes.rounding > WORTHLESS:
        group.errors.update(dict.fromkeys(items.tolist(), told(p.outcomes.rounding)))
    P = p.moments.P[rows]
    if covariance_fault(P) is None:
        return
    for item, first in zip(items, map(first_fault, P), strict=True):
        if first is not None:
            group.errors.setdefault(int(item), f"the covariance at step {first[0]} is {first[1]}")


def _messages(asked: _Points) -> None:
    """Write the expected message load, which depends on the network alone."""
    group, numbers = asked.group, asked.numbers
    column = asked.plan.columns.index(NODES)
    fine = np.setdiff1d(np.arange(len(group.what)), list(group.errors))
    if not len(fine):
        return
    links, rows = (None, np.zeros(len(fine), dtype=int))
    if LINK in numbers:
        links, rows = np.unique(numbers[LINK][fine], return_inverse=True)
    for (_, estimator, _), code in group.kinds.items():
        some = np.flatnonzero(group.what[fine] == code)
        if not len(some):
            continue
        try:
            load = _load(asked.unit, links, estimator, asked.plan.agent)
        except Exception as error:
            asked.fail(fine[some], error)
        else:
            group.values[fine[some], :, column] = load[rows[some]]


def _load(scenario: Scenario, links: np.ndarray | None, estimator: str, agent: int | str) -> np.ndarray:
    """Expected nodes that an agent receives in each step, (links, steps)."""
    rule = LFG if estimator in PEDIGREES else NAIVE
    load = message_load(scenario, links, rule)
    whose = agent if isinstance(agent, int) else "mean"
    each = np.stack([load.between(k, k).mean(whose) for k in map(int, load.steps)], axis=1)
    return 0.0 * each if estimator == STAND_ALONE else each
