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

from stochfuse.engines.progress import Progress, listening

PATIENCE = 2.0
"""Seconds of work after which the user is told of it."""
LINES = (2.0, 10.0, 30.0)
"""Seconds after which a line is written where there is no terminal; from then on every minute."""


class ProgressThread(Progress):
    """A thread that shows what the work last said."""

    def __init__(self) -> None:
        self.silence, self._last = 0.0, ("working", 0, 0)
        self._over = threading.Event()
        self._start = time.monotonic()
        self._thread = threading.Thread(target=self._bar if _terminal() else self._lines, daemon=True)
        self._thread.start()

    def expect(self, outcomes: int, graphs: int) -> None:
        """Say how much work there is."""
        from stochfuse.report.table import counted

        work = f"{counted(outcomes, 'outcome')}; about {counted(graphs, 'different graph')} to carry"
        typer.echo(f"note: {work}", err=True)

    def advance(self, what: str, done: int, total: int) -> None:
        """Keep what was said last."""
        self._last = (what, done, total)

    def stop(self) -> None:
        """Take the bar away, and say no more."""
        self._over.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _bar(self) -> None:
        if self._over.wait(PATIENCE):
            return
        from rich.console import Console
        from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        texts = SpinnerColumn(), TextColumn("{task.description}"), BarColumn()
        with Bar(
            *texts,
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            redirect_stdout=False,
        ) as bar:
            task = bar.add_task("working", total=None)
            while not self._over.wait(0.2):
                what, done, total = self._last
                bar.update(task, description=what, completed=done, total=total or None)

    def _lines(self) -> None:
        said = 0
        while True:
            due = LINES[said] if said < len(LINES) else 60.0 * (said - len(LINES) + 1)
            if self._over.wait(max(0.0, self._start + due - time.monotonic())):
                return
            what, done, total = self._last
            share = f", {done:,} of {total:,}" if total else ""
            if due >= self.silence:
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


def patient(seconds: float) -> None:
    """Write no line before so many seconds have passed."""
    for progress in _now:
        progress.silence = seconds


def quiet() -> None:
    """Say no more: what comes now is the answer, or tells of its progress itself."""
    for progress in _now:
        progress.stop()
