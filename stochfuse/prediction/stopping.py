"""Sampling until a precision is reached: every shown standard error below a share of its value.

Whoever looks at a sample after every run and stops when it looks good stops too early, and is biased.  So the size is
fixed from a first stage alone (Stein 1945, Annals of Mathematical Statistics 16, 243): from its R_1 runs the largest
share s of a standard error in its value, and then

    R = R_1 (s / asked)² / q         q: what a χ² of R_1 − 1 degrees of freedom, over these, exceeds in 97.5 % of cases

runs in all, that the first stage's luck with its variance does not leave the second one short.  Where it does so all
the same, or where R would be more than `GROWTH` times R_1, a further stage is fixed in the same way from all runs there
are.  A limit of time looks at the clock, never at the values: the runs that fit are the answer.  Where runs are dear, R
is fixed for every step, and those that only early steps need end there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import ceil, inf, isfinite
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.monte_carlo import BLOCK
from stochfuse.estimators.progress import within

FIRST, FEWEST = 400, 16
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
    draw : as for `sampled_to`.
    at_most : seconds, or None.
    block : runs that are drawn from one seed.
    said : what is drawn for, in words.
    """

    def __init__(self, draw: Callable[..., Any], at_most: float | None, block: int, said: str) -> None:
        self.sample: Any = None
        self.parts: Parts = []
        self.followed = np.zeros(1, dtype=int)  # runs so far, to every step
        self._draw, self._said, self._block, self._begun = draw, said, block, time.monotonic()
        self._end = inf if at_most is None else self._begun + at_most

    def to(self, targets: np.ndarray) -> bool:
        """Draw until so many runs are followed to every step; whether there was the time."""
        self.followed = np.broadcast_to(self.followed, targets.shape).copy()
        pieces = -(-int((targets - self.followed).max()) // PARTS)
        while len(short := np.flatnonzero(self.followed < targets)):
            upto = int(short[-1]) + 1
            left, rest = self._end - time.monotonic(), int((targets - self.followed)[upto - 1])
            now = min(rest, max(BLOCK, pieces))
            if self.parts:
                cost = (time.monotonic() - self._begun) / self.followed.sum() * upto
                now, left = min(now, int(min(left / cost, rest))), min(left, rest * cost)
                if now < min(FEW, rest):
                    return False
            elif left < inf:
                now = min(now, FEW)  # which show what a run takes
            told = f", about {left:.0f} s left" if self.parts else ""
            with within(f"{self._said}{told}", int(self.followed[0]) + 1, int(targets[0])):
                first = sum(-(-runs // self._block) for runs, _ in self.parts)
                whole = upto == len(targets)
                self.sample = self._draw(self.sample, now, first, *(() if whole else (upto,)))
            self.parts.append((now, first))
            self.followed[:upto] += now
        return True


def sampled_to(
    asked: float,
    at_most: float | None,
    sizes: tuple[int, int],
    block: int,
    draw: Callable[..., Any],
    judge: Callable[[Any, Parts], tuple[Any, np.ndarray]],
) -> tuple[Any, Reached]:
    """Draw until a precision is reached.

    Parameters
    ----------
    asked, at_most : precision, and seconds or None.
    sizes : runs of the first stage, and runs that can be held.
    block : runs that are drawn from one seed.
    draw : goes on with a sample (None at first), by so many runs, from a block of random numbers on, and, if they are
        not to be followed to the end, up to a step.
    judge : what a sample, of some parts, comes to, and its largest share of a standard error in its value: of every
        step, or one for all, which are then followed to the end.
    """
    drawing, most = _Drawing(draw, at_most, block, f"to {100 * asked:.3g} % of every value"), sizes[1]
    targets = np.array([min(sizes)])
    while True:
        in_time = drawing.to(targets)
        found, shares = judge(drawing.sample, drawing.parts)
        reached, followed = float(shares.max()), np.broadcast_to(drawing.followed, shares.shape)
        if reached <= asked:
            return found, Reached(asked, reached)
        if not in_time:
            return found, Reached(asked, reached, f"{at_most:g} s were over")
        if targets[0] >= most:
            return found, Reached(asked, reached, f"{most:,} runs are the most that are held")
        wanted = [stage(n, s / asked) if s > asked else n for n, s in zip(followed.tolist(), shares, strict=True)]
        targets = lengths(np.maximum(np.minimum(wanted, most), followed))


def lengths(wanted: np.ndarray) -> np.ndarray:
    """Runs that are followed to every step, where so many are wanted: of two lengths, and fewest steps in all."""
    need, steps = np.maximum.accumulate(wanted[::-1])[::-1], np.arange(len(wanted))
    early = int((need[0] * steps + need * (len(steps) - steps)).argmin())
    return np.where(steps < early, need[0], need[early])


def stage(runs: int, excess: float) -> int:
    """Runs in all that a sample needs whose largest error is so many times what is asked for.

    By the χ² distribution's lower 2.5 % as Wilson and Hilferty approximate it.
    """
    by = 2.0 / (9.0 * (runs - 1))
    q = (1.0 - by - 1.96 * by**0.5) ** 3 if by < 0.1 else 0.2
    wanted = runs * excess**2 / q
    return ceil(min(wanted, GROWTH * runs)) if isfinite(wanted) else GROWTH * runs
