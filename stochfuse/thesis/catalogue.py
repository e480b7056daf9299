"""Every figure and table of the thesis' chapters 3 and 4: what it shows, and how it is made here.

A figure with its statements, and all statements on one page.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from stochfuse.errors import UsageError, nearest
from stochfuse.report.reproductions import Finding, Panel, Sheet
from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis import about_covariance, about_errors, about_messages, about_methods, about_records
from stochfuse.thesis import figures as compared
from stochfuse.thesis import figures as f
from stochfuse.thesis import tables as published
from stochfuse.thesis.bench import STEADY, TRANSIENT, Bench, ThesisCase
from stochfuse.thesis.statements import Statement

ONE_RECORD = (
    "The thesis averages over 1000 draws of the links with one record of truth and measurements; shown are the average "
    "over links and noise, and single records"
)
AGENTS = "Errors are averaged over the three agents; the thesis does not say whose it shows"
APPROXIMATE = "(53)/(54) are approximate, the Local Fusion Graph's averages exact"
NO_RATIOS = (
    "The three ratios are not in the thesis' text: shown are 1/16, 1/4 and 4.  Whether Q or R is changed makes no "
    "difference but for the scale of the noise, as P(k0) = R"
)
SIZES = "Size: nodes of a step's messages that are new to the receiver"
NAMES = {"ad-hoc": "ad hoc", "broadcast": "broadcast", "cyclic": "cyclic"}


@dataclass(frozen=True)
class Item:
    """A figure or table of the thesis.

    Parameters
    ----------
    key : "figure-32" or "table-3".
    title : what it shows, in our words.
    panels : makes its data, or None.
    facts : makes its rows where it is a table of parameters, or None.
    notes : what the reader should know.
    """

    key: str
    title: str
    panels: Callable[[Bench], tuple[Panel, ...]] | None = None
    facts: Callable[[Bench], tuple[tuple[str, str, str], ...]] | None = None
    notes: tuple[str, ...] = ()

    def sheet(self, bench: Bench) -> Sheet:
        """Make the data."""
        return Sheet(
            self.key,
            self.title,
            self.notes,
            () if self.panels is None else self.panels(bench),
            () if self.facts is None else self.facts(bench),
        )


NOT_COVERED = {
    **{f"figure-{i}": "explains the method; see `stochfuse graph`" for i in range(3, 17)},
    **{f"figure-{i}": "is a drawing of the simulation model" for i in (17, 18, 64)},
    "figure-63": "is a drawing of a fusion graph; see `stochfuse graph`",
    **{f"figure-{i}": "belongs to appendix A" for i in range(73, 76)},
    **dict.fromkeys(("figure-1", "table-1"), "is about a network demonstration"),
    "figure-2": "explains the Information Graph",
}
"""Figures and tables that hold nothing to calculate, and why."""


def catalogue() -> tuple[Item, ...]:
    """Return all figures and tables that are reproduced, in the thesis' order."""
    made = [*_chapter_3(), *_messages(), *_chapter_4()]
    tables = [item for item in made if item.key.startswith("table")]
    return (*sorted((i for i in made if i not in tables), key=_number), *sorted(tables, key=_number))


def _number(item: Item) -> int:
    return int(item.key.partition("-")[2])


def _chapter_3() -> Iterator[Item]:
    yield Item("table-2", "parameters of the Local Fusion Graph simulations", facts=published.table_2)
    yield Item("figure-19", "claimed covariance over time in a single run, ad hoc network, transient", f.sample_run)
    yield from _scenario(TRANSIENT, "transient", covariance=20, normalised=23, states=26, errors=29)
    yield from _scenario(STEADY, "steady state", covariance=36, normalised=39, states=42, errors=45)
    title = "RMS error averaged over steps 2–5 against connectivity, three networks"
    notes = (ONE_RECORD, AGENTS)
    make = f.averaged_over_time(f.by_architecture(TRANSIENT), variants=("no-error",))
    yield Item("figure-32", f"{title}, transient", make, notes=notes)
    fine = (0.0, 0.125, 0.25, 0.375, 0.5)
    make = f.averaged_over_time(f.by_architecture(TRANSIENT), fine, variants=("no-error",))
    yield Item("figure-33", f"{title}, transient, up to 50 %", make, notes=notes)
    for number, architecture, where in ((34, "broadcast", "broadcast (or ad hoc)"), (35, "cyclic", "cyclic")):
        make = f.averaged_over_time(f.by_ratio(architecture), variants=("no-error",))
        title_34 = f"RMS error averaged over steps 2–5 for three noise ratios, {where} network, transient"
        yield Item(f"figure-{number}", title_34, make, notes=(*notes, NO_RATIOS))
    make = f.averaged_over_time(f.by_architecture(STEADY), variants=("start", "all"))
    yield Item("figure-48", f"{title}, steady state", make, notes=notes)


