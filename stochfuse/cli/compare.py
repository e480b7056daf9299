"""`stochfuse compare`: methods side by side with the differences, or estimators side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

from stochfuse.cli.options import (
    RARE,
    SHOWN,
    WORK,
    AgentOption,
    AtOption,
    Averaging,
    Changes,
    MetricOption,
    OverOption,
    Reported,
    ScenarioArgument,
    completed,
    option,
)
from stochfuse.cli.values import named, quantity_names, refuse, steps_at, tell, whose
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import ESTIMATORS, GENERAL, INTERSECTIONS, METHODS, MONTE_CARLO, NAIVE, SIMPLIFIED

if TYPE_CHECKING:
    from stochfuse.prediction.method import ShownPart
    from stochfuse.report.table import Report
    from stochfuse.scenario.scenario import Scenario

ALL = "all"
DEFAULT = (GENERAL, SIMPLIFIED, NAIVE, MONTE_CARLO)
EXAMPLES = (
    "stochfuse compare --methods general,simplified --link 0.5 --steps 4 --relative",
    "stochfuse compare --estimator naive,split-ci,optimal --link 0.2,0.8 --steps 3",
)


def compare(
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    over: OverOption = None,
    methods: Annotated[
        str | None,
        option(
            f"Of {', '.join(METHODS)}; default: {', '.join(DEFAULT)}. With several estimators one.",
            WORK,
            metavar="LIST",
            autocompletion=completed(METHODS),
        ),
    ] = None,
    reference: Annotated[
        str | None, option("What the others are compared with; default: the most exact.", WORK + RARE, metavar="METHOD")
    ] = None,
    estimator: Annotated[
        str | None,
        option(
            "Compare estimators instead (stochfuse methods, or your own module:Class), claims beside truth; all: those "
            "that the scenario takes. One, with --methods: what these average.",
            WORK,
            metavar="LIST",
            autocompletion=completed((*ESTIMATORS, ALL)),
        ),
    ] = None,
    quantity: Annotated[
        str | None,
        option(
            "claimed, actual, consistency, bias or rms; default: claimed, of estimators claimed,actual,consistency.",
            SHOWN,
            metavar="NAME",
        ),
    ] = None,
    metric: MetricOption = None,
    agent: AgentOption = None,
    at: AtOption = None,
    all_steps: Annotated[bool, option("Estimators: every step, not only the last.", SHOWN, "--all-steps")] = False,
    relative: Annotated[bool, option("Differences in per cent of the reference.", SHOWN, "--relative")] = False,
    averaging: Averaging = Averaging(),
    to: Reported = Reported(),
) -> None:
    """Show what methods predict side by side, and the signed differences; or what estimators claim and achieve.

    simplified is approximate, general and naive are exact (naive counts shared information twice), monte-carlo
    is sampled, with its standard error.
    """
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.prediction.method import ShownPart

    to.check(scenario)
    given, links, swept = changes.swept(scenario, over, to.kind)
    names = None if estimator is None else [ALL] if estimator == ALL else list(named(estimator))
    if names is None and methods is None and given.estimator is not None:
        names = [ALL]  # a scenario for other estimators than those of the thesis' methods
    several = names is not None and (len(names) > 1 or methods is None or names == [ALL])
    ways = list(DEFAULT) if methods is None else [name.strip() for name in methods.split(",")]
    if several and methods is not None and len(ways) > 1:
        raise UsageError(f"--methods: expected one with several estimators, got {methods}")
    settings = averaging.settings(
        [GENERAL, MONTE_CARLO] if several and methods is None else ways,
        estimator=None if several or names is None else names[0],
    )
    settings |= {} if swept is None else {"over": swept}
    if several:
        refuse({"--reference": reference, "--relative": relative}, "methods to compare, got several estimators")
    if averaging.criterion is not None and several and names != [ALL] and not set(names or ()) & set(INTERSECTIONS):
        raise UsageError(f"--criterion: expected estimator {' or '.join(INTERSECTIONS)}, got {estimator}")
    if all_steps and not several:
        raise UsageError("--all-steps: expected several estimators")
    quantities = quantity_names(quantity or ("claimed,actual,consistency" if several else "claimed"))
    chosen, chosen_agent = metric_of(metric or given.metric or "trace", given.model), whose(agent, given)
    steps = steps_at(at, given)
    part = ShownPart(tuple(quantities), (chosen,), chosen_agent, steps)
    settings["shown"] = part
    if several:
        only, way = None if names == [ALL] else names, None if methods is None else ways[0]
        report, said = _estimators((given, links), only, way, part, (all_steps, to.digits), settings)
    else:
        if len(quantities) > 1:
            raise UsageError(f"--quantity: expected one to compare methods by, got {quantity}; for several see predict")
        report, said = _methods((given, links), ways, reference, part, (relative, to.digits), settings)
    to.write(report)
    to.send(report, given.to_mapping(), said)


def _methods(
    asked: tuple[Scenario, list[float] | None],
    methods: Sequence[str],
    reference: str | None,
    part: ShownPart,
    look: tuple[bool, int],
    settings: dict[str, Any],
) -> tuple[Report, list[str]]:
    """Return the report and what was said of it; `look`: whether differences are relative, and digits."""
    from stochfuse.prediction.compare import compare as run
    from stochfuse.report.comparisons import ComparisonView, comparison_report
    from stochfuse.report.predictions import PredictionView

    relative, digits = look
    found = run(*asked, methods, reference, part.quantities[0], **settings)
    metric, agent, at = part.metrics[0], part.agent, part.steps
    views = tuple(PredictionView(p, metric, agent, digits=digits, at=at) for p in found.predictions)
    view = ComparisonView(found, views, relative)
    view.values()  # a request that cannot be met should say so before notes
    said = tell(f"note: {prediction.method}: {note}" for prediction in found.predictions for note in prediction.notes)
    return comparison_report(view), said


def _estimators(
    asked: tuple[Scenario, list[float] | None],
    names: Sequence[str] | None,
    method: str | None,
    part: ShownPart,
    look: tuple[bool, int],
    settings: dict[str, Any],
) -> tuple[Report, list[str]]:
    """Return the report and what was said of it; `look`: whether every step is shown, and digits."""
    from stochfuse.prediction.compare import compare_estimators as run
    from stochfuse.prediction.quantities import check
    from stochfuse.report.comparisons import EstimatorView, estimator_report

    (metric,), (all_steps, digits) = part.metrics, look
    for name in part.quantities:
        check(name, metric)
    found = run(*asked, names, method, quantities=part.quantities, **settings)
    view = EstimatorView(found, metric, part.agent, digits, part.quantities, all_steps, part.steps)
    said = [f"note: left out: {reason}" for reason in found.left_out]
    said += [f"note: {prediction.estimator}: {note}" for prediction in found.predictions for note in prediction.notes]
    warnings = {views[0].prediction.estimator: views[0].overconfidence() for views in view.views}
    warnings = {name: warning for name, warning in warnings.items() if warning}
    if len(warnings) > 2:
        said.append(f"warning: overconfident by more than 5 % somewhere: {', '.join(warnings)}")
    else:
        said += [f"warning: {name}: {warning}" for name, warning in warnings.items()]
    return estimator_report(view), tell(said)
