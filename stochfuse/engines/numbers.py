"""What the numbers of a recursion in square-root form go through.."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from stochfuse.kalman import factor


class Numbers(Protocol):
    """What the numbers of a recursion in square-root form go through."""

    def factor(self, P: np.ndarray) -> np.ndarray:
        """Square root of a given covariance."""
        ...

    def rounded(self, L: np.ndarray) -> np.ndarray:
        """Return a factor that has been computed, or another matrix with errors of rounding."""
        ...

    def noise(self, R: np.ndarray) -> np.ndarray:
        """Return a given noise covariance, which is about to be factored."""
        ...


class AsTheyAre:
    """Numbers as they are; `stochfuse.engines.rounding.Moving` moves them."""

    def factor(self, P: np.ndarray) -> np.ndarray:
        """Square root of a given covariance."""
        return factor(P)

    def rounded(self, L: np.ndarray) -> np.ndarray:
        """Return the same."""
        return L

    def noise(self, R: np.ndarray) -> np.ndarray:
        """Return the same."""
        return R
