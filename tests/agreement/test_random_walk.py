"""A random walk over valid scenarios × calls: nothing comes out but finite answers and refusals with a reason.

Every step has a seed of its own, and what fails is printed with its scenario made as small as it goes, as JSON:

    STOCHFUSE_WALK_SECONDS=600 python -m pytest -n0 -m slow tests/agreement/test_random_walk.py     a longer walk
    STOCHFUSE_WALK_SEED=7      another way
    python -m tests.agreement.test_random_walk FILE                     one step again, from the JSON that was printed
"""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.prediction.quantities import QUANTITIES
from stochfuse.scenario.registry import CRITERIA, ESTIMATORS, METHODS
from tests.oracles import random_scenarios

SEED = int(os.environ.get("STOCHFUSE_WALK_SEED", "1"))
SECONDS = float(os.environ.get("STOCHFUSE_WALK_SECONDS", "60"))
QUICK_STEPS = 60
CALLS_PER_SCENARIO = 3
LIMIT = 20.0
"""Seconds of processor time that a call on a scenario of this size may take."""
FEW_GRAPHS = 300
PACKAGE = f"{Path(sf.__file__).parent}{os.sep}"
STATISTICS = ("mean", "variance", "std", "quantile:0.9", "at-most:1.5", "derivative")
METRICS = ("trace", "trace", "det", "max-eig", "std:FIRST", "var:FIRST", "rms:ALL")

Arguments = dict[str, Any]


class TookTooLongError(Exception):
    """A call that goes on."""


# what is asked: every call draws its arguments, and yields the numbers of its answer by name


def _predicted(s: sf.Scenario, statistic: str, metric: str, agent: Any, shown: str | None, **asked: Any) -> Arguments:
    p = sf.predict(s, **asked)
    if shown is not None:
        p = p.shown_as(shown)
    numbers = {"values": p.values(metric, agent), "statistic": p.statistic(statistic, metric, agent)}
    return numbers | {
        "steady": p.steady_values(metric, agent),
        "standard error": p.standard_error(metric, agent),
        "moments": p.by_group,
        "table": p.table(metric, agent),
    }


def _compared(s: sf.Scenario, metric: str, agent: Any, **asked: Any) -> Arguments:
    found = sf.compare(s, **asked)
    return {"values": found.values(metric, agent), "differences": found.differences(metric, agent)}


def _compared_estimators(s: sf.Scenario, quantities: list[str], metric: str, **asked: Any) -> Arguments:
    found = sf.compare_estimators(s, quantities=quantities, **asked)
    return {quantity: found.values(quantity, metric) for quantity in quantities}


def _least_link(s: sf.Scenario, share: float, **asked: Any) -> Arguments:
    """Ask for a value somewhere between those of µ = 0 and µ = 1."""
    ends = sf.predict(s, [0.0, 1.0], asked.get("method")).values()[:, -1]
    found = sf.least_link(s, float(ends[1] + share * (ends[0] - ends[1])), **asked)
    return {"link": found.link, "value": found.value, "enclosure": found.enclosure, "below": found.below}


def _agents_needed(s: sf.Scenario, share: float, link: float, **asked: Any) -> Arguments:
    first = float(sf.predict(s, [link]).values()[0, -1])
    return {"agents": sf.agents_needed(s, share * first, link, max_agents=20, **asked).agents}


def _sensitivity(s: sf.Scenario, **asked: Any) -> Arguments:
    found = sf.sensitivity(s, **asked)
    return {"derivative": found.derivative, "error": found.error, "value": found.value}


def _share_of_gain(s: sf.Scenario, **asked: Any) -> Arguments:
    return {"value": sf.share_of_gain(s, **asked).value}


def _steady_state(s: sf.Scenario, **asked: Any) -> Arguments:
    found = sf.steady_state(s, **asked)
    return {"P": found.P, "residual": found.residual}


def _message_load(s: sf.Scenario, **asked: Any) -> Arguments:
    found = sf.message_load(s, **asked)
    return {"mean": found.mean(), "probabilities": found.probabilities}


def _states(s: sf.Scenario, shape: list[int], **asked: Any) -> Arguments:
    return {"x": sf.predict_states(s, np.linspace(-1, 1, int(np.prod(shape))).reshape(shape), **asked).x}


def _derived(s: sf.Scenario, kind: str, at: float, **asked: Any) -> Arguments:
    """Formulas of like agents; of the scenario they take the numbers of agents and steps."""
    size = {"agents": s.network.agents, "step": min(s.network.steps, 2)}
    form = {"simplified": sf.derive_simplified, "general": sf.derive_general, "optimal": sf.derive_optimal}[kind](
        **size, **asked
    )
    return {"value": form.lambdify()(at, 1.0, 2.0, 3.0)}


