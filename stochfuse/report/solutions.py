"""Answers to questions asked backwards, as table, CSV and JSON, with how exact they are and why they are right.

Answers to questions asked backwards as figures (matplotlib, extra `plot`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stochfuse.prediction.result import Prediction
from stochfuse.questions.agents_needed import AgentsNeeded
from stochfuse.questions.least_link import BESIDE, LeastLink
from stochfuse.questions.least_value import LeastValue
from stochfuse.questions.question import Question, described, named
from stochfuse.questions.sensitivity import Sensitivity, ShareOfGain
from stochfuse.report.plot import MARKERS, below, canvas, labelled, spread, titled
from stochfuse.report.predictions import PredictionView
from stochfuse.report.rows import ResultRows
from stochfuse.report.table import Report, Table, listed, number, stamped, to_csv

SCHEMA = "stochfuse.solution/1"
PRECISE = 12
"""Significant digits of link probabilities, and of values that differ by little."""
RESULT, VALUE, LINKS, CASES = ("result",), ("value",), ("µ",), ("links", "mean µ")
"""Headings: of a table with one answer, and of a row for each link or case."""
PROOFS = {
    "monotone": "proved: the value never rises with the link probability",
    "polynomial": "proved: the value is a polynomial in µ, and every root was parted from the others",
    "scan": "the value was looked at for all µ on a fine grid, and closely around every dip near the target",
}


@dataclass(frozen=True)
class SolutionSheet:
    """An answer, ready to be written in any format.

    Parameters
    ----------
    kind : which question: "least-link", "least-value", "agents-needed", "sensitivity", "gain" or "steady".
    question, prediction : what was asked about, and the prediction that labels it.
    answer : lines that say the answer in words.
    keys, columns, rows : the table.
    headings, records : of the CSV, beside what labels every line.
    facts : the answer's entries of the JSON object.
    """

    kind: str
    question: Question
    prediction: Prediction
    answer: tuple[str, ...]
    keys: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    headings: tuple[str, ...]
    records: tuple[tuple[Any, ...], ...]
    facts: dict[str, Any]

    @property
    def view(self) -> PredictionView:
        """View of the prediction."""
        return PredictionView(self.prediction, self.question.metric, self.question.agent)

    @property
    def titles(self) -> tuple[str, ...]:
        """The answer in words, and what it is about."""
        when = "" if self.kind == "gain" and self.question.step is not None else f"; {self.question.when}"
        return (*self.answer, self.view.what + when, self.view.whom, self.view.how)


def solution_report(sheet: SolutionSheet, found: Any) -> Report:
    """Return an answer in every form."""
    return Report.of(sheet, solution_table, solution_csv, solution_json, lambda _: draw(sheet, found))


def solution_table(sheet: SolutionSheet) -> Table:
    """Return the answer's table under what it means."""
    over = "k" if sheet.kind == "gain" else ""
    return Table(sheet.titles, sheet.keys, sheet.columns, sheet.rows, over)


def solution_csv(sheet: SolutionSheet) -> str:
    """One line per number asked for, with everything that says what it is."""
    p, asked = sheet.prediction, sheet.question
    labels = ("question", "method", "quantity", "stage", "nature", "metric", "unit", "agent")
    label = (sheet.kind, p.method, p.quantity, p.stage, p.nature, asked.metric.name, sheet.view.unit, asked.agent)
    return to_csv((*labels, *sheet.headings), [(*label, *record) for record in sheet.records])


def solution_json(sheet: SolutionSheet) -> dict[str, Any]:
    """Return the object of schema stochfuse.solution/1."""
    p, asked = sheet.prediction, sheet.question
    return stamped(
        SCHEMA,
        question=sheet.kind,
        method=p.method,
        quantity=p.quantity,
        metric=asked.metric.name,
        nature=p.nature,
        step=_step(asked),
        **sheet.facts,
        scenario=asked.scenario.to_mapping(),
        meta={
            "description": list(sheet.titles),
            "stage": p.stage,
            "unit": sheet.view.unit or None,
            "agent": asked.agent,
            "notes": list(p.notes),
        },
    )


