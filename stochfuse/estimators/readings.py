"""Estimates in numbers, for data: what the values of an estimator come to in runs that were measured.

An estimator writes down values, equal for equal pasts, whatever was measured (`stochfuse.estimators.protocol`).  On
data a value comes to another estimate in every run, so that numbers belong to pairs (value, run).  They are worked out
as soon as a step is over, by the very rules and sums that average over chance, with what was measured riding along in
the place of noise footprints (`Readings`), and forgotten as soon as nothing that is still to come can rest on them:

    x̂⁻ = F x̂ + B u      x̂ = x̂⁻ + K (z − H x̂⁻)      or      y = Σ c · (F⁻ᵀ…y, HᵀR⁻¹z)

Sensors that are no linear function of the state are linearised where the extended filter does it, about the prediction
of the measuring agent's own estimate, x̂⁻_i: what rides along is then H = ∂h/∂x (x̂⁻_i) and z − h(x̂⁻_i) + H x̂⁻_i,
angles wrapped, as if this had been measured linearly.  Whoever uses the measurement uses it so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.estimators.ledger import (
    GIVEN,
    MEASURED,
    PRIOR,
    START,
    Ledger,
    check_definite,
    estimated,
)
from stochfuse.estimators.protocol import FusionRule
from stochfuse.estimators.recursion import RecursiveEstimator, Worked, assembled, worked_out
from stochfuse.estimators.world import World, sources_of, world_of
from stochfuse.kalman.kernel import Estimate, Information, at_step, update_information
from stochfuse.scenario.system import System


class Function(Protocol):
    """What a sensor measures, where that is no linear function of the state."""

    def h(self, x: np.ndarray, step: int) -> np.ndarray:
        """What states (runs, d, 1) would show, (runs, p, 1)."""
        ...

    def H(self, x: np.ndarray, step: int) -> np.ndarray:  # noqa: N802  the mathematics' name
        """Its derivative, (runs, p, d)."""
        ...

    def residual(self, measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Difference of two measurements, angles wrapped."""
        ...


