"""Message load: how many nodes new to an agent the messages of a step bring it (thesis 3.3).

**What is counted.**  The load of agent i in step k is the number of nodes that the step's exchange adds to its Local
Fusion Graph: what senders would have to send that knew what the receiver has, a lower bound for any protocol.  Own
nodes are never new, and a node that two messages of a step bring counts once.  So the thesis describes its data: new
nodes added to an agent's graph at each step.  If every message were counted by itself, three agents in an ad hoc
network with µ = 0.75 would carry 2.24 nodes a step, more than at µ = 1, where the thesis finds always less.  A naive
message is one node, the sender's latest: a step's load is the number of arrivals, binomial with mean (n−1)µ.  (40)/(41)
are the first step of either rule (of ad hoc and broadcast networks; in a cyclic one n − 1 is to be read as 1).

`stochfuse.questions.message_chain` has the mathematics.

**Bytes.**  A node carries an information pair of d + d(d+1)/2 numbers of 8 bytes, and 8 bytes that identify it (agent
and step).  The links to its parents, some n bits, are not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, overload

import numpy as np

from stochfuse.engines.events import events
from stochfuse.errors import UsageError
from stochfuse.prediction.method import RUNS, SEED
from stochfuse.prediction.predict import choose, predict
from stochfuse.prediction.swept import Swept, SweptRows, below_each_other, of_parts
from stochfuse.questions.message_chain import frequencies, like_agents, naive_load, sampled_loads, walked_load
from stochfuse.scenario.network import LinkRows, require_memoryless
from stochfuse.scenario.over import Over
from stochfuse.scenario.over import over as read_over
from stochfuse.scenario.registry import GENERAL, LFG, MONTE_CARLO, NAIVE
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, ScenarioLike, link_rows, of_scenario, require_one_state

RULES = (LFG, NAIVE)
METHODS = ("exact", MONTE_CARLO)
NUMBER_BYTES, IDENTITY_BYTES = 8, 8


@dataclass(frozen=True, eq=False, repr=False)
class MessageLoad(Result):
    """Distribution of the load of one agent in one step.

    Parameters
    ----------
    scenario : what was given.
    rule : "local-fusion-graph" or "naive".
    nature : "exact" or "sampled".
    link : (rows,) link probability of each row, averaged over the links if they differ.
    cases : a name per row where the rows are cases, else None.
    steps : (steps,) steps of the window.
    probabilities : (rows, steps, groups, sizes) of a load of 0, 1, 2 … nodes, per group of agents that are alike.
    group_of : (agents,) index into the groups.
    sample : (rows, runs, steps, agents) loads drawn, if sampled.
    seed : of the random numbers, if sampled.
    """

    scenario: Scenario
    rule: str
    nature: str
    link: np.ndarray
    cases: tuple[str, ...] | None
    steps: np.ndarray
    probabilities: np.ndarray
    group_of: np.ndarray
    sample: np.ndarray | None = field(default=None, repr=False)
    seed: int | None = None

    def between(self, first: int, last: int) -> MessageLoad:
        """Return the same for steps first … last.

        Raises
        ------
        UsageError
            If these are no steps of this window.
        """
        low, high = int(self.steps[0]), int(self.steps[-1])
        if not low <= first <= last <= high:
            raise UsageError(f"window: expected steps from {low} to {high}, first ≤ last, got {first} to {last}")
        inside = (self.steps >= first) & (self.steps <= last)
        sample = None if self.sample is None else self.sample[:, :, inside]
        return replace(self, steps=self.steps[inside], probabilities=self.probabilities[:, inside], sample=sample)

    @property
    def sizes(self) -> np.ndarray:
        """Loads that `probabilities` lists: 0, 1, 2 …"""
        return np.arange(self.probabilities.shape[-1])

    def by_step(self, agent: int | str = "mean") -> np.ndarray:
        """Probabilities of each size at each step, (rows, steps, sizes), of an agent or of one picked at random."""
        chosen = self._agents(agent)
        return self.probabilities[:, :, self.group_of[chosen]].mean(axis=2)

    def distribution(self, agent: int | str = "mean") -> np.ndarray:
        """Probabilities of each size at a step of the window picked at random, (rows, sizes)."""
        return self.by_step(agent).mean(axis=1)

    def mean(self, agent: int | str = "mean") -> np.ndarray:
        """Mean load in nodes, (rows,)."""
        return self.distribution(agent) @ self.sizes

    def std(self, agent: int | str = "mean") -> np.ndarray:
        """Standard deviation of the load in nodes, over outcomes, steps of the window and agents, (rows,)."""
        away = self.sizes - self.mean(agent)[:, None]
        return np.sqrt((self.distribution(agent) * away**2).sum(axis=1))

    def maximum(self, agent: int | str = "mean") -> np.ndarray:
        """Largest load that has a positive probability (or, if sampled, was drawn), (rows,)."""
        return np.where(self.distribution(agent) > 0, self.sizes, 0).max(axis=1)

    def cdf(self, agent: int | str = "mean") -> np.ndarray:
        """Probability that the load is at most each size, (rows, sizes)."""
        return np.minimum(np.cumsum(self.distribution(agent), axis=1), 1.0)

    def quantile(self, p: float, agent: int | str = "mean") -> np.ndarray:
        """Smallest size that holds a share p of the loads, (rows,).

        Raises
        ------
        UsageError
            If p is no probability.
        """
        if not 0 <= p <= 1:
            raise UsageError(f"quantile: expected a probability between 0 and 1, got {p:g}")
        # what lies below p by rounding alone reaches it
        return np.minimum((self.cdf(agent) < p - 1e-12).sum(axis=1), self.maximum(agent))

    def standard_error(self, agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of the mean over independent runs, (rows,), or None if it is exact."""
        if self.sample is None:
            return None
        runs = self.sample[..., self._agents(agent)].mean(axis=(2, 3))
        return runs.std(axis=1, ddof=1) / np.sqrt(runs.shape[1])

    @property
    def runs(self) -> int | None:
        """Runs of the sample, if sampled."""
        return None if self.sample is None else self.sample.shape[1]

    @property
    def alike(self) -> bool:
        """Whether all agents have the same load."""
        return self.probabilities.shape[2] == 1

    def _agents(self, agent: int | str) -> list[int]:
        network = self.scenario.network
        chosen = network.agent(agent, ("mean",))
        return list(range(network.agents)) if isinstance(chosen, str) else [chosen - 1]


