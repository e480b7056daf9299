"""`stochfuse study`: one question asked of many points, as a file, a Pareto front or a plot."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.options import OUTPUT, SHOWN, WORK, Beside, choice, option
from stochfuse.cli.progress import known_long, quiet
from stochfuse.cli.values import named_once, refuse, tell
from stochfuse.errors import UsageError
from stochfuse.estimators.progress import Progress, listener, listening

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from stochfuse.studies.files import Results
    from stochfuse.studies.running import StudyProgress

SILENCE = 30.0
"""Seconds before the first line of progress where there is no terminal for a bar."""
PATIENCE = 10
"""Seconds in which a scheduler should answer."""


KINDS = ("heat", "contour")
EXAMPLES = (
    "stochfuse study trade.toml --workers 2",
    "stochfuse study trade.toml --over network.link,model.R --plot trade.png",
)


@dataclass(frozen=True)
class Looked:
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


@dataclass(frozen=True)
class StudyOptions(Beside):
    """A summary on standard output, and the result in a file."""

    output: Annotated[
        Path | None,
        option(
            "The result, .parquet or .csv; default: beside the study file, .parquet.",
            OUTPUT, "--output", "-o", metavar="FILE",
        ),
    ] = None  # fmt: skip


def study(
    study: Annotated[str, typer.Argument(metavar="STUDY", help="TOML or JSON file, - for standard input.")],
    workers: Annotated[int, option("Processes; default: 1.", WORK, min=1, metavar="N")] = 1,
    dask: Annotated[
        str | None, option("Work on the cluster of this Dask scheduler, tcp://host:8786.", WORK, metavar="ADDRESS")
    ] = None,
    restart: Annotated[bool, option("Begin anew, and replace a result that is there.", WORK, "--restart")] = False,
    looked: Looked = Looked(),
    to: StudyOptions = StudyOptions(),
) -> None:
    """Predict many points: a grid, a list or a Latin hypercube over scenario keys and methods.

    The result has one row per point and step. Killed at any moment, the same command goes on where it stopped; when it
    is finished, it shows what there is.
    """
    # one thread in matrix products, before NumPy is there: these are small, and workers have a processor each
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from stochfuse.studies.running import study as run

    to.check(study)
    drawn = to.plot is not None or to.report is not None
    if not drawn or looked.pareto:
        refuse({"--over": looked.over, "--kind": looked.kind}, "--plot without --pareto")
    if not drawn and not looked.pareto:
        of_points = {"--where": looked.where, "--column": looked.column, "--step": looked.step}
        refuse(of_points, "--plot or --pareto")
    if dask is not None and workers != 1:
        raise UsageError("--workers: expected nothing with --dask, whose cluster has its own")
    told = _progress()
    with _executor(dask, workers) as (executor, width), listening(Progress()):  # single points are not told of
        try:
            results = run(study, to.output, workers=width, executor=executor, restart=restart, progress=told)
        except KeyboardInterrupt:
            quiet()
            command = "the same command without --restart" if restart else "the same command"
            tell([f"note: finished points are kept: {command} goes on"])
            raise
    quiet()
    said = tell(_failed(results))
    from stochfuse.report import study_figures as studies

    where = named_once("--where", looked.where or [], "KEY=VALUE", "each key once")
    if looked.pareto:
        from stochfuse.report.study_slices import fixed_values
        from stochfuse.studies.pareto import pareto

        front = pareto(results, looked.column, looked.step, fixed_values(results.plan, where))
        said += tell(f"note: {note}" for note in front.notes)
        shown = studies.pareto_report(front, results, to.digits)
    else:
        keys = None if looked.over is None else tuple(key.strip() for key in looked.over.split(","))
        drawn = (keys, looked.column, looked.kind or KINDS[0], where, looked.step)
        shown = studies.summary_report(results, to.digits, drawn)
    to.write(shown)
    to.send(shown, results.plan.base, said)


def _failed(results: Results) -> Iterator[str]:
    from stochfuse.errors import StochfuseError

    if results.failed:
        point, reason = results.first_errors[0]
        if results.failed == results.plan.size:
            raise StochfuseError(f"all {results.failed} points failed (see {results.path}); the first: {reason}")
        yield f"warning: {results.failed} of {results.plan.size} points failed; the first, point {point}: {reason}"


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


def _progress() -> StudyProgress:
    """Return what tells whoever shows how far a command is."""
    from stochfuse.studies.running import StudyProgress

    shown = listener()
    known_long(SILENCE)

    class Points(StudyProgress):
        def begin(self, points: int, done: int, what: str) -> None:
            self._what, self._done, self._points = what, done, points
            if done and what == "computing":
                tell([f"note: {done} of {points} points are there already"])

        def advance(self, points: int) -> None:
            self._done += points
            shown.advance(f"{self._what} points", self._done, self._points)

    return Points()
