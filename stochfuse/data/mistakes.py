"""Mistakes that people make in simulators: each a name, a line of text, and what a simulator with it would be.

`MISTAKES` is the table.  A mistake changes a `Simulator` (`stochfuse.data.supposed`): what is shown of the estimates,
the numbers, the links, or the exchange.  It yields variants, since the same mistake can be made in several ways; one
with a `grid` has a number that is not known and is estimated from the results.  What cannot be made of a scenario
yields nothing.

The likelier of two mistakes that show the same stands first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.cells import Cell
from stochfuse.data.supposed import ALONE, AS_IT_WAS, BOTH_WAYS, LOCAL, OWN_LOST, PRIOR, Shown, Simulator
from stochfuse.kalman.metrics import metric
from stochfuse.scenario.network import ARCHITECTURES, LinkRows, mean_delivery
from stochfuse.scenario.registry import LFG, NAIVE, OPTIMAL, STAND_ALONE, SUMS
from stochfuse.scenario.system import System

SCALES = tuple(np.log([0.1, 0.25, 0.5, 0.8, 1.25, 2.0, 4.0, 10.0]))
"""Factors at which a search for the right one begins, as logarithms."""
MEMORY = (0.3, 0.6, 0.9)
"""Correlation of a link's states from step to step at which a search begins."""
FROZEN = 1e-9
"""Probability that a link which is drawn once changes in a step."""
MOST_WEIGHED = 3
"""Agents up to which the weights of an intersection are worked out."""
LONG = 0.8
"""Correlation of a link's states where it is what they deliver that is estimated."""
FILTERS, TRUTH, CLAIMS = "in the filters alone", "in the truth alone", "in what is claimed alone"


class Variant(NamedTuple):
    """One way to make a mistake.

    Parameters
    ----------
    of : the simulator, of the unknown number if there is one.
    grid : values of it where a search for the right one begins; empty if there is none.
    shown : what a person sees of it.
    note : which way it is, where there are several; may be empty.
    """

    of: Callable[[float], Simulator]
    grid: tuple[float, ...] = ()
    shown: Callable[[float], float] = float
    note: str = ""


class Mistake(NamedTuple):
    """A mistake that people make.

    Parameters
    ----------
    name : as programs read it.
    text : what it is, in a line; {0} is the estimated number.
    variants : ways to make it in a simulator; none of what is found otherwise.
    """

    name: str
    text: str
    variants: Callable[[Simulator], Iterator[Variant]] = lambda _: iter(())


def _certain(simulator: Simulator, note: str = "") -> Variant:
    return Variant(lambda _: simulator, note=note)


def _system(s: Simulator, **changes: Any) -> Simulator:
    return replace(s, system=replace(s.system, **changes))


def _network(s: Simulator, **changes: Any) -> Simulator:
    return _system(s, network=replace(s.system.network, **changes))


def _rows(s: Simulator, **changes: Any) -> Simulator:
    return replace(s, rows=replace(s.rows, **changes))


def _changed(
    s: Simulator, change: Callable[[System, float], System]
) -> Iterator[tuple[str, Callable[[float], Simulator]]]:
    """Where a number may be wrong, and the simulator: everywhere, in what its filters are told, or in what is true."""
    yield "", lambda at: replace(s, system=change(s.system, at))
    if s.followed and s.estimator in SUMS:
        told = s.told or s.system
        yield FILTERS, lambda at: replace(s, told=change(told, at))
        yield TRUTH, lambda at: replace(s, system=change(s.system, at), told=told)


def _certainly_changed(s: Simulator, change: Callable[[System], System]) -> Iterator[Variant]:
    for note, of in _changed(s, lambda system, _: change(system)):
        yield Variant(of, note=note)


def scaled(system: System, *, Q: float = 1.0, R: float = 1.0, P0: float = 1.0) -> System:
    """Return a system with some noises multiplied."""
    noise = system.noise
    if noise is not None and noise.disturbance is not None:
        noise = replace(noise, disturbance=R * noise.disturbance)
    return replace(
        system,
        model=replace(system.model, Q=Q * system.model.Q),
        sensors=tuple(replace(sensor, R=R * sensor.R) for sensor in system.sensors),
        P0=P0 * system.P0,
        filters=tuple(replace(f, Q=Q * f.Q, P0=P0 * f.P0) for f in system.filters),
        process=None if system.process is None else Q * system.process,
        noise=noise,
    )