@dataclass(frozen=True, eq=False, repr=False)
class SweptLoad(SweptRows[MessageLoad]):
    """Message loads against the values of one or two keys of the scenario; see `SweptRows`."""

    @property
    def rule(self) -> str:
        """Whose messages."""
        return self.parts[0].rule

    @property
    def nature(self) -> str:
        """How certain: "exact" or "sampled"."""
        return self.parts[0].nature

    @property
    def runs(self) -> int | None:
        """Runs of the sample, if sampled."""
        return self.parts[0].runs

    @property
    def seed(self) -> int | None:
        """Seed of the sample, if sampled."""
        return self.parts[0].seed

    @property
    def sizes(self) -> np.ndarray:
        """Loads that distributions list: 0, 1, 2 …"""
        return max((part.sizes for part in self.parts), key=len)

    def between(self, first: int, last: int) -> SweptLoad:
        """Return the same for steps first … last, of points with fewer up to their last."""
        parts = of_parts(self.over, self.parts, lambda part: part.between(first, min(last, int(part.steps[-1]))))
        return replace(self, parts=tuple(parts))

    def by_step(self, agent: int | str = "mean") -> np.ndarray:
        """Probabilities of each size at each step, (rows, steps, sizes), 0 at steps that a point does not have."""
        return self._read(lambda part: part.by_step(agent), 0.0)

    def distribution(self, agent: int | str = "mean") -> np.ndarray:
        """Probabilities of each size at a step of the window picked at random, (rows, sizes)."""
        return self._read(lambda part: part.distribution(agent), 0.0)

    def cdf(self, agent: int | str = "mean") -> np.ndarray:
        """Probability that the load is at most each size, (rows, sizes)."""
        return self._read(lambda part: part.cdf(agent), 1.0)

    def mean(self, agent: int | str = "mean") -> np.ndarray:
        """Mean load in nodes, (rows,)."""
        return self._read(lambda part: part.mean(agent))

    def std(self, agent: int | str = "mean") -> np.ndarray:
        """Standard deviation of the load in nodes, (rows,)."""
        return self._read(lambda part: part.std(agent))

    def maximum(self, agent: int | str = "mean") -> np.ndarray:
        """Largest load that has a positive probability (or, if sampled, was drawn), (rows,)."""
        return self._read(lambda part: part.maximum(agent))

    def quantile(self, p: float, agent: int | str = "mean") -> np.ndarray:
        """Smallest size that holds a share p of the loads, (rows,)."""
        return self._read(lambda part: part.quantile(p, agent))

    def standard_error(self, agent: int | str = "mean") -> np.ndarray | None:
        """Return the standard error of the mean over independent runs, (rows,), or None if it is exact."""
        return None if self.runs is None else self._read(lambda part: part.standard_error(agent))

    def _read(self, read: Callable[[MessageLoad], Any], fill: float = np.nan) -> np.ndarray:
        return below_each_other(of_parts(self.over, self.parts, read), fill)


