"""Message load as table, CSV, JSON and figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stochfuse.kalman.metrics import Metric
from stochfuse.questions.messages import IDENTITY_BYTES, NUMBER_BYTES, Accuracy, Bytes, Load, in_bytes
from stochfuse.report.plot import COLORS, MARKERS, MOST_MARKED, band, below, canvas, labelled, shades, spread, titled
from stochfuse.report.predictions import WIDTH_95, PredictionView
from stochfuse.report.rows import ResultRows
from stochfuse.report.table import Report, Table, number, records_csv, stamped
from stochfuse.scenario.registry import LFG, NAIVE

SCHEMA = "stochfuse.messages/1"
SHORT = {LFG: "LFG", NAIVE: NAIVE}
RULE_TITLES = {
    LFG: "Local Fusion Graph, all that is new to the receiver",
    NAIVE: "naive fusion, the sender's latest node",
}
KINDS = ("moments", "distribution", "cdf", "accuracy")
RULE_DASHES = ("-", "--")


@dataclass(frozen=True)
class LoadView:
    """What of message loads is shown.

    Parameters
    ----------
    loads : one per rule, of one window.
    messages : the naive load of that window: the number of messages.
    kind : one of `KINDS`.
    agent : "mean" (an agent picked at random) or a number from 1.
    header : bytes per message where loads are shown in bytes too, else None.
    accuracies : one per load, for kind "accuracy".
    metric : what is shown of the covariance, for kind "accuracy".
    digits : significant digits in tables.
    """

    loads: tuple[Load, ...]
    messages: Load
    kind: str = "moments"
    agent: int | str = "mean"
    header: int | None = None
    accuracies: tuple[Accuracy, ...] = ()
    metric: Metric | None = None
    digits: int = 5

    @cached_property
    def rows(self) -> ResultRows:
        """What the rows stand for."""
        return ResultRows(self.loads[0])

    def bytes_of(self, load: Load) -> Bytes:
        """Return a load in bytes."""
        return in_bytes(load, self.messages, header=self.header or 0, agent=self.agent)

    @property
    def window(self) -> str:
        """The steps, in words."""
        first, last = self.loads[0].steps[[0, -1]]
        return f"step {first}" if first == last else f"steps {first} to {last}"

    @property
    def whom(self) -> str:
        """One line: the scenario, whose load and which steps."""
        whose = "an agent picked at random" if self.agent == "mean" else f"agent {self.agent}"
        if self.rows.sizes == [1]:
            whose = "alone"
        elif self.loads[0].alike:
            whose = "every agent alike"
        return f"{self.rows.agents}; {whose}; {self.window}{self.rows.common}"

    @property
    def what(self) -> str:
        """One line: what is counted."""
        counted = "nodes new to an agent in all messages of a step, each counted once"
        start = {
            "moments": "Message load: ",
            "distribution": "Message load, probability of each number of ",
            "cdf": "Message load, probability of at most so many ",
            "accuracy": "Accuracy against message load, which is the mean number of ",
        }
        return start[self.kind] + counted

    @property
    def titles(self) -> tuple[str, ...]:
        """Lines that say what is shown and how exact it is."""
        lines = [self.what, self.whom, *(f"{SHORT[load.rule]}: {self.how(load)}" for load in self.loads)]
        lines += [f"accuracy of {SHORT[a.load.rule]}: {self.accuracy_view(a).how}" for a in self.accuracies]
        if self.accuracies:
            bounded = "; ± at most one standard error of the average" if self.accuracies[0].error is not None else ""
            lines.append(self.accuracy_view(self.accuracies[0]).what + f", averaged over {self.window}{bounded}")
        if self.header is not None:
            d = self.loads[0].scenario.model.dimension
            pair = f"an information pair of {d} + {d * (d + 1) // 2} numbers of {NUMBER_BYTES}"
            node = self.bytes_of(self.loads[0]).node
            lines.append(
                f"B: bytes; {node} a node ({pair}, and {IDENTITY_BYTES} to identify it), {self.header} a message"
            )
        return tuple(lines)

    def how(self, load: Load) -> str:
        """What a rule sends and how exact its load is."""
        if load.runs is None:
            return f"{RULE_TITLES[load.rule]}; exact"
        runs = f"{load.runs:,} runs, seed {load.seed}"
        return f"{RULE_TITLES[load.rule]}; sampled, {runs}; ± one standard error"

    def accuracy_view(self, accuracy: Accuracy) -> PredictionView:
        """Return a view of an accuracy's prediction, for its texts."""
        if self.metric is None:
            raise ValueError("a view of accuracies needs a metric")
        return PredictionView(accuracy.prediction, self.metric, self.agent)


def load_report(view: LoadView) -> Report:
    """Return message loads in every form."""
    return Report.of(view, load_table, load_csv, load_json, draw)


