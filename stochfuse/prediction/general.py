"""The general stochastic formulation, thesis (44)–(49): every outcome, every common prior, exactly.

    (49)  E[P(k)] = Σ_S µ_S µ_¬S P_S(k)        (48)  E[x̂(k)] = Σ_S µ_S µ_¬S x̂_S(k)

over the outcomes S of "which messages arrive, in all steps up to k", (45)/(46).  P_S and x̂_S are what the estimator
claims in that outcome: the Local Fusion Graph, or naive fusion (42)/(43), or any other.  With one µ for all links,

    E[P(k)](µ) = Σ_c A_c µ^c (1−µ)^(L−c) = Σ_v w_v(µ) P_v(k)

is a polynomial; its weights w_v over the different claims v depend on agents and links alone, are found once and kept,
and serve every µ, Q, R and P(k0).  With unequal µ_ij(k) every row of link probabilities has weights of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.distribution import Distribution, parse_statistic
from stochfuse.engines.enumeration import Claimed, Request, Structure, claims_of, enumerate_outcomes
from stochfuse.engines.events import (
    MOST_AGENTS_RELABELLED,
    Rows,
    Weights,
    bernstein,
    bursty,
    events,
    monomials,
    orbits,
    relabellings,
    some_relabellings,
    weights_for,
)
from stochfuse.engines.precision import NO_DIGIT, PROMISED, MovedSources, change, moved_claims, notes, reach, suspects
from stochfuse.errors import NoAnswerError, StochfuseError, TooManyError, UsageError
from stochfuse.estimators.ledger import InformationClaims, evaluate
from stochfuse.estimators.making import kinds_of, make, sources
from stochfuse.estimators.progress import listener
from stochfuse.estimators.protocol import Claims, Made
from stochfuse.estimators.world import claimed_only, moments
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction.method import Averaged, Settings, group_of, joined
from stochfuse.prediction.quantities import linear, matrix, number, value
from stochfuse.scenario.network import LinkRows, Network, number_of_senders, restricted, uniform_rows
from stochfuse.scenario.registry import SUMS
from stochfuse.scenario.system import Items, Noises, System

MOST_PROBABILITIES = 20_000_000
"""Probabilities that a distribution may hold at a time."""
MOST_SENDERS, MOST_DRAWN = 12, 1000
"""Agents that one of them may hear in a step, and links in all, up to which outcomes are listed."""
KEPT = 8
"""Structures kept for what is asked next."""
HELD = 1 << 24
"""Weights of claims that are held, and not found again when they are needed again."""
CHUNK = 1 << 17
"""Numbers of estimates that are worked on at a time: few enough to stay in the cache."""
BLOCK = 1 << 20
"""Numbers that the values of a block of items take."""


class Spread(NamedTuple):
    """What is averaged of estimates on data: x (..., d, 1), their squares x xᵀ and P."""

    x: np.ndarray
    square: np.ndarray
    P: np.ndarray


def spread(estimate: Estimate) -> Spread:
    """Average estimates and their squares."""
    return Spread(estimate.x, estimate.x @ np.swapaxes(estimate.x, -1, -2), estimate.P)


def itself(estimate: Estimate) -> Estimate:
    """Average estimates as they are."""
    return estimate


@dataclass(eq=False)
class Enumerated:
    """All outcomes of a system before any number is put in.

    Parameters
    ----------
    groups : agents that are alike.
    structure : the outcomes.
    made : the estimator that has written them down.
    weights : bookkeeping of probabilities.
    """

    groups: tuple[tuple[int, ...], ...]
    structure: Structure
    made: Made
    weights: Weights
    _held: dict[int, list[Claimed]] = field(default_factory=dict)

    @property
    def polynomial(self) -> bool:
        """Whether weights are polynomials in one link probability."""
        return not isinstance(self.weights, Rows)

    @cached_property
    def signatures(self) -> np.ndarray | None:
        """Numbers by which equal sums of values are told."""
        return self.made.estimator.ledger.signatures() if self.made.estimator.additive else None

    def claims(self, step: int) -> Iterable[Claimed]:
        """Different claims of a step with their weights."""
        if step not in self._held:
            found = claims_of(self.structure.endings[step - 1], self.signatures, self.weights)
            held, numbers = [], 0
            for block in found:
                held.append(block)
                numbers += (0 if block.which is None else block.which.size // 2) + block.number * block.width
                if numbers > HELD:
                    return _rest(held, found)
            self._held[step] = held
        return self._held[step]

    def shared_out(self, step: int, values: Claims) -> Iterator[tuple[np.ndarray, Any, Any]]:
        """Claims of a step in numbers, some at a time: weights (groups, width, claims), estimates, and by how much
        rounding grew in them.
        """
        for block in self.claims(step):
            for some, estimate, grown in in_numbers(block, values, step):
                yield block.shared(block.total[:, some]), estimate, grown


def in_numbers(block: Claimed, values: Claims, step: int) -> Iterator[tuple[slice, Any, Any]]:
    """Estimates of some claims of a step at a time, and by how much rounding grew in them."""
    size = max(1, CHUNK // values.width)
    for first in range(0, block.number, size):
        some = slice(first, first + size)
        terms = [(sign, ids[some]) for sign, ids in block.terms]
        if block.view.always is not None:
            terms.append((1, np.array([block.view.always])))
        yield some, *values.estimate(terms, step)


def _rest(held: list[Claimed], found: Iterator[Claimed]) -> Iterator[Claimed]:
    yield from held
    yield from found


@dataclass(frozen=True, eq=False)
class Outcomes:
    """All outcomes of a system with what is claimed in each.

    Parameters
    ----------
    system, links : what was given, with one set of noises.
    found : the outcomes.
    errors : whether the moments of the actual error are averaged, or the estimates as they are.
    records : measurements, where states are wanted.
    """

    system: System
    links: LinkRows
    found: Enumerated
    errors: bool = False
    records: np.ndarray | None = None

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Agents that are alike, as sorted tuples."""
        return self.found.groups

    @property
    def structure(self) -> Structure:
        """The outcomes."""
        return self.found.structure

    @property
    def polynomial(self) -> bool:
        """Whether the expectation is a polynomial in one link probability."""
        return self.found.polynomial

    @cached_property
    def common(self) -> np.ndarray:
        """Link probability µ of each row, of a polynomial, (rows,)."""
        µ = self.links.common(self.system.network)
        if µ is None:
            raise TypeError("links that differ have no common probability")
        return µ

    @cached_property
    def values(self) -> Claims:
        """Numbers for every value in the structure."""
        return self.found.made.claims(self.system, Noises())

    @property
    def _of(self) -> Callable[[Estimate], Any]:
        return moments if self.errors else itself if self.records is None else spread

    @cached_property
    def expectations(self) -> list[list[Any]]:
        """Expected estimate or moments per step and group of agents, on the weights' axis (coefficients A_c, or rows).

        Where outcomes were left out: given that the outcome is one of those that were not.
        """
        return [found for found, _ in self._expected]

    @cached_property
    def _expected(self) -> list[tuple[list[Any], float]]:
        return self._expectations(self.values)

    def _expectations(self, values: Claims) -> list[tuple[list[Any], float]]:
        found, steps = [], self.system.steps
        for step in range(1, steps + 1):
            found.append(_expectation(self.found.claims(step), values, step, self._of))
            listener().advance("averaging", step, steps)
        return found

    @cached_property
    def rounding(self) -> float:
        """How far rounding may reach in an expected covariance at any link probability, relative to the deviations.

        The larger of what the last inversion of an outcome's information loses, and what moved numbers change.
        """
        lost = 2e-16 * max(magnified for _, magnified in self._expected)
        again = self._again()
        return max(lost, float(reach(lambda seed: self._change(again[seed]()), len(again))))

    def _again(self) -> Sequence[Callable[[], Claims]]:
        """What the values claim with moved numbers, to be called for; of pasts it is not known."""
        estimator = self.found.made.estimator
        if not hasattr(estimator, "ledger"):
            return ()
        return moved_claims(
            self.system, estimator.ledger, partial(sources, self.system, Noises(), self.errors, self.records)
        )

    def _change(self, values: Claims) -> float:
        """Largest change of an expected covariance if the values claimed others."""
        quantities = ("claimed", "actual", "rms") if self.errors else ("claimed",)
        pairs = zip(self._expected, self._expectations(values), strict=True)
        groups = [pair for (found, _), (moved, _) in pairs for pair in zip(found, moved, strict=True)]
        return max(float(change(matrix(q, a), matrix(q, b)).max()) for q in quantities for a, b in groups)

    def coefficients(self, step: int, group: int = 0, quantity: str = "claimed") -> np.ndarray:
        """A_0 … A_L of E[P(step)](µ) = Σ A_c µ^c (1−µ)^(L−c), shape (L + 1, d, d); or of another quantity's matrix.

        Raises
        ------
        UsageError
            If links differ, so that there is no single µ.
        """
        self._require_polynomial()
        return matrix(quantity, self.expectations[step - 1][group])

    def _require_polynomial(self) -> None:
        if not self.polynomial:
            raise UsageError(
                "a polynomial in µ: expected one link probability for all links and steps, and every outcome; got "
                "links that differ, none at all, or outcomes left out"
            )

    def covariance(self, link: np.ndarray | None = None, quantity: str = "claimed") -> np.ndarray:
        """Expected covariance, (rows, steps, groups, d, d), at the rows or, of a polynomial, at some link
        probabilities.  Another quantity: its matrix, see `stochfuse.prediction.quantities.matrix`.

        Raises
        ------
        UsageError
            If link probabilities are given and there is no polynomial.
        """
        if link is not None:
            self.coefficients(1)
        return self._stacked([[self._at(matrix(quantity, e), link) for e in step] for step in self.expectations])

    def moments(self, link: np.ndarray | None = None) -> Moments:
        """Expected moments of the error that were averaged, (rows, steps, groups, …), where `covariance` has them."""
        if not self.errors:
            return Moments(self.covariance(link))
        return Moments(*(self.covariance(link, q) for q in ("claimed", "actual", "bias", "rms")))

    def states(self) -> np.ndarray:
        """Expected state estimates, (rows, steps, groups, d, 1), (48)."""
        return self._stacked([[self._at(e.x, None) for e in step] for step in self.expectations])

    def state_spread(self) -> np.ndarray:
        """Covariance of the state estimates over the outcomes, (rows, steps, groups, d, d)."""
        square = self._stacked([[self._at(e.square, None) for e in step] for step in self.expectations])
        x = self.states()
        return square - x @ np.swapaxes(x, -1, -2)

    def _stacked(self, by_step: list[list[np.ndarray]]) -> np.ndarray:
        stacked = np.stack([np.stack(by_group, axis=1) for by_group in by_step], axis=1)
        return stacked if self.polynomial else stacked / self._kept[:, :, None, None, None]

    def derivative(self, quantity: str = "claimed") -> np.ndarray:
        """dE[P]/dµ at the scenario's rows, (rows, steps, groups, d, d); or of another quantity's matrix."""
        self._require_polynomial()
        µ, out = self.common, []
        for step in range(1, len(self.expectations) + 1):
            by_group = []
            for group in range(len(self.groups)):
                A = self.coefficients(step, group, quantity)
                L = len(A) - 1
                c = np.arange(L + 1).reshape(-1, 1, 1)
                # d/dµ Σ A_c µ^c (1−µ)^(L−c), by Bernstein's form of degree L − 1
                slope = (c * A)[1:] - ((L - c) * A)[:-1] if L else np.zeros((1, *A.shape[1:]))
                by_group.append(bernstein(slope, max(L - 1, 0), µ))
            out.append(np.stack(by_group, axis=1))
        return np.stack(out, axis=1)

    @property
    def left_out(self) -> np.ndarray:
        """Probability of the outcomes left out, (rows, steps)."""
        return 1.0 - self._kept if not self.polynomial else np.zeros((len(self.common), self.system.steps))

    @cached_property
    def _kept(self) -> np.ndarray:
        """Probability of the outcomes that were not left out, (rows, steps)."""
        steps = range(1, self.system.steps + 1)
        by_step = [sum(b.expected(np.ones((1, b.number)))[0, :, 0] for b in self.found.claims(step)) for step in steps]
        return np.stack(by_step, axis=1)

    def statistic(self, name: str, metric: Metric, groups: Sequence[int], quantity: str = "claimed") -> np.ndarray:
        """Return a statistic of a metric over the outcomes, (rows, steps).

        Parameters
        ----------
        name : "variance", "std", "quantile:P", "at-most:LIMIT" or "derivative" (of the expected metric, in µ).
        groups : groups of agents, each agent as likely as every other.
        quantity : what the metric is taken of, in each outcome.

        Raises
        ------
        UsageError
            If there is no such statistic, or it cannot be had of this metric.
        """
        kind, argument = check_statistic(name, quantity, metric)
        share = [len(self.groups[g]) for g in groups]
        if kind == "derivative":
            slope = np.average(self.derivative(quantity)[:, :, groups], axis=2, weights=share)
            return number(quantity, metric, slope)
        of: dict[str, Callable[[Distribution], np.ndarray]] = {
            "variance": Distribution.variance,
            "std": lambda spread: np.sqrt(spread.variance()),
            "quantile": lambda spread: spread.quantile(argument),
            "at-most": lambda spread: spread.at_most(argument),
        }
        return self.over_outcomes(metric, groups, of[kind], quantity)

    def over_outcomes(
        self,
        metric: Metric,
        groups: Sequence[int],
        of: Callable[[Distribution], np.ndarray],
        quantity: str = "claimed",
    ) -> np.ndarray:
        """Return what a function (rows of it) makes of the distribution at every step, (rows, steps)."""
        columns = []
        for step in range(1, len(self.structure.endings) + 1):
            blocks = self._blocks_of_rows(step)
            columns.append(np.concatenate([of(self.distribution(metric, step, groups, b, quantity)) for b in blocks]))
        return np.stack(columns, axis=1)

    def _blocks_of_rows(self, step: int) -> list[slice]:
        """Rows in blocks small enough that a distribution of each fits in memory."""
        rows, claims = len(self.links.link), sum(block.number for block in self.found.claims(step))
        size = max(1, MOST_PROBABILITIES // claims)
        return [slice(first, first + size) for first in range(0, rows, size)]

    def distribution(
        self,
        metric: Metric,
        step: int,
        groups: Sequence[int] = (0,),
        rows: slice = slice(None),
        quantity: str = "claimed",
    ) -> Distribution:
        """Values of a metric over all outcomes of a step, with their probabilities in some rows (default: every one).

        Several groups of agents: of an agent picked at random.
        """
        agents = sum(len(self.groups[g]) for g in groups)
        share = np.array([len(self.groups[g]) / agents for g in groups])
        values, weights = [], []
        for by_group, estimate, _ in self.found.shared_out(step, self.values):
            weight = np.tensordot(share, by_group[list(groups)], axes=1)
            some = np.flatnonzero(weight.any(axis=0))
            if not len(some):
                continue
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):
                all_of = (moments if self.errors else claimed_only)(estimate)
                found = value(quantity, metric, all_of.map(lambda M: M[some]))  # noqa: B023
            if not np.isfinite(found).all():
                raise StochfuseError(f"{metric.label} is not finite in some outcome: it grows beyond floating point")
            values.append(found)
            weights.append(self._probability(weight[:, some], rows))
        merged = Distribution.merged(np.concatenate(values), np.concatenate(weights, axis=1))
        return Distribution(merged.values, merged.probability / merged.probability.sum(axis=1, keepdims=True))

    def listed(self, step: int, group: int) -> tuple[Callable[[int], np.ndarray], Moments]:
        """What gives the probability of every outcome of a step in a row, and an agent's moments in each."""
        weights, found = [], []
        for by_group, estimate, _ in self.found.shared_out(step, self.values):
            some = np.flatnonzero(by_group[group].any(axis=0))
            found.append((moments if self.errors else claimed_only)(estimate).map(lambda M: M[some]))  # noqa: B023
            weights.append(by_group[group][:, some])

        def probability(row: int) -> np.ndarray:
            p = np.concatenate([self._probability(weight, slice(row, row + 1))[0] for weight in weights])
            return p / p.sum()

        columns = zip(*found, strict=True)
        return probability, Moments(*(None if some[0] is None else np.concatenate(some) for some in columns))

    def _probability(self, weight: np.ndarray, rows: slice) -> np.ndarray:
        """Probabilities (rows, claims) from weights on the weights' axis."""
        if self.polynomial:
            return monomials(len(weight) - 1, self.common[rows]) @ weight
        return weight[rows]

    def _at(self, expected: np.ndarray, link: np.ndarray | None) -> np.ndarray:
        if not self.polynomial:
            return expected
        return bernstein(expected, len(expected) - 1, self.common if link is None else link)


