"""A manoeuvring vehicle over the Earth: what an inertial navigation system would feel along nominal legs.

Frames: n is north-east-down at the vehicle, b the vehicle (forward, right wing, down), e the Earth, i inertial space.
The Earth is the WGS-84 ellipsoid with R_N, R_E its radii of curvature along the meridian and across it; L is the
latitude, h the height, v the velocity over the ground in n, f the specific force (what accelerometers measure) in n:

    dL/dt = v_N/(R_N+h)      dh/dt = −v_D
    ω_ie  = Ω (cos L, 0, −sin L)                                                      Earth rate
    ω_en  = (v_E/(R_E+h), −v_N/(R_N+h), −v_E tan L/(R_E+h))                           transport rate
    f     = dv/dt − g(L, h) + (2ω_ie + ω_en) × v                                      the accelerometers
    ω_ib  = C_nb (ω_ie + ω_en) + ω_nb,   [ω_nb×] = C_nb dC_bn/dt                      the gyros

P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems" (2nd ed., 2013), sections
2.4, 5.4; D. H. Titterton and J. L. Weston, "Strapdown Inertial Navigation Technology" (2nd ed., 2004), chapter 3.
Gravity at height 0 is Somigliana's formula (Groves section 2.4.7); above it falls as 1/(1 + h/R)², R = √(R_N R_E),
which leaves the centrifugal part aside.

The nose points along the velocity (no angle of attack, no sideslip) and the vehicle banks so that the specific force is
perpendicular to its wings (a coordinated turn).  The legs' accelerations and turn rates are rounded off over
`ROLL_IN` seconds about each change, as no vehicle banks at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError

EARTH_RATE = 7.292115e-5
"""Rotation of the Earth, rad/s (WGS-84)."""
STANDARD_GRAVITY = 9.80665
"""m/s² in one g, the unit of accelerometer data sheets."""
ROLL_IN = 2.0
"""Seconds that a change of acceleration or turn rate takes."""
_EQUATORIAL_RADIUS = 6378137.0
_ECCENTRICITY_SQUARED = 6.69437999014e-3
_LEAST_LIFT = 1.0
_HIGHEST_LATITUDE = np.deg2rad(89.0)


@dataclass(frozen=True)
class Leg:
    """A part of the way with constant manoeuvre.

    Parameters
    ----------
    duration : s.
    acceleration : of the ground speed, m/s².
    turn_rate : of the heading, rad/s, positive to the right.
    climb : rate of climb at the end of the leg, m/s, reached evenly from that of the leg before (0 at the start).
    """

    duration: float
    acceleration: float = 0.0
    turn_rate: float = 0.0
    climb: float = 0.0


class Trajectory(NamedTuple):
    """The nominal motion at every tick, first axis: tick.

    Attributes
    ----------
    time : (ticks,) s from the start.
    latitude, height : (ticks,) rad and m.
    displacement : (ticks, 3) way from the start along north, east, down, m.
    velocity : (ticks, 3) over the ground in north, east, down, m/s.
    specific_force : (ticks, 3) in north, east, down, m/s².
    rate : (ticks, 3) angular rate of the vehicle against inertial space, in its own axes, rad/s.
    attitude : (ticks, 3, 3) C_bn, from the vehicle's axes (forward, right, down) to north, east, down.
    """

    time: np.ndarray
    latitude: np.ndarray
    height: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    specific_force: np.ndarray
    rate: np.ndarray
    attitude: np.ndarray


def radii(latitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the WGS-84 radii of curvature R_N (along the meridian) and R_E (across it), m, Groves (2.105), (2.106)."""
    flattening = 1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    return (
        _EQUATORIAL_RADIUS * (1.0 - _ECCENTRICITY_SQUARED) / flattening**1.5,
        _EQUATORIAL_RADIUS / np.sqrt(flattening),
    )


