"""A recursion of matrices, the same for each of many items, compiled when there is enough of it.

The step is run once on arrays of `TracedNumber`, which write down what is done to them: no equation is written a second
time. That list, in the language of LLVM, becomes the body of a loop over groups of `LANES` neighbouring items; an
operation is one vector instruction, a product and the sum that it goes into are one. All steps of a group come before
the next group: what it goes by is read once and stays in registers and the nearest cache, where NumPy passes memory at
every operation.

Needs the package llvmlite (extra `compiled`), whose import takes 0.1 s once, and then 0.02 to 0.5 s for 2 to 9 states;
nothing is kept on disk.  Without it answers are the same up to rounding.  The environment variable STOCHFUSE_COMPILED
switches it off (0), or on for the least work too (1); else the size of a call decides, so that the same call gives the
same digits whatever came before.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Collection, Sequence
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from stochfuse.errors import UsageError

SWITCH = "STOCHFUSE_COMPILED"
LANES = 8
"""Items in a group: as many as the widest registers hold; narrower ones take a group in two or four."""
LEAST = 40_000
"""Steps of items that pay for compiling what is short; what is long needs `LEAST_EACH` for each of its products."""
LEAST_EACH = 60
MOST = 10_000
"""Products in a step at most: compiling takes seconds there."""
_NUMBERS, _PLACES, _MASK, _POINTERS = (f"<{LANES} x {kind}>" for kind in ("double", "i64", "i1", "ptr"))
_GATHER, _STORE = f"@llvm.masked.gather.v{LANES}f64.v{LANES}p0", f"@llvm.masked.store.v{LANES}f64.p0"

Entries = Sequence[tuple[int, int]]
Step = Callable[..., tuple[Sequence["TracedNumber"], Sequence["TracedNumber"]]]


class TracedNumber:
    """A number of every item that is not known yet: arithmetic on it is written down, the same only once."""

    def __init__(self, name: str, written: dict[str, str]) -> None:
        self.name, self._written = name, written

    def _write(self, text: str) -> TracedNumber:
        return TracedNumber(self._written.setdefault(text, f"%t{len(self._written)}"), self._written)

    def __add__(self, other: TracedNumber) -> TracedNumber:
        return self._write(f"fadd contract {_NUMBERS} {self.name}, {other.name}")

    def __radd__(self, nothing: int) -> TracedNumber:
        return self  # NumPy begins its sums at 0

    def __sub__(self, other: TracedNumber) -> TracedNumber:
        return self._write(f"fsub contract {_NUMBERS} {self.name}, {other.name}")

    def __mul__(self, other: TracedNumber) -> TracedNumber:
        return self._write(f"fmul contract {_NUMBERS} {self.name}, {other.name}")

    def __rtruediv__(self, number: float) -> TracedNumber:
        return self._write(f"fdiv {_NUMBERS} splat (double {number!r}), {self.name}")

    def largest(self, other: TracedNumber) -> TracedNumber:
        """Return the larger of the two, `other` where one is no number."""
        larger = self._write(f"fcmp ogt {_NUMBERS} {self.name}, {other.name}")
        return self._write(f"select {_MASK} {larger.name}, {_NUMBERS} {self.name}, {_NUMBERS} {other.name}")


class Loop:
    """A compiled recursion; raises OSError or RuntimeError where this machine compiles nothing.

    Parameters
    ----------
    place : (d, d) which of the carried numbers stands where in the matrix that a step makes anew.
    watched : how many numbers beside them a step makes anew.
    given : which entries are read of each matrix that it goes by.
    common : which of these are never an item's own, so that they are read once.
    step : from the terms of the carried numbers, those watched and the entries of each matrix given, one-dimensional
        arrays, to what the carried numbers and those watched become.
    """

    def __init__(
        self, place: np.ndarray, watched: int, given: Sequence[Entries], common: Collection[int], step: Step
    ) -> None:
        import llvmlite.binding as llvm

        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
        )
        first = np.unique(place, return_index=True)[1]
        self._out = list(np.ndindex(place.shape))
        self._read = [[self._out[at] for at in first], *given]
        text = _text(place.ravel().tolist(), watched, [len(entries) for entries in self._read], common, step)
        self._engine: Any = llvm.create_mcjit_compiler(llvm.parse_assembly(text), machine)  # it keeps the code
        self._engine.finalize_object()
        self._run = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(self._engine.get_function_address("run"))

    def __call__(
        self, start: np.ndarray, watched: np.ndarray, given: Sequence[np.ndarray], steps: int, out: np.ndarray
    ) -> None:
        """Take all items, at least one, through at least one step.

        Parameters
        ----------
        start : (items, d, d) to begin with.
        watched : (numbers, at least `padded(items)`), the items in one piece: overwritten.
        given : matrices (items, ., .), or (., .) of all.
        steps : how many.
        out : (1, d, d, items) for the last matrices, or (steps, d, d, items), the items in one piece: filled.
        """
        words = [steps, len(start), out.strides[0] if len(out) > 1 else 0]
        words += _addresses(out, self._out, out.strides[1:3])
        words += _addresses(watched, [(i, 0) for i in range(len(watched))], watched.strides)
        arrays = [np.asarray(M, dtype=float) for M in (start, *given)]
        for M, entries in zip(arrays, self._read, strict=True):
            words += [M.strides[0] if M.ndim == 3 else 0, *_addresses(M, entries, M.strides[-2:])]
        table = np.array(words, dtype=np.int64)
        self._run(address(table))


def _addresses(M: np.ndarray, entries: Entries, strides: Sequence[int]) -> list[int]:
    begin, (down, right) = address(M), strides
    return [begin + i * down + j * right for i, j in entries]


def address(M: np.ndarray) -> int:
    """Return where an array's first number is kept, in a tenth of the time that its `ctypes` takes."""
    return M.__array_interface__["data"][0]


