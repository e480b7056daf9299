"""The figure of an inertial navigation system: where the vehicle is, what GPS measured, what estimators made of it.

The state is the error of the computed position, computed − true; so that along north, east and down

    computed = true + x      measured by GPS = computed − z      corrected by an estimator = computed − x̂

Longitude is counted from the start of the way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stochfuse.data.run import RunResult
from stochfuse.fusion.inertial import POSITION
from stochfuse.fusion.trajectory import displaced, geodetic
from stochfuse.kalman.kernel import at_step
from stochfuse.report.plot import band, below, canvas, labelled, look, titled
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.navigation import read_navigation

LINES = ("latitude [°]", "longitude from the start [°]", "height [m]")
AXES = ("north", "east", "down")


def draw_navigation(found: RunResult, title: Sequence[str], averages: Callable[[Any, RunResult, str], None]) -> Any:
    """Return the figure: latitude, longitude, height over time, below them errors along north, east, down, and NEES.

    Parameters
    ----------
    title : its first lines.
    averages : draws NEES on axes.
    """
    steps, network = found.scenario.network.steps, found.scenario.network
    errors = read_navigation(Checker(), found.scenario.source["navigation"], steps)
    if errors is None:
        raise ValueError("expected a scenario whose [navigation] was read before")
    where = geodetic(errors.trajectory, max(1, (len(errors.trajectory.time) - 1) // max(1, steps - 1)))[:steps]
    seconds = np.arange(steps) * found.scenario.source["navigation"].get("interval", 1.0)
    agent = (found.scenario.agent or 1) - 1
    x = found.traces[0].truth[:, min(agent, found.traces[0].truth.shape[1] - 1), POSITION]
    computed = displaced(where, x)
    figure = canvas(13.2, 9.6)
    grid = figure.add_gridspec(3, 3, height_ratios=(3.0, 3.0, 2.2))
    axes = np.array([[figure.add_subplot(grid[row, column]) for column in range(3)] for row in range(2)])
    averages(figure.add_subplot(grid[2, :]), found, "NEES")
    shown = _shown(where), _shown(computed)
    for k, name in enumerate(LINES):
        above = axes[0, k]
        above.plot(seconds, shown[0][:, k], color="0.6", linewidth=4, label="true")
        for place, (sender, z) in enumerate(_fixes(found, agent)):
            fix = _shown(displaced(computed, -z))
            above.plot(seconds, fix[:, k], ".x"[place % 2], color="0.35", markersize=4, label=f"measured by {sender}")
        labelled(above, None, name)
        above.ticklabel_format(useOffset=False)
        for place, trace in enumerate(found.traces):
            style = {**look(place), "linewidth": 1.3}
            estimate = trace.x[:, agent, POSITION]
            above.plot(seconds, _shown(displaced(computed, -estimate))[:, k], label=trace.estimator, **style)
            error, sigma = (x - estimate)[:, k], 2 * np.sqrt(trace.variance[:, agent, POSITION][:, k])
            band(axes[1, k], seconds, -sigma, sigma, style["color"])
            axes[1, k].plot(seconds, error, **style)
            for edge in (-sigma, sigma):  # told apart without colour
                axes[1, k].plot(seconds, edge, **{**style, "linewidth": 0.6})
        labelled(axes[1, k], "time [s]", f"error {AXES[k]} [m]")
    below(figure, axes[0, 0].get_legend_handles_labels()[0])
    name = network.names[agent] if network.names else f"agent {agent + 1}"
    titled(figure, *title, f"{name} in the first run: position, and its error with ±2σ claimed (thin)")
    return figure


def _shown(where: np.ndarray) -> np.ndarray:
    return np.concatenate([np.rad2deg(where[:, :2]), where[:, 2:]], axis=1)


def _fixes(found: RunResult, agent: int) -> list[tuple[str, np.ndarray]]:
    """Position fixes of the agents that measure all of it, (steps, 3), NaN where one did not arrive."""
    fixes = []
    for sender, z in enumerate(found.measured):
        H = at_step(found.scenario.sensors[found.scenario.sensor_of[sender]].H, 1)
        if len(H) < 3 or not (H[:3, POSITION] == np.eye(3)).all():
            continue
        came = found.heard[:, agent, sender] | (sender == agent)
        names = found.scenario.network.names
        fixes.append((names[sender] if names else f"agent {sender + 1}", np.where(came[:, None], z[:, :3], np.nan)))
    return fixes
