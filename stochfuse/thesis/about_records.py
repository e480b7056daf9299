"""Statements about the steady scenario, where one record decides what is seen: figures 42–48, 59, 62, 70 and 71.

The thesis draws links 1000 times over one record of truth and measurements.  What it reports there is compared with
the average over noise and with many single records, and that under three readings of what the agents' data were, see
`stochfuse.thesis.bench`.  The thesis' text does not decide between them: its assumptions for (50)–(54) name
equal initial estimates, and (53) has one local estimate for all agents, but its section 3.1 has a filter for each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from stochfuse.scenario.registry import LFG, NAIVE, SIMPLIFIED
from stochfuse.thesis.about_methods import AD_HOC, BEST_OF_NAIVE, best_of_naive
from stochfuse.thesis.bench import STEADY, Bench, Sweep, time_average
from stochfuse.thesis.statements import Stated, Verdict, judged, listed

STATED = Stated()
MANY = 2000
"""Records that shares are counted in."""
READINGS = {"own": "own data", "start": "one start", "all": "one start and measurement"}
"""Whose data the agents have: see `stochfuse.thesis.bench`."""
IN_RECORDS = "averaged over noise, else open where single records show it"


def given(sweep: Sweep, data: str) -> np.ndarray:
    """RMS errors of many records, (records, links, steps)."""
    key = ("given", *sweep[1:], data)
    return sweep.bench.once(key, lambda: sweep.rms_given(MANY, data))


def _averaged_given(sweep: Sweep) -> dict[str, np.ndarray]:
    """The same averaged over time, for each reading."""
    return {data: time_average(given(sweep, data)) for data in READINGS}


def _averages(sweep: Sweep) -> dict[str, np.ndarray]:
    return {data: sweep.averaged(data) for data in READINGS}


def _shares(seen: Mapping[str, Any]) -> str:
    parts = [f"{100 * np.mean(seen[data]):.1f} % ({name})" for data, name in READINGS.items()]
    return f"in {', '.join(parts)} of {MANY} single records"


def _on_average(averages: Mapping[str, np.ndarray]) -> str:
    return "; ".join(f"{READINGS[data]}: {listed(values)}" for data, values in averages.items())


def of_records(seen: Mapping[str, Any], averages: Mapping[str, np.ndarray], on_average: bool) -> Verdict:
    """Return "agrees" if the average over noise shows it, "open" if only single records do, and how many."""
    ours = f"{_shares(seen)}; averaged over noise {_on_average(averages)}"
    return judged(on_average, ours, "open" if any(s.any() for s in seen.values()) else "differs")


def _shown_by(sweep: Sweep, feature: Callable[[np.ndarray], Any], on_average: Callable[[np.ndarray], Any]) -> Verdict:
    """Judge a feature of time-averaged errors (..., links): of many records, and of the average over noise."""
    averages = _averages(sweep)
    seen = {data: feature(errors) for data, errors in _averaged_given(sweep).items()}
    return of_records(seen, averages, bool(on_average(averages["own"])))


@STATED.of(
    {42: STEADY},
    "More connectivity responds faster to changes of the true state.",
    "the share followed at once grows at every step",
)
def _responds(sweep: Sweep) -> Verdict:
    n, steps = sweep.scenario.network.agents, sweep.bench.steps
    places = [n + (step - 1) * (n + 1) for step in range(1, steps)]
    first, deviation = sweep.weights.first, np.sqrt(sweep.scenario.model.Q.item())
    follows = np.stack([1 + first[:, k, p] / deviation for k, p in enumerate(places, 1)], axis=1)
    ours = f"share of a change of the state that is followed at once: {listed(follows[:, 0], 3)} at k=2, "
    ours += f"{listed(follows[:, -1], 3)} at k={steps}, 0 to 100 %"
    return judged((np.diff(follows, axis=0) > 0).all(), ours)


@STATED.of(
    {42: STEADY},
    "At step 1 all levels of connectivity have the same estimate.",
    "equal in single records, within rounding",
)
def _same_at_first(sweep: Sweep) -> Verdict:
    away = np.ptp(sweep.weights.mean_given(sweep.records(MANY))[:, :, 0], axis=1).max()
    own, start = (sweep.rms(data)[:, 0] for data in ("own", "start"))
    ours = f"averaged over the agents, within {away:.0e} in {MANY} single records.  The RMS errors differ, averaged "
    ours += f"over noise {listed(own)}, unless all agents have one start: {listed(start)}"
    return judged(away < 1e-9, ours)


@STATED.of(
    {45: STEADY},
    "From step 1 to 2 the RMS error falls at 75 and 100 % and rises at 0, 25 and 50 %.",
    IN_RECORDS,
)
def _first_step(sweep: Sweep) -> Verdict:
    def seen(moves: np.ndarray) -> Any:
        return (moves[..., 3:] < 0).all(axis=-1) & (moves[..., :3] > 0).all(axis=-1)

    def move(rms: np.ndarray) -> np.ndarray:
        return rms[..., 1] - rms[..., 0]

    moves = {data: move(sweep.rms(data)) for data in READINGS}
    found = {data: seen(move(given(sweep, data))) for data in READINGS}
    verdict, _ = of_records(found, moves, bool(seen(moves["own"])))
    return verdict, f"{_shares(found)}; change from k=1 to k=2 averaged over noise {_on_average(moves)}"


@STATED.of(
    {45: STEADY},
    "More connectivity is not better at all steps.",
    "in more than half of the single records, at some step and level",
)
def _not_always_better(sweep: Sweep) -> Verdict:
    worse = {data: (np.diff(given(sweep, data), axis=1) > 0).any(axis=(1, 2)) for data in READINGS}
    return judged(worse["own"].mean() > 0.5, f"more connectivity is worse at some step {_shares(worse)}")


@STATED.of({48: STEADY}, "The averaged RMS error rises from 0 to 25 % ({network}).", IN_RECORDS, next_figure=0)
def _rises_at_25(sweep: Sweep) -> Verdict:
    def rises(errors: np.ndarray) -> Any:
        return errors[..., 1] > errors[..., 0]

    return _shown_by(sweep, rises, rises)


def peaks_at_25(errors: np.ndarray) -> np.ndarray:
    """Whether time-averaged errors (..., links) are greatest at 25 % and fall from there on."""
    return (errors.argmax(axis=-1) == 1) & (np.diff(errors[..., 1:], axis=-1) < 0).all(axis=-1)


@STATED.of(
    {48: STEADY},
    "It is greatest at 25 % and falls from there on, as in the transient ({network}).",
    IN_RECORDS,
    next_figure=0,
)
def _mirrors(sweep: Sweep) -> Verdict:
    return _shown_by(sweep, peaks_at_25, peaks_at_25)


@STATED.about(
    [48, 62, 71],
    "In one record: the Local Fusion Graph's error peaks at 25 % and falls, the naive one is greater at 100 % than "
    "at 0 %, the simplified one falls at 25 %.",
    "no average can show it; the share of single records says how likely each reading makes it",
)
def _everything(bench: Bench) -> Verdict:
    graph, naive, simplified = (_averaged_given(Sweep(bench, STEADY, rule=rule)) for rule in (LFG, NAIVE, SIMPLIFIED))
    seen = {
        data: peaks_at_25(graph[data])
        & (naive[data][:, -1] > naive[data][:, 0])
        & (simplified[data][:, 1] < simplified[data][:, 0])
        for data in READINGS
    }
    return judged(False, _shares(seen), "open" if any(s.any() for s in seen.values()) else "differs")


@STATED.of({62: STEADY}, "The naive RMS error grows with message size.", f"at every level {IN_RECORDS}", AD_HOC)
@STATED.of({59: STEADY}, "Naive state estimates get worse with connectivity.", f"at every level {IN_RECORDS}", AD_HOC)
def _naive_worse(sweep: Sweep) -> Verdict:
    return _shown_by(sweep.by(NAIVE), lambda e: e[:, -1] > e[:, 0], lambda e: (np.diff(e) > 0).all())


STATED.of({62: STEADY}, BEST_OF_NAIVE, "below at every level from 25 % on, averaged over noise", AD_HOC)(best_of_naive)


@STATED.of(
    {70: STEADY},
    "The simplified state estimates are close at each step.",
    "root-mean-square difference within a quarter of the RMS error",
    AD_HOC,
)
def _close_states(sweep: Sweep) -> Verdict:
    drawn, rms = sweep.records(MANY), sweep.averaged()
    difference = sweep.by(SIMPLIFIED).weights.mean_given(drawn) - sweep.weights.mean_given(drawn)
    away = np.sqrt((difference**2).mean(axis=0)).max(axis=1)
    ours = f"root-mean-square difference of the mean estimates, largest step: {listed(away, 3)} at 0 to 100 %; "
    return judged((away < rms / 4).all(), f"{ours}RMS error {listed(rms)}")


@STATED.of(
    {71: STEADY},
    "At 25 % the Local Fusion Graph's RMS error rises and the simplified one falls (steady state).",
    IN_RECORDS,
    AD_HOC,
)
def _opposite_trends(sweep: Sweep) -> Verdict:
    graph, simplified = _averaged_given(sweep), _averaged_given(sweep.by(SIMPLIFIED))
    ours, theirs = _averages(sweep), _averages(sweep.by(SIMPLIFIED))
    seen = {
        data: (graph[data][:, 1] > graph[data][:, 0]) & (simplified[data][:, 1] < simplified[data][:, 0])
        for data in READINGS
    }
    at_25 = {data: np.array([ours[data][1], theirs[data][1]]) for data in READINGS}
    start = ours["own"][0]
    verdict, _ = of_records(seen, at_25, bool(at_25["own"][0] > start > at_25["own"][1]))
    text = f"{_shares(seen)}; averaged over noise at 25 %, Local Fusion Graph and simplified, {_on_average(at_25)}"
    return verdict, f"{text} ({start:.3f} at 0 %)"
