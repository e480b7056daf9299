"""What can be asked of an estimate's error: claimed, actual, bias, and what follows from them.

    claimed      P, the covariance that the fusion rule itself reports
    actual       A = Σ_sources c Cov cᵀ, the covariance that the error truly has, from its noise footprint
    optimal      P of the best that linear fusion can do with what arrived
    consistency  A / P, more than 1 where the rule is overconfident
    bias         b, the mean error that a known initial error, common to all agents, leaves behind
    rms          √(A + b bᵀ), the root of the mean squared error

All are expectations over the outcomes: E[P], E[A], E[b] and, inside the root, E[A + b bᵀ], as the thesis' (39) averages
squared errors before it takes the root.  The consistency ratio is that of the two expectations, E[A]/E[P].

The source leaves open whether ratio and root are taken before or after averaging.
Taken of the expectations, as here, they are what the tabulated claimed, actual and bias give; over single outcomes
they are statistics (`stochfuse predict --quantity consistency --statistic quantile:1`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Metric, Moments
from stochfuse.scenario import registry
from stochfuse.scenario.registry import OPTIMAL

QUANTITIES = registry.QUANTITIES
OVERCONFIDENT = 1.05
"""Ratio of actual to claimed from which on a reader is warned."""


_FIELD = {"claimed": "P", OPTIMAL: "P", "actual": "actual", "consistency": "actual", "bias": "bias", "rms": "square"}


def matrix(quantity: str, moments: Moments) -> Any:
    """Return the moment behind a quantity: of consistency the actual covariance, of rms the mean squared error."""
    return getattr(moments, _FIELD[quantity])


def needed(quantity: str, moments: Moments) -> Moments:
    """Return only the moments that a quantity's value is made of."""
    fields = ("P", "actual") if quantity == "consistency" else (_FIELD[quantity],)
    return Moments(*(m if field in fields else None for field, m in zip(Moments._fields, moments, strict=True)))


def value(quantity: str, metric: Metric, moments: Moments) -> np.ndarray:
    """Return a quantity as one number each, (...,), in the metric's sense.

    Raises
    ------
    UsageError
        If the quantity cannot be had of the metric.
    """
    check(quantity, metric)
    if quantity == "consistency":
        claimed, actual = metric.of(moments.P), metric.of(moments.actual)
        return np.divide(actual, claimed, out=np.ones_like(actual), where=claimed != 0)
    return number(quantity, metric, matrix(quantity, moments))


def number(quantity: str, metric: Metric, m: np.ndarray) -> np.ndarray:
    """Return the same from the one moment behind a quantity, which consistency does not have."""
    if quantity == "bias":
        chosen = m[..., list(metric.states), 0]
        return chosen[..., 0] if len(metric.states) == 1 else np.sqrt((chosen**2).sum(axis=-1))
    shown = metric.of(m)
    return np.sqrt(shown) if quantity == "rms" and metric.squared else shown


def check(quantity: str, metric: Metric) -> None:
    """Raise UsageError if a quantity cannot be had of a metric."""
    if quantity in ("bias", "rms") and metric.name == "det":
        raise UsageError(
            f"quantity {quantity}: expected metric trace, max-eig, var:STATE, std:STATE or rms:STATE, got "
            f"'{metric.name}'"
        )


def linear(quantity: str, metric: Metric) -> bool:
    """Whether the number of an expectation is the expectation of the number."""
    if quantity == "bias":
        return len(metric.states) == 1
    return metric.linear and quantity in ("claimed", "actual", OPTIMAL)


def title(quantity: str, stage: str) -> str:
    """Return the quantity in words: 'claimed posterior covariance'."""
    return registry.quantity(quantity).title.format(stage=stage)


def noun(quantity: str, metric: Metric) -> str:
    """Return what of it is shown: 'variance of x'."""
    if quantity == "bias":
        return metric.names if len(metric.states) == 1 else f"length over {metric.names}"
    if quantity == "rms":
        return f"worst direction of {metric.names}" if metric.name == "max-eig" else metric.names
    return metric.label


def expectation(quantity: str) -> bool:
    """Whether the quantity is itself an expectation, not made of one."""
    return quantity not in ("consistency", "rms")


def unit(quantity: str, metric: Metric) -> str:
    """Return the unit of a quantity; empty where there is none."""
    if quantity == "consistency":
        return ""
    return metric.root_unit if quantity in ("bias", "rms") else metric.unit
