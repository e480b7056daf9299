"""`stochfuse study`: one question asked of many points, as a file, a Pareto front or a plot."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from stochfuse.cli.options import (
    FORMATS,
    OUTPUT,
    SHOWN,
    WORK,
    DigitsOption,
    Reported,
    Written,
    choice,
    option,
    tell,
)
from stochfuse.cli.progress import quiet
from stochfuse.errors import UsageError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from stochfuse.studies.files import Results

EVERY = 30.0
"""Seconds between lines of progress where there is no terminal for a bar."""
PATIENCE = 10
"""Seconds in which a scheduler should answer."""


KINDS = ("heat", "contour")
EXAMPLES = (
    "stochfuse study trade.toml --workers 2",
    "stochfuse study trade.toml --over network.link,model.R --plot trade.png",
)


class Looked(NamedTuple):
    """What of the result is looked at."""

    pareto: Annotated[
        bool, option("The points that no other beats in both accuracy and message load.", SHOWN, "--pareto")
    ] = False
    column: Annotated[
        str | None, option("Value column to show: claimed.trace; default: the first.", SHOWN, metavar="NAME")
    ] = None
    step: Annotated[int | None, option("Step to show; default: the last.", SHOWN, min=1, metavar="K")] = None
    over: Annotated[
        str | None,
        option("Keys that the plot is drawn over; default: the first two that vary.", SHOWN, metavar="KEY,KEY"),
    ] = None
    where: Annotated[
        list[str] | None,
        option(
            "Only points with this value of a key, in the plot or the front; may be repeated.",
            SHOWN,
            metavar="KEY=VALUE",
        ),
    ] = None
    kind: Annotated[
        str | None, choice(KINDS, "What is drawn over two keys: heat or contour; default: heat.", SHOWN)
    ] = None


def study(
    study: Annotated[str, typer.Argument(metavar="STUDY", help="TOML or JSON file, - for standard input.")],
    workers: Annotated[int, option("Processes; default: 1.", WORK, min=1, metavar="N")] = 1,
    dask: Annotated[
        str | None, option("Work on the cluster of this Dask scheduler, tcp://host:8786.", WORK, metavar="ADDRESS")
    ] = None,
    restart: Annotated[bool, option("Begin anew, and replace a result that is there.", WORK, "--restart")] = False,
    looked: Looked = Looked(),
    output: Annotated[
        Path | None,
        option(
            "The result, .parquet or .csv; default: beside the study file, .parquet.",
            OUTPUT,
            "--output",
            "-o",
            metavar="FILE",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        option("Draw the front, or the column over two keys: .png, .svg or .pdf.", OUTPUT, metavar="FILE"),
    ] = None,
    format: Annotated[
        str | None, choice(FORMATS, "Format of what is shown; default: table.", OUTPUT, "--format", "-f")
    ] = None,
    digits: DigitsOption = 5,
    page: Reported = Reported(),
) -> None:
    """Predict many points: a grid, a list or a Latin hypercube over scenario keys and methods.

    The result has one row per point and step. Killed at any moment, the same command goes on where it stopped; when it
    is finished, it shows what there is.
    """
    # one thread in matrix products, before NumPy is there: these are small, and workers have a processor each
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stochfuse.cli.options import check_files
    from stochfuse.studies.running import study as run

    check_files(output, plot, study)
    page.check(output, plot, study)
    drawn = plot is not None or page.report is not None
    for flag, value in (("--over", looked.over), ("--kind", looked.kind)):
        if value is not None and (not drawn or looked.pareto):
            raise UsageError(f"{flag}: expected --plot without --pareto")
    for flag, value in (("--where", looked.where or None), ("--column", looked.column), ("--step", looked.step)):
        if value is not None and not drawn and not looked.pareto:
            raise UsageError(f"{flag}: expected --plot or --pareto")
    if dask is not None and workers != 1:
        raise UsageError("--workers: expected nothing with --dask, whose cluster has its own")
    quiet()
    with _executor(dask, workers) as (executor, width), _shown() as progress:
        try:
            results = run(study, output, workers=width, executor=executor, restart=restart, progress=progress)
        except KeyboardInterrupt:
            progress.stop()
            command = "the same command without --restart" if restart else "the same command"
            typer.echo(f"note: finished points are kept: {command} goes on", err=True)
            raise
    said = tell(_failed(results))
    from stochfuse.report import study_figures as studies

    to, where = Written(format, None, plot, digits), _pairs(looked.where or [])
    if looked.pareto:
        from stochfuse.report.study_slices import fixed_values
        from stochfuse.studies.pareto import pareto

        front = pareto(results, looked.column, looked.step, fixed_values(results.plan, where))
        said += tell(f"note: {note}" for note in front.notes)
        shown = studies.pareto_report(front, results, digits)
        to.write(shown)
        page.write(shown, results.plan.base, said)
        return
    keys = None if looked.over is None else tuple(key.strip() for key in looked.over.split(","))
    shown = studies.summary_report(results, digits, (keys, looked.column, looked.kind or KINDS[0], where, looked.step))
    to.write(shown)
    page.write(shown, results.plan.base, said)


def _failed(results: Results) -> Iterator[str]:
    from stochfuse.errors import StochfuseError

    if results.failed:
        point, reason = results.first_errors[0]
        if results.failed == results.plan.size:
            raise StochfuseError(f"all {results.failed} points failed (see {results.path}); the first: {reason}")
        yield f"warning: {results.failed} of {results.plan.size} points failed; the first, point {point}: {reason}"


def _pairs(texts: list[str]) -> dict[str, str]:
    found = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"--where: expected KEY=VALUE, got '{text}'")
        if key.strip() in found:
            raise UsageError(f"--where: expected each key once, got {key.strip()} twice")
        found[key.strip()] = value.strip()
    return found


@contextmanager
def _executor(address: str | None, workers: int) -> Iterator[tuple[Executor | None, int]]:
    """Connect to a cluster, if one is asked for."""
    if address is None:
        yield None, workers
        return
    try:
        from distributed import Client
    except ImportError:
        raise UsageError("--dask needs dask.distributed: pip install 'stochfuse[scale]'") from None
    try:
        client: Any = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise UsageError(f"--dask {address}: expected a Dask scheduler that answers, got {error}") from None
    with client:
        width = sum(client.nthreads().values())
        if not width:
            raise UsageError(f"--dask {address}: expected a cluster with workers, got none (dask worker {address})")
        yield client.get_executor(), width


@contextmanager
def _shown() -> Iterator[Any]:
    """Show progress on standard error, and leave the terminal as it was whatever happens."""
    bar = _Bar() if sys.stderr is not None and sys.stderr.isatty() else _Lines()
    try:
        yield bar
    finally:
        bar.stop()


class _Bar:
    """A bar with rate and remaining time."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._task: Any = None

    def begin(self, points: int, done: int, what: str) -> None:
        """Begin another piece of work."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self.stop()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar.start()
        self._task = self._bar.add_task(what, total=points, completed=done, rate="")
        self._done, self._start = 0, time.monotonic()

    def advance(self, points: int) -> None:
        """Move the bar."""
        self._done += points
        rate = self._done / max(time.monotonic() - self._start, 1e-9)
        self._bar.update(self._task, advance=points, rate=f"{rate:,.0f}/s")

    def stop(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class _Lines:
    """A line now and then, for files."""

    def begin(self, points: int, done: int, what: str) -> None:
        """Begin another piece of work."""
        self._points, self._before, self._done, self._what = points, done, 0, what
        self._start = self._last = time.monotonic()
        if done and what == "computing":
            typer.echo(f"note: {done} of {points} points are there already", err=True)

    def advance(self, points: int) -> None:
        """Say how far it is, if it has not been said for a while."""
        self._done += points
        now = time.monotonic()
        if now - self._last >= EVERY:
            self._last, rate = now, self._done / (now - self._start)
            done = self._before + self._done
            left = (self._points - done) / rate
            typer.echo(f"{self._what}: {done:,} of {self._points:,} points, {rate:,.0f}/s, {left:.0f} s left", err=True)

    def stop(self) -> None:
        """Nothing to take away."""
