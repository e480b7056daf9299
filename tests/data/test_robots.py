"""Robots' records: identification finds known noises, prediction is exact, spoilt folders are named."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.robot_errors import Channel, ChannelNoises, Process, identify
from stochfuse.data.robot_filters import ESTIMATORS, Followed, RobotMoments, _intersected, assumed, course_of, filtered
from stochfuse.data.robots import moved, read_robots, seen
from stochfuse.errors import UsageError
from stochfuse.fusion.extended import jacobian
from stochfuse.fusion.intersection import fuse_stack
from tests.cli.command import run as command
from tests.cli.command import strict_json
from tests.data.robot_records import Drawn, write

MRCLAM = Path(__file__).parents[3] / "shared" / "data" / "mrclam"
there = pytest.mark.skipif(not MRCLAM.exists(), reason="the robots' record is not here")
CONSTANTS = Drawn(range_constants=(0.0, 0.1, -0.1), bearing_constants=(0.06, 0.0, 0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A minute of it, in steps of a quarter of a second."""
    return write(tmp_path_factory.mktemp("robots"), 1, CONSTANTS, landmarks=6, seconds=61.0, interval=0.25)


@pytest.fixture(scope="module")
def record(folder):
    return read_robots(folder)


def test_the_reader_keeps_what_was_written(folder, record):
    first = (folder / "truth.csv").read_text().splitlines()[1].split(",")
    assert (record.robots, record.landmarks) == ((1, 2, 3), tuple(range(4, 10)))
    assert record.interval == pytest.approx(0.25)
    assert record.truth[0, 0] == pytest.approx([float(v) for v in first[2:]])
    few = record.with_landmarks(2)
    assert len(set(few.sightings.subject[few.sightings.subject >= 3])) == 2
    assert (few.sightings.subject < 3).sum() == (record.sightings.subject < 3).sum()


def test_a_sighting_between_steps_is_told_as_from_the_nearest(folder, tmp_path):
    """A robot that turns at 0.5 rad/s sees a still thing 0.08 s after a step."""
    shutil.copytree(folder, tmp_path / "r")
    turn = "time,robot,speed,turn_rate\n" + "".join(f"{k * 0.2:.1f},1,0.1,0.5\n" for k in range(50))
    truth, x, y, heading = "time,robot,x,y,heading\n", 0.0, 0.0, 0.0
    where = []
    for k in range(500):  # ten small steps to one
        if k % 10 == 0:
            truth += f"{k * 0.02:.1f},1,{x},{y},{heading}\n"
        where.append((x, y, heading))
        x, y, heading = x + 0.002 * np.cos(heading), y + 0.002 * np.sin(heading), heading + 0.01
    at = where[104]
    sight = (np.hypot(3 - at[0], 1 - at[1]), (np.arctan2(1 - at[1], 3 - at[0]) - at[2] + np.pi) % (2 * np.pi) - np.pi)
    texts = {
        "odometry": turn,
        "truth": truth,
        "landmarks": "landmark,x,y\n9,3,1\n",
        "sightings": f"time,robot,subject,range,bearing\n2.08,1,9,{sight[0]},{sight[1]}\n",
    }
    for name, text in texts.items():
        (tmp_path / "r" / f"{name}.csv").write_text(text)
    s = read_robots(tmp_path / "r").sightings
    at = where[100]
    assert s.step[0] == 10
    assert s.range[0] == pytest.approx(np.hypot(3 - at[0], 1 - at[1]), abs=1e-4)
    assert np.tan(s.bearing[0]) == pytest.approx(np.tan(np.arctan2(1 - at[1], 3 - at[0]) - at[2]), abs=1e-3)


def test_jacobians_are_those_of_differences():
    x, place = np.array([0.3, -1.2, 0.7]), np.array([2.0, 0.5])
    motion = np.array([0.4, -0.3])
    F = jacobian(lambda c: moved(c[..., 0], motion, 0.5)[0][..., None], x[:, None])
    assert moved(x, motion, 0.5)[1] == pytest.approx(F, abs=1e-8)
    H = jacobian(lambda c: seen(c[..., 0], place)[0][..., None], x[:, None])
    assert seen(x, place)[1] == pytest.approx(H, abs=1e-8)


