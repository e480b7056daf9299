"""A crosscheck as table, CSV, JSON and figure.

The figure: z-scores over the steps, a mark per link probability, and below them what the simulator found (points with
two standard errors either way) on what is expected (lines), a panel per quantity and group of agents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, isfinite
from statistics import NormalDist
from typing import Any

import numpy as np

from stochfuse.data.causes import summary
from stochfuse.data.crosscheck import Cell, Verdict
from stochfuse.kalman.metrics import metric
from stochfuse.report.plot import DASHES, MARKERS, below, canvas, entry, labelled, shades, spread, titled
from stochfuse.report.predictions import PredictionView
from stochfuse.report.table import Report, Table, counted, listed, number, records_csv, stamped
from stochfuse.scenario.registry import ACTUAL, OPTIMAL

SCHEMA = "stochfuse.crosscheck/1"
NEES = "Expected NEES: squared error in units of the claimed covariance"
MOST_PANELS, ACROSS, MOST_CAUSES = 6, 3, 3
LEAST_REACH = 4.0
"""z-scores up to which an axis of them reaches at least."""


@dataclass(frozen=True)
class CrosscheckView:
    """What is shown: a verdict, and with how many digits."""

    verdict: Verdict
    digits: int = 5

    @property
    def says(self) -> str:
        """The verdict in one line."""
        v = self.verdict
        off = [cell for cell in v.cells if not cell.agrees]
        together = "" if v.p_together is None else f", p of all cells together {_p(v.p_together)}"
        cells = counted(len(v.cells), "cell")
        text = f"smallest p over {cells}, corrected: {_p(v.p_largest)}{together}; level {v.alpha:g}"
        if v.agrees:
            return f"AGREE ({text})"
        where = f"{len(off)} of {cells} differ" if off else "no single cell, but all of them together"
        if v.evidence:
            where = v.evidence[0] + (f", and {len(v.evidence) - 1} more" if len(v.evidence) > 1 else "")
            where += f"; {len(off)} of {cells} differ" if off else ""
        return f"DISAGREE: {where} ({text})"

    @property
    def senses(self) -> list[tuple[str, str]]:
        """Quantities and metrics that are compared, in order."""
        return list(dict.fromkeys((cell.quantity, cell.metric) for cell in self.verdict.cells))

    @property
    def quantity(self) -> str:
        """The first quantity."""
        first = self.senses[0][0] if self.senses else "claimed"
        return OPTIMAL if first == "claimed" and self.verdict.prediction.method == OPTIMAL else first

    def view(self, quantity: str, name: str) -> PredictionView:
        """Return the prediction as it is shown of a quantity."""
        p = self.verdict.prediction
        named = OPTIMAL if quantity == "claimed" and p.method == OPTIMAL else quantity
        return PredictionView(p.shown_as(named), metric(name, p.scenario.model), digits=self.digits)

    def what(self, quantity: str, name: str) -> str:
        """Return in words what is expected."""
        return NEES if quantity == "nees" else self.view(quantity, name).what

    @property
    def causes(self) -> tuple[str, ...]:
        """What would explain a disagreement, a line each: all in one, then the likeliest."""
        found = self.verdict.causes
        if not found:
            return ()
        likely = [cause for cause in found if cause.explains] or list(found[:1])
        return (summary(found), *(f"  {cause.text}" for cause in likely[:MOST_CAUSES]))

    @property
    def seen(self) -> tuple[str, ...]:
        """Of what agrees, in a line, how wrong it would have to be to show."""
        v = self.verdict
        shares = [
            hypot(c.error, c.expected_error) / abs(c.expected) for c in v.cells if c.expected and isfinite(c.error)
        ]
        if not v.agrees or not shares:
            return ()
        far = 100.0 * NormalDist().inv_cdf(1.0 - v.alpha / 2.0 / len(v.cells))
        least, most = (f"{far * share:.2g}" for share in (min(shares), max(shares)))
        between = least if least == most else f"{least} to {most}"
        unseen = "; what is claimed was not compared" if {quantity for quantity, _ in self.senses} == {ACTUAL} else ""
        return (f"would have shown: a cell that is off by {between} %{unseen}",)

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is compared with what."""
        v = self.verdict
        view = self.view("claimed", v.metric.name)
        notes = [f"evidence: {text}" for text in v.evidence]
        return (
            f"Crosscheck of {v.results.source}: {self.says}",
            *notes,
            *self.seen,
            *self.causes,
            *(f"against: {self.what(*sense)}" for sense in self.senses),
            view.whom.partition(";")[0],
            view.how,
            "±: standard error of the mean; p corr.: p-value times the number of cells",
        )


def _p(p: float) -> str:
    return f"{p:.2g}" if p > 1e-300 else "0"


