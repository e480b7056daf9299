"""Statements about state estimates and RMS errors in the transient scenario: figures 26–35, 57, 61, 69, 71 and 72."""

from __future__ import annotations

from functools import partial

import numpy as np

from stochfuse.kalman.kernel import Estimate, predict, update
from stochfuse.scenario.registry import LFG
from stochfuse.thesis import bench as records
from stochfuse.thesis.bench import ARCHITECTURES, LINKS, TRANSIENT, Bench, ThesisCase, noise_order
from stochfuse.thesis.figures import RATIOS, averaged_errors, change, percent
from stochfuse.thesis.statements import Statement, Verdict, explained, figures, judged, listed

FINE = (0.0, 0.125, 0.25, 0.375, 0.5)
EIGHTHS = tuple(i / 8 for i in range(9))
CAUSE = "without the common initial error it falls steadily"


def averaged(
    bench: Bench,
    architecture: str,
    links=LINKS,
    case: ThesisCase = TRANSIENT,
    rule: str = LFG,
    *,
    initial_error: bool = True,
) -> np.ndarray:
    """Return the time-averaged RMS error, averaged over links and noise, (links,)."""
    weights = bench.weights(case, architecture, links, rule)
    return averaged_errors(bench, weights, case, architecture, initial_error=initial_error)


def filtered(bench: Bench, everyone: int, drawn: np.ndarray) -> np.ndarray:
    """Error of a scalar Kalman filter on some records, (records, steps): with everyone's data, or of agent 1 alone."""
    scenario = bench.scenario(TRANSIENT, "ad-hoc")
    model, sensor, n = scenario.model, scenario.sensors[0], scenario.network.agents
    bias = 0.0 if scenario.error is None else scenario.error.item()
    error = np.sqrt(scenario.P0.item()) * drawn[:, :everyone].mean(axis=1) + bias * drawn[:, -1]
    P, out = scenario.P0 / everyone, [error]
    for step in range(1, bench.steps):
        place = n + (step - 1) * (n + 1)
        noise = np.sqrt(sensor.R.item()) * drawn[:, place + 1 : place + 1 + everyone].mean(axis=1)
        x = (error - np.sqrt(model.Q.item()) * drawn[:, place])[:, None, None]
        prior = predict(Estimate(x, P[None]), model.F, model.Q, 0 * model.Bu)
        found = update(prior, sensor.H, sensor.R / everyone, noise[:, None, None])
        error, P = found.x[:, 0, 0], found.P[0]
        out.append(error)
    return np.stack(out, axis=1)


def _known_estimates(bench: Bench, architecture: str) -> Verdict:
    scenario = bench.scenario(TRANSIENT, architecture)
    drawn, n = records.draw(scenario, 5, bench.seed), scenario.network.agents
    given = bench.weights(TRANSIENT, architecture).mean_given(drawn)
    turns = [noise_order(np.roll(np.arange(n), i).tolist(), bench.steps) for i in range(n)]
    alone = [filtered(bench, 1, drawn[:, turn]) for turn in turns]
    away = max(
        np.abs(given[:, 0] - np.mean(alone, axis=0)).max(), np.abs(given[:, -1] - filtered(bench, n, drawn)).max()
    )
    return judged(away < 1e-6, f"largest difference over 5 records {away:.0e}")


def _worse_at_some_step(bench: Bench, architecture: str) -> Verdict:
    bias = np.abs(bench.weights(TRANSIENT, architecture).first[:2, :, -1])
    worse = np.flatnonzero(bias[1] > bias[0]) + 1
    ours = f"mean error at 0 % {listed(bias[0])}; at 25 % {listed(bias[1])} (k=1–{bench.steps})"
    return explained(len(worse) > 0, _falls_without_error(bench, architecture), f"{ours}; {CAUSE}")


def _falls_without_error(bench: Bench, architecture: str, links=LINKS) -> bool:
    return bool((np.diff(averaged(bench, architecture, links, initial_error=False)) < 0).all())


def _cyclic_states(bench: Bench) -> Verdict:
    bias = bench.weights(TRANSIENT, "cyclic").first[:3, :, -1]
    away = (bias.max(axis=0) - bias.min(axis=0)).max()
    return judged(away < 50, f"mean estimates of 0, 25 and 50 % within {away:.0f} at every step, true state 1000")


