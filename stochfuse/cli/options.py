"""Options that several commands share, and how their texts become values."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.progress import quiet

if TYPE_CHECKING:
    from stochfuse.report.table import Table
    from stochfuse.scenario.scenario import Scenario

MOST_LINKS = 1_000_000


class Format(StrEnum):
    """Output formats."""

    table = "table"
    csv = "csv"
    json = "json"
    markdown = "markdown"
    latex = "latex"


class Estimator(StrEnum):
    """What the agents do with what arrives."""

    local_fusion_graph = "local-fusion-graph"
    naive = "naive"
    optimal = "optimal"
    covariance_intersection = "covariance-intersection"
    split_ci = "split-ci"
    blender = "blender"
    joint_blender = "joint-blender"
    equivalent_measurement = "equivalent-measurement"
    independent_measurements = "independent-measurements"
    lwin = "lwin"
    itns = "itns"
    stand_alone = "stand-alone"


class Criterion(StrEnum):
    """What the weights of an intersection minimise."""

    det = "det"
    trace = "trace"
    max_eig = "max-eig"


class Architecture(StrEnum):
    """Network architectures."""

    ad_hoc = "ad-hoc"
    broadcast = "broadcast"
    cyclic = "cyclic"


def complete_scenario(incomplete: str) -> list[str]:
    """Return the presets that begin so, for the shell."""
    from stochfuse.scenario.scenario import preset_names

    return [name for name in preset_names() if name.startswith(incomplete)]


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="TOML or JSON file, - for standard input, or a preset's name (see `stochfuse scenario list`).",
        autocompletion=complete_scenario,
    ),
]
OutputOption = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write there instead of to standard output.")
]
FormatOption = Annotated[
    Format | None,
    typer.Option("--format", "-f", help="Output format; default: table, or what the output file's name says."),
]


AgentsOption = Annotated[int | None, typer.Option(min=1, help="Number of agents.")]
StepsOption = Annotated[int | None, typer.Option(min=1, help="Number of time steps.")]
LinkOption = Annotated[
    str | None,
    typer.Option(metavar="SPEC", help="Link probabilities, for all links alike: 0.5, 0.2,0.5 or 0:1:0.25 (both ends)."),
]
QOption = Annotated[float | None, typer.Option(help="Process noise variance Q (times the identity).")]
ROption = Annotated[
    float | None, typer.Option(help="Measurement noise variance R (times the identity), of agents without their own.")
]
P0Option = Annotated[float | None, typer.Option(help="Variance of the initial estimates P(k0) (times the identity).")]
ArchitectureOption = Annotated[Architecture | None, typer.Option(help="Who may hear whom.")]
MetricOption = Annotated[
    str | None,
    typer.Option(
        help="trace, det, max-eig, var:STATE, std:STATE or rms:STATE,STATE; default: the scenario's, else trace."
    ),
]
AgentOption = Annotated[
    str | None,
    typer.Option(
        metavar="N",
        help="Whose covariance where agents differ: mean, worst, best or an agent's number; default: the scenario's, "
        "else mean.",
    ),
]
EstimatorOption = Annotated[
    Estimator | None,
    typer.Option(
        help="general, monte-carlo: what the agents do with what arrives; default: local-fusion-graph.",
        show_default=False,
    ),
]
MaxGraphsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="general, naive: different graphs that may be carried from step to step; default: 100000.",
        show_default=False,
    ),
]
PruneOption = Annotated[
    bool,
    typer.Option(
        "--prune", help="general, naive: beyond --max-graphs leave the least likely out, and say how likely they were."
    ),
]
RunsOption = Annotated[
    int | None,
    typer.Option(
        min=2,
        help="monte-carlo: independent runs per link probability; default: the scenario's, else 1000.",
        show_default=False,
    ),
]
SeedOption = Annotated[
    int | None,
    typer.Option(min=0, help="monte-carlo: seed of the random numbers; default: 1.", show_default=False),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="monte-carlo: processes; default: one for small samples, else one per processor."),
]
QuantityOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="claimed, actual, optimal, consistency (actual / claimed), bias or rms; several side by side: "
        "claimed,actual.",
    ),
]
DigitsOption = Annotated[int, typer.Option(min=1, max=17, help="Significant digits in tables.")]
CriterionOption = Annotated[
    Criterion | None,
    typer.Option(
        help="covariance-intersection, split-ci: what the weights minimise in each fusion; default: det.",
        show_default=False,
    ),
]
PlotOption = Annotated[Path | None, typer.Option(metavar="FILE", help="Also draw a figure: .png, .svg or .pdf.")]


def whose(agent: str | None, scenario: Scenario) -> int | str:
    """Return the agent asked for: a number, or mean, worst or best.

    Raises
    ------
    UsageError
        If there is no such agent.
    """
    from stochfuse.errors import UsageError

    chosen = (scenario.agent or "mean") if agent is None else int(agent) if agent.isdigit() else agent
    most = scenario.network.agents
    if chosen not in ("mean", "worst", "best") and not (isinstance(chosen, int) and 1 <= chosen <= most):
        raise UsageError(f"agent: expected mean, worst, best or a number from 1 to {most}, got '{agent}'")
    return chosen


def load(
    scenario: str,
    agents: int | None,
    steps: int | None,
    architecture: Architecture | None,
    q: float | None,
    r: float | None,
    p0: float | None,
    link: str | None,
) -> tuple[Scenario, list[float] | None]:
    """Return the scenario with the options' values in it, and the link probabilities asked for."""
    from stochfuse.scenario.scenario import load_scenario

    links = None if link is None else parse_link(link)
    given = load_scenario(
        scenario,
        agents=agents,
        steps=steps,
        architecture=architecture.value if architecture else None,
        q=q,
        r=r,
        p0=p0,
        uniform_link=links is not None,
    )
    return given, links