def test_identification_finds_what_was_drawn(tmp_path):
    """Standard errors by hand: range 8 % of its deviation over some 150 independent numbers, odometry 4 %."""
    found = identify(read_robots(write(tmp_path, 1, CONSTANTS, seconds=90.0)), 0.0, 80.0)
    assert np.sqrt(found.speed.variance) == pytest.approx(0.08, rel=0.2)
    assert np.sqrt(found.turn.variance) == pytest.approx(0.15, rel=0.25)
    total = np.hypot(0.05, 0.01)
    assert np.sqrt(found.range.variance) == pytest.approx(total, rel=0.25)
    share = found.range.subject.variance / found.range.variance
    assert share == pytest.approx(0.05**2 / total**2, abs=0.25)
    assert 1.5 < found.range.subject.time < 8.0
    assert np.sqrt(found.bearing.common.variance) == pytest.approx(0.012, rel=0.35)
    assert 0.8 < found.bearing.common.time < 5.0
    for channel, drawn in ((found.range, CONSTANTS.range_constants), (found.bearing, CONSTANTS.bearing_constants)):
        off = (channel.mean - np.array(drawn)) / np.sqrt(channel.doubt)
        assert np.abs(off).max() < 3.5
        assert np.sqrt(channel.doubt).max() < 0.5 * np.max(drawn)
    assert (found.range.alike > 3.0).all()
    assert found.white().range.alike == pytest.approx(1.0)


def test_gross_errors_are_left_out(folder, record, tmp_path):
    shutil.copytree(folder, tmp_path / "r")
    lines = (tmp_path / "r" / "sightings.csv").read_text().splitlines()
    spoilt = [*lines[:1], *(_misread(line) if k % 40 == 0 else line for k, line in enumerate(lines[1:]))]
    (tmp_path / "r" / "sightings.csv").write_text("\n".join(spoilt) + "\n")
    found_record = read_robots(tmp_path / "r")
    clean, found = (identify(each, 0.0, 30.0) for each in (record, found_record))
    assert found.gross == pytest.approx(1 / 40, abs=0.01)
    assert found.range.variance == pytest.approx(clean.range.variance, rel=0.15)
    course = course_of(found_record, found)
    followed = Followed(course, 1)
    nobody = np.zeros((1, course.pairs, 2), dtype=bool)
    for moment in filtered(course, "stand-alone", assumed(found_record, found, 120), nobody, followed):
        assert np.hypot(*(followed.x - found_record.truth[moment.step])[0, :, :2].T).max() < 0.5


def _misread(line):
    time, robot, subject, distance, bearing = line.split(",")
    return ",".join([time, robot, subject, str(float(distance) * 2.0), bearing])


def test_intersection_in_bulk_is_the_intersection():
    rng = np.random.default_rng(3)

    def some(d):
        A = rng.normal(size=(20, d, d))
        return A @ np.swapaxes(A, -1, -2) + 0.05 * np.eye(d)

    H = rng.normal(size=(20, 2, 3))
    for A2, B2 in ((np.zeros((20, 3, 3)), np.zeros((20, 2, 2))), (0.2 * some(3), 0.3 * some(2))):
        A1, B1 = some(3), some(2)
        stack = fuse_stack((A1, B1), (A2, B2), [None, H])
        K, P = _intersected(A1, A2, B1, B2, H)
        assert np.linalg.slogdet(P)[1] == pytest.approx(np.linalg.slogdet(stack.C)[1], abs=3e-3)
        assert pytest.approx(stack.gains[1], abs=0.03) == K