def rms_by_step(bench: Bench, architecture: str) -> np.ndarray:
    """Return the transient RMS error, averaged over links and noise, (links, steps)."""
    return bench.weights(TRANSIENT, architecture).rms(records.spread(bench.scenario(TRANSIENT, architecture)))


def _worse_at_25(bench: Bench, architecture: str) -> Verdict:
    rms = rms_by_step(bench, architecture)
    seen = rms[1, 1:].mean() > rms[0, 1:].mean()
    ours = f"at 0 % {listed(rms[0, 1:])}; at 25 % {listed(rms[1, 1:])} (k=2–{bench.steps})"
    return explained(seen, _falls_without_error(bench, architecture), f"{ours}; {CAUSE}")


def _cyclic_similar(bench: Bench) -> Verdict:
    rms = rms_by_step(bench, "cyclic")[:3]
    away = 100 * (rms.max(axis=0) / rms.min(axis=0) - 1)
    return judged(away.max() < 25, f"0, 25 and 50 % lie within {listed(away, 2)} % at k=1–{bench.steps}")


def _general_increase(bench: Bench, architecture: str) -> Verdict:
    last = rms_by_step(bench, architecture)[:, -1]
    ours = f"{listed(last)} at k={bench.steps}, 0 to 100 %; the thesis' own figure 32 falls beyond 25 % too"
    return judged(last[-1] > last[0], ours)


def _rises(bench: Bench, architecture: str) -> Verdict:
    with_, without = (averaged(bench, architecture, initial_error=e) for e in (True, False))
    ours = f"{listed(with_)}; without the common initial error of −1000: {listed(without)}"
    return explained(with_[1] > with_[0], _falls_without_error(bench, architecture), ours)


def _greatest_at_25(bench: Bench) -> Verdict:
    found = [change(averaged(bench, a)) for a in ARCHITECTURES[:2]]
    ours = f"change against 0 %: ad hoc {listed(found[0], 3)}; broadcast {listed(found[1], 3)} (per cent)"
    cause = all(_falls_without_error(bench, a) for a in ARCHITECTURES[:2])
    return explained(all(c.argmax() == 1 for c in found), cause, f"{ours}; {CAUSE}")


def _identical(bench: Bench) -> Verdict:
    away = 100 * np.abs(averaged(bench, "ad-hoc") / averaged(bench, "broadcast") - 1).max()
    return judged(away < 2, f"they differ by at most {away:.2g} %")


def _cyclic_at_half(bench: Bench) -> Verdict:
    found = averaged(bench, "cyclic")
    ours = f"{found[2]:.1f} at 50 %, {found[0]:.1f} at 0 %; {CAUSE}"
    return explained(found[2] > found[0], _falls_without_error(bench, "cyclic"), ours)


def _faster_and_faster(bench: Bench, architecture: str) -> Verdict:
    falls = -np.diff(averaged(bench, architecture)[1:])
    return judged((np.diff(falls) > 0).all() and falls[0] > 0, f"falls by {listed(falls)} from 25 to 50, 75, 100 %")


def _peak(bench: Bench, architecture: str, at: float) -> Verdict:
    found = averaged(bench, architecture, FINE)
    ours = f"{listed(found)} at {', '.join(map(percent, FINE))}; {CAUSE}"
    return explained(FINE[found.argmax()] == at, _falls_without_error(bench, architecture, FINE), ours)


def _optimism(bench: Bench) -> Verdict:
    spread = records.spread(bench.scenario(TRANSIENT, "broadcast"), initial_error=False)
    found = {}
    for a in ARCHITECTURES:
        actual = bench.weights(TRANSIENT, a).rms(spread) ** 2
        found[a] = 100 * (actual / bench.claimed(TRANSIENT, a) - 1).max()
    ours = (
        "the smaller gain hurts because the initial error is common to all and not in the covariance; without it the "
    )
    ours += "error falls steadily, although the covariance is as optimistic as before: actual at most "
    ours += ", ".join(f"{v:.1f} % ({a.replace('-', ' ')})" for a, v in found.items()) + " above claimed"
    return judged(not all(_falls_without_error(bench, a) for a in ARCHITECTURES), ours)


def rise(bench: Bench, case: ThesisCase, architecture: str) -> float:
    """Return how far the time-averaged RMS error rises above that at 0 %, in per cent, over eighths of connectivity."""
    return float(change(averaged(bench, architecture, EIGHTHS, case)).max())


