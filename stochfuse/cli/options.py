"""Options that several commands share, and how their texts become values."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

MOST_LINKS = 1_000_000


class Format(StrEnum):
    """Output formats."""

    table = "table"
    csv = "csv"
    json = "json"
    markdown = "markdown"
    latex = "latex"


class Architecture(StrEnum):
    """Network architectures."""

    ad_hoc = "ad-hoc"
    broadcast = "broadcast"
    cyclic = "cyclic"


def complete_scenario(incomplete: str) -> list[str]:
    """Return the presets that begin so, for the shell."""
    from stochfuse.scenario import preset_names

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


def chosen_format(format: Format | None, output: Path | None) -> str:
    """Return the format asked for, else the one that the output's name suggests, else table."""
    if format is not None:
        return format.value
    from stochfuse.report.export import SUFFIXES

    return SUFFIXES.get(output.suffix.lower(), "table") if output else "table"