def least_link_sheet(found: LeastLink, digits: int = 5) -> SolutionSheet:
    """Say the least link probability, its neighbours, and what can be reached at all."""
    asked, µ = found.question, found.link
    low, high = found.enclosure
    sure = max(high - µ, µ - low)
    at_most = f"{described(asked)} is at most {found.target:.9g}"
    if µ == 0:
        answer = [f"No link is needed: at µ = 0 {at_most}"]
    else:
        answer = [f"Least link probability: µ = {number(µ, PRECISE)}, from which on {at_most}"]
    if found.met != ((µ, 1.0),):
        answer = [answer[0].replace(", from which on", ", where"), f"It does not stay so: met for µ {_met(found)} only"]
    certain = "certain within" if np.isfinite(found.bound) and found.proof != "scan" else "by rounding within"
    reason = PROOFS[found.proof] + (f"; {certain} {sure:.1g} in µ" if sure else "") + _bounded(found.bound)
    answer.append(reason[0].upper() + reason[1:])
    rows = [
        ("least µ", number(µ, PRECISE)),
        ("target", f"{found.target:.{PRECISE}g}"),
        ("value at µ", number(found.value, PRECISE)),
        (f"value at µ − {BESIDE:g}", number(found.below, PRECISE) if µ > 0 else "none"),
        (f"value at µ + {BESIDE:g}", number(found.above, PRECISE) if µ < 1 else "none"),
        *((f"value at µ = {end}", number(v, digits)) for end, v in enumerate(found.reachable)),
        ("share of the gain", "none" if found.share is None else f"{100 * found.share:.4g} %"),
    ]
    zero, one = listed(found.reachable)
    facts = {
        "target": found.target,
        "link": µ,
        "value": found.value,
        "reachable": {"at_0": zero, "at_1": one},
        "share_of_gain": found.share,
        "met": [list(span) for span in found.met],
        "certificate": {
            "proof": found.proof,
            "enclosure": list(found.enclosure),
            "below": {"link": max(µ - BESIDE, 0.0), "value": listed(found.below)},
            "above": {"link": min(µ + BESIDE, 1.0), "value": found.above},
            "relative_bound": listed(found.bound),
        },
    }
    headings = ("step", "target", "link", "link_low", "link_high", "value", "value_at_0", "value_at_1", "share_of_gain")
    record = (_step(asked), found.target, µ, low, high, found.value, zero, one, found.share)
    table = (RESULT, VALUE, tuple(rows))
    return SolutionSheet("least-link", asked, found.prediction, tuple(answer), *table, headings, (record,), facts)


VALUE_PROOFS = {
    "every": "proved: every whole number of the range was evaluated",
    "monotone": "the value is monotone along {n} values of the range",
    "grid": "the value goes up and down: found on a grid of {n} values, between which more may happen",
}


