"""Build what is released, install it where nothing else is, and run the README's examples there: `python -m tests.release`.

From a wheel, outside the checkout, with the lowest versions that pyproject.toml states and with the newest, and with
every Python that the machine has.  Needs `build` and `uv`.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path

from tests.cli.test_readme import CONSOLE, README, commands, files

ROOT = Path(__file__).parents[1]
EXTRAS = ("plot", "study", "data", "flint", "compiled")
MOST_BYTES, MOST_SECONDS = 1_500_000, 0.25
COMPILES = "from stochfuse.kalman.packed import compiled_step; raise SystemExit(not compiled_step(2, 1, True))"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def called(*command: str | Path, env: Mapping[str, str] | None = None, cwd: Path | None = None) -> str:
    """Output of a command that has to succeed."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, env=env, cwd=cwd)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def built(folder: Path) -> Path:
    """Build an sdist, and from it a wheel; return the wheel."""
    called(sys.executable, "-m", "build", "--quiet", "--outdir", folder, ROOT)
    (wheel,) = folder.glob("*.whl")
    if wheel.stat().st_size > MOST_BYTES:
        raise SystemExit(f"the wheel has {wheel.stat().st_size:,} bytes; at most {MOST_BYTES:,} are wanted")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB")
    return wheel


def lowest(folder: Path) -> list[str]:
    """Requirements at the lowest versions that pyproject.toml states."""
    told = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    stated = [*told["dependencies"], *(one for extra in EXTRAS for one in told["optional-dependencies"][extra])]
    given, pins = folder / "stated.txt", folder / "lowest.txt"
    given.write_text("\n".join(stated))
    called("uv", "pip", "compile", "--quiet", "--resolution", "lowest-direct", "--output-file", pins, given)
    return ["-r", str(pins)]


def interpreter_of(version: str) -> str | None:
    """Path of a Python that works, on the path or as pyenv keeps them; None if there is none."""
    kept = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for python in (f"python{version}", *map(str, reversed(kept))):
        found = shutil.which(python)
        if found and not subprocess.run([found, "-c", "import ssl"], capture_output=True).returncode:
            return found
    return None


def installed(folder: Path, python: str, wheel: Path, pins: list[str]) -> Path:
    """Make an environment with the wheel; return its folder of programs."""
    called("uv", "venv", "--quiet", "--python", python, folder)
    env = {**os.environ, "VIRTUAL_ENV": str(folder)}
    called("uv", "pip", "install", "--quiet", f"{wheel}[{','.join(EXTRAS)}]", *pins, env=env)
    return folder / "bin"


def words(text: str) -> list[str]:
    """What a text says: older versions of rich leave other spaces between columns."""
    return re.sub("─+", "", text).split()


def tried(programs: Path, folder: Path) -> int:
    """Run every example of the README, and compile a filter; return how many examples there were."""
    env = {**os.environ, "COLUMNS": "80", "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    env.pop("PYTHONPATH", None)
    text = README.read_text(encoding="utf-8")
    files(folder)
    shown = [pair for block in CONSOLE.findall(text) for pair in commands(block)]
    for command, output in shown:
        found = called("bash", "-c", command, env=env, cwd=folder).strip("\n")
        if words(found) != words(output):
            raise SystemExit(f"$ {command}\n{found}\ninstead of\n{output}")
    codes = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    for code in codes:
        called(programs / "python", "-c", code, env=env, cwd=folder)
    called(programs / "python", "-W", "error", "-c", COMPILES, env=env, cwd=folder)
    return len(shown) + len(codes)


def seconds_of_import(programs: Path, folder: Path) -> float:
    """Least time of five imports beyond the interpreter's own start."""
    times = {"pass": 9.0, "import stochfuse": 9.0}
    for _ in range(5):
        for code in times:
            start = time.perf_counter()
            called(programs / "python", "-c", code, cwd=folder)
            times[code] = min(times[code], time.perf_counter() - start)
    return times["import stochfuse"] - times["pass"]


def main() -> None:
    """Try every environment."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        wheel = built(folder)
        ways = [("lowest", PYTHONS[0]), *(("newest", python) for python in PYTHONS)]
        for name, python in ways:
            here = folder / f"{name}-{python}"
            interpreter = interpreter_of(python)
            if interpreter is None:
                print(f"Python {python}: not on this machine")
                continue
            programs = installed(here, interpreter, wheel, lowest(folder) if name == "lowest" else [])
            elsewhere = here / "elsewhere"
            elsewhere.mkdir()
            took = seconds_of_import(programs, elsewhere)
            if took > MOST_SECONDS:
                raise SystemExit(f"import stochfuse takes {took:.2f} s; at most {MOST_SECONDS} s are wanted")
            print(
                f"Python {python}, {name} versions: {tried(programs, elsewhere)} examples, import {took * 1e3:.0f} ms"
            )


if __name__ == "__main__":
    main()