CALLS: dict[str, Callable[..., Arguments]] = {
    "predict": _predicted,
    "compare": _compared,
    "compare_estimators": _compared_estimators,
    "least_link": _least_link,
    "agents_needed": _agents_needed,
    "sensitivity": _sensitivity,
    "share_of_gain": _share_of_gain,
    "steady_state": _steady_state,
    "message_load": _message_load,
    "predict_states": _states,
    "derive": _derived,
}
WEIGHTS = (0.5, 0.1, 0.08, 0.05, 0.03, 0.05, 0.03, 0.05, 0.04, 0.04, 0.03)


def drawn(rng: np.random.Generator, call: str, made: Arguments) -> Arguments:
    """Return random arguments of a call."""
    n, steps = made["network"]["agents"], made["network"]["steps"]
    model: Arguments = made.get("model", {"F": np.eye(15).tolist()})
    d, p = np.atleast_2d(model["F"]).shape[-1], np.atleast_2d(model.get("H", 1.0)).shape[-2]
    states = model.get("states") or (["x"] if d == 1 else [f"x{i}" for i in range(1, d + 1)])
    pick = lambda choices: choices[int(rng.integers(len(choices)))]  # noqa: E731
    some = lambda choices, most: [str(c) for c in rng.permutation(choices)[: int(rng.integers(1, most + 1))]]  # noqa: E731
    maybe = lambda probability: bool(rng.random() < probability)  # noqa: E731
    like = not model.get("own") and not any({"F", "Q", "P", "M"} & set(agent) for agent in made.get("agent", ()))
    fitting = list(ESTIMATORS) if like or maybe(0.2) else ["lwin", "itns", "stand-alone", "blender", "joint-blender"]
    metric = pick(METRICS).replace("FIRST", states[0]).replace("ALL", ",".join(states))
    agent = pick(["mean", "mean", "worst", "best", int(rng.integers(1, n + 1))])
    link = pick([None, None, [0.0, 0.5, 1.0], [0.3], [rng.integers(0, 3, size=(n, n)).astype(float).tolist()]])
    link = (np.array(link) / 2).tolist() if np.ndim(link) == 3 else link
    how = {"max_graphs": FEW_GRAPHS} | ({"prune": True} if n < 4 and maybe(0.1) else {})
    how |= {"runs": 6, "workers": 1} if maybe(0.7) else {}
    how |= {"criterion": pick(CRITERIA)} if maybe(0.2) else {}
    asked = {"method": pick(METHODS[:4]), "quantity": pick(QUANTITIES), "of": metric, "agent": agent}
    asked = {key: value for key, value in asked.items() if maybe(0.6)} | {"max_graphs": FEW_GRAPHS}
    asked |= {"steady": True} if maybe(0.15) else {"step": int(rng.integers(1, steps + 1))} if maybe(0.3) else {}
    if call == "predict":
        method = pick([None, *METHODS, "general", "monte-carlo"]) if like else pick(["general", "monte-carlo"])
        wanted = {"method": method, "quantity": pick(QUANTITIES), "link": link}
        wanted |= {"estimator": pick(fitting)} if method in ("general", "monte-carlo") and maybe(0.8) else {}
        wanted |= {"steady": True} if method in (None, "simplified") and maybe(0.2) else {}
        statistic = pick(STATISTICS) if method in ("general", "naive") and maybe(0.6) else "mean"
        shown = pick(["claimed", "actual", wanted["quantity"]]) if maybe(0.2) else None
        return {"statistic": statistic, "metric": metric, "agent": agent, "shown": shown} | wanted | how
    if call == "compare":
        methods = {"methods": some(METHODS, 5)} if maybe(0.7) else {}
        return {"metric": metric, "agent": agent, "link": link, "quantity": pick(QUANTITIES)} | methods | how
    if call == "compare_estimators":
        wanted = {"quantities": some([q for q in QUANTITIES if q != "optimal"], 3), "metric": metric, "link": link}
        wanted |= {"estimators": some(fitting, 4)} if maybe(0.6) else {}
        return wanted | ({"method": pick(("general", "monte-carlo"))} if maybe(0.5) else {}) | how
    if call in ("least_link", "agents_needed"):
        number = {"link": pick([0.0, 0.5, 1.0])} if call == "agents_needed" else {}
        return {"share": pick([0.5, 0.9, 1.5, 0.0])} | number | asked
    if call in ("sensitivity", "share_of_gain"):
        one = pick([None, 0.5, 0.0, 1.0]) if call == "sensitivity" else link
        return {"link": one} | asked
    if call == "steady_state":
        return {"link": link}
    if call == "message_load":
        return {
            "link": link,
            "rule": pick(("local-fusion-graph", "naive")),
            "method": pick(("exact", "monte-carlo")),
            "runs": 6,
        }
    if call == "predict_states":
        return {"shape": [steps, p] if maybe(0.5) else [steps, n, p], "link": link, "printed": maybe(0.2)}
    kind = pick(("simplified", "general", "optimal"))
    wanted = {"architecture": pick(("ad-hoc", "broadcast", "cyclic"))} if kind != "simplified" else {}
    wanted |= {"estimator": pick(("local-fusion-graph", "naive", "optimal"))} if kind == "general" else {}
    return {"kind": kind, "at": pick([0.0, 0.4, 1.0]), "correlation": pick(("independent", "shared"))} | wanted


