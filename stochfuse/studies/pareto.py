"""Which points of a study pay: accuracy against message load, both as small as can be (Pareto).

A point i is dominated if another one j is nowhere worse and somewhere better:

    a_j ≤ a_i,  b_j ≤ b_i,  (a_j, b_j) ≠ (a_i, b_i)

The front is what nobody dominates (Kung, Luccio and Preparata 1975: sorted by a, a point is on it if its b is below all
b before).  Points of equal costs do not dominate each other: all of them are kept.  A front of fronts is the front of
the whole, so that a study is gone through block by block, with one block and the front so far in memory.

Departure from the source: costs of a study that agree to 40 bits (12 digits) count as equal, so that not rounding
decides who is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.scenario.registry import BROADCAST_PRIOR, LFG, OPTIMAL, STAND_ALONE
from stochfuse.studies.plan import ERROR, NODES, Plan

if TYPE_CHECKING:
    from stochfuse.studies.files import Results

COSTS = ("claimed", "actual", OPTIMAL, "rms")
"""Quantities of which less is better."""
COMPARED_BITS = 40
TRUTHFUL = (BROADCAST_PRIOR, LFG, OPTIMAL, STAND_ALONE)
"""Estimators that claim what they achieve, as far as their method is exact."""


def front(cost_a: np.ndarray, cost_b: np.ndarray) -> np.ndarray:
    """Return the indices of the points that no other one dominates, in O(n log n).

    Parameters
    ----------
    cost_a, cost_b : (n,) finite numbers, both the better the smaller.

    Returns
    -------
    ndarray
        Indices by rising a (b falls); points with equal costs are all kept, in their order.

    Raises
    ------
    ValueError
        If the shapes do not agree or a cost is not finite.
    """
    a, b = np.asarray(cost_a, dtype=float), np.asarray(cost_b, dtype=float)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"front: expected two lists of costs of one length, got shapes {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("front: expected finite costs, got NaN or infinity")
    if not len(a):
        return np.empty(0, dtype=np.intp)
    order = np.lexsort((b, a))
    a, b = a[order], b[order]
    least_before = np.concatenate([[np.inf], np.minimum.accumulate(b)[:-1]])
    fresh = np.concatenate([[True], (a[1:] != a[:-1]) | (b[1:] != b[:-1])])
    # a group of equal points is on the front if its first one is
    return order[(b < least_before)[fresh][np.cumsum(fresh) - 1]]


def rounded(costs: np.ndarray) -> np.ndarray:
    """Return numbers rounded to `COMPARED_BITS` significant bits."""
    mantissa, exponent = np.frexp(np.asarray(costs, dtype=float))
    return np.ldexp(np.rint(np.ldexp(mantissa, COMPARED_BITS)), exponent - COMPARED_BITS)


@dataclass(frozen=True)
class Front:
    """The front of what was added so far; memory: the front itself.

    Parameters
    ----------
    a, b : (n,) costs of its points, by rising a.
    columns : what else is known of them, (n,) each.
    seen : number of points added.
    """

    a: np.ndarray = field(default_factory=lambda: np.empty(0))
    b: np.ndarray = field(default_factory=lambda: np.empty(0))
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    seen: int = 0

    def add(self, a: np.ndarray, b: np.ndarray, columns: Mapping[str, np.ndarray]) -> Front:
        """Return the front of its points and further ones; costs that agree to `COMPARED_BITS` count as equal."""
        inside = front(rounded(a), rounded(b))
        a, b = np.concatenate([self.a, a[inside]]), np.concatenate([self.b, b[inside]])
        kept = front(rounded(a), rounded(b))
        joined = {
            name: np.concatenate([self.columns[name], values[inside]]) if self.columns else values[inside]
            for name, values in columns.items()
        }
        return Front(
            a[kept], b[kept], {name: values[kept] for name, values in joined.items()}, self.seen + len(columns["point"])
        )


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """The points of a study that no other one beats in both accuracy and message load.

    Parameters
    ----------
    column : the value column that is the accuracy, in the sense that less is better.
    step : the step at which it is taken, or None for each point's last.
    points, steps : (n,) their numbers and steps, by rising load.
    keys : their values of every varied key.
    accuracy, load : (n,) the two costs; the load is the mean over all steps of a point.
    error : (n,) standard errors of the accuracy, NaN where it is not sampled, or None where nothing is.
    method, estimator, nature : (n,) how they were predicted.
    compared : how many points were compared.
    notes : what the reader must know to compare them.
    fixed : values of keys that all compared points have.
    """

    column: str
    step: int | None
    points: np.ndarray
    steps: np.ndarray
    keys: Mapping[str, np.ndarray]
    accuracy: np.ndarray
    load: np.ndarray
    error: np.ndarray | None
    method: np.ndarray
    estimator: np.ndarray
    nature: np.ndarray
    compared: int
    notes: tuple[str, ...] = ()
    fixed: Mapping[str, Any] = field(default_factory=dict)

    def there(self, block: Mapping[str, np.ndarray]) -> np.ndarray:
        """Which points of a block of results, with "point" and the keys, have the fixed values."""
        return holds(self.fixed, block)


def holds(fixed: Mapping[str, Any], block: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which points of a block of results have some values."""
    there = np.ones(len(block["point"]), dtype=bool)
    for name, value in fixed.items():
        there &= block[name] == value
    return there


