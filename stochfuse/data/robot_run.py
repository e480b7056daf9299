"""Robots from record to verdict: noises from the first minute, filters and what was predicted of them on the rest.

    1. `stochfuse.data.robot_errors.identify` on the first `until` seconds, where the truth is used: a calibration run
    2. filters that are told white noises of the same weight over long times, times one factor for each robot, by which
       the claim is right on average in the calibration run, as predicted for a robot alone, and times one for all (at
       least 1) by which the NEES realised there exceeds that: it changes what is claimed, and hardly any gain
    3. the filters on the record, `runs` times for each link probability: realised RMS of position, claim, NEES
    4. the errors that they should have, along the path that the robots alone believed in, by other draws of arrivals

Figures are of the rest of the record, after `until`; of that, prediction uses odometry and what was seen when, but no
truth.  Filters start at the first step, so that they have forgotten their start by then.

NEES is averaged over runs before its interval is found: runs differ in what arrived, not in noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from stochfuse.data.consistency import Average, Series
from stochfuse.data.robot_errors import ChannelNoises, identify
from stochfuse.data.robot_filters import (
    ESTIMATORS,
    Assumed,
    Followed,
    RobotMoments,
    RobotPath,
    assumed,
    course_of,
    filtered,
)
from stochfuse.data.robots import RobotRecord, read_robots
from stochfuse.errors import UsageError, nearest
from stochfuse.estimators.progress import listener
from stochfuse.scenario import registry
from stochfuse.scenario.result import Result
from stochfuse.scenario.sensing import wrapped

UNTIL = 60.0
FORGOTTEN = 10.0
"""Seconds after which the known start no longer counts in the calibration run."""
EVERY = 0.5
"""Seconds from one NEES to the next that is averaged: their memory is told by as many lags as there are."""
SHORTEST = 30.0
"""Seconds that have to be left to compare on."""


class RobotRow(NamedTuple):
    """What an estimator achieved at one link probability, in m RMS of position.

    Parameters
    ----------
    estimator, link : which.
    agent : the robot's number in the record, None for the mean over robots.
    realised, claimed, predicted : root of the mean squared error of (x, y), of the claim, and predicted.
    nees : average over robots and steps of three degrees of freedom.
    predicted_nees : the same as predicted.
    """

    estimator: str
    agent: int | None
    link: float
    realised: float
    claimed: float
    predicted: float
    nees: Average
    predicted_nees: float

    @property
    def verdict(self) -> str:
        """Whether the claim is consistent, overconfident or cautious."""
        return self.nees.verdict


@dataclass(frozen=True, eq=False, repr=False)
class RobotRun(Result):
    """Estimators on a record of robots.

    Parameters
    ----------
    record : with the landmarks used.
    noises : as identified.
    until, runs : seconds of the calibration run; draws of arrivals for each link probability.
    white : whether noise was taken for white at face value.
    rows : for each estimator and link, robots one by one and their mean.
    alone : (steps, robots, 3) error of the robots without exchange.
    alone_deviation : (steps, robots, 3) its predicted deviation.
    """

    record: RobotRecord
    noises: ChannelNoises
    until: float
    runs: int
    white: bool
    rows: tuple[RobotRow, ...]
    alone: np.ndarray
    alone_deviation: np.ndarray

    def row(self, estimator: str, link: float, agent: int | None = None) -> RobotRow:
        """Return one row."""
        return next(r for r in self.rows if (r.estimator, r.link, r.agent) == (estimator, link, agent))


def run_robots(
    record: RobotRecord | str | Path,
    link: Sequence[float] = (0.0, 0.25, 0.5, 0.75, 1.0),
    estimators: Sequence[str] = ESTIMATORS,
    *,
    runs: int = 4,
    seed: int = 1,
    landmarks: int | None = None,
    until: float = UNTIL,
    noises: ChannelNoises | Literal["identified", "white"] = "identified",
) -> RobotRun:
    """Run estimators on a record of robots.

    Parameters
    ----------
    record : a folder, or what `stochfuse.data.robots.read_robots` made of it.
    link : probabilities that a message arrives.
    estimators : names, of those that agents with states of their own have.
    runs, seed : draws of arrivals for each link probability.
    landmarks : how many the filters may use; noises are identified with all of them.
    until : seconds to identify noises on.
    noises : as identified; "white": the same taken for white at face value, in filters and prediction; or others.

    Raises
    ------
    UsageError
        If the folder is spoilt, an estimator does not apply, the record is too short, or a number is out of range.

    Examples
    --------
    >>> from stochfuse import UsageError, run_robots
    >>> try:
    ...     run_robots("mrclam", link=[0, 0.5, 1], estimators=["split-ci"])
    ... except UsageError as error:
    ...     print(error)
    mrclam: expected a folder with odometry.csv, sightings.csv, truth.csv, landmarks.csv, found none
    """
    record = read_robots(record) if isinstance(record, str | Path) else record
    _check(record, link, estimators, runs, until)
    white = noises == "white"
    if isinstance(noises, str):
        noises = identify(record, 0.0, until).white() if white else identify(record, 0.0, until)
    used = record if landmarks is None else record.with_landmarks(landmarks)
    course, last = course_of(used, noises), record.step_at(until)
    told = assumed(record, noises, last)
    alone = _alone(course, noises, told, last)
    if not white:
        told = told.scaled(alone.factor)
    items = _ArrivalDraws.drawn(link, runs, course.pairs, seed)
    others = _ArrivalDraws.drawn(link, runs, course.pairs, seed, other=True)
    rows: list[RobotRow] = []
    for k, name in enumerate(estimators):
        listener().advance(name, 2 * k, 2 * len(estimators))
        real = _found(course, name, told, items.heard, Followed(course, len(items.heard)), last)
        listener().advance(f"{name}, predicted", 2 * k + 1, 2 * len(estimators))
        carried = RobotMoments(course, noises, alone.path, len(others.heard))
        rows += _rows(name, record, real, _found(course, name, told, others.heard, carried, last), items)
    return RobotRun(used, noises, until, runs, white, tuple(rows), alone.error, alone.deviation)


def _check(record: RobotRecord, link: Sequence[float], estimators: Sequence[str], runs: int, until: float) -> None:
    end = (record.steps - 1) * record.interval
    if end < until + SHORTEST:
        raise UsageError(
            f"{record.source}: expected {until + SHORTEST:g} s or more ({until:g} s to identify noises on, the rest to "
            f"compare), got {end:g} s"
        )
    for name in estimators:
        if name not in registry.ESTIMATORS:
            raise UsageError(
                f"estimator: expected one of {', '.join(ESTIMATORS)}, got '{name}'{nearest(name, ESTIMATORS)}"
            )
        if name not in ESTIMATORS:
            raise UsageError(
                f"estimator {name}: expected agents that track one state by one model, got robots that each estimate "
                f"their own place; these take them: {', '.join(ESTIMATORS)}"
            )
    if runs < 1 or not len(link) or not all(0.0 <= value <= 1.0 for value in link):
        raise UsageError(f"expected probabilities from 0 to 1 and 1 run or more, got {list(link)} and {runs}")


class _ArrivalDraws(NamedTuple):
    """Draws of arrivals: heard (items, pairs, 2), and the items of each link."""

    heard: np.ndarray
    link: tuple[float, ...]
    of: tuple[slice, ...]

    @classmethod
    def drawn(cls, link: Sequence[float], runs: int, pairs: int, seed: int, other: bool = False) -> _ArrivalDraws:
        """Draw; one item is enough where nothing is left to chance.  The same numbers for all links."""
        u = np.random.default_rng([seed, int(other)]).random((runs, pairs, 2))
        parts = [u[: 1 if value in (0.0, 1.0) else runs] < value for value in link]
        ends = np.cumsum([0, *map(len, parts)])
        pieces = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
        return cls(np.concatenate(parts), tuple(link), pieces)


class _Alone(NamedTuple):
    path: np.ndarray
    error: np.ndarray
    deviation: np.ndarray
    factor: np.ndarray


def _alone(course: RobotPath, noises: ChannelNoises, told: Assumed, last: int) -> _Alone:
    """Every robot by itself: the path that it believes in, and by what its claim is to be scaled."""
    record, nobody = course.record, np.zeros((1, course.pairs, 2), dtype=bool)
    followed = Followed(course, 1)
    path, realised = [], []
    for moment in filtered(course, "stand-alone", told, nobody, followed):
        path.append(followed.x[0].copy())
        realised.append(followed.errors(moment)[1][0])
    path = np.array(path)
    expected = RobotMoments(course, noises, path, 1)
    first, n = min(record.step_at(FORGOTTEN), last // 2), len(record.robots)
    deviation, ratio = np.zeros_like(path), np.zeros((record.steps, n))
    for moment in filtered(course, "stand-alone", told, nobody, expected):
        deviation[moment.step] = np.sqrt(np.diagonal(expected.blocks()[0], axis1=-2, axis2=-1))
        ratio[moment.step] = expected.errors(moment)[1][0] / 3.0
    error = path - record.truth
    error[..., 2] = wrapped(error[..., 2])
    factor = np.maximum(ratio[first:last].mean(axis=0), 1e-3)
    beyond = float((np.array(realised)[first:last].mean(axis=0) / 3.0 / factor).mean())
    return _Alone(path, error, deviation, factor * max(beyond, 1.0))


class _Found(NamedTuple):
    """Per step after `until`, item and robot: squared error, its claim and its prediction, and NEES."""

    squared: np.ndarray
    claimed: np.ndarray
    nees: np.ndarray


def _found(
    course: RobotPath, name: str, told: Assumed, heard: np.ndarray, carried: Followed | RobotMoments, last: int
) -> _Found:
    """Of an estimator after the calibration run: realised where the record is followed, else as it should be."""
    found = []
    for moment in filtered(course, name, told, heard, carried):
        if moment.step > last:
            squared, nees = carried.errors(moment)
            found.append((squared, moment.claims[..., [0, 1], [0, 1]].sum(axis=-1), nees))
    return _Found(*map(np.array, zip(*found, strict=True)))


def _rows(name: str, record: RobotRecord, real: _Found, expected: _Found, items: _ArrivalDraws) -> list[RobotRow]:
    n, stride, rows = len(record.robots), max(1, round(EVERY / record.interval)), []
    for link, which in zip(items.link, items.of, strict=True):
        series = Series(len(real.nees[::stride]), n, np.full(n, 3.0))
        series.add(real.nees[::stride, which].mean(axis=1)[None])
        realised, claimed, predicted = (
            np.sqrt(values[:, which].mean(axis=(0, 1))) for values in (real.squared, real.claimed, expected.squared)
        )
        nees = expected.nees[:, which].mean(axis=(0, 1))
        for agent in [*range(n), None]:
            of = slice(None) if agent is None else agent
            average = series.average(agent)
            if average is None:
                raise UsageError(f"{record.source}: expected errors that can be told, got none")
            number = None if agent is None else record.robots[agent]
            real_, claim, expect, nees_ = (float(np.mean(v[of])) for v in (realised, claimed, predicted, nees))
            rows.append(RobotRow(name, number, link, real_, claim, expect, average, nees_))
    return rows
