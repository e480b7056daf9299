"""What is asked of the page: a scenario, what is changed in it, and what is to be shown.

A `PageInput` is immutable, and from it comes everything else: the scenario, and the same question as commands, as
Python and as a file.  What is opened in the page is content alone: a name in it never becomes a path (`opened`).
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import Problem, ScenarioError, UsageError
from stochfuse.kalman.metrics import Metric
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.scenario.as_toml import to_toml
from stochfuse.scenario.known_links import links_of_scenario
from stochfuse.scenario.links import read_links
from stochfuse.scenario.over import put
from stochfuse.scenario.registry import LFG
from stochfuse.scenario.scenario import (
    LINK_KEYS,
    Scenario,
    folder_of,
    is_preset,
    load_scenario,
    parse,
    read_text,
    with_links,
)

MOST_AGENTS, MOST_STEPS, MOST_BYTES = 60, 500, 2_000_000
"""What a page takes: agents, steps, and letters of a file that is opened."""
FINE, COARSE, ROUGH = "0:1:0.05", "0:1:0.1", "0:1:0.25"
"""Link probabilities of the curves, as --link takes them: of the quick engines, the exact ones, and samples."""
RUNS = 100
"""Runs of a sample."""
POWER = "network.radio.transmit_power"
REACH = 10.0
"""How far the power of the radios is varied to both sides [dB]."""
FILE = "page.toml"
"""Name of the file that has everything that options cannot say."""
SCENARIO_SUFFIXES, LOG_SUFFIXES = (".toml", ".json"), (".csv", ".txt", ".tsv")
SUFFIXES = (*SCENARIO_SUFFIXES, *LOG_SUFFIXES)


class OpenedScenario(NamedTuple):
    """A scenario as it came: a preset, a file named on the command line, or one opened in the page.

    Parameters
    ----------
    name : as the command line takes it; of an opened file its name.
    mapping : with a scenario file's keys, files of links read.
    """

    name: str
    mapping: Mapping[str, Any]


def begun(source: str) -> OpenedScenario:
    """Return the scenario that the command line names, a file of links only out of its own folder.

    Raises
    ------
    ScenarioError
        If it cannot be read, or reaches out of its folder.
    """
    name, text = read_text(source)
    mapping = parse(name, text)
    folder = folder_of(source).resolve()
    file = _link_file(mapping)
    if file is not None and not (folder / file).resolve().is_relative_to(folder):
        raise ScenarioError(name, [Problem("network.link.file", f"a file within {folder}", f"'{file}'")])
    mapping = mapping if is_preset(source) else with_links(mapping, name, folder)
    return OpenedScenario(source if source != "-" else FILE, mapping)


def _link_file(mapping: Any) -> str | None:
    """The file that a scenario's links are in, if any."""
    network = mapping.get("network") if isinstance(mapping, Mapping) else None
    link = network.get("link") if isinstance(network, Mapping) else None
    file = link.get("file") if isinstance(link, Mapping) else None
    return file if isinstance(file, str) else None