def _expectation(
    claims: Iterable[Claimed], values: Claims, step: int, of: Callable[[Estimate], Any]
) -> tuple[list[Any], float]:
    """Expected state and covariance per group of agents, (48)/(49), on the weights' axis, and growth of rounding.

    Parameters
    ----------
    of : makes what is averaged, a named tuple of arrays or Nones, of a stack of estimates.
    """
    magnified, total, averaged = 1.0, None, None
    for block in claims:
        few = []
        for some, estimate, grown in in_numbers(block, values, step):
            magnified, averaged = max(magnified, float(grown)), of(estimate)
            numbers = np.concatenate([part.reshape(len(part), -1).T for part in averaged if part is not None])
            # the cheaper of the two: numbers of every outcome, or weights of every claim
            if len(numbers) < block.width:
                few.append(numbers)
            else:
                total = _sum(total, block.shared(block.total[:, some] @ numbers.T))
        if few:
            total = _sum(total, block.expected(np.concatenate(few, axis=1)))
    if averaged is None or total is None:
        raise StochfuseError("no outcome is possible")
    return [_unflattened(by_group, averaged) for by_group in total], magnified


def _sum(total: np.ndarray | None, part: np.ndarray) -> np.ndarray:
    return part if total is None else total + part


def _unflattened(numbers: np.ndarray, like: Any) -> Any:
    """Numbers (width, numbers) as arrays (width, ...) of the shapes that a named tuple has for each estimate."""
    found, first = [], 0
    for part in like:
        size = 0 if part is None else part[0].size
        found.append(None if part is None else numbers[:, first : first + size].reshape(-1, *part.shape[1:]))
        first += size
    return type(like)(*found)


