"""Messages of live agents: what they carry, their bytes, and why one is refused.

A message of agent i at step k carries nodes, the first of them i's own of that step.  A node is an estimate (or what
was measured) with the name of who made it, the step, and for every agent the latest step that it rests on; since what
rests on an estimate rests on all that its maker had before, such a vector says the whole pedigree:

    (j, s) is an ancestor of a node, or the node itself   ⇔   s ≤ known[j]

Who made a node is an agent in one of its lives: an agent that was started again from what it had saved does not go on
under the old name, for others may have heard what it no longer knows.

**Bytes** (little endian; a varint has 7 bits a byte, low ones first):

    "SF", version, matrices m, CRC-32 of the estimator's name, agents, dimension d, step, number of lives B, of nodes N
    B times    varints: agent, life, latest step T of that life that any node of the message knows
    N times    varints: whose life, T − step, and for every other life T − known (T where nothing is known)
    N times    d + m·d(d+1)/2 numbers of 8 bytes: y and Y, or x and P (and the part of P that is independent)
    CRC-32 of all that

Nothing is taken from a message before its length and checksum are right, nothing is allocated for more than its length
can hold, and what it says must be possible: steps in order, pedigrees that hold what they rest on, finite numbers,
definite matrices.  The checksum finds what was damaged, not who lies: a sender that makes sound messages is believed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import MessageError, UsageError, nearest

MAGIC, VERSION = b"SF", 1
HEAD, SUM = struct.Struct("<2sBBIHHIHH"), struct.Struct("<I")
LATEST_STEP, LARGEST = 2**32 - 1, 1e150
CARRIES = ("full", "acknowledged", "own", "window")
MISSING = ("wait", "intersect")
MOST_HORIZON, LIVES = 500, 64
"""Largest horizon, and lives of an agent that are told apart; what comes of later ones is refused."""


class Life(NamedTuple):
    """An agent, counted from 0, between two starts; `number` is 0 for its first life."""

    agent: int
    number: int


Name = tuple[Life, int]
"""What tells a node from all others: who made it, and at which step."""


class Node(NamedTuple):
    """An estimate, or what was measured, of an agent at a step.

    Parameters
    ----------
    life, step : who made it and when.
    known : latest step of every life that it rests on, its own among them.
    v : (d, columns) information vector y, or state x.
    M : (d, d) information Y, or covariance P; and what of P is independent of all else, where that is told.
    """

    life: Life
    step: int
    known: Mapping[Life, int]
    v: np.ndarray
    M: tuple[np.ndarray, ...]

    @property
    def name(self) -> Name:
        """What tells it from all others."""
        return self.life, self.step


class Kind(NamedTuple):
    """What all messages of a network have in common.

    Parameters
    ----------
    estimator : its name.
    dimensions : of every agent's estimates.
    matrices : of every node.
    definite : whether the first of these must be definite.
    most : nodes that a message may have.
    """

    estimator: str
    dimensions: tuple[int, ...]
    matrices: int = 1
    definite: bool = True
    most: int = 10_000

    @property
    def code(self) -> int:
        """Number of the estimator."""
        return zlib.crc32(self.estimator.encode())


@dataclass(frozen=True)
class MessageProtocol:
    """What messages carry, and what is done where that is too little.

    Parameters
    ----------
    carries : "full": all that a later search may meet; "acknowledged": of that, what is not known to be known to all
        hearers; "own": of that, the sender's own nodes; "window": the nodes of the last `window` steps.
    window : steps, this one included.
    horizon : steps after which an agent that was not heard of is no longer waited for, and nodes are forgotten.
    missing : what is done with a node whose common information with what is known rests on nodes that are not there:
        "wait": it is left until they come, unless nobody will send them any more; then, and with "intersect" at once,
        it is fused by covariance intersection, as if nothing were known of what it shares.
    """

    carries: str = "acknowledged"
    window: int = 0
    horizon: int = 32
    missing: str = "wait"

    def __post_init__(self) -> None:
        for name, value, names in (("carries", self.carries, CARRIES), ("missing", self.missing, MISSING)):
            if value not in names:
                raise UsageError(f"{name}: expected {', '.join(names)}, got '{value}'{nearest(value, names)}")
        if not 1 <= self.horizon <= MOST_HORIZON:
            raise UsageError(f"horizon: expected 1 to {MOST_HORIZON} steps, got {self.horizon}")
        if self.carries == "window" and not 1 <= self.window <= self.horizon:
            raise UsageError(f"window: expected 1 to {self.horizon} steps (the horizon), got {self.window}")

    @classmethod
    def of(cls, given: str | MessageProtocol) -> MessageProtocol:
        """Read `full`, `acknowledged`, `own` or `window:W`.

        Raises
        ------
        UsageError
            If it is something else.
        """
        if isinstance(given, MessageProtocol):
            return given
        name, colon, steps = str(given).partition(":")
        if (name == "window") != bool(colon) or name not in CARRIES or (colon and not steps.isdecimal()):
            expected = "full, acknowledged, own or window:W (W steps)"
            raise UsageError(f"protocol: expected {expected}, got '{given}'{nearest(name, CARRIES)}")
        return cls(name, int(steps or 0))

    def __str__(self) -> str:
        return f"window:{self.window}" if self.carries == "window" else self.carries


def encode(nodes: Sequence[Node], kind: Kind) -> bytes:
    """Return the bytes of some nodes, the sender's own first; of states with several columns those of the first."""
    latest: dict[Life, int] = {}
    for node in nodes:
        for life, step in node.known.items():
            latest[life] = max(step, latest.get(life, 0))
    first, d = nodes[0], len(nodes[0].v)
    lives = {life: place for place, life in enumerate(sorted(latest))}
    body = bytearray()
    for life in lives:
        _write(body, life.agent, life.number, latest[life])
    for node in nodes:
        _write(body, lives[node.life], latest[node.life] - node.step)
        _write(body, *(step - node.known.get(life, 0) for life, step in sorted(latest.items()) if life != node.life))
    upper = np.triu_indices(d)
    numbers = [part for node in nodes for part in (node.v[:, 0], *(M[upper] for M in node.M))]
    body += np.concatenate(numbers).astype("<f8").tobytes()
    sizes = (len(kind.dimensions), d, first.step, len(lives), len(nodes))
    whole = HEAD.pack(MAGIC, VERSION, kind.matrices, kind.code, *sizes) + body
    return whole + SUM.pack(zlib.crc32(whole))