def _agents(cell: Cell) -> str:
    first, last = cell.agents[0], cell.agents[-1]
    if cell.agents == tuple(range(first, last + 1)):
        return str(first) if first == last else f"{first}-{last}"
    return ",".join(map(str, cell.agents))


def crosscheck_report(shown: CrosscheckView) -> Report:
    """Return a verdict in every form."""
    return Report.of(shown, crosscheck_table, crosscheck_csv, crosscheck_json, draw)


def crosscheck_table(shown: CrosscheckView) -> Table:
    """Return one row per cell, with quantity and metric where there are several."""
    digits, several = shown.digits, len(shown.senses) > 1
    runs = {cell.runs for cell in shown.verdict.cells}
    # what all have in common is said once where quantities need the room
    alike = several and len(runs) == 1
    said = (f"{counted(min(runs), 'run')} in every cell",) if alike else ()
    rows = [
        (
            *((_sense(cell, shown.senses),) if several else ()),
            cell.link,
            str(cell.step),
            _agents(cell),
            *(() if alike else (str(cell.runs),)),
            number(cell.mean, digits),
            f"{cell.error:.2g}",
            number(cell.expected, digits) + (f" ±{cell.expected_error:.2g}" if cell.expected_error else ""),
            f"{cell.z:+.2f}" if np.isfinite(cell.z) else "+∞" if cell.z > 0 else "−∞",
            _p(cell.p) + ("" if cell.agrees else " differs"),
        )
        for cell in shown.verdict.cells
    ]
    return Table(
        (*shown.titles, *said),
        (*(("of",) if several else ()), "µ", "k", "agents"),
        (*(() if alike else ("runs",)), "mean", "±", "expected", "z", "p corr."),
        tuple(rows),
    )


def _sense(cell: Cell, senses: Sequence[tuple[str, str]]) -> str:
    """Quantity of a cell, with its metric where there are several of it."""
    alone = [quantity for quantity, _ in senses].count(cell.quantity) == 1
    return cell.quantity if alone else f"{cell.quantity} {cell.metric}"


COLUMNS = (
    "link", "step", "agents", "runs", "mean", "standard_error", "expected", "z", "p_corrected", "verdict",
    "quantity", "metric", "column", "expected_standard_error",
)  # fmt: skip


def _record(cell: Cell) -> dict[str, Any]:
    """A cell as JSON has it; a z-score that is infinite is null."""
    return {
        "link": _value(cell.link),
        "step": cell.step,
        "agents": list(cell.agents),
        "runs": cell.runs,
        "mean": cell.mean,
        "standard_error": cell.error,
        "expected": cell.expected,
        "z": listed(cell.z),
        "p_corrected": cell.p,
        "agrees": cell.agrees,
        "quantity": cell.quantity,
        "metric": cell.metric,
        "column": cell.column,
        "expected_standard_error": cell.expected_error,
    }


def crosscheck_csv(shown: CrosscheckView) -> str:
    """One line per cell."""
    said = {True: "agrees", False: "differs"}
    own = ({"link": c.link, "agents": _agents(c), "z": c.z, "verdict": said[c.agrees]} for c in shown.verdict.cells)
    return records_csv(COLUMNS, (_record(c) | more for c, more in zip(shown.verdict.cells, own, strict=True)))


def crosscheck_json(shown: CrosscheckView) -> dict[str, Any]:
    """Return the object of schema stochfuse.crosscheck/1."""
    v, p = shown.verdict, shown.verdict.prediction
    return stamped(
        SCHEMA,
        verdict="agree" if v.agrees else "disagree",
        alpha=v.alpha,
        p_largest=v.p_largest,
        p_together=v.p_together,
        method=p.method,
        estimator=p.estimator,
        quantity=shown.quantity,
        metric=shown.senses[0][1] if shown.senses else v.metric.name,
        cells=list(map(_record, v.cells)),
        consistency=dict(v.consistency),
        evidence=list(v.evidence),
        causes=[cause._asdict() for cause in v.causes],
        scenario=p.scenario.to_mapping(),
        meta={"description": list(shown.titles), "nature": p.nature, "notes": [*p.notes, *v.notes]},
    )


def _value(link: str) -> float | str:
    try:
        return float(link)
    except ValueError:
        return link


