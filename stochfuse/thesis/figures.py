"""Families of figures: each makes the panels of many figures from the same few numbers.

Families of figures about messages, and those that compare methods: figures 49–55, 60–62 and 67–72.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from stochfuse.report.reproductions import DrawnCurve, Panel
from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis import bench as records
from stochfuse.thesis.bench import (
    ARCHITECTURES,
    LINKS,
    STATED_WINDOW,
    STEADY,
    TRANSIENT,
    WINDOW,
    Bench,
    ThesisCase,
    Weights,
)

FEW = 20
"""Records whose spread is shown."""
RULES = {LFG: "Local Fusion Graph", NAIVE: "naive fusion", SIMPLIFIED: "simplified (53)/(54)"}
CONNECTIVITY = "average connectivity"
ONE = "given one record of truth and measurements (seed {}, record 1), averaged over links as the thesis does{}"
NOISE = "averaged over links and noise, exact"
APPROXIMATELY = "averaged over links and noise, approximate"
Make = Callable[[Bench], tuple[Panel, ...]]


def one_record(bench: Bench, *, exact: bool = True) -> str:
    """Title of what is given one record."""
    return ONE.format(bench.seed, ", exact" if exact else ", approximate")


def percent(link: float) -> str:
    """Return a link probability as the thesis names it: 25 %."""
    return f"{100 * link:g} %"


def over_steps(bench: Bench, title: str, y: str, curves: Sequence[DrawnCurve], y_range=None) -> Panel:
    """Return curves over the time step."""
    x = np.arange(1, bench.steps + 1)
    return Panel(title, "time step", y, tuple(f"k={k}" for k in x), x, tuple(curves), y_range)


def over_links(title: str, y: str, curves: Sequence[DrawnCurve], links: Sequence[float] = LINKS) -> Panel:
    """Return curves over the link probability."""
    return Panel(title, CONNECTIVITY, y, tuple(map(percent, links)), np.array(links), tuple(curves))


def per_link(values: np.ndarray, name: str = "") -> list[DrawnCurve]:
    """Return a curve over steps per link probability, of values (links, steps)."""
    return [DrawnCurve(name + percent(link), row) for link, row in zip(LINKS, values, strict=True)]


def covariance(case: ThesisCase, architecture: str, rules: Sequence[str] = (LFG,)) -> Make:
    """Figures 20–22, 36–38, 56, 58, 65, 66: claimed covariance over time, one curve per connectivity."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        return tuple(
            over_steps(
                bench,
                f"{RULES[rule]}, {'approximate' if rule == SIMPLIFIED else 'exact average over links'}",
                "claimed covariance",
                per_link(bench.claimed(case, architecture, rule=rule)),
            )
            for rule in rules
        )

    return make


def normalised(case: ThesisCase, architecture: str) -> Make:
    """Figures 23–25, 39–41: claimed covariance relative to that without links, one curve per step."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        P = bench.claimed(case, architecture)
        curves = [DrawnCurve(f"k={k}", column) for k, column in enumerate((P / P[0]).T, start=1)]
        return (over_links("Local Fusion Graph, exact average over links", "claimed covariance / that at 0 %", curves),)

    return make


def states(case: ThesisCase, architecture: str, rules: Sequence[str] = (LFG,)) -> Make:
    """Figures 26–28, 42–44, 57, 59, 69, 70: mean state estimate over time, with the truth."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        scenario = bench.scenario(case, architecture)
        drawn = records.draw(scenario, 1, bench.seed)
        panels = []
        for rule in rules:
            weights = bench.weights(case, architecture, rule=rule)
            true = records.truth(scenario, drawn)[0]
            expected = np.full(bench.steps, records.TRUTH)
            exact = rule != SIMPLIFIED
            for title, x, error in (
                (NOISE if exact else APPROXIMATELY, expected, weights.first[..., -1]),
                (one_record(bench, exact=exact), true, weights.mean_given(drawn)[0]),
            ):
                curves = [DrawnCurve("true state", x), *per_link(x + error)]
                panels.append(over_steps(bench, f"{RULES[rule]}, {title}", "mean state estimate", curves))
        return tuple(panels)

    return make


