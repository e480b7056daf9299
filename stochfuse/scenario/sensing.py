"""Sensors by name: what they measure of a target, h(x), and H(x) that it is linearised to.

Target at p with velocity v, sensor at a with velocity v_a, Δ = p − a with length ρ, u = Δ/ρ; r the length of (Δx, Δy):

    position     p                                       ∂/∂p = I
    velocity     v                                       ∂/∂v = I
    range        ρ                                       ∂/∂p = uᵀ
    bearing      atan2(Δy, Δx), azimuth in space         ∂/∂p = (−Δy, Δx, 0)/r²
    elevation    atan2(Δz, r)                            ∂/∂p = (−ΔxΔz/r, −ΔyΔz/r, r)/ρ²
    range rate   uᵀ(v − v_a)                             ∂/∂p = (v − v_a)ᵀ(I − uuᵀ)/ρ,  ∂/∂v = uᵀ

A kind is a stack of these (`KINDS`).  Noise is R = diag(σ²).  Angles are in rad, and differences of them are wrapped
into [−π, π) (`residual`).

H(k) is H at the nominal path x*(k) of `stochfuse.scenario.motion`, seen from the sensor's own place at step k; v_a(k)
says how fast it came there from its place at step k − 1.  A sensor measures in step k if k − 1 − offset is a multiple
of its period, if ρ is at most its range, and if the bearing lies within half its field of view on either side of its
heading, all of it on the nominal path.  Where it does not measure, H(k) = 0 with R as ever.  At step 1 nothing is
measured.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, section 10.4 (range and
azimuth) and 11.7; the derivatives are elementary.  The linearisation is an assumption of what is predicted; the
functions here are the truth that an extended filter on data takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from stochfuse.fusion.cooperative import COINCIDENT, over_states
from stochfuse.kalman.checks import LARGEST, shown
from stochfuse.scenario.checker import Checker, table_of
from stochfuse.scenario.model import Model, Sensor, over_steps
from stochfuse.scenario.motion import PLACES, Course, Layout, layout_of, rates, read_course
from stochfuse.scenario.network import Network

NEAREST = 1e-30
"""Distance at which floating point ends: what is divided by its square stays below `LARGEST`."""
SMALLEST = 1e-50
"""Smallest standard deviation: its square is a number still."""
FULL_TURN = 2.0 * np.pi
MOST_STEPS = 100_000
"""Most steps of a network with sensors by name: each has matrices of its own for every step."""


class Sight(NamedTuple):
    """A target and the sensor that looks at it, (..., D) each; their leading axes broadcast.

    Parameters
    ----------
    place, velocity : of the target, in m and m/s.
    sensor, sensor_velocity : of the sensor.
    """

    place: np.ndarray
    velocity: np.ndarray
    sensor: np.ndarray
    sensor_velocity: np.ndarray

    @property
    def away(self) -> np.ndarray:
        """Δ, from the sensor to the target."""
        return self.place - self.sensor

    @property
    def rate(self) -> np.ndarray:
        """How Δ changes."""
        return self.velocity - self.sensor_velocity


class Slope(NamedTuple):
    """Derivatives of a measurement in the target's place and velocity, (..., p, D) each."""

    place: np.ndarray
    velocity: np.ndarray


class Part(NamedTuple):
    """One thing that a sensor measures.

    Parameters
    ----------
    value, slope : of a sight, (..., p) and its derivatives.
    unit : of a standard deviation.
    every_axis : whether it has a component for each axis, else one.
    moving : whether it needs the target's velocity.
    least : fewest axes that it can be measured in.
    looks : whether it matters where the sensor is.
    level : whether there is no direction above and below the target either, not only at its place.
    """

    value: Callable[[Sight], np.ndarray]
    slope: Callable[[Sight], Slope]
    unit: str
    every_axis: bool = False
    moving: bool = False
    least: int = 1
    looks: bool = True
    level: bool = False

    @property
    def angle(self) -> bool:
        """Whether it is an angle, so that differences wrap."""
        return self.unit == "rad"


def _length(away: np.ndarray) -> np.ndarray:
    return np.linalg.norm(away, axis=-1, keepdims=True)


def _unit(away: np.ndarray) -> np.ndarray:
    return away / _length(away)


def _of_place(rows: np.ndarray) -> Slope:
    return Slope(rows, np.zeros_like(rows))


