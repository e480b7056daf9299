"""Information as expressions: what an estimate is made of, before any number is put in.

The information (inverse covariance) of every estimate in a fusion network is a sum with whole coefficients,

    Y(k) = Σ c · atom,      atom:  the start      P(k0)⁻¹
                                   a measurement  HᵀR⁻¹H of one sensor at step k
                                   a prior        TU(P)⁻¹, some earlier estimate's information brought to step k

and the information vector y = Y x̂ is the same sum of the atoms' vectors.  A `Ledger` gives equal sums one number, so
that a search through millions of outcomes compares numbers, terms that cancel never meet in floating point, and the
whole is evaluated once for every distinct sum: over NumPy in one batch per step, or over an exact field.

Equations: local estimate (24)–(27) in information form, Y(k|k) = TU(P(k−1))⁻¹ + HᵀR⁻¹H; fusion (2)/(3) adds up.

Values under numbers, when agents of one kind change places: what ledgers of sums and of pasts share.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import chain, pairwise, repeat
from typing import Any

import numpy as np

from stochfuse.errors import NoAnswerError, UsageError
from stochfuse.estimators.progress import listener
from stochfuse.kalman.algebra import NUMPY, Algebra
from stochfuse.kalman.kernel import (
    Estimate,
    Information,
    at_step,
    from_information,
    predict,
    predict_information,
    to_information,
    update_information,
)
from stochfuse.scenario.model import Model, Sensor

START, MEASURED, PRIOR, GIVEN = "start", "measured", "prior", "given"
Atoms = tuple[tuple[int, int], ...]
"""Numbers of atoms and their coefficients, in order."""
MANY = 1 << 14
"""Terms from which on sums are added up by a sparse product, several times faster."""
COMMON = -1
"""Source of an initial estimate that all agents share."""
_RANDOM = np.random.default_rng(5).integers(1 << 64, size=(2, 2, 1 << 13), dtype=np.uint64) | np.uint64(1)


class Renamed:
    """Numbers for values that name agents.

    Parameters
    ----------
    kinds : kind of each agent, where agents may change places with others of their kind; None: a value stays itself.
    by_kind : where values are written with kinds in the place of agents, or None with `kinds`.
    """

    def __init__(self, kinds: Sequence[int] | None, by_kind: Any) -> None:
        self._kinds, self._by_kind = kinds, by_kind
        self._kind_of: dict[int, int] = {}
        self._moved: dict[tuple[int, ...], dict[int, int]] = {}

    def invariant(self, value: int) -> int:
        """Return a number that stays the same when agents of one kind change places."""
        if self._kinds is None:
            return value
        known = self._kind_of.get(value)
        return self._renamed(value, self._by_kind, self._kinds, self._kind_of) if known is None else known

    def moved(self, value: int, order: tuple[int, ...]) -> int:
        """Return the value after agents changed places: place p is taken by agent order[p]."""
        if self._kinds is None:
            return value
        known = self._moved.setdefault(order, {})
        new = known.get(value)
        if new is None:
            place = [0] * len(order)
            for p, agent in enumerate(order):
                place[agent] = p
            new = self._renamed(value, self, place, known)
        return new

    def _renamed(self, value: int, into: Any, names: Sequence[int], known: dict[int, int]) -> int:
        """Return the number, in another book, of a value whose agents got other names; `known` remembers."""
        raise NotImplementedError


class Ledger(Renamed):
    """Numbers for distinct information sums; equal sums have equal numbers.

    A value is a sum of atoms at one step.  Sources (of start and measurement atoms) are numbers that the caller gives:
    kinds of sensors where only covariances matter, agents where their data do.

    Parameters
    ----------
    kinds : kind of each source, where sources are agents that may change places with others of their kind; see `moved`.
    """

    def __init__(self, kinds: Sequence[int] | None = None) -> None:
        self.atoms: list[tuple[str, int, int]] = []
        self.step: list[int] = []
        self.sums: list[Atoms] = []
        self._atom_of: dict[tuple[str, int, int], int] = {}
        self._value_of: dict[tuple[int, Atoms], int] = {}
        self._local_of: dict[tuple[int, int | None], int] = {}
        self._random, self._steps = np.random.default_rng(0), np.zeros(0, dtype=np.int64)
        self._pairs, self._ends = np.zeros((0, 2), dtype=np.int64), np.zeros(1, dtype=np.int64)
        self._of_atoms, self._signatures = np.zeros((0, 2), dtype=np.uint64), np.zeros((0, 2), dtype=np.uint64)
        super().__init__(kinds, None if kinds is None else Ledger())

    def start(self, source: int) -> int:
        """Information of an initial estimate, at step 1."""
        return self._value(1, ((self._atom(START, 1, source), 1),))

    def given(self, step: int) -> int:
        """A value of its own, whose numbers are known to whoever asks for it."""
        return self._value(step, ((self._atom(GIVEN, step, len(self.sums)), 1),))

    def local(self, value: int, source: int | None) -> int:
        """The next step's local estimate: predicted from a fused value, with the source's own measurement if any."""
        known = self._local_of.get((value, source))
        if known is None:
            known = self._local_of[value, source] = self.measured(value, () if source is None else (source,))
        return known

    def measured(self, value: int, sources: Sequence[int]) -> int:
        """Return the value predicted to the next step, with the measurements of some sources there."""
        step = self.step[value] + 1
        return self._counted(step, [(PRIOR, value), *((MEASURED, of) for of in sources)])

    def measurements(self, step: int, sources: Sequence[int]) -> int:
        """Information of some sources' measurements at a step, and nothing else."""
        return self._counted(step, [(MEASURED, of) for of in sources])

    def _counted(self, step: int, kinds: Iterable[tuple[str, int]]) -> int:
        """Return the sum of some atoms of a step, given by kind and what they are of, as often as each stands there."""
        atoms = Counter(self._atom(kind, step, of) for kind, of in kinds)
        return self._value(step, tuple(sorted(atoms.items())))

    def forward(self, value: int, step: int) -> int:
        """Return the value brought forward to a later step by the time update (24)."""
        while self.step[value] < step:
            value = self.local(value, None)
        return value

    def combine(self, step: int, terms: Iterable[tuple[int, int]]) -> int:
        """Σ coefficient · value over (value, coefficient), each brought forward to the step."""
        total: dict[int, int] = {}
        steps, sums = self.step, self.sums
        for value, coefficient in terms:
            for atom, times in sums[value if steps[value] == step else self.forward(value, step)]:
                total[atom] = total.get(atom, 0) + coefficient * times
        return self._value(step, tuple(sorted([pair for pair in total.items() if pair[1]])))

    def combined(self, like: np.ndarray, of: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return many sums at a time, see `combine`, each written down once.

        Parameters
        ----------
        like : of every sum, a value of its step.
        of : number of its sum, of every term; in order, none without terms.
        values, times : of the terms.
        """
        step = self.steps[like]
        brought = self.forwards(values, step[of])
        starts = np.searchsorted(of, np.arange(len(like)))
        signed = times.view(np.uint64)[:, None] * self.signatures()[brought]
        which, first = numbered(np.ascontiguousarray(np.add.reduceat(signed, starts, axis=0).T))
        number = np.full(len(like), -1)
        number[first] = np.arange(len(first))
        one = np.flatnonzero(number[of] >= 0)
        sums = self._added_up(number[of[one]], brought[one], times[one], len(first))
        return np.array(self._values(step[first].tolist(), sums))[which]

    def _added_up(self, of: np.ndarray, values: np.ndarray, times: np.ndarray, sums: int) -> list[Atoms]:
        """Return so many sums, Σ times · value over the terms of each."""
        atoms, each, first = self.table(values)
        term = np.repeat(np.arange(len(values)), np.diff(first, append=len(atoms)))
        # a set bit more than there are atoms: a number for each sum and atom
        bits = len(self.atoms).bit_length()
        keys, which = np.unique(of[term] << bits | atoms, return_inverse=True)
        total = np.zeros(len(keys), dtype=np.int64)
        np.add.at(total, which, each * times[term])
        keys, total = keys[total != 0], total[total != 0]
        pairs = list(zip((keys & (1 << bits) - 1).tolist(), total.tolist(), strict=True))
        ends = np.searchsorted(keys >> bits, np.arange(sums + 1)).tolist()
        return [tuple(pairs[begin:end]) for begin, end in pairwise(ends)]

    def locals(self, values: np.ndarray, source: int | None) -> np.ndarray:
        """Return many local estimates at a time, see `local`."""

        def known(different: list[int]) -> list[int]:
            asked = list(zip(different, repeat(source)))
            new = [pair for pair in asked if pair not in self._local_of]
            if new:
                step = self.step[new[0][0]] + 1
                measured = () if source is None else ((self._atom(MEASURED, step, source), 1),)
                priors = [(PRIOR, step, value) for value, _ in new]
                self.atoms += _added(priors, self._atom_of)
                sums = [tuple(sorted((*measured, (self._atom_of[prior], 1)))) for prior in priors]
                self._local_of.update(zip(new, self._values(repeat(step), sums), strict=True))
            return [self._local_of[pair] for pair in asked]

        return mapped(values, known)

    def forwards(self, values: np.ndarray, steps: np.ndarray | int) -> np.ndarray:
        """Return many values brought forward, see `forward`, to a step or one each; −1 stays."""
        out, last = values.copy(), int(np.max(steps, initial=0))
        since = np.where(values < 0, last, self.steps[values])
        for now in range(int(since.min(initial=last)), last):
            here = (since <= now) & (now < steps)
            out[here] = self.locals(out[here], None)
        return out

    @property
    def steps(self) -> np.ndarray:
        """Step of every value."""
        if len(self._steps) < len(self.step):
            self._steps = np.concatenate([self._steps, self.step[len(self._steps) :]])
        return self._steps

    def signatures(self) -> np.ndarray:
        """Two random numbers per value, (values + 1, 2), that add up modulo 2^64 as the sums do; the last: nothing."""
        known = max(0, len(self._signatures) - 1)
        if known < len(self.sums):
            more = (len(self.atoms) - len(self._of_atoms), 2)
            drawn = self._random.integers(1 << 64, size=more, dtype=np.uint64)
            self._of_atoms = np.concatenate([self._of_atoms, drawn])
            which, times, first = self.table(range(known, len(self.sums)))
            signed = times.view(np.uint64)[:, None] * self._of_atoms[which]
            found = np.add.reduceat(signed, first, axis=0)
            self._signatures = np.concatenate([self._signatures[:known], found, np.zeros((1, 2), dtype=np.uint64)])
        return self._signatures

    def table(self, values: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of values: atoms and coefficients one after the other, and where each sum begins."""
        new = self.sums[len(self._ends) - 1 :]
        if new:
            pairs = np.fromiter(chain.from_iterable(chain.from_iterable(new)), dtype=np.int64).reshape(-1, 2)
            self._pairs = np.concatenate([self._pairs, pairs])
            self._ends = np.concatenate([self._ends, self._ends[-1] + np.cumsum(list(map(len, new)))])
        some = np.asarray(values)
        sizes = self._ends[some + 1] - self._ends[some]
        first = np.cumsum(sizes) - sizes
        which, times = self._pairs[np.arange(sizes.sum()) + np.repeat(self._ends[some] - first, sizes)].T
        return which, times, first

    def _renamed(self, value: int, into: Ledger, names: Sequence[int], known: dict[int, int]) -> int:
        new = known.get(value)
        if new is None:
            total: dict[int, int] = {}
            for atom, times in self.sums[value]:
                kind, step, of = self.atoms[atom]
                if kind == PRIOR:
                    of = self._renamed(of, into, names, known)
                elif of != COMMON:
                    of = names[of]
                atom = into._atom(kind, step, of)
                total[atom] = total.get(atom, 0) + times
            atoms = tuple(sorted([pair for pair in total.items() if pair[1]]))
            new = known[value] = into._value(self.step[value], atoms)
        return new

    def _atom(self, kind: str, step: int, of: int) -> int:
        key = (kind, step, of)
        known = self._atom_of.get(key)
        if known is None:
            known = self._atom_of[key] = len(self.atoms)
            self.atoms.append(key)
        return known

    def _values(self, steps: Iterable[int], sums: Sequence[Atoms]) -> list[int]:
        """Return the numbers of different sums, of a step each."""
        keys = list(zip(steps, sums, strict=False))
        new = _added(keys, self._value_of)
        self.step += [step for step, _ in new]
        self.sums += [atoms for _, atoms in new]
        return [self._value_of[key] for key in keys]

    def _value(self, step: int, atoms: Atoms) -> int:
        key = (step, atoms)
        known = self._value_of.get(key)
        if known is None:
            known = self._value_of[key] = len(self.sums)
            self.sums.append(atoms)
            self.step.append(step)
        return known


def _added(keys: Sequence[Any], numbers: dict[Any, int]) -> list[Any]:
    """Return those of some different keys that have no number yet, after giving them the next ones."""
    new = [key for key in keys if key not in numbers]
    numbers.update(zip(new, range(len(numbers), len(numbers) + len(new)), strict=True))
    return new


def mapped(values: np.ndarray, function: Callable[[list[int]], list[int]]) -> np.ndarray:
    """Return what a function makes of the different ones of some values; −1 stays."""
    found = np.flatnonzero(np.bincount(values.ravel() + 1, minlength=1)[1:])
    table = np.full(found.max(initial=-1) + 2, -1)
    table[found] = function(found.tolist())
    return table[values]


def different(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order of keys, of 1 or 2 numbers (numbers, keys), and where the different ones begin in it."""
    order = np.argsort(keys[0])
    first, last = keys[0][order], keys[-1][order]
    new, other = first[1:] != first[:-1], last[1:] != last[:-1]
    # two different keys share a number once in 10^19 pairs: where the second number differs, both count
    if (other & ~new).any():
        order = np.lexsort(keys[::-1])
        new = (keys[:, order[1:]] != keys[:, order[:-1]]).any(axis=0)
    return order, np.flatnonzero(np.concatenate([[True], new]))


def hashes(words: np.ndarray, numbers: int = 2) -> np.ndarray:
    """Return 1 or 2 numbers of 64 bits for every row of up to 2^13 words, (numbers, rows)."""
    words = words.view(np.uint64)
    out = np.empty((numbers, len(words)), dtype=np.uint64)
    for total, (one, other) in zip(out, _RANDOM, strict=False):
        mixed = words * one[: words.shape[1]]
        mixed ^= mixed >> np.uint64(32)
        np.einsum("ij,j->i", mixed, other[: words.shape[1]], out=total)
        total ^= total >> np.uint64(32)
        total *= other[-1]
    return out


def numbered(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of every key among the different ones, and where one of each of these is, in order; see `different`."""
    order, starts = different(keys)
    which, number = np.empty((2, len(order)), dtype=np.int64)
    # what is used together stays together in memory
    one = np.sort(order[starts])
    number[one] = np.arange(len(one))
    which[order] = np.repeat(number[order[starts]], np.diff(starts, append=len(order)))
    return which, one


class Sources:
    """What the atoms stand for: start and measurement information of every source, and how the state moves.

    Parameters
    ----------
    model : state transition and process noise.
    sensors : sensor of each source.
    starts : information pair of each source's initial estimate (the last one's is that of `COMMON`); where there are
        records, with y of shape (d, columns), one column for each world that is carried along.
    records : measurements z of shape (steps, sources, p, columns), or None where only covariances matter.
    """

    def __init__(
        self,
        model: Model,
        sensors: Sequence[Sensor],
        starts: Sequence[Information],
        records: Sequence[Sequence[Any]] | None = None,
        algebra: Algebra = NUMPY,
    ) -> None:
        self.model, self.sensors, self.starts, self.records, self.algebra = model, sensors, starts, records, algebra

    def measured(self, step: int, source: int) -> Information:
        """Information of one measurement, HᵀR⁻¹H and HᵀR⁻¹z."""
        sensor = self.sensors[source]
        nothing = Information(None if self.records is None else 0 * self.starts[source].y, 0 * self.starts[source].Y)
        z = None if self.records is None else self.records[step - 1][source]
        return update_information(nothing, at_step(sensor.H, step), at_step(sensor.R, step), z, algebra=self.algebra)

    def forward(self, information: Information, step: int) -> Information:
        """Time update of an information pair (or a stack) from step − 1 to the step.

        In information form, which inverts no covariance, wherever F has an inverse.
        """
        F, Q, Bu = (at_step(M, step) for M in (self.model.F, self.model.Q, self.model.Bu))
        if self._invertible(step):
            return predict_information(information, F, Q, Bu, algebra=self.algebra)
        estimate = from_information(information, algebra=self.algebra)
        return to_information(predict(estimate, F, Q, Bu, algebra=self.algebra), algebra=self.algebra)

    def _invertible(self, step: int) -> bool:
        F = at_step(self.model.F, step)
        return F.dtype != object and np.linalg.cond(F) < 1e8


def evaluate(ledger: Ledger, sources: Sources) -> Information:
    """Every value of a ledger as floating-point numbers.

    Returns
    -------
    Information
        Y of shape (values, d, d) and y of shape (values, d, columns), None without records.  Sources of a batch: with
        the items' axis after that of the values.

    Raises
    ------
    NoAnswerError
        If some value is no positive-definite information: nothing can be inferred from it.
    UsageError
        If a predicted covariance has no inverse.
    """

    def total(values: np.ndarray, atoms: np.ndarray) -> np.ndarray:
        which, times, first = ledger.table(values)
        if len(which) < MANY:  # in pairs, which loses a little less
            return np.add.reduceat(times.reshape(-1, *(1,) * (atoms.ndim - 1)) * atoms[which], first, axis=0)
        return _summed([atoms], times, which, np.append(first, len(which)))[0]

    atoms, value_step = evaluate_atoms(ledger.atoms, sources, total), np.array(ledger.step)
    values = np.empty((len(ledger.sums), *atoms.shape[1:]))
    for step in np.unique(value_step):
        listener().advance("estimates", int(step), int(value_step.max()))
        here = np.flatnonzero(value_step == step)
        values[here] = total(here, atoms)
    return unpacked(values, sources)


def evaluate_atoms(
    atoms: Sequence[tuple[str, int, int]], sources: Sources, total: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Every atom of a ledger as floating-point numbers, (atoms, …, d, width), Y and y side by side; see `unpacked`.

    Parameters
    ----------
    atoms : of the ledger.
    sources : what they stand for; of a batch, starts and noises have the items' axis before their own two.
    total : sums up some of the ledger's values from all atoms; those of later steps do not hold numbers yet.

    Raises
    ------
    NoAnswerError, UsageError
        As `evaluate`.
    """
    start = sources.starts[0]
    width = start.Y.shape[-1] + (0 if sources.records is None else start.y.shape[-1])
    out = np.empty((len(atoms), *start.Y.shape[:-1], width))
    of, atom_step = np.array([of for _, _, of in atoms]), np.array([step for _, step, _ in atoms])
    prior = np.array([kind == PRIOR for kind, _, _ in atoms])
    for step in range(1, int(atom_step.max()) + 1):
        listener().advance("information", step, int(atom_step.max()))
        brought = np.flatnonzero(prior & (atom_step == step))
        if len(brought):
            out[brought] = brought_forward(total(of[brought], out), sources, step)
        for atom in np.flatnonzero(~prior & (atom_step == step)).tolist():
            kind, _, source = atoms[atom]
            out[atom] = packed(sources.starts[source] if kind == START else sources.measured(step, source))
    return out


def brought_forward(values: np.ndarray, sources: Sources, step: int) -> np.ndarray:
    """Values of the step before, Y and y side by side, brought forward to a step.

    Raises
    ------
    NoAnswerError, UsageError
        As `evaluate`.
    """
    before = unpacked(values, sources)
    check_definite(before.Y, step - 1, rounding=1e-9)
    try:
        return packed(sources.forward(before, step))
    except np.linalg.LinAlgError:
        raise UsageError(
            f"the covariance predicted for step {step} is singular, and the common information is its inverse: "
            "expected an invertible model.F, or a model.Q that fills what it leaves out"
        ) from None


class InformationClaims:
    """What sums of information claim, see `stochfuse.estimators.protocol.Claims`.

    Parameters
    ----------
    information : of every value of a ledger.
    """

    def __init__(self, information: Information) -> None:
        d = information.Y.shape[-1]
        # beside each other they would be copied whenever some are added up; at −1 stands nothing
        y, Y = (None if part is None else np.concatenate([part, 0.0 * part[:1]]) for part in information)
        self.information = Information(y, Y)
        items = information.Y[0].size // d**2
        self.width = items * d * max(d, 0 if y is None else y.shape[-1])

    def estimate(self, terms: Sequence[tuple[int, np.ndarray]], step: int) -> tuple[Estimate, np.ndarray]:
        """Estimates of a step from sums of values, and by how much rounding grew, for each item of a batch.

        Raises
        ------
        NoAnswerError
            If some sum is no positive-definite information.
        """
        found = [None if part is None else self._total(part, terms) for part in self.information]
        estimate, magnified = estimated(Information(*found), step)
        return estimate, magnified.max(axis=(0, -1))

    @staticmethod
    def _total(part: np.ndarray, terms: Sequence[tuple[int, np.ndarray]]) -> np.ndarray:
        (sign, first), *others = terms
        total = sign * part.take(first, axis=0)
        for sign, values in others:
            (np.add if sign > 0 else np.subtract)(total, part.take(values, axis=0), out=total)
        return total


def _summed(parts: Sequence[np.ndarray], times: np.ndarray, which: np.ndarray, ends: np.ndarray) -> list[np.ndarray]:
    """Σ times · part[which] from each of the ends to the next, of some arrays."""
    from scipy.sparse import csr_array

    matrix = csr_array((times.astype(float), which, ends), shape=(len(ends) - 1, len(parts[0])))
    return [(matrix @ part.reshape(len(part), -1)).reshape(-1, *part.shape[1:]) for part in parts]


def estimated(information: Information, step: int) -> tuple[Estimate, np.ndarray]:
    """Return estimates from information claimed at a step, and by how much rounding grew in each component, (..., d).

    Raises
    ------
    NoAnswerError
        If some information is not positive definite, or has no inverse in floating point.
    """
    check_definite(information.Y, step)
    try:
        estimate = from_information(information)
    except np.linalg.LinAlgError:
        raise NoAnswerError(
            f"ill-conditioned: at step {step} the information claimed in some outcome is singular to rounding, and no "
            "covariance follows"
        ) from None
    return estimate, _diagonal(estimate.P) * _diagonal(information.Y)


def evaluate_exactly(ledger: Ledger, sources: Sources) -> list[Information]:
    """Every value of a ledger over an exact field, one by one."""
    atoms: dict[int, Information] = {}
    values: dict[int, Information] = {}
    by_step = sorted(range(len(ledger.sums)), key=ledger.step.__getitem__)
    for value in by_step:
        y: Any = None if sources.records is None else 0
        Y: Any = 0
        for atom, times in ledger.sums[value]:
            if atom not in atoms:
                kind, step, of = ledger.atoms[atom]
                make: dict[str, Callable[[], Information]] = {
                    START: lambda of=of: sources.starts[of],
                    MEASURED: lambda step=step, of=of: sources.measured(step, of),
                    PRIOR: lambda step=step, of=of: sources.forward(values[of], step),
                }
                atoms[atom] = make[kind]()
            Y = atoms[atom].Y * times + Y
            y = None if y is None else atoms[atom].y * times + y
        values[value] = Information(y, Y)
    return [values[value] for value in range(len(ledger.sums))]


def _diagonal(A: np.ndarray) -> np.ndarray:
    return np.diagonal(A, axis1=-2, axis2=-1)


def packed(information: Information) -> np.ndarray:
    """Return Y and y of information pairs side by side in an array."""
    y, Y = information
    return Y if y is None else np.concatenate([Y, y], axis=-1)


def unpacked(packed: np.ndarray, sources: Sources) -> Information:
    """Return the information pairs that stand side by side in an array."""
    d = sources.model.dimension
    return Information(None if sources.records is None else packed[..., d:], packed[..., :d])


def check_definite(Y: np.ndarray, step: int, *, rounding: float = 0.0) -> None:
    """Raise NoAnswerError if an information matrix of a step's stack is not positive definite.

    Of a batch (values, items, d, d) the error names the items.

    Parameters
    ----------
    rounding : how negative the smallest eigenvalue, scaled to unit diagonal, may be.
    """
    try:
        fine = bool((Y > 0).all()) if Y.shape[-1] == 1 else np.isfinite(np.linalg.cholesky(Y)).all()
    except np.linalg.LinAlgError:
        fine = rounding > 0 and _almost_definite(Y, rounding)
    if not fine:
        raise NoAnswerError(
            f"at step {step} the information claimed in some outcome is not positive definite: what is taken for "
            "common exceeds what is known, and no covariance follows",
            _indefinite_items(Y, rounding) if Y.ndim == 4 else (),
        )


def _indefinite_items(Y: np.ndarray, rounding: float) -> list[int]:
    return np.flatnonzero((_smallest(Y) <= -rounding).any(axis=0)).tolist()


def _smallest(Y: np.ndarray) -> np.ndarray:
    """Smallest eigenvalue of each matrix, scaled to unit diagonal; −∞ where it has none."""
    diagonal = np.diagonal(Y, axis1=-2, axis2=-1)
    usable = np.asarray((diagonal > 0).all(axis=-1) & np.isfinite(Y).all(axis=(-2, -1)))
    scale = 1.0 / np.sqrt(np.where(usable[..., None], diagonal, 1.0))
    scaled = np.where(usable[..., None, None], Y, 0.0) * scale[..., :, None] * scale[..., None, :]
    return np.where(usable, np.linalg.eigvalsh(scaled)[..., 0], -np.inf)


def _almost_definite(Y: np.ndarray, rounding: float) -> bool:
    return bool((_smallest(Y) > -rounding).all())
