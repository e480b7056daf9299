"""The journal of a study: whatever is killed, cut off or damaged, no finished part is lost and the result is the same."""

from __future__ import annotations

import csv
import os
import re
import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import pyarrow.parquet as pq
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

import stochfuse as sf
from stochfuse.studies import plan as plans
from stochfuse.studies.journal import DamagedError, Journal
from tests.oracles.faulty_disk import FaultyDisk, Killed

CHUNKS = 4
AGAIN = "finished points are kept: the same command goes on"


@pytest.fixture(scope="module", autouse=True)
def no_waiting_for_the_disk():
    """What fsync keeps is modelled by FaultyDisk; the real one only takes time."""
    with mock.patch.object(os, "fsync"):
        yield


def answer(version: int, chunk: int) -> bytes:
    return bytes((version * 31 + chunk * 7 + i) % 256 for i in range(chunk * 40 + 3))


def whole(version: int) -> bytes:
    return b"".join(answer(version, chunk) for chunk in range(CHUNKS))


def said(error: sf.UsageError, message: str) -> None:
    assert re.search(message, str(error)), error


class JournalMachine(RuleBasedStateMachine):
    """What a user, a kill, a power cut and a bad disk may do, one after another.

    The model is `committed`: the parts that must be there, since `commit` came back; parts whose commit was cut off
    (`maybe`) may be there, but only whole.
    """

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.output = self.folder / "result.csv"
        self.version = 1
        self.committed: set[int] = set()
        self.maybe: set[int] = set()
        self.began = self.finished = self.restarting = False
        self.hold: ExitStack | None = None
        self.journal = self.make(1)

    def make(self, version: int) -> Journal:
        return Journal(self.output, {"study": {"version": version}}, "mine.toml")

    def teardown(self) -> None:
        try:
            # whatever happened, the same command goes on to the same result
            self.release()
            if self.restarting:
                self.restart(0)
            self.open()
            self.complete()
            assert self.output.read_bytes() == whole(self.version)
            assert sorted(path.name for path in self.folder.iterdir()) == ["result.csv", "result.csv.study.json"]
        finally:
            self.release()
            shutil.rmtree(self.folder)

    def release(self) -> None:
        if self.hold is not None:
            self.hold.close()
        self.hold = None

    def write(self, path: Path) -> dict[str, int]:
        with path.open("wb") as file:
            for chunk in range(CHUNKS):
                file.write(self.journal.read(chunk))
        return {"rows": CHUNKS}

    def die(self, disk: FaultyDisk, share: float, power: bool) -> None:
        """Forget what is in memory."""
        if self.hold is not None:
            with disk:
                # closing files and letting go of the lock is all that is left of a process
                self.hold.__exit__(Killed, Killed(), None)
        self.hold = None
        disk.lose(share, power=power)
        self.journal = self.make(self.version)

    def look(self) -> None:
        """What is there is what was committed, and perhaps what was being committed."""
        done = self.journal.done()
        assert self.committed <= done <= self.committed | self.maybe
        for chunk in done:
            assert self.journal.read(chunk) == answer(self.version, chunk)
        self.committed, self.maybe = done, set()
        assert not [path for path in self.journal.folder.iterdir() if path.name.startswith(".")]

    def opened(self) -> None:
        self.began, self.finished = True, False
        self.look()

    @precondition(lambda self: self.hold is None and not self.restarting)
    @rule()
    def open(self) -> None:
        if self.journal.finished:
            self.journal.clean()
            self.finished, self.began = True, False
            self.committed, self.maybe = set(), set()
            return
        assert not self.finished
        self.hold = ExitStack()
        self.hold.enter_context(self.journal.open())
        self.opened()

    @precondition(lambda self: self.hold is None and not self.restarting and not self.finished)
    @rule(at=st.integers(1, 16), share=st.floats(0, 1), power=st.booleans())
    def killed_at_opening(self, at: int, share: float, power: bool) -> None:
        if self.journal.finished:
            return
        disk, hold = FaultyDisk(self.folder, at, kill=True), ExitStack()
        try:
            with disk:
                hold.enter_context(self.journal.open())
        except Killed:
            self.die(disk, share, power)
        else:
            self.hold = hold
            self.opened()

    @precondition(lambda self: self.hold is not None)
    @rule(chunk=st.integers(0, CHUNKS - 1))
    def commit(self, chunk: int) -> None:
        self.journal.commit(chunk, answer(self.version, chunk))
        self.committed.add(chunk)

    @precondition(lambda self: self.hold is not None)
    @rule(chunk=st.integers(0, CHUNKS - 1), at=st.integers(1, 8), share=st.floats(0, 1), power=st.booleans())
    def killed_at_commit(self, chunk: int, at: int, share: float, power: bool) -> None:
        disk = FaultyDisk(self.folder, at, kill=True)
        try:
            with disk:
                self.journal.commit(chunk, answer(self.version, chunk))
        except Killed:
            self.maybe.add(chunk)
            self.die(disk, share, power)
        else:
            self.committed.add(chunk)

    @precondition(lambda self: self.hold is not None)
    @rule(chunk=st.integers(0, CHUNKS - 1), at=st.integers(1, 8), stays=st.booleans())
    def full_at_commit(self, chunk: int, at: int, stays: bool) -> None:
        disk = FaultyDisk(self.folder, at, stays=stays)
        try:
            with disk:
                self.journal.commit(chunk, answer(self.version, chunk))
        except sf.UsageError as error:
            said(error, f"cannot write .*part-0000000{chunk}: No space left on device; {AGAIN}")
            # the command ends here
            self.release()
            self.maybe.add(chunk)
            self.journal = self.make(self.version)
        else:
            self.committed.add(chunk)

    @precondition(lambda self: self.hold is not None)
    @rule()
    def complete(self) -> None:
        if self.hold is None:
            return
        for chunk in set(range(CHUNKS)) - self.committed:
            self.commit(chunk)
        self.journal.finish(self.write)
        self.release()
        self.end()

    def end(self) -> None:
        self.finished, self.began = True, False
        self.committed, self.maybe = set(), set()
        assert self.journal.facts == {"rows": CHUNKS}

    @precondition(lambda self: self.hold is not None)
    @rule(at=st.integers(1, 30), share=st.floats(0, 1), power=st.booleans())
    def killed_at_finish(self, at: int, share: float, power: bool) -> None:
        for chunk in set(range(CHUNKS)) - self.committed:
            self.commit(chunk)
        disk = FaultyDisk(self.folder, at, kill=True)
        try:
            with disk:
                self.journal.finish(self.write)
        except Killed:
            self.die(disk, share, power)
            if self.journal.finished:
                # the parts are no longer needed, and may be half deleted
                self.committed, self.maybe = set(), set(range(CHUNKS))
                self.finished = True
        else:
            self.release()
            self.end()

    @precondition(lambda self: self.hold is not None)
    @rule()
    def killed_between(self) -> None:
        self.die(FaultyDisk(self.folder, 0, kill=True), 1.0, False)

    @precondition(lambda self: self.hold is not None)
    @rule()
    def a_second_command_is_refused(self) -> None:
        with pytest.raises(sf.UsageError, match=r"another process is working on .*result\.csv\.parts"):
            self.make(self.version).open().__enter__()

    @precondition(lambda self: self.hold is None and (self.began or self.finished) and not self.restarting)
    @rule()
    def a_changed_study_is_refused(self) -> None:
        other = self.make(self.version + 1)
        assert not other.finished
        reason = rf"mine\.toml.*: version was {self.version} and is {self.version + 1}; .*--restart"
        with pytest.raises(sf.UsageError, match=reason):
            other.open().__enter__()

    @precondition(lambda self: self.hold is None)
    @rule(at=st.integers(0, 16), share=st.floats(0, 1), power=st.booleans())
    def restart(self, at: int, share: float = 1.0, power: bool = False) -> None:
        if not self.restarting:
            self.version += 1
        self.journal, hold = self.make(self.version), ExitStack()
        disk = FaultyDisk(self.folder, at or None, kill=True)
        self.committed, self.maybe = set(), set()
        try:
            with disk:
                hold.enter_context(self.journal.open(restart=True))
        except Killed:
            self.restarting, self.began, self.finished = True, False, False
            self.die(disk, share, power)
        else:
            self.hold, self.restarting = hold, False
            self.opened()
            assert not self.committed

    @precondition(lambda self: self.hold is None and self.restarting)
    @rule()
    def without_restart_no_old_part_is_taken(self) -> None:
        try:
            with self.journal.open():
                assert self.journal.done() == set()
        except sf.UsageError as error:
            said(error, "begin anew with --restart")

    @precondition(lambda self: self.hold is None and self.committed | self.maybe)
    @rule(data=st.data())
    def a_part_is_damaged(self, data: st.DataObject) -> None:
        # a second damage might mend the first
        whole = {f"part-{chunk:08d}" for chunk in self.committed | self.maybe}
        parts = [part for part in sorted(self.journal.folder.glob("part-*")) if part.name in whole]
        if not parts:
            return
        part = data.draw(st.sampled_from(parts))
        raw = bytearray(part.read_bytes())
        if data.draw(st.booleans()):
            raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
        else:
            del raw[data.draw(st.integers(0, len(raw) - 1)) :]
        part.write_bytes(raw)
        chunk = int(part.name[-8:])
        with pytest.raises(DamagedError):
            self.journal.read(chunk)
        self.committed.discard(chunk)
        self.maybe.discard(chunk)

    @precondition(lambda self: self.hold is None and self.began)
    @rule(chunk=st.integers(0, CHUNKS - 1), garbage=st.binary(max_size=30))
    def a_half_written_file_is_left(self, chunk: int, garbage: bytes) -> None:
        (self.journal.folder / f".part-{chunk:08d}.4711").write_bytes(garbage)

    @precondition(lambda self: self.hold is None and self.finished)
    @rule()
    def the_result_is_thrown_away(self) -> None:
        """And perhaps another study is begun beside what is left of the parts."""
        self.output.unlink()
        self.journal.description.unlink()
        self.finished = False
        self.began = (self.journal.folder / "study.json").exists()
        if not self.began:
            self.version += 1
            self.journal = self.make(self.version)
            self.committed, self.maybe = set(), set()

    @precondition(lambda self: self.hold is None and self.finished)
    @rule(garbage=st.binary(max_size=20))
    def the_result_is_changed(self, garbage: bytes) -> None:
        before = self.output.read_bytes()
        self.output.write_bytes(garbage)
        try:
            assert not self.journal.finished
            if not (self.journal.folder / "study.json").exists():
                with pytest.raises(sf.UsageError, match="the file has been changed since; begin anew with --restart"):
                    self.journal.open().__enter__()
        finally:
            self.output.write_bytes(before)

    @invariant()
    def the_result_is_whole_or_not_there(self) -> None:
        if self.finished:
            assert self.journal.finished
            assert self.output.read_bytes() == whole(self.version)
        elif self.output.exists():
            assert self.output.read_bytes() in [whole(version) for version in range(1, self.version + 1)]
        for version in range(1, self.version + 1):
            if self.output.exists() and self.make(version).finished:
                assert self.output.read_bytes() == whole(version)


