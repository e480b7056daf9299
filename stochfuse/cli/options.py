"""Options that several commands share, each declared once, and how their texts become values.

A command names groups of options (`Changes`, `Settings`, `Written`, …) as its parameters; `gathered` lays them out as
single options for Typer and hands them on together.  `stochfuse.cli.help` shows them by panel; those marked rare only
under --help-all.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from functools import wraps
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer

from stochfuse.cli.progress import quiet
from stochfuse.errors import UsageError, nearest
from stochfuse.scenario import registry
from stochfuse.scenario.own_rules import estimators_named
from stochfuse.scenario.registry import (
    CONTROLS,
    CRITERIA,
    ESTIMATORS,
    GENERAL,
    METHODS,
    MONTE_CARLO,
    NAIVE,
    OPTIMAL,
    QUANTITIES,
)

if TYPE_CHECKING:
    from stochfuse.report.table import Report
    from stochfuse.scenario.over import Over
    from stochfuse.scenario.scenario import Scenario

SCENARIO, NETWORK, SHOWN, WORK, OUTPUT = "Scenario", "Network", "What is shown", "How it is worked out", "Output"
RARE = ", rarely used"
"""Ends a panel whose options `--help` leaves to `--help-all`."""
FORMATS = ("table", "csv", "json", "markdown", "latex")
ARCHITECTURES = ("ad-hoc", "broadcast", "cyclic")


def one_of(names: Sequence[str]) -> Callable[[str | None], str | None]:
    """Return what refuses a value that is none of the names, and says which is nearest."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in names:
            raise typer.BadParameter(f"expected one of {', '.join(names)}, got '{value}'{nearest(value, names)}")
        return value

    return check


