"""The thesis' table 3, sizes of Local Fusion Graph messages, beside the exact calculation.

The thesis states 10 steps of which the first five are left out.  Its maxima (24 in a broadcast network,
23 = 2·12 − 1 in a cyclic one) need 12 steps, and with steps 6–12 its broadcast column is met within 1 %.  Its *ad hoc*
column has the moments of a broadcast draw too.  Its cyclic column lies lower than these steps', by 3–6 % in the mean
and 5–7 % in the standard deviation, which is not explained.

The thesis' tables 2 and 4 (parameters) and 3 (message sizes) beside what is used and found here.
"""

from __future__ import annotations

import numpy as np

from stochfuse.report.reproductions import DrawnCurve, Panel
from stochfuse.scenario.scenario import Scenario
from stochfuse.thesis.bench import LINKS, STEADY, TRANSIENT, Bench, table_3_rows
from stochfuse.thesis.figures import over_links


def table_3(bench: Bench) -> tuple[Panel, ...]:
    """Table 3 beside the exact calculation, for the window it needs and the one it states; a panel per column."""
    rows = bench.once(("table-3",), table_3_rows)
    panels = []
    for column in dict.fromkeys(row.column for row in rows):
        here = [row for row in rows if row.column == column]
        curves = []
        for moment in ("mean", "maximum", "std"):
            curves.append(DrawnCurve(f"{moment}, thesis", np.array([float(getattr(r.thesis, moment)) for r in here])))
            for architecture, first, last in here[0].ours:
                found = [float(getattr(row.ours[architecture, first, last], moment)) for row in here]
                name = f"{moment}, {architecture.replace('-', ' ')}, k={first}–{last}"
                curves.append(DrawnCurve(name, np.array(found)))
        title = f"the thesis' column '{column.replace('-', ' ')}', and exact values by draw and window"
        panels.append(over_links(title, "message size [nodes]", curves, [row.link for row in here]))
    return tuple(panels)


def table_2(bench: Bench) -> tuple[tuple[str, str, str], ...]:
    """Parameters of the Local Fusion Graph simulations beside the presets'."""
    return (*_parameters(bench), ("runs", "1000", "none: every outcome is gone through"))


def table_4(bench: Bench) -> tuple[tuple[str, str, str], ...]:
    """Parameters of the stochastic model's simulations beside the presets'."""
    return (*_parameters(bench), ("runs", "1", "none: (54) is evaluated"))


def _parameters(bench: Bench) -> tuple[tuple[str, str, str], ...]:
    transient, steady = bench.scenario(TRANSIENT, "ad-hoc"), bench.scenario(STEADY, "ad-hoc")
    model, sensor, network = transient.model, transient.sensors[0], transient.network
    return (
        ("F, H", "1", f"{model.F.item():g}, {sensor.H.item():g}"),
        ("B, G", "1 (u = 0)", "none: no input; Q acts on the state"),
        ("Q", "25", f"{model.Q.item():g}"),
        ("R", "100", f"{sensor.R.item():g}"),
        ("x(0)", "1000 + N(0, Q)", "1000 at step 1; its scatter of 5 is left out"),
        ("agents", "3", f"{network.agents}"),
        ("steps", "1 to 5", f"1 to {network.steps}"),
        ("delay", "0", "0"),
        ("link probabilities", "0, 0.25, 0.5, 0.75, 1", ", ".join(f"{link:g}" for link in LINKS)),
        ("transient: P(k0), estimate", "R, drawn from N(0, R)", _start(transient)),
        ("steady: P(k0), estimate", "45, drawn from x(0) + N(0, 45)", _start(steady)),
    )


def _start(scenario: Scenario) -> str:
    error = 0.0 if scenario.error is None else scenario.error.item()
    return f"{scenario.P0.item():g}, truth {error:+g} + N(0, {scenario.P0.item():g}), each agent its own"
