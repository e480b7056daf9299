"""What takes what: estimator × engine × feature of a scenario, with the reason where not.

`RULES` is the table, written by rule: whom it concerns, which features it does not take, and why.  It decides every
refusal (`require`), `stochfuse methods --matrix` prints it, and the tests walk it: each feature alone with each
estimator and engine, and each pair of features.  Limits of size (agents, outcomes, paths) are known by the engines
alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.scenario import registry
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.own_rules import OwnRule
from stochfuse.scenario.registry import BROADCAST_PRIOR, CHAIN, ENGINES, ESTIMATORS, GENERAL, MONTE_CARLO, SIMPLIFIED
from stochfuse.scenario.system import System

SINGULAR = 1e-14
"""Smallest eigenvalue of a covariance, scaled to unit variances, that is none."""


class Feature(NamedTuple):
    """Something that a scenario may have.

    Parameters
    ----------
    name : one or two words.
    key : where it stands in a scenario file.
    has : whether a system, asked about some rows of links, has it.
    """

    name: str
    key: str
    has: Callable[[System, LinkRows], bool]


class Rule(NamedTuple):
    """Features that somebody does not take.

    Parameters
    ----------
    who : how the refusal begins.
    concerns : whether an estimator averaged by an engine is meant.
    features : names of the features.
    why : what was expected, and what came.
    beside : a feature beside which alone these are not taken; empty: always.
    """

    who: str
    concerns: Callable[[str, str], bool]
    features: tuple[str, ...]
    why: str
    beside: str = ""


def _blind(system: System) -> list[bool]:
    """Whether each kind of sensor never measures anything."""
    return [not sensor.H[1:].any() for sensor in system.sensors]


def _at_times(system: System) -> bool:
    seen = [sensor.H[1:].any(axis=(-2, -1)) for sensor in system.sensors]
    return any(each.any() and not each.all() for each in seen)


def _unlike(system: System) -> bool:
    seeing = [s for s, blind in zip(system.sensors, _blind(system), strict=True) if not blind]
    return any(s.H.shape != seeing[0].H.shape or (s.H != seeing[0].H).any() for s in seeing[1:])


def _singular(P: np.ndarray) -> bool:
    sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    sd = np.where(sd > 0, sd, 1.0)
    return bool(np.linalg.eigvalsh(P / (sd[..., :, None] * sd[..., None, :])).min() <= SINGULAR)


def _lost(system: System) -> bool:
    """Whether some direction of the state is known exactly after a prediction, whatever was known before."""
    F, Q = system.model.F[1:], system.model.Q[1:]
    return len(F) > 0 and _singular(F @ np.swapaxes(F, -1, -2) + Q)


def _varies(system: System) -> bool:
    return system.model.varies or any(sensor.varies for sensor in system.sensors)


def _unequal(system: System, links: LinkRows) -> bool:
    return not links.uniform and system.network.hears is None


FEATURES = (
    Feature("no-sensor", "[[agent]] sensor = false", lambda s, _: any(_blind(s)[k] for k in s.sensor_of)),
    Feature(
        "sensor-pauses",
        "[[agent]] H of zeros in some steps, or a sensor's period, range or field_of_view",
        lambda s, _: _at_times(s),
    ),
    Feature("detection", "[[agent]] sensor.detection", lambda s, _: s.detects is not None),
    Feature("unlike-noises", "[[agent]] R", lambda s, _: len(s.sensors) > 1 and not _unlike(s)),
    Feature("unlike-sensors", "[[agent]] H", lambda s, _: _unlike(s)),
    Feature(
        "matrices-per-step",
        "model.F, Q, H, R per step, model.step per step, or a sensor whose H follows the nominal path",
        lambda s, _: _varies(s),
    ),
    Feature("unequal-links", "network.link as a matrix, network.radio", _unequal),
    Feature("links-per-step", "network.link per step, network.radio with paths", lambda s, r: r.varies),
    Feature("masks", "network.hears", lambda s, _: s.network.hears is not None),
    Feature("cases", "[[network.case]]", lambda s, r: r.names is not None),
    Feature("delay", "network.delay", lambda s, _: s.network.delay != (1.0,)),
    Feature("unequal-delays", "network.delay as a matrix", lambda s, _: s.network.delays is not None),
    Feature("bursts", "network.burst", lambda s, r: r.bursts is not None),
    Feature("shared-start", 'initial.correlation = "shared"', lambda s, _: s.shared),
    Feature("initial-error", "initial.error", lambda s, _: s.error is not None),
    Feature("correlated-noises", "noise.correlation", lambda s, _: s.noise is not None),
    Feature("disturbance", "noise.disturbance", lambda s, _: s.noise is not None and s.noise.disturbance is not None),
    Feature("several-states", "model.F of several states", lambda s, _: s.dimension > 1),
    Feature("singular-P", "initial.P", lambda s, _: not s.filters and _singular(s.P0)),
    Feature(
        "singular-Q", "model.Q", lambda s, _: not s.filters and _singular(s.model.Q[1:] if s.steps > 1 else s.model.Q)
    ),
    Feature("singular-F", "model.F", lambda s, _: bool((np.abs(np.linalg.det(s.model.F[-1:])) < SINGULAR).any())),
    Feature("singular-prediction", "model.F and model.Q", lambda s, _: not s.filters and _lost(s)),
    Feature("own-states", "model.own", lambda s, _: s.own),
    Feature("own-filters", "[[agent]] F, Q, P, M, s", lambda s, _: bool(s.filters) and not s.own),
)

_NO_DELAY = "expected messages without delay, got network.delay"
_ONE_STATE = "expected agents that track one state by one model, got agents with {what}"
_OWN = "states of their own (model.own)"
_INDEPENDENT = "expected independent measurement noises, got [noise] with a correlation or a disturbance"
_OPTIMUM = "the optimum"


def _of(*names: str) -> Callable[[str, str], bool]:
    return lambda estimator, engine: estimator in names and engine in (GENERAL, MONTE_CARLO)


def _all_but(flag: str) -> Callable[[str, str], bool]:
    """Estimators whose entry does not have a flag, where outcomes are gone through or drawn."""
    return lambda estimator, engine: (
        engine in (GENERAL, MONTE_CARLO) and not getattr(registry.estimator(estimator), flag)
    )


def _by(*engines: str) -> Callable[[str, str], bool]:
    return lambda estimator, engine: engine in engines


_SUMS = [e.name for e in registry.ESTIMATOR if e.sums]
_WEIGHING = [e.name for e in registry.ESTIMATOR if e.weighs]
_EQUIVALENT = [e.name for e in registry.ESTIMATOR if e.place[0] == "equivalent"]
_BLENDING = [e.name for e in registry.ESTIMATOR if e.place[0] == "blender"]
_PROMPT = [e.name for e in registry.ESTIMATOR if not e.sums and not e.weighs]
RULES = (
    Rule(
        "method simplified",
        _by(SIMPLIFIED),
        ("delay",),
        "it is derived without delay (thesis 4.2): expected network.delay = 0",
    ),
    Rule(
        "method simplified",
        _by(SIMPLIFIED),
        ("bursts",),
        "it does not take bursty links (network.burst): it averages after every step and forgets which links were bad",
    ),
    Rule("method simplified", _by(SIMPLIFIED), ("own-states",), _ONE_STATE.format(what=_OWN)),
    Rule("method simplified", _by(SIMPLIFIED), ("own-filters",), _ONE_STATE.format(what="filters of their own")),
    Rule("method simplified", _by(SIMPLIFIED), ("correlated-noises", "disturbance"), _INDEPENDENT),
    Rule(_OPTIMUM, _by(CHAIN), ("own-states",), _ONE_STATE.format(what=_OWN)),
    Rule(_OPTIMUM, _by(CHAIN), ("own-filters",), _ONE_STATE.format(what="filters of their own")),
    Rule(_OPTIMUM, _by(CHAIN), ("correlated-noises", "disturbance"), _INDEPENDENT),
    Rule(
        "estimator {estimator}",
        _all_but("own_states"),
        ("own-states",),
        "expected agents that track one state, got states of their own (model.own)",
    ),
    Rule(
        "estimator {estimator}",
        _all_but("own_filters"),
        ("own-filters",),
        "expected one model for all agents, got parallel filters ([[agent]] F, Q, P, M or s)",
    ),
    Rule("estimator {estimator}", _of(registry.OPTIMAL), ("correlated-noises", "disturbance"), _INDEPENDENT),
    Rule("estimator {estimator}", _of(*_PROMPT), ("delay",), _NO_DELAY),
    Rule("estimator {estimator}", _of(*_WEIGHING), ("delay",), _NO_DELAY + " beside model.own", beside="own-states"),
    Rule(
        "estimator {estimator}",
        _of(*_BLENDING),
        ("detection",),
        "the joint covariance of all filters is known beforehand only if sensors never miss: expected "
        "sensor.detection = 1",
    ),
    Rule(
        "estimator {estimator}",
        _of(*_SUMS),
        ("singular-P",),
        "initial.P: expected an invertible covariance for the Local Fusion Graph, got a singular one",
    ),
    Rule(
        "estimator {estimator}",
        _of(*_SUMS, *_WEIGHING),
        ("singular-prediction",),
        "expected an invertible model.F, or a model.Q that fills what it leaves out, got a singular prediction",
    ),
    Rule(
        "estimator {estimator}",
        _of(*_WEIGHING),
        ("singular-P",),
        "intersections expect estimates that are known exactly in no direction (initial.P positive definite), got a "
        "singular covariance",
    ),
    Rule(
        "estimator {estimator}",
        _of(*_EQUIVALENT),
        ("unlike-sensors", "sensor-pauses"),
        "estimators of measurements: expected sensors that measure the same (one H), got another H",
    ),
)
"""The table: what is not here is taken."""
ENDING = ("links-per-step", "matrices-per-step")
ENDLESS = "a model, sensors and links that do not vary with the step, or sensors with a period"
"""Features that have no steady state, but that of sensors with periods, and what is expected in their place."""


def pairs(own: Sequence[OwnRule] = ()) -> list[tuple[str, str]]:
    """Estimators, and rules of the user's own, with the engines that average them."""
    both = [(estimator, engine) for estimator in (*ESTIMATORS, *own) for engine in (GENERAL, MONTE_CARLO)]
    return [(BROADCAST_PRIOR, SIMPLIFIED), (registry.OPTIMAL, CHAIN), *both]


