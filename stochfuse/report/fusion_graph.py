"""A Local Fusion Graph in words, as Graphviz DOT, as JSON and as a figure like those of the thesis."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.estimators.fusion_graph import Explanation, FusionGraph, Node, Term
from stochfuse.kalman.metrics import Metric
from stochfuse.report.plot import canvas, entry
from stochfuse.report.table import number, stamped

SCHEMA = "stochfuse.fusion-graph/1"
REMOVED, OWN, OTHER = "#f4b183", "#9dc3e6", "#ffffff"


class ClaimedAtNodes(NamedTuple):
    """A metric of every fused estimate's claimed covariance."""

    metric: Metric
    values: Mapping[Node, float]


def name(node: Node) -> str:
    """Return a node's name: (agent,kStep), or the common start."""
    return "start" if node[0] == 0 else f"({node[0]},k{node[1]})"


def names(nodes: tuple[Node, ...]) -> str:
    """Return several nodes' names."""
    return name(nodes[0]) if len(nodes) == 1 else "{" + ", ".join(map(name, nodes)) + "}"


def to_text(explanations: list[Explanation], claimed: ClaimedAtNodes | None = None, width: int | None = None) -> str:
    """Every fusion in words, one block each, wrapped to a width."""
    blocks = []
    for e in explanations:
        lines = [f"agent {e.agent} at step {e.step} fuses {names(e.fused)}"]
        if e.superseded:
            lines.append(f"  {names(e.superseded)} arrived too, but was known already: it changes nothing")
        lines += _lines(e.terms, 2)
        if claimed is not None:
            unit = f" {claimed.metric.unit}" if claimed.metric.unit else ""
            value = number(claimed.values[e.agent, e.step])
            lines.append(f"  claimed covariance, {claimed.metric.label}: {value}{unit}")
        blocks.append("\n".join(lines if width is None else map(partial(_wrapped, width=width), lines)))
    return "\n\n".join(blocks) + "\n"


def _wrapped(line: str, width: int) -> str:
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    return textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False)


def _lines(terms: tuple[Term, ...], indent: int) -> list[str]:
    lines = []
    for term in terms:
        sign = "+" if term.coefficient > 0 else "-"
        times = f"{abs(term.coefficient)} × " if abs(term.coefficient) > 1 else ""
        text = f"{' ' * indent}{sign} {times}{names(term.nodes)}"
        if len(term.nodes) > 1:
            text += f" fused at k{term.since}"
        if term.until > term.since:
            text += f"{' and' if len(term.nodes) > 1 else ','} brought forward from k{term.since} to k{term.until}"
        if term.shared_by:
            text += f"; common to {' and to '.join(map(names, term.shared_by))}"
        lines.append(text)
        lines += _lines(term.parts, indent + 4)
    return lines


def to_mapping(graph: FusionGraph, explanations: list[Explanation], claimed: ClaimedAtNodes | None) -> dict[str, Any]:
    """Return an object with nodes, edges and what explains every fusion."""
    return stamped(
        SCHEMA,
        **({} if claimed is None else {"metric": claimed.metric.name}),
        agents=graph.history.agents,
        steps=graph.history.steps,
        nodes=[list(node) for node in graph.nodes],
        edges=[[list(parent), list(node)] for node in graph.nodes for parent in graph.parents(node)],
        fusions=[
            {
                "agent": e.agent,
                "step": e.step,
                "fused": [list(n) for n in e.fused],
                "superseded": [list(n) for n in e.superseded],
                "terms": [_term(t) for t in e.terms],
                **({} if claimed is None else {"claimed": claimed.values[e.agent, e.step]}),
            }
            for e in explanations
        ],
    )


def _term(term: Term) -> dict[str, Any]:
    return {
        "coefficient": term.coefficient,
        "nodes": [list(n) for n in term.nodes],
        "since": term.since,
        "until": term.until,
        "shared_by": [[list(n) for n in nodes] for nodes in term.shared_by],
        "parts": [_term(part) for part in term.parts],
    }


def _edges(graph: FusionGraph, shown: set[Node], agent: int, step: int) -> list[tuple[Any, Any, bool]]:
    """(parent, child, late) among the nodes shown; the fused estimate is the node (agent, step + ½)."""
    edges: list[tuple[Any, Any, bool]] = [(p, n, p[1] < n[1] - 1) for n in shown for p in graph.parents(n)]
    fused = (agent, step + 0.5)
    edges += [(p, fused, p[1] < step) for p in graph.received(agent, step)]
    return sorted(edges, key=lambda e: (e[1][1], e[1][0], e[0][1], e[0][0]))


