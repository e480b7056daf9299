"""`stochfuse messages`: how much the agents have to send each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from stochfuse.cli.options import (
    RARE,
    SHOWN,
    WORK,
    Changes,
    MetricOption,
    OutcomeOptions,
    OverOption,
    ScenarioArgument,
    Written,
    choice,
    option,
)
from stochfuse.cli.values import refuse, settings_for, tell, whole
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import GENERAL, LFG, MONTE_CARLO, NAIVE

if TYPE_CHECKING:
    from stochfuse.questions.messages import Load
    from stochfuse.scenario.scenario import Scenario

BOTH, EXACT = "both", "exact"
MISSING = ("wait", "intersect")
EXAMPLES = (
    "stochfuse messages --steps 12 --from-step 6 --architecture broadcast",
    "stochfuse messages --accuracy --steps 3 --bytes",
)


@dataclass(frozen=True)
class LoadOptions:
    """What of the load is shown."""

    distribution: Annotated[
        bool, option("Probabilities of every number of nodes instead.", SHOWN, "--distribution")
    ] = False
    cdf: Annotated[bool, option("Probabilities of at most so many nodes instead.", SHOWN + RARE, "--cdf")] = False
    accuracy: Annotated[
        bool, option("Accuracy of the fused estimate beside the load instead.", SHOWN, "--accuracy")
    ] = False
    metric: MetricOption = None
    quantity: Annotated[
        str | None,
        option("--accuracy: claimed, actual, consistency, bias or rms; default: actual.", SHOWN, metavar="NAME"),
    ] = None
    bytes: Annotated[bool, option("Bytes too, from the scenario's state dimension.", SHOWN, "--bytes")] = False
    header: Annotated[
        int | None,
        option("Bytes of every message beside its nodes; sets --bytes.", SHOWN + RARE, min=0, metavar="BYTES"),
    ] = None
    protocol: Annotated[
        str | None, option("Live agents instead: acknowledged, full, own, window:W, or several.", SHOWN, metavar="NAME")
    ] = None
    missing: Annotated[
        str | None,
        choice(
            MISSING,
            "--protocol: what rests on estimates that are not there waits, or is intersected; default: wait.",
            SHOWN + RARE,
        ),
    ] = None


def messages(
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    over: OverOption = None,
    rule: Annotated[
        str, choice((LFG, NAIVE, BOTH), f"Whose messages: {LFG}, {NAIVE} or both; default: both.", SHOWN)
    ] = BOTH,
    from_step: Annotated[
        int | None, option("First step counted; default: 1; the last: --steps.", SHOWN, min=1, metavar="K")
    ] = None,
    step: Annotated[int | None, option("Count this step alone.", SHOWN + RARE, min=1, metavar="K")] = None,
    agent: Annotated[
        str, option("Whose load, where agents differ: mean or an agent's number; default: mean.", SHOWN, metavar="N")
    ] = "mean",
    shown: LoadOptions = LoadOptions(),
    method: Annotated[
        str, choice((EXACT, MONTE_CARLO), "exact; or monte-carlo, for networks too large for it; default: exact.", WORK)
    ] = EXACT,
    outcomes: OutcomeOptions = OutcomeOptions(),
    to: Written = Written(),
) -> None:
    """Tabulate message load: how many nodes new to an agent the messages of a step bring it.

    A lower bound for any protocol: senders that know what the receiver lacks. Naive loads are always exact.
    """
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.questions.messages import RULES, message_load
    from stochfuse.questions.messages import accuracy as accuracy_of
    from stochfuse.report import messages as reports

    to.check(scenario)
    window = (from_step, step)
    if shown.protocol is not None:
        other = {"--over": over, "--rule": rule == NAIVE, "--method": method != EXACT}
        other |= {"--distribution": shown.distribution, "--cdf": shown.cdf, "--header": shown.header}
        refuse(other, "without --protocol, which samples what live agents send in bytes")
        _by_protocol(changes.of(scenario), window, agent, shown, outcomes, to)
        return
    refuse({"--missing": shown.missing}, "--protocol, which it is for")
    kind = _kind(distribution=shown.distribution, cdf=shown.cdf, accuracy=shown.accuracy)
    if kind in ("distribution", "cdf") and (shown.bytes or shown.header is not None):
        raise UsageError(f"--{kind}: expected neither --bytes nor --header, every node has the same size")
    graphs = {"max_graphs": outcomes.max_graphs, "prune": outcomes.prune}
    if not shown.accuracy:
        for_accuracy = {"--metric": shown.metric, "--quantity": shown.quantity}
        for_accuracy |= {"--max-graphs": outcomes.max_graphs, "--prune": outcomes.prune}
        refuse(for_accuracy, "--accuracy, which it is for")
    drawn = settings_for([method], runs=outcomes.runs, seed=outcomes.seed)
    averaged = settings_for([GENERAL, NAIVE] if method == EXACT else [method], **graphs)
    given, links, swept = changes.swept(scenario, over, to.kind)
    first, last = _window(given.network.steps, *window)
    whose = whole(agent) or agent
    wanted = [each for each in RULES if rule in (each, BOTH)]
    of_rule = {
        each: message_load(given, links, each, method=method, over=swept, **drawn).between(first, last)
        for each in {*wanted, NAIVE}  # naive loads are the numbers of messages
    }
    loads = tuple(of_rule[each] for each in wanted)
    loads[0].mean(whose)  # a request that cannot be met should say so before longer work
    chosen = metric_of(shown.metric or given.metric or "trace", given.model)
    asked = {"metric": chosen, "quantity": shown.quantity or "actual", "agent": whose, "method": method}
    accuracies = tuple(accuracy_of(each, links, **asked, **drawn, **averaged) for each in loads if shown.accuracy)
    in_bytes = (shown.header or 0) if shown.bytes or shown.header is not None else None
    view = reports.LoadView(loads, of_rule[NAIVE], kind, whose, in_bytes, accuracies, chosen, to.digits)
    _note(loads, accuracies)
    to.write(reports.load_report(view))


def _by_protocol(
    asked: tuple[Scenario, list[float] | None],
    window: tuple[int | None, int | None],
    agent: str,
    shown: LoadOptions,
    outcomes: OutcomeOptions,
    to: Written,
) -> None:
    """What live agents send, and what it is worth to them."""
    from stochfuse.data.protocols import protocol_load
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.report.protocols import ProtocolView, protocol_report

    given, links = asked
    names = [name.strip() for name in (shown.protocol or "").split(",")]
    drawn = settings_for([MONTE_CARLO], runs=outcomes.runs, seed=outcomes.seed)
    first, last = _window(given.network.steps, *window)
    rule = given.estimator or LFG
    found = protocol_load(given, links, names, estimator=rule, missing=shown.missing or MISSING[0], **drawn)
    chosen = metric_of(shown.metric or given.metric or "trace", given.model) if shown.accuracy else None
    view = ProtocolView(
        found.between(first, last), whole(agent) or agent, chosen, shown.quantity or "actual", to.digits
    )
    to.write(protocol_report(view))


def _kind(**wanted: bool) -> str:
    chosen = [name for name, value in wanted.items() if value]
    if len(chosen) > 1:
        raise UsageError(f"--{chosen[1]}: expected without --{chosen[0]}, one of them at a time")
    return chosen[0] if chosen else "moments"


def _window(steps: int, from_step: int | None, step: int | None) -> tuple[int, int]:
    if step is not None and from_step is not None:
        raise UsageError("--step: expected without --from-step, one of them at a time")
    for flag, value in (("--step", step), ("--from-step", from_step)):
        if value is not None and value > steps:
            raise UsageError(f"{flag}: expected a step from 1 to {steps} (see --steps), got {value}")
    return (step, step) if step is not None else (from_step or 1, steps)


def _note(loads: tuple[Load, ...], accuracies: tuple[Any, ...]) -> None:
    if any(each.runs is not None for each in loads):
        tell(["note: the maximum of a sample is no bound; larger loads may be possible"])
    tell(f"note: accuracy of {each.load.rule}: {note}" for each in accuracies for note in each.prediction.notes)
