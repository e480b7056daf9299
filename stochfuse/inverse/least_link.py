"""A question asked backwards: the least link probability that meets a target.

With E(µ) the number asked about (a metric of a quantity, at a step or in the steady state), one µ for all links:

    least µ          µ* = min {µ in [0, 1] : E(µ) ≤ target}

E need not fall throughout (an RMS error with an initial bias first rises), so that µ* is not simply "the" root: every
interval in which the target is met is found (`stochfuse.inverse.crossings`), and where the first one begins is the
answer.
Why no smaller µ meets the target comes with it:

* `monotone`: (54) and the optimum average, over a number of measurements that grows with µ (and with n) in
  probability, a covariance that falls with that number, through time updates that keep the order; so E falls.
* `polynomial`: one enumeration gives E = Σ A_c µ^c (1−µ)^(L−c), whose roots are parted by their changes of sign.
* `scan`: anything else is looked at closely.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import comb, isfinite
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError
from stochfuse.inverse.crossings import SECTIONS, intervals, lowest, scanned, separated
from stochfuse.inverse.question import (
    SLACK,
    Question,
    check_target,
    described,
    question,
    relative_bound,
    require_like_links,
)
from stochfuse.inverse.refinement import WANTED, refinable, refined
from stochfuse.prediction import Prediction
from stochfuse.scenario import Scenario
from stochfuse.weights import bernstein

BESIDE = 1e-9
"""How far beside the answer its neighbours are evaluated."""
LOOK = 201
"""Points that are looked at for the best value where the target is out of reach."""
ROUNDING, STEADY_ROUNDING = 4e-15, 1e-12
"""Relative rounding errors of values, and of steady states."""


@dataclass(frozen=True, eq=False)
class LeastLink:
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


class Curve(NamedTuple):
    """E(µ) with points between which it crosses a target at most once."""

    value: Callable[[np.ndarray], np.ndarray]
    cells: Callable[[float], np.ndarray]
    predict: Callable[[np.ndarray], Prediction]
    proof: str
    rounding: float = ROUNDING
    sections: int = SECTIONS


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


def _unreachable(asked: Question, target: float, curve: Curve, cells: np.ndarray) -> str:
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


def _relative(curve: Curve, asked: Question, bound: float) -> float:
    """How far values may be off: by the bound on the covariance, d times that for its determinant; or by rounding."""
    if not isfinite(bound):
        return curve.rounding
    return max(curve.rounding, bound * (asked.scenario.model.dimension if asked.metric.name == "det" else 1))


def _enclosure(
    curve: Curve, cells: np.ndarray, target: float, found: tuple[float, float], relative: float
) -> tuple[float, float]:
    """Where the least µ lies if values may be wrong by so much: at that of a looser and that of a tighter target."""
    loose, tight = (
        intervals(curve.value, cells, target * (1.0 + sign * relative), curve.sections) for sign in (1.0, -1.0)
    )
    return min(loose[0][0], found[0]), max(tight[0][0], found[0]) if tight else found[1]


def _curve(asked: Question) -> Curve:
    if asked.monotone:
        return _monotone(asked)
    prediction = asked.predict([0.0, 1.0])
    outcomes = prediction.outcomes
    if outcomes is None:
        return Curve(asked.at, partial(scanned, asked.at), asked.predict, "scan")

    def at(µ: np.ndarray) -> Prediction:
        # one enumeration answers every µ
        return replace(prediction, moments=outcomes.moments(µ), link=µ)

    rounding = max(ROUNDING, outcomes.rounding)
    polynomials = None if asked.quantity == "bias" else prediction.polynomials(asked.metric, asked.agent)
    if polynomials is None:
        value = lambda µ: asked.read(at(µ))  # noqa: E731
        return Curve(value, partial(scanned, value), at, "scan", rounding)
    A = polynomials[-1]
    L = len(A) - 1
    b = A / np.array([float(comb(L, c)) for c in range(L + 1)])
    return Curve(lambda µ: bernstein(A, L, µ), lambda target: separated(b - target), at, "polynomial", rounding)


def _monotone(asked: Question) -> Curve:
    ends = lambda target: np.array([0.0, 1.0])  # noqa: E731
    value, rounding, sections = asked.at, ROUNDING, SECTIONS
    if asked.step is None:
        rounding = STEADY_ROUNDING
        if len(asked.scenario.sensors) > 1:
            # where no steady state exists it takes long to find that out: one point at a time
            value, sections = partial(_where_steady, asked, [-1.0]), 2
    elif asked.method == "optimal":
        sections = 2
    return Curve(value, ends, asked.predict, "monotone", rounding, sections)


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
