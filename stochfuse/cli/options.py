"""Options that several commands share, each declared once.

A command names groups of options (`Changes`, `Averaging`, `Written`, …) as its parameters; `gathered` lays them out as
single options for Typer and hands them on together.  `stochfuse.cli.help` shows them by panel; those marked rare only
under --help-all.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from stochfuse.cli.progress import quiet
from stochfuse.cli.values import check_files, check_memory, named, over_values, parse_link, settings_for, tell
from stochfuse.errors import UsageError, nearest
from stochfuse.scenario import registry
from stochfuse.scenario.registry import CONTROLS, CRITERIA, ESTIMATORS, METHODS, QUANTITIES

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
ARCHITECTURE = choice(ARCHITECTURES, f"Who may hear whom: {', '.join(ARCHITECTURES)}.", NETWORK)


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
AgentOption = Annotated[
    str | None, option("Whose: mean (the default), worst, best, a number or a name.", SHOWN, metavar="N")
]
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


@dataclass(frozen=True)
class Changes:
    """What options change in a scenario."""

    agents: Annotated[int | None, option("Number of agents.", NETWORK, min=1, metavar="N")] = None
    steps: Annotated[int | None, option("Number of time steps.", NETWORK, min=1, metavar="K")] = None
    link: Annotated[
        str | None, option("Link probability: 0.5, 0.2,0.5 or 0:1:0.25 (both ends).", NETWORK, metavar="SPEC")
    ] = None
    architecture: Annotated[str | None, ARCHITECTURE] = None
    q: Annotated[float | None, option("Process noise variance Q (times the identity).", SCENARIO, metavar="X")] = None
    r: Annotated[
        float | None, option("Measurement noise variance R, of agents without their own.", SCENARIO, metavar="X")
    ] = None
    p0: Annotated[float | None, option("Variance of the first estimates P(k0).", SCENARIO, metavar="X")] = None

    def of(self, scenario: str) -> tuple[Scenario, list[float] | None]:
        """Return the scenario with the options' values in it, and the link probabilities asked for."""
        from stochfuse.scenario.scenario import load_scenario

        links = None if self.link is None else parse_link(self.link)
        changed = {key: value for key, value in vars(self).items() if key != "link"}
        given = load_scenario(scenario, **changed, uniform_link=links is not None)
        tell([f"note: --link takes the place of the scenario's own links: {given.replaced}"] if given.replaced else [])
        return given, links

    def swept(
        self, scenario: str, texts: Sequence[str] | None, kind: str
    ) -> tuple[Scenario, list[float] | None, Over | None]:
        """Return the same of what --over sweeps: the longest of its scenarios, the links, and the sweep, if any.

        Raises
        ------
        UsageError
            If an option sets what is swept, the option is malformed, or the answer in a format (`kind`) does not fit
            into memory.
        """
        given, links = self.of(scenario)
        if not texts:
            check_memory(given, links, kind)
            return given, links, None
        from stochfuse.scenario import over

        values = over_values(texts)
        self.check_unset(values)
        swept = over.over(given, values)
        check_memory(swept.longest, links, kind, len(swept.points))
        return swept.longest, links, swept

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


@dataclass(frozen=True)
class OutcomeOptions:
    """How outcomes are listed or drawn."""

    runs: Annotated[
        int | None, option("monte-carlo: runs per link probability; default: 1000.", WORK, min=2, metavar="N")
    ] = None
    seed: Annotated[
        int | None, option("monte-carlo: seed of the random numbers; default: 1.", WORK, min=0, metavar="N")
    ] = None
    max_graphs: MaxGraphsOption = None
    prune: Annotated[
        bool,
        option("general: beyond --max-graphs leave out the least likely, and say how likely.", WORK + RARE, "--prune"),
    ] = False

    def settings(self, methods: Sequence[str], **more: Any) -> dict[str, Any]:
        """Return what was given, and more settings; see `settings_for`."""
        return settings_for(methods, **more, **vars(self))


