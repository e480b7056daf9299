"""The structure of a scenario file's [navigation] table, for pydantic.

Whether the numbers fit together is checked in `stochfuse.tables.navigation`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, Strict

from stochfuse.tables.base import Table

Real = Annotated[float, Strict()]


class LegTable(Table):
    """A part of the nominal way, with constant manoeuvre."""

    duration: Real = Field(description="s")
    acceleration: Real = Field(0.0, description="of the ground speed, m/s²")
    turn_rate: Real = Field(0.0, description="of the heading, °/s, positive to the right")
    climb: Real = Field(0.0, description="rate of climb at the end of the leg, reached evenly, m/s")


class ImuTable(Table):
    """The inertial measurement unit, in the units of data sheets; alike on its three axes."""

    angle_random_walk: Real = Field(description="white noise of the gyros, °/√h")
    velocity_random_walk: Real = Field(description="white noise of the accelerometers, m/s/√h")
    gyro_bias: Real = Field(description="turn-on bias, standard deviation, °/h")
    gyro_instability: Real = Field(description="in-run bias, standard deviation, °/h")
    gyro_time: Real = Field(description="correlation time of the gyros' bias, s")
    accelerometer_bias: Real = Field(description="turn-on bias, standard deviation, mg")
    accelerometer_instability: Real = Field(description="in-run bias, standard deviation, mg")
    accelerometer_time: Real = Field(description="correlation time of the accelerometers' bias, s")


class InitialErrorsTable(Table):
    """Standard deviations of the first estimate, along north, east and down; the biases' are the IMU's."""

    attitude: list[Real] = Field(description="about north, about east, of the heading, °")
    velocity: list[Real] = Field(description="m/s")
    position: list[Real] = Field(description="m")


class NavigationTable(Table):
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
