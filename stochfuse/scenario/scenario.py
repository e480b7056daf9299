"""A scenario: everything that is given.  Read from TOML or JSON, checked once, frozen.

    schema = "stochfuse.scenario/1"
    [model]      F, H, Q, R as nested lists or a number; optional G, B, u; optional states and units (names)
                 or kind, step, noise (`stochfuse.scenario.motion`), sensor (`stochfuse.scenario.sensing`)
    [initial]    P, correlation = "independent" | "shared", optional x and error (a known initial bias)
    [network]    agents, steps, architecture, link = number | matrix | one of either per step, optional delay, case
    [network.radio]  instead of link: a link budget, which gives it with the agents' positions
    [[agent]]    optional, for unlike agents: its own H, R, or a sensor by name; name and position

Step 1 holds the agents' initial estimates and the first exchange: nothing is predicted or measured before it (thesis
3.1).  With correlation = "independent" the initial errors are the agents' own, so that nothing is shared at step 1;
with "shared" all agents start from one common estimate.
"""

from __future__ import annotations

import copy
import json
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from numbers import Real
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from stochfuse.errors import Problem, ScenarioError, UsageError, nearest
from stochfuse.fusion.cooperative import Relation
from stochfuse.kalman.checks import shown
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.scenario.checker import Checker, table_of, tables_of
from stochfuse.scenario.model import Filter, Model, NoiseCorrelation, Sensor
from stochfuse.scenario.network import LinkRows, Network, default_rows, restricted, stacked_rows, uniform_rows
from stochfuse.scenario.registry import ESTIMATORS, GENERAL, METHODS, MONTE_CARLO
from stochfuse.scenario.sensing import Instrument, by_name, is_named, read_named
from stochfuse.scenario.system import System
from stochfuse.scenario.tables import read_filters, read_link, read_model, read_network, read_noise, read_sensors

SCHEMA = "stochfuse.scenario/1"
DEFAULT = "thesis-transient"
LINK_KEYS = ("link", "radio", "sent", "received", "case", "burst", "scale")
CORRELATIONS = ("independent", "shared")
_PRESETS = Path(__file__).parent / "presets"


