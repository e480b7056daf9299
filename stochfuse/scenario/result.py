"""What all results have, what is given included: a short name, a table, records, arrays and a figure.

Results know nothing of what shows them (`stochfuse.report`): they reach it through the one door `stochfuse.shown`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

import stochfuse


class Result:
    """What all results have: a short name for the prompt, a table for notebooks, records, arrays and a figure."""

    def __repr__(self) -> str:
        """One line: the fields, arrays by their shapes."""
        return brief(self, [f.name for f in fields(self)])  # type: ignore[arg-type]

    def _repr_html_(self) -> str:
        return stochfuse.shown("html_of", self)

    def to_dataframe(self, **shown: Any) -> Any:
        """Return a tidy pandas DataFrame, a number a row (extra `data`).

        Parameters
        ----------
        **shown : of predictions and comparisons: `of`, the metric, and `agent`.
        """
        return stochfuse.shown("frame_of", self, **shown)

    def to_xarray(self) -> Any:
        """Return an xarray object with named axes (extra `data`); of predictions and comparisons the covariances."""
        return stochfuse.shown("arrays_of", self)

    def plot(self, ax: Any = None, **shown: Any) -> Any:
        """Draw it, as `--plot` does, and return the figure; on some axes if they are given (predictions)."""
        return stochfuse.shown("figure_of", self, ax, **shown)


LONGEST = 390
"""Letters of a result's short name."""


def brief(result: Any, names: Iterable[str]) -> str:
    """One line for the prompt: a result's fields, arrays by their shapes."""
    text = f"{type(result).__name__}({', '.join(f'{name}={_brief(getattr(result, name))}' for name in names)})"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 2]}…)"


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if value is None or isinstance(value, bool | int | np.integer | str):
        return repr(value)
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    if isinstance(value, tuple | list | Mapping):
        return f"{len(value)} of them" if value else "()"
    name = getattr(value, "name", None)
    return f"<{name if isinstance(name, str) else type(value).__name__}>"
