"""Write the files of a run: measurements, arrivals, truth, first estimates and estimates.

Numbers are written with as many digits as tell them apart (17 at most), so that what is read is what was written.  Rows
go out batch by batch; a file has its name only when it is complete.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.data.records import RecordedRuns
from stochfuse.data.run import Estimates
from stochfuse.data.tables import SUFFIXES
from stochfuse.engines.replay import ArrivalRecord
from stochfuse.errors import UsageError, needed
from stochfuse.scenario.scenario import Scenario

MEASUREMENTS, ARRIVALS, TRUTH, FIRST, ESTIMATES = (
    f"{name}.csv" for name in ("measurements", "arrivals", "truth", "initial", "estimates")
)
"""Names of the files of a run."""


class GrowingTable:
    """A CSV or Parquet file that is written row by row, and there only once it is complete.

    Parameters
    ----------
    path : of the file; a name that ends in .parquet makes it one (extra `study`).
    headings : names of the columns.
    """

    def __init__(self, path: Path, headings: Sequence[str]) -> None:
        self.path, self.headings = path, tuple(headings)
        self._partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
        self._parquet: Any = None
        if path.suffix.lower() in SUFFIXES:
            needed("pyarrow.parquet", "study", f"{path}: Parquet needs")

    def __enter__(self) -> GrowingTable:
        try:
            if self.path.suffix.lower() not in SUFFIXES:
                self._stream = self._partial.open("w", encoding="utf-8", newline="")
                csv.writer(self._stream, lineterminator="\n").writerow(self.headings)
        except OSError as error:
            raise UsageError(f"cannot write {self.path}: {error.strerror or error}") from None
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if self.path.suffix.lower() in SUFFIXES:
            if self._parquet is not None:
                self._parquet.close()
        else:
            self._stream.close()
        if kind is None and self._partial.exists():
            self._partial.replace(self.path)
        else:
            self._partial.unlink(missing_ok=True)

    def add(self, columns: Sequence[Any]) -> None:
        """Add rows, column by column; None is an empty cell."""
        if self.path.suffix.lower() in SUFFIXES:
            pa, pq = import_module("pyarrow"), import_module("pyarrow.parquet")
            made = pa.table(dict(zip(self.headings, columns, strict=True)))
            if self._parquet is None:
                self._parquet = pq.ParquetWriter(self._partial, made.schema)
            self._parquet.write_table(made)
            return
        try:
            csv.writer(self._stream, lineterminator="\n").writerows(zip(*map(_cells, columns), strict=True))
        except OSError as error:
            raise UsageError(f"cannot write {self.path}: {error.strerror or error}") from None


def _cells(column: Any) -> Iterable[Any]:
    """Cells of a column; what is not a number is empty."""
    if isinstance(column, np.ndarray):
        if column.dtype.kind == "f":
            return ["" if value != value else repr(value) for value in column.tolist()]
        return column.tolist()
    return column


def agents_of(scenario: Scenario) -> list[str]:
    """Names of the agents, or their numbers from 1."""
    return list(scenario.network.names) or [str(i + 1) for i in range(scenario.network.agents)]


class EstimatesFile:
    """Estimates of runs, `run, step, agent, estimator, states, var:state, …`.

    Parameters
    ----------
    path : of the file.
    scenario : whose agents and states it names.
    truth : whether there is NEES too.
    covariance : whether covariances cov:state:state are written beside the variances.
    """

    def __init__(self, path: Path, scenario: Scenario, *, truth: bool, covariance: bool = False) -> None:
        states = scenario.model.states
        self._agents, self._truth = np.array(agents_of(scenario), dtype=object), truth
        self._pairs = [(i, j) for j in range(len(states)) for i in range(j)] if covariance else []
        named = [f"cov:{states[i]}:{states[j]}" for i, j in self._pairs]
        headings = ["run", "step", "agent", "estimator", *states, *(f"var:{s}" for s in states), *named]
        self.table = GrowingTable(path, [*headings, *(["nees"] if truth else [])])

    def __enter__(self) -> EstimatesFile:
        self.table.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.table.__exit__(*error)

    def write(self, found: Estimates) -> None:
        """Write the estimates of a step."""
        runs, n, d = found.x.shape
        flat, P = found.x.reshape(-1, d), found.P.reshape(-1, d, d)
        columns: list[Any] = [
            np.repeat(np.array(found.runs, dtype=object), n),
            np.full(runs * n, found.step),
            np.tile(self._agents, runs),
            [found.estimator] * (runs * n),
            *flat.T,
            *(P[:, i, i] for i in range(d)),
            *(P[:, i, j] for i, j in self._pairs),
        ]
        if self._truth:
            columns.append(np.full(runs * n, np.nan) if found.nees is None else found.nees.ravel())
        self.table.add(columns)


class RecordFiles:
    """Measurements, arrivals, truth and first estimates of simulated runs, in a folder.

    Parameters
    ----------
    folder : where the files go.
    scenario : whose agents and states they name.
    """

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self.scenario, self._agents = scenario, np.array(agents_of(scenario), dtype=object)
        system, states = scenario.system, scenario.model.states
        widths = [scenario.sensors[kind].H.shape[-2] for kind in scenario.sensor_of]
        self._most = max([*widths, *(relation.R.shape[-1] for relation in system.relations.values()), 1])
        self._own = not system.one_state
        of = ["of"] if system.relations else []
        z = [f"z{i}" for i in range(1, self._most + 1)]
        self.measurements = GrowingTable(folder / MEASUREMENTS, ["run", "step", "agent", *of, *z])
        self.arrivals = GrowingTable(folder / ARRIVALS, ["run", "step", "receiver", "sender", "sent_step"])
        self.truth = GrowingTable(folder / TRUTH, ["run", "step", *(["agent"] if self._own else []), *states])
        self.first = GrowingTable(folder / FIRST, ["run", "agent", *states])
        self._stack = ExitStack()

    def __enter__(self) -> RecordFiles:
        for table in (self.measurements, self.arrivals, self.truth, self.first):
            self._stack.enter_context(table)
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def write(self, batch: RecordedRuns, names: Sequence[str], seen: Callable[[int], np.ndarray]) -> None:
        """Write some runs.

        Parameters
        ----------
        names : of these runs.
        seen : by agent, (runs, steps) whether it measured something.
        """
        runs = np.array(names, dtype=object)
        self._write_measurements(batch, runs, seen)
        if batch.arrivals is not None:
            self._write_arrivals(batch.arrivals, runs)
        truth = batch.truth
        if truth is not None:
            count, steps, n, d = truth.shape
            shown = truth if self._own else truth[:, :, :1]
            each = shown.shape[2]
            run, step = np.repeat(runs, steps * each), np.tile(np.repeat(np.arange(1, steps + 1), each), count)
            agent = [np.tile(self._agents, count * steps)] if self._own else []
            self.truth.add([run, step, *agent, *shown.reshape(-1, d).T])
            first = np.stack(batch.first, axis=1).reshape(-1, d)
            self.first.add([np.repeat(runs, n), np.tile(self._agents, count), *first.T])

    def _write_measurements(self, batch: RecordedRuns, runs: np.ndarray, seen: Callable[[int], np.ndarray]) -> None:
        parts = []
        for agent, z in enumerate(batch.z):
            run, step = np.nonzero(seen(agent))
            parts.append((run, step, np.full(len(run), agent), np.full(len(run), -1), z[run, step]))
        for (i, j), z in batch.relations.items():
            run, step = (index.ravel() for index in np.indices((z.shape[0], z.shape[1] - 1)))
            step = step + 1  # nothing is measured at step 1
            parts.append((run, step, np.full(len(run), i), np.full(len(run), j), z[run, step]))
        padded = [np.full((len(part[0]), self._most), np.nan) for part in parts]
        for wide, part in zip(padded, parts, strict=True):
            wide[:, : part[4].shape[1]] = part[4]
        run, step, agent, of = (np.concatenate([part[i] for part in parts]) for i in range(4))
        order = np.lexsort((of, agent, step, run))
        names = np.append(self._agents, "")
        related = [names[of[order]]] if self.scenario.system.relations else []
        values = np.concatenate(padded)[order]
        self.measurements.add([runs[run[order]], step[order] + 1, self._agents[agent[order]], *related, *values.T])

    def _write_arrivals(self, arrivals: ArrivalRecord, runs: np.ndarray) -> None:
        rows = []
        for run, of_run in enumerate(arrivals.heard):
            for step, masks in enumerate(of_run, start=1):
                for receiver, mask in enumerate(masks):
                    senders = mask & ~(1 << receiver)
                    while senders:
                        sender = senders.bit_length() - 1
                        rows.append((run, step, receiver, sender, step))
                        senders ^= 1 << sender
        for (run, sent), messages in arrivals.late.items():
            rows += [(run, sent + m.delay, m.receiver, m.sender, sent) for m in messages]
        run, step, receiver, sender, sent = np.array(sorted(rows), dtype=np.int64).reshape(-1, 5).T
        self.arrivals.add([runs[run], step, self._agents[receiver], self._agents[sender], sent])
