"""The thesis' table 3, sizes of Local Fusion Graph messages, beside the exact calculation.

The thesis states 10 steps of which the first five are left out.  Its maxima (24 in a broadcast network,
23 = 2·12 − 1 in a cyclic one) need 12 steps, and with steps 6–12 its broadcast column is met within 1 %.  Its *ad hoc*
column has the moments of a broadcast draw too.  Its cyclic column lies lower than these steps', by 3–6 % in the mean
and 5–7 % in the standard deviation, which is not explained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stochfuse.messages import message_load
from stochfuse.scenario import load_scenario


class Moments(NamedTuple):
    """Mean, largest and standard deviation of a load in nodes."""

    mean: float
    maximum: int
    std: float


class Row(NamedTuple):
    """One entry of table 3 beside ours.

    Parameters
    ----------
    column : the thesis' heading: "ad-hoc", "broadcast" or "cyclic".
    link : µ.
    thesis : its moments; the maximum is that of 1000 runs.
    ours : by (architecture, first step, last step), exact; the maximum is the largest that is possible.
    """

    column: str
    link: float
    thesis: Moments
    ours: dict[tuple[str, int, int], Moments]


WINDOWS = ((6, 10), (6, 12))
"""Steps that the thesis states, and those that its maxima need."""
TABLE_3 = {
    "ad-hoc": ((0.0, 0, 0.0), (1.820, 22, 2.843), (1.992, 16, 1.974), (1.988, 8, 1.146), (2.0, 2, 0.0)),
    "broadcast": ((0.0, 0, 0.0), (1.823, 24, 2.896), (1.991, 18, 1.970), (1.982, 9, 1.154), (2.0, 2, 0.0)),
    "cyclic": ((0.0, 0, 0.0), (1.491, 23, 3.432), (1.858, 21, 2.766), (1.943, 11, 1.694), (2.0, 2, 0.0)),
}
"""Mean, maximum and standard deviation at µ = 0, 0.25, 0.5, 0.75, 1: thesis table 3, 3 agents, 1000 runs."""


def table_3() -> tuple[Row, ...]:
    """Return table 3 of the thesis and what the exact walk gives for it.

    Beside its *ad hoc* column stand an ad hoc and a broadcast draw; the windows are `WINDOWS`.
    """
    link = np.linspace(0.0, 1.0, 5)
    loads = {}
    for architecture in TABLE_3:
        whole = message_load(load_scenario(agents=3, steps=12, architecture=architecture, uniform_link=True), link)
        for window in WINDOWS:
            load = whole.between(*window)
            moments = zip(load.mean().tolist(), load.maximum().tolist(), load.std().tolist(), strict=True)
            loads[architecture, *window] = [Moments(*m) for m in moments]
    return tuple(
        Row(
            column,
            float(µ),
            Moments(*thesis[i]),
            {
                key: moments[i]
                for key, moments in loads.items()
                if key[0] == column or (column, key[0]) == ("ad-hoc", "broadcast")
            },
        )
        for column, thesis in TABLE_3.items()
        for i, µ in enumerate(link)
    )