def opened(name: str, content: bytes, logs: Mapping[str, bytes]) -> Mapping[str, Any] | None:
    """Return the mapping of a scenario that was opened; None of a file of links, which is checked.

    Parameters
    ----------
    name : the file's name, which is shown and never used as a path.
    content : what is in it.
    logs : files of links that were opened before, by name: all that `file =` can mean.

    Raises
    ------
    UsageError, ScenarioError
        If it is too large, of another kind, or malformed.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if len(content) > MOST_BYTES:
        raise UsageError(f"{name}: expected a file of at most {MOST_BYTES:,} bytes, got {len(content):,}")
    if suffix in LOG_SUFFIXES:
        logged(name, {**logs, name: content})
        return None
    if suffix not in SCENARIO_SUFFIXES:
        expected = ", ".join(SUFFIXES)
        raise UsageError(f"{name}: expected a scenario or a packet log, by a name that ends in {expected}")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ScenarioError(name, f"not a text file in UTF-8 (byte {error.start})") from None
    mapping = parse(name, text)
    file = _link_file(mapping)
    if file is None:
        return mapping
    if file not in logs:
        known = f"one that was opened here before ({', '.join(logs)})" if logs else "one that was opened here before"
        raise ScenarioError(name, [Problem("network.link.file", known, f"'{file}'")])
    return _linked(mapping, name, file, logs)


def _linked(mapping: Mapping[str, Any], name: str, log: str, logs: Mapping[str, bytes]) -> Mapping[str, Any]:
    """A mapping with the links of an opened file in it."""
    network = mapping["network"]

    def read(folder: Path, inside: str) -> Mapping[str, Any]:
        link = {**network.get("link", {}), "file": inside}
        return with_links({**mapping, "network": {**network, "link": link}}, name, folder)

    return _in_folder(log, logs[log], read)


def _in_folder(name: str, content: bytes, use: Any) -> Any:
    """Use content as a file, alone in a folder and under a name of our own; messages call it by its own name."""
    if content[:2] == b"\x1f\x8b":
        raise UsageError(f"{name}: expected text, got a compressed file")
    inside = f"links{PurePosixPath(name).suffix.lower() or '.csv'}"
    with TemporaryDirectory() as folder:
        path = Path(folder) / inside
        path.write_bytes(content)
        try:
            return use(Path(folder), inside)
        except ScenarioError as error:
            raise UsageError(str(error).replace(str(path), name).replace(inside, name)) from None
        except UsageError as error:
            raise UsageError(str(error).replace(str(path), name)) from None


def logged(name: str, logs: Mapping[str, bytes]) -> Any:
    """Return what is known of links in a file that was opened."""
    return _in_folder(name, logs[name], lambda folder, inside: read_links(folder / inside))


def with_log(given: OpenedScenario, name: str, logs: Mapping[str, bytes]) -> OpenedScenario:
    """Return a scenario with the links of an opened file in the place of its own, and as many agents as it has nodes.

    Raises
    ------
    UsageError
        If they do not fit.
    """
    network = {key: value for key, value in given.mapping["network"].items() if key not in LINK_KEYS}
    if "agent" not in given.mapping:
        network.pop("nodes", None)
        network["agents"] = len(logged(name, logs).nodes)
    return OpenedScenario(FILE, _linked({**given.mapping, "network": network}, given.name, name, logs))


@dataclass(frozen=True)
class PageInput:
    """What is asked.

    Parameters
    ----------
    given : the scenario as it came.
    agents, steps, architecture, q, r, p0 : what is changed in it, as options of the command line; None: nothing.
    link : one probability for all links; None: the scenario's own.
    power : of all radios [dBm]; None: the scenario's.
    changed : probabilities of single links that were changed, by (receiver, sender) from 0.
    sensors : what the R of single agents (from 0) is multiplied by; None: such an agent measures nothing.
    estimators : names.
    quantities : of the estimators.
    metric : its name; None: the scenario's, else trace.
    agent : "mean", "worst", "best" or a number.
    target : a value to be met, or None.
    """

    given: OpenedScenario
    agents: int | None = None
    steps: int | None = None
    architecture: str | None = None
    q: float | None = None
    r: float | None = None
    p0: float | None = None
    link: float | None = None
    power: float | None = None
    changed: tuple[tuple[tuple[int, int], float], ...] = ()
    sensors: tuple[tuple[int, float | None], ...] = ()
    estimators: tuple[str, ...] = (LFG,)
    quantities: tuple[str, ...] = ("claimed", "actual")
    metric: str | None = None
    agent: int | str = "mean"
    target: float | None = None

    @property
    def options(self) -> dict[str, Any]:
        """What is changed by options of the command line, by their names."""
        names = ("agents", "steps", "architecture", "q", "r", "p0")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    @cached_property
    def scenario(self) -> Scenario:
        """What is given to the engines.

        Raises
        ------
        UsageError, ScenarioError
            As on the command line; and if it is too large for a page.
        """
        made = _loaded(self.given, uniform=self.link is not None, **self.options)
        network = made.network
        for name, number, most in (("agents", network.agents, MOST_AGENTS), ("steps", network.steps, MOST_STEPS)):
            if number > most:
                more = "the command line has more"
                raise UsageError(f"{name}: expected at most {most} on this page, got {number}; {more}")
        if self.power is not None:
            made = _loaded(OpenedScenario(self.given.name, put(made.to_mapping(), {POWER: self.power})))
        if self.changed:
            made = _loaded(OpenedScenario(self.given.name, self._with_changed(made)))
        if self.sensors:
            made = _loaded(OpenedScenario(self.given.name, self._with_sensors(made)))
        return made

    def _with_changed(self, made: Scenario) -> dict[str, Any]:
        """A mapping in which single links have other probabilities."""
        n = made.network.agents
        matrix = np.full((n, n), self.link) if self.link is not None else np.nan_to_num(links_of_scenario(made).link)
        if matrix.ndim == 3:
            raise UsageError("link: expected links that do not vary with the step, to change one of them")
        for (receiver, sender), µ in self.changed:
            if receiver < n and sender < n:
                matrix[receiver, sender] = µ
        np.fill_diagonal(matrix, 0.0)
        mapping = made.to_mapping()
        network = {key: value for key, value in mapping["network"].items() if key not in LINK_KEYS}
        return {**mapping, "network": {**network, "link": matrix.tolist()}}

    def _with_sensors(self, made: Scenario) -> dict[str, Any]:
        """A mapping in which single agents measure otherwise: their own R, or a named sensor's sigma."""
        mapping = made.to_mapping()
        mapping.setdefault("agent", [{} for _ in range(made.network.agents)])
        model = mapping.get("model", {})
        for i, times in self.sensors:
            if i >= made.network.agents:
                continue
            table = mapping["agent"][i]
            own = table.pop("sensor", True)
            named = own if isinstance(own, dict) else model.get("sensor", {}) if "R" not in table else {}
            R = table.get("R", model.get("R"))
            if times is None:
                mapping["agent"][i] = {**{k: v for k, v in table.items() if k not in ("H", "R")}, "sensor": False}
                continue
            if named:
                sigma = {"sigma": (np.asarray(named["sigma"]) * np.sqrt(times)).tolist()} if "sigma" in named else {}
                table["sensor"] = {**named, **sigma}
            if "sigma" not in named and R is None:
                raise UsageError(f"agent[{i + 1}].R: expected a sensor of its own or of the model, got none")
            if "sigma" not in named:
                table["R"] = (np.asarray(R) * times).tolist()
        return mapping

    @cached_property
    def alike(self) -> Scenario:
        """The same without its own links: what one probability for all is asked of."""
        if self.kind == "link":
            return self.scenario
        return _loaded(OpenedScenario(self.scenario.name, self.scenario.to_mapping()), uniform=True)

    @property
    def kind(self) -> str:
        """What curves run over: "link" (all alike), "power" (of the radios), or "own" (beside links of their own)."""
        network = self.scenario.network
        if network.radio is not None:
            return "power"
        return "link" if self.link is not None and not self.changed else "own"

    @property
    def transmit_power(self) -> float | None:
        """Power of the radios [dBm], if there are any."""
        radio = self.scenario.network.radio
        return None if radio is None else float(radio.transmit_power)

    def powers(self, grid: str) -> list[float]:
        """Powers of the radios that curves run over, the present one in the middle."""
        own, tick = self.transmit_power or 0.0, 2.0 if grid == FINE else 5.0
        side = round(REACH / tick)
        return [own + tick * i for i in range(-side, side + 1)]

    @property
    def measure(self) -> Metric:
        """The metric that is shown."""
        return metric_of(self.metric or self.scenario.metric or "trace", self.scenario.model)

    def plain(self) -> bool:
        """Whether options say all that is changed."""
        return not self.changed and not self.sensors and self.given.name != FILE

    def file(self) -> str:
        """Return the scenario as a file."""
        return to_toml(self.scenario.to_mapping())

    def commands(self, sampled: Sequence[str] = ()) -> list[str]:
        """Return the commands that print the same numbers; `sampled` are the estimators that have to be."""
        base, shown = self._base(), self._shown()
        found = []
        for alone in (False, True) if self.kind == "own" else (False,):
            for method in ("simplified", "optimal"):
                counted = alone and method == "simplified" and self.scenario.network.counts is not None
                more = ["--interval", "95%"] if counted else []
                found.append(["predict", *base, *self._along(FINE, alone), "--method", method, *more, *shown])
            for some, grid, runs in self.groups(sampled):
                more = ["--estimator", ",".join(some), "--quantity", ",".join(self.quantities)]
                more += [*(["--runs", str(runs)] if runs else []), "--all-steps"]
                found.append(["compare", *base, *self._along(grid, alone), *more, *shown])
        at = ["--link", f"{self.link:.12g}"] if self.kind == "link" else []
        present = self._base(alone=not at)
        found.append(["solve", *present, "--sensitivity", *at, *shown])
        if self.target is not None and self.kind == "link":
            found.append(["solve", *self._base(alone=True), "--target", f"{self.target:.12g}", *shown])
        found.append(["messages", *present, *at])
        return [shlex.join(["stochfuse", *words]) for words in found]

    def groups(self, sampled: Sequence[str]) -> list[tuple[list[str], str, int]]:
        """Estimators that are exact and those that are sampled, with their links and runs."""
        found = [([e for e in self.estimators if e not in sampled], COARSE, 0)]
        found.append(([e for e in self.estimators if e in sampled], ROUGH, RUNS))
        return [group for group in found if group[0]]

    def _along(self, grid: str, alone: bool) -> list[str]:
        """Options that say what curves run over; `alone` what is at the scenario's own links."""
        if self.kind == "power":
            return ["--over", f"{POWER}={','.join(f'{p:.12g}' for p in self.powers(grid))}"]
        return [] if alone else ["--link", grid if self.kind == "own" else f"{grid},{self.link:.12g}"]

    def _base(self, alone: bool = False) -> list[str]:
        """Scenario and options; `alone` where no --link is said that would replace the scenario's links."""
        replaced = self.link is not None and any(key in self.given.mapping["network"] for key in LINK_KEYS)
        if not self.plain() or (alone and (replaced or self.power is not None)):
            return [FILE]
        return [self.given.name, *(w for key, value in self.options.items() for w in (f"--{key}", _word(value)))]

    def _shown(self) -> list[str]:
        words = [] if self.metric is None else ["--metric", self.metric]
        return words if self.agent == "mean" else [*words, "--agent", str(self.agent)]

    def python(self, sampled: Sequence[str] = ()) -> str:
        """Return the same in Python; see `commands`."""
        words = [repr(self.given.name if self.plain() else FILE)]
        words += [f"{key}={value!r}" for key, value in self.options.items()] if self.plain() else []
        words += ["uniform_link=True"] if self.plain() and self.link is not None else []
        of = "" if self.metric is None and self.agent == "mean" else f"{self.measure.name!r}, {self.agent!r}"

        def at(grid: str) -> str:
            if self.kind == "power":
                return f"over={{{POWER!r}: {self.powers(grid)}}}"
            return "link=None" if self.kind == "own" else f"link={[*links_of(grid), self.link]}"

        lines = [
            "import stochfuse as sf", "",
            f"s = sf.load_scenario({', '.join(words)})",
            *(
                f"print(sf.predict(s, method={method!r}, {at(FINE)}).values({of})[:, -1])"
                for method in ("simplified", "optimal")
            ),
        ]  # fmt: skip
        for some, grid, runs in self.groups(sampled):
            asks = f"estimators={some}, quantities={list(self.quantities)}{f', runs={runs}' if runs else ''}"
            lines.append(f"p = sf.compare_estimators(s, {asks}, {at(grid)})")
            lines += [f"print(p.values({q!r}{', ' + of if of else ''})[..., -1])" for q in self.quantities]
        return "\n".join(lines) + "\n"


