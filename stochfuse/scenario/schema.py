"""The structure of a scenario file, for pydantic: which keys there are and what kind of value each takes.

Whether the numbers fit together (shapes, definiteness, probabilities) is checked where the tables are read
(`stochfuse.scenario.scenario`), for every scenario, wherever it comes from.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Strict, Tag, ValidationError
from pydantic.fields import FieldInfo

from stochfuse.errors import Problem, nearest
from stochfuse.kalman.checks import shown
from stochfuse.scenario.motion import NOISES, ORDERS
from stochfuse.scenario.sensing import KINDS

Number = Annotated[int, Strict()] | Annotated[float, Strict()]


class StrictTable(BaseModel):
    """A table: unknown keys are errors, and numbers that are not finite are left to the reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True)


Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]


class PairTable(StrictTable):
    """What one pair of agents measures, in place of what all pairs measure."""

    agents: list[Whole] = Field(description="the observer and the other, counted from 1")
    range: Number | None = Field(None, description="standard deviation of the distance; left out, none is measured")
    direction: Number | None = Field(
        None, description="standard deviation of the line of sight in rad; left out, none is measured"
    )
    time: Number | None = Field(
        None, description="standard deviation of the difference of the clocks; left out, none is measured"
    )
    H_i: Number | list[list[Number]] | None = Field(
        None, description="any linear relation y = H_i x_i + H_j x_j + s: (p, d), of the observer's state"
    )
    H_j: Number | list[list[Number]] | None = Field(None, description="(p, d), of the other's state")
    R: Number | list[list[Number]] | None = Field(None, description="(p, p) covariance of its noise s, or a number")
    none: Flag = Field(False, description="true: the two communicate and measure nothing of each other")
    both_ways: Flag = Field(True, description="whether the other measures the observer likewise, with noise of its own")


class CooperativeTable(StrictTable):
    """Agents that measure each other: relative range, line-of-sight direction, clocks, or any linear relation."""

    positions: list[str] | None = Field(
        None, description="names of the 2 or 3 states that are the place; needed for range and direction"
    )
    attitude: list[str] | None = Field(
        None,
        description="names of the state (in the plane: turned left) or 3 states (in space: small rotation about the "
        "axes of the place), in rad, that turn an agent's own frame, in which it measures directions; left out: known",
    )
    clock: str | None = Field(None, description="name of the state that is the clock's error, for time")
    time: Number | None = Field(
        None, description="standard deviation of the difference of every pair's clocks, in the clock's unit"
    )
    range: Number | None = Field(
        None, description="standard deviation of the distance of every pair, in the places' unit"
    )
    direction: Number | None = Field(
        None, description="standard deviation of the line of sight of every pair, in rad (of each of the two angles)"
    )
    pair: list[PairTable] | None = Field(None, description="pairs that measure otherwise")


Real = Annotated[float, Strict()]


class LegTable(StrictTable):
    """A part of the nominal way, with constant manoeuvre."""

    duration: Real = Field(description="s")
    acceleration: Real = Field(0.0, description="of the ground speed, m/s²")
    turn_rate: Real = Field(0.0, description="of the heading, °/s, positive to the right")
    climb: Real = Field(0.0, description="rate of climb at the end of the leg, reached evenly, m/s")


class ImuTable(StrictTable):
    """The inertial measurement unit, in the units of data sheets; alike on its three axes."""

    angle_random_walk: Real = Field(description="white noise of the gyros, °/√h")
    velocity_random_walk: Real = Field(description="white noise of the accelerometers, m/s/√h")
    gyro_bias: Real = Field(description="turn-on bias, standard deviation, °/h")
    gyro_instability: Real = Field(description="in-run bias, standard deviation, °/h")
    gyro_time: Real = Field(description="correlation time of the gyros' bias, s")
    accelerometer_bias: Real = Field(description="turn-on bias, standard deviation, mg")
    accelerometer_instability: Real = Field(description="in-run bias, standard deviation, mg")
    accelerometer_time: Real = Field(description="correlation time of the accelerometers' bias, s")


