"""What a better link is worth: dE/dµ_ij of every link, and the share of the gain that a link probability reaches.

    sensitivity      dE/dµ_ij, receiver i, sender j, everything else as it is
    share of gain    (E(0) − E(µ)) / (E(0) − E(1))

Where links vary with the step, a link is made better in all of them: Σ_k ∂E/∂µ_ij(k), of E(µ_ij(1) + t, µ_ij(2) + t, …)
the derivative in t at 0.

In an ad hoc network a link is an ordered pair, in a broadcast one a sender (heard by all or by none), in a cyclic one
an agent's one link.  The general formulation, naive fusion and the optimum average over independent draws: E is
multi-affine in the µ_ij(k), hence a polynomial of degree ≤ k in t.  Its values at
more Chebyshev points than that give the derivative to rounding, and the coefficients beyond the degree, which must
vanish, test it (`exact`).  Anything else (the simplified formulation, metrics that are not linear) is differentiated
through a Chebyshev series on a short interval, with what the last terms contribute as its estimated error.  The
interval keeps all µ_ij(k) in [0, 1]: where one is 0 or 1 it lies to one side.  Where that leaves hardly any, steps
below ½ and the others are moved apart, and the two derivatives added up.

Where agents and links are alike and the average over the agents is asked for, no link differs from another: each has
its share of dE/dµ, the derivative in the one µ of all links (of degree ≤ the number of draws).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev

from stochfuse.engines.events import events
from stochfuse.errors import NoAnswerError, StochfuseError, UsageError
from stochfuse.prediction.quantities import linear
from stochfuse.prediction.result import Prediction
from stochfuse.questions.question import Question, described, question
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.network import LinkRows, reachable, uniform_rows
from stochfuse.scenario.registry import OPTIMAL, SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, of_scenario
from stochfuse.scenario.tables import read_link

MOST_UPDATES = 200_000_000
"""Updates (rows of links, agents, steps and, of unlike sensors, numbers of arrivals) that are worth the time."""
MOST_DEGREE = 1000
"""Degree of a polynomial up to which it is found whole."""
ENTRIES = 1 << 22
"""Link probabilities that are predicted at a time."""
SHORT, SHORT_DEGREE = 0.1, 9
"""Length of the interval of a numerical derivative, and the degree there."""
SPARE = 2
"""Coefficients beyond the degree, which must vanish."""
VARIES = "links vary with the step: µ is the mean over the steps, and a link is made better in all of them at once"
TIE, TIED = 1e-12, 1e-9
"""Relative difference below which values, or derivatives, are the same."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Result):
    """dE/dµ of every link.

    Parameters
    ----------
    question : what was asked about.
    links : sender and receivers of every link, numbered from 1.
    link : (links,) its probability; where that varies with the step, the mean.
    derivative : (links,) dE/dµ; one-sided at 0 and 1, and to the right where several agents are the worst (or best).
    error : (links,) estimated error of the derivative; a derivative no larger than that is given as 0.
    exact : whether E is a polynomial whose derivative is exact to rounding.
    value : E at the links as they are.
    order : links from the one whose improvement lowers E most to the one that lowers it least.
    prediction : the prediction at the links as they are.
    """

    question: Question
    links: tuple[tuple[int, tuple[int, ...]], ...]
    link: np.ndarray
    derivative: np.ndarray
    error: np.ndarray
    exact: bool
    value: float
    order: np.ndarray
    prediction: Prediction

    @property
    def lacking(self) -> np.ndarray:
        """What each link would take off E if it were perfect, to first order: −dE/dµ (1 − µ), shape (links,)."""
        return -self.derivative * (1.0 - self.link)

    @property
    def first(self) -> tuple[int, ...]:
        """Links to improve first: the one with the largest gain and those that tie with it; none if none gains."""
        can = np.flatnonzero((self.link < 1.0) & (self.derivative < 0.0))
        if not len(can):
            return ()
        best = self.derivative[can].min()
        margin = TIED * abs(best) + 2 * self.error[can].max()
        return tuple(int(i) for i in can if self.derivative[i] <= best + margin)