def completed(names: Sequence[str] | Callable[[], Sequence[str]]) -> Callable[[str], list[str]]:
    """Return what the shell is told: the names that begin so, after the last comma."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        return [before + comma + name for name in (names() if callable(names) else names) if name.startswith(last)]

    return complete


def choice(names: Sequence[str], help: str, panel: str, *flags: str, **more: Any) -> Any:
    """An option that takes one of some names."""
    return typer.Option(
        *flags, help=help, rich_help_panel=panel, metavar="NAME", callback=one_of(names),
        autocompletion=completed(names), show_default=False, **more,
    )  # fmt: skip


def option(help: str, panel: str, *flags: str, **more: Any) -> Any:
    """An option in a panel."""
    return typer.Option(*flags, help=help, rich_help_panel=panel, **{"show_default": False, **more})


def presets() -> Sequence[str]:
    """Names of the presets."""
    from stochfuse.scenario.scenario import preset_names

    return preset_names()


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="TOML or JSON file, - for standard input, or a preset (stochfuse scenario list).",
        autocompletion=completed(presets),
    ),
]
OutputOption = Annotated[
    Path | None, option("Write there, not to standard output.", OUTPUT, "--output", "-o", metavar="FILE")
]
FormatOption = Annotated[
    str | None,
    choice(FORMATS, f"{', '.join(FORMATS)}; default: table, or by the name of --output.", OUTPUT, "--format", "-f"),
]
PlotOption = Annotated[Path | None, option("Also draw a figure: .png, .svg or .pdf.", OUTPUT, metavar="FILE")]
PageOption = Annotated[
    Path | None, option("A page to send: result, figure, what was asked: .html.", OUTPUT, metavar="FILE")
]
DigitsOption = Annotated[
    int, option("Significant digits in tables; default: 5.", OUTPUT + RARE, min=1, max=17, metavar="N")
]
WorkersOption = Annotated[
    int | None, option("monte-carlo: processes; default: by the size of the sample.", WORK + RARE, min=1, metavar="N")
]
ArchitectureName = Annotated[str, choice(ARCHITECTURES, f"Who may hear whom: {', '.join(ARCHITECTURES)}.", NETWORK)]


def named(text: str) -> tuple[str, ...]:
    """Return the estimators of `naive` or `naive,my_rules:Mine`; modules are looked for in the working folder too.

    Raises
    ------
    UsageError
        If one is unknown or named twice.
    """
    try:
        return estimators_named([name.strip() for name in text.split(",")], here=True)
    except UsageError as error:
        raise UsageError(f"--{error}") from None


def _one_named(text: str | None) -> str | None:
    return None if text is None else named(text.replace(",", " "))[0]


EstimatorOption = Annotated[
    str | None,
    option(
        "One of stochfuse methods, or module:Class (in this folder too); default: local-fusion-graph.",
        WORK, metavar="NAME", callback=_one_named, autocompletion=completed(ESTIMATORS),
    ),
]  # fmt: skip
MetricOption = Annotated[
    str | None,
    option(
        "trace, det, max-eig, var:STATE, std:STATE or rms:STATE,STATE; default: the scenario's, else trace.", SHOWN,
        metavar="NAME", autocompletion=completed([m.name.partition("STATE")[0] for m in registry.METRIC]),
    ),
]  # fmt: skip
AgentOption = Annotated[str | None, option("Whose: mean (the default), worst, best or a number.", SHOWN, metavar="N")]
QuantityOption = Annotated[
    str,
    option(
        f"{', '.join(QUANTITIES)}; several: claimed,actual; {registry.STATE} of measurements. Default: claimed.", SHOWN,
        metavar="NAME", autocompletion=completed((*QUANTITIES, registry.STATE)),
    ),
]  # fmt: skip


MethodOption = Annotated[
    str | None,
    choice(
        METHODS,
        f"How to average over what arrives: {', '.join(METHODS)}; default: the scenario's, else simplified.",
        WORK,
    ),
]
AtOption = Annotated[str | None, option("Only these steps: 1,5,10,last; default: all.", SHOWN, metavar="STEPS")]


def keys() -> Sequence[str]:
    """Keys of a scenario, as --over takes them."""
    from stochfuse.scenario.schema import ScenarioFile, key_paths

    return [f"{path}=" for path in key_paths(ScenarioFile)]


OverOption = Annotated[
    list[str] | None,
    option(
        "Sweep any number: network.delay=0:3:1; once or twice.", SCENARIO, "--over", metavar="KEY=SPEC",
        autocompletion=completed(keys),
    ),
]  # fmt: skip


class Changes(NamedTuple):
    """What options change in a scenario."""

    agents: Annotated[int | None, option("Number of agents.", NETWORK, min=1, metavar="N")] = None
    steps: Annotated[int | None, option("Number of time steps.", NETWORK, min=1, metavar="K")] = None
    link: Annotated[
        str | None,
        option("Link probability: 0.5, 0.2,0.5 or 0:1:0.25 (both ends).", NETWORK, metavar="SPEC"),
    ] = None
    architecture: Annotated[
        str | None, choice(ARCHITECTURES, f"Who may hear whom: {', '.join(ARCHITECTURES)}.", NETWORK)
    ] = None
    q: Annotated[float | None, option("Process noise variance Q (times the identity).", SCENARIO, metavar="X")] = None
    r: Annotated[
        float | None, option("Measurement noise variance R, of agents without their own.", SCENARIO, metavar="X")
    ] = None
    p0: Annotated[float | None, option("Variance of the first estimates P(k0).", SCENARIO, metavar="X")] = None

    def of(self, scenario: str) -> tuple[Scenario, list[float] | None]:
        """Return the scenario with the options' values in it, and the link probabilities asked for."""
        from stochfuse.scenario.scenario import load_scenario

        links = None if self.link is None else parse_link(self.link)
        changed = self._asdict() | {"link": None}
        changed.pop("link")
        return load_scenario(scenario, **changed, uniform_link=links is not None), links

    def over(self, texts: Sequence[str] | None, scenario: Scenario) -> Over | None:
        """Return the scenarios that --over makes of one; None without.

        Raises
        ------
        UsageError
            If an option sets what is swept, or the option is malformed.
        """
        if not texts:
            return None
        from stochfuse.scenario import over

        given = over_values(texts)
        self.check_unset(given)
        return over.over(scenario, given)

    def check_unset(self, keys: Iterable[str]) -> None:
        """Raise UsageError if an option sets one of some keys."""
        for key in keys:
            flag = next((flag for flag, place in PLACES.items() if place == key), None)
            if flag is not None and getattr(self, flag) is not None:
                raise UsageError(f"--over {key}: expected without --{flag}, which sets the same")


PLACES = {
    "agents": "network.agents",
    "steps": "network.steps",
    "link": "network.link",
    "q": "model.Q",
    "r": "model.R",
    "p0": "initial.P",
}
"""Keys that options of `Changes` set."""
MaxGraphsOption = Annotated[
    int | None, option("general: graphs carried from step to step; default: 100000.", WORK + RARE, min=1, metavar="N")
]


