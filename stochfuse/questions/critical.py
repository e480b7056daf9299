"""A question asked backwards: the critical link probability, above which the averaged covariance stays bounded.

    critical µ      µ_c = inf {µ in [0, 1] : (54) stays bounded, whatever it begins with}

With µ the probability of all links, messages are stochastically more the larger it is, and (54) is smaller: what is
bounded at one µ is so at every larger one.  `stochfuse.prediction.boundedness` decides at one µ, and proves it: above
µ_c by a covariance P with g(P) ⪯ P, below by a direction X that g makes larger in every step.  µ_c is narrowed
down to rounding without proofs; then µ is moved away from it, up and down, until there is one: `high` and `low`.

Every agent has a recursion of its own (`stochfuse.prediction.simplified`), and the mean over agents is bounded where
all are.  Where no eigenvalue of F lies outside the unit circle, µ_c is 0 or there is none: F X Fᵀ has no larger
determinant than X on an invariant subspace, so what did not shrink there would be hidden from all that can arrive, at
µ = 1 too.  At µ_c itself nothing is said: a mode on the circle that nothing shows grows without end at µ = 0, though
slowly.

What is swept need not be the links: any probability that a scenario depends on will do, of which more is never worse.

Departure.  Sinopoli et al. 2004 enclose the critical probability γ_c of the *expected* covariance,
1 − 1/max|λ|² ≤ γ_c ≤ γ̄.  (54) is an upper bound of that expectation, by concavity; for one sender and a receiver
without a sensor its critical µ is their γ̄.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.prediction import simplified
from stochfuse.prediction.boundedness import (
    Bounded,
    Growing,
    Recursion,
    bounded,
    conditioned,
    decide,
    growing,
    hidden_mode,
    rebased,
    recursions,
    stable,
)
from stochfuse.scenario.network import LinkRows, restricted, stacked_rows
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario
from stochfuse.scenario.system import Items

ROUNDED = 2e-15
"""Width at which the search for the crossing ends."""
NARROW, BETTER = 1e-10, 3
"""Width of a bracket that is good enough, and how many changes of coordinates are tried for one."""
FIRST, FACTOR = 1e-14, 4.0
"""How far from the crossing a proof is tried first, and by how much farther each time."""

Parameter = Callable[[float], Scenario]
"""A scenario for every value of a probability, of which more is never worse."""


@dataclass(frozen=True, eq=False, repr=False)
class Critical(Result):
    """The critical value of a probability.

    Parameters
    ----------
    scenario : what was asked about.
    name : what is swept: "link", or the name of another probability.
    agent : whose covariance: "mean" or "worst" (all agents'), "best", or an agent's number.
    critical : the critical value, between the two that follow.
    low : below it the covariance grows without end, by `growing`; 0 where nothing is to be proved.
    high : from it on the covariance is bounded, by `bounded`.
    agents : numbers of the agents whose recursion is the last to become bounded.
    growing : the proof at `low`; None where that is 0.
    bounded : the proofs at `high`, one for every different recursion.
    radius : growth of large covariances per step, ρ(ĝ), at any value.
    """

    scenario: Scenario
    name: str
    agent: int | str
    critical: float
    low: float
    high: float
    agents: tuple[int, ...]
    growing: Growing | None
    bounded: tuple[Bounded, ...]
    radius: Callable[[float], float] = field(repr=False)

    @property
    def certificate(self) -> str:
        """The proofs in words."""
        margin = min(proof.margin for proof in self.bounded)
        above = (
            f"bounded at {self.name} {self.high:.15g}: a covariance P with g(P) below P, by at least {margin:.2g} in "
            "units of its deviations"
        )
        if self.growing is not None:
            return (
                f"{above}; unbounded at {self.name} {self.low:.15g}: a direction X of rank {self.growing.rank} that "
                f"every step makes larger, by a factor of at least 1 + {self.growing.factor - 1.0:.2g}"
            )
        if self.critical:
            return f"{above}; that it is unbounded at any {self.name} below was not proved"
        return above

    def curve(self, points: int = 101) -> tuple[np.ndarray, np.ndarray]:
        """Return values from 0 to 1 and the growth of large covariances per step at each."""
        x = np.linspace(0.0, 1.0, points)
        return x, np.array([self.radius(float(value)) for value in x])


@of_scenario
def critical(
    scenario: Scenario, parameter: Parameter | None = None, *, agent: int | str = "mean", name: str = "link"
) -> Critical:
    """Return the least link probability above which the simplified formulation stays bounded.

    Parameters
    ----------
    scenario : must not vary with the step.  Its own link probabilities give way to the one asked for, except that a
        link of probability 0 in a matrix stays one.
    parameter : sweep another probability than that of the links: the scenario for each of its values from 0 to 1, its
        link probability in it; more must never be worse.
    agent : whose covariance has to be bounded: "mean" or "worst" for all agents', "best" for some agent's, or a number
        from 1.
    name : what `parameter` sweeps.

    Returns
    -------
    Critical

    Raises
    ------
    UsageError
        If the scenario varies with the step, or the simplified formulation does not take it.
    NoAnswerError
        If it is unbounded even at 1.

    Examples
    --------
    A remote estimator (Sinopoli et al. 2004): the second agent lives on what it hears, 1 − 1/1.25².

    >>> import stochfuse as sf
    >>> remote = {"model": {"F": 1.25, "H": 1, "Q": 1, "R": 2.5}, "initial": {"P": 1},
    ...           "network": {"agents": 2, "steps": 2}, "agent": [{}, {"sensor": False}]}
    >>> round(sf.critical(remote).critical, 9)
    0.36
    """
    agent = scenario.network.agent(agent)
    if parameter is None:
        at = _ReceiverChances(scenario).at
    else:
        sweep = parameter
        at = lambda x: _of(sweep(x), None)  # noqa: E731
    receivers = [r for r, _ in at(0.5) if isinstance(agent, str) or agent in r]
    asked = [_BoundSearch(at, name, [r]) for r in receivers] if agent == "best" else [_BoundSearch(at, name, receivers)]
    found, lost = [], []
    for one in asked:
        try:
            found.append(one.answer(scenario, agent))
        except NoAnswerError as error:
            lost.append(error)
    if not found:
        raise lost[0]
    return min(found, key=lambda one: one.critical)


class _Receiver(NamedTuple):
    """Agents (numbers from 1) that share a recursion, and that recursion."""

    agents: tuple[int, ...]
    recursion: Recursion


class _Bracket(NamedTuple):
    """Where receivers become stable, the last of them, and what is proved on both sides; see `Critical`."""

    middle: float
    worst: tuple[tuple[int, ...], ...]
    low: float
    high: float
    growing: Growing | None
    bounded: tuple[Bounded, ...] | None

    def narrowed(self, other: _Bracket) -> _Bracket:
        """Return what two brackets say together: a proof is one in any coordinates."""
        low, high = max(self, other, key=lambda one: one.low), min(self, other, key=lambda one: one.high)
        nearest = min(self, other, key=lambda one: one.high - one.low)
        middle = min(max(nearest.middle, low.low), high.high)
        return _Bracket(middle, nearest.worst, low.low, high.high, low.growing, high.bounded)


class _ReceiverChances:
    """The receivers of a scenario at any probability of all its links."""

    def __init__(self, scenario: Scenario):
        network = scenario.network
        if network.cases:
            raise UsageError("critical: expected no network.case, since one µ takes the place of all links, got cases")
        if network.burst is not None:
            raise UsageError("critical: expected links without memory, got network.burst")
        link, self._mask = network.link, None
        if link is not None and link.ndim >= 2:
            if link.ndim == 3:
                raise UsageError("critical: expected links that do not vary with the step, got network.link per step")
            self._mask = (link > 0).astype(float)
        self._scenario = replace(scenario, network=replace(network, steps=2, link=None))
        _ = self._scenario.system

    def at(self, x: float) -> list[_Receiver]:
        """Return the receivers with a probability x of every link that there is."""
        rows = link_rows(self._scenario, [x])
        if self._mask is not None:
            network = self._scenario.network
            rows = restricted(stacked_rows(None, [x * self._mask], network), network)
        return _of(self._scenario, rows)


def _of(scenario: Scenario, rows: LinkRows | None) -> list[_Receiver]:
    """Return the receivers of a scenario, for one row of links or those of its own."""
    rows = link_rows(scenario) if rows is None else rows
    if scenario.model.varies or any(s.varies for s in scenario.sensors) or rows.varies:
        raise UsageError("critical: expected a model, sensors and links that do not vary with the step")
    if len(rows.link) > 1:
        raise UsageError(f"critical: expected one link probability in the scenario, got {len(rows.link)}")
    found = []
    for group in simplified.groups(scenario.system, Items(rows)):
        for members, recursion in zip(group.agents, recursions(group.case), strict=True):
            found.append(_Receiver(tuple(member + 1 for member in members), recursion))
    return found


class _BoundSearch:
    """The search for the value from which on the recursions of some receivers are all bounded."""

    def __init__(self, at: Callable[[float], list[_Receiver]], name: str, receivers: Sequence[tuple[int, ...]]):
        self._at, self._name, self._receivers = at, name, list(receivers)
        self._gains: dict[tuple[int, ...], np.ndarray] = {}
        self._coordinates: dict[tuple[int, ...], np.ndarray] = {}

    def answer(self, scenario: Scenario, agent: int | str) -> Critical:
        """Return the answer, or raise NoAnswerError."""
        everyone = self._receivers
        over = self._excess(1.0, everyone)
        lost = [who for who, excess in over.items() if excess > 0]
        if lost:
            raise NoAnswerError(self._why(lost[0]))
        found = self._bracket(everyone)
        for _ in range(BETTER):
            if found.high - found.low < NARROW or not self._conditioned(found.middle, found.worst):
                break
            found = found.narrowed(self._bracket(everyone))
        if found.bounded is None:
            raise NoAnswerError(f"no {self._name} was found at which the covariance is proved to be bounded")
        return Critical(
            scenario=scenario,
            name=self._name,
            agent=agent,
            critical=found.middle,
            low=found.low,
            high=found.high,
            agents=tuple(sorted(number for who in found.worst for number in who)),
            growing=found.growing,
            bounded=found.bounded,
            radius=lambda x: 1.0 + max(self._excess(x, everyone).values()),
        )

    def _bracket(self, everyone: Sequence[tuple[int, ...]]) -> _Bracket:
        middle, worst = self._crossing(everyone)
        high, proofs = self._proved_above(middle, everyone)
        low, proof = self._proved_below(middle, worst)
        return _Bracket(middle, tuple(worst), low, high, proof, proofs)

    def _recursions(self, x: float, who: Sequence[tuple[int, ...]]) -> list[tuple[Recursion, np.ndarray, float]]:
        """Each receiver's recursion, its best gains and the growth ρ(ĝ)."""
        found, there = [], self._at(x)
        for agents in who:
            recursion = next(r.recursion for r in there if agents[0] in r.agents)
            if agents in self._coordinates:
                recursion = rebased(recursion, self._coordinates[agents])
            ρ, gains = decide(recursion, self._gains.get(agents))
            self._gains[agents] = gains
            found.append((recursion, gains, ρ))
        return found

    def _conditioned(self, x: float, who: Sequence[tuple[int, ...]]) -> bool:
        """Change to coordinates in which large covariances are well conditioned; whether any had to be changed."""
        changed = False
        for agents, (recursion, gains, _) in zip(who, self._recursions(x, who), strict=True):
            better = conditioned(recursion, gains)
            if better is not None:
                before = self._coordinates.get(agents, np.eye(len(recursion.F)))
                self._coordinates[agents] = before @ np.linalg.solve(recursion.T, better.T)
                del self._gains[agents]
                changed = True
        return changed

    def _excess(self, x: float, who: Sequence[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
        """ρ(ĝ) − 1 of each receiver, positive where it is not below 0 for certain."""
        found = {}
        for agents, (recursion, gains, ρ) in zip(who, self._recursions(x, who), strict=True):
            excess = abs(ρ - 1.0) + 1e-300
            found[agents] = -excess if stable(recursion, gains) else excess
        return found

    def _crossing(self, everyone: Sequence[tuple[int, ...]]) -> tuple[float, Sequence[tuple[int, ...]]]:
        """Where the last receivers become stable, to rounding, and these; by secants between what is stable and not."""
        over = self._excess(0.0, everyone)
        worst = [who for who, excess in over.items() if excess > 0]
        marginal = [np.abs(np.linalg.eigvals(r.recursion.F)).max() <= 1.0 for r in self._at(0.0)]
        if not worst or all(marginal):
            return 0.0, worst or everyone
        excess = {0.0: max(over.values()), 1.0: max(self._excess(1.0, everyone).values())}
        low, high, widths = 0.0, 1.0, [1.0]
        while high - low > ROUNDED:
            f_low, f_high = excess[low], excess[high]
            x = high - f_high * (high - low) / (f_high - f_low)
            # a secant that leaves one end where it was for long is no better than halves
            slow = len(widths) > 2 and widths[-1] > 0.5 * widths[-3]
            x = 0.5 * (low + high) if slow or not low < x < high else x
            over = self._excess(x, worst)
            excess[x] = max(over.values())
            if excess[x] > 0:
                low, worst = x, [who for who, value in over.items() if value > 0]
                excess[high] /= 2.0
            else:
                high = x
                excess[low] /= 2.0
            widths.append(high - low)
        return high, worst

    def _proved_above(self, middle: float, who: Sequence[tuple[int, ...]]) -> tuple[float, tuple[Bounded, ...] | None]:
        """The nearest value above the crossing at which a proof is found for every receiver, and the proofs."""
        for x in _away(middle, 1.0):
            proofs = [bounded(recursion, gains) for recursion, gains, _ in self._recursions(x, who)]
            if all(proof is not None for proof in proofs):
                return x, tuple(proof for proof in proofs if proof is not None)
        return 1.0, None

    def _proved_below(self, middle: float, who: Sequence[tuple[int, ...]]) -> tuple[float, Growing | None]:
        """The nearest value below the crossing at which some receiver's recursion is proved to grow, and the proof."""
        for x in _away(middle, 0.0) if middle > 0 else ():
            for recursion, gains, _ in self._recursions(x, who):
                proof = growing(recursion, gains)
                if proof is not None:
                    return x, proof
        return 0.0, None

    def _why(self, who: tuple[int, ...]) -> str:
        """Why receivers are unbounded even at 1."""
        (recursion, _, ρ), *_ = self._recursions(1.0, [who])
        mode = hidden_mode(recursion.F, recursion.H.reshape(-1, len(recursion.F)))
        agents = f"agent{'s' * (len(who) > 1)} {', '.join(map(str, who))}"
        unbounded = f"no critical {self._name}: even at 1 the averaged covariance of {agents} is not bounded"
        if mode is not None:
            return f"{unbounded}, since no measurement that gets there shows the mode of F with eigenvalue {mode:.6g}"
        return f"{unbounded}: it grows by a factor of {ρ:.6g} in every step, since what shows it comes too rarely"


def _away(middle: float, end: float) -> Sequence[float]:
    """Values on the way from one to an end, the steps growing; each once."""
    found, step, sign = [middle], FIRST, 1.0 if end > middle else -1.0
    while step < abs(end - middle):
        found.append(middle + sign * step)
        step *= FACTOR
    return [*found, end]
