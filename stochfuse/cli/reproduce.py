"""`stochfuse reproduce`: what the thesis found, computed here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import SCENARIO, WorkersOption, Written, completed, option
from stochfuse.errors import UsageError

if TYPE_CHECKING:
    from stochfuse.thesis import Bench


EXAMPLES = ("stochfuse reproduce figure-32 --plot figure-32.png", "stochfuse reproduce table-3")
SPECIAL = ("statements", "all", "timing")


def _items() -> list[str]:
    from stochfuse.thesis import listing

    return [*(key for key, _ in listing()), *SPECIAL]


def reproduce(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="KEY",
            help="figure-32 (or 32), table-3, statements, all or timing; without one: the list of all.",
            autocompletion=completed(_items),
        ),
    ] = None,
    seed: Annotated[
        int, option("Seed of the records of truth and measurements; default: 1.", SCENARIO, min=0, metavar="N")
    ] = 1,
    workers: WorkersOption = None,
    to: Written = Written(),
) -> None:
    """Reproduce a figure or table of the thesis and judge what the thesis says about it.

    KEY: the data behind the figure, exact where the thesis sampled, and each statement of the thesis about it with our
    numbers: agrees, differs, explained or open.  --plot draws it on the thesis' axes.

    statements: all statements on one page, in some minutes.

    all: data and plots of everything, into the directory of --output.

    timing: 1000 Monte Carlo runs of the Local Fusion Graph took 12,000 s there, the simplified formulation 2 s; here
    the same pair, and the exact general formulation.
    """
    from stochfuse.report.reproductions import listing_report, sheet_report
    from stochfuse.thesis import Bench, find, listing, sheet, timing

    if to.plot is not None and (what is None or what in SPECIAL):
        raise UsageError("--plot: expected the key of a figure, such as figure-32, to draw")
    if what == "all":
        _everything(Bench(seed=seed), to)
        return
    to.check()
    if what is None:
        to.write(listing_report(listing()))
    elif what == "timing":
        to.write(timing(workers=workers).report())
    elif what == "statements":
        _statements(Bench(seed=seed), to)
    else:
        item = find(what)
        if to.plot is not None and item.panels is None:
            raise UsageError(f"--plot: {item.key.replace('-', ' ')} is a table of parameters, with nothing to draw")
        to.write(sheet_report(sheet(what, Bench(seed=seed)), to.digits))


def _statements(bench: Bench, to: Written) -> None:
    from stochfuse.report.reproductions import findings_report
    from stochfuse.thesis import page

    title = ("Statements of the thesis' chapters 3 and 4, in our words, and what our numbers say to them",)
    to.write(findings_report(page(bench), title))


def _everything(bench: Bench, to: Written) -> None:
    """Write data, statements and plot of every figure and table into a directory."""
    from stochfuse.report.reproductions import sheet_report
    from stochfuse.report.table import SUFFIXES
    from stochfuse.thesis import listing, sheet

    folder = to.output
    if folder is None or not folder.is_dir():
        got = "nothing" if folder is None else f"'{folder}'"
        raise UsageError(f"reproduce all: expected --output with a directory that exists, got {got}")
    kind = to.format or "json"
    suffix = next(ending for ending, name in SUFFIXES.items() if name == kind)
    for key, _ in listing():
        found = sheet(key, bench)
        figure = folder / f"{key}.png" if found.panels else None
        Written(kind, folder / f"{key}{suffix}", figure).write(sheet_report(found, to.digits))
    _statements(bench, Written(kind, folder / f"statements{suffix}"))
