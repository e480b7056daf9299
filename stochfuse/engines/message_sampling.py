"""Message loads sampled: follow the latest node of every agent that every agent knows; see `stochfuse.messages`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.events import Event

MOST_NUMBERS = 100_000_000
"""Numbers in a sample."""
MOST_UPDATES = 20_000_000_000
"""Updates up to which loads are sampled: some two minutes."""
BLOCK = 250
"""Runs drawn from one seed."""


def sampled_loads(agents: int, drawn: Sequence[Sequence[Event]], rows: int, runs: int, seed: int) -> np.ndarray:
    """Loads of simulated agents, (rows, runs, steps, agents); all rows are drawn from the same random numbers."""
    numbers = max(rows * runs * len(drawn) * agents, rows * min(runs, BLOCK) * agents**2)
    if numbers > MOST_NUMBERS:
        raise UsageError(
            f"runs: {runs} runs for {rows} link probabilities, {len(drawn)} steps and {agents} agents are "
            f"{numbers:.3g} values; expected at most {MOST_NUMBERS:.3g}"
        )
    updates = rows * runs * agents * sum(len(event.receivers) for now in drawn for event in now)
    if updates > MOST_UPDATES:
        raise UsageError(
            f"runs: {runs} runs for {rows} link probabilities, {len(drawn)} steps and {agents} agents are "
            f"{updates:.3g} updates of what an agent knows of another; expected at most {MOST_UPDATES:.3g}"
        )
    parts = []
    for block in range(-(-runs // BLOCK)):
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(block,)))
        parts.append(_simulated(agents, drawn, rows, min(BLOCK, runs - block * BLOCK), generator))
    return np.concatenate(parts, axis=1)


def _simulated(
    agents: int, drawn: Sequence[Sequence[Event]], rows: int, runs: int, generator: np.random.Generator
) -> np.ndarray:
    """Follow the latest node of every agent that every agent knows, (rows, runs, agent, of agent); 0: none."""
    known = np.zeros((rows, runs, agents, agents), dtype=np.int32)
    loads = np.empty((rows, runs, len(drawn), agents), dtype=np.int32)
    for step, now in enumerate(drawn, start=1):
        known[..., range(agents), range(agents)] = step
        after = known.copy()
        for event in now:
            arrived = generator.random(runs) < event.probability[:, None]
            sent = np.where(arrived[..., None], known[:, :, event.sender], 0)
            for receiver in event.receivers:
                np.maximum(after[:, :, receiver], sent, out=after[:, :, receiver])
        loads[:, :, step - 1] = (after - known).sum(axis=-1)
        known = after
    return loads


def frequencies(sample: np.ndarray, groups: list[list[int]]) -> np.ndarray:
    """Shares of each load, (rows, steps, groups, sizes)."""
    sizes = int(sample.max()) + 1
    rows, _, steps, _ = sample.shape
    out = np.empty((rows, steps, len(groups), sizes))
    cells = np.arange(rows * steps).reshape(rows, 1, steps, 1) * sizes
    for g, group in enumerate(groups):
        counts = np.bincount((sample[..., group] + cells).ravel(), minlength=rows * steps * sizes)
        out[:, :, g] = counts.reshape(rows, steps, sizes) / (sample.shape[1] * len(group))
    return out
