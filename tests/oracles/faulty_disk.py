"""A disk that fails: counts the operations that change files, and lets one fail, or kills whoever asks for it."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any
from unittest import mock

import pyarrow.parquet as pq


class Killed(BaseException):
    """The process is no more: nothing that it does from here on reaches the disk."""


class FaultyDisk:
    """Every operation below a folder that changes files, with a fault at one of them.

    Parameters
    ----------
    folder : where it watches.
    at : number of the operation that fails, from 1; None to count only.
    kill : whether the process ends there; else the operation fails as on a full disk.
    stays : whether the disk stays full from there on: whatever needs room fails.
    """

    GROWS = ("open", "write", "close", "fsync", "replace", "mkdir")

    def __init__(self, folder: Path, at: int | None = None, *, kill: bool = False, stays: bool = False) -> None:
        self.folder, self.at, self.kill, self.stays = folder.resolve(), at, kill, stays
        self.done: list[tuple[str, str]] = []
        self.failed: str | None = None
        self.unsynced: set[Path] = set()
        self.renamed: list[tuple[Path, Path, bytes | None]] = []
        self._handles: dict[int, Path] = {}
        self._streams: list[Any] = []
        self._patches: list[Any] = []

    @property
    def dead(self) -> bool:
        """Whether the process was killed."""
        return self.kill and self.failed is not None

    def ask(self, what: str, path: Path) -> None:
        """Count an operation, and fail if it is its turn."""
        if self.dead:
            raise Killed
        self.done.append((what, path.name))
        if len(self.done) == self.at:
            self.failed = what
            if self.kill:
                raise Killed
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        if self.stays and self.failed is not None and what in self.GROWS:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    def mine(self, path: Any, dir_fd: int | None = None) -> Path | None:
        """Return the path if it is below the folder."""
        if isinstance(path, int):
            return self._handles.get(path)
        inside = Path(os.readlink(f"/proc/self/fd/{dir_fd}")) if dir_fd is not None else Path()
        full = Path(os.path.abspath(inside / os.fspath(path)))
        return full if full.is_relative_to(self.folder) else None

    def __enter__(self) -> FaultyDisk:
        real = {name: getattr(os, name) for name in ("replace", "fsync", "unlink", "rmdir", "mkdir", "open", "close")}
        real_open, disk, writer = io.open, self, pq.ParquetWriter

        def watched(name: str) -> Callable[..., Any]:
            def call(path: Any, *rest: Any, **named: Any) -> Any:
                found = disk.mine(path, named.get("dir_fd"))
                if found is not None:
                    disk.ask(name, found)
                return real[name](path, *rest, **named)

            return call

        def replace(source: Any, target: Any, **named: Any) -> None:
            found, place = disk.mine(source), disk.mine(target)
            if found is not None and place is not None:
                disk.ask("replace", place)
                disk.renamed.append((found, place, place.read_bytes() if place.exists() else None))
                if found in disk.unsynced:
                    disk.unsynced.add(place)
                disk.unsynced.discard(found)
            real["replace"](source, target, **named)

        def opened(path: Any, *rest: Any, **named: Any) -> int:
            handle = real["open"](path, *rest, **named)
            found = disk.mine(path, named.get("dir_fd"))
            if found is not None:
                disk._handles[handle] = found
            return handle

        def closed(handle: int) -> None:
            disk._handles.pop(handle, None)
            real["close"](handle)

        def fsync(handle: int) -> None:
            found = disk.mine(handle)
            if found is not None:
                disk.ask("fsync" if found.is_file() else "fsync folder", found)
                disk.unsynced.discard(found)
                disk.renamed = [entry for entry in disk.renamed if entry[1].parent != found]
            real["fsync"](handle)

        def stream(path: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
            found = None if isinstance(path, int) else disk.mine(path)
            if found is None or not set(mode) & set("wax+"):
                return real_open(path, mode, *rest, **named)
            disk.ask("open", found)
            disk.unsynced.add(found)
            file = real_open(path, mode, *rest, **named)
            disk._streams.append(file)
            return _Stream(disk, found, file)

        class Writer(writer):  # type: ignore[misc, valid-type]
            def __init__(self, where: Any, *rest: Any, **named: Any) -> None:
                self.watched = disk.mine(where) or Path(where)
                disk.ask("open", self.watched)
                disk.unsynced.add(self.watched)
                super().__init__(where, *rest, **named)

            def write_table(self, *rest: Any, **named: Any) -> None:
                disk.ask("write", self.watched)
                super().write_table(*rest, **named)

            def close(self) -> None:
                # pyarrow closes again when it is thrown away
                if not self.is_open:
                    return
                super().close()
                disk.ask("close", self.watched)

        replacements = {name: watched(name) for name in ("unlink", "rmdir", "mkdir")}
        replacements |= {"replace": replace, "fsync": fsync, "open": opened, "close": closed}
        self._patches = [mock.patch.object(os, name, by) for name, by in replacements.items()]
        self._patches += [mock.patch.object(io, "open", stream), mock.patch.object(pq, "ParquetWriter", Writer)]
        for patch in self._patches:
            patch.start()
        return self

    def __exit__(self, *reason: Any) -> None:
        for patch in reversed(self._patches):
            patch.stop()
        # what the system does for a process that is no more
        for file in self._streams if self.dead else ():
            file.close()

    def lose(self, share: float, *, power: bool) -> None:
        """After a kill: what was never brought to the disk may be there in part, or not under its name.

        Parameters
        ----------
        share : how much of it is there.
        power : whether the machine went down as well, so that renamings are lost that the folder's fsync did not keep.
        """
        for path in self.unsynced:
            if path.is_file():
                os.truncate(path, int(share * path.stat().st_size))
        for source, target, before in reversed(self.renamed) if power else ():
            if target.exists() and source.parent.exists():
                os.replace(target, source)
                if before is not None:
                    target.write_bytes(before)


class _Stream:
    """A file that is being written."""

    def __init__(self, disk: FaultyDisk, path: Path, file: Any) -> None:
        self._disk, self._path, self._file = disk, path, file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: Any) -> int:
        try:
            self._disk.ask("write", self._path)
        except OSError:
            self._file.write(data[: len(data) // 2])
            raise
        return self._file.write(data)

    def close(self) -> None:
        if not self._file.closed:
            self._file.close()
            if self._path.name != "lock":
                self._disk.ask("close", self._path)

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Any, trace: TracebackType | None) -> None:
        self.close()