def check_statistic(name: str, quantity: str, metric: Metric) -> tuple[str, float]:
    """Return kind and number of a statistic.

    Raises
    ------
    UsageError
        If there is no such statistic, or it cannot be had of this metric.
    """
    kind, number = parse_statistic(name)
    if kind == "derivative" and not linear(quantity, metric):
        raise UsageError(
            "derivative: expected metric trace or var:STATE of quantity claimed or actual, or the bias of one state, "
            f"got '{metric.name}' of {quantity}"
        )
    return kind, number


def averaged(system: System, items: Items, how: Settings, errors: bool) -> Averaged:
    """Average an estimator over all outcomes, (49); parameters are those of every method, see `Averaged`.

    Raises
    ------
    UsageError
        If the outcomes are too many, or a covariance has no inverse.
    NoAnswerError
        If nothing can be inferred from some outcome; names the items where they are known.
    """
    if how.max_graphs < 1:
        raise UsageError(f"max_graphs: expected a whole number of at least 1, got {how.max_graphs}")
    if not items.noises.common and how.estimator in SUMS and not how.prune:
        µ = items.links.common(system.network)
        if µ is not None and not (errors and system.noise is not None and system.noise.disturbance is not None):
            return _over_items(system, µ, items, how, errors)
    parts = []
    for members, alone, some in items.by_noises(system):
        parts.append((members, _of_outcomes(outcomes(alone, some.links, how, errors=errors))))
    return joined(parts)