def decode(data: Any, kind: Kind) -> list[Node]:
    """Read the nodes of a message, the sender's own first.

    Raises
    ------
    MessageError
        If the bytes are no message of this kind, or say what cannot be.
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise MessageError(f"message: expected bytes, got {type(data).__name__}")
    data = bytes(data) if len(data) < _longest(kind) else _refuse(f"at most {_longest(kind)} bytes", len(data))
    if len(data) < HEAD.size + SUM.size:
        _refuse(f"at least {HEAD.size + SUM.size} bytes", len(data))
    magic, version, matrices, code, agents, d, step, B, N = HEAD.unpack_from(data)
    if magic != MAGIC or version != VERSION:
        _refuse(f"version {VERSION} of a message", f"version {version}" if magic == MAGIC else "other bytes")
    if SUM.unpack_from(data, len(data) - SUM.size)[0] != zlib.crc32(data[: -SUM.size]):
        _refuse("bytes that fit their checksum", "damaged ones")
    if (code, matrices, agents) != (kind.code, kind.matrices, len(kind.dimensions)):
        _refuse(f"{len(kind.dimensions)} agents with estimator {kind.estimator}", "another network's or estimator's")
    width = d + matrices * d * (d + 1) // 2
    least = HEAD.size + 3 * B + N * (1 + B + 8 * width) + SUM.size
    if not 1 <= N <= kind.most or not 1 <= B <= LIVES * agents or len(data) < least or not d:
        _refuse(f"1 to {kind.most} nodes that fit into {len(data)} bytes", f"{N} of {B} lives")
    reader = _VarintReader(data, HEAD.size, len(data) - SUM.size)
    latest = {Life(reader.next(), reader.next()): reader.next() for _ in range(B)}
    lives = list(latest)
    if len(lives) != B or any(life.agent >= agents for life in lives) or not all(latest.values()):
        _refuse(f"each life of {agents} agents once, at some step", "others")
    known, names = _pedigrees(reader, N, latest)
    if names[0][1] != step or kind.dimensions[names[0][0].agent] != d:
        _refuse(f"a first node of step {step} and its agent's dimension", f"step {names[0][1]}, dimension {d}")
    if reader.place + 8 * N * width != reader.end:
        _refuse(f"{8 * N * width} bytes of numbers", reader.end - reader.place)
    block = np.frombuffer(data, "<f8", N * width, reader.place).reshape(N, width)
    v, M = _numbers(block, d, kind)
    vectors = [{life: k for life, k in zip(lives, row, strict=True) if k} for row in known.tolist()]
    return [Node(*names[i], vectors[i], v[i], tuple(M[i])) for i in range(N)]


def _pedigrees(reader: _VarintReader, nodes: int, latest: Mapping[Life, int]) -> tuple[np.ndarray, list[Name]]:
    """What every node knows of every life, (N, B), and the nodes' names, seen to be possible."""
    lives, last = list(latest), np.array(list(latest.values()), dtype=np.int64)
    known, whose = np.empty((nodes, len(lives)), dtype=np.int64), np.empty(nodes, dtype=np.int64)
    for i in range(nodes):
        whose[i] = own = reader.next()
        if own >= len(lives):
            _refuse(f"a node of one of {len(lives)} lives", own)
        back = reader.next()
        known[i] = last - [back if place == own else reader.next() for place in range(len(lives))]
    steps = known[np.arange(nodes), whose]
    others = known - np.where(np.arange(len(lives)) == whose[:, None], 1, 0)
    if (known < 0).any() or (steps < 1).any() or (others >= steps[:, None]).any():
        _refuse("nodes that rest on earlier ones", "steps out of order")
    complete = True
    for life in range(len(lives)):
        # whoever knows a node knows what that rests on
        mine = np.flatnonzero(whose == life)
        mine = mine[np.argsort(steps[mine], kind="stable")]
        latest_known = known[:, life] - (whose == life)
        at = np.searchsorted(steps[mine], latest_known, side="right") - 1
        there = np.flatnonzero(at >= 0)
        below = known[mine[at[there]]]
        complete &= not (below > known[there]).any()
    names = [(lives[life], step) for life, step in zip(whose.tolist(), steps.tolist(), strict=True)]
    if not complete or len(set(names)) < nodes:
        _refuse("pedigrees that hold what they rest on", "others")
    return known, names


