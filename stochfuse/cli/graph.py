"""`stochfuse graph`: one history as a Local Fusion Graph that explains itself."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from stochfuse.cli.options import OutputOption, PlotOption, check_files


class GraphFormat(StrEnum):
    """How a graph is written."""

    text = "text"
    dot = "dot"
    json = "json"


def graph(
    history: Annotated[
        str,
        typer.Argument(
            metavar="HISTORY",
            help="TOML or JSON file that says which message arrived when, - for standard input, or thesis-example.",
        ),
    ] = "thesis-example",
    agent: Annotated[int | None, typer.Option(min=1, help="Whose fusions; default: everyone's.")] = None,
    step: Annotated[int | None, typer.Option(min=1, help="At which step; default: every step.")] = None,
    shared: Annotated[bool, typer.Option("--shared", help="All agents start from one common estimate.")] = False,
    scenario: Annotated[
        str | None, typer.Option(help="Add the claimed covariances with this scenario's model and sensors.")
    ] = None,
    format: Annotated[
        GraphFormat, typer.Option("--format", "-f", help="text: in words; dot: for Graphviz; json: for programs.")
    ] = GraphFormat.text,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Explain fused estimates: which shared nodes were removed, with which sign, brought forward from when.

    Without a history: the worked example of the thesis' section 2.4.
    """
    from stochfuse.errors import UsageError
    from stochfuse.estimators.fusion_graph import FusionGraph, load_history
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.report import fusion_graph as report
    from stochfuse.report.table import terminal_width, to_json, write_text

    check_files(output, plot, history, scenario or "")
    made = FusionGraph(load_history(history), shared=shared)
    agents = range(1, made.history.agents + 1) if agent is None else [agent]
    steps = range(1, made.history.steps + 1) if step is None else [step]
    explanations = [made.explain(i, k) for k in steps for i in agents]
    if (plot is not None or format is GraphFormat.dot) and (agent is None or step is None):
        raise UsageError("a drawing shows one agent at one step: expected --agent and --step")
    values = None
    if scenario is not None:
        from stochfuse.scenario.scenario import load_scenario

        n, steps = made.history.agents, made.history.steps
        given = load_scenario(scenario, agents=n, steps=steps, uniform_link=True)
        metric = metric_of(given.metric or "trace", given.model)
        claimed = {node: float(metric.of(estimate.P)) for node, estimate in made.estimates(given).items()}
        values = report.ClaimedAtNodes(metric, claimed)
    if plot is not None:
        report.plot(made, explanations[0], plot)
    if format is GraphFormat.json:
        text = to_json(report.to_mapping(made, explanations, values))
    elif format is GraphFormat.dot:
        text = report.to_dot(made, explanations[0])
    else:
        text = report.to_text(explanations, values, terminal_width())
    write_text(text, output)