@of_scenario
def sensitivity(
    scenario: Scenario, link: float | np.ndarray | None = None, *, case: str | None = None, **asked: Any
) -> Sensitivity:
    """Return how much the number asked about changes with every link's probability.

    Parameters
    ----------
    link : one probability for all links, or a matrix µ_ij (receiver, sender), or either per step; default: the
        scenario's.
    case : which of the scenario's cases, by name.
    **asked : see `question`.

    Raises
    ------
    UsageError
        If the request does not fit the scenario, there are no links, or too many.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.sensitivity("thesis-transient", 0.5).derivative[:2].round(4)
    array([-3.2051, -3.2051])
    """
    network, there = scenario.network, reachable(scenario.network)
    base = _links(scenario, link, case) * there
    asked_for = question(scenario, **asked)
    base = base[: asked_for.scenario.network.steps]
    drawn = [
        (e.sender, e.receivers) for e in events(network, uniform_rows([1.0]), 1) if there[e.receivers[0], e.sender]
    ]
    if not drawn:
        raise UsageError("sensitivity: expected agents that hear one another, got no link")
    µ = np.array([base[:, receivers[0], sender] for sender, receivers in drawn])
    alike = len(scenario.sensors) == 1 and len(np.unique(µ)) == 1 and asked_for.agent == "mean"
    alike = alike and network.hears is None
    exact = asked_for.method != SIMPLIFIED and linear(asked_for.quantity, asked_for.metric)
    exact = exact and asked_for.quantity != "bias" and asked_for.step is not None
    degree = asked_for.scenario.network.steps * (len(µ) if alike else 1) + SPARE
    exact = exact and degree <= MOST_DEGREE
    degree = degree if exact else SHORT_DEGREE
    moves = [Move.of(i, some, steps, exact) for i, some in enumerate(µ[:1] if alike else µ) for steps in _apart(some)]
    if alike:
        rows = uniform_rows([µ[0, 0], *moves[0].points(degree)])
        changes = iter([(moves[0], *[asked_for.predict(rows)] * 2)])
    else:
        changes = _changes(asked_for, base, drawn, _at_once(asked_for, drawn, moves), degree)
    derivative, error = np.zeros((2, len(µ)))
    value, prediction = 0.0, None
    for move, whole, alone in changes:
        prediction = prediction or whole
        value, values = _numbers(asked_for, alone)
        slope, off = move.slope(values, asked_for.agent, exact)
        some = slice(None) if alike else move.link
        derivative[some] += slope / (len(µ) if alike else 1)
        error[some] += off / (len(µ) if alike else 1)
    derivative = np.where(np.abs(derivative) <= error + TIE * abs(value), 0.0, derivative)
    if exact and (error > 1e-6 * abs(value)).any():
        raise StochfuseError(f"{described(asked_for)}: rounding is too large to find the derivative")
    return Sensitivity(
        question=asked_for,
        links=tuple((sender + 1, tuple(i + 1 for i in receivers)) for sender, receivers in drawn),
        link=µ.mean(axis=1),
        derivative=derivative,
        error=error,
        exact=exact,
        value=value,
        order=np.argsort(np.round(derivative / (TIED * np.abs(derivative).max() or 1.0)), kind="stable"),
        prediction=_at_base(prediction, varies=len(base) > 1),
    )


def _links(scenario: Scenario, link: Any, case: str | None) -> np.ndarray:
    """Link probabilities µ_ij(k) as they are, (steps or 1, n, n)."""
    network, check = scenario.network, Checker()
    if link is None and case is not None:
        cases = dict(network.cases)
        if case not in cases:
            names = ", ".join(f"'{known}'" for known in cases)
            expected = f"one of {names}" if cases else "none, as the scenario has no cases"
            raise UsageError(f"case: expected {expected}, got '{case}'")
        chosen = cases[case]
    elif link is None:
        chosen = network.link
        if chosen is None:
            more = ", nor the name of a case" if network.cases else ""
            raise UsageError(f"sensitivity: expected links to start from, got none here nor in network.link{more}")
    elif case is not None:
        raise UsageError(f"case: expected none beside link probabilities of one's own, got '{case}'")
    else:
        chosen = read_link(check, "link", link, network.agents, network.steps, network.architecture)
        if chosen is None or check.problems:
            raise UsageError("; ".join(map(str, check.problems)))
    full = chosen[..., None, None] if chosen.ndim < 2 else chosen
    return np.broadcast_to(full, (len(full) if full.ndim == 3 else 1, network.agents, network.agents))


def chebyshev_points(degree: int) -> np.ndarray:
    """Degree + 1 Chebyshev points of [0, 1], both ends included."""
    return np.sin(np.linspace(0.0, np.pi / 2, degree + 1)) ** 2


