"""Messages that do not carry everything: load against accuracy of live agents, by protocol.

The agents are those of `stochfuse.data.agent`, each with its own memory, acknowledgements and fallbacks; only what
arrives is drawn.  In the place of measurements they carry noise footprints (`stochfuse.estimators.world`), so that
every run gives what each agent claims and what its error truly is over all noises,

    P      and      A = X Xᵀ

and both are averaged over the runs.  The load is what arrives at an agent in a step: nodes, or bytes of messages, each
message counted by itself, unlike the least load of `stochfuse.questions.messages`, of senders that know what each
receiver lacks.  Standard errors are jackknifed over groups of runs, for they are of metrics of averages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stochfuse.data.agent import Agent
from stochfuse.data.draw import drawn_arrivals
from stochfuse.data.messages import MessageProtocol, encode
from stochfuse.engines.replay import ArrivalRecord
from stochfuse.errors import UsageError
from stochfuse.estimators.progress import listener
from stochfuse.estimators.world import Footprints, World, world_of
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.prediction import quantities
from stochfuse.prediction.method import SEED
from stochfuse.prediction.predict import choose
from stochfuse.scenario import registry
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario, require_one_state

RUNS, GROUPS = 200, 20
"""Runs of a sample, and groups of them that are left out in turn for a standard error."""
QUANTITIES = ("claimed", "actual", "consistency", "bias", "rms")


class SampledLoad(NamedTuple):
    """A number for each row, and its standard error."""

    values: np.ndarray
    error: np.ndarray


class Lived(NamedTuple):
    """What agents of one protocol went through, (rows, runs, steps, agents, …).

    Parameters
    ----------
    nodes, bytes : that arrived.
    apart : estimates that were heard whose common information with what was known could not be told.
    P, actual, bias : of what they claimed.
    """

    nodes: np.ndarray
    bytes: np.ndarray
    apart: np.ndarray
    P: np.ndarray
    actual: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class ProtocolLoad(Result):
    """Load and accuracy of live agents under some protocols.

    Parameters
    ----------
    scenario, estimator : what the agents are told.
    protocols : names, as `stochfuse.data.messages.MessageProtocol` reads them.
    missing : what is done with what rests on nodes that are not there.
    link : (rows,) link probability of each row, averaged over the links if they differ.
    cases : a name per row where the rows are cases, else None.
    steps : (steps,) of the window.
    runs, seed : of the sample.
    lived : one for each protocol.
    """

    scenario: Scenario
    estimator: str
    protocols: tuple[str, ...]
    missing: str
    link: np.ndarray
    cases: tuple[str, ...] | None
    steps: np.ndarray
    runs: int
    seed: int
    lived: tuple[Lived, ...]

    def between(self, first: int, last: int) -> ProtocolLoad:
        """Return the same for steps first … last."""
        inside = (self.steps >= first) & (self.steps <= last)
        lived = tuple(Lived(*(part[:, :, inside] for part in each)) for each in self.lived)
        return replace(self, steps=self.steps[inside], lived=lived)

    def load(self, protocol: int, what: str = "nodes", agent: int | str = "mean") -> SampledLoad:
        """Nodes, bytes or estimates `apart` that a step brings an agent, on average.

        Parameters
        ----------
        protocol : its place.
        what : "nodes", "bytes" or "apart".
        """
        runs = getattr(self.lived[protocol], what)[..., self._agents(agent)].mean(axis=(2, 3))
        return _over_runs(lambda chosen: runs[:, chosen].mean(axis=1), self.runs)

    def accuracy(
        self, protocol: int, metric: Metric, quantity: str = "actual", agent: int | str = "mean"
    ) -> SampledLoad:
        """Metric of the averages over runs, averaged over the steps of the window.

        Raises
        ------
        UsageError
            If the quantity is none of live agents, or not to be had of the metric.
        """
        choose("quantity", quantity, QUANTITIES)
        quantities.check(quantity, metric)
        agents, lived = self._agents(agent), self.lived[protocol]

        def value(chosen: np.ndarray) -> np.ndarray:
            P, actual, bias = (
                part[:, chosen][:, :, :, agents].mean(axis=1) for part in (lived.P, lived.actual, lived.bias)
            )
            b = lived.bias[:, chosen][:, :, :, agents]
            square = actual + (b @ np.swapaxes(b, -1, -2)).mean(axis=1)
            return quantities.value(quantity, metric, Moments(P, actual, bias, square)).mean(axis=(1, 2))

        return _over_runs(value, self.runs)

    def _agents(self, agent: int | str) -> list[int]:
        network = self.scenario.network
        chosen = network.agent(agent, ("mean",))
        return list(range(network.agents)) if isinstance(chosen, str) else [chosen - 1]


def _over_runs(value: Callable[[np.ndarray], np.ndarray], runs: int) -> SampledLoad:
    """A number over all runs, and its standard error by leaving out groups of them in turn."""
    everyone, groups = np.arange(runs), min(GROUPS, runs)
    without = np.stack([value(everyone[everyone % groups != group]) for group in range(groups)])
    spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return SampledLoad(value(everyone), np.sqrt(spread * (groups - 1) / groups))


@of_scenario
def protocol_load(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | LinkRows | None = None,
    protocols: str | MessageProtocol | Sequence[str | MessageProtocol] = "acknowledged",
    *,
    estimator: str = registry.LFG,
    missing: str = "wait",
    runs: int = RUNS,
    seed: int = SEED,
) -> ProtocolLoad:
    """Load and accuracy of live agents whose messages follow a protocol.

    Parameters
    ----------
    scenario, link : as for `stochfuse.predict`.
    protocols : "acknowledged", "full", "own", "window:W", or several, under the same arrivals.
    estimator : of the agents.
    missing : "wait" or "intersect", see `stochfuse.data.messages.MessageProtocol`.
    runs, seed : of the sample.

    Raises
    ------
    UsageError
        If the estimator cannot be one live, or the request does not fit the scenario.

    Examples
    --------
    >>> import stochfuse as sf
    >>> found = sf.protocol_load("thesis-steady", [0.5], ["acknowledged", "window:1"], runs=20)
    >>> found.load(0).values > found.load(1).values
    array([ True])
    """
    require_one_state(scenario, "message load")
    if runs < 2 or seed < 0:
        raise UsageError(f"runs, seed: expected at least 2 runs and a seed of at least 0, got {runs} and {seed}")
    given = [protocols] if isinstance(protocols, str | MessageProtocol) else list(protocols)
    policies = [replace(MessageProtocol.of(each), missing=missing) for each in given]
    system, rows = scenario.system, link_rows(scenario, link)
    if system.detects is not None:
        raise UsageError("sensor.detection: expected sensors that do not miss for loads of live agents")
    world, seen = world_of(system), np.zeros((runs, system.steps, system.agents), dtype=bool)
    records = [drawn_arrivals(system, rows.take(np.array([row])), seen, seed) for row in range(len(rows.link))]
    made = _ProtocolAgents(scenario, estimator, world, Footprints(world), len(policies) * len(records) * runs)
    lived = [[made.lived(policy, record) for record in records] for policy in policies]
    stacked = tuple(Lived(*(np.stack(part) for part in zip(*each, strict=True))) for each in lived)
    return ProtocolLoad(
        scenario,
        estimator,
        tuple(map(str, policies)),
        missing,
        rows.means(scenario.network),
        rows.names,
        np.arange(1, system.steps + 1),
        runs,
        seed,
        stacked,
    )


class _ProtocolAgents:
    """Agents of a scenario that live through records."""

    def __init__(self, scenario: Scenario, estimator: str, world: World, riding: Footprints, total: int) -> None:
        self.scenario, self.estimator, self.world, self.riding = scenario, estimator, world, riding
        self._progress, self._done, self._total = listener(), 0, total

    def lived(self, policy: MessageProtocol, record: ArrivalRecord) -> Lived:
        """Every different run once."""
        found: dict[object, Lived] = {}
        out = []
        for run in range(record.runs):
            late = tuple((step, each) for (r, step), each in record.late.items() if r == run)
            key = (tuple(map(tuple, record.heard[run])), late)
            if key not in found:
                found[key] = self._run(policy, record, run)
            out.append(found[key])
            self._done += 1
            self._progress.advance("runs", self._done, self._total)
        return Lived(*(np.stack(part) for part in zip(*out, strict=True)))

    def _run(self, policy: MessageProtocol, record: ArrivalRecord, run: int) -> Lived:
        n = self.scenario.network.agents
        agents = [Agent.riding(self.scenario, i, self.estimator, policy, self.world, self.riding) for i in range(n)]
        kind, coming, steps = agents[0].kind, {}, []
        for step in range(1, record.steps + 1):
            for agent in agents if step > 1 else []:
                agent.step()
            said = [agent.says() for agent in agents]
            size = [len(encode(nodes, kind)) for nodes in said]
            for message in record.late.get((run, step), ()):
                coming.setdefault(step + message.delay, []).append((message.receiver, message.sender, said, size))
            masks = record.heard[run][step - 1]
            heard = [(i, j, said, size) for i in range(n) for j in range(n) if i != j and masks[i] >> j & 1]
            nodes, length = np.zeros(n), np.zeros(n)
            for i, j, what, long in (*heard, *coming.pop(step, ())):
                agents[i].hear(what[j])
                nodes[i] += len(what[j])
                length[i] += long[j]
            claims = [agent.claimed() for agent in agents]
            moments = [Moments.of_footprint(P, x) for x, P in claims]
            apart = np.array([agent.apart for agent in agents], dtype=float)
            columns = (np.stack([getattr(m, part) for m in moments]) for part in ("P", "actual", "bias"))
            steps.append((nodes, length, apart, *columns))
        return Lived(*(np.stack(part) for part in zip(*steps, strict=True)))
