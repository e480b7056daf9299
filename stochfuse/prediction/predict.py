"""The methods by the names that users ask for: one request, any method, a prediction.

    predict           one scenario against link probabilities
    predict_several   several quantities of it
    predict_many      many scenarios that differ in link probability and noises

All three make `Items` of a `System` and ask one method for their moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from math import log2
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from stochfuse.engines.events import events
from stochfuse.engines.precision import told
from stochfuse.errors import NoAnswerError, StochfuseError, TooManyError, UsageError, nearest
from stochfuse.kalman.checks import covariance_fault
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.method import RUNS, Averaged, Settings, ShownPart, faults_of, seconds, share
from stochfuse.prediction.quantities import QUANTITIES
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.swept import Swept, of_parts
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.over import Over
from stochfuse.scenario.over import over as read_over
from stochfuse.scenario.own_rules import estimator_named
from stochfuse.scenario.registry import (
    CONTROLS,
    CRITERIA,
    GENERAL,
    LFG,
    METHODS,
    MONTE_CARLO,
    NAIVE,
    NATURES,
    OPTIMAL,
    SIMPLIFIED,
)
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, ScenarioLike, link_rows, of_scenario
from stochfuse.scenario.system import Items, Noises, System

if TYPE_CHECKING:
    from stochfuse.prediction.interval import Posterior

COUNTS_AGAIN = "naive fusion counts shared information again and believes it; quantity actual is its true error"
CENTRE = (
    "what agents measure themselves reaches the centre of ITNS without a link, only agreement between them depends on "
    "the links: not to be compared with the optimum of what arrived"
)
NO_ERROR = "the scenario has no known initial error (initial.error): the bias is 0, the RMS error that of the noise"
HARDNESS = ("claimed", OPTIMAL, "actual", "consistency", "bias", "rms")
"""The moments of the actual error contain what is claimed; bias and rms have more to note."""
EASY, EASY_EXCHANGE = 2000, 12
"""Graphs, and binary logarithm of the outcomes of one exchange, up to which outcomes are enumerated unasked."""
PATIENT, EASILY = 5.0, 1 << 17
"""Seconds of a limit of time that go with so many graphs, generously, and with so many outcomes of all of them."""
WORTHLESS = 1e-3
"""Relative rounding beyond which it is no answer."""


Links = Sequence[float] | np.ndarray | float | LinkRows | None


@overload
def predict(
    scenario: ScenarioLike,
    link: Links = None,
    method: str | None = None,
    quantity: str = "claimed",
    *,
    steady: bool = False,
    interval: float | str | None = None,
    over: None = None,
    **settings: Any,
) -> Prediction: ...
@overload
def predict(
    scenario: ScenarioLike,
    link: Links = None,
    method: str | None = None,
    quantity: str = "claimed",
    *,
    steady: bool = False,
    over: Mapping[str, Any] | Over,
    **settings: Any,
) -> Swept: ...
@of_scenario
def predict(
    scenario: Scenario,
    link: Links = None,
    method: str | None = None,
    quantity: str = "claimed",
    *,
    steady: bool = False,
    interval: float | str | None = None,
    over: Mapping[str, Any] | Over | None = None,
    **settings: Any,
) -> Prediction | Swept:
    """Predict the expected fused covariance against link probability.

    Parameters
    ----------
    scenario : from `load_scenario`.
    link : link probabilities, one row of the result each; an array of shape (rows, agents, agents) gives a matrix µ_ij
        (receiver, sender) per row.  Default: the scenario's cases, else its link, else 0, 0.25, 0.5, 0.75 and 1.
    method : default: what the scenario asks for (report.method), else simplified; one of
        "simplified", thesis (50)–(54), approximate (mean field);
        "general", thesis (44)–(49), exact: every outcome, its common information found by the Local Fusion Graph;
        "naive", the same with naive fusion (42)/(43);
        "optimal", the best that any linear fusion could do with what arrived, by the contact chain;
        "monte-carlo", sampled.
    quantity : one of
        "claimed", the covariance that the fusion rule itself reports;
        "actual", the covariance that its error truly has;
        "optimal", the best that any linear fusion could do with what arrived, whatever the method;
        "consistency", actual / claimed, more than 1 where the rule is overconfident;
        "bias", what is left of the scenario's known initial error (initial.error);
        "rms", the root of the mean squared error, noise and bias.
    steady : also find what it tends to, see `stochfuse.prediction.limits`: a steady state, or a cycle.
    interval : a probability (0.95, "95%"): also what the log behind the scenario's links leaves unknown, see
        `Prediction.interval`.
    over : values of one or two numbers of the scenario by their paths, {"network.delay": [0, 1, 2]}: what is
        predicted, at the same links, of every combination.
    **settings : see `Settings`.

    Returns
    -------
    Prediction
        With `over` a `Swept`: rows are the values (and links), and errors name the value.

    Raises
    ------
    UsageError
        If the request does not fit the scenario.
    NoAnswerError
        If a steady state is asked for and there is none.

    Examples
    --------
    >>> import stochfuse as sf
    >>> p = sf.predict("thesis-transient", [0, 0.5])
    >>> p.values().round(3)[:, -1]
    array([39.775, 26.271])
    >>> sf.predict("thesis-transient", [0.5], over={"model.R": [50, 100]}).values().round(3)[:, -1]
    array([16.451, 26.271])
    """
    if over is not None:
        if interval is not None:
            raise UsageError("interval: expected one scenario, got values of a key (over)")
        return predict_several(scenario, link, method, [quantity], over=over, steady=steady, **settings)[0]
    if (
        method is None
        and scenario.method is None
        and settings.get("estimator") is not None
        and settings.get("precision") is None
        and quantity != registry.OPTIMAL
    ):
        return _by_any(scenario, link, quantity, {**settings, "interval": interval, "steady": steady})
    method, how = _asked(scenario, method, quantity, settings)
    rows = link_rows(scenario, link)
    if steady:
        _room("limits").period_of(scenario, rows)  # what has no steady state is refused before any work
    elif how.precision is not None and how.exact_first:
        exactly = _exactly(scenario, link, how, quantity)
        if exactly is not None:
            return exactly
    found = _averaged(scenario.system, Items(rows), method, how, quantity)
    if found.faults:
        item, why = min(found.faults.items())
        raise StochfuseError(f"method {method}: {why} (link probability {rows.means(scenario.network)[item]:g})")
    prediction = _prediction(scenario, rows, method, quantity, found)
    if interval is not None:
        prediction = replace(prediction, supported=_supported(scenario, link, interval, method, quantity, settings))
    if not steady:
        return prediction
    return replace(prediction, limit=_room("limits").limit(prediction, rows, how))


def _exactly(scenario: Scenario, link: Any, how: Settings, quantity: str) -> Prediction | None:
    """Predict by an exact engine what is asked to a precision, where that is easy within the time; else None."""
    more = 1.0 if how.at_most is None else max(1.0, seconds(how.at_most) / PATIENT)
    try:
        if how.estimator == OPTIMAL:
            found = predict(scenario, link, OPTIMAL, quantity, runs=2, workers=1)  # two tell that it would be a sample
        else:
            graphs = int(more * min(EASY, EASILY * 2.0 ** -exchange_of(scenario, link)))
            if not graphs:
                return None
            kept = {"estimator": how.estimator, "criterion": how.criterion, "max_graphs": graphs}
            found = predict(scenario, link, GENERAL, quantity, **kept)
    except (UsageError, NoAnswerError):
        return None
    if found.nature == "sampled":
        return None
    asked, reached = share(how.precision or 0.0), float(np.max(found.meta.get("relative_bound", 0.0)))
    if reached > asked or found.nature == "approximate":
        return None
    told = f"precision: nothing had to be drawn, method {found.method} takes this scenario: {found.nature}"
    meta = {**found.meta, "precision": {"asked": asked, "reached": reached}}
    return replace(found, notes=(told, *found.notes), meta=meta)


def exchange_of(scenario: Scenario, link: Any) -> float:
    """Binary logarithm of the outcomes of one exchange."""
    network = scenario.network
    return len(events(network, link_rows(scenario, link), 1)) * log2(len(network.delay) + 1)


def _supported(
    scenario: Scenario, link: Any, interval: float | str, method: str, quantity: str, settings: Mapping[str, Any]
) -> tuple[Posterior, Prediction]:
    """What the log supports of the links, and the prediction of that."""
    if link is not None:
        raise UsageError("interval: expected the scenario's own links, of which packets are counted, got others")
    room = _room("interval")
    found = room.posterior(scenario.network, room.level_of(interval), method)
    return found, predict(scenario, found.rows, method, quantity, **settings)


@of_scenario
def predict_several(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | LinkRows | None,
    method: str | None,
    quantities: Sequence[str],
    *,
    over: Mapping[str, Any] | Over | None = None,
    one_by_one: bool = False,
    **settings: Any,
) -> list[Any]:
    """Predict several quantities, with no more work than the hardest of them needs; see `predict`.

    Parameters
    ----------
    one_by_one : predict every point of `over` by itself even where all could be predicted together, which leaves no
        outcomes to take statistics of.
    """
    if over is not None:
        return _swept(read_over(scenario, over), link, method, quantities, one_by_one, settings)
    method = registry.OPTIMAL if method == registry.CHAIN else method or scenario.method
    if method is None and settings.get("precision") is not None:
        method = MONTE_CARLO
    if method is None and settings.get("estimator") is None:
        method = registry.SIMPLIFIED
    together, apart = _together(method or "", quantities)
    if method == registry.OPTIMAL and {"claimed", OPTIMAL} <= set(together):
        raise UsageError(
            "quantity: with method optimal the claimed covariance is the optimal one; expected one of them"
        )
    found = {}
    for some in (together, apart):
        if some:
            hardest = max(some, key=HARDNESS.index)
            shown = replace(settings.get("shown", ShownPart()), quantities=tuple(some))
            common = predict(scenario, link, method, hardest, **{**settings, "shown": shown})
            found |= {q: common if q == hardest else common.shown_as(q) for q in some}
    return [found[q] for q in quantities]


def _swept(
    over: Over, link: Any, method: str | None, quantities: Sequence[str], one_by_one: bool, settings: Mapping[str, Any]
) -> list[Swept]:
    over.check(link)
    together = None if one_by_one else _at_once(over, link, method, quantities, settings)
    if together is not None:
        return [Swept(over, (p,)) for p in together]
    found = of_parts(over, over.scenarios, lambda some: predict_several(some, link, method, quantities, **settings))
    return [Swept(over, parts) for parts in zip(*found, strict=True)]


def _at_once(
    over: Over, link: Any, method: str | None, quantities: Sequence[str], settings: Mapping[str, Any]
) -> list[Prediction] | None:
    """Predict all points as items of one system; None where that cannot be, or has an error to be found one by one."""
    first = over.scenarios[0]
    way = method or first.method or (registry.SIMPLIFIED if settings.get("estimator") is None else None)
    # the answer to a sample depends on the company it is drawn in
    sampled = way in (None, MONTE_CARLO) or settings.get("precision") is not None
    if sampled or settings.get("prune") or settings.get("steady"):
        return None
    items = over.items(link)
    if items is None or len(over.scenarios) == 1:
        return None
    given = {name: value for name, value in settings.items() if name != "steady"}
    try:
        found = predict_items(first, items, way, quantities, **given)
    except StochfuseError:
        return None
    return None if found.faults else found.predictions


@dataclass(frozen=True, eq=False, repr=False)
class Many(Result):
    """What became of many scenarios.

    Parameters
    ----------
    predictions : one per quantity, with the items in the place of link probabilities.
    natures : (items,) "exact", "approximate", "bound" or "sampled".
    faults : reason why an item has no answer, by its place.
    """

    predictions: list[Prediction]
    natures: np.ndarray
    faults: Mapping[int, str]


@of_scenario
def predict_many(
    scenario: Scenario,
    link: Any = None,
    Q: Any = None,
    R: Any = None,
    P: Any = None,
    method: str | None = None,
    quantity: str = "claimed",
    **settings: Any,
) -> Prediction:
    """Predict many scenarios that differ in link probability and noises only, in one call.

    Parameters
    ----------
    scenario : what they have in common.
    link : (items,) link probability of each, the same for all links and steps; default: the scenario's.
    Q : (items, d, d) process noise of each, as it enters the state, at all steps; or (items,) for multiples of the
        identity.  Default: the scenario's.
    R : (items, p, p) measurement noise of each, of every agent; or (items,).
    P : (items, d, d) covariance of the first estimates of each; or (items,).
    method, quantity, **settings : as for `predict`.

    Returns
    -------
    Prediction
        With the items in the place of link probabilities; not-a-number for an item that has no answer, and why in
        meta["faults"].

    Raises
    ------
    UsageError
        If an array does not fit, or the method does not take the scenario.

    Examples
    --------
    >>> import stochfuse as sf
    >>> p = sf.predict_many("thesis-transient", link=[0.2, 0.8], R=[100.0, 400.0])
    >>> p.values()[:, -1].round(3)
    array([33.287, 50.832])
    """
    items = items_of(scenario, link, Noises(Q, R, P))
    found = predict_items(scenario, items, method, [quantity], **settings)
    (prediction,) = found.predictions
    without = np.zeros(len(items), dtype=bool)
    without[list(found.faults)] = True

    def blank(M: np.ndarray) -> np.ndarray:
        return np.where(without.reshape(-1, *(1,) * (M.ndim - 1)), np.nan, M)

    moments = prediction.moments.map(blank) if found.faults else prediction.moments
    meta = {**prediction.meta, "faults": dict(found.faults)}
    return replace(prediction, moments=moments, meta=meta, noises=items.noises)


def predict_items(
    scenario: Scenario, items: Items, method: str | None, quantities: Sequence[str], **settings: Any
) -> Many:
    """Predict several quantities of many items, with no more work than the hardest of them needs.

    Raises
    ------
    UsageError, NoAnswerError
        As `predict`, if that would raise it for one item; a NoAnswerError names such items where they are known.
    """
    predictions, faults, natures = {}, {}, []
    for some in filter(None, _together(method or scenario.method or registry.SIMPLIFIED, quantities)):
        hardest = max(some, key=HARDNESS.index)
        way, how = _asked(scenario, method, hardest, settings)
        found = _averaged(scenario.system, items, way, how, hardest)
        first = _prediction(scenario, items.links, way, hardest, found)
        predictions |= {q: first if q == hardest else first.shown_as(q) for q in some}
        lost = {int(i): told(found.rounding[i]) for i in np.flatnonzero(found.rounding > WORTHLESS)}
        # the mean field looks for faults itself, at a fraction of the cost
        wrong = {} if way == SIMPLIFIED else faults_of(found.moments)
        faults |= {**wrong, **lost, **found.faults}
        natures.append(found.natures)
    worst = natures[0]
    for nature in NATURES if len(natures) > 1 else ():
        worst = np.where(np.any([some == nature for some in natures], axis=0), nature, worst)
    return Many([predictions[q] for q in quantities], worst, faults)


def items_of(scenario: Scenario, link: Any, noises: Noises) -> Items:
    """Return items of link probabilities and noises, checked.

    Raises
    ------
    UsageError
        If they do not fit the scenario, or each other.
    """
    d, widths = scenario.model.dimension, {s.H.shape[-2] for s in scenario.sensors}
    if noises.R is not None and len(scenario.sensors) > 1:
        raise UsageError("R: expected like sensors to have a noise of the item's own, got unlike ones ([[agent]] H, R)")
    checked = Noises(
        _stack("Q", noises.Q, d), _stack("R", noises.R, max(widths), definite=True), _stack("P", noises.P0, d)
    )
    sizes = {name: len(M) for name, M in zip(("Q", "R", "P"), checked, strict=True) if M is not None}
    if link is not None or not sizes:
        rows = link_rows(scenario, link)
    else:
        rows = link_rows(scenario)
        if len(rows.link) != 1:
            raise UsageError("link: expected one link probability per item, since the scenario has none of its own")
    items = max([len(rows.link) if link is not None else 1, *sizes.values()])
    if len(rows.link) == 1 and items > 1:
        rows = rows.take(np.zeros(items, dtype=int))
    for name, size in {"link": len(rows.link), **sizes}.items():
        if size != items:
            raise UsageError(f"{name}: expected {items} items, as many as the other arrays have, got {size}")
    return Items(rows, checked)


def _stack(name: str, given: Any, n: int, *, definite: bool = False) -> np.ndarray | None:
    """Covariances (items, n, n), or numbers (items,) that multiply the identity, checked."""
    if given is None:
        return None
    expected = f"an array of shape (items, {n}, {n}), or (items,)"
    try:
        M = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"{name}: expected {expected}, got {type(given).__name__}") from None
    M = M[:, None, None] * np.eye(n) if M.ndim == 1 else M
    if M.ndim != 3 or M.shape[1:] != (n, n):
        raise UsageError(f"{name}: expected {expected}, got {np.shape(given)}")
    fault = covariance_fault(M, definite=definite)
    if fault is not None:
        raise UsageError(f"{name}: expected covariances, got {fault}")
    return M


def _together(method: str, quantities: Sequence[str]) -> tuple[list[str], list[str]]:
    """Quantities that one calculation gives together, and those that need another."""
    apart = [q for q in quantities if q == registry.OPTIMAL and method != registry.OPTIMAL]
    return [q for q in quantities if q not in apart], apart


def _asked(scenario: Scenario, method: str | None, quantity: str, settings: Mapping[str, Any]) -> tuple[str, Settings]:
    """Method and settings of a request, checked."""
    precise = settings.get("precision") is not None
    method = method or scenario.method or (MONTE_CARLO if precise else registry.SIMPLIFIED)
    choose("method", method, METHODS)
    choose("quantity", quantity, QUANTITIES)
    if method == registry.CHAIN:
        elsewhere = capabilities.not_averaged(settings.get("estimator") or registry.OPTIMAL, method)
        if elsewhere is not None:
            raise UsageError(f"method {method}: {elsewhere}")
        method = registry.OPTIMAL
    unknown = set(settings) - set(Settings.__dataclass_fields__)
    if unknown:
        wrong, known = sorted(unknown)[0], sorted(Settings.__dataclass_fields__)
        near = nearest(wrong, known)
        raise TypeError(f"predict() got an unexpected keyword argument '{wrong}'{near}; expected {', '.join(known)}")
    how = Settings(**{"estimator": scenario.estimator or LFG, "runs": scenario.runs or RUNS, **settings})
    estimator = estimator_named(how.estimator)
    choose("criterion", how.criterion, CRITERIA)
    choose("control", how.control, CONTROLS)
    _check_precision(method, how, settings)
    metrics = how.shown.metrics or (metric_of(scenario.metric or "trace", scenario.model),)
    shown = replace(how.shown, metrics=metrics, quantities=how.shown.quantities or (quantity,))
    if quantity == OPTIMAL:
        method, estimator = (MONTE_CARLO if method == MONTE_CARLO else OPTIMAL), OPTIMAL
    return method, replace(how, estimator=NAIVE if method == NAIVE else estimator, shown=shown)


def _check_precision(method: str, how: Settings, given: Mapping[str, Any]) -> None:
    """Raise UsageError if a precision, or a limit of time, is none, or goes with nothing that is sampled."""
    if how.at_most is not None:
        seconds(how.at_most)
        if how.precision is None:
            raise UsageError(f"at-most: expected a precision to go with it, got {how.at_most} alone")
    if given.get("control") is not None and method not in (MONTE_CARLO, OPTIMAL):
        raise UsageError(f"control: expected method {MONTE_CARLO}, whose values are sampled, got {method}")
    if how.precision is not None:
        share(how.precision)
        if method != MONTE_CARLO:
            raise UsageError(f"precision: expected method {MONTE_CARLO}, whose values are sampled, got {method}")
        if given.get("runs") is not None:
            raise UsageError(f"runs: expected without precision, which says how many it takes, got {how.runs}")


def _by_any(scenario: Scenario, link: Any, quantity: str, settings: Mapping[str, Any]) -> Prediction:
    """Predict an estimator by the exact engine that takes it, else by sampling, and say which."""
    name = estimator_named(settings["estimator"])
    settings = {**settings, "estimator": name}
    features = capabilities.features_of(scenario.system, link_rows(scenario, link))
    engines = capabilities.engine_for(name, features) or [registry.GENERAL]
    for engine in engines:
        given = {n: v for n, v in settings.items() if n != "control" or engine == MONTE_CARLO}
        try:
            found = predict(scenario, link, engine, quantity, **given)
        except TooManyError:
            if engine == engines[-1]:
                raise
        else:
            return replace(found, notes=(*found.notes, f"estimator {name} is averaged by --method {engine}"))
    raise TypeError("some engine was tried")


def _averaged(system: System, items: Items, method: str, how: Settings, quantity: str) -> Averaged:
    errors = quantity not in ("claimed", OPTIMAL)
    engine = registry.engine_of(method)
    capabilities.require(system, items.links, capabilities.averaged_by(engine.name) or how.estimator, engine.name)
    found = _room(engine.file).averaged(system, items, how, errors)
    if method == SIMPLIFIED and errors:
        found = _room("states").with_errors(system, items, found)
    first = [COUNTS_AGAIN] if how.estimator == NAIVE and method in (GENERAL, NAIVE) and not errors else []
    said = []
    if found.estimator == "itns" and not system.own:
        said.append(CENTRE)
    if quantity in ("bias", "rms") and system.error is None:
        said.append(NO_ERROR)
    return found._replace(notes=(*first, *found.notes, *said))


def _room(file: str) -> Any:
    """A file of this room, imported when it is asked for: without the others a `predict` starts a third sooner."""
    return import_module(f"stochfuse.prediction.{file}")


def _prediction(scenario: Scenario, rows: LinkRows, method: str, quantity: str, found: Averaged) -> Prediction:
    return Prediction(
        scenario=scenario,
        method=method,
        quantity=OPTIMAL if method == OPTIMAL and quantity == "claimed" else quantity,
        stage="posterior",
        nature=max(set(found.natures.tolist()), key=NATURES.index),
        link=rows.means(scenario.network),
        cases=rows.names,
        steps=np.arange(1, scenario.network.steps + 1),
        moments=found.moments,
        group_of=found.group_of,
        forms=found.forms,
        notes=found.notes,
        estimator=found.estimator,
        outcomes=found.outcomes,
        sampled=found.sampled,
        meta=found.meta,
    )


def choose(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise UsageError if a value is not one of the choices."""
    if value not in choices:
        raise UsageError(f"{name}: expected one of {', '.join(choices)}, got '{value}'{nearest(value, choices)}")