@dataclass(frozen=True, repr=False)
class Scenario:
    """A checked scenario; make one with `load_scenario` or `Scenario.from_mapping`.

    Parameters
    ----------
    name : the preset's or the file's name.
    model : how the state moves.
    sensors : the different sensors among the agents.
    sensor_of : index into `sensors` for every agent.
    P0 : (d, d) covariance of each agent's initial estimate.
    correlation : "independent" or "shared".
    x0 : (d, 1) initial state estimate.
    error : (d, 1) known initial error, or None.
    network : agents and links.
    metric : the metric that the scenario asks to be shown, or None.
    source : the mapping it was made from, as the file has it.
    own : whether every agent has a state of its own.
    filters : each agent's own filter, where they differ from the model; else empty.
    noise : how measurement noises hang together, or None if they are independent.
    process : (Σd_i, Σd_i) process noise of all parallel filters together, or None if they have nothing in common.
    relations : what agent i measures of agent j, by (i, j) counted from 0.
    agent : number of the agent that the scenario asks to be shown, or None.
    method, estimator, runs : what the scenario asks to be predicted by, or None.
    instruments : each agent's sensor by name, the function that its H is linearised from, None for a sensor without a
        name; empty where there is none.
    nominal : (steps, d) states of the nominal path, or None.
    replaced : its own links that gave way to a caller's probability, in words; empty where they were one number.
    """

    name: str
    model: Model
    sensors: tuple[Sensor, ...]
    sensor_of: tuple[int, ...]
    P0: np.ndarray
    correlation: str
    x0: np.ndarray
    error: np.ndarray | None
    network: Network
    metric: str | None
    source: Mapping[str, Any]
    own: bool = False
    filters: tuple[Filter, ...] = ()
    noise: NoiseCorrelation | None = None
    process: np.ndarray | None = None
    relations: Mapping[tuple[int, int], Relation] = field(default_factory=dict)
    agent: int | None = None
    method: str | None = None
    estimator: str | None = None
    runs: int | None = None
    instruments: tuple[Instrument | None, ...] = ()
    nominal: np.ndarray | None = None
    replaced: str = ""

    def __repr__(self) -> str:
        """One line."""
        network, states = self.network, ", ".join(self.model.states[:8])
        return (
            f"Scenario({self.name}: {network.agents} agents, {network.architecture}, {network.steps} steps, state "
            f"({states}{', …' if len(self.model.states) > 8 else ''}))"
        )

    @cached_property
    def system(self) -> System:
        """The scenario as engines see it; see `stochfuse.scenario.system`."""
        return System.of(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], name: str = "scenario", folder: Path = Path()) -> Scenario:
        """Check a mapping with a scenario file's keys and make the scenario.

        Parameters
        ----------
        folder : what paths of files in it are relative to.

        Raises
        ------
        ScenarioError
            Naming every offending key, what was expected there and what came.
        """
        from stochfuse.scenario.schema import structure_problems

        mapping = with_links(as_file(mapping, name), name, folder)
        return _build(mapping, name, structure_problems(mapping))

    def until(self, step: int) -> Scenario:
        """Return the same up to an earlier step."""
        network = replace(
            self.network,
            steps=step,
            link=None if self.network.link is None else _first(self.network.link, step),
            cases=tuple((name, _first(link, step)) for name, link in self.network.cases),
        )
        source = dict(self.source)
        source["network"] = {**source.get("network", {}), "steps": step}
        return replace(self, network=network, source=source)

    def to_mapping(self) -> dict[str, Any]:
        """Return the mapping that the scenario was made from, with a file's keys."""
        return {"schema": SCHEMA, **copy.deepcopy(dict(self.source))}


def require_one_state(scenario: Scenario, who: str) -> None:
    """Raise UsageError unless all agents track the state of one model."""
    if not scenario.system.one_state:
        what = "states of their own (model.own)" if scenario.own else "filters of their own"
        raise UsageError(f"{who}: expected agents that track one state by one model, got agents with {what}")


def _first(link: np.ndarray, steps: int) -> np.ndarray:
    return link[:steps] if link.ndim in (1, 3) else link


def preset_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(path.stem for path in _PRESETS.glob("*.toml"))


def load_scenario(source: str | Path | Mapping[str, Any] = DEFAULT, **overrides: Any) -> Scenario:
    """Read a scenario.

    Parameters
    ----------
    source : a preset's name, a TOML or JSON file's path, "-" for standard input, or a mapping with a file's keys, whose
        lists and numbers may be NumPy's.
    **overrides : agents, steps, architecture, q, r, p0: numbers that take the place of network.agents, network.steps,
        network.architecture, model.Q, model.R and initial.P; `uniform_link=True` drops the file's link, radio, burst
        and cases, for a caller who gives the link probability.  For a state of several dimensions a number is that
        multiple of the identity.  Of a model with a kind q is its noise: the density, or the square of the standard
        deviation; of a sensor by name (model.sensor) r is the square of sigma.

    Raises
    ------
    ScenarioError
        If the file is missing or malformed, or naming every offending key.

    Examples
    --------
    >>> import stochfuse as sf
    >>> sf.load_scenario("thesis-transient", agents=5).network.agents
    5
    >>> sf.load_scenario({"model": {"F": 1, "H": 1, "Q": 1, "R": 4}, "initial": {"P": 10},
    ...                   "network": {"agents": 2, "steps": 3}}).model.dimension
    1
    """
    if isinstance(source, Mapping):
        return Scenario.from_mapping(_override(as_file(source, "scenario"), overrides))
    if not isinstance(source, str | Path):
        raise UsageError(
            f"scenario: expected a preset's name, a path, or a mapping with a file's keys, got {type(source).__name__}"
        )
    name, text = read_text(source)
    given = parse(name, text)
    gone = _own_links(given.get("network")) if overrides.get("uniform_link") else ""
    mapping = _override(given, overrides)
    # the presets' structure is checked by the tests; pydantic would double the time of a plain `predict`
    preset = is_preset(source)
    made = _build(mapping, name, []) if preset else Scenario.from_mapping(mapping, name, folder_of(source))
    return replace(made, replaced=gone)