def value_sheet(found: LeastValue, digits: int = 5) -> SolutionSheet:
    """Say the least or greatest value of a key, the value beside it that misses, and what proves it."""
    asked, unit = found.question, f" {found.unit}" if found.unit else ""
    low, high = (float(found.grid[0, i]) for i in (0, -1))
    at, µ = f"{found.at:.{PRECISE}g}{unit}", ResultRows(found.prediction).cells(0)[-1]
    at_most = f"{described(asked)} is at most {found.target:.9g}, at µ = {µ}"
    single = len(found.met) == 1 and found.proof != "grid"
    which = "at and above which" if found.direction == "least" else "at and below which"
    lines = [f"{found.direction.capitalize()} {found.key}: {at}, {which if single else 'where'} {at_most}"]
    if not single:
        lines.append(f"Met for {found.key} {_met(found)}")
    proof = VALUE_PROOFS[found.proof].format(n=found.grid.shape[1])
    if found.beside is None:
        proof += "; no value of the range misses the target on that side"
    else:
        proof += f"; certified: {found.beside[0]:.17g} misses the target, {found.at:.17g} meets it"
    lines.append(proof[0].upper() + proof[1:])
    ends = listed(found.grid[1, [0, -1]])
    rows = [
        (f"{found.direction} {found.key}", at),
        ("target", f"{found.target:.{PRECISE}g}"),
        ("value there", number(found.value, PRECISE)),
        ("value beside it, which misses", "none" if found.beside is None else number(found.beside[1], PRECISE)),
        *(
            (f"value at {end:.6g}{unit}", "none" if v is None else number(v, digits))
            for end, v in zip((low, high), ends, strict=True)
        ),
    ]
    missed = None if found.beside is None else found.beside[0]
    beside = None if found.beside is None else {"over": missed, "value": listed(found.beside[1])}
    facts = {
        "target": found.target,
        "link": float(found.prediction.link[0]),
        "over": {
            "key": found.key,
            "unit": found.unit or None,
            "value": found.at,
            "direction": found.direction,
            "proof": found.proof,
        },
        "value": found.value,
        "between": [low, high],
        "met": [list(span) for span in found.met],
        "certificate": {"meets": {"over": found.at, "value": found.value}, "misses": beside},
        "grid": [{"over": v, "value": listed(e)} for v, e in found.grid.T.tolist()],
    }
    headings = ("step", "target", "link", _key(found), "direction", "proof", "value", "misses_at")
    where = (_step(asked), found.target, float(found.prediction.link[0]), found.at)
    record = (*where, found.direction, found.proof, found.value, missed)
    table = (RESULT, VALUE, tuple(rows))
    return SolutionSheet("least-value", asked, found.prediction, tuple(lines), *table, headings, (record,), facts)


def _met(found: LeastLink | LeastValue) -> str:
    return "; ".join(f"from {a:.9g} to {b:.9g}" for a, b in found.met)


def _key(found: LeastValue) -> str:
    return f"{found.key} [{found.unit}]" if found.unit else found.key


def agents_sheet(found: AgentsNeeded, digits: int = 5) -> SolutionSheet:
    """Say the least number of agents, and that one fewer misses the target."""
    asked, n = found.question, found.agents
    answer = (
        f"Agents needed at µ = {found.link:g}: {n:,}, with which {described(asked)} is at most {found.target:.9g}",
        "Least: " + ("one fewer misses the target" if n > 1 else "there can be no fewer") + "; more agents never raise "
        "the value" + _bounded(found.bound),
    )
    tries = [(n - 1, found.fewer, "misses")] if found.fewer is not None else []
    tries.append((n, found.value, "meets"))
    rows = tuple((f"{k:,}", number(v, max(digits, 9)), word) for k, v, word in tries if v is not None)
    facts = {
        "target": found.target,
        "link": found.link,
        "agents": n,
        "value": found.value,
        "value_with_one_fewer": found.fewer,
        "tried": [{"agents": int(k), "value": float(v)} for k, v in found.tried.T],
        "relative_bound": listed(found.bound),
    }
    headings = ("step", "target", "link", "agents", "value", "value_with_one_fewer")
    record = (_step(asked), found.target, found.link, n, found.value, found.fewer)
    table = (("agents",), ("value", f"target {found.target:.9g}"), rows)
    return SolutionSheet("agents-needed", asked, found.prediction, answer, *table, headings, (record,), facts)


IMPROVEMENT = 0.01
"""How much better a link is taken to become, for an example."""


def sensitivity_sheet(found: Sensitivity, digits: int = 5) -> SolutionSheet:
    """Rank the links, and say which to improve first."""
    asked = found.question
    how = "exact derivatives of a polynomial in each link's µ" if found.exact else "numerical derivatives"
    error = np.max(found.error)
    answer = (*_advice(found), *_mending(found), f"{how}; estimated error at most {error:.1g}")
    rows, records = [], []
    for rank, i in enumerate(found.order, start=1):
        sender, to = found.links[i][0], receivers(found, int(i))
        gain = -IMPROVEMENT * found.derivative[i]
        slope, µ = found.derivative[i], found.link[i]
        rows.append((str(sender), to, f"{µ:.6g}", number(float(slope), digits), f"{-gain:+.3g}"))
        records.append((_step(asked), rank, sender, to, µ, slope, found.error[i], found.value))
    facts = {
        "value": found.value,
        "derivatives": "exact" if found.exact else "numerical",
        "improve_first": [_link(found, i) for i in found.first],
        "links": [
            {
                **_link(found, int(i)),
                "link": float(found.link[i]),
                "derivative": float(found.derivative[i]),
                "gain_if_perfect": float(found.lacking[i]),
                "estimated_error": float(found.error[i]),
            }
            for i in found.order
        ],
    }
    table = (("from", "to"), ("µ", "d value / dµ", f"µ + {IMPROVEMENT:g}"), tuple(rows))
    headings = ("step", "rank", "sender", "receiver", "link", "derivative", "estimated_error", "value")
    return SolutionSheet("sensitivity", asked, found.prediction, answer, *table, headings, tuple(records), facts)


