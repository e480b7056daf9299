"""What agents claim over all outcomes of a network, before any number: different claims and how likely each is.

Which messages arrive, what they have in common and how likely that is, as a polynomial in µ, depends on agents, links
and the kind of start alone,

    E[P(k)] = Σ_v w_v(µ) P_v(k)      P_v⁻¹ = Σ_atoms c · atom      w_v(µ) = Σ_c W_cv µ^c (1−µ)^(L−c)

over the *different* claims v: outcomes whose sums of information are the same sum are added up before any number is put
in (of three agents ad hoc, 48,236 claims of step 4 are 2,613).  What has been found is kept for the next batch.

Departure from `stochfuse.engines.enumeration`: terms of the inclusion–exclusion that cancel do so in the ledger, before
floating point sees them.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.enumeration import Ending, View
from stochfuse.engines.progress import uncollected
from stochfuse.estimators.ledger import Ledger
from stochfuse.estimators.world import batched
from stochfuse.prediction.general import Enumerated, enumerated
from stochfuse.scenario.model import Noises
from stochfuse.scenario.network import LinkRows, Network, restricted, uniform_rows
from stochfuse.scenario.scenario import Scenario

MOST_KEPT = 8
"""Structures kept for the batches to come."""
LISTED = 1 << 20
"""Terms of claims that are gone through at a time while different ones are told apart."""


def typical_rows(network: Network) -> LinkRows:
    """Return a row of links that all may succeed and may fail."""
    return restricted(uniform_rows([0.5]), network)


@dataclass(frozen=True)
class Key:
    """A scenario, and all of it that outcomes and what they have in common depend on; equal where that is.

    Parameters
    ----------
    structure : agents, links and starts without their numbers.
    scenario : one of those that have it.
    """

    structure: tuple[Hashable, ...]
    scenario: Scenario = field(compare=False)

    @classmethod
    def of(cls, scenario: Scenario) -> Key:
        """Return the key of a scenario."""
        network, kinds = scenario.network, (scenario.kind_of, scenario.sensor_of)
        links = (network.agents, network.steps, network.architecture, network.delay)
        hears = None if network.hears is None else network.hears.tobytes()
        return cls((*links, hears, *kinds, scenario.correlation), scenario)


class Step(NamedTuple):
    """Different claims of one step: as sums of atoms (claims, atoms), and weights (groups, L + 1, claims)."""

    sums: Any
    weights: np.ndarray


class Claims(NamedTuple):
    """Outcomes with equal claims added up.

    Parameters
    ----------
    atoms : of the ledger.
    values : what is brought forward in the atoms, as sums of atoms (values, atoms).
    steps : claims of every step.
    groups, states, outcomes : as in `stochfuse.batches.general.Found`.
    """

    atoms: list[tuple[str, int, int]]
    values: Any
    steps: list[Step]
    groups: tuple[tuple[int, ...], ...]
    states: list[int]
    outcomes: int


@lru_cache(maxsize=MOST_KEPT)
def claims_of(key: Key, estimator: str, errors: bool, max_graphs: int) -> Claims:
    """Return the claims of a scenario's outcomes; parameters and errors are those of
    `stochfuse.prediction.general.outcomes`.
    """
    # the first covariance is not used, and may be one that has no inverse
    plain = batched(key.scenario, Noises(P0=np.eye(key.scenario.model.dimension)))
    rows = typical_rows(key.scenario.network)
    found = enumerated(plain, rows, estimator, errors=errors, max_graphs=max_graphs, polynomial=True)
    ledger, structure = found.made.estimator.ledger, found.structure
    with uncollected():
        known = [_different(ending, found, ledger) for ending in structure.endings]
    values = _matrix(ledger, range(len(ledger.sums)))
    steps = [Step(values[ids], weights) for ids, weights in known]
    return Claims(ledger.atoms, values, steps, found.groups, structure.states, structure.outcomes[-1])


def _matrix(ledger: Ledger, values: Sequence[int]) -> Any:
    """Values as sums of atoms, a sparse matrix (values, atoms)."""
    from scipy.sparse import csr_array

    sums = [ledger.sums[value] for value in values]
    pairs = np.array([pair for sum_ in sums for pair in sum_], dtype=np.int64).reshape(-1, 2)
    first = np.cumsum([0, *map(len, sums)])
    return csr_array((pairs[:, 1].astype(float), pairs[:, 0], first), shape=(len(sums), len(ledger.atoms)))


def _different(ending: Ending, found: Enumerated, ledger: Ledger) -> tuple[np.ndarray, np.ndarray]:
    """Different claims of a step, as values of the ledger (claims,), and their weights (groups, L + 1, claims)."""
    place: dict[int, int] = {}
    weights = np.zeros((len(found.groups), ending.events + 1, 0))
    for view in ending.views:
        for states in _states(view, ending):
            rows, of = _rows(view, states)
            signs = _signs(view)
            values = [ledger.combine(ending.step, _terms(row, signs)) for row in rows.tolist()]
            claims = np.array([place.setdefault(value, len(place)) for value in values])
            here, at = np.unique(claims, return_inverse=True)
            parts = _weights(view, ending.weights[states], at[of], len(here), found.weights, ending.events)
            missing = len(place) - weights.shape[2]
            weights = np.concatenate([weights, np.zeros((*weights.shape[:2], missing))], axis=2)
            for group, part in parts:
                weights[group][:, here] += part
    return np.array(list(place)), weights


def _states(view: View, ending: Ending) -> Iterator[slice]:
    width = max(len(view.terms), ending.weights.shape[1])
    size = max(1, LISTED // (len(view.terms[0][1]) * width))
    return (slice(first, first + size) for first in range(0, len(view.ids), size))


def _signs(view: View) -> list[int]:
    return sorted(sign for sign, _ in view.terms)


def _rows(view: View, states: slice) -> tuple[np.ndarray, np.ndarray]:
    """Different (claims, terms), the terms in the order of `_signs`, and which of them each outcome has."""
    ids, by_sign = view.ids[states], []
    for sign in sorted({sign for sign, _ in view.terms}):
        by_sign.append(np.sort(np.stack([ids[:, index] for s, index in view.terms if s == sign], axis=-1), axis=-1))
    terms = np.concatenate(by_sign, axis=-1)
    rows, of = _unique_rows(terms.reshape(-1, terms.shape[-1]))
    return rows, of.reshape(terms.shape[:-1])


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different rows of integers, and which of them each row is."""
    # sorting one number for each row is many times faster than sorting rows; two rows hardly ever share theirs
    odd = np.random.default_rng(0).integers(1 << 62, size=rows.shape[1]) | 1
    _, first, of = np.unique(rows @ odd, return_index=True, return_inverse=True)
    if (rows[first[of]] == rows).all():
        return rows[first], of
    different, of = np.unique(rows, axis=0, return_inverse=True)
    return different, of.ravel()