def _rules(estimator: str) -> tuple[Rule, ...]:
    """The table, and what a rule of the user's own says of itself."""
    if not isinstance(estimator, OwnRule):
        return RULES
    known = [feature.name for feature in FEATURES]
    for name in estimator.refuses:
        if name not in known:
            raise UsageError(f"estimator {estimator}: refuses: expected features of {', '.join(known)}, got '{name}'")
    own = [Rule("estimator {estimator}", lambda *_: True, (name,), why) for name, why in estimator.refuses.items()]
    return (*RULES, *own)


def averaged_by(engine: str) -> str | None:
    """Return the one estimator that an engine averages, or None if it averages any."""
    return {SIMPLIFIED: BROADCAST_PRIOR, CHAIN: registry.OPTIMAL}.get(engine)


def not_averaged(estimator: str, engine: str) -> str | None:
    """Why an engine does not average an estimator, or None if it does."""
    known = pairs([estimator] if isinstance(estimator, OwnRule) else [])
    if (estimator, engine) in known:
        return None
    others = [e for who, e in known if who == estimator]
    averages = "the broadcast prior" if engine == SIMPLIFIED else "the optimum" if engine == CHAIN else "estimators"
    return f"{engine} averages {averages} alone; {' or '.join(others)} takes {estimator}"


