"""Link probabilities from what people have: packet logs, ratios, matrices and edge lists.

Of n packets that a sender sent while a receiver listened s arrived: µ̂ = s/n, and the Jeffreys posterior
Beta(s + ½, n − s + ½) gives the interval.  A link of which nothing is known is unknown (NaN), never 0; a receiver
that listened and heard nothing of n packets is 0 of n.

Whether a link has a memory, and which two states explain it: `stochfuse.scenario.link_memory`.

Files are known by their headers: logs `seq,sender,receiver,received` or, of received packets alone,
`seq,sender,receiver` (the numbers between a sender's first and last were sent; a counter of 16 bits may wrap);
Mercator raw logs; k7 files of ratios; edge lists `receiver,sender,link`; matrices with the nodes' names in the first
row and column, receivers downwards.  Arrow reads them where it is installed (extra `study`), else Python's own csv.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stochfuse.errors import Problem, ScenarioError, StochfuseError, UsageError, nearest, needed
from stochfuse.scenario.link_memory import MEMORY as MEMORY
from stochfuse.scenario.link_memory import memory_of
from stochfuse.scenario.result import Result

if TYPE_CHECKING:
    from stochfuse.scenario.radio import Radio

CONFIDENCE = 0.95
LONGEST_LINE = 1 << 20
"""Letters of a line of text beyond which a file is none of these."""
MOST_PACKETS = 50_000_000
"""Packets that are told apart where a log has the received ones alone."""
WRAP = 1 << 16
LARGEST = float(1 << 53)
"""Whole numbers up to which a file's are told apart."""
NOTHING = ("", "nan", "None", "<NA>", "NaT")
"""What an empty cell says as text, in a file and in the several kinds of frames."""
COLUMNS = ("seq", "sender", "receiver", "received", "time", "sent_time", "received_time", "rssi", "link")


@dataclass(frozen=True, eq=False, repr=False)
class Links(Result):
    """What is known of the links between nodes.

    Parameters
    ----------
    source, kind : the file's name, and what it was taken for.
    nodes : names.
    link : (receiver, sender) estimated probability, or (steps, receiver, sender) where a scenario's vary; NaN where
        nothing is known, and on the diagonal.
    low, high : the same, ends of the 95 % interval; NaN where no number of packets is known.
    sent, received : the same, numbers of packets; None where only ratios are known.
    memory : the same, likelihood ratio for memory; None where packets have no order.
    burst : fitted two-state models, by (receiver, sender) from 0, where a link has memory.
    delay : probabilities of 0, 1, … steps, or None.
    notes : what the reader should know.
    architecture, steps : of a scenario; the least that a log says.
    places : of a scenario's agents, (D,) or (steps, D) in m each; empty where they are not given.
    radio : what a scenario's links come from, or None.
    cases : a scenario's named alternatives, each an array like `link`.
    """

    source: str
    kind: str
    nodes: tuple[str, ...]
    link: np.ndarray
    low: np.ndarray
    high: np.ndarray
    sent: np.ndarray | None = None
    received: np.ndarray | None = None
    memory: np.ndarray | None = None
    burst: Mapping[tuple[int, int], Mapping[str, float]] | None = None
    delay: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()
    architecture: str = "ad-hoc"
    steps: int | None = None
    places: tuple[np.ndarray, ...] = ()
    radio: Radio | None = None
    cases: tuple[tuple[str, np.ndarray], ...] = ()

    @property
    def varies(self) -> bool:
        """Whether the links depend on the step."""
        return self.link.ndim == 3

    @property
    def moves(self) -> bool:
        """Whether some agent is on its way."""
        return any(place.ndim == 2 for place in self.places)

    @property
    def unknown(self) -> list[tuple[str, str]]:
        """Receiver and sender of links of which nothing is known."""
        off = ~np.eye(len(self.nodes), dtype=bool)
        return [(self.nodes[i], self.nodes[j]) for i, j in np.argwhere(np.isnan(self.link) & off)[:, -2:]]

    @property
    def hears(self) -> list[list[int]]:
        """Whom each node is known to hear, well or badly, numbered from 1: network.hears of a scenario."""
        off = ~np.eye(len(self.nodes), dtype=bool)
        return [(np.flatnonzero(row) + 1).tolist() for row in ~np.isnan(self.link) & off]

    def of(self, nodes: Sequence[str]) -> Links:
        """Return the links between some of the nodes, in that order.

        Raises
        ------
        UsageError
            If a node is not there, or named twice.
        """
        for node in nodes:
            if node not in self.nodes:
                known = ", ".join(self.nodes)
                raise UsageError(f"nodes: expected some of {known}, got '{node}'{nearest(node, self.nodes)}")
        if len(set(nodes)) < len(nodes):
            raise UsageError(f"nodes: expected different ones, got {', '.join(nodes)}")
        places = [self.nodes.index(node) for node in nodes]
        burst = self.burst and {
            (places.index(i), places.index(j)): fit for (i, j), fit in self.burst.items() if {i, j} <= set(places)
        }
        square = (..., *np.ix_(places, places))
        counts = (None if M is None else M[square] for M in (self.sent, self.received, self.memory))
        sent, received, memory = counts
        return replace(
            self,
            nodes=tuple(nodes),
            link=self.link[square],
            low=self.low[square],
            high=self.high[square],
            sent=sent,
            received=received,
            memory=memory,
            burst=burst or None,
            places=tuple(self.places[i] for i in places) if self.places else (),
            cases=tuple((name, link[square]) for name, link in self.cases),
        )