class TestJournal(JournalMachine.TestCase):
    settings = settings(max_examples=60, stateful_step_count=25, deadline=None, derandomize=True)


@pytest.mark.slow
class TestJournalAtLength(JournalMachine.TestCase):
    settings = settings(max_examples=300, stateful_step_count=25, deadline=None, derandomize=True)


def test_parts_are_not_trusted_without_the_record_of_what_they_are(tmp_path):
    """As they are left when the deletion of a finished study's parts is cut off."""
    before = Journal(tmp_path / "result.csv", {"study": {"version": 1}}, "mine.toml")
    with before.open():
        for chunk in range(CHUNKS):
            before.commit(chunk, answer(1, chunk))
    (before.folder / "study.json").unlink()
    after = Journal(tmp_path / "result.csv", {"study": {"version": 2}}, "mine.toml")
    with after.open():
        assert after.done() == set()


def test_other_files_among_the_parts_do_no_harm(tmp_path):
    journal = Journal(tmp_path / "result.csv", {"study": {"version": 1}}, "mine.toml")
    with journal.open():
        journal.commit(0, answer(1, 0))
        (journal.folder / "part-00000001 (copy)").write_bytes(b"")
        assert journal.done() == {0}


def test_what_goes_wrong_while_the_journal_is_held_keeps_its_name(tmp_path):
    journal = Journal(tmp_path / "result.csv", {}, "mine.toml")
    with pytest.raises(ConnectionResetError, match="by peer"), journal.open():
        raise ConnectionResetError("by peer")


