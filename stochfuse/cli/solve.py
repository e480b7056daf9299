"""`stochfuse solve`: questions asked backwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from stochfuse.cli.options import (
    RARE,
    SHOWN,
    WORK,
    AgentOption,
    Changes,
    EstimatorOption,
    MaxGraphsOption,
    MetricOption,
    ScenarioArgument,
    Written,
    choice,
    option,
)
from stochfuse.cli.values import check_memory, over_ends, settings_for, tell, whose
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import METHODS, SIMPLIFIED

if TYPE_CHECKING:
    from stochfuse.report.solutions import SolutionSheet
    from stochfuse.report.table import Report
    from stochfuse.scenario.scenario import Scenario

QUESTION = "Options"
EXAMPLES = (
    "stochfuse solve --target 30 --method general --steps 3",
    "stochfuse solve --target 25 --agents-needed --link 0.5",
)

NOT_CRITICAL = ("target", "agents-needed", "sensitivity", "gain", "steady", "over")
"""Questions about a number, which has a step and a metric; whether it is bounded is the same in all of them."""


@dataclass(frozen=True)
class SolveRequest:
    """Which question."""

    target: Annotated[
        float | None, option("Least link probability at which the value is at most X.", QUESTION, metavar="X")
    ] = None
    agents_needed: Annotated[
        bool, option("With --target, --link: the least number of agents.", QUESTION, "--agents-needed")
    ] = False
    over: Annotated[
        list[str] | None,
        option("That key for µ: with --target KEY=LO:HI, with --critical KEY.", QUESTION, "--over", metavar="KEY"),
    ] = None
    sensitivity: Annotated[
        bool, option("What each link is worth, and which to improve first.", QUESTION, "--sensitivity")
    ] = False
    gain: Annotated[bool, option("Share of the gain from µ = 0 to 1 that each --link reaches.", QUESTION, "--gain")] = (
        False
    )
    steady: Annotated[
        bool, option("Ask about the steady state; alone: tabulate it over --link.", QUESTION, "--steady")
    ] = False
    critical: Annotated[
        bool, option("The µ above which the average stays bounded, proved.", QUESTION, "--critical")
    ] = False

    @property
    def kind(self) -> str:
        """The one question that is asked.

        Raises
        ------
        UsageError
            If there is none, or several.
        """
        questions = ("target", "sensitivity", "gain", "critical")
        chosen = [name for name in questions if getattr(self, name) not in (None, False)]
        if len(chosen) > 1:
            raise UsageError(f"expected one question a call, got --{' and --'.join(chosen)}")
        if self.over and chosen == ["critical"]:
            return "critical"
        if self.over and (chosen != ["target"] or self.agents_needed):
            got = "--agents-needed" if self.agents_needed else f"--{chosen[0]}" if chosen else "no --target"
            raise UsageError(f"--over: expected --target X or --critical with it, got {got}")
        if self.over:
            return "over"
        if self.agents_needed and chosen != ["target"]:
            raise UsageError("--agents-needed: expected --target X and --link P with it, got no --target")
        if self.agents_needed:
            return "agents-needed"
        if not chosen and not self.steady:
            raise UsageError(
                "expected a question: --target X (the least link probability; with --agents-needed the least number of "
                "agents), --sensitivity, --gain, --critical, or --steady; got none"
            )
        return chosen[0] if chosen else "steady"


def solve(
    scenario: ScenarioArgument = "thesis-transient",
    asked_for: SolveRequest = SolveRequest(),
    step: Annotated[int | None, option("Step asked about; default: the last.", QUESTION, metavar="K")] = None,
    case: Annotated[
        str | None, option("--sensitivity: which of the scenario's cases.", QUESTION + RARE, metavar="NAME")
    ] = None,
    max_agents: Annotated[
        int | None,
        option(
            "--agents-needed: where to give up; default: 1000000, for optimal 100.", QUESTION + RARE, min=1, metavar="N"
        ),
    ] = None,
    changes: Changes = Changes(),
    quantity: Annotated[
        str, option("claimed, actual, optimal, consistency, bias or rms; default: claimed.", SHOWN, metavar="NAME")
    ] = "claimed",
    metric: MetricOption = None,
    agent: AgentOption = None,
    method: Annotated[
        str, choice(METHODS, f"How to average over what arrives: {', '.join(METHODS[:-1])}; default: simplified.", WORK)
    ] = SIMPLIFIED,
    estimator: EstimatorOption = None,
    max_graphs: MaxGraphsOption = None,
    to: Written = Written(),
) -> None:
    """Answer a question asked backwards: which µ, which link, how many agents.

    One question a call: --target X (with --agents-needed: the agents), one of the others, or --steady alone.
    """
    from stochfuse.questions.question import question
    from stochfuse.report import solutions

    to.check(scenario)
    kind = asked_for.kind
    for flag, value, wanted in (
        ("--link", changes.link, ("agents-needed", "sensitivity", "gain", "steady", "over")),
        ("--case", case, ("sensitivity",)),
        ("--max-agents", max_agents, ("agents-needed",)),
        ("--agents", changes.agents, ("target", "sensitivity", "gain", "steady", "over", "critical")),
        ("--step", step, NOT_CRITICAL),
        ("--metric", metric, NOT_CRITICAL),
        ("--estimator", estimator, NOT_CRITICAL),
        ("--max-graphs", max_graphs, NOT_CRITICAL),
        ("--method", None if method == SIMPLIFIED else method, NOT_CRITICAL),
        ("--quantity", None if quantity == "claimed" else quantity, NOT_CRITICAL),
    ):
        if value is not None and kind not in wanted:
            raise UsageError(f"{flag}: expected with --{', --'.join(wanted)}; got it with --{kind}")
    if kind == "critical":
        to.write(_critical(changes.of(scenario)[0], agent, asked_for.over))
        return
    asked: dict[str, Any] = {
        "step": step,
        "steady": asked_for.steady,
        "method": method,
        "quantity": quantity,
        "of": metric,
        **settings_for([method], estimator=estimator, max_graphs=max_graphs),
    }
    given, links = changes.of(scenario)
    check_memory(given, links, to.kind)
    asked["agent"] = whose(agent, given)
    if asked_for.over:
        key, between = over_ends(asked_for.over)
        changes.check_unset([key])
        asked |= {"key": key, "between": between}
    if kind == "steady":
        about = question(given, **asked)
        found = about.predict(links)
        sheet = solutions.steady_sheet(about, found, to.digits)
    else:
        found = _answer(kind, given, links, asked_for.target, case, max_agents, asked)
        sheet = solutions.sheet_of(found, to.digits)
    _note(sheet)
    to.write(solutions.solution_report(sheet, found))


def _critical(given: Scenario, agent: str | None, over: list[str] | None) -> Report:
    from stochfuse.questions.critical import critical
    from stochfuse.report.critical import critical_report
    from stochfuse.scenario.over import unit_of, with_numbers

    if not over:
        return critical_report(critical(given, agent=whose(agent, given)))
    key = over[0].strip()
    if len(over) > 1 or "=" in key:
        raise UsageError(f"--over: expected one KEY without values with --critical, got '{' '.join(over)}'")
    unit_of(key)  # says which key was meant, if it is none
    found = critical(given, lambda x: with_numbers(given, {key: x}), agent=whose(agent, given), name=key)
    return critical_report(found)


def _answer(
    kind: str,
    given: Scenario,
    links: list[float] | None,
    target: float | None,
    case: str | None,
    max_agents: int | None,
    asked: dict[str, Any],
) -> Any:
    from stochfuse.questions import agents_needed, least_link, least_value, sensitivity

    if kind == "target":
        return least_link.least_link(given, target or 0.0, **asked)
    if kind == "gain":
        return sensitivity.share_of_gain(given, links, **asked)
    if kind == "agents-needed":
        return agents_needed.agents_needed(given, target or 0.0, _single(links, kind), max_agents=max_agents, **asked)
    at = None if links is None else _single(links, kind)
    if kind == "over":
        return least_value.least_value(given, target or 0.0, link=at, **asked)
    return sensitivity.sensitivity(given, at, case=case, **asked)


def _single(links: list[float] | None, kind: str) -> float:
    if links is None or len(links) != 1:
        got = "none" if links is None else f"{len(links)} of them"
        raise UsageError(f"--link: expected one link probability with --{kind}, got {got}")
    return links[0]


def _note(sheet: SolutionSheet) -> None:
    mixed = [f"{sheet.question.metric.name} adds up different units; see --metric"] * sheet.question.metric.mixed
    tell(f"note: {note}" for note in (*sheet.prediction.notes, *mixed))
