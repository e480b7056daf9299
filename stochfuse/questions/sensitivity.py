"""What a better link is worth: dE/dµ_ij of every link, and the share of the gain that a link probability reaches.

    sensitivity      dE/dµ_ij, receiver i, sender j, everything else as it is
    share of gain    (E(0) − E(µ)) / (E(0) − E(1))

In an ad hoc network a link is an ordered pair, in a broadcast one a sender (heard by all or by none), in a cyclic one
an agent's one link.  The general formulation, naive fusion and the optimum average over independent draws: E is
multi-affine in the µ_ij(k), hence a polynomial of degree ≤ k in a µ_ij that is the same in all k steps.  Its values at
more Chebyshev points than that give the derivative to rounding, and the coefficients beyond the degree, which must
vanish, test it (`exact`).  Anything else (the simplified formulation, metrics that are not linear) is differentiated
through a Chebyshev series on a short interval, with what the last terms contribute as its estimated error.  Where µ_ij
is 0 or 1 the interval lies inside [0, 1], to one side.

Where agents and links are alike and the average over the agents is asked for, no link differs from another: each has
its share of dE/dµ, the derivative in the one µ of all links (of degree ≤ the number of draws).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev

from stochfuse.engines.events import events
from stochfuse.errors import NoAnswerError, StochfuseError, UsageError
from stochfuse.prediction.quantities import linear
from stochfuse.prediction.result import Prediction
from stochfuse.questions.question import Question, described, question
from stochfuse.scenario.network import LinkRows, uniform_rows
from stochfuse.scenario.registry import SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, of_scenario

MOST_AGENTS = 12
"""Agents up to which every link is listed."""
SHORT, SHORT_DEGREE = 0.1, 9
"""Length of the interval of a numerical derivative, and the degree there."""
SPARE = 2
"""Coefficients beyond the degree, which must vanish."""
TIE, TIED = 1e-12, 1e-9
"""Relative difference below which values, or derivatives, are the same."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Result):
    """dE/dµ of every link.

    Parameters
    ----------
    question : what was asked about.
    links : sender and receivers of every link, numbered from 1.
    link : (links,) its probability.
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
    link : one probability for all links, or a matrix µ_ij (receiver, sender); default: the scenario's.
    case : which of the scenario's cases, by name.
    **asked : see `question`.

    Raises
    ------
    UsageError
        If the request does not fit the scenario, there are no links, or too many to list.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.sensitivity("thesis-transient", 0.5).derivative[:2].round(4)
    array([-3.2051, -3.2051])
    """
    network = scenario.network
    if not 1 < network.agents <= MOST_AGENTS:
        raise UsageError(f"sensitivity: expected 2 to {MOST_AGENTS} agents, to list every link, got {network.agents}")
    base = _matrix(scenario, link, case)
    asked_for = question(scenario, **asked)
    drawn = [(event.sender, event.receivers) for event in events(network, uniform_rows([1.0]), 1)]
    µ = np.array([base[receivers[0], sender] for sender, receivers in drawn])
    alike = len(scenario.sensors) == 1 and len(set(µ)) == 1 and asked_for.agent == "mean"
    exact = asked_for.method != SIMPLIFIED and linear(asked_for.quantity, asked_for.metric)
    exact = exact and asked_for.quantity != "bias"
    varied = µ[:1] if alike else µ
    degree = asked_for.scenario.network.steps * (len(µ) if alike else 1) + SPARE if exact else SHORT_DEGREE
    low = np.zeros_like(varied) if exact else np.clip(varied - SHORT / 2, 0.0, 1.0 - SHORT)
    length = 1.0 if exact else SHORT
    nodes = low[:, None] + length * chebyshev_points(degree)
    rows = uniform_rows([µ[0], *nodes[0]]) if alike else _rows(base, drawn, nodes)
    prediction = asked_for.predict(rows)
    value, values = _numbers(asked_for, prediction, nodes.shape)
    each = [_slope(f, x, a, length, asked_for.agent, exact) for f, x, a in zip(values, varied, low, strict=True)]
    derivative, error = np.transpose(each * len(µ)) / len(µ) if alike else np.transpose(each)
    derivative = np.where(np.abs(derivative) <= error + TIE * abs(value), 0.0, derivative)
    if exact and (error > 1e-6 * abs(value)).any():
        raise StochfuseError(f"{described(asked_for)}: rounding is too large to find the derivative")
    return Sensitivity(
        question=asked_for,
        links=tuple((sender + 1, tuple(i + 1 for i in receivers)) for sender, receivers in drawn),
        link=µ,
        derivative=derivative,
        error=error,
        exact=exact,
        value=value,
        order=np.argsort(np.round(derivative / (TIED * np.abs(derivative).max() or 1.0)), kind="stable"),
        prediction=prediction,
    )


