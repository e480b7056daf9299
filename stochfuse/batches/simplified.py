"""The simplified stochastic formulation (54) for a batch of scenarios that differ in link probability and in noises.

All items have the model's F, the sensor's H, the network and the start in common; each has a link probability µ of its
own and, where they are given, its own Q, R and P(k0).  `stochfuse.engines.mean_field` carries them together, with one
constant matrix for all: what Q adds and what R whitens are arrays over the items.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stochfuse.engines.mean_field import BLOCK, Case, run_like
from stochfuse.engines.precision import definite, lost, rounding, told
from stochfuse.errors import UsageError
from stochfuse.kalman.averaged_update import noise_factor
from stochfuse.prediction import simplified
from stochfuse.scenario.model import Noises
from stochfuse.scenario.network import default_rows, require_memoryless, uniform_rows
from stochfuse.scenario.scenario import Scenario, require_independent_noise, require_one_state

DOUBTFUL = 1e-10
"""Smallest pivot of R, relative to its variance, below which it takes a library's word that there is a factor."""
WHO = "a batch of the simplified formulation"


class Covariances(NamedTuple):
    """Averaged posterior covariances of a batch.

    Parameters
    ----------
    P : (items, steps, d, d), in the units of the model; an item with a fault may have entries that are not finite.
    forms : which numeric forms were used.
    faults : per item whose result is no covariance, the first step and why; and of one that is, but of which rounding
        leaves less than nine digits (see `stochfuse.engines.precision`), by how much.
    """

    P: np.ndarray
    forms: tuple[str, ...]
    faults: dict[int, str]


def require_batch(scenario: Scenario) -> None:
    """Raise UsageError unless a scenario can be taken in a batch.

    Raises
    ------
    UsageError
        If agents have unlike sensors, states of their own or noises that hang together, or links that are delayed,
        bursty or missing.
    """
    network = scenario.network
    require_one_state(scenario, WHO)
    require_independent_noise(scenario, WHO)
    if len(scenario.sensors) > 1:
        raise UsageError(f"{WHO}: expected like agents, got {len(scenario.sensors)} kinds of sensors")
    if network.hears is not None:
        raise UsageError(f"{WHO}: expected agents that may hear all others, got network.hears")
    require_memoryless(default_rows(network), WHO, "one link probability per item stands for all its links and steps")
    simplified.require_prompt(network)


def covariances(scenario: Scenario, link: np.ndarray, noises: Noises) -> Covariances:
    """Evaluate (54) for every item of a batch and every step.

    Parameters
    ----------
    scenario : what the items have in common; its own link probabilities are not used.
    link : (items,) link probability of each item, for all its links and steps.
    noises : each item's own noises, which hold at all steps, checked by the caller: finite, symmetric, Q and P0
        positive semi-definite, R positive definite.

    Returns
    -------
    Covariances

    Raises
    ------
    UsageError
        If the scenario cannot be taken; see `require_batch`.
    """
    require_batch(scenario)
    steps, d = scenario.network.steps, scenario.model.dimension
    P, forms, faults = np.empty((steps, d, d, len(link))), set(), {}
    for first in range(0, len(link), BLOCK):
        block = np.s_[first : first + BLOCK]
        own, singular = _factorable(noises.take(block))
        case = simplified.like_case(scenario, uniform_rows(link[block]), own)
        _, cancelled = run_like(case, steps, P[..., block])
        forms |= simplified.forms_used(cancelled)
        found = _imprecise(case, np.flatnonzero(cancelled), P[..., block]) | simplified.faults(P[..., block]) | singular
        faults |= {first + item: why for item, why in found.items()}
    return Covariances(np.moveaxis(P, -1, 0), tuple(sorted(forms)), faults)


def _factorable(noises: Noises) -> tuple[Noises, dict[int, str]]:
    """Noises of which every R has a Cholesky factor, and why those have no answer that are there for others."""
    if noises.R is None:
        return noises, {}
    left = noise_factor(noises.R)[1]
    usable = left > 0
    doubtful = np.flatnonzero(usable & (left < DOUBTFUL))
    usable[doubtful] = definite(noises.R[doubtful])
    if usable.all():
        return noises, {}
    why = "R: expected a positive definite matrix, got one that is singular to rounding"
    R = np.where(usable[:, None, None], noises.R, np.eye(noises.R.shape[-1]))
    return noises._replace(R=R), dict.fromkeys(np.flatnonzero(~usable).tolist(), why)


def _imprecise(case: Case, items: np.ndarray, P: np.ndarray) -> dict[int, str]:
    """Those of some items of which rounding leaves too few digits."""
    if not items.size:
        return {}
    reach = rounding(case.take(items), P[..., items])
    return {int(item): told(error) for item, error in zip(items[lost(reach)], reach[lost(reach)], strict=True)}
