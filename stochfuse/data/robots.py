"""A record of robots that see landmarks and one another: read, checked, and brought onto one clock.

A folder holds four tables with headings, as excerpts of the UTIAS multi-robot cooperative localisation and mapping
data set (Leung, Halpern, Barfoot and Liu 2011) are given:

    odometry.csv    time [s], robot, speed [m/s], turn_rate [rad/s]     at equal intervals T, the same for all robots
    sightings.csv   time [s], robot, subject, range [m], bearing [rad]  whenever; a subject is a robot or a landmark
    truth.csv       time [s], robot, x, y [m], heading [rad]            at the odometry's times
    landmarks.csv   landmark, x, y [m]

A robot's state is (x, y, θ); V and ω hold from step k to k + 1,

    x ← x + V T cos θ        y ← y + V T sin θ        θ ← θ + ω T

and it sees a subject at p, with Δ = p − (x, y), as range |Δ| and bearing atan2(Δ_y, Δ_x) − θ.  A sighting between two
steps is told as from the nearest one: the robot's own motion in the at most T/2 between, by its odometry, is taken
out of range and bearing.

What cannot be right is refused with file, line and column.  Units are compared with the truth: degrees for radians,
millimetres or a clock in milliseconds are off by factors that no sensor errs by.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stochfuse.data.columns import WHOLE, ColumnField, Columns, read_columns
from stochfuse.errors import UsageError
from stochfuse.scenario.sensing import wrapped

FILES = {
    "odometry": (ColumnField("time"), ColumnField("robot", WHOLE), ColumnField("speed"), ColumnField("turn_rate")),
    "sightings": (
        ColumnField("time"),
        ColumnField("robot", WHOLE),
        ColumnField("subject", WHOLE),
        ColumnField("range", least=0.0),
        ColumnField("bearing"),
    ),
    "truth": (
        ColumnField("time"),
        ColumnField("robot", WHOLE),
        ColumnField("x"),
        ColumnField("y"),
        ColumnField("heading"),
    ),
    "landmarks": (ColumnField("landmark", WHOLE), ColumnField("x"), ColumnField("y")),
}
"""The tables of a folder, and their columns."""
JITTER = 0.01
"""Share of the interval by which a time may be off the clock: rounding of what is written."""
FACTOR = 2.5
"""By how much an honest sensor's typical value may differ from the truth's; degrees differ by 57."""
ASIDE = 0.5
"""Typical error of a bearing [rad] from which on it cannot be one in radians from the heading, anticlockwise."""


class Sightings(NamedTuple):
    """Sightings in order of their steps, landmarks before robots.

    Parameters
    ----------
    step : (sightings,) counted from 0.
    robot, subject : (sightings,) who sees whom: robots are counted from 0, landmarks on from there.
    range, bearing : (sightings,) as seen at the step [m, rad].
    """

    step: np.ndarray
    robot: np.ndarray
    subject: np.ndarray
    range: np.ndarray
    bearing: np.ndarray

    def where(self, chosen: np.ndarray) -> Sightings:
        """Return some of them."""
        return Sightings(*(column[chosen] for column in self))


@dataclass(frozen=True, eq=False)
class RobotRecord:
    """What robots did, saw and where they were.

    Parameters
    ----------
    source : the folder.
    interval : T [s].
    robots, landmarks : their numbers in the files.
    odometry : (steps, robots, 2) speed and turn rate.
    truth : (steps, robots, 3) x, y, heading, the heading without jumps.
    places : (landmarks, 2).
    sightings : of both kinds.
    """

    source: str
    interval: float
    robots: tuple[int, ...]
    landmarks: tuple[int, ...]
    odometry: np.ndarray
    truth: np.ndarray
    places: np.ndarray
    sightings: Sightings

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.odometry)

    def step_at(self, seconds: float) -> int:
        """Return the step at a time after the first."""
        return round(seconds / self.interval)

    def with_landmarks(self, number: int) -> RobotRecord:
        """Return the record with so many landmarks, evenly out of their list, and no sightings of the others.

        Raises
        ------
        UsageError
            If there are not so many.
        """
        n, m = len(self.robots), len(self.landmarks)
        if not 1 <= number <= m:
            raise UsageError(f"landmarks: expected 1 to {m}, got {number}")
        kept = np.unique((np.arange(number) + 0.5) * m // number).astype(int)
        seen = self.sightings.subject
        return replace(self, sightings=self.sightings.where((seen < n) | np.isin(seen - n, kept)))

    def subject_places(self, sightings: Sightings) -> np.ndarray:
        """Return where the subjects of sightings truly are, (sightings, 2)."""
        n = len(self.robots)
        of_robots = self.truth[sightings.step, np.minimum(sightings.subject, n - 1), :2]
        fixed = self.places[np.maximum(sightings.subject - n, 0)]
        return np.where((sightings.subject < n)[:, None], of_robots, fixed)


def moved(x: np.ndarray, motion: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Move states (..., 3) on by speeds and turn rates (..., 2); with the Jacobian (..., 3, 3)."""
    run = motion[..., 0] * seconds
    across, along = run * np.sin(x[..., 2]), run * np.cos(x[..., 2])
    there = x + np.stack(np.broadcast_arrays(along, across, motion[..., 1] * seconds), axis=-1)
    F = np.zeros((*there.shape, 3))
    F[..., [0, 1, 2], [0, 1, 2]] = 1.0
    F[..., 0, 2], F[..., 1, 2] = -across, along
    return there, F