def _scaled(s: Simulator, which: str) -> Iterator[Variant]:
    for note, of in _changed(s, lambda system, log: scaled(system, **{which: float(np.exp(log))})):
        yield Variant(of, SCALES, np.exp, note)


def _concerned(s: Simulator) -> tuple[bool, ...]:
    """Whether claimed numbers alone are concerned; either is possible where errors are looked at."""
    return (False, True) if s.followed else (False,)


def _stage(s: Simulator, stage: str) -> Iterator[Variant]:
    if not s.system.one_state or s.stage == stage or s.shift or (stage == LOCAL and s.system.detects is not None):
        return
    for from_start in (True, False):
        for claimed in _concerned(s):
            note = CLAIMS if claimed else ""
            yield _certain(replace(s, stage=stage, from_start=from_start, claimed_only=claimed), note)


def _shifted(s: Simulator) -> Iterator[Variant]:
    if not s.system.one_state or s.shift:
        return
    for claimed in _concerned(s):
        for from_start in (True, False):
            note = "the step before" + (f", {CLAIMS}" if claimed else "")
            yield _certain(replace(s, shift=-1, from_start=from_start, claimed_only=claimed), note)
    longer = one_step_more(s)
    if longer is not None:
        for claimed in _concerned(s):
            note = "the step after" + (f", {CLAIMS}" if claimed else "")
            yield _certain(replace(longer, shift=1, claimed_only=claimed), note)


def one_step_more(s: Simulator, first: bool = False) -> Simulator | None:
    """Return the simulator with a step more, at the end or before the first exchange; None where what comes is unknown.

    In the step before the first exchange nobody hears anything.
    """
    system, steps = s.system, s.system.steps
    varying = system.model.varies or any(sensor.varies for sensor in system.sensors) or s.rows.varies
    if (varying and not first) or system.filters or system.relations:
        return None

    def longer(M: np.ndarray) -> np.ndarray:
        return np.concatenate([M[:1], M]) if first else np.concatenate([M, M[-1:]])

    model = replace(system.model, **{name: longer(getattr(system.model, name)) for name in ("F", "Q", "Bu")})
    sensors = tuple(
        replace(
            x,
            H=longer(x.H),
            R=longer(x.R),
            detection=x.detection if x.detection is None or not x.detection.ndim else longer(x.detection),
        )
        for x in system.sensors
    )
    link, rows = s.rows.link, s.rows
    if first and rows.bursts is not None:
        return None
    if first:
        every = link if rows.varies else np.repeat(link[:, None], steps, axis=1)
        rows = replace(rows, link=np.concatenate([np.zeros_like(every[:, :1]), every], axis=1))
    elif rows.varies:
        return None
    network = replace(system.network, steps=steps + 1)
    return replace(s, system=replace(system, model=model, sensors=sensors, network=network), rows=rows)


def _measured_first(s: Simulator) -> Iterator[Variant]:
    longer = one_step_more(s, first=True)
    if longer is None or s.shift:
        return
    system, d = longer.system, s.system.dimension

    def early(M: np.ndarray) -> np.ndarray:
        # the step that measures needs a sensor's H, which is never used at step 1 and may pause there
        return np.concatenate([M[:1], M[2:3], M[2:]]) if len(M) > 2 else M

    sensors = tuple(replace(x, H=early(x.H), R=early(x.R)) for x in system.sensors)
    F, Q, Bu = system.model.F.copy(), system.model.Q.copy(), system.model.Bu.copy()
    F[1], Q[1], Bu[1] = np.eye(d), 0.0, 0.0
    models = [replace(system.model, F=F, Q=Q, Bu=Bu)]
    if len(system.model.F) > 2:
        models.append(replace(system.model, F=early(system.model.F), Q=early(system.model.Q)))
    for model in models:
        yield _certain(replace(_system(longer, sensors=sensors, model=model), shift=1))


def _start(s: Simulator, shared: bool) -> Iterator[Variant]:
    if s.system.shared != shared and s.system.agents > 1:
        yield _certain(_system(s, shared=shared))


def _estimator(s: Simulator, name: str, unless: tuple[str, ...] = ()) -> Iterator[Variant]:
    if s.estimator not in (name, *unless) and s.system.agents > 1:
        yield _certain(replace(s, estimator=name, habits=s.habits - {AS_IT_WAS}))