STUDY = {
    "scenario": {
        "model": {"F": 1.0, "H": 1.0, "Q": 1.0, "R": 1.0},
        "initial": {"P": 1.0},
        "network": {"agents": 3, "steps": 2, "link": 0.5},
    },
    "vary": {"network.link": [0.0, 0.3, 1.5, 1.0], "model.R": [1.0, 2.0, 0.0]},
}


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setitem(plans.CHUNK, "simplified", 5)


def rows(path: Path) -> list[dict[Any, Any]]:
    if path.suffix == ".parquet":
        return pq.read_table(path).to_pylist()
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def uninterrupted(tmp_path: Path, name: str) -> tuple[Path, list[tuple[str, str]]]:
    """The result without a fault, and all operations that it took."""
    folder = tmp_path / "whole"
    folder.mkdir()
    with FaultyDisk(folder) as disk:
        results = sf.study(STUDY, folder / name)
    assert (results.plan.chunks, results.failed) == (3, 6)
    assert [path.name for path in sorted(folder.iterdir())] == [name, f"{name}.study.json"]
    return folder / name, disk.done


def same(found: Path, expected: Path) -> None:
    assert rows(found) == rows(expected)
    if found.suffix == ".csv":
        assert found.read_bytes() == expected.read_bytes()
    else:
        assert pq.read_table(found).equals(pq.read_table(expected), check_metadata=True)
    assert [path.name for path in sorted(found.parent.iterdir())] == [found.name, f"{found.name}.study.json"]