def receivers(found: Sensitivity, i: int) -> str:
    """Whom a link reaches: an agent's number, or all."""
    heard = found.links[i][1]
    return "all" if found.question.scenario.network.architecture == "broadcast" else str(heard[0])


def _named(found: Sensitivity, i: int) -> str:
    """A link in words, its agents by number and name."""
    sender, to = found.links[i][0], receivers(found, i)
    names = found.question.scenario.network.names
    if not names:
        return f"{sender} to {to}"
    return f"{sender} ({names[sender - 1]}) to {to}" + (f" ({names[int(to) - 1]})" if to != "all" else "")


def _mending(found: Sensitivity) -> Sequence[str]:
    """Which link has most to gain, where that is another than the one of the largest slope."""
    most = int(np.argmax(found.lacking))
    if found.lacking[most] <= 0 or most in found.first:
        return ()
    gain = f"about {found.lacking[most]:.3g}, to first order"
    return (f"Perfect, the link from agent {_named(found, most)} would lower it most: by {gain}",)


def _link(found: Sensitivity, i: int) -> dict[str, Any]:
    return {"sender": found.links[i][0], "receivers": list(found.links[i][1])}


def _advice(found: Sensitivity) -> Sequence[str]:
    if not found.first:
        why = "; links of probability 1 cannot get better" if (found.link == 1).any() else ""
        if found.question.agent == "worst":
            why += "; where several agents are the worst, all of them must get better"
        return (f"No single link that is made better lowers the value{why}",)
    best = found.first[0]
    gain = -IMPROVEMENT * found.derivative[best]
    worth = (
        f"about {gain:.3g} of {found.value:.6g} ({100 * gain / abs(found.value):.2g} %)"
        if found.value
        else f"{gain:.3g}"
    )
    names = [f"from agent {_named(found, i)}" for i in found.first]
    if len(names) == len(found.links) > 1:
        return (f"No link is better to improve than another: +{IMPROVEMENT:g} on any one lowers the value by {worth}",)
    which = f"the link {names[0]}" if len(names) == 1 else f"one of the {len(names)} links {', '.join(names)}"
    return (f"Improve first: {which}; +{IMPROVEMENT:g} there lowers the value by {worth}",)


def gain_sheet(found: ShareOfGain, digits: int = 5) -> SolutionSheet:
    """Tabulate which share of the way from µ = 0 to µ = 1 each row has gone."""
    asked, p = found.question, found.prediction
    steps = ["steady"] if found.steps is None else [int(k) for k in found.steps]
    columns = tuple(k if isinstance(k, str) else f"k={k}" for k in steps)
    answer = ["Share of the gain reached, in per cent: (E(0) − E(µ)) / (E(0) − E(1))"]
    half = np.flatnonzero(p.link == 0.5)
    if p.cases is None and len(half) and np.isfinite(found.share[half[0]]).all():
        first, last = np.min(found.share[half[0]]), np.max(found.share[half[0]])
        span = f"{100 * first:.3g}" + (f" to {100 * last:.3g}" if len(steps) > 1 else "")
        thesis = " (the thesis, of the Local Fusion Graph: about 70 %)" if p.scenario.name == "thesis-transient" else ""
        answer.append(f"At µ = 0.5 it is {span} %{thesis}")
    rows, records = [], []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        shares = [number(100 * s, digits) if np.isfinite(s) else "none" for s in found.share[i]]
        rows.append((*name, f"{µ:.6g}", *shares))
        for c, k in enumerate(steps):
            records.append((*(name or ("",)), µ, k, listed(found.share[i, c]), found.value[i, c]))
    facts = {
        **ResultRows(p).facts,
        "steps": steps,
        "share_of_gain": listed(found.share),
        "values": found.value.tolist(),
        "reachable": {"at_0": found.reachable[0].tolist(), "at_1": found.reachable[1].tolist()},
    }
    headings = ("case", "link", "step", "share_of_gain", "value")
    table = (LINKS if p.cases is None else CASES, columns, tuple(rows))
    return SolutionSheet("gain", asked, p, tuple(answer), *table, headings, tuple(records), facts)


