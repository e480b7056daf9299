"""Estimators: what the agents do with what arrives, one file each, behind one protocol.

An engine drives an estimator through the steps.  `start` is the state before the first exchange; `exchange` opens the
exchange of one step; from there `fused` tells what an agent makes of what was heard and `after` goes on to the next
step.  Numbers of agents are bits of a mask: heard[i] = 0b101 means that agent i heard agents 0 and 2.

Until then an estimator writes down values, numbers that stand for estimates, equal for equal pasts; `Claims` puts
numbers in for all of them at once.  Two families share this protocol.  Those whose estimates are sums of information
write them into a `Ledger`; all others remember pasts, see `stochfuse.estimators.recursion`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from stochfuse.estimators.ledger import Ledger, Renamed
from stochfuse.scenario.system import Noises, System


class Late(NamedTuple):
    """A message that will arrive after some steps."""

    receiver: int
    delay: int
    sender: int


class Exchange(Protocol):
    """One step's exchange of local estimates."""

    def fused(self, agent: int, heard: Sequence[int]) -> int:
        """Value of what an agent claims after every agent heard some (itself included).

        Unless the estimator is `joint`, what the others heard does not matter.
        """
        ...

    def after(
        self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0
    ) -> tuple[Hashable, tuple[int, ...]]:
        """State before the next exchange, equal for all that will behave alike from here on.

        The sensors of some agents, a mask, miss in between: these predict only.

        Like agents may change places for that: returned with it is the agent that took each place.
        """
        ...

    def onward(self, heard: Sequence[int], late: Sequence[Late] = (), missed: int = 0) -> Exchange:
        """Open the next exchange, nothing merged and nobody moved."""
        ...


class Estimator(Protocol):
    """What the agents do with what arrives.

    Attributes
    ----------
    additive : whether what agents claim after an exchange is a sum, in a ledger, of what they and what they have in
        common brought there, so that `union` and `common` tell everything; see `AdditiveEstimator`.
    joint : whether what an agent claims depends on what others heard in the same step.
    relabellings : permutations of the agents that leave network and sources as they are.
    """

    additive: bool
    joint: bool
    relabellings: Sequence[tuple[int, ...]]

    def start(self) -> Any:
        """State before the first exchange."""
        ...

    def exchange(self, state: Any) -> Exchange:
        """Open the exchange of the state's step."""
        ...


class AdditiveEstimator(Estimator, Protocol):
    """An estimator of sums of information.

    Attributes
    ----------
    ledger : where values are written.
    sources : source (of start and measurements) of every agent.
    removes : whether anything is taken for common and removed.
    """

    ledger: Ledger
    sources: tuple[int, ...]
    removes: bool

    def together(self, states: Sequence[Any]) -> AdditiveLayer | None:
        """Open the exchanges of many states of one step, or None: one by one then."""
        ...


class AdditiveLayer(Protocol):
    """The exchanges of many states of an additive estimator, with nothing under way."""

    def commons(self, clauses: Sequence[Sequence[int]]) -> np.ndarray:
        """Values of what agents that heard some sets have in common, (states, sets of sets); −1 where it is nothing.

        One set alone: what would be fused from it.
        """
        ...

    def after(self, heard: np.ndarray, missed: np.ndarray) -> tuple[np.ndarray, list[Any]]:
        """Number of the state before the next exchange, (states, outcomes), and these states.

        Parameters
        ----------
        heard : (outcomes, agents) whom each agent hears, as masks.
        missed : (outcomes,) agents whose sensors miss in between, as masks.
        """
        ...


class Claims(Protocol):
    """What the values of an estimator stand for, in numbers.

    Attributes
    ----------
    width : how many numbers one estimate takes.
    """

    width: int

    def estimate(self, terms: Sequence[tuple[int, np.ndarray]], step: int) -> tuple[Any, Any]:
        """Estimates of a step, and by how much rounding grew, one number or one for each item of a batch.

        Parameters
        ----------
        terms : sign and values, of any one shape or, but for the first, a value for all: Σ sign · value is claimed.

        An `Estimate` of P (..., d, d) and x (..., d, columns), which holds data or a noise footprint or is None; or the
        `Moments` of the error themselves.
        """
        ...


