"""`stochfuse compare`: methods side by side, with the differences."""

from __future__ import annotations

from functools import partial
from typing import Annotated

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
    quantity_names,
    settings_for,
    write_report,
)


def compare(
    scenario: ScenarioArgument = "thesis-transient",
    methods: Annotated[
        str, typer.Option(metavar="LIST", help="Methods to compare: simplified, general, optimal, naive, monte-carlo.")
    ] = "general,simplified,naive,monte-carlo",
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
    estimator: EstimatorOption = None,
    quantity: Annotated[
        str, typer.Option(metavar="NAME", help="claimed, actual, consistency (actual / claimed), bias or rms.")
    ] = "claimed",
    metric: MetricOption = None,
    agent: AgentOption = "mean",
    relative: Annotated[bool, typer.Option("--relative", help="Differences in per cent of the reference.")] = False,
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
    """Show what methods predict side by side, and the signed differences.

    simplified is approximate, general and naive are exact averages over every outcome (naive of a rule that counts
    shared information twice), monte-carlo is sampled, with its standard error.
    """
    from stochfuse.cli.progress import shown
    from stochfuse.comparison import compare as run
    from stochfuse.errors import UsageError
    from stochfuse.metrics import metric as metric_of
    from stochfuse.report import comparisons
    from stochfuse.report.predictions import View

    check_files(output, plot, scenario)
    chosen_methods = [name.strip() for name in methods.split(",")]
    settings = settings_for(
        chosen_methods,
        estimator=estimator,
        max_graphs=max_graphs,
        prune=prune,
        runs=runs,
        seed=seed,
        workers=workers,
    )
    quantities = quantity_names(quantity)
    if len(quantities) > 1:
        raise UsageError(f"--quantity: expected one to compare methods by, got {quantity}; for several see predict")
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    with shown() as progress:
        found = run(given, links, chosen_methods, reference, quantities[0], progress=progress, **settings)
    whose = int(agent) if agent.isdigit() else agent
    view = comparisons.ComparisonView(
        found, tuple(View(p, chosen, whose, None, digits) for p in found.predictions), relative
    )
    view.values()
    for prediction in found.predictions:
        for note in prediction.notes:
            typer.echo(f"note: {prediction.method}: {note}", err=True)
    if plot is not None:
        comparisons.plot_comparison(view, plot)
    write_report(
        format,
        output,
        partial(comparisons.compare_table, view),
        partial(comparisons.compare_csv, view),
        partial(comparisons.compare_json, view),
    )
