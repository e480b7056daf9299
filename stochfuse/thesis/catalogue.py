"""Every figure and table of the thesis' chapters 3 and 4: what it shows, and how it is made here.

A figure is a quantity (`stochfuse.thesis.figures`) of some sweeps: scenario, network and fusion rule over link
probabilities; `sheet` works it out and adds the statements about it, `page` judges all statements.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from stochfuse.errors import UsageError, nearest
from stochfuse.report.reproductions import Finding, Panel, Sheet
from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis import about_covariance, about_errors, about_messages, about_methods, about_records
from stochfuse.thesis import figures as show
from stochfuse.thesis.bench import ARCHITECTURES, LINKS, STEADY, TRANSIENT, Bench, Sweep, ThesisCase
from stochfuse.thesis.statements import Statement

ONE_RECORD = (
    "The thesis averages over 1000 draws of the links with one record of truth and measurements; shown are the average "
    "over links and noise, and single records"
)
AGENTS = "Errors are averaged over the three agents; the thesis does not say whose it shows"
ERRORS = (ONE_RECORD, AGENTS)
APPROXIMATE = "(53)/(54) are approximate, the Local Fusion Graph's averages exact"
NO_RATIOS = (
    "The three ratios are not in the thesis' text: shown are 1/16, 1/4 and 4.  Whether Q or R is changed makes no "
    "difference but for the scale of the noise, as P(k0) = R"
)
SIZES = "Size: nodes of a step's messages that are new to the receiver"


@dataclass(frozen=True)
class Item:
    """A figure or table of the thesis.

    Parameters
    ----------
    key : "figure-32" or "table-3".
    title : what it shows, in our words.
    quantity : what is shown of the sweeps, or None for a table of parameters.
    sweeps : (scenario, architecture, rule) of each.
    notes : what the reader should know.
    links : link probabilities.
    options : further arguments of the quantity.
    runs : for tables of parameters: runs in the thesis, and here.
    """

    key: str
    title: str
    quantity: Callable[..., list[Panel]] | None = None
    sweeps: Sequence[tuple[ThesisCase, str, str]] = ()
    notes: tuple[str, ...] = ()
    links: Sequence[float] = LINKS
    options: Mapping[str, Any] = field(default_factory=dict)
    runs: tuple[str, str] = ("", "")

    @property
    def panels(self) -> Callable[[Bench], tuple[Panel, ...]] | None:
        """What makes its panels, or None for a table of parameters."""
        return None if self.quantity is None else partial(self._panels, self.quantity)

    def _panels(self, quantity: Callable[..., list[Panel]], bench: Bench) -> tuple[Panel, ...]:
        return tuple(quantity(*(Sweep(bench, *given, self.links) for given in self.sweeps), **self.options))

    def sheet(self, bench: Bench) -> Sheet:
        """Make the data."""
        if self.panels is not None:
            return Sheet(self.key, self.title, self.notes, self.panels(bench))
        return Sheet(self.key, self.title, self.notes, facts=(*show.parameters(bench), ("runs", *self.runs)))


NOT_COVERED = {
    **{f"figure-{i}": "explains the method; see `stochfuse graph`" for i in range(3, 17)},
    **{f"figure-{i}": "is a drawing of the simulation model" for i in (17, 18, 64)},
    "figure-63": "is a drawing of a fusion graph; see `stochfuse graph`",
    **{f"figure-{i}": "belongs to appendix A" for i in range(73, 76)},
    **dict.fromkeys(("figure-1", "table-1"), "is about a network demonstration"),
    "figure-2": "explains the Information Graph",
}
"""Figures and tables that hold nothing to calculate, and why."""


def _figure(number: int, title: str, quantity: Callable, *sweeps: tuple, notes: tuple[str, ...] = (), **more) -> Item:
    return Item(f"figure-{number}", title, quantity, sweeps, notes, **more)


def _by_network(
    first: int, title: str, quantity: Callable, case: ThesisCase, notes: tuple[str, ...] = ()
) -> Iterator[Item]:
    """A figure for each network, from the number of the first on; {} in the title is the network."""
    for i, a in enumerate(ARCHITECTURES):
        yield _figure(first + i, title.format(a.replace("-", " ")), quantity, (case, a, LFG), notes=notes)


def _networks(case: ThesisCase, *rules: str) -> list[tuple[ThesisCase, str, str]]:
    return [(case, a, rule) for rule in rules for a in ARCHITECTURES]


def _ratios(architecture: str) -> list[tuple[ThesisCase, str, str]]:
    """Transient, with three ratios of process to measurement noise, R = P(k0) = 100."""
    return [(ThesisCase("transient", q), architecture, LFG) for _, q in show.RATIOS]


def _both_cases(*rules: str) -> list[tuple[ThesisCase, str, str]]:
    return [(case, "ad-hoc", rule) for case in (TRANSIENT, STEADY) for rule in rules]


def _of_case(case: ThesisCase, name: str, first: int, naive: int, both: int, both_states: int, cost: int):
    """Figures that there are of either scenario; `first` and the others are their numbers."""
    yield from _by_network(first, f"average covariance over time, {{}} network, {name}", show.covariance, case)
    title = f"covariance relative to 0 % against connectivity, {{}} network, {name}"
    yield from _by_network(first + 3, title, show.normalised, case)
    yield from _by_network(
        first + 6, f"average state estimate over time, {{}} network, {name}", show.states, case, ERRORS
    )
    yield from _by_network(first + 9, f"RMS error over time, {{}} network, {name}", show.errors, case, ERRORS)
    title, rule = f"over time, naive fusion, ad hoc network, {name}", (case, "ad-hoc", NAIVE)
    yield _figure(naive, f"average covariance {title}", show.covariance, rule)
    yield _figure(naive + 1, f"average state estimate {title}", show.states, rule, notes=ERRORS)
    title = f"over time, Local Fusion Graph and simplified formulation, ad hoc network, {name}"
    rules = [(case, "ad-hoc", rule) for rule in (LFG, SIMPLIFIED)]
    yield _figure(both, f"average covariance {title}", show.covariance, *rules, notes=(APPROXIMATE,))
    yield _figure(both_states, f"state estimate {title}", show.states, *rules, notes=(*ERRORS, APPROXIMATE))
    title = f"RMS error against mean message size, Local Fusion Graph and naive fusion, {name}"
    yield _figure(cost, title, show.cost_of_accuracy, *_networks(case, LFG, NAIVE), notes=(*ERRORS, SIZES))


def _averaged_over_time() -> Iterator[Item]:
    title = "RMS error averaged over steps 2–5 against connectivity, three networks"
    networks, no_error = _networks(TRANSIENT, LFG), {"variants": ("no-error",)}
    quantity = show.averaged_errors
    yield _figure(32, f"{title}, transient", quantity, *networks, notes=ERRORS, options=no_error)
    up_to = f"{title}, transient, up to 50 %"
    yield _figure(33, up_to, quantity, *networks, notes=ERRORS, links=about_errors.FINE, options=no_error)
    steady, options = f"{title}, steady state", {"variants": ("start", "all")}
    yield _figure(48, steady, quantity, *_networks(STEADY, LFG), notes=ERRORS, options=options)
    title, notes = (
        "RMS error averaged over steps 2–5 for three noise ratios, {} network, transient",
        (*ERRORS, NO_RATIOS),
    )
    for number, a, where in ((34, "broadcast", "broadcast (or ad hoc)"), (35, "cyclic", "cyclic")):
        yield _figure(number, title.format(where), quantity, *_ratios(a), notes=notes, options=no_error)


def _messages() -> Iterator[Item]:
    size = "message size, {} network"
    yield from _by_network(49, f"histogram of the {size}", show.histogram, TRANSIENT, (SIZES,))
    yield from _by_network(53, f"cumulative distribution of the {size}", show.cumulative, TRANSIENT, (SIZES,))
    title, sizes = "mean message size against connectivity", show.message_sizes
    yield _figure(52, title, sizes, *_networks(TRANSIENT, LFG), notes=(SIZES,))
    rules = _networks(TRANSIENT, LFG, NAIVE)
    yield _figure(60, f"{title}, Local Fusion Graph and naive fusion", sizes, *rules, notes=(SIZES,))


def _methods() -> Iterator[Item]:
    title, notes = "against connectivity, both methods, ad hoc network, both scenarios", (*ERRORS, APPROXIMATE)
    each, both = _both_cases(SIMPLIFIED, LFG), _both_cases(LFG)
    yield _figure(67, f"relative covariance averaged over time {title}", show.averaged_covariances, *each)
    yield _figure(68, f"difference of the covariances {title}", show.covariance_differences, *both)
    yield _figure(71, f"relative RMS error {title}", show.relative_errors, *each, notes=notes)
    yield _figure(72, f"difference of the relative RMS errors {title}", show.error_differences, *both, notes=notes)


def catalogue() -> tuple[Item, ...]:
    """Return all figures and tables that are reproduced, in the thesis' order."""
    found = [
        _figure(
            19,
            "claimed covariance over time in a single run, ad hoc network, transient",
            show.sample_run,
            (TRANSIENT, "ad-hoc", LFG),
        ),
        *_of_case(TRANSIENT, "transient", 20, naive=56, both=65, both_states=69, cost=61),
        *_of_case(STEADY, "steady state", 36, naive=58, both=66, both_states=70, cost=62),
        *_averaged_over_time(),
        *_messages(),
        *_methods(),
    ]
    moments = "mean, largest and standard deviation of the message size"
    runs_2, runs_4 = ("1000", "none: every outcome is gone through"), ("1", "none: (54) is evaluated")
    return (
        *sorted(found, key=lambda item: int(item.key.partition("-")[2])),
        Item("table-2", "parameters of the Local Fusion Graph simulations", runs=runs_2),
        Item("table-3", moments, show.table_3, _networks(TRANSIENT, LFG), notes=(SIZES,)),
        Item("table-4", "parameters of the stochastic model's simulations", runs=runs_4),
    )


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
    found = [statement for room in rooms for statement in room.STATED]
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