class Move(NamedTuple):
    """A link that is moved by t, in some steps at once.

    Parameters
    ----------
    link : which.
    steps : (steps,) whether it is moved there.
    µ : its probability in the first of these steps, in which the move is told.
    low, length : the interval of µ + t.
    top : whether it is 1 in one of the steps, so that one looks back.
    """

    link: int
    steps: np.ndarray
    µ: float
    low: float
    length: float
    top: bool

    @classmethod
    def of(cls, link: int, µ: np.ndarray, steps: np.ndarray, exact: bool) -> Move:
        """As far as probabilities allow where the derivative is exact, else a short way."""
        first, least, most = (float(x) for x in (µ[steps][0], µ[steps].min(), µ[steps].max()))
        low, high = first - least, 1.0 - (most - first)
        length = high - low if exact else SHORT
        low = low if exact else min(max(low, first - SHORT / 2), high - SHORT)
        return cls(link, steps, first, low, length, most == 1.0)

    def points(self, degree: int) -> np.ndarray:
        """Degree + 1 Chebyshev points of the interval."""
        return self.low + self.length * chebyshev_points(degree)

    def moved(self, µ: np.ndarray, degree: int) -> np.ndarray:
        """Probabilities (points, steps) of what they are in the steps moved, (steps,)."""
        points = self.points(degree)[:, None]
        return np.where(µ == self.µ, points, np.clip(µ + (points - self.µ), 0.0, 1.0))

    def slope(self, f: np.ndarray, agent: int | str, exact: bool) -> tuple[float, float]:
        """Derivative at t = 0 of what passes through f at these points, and its estimated error."""
        degree = len(f) - 1
        nodes, domain = self.points(degree), [self.low, self.low + self.length]
        slopes, errors = [], []
        for column in f.T:
            series = Chebyshev.fit(nodes, column, degree, domain=domain)
            whole, short = series.deriv()(self.µ), series.truncate(degree + 1 - SPARE).deriv()(self.µ)
            slopes.append(short if exact else whole)
            errors.append(abs(whole - short))
        # of several agents that are the worst, all must get better for the worst to get better; at µ = 1 one looks back
        least = (agent == "best") != self.top
        return float(min(slopes) if least else max(slopes)), float(max(errors))


def _apart(µ: np.ndarray) -> list[np.ndarray]:
    """Steps in which a link is moved at once, (steps,) each: all where there is room, else the lower and the higher."""
    if 1.0 - np.ptp(µ) >= SHORT:
        return [np.ones(len(µ), dtype=bool)]
    return [µ < 0.5, µ >= 0.5]


Link = tuple[int, tuple[int, ...]]
"""Sender and receivers, from 0."""


def _at_once(asked: Question, drawn: list[Link], moves: list[Move]) -> list[list[Move]]:
    """Moves that one row can have: by (54) links to an agent change its own covariance and no other's."""
    if asked.method != SIMPLIFIED or asked.step is None or any(len(receivers) > 1 for _, receivers in drawn):
        return [[move] for move in moves]
    by_receiver: dict[int, list[Move]] = {}
    for move in moves:
        by_receiver.setdefault(drawn[move.link][1][0], []).append(move)
    return [[m for m in some if m is not None] for some in zip_longest(*by_receiver.values())]


def _check_size(scenario: Scenario, rows: int) -> None:
    """Raise UsageError if so many rows of unlike links are more than is worth the time."""
    kinds = np.bincount(scenario.sensor_of) + 1
    updates = rows * scenario.network.agents * scenario.network.steps * (np.prod(kinds) if len(kinds) > 1 else 1)
    if updates > MOST_UPDATES:
        raise UsageError(
            f"sensitivity: every link, moved to a few places, takes {updates:.2g} updates, at most {MOST_UPDATES:.2g} "
            "are made: expected fewer steps or kinds of sensors, or links alike, one of which stands for all"
        )


def _rows(base: np.ndarray, drawn: list[Link], at_once: list[list[Move]], degree: int) -> LinkRows:
    """Matrices: the links as they are, then all moves at every point, all in one prediction."""
    rows = np.broadcast_to(base, (1 + len(at_once) * (degree + 1), *base.shape)).copy()
    for moves, each in zip(at_once, rows[1:].reshape(len(at_once), degree + 1, *base.shape), strict=True):
        for move in moves:
            sender, receivers = drawn[move.link]
            for i in receivers:
                each[:, move.steps, i, sender] = move.moved(base[move.steps, i, sender], degree)
    return LinkRows(None, rows[:, 0] if len(base) == 1 else rows)


