"""What the thesis' figures show: quantities, each the panels of a figure from the sweeps that it is about.

Which figure shows which quantity of what is declared in `stochfuse.thesis.catalogue`.

The thesis' table 3, sizes of Local Fusion Graph messages, stands beside the exact calculation.  The thesis states
10 steps of which the first five are left out.  Its maxima (24 in a broadcast network, 23 = 2·12 − 1 in a cyclic one)
need 12 steps, and with steps 6–12 its broadcast column is met within 1 %.  Its *ad hoc* column has the moments of a
broadcast draw too.  Its cyclic column lies lower than these steps', by 3–6 % in the mean and 5–7 % in the standard
deviation, which is not explained.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stochfuse.report.reproductions import DrawnCurve, Panel
from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.scenario.scenario import Scenario
from stochfuse.thesis.bench import (
    LINKS,
    STATED_WINDOW,
    STEADY,
    TABLE_3,
    TRANSIENT,
    TRUTH,
    WINDOW,
    Bench,
    Sweep,
    time_average,
    truth,
)

FEW = 20
"""Records whose spread is shown."""
MOST_NODES = 10
"""Message sizes that the thesis' axes show."""
RULES = {LFG: "Local Fusion Graph", NAIVE: "naive fusion", SIMPLIFIED: "simplified (53)/(54)"}
NOISE = "averaged over links and noise, exact"
ONE = "given one record of truth and measurements (seed {}, record 1), averaged over links as the thesis does"
BOTH = "; Local Fusion Graph exact, simplified approximate"
RATIOS = (("1/16", 6.25), ("1/4", 25.0), ("4", 400.0))
"""Ratios Q/R; the thesis' own three are not in its text, only 1:4 is."""
VARIANTS = {
    "no-error": ("without the common initial error", {"initial_error": False}),
    "start": ("all agents start from one estimate, fused as if each had its own", {"data": "start"}),
    "all": ("all agents have one initial estimate and one measurement of each step", {"data": "all"}),
}
"""Other readings of what the thesis did, see `stochfuse.thesis.bench`."""

Curves = Sequence[DrawnCurve]


def percent(link: float) -> str:
    """Return a link probability as the thesis names it: 25 %."""
    return f"{100 * link:g} %"


def change(values: np.ndarray) -> np.ndarray:
    """Change against the first link probability, in per cent of it, along the last axis."""
    return 100.0 * (values / values[..., :1] - 1.0)


def _one_record(bench: Bench, rule: str = LFG) -> str:
    return ONE.format(bench.seed) + (", approximate" if rule == SIMPLIFIED else ", exact")


def _over_steps(bench: Bench, title: str, y: str, curves: Curves, y_range: tuple[float, float] | None = None) -> Panel:
    x = np.arange(1, bench.steps + 1)
    return Panel(title, "time step", y, tuple(f"k={k}" for k in x), x, tuple(curves), y_range)


def _over_links(title: str, y: str, curves: Curves, links: Sequence[float] = LINKS, x: str = "", **kind) -> Panel:
    return Panel(
        title, x or "average connectivity", y, tuple(map(percent, links)), np.array(links), tuple(curves), **kind
    )


def _per_link(values: np.ndarray) -> list[DrawnCurve]:
    """Return a curve over steps per link probability, of values (links, steps)."""
    return [DrawnCurve(percent(link), row) for link, row in zip(LINKS, values, strict=True)]


def sample_run(sweep: Sweep) -> list[Panel]:
    """One run, and what any run can give."""
    bench = sweep.bench
    run = bench.sample(sweep.case, sweep.architecture, LINKS, 2)[:, 0]
    title = f"one run (seed {bench.seed}, agent 1), sampled"
    return [_over_steps(bench, title, "claimed covariance", _per_link(run), (0, 100))]


def covariance(*sweeps: Sweep) -> list[Panel]:
    """Claimed covariance over time, one curve per connectivity."""
    exact = {rule: "approximate" if rule == SIMPLIFIED else "exact average over links" for rule in RULES}
    return [
        _over_steps(s.bench, f"{RULES[s.rule]}, {exact[s.rule]}", "claimed covariance", _per_link(s.claimed))
        for s in sweeps
    ]


def normalised(sweep: Sweep) -> list[Panel]:
    """Claimed covariance relative to that without links, one curve per step."""
    P = sweep.claimed
    curves = [DrawnCurve(f"k={k}", column) for k, column in enumerate((P / P[0]).T, start=1)]
    return [_over_links("Local Fusion Graph, exact average over links", "claimed covariance / that at 0 %", curves)]