def reason(estimator: str, engine: str, feature: str) -> str | None:
    """Why an estimator averaged by an engine does not take a feature, and what does; None if it is taken."""
    elsewhere = not_averaged(estimator, engine)
    if elsewhere is not None:
        return elsewhere
    for rule in _rules(estimator):
        if feature in rule.features and not rule.beside and rule.concerns(estimator, engine):
            return f"{rule.who.format(estimator=estimator)}: {rule.why}; {_instead(estimator, feature)}"
    return None


def _instead(estimator: str, feature: str) -> str:
    """What takes a feature: another engine for the same estimator, else other estimators."""
    takes = [pair for pair in pairs() if not any(feature in r.features and r.concerns(*pair) for r in RULES)]
    engines = [engine for who, engine in takes if who == estimator]
    if engines:
        return f"{' or '.join(engines)} takes {feature}"
    names = list(dict.fromkeys(who for who, _ in takes))
    return f"{', '.join(names)} take{'s' * (len(names) == 1)} {feature}"


def features_of(system: System, links: LinkRows) -> list[str]:
    """Names of the features that a system, asked about some rows of links, has."""
    return [feature.name for feature in FEATURES if feature.has(system, links)]


def require(system: System, links: LinkRows, estimator: str, engine: str) -> None:
    """Raise UsageError if an estimator averaged by an engine does not take what a system has.

    Parameters
    ----------
    links : rows of links; estimators do not look at them.
    """
    has = {feature.name: feature.has for feature in FEATURES}
    for rule in _rules(estimator):
        if not rule.concerns(estimator, engine) or (rule.beside and not has[rule.beside](system, links)):
            continue
        for name in rule.features:
            if has[name](system, links):
                instead = "" if rule.beside else f"; {_instead(estimator, name)}"
                raise UsageError(f"{rule.who.format(estimator=estimator)}: {rule.why}{instead}")


