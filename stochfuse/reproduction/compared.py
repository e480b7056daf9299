"""Families of figures about messages, and those that compare methods: figures 49–55, 60–62 and 67–72."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stochfuse.report.reproductions import Curve, Panel
from stochfuse.reproduction.bench import (
    ARCHITECTURES,
    LFG,
    LINKS,
    NAIVE,
    SIMPLIFIED,
    STATED_WINDOW,
    STEADY,
    TRANSIENT,
    WINDOW,
    Bench,
    Case,
)
from stochfuse.reproduction.figures import (
    NOISE,
    ONE,
    RULES,
    Make,
    averaged_errors,
    errors_of_records,
    one_record,
    over_links,
    percent,
)

MOST_NODES = 10
"""Message sizes that the thesis' axes show."""
BOTH_NOISE = "averaged over links and noise; Local Fusion Graph exact, simplified approximate"
BOTH_ONE = ONE + "; Local Fusion Graph exact, simplified approximate"


def histogram(architecture: str) -> Make:
    """Figures 49–51: distribution of the message size."""
    return _message_distribution(architecture, cumulative=False)


def cumulative(architecture: str) -> Make:
    """Figures 53–55: cumulative distribution of the message size."""
    return _message_distribution(architecture, cumulative=True)


def _message_distribution(architecture: str, *, cumulative: bool) -> Make:
    def make(bench: Bench) -> tuple[Panel, ...]:
        links = LINKS[1:-1]
        panels = []
        for first, last in (WINDOW, STATED_WINDOW):
            load = bench.messages(architecture, links).between(first, last)
            values = (load.cdf() if cumulative else load.distribution())[:, : MOST_NODES + 1]
            x = np.arange(MOST_NODES + 1)
            title = f"Local Fusion Graph, exact, steps {first}–{last}{_window(first, last)}"
            y = "cumulative probability" if cumulative else "probability"
            curves = tuple(Curve(percent(µ), row) for µ, row in zip(links, values, strict=True))
            panels.append(
                Panel(title, "nodes per message", y, tuple(map(str, x)), x, curves, (0.0, 1.0), bars=not cumulative)
            )
        return tuple(panels)

    return make


def _window(first: int, last: int) -> str:
    return " (the thesis' stated window)" if (first, last) == STATED_WINDOW else " (what table 3's maxima need)"


def mean_size(bench: Bench, architecture: str, rule: str = LFG, window: tuple[int, int] = WINDOW) -> np.ndarray:
    """Return the mean message size in nodes, (links,)."""
    return bench.messages(architecture, rule=rule).between(*window).mean()


def message_sizes(rules: Sequence[str] = (LFG,)) -> Make:
    """Figures 52, 60: mean message size over connectivity."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        names = [(f"{RULES[rule]}, {a.replace('-', ' ')}", a, rule) for rule in rules for a in ARCHITECTURES]
        panels = []
        for first, last in (WINDOW, STATED_WINDOW):
            curves = [Curve(name, mean_size(bench, a, rule, (first, last))) for name, a, rule in names]
            panels.append(
                over_links(f"exact, steps {first}–{last}{_window(first, last)}", "mean message size [nodes]", curves)
            )
        return tuple(panels)

    return make


def cost_of_accuracy(case: Case) -> Make:
    """Figures 61, 62: time-averaged RMS error over the mean message size."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        found = [(RULES[LFG], a, LFG) for a in ARCHITECTURES] + [(RULES[NAIVE], a, NAIVE) for a in ARCHITECTURES]
        averaged, single = [], []
        for name, a, rule in found:
            weights, size = bench.weights(case, a, rule=rule), mean_size(bench, a, rule)
            label = f"{name}, {a.replace('-', ' ')}"
            averaged.append(Curve(label, averaged_errors(bench, weights, case, a), at=size))
            single.append(Curve(label, errors_of_records(bench, weights, case, a, 1)[0], at=size))
        y = f"RMS error (actual), mean over steps 2–{bench.steps}"
        return tuple(
            Panel(title, "mean message size [nodes]", y, tuple(map(percent, LINKS)), np.array(LINKS), tuple(curves))
            for title, curves in ((NOISE, averaged), (one_record(bench), single))
        )

    return make


