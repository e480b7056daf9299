"""Pasts: what estimates are made of, under numbers that are equal where the pasts are equal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from stochfuse.renaming import Renamed

Rule = tuple[Any, ...]
"""Name of a rule, and the numbers of the agents that it concerns."""


class Pasts(Renamed):
    """Numbers for distinct pasts; what a past rests on has smaller numbers.

    Parameters
    ----------
    symmetric : names of the rules to which the order of what they rest on does not matter.
    kinds : kind of each agent, where agents may change places with others of their kind.
    """

    def __init__(self, symmetric: Sequence[str] = (), kinds: Sequence[int] | None = None) -> None:
        self.step: list[int] = []
        self.rule: list[Rule] = []
        self.rests_on: list[tuple[int, ...]] = []
        self._symmetric = frozenset(symmetric)
        self._number: dict[tuple[int, Rule, tuple[int, ...]], int] = {}
        super().__init__(kinds, None if kinds is None else Pasts(symmetric))

    def number(self, step: int, rule: Rule, rests_on: Sequence[int] = ()) -> int:
        """Return the number of a past."""
        key = (step, rule, tuple(sorted(rests_on) if rule[0] in self._symmetric else rests_on))
        known = self._number.get(key)
        if known is None:
            known = self._number[key] = len(self.step)
            self.step.append(step)
            self.rule.append(rule)
            self.rests_on.append(key[2])
        return known

    def _renamed(self, value: int, into: Pasts, names: Sequence[int], known: dict[int, int]) -> int:
        new = known.get(value)
        if new is None:
            name, *agents = self.rule[value]
            rests_on = [self._renamed(n, into, names, known) for n in self.rests_on[value]]
            new = known[value] = into.number(self.step[value], (name, *(names[a] for a in agents)), rests_on)
        return new

    def batches(self, mixed: Sequence[str]) -> Iterator[tuple[int, list[Rule], np.ndarray]]:
        """Pasts of one step and rule that rest on as many others, and on none of their own batch; in order of time.

        Parameters
        ----------
        mixed : names of the rules that are worked out together whatever agents they concern.
        """
        level: list[int] = []
        found: dict[tuple[int, int, Rule, int], list[int]] = {}
        for number, (step, rule, rests_on) in enumerate(zip(self.step, self.rule, self.rests_on, strict=True)):
            level.append(1 + max((level[n] for n in rests_on if self.step[n] == step), default=-1))
            what = rule[:1] if rule[0] in mixed else rule
            found.setdefault((step, level[number], what, len(rests_on)), []).append(number)
        for key in sorted(found, key=lambda key: key[:2]):
            yield key[0], [self.rule[number] for number in found[key]], np.array(found[key])