def links_of_table(source: Any, **how: Any) -> Links:
    """Return what is known of links from a table that has a file's columns.

    Parameters
    ----------
    source : columns by name: a mapping, a frame of pandas or polars, a table of Arrow; or a pandas frame that is a
        matrix µ_ij (index: receivers, columns: senders, the same names), NaN where nothing is known.
    **how : columns, sent, step; see `read_links`.

    Raises
    ------
    UsageError
        If it is none of these; with line and column.
    """
    if hasattr(source, "index") and hasattr(source, "columns") and list(source.index) == list(source.columns):
        return _frame_matrix(source)
    return _of_columns("table", _columns(source), **how)


def _columns(table: Any) -> dict[str, Any]:
    """Columns by name, of whatever has them."""
    for names in ("column_names", "columns"):  # Arrow's; those of pandas and polars
        if hasattr(table, names):
            return {str(name): table[name] for name in getattr(table, names)}
    if not isinstance(table, Mapping):
        raise UsageError(f"links: expected a path, or a table with columns by name, got {type(table).__name__}")
    found = {str(name): column for name, column in table.items()}
    lengths = {name: len(column) if hasattr(column, "__len__") else 1 for name, column in found.items()}
    if len(set(lengths.values())) > 1:
        got = ", ".join(f"{length} of {name}" for name, length in lengths.items())
        raise UsageError(f"links: expected columns of one length, got {got}")
    return found


def _frame_matrix(frame: Any) -> Links:
    """Links of a square frame with the same names on both sides; unnamed nodes are numbered from 1."""
    names = [str(name) for name in frame.columns]
    if names == [str(i) for i in range(len(names))]:
        names = [str(i + 1) for i in range(len(names))]
    cells = [["" if value != value else str(value) for value in row] for row in frame.to_numpy(dtype=object)]
    return _matrix("table", names, names, cells)


