"""Random models for Hypothesis and for seeded loops."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

seeds = st.integers(min_value=0, max_value=2**32 - 1)
probabilities = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(min_value=0.0, max_value=1.0))


def covariance(rng, d, rank=None, scale=1.0):
    A = rng.normal(size=(d, d if rank is None else rank))
    return scale * (A @ A.T)


def model(rng, d, p):
    """F, Q, H, R, P0 of a stable, well-scaled random model."""
    F = rng.normal(size=(d, d))
    F /= max(1.0, np.abs(np.linalg.eigvals(F)).max())
    return (
        F,
        covariance(rng, d),
        rng.normal(size=(p, d)),
        covariance(rng, p) + 0.1 * np.eye(p),
        covariance(rng, d) + 0.1 * np.eye(d),
    )


def mapping(F, Q, H, R, P0, agents=3, steps=4, **network):
    """A scenario file's mapping."""
    return {
        "model": {name: np.asarray(M).tolist() for name, M in zip("FQHR", (F, Q, H, R), strict=True)},
        "initial": {"P": np.asarray(P0).tolist()},
        "network": {"agents": agents, "steps": steps, **network},
    }


def same(A, B):
    """Whether two matrices over an exact field are equal, entry by entry."""
    return all(a == b for a, b in zip(A.flat, B.flat, strict=True))