class InitialErrorsTable(StrictTable):
    """Standard deviations of the first estimate, along north, east and down; the biases' are the IMU's."""

    attitude: list[Real] = Field(description="about north, about east, of the heading, °")
    velocity: list[Real] = Field(description="m/s")
    position: list[Real] = Field(description="m")


class NavigationTable(StrictTable):
    """An inertial navigation system's 15 errors along a nominal way: takes the place of F, Q and the first P."""

    latitude: Real = Field(description="at the start, °")
    height: Real = Field(0.0, description="at the start, m above the ellipsoid")
    speed: Real = Field(description="ground speed at the start, m/s")
    heading: Real = Field(0.0, description="at the start, ° from north to the right")
    rate: Real = Field(100.0, description="propagation ticks per second, Hz")
    interval: Real = Field(1.0, description="from one step to the next, s; a whole number of ticks")
    leg: list[LegTable] = Field(description="the way, one [[navigation.leg]] after another")
    imu: ImuTable
    initial: InitialErrorsTable


Vector = Number | list[Number] | list[list[Number]]
Matrix = Number | list[list[Number]] | list[list[list[Number]]]
Link = Number | list[Number | list[Number] | list[list[Number]]]


Series = Number | list[Number]


class SensorTable(StrictTable):
    """A sensor by name, at its agent's position, or when that of H and R measures; nothing is measured at step 1."""

    kind: Literal[tuple(KINDS)] | None = Field(  # type: ignore[valid-type]
        None,
        description="what it measures of the target: "
        + ", ".join(KINDS)
        + "; bearing and azimuth are atan2(Δy, Δx); left out, with all but period, offset and detection: what H says",
    )
    sigma: Series | None = Field(None, description="standard deviation in m, m/s or rad, or one for each component")
    range: Number | None = Field(None, description="beyond this distance on the nominal path it measures nothing, m")
    field_of_view: Number | None = Field(None, description="full width about heading in which it measures, rad")
    heading: Series | None = Field(None, description="middle of the field of view, or one per step, rad; default 0")
    period: int = Field(1, ge=1, strict=True, description="it measures in steps 1 + offset + a multiple of this")
    offset: int = Field(0, ge=0, strict=True, description="steps by which its period begins later")
    detection: Series = Field(
        1.0, description="probability that it measures where it could, or one per step; independent of all else"
    )


def _form(value: Any) -> str:
    return "table" if isinstance(value, Mapping) else "flag"


SensorChoice = Annotated[
    Annotated[bool, Strict(), Tag("flag")] | Annotated[SensorTable, Tag("table")], Discriminator(_form)
]


class NominalTable(StrictTable):
    """The path that sensors by name are linearised about: a first state moved on by F, or a place per step."""

    position: Vector = Field(description="coordinates at step 1, or as many per step, m")
    velocity: Vector | None = Field(
        None, description="m/s, likewise; default 0, or how fast the places per step follow each other"
    )
    acceleration: Vector | None = Field(None, description="m/s², likewise; default 0")