def seen(x: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range and bearing (..., 2) of places (..., 2) from states (..., 3), and the Jacobian (..., 2, 3) in the observer.

    That in the place is the negative of its first two columns.
    """
    dx, dy = place[..., 0] - x[..., 0], place[..., 1] - x[..., 1]
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    H = np.zeros((*distance.shape, 2, 3))
    H[..., 0, 0], H[..., 0, 1] = -dx / distance, -dy / distance
    H[..., 1, 0], H[..., 1, 1], H[..., 1, 2] = dy / distance**2, -dx / distance**2, -1.0
    return np.stack([distance, wrapped(np.arctan2(dy, dx) - x[..., 2])], axis=-1), H


def read_robots(folder: str | Path) -> RobotRecord:
    """Read a record.

    Parameters
    ----------
    folder : holds odometry.csv, sightings.csv, truth.csv and landmarks.csv.

    Raises
    ------
    UsageError
        If a table is missing or spoilt, units are not those above, or the tables do not fit together.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"{folder}: expected a folder with {', '.join(f'{name}.csv' for name in FILES)}, found none")
    tables = {name: _table(folder / f"{name}.csv", fields) for name, fields in FILES.items()}
    robots = tuple(int(r) for r in np.unique(tables["odometry"].number["robot"]))
    places = tables["landmarks"]
    landmarks = tuple(int(m) for m in places.number["landmark"])
    for row, number in enumerate(landmarks):
        if number in robots or number in landmarks[:row]:
            raise places.error(row, "landmark", "a number that no other landmark or robot has", number)
    times, odometry = _on_clock(tables["odometry"], robots, None, ("speed", "turn_rate"))
    _, truth = _on_clock(tables["truth"], robots, times, ("x", "y", "heading"))
    truth[..., 2] = np.unwrap(truth[..., 2], axis=0)
    xy = np.stack([places.number["x"], places.number["y"]], axis=1)
    sightings = _sightings(tables["sightings"], (*robots, *landmarks), len(robots), times, odometry)
    interval = float(times[-1] - times[0]) / (len(times) - 1)
    record = RobotRecord(str(folder), interval, robots, landmarks, odometry, truth, xy, sightings)
    _check_units(record, folder)
    return record


def _table(path: Path, fields: tuple[ColumnField, ...]) -> Columns:
    if not path.is_file():
        raise UsageError(f"{path}: expected a table with columns {', '.join(f.name for f in fields)}, found no file")
    found = read_columns(str(path), fields)
    for field in fields:
        found.refuse(~np.isfinite(found.number[field.name]), field.name, "a finite number")
    return found