def _intersection(s: Simulator) -> Iterator[Variant]:
    # weights take long, and many agents have many
    if s.system.agents <= MOST_WEIGHED:
        yield from _estimator(s, "covariance-intersection", ("split-ci", STAND_ALONE))


def _habit(s: Simulator, habit: str) -> Iterator[Variant]:
    fits = {
        BOTH_WAYS: s.system.network.architecture == "ad-hoc" and s.rows.bursts is None and s.system.agents > 1,
        OWN_LOST: s.estimator in SUMS and s.rows.bursts is None,
        ALONE: s.system.agents > 1 and s.system.steps > 1,
        AS_IT_WAS: s.estimator == LFG or (s.estimator == NAIVE and len(s.system.network.delay) > 1),
    }
    if fits[habit]:
        yield _certain(replace(s, habits=s.habits | {habit}))


def _delayed(s: Simulator) -> Iterator[Variant]:
    if s.system.network.delay == (1.0,) and s.system.agents > 1:
        yield _certain(_network(s, delay=(0.0, 1.0)))


def _not_delayed(s: Simulator) -> Iterator[Variant]:
    if s.system.network.delay != (1.0,):
        yield _certain(_network(s, delay=(1.0,), delays=None))


def _architecture(s: Simulator) -> Iterator[Variant]:
    network = s.system.network
    # between two agents all architectures are alike
    if s.system.agents < 3 or not s.rows.uniform or s.rows.bursts is not None or network.hears is not None:
        return
    for architecture in ARCHITECTURES:
        if architecture != network.architecture and network.delays is None:
            yield _certain(_network(s, architecture=architecture), architecture)


def _agents(s: Simulator) -> Iterator[Variant]:
    system, n = s.system, s.system.agents
    alike = len(set(system.labels)) == 1 and s.rows.uniform and s.rows.bursts is None and not s.whose
    if not alike or not system.one_state or system.noise is not None or system.network.hears is not None:
        return
    for m in (n - 1, n + 1):
        if m >= 1 and system.network.delays is None:
            other = replace(
                _network(s, agents=m).system, sensor_of=system.sensor_of[:1] * m, labels=system.labels[:1] * m
            )
            # one stands for all, since they are alike
            yield _certain(replace(s, system=other, whose=(1,) * n), f"{m} agents")


def _links(s: Simulator, of: Callable[[np.ndarray], np.ndarray]) -> Iterator[Variant]:
    if s.system.agents > 1 and s.rows.bursts is None:
        there = s.rows.link > 0 if s.rows.link.ndim > 2 else np.ones(1, dtype=bool)
        yield _certain(_rows(s, link=np.where(there, of(s.rows.link), s.rows.link)))


def _turned(s: Simulator) -> Iterator[Variant]:
    if not s.rows.uniform:
        yield _certain(_rows(s, link=np.swapaxes(s.rows.link, -1, -2)))


def _scaled_links(s: Simulator) -> Iterator[Variant]:
    if not s.rows.uniform and s.rows.bursts is None:
        grid = tuple(np.log([0.25, 0.5, 0.8, 1.25, 2.0]))
        yield Variant(lambda log: _rows(s, link=np.minimum(1.0, s.rows.link * np.exp(log))), grid, np.exp)


def _silent_at_first(s: Simulator) -> Iterator[Variant]:
    if s.system.agents < 2 or s.rows.bursts is not None or not s.rows.link.any():
        return
    rows, steps = s.rows, s.system.steps
    every = rows.link.copy() if rows.varies else np.repeat(rows.link[:, None], steps, axis=1)
    every[:, 0] = 0.0
    yield _certain(_rows(s, link=every))


def with_memory(rows: LinkRows, memory: float) -> LinkRows:
    """Return rows whose links are good or bad for a while, and deliver with the same mean probability."""
    leave = max(1.0 - memory, FROZEN)
    bursts = tuple(
        None if not 0 < µ < 1 else np.array([leave * (1.0 - µ), leave * µ, 1.0, 0.0]) for µ in rows.link.tolist()
    )
    return replace(rows, bursts=bursts)