def _scenario(
    case: ThesisCase, name: str, *, covariance: int, normalised: int, states: int, errors: int
) -> Iterator[Item]:
    for i, (architecture, shown) in enumerate(NAMES.items()):
        tail = f"{shown} network, {name}"
        yield Item(
            f"figure-{covariance + i}", f"average covariance over time, {tail}", f.covariance(case, architecture)
        )
        yield Item(
            f"figure-{normalised + i}",
            f"covariance relative to 0 % against connectivity, {tail}",
            f.normalised(case, architecture),
        )
        yield Item(
            f"figure-{states + i}",
            f"average state estimate over time, {tail}",
            f.states(case, architecture),
            notes=(ONE_RECORD, AGENTS),
        )
        yield Item(
            f"figure-{errors + i}",
            f"RMS error over time, {tail}",
            f.errors(case, architecture),
            notes=(ONE_RECORD, AGENTS),
        )


def _messages() -> Iterator[Item]:
    notes = (SIZES,)
    for i, (architecture, shown) in enumerate(NAMES.items()):
        size = f"message size, {shown} network"
        yield Item(f"figure-{49 + i}", f"histogram of the {size}", compared.histogram(architecture), notes=notes)
        yield Item(
            f"figure-{53 + i}",
            f"cumulative distribution of the {size}",
            compared.cumulative(architecture),
            notes=notes,
        )
    yield Item("figure-52", "mean message size against connectivity", compared.message_sizes(), notes=notes)
    yield Item("table-3", "mean, largest and standard deviation of the message size", published.table_3, notes=notes)
    for number, case, name in ((56, TRANSIENT, "transient"), (58, STEADY, "steady state")):
        title = f"over time, naive fusion, ad hoc network, {name}"
        make = f.covariance(case, "ad-hoc", (NAIVE,))
        yield Item(f"figure-{number}", f"average covariance {title}", make)
        make = f.states(case, "ad-hoc", (NAIVE,))
        yield Item(f"figure-{number + 1}", f"average state estimate {title}", make, notes=(ONE_RECORD, AGENTS))
    title = "mean message size against connectivity, Local Fusion Graph and naive fusion"
    yield Item("figure-60", title, compared.message_sizes((LFG, NAIVE)), notes=notes)
    for number, case, name in ((61, TRANSIENT, "transient"), (62, STEADY, "steady state")):
        title = f"RMS error against mean message size, Local Fusion Graph and naive fusion, {name}"
        yield Item(f"figure-{number}", title, compared.cost_of_accuracy(case), notes=(ONE_RECORD, AGENTS, *notes))


def _chapter_4() -> Iterator[Item]:
    yield Item("table-4", "parameters of the stochastic model's simulations", facts=published.table_4)
    both = (LFG, SIMPLIFIED)
    for i, (case, name) in enumerate(((TRANSIENT, "transient"), (STEADY, "steady state"))):
        tail = f"over time, Local Fusion Graph and simplified formulation, ad hoc network, {name}"
        make = f.covariance(case, "ad-hoc", both)
        yield Item(f"figure-{65 + i}", f"average covariance {tail}", make, notes=(APPROXIMATE,))
        make = f.states(case, "ad-hoc", both)
        yield Item(f"figure-{69 + i}", f"state estimate {tail}", make, notes=(ONE_RECORD, AGENTS, APPROXIMATE))
    title = "against connectivity, both methods, ad hoc network, both scenarios"
    yield Item("figure-67", f"relative covariance averaged over time {title}", compared.figure_67)
    yield Item("figure-68", f"difference of the covariances {title}", compared.figure_68)
    notes = (ONE_RECORD, AGENTS, APPROXIMATE)
    yield Item("figure-71", f"relative RMS error {title}", compared.figure_71, notes=notes)
    yield Item("figure-72", f"difference of the relative RMS errors {title}", compared.figure_72, notes=notes)


def find(name: str) -> Item:
    """Return the item of a name: figure-32, fig32, 32, table-3, table3.

    Raises
    ------
    UsageError
        If it is not in the thesis, or holds nothing to calculate.
    """
    match = re.fullmatch(r"(?:(fig(?:ure)?\.?|table|tab\.?)[-\s]*)?(\d+)", name.strip().lower())
    key = match and f"{'table' if (match[1] or '').startswith('tab') else 'figure'}-{int(match[2])}"
    for item in catalogue():
        if item.key == key:
            return item
    if key in NOT_COVERED:
        raise UsageError(f"reproduce: {key.replace('-', ' ')} {NOT_COVERED[key]}; it has no numbers to calculate")
    raise UsageError(
        f"reproduce: expected figure-19 to figure-62, figure-65 to figure-72, table-2 to table-4, statements, all or "
        f"timing, got '{name}'{nearest(name, (item.key for item in catalogue()))}"
    )


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
    name : as for `stochfuse.thesis.find`.

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