@overload
def message_load(
    scenario: ScenarioLike,
    link: Sequence[float] | np.ndarray | float | LinkRows | None = None,
    rule: str = LFG,
    *,
    method: str = "exact",
    runs: int = RUNS,
    seed: int = SEED,
    over: None = None,
) -> MessageLoad: ...
@overload
def message_load(
    scenario: ScenarioLike,
    link: Sequence[float] | np.ndarray | float | LinkRows | None = None,
    rule: str = LFG,
    *,
    method: str = "exact",
    runs: int = RUNS,
    seed: int = SEED,
    over: Mapping[str, Any] | Over,
) -> SweptLoad: ...
@of_scenario
def message_load(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | LinkRows | None = None,
    rule: str = LFG,
    *,
    method: str = "exact",
    runs: int = RUNS,
    seed: int = SEED,
    over: Mapping[str, Any] | Over | None = None,
) -> MessageLoad | SweptLoad:
    """Distribution of the message load at every step of a scenario.

    Parameters
    ----------
    scenario, link : as for `stochfuse.predict`; of the scenario only the network matters.
    rule : "local-fusion-graph": every node that is new to the receiver; "naive": the senders' latest nodes, (42)/(43).
    method : "exact"; or "monte-carlo", sampled, for networks with too many states (naive loads are always exact).
    runs, seed : of the sample.
    over : values of one or two numbers of the scenario by their paths, as for `stochfuse.predict`.

    Returns
    -------
    MessageLoad
        Over all steps; see `MessageLoad.between`.  With `over` a `SweptLoad`.

    Raises
    ------
    UsageError
        If the request does not fit the scenario, or the exact walk has too many states.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.message_load("thesis-transient", [0.5]).mean().round(4)
    array([1.6898])
    """
    if over is not None:
        found = read_over(scenario, over)
        found.check(link)
        loads = of_parts(
            found,
            found.scenarios,
            lambda some: message_load(some, link, rule, method=method, runs=runs, seed=seed),
        )
        return SweptLoad(found, tuple(loads))
    choose("rule", rule, RULES)
    choose("method", method, METHODS)
    for name, value, least in (("runs", runs, 2), ("seed", seed, 0)):
        if value < least:
            raise UsageError(f"{name}: expected a whole number of at least {least}, got {value}")
    require_one_state(scenario, "message load")
    network, rows = scenario.network, link_rows(scenario, link)
    if network.delay != (1.0,):
        raise UsageError("network.delay: expected none for message loads, which are counted without delay")
    require_memoryless(rows, "message load", "it is counted for links whose steps are independent")
    last = network.steps
    drawn = [events(network, rows, k) for k in range(1, last + 1)] if rows.varies else [events(network, rows, 1)] * last
    groups = like_agents(network, rows)
    if method == MONTE_CARLO and rule != NAIVE:
        sample = sampled_loads(network.agents, drawn, len(rows.link), runs, seed)
        found = frequencies(sample, groups)
    else:
        sample, count = None, naive_load if rule == NAIVE else walked_load
        found = np.stack([count(network, rows, drawn, group[0]) for group in groups], axis=2)
    return MessageLoad(
        scenario=scenario,
        rule=rule,
        nature="exact" if sample is None else "sampled",
        link=rows.means(network),
        cases=rows.names,
        steps=np.arange(1, network.steps + 1),
        probabilities=found,
        group_of=np.array([next(g for g, group in enumerate(groups) if i in group) for i in range(network.agents)]),
        sample=sample,
        seed=None if sample is None else seed,
    )