def states(*sweeps: Sweep) -> list[Panel]:
    """Mean state estimate over time, with the truth."""
    panels = []
    for s in sweeps:
        drawn = s.records(1)
        noise = "averaged over links and noise, approximate" if s.rule == SIMPLIFIED else NOISE
        for title, x, error in (
            (noise, np.full(s.bench.steps, TRUTH), s.bias),
            (_one_record(s.bench, s.rule), truth(s.scenario, drawn)[0], s.weights.mean_given(drawn)[0]),
        ):
            curves = [DrawnCurve("true state", x), *_per_link(x + error)]
            panels.append(_over_steps(s.bench, f"{RULES[s.rule]}, {title}", "mean state estimate", curves))
    return panels


def errors(sweep: Sweep) -> list[Panel]:
    """RMS error over time, one curve per connectivity."""
    return [
        _over_steps(sweep.bench, f"Local Fusion Graph, {title}", "RMS error (actual)", _per_link(rms))
        for title, rms in ((NOISE, sweep.rms()), (_one_record(sweep.bench), sweep.rms_given(1)[0]))
    ]


def averaged_errors(*sweeps: Sweep, variants: Sequence[str] = ()) -> list[Panel]:
    """Time-averaged RMS error over connectivity, one curve per network, or ratio of the noises.

    Parameters
    ----------
    variants : further panels, of `VARIANTS`.
    """
    bench, links = sweeps[0].bench, sweeps[0].links
    ratio = {q: f"Q/R = {name}" for name, q in RATIOS}
    names = [s.network if s.case.q is None else ratio[s.case.q] for s in sweeps]
    y = f"RMS error (actual), mean over steps 2–{bench.steps}"

    def named(values: Sequence[np.ndarray]) -> list[DrawnCurve]:
        return [DrawnCurve(name, each) for name, each in zip(names, values, strict=True)]

    single = [time_average(s.rms_given(FEW)) for s in sweeps]
    moves = [change(each) for each in single]
    return [
        _over_links(NOISE, y, named([s.averaged() for s in sweeps]), links),
        _over_links(_one_record(bench), y, named([each[0] for each in single]), links),
        _over_links(
            f"{FEW} single records: median, lowest and highest",
            "change of that RMS error against 0 %, in per cent of it",
            [
                DrawnCurve(name, np.median(move, axis=0), move.min(axis=0), move.max(axis=0))
                for name, move in zip(names, moves, strict=True)
            ],
            links,
        ),
        *(
            _over_links(f"{NOISE}, {title}", y, named([s.averaged(**options) for s in sweeps]), links)
            for title, options in (VARIANTS[variant] for variant in variants)
        ),
    ]


def histogram(sweep: Sweep, *, cumulative: bool = False) -> list[Panel]:
    """Distribution of the message size, or the cumulative one."""
    panels, x = [], np.arange(MOST_NODES + 1)
    y = "cumulative probability" if cumulative else "probability"
    for first, last in (WINDOW, STATED_WINDOW):
        load = sweep.bench.messages(sweep.architecture).between(first, last)
        values = (load.cdf() if cumulative else load.distribution())[1:-1, : MOST_NODES + 1]
        curves = tuple(DrawnCurve(percent(µ), row) for µ, row in zip(LINKS[1:-1], values, strict=True))
        title = f"Local Fusion Graph, {_window(first, last)}"
        points = tuple(map(str, x))
        panels.append(Panel(title, "nodes per message", y, points, x, curves, (0.0, 1.0), bars=not cumulative))
    return panels


def cumulative(sweep: Sweep) -> list[Panel]:
    """Cumulative distribution of the message size."""
    return histogram(sweep, cumulative=True)


def _window(first: int, last: int) -> str:
    why = "the thesis' stated window" if (first, last) == STATED_WINDOW else "what table 3's maxima need"
    return f"exact, steps {first}–{last} ({why})"


def message_sizes(*sweeps: Sweep) -> list[Panel]:
    """Mean message size over connectivity."""
    return [
        _over_links(
            _window(*window),
            "mean message size [nodes]",
            [DrawnCurve(f"{RULES[s.rule]}, {s.network}", s.size(window)) for s in sweeps],
        )
        for window in (WINDOW, STATED_WINDOW)
    ]


def cost_of_accuracy(*sweeps: Sweep) -> list[Panel]:
    """Time-averaged RMS error over the mean message size."""
    bench = sweeps[0].bench
    names, sizes = [f"{RULES[s.rule]}, {s.network}" for s in sweeps], [s.size() for s in sweeps]
    averaged, single = [s.averaged() for s in sweeps], [time_average(s.rms_given(1))[0] for s in sweeps]
    y = f"RMS error (actual), mean over steps 2–{bench.steps}"
    return [
        _over_links(
            title,
            y,
            [DrawnCurve(name, error, at=at) for name, error, at in zip(names, values, sizes, strict=True)],
            x="mean message size [nodes]",
        )
        for title, values in ((NOISE, averaged), (_one_record(bench), single))
    ]


