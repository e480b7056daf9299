"""`stochfuse compare`: methods side by side with the differences, or estimators side by side."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from stochfuse.cli.options import (
    AgentOption,
    AgentsOption,
    ArchitectureOption,
    CriterionOption,
    DigitsOption,
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
    from stochfuse.kalman.metrics import Metric
    from stochfuse.scenario.scenario import Scenario


def compare(
    scenario: ScenarioArgument = "thesis-transient",
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Methods to compare: simplified, general, optimal, naive, monte-carlo; default: all but optimal. With "
            "several estimators one, general or monte-carlo; default: general where that is easy.",
        ),
    ] = None,
    reference: Annotated[
        str | None, typer.Option(metavar="METHOD", help="What the others are compared with; default: the most exact.")
    ] = None,
    agents: AgentsOption = None,
    steps: StepsOption = None,
    link: LinkOption = None,
    q: QOption = None,
    r: ROption = None,
    p0: P0Option = None,
    architecture: ArchitectureOption = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Compare these estimators instead, what each claims beside what is true: local-fusion-graph, naive, "
            "optimal, covariance-intersection, split-ci, blender, joint-blender, equivalent-measurement, "
            "independent-measurements, lwin, itns, stand-alone; all: those that the scenario takes. One, with "
            "--methods: what the methods general and monte-carlo average.",
        ),
    ] = None,
    quantity: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="claimed, actual, consistency (actual / claimed), bias or rms; default: claimed, of estimators "
            "claimed,actual,consistency.",
        ),
    ] = None,
    metric: MetricOption = None,
    agent: AgentOption = None,
    all_steps: Annotated[
        bool, typer.Option("--all-steps", help="With several estimators: a row for every step, not only the last.")
    ] = False,
    relative: Annotated[bool, typer.Option("--relative", help="Differences in per cent of the reference.")] = False,
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
    """Show what methods predict side by side, and the signed differences; or what estimators claim and achieve.

    simplified is approximate, general and naive are exact averages over every outcome (naive of a rule that counts
    shared information twice), monte-carlo is sampled, with its standard error.
    """
    from stochfuse.errors import UsageError
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.scenario.registry import INTERSECTIONS

    check_files(output, plot, scenario)
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    check_memory(given, links, chosen_format(format, output))
    names = None if estimator is None else _names(estimator)
    if names is None and methods is None and given.estimator is not None:
        names = ["all"]  # a scenario for other estimators than those of the thesis' methods
    several = names is not None and (len(names) > 1 or methods is None or names == ["all"])
    ways = ["general", "simplified", "naive", "monte-carlo"] if methods is None else _names(methods)
    if several and methods is not None and len(ways) > 1:
        raise UsageError(f"--methods: expected one with several estimators, got {methods}")
    settings = settings_for(
        ["general", "monte-carlo"] if several and methods is None else ways,
        estimator=None if several or names is None else _known(names[0]),
        max_graphs=max_graphs,
        prune=prune,
        runs=runs,
        seed=seed,
        workers=workers,
        criterion=criterion,
    )
    for option, given_at_all in (("--reference", reference is not None), ("--relative", relative)):
        if several and given_at_all:
            raise UsageError(f"{option}: expected methods to compare, got several estimators")
    if criterion is not None and several and names != ["all"] and not set(names or ()) & set(INTERSECTIONS):
        raise UsageError(f"--criterion: expected estimator {' or '.join(INTERSECTIONS)}, got {estimator}")
    if all_steps and not several:
        raise UsageError("--all-steps: expected several estimators")
    quantities = quantity_names(quantity or ("claimed,actual,consistency" if several else "claimed"))
    chosen, chosen_agent = metric_of(metric or given.metric or "trace", given.model), whose(agent, given)
    shown = _Shown(chosen, chosen_agent, digits, format, output, plot)
    if several:
        only = None if names == ["all"] else names
        _estimators(shown, given, links, only, None if methods is None else ways[0], quantities, all_steps, settings)
    else:
        if len(quantities) > 1:
            raise UsageError(f"--quantity: expected one to compare methods by, got {quantity}; for several see predict")
        _methods(shown, given, links, ways, reference, quantities[0], relative, settings)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _known(estimator: str) -> str:
    from stochfuse.prediction.predict import choose
    from stochfuse.scenario.registry import ESTIMATORS

    choose("estimator", estimator, ESTIMATORS)
    return estimator


class _Shown(NamedTuple):
    """How an answer is shown."""

    metric: Metric
    agent: int | str
    digits: int
    format: Format | None
    output: Path | None
    plot: Path | None


def _methods(
    how: _Shown,
    scenario: Scenario,
    links: list[float] | None,
    methods: Sequence[str],
    reference: str | None,
    quantity: str,
    relative: bool,
    settings: dict[str, Any],
) -> None:
    from stochfuse.prediction.compare import compare as run
    from stochfuse.report import comparisons
    from stochfuse.report.predictions import PredictionView

    found = run(scenario, links, methods, reference, quantity, **settings)
    view = comparisons.ComparisonView(
        found, tuple(PredictionView(p, how.metric, how.agent, None, how.digits) for p in found.predictions), relative
    )
    view.values()
    for prediction in found.predictions:
        for note in prediction.notes:
            typer.echo(f"note: {prediction.method}: {note}", err=True)
    if how.plot is not None:
        comparisons.plot_comparison(view, how.plot)
    write_report(
        how.format,
        how.output,
        partial(comparisons.compare_table, view),
        partial(comparisons.compare_csv, view),
        partial(comparisons.compare_json, view),
    )


def _estimators(
    how: _Shown,
    scenario: Scenario,
    links: list[float] | None,
    names: Sequence[str] | None,
    method: str | None,
    quantities: Sequence[str],
    all_steps: bool,
    settings: dict[str, Any],
) -> None:
    from stochfuse.prediction.compare import compare_estimators as run
    from stochfuse.prediction.quantities import check
    from stochfuse.report import comparisons as estimators

    for name in quantities:
        check(name, how.metric)
    found = run(scenario, links, names, method, quantities=quantities, **settings)
    view = estimators.EstimatorView(found, how.metric, how.agent, how.digits, quantities, all_steps)
    for reason in found.left_out:
        typer.echo(f"note: left out: {reason}", err=True)
    for prediction in found.predictions:
        for note in prediction.notes:
            typer.echo(f"note: {prediction.estimator}: {note}", err=True)
    warnings = {views[0].prediction.estimator: views[0].overconfidence() for views in view.views}
    warnings = {name: warning for name, warning in warnings.items() if warning}
    if len(warnings) > 2:
        typer.echo(f"warning: overconfident by more than 5 % somewhere: {', '.join(warnings)}", err=True)
    else:
        for name, warning in warnings.items():
            typer.echo(f"warning: {name}: {warning}", err=True)
    if how.plot is not None:
        estimators.plot_estimators(view, how.plot)
    write_report(
        how.format,
        how.output,
        partial(estimators.estimator_table, view),
        partial(estimators.estimator_csv, view),
        partial(estimators.estimator_json, view),
    )