class ModelTable(StrictTable):
    """Linear-Gaussian model x(k) = F x(k−1) + B u + G v, z(k) = H x(k) + w, with v ~ N(0, Q), w ~ N(0, R)."""

    F: Matrix | None = Field(None, description="state transition, d×d; its size is the number of states")
    H: Matrix | None = Field(None, description="measurement matrix, p×d")
    Q: Matrix | None = Field(None, description="process noise covariance, d×d, or as many as G has columns")
    R: Matrix | None = Field(None, description="measurement noise covariance, p×p, positive definite")
    kind: Literal[tuple(ORDERS)] | None = Field(  # type: ignore[valid-type]
        None, description="a model by name in the place of F and Q: " + ", ".join(ORDERS)
    )
    axes: int = Field(2, ge=1, strict=True, description="1, 2 or 3; states are ordered axis by axis: x, vx, y, vy")
    step: Series = Field(1.0, description="time since the step before in s, or one per step (the first is not used)")
    noise: Number | None = Field(
        None, description="of a kind: the white noise's density (continuous), or a standard deviation (piecewise)"
    )
    noise_kind: Literal[NOISES] = Field(  # type: ignore[valid-type]
        "continuous", description="continuous: white noise all the time; piecewise: one acceleration for each step"
    )
    turn_rate: Series | None = Field(None, description="of a coordinated turn, rad/s from x to y, or one per step")
    nominal: NominalTable | None = Field(None, description="where the target is meant to be, for sensors by name")
    sensor: SensorTable | None = Field(None, description="sensor by name in the place of H and R, at every position")
    own: bool = Field(False, strict=True, description="true: every agent has a state of its own, all of this model")
    G: Matrix | None = Field(None, description="process noise gain, default the identity")
    B: Matrix | None = Field(None, description="input matrix")
    u: Vector | None = Field(None, description="known input, needs B")
    states: list[str] | None = Field(None, description="names of the states")
    units: list[str] | None = Field(None, description="units of the states")


class InitialTable(StrictTable):
    """The estimates that the agents start with, at step 1."""

    P: Matrix = Field(description="covariance of each agent's first estimate, d×d")
    correlation: Literal["independent", "shared"] = Field(
        "independent", description="whether the agents' first errors are independent, or all start from one estimate"
    )
    x: Vector | None = Field(None, description="first state estimate, default zero")
    error: Vector | None = Field(None, description="known initial error (bias), common to all agents")


class BurstTable(StrictTable):
    """A bursty link (Gilbert and Elliott): good or bad, with a memory; each link on its own."""

    good_to_bad: Number = Field(description="probability that a good link is bad in the next step")
    bad_to_good: Number = Field(description="probability that a bad link is good in the next step")
    good: Number = Field(1.0, description="delivery probability of a good link")
    bad: Number = Field(0.0, description="delivery probability of a bad link")


class CaseTable(StrictTable):
    """A named alternative to network.link."""

    name: str
    link: Link | None = Field(None, description="as network.link; default network.link itself")
    burst: BurstTable | None = Field(None, description="as network.burst, instead of a link")


class LinkFile(StrictTable):
    """Links from a packet log or a file of link probabilities."""

    file: str = Field(description="its path, relative to the scenario file; see `stochfuse links`")
    columns: dict[str, str] | None = Field(
        None,
        description="its names of columns, by ours: { sender = 'src', receiver = 'dst' }; of seq, received, …",
    )


class RadioTable(StrictTable):
    """A radio link's budget: with the agents' places it gives the link probabilities."""

    transmit_power: Real = Field(description="dBm")
    gain: Real = Field(0.0, description="antenna gains of both ends, less what cables take, dB")
    exponent: Real = Field(2.0, description="of the path loss over distance; 2 in free space")
    reference_distance: Real = Field(1.0, description="m; nearer than that the loss is the reference loss")
    reference_loss: Real = Field(description="path loss at the reference distance, dB")
    sensitivity: Real = Field(description="least power that a receiver can read, dBm")
    fading: Literal["none", "rayleigh", "shadowing"] = Field(
        "none",
        description="none: all or nothing; rayleigh: block fading, drawn for each message; shadowing: log-normal",
    )
    shadowing: Real | None = Field(None, description="standard deviation of log-normal shadowing, dB")