def steady_sheet(asked: Question, prediction: Prediction, digits: int = 5) -> SolutionSheet:
    """Tabulate the steady state against link probability, with its proved bound."""
    p, values = prediction, asked.read(prediction)
    bounds = np.full(len(values), np.inf) if p.steady_bound is None else p.steady_bound.max(axis=1)
    answer = ("Steady state against link probability, P = g(P), with a proved relative bound on the covariance",)
    rows, records = [], []
    for i, µ in enumerate(p.link):
        name = () if p.cases is None else (p.cases[i],)
        bound = "not proved" if np.isinf(bounds[i]) else f"{bounds[i]:.0e}"
        rows.append((*name, f"{µ:.6g}", number(values[i], digits), bound))
        records.append((*(name or ("",)), µ, "steady", values[i], listed(bounds[i])))
    facts = {**ResultRows(p).facts, "values": values.tolist(), "relative_bound": listed(bounds)}
    headings = ("case", "link", "step", "value", "relative_bound")
    table = (LINKS if p.cases is None else CASES, ("steady", "bound"), tuple(rows))
    return SolutionSheet("steady", asked, p, answer, *table, headings, tuple(records), facts)


SHEETS: dict[type, Callable[..., SolutionSheet]] = {
    LeastLink: least_link_sheet,
    LeastValue: value_sheet,
    AgentsNeeded: agents_sheet,
    Sensitivity: sensitivity_sheet,
    ShareOfGain: gain_sheet,
}


def sheet_of(found: Any, digits: int = 5) -> SolutionSheet:
    """Return the sheet of an answer; a steady state has `steady_sheet`."""
    return SHEETS[type(found)](found, digits)


def _bounded(bound: float) -> str:
    if not bound:
        return ""
    return f"; values proved to a relative {bound:.0e}" if np.isfinite(bound) else "; values at rounding, not proved"


def _step(asked: Question) -> int | str:
    return "steady" if asked.step is None else asked.step


MOST_BARS = 12


def draw(sheet: SolutionSheet, found: Any) -> Any:
    """Return the figure of an answer under what it means."""
    figure = canvas(7.5, 5.4)
    axes = figure.add_subplot()
    DRAWN[sheet.kind](axes, sheet, found)
    below(figure)
    titled(figure, sheet.answer[0], *sheet.titles[len(sheet.answer) :])
    return figure


def _label(sheet: SolutionSheet) -> str:
    unit = f" [{sheet.view.unit}]" if sheet.view.unit else ""
    return f"{named(sheet.question).partition(' (')[0]}{unit}"


def _draw_met(axes: Any, found: LeastLink | LeastValue, at: float, name: str) -> None:
    """Draw the target, where it is met, and the answer."""
    axes.axhline(found.target, color="C3", linestyle="--", linewidth=1, label=f"target {found.target:.6g}")
    for i, (a, b) in enumerate(found.met):
        axes.axvspan(a, b, color="C2", alpha=0.12, linewidth=0, label="met" if i == 0 else None)
    axes.plot([at], [found.value], "o", color="C3", label=f"{name} {at:.6g}")
    axes.axvline(at, color="C3", linestyle=":", linewidth=1)


