"""Studies: a million points, what a second worker is worth, and how the cost grows with n, k, d and points."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

import stochfuse as sf
from stochfuse.prediction.predict import predict_items
from stochfuse.scenario.network import uniform_rows
from stochfuse.scenario.system import Items, Noises
from tests.benchmarks.growth import Growth, draw, seconds

HEADINGS = ("work", "time", "memory", "rate", "promised")
NOISES = {
    "network.link": {"from": 0, "to": 1},
    "model.Q": {"from": 0.1, "to": 100, "scale": "log"},
    "model.R": {"from": 1, "to": 1e4, "scale": "log"},
    "initial.P": {"from": 1, "to": 1e4, "scale": "log"},
}
RUN = """
import json, resource, sys, time
import stochfuse as sf
if __name__ == "__main__":
    start = time.perf_counter()
    results = sf.study(json.loads(sys.argv[1]), sys.argv[2], workers=int(sys.argv[3]))
    took = time.perf_counter() - start
    peak = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(took, peak / 1e3, results.rows)
"""


def run(mapping: dict, workers: int) -> tuple[float, float, int]:
    """Seconds, megabytes (of the process and its largest worker) and rows of a study in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "run.py"
        script.write_text(RUN)
        arguments = [json.dumps(mapping), str(Path(folder) / "result.parquet"), str(workers)]
        done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, check=True)
    took, peak, rows = done.stdout.split()
    return float(took), float(peak), int(rows)


def latin(points: int, **more: object) -> dict:
    """A Latin hypercube over link probability and noises."""
    return {"vary": NOISES, "design": {"kind": "latin-hypercube", "points": points}, **more}


def promised(quick: bool) -> list[tuple[str, ...]]:
    """Work, seconds, memory, rate, and what was promised."""
    points = 20_000 if quick else 1_000_000
    rows = []
    for workers in (1, 2):
        took, peak, _ = run(latin(points), workers)
        name = f"simplified, scalar, n = 3, 5 steps: {points:,} points, {workers} worker{'s' * (workers > 1)}"
        rows.append((name, f"{took:.3g} s", f"{peak:.0f} MB", f"{points / took:,.0f}/s", "20 s, 1 GB"))
    points = 200 if quick else 80_000
    minute = latin(points, scenario="cv-2d", predict={"method": "general"})
    minute["vary"] = {**NOISES, "network.steps": [3]}
    times = [run(minute, workers) for workers in (1, 2)]
    for workers, (took, peak, _) in zip((1, 2), times, strict=True):
        name = f"general, 4 states, n = 3, 3 steps: {points:,} points, {workers} worker{'s' * (workers > 1)}"
        rows.append((name, f"{took:.3g} s", f"{peak:.0f} MB", f"{points / took:,.0f}/s", ""))
    rows.append(("two workers against one", f"{times[0][0] / times[1][0]:.2f} times", "", "", "≥ 1.7"))
    return rows


def growth(quick: bool) -> dict[str, Growth]:
    """Seconds for 1,000 points against n, k and d, and for so many points."""
    few, rounds = 1_000, 1 if quick else 3

    def took(method: str, points: int, agents: int = 3, steps: int = 5, d: int = 1) -> float:
        scenario, link, noises = batch(points, agents, steps, d)
        return seconds(lambda: predict_items(scenario, Items(uniform_rows(link), noises), method, ["claimed"]), rounds)

    simplified: Growth = {
        "agents n": _curve(quick, [2, 5, 10, 20, 50, 100, 1000, 10_000], lambda n: took("simplified", few, agents=n)),
        "steps k": _curve(quick, [5, 10, 20, 50, 100, 200, 500], lambda k: took("simplified", few, steps=k)),
        "states d": _curve(quick, [2, 3, 4, 6, 8, 12, 16], lambda d: took("simplified", few, d=d)),
        "points": _curve(quick, [10, 100, 1000, 10_000, 100_000, 1_000_000], lambda N: took("simplified", N)),
    }
    # naive fusion has an answer for all noises; the Local Fusion Graph may take more for common than there is
    general: Growth = {
        "agents n, 2 steps": _curve(quick, [2, 3, 4], lambda n: took("naive", few, agents=n, steps=2)),
        "steps k, 2 agents": _curve(quick, [2, 3, 4, 5], lambda k: took("naive", few, agents=2, steps=k)),
        "states d": _curve(quick, [1, 2, 4, 6, 8], lambda d: took("naive", few, steps=2, d=d)),
        "points": _curve(quick, [10, 100, 1000, 10_000], lambda N: took("naive", N, steps=3)),
    }
    return {"Simplified formulation": simplified, "General formulation, naive fusion": general}


def _curve(quick: bool, sizes: list[int], took: Callable[[int], float]) -> tuple[list[int], list[float]]:
    chosen = sizes[:2] if quick else sizes
    return chosen, [took(size) for size in chosen]


def batch(
    points: int, agents: int, steps: int, d: int, architecture: str = "ad-hoc"
) -> tuple[sf.Scenario, np.ndarray, Noises]:
    """A chain of d integrators of which half are measured, with noises of its own for each point."""
    rng, p = np.random.default_rng(1), max(1, d // 2)
    F = np.eye(d) + 0.1 * np.eye(d, k=1)
    mapping = {
        "model": {"F": F.tolist(), "H": np.eye(p, d).tolist(), "Q": 1.0, "R": 1.0},
        "initial": {"P": 1.0},
        "network": {"agents": agents, "steps": steps, "link": 0.5},
    }
    noise = [rng.uniform(0.5, 50.0, points)[:, None, None] * np.eye(size) for size in (d, p, d)]
    return sf.Scenario.from_mapping(mapping), rng.uniform(0.0, 1.0, points), Noises(*noise)


def plot(costs: dict[str, Growth], output: Path) -> None:
    """Draw the growth of the cost."""
    draw(costs, output, "size", "time of a batch [s]; 1,000 points unless they grow")
