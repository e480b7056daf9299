"""`stochfuse predict`: expected covariance against link probability."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.options import (
    AgentOption,
    AgentsOption,
    ArchitectureOption,
    DigitsOption,
    EstimatorOption,
    FormatOption,
    LinkOption,
    MaxGraphsOption,
    MetricOption,
    OutputOption,
    P0Option,
    PlotOption,
    PruneOption,
    QOption,
    ROption,
    RunsOption,
    ScenarioArgument,
    SeedOption,
    StepsOption,
    WorkersOption,
    check_files,
    load,
    settings_for,
    write_report,
)

if TYPE_CHECKING:
    from stochfuse.report.predictions import View


class Method(StrEnum):
    """Methods of prediction."""

    simplified = "simplified"
    general = "general"
    optimal = "optimal"
    naive = "naive"
    monte_carlo = "monte-carlo"


class Quantity(StrEnum):
    """Quantities predicted."""

    claimed = "claimed"


def predict(
    scenario: ScenarioArgument = "thesis-transient",
    agents: AgentsOption = None,
    steps: StepsOption = None,
    link: LinkOption = None,
    q: QOption = None,
    r: ROption = None,
    p0: P0Option = None,
    architecture: ArchitectureOption = None,
    method: Annotated[Method, typer.Option(help="How to average over which messages arrive.")] = Method.simplified,
    estimator: EstimatorOption = None,
    quantity: Annotated[Quantity, typer.Option(help="Which covariance.")] = Quantity.claimed,
    metric: MetricOption = None,
    statistic: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="mean; or over the outcomes (general, naive): variance, std, quantile:P, at-most:LIMIT, derivative.",
        ),
    ] = "mean",
    agent: AgentOption = "mean",
    normalise: Annotated[bool, typer.Option("--normalise", help="Relative to link probability 0.")] = False,
    steady: Annotated[
        bool, typer.Option("--steady", help="Add the steady state, P = g(P), with a proved bound (simplified).")
    ] = False,
    max_graphs: MaxGraphsOption = None,
    prune: PruneOption = False,
    runs: RunsOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = None,
    digits: DigitsOption = 5,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Tabulate the expected fused covariance against link probability.

    Without a scenario: the thesis' transient one. Options override the scenario.
    """
    from stochfuse.errors import UsageError
    from stochfuse.methods import predict as run
    from stochfuse.metrics import metric as metric_of
    from stochfuse.report import predictions
    from stochfuse.report.predictions import View

    check_files(output, plot, scenario)
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    if statistic != "mean":
        if method not in (Method.general, Method.naive):
            raise UsageError(f"--statistic {statistic}: expected --method general or naive, got {method.value}")
        if normalise:
            raise UsageError("--normalise: expected --statistic mean")
        from stochfuse.distribution import parse_statistic

        kind, _ = parse_statistic(statistic)
        if kind == "derivative" and not chosen.linear:
            raise UsageError(f"derivative: expected metric trace or var:STATE, got '{chosen.name}'")
    settings = {
        "steady": steady,
        **settings_for(
            [method.value],
            estimator=estimator,
            max_graphs=max_graphs,
            prune=prune,
            runs=runs,
            seed=seed,
            workers=workers,
        ),
    }
    with _progress(method) as settings["progress"]:
        prediction = run(given, links, method.value, quantity.value, **settings)
        baseline = run(given, [0.0], method.value, quantity.value, **settings) if normalise else None
    view = View(prediction, chosen, int(agent) if agent.isdigit() else agent, baseline, digits, statistic)
    view.values()  # a request that cannot be met should say so before notes and figures
    _warn(view)
    if plot is not None:
        from stochfuse.report.plot import plot_prediction

        plot_prediction(view, plot)
    write_report(
        format,
        output,
        partial(predictions.predict_table, view),
        partial(predictions.predict_csv, view),
        partial(predictions.predict_json, view),
    )


def _progress(method: Method) -> AbstractContextManager[Any]:
    if method is Method.simplified:
        return nullcontext()
    from stochfuse.cli.progress import shown

    return shown()


def _warn(view: View) -> None:
    if view.prediction.sampled is not None and view.agent in ("worst", "best") and not view.prediction.alike:
        typer.echo(f"note: which agent is the {view.agent} is judged by the same sample: the value is biased", err=True)
    for note in view.prediction.notes:
        typer.echo(f"note: {note}", err=True)
    if view.metric.mixed and not view.baseline:
        names = ", ".join(f"{n} [{u}]" for n, u in zip(*_states(view), strict=True))
        typer.echo(f"note: {view.metric.name} adds up different units ({names}); see --metric", err=True)
    bound = view.prediction.steady_bound
    if bound is not None:
        worst = bound.max()
        if worst < 1:
            typer.echo(
                f"note: the steady state is proved to lie within a relative {worst:.0e} of the value shown", err=True
            )
        else:
            typer.echo(
                "note: the steady state's residual is at rounding level, but no bound on it could be proved", err=True
            )


def _states(view: View) -> tuple[tuple[str, ...], tuple[str, ...]]:
    model = view.prediction.scenario.model
    return model.states, model.units
