"""Statements about claimed covariances: figures 19–25 and 36–41."""

from __future__ import annotations

import numpy as np

from stochfuse.kalman.kernel import Estimate, predict, update
from stochfuse.scenario.model import Sensor
from stochfuse.scenario.scenario import Scenario
from stochfuse.thesis.bench import LINKS, STEADY, TRANSIENT, Bench, Sweep, ThesisCase
from stochfuse.thesis.statements import Stated, Verdict, judged, listed

STATED = Stated()
RUNS = 1000
OVER_TIME = {20: TRANSIENT, 36: STEADY}
"""First figures of covariance over time."""
NORMALISED = {23: TRANSIENT}


def full_rate(scenario: Scenario, everyone: int) -> np.ndarray:
    """Claimed variance over the steps of a scalar filter with every agent's measurement, (28)–(31); or of one agent's.

    Parameters
    ----------
    everyone : number of agents whose data each has.
    """
    model, sensor = scenario.model, Sensor(scenario.sensors[0].H, scenario.sensors[0].R / everyone)
    P, out = scenario.P0 / everyone, []
    for step in range(scenario.network.steps):
        if step:
            P = update(predict(Estimate(None, P), model.F, model.Q, model.Bu), sensor.H, sensor.R).P
        out.append(P.item())
    return np.array(out)


def full_rate_cyclic(scenario: Scenario) -> np.ndarray:
    """Claimed variance of like scalar agents that each hear the next one in every step, (32)–(38)."""
    Q, R, P0 = scenario.model.Q.item(), scenario.sensors[0].R.item(), scenario.P0.item()

    def later(Y: float) -> float:
        return 1.0 / (1.0 / Y + Q)

    local, fused = [1.0 / P0], [2.0 / P0]
    for k in range(1, scenario.network.steps):
        local.append(later(fused[-1]) + 1.0 / R)
        common = local[k - 1]
        if k > 1:
            common += later(local[k - 2])
        if k > 2:
            common -= later(later(fused[k - 3]))
        fused.append(2.0 * local[k] - later(common))
    return 1.0 / np.array(fused)


@STATED.about(
    [19],
    "In a single run the covariance stays between those of no and of full connectivity.",
    "no outcome of 0 < µ < 1 lies outside",
)
def _single_runs(bench: Bench) -> Verdict:
    P = bench.claimed(TRANSIENT, "ad-hoc")
    found = np.array([step.extremes for step in bench.averages(TRANSIENT, "ad-hoc", errors=False)])
    inside = (found[:, 0] >= P[-1] * (1 - 1e-12)) & (found[:, 1] <= P[0] * (1 + 1e-12))
    sample = bench.sample(TRANSIENT, "ad-hoc", LINKS[1:-1], RUNS)
    below = 100 * (sample < P[-1] * (1 - 1e-12)).any(axis=2).mean(axis=1)
    ours = f"over all outcomes {_ranges(found)} against {_ranges(np.stack([P[-1], P[0]], axis=1))} at k=1–{bench.steps}"
    ours += f"; {listed(below, 3)} % of {RUNS} sampled runs at 25, 50, 75 % fall below full connectivity at some step: "
    ours += "the Local Fusion Graph is then overconfident"
    return judged(inside.all(), ours)


def _ranges(pairs: np.ndarray) -> str:
    return ", ".join(f"{low:.4g}–{high:.4g}" for low, high in pairs)


@STATED.about(
    [19],
    "In single runs the covariance can rise again where a step brings no message.",
    "it rises in some step of some of 1000 sampled runs",
)
def _rising_runs(bench: Bench) -> Verdict:
    P = bench.sample(TRANSIENT, "ad-hoc", [0.25, 0.75], RUNS)
    share = 100 * (np.diff(P, axis=2) > 0).any(axis=2).mean(axis=1)
    return judged((share > 0).all(), f"in {share[0]:.0f} % of {RUNS} runs at 25 %, {share[1]:.0f} % at 75 %")


@STATED.of(
    OVER_TIME,
    "At 0 % and 100 % the Local Fusion Graph gives what the known algorithms give.",
    "equal to the filter with one agent's data, and to (28)–(38), within rounding",
)
def _known_algorithms(sweep: Sweep) -> Verdict:
    P, scenario = sweep.claimed, sweep.scenario
    everyone = scenario.network.agents
    full = full_rate_cyclic(scenario) if sweep.architecture == "cyclic" else full_rate(scenario, everyone)
    away = max(np.abs(P[0] / full_rate(scenario, 1) - 1).max(), np.abs(P[-1] / full - 1).max())
    return judged(away < 1e-9, f"largest relative difference {away:.0e}")


@STATED.of(OVER_TIME, "Higher connectivity gives a smaller average covariance.", "falls at every step")
def _falls_with_links(sweep: Sweep) -> Verdict:
    P = sweep.claimed
    return judged((np.diff(P, axis=0) < 0).all(), f"last step: {listed(P[:, -1])} at 0, 25, 50, 75, 100 %")


def share_at_half(P: np.ndarray) -> np.ndarray:
    """Share, per step, of the reduction from 0 to 100 % connectivity that is had at 50 %, in per cent."""
    return 100 * (P[0] - P[2]) / (P[0] - P[-1])


@STATED.of(
    OVER_TIME,
    "The gains are not linear in connectivity.",
    "more than half of the reduction is had at 50 % (cyclic: from step 2 on)",
)
def _non_linear(sweep: Sweep) -> Verdict:
    share = share_at_half(sweep.claimed)
    later = share[1:] if sweep.architecture == "cyclic" else share
    return judged((later > 50 + 1e-7).all(), f"share at 50 %: {listed(share, 3)} % at k=1–{sweep.bench.steps}")


