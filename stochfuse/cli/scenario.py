"""`stochfuse scenario`: list, show, check, schema, new."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from stochfuse.cli.help import Command
from stochfuse.cli.options import (
    ARCHITECTURES,
    NETWORK,
    OUTPUT,
    SCENARIO,
    Listed,
    OutputOption,
    ScenarioArgument,
    choice,
    completed,
    gathered,
    one_of,
    option,
    presets,
)
from stochfuse.cli.progress import quiet
from stochfuse.errors import UsageError, nearest

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="The scenarios: list, show, check, schema, new.",
)

MODELS = ("random-walk", "constant-velocity")
NEW_HEADER = """\
# A stochfuse scenario.  `stochfuse scenario check FILE` says what does not fit; `stochfuse scenario schema` lists keys.
# Predict with: stochfuse predict FILE
"""


TEMPLATE = """\
schema = "stochfuse.scenario/1"
description = "{what}"

[model]                     # what all agents track: x(k) = F x(k-1) + w with covariance Q; z(k) = H x(k) + v with R
states = {states}
units = {units}
F = {F}
{G}Q = {Q}
H = {H}
R = {R}

[initial]
P = {P}
# correlation = "shared"    # where all agents begin with one common estimate

[network]
agents = {agents}
steps = {steps}
architecture = "{architecture}"     # a message may reach some, not others; "broadcast": all or none; "cyclic": a ring
{link}                # probability that a message arrives; left out, a table over µ = 0 to 1
# delay = [0.7, 0.3]        # probabilities of arriving in the same step, one later, ...