class NetworkTable(StrictTable):
    """Who may hear whom, and how likely."""

    agents: int = Field(ge=1, strict=True, description="number of agents")
    steps: int = Field(ge=1, strict=True, description="number of time steps; step 1 exchanges the first estimates")
    architecture: Literal["ad-hoc", "broadcast", "cyclic"] = "ad-hoc"
    link: Link | LinkFile | None = Field(
        None,
        description="link probability: a number, a matrix (row: receiver, column: sender), or one of either per step; "
        "or { file = ... }, a packet log; left out, it is tabulated from 0 to 1",
    )
    sent: Number | list[list[Number]] | None = Field(
        None,
        description="packets sent on each link, a number or a matrix (row: receiver, column: sender), instead of link",
    )
    received: list[list[Number]] | None = Field(None, description="packets of these that were received")
    radio: RadioTable | None = Field(
        None, description="link probabilities from a link budget and every agent's position, instead of link"
    )
    scale: Number | None = Field(
        None, description="factor on the probability of every link that the scenario names, which stays 1 at most"
    )
    nodes: list[str] | None = Field(None, description="names of the agents in order: which nodes of a file they are")
    burst: BurstTable | None = Field(None, description="bursty links, instead of a link probability")
    hears: list[list[int]] | None = Field(
        None, description="for each agent the agents that it may hear; default: all that the architecture lets it hear"
    )
    delay: Number | list[Number | list[Number | list[Number]]] | None = Field(
        None,
        description="delay of messages in steps, or the probabilities of a delay of 0, 1, 2 … steps; or a matrix "
        "(row: receiver, column: sender) of either",
    )
    case: list[CaseTable] | None = Field(None, description="named alternatives to link, one row of the table each")


class AgentTable(StrictTable):
    """One agent's own sensor, filter and place, where they differ from the model's."""

    name: str | None = Field(None, description="name of the agent, its own; default: its number")
    H: Matrix | None = None
    R: Matrix | None = None
    sensor: SensorChoice = Field(
        True,
        description="a sensor by name in the place of H and R; period, offset and detection alone: when it measures, "
        "in the place of what model.sensor says; false: this agent measures nothing itself",
    )
    F: Matrix | None = Field(None, description="transition of the agent's own filter")
    Q: Matrix | None = Field(None, description="process noise of the agent's own filter")
    P: Matrix | None = Field(None, description="covariance of the agent's first estimate")
    M: Matrix | None = Field(None, description="mapping of a parallel filter's state into the state, x = M x_i + s")
    s: Vector | None = Field(None, description="offset of that mapping, default zero")
    position: Vector | None = Field(
        None,
        description="place in m, or one per step: of a sensor by name, for network.radio, and the nominal place for "
        "cooperative measurements",
    )


class NoiseTable(StrictTable):
    """How noises hang together that are otherwise independent."""

    correlation: Number | list[list[Number]] | None = Field(
        None, description="correlation of the agents' measurement noises: one number for all pairs, or a matrix"
    )
    disturbance: Number | list[Number] | list[list[Number]] | None = Field(
        None,
        description="bound on the covariance of an uncertain disturbance of the measurements: a variance for every "
        "component, the variances of one sensor's components, or a matrix over all agents' components",
    )
    process: list[list[Number]] | None = Field(
        None, description="process noise covariance of all parallel filters together, their states one below another"
    )


class ReportTable(StrictTable):
    """How results are shown where the command does not say."""

    metric: str | None = Field(None, description="default metric, as --metric takes it")
    method: str | None = Field(
        None, description="default method; where an estimator is named general, where runs are monte-carlo"
    )
    estimator: str | None = Field(None, description="default estimator, as --estimator takes it")
    runs: int | None = Field(None, ge=2, strict=True, description="default runs of method monte-carlo")
    agent: int | None = Field(None, ge=1, strict=True, description="whose estimate is shown; default: the mean")