def _of_outcomes(found: Outcomes) -> Averaged:
    left_out, rows, estimator = found.left_out, len(found.links.link), found.found.made.name
    said = []
    if left_out.max() > 1e-12:
        row, step = np.unravel_index(left_out.argmax(), left_out.shape)
        said.append(
            f"outcomes of probability up to {left_out.max():.2g} (at µ = "
            f"{found.links.means(found.system.network)[row]:g}, step {step + 1}) are left out; what is shown holds "
            "given one of the others"
        )
    far = found.rounding
    exact = left_out.max() <= 1e-12 and far <= PROMISED
    return Averaged(
        moments=found.moments(),
        group_of=group_of(found.groups),
        natures=np.full(rows, "exact" if exact else "approximate"),
        estimator=estimator,
        rounding=np.full(rows, far),
        notes=(*said, *notes(far)),
        outcomes=found,
        meta={
            "outcomes": found.structure.outcomes[-1],
            "graphs": found.structure.states,
            "left_out": left_out.tolist(),
        },
    )


def outcomes(
    system: System,
    links: LinkRows,
    how: Settings = Settings(),  # noqa: B008  frozen
    *,
    records: np.ndarray | None = None,
    errors: bool = False,
    plain: bool = False,
) -> Outcomes:
    """Enumerate all outcomes of a system.

    Parameters
    ----------
    links : rows of link probabilities.
    how : estimator and limits.
    records : measurements (steps, agents, p) where states are wanted.
    errors : whether the moments of the actual error are wanted too; not with records.
    plain : merge nothing.

    Raises
    ------
    UsageError
        If the outcomes are too many, or a covariance has no inverse.
    """
    if _common(system, links) is None or plain or how.prune or records is not None:
        found = _enumerated(system, links, how, records=records, errors=errors, plain=plain)
    else:
        found = _kept(_StructureKey.of(system, how, errors))
    return Outcomes(system, links, found, errors, records)