def _draw_least_link(axes: Any, sheet: SolutionSheet, found: LeastLink) -> None:
    axes.plot(*found.curve(), color="C0", label=f"value, {sheet.question.when}")
    _draw_met(axes, found, found.link, "least µ =")
    labelled(axes, "link probability µ", _label(sheet))


def _draw_value(axes: Any, sheet: SolutionSheet, found: LeastValue) -> None:
    axes.plot(*found.grid, ".-", color="C0", markersize=3, label=f"value, {sheet.question.when}")
    _draw_met(axes, found, found.at, f"{found.direction}:")
    labelled(axes, _key(found), _label(sheet))


def _draw_agents(axes: Any, sheet: SolutionSheet, found: AgentsNeeded) -> None:
    axes.plot(*found.tried, "o-", color="C0", markersize=3, label=f"value at µ = {found.link:g}")
    axes.axhline(found.target, color="C3", linestyle="--", linewidth=1, label=f"target {found.target:.6g}")
    axes.plot([found.agents], [found.value], "D", color="C3", label=f"{found.agents:,} agents")
    if found.tried[0].max() > 30:
        axes.set_xscale("log")
        axes.set_yscale("log")
    labelled(axes, "agents", _label(sheet))


def _draw_sensitivity(axes: Any, sheet: SolutionSheet, found: Sensitivity) -> None:
    label = f"d ({named(sheet.question).partition(' (')[0]}) / dµ"
    if len(found.links) <= MOST_BARS:
        order = found.order[::-1]
        names = [f"{found.links[i][0]} to {receivers(found, int(i))}" for i in order]
        first = ["//" if int(i) in found.first else "" for i in order]
        axes.barh(names, found.derivative[order], color=["C3" if f else "C0" for f in first], hatch=first)
        axes.axvline(0, color="0.3", linewidth=0.8)
        labelled(axes, label + "; hatched: improve first", "link")
        return
    n = found.question.scenario.network.agents
    grid = np.full((n, n), np.nan)
    for (sender, heard), slope in zip(found.links, found.derivative, strict=True):
        grid[[i - 1 for i in heard], sender - 1] = slope
    image = axes.imshow(grid, cmap="viridis")
    axes.figure.colorbar(image, ax=axes, label=label)
    axes.set_xticks(range(n), range(1, n + 1))
    axes.set_yticks(range(n), range(1, n + 1))
    axes.set_xlabel("from agent")
    axes.set_ylabel("to agent")


def _draw_gain(axes: Any, sheet: SolutionSheet, found: ShareOfGain) -> None:
    p = found.prediction
    names = ["steady"] if found.steps is None else [f"k = {k}" for k in found.steps]
    if p.cases is None:
        order = np.argsort(p.link)
        for i, c in enumerate(spread(len(names))):
            axes.plot(p.link[order], 100 * found.share[order, c], marker=MARKERS[i], markersize=4, label=names[c])
        axes.plot([0, 1], [0, 100], color="0.6", linewidth=0.8, linestyle=":")
        labelled(axes, "link probability µ", "share of the gain [%]")
    else:
        for i, row in enumerate(spread(len(p.cases))):
            axes.plot(names, 100 * found.share[row], marker=MARKERS[i], markersize=4, label=p.cases[row])
        labelled(axes, "step", "share of the gain [%]")


def _draw_steady(axes: Any, sheet: SolutionSheet, found: Any) -> None:
    p, values = sheet.prediction, sheet.question.read(sheet.prediction)
    if p.cases is None:
        order = np.argsort(p.link)
        axes.plot(p.link[order], values[order], "o-", color="C0", markersize=4)
        labelled(axes, "link probability µ", f"{_label(sheet)}, steady state")
    else:
        axes.bar(p.cases, values, color="C0")
        labelled(axes, "links", f"{_label(sheet)}, steady state")
    axes.set_ylim(bottom=0)


DRAWN: dict[str, Callable[..., None]] = {
    "least-link": _draw_least_link,
    "least-value": _draw_value,
    "agents-needed": _draw_agents,
    "sensitivity": _draw_sensitivity,
    "gain": _draw_gain,
    "steady": _draw_steady,
}
