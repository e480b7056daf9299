"""`stochfuse messages`: how much the agents have to send each other."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.options import (
    AgentsOption,
    ArchitectureOption,
    DigitsOption,
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
    check_files,
    check_memory,
    chosen_format,
    load,
    settings_for,
    write_report,
)

if TYPE_CHECKING:
    from stochfuse.questions.messages import MessageLoad


class Rule(StrEnum):
    """Which messages."""

    local_fusion_graph = "local-fusion-graph"
    naive = "naive"
    both = "both"


class Method(StrEnum):
    """How loads are computed."""

    exact = "exact"
    monte_carlo = "monte-carlo"


def messages(
    scenario: ScenarioArgument = "thesis-transient",
    agents: AgentsOption = None,
    steps: StepsOption = None,
    link: LinkOption = None,
    q: QOption = None,
    r: ROption = None,
    p0: P0Option = None,
    architecture: ArchitectureOption = None,
    rule: Annotated[Rule, typer.Option(help="Whose messages.")] = Rule.both,
    from_step: Annotated[
        int | None, typer.Option(min=1, metavar="K", help="First step counted; default: 1. The last one is --steps.")
    ] = None,
    step: Annotated[int | None, typer.Option(min=1, metavar="K", help="Count this step alone.")] = None,
    agent: Annotated[
        str, typer.Option(metavar="N", help="Whose load where agents differ: mean (any of them) or an agent's number.")
    ] = "mean",
    distribution: Annotated[
        bool, typer.Option("--distribution", help="Probabilities of every number of nodes instead.")
    ] = False,
    cdf: Annotated[bool, typer.Option("--cdf", help="Probabilities of at most so many nodes instead.")] = False,
    accuracy: Annotated[
        bool, typer.Option("--accuracy", help="Accuracy of the fused estimate beside the mean load instead.")
    ] = False,
    metric: MetricOption = None,
    quantity: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="--accuracy: claimed, actual, consistency, bias or rms; default: actual."),
    ] = None,
    bytes: Annotated[bool, typer.Option("--bytes", help="Bytes too, from the scenario's state dimension.")] = False,
    header: Annotated[
        int | None, typer.Option(min=0, metavar="BYTES", help="Bytes of every message beside its nodes; sets --bytes.")
    ] = None,
    method: Annotated[
        Method,
        typer.Option(help="exact; or monte-carlo, for networks too large for it (naive loads are always exact)."),
    ] = Method.exact,
    max_graphs: MaxGraphsOption = None,
    prune: PruneOption = False,
    runs: RunsOption = None,
    seed: SeedOption = None,
    digits: DigitsOption = 5,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Tabulate message load: how many nodes new to an agent the messages of a step bring it.

    A lower bound for any protocol: senders that know what the receiver lacks.
    Example: stochfuse messages --steps 12 --from-step 6 --architecture broadcast
    """
    from stochfuse.errors import UsageError
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.questions.messages import RULES, message_load
    from stochfuse.questions.messages import accuracy as accuracy_of
    from stochfuse.report import messages as reports

    check_files(output, plot, scenario)
    kind = _kind(distribution=distribution, cdf=cdf, accuracy=accuracy)
    if kind in ("distribution", "cdf") and (bytes or header is not None):
        raise UsageError(f"--{kind}: expected neither --bytes nor --header, every node has the same size")
    for_accuracy = {"--metric": metric, "--quantity": quantity, "--max-graphs": max_graphs, "--prune": prune or None}
    for option, value in for_accuracy.items():
        if value is not None and not accuracy:
            raise UsageError(f"{option}: expected --accuracy, which it is for")
    sampling = settings_for([method.value], runs=runs, seed=seed)
    averaging = ["general", "naive"] if method is Method.exact else [method.value]
    graphs = settings_for(averaging, max_graphs=max_graphs, prune=prune)
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    check_memory(given, links, chosen_format(format, output))
    first, last = _window(given.network.steps, from_step, step)
    whose = int(agent) if agent.isdigit() else agent
    wanted = [each for each in RULES if rule.value in (each, "both")]
    of_rule = {
        each: message_load(given, links, each, method=method.value, **sampling).between(first, last)
        for each in {*wanted, "naive"}  # naive loads are the numbers of messages
    }
    loads = tuple(of_rule[each] for each in wanted)
    loads[0].mean(whose)  # a request that cannot be met should say so before longer work
    chosen = metric_of(metric or given.metric or "trace", given.model)
    accuracies = tuple(
        accuracy_of(
            each,
            links,
            metric=chosen,
            quantity=quantity or "actual",
            agent=whose,
            method=method.value,
            **sampling,
            **graphs,
        )
        for each in loads
        if accuracy
    )
    in_bytes = (header or 0) if bytes or header is not None else None
    view = reports.LoadView(loads, of_rule["naive"], kind, whose, in_bytes, accuracies, chosen, digits)
    _note(loads, accuracies)
    if plot is not None:
        reports.plot_load(view, plot)
    write_report(
        format,
        output,
        partial(reports.load_table, view),
        partial(reports.load_csv, view),
        partial(reports.load_json, view),
    )


def _kind(**wanted: bool) -> str:
    from stochfuse.errors import UsageError

    chosen = [name for name, value in wanted.items() if value]
    if len(chosen) > 1:
        raise UsageError(f"--{chosen[1]}: expected without --{chosen[0]}, one of them at a time")
    return chosen[0] if chosen else "moments"


def _window(steps: int, from_step: int | None, step: int | None) -> tuple[int, int]:
    from stochfuse.errors import UsageError

    if step is not None and from_step is not None:
        raise UsageError("--step: expected without --from-step, one of them at a time")
    for option, value in (("--step", step), ("--from-step", from_step)):
        if value is not None and value > steps:
            raise UsageError(f"{option}: expected a step from 1 to {steps} (see --steps), got {value}")
    return (step, step) if step is not None else (from_step or 1, steps)


def _note(loads: tuple[MessageLoad, ...], accuracies: tuple[Any, ...]) -> None:
    if any(each.sample is not None for each in loads):
        typer.echo("note: the maximum of a sample is no bound; larger loads may be possible", err=True)
    for each in accuracies:
        for note in each.prediction.notes:
            typer.echo(f"note: accuracy of {each.load.rule}: {note}", err=True)
