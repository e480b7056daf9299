"""Links between nodes as tables, JSON, a scenario's [network] and figures.

Of a file: a heat map, and the network on a circle.  Of a scenario with places: the network where it is, at some steps
(`stochfuse.report.network_figure`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from stochfuse.report.network_figure import draw_circle, draw_network
from stochfuse.report.plot import canvas, titled
from stochfuse.report.table import Report, Table, listed, stamped, to_csv
from stochfuse.scenario.links import MEMORY, Links
from stochfuse.scenario.radio import distances

SCHEMA = "stochfuse.links/1"
NAMES = ("receiver", "sender")
"""Axes of what is known of links, and the columns that name a link."""


def links_report(found: Links, at: Sequence[int] | None = None) -> Report:
    """Return links in every form.

    Parameters
    ----------
    at : steps that table and figure show of links that vary, from 1; default: the first, the middle and the last.
    """
    if found.steps is None:
        return Report.of(found, links_table, links_csv, links_json, draw)
    steps = tuple(at or sorted({1, (found.steps + 1) // 2, found.steps}))
    flat = not (found.places or found.varies or found.cases)
    figure = draw if flat else partial(draw_network, steps=steps)
    return Report.of(found, partial(scenario_tables, steps=steps), links_csv, links_json, figure)


def scenario_tables(found: Links, steps: Sequence[int]) -> list[Table]:
    """Return µ receiver × sender of a scenario, at some steps or of each case, and each link over the steps."""
    n = len(found.nodes)
    head = f"Link probabilities of {found.source} ({found.kind}): {n} agents, {found.architecture}, {found.steps} steps"
    shown = [(f"case {name}", link) for name, link in found.cases] or [("", found.link)]
    tables = []
    for what, link in shown:
        for step in steps if link.ndim == 3 else (0,):
            now = link[step - 1] if step else link
            titles = [title for title in (what, f"step {step}" if step else "") if title]
            lines = (head, "rows receive, columns send") if not tables else ()
            tables.append(_matrix(found.nodes, now, (*lines, *titles)))
    single = n > 1 and not found.cases and (found.varies or found.places)
    return [*tables, _each(found)] if single else tables


def _each(found: Links) -> Table:
    """Each link over the steps, with distance and received power if known; both ways in one row if alike."""
    link = found.link if found.varies else found.link[None]
    alike = bool((np.nan_to_num(link) == np.nan_to_num(np.swapaxes(link, 1, 2))).all())
    columns = _over("µ", ".3f", link, ("from", "mean", "to"))
    if found.places:
        d = distances(found.places)
        d = d if d.ndim == 3 else d[None]
        columns += _over("m", ".1f", d, ("from", "to"))
        if found.radio is not None:
            columns += _over("dBm", ".1f", found.radio.received(d), ("from", "to"))
    n = len(found.nodes)
    rows = tuple(
        (found.nodes[i], found.nodes[j], *(f"{M[i, j]:{form}}" for _, form, M in columns))
        for i, j in product(range(n), repeat=2)
        if (i < j if alike else i != j)
    )
    both = "the same both ways" if alike else "receiver and sender"
    sensitivity = "" if found.radio is None else f"; sensitivity {found.radio.sensitivity:g} dBm"
    over = " over the steps" if found.varies else ""
    title = (f"Each link{over}: {both}{'; distance in m' if found.places else ''}{sensitivity}",)
    return Table(
        title, ("agent", "and") if alike else ("receiver", "sender"), tuple(name for name, *_ in columns), rows
    )


def _over(what: str, form: str, M: np.ndarray, which: Sequence[str]) -> list[tuple[str, str, np.ndarray]]:
    """Columns of a stack over the steps: name, format and numbers; itself where it has but one step."""
    if len(M) == 1:
        return [(what, form, M[0])]
    of = {"from": M.min, "mean": M.mean, "to": M.max}
    return [(f"{what} {name}", form, of[name](axis=0)) for name in which]


def _matrix(names: Sequence[str], link: np.ndarray, title: tuple[str, ...]) -> Table:
    """µ receiver × sender; long names stand beside the rows alone."""
    short = max(map(len, names)) <= 7
    labels = names if short else tuple(f"{i + 1}: {name}" for i, name in enumerate(names))
    across = tuple(names) if short else tuple(str(i + 1) for i in range(len(names)))
    rows = tuple((labels[i], *("-" if i == j else _shown(µ) for j, µ in enumerate(row))) for i, row in enumerate(link))
    return Table(title, ("receiver",), across, rows)


def links_table(found: Links) -> list[Table]:
    """Return µ̂ receiver × sender, and each link with its interval and numbers."""
    names = found.nodes
    head = (
        f"Link probabilities of {found.source} ({found.kind}): {len(names)} nodes",
        "rows receive, columns send; ? is unknown, never 0",
    )
    rows = []
    for i, j in np.argwhere(~np.isnan(found.link) & ~np.eye(len(names), dtype=bool)).tolist():
        sent = "" if found.sent is None else f"{found.received[i, j]} of {found.sent[i, j]}"  # type: ignore[index]
        span = "" if np.isnan(found.low[i, j]) else f"{found.low[i, j]:.3f} to {found.high[i, j]:.3f}"
        back = "?" if np.isnan(found.link[j, i]) else f"{found.link[i, j] - found.link[j, i]:+.2f}"
        rows.append((names[i], names[j], f"{found.link[i, j]:.3f}", span, sent, back, _memory(found, i, j)))
    columns = ("µ", "95 % interval", "received", "Δ back", "memory")
    tables = [_matrix(names, found.link, head)]
    if found.sent is not None:
        title = ("Each link: Jeffreys interval; Δ back: less the link the other way; memory by likelihood ratio",)
        tables.append(Table(title, NAMES, columns, tuple(rows)))
    if found.delay is not None:
        delays = tuple((str(k), f"{p:.4f}") for k, p in enumerate(found.delay))
        tables.append(Table(("Delay of messages that arrive",), ("steps",), ("probability",), delays))
    return tables


def _shown(µ: float) -> str:
    return "?" if np.isnan(µ) else f"{µ:.3f}"


def _memory(found: Links, i: int, j: int) -> str:
    if found.memory is None or np.isnan(found.memory[i, j]):
        return ""
    fit = (found.burst or {}).get((i, j))
    if fit is None:
        return "none" if found.memory[i, j] <= MEMORY else f"χ² {found.memory[i, j]:.1f}, no model better than none"
    model = (
        "Gilbert" if (fit["good"], fit["bad"]) == (1.0, 0.0) else f"Gilbert–Elliott {fit['good']:.2f}/{fit['bad']:.2f}"
    )
    return f"{model}, p {fit['good_to_bad']:.3f}, r {fit['bad_to_good']:.3f}"


def links_csv(found: Links) -> str:
    """One line per link that is known, and step where they vary."""
    rows = []
    links = found.link if found.varies else found.link[None]
    low, high = (np.broadcast_to(ends, links.shape) for ends in (found.low, found.high))
    for k, i, j in np.argwhere(~np.isnan(links)).tolist():
        known = not np.isnan(low[k, i, j])
        ends = (float(low[k, i, j]), float(high[k, i, j])) if known else ("", "")
        counts = ("", "") if found.sent is None else (int(found.sent[i, j]), int(found.received[i, j]))  # type: ignore[index]
        step = (k + 1,) if found.varies else ()
        rows.append((*step, found.nodes[i], found.nodes[j], float(links[k, i, j]), *ends, *counts))
    step = ("step",) if found.varies else ()
    return to_csv((*step, *NAMES, "link", "low", "high", "sent", "received"), rows)


def arrays(found: Links) -> dict[str, Any]:
    """Return what an xarray.Dataset takes: (receiver, sender) arrays of all that is known, NaN where nothing is.

    Where links vary the step stands in front.
    """
    known = {name: getattr(found, name) for name in ("link", "low", "high", "sent", "received", "memory")}
    steps = {"step": range(1, len(found.link) + 1)} if found.varies else {}
    return {
        "data_vars": {name: (("step", *NAMES)[3 - M.ndim :], M) for name, M in known.items() if M is not None},
        "coords": {**steps, **{name: list(found.nodes) for name in NAMES}},
        "attrs": {"source": found.source, "kind": found.kind},
    }


def links_json(found: Links) -> dict[str, Any]:
    """Return the object of schema stochfuse.links/1; what is unknown is null."""
    n = len(found.nodes)
    burst = found.burst and [[found.burst.get((i, j)) for j in range(n)] for i in range(n)]
    counted = found.sent is not None
    return stamped(
        SCHEMA,
        source=found.source,
        kind=found.kind,
        nodes=list(found.nodes),
        link=listed(found.link),
        low=listed(found.low) if counted else None,
        high=listed(found.high) if counted else None,
        sent=found.sent.tolist() if found.sent is not None else None,
        received=found.received.tolist() if found.received is not None else None,
        burst=burst or None,
        memory=None if found.memory is None else listed(found.memory),
        delay=None if found.delay is None else list(found.delay),
        notes=list(found.notes),
        steps=list(range(1, len(found.link) + 1)) if found.varies else None,
        positions=[place.tolist() for place in found.places] or None,
        cases=[{"name": name, "link": listed(link)} for name, link in found.cases] or None,
    )


def network_table(found: Links) -> str:
    """Return the [network] table of a scenario; links of which nothing is known are not heard."""
    lines = [
        f"# Links of {found.source} ({found.kind}), receiver × sender{', one matrix per step' * found.varies}",
        "[network]",
        f"agents = {len(found.nodes)}",
        f"steps = {found.steps or 10}",
        *([f'architecture = "{found.architecture}"'] if found.architecture != "ad-hoc" else []),
        f"nodes = {json.dumps(list(found.nodes), ensure_ascii=False)}",
    ]
    # a scenario's links are written in full, so that they predict what it does; a log's have no more digits than that
    exact = found.steps is not None
    if exact and found.burst:  # of a scenario all links have one
        burst = ", ".join(f"{key} = {value!r}" for key, value in next(iter(found.burst.values())).items())
        lines.append(f"burst = {{ {burst} }}")
    else:
        lines.append(f"link = {_rows(found.link, exact=exact)}")
    if found.unknown:
        lines += ["# nothing is known of the other links: they are taken for none", f"hears = {found.hears}"]
    if found.delay is not None:
        lines.append(f"delay = {list(found.delay)}")
    for name, link in found.cases:
        rows = _rows(link, exact=exact)
        lines += ["", "[[network.case]]", f"name = {json.dumps(name, ensure_ascii=False)}", f"link = {rows}"]
    return "\n".join(lines) + "\n"


def _rows(link: np.ndarray, *, exact: bool, indent: str = "") -> str:
    """Nested lists of TOML, a line a row; 0 for what is unknown."""
    if link.ndim == 1:
        shown = [0.0 if np.isnan(x) else float(x) for x in link]
        return "[" + ", ".join(repr(x) if exact else f"{x:.6g}" for x in shown) + "]"
    inside = ",\n".join(f"{indent}  {_rows(row, exact=exact, indent=indent + '  ')}" for row in link)
    return f"[\n{inside},\n{indent}]"


def draw(found: Links) -> Any:
    """Return the figure: µ̂ as a heat map, and the nodes on a circle with what each hears."""
    n = len(found.nodes)
    figure = canvas(12.5, 6.2)
    left, right = figure.subplots(1, 2)
    image = left.imshow(np.ma.masked_invalid(found.link), vmin=0, vmax=1, cmap="viridis")
    left.set_facecolor("0.9")
    left.set_xticks(range(n), found.nodes, rotation=90, fontsize="small")
    left.set_yticks(range(n), found.nodes, fontsize="small")
    left.set_xlabel("sender")
    left.set_ylabel("receiver")
    if n <= 12:
        for i, j in zip(*np.nonzero(~np.isnan(found.link)), strict=True):
            µ = found.link[i, j]
            left.text(j, i, f"{µ:.2f}", ha="center", va="center", fontsize="x-small", color="w" if µ < 0.6 else "k")
    figure.colorbar(image, ax=left, label="link probability µ (grey: unknown)", shrink=0.8)
    name = draw_circle(right, found)
    about = "right: the darker and thicker, the likelier"
    titled(figure, f"Link probabilities of {found.source} ({found.kind})", about)
    figure.draw_without_rendering()
    name()
    return figure
