"""The [noise] table of a scenario file: noises that hang together and are otherwise taken for independent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stochfuse.checks import Checker, shown
from stochfuse.model import Filter, Noise, Sensor


def read_noise(
    check: Checker, table: Mapping[str, Any], sensors: Sequence[Sensor], filters: Sequence[Filter], own: bool
) -> tuple[Noise | None, np.ndarray | None]:
    """Read [noise]: measurement noises that hang together, and the process noise of all parallel filters."""
    process = None
    if table.get("process") is not None:
        process = check.covariance("noise.process", table["process"], sum(f.dimension for f in filters) or None, 0)
        if own or not filters:
            check.note("noise.process", "nothing unless agents have parallel filters ([[agent]] F, Q, M)", "a matrix")
        elif process is not None:
            _check_blocks(check, process, [f.Q for f in filters])
    if table.get("correlation") is None and table.get("disturbance") is None:
        return None, process
    sizes = [sensor.H.shape[-2] for sensor in sensors]
    correlation = _correlation(check, table.get("correlation"), sizes)
    disturbance = _disturbance(check, table.get("disturbance"), sizes)
    return (None if correlation is None else Noise(correlation, disturbance)), process


def _check_blocks(check: Checker, process: np.ndarray, own: Sequence[np.ndarray]) -> None:
    first = 0
    for i, Q in enumerate(own, start=1):
        rows = slice(first, first + Q.shape[-1])
        first = rows.stop
        if not np.allclose(process[rows, rows], Q, rtol=1e-9, atol=0):
            check.note("noise.process", f"the process noise of agent {i}'s own filter as its diagonal block", "another")


def _correlation(check: Checker, value: Any, sizes: Sequence[int]) -> np.ndarray | None:
    n = len(sizes)
    expected = f"a number, or a symmetric {n}×{n} matrix of correlations with 1 on its diagonal"
    c = check.array("noise.correlation", 0.0 if value is None else value, expected)
    if c is None:
        return None
    if c.ndim == 0:
        c = np.where(np.eye(n, dtype=bool), 1.0, c)
    if c.shape != (n, n) or not np.allclose(c, c.T) or not np.allclose(np.diagonal(c), 1.0):
        check.note("noise.correlation", expected, shown(value))
        return None
    sees = [i for i in range(n) if sizes[i]]
    smallest = float(np.linalg.eigvalsh(c[np.ix_(sees, sees)]).min()) if sees else 1.0
    if smallest < -1e-9 or np.abs(c).max() > 1:
        kind = "correlations that can be (a positive semi-definite matrix)"
        check.note("noise.correlation", kind, f"{shown(value)} (smallest eigenvalue {smallest:.3g})")
        return None
    unlike = [(i, j) for i in sees for j in sees if c[i, j] and sizes[i] != sizes[j]]
    if unlike:
        i, j = unlike[0]
        got = f"{sizes[i]} of agent {i + 1} and {sizes[j]} of agent {j + 1}"
        check.note("noise.correlation", "sensors with as many components where they are correlated", got)
        return None
    return c


def _disturbance(check: Checker, value: Any, sizes: Sequence[int]) -> np.ndarray | None:
    total, expected = sum(sizes), "a variance, one sensor's variances, or a matrix over all components"
    array = check.array("noise.disturbance", value, expected)
    if array is None:
        return None
    if array.ndim == 1:
        if any(size not in (0, len(array)) for size in sizes):
            check.note("noise.disturbance", f"{max(sizes)} variances, one for each component", f"{len(array)}")
            return None
        array = np.diag(np.concatenate([array[:size] for size in sizes]))
    return check.covariance("noise.disturbance", array, total, 0)