def _matrix(scenario: Scenario, link: float | np.ndarray | None, case: str | None) -> np.ndarray:
    """Link probabilities µ_ij as they are, (n, n)."""
    network = scenario.network
    chosen = link
    if link is None:
        chosen = network.link if case is None else _case(dict(network.cases), case)
        if chosen is None:
            more = ", nor the name of a case" if network.cases else ""
            raise UsageError(f"sensitivity: expected links to start from, got none here nor in network.link{more}")
    elif case is not None:
        raise UsageError(f"case: expected none beside link probabilities of one's own, got '{case}'")
    try:
        array = np.asarray(chosen, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(
            f"link: expected a probability or a {network.agents}×{network.agents} matrix, got {link!r}"
        ) from None
    if array.ndim not in (0, 2):
        raise UsageError("sensitivity: expected links that do not vary with the step, got links per step")
    n = network.agents
    if array.ndim == 2 and array.shape != (n, n):
        raise UsageError(f"link: expected a probability or a {n}×{n} matrix, got an array of shape {array.shape}")
    if not ((array >= 0) & (array <= 1)).all():
        raise UsageError(f"link: expected probabilities between 0 and 1, got {array.min():g} to {array.max():g}")
    return np.broadcast_to(array, (n, n))


def _case(cases: dict[str, np.ndarray], name: str) -> np.ndarray:
    if name not in cases:
        names = ", ".join(f"'{known}'" for known in cases)
        expected = f"one of {names}" if cases else "none, as the scenario has no cases"
        raise UsageError(f"case: expected {expected}, got '{name}'")
    return cases[name]


def chebyshev_points(degree: int) -> np.ndarray:
    """Degree + 1 Chebyshev points of [0, 1], both ends included."""
    return np.sin(np.linspace(0.0, np.pi / 2, degree + 1)) ** 2


def _rows(base: np.ndarray, drawn: list[tuple[int, tuple[int, ...]]], nodes: np.ndarray) -> LinkRows:
    """Matrices: the links as they are, then every link at every node, all in one prediction."""
    rows = np.broadcast_to(base, (1 + nodes.size, *base.shape)).copy()
    each = rows[1:].reshape(*nodes.shape, *base.shape)
    for i, (sender, receivers) in enumerate(drawn):
        each[i][:, list(receivers), sender] = nodes[i][:, None]
    return LinkRows(None, rows)


def _numbers(asked: Question, prediction: Prediction, shape: tuple[int, ...]) -> tuple[float, np.ndarray]:
    """E at the links as they are, and at every link's nodes, (links, nodes, agents).

    Of the worst (or best) agent: of all that are it with the links as they are, each on its own.
    """
    whom: list[int | str] = [asked.agent]
    if asked.agent in ("worst", "best"):
        everyone = list(range(1, len(prediction.group_of) + 1))
        at_base = np.array([asked.read(prediction, i)[0] for i in everyone])
        extreme = at_base.max() if asked.agent == "worst" else at_base.min()
        whom = [i for i, v in zip(everyone, at_base, strict=True) if abs(v - extreme) <= TIE * abs(extreme)]
    values = np.stack([asked.read(prediction, i) for i in whom], axis=-1)
    return float(values[0, 0]), values[1:].reshape(*shape, len(whom))


def _slope(f: np.ndarray, x: float, a: float, length: float, agent: int | str, exact: bool) -> tuple[float, float]:
    """Derivative at x of what passes through f at Chebyshev points of [a, a + length], and its estimated error."""
    degree = len(f) - 1
    nodes = a + length * chebyshev_points(degree)
    slopes, errors = [], []
    for column in f.T:
        series = Chebyshev.fit(nodes, column, degree, domain=[a, a + length])
        whole, short = series.deriv()(x), series.truncate(degree + 1 - SPARE).deriv()(x)
        slopes.append(short if exact else whole)
        errors.append(abs(whole - short))
    # of several agents that are the worst, all must get better for the worst to get better; at µ = 1 one looks back
    least = (agent == "best") != (x == 1.0)
    return float(min(slopes) if least else max(slopes)), float(max(errors))


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