class Graphs(NamedTuple):
    """How many outcomes are carried where they are enumerated."""

    max_graphs: MaxGraphsOption = None
    prune: Annotated[
        bool,
        option("general: beyond --max-graphs leave out the least likely, and say how likely.", WORK + RARE, "--prune"),
    ] = False


class Sampling(NamedTuple):
    """How outcomes are sampled."""

    runs: Annotated[
        int | None, option("monte-carlo: runs per link probability; default: 1000.", WORK, min=2, metavar="N")
    ] = None
    seed: Annotated[
        int | None, option("monte-carlo: seed of the random numbers; default: 1.", WORK, min=0, metavar="N")
    ] = None


class Precisely(NamedTuple):
    """How exactly values are sampled."""

    precision: Annotated[
        str | None,
        option("Draw until every ± is below this share of its value: 0.2%.", WORK, metavar="P%"),
    ] = None
    at_most: Annotated[
        str | None, option("With --precision: stop after that time, 60s or 2min.", WORK + RARE, metavar="TIME")
    ] = None
    control: Annotated[
        str | None,
        choice(
            CONTROLS, "monte-carlo: control variate, optimum (where it helps) or none; default: optimum.", WORK + RARE
        ),
    ] = None


class Weighing(NamedTuple):
    """What only some engines and estimators have."""

    workers: WorkersOption = None
    criterion: Annotated[
        str | None,
        choice(
            CRITERIA, f"intersections: what the weights minimise, {', '.join(CRITERIA)}; default: det.", WORK + RARE
        ),
    ] = None


class Written(NamedTuple):
    """Where an answer goes, and how it looks."""

    format: FormatOption = None
    output: OutputOption = None
    plot: PlotOption = None
    digits: DigitsOption = 5

    @property
    def kind(self) -> str:
        """The format asked for, else the one that the output's name suggests, else table."""
        return chosen_format(self.format, self.output)

    def check(self, *inputs: str) -> None:
        """Raise UsageError early if a file can never be written, if two are one, or if one is an input."""
        check_files(self.output, self.plot, *inputs)

    def write(self, report: Report) -> None:
        """Write a report in the format asked for, and draw it where that is asked for."""
        if self.plot is not None and report.draw is not None:
            from stochfuse.report.plot import save

            save(report.draw, self.plot)
        write_report(report, self.kind, self.output)


class Reported(NamedTuple):
    """Where the page goes that can be sent."""

    report: PageOption = None

    def check(self, *others: Path | str | None) -> None:
        """Raise UsageError early if the page can never be written, or is one of the other files."""
        check_page(self.report, *others)

    def write(self, report: Report, scenario: Mapping[str, Any], said: Sequence[str] = ()) -> None:
        """Write the page, where it is asked for; with the words of the command line and what was said beside it."""
        if self.report is None:
            return
        from stochfuse.report.document import DocumentNote, document
        from stochfuse.report.table import write_text

        write_text(document(report, DocumentNote(WORDS.get(), scenario, tuple(said))), self.report)


WORDS: ContextVar[tuple[str, ...]] = ContextVar("WORDS", default=())
"""Words of the command line, without the program's name."""


def tell(lines: Iterable[str]) -> list[str]:
    """Write lines to standard error, each once, and return them."""
    told = list(dict.fromkeys(lines))
    for line in told:
        typer.echo(line, err=True)
    return told


