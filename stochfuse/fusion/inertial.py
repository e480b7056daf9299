"""The 15 errors of an inertial navigation system along a nominal trajectory, for a covariance analysis.

State x, error = computed − true, in the local north-east-down frame (`STATES`): attitude ψ (rad), velocity δv (m/s),
position δp (m: δp_N = (R_N+h) δL, δp_E = (R_E+h) cos L δλ, δp_D = −δh), gyro bias b_g (rad/s), accelerometer bias
b_a (m/s²), both in the vehicle's axes.  The attitude error is that of Groves: computed C_bn = (I + [ψ×]) C_bn, so
ψ_D > 0 is a heading computed too large; Titterton and Weston have the other sign.  Sensors: output = truth + b + noise.

    dψ/dt  = −ω_in × ψ − δω_in + C_bn (b_g + w_g)                                      ω_in = ω_ie + ω_en
    dδv/dt = −f × ψ − (2ω_ie + ω_en) × δv + v × (2δω_ie + δω_en) + 2g/(R+h) δp_D e_D + C_bn (b_a + w_a)
    dδp/dt = δv + (how metres per radian change on the way, below)
    db/dt  = −b/τ + w_b,   E[w_b²] = 2σ²/τ                                             first-order Gauss–Markov
    δω_ie  = Ω (−sin L, 0, −cos L) δL,   δω_en = A_v δv + A_p δp                       L, h, v perturbed in ω_en

P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems" (2nd ed., 2013), section
14.2.4 (local-navigation-frame error model; there with curvilinear position); D. H. Titterton and J. L. Weston,
"Strapdown Inertial Navigation Technology" (2nd ed., 2004), chapter 12.  Kept: Earth and transport rate, their
perturbation (the Schuler loop), and the gradient of gravity with height (the vertical channel is unstable, as it must
be).  Left out: how R_N, R_E and gravity vary with latitude (1e-8 /s² at most, against 1.5e-6 /s² of the Schuler loop),
scale factors, misalignments and g-dependent gyro errors, lever arms.  Each bias is one state: the turn-on bias only
widens its initial variance, so it decays with τ like the in-run part (by 3 % in 100 s at τ = 1 h).

Between ticks of length T, with F̄ the mean of dx/dt = F x at both ends (second order, like the trapezoidal rule):

    Φ = I + F̄T + F̄²T²/2      Q = (T/6) (S + 4 Φ_½ S Φ_½ᵀ + Φ S Φᵀ)                    S noise density, Simpson's rule

and n ticks compose to Φ_n … Φ_1 and the noise carried along, in log₂ n batched products.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.fusion.trajectory import (
    EARTH_RATE,
    STANDARD_GRAVITY,
    Trajectory,
    earth_rate,
    gravity,
    radii,
    transport_rate,
)
from stochfuse.kalman.algebra import NUMPY

STATES = (
    *("tiltN", "tiltE", "yaw", "vN", "vE", "vD", "pN", "pE", "pD"),
    *("gyroX", "gyroY", "gyroZ", "accX", "accY", "accZ"),
)
"""Names of the errors; X, Y, Z are the vehicle's forward, right and down axes."""
UNITS = ("rad",) * 3 + ("m/s",) * 3 + ("m",) * 3 + ("rad/s",) * 3 + ("m/s²",) * 3
ATTITUDE, VELOCITY, POSITION, GYRO, ACCELEROMETER = (slice(i, i + 3) for i in range(0, 15, 3))
_BLOCK = 8_192
"""Ticks worked on at a time: enough to batch, few enough to stay in fast memory."""


@dataclass(frozen=True)
class ImuGrade:
    """The errors of an inertial measurement unit, alike on its three axes, in SI units.

    Parameters
    ----------
    angle_random_walk : white noise of the gyros, rad/√s.
    velocity_random_walk : white noise of the accelerometers, m/s/√s.
    gyro_bias, accelerometer_bias : standard deviations of the turn-on biases, rad/s and m/s².
    gyro_instability, accelerometer_instability : standard deviations σ of the in-run biases, rad/s and m/s².
    gyro_time, accelerometer_time : their correlation times τ, s; infinity is a constant bias.
    """

    angle_random_walk: float
    velocity_random_walk: float
    gyro_bias: float
    gyro_instability: float
    gyro_time: float
    accelerometer_bias: float
    accelerometer_instability: float
    accelerometer_time: float

    @classmethod
    def from_data_sheet(
        cls,
        *,
        angle_random_walk: float,
        velocity_random_walk: float,
        gyro: tuple[float, float, float],
        accelerometer: tuple[float, float, float],
    ) -> ImuGrade:
        """Take the units of data sheets: °/√h, m/s/√h; bias, instability and its time in °/h, °/h, s and mg, mg, s."""
        gyro_bias, gyro_instability, gyro_time = gyro
        accelerometer_bias, accelerometer_instability, accelerometer_time = accelerometer
        per_hour, milli_g = np.deg2rad(1.0) / 3600.0, STANDARD_GRAVITY / 1000.0
        return cls(
            angle_random_walk=float(np.deg2rad(angle_random_walk)) / 60.0,
            velocity_random_walk=velocity_random_walk / 60.0,
            gyro_bias=float(gyro_bias * per_hour),
            gyro_instability=float(gyro_instability * per_hour),
            gyro_time=gyro_time,
            accelerometer_bias=accelerometer_bias * milli_g,
            accelerometer_instability=accelerometer_instability * milli_g,
            accelerometer_time=accelerometer_time,
        )