@pytest.mark.parametrize("name", ["result.csv", "result.parquet"])
def test_all_writes_are_among_the_faults(name, tmp_path, small_chunks):
    _, done = uninterrupted(tmp_path, name)
    kinds = [what for what, _ in done]
    # record, three parts, result and its description: each brought to the disk before and after it gets its name
    for what in ("replace", "fsync", "fsync folder"):
        assert kinds.count(what) == 6, what
    assert kinds.count("mkdir") == kinds.count("rmdir") == 1
    for place, (what, _) in enumerate(done):
        if what == "replace":
            assert (kinds[place - 1], kinds[place + 1]) == ("fsync", "fsync folder")
    writes = [path for what, path in done if what == "write"]
    assert len(writes) >= 5 + 3


@pytest.mark.parametrize(
    ("name", "stays"),
    [
        ("result.csv", True),
        pytest.param("result.parquet", False, marks=pytest.mark.slow),
        pytest.param("result.csv", False, marks=pytest.mark.slow),
        pytest.param("result.parquet", True, marks=pytest.mark.slow),
    ],
)
def test_a_full_disk_at_every_operation(name, stays, tmp_path, small_chunks):
    expected, done = uninterrupted(tmp_path, name)
    refused = set()
    for at in range(1, len(done) + 1):
        folder = tmp_path / f"at{at}"
        folder.mkdir()
        disk = FaultyDisk(folder, at, stays=stays)
        try:
            with disk:
                sf.study(STUDY, folder / name)
        except sf.UsageError as error:
            message = rf"cannot write .*{re.escape(name)}[^:]*: (\[Errno 28\] )?No space left on device; {AGAIN}"
            said(error, message)
            refused.add(done[at - 1][0])
        else:
            assert rows(folder / name) == rows(expected)
        assert disk.failed == done[at - 1][0]
        sf.study(STUDY, folder / name)
        same(folder / name, expected)
    assert refused >= {"mkdir", "open", "write", "close", "fsync", "replace"}


@pytest.mark.parametrize(
    ("name", "share", "power"),
    [
        ("result.csv", 0.5, True),
        ("result.parquet", 1.0, False),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("result.csv", 0.0, False),
                ("result.csv", 1.0, False),
                ("result.parquet", 0.0, False),
                ("result.parquet", 0.5, True),
            ]
        ),
    ],
)
def test_killed_at_every_operation(name, share, power, tmp_path, small_chunks):
    expected, done = uninterrupted(tmp_path, name)
    for at in range(1, len(done) + 1):
        folder = tmp_path / f"at{at}"
        folder.mkdir()
        with FaultyDisk(folder, at, kill=True) as disk, pytest.raises(Killed):
            sf.study(STUDY, folder / name)
        disk.lose(share, power=power)
        kept = {path.name for path in folder.glob("*.parts/part-*")}
        committed = [path for what, path in done[: at - 1] if what == "fsync folder"].count(f"{name}.parts") - 1
        if at < [what for what, _ in done].index("rmdir") and not (folder / f"{name}.study.json").exists():
            assert len(kept) >= committed
        sf.study(STUDY, folder / name)
        same(folder / name, expected)


def test_finished_points_are_not_worked_out_again(tmp_path, small_chunks, monkeypatch):
    from stochfuse.studies import running

    asked, real = [], running.evaluate
    monkeypatch.setattr(running, "evaluate", lambda plan, points: asked.append(points.start) or real(plan, points))
    expected, done = uninterrupted(tmp_path, "result.csv")
    third = [place for place, entry in enumerate(done, 1) if entry == ("replace", "part-00000002")]
    folder = tmp_path / "again"
    folder.mkdir()
    asked.clear()
    with FaultyDisk(folder, third[0], kill=True), pytest.raises(Killed):
        sf.study(STUDY, folder / "result.csv")
    assert asked == [0, 5, 10]
    asked.clear()
    sf.study(STUDY, folder / "result.csv")
    assert asked == [10]
    asked.clear()
    sf.study(STUDY, folder / "result.csv")
    assert asked == []
    same(folder / "result.csv", expected)
