"""What the thesis states about its figures, and how our numbers judge it.

A statement is checked by a function that works out its numbers and says whether they meet the criterion.  A verdict
is "agrees" or "differs" from that alone.  Where the cause of what the thesis saw is known, the check works out the
numbers of the cause as well and the verdict is "explained" only if both hold; where neither can be decided, "open".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stochfuse.report.reproductions import Finding
from stochfuse.thesis.bench import Bench

Verdict = tuple[str, str]
"""The verdict and our numbers in words."""


@dataclass(frozen=True)
class Statement:
    """Something that the thesis states.

    Parameters
    ----------
    items : keys of the figures and tables that it is about.
    thesis : the statement, in our words.
    criterion : what the verdict follows from.
    check : works out verdict and numbers.
    """

    items: tuple[str, ...]
    thesis: str
    criterion: str
    check: Callable[[Bench], Verdict]

    def judge(self, bench: Bench) -> Finding:
        """Return the statement with our numbers and the verdict."""
        verdict, ours = self.check(bench)
        return Finding(self.items, self.thesis, ours, self.criterion, verdict)


def judged(holds: bool | np.bool_, ours: str, otherwise: str = "differs") -> Verdict:
    """Return "agrees" if the criterion is met."""
    return ("agrees" if holds else otherwise), ours


def explained(seen: bool | np.bool_, cause: bool | np.bool_, ours: str, otherwise: str = "differs") -> Verdict:
    """Return "explained" if what the thesis saw is seen and its cause is shown; else what is left."""
    return ("explained" if seen and cause else "agrees" if seen else otherwise), ours


def listed(values: Sequence[float] | np.ndarray, digits: int = 4, unit: str = "") -> str:
    """Return numbers in words: 1, 2, 3."""
    return ", ".join(f"{value + 0.0:.{digits}g}" for value in values) + unit


def figures(*numbers: int) -> tuple[str, ...]:
    """Return the keys of some figures."""
    return tuple(f"figure-{number}" for number in numbers)