# [[agent]]                 # one table for each agent, where they differ
# R = 100
# sensor = false
"""


def list_presets(to: Listed = Listed()) -> None:
    """List the presets."""
    from stochfuse.report.table import Report
    from stochfuse.scenario.scenario import load_scenario, preset_names

    keys = ("name", "agents", "steps", "states", "description")
    entries = []
    for name in preset_names():
        s = load_scenario(name)
        entries.append((name, s.network.agents, s.network.steps, ", ".join(s.model.states), s.source["description"]))
    to.write(Report.of_rows(("Presets",), keys, entries, [dict(zip(keys, entry, strict=True)) for entry in entries]))


def show(
    scenario: ScenarioArgument = "thesis-transient",
    as_json: Annotated[bool, option("As JSON.", OUTPUT, "--json")] = False,
    output: OutputOption = None,
) -> None:
    """Print a scenario, after checking it, in a form that can be saved and edited."""
    from stochfuse.report.table import to_json, write_text
    from stochfuse.scenario.scenario import Scenario, folder_of, parse, read_text

    name, text = read_text(scenario)
    checked = Scenario.from_mapping(parse(name, text), name, folder_of(scenario))
    write_text(to_json(checked.to_mapping()) if as_json else text, output)


def check(scenario: ScenarioArgument) -> None:
    """Check a scenario: name every key that does not fit, exit 2, or say what it describes."""
    from stochfuse.scenario.scenario import checked_scenario

    s = checked_scenario(scenario)
    n = s.network.agents
    kinds = f" with {len(s.sensors)} kinds of sensors" if len(s.sensors) > 1 else ""
    typer.echo(
        f"{s.name}: ok: {n} agent{'s' * (n > 1)}{kinds}, {s.network.architecture}, {s.network.steps} steps, "
        f"state ({', '.join(s.model.states)})"
    )


def schema(
    study: Annotated[bool, option("Of a study file, see `stochfuse study`.", OUTPUT, "--study")] = False,
    output: OutputOption = None,
) -> None:
    """Print the JSON Schema of a scenario file."""
    from stochfuse.report.table import to_json, write_text
    from stochfuse.scenario.schema import ScenarioFile
    from stochfuse.studies.plan import StudyFile

    structure = StudyFile if study else ScenarioFile
    write_text(to_json(structure.model_json_schema(by_alias=True)), output)


@dataclass(frozen=True)
class Described:
    """What a new scenario is about."""

    model: Annotated[
        str | None, choice(MODELS, f"What moves: {' or '.join(MODELS)}; default: random-walk.", SCENARIO)
    ] = None
    axes: Annotated[
        int | None, option("Directions in which it moves; default: 1.", SCENARIO, min=1, max=3, metavar="N")
    ] = None
    noise: Annotated[
        float | None,
        option("Standard deviation of what disturbs it in a step; default: 1.", SCENARIO, min=0.0, metavar="X"),
    ] = None
    sigma: Annotated[
        float | None, option("Standard deviation of a measurement; default: 10.", SCENARIO, min=0.0, metavar="X")
    ] = None
    unit: Annotated[str | None, option("Unit of a position; default: m.", SCENARIO, metavar="U")] = None
    agents: Annotated[int | None, option("Number of agents; default: 3.", NETWORK, min=1, metavar="N")] = None
    steps: Annotated[int | None, option("Number of time steps; default: 10.", NETWORK, min=1, metavar="K")] = None
    link: Annotated[
        float | None,
        option("Link probability; default: none, a table over all.", NETWORK, min=0.0, max=1.0, metavar="P"),
    ] = None
    architecture: Annotated[
        str | None, choice(ARCHITECTURES, f"Who may hear whom: {', '.join(ARCHITECTURES)}; default: ad-hoc.", NETWORK)
    ] = None


def new(
    preset: Annotated[
        str | None,
        typer.Argument(metavar="PRESET", help="A preset to begin with instead.", autocompletion=completed(presets)),
    ] = None,
    described: Described = Described(),
    output: OutputOption = None,
) -> None:
    """Print a commented scenario file to begin with; --output saves it and never overwrites.

    With options: a scenario of that kind. Without any, in a terminal: asks a few questions; else a copy of cv-2d.
    """
    from stochfuse.report.table import check_writable, write_text
    from stochfuse.scenario.scenario import is_preset, preset_names, read_text

    given = {key: value for key, value in vars(described).items() if value is not None}
    if preset is not None and given:
        raise UsageError(f"--{next(iter(given))}: expected no preset with it, got '{preset}'")
    if preset is not None and not is_preset(preset):
        known = preset_names()
        raise UsageError(f"no preset '{preset}'; the presets are {', '.join(known)}{nearest(preset, known)}")
    check_writable(output)
    if output is not None and output.suffix.lower() == ".json":
        raise UsageError(f"{output}: a new scenario is TOML, with comments; give a name that ends in .toml")
    if output is not None and output.exists():
        raise UsageError(f"{output} exists already")
    if preset is None and not given and sys.stdin.isatty() and sys.stderr.isatty():
        quiet()
        given = _answers()
    text = _written(**given) if given else read_text(preset or "cv-2d")[1]
    write_text(NEW_HEADER + text, output)


def _answers() -> dict[str, Any]:
    """Ask what a new scenario is about."""

    def ask(what: str, default: Any, **more: Any) -> Any:
        return typer.prompt(what, default=default, err=True, **more)

    model = ask("What moves: random-walk (a position), constant-velocity", MODELS[0], value_proc=_one_of_models)
    found = {"model": model, "axes": ask("In how many directions (1 to 3)", 1, type=int)}
    found |= {"unit": ask("Unit of a position", "m"), "sigma": ask("Standard deviation of a measurement", 10.0)}
    found |= {"noise": ask("Standard deviation of what disturbs it in a step", 1.0)}
    found |= {"agents": ask("How many agents", 3), "steps": ask("How many steps", 10)}
    link = ask("Probability that a message arrives (0 to 1; all: a table over it)", "all")
    return found if link == "all" else {**found, "link": float(link)}


def _one_of_models(text: str) -> str:
    return str(one_of(MODELS)(text))


def _written(
    model: str = "random-walk", axes: int = 1, noise: float = 1.0, sigma: float = 10.0, unit: str = "m", **network: Any
) -> str:
    """Return a commented scenario file."""
    if not 1 <= axes <= 3:
        raise UsageError(f"axes: expected 1 to 3, got {axes}")
    moves, n = model != MODELS[0], axes
    d = 2 * n if moves else n
    names = [f"{v}{a}" for a in "xyz"[:n] for v in (("", "v") if moves else ("",))]
    units = [u for _ in range(n) for u in ((unit, f"{unit}/step") if moves else (unit,))]
    F = [[float(i == j or (moves and i % 2 == 0 and j == i + 1)) for j in range(d)] for i in range(d)]
    G = [[(0.5, 1.0)[i % 2] if i // 2 == j else 0.0 for j in range(n)] for i in range(d)]
    H = [[float(j == (2 * i if moves else i)) for j in range(d)] for i in range(n)]
    start = [
        [(100 * sigma**2 if not moves or i % 2 == 0 else 100 * noise**2 + 1) * (i == j) for j in range(d)]
        for i in range(d)
    ]
    lines = {"agents": 3, "steps": 10, "architecture": "ad-hoc", **network}
    link = lines.pop("link", None)
    return TEMPLATE.format(
        what=f"{model.replace('-', ' ')} in {n} direction{'s' * (n > 1)}, seen by {lines['agents']} agents",
        states=json.dumps(names),
        units=json.dumps(units),
        F=F,
        G=f"G = {G}                # the disturbance moves the state by G w\n" if moves else "",
        H=H,
        Q=noise**2,
        R=sigma**2,
        P=start,
        link=f"link = {link}" if link is not None else "# link = 0.5",
        **lines,
    )


for command in (list_presets, show, check, schema, new):
    app.command("list" if command is list_presets else command.__name__, cls=Command)(gathered(command))
