"""The journal of a study: finished parts on disk, never lost, repeated or half written.

Beside the result RESULT there are, while the study runs,

    RESULT.parts/study.json        what is asked (the record), written first
    RESULT.parts/part-00000012     the answers of a chunk of points, with a check sum
    RESULT.parts/lock              held by the process that works on it

and afterwards RESULT.study.json, which says what RESULT is.  Every file is written under another name, brought to the
disk, and then renamed, which is done or not done whatever happens.  The order is: all parts, the result, its
RESULT.study.json, then the parts are deleted; killed at any point, what is there says what remains to be done.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stochfuse.errors import UsageError

MAGIC = b"stochfuse part 1\n"


class DamagedError(Exception):
    """A part whose check sum does not fit."""


class Journal:
    """The journal of one result.

    Parameters
    ----------
    output : the result's file.
    record : what is asked, as JSON takes it.
    source : the study file's name, for messages.
    """

    def __init__(self, output: Path, record: Mapping[str, Any], source: str = "the study") -> None:
        self.output, self.record, self.source = output, record, source
        self.folder = output.with_name(output.name + ".parts")
        self.description = output.with_name(output.name + ".study.json")

    @property
    def finished(self) -> bool:
        """Whether the result is complete, and of this study."""
        described = _read(self.description)
        return (
            described is not None
            and not changed(described.get("record"), self.record)
            and self.output.is_file()
            and self.output.stat().st_size == described.get("bytes")
        )

    @property
    def facts(self) -> dict[str, Any]:
        """What was written down about the finished result."""
        return dict((_read(self.description) or {}).get("facts", {}))

    @contextmanager
    def open(self, *, restart: bool = False) -> Iterator[None]:
        """Hold the journal: begin it, or go on where it stopped.

        Parameters
        ----------
        restart : forget what there is.

        Raises
        ------
        UsageError
            If there is a result or a journal of something else, another process works on it, or it cannot be written.
        """
        if not restart:
            self._check()
        with _told(self.folder):
            self.folder.mkdir(exist_ok=True)
        with self._locked():
            with _told(self.folder):
                for part in self.folder.glob(".*"):  # half written when it was killed
                    part.unlink()
                if restart:
                    self.description.unlink(missing_ok=True)
                if restart or not (self.folder / "study.json").exists():
                    for _, part in self._parts():  # of whatever study
                        part.unlink()
                    replace_file(self.folder / "study.json", _json(self.record))
            yield

    def _check(self) -> None:
        again = "begin anew with --restart, or give another --output"
        begun = _read(self.folder / "study.json")
        if begun is not None:
            difference = changed(begun, self.record)
            if difference:
                raise UsageError(
                    f"{self.source} is not what {self.folder} was begun with: {difference}; undo that to go on, {again}"
                )
            return
        described = _read(self.description)
        if self.output.exists() and described is not None and not self.finished:
            difference = changed(described.get("record", {}), self.record)
            why = difference or "the file has been changed since"
            raise UsageError(f"{self.output} is not the result of {self.source} as it is now: {why}; {again}")
        if self.output.exists() and described is None:
            raise UsageError(f"{self.output} exists and is not the result of a study; {again}")

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            import fcntl
        except ImportError:  # pragma: no cover - only POSIX has it
            yield
            return
        lock = self.folder / "lock"
        with _told(self.folder):
            file = lock.open("a+")
        with file:
            with _told(self.folder):
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    # one that has been deleted with its folder meanwhile keeps nobody out
                    mine = lock.exists() and os.path.samestat(os.fstat(file.fileno()), lock.stat())
                except BlockingIOError:
                    mine = False
            if not mine:
                raise UsageError(f"another process is working on {self.folder}")
            yield

    def _parts(self) -> list[tuple[int, Path]]:
        found = [(re.fullmatch(r"part-([0-9]{8,})", path.name), path) for path in self.folder.glob("part-*")]
        return sorted((int(match[1]), path) for match, path in found if match)

    def done(self) -> set[int]:
        """Numbers of the chunks whose parts are there and undamaged; damaged ones are deleted."""
        found = set()
        for chunk, part in self._parts():
            try:
                self.read(chunk)
            except DamagedError:
                with _told(part):
                    part.unlink()
            else:
                found.add(chunk)
        return found

    def commit(self, chunk: int, data: bytes) -> None:
        """Keep the answers of a chunk.

        Raises
        ------
        UsageError
            If they cannot be written.
        """
        replace_file(self._part(chunk), MAGIC + zlib.crc32(data).to_bytes(4, "big") + data)

    def read(self, chunk: int) -> bytes:
        """Return the answers of a chunk.

        Raises
        ------
        DamagedError
            If they are not what was written.
        """
        raw = self._part(chunk).read_bytes()
        head, data = raw[: len(MAGIC)], raw[len(MAGIC) + 4 :]
        if head != MAGIC or raw[len(MAGIC) : len(MAGIC) + 4] != zlib.crc32(data).to_bytes(4, "big"):
            raise DamagedError(self._part(chunk))
        return data

    def finish(self, write: Callable[[Path], Mapping[str, Any]]) -> None:
        """Put the result in place, say what it is, and delete the parts.

        Parameters
        ----------
        write : writes the result under the name that it is given, and returns facts about it, as JSON takes them.
        """
        partial = self.folder / f".result{self.output.suffix}"
        with _told(self.output):
            try:
                facts = write(partial)
                size = partial.stat().st_size
                put_in_place(partial, self.output)
            finally:
                with suppress(OSError):
                    partial.unlink(missing_ok=True)
        described = {"schema": "stochfuse.result/1", "bytes": size, "facts": facts, "record": self.record}
        replace_file(self.description, _json(described))
        self.clean()

    def clean(self) -> None:
        """Delete the parts of a finished result, and what they belong to after them."""
        for _, part in self._parts():
            with suppress(OSError):
                part.unlink()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _part(self, chunk: int) -> Path:
        return self.folder / f"part-{chunk:08d}"


def changed(before: Any, now: Any, path: str = "") -> str:
    """Return the first difference between two records in words; empty if there is none but the study file's name."""
    if path == "name":
        return ""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in [*now, *(k for k in before if k not in now)]:
            found = changed(before.get(key), now.get(key), f"{path}.{key}" if path else key)
            if found:
                return found
        return ""
    if json.dumps(before) == json.dumps(now):
        return ""
    return f"{path.removeprefix('study.')} was {_short(before)} and is {_short(now)}"


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


def replace_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, and bring it to the disk.

    Raises
    ------
    UsageError
        If it cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    with _told(path):
        try:
            with partial.open("wb") as file:
                file.write(data)
            put_in_place(partial, path)
        except BaseException:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise


def put_in_place(partial: Path, path: Path) -> None:
    """Bring a written file to the disk and give it its name."""
    _sync(partial)
    os.replace(partial, path)
    with suppress(OSError):  # not every file system lets a directory be opened
        _sync(path.parent)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UsageError(
            f"cannot write {path}: {error.strerror or error}; finished points are kept: the same command goes on"
        ) from None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UsageError(f"{path} cannot be read ({error}); begin anew with --restart") from None
    return found if isinstance(found, dict) else {}


def _json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=1, ensure_ascii=False) + "\n").encode()