def errors(case: ThesisCase, architecture: str) -> Make:
    """Figures 29–31, 45–47: RMS error over time, one curve per connectivity."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        scenario, weights = bench.scenario(case, architecture), bench.weights(case, architecture)
        one = weights.rms_given(records.draw(scenario, 1, bench.seed))[0]
        y = "RMS error (actual)"
        return (
            over_steps(bench, f"Local Fusion Graph, {NOISE}", y, per_link(weights.rms(records.spread(scenario)))),
            over_steps(bench, f"Local Fusion Graph, {one_record(bench)}", y, per_link(one)),
        )

    return make


def time_average(rms: np.ndarray) -> np.ndarray:
    """RMS errors averaged over the steps but the first, as the thesis averages them; (..., steps) to (...)."""
    return rms[..., 1:].mean(axis=-1)


def averaged_errors(
    bench: Bench,
    weights: Weights,
    case: ThesisCase,
    architecture: str,
    data: str = "own",
    *,
    initial_error: bool = True,
) -> np.ndarray:
    """Return the time-averaged RMS error, averaged over the noise, (links,)."""
    spread = records.spread(bench.scenario(case, architecture), data, initial_error=initial_error)
    return time_average(weights.rms(spread))


def errors_of_records(
    bench: Bench, weights: Weights, case: ThesisCase, architecture: str, number: int, data: str = "own"
) -> np.ndarray:
    """Return the time-averaged RMS error of single records, (records, links)."""
    drawn = records.draw(bench.scenario(case, architecture), number, bench.seed, data)
    return time_average(weights.rms_given(drawn))


def change(values: np.ndarray) -> np.ndarray:
    """Change against the first link probability, in per cent of it, along the last axis."""
    return 100.0 * (values / values[..., :1] - 1.0)


def averaged_over_time(
    cases: Sequence[tuple[str, ThesisCase, str]], links: Sequence[float] = LINKS, variants: Sequence[str] = ()
) -> Make:
    """Figures 32–35, 48: time-averaged RMS error over connectivity, one curve per (name, case, architecture).

    Parameters
    ----------
    variants : further panels: "no initial error", or other records, see `stochfuse.thesis.bench`.
    """

    def make(bench: Bench) -> tuple[Panel, ...]:
        found = [(name, case, a, bench.weights(case, a, links)) for name, case, a in cases]
        y = f"RMS error (actual), mean over steps 2–{bench.steps}"
        single = [(n, errors_of_records(bench, w, c, a, FEW)) for n, c, a, w in found]
        panels = [
            over_links(NOISE, y, [DrawnCurve(n, averaged_errors(bench, w, c, a)) for n, c, a, w in found], links),
            over_links(one_record(bench), y, [DrawnCurve(n, e[0]) for n, e in single], links),
            over_links(
                f"{FEW} single records: median, lowest and highest",
                "change of that RMS error against 0 %, in per cent of it",
                [
                    DrawnCurve(n, np.median(change(e), axis=0), change(e).min(axis=0), change(e).max(axis=0))
                    for n, e in single
                ],
                links,
            ),
        ]
        for variant in variants:
            title, options = VARIANTS[variant]
            curves = [DrawnCurve(n, averaged_errors(bench, w, c, a, **options)) for n, c, a, w in found]
            panels.append(over_links(f"{NOISE}, {title}", y, curves, links))
        return tuple(panels)

    return make


VARIANTS = {
    "no-error": ("without the common initial error", {"initial_error": False}),
    "start": ("all agents start from one estimate, fused as if each had its own", {"data": "start"}),
    "all": ("all agents have one initial estimate and one measurement of each step", {"data": "all"}),
}


def by_architecture(case: ThesisCase) -> list[tuple[str, ThesisCase, str]]:
    """Return the three networks of the thesis in one scenario."""
    return [(a.replace("-", " "), case, a) for a in ARCHITECTURES]


RATIOS = (("1/16", 6.25), ("1/4", 25.0), ("4", 400.0))
"""Ratios Q/R; the thesis' own three are not in its text, only 1:4 is."""


