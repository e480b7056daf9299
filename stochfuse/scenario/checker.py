"""Reads numbers from outside by their path, and remembers what was wrong: one message names every offending key."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from stochfuse.errors import Problem
from stochfuse.kalman.checks import LARGEST, MOST, covariance_fault, shown, size


def table_of(mapping: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a table within another; empty where there is none, or something else, which its structure tells."""
    inner = mapping.get(key)
    return inner if isinstance(inner, Mapping) else {}


def tables_of(value: Any) -> list[Mapping[str, Any]]:
    """Return a list of tables, empty ones in the place of what is none."""
    return [each if isinstance(each, Mapping) else {} for each in (value if isinstance(value, list | tuple) else ())]


class Checker:
    """Reads values by their path and remembers what was wrong.

    Every method returns None where it noted a problem or where the value was not given.
    """

    def __init__(self, skip: set[str] | frozenset[str] = frozenset()):
        self.problems: list[Problem] = []
        self._skip = skip

    def note(self, path: str, expected: str, got: str) -> None:
        """Remember one problem, unless something is known to be wrong there already."""
        if path not in self._skip and all(problem.path != path for problem in self.problems):
            self.problems.append(Problem(path, expected, got))

    def absent(self, path: str, table: Mapping[str, Any], keys: Iterable[str], expected: str) -> None:
        """Note keys of a table that must not be given."""
        for key in keys:
            if table.get(key) is not None:
                self.note(f"{path}.{key}", expected, shown(table[key]))

    def array(self, path: str, value: Any, expected: str) -> np.ndarray | None:
        """Any array of finite floats."""
        if value is None or path in self._skip:
            return None
        try:
            array = np.array(value, dtype=float)
        except OverflowError:
            self.note(path, expected, "a number beyond floating point")
            return None
        except (ValueError, TypeError):
            uneven = "" if isinstance(value, str) else " (rows of different length?)"
            self.note(path, expected, f"{shown(value)}{uneven}")
            return None
        if not np.isfinite(array).all():
            self.note(path, expected, "a value that is not finite (NaN or infinity)")
            return None
        if array.size and np.abs(array).max() > LARGEST:
            self.note(path, f"numbers of at most {LARGEST:g} in size", f"{array.flat[np.abs(array).argmax()]:g}")
            return None
        array.setflags(write=False)
        return array

    def number(
        self, path: str, value: Any, expected: str, fits: Callable[[Any], Any] = lambda number: True
    ) -> float | None:
        """Read one finite number that fits."""
        array = self.array(path, value, expected)
        if array is None:
            return None
        if array.ndim or not fits(array):
            self.note(path, expected, shown(value))
            return None
        return float(array)

    def matrix(
        self, path: str, value: Any, rows: int | None, columns: int | None, steps: int, *, identity: bool = False
    ) -> np.ndarray | None:
        """Read a matrix, constant (2 axes) or per step (3 axes, at least `steps` entries).

        Where rows or columns are None they may be any number, and steps = 0 takes constants only; a number is 1×1, or
        that multiple of the identity if `identity` is set.
        """
        shape = f"{rows or ''}{'×' if rows and columns else ''}{columns or ''}"
        kind = "matrix" if not shape else f"{shape} matrix" if rows and columns else f"matrix with {shape} "
        kind += "" if not shape or (rows and columns) else "rows" if rows else "columns"
        expected = f"a number or a {kind} (a list of rows)" + (", or one such matrix per step" if steps else "")
        array = self.array(path, value, expected)
        if array is None:
            return None
        if array.ndim == 0:
            array = array * (np.eye(rows) if identity and rows else np.ones((1, 1)))
            array.setflags(write=False)
        wanted = (rows, columns)
        if array.ndim not in ((2, 3) if steps else (2,)) or 0 in array.shape:
            self.note(path, expected, shown(value))
        elif any(w is not None and w != n for w, n in zip(wanted, array.shape[-2:], strict=True)):
            self.note(path, expected, f"a {size(array.shape[-2:])} matrix")
        elif array.ndim == 3 and len(array) < steps:
            self.note(path, f"one matrix for each of the {steps} steps", f"{len(array)} matrices")
        else:
            return array
        return None

    def covariance(
        self, path: str, value: Any, n: int | None, steps: int, *, definite: bool = False
    ) -> np.ndarray | None:
        """Read a symmetric positive semi-definite (or definite) matrix, made exactly symmetric."""
        array = self.matrix(path, value, n, n, steps, identity=True)
        if array is None:
            return None
        kind = f"a symmetric positive {'definite' if definite else 'semi-definite'} matrix"
        if array.shape[-1] != array.shape[-2]:
            self.note(path, kind, f"a {size(array.shape[-2:])} matrix")
            return None
        fault = covariance_fault(array, definite=definite)
        if fault is not None:
            self.note(path, kind, fault)
            return None
        array = 0.5 * (array + np.swapaxes(array, -1, -2))
        array.setflags(write=False)
        return array

    def vector(self, path: str, value: Any, n: int | None, steps: int | None = None) -> np.ndarray | None:
        """Read a vector as a column (n, 1), or per step (steps, n, 1) if `steps` is given; a number has one entry."""
        shape = "a number or a list of numbers" if n is None else "a number" if n == 1 else f"a list of {n} numbers"
        expected = shape + (", or one such list per step" if steps else "")
        array = self.array(path, value, expected)
        if array is None:
            return None
        if array.ndim == 0:
            array = array[None]
        if array.ndim not in ((1, 2) if steps else (1,)) or 0 in array.shape or n not in (None, array.shape[-1]):
            self.note(path, expected, shown(value))
        elif array.ndim == 2 and steps and len(array) < steps:
            self.note(path, f"one list for each of the {steps} steps", f"{len(array)} lists")
        else:
            return array[..., None]
        return None

    def place(self, path: str, value: Any, axes: int, steps: int) -> np.ndarray | None:
        """Read coordinates (axes,), or as many per step (steps, axes)."""
        found = self.vector(path, value, axes, steps)
        if found is None:
            return None
        return found[:steps, :, 0] if found.ndim == 3 else found[:, 0]

    def series(self, path: str, value: Any, expected: str, steps: int) -> np.ndarray | None:
        """Read a number, or one for each step: an array of shape () or (steps,)."""
        array = self.array(path, value, expected)
        if array is None:
            return None
        if array.ndim > 1:
            self.note(path, expected, shown(value))
        elif array.ndim and len(array) < steps:
            self.note(path, f"one number for each of the {steps} steps", f"{len(array)} numbers")
        else:
            return array[:steps] if array.ndim else array
        return None

    def integer(self, path: str, value: Any, least: int) -> int | None:
        """Read a whole number of at least `least`."""
        if value is None or path in self._skip:
            return None
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            self.note(path, f"a whole number of at least {least}", shown(value))
            return None
        if value > MOST:
            self.note(path, f"at most {MOST}", shown(value))
            return None
        return int(value)

    def name(self, path: str, value: str, *, of_state: bool = False) -> None:
        """Note a name that cannot be shown on one line, or, of a state, cannot be named in a metric."""
        bad = [c for c in value if not c.isprintable() or (of_state and c in ",:")]
        if bad or (of_state and not value.strip()):
            self.note(path, f"printable text{', not empty, without comma and colon' if of_state else ''}", shown(value))

    def choice(self, path: str, value: Any, choices: Sequence[str]) -> str | None:
        """Read one of a few words."""
        if value is None or path in self._skip:
            return None
        if value not in choices:
            self.note(path, "one of " + ", ".join(f'"{c}"' for c in choices), shown(value))
            return None
        return value

    def link(self, path: str, value: Any, agents: int, steps: int) -> np.ndarray | None:
        """Read link probabilities: a number, an n×n matrix µ_ij, or one of either per step.

        Returns an array of shape (), (n, n), (steps,) or (steps, n, n).
        """
        expected = (
            f"a probability, a {agents}×{agents} matrix of them (row: receiver, column: sender), "
            f"or one of either for each of the {steps} steps"
        )
        if value is None or path in self._skip:
            return None
        if isinstance(value, list | tuple | np.ndarray) and len(value):
            depths = [np.ndim(entry) if not isinstance(entry, list | tuple) else _depth(entry) for entry in value]
            fitting = all(len(entry) == agents for entry, depth in zip(value, depths, strict=True) if depth == 2)
            if set(depths) == {0, 2} and fitting:
                value = [
                    np.full((agents, agents), e).tolist() if depth == 0 else e
                    for e, depth in zip(value, depths, strict=True)
                ]
        array = self.array(path, value, expected)
        if array is None:
            return None
        matrix = (agents, agents)
        per_step = array.ndim in (1, 3)
        if array.ndim > 3 or (array.ndim >= 2 and array.shape[-2:] != matrix):
            self.note(path, expected, f"an array of {size(array.shape)}")
        elif per_step and len(array) < steps:
            self.note(path, expected, f"{len(array)} entries")
        elif array.size and (array.min() < 0 or array.max() > 1):
            worst = array.min() if array.min() < 0 else array.max()
            self.note(path, "probabilities between 0 and 1", f"{worst:g}")
        else:
            return array[:steps] if per_step else array
        return None


def _depth(value: Any) -> int:
    depth = 0
    while isinstance(value, list | tuple | np.ndarray):
        depth += 1
        value = value[0] if len(value) else 0.0
    return depth
