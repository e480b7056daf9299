"""What the thesis states about its figures, and how our numbers judge it.

A statement is declared above the function that works out its numbers and says whether they meet the criterion.  A
verdict is "agrees" or "differs" from that alone.  Where the cause of what the thesis saw is known, the check works out
the numbers of the cause as well and the verdict is "explained" only if both hold; where neither can be decided, "open".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stochfuse.report.reproductions import Finding
from stochfuse.thesis.bench import ARCHITECTURES, Bench, Sweep, ThesisCase

Verdict = tuple[str, str]
"""The verdict and our numbers in words."""
Check = Callable[..., Verdict]


@dataclass(frozen=True)
class Statement:
    """Something that the thesis states.

    Parameters
    ----------
    items : keys of the figures and tables that it is about.
    thesis : the statement, in our words.
    criterion : what the verdict follows from.
    check : works out verdict and numbers.
    """

    items: tuple[str, ...]
    thesis: str
    criterion: str
    check: Callable[[Bench], Verdict]

    def judge(self, bench: Bench) -> Finding:
        """Return the statement with our numbers and the verdict."""
        verdict, ours = self.check(bench)
        return Finding(self.items, self.thesis, ours, self.criterion, verdict)


class Stated(list[Statement]):
    """The statements of a chapter: a decorator declares one above its check."""

    def about(self, items: Sequence[int | str], thesis: str, criterion: str, **given: Any) -> Callable[[Check], Check]:
        """Declare a statement about some figures, or tables by key; the check takes a bench and what is given."""
        keys = tuple(item if isinstance(item, str) else f"figure-{item}" for item in items)

        def declare(check: Check) -> Check:
            self.append(Statement(keys, thesis, criterion, partial(check, **given)))
            return check

        return declare

    def of(
        self,
        figures: Mapping[int, ThesisCase],
        thesis: str,
        criterion: str,
        networks: Sequence[str] = ARCHITECTURES,
        *,
        next_figure: int = 1,
        also: int | None = None,
        **given: Any,
    ) -> Callable[[Check], Check]:
        """Declare a statement of each scenario and network; the check takes a sweep and what is given.

        Parameters
        ----------
        figures : the scenario's figure of the first network.
        thesis : {network} in it is the network's name.
        next_figure : how many figures further the next network's is.
        also : another figure of the first network.
        """

        def declare(check: Check) -> Check:
            for first, case in figures.items():
                for i, network in enumerate(networks):
                    numbers = [number + next_figure * i for number in (first, also) if number is not None]
                    text = thesis.replace("{network}", network.replace("-", " "))
                    on_sweep = partial(_on_sweep, check, case=case, architecture=network, **given)
                    self.about(numbers, text, criterion)(on_sweep)
            return check

        return declare


def _on_sweep(check: Check, bench: Bench, case: ThesisCase, architecture: str, **given: Any) -> Verdict:
    return check(Sweep(bench, case, architecture), **given)


def judged(holds: bool | np.bool_, ours: str, otherwise: str = "differs") -> Verdict:
    """Return "agrees" if the criterion is met."""
    return ("agrees" if holds else otherwise), ours


def explained(seen: bool | np.bool_, cause: bool | np.bool_, ours: str) -> Verdict:
    """Return "explained" if what the thesis saw is seen and its cause is shown; else what is left."""
    return ("explained" if seen and cause else "agrees" if seen else "differs"), ours


def listed(values: Sequence[float] | np.ndarray, digits: int = 4) -> str:
    """Return numbers in words: 1, 2, 3."""
    return ", ".join(f"{value + 0.0:.{digits}g}" for value in values)
