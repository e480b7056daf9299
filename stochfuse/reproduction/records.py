"""Records of truth and measurements: one world that the thesis holds fixed while it draws links.

A record is a vector s of the independent noises in units of their own deviations, as `stochfuse.sources` orders them:
the agents' initial errors, then for every step 2 … K the process noise and the agents' measurement noises; and 1 for
the known initial error.  Two things that the thesis leaves unsaid can be varied:

    "own"      every agent draws its own initial estimate and its own measurements
    "start"    one initial estimate for all agents (fused as if each had its own)
    "all"      one initial estimate and one measurement of each step for all agents
"""

from __future__ import annotations

import numpy as np

from stochfuse.scenario import Scenario

DATA = ("own", "start", "all")
TRUTH = 1000.0
"""True state at step 1, the mean of the thesis' x(0)."""


def _shared(scenario: Scenario, data: str) -> np.ndarray:
    """Index of the noise that each entry of s is."""
    n, steps = scenario.network.agents, scenario.network.steps
    index = np.arange(n + (steps - 1) * (n + 1) + 1)
    if data != "own":
        index[:n] = 0
    if data == "all":
        for first in range(n + 1, len(index) - 1, n + 1):
            index[first : first + n] = first
    return index


def spread(scenario: Scenario, data: str = "own", *, initial_error: bool = True) -> np.ndarray:
    """E[s sᵀ] over the noise, (noises, noises).

    Parameters
    ----------
    initial_error : whether the known initial error is there.
    """
    index = _shared(scenario, data)
    out = (index[:, None] == index[None, :]).astype(float)
    out[-1, -1] = float(initial_error)
    return out


def draw(scenario: Scenario, number: int, seed: int, data: str = "own") -> np.ndarray:
    """Return some records s, (records, noises); the first ones are the same whatever their number."""
    index = _shared(scenario, data)
    made = [np.random.default_rng([seed, i]).standard_normal(len(index)) for i in range(number)]
    out = np.stack(made)[:, index]
    out[:, -1] = 1.0
    return out


def truth(scenario: Scenario, records: np.ndarray) -> np.ndarray:
    """True state of some records, (records, steps)."""
    n, steps = scenario.network.agents, scenario.network.steps
    moves = records[:, n : -1 : n + 1] * np.sqrt(scenario.model.Q.item())
    return TRUTH + np.concatenate([np.zeros((len(records), 1)), np.cumsum(moves, axis=1)], axis=1)[:, :steps]