class Dense(RobotMoments):
    """The same moments by one dense joint covariance of errors and biases, every matrix written out."""

    def __init__(self, course, noises, path, items):
        super().__init__(course, noises, path, items)
        self.d = 3 * self.n
        self.whole = np.zeros((items, self.d + len(self.variance), self.d + len(self.variance)))
        self.whole[:, self.d :, self.d :] = np.diag(self.variance)

    def move(self, step):
        F = super().move(step)
        T, (V, omega) = self.course.record.interval, np.moveaxis(self.course.record.odometry[step - 1], -1, 0)
        A, Q = np.diag(np.r_[np.ones(self.d), self.decay]), np.zeros_like(self.whole[0])
        for i in range(self.n):
            rows, heading = slice(3 * i, 3 * i + 3), self.path[step - 1, i, 2]
            A[rows, rows] = F[0, i]
            along = np.array([np.cos(heading), np.sin(heading), 0.0]) * V[i] * T
            across = np.array([0.0, 0.0, omega[i] * T])
            for column, push in enumerate((along, along, across, across)):
                A[rows, self.d + self.width * i + column] = push
            Q[rows, rows] = (
                np.outer(along, along) * self.noises.speed.white[i]
                + np.outer(across, across) * self.noises.turn.white[i]
            ) / T
        Q[self.d :, self.d :] = np.diag(self.variance * (1 - self.decay**2))
        self.whole = A @ self.whole @ A.T + Q
        return F

    def correct(self, event, rows, K, H, y):
        super().correct(event, rows, K, H, y)
        i, n, subjects = event.robot, self.n, self.subjects
        C = np.zeros((2, self.whole.shape[-1]))
        size = (event.measured[0], 1.0)
        for m, (constant, common, each) in enumerate(((4, 5, 8), (6, 7, 8 + subjects))):
            for column in (constant, common, each + event.subject):
                C[m, self.d + self.width * i + column] = size[m]
        for robot, h in H.items():
            C[:, 3 * robot : 3 * robot + 3] -= h[0]
        R = np.diag([size[0] ** 2 * self.noises.range.white[i], self.noises.bearing.white[i]])
        gain = np.zeros((len(K), self.whole.shape[-1], 2))
        gain[:, [3 * r + k for r in rows for k in range(3)]] = K
        A = np.eye(self.whole.shape[-1]) + gain @ C
        self.whole = A @ self.whole @ np.swapaxes(A, -1, -2) + gain @ R @ np.swapaxes(gain, -1, -2)
        assert n == self.n


@pytest.mark.parametrize("estimator", ["naive", "split-ci", "itns"])
def test_moments_are_those_of_the_dense_joint_covariance(estimator, record):
    """Noises of all kinds at a time, unlike robots."""
    one = np.array([1.0, 0.7, 1.3])

    def channel(size):
        part = one * size**2
        return Channel(0 * one, 0.1 * part, Process(part, 1.5), Process(0.5 * part, 3.0), 0.2 * part, one * 2, one)

    noises = ChannelNoises(channel(0.1), channel(0.2), channel(0.05), channel(0.01), 0.0, 0.0)
    course = course_of(record, noises)
    heard = np.random.default_rng(0).random((2, course.pairs, 2)) < 0.6
    carried = Dense(course, noises, record.truth, 2)
    told = assumed(record, noises, 100)
    exchanged = 0
    for moment in filtered(course, estimator, told, heard, carried, 60):
        exchanged += sum(event.subject < 3 for event in course.events[moment.step])
        if moment.step % 10 == 0:
            np.testing.assert_allclose(carried.whole[:, :9, :9], carried.E, rtol=1e-9, atol=1e-14)
            np.testing.assert_allclose(carried.whole[:, :9, 9:], carried.M, rtol=1e-9, atol=1e-14)
    assert exchanged > 5


@pytest.mark.slow
def test_without_messages_all_are_alone(record):
    found = sf.run_robots(record, [0], ESTIMATORS, runs=1, until=30.0)
    alone = found.row("stand-alone", 0)
    for name in ESTIMATORS:
        row = found.row(name, 0)
        assert (row.realised, row.claimed, row.predicted) == pytest.approx(
            (alone.realised, alone.claimed, alone.predicted), rel=1e-6
        )


@pytest.fixture(scope="module")
def white(record):
    return tuple(
        sf.run_robots(record, [0], ["stand-alone"], until=30.0, noises=noises) for noises in ("white", "identified")
    )


def test_white_noise_claims_what_it_predicts(white):
    """With white noises in filter and truth the claim is the prediction but for odometry in proportion to its size."""
    white, full = (run.row("stand-alone", 0) for run in white)
    assert white.claimed == pytest.approx(white.predicted, rel=0.2)
    assert white.predicted_nees == pytest.approx(3.0, rel=0.25)
    assert full.predicted > 1.3 * white.predicted
    assert white.nees.mean > 1.5 * full.nees.mean


def test_claims_make_up_for_noises_that_the_calibration_run_shows_to_be_too_small(record, white):
    """Noises said to have a ninth of their variance: predicted is a third, the claim what it was but for who was gated."""
    full = white[1]

    def ninth(channel):
        parts = {name: getattr(channel, name)._replace(variance=getattr(channel, name).variance / 9)
                 for name in ("common", "subject")}  # fmt: skip
        return channel._replace(doubt=channel.doubt / 9, white=channel.white / 9, **parts)

    n = full.noises
    small = n._replace(**{name: ninth(getattr(n, name)) for name in ("speed", "turn", "range", "bearing")})
    found = sf.run_robots(record, [0], ["stand-alone"], until=30.0, noises=small).row("stand-alone", 0)
    known = full.row("stand-alone", 0)
    assert found.predicted == pytest.approx(known.predicted / 3, rel=0.05)
    assert known.claimed * 0.8 < found.claimed
    assert found.nees.mean < 1.5 * max(known.nees.mean, 3.0)


