"""Records of robots with known noises, drawn by plain loops that share nothing with the package."""

from __future__ import annotations

from math import atan2, cos, exp, hypot, pi, sin
from typing import NamedTuple

import numpy as np


class Drawn(NamedTuple):
    """How sensors err: relative deviations of odometry per second, of a range's process and white part, bearing."""

    speed: float = 0.08
    turn: float = 0.15
    range: float = 0.05
    range_time: float = 4.0
    range_white: float = 0.01
    bearing: float = 0.012
    bearing_time: float = 2.0
    bearing_white: float = 0.006
    range_constants: tuple[float, ...] = (0.0, 0.0, 0.0)
    bearing_constants: tuple[float, ...] = (0.0, 0.0, 0.0)


def gauss_markov(rng, deviation, time, interval, steps):
    b, keep = np.empty(steps), exp(-interval / time)
    b[0] = deviation * rng.normal()
    for k in range(1, steps):
        b[k] = keep * b[k - 1] + deviation * (1 - keep**2) ** 0.5 * rng.normal()
    return b


def write(folder, seed, drawn=None, robots=3, landmarks=8, seconds=120.0, interval=0.2):
    """Write a folder: robots that drive about in a hall of 8 m by 8 m, and see what is before them each second step."""
    rng, drawn = np.random.default_rng(seed), drawn or Drawn()
    steps = round(seconds / interval) + 1
    around = [(4.5 * cos(2 * pi * m / landmarks), 4.5 * sin(2 * pi * m / landmarks)) for m in range(landmarks)]
    tables = {
        "landmarks": ["landmark,x,y"] + [f"{robots + 1 + m},{x},{y}" for m, (x, y) in enumerate(around)],
        "odometry": ["time,robot,speed,turn_rate"],
        "truth": ["time,robot,x,y,heading"],
        "sightings": ["time,robot,subject,range,bearing"],
    }
    paths = np.zeros((robots, steps, 3))
    for r in range(robots):
        x, y, heading = 2.0 * cos(2.1 * r), 2.0 * sin(2.1 * r), 2.1 * r + 1.6
        wish = gauss_markov(rng, 0.2, 5.0, interval, steps)
        for k in range(steps):
            paths[r, k] = x, y, heading
            V = 0.15 + 0.05 * sin(0.1 * k * interval + r)
            # away from the wall
            home = (atan2(-y, -x) - heading + pi) % (2 * pi) - pi
            omega = wish[k] + (0.4 * home if hypot(x, y) > 2.5 else 0.0)
            tables["odometry"].append(f"{k * interval:.3f},{r + 1},{V},{omega}")
            tables["truth"].append(f"{k * interval:.3f},{r + 1},{x},{y},{heading}")
            # what was told to do, less what the wheels did not
            V *= 1 - drawn.speed / interval**0.5 * rng.normal()
            omega *= 1 - drawn.turn / interval**0.5 * rng.normal()
            x, y, heading = x + V * interval * cos(heading), y + V * interval * sin(heading), heading + omega * interval
    common = [gauss_markov(rng, drawn.bearing, drawn.bearing_time, interval, steps) for _ in range(robots)]
    each = [
        [gauss_markov(rng, drawn.range, drawn.range_time, interval, steps) for _ in range(robots + landmarks)]
        for _ in range(robots)
    ]
    for k in range(0, steps, 2):
        for r in range(robots):
            x, y, heading = paths[r, k]
            for s in range(robots + landmarks):
                if s == r:
                    continue
                px, py = paths[s, k, :2] if s < robots else around[s - robots]
                bearing = (atan2(py - y, px - x) - heading + pi) % (2 * pi) - pi
                distance = hypot(px - x, py - y)
                if abs(bearing) > 0.7 or not 0.3 < distance < 5.0:
                    continue
                relative = drawn.range_constants[r] + each[r][s][k] + drawn.range_white * rng.normal()
                beside = drawn.bearing_constants[r] + common[r][k] + drawn.bearing_white * rng.normal()
                tables["sightings"].append(
                    f"{k * interval:.3f},{r + 1},{s + 1},{distance * (1 + relative)},{bearing + beside}"
                )
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in tables.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
