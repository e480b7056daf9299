"""Five ways in which robots that see one another use what they hear: gains and claims, on data or on their errors.

Every robot's filter is told white noises Q and R; state (x, y, θ), one robot's block P_ii.  When robot i sees robot j
(range and bearing, H_i and H_j), two messages are under way, each of which arrives with probability µ: j's estimate
to i, and i's estimate with the sighting to j.

    stand-alone              takes no sighting of a robot
    naive                    who hears takes the other's error for independent noise, H_j P_jj H_jᵀ + R; nothing is
                             ever removed
    lwin                     the same for the observer alone, as the patent has it
    covariance-intersection  the sighting with covariance H_j P_jj H_jᵀ + R is intersected with the own estimate
    split-ci                 R, and of every estimate what the step's own odometry and landmarks brought, is independent
    itns                     one covariance of all robots; the sighting is taken in if the first message arrives

All of them are linear in errors once the gains are known: with the innovation y = z − h(x̂), x̂ ← x̂ + K y on the rows
of one, two or all robots.  So the same filters run on

    `Followed`  the record itself, extended filters on batches of arrivals;
    `RobotMoments`  second moments of their errors e under the noises that `stochfuse.data.robot_errors` identified,
                with Jacobians along a given path: E = E[eeᵀ] of all robots at a time, M = E[ebᵀ] with every constant
                and Gauss–Markov process b of the sensors.  With y = −He + Bb + v,

                    e ← e + Ky        b ← Φb + …        e ← Fe + Γb + w

                carries E and M on exactly; b's own covariance is diagonal and stays so.  This is a consider analysis
                (Schmidt 1966) of the filters as they are: their gains come from the white noises that they assume.

On the record a sighting of more than `GATE` of the innovation's own covariance is left out (a misread barcode), unless
`AGAIN` of the robot's sightings in a row were: then it is the robot that errs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from stochfuse.data.robot_errors import BLOCK, ChannelNoises
from stochfuse.data.robots import RobotRecord, moved, seen
from stochfuse.fusion.cooperative import lwin_update, over_states, place
from stochfuse.kalman.algebra import NUMPY
from stochfuse.kalman.kernel import Estimate, corrected, predict, update
from stochfuse.scenario.sensing import wrapped

ESTIMATORS = ("stand-alone", "naive", "covariance-intersection", "split-ci", "lwin", "itns")
GATE = 40.0
"""Squared normalised innovation (two degrees of freedom: 2e-9 by chance) that is no sighting of this subject."""
GRID = (np.arange(24) + 0.5) / 24.0
"""Weights tried, of the interval at hand."""
AGAIN = 8
"""Sightings left out in a row after which the next is believed."""
START = 0.05
"""Deviation of the first estimates from the truth that the filters assume [m, rad]; they begin at the truth."""


class Assumed(NamedTuple):
    """What the filters take for white: Q per step of V and ω (robots, 2), R of range (relative) and bearing."""

    Q: np.ndarray
    R: np.ndarray

    def scaled(self, factor: np.ndarray) -> Assumed:
        """Return both times a factor for each robot, which scales claims and leaves gains of its own alone."""
        return Assumed(self.Q * factor[:, None], self.R * factor[:, None])


def assumed(record: RobotRecord, noises: ChannelNoises, last: int) -> Assumed:
    """White noises of the same weight over long times: each channel's variance times its D.

    Odometry errs in proportion to what it measures; the filters take its mean square up to step `last`.
    """
    size = np.mean(record.odometry[:last] ** 2, axis=0)
    rates = [(c.variance + c.doubt) * c.alike * BLOCK / record.interval for c in (noises.speed, noises.turn)]
    sights = [c.variance * c.alike + c.doubt for c in (noises.range, noises.bearing)]
    return Assumed(np.stack(rates, axis=1) * np.maximum(size, 1e-8), np.stack(sights, axis=1))


class Sighting(NamedTuple):
    """One sighting: its place in the record, who, whom (robots below n), range and bearing."""

    at: int
    robot: int
    subject: int
    measured: np.ndarray


class RobotPath(NamedTuple):
    """A record made ready for filters: constants taken out, sightings by step.

    Parameters
    ----------
    record : with the landmarks that the filters may use.
    motion : (steps, robots, 2) odometry without its constants.
    events : by step, landmarks first.
    pairs : number of sightings of robots; they are numbered in order.
    """

    record: RobotRecord
    motion: np.ndarray
    events: tuple[tuple[Sighting, ...], ...]
    pairs: int


def course_of(record: RobotRecord, noises: ChannelNoises) -> RobotPath:
    """Take the identified constants out of a record."""
    V, omega = record.odometry[..., 0], record.odometry[..., 1]
    V = V * (1.0 - noises.speed.mean) - noises.turning_loss * np.abs(omega)
    motion = np.stack([V, omega * (1.0 - noises.turn.mean)], axis=-1)
    s, n = record.sightings, len(record.robots)
    measured = np.stack(
        [s.range / (1.0 + noises.range.mean[s.robot]), wrapped(s.bearing - noises.bearing.mean[s.robot])], axis=1
    )
    number = np.cumsum(s.subject < n) - 1
    events: list[list[Sighting]] = [[] for _ in range(record.steps)]
    for k, step in enumerate(s.step):
        events[step].append(Sighting(int(number[k]), int(s.robot[k]), int(s.subject[k]), measured[k]))
    return RobotPath(record, motion, tuple(map(tuple, events)), int((s.subject < n).sum()))


class RobotCovariances:
    """Covariances that the filters claim: P (items, robots, 3, 3), of itns the joint one (items, 3n, 3n).

    `own` is, for split-ci, the part that the step's own odometry and sightings of landmarks brought.
    """

    def __init__(self, estimator: str, items: int, robots: int) -> None:
        self.estimator, self.n = estimator, robots
        self.joint = estimator == "itns"
        shape = (3 * robots, 3 * robots) if self.joint else (robots, 3, 3)
        self.P = np.broadcast_to(START**2 * np.eye(shape[-1]), (items, *shape)).copy()
        self.own = np.zeros_like(self.P) if estimator == "split-ci" else None

    def blocks(self) -> np.ndarray:
        """Each robot's covariance, (items, robots, 3, 3)."""
        return _blocks(self.P, self.n) if self.joint else self.P

    def move(self, F: np.ndarray, Q: np.ndarray) -> None:
        """Predict with (items or 1, robots, 3, 3)."""
        if self.joint:
            self.P = predict(Estimate(None, self.P), _diagonal(F), _diagonal(Q)).P
            return
        self.P = predict(Estimate(None, self.P), F, Q).P
        if self.own is not None:
            self.own = np.broadcast_to(Q, self.P.shape).copy()

    def landmark(self, i: int, H: np.ndarray, R: np.ndarray, valid: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Take a landmark in; return the gain (items, rows, 2)."""
        if self.joint:
            return self._joint(over_states(H, range(3 * i, 3 * i + 3), 3 * self.n), R, valid)
        P = self.P[:, i]
        fine = valid(H @ P @ NUMPY.transpose(H) + R)
        found = update(_unit(P, 3), H, R, np.eye(2))
        K = np.where(fine, found.x, 0.0)
        self.P[:, i] = np.where(fine, found.P, P)
        if self.own is not None:
            self.own[:, i] = corrected(self.own[:, i], K, H, R)
        return K

    def robot(
        self,
        pair: tuple[int, int],
        H: tuple[np.ndarray, np.ndarray],
        R: np.ndarray,
        heard: np.ndarray,
        valid: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray | None:
        """Take a sighting of a robot in where messages arrived, heard (items, 2); return the gain (items, rows, 2)."""
        i, j = pair
        if self.joint:
            return self._joint(place(H[0], i, H[1], j, self.n, 3), R, lambda S: valid(S) & heard[:, :1, None])
        if self.estimator == "stand-alone":
            return None
        if self.estimator == "lwin":
            heard = heard * np.array([True, False])
        before = self.P[:, [i, j]]
        part = None if self.own is None else self.own[:, [i, j]]
        S = sum((h @ before[:, k] @ NUMPY.transpose(h) for k, h in enumerate(H)), R)
        fine = valid(S)[..., 0] & heard
        gains = []
        for k, robot in enumerate(pair):
            K, P, own = self._heard(before, part, k, H, R)
            there = fine[:, k, None, None]
            gains.append(np.where(there, K, 0.0))
            self.P[:, robot] = np.where(there, P, before[:, k])
            if self.own is not None and own is not None:
                self.own[:, robot] = np.where(there, own, self.own[:, robot])
        return np.concatenate(gains, axis=1)

    def _heard(
        self, P: np.ndarray, own: np.ndarray | None, k: int, H: tuple[np.ndarray, np.ndarray], R: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Gain and claim of one that heard of the other, k = 0 for the observer."""
        mine, other, H_k, H_o = P[:, k], P[:, 1 - k], H[k], H[1 - k]
        if self.estimator in ("naive", "lwin"):
            found = lwin_update(_unit(mine, 3), _unit(other, 3), H_k, H_o, R, np.eye(2))
            return found.x, found.P, None
        theirs = H_o @ other @ NUMPY.transpose(H_o)
        if own is None:
            return *_intersected(mine, np.zeros_like(mine), theirs + R, np.zeros_like(theirs), H_k), None
        known = H_o @ own[:, 1 - k] @ NUMPY.transpose(H_o)
        K, P = _intersected(mine - own[:, k], own[:, k], theirs - known, known + R, H_k)
        return K, P, corrected(own[:, k], K, H_k, known + R)

    def _joint(self, H: np.ndarray, R: np.ndarray, valid: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        fine = valid(H @ self.P @ NUMPY.transpose(H) + R)
        found = update(_unit(self.P, 3 * self.n), H, R, np.eye(2))
        self.P = np.where(fine, found.P, self.P)
        return np.where(fine, found.x, 0.0)


def _intersected(
    A1: np.ndarray, A2: np.ndarray, B1: np.ndarray, B2: np.ndarray, H: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gain and covariance of split covariance intersection of the whole state with one measurement, least det C.

    C⁻¹ = (A1/ω + A2)⁻¹ + Hᵀ(B1/(1 − ω) + B2)⁻¹H is a Kalman update with inflated covariances, and
    det C = |A(ω)| |B(ω)| / |B(ω) + H A(ω) Hᵀ|; the weight by a grid, twice refined around the best.  The same as
    `stochfuse.fusion.intersection.fuse_stack`, for two signals and a thousand times in a row.
    """
    G1, G2 = (H @ A @ NUMPY.transpose(H) for A in (A1, A2))
    alpha = np.linalg.eigvals(np.linalg.solve(A1 + A2, A1)).real.clip(0.0, 1.0)

    def log_det(w: np.ndarray) -> np.ndarray:
        a, b = 1.0 / w[:, None], 1.0 / (1.0 - w[:, None, None])
        size = np.log(alpha[:, :, None] * a + 1.0 - alpha[:, :, None]).sum(axis=1)
        B = B1[..., None] * b + B2[..., None]
        S = B + G1[..., None] * a[:, None] + G2[..., None]
        return size + np.log(_det(B) / _det(S))

    low, high, middle = np.zeros(len(A1)), np.ones(len(A1)), np.full(len(A1), 0.5)
    for _ in range(3):
        w = low[:, None] + (high - low)[:, None] * GRID
        best = np.argmin(log_det(w), axis=1)
        middle, reach = w[np.arange(len(w)), best], (high - low) * (GRID[1] - GRID[0])
        low, high = np.maximum(middle - reach, 0.0), np.minimum(middle + reach, 1.0)
    w = middle[:, None, None]
    A, B = A1 / w + A2, B1 / (1.0 - w) + B2
    found = update(_unit(A, 3), H, B, np.eye(2))
    return found.x, found.P


def _det(A: np.ndarray) -> np.ndarray:
    """Determinants of 2×2 matrices (items, 2, 2, weights)."""
    return A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]


def _unit(P: np.ndarray, d: int) -> Estimate:
    """An error of zero, so that an update by the identity returns the gain as its state."""
    return Estimate(np.zeros((d, 2)), P)


def _blocks(P: np.ndarray, n: int) -> np.ndarray:
    """Diagonal blocks (items, n, 3, 3) of (items, 3n, 3n)."""
    return np.moveaxis(np.diagonal(P.reshape(len(P), n, 3, n, 3), axis1=1, axis2=3), -1, 1)


def _diagonal(blocks: np.ndarray) -> np.ndarray:
    """Block-diagonal (..., 3n, 3n) of (..., n, 3, 3)."""
    n = blocks.shape[-3]
    whole = np.zeros((*blocks.shape[:-3], 3 * n, 3 * n))
    for i in range(n):
        whole[..., 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = blocks[..., i, :, :]
    return whole


class Followed:
    """The record itself: states (items, robots, 3).

    What is carried along with the claims moves on to a step (returns the Jacobians), says where to linearise and which
    innovations y to take, and takes a sighting in: gain K (items, 3·rows, 2) on the rows of some robots.
    """

    def __init__(self, course: RobotPath, items: int) -> None:
        self.course = course
        self.x = np.broadcast_to(course.record.truth[0], (items, *course.record.truth.shape[1:])).copy()
        self.left_out = np.zeros(self.x.shape[:2], dtype=int)

    def move(self, step: int) -> np.ndarray:
        self.x, F = moved(self.x, self.course.motion[step - 1], self.course.record.interval)
        return F

    def states(self, step: int) -> np.ndarray:
        return self.x

    def valid(self, robot: int, y: np.ndarray, S: np.ndarray) -> np.ndarray:
        off = y[..., None]
        distance = (NUMPY.transpose(off) @ np.linalg.solve(S, off))[:, 0, 0]
        fine = (distance <= GATE) | (self.left_out[:, robot] >= AGAIN)
        self.left_out[:, robot] = np.where(fine, 0, self.left_out[:, robot] + 1)
        return fine[:, None, None]

    def correct(self, event: Sighting, rows: list[int], K: np.ndarray, H: dict[int, np.ndarray], y: np.ndarray) -> None:
        change = (K @ y[..., None])[..., 0]
        self.x[:, rows] += change.reshape(len(change), len(rows), 3)

    def errors(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Squared errors of position and NEES of a step, each (items, robots)."""
        e = self.x - self.course.record.truth[moment.step]
        e[..., 2] = wrapped(e[..., 2])
        nees = (e[..., None, :] @ np.linalg.solve(moment.claims, e[..., None]))[..., 0, 0]
        return e[..., 0] ** 2 + e[..., 1] ** 2, nees


class RobotMoments:
    """Second moments of the errors along a path (steps, robots, 3): E (items, 3n, 3n) and M (items, 3n, biases).

    Biases are, for every robot, constant and process of speed and of turn rate, then constants and common processes
    of range and bearing, then range and bearing of every subject.
    """

    def __init__(self, course: RobotPath, noises: ChannelNoises, path: np.ndarray, items: int) -> None:
        record = course.record
        self.course, self.noises, self.path, self.n = course, noises, path, len(record.robots)
        self.subjects = self.n + len(record.landmarks)
        constant = [noises.speed, noises.turn, noises.range, noises.bearing]
        columns = [(c.doubt, np.inf) for c in constant] + [(c.common.variance, c.common.time) for c in constant]
        columns = [columns[k] for k in (0, 4, 1, 5, 2, 6, 3, 7)]
        for c in (noises.range, noises.bearing):
            columns += [(c.subject.variance, c.subject.time)] * self.subjects
        self.variance = np.stack([v for v, _ in columns], axis=1).ravel()
        decay = np.exp(-record.interval / np.array([time for _, time in columns]))
        self.decay = np.tile(decay, self.n)
        self.width = len(columns)
        self.E = np.zeros((items, 3 * self.n, 3 * self.n))
        self.M = np.zeros((items, 3 * self.n, len(self.variance)))

    def blocks(self) -> np.ndarray:
        """Each robot's error covariance, (items, robots, 3, 3)."""
        return _blocks(self.E, self.n)

    def states(self, step: int) -> np.ndarray:
        return self.path[None, step]

    def valid(self, robot: int, y: np.ndarray, S: np.ndarray) -> np.ndarray:
        return np.ones((len(S), 1, 1), dtype=bool)

    def move(self, step: int) -> np.ndarray:
        T, at, n = self.course.record.interval, self.path[step - 1], self.n
        motion, noises = self.course.motion[step - 1], self.noises
        _, F = moved(at, motion, T)
        size = self.course.record.odometry[step - 1]
        # what a unit of relative error of speed and of turn rate moves
        push = np.zeros((n, 3, 2))
        push[:, 0, 0], push[:, 1, 0] = np.cos(at[:, 2]) * size[:, 0] * T, np.sin(at[:, 2]) * size[:, 0] * T
        push[:, 2, 1] = size[:, 1] * T
        gamma, white = np.zeros((3 * n, len(self.variance))), np.zeros((3 * n, 3 * n))
        per_step = BLOCK / T
        for i in range(n):
            rows, first = slice(3 * i, 3 * i + 3), self.width * i
            gamma[rows, first : first + 4] = push[i][:, [0, 0, 1, 1]]
            w = np.array([noises.speed.white[i], noises.turn.white[i]]) * per_step
            white[rows, rows] = (push[i] * w) @ push[i].T
        whole = _diagonal(F)
        cross = (whole @ self.M) @ gamma.T
        self.E = whole @ self.E @ whole.T + cross + NUMPY.transpose(cross) + (gamma * self.variance) @ gamma.T + white
        self.M = (whole @ self.M + gamma * self.variance) * self.decay
        return F[None]

    def correct(self, event: Sighting, rows: list[int], K: np.ndarray, H: dict[int, np.ndarray], y: np.ndarray) -> None:
        i, first = event.robot, self.width * event.robot
        size = np.array([event.measured[0], 1.0])
        columns = first + np.array([[4, 5, 8 + event.subject], [6, 7, 8 + self.subjects + event.subject]])
        white = size**2 * np.array([self.noises.range.white[i], self.noises.bearing.white[i]])
        # y = −He + Bb + v
        HE = sum(h @ self.E[:, 3 * robot : 3 * robot + 3] for robot, h in H.items())
        yb = -np.asarray(sum(h @ self.M[:, 3 * robot : 3 * robot + 3] for robot, h in H.items()))
        eB = self.M[:, :, columns].sum(axis=-1) * size
        ey = eB - NUMPY.transpose(HE)
        for m in range(2):
            yb[:, m, columns[m]] += size[m] * self.variance[columns[m]]
        By = NUMPY.transpose(yb[:, :, columns].sum(axis=-1) * size)
        He_y = sum(h @ ey[:, 3 * robot : 3 * robot + 3] for robot, h in H.items())
        yy = By - He_y + white * np.eye(2)
        at = (3 * np.array(rows)[:, None] + np.arange(3)).ravel()
        change = K @ NUMPY.transpose(ey)
        self.E[:, at] += change
        self.E[:, :, at] += NUMPY.transpose(change)
        self.E[:, at[:, None], at] += K @ yy @ NUMPY.transpose(K)
        self.M[:, at] += K @ yb

    def errors(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Expected squared errors of position and NEES of a step, each (items, robots)."""
        E = self.blocks()
        nees = np.trace(np.linalg.solve(moment.claims, E), axis1=-2, axis2=-1)
        return E[..., [0, 1], [0, 1]].sum(axis=-1), nees


class Moment(NamedTuple):
    """A step of filters and its claims (items, robots, 3, 3); what is carried along is to be read at once."""

    step: int
    claims: np.ndarray


def filtered(
    course: RobotPath,
    estimator: str,
    assumed: Assumed,
    heard: np.ndarray,
    carried: Followed | RobotMoments,
    last: int | None = None,
) -> Iterator[Moment]:
    """Run one estimator, step by step.

    Parameters
    ----------
    course : the record.
    estimator : one of `ESTIMATORS`.
    assumed : the white noises that the filters are told.
    heard : (items, pairs, 2) whether the message to the observer, and that to the observed, arrived.
    carried : `Followed` or `RobotMoments`; read it at every step.
    last : step to end with; default: all.
    """
    record, n, T = course.record, len(course.record.robots), course.record.interval
    claims = RobotCovariances(estimator, len(heard), n)
    everyone = list(range(n))
    for step in range(record.steps if last is None else last + 1):
        if step:
            x = carried.states(step - 1)
            push = np.zeros((*x.shape[:-1], 3, 2))
            push[..., 0, 0], push[..., 1, 0], push[..., 2, 1] = np.cos(x[..., 2]) * T, np.sin(x[..., 2]) * T, T
            claims.move(carried.move(step), (push * assumed.Q[:, None, :]) @ NUMPY.transpose(push))
        for event in course.events[step]:
            i, subject, x = event.robot, event.subject, carried.states(step)
            place = x[:, subject, :2] if subject < n else record.places[subject - n]
            expected, H_i = seen(x[:, i], place)
            y = event.measured - expected
            y[..., 1] = wrapped(y[..., 1])
            R = np.diag(assumed.R[i] * np.array([event.measured[0] ** 2, 1.0]))
            if subject >= n:
                K = claims.landmark(i, H_i, R, lambda S, i=i, y=y: carried.valid(i, y, S))
                carried.correct(event, everyone if claims.joint else [i], K, {i: H_i}, y)
                continue
            H_j = np.concatenate([-H_i[..., :2], np.zeros((*H_i.shape[:-1], 1))], axis=-1)
            arrived = heard[:, event.at]
            K = claims.robot((i, subject), (H_i, H_j), R, arrived, lambda S, i=i, y=y: carried.valid(i, y, S))
            if K is not None:
                carried.correct(event, everyone if claims.joint else [i, subject], K, {i: H_i, subject: H_j}, y)
        yield Moment(step, claims.blocks())
