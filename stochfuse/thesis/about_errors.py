"""Statements about state estimates and RMS errors in the transient scenario: figures 26–35."""

from __future__ import annotations

import numpy as np

from stochfuse.kalman.kernel import Estimate, predict, update
from stochfuse.thesis.bench import ARCHITECTURES, LIKE_NETWORKS, TRANSIENT, Bench, Sweep, ThesisCase, noise_order
from stochfuse.thesis.figures import RATIOS, change, percent
from stochfuse.thesis.statements import Stated, Verdict, explained, judged, listed

STATED = Stated()
FINE = (0.0, 0.125, 0.25, 0.375, 0.5)
EIGHTHS = tuple(i / 8 for i in range(9))
CAUSE = "without the common initial error it falls steadily"
INITIAL_ERROR = "the statement holds, and RMS error falls steadily without the common initial error"


def transient(bench: Bench, architecture: str) -> Sweep:
    """Return the Local Fusion Graph in a network of the transient scenario."""
    return Sweep(bench, TRANSIENT, architecture)


def _falls_without_error(sweep: Sweep) -> bool:
    return bool((np.diff(sweep.averaged(initial_error=False)) < 0).all())


def filtered(sweep: Sweep, everyone: int, drawn: np.ndarray) -> np.ndarray:
    """Error of a scalar Kalman filter on some records, (records, steps): with everyone's data, or of agent 1 alone."""
    scenario = sweep.scenario
    model, sensor, n = scenario.model, scenario.sensors[0], scenario.network.agents
    bias = 0.0 if scenario.error is None else scenario.error.item()
    error = np.sqrt(scenario.P0.item()) * drawn[:, :everyone].mean(axis=1) + bias * drawn[:, -1]
    P, out = scenario.P0 / everyone, [error]
    for step in range(1, sweep.bench.steps):
        place = n + (step - 1) * (n + 1)
        noise = np.sqrt(sensor.R.item()) * drawn[:, place + 1 : place + 1 + everyone].mean(axis=1)
        x = (error - np.sqrt(model.Q.item()) * drawn[:, place])[:, None, None]
        prior = predict(Estimate(x, P[None]), model.F, model.Q, 0 * model.Bu)
        found = update(prior, sensor.H, sensor.R / everyone, noise[:, None, None])
        error, P = found.x[:, 0, 0], found.P[0]
        out.append(error)
    return np.stack(out, axis=1)


@STATED.of(
    {26: TRANSIENT},
    "At 0 % and 100 % the state estimates are those of the known algorithms.",
    "equal to the Kalman filter on one agent's, on everyone's data",
    LIKE_NETWORKS,
)
def _known_estimates(sweep: Sweep) -> Verdict:
    drawn, n = sweep.records(5), sweep.scenario.network.agents
    given = sweep.weights.mean_given(drawn)
    turns = [noise_order(np.roll(np.arange(n), i).tolist(), sweep.bench.steps) for i in range(n)]
    alone = np.mean([filtered(sweep, 1, drawn[:, turn]) for turn in turns], axis=0)
    away = max(np.abs(given[:, 0] - alone).max(), np.abs(given[:, -1] - filtered(sweep, n, drawn)).max())
    return judged(away < 1e-6, f"largest difference over 5 records {away:.0e}")


@STATED.of({26: TRANSIENT}, "At some steps the estimate is better at 0 % than at 25 %.", INITIAL_ERROR, LIKE_NETWORKS)
def _worse_at_some_step(sweep: Sweep) -> Verdict:
    bias = np.abs(sweep.bias)
    ours = f"mean error at 0 % {listed(bias[0])}; at 25 % {listed(bias[1])} (k=1–{sweep.bench.steps})"
    return explained((bias[1] > bias[0]).any(), _falls_without_error(sweep), f"{ours}; {CAUSE}")


@STATED.about([28], "0, 25 and 50 % give about the same estimates.", "within 5 % of the state")
def _cyclic_states(bench: Bench) -> Verdict:
    away = np.ptp(transient(bench, "cyclic").bias[:3], axis=0).max()
    return judged(away < 50, f"mean estimates of 0, 25 and 50 % within {away:.0f} at every step, true state 1000")


@STATED.of(
    {29: TRANSIENT},
    "In general the RMS error increases with connectivity (so says the text).",
    "larger at 100 % than at 0 % at the last step",
)
def _general_increase(sweep: Sweep) -> Verdict:
    last = sweep.rms()[:, -1]
    ours = f"{listed(last)} at k={sweep.bench.steps}, 0 to 100 %; the thesis' own figure 32 falls beyond 25 % too"
    return judged(last[-1] > last[0], ours)


@STATED.of(
    {29: TRANSIENT},
    "The RMS error is greater at 25 % than at 0 %.",
    f"averaged over steps 2–5: {INITIAL_ERROR}",
)
def _worse_at_25(sweep: Sweep) -> Verdict:
    rms = sweep.rms()[:, 1:]
    ours = f"at 0 % {listed(rms[0])}; at 25 % {listed(rms[1])} (k=2–{sweep.bench.steps})"
    return explained(rms[1].mean() > rms[0].mean(), _falls_without_error(sweep), f"{ours}; {CAUSE}")


@STATED.about([31], "0, 25 and 50 % have RMS errors of like size at each step.", "within 25 %")
def _cyclic_similar(bench: Bench) -> Verdict:
    rms = transient(bench, "cyclic").rms()[:3]
    away = 100 * (rms.max(axis=0) / rms.min(axis=0) - 1)
    return judged(away.max() < 25, f"0, 25 and 50 % lie within {listed(away, 2)} % at k=1–{bench.steps}")


