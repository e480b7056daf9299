"""One window of the page: fields on the left, numbers and figures on the right, and what happens between them.

A change marks everything as not yet answered at once; what is answered afterwards is shown only if nothing else has
been asked since.  All that comes from files or fields is escaped where it meets HTML.
"""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from math import isfinite
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    CheckboxGroup,
    CustomJS,
    Div,
    FileInput,
    InlineStyleSheet,
    RadioButtonGroup,
    Select,
    Slider,
    Spinner,
    TextInput,
)

from stochfuse.errors import StochfuseError, UsageError
from stochfuse.explore import answers, saved, state
from stochfuse.explore.answers import Curve, Line, PageAnswer, QuestionWorker
from stochfuse.explore.charts import DARK, LIGHT, Chart, NetworkChart, key_of
from stochfuse.explore.network import Picture
from stochfuse.explore.saved import PageContents, axes_of, lines_of
from stochfuse.explore.state import OpenedScenario, PageInput, field_of
from stochfuse.scenario.network import WHOSE
from stochfuse.scenario.registry import ESTIMATORS, LFG, SIMPLIFIED
from stochfuse.scenario.scenario import preset_names

PATIENCE = 30
"""Seconds in which a file that is opened must be read."""
MOST_LOGS = 8
"""Files of links that are kept."""
WAIT = 30
"""Milliseconds that pass before a change is followed, in which others may come."""
OWN, ALIKE = "the scenario's own", "all alike, µ below"
QUANTITIES = ("claimed,actual", "claimed", "actual", "consistency", "bias", "rms")
HERE = Path(__file__).parent


