"""The network as it is drawn: agents at their places, a link as an arc from sender to receiver, what each is worth.

Each way has an arc of its own, bent to one side of the chord, so that it can be pointed at.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stochfuse.errors import StochfuseError
from stochfuse.explore.state import PageInput
from stochfuse.prediction.predict import predict
from stochfuse.report.network_figure import LEAST, arc, circle
from stochfuse.scenario.known_links import links_of_scenario
from stochfuse.scenario.network import reachable
from stochfuse.scenario.registry import SIMPLIFIED

MOST_LINKED = 30
"""Agents up to which links are drawn one by one."""
POINTS = 17


@dataclass(frozen=True)
class Picture:
    """What is drawn.

    Parameters
    ----------
    names : of the agents.
    places : (agents, 2); on a circle where the scenario has none.
    metres : whether places are in metres.
    link : (agents, agents) probabilities, receiver × sender, NaN where there is no link.
    step : the step that is drawn, where links vary with the step; else None.
    errors : (agents,) each agent's own number, of the simplified formulation at the last step; NaN where it has none.
    worth : dE/dµ of links, by (receiver, sender).
    lacking : what each would take off if it were perfect, to first order.
    first : the links to improve first.
    """

    names: tuple[str, ...]
    places: np.ndarray
    metres: bool
    link: np.ndarray
    step: int | None
    errors: np.ndarray
    worth: dict[tuple[int, int], float] = field(default_factory=dict)
    lacking: dict[tuple[int, int], float] = field(default_factory=dict)
    first: frozenset[tuple[int, int]] = frozenset()

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Links as (receiver, sender), those that are there."""
        if len(self.names) > MOST_LINKED:
            return []
        return [(int(i), int(j)) for i, j in np.argwhere(~np.isnan(self.link))]

    def arc(self, receiver: int, sender: int) -> np.ndarray:
        """Points of a link's arc, (points, 2)."""
        return arc(self.places[sender], self.places[receiver], POINTS)

    def width(self, pair: tuple[int, int]) -> float:
        """Width of a link's arc: the more it is worth, the wider."""
        most = max((abs(slope) for slope in self.worth.values()), default=0.0)
        return 2.0 + (6.0 * abs(self.worth.get(pair, 0.0)) / most if most else 0.0)

    def name(self, pair: tuple[int, int]) -> str:
        """A link in words."""
        return f"{self.names[pair[1]]} → {self.names[pair[0]]}"

    def mended(self) -> str:
        """Say which link has most to gain; empty where none differs."""
        most = max(self.lacking.values(), default=0.0)
        best = [self.name(pair) for pair, gain in self.lacking.items() if gain >= most * (1 - 1e-6)]
        if most <= 0 or len(best) == len(self.lacking):
            return ""
        return f" To mend first: {', '.join(best)}; perfect, it would take about {most:.3g} off (to first order)."

    def about_link(self, pair: tuple[int, int], asked: PageInput) -> str:
        """Say what a link is and what it is worth."""
        at = f" in step {self.step}" if self.step else ""
        text = f"Link {self.name(pair)}: µ = {self.link[pair]:.4g}{at}."
        if pair not in self.worth:
            return text
        slope = self.worth[pair]
        rank = 1 + sum(abs(other) > abs(slope) * (1 + 1e-9) for other in self.worth.values())
        best = " It is one to improve first." if pair in self.first else ""
        return (
            f"{text} Per hundredth of µ more, {asked.measure.label} changes by {slope / 100:.4g} (dE/dµ = {slope:.5g}, "
            f"simplified); rank {rank} of {len(self.worth)}.{best}"
        )

    def senses(self, i: int, asked: PageInput) -> bool:
        """Whether an agent measures anything itself."""
        return bool(np.any(asked.scenario.sensors[asked.scenario.sensor_of[i]].H))

    def about_agent(self, i: int, asked: PageInput) -> str:
        """Say what an agent has and gets."""
        scenario = asked.scenario
        sensor = scenario.sensors[scenario.sensor_of[i]]
        heard = [float(µ) for µ in self.link[i] if not np.isnan(µ) and µ > LEAST]
        seen = "measures nothing itself"
        if self.senses(i, asked):
            R = sensor.R if sensor.R.ndim == 2 else sensor.R[-1]
            deviations = ", ".join(f"{deviation:.4g}" for deviation in np.sqrt(np.diag(R)))
            seen = f"measures with standard deviation {deviations}"
        error = (
            "" if np.isnan(self.errors[i]) else f" Its own {asked.measure.label}: {self.errors[i]:.5g} (simplified)."
        )
        mean = f", with µ = {np.mean(heard):.3g} on average" if heard else ""
        return f"Agent {self.names[i]} {seen}; hears {len(heard)} other(s){mean}.{error}"


def picture(asked: PageInput) -> Picture:
    """Return the network of what is asked, without what its links are worth.

    Raises
    ------
    UsageError, NoAnswerError
        If the scenario's links cannot be laid out.
    """
    scenario, n = asked.scenario, asked.scenario.network.agents
    step = None
    alike = asked.link if asked.kind == "link" else None
    if alike is not None:
        link = np.where(reachable(scenario.network), alike, np.nan)
    else:
        known = links_of_scenario(scenario).link
        link = np.where(reachable(scenario.network), known, np.nan)
        if link.ndim == 3:
            step, link = len(link), link[-1]
    np.fill_diagonal(link, np.nan)
    where = scenario.network.places
    places = np.array([place[-1, :2] if place.ndim == 2 else place[:2] for place in where]) if where else circle(n)
    try:
        found = predict(scenario, None if alike is None else [alike], SIMPLIFIED)
        errors = np.array([found.values(asked.measure, i + 1)[0, -1] for i in range(n)])
    except StochfuseError:  # which the curves say
        errors = np.full(n, np.nan)
    names = scenario.network.names or tuple(str(i + 1) for i in range(n))
    return Picture(names, places, bool(where), link, step, errors)
