"""Where a report goes: standard output or a file, whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stochfuse.errors import UsageError

SUFFIXES = {".csv": "csv", ".json": "json", ".md": "markdown", ".tex": "latex", ".txt": "table"}
PLOT_SUFFIXES = (".png", ".svg", ".pdf")


def to_json(value: Any) -> str:
    """One object, indented; NaN and infinity are an error."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def terminal_width() -> int:
    """Columns of the terminal, COLUMNS if set, else 80; at least 40."""
    return max(40, shutil.get_terminal_size((80, 24)).columns)


def write_text(text: str, output: Path | None) -> None:
    """Write to a file, or to standard output without one."""
    if output is None:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_file(output, lambda path: path.write_text(text, encoding="utf-8"))


def write_file(output: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under another name and put it in place when it is complete.

    Raises
    ------
    UsageError
        If the file cannot be written.
    """
    target = output.resolve() if output.is_symlink() else output
    special = target.exists() and not target.is_file()
    partial = target if special else target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        write(partial)
        if not special:
            partial.replace(target)
    except OSError as error:
        raise UsageError(f"cannot write {output}: {error.strerror or error}") from None
    finally:
        if not special:
            partial.unlink(missing_ok=True)


def check_writable(output: Path | None, suffixes: tuple[str, ...] = ()) -> None:
    """Raise UsageError early, before the work, if a file of that name can never be written."""
    if output is None:
        return
    if suffixes and output.suffix.lower() not in suffixes:
        raise UsageError(f"{output}: expected a name that ends in {', '.join(suffixes)}")
    if output.is_dir():
        raise UsageError(f"cannot write {output}: it is a directory")
    if not output.parent.is_dir():
        raise UsageError(f"cannot write {output}: there is no directory {output.parent}")