class ScenarioFile(StrictTable):
    """A stochfuse scenario."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, title="stochfuse scenario", populate_by_name=False, serialize_by_alias=True
    )

    schema_: Literal["stochfuse.scenario/1"] = Field("stochfuse.scenario/1", alias="schema")
    description: str | None = None
    model: ModelTable | None = Field(None, description="needed unless there is a navigation table")
    initial: InitialTable | None = Field(None, description="needed unless there is a navigation table")
    navigation: NavigationTable | None = Field(None, description="inertial navigation, instead of model and initial")
    network: NetworkTable
    noise: NoiseTable | None = None
    cooperative: CooperativeTable | None = None
    agent: list[AgentTable] | None = Field(None, description="one entry per agent, for unlike agents")
    report: ReportTable | None = None


_KINDS = {
    "extra_forbidden": "a known key",
    "missing": "a value",
    "string_type": "text",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "list_type": "a list",
    "bool_type": "true or false",
    "model_type": "a table",
    "dict_type": "a table",
    "model_attributes_type": "a table",
}

_SHAPES = {
    "matrix": "a number or a matrix (a list of rows), or one such matrix per step",
    "vector": "a number, a list of numbers, or one list per step",
    "link": "a probability, a matrix of them, or one of either per step",
    "delay": "a number of steps, a list of probabilities, or a matrix of either",
    "place": "a list of coordinates, or one such list per step",
    "correlation": "a number or a matrix (a list of rows)",
    "disturbance": "a variance, a list of variances, or a matrix (a list of rows)",
    "series": "a number, or one per step",
    "deviation": "a standard deviation, or a list of them",
}
_FORMS = (("sensor", "flag"), ("sensor", "table"))
_SHAPE_OF = {
    **dict.fromkeys(("F", "H", "Q", "R", "G", "B", "P", "M"), "matrix"),
    **dict.fromkeys(("u", "x", "error", "s"), "vector"),
    **dict.fromkeys(("position", "velocity", "acceleration"), "place"),
    **dict.fromkeys(("step", "turn_rate", "heading", "detection"), "series"),
    "sigma": "deviation",
    "disturbance": "disturbance",
    "link": "link",
    "delay": "delay",
}


def structure_problems(mapping: Any) -> list[Problem]:
    """Return every key of a parsed file that is unknown, missing or of the wrong kind, once each."""
    problems = []
    if isinstance(mapping, dict) and "navigation" not in mapping:
        problems = [Problem(key, "a value", "nothing") for key in ("model", "initial") if key not in mapping]
        problems += _missing_matrices(mapping)
    known = {problem.path for problem in problems}
    return problems + [problem for problem in problems_of(ScenarioFile, mapping) if problem.path not in known]


def _missing_matrices(mapping: Mapping[str, Any]) -> list[Problem]:
    """Matrices of [model] that nothing else in the file says."""
    model, agents = mapping.get("model"), mapping.get("agent")
    if not isinstance(model, Mapping):
        return []
    motion = [] if model.get("kind") is not None else ["F", "Q"]
    # agents may all have sensors of their own, but half a sensor is none
    elsewhere = model.get("sensor") is not None or (agents and model.get("H") is None and model.get("R") is None)
    order = [key for key in ("F", "H", "Q", "R") if key in (motion if elsewhere else [*motion, "H", "R"])]
    return [Problem(f"model.{key}", "a value", "nothing") for key in order if model.get(key) is None]


def problems_of(
    structure: type[StrictTable], mapping: Any, expected: Mapping[str, str] = MappingProxyType({})
) -> list[Problem]:
    """Return every key of a parsed file that does not fit a structure, once each.

    Parameters
    ----------
    expected : what some keys take, by their paths, where the structure alone would not say it well.
    """
    problems: dict[str, Problem] = {}
    try:
        structure.model_validate(mapping)
    except ValidationError as error:
        for entry in error.errors(include_url=False, include_context=True):
            problem = _problem(structure, entry)
            for path, words in expected.items():
                if problem.path == path or problem.path.startswith((f"{path}.", f"{path}[")):
                    got = "nothing" if entry["type"] == "missing" else _got(entry, [])
                    problem = Problem(path, words, got)
            problems.setdefault(problem.path, problem)
    return list(problems.values())


def keys_of(structure: type[BaseModel], path: Sequence[Any]) -> list[str]:
    """Keys that the table at a path within a structure takes, as files have them; none where it is no table."""
    for part in path:
        if isinstance(part, int):
            continue
        fields = {field.alias or name: field.annotation for name, field in structure.model_fields.items()}
        inside = _tables(fields.get(part))
        if not inside:
            return []
        structure = inside[0]
    return [field.alias or name for name, field in structure.model_fields.items()]


def fields_at(structure: type[BaseModel], path: Sequence[str | int]) -> list[FieldInfo]:
    """Fields that a path within a structure may lead to; none where there is no such key."""
    tables, found = [structure], []
    for part in path:
        if isinstance(part, str):
            found = [
                field for table in tables for name, field in table.model_fields.items() if (field.alias or name) == part
            ]
            tables = [inside for field in found for inside in _tables(field.annotation)]
    return found


def key_paths(structure: type[BaseModel], prefix: str = "") -> list[str]:
    """Paths of all keys within a structure, lists without their places."""
    paths = []
    for name, field in structure.model_fields.items():
        path = f"{prefix}{field.alias or name}"
        paths += [path, *(key for inside in _tables(field.annotation) for key in key_paths(inside, f"{path}."))]
    return paths


_SYMBOL = r"(dBm|dBi|dB|MHz|kHz|Hz|rad|deg|mg|km|cm|mm|ms|min|steps|m|s|g|h|°)[²³]?"
_UNIT = re.compile(rf"√?{_SYMBOL}(/√?{_SYMBOL})*")


def unit(field: FieldInfo) -> str:
    """Unit of a key: from its metadata, else as its description names it (`…, °/h`, `… in rad`, `… [dBm]`)."""
    extra = field.json_schema_extra
    if isinstance(extra, dict) and isinstance(extra.get("unit"), str):
        return str(extra["unit"])
    pieces = re.split(r"[,;()\[\]]| in | above | or ", field.description or "")
    found = {piece.strip() for piece in pieces if _UNIT.fullmatch(piece.strip())}
    return found.pop() if len(found) == 1 else ""


def _tables(annotation: Any) -> list[type[BaseModel]]:
    """Tables within an annotation: of `list[Agent] | None` Agent."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables(part)]


