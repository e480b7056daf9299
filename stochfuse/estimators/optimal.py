"""The best that any linear fusion could do with what arrived: no node's measurement is lost.

An agent holds the measurements of all nodes in its pedigree, so for every step t a set r_t of agents.  What it would
claim is one filter over all of them,

    Y = Y_0(r_1)      Y ← TU(Y⁻¹)⁻¹ + Σ_{j∈r_t} H_jᵀR_j⁻¹H_j      t = 2 … k

and is what it truly achieves.  A received node brings the measurements of its whole pedigree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from stochfuse.estimators.ledger import COMMON, Ledger
from stochfuse.estimators.protocol import FusionRule, Late, best_relabelling

Held = tuple[int, ...]
"""Agents whose measurement of step 1, 2, … is held, as masks."""


class KnownSets(NamedTuple):
    """Before an exchange: what every agent holds, and (receiver, steps left, held) of messages under way.

    Where all hold the same of the first steps, these may be left out: `base` is then what they come to.
    """

    agents: tuple[Held, ...]
    late: tuple[tuple[int, int, Held], ...] = ()
    base: int | None = None


class OptimalFusion(FusionRule):
    """The estimator; parameters are those of `FusionRule`."""

    removes, additive = True, False

    def __init__(self, ledger: Ledger, sources: Sequence[int], **more: Any) -> None:
        super().__init__(ledger, sources, **more)
        self._values: dict[tuple[int | None, Held], int] = {}

    def start(self) -> KnownSets:
        """Everyone's initial estimate."""
        return KnownSets(tuple((1 << i,) for i in range(len(self.sources))))

    def exchange(self, state: KnownSets) -> OptimalExchange:
        """Open the exchange of the state's step."""
        return OptimalExchange(self, state)

    def value(self, held: Held, base: int | None = None) -> int:
        """Value, in the ledger, of one filter over everything held, after what the base is of."""
        values, first = self._values, len(held)
        while first and (base, held[:first]) not in values:
            first -= 1
        value = values[base, held[:first]] if first else base
        for t in range(first, len(held)):
            members = [self.sources[i] for i in range(len(self.sources)) if held[t] >> i & 1]
            if value is not None:
                value = self.ledger.measured(value, members)
            elif self.shared:
                value = self.ledger.start(COMMON)
            else:
                value = self.ledger.combine(1, [(self.ledger.start(source), 1) for source in members])
            values[base, held[: t + 1]] = value
        if value is None:
            raise ValueError("expected something held")
        return value

    def rests_on(self, state: KnownSets) -> Iterator[int]:
        """Values that a state rests on: what all hold, and each agent's own."""
        base, known, _ = self._shared_part(state)
        yield from (value for value in {state.base, base} if value is not None)
        yield from known

    def renamed(self, state: KnownSets, names: Mapping[int, int], into: OptimalFusion) -> KnownSets:
        """Return the state, without what all hold, with the numbers that another one of these has for its values."""
        base, _, shared = self._shared_part(state)
        agents = tuple(held[shared:] for held in state.agents)
        late = tuple((r, left, held[shared:]) for r, left, held in state.late)
        return KnownSets(agents, late, None if base is None else names[base])

    def _shared_part(self, state: KnownSets) -> tuple[int | None, list[int], int]:
        """Value of the first steps, of which all hold the same; every agent's value; and how many these steps are."""
        everything = [*state.agents, *(held for _, _, held in state.late)]
        longest = min(map(len, everything)) - 1
        shared = next((t for t in range(longest) if len({held[t] for held in everything}) > 1), max(longest, 0))
        known = [self.value(held, state.base) for held in state.agents]
        base = self.value(state.agents[0][:shared], state.base) if shared else state.base
        return base, known, shared


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
        return self.estimator.value(self.held(agent, heard[agent]), self.state.base)

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
        return KnownSets(agents, tuple(sorted(under_way)), self.state.base)


def _moved(state: KnownSets, order: tuple[int, ...]) -> KnownSets:
    place = {agent: p for p, agent in enumerate(order)}

    def moved(held: Held) -> Held:
        return tuple(sum(1 << p for i, p in place.items() if mask >> i & 1) for mask in held)

    late = tuple(sorted((place[r], left, moved(held)) for r, left, held in state.late))
    return KnownSets(tuple(moved(state.agents[i]) for i in order), late, state.base)
