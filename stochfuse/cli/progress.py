"""Signs of life on standard error: what long work is about to do, and how far it is.

The door of the command line listens to every command (`shown`).  Work that takes longer than `PATIENCE` gets a bar in a
terminal, and elsewhere a line now and then, whichever engine does it; what is quick says nothing.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from stochfuse.estimators.progress import Progress, listening

PATIENCE = 2.0
"""Seconds of work after which the user is told of it."""
FAST = 10.0
"""Pieces of work a second from which on their rate is shown."""
LINES = (2.0, 10.0, 30.0)
"""Seconds after which a line is written where there is no terminal; from then on every minute."""


class ProgressThread(Progress):
    """A thread that shows what the work last said."""

    def __init__(self) -> None:
        self._last, self._silence = ("working", 0, 0), 0.0
        self._start = time.monotonic()
        self._since = (self._start, 0)
        self._shown, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._bar if _terminal() else self._lines, daemon=True)
        self._thread.start()

    def expect(self, outcomes: int, graphs: int) -> None:
        """Say how much work there is."""
        from stochfuse.report.table import counted

        work = f"{counted(outcomes, 'outcome')}; about {counted(graphs, 'different graph')} to carry"
        typer.echo(f"note: {work}", err=True)

    def advance(self, what: str, done: int, total: int) -> None:
        """Keep what was said last."""
        if what != self._last[0]:
            self._since = (time.monotonic(), done)
        self._last = (what, done, total)

    def known_long(self, silence: float) -> None:
        """Show a bar at once; without a terminal no line before so many seconds have passed."""
        self._silence = silence
        self._shown.set()

    def stop(self) -> None:
        """Take the bar away, and say no more."""
        self._over.set()
        self._shown.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _bar(self) -> None:
        self._shown.wait(PATIENCE)
        if self._over.is_set():
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        texts = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}")
        times = TimeElapsedColumn(), TimeRemainingColumn()
        with Bar(*texts, *times, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
            task = bar.add_task("working", total=None, rate="")
            while not self._over.wait(0.2):
                (what, done, total), (start, first) = self._last, self._since
                rate = (done - first) / max(time.monotonic() - start, 1e-9)
                shown = f"{rate:,.0f}/s" if rate >= FAST else ""
                bar.update(task, description=what, completed=done, total=total or None, rate=shown)

    def _lines(self) -> None:
        said = 0
        while True:
            due = LINES[said] if said < len(LINES) else 60.0 * (said - len(LINES) + 1)
            if self._over.wait(max(0.0, self._start + due - time.monotonic())):
                return
            what, done, total = self._last
            share = f", {done:,} of {total:,}" if total else ""
            if due >= self._silence:
                typer.echo(f"note: {what}{share}; {due:.0f} s so far", err=True)
            said += 1


def _terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


_now: list[ProgressThread] = []


@contextmanager
def shown() -> Iterator[None]:
    """Show the progress of the work inside, and leave the terminal as it was whatever happens."""
    _now.append(ProgressThread())
    try:
        with listening(_now[-1]):
            yield
    finally:
        _now.pop().stop()


def known_long(silence: float) -> None:
    """Tell whoever shows progress that work is long; see `ProgressThread.known_long`."""
    for progress in _now:
        progress.known_long(silence)


def quiet() -> None:
    """Say no more: what comes now is the answer, or tells of its progress itself."""
    for progress in _now:
        progress.stop()
