"""`stochfuse doctor`: what is installed, what is missing and how to get it."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, requires, version

from stochfuse import __version__
from stochfuse.cli.options import Listed

EXAMPLES = ("stochfuse doctor", "stochfuse doctor --format json")
SCHEMA = "stochfuse.doctor/1"
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
HIDDEN = ("test", "dev", "bench", "notebook")
"""Extras of those who work on stochfuse itself."""


def _needs() -> list[tuple[str, str]]:
    """Packages that stochfuse can use, and the extra that brings each; "" for those that it cannot do without."""
    found = []
    for line in requires("stochfuse") or ():
        requirement, _, marker = line.partition(";")
        name = requirement.strip().split(" ")[0]
        for sign in "<>=!~[(":
            name = name.partition(sign)[0]
        extra = marker.partition("extra ==")[2].strip(" '\"")
        if extra not in HIDDEN and name != "stochfuse":
            found.append((name, extra))
    return found


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def doctor(to: Listed = Listed()) -> None:
    """Show versions, extras and threads, and what is missing with the line that installs it."""
    from stochfuse.kalman import compiled
    from stochfuse.report.table import Report, stamped

    to.check()
    rows = [("stochfuse", "", __version__, ""), ("Python", "", platform.python_version(), "")]
    for name, extra in _needs():
        have = _version(name)
        what = f"stochfuse[{extra}]" if extra else name
        rows.append((name, extra, have or "missing", "" if have else f"pip install '{what}'"))
    threads = {name: os.environ.get(name, "not set") for name in THREADS}
    cores = os.cpu_count()
    set_to = ", ".join(f"{name} {value}" for name, value in threads.items())
    machine = f"{platform.system()} {platform.machine()}, {cores} cores; threads of matrix products: {set_to}; "
    machine += f"compiled filters: {compiled.state()}"
    keys = ("package", "extra", "version", "to install")
    facts = [dict(zip(("package", "extra", "version", "install"), row, strict=True)) for row in rows]
    said = stamped(SCHEMA, cores=cores, threads=threads, compiled=compiled.state(), packages=facts)
    to.write(Report.of_rows(("What is installed", machine), keys, rows, said))