def _common(system: System, links: LinkRows) -> np.ndarray | None:
    """Probability that all links have in common; None too where masked links are certain: one outcome is possible."""
    common = links.common(system.network)
    if common is None or (not links.uniform and np.isin(common, (0.0, 1.0)).all()):
        return None
    return common


@dataclass(frozen=True)
class _StructureKey:
    """All that outcomes under one µ depend on; equal where that is.

    Parameters
    ----------
    structure : agents, links and starts without their numbers.
    system, how : one of those that have it.
    """

    structure: tuple[Any, ...]
    errors: bool
    system: System = field(compare=False)
    how: Settings = field(compare=False)

    @classmethod
    def of(cls, system: System, how: Settings, errors: bool) -> _StructureKey:
        estimator = (how.estimator, how.max_graphs, how.criterion)
        # what is not a sum of information may look at numbers of the system while it writes down pasts
        own = () if how.estimator in SUMS else (id(system),)
        return cls((*system.same_structure(), *estimator, *own), errors, system, how)


@lru_cache(maxsize=KEPT)
def _kept(asked: _StructureKey) -> Enumerated:
    network = asked.system.network
    return _enumerated(asked.system, restricted(uniform_rows([0.5]), network), asked.how, errors=asked.errors)


def _enumerated(
    system: System,
    links: LinkRows,
    how: Settings,
    *,
    records: np.ndarray | None = None,
    errors: bool = False,
    plain: bool = False,
) -> Enumerated:
    """Enumerate all outcomes; parameters and errors are those of `outcomes`."""
    network = system.network
    check_size(network, links)
    # records tell like agents apart
    kinds = kinds_of(system, how.estimator) if records is None else tuple(range(network.agents))
    permutations = relabellings(network, links, kinds)
    # a bursty link keeps its state where it is: nobody may change places
    fixed = plain or links.bursts is not None
    made = make(
        system,
        how.estimator,
        None if fixed else permutations,
        errors=errors,
        records=records,
        criterion=how.criterion,
    )
    per_step = [events(network, links, step) for step in range(1, network.steps + 1)]
    if links.bursts is not None:
        weights = bursty(per_step[0], len(links.link))
    elif how.prune or _common(system, links) is None:
        weights = Rows(len(links.link))
    else:
        weights = weights_for(network, sum(map(len, per_step)), system.detects is None)
    groups = groups_alike(network, links, kinds, permutations)
    request = Request(
        agents=network.agents,
        steps=network.steps,
        events=lambda step: per_step[step - 1],
        weights=weights,
        groups=groups,
        most=how.max_graphs,
        prune=how.prune,
        plain=plain,
        detections=system.detections,
    )
    return Enumerated(groups, enumerate_outcomes(made.estimator, request), made, weights)