@dataclass(frozen=True, eq=False)
class Readings:
    """What was measured, in the place of footprints; see `stochfuse.estimators.world.Riding`.

    Parameters
    ----------
    world : what the filters are told.
    x0, inputs : (runs, D, 1) first estimates and (steps, D, 1) known inputs, stacked over the agents.
    shifts : (d, 1) of each agent, what is added to its filter's output.
    z : by agent, (runs, steps, p) what it measured; anything where it measured nothing.
    relations : by pair of agents, (runs, steps, p) what one measured of the other.
    functions : by agent, what it measures if that is not linear, or None.
    H : by agent, (runs, steps, p, d) the sensor as linearised so far; empty for linear ones.
    runs : (batch,) the run of each estimate that is worked on.
    """

    world: World
    x0: np.ndarray
    inputs: np.ndarray
    shifts: tuple[np.ndarray, ...]
    z: tuple[np.ndarray, ...]
    relations: Mapping[tuple[int, int], np.ndarray]
    functions: tuple[Function | None, ...]
    H: tuple[np.ndarray, ...]
    runs: np.ndarray

    @classmethod
    def given(
        cls,
        system: System,
        z: Sequence[np.ndarray],
        relations: Mapping[tuple[int, int], np.ndarray] | None = None,
        functions: Sequence[Function | None] = (),
        first: Sequence[np.ndarray | None] = (),
    ) -> Readings:
        """Put what was measured beside what the filters are told.

        Parameters
        ----------
        z, relations, functions : see the class.
        first : by agent, (runs, d, 1) first estimates of the state; default, and for None: the scenario's initial.x.

        Raises
        ------
        UsageError
            If filters of a part of the state have a known input that is not theirs.
        """
        world, model = world_of(system), system.model
        shapes = [(np.eye(model.dimension), np.zeros((model.dimension, 1)))] * system.agents
        if system.filters:
            shapes = [(f.M, f.s) for f in system.filters]
        into = [np.linalg.pinv(M) for M, _ in shapes]
        runs, steps = z[0].shape[:2]
        starts = [
            np.broadcast_to(system.x0 if x is None else x, (runs, *system.x0.shape))
            for x in first or [None] * len(into)
        ]
        x0 = np.concatenate([turn @ (x - s) for turn, (_, s), x in zip(into, shapes, starts, strict=True)], axis=1)
        if model.Bu.any() and any(M.shape[0] != M.shape[1] for M, _ in shapes):
            raise UsageError("model.B and u: expected no known input beside filters of a part of the state, got one")
        inputs = np.concatenate([turn @ model.Bu for turn in into], axis=-2)
        functions = tuple(functions) or (None,) * system.agents
        H = tuple(
            np.zeros((0,)) if f is None else np.zeros((runs, steps, *at_step(seen, 1).shape))
            for f, seen in zip(functions, world.H, strict=True)
        )
        z = tuple(np.array(each) if f is not None else each for each, f in zip(z, functions, strict=True))
        shifts = tuple(s for _, s in shapes)
        return cls(world, x0, inputs, shifts, z, relations or {}, functions, H, np.zeros(1, dtype=int))

    def of(self, runs: np.ndarray) -> Readings:
        """Return the same for a batch of estimates of some runs."""
        return replace(self, runs=runs)

    def start(self, rows: slice) -> np.ndarray:
        """First estimates."""
        return self.x0[self.runs, rows]

    def process(self, step: int, rows: slice) -> np.ndarray:
        """Known input."""
        return at_step(self.inputs, step)[rows]

    def sensor(self, step: int, agent: int, H: np.ndarray) -> np.ndarray:
        """Sensor as linearised, over the agent's own state or, where H is, over the stacked one."""
        if self.functions[agent] is None:
            return H
        own = self.H[agent][self.runs, step - 1]
        if H.shape[-1] == own.shape[-1]:
            return own
        out = np.zeros((len(own), *H.shape))
        out[..., self.world.states[agent]] = own
        return out

    def measured(self, step: int, agent: int) -> np.ndarray:
        """What an agent measured."""
        return self.z[agent][self.runs, step - 1, :, None]

    def related(self, step: int, pair: tuple[int, int]) -> np.ndarray:
        """What one agent measured of another; that they agree, where all track one state."""
        if not self.world.own:
            return np.zeros((self.world.states[0].stop, 1))
        return self.relations[pair][self.runs, step - 1, :, None]

    def shift(self, agent: int) -> np.ndarray:
        """S of an agent's filter."""
        return self.shifts[agent]

    def linearised(self, step: int, agent: int, prior: np.ndarray) -> None:
        """Put down an agent's sensor as linearised about its predictions x̂⁻ of every run, (runs, d, 1)."""
        f = self.functions[agent]
        if f is None:
            return
        H = f.H(prior, step)
        z = self.z[agent][:, step - 1, :, None]
        self.H[agent][:, step - 1] = H
        self.z[agent][:, step - 1] = (f.residual(z, f.h(prior, step)) + H @ prior)[..., 0]


class RunNumbers(Protocol):
    """Numbers of (value, run) pairs of an estimator; see `numbers_of`."""

    def work(self, values: np.ndarray, runs: np.ndarray) -> None:
        """Work out all that is not known of some pairs, and of what they rest on."""
        ...

    def estimates(self, values: np.ndarray, step: int) -> Estimate:
        """Estimates x (runs, d, 1), P (runs, d, d) of one value for every run, which are known."""
        ...

    def keep(self, values: np.ndarray, runs: np.ndarray) -> None:
        """Forget all other pairs."""
        ...

    def renamed(self, estimator: Any, names: Mapping[int, int]) -> RunNumbers:
        """Return the same for an estimator that has other numbers for these values and no past."""
        ...


def numbers_of(estimator: Any, system: System, readings: Readings, runs: int) -> RunNumbers:
    """Return what the values of an estimator come to.

    Parameters
    ----------
    readings : what was measured in those runs.
    """
    if isinstance(estimator, RecursiveEstimator):
        return PastNumbers(estimator, readings, runs)
    return SumNumbers(estimator, system, readings, runs)