def test_json_and_table(folder):
    words = ["run", "utias", "--data", folder, "--until", 30]
    done = command(*words, "--link", "0,1", "--estimator", "lwin", "--format", "json")
    got = strict_json(done.stdout)
    assert got["schema"] == "stochfuse.run/1"
    assert [(row["agent"], row["link"]) for row in got["rows"]] == [(a, µ) for µ in (0, 1) for a in (1, 2, 3, None)]
    robots, mean = got["rows"][4:7], got["rows"][7]
    assert mean["realised"] == pytest.approx(np.mean([row["realised"] for row in robots]))
    assert mean["verdict"] in ("consistent", "overconfident", "cautious")
    assert mean["nees_low"] < 3 < mean["nees_high"]


def test_the_table_and_the_figure(white):
    run, _ = white
    text = run._repr_html_()
    assert re.search(r"stand-alone</td><td[^>]*>0</td><td[^>]*>0\.\d", text)
    assert re.search(r"0\.0\d+ of range", text)
    left, *robots = run.plot().axes
    assert left.get_xlabel() == "link probability µ"
    assert [axes.get_ylabel() for axes in robots] == [f"robot {i} [m]" for i in (1, 2, 3)]
    alone = np.hypot(*run.alone[:, 1, :2].T)
    np.testing.assert_allclose(robots[1].lines[0].get_ydata()[-1], alone[-1])


def edit(name, change):
    def spoil(folder):
        path = folder / f"{name}.csv"
        lines = path.read_text().splitlines()
        path.write_text("\n".join(change(lines)) + "\n")

    return spoil


def column(place, factor):
    def change(lines):
        rows = [line.split(",") for line in lines[1:]]
        for row in rows:
            row[place] = str(float(row[place]) * factor)
        return [lines[0], *map(",".join, rows)]

    return change


def cell(line, place, value):
    def change(lines):
        row = lines[line - 1].split(",")
        row[place] = value
        return [*lines[: line - 1], ",".join(row), *lines[line:]]

    return change


SPOILT = [
    (lambda f: (f / "truth.csv").unlink(), r"truth\.csv: expected a table with columns time, .*, found no file"),
    (edit("odometry", cell(1, 2, "V")), r"odometry\.csv: .*column 'speed' is missing from time, robot, V, turn_rate"),
    (edit("odometry", cell(9, 2, "nan")), r"odometry\.csv, line 9, column 'speed': expected a .*number, got '?nan"),
    (edit("sightings", cell(7, 3, "")), r"sightings\.csv, line 7, column 'range': expected a number"),
    (edit("sightings", cell(7, 3, "-1")), r"sightings\.csv, line 7, column 'range': expected a number of at least 0"),
    (edit("sightings", cell(7, 2, "77")), r"sightings\.csv, line 7, column 'subject': .* landmark .* got 77"),
    (edit("sightings", lambda s: [*s[:5], s[40], *s[5:]]), r"sightings\.csv, line 7, column 'time': expected times in order"),
    (edit("odometry", lambda s: [*s[:9], s[3], *s[9:]]), r"odometry\.csv, line 10, column 'time': expected later than"),
    (edit("odometry", lambda s: [*s[:30], *s[31:]]), r"odometry\.csv, line 31, column 'time': expected 7\.25, every 0\.25 s"),
    (edit("truth", lambda s: s[:-1]), r"truth\.csv, line \d+, column 'time': expected 245 rows of robot 3 in all, got 244"),
    (edit("landmarks", cell(3, 0, "4")), r"landmarks\.csv, line 3, column 'landmark': expected a number that no other"),
    (edit("sightings", column(4, 57.3)), r"column 'bearing': expected rad from the heading, .*degrees"),
    (edit("truth", column(4, 57.3)), r"truth.csv has it|truth\.csv's heading not in rad"),
    (edit("sightings", column(3, 1000.0)), r"column 'range': expected m as truth\.csv has it, got \d+ times that"),
    (edit("odometry", column(2, 100.0)), r"column 'speed': expected m/s as truth\.csv has it, got \d+"),
    (edit("odometry", column(3, 57.3)), r"column 'turn_rate': expected rad/s as truth\.csv has it"),
    (edit("sightings", column(0, 1000.0)), r"column 'time': expected a time from 0 to 61 s, as in odometry.csv"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), SPOILT)