def _over_items(system: System, link: np.ndarray, items: Items, how: Settings, errors: bool) -> Averaged:
    """Average sums of information for items with noises of their own, every item's claims weighed at its own µ."""
    P0 = system.P0 if items.noises.P0 is None else items.noises.P0
    noises = items.noises._replace(P0=np.broadcast_to(P0, (len(items), *system.P0.shape)))
    # the system's own first covariance is not used, and may be one that has no inverse
    plain = system.with_noises(Noises(P0=np.eye(system.dimension)))
    found = _kept(_StructureKey.of(plain, how, errors))
    batch = _ItemStack(system, found, errors)
    # items with the same noises side by side, so that a block of them has few different ones
    order = np.argsort(noises.different()[1], kind="stable")
    size = max(1, BLOCK // (len(found.made.estimator.ledger.sums) * batch.numbers))
    parts, far = [], []
    for first in range(0, len(order), size):
        some = order[first : first + size]
        try:
            block, reached = batch.block(link[some], noises.take(some))
        except NoAnswerError as error:
            raise NoAnswerError(str(error), some[list(error.items)].tolist()) from None
        parts.append(block)
        far.append(reached)
    back = np.argsort(order)
    rounding = np.concatenate(far)[back]
    of = Moments(*(None if m[0] is None else np.concatenate(m)[back] for m in zip(*parts, strict=True)))
    return Averaged(
        moments=of,
        group_of=group_of(found.groups),
        natures=np.where(rounding > PROMISED, "approximate", "exact"),
        estimator=how.estimator,
        rounding=rounding,
        meta={"outcomes": found.structure.outcomes[-1], "graphs": found.structure.states},
    )


class _ItemStack(NamedTuple):
    """Items with noises of their own, side by side."""

    system: System
    found: Enumerated
    errors: bool

    @property
    def numbers(self) -> int:
        """How many numbers information and footprint of one value take."""
        d, n, steps = self.system.dimension, self.system.agents, self.system.steps
        p = sum(self.system.sensors[kind].H.shape[-2] for kind in self.system.sensor_of)
        return d * (d + self.errors * (n * d + (steps - 1) * (d + p) + 1))

    def block(self, link: np.ndarray, noises: Noises) -> tuple[Moments, np.ndarray]:
        """Moments (items, steps, groups, …), and how far rounding may reach in each item."""
        first, of = noises.different()
        different = noises.take(first)
        try:
            found, magnified = self._moments(link, of, self._claims(different, None))
        except NoAnswerError as error:
            raise NoAnswerError(str(error), np.flatnonzero(np.isin(of, error.items)).tolist()) from None
        far, suspect = 2e-16 * magnified, np.flatnonzero(suspects(self.system, different)[of])
        if len(suspect):
            theirs = found.map(lambda m: m[suspect])
            again = partial(self._changes, link[suspect], noises.take(suspect), theirs)
            far[suspect] = np.maximum(far[suspect], reach(again))
        return found, far

    def _claims(self, noises: Noises, seed: int | None) -> InformationClaims:
        given = sources(self.system, noises, self.errors)
        ledger = self.found.made.estimator.ledger
        return InformationClaims(evaluate(ledger, given if seed is None else MovedSources(given, seed)))

    def _moments(self, link: np.ndarray, of: np.ndarray, values: Claims) -> tuple[Moments, np.ndarray]:
        """Moments (items, steps, groups, …), and by how much rounding grew in the last inversion of each item.

        Parameters
        ----------
        of : which of the noises each item has.
        """
        magnified, steps = np.ones(len(of)), []
        for step in range(1, self.system.steps + 1):
            expected: list[Any] = [None] * len(Moments._fields)
            for weights, estimate, grown in self.found.shared_out(step, values):
                magnified = np.maximum(magnified, np.atleast_1d(grown)[of])
                probability = monomials(weights.shape[1] - 1, link) @ weights
                for place, each in enumerate((moments if self.errors else claimed_only)(estimate)):
                    if each is not None:
                        part = np.einsum("giv,vi...->ig...", probability, each[:, of])
                        expected[place] = part if expected[place] is None else expected[place] + part
            steps.append(expected)
        return Moments(*(None if m[0] is None else np.stack(m, axis=1) for m in zip(*steps, strict=True))), magnified

    def _changes(self, link: np.ndarray, noises: Noises, found: Moments, seed: int) -> np.ndarray:
        """By how much moved numbers change each item's moments, (items,)."""
        first, of = noises.different()
        try:
            moved, _ = self._moments(link, of, self._claims(noises.take(first), seed))
        except (StochfuseError, np.linalg.LinAlgError):
            if len(link) == 1:
                return np.array([NO_DIGIT])
            # halves, until those are found of which no digit is left
            half = len(link) // 2
            parts = [
                self._changes(link[some], noises.take(some), found.map(lambda m: m[some]), seed)  # noqa: B023
                for some in (np.s_[:half], np.s_[half:])
            ]
            return np.concatenate(parts)
        pairs = [(found.P, moved.P), (found.actual, moved.actual), (found.square, moved.square)]
        return np.max([change(P, M).max(axis=(1, 2)) for P, M in pairs if P is not None and M is not None], axis=0)


def groups_alike(
    network: Network, rows: LinkRows, labels: Sequence[int], permutations: Sequence[tuple[int, ...]]
) -> tuple[tuple[int, ...], ...]:
    """Groups of agents that some relabelling takes into one another; of many agents, one that is easily found."""
    if network.agents > MOST_AGENTS_RELABELLED:
        if rows.uniform and len(set(labels)) == 1 and network.delays is None:
            return (tuple(range(network.agents)),)
        permutations = some_relabellings(network, rows, labels)
    return tuple(orbits(network.agents, permutations))


def check_size(network: Network, links: LinkRows) -> None:
    """Raise TooManyError if what the agents may hear at one step is too much to list."""
    n = network.agents
    heard = np.full(n, number_of_senders(network.architecture, n))
    if not links.uniform:
        steps = range(1, network.steps + 1 if links.varies else 2)
        heard = np.max([(links.matrices(network, step) > 0).any(axis=0).sum(axis=1) for step in steps], axis=0)
    drawn = n if network.architecture == "broadcast" else heard.sum()
    if heard.max() > MOST_SENDERS or drawn > MOST_DRAWN:
        raise TooManyError(
            f"one exchange of {n} agents, {network.architecture}, has 2^{drawn} outcomes, too many "
            "to go through: use --method optimal or --method monte-carlo"
        )
