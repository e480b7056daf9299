"""One number out of a covariance: trace, determinant, largest eigenvalue, one state, RMS of a sub-block.

A metric is named as the command line takes it: `trace`, `det`, `max-eig`, `var:x`, `std:x` or `rms:x,y` (the root
of the sum of the named states' variances), with the states' own names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from stochfuse.errors import UsageError, nearest

NAMES = "trace, det, max-eig, var:STATE, std:STATE or rms:STATE,STATE,…"


class Labelled(Protocol):
    """A state whose components have names and units, empty where there is none."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the components."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the components."""
        ...


@dataclass(frozen=True)
class Metric:
    """A number per covariance.

    Parameters
    ----------
    name : as the command line takes it.
    label : for people: what it is, of which states.
    unit : its unit; empty if the states have none or different ones.
    of : the function, from (..., d, d) to (...).
    mixed : whether it adds up quantities of different units.
    linear : whether the metric of a sum is the sum of the metrics.
    states : indices of the states that it looks at.
    names : their names.
    root_unit : unit of those states themselves; empty if they have none or different ones.
    squared : whether the metric is in squares of the states' units.
    """

    name: str
    label: str
    unit: str
    of: Callable[[np.ndarray], np.ndarray]
    mixed: bool = False
    linear: bool = False
    states: tuple[int, ...] = ()
    names: str = ""
    root_unit: str = ""
    squared: bool = False


def metric(name: str, model: Labelled) -> Metric:
    """Return the metric of a name.

    Raises
    ------
    UsageError
        If there is no such metric or state.
    """
    kind, _, rest = name.partition(":")
    everything = ", ".join(model.states)
    if kind in ("trace", "det", "max-eig") and not rest:
        mixed = len(set(model.units)) > 1
        unit = "" if mixed else model.units[0]
        square = power(unit, 2)
        of = partial(Metric, states=tuple(range(len(model.states))), names=everything, root_unit=unit, squared=True)
        if kind == "trace":
            label = f"trace over {everything}" if len(model.states) > 1 else f"variance of {everything}"
            return of(name, label, square, _trace, mixed, linear=True)
        if kind == "max-eig":
            return of(name, f"largest eigenvalue over {everything}", square, _largest, mixed)
        units = " ".join(filter(None, (power(u, 2) for u in model.units)))
        return of(name, f"determinant over {everything}", units, np.linalg.det)
    if kind in ("var", "std", "rms") and rest:
        chosen = [_index(name, state.strip(), model) for state in rest.split(",")]
        if len(set(chosen)) < len(chosen):
            raise UsageError(f"metric '{name}': a state is named twice")
        if kind != "rms" and len(chosen) > 1:
            raise UsageError(f"metric '{name}': expected one state, got {len(chosen)}; use rms: for several")
        units = {model.units[i] for i in chosen}
        unit, mixed = (units.pop(), False) if len(units) == 1 else ("", True)
        names = ", ".join(model.states[i] for i in chosen)
        of = partial(Metric, states=tuple(chosen), names=names, root_unit=unit)
        if kind == "var":
            variance = lambda P: P[..., chosen[0], chosen[0]]  # noqa: E731
            return of(name, f"variance of {names}", power(unit, 2), variance, linear=True, squared=True)
        if kind == "std":
            return of(name, f"standard deviation of {names}", unit, lambda P: np.sqrt(P[..., chosen[0], chosen[0]]))
        root = f"RMS of {names} (root of the summed variances)" if len(chosen) > 1 else f"RMS of {names}"
        return of(name, root, unit, lambda P: np.sqrt(_trace(P[..., chosen, :][..., chosen])), mixed)
    if name in ("var", "std", "rms"):
        alike = [state for state, unit in zip(model.states, model.units, strict=True) if unit == model.units[0]]
        some = ",".join(alike[: 1 if name != "rms" else None])
        raise UsageError(f"metric: expected states after it, as in {name}:{some}, got '{name}' alone")
    near = nearest(kind, ("trace", "det", "max-eig", "var", "std", "rms"))
    raise UsageError(f"metric: expected {NAMES}, got '{name}'{near}")


def _index(name: str, state: str, model: Labelled) -> int:
    if state not in model.states:
        near = nearest(state, model.states)
        raise UsageError(f"metric '{name}': no state '{state}'{near}; the states are {', '.join(model.states)}")
    return model.states.index(state)


def _trace(P: np.ndarray) -> np.ndarray:
    return np.trace(P, axis1=-2, axis2=-1)


def _largest(P: np.ndarray) -> np.ndarray:
    return np.linalg.eigvalsh(P)[..., -1]


def power(unit: str, exponent: int) -> str:
    """Return a unit's power: m², (m/s)²."""
    if not unit:
        return ""
    superscript = "²" if exponent == 2 else f"^{exponent}"
    return f"({unit}){superscript}" if "/" in unit else f"{unit}{superscript}"


class Moments(NamedTuple):
    """Moments of the error, of one outcome or expected; stacks of any leading shape.

    Parameters
    ----------
    P : (..., d, d) claimed covariance.
    actual : (..., d, d) actual covariance, or None where it was not asked for.
    bias : (..., d, 1) mean error, or None.
    square : (..., d, d) mean squared error, actual + bias biasᵀ, or None.
    """

    P: Any
    actual: Any = None
    bias: Any = None
    square: Any = None

    @classmethod
    def of(cls, P: Any, actual: Any, bias: Any) -> Moments:
        """Return the moments of one outcome."""
        return cls(P, actual, bias, actual + bias @ np.swapaxes(bias, -1, -2))

    @classmethod
    def of_optimum(cls, P: Any, bias: Any) -> Moments:
        """Return the moments of what achieves what it claims; without a known error nothing is known of a bias."""
        return cls(P, P, None, P) if bias is None else cls.of(P, P, bias)

    @classmethod
    def of_footprint(cls, P: Any, x: Any) -> Moments:
        """Return the moments from noise footprints x, (..., d, columns), whose last column is the bias."""
        noises, bias = x[..., :-1], x[..., -1:]
        return cls.of(P, noises @ np.swapaxes(noises, -1, -2), bias)

    def map(self, function: Any) -> Moments:
        """Return what a function makes of every moment there is."""
        return Moments(*(None if m is None else function(m) for m in self))