def as_network(
    found: Links, network: Mapping[str, Any], name: str, key: str = "network.link", *, silent: bool = False
) -> dict[str, Any]:
    """Return a scenario's [network] with links that are known in the place of what names them.

    Parameters
    ----------
    network : its other keys; `nodes` picks some of the nodes, in that order, `hears` says which links there are.
    name, key : the scenario's name and the key that holds the links, for messages.
    silent : whether nothing is heard on links that are unknown, where `hears` is not given.

    Raises
    ------
    ScenarioError
        If they do not fit the agents, or leave a link unknown that may be heard.
    """
    nodes, agents = network.get("nodes"), network.get("agents")
    try:
        found = found.of([str(node) for node in nodes]) if isinstance(nodes, list) else found
    except UsageError as error:
        raise ScenarioError(name, [Problem(key, "links of network.nodes", f"({error})")]) from None
    if silent and found.unknown and "hears" not in network:
        network = {**network, "hears": found.hears}
    n, link, hears = len(found.nodes), found.link.copy(), network.get("hears")
    if agents is not None and agents != n:
        raise ScenarioError(name, [Problem("network.agents", f"{n}, the nodes of {found.source}", str(agents))])
    if found.steps is not None and (found.burst or found.cases):
        raise ScenarioError(name, [Problem(key, "one probability for each link", "bursts or cases of a scenario")])
    for i, j in np.argwhere(np.isnan(link))[:, -2:].tolist():
        if i != j and not (isinstance(hears, list) and i < len(hears) and j + 1 not in (hears[i] or [])):
            expected = "links that are all known, or network.hears without the unknown ones"
            raise ScenarioError(
                name, [Problem(key, expected, f"nothing known of {found.nodes[j]} to {found.nodes[i]}")]
            )
        link[..., i, j] = 0.0
    made = {**network, "agents": n, "nodes": list(found.nodes), "link": link.tolist()}
    if found.delay is not None:
        made.setdefault("delay", list(found.delay))
    if found.sent is not None and found.received is not None:
        made |= {"sent": found.sent.tolist(), "received": found.received.tolist()}
    return made


def read_links(
    source: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    sent: int | None = None,
    step: float | None = None,
) -> Links:
    """Read a file of links.

    Parameters
    ----------
    columns : the file's names of columns, by ours.
    sent : packets behind each ratio of a k7 file that does not say.
    step : seconds in a step, for delays.

    Raises
    ------
    UsageError
        If the file is none of these; with line and column.
    StochfuseError
        If it is Parquet, and pyarrow is not installed.
    """
    name, text, table = _opened(source)
    if table is None and text.lstrip("\ufeff").startswith("{"):
        text = text.partition("\n")[2]
    return _of_columns(name, _table(name, text) if table is None else table, columns=columns, sent=sent, step=step)


def _of_columns(
    name: str,
    table: dict[str, Any],
    *,
    columns: Mapping[str, str] | None = None,
    sent: int | None = None,
    step: float | None = None,
) -> Links:
    """Links of a table, which its columns tell apart."""
    table = _renamed(name, table, columns or {})
    known = set(table)
    if {"mac", "srcmac"} <= known:
        return _mercator(name, table)
    if {"src", "dst", "pdr"} <= known:
        return _k7(name, table, sent)
    if {"receiver", "sender", "link"} <= known:
        return _edges(name, table)
    if {"sender", "receiver"} <= known and ({"seq"} <= known or {"received"} <= known):
        return links_of_packets(table, source=name, step=step)
    rows = _matrix_rows(table)
    if rows is not None:
        return _matrix(name, *rows)
    raise UsageError(
        f"{name}: expected columns seq, sender, receiver, received (a packet log) or receiver, sender, link (an edge "
        f"list), or a matrix with names in its first row and column; got {', '.join(list(table)[:8])}; --columns, "
        "or in a scenario columns beside file, names others"
    )


def _opened(source: str | Path) -> tuple[str, str, dict[str, list[Any]] | None]:
    path, raw = Path(source), b""
    try:
        if path.suffix.lower() == ".parquet":
            found = _arrow("pyarrow.parquet").read_table(path)
            return str(path), "", {column: found[column].to_pylist() for column in found.column_names}
        raw = path.read_bytes()
        raw = gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw
        text = raw.decode("utf-8")
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise UsageError(f"{path}: expected a file, got a directory") from None
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise UsageError(
            f"{path}, line {line}: expected text in UTF-8, got byte {error.object[error.start]:#04x}"
        ) from None
    except (OSError, EOFError, ValueError) as error:
        raise UsageError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not text.strip():
        raise UsageError(f"{path}: expected links, got an empty file")
    return str(path), text, None


