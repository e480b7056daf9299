"""`stochfuse solve`: questions asked backwards."""

from __future__ import annotations

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
    QOption,
    ROption,
    ScenarioArgument,
    StepsOption,
    check_files,
    check_memory,
    chosen_format,
    load,
    settings_for,
    whose,
    write_report,
)
from stochfuse.cli.predict import Method

if TYPE_CHECKING:
    from stochfuse.report.solutions import SolutionSheet
    from stochfuse.scenario.scenario import Scenario


def solve(
    scenario: ScenarioArgument = "thesis-transient",
    target: Annotated[
        float | None,
        typer.Option(metavar="X", help="Least link probability at which the value is at most X, in the metric's unit."),
    ] = None,
    agents_needed: Annotated[
        bool, typer.Option("--agents-needed", help="With --target and --link: the least number of agents instead.")
    ] = False,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="What each link is worth, and which to improve first.")
    ] = False,
    gain: Annotated[
        bool, typer.Option("--gain", help="Share of the gain from µ = 0 to µ = 1 that each --link reaches.")
    ] = False,
    steady: Annotated[
        bool,
        typer.Option("--steady", help="Ask about the steady state (simplified); alone: tabulate it against --link."),
    ] = False,
    step: Annotated[int | None, typer.Option(metavar="K", help="Step asked about; default: the last.")] = None,
    link: LinkOption = None,
    case: Annotated[
        str | None, typer.Option(metavar="NAME", help="--sensitivity: which of the scenario's cases.")
    ] = None,
    max_agents: Annotated[
        int | None,
        typer.Option(min=1, help="--agents-needed: where to give up; default: 1000000, for optimal 100."),
    ] = None,
    agents: AgentsOption = None,
    steps: StepsOption = None,
    q: QOption = None,
    r: ROption = None,
    p0: P0Option = None,
    architecture: ArchitectureOption = None,
    method: Annotated[
        Method, typer.Option(help="How to average over which messages arrive (monte-carlo cannot be asked backwards).")
    ] = Method.simplified,
    estimator: EstimatorOption = None,
    quantity: Annotated[
        str, typer.Option(metavar="NAME", help="claimed, actual, optimal, consistency, bias or rms.")
    ] = "claimed",
    metric: MetricOption = None,
    agent: AgentOption = None,
    max_graphs: MaxGraphsOption = None,
    digits: DigitsOption = 5,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: PlotOption = None,
) -> None:
    """Answer a question asked backwards: which link probability, which link, how many agents.

    One question a call: --target X (with --agents-needed: the agents), --sensitivity, --gain, or --steady alone.
    Example: stochfuse solve --target 30 --method general
    """
    from stochfuse.errors import UsageError
    from stochfuse.report import solutions

    check_files(output, plot, scenario)
    kind = _question(target, agents_needed=agents_needed, sensitivity=sensitivity, gain=gain, steady=steady)
    for option, value, wanted in (
        ("--link", link, ("agents-needed", "sensitivity", "gain", "steady")),
        ("--case", case, ("sensitivity",)),
        ("--max-agents", max_agents, ("agents-needed",)),
        ("--agents", agents, ("target", "sensitivity", "gain", "steady")),
    ):
        if value is not None and kind not in wanted:
            raise UsageError(f"{option}: expected with --{', --'.join(wanted)}; got it with --{kind}")
    asked: dict[str, Any] = {
        "step": step,
        "steady": steady,
        "method": method.value,
        "quantity": quantity,
        "of": metric,
        **settings_for([method.value], estimator=estimator, max_graphs=max_graphs),
    }
    given, links = load(scenario, agents, steps, architecture, q, r, p0, link)
    check_memory(given, links, chosen_format(format, output))
    asked["agent"] = whose(agent, given)
    sheet, found = _answer(kind, given, links, target, case, max_agents, digits, asked)
    _note(sheet)
    if plot is not None:
        from stochfuse.report.solutions import plot_solution

        plot_solution(sheet, found, plot)
    write_report(
        format,
        output,
        partial(solutions.solution_table, sheet),
        partial(solutions.solution_csv, sheet),
        partial(solutions.solution_json, sheet),
    )


def _question(target: float | None, *, agents_needed: bool, sensitivity: bool, gain: bool, steady: bool) -> str:
    from stochfuse.errors import UsageError

    questions = {"target": target is not None, "sensitivity": sensitivity, "gain": gain}
    chosen = [name for name, wanted in questions.items() if wanted]
    if len(chosen) > 1:
        raise UsageError(f"expected one question a call, got --{' and --'.join(chosen)}")
    if agents_needed:
        if chosen != ["target"]:
            raise UsageError("--agents-needed: expected --target X and --link P with it, got no --target")
        return "agents-needed"
    if not chosen and not steady:
        raise UsageError(
            "expected a question: --target X (the least link probability; with --agents-needed the least number of "
            "agents), --sensitivity, --gain, or --steady; got none"
        )
    return chosen[0] if chosen else "steady"


def _answer(
    kind: str,
    given: Scenario,
    links: list[float] | None,
    target: float | None,
    case: str | None,
    max_agents: int | None,
    digits: int,
    asked: dict[str, Any],
) -> tuple[SolutionSheet, Any]:
    from stochfuse.questions import agents_needed, least_link, sensitivity
    from stochfuse.questions.question import question
    from stochfuse.report import solutions

    if kind == "target":
        found = least_link.least_link(given, target or 0.0, **asked)
        return solutions.least_link_sheet(found, digits), found
    if kind == "agents-needed":
        found = agents_needed.agents_needed(given, target or 0.0, _single(links, kind), max_agents=max_agents, **asked)
        return solutions.agents_sheet(found, digits), found
    if kind == "sensitivity":
        at = None if links is None else _single(links, kind)
        found = sensitivity.sensitivity(given, at, case=case, **asked)
        return solutions.sensitivity_sheet(found, digits), found
    if kind == "gain":
        found = sensitivity.share_of_gain(given, links, **asked)
        return solutions.gain_sheet(found, digits), found
    about = question(given, **asked)
    found = about.predict(links)
    return solutions.steady_sheet(about, found, digits), found


def _single(links: list[float] | None, kind: str) -> float:
    from stochfuse.errors import UsageError

    if links is None or len(links) != 1:
        got = "none" if links is None else f"{len(links)} of them"
        raise UsageError(f"--link: expected one link probability with --{kind}, got {got}")
    return links[0]


def _note(sheet: SolutionSheet) -> None:
    if sheet.kind == "sensitivity" and sheet.question.method == "simplified" and sheet.question.agent != "mean":
        typer.echo(
            "note: the simplified formulation lets an agent's prior stand for the others' too, so that only links to "
            "the agent count; see --method general or optimal",
            err=True,
        )
    for note in sheet.prediction.notes:
        typer.echo(f"note: {note}", err=True)
    if sheet.question.metric.mixed:
        typer.echo(f"note: {sheet.question.metric.name} adds up different units; see --metric", err=True)
