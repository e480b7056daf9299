"""How robots' sensors err, identified on a calibration run: biases, what stays alike and for how long, what is white.

Four channels: speed, turn rate, range, bearing.  Where the truth is known (the first seconds of a record, as in a
calibration run), every measurement has an error e, in units of a size u that it grows with,

    speed  u = V      turn rate  u = ω      range  u = range      bearing  u = 1

    e/u = constant of the robot + common(t) + of the subject(t) + white

common and of the subject are first-order Gauss–Markov processes: variance σ² and E[b(t)b(t′)] = σ² exp(−|t − t′|/τ);
the first is the same for all that a robot measures by the channel, the second is one for each subject that it sees.
Odometry has no subjects.  A robot that turns also loses speed, in proportion to |ω|: that is taken out first.

How it is found, all of it by second moments:

    constants   means of the robots, shrunk to their common mean as far as they differ no more than chance lets them
                (random effects, DerSimonian and Laird 1986)
    processes   least squares of pairs' products e e′ over the lag: pairs of different subjects show the common
                process, pairs of one subject both, what is left at lag 0 is white
    variances   of all robots together: they are of one make, and how much a robot's errors vary in one minute says
                little of how much they do in the next

A robot's N errors count for its mean as N/D independent ones, D = Σ ρ(t, t′)/N: the factor by which errors that stay
alike count for more than white ones.  Errors of more than `GROSS` pooled deviations (a barcode misread) are left out
and counted.

White Gaussian noise is the special case without constants and processes (`Noises.white`); what it cannot express is
D, the factor that its claims leave out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stochfuse.data.robots import RobotRecord, seen
from stochfuse.errors import UsageError
from stochfuse.scenario.sensing import wrapped

GROSS = 5.0
BLOCK = 1.0
"""Seconds over which odometry is compared with the truth: the truth's own noise counts over shorter times."""
BIN = 0.25
"""Seconds of a bin of lags."""
LONGEST = 30.0
"""Longest lag and correlation time looked at [s]."""
FEWEST = 20
"""Errors of a channel below which nothing is identified."""
LEAST_WHITE = 0.02
"""Share of a channel's variance that is at least white."""


class Process(NamedTuple):
    """A Gauss–Markov process: variances (robots,), and the correlation time [s] of all."""

    variance: np.ndarray
    time: float


class Channel(NamedTuple):
    """How one kind of measurement errs, relative to its size; arrays (robots,).

    Parameters
    ----------
    mean : the robot's constant, which is taken out of its measurements.
    doubt : variance of what is left of the constant.
    common, subject : processes of the robot and of each subject seen.
    white : variance; of odometry for an average over `BLOCK`.
    alike : D of each robot, as often as it measured in the calibration run.
    number : how many errors there were.
    """

    mean: np.ndarray
    doubt: np.ndarray
    common: Process
    subject: Process
    white: np.ndarray
    alike: np.ndarray
    number: np.ndarray

    @property
    def variance(self) -> np.ndarray:
        """All that varies, (robots,)."""
        return self.common.variance + self.subject.variance + self.white

    def as_white(self) -> Channel:
        """Return the channel with the same variance, all of it white."""
        none = np.zeros_like(self.white)
        total = self.variance + self.doubt
        return Channel(self.mean, none, Process(none, 1.0), Process(none, 1.0), total, none + 1.0, self.number)


class ChannelNoises(NamedTuple):
    """All channels, the speed lost in turning [m/s per rad/s], and the share of gross errors among sightings."""

    speed: Channel
    turn: Channel
    range: Channel
    bearing: Channel
    turning_loss: float
    gross: float

    def white(self) -> ChannelNoises:
        """Return them as white noise takes them: at face value."""
        channels = (channel.as_white() for channel in (self.speed, self.turn, self.range, self.bearing))
        return ChannelNoises(*channels, turning_loss=self.turning_loss, gross=self.gross)


class _ChannelErrors(NamedTuple):
    """Errors of a channel: time, robot, subject, error and size, each (errors,)."""

    time: np.ndarray
    robot: np.ndarray
    subject: np.ndarray
    error: np.ndarray
    size: np.ndarray


def identify(record: RobotRecord, start: float = 0.0, stop: float = 60.0) -> ChannelNoises:
    """Identify all noises on a part of a record where the truth is used.

    Parameters
    ----------
    start, stop : seconds after the first step.

    Raises
    ------
    UsageError
        If the record or the part is too short, or a channel has too few errors in it.
    """
    first, last = record.step_at(start), record.step_at(stop)
    if not 0 <= first < last < record.steps:
        end = (record.steps - 1) * record.interval
        raise UsageError(f"{record.source}: expected more than {stop:g} s to identify noises on, got {end:g} s")
    n = len(record.robots)
    speed, turn, loss = _odometry(record, first, last)
    ranges, bearings, gross = _sights(record, first, last)
    channels = (_channel(name, errors, n) for name, errors in zip(
        ("speed", "turn_rate", "range", "bearing"), (speed, turn, ranges, bearings), strict=True
    ))  # fmt: skip
    return ChannelNoises(*channels, turning_loss=loss, gross=gross)