def _ones(like: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.eye(like.shape[-1]), (*like.shape, like.shape[-1]))


def _velocity_slope(sight: Sight) -> Slope:
    rows = _ones(sight.away)
    return Slope(np.zeros_like(rows), rows)


def _bearing(sight: Sight) -> np.ndarray:
    return np.arctan2(sight.away[..., 1:2], sight.away[..., :1])


def _bearing_slope(sight: Sight) -> Slope:
    away = sight.away
    rows, level = np.zeros_like(away), away[..., :2]
    rows[..., :2] = np.stack([-level[..., 1], level[..., 0]], axis=-1) / _length(level) ** 2
    return _of_place(rows[..., None, :])


def _elevation(sight: Sight) -> np.ndarray:
    return np.arctan2(sight.away[..., 2:], _length(sight.away[..., :2]))


def _elevation_slope(sight: Sight) -> Slope:
    away = sight.away
    r, height = _length(away[..., :2]), away[..., 2:]
    rows = np.concatenate([-away[..., :2] * height / r, r], axis=-1) / _length(away) ** 2
    return _of_place(rows[..., None, :])


def _range_rate(sight: Sight) -> np.ndarray:
    return np.sum(_unit(sight.away) * sight.rate, axis=-1, keepdims=True)


def _range_rate_slope(sight: Sight) -> Slope:
    u = _unit(sight.away)
    across = sight.rate - u * np.sum(u * sight.rate, axis=-1, keepdims=True)
    rows, u = np.broadcast_arrays(across / _length(sight.away), u)
    return Slope(rows[..., None, :], u[..., None, :])


PARTS = {
    "position": Part(lambda s: s.place, lambda s: _of_place(_ones(s.away)), "m", every_axis=True, looks=False),
    "velocity": Part(lambda s: s.velocity, _velocity_slope, "m/s", every_axis=True, moving=True, looks=False),
    "range": Part(lambda s: _length(s.away), lambda s: _of_place(_unit(s.away)[..., None, :]), "m"),
    "bearing": Part(_bearing, _bearing_slope, "rad", least=2, level=True),
    "elevation": Part(_elevation, _elevation_slope, "rad", least=3, level=True),
    "range-rate": Part(_range_rate, _range_rate_slope, "m/s", moving=True),
}
KINDS = {
    "position": ("position",),
    "velocity": ("velocity",),
    "position-velocity": ("position", "velocity"),
    "range": ("range",),
    "range-rate": ("range-rate",),
    "bearing": ("bearing",),
    "range-bearing": ("range", "bearing"),
    "range-bearing-rate": ("range", "bearing", "range-rate"),
    "azimuth-elevation": ("bearing", "elevation"),
    "range-azimuth-elevation": ("range", "bearing", "elevation"),
    "range-azimuth-elevation-rate": ("range", "bearing", "elevation", "range-rate"),
}
"""What the sensors by name measure, in the order of their components."""


def parts_of(kind: str, axes: int) -> list[Part]:
    """What each component of a measurement is part of, in order."""
    parts = [PARTS[name] for name in KINDS[kind]]
    return [part for part in parts for _ in range(axes if part.every_axis else 1)]


def _looks(kind: str) -> bool:
    return any(PARTS[name].looks for name in KINDS[kind])


def observe(kind: str, sight: Sight) -> np.ndarray:
    """What a sensor would measure without noise, as a column.

    Parameters
    ----------
    kind : one of `KINDS`.
    sight : target and sensor in 1, 2 or 3 axes, as many as the kind needs at least.

    Returns
    -------
    (..., p, 1) array
        In m, m/s and rad; no number (NaN) where the target is at the sensor's place and there is no direction.
    """
    values = [PARTS[name].value(sight) for name in KINDS[kind]]
    shape = np.broadcast_shapes(*(M.shape[:-1] for M in sight))
    return np.concatenate([np.broadcast_to(v, (*shape, v.shape[-1])) for v in values], axis=-1)[..., None]


def slope(kind: str, sight: Sight) -> Slope:
    """Derivatives of `observe` in the target's place and velocity, each (..., p, D)."""
    found = [PARTS[name].slope(sight) for name in KINDS[kind]]
    shape = np.broadcast_shapes(*(M.shape[:-1] for M in sight))
    place, velocity = (
        np.concatenate([np.broadcast_to(M, (*shape, *M.shape[-2:])) for M in both], axis=-2)
        for both in zip(*found, strict=True)
    )
    return Slope(place, velocity)


