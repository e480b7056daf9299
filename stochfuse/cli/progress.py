"""Long work says on standard error what it is about to do and how far it is."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from stochfuse.engines.progress import Progress


class Shown(Progress):
    """Notes and, in a terminal, a bar."""

    def __init__(self) -> None:
        self._bar = None
        self._task = None
        self._step: int | None = None

    def expect(self, outcomes: int, graphs: int) -> None:
        """Say how much work there is."""
        from stochfuse.report.predictions import counted

        work = f"{counted(outcomes, 'outcome')}; about {counted(graphs, 'different graph')} to carry"
        typer.echo(f"note: {work}", err=True)

    def advance(self, step: int, done: int, total: int) -> None:
        """Move the bar."""
        if not sys.stderr.isatty() or (self._bar is None and total < 100 and step):
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import Progress as Bar

            self._bar = Bar(console=Console(stderr=True), transient=True)
            self._bar.start()
        if self._step != step or self._task is None:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._step, self._task = step, self._bar.add_task(f"step {step}" if step else "sampling", total=total)
        if done % 16 == 0 or done == total or not step:
            self._bar.update(self._task, completed=done)

    def stop(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = self._task = None


@contextmanager
def shown() -> Iterator[Shown]:
    """Show progress, and leave the terminal as it was whatever happens."""
    progress = Shown()
    try:
        yield progress
    finally:
        progress.stop()