class Page:
    """One window.

    Parameters
    ----------
    doc : Bokeh's document.
    given : the scenario that it begins with.
    """

    def __init__(self, doc: Any, given: OpenedScenario) -> None:
        self._doc, self._begun, self._logs = doc, given, {}
        self._presets: dict[str, OpenedScenario] = {given.name: given}
        self._sheet = InlineStyleSheet(css=(HERE / "fields.css").read_text(encoding="utf-8"))
        self._quiet = self._waiting = False
        self._opening = 0
        self._curves: dict[str, list[Curve]] = {}
        self._refused: dict[str, str] = {}
        self._picture: Picture | None = None
        self._loads: PageAnswer | None = None
        self._least_told: PageAnswer | None = None
        self._pointed: Any = None
        self._changed: dict[tuple[int, int], float] = {}
        self._sensors: dict[int, float | None] = {}
        self._touched = False
        self._work = QuestionWorker(lambda *said: self._hand_on(self._work, *said))
        self._work_least = QuestionWorker(lambda *said: self._hand_on(self._work_least, *said), (answers.least,))
        self._build()
        self._dress()
        self.asked = self._begin(given)
        doc.title = "stochfuse explore"
        doc.template = (HERE / "page.html").read_text(encoding="utf-8")
        doc.on_session_destroyed(lambda _: self._work.stop())
        # not before the page is there: its own files have to be sent first
        doc.on_event(DocumentReady, lambda _: self._ask())

    # fields

    def _build(self) -> None:
        """Make all fields and figures."""
        f: dict[str, Any] = {
            "scenario": Select(title="Scenario", options=[*dict.fromkeys([self._begun.name, *preset_names()])]),
            "file": FileInput(title="Open a scenario or packet log", accept=",".join(state.SUFFIXES)),
            "links": Select(title="Links", options=[OWN, ALIKE]),
            "link": Slider(title="Link probability µ", start=0, end=1, step=0.01, value=0.5),
            "power": TextInput(title="Radio power [dBm]"),
            "agents": Spinner(title="Agents", low=1, high=state.MOST_AGENTS, value=3, step=1),
            "steps": Spinner(title="Steps", low=1, high=state.MOST_STEPS, value=5, step=1),
            "architecture": Select(title="Architecture", options=["ad-hoc", "broadcast", "cyclic"]),
            "q": TextInput(title="Process noise Q", placeholder="as in the scenario"),
            "r": TextInput(title="Measurement noise R", placeholder="as in the scenario"),
            "p0": TextInput(title="First estimates P", placeholder="as in the scenario"),
            "estimators": CheckboxGroup(labels=list(ESTIMATORS), active=[]),
            "quantities": Select(title="Quantity", options=list(QUANTITIES), value=QUANTITIES[0]),
            "metric": TextInput(title="Metric"),
            "agent": Select(title="Whose", options=[*WHOSE], value="mean"),
            "target": TextInput(title="Target to be met"),
        }  # fmt: skip
        self._fields, self._errors = f, {}
        children: list[Any] = []
        for name, widget in f.items():
            widget.stylesheets, widget.sizing_mode, widget.margin = [self._sheet], "stretch_width", (3, 0, 3, 0)
            self._errors[name] = self._div("", {"role": "alert"}, visible=False, margin=0)
            if name == "estimators":
                children.append(self._div("Estimators", margin=0))
                widget.html_attributes = {"role": "group", "aria-label": "Estimators"}
            children += [widget, self._errors[name]]
            attribute = "active" if name == "estimators" else "value"
            follow = {"file": self._soon, "scenario": self._pick, "target": self._retarget}.get(name, self._change)
            self._on(widget, attribute, lambda _new, follow=follow: follow())
        self._status = self._div("", {"role": "status", "aria-live": "polite"}, name="status")
        self._dark = CheckboxGroup(labels=["dark"], active=[], name="dark", stylesheets=[self._sheet])
        self._on(self._dark, "active", lambda _: self._dress())
        self._dark.js_on_change("active", CustomJS(code="stochfuse.theme(cb_obj.active.length > 0);"))
        self._numbers = self._div(
            "", {"role": "region", "aria-label": "Numbers", "aria-live": "polite"}, name="numbers"
        )
        self._build_figures()
        for root in (
            column(*children, sizing_mode="stretch_width", name="controls"), self._status, self._dark, self._numbers,
            *self._figure_roots, self._build_this(),
        ):  # fmt: skip
            self._doc.add_root(root)
        known = {"dark": self._dark, "said": self._errors["file"], "most": state.MOST_BYTES}
        ready = CustomJS(args=known, code="stochfuse.ready(dark, said, most);")
        self._doc.js_on_event(DocumentReady, ready)
        self._doc.js_on_event(ConnectionLost, CustomJS(code='document.body.classList.add("lost");'))

    def _on(self, model: Any, attribute: str, follow: Callable[[Any], None]) -> None:
        """Follow what a reader changes, not what the page itself does."""

        def changed(attr: str, old: Any, new: Any) -> None:
            if not self._quiet:
                follow(new)

        model.on_change(attribute, changed)

    def _div(self, text: str, attributes: dict[str, str] | None = None, **more: Any) -> Any:
        return Div(
            text=text, html_attributes=attributes or {}, stylesheets=[self._sheet], sizing_mode="stretch_width", **more
        )

    def _build_figures(self) -> None:
        self._over, self._steps = Chart("Error against links"), Chart("Error against steps")
        self._load, self._network = Chart("Message load against steps", 300), NetworkChart()
        self._at, self._least = self._over.span("height", False), self._over.span("height", False)
        self._least.line_dash = "dotted"
        self._target = self._over.span("width", True)
        self._on(self._target, "location", self._dragged)
        self._said_least, self._said_load = self._div(""), self._div("")
        self._keys = [self._div(""), self._div(""), self._div("")]
        self._about = self._div("Click on a link or an agent.", {"role": "status", "aria-live": "polite"})
        self._which = Select(title="Link or agent", options=[""], value="", stylesheets=[self._sheet])
        self._on(self._which, "value", self._point)
        hidden: dict[str, Any] = {"stylesheets": [self._sheet], "visible": False}
        self._one = Spinner(title="µ of this link", low=0, high=1, step=0.05, width=120, **hidden)
        self._on(self._one, "value", self._change_link)
        self._senses = CheckboxGroup(labels=["measures"], active=[0], align="end", **hidden)
        self._times = Spinner(title="its noise R, times", low=0.01, step=0.5, width=120, **hidden)
        self._on(self._senses, "active", lambda on: self._change_agent((self._times.value or 1.0) if on else None))
        self._on(self._times, "value", self._change_agent)
        self._undo = Button(label="Undo changes", align="end", **hidden)
        self._undo.on_click(lambda _: self._undone())
        self._fields["times"], self._errors["times"] = self._times, self._div("", {"role": "alert"}, visible=False)
        for source, many in ((self._network.links, "link"), (self._network.agents, "agent")):
            self._on(source.selected, "indices", lambda new, many=many: self._clicked(many, new))
        wide: Any = {"sizing_mode": "stretch_width"}
        told = row(self._which, self._one, self._senses, self._times, self._undo, styles={"flex-wrap": "wrap"}, **wide)
        self._figure_roots = [
            column(self._over.figure, self._keys[0], self._said_least, name="over", **wide),
            column(self._steps.figure, self._keys[1], name="steps", **wide),
            column(self._network.figure, told, self._errors["times"], self._about, name="network", **wide),
            column(self._load.figure, self._keys[2], self._said_load, name="load", **wide),
        ]

    def _build_this(self) -> Any:
        self._kind = RadioButtonGroup(labels=["Command", "Python", "File"], active=0, stylesheets=[self._sheet])
        self._on(self._kind, "active", lambda _: self._show_this())
        self._this = self._div("")
        self._saved = Div(visible=False)
        self._saved.js_on_change("tags", CustomJS(code="stochfuse.save(...cb_obj.tags);"))
        buttons = []
        for kind in ("CSV", "Scenario", "Figure", "Report"):
            button = Button(label=f"Save {kind.lower() if kind != 'CSV' else kind}", stylesheets=[self._sheet])
            button.on_click(lambda _e, kind=kind: self._export(kind))
            buttons.append(button)
        wide: Any = {"sizing_mode": "stretch_width"}
        above = row(self._kind, *buttons, styles={"flex-wrap": "wrap"}, **wide)
        return column(above, self._this, self._saved, name="this", **wide)

    # what is asked

    def _begin(self, given: OpenedScenario) -> PageInput:
        """Fill the fields from a scenario."""
        scenario = PageInput(given).scenario
        network, f = scenario.network, self._fields
        own = network.link is not None or bool(network.cases)
        self._given, self._changed, self._sensors, self._pointed, self._touched = given, {}, {}, None, False
        self._quiet = True
        f["scenario"].options = [*dict.fromkeys([given.name, *f["scenario"].options])]
        f["scenario"].value, f["agents"].value, f["steps"].value = given.name, network.agents, network.steps
        f["architecture"].value = network.architecture
        f["links"].options, f["links"].value = ([OWN, ALIKE], OWN) if own else ([ALIKE], ALIKE)
        f["power"].visible, f["power"].value = network.radio is not None, ""
        f["power"].placeholder = "" if network.radio is None else f"{network.radio.transmit_power:g}"
        for name in ("q", "r", "p0", "target", "metric"):
            f[name].value = ""
        f["estimators"].active = [ESTIMATORS.index(scenario.estimator or LFG)]
        f["metric"].placeholder = f"{scenario.metric or 'trace'}; or std:{scenario.model.states[0]}, …"
        f["agent"].value = str(scenario.agent or "mean")
        self._base = scenario
        self._quiet = False
        return PageInput(given)

    def _read(self) -> PageInput:
        """Return what the fields ask.

        Raises
        ------
        Wrong
            If one cannot be read.
        """
        f, base = self._fields, self._base.network
        alike = f["links"].value == ALIKE
        sizes = ("agents", "steps", "architecture")
        numbers: dict[str, Any] = {name: _number(name, f[name].value) for name in ("q", "r", "p0", "target")}
        asked = PageInput(
            self._given,
            **{name: f[name].value if f[name].value != getattr(base, name) else None for name in sizes},
            **numbers,
            link=round(f["link"].value, 6) if alike else None,
            power=_number("power", f["power"].value) if f["power"].visible and not alike else None,
            changed=tuple(sorted(self._changed.items())),
            sensors=tuple(sorted(self._sensors.items())),
            estimators=tuple(ESTIMATORS[i] for i in sorted(f["estimators"].active)),
            quantities=tuple(f["quantities"].value.split(",")),
            metric=f["metric"].value.strip() or None,
            agent=int(f["agent"].value) if f["agent"].value.isdecimal() else f["agent"].value,
        )
        asked.scenario.network.agent(asked.agent)
        asked.measure  # noqa: B018  says what is wrong with a name
        if asked.target is not None and asked.target < 0:
            raise UsageError(f"target: expected a finite number of at least 0, got {asked.target:g}")
        return asked

    def _pick(self) -> None:
        """Begin with another scenario."""
        name = self._fields["scenario"].value
        given = self._presets.get(name) or state.preset(name)
        self.asked = self._begin(given)
        self._change()

    def _soon(self) -> None:
        """Open a file when its name, which comes behind its content, is there too."""
        self._doc.add_next_tick_callback(self._open)

    def _open(self) -> None:
        """Take the file that was opened, its content under its name, in a thread and for so long only."""
        field = self._fields["file"]
        name, raw = PurePosixPath(str(field.filename).replace("\\", "/")).name, str(field.value)
        if not raw:
            return
        self._wrong({})
        self._status.text, self._opening = f"reading {escape(name)} …", self._opening + 1
        number, given, logs = self._opening, self._given, dict([*self._logs.items()][-MOST_LOGS:])

        def read() -> None:
            try:
                content = base64.b64decode(raw) if len(raw) <= 2 * state.MOST_BYTES else bytes(state.MOST_BYTES + 1)
                mapping = state.opened(name, content, logs)
                if mapping is None:
                    logs[name] = content
                found: Any = OpenedScenario(name, mapping) if mapping is not None else state.with_log(given, name, logs)
            except (StochfuseError, MemoryError) as error:
                found = error
            self._doc.add_next_tick_callback(lambda: self._opened(number, found, logs))

        threading.Thread(target=read, daemon=True).start()
        late = UsageError(f"{name}: expected a file that is read within {PATIENCE} s")
        self._doc.add_timeout_callback(lambda: self._opened(number, late, self._logs), 1000 * PATIENCE)

    def _opened(self, number: int, found: Any, logs: dict[str, bytes]) -> None:
        """Begin with what was opened, unless it came too late."""
        if number != self._opening:
            return
        self._opening += 1
        try:
            if isinstance(found, Exception):
                raise found
            self.asked = self._begin(found)
        except (StochfuseError, MemoryError) as error:
            self._wrong({"file": str(error) or type(error).__name__})
            self._status.text = "see the marked field"
            return
        self._presets[found.name], self._logs = found, logs
        self._change()

    def _change(self) -> None:
        """Something was changed: nothing that is shown is an answer to it yet."""
        self._stale()
        if not self._waiting:
            self._waiting = True
            self._doc.add_timeout_callback(self._ask, WAIT)

    def _stale(self) -> None:
        self._work.stop()
        self._work_least.stop()
        self._curves, self._refused, self._picture, self._loads, self._least_told = {}, {}, None, None, None
        self._numbers.text = self._said_least.text = self._said_load.text = self._this.text = ""
        self._least.visible = False
        self._status.text = "working …"
        for chart in (self._over, self._steps, self._load, self._network):
            chart.figure.styles = {"opacity": "0.3"}

    def _ask(self) -> None:
        """Follow what the fields ask now."""
        self._waiting = False
        self._stale()
        try:
            asked = self._read()
        except (StochfuseError, ArithmeticError) as error:
            self._wrong({field_of(error): str(error)})
            self._status.text = "see the marked field"
            for chart in (self._over, self._steps, self._load):
                chart.show([], "", "")
            return
        self.asked = asked
        self._wrong({})
        numbers = map(str, range(1, asked.scenario.network.agents + 1))
        self._fields["agent"].options = [*WHOSE, *numbers]
        self._fields["link"].visible = self._fields["links"].value == ALIKE
        self._work.ask(asked)
        self._ask_least()

    def _ask_least(self) -> None:
        shown = self.asked.target is not None and self.asked.kind == "link"
        self._target.visible, self._target.location = shown, self.asked.target if shown else None
        if self.asked.target is not None:
            self._work_least.ask(self.asked)

    def _retarget(self) -> None:
        """Another target was typed: what does not depend on it stays."""
        self._touched = True
        try:
            target = self._read().target
        except StochfuseError as error:
            self._wrong({field_of(error): str(error)})
            return
        self._wrong({})
        self._said_least.text, self._least.visible, self._least_told = "", False, None
        self.asked = replace(self.asked, target=target)
        self._ask_least()
        self._show_this()

    def _dragged(self, to: Any) -> None:
        if to is None or self.asked.target is None or abs(to - self.asked.target) <= 1e-12 * abs(to):
            return
        self._fields["target"].value = f"{max(to, 0.0):.4g}"

    def _wrong(self, messages: dict[str, str]) -> None:
        """Mark the fields that are wrong, and no others."""
        for name, div in self._errors.items():
            text = messages.get(name, "")
            div.text, div.visible = _wrongly(text) if text else "", bool(text)
            self._fields[name].css_classes = ["wrong"] if text else []

    # answers

    def _hand_on(self, work: QuestionWorker, number: int, name: str, found: Any) -> None:
        """Bring an answer from its thread to the document."""
        self._doc.add_next_tick_callback(lambda: self._answered(work, number, name, found))

    def _answered(self, work: QuestionWorker, number: int, name: str, found: Any) -> None:
        if number != work.number:
            return
        if isinstance(found, Exception):
            self._refused[name] = str(found) or type(found).__name__
            self._show_about()
        if name == "progress":
            if work is self._work_least:
                return  # it has no end that would be told
            self._status.text = f"quick answers are here; exact ones are coming: {escape(str(found))}"
        elif name == "done":
            self._status.text = "all answers are here"
        elif isinstance(found, Picture):
            self._picture = found
            self._show_network()
        elif name == "messages" and isinstance(found, PageAnswer):
            self._show_load(found)
        elif name == "least":
            self._show_least(found)
        elif isinstance(found, list):
            self._curves[name] = found
            if name == SIMPLIFIED and not self._touched and found and self.asked.kind == "link":
                self._suggest(found[0])
            self._show_curves()
        self._show_numbers()
        if isinstance(found, list):
            self._show_this()

    def _suggest(self, curve: Curve) -> None:
        """Put a target where it can be dragged: midway between what µ = 0 and µ = 1 give."""
        low, high = float(curve.over.y.min()), float(curve.over.y.max())
        self._quiet = True
        self._fields["target"].value = f"{(low + high) / 2:.3g}" if isfinite(high) and high > low >= 0 else ""
        self._quiet = False
        self.asked = replace(self.asked, target=_number("target", self._fields["target"].value))
        self._ask_least()

    def _shown(self) -> list[Curve]:
        return [curve for curves in self._curves.values() for curve in curves]

    def _show_curves(self) -> None:
        curves, look, asked = self._shown(), self._look, self.asked
        (x, y), colors = axes_of(asked, curves), look.curves
        self._over.show(lines_of(curves, colors, "over"), x, y)
        self._steps.show(lines_of(curves, colors, "steps"), "step k", y)
        self._keys[0].text = self._keys[1].text = key_of(lines_of(curves, colors, "over"))
        at = {"link": asked.link, "power": asked.transmit_power}.get(asked.kind)
        self._at.location, self._at.visible = at, at is not None
        for chart in (self._over, self._steps):
            chart.figure.styles = {"opacity": "1"}

    def _show_load(self, found: PageAnswer) -> None:
        steps = self._curves[SIMPLIFIED][0].views[0].prediction.steps if self._curves.get(SIMPLIFIED) else None
        x = steps if steps is not None else range(1, found.value.shape[1] + 1)
        names, colors = ("Local Fusion Graph", "naive"), (self._look.curves[0], self._look.curves[1])
        lines = [
            (name, color, dash, Line(np.asarray(x), y))
            for name, color, dash, y in zip(names, colors, ("solid", "dashed"), found.value, strict=True)
        ]
        self._loads = found
        self._load.show(lines, "step k", "new nodes per agent")
        self._keys[2].text, self._load.figure.styles = key_of(lines), {"opacity": "1"}
        self._said_load.text = escape(found.text)

    def _show_least(self, found: Any) -> None:
        self._least_told = found if isinstance(found, PageAnswer) else None
        if isinstance(found, PageAnswer):
            self._least.location, self._least.visible = found.value, found.value is not None
            self._said_least.text = escape(found.text) + ". Drag the line, or type a target."
        else:
            self._said_least.text = _wrongly(str(found))

    def _show_network(self) -> None:
        picture = self._picture
        if picture is None:
            return
        self._network.show(picture, self.asked)
        self._network.figure.styles = {"opacity": "1"}
        self._quiet = True
        self._which.options = [
            ("", "—"),
            *((f"link {i},{j}", f"link {picture.name((i, j))}") for i, j in picture.pairs),
            *((f"agent {i}", f"agent {name}") for i, name in enumerate(picture.names)),
        ]
        self._quiet = False
        self._show_about()

    def _clicked(self, many: str, indices: Sequence[int]) -> None:
        if not indices or self._picture is None:
            return
        what = indices[0]
        self._point(f"agent {what}" if many == "agent" else "link {},{}".format(*self._picture.pairs[what]))

    def _point(self, what: str) -> None:
        kind, _, where = what.partition(" ")
        self._pointed = None if not where else (kind, tuple(int(part) for part in where.split(",")))
        self._show_about()

    def _show_about(self) -> None:
        """Explain the link or the agent that was pointed at."""
        picture, text = self._picture, "Click on a link or an agent, or choose one. Wider links are worth more."
        link: float | None = None
        agent: int | None = None
        text += picture.mended() if picture is not None else ""
        if picture is not None and self._pointed is not None:
            kind, place = self._pointed
            if kind == "agent" and place[0] < len(picture.names):
                text, agent = picture.about_agent(place[0], self.asked), place[0]
            elif kind == "link" and place in picture.pairs:
                text, link = picture.about_link(place, self.asked), float(picture.link[place])
        if "sensitivity" in self._refused:
            text += f" What links are worth: {self._refused['sensitivity']}"
        self._about.text = escape(text)
        self._quiet = True
        self._one.visible = link is not None and picture is not None and picture.step is None
        self._one.value = link
        self._senses.visible = agent is not None
        if agent is not None and picture is not None:
            senses = picture.senses(agent, self.asked)
            self._senses.active, self._times.visible = [0] if senses else [], senses
            self._times.value = self._sensors.get(agent) or 1.0
        else:
            self._times.visible = False
        self._undo.visible = bool(self._changed or self._sensors)
        self._which.value = (
            "" if self._pointed is None else f"{self._pointed[0]} {','.join(map(str, self._pointed[1]))}"
        )
        self._quiet = False

    def _change_link(self, µ: float | None) -> None:
        if µ is None or self._pointed is None or self._pointed[0] != "link":
            return
        self._changed[self._pointed[1]] = round(float(µ), 6)
        self._change()

    def _change_agent(self, times: float | None) -> None:
        """Let the agent that is pointed at measure with so many times its noise, or nothing."""
        if self._pointed is None or self._pointed[0] != "agent":
            return
        self._sensors[self._pointed[1][0]] = times
        self._change()

    def _undone(self) -> None:
        """Forget what was changed of single links and agents."""
        self._changed, self._sensors = {}, {}
        self._change()

    def _show_numbers(self) -> None:
        """The present numbers in a table, and what was refused."""
        asked, curves = self.asked, self._shown()
        if not curves and not self._refused:
            return
        table = saved.numbers(asked, curves)
        rows = "".join(
            f"<tr><td>{escape(name)}</td><td>{escape(quantity)}</td><td class='n'>{value}</td>"
            f"<td class='soft'>{escape(how)}</td></tr>"
            for name, quantity, value, how in table.rows
        )
        refused = [
            f"{name.removeprefix('estimator ')}: {why}"
            for name, why in self._refused.items()
            if name not in ("least", "sensitivity")
        ]
        listed = "".join(f"<li>{_lines(text)}</li>" for text in (*refused, *saved.notes(curves)))
        heads = "".join(f"<th>{heading}</th>" for heading in table.headings)
        self._numbers.text = f"<div><b>{escape(table.title[0])}</b></div><table><tr>{heads}</tr>{rows}</table>" + (
            f"<ul class='soft'>{listed}</ul>" if listed else ""
        )

    def _show_this(self) -> None:
        asked, kind = self.asked, self._kind.active or 0
        drawn = [c.name for c in self._shown() if c.sampled]
        text = asked.file() if kind == 2 else asked.python(drawn) if kind else "\n".join(asked.commands(drawn))
        if kind != 2 and state.FILE in text:
            text = f"# {state.FILE} is what “File” shows\n{text}"
        self._this.text = f"<pre tabindex='0'>{escape(text)}</pre>"

    def _export(self, kind: str) -> None:
        """Save something as a file, in the reader's browser."""
        asked, curves = self.asked, self._shown()
        if not curves:
            self._status.text = "nothing to save yet"
            return
        if kind == "Scenario":
            self._save(state.FILE, asked.file())
        elif kind == "CSV":
            self._save("page.csv", saved.records(curves))
        else:
            shown = PageContents(curves, self._picture, self._loads, self._least_told)
            threading.Thread(target=self._draw, args=(kind, asked, shown), daemon=True).start()

    def _draw(self, kind: str, asked: PageInput, shown: PageContents) -> None:
        try:
            text = saved.page_of(asked, shown) if kind == "Report" else saved.figure_of(asked, shown.curves)
        except StochfuseError as error:
            said = escape(str(error))
            self._doc.add_next_tick_callback(lambda: setattr(self._status, "text", said))
            return
        name = "page.html" if kind == "Report" else "page.svg"
        self._doc.add_next_tick_callback(lambda: self._save(name, text))

    def _save(self, name: str, text: str) -> None:
        self._saved.tags = []
        self._saved.tags = [name, text]
        self._status.text = f"saved {escape(name)}"

    # looks

    @property
    def _look(self) -> Any:
        return DARK if self._dark.active else LIGHT

    def _dress(self) -> None:
        for chart in (self._over, self._steps, self._load, self._network):
            chart.dress(self._look)
        if self._curves:
            self._show_curves()
        if self._loads is not None:
            self._show_load(self._loads)


def _number(field: str, text: str) -> float | None:
    """Return the number in a field; None where there is none.

    Raises
    ------
    UsageError
        If it is no finite number.
    """
    if not text.strip():
        return None
    try:
        found = float(text)
    except ValueError:
        found = float("nan")
    if not isfinite(found):
        raise UsageError(f"{field}: expected a finite number, got '{text}'")
    return found


def _lines(text: str) -> str:
    return escape(text).replace("\n", "<br>")


def _wrongly(text: str) -> str:
    return f'<span class="wrong">{_lines(text)}</span>'
