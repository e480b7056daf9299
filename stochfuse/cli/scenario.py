"""`stochfuse scenario`: list, show, check, schema, new."""

from __future__ import annotations

from typing import Annotated

import typer

from stochfuse.cli.options import Format, FormatOption, OutputOption, ScenarioArgument, chosen_format, complete_scenario

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="The scenarios: list, show, check, schema, new.",
)

NEW_HEADER = """\
# A stochfuse scenario.  `stochfuse scenario check FILE` says what does not fit; `stochfuse scenario schema` lists keys.
# Predict with: stochfuse predict FILE
"""


@app.command("list")
def list_presets(format: FormatOption = None, output: OutputOption = None) -> None:
    """List the presets."""
    from stochfuse.report import table
    from stochfuse.report.table import terminal_width, to_json, write_text
    from stochfuse.scenario.scenario import load_scenario, preset_names

    keys = ("name", "agents", "steps", "states", "description")
    entries = []
    for name in preset_names():
        s = load_scenario(name)
        entries.append((name, s.network.agents, s.network.steps, ", ".join(s.model.states), s.source["description"]))
    chosen = chosen_format(format, output)
    if chosen == Format.json.value:
        text = to_json([dict(zip(keys, entry, strict=True)) for entry in entries])
    elif chosen == Format.csv.value:
        text = table.to_csv(keys, entries)
    else:
        rows = tuple(tuple(map(str, entry)) for entry in entries)
        text = table.render(table.Table(("Presets",), keys, (), rows), chosen, terminal_width())
    write_text(text, output)


@app.command()
def show(
    scenario: ScenarioArgument = "thesis-transient",
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    output: OutputOption = None,
) -> None:
    """Print a scenario, after checking it, in a form that can be saved and edited."""
    from stochfuse.report.table import to_json, write_text
    from stochfuse.scenario.scenario import Scenario, parse, read_text

    name, text = read_text(scenario)
    checked = Scenario.from_mapping(parse(name, text), name)
    write_text(to_json(checked.to_mapping()) if json else text, output)


@app.command()
def check(scenario: ScenarioArgument) -> None:
    """Check a scenario: name every key that does not fit, exit 2, or say what it describes."""
    from stochfuse.scenario.scenario import Scenario, parse, read_text

    name, text = read_text(scenario)
    s = Scenario.from_mapping(parse(name, text), name)
    n = s.network.agents
    kinds = f" with {len(s.sensors)} kinds of sensors" if len(s.sensors) > 1 else ""
    typer.echo(
        f"{name}: ok: {n} agent{'s' * (n > 1)}{kinds}, {s.network.architecture}, {s.network.steps} steps, "
        f"state ({', '.join(s.model.states)})"
    )


@app.command()
def schema(
    study: Annotated[bool, typer.Option("--study", help="Of a study file, see `stochfuse study`.")] = False,
    output: OutputOption = None,
) -> None:
    """Print the JSON Schema of a scenario file."""
    from stochfuse.report.table import to_json, write_text
    from stochfuse.scenario.schema import ScenarioFile
    from stochfuse.studies.plan import StudyFile

    structure = StudyFile if study else ScenarioFile
    write_text(to_json(structure.model_json_schema(by_alias=True)), output)


@app.command()
def new(
    preset: Annotated[
        str, typer.Argument(help="The preset to begin with.", autocompletion=complete_scenario)
    ] = "cv-2d",
    output: OutputOption = None,
) -> None:
    """Print a scenario file to begin with; --output saves it and never overwrites."""
    from stochfuse.errors import UsageError
    from stochfuse.report.table import check_writable, write_text
    from stochfuse.scenario.scenario import is_preset, preset_names, read_text

    if not is_preset(preset):
        raise UsageError(f"no preset '{preset}'; the presets are {', '.join(preset_names())}")
    check_writable(output)
    if output is not None and output.suffix.lower() == ".json":
        raise UsageError(f"{output}: a new scenario is TOML, with comments; give a name that ends in .toml")
    if output is not None and output.exists():
        raise UsageError(f"{output} exists already")
    write_text(NEW_HEADER + read_text(preset)[1], output)