class StepOutcomes(NamedTuple):
    """What becomes of a step in many outcomes.

    Parameters
    ----------
    arrived : for every delay 0, 1 … the (run and receiver, run and sender) pairs of the messages sent at this step that
        arrive after it, numbered run·n + agent, by receiver.
    missed : (runs, agents) whose sensors miss at this step, or None if nobody's.
    """

    arrived: list[tuple[np.ndarray, np.ndarray]]
    missed: np.ndarray | None


class Together(Protocol):
    """An estimator that follows many outcomes at a time, numbers and all: what sampling of large networks uses.

    Attributes
    ----------
    size : numbers held of every outcome, about.
    """

    @property
    def size(self) -> int: ...

    def exchange(self, now: StepOutcomes) -> tuple[Any, np.ndarray]:
        """Estimates (or `Moments`) after the next step's exchange, and which of them each agent has, (runs, agents)."""
        ...


class Made(NamedTuple):
    """An estimator by its name, and what makes numbers, of a system and noises of items, of all it has written down."""

    name: str
    estimator: Any
    claims: Callable[[System, Noises], Claims]


class FusionRule:
    """What estimators that write sums of information have in common.

    Parameters
    ----------
    ledger : where values are written.
    sources : source (of start and measurements) of every agent.
    shared : whether all agents start from one common estimate.
    relabellings : permutations of the agents that leave network and sources as they are.
    """

    joint = False

    def __init__(
        self,
        ledger: Ledger,
        sources: Sequence[int],
        *,
        shared: bool = False,
        relabellings: Sequence[tuple[int, ...]] | None = None,
    ) -> None:
        self.ledger, self.sources, self.shared = ledger, tuple(sources), shared
        self.relabellings = relabellings or [tuple(range(len(self.sources)))]

    @property
    def book(self) -> Ledger:
        """Where values are written down."""
        return self.ledger

    def together(self, states: Sequence[Any]) -> AdditiveLayer | None:
        """Open the exchanges of many states: here, one by one."""
        return None

    def seen(self, missed: int) -> Iterator[int | None]:
        """Source of what each agent measures; None for those, a mask, whose sensor misses."""
        return (None if missed >> i & 1 else source for i, source in enumerate(self.sources))


def in_least_order(
    book: Renamed,
    agents: Sequence[int],
    late: Sequence[tuple[int, int, int]],
    relabellings: Sequence[tuple[int, ...]],
) -> tuple[tuple[int, ...], tuple[tuple[int, int, int], ...], tuple[int, ...]]:
    """Put agents and messages under way into the order that like states share.

    Parameters
    ----------
    book : where the values are written.
    agents : value of every agent.
    late : (receiver, steps left, value) of messages under way.
    relabellings : as for `best_relabelling`.

    Returns
    -------
    agents, late, order
        Renamed, and the agent that took each place.
    """
    if len(relabellings) == 1:
        return tuple(agents), tuple(sorted(late)), relabellings[0]
    invariants = [
        (book.invariant(value), sorted((left, book.invariant(v)) for r, left, v in late if r == i))
        for i, value in enumerate(agents)
    ]
    found = []
    for order in best_relabelling(invariants, relabellings):
        place = {i: p for p, i in enumerate(order)}
        late_now = tuple(sorted((place[r], left, book.moved(value, order)) for r, left, value in late))
        found.append((tuple(book.moved(agents[i], order) for i in order), late_now, order))
    return min(found)


def best_relabelling(invariants: Sequence[Hashable], relabellings: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Return the relabellings of like agents that put invariants into their least order.

    Parameters
    ----------
    invariants : one comparable per agent, the same whatever the agents are called.
    relabellings : permutations that change nothing in the network; place a of the new order is taken by agent p[a].
    """
    if len(relabellings) == 1:
        return list(relabellings)
    best: list[tuple[int, ...]] = []
    least: Any = None
    for p in relabellings:
        order = [invariants[a] for a in p]
        if least is None or order < least:
            best, least = [p], order
        elif order == least:
            best.append(p)
    return best
