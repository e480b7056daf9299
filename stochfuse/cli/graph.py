"""`stochfuse graph`: one history as a Local Fusion Graph that explains itself."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from stochfuse.cli.options import OUTPUT, SHOWN, OutputOption, PlotOption, choice, option
from stochfuse.cli.values import check_files
from stochfuse.errors import UsageError

TEXT, DOT, JSON = FORMATS = ("text", "dot", "json")
EXAMPLES = (
    "stochfuse graph --agent 1 --step 3",
    "stochfuse graph --scenario thesis-steady --agent 1 --step 3 --plot graph.svg",
)


def graph(
    history: Annotated[
        str,
        typer.Argument(
            metavar="HISTORY",
            help="TOML or JSON file that says which message arrived when, - for standard input, or thesis-example.",
        ),
    ] = "thesis-example",
    agent: Annotated[int | None, option("Whose fusions; default: everyone's.", SHOWN, min=1, metavar="N")] = None,
    step: Annotated[int | None, option("At which step; default: every step.", SHOWN, min=1, metavar="K")] = None,
    shared: Annotated[bool, option("All agents start from one common estimate.", SHOWN, "--shared")] = False,
    scenario: Annotated[
        str | None, option("Add the claimed covariances with this scenario's model and sensors.", SHOWN, metavar="FILE")
    ] = None,
    format: Annotated[
        str, choice(FORMATS, "text (in words), dot (for Graphviz), json; default: text.", OUTPUT, "--format", "-f")
    ] = TEXT,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Explain fused estimates: which shared nodes were removed, with which sign, brought forward from when.

    Without a history: the worked example of the thesis' section 2.4.
    """
    from stochfuse.estimators.fusion_graph import FusionGraph, load_history
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.report import fusion_graph as report
    from stochfuse.report.plot import save
    from stochfuse.report.table import terminal_width, to_json, write_text

    check_files([history, scenario], output, plot)
    made = FusionGraph(load_history(history), shared=shared)
    agents = range(1, made.history.agents + 1) if agent is None else [agent]
    steps = range(1, made.history.steps + 1) if step is None else [step]
    explanations = [made.explain(i, k) for k in steps for i in agents]
    if (plot is not None or format == DOT) and (agent is None or step is None):
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
        save(partial(report.draw, made, explanations[0]), plot)
    if format == JSON:
        text = to_json(report.to_mapping(made, explanations, values))
    elif format == DOT:
        text = report.to_dot(made, explanations[0])
    else:
        text = report.to_text(explanations, values, terminal_width())
    write_text(text, output)