def pareto(
    results: Results, column: str | None = None, step: int | None = None, fixed: Mapping[str, Any] | None = None
) -> ParetoFront:
    """Find the points of a study that no other one beats in both accuracy and message load.

    Parameters
    ----------
    results : of a study with "messages" among its quantities.
    column : the accuracy, a value column of claimed, actual, optimal or rms; default: the first.
    step : where the accuracy is taken; default: each point's last step.
    fixed : values of keys: only points that have them are compared.

    Returns
    -------
    ParetoFront
        By rising load, so that the accuracy gets better from row to row; points of equal costs are all there.

    Raises
    ------
    UsageError
        If the study has no message load, no such column, or no such step.
    NoAnswerError
        If all points failed.
    """
    plan = results.plan
    if NODES not in plan.columns:
        raise UsageError(
            f"report.quantity: expected messages among them for --pareto, got {', '.join(plan.quantities)}"
        )
    column = accuracy_column(plan, column)
    keys = tuple(axis.name for axis in plan.axes)
    error = column + ERROR if column + ERROR in plan.columns else None
    asked = {"point", "step", *keys, "method", "estimator", "nature", column, *([error] if error else [])}
    found = Front()
    loads = results.mean_over_steps(NODES)
    for block, load in zip(results.blocks(sorted(asked), step), loads, strict=True):
        if len(load) != len(block["point"]):
            raise UsageError(f"step: expected a step that every point has, got {step}")
        some = holds(fixed or {}, block)
        found = found.add(load[some], block[column][some], {name: values[some] for name, values in block.items()})
    if not found.seen:
        if step is not None and results.rows:
            raise UsageError(f"step: expected a step that every point has, got {step}")
        where = " where the keys are so" if fixed else ""
        raise NoAnswerError(f"no point of the study has a value{where}: {results.failed} failed")
    at = found.columns
    return ParetoFront(
        column,
        step,
        at["point"],
        at["step"],
        {key: at[key] for key in keys},
        found.b,
        found.a,
        at[error] if error else None,
        at["method"],
        at["estimator"],
        at["nature"],
        found.seen,
        _notes(column, at),
        dict(fixed or {}),
    )


def accuracy_column(plan: Plan, column: str | None = None) -> str:
    """Return the value column that is the accuracy.

    Raises
    ------
    UsageError
        If there is none, or none of that name.
    """
    possible = [c for c in plan.columns if c.partition(".")[0] in COSTS and not c.endswith(ERROR)]
    if not possible:
        got = ", ".join(plan.quantities)
        raise UsageError(f"report.quantity: expected {', '.join(COSTS[:-1])} or {COSTS[-1]} for --pareto, got {got}")
    if column is not None and column not in possible:
        raise UsageError(f"column: expected {' or '.join(possible)}, got {column}")
    return column or possible[0]


def _notes(column: str, at: Mapping[str, Any]) -> tuple[str, ...]:
    """What makes points of the front unlike."""
    methods, natures = (sorted(set(at[name].tolist())) for name in ("method", "nature"))
    estimators = sorted(set(at["estimator"].tolist()))
    notes = []
    if len(methods) > 1:
        notes.append(
            f"the front compares unlike things: its points are of methods {', '.join(methods)} ({', '.join(natures)})"
        )
    elif len(natures) > 1:
        notes.append(f"the front compares unlike things: its points are {', '.join(natures)}")
    doubtful = [name for name in estimators if name not in TRUTHFUL]
    if column.startswith("claimed") and doubtful:
        notes.append(
            f"claimed is what an estimator believes of itself, which is not what {', '.join(doubtful)} achieves: "
            "report quantity actual as well"
        )
    if "sampled" in natures:
        notes.append("sampled values scatter: the luckier of two equal points is on the front")
    return tuple(notes)
