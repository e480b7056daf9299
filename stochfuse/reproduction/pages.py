"""A figure with its statements, and all statements on one page."""

from __future__ import annotations

from dataclasses import replace

from stochfuse.report.reproductions import Finding, Sheet
from stochfuse.reproduction import about_covariance, about_errors, about_messages, about_methods, about_records
from stochfuse.reproduction.bench import LFG, NAIVE, STEADY, TRANSIENT, Bench
from stochfuse.reproduction.catalogue import catalogue, find
from stochfuse.reproduction.statements import Statement


def statements() -> tuple[Statement, ...]:
    """Return every statement, figures first, in the thesis' order."""
    rooms = (about_covariance, about_errors, about_records, about_methods, about_messages)
    found = [statement for room in rooms for statement in room.STATEMENTS]
    return tuple(sorted(found, key=lambda s: (s.items[0].startswith("table"), int(s.items[0].partition("-")[2]))))


def listing() -> list[tuple[str, str]]:
    """Key and title of everything that can be reproduced."""
    return [(item.key, item.title) for item in catalogue()]


def sheet(name: str, bench: Bench) -> Sheet:
    """Make a figure or table with the statements about it.

    Parameters
    ----------
    name : as for `stochfuse.reproduction.find`.

    Raises
    ------
    UsageError
        If there is no such figure or table.
    """
    item = find(name)
    findings = tuple(s.judge(bench) for s in statements() if item.key in s.items)
    return replace(item.sheet(bench), findings=findings)


def page(bench: Bench) -> list[Finding]:
    """Judge every statement."""
    for rule in (LFG, NAIVE):
        for case in (TRANSIENT, STEADY):
            # with footprints at once: without, the same outcomes would be gone through twice
            bench.averages(case, "ad-hoc", rule)
    return [statement.judge(bench) for statement in statements()]