def _odometry(record: RobotRecord, first: int, last: int) -> tuple[_ChannelErrors, _ChannelErrors, float]:
    """Errors of averages over blocks."""
    T, truth = record.interval, record.truth[first : last + 1]
    size = max(1, round(BLOCK / T))
    blocks = (last - first) // size
    ends = truth[: blocks * size + 1 : size]
    step = np.diff(truth[..., :2], axis=0)[: blocks * size]
    half = 0.5 * (truth[:-1, :, 2] + truth[1:, :, 2])[: blocks * size]
    along = (step[..., 0] * np.cos(half) + step[..., 1] * np.sin(half)).reshape(blocks, size, -1).sum(axis=1)
    said = record.odometry[first : first + blocks * size].reshape(blocks, size, -1, 2).mean(axis=1)
    V, omega = said[..., 0], said[..., 1]
    speed, turn = V - along / (size * T), omega - np.diff(ends[..., 2], axis=0) / (size * T)
    # speed lost in turning, beside a relative error of all
    basis = np.stack([V.ravel(), np.abs(omega).ravel()], axis=1)
    loss = float(np.linalg.lstsq(basis, speed.ravel(), rcond=None)[0][1])
    speed = speed - loss * np.abs(omega)
    time = np.broadcast_to((np.arange(blocks) * size * T)[:, None], V.shape)
    robot = np.broadcast_to(np.arange(V.shape[1]), V.shape)
    parts = (time.ravel(), robot.ravel(), np.zeros(V.size, dtype=int))
    return _ChannelErrors(*parts, speed.ravel(), V.ravel()), _ChannelErrors(*parts, turn.ravel(), omega.ravel()), loss


def _sights(record: RobotRecord, first: int, last: int) -> tuple[_ChannelErrors, _ChannelErrors, float]:
    """Errors of ranges and bearings, gross ones left out."""
    sightings = record.sightings.where((record.sightings.step >= first) & (record.sightings.step < last))
    true, _ = seen(record.truth[sightings.step, sightings.robot], record.subject_places(sightings))
    relative = (sightings.range - true[:, 0]) / true[:, 0]
    beside = wrapped(sightings.bearing - true[:, 1])
    kept = np.ones(len(relative), dtype=bool)
    for errors in (relative, beside):
        for _ in range(5):
            if kept.sum() > FEWEST:
                kept &= np.abs(errors - np.median(errors[kept])) <= GROSS * errors[kept].std()
    parts = (sightings.step[kept] * record.interval, sightings.robot[kept], sightings.subject[kept])
    ones = np.ones(int(kept.sum()))
    gross = float(1.0 - kept.mean()) if len(kept) else 0.0
    return _ChannelErrors(*parts, relative[kept], ones), _ChannelErrors(*parts, beside[kept], ones), gross


def _channel(name: str, errors: _ChannelErrors, n: int) -> Channel:
    if len(errors.time) < FEWEST or not errors.size.any():
        raise UsageError(f"{name}: expected {FEWEST} errors or more to identify its noise by, got {len(errors.time)}")
    number = np.bincount(errors.robot, minlength=n)
    weight = np.bincount(errors.robot, errors.size**2, n)
    mean = _ratio(np.bincount(errors.robot, errors.error * errors.size, n), weight)
    residual = errors.error - mean[errors.robot] * errors.size
    shares, pairs, times = _processes(errors, residual)
    D = _design(errors, pairs, shares, times, n)
    independent = np.maximum(_ratio(_effective(errors, n), D), 1.0)
    # means of robots were taken out of what is pooled
    lost = float((weight / independent).sum() / weight.sum())
    variance = float((residual**2).sum() / (errors.size**2).sum()) / max(1.0 - lost, 0.5)
    mean, doubt = _shrunk(mean, variance / independent, weight > 0)
    common, subject, white = (np.full(n, variance * share) for share in shares)
    return Channel(mean, doubt, Process(common, times[0]), Process(subject, times[1]), white, D, number)


def _ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    return np.divide(top, bottom, out=np.zeros(np.shape(top)), where=bottom > 0)


def _effective(errors: _ChannelErrors, n: int) -> np.ndarray:
    """As how many a robot's errors count where only some are large, were they white."""
    return _ratio(np.bincount(errors.robot, errors.size**2, n) ** 2, np.bincount(errors.robot, errors.size**4, n))