def load_table(view: LoadView) -> Table:
    """Return rows of link probabilities (of rules and sizes for distributions)."""
    if view.kind in ("distribution", "cdf"):
        return _distribution_table(view)
    columns, cells = [], []
    accuracies: Sequence[Accuracy | None] = view.accuracies or (None,) * len(view.loads)
    for load, accuracy in zip(view.loads, accuracies, strict=True):
        short = SHORT[load.rule]
        columns.append(f"{short} {'load' if accuracy else 'mean'}")
        cells.append(_numbers(load.mean(view.agent), load.standard_error(view.agent), view.digits))
        if accuracy is None:
            columns += [f"{short} std", f"{short} max"]
            cells += [_numbers(load.std(view.agent), None, view.digits), load.maximum(view.agent).astype(str).tolist()]
        if view.header is not None:
            size = view.bytes_of(load)
            columns += [f"{short} mean B", f"{short} max B"]
            cells += [_numbers(size.mean, None, view.digits), size.maximum.astype(str).tolist()]
        if accuracy is not None:
            columns.append(f"{short} {accuracy.prediction.quantity}")
            cells.append(_numbers(accuracy.values, accuracy.error, view.digits))
    rows = tuple((*view.rows.cells(i), *row) for i, row in enumerate(zip(*cells, strict=True)))
    drawn = "drawn" if any(load.runs is not None for load in view.loads) else "possible"
    note = f"std: over outcomes, steps and agents; max: the largest load {drawn}"
    titles = (*view.titles, *([] if view.accuracies else [note]))
    return Table(titles, view.rows.keys, tuple(columns), rows)


def _numbers(values: np.ndarray, errors: np.ndarray | None, digits: int) -> list[str]:
    shown = [number(value, digits) if value else "0" for value in values]
    return shown if errors is None else [f"{v} ±{e:.2g}" for v, e in zip(shown, errors, strict=True)]


def _names(view: LoadView) -> list[str]:
    return [view.rows.name(row) for row in range(len(view.loads[0].link))]


def _probabilities(load: Load, view: LoadView) -> np.ndarray:
    """Probabilities of each size, or of at most that, up to the largest one, (rows, sizes)."""
    values = load.cdf(view.agent) if view.kind == "cdf" else load.distribution(view.agent)
    return values[:, : load.maximum(view.agent).max() + 1]


def _distribution_table(view: LoadView) -> Table:
    rows = []
    for load in view.loads:
        values = _probabilities(load, view)
        rows += [(SHORT[load.rule], str(size), *_numbers(v, None, view.digits)) for size, v in enumerate(values.T)]
    return Table(view.titles, ("rule", "nodes"), tuple(_names(view)), tuple(rows))


def load_csv(view: LoadView) -> str:
    """One line per rule and link probability, for distributions per size too."""
    records = []
    for r, load in enumerate(view.loads):
        first, last = map(int, load.steps[[0, -1]])
        for i in range(len(load.link)):
            names = dict(zip(view.rows.headings, view.rows.record(i), strict=True))
            start = {"rule": load.rule, "nature": load.nature, "agent": view.agent, **names}
            start |= {"from_step": first, "to_step": last}
            if view.kind == "moments":
                records.append(start | _moments(view, load, i))
            elif view.kind == "accuracy":
                records.append(start | _accuracy(view, view.accuracies[r], i))
            else:
                both = zip(load.distribution(view.agent)[i].tolist(), load.cdf(view.agent)[i].tolist(), strict=True)
                records += [
                    start | {"nodes": size, "probability": p, "cumulative": q} for size, (p, q) in enumerate(both)
                ]
    return records_csv(tuple(records[0]), records)


def _moments(view: LoadView, load: Load, row: int) -> dict[str, Any]:
    error, size = load.standard_error(view.agent), view.bytes_of(load)
    return {
        "mean": float(load.mean(view.agent)[row]),
        "std": float(load.std(view.agent)[row]),
        "max": int(load.maximum(view.agent)[row]),
        "standard_error": None if error is None else float(error[row]),
        "mean_bytes": float(size.mean[row]),
        "max_bytes": int(size.maximum[row]),
    }


def _accuracy(view: LoadView, accuracy: Accuracy, row: int) -> dict[str, Any]:
    shown, load, p = view.accuracy_view(accuracy), accuracy.load, accuracy.prediction
    return {
        "mean": float(load.mean(view.agent)[row]),
        "mean_bytes": float(view.bytes_of(load).mean[row]),
        "metric": shown.metric.name,
        "unit": shown.unit,
        "quantity": p.quantity,
        "method": p.method,
        "accuracy_nature": p.nature,
        "accuracy": float(accuracy.values[row]),
        "accuracy_standard_error_at_most": None if accuracy.error is None else float(accuracy.error[row]),
    }


