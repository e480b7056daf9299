"""A question asked backwards: the least number of agents that meets a target.

    agents needed    n* = min {n ≥ 1 : E(µ; n) ≤ target}

With E(µ; n) from the simplified formulation or the optimum, which never rises with n (`stochfuse.questions.least_link`
says why), n is doubled until the target is met and then halved in: n* meets it and n* − 1 does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.prediction.result import Prediction
from stochfuse.questions.question import (
    SLACK,
    Question,
    check_target,
    described,
    question,
    relative_bound,
    require_like_links,
)
from stochfuse.scenario.registry import OPTIMAL, SIMPLIFIED
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, of_scenario

MOST_AGENTS = {SIMPLIFIED: 1_000_000, OPTIMAL: 100}
"""Agents up to which each method is asked."""


@dataclass(frozen=True, eq=False, repr=False)
class AgentsNeeded(Result):
    """The least number of agents that meets a target.

    Parameters
    ----------
    question : what was asked about; its scenario has that many agents.
    target : the number to be met.
    link : link probability.
    agents : least n.
    value : the number with n agents.
    fewer : the number with n − 1 agents, which misses the target; None for n = 1.
    tried : (2, tries) numbers of agents that were tried, increasing, and the values there.
    prediction : the prediction with n agents.
    bound : relative bound on the value, 0 where there is none to give.
    """

    question: Question
    target: float
    link: float
    agents: int
    value: float
    fewer: float | None
    tried: np.ndarray
    prediction: Prediction
    bound: float = 0.0


@of_scenario
def agents_needed(
    scenario: Scenario, target: float, link: float, *, max_agents: int | None = None, **asked: Any
) -> AgentsNeeded:
    """Return the least number of like agents with which the number asked about is at most the target.

    Parameters
    ----------
    link : link probability of all links.
    max_agents : agents up to which to look; default: 1,000,000, for "optimal" 100.
    **asked : see `question`; method "simplified" or "optimal".

    Raises
    ------
    UsageError
        If agents or links differ, or the method is another.
    NoAnswerError
        If even the most agents miss the target; says what they reach.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.agents_needed("thesis-transient", 25.0, 0.5).agents
    4
    """
    check_target(target)
    if len(scenario.sensors) > 1 or "agent" in scenario.source:
        raise UsageError(
            "agents needed: expected like agents, got [[agent]] tables; there is no telling what one more is"
        )
    if scenario.network.hears is not None:
        raise UsageError(
            "agents needed: expected everyone to hear everyone, got network.hears; there is no telling whom one more "
            "would hear"
        )
    require_like_links(scenario)
    if not isinstance(link, Real) or not 0 <= link <= 1:
        raise UsageError(f"link: expected a probability between 0 and 1, got {link}")
    asked_for = question(scenario, **asked)
    if not asked_for.monotone:
        raise UsageError(
            f"agents needed: expected method simplified or optimal and what they claim, got {asked_for.method}, "
            f"{asked_for.quantity}"
        )
    if isinstance(asked_for.agent, int):
        raise UsageError(f"agents needed: expected agent mean, worst or best, got {asked_for.agent}")
    most = MOST_AGENTS[asked_for.method] if max_agents is None else max_agents
    if most < 1:
        raise UsageError(f"max_agents: expected a whole number of at least 1, got {most}")
    return _least_agents(asked_for, target, link, most)


def _least_agents(asked: Question, target: float, link: float, most: int) -> AgentsNeeded:
    tried: dict[int, float] = {}

    def misses(n: int) -> bool:
        tried[n] = float(replace(asked, scenario=with_agents(asked.scenario, n)).at([link])[0])
        return tried[n] > target * (1.0 + SLACK)

    n = 1
    while misses(n):
        if n == most:
            raise NoAnswerError(
                f"{described(asked)} is still {tried[n]:.9g} with {n:,} agents at µ = {link:g}; expected a target of "
                f"at least that, got {target:.9g}"
            )
        n = min(2 * n, most)
    low = max((k for k in tried if k < n), default=0)
    while n - low > 1:
        middle = (low + n) // 2
        low, n = (middle, n) if misses(middle) else (low, middle)
    found = replace(asked, scenario=with_agents(asked.scenario, n))
    prediction = found.predict([link])
    return AgentsNeeded(
        question=found,
        target=float(target),
        link=float(link),
        agents=n,
        value=tried[n],
        fewer=tried[n - 1] if n > 1 else None,
        tried=np.array(sorted(tried.items()), dtype=float).T,
        prediction=prediction,
        bound=relative_bound(prediction, 0),
    )


def with_agents(scenario: Scenario, agents: int) -> Scenario:
    """Return the same scenario with another number of like agents."""
    source = dict(scenario.source)
    given = {key: value for key, value in source.get("network", {}).items() if key != "nodes"}
    source["network"] = {**given, "agents": agents}
    network = replace(scenario.network, agents=agents, names=())
    return replace(scenario, network=network, sensor_of=(0,) * agents, source=source)