APPLIES_TO = {
    "estimator": ("general", "monte-carlo"),
    "max_graphs": ("general", "naive"),
    "prune": ("general", "naive"),
    "runs": ("monte-carlo",),
    "seed": ("monte-carlo",),
    "workers": ("monte-carlo",),
    "criterion": ("general", "monte-carlo"),
}
"""Methods that each setting means something to."""


def settings_for(methods: Sequence[str], **settings: Any) -> dict[str, Any]:
    """Return the settings that were given.

    Raises
    ------
    UsageError
        If none of the methods has any use for one of them.
    """
    from stochfuse.errors import UsageError

    given = {name: value for name, value in settings.items() if value is not None and value is not False}
    for name in given:
        if not set(APPLIES_TO[name]) & set(methods):
            option = "--" + name.replace("_", "-")
            raise UsageError(f"{option}: expected method {' or '.join(APPLIES_TO[name])}, got {', '.join(methods)}")
    return {name: value.value if isinstance(value, StrEnum) else value for name, value in given.items()}


def quantity_names(text: str) -> list[str]:
    """Return the quantities of `claimed` or `claimed,actual`.

    Raises
    ------
    UsageError
        If one is unknown or named twice.
    """
    from stochfuse.errors import UsageError
    from stochfuse.prediction.quantities import QUANTITIES

    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in QUANTITIES:
            raise UsageError(f"--quantity: expected one or several of {', '.join(QUANTITIES)}, got '{name}'")
    if len(set(names)) < len(names):
        raise UsageError(f"--quantity: expected different ones, got {text}")
    return names


BYTES = {"table": 1000, "markdown": 1000, "latex": 1000, "csv": 200, "json": 200}
"""Memory that a number takes on its way to the reader."""


def check_memory(scenario: Scenario, links: Sequence[float] | None, kind: str) -> None:
    """Raise UsageError, with an estimate, if the answer cannot be held in this machine's memory."""
    from stochfuse.errors import UsageError
    from stochfuse.scenario.scenario import link_rows

    steps, rows = scenario.network.steps, len(link_rows(scenario, links).link)
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
    from stochfuse.errors import UsageError
    from stochfuse.report.table import PLOT_SUFFIXES, check_writable

    check_writable(output)
    check_writable(plot, PLOT_SUFFIXES)
    if plot is not None and output is not None and plot.resolve() == output.resolve():
        raise UsageError(f"--output and --plot: expected different files, got {output} for both")
    for option, file in (("--output", output), ("--plot", plot)):
        for source in inputs:
            if file is not None and file.exists() and Path(source).exists() and file.samefile(source):
                raise UsageError(f"{option}: expected another file than the input {source}, which it would overwrite")


def parse_link(text: str) -> list[float]:
    """Return the link probabilities of `0.5`, `0.2,0.5` or `0:1:0.25` (both ends included).

    Raises
    ------
    UsageError
        If the text is none of these or a value is no probability.
    """
    from stochfuse.errors import UsageError

    values: list[float] = []
    for part in text.split(","):
        try:
            numbers = [float(piece) for piece in part.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            values += numbers
        elif len(numbers) == 3:
            values += _range(text, *numbers)
        else:
            raise UsageError(f"--link: expected 0.5, 0.2,0.5 or 0:1:0.25, got '{text}'")
    for value in values:
        if not 0 <= value <= 1:
            raise UsageError(f"--link: expected probabilities between 0 and 1, got {value:g}")
    return values


def _range(text: str, first: float, last: float, step: float) -> list[float]:
    from stochfuse.errors import UsageError

    if not (step > 0 and last >= first and first >= 0 and last <= 1):
        raise UsageError(f"--link: expected first:last:step with 0 ≤ first ≤ last ≤ 1 and step > 0, got '{text}'")
    count = (last - first) / step
    if count > MOST_LINKS:
        raise UsageError(f"--link: expected at most {MOST_LINKS} link probabilities, got {count:.3g} from '{text}'")
    values = [round(first + i * step, 12) for i in range(int(count + 1e-9) + 1)]
    return values if values[-1] >= last - 1e-12 else [*values, last]


def write_report(
    format: Format | None,
    output: Path | None,
    table: Callable[[], Table],
    csv: Callable[[], str],
    json: Callable[[], Any],
) -> None:
    """Write a report to standard output or a file, in the format asked for; only that one is made."""
    from stochfuse.report.table import render, terminal_width, to_json, write_text

    kind = chosen_format(format, output)
    if kind == Format.csv.value:
        text = csv()
    elif kind == Format.json.value:
        text = to_json(json())
    else:
        text = render(table(), kind, terminal_width())
    quiet()
    write_text(text, output)


def chosen_format(format: Format | None, output: Path | None) -> str:
    """Return the format asked for, else the one that the output's name suggests, else table."""
    if format is not None:
        return format.value
    from stochfuse.report.table import SUFFIXES

    return SUFFIXES.get(output.suffix.lower(), "table") if output else "table"
