"""A scenario's network drawn where it is: places, ways and links, a panel for each of some steps, or for each case.

Links are arcs, the darker and thicker the likelier: one for both ways where they are alike, else one for each way with
an arrowhead.  Axes are in metres and of equal scale; without places the agents stand on a circle.  Names stand where
they cover least of what is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.report.plot import below, canvas, entry, titled
from stochfuse.scenario.links import Links

LEAST = 0.01
"""Link probability below which no link is drawn."""
BEND = 0.08
"""How far an arc leaves its chord, as a share of its length."""
POINTS = 65
"""Points of an arc."""
MOST_PANELS, TALLEST = 6, 11.0
_PADDING = 0.10
SIZE, FAR = 9.0, 9.0
"""Size of names, and how far from its place a name is tied to it by a line, in points."""
LEADER = {"arrowstyle": "-", "linewidth": 0.5, "color": "0.3", "shrinkA": 0, "shrinkB": 4}


class _NetworkPanel(NamedTuple):
    title: str
    step: int
    link: np.ndarray
    places: np.ndarray

    @property
    def alike(self) -> bool:
        """Whether every link is as likely as the one the other way."""
        return bool((self.link == self.link.T).all())


class _Arc(NamedTuple):
    line: np.ndarray
    link: float


class _Ink(NamedTuple):
    """What a name should not cover, in points of the figure: where, and how much it matters."""

    at: np.ndarray
    weight: np.ndarray


def draw_network(found: Links, steps: Sequence[int]) -> Any:
    """Return the figure.

    Parameters
    ----------
    steps : which steps to draw where links or places vary, from 1.
    """
    panels = list(_panels(found, steps))[:MOST_PANELS]
    low, high = _limits(found)
    across, down, size = _layout(len(panels), high - low)
    figure = canvas(*size, layout="compressed")
    grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    if found.places:
        for axes in grid[-1]:
            axes.set_xlabel("x [m]", fontsize="small")
        for axes in grid[:, 0]:
            axes.set_ylabel("y [m]", fontsize="small")
    titled(
        figure,
        f"Links of {found.source} ({found.kind}): {len(found.nodes)} agents, {found.architecture}",
        *_says(found),
    )
    naming = [_draw_panel(axes, panel, found) for axes, panel in zip(grid.flat, panels, strict=False)]
    below(figure, [entry(f"µ = {µ:g}", **_ink(µ)) for µ in (1.0, 0.75, 0.5, 0.25, 0.05)])
    # names are put where they cover least, which is known once everything else has its place
    figure.draw_without_rendering()
    for name in naming:
        name()
    return figure


def draw_circle(axes: Any, found: Links) -> Callable[[], None]:
    """Draw links that do not vary on some axes, and return what names their nodes once the figure is laid out."""
    return _draw_panel(axes, next(_panels(found, (1,))), found)


def _panels(found: Links, steps: Sequence[int]) -> Iterator[_NetworkPanel]:
    for name, link in found.cases or [("", found.link)]:
        varies = link.ndim == 3 or found.moves
        for step in steps if varies else (1,):
            title = ", ".join(part for part in (name, f"step {step}" if varies else "") if part)
            yield _NetworkPanel(
                title, step, np.nan_to_num(link[step - 1] if link.ndim == 3 else link), _places(found, step)
            )


def _places(found: Links, step: int) -> np.ndarray:
    """Where the agents are at a step, (n, 2)."""
    if found.places:
        return np.array([place[step - 1, :2] if place.ndim == 2 else place[:2] for place in found.places])
    return circle(len(found.nodes))


def circle(n: int) -> np.ndarray:
    """Return n places on a circle, (n, 2), from the top clockwise."""
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def arc(start: np.ndarray, end: np.ndarray, points: int = POINTS) -> np.ndarray:
    """Return points of the arc from a place to another, (points, 2)."""
    t = np.linspace(0.0, 1.0, points)[:, None]
    middle = (start + end) / 2 + 2 * BEND * np.array([end[1] - start[1], start[0] - end[0]])
    return (1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end


def _limits(found: Links) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the axes: all ways and some room about them, not too flat."""
    at = np.concatenate([place.reshape(-1, place.shape[-1])[:, :2] for place in found.places] or [_places(found, 1)])
    low, high = at.min(axis=0), at.max(axis=0)
    longest = max(float((high - low).max()), 1.0)
    half = np.maximum((high - low) / 2, 0.1 * longest) + _PADDING * longest
    return (low + high) / 2 - half, (low + high) / 2 + half


