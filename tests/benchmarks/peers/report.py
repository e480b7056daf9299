"""One table of all work, on the terminal or as Markdown."""

from __future__ import annotations

import platform
import sys
import time
import warnings
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks.peers import fusion, network, recursion
from tests.benchmarks.peers.ways import Row, Section

HEADINGS = ("written with", "timed", "time", "over stochfuse's", "largest difference")


def sections(quick: bool) -> list[Section]:
    items, few, rounds = (200, 20, 1) if quick else (10_000, 200, 15)
    return [
        recursion.section("scalar", recursion.scalar(items), few, rounds),
        recursion.section("4 states, 2 measured", recursion.plane(items), few, rounds),
        fusion.section("det", items, few, 1 if quick else 3),
        fusion.section("trace", items, few, 1 if quick else 3),
        network.section(quick, 1 if quick else 11),
    ]


def processor() -> str:
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def heading(busy: float) -> str:
    """When, where and with what: CPU seconds per second of the clock are measured to show the one thread."""
    packages = ("stochfuse", "numpy", "scipy", "filterpy", "stonesoup", "simdkalman")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    day = datetime.now(UTC).date()
    where = f"{day}, {processor()}, CPU time of one thread ({busy:.2f} CPU seconds a second), Python {platform.python_version()}"
    return f"{where}, {versions}"


def in_words(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def times(ratio: float) -> str:
    return "1" if ratio == 1 else f"{ratio:.2g}" if ratio < 10 else f"{ratio:,.0f}"


def cells(row: Row) -> tuple[str, ...]:
    return f"{row.who}, {row.how}", row.timed, in_words(row.seconds), times(row.ratio), row.difference


def as_table(title: str, found: list[Section]) -> Table:
    table = Table(*HEADINGS, title=title, title_justify="left", min_width=120)
    for work, rows in found:
        table.add_section()
        table.add_row(f"[bold]{work}[/bold]")
        for row in rows:
            table.add_row(*cells(row))
    return table


def as_markdown(title: str, found: list[Section]) -> str:
    lines = [title, "", f"| work | {' | '.join((HEADINGS[0], *HEADINGS[2:]))} |", "|" + "---|" * 5]
    for work, rows in found:
        for row in rows:
            who, _, *rest = cells(row)
            lines.append(f"| {' | '.join((work if row is rows[0] else '', who, *rest))} |")
    return "\n".join(lines)


def report(*, quick: bool, markdown: bool) -> None:
    """Measure everything and print the table; what the libraries warned of goes to stderr."""
    start, used = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        found = sections(quick)
    title = heading((time.process_time() - used) / (time.perf_counter() - start))
    if markdown:
        print(as_markdown(title, found))
    else:
        Console(width=130).print(as_table(title, found))
    for text in sorted({f"{w.category.__name__}: {w.message} ({Path(w.filename).name})" for w in caught}):
        print(f"warning: {text}", file=sys.stderr)
