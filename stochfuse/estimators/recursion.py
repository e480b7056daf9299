"""Estimators that remember pasts: what a fused estimate is made of is written down first, worked out in batches later.

A value is a past: a step, a rule with the agents that it concerns, and the values that it rests on.  Equal pasts have
equal numbers.  Between exchanges every agent's filter runs by itself,

    local      predict (23)/(24), then update (25)–(27) with the agent's own measurement

and what an agent makes of what it hears is the estimator's own business (`fuse` and `work`).  Errors ride along as
noise footprints: the state of every estimate in a world whose true state is zero (`stochfuse.estimators.world`).

Pasts: what estimates are made of, under numbers that are equal where the pasts are equal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import Renamed
from stochfuse.estimators.protocol import Late, in_least_order
from stochfuse.estimators.world import Footprints, Riding, World
from stochfuse.kalman.kernel import Estimate, at_step, predict, update
from stochfuse.kalman.metrics import Moments

MOST_MAGNIFIED = 1e13
"""Growth of rounding, 2e-16 of the prior beside the posterior, from which on nothing is claimed."""


class Worked(NamedTuple):
    """Stacks of estimates that a rule worked out.

    Parameters
    ----------
    P : (..., d, d) claimed covariance.
    x : (..., d, columns) noise footprint, or None.
    independent : (..., d, d) part of P that only this step's own measurement brought, K R Kᵀ; None after fusion.
    actual, bias : (..., d, d) actual covariance and (..., d, 1) mean error where no footprint is carried; or None.
    """

    P: Any
    x: Any = None
    independent: Any = None
    actual: Any = None
    bias: Any = None

    def settled(self) -> Worked:
        """Return the same with moments of the error in the place of the footprint, once nothing more rests on it."""
        if self.x is None:
            return Worked(self.P, actual=self.actual, bias=self.bias)
        moments = Moments.of_footprint(self.P, self.x)
        return Worked(self.P, actual=moments.actual, bias=moments.bias)


class PastState(NamedTuple):
    """Before an exchange: every agent's value, and (receiver, steps left, value) of messages under way."""

    step: int
    agents: tuple[int, ...]
    late: tuple[tuple[int, int, int], ...] = ()