# what comes out


@dataclass(frozen=True)
class Failure:
    """What came out in the place of an answer or a refusal."""

    what: str
    message: str
    where: str
    through: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, str]:
        """Failures with one key count as one."""
        # what goes on and on is stopped anywhere
        return self.what, self.through[0] if self.what == TookTooLongError.__name__ else self.where


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """End what takes more processor time than that."""

    def too_long(*_: Any) -> None:
        raise TookTooLongError(f"more than {seconds:g} s of processor time")

    before = signal.signal(signal.SIGVTALRM, too_long)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def outcome(made: Arguments, call: str, arguments: Arguments) -> Failure | str:
    """Return what is wrong with an answer, or "answered", or "refused"."""
    try:
        scenario = sf.Scenario.from_mapping(made)
    except sf.ScenarioError:
        return "unread"
    except Exception as error:
        return _failure(error)
    try:
        with warnings.catch_warnings(), limited(LIMIT):
            warnings.simplefilter("error")
            numbers = CALLS[call](scenario, **arguments)
    except sf.StochfuseError:
        return "refused"
    except Exception as error:
        return _failure(error)
    for name, value in numbers.items():
        if isinstance(value, str):
            if re.search(r"\bnan\b", value):
                return Failure("nan", f"{name} shows nan", call)
        elif value is not None and not _sound(name, np.asarray(value, dtype=float)):
            return Failure("not finite", f"{name} of {call} is not finite", f"{call}: {name}")
    return "answered"


def _sound(name: str, values: np.ndarray) -> bool:
    # where nothing can be gained there is no share of the gain
    return bool(np.isfinite(values).all())


def _failure(error: Exception) -> Failure:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if PACKAGE in f.filename]
    through = [f"{f.filename.rpartition(PACKAGE)[2]}:{f.name}" for f in frames]
    message = re.sub(r"0x[0-9a-f]+", "0x…", str(error).splitlines()[0] if str(error) else "")
    return Failure(type(error).__name__, message, through[-1] if through else "outside", tuple(through))


def least(made: Arguments, call: str, arguments: Arguments, failure: Failure, seconds: float = 10.0) -> Arguments:
    """Return the scenario with all taken out that the failure does not need."""
    end, going_on = time.process_time() + seconds, True
    while going_on:
        going_on = False
        for less in random_scenarios.smaller(made):
            if time.process_time() > end or failure.what == "TookTooLongError":
                return made
            found = outcome(less, call, arguments)
            if isinstance(found, Failure) and found.key == failure.key:
                made, going_on = less, True
                break
    return made


def walk(
    seed: int, steps: int | None = None, seconds: float = np.inf
) -> tuple[dict[tuple[str, str], str], Counter[str]]:
    """Walk for so many scenarios or seconds; return the distinct failures, told, and how often what came out."""
    end, number = time.monotonic() + seconds, 0
    failures: dict[tuple[str, str], str] = {}
    counted: Counter[str] = Counter()
    while (steps is None or number < steps) and time.monotonic() < end:
        rng = np.random.default_rng([seed, number])
        made = random_scenarios.scenario(rng)
        for _ in range(CALLS_PER_SCENARIO):
            call = str(rng.choice(list(CALLS), p=WEIGHTS))
            arguments = drawn(rng, call, made)
            found = outcome(made, call, arguments)
            counted[found if isinstance(found, str) else "failed"] += 1
            if isinstance(found, Failure) and found.key not in failures:
                small = least(made, call, arguments, found)
                step = json.dumps({"scenario": small, "call": call, "arguments": arguments}, ensure_ascii=False)
                told = f"{found.what} in {found.where}: {found.message}\n({' > '.join(found.through)})\n"
                told += f"(seed {seed}, scenario {number})\n{step}"
                failures[found.key] = told
        number += 1
    return failures, counted


def check(failures: dict[tuple[str, str], str], counted: Counter[str]) -> None:
    total = counted.total()
    assert counted["unread"] < 0.1 * total, counted
    assert counted["answered"] > 0.3 * total, counted
    if failures:
        told = "\n\n".join(failures.values())
        pytest.fail(f"{len(failures)} distinct failures, {dict(counted)}:\n\n{told}", pytrace=False)


def test_a_short_walk():
    check(*walk(SEED, QUICK_STEPS))


@pytest.mark.slow
def test_a_long_walk():
    check(*walk(SEED + 1, seconds=SECONDS))


if __name__ == "__main__":
    given = json.loads(Path(sys.argv[1]).read_text() if len(sys.argv) > 1 else sys.stdin.read())
    print(CALLS[given["call"]](sf.Scenario.from_mapping(given["scenario"]), **given["arguments"]))
