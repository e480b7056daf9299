"""Statements that compare methods: naive fusion and the simplified formulation beside the Local Fusion Graph.

Figures 56–58, 61, 62, 65–69, 71 and 72; where single records decide, see `stochfuse.thesis.about_records`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis.about_errors import averaged, rms_by_step
from stochfuse.thesis.bench import LINKS, STEADY, TRANSIENT, Bench, ThesisCase
from stochfuse.thesis.figures import covariance_difference, mean_size, percent, relative_errors
from stochfuse.thesis.statements import Statement, Verdict, figures, judged, listed


def _naive_below(bench: Bench, case: ThesisCase) -> Verdict:
    naive, best = bench.claimed(case, "ad-hoc", rule=NAIVE)[-1], bench.claimed(case, "ad-hoc")[-1]
    return judged((naive[1:] < best[1:]).all(), f"naive {listed(naive)} against {listed(best)} at 100 %")


def _naive_shape(bench: Bench, case: ThesisCase) -> Verdict:
    naive, best = bench.claimed(case, "ad-hoc", rule=NAIVE), bench.claimed(case, "ad-hoc")
    falls = (np.diff(naive, axis=0) < 0).all() and (naive[1:, 1:] < best[1:, 1:]).all()
    return judged(falls, f"last step: naive {listed(naive[:, -1])}, Local Fusion Graph {listed(best[:, -1])}")


def _equal_first(bench: Bench, case: ThesisCase) -> Verdict:
    away = np.abs(_relative(bench, case)[:, 0]).max()
    return judged(away < 1e-9, f"largest relative difference at k=1 {away:.0e}")


def _relative(bench: Bench, case: ThesisCase) -> np.ndarray:
    """Simplified less exact claimed covariance, relative to the exact one, (links, steps)."""
    return bench.claimed(case, "ad-hoc", rule=SIMPLIFIED) / bench.claimed(case, "ad-hoc", rule=LFG) - 1


def _converge_but_25(bench: Bench, case: ThesisCase) -> Verdict:
    away = 100 * np.abs(_relative(bench, case))[1:4]
    peak, last = away.max(axis=1), away[:, -1]
    ours = f"largest and last difference: 25 % {peak[0]:.2f}, {last[0]:.2f}; 50 % {peak[1]:.2f}, {last[1]:.2f}; 75 % "
    ours += f"{peak[2]:.2f}, {last[2]:.2f} (per cent)"
    return judged((last < peak)[1:].all() and away[:, 1].min() > 0, ours)


def _better_when_connected(bench: Bench) -> Verdict:
    found = [np.abs(_relative(bench, case)).mean(axis=1)[1:4] for case in (TRANSIENT, STEADY)]
    ours = "; ".join(f"{name} {listed(100 * d, 3)} %" for name, d in zip(("transient", "steady"), found, strict=True))
    return judged(all((np.diff(d) < 0).all() for d in found), f"mean difference at 25, 50, 75 %: {ours}")


def _most_at_25(bench: Bench) -> Verdict:
    found = [covariance_difference(bench, case) for case in (TRANSIENT, STEADY)]
    ours = "; ".join(f"{name} {listed(d, 3)}" for name, d in zip(("transient", "steady"), found, strict=True))
    return judged(all(np.abs(d).argmax() == 1 for d in found), ours)


def _naive_states(bench: Bench) -> Verdict:
    bias = np.abs(bench.weights(TRANSIENT, "ad-hoc", rule=NAIVE).first[:, -1, -1])
    return judged((np.diff(bias) > 0).all(), f"mean error at k={bench.steps}: {listed(bias)} at 0 to 100 %")


def _naive_grows(bench: Bench) -> Verdict:
    found = averaged(bench, "ad-hoc", rule=NAIVE)
    ours = f"RMS error {listed(found)} at {listed(mean_size(bench, 'ad-hoc', NAIVE))} nodes (ad hoc)"
    return judged((np.diff(found) > 0).all(), ours)


def best_of_naive(bench: Bench, case: ThesisCase) -> Verdict:
    """Compare the two rules in an ad hoc network."""
    here, naive = (averaged(bench, "ad-hoc", case=case, rule=rule) for rule in (LFG, NAIVE))
    ours = f"Local Fusion Graph {listed(here[1:])}; naive {listed(naive[1:])} at 25 to 100 % (ad hoc)"
    return judged((here[1:] < naive[1:]).all(), ours)


def _close_states(bench: Bench) -> Verdict:
    bias = [bench.weights(TRANSIENT, "ad-hoc", rule=rule).first[:, :, -1] for rule in (SIMPLIFIED, LFG)]
    away, rms = np.abs(bias[0] - bias[1]), rms_by_step(bench, "ad-hoc")
    link, step = np.unravel_index(away.argmax(), away.shape)
    ours = f"mean estimates differ by at most {away.max():.1f} (at {percent(LINKS[link])}, k={step + 1}), by "
    ours += f"{100 * (away / rms).max():.0f} % of the RMS error"
    return judged((away < rms / 4).all(), ours)


def _opposite_trends(bench: Bench) -> Verdict:
    found = relative_errors(bench, one_record=False)
    here, simplified = found["transient", LFG], found["transient", SIMPLIFIED]
    ours = f"at 25 %, relative to 0 %: Local Fusion Graph {here[1]:.3f}, simplified {simplified[1]:.3f}"
    return judged(here[1] > 1 and simplified[1] < 1, ours)


def _largest_at_25(bench: Bench, case: ThesisCase) -> Verdict:
    found = relative_errors(bench, one_record=False)
    away = np.abs(found[case.name, SIMPLIFIED] - found[case.name, LFG])
    return judged(away.argmax() == 1, f"{listed(away, 3)} at 0 to 100 %")


STATEMENTS: tuple[Statement, ...] = (
    *[
        Statement(
            figures(number),
            "Naive fusion claims more at full connectivity than the known solution does.",
            "smaller from step 2 on",
            partial(_naive_below, case=case),
        )
        for number, case in ((56, TRANSIENT), (58, STEADY))
    ],
    *[
        Statement(
            figures(number),
            "The naive covariance falls in the same way with connectivity, but faster.",
            "falls, and lies below the Local Fusion Graph's from step 2 on",
            partial(_naive_shape, case=case),
        )
        for number, case in ((56, TRANSIENT), (58, STEADY))
    ],
    *[
        Statement(
            figures(number),
            "At step 1 both methods agree exactly.",
            "within rounding",
            partial(_equal_first, case=case),
        )
        for number, case in ((65, TRANSIENT), (66, STEADY))
    ],
    *[
        Statement(
            figures(number),
            "Their difference grows in the first steps and then shrinks, except at 25 %.",
            "at 50 and 75 % the last difference is below the largest",
            partial(_converge_but_25, case=case),
        )
        for number, case in ((65, TRANSIENT), (66, STEADY))
    ],
    Statement(
        figures(67),
        "The simplified covariance is more accurate at high connectivity.",
        "relative difference averaged over time falls from 25 to 75 %",
        _better_when_connected,
    ),
    Statement(figures(68), "The covariances differ most at 25 %.", "largest at 25 %", _most_at_25),
    Statement(
        figures(57),
        "Naive state estimates get worse with connectivity.",
        "at the last step, at every level",
        _naive_states,
    ),
    Statement(figures(61), "The naive RMS error grows with message size.", "at every level", _naive_grows),
    Statement(
        figures(61),
        "The Local Fusion Graph's RMS error is well below that of any naive estimate.",
        "below at every level from 25 % on",
        partial(best_of_naive, case=TRANSIENT),
    ),
    Statement(
        figures(69),
        "The simplified state estimates are close at each step.",
        "mean estimates within a quarter of the RMS error",
        _close_states,
    ),
    Statement(
        figures(71),
        "At 25 % the Local Fusion Graph's RMS error rises and the simplified one falls (transient).",
        "relative to 0 %, averaged over noise",
        _opposite_trends,
    ),
    *[
        Statement(
            figures(72),
            f"The RMS errors of the two methods differ most at low connectivity ({name}).",
            "largest at 25 %",
            partial(_largest_at_25, case=case),
        )
        for case, name in ((TRANSIENT, "transient"), (STEADY, "steady state"))
    ],
)
