"""Enumeration: every outcome of "which messages arrive", its probability (45)/(46), and what is claimed then.

The structure comes first and knows no numbers: states of the estimator are carried from exchange to exchange with the
weight of all outcomes that lead to them, and states that will behave alike are one.  The last two exchanges are not
carried out state by state.  After the exchange at step k − 1 agent i knows what the agents that it heard, S_i, know
together, and so what agents i ∈ A have in common after it is ∩ ∪_{j∈S_i} (pedigree of j): one of the few elements
of a distributive lattice on n generators (18 for n = 3) instead of one for each of the 2^(n(n−1)) outcomes.  Then

    Y_A(k) = Σ_{i∈A} HᵢᵀRᵢ⁻¹Hᵢ + Σ_{T⊆A, T≠∅} (−1)^(|T|+1) · [ common(∩_{i∈T} ∪S_i) brought forward to k ]

is summed in floating point, for all states and outcomes at once.  With delays, sensors that may miss, or more agents
than fit a machine word, the last exchange is carried out instead.

Outcomes in which the same is claimed are one from there on (`claims_of`): of three agents ad hoc, 48,236 outcomes of
the last two exchanges at step 4 claim 2,613 different sums.  Whether two sums of information are the same sum is told
by a random number for each atom, added up as the atoms are, modulo 2^64.

The numbers come last (`stochfuse.prediction.general`): one structure serves every Q, R and P(k0) with the same agents
and links.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property, reduce
from itertools import combinations
from typing import Any, NamedTuple, cast

import numpy as np

from stochfuse.engines.events import ChanceEvent, Outcome, Rows, Weights, concerning, number_of_outcomes, outcomes
from stochfuse.errors import TooManyError
from stochfuse.estimators.ledger import different, hashes, numbered
from stochfuse.estimators.progress import listener, uncollected
from stochfuse.estimators.protocol import AdditiveEstimator, AdditiveLayer, Estimator, Exchange
from stochfuse.scenario.system import Detection

MOST_GENERATORS = 6
"""Agents up to which truth tables of the lattice fit 64 bits."""
MOST_CELLS = 1 << 21
"""Outcomes of one exchange up to which they are listed."""
LONG = 1000
"""States from which on the work is long enough to be announced before."""
TOGETHER = 1 << 14
"""States whose last two exchanges are gone through at a time."""
AT_A_TIME = 1 << 17
"""Outcomes of states, in every order of the agents, that are merged at a time."""
LISTED = 1 << 21
"""Outcomes, or weights of some, that are gone through at a time while equal claims are found."""
TRIED, WORTH = 1 << 16, 0.75
"""Outcomes that are tried for equal claims, and the share of different ones up to which it is worth finding these."""
MOST_ENDINGS = 1_000_000
"""Outcomes of the last exchange, over all states, up to which they are listed one by one."""
WRITTEN_OUT = 10**30
"""Numbers from which on only the size is told."""


class FusedSet(NamedTuple):
    """Outcomes of the last exchanges as a set of agents A sees them: Y = Y[always] + Σ sign · Y[ids[:, index]].

    Parameters
    ----------
    ids : (states, table) values of the ledger; −1 stands for nothing.
    terms : (sign, index into the table per cell).
    starts : first cell of every group of cells with one factor.
    factors : weight of each group's cells, shape (groups, width).
    shares : weight of "the agent fuses just this" for each group of agents, shape (groups of agents, width).
    always : value that is part of every claim, or None.
    """

    ids: np.ndarray
    terms: tuple[tuple[int, np.ndarray], ...]
    starts: np.ndarray
    factors: np.ndarray
    shares: list[Any]
    always: int | None = None


class Ending(NamedTuple):
    """Everything that can be claimed at one step.

    Parameters
    ----------
    step : number of the step.
    weights : weight of every state, on the weights' axis.
    views : what the agents can fuse from there.
    events : events up to this step.
    """

    step: int
    weights: np.ndarray
    views: list[FusedSet]
    events: int


@dataclass(frozen=True)
class Request:
    """What is to be enumerated.

    Parameters
    ----------
    agents, steps : numbers of agents and steps.
    events : events of a step.
    weights : bookkeeping of probabilities.
    groups : agents that are alike.
    most : states that may be carried at a time.
    prune : whether the least likely states are left out where there are more, instead of giving up.
    plain : carry every outcome to the end, merge nothing: for tests and benchmarks.
    detections : draws of what is measured at a step.
    """

    agents: int
    steps: int
    events: Callable[[int], list[ChanceEvent]]
    weights: Weights
    groups: tuple[tuple[int, ...], ...]
    most: int = 100_000
    prune: bool = False
    plain: bool = False
    detections: Callable[[int], list[Detection]] = lambda step: []


class Structure(NamedTuple):
    """All outcomes, before any number is put in.

    Parameters
    ----------
    endings : one per step.
    states : number of states carried before each step's exchange.
    outcomes : number of outcomes up to each step.
    """

    endings: list[Ending]
    states: list[int]
    outcomes: list[int]


def enumerate_outcomes(estimator: Estimator, request: Request) -> Structure:
    """List what can be claimed at every step.

    Raises
    ------
    TooManyError
        If more states than `request.most` have to be carried.
    """
    with uncollected():
        return _enumerate(estimator, request)


def _enumerate(estimator: Estimator, request: Request) -> Structure:
    weights, n, steps = request.weights, request.agents, request.steps
    drawn = [request.events(step) for step in range(1, steps + 1)]
    events_up_to = np.cumsum([len(d) for d in drawn]).tolist()
    seen = [request.detections(step) for step in range(1, steps + 1)]
    number = [1]
    for step, d in enumerate(drawn, start=1):
        number.append(number[-1] * number_of_outcomes(d, steps - step, seen[step - 1]))
    sums = cast(AdditiveEstimator, estimator)
    two_steps = (
        estimator.additive
        and not weights.memory
        and all(event.delay == (1.0,) for d in drawn for event in d)
        and not any(seen)
        and n <= MOST_GENERATORS
        and not request.plain
    )
    start = estimator.start()
    layer: dict[Any, Any] = {estimator.exchange(start) if request.plain else start: weights.one()}
    sizes, announced = [1], False
    endings = [_ending(estimator, layer, drawn[0], 0, events_up_to[0], 1, request)]
    for step in range(2, steps + 1):
        before, last = drawn[step - 2 : step]
        degree = events_up_to[step - 2] - two_steps * len(before)
        if two_steps:
            total = events_up_to[step - 1]
            endings.append(_two_step_ending(sums, layer, before, last, degree, total, step, request))
        if step < steps or not two_steps:
            left = steps - step + 1
            expected = _expected(sizes, len(layer) * number[step - 1] // number[step - 2], len(estimator.relabellings))
            in_the_end = _extrapolated(sizes, expected, steps - step - two_steps)
            _check_exchange(number_of_outcomes(before, left, seen[step - 1]), number[steps], request)
            # the first exchange says nothing yet of an estimator that forgets, or whose agents are soon alike
            hopeless = len(sizes) > 1 and in_the_end > 10 * request.most
            if expected > LONG or hopeless:
                # an extrapolation may be off by a few times; what is far beyond the limit need not be begun
                beyond = in_the_end if hopeless else expected
                _check_size(beyond, number[steps], request)
            if not announced and expected > LONG:
                listener().expect(number[steps], in_the_end)
                announced = True
            possible = outcomes(before, n, left, weights, seen[step - 1])
            layer = _next_layer(estimator, layer, possible, step - 1, request)
            layer = dict(zip(layer, weights.between(list(layer.values())), strict=True)) if weights.memory else layer
            if request.prune and len(layer) > request.most:
                layer = _likeliest(layer, request)
            _check_size(len(layer), number[steps], request)
            sizes.append(len(layer))
        if not two_steps:
            endings.append(_ending(estimator, layer, last, degree, events_up_to[step - 1], step, request))
    if not announced:
        listener().expect(number[steps], sizes[-1])
    return Structure(endings, sizes, number[1:])


def _next_layer(
    estimator: Estimator,
    layer: dict[Any, Any],
    possible: list[Outcome],
    step: int,
    request: Request,
) -> dict[Any, Any]:
    times, found = request.weights.times, {}
    total, progress, done = len(layer), listener(), 0
    for weights, exchanges in _in_parts(estimator, layer, possible, request):
        if isinstance(exchanges, list):
            followed = (_after(exchange, possible, request.plain) for exchange in exchanges)
        else:
            heard = np.array([outcome.heard for outcome in possible])
            which, after = exchanges.after(heard, np.array([outcome.missed for outcome in possible]))
            followed = ([after[number] for number in numbers] for numbers in which.tolist())
        for weight, reached in zip(weights, followed, strict=True):
            for outcome, state in zip(possible, reached, strict=True):
                new = times(weight, outcome.factor)
                known = found.get(state)
                found[state] = new if known is None else known + new
            done += 1
            progress.advance(f"step {step}", done, total)
    return found


def _after(exchange: Exchange, possible: list[Outcome], plain: bool) -> Iterator[Any]:
    """What an exchange leads to in every outcome, one by one."""
    for heard, late, _, missed in possible:
        yield exchange.onward(heard, late, missed) if plain else exchange.after(heard, late, missed)[0]


def _in_parts(
    estimator: Estimator, layer: dict[Any, Any], possible: list[Outcome], request: Request
) -> Iterator[tuple[list[Any], list[Exchange] | AdditiveLayer]]:
    """Weights of some states at a time, and their exchanges."""
    states, weights, late = list(layer), list(layer.values()), any(outcome.late for outcome in possible)
    size = max(1, AT_A_TIME // (len(possible) * len(estimator.relabellings)))
    for first in range(0, len(states), size):
        some = states[first : first + size]
        yield weights[first : first + size], some if request.plain else _opened(estimator, some, late)


def _likeliest(layer: dict[Any, np.ndarray], request: Request) -> dict[Any, np.ndarray]:
    """Return the likeliest states, every row's own likeliest in turn."""
    most, states = request.most, list(layer)
    weights = request.weights.collected(np.array(list(layer.values())).T).T
    rank = np.argsort(np.argsort(-weights, axis=0, kind="stable"), axis=0, kind="stable").min(axis=1)
    kept = np.sort(np.argsort(rank, kind="stable")[:most])
    if (weights[kept].sum(axis=0) <= 0).any():
        raise TooManyError(
            f"--max-graphs {most}: too few to keep an outcome for every row; expected more, or fewer rows"
        )
    return {states[i]: layer[states[i]] for i in kept}