def by_ratio(architecture: str) -> list[tuple[str, ThesisCase, str]]:
    """Return the transient scenario with three ratios of process to measurement noise, R = P(k0) = 100."""
    return [(f"Q/R = {name}", ThesisCase("transient", q=q), architecture) for name, q in RATIOS]


def sample_run(bench: Bench) -> tuple[Panel, ...]:
    """Figure 19: one run, and what any run can give."""
    run = bench.sample(TRANSIENT, "ad-hoc", LINKS, 2)[:, 0]
    return (
        over_steps(
            bench, f"one run (seed {bench.seed}, agent 1), sampled", "claimed covariance", per_link(run), (0, 100)
        ),
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
            curves = tuple(DrawnCurve(percent(µ), row) for µ, row in zip(links, values, strict=True))
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
            curves = [DrawnCurve(name, mean_size(bench, a, rule, (first, last))) for name, a, rule in names]
            panels.append(
                over_links(f"exact, steps {first}–{last}{_window(first, last)}", "mean message size [nodes]", curves)
            )
        return tuple(panels)

    return make


def cost_of_accuracy(case: ThesisCase) -> Make:
    """Figures 61, 62: time-averaged RMS error over the mean message size."""

    def make(bench: Bench) -> tuple[Panel, ...]:
        found = [(RULES[LFG], a, LFG) for a in ARCHITECTURES] + [(RULES[NAIVE], a, NAIVE) for a in ARCHITECTURES]
        averaged, single = [], []
        for name, a, rule in found:
            weights, size = bench.weights(case, a, rule=rule), mean_size(bench, a, rule)
            label = f"{name}, {a.replace('-', ' ')}"
            averaged.append(DrawnCurve(label, averaged_errors(bench, weights, case, a), at=size))
            single.append(DrawnCurve(label, errors_of_records(bench, weights, case, a, 1)[0], at=size))
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
    curves = [DrawnCurve(name, P / P[0]) for name, P in averaged_covariances(bench).items()]
    y = f"claimed covariance, mean over steps 1–{bench.steps}, / that at 0 %"
    panel = over_links("ad hoc; Local Fusion Graph exact, simplified approximate", y, curves)
    return (Panel(panel.title, panel.x_label, y, panel.points, panel.x, panel.curves, (0.4, 1.0)),)


def figure_68(bench: Bench) -> tuple[Panel, ...]:
    """Figure 68: difference of the covariances, relative to the initial covariance."""
    curves = [DrawnCurve(case.name, covariance_difference(bench, case)) for case in (TRANSIENT, STEADY)]
    y = f"simplified less Local Fusion Graph, mean over steps 1–{bench.steps}, / P(k0)"
    return (over_links("ad hoc, claimed covariance", y, curves),)


def covariance_difference(bench: Bench, case: ThesisCase) -> np.ndarray:
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
        curves = [DrawnCurve(f"{RULES[rule]}, {case}", y) for (case, rule), y in found.items()]
        panels.append(over_links(f"ad hoc, {title}", f"RMS error, mean over steps 2–{bench.steps}, / 0 %", curves))
    return tuple(panels)


def figure_72(bench: Bench) -> tuple[Panel, ...]:
    """Figure 72: their difference."""
    panels = []
    for title, one in ((BOTH_NOISE, False), (BOTH_ONE.format(bench.seed, ""), True)):
        found = relative_errors(bench, one_record=one)
        curves = [DrawnCurve(c.name, found[c.name, SIMPLIFIED] - found[c.name, LFG]) for c in (TRANSIENT, STEADY)]
        panels.append(over_links(f"ad hoc, {title}", "simplified less Local Fusion Graph, both / 0 %", curves))
    return tuple(panels)
