"""The page's figures: curves with bands, and the network; each drawn anew from data, in light or dark.

Curves are told apart by colour (Okabe and Ito's) and by dashes; words in a figure are plain text, whatever they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from bokeh.models import (
    BasicTicker,
    ColorBar,
    ColumnDataSource,
    HoverTool,
    LinearColorMapper,
    PlainText,
    Range1d,
    Span,
    TapTool,
)
from bokeh.palettes import cividis
from bokeh.plotting import figure

from stochfuse.explore.answers import Line
from stochfuse.explore.network import Picture
from stochfuse.explore.state import PageInput
from stochfuse.report.plot import COLORS


class ThemeColours(NamedTuple):
    """Colours of a theme."""

    back: str
    ink: str
    grid: str
    curves: tuple[str, ...]
    links: tuple[str, ...]


SHADES = cividis(256)
LIGHT = ThemeColours("#ffffff", "#1b1b1b", "#dcdcdc", COLORS, tuple(reversed(SHADES[:215])))
DARK = ThemeColours(
    "#16181b", "#ececec", "#3a3e43",
    ("#56B4E9", "#E69F00", "#2FC79A", "#E59BC5", "#F0E442", "#FF8A50", "#FFFFFF", "#C9B27A"), SHADES[60:],
)  # fmt: skip

NOTHING = {"xs": [[0, 1]], "ys": [[0, 1]], "name": [""], "color": ["transparent"], "dash": ["solid"]}
"""Axes need something to go by."""


class Chart:
    """Curves along an axis, with bands.

    Parameters
    ----------
    label : what the figure shows, for those who do not see it.
    height : in pixels.
    """

    def __init__(self, label: str, height: int = 330) -> None:
        self.figure: Any = figure(
            height=height, sizing_mode="stretch_width", tools="pan,box_zoom,reset,save", toolbar_location="above",
            html_attributes={"role": "img", "aria-label": label}, min_width=200,
        )  # fmt: skip
        self.figure.toolbar.logo = None
        self._label = label
        self._lines = ColumnDataSource(NOTHING)
        self._bands = ColumnDataSource({"xs": [], "ys": [], "color": []})
        self.figure.patches("xs", "ys", source=self._bands, fill_color="color", fill_alpha=0.18, line_color=None)
        drawn = self.figure.multi_line(
            "xs", "ys", source=self._lines, line_color="color", line_dash="dash", line_width=2.2
        )
        self.figure.add_tools(HoverTool(renderers=[drawn], tooltips=[("", "@name"), ("x", "$x"), ("y", "$y")]))

    def show(self, lines: Sequence[tuple[str, str, str, Line]], x: str, y: str) -> None:
        """Draw lines (name, colour, dash, line) with the labels of the axes."""
        names, colors, dashes, drawn = zip(*lines, strict=True) if lines else ((), (), (), ())
        self._lines.data = NOTHING if not lines else {
            "xs": [line.x.tolist() for line in drawn], "ys": [line.y.tolist() for line in drawn],
            "name": list(names), "color": list(colors), "dash": list(dashes),
        }  # fmt: skip
        bands = [(color, line) for _, color, _, line in lines if line.low is not None and line.high is not None]
        self._bands.data = {
            "xs": [[*line.x, *line.x[::-1]] for _, line in bands],
            "ys": [[*line.low, *line.high[::-1]] for _, line in bands],  # type: ignore[misc]
            "color": [color for color, _ in bands],
        }
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = PlainText(text=x), PlainText(text=y)
        ends = [f"{name} from {line.y[0]:.4g} to {line.y[-1]:.4g}" for name, *_, line in lines]
        self.figure.html_attributes = {"role": "img", "aria-label": f"{self._label}, {x}: {'; '.join(ends)}"}

    def span(self, dimension: Any, editable: bool) -> Span:
        """Return a line across the figure, which may be dragged."""
        line = Span(
            location=None, dimension=dimension, editable=editable, line_width=2.5 if editable else 1.5, visible=False,
            hover_line_width=5 if editable else 1.5,
        )  # fmt: skip
        self.figure.add_layout(line)
        return line

    def dress(self, look: ThemeColours) -> None:
        """Put on the colours of a theme."""
        dress(self.figure, look)
        for line in self.figure.select({"type": Span}):
            line.line_color = line.hover_line_color = look.ink


def dress(plot: Any, look: ThemeColours) -> None:
    """Put the colours of a theme on a figure."""
    plot.background_fill_color = plot.border_fill_color = look.back
    plot.outline_line_color = look.grid
    for grid in plot.grid:
        grid.grid_line_color = look.grid
    for axis in plot.axis:
        axis.axis_label_text_color = axis.major_label_text_color = look.ink
        axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = look.ink
        axis.axis_label_text_font_style, axis.axis_label_text_font_size = "normal", "13px"


STROKES = {"solid": "", "dashed": "6", "dotted": "2 3", "dotdash": "2 3 6 3"}


def key_of(lines: Sequence[tuple[str, str, str, Line]]) -> str:
    """Return which line is whose, as HTML that flows."""
    return "".join(
        '<span style="white-space: nowrap; margin-right: 14px"><svg width="30" height="10" aria-hidden="true"><line '
        f'x1="0" x2="28" y1="6" y2="6" stroke="{color}" stroke-width="2.5" stroke-dasharray="{STROKES[dash]}"/></svg> '
        f"{escape(name)}</span> "
        for name, color, dash, _ in lines
    )


class NetworkChart:
    """The network; what is pointed at is told through `links` and `agents`, by the indices selected in them."""

    def __init__(self) -> None:
        self.figure: Any = figure(
            height=360, sizing_mode="stretch_width", tools="pan,wheel_zoom,reset,save", toolbar_location="above",
            html_attributes={"role": "img", "aria-label": "Network"}, min_width=200,
            x_range=Range1d(start=-1.5, end=1.5), y_range=Range1d(start=-1.5, end=1.5),
        )  # fmt: skip
        self.figure.toolbar.logo = None
        keys = ("xs", "ys", "mu", "width", "name", "angle")
        self.links, self.heads = ColumnDataSource({k: [] for k in keys}), ColumnDataSource({k: [] for k in keys})
        self.agents = ColumnDataSource({key: [] for key in ("x", "y", "error", "name", "label", "off")})
        self._mu = LinearColorMapper(palette=list(LIGHT.links), low=0.0, high=1.0)
        self._error = LinearColorMapper(palette=list(LIGHT.links), low=0.0, high=1.0, nan_color="#999999")
        arcs = self.figure.multi_line(
            "xs", "ys", source=self.links, line_color={"field": "mu", "transform": self._mu}, line_width="width",
            nonselection_line_alpha=0.45, hover_line_alpha=1.0, line_cap="round",
        )  # fmt: skip
        self._heads = self.figure.scatter(
            "xs", "ys", source=self.heads, marker="triangle", angle="angle", size="width", line_width=0.7,
            fill_color={"field": "mu", "transform": self._mu},
        )  # fmt: skip
        dots = self.figure.scatter(
            "x", "y", source=self.agents, size=20, fill_color={"field": "error", "transform": self._error},
            line_width=2, nonselection_fill_alpha=0.8,
        )  # fmt: skip
        self._dots = dots
        self._text = self.figure.text(
            "x", "y", "label", source=self.agents, text_font_size="13px", text_align="center", y_offset="off",
            background_fill_alpha=0.7, padding=1,
        )  # fmt: skip
        self.figure.add_tools(TapTool(renderers=[arcs, dots]))
        self.figure.add_tools(HoverTool(renderers=[arcs], tooltips=[("link", "@name"), ("µ", "@mu{0.000}")]))
        self._bar = ColorBar(
            color_mapper=self._mu, ticker=BasicTicker(desired_num_ticks=5), width=8, padding=4,
            major_label_overrides={1: "µ = 1"},
        )  # fmt: skip
        self.figure.add_layout(self._bar, "right")

    def show(self, picture: Picture, asked: PageInput) -> None:
        """Draw a network."""
        pairs = picture.pairs
        arcs = [picture.arc(*pair) for pair in pairs]
        names = [picture.name(pair) for pair in pairs]
        µ = [float(picture.link[pair]) for pair in pairs]
        self.links.data = {
            "xs": [arc[:, 0].tolist() for arc in arcs], "ys": [arc[:, 1].tolist() for arc in arcs], "mu": µ,
            "width": [picture.width(pair) for pair in pairs], "name": names, "angle": [0.0] * len(pairs),
        }  # fmt: skip
        tips = [(arc[-5], arc[-5] - arc[-7]) for arc in arcs]
        self.heads.data = {
            "xs": [float(at[0]) for at, _ in tips], "ys": [float(at[1]) for at, _ in tips], "mu": µ,
            "width": [picture.width(pair) + 7 for pair in pairs], "name": names,
            "angle": [float(np.arctan2(way[1], way[0]) - np.pi / 2) for _, way in tips],
        }  # fmt: skip
        errors, middle = picture.errors, float(picture.places[:, 1].mean())
        self.agents.data = {
            "x": picture.places[:, 0].tolist(), "y": picture.places[:, 1].tolist(), "error": errors.tolist(),
            "name": list(picture.names),
            "off": [-14 if y >= middle else 28 for y in picture.places[:, 1]],
            "label": [n if np.isnan(e) else f"{n}: {e:.4g}" for n, e in zip(picture.names, errors, strict=True)],
        }  # fmt: skip
        if np.isfinite(errors).any():
            low, high = float(np.nanmin(errors)), float(np.nanmax(errors))
            self._error.low, self._error.high = (low, high) if high > low * (1 + 1e-9) else (0.0, 2 * high or 1.0)
        for axis in self.figure.axis:
            axis.visible = picture.metres
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = "x [m]", "y [m]"
        low, high = picture.places.min(axis=0), picture.places.max(axis=0)
        pad = 0.22 * max(float((high - low).max()), 1.0)
        self.figure.x_range.update(start=low[0] - pad, end=high[0] + 1.5 * pad)
        self.figure.y_range.update(start=low[1] - pad, end=high[1] + pad)
        text = "; ".join(picture.about_link(pair, asked) for pair in pairs[:6])
        label = f"Network of {len(picture.names)} agents, {len(pairs)} links. {text}"
        self.figure.html_attributes = {"role": "img", "aria-label": label}

    def dress(self, look: ThemeColours) -> None:
        """Put on the colours of a theme."""
        dress(self.figure, look)
        self._mu.palette, self._error.palette = list(look.links), list(look.links)
        self._dots.glyph.line_color = self._text.glyph.text_color = look.ink
        self._text.glyph.background_fill_color = self._heads.glyph.line_color = look.back
        self._bar.background_fill_color = look.back
        self._bar.major_label_text_color = look.ink
