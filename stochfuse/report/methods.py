"""What there is to ask for, and what takes what, as tables and JSON: the registry and the capability table, shown."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from stochfuse.report.table import Report, Table, stamped, to_csv
from stochfuse.scenario import capabilities, registry
from stochfuse.scenario.own_rules import OwnRule

SCHEMA = "stochfuse.methods/1"


def methods_report(matrix: bool = False, own: Sequence[OwnRule] = ()) -> Report:
    """Return what there is and rules of the user's own, or the capability table, in every form."""
    more: Any = {"matrix": matrix, "own": own}
    return Report(partial(methods_table, **more), partial(methods_csv, **more), partial(methods_json, own))


def methods_table(*, matrix: bool = False, own: Sequence[OwnRule] = ()) -> Table:
    """Return everything that can be asked for by its name; or, for each estimator and engine, what is not taken."""
    return _matrix_table(own) if matrix else _listing_table(own)


def _entries(own: Sequence[OwnRule]) -> list[registry.EstimatorEntry]:
    return [*registry.ESTIMATOR, *(name.entry for name in own)]


def _listing_table(own: Sequence[OwnRule]) -> Table:
    rows = [("estimator", e.name, f"{e.title} ({e.source})") for e in _entries(own)]
    rows += [("method", e.name, f"{e.title}, {e.source}: {e.help}; {e.nature}") for e in registry.ENGINE]
    e = registry.REPLAY
    rows += [("engine", e.name, f"{e.source}: {e.help}; {e.nature}")]
    rows += [("method", s.name, f"short for --estimator {s.estimator} --method {s.engine}") for s in registry.SHORT]
    rows += [("quantity", q.name, q.help) for q in registry.QUANTITY]
    rows += [("metric", m.name, m.help) for m in registry.METRIC]
    rows += [("statistic", s.name, s.help) for s in registry.STATISTIC]
    weighs = "minimised by the weights of " + ", ".join(registry.INTERSECTIONS)
    rows += [("criterion", c, weighs) for c in registry.CRITERIA]
    title = ("What can be asked for: --estimator is what the agents do, --method how chance is averaged",)
    return Table(title, ("option", "name", "what it is"), (), tuple(rows))


def _matrix_table(own: Sequence[OwnRule]) -> Table:
    rows = []
    for estimator, engine in capabilities.pairs(own):
        why = {f.name: capabilities.reason(estimator, engine, f.name) for f in capabilities.FEATURES}
        rows.append((estimator, engine, ", ".join(name for name, reason in why.items() if reason) or "takes all"))
    title = (
        "Features of a scenario that an estimator averaged by an engine does not take",
        "known features: " + ", ".join(f.name for f in capabilities.FEATURES),
        f"a steady state (--steady) needs {capabilities.ENDLESS}",
        "reasons: --format json",
    )
    return Table(title, ("estimator", "method", "does not take"), (), tuple(rows))


def methods_csv(*, matrix: bool = False, own: Sequence[OwnRule] = ()) -> str:
    """Return the same as CSV: of the matrix every cell, with the reason where it says no."""
    if not matrix:
        table = methods_table(own=own)
        return to_csv(table.headings, table.rows)
    cells = [
        (estimator, engine, feature, "" if reason is True else reason)
        for estimator, engines in capabilities.matrix(own).items()
        for engine, features in engines.items()
        for feature, reason in features.items()
    ]
    return to_csv(("estimator", "method", "feature", "reason"), cells)


def methods_json(own: Sequence[OwnRule] = ()) -> dict[str, Any]:
    """Return registry and table with the keys of the schema."""

    def told(entries: Sequence[Any], *names: str) -> list[dict[str, Any]]:
        return [{name: getattr(entry, name) for name in names} for entry in entries]

    return stamped(
        SCHEMA,
        estimators=told(_entries(own), "name", "title", "source"),
        engines=told(registry.ENGINE, "name", "title", "source", "nature", "help"),
        short_forms=told(registry.SHORT, "name", "estimator", "engine"),
        quantities=told(registry.QUANTITY, "name", "help"),
        metrics=told(registry.METRIC, "name", "help"),
        statistics=told(registry.STATISTIC, "name", "help"),
        features=told(capabilities.FEATURES, "name", "key"),
        matrix=capabilities.matrix(own),
    )