def _roles(graph: FusionGraph, explanation: Explanation) -> tuple[set[Node], set[Node]]:
    """Return the nodes in the pedigree of a fusion, and those that were removed as common."""
    shown = set().union(*(graph.ancestors(n) for n in graph.received(explanation.agent, explanation.step)))
    removed = {n for term in explanation.terms if term.shared_by for n in term.nodes}
    return shown, removed


def to_dot(graph: FusionGraph, explanation: Explanation) -> str:
    """One agent's graph at a step for Graphviz: one rank per step, late messages dashed, common nodes filled."""
    shown, removed = _roles(graph, explanation)
    agent, step = explanation.agent, explanation.step
    lines = [
        f'digraph "agent {agent} at step {step}" {{',
        f'  label="Local fusion graph of agent {agent} after step {step}; filled: removed as common information"',
        "  rankdir=LR; node [shape=circle, style=filled, fillcolor=white];",
    ]
    for k in range(1, step + 1):
        here = sorted(n for n in shown if n[1] == k)
        lines += [f"  {{ rank=same; {' '.join(f'{_id(n)};' for n in here)} }}"] if here else []
    lines += [
        f'  {_id(n)} [label="{name(n)[1:-1] if n[0] else name(n)}"'
        + (f', fillcolor="{REMOVED}"' if n in removed else "")
        + "];"
        for n in sorted(shown, key=lambda n: (n[1], n[0]))
    ]
    lines.append(f'  fused [label="{agent},k{step}\\nfused", shape=doublecircle, fillcolor="{OWN}"];')
    for parent, child, late in _edges(graph, shown, agent, step):
        to = _id(child) if isinstance(child[1], int) else "fused"
        lines.append(f"  {_id(parent)} -> {to}{' [style=dashed]' if late else ''};")
    return "\n".join([*lines, "}"]) + "\n"


def _id(node: Node) -> str:
    return f"n{node[0]}_{node[1]}"


def draw(graph: FusionGraph, explanation: Explanation):
    """Return a figure of one agent's graph at a step: agents as rows, steps as columns, as in the thesis' figure 5."""
    figure = canvas(max(5.0, 1.9 * explanation.step + 2.2), max(3.2, 1.05 * graph.history.agents + 1.6))
    from matplotlib.patches import Patch

    shown, removed = _roles(graph, explanation)
    agent, step, n = explanation.agent, explanation.step, graph.history.agents
    axes = figure.add_subplot()
    radius = 0.17

    def place(node: tuple[float, float]) -> np.ndarray:
        row = (n + 1) / 2 if node[0] == 0 else node[0]
        return np.array([node[1] - (0.5 if node[0] == 0 else 0.0) + (0.15 if node[1] != int(node[1]) else 0.0), -row])

    for parent, child, late in _edges(graph, shown, agent, step):
        a, b = place(parent), place(child)
        way = (b - a) / np.hypot(*(b - a))
        arrow = {"arrowstyle": "->", "linestyle": "--" if late else "-", "color": "0.35", "lw": 1.1}
        axes.annotate("", b - radius * way, a + radius * way, arrowprops=arrow)
    for node in sorted(shown):
        x, y = place(node)
        color = REMOVED if node in removed else OTHER
        axes.plot(x, y, "o", markersize=27, color=color, markeredgecolor="black")
        axes.text(x, y, "start" if node[0] == 0 else f"{node[0]},{node[1]}", ha="center", va="center", fontsize=9)
    x, y = place((agent, step + 0.5))
    axes.plot(x, y, "s", markersize=27, color=OWN, markeredgecolor="black")
    axes.text(x, y, f"{agent},{step}f", ha="center", va="center", fontsize=9)
    axes.set_xticks(range(1, step + 1), [f"k{k}" for k in range(1, step + 1)])
    axes.set_yticks([-i for i in range(1, n + 1)], [f"agent {i}" for i in range(1, n + 1)])
    axes.set_xlim(0.3 if graph.shared else 0.6, step + 1.1)
    axes.set_ylim(-n - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title(f"Local fusion graph of agent {agent} after step {step}", fontsize="medium")
    key = [
        Patch(facecolor=OWN, edgecolor="black", label="fused estimate"),
        Patch(facecolor=REMOVED, edgecolor="black", label="removed as common"),
        entry("late message", color="0.35", linestyle="--"),
    ]
    figure.legend(handles=key, loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure
