"""Records: what was measured, what arrived and what was true, as files have it.

    measurements   run (optional), step, agent, z1, z2, …; of (optional): the agent that was measured, where agents have
                   states of their own
    arrivals       run (optional), step, receiver, sender, sent_step (optional, default step); or a packet log: seq,
                   sender, receiver, received (optional), one packet a step
    truth          run (optional), step, some or all states by name; agent (optional), where each has its own
    first          run (optional), agent, the states by name: first estimates, default initial.x of the scenario
    estimates      run (optional), step, agent, the states by name, var:state of each and cov:state:state of each pair:
                   what filters of one's own made of it

Agents go by name or by number from 1, steps count from 1.  Rows come in any order.  A file without runs holds for all
runs of the others.  A measurement that is not there (no row, or empty cells) was missed: its agent predicts only.  The
same row again is taken once.  Whatever cannot be meant is named with its line.

Tables are held as columns of numbers, some 40 bytes a row; what is made of them (`Records.batches`) is made for some
runs at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from stochfuse.data.columns import TEXT, WHOLE, ColumnField, Columns, ColumnsError, Labels, read_columns
from stochfuse.engines.replay import ArrivalRecord
from stochfuse.errors import StochfuseError, UsageError, nearest
from stochfuse.estimators.protocol import Late
from stochfuse.kalman.packed import sound, triangle
from stochfuse.scenario.network import reachable
from stochfuse.scenario.scenario import Scenario, load_scenario

ColumnNames = Mapping[str, str | Sequence[str]]
"""Names that files have for columns, by ours; several where files differ."""
RUN, STEP = ColumnField("run", TEXT, required=False), ColumnField("step", WHOLE, 1)
ALONE = ("1",)
"""Names of the runs where no file has any."""
NUMBERS = 400_000
"""Agents times steps of a batch of runs."""
LARGEST = 1e100
"""Size of a number from which on its square tells nothing."""
MANY, SPARSE = 2_000, 200
"""Steps from which on a step must be spoken of in so many at least, lest times be taken for numbers of steps."""


class RunRows(NamedTuple):
    """A table's rows in the order of runs.

    Parameters
    ----------
    run : (rows,) index of its run; None where the rows hold for all runs.
    where : (rows, keys) step and agents, counted from 0.
    values : (rows, columns) numbers; NaN where there is none.
    """

    run: np.ndarray | None
    where: np.ndarray
    values: np.ndarray

    def of(self, runs: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return place within the batch, keys and values of the rows of some runs."""
        if self.run is None:
            count = runs.stop - runs.start
            run = np.repeat(np.arange(count), len(self.where))
            return run, np.tile(self.where, (count, 1)), np.tile(self.values, (count, 1))
        first, last = np.searchsorted(self.run, [runs.start, runs.stop])
        return self.run[first:last] - runs.start, self.where[first:last], self.values[first:last]


class RecordedRuns(NamedTuple):
    """Some runs.

    Parameters
    ----------
    runs : their places among all.
    z : by agent, (runs, steps, p) measurements; 0 where there are none.
    relations : by pair of agents, (runs, steps, p) what one measured of the other.
    arrivals : what arrived, None where that is not given; which sensors missed.
    missed : (runs, steps, agents) whether a sensor that is there measured nothing.
    truth : (runs, steps, agents, d), NaN where unknown; None where it is not given.
    first : by agent, (runs, d, 1) first estimates; empty where they are the scenario's.
    estimates : x (runs, steps, agents, d) and P (runs, steps, agents, d, d), NaN where there are none; None where they
        are not given.
    """

    runs: np.ndarray
    z: tuple[np.ndarray, ...]
    relations: dict[tuple[int, int], np.ndarray]
    arrivals: ArrivalRecord | None
    missed: np.ndarray
    truth: np.ndarray | None
    first: tuple[np.ndarray, ...]
    estimates: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class Records:
    """Records of some runs of a scenario.

    Parameters
    ----------
    scenario : with as many steps as the records have.
    names : of the runs.
    measurements, relations, arrivals, truth, first, estimates : tables, None where they are not given.
    known : (states,) which states the truth gives.
    notes : what should be known of how the files were read.
    """

    scenario: Scenario
    names: tuple[str, ...]
    measurements: RunRows
    relations: RunRows
    arrivals: RunRows | None
    truth: RunRows | None
    first: RunRows | None
    known: np.ndarray
    notes: tuple[str, ...]
    estimates: RunRows | None = None

    @property
    def given(self) -> bool:
        """Whether arrivals come with the records."""
        return self.arrivals is not None

    @property
    def with_truth(self) -> bool:
        """Whether there is any truth."""
        return self.truth is not None

    def batches(self) -> Iterator[RecordedRuns]:
        """Go through the runs, some at a time."""
        network = self.scenario.network
        size = max(1, NUMBERS // (network.agents * network.steps))
        for first in range(0, len(self.names), size):
            yield self._batch(slice(first, min(first + size, len(self.names))))

    def one_run(self) -> np.ndarray:
        """Return the measurements of the only run, (steps, agents, p), NaN where there are none.

        Raises
        ------
        UsageError
            If there are several runs.
        """
        if len(self.names) > 1:
            raise UsageError(f"measurements: expected one run, got {len(self.names)}: {', '.join(self.names[:5])}, …")
        system = self.scenario.system
        widths = [self.scenario.sensors[kind].H.shape[-2] for kind in self.scenario.sensor_of]
        out = np.full((system.steps, system.agents, max([*widths, 1])), np.nan)
        _, where, values = self.measurements.of(slice(0, 1))
        out[where[:, 0], where[:, 1]] = values[:, : out.shape[2]]
        return out

    def _batch(self, runs: slice) -> RecordedRuns:
        system = self.scenario.system
        count, steps, n, d = runs.stop - runs.start, system.steps, system.agents, system.dimension
        run, where, values = self.measurements.of(runs)
        z, missed = [], np.zeros((count, steps, n), dtype=bool)
        for agent in range(n):
            mine, H = where[:, 1] == agent, system.sensors[system.sensor_of[agent]].H
            filled = np.full((count, steps, H.shape[-2]), np.nan)
            if mine.any():
                filled[run[mine], where[mine, 0]] = values[mine, : H.shape[-2]]
            looked = H.any(axis=(-2, -1)) if not self._functions[agent] else np.ones(steps, dtype=bool)
            missed[:, :, agent] = np.isnan(filled[..., 0]) & looked if H.any() else False
            z.append(np.nan_to_num(filled))
        missed[:, 0] = False
        return RecordedRuns(
            np.arange(runs.start, runs.stop),
            tuple(z),
            self._related(runs),
            None if self.arrivals is None else _arrivals(self.arrivals.of(runs), missed),
            missed,
            None if self.truth is None else _placed(self.truth.of(runs), (count, steps, n, d), self.known),
            self._first_estimates(runs),
            None if self.estimates is None else _estimates(self.estimates.of(runs), (count, steps, n, d)),
        )

    def _first_estimates(self, runs: slice) -> tuple[np.ndarray, ...]:
        """As given; else where the nominal path begins, of a scenario without initial.x."""
        system, nominal = self.scenario.system, self.scenario.nominal
        count = runs.stop - runs.start
        if self.first is not None:
            return tuple(np.moveaxis(_first(self.first.of(runs), count, system.agents, system.dimension), 1, 0))
        if nominal is not None and not system.x0.any():
            return (np.broadcast_to(nominal[0][:, None], (count, system.dimension, 1)),) * system.agents
        return ()

    @property
    def _functions(self) -> Sequence[Any]:
        return self.scenario.instruments or (None,) * self.scenario.network.agents

    def _related(self, runs: slice) -> dict[tuple[int, int], np.ndarray]:
        relations, steps = self.scenario.system.relations, self.scenario.network.steps
        run, where, values = self.relations.of(runs)
        out = {}
        for pair, relation in relations.items():
            p = relation.R.shape[-1]
            mine = (where[:, 1:] == pair).all(axis=1)
            out[pair] = np.zeros((runs.stop - runs.start, steps, p))
            out[pair][run[mine], where[mine, 0]] = values[mine, :p]
        return out


def _placed(rows: tuple[np.ndarray, np.ndarray, np.ndarray], shape: tuple[int, ...], known: np.ndarray) -> np.ndarray:
    run, where, values = rows
    out = np.full(shape, np.nan)
    whole = np.full((len(values), shape[-1]), np.nan)
    whole[:, known] = values
    everyone = where[:, 1] < 0
    out[run[everyone], where[everyone, 0]] = whole[everyone][:, None]
    out[run[~everyone], where[~everyone, 0], where[~everyone, 1]] = whole[~everyone]
    return out


def _first(rows: tuple[np.ndarray, np.ndarray, np.ndarray], count: int, n: int, d: int) -> np.ndarray:
    run, where, values = rows
    out = np.full((count, n, d, 1), np.nan)
    out[run, where[:, 1]] = values[..., None]
    return out


def _estimates(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray], shape: tuple[int, int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    run, where, values = rows
    d = shape[-1]
    x, P = np.full(shape, np.nan), np.full((*shape, d), np.nan)
    place = (run, where[:, 0], where[:, 1])
    x[place] = values[:, :d]
    i, j, _ = triangle(d)
    for entry, of in enumerate(values[:, d:].T):
        P[(*place, i[entry], j[entry])] = P[(*place, j[entry], i[entry])] = of
    return x, P


def _arrivals(rows: tuple[np.ndarray, np.ndarray, np.ndarray], missed: np.ndarray) -> ArrivalRecord:
    run, where, _ = rows
    step, receiver, sender, sent = where.T
    prompt = step == sent
    late: dict[tuple[int, int], set[Late]] = {}
    columns = (run[~prompt], step[~prompt], receiver[~prompt], sender[~prompt], sent[~prompt])
    for r, k, i, j, s in zip(*(column.tolist() for column in columns), strict=True):
        late.setdefault((r, s + 1), set()).add(Late(i, k - s, j))
    heard = np.stack([run[prompt], step[prompt], receiver[prompt], sender[prompt]], axis=1)
    return arrivals_of(heard, missed, {key: tuple(sorted(messages)) for key, messages in late.items()})


def arrivals_of(
    heard: np.ndarray, missed: np.ndarray, late: Mapping[tuple[int, int], tuple[Late, ...]] | None = None
) -> ArrivalRecord:
    """Return arrivals as the estimators take them.

    Parameters
    ----------
    heard : (messages, 4) run, step, receiver and sender, from 0, of messages that arrived in the step they were sent.
    missed : (runs, steps, agents) whose sensors missed.
    late : by (run, step from 1), messages sent then that took longer.
    """
    runs, steps, n = missed.shape
    kind = np.int64 if n < 62 else object
    bits = np.array([1 << agent for agent in range(n)], dtype=kind)
    masks = np.tile(bits, (runs, steps, 1))
    run, step, receiver, sender = heard.T
    np.bitwise_or.at(masks, (run, step, receiver), bits[sender])
    which = (missed * bits).sum(axis=-1)
    listed = [[tuple(row) for row in of_run] for of_run in masks.tolist()]
    return ArrivalRecord(listed, which.tolist(), late or {})


def read_records(
    scenario: Scenario,
    measurements: Any,
    arrivals: Any = None,
    truth: Any = None,
    first: Any = None,
    columns: ColumnNames | None = None,
    estimates: Any = None,
) -> Records:
    """Read the records of some runs.

    Parameters
    ----------
    measurements, arrivals, truth, first, estimates : paths of CSV, Parquet or JSON files, or frames or mappings of
        arrays; see the module.
    columns : names that the files have for columns, by the names here; several where files differ.

    Raises
    ------
    UsageError
        If a file is malformed or does not fit the scenario; names line and column.
    """
    read = _ScenarioReader(scenario, columns or {})
    tables = {
        "measurements": read.measurements(measurements),
        "arrivals": None if arrivals is None else read.arrivals(arrivals),
        "truth": None if truth is None else read.truth(truth),
        "first": None if first is None else read.first(first),
        "estimates": None if estimates is None else read.estimates(estimates),
    }
    read.check_columns()
    given = {name: table for name, table in tables.items() if table is not None}
    names = _runs(given)
    last = max(table.last for table in given.values())
    _check_steps(last, given)
    scenario = _lengthened(scenario, last, given)
    rows = {name: table.rows(names) for name, table in given.items()}
    measured = rows["measurements"]
    related = measured.where[:, 2] >= 0
    notes = [note for table in given.values() for note in table.notes]
    return Records(
        scenario,
        names,
        _taken(measured, ~related),
        _taken(measured, related),
        rows.get("arrivals"),
        rows.get("truth"),
        rows.get("first"),
        read.known,
        tuple(notes),
        rows.get("estimates"),
    )


def _taken(rows: RunRows, which: np.ndarray) -> RunRows:
    return RunRows(None if rows.run is None else rows.run[which], rows.where[which], rows.values[which])


def _check_steps(last: int, tables: Mapping[str, _RawTable]) -> None:
    """Raise UsageError if hardly any of the steps are spoken of: these are times, or one of them is a slip."""
    different = len(np.unique(np.concatenate([table.where[:, 0] for table in tables.values()])))
    if last <= MANY or last <= SPARSE * different:
        return
    table = max(tables.values(), key=lambda table: table.last)
    row = int(table.where[:, 0].argmax())
    raise ColumnsError(
        f"{table.columns.at(table.row(row), 'step')}: expected steps 1, 2, … one by one, got step {last} where the "
        f"files speak of {different} steps; are these times?"
    )


def _lengthened(scenario: Scenario, last: int, tables: Mapping[str, _RawTable]) -> Scenario:
    """The scenario with as many steps as the records have."""
    steps = scenario.network.steps
    if last == steps:
        return scenario
    if last < steps:
        return scenario.until(last)
    source = scenario.to_mapping()
    try:
        longer = load_scenario({**source, "network": {**source["network"], "steps": last}})
    except StochfuseError as error:
        table = max(tables.values(), key=lambda table: table.last)
        row = table.row(int(table.where[:, 0].argmax()))
        raise ColumnsError(
            f"{table.columns.at(row, 'step')}: expected at most the scenario's {steps} steps, got {last}; it cannot be "
            f"lengthened: {error}"
        ) from None
    return replace(longer, name=scenario.name)


def _runs(tables: Mapping[str, _RawTable]) -> tuple[str, ...]:
    """Names of the runs, numbers in their order; every file that has runs has all of them.

    In a run that has first estimates nothing may have been measured.
    """
    found: dict[str, None] = {}
    for table in tables.values():
        found.update(dict.fromkeys(table.run.names if table.run is not None else ()))
    names = list(found)
    if not names:
        return ALONE
    if all(name.removeprefix("-").isdecimal() for name in names):
        names.sort(key=int)
    first = tables.get("first")
    begun = () if first is None or first.run is None else first.run.names
    for what, table in tables.items():
        there = set(names if table.run is None else table.run.names)
        there.update(begun if what == "measurements" else ())
        lost = [name for name in names if name not in there]
        if lost and what in ("measurements", "truth", "first"):
            other = next(t for t in tables.values() if t.run is not None and lost[0] in t.run.names)
            row = int((other.run.codes == other.run.names.index(lost[0])).argmax())  # type: ignore[union-attr]
            raise ColumnsError(
                f"{other.columns.at(row, 'run')}: run '{lost[0]}' is not in {table.columns.source}; expected the same "
                "runs in all files"
            )
    return tuple(names)


class _RawTable(NamedTuple):
    """A table as it was read, checked but for its runs."""

    columns: Columns
    run: Labels | None
    where: np.ndarray
    values: np.ndarray
    notes: tuple[str, ...]
    kept: np.ndarray

    def row(self, place: int) -> int:
        """Row of the file that one of these is."""
        return int(self.kept[place])

    @property
    def last(self) -> int:
        """Largest step."""
        return int(self.where[:, 0].max(initial=0)) + 1

    def rows(self, names: Sequence[str]) -> RunRows:
        """In the order of runs."""
        if self.run is None:
            return RunRows(None, self.where, self.values)
        place = {name: i for i, name in enumerate(names)}
        run = np.array([place[name] for name in self.run.names], dtype=np.int64)[self.run.codes]
        order = np.argsort(run, kind="stable")
        return RunRows(run[order], self.where[order], self.values[order])


class _ScenarioReader:
    """Reads the files of a scenario; knows its agents and states."""

    def __init__(self, scenario: Scenario, renamed: ColumnNames) -> None:
        self.scenario = scenario
        self.renamed = [
            (ours, each)
            for ours, theirs in renamed.items()
            for each in ([theirs] if isinstance(theirs, str) else theirs)
        ]
        self.used: set[str] = set()
        self.seen: dict[str, None] = {}
        self.known = np.arange(scenario.model.dimension)
        network = scenario.network
        self.agents = {str(i + 1): i for i in range(network.agents)} | {name: i for i, name in enumerate(network.names)}

    def columns(
        self, source: Any, fields: Callable[[Sequence[str]], list[ColumnField]], empty: bool = False
    ) -> Columns:
        """Columns of a file, those that have other names there among them."""

        def asked(names: Sequence[str]) -> list[ColumnField]:
            found = fields(names)
            self.used |= {field.name for field in found}
            return found

        return read_columns(source, asked, lambda names: self._renamed_in(names, fields), empty=empty)

    def _renamed_in(self, names: Sequence[str], fields: Callable[[Sequence[str]], list[ColumnField]]) -> dict[str, str]:
        """Those of the given names that a file has, of columns that are wanted of it."""
        self.seen.update(dict.fromkeys(names))
        here = {ours: theirs for ours, theirs in self.renamed if theirs in names}
        if not here:
            return {}
        wanted = {field.name for field in fields([*here, *names])}
        return {ours: theirs for ours, theirs in here.items() if ours in wanted}

    def check_columns(self) -> None:
        """Raise UsageError if a name was given for a column that no file has."""
        for ours, theirs in self.renamed:
            if ours not in self.used:
                raise UsageError(f"columns: unknown column '{ours}'{nearest(ours, sorted(self.used))}")
            if theirs not in self.seen:
                raise UsageError(
                    f"columns: no file has a column '{theirs}'{nearest(theirs, self.seen)}, to be used as '{ours}'"
                )

    def measurements(self, source: Any) -> _RawTable:
        """Measurements, and those of other agents: keys step, agent, agent that was measured or −1."""
        widths = [self._width(i) for i in range(len(self.scenario.sensor_of))]
        related = [relation.R.shape[-1] for relation in self.scenario.relations.values()]
        most = max([*widths, *related, 1])

        def fields(names: Sequence[str]) -> list[ColumnField]:
            z = [ColumnField(f"z{i}", blank=True, free=True, required=i == 1) for i in range(1, most + 1)]
            own = [ColumnField("of", TEXT, required=False, blank=True)] if self.scenario.relations else []
            return [RUN, STEP, ColumnField("agent", TEXT), *own, *z]

        found = self.columns(source, fields)
        agent = self._agent(found, "agent")
        of = np.full(len(found), -1)
        if "of" in found and (found.text["of"].codes >= 0).any():
            of = self._agent(found, "of", blank=True)
        z = [f"z{i}" for i in range(1, most + 1) if f"z{i}" in found]
        values = np.stack([found.number[name] for name in z], axis=1)
        self._check_size(found, values, z, "a finite number or nothing")
        expected = np.array([widths[i] for i in agent])
        for row in np.flatnonzero(of >= 0).tolist():
            relation = self.scenario.relations.get((int(agent[row]), int(of[row])))
            if relation is None:
                raise found.error(row, "of", "an agent that the scenario lets it measure", found.said(row, "of"))
            expected[row] = relation.R.shape[-1]
        blind = (expected == 0) & ~np.isnan(values).all(axis=1)
        found.refuse(blind, "agent", "an agent with a sensor", lambda said: f"{said} without one")
        self._check_width(found, values, expected, z)
        step = found.number["step"] - 1
        early = int((~np.isnan(values[:, 0]) & (step == 0)).sum())
        where = np.stack([step, agent, of], axis=1)
        notes = []
        if early:
            notes.append(f"{found.source}: {early} measurements of step 1 are not used: estimates begin there")
        unused = [name for name in found.skipped if name[:1].lower() == "z" and name[1:].isdigit()]
        if unused:
            listed = ", ".join(unused[:3]) + (", …" if len(unused) > 3 else "")
            notes.append(f"{found.source}: not used is {listed}: sensors of the scenario measure at most {most}")
        if values.shape[1] < most:
            values = np.concatenate([values, np.full((len(values), most - values.shape[1]), np.nan)], axis=1)
        return self._once(found, where, values, notes, step > 0)

    def arrivals(self, source: Any) -> _RawTable:
        """Messages: keys step, receiver, sender, step of sending."""

        def fields(names: Sequence[str]) -> list[ColumnField]:
            ends = [ColumnField("receiver", TEXT), ColumnField("sender", TEXT)]
            if "step" not in names and "seq" in names:
                return [RUN, ColumnField("seq", WHOLE, 0), *ends, ColumnField("received", WHOLE, 0, required=False)]
            return [RUN, STEP, *ends, ColumnField("sent_step", WHOLE, 1, required=False, blank=True)]

        found = self.columns(source, fields, empty=True)
        receiver, sender = self._agent(found, "receiver"), self._agent(found, "sender")
        notes, there = [], np.ones(len(found), dtype=bool)
        if "seq" in found:
            seq = found.number["seq"]
            begins = int(seq.min(initial=1))
            step = seq - begins
            notes.append(f"{found.source}: a packet log; packet {begins} is taken for step 1's")
            there = found.number["received"] != 0 if "received" in found else there
            sent = step
        else:
            step = found.number["step"] - 1
            sent = step
            if "sent_step" in found:
                told = found.number["sent_step"]
                sent = np.where(np.isnan(told), step, np.nan_to_num(told) - 1).astype(np.int64)
        self._check_messages(found, receiver, sender, step, sent)
        far = ~reachable(self.scenario.network)[receiver, sender] & there
        if far.any():
            notes.append(f"{found.source}: {int(far.sum())} messages came over links that the scenario does not have")
        where = np.stack([step, receiver, sender, sent], axis=1)
        # a message counts once, when it comes first
        order = np.lexsort((step,)) if len(step) else np.zeros(0, dtype=int)
        again = self._again(found, where[:, 1:], order)
        if (again & there).any():
            notes.append(f"{found.source}: {int((again & there).sum())} messages came again; the first time counts")
        kept = there & ~again
        return _RawTable(
            found,
            self._run(found, kept),
            where[kept],
            np.zeros((int(kept.sum()), 0)),
            tuple(notes),
            np.flatnonzero(kept),
        )

    def truth(self, source: Any) -> _RawTable:
        """True states: keys step, agent or −1 for all."""
        states = self.scenario.model.states
        own = not self.scenario.system.one_state
        shown: list[str] = []

        def fields(names: Sequence[str]) -> list[ColumnField]:
            shown[:] = [state for state in states if state in names]
            if not shown:
                raise UsageError(
                    f"truth: expected states as columns, some of {', '.join(states)}; got {', '.join(names)}"
                )
            given = [ColumnField(state, blank=True) for state in shown]
            return [RUN, STEP, ColumnField("agent", TEXT, required=own), *given]

        found = self.columns(source, fields)
        self.known = np.array([states.index(state) for state in shown])
        agent = self._agent(found, "agent") if "agent" in found else np.full(len(found), -1)
        values = np.stack([found.number[state] for state in shown], axis=1)
        self._check_size(found, values, shown, "a number or nothing")
        step = found.number["step"] - 1
        notes = []
        if len(shown) < len(states):
            lost = ", ".join(state for state in states if state not in shown)
            notes.append(f"{found.source}: nothing is known of {lost}: NEES is that of {', '.join(shown)}")
        return self._once(found, np.stack([step, agent], axis=1), values, notes, np.ones(len(found), dtype=bool))

    def first(self, source: Any) -> _RawTable:
        """First estimates: keys 0, agent."""
        states = self.scenario.model.states
        given = [RUN, ColumnField("agent", TEXT), *map(ColumnField, states)]
        found = self.columns(source, lambda _: given)
        agent = self._agent(found, "agent")
        values = np.stack([found.number[state] for state in states], axis=1)
        self._check_size(found, values, states, "a number")
        runs, names = found.text["run"] if "run" in found else (np.zeros(len(found), dtype=np.int64), ("",))
        there = np.zeros((len(names), self.scenario.network.agents), dtype=bool)
        there[runs, agent] = True
        if not there.all():
            run, lost = (int(i) for i in np.argwhere(~there)[0])
            where = f" in run '{names[run]}'" if names[run] else ""
            raise UsageError(
                f"{found.source}: expected a first estimate of every agent, got none of agent {lost + 1}{where}"
            )
        where = np.stack([np.zeros_like(agent), agent], axis=1)
        return self._once(found, where, values, [], np.ones(len(found), dtype=bool))

    def estimates(self, source: Any) -> _RawTable:
        """What filters of one's own estimate and claim: keys step, agent; states, then the upper triangle of P."""
        states = self.scenario.model.states
        i, j, _ = triangle(len(states))
        pairs = list(zip(i.tolist(), j.tolist(), strict=True))

        def called(i: int, j: int) -> str:
            return f"var:{states[i]}" if i == j else f"cov:{states[i]}:{states[j]}"

        def fields(names: Sequence[str]) -> list[ColumnField]:
            claimed = [called(j, i) if called(j, i) in names else called(i, j) for i, j in pairs]
            return [RUN, STEP, ColumnField("agent", TEXT), *map(ColumnField, (*states, *claimed))]

        found = self.columns(source, fields)
        shown = [*states, *(called(i, j) if called(i, j) in found else called(j, i) for i, j in pairs)]
        values = np.stack([found.number[name] for name in shown], axis=1)
        self._check_size(found, values, shown, "a number")
        unsound = ~sound(values[:, len(states) :].T, len(states))
        found.refuse(unsound, shown[len(states)], "variances and covariances of a matrix that is one")
        where = np.stack([found.number["step"] - 1, self._agent(found, "agent")], axis=1)
        return self._once(found, where, values, [], np.ones(len(found), dtype=bool))

    def _width(self, agent: int) -> int:
        return self.scenario.sensors[self.scenario.sensor_of[agent]].H.shape[-2]

    def _agent(self, found: Columns, column: str, blank: bool = False) -> np.ndarray:
        """Agents by number from 0; −1 where a cell is empty."""
        codes, names = found.text[column]
        numbers = np.array([self.agents.get(name.strip(), -1) for name in names] or [-1])
        out = np.where(codes >= 0, numbers[codes], -1)
        wrong = (out < 0) & (codes >= 0) if blank else out < 0
        n, known = self.scenario.network.agents, self.scenario.network.names
        listed = f", or {', '.join(known[:6])}{', …' if len(known) > 6 else ''}" if known else ""
        expected = f"an agent from 1 to {n}{listed}"
        found.refuse(wrong, column, expected, lambda said: said + nearest(said[1:-1], known))
        return out

    def _check_size(self, found: Columns, values: np.ndarray, names: Sequence[str], expected: str) -> None:
        wrong = np.abs(values) >= LARGEST
        if wrong.any():
            row, column = (int(i) for i in np.argwhere(wrong)[0])
            value = values[row, column]
            within = f", below {LARGEST:g} in size" if np.isfinite(value) else ""
            raise found.error(row, names[column], f"{expected}{within}", value)

    def _check_width(self, found: Columns, values: np.ndarray, expected: np.ndarray, names: Sequence[str]) -> None:
        there = ~np.isnan(values)
        count = there.sum(axis=1)
        leading = np.logical_and.accumulate(there, axis=1).sum(axis=1)
        wrong = (count > 0) & ((count != expected) | (leading != count))
        if wrong.any():
            row = int(wrong.argmax())
            needed = ", ".join(f"z{i}" for i in range(1, int(expected[row]) + 1))
            got = ", ".join(name for name, t in zip(names, there[row], strict=True) if t)
            raise found.error(row, names[0], f"all of {needed} and no more, or none", got)

    def _check_messages(
        self, found: Columns, receiver: np.ndarray, sender: np.ndarray, step: np.ndarray, sent: np.ndarray
    ) -> None:
        found.refuse(receiver == sender, "receiver", "another agent than the sender")
        if (sent > step).any():
            row = int((sent > step).argmax())
            raise found.error(row, "sent_step", f"a step up to {step[row] + 1}", sent[row] + 1)

    def _run(self, found: Columns, kept: np.ndarray) -> Labels | None:
        if "run" not in found:
            return None
        codes, names = found.text["run"]
        return Labels(codes[kept], names)

    def _by_run(self, found: Columns, keys: np.ndarray) -> np.ndarray:
        """Keys with the number of the run before them."""
        runs = found.text["run"].codes[:, None] if "run" in found else np.zeros((len(found), 1), dtype=np.int64)
        return np.concatenate([runs, keys], axis=1)

    def _again(self, found: Columns, keys: np.ndarray, order: np.ndarray) -> np.ndarray:
        """Rows that have the keys of one before them, in some order of rows."""
        first = np.unique(self._by_run(found, keys)[order], axis=0, return_index=True)[1]
        again = np.ones(len(found), dtype=bool)
        again[order[first]] = False
        return again

    def _once(
        self, found: Columns, where: np.ndarray, values: np.ndarray, notes: list[str], there: np.ndarray
    ) -> _RawTable:
        """Rows that are there, each once; two that say different things of the same are an error."""
        again = self._again(found, where, np.arange(len(found)))
        if again.any():
            _, of = np.unique(self._by_run(found, where), axis=0, return_inverse=True)
            firsts = np.zeros(of.max() + 1, dtype=np.int64)
            firsts[of[~again]] = np.flatnonzero(~again)
            other = firsts[of.ravel()]
            differs = (~((values == values[other]) | (np.isnan(values) & np.isnan(values[other])))).any(axis=1)
            if differs.any():
                row = int(differs.argmax())
                raise ColumnsError(
                    f"{found.at(row)}: expected one row for each run, step and agent, got another than in "
                    f"{found.what} {found.line(int(other[row]))}"
                )
            notes.append(f"{found.source}: {int(again.sum())} rows are there twice, and count once")
        kept = there & ~again
        return _RawTable(found, self._run(found, kept), where[kept], values[kept], tuple(notes), np.flatnonzero(kept))