def _table(name: str, text: str) -> dict[str, Any]:
    """Columns of text by their names."""
    text = text.lstrip("\ufeff")
    header = text.partition("\n")[0].rstrip("\r")
    if len(header) > LONGEST_LINE:
        raise UsageError(f"{name}, line 1: expected a line of headings, got {len(header):,} letters")
    heads = [_one_line(head).strip('"') for head in header.split(",")]
    if len(set(heads)) < len(heads):
        raise UsageError(f"{name}, line 1: expected different headings, got {header[:80]}")
    try:
        arrow, arrow_csv = _arrow("pyarrow"), _arrow("pyarrow.csv")
    except StochfuseError:
        return _by_csv(name, text, heads)
    try:
        found = arrow_csv.read_csv(
            io.BytesIO(text.encode()),
            read_options=arrow_csv.ReadOptions(column_names=heads, skip_rows=1, block_size=LONGEST_LINE * 16),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(heads, arrow.string()), strings_can_be_null=False
            ),
        )
    except arrow.ArrowInvalid as error:
        raise UsageError(f"{name}{_torn(text, len(heads)) or f': {_one_line(str(error))[:160]}'}") from None
    return {head: found[head] for head in heads}


def _by_csv(name: str, text: str, heads: list[str]) -> dict[str, Any]:
    torn = _torn(text, len(heads))
    if torn:
        raise UsageError(f"{name}{torn}")
    rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row][1:]
    return {head: np.array([row[i] for row in rows], dtype=str) for i, head in enumerate(heads)}


def _torn(text: str, columns: int) -> str:
    """Where a text ceases to be a table of so many columns; empty if it does not."""
    rows = csv.reader(io.StringIO(text, newline=""))
    try:
        for row in rows:
            if row and len(row) != columns:
                return f", line {rows.line_num}: expected {columns} columns, got {len(row)}"
    except csv.Error:
        return f", line {rows.line_num + 1}: expected {columns} columns, got no text of a table"
    return ""


def _renamed(name: str, table: dict[str, Any], columns: Mapping[str, str]) -> dict[str, Any]:
    for ours, theirs in columns.items():
        if ours not in COLUMNS:
            raise UsageError(f"columns: expected one of {', '.join(COLUMNS)}, got '{ours}'{nearest(ours, COLUMNS)}")
        if theirs not in table:
            raise UsageError(
                f"columns: {name} has no column '{theirs}'{nearest(theirs, table)}; it has {', '.join(table)}"
            )
    theirs = {given: ours for ours, given in columns.items()}
    return {theirs.get(head, head): column for head, column in table.items()}


def links_of_packets(table: Mapping[str, Any], *, source: str = "table", step: float | None = None) -> Links:
    """Return the links of a packet log, a row for each packet or for each that was received.

    Parameters
    ----------
    table : columns by name: sender, receiver, and seq or received or both; a pandas DataFrame will do.
    step : seconds in a step, for delays from sent_time and received_time.

    Raises
    ------
    UsageError
        If a value is none that its column can have; with the line.
    """
    nodes, s, r = _nodes(source, table, "sender", "receiver")
    n = len(nodes)
    if not n:
        raise UsageError(f"{source}: expected packets, got no rows")
    seq = _numbers(source, table, "seq", whole=True) if "seq" in table else None
    if seq is not None:
        _refuse(source, "seq", seq, seq < 0, "a number of at least 0")
    pair = r * n + s
    if "received" in table:
        found = _of_all(source, table, pair, seq, n)
    elif seq is not None:
        found = _of_received(pair, _unwrapped(s, seq, table, source), n)
    else:
        raise UsageError(f"{source}: expected a column seq or received, got neither")
    memory, burst = (None, None) if found.packets is None else memory_of(*found.packets, n)
    more = {"memory": memory, "burst": burst, "delay": _delays(source, table, step), "notes": found.notes}
    return _counted(source, "packet log", nodes, found.sent, found.heard, **more)


class _Packets(NamedTuple):
    """What a log says of packets: how many were sent and heard, (receiver, sender), and of each, link by link.

    Parameters
    ----------
    packets : link, number and arrival of every packet; None where they have no order, or are too many.
    """

    sent: np.ndarray
    heard: np.ndarray
    packets: tuple[np.ndarray, np.ndarray, np.ndarray] | None
    notes: tuple[str, ...]


