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
from stochfuse.engines.progress import within
from stochfuse.errors import UsageError

FIRST = 400
"""Runs of the first stage."""
GROWTH = 40
"""How many times as many runs a stage makes of those before."""
PARTS = 8
"""Parts that a stage is drawn in, after each of which the time left is told."""
FEW = 20
"""Runs for which no further part is begun."""

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


def share(value: float | str) -> float:
    """Return a precision as a share: of 0.002, "0.002" or "0.2%".

    Raises
    ------
    UsageError
        If it is none, or not between 0 and 1.
    """
    text = str(value).strip()
    try:
        found = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        found = 0.0
    if not 0.0 < found < 1.0:
        raise UsageError(f"precision: expected a share between 0 and 1, such as 0.2% or 0.002, got '{value}'")
    return found


def seconds(value: float | str) -> float:
    """Return a time in seconds: of 60, "60s" or "2min".

    Raises
    ------
    UsageError
        If it is none, or not positive.
    """
    text = str(value).strip()
    unit = next((u for u in ("min", "s", "h") if text.endswith(u)), "")
    try:
        found = float(text.removesuffix(unit)) * {"min": 60.0, "h": 3600.0}.get(unit, 1.0)
    except ValueError:
        found = 0.0
    if not 0.0 < found < inf:
        raise UsageError(f"at-most: expected a time such as 60s or 2min, got '{value}'")
    return found


def sampled_to(
    asked: float,
    at_most: float | None,
    most: int,
    draw: Callable[[Any, int, int], Any],
    judge: Callable[[Any, Parts], tuple[Any, float]],
) -> tuple[Any, Parts, Reached]:
    """Draw until a precision is reached.

    Parameters
    ----------
    asked, at_most : precision, and seconds or None.
    most : runs that can be held.
    draw : goes on with a sample (None at first), by so many runs, from a block of random numbers on.
    judge : what a sample, of some parts, comes to, and its largest share of a standard error in its value.
    """
    begun, parts = time.monotonic(), [(min(FIRST, most), 0)]
    drawn = draw(None, *parts[0])
    while True:
        found, reached = judge(drawn, parts)
        runs = sum(n for n, _ in parts)
        if reached <= asked:
            return found, parts, Reached(asked, reached)
        if runs >= most:
            return found, parts, Reached(asked, reached, f"{most:,} runs are the most that are held")
        cost = (time.monotonic() - begun) / runs
        end = inf if at_most is None else begun + at_most
        before = runs
        target = min(most, stage(runs, reached / asked))
        while runs < target:
            affordable = (end - time.monotonic()) / cost
            now = min(max(BLOCK, -(-(target - before) // PARTS)), target - runs)
            if affordable < now:
                now = int(affordable)
            if now < FEW and now < target - runs:
                break
            left = min((target - runs) * cost, end - time.monotonic())
            with within(f"to {asked:.3g} of every value, about {left:.0f} s left", runs + 1, target):
                parts.append((now, parts[-1][1] + -(-parts[-1][0] // BLOCK)))
                drawn = draw(drawn, *parts[-1])
            runs += now
        if runs < target:
            found, reached = judge(drawn, parts) if runs > before else (found, reached)
            stopped = "" if reached <= asked else f"the {at_most:g} s were over"
            return found, parts, Reached(asked, reached, stopped)


def stage(runs: int, excess: float) -> int:
    """Runs in all that a sample needs whose largest error is so many times what is asked for.

    By the χ² distribution's lower 2.5 % as Wilson and Hilferty approximate it.
    """
    by = 2.0 / (9.0 * (runs - 1))
    q = (1.0 - by - 1.96 * by**0.5) ** 3 if by < 0.1 else 0.2
    wanted = runs * excess**2 / q
    return ceil(min(wanted, GROWTH * runs)) if isfinite(wanted) else GROWTH * runs
