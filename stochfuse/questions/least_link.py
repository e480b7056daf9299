"""A question asked backwards: the least link probability that meets a target.

With E(µ) the number asked about (a metric of a quantity, at a step or in the steady state), one µ for all links,

    least µ          µ* = min {µ in [0, 1] : E(µ) ≤ target}

E need not fall throughout (an RMS error with an initial bias first rises), so that µ* is not simply "the" root: every
interval in which the target is met is found, and where the first one begins is the answer.  [0, 1] is cut into cells in
which E crosses the target at most once; every crossing is then narrowed down between a point that misses the target and
one that meets it, so that each end found meets the target itself.  Why no smaller µ meets it comes with the cells:

* `monotone`: (54) and the optimum average, over a number of measurements that grows with µ (and with n) in
  probability, a covariance that falls with that number, through time updates that keep the order; so E falls.
* `polynomial`: one enumeration gives E = Σ A_c µ^c (1−µ)^(L−c).  In Bernstein's form E has, by Descartes' rule of
  signs, at most as many roots in a cell as its coefficients have changes of sign there, and de Casteljau's halving
  gives the coefficients of both halves, until the roots are parted.
* `scan`: anything else is looked at closely.

Where a curve is so flat that rounding moves its crossing by more than is wanted, the crossing of (54) is found again
with the same equations over mpmath's numbers: `stochfuse.kalman.kernel` and `stochfuse.prediction.simplified` as they
are, numbers of `DIGITS` digits in the place of elements of a field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import comb, inf, isfinite, log
from typing import Any, NamedTuple

import mpmath
import numpy as np

from stochfuse.engines.events import bernstein
from stochfuse.errors import NoAnswerError
from stochfuse.kalman.algebra import FIELD
from stochfuse.kalman.kernel import Estimate, at_step, predict
from stochfuse.prediction.quantities import linear
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.simplified import average, outcome
from stochfuse.questions.question import (
    SLACK,
    Question,
    check_target,
    described,
    question,
    relative_bound,
    require_like_links,
)
from stochfuse.scenario.network import number_of_senders
from stochfuse.scenario.registry import OPTIMAL, SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, of_scenario

Function = Callable[[np.ndarray], np.ndarray]

SCAN = 2049
SECTIONS = 64
NARROWEST = 2.0**-44
"""Width of a cell that is cut no further: two roots so close are one."""
SPARE = 8
"""Evaluations by which interpolation may turn out slower than halving."""
MOST_CELLS = 4096
"""Cells that may be undecided at a time: more are rounding, where the function is as good as constant."""


def intervals(
    value: Function, cells: np.ndarray, target: float, sections: int = SECTIONS
) -> tuple[tuple[float, float], ...]:
    """Return the intervals of [0, 1] in which the target is met.

    Parameters
    ----------
    value : the function, of many points at once.
    cells : increasing points from 0 to 1 between which the function crosses the target at most once.
    sections : cells into which a crossing's is cut at a time; 2 where each point costs as much as the next, and the
        function is `remembered`.
    """
    met = value(cells) <= target
    ends = [0.0] if met[0] else []
    for i in np.flatnonzero(met[1:] != met[:-1]):
        a, b = float(cells[i]), float(cells[i + 1])
        if sections == 2:
            a, b = _interpolated(value, target, a, b, rises=bool(met[i]))
        ends.append(_narrowed(value, target, a, b, rises=bool(met[i]), sections=sections))
    if met[-1]:
        ends.append(1.0)
    return tuple(zip(ends[::2], ends[1::2], strict=True))


def _narrowed(value: Function, target: float, a: float, b: float, *, rises: bool, sections: int) -> float:
    """Where the target begins (or, if the function rises, ceases) to be met between a and b: a point that meets it."""
    while b - a > 2 * np.spacing(b):
        points = np.linspace(a, b, sections + 1)
        inside = (value(points[1:-1]) <= target) != rises
        # the first that is no longer as a is
        i = int(np.argmax(inside)) + 1 if inside.any() else sections
        if points[i] - points[i - 1] >= b - a:
            break
        a, b = float(points[i - 1]), float(points[i])
    return a if rises else b


def _interpolated(value: Function, target: float, a: float, b: float, *, rises: bool) -> tuple[float, float]:
    """The cell, narrowed as far as interpolation helps: the method ITP (Oliveira and Takahashi 2021).

    Variances fall by powers of ten between µ = 0 and 1, so that their logarithms are interpolated.
    """

    def beyond(x: float) -> float:
        y = float(value(np.array([x]))[0])
        ratio = y / target if target > 0 else 0.0
        # next to the target the ratio may be rounded to 1, which the difference never is to 0
        return log(ratio) if 0 < ratio < inf and ratio != 1 else y - target

    fa, fb = beyond(a), beyond(b)
    whole, most = b - a, (b - a) * 2.0**SPARE
    while b - a > NARROWEST:
        middle, most = 0.5 * (a + b), 0.5 * most
        x = middle
        if isfinite(fa) and isfinite(fb) and fa != fb:
            between = (a * fb - b * fa) / (fb - fa)
            towards = 1.0 if middle > between else -1.0
            bent = max(0.2 / whole * (b - a) ** 2, NARROWEST / 4)  # far enough to have the crossing between
            x = between + towards * bent if bent <= abs(middle - between) else middle
            slack = max(most - 0.5 * (b - a), 0.0)
            x = x if abs(x - middle) <= slack else middle - towards * slack
        fx = beyond(x)
        if (fx <= 0) != rises:
            b, fb = x, fx
        else:
            a, fa = x, fx
    return a, b


def remembered(value: Function) -> Function:
    """Return the function with its values kept, which are asked for again and again and cost much each."""
    known: dict[float, float] = {}

    def at(link: np.ndarray) -> np.ndarray:
        new = [µ for µ in np.unique(link).tolist() if µ not in known]
        if new:
            known.update(zip(new, value(np.array(new)).tolist(), strict=True))
        return np.array([known[µ] for µ in link.tolist()])

    return at


def separated(b: np.ndarray) -> np.ndarray:
    """Return points between which a polynomial has at most one root.

    Parameters
    ----------
    b : (degree + 1,) coefficients in Bernstein's form on [0, 1].
    """
    left, width, cells, points = np.zeros(1), 1.0, b[None], [np.array([0.0, 1.0])]
    while True:
        signs = cells > 0
        open_ = (signs[:, 1:] != signs[:, :-1]).sum(axis=1) > 1
        left, cells = left[open_], cells[open_]
        if not len(left) or len(left) > MOST_CELLS or width < NARROWEST:
            # what is still open at this width touches the target, or nearly so
            return np.unique(np.concatenate([*points, left + width / 2]))
        width /= 2
        points.append(left + width)
        cells = np.concatenate(_halves(cells))
        left = np.concatenate([left, left + width])


def _halves(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """De Casteljau: coefficients on the left and on the right half of every cell."""
    first, last = [b[:, 0]], [b[:, -1]]
    while b.shape[1] > 1:
        b = 0.5 * (b[:, :-1] + b[:, 1:])
        first.append(b[:, 0])
        last.append(b[:, -1])
    return np.stack(first, axis=1), np.stack(last[::-1], axis=1)


def scanned(value: Function, target: float) -> np.ndarray:
    """Return points between which a function crosses the target at most once, as far as looking closely can tell.

    Dips and peaks that do not reach the target on the scan's points, but might between them, are followed down to their
    bottom or top.
    """
    points = np.linspace(0.0, 1.0, SCAN)
    f = value(points) - target
    more = []
    for sign in (1.0, -1.0):
        g = sign * f
        dip = (g[1:-1] > 0) & (g[1:-1] <= np.minimum(g[:-2], g[2:]))
        # a parabola through three points goes below the middle one by at most an eighth of what the steeper side falls
        near = g[1:-1] < np.maximum(g[:-2], g[2:]) - g[1:-1]
        for i in np.flatnonzero(dip & near) + 1:
            more.append(lowest(lambda µ, s=sign: s * value(µ), points[i - 1], points[i + 1]))
    return np.unique(np.concatenate([points, more]))


def lowest(value: Function, a: float, b: float) -> float:
    """Return the point of [a, b] with the least value, where there is one dip in it."""
    while True:
        points = np.linspace(a, b, SECTIONS + 1)
        i = int(np.argmin(value(points)))
        if b - a < 1e-9:  # values at a bottom differ by the square of that
            return float(points[i])
        a, b = float(points[max(i - 1, 0)]), float(points[min(i + 1, SECTIONS)])


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
        asked.method == SIMPLIFIED
        and asked.step is not None
        and len(asked.scenario.sensors) == 1
        and linear(asked.quantity, asked.metric)
        and asked.quantity == "claimed"
        and network.agents * network.steps <= MOST_UPDATES
        and asked.scenario.sensors[0].H.shape[-2] == 1
    )


def refined(asked: Question, target: float, enclosure: tuple[float, float]) -> tuple[float, tuple[float, float]] | None:
    """Return the crossing of the target within an enclosure, and what encloses it now; None if it is not in there."""
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
    return np.array([[mpmath.mpf(float(a)) for a in row] for row in A], dtype=object)


BESIDE = 1e-9
"""How far beside the answer its neighbours are evaluated."""
LOOK = 201
"""Points that are looked at for the best value where the target is out of reach."""
ROUNDING, STEADY_ROUNDING = 4e-15, 1e-12
"""Relative rounding errors of values, and of steady states."""


@dataclass(frozen=True, eq=False, repr=False)
class LeastLink(Result):
    """The least link probability that meets a target.

    Parameters
    ----------
    question : what was asked about.
    target : the number to be met.
    link : least µ.
    value : the number at it, evaluated by the method itself.
    below, above : the number at µ − 1e-9 and µ + 1e-9 (at 0 or 1 where that lies beyond).
    enclosure : µ lies in there for certain, given the bound on the values and their rounding.
    met : intervals of µ in which the target is met.
    reachable : the number at µ = 0 and at µ = 1; infinite where there is no steady state.
    share : share of the gain reached at µ, or None if there is none to reach.
    proof : "monotone", "polynomial" or "scan": why no smaller µ meets the target.
    prediction : the prediction at µ.
    function : the number at any µ, for a figure.
    bound : relative bound on the value (steady state, enclosed optimum); 0 where there is none to give.
    """

    question: Question
    target: float
    link: float
    value: float
    below: float
    above: float
    enclosure: tuple[float, float]
    met: tuple[tuple[float, float], ...]
    reachable: tuple[float, float]
    share: float | None
    proof: str
    prediction: Prediction
    function: Callable[[np.ndarray], np.ndarray]
    bound: float = 0.0

    def curve(self, points: int = 201) -> tuple[np.ndarray, np.ndarray]:
        """Return µ and the number there, from 0 (or the answer, if there is no steady state at 0) to 1."""
        µ = np.linspace(0.0 if isfinite(self.reachable[0]) else self.link, 1.0, points)
        return µ, self.function(µ)


class Expectation(NamedTuple):
    """E(µ) with points between which it crosses a target at most once."""

    value: Callable[[np.ndarray], np.ndarray]
    cells: Callable[[float], np.ndarray]
    predict: Callable[[np.ndarray], Prediction]
    proof: str
    rounding: float = ROUNDING
    sections: int = SECTIONS


@of_scenario
def least_link(scenario: Scenario, target: float, **asked: Any) -> LeastLink:
    """Return the least µ, one for all links, at which the number asked about is at most the target.

    Parameters
    ----------
    scenario : links must not differ in it; its own link probability gives way to the unknown one.
    target : in the unit of the metric (of the quantity).
    **asked : see `question`.

    Raises
    ------
    UsageError
        If the request does not fit the scenario.
    NoAnswerError
        If no µ meets the target; says what the best is.

    Examples
    --------
    >>> import stochfuse as sf
    >>> round(sf.least_link("thesis-transient", 30.0).link, 6)
    0.326331
    """
    check_target(target)
    require_like_links(scenario)
    asked_for = question(scenario, **asked)
    curve = _curve(asked_for)
    cells = curve.cells(target)
    found = intervals(curve.value, cells, target, curve.sections)
    if not found:  # a value that was printed in full is a target that can be met
        found = intervals(curve.value, cells, target * (1.0 + SLACK), curve.sections)
    if not found:
        raise NoAnswerError(_unreachable(asked_for, target, curve, cells))
    µ = found[0][0]
    prediction = curve.predict(np.array([µ]))
    bound = relative_bound(prediction, 0)
    enclosure = _enclosure(curve, cells, target, found[0], _relative(curve, asked_for, bound))
    if enclosure[1] - enclosure[0] > WANTED and refinable(asked_for):
        better = refined(asked_for, target, enclosure)
        if better is not None:
            µ, enclosure = better
            found, prediction = ((µ, found[0][1]), *found[1:]), curve.predict(np.array([µ]))
    zero, below, above, one = map(float, curve.value(np.clip([0.0, µ - BESIDE, µ + BESIDE, 1.0], 0.0, 1.0)))
    value = float(asked_for.read(prediction)[0])
    return LeastLink(
        question=asked_for,
        target=float(target),
        link=µ,
        value=value,
        below=below,
        above=above,
        enclosure=enclosure,
        met=found,
        reachable=(zero, one),
        share=(zero - value) / (zero - one) if isfinite(zero) and zero != one else None,
        proof=curve.proof,
        prediction=prediction,
        function=curve.value,
        bound=bound,
    )


def _unreachable(asked: Question, target: float, curve: Expectation, cells: np.ndarray) -> str:
    points = cells
    if curve.proof != "monotone":
        points = np.unique(np.concatenate([cells, np.linspace(0.0, 1.0, LOOK)]))
    i = int(np.argmin(curve.value(points)))
    best = float(points[i])
    if curve.proof != "monotone":
        best = lowest(curve.value, points[max(i - 1, 0)], points[min(i + 1, len(points) - 1)])
    value = float(curve.value(np.array([best]))[0])
    digits = 9 if f"{value:.9g}" != f"{target:.9g}" else 17
    return (
        f"{described(asked)} is {value:.{digits}g} at best, at µ = {best:.6g}; expected a target of at least that, "
        f"got {target:.{digits}g}"
    )


def _relative(curve: Expectation, asked: Question, bound: float) -> float:
    """How far values may be off: by the bound on the covariance, d times that for its determinant; or by rounding."""
    if not isfinite(bound):
        return curve.rounding
    return max(curve.rounding, bound * (asked.scenario.model.dimension if asked.metric.name == "det" else 1))


def _enclosure(
    curve: Expectation, cells: np.ndarray, target: float, found: tuple[float, float], relative: float
) -> tuple[float, float]:
    """Where the least µ lies if values may be wrong by so much: at that of a looser and that of a tighter target."""
    loose, tight = (
        intervals(curve.value, cells, target * (1.0 + sign * relative), curve.sections) for sign in (1.0, -1.0)
    )
    return min(loose[0][0], found[0]), max(tight[0][0], found[0]) if tight else found[1]


def _curve(asked: Question) -> Expectation:
    if asked.monotone:
        return _monotone(asked)
    prediction = asked.predict([0.0, 1.0])
    outcomes = prediction.outcomes
    if outcomes is None:
        return Expectation(asked.at, partial(scanned, asked.at), asked.predict, "scan")

    def at(µ: np.ndarray) -> Prediction:
        # one enumeration answers every µ
        return replace(prediction, moments=outcomes.moments(µ), link=µ)

    rounding = max(ROUNDING, outcomes.rounding)
    polynomials = None if asked.quantity == "bias" else prediction.polynomials(asked.metric, asked.agent)
    if polynomials is None:
        value = lambda µ: asked.read(at(µ))  # noqa: E731
        return Expectation(value, partial(scanned, value), at, "scan", rounding)
    A = polynomials[-1]
    L = len(A) - 1
    b = A / np.array([float(comb(L, c)) for c in range(L + 1)])
    return Expectation(lambda µ: bernstein(A, L, µ), lambda target: separated(b - target), at, "polynomial", rounding)


def _monotone(asked: Question) -> Expectation:
    ends = lambda target: np.array([0.0, 1.0])  # noqa: E731
    value, rounding, sections = asked.at, ROUNDING, SECTIONS
    if asked.step is None:
        rounding = STEADY_ROUNDING
        if len(asked.scenario.sensors) > 1 or asked.method == OPTIMAL:
            # where no steady state exists it takes long to find that out: one point at a time
            value, sections = remembered(partial(_where_steady, asked, [-1.0])), 2
    elif asked.method == OPTIMAL:
        value, sections = remembered(value), 2
    return Expectation(value, ends, asked.predict, "monotone", rounding, sections)


def _where_steady(asked: Question, without: list[float], link: np.ndarray) -> np.ndarray:
    """E(µ) in the steady state, infinite where there is none: links may be too unlikely for unlike agents.

    `without` holds the largest µ for which it took long to find that out: no smaller one has a steady state either.
    """
    values = []
    for µ in link:
        try:
            values.append(np.inf if µ <= without[0] else asked.at([µ])[0])
        except NoAnswerError:
            if µ == 1.0:
                raise
            without[0] = float(µ)
            values.append(np.inf)
    return np.array(values)
