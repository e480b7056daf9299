"""(54) in fifty digits, for a least link probability that the rounding of double precision leaves uncertain.

Where a curve is so flat that rounding moves its crossing of the target by more than is wanted, the crossing is found
again with the same equations over mpmath's numbers: `stochfuse.kalman` and `stochfuse.simplified` as they are, numbers
of `DIGITS` digits in the place of elements of a field.
"""

from __future__ import annotations

from math import comb
from typing import Any

import numpy as np

from stochfuse.algebra import FIELD
from stochfuse.inverse.question import Question
from stochfuse.kalman import Estimate, predict
from stochfuse.model import at_step
from stochfuse.network import number_of_senders
from stochfuse.quantities import linear
from stochfuse.simplified import average, outcome

DIGITS = 50
WANTED = 1e-10
"""Width of an enclosure that is good enough."""
CERTAIN = 1e-14
"""Half-width of the enclosure afterwards."""
MOST_UPDATES = 300
"""Updates (agents times steps) that are worth the time."""


def refinable(asked: Question) -> bool:
    """Whether a question is about (54) for like agents with one measurement each, and a linear metric."""
    network = asked.scenario.network
    return (
        asked.method == "simplified"
        and asked.step is not None
        and len(asked.scenario.sensors) == 1
        and linear(asked.quantity, asked.metric)
        and asked.quantity == "claimed"
        and network.agents * network.steps <= MOST_UPDATES
        and asked.scenario.sensors[0].H.shape[-2] == 1
    )


def refined(asked: Question, target: float, enclosure: tuple[float, float]) -> tuple[float, tuple[float, float]] | None:
    """Return the crossing of the target within an enclosure, and what encloses it now; None if it is not in there."""
    import mpmath

    with mpmath.workdps(DIGITS):
        gap = lambda µ: expected(asked, µ) - mpmath.mpf(target)  # noqa: E731
        low, high = map(mpmath.mpf, enclosure)
        if gap(low) <= 0 or gap(high) > 0:
            return None
        least = float(mpmath.findroot(gap, (low, high), solver="anderson", tol=1e-30, maxsteps=60, verify=False))
        sides = max(enclosure[0], least - CERTAIN), min(enclosure[1], least + CERTAIN)
        return (least, sides) if gap(sides[0]) >= 0 >= gap(sides[1]) else None


def expected(asked: Question, µ: Any) -> Any:
    """E(µ) of (54) at the step asked about, in mpmath's working precision."""
    import mpmath

    scenario = asked.scenario
    senders = number_of_senders(scenario.network.architecture, scenario.network.agents)
    µ = mpmath.mpf(µ)
    weights = [comb(senders, m) * µ**m * (1 - µ) ** (senders - m) for m in range(senders + 1)]
    P = _precise(scenario.P0)
    if scenario.correlation != "shared":
        P = average([Estimate(None, P / (m + 1)) for m in range(senders + 1)], weights).P
    sensor = scenario.sensors[0]
    for step in range(2, scenario.network.steps + 1):
        F, Q, H, R = (_precise(at_step(A, step)) for A in (scenario.model.F, scenario.model.Q, sensor.H, sensor.R))
        prior = predict(Estimate(None, P), F, Q, algebra=FIELD)
        P = average([outcome(prior, H, R, m, algebra=FIELD) for m in range(senders + 1)], weights).P
    return asked.metric.of(P)


def _precise(A: np.ndarray) -> np.ndarray:
    import mpmath

    return np.array([[mpmath.mpf(float(a)) for a in row] for row in A], dtype=object)