@STATED.of(
    {32: TRANSIENT},
    "The averaged RMS error first rises from 0 to 25 % ({network}).",
    INITIAL_ERROR,
    next_figure=0,
)
def _rises(sweep: Sweep) -> Verdict:
    with_, without = (sweep.averaged(initial_error=e) for e in (True, False))
    ours = f"{listed(with_)}; without the common initial error of −1000: {listed(without)}"
    return explained(with_[1] > with_[0], _falls_without_error(sweep), ours)


@STATED.about([32], "It is greatest at 25 % in ad hoc and broadcast networks.", INITIAL_ERROR)
def _greatest_at_25(bench: Bench) -> Verdict:
    sweeps = [transient(bench, a) for a in LIKE_NETWORKS]
    ad_hoc, broadcast = (change(sweep.averaged()) for sweep in sweeps)
    ours = f"change against 0 %: ad hoc {listed(ad_hoc, 3)}; broadcast {listed(broadcast, 3)} (per cent)"
    seen = ad_hoc.argmax() == broadcast.argmax() == 1
    return explained(seen, all(map(_falls_without_error, sweeps)), f"{ours}; {CAUSE}")


@STATED.about([32], "Ad hoc and broadcast networks show nearly the same.", "within 2 %")
def _identical(bench: Bench) -> Verdict:
    ad_hoc, broadcast = (transient(bench, a).averaged() for a in LIKE_NETWORKS)
    away = 100 * np.abs(ad_hoc / broadcast - 1).max()
    return judged(away < 2, f"they differ by at most {away:.2g} %")


@STATED.about([32], "In a cyclic network 50 % is still worse than 0 %.", INITIAL_ERROR)
def _cyclic_at_half(bench: Bench) -> Verdict:
    cyclic = transient(bench, "cyclic")
    found = cyclic.averaged()
    ours = f"{found[2]:.1f} at 50 %, {found[0]:.1f} at 0 %; {CAUSE}"
    return explained(found[2] > found[0], _falls_without_error(cyclic), ours)


@STATED.of(
    {32: TRANSIENT},
    "Beyond 25 % it improves at an increasing rate ({network}).",
    "each fall is greater than the last",
    next_figure=0,
)
def _faster_and_faster(sweep: Sweep) -> Verdict:
    falls = -np.diff(sweep.averaged()[1:])
    return judged((np.diff(falls) > 0).all() and falls[0] > 0, f"falls by {listed(falls)} from 25 to 50, 75, 100 %")


@STATED.of(
    {33: TRANSIENT},
    "The peak is at or near 25 % ({network}).",
    f"largest of five levels there: {INITIAL_ERROR}",
    ("cyclic",),
    at=0.25,
)
@STATED.of(
    {33: TRANSIENT},
    "The peak is at or near 12.5 % ({network}).",
    f"largest of five levels there: {INITIAL_ERROR}",
    LIKE_NETWORKS,
    next_figure=0,
    at=0.125,
)
def _peak(sweep: Sweep, at: float) -> Verdict:
    fine = sweep._replace(links=FINE)
    found = fine.averaged()
    ours = f"{listed(found)} at {', '.join(map(percent, FINE))}; {CAUSE}"
    return explained(FINE[found.argmax()] == at, _falls_without_error(fine), ours)


@STATED.about(
    [32, 33],
    "The rise comes from a covariance that is too optimistic when a step without messages follows one with.",
    "there is a rise without the common initial error too",
)
def _optimism(bench: Bench) -> Verdict:
    sweeps = [transient(bench, a) for a in ARCHITECTURES]
    above = [100 * (s.rms(initial_error=False) ** 2 / s.claimed - 1).max() for s in sweeps]
    ours = (
        "the smaller gain hurts because the initial error is common to all and not in the covariance; without it the "
        "error falls steadily, although the covariance is as optimistic as before: actual at most "
    )
    ours += ", ".join(f"{v:.1f} % ({s.network})" for v, s in zip(above, sweeps, strict=True)) + " above claimed"
    return judged(not all(map(_falls_without_error, sweeps)), ours)


def rise(sweep: Sweep, q: float, *, initial_error: bool = True) -> float:
    """Return how far the time-averaged RMS error rises above that at 0 %, in per cent, over eighths of connectivity."""
    other = sweep._replace(case=ThesisCase("transient", q), links=EIGHTHS)
    return float(change(other.averaged(initial_error=initial_error)).max())


@STATED.of(
    {34: TRANSIENT},
    "More process noise relative to measurement noise increases the errors at low connectivity.",
    "the rise above 0 % grows with Q/R",
    ("broadcast", "cyclic"),
)
def _grows_with_process_noise(sweep: Sweep) -> Verdict:
    found, without = ([rise(sweep, q, initial_error=e) for _, q in RATIOS] for e in (True, False))
    ours = f"rise above 0 %: {listed(found, 3)} % at Q/R = {', '.join(name for name, _ in RATIOS)}; without the initial"
    ours += f" error {listed(without, 3)} %.  It shrinks here: a larger gain forgets the initial error sooner"
    return judged((np.diff(found) > 0).all(), ours, "open")


@STATED.about(
    [34, 35],
    "At low ratios of process to measurement noise the error falls steadily with connectivity.",
    "no rise at the lowest ratio",
)
def _low_ratio_falls(bench: Bench) -> Verdict:
    name, q = RATIOS[0]
    found = {a: rise(transient(bench, a), q) for a in ("broadcast", "cyclic")}
    ours = "; ".join(f"{a} rises by {value:.1f} %" for a, value in found.items())
    return judged(max(found.values()) <= 0, f"at Q/R = {name} {ours}", "open")