def _word(value: Any) -> str:
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _loaded(given: OpenedScenario, *, uniform: bool = False, **options: Any) -> Scenario:
    """A scenario under the name it came by."""
    if is_preset(given.name) and given.mapping == preset(given.name).mapping:
        return load_scenario(given.name, uniform_link=uniform, **options)
    try:
        return replace(load_scenario(given.mapping, uniform_link=uniform, **options), name=given.name)
    except ScenarioError as error:
        raise ScenarioError(given.name, error.problems or str(error).partition(": ")[2]) from None


def preset(name: str) -> OpenedScenario:
    """Return a preset as it comes."""
    return OpenedScenario(name, parse(name, read_text(name)[1]))


def links_of(text: str) -> list[float]:
    """Return the probabilities of `0:1:0.05`."""
    step = float(text.rpartition(":")[2])
    return [round(step * i, 12) for i in range(round(1 / step) + 1)]


FIELDS = {
    "network.agents": "agents", "network.steps": "steps", "network.architecture": "architecture", "model.Q": "q",
    "model.noise": "q", "model.R": "r", "model.sensor": "r", "initial.P": "p0", "network.radio": "power",
    "network.link": "link", "network.case": "link", "agents": "agents", "steps": "steps", "q": "q", "r": "r",
    "p0": "p0", "link": "link", "metric": "metric", "agent": "agent", "target": "target", "estimator": "estimators",
    "quantity": "quantities",
}  # fmt: skip
"""Fields of the page that keys of a scenario, and first words of messages, are about."""


def field_of(error: Exception, otherwise: str = "scenario") -> str:
    """Return the field of the page that an error is about."""
    paths = [p.path for p in error.problems] if isinstance(error, ScenarioError) else []
    for text in (*paths, str(error)):
        if text.startswith("agent["):
            return "times"
        for key, field in FIELDS.items():
            if text == key or text.startswith((f"{key}:", f"{key} ", f"{key}.", f"{key}[")):
                return field
    return otherwise
