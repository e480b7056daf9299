"""Sampling of large networks: many outcomes at a time against history by history, and the largest that is promised."""

from __future__ import annotations

import resource
import time

import numpy as np

import stochfuse as sf
from stochfuse.prediction import sampled

HEADINGS = ("work", "history by history", "together", "times faster", "largest relative difference")
HEADINGS_OF_LARGE = ("work", "CPU time", "memory", "relative standard error")


def at_random(agents: int, heard: float, steps: int, seed: int = 3) -> sf.Scenario:
    """Agents at random in a square, µ = exp(−(distance/s)²) with so many heard on average."""
    places = np.random.default_rng(seed).random((agents, 2))
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    low, high, link = 1e-3, 1e2, np.zeros_like(distance)
    for _ in range(60):
        scale = np.sqrt(low * high)
        link = np.exp(-((distance / scale) ** 2)) * (1 - np.eye(agents))
        low, high = (scale, high) if link.sum(axis=1).mean() < heard else (low, scale)
    source = {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}}
    return sf.Scenario.from_mapping(source | {"network": {"agents": agents, "steps": steps, "link": link.tolist()}})


def against_histories(name: str, scenario: sf.Scenario, runs: int, **how: str) -> tuple[str, ...]:
    """CPU seconds of the same sample, drawn both ways in one run."""
    seconds, found, few = [], [], sampled.FEW_TOGETHER
    for sampled.FEW_TOGETHER in (10**6, 0):
        start = time.process_time()
        sample = sf.predict(scenario, method="monte-carlo", runs=runs, workers=1, **how).sampled.sample
        seconds.append(time.process_time() - start)
        found.append(sample.values.P[sample.which])
    sampled.FEW_TOGETHER = few
    difference = np.abs(found[1] / found[0] - 1).max()
    return name, *(f"{s / runs:.3g} s a run" for s in seconds), f"{seconds[0] / seconds[1]:.1f}", f"{difference:.0e}"


def ratios(quick: bool) -> list[tuple[str, ...]]:
    """The Local Fusion Graph and the others at 20 agents, half the links."""
    scenario, runs = at_random(20, 9.5, 4 if quick else 20), 2 if quick else 8
    names = ("local-fusion-graph", "naive", "covariance-intersection")
    found = [against_histories(f"20 agents, {e}", scenario, runs, estimator=e) for e in names]
    return [*found, against_histories("20 agents, actual", scenario, runs, quantity="actual")]


def large(quick: bool) -> list[tuple[str, ...]]:
    """Mean over the agents at the last step."""
    work = [
        ("20 agents, 20 steps", 20, 9.5, 20, 250, "local-fusion-graph"),
        ("60 agents, 10 steps", 60, 5.5, 10, 24, "local-fusion-graph"),
        ("500 agents, 10 steps", 500, 6.0, 10, 2, "local-fusion-graph"),
        ("500 agents, 20 steps, naive", 500, 6.0, 20, 30, "naive"),
        ("500 agents, 20 steps, intersection", 500, 6.0, 20, 30, "covariance-intersection"),
        ("100 agents, 20 steps, optimum", 100, 6.0, 20, 400, "optimal"),
    ]
    rows = []
    for name, agents, heard, steps, runs, estimator in work[:1] if quick else work:
        scenario = at_random(agents, heard, 3 if quick else steps)
        start = time.process_time()
        p = sf.predict(scenario, method="monte-carlo", runs=runs, workers=1, estimator=estimator)
        seconds = time.process_time() - start
        error = p.standard_error("trace", "mean")[0, -1] / p.values("trace", "mean")[0, -1]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        rows.append((f"{name}, {runs} runs", f"{seconds:.3g} s", f"{memory:.0f} MB", f"{error:.2%}"))
    return rows