def averaged_covariances(*sweeps: Sweep) -> list[Panel]:
    """Covariance averaged over time, relative to that without links."""
    averages = [(f"{RULES[s.rule]}, {s.case.name}", s.claimed.mean(axis=1)) for s in sweeps]
    y = f"claimed covariance, mean over steps 1–{sweeps[0].bench.steps}, / that at 0 %"
    title = "ad hoc; Local Fusion Graph exact, simplified approximate"
    return [_over_links(title, y, [DrawnCurve(name, P / P[0]) for name, P in averages], y_range=(0.4, 1.0))]


def covariance_differences(*sweeps: Sweep) -> list[Panel]:
    """Difference of the covariances of the two methods, relative to the initial covariance."""
    curves = [DrawnCurve(s.case.name, covariance_difference(s)) for s in sweeps]
    y = f"simplified less Local Fusion Graph, mean over steps 1–{sweeps[0].bench.steps}, / P(k0)"
    return [_over_links("ad hoc, claimed covariance", y, curves)]


def covariance_difference(sweep: Sweep) -> np.ndarray:
    """Simplified less exact claimed covariance, averaged over time, in units of P(k0), (links,)."""
    simplified, exact = (sweep.by(rule).claimed.mean(axis=1) for rule in (SIMPLIFIED, LFG))
    return (simplified - exact) / sweep.scenario.P0.item()


def relative_error(sweep: Sweep, *, one_record: bool = False) -> np.ndarray:
    """Time-averaged RMS error relative to that without links, (links,)."""
    rms = time_average(sweep.rms_given(1))[0] if one_record else sweep.averaged()
    return rms / rms[0]


def relative_errors(*sweeps: Sweep) -> list[Panel]:
    """Relative RMS errors of both methods."""
    bench = sweeps[0].bench
    return [
        _over_links(
            title,
            f"RMS error, mean over steps 2–{bench.steps}, / 0 %",
            [DrawnCurve(f"{RULES[s.rule]}, {s.case.name}", relative_error(s, one_record=one)) for s in sweeps],
        )
        for title, one in _both(bench)
    ]


def error_differences(*sweeps: Sweep) -> list[Panel]:
    """Difference of the relative RMS errors of the two methods."""

    def difference(s: Sweep, one: bool) -> np.ndarray:
        return relative_error(s.by(SIMPLIFIED), one_record=one) - relative_error(s.by(LFG), one_record=one)

    return [
        _over_links(
            title,
            "simplified less Local Fusion Graph, both / 0 %",
            [DrawnCurve(s.case.name, difference(s, one)) for s in sweeps],
        )
        for title, one in _both(sweeps[0].bench)
    ]


def _both(bench: Bench) -> tuple[tuple[str, bool], ...]:
    return (f"ad hoc, averaged over links and noise{BOTH}", False), (f"ad hoc, {ONE.format(bench.seed)}{BOTH}", True)


def table_3(*sweeps: Sweep) -> list[Panel]:
    """Table 3 beside the exact calculation, for the window it needs and the one it states; a panel per column."""
    panels = []
    for s in sweeps:
        draws = ("ad-hoc", "broadcast") if s.architecture == "ad-hoc" else (s.architecture,)
        known = {"thesis": TABLE_3[s.architecture]} | {
            f"{draw.replace('-', ' ')}, k={first}–{last}": s.bench.table_3(draw, (first, last))
            for draw in draws
            for first, last in (STATED_WINDOW, WINDOW)
        }
        curves = [
            DrawnCurve(f"{moment}, {name}", table[:, column])
            for column, moment in enumerate(("mean", "maximum", "std"))
            for name, table in known.items()
        ]
        title = f"the thesis' column '{s.network}', and exact values by draw and window"
        panels.append(_over_links(title, "message size [nodes]", curves))
    return panels


def parameters(bench: Bench) -> list[tuple[str, str, str]]:
    """Parameters in the thesis' tables 2 and 4 beside the presets'."""
    transient, steady = (Sweep(bench, case).scenario for case in (TRANSIENT, STEADY))
    model, sensor, network = transient.model, transient.sensors[0], transient.network
    return [
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
    ]


def _start(scenario: Scenario) -> str:
    error = 0.0 if scenario.error is None else scenario.error.item()
    return f"{scenario.P0.item():g}, truth {error:+g} + N(0, {scenario.P0.item():g}), each agent its own"