class _SortedKeys:
    """Sorted keys value · runs + run, and where the numbers of each are."""

    def __init__(self, runs: int) -> None:
        self.runs = runs
        self.keys = np.zeros(0, dtype=np.int64)
        self.place = np.zeros((0, 2), dtype=np.int64)

    def key(self, values: np.ndarray, runs: np.ndarray) -> np.ndarray:
        return values.astype(np.int64) * self.runs + runs

    def unknown(self, keys: np.ndarray) -> np.ndarray:
        """Those of some keys that are not here, each once."""
        return np.unique(keys[~self.known(keys)])

    def known(self, keys: np.ndarray) -> np.ndarray:
        """Which of some keys are here."""
        if not len(self.keys):
            return np.zeros(len(keys), dtype=bool)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return self.keys[at] == keys

    def add(self, keys: np.ndarray, block: int) -> None:
        """Add sorted keys, whose numbers are the rows of a block."""
        at = np.searchsorted(self.keys, keys)
        place = np.stack([np.full(len(keys), block), np.arange(len(keys))], axis=1)
        self.keys, self.place = np.insert(self.keys, at, keys), np.insert(self.place, at, place, axis=0)

    def find(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Block and row of keys that are here."""
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        if (self.keys[at] != keys).any():
            raise ValueError("expected numbers that are known, got some that were forgotten")
        block, row = self.place[at].T
        return block, row

    def renamed(self, names: Mapping[int, int]) -> _SortedKeys:
        """Return those whose values have other names, under these."""
        values, runs = np.divmod(self.keys, self.runs)
        out, new = _SortedKeys(self.runs), np.array([names.get(value, -1) for value in values.tolist()], dtype=np.int64)
        kept = new >= 0
        keys = out.key(new[kept], runs[kept])
        order = np.argsort(keys)
        out.keys, out.place = keys[order], self.place[kept][order]
        return out


def _closed(unknown: np.ndarray, rests_on: Callable[[np.ndarray], np.ndarray], pairs: _SortedKeys) -> np.ndarray:
    """Unknown keys with all unknown ones that they rest on."""
    found = unknown
    while len(unknown):
        unknown = pairs.unknown(rests_on(unknown))
        if len(unknown):
            unknown = np.setdiff1d(unknown, found, assume_unique=True)
            found = np.union1d(found, unknown)
    return found


def _spread(lists: Sequence[Sequence[int]], which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entries of lists[which], one list after the other, and the place in `which` that each is from."""
    lengths = np.array([len(entries) for entries in lists], dtype=np.int64)
    flat = np.array([entry for entries in lists for entry in entries], dtype=np.int64)
    first = np.cumsum(lengths) - lengths
    times = lengths[which]
    owner = np.repeat(np.arange(len(which)), times)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(times) - times, times)
    return flat[np.repeat(first[which], times) + within], owner


