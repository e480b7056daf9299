"""Links between nodes as tables, JSON, a scenario's [network] and a figure: a heat map and the network drawn."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from stochfuse import __version__
from stochfuse.report.plot import figure_class, titled
from stochfuse.report.table import Report, Table, to_csv
from stochfuse.scenario.links import MEMORY, Links

SCHEMA = "stochfuse.links/1"
NAMES = ("receiver", "sender")
"""Axes of what is known of links, and the columns that name a link."""


def links_report(found: Links) -> Report:
    """Return links in every form."""
    return Report.of(found, links_table, links_csv, links_json, draw)


def links_table(found: Links) -> list[Table]:
    """Return µ̂ receiver × sender, and each link with its interval and numbers."""
    names = found.nodes
    head = (
        f"Link probabilities of {found.source} ({found.kind}): {len(names)} nodes",
        "rows receive, columns send; ? is unknown, never 0",
    )
    # long names stand beside the rows alone
    short = max(map(len, names)) <= 7
    labels = names if short else tuple(f"{i + 1}: {name}" for i, name in enumerate(names))
    matrix = [
        (labels[i], *("-" if i == j else _shown(found.link[i, j]) for j in range(len(names))))
        for i in range(len(names))
    ]
    pairs = [(i, j) for i in range(len(names)) for j in range(len(names)) if i != j and not np.isnan(found.link[i, j])]
    rows = []
    for i, j in pairs:
        sent = "" if found.sent is None else f"{found.received[i, j]} of {found.sent[i, j]}"  # type: ignore[index]
        span = "" if np.isnan(found.low[i, j]) else f"{found.low[i, j]:.3f} to {found.high[i, j]:.3f}"
        back = "?" if np.isnan(found.link[j, i]) else f"{found.link[i, j] - found.link[j, i]:+.2f}"
        rows.append((names[i], names[j], f"{found.link[i, j]:.3f}", span, sent, back, _memory(found, i, j)))
    columns = ("µ", "95 % interval", "received", "Δ back", "memory")
    across = names if short else tuple(str(i + 1) for i in range(len(names)))
    tables = [Table(head, ("receiver",), across, tuple(matrix))]
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
    """One line per link that is known."""
    rows = []
    for i, receiver in enumerate(found.nodes):
        for j, sender in enumerate(found.nodes):
            if i == j or np.isnan(found.link[i, j]):
                continue
            known = not np.isnan(found.low[i, j])
            ends = (float(found.low[i, j]), float(found.high[i, j])) if known else ("", "")
            counts = ("", "") if found.sent is None else (int(found.sent[i, j]), int(found.received[i, j]))  # type: ignore[index]
            rows.append((receiver, sender, float(found.link[i, j]), *ends, *counts))
    return to_csv((*NAMES, "link", "low", "high", "sent", "received"), rows)


def arrays(found: Links) -> dict[str, Any]:
    """Return what an xarray.Dataset takes: (receiver, sender) arrays of all that is known, NaN where nothing is."""
    known = {name: getattr(found, name) for name in ("link", "low", "high", "sent", "received", "memory")}
    return {
        "data_vars": {name: (NAMES, M) for name, M in known.items() if M is not None},
        "coords": {name: list(found.nodes) for name in NAMES},
        "attrs": {"source": found.source, "kind": found.kind},
    }


def links_json(found: Links) -> dict[str, Any]:
    """Return the object of schema stochfuse.links/1; what is unknown is null."""
    n = len(found.nodes)
    burst = found.burst and [[found.burst.get((i, j)) for j in range(n)] for i in range(n)]
    counted = found.sent is not None
    return {
        "schema": SCHEMA,
        "version": __version__,
        "source": found.source,
        "kind": found.kind,
        "nodes": list(found.nodes),
        "link": _listed(found.link),
        "low": _listed(found.low) if counted else None,
        "high": _listed(found.high) if counted else None,
        "sent": found.sent.tolist() if found.sent is not None else None,
        "received": found.received.tolist() if found.received is not None else None,
        "burst": burst or None,
        "memory": None if found.memory is None else _listed(found.memory),
        "delay": None if found.delay is None else list(found.delay),
        "notes": list(found.notes),
    }


def _listed(M: np.ndarray) -> list[list[float | None]]:
    return [[None if np.isnan(x) else float(x) for x in row] for row in M]


def network_table(found: Links) -> str:
    """Return the [network] table of a scenario; links of which nothing is known are not heard."""
    rows = ",\n".join("  [" + ", ".join(f"{0.0 if np.isnan(x) else x:.6g}" for x in row) + "]" for row in found.link)
    lines = [
        f"# Links of {found.source} ({found.kind}), receiver × sender",
        "[network]",
        f"agents = {len(found.nodes)}",
        "steps = 10",
        f"nodes = {json.dumps(list(found.nodes), ensure_ascii=False)}",
        f"link = [\n{rows},\n]",
    ]
    if found.unknown:
        lines += ["# nothing is known of the other links: they are taken for none", f"hears = {found.hears}"]
    if found.delay is not None:
        lines.append(f"delay = {list(found.delay)}")
    return "\n".join(lines) + "\n"


def draw(found: Links) -> Any:
    """Return the figure: µ̂ as a heat map, and the nodes on a circle with what each hears."""
    n = len(found.nodes)
    figure = figure_class()(figsize=(12.5, 6.2), layout="constrained")
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
    angle = 2 * np.pi * np.arange(n) / n
    x, y = np.sin(angle), np.cos(angle)
    for i, j in zip(*np.nonzero(np.nan_to_num(found.link) > 0), strict=True):
        right.annotate(
            "",
            (x[i] * 0.93, y[i] * 0.93),
            (x[j] * 0.93, y[j] * 0.93),
            arrowprops={
                "arrowstyle": "-|>",
                "linewidth": 0.3 + 2.0 * found.link[i, j],
                "color": str(round(0.85 - 0.85 * float(found.link[i, j]), 3)),
                "connectionstyle": "arc3,rad=0.08",
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )
    for node, a, b in zip(found.nodes, x, y, strict=True):
        right.text(1.12 * a, 1.12 * b, node, ha="center", va="center", fontsize="small")
    right.set_xlim(-1.35, 1.35)
    right.set_ylim(-1.35, 1.35)
    right.set_aspect("equal")
    right.set_axis_off()
    titled(
        figure, f"Link probabilities of {found.source} ({found.kind})", "right: the darker and thicker, the likelier"
    )
    return figure