def geodetic(path: Trajectory, every: int = 1) -> np.ndarray:
    """Return latitude, longitude from the start (rad) and height (m) at every n-th tick, (n, 3)."""
    _, transverse = radii(path.latitude)
    rate = 1.0 / (path.time[1] - path.time[0])
    longitude = _integral(path.velocity[:, 1] / ((transverse + path.height) * np.cos(path.latitude)), rate)
    return np.stack([path.latitude, longitude, path.height], axis=-1)[::every]


def displaced(where: np.ndarray, ned: np.ndarray) -> np.ndarray:
    """Return latitude, longitude and height (..., 3) after small ways along north, east, down, m."""
    meridian, transverse = radii(where[..., 0])
    per_metre = [1 / (meridian + where[..., 2]), 1 / ((transverse + where[..., 2]) * np.cos(where[..., 0]))]
    return where + np.stack([per_metre[0] * ned[..., 0], per_metre[1] * ned[..., 1], -ned[..., 2]], axis=-1)


def gravity(latitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the size of gravity, m/s²: Somigliana at the ellipsoid, falling with the square of the distance above."""
    sine = np.sin(latitude) ** 2
    surface = 9.7803253359 * (1.0 + 0.001931853 * sine) / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * sine)
    meridian, transverse = radii(latitude)
    return surface / (1.0 + height / np.sqrt(meridian * transverse)) ** 2


def earth_rate(latitude: np.ndarray) -> np.ndarray:
    """Return ω_ie in north, east, down, shape (..., 3), rad/s."""
    return EARTH_RATE * np.stack([np.cos(latitude), np.zeros_like(latitude), -np.sin(latitude)], axis=-1)


def transport_rate(latitude: np.ndarray, height: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return ω_en in north, east, down, shape (..., 3), rad/s: how the local frame turns as the vehicle moves."""
    meridian, transverse = radii(latitude)
    east = velocity[..., 1] / (transverse + height)
    return np.stack([east, -velocity[..., 0] / (meridian + height), -east * np.tan(latitude)], axis=-1)


def trajectory(
    legs: Sequence[Leg],
    *,
    speed: float,
    latitude: float,
    heading: float = 0.0,
    height: float = 0.0,
    rate: float = 100.0,
    duration: float | None = None,
) -> Trajectory:
    """Fly the legs one after another.

    Parameters
    ----------
    legs : at least one.
    speed, heading : ground speed (m/s) and heading (rad, from north to the right) at the start, in level motion.
    latitude, height : at the start, rad and m.
    rate : ticks per second.
    duration : s, at most the legs' sum, which is the default; there are duration·rate + 1 ticks.

    Raises
    ------
    UsageError
        If there is no leg, the legs are too short, the vehicle would drive backwards, lose the force that presses it
        into its seat (its bank is then undefined), or come near a pole.
    """
    _check_legs(legs, speed)
    total = float(sum(leg.duration for leg in legs))
    ticks = int((total if duration is None else duration) * rate + 1e-6) + 1
    if ticks < 3 or (ticks - 1) / rate > total * (1 + 1e-9):
        wanted = f"at least {max(2 / rate, duration or 0.0):g} s"
        raise UsageError(f"legs: expected {wanted} together, got {total:g} s")
    time = np.arange(ticks) / rate
    manoeuvre = _rounded_off(_manoeuvre(legs, time), round(ROLL_IN * rate / 4))
    # rounding must not turn a vehicle that comes to rest around
    ground_speed = np.maximum(speed + _integral(manoeuvre[0], rate), 0.0)
    course, climb = heading + _integral(manoeuvre[1], rate), _integral(manoeuvre[2], rate)
    cosine, sine = np.cos(course), np.sin(course)
    velocity = np.stack([ground_speed * cosine, ground_speed * sine, -climb], axis=-1)
    across = ground_speed * manoeuvre[1]
    acceleration = np.stack(
        [manoeuvre[0] * cosine - across * sine, manoeuvre[0] * sine + across * cosine, -manoeuvre[2]], axis=-1
    )
    displacement = np.stack([_integral(component, rate) for component in velocity.T], axis=-1)
    above = height - displacement[:, 2]
    where = _latitude(latitude, above, velocity[:, 0], rate)
    force = _specific_force(where, above, velocity, acceleration)
    attitude = _coordinated(course, np.arctan2(climb, ground_speed), force)
    frame = earth_rate(where) + transport_rate(where, above, velocity)
    turning = _body_rate(attitude, rate) + np.einsum("tij,ti->tj", attitude, frame)
    return Trajectory(time, where, above, displacement, velocity, force, turning, attitude)


def _check_legs(legs: Sequence[Leg], speed: float) -> None:
    if not legs:
        raise UsageError("legs: expected at least one leg, got none")
    at = speed
    for number, leg in enumerate(legs, start=1):
        if leg.duration <= 0:
            raise UsageError(f"leg {number}: expected a positive duration, got {leg.duration:g} s")
        at += leg.acceleration * leg.duration
        if at < -1e-9 * max(1.0, speed):
            raise UsageError(f"leg {number}: expected a ground speed of at least 0, got {at:.3g} m/s at its end")


def _manoeuvre(legs: Sequence[Leg], time: np.ndarray) -> np.ndarray:
    """Return acceleration, turn rate and vertical acceleration at every tick, shape (3, ticks)."""
    durations = np.array([leg.duration for leg in legs])
    climbs = np.diff([0.0, *(leg.climb for leg in legs)]) / durations
    each = np.array([[leg.acceleration for leg in legs], [leg.turn_rate for leg in legs], climbs])
    leg_at = np.searchsorted(np.cumsum(durations), time, side="right")
    return each[:, np.minimum(leg_at, len(legs) - 1)]


def _rounded_off(steps: np.ndarray, half: int) -> np.ndarray:
    """Average over a window twice: corners become smooth ramps and the integrals stay."""
    for _ in range(2):
        padded = np.pad(steps, ((0, 0), (half + 1, half)), mode="edge")
        sums = np.cumsum(padded, axis=-1)
        steps = (sums[:, 2 * half + 1 :] - sums[:, : -(2 * half + 1)]) / (2 * half + 1)
    return steps


def _integral(values: np.ndarray, rate: float) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))]) / rate