class PastNumbers:
    """Numbers of an estimator that remembers pasts."""

    def __init__(self, estimator: RecursiveEstimator, readings: Readings, runs: int) -> None:
        self.estimator, self.readings, self.pairs = estimator, readings, _SortedKeys(runs)
        self.blocks: list[Worked] = []
        self._groups: list[tuple[int, int, int, int]] = []
        self._rules: dict[Any, int] = {}

    def work(self, values: np.ndarray, runs: np.ndarray) -> None:
        """One batch for each step, rule and level."""
        unknown = self.pairs.unknown(self.pairs.key(values, runs))
        todo = _closed(unknown, self._resting, self.pairs)
        if not len(todo):
            return
        self._sort_in()
        used, which = np.unique(todo // self.pairs.runs, return_inverse=True)
        groups = np.array([self._groups[value] for value in used])[which]
        order = np.lexsort((todo, *groups.T[::-1]))
        ends = np.flatnonzero((groups[order][1:] != groups[order][:-1]).any(axis=1)) + 1
        for batch in np.split(todo[order], ends):
            self._work(batch)

    def estimates(self, values: np.ndarray, step: int) -> Estimate:
        """As they were worked out."""
        worked = self._gathered(self.pairs.key(values, np.arange(self.pairs.runs)))
        return Estimate(worked.x, worked.P)

    def keep(self, values: np.ndarray, runs: np.ndarray) -> None:
        """Put what is kept into blocks of its own, one for each of the old ones."""
        keys = np.unique(self.pairs.key(values, runs))
        block, row = self.pairs.find(keys)
        kept, self.pairs = self.blocks, _SortedKeys(self.pairs.runs)
        self.blocks = []
        for old in np.unique(block):
            here = block == old
            self._add(keys[here], Worked(*(None if a is None else a[row[here]] for a in kept[old])))

    def renamed(self, estimator: RecursiveEstimator, names: Mapping[int, int]) -> PastNumbers:
        """The blocks stay."""
        out = PastNumbers(estimator, self.readings, self.pairs.runs)
        out.pairs, out.blocks = self.pairs.renamed(names), self.blocks
        return out

    def _resting(self, keys: np.ndarray) -> np.ndarray:
        values, runs = np.divmod(keys, self.pairs.runs)
        used, which = np.unique(values, return_inverse=True)
        before, owner = _spread([self.estimator.pasts.rests_on[value] for value in used.tolist()], which)
        return before * self.pairs.runs + runs[owner]

    def _sort_in(self) -> None:
        """Say of every new past which batch it belongs to."""
        pasts, mixed = self.estimator.pasts, self.estimator.mixed
        for value in range(len(self._groups), len(pasts.step)):
            step, rule, rests_on = pasts.step[value], pasts.rule[value], pasts.rests_on[value]
            level = 1 + max((self._groups[n][1] for n in rests_on if pasts.step[n] == step), default=-1)
            what = rule[:1] if rule[0] in mixed else rule
            self._groups.append((step, level, self._rules.setdefault(what, len(self._rules)), len(rests_on)))

    def _work(self, keys: np.ndarray) -> None:
        values, runs = np.divmod(keys, self.pairs.runs)
        pasts, estimator = self.estimator.pasts, self.estimator
        rests_on = np.array([pasts.rests_on[value] for value in values.tolist()], dtype=np.int64)
        before = [self._gathered(column * self.pairs.runs + runs) for column in rests_on.reshape(len(keys), -1).T]
        estimator.readings = self.readings.of(runs)
        rules = [pasts.rule[value] for value in values.tolist()]
        worked = worked_out(estimator, pasts.step[values[0]], rules, before, values)
        self._add(keys, Worked(*(None if a is None else np.broadcast_to(a, (len(keys), *a.shape[1:])) for a in worked)))

    def _add(self, keys: np.ndarray, worked: Worked) -> None:
        self.pairs.add(keys, len(self.blocks))
        self.blocks.append(worked)

    def _gathered(self, keys: np.ndarray) -> Worked:
        return assembled(self.blocks, *self.pairs.find(keys))


class SumNumbers:
    """Numbers of an estimator of sums of information, Y and y side by side."""

    def __init__(self, estimator: FusionRule, system: System, readings: Readings, runs: int) -> None:
        self.estimator, self.system, self.readings, self.pairs = estimator, system, readings, _SortedKeys(runs)
        self._sources = sources_of(system, np.zeros((1, system.agents, 1)))
        d = system.dimension
        self._packed = np.zeros((0, d, d + 1))

    @property
    def _ledger(self) -> Ledger:
        return self.estimator.ledger

    def work(self, values: np.ndarray, runs: np.ndarray) -> None:
        """One batch for each step."""
        todo = _closed(self.pairs.unknown(self.pairs.key(values, runs)), self._resting, self.pairs)
        if not len(todo):
            return
        used, which = np.unique(todo // self.pairs.runs, return_inverse=True)
        step_of = np.array([self._ledger.step[value] for value in used.tolist()])[which]
        for step in np.unique(step_of).tolist():
            keys = todo[step_of == step]
            packed = self._sums(keys, step)
            first = len(self._packed)
            self.pairs.add(keys, 0)
            self.pairs.place[np.searchsorted(self.pairs.keys, keys), 1] += first
            self._packed = np.concatenate([self._packed, packed])

    def estimates(self, values: np.ndarray, step: int) -> Estimate:
        """Covariance form."""
        found = self._gathered(self.pairs.key(values, np.arange(self.pairs.runs)))
        return estimated(self._unpacked(found), step)[0]

    def keep(self, values: np.ndarray, runs: np.ndarray) -> None:
        """Keep their rows, and those of what was brought forward into them: later sums take the same atoms."""
        keys = np.unique(self.pairs.key(values, runs))
        before = self._resting(keys)
        keys = np.unique(np.concatenate([keys, before[self.pairs.known(before)]]))
        packed, self.pairs = self._gathered(keys), _SortedKeys(self.pairs.runs)
        self.pairs.add(keys, 0)
        self._packed = packed

    def renamed(self, estimator: FusionRule, names: Mapping[int, int]) -> SumNumbers:
        """The rows stay."""
        out = SumNumbers(estimator, self.system, self.readings, self.pairs.runs)
        out.pairs, out._packed = self.pairs.renamed(names), self._packed
        return out

    def _unpacked(self, packed: np.ndarray) -> Information:
        return Information(packed[..., -1:], packed[..., :-1])

    def _gathered(self, keys: np.ndarray) -> np.ndarray:
        return self._packed[self.pairs.find(keys)[1]]

    def _resting(self, keys: np.ndarray) -> np.ndarray:
        values, runs = np.divmod(keys, self.pairs.runs)
        used, which = np.unique(values, return_inverse=True)
        atoms = self._ledger.atoms
        rests_on = [
            [atoms[atom][2] for atom, _ in self._ledger.sums[value] if atoms[atom][0] in (PRIOR, GIVEN)]
            for value in used.tolist()
        ]
        before, owner = _spread(rests_on, which)
        given = before == values[owner]  # rests on itself
        return (before * self.pairs.runs + runs[owner])[~given]

    def _sums(self, keys: np.ndarray, step: int) -> np.ndarray:
        values, runs = np.divmod(keys, self.pairs.runs)
        used, which = np.unique(values, return_inverse=True)
        sums = [self._ledger.sums[value] for value in used.tolist()]
        atoms, owner = _spread([[atom for atom, _ in terms] for terms in sums], which)
        times, _ = _spread([[count for _, count in terms] for terms in sums], which)
        different, place = np.unique(atoms * self.pairs.runs + runs[owner], return_inverse=True)
        numbers = self._atoms(different, step)
        out = np.zeros((len(keys), *numbers.shape[1:]))
        np.add.at(out, owner, times[:, None, None] * numbers[place])
        return out

    def _atoms(self, pairs: np.ndarray, step: int) -> np.ndarray:
        """Numbers of (atom, run) pairs of a step."""
        d = self.system.dimension
        out = np.zeros((len(pairs), d, d + 1))
        atoms, runs = np.divmod(pairs, self.pairs.runs)
        used, which = np.unique(atoms, return_inverse=True)
        what = [self._ledger.atoms[atom] for atom in used.tolist()]
        of = np.array([each for _, _, each in what])[which]
        kinds = np.array([kind for kind, _, _ in what])[which]
        for kind in set(kinds.tolist()):
            here = np.flatnonzero(kinds == kind)
            if kind == START:
                out[here] = self._start(of[here], runs[here])
            elif kind == MEASURED:
                for source in np.unique(of[here]).tolist():
                    mine = here[of[here] == source]
                    out[mine] = self._measured(step, source, runs[mine])
            elif kind == PRIOR:
                out[here] = self._forward(of[here], runs[here], step)
            else:
                out[here] = self._gathered(self.pairs.key(of[here], runs[here]))
        return out

    def _start(self, sources: np.ndarray, runs: np.ndarray) -> np.ndarray:
        Y, x = self._sources.starts[0].Y, self.readings.x0.reshape(self.pairs.runs, -1, self.system.dimension, 1)
        # a common first estimate is any agent's
        y = Y @ x[runs, np.maximum(sources, 0)]
        return np.concatenate([np.broadcast_to(Y, (len(runs), *Y.shape)), y], axis=-1)

    def _measured(self, step: int, source: int, runs: np.ndarray) -> np.ndarray:
        sensor, d = self.system.sensors[self.system.sensor_of[source]].at(step), self.system.dimension
        readings = self.readings.of(runs)
        nothing = Information(np.zeros((d, 1)), np.zeros((d, d)))
        H, z = readings.sensor(step, source, sensor.H), readings.measured(step, source)
        y, Y = update_information(nothing, H, sensor.R, z)
        return np.concatenate([np.broadcast_to(Y, (len(runs), d, d)), y], axis=-1)

    def _forward(self, values: np.ndarray, runs: np.ndarray, step: int) -> np.ndarray:
        before = self._unpacked(self._gathered(self.pairs.key(values, runs)))
        check_definite(before.Y, step - 1, rounding=1e-9)
        try:
            y, Y = self._sources.forward(before, step)
        except np.linalg.LinAlgError:
            raise UsageError(
                f"the covariance predicted for step {step} is singular: expected an invertible model.F, or a model.Q "
                "that fills what it leaves out"
            ) from None
        return np.concatenate([Y, y], axis=-1)


def given_again(old: Any, new: Any, values: Iterator[int]) -> dict[int, int]:
    """Names, in the book of a new estimator without a past, for values of an old one that are known in numbers."""
    return {value: new.book.given(old.book.step[value]) for value in sorted(set(values))}