def _bursts(s: Simulator) -> Iterator[Variant]:
    if _may_have_memory(s):
        yield Variant(lambda memory: replace(s, rows=with_memory(s.rows, _share(memory))), MEMORY, _share)
        # the correlation from step to step of deliveries is that of the states times the square of the contrast
        yield Variant(
            lambda contrast: replace(s, rows=_with_contrast(s.rows, _share(contrast))),
            MEMORY,
            lambda contrast: LONG * _share(contrast) ** 2,
            "between better and worse",
        )


def _share(at: float) -> float:
    return min(max(float(at), 0.0), 1.0)


def _with_contrast(rows: LinkRows, contrast: float) -> LinkRows:
    """Return rows whose links are better and worse for a while, each half of the time."""
    leave, bursts = (1.0 - LONG) / 2, []
    for µ in rows.link.tolist():
        spread = contrast * min(µ, 1.0 - µ)
        bursts.append(None if not 0 < µ < 1 else np.array([leave, leave, µ + spread, µ - spread]))
    return replace(rows, bursts=tuple(bursts))


def _drawn_once(s: Simulator) -> Iterator[Variant]:
    if _may_have_memory(s):
        yield _certain(replace(s, rows=with_memory(s.rows, 1.0)))


def _may_have_memory(s: Simulator) -> bool:
    inside = s.rows.link.ndim == 1 and bool(((s.rows.link > 0) & (s.rows.link < 1)).any())
    apart = OWN_LOST not in s.habits and BOTH_WAYS not in s.habits and s.system.network.delays is None
    return inside and apart and s.rows.bursts is None and s.system.agents > 1 and s.system.steps > 1


def _no_bursts(s: Simulator) -> Iterator[Variant]:
    if s.rows.bursts is not None:
        pairs = zip(s.rows.link, s.rows.bursts, strict=True)
        link = np.array([µ if b is None else np.where(µ > 0, mean_delivery(b), 0.0) for µ, b in pairs])
        yield _certain(_rows(s, link=link, bursts=None))


def _shown(s: Simulator, *some: Shown, note: str = "") -> Iterator[Variant]:
    for one in some:
        yield _certain(replace(s, shown=(*s.shown, one)), note)


def _times(s: Simulator, *factors: Callable[[Cell, Simulator], float], note: str = "") -> Iterator[Variant]:
    """Numbers are shown times a factor."""
    for factor in factors:
        yield from _shown(s, lambda numbers, cell, s, factor=factor: numbers * factor(cell, s), note=note)


def _power(cell: Cell, s: Simulator) -> int:
    """Which power of the states' units a cell's numbers are in."""
    return 2 if metric(cell.metric, s.system.model).squared else 1


def _three(numbers: np.ndarray, cell: Cell, s: Simulator) -> np.ndarray:
    return 3.0 * (np.sqrt(numbers) if _power(cell, s) == 2 else numbers)


def _constant(numbers: np.ndarray, cell: Cell, s: Simulator, *, which: str) -> np.ndarray:
    k = min(cell.step, s.system.steps) - 1
    M = s.system.model.Q[k] if which == "Q" else s.system.sensors[s.system.sensor_of[cell.agents[0] - 1]].R[k]
    value = metric(cell.metric, s.system.model).of(M) if len(M) == s.system.dimension else np.trace(M)
    return np.full_like(numbers, float(value))


def _noise(s: Simulator) -> Iterator[Variant]:
    for which in ("R", "Q"):
        yield from _shown(s, partial(_constant, which=which), note=which)


def _sum(s: Simulator) -> Iterator[Variant]:
    for number, name in ((s.system.agents, "agents"), (s.system.dimension, "states")):
        if number > 1:
            yield from _times(s, lambda *_, number=number: float(number), note=f"the sum over {name}")
            yield from _times(s, lambda *_, number=number: 1.0 / number, note=f"the mean over {name}")


def _one_agent(s: Simulator) -> Iterator[Variant]:
    n = s.system.agents
    if len(set(s.system.labels)) > 1 or not s.rows.uniform:
        for i in range(1, n + 1):
            yield _certain(replace(s, whose=(i,) * n), f"agent {i}")


def _swapped(s: Simulator) -> Iterator[Variant]:
    n = s.system.agents
    if len(set(s.system.labels)) > 1 or not s.rows.uniform:
        turned = [(*range(2, n + 1), 1), (n, *range(1, n)), tuple(range(n, 0, -1))]
        for order in dict.fromkeys(turned):
            yield _certain(replace(s, whose=order), f"{', '.join(map(str, order))} in the place of 1 to {n}")


