"""The [navigation] table of a scenario file, read and checked: the errors of an inertial navigation system.

    [navigation]            latitude, height, speed, heading, rate, interval
    [[navigation.leg]]      duration, acceleration, turn_rate, climb
    [navigation.imu]        random walks, biases, instabilities, correlation times in the units of data sheets
    [navigation.initial]    attitude, velocity, position: standard deviations along north, east, down

Keys and units are those of `stochfuse.scenario.schema`; the mathematics is `stochfuse.fusion.inertial`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.fusion.inertial import ErrorModel, ImuGrade, InitialErrors, error_model
from stochfuse.fusion.trajectory import Leg, trajectory
from stochfuse.kalman.checks import shown
from stochfuse.scenario.checker import Checker, table_of, tables_of

MOST_TICKS = 1_000_000
"""Most propagation ticks: beyond, memory and patience end."""


class _Range(NamedTuple):
    """A number's bounds, in its unit; an open one excludes its lower end."""

    low: float
    high: float
    unit: str
    default: float | None = None
    open: bool = False

    def __str__(self) -> str:
        lower = f"above {self.low:g}" if self.open else f"of at least {self.low:g}"
        return f"a number {lower} and at most {self.high:g} {self.unit}"


_NAVIGATION = {
    "latitude": _Range(-85.0, 85.0, "° (north and east end at the poles)"),
    "height": _Range(-1e4, 1e5, "m", 0.0),
    "speed": _Range(0.0, 1e4, "m/s"),
    "heading": _Range(-360.0, 360.0, "°", 0.0),
    "rate": _Range(0.0, 1e5, "Hz", 100.0, open=True),
    "interval": _Range(0.0, 1e4, "s", 1.0, open=True),
}
_LEG = {
    "duration": _Range(0.0, 1e6, "s", open=True),
    "acceleration": _Range(-1e3, 1e3, "m/s²", 0.0),
    "turn_rate": _Range(-360.0, 360.0, "°/s", 0.0),
    "climb": _Range(-1e4, 1e4, "m/s", 0.0),
}
_IMU = {
    "angle_random_walk": _Range(0.0, 1e3, "°/√h"),
    "velocity_random_walk": _Range(0.0, 1e3, "m/s/√h"),
    "gyro_bias": _Range(0.0, 1e5, "°/h"),
    "gyro_instability": _Range(0.0, 1e5, "°/h"),
    "gyro_time": _Range(1e-3, 1e9, "s"),
    "accelerometer_bias": _Range(0.0, 1e3, "mg"),
    "accelerometer_instability": _Range(0.0, 1e3, "mg"),
    "accelerometer_time": _Range(1e-3, 1e9, "s"),
}
_INITIAL = {
    "attitude": _Range(0.0, 90.0, "°", open=True),
    "velocity": _Range(0.0, 1e4, "m/s", open=True),
    "position": _Range(0.0, 1e6, "m", open=True),
}


def read_navigation(check: Checker, table: Mapping[str, Any], steps: int) -> ErrorModel | None:
    """Read [navigation] for a network of so many steps; None where something is wrong, which the checker has noted."""
    before = len(check.problems)
    numbers = _numbers(check, "navigation", table, _NAVIGATION)
    legs = _legs(check, table.get("leg"))
    imu = _numbers(check, "navigation.imu", table_of(table, "imu"), _IMU)
    initial = _initial(check, table_of(table, "initial"))
    ticks = _ticks(check, numbers, steps)
    complete = len(numbers) == len(_NAVIGATION) and len(imu) == len(_IMU)
    if len(check.problems) > before or not complete or not legs or initial is None or ticks is None:
        return None
    span = (steps - 1) * numbers["interval"]
    total = sum(leg.duration for leg in legs)
    if total < span * (1 - 1e-9):
        check.note(
            "navigation.leg",
            f"legs of at least {span:g} s together, for {steps} steps of {numbers['interval']:g} s",
            f"{total:g} s",
        )
        return None
    try:
        path = trajectory(
            legs,
            speed=numbers["speed"],
            latitude=float(np.deg2rad(numbers["latitude"])),
            heading=float(np.deg2rad(numbers["heading"])),
            height=numbers["height"],
            rate=numbers["rate"],
            # two ticks at least, for a network of one step
            duration=min(max(span, 2.0 / numbers["rate"]), total),
        )
    except UsageError as reason:
        check.note("navigation.leg", "a way that a vehicle can take", f"({reason})")
        return None
    grade = ImuGrade.from_data_sheet(
        angle_random_walk=imu["angle_random_walk"],
        velocity_random_walk=imu["velocity_random_walk"],
        gyro=_drift(imu, "gyro"),
        accelerometer=_drift(imu, "accelerometer"),
    )
    return error_model(path, grade, initial, steps, ticks)


def _drift(imu: Mapping[str, float], sensor: str) -> tuple[float, float, float]:
    return imu[f"{sensor}_bias"], imu[f"{sensor}_instability"], imu[f"{sensor}_time"]


def _numbers(check: Checker, path: str, table: Mapping[str, Any], ranges: Mapping[str, _Range]) -> dict[str, float]:
    """Return the numbers that are right, each within its range or its default."""
    numbers = {}
    for key, bounds in ranges.items():
        value = table.get(key, bounds.default)
        number = check.number(f"{path}.{key}", value, str(bounds), partial(_within, bounds))
        if number is not None:
            numbers[key] = number
    return numbers


def _within(bounds: _Range, array: np.ndarray) -> bool:
    lower = array > bounds.low if bounds.open else array >= bounds.low
    return bool((lower & (array <= bounds.high)).all())


def _legs(check: Checker, value: Any) -> list[Leg]:
    if isinstance(value, list) and not value:
        check.note("navigation.leg", "at least one [[navigation.leg]] table", "none")
    legs = []
    for i, table in enumerate(tables_of(value), start=1):
        numbers = _numbers(check, f"navigation.leg[{i}]", table, _LEG)
        if len(numbers) == len(_LEG):
            legs.append(Leg(**{**numbers, "turn_rate": float(np.deg2rad(numbers["turn_rate"]))}))
    return legs


def _initial(check: Checker, table: Mapping[str, Any]) -> InitialErrors | None:
    deviations = {}
    for key, bounds in _INITIAL.items():
        vector = check.vector(f"navigation.initial.{key}", table.get(key), 3)
        if vector is not None and not _within(bounds, vector):
            check.note(f"navigation.initial.{key}", f"three standard deviations, each {bounds}", shown(table[key]))
        elif vector is not None:
            deviations[key] = vector[:, 0]
    if len(deviations) < len(_INITIAL):
        return None
    return InitialErrors(**{**deviations, "attitude": np.deg2rad(deviations["attitude"])})


def _ticks(check: Checker, numbers: Mapping[str, float], steps: int) -> int | None:
    """Return the ticks from one step to the next."""
    if "rate" not in numbers or "interval" not in numbers:
        return None
    exact = numbers["rate"] * numbers["interval"]
    ticks = round(exact)
    if ticks < 1 or abs(exact - ticks) > 1e-6:
        expected = f"a whole number of ticks in each interval of {numbers['interval']:g} s"
        check.note("navigation.rate", expected, f"{exact:g} at {numbers['rate']:g} Hz")
    elif ticks * (steps - 1) > MOST_TICKS:
        check.note("navigation.rate", f"at most {MOST_TICKS} ticks in all", f"{ticks * (steps - 1)}")
    else:
        return ticks
    return None