def _problem(structure: type[BaseModel], entry: Any) -> Problem:
    location = _without_alternatives(entry["loc"])
    if location[:2] == ["noise", "correlation"]:
        return Problem("noise.correlation", _SHAPES["correlation"], _got(entry, location[2:]))
    for place, part in enumerate(location):
        if (part in _SHAPE_OF and place < len(location) - 1) or (part in _SHAPE_OF and entry["type"].endswith("_type")):
            # a union reports one error per alternative: say once what the key takes
            return Problem(_path(location[: place + 1]), _SHAPES[_SHAPE_OF[part]], _got(entry, location[place + 1 :]))
    kind, context = entry["type"], entry.get("ctx", {})
    if kind == "literal_error":
        expected = "one of " + str(context["expected"]).replace("'", '"').replace(" or ", ", ")
    elif kind == "greater_than_equal":
        expected = f"a whole number of at least {context['ge']}"
    elif entry["loc"][-1:] in (("int",), ("float",)):
        expected = _KINDS["float_type"]
    elif entry["loc"][-2:] == _FORMS[0]:
        expected = "true, false, or a table"
    else:
        expected = _KINDS.get(kind, str(entry["msg"]))
    if kind == "extra_forbidden":
        got = f"an unknown one, '{location[-1]}'{nearest(str(location[-1]), keys_of(structure, location[:-1]))}"
    else:
        got = "nothing" if kind == "missing" else shown(entry["input"])
    return Problem(_path(location) or "scenario", expected, got)


def _without_alternatives(location: Sequence[Any]) -> list[Any]:
    """Where a problem is, without what a union's alternatives are called."""
    kept = [part for before, part in zip((None, *location), location, strict=False) if (before, part) not in _FORMS]
    return kept[:-1] if kept[-1:] in (["int"], ["float"]) else kept


def _got(entry: Any, rest: list[Any]) -> str:
    indices = [part for part in rest if isinstance(part, int)]
    where = f" at [{', '.join(map(str, indices))}]" if indices else ""
    return shown(entry["input"]) + where


def _path(location: list[Any]) -> str:
    path = ""
    for part in location:
        path += f"[{part + 1}]" if isinstance(part, int) else f".{part}" if path else str(part)
    return path
