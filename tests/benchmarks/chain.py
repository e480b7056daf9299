"""Contact chain and message load: seconds, the bounds reached, and how the cost grows with agents and steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import stochfuse as sf
from tests.benchmarks.growth import draw, seconds

LINK = np.linspace(0, 1, 1001)


def promised(quick: bool) -> list[tuple[str, ...]]:
    """Work, seconds, relative bound of the value, and what was promised."""
    rounds = 1 if quick else 5
    small = sf.load_scenario()
    rows = [
        (
            "optimum, n = 3, k = 5, 1001 µ",
            f"{seconds(lambda: sf.predict(small, LINK, 'optimal'), rounds):.4f} s",
            "exact",
            "20 ms",
        )
    ]
    cases = [
        ("optimum, n = 50, k = 50, µ = 0.05", sf.load_scenario(agents=50, steps=50), 0.05, "2 s, 1e-6"),
        ("optimum, n = 50, k = 50, µ = 0.5", sf.load_scenario(agents=50, steps=50), 0.5, "2 s, 1e-6"),
        ("optimum, 4 states, n = 6, k = 30, µ = 0.05", sf.load_scenario("cv-2d", agents=6, steps=30), 0.05, ""),
        ("optimum, 4 states, n = 10, k = 20, µ = 0.05", sf.load_scenario("cv-2d", agents=10, steps=20), 0.05, ""),
        ("optimum, 4 states, n = 10, k = 20, µ = 0.5", sf.load_scenario("cv-2d", agents=10, steps=20), 0.5, ""),
    ]
    for name, scenario, link, bound in cases[:1] if quick else cases:
        took = seconds(lambda: sf.predict(scenario, [link], "optimal"), 1)  # noqa: B023
        reached = np.max(sf.predict(scenario, [link], "optimal").meta["relative_bound"])
        rows.append((name, f"{took:.3g} s", f"{reached:.1e}", bound))
    load = sf.load_scenario(steps=12)
    rows.append(
        (
            "message load, n = 3, 12 steps, 1001 µ",
            f"{seconds(lambda: sf.message_load(load, LINK), rounds):.3g} s",
            "exact",
            "1 s",
        )
    )
    return rows


def growth(quick: bool) -> dict[str, tuple[list[int], list[float]]]:
    """Seconds of one µ against agents (5 steps, then 20) and against steps (3 agents, then 10)."""
    sizes = [2, 4] if quick else [2, 3, 5, 8, 12, 20, 32, 50]

    def took(agents: int, steps: int) -> float:
        scenario = sf.load_scenario(agents=agents, steps=steps)
        return seconds(lambda: sf.predict(scenario, [0.3], "optimal"), 1 if quick else 3)

    return {
        "against n, 5 steps": (sizes, [took(n, 5) for n in sizes]),
        "against n, 20 steps": (sizes, [took(n, 20) for n in sizes]),
        "against k, 3 agents": (sizes, [took(3, k) for k in sizes]),
        "against k, 10 agents": (sizes, [took(10, k) for k in sizes]),
    }


def plot(found: dict[str, tuple[list[int], list[float]]], output: Path) -> None:
    """Draw the growth of the cost."""
    draw(
        {"Contact chain, scalar: exact up to 20,000 paths, enclosed beyond": found},
        output,
        "agents n, or steps k",
        "time for one µ [s]",
    )
