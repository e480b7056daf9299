"""How texts of options become values, and what is refused before any work: one line that says what was expected."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from stochfuse.errors import UsageError, nearest
from stochfuse.scenario import registry
from stochfuse.scenario.own_rules import estimators_named
from stochfuse.scenario.registry import GENERAL, MONTE_CARLO, NAIVE, OPTIMAL, QUANTITIES

if TYPE_CHECKING:
    from stochfuse.scenario.scenario import Scenario


def named(text: str) -> tuple[str, ...]:
    """Return the estimators of `naive` or `naive,my_rules:Mine`; modules are looked for in the working folder too.

    Raises
    ------
    UsageError
        If one is unknown or named twice.
    """
    with options_for("estimator"):
        return estimators_named([name.strip() for name in text.split(",")], here=True)


@contextmanager
def options_for(*names: str) -> Iterator[None]:
    """Let errors about parameters of those names speak of options: `initial_error:` becomes `--initial-error:`."""
    try:
        yield
    except UsageError as error:
        name = next((name for name in names if str(error).startswith((f"{name}:", f"{name} "))), None)
        if name is None:
            raise
        raise UsageError(f"--{name.replace('_', '-')}{str(error).removeprefix(name)}") from None


def tell(lines: Iterable[str]) -> list[str]:
    """Write lines to standard error, each once, and return them."""
    told = list(dict.fromkeys(lines))
    for line in told:
        typer.echo(line, err=True)
    return told


def whole(text: str) -> int | None:
    """Return the whole number that a text is; None if it is none (superscripts are digits too), or a huge one."""
    return int(text) if text.isdecimal() and len(text) < 19 else None


def whose(agent: str | None, scenario: Scenario) -> int | str:
    """Return the agent asked for: its number, where it is given by number or by name, or mean, worst or best.

    Raises
    ------
    UsageError
        If there is no such agent.
    """
    return scenario.network.agent((scenario.agent or "mean") if agent is None else whole(agent) or agent)


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


def renamed(text: str | None, expected: str = "OURS=THEIRS such as covariance=P_trace,link=mu") -> dict[str, str]:
    """Return the columns of `covariance=P_trace,link=mu`; what follows a comma without = belongs to the name before.

    Raises
    ------
    UsageError
        If a pair is malformed or a column is named twice.
    """
    parts: list[str] = []
    for part in text.split(",") if text else ():
        # covariance:rms:x,y=P_rms has a comma of its own
        if parts and "=" not in parts[-1]:
            parts[-1] += f",{part}"
        else:
            parts.append(part)
    return named_once("--columns", parts, expected, "different columns")


def named_once(flag: str, texts: Iterable[str], expected: str, once: str) -> dict[str, str]:
    """Return what stands behind the = of each text, by what stands before it.

    Raises
    ------
    UsageError
        If one is no such pair, or a name is given twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        ours, _, theirs = (word.strip() for word in text.partition("="))
        if not ours or not theirs:
            raise UsageError(f"{flag}: expected {expected}, got '{text.strip()}'")
        if ours in found:
            raise UsageError(f"{flag}: expected {once}, got {ours} twice")
        found[ours] = theirs
    return found


def refuse(given: Mapping[str, Any], expected: str) -> None:
    """Raise UsageError at the first option that is given where it means nothing: None, False and [] are not given."""
    for flag, value in given.items():
        if value is not None and value is not False and value != []:
            raise UsageError(f"{flag}: expected {expected}")


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


def check_files(
    inputs: Iterable[str | None], output: Path | None = None, plot: Path | None = None, page: Path | None = None
) -> None:
    """Raise UsageError early if a file can never be written, if two are one, or if one is an input."""
    from stochfuse.report.table import PLOT_SUFFIXES, check_writable

    check_writable(output)
    check_writable(plot, PLOT_SUFFIXES)
    check_writable(page, (".html", ".htm"))
    if plot is not None and output is not None and plot.resolve() == output.resolve():
        raise UsageError(f"--output and --plot: expected different files, got {output} for both")
    for other in (output, plot):
        if page is not None and other is not None and page.resolve() == other.resolve():
            raise UsageError(f"--report: expected another file than {other}, which it would overwrite")
    for option, file in (("--output", output), ("--plot", plot), ("--report", page)):
        for source in inputs:
            if file and source and file.exists() and Path(source).exists() and file.samefile(source):
                raise UsageError(f"{option}: expected another file than the input {source}, which it would overwrite")


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
    expected = "KEY=SPEC such as network.delay=0:3:1 or model.R=50,100"
    for key, spec in named_once("--over", texts, expected, "different keys").items():
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
    ((key, spec),) = named_once("--over", texts, expected, "one").items()
    try:
        low, high = map(number, spec.split(":"))
    except ValueError:
        raise UsageError(f"--over: expected {expected}, got '{texts[0]}'") from None
    if not -inf < low < high < inf:
        raise UsageError(f"--over {key}: expected LO:HI with LO < HI, got '{spec}'")
    return key, (low, high)