def _terms(row: list[int], signs: list[int]) -> list[tuple[int, int]]:
    return [(value, sign) for value, sign in zip(row, signs, strict=True) if value >= 0]


def _weights(
    view: View, states: np.ndarray, of: np.ndarray, claims: int, weights: Any, events: int
) -> list[tuple[int, np.ndarray]]:
    """Weights (L + 1, claims) by group of agents, of outcomes (states, cells) whose claims are numbered."""
    from scipy.sparse import coo_array

    factors, degrees = len(view.factors), states.shape[1]
    factor = np.repeat(np.arange(factors), np.diff([*view.starts, of.shape[1]]))
    state = np.broadcast_to(np.arange(len(of))[:, None], of.shape)
    where = ((factor * claims + of).ravel(), state.ravel())
    count = coo_array((np.ones(of.size), where), shape=(factors * claims, len(of))).tocsr()
    # Σ over states, by their degree; a degree is then as a state with that one weight
    by_degree = np.moveaxis((count @ states).reshape(factors, claims, degrees), -1, 0)
    total = weights.total(np.eye(degrees), view.factors, by_degree)
    shares = [(group, share) for group, share in enumerate(view.shares) if share is not None]
    return [(group, weights.completed(weights.weighed(total, share), events)) for group, share in shares]