def _grows_with_process_noise(bench: Bench, architecture: str) -> Verdict:
    found = [rise(bench, ThesisCase("transient", q=q), architecture) for _, q in RATIOS]
    without = [
        change(averaged(bench, architecture, EIGHTHS, ThesisCase("transient", q=q), initial_error=False)).max()
        for _, q in RATIOS
    ]
    ours = (
        f"rise above 0 %: {listed(found, 3)} % at Q/R = {', '.join(name for name, _ in RATIOS)}; without the initial "
    )
    ours += f"error {listed(without, 3)} %.  It shrinks here: a larger gain forgets the initial error sooner"
    return judged((np.diff(found) > 0).all(), ours, "open")


def _low_ratio_falls(bench: Bench) -> Verdict:
    found = {
        a: change(averaged(bench, a, EIGHTHS, ThesisCase("transient", q=RATIOS[0][1]))) for a in ("broadcast", "cyclic")
    }
    ours = "; ".join(f"{a} rises by {values.max():.1f} %" for a, values in found.items())
    return judged(all(v.max() <= 0 for v in found.values()), f"at Q/R = {RATIOS[0][0]} {ours}", "open")


_INITIAL_ERROR = "the statement holds, and RMS error falls steadily without the common initial error"

STATEMENTS: tuple[Statement, ...] = (
    *[
        Statement(
            figures(26 + i),
            "At 0 % and 100 % the state estimates are those of the known algorithms.",
            "equal to the Kalman filter on one agent's, on everyone's data",
            partial(_known_estimates, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES[:2])
    ],
    *[
        Statement(
            figures(26 + i),
            "At some steps the estimate is better at 0 % than at 25 %.",
            _INITIAL_ERROR,
            partial(_worse_at_some_step, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES[:2])
    ],
    Statement(figures(28), "0, 25 and 50 % give about the same estimates.", "within 5 % of the state", _cyclic_states),
    *[
        Statement(
            figures(29 + i),
            "In general the RMS error increases with connectivity (so says the text).",
            "larger at 100 % than at 0 % at the last step",
            partial(_general_increase, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    *[
        Statement(
            figures(29 + i),
            "The RMS error is greater at 25 % than at 0 %.",
            f"averaged over steps 2–5: {_INITIAL_ERROR}",
            partial(_worse_at_25, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    Statement(figures(31), "0, 25 and 50 % have RMS errors of like size at each step.", "within 25 %", _cyclic_similar),
    *[
        Statement(
            figures(32),
            f"The averaged RMS error first rises from 0 to 25 % ({a.replace('-', ' ')}).",
            _INITIAL_ERROR,
            partial(_rises, architecture=a),
        )
        for a in ARCHITECTURES
    ],
    Statement(figures(32), "It is greatest at 25 % in ad hoc and broadcast networks.", _INITIAL_ERROR, _greatest_at_25),
    Statement(figures(32), "Ad hoc and broadcast networks show nearly the same.", "within 2 %", _identical),
    Statement(figures(32), "In a cyclic network 50 % is still worse than 0 %.", _INITIAL_ERROR, _cyclic_at_half),
    *[
        Statement(
            figures(32),
            f"Beyond 25 % it improves at an increasing rate ({a.replace('-', ' ')}).",
            "each fall is greater than the last",
            partial(_faster_and_faster, architecture=a),
        )
        for a in ARCHITECTURES
    ],
    *[
        Statement(
            figures(33),
            f"The peak is at or near {percent(at)} ({a.replace('-', ' ')}).",
            f"largest of five levels there: {_INITIAL_ERROR}",
            partial(_peak, architecture=a, at=at),
        )
        for a, at in zip(ARCHITECTURES, (0.125, 0.125, 0.25), strict=True)
    ],
    Statement(
        figures(32, 33),
        "The rise comes from a covariance that is too optimistic when a step without messages follows one with.",
        "there is a rise without the common initial error too",
        _optimism,
    ),
    *[
        Statement(
            figures(number),
            "More process noise relative to measurement noise increases the errors at low connectivity.",
            "the rise above 0 % grows with Q/R",
            partial(_grows_with_process_noise, architecture=a),
        )
        for number, a in ((34, "broadcast"), (35, "cyclic"))
    ],
    Statement(
        figures(34, 35),
        "At low ratios of process to measurement noise the error falls steadily with connectivity.",
        "no rise at the lowest ratio",
        _low_ratio_falls,
    ),
)
