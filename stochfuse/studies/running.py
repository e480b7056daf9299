"""A study from file to result: chunks of points on an executor, kept in the journal as they come, written in order.

A chunk's answers depend on the chunk alone, so that the result is the same to the last bit whoever works it out, in
whatever order, and however often it was interrupted.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from stochfuse.errors import StochfuseError, UsageError
from stochfuse.studies.evaluation import evaluate
from stochfuse.studies.files import Results, check_format, packed, unpacked, write_result
from stochfuse.studies.journal import DamagedError, Journal
from stochfuse.studies.plan import Plan
from stochfuse.studies.reading import load_study, plan_of, software

WAITING = 3
"""Chunks that are handed out for each worker: enough to keep it busy, few enough to hold little."""
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
LEFT_BEHIND = "ignore:resource_tracker:UserWarning"
"""A killed study's semaphores are removed by Python's tracker, which need not warn of them."""
MOST_DEADLY = 3
"""Chunks that kill their worker, after which the study stops."""
AGAIN = "finished points are kept: the same command goes on"


class StudyProgress:
    """How far a study is; this one says nothing."""

    def begin(self, points: int, done: int, what: str) -> None:
        """So many points, so many of them done before, and what is done with them."""

    def advance(self, points: int) -> None:
        """So many points more."""


def study(
    source: str | Path | Mapping[str, Any],
    output: str | Path | None = None,
    *,
    workers: int = 1,
    executor: Executor | None = None,
    restart: bool = False,
    progress: StudyProgress | None = None,
) -> Results:
    """Run a study, or go on with it where it stopped.

    Parameters
    ----------
    source : study file, "-" for standard input, or a mapping with a study file's keys.
    output : the result's file, .parquet or .csv; default: beside the study file, with its name and .parquet.
    workers : processes.
    executor : who does the work instead: any `concurrent.futures.Executor`, such as that of a Dask client; its workers
        need the same versions of stochfuse, NumPy and SciPy.  `workers` is then how many it has, if more than 1.
    restart : forget what there is of it.
    progress : told how far it is.

    Returns
    -------
    Results

    Raises
    ------
    ScenarioError
        If the study file does not fit together.
    UsageError
        If the result cannot be written, is of another study, or the study has been changed since it was begun.
    StochfuseError
        If workers die over and over again.
    """
    if workers < 1:
        raise UsageError(f"workers: expected a whole number of at least 1, got {workers}")
    plan = load_study(source)
    target = result_path(source, output)
    check_format(target)
    progress = progress or StudyProgress()
    journal = Journal(target, plan.record, plan.name)
    if not restart and journal.finished:
        journal.clean()
        return results_of(plan, journal)
    with journal.open(restart=restart):
        done = journal.done()
        _work(plan, journal, done, executor, workers, progress)
        journal.finish(lambda path: _write(plan, journal, path, progress))
    return results_of(plan, journal)


def result_path(source: str | Path | Mapping[str, Any], output: str | Path | None) -> Path:
    """Return the result's file: the one asked for, or the study file's with .parquet."""
    if output is not None:
        return Path(output)
    if isinstance(source, Mapping) or str(source) == "-":
        raise UsageError("output: expected a file for the result, got nothing")
    return Path(source).with_suffix(".parquet")


def results_of(plan: Plan, journal: Journal) -> Results:
    """Return what a finished journal has."""
    facts = journal.facts
    errors = tuple((point, reason) for point, reason in facts["first_errors"])
    return Results(plan, journal.output, facts["rows"], facts["failed"], errors)


def _write(plan: Plan, journal: Journal, path: Path, progress: StudyProgress) -> dict[str, Any]:
    progress.begin(plan.size, 0, "writing")

    def answers() -> Iterator[Any]:
        for chunk in range(plan.chunks):
            points = plan.range_of(chunk)
            try:
                yield points, unpacked(journal.read(chunk))
            except (DamagedError, FileNotFoundError):
                raise UsageError(
                    f"{journal.folder}: part {chunk} was damaged after it was written: the same command mends it"
                ) from None
            progress.advance(len(points))

    return write_result(plan, answers(), path)


def _work(
    plan: Plan, journal: Journal, done: set[int], executor: Executor | None, workers: int, progress: StudyProgress
) -> None:
    todo = [chunk for chunk in range(plan.chunks) if chunk not in done]
    progress.begin(plan.size, plan.size - sum(len(plan.range_of(c)) for c in todo), "computing")
    if executor is None and workers == 1:
        for chunk in todo:
            journal.commit(chunk, packed(evaluate(plan, plan.range_of(chunk))))
            progress.advance(len(plan.range_of(chunk)))
        return
    pending, suspects, deadly = dict.fromkeys(todo), [], []
    while pending:
        alone = bool(suspects)
        handed = suspects[:1] if alone else list(pending)
        try:
            with _executor(executor, 1 if alone else workers) as (using, width):
                for chunk, data in _answered(using, width, json.dumps(plan.record), handed, executor is not None):
                    journal.commit(chunk, data)
                    pending.pop(chunk)
                    progress.advance(len(plan.range_of(chunk)))
            suspects = suspects[1:]
        except BrokenExecutor as error:
            if executor is not None:
                raise StochfuseError(f"a worker died ({error or 'no reason given'}); {AGAIN}") from None
            if alone:  # its worker had nothing else to do
                deadly.append(suspects.pop(0))
                pending.pop(deadly[-1])
                if len(deadly) == MOST_DEADLY:
                    break
            else:
                suspects = list(pending)[:workers]
    if deadly:
        points, hint = plan.range_of(deadly[0]), ""
        if len(deadly) == MOST_DEADLY:
            hint = f", and {MOST_DEADLY - 1} times more (is the script guarded by if __name__ == '__main__'?)"
        raise StochfuseError(
            f"a worker died at points {points.start} to {points.stop - 1}, again when it was alone with them{hint}; "
            "what is finished is kept"
        )


def _answered(
    executor: Executor, width: int, record: str, todo: Iterable[int], given: bool
) -> Iterator[tuple[int, bytes]]:
    """Chunks with their answers as they come, few under way at a time; none stays with an executor that was given."""
    waiting, chunks = {}, iter(todo)
    try:
        while True:
            for chunk in islice(chunks, WAITING * width - len(waiting)):
                with _undisturbed():
                    waiting[executor.submit(answer, record, chunk)] = chunk
            if not waiting:
                return
            finished, _ = wait(list(waiting), return_when=FIRST_COMPLETED)
            for future in sorted(finished, key=waiting.__getitem__):
                chunk = waiting.pop(future)
                yield chunk, _checked(future)
    except BrokenExecutor:
        given = False
        raise
    finally:
        # a pool whose workers are gone tells each future so, and stumbles over one that was cancelled meanwhile
        for future in waiting if given else ():
            future.cancel()


def answer(record: str, chunk: int) -> tuple[bytes, dict[str, str]]:
    """Work out a chunk: what a worker does."""
    plan = plan_of(record)
    return packed(evaluate(plan, plan.range_of(chunk))), software()


def _checked(future: Future[tuple[bytes, dict[str, str]]]) -> bytes:
    try:
        data, theirs = future.result()
    except (StochfuseError, BrokenExecutor):
        raise
    except (Exception, CancelledError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise StochfuseError(f"a worker failed ({reason}); {AGAIN}") from None
    ours = software()
    if theirs != ours:
        unlike = [name for name in ours if theirs.get(name) != ours[name]]
        different = ", ".join(f"{name} {theirs.get(name)} instead of {ours[name]}" for name in unlike)
        raise UsageError(f"workers: expected the same software as here, got {different}")
    return data


@contextmanager
def _executor(given: Executor | None, workers: int) -> Iterator[tuple[Executor, int]]:
    """Return who does the work, and how many at a time."""
    if given is not None:
        yield given, workers if workers > 1 else getattr(given, "_max_workers", None) or os.cpu_count() or 1
        return
    # a worker has one processor: more threads in its matrix products would only be in the others' way
    warnings = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), LEFT_BEHIND)))
    changed: dict[str, str] = {**dict.fromkeys(THREADS, "1"), "PYTHONWARNINGS": warnings}
    before, others = {name: os.environ.get(name) for name in changed}, multiprocessing.active_children()
    os.environ.update(changed)
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        yield pool, workers
    except BaseException:
        for child in set(multiprocessing.active_children()) - set(others):
            child.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let Ctrl-C wait while a worker may be started, who inherits that it waits until `_begin` ignores it."""
    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Leave Ctrl-C to the process that hands out the work, and end with it, also if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