def _of_all(source: str, table: Mapping[str, Any], pair: np.ndarray, seq: np.ndarray | None, n: int) -> _Packets:
    """Of a log of all packets, received or not."""
    got = _numbers(source, table, "received", whole=True)
    _refuse(source, "received", got, (got != 0) & (got != 1), "0 or 1")
    got, again = got.astype(bool), 0
    if seq is not None:
        # a packet that is reported twice was sent once, and arrived if it arrived once
        key, where = _distinct(pair, seq)
        arrived = np.zeros(len(key), dtype=bool)
        arrived[where[got]] = True
        again = len(pair) - len(key)
        pair, seq, got = key[:, 0], key[:, 1], arrived
    sent = np.bincount(pair, minlength=n * n).reshape(n, n)
    heard = np.bincount(pair, got, minlength=n * n).reshape(n, n).astype(int)
    notes = _repeated(again)
    if got.all():
        notes += ("no packet of the log is lost; if it has those that arrived alone, leave out its column received",)
    return _Packets(sent, heard, None if seq is None else (pair, seq, got), notes)


def _of_received(pair: np.ndarray, seq: np.ndarray, n: int) -> _Packets:
    """Of a log of received packets alone: what was sent is told by the numbers of those that anybody received."""
    key, _ = _distinct(pair, seq)
    heard = np.bincount(key[:, 0], minlength=n * n).reshape(n, n)
    first, last = np.full(n, np.iinfo(int).max), np.full(n, -1)
    np.minimum.at(first, pair % n, seq)
    np.maximum.at(last, pair % n, seq)
    listened = heard.sum(axis=1) > 0
    sent = np.where(listened[:, None], np.maximum(last - first + 1, 0)[None], 0)
    np.fill_diagonal(sent, 0)
    note = "only received packets are logged: what each sender sent is taken from its first to its last number"
    packets = None
    if 0 < sent.sum() <= MOST_PACKETS:
        links = np.flatnonzero(sent.ravel() > 0)
        counts = sent.ravel()[links]
        begins = np.cumsum(counts) - counts
        arrived = np.zeros(counts.sum(), dtype=bool)
        place = np.searchsorted(links, key[:, 0])
        arrived[begins[place] + key[:, 1] - first[key[:, 0] % n]] = True
        numbers = np.arange(len(arrived)) - np.repeat(begins, counts)
        packets = np.repeat(links, counts), numbers, arrived
    return _Packets(sent, heard, packets, (*_repeated(len(pair) - len(key)), note))


def _repeated(again: int) -> tuple[str, ...]:
    return (f"{again:,} rows repeat a packet; each is counted once",) if again else ()


def _counted(
    source: str, kind: str, nodes: Sequence[str], sent: np.ndarray, received: np.ndarray, **more: Any
) -> Links:
    low, high = jeffreys(sent, received)
    link = np.divide(received, sent, out=np.full(sent.shape, np.nan), where=sent > 0)
    return Links(source, kind, tuple(map(str, nodes)), link, low, high, sent, received, **more)


def _uncounted(source: str, kind: str, nodes: Sequence[str], link: np.ndarray, **more: Any) -> Links:
    """Links of which no number of packets is known, and so no interval."""
    unknown = np.full_like(link, np.nan)
    return Links(source, kind, tuple(nodes), link, unknown, unknown, **more)


