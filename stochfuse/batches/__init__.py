"""Batches: many scenarios that differ in link probability and noises only, evaluated together.

Every method has its own module; `predict` is all of them by the names that users ask for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.batches import general, optimum, simplified
from stochfuse.engines.precision import PROMISED, told
from stochfuse.errors import NotABatchError
from stochfuse.kalman.checks import covariance_fault, first_fault
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction.predict import LFG, MOST_GRAPHS, group_of
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.model import Noises
from stochfuse.scenario.scenario import Scenario

WORTHLESS = 1e-3
"""Relative rounding beyond which it is no answer."""


class Batch(NamedTuple):
    """What became of a batch.

    Parameters
    ----------
    predictions : one per quantity, with the items in the place of link probabilities.
    natures : (items,) "exact" or "approximate".
    faults : reason why an item has no answer, by its place.
    """

    predictions: list[Prediction]
    natures: np.ndarray
    faults: dict[int, str]


class _Found(NamedTuple):
    moments: Moments
    group_of: np.ndarray
    estimator: str
    exact: np.ndarray
    faults: dict[int, str]


def predict(
    scenario: Scenario,
    link: np.ndarray,
    noises: Noises,
    method: str = "simplified",
    quantities: Sequence[str] = ("claimed",),
    **settings: Any,
) -> Batch:
    """Predict many scenarios that differ in link probability and noises only.

    Parameters
    ----------
    scenario : what they have in common.
    link : (items,) link probability of each, the same for all links and steps.
    noises : theirs, checked to be covariances.
    method, quantities, **settings : as for `stochfuse.prediction.predict.predict_several`.

    Returns
    -------
    Batch

    Raises
    ------
    NotABatchError
        If the method makes no batch of them.
    StochfuseError
        If some item has no answer and it is not known which.
    """
    if settings.get("prune"):
        raise NotABatchError("a batch: expected every outcome, got prune")
    ways = {q: "optimal" if q == "optimal" else method for q in quantities}
    found = {}
    for way in dict.fromkeys(ways.values()):
        asked = [q for q in quantities if ways[q] == way]
        found[way] = _found(scenario, link, noises, way, asked, settings)
    predictions = [_prediction(scenario, link, ways[q], q, found[ways[q]]) for q in quantities]
    natures = np.where(np.all([f.exact for f in found.values()], axis=0), "exact", "approximate")
    return Batch(predictions, natures, {k: v for f in found.values() for k, v in f.faults.items()})


def _found(
    scenario: Scenario, link: np.ndarray, noises: Noises, method: str, quantities: Sequence[str], settings: Any
) -> _Found:
    errors = bool(set(quantities) - {"claimed", "optimal"})
    if method == "simplified":
        if errors:
            raise NotABatchError(
                f"a batch by method simplified: expected quantity claimed, got {', '.join(quantities)}"
            )
        P, _, faults = simplified.covariances(scenario, link, noises)
        everyone = np.zeros(scenario.network.agents, dtype=int)
        return _Found(Moments(P[:, :, None]), everyone, "broadcast-prior", np.zeros(len(link), dtype=bool), faults)
    if method == "optimal":
        best = optimum.moments(scenario, link, noises, errors=errors)
        of, groups, estimator = best.moments, best.groups, "optimal"
        rounding = best.rounding
    elif method in ("general", "naive"):
        estimator = "naive" if method == "naive" else settings.get("estimator") or scenario.estimator or LFG
        graphs = settings.get("max_graphs", MOST_GRAPHS)
        every = general.moments(scenario, link, noises, estimator, errors=errors, max_graphs=graphs)
        of, groups = every.moments, every.groups
        rounding = every.rounding
    else:
        raise NotABatchError(f"a batch: expected method simplified, general, naive or optimal, got {method}")
    faults = {int(i): told(rounding[i]) for i in np.flatnonzero(rounding > WORTHLESS)}
    return _Found(of, group_of(groups), estimator, ~(rounding > PROMISED), {**_faults(of), **faults})


def _faults(moments: Moments) -> dict[int, str]:
    """Items with a matrix that is no covariance."""
    found = {}
    for name, M in (("claimed", moments.P), ("actual", moments.actual)):
        if M is None or covariance_fault(M) is None:
            continue
        for item, first in enumerate(map(first_fault, M)):
            if first is not None:
                found.setdefault(item, f"the {name} covariance at step {first[0]} is {first[1]}")
    return found


def _prediction(scenario: Scenario, link: np.ndarray, method: str, quantity: str, found: _Found) -> Prediction:
    return Prediction(
        scenario=scenario,
        method=method,
        quantity="optimal" if method == "optimal" and quantity == "claimed" else quantity,
        stage="posterior",
        nature="exact" if found.exact.all() else "approximate",
        link=link,
        cases=None,
        steps=np.arange(1, scenario.network.steps + 1),
        moments=found.moments,
        group_of=found.group_of,
        estimator=found.estimator,
    )