def _changes(
    asked: Question, base: np.ndarray, drawn: list[Link], at_once: list[list[Move]], degree: int
) -> Iterator[tuple[Move, Prediction, Prediction]]:
    """Every move, a prediction that begins with the links as they are, and of these that and what it alone changes."""
    _check_size(asked.scenario, len(at_once) * (degree + 1))
    if asked.method == OPTIMAL:
        asked.predict(_rows(base, drawn, [], degree))  # which is refused at once where it would be a sample
    together = max(1, ENTRIES // ((degree + 1) * base.size))
    for first in range(0, len(at_once), together):
        batch = at_once[first : first + together]
        found = asked.predict(_rows(base, drawn, batch, degree))
        for moves, rows in zip(batch, np.split(np.arange(1, len(found.link)), len(batch)), strict=True):
            some = _taken(found, [0, *rows])
            for move in moves:
                yield move, found, some if len(moves) == 1 else _alone(some, drawn[move.link][1][0])


def _alone(p: Prediction, agent: int) -> Prediction:
    """The last step, where of the rows after the first that of one agent alone is different."""

    def alone(M: np.ndarray) -> np.ndarray:
        each = M[:, -1:, p.group_of]
        found = np.repeat(each[:1], len(M), axis=0)
        found[:, :, agent] = each[:, :, agent]
        return found

    return replace(p, moments=p.moments.map(alone), group_of=np.arange(len(p.group_of)))


def _at_base(p: Prediction | None, *, varies: bool) -> Prediction:
    """The prediction at the links as they are."""
    if p is None:
        raise TypeError("some link was moved")
    base = _taken(p, [0])
    return replace(base, notes=(*base.notes, VARIES)) if varies else base


def _taken(p: Prediction, rows: list[int]) -> Prediction:
    """Some rows of a prediction and of its steady state."""
    limit = p.limit and replace(p.limit, prediction=_taken(p.limit.prediction, rows))
    return replace(p, link=p.link[rows], moments=p.moments.map(lambda M: M[rows]), limit=limit)


def _numbers(asked: Question, prediction: Prediction) -> tuple[float, np.ndarray]:
    """E at the links as they are, and at the other rows, (rows, agents).

    Of the worst (or best) agent: of all that are it with the links as they are, each on its own.
    """
    whom: list[int | str] = [asked.agent]
    if asked.agent in ("worst", "best"):
        everyone = list(range(1, len(prediction.group_of) + 1))
        at_base = np.array([asked.read(prediction, i)[0] for i in everyone])
        extreme = at_base.max() if asked.agent == "worst" else at_base.min()
        whom = [i for i, v in zip(everyone, at_base, strict=True) if abs(v - extreme) <= TIE * abs(extreme)]
    values = np.stack([asked.read(prediction, i) for i in whom], axis=-1)
    return float(values[0, 0]), values[1:]


@dataclass(frozen=True, eq=False, repr=False)
class ShareOfGain(Result):
    """Share of the gain (E(0) − E(µ)) / (E(0) − E(1)), against link probability and step.

    Parameters
    ----------
    question : what was asked about.
    steps : steps of the columns; None for the steady state.
    share : (links, columns); NaN where there is nothing to gain.
    value : (links, columns) E(µ).
    reachable : (2, columns) E(0) and E(1).
    prediction : the prediction of the rows.
    """

    question: Question
    steps: np.ndarray | None
    share: np.ndarray
    value: np.ndarray
    reachable: np.ndarray
    prediction: Prediction


@of_scenario
def share_of_gain(scenario: Scenario, link: Any = None, **asked: Any) -> ShareOfGain:
    """Return which share of the gain from µ = 0 to µ = 1 is reached at some links.

    Parameters
    ----------
    link : as in `stochfuse.predict`.
    **asked : see `question`; without step, every step is a column.

    Raises
    ------
    UsageError
        If the request does not fit the scenario.
    NoAnswerError
        If there is nothing to gain: E(0) = E(1) throughout.

    Examples
    --------
    >>> import stochfuse as sf
    >>> float(sf.share_of_gain("thesis-transient", [0.5]).share[0, -1].round(3))
    0.649
    """
    asked_for = question(scenario, **asked)
    prediction, ends = asked_for.predict(link), asked_for.predict([0.0, 1.0])
    if asked_for.step is None or asked.get("step") is not None:
        value, reachable = asked_for.read(prediction)[:, None], asked_for.read(ends)[:, None]
        steps = None if asked_for.step is None else prediction.steps[-1:]
    else:
        value, reachable = (p.values(asked_for.metric, asked_for.agent) for p in (prediction, ends))
        steps = prediction.steps
    gain = reachable[0] - reachable[1]
    nothing = np.abs(gain) <= 1e-13 * np.abs(reachable[0])
    if nothing.all():
        raise NoAnswerError(
            f"{described(asked_for)} is {reachable[0, -1]:.9g} with every link probability: nothing to gain"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(nothing, np.nan, (reachable[0] - value) / gain)
    return ShareOfGain(asked_for, steps, share, value, reachable, prediction)