def jeffreys(sent: np.ndarray, received: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the 95 % interval of each link's probability from its numbers of packets; NaN where none was sent."""
    from scipy.special import betaincinv

    tail = (1 - CONFIDENCE) / 2
    a, b = received + 0.5, sent - received + 0.5
    low, high = (np.where(sent > 0, betaincinv(a, b, q), np.nan) for q in (tail, 1 - tail))
    return low, high


def _mercator(name: str, table: Mapping[str, Any]) -> Links:
    good = np.ones(len(_words(name, table, "mac")), dtype=bool)
    for flag in ("crc", "expected"):
        if flag in table:
            good &= _words(name, table, flag) == "1"
    if not good.any():
        raise UsageError(f"{name}: expected received packets (crc and expected 1), got none")
    receiver, sender = _words(name, table, "mac")[good], _words(name, table, "srcmac")[good]
    turn, packet, number = (
        _numbers(name, table, column, whole=True, rows=good) for column in ("transctr", "pkctr", "txnumpk")
    )
    nodes, codes = np.unique(np.concatenate([sender, receiver]), return_inverse=True)
    n, (s, r) = len(nodes), np.split(codes, 2)
    key = np.unique(np.stack([r * n + s, turn, packet], axis=1), axis=0)
    heard = np.bincount(key[:, 0], minlength=n * n).reshape(n, n)
    turns, first = np.unique(np.stack([s, turn], axis=1), axis=0, return_index=True)
    of_sender = np.bincount(turns[:, 0], number[first], minlength=n).astype(int)
    sent = np.where((heard.sum(axis=1) > 0)[:, None], of_sender[None], 0)
    np.fill_diagonal(sent, 0)
    dropped = int((~good).sum())
    notes = (f"{dropped:,} rows that are no packets of the experiment are left out",) if dropped else ()
    return _counted(name, "Mercator raw log", nodes.tolist(), sent, np.minimum(heard, sent), notes=notes)


def _k7(name: str, table: Mapping[str, Any], sent: int | None) -> Links:
    nodes, s, r = _nodes(name, table, "src", "dst")
    ratio = _numbers(name, table, "pdr")
    _refuse(name, "pdr", ratio, ~((ratio >= 0) & (ratio <= 1)), "a ratio between 0 and 1")
    counts = _numbers(name, table, "tx_count", empty=np.nan) if "tx_count" in table else np.full(len(ratio), np.nan)
    counts = np.where(np.isnan(counts) if sent is not None else False, float(sent or 0), counts)
    n, pair = len(nodes), r * len(nodes) + s
    if np.isfinite(counts).all() and counts.sum() > 0:
        total = np.bincount(pair, counts, minlength=n * n).reshape(n, n)
        heard = np.bincount(pair, counts * ratio, minlength=n * n).reshape(n, n)
        return _counted(name, "k7 ratios", nodes, np.rint(total).astype(int), np.rint(heard).astype(int))
    rows = np.bincount(pair, minlength=n * n).reshape(n, n)
    mean = np.bincount(pair, ratio, minlength=n * n).reshape(n, n)
    link = np.divide(mean, rows, out=np.full((n, n), np.nan), where=rows > 0)
    note = "ratios without numbers of packets: no interval; --sent N says how many each stands for"
    return _uncounted(name, "k7 ratios", nodes, link, notes=(note,))


def _edges(name: str, table: Mapping[str, Any]) -> Links:
    nodes, s, r = _nodes(name, table, "sender", "receiver")
    values = _numbers(name, table, "link")
    _refuse(name, "link", values, ~((values >= 0) & (values <= 1)), "a probability between 0 and 1")
    link = np.full((len(nodes), len(nodes)), np.nan)
    _, first = np.unique(r * len(nodes) + s, return_index=True)
    again = np.ones(len(values), dtype=bool)
    again[first] = False
    _refuse(name, "link", values, again, "each link once")
    link[r, s] = values
    return _uncounted(name, "edge list", nodes, link)


def _matrix_rows(table: Mapping[str, Any]) -> tuple[list[str], list[str], list[list[str]]] | None:
    heads = list(table)
    columns = [[str(cell) for cell in _listed(table[head])] for head in heads]
    named = not heads[0] or set(heads[1:]) & {cell.strip() for cell in columns[0]}
    if len(heads) < 2 or len(columns[0]) != len(heads) - 1 or not named:
        return None
    return columns[0], heads[1:], [list(row) for row in zip(*columns[1:], strict=True)]


def _matrix(name: str, rows: list[str], heads: list[str], cells: list[list[str]]) -> Links:
    rows, heads = [r.strip() for r in rows], [h.strip() for h in heads]
    if rows != heads:
        got = f"{', '.join(rows[:4])} … and {', '.join(heads[:4])} …"
        raise UsageError(f"{name}: expected the same names in the first row and column, got {got}")
    link = np.full((len(rows), len(rows)), np.nan)
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            if i == j or not cell.strip():
                continue
            try:
                link[i, j] = float(cell)
            except ValueError:
                link[i, j] = -1
            if not 0 <= link[i, j] <= 1:
                where, got = f"{name}, line {i + 2}, column '{heads[j]}'", cell.strip()[:40]
                raise UsageError(f"{where}: expected a probability between 0 and 1, got '{got}'")
    return _uncounted(name, "matrix", rows, link)


def _listed(column: Any) -> list[Any]:
    return column.to_pylist() if hasattr(column, "to_pylist") else list(column)


def _words(name: str, table: Mapping[str, Any], column: str) -> np.ndarray:
    names, codes = _coded(name, table, column)
    return np.array(names)[codes]


def _numbers(
    name: str,
    table: Mapping[str, Any],
    column: str,
    *,
    whole: bool = False,
    empty: float | None = None,
    rows: Any = slice(None),
) -> np.ndarray:
    """Numbers of a column; with `whole` integers; an empty cell is `empty`, or refused."""
    given = table[column]
    if hasattr(given, "dictionary_encode"):
        given = _cast(given)
    raw = given.to_numpy() if hasattr(given, "to_numpy") else np.asarray(given)
    raw = _seconds(given, raw)
    if raw.dtype.kind in "biuf":
        values = raw.astype(float)
    else:
        words = np.asarray(raw).astype(str)
        words = np.where(np.isin(np.char.strip(words), NOTHING), "nan", words)
        try:
            values = words.astype(float)
        except ValueError:
            values = np.array([_number(word) for word in words])
        bad = np.isinf(values) | (np.isnan(values) & (np.char.lower(words) != "nan"))
        kept = np.zeros(len(values), dtype=bool)
        kept[rows] = True
        _refuse(name, column, words, bad & kept, "a whole number" if whole else "a number")
    values = values[rows]
    lines = np.arange(len(raw))[rows]
    if empty is None:
        _refuse(name, column, values, np.isnan(values), "a whole number" if whole else "a number", lines)
    if whole:
        wrong = (values != np.rint(values)) | (np.abs(values) > LARGEST)
        _refuse(name, column, values, wrong, "a whole number", lines)
        return np.rint(values).astype(np.int64)
    return values


def _seconds(given: Any, raw: np.ndarray) -> np.ndarray:
    """Times as seconds, NaN where there is none; anything else as it is."""
    if getattr(getattr(given, "dtype", None), "kind", "") == "M" or raw.dtype.kind == "M":
        raw = np.asarray(given if raw.dtype.kind == "O" else raw, dtype="datetime64[ns]")
        return np.where(np.isnat(raw), np.nan, raw.astype(np.int64) / 1e9)
    return raw


def _cast(column: Any) -> Any:
    """An Arrow column as numbers, if all of it is; else as it is."""
    try:
        return column.cast("float64")
    except (ValueError, TypeError, NotImplementedError):
        return column


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.inf


def _refuse(
    name: str, column: str, values: np.ndarray, bad: np.ndarray, expected: str, lines: np.ndarray | None = None
) -> None:
    found = np.flatnonzero(bad)
    if len(found):
        line = int(found[0] if lines is None else lines[found[0]]) + 2
        got = str(values[found[0]])
        got = "nothing" if got in NOTHING else f"'{_one_line(got)[:40]}'"
        raise UsageError(f"{name}, line {line}, column '{column}': expected {expected}, got {got}")


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _natural(nodes: Sequence[str] | np.ndarray) -> tuple[list[str], np.ndarray]:
    """Names in the order that a reader expects (2 before 10), and the new place of each."""

    def key(name: str) -> list[tuple[int, int, str]]:
        # longer numbers are larger
        parts = [part.lstrip("0") if part.isdecimal() else part for part in re.split(r"(\d+)", name) if part]
        return [(0, len(part), part) if not part or part.isdecimal() else (1, 0, part) for part in parts]

    order = sorted(range(len(nodes)), key=lambda i: key(str(nodes[i])))
    places = np.empty(len(nodes), dtype=int)
    places[order] = np.arange(len(nodes))
    return [str(nodes[i]) for i in order], places


def _nodes(name: str, table: Mapping[str, Any], sender: str, receiver: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of all nodes, and the places of each row's sender and receiver among them."""
    (from_names, s), (to_names, r) = _coded(name, table, sender), _coded(name, table, receiver)
    nodes, _ = _natural(sorted({*from_names, *to_names}))
    place = {node: i for i, node in enumerate(nodes)}
    s, r = (
        np.array([place[node] for node in names], dtype=np.int64)[codes]
        for names, codes in ((from_names, s), (to_names, r))
    )
    if (s == r).any():
        _refuse(name, receiver, np.array(nodes)[r], s == r, "another node than the sender")
    return nodes, s, r


def _coded(name: str, table: Mapping[str, Any], column: str) -> tuple[list[str], np.ndarray]:
    """Different names in a column, and which of them each row has."""
    if column not in table:
        raise UsageError(f"{name}: expected a column {column}, got {', '.join(map(str, table))}")
    given = table[column]
    if hasattr(given, "dictionary_encode"):
        encoded = given.dictionary_encode().combine_chunks()
        names, codes = encoded.dictionary.to_pylist(), encoded.indices.to_numpy(zero_copy_only=False)
    else:
        names, codes = np.unique(np.asarray(given).astype(str), return_inverse=True)
    words = [_one_line(str(word)) for word in names]
    wrong = np.array([word in NOTHING for word in words], dtype=bool)
    if wrong.any():
        _refuse(name, column, np.array(words)[codes], wrong[codes], "a name")
    return words, codes.astype(np.int64)


def _distinct(pair: np.ndarray, seq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different (pair, seq), sorted, and the place of each row among them."""
    span = int(seq.max(initial=0)) + 1
    if int(pair.max(initial=0)) + 1 > np.iinfo(np.int64).max // span:
        raise UsageError(
            f"seq: expected numbers below {np.iinfo(np.int64).max // (int(pair.max()) + 1):.3g}, got {span - 1:.3g}"
        )
    code, where = np.unique(pair * span + seq, return_inverse=True)
    return np.stack(np.divmod(code, span), axis=1), where


def _unwrapped(sender: np.ndarray, seq: np.ndarray, table: Mapping[str, Any], source: str) -> np.ndarray:
    """Sequence numbers of each sender, a counter of 16 bits unrolled in order of time, or of the file."""
    if seq.max(initial=0) >= WRAP:
        return seq
    clock = next((name for name in ("received_time", "time", "sent_time") if name in table), None)
    when = np.arange(len(seq)) if clock is None else _numbers(source, table, clock)
    out = seq.copy()
    for one in np.unique(sender):
        mine = np.flatnonzero(sender == one)
        mine = mine[np.argsort(when[mine], kind="stable")]
        jumps = np.diff(seq[mine])
        turns = np.concatenate([[0], np.cumsum((jumps < -WRAP // 2).astype(int) - (jumps > WRAP // 2))])
        out[mine] = seq[mine] + WRAP * (turns - turns.min())
    return out


def _delays(source: str, table: Mapping[str, Any], step: float | None) -> tuple[float, ...] | None:
    if step is None:
        return None
    if not step > 0:
        raise UsageError(f"--step: expected seconds above 0, got {step:g}")
    if "sent_time" not in table or "received_time" not in table:
        raise UsageError(
            f"{source}: expected columns sent_time and received_time for delays, got {', '.join(map(str, table))}"
        )
    left, came = (_numbers(source, table, name, empty=np.nan) for name in ("sent_time", "received_time"))
    took = came - left
    _refuse(source, "received_time", took, took < 0, "no time before sent_time")
    steps = np.floor(took[np.isfinite(took)] / step + 1e-9).astype(int)
    if not len(steps):
        raise UsageError(f"{source}: expected packets with sent_time and received_time, got none")
    return tuple((np.bincount(steps) / len(steps)).tolist())


def _arrow(name: str) -> Any:
    return needed(name, "study", "Parquet files of links need")
