"""Expected state estimates given what was measured, with how far they lie apart over what arrives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.prediction.expected_states import ExpectedStates
from stochfuse.report.plot import band, below, canvas, labelled, look, spread, titled
from stochfuse.report.table import Report, Table, number, stamped, to_csv
from stochfuse.scenario import registry

SCHEMA = "stochfuse.prediction/1"


class StatesView(NamedTuple):
    """What is shown: of which agent (a number from 1, or "mean"), at which steps (None: all), with how many digits."""

    found: ExpectedStates
    agent: int | str = "mean"
    steps: Sequence[int] | None = None
    digits: int = 5

    def of(self, values: np.ndarray) -> np.ndarray:
        """Values of the agent, (links, steps, d)."""
        return values.mean(axis=2) if self.agent == "mean" else values[:, :, int(self.agent) - 1]

    @property
    def deviation(self) -> np.ndarray | None:
        """Spread of one agent; of the mean over agents that are all alike, else none: it is not known."""
        deviation = self.found.deviation
        if deviation is None or (self.agent == "mean" and deviation.shape[2] > 1):
            return None
        return self.of(deviation)

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is shown."""
        found = self.found
        # the states' own equations stand beside those of the covariances
        by = registry.engine_of(found.method).title.replace("(54)", "(53)").replace("(49)", "(48)")
        whose = "" if found.estimator == registry.BROADCAST_PRIOR else registry.estimator(found.estimator).of
        whom = "mean over the agents" if self.agent == "mean" else f"agent {self.agent}"
        return (
            f"Expected posterior state estimate given the measurements: {found.scenario.name}",
            f"{by}{whose}; {found.nature}; {whom}",
            "±: standard deviation over what arrives, of one agent"
            if found.deviation is not None
            else "the simplified formulation knows no spread over what arrives",
        )


def states_report(view: StatesView) -> Report:
    """Return expected states in every form."""
    return Report.of(view, states_table, states_csv, states_json, draw)


def _label(found: ExpectedStates, row: int) -> str:
    return found.cases[row] if found.cases is not None else f"{found.link[row]:g}"


def states_table(view: StatesView) -> Table:
    """Return one row for each link probability and step."""
    found, x, deviation = view.found, view.of(view.found.x), view.deviation
    model, shown = found.scenario.model, view.steps or found.steps.tolist()
    columns = []
    for name, unit in zip(model.states, model.units, strict=True):
        columns += [f"{name} [{unit}]" if unit else name, *([f"± {name}"] if deviation is not None else [])]
    rows = []
    for row in range(len(found.link)):
        for k in shown:
            cells = []
            for state in range(len(model.states)):
                cells.append(number(x[row, k - 1, state], view.digits))
                if deviation is not None:
                    cells.append(number(deviation[row, k - 1, state], 3))
            rows.append((_label(found, row), str(k), *cells))
    return Table(view.titles, ("µ", "k"), tuple(columns), tuple(rows))


def states_csv(view: StatesView) -> str:
    """One line for each link probability, step, agent and state."""
    found, rows = view.found, []
    model = found.scenario.model
    for index in np.ndindex(found.x.shape):
        row, k, agent, state = index
        deviation = None if found.deviation is None else found.deviation[index]
        error = None if found.standard_error is None else found.standard_error[index]
        where = (_label(found, row), k + 1, agent + 1, model.states[state], model.units[state])
        rows.append((*where, found.x[index], deviation, error, found.method, found.estimator, found.nature))
    headings = ("link", "step", "agent", "state", "unit", "expected", "spread", "standard_error")
    return to_csv((*headings, "method", "estimator", "nature"), rows)


def states_json(view: StatesView) -> dict[str, Any]:
    """Return the object of schema stochfuse.prediction/1: values of the agent, a list of states per step and link.

    A number in the place of the list where there is one state.
    """
    found = view.found
    return stamped(
        SCHEMA,
        method=found.method,
        estimator=found.estimator,
        quantity="state",
        metric=None,
        agent=view.agent,
        states=list(found.scenario.model.states),
        link=found.link.tolist(),
        cases=None if found.cases is None else list(found.cases),
        steps=found.steps.tolist(),
        values=_squeezed(view.of(found.x)),
        spread=_squeezed(view.deviation),
        agents={
            "values": _squeezed(found.x),
            "spread": _squeezed(found.deviation),
            "standard_error": _squeezed(found.standard_error),
        },
        scenario=found.scenario.to_mapping(),
        meta={"description": list(view.titles), "nature": found.nature},
    )


def _squeezed(values: np.ndarray | None) -> Any:
    """Lists of numbers in the place of lists of one state; None of None."""
    return None if values is None else (values[..., 0] if values.shape[-1] == 1 else values).tolist()


def draw(view: StatesView) -> Any:
    """Return the figure: every state over the steps, at some link probabilities, with ± the spread of one of them."""
    found, x, deviation = view.found, view.of(view.found.x), view.deviation
    model = found.scenario.model
    d = len(model.states)
    figure = canvas(8.0, 1.6 + 2.6 * d)
    rows = spread(len(found.link))
    panels = figure.subplots(d, 1, sharex=True, squeeze=False)[:, 0]
    for state, axes in enumerate(panels):
        for place, row in enumerate(rows):
            middle, style = x[row, :, state], look(place)
            label = f"µ = {_label(found, row)}" if state == 0 else None
            axes.plot(found.steps, middle, label=label, linewidth=1.4, **style)
            if deviation is not None:
                reach = deviation[row, :, state]
                band(axes, found.steps, middle - reach, middle + reach, style["color"])
        unit = model.units[state]
        labelled(axes, None, f"{model.states[state]} [{unit}]" if unit else model.states[state], whole=True)
    panels[-1].set_xlabel("step k")
    below(figure)
    titled(figure, *view.titles)
    return figure
