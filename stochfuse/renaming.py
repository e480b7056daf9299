"""Values under numbers, when agents of one kind change places: what ledgers of sums and of pasts share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class Renamed:
    """Numbers for values that name agents.

    Parameters
    ----------
    kinds : kind of each agent, where agents may change places with others of their kind; None: a value stays itself.
    by_kind : where values are written with kinds in the place of agents, or None with `kinds`.
    """

    def __init__(self, kinds: Sequence[int] | None, by_kind: Any) -> None:
        self._kinds, self._by_kind = kinds, by_kind
        self._kind_of: dict[int, int] = {}
        self._moved: dict[tuple[int, ...], dict[int, int]] = {}

    def invariant(self, value: int) -> int:
        """Return a number that stays the same when agents of one kind change places."""
        if self._kinds is None:
            return value
        return self._renamed(value, self._by_kind, self._kinds, self._kind_of)

    def moved(self, value: int, order: tuple[int, ...]) -> int:
        """Return the value after agents changed places: place p is taken by agent order[p]."""
        if self._kinds is None:
            return value
        place = [0] * len(order)
        for p, agent in enumerate(order):
            place[agent] = p
        return self._renamed(value, self, place, self._moved.setdefault(order, {}))

    def _renamed(self, value: int, into: Any, names: Sequence[int], known: dict[int, int]) -> int:
        """Return the number, in another book, of a value whose agents got other names; `known` remembers."""
        raise NotImplementedError
