"""Run estimators on data, and lay what comes out beside what was predicted.

For each estimator and agent, over all runs and steps of which the truth is known,

    realised     metric of the mean of (x̂ − x)(x̂ − x)ᵀ
    claimed      metric of the mean of P, what the rule itself says
    predicted    metric of E[(x̂ − x)(x̂ − x)ᵀ] over noises and over what arrives, from the scenario's links
    given        the same over noises alone, given this very record of arrivals
    NEES, NIS    averages, with what a consistent filter keeps (`stochfuse.data.consistency`)

A prediction that is to be compared with an average over steps is averaged over the same steps.  Beyond `FAR` steps it
is taken for steady if it is by then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.consistency import Average, Series, band
from stochfuse.data.draw import Draws, drawn_arrivals
from stochfuse.data.records import ColumnNames, RecordedRuns, Records, read_records
from stochfuse.data.suspicions import Suspicion, suspicions
from stochfuse.engines.replay import ArrivalRecord, Stage, moments_given, replay
from stochfuse.errors import StochfuseError, UsageError, nearest
from stochfuse.estimators.progress import listener
from stochfuse.estimators.readings import Readings
from stochfuse.kalman.kernel import Estimate
from stochfuse.kalman.metrics import Metric
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.predict import choose, predict
from stochfuse.scenario import registry
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.own_rules import estimators_named
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, link_rows, of_scenario

FAR, LAST = 40, 10
"""Steps up to which errors are predicted one by one, and how many of the last are averaged for a steady one."""
STEADY = 0.02
"""Largest relative change of such an average over as many steps that is taken for steady."""
FOLLOWED = 2_000_000
"""Runs times agents times steps squared of which the error given what arrived is worked out: so does its work grow."""


RECORDED = "recorded"
"""What estimates are called that come with the records."""
RecordsLike = Records | Draws
"""Records of some runs, read or drawn."""


class Row(NamedTuple):
    """What an estimator achieved.

    Parameters
    ----------
    estimator : its name.
    agent : number from 1, or None for the mean over the agents.
    link : link probability that arrivals were drawn with, or None if they were given or their links differ.
    realised, claimed, predicted, given : in the metric; None where it cannot be known.
    method : that predicted, and what its numbers are.
    nees, nis : averages with their intervals, or None.
    """

    estimator: str
    agent: int | None
    link: float | None
    realised: float | None
    claimed: float
    predicted: float | None
    given: float | None
    nees: Average | None
    nis: Average | None
    method: str = ""

    @property
    def verdict(self) -> str | None:
        """Of NEES where the truth is known, else of NIS."""
        average = self.nees or self.nis
        return None if average is None else average.verdict


class Trace(NamedTuple):
    """One estimator over the steps.

    Parameters
    ----------
    estimator : its name.
    x, variance : (steps, agents, d) estimates of the first run, and claimed variances.
    truth : (steps, agents, d) of the first run, NaN where unknown.
    nees, nis : (steps,) averages over runs and agents; NaN where unknown.
    band, nis_band : (steps, 2) between what they lie if the claim is consistent.
    """

    estimator: str
    x: np.ndarray
    variance: np.ndarray
    truth: np.ndarray
    nees: np.ndarray
    band: np.ndarray
    nis: np.ndarray
    nis_band: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(Result):
    """What estimators made of records.

    Parameters
    ----------
    scenario : what the estimators were told, with the records' number of steps.
    metric : what is shown.
    runs : number of runs.
    drawn : whether arrivals were drawn.
    simulated : whether everything was.
    rows : one for each estimator and agent, and for the mean over the agents.
    traces : each estimator over the steps.
    heard : (steps, agents, agents) what arrived in the first run at once, receiver × sender, itself not counted.
    measured : by agent, (steps, p) what it measured in the first run; NaN where nothing.
    notes : what the reader should know.
    suspicions : what may be wrong with the record, or with the scenario, where innovations are far from consistent; the
        one that explains most first.
    """

    scenario: Scenario
    metric: Metric
    runs: int
    drawn: bool
    rows: tuple[Row, ...]
    traces: tuple[Trace, ...]
    heard: np.ndarray
    measured: tuple[np.ndarray, ...]
    notes: tuple[str, ...] = ()
    simulated: bool = False
    suspicions: tuple[Suspicion, ...] = ()


class Estimates(NamedTuple):
    """Estimates of some runs at a step, as they are written to a file.

    Parameters
    ----------
    runs : names of the runs.
    estimator, step : which.
    x, P : (runs, agents, d) and (runs, agents, d, d).
    nees : (runs, agents), or None without truth.
    """

    runs: Sequence[str]
    estimator: str
    step: int
    x: np.ndarray
    P: np.ndarray
    nees: np.ndarray | None


@dataclass(frozen=True)
class Way:
    """How records are run.

    Parameters
    ----------
    estimators : names.
    link : link probability that arrivals are drawn with, in the place of the scenario's, or the name of a case.
    seed : of drawn arrivals.
    criterion : what the weights of an intersection minimise.
    predicted : whether errors are predicted too.
    suspected : whether faults are looked for where innovations are far from what is claimed.
    """

    estimators: tuple[str, ...] = (registry.LFG,)
    link: float | str | None = None
    seed: int = 1
    criterion: str = "det"
    predicted: bool = True
    suspected: bool = True


def asked_links(scenario: Scenario, link: float | str | None) -> LinkRows:
    """Return rows of a link probability, of a case by its name, or of the scenario's own links.

    Raises
    ------
    UsageError
        If it is no probability, or the scenario has no such case.
    """
    if not isinstance(link, str):
        return link_rows(scenario, None if link is None else [link])
    rows = link_rows(scenario)
    if rows.names is None:
        raise UsageError(f"case: expected a scenario with [[network.case]], got none with a case '{link}'")
    choose("case", link, rows.names)
    return rows.take(slice(rows.names.index(link), rows.names.index(link) + 1))


def way_of(given: Mapping[str, Any], scenario: Scenario) -> Way:
    """Return how records are run, of what a caller gives: `estimator`, a name or several, and fields of `Way`.

    Without an estimator it is the scenario's, else the Local Fusion Graph.

    Raises
    ------
    UsageError
        If something has another name.
    """
    known = ("estimator", *(field.name for field in fields(Way) if field.name != "estimators"))
    for name in given:
        if name not in known:
            raise UsageError(f"{name}: no such setting{nearest(name, known)}; expected {', '.join(known)}")
    rest, asked = dict(given), given.get("estimator") or scenario.estimator or registry.LFG
    rest.pop("estimator", None)
    return Way(estimators_named(asked), **rest)


@of_scenario
def run(
    scenario: Scenario,
    measurements: Any,
    arrivals: Any = None,
    truth: Any = None,
    *,
    initial: Any = None,
    columns: ColumnNames | None = None,
    metric: str | None = None,
    **way: Any,
) -> RunResult:
    """Run estimators on measurements, beside what is predicted.

    Parameters
    ----------
    scenario : what the estimators are told; it is lengthened to the records' last step.
    measurements, arrivals, truth, initial : files, mappings of arrays or data frames, see `stochfuse.data.records`;
        arrivals that are not given are drawn from the links.
    columns : names that they have for columns, by the names here; several where files differ.
    metric : what errors are shown in; default: the scenario's, else trace.
    **way : estimates (what filters of one's own made of it, judged beside the estimators as "recorded"); estimator (a
        name or several; default: the scenario's, else local-fusion-graph), link, seed, criterion, predicted (False:
        predict nothing), suspected (False: look for no faults), see `Way`.

    Returns
    -------
    RunResult
        `to_dataframe()` has a row for every estimator and agent.

    Raises
    ------
    UsageError
        If a file is malformed, or an estimator or the links do not fit.

    Examples
    --------
    >>> import stochfuse as sf
    >>> z = {"step": [2, 2, 3, 3], "agent": [1, 2, 1, 2], "z1": [0.3, -0.2, 1.1, 0.7]}
    >>> heard = {"step": [2], "receiver": [1], "sender": [2]}
    >>> found = sf.run(sf.load_scenario("thesis-steady", agents=2, steps=3), z, heard, estimator="naive")
    >>> found.rows[0].estimator, found.rows[0].agent, found.rows[0].realised
    ('naive', None, None)
    """
    estimates = way.pop("estimates", None)
    how = way_of(way, scenario)
    records = read_records(scenario, measurements, arrivals, truth, initial, columns, estimates)
    return run_records(records, metric_of(metric or scenario.metric or "trace", scenario.model), how)


def run_records(
    records: RecordsLike, metric: Metric, way: Way, write: Callable[[Estimates], None] | None = None
) -> RunResult:
    """Run estimators on records.

    Parameters
    ----------
    records : from `stochfuse.data.records.read_records`, or draws.
    metric : what errors are shown in.
    way : which estimators, and how.
    write : what is told every step's estimates, in the order run by run of a batch.

    Raises
    ------
    UsageError
        If an estimator is none for such records, or arrivals are to be drawn and no link probability is known.
    NoAnswerError
        If an estimator claims no covariance in some run.
    """
    choose("criterion", way.criterion, registry.CRITERIA)
    scenario = records.scenario
    links = None
    if not records.given or way.link is not None or scenario.network.link is not None or scenario.network.cases:
        links = asked_links(scenario, way.link)
    if not records.given and (links is None or (len(links.link) > 1)):
        raise UsageError(
            "arrivals are drawn from the scenario's links: expected one link probability; give --link or --arrivals"
        )
    tallies = {name: Tally(records, name, way.criterion) for name in way.estimators}
    if isinstance(records, Records) and records.estimates is not None:
        tallies[RECORDED] = RecordedTally(records, RECORDED, way.criterion)
    done, total = 0, len(records.names) * len(tallies) * scenario.network.steps
    heard, measured, suspected = None, (), ()
    for batch in records.batches():
        arrivals = batch.arrivals
        if arrivals is None:
            arrivals = drawn_arrivals(scenario.system, links, batch.missed, way.seed, int(batch.runs[0]))  # type: ignore[arg-type]
        if heard is None:
            heard, measured = _heard(arrivals), tuple(z[0] for z in batch.z)
            suspected = suspicions(scenario, batch, records.known) if way.suspected else ()
        for tally in tallies.values():
            tally.add(batch, arrivals, write if tally.estimator != RECORDED else None, (done, total))
            done += len(batch.runs) * scenario.network.steps
    rows, notes = [], list(records.notes)
    for tally in tallies.values():
        expected = PredictedSquare(None, "", ())
        if way.predicted and tally.estimator != RECORDED:
            expected = _expected(scenario, links, tally.estimator, way)
        notes += [*expected.notes, *tally.notes]
        rows += tally.rows(metric, expected, _link(links))
    if heard is None:
        raise UsageError("measurements: expected at least one run, got none")
    return RunResult(
        scenario,
        metric,
        len(records.names),
        not records.given,
        tuple(rows),
        tuple(tally.trace() for tally in tallies.values()),
        heard,
        measured,
        tuple(dict.fromkeys(notes)),
        suspicions=suspected,
    )


def _link(links: LinkRows | None) -> float | None:
    """The probability that all links have in common."""
    alike = links is not None and links.link.shape == (1,) and links.bursts is None
    return float(links.link[0]) if alike else None  # type: ignore[union-attr]


def _heard(arrivals: ArrivalRecord) -> np.ndarray:
    n = len(arrivals.heard[0][0])
    rows = [[[mask >> j & 1 for j in range(n)] for mask in masks] for masks in arrivals.heard[0]]
    return np.array(rows, dtype=bool) & ~np.eye(n, dtype=bool)


def stages(
    records: RecordsLike, batch: RecordedRuns, arrivals: ArrivalRecord, estimator: str, criterion: str
) -> Iterator[Stage]:
    """Follow an estimator through a batch of records; extended where sensors are by name."""
    scenario = records.scenario
    readings = Readings.given(scenario.system, batch.z, batch.relations, scenario.instruments, batch.first)
    return replay(scenario.system, estimator, arrivals, readings, criterion)


class Tally:
    """Sums over runs of what an estimator made of them.

    Parameters
    ----------
    records : what it runs on.
    estimator, criterion : how.
    """

    def __init__(self, records: RecordsLike, estimator: str, criterion: str) -> None:
        system = records.scenario.system
        steps, n, d = system.steps, system.agents, system.dimension
        self.records, self.estimator, self.criterion = records, estimator, criterion
        self.notes: list[str] = []
        self._square, self._claim = np.zeros((steps, n, d, d)), np.zeros((steps, n, d, d))
        self._count = np.zeros((steps, n), dtype=np.int64)
        known = len(records.known)
        self.nees = Series(steps, n, np.full(n, known))
        widths = [np.linalg.matrix_rank(system.sensors[kind].R[-1]) for kind in system.sensor_of]
        self.nis = Series(steps, n, np.array(widths))
        self._given, self._given_count = np.zeros((steps, n, d, d)), 0
        self._shown: list[np.ndarray] = []

    def add(
        self,
        batch: RecordedRuns,
        arrivals: ArrivalRecord,
        write: Callable[[Estimates], None] | None = None,
        work: tuple[int, int] = (0, 1),
    ) -> None:
        """Run a batch; `work`: steps of runs that were gone through before, and all."""
        system, known = self.records.scenario.system, self.records.known
        shape = (len(batch.runs), system.steps, system.agents)
        nees, nis = np.full(shape, np.nan), np.full(shape, np.nan)
        names = [self.records.names[run] for run in batch.runs.tolist()]
        first = not self._shown
        for stage in self.stages(batch, arrivals):
            k = stage.step - 1
            listener().advance("running estimators", work[0] + stage.step * len(batch.runs), work[1])
            x = np.stack([estimate.x[..., 0] for estimate in stage.estimates], axis=1)
            P = np.stack([estimate.P for estimate in stage.estimates], axis=1)
            nis[:, k] = stage.nis
            squared = None
            if batch.truth is not None:
                error = x - batch.truth[:, k]
                squared = nees[:, k] = _normalised(error[..., known], P[..., known, :][..., known])
                there = ~np.isnan(squared)
                self._square[k] += np.einsum("rai,raj->aij", *(np.where(there[..., None], error, 0.0),) * 2)
            else:
                there = ~np.asarray(np.isnan(x).any(axis=-1))
            self._claim[k] += np.where(there[..., None, None], P, 0.0).sum(axis=0)
            self._count[k] += there.sum(axis=0)
            if first:
                self._shown.append(np.stack([x[0], np.diagonal(P[0], axis1=-2, axis2=-1)]))
            if write is not None:
                write(Estimates(names, self.estimator, stage.step, x, P, squared))
        if first:
            self._truth = np.full(self._shown[0].shape[1:], np.nan)[None] if batch.truth is None else batch.truth[0]
            self._truth = np.broadcast_to(self._truth, (system.steps, *self._truth.shape[1:]))
        self.nees.add(nees)
        self.nis.add(nis)
        self._add_given(arrivals)

    def stages(self, batch: RecordedRuns, arrivals: ArrivalRecord) -> Iterator[Stage]:
        """What is claimed, step by step."""
        return stages(self.records, batch, arrivals, self.estimator, self.criterion)

    def _add_given(self, arrivals: ArrivalRecord) -> None:
        """Expected squared error given what arrived, of as many runs as can be followed."""
        system = self.records.scenario.system
        left = FOLLOWED // (system.steps**2 * system.agents) - self._given_count
        if left < 1 or self._given_count < 0:
            if self._given_count >= 0:
                self.notes.append(
                    f"{self.estimator}: the error given what arrived is that of the first {self._given_count:,} runs"
                    if self._given_count
                    else f"{self.estimator}: the error given what arrived is not worked out for so many steps"
                )
            return
        some = ArrivalRecord(arrivals.heard[:left], arrivals.missed[:left], arrivals.late)
        try:
            found = moments_given(system, self.estimator, some, self.criterion)
        except (UsageError, MemoryError) as error:
            self.notes.append(f"no error given what arrived: {error}")
            self._given_count = -1
            return
        self._given += found.square.sum(axis=0)
        self._given_count += some.runs

    def rows(self, metric: Metric, expected: PredictedSquare, link: float | None) -> list[Row]:
        """What it comes to, the mean over the agents first."""
        n = self._square.shape[1]
        given = self._given / self._given_count if self._given_count > 0 else None
        known = self.records.with_truth
        hidden = not set(metric.states) <= set(self.records.known.tolist())
        out = []
        for agent in [None, *range(n)] if n > 1 else [0]:
            out.append(
                Row(
                    self.estimator,
                    None if agent is None else agent + 1,
                    link,
                    self._over_steps(metric, self._square, agent, summed=True) if known and not hidden else None,
                    self._over_steps(metric, self._claim, agent, summed=True) or 0.0,
                    None if expected.square is None else self._over_steps(metric, expected.square, agent),
                    None if given is None else self._over_steps(metric, given, agent),
                    self.nees.average(agent),
                    self.nis.average(agent),
                    expected.method,
                )
            )
        return out

    def _over_steps(self, metric: Metric, M: np.ndarray, agent: int | None, summed: bool = False) -> float | None:
        """Metric of the mean over the steps and runs that were counted."""
        place = slice(None) if agent is None else slice(agent, agent + 1)
        weight = self._count[:, place]
        if not weight.sum():
            return None
        of = M[:, place] if summed else M[:, place] * weight[..., None, None]
        value = float(metric.of(of.sum(axis=(0, 1)) / weight.sum()))
        return value if np.isfinite(value) else None

    def trace(self) -> Trace:
        """Over the steps."""
        x, variance = np.stack(self._shown, axis=1)
        nees, nis = _over_steps(self.nees), _over_steps(self.nis)
        return Trace(self.estimator, x, variance, self._truth, *nees, *nis)


class RecordedTally(Tally):
    """The same of estimates that come with the records."""

    def stages(self, batch: RecordedRuns, arrivals: ArrivalRecord) -> Iterator[Stage]:
        """What was written down, step by step; NaN where nothing was."""
        x, P = batch.estimates  # type: ignore[misc]
        unknown = np.full(x.shape[:3], np.nan)
        for k in range(x.shape[1]):
            claimed = tuple(Estimate(x[:, k, i, :, None], P[:, k, i]) for i in range(x.shape[2]))
            yield Stage(k + 1, claimed, unknown[:, k], np.zeros(x.shape[2]))

    def _add_given(self, arrivals: ArrivalRecord) -> None:
        """Nothing is known of a rule that is not ours."""


def _over_steps(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """Averages of every step, and their bands; agents that fuse with each other count as one."""
    runs, freedom = series.count.max(axis=1), float(series.freedom.mean())
    bands = {number: band(freedom, number) for number in set(runs.tolist()) if number}
    ends = np.array([bands.get(number, (np.nan, np.nan)) for number in runs.tolist()])
    return series.by_step(), ends


def _normalised(error: np.ndarray, P: np.ndarray) -> np.ndarray:
    """ε = eᵀ P⁻¹ e, by the pseudo-inverse where P is singular; NaN where e is not known."""
    there = ~np.isnan(error).any(axis=-1)
    out = np.full(error.shape[:-1], np.nan)
    e, cov = error[there][..., None], P[there]
    if not len(e):
        return out
    try:
        solved = np.linalg.solve(cov, e)
    except np.linalg.LinAlgError:
        solved = np.linalg.pinv(cov, hermitian=True) @ e
    out[there] = (e * solved).sum(axis=(-2, -1))
    return out


class PredictedSquare(NamedTuple):
    """Expected squared error, (steps, agents, d, d), or None where it cannot be had; its method, and notes."""

    square: np.ndarray | None
    method: str
    notes: tuple[str, ...]


def _expected(scenario: Scenario, links: LinkRows | None, estimator: str, way: Way) -> PredictedSquare:
    """What is predicted from the scenario's links."""

    def nothing(why: str) -> PredictedSquare:
        return PredictedSquare(None, "", (f"{estimator}: nothing is predicted from the scenario's links: {why}",))

    if links is None or len(links.link) > 1:
        return nothing("it has none of its own; see --link")
    system = scenario.system
    near = scenario if system.steps <= FAR else scenario.until(FAR)
    if system.steps > FAR and (system.model.varies or any(s.varies for s in system.sensors) or links.varies):
        return nothing(f"more than {FAR} steps of matrices that vary")
    settings: dict[str, Any] = {"criterion": way.criterion} if registry.estimator(estimator).weighs else {}
    try:
        found = predict(near, links, estimator=estimator, quantity="rms", **settings)
    except StochfuseError as error:
        return nothing(str(error))
    square = found.moments.square[0][:, found.group_of]
    method = f"{registry.engine_of(found.method).name}, {found.nature}"
    if system.steps > FAR:
        # what was sampled changes by chance from step to step, and less so its average over some steps
        last, before = square[-LAST:].mean(axis=0), square[-2 * LAST : -LAST].mean(axis=0)
        if np.abs(last - before).max() > STEADY * np.abs(last).max():
            return nothing(f"the error is not steady at step {FAR}")
        square = np.concatenate([square, np.broadcast_to(last, (system.steps - FAR, *square.shape[1:]))])
    return PredictedSquare(square, method, ())