def _expected(sizes: list[int], candidates: int, relabellings: int) -> int:
    """Return how many states the next layer will have, judged by the growth so far, at first by the symmetry."""
    if len(sizes) == 1:
        return min(candidates, 1 + 3 * candidates // (2 * relabellings))
    return max(1, int(min(candidates, 1.2 * sizes[-1] * sizes[-1] / sizes[-2])))


def _extrapolated(sizes: list[int], expected: int, further: int) -> int:
    return round(expected * (Decimal(expected) / sizes[-1]) ** max(0, further))


def _check_exchange(here: int, number: int, request: Request) -> None:
    if here > MOST_CELLS >> 4:
        raise TooManyError(
            f"one exchange of {request.agents} agents has {_shown(here)} outcomes, the "
            f"whole {_shown(number)}, too many to list: use --method optimal or --method monte-carlo, fewer steps or "
            "fewer agents"
        )


def _check_size(expected: int, number: int, request: Request) -> None:
    if expected > request.most and not request.prune:
        raise TooManyError(
            f"{_shown(number)} outcomes make about {_shown(expected, '')} different graphs, more than --max-graphs "
            f"{request.most}: raise it, "
            "leave the least likely out with --prune, or use --method optimal or --method monte-carlo, fewer "
            "steps or fewer "
            "agents"
        )


def _shown(number: int, short: str = ".3g") -> str:
    """Return a number in words' length, also one that is too large for a floating-point number."""
    return f"{number:{short}}" if number < WRITTEN_OUT else f"{Decimal(number):.3g}"


def _check_ending(states: int, events: int) -> None:
    if states * 2.0**events > MOST_ENDINGS:
        raise TooManyError(
            f"the last exchange has {2.0**events:.3g} outcomes for each of {states:,} states, too many to list: use "
            "--method monte-carlo, or fewer agents or steps"
        )


def _ending(
    estimator: Estimator,
    layer: dict[Any, Any],
    last: list[ChanceEvent],
    degree: int,
    events: int,
    step: int,
    request: Request,
) -> Ending:
    """Carry out the last exchange for every state: one view per agent."""
    weights, views = request.weights, []
    states = list(layer)
    parts = [states[first : first + TOGETHER] for first in range(0, len(states), TOGETHER)]
    opened = parts if request.plain else [_opened(estimator, part) for part in parts]
    for group, agents in enumerate(request.groups):
        for agent in agents:
            concerned = [e._replace(receivers=(agent,)) for e in concerning(last, [agent])]
            concerned = last if estimator.joint else concerned
            _check_ending(len(states), len(concerned))
            possible = outcomes(concerned, request.agents, 0, weights)
            ids = np.concatenate([_fused(exchanges, agent, possible) for exchanges in opened])
            factors = weights.factors([o.factor for o in possible], len(concerned))
            share = weights.factors([weights.none()], 0)[0] / len(agents)
            shares = [share if g == group else None for g in range(len(request.groups))]
            cells = np.arange(len(possible))
            views.append(FusedSet(ids, ((1, cells),), cells, factors, shares))
    return Ending(step, weights.table(list(layer.values()), degree), views, events)


def _opened(estimator: Estimator, states: list[Any], late: bool = False) -> list[Exchange] | AdditiveLayer:
    """Exchanges of some states, all together where they can stand in arrays and no message will be late."""
    arrays = estimator.additive and not late
    together = cast(AdditiveEstimator, estimator).together(states) if arrays else None
    return [estimator.exchange(state) for state in states] if together is None else together


def _fused(exchanges: list[Exchange] | AdditiveLayer, agent: int, possible: list[Outcome]) -> np.ndarray:
    """Values that an agent claims, (exchanges, outcomes)."""
    if isinstance(exchanges, list):
        return np.array([[exchange.fused(agent, o.heard) for o in possible] for exchange in exchanges])
    sets, index = np.unique([o.heard[agent] for o in possible], return_inverse=True)
    return exchanges.commons(sets[:, None].tolist())[:, index]


def _two_step_ending(
    estimator: AdditiveEstimator,
    layer: dict[Any, Any],
    before: list[ChanceEvent],
    last: list[ChanceEvent],
    degree: int,
    events: int,
    step: int,
    request: Request,
) -> Ending:
    """The last two exchanges for every state, through the lattice of what can be common."""
    weights, n = request.weights, request.agents
    table = _LastViews(estimator, n)
    views = []
    sets = _last_heard(last, request)
    most = max(len(concerning(before, _members(fused, n))) for fused in sets)
    if most > MOST_CELLS.bit_length() - 1:
        raise TooManyError(
            f"one exchange of {n} agents has {2.0**most:.3g} outcomes, too many to list: use --method optimal or "
            "--method monte-carlo, or fewer agents"
        )
    for fused, shares in sets.items():
        members = _members(fused, n)
        concerned = concerning(before, members)
        heard, factor_of, factors = _cells(concerned, members, weights)
        order = np.argsort(factor_of, kind="stable")
        starts = np.searchsorted(factor_of[order], np.arange(len(factors)))
        heard = {i: h[order] for i, h in heard.items()}
        terms = []
        for size in range(1, len(members) + 1 if estimator.removes else 2):
            sign = 1 if size % 2 else -1
            terms += [(sign, table.common([heard[i] for i in T])) for T in combinations(members, size)]
        always = estimator.ledger.measurements(step, [estimator.sources[i] for i in members])
        views.append((tuple(terms), starts, factors, shares, always))
    ids, progress, states = [], listener(), list(layer)
    for first in range(0, len(states), TOGETHER):
        some = states[first : first + TOGETHER]
        ids.append(table.values(some))
        progress.advance(f"steps {step - 1} and {step}", first + len(some), len(states))
    ids, state_weights = _rows_once(np.concatenate(ids), weights.table(list(layer.values()), degree))
    return Ending(step, state_weights, [FusedSet(ids, *view) for view in views], events)


def _rows_once(ids: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States of which everything is equal that is still asked for as one, with their weights added up."""
    which, one = numbered(hashes(ids))
    total = np.zeros((len(one), weights.shape[1]))
    np.add.at(total, which, weights)
    return ids[one], total


def _members(agents: int, n: int) -> list[int]:
    return [i for i in range(n) if agents >> i & 1]


def _last_heard(last: list[ChanceEvent], request: Request) -> dict[int, list[Any]]:
    """What an agent can fuse in the last exchange, with the weight for every group of agents."""
    found: dict[int, list[Any]] = {}
    weights = request.weights
    for group, agents in enumerate(request.groups):
        degree = max(len(concerning(last, [agent])) for agent in agents)
        for agent in agents:
            concerned = [e._replace(receivers=(agent,)) for e in concerning(last, [agent])]
            for outcome in outcomes(concerned, request.agents, 0, weights):
                shares = found.setdefault(outcome.heard[agent], [None] * len(request.groups))
                share = weights.completed(weights.factors([outcome.factor], len(concerned))[0], degree)
                shares[group] = share / len(agents) + (0 if shares[group] is None else shares[group])
    return found


def _cells(
    drawn: list[ChanceEvent], members: Sequence[int], weights: Weights
) -> tuple[dict[int, np.ndarray], np.ndarray, np.ndarray]:
    """All outcomes of some events: what each member hears, the factor's number, and the factors."""
    cells = np.arange(1 << len(drawn))
    heard = {i: np.full(len(cells), 1 << i) for i in members}
    for bit, event in enumerate(drawn):
        for i in set(event.receivers) & set(members):
            heard[i] |= (cells >> bit & 1) << event.sender
    if isinstance(weights, Rows):
        factors = np.ones((1, weights.rows))
        for event in drawn:
            factors = np.concatenate([factors * (1.0 - event.probability), factors * event.probability])
        possible = np.flatnonzero(factors.any(axis=1))
        return {i: h[possible] for i, h in heard.items()}, np.arange(len(possible)), factors[possible]
    successes = np.zeros(len(cells), dtype=int)
    for bit in range(len(drawn)):
        successes += cells >> bit & 1
    return heard, successes, np.eye(len(drawn) + 1)


class _LastViews:
    """Numbers the common pedigrees that the views of a step need; what one agent knows is common to it alone."""

    def __init__(self, estimator: AdditiveEstimator, agents: int) -> None:
        self.estimator = estimator
        self._common: dict[int, int] = {}
        self._clauses: list[tuple[int, ...]] = []
        points = np.arange(1 << agents, dtype=np.uint64)
        variables = [sum((1 << int(p)) for p in points if int(p) >> i & 1) for i in range(agents)]
        self._truth = np.zeros(1 << agents, dtype=np.uint64)
        for i, variable in enumerate(variables):
            with_i = (points >> np.uint64(i) & np.uint64(1)).astype(bool)
            self._truth[with_i] |= np.uint64(variable)

    def common(self, heard: Sequence[np.ndarray]) -> np.ndarray:
        """Index of what agents with those heard sets have in common."""
        meet = np.bitwise_and.reduce([self._truth[h] for h in heard])
        found, first, where = np.unique(meet, return_index=True, return_inverse=True)
        for table, cell in zip(found.tolist(), first.tolist(), strict=True):
            if table not in self._common:
                self._common[table] = len(self._clauses)
                self._clauses.append(tuple({int(h[cell]) for h in heard}))
        return np.array([self._common[table] for table in found.tolist()])[where]

    def values(self, states: list[Any]) -> np.ndarray:
        """Values for some states, brought forward, (states, values); −1 for nothing."""
        ledger, exchanges = self.estimator.ledger, cast(Any, _opened(self.estimator, states))
        if isinstance(exchanges, list):
            commons = np.array([[exchange.common(clauses) for clauses in self._clauses] for exchange in exchanges])
        else:
            commons = exchanges.commons(self._clauses)
        # the union of what all know is never nothing
        return ledger.forwards(commons, int(ledger.steps[commons.max()]) + 1)


@dataclass(frozen=True, eq=False)
class Claimed:
    """Different claims of a step, outcomes with equal ones added up: Y = Σ sign · Y[ids], and what all contain.

    Parameters
    ----------
    terms : (sign, values (claims,)), without what is part of all; the value −1 stands for nothing.
    which : number of the claim in every outcome, (states, cells), or None where each has its own.
    view : the outcomes.
    states : weight of every state, on the weights' axis.
    events : events up to the step.
    bookkeeping : of the weights.
    """

    terms: tuple[tuple[int, np.ndarray], ...]
    which: np.ndarray | None
    view: FusedSet
    states: np.ndarray
    events: int
    bookkeeping: Weights

    @property
    def number(self) -> int:
        """How many claims there are."""
        return len(self.terms[0][1])

    @cached_property
    def width(self) -> int:
        """Length of the weights' axis before the last exchange counts."""
        return self.bookkeeping.pairs(self.states[:1], self.view.factors).shape[2]

    @cached_property
    def total(self) -> np.ndarray:
        """Weight of each claim before the last exchange counts, (width, claims); see `shared`."""
        from scipy.sparse import csr_array

        total, factor_of = np.zeros((self.number, self.width)), self._factor_of
        for some, pairs in self._pairs():
            which = self._of(np.arange(self.number)[None], some).ravel()
            pair_of = (np.arange(len(pairs))[:, None] * pairs.shape[1] + factor_of).ravel()
            places = (np.ones(len(which)), (which, pair_of))
            total += csr_array(places, shape=(self.number, pairs[:, :, 0].size)) @ pairs.reshape(-1, self.width)
        return np.ascontiguousarray(total.T)

    def expected(self, values: np.ndarray) -> np.ndarray:
        """Σ weight · values (numbers, claims) for every group of agents, (groups, full width, numbers).

        Without the weight of any claim: for few numbers of many claims.
        """
        factors, size = self.view.factors, max(1, LISTED // (self._cells * len(values)))
        found = np.zeros((self.states.shape[1], len(values), len(factors)))
        for first in range(0, len(self.states), size):
            some = slice(first, first + size)
            by_factor = np.add.reduceat(self._of(values, some), self.view.starts, axis=2)
            found += np.tensordot(self.states[some], by_factor, axes=((0,), (1,)))
        weighed = (self.bookkeeping.weighed(found[..., f], factor) for f, factor in enumerate(factors))
        return self.shared(reduce(np.add, weighed))

    def shared(self, found: np.ndarray) -> np.ndarray:
        """What is known before the last exchange counts, (width, ...), after it: (groups, full width, ...)."""
        weights, by_group = self.bookkeeping, []
        for share in self.view.shares:
            whole = None if share is None else weights.completed(weights.weighed(found, share), self.events)
            by_group.append(None if whole is None else weights.collected(whole))
        shape = next(part for part in by_group if part is not None).shape
        return np.stack([np.zeros(shape) if part is None else part for part in by_group])

    @property
    def _cells(self) -> int:
        return len(self.view.terms[0][1])

    def _of(self, values: np.ndarray, some: slice) -> np.ndarray:
        """Values (numbers, claims) of what is claimed in some states, (numbers, states, cells)."""
        if self.which is None:
            return values.reshape(len(values), -1, self._cells)[:, some]
        return values.take(self.which[some], axis=1)

    @property
    def _factor_of(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.view.factors)), np.diff([*self.view.starts, self._cells]))

    def _pairs(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Weights of some states with every factor, (states, factors, width), at a time."""
        size = max(1, LISTED // max(self._cells, len(self.view.factors) * self.width))
        for first in range(0, len(self.states), size):
            some = slice(first, first + size)
            yield some, self.bookkeeping.pairs(self.states[some], self.view.factors)


def claims_of(ending: Ending, signatures: np.ndarray | None, weights: Weights) -> Iterator[Claimed]:
    """Different claims of a step, as many at a time as fit in memory.

    Parameters
    ----------
    signatures : (values, 2) numbers of the estimator's values such that a sum of values has the sum of their numbers,
        see `stochfuse.estimators.ledger.Ledger.signatures`; None where nothing is summed.
    """
    for view in ending.views:
        cells = len(view.terms[0][1])
        size, tried = max(1, LISTED // cells), slice(0, max(1, TRIED // cells))
        _, different_ones = different(_keys(view, tried, signatures))
        alike = len(different_ones) < WORTH * cells * len(view.ids[tried])
        for first in range(0, len(view.ids), size):
            states = slice(first, first + size)
            ids, which = view.ids[states], None
            if alike:
                which, order = numbered(_keys(view, states, signatures))
                which, (row, cell) = which.astype(np.int32).reshape(-1, cells), np.divmod(order, cells)
                terms = tuple((sign, ids[row, index[cell]]) for sign, index in view.terms)
            else:
                terms = tuple((sign, ids.take(index, axis=1).ravel()) for sign, index in view.terms)
            yield Claimed(terms, which, view, ending.weights[states], ending.events, weights)


def _keys(view: FusedSet, states: slice, signatures: np.ndarray | None) -> np.ndarray:
    """Numbers for what is claimed in each outcome, (1 or 2, states · cells), equal where claims are."""
    ids = view.ids[states]
    if len(view.terms) == 1 or signatures is None:
        ((_, index),) = view.terms
        return ids[:, index].reshape(1, -1)
    numbers = np.ascontiguousarray(signatures.T).take(ids, axis=1)
    keys = np.zeros((2, len(ids), len(view.terms[0][1])), dtype=np.uint64)
    for sign, index in view.terms:
        (np.add if sign > 0 else np.subtract)(keys, numbers.take(index, axis=2), out=keys)
    return keys.reshape(2, -1)
