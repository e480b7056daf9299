"""Sampling until a precision is reached: every shown standard error below a share of its value.

Whoever looks at a sample after every run and stops when it looks good stops too early, and is biased.  So the size is
fixed from a first stage alone (Stein 1945, Annals of Mathematical Statistics 16, 243): from its R_1 runs the largest
share s of a standard error in its value, and then

    R = R_1 (s / asked)² / q         q: what a χ² of R_1 − 1 degrees of freedom, over these, exceeds in 97.5 % of cases

runs in all, that the first stage's luck with its variance does not leave the second one short.  Where it does so all
the same, or where R would be more than `GROWTH` times R_1, a further stage is fixed in the same way from all runs there
are.  A limit of time looks at the clock, never at the values: the runs that fit are the answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import ceil, inf, isfinite
from typing import Any, NamedTuple

from stochfuse.engines.monte_carlo import BLOCK
from stochfuse.estimators.progress import within

FIRST, FEWEST = 400, 24
"""Most and fewest runs of the first stage."""
GROWTH = 40
"""How many times as many runs a stage makes of those before."""
PARTS = 8
"""Parts that a stage is drawn in, after each of which the time left is told."""
FEW = 20
"""Runs that show what a run takes, and for which no further part is begun."""

Parts = list[tuple[int, int]]
"""Number of runs, and first block of random numbers, of every part of a sample."""


class Reached(NamedTuple):
    """How far a sample came.

    Parameters
    ----------
    asked, reached : largest share of a standard error in its value.
    stopped : what ended it before that, in words; empty if nothing did.
    """

    asked: float
    reached: float
    stopped: str = ""

    @property
    def for_programs(self) -> dict[str, float | None]:
        """What was asked and what was reached; None where an error is no share of a value, which is 0."""
        return {"asked": self.asked, "reached": self.reached if isfinite(self.reached) else None}


class _Drawing:
    """A sample that grows by parts, as long as there is time.

    Parameters
    ----------
    draw : goes on with a sample (None at first), by so many runs, from a block of random numbers on.
    at_most : seconds, or None.
    block : runs that are drawn from one seed.
    said : what is drawn for, in words.
    """

    def __init__(self, draw: Callable[[Any, int, int], Any], at_most: float | None, block: int, said: str) -> None:
        self.sample: Any = None
        self.parts: Parts = []
        self._draw, self._said, self._block, self._begun = draw, said, block, time.monotonic()
        self._end = inf if at_most is None else self._begun + at_most

    @property
    def runs(self) -> int:
        """Runs so far."""
        return sum(runs for runs, _ in self.parts)

    def to(self, target: int) -> bool:
        """Draw until there are so many runs; whether there was the time."""
        missing = target - self.runs
        while self.runs < target:
            left, rest = self._end - time.monotonic(), target - self.runs
            now = min(rest, max(BLOCK, -(-missing // PARTS)))
            if self.parts:
                cost = (time.monotonic() - self._begun) / self.runs
                now, left = min(now, int(min(left / cost, rest))), min(left, rest * cost)
                if now < min(FEW, rest):
                    return False
            elif left < inf:
                now = min(now, FEW)  # which show what a run takes
            told = f", about {left:.0f} s left" if self.parts else ""
            with within(f"{self._said}{told}", self.runs + 1, target):
                first = sum(-(-runs // self._block) for runs, _ in self.parts)
                self.sample = self._draw(self.sample, now, first)
            self.parts.append((now, first))
        return True


def sampled_to(
    asked: float,
    at_most: float | None,
    sizes: tuple[int, int],
    block: int,
    draw: Callable[[Any, int, int], Any],
    judge: Callable[[Any, Parts], tuple[Any, float]],
) -> tuple[Any, Reached]:
    """Draw until a precision is reached.

    Parameters
    ----------
    asked, at_most : precision, and seconds or None.
    sizes : runs of the first stage, and runs that can be held.
    block : runs that are drawn from one seed.
    draw : goes on with a sample (None at first), by so many runs, from a block of random numbers on.
    judge : what a sample, of some parts, comes to, and its largest share of a standard error in its value.
    """
    drawing, most = _Drawing(draw, at_most, block, f"to {100 * asked:.3g} % of every value"), sizes[1]
    target = min(sizes)
    while True:
        in_time = drawing.to(target)
        found, reached = judge(drawing.sample, drawing.parts)
        if reached <= asked:
            return found, Reached(asked, reached)
        if not in_time:
            return found, Reached(asked, reached, f"{at_most:g} s were over")
        if target >= most:
            return found, Reached(asked, reached, f"{most:,} runs are the most that are held")
        target = min(most, stage(target, reached / asked))


def stage(runs: int, excess: float) -> int:
    """Runs in all that a sample needs whose largest error is so many times what is asked for.

    By the χ² distribution's lower 2.5 % as Wilson and Hilferty approximate it.
    """
    by = 2.0 / (9.0 * (runs - 1))
    q = (1.0 - by - 1.96 * by**0.5) ** 3 if by < 0.1 else 0.2
    wanted = runs * excess**2 / q
    return ceil(min(wanted, GROWTH * runs)) if isfinite(wanted) else GROWTH * runs