def draw(shown: CrosscheckView) -> Any:
    """Return the figure."""
    cells = shown.verdict.cells
    panels: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        panels.setdefault((cell.quantity, cell.metric, _agents(cell)), []).append(cell)
    kept = _worst(panels)
    links = list(dict.fromkeys(cell.link for cell in cells))
    chosen = [links[i] for i in spread(len(links))] if links else []
    looks = {
        link: {"color": color, "marker": MARKERS[i], "linestyle": DASHES[i]}
        for i, (link, color) in enumerate(zip(chosen, shades(len(chosen)), strict=True))
    }
    across, down = min(ACROSS, len(kept) or 1), -(-len(kept) // ACROSS)
    figure = canvas(max(7.5, 1.2 + 3.6 * across), 4.4 + 2.7 * down)
    grid = figure.add_gridspec(1 + down, across, height_ratios=[1.15] + [1.0] * down)
    said = _draw_scores(figure.add_subplot(grid[0, :]), shown, looks)
    for place, key in enumerate(kept):
        _draw_panel(figure.add_subplot(grid[1 + place // across, place % across]), shown, key, panels[key], looks)
    below(figure, [entry(f"µ = {link}" if link else "simulator", markersize=4, **look) for link, look in looks.items()])
    left = [f"{len(kept)} of {len(panels)} panels, those with the largest |z|"] if len(kept) < len(panels) else []
    left += [f"{len(chosen)} of {len(links)} link probabilities"] if len(chosen) < len(links) else []
    lines = ["points: simulator, ± two standard errors; lines: expected", *said, *left]
    view = shown.view("claimed", shown.verdict.metric.name)
    titled(figure, shown.titles[0], view.whom.partition(";")[0], view.how, "; ".join(lines))
    return figure


def _worst(panels: dict[tuple[str, str, str], list[Cell]]) -> list[tuple[str, str, str]]:
    """The panels that are drawn, in their order."""
    keys = list(panels)
    worst = sorted(keys, key=lambda key: -max(abs(cell.z) for cell in panels[key]))[:MOST_PANELS]
    return [key for key in keys if key in worst]


def _beside(cells: Sequence[Cell], place: int, places: int) -> np.ndarray:
    """Steps, moved a little apart so that the marks of several link probabilities do not hide each other."""
    return np.array([cell.step for cell in cells]) + 0.4 * ((place + 0.5) / places - 0.5)


def _draw_scores(axes: Any, shown: CrosscheckView, looks: dict[str, dict[str, Any]]) -> list[str]:
    """Draw z-scores, and return what is to be said of them."""
    from scipy.special import ndtri

    v = shown.verdict
    level = v.alpha / 2 if v.p_together is not None else v.alpha
    limit = -float(ndtri(level / max(1, len(v.cells)) / 2))
    finite = [abs(cell.z) for cell in v.cells if np.isfinite(cell.z)]
    reach = max(LEAST_REACH, 1.25 * limit, 1.1 * min(max(finite, default=0.0), 6 * limit))
    beyond = False
    for place, (link, look) in enumerate(looks.items()):
        mine = [cell for cell in v.cells if cell.link == link]
        x, z = _beside(mine, place, len(looks)), np.array([cell.z for cell in mine])
        outside = np.abs(z) > reach
        beyond |= bool(outside.any())
        style = {"color": look["color"], "linestyle": "none", "markersize": 4}
        axes.plot(x[~outside], z[~outside], marker=look["marker"], **style)
        for sign, mark in ((1, "^"), (-1, "v")):
            far = outside & (np.sign(z) == sign)
            axes.plot(x[far], np.full(far.sum(), 0.96 * sign * reach), marker=mark, markeredgecolor="0.1", **style)
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    for sign in (1, -1):
        axes.axhline(sign * limit, color="0.2", linewidth=0.8, linestyle="--")
    axes.set_ylim(-reach, reach)
    labelled(axes, None, "z, in standard errors", whole=True)
    said = [f"dashed: |z| = {limit:.2f}, reached by one of {counted(len(v.cells), 'cell')} with probability {level:g}"]
    return [*said, "triangles: beyond the axis"] if beyond else said


def _draw_panel(
    axes: Any, shown: CrosscheckView, key: tuple[str, str, str], cells: Sequence[Cell], looks: dict[str, dict[str, Any]]
) -> None:
    quantity, name, agents = key
    for place, (link, look) in enumerate(looks.items()):
        mine = sorted((cell for cell in cells if cell.link == link), key=lambda cell: cell.step)
        if not mine:
            continue
        x = _beside(mine, place, len(looks))
        axes.plot(x, [cell.expected for cell in mine], color=look["color"], linestyle=look["linestyle"], linewidth=1.2)
        axes.errorbar(
            x, [cell.mean for cell in mine], yerr=[2 * cell.error for cell in mine], color=look["color"],
            marker=look["marker"], markersize=4, linestyle="none", capsize=2, linewidth=1,
        )  # fmt: skip
    who = f"agent {agents}" if agents.isdigit() else f"agents {agents}"
    heading = "NEES" if quantity == "nees" else f"{quantity}, {name}"
    axes.set_title(f"{heading}; {who}", fontsize="small")
    labelled(axes, "step k", "NEES" if quantity == "nees" else shown.view(quantity, name).axis, whole=True)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set_size("small")
    axes.tick_params(labelsize="small")