def _latitude(start: float, height: np.ndarray, north: np.ndarray, rate: float) -> np.ndarray:
    # R_N hardly varies along the way: one refinement of a constant radius is exact to rounding
    latitude = np.full_like(height, start)
    for _ in range(2):
        latitude = start + _integral(north / (radii(latitude)[0] + height), rate)
        if np.abs(latitude).max() > _HIGHEST_LATITUDE:
            raise UsageError("legs: expected a way that keeps a degree from the poles, got one that comes nearer")
    return latitude


def _specific_force(
    latitude: np.ndarray, height: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    rotating = 2.0 * earth_rate(latitude) + transport_rate(latitude, height, velocity)
    force = acceleration + np.cross(rotating, velocity)
    force[:, 2] -= gravity(latitude, height)
    return force


def _coordinated(course: np.ndarray, path_angle: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return C_bn with the nose along the course and the wings perpendicular to the specific force."""
    level = np.cos(path_angle)
    nose = np.stack([np.cos(course) * level, np.sin(course) * level, -np.sin(path_angle)], axis=-1)
    lift = force - np.sum(force * nose, axis=-1, keepdims=True) * nose
    size = np.linalg.norm(lift, axis=-1, keepdims=True)
    if size.min() < _LEAST_LIFT:
        raise UsageError(
            f"legs: expected manoeuvres with at least {_LEAST_LIFT:g} m/s² of specific force across the direction of "
            f"motion, got {size.min():.2g} m/s² (free fall or a vertical climb)"
        )
    down = -lift / size
    return np.stack([nose, np.cross(down, nose), down], axis=-1)


def _body_rate(attitude: np.ndarray, rate: float) -> np.ndarray:
    change = np.swapaxes(attitude, -1, -2) @ np.gradient(attitude, 1.0 / rate, axis=0, edge_order=2)
    skewed = 0.5 * (change - np.swapaxes(change, -1, -2))
    return np.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], axis=-1)