def load_json(view: LoadView) -> dict[str, Any]:
    """Return the object of schema stochfuse.messages/1."""
    first = view.loads[0]
    rules: dict[str, Any] = {}
    for load in view.loads:
        size, error = view.bytes_of(load), load.standard_error(view.agent)
        rules[load.rule] = {
            "nature": load.nature,
            "description": view.how(load),
            "mean": load.mean(view.agent).tolist(),
            "std": load.std(view.agent).tolist(),
            "max": load.maximum(view.agent).tolist(),
            **({} if error is None else {"standard_error": error.tolist()}),
            "distribution": load.distribution(view.agent).tolist(),
            "cdf": load.cdf(view.agent).tolist(),
            "by_step": load.by_step(view.agent).tolist(),
            "bytes": {"node": size.node, "mean": size.mean.tolist(), "max": size.maximum.tolist()},
        }
    for accuracy in view.accuracies:
        shown, p = view.accuracy_view(accuracy), accuracy.prediction
        rules[accuracy.load.rule]["accuracy"] = {
            "method": p.method,
            "quantity": p.quantity,
            "nature": p.nature,
            "metric": shown.metric.name,
            "unit": shown.unit or None,
            "description": [shown.what, shown.how],
            "values": accuracy.values.tolist(),
            **({} if accuracy.error is None else {"standard_error_at_most": accuracy.error.tolist()}),
        }
    return stamped(
        SCHEMA,
        **view.rows.facts,
        steps=first.steps.tolist(),
        rules=rules,
        scenario=first.scenario.to_mapping(),
        meta={"description": list(view.titles), "agent": view.agent, "header_bytes": view.header or 0},
    )


def draw(view: LoadView) -> Any:
    """Return the figure."""
    figure = canvas(7.5, 5.0)
    axes = figure.add_subplot()
    {"moments": _draw_moments, "accuracy": _draw_accuracy}.get(view.kind, _draw_distribution)(view, axes)
    below(figure)
    titled(figure, *view.titles)
    return figure


def _draw_moments(view: LoadView, axes: Any) -> None:
    if not view.rows.sequence:
        _draw_steps(view, axes)
        return
    curves = view.rows.curves(None)
    shown = curves.shown()
    alone = len(shown) == 1
    for load, style, marker in zip(view.loads, RULE_DASHES, MARKERS, strict=False):
        for curve in shown:
            mean, std = load.mean(view.agent)[curve.pick], load.std(view.agent)[curve.pick]
            label = ", ".join(filter(None, (SHORT[load.rule], curve.name)))
            few = {"marker": marker if len(curve.x) <= MOST_MARKED else None, "markersize": 4}
            (line,) = axes.plot(curve.x, mean, linestyle="-" if alone else style, label=label, **few)
            if alone:
                band(axes, curve.x, np.maximum(mean - std, 0), mean + std, line.get_color())
    what = "mean nodes per step" + " (band: ± one standard deviation)" * alone
    labelled(axes, curves.label, what, whole=curves.whole, zero=True)


def _draw_steps(view: LoadView, axes: Any) -> None:
    for load, style, label, color, i in _curves(view):
        mean = load.by_step(view.agent)[i] @ load.sizes
        axes.plot(load.steps, mean, style, marker=".", color=color, label=label)
    labelled(axes, "step k", "mean nodes per step", whole=True, zero=True)


def _draw_distribution(view: LoadView, axes: Any) -> None:
    widest = max(int(load.maximum(view.agent).max()) for load in view.loads)
    for load, style, label, color, i in _curves(view):
        values = _probabilities(load, view)[i]
        if view.kind == "cdf":
            whole = np.append(values, np.ones(widest + 1 - len(values)))
            axes.plot(whole, style, color=color, label=label, drawstyle="steps-post")
        else:
            axes.plot(values, style, color=color, label=label, marker=".")
    what = "probability of at most so many" if view.kind == "cdf" else "probability"
    labelled(axes, "nodes per step", what, whole=True, zero=True)


def _curves(view: LoadView) -> Iterator[tuple[Load, str, str, Any, int]]:
    """Load, line style, label, colour and row of every curve: a style per rule, a colour per row."""
    names = _names(view)
    chosen = spread(len(names))
    for load, style in zip(view.loads, RULE_DASHES, strict=False):
        for i, color in zip(chosen, shades(len(chosen)), strict=True):
            yield load, style, f"{SHORT[load.rule]}, {names[i]}", color, i


def _draw_accuracy(view: LoadView, axes: Any) -> None:
    bare = view.rows.over is None and view.loads[0].cases is None
    names = [f"{µ:.3g}" for µ in view.loads[0].link] if bare else _names(view)
    picks = view.rows.curves(None).picks if view.rows.sequence else [(np.argsort(view.loads[0].link),)]
    for r, accuracy in enumerate(view.accuracies):
        load = accuracy.load.mean(view.agent)
        for c, (order,) in enumerate(picks):
            errors = None if accuracy.error is None else WIDTH_95 * accuracy.error[order]
            style = {"marker": MARKERS[r], "color": COLORS[r], "label": None if c else SHORT[accuracy.load.rule]}
            axes.errorbar(load[order], accuracy.values[order], errors, capsize=2, **style)
        for i in spread(len(names)):
            at = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 7}
            axes.annotate(names[i], (load[i], accuracy.values[i]), **at)
    shown = view.accuracy_view(view.accuracies[0])
    bars = "; bars: at least 95 % confidence" if view.accuracies[0].error is not None else ""
    marks = "link probability µ" if view.rows.over is None else "what is swept"
    labelled(axes, f"mean nodes per step (marks: {marks}{bars})", shown.axis, zero=True)