@dataclass(frozen=True)
class Averaging(OutcomeOptions):
    """How chance is averaged: outcomes, and what only some engines and estimators have."""

    precision: Annotated[
        str | None, option("Draw until every ± is below this share of its value: 0.2%.", WORK, metavar="P%")
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
    workers: WorkersOption = None
    criterion: Annotated[
        str | None,
        choice(
            CRITERIA, f"intersections: what the weights minimise, {', '.join(CRITERIA)}; default: det.", WORK + RARE
        ),
    ] = None


@dataclass(frozen=True)
class Listed:
    """Where a list goes, and in which format."""

    format: FormatOption = None
    output: OutputOption = None

    @property
    def target(self) -> Path | None:
        """Where the answer goes; None is standard output."""
        return self.output

    @property
    def kind(self) -> str:
        """The format asked for, else the one that the target's name suggests, else table."""
        from stochfuse.report.table import SUFFIXES

        return self.format or (SUFFIXES.get(self.target.suffix.lower(), "table") if self.target else "table")

    def check(self, *inputs: str | None) -> None:
        """Raise UsageError early if a file can never be written, if two are one, or if one is an input."""
        check_files(inputs, self.output)

    def write(self, report: Report) -> None:
        """Write a report in the format asked for."""
        from stochfuse.report.table import render, terminal_width, to_json, write_text

        if self.kind == "csv":
            text = report.csv()
        elif self.kind == "json":
            text = to_json(report.json())
        else:
            text = render(report.table(), self.kind, terminal_width())
        quiet()
        write_text(text, self.target)


@dataclass(frozen=True)
class Written(Listed):
    """Where an answer goes, and how it looks."""

    plot: PlotOption = None
    digits: DigitsOption = 5

    def check(self, *inputs: str | None) -> None:
        """See `Listed.check`."""
        check_files(inputs, self.output, self.plot)

    def write(self, report: Report) -> None:
        """Write a report in the format asked for, and draw it where that is asked for."""
        if self.plot is not None and report.draw is not None:
            from stochfuse.report.plot import save

            save(report.draw, self.plot)
        super().write(report)


@dataclass(frozen=True)
class Reported(Written):
    """The same, and a page that can be sent."""

    report: PageOption = None

    def check(self, *inputs: str | None) -> None:
        """See `Listed.check`."""
        check_files(inputs, self.output, self.plot, self.report)

    def send(self, report: Report, scenario: Mapping[str, Any], said: Sequence[str] = ()) -> None:
        """Write the page, where it is asked for; with the words of the command line and what was said beside it."""
        if self.report is None:
            return
        from stochfuse.report.document import DocumentNote, document
        from stochfuse.report.table import write_text

        write_text(document(report, DocumentNote(WORDS.get(), scenario, tuple(said))), self.report)


@dataclass(frozen=True)
class Beside(Reported):
    """The same where --output is for something else than the answer, which goes to standard output."""

    format: Annotated[
        str | None, choice(FORMATS, f"{', '.join(FORMATS)}; default: table.", OUTPUT, "--format", "-f")
    ] = None

    @property
    def target(self) -> None:
        """Standard output."""
        return


WORDS: ContextVar[tuple[str, ...]] = ContextVar("WORDS", default=())
"""Words of the command line, without the program's name."""


def gathered(command: Callable[..., None]) -> Callable[..., None]:
    """Lay out a command's groups of options as single ones, in the order of its parameters."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters = []
    for parameter in inspect.signature(command).parameters.values():
        kind = groups.get(parameter.name)
        if kind is None:
            parameters.append(parameter.replace(annotation=hints[parameter.name], kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        given = get_type_hints(kind, include_extras=True)
        parameters += [
            inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=given[field.name]
            )
            for field in fields(kind)
        ]

    @wraps(command)
    def laid_out(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(*(given.pop(field.name) for field in fields(kind)))
        command(**given)

    laid_out.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    laid_out.__annotations__ = {}
    del laid_out.__wrapped__
    return laid_out
