"""Statements about message loads: figures 49–55, 60 and table 3."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stochfuse.scenario.registry import NAIVE
from stochfuse.thesis.bench import (
    ARCHITECTURES,
    LIKE_NETWORKS,
    LINKS,
    STATED_WINDOW,
    TABLE_3,
    TRANSIENT,
    WINDOW,
    Bench,
    Sweep,
)
from stochfuse.thesis.statements import Stated, Verdict, explained, judged, listed

STATED = Stated()
INNER = slice(1, 4)
"""The levels that are not 0 or 100 %."""


def _named(values: Mapping[str, str], between: str = "; ") -> str:
    return between.join(f"{a.replace('-', ' ')} {text}" for a, text in values.items())


def _sizes(bench: Bench) -> dict[str, np.ndarray]:
    """Mean message size of each network, (links,)."""
    return {a: Sweep(bench, TRANSIENT, a).size() for a in ARCHITECTURES}


IMPULSES = "At 0 and 100 % the size is always 0 and 2 nodes."


@STATED.of({51: TRANSIENT}, IMPULSES, "probability 1, from step 3 on", ("cyclic",))
@STATED.of({49: TRANSIENT}, IMPULSES, "probability 1", LIKE_NETWORKS)
def _impulses(sweep: Sweep) -> Verdict:
    load = sweep.bench.messages(sweep.architecture).between(*WINDOW).distribution()
    ours = f"P(0 nodes) at 0 % {load[0, 0]:g}, P(2) at 100 % {load[-1, 2]:g}"
    return judged(load[0, 0] == 1 and load[-1, 2] == 1, ours)


@STATED.of(
    {49: TRANSIENT},
    "The share of steps without new nodes at step 1 is that of (41).",
    "(1−µ)^(number of possible senders) within rounding",
)
def _first_step(sweep: Sweep) -> Verdict:
    found = sweep.bench.messages(sweep.architecture).by_step()[:, 0, 0]
    senders = 1 if sweep.architecture == "cyclic" else 2
    away = np.abs(found - (1 - np.asarray(LINKS)) ** senders).max()
    return judged(away < 1e-12, f"{listed(found)}; largest difference {away:.0e}")


@STATED.about([52, "table-3"], "The mean size is always below that of full connectivity.", "below 2")
def _always_less(bench: Bench) -> Verdict:
    found = {a: size[INNER] for a, size in _sizes(bench).items()}
    ours = _named({a: listed(values) for a, values in found.items()})
    return judged(all((values < 2).all() for values in found.values()), f"{ours} at 25, 50, 75 %; 2 at 100 %")


@STATED.about(
    [52, "table-3"],
    "It grows quickly: 1.8 nodes at 25 %.",
    "broadcast within 0.05, steps 6–12; explained for ad hoc by a broadcast draw",
)
def _quick_increase(bench: Bench) -> Verdict:
    found = {a: size[1] for a, size in _sizes(bench).items()}
    ours = _named({a: f"{value:.3f}" for a, value in found.items()})
    near, own = abs(found["broadcast"] - 1.8) < 0.05, abs(found["ad-hoc"] - 1.8) < 0.05
    return explained(near, not own, f"{ours}; the thesis' ad hoc column is a broadcast draw, see table 3")


@STATED.about(
    ["table-3"],
    "The largest message becomes smaller with connectivity.",
    "the spread of sizes shrinks from 25 to 75 %",
)
def _larger_peaks(bench: Bench) -> Verdict:
    found = {a: bench.table_3(a, WINDOW)[INNER, 2] for a in ARCHITECTURES}
    ours = _named({a: listed(values) for a, values in found.items()})
    ours += f" (standard deviation at 25, 50, 75 %).  The largest that is possible is {2 * WINDOW[1]} at each: that "
    ours += "of 1000 runs tells how rare it is"
    return judged(all((np.diff(values) < 0).all() for values in found.values()), ours)


def _away(bench: Bench, column: str, draw: str, window: tuple[int, int] = WINDOW) -> np.ndarray:
    """Relative distance, in per cent, of our mean and deviation from those of the thesis' column, (3 levels, 2)."""
    ours, theirs = (table[INNER, ::2] for table in (bench.table_3(draw, window), TABLE_3[column]))
    return 100 * (ours / theirs - 1)


@STATED.about(
    ["table-3"],
    "10 steps, of which the first five are left out.",
    "explained if its maxima need more steps and steps 6–12 meet its broadcast column within 1.5 %",
)
def _stated_window(bench: Bench) -> Verdict:
    largest = int(max(table[:, 1].max() for table in TABLE_3.values()))
    windows = (STATED_WINDOW, WINDOW)
    stated, needed = (np.abs(_away(bench, "broadcast", "broadcast", window)).max() for window in windows)
    possible = 2 * STATED_WINDOW[1]
    ours = f"10 steps allow at most {possible} nodes, the table has {largest}; its broadcast column is met within "
    ours += f"{stated:.1f} % with steps 6–10, within {needed:.1f} % with steps 6–12"
    return explained(largest > possible, needed < 1.5 < stated, ours)


@STATED.about(
    ["table-3"],
    "The ad hoc column: 1.820, 1.992, 1.988 nodes at 25, 50, 75 %.",
    "explained if a broadcast draw meets it better, and within 3 %",
)
def _ad_hoc_column(bench: Bench) -> Verdict:
    own, other = (np.abs(_away(bench, "ad-hoc", draw)).max() for draw in LIKE_NETWORKS)
    ours = f"met within {own:.1f} % by an ad hoc draw, within {other:.1f} % by a broadcast draw (steps 6–12)"
    return explained(other < own, other < 3, ours)


@STATED.about(
    ["table-3"],
    "The cyclic column: 1.491, 1.858, 1.943 nodes at 25, 50, 75 %.",
    "mean and standard deviation within 3 %",
)
def _cyclic_column(bench: Bench) -> Verdict:
    away = _away(bench, "cyclic", "cyclic")
    ours = f"mean and deviation differ by {listed(away.ravel(), 2)} % (25, 50, 75 %; steps 6–12)"
    return judged(np.abs(away).max() < 3, ours)


@STATED.about(
    [53],
    "About 90 % of messages have at most 3 nodes at 75 %.",
    "within 3 % by an ad hoc draw; explained if only by a broadcast draw",
)
def _ninety(bench: Bench) -> Verdict:
    own, other = (100 * bench.messages(a).between(*WINDOW).cdf()[3, 3] for a in LIKE_NETWORKS)
    near = [abs(share - 90) < 3 for share in (own, other)]
    return explained(any(near), not near[0], f"ad hoc {own:.1f} %, by a broadcast draw {other:.1f} % (steps 6–12)")


@STATED.about([60], "At 75 % they are about 75 %.", "70–80 %", link=3, least=70, most=80)
@STATED.about(
    [60],
    "At 25 % naive messages are less than 30 % of the Local Fusion Graph's size.",
    "below 30 %",
    link=1,
    least=0,
    most=30,
)
def _naive_ratio(bench: Bench, link: int, least: float, most: float) -> Verdict:
    sweeps = [Sweep(bench, TRANSIENT, a) for a in LIKE_NETWORKS]
    found = {s.architecture: 100 * s.by(NAIVE).size()[link] / s.size()[link] for s in sweeps}
    ours = _named({a: f"{ratio:.1f} %" for a, ratio in found.items()}, ", ")
    return judged(all(least <= ratio <= most for ratio in found.values()), ours)