def gathered(command: Callable[..., None]) -> Callable[..., None]:
    """Lay out a command's groups of options as single ones, in the order of its parameters."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {
        name: kind for name, kind in hints.items() if isinstance(kind, type) and issubclass(kind, tuple)
    }
    parameters = []
    for parameter in inspect.signature(command).parameters.values():
        kind = groups.get(parameter.name)
        if kind is None:
            parameters.append(parameter.replace(annotation=hints[parameter.name], kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        fields = get_type_hints(kind, include_extras=True)
        parameters += [
            inspect.Parameter(
                field, inspect.Parameter.KEYWORD_ONLY, default=kind._field_defaults[field], annotation=fields[field]
            )
            for field in kind._fields
        ]

    @wraps(command)
    def laid_out(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(*(given.pop(field) for field in kind._fields))
        command(**given)

    laid_out.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    laid_out.__annotations__ = {}
    del laid_out.__wrapped__
    return laid_out


def whole(text: str) -> int | None:
    """Return the whole number that a text is; None if it is none (superscripts are digits too), or a huge one."""
    return int(text) if text.isdecimal() and len(text) < 19 else None


def whose(agent: str | None, scenario: Scenario) -> int | str:
    """Return the agent asked for: a number, or mean, worst or best.

    Raises
    ------
    UsageError
        If there is no such agent.
    """
    chosen = (scenario.agent or "mean") if agent is None else whole(agent) or agent
    most = scenario.network.agents
    if chosen not in ("mean", "worst", "best") and not (isinstance(chosen, int) and 1 <= chosen <= most):
        raise UsageError(f"agent: expected mean, worst, best or a number from 1 to {most}, got '{agent}'")
    return chosen


SAMPLED, LISTED, BOTH = (MONTE_CARLO,), (GENERAL, NAIVE), (GENERAL, MONTE_CARLO)
APPLIES_TO = {
    "estimator": BOTH,
    "max_graphs": LISTED,
    "prune": LISTED,
    "runs": SAMPLED,
    "seed": SAMPLED,
    "workers": SAMPLED,
    "precision": SAMPLED,
    "at_most": SAMPLED,
    "control": SAMPLED,
    "criterion": BOTH,
}
"""Methods that each setting means something to; the optimum of many unlike agents is sampled too."""


def settings_for(methods: Sequence[str], **settings: Any) -> dict[str, Any]:
    """Return the settings that were given.

    Raises
    ------
    UsageError
        If none of the methods has any use for one of them.
    """
    given = {name: value for name, value in settings.items() if value is not None and value is not False}
    for name in given:
        also = {OPTIMAL} if name in ("runs", "seed", "workers") else set()
        if not (also | set(APPLIES_TO[name])) & set(methods):
            option = "--" + name.replace("_", "-")
            raise UsageError(f"{option}: expected method {' or '.join(APPLIES_TO[name])}, got {', '.join(methods)}")
    return given


def steps_at(text: str | None, scenario: Scenario) -> tuple[int, ...] | None:
    """Return the steps of `1,5,10,last`, in order; None for all.

    Raises
    ------
    UsageError
        If one is no step of the scenario.
    """
    if text is None:
        return None
    last, found = scenario.network.steps, set()
    for word in text.split(","):
        step = last if word.strip() == "last" else whole(word.strip()) or 0
        if not 1 <= step <= last:
            raise UsageError(f"--at: expected steps from 1 to {last}, or last, got '{word.strip()}'")
        found.add(step)
    return tuple(sorted(found))


def quantity_names(text: str) -> list[str]:
    """Return the quantities of `claimed` or `claimed,actual`.

    Raises
    ------
    UsageError
        If one is unknown or named twice.
    """
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            if name == registry.STATE:
                raise UsageError(f"--quantity: expected {name} by itself, and of predict, got {text}")
            raise UsageError(f"--quantity: expected one or several of {known}, got '{name}'{nearest(name, QUANTITIES)}")
    if len(set(names)) < len(names):
        raise UsageError(f"--quantity: expected different ones, got {text}")
    return names


def pairs(flag: str, text: str | None) -> dict[str, str]:
    """Return the names of `OURS=THEIRS,OURS=THEIRS`.

    Raises
    ------
    UsageError
        If a part is no such pair.
    """
    found = {}
    for part in text.split(",") if text else ():
        ours, equals, theirs = part.partition("=")
        if not equals:
            raise UsageError(f"{flag}: expected OURS=THEIRS, got '{part}'")
        found[ours.strip()] = theirs.strip()
    return found


BYTES = {"table": 1000, "markdown": 1000, "latex": 1000, "csv": 200, "json": 200}
"""Memory that a number takes on its way to the reader."""


def check_memory(scenario: Scenario, links: Sequence[float] | None, kind: str, points: int = 1) -> None:
    """Raise UsageError, with an estimate, if the answer cannot be held in this machine's memory."""
    from stochfuse.scenario.scenario import link_rows

    steps, rows = scenario.network.steps, points * len(link_rows(scenario, links).link)
    needed = rows * steps * (BYTES[kind] + 24 * scenario.model.dimension**2)
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        more = "" if BYTES[kind] < BYTES["table"] else ", or --format csv"
        raise UsageError(
            f"--steps: {steps:,} steps of {rows:,} link probabilities take about {needed / 1e9:,.0f} GB of memory, and "
            f"this machine has {there / 1e9:,.0f}; expected fewer of them{more}"
        )


