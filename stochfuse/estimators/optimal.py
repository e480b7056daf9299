"""The best that any linear fusion could do with what arrived: no node's measurement is lost.

An agent holds the measurements of all nodes in its pedigree, so for every step t a set r_t of agents.  What it would
claim is one filter over all of them,

    Y = Y_0(r_1)      Y ← TU(Y⁻¹)⁻¹ + Σ_{j∈r_t} H_jᵀR_j⁻¹H_j      t = 2 … k

and is what it truly achieves.  A received node brings the measurements of its whole pedigree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from stochfuse.estimators.ledger import COMMON, Ledger
from stochfuse.estimators.protocol import FusionRule, Late, best_relabelling

Held = tuple[int, ...]
"""Agents whose measurement of step 1, 2, … is held, as masks."""


class KnownSets(NamedTuple):
    """Before an exchange: what every agent holds, and (receiver, steps left, held) of messages under way."""

    agents: tuple[Held, ...]
    late: tuple[tuple[int, int, Held], ...] = ()


class OptimalFusion(FusionRule):
    """The estimator; parameters are those of `FusionRule`."""

    removes, additive = True, False

    def __init__(self, ledger: Ledger, sources: Sequence[int], **more: Any) -> None:
        super().__init__(ledger, sources, **more)
        self._values: dict[Held, int] = {}

    def start(self) -> KnownSets:
        """Everyone's initial estimate."""
        return KnownSets(tuple((1 << i,) for i in range(len(self.sources))))

    def exchange(self, state: KnownSets) -> OptimalExchange:
        """Open the exchange of the state's step."""
        return OptimalExchange(self, state)

    def value(self, held: Held) -> int:
        """Value, in the ledger, of one filter over everything held."""
        known = self._values.get(held)
        if known is None:
            *before, last = held
            members = [self.sources[i] for i in range(len(self.sources)) if last >> i & 1]
            if before:
                known = self.ledger.measured(self.value(tuple(before)), members)
            elif self.shared:
                known = self.ledger.start(COMMON)
            else:
                known = self.ledger.combine(1, [(self.ledger.start(source), 1) for source in members])
            self._values[held] = known
        return known


class OptimalExchange:
    """One exchange."""

    def __init__(self, estimator: OptimalFusion, state: KnownSets) -> None:
        self.estimator, self.state = estimator, state
        self._due: list[list[Held]] = [[] for _ in state.agents]
        for receiver, left, held in state.late:
            if left == 0:
                self._due[receiver].append(held)

    def held(self, agent: int, heard: int) -> Held:
        """What an agent holds after hearing some agents, with what else is due."""
        union = list(self.state.agents[agent])
        brought = [self.state.agents[i] for i in range(len(self.state.agents)) if heard >> i & 1 and i != agent]
        for held in [*brought, *self._due[agent]]:
            for t, mask in enumerate(held):
                union[t] |= mask
        return tuple(union)

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value that an agent would claim after hearing some agents, with what else is due."""
        return self.estimator.value(self.held(agent, heard[agent]))

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[KnownSets, tuple[int, ...]]:
        """State before the next exchange, in the order that like states share, and the agent at each place of it."""
        state = self._next(heard, late, missed)
        counts = [tuple(mask.bit_count() for mask in held) for held in state.agents]
        return min((_moved(state, order), order) for order in best_relabelling(counts, self.estimator.relabellings))

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> OptimalExchange:
        """Open the next exchange as it comes."""
        return OptimalExchange(self.estimator, self._next(heard, late, missed))

    def _next(self, heard: Sequence[int], late: Sequence[Late], missed: int) -> KnownSets:
        under_way = [(r, left - 1, held) for r, left, held in self.state.late if left > 0]
        under_way += [(m.receiver, m.delay - 1, self.state.agents[m.sender]) for m in late]
        agents = tuple((*self.held(i, h), 1 << i & ~missed) for i, h in enumerate(heard))
        return KnownSets(agents, tuple(sorted(under_way)))


def _moved(state: KnownSets, order: tuple[int, ...]) -> KnownSets:
    place = {agent: p for p, agent in enumerate(order)}

    def moved(held: Held) -> Held:
        return tuple(sum(1 << p for i, p in place.items() if mask >> i & 1) for mask in held)

    late = tuple(sorted((place[r], left, moved(held)) for r, left, held in state.late))
    return KnownSets(tuple(moved(state.agents[i]) for i in order), late)
