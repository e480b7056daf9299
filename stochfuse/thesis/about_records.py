"""Statements about the steady scenario, where one record decides what is seen: figures 42–48, 59, 62, 70 and 71.

The thesis draws links 1000 times over one record of truth and measurements.  What it reports there is compared with
the average over noise and with many single records, and that under three readings of what the agents' data were, see
`stochfuse.thesis.bench`.  The thesis' text does not decide between them: its assumptions for (50)–(54) name
equal initial estimates, and (53) has one local estimate for all agents, but its section 3.1 has a filter for each.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis import bench as records
from stochfuse.thesis.about_errors import averaged
from stochfuse.thesis.about_methods import best_of_naive
from stochfuse.thesis.bench import ARCHITECTURES, STEADY, Bench
from stochfuse.thesis.figures import averaged_errors, time_average
from stochfuse.thesis.statements import Statement, Verdict, figures, judged, listed

MANY = 2000
"""Records that shares are counted in."""
READINGS = {"own": "own data", "start": "one start", "all": "one start and measurement"}
"""Whose data the agents have: see `stochfuse.thesis.bench`."""


def given(bench: Bench, architecture: str, data: str, rule: str = LFG) -> np.ndarray:
    """RMS errors of many records, (records, links, steps)."""

    def make() -> np.ndarray:
        drawn = records.draw(bench.scenario(STEADY, architecture), MANY, bench.seed, data)
        return bench.weights(STEADY, architecture, rule=rule).rms_given(drawn)

    return bench.once(("given", architecture, data, rule), make)


def _averages(bench: Bench, architecture: str, rule: str = LFG) -> dict[str, np.ndarray]:
    weights = bench.weights(STEADY, architecture, rule=rule)
    return {data: averaged_errors(bench, weights, STEADY, architecture, data) for data in READINGS}


def _shares(seen: Mapping[str, Any]) -> str:
    parts = [f"{100 * np.mean(seen[data]):.1f} % ({name})" for data, name in READINGS.items()]
    return f"in {', '.join(parts)} of {MANY} single records"


def _on_average(averages: dict[str, np.ndarray]) -> str:
    return "; ".join(f"{READINGS[data]}: {listed(values)}" for data, values in averages.items())


def of_records(seen: Mapping[str, Any], averages: dict[str, np.ndarray], on_average: bool) -> Verdict:
    """Return "agrees" if the average over noise shows it, "open" if only single records do, and how many."""
    ours = f"{_shares(seen)}; averaged over noise {_on_average(averages)}"
    return judged(on_average, ours, "open" if any(s.any() for s in seen.values()) else "differs")


def _rises_at_25(bench: Bench, architecture: str) -> Verdict:
    found = {data: time_average(given(bench, architecture, data)) for data in READINGS}
    averages = _averages(bench, architecture)
    return of_records(
        {d: e[:, 1] > e[:, 0] for d, e in found.items()}, averages, averages["own"][1] > averages["own"][0]
    )


def peaks_at_25(errors: np.ndarray) -> np.ndarray:
    """Whether time-averaged errors (..., links) are greatest at 25 % and fall from there on."""
    return (errors.argmax(axis=-1) == 1) & (np.diff(errors[..., 1:], axis=-1) < 0).all(axis=-1)


def _mirrors(bench: Bench, architecture: str) -> Verdict:
    seen = {data: peaks_at_25(time_average(given(bench, architecture, data))) for data in READINGS}
    averages = _averages(bench, architecture)
    return of_records(seen, averages, bool(peaks_at_25(averages["own"])))


def _everything(bench: Bench) -> Verdict:
    seen = {}
    for data in READINGS:
        graph, naive, simplified = (
            time_average(given(bench, "ad-hoc", data, rule)) for rule in (LFG, NAIVE, SIMPLIFIED)
        )
        seen[data] = peaks_at_25(graph) & (naive[:, -1] > naive[:, 0]) & (simplified[:, 1] < simplified[:, 0])
    return judged(False, _shares(seen), "open" if any(s.any() for s in seen.values()) else "differs")


def _responds(bench: Bench, architecture: str) -> Verdict:
    scenario = bench.scenario(STEADY, architecture)
    n = scenario.network.agents
    places = [n + (step - 1) * (n + 1) for step in range(1, bench.steps)]
    first = bench.weights(STEADY, architecture).first
    follows = np.stack([1 + first[:, k, p] / np.sqrt(scenario.model.Q.item()) for k, p in enumerate(places, 1)], axis=1)
    ours = f"share of a change of the state that is followed at once: {listed(follows[:, 0], 3)} at k=2, "
    ours += f"{listed(follows[:, -1], 3)} at k={bench.steps}, 0 to 100 %"
    return judged((np.diff(follows, axis=0) > 0).all(), ours)


def _same_at_first(bench: Bench, architecture: str) -> Verdict:
    weights, scenario = bench.weights(STEADY, architecture), bench.scenario(STEADY, architecture)
    drawn = records.draw(scenario, MANY, bench.seed)
    away = np.ptp(weights.mean_given(drawn)[:, :, 0], axis=1).max()
    rms = [weights.rms(records.spread(scenario, data))[:, 0] for data in ("own", "start")]
    ours = f"averaged over the agents, within {away:.0e} in {MANY} single records.  The RMS errors differ, averaged "
    ours += f"over noise {listed(rms[0])}, unless all agents have one start: {listed(rms[1])}"
    return judged(away < 1e-9, ours)


def _first_step(bench: Bench, architecture: str) -> Verdict:
    def seen(rms: np.ndarray) -> Any:
        moves = rms[..., 1] - rms[..., 0]
        return (moves[..., 3:] < 0).all(axis=-1) & (moves[..., :3] > 0).all(axis=-1)

    weights, scenario = bench.weights(STEADY, architecture), bench.scenario(STEADY, architecture)
    rms = {data: weights.rms(records.spread(scenario, data)) for data in READINGS}
    moves = {data: values[:, 1] - values[:, 0] for data, values in rms.items()}
    found = {data: seen(given(bench, architecture, data)) for data in READINGS}
    verdict, _ = of_records(found, moves, bool(seen(rms["own"])))
    return verdict, f"{_shares(found)}; change from k=1 to k=2 averaged over noise {_on_average(moves)}"


def _not_always_better(bench: Bench, architecture: str) -> Verdict:
    worse = {d: (np.diff(given(bench, architecture, d), axis=1) > 0).any(axis=(1, 2)) for d in READINGS}
    return judged(worse["own"].mean() > 0.5, f"more connectivity is worse at some step {_shares(worse)}")


def _naive_worse(bench: Bench) -> Verdict:
    found = {data: time_average(given(bench, "ad-hoc", data, NAIVE)) for data in READINGS}
    averages = _averages(bench, "ad-hoc", NAIVE)
    seen = {data: values[:, -1] > values[:, 0] for data, values in found.items()}
    return of_records(seen, averages, bool((np.diff(averages["own"]) > 0).all()))


def _close_states(bench: Bench) -> Verdict:
    drawn = records.draw(bench.scenario(STEADY, "ad-hoc"), MANY, bench.seed)
    means = [bench.weights(STEADY, "ad-hoc", rule=rule).mean_given(drawn) for rule in (SIMPLIFIED, LFG)]
    away = np.sqrt(((means[0] - means[1]) ** 2).mean(axis=0)).max(axis=1)
    ours = f"root-mean-square difference of the mean estimates, largest step: {listed(away, 3)} at 0 to 100 %; "
    ours += f"RMS error {listed(averaged(bench, 'ad-hoc', case=STEADY))}"
    return judged((away < averaged(bench, "ad-hoc", case=STEADY) / 4).all(), ours)


def _opposite_trends(bench: Bench) -> Verdict:
    seen, averages = {}, {}
    for data in READINGS:
        graph, simplified = (time_average(given(bench, "ad-hoc", data, rule)) for rule in (LFG, SIMPLIFIED))
        seen[data] = (graph[:, 1] > graph[:, 0]) & (simplified[:, 1] < simplified[:, 0])
        averages[data] = np.array([_averages(bench, "ad-hoc", rule)[data][1] for rule in (LFG, SIMPLIFIED)])
    start = _averages(bench, "ad-hoc")["own"][0]
    verdict, _ = of_records(seen, averages, averages["own"][0] > start > averages["own"][1])
    ours = f"{_shares(seen)}; averaged over noise at 25 %, Local Fusion Graph and simplified, {_on_average(averages)}"
    return verdict, f"{ours} ({start:.3f} at 0 %)"


_RECORDS = "averaged over noise, else open where single records show it"

STATEMENTS: tuple[Statement, ...] = (
    *[
        Statement(
            figures(42 + i),
            "More connectivity responds faster to changes of the true state.",
            "the share followed at once grows at every step",
            partial(_responds, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    *[
        Statement(
            figures(42 + i),
            "At step 1 all levels of connectivity have the same estimate.",
            "equal in single records, within rounding",
            partial(_same_at_first, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    *[
        Statement(
            figures(45 + i),
            "From step 1 to 2 the RMS error falls at 75 and 100 % and rises at 0, 25 and 50 %.",
            _RECORDS,
            partial(_first_step, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    *[
        Statement(
            figures(45 + i),
            "More connectivity is not better at all steps.",
            "in more than half of the single records, at some step and level",
            partial(_not_always_better, architecture=a),
        )
        for i, a in enumerate(ARCHITECTURES)
    ],
    *[
        Statement(
            figures(48),
            f"The averaged RMS error rises from 0 to 25 % ({a.replace('-', ' ')}).",
            _RECORDS,
            partial(_rises_at_25, architecture=a),
        )
        for a in ARCHITECTURES
    ],
    *[
        Statement(
            figures(48),
            f"It is greatest at 25 % and falls from there on, as in the transient ({a.replace('-', ' ')}).",
            _RECORDS,
            partial(_mirrors, architecture=a),
        )
        for a in ARCHITECTURES
    ],
    Statement(
        figures(48, 62, 71),
        "In one record: the Local Fusion Graph's error peaks at 25 % and falls, the naive one is greater at 100 % than "
        "at 0 %, the simplified one falls at 25 %.",
        "no average can show it; the share of single records says how likely each reading makes it",
        _everything,
    ),
    Statement(
        figures(59), "Naive state estimates get worse with connectivity.", f"at every level {_RECORDS}", _naive_worse
    ),
    Statement(figures(62), "The naive RMS error grows with message size.", f"at every level {_RECORDS}", _naive_worse),
    Statement(
        figures(62),
        "The Local Fusion Graph's RMS error is well below that of any naive estimate.",
        "below at every level from 25 % on, averaged over noise",
        partial(best_of_naive, case=STEADY),
    ),
    Statement(
        figures(70),
        "The simplified state estimates are close at each step.",
        "root-mean-square difference within a quarter of the RMS error",
        _close_states,
    ),
    Statement(
        figures(71),
        "At 25 % the Local Fusion Graph's RMS error rises and the simplified one falls (steady state).",
        _RECORDS,
        _opposite_trends,
    ),
)