def bend(P: np.ndarray) -> np.ndarray:
    """How far a step's curve over connectivity lies from a straight line, in units of its whole fall, (steps,)."""
    line = P[0] + np.asarray(LINKS)[:, None] * (P[-1] - P[0])
    return np.abs(P - line).max(axis=0) / (P[0] - P[-1])


@STATED.of(
    NORMALISED,
    "The bend of the curve is slight at first and grows with time.",
    "distance from a straight line smallest at step 1",
)
def _bend_grows(sweep: Sweep) -> Verdict:
    found = bend(sweep.claimed)
    return judged(found[0] == found.min() and found[-1] > found[0], f"at k=1–{sweep.bench.steps}: {listed(found, 3)}")


@STATED.of(
    {36: STEADY},
    "In steady state the covariance changes little with time.",
    "by less than 10 % from step 2 to the last, and less than in the transient",
)
def _little_change(sweep: Sweep) -> Verdict:
    steady, transient = sweep.claimed, sweep._replace(case=TRANSIENT).claimed
    moves = [np.abs(P[:, -1] / P[:, 1] - 1).max() for P in (steady, transient)]
    from_first = np.abs(steady[:, -1] / steady[:, 0] - 1).max()
    ours = f"from k=2 to k={sweep.bench.steps} by at most {100 * moves[0]:.0f} % (transient {100 * moves[1]:.0f} %)"
    return judged(moves[0] < 0.1 and moves[0] < moves[1], f"{ours}, from k=1 {100 * from_first:.0f} %")


@STATED.about(
    [36, 37],
    "Ad hoc and broadcast networks show nearly the same in steady state too.",
    "covariances within 2 %",
    case=STEADY,
)
@STATED.about([23, 24], "Ad hoc and broadcast networks show nearly the same.", "covariances within 2 %", case=TRANSIENT)
def _same_by_network(bench: Bench, case: ThesisCase) -> Verdict:
    away = 100 * np.abs(bench.claimed(case, "ad-hoc") / bench.claimed(case, "broadcast") - 1).max()
    return judged(away < 2, f"they differ by at most {away:.2g} %")


@STATED.about(
    [25],
    "In a cyclic network the change from step 1 to 2 is much more pronounced.",
    "1.5 times that of an ad hoc network",
)
def _cyclic_first_change(bench: Bench) -> Verdict:
    first = {}
    for a in ("cyclic", "ad-hoc"):
        P = bench.claimed(TRANSIENT, a)
        first[a] = np.abs(np.diff((P / P[0])[:, :2], axis=1)).max()
    ours = f"largest change of the relative covariance {first['cyclic']:.3f}, ad hoc {first['ad-hoc']:.3f}"
    return judged(first["cyclic"] > 1.5 * first["ad-hoc"], ours)


@STATED.about([25], "In a cyclic network the curves are nearer to linear.", "at every step")
def _cyclic_linear(bench: Bench) -> Verdict:
    cyclic, ad_hoc = (bend(bench.claimed(TRANSIENT, a)) for a in ("cyclic", "ad-hoc"))
    ours = f"distance from a straight line {listed(cyclic, 3)}; ad hoc {listed(ad_hoc, 3)}"
    return judged((cyclic < ad_hoc).all(), ours)


@STATED.of(NORMALISED, "The curves converge with time.", "each change between steps is less than the last")
def _converges(sweep: Sweep) -> Verdict:
    P = sweep.claimed
    steps = np.abs(np.diff(P / P[0], axis=1)).max(axis=0)
    return judged((np.diff(steps) < 0).all(), f"largest change from step to step: {listed(steps, 3)}")


@STATED.of(NORMALISED, "Connectivity matters most at early steps.", "largest reduction at step 1")
def _most_at_first(sweep: Sweep) -> Verdict:
    P = sweep.claimed
    gain = 1 - P[-1] / P[0]
    return judged(gain.argmax() == 0, f"100 % reduces by {listed(100 * gain, 3)} % at k=1–{sweep.bench.steps}")


@STATED.of(
    NORMALISED,
    "About 70 % of the reduction is had by going from 0 to 50 %, 30 % by going on to 100 %.",
    "67–73 % averaged over the steps",
    ("ad-hoc", "broadcast"),
)
def _seventy(sweep: Sweep) -> Verdict:
    share = share_at_half(sweep.claimed)
    ours = f"{listed(share, 3)} % at k=1–{sweep.bench.steps}, on average {share.mean():.1f} %"
    return judged(abs(share.mean() - 70) <= 3, ours)


@STATED.of({39: STEADY}, "But for the first step, the curves of all steps are very alike.", "within 0.08")
def _similar_later(sweep: Sweep) -> Verdict:
    P = sweep.claimed
    away = np.ptp((P / P[0])[:, 1:], axis=1).max()
    return judged(away < 0.08, f"from k=2 on they lie within {away:.3f} of each other")


@STATED.of({39: STEADY}, "The last step shows the same reductions as in the transient.", "within 0.01", also=23)
def _same_in_the_end(sweep: Sweep) -> Verdict:
    steady, transient = sweep.claimed[:, -1], sweep._replace(case=TRANSIENT).claimed[:, -1]
    away = np.abs(steady / steady[0] - transient / transient[0]).max()
    return judged(away < 0.01, f"at k={sweep.bench.steps} the curves differ by at most {away:.4f}")
