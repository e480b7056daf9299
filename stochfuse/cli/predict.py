"""`stochfuse predict`: expected covariance against link probability."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import (
    AgentOption,
    AgentsOption,
    ArchitectureOption,
    CriterionOption,
    DigitsOption,
    EstimatorOption,
    Format,
    FormatOption,
    LinkOption,
    MaxGraphsOption,
    MetricOption,
    OutputOption,
    P0Option,
    PlotOption,
    PruneOption,
    QOption,
    QuantityOption,
    ROption,
    RunsOption,
    ScenarioArgument,
    SeedOption,
    StepsOption,
    WorkersOption,
    check_files,
    check_memory,
    chosen_format,
    load,
    quantity_names,
    settings_for,
    whose,
    write_report,
)

if TYPE_CHECKING:
    from stochfuse.report.predictions import PredictionView


class Method(StrEnum):
    """Methods of prediction."""

    simplified = "simplified"
    general = "general"
    optimal = "optimal"
    chain = "chain"
    naive = "naive"
    monte_carlo = "monte-carlo"


def predict(
    scenario: ScenarioArgument = "thesis-transient",
    agents: AgentsOption = None,
    steps: StepsOption = None,
    link: LinkOption = None,
    q: QOption = None,
    r: ROption = None,
    p0: P0Option = None,
    architecture: ArchitectureOption = None,
    method: Annotated[
        Method | None,
        typer.Option(
            help="How to average over which messages arrive; default: the scenario's, else simplified.",
            show_default=False,
        ),
    ] = None,
    estimator: EstimatorOption = None,
    quantity: QuantityOption = "claimed",
    metric: MetricOption = None,
    statistic: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="mean; or over the outcomes (general, naive): variance, std, quantile:P, at-most:LIMIT, derivative.",
        ),
    ] = "mean",
    agent: AgentOption = None,
    normalise: Annotated[bool, typer.Option("--normalise", help="Relative to link probability 0.")] = False,
    steady: Annotated[
        bool, typer.Option("--steady", help="Add the steady state, P = g(P), with a proved bound (simplified).")
    ] = False,
    max_graphs: MaxGraphsOption = None,
    prune: PruneOption = False,
    runs: RunsOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = None,
    criterion: CriterionOption = None,
    digits: DigitsOption = 5,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Tabulate the expected fused covariance against link probability.

    Without a scenario: the thesis' transient one. Options override the scenario.
    """
    from stochfuse.errors import UsageError
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.prediction.predict import predict_several as run
    from stochfuse.prediction.quantities import check
    from stochfuse.report.predictions import PredictionView

    check_files(output, plot, scenario)
    quantities = quantity_names(quantity)
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    check_memory(given, links, chosen_format(format, output))
    chosen_agent = whose(agent, given)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    for name in quantities:
        check(name, chosen)
    # an estimator without a method picks the exact engine that takes it, else sampling
    free = method is None and given.method is None and estimator is not None
    way = Method(given.method or ("general" if free else "simplified")) if method is None else method
    if statistic != "mean":
        if way not in (Method.general, Method.naive):
            raise UsageError(f"--statistic {statistic}: expected --method general or naive, got {way.value}")
        if normalise:
            raise UsageError("--normalise: expected --statistic mean")
        from stochfuse.prediction.general import check_statistic

        for name in quantities:
            check_statistic(statistic, name, chosen)
    settings = {
        "steady": steady,
        **settings_for(
            [way.value],
            estimator=estimator,
            max_graphs=max_graphs,
            prune=prune,
            runs=runs,
            seed=seed,
            workers=workers,
            criterion=criterion,
        ),
    }
    asked = None if free else way.value
    found = run(given, links, asked, quantities, **settings)
    at_zero = run(given, [0.0], asked, quantities, **settings) if normalise else [None] * len(found)
    views = tuple(
        PredictionView(p, chosen, chosen_agent, baseline, digits, statistic)
        for p, baseline in zip(found, at_zero, strict=True)
    )
    for view in views:
        view.values()  # a request that cannot be met should say so before notes and figures
    _warn(views)
    if len(views) == 1:
        _report(views[0], format, output, plot)
    else:
        _report_several(views, format, output, plot)


def _report(view: PredictionView, format: Format | None, output: Path | None, plot: Path | None) -> None:
    from stochfuse.report import predictions

    if plot is not None:
        from stochfuse.report.predictions import plot_prediction

        plot_prediction(view, plot)
    write_report(
        format,
        output,
        partial(predictions.predict_table, view),
        partial(predictions.predict_csv, view),
        partial(predictions.predict_json, view),
    )


def _report_several(
    views: tuple[PredictionView, ...], format: Format | None, output: Path | None, plot: Path | None
) -> None:
    from stochfuse.report import predictions as side_by_side

    if plot is not None:
        side_by_side.plot_side(views, plot)
    write_report(
        format,
        output,
        partial(side_by_side.side_table, views),
        partial(side_by_side.side_csv, views),
        partial(side_by_side.side_json, views),
    )


def _warn(views: tuple[PredictionView, ...]) -> None:
    first = views[0]
    if first.prediction.sampled is not None and first.agent in ("worst", "best") and not first.prediction.alike:
        typer.echo(
            f"note: which agent is the {first.agent} is judged by the same sample: the value is biased", err=True
        )
    for note in dict.fromkeys(note for view in views for note in view.prediction.notes):
        typer.echo(f"note: {note}", err=True)
    if first.metric.mixed and not first.baseline:
        model = first.prediction.scenario.model
        names = ", ".join(f"{n} [{u}]" for n, u in zip(model.states, model.units, strict=True))
        typer.echo(f"note: {first.metric.name} adds up different units ({names}); see --metric", err=True)
    for view in views:
        text = view.overconfidence()
        if text:
            typer.echo(f"warning: {text}", err=True)
            break
    if first.prediction.steady_bound is not None:
        _tell_bound(first.prediction.steady_bound.max())


def _tell_bound(worst: float) -> None:
    if worst < 1:
        text = f"the steady state is proved to lie within a relative {worst:.0e} of the value shown"
    else:
        text = "the steady state's residual is at rounding level, but no bound on it could be proved"
    typer.echo(f"note: {text}", err=True)