def takes(system: System, links: LinkRows, estimator: str, engine: str) -> bool:
    """Whether an estimator averaged by an engine takes what a system has."""
    try:
        require(system, links, estimator, engine)
    except UsageError:
        return False
    return True


def require_endless(system: System, links: LinkRows, *, periodic: bool) -> None:
    """Raise UsageError if what is given ends with its steps, so that there is no steady state to ask for.

    Parameters
    ----------
    periodic : whether what varies does so with a period, as far as that can be told.
    """
    goes_on = ("matrices-per-step",) if periodic else ()
    for feature in FEATURES:
        if feature.name in ENDING and feature.name not in goes_on and feature.has(system, links):
            raise UsageError(f"a steady state needs {ENDLESS}; got {feature.key}")


LATE, GAPS, BY_NAME = "messages that came late", "measurements that are missing", "sensors by name"
"""What a record may have that its scenario need not have, or that counts only on data."""
_AS_FEATURE = {LATE: "delay", GAPS: "detection"}
_KNOWN_BEFORE = {"blender": "the joint covariance of all filters", "equivalent": "the equivalent measurement"}


def not_on_data(estimator: str, has: Sequence[str]) -> str | None:
    """Why an estimator does not run on a record that has some of `LATE`, `GAPS`, `BY_NAME`; None if it does."""
    for what in has:
        if what in _AS_FEATURE:
            why = reason(estimator, GENERAL, _AS_FEATURE[what])
            if why is not None:
                return f"the record has {what}: {why}"
        known = _KNOWN_BEFORE.get(registry.estimator(estimator).place[0])
        if what == BY_NAME and known is not None:
            takes = [e.name for e in registry.ESTIMATOR if e.place[0] not in _KNOWN_BEFORE and not e.own_states]
            return (
                f"estimator {estimator}: {known} is known beforehand only of linear sensors; expected sensors of H and "
                f"R where it runs on data, got {what}; {', '.join(takes)} take them"
            )
    return None


def not_live(estimator: str, system: System) -> str | None:
    """Why an estimator is no live agent's in such a system; None if it is."""
    needs = registry.estimator(estimator).not_live
    if not needs and system.own:
        needs = "what agents with states of their own (model.own) measured of each other"
    if not needs:
        return None
    takes = ", ".join(e.name for e in registry.ESTIMATOR if not e.not_live)
    return (
        f"estimator {estimator}: a live agent fuses estimates that it hears; expected one of {takes}, of one state; "
        f"got one that needs {needs}"
    )


def matrix(own: Sequence[OwnRule] = ()) -> dict[str, dict[str, dict[str, bool | str]]]:
    """Return the whole table: estimator, engine, feature → True or the reason.

    Parameters
    ----------
    own : rules of the user's, shown too.
    """
    names = [feature.name for feature in FEATURES]
    return {
        estimator: {engine: {name: reason(estimator, engine, name) or True for name in names} for engine in ENGINES}
        for estimator in (*ESTIMATORS, *own, BROADCAST_PRIOR)
    }


def engine_for(estimator: str, features: Sequence[str]) -> list[str]:
    """Engines that take an estimator with some features, the exact ones first."""
    exact_first = (CHAIN, GENERAL, SIMPLIFIED, MONTE_CARLO)
    return [e for e in exact_first if all(reason(estimator, e, f) is None for f in features or [""])]
