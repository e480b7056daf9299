"""Engines average an estimator over chance."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Keep the garbage collector from going through millions of small tuples, none in a cycle, again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Progress:
    """Told what long work is about to do and how far it is; this one says nothing."""

    def expect(self, outcomes: int, graphs: int) -> None:
        """Told once, before long work starts: number of outcomes, and of different states in the last layer."""

    def advance(self, step: int, done: int, total: int) -> None:
        """Told within a step; step 0 stands for work that is not divided into steps."""