def _own_links(network: Any) -> str:
    """What a scenario says of its links beyond one number, in words."""
    if not isinstance(network, Mapping):
        return ""
    words = {"radio": "a link budget", "burst": "bursts", "case": "cases", "sent": "packets", "scale": "a factor"}
    found, link = {key: what for key, what in words.items() if key in network}, network.get("link")
    if isinstance(link, Mapping):
        found["link"] = f"those of {link.get('file')}"
    elif isinstance(link, list):
        rows = [row for row in link if isinstance(row, list)]
        varied = any(isinstance(entry, list) for row in rows for entry in row)
        found["link"] = "a matrix per step" if varied else "a matrix" if rows else "one per step"
    return ", ".join(f"network.{key} ({what})" for key, what in found.items())


def with_links(mapping: Any, name: str, folder: Path) -> Any:
    """The mapping with the link probabilities of a file in the place of its name.

    Raises
    ------
    ScenarioError
        If the file does not fit the agents, or leaves a link unknown that may be heard.
    """
    network = mapping.get("network") if isinstance(mapping, Mapping) else None
    given = network.get("link") if isinstance(network, Mapping) else None
    if not isinstance(network, Mapping) or not (isinstance(given, Mapping) and isinstance(given.get("file"), str)):
        return mapping
    from stochfuse.scenario.links import as_network, read_links
    from stochfuse.scenario.schema import LinkFile, problems_of

    problems = problems_of(LinkFile, given)
    if problems:
        raise ScenarioError(name, [Problem(f"network.link.{p.path}", p.expected, p.got) for p in problems])
    try:
        found = read_links(folder / given["file"], columns=given.get("columns"))
    except UsageError as error:
        raise ScenarioError(name, [Problem("network.link.file", "a file of links", f"({error})")]) from None
    found = replace(found, source=given["file"])
    nodes = network.get("nodes") or all_names(mapping.get("agent"))
    network = network if nodes is None else {**network, "nodes": nodes}
    return {**mapping, "network": as_network(found, network, name, "network.link.file")}


def all_names(tables: Any) -> list[str] | None:
    """Names of [[agent]] tables that all have one."""
    listed = tables if isinstance(tables, list) else []
    given = [table.get("name") for table in listed if isinstance(table, Mapping)]
    names = [name for name in given if isinstance(name, str)]
    return names if names and len(names) == len(listed) else None


def checked_scenario(source: str | Path) -> Scenario:
    """Read a scenario with every check, presets included; see `load_scenario`."""
    name, text = read_text(source)
    return Scenario.from_mapping(parse(name, text), name, folder_of(source))


def folder_of(source: str | Path) -> Path:
    """What paths of files in a scenario are relative to."""
    return Path() if source == "-" or is_preset(source) else Path(source).parent


def as_file(mapping: Any, name: str) -> Any:
    """A mapping as a file would have it: lists for arrays, frames and tuples, Python's numbers for NumPy's.

    Raises
    ------
    ScenarioError
        If it is nested too deeply.
    """
    try:
        return _plain(mapping)
    except RecursionError:
        raise ScenarioError(name, "nested too deeply") from None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if hasattr(value, "to_numpy"):  # frames
        value = value.to_numpy()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


ScenarioLike = Scenario | str | Path | Mapping[str, Any]
"""What may stand for a scenario: one, a preset's name, a path, or a mapping with a file's keys."""
P = ParamSpec("P")
Answer = TypeVar("Answer")