def _metric(s: Simulator) -> Iterator[Variant]:
    states = s.system.model.states
    if len(states) > 1 and s.metric is None:
        single = [f"{kind}:{state}" for state in states for kind in ("var", "std")]
        for name in ("trace", "max-eig", "det", f"rms:{','.join(states)}", *single):
            yield _certain(replace(s, metric=metric(name, s.system.model)), name)


def _transposed(s: Simulator) -> Iterator[Variant]:
    F = s.system.model.F
    if s.system.one_state and (np.swapaxes(F, -1, -2) != F).any():
        yield from _certainly_changed(s, lambda x: replace(x, model=replace(x.model, F=np.swapaxes(x.model.F, -1, -2))))


def _no_noise(s: Simulator) -> Iterator[Variant]:
    if s.system.one_state and s.system.model.Q.any():
        yield from _certainly_changed(s, lambda system: scaled(system, Q=0.0))


def _other_error(s: Simulator, of: Callable[[np.ndarray], np.ndarray | None]) -> Iterator[Variant]:
    if s.followed and s.system.error is not None and s.system.error.any():
        yield _certain(_system(s, error=of(s.system.error)))


def _with_error(s: Simulator) -> Iterator[Variant]:
    if s.followed and s.system.dimension == 1 and s.system.one_state:
        deviation = np.sqrt(s.system.P0)
        yield Variant(
            lambda at: _system(s, error=at * deviation),
            (-10.0, -3.0, -1.0, -0.3, 0.3, 1.0, 3.0, 10.0),
            lambda at: at * float(deviation[0, 0]),
        )