def check_files(output: Path | None, plot: Path | None, *inputs: str) -> None:
    """Raise UsageError early if a file can never be written, if two are one, or if one is an input."""
    from stochfuse.report.table import PLOT_SUFFIXES, check_writable

    check_writable(output)
    check_writable(plot, PLOT_SUFFIXES)
    if plot is not None and output is not None and plot.resolve() == output.resolve():
        raise UsageError(f"--output and --plot: expected different files, got {output} for both")
    for option, file in (("--output", output), ("--plot", plot)):
        for source in inputs:
            if file is not None and file.exists() and Path(source).exists() and file.samefile(source):
                raise UsageError(f"{option}: expected another file than the input {source}, which it would overwrite")


def check_page(page: Path | None, *others: Path | str | None) -> None:
    """Raise UsageError early if a page can never be written, or is one of the other files."""
    from stochfuse.report.table import check_writable

    check_writable(page, (".html", ".htm"))
    for other in others if page is not None else ():
        if other is not None and page is not None and page.resolve() == Path(other).resolve():
            raise UsageError(f"--report: expected another file than {other}, which it would overwrite")


def parse_link(text: str) -> list[float]:
    """Return the link probabilities of `0.5`, `0.2,0.5` or `0:1:0.25` (both ends included).

    Raises
    ------
    UsageError
        If the text is none of these or a value is no probability.
    """
    from stochfuse.scenario.over import numbers_of

    values = [float(value) for value in numbers_of("--link", text, 0.0, 1.0)]
    for value in values:
        if not 0 <= value <= 1:
            raise UsageError(f"--link: expected probabilities between 0 and 1, got {value:g}")
    return values


def over_values(texts: Sequence[str]) -> dict[str, list[float]]:
    """Return the values by key of `network.delay=0:3:1`, each as --link takes them, but any numbers.

    Raises
    ------
    UsageError
        If a text is malformed, there are more than two, or a key is named twice.
    """
    from stochfuse.scenario.over import MOST_KEYS, numbers_of

    if len(texts) > MOST_KEYS:
        raise UsageError(f"--over: expected it once or twice, got it {len(texts)} times; for more see stochfuse study")
    found: dict[str, list[float]] = {}
    for text in texts:
        key, spec = _key_and(text, "KEY=SPEC such as network.delay=0:3:1 or model.R=50,100")
        if key in found:
            raise UsageError(f"--over: expected different keys, got {key} twice")
        found[key] = numbers_of(f"--over {key}", spec)
        if not all(map(isfinite, found[key])):
            raise UsageError(f"--over {key}: expected finite numbers, got '{spec}'")
    return found


def over_ends(texts: Sequence[str]) -> tuple[str, tuple[float, float]]:
    """Return the key and the ends of `network.delay=0:10`.

    Raises
    ------
    UsageError
        If the text is malformed, or there are several.
    """
    from stochfuse.scenario.over import number

    if len(texts) > 1:
        raise UsageError(f"--over: expected it once with --target, got it {len(texts)} times")
    expected = "KEY=LO:HI such as model.R=50:200"
    key, spec = _key_and(texts[0], expected)
    try:
        low, high = map(number, spec.split(":"))
    except ValueError:
        raise UsageError(f"--over: expected {expected}, got '{texts[0]}'") from None
    if not -inf < low < high < inf:
        raise UsageError(f"--over {key}: expected LO:HI with LO < HI, got '{spec}'")
    return key, (low, high)


def _key_and(text: str, expected: str) -> tuple[str, str]:
    key, _, spec = (part.strip() for part in text.partition("="))
    if not key or not spec:
        raise UsageError(f"--over: expected {expected}, got '{text}'")
    return key, spec


def write_report(report: Report, kind: str, output: Path | None) -> None:
    """Write a report to standard output or a file, in one format."""
    from stochfuse.report.table import render, terminal_width, to_json, write_text

    if kind == "csv":
        text = report.csv()
    elif kind == "json":
        text = to_json(report.json())
    else:
        text = render(report.table(), kind, terminal_width())
    quiet()
    write_text(text, output)


def chosen_format(format: str | None, output: Path | None) -> str:
    """Return the format asked for, else the one that the output's name suggests, else table."""
    if format is not None:
        return format
    from stochfuse.report.table import SUFFIXES

    return SUFFIXES.get(output.suffix.lower(), "table") if output else "table"