class RecursiveEstimator:
    """What estimators that remember pasts have in common; one of them says how to `fuse`, and how that `work`s out.

    Parameters
    ----------
    world : what the filters are told, and what is true.
    kinds : kind of each agent; agents of one kind may change places where the relabellings say so.
    relabellings : permutations of the agents that leave network and world as they are; None if nobody may change.
    errors : whether noise footprints are carried along.
    """

    additive, joint = False, False
    gathers: str | None = None
    """Name of the rule by which agents that track one state fuse all that they hear; None if they fuse nothing."""
    split = False
    """Whether fusion asks what of an estimate only its own step's measurement brought."""
    symmetric: tuple[str, ...] = ()
    headed: tuple[str, ...] = ()
    mixed: tuple[str, ...] = ()

    def __init__(
        self,
        world: World,
        kinds: Sequence[int],
        relabellings: Sequence[tuple[int, ...]] | None = None,
        *,
        errors: bool = False,
    ) -> None:
        self.world, everyone = world, tuple(range(world.agents))
        self.relabellings = relabellings or [everyone]
        # where errors do not matter, the first agent of a kind stands for all of it
        self.labels = everyone if errors else tuple(kinds.index(kind) for kind in kinds)
        self.pasts = Pasts(self.symmetric, kinds if errors else None, self.headed)
        self.errors = errors
        self.readings: Riding | None = None
        self.magnified = 1.0
        self._neighbours: dict[tuple[int, int], tuple[int, ...]] = {}

    @cached_property
    def footprints(self) -> Footprints | None:
        """Noise footprints, where errors are carried along; large, and so not made before they are asked for."""
        return Footprints(self.world) if self.errors else None

    @property
    def book(self) -> Pasts:
        """Where values are written down."""
        return self.pasts

    @property
    def riding(self) -> Riding | None:
        """What rides along with covariances: what was measured (`readings`), noise footprints, or nothing."""
        return self.footprints if self.readings is None else self.readings

    def start(self) -> PastState:
        """Everyone's first estimate."""
        return PastState(1, tuple(self.pasts.number(1, ("start", label)) for label in self.labels))

    def exchange(self, state: PastState) -> PastExchange:
        """Open the exchange of the state's step."""
        return PastExchange(self, state)

    def rests_on(self, state: PastState) -> Iterator[int]:
        """Values that a state rests on."""
        yield from state.agents
        yield from (value for _, _, value in state.late)

    def renamed(self, state: PastState, names: Mapping[int, int], into: Any) -> PastState:
        """Return the state with the numbers that another estimator of this kind has for its values."""
        late = tuple(sorted((receiver, left, names[value]) for receiver, left, value in state.late))
        return PastState(state.step, tuple(names[value] for value in state.agents), late)

    def fuse(self, step: int, agent: int, values: Sequence[int], heard: int, due: Sequence[int]) -> int:
        """Value that an agent claims.

        Parameters
        ----------
        values : what every agent has before the exchange.
        heard : mask of the agents heard, itself included.
        due : late messages that arrive now, brought forward.
        """
        raise NotImplementedError

    def neighbours(self, agent: int, heard: int) -> tuple[int, ...]:
        """Others that were heard; of agents with states of their own, those that the agent can measure."""
        known = self._neighbours.get((agent, heard))
        if known is None:
            others = [j for j in range(self.world.agents) if heard >> j & 1 and j != agent]
            known = tuple(j for j in others if not self.world.own or (agent, j) in self.world.relations)
            self._neighbours[agent, heard] = known
        return known

    def onward(self, step: int, agent: int, fused: int, before: int, missed: bool) -> int:
        """What an agent has at the next step, of what it claims now and had before the exchange.

        Parameters
        ----------
        missed : whether its sensor misses there.
        """
        return self.pasts.number(step + 1, ("forward" if missed else "local", self.labels[agent]), (fused,))

    def work(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Work a batch out, from stacks of what it rests on; all have one rule unless its name is in `mixed`."""
        raise NotImplementedError

    def batch(self, step: int, rules: Sequence[FusionStep], rests_on: list[Worked]) -> Worked:
        """Work out the rules that all estimators share, and leave the others to `work`."""
        rule = rules[0]
        if rule[0] == "start":
            return self.first(self.world.states[rule[1]])
        if rule[0] == "local":
            return self.local(step, rule[1], rests_on[0])
        if rule[0] == "forward":
            prior = self.prior(step, rule[1], rests_on[0])
            return Worked(prior.P, prior.x, np.zeros_like(prior.P))
        return self.work(step, rules, rests_on)

    def first(self, rows: slice) -> Worked:
        """First estimate of some rows of the stacked state, as a batch of one."""
        P = self.world.P0[rows, rows][None]
        x = None if self.riding is None else self.riding.start(rows)
        return Worked(P, x if x is None or x.ndim > 2 else x[None], np.zeros_like(P))

    def prior(self, step: int, agent: int, before: Worked) -> Estimate:
        """Time update of an agent's estimates."""
        rows = self.world.states[agent]
        moved = None if self.riding is None else self.riding.process(step, rows)
        Q = at_step(self.world.Q, step)[rows, rows]
        return predict(Estimate(before.x, before.P), at_step(self.world.F[agent], step), Q, moved)

    def local(self, step: int, agent: int, before: Worked) -> Worked:
        """Time update and the agent's own measurement."""
        H, R, z = self.seen(step, agent)
        prior = self.prior(step, agent, before)
        x, P = update(prior, H, R, z)
        self.grown(prior.P, P)
        return Worked(P, x, P @ (np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H)) @ P)

    def seen(self, step: int, agent: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """What an agent's sensor measures, H and R, and what it says to what rides along."""
        H, R = at_step(self.world.H[agent], step), at_step(self.world.R[agent], step)
        if self.riding is None:
            return H, R, None
        return self.riding.sensor(step, agent, H), R, self.riding.measured(step, agent)

    def grown(self, prior: np.ndarray, posterior: np.ndarray) -> None:
        """Remember by how much the rounding of a prior covariance grew beside a posterior one."""
        if prior.shape[-1] == 1:
            return  # one state loses nothing
        before, after = (np.diagonal(P, axis1=-2, axis2=-1) for P in (prior, posterior))
        ratio = np.divide(before, np.abs(after), out=np.ones_like(before), where=after != 0)
        self.magnified = max(self.magnified, float(ratio.max(initial=1.0)))


class PastExchange:
    """One exchange."""

    def __init__(self, estimator: RecursiveEstimator, state: PastState) -> None:
        self.estimator, self.state = estimator, state
        self._fused: dict[tuple[int, int], int] = {}
        self._due: list[list[int]] = [[] for _ in state.agents]
        for receiver, left, value in state.late:
            if left == 0:
                self._due[receiver].append(value)

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value that an agent claims after everyone heard some, with what else is due."""
        known = self._fused.get((agent, heard[agent]))
        if known is None:
            step, agents, _ = self.state
            known = self.estimator.fuse(step, agent, agents, heard[agent], self._due[agent])
            self._fused[agent, heard[agent]] = known
        return known

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[PastState, tuple[int, ...]]:
        """State before the next exchange, in the order that like states share, and the agent at each place of it."""
        estimator = self.estimator
        step, agents, coming = self._next(heard, late, missed)
        agents, under_way, order = in_least_order(estimator.pasts, agents, coming, estimator.relabellings)
        return PastState(step, agents, under_way), order

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> PastExchange:
        """Open the next exchange as it comes."""
        return self.estimator.exchange(self._next(heard, late, missed))

    def _next(self, heard: Sequence[int], late: Sequence[Late], missed: int) -> PastState:
        step, before, under_way = self.state
        estimator = self.estimator
        agents = tuple(
            estimator.onward(step, i, self.fused(i, heard), value, bool(missed >> i & 1))
            for i, value in enumerate(before)
        )
        coming = [(r, left - 1, value) for r, left, value in under_way if left > 0]
        coming += [(m.receiver, m.delay - 1, before[m.sender]) for m in late]
        forward = [
            (r, left, estimator.pasts.number(step + 1, ("forward", estimator.labels[r]), (value,)))
            for r, left, value in coming
        ]
        return PastState(step + 1, agents, tuple(sorted(forward)))


class PastClaims:
    """What pasts claim, in numbers."""

    def __init__(self, estimator: RecursiveEstimator) -> None:
        self._worked: list[Worked] = []
        self._batch = np.zeros(len(estimator.pasts.step), dtype=int)
        self._row = np.zeros(len(estimator.pasts.step), dtype=int)
        steps: list[int] = []
        for step, rules, numbers in estimator.pasts.batches(estimator.mixed):
            if steps and step > steps[-1] and estimator.readings is None:
                self._settle([b for b, s in enumerate(steps) if s == step - 2])
            steps.append(step)
            rests_on = np.array([estimator.pasts.rests_on[n] for n in numbers], dtype=int).reshape(len(numbers), -1)
            worked = worked_out(estimator, step, rules, [self._gathered(column) for column in rests_on.T], numbers)
            self._batch[numbers], self._row[numbers] = len(self._worked), np.arange(len(numbers))
            self._worked.append(worked)
        if estimator.readings is None:
            self._settle([b for b, s in enumerate(steps) if s >= steps[-1] - 1])
        self.width, self._magnified = self._worked[-1].P[0].size, estimator.magnified
        self._on_data = estimator.readings is not None

    def estimate(self, terms: Sequence[tuple[int, np.ndarray]], step: int) -> tuple[Estimate | Moments, float]:
        """Estimates of a step, with the moments of their errors if these were carried along; nothing is summed."""
        ((_, values),) = terms
        used, index = np.unique(values, return_inverse=True)
        found, index = self._gathered(used), index.reshape(np.shape(values))
        if self._on_data:
            return Estimate(found.x[index], found.P[index]), self._magnified
        moments = Moments(found.P) if found.actual is None else Moments.of(found.P, found.actual, found.bias)
        if not np.array_equal(used, values):
            moments = moments.map(lambda m: m[index])
        return (Estimate(None, moments.P) if found.actual is None else moments), self._magnified

    def _settle(self, batches: Sequence[int]) -> None:
        """Keep of batches that nothing more rests on what may be claimed: footprints are large."""
        for batch in batches:
            self._worked[batch] = self._worked[batch].settled()

    def _gathered(self, numbers: np.ndarray) -> Worked:
        return assembled(self._worked, self._batch[numbers], self._row[numbers])


def assembled(worked: Sequence[Worked], batch: np.ndarray, row: np.ndarray) -> Worked:
    """Stacks of estimates of which each is a row of one of some batches."""
    batches = np.unique(batch)
    if len(batches) == 1:
        return Worked(*(None if a is None else a[row] for a in worked[batches[0]]))
    return Worked(
        *(_filled([worked[b][place] for b in batches], batches, batch, row) for place in range(len(Worked._fields)))
    )


def _filled(parts: Sequence[Any], batches: np.ndarray, batch: np.ndarray, row: np.ndarray) -> np.ndarray | None:
    if any(part is None for part in parts):
        return None
    out = np.empty((len(row), *parts[0].shape[1:]))
    for number, part in zip(batches, parts, strict=True):
        here = batch == number
        out[here] = part[row[here]]
    return out


class RuleError(UsageError):
    """What a fusion rule of one's own does that it must not.

    Parameters
    ----------
    why : what it is.
    item : place of the fusion in its batch.
    """

    def __init__(self, why: str, item: int = 0) -> None:
        super().__init__(why)
        self.item = item


def worked_out(
    estimator: RecursiveEstimator,
    step: int,
    rules: Sequence[FusionStep],
    rests_on: list[Worked],
    numbers: Sequence[int] | np.ndarray = (),
) -> Worked:
    """Work a batch out, and see that covariances come of it; with the pasts' numbers, errors name an agent."""
    mend = "expected noises R that are not negligible beside the errors P, in units in which P is not far from 1"
    try:
        worked = estimator.batch(step, rules, rests_on)
    except RuleError as error:
        agent = estimator.pasts.agent_of.get(int(numbers[error.item])) if len(numbers) else None
        whose = "" if agent is None else f", agent {agent + 1}"
        name = getattr(estimator, "name", "of one's own")
        raise RuleError(f"estimator {name}: step {step}{whose}: {error}", error.item) from None
    except np.linalg.LinAlgError:
        raise UsageError(f"step {step}: the covariance of an innovation is singular: {mend}") from None
    variances = np.diagonal(worked.P, axis1=-2, axis2=-1)
    if not np.isfinite(worked.P).all():
        raise UsageError(f"step {step}: the covariance of an estimate grows beyond floating point")
    if (variances < 0).any() or estimator.magnified > MOST_MAGNIFIED:
        raise UsageError(f"step {step}: rounding has the size of the covariance of an estimate: {mend}")
    return worked


FusionStep = tuple[Any, ...]
"""Name of a rule, and the numbers of the agents that it concerns."""


class Pasts(Renamed):
    """Numbers for distinct pasts; what a past rests on has smaller numbers.

    Parameters
    ----------
    symmetric : names of the rules to which the order of what they rest on does not matter.
    kinds : kind of each agent, where agents may change places with others of their kind.
    headed : names of the rules to which it does not matter but for the first.

    Attributes
    ----------
    agent_of : an agent to which a past belongs, where that is worth remembering.
    """

    def __init__(
        self, symmetric: Sequence[str] = (), kinds: Sequence[int] | None = None, headed: Sequence[str] = ()
    ) -> None:
        self.step: list[int] = []
        self.rule: list[FusionStep] = []
        self.rests_on: list[tuple[int, ...]] = []
        self.agent_of: dict[int, int] = {}
        self._symmetric, self._headed = frozenset(symmetric), frozenset(headed)
        self._number: dict[tuple[int, FusionStep, tuple[int, ...]], int] = {}
        super().__init__(kinds, None if kinds is None else Pasts(symmetric, headed=headed))

    def number(self, step: int, rule: FusionStep, rests_on: Sequence[int] = ()) -> int:
        """Return the number of a past."""
        fixed = 0 if rule[0] in self._symmetric else 1 if rule[0] in self._headed else len(rests_on)
        key = (step, rule, (*rests_on[:fixed], *sorted(rests_on[fixed:])))
        known = self._number.get(key)
        if known is None:
            known = self._number[key] = len(self.step)
            self.step.append(step)
            self.rule.append(rule)
            self.rests_on.append(key[2])
        return known

    def given(self, step: int) -> int:
        """A past of its own, whose numbers are known to whoever asks for it."""
        return self.number(step, ("given", len(self.step)))

    def _renamed(self, value: int, into: Pasts, names: Sequence[int], known: dict[int, int]) -> int:
        new = known.get(value)
        if new is None:
            name, *agents = self.rule[value]
            rests_on = [self._renamed(n, into, names, known) for n in self.rests_on[value]]
            new = known[value] = into.number(self.step[value], (name, *(names[a] for a in agents)), rests_on)
            if value in self.agent_of:
                into.agent_of.setdefault(new, names[self.agent_of[value]])
        return new

    def batches(self, mixed: Sequence[str]) -> Iterator[tuple[int, list[FusionStep], np.ndarray]]:
        """Pasts of one step and rule that rest on as many others, and on none of their own batch; in order of time.

        Parameters
        ----------
        mixed : names of the rules that are worked out together whatever agents they concern.
        """
        level: list[int] = []
        found: dict[tuple[int, int, FusionStep, int], list[int]] = {}
        for number, (step, rule, rests_on) in enumerate(zip(self.step, self.rule, self.rests_on, strict=True)):
            level.append(1 + max((level[n] for n in rests_on if self.step[n] == step), default=-1))
            what = rule[:1] if rule[0] in mixed else rule
            found.setdefault((step, level[number], what, len(rests_on)), []).append(number)
        for key in sorted(found, key=lambda key: key[:2]):
            yield key[0], [self.rule[number] for number in found[key]], np.array(found[key])