def _layout(panels: int, extent: np.ndarray) -> tuple[int, int, tuple[float, float]]:
    """Panels across and down, and the figure's size in inches: flat panels below each other, others side by side."""
    flat = float(extent[0] / extent[1])
    across = 1 if flat > 1.7 else min(panels, 3) if panels != 4 else 2
    down = -(-panels // across)
    width = 8.0 if across == 1 else 5.6 * across if across == 2 else 4.6 * across
    if panels == 1 and flat <= 1.7:
        width = 7.5
    width = min(width, max(5.0, across * flat * TALLEST / down))
    return across, down, (width, down * (0.88 * width / across / flat + 0.4) + 1.4)


def _says(found: Links) -> list[str]:
    way = "pale bands: the ways, from circle to square; " if found.moves else ""
    above = "; seen from above" if any(place.shape[-1] == 3 for place in found.places) else ""
    return [f"{way}links from µ = {LEAST:g} on{above}"]


def _ink(µ: float) -> dict[str, Any]:
    """Colour and width of a link."""
    return {"color": str(round(0.82 * (1.0 - µ), 3)), "linewidth": 0.4 + 2.2 * µ}


def _draw_panel(axes: Any, panel: _NetworkPanel, found: Links) -> Callable[[], None]:
    """Draw a panel, and return what names its agents."""
    from matplotlib.collections import LineCollection

    low, high = _limits(found)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_title(panel.title, fontsize="small")
    if not found.places:
        axes.set_axis_off()
    for place in found.places:
        if place.ndim == 2:
            axes.plot(place[:, 0], place[:, 1], color="0.9", linewidth=4, zorder=1, solid_capstyle="round")
            for end, mark in ((place[0], "o"), (place[-1], "s")):
                axes.plot(*end[:2], mark, markersize=4, markerfacecolor="w", markeredgecolor="0.45", zorder=2)
    arcs = sorted(_arcs(panel), key=lambda arc: arc.link)
    inks = [_ink(arc.link) for arc in arcs]
    colors, widths = [ink["color"] for ink in inks], [ink["linewidth"] for ink in inks]
    lines = [arc.line for arc in arcs]
    axes.add_collection(LineCollection(lines, colors=colors, linewidths=widths, capstyle="round", zorder=3))
    for arc, ink in zip(arcs, inks, strict=True) if not panel.alike else ():
        tip = arc.line[-POINTS // 6]
        way = tip - arc.line[-POINTS // 6 - 3]
        angle = float(np.degrees(np.arctan2(way[1], way[0]))) - 90.0
        head = {"marker": (3, 0, angle), "markersize": 3.5 + 1.5 * ink["linewidth"], "markeredgewidth": 0}
        axes.plot(*tip, **head, color=ink["color"], zorder=4)
    axes.plot(*panel.places.T, "o", color="k", markersize=6.5, markeredgecolor="w", zorder=5)
    axes.tick_params(labelsize="x-small")
    return lambda: _name(axes, panel, arcs, found)


def _arcs(panel: _NetworkPanel) -> list[_Arc]:
    """Links as arcs from sender to receiver; one for both ways where all are alike."""
    drawn = [(i, j) for i, j in np.argwhere(panel.link >= LEAST) if i >= j or not panel.alike]
    return [_Arc(arc(panel.places[j], panel.places[i]), float(panel.link[i, j])) for i, j in drawn]


def _labels(found: Links, panel: _NetworkPanel) -> list[str]:
    """Names, with the heights where places have some."""
    if not any(place.shape[-1] == 3 for place in found.places):
        return list(found.nodes)
    heights = [place[panel.step - 1, 2] if place.ndim == 2 else place[2] for place in found.places]
    return [f"{name} ({z:g} m up)" for name, z in zip(found.nodes, heights, strict=True)]


def _name(axes: Any, panel: _NetworkPanel, arcs: Sequence[_Arc], found: Links) -> None:
    """Write the agents' names beside their places, where they cover least of links, ways, agents and other names."""
    from matplotlib.patheffects import withStroke

    def in_points(at: np.ndarray) -> np.ndarray:
        return axes.transData.transform(at) * 72.0 / axes.figure.dpi

    dots, frame = in_points(panel.places), in_points(np.stack([axes.get_xlim(), axes.get_ylim()], axis=1))
    ways = [place[:, :2] for place in found.places if place.ndim == 2]
    drawn = [
        *((arc.line, 0.3 + arc.link) for arc in arcs),
        *((way, 0.1) for way in ways),
        *((way[[0, -1]], 3.0) for way in ways),
    ]
    ink = _Ink(
        in_points(np.concatenate([line for line, _ in drawn] or [panel.places[:0]])),
        np.concatenate([np.full(len(line), weight) for line, weight in drawn] or [np.zeros(0)]),
    )
    taken: list[np.ndarray] = []
    for at, dot, label in zip(panel.places, dots, _labels(found, panel), strict=True):
        half = np.array([0.29 * SIZE * len(label) + 1.5, 0.67 * SIZE])
        offsets = _around(half)
        boxes = np.stack([dot + offsets - half, dot + offsets + half], axis=1)
        # the nearest of the places that cover as little
        covered = _covered(boxes, dots, ink, frame, taken) + 0.02 * np.linalg.norm(offsets, axis=1)
        best = int(covered.argmin())
        taken.append(boxes[best])
        far = np.linalg.norm(np.maximum(np.abs(offsets[best]) - half, 0.0)) > FAR
        text = axes.annotate(
            label, at, offsets[best], textcoords="offset points", ha="center", va="center", fontsize=SIZE, zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="w")], arrowprops={**LEADER} if far else None,
        )  # fmt: skip
        text.set_in_layout(False)


def _covered(
    boxes: np.ndarray, dots: np.ndarray, ink: _Ink, frame: np.ndarray, taken: Sequence[np.ndarray]
) -> np.ndarray:
    """How much boxes (boxes, low and high, 2) cover that they should not."""
    low, high = boxes[:, 0], boxes[:, 1]
    near = ((ink.at > low.min(axis=0)) & (ink.at < high.max(axis=0))).all(axis=1)
    out = _inside(ink.at[near], low, high) @ ink.weight[near]
    out = out + 20.0 * _inside(dots, low - 4.0, high + 4.0).sum(axis=1)
    out = out + 100.0 * ((low < frame[0]) | (high > frame[1])).any(axis=1)
    for other in taken:
        out = out + 50.0 * ((low < other[1]) & (high > other[0])).all(axis=1)
    return out


def _inside(at: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Whether points (points, 2) lie in boxes, (boxes, points)."""
    return np.all((at > low[:, None]) & (at < high[:, None]), axis=2)


def _around(half: np.ndarray) -> np.ndarray:
    """Where the middle of a box may lie, at growing distances all around a place, (candidates, 2), in points."""
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([ways * (half + away) for away in (5.0, 9.0, 14.0, 20.0, 28.0, 38.0)])
