"""`stochfuse predict`: expected covariance against link probability."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from stochfuse.cli.options import (
    PLACES,
    RARE,
    SHOWN,
    AtOption,
    Averaging,
    Changes,
    EstimatorOption,
    MethodOption,
    MetricOption,
    OverOption,
    QuantityOption,
    Reported,
    ScenarioArgument,
    option,
)
from stochfuse.cli.values import quantity_names, refuse, steps_at, tell, whose
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import GENERAL, MONTE_CARLO, NAIVE, SIMPLIFIED, STATE

if TYPE_CHECKING:
    from stochfuse.report.predictions import PredictionView

EACH = "each"
"""All agents beside each other."""
EXAMPLES = (
    "stochfuse predict --agents 50 --link 0:1:0.25 --steps 4",
    "stochfuse predict --method general --quantity claimed,actual --steps 3",
    "stochfuse predict --over model.R=50:200:25 --link 0.5",
)


def predict(
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    over: OverOption = None,
    quantity: QuantityOption = "claimed",
    measurements: Annotated[
        str | None,
        option("With --quantity state: CSV, Parquet or -: step, agent, z1, z2, …", SHOWN + RARE, metavar="FILE"),
    ] = None,
    metric: MetricOption = None,
    statistic: Annotated[
        str,
        option(
            "Over the outcomes (general): variance, std, quantile:P, at-most:LIMIT, derivative; default: mean.",
            SHOWN + RARE,
            metavar="NAME",
        ),
    ] = "mean",
    agent: Annotated[
        str | None,
        option("Whose: mean (default), worst, best, a number, a name, each.", SHOWN, metavar="N"),
    ] = None,
    at: AtOption = None,
    normalise: Annotated[bool, option("Relative to link probability 0.", SHOWN + RARE, "--normalise")] = False,
    steady: Annotated[
        bool, option("Add the steady state or cycle: proved bounds, or sampled after a burn-in.", SHOWN, "--steady")
    ] = False,
    interval: Annotated[
        str | None, option("Also the interval that the log behind the links supports: 95%.", SHOWN, metavar="P%")
    ] = None,
    method: MethodOption = None,
    estimator: EstimatorOption = None,
    averaging: Averaging = Averaging(),
    to: Reported = Reported(),
) -> None:
    """Tabulate the expected fused covariance against link probability.

    Without a scenario: the thesis' transient one. Options override it.
    """
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.prediction.method import ShownPart
    from stochfuse.prediction.predict import predict_several as run
    from stochfuse.prediction.quantities import check
    from stochfuse.report.predictions import PredictionView, each_report, report

    to.check(scenario, measurements)
    several = {"--over": over, "--normalise": normalise, "--statistic": None if statistic == "mean" else statistic}
    if quantity == STATE:
        unknown = {"--metric": metric, "--steady": steady, "--interval": interval}
        refuse(several | unknown, f"without --quantity {STATE}")
        way = method or (SIMPLIFIED if estimator is None else GENERAL)
        settings = averaging.settings([way], estimator=estimator)
        _states(scenario, changes, measurements, StatesAsked(way, agent, at), settings, to)
        return
    if measurements is not None:
        raise UsageError(f"--measurements: expected --quantity {STATE} to go with it, got {quantity}")
    quantities = quantity_names(quantity)
    given, links, swept = changes.swept(scenario, over, to.kind)
    each = agent == EACH
    chosen_agent, steps = EACH if each else whose(agent, given), steps_at(at, given)
    if each and len(quantities) > 1:
        raise UsageError(f"--agent {EACH}: expected one --quantity, got {quantity}")
    if each and swept and len({s.network.agents for s in swept.scenarios}) > 1:
        raise UsageError(f"--agent {EACH}: expected as many agents in every row, got --over {over[0] if over else ''}")
    chosen = metric_of(metric or given.metric or "trace", given.model)
    for name in quantities:
        check(name, chosen)
    # an estimator without a method picks the exact engine that takes it, else sampling
    unsaid = method is None and given.method is None
    free = unsaid and estimator is not None and averaging.precision is None
    otherwise = GENERAL if free else SIMPLIFIED if averaging.precision is None else MONTE_CARLO
    way = (given.method or otherwise) if method is None else method
    if statistic != "mean":
        if way not in (GENERAL, NAIVE):
            raise UsageError(f"--statistic {statistic}: expected --method general or naive, got {way}")
        if normalise:
            raise UsageError("--normalise: expected --statistic mean")
        from stochfuse.prediction.general import check_statistic

        for name in quantities:
            check_statistic(statistic, name, chosen)
    if interval is not None:
        refuse(several, "without --interval")
    asked_for: dict[str, Any] = {"steady": steady, "over": swept} | ({} if interval is None else {"interval": interval})
    # a steady state may have to be sampled
    settings = asked_for | averaging.settings([way, *[MONTE_CARLO] * steady], estimator=estimator)
    settings["shown"] = ShownPart(metrics=(chosen,), agent=chosen_agent, steps=steps)
    if swept and statistic != "mean":
        settings["one_by_one"] = True  # whose outcomes are kept
    if normalise and swept and any(key.name == PLACES["link"] for key in swept.keys):
        raise UsageError("--normalise: expected without --over network.link, since it is to link probability 0")
    asked = None if free else way
    found = run(given, links, asked, quantities, **settings)
    at_zero = run(given, [0.0], asked, quantities, **settings) if normalise else [None] * len(found)
    views = tuple(
        PredictionView(p, chosen, "mean" if each else chosen_agent, baseline, to.digits, statistic, steps)
        for p, baseline in zip(found, at_zero, strict=True)
    )
    for view in views:
        view.values()  # a request that cannot be met should say so before notes and figures
    said, shown = tell(_said(views)), each_report(views[0]) if each else report(views)
    to.write(shown)
    to.send(shown, given.to_mapping(), said)


class StatesAsked(NamedTuple):
    """How expected states are asked for."""

    method: str
    agent: str | None
    at: str | None


def _states(
    scenario: str,
    changes: Changes,
    measurements: str | None,
    asked: StatesAsked,
    settings: dict[str, Any],
    to: Reported,
) -> None:
    """Show the expected state over what arrives, given one record of measurements."""
    from stochfuse.data.records import read_records
    from stochfuse.prediction.expected_states import expected_states
    from stochfuse.report.states import StatesView, states_report

    if measurements is None:
        raise UsageError(f"--quantity {STATE}: expected --measurements FILE to go with it")
    if scenario == measurements == "-":
        raise UsageError("SCENARIO and --measurements: expected at most one of them on standard input, got - for both")
    given, links = changes.of(scenario)
    records = read_records(given, measurements)
    if asked.agent in ("worst", "best", EACH):
        raise UsageError(f"--agent: expected mean or a number with --quantity {STATE}, got {asked.agent}")
    agent, steps = whose(asked.agent, records.scenario), steps_at(asked.at, records.scenario)
    found = expected_states(records.scenario, records.one_run(), links, asked.method, **settings)
    said = tell(f"note: {note}" for note in records.notes)
    shown = states_report(StatesView(found, agent, steps, to.digits))
    to.write(shown)
    to.send(shown, records.scenario.to_mapping(), said)


def _said(views: tuple[PredictionView, ...]) -> Iterator[str]:
    """Notes and warnings beside a prediction."""
    first = views[0]
    if first.sampled and first.agent in ("worst", "best") and not first.prediction.alike:
        yield f"note: which agent is the {first.agent} is judged by the same sample: the value is biased"
    for view in views:
        yield from (f"note: {note}" for note in view.prediction.notes)
    if first.metric.mixed and not first.baseline:
        model = first.prediction.scenario.model
        names = ", ".join(f"{n} [{u}]" for n, u in zip(model.states, model.units, strict=True))
        yield f"note: {first.metric.name} adds up different units ({names}); see --metric"
    warning = next(filter(None, (view.overconfidence() for view in views)), None)
    if warning is not None:
        yield f"warning: {warning}"
    for note in (note for view in views for limit in view.limits for note in limit.notes):
        yield f"note: {note}"