def averaged_covariances(bench: Bench) -> dict[str, np.ndarray]:
    """Claimed covariance averaged over all steps, per curve of figures 67 and 68, (links,)."""
    return {
        f"{RULES[rule]}, {case.name}": bench.claimed(case, "ad-hoc", rule=rule).mean(axis=1)
        for case in (TRANSIENT, STEADY)
        for rule in (SIMPLIFIED, LFG)
    }


def figure_67(bench: Bench) -> tuple[Panel, ...]:
    """Figure 67: covariance averaged over time, relative to that without links."""
    curves = [Curve(name, P / P[0]) for name, P in averaged_covariances(bench).items()]
    y = f"claimed covariance, mean over steps 1–{bench.steps}, / that at 0 %"
    panel = over_links("ad hoc; Local Fusion Graph exact, simplified approximate", y, curves)
    return (Panel(panel.title, panel.x_label, y, panel.points, panel.x, panel.curves, (0.4, 1.0)),)


def figure_68(bench: Bench) -> tuple[Panel, ...]:
    """Figure 68: difference of the covariances, relative to the initial covariance."""
    curves = [Curve(case.name, covariance_difference(bench, case)) for case in (TRANSIENT, STEADY)]
    y = f"simplified less Local Fusion Graph, mean over steps 1–{bench.steps}, / P(k0)"
    return (over_links("ad hoc, claimed covariance", y, curves),)


def covariance_difference(bench: Bench, case: Case) -> np.ndarray:
    """Simplified less exact claimed covariance, averaged over time, in units of P(k0), (links,)."""
    found = averaged_covariances(bench)
    difference = found[f"{RULES[SIMPLIFIED]}, {case.name}"] - found[f"{RULES[LFG]}, {case.name}"]
    return difference / bench.scenario(case, "ad-hoc").P0.item()


def relative_errors(bench: Bench, *, one_record: bool) -> dict[tuple[str, str], np.ndarray]:
    """Time-averaged RMS error relative to that without links, per (case, rule), (links,)."""
    out = {}
    for case in (TRANSIENT, STEADY):
        for rule in (SIMPLIFIED, LFG):
            weights = bench.weights(case, "ad-hoc", rule=rule)
            if one_record:
                rms = errors_of_records(bench, weights, case, "ad-hoc", 1)[0]
            else:
                rms = averaged_errors(bench, weights, case, "ad-hoc")
            out[case.name, rule] = rms / rms[0]
    return out


def figure_71(bench: Bench) -> tuple[Panel, ...]:
    """Figure 71: relative RMS errors of both methods."""
    panels = []
    for title, one in ((BOTH_NOISE, False), (BOTH_ONE.format(bench.seed, ""), True)):
        found = relative_errors(bench, one_record=one)
        curves = [Curve(f"{RULES[rule]}, {case}", y) for (case, rule), y in found.items()]
        panels.append(over_links(f"ad hoc, {title}", f"RMS error, mean over steps 2–{bench.steps}, / 0 %", curves))
    return tuple(panels)


def figure_72(bench: Bench) -> tuple[Panel, ...]:
    """Figure 72: their difference."""
    panels = []
    for title, one in ((BOTH_NOISE, False), (BOTH_ONE.format(bench.seed, ""), True)):
        found = relative_errors(bench, one_record=one)
        curves = [Curve(c.name, found[c.name, SIMPLIFIED] - found[c.name, LFG]) for c in (TRANSIENT, STEADY)]
        panels.append(over_links(f"ad hoc, {title}", "simplified less Local Fusion Graph, both / 0 %", curves))
    return tuple(panels)