def of_scenario(
    question: Callable[Concatenate[Scenario, P], Answer],
) -> Callable[Concatenate[ScenarioLike, P], Answer]:
    """Let a function of a scenario take whatever may stand for one."""

    @wraps(question)
    def asked(scenario: ScenarioLike, *args: P.args, **kwargs: P.kwargs) -> Answer:
        return question(scenario if isinstance(scenario, Scenario) else load_scenario(scenario), *args, **kwargs)

    return asked


def link_rows(scenario: Scenario, link: Any = None) -> LinkRows:
    """Return the rows of link probability that a caller asks for, checked.

    Parameters
    ----------
    link : link probabilities, one row each; or an array of shape (rows, agents, agents), one matrix each.  Default: the
        scenario's cases, else its link, else 0, 0.25, 0.5, 0.75 and 1.

    Raises
    ------
    UsageError
        If they are no probabilities or do not fit the agents.
    """
    network, check = scenario.network, Checker()
    if isinstance(link, LinkRows):
        return link
    if link is None:
        return default_rows(network)
    expected = f"link probabilities, or one {network.agents}×{network.agents} matrix of them per row"
    array = check.array("link", link, expected)
    if array is not None and array.ndim <= 1 and array.size:
        if array.min() >= 0 and array.max() <= 1:
            return restricted(uniform_rows(np.atleast_1d(array)), network)
        check.note("link", "probabilities between 0 and 1", f"{array.min() if array.min() < 0 else array.max():g}")
    elif array is not None and array.ndim == 3 and array.size:
        matrices = [
            read_link(check, "link", matrix, network.agents, network.steps, network.architecture) for matrix in array
        ]
        if not check.problems:
            return restricted(stacked_rows(None, [m for m in matrices if m is not None], network), network)
    elif array is not None:
        check.note("link", expected, f"an array of shape {array.shape}")
    raise UsageError("; ".join(map(str, check.problems)))


def is_preset(source: str | Path) -> bool:
    """Whether a source names a preset (a file of that name in the working directory does not hide it)."""
    return isinstance(source, str) and source in preset_names()


def read_text(source: str | Path) -> tuple[str, str]:
    """Return name and text of a preset, a file or standard input."""
    if is_preset(source):
        return str(source), (_PRESETS / f"{source}.toml").read_text(encoding="utf-8")
    known = preset_names()
    near = nearest(str(source), known)
    return read_file(source, f"no such file, and no preset of that name{near} (presets: {', '.join(known)})")


def read_file(source: str | Path, missing: str = "no such file") -> tuple[str, str]:
    """Return name and text of a file, or of standard input for "-".

    Raises
    ------
    ScenarioError
        If it cannot be read; `missing` is what to say where there is none.
    """
    if source == "-":
        if sys.stdin is None:
            raise ScenarioError("standard input", "closed")
        return "standard input", sys.stdin.read()
    if str(source) == "":
        raise ScenarioError("scenario", "expected a file or a preset's name, got nothing")
    path = Path(source)
    try:
        return str(path), path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ScenarioError(str(path), missing) from None
    except UnicodeDecodeError as error:
        raise ScenarioError(str(path), f"not a text file in UTF-8 (byte {error.start})") from None
    except OSError as error:
        raise ScenarioError(str(path), f"cannot be read: {error.strerror}") from None
    except ValueError:
        raise ScenarioError(shown(str(path)), "no name that a file can have") from None


def parse(name: str, text: str, help: str = "`stochfuse scenario new`") -> dict[str, Any]:
    """Parse TOML, or JSON if the text begins with a brace; `help` is what an empty text's author should see."""
    try:
        if text.lstrip("\ufeff \t\r\n").startswith("{") or name.lower().endswith(".json"):
            mapping = json.loads(text.lstrip("\ufeff"))
        else:
            mapping = tomllib.loads(text.lstrip("\ufeff"))
    except RecursionError:
        raise ScenarioError(name, "nested too deeply") from None
    except ValueError as error:
        raise ScenarioError(
            name, f"not valid {'JSON' if 'json' in type(error).__module__ else 'TOML'}: {error}"
        ) from None
    if not isinstance(mapping, dict):
        raise ScenarioError(name, f"expected a table of keys, got {shown(mapping)}")
    if not mapping:
        raise ScenarioError(name, f"empty; see {help}")
    return mapping


