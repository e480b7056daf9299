"""The generated pages of the handbook: reference (from registry and schema) and mathematics (from the modules' texts).

`python -m tests.handbook` writes them; `tests/cli/test_readme.py` checks that they are current.
"""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path

from stochfuse.report.explanations import TERMS
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.schema import ScenarioFile

HANDBOOK = Path(__file__).parents[1] / "notebooks" / "handbook"
CHAPTERS = {
    "The Kalman filter": "kalman.kernel",
    "Many filters at once": "kalman.packed",
    "The simplified formulation": "prediction.simplified",
    "The average over arrivals": "kalman.averaged_update",
    "The Local Fusion Graph": "estimators.local_fusion_graph",
    "The general formulation": "engines.enumeration",
    "The contact chain: the exact optimum": "engines.contact_chain",
    "The optimum as control of a sample": "prediction.control",
    "Sampling to a precision": "prediction.stopping",
    "What is true: footprints of the noises": "estimators.world",
    "Claimed, actual and what follows": "prediction.quantities",
    "The optimum enclosed": "engines.enclosure",
    "The steady state": "prediction.steady_state",
    "The steady state of everything": "prediction.limits",
    "The steady optimum": "prediction.steady_chain",
    "Bounded or growing": "prediction.boundedness",
    "The critical link probability": "questions.critical",
    "Message load": "questions.messages",
    "Covariance intersection": "fusion.intersection",
    "Parallel filters and blenders": "fusion.parallel",
    "A fusion rule of one's own": "estimators.own",
    "The equivalent measurement": "fusion.equivalent",
    "Cooperative estimators": "fusion.cooperative",
    "Models by name": "scenario.motion",
    "Sensors by name": "scenario.sensing",
    "What rounding can do": "engines.precision",
    "Replay: what did arrive": "engines.replay",
    "Estimates in numbers": "estimators.readings",
    "Expected states given measurements": "prediction.expected_states",
    "What a simulation draws": "data.draw",
    "What a live agent knows": "data.knowledge",
    "Messages of live agents": "data.messages",
    "Messages that do not carry everything": "data.protocols",
    "Consistency: NEES and NIS": "data.consistency",
    "Robots: how sensors err": "data.robot_errors",
    "Robots: filters and their errors": "data.robot_filters",
    "Robots: from record to verdict": "data.robot_run",
    "What a simulator's values are distributed like": "data.expected",
    "How a simulator's cells are judged": "data.cells",
    "All cells together": "data.together",
    "What is wrong with a simulator": "data.causes",
    "How well numbers explain it": "data.fits",
    "What a simulator with a mistake would show": "data.supposed",
}


def mathematics() -> str:
    """Each method's equations, departures and errata, as its module states them."""
    parts = [
        "# Mathematics\n",
        "Each method with the source's equation numbers, every departure and erratum, as the module states it that "
        "evaluates it. Numbers in parentheses are those of the thesis (`stochfuse --cite`). How each is checked: the "
        "independent re-derivations in `tests/oracles`, and the published numbers in `tests/agreement/test_published.py`.\n",
    ]
    for title, module in CHAPTERS.items():
        text = inspect.cleandoc(import_module(f"stochfuse.{module}").__doc__ or "")
        parts.append(f"## {title}\n\n`stochfuse/{module.replace('.', '/')}.py`\n\n```text\n{text}\n```\n")
    return "\n".join(parts)


def table(headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""

    def line(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

    return "\n".join([line(headings), line(("---",) * len(headings)), *map(line, rows)]) + "\n"


def keys(schema: dict, place: str, definitions: dict) -> list[tuple[str, str]]:
    """Every key of a scenario file with its description, tables opened up."""
    found = []
    for name, entry in schema.get("properties", {}).items():
        path = f"{place}.{name}" if place else name
        found.append((f"`{path}`", entry.get("description", entry.get("title", ""))))
        options = [entry, entry.get("items", {}), *entry.get("anyOf", []), *entry.get("oneOf", [])]
        options += [option.get("items", {}) for option in entry.get("anyOf", [])]
        for option in options:
            inner = definitions.get(option.get("$ref", "").rpartition("/")[2])
            if inner is not None:
                found += keys(inner, path, definitions)
                break
    return found


def reference() -> str:
    """Everything that can be named, from the registry, the capability table and the schema."""
    schema = ScenarioFile.model_json_schema(by_alias=True)
    return "\n".join(
        [
            "# Reference\n",
            "Generated from registry and schema. Estimators say what the agents do with what arrives (`--estimator`), "
            "methods how chance is averaged (`--method`).\n",
            "## Estimators\n",
            table(("name", "what it does", "source"), [(f"`{e.name}`", e.title, e.source) for e in registry.ESTIMATOR]),
            "## Methods\n",
            table(
                ("name", "what it is", "source", "nature"),
                [(f"`{e.name}`", f"{e.title}: {e.help}", e.source, e.nature) for e in registry.ENGINE]
                + [
                    (f"`{s.name}`", f"short for --estimator {s.estimator} --method {s.engine}", "", "")
                    for s in registry.SHORT
                ],
            ),
            "## Quantities, metrics, statistics\n",
            table(
                ("name", "kind", "what it is"),
                [(f"`{q.name}`", "quantity", q.help) for q in registry.QUANTITY]
                + [(f"`{m.name}`", "metric", m.help) for m in registry.METRIC]
                + [(f"`{s.name}`", "statistic", s.help) for s in registry.STATISTIC],
            ),
            "## Features of a scenario\n",
            "What takes what, and why not, says `stochfuse methods --matrix`.\n",
            table(("feature", "in a scenario file"), [(f"`{f.name}`", f.key) for f in capabilities.FEATURES]),
            "## Words\n",
            table(("word", "what it means"), list(TERMS.items())),
            "## Keys of a scenario file\n",
            table(("key", "what it is"), keys(schema, "", schema.get("$defs", {}))),
        ]
    )


PAGES = {"mathematics.md": mathematics, "reference.md": reference}

if __name__ == "__main__":
    for name, make in PAGES.items():
        (HANDBOOK / name).write_text(make(), encoding="utf-8")