def _on_clock(
    table: Columns, robots: tuple[int, ...], times: np.ndarray | None, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Times of the steps, and columns as (steps, robots, columns); the first robot's times are the clock where None."""
    time, robot = table.number["time"], table.number["robot"]
    values = []
    for number in robots:
        rows = np.flatnonzero(robot == number)
        if len(rows) < 3:
            raise UsageError(f"{table.source}: expected 3 rows or more of robot {number}, got {len(rows)}")
        late = np.flatnonzero(np.diff(time[rows]) <= 0)
        if len(late):
            row = int(rows[late[0] + 1])
            raise table.error(row, "time", f"later than {time[rows[late[0]]]:g}, as robot {number} goes on", time[row])
        if times is None:
            interval = float(np.median(np.diff(time[rows])))
            times = time[rows[0]] + interval * np.arange(len(rows))
        slack = JITTER * (times[1] - times[0]) + 1e-9 * abs(times[-1])
        off = np.flatnonzero(np.abs(time[rows][: len(times)] - times[: len(rows)]) > slack)
        if len(off):
            row = int(rows[off[0]])
            expected = f"{times[off[0]]:g}, every {times[1] - times[0]:g} s, for robot {number}"
            raise table.error(row, "time", expected, time[row])
        if len(rows) != len(times):
            raise table.error(int(rows[-1]), "time", f"{len(times)} rows of robot {number} in all", len(rows))
        values.append(np.stack([table.number[name][rows] for name in names], axis=1))
    table.refuse(~np.isin(robot, robots), "robot", f"one of {', '.join(map(str, robots))}, as in odometry.csv")
    assert times is not None
    return times, np.stack(values, axis=1)


def _sightings(table: Columns, numbers: tuple[int, ...], n: int, times: np.ndarray, odometry: np.ndarray) -> Sightings:
    time, place = table.number["time"], {number: at for at, number in enumerate(numbers)}
    robot, subject = (np.array([place.get(int(v), -1) for v in table.number[c]]) for c in ("robot", "subject"))
    for column, wrong, expected in (
        ("robot", (robot < 0) | (robot >= n), "a robot of odometry.csv"),
        ("subject", subject < 0, "a landmark of landmarks.csv or a robot of odometry.csv"),
        ("subject", subject == robot, "another than the robot itself"),
        ("range", table.number["range"] <= 0, "a distance above 0"),
    ):
        table.refuse(wrong, column, expected)
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        row = int(back[0]) + 1
        raise table.error(row, "time", f"times in order, {time[row - 1]:g} or later", f"{time[row]:g}")
    T = times[1] - times[0]
    outside = (time < times[0] - T) | (time > times[-1] + T)
    table.refuse(outside, "time", f"a time from {times[0]:g} to {times[-1]:g} s, as in odometry.csv")
    step = np.clip(np.rint((time - times[0]) / T).astype(int), 0, len(times) - 1)
    after = time - times[step]
    # the odometry of the interval in which the sighting fell
    motion = odometry[np.maximum(step - (after < 0), 0), robot]
    turned, run = motion[:, 1] * after, motion[:, 0] * after
    bearing = table.number["bearing"] + turned
    ahead, left = run + table.number["range"] * np.cos(bearing), table.number["range"] * np.sin(bearing)
    order = np.lexsort((subject < n, step))
    whole = Sightings(step, robot, subject, np.hypot(ahead, left), np.arctan2(left, ahead))
    return whole.where(order)


def _check_units(record: RobotRecord, folder: Path) -> None:
    """Raise UsageError where typical values are not those that the truth asks for."""
    sightings, T = record.sightings, record.interval
    expected, _ = seen(record.truth[sightings.step, sightings.robot], record.subject_places(sightings))
    beside = np.median(np.abs(wrapped(sightings.bearing - expected[:, 1])))
    # over ten steps, so that the truth's own noise does not count
    stride = min(10, record.steps - 1)
    path = record.truth[::stride]
    whiles = stride * T
    driven = np.sqrt(np.mean(np.sum(np.diff(path[..., :2], axis=0) ** 2, axis=-1))) / whiles
    turned = np.sqrt(np.mean(np.diff(path[..., 2], axis=0) ** 2)) / whiles
    smooth = np.diff(np.cumsum(record.odometry, axis=0)[::stride], axis=0) / stride
    said = np.sqrt(np.mean(smooth**2, axis=(0, 1)))
    for file, column, unit, ratio in (
        ("odometry", "speed", "m/s", said[0] / max(driven, 1e-9)),
        ("odometry", "turn_rate", "rad/s", said[1] / max(turned, 1e-9)),
        ("sightings", "range", "m", np.median(sightings.range / np.maximum(expected[:, 0], 1e-9))),
    ):
        if not 1.0 / FACTOR < ratio < FACTOR:
            wanted = f"expected {unit} as truth.csv has it"
            raise UsageError(f"{folder / file}.csv, column '{column}': {wanted}, got {ratio:.3g} times that")
    if beside > ASIDE:
        raise UsageError(
            f"{folder / 'sightings.csv'}, column 'bearing': expected rad from the heading, anticlockwise, got "
            f"{beside:.3g} rad beside the truth in the median (degrees, or truth.csv's heading not in rad?)"
        )