class _ErrorPairs(NamedTuple):
    """Pairs of errors of one robot, first before second: their places, lag [s], and whether of one subject."""

    first: np.ndarray
    second: np.ndarray
    lag: np.ndarray
    same: np.ndarray


def _pairs(errors: _ChannelErrors) -> _ErrorPairs:
    found = []
    for robot in np.unique(errors.robot):
        rows = np.flatnonzero(errors.robot == robot)
        i, j = np.triu_indices(len(rows), 1)
        first, second = rows[i], rows[j]
        lag = np.abs(errors.time[second] - errors.time[first])
        near = lag <= LONGEST
        first, second = first[near], second[near]
        found.append((first, second, lag[near], errors.subject[first] == errors.subject[second]))
    return _ErrorPairs(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _processes(
    errors: _ChannelErrors, residual: np.ndarray
) -> tuple[tuple[float, float, float], _ErrorPairs, tuple[float, float]]:
    """Shares of the variance (common, subject, white), pairs of errors, and correlation times, robots pooled."""
    pairs, u = _pairs(errors), errors.size
    several = not pairs.same.all()
    variance = float((residual**2).sum() / (u**2).sum())
    e = residual / np.sqrt(variance)
    products = e[pairs.first] * e[pairs.second]
    sizes = u[pairs.first] * u[pairs.second]
    bins = (pairs.lag / BIN).astype(int)
    common, common_time = 0.0, 1.0
    if several:
        apart = ~pairs.same
        common, common_time = _memory(bins[apart], products[apart], sizes[apart])
    together = pairs.same
    rest = products[together] - common * np.exp(-pairs.lag[together] / common_time) * sizes[together]
    subject, subject_time = _memory(bins[together], rest, sizes[together])
    if not several:
        common, common_time, subject, subject_time = subject, subject_time, 0.0, 1.0
    least = 1.0 - LEAST_WHITE
    if common + subject > least:
        common, subject = common * least / (common + subject), subject * least / (common + subject)
    return (common, subject, 1.0 - common - subject), pairs, (common_time, subject_time)


def _memory(bins: np.ndarray, products: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Variance and correlation time of the process that fits products of pairs best over the lag."""
    if not (len(bins) and sizes.any()):
        return 0.0, 1.0
    weight = np.bincount(bins, sizes**2)
    mean = _ratio(np.bincount(bins, products * sizes), weight)
    lag = (np.arange(len(weight)) + 0.5) * BIN
    best = (np.inf, 0.0, 1.0)
    # shorter than the shortest lag it cannot be told from white
    for time in np.geomspace(lag[np.flatnonzero(weight)[0]], LONGEST, 60):
        shape = np.exp(-lag / time)
        variance = max(0.0, float((weight * mean * shape).sum() / max((weight * shape**2).sum(), 1e-300)))
        left = float((weight * (mean - variance * shape) ** 2).sum())
        if left < best[0] * (1.0 - 1e-9):
            best = (left, variance, float(time))
    return best[1], best[2]


def _design(
    errors: _ChannelErrors, pairs: _ErrorPairs, shares: tuple[float, float, float], times: tuple[float, float], n: int
) -> np.ndarray:
    """D of each robot, (robots,)."""
    rho = shares[0] * np.exp(-pairs.lag / times[0]) + pairs.same * shares[1] * np.exp(-pairs.lag / times[1])
    u = errors.size
    # of a weighted mean, weights u²
    across = np.bincount(errors.robot[pairs.first], rho * (u[pairs.first] * u[pairs.second]) ** 2, n)
    alone = np.bincount(errors.robot, u**4, n)
    # a robot that measured nothing may do so later, as often as the others
    return 1.0 + 2.0 * np.where(alone > 0, _ratio(across, alone), across.sum() / alone.sum())


def _shrunk(values: np.ndarray, variance: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values of the robots drawn to their common mean, and the variance that is left."""
    v, s = values[known], np.maximum(variance[known], 1e-300)
    w = 1.0 / s
    middle = float((w * v).sum() / w.sum())
    spread = float((w * (v - middle) ** 2).sum()) - (len(v) - 1)
    between = max(0.0, spread / max(float(w.sum() - (w**2).sum() / w.sum()), 1e-300)) if len(v) > 1 else np.inf
    if not np.isfinite(between):
        return values, variance
    w = 1.0 / (s + between)
    middle = float((w * v).sum() / w.sum())
    keep = np.where(known, between / (between + np.maximum(variance, 1e-300)), 0.0)
    left = keep * np.where(known, variance, 0.0) + (1.0 - keep) ** 2 / float(w.sum())
    left = np.where(known, left, between + 1.0 / float(w.sum()))
    return np.where(known, keep * values + (1.0 - keep) * middle, middle), left
