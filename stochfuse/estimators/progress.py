"""What long work says of how far it is, to whoever listens.

Who works does not know who asked.  It says `listener().advance("step 3", done, total)`, and whoever wants to know of
the work wraps it in `with listening(progress):`; without that nobody hears it, and it costs nothing worth naming.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


@contextmanager
def uncollected() -> Iterator[None]:
    """Keep the garbage collector from going through millions of small tuples, none in a cycle, again and again.

    Those that stay are old ones afterwards: as new ones they would be gone through at once.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.unfreeze()
        if enabled:
            gc.enable()


class Progress:
    """Told what long work is about to do and how far it is; this one says nothing."""

    def expect(self, outcomes: int, graphs: int) -> None:
        """Told once, before long work starts: number of outcomes, and of different states in the last layer."""

    def advance(self, what: str, done: int, total: int) -> None:
        """Told within a piece of work: so much of it is done."""


_LISTENER: ContextVar[Progress] = ContextVar("listener", default=Progress())  # noqa: B039


def listener() -> Progress:
    """Return who listens."""
    return _LISTENER.get()


@contextmanager
def listening(progress: Progress) -> Iterator[None]:
    """Let `progress` hear of the work inside."""
    token = _LISTENER.set(progress)
    try:
        yield
    finally:
        _LISTENER.reset(token)


class _Within(Progress):
    def __init__(self, outer: Progress, name: str, number: int, of: int) -> None:
        self._outer, self._name, self._share = outer, f"{name} ({number} of {of})", (number - 1, of)
        outer.advance(self._name, *self._share)

    def expect(self, outcomes: int, graphs: int) -> None:
        self._outer.expect(outcomes, graphs)

    def advance(self, what: str, done: int, total: int) -> None:
        self._outer.advance(f"{self._name}: {what}", done, total)


@contextmanager
def within(name: str, number: int, of: int) -> Iterator[None]:
    """Let whoever listens hear which of several pieces of work it is that the work inside tells of."""
    with listening(_Within(listener(), name, number, of)):
        yield
