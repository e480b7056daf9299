"""Load and accuracy of live agents by protocol, as table, CSV, JSON and figure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.data.protocols import ProtocolLoad, SampledLoad
from stochfuse.kalman.metrics import Metric
from stochfuse.prediction import quantities
from stochfuse.report.plot import COLORS, MARKERS, below, canvas, labelled, titled
from stochfuse.report.rows import ResultRows
from stochfuse.report.table import Report, Table, number, records_csv, stamped
from stochfuse.scenario import registry

SCHEMA = "stochfuse.messages/1"
SAYS = {
    "full": "all that a later search may meet",
    "acknowledged": "of that, what not all hearers are known to know",
    "own": "of that, the sender's own estimates",
    "window": "the estimates of the last W steps",
}


@dataclass(frozen=True)
class ProtocolView:
    """What of loads by protocol is shown.

    Parameters
    ----------
    found : the loads, of one window.
    agent : "mean" or a number from 1.
    metric, quantity : of the accuracy, or None where only loads are shown.
    digits : significant digits in tables.
    """

    found: ProtocolLoad
    agent: int | str = "mean"
    metric: Metric | None = None
    quantity: str = "actual"
    digits: int = 5

    @cached_property
    def rows(self) -> ResultRows:
        """What the rows stand for."""
        return ResultRows(self.found)

    def accuracy(self, protocol: int) -> SampledLoad | None:
        """Of a protocol, where it is asked for."""
        return None if self.metric is None else self.found.accuracy(protocol, self.metric, self.quantity, self.agent)

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is shown."""
        f, network = self.found, self.found.scenario.network
        first, last = f.steps[[0, -1]]
        steps = f"step {first}" if first == last else f"steps {first} to {last}"
        whose = "an agent picked at random" if self.agent == "mean" else f"agent {self.agent}"
        kinds = dict.fromkeys(name.partition(":")[0] for name in f.protocols)
        lines = [
            "Live agents: what arrives at an agent in a step, every message counted by itself",
            f"{f.scenario.name}: {network.agents} agents, {network.architecture}; {whose}; {steps}",
            f"estimates{registry.estimator(f.estimator).of}",
            f"sampled, {f.runs:,} runs, seed {f.seed}; ± one standard error",
            *(f"{kind}{':W' * (kind == 'window')}: {SAYS[kind]}" for kind in kinds),
            f"apart: estimates heard that rest on others that are not there ({f.missing})",
        ]
        if self.metric is not None:
            what = quantities.title(self.quantity, "posterior")
            unit = quantities.unit(self.quantity, self.metric)
            shown = quantities.noun(self.quantity, self.metric)
            lines.append(f"Expected {what}: {shown}{f' [{unit}]' if unit else ''}, averaged over {steps}")
        return tuple(lines)


def protocol_report(view: ProtocolView) -> Report:
    """Return loads by protocol in every form."""
    return Report.of(view, _table, _csv, _json, _draw)


def _table(view: ProtocolView) -> Table:
    columns = ("nodes", "bytes", "apart", *(() if view.metric is None else (view.quantity,)))
    rows = []
    for row in range(len(view.found.link)):
        for p, name in enumerate(view.found.protocols):
            shown = [view.found.load(p, what, view.agent) for what in columns[:3]]
            accuracy = view.accuracy(p)
            apart = shown.pop().values[row]
            cells = [*(_cell(each, row, 3) for each in shown), f"{apart:.2g}"]
            cells += [] if accuracy is None else [_cell(accuracy, row, view.digits)]
            rows.append((*view.rows.cells(row), name, *cells))
    return Table(view.titles, (*view.rows.keys, "protocol"), columns, tuple(rows))


def _cell(shown: SampledLoad, row: int, digits: int) -> str:
    value, error = shown.values[row], shown.error[row]
    return "0" if not value and not error else f"{number(value, digits)} ±{error:.2g}"


def _csv(view: ProtocolView) -> str:
    records, f = [], view.found
    first, last = map(int, f.steps[[0, -1]])
    for p, name in enumerate(f.protocols):
        sampled = {what: f.load(p, what, view.agent) for what in ("nodes", "bytes", "apart")}
        for row in range(len(f.link)):
            record = {"protocol": name, "missing": f.missing, "estimator": f.estimator, "nature": "sampled"}
            record |= {"runs": f.runs, "agent": view.agent}
            record |= dict(zip(view.rows.headings, view.rows.record(row), strict=True))
            record |= {"from_step": first, "to_step": last}
            accuracy = view.accuracy(p)
            for what, each in sampled.items():
                record |= {what: float(each.values[row]), f"{what}_standard_error": float(each.error[row])}
            if accuracy is not None and view.metric is not None:
                record |= {"metric": view.metric.name, "quantity": view.quantity}
                record |= {"accuracy": float(accuracy.values[row])}
                record |= {"accuracy_standard_error": float(accuracy.error[row])}
            records.append(record)
    return records_csv(tuple(records[0]), records)


def _json(view: ProtocolView) -> dict[str, Any]:
    """Object of schema stochfuse.messages/1: protocol, load and accuracy of the first, and all in `protocols`."""
    f, each = view.found, []
    for p, name in enumerate(f.protocols):
        nodes, size, apart = (f.load(p, what, view.agent) for what in ("nodes", "bytes", "apart"))
        entry: dict[str, Any] = {
            "protocol": name,
            "load": {
                "nature": "sampled",
                "mean": nodes.values.tolist(),
                "standard_error": nodes.error.tolist(),
                "bytes": {"mean": size.values.tolist(), "standard_error": size.error.tolist()},
                "apart": apart.values.tolist(),
            },
        }
        accuracy = view.accuracy(p)
        if accuracy is not None and view.metric is not None:
            entry["accuracy"] = {
                "nature": "sampled",
                "quantity": view.quantity,
                "metric": view.metric.name,
                "unit": quantities.unit(view.quantity, view.metric) or None,
                "values": accuracy.values.tolist(),
                "standard_error": accuracy.error.tolist(),
            }
        each.append(entry)
    return stamped(
        SCHEMA,
        **view.rows.facts,
        steps=f.steps.tolist(),
        **each[0],
        protocols=each,
        estimator=f.estimator,
        runs=f.runs,
        seed=f.seed,
        missing=f.missing,
        scenario=f.scenario.to_mapping(),
        meta={"description": list(view.titles), "agent": view.agent},
    )


def _draw(view: ProtocolView) -> Any:
    """Accuracy against bytes, a curve for each protocol; without an accuracy bytes against link probability."""
    figure = canvas(7.5, 5.0)
    axes, f = figure.add_subplot(), view.found
    order = np.argsort(f.link)
    for p, name in enumerate(f.protocols):
        size, accuracy = f.load(p, "bytes", view.agent), view.accuracy(p)
        x, y = (f.link, size) if accuracy is None else (size.values, accuracy)
        style = {"marker": MARKERS[p % len(MARKERS)], "color": COLORS[p % len(COLORS)], "capsize": 2, "label": name}
        axes.errorbar(x[order], y.values[order], 1.96 * y.error[order], **style)
    if view.metric is None:
        labelled(axes, "link probability µ", "bytes a step (bars: 95 %)")
    else:
        unit = quantities.unit(view.quantity, view.metric)
        shown = f"{view.quantity} {quantities.noun(view.quantity, view.metric)}{f' [{unit}]' if unit else ''}"
        labelled(axes, "bytes a step", f"{shown} (bars: 95 %)")
    below(figure)
    titled(figure, *view.titles)
    return figure