def padded(items: int) -> int:
    """Return how many items whole groups have."""
    return -(-items // LANES) * LANES


_FRAME = f"""
declare {_NUMBERS} {_GATHER}({_POINTERS}, i32, {_MASK}, {_NUMBERS})
declare void {_STORE}({_NUMBERS}, ptr, i32, {_MASK})
define void @run(ptr %table) {{{{
entry:
{{entry}}
%least = sub i64 %items, 1
%ends_ = insertelement {_PLACES} poison, i64 %least, i32 0
%ends = shufflevector {_PLACES} %ends_, {_PLACES} poison, <{LANES} x i32> zeroinitializer
br label %group
group:
%first = phi i64 [0, %entry], [%next, %done]
%firsts_ = insertelement {_PLACES} poison, i64 %first, i32 0
%firsts = shufflevector {_PLACES} %firsts_, {_PLACES} poison, <{LANES} x i32> zeroinitializer
%lane = add {_PLACES} %firsts, <{", ".join(f"i64 {lane}" for lane in range(LANES))}>
%mask = icmp sle {_PLACES} %lane, %ends
%item = select {_MASK} %mask, {_PLACES} %lane, {_PLACES} %ends
{{group}}
br label %step
step:
%k = phi i64 [0, %group], [%after, %on]
{{step}}
%after = add i64 %k, 1
%more = icmp slt i64 %after, %steps
%all = icmp ne i64 %apart, 0
%last = xor i1 %more, true
%due = or i1 %all, %last
br i1 %due, label %show, label %on
show:
%far = mul i64 %k, %apart
{{show}}
br label %on
on:
br i1 %more, label %step, label %done
done:
{{done}}
%next = add i64 %first, {LANES}
%again = icmp slt i64 %next, %items
br i1 %again, label %group, label %exit
exit:
ret void
}}}}
"""
"""The loops.  The last group is filled up with the last item, and what is beyond it is not stored."""


def _text(place: Sequence[int], watched: int, read: Sequence[int], common: Collection[int], step: Step) -> str:
    """Return the loops around a step as LLVM reads them; what is in their table, `Loop.__call__` says."""
    written: dict[str, str] = {}

    def terms(name: str, size: int) -> np.ndarray:
        return np.array([TracedNumber(f"%{name}.{i}", written) for i in range(size)], dtype=object)

    now, seen = terms("now", read[0]), terms("seen", watched)
    becomes, then = step(now, seen, *(terms(f"m{j}", size) for j, size in enumerate(read[1:], start=1)))
    words = ["steps", "items", "apart", *(f"out.{i}" for i in range(len(place))), *(f"row.{i}" for i in range(watched))]
    once, group, show, done = [], [], [], []
    for j, size in enumerate(read):
        words += [f"stride{j}", *(f"m{j}.{i}" for i in range(size))]
        if j - 1 in common:
            for i in range(size):
                once += [f"%number{j}.{i} = load double, ptr %in.m{j}.{i}"]
                once += _spread(f"%m{j}.{i}", "double", f"%number{j}.{i}")
            continue
        group += [*_spread(f"%each{j}", "i64", f"%stride{j}"), f"%far{j} = mul {_PLACES} %item, %each{j}"]
        for i in range(size):
            group += [
                f"%at{j}.{i} = getelementptr i8, ptr %in.m{j}.{i}, {_PLACES} %far{j}",
                f"%m{j}.{i} = call {_NUMBERS} {_GATHER}"
                f"({_POINTERS} %at{j}.{i}, i32 8, {_MASK} splat (i1 true), {_NUMBERS} poison)",
            ]
    for i, term in enumerate(then):
        group += [
            f"%kept.{i} = getelementptr double, ptr %in.row.{i}, i64 %first",
            f"%was.{i} = load {_NUMBERS}, ptr %kept.{i}, align 8",
        ]
        done.append(f"store {_NUMBERS} {term.name}, ptr %kept.{i}, align 8")
    for i, which in enumerate(place):
        show += [
            f"%to.{i} = getelementptr double, ptr %in.out.{i}, i64 %first",
            f"%here.{i} = getelementptr i8, ptr %to.{i}, i64 %far",
            f"call void {_STORE}({_NUMBERS} {becomes[which].name}, ptr %here.{i}, i32 8, {_MASK} %mask)",
        ]
    entry = []
    for at, word in enumerate(words):
        name, kind = (f"in.{word}", "ptr") if "." in word else (word, "i64")
        entry += [f"%word.{at} = getelementptr i64, ptr %table, i64 {at}", f"%{name} = load {kind}, ptr %word.{at}"]
    body = [
        f"%{name}.{i} = phi {_NUMBERS} [%{before}.{i}, %group], [{term.name}, %on]"
        for name, before, after in (("now", "m0", becomes), ("seen", "was", then))
        for i, term in enumerate(after)
    ]
    body += [f"{name} = {text}" for text, name in written.items()]
    parts = {"entry": entry + once, "group": group, "step": body, "show": show, "done": done}
    return _FRAME.format(**{part: "\n".join(lines) for part, lines in parts.items()})


def _spread(name: str, kind: str, value: str) -> list[str]:
    """Write one number into every lane."""
    vector = f"<{LANES} x {kind}>"
    return [
        f"{name}.one = insertelement {vector} poison, {kind} {value}, i32 0",
        f"{name} = shufflevector {vector} {name}.one, {vector} poison, <{LANES} x i32> zeroinitializer",
    ]


@lru_cache(maxsize=1)
def installed() -> bool:
    """Whether there is a compiler."""
    return find_spec("llvmlite") is not None


def pays(work: int, products: int) -> bool:
    """Whether to compile.

    Parameters
    ----------
    work : steps of items that are asked for.
    products : products in a step.

    Raises
    ------
    UsageError
        If the environment variable says neither 0 nor 1.
    """
    said = os.environ.get(SWITCH, "")
    if said not in ("", "0", "1"):
        raise UsageError(f"{SWITCH}: expected 0 (never) or 1 (always), got '{said}'")
    if said == "0" or products > MOST or not installed():
        return False
    return said == "1" or work >= max(LEAST, LEAST_EACH * products)


def state() -> str:
    """Return in words when many filters run compiled."""
    if not installed():
        return "not installed"
    return {"0": f"off ({SWITCH}=0)", "1": f"always ({SWITCH}=1)"}.get(os.environ.get(SWITCH, ""), "for much work")
