"""Ways of doing one piece of work, the time that each takes for a unit of it, and whether their answers agree."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import NamedTuple

from tests.benchmarks.__main__ import medians

OURS = f"stochfuse {version('stochfuse')}"
FILTERPY, STONE_SOUP, SIMDKALMAN = (
    f"{name} {version(package)}"
    for name, package in (("FilterPy", "filterpy"), ("Stone Soup", "stonesoup"), ("simdkalman", "simdkalman"))
)


class Way(NamedTuple):
    """One way of doing the work.

    Parameters
    ----------
    who, how : the library and which part of it.
    run : does the work and returns the answer.
    units : units of work in one run.
    """

    who: str
    how: str
    run: Callable[[], object]
    units: int


class Row(NamedTuple):
    """What is shown of a way: units timed, seconds for one, over stochfuse's, and by how much its answer differs."""

    who: str
    how: str
    timed: str
    seconds: float
    ratio: float
    difference: str


class Section(NamedTuple):
    """A piece of work, with the unit that is timed, and its rows."""

    work: str
    rows: list[Row]


def agreed(what: str, found: float, most: float) -> str:
    """Return the difference for the table, or end the run: times of different answers mean nothing."""
    if not found <= most:
        raise SystemExit(f"peers: {what}: expected agreement to {most:g}, got a difference of {found:.3g}")
    return f"{found:.0e}"


def timed(ways: Sequence[Way], differences: Sequence[str], ours: Way, rounds: int) -> list[Row]:
    """Measure all ways in turns, by the CPU time of their one thread: other work on the machine is not theirs."""
    medians_of = medians(*(way.run for way in ways), rounds=rounds, clock=time.process_time)
    seconds = [time / way.units for time, way in zip(medians_of, ways, strict=True)]
    own = seconds[ways.index(ours)]
    return [
        Row(way.who, way.how, f"{way.units:,}", each, each / own, difference)
        for way, each, difference in zip(ways, seconds, differences, strict=True)
    ]


def fastest(rows: Sequence[Row]) -> list[Row]:
    """Leave out what is not the fastest way of a peer."""
    least = {row.who: min(r.seconds for r in rows if r.who == row.who) for row in rows}
    return [row for row in rows if row.who == OURS or row.seconds == least[row.who]]
