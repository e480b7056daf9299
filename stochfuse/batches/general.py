"""The general stochastic formulation (44)–(49) of many scenarios that differ in link probability and noises only.

    E[P(k)] = Σ_v w_v(µ) P_v(k)

over the different claims v, which are found once (`stochfuse.batches.claims`).  Then every item's atoms, claims and
weights are worked out side by side, each item's claims weighed at its own µ; items with the same noises share theirs.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.batches.claims import Claims, Key, Step, claims_of
from stochfuse.engines.events import monomials
from stochfuse.engines.precision import NO_DIGIT, MovedSources, change, reach, suspects
from stochfuse.errors import NoAnswerError, NotABatchError, StochfuseError
from stochfuse.estimators.ledger import Sources, estimated, evaluate_atoms, unpacked
from stochfuse.estimators.making import SUMS, make
from stochfuse.estimators.world import batched, claimed_only, error_sources, sources_of
from stochfuse.estimators.world import moments as of_footprints
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.metrics import Moments
from stochfuse.scenario.model import Noises
from stochfuse.scenario.scenario import Scenario

BLOCK = 1 << 20
"""Numbers that the atoms of a block of items take."""
CHUNK = 1 << 18
"""Numbers that the claims worked on at a time take."""


class Found(NamedTuple):
    """Expected moments of a batch.

    Parameters
    ----------
    moments : (items, steps, groups, …).
    groups : agents that are alike.
    rounding : (items,) how far rounding may reach in an expected covariance, relative to the standard deviations.
    states : number of graphs carried before each step's exchange.
    outcomes : number of outcomes.
    """

    moments: Moments
    groups: tuple[tuple[int, ...], ...]
    rounding: np.ndarray
    states: list[int]
    outcomes: int


def moments(
    scenario: Scenario,
    link: np.ndarray,
    noises: Noises,
    estimator: str = "local-fusion-graph",
    *,
    errors: bool = False,
    max_graphs: int = 100_000,
) -> Found:
    """Return the expected moments of the error for many scenarios that differ in link probability and noises.

    Parameters
    ----------
    scenario : what they have in common.
    link : (items,) link probability of each, the same for all links and steps.
    noises : theirs, checked to be covariances.
    estimator : "local-fusion-graph", "naive" or "optimal".
    errors : whether actual covariance, bias and mean squared error are wanted too.
    max_graphs : states that may be carried from step to step.

    Raises
    ------
    NotABatchError
        If they cannot be evaluated together: another estimator, links that differ or are bursty, unlike sensors with
        noises R of their own, a number that is not finite.
    UsageError, NoAnswerError
        As `stochfuse.prediction.general.outcomes`, if that would raise it for one item; a NoAnswerError names such
        items, if not all of them.
    """
    check_batch(scenario, link, noises)
    if estimator not in SUMS:
        raise NotABatchError(f"a batch by method general: expected estimator {', '.join(SUMS)}, got '{estimator}'")
    if errors and noises.R is not None and scenario.noise is not None and scenario.noise.disturbance is not None:
        raise NotABatchError(
            "a batch of actual errors with noises R of their own: expected no noise.disturbance, got one"
        )
    noises = with_starts(scenario, noises, len(link))
    # what the estimator does not take it says of any item
    first = Noises(*(None if M is None else M[0] for M in noises))
    make(batched(scenario, first), estimator, errors=errors)
    claims = claims_of(Key.of(scenario), estimator, errors, max_graphs)
    # items with the same noises side by side, so that a block of them has few different ones
    order = np.argsort(_distinct(noises)[1], kind="stable")
    blocks = _blocks(claims, scenario, order, errors)
    found = []
    for some in blocks:
        try:
            found.append(_block(claims, scenario, link[some], noises.take(some), errors))
        except NoAnswerError as error:
            raise NoAnswerError(str(error), some[list(error.items)].tolist()) from None
    parts, rounding = zip(*found, strict=True)
    back = np.argsort(order)
    joined = [None if m[0] is None else np.concatenate(m)[back] for m in zip(*parts, strict=True)]
    if not all(m is None or np.isfinite(m).all() for m in joined):
        raise NotABatchError("a batch by method general: expected finite moments, got one that is not")
    return Found(Moments(*joined), claims.groups, np.concatenate(rounding)[back], claims.states, claims.outcomes)


def check_batch(scenario: Scenario, link: np.ndarray, noises: Noises) -> None:
    """Raise NotABatchError if scenarios cannot be told apart by one link probability and common noises each."""
    network = scenario.network
    if link.ndim != 1:
        raise NotABatchError(
            f"a batch: expected one link probability for each item, got an array of shape {link.shape}"
        )
    if network.burst is not None or any(burst is not None for burst in network.case_bursts):
        raise NotABatchError("a batch: expected links without memory, got network.burst")
    if noises.R is not None and len(scenario.sensors) > 1:
        raise NotABatchError(
            "a batch with noises R of their own: expected like sensors, got unlike ones ([[agent]] H, R)"
        )


def with_starts(scenario: Scenario, noises: Noises, items: int) -> Noises:
    """Return the noises with first covariances, the scenario's where there are none."""
    P0 = scenario.P0 if noises.P0 is None else noises.P0
    return noises._replace(P0=np.broadcast_to(P0, (items, *scenario.P0.shape)))


