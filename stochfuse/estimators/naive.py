"""Naive fusion, thesis (42)/(43): add up what arrives and subtract nothing.

    P_j⁻¹(k) = Σ P_i⁻¹(k|k)      P_j⁻¹(k) x̂_j(k) = Σ P_i⁻¹(k|k) x̂_i(k|k)      over what agent j heard, itself included

Right only where the estimates are independent; what they share is counted again at every exchange, so that the claimed
covariance falls below what any estimator can reach.  A late message is brought forward and added too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from stochfuse.estimators.layers import NaiveLayer, NaiveState
from stochfuse.estimators.ledger import COMMON
from stochfuse.estimators.protocol import AdditiveLayer, FusionRule, Late, in_least_order


class NaiveFusion(FusionRule):
    """The estimator; parameters are those of `FusionRule`.  A shared start is not recognised as such."""

    removes, additive = False, True

    def start(self) -> NaiveState:
        """Everyone's initial estimate."""
        return NaiveState(tuple(self.ledger.start(COMMON if self.shared else source) for source in self.sources))

    def exchange(self, state: NaiveState) -> NaiveExchange:
        """Open the exchange of the state's step."""
        return NaiveExchange(self, state)

    def together(self, states: Sequence[NaiveState]) -> AdditiveLayer | None:
        """Open the exchanges of many states, where nothing is under way."""
        return None if any(state.late for state in states) else NaiveLayer(self, states)

    def rests_on(self, state: NaiveState) -> Iterator[int]:
        """Values that a state rests on."""
        yield from state.agents
        yield from (value for _, _, value in state.late)

    def renamed(self, state: NaiveState, names: Mapping[int, int], into: NaiveFusion) -> NaiveState:
        """Return the state with the numbers that another one of these has for its values."""
        late = tuple(sorted((receiver, left, names[value]) for receiver, left, value in state.late))
        return NaiveState(tuple(names[value] for value in state.agents), late)


class NaiveExchange:
    """One exchange."""

    def __init__(self, estimator: NaiveFusion, state: NaiveState) -> None:
        self.estimator, self.state = estimator, state
        self._step = estimator.ledger.step[state.agents[0]]
        self._due: list[list[int]] = [[] for _ in state.agents]
        for receiver, left, value in state.late:
            if left == 0:
                self._due[receiver].append(value)
        self._fused: dict[int, int] = {}

    def union(self, heard: int) -> int:
        """Value of the sum of the agents heard."""
        known = self._fused.get(heard)
        if known is None:
            terms = [(value, 1) for i, value in enumerate(self.state.agents) if heard >> i & 1]
            known = self._fused[heard] = self.estimator.ledger.combine(self._step, terms)
        return known

    def common(self, clauses: Sequence[int]) -> int:
        """Value of what an agent that heard a set has, the only clause: nothing else is taken for common."""
        (heard,) = clauses
        return self.union(heard)

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value that an agent claims after hearing some agents, with what else is due."""
        if not self._due[agent]:
            return self.union(heard[agent])
        terms = [(self.union(heard[agent]), 1), *((value, 1) for value in self._due[agent])]
        return self.estimator.ledger.combine(self._step, terms)

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[NaiveState, tuple[int, ...]]:
        """State before the next exchange, in the order that like states share, and the agent at each place of it."""
        estimator = self.estimator
        agents, under_way, order = in_least_order(
            estimator.ledger, *self._next(heard, late, missed), estimator.relabellings
        )
        return NaiveState(agents, under_way), order

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> NaiveExchange:
        """Open the next exchange as it comes."""
        agents, under_way = self._next(heard, late, missed)
        return NaiveExchange(self.estimator, NaiveState(tuple(agents), tuple(under_way)))

    def _next(
        self, heard: Sequence[int], late: Sequence[Late], missed: int
    ) -> tuple[list[int], list[tuple[int, int, int]]]:
        ledger, sources = self.estimator.ledger, self.estimator.seen(missed)
        agents = [ledger.local(self.fused(i, heard), source) for i, source in enumerate(sources)]
        under_way = [(r, left - 1, value) for r, left, value in self.state.late if left > 0]
        under_way += [(m.receiver, m.delay - 1, self.state.agents[m.sender]) for m in late]
        return agents, under_way
