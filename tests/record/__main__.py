"""`python -m tests.record write|compare [--only WORD]`."""

from __future__ import annotations

import gzip
import json
import signal
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tests.record.calls import calls

FILE = Path(__file__).parent / "record.json.gz"
LONGEST = 1
"""Seconds that a call may take to be recorded."""
TOLERANCE = 1e-12
FREE = {
    "version",
    "notes",
    "title",
    "titles",
    "description",
    "expected",
    "note",
    "seconds",
    "statements",
    "schema_text",
}
"""Keys whose text may be put differently."""
MOST_NUMBERS = 400
"""Numbers of an array that are kept: every so many of a larger one."""


def plain(value: Any) -> Any:
    """The answer as JSON: large arrays thinned."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items() if k not in FREE}
    if isinstance(value, np.ndarray) or hasattr(value, "shape"):
        flat = np.asarray(value, dtype=float).ravel()
        thinned = flat[:: max(1, -(-len(flat) // MOST_NUMBERS))]
        return {"shape": list(np.shape(value)), "numbers": [None if np.isnan(x) else float(x) for x in thinned]}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def number(text: Any) -> float | None:
    try:
        return None if isinstance(text, bool) else float(text)
    except (TypeError, ValueError):
        return None


REFUSED_NOW = {
    "steady state correlated": "0.1 left the correlation of the noises out; `predict` refused it then, both do now",
}
"""Calls that 0.1 answered wrongly, and why they are refused now."""
GROWN = {"scenario list": "there are more presets", "scenario schema": "there are more keys"}
"""Calls whose answers hold more now."""
BESIDE = {"estimated_error": "derivative"}
"""Estimates of what rounding did, which are rounding themselves, and the numbers that they speak of."""


def differences(a: Any, b: Any, where: str = "", scale: float = 0.0) -> list[tuple[str, float]]:
    """Where two answers differ, and by how much relative to the largest number beside it."""
    if isinstance(a, dict) and isinstance(b, dict):
        missing = [(f"{where}.{k} is gone", np.inf) for k in a if k not in b]
        beside = {k: abs(a.get(of) or 0.0) for k, of in BESIDE.items()}
        return missing + [d for k in a if k in b for d in differences(a[k], b[k], f"{where}.{k}", beside.get(k, 0.0))]
    if isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            return [(f"{where}: {len(a)} entries, now {len(b)}", np.inf)]
        # a matrix's small entries are known as well as its large ones are
        beside = max([abs(x) for x in map(number, a) if x is not None and np.isfinite(x)], default=0.0)
        return [
            d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}[{i}]", beside)
        ]
    x, y = number(a), number(b)
    if x is None or y is None:
        return [] if a == b or (x is None and y is None and isinstance(a, str)) else [(f"{where}: {a} now {b}", np.inf)]
    gap = abs(x - y) / max(abs(x), abs(y), scale, 1e-300)
    return [(f"{where}: {x!r} now {y!r}", gap)] if gap > 0 else []


def answer(call: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return json.loads(json.dumps(plain(call()), default=str))


class TooLongError(BaseException):
    """A call takes longer than a call of the record may."""


def _too_long(*_: object) -> None:
    raise TooLongError(f"more than {LONGEST} s")


def write() -> None:
    found, left = {}, []
    signal.signal(signal.SIGALRM, _too_long)
    for name, call in calls().items():
        signal.alarm(LONGEST)
        try:
            found[name] = answer(call)
        except (Exception, TooLongError) as error:
            left.append(f"{name}: {type(error).__name__}: {str(error)[:150]}")
        finally:
            signal.alarm(0)
    data = json.dumps(found, sort_keys=True, separators=(",", ":")).encode()
    with FILE.open("wb") as file, gzip.GzipFile(fileobj=file, mode="wb", mtime=0) as packed:
        packed.write(data)
    print("\n".join(left))
    print(f"{len(found)} calls recorded, {len(left)} refused or left out; {FILE.stat().st_size} bytes")


def recorded() -> dict[str, Any]:
    return json.loads(gzip.decompress(FILE.read_bytes()))


def compare(only: str = "") -> int:
    made, differing, worst = calls(), 0, 0.0
    known = {name: answer_ for name, answer_ in recorded().items() if only in name and name not in REFUSED_NOW | GROWN}
    for name, wanted in known.items():
        try:
            found = differences(wanted, answer(made[name]), name)
        except Exception as error:
            found = [(f"{name}: {type(error).__name__}: {error}", np.inf)]
        gap = max((g for _, g in found), default=0.0)
        worst = max(worst, gap if gap <= TOLERANCE else 0.0)
        if gap > TOLERANCE:
            differing += 1
            print(max(found, key=lambda d: d[1]))
    for name, reason in (REFUSED_NOW | GROWN).items():
        print(f"not compared: {name}: {reason}")
    print(f"{len(known)} calls compared, {differing} differing by more than {TOLERANCE}; others by at most {worst:.1e}")
    return differing


if __name__ == "__main__":
    only = sys.argv[sys.argv.index("--only") + 1] if "--only" in sys.argv else ""
    if sys.argv[1:2] == ["write"]:
        write()
    else:
        sys.exit(compare(only) > 0)