WRONG_LINK, DEPENDENT = "wrong-link", "dependent-runs"
MISTAKES = (
    Mistake(
        "prior-for-posterior",
        "the covariance predicted for the step, before measurement and fusion, is shown for the fused one",
        lambda s: _stage(s, PRIOR),
    ),
    Mistake("step-off-by-one", "each step shows the step before it, or the one after", _shifted),
    Mistake(
        "measured-at-step-1",
        "the agents measure before the first exchange, where step 1 is the exchange of their first estimates",
        _measured_first,
    ),
    Mistake(
        "shared-start",
        "all agents start from one common estimate, where the scenario has independent ones",
        lambda s: _start(s, True),
    ),
    Mistake(
        "independent-start",
        "the agents start from independent estimates, where the scenario has a common one",
        lambda s: _start(s, False),
    ),
    Mistake(
        "nothing-removed",
        "what the estimates have in common is not removed when they are added up: naive fusion (42)/(43)",
        lambda s: _estimator(s, NAIVE, (OPTIMAL,)) if s.estimator == LFG else iter(()),
    ),
    Mistake(
        "naive-for-graph",
        "naive fusion (42)/(43) is what was simulated",
        lambda s: _estimator(s, NAIVE),
    ),
    Mistake(
        "not-brought-forward",
        "what the estimates have in common is removed as it was, not brought forward by the time update",
        lambda s: _habit(s, AS_IT_WAS),
    ),
    Mistake(
        "pair-drawn-once",
        "each pair of agents is drawn once, so that both messages arrive or neither",
        lambda s: _habit(s, BOTH_WAYS),
    ),
    Mistake(
        "own-message-lost",
        "an agent's own estimate is drawn like a message, and lost with probability 1 − µ",
        lambda s: _habit(s, OWN_LOST),
    ),
    Mistake("delay-of-one", "messages arrive a step late", _delayed),
    Mistake("no-delay", "messages arrive at once, where the scenario delays them", _not_delayed),
    Mistake("one-minus-link", "µ is the probability of a loss", lambda s: _links(s, lambda µ: 1.0 - µ)),
    Mistake(
        "squared-link",
        "a message arrives with probability µ², as if its acknowledgement were lost too",
        lambda s: _links(s, np.square),
    ),
    Mistake("links-ignored", "every message arrives", lambda s: _links(s, np.ones_like)),
    Mistake(
        "deviation-for-variance",
        "the root is shown: a standard deviation for a variance",
        lambda s: _shown(s, lambda numbers, *_: np.sqrt(np.maximum(numbers, 0.0))),
    ),
    Mistake(
        "variance-for-deviation",
        "the square is shown: a variance for a standard deviation",
        lambda s: _shown(s, lambda numbers, *_: numbers**2),
    ),
    Mistake("three-sigma", "three standard deviations are shown", lambda s: _shown(s, _three)),
    Mistake("sum-for-mean", "a sum over agents or states is shown for a mean, or a mean for a sum", _sum),
    Mistake(
        "nees-per-state",
        "NEES is divided by the number of states",
        lambda s: iter([_certain(replace(s, nees=1.0 / s.system.dimension))] if s.system.dimension > 1 else []),
    ),
    Mistake("wrong-metric", "another number is made of the covariance matrix", _metric),
    Mistake("one-agent-for-mean", "one agent stands for all", _one_agent),
    Mistake("agents-swapped", "the agents are numbered otherwise", _swapped),
    Mistake(
        "noise-for-covariance",
        "a noise covariance, R or Q, is shown for that of the estimate",
        _noise,
    ),
    Mistake("process-noise-left-out", "the process noise Q is left out", _no_noise),
    Mistake(
        "local-for-fused",
        "the local estimate before the exchange is shown for the fused one",
        lambda s: _stage(s, LOCAL),
    ),
    Mistake("not-fed-back", "the filters go on without what was fused", lambda s: _habit(s, ALONE)),
    Mistake(
        "nothing-fused",
        "no message is used: every agent's own filter",
        lambda s: _estimator(s, STAND_ALONE) if not s.habits else iter(()),
    ),
    Mistake("Q-scaled", "the process noise Q is {0:.3g} times that of the scenario", lambda s: _scaled(s, "Q")),
    Mistake("R-scaled", "the measurement noise R is {0:.3g} times that of the scenario", lambda s: _scaled(s, "R")),
    Mistake(
        "P-scaled",
        "the covariance of the first estimates is {0:.3g} times that of the scenario",
        lambda s: _scaled(s, "P0"),
    ),
    Mistake(
        "initial-error-left-out",
        "the known initial error (initial.error) is left out",
        lambda s: _other_error(s, lambda error: None),
    ),
    Mistake(
        "sign-of-error",
        "errors have the other sign: truth less estimate",
        lambda s: _other_error(s, np.negative),
    ),
    Mistake("initial-error", "the first estimates are off by {0:.3g} on average", _with_error),
    Mistake("F-transposed", "F is transposed", _transposed),
    Mistake("wrong-number-of-agents", "there is an agent more, or one less", _agents),
    Mistake("wrong-architecture", "who hears whom is drawn by another architecture", _architecture),
    Mistake("silent-at-step-1", "nothing is exchanged at step 1", _silent_at_first),
    Mistake("link-transposed", "receiver and sender are exchanged in the matrix of links", _turned),
    Mistake("no-bursts", "losses are independent, where the scenario has bursts", _no_bursts),
    Mistake("links-drawn-once", "each link is drawn once for all steps of a run", _drawn_once),
    Mistake("bursts", "losses come in bursts, with correlation {0:.2g} from step to step", _bursts),
    Mistake(
        "inverse-shown",
        "the information, 1/P, is shown",
        lambda s: _shown(s, lambda numbers, *_: 1.0 / numbers),
    ),
    Mistake(
        "divided-by-runs",
        "a standard error, or a number divided by that of runs, is shown",
        lambda s: _times(s, lambda c, _: c.runs**-0.5, lambda _, s: s.system.agents**-0.5, lambda c, _: 1.0 / c.runs),
    ),
    Mistake(
        "degrees",
        "radians and degrees are confused",
        lambda s: _times(s, lambda c, s: (180.0 / np.pi) ** _power(c, s), lambda c, s: (np.pi / 180.0) ** _power(c, s)),
    ),
    Mistake("best-for-graph", "the optimum of what arrived is shown", lambda s: _estimator(s, OPTIMAL, (STAND_ALONE,))),
    Mistake(
        "intersection-for-graph",
        "covariance intersection is what was simulated",
        _intersection,
    ),
    Mistake("link-scaled", "the links' probabilities are {0:.3g} times those of the scenario", _scaled_links),
)
"""Known mistakes whose simulators can be made; wrong links and dependent runs are found otherwise."""
