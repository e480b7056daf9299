"""A scenario's network drawn where it is: places, ways and links, a panel for each of some steps, or for each case.

Links are arcs, the darker and thicker the likelier: one for both ways where they are alike, else one for each way with
an arrowhead.  Axes are in metres and of equal scale; without places the agents stand on a circle.  Names stand where
they cover least of what is drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.report.plot import below, figure_class, titled
from stochfuse.scenario.links import Links

LEAST = 0.01
"""Link probability below which no link is drawn."""
BEND = 0.08
"""How far an arc leaves its chord, as a share of its length."""
POINTS = 65
"""Points of an arc."""
MOST_PANELS, TALLEST = 6, 11.0
_PADDING = 0.10
_ROOM = 9.0


class _Panel(NamedTuple):
    title: str
    link: np.ndarray
    places: np.ndarray


class _Arc(NamedTuple):
    line: np.ndarray
    link: float


def draw_network(found: Links, steps: Sequence[int]) -> Any:
    """Return the figure.

    Parameters
    ----------
    steps : which steps to draw where links or places vary, from 1.
    """
    panels = list(_panels(found, steps))[:MOST_PANELS]
    low, high = _limits(found)
    across, down, size = _layout(len(panels), high - low)
    figure = figure_class()(figsize=size, layout="compressed")
    grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    for axes, panel in zip(grid.flat, panels, strict=False):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(panel.title, fontsize="small")
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes in grid.flat:
        if not found.places:
            axes.set_axis_off()
    if found.places:
        for axes in grid[-1]:
            axes.set_xlabel("x [m]", fontsize="small")
        for axes in grid[:, 0]:
            axes.set_ylabel("y [m]", fontsize="small")
    titled(figure, f"Links of {found.source} ({found.kind}): {len(found.nodes)} agents, {found.architecture}", *_says(found))
    arcs = [_draw_panel(axes, panel, found) for axes, panel in zip(grid.flat, panels, strict=False)]
    below(figure, _legend(found))
    # names are put where they cover least, which is known once everything else has its place
    figure.draw_without_rendering()
    for axes, panel, drawn in zip(grid.flat, panels, arcs, strict=False):
        ways = [place[:, :2] for place in found.places if place.ndim == 2]
        _name(axes, panel.places, drawn, ways, _labels(found, panel))
    return figure


def _panels(found: Links, steps: Sequence[int]) -> Iterator[_Panel]:
    moving = any(place.ndim == 2 for place in found.places)
    for name, link in found.cases or [("", found.link)]:
        varies = link.ndim == 3 or moving
        for step in steps if varies else (1,):
            title = ", ".join(part for part in (name, f"step {step}" if varies else "") if part)
            yield _Panel(title, np.nan_to_num(link[step - 1] if link.ndim == 3 else link), _places(found, step))


def _places(found: Links, step: int) -> np.ndarray:
    """Where the agents are at a step, (n, 2)."""
    if found.places:
        return np.array([place[step - 1, :2] if place.ndim == 2 else place[:2] for place in found.places])
    angle = 2 * np.pi * np.arange(len(found.nodes)) / len(found.nodes)
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


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
    way = "pale bands: the ways, from circle to square; " if any(place.ndim == 2 for place in found.places) else ""
    above = "; seen from above" if any(place.shape[-1] == 3 for place in found.places) else ""
    return [f"{way}links from µ = {LEAST:g} on{above}"]


def _legend(found: Links) -> list[Any]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], **_ink(µ), label=f"µ = {µ:g}") for µ in (1.0, 0.75, 0.5, 0.25, 0.05)]


def _ink(µ: float) -> dict[str, Any]:
    """Colour and width of a link."""
    return {"color": str(round(0.82 * (1.0 - µ), 3)), "linewidth": 0.4 + 2.2 * µ}


def _draw_panel(axes: Any, panel: _Panel, found: Links) -> list[_Arc]:
    for place in found.places:
        if place.ndim == 2:
            axes.plot(place[:, 0], place[:, 1], color="0.9", linewidth=4, zorder=1, solid_capstyle="round")
            for end, mark in ((place[0], "o"), (place[-1], "s")):
                axes.plot(*end[:2], mark, markersize=4, markerfacecolor="w", markeredgecolor="0.45", zorder=2)
    arcs = _arcs(panel)
    alike = bool((panel.link == panel.link.T).all())
    for arc in sorted(arcs, key=lambda arc: arc.link):
        ink = _ink(arc.link)
        axes.plot(*arc.line.T, **ink, zorder=3 + arc.link, solid_capstyle="round")
        if not alike:
            tip = arc.line[-POINTS // 6]
            way = tip - arc.line[-POINTS // 6 - 3]
            angle = float(np.degrees(np.arctan2(way[1], way[0]))) - 90.0
            head = {"marker": (3, 0, angle), "markersize": 3.5 + 1.5 * ink["linewidth"], "markeredgewidth": 0}
            axes.plot(*tip, **head, color=ink["color"], zorder=3 + arc.link)
    axes.plot(*panel.places.T, "o", color="k", markersize=6.5, markeredgecolor="w", zorder=5)
    axes.tick_params(labelsize="x-small")
    return arcs


def _arcs(panel: _Panel) -> list[_Arc]:
    """Links as arcs from sender to receiver; one for both ways where all are alike."""
    alike = bool((panel.link == panel.link.T).all())
    arcs, t = [], np.linspace(0.0, 1.0, POINTS)[:, None]
    for i, j in np.argwhere(panel.link >= LEAST):
        if alike and i < j:
            continue
        start, end = panel.places[j], panel.places[i]
        across = np.array([end[1] - start[1], start[0] - end[0]])
        middle = (start + end) / 2 + 2 * BEND * across
        line = (1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end
        arcs.append(_Arc(line, float(panel.link[i, j])))
    return arcs


def _labels(found: Links, panel: _Panel) -> list[str]:
    step = panel.title.rpartition("step ")[2]
    high = [place for place in found.places if place.shape[-1] == 3]
    if not high:
        return list(found.nodes)
    k = int(step) - 1 if step.isdigit() else 0
    heights = [place[k, 2] if place.ndim == 2 else place[2] for place in found.places]
    return [f"{name} ({z:g} m up)" for name, z in zip(found.nodes, heights, strict=True)]


def _name(
    axes: Any, places: np.ndarray, arcs: Sequence[_Arc], ways: Sequence[np.ndarray], labels: Sequence[str]
) -> None:
    """Write the agents' names beside their places, where they cover least of links, ways, agents and other names."""
    from matplotlib.patheffects import withStroke

    def in_points(at: np.ndarray) -> np.ndarray:
        return axes.transData.transform(at) * 72.0 / axes.figure.dpi

    dots = in_points(places)
    inked = in_points(np.concatenate([*(arc.line for arc in arcs), *ways, *(way[[0, -1]] for way in ways), dots[:0]]))
    weight = np.concatenate(
        [np.repeat([0.3 + arc.link for arc in arcs], POINTS), np.full(sum(map(len, ways)), 0.1), np.full(2 * len(ways), 3)]
    )
    frame_low, frame_high = in_points(np.stack([axes.get_xlim(), axes.get_ylim()], axis=1))
    taken: list[tuple[np.ndarray, np.ndarray]] = []
    for at, place, label in zip(places, dots, labels, strict=True):
        half = np.array([0.29 * 9 * len(label) + 1.5, 6.0])
        centres = _around(place, half)
        low, high = centres - half, centres + half
        covered = ((inked > low[:, None]) & (inked < high[:, None])).all(axis=2) @ weight
        covered += 20.0 * ((dots > low[:, None] - 4) & (dots < high[:, None] + 4)).all(axis=2).sum(axis=1)
        covered += 100.0 * ((low < frame_low) | (high > frame_high)).any(axis=1)
        for other_low, other_high in taken:
            covered += 50.0 * ((low < other_high) & (high > other_low)).all(axis=1)
        # the nearest of the places that cover as little
        best = int(np.argmin(covered + 0.02 * np.linalg.norm(centres - place, axis=1)))
        taken.append((low[best], high[best]))
        offset = centres[best] - place
        far = np.linalg.norm(np.maximum(np.abs(offset) - half, 0.0)) > _ROOM
        text = axes.annotate(
            label,
            at,
            offset,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=9,
            zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="w")],
            arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": "0.3", "shrinkA": 0, "shrinkB": 4} if far else None,
        )
        text.set_in_layout(False)


def _around(place: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Centres of a box at growing distances all around a place, (candidates, 2), in points."""
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([place + ways * (half + away) for away in (5.0, 9.0, 14.0, 20.0, 28.0, 38.0)])