def residual(kind: str, measured: np.ndarray, expected: np.ndarray, axes: int) -> np.ndarray:
    """Difference of two measurements (..., p, 1), that of angles wrapped into [−π, π)."""
    difference = np.subtract(measured, expected)
    angles = np.array([part.angle for part in parts_of(kind, axes)])[:, None]
    return np.where(angles, wrapped(difference), difference)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in rad, wrapped into [−π, π)."""
    return (angle + np.pi) % FULL_TURN - np.pi


@dataclass(frozen=True, eq=False)
class Instrument:
    """A sensor by name at an agent's place: the functions of the state that its matrices H come from.

    Parameters
    ----------
    kind : one of `KINDS`.
    layout : which states are places and velocities.
    place, velocity : (steps, D), the sensor's own.
    seen : (steps,) whether it measures, on the nominal path; never at step 1.
    """

    kind: str
    layout: Layout
    place: np.ndarray
    velocity: np.ndarray
    seen: np.ndarray

    @property
    def stands(self) -> bool:
        """Whether it measures at every step, from one place: steps beyond the path's are like those on it."""
        return not np.ptp(self.place, axis=0).any() and bool(self.seen[1:].all())

    def h(self, x: np.ndarray, step: int) -> np.ndarray:
        """What states x (..., d, 1) would show at a step (counted from 1): (..., p, 1)."""
        return observe(self.kind, self._sight(x, step))

    def H(self, x: np.ndarray, step: int) -> np.ndarray:  # noqa: N802  the mathematics' name
        """Derivative of h at states x (..., d, 1): (..., p, d)."""
        return _over(slope(self.kind, self._sight(x, step)), self.layout, x.shape[-2])

    def residual(self, measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Difference of two measurements (..., p, 1), angles wrapped."""
        return residual(self.kind, measured, expected, self.layout.axes)

    def _sight(self, x: np.ndarray, step: int) -> Sight:
        now = min(step, len(self.place)) - 1  # later only for one that `stands`
        return _sight(self.layout, x[..., 0], self.place[now], self.velocity[now])


def _sight(layout: Layout, x: np.ndarray, place: np.ndarray, velocity: np.ndarray) -> Sight:
    """Target and sensor from states (..., d)."""
    p = x[..., list(layout.place)]
    return Sight(p, x[..., list(layout.velocity)] if layout.velocity else np.zeros_like(p), place, velocity)


def _over(slope: Slope, layout: Layout, d: int) -> np.ndarray:
    H = over_states(slope.place, layout.place, d)
    return H + over_states(slope.velocity, layout.velocity, d) if layout.velocity else H


class Named(NamedTuple):
    """The sensors by name of a scenario.

    Parameters
    ----------
    of : by agent, counted from 0, the sensor and the instrument behind it; None where something is wrong with it.
        Without [[agent]] tables there is one, agent 0's, and all have it.
    nominal : (steps, d) states of the nominal path, or None.
    """

    of: Mapping[int, tuple[Sensor, Instrument] | None]
    nominal: np.ndarray | None = None

    @property
    def sensors(self) -> dict[int, Sensor | None]:
        """The sensors alone."""
        return {i: None if both is None else both[0] for i, both in self.of.items()}

    def instruments(self, agents: int, alike: bool) -> tuple[Instrument | None, ...]:
        """Every agent's; empty where no sensor has a name."""
        if not self.of:
            return ()
        found = [self.of.get(0 if alike else i) for i in range(agents)]
        return tuple(None if both is None else both[1] for both in found)


def by_name(mapping: Mapping[str, Any]) -> bool:
    """Whether a scenario has a sensor by name."""
    agents = mapping.get("agent")
    tables = [mapping.get("model"), *(agents if isinstance(agents, list) else [])]
    return any(isinstance(table, Mapping) and is_named(table.get("sensor")) for table in tables)


SOMETIMES = ("period", "offset", "detection")
"""What a sensor table may say of H and R as well."""


def is_named(table: Any) -> bool:
    """Whether a sensor table says what is measured, and not only when."""
    return isinstance(table, Mapping) and not set(table) <= set(SOMETIMES)


def sometimes(check: Checker, path: str, table: Any, sensor: Sensor, steps: int) -> Sensor:
    """Let a sensor of H and R measure when its table, which may be none, says."""
    if not isinstance(table, Mapping) or is_named(table):
        return sensor
    due, H = _due(check, path, table, steps), sensor.H
    detection = _detection(check, f"{path}.detection", table.get("detection", 1.0), steps)
    if due is not None and not due.all():
        H = over_steps(H, steps) * due[:, None, None]
    return replace(sensor, H=H, detection=detection)


class _SensingContext(NamedTuple):
    """What sensors are read beside.

    Parameters
    ----------
    layout : which states are places, None where they do not tell.
    course : what sensors look at, None where it is wrong.
    nominal : whether there is a [model.nominal].
    own : whether every agent has a state of its own.
    """

    layout: Layout | None
    course: Course | None
    model: Model
    steps: int
    nominal: bool
    own: bool

    @property
    def path(self) -> np.ndarray | None:
        """The nominal path."""
        return None if self.course is None else self.course.path


class _Read(NamedTuple):
    """A sensor's table, read: what holds wherever the sensor is.

    Parameters
    ----------
    path : of the table.
    due : (steps,) whether its period has it measure.
    reach, width : range and field of view; infinite where there is no limit.
    heading : () or (steps,) middle of the field of view.
    """

    path: str
    kind: str
    layout: Layout
    R: np.ndarray
    due: np.ndarray
    reach: float
    width: float
    heading: np.ndarray
    detection: np.ndarray | None

    @property
    def looks(self) -> bool:
        """Whether it matters where the sensor is."""
        return _looks(self.kind) or bool(np.isfinite([self.reach, self.width]).any())


def read_named(
    check: Checker,
    table: Mapping[str, Any],
    tables: Sequence[Mapping[str, Any]],
    model: Model | None,
    network: Network | None,
    own: bool,
) -> Named:
    """Read model.sensor, model.nominal, [[agent]] sensor and position: the sensors by name.

    Parameters
    ----------
    table, tables : [model], and the [[agent]] tables.
    own : whether every agent has a state of its own.
    """
    common = table_of(table, "sensor") if is_named(table.get("sensor")) else {}
    named = [i for i, agent in enumerate(tables) if is_named(agent.get("sensor"))]
    if model is None or network is None or not (common or named or table.get("nominal")):
        return Named(dict.fromkeys(named))
    if network.steps > MOST_STEPS:
        check.note("network.steps", f"at most {MOST_STEPS} with sensors by name or a nominal path", str(network.steps))
        return Named(dict.fromkeys([0, *named]))
    layout, steps = layout_of(table.get("kind"), model.states), network.steps
    course = read_course(check, table, layout, model, steps)
    given = _SensingContext(layout, course, model, steps, table.get("nominal") is not None, own)
    default = None
    if common:
        check.absent("model", table, ("H", "R"), "nothing beside a sensor by name")
        default = _read(check, "model.sensor", common, given)
    if common and not tables:
        return Named({0: None if default is None else _placed(check, "agent", None, default, given)}, given.path)
    found: dict[int, tuple[Sensor, Instrument] | None] = {}
    for i, agent in enumerate(tables):
        path = f"agent[{i + 1}]"
        if i in named:
            check.absent(path, agent, ("H", "R"), "nothing beside a sensor by name")
            sensor = _read(check, f"{path}.sensor", agent["sensor"], given)
        elif common and agent.get("sensor") is not False and not {"H", "R"} & set(agent):
            # when it measures may be its own
            when = table_of(agent, "sensor")
            merged = {**common, **when}
            sensor = _read(check, f"{path}.sensor", merged, given) if when and default is not None else default
        else:
            _place(check, path, agent.get("position"), given)
            continue
        check.absent(path, agent, ("F", "M", "s"), MODEL_STATES)
        found[i] = None if sensor is None else _placed(check, path, agent.get("position"), sensor, given)
    return Named(found, given.path)


MODEL_STATES = "nothing beside a sensor by name, which measures the model's states; or H and R instead of it"


def _read(check: Checker, path: str, table: Mapping[str, Any], given: _SensingContext) -> _Read | None:
    """Read one sensor's table."""
    if table.get("kind") is None:
        expected = "one of " + ", ".join(f'"{known}"' for known in KINDS)
        check.note(f"{path}.kind", f"{expected}, or H and R with {', '.join(SOMETIMES)} alone", "nothing")
    kind = check.choice(f"{path}.kind", table.get("kind"), tuple(KINDS))
    due = _due(check, path, table, given.steps)
    detection = _detection(check, f"{path}.detection", table.get("detection"), given.steps)
    layout = None if kind is None or not _fits(check, f"{path}.kind", kind, given) else given.layout
    if kind is None or layout is None:
        return None
    if table.get("sigma") is None:
        check.note(f"{path}.sigma", f'standard deviations of a "{kind}"', "nothing")
    R = _noise(check, f"{path}.sigma", table.get("sigma"), kind, layout.axes)
    reach = _above_zero(check, f"{path}.range", table.get("range"), "a distance above 0 in m", LARGEST)
    width = _above_zero(
        check, f"{path}.field_of_view", table.get("field_of_view"), "a full width in rad above 0, at most 2π", FULL_TURN
    )
    heading = _heading(check, path, table, given.steps)
    if np.isfinite(width) and layout.axes < 2:
        check.note(f"{path}.field_of_view", "nothing on a line, which has no bearings", shown(table["field_of_view"]))
        return None
    if R is None or due is None or heading is None:
        return None
    read = _Read(path, kind, layout, R, due, reach, width, heading, detection)
    if given.own and read.looks:
        expected = "one that does not look from a place, since the states are the agents' own (model.own)"
        check.note(path, expected, f'"{kind}"' if _looks(kind) else f'a range or a field of view of "{kind}"')
        return None
    return read


def _fits(check: Checker, path: str, kind: str, given: _SensingContext) -> bool:
    """Whether the model has the states that a kind is about; notes why not."""
    parts, layout = [PARTS[name] for name in KINDS[kind]], given.layout
    if layout is None:
        check.note(path, f'{PLACES}, for a "{kind}"', f"states {', '.join(given.model.states)}")
        return False
    least = max(part.least for part in parts)
    if layout.axes < least:
        check.note(path, f'{least} axes for a "{kind}"', f"{layout.axes}")
        return False
    if any(part.moving for part in parts) and not layout.velocity:
        check.note(path, f'a model with velocities for a "{kind}"', f"states {', '.join(given.model.states)}")
        return False
    return True


def _noise(check: Checker, path: str, value: Any, kind: str, axes: int) -> np.ndarray | None:
    """R = diag(σ²) from one standard deviation, or one for each component."""
    units = [part.unit for part in parts_of(kind, axes)]
    p = len(units)
    every = f"{p} standard deviations above 0, a list in {', '.join(units)}"
    expected = f"a standard deviation above 0 in {units[0]}" if p == 1 else every
    if p > 1 and len(set(units)) == 1:
        expected = f"a standard deviation above 0 in {units[0]}, or a list of {p}"
    if value is None:
        check.note(path, expected, "nothing")
        return None
    sigma = check.array(path, value, expected)
    if sigma is None:
        return None
    scalar = sigma.ndim == 0 and len(set(units)) == 1
    if not (scalar or sigma.shape == (p,)) or not ((sigma > 0) & (sigma >= SMALLEST) & (sigma <= LARGEST**0.5)).all():
        check.note(path, expected, shown(value))
        return None
    return np.diag(np.broadcast_to(sigma, (p,)) ** 2)


def _due(check: Checker, path: str, table: Mapping[str, Any], steps: int) -> np.ndarray | None:
    """(steps,) whether a sensor's period has it measure."""
    period = check.integer(f"{path}.period", table.get("period", 1), 1)
    offset = check.integer(f"{path}.offset", table.get("offset", 0), 0)
    if period is None or offset is None:
        return None
    return (np.arange(steps) - offset) % period == 0


def _above_zero(check: Checker, path: str, value: Any, expected: str, most: float) -> float:
    """A number above 0; infinite where none is given."""
    number = check.number(path, value, expected, lambda number: 0 < number <= most)
    return np.inf if number is None else number


def _heading(check: Checker, path: str, table: Mapping[str, Any], steps: int) -> np.ndarray | None:
    value = table.get("heading")
    if value is not None and table.get("field_of_view") is None:
        check.note(f"{path}.heading", "nothing without a field_of_view", shown(value))
    return check.series(f"{path}.heading", 0.0 if value is None else value, "an angle in rad, or one per step", steps)


def _detection(check: Checker, path: str, value: Any, steps: int) -> np.ndarray | None:
    """Probability () or (steps,) that a sensor detects what it sees; None where it is certain."""
    expected = "a probability, or one per step"
    detection = check.series(path, value, expected, steps)
    if detection is None:
        return None
    if not ((detection >= 0) & (detection <= 1)).all():
        check.note(path, expected, shown(value))
        return None
    return None if (detection == 1).all() else detection


def _place(check: Checker, path: str, value: Any, given: _SensingContext) -> np.ndarray | None:
    """An agent's place as (steps, D); None where there is none, or where [cooperative] reads it."""
    if given.layout is None or given.own:
        return None
    axes = given.layout.axes
    place = check.place(f"{path}.position", value, axes, given.steps)
    return None if place is None else np.broadcast_to(place, (given.steps, axes))


def _placed(
    check: Checker, path: str, position: Any, read: _Read, given: _SensingContext
) -> tuple[Sensor, Instrument] | None:
    """Put a sensor at an agent's place; `path` is that of the agent's table, "agent" where there is none."""
    place = _place(check, path, position, given)
    if read.looks and position is None:
        axes = f"{read.layout.axes} coordinates" if read.layout.axes > 1 else "a coordinate"
        if path == "agent":
            check.note(path, f"one [[agent]] table with a position for each, where {read.path} is", "nothing")
        else:
            check.note(f"{path}.position", f"the place of its sensor, {axes} or as many per step", "nothing")
        return None
    if read.looks and not given.nominal:
        if not any(problem.path == "model.nominal" for problem in check.problems):
            expected = f"a nominal path (position, velocity), about which {read.path} ({read.kind}) is linearised"
            check.note("model.nominal", expected, "nothing")
        return None
    course = given.course
    if course is None or (read.looks and (place is None or given.path is None)):
        return None
    if place is None:
        place = np.zeros((given.steps, read.layout.axes))
    return _seeing(check, path, read, place, course, given.model.dimension)


def _seeing(
    check: Checker, path: str, read: _Read, place: np.ndarray, course: Course, d: int
) -> tuple[Sensor, Instrument] | None:
    """A sensor's matrices along the nominal path, and the instrument that they come from."""
    x = np.zeros((len(place), d)) if course.path is None else course.path
    velocity = rates(place, course.step)
    sight = _sight(read.layout, x, place, velocity)
    seen = read.due & _within(read, sight)
    near = seen & _no_direction(read.kind, sight)
    if near[1:].any():
        step = int(near[1:].argmax()) + 1
        got = f"{place[step].tolist()} with the target at {sight.place[step].tolist()} at step {step + 1}"
        check.note(f"{path}.position", f"a place away from the target's, for a {read.kind} to it", got)
        return None
    there = seen & ~near
    H = np.zeros((len(x), len(read.R), d))
    H[there] = _over(slope(read.kind, Sight(*(M[there] for M in sight))), read.layout, d)
    H = H[-1] if (H[1:] == H[-1]).all() else H
    for M in (H, read.R, place, velocity):
        M.setflags(write=False)
    seen = seen & (np.arange(len(seen)) > 0)
    return Sensor(H, read.R, read.detection), Instrument(read.kind, read.layout, place, velocity, seen)


def _within(read: _Read, sight: Sight) -> np.ndarray:
    """Whether the target is within range and field of view, (steps,)."""
    within = _length(sight.away)[:, 0] <= read.reach
    if np.isfinite(read.width):
        off = wrapped(_bearing(sight)[:, 0] - read.heading)
        within &= np.abs(off) <= 0.5 * read.width
    return within


def _no_direction(kind: str, sight: Sight) -> np.ndarray:
    """Whether the target is too near the sensor, or above or below it, for what a kind measures, (steps,)."""
    near = np.zeros(len(sight.place), dtype=bool)
    for level in {PARTS[name].level for name in KINDS[kind] if PARTS[name].looks}:
        axes = slice(0, 2) if level else slice(None)
        farthest = np.maximum(_length(sight.place[:, axes]), _length(sight.sensor[:, axes]))
        near |= (_length(sight.away[:, axes]) <= np.maximum(COINCIDENT * farthest, NEAREST))[:, 0]
    return near
