"""Statements that compare methods: naive fusion and the simplified formulation beside the Local Fusion Graph.

Figures 56–58, 61, 62, 65–69, 71 and 72; where single records decide, see `stochfuse.thesis.about_records`.
"""

from __future__ import annotations

import numpy as np

from stochfuse.scenario.registry import NAIVE, SIMPLIFIED
from stochfuse.thesis.bench import LINKS, STEADY, TRANSIENT, Bench, Sweep
from stochfuse.thesis.figures import covariance_difference, percent, relative_error
from stochfuse.thesis.statements import Stated, Verdict, judged, listed

STATED = Stated()
AD_HOC = ("ad-hoc",)
NAIVE_FIGURES = {56: TRANSIENT, 58: STEADY}
SIMPLIFIED_FIGURES = {65: TRANSIENT, 66: STEADY}


@STATED.of(
    NAIVE_FIGURES,
    "Naive fusion claims more at full connectivity than the known solution does.",
    "smaller from step 2 on",
    AD_HOC,
)
def _naive_below(sweep: Sweep) -> Verdict:
    naive, best = sweep.by(NAIVE).claimed[-1], sweep.claimed[-1]
    return judged((naive[1:] < best[1:]).all(), f"naive {listed(naive)} against {listed(best)} at 100 %")


@STATED.of(
    NAIVE_FIGURES,
    "The naive covariance falls in the same way with connectivity, but faster.",
    "falls, and lies below the Local Fusion Graph's from step 2 on",
    AD_HOC,
)
def _naive_shape(sweep: Sweep) -> Verdict:
    naive, best = sweep.by(NAIVE).claimed, sweep.claimed
    falls = (np.diff(naive, axis=0) < 0).all() and (naive[1:, 1:] < best[1:, 1:]).all()
    return judged(falls, f"last step: naive {listed(naive[:, -1])}, Local Fusion Graph {listed(best[:, -1])}")


def _relative(sweep: Sweep) -> np.ndarray:
    """Distance of the simplified claimed covariance from the exact one, relative to that, (links, steps)."""
    return np.abs(sweep.by(SIMPLIFIED).claimed / sweep.claimed - 1)


@STATED.of(SIMPLIFIED_FIGURES, "At step 1 both methods agree exactly.", "within rounding", AD_HOC)
def _equal_first(sweep: Sweep) -> Verdict:
    away = _relative(sweep)[:, 0].max()
    return judged(away < 1e-9, f"largest relative difference at k=1 {away:.0e}")


@STATED.of(
    SIMPLIFIED_FIGURES,
    "Their difference grows in the first steps and then shrinks, except at 25 %.",
    "at 50 and 75 % the last difference is below the largest",
    AD_HOC,
)
def _converge_but_25(sweep: Sweep) -> Verdict:
    away = 100 * _relative(sweep)[1:4]
    peak, last = away.max(axis=1), away[:, -1]
    levels = ((25, 50, 75), peak, last)
    ours = "; ".join(f"{level} % {most:.2f}, {at_last:.2f}" for level, most, at_last in zip(*levels, strict=True))
    holds = (last < peak)[1:].all() and away[:, 1].min() > 0
    return judged(holds, f"largest and last difference: {ours} (per cent)")


@STATED.about(
    [67],
    "The simplified covariance is more accurate at high connectivity.",
    "relative difference averaged over time falls from 25 to 75 %",
)
def _better_when_connected(bench: Bench) -> Verdict:
    found = {case.name: _relative(Sweep(bench, case)).mean(axis=1)[1:4] for case in (TRANSIENT, STEADY)}
    ours = "; ".join(f"{name} {listed(100 * away, 3)} %" for name, away in found.items())
    holds = all((np.diff(away) < 0).all() for away in found.values())
    return judged(holds, f"mean difference at 25, 50, 75 %: {ours}")


@STATED.about([68], "The covariances differ most at 25 %.", "largest at 25 %")
def _most_at_25(bench: Bench) -> Verdict:
    found = {case.name: covariance_difference(Sweep(bench, case)) for case in (TRANSIENT, STEADY)}
    ours = "; ".join(f"{name} {listed(away, 3)}" for name, away in found.items())
    return judged(all(np.abs(away).argmax() == 1 for away in found.values()), ours)


@STATED.about([57], "Naive state estimates get worse with connectivity.", "at the last step, at every level")
def _naive_states(bench: Bench) -> Verdict:
    bias = np.abs(Sweep(bench, TRANSIENT, rule=NAIVE).bias[:, -1])
    return judged((np.diff(bias) > 0).all(), f"mean error at k={bench.steps}: {listed(bias)} at 0 to 100 %")


@STATED.about([61], "The naive RMS error grows with message size.", "at every level")
def _naive_grows(bench: Bench) -> Verdict:
    sweep = Sweep(bench, TRANSIENT, rule=NAIVE)
    found = sweep.averaged()
    return judged((np.diff(found) > 0).all(), f"RMS error {listed(found)} at {listed(sweep.size())} nodes (ad hoc)")


BEST_OF_NAIVE = "The Local Fusion Graph's RMS error is well below that of any naive estimate."


@STATED.of({61: TRANSIENT}, BEST_OF_NAIVE, "below at every level from 25 % on", AD_HOC)
def best_of_naive(sweep: Sweep) -> Verdict:
    """Compare the two rules."""
    here, naive = sweep.averaged()[1:], sweep.by(NAIVE).averaged()[1:]
    ours = f"Local Fusion Graph {listed(here)}; naive {listed(naive)} at 25 to 100 % (ad hoc)"
    return judged((here < naive).all(), ours)


@STATED.of(
    {69: TRANSIENT},
    "The simplified state estimates are close at each step.",
    "mean estimates within a quarter of the RMS error",
    AD_HOC,
)
def _close_states(sweep: Sweep) -> Verdict:
    away, rms = np.abs(sweep.by(SIMPLIFIED).bias - sweep.bias), sweep.rms()
    link, step = np.unravel_index(away.argmax(), away.shape)
    ours = f"mean estimates differ by at most {away.max():.1f} (at {percent(LINKS[link])}, k={step + 1}), by "
    ours += f"{100 * (away / rms).max():.0f} % of the RMS error"
    return judged((away < rms / 4).all(), ours)


@STATED.of(
    {71: TRANSIENT},
    "At 25 % the Local Fusion Graph's RMS error rises and the simplified one falls (transient).",
    "relative to 0 %, averaged over noise",
    AD_HOC,
)
def _opposite_trends(sweep: Sweep) -> Verdict:
    here, simplified = relative_error(sweep)[1], relative_error(sweep.by(SIMPLIFIED))[1]
    ours = f"at 25 %, relative to 0 %: Local Fusion Graph {here:.3f}, simplified {simplified:.3f}"
    return judged(here > 1 and simplified < 1, ours)


MOST_AT_LOW = "The RMS errors of the two methods differ most at low connectivity"


@STATED.of({72: STEADY}, f"{MOST_AT_LOW} (steady state).", "largest at 25 %", AD_HOC)
@STATED.of({72: TRANSIENT}, f"{MOST_AT_LOW} (transient).", "largest at 25 %", AD_HOC)
def _largest_at_25(sweep: Sweep) -> Verdict:
    away = np.abs(relative_error(sweep.by(SIMPLIFIED)) - relative_error(sweep))
    return judged(away.argmax() == 1, f"{listed(away, 3)} at 0 to 100 %")