def test_spoilt_folders_are_named(spoil, message, folder, tmp_path):
    shutil.copytree(folder, tmp_path / "r")
    spoil(tmp_path / "r")
    with pytest.raises(UsageError, match=message):
        read_robots(tmp_path / "r")


WORDS = [
    (
        ["--estimator", "local-fusion-graph", "--until", "30"],
        r"expected agents that track one state by one model, got robots",
    ),
    (["--landmarks", "9", "--until", "30"], r"landmarks: expected 1 to 6, got 9"),
    (["--until", "40"], r"expected 70 s or more \(40 s to identify noises on, the rest to compare\), got 61 s"),
    (["--agents", "3"], r"--agents: expected a scenario, got utias"),
    (["--metric", "trace"], r"--metric: expected rms:x,y with utias, got trace"),
    (["--link", "2"], r"--link: expected probabilities between 0 and 1, got 2"),
]


@pytest.mark.parametrize(("words", "message"), WORDS)
def test_words_that_do_not_go_with_robots(words, message, folder):
    said = command("run", "utias", "--data", folder, *words, code=2).stderr
    assert re.search(message, said)
    assert "\n" not in said.strip()


def test_data_go_with_robots_alone(folder, tmp_path):
    said = command("run", "utias", code=2).stderr
    assert "--data: expected a folder with a record of robots" in said
    said = command("run", "thesis-steady", "--data", folder, code=2).stderr
    assert "expected with utias alone, got thesis-steady" in said
    said = command("run", "utias", "--data", tmp_path / "none", code=2).stderr
    assert "expected a folder with odometry.csv" in said


@pytest.mark.slow
def test_prediction_is_what_is_realised_of_drawn_records(tmp_path):
    """Mean squares over six records of three robots: some 110 independent errors, known within 14 %."""
    found = []
    for seed in range(6):
        drawn = Drawn(range_constants=(0.0, 0.03, -0.03), bearing_constants=(0.02, 0.0, 0.0))
        run = sf.run_robots(write(tmp_path / str(seed), seed, drawn), [1], ["stand-alone", "itns"], runs=1)
        rows = [row for row in run.rows if row.agent is None]
        found.append([(row.realised**2, row.predicted**2, row.nees.mean, row.predicted_nees) for row in rows])
    mean = np.mean(found, axis=0)
    assert np.sqrt(mean[:, 1] / mean[:, 0]) == pytest.approx(1.0, abs=0.25)
    assert mean[:, 2] == pytest.approx(mean[:, 3], rel=0.35)


CONSISTENT = ["stand-alone", "covariance-intersection", "split-ci", "itns"]


@there
@pytest.mark.slow
@pytest.mark.parametrize("landmarks", [None, 5])
def test_robots_of_the_record(landmarks):
    """Predicted within a factor of 1.3 of realised, its change with µ within 20 %; with few landmarks exchange shows."""
    names = CONSISTENT if landmarks is None else CONSISTENT[:1] + CONSISTENT[2:]
    run = sf.run_robots(MRCLAM, [0, 0.5, 1], names, runs=1, landmarks=landmarks)
    for name in names:
        first = run.row(name, 0)
        for link in (0, 0.5, 1):
            row = run.row(name, link)
            assert 1 / 1.3 < row.predicted / row.realised < 1.3
            assert (row.predicted / first.predicted) / (row.realised / first.realised) == pytest.approx(1.0, abs=0.2)
    if landmarks:
        assert run.row("itns", 1).realised < 0.7 * run.row("stand-alone", 1).realised
        assert [run.row(name, 1).verdict for name in ("stand-alone", "itns")] == ["consistent"] * 2
        assert run.row("split-ci", 1).verdict == "cautious"  # it allows for correlations that are not there
    else:
        assert [run.row(name, 1).verdict for name in CONSISTENT[1:]] == ["consistent"] * 3


@there
@pytest.mark.slow
def test_white_noise_at_face_value_claims_too_little():
    run = sf.run_robots(MRCLAM, [0], ["stand-alone"], noises="white")
    row = run.row("stand-alone", 0)
    assert row.verdict == "overconfident"
    assert row.claimed < 0.75 * row.realised
    assert row.predicted < 0.75 * row.realised