@dataclass(frozen=True, eq=False)
class InitialErrors:
    """Standard deviations at the start, each (3,) along north, east, down: attitude (rad), velocity, position."""

    attitude: np.ndarray
    velocity: np.ndarray
    position: np.ndarray


class ErrorModel(NamedTuple):
    """The errors from one fix to the next, ready for a linear model.

    Attributes
    ----------
    F, Q : (steps, 15, 15) entry k takes step k−1 to step k (steps from 1); that of step 1 is the identity and zero.
    P0 : (15, 15) covariance at step 1.
    states, units : of the 15 errors.
    H_gps : (6, 15) position, then velocity, computed − measured by GPS: plus the error itself.
    trajectory : the nominal motion at every tick.
    """

    F: np.ndarray
    Q: np.ndarray
    P0: np.ndarray
    states: tuple[str, ...]
    units: tuple[str, ...]
    H_gps: np.ndarray
    trajectory: Trajectory


def error_model(path: Trajectory, imu: ImuGrade, initial: InitialErrors, steps: int, ticks: int) -> ErrorModel:
    """Return the error model at fixes that are `ticks` ticks of the trajectory apart, the first at its start.

    Raises
    ------
    UsageError
        If the trajectory is shorter than the steps need.
    """
    if len(path.time) < (steps - 1) * ticks + 1:
        had = (len(path.time) - 1) // ticks + 1
        raise UsageError(f"trajectory: expected one of {steps} steps of {ticks} ticks, got one of {had}")
    tick = float(path.time[1] - path.time[0])
    density = noise_density(imu)
    F, Q = np.tile(np.eye(15), (steps, 1, 1)), np.zeros((steps, 15, 15))
    block = max(1, _BLOCK // ticks)
    for first in range(0, steps - 1, block):
        last = min(first + block, steps - 1)
        part = Trajectory(*(array[first * ticks : last * ticks + 1] for array in path))
        F[first + 1 : last + 1], Q[first + 1 : last + 1] = compose(
            *discretise(error_dynamics(part, imu), density, tick), ticks
        )
    deviations = np.concatenate(
        [
            *(initial.attitude, initial.velocity, initial.position),
            np.full(3, np.hypot(imu.gyro_bias, imu.gyro_instability)),
            np.full(3, np.hypot(imu.accelerometer_bias, imu.accelerometer_instability)),
        ]
    )
    H = np.zeros((6, 15))
    H[:3, POSITION] = H[3:, VELOCITY] = np.eye(3)
    return ErrorModel(F, Q, np.diag(deviations**2), STATES, UNITS, H, path)


def error_dynamics(path: Trajectory, imu: ImuGrade) -> np.ndarray:
    """Return F of dx/dt = F x at every tick, shape (ticks, 15, 15), the module's equations."""
    latitude, velocity = path.latitude, path.velocity
    R_N, R_E = (radius + path.height for radius in radii(latitude))
    in_earth, of_earth = transport_rate(latitude, path.height, velocity), earth_rate(latitude)
    by_velocity, by_position = _transport_rate_errors(latitude, velocity, R_N, R_E)
    earth_by_position = np.zeros_like(by_position)
    earth_by_position[:, 0, 0] = -EARTH_RATE * np.sin(latitude) / R_N
    earth_by_position[:, 2, 0] = -EARTH_RATE * np.cos(latitude) / R_N
    moving = _cross(velocity)
    F = np.zeros((len(latitude), 15, 15))
    F[:, ATTITUDE, ATTITUDE] = -_cross(in_earth + of_earth)
    F[:, ATTITUDE, VELOCITY] = -by_velocity
    F[:, ATTITUDE, POSITION] = -(by_position + earth_by_position)
    F[:, ATTITUDE, GYRO] = F[:, VELOCITY, ACCELEROMETER] = path.attitude
    F[:, VELOCITY, ATTITUDE] = -_cross(path.specific_force)
    F[:, VELOCITY, VELOCITY] = moving @ by_velocity - _cross(in_earth + 2.0 * of_earth)
    F[:, VELOCITY, POSITION] = moving @ (by_position + 2.0 * earth_by_position)
    F[:, 5, 8] += 2.0 * gravity(latitude, path.height) / np.sqrt(R_N * R_E)
    F[:, POSITION, VELOCITY] = np.eye(3)
    F[:, POSITION, POSITION] = _metres_per_radian(latitude, velocity, R_N, R_E)
    F[:, GYRO, GYRO] = -np.eye(3) / imu.gyro_time
    F[:, ACCELEROMETER, ACCELEROMETER] = -np.eye(3) / imu.accelerometer_time
    return F


def noise_density(imu: ImuGrade) -> np.ndarray:
    """Return the diagonal (15,) of S: white noise per second; alike on three axes, it is the same in every frame."""
    densities = (
        imu.angle_random_walk**2,
        imu.velocity_random_walk**2,
        0.0,
        2.0 * imu.gyro_instability**2 / imu.gyro_time,
        2.0 * imu.accelerometer_instability**2 / imu.accelerometer_time,
    )
    return np.repeat(densities, 3)


def discretise(F: np.ndarray, density: np.ndarray, tick: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Φ and Q (ticks − 1, d, d) between neighbouring ticks of F (ticks, d, d), a `tick` of seconds apart."""
    first = 0.5 * tick * (F[1:] + F[:-1])
    second = 0.5 * (first @ first)
    eye = np.eye(F.shape[-1])
    whole, half = eye + first + second, eye + 0.5 * first + 0.25 * second
    noise = 4.0 * (half * density) @ NUMPY.transpose(half) + (whole * density) @ NUMPY.transpose(whole)
    return whole, NUMPY.symmetric(tick / 6.0 * (np.diag(density) + noise))


def compose(Phi: np.ndarray, Q: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Φ and Q over every `count` neighbours of (groups·count, d, d), shape (groups, d, d), by halving."""
    d = Phi.shape[-1]
    Phi, Q = Phi.reshape(-1, count, d, d), Q.reshape(-1, count, d, d)
    while Phi.shape[1] > 1:
        odd = Phi.shape[1] % 2
        early, late = Phi[:, : Phi.shape[1] - odd : 2], Phi[:, 1::2]
        noise = late @ Q[:, : Q.shape[1] - odd : 2] @ NUMPY.transpose(late) + Q[:, 1::2]
        Phi = np.concatenate([late @ early, Phi[:, Phi.shape[1] - odd :]], axis=1)
        Q = np.concatenate([noise, Q[:, Q.shape[1] - odd :]], axis=1)
    return Phi[:, 0], NUMPY.symmetric(Q[:, 0])


def _transport_rate_errors(
    latitude: np.ndarray, velocity: np.ndarray, R_N: np.ndarray, R_E: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return A_v and A_p (ticks, 3, 3) of δω_en = A_v δv + A_p δp, with δL = δp_N/R_N and δh = −δp_D."""
    north, east, tangent = velocity[:, 0], velocity[:, 1], np.tan(latitude)
    by_velocity, by_position = np.zeros((2, len(latitude), 3, 3))
    by_velocity[:, 0, 1], by_velocity[:, 1, 0], by_velocity[:, 2, 1] = 1.0 / R_E, -1.0 / R_N, -tangent / R_E
    by_position[:, 2, 0] = -east / (R_E * R_N * np.cos(latitude) ** 2)
    by_position[:, 0, 2] = east / R_E**2
    by_position[:, 1, 2] = -north / R_N**2
    by_position[:, 2, 2] = -east * tangent / R_E**2
    return by_velocity, by_position


def _metres_per_radian(latitude: np.ndarray, velocity: np.ndarray, R_N: np.ndarray, R_E: np.ndarray) -> np.ndarray:
    """Return dδp/dt by δp (ticks, 3, 3): a degree has other lengths at another height and latitude."""
    (north, east, down), tangent = velocity.T, np.tan(latitude)
    change = np.zeros((len(latitude), 3, 3))
    change[:, 0, 0], change[:, 0, 2] = -down / R_N, north / R_N
    change[:, 1, 0], change[:, 1, 2] = east * tangent / R_N, east / R_E
    change[:, 1, 1] = -(down / R_E + north * tangent / R_N)
    return change


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Return [v×] with [v×] w = v × w, of vectors (ticks, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        matrices[:, row, column] = vectors[:, axis]
        matrices[:, column, row] = -vectors[:, axis]
    return matrices