Load = MessageLoad | SweptLoad


class Bytes(NamedTuple):
    """Bytes that an agent receives in a step.

    Parameters
    ----------
    node : bytes of one node.
    mean, maximum : (rows,) over the window.
    """

    node: int
    mean: np.ndarray
    maximum: np.ndarray


def node_bytes(dimension: int) -> int:
    """Bytes of a node: an information pair of d + d(d+1)/2 numbers, and what identifies it."""
    return NUMBER_BYTES * (dimension + dimension * (dimension + 1) // 2) + IDENTITY_BYTES


def in_bytes(load: Load, messages: Load, *, header: int = 0, agent: int | str = "mean") -> Bytes:
    """Return a load in bytes.

    Parameters
    ----------
    load : of either rule.
    messages : the naive load of the same window: the number of messages that arrive.
    header : bytes of every message that arrives, beside its nodes.

    Raises
    ------
    UsageError
        If the header is negative.
    """
    if header < 0:
        raise UsageError(f"header: expected a number of bytes of at least 0, got {header}")
    if isinstance(load, SweptLoad) and isinstance(messages, SweptLoad):
        both = zip(load.parts, messages.parts, strict=True)
        each = [in_bytes(own, number, header=header, agent=agent) for own, number in both]
        return Bytes(each[0].node, *(np.concatenate(column) for column in list(zip(*each, strict=True))[1:]))
    if isinstance(load, SweptLoad) or isinstance(messages, SweptLoad):
        raise TypeError("loads of the same points are put together")
    node = node_bytes(load.scenario.model.dimension)
    # a step brings most nodes when all its messages arrive, so that both maxima are reached together
    most = [
        node * load.between(k, k).maximum(agent) + header * messages.between(k, k).maximum(agent)
        for k in map(int, load.steps)
    ]
    return Bytes(node, node * load.mean(agent) + header * messages.mean(agent), np.max(most, axis=0))


class Accuracy(NamedTuple):
    """Accuracy against load, as in figures 61 and 62.

    Parameters
    ----------
    load : of the rule, over the window.
    prediction : expected covariance of the rule; not only of the window.
    values : (rows,) metric averaged over the steps of the window.
    error : (rows,) upper bound of its standard error, or None if nothing was sampled.
    """

    load: Load
    prediction: Any
    values: np.ndarray
    error: np.ndarray | None


def accuracy(
    load: Load,
    link: Any = None,
    *,
    metric: Any = "trace",
    quantity: str = "actual",
    agent: int | str = "mean",
    method: str = "exact",
    **settings: Any,
) -> Accuracy:
    """Put the accuracy beside a load, averaged over the same steps.

    Parameters
    ----------
    load : over the window wanted.
    link : what the load was computed for.
    metric, quantity : as for `stochfuse.predict`.
    method : "exact": general formulation (49) of the rule; or "monte-carlo".
    **settings : of `stochfuse.predict`.
    """
    if isinstance(load, SweptLoad):
        asked = {"metric": metric, "quantity": quantity, "agent": agent, "method": method, **settings}
        each = of_parts(load.over, load.parts, lambda part: accuracy(part, link, **asked))
        errors = [one.error for one in each if one.error is not None]
        error = np.concatenate(errors) if errors else None
        predictions = Swept(load.over, tuple(one.prediction for one in each))
        return Accuracy(load, predictions, np.concatenate([one.values for one in each]), error)
    scenario, last = load.scenario, int(load.steps[-1])
    if method == "exact":
        how = NAIVE if load.rule == NAIVE else GENERAL
    else:
        how, settings = method, {**settings, "estimator": load.rule}
    try:
        prediction = predict(scenario, link, how, quantity, **settings)
    except UsageError as error:
        raise UsageError(f"accuracy of {load.rule}: {error}") from None
    window = slice(int(load.steps[0]) - 1, last)
    errors = prediction.standard_error(metric, agent)
    return Accuracy(
        load=load,
        prediction=prediction,
        values=prediction.values(metric, agent)[:, window].mean(axis=1),
        # an average of dependent values errs by no more than they do on average
        error=None if errors is None else errors[:, window].mean(axis=1),
    )