def _distinct(noises: Noises) -> tuple[Noises, np.ndarray]:
    """Return the different ones among the noises of items, and which of them each item has."""
    flat = np.concatenate([M.reshape(len(M), -1) for M in noises if M is not None], axis=1)
    _, first, of = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    return noises.take(first), of.ravel()


def _blocks(claims: Claims, scenario: Scenario, order: np.ndarray, errors: bool) -> list[np.ndarray]:
    size = max(1, BLOCK // (len(claims.atoms) * _numbers(scenario, errors)))
    return [order[first : first + size] for first in range(0, len(order), size)]


def _numbers(scenario: Scenario, errors: bool) -> int:
    """How many numbers information and footprint of one value take."""
    d, steps = scenario.model.dimension, scenario.network.steps
    p = sum(scenario.sensors[kind].H.shape[-2] for kind in scenario.sensor_of)
    return d * (d + errors * (scenario.network.agents * d + (steps - 1) * (d + p) + 1))


def _block(
    claims: Claims, scenario: Scenario, link: np.ndarray, noises: Noises, errors: bool
) -> tuple[Moments, np.ndarray]:
    """Moments (items, steps, groups, …), and how far rounding may reach in each item."""
    different, of = _distinct(noises)
    try:
        found, magnified = _over_claims(claims, link, of, _sources(scenario, different, errors), errors)
    except NoAnswerError as error:
        raise NoAnswerError(str(error), np.flatnonzero(np.isin(of, error.items)).tolist()) from None
    far, suspect = 2e-16 * magnified, np.flatnonzero(suspects(scenario, different)[of])
    if len(suspect):
        theirs = Moments(*(None if m is None else m[suspect] for m in found))
        again = partial(_changes, claims, scenario, link[suspect], noises.take(suspect), errors, theirs)
        far[suspect] = np.maximum(far[suspect], reach(again))
    return found, far


def _changes(
    claims: Claims, scenario: Scenario, link: np.ndarray, noises: Noises, errors: bool, found: Moments, seed: int
) -> np.ndarray:
    """By how much moved numbers change each item's moments, (items,)."""
    different, of = _distinct(noises)
    try:
        moved, _ = _over_claims(claims, link, of, MovedSources(_sources(scenario, different, errors), seed), errors)
    except (StochfuseError, np.linalg.LinAlgError):
        if len(link) == 1:
            return np.array([NO_DIGIT])
        # halves, until those are found of which no digit is left
        half = len(link) // 2
        parts = []
        for some in (np.s_[:half], np.s_[half:]):
            theirs = Moments(*(None if m is None else m[some] for m in found))
            parts.append(_changes(claims, scenario, link[some], noises.take(some), errors, theirs, seed))
        return np.concatenate(parts)
    pairs = [(found.P, moved.P), (found.actual, moved.actual), (found.square, moved.square)]
    return np.max([change(P, M).max(axis=(1, 2)) for P, M in pairs if P is not None and M is not None], axis=0)


def _sources(scenario: Scenario, noises: Noises, errors: bool) -> Sources:
    return error_sources(scenario, noises) if errors else sources_of(batched(scenario, noises))


def _over_claims(
    claims: Claims, link: np.ndarray, of: np.ndarray, sources: Sources, errors: bool
) -> tuple[Moments, np.ndarray]:
    """Moments (items, steps, groups, …), and by how much rounding grew in the last inversion of each item.

    Parameters
    ----------
    of : which item of the sources each has.
    """
    atoms = evaluate_atoms(claims.atoms, sources, lambda values, atoms: _sums(claims.values[values], atoms))
    magnified, steps = np.ones(len(atoms[0])), []
    for number, step in enumerate(claims.steps, start=1):
        expected: list[Any] = [None] * len(Moments._fields)
        probability = monomials(step.weights.shape[1] - 1, link)
        for some in _chunks(step, atoms[0].size * len(link) // len(magnified)):
            estimate, grown = _claimed(step.sums[some], atoms, sources, number)
            magnified = np.maximum(magnified, grown)
            weights = probability @ step.weights[:, :, some]
            for place, value in enumerate((of_footprints if errors else claimed_only)(estimate)):
                if value is not None:
                    part = np.einsum("giv,vi...->ig...", weights, value[:, of])
                    expected[place] = part if expected[place] is None else expected[place] + part
        steps.append(expected)
    stacked = [None if m[0] is None else np.stack(m, axis=1) for m in zip(*steps, strict=True)]
    return Moments(*stacked), magnified[of]


def _chunks(step: Step, numbers: int) -> list[slice]:
    """Claims, of which each takes so many numbers, a few at a time."""
    claims = step.sums.shape[0]
    size = max(1, CHUNK // numbers)
    return [slice(first, min(first + size, claims)) for first in range(0, claims, size)]


def _sums(sums: Any, atoms: np.ndarray) -> np.ndarray:
    return (sums @ atoms.reshape(len(atoms), -1)).reshape(-1, *atoms.shape[1:])


def _claimed(sums: Any, atoms: np.ndarray, sources: Sources, step: int) -> tuple[Estimate, np.ndarray]:
    estimate, grown = estimated(unpacked(_sums(sums, atoms), sources), step)
    return estimate, grown.max(axis=(0, -1))