def _numbers(block: np.ndarray, d: int, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (N, d, 1) and matrices (N, m, d, d), seen to be finite and definite."""
    if not (np.abs(block) <= LARGEST).all():  # NaN is not
        _refuse("finite numbers", "NaN, infinite or huge ones")
    rows, columns = np.triu_indices(d)
    M = np.empty((len(block), kind.matrices, d, d))
    M[..., rows, columns] = M[..., columns, rows] = block[:, d:].reshape(len(block), kind.matrices, -1)
    first = M[:, 0]
    if kind.definite:
        fine = smallest(first) > 0
        if kind.matrices > 1:
            scale = first.diagonal(axis1=1, axis2=2)
            fine &= (smallest(M[:, 1], scale) > -1e-9) & (smallest(first - M[:, 1], scale) > -1e-9)
    else:
        diagonal = first.diagonal(axis1=1, axis2=2)  # what measures nothing has zeros there
        fine = smallest(first, np.where(diagonal == 0, 1.0, diagonal)) > -1e-9
    if not fine.all():
        _refuse("definite matrices", "an indefinite one")
    return block[:, :d, None].copy(), M


def smallest(M: np.ndarray, scale: np.ndarray | None = None) -> np.ndarray:
    """Smallest eigenvalue of each matrix (N, d, d) in units of its diagonal, or another; −1 where that is none."""
    scale = M.diagonal(axis1=1, axis2=2) if scale is None else scale
    fine = np.asarray((scale > 1 / LARGEST).all(axis=1))
    root = np.sqrt(np.where(fine[:, None], scale, 1.0))
    scaled = M / root[:, :, None] / root[:, None, :]
    fine &= (np.abs(scaled) < 1e9).all(axis=(1, 2))
    return np.where(fine, np.linalg.eigvalsh(np.where(fine[:, None, None], scaled, 0.0))[:, 0], -1.0)


class _VarintReader:
    """Varints of a message, one after the other."""

    def __init__(self, data: bytes, place: int, end: int) -> None:
        self.data, self.place, self.end = data, place, end

    def next(self) -> int:
        """The next one."""
        value = shift = 0
        while self.place < self.end and shift < 35:
            byte = self.data[self.place]
            self.place, value, shift = self.place + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value if value <= LATEST_STEP else _refuse("numbers of 32 bits", value)
        return _refuse("whole varints", "one that does not end")


def _write(out: bytearray, *numbers: int) -> None:
    for number in numbers:
        while number > 127:
            out.append(number & 127 | 128)
            number >>= 7
        out.append(number)


def _longest(kind: Kind) -> int:
    """Bytes that the longest message cannot reach."""
    d, lives = max(kind.dimensions), LIVES * len(kind.dimensions)
    return HEAD.size + 15 * lives + kind.most * (10 + 5 * lives + 8 * (d + kind.matrices * d * (d + 1) // 2)) + 5


def _refuse(expected: str, got: Any) -> Any:
    raise MessageError(f"message: expected {expected}, got {got}")