def _override(mapping: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    places = {
        "agents": ("network", "agents"),
        "steps": ("network", "steps"),
        "architecture": ("network", "architecture"),
        "q": ("model", "Q"),
        "r": ("model", "R"),
        "p0": ("initial", "P"),
    }
    network = mapping.get("network")
    if overrides.get("uniform_link") and isinstance(network, dict):
        mapping["network"] = {key: value for key, value in network.items() if key not in LINK_KEYS}
    for key, value in overrides.items():
        if value is None or key == "uniform_link":
            continue
        if key not in places:
            near = nearest(key, places)
            raise TypeError(f"load_scenario() got an unexpected keyword argument '{key}'{near}")
        table, entry = places[key]
        if isinstance(mapping.setdefault(table, {}), dict):
            if table == "model":
                _override_noise(mapping, entry, value)
            else:
                mapping[table][entry] = value
    return mapping


def _override_noise(mapping: dict[str, Any], entry: str, value: Any) -> None:
    """Put a noise covariance in the place of model.Q or R, or of what says it there by name.

    Raises
    ------
    UsageError
        If only agents' own sensors have an R, or if what is to have a root is no number.
    """
    model = mapping["model"]
    agents = tables_of(mapping.get("agent"))
    own = [table.get("sensor") is False or is_named(table.get("sensor")) or "R" in table for table in agents]
    if entry == "Q" and model.get("kind") is not None:
        model["noise"] = _root("q", value) if model.get("noise_kind") == "piecewise" else value
    elif entry == "R" and own and all(own) and "navigation" not in mapping:
        raise UsageError("r: expected a sensor of the model (model.R or model.sensor), got agents with their own alone")
    elif entry == "R" and is_named(model.get("sensor")):
        model["sensor"] = {**model["sensor"], "sigma": _root("r", value)}
    else:
        model[entry] = value


def _root(key: str, variance: Any) -> Any:
    """Standard deviation of a variance; a negative one is left for the reading to refuse."""
    if not isinstance(variance, Real):
        raise UsageError(f"{key}: expected a variance, in the place of a standard deviation, got {shown(variance)}")
    value = float(variance)
    return value**0.5 if value >= 0 else value


def _build(mapping: Mapping[str, Any], name: str, structure: list[Problem]) -> Scenario:
    if not isinstance(mapping, Mapping):
        raise ScenarioError(name, structure)
    check = Checker(skip={problem.path for problem in structure})
    tables = {key: table_of(mapping, key) for key in ("model", "initial", "network", "noise", "report")}
    agents, initial = tables_of(mapping.get("agent")), tables["initial"]
    network = read_network(check, tables["network"], agents)
    own = tables["model"].get("own") is True
    if isinstance(mapping.get("navigation"), dict):
        (model, P0), default = _navigation(check, mapping, network), None
    else:
        model, default = read_model(check, tables["model"], network.steps if network else 1)
        P0 = check.covariance("initial.P", initial.get("P"), model.dimension if model else None, 0)
    d = model.dimension if model else None
    filters = read_filters(check, agents, model, P0, own, network)
    named = read_named(check, tables["model"], agents, model, network, own)
    sensors, sensor_of = read_sensors(check, agents, default, d, filters, network, named.sensors, tables["model"])
    correlation = check.choice("initial.correlation", initial.get("correlation", "independent"), CORRELATIONS)
    if correlation == "shared" and (own or filters):
        check.note("initial.correlation", '"independent", since agents have states or filters of their own', "'shared'")
    x0 = check.vector("initial.x", initial.get("x"), d)
    error = check.vector("initial.error", initial.get("error"), d)
    noise, process = None, None
    if network is not None and len(sensor_of) == network.agents:
        noise, process = read_noise(check, tables["noise"], [sensors[s] for s in sensor_of], filters, own)
    relations = _relations(check, mapping, agents, model, network, own)
    shown = _report(check, tables["report"], model, network)
    problems = [*structure, *check.problems]
    if problems:
        raise ScenarioError(name, problems)
    if model is None or network is None or P0 is None or correlation is None:
        raise ScenarioError(name, "incomplete: [model], [initial] and [network] are needed")
    return Scenario(
        name=name,
        model=model,
        sensors=sensors,
        sensor_of=sensor_of,
        P0=P0,
        correlation=correlation,
        x0=np.zeros((model.dimension, 1)) if x0 is None else x0,
        error=error,
        network=network,
        source={key: value for key, value in mapping.items() if key != "schema"},
        own=own,
        filters=filters,
        noise=noise,
        process=process,
        relations=relations,
        instruments=named.instruments(network.agents, mapping.get("agent") is None),
        nominal=named.nominal,
        **shown,
    )


def _report(check: Checker, table: Mapping[str, Any], model: Model | None, network: Network | None) -> dict[str, Any]:
    """How the scenario asks to be predicted and shown: metric, agent, method, estimator and runs."""
    metric = table.get("metric")
    if isinstance(metric, str) and model is not None:
        try:
            metric_of(metric, model)
        except UsageError as reason:
            check.note("report.metric", "a metric of this model", f"'{metric}' ({reason})")
    method = check.choice("report.method", table.get("method"), METHODS)
    estimator = check.choice("report.estimator", table.get("estimator"), ESTIMATORS)
    if estimator is not None and method not in (None, GENERAL, MONTE_CARLO):
        check.note("report.estimator", 'report.method "general" or "monte-carlo", which average it', f'"{method}"')
    runs = check.integer("report.runs", table.get("runs"), 2)
    if method is None and (estimator is not None or runs is not None):
        method = GENERAL if runs is None else MONTE_CARLO
    agent = check.integer("report.agent", table.get("agent"), 1)
    if agent is not None and network is not None and agent > network.agents:
        check.note("report.agent", f"an agent from 1 to {network.agents}", str(agent))
    return {"metric": metric, "agent": agent, "method": method, "estimator": estimator, "runs": runs}


def _navigation(
    check: Checker, mapping: Mapping[str, Any], network: Network | None
) -> tuple[Model | None, np.ndarray | None]:
    """Model and first covariance of an inertial navigation system."""
    from stochfuse.scenario.navigation import read_navigation

    for key in ("model", "initial"):
        if key in mapping:
            check.note(key, "nothing beside [navigation], which takes its place", "a table")
    errors = read_navigation(check, mapping["navigation"], network.steps if network else 1)
    if errors is None:
        return None, None
    return Model(errors.F, errors.Q, np.zeros((len(errors.P0), 1)), errors.states, errors.units), errors.P0


def _relations(
    check: Checker,
    mapping: Mapping[str, Any],
    tables: Sequence[Mapping[str, Any]],
    model: Model | None,
    network: Network | None,
    own: bool,
) -> Mapping[tuple[int, int], Relation]:
    """What agents measure of each other."""
    if "cooperative" not in mapping and not (
        own and not by_name(mapping) and any("position" in table for table in tables)
    ):
        if own:
            check.note("cooperative", "what agents with states of their own measure of each other", "nothing")
        return {}
    if model is None or network is None:
        return {}
    from stochfuse.scenario.cooperative import read_cooperative

    if not own:
        check.note("model.own", "true, since agents measure each other's own places", "false")
    found = read_cooperative(check, mapping.get("cooperative"), tables, model.states, network.agents, network.steps)
    return found or {}
