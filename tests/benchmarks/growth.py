"""How cost grows: seconds, slopes and figures; and, as a command, every method against everything that can grow.

`python -m tests.benchmarks.growth [--quick] [--markdown] [--longest SECONDS] [--largest] [--workers] [--only WORD]`.  Times are CPU seconds of one
thread, memory is the peak of what Python and NumPy hold.  Exponents are slopes of the upper half in doubly logarithmic axes,
beside what theory says; a series ends where the next point would take longer than `--longest`.  `--largest` doubles a scenario until it
takes more than 60 s or 4 GB, each in a process of its own; `--workers` asks what a second worker is worth.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Growth = dict[str, tuple[list[int], list[float]]]
"""Sizes and seconds by what grows."""


def seconds(function, rounds: int) -> float:
    """Least time of some rounds, after one that is not counted."""
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def slopes(found: Growth) -> list[tuple[str, ...]]:
    """Name, first and last time, and the slope of the upper half in a doubly logarithmic plot."""
    rows = []
    for name, (sizes, times) in found.items():
        upper = slice(len(sizes) // 2, None) if len(sizes) > 2 else slice(None)
        slope = np.polyfit(np.log(sizes[upper]), np.log(times[upper]), 1)[0]
        rows.append(
            (name, f"{sizes[0]}: {times[0] * 1e3:.3g} ms", f"{sizes[-1]}: {times[-1] * 1e3:.3g} ms", f"{slope:.1f}")
        )
    return rows


def draw(panels: dict[str, Growth], output: Path, sizes: str, cost: str) -> None:
    """Draw one panel per title, doubly logarithmic, each curve with the slope of its upper half."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5 * len(panels), 4.8), layout="constrained")
    for axes, (title, found) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for (name, (x, y)), slope, style in zip(
            found.items(), slopes(found), ("o-", "s-", "^-", "o--", "s--"), strict=False
        ):
            axes.loglog(x, y, style, label=f"{name}: slope {slope[-1]}")
        axes.set(xlabel=sizes, ylabel=cost, title=title)
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    figure.savefig(output, dpi=150)


LONGEST = 4.0
"""Seconds that a point of a series may take, if it is not said otherwise."""
SECONDS, BYTES = 60.0, 4e9
"""What the largest scenario may take."""


class Asked(NamedTuple):
    """A prediction that grows.

    Parameters
    ----------
    method, estimator : None where the method says it.
    agents, steps, states, rows, runs, items : its size; `items` are scenarios with noises of their own (`predict_many`).
    """

    method: str
    estimator: str | None = None
    agents: int = 3
    steps: int = 5
    states: int = 1
    rows: int = 1
    runs: int = 0
    items: int = 0

    def work(self) -> Callable[[], object]:
        """Prepare it."""
        import stochfuse as sf
        from tests.benchmarks.studies import batch

        scenario, link, noises = batch(max(self.items, 1), self.agents, self.steps, self.states)
        more: dict[str, Any] = {"estimator": self.estimator} if self.estimator else {}
        more |= {"runs": self.runs, "workers": 1} if self.runs else {}
        if self.items:
            Q, R, P = noises
            return lambda: sf.predict_many(scenario, link, Q, R, P, self.method, **more)
        rows = np.linspace(0.2, 0.8, self.rows) if self.rows > 1 else [0.3]
        return lambda: sf.predict(scenario, rows, self.method, **more).values()


class Series(NamedTuple):
    """What is asked, what of it grows and how far, and what theory says of time and memory."""

    asked: Asked
    key: str
    sizes: tuple[int, ...]
    theory: str


def decades(first: int, last: int, each: int = 2) -> tuple[int, ...]:
    """Sizes from first to last, some to a decade."""
    number = round(np.log10(last / first) * each) + 1
    return tuple(dict.fromkeys(np.geomspace(first, last, number).round().astype(int).tolist()))


SIMPLIFIED = Asked("simplified", rows=100)
OPTIMUM, GRAPHS = Asked("optimal"), Asked("general")
SAMPLED = Asked("monte-carlo", "local-fusion-graph", runs=1000)
ARRIVED = Asked("monte-carlo", "optimal", runs=1000)
COUNTED = Asked("monte-carlo", "naive", runs=1000)
ALL = (
    Series(SIMPLIFIED, "agents", decades(100, 100_000), "0: an integral in the place of the sum above 100 senders"),
    Series(SIMPLIFIED, "steps", decades(10, 10_000), "1"),
    Series(
        SIMPLIFIED._replace(rows=10), "states", (2, 4, 8, 16, 32, 64), "3 to 4: d³, and d⁴ in one product for all rows"
    ),
    Series(SIMPLIFIED, "rows", decades(1000, 1_000_000), "1"),
    Series(SIMPLIFIED._replace(rows=1), "items", decades(1000, 1_000_000), "1"),
    Series(
        OPTIMUM, "agents", (2, 4, 8, 16, 32, 64, 128, 256), "1 to 3: states of the chain, or paths that bounds need"
    ),
    Series(OPTIMUM, "steps", decades(5, 5000), "2: every step looks back; 1 once the tail is bounded"),
    Series(OPTIMUM, "rows", decades(100, 100_000), "1"),
    Series(GRAPHS._replace(steps=2), "agents", (2, 3, 4), "exponential: 2^(n(n−1)k) outcomes, merged"),
    Series(GRAPHS, "steps", (2, 3, 4, 5), "exponential: different graphs grow with every step"),
    Series(GRAPHS._replace(steps=3), "rows", decades(10, 10_000), "1, and 0 while graphs cost more than rows"),
    Series(GRAPHS._replace(estimator="naive", steps=3, rows=1), "items", decades(10, 10_000), "1"),
    Series(SAMPLED, "runs", decades(100, 100_000), "1, and 0 while different graphs are met for the first time"),
    Series(
        SAMPLED._replace(runs=20), "agents", (3, 5, 8, 12, 20), "exponential in the number heard: 2^m intersections"
    ),
    Series(SAMPLED._replace(runs=100), "steps", decades(5, 500), "1 to 2"),
    Series(ARRIVED, "runs", decades(100, 100_000), "1"),
    Series(
        ARRIVED._replace(runs=100),
        "agents",
        (5, 10, 20, 50, 100, 200, 500),
        "3: n×n Boolean products; 2 where sets are full",
    ),
    Series(ARRIVED._replace(runs=100), "steps", decades(5, 500), "2: measurements of every step before"),
    Series(COUNTED, "runs", decades(100, 100_000), "1"),
    Series(COUNTED._replace(runs=100), "agents", (5, 10, 20, 50, 100, 200, 500), "2: links"),
    Series(COUNTED._replace(runs=100), "steps", decades(5, 5000), "1"),
)
LARGEST = (
    (SIMPLIFIED._replace(rows=1001, steps=100), "states"),
    (SIMPLIFIED, "rows"),
    (SIMPLIFIED._replace(rows=1, items=1000), "items"),
    (OPTIMUM._replace(steps=50), "agents"),
    (OPTIMUM._replace(agents=10), "steps"),
    (GRAPHS, "steps"),
    (SAMPLED._replace(runs=100, steps=10), "agents"),
    (ARRIVED._replace(runs=100, steps=20), "agents"),
    (COUNTED._replace(runs=100, steps=20), "agents"),
)


def named(asked: Asked, but: str) -> str:
    """What is asked, in words, without what grows."""
    default = Asked(asked.method)._asdict()
    size = [f"{value:,} {key}" for key, value in asked._asdict().items() if key != but and key not in ("method", "estimator")
            and (value != default[key] or key in ("agents", "steps"))]  # fmt: skip
    return f"{asked.estimator or asked.method}{', sampled' if asked.runs else ''}: {', '.join(size)}"


def cost(asked: Asked, longest: float) -> tuple[float, float]:
    """CPU seconds, the least of some runs after a first one, and peak bytes; nothing is kept from one to the next."""
    from stochfuse.prediction import general

    asked_for = asked.work()

    def work() -> None:
        general._kept.cache_clear()
        asked_for()

    start = time.process_time()
    work()
    took = [time.process_time() - start]
    while took[0] < longest and (len(took) < 2 or (sum(took) < longest / 8 and len(took) < 5)):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return min(took), peak


def grown(series: Series, longest: float, quick: bool) -> tuple[str, ...]:
    """A row: what was asked, what grew from where to where, time, exponents, theory."""
    sizes, times, peaks = [], [], []
    for size in series.sizes[:2] if quick else series.sizes:
        seconds_of, peak = cost(series.asked._replace(**{series.key: size}), longest)
        sizes.append(size)
        times.append(seconds_of)
        peaks.append(peak)
        # the next point takes as much more as this one took
        if seconds_of * (seconds_of / times[-2] if len(times) > 1 else 1.0) > longest:
            break
    half = slice((len(sizes) - 1) // 2, None) if len(sizes) > 2 else slice(None)
    slope = [
        np.polyfit(np.log(sizes[half]), np.log(of[half]), 1)[0] if len(sizes) > 1 else np.nan for of in (times, peaks)
    ]
    return (
        named(series.asked, series.key),
        f"{series.key} {sizes[0]:,} to {sizes[-1]:,}",
        f"{times[0]:.2g} to {times[-1]:.2g} s",
        f"{slope[0]:.1f}",
        f"{slope[1]:.1f}",
        series.theory,
    )


def apart(asked: Asked) -> tuple[float, float, str]:
    """CPU seconds and peak bytes of a process of its own, and what it said if it had no answer."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.growth", "--one", json.dumps(asked)],
        capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode:
        return np.inf, np.inf, (done.stderr.strip().splitlines() or ["killed"])[-1]
    took, peak = map(float, done.stdout.split())
    return took, peak, ""


def one(given: str) -> None:
    """Do what a process of its own is for, with an end to time and memory."""
    import resource

    resource.setrlimit(resource.RLIMIT_CPU, (int(2 * SECONDS), int(2 * SECONDS)))
    resource.setrlimit(resource.RLIMIT_AS, (int(2 * BYTES), int(2 * BYTES)))
    work = Asked(*json.loads(given)).work()
    start = time.process_time()
    work()
    print(time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def largest(quick: bool, only: str) -> Iterator[tuple[str, ...]]:
    """A row for each method: its largest size within the limits, by factors of two from small, and what ended it."""
    for asked, key in LARGEST:
        if only not in named(asked, key):
            continue
        size, last, why = getattr(asked, key), ("", "", ""), "quick"
        while True:
            took, peak, said = apart(asked._replace(**{key: size}))
            if took > SECONDS or peak > BYTES:
                why = said or (
                    f"{size:,} take {took:.0f} s" if took > SECONDS else f"{size:,} take {peak / 1e9:.1f} GB"
                )
                break
            last = (f"{key} {size:,}", f"{took:.2g} s", f"{peak / 1e6:.0f} MB")
            if quick:
                break
            size = size + 1 if asked.method == "general" else 2 * size
        yield named(asked, key), *last, why


def second_worker(quick: bool) -> list[tuple[str, ...]]:
    """Sampling and a study with one worker and with two: by the clock, and by the CPU time of the longest way through."""
    from tests.benchmarks.studies import NOISES, latin

    runs, points = (200, 200) if quick else (100_000, 40_000)
    study = latin(points, scenario="cv-2d", predict={"method": "general"})
    study["vary"] = {**NOISES, "network.steps": [3]}
    code = (
        "import json, resource, sys, tempfile, time, stochfuse as sf\n"
        "if __name__ == '__main__':\n"
        "    what, given, workers = sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3])\n"
        "    start, own = time.perf_counter(), time.process_time()\n"
        "    if what == 'sampling':\n"
        "        sf.predict(sf.load_scenario(agents=6, steps=8), [0.5], 'monte-carlo', runs=given, workers=workers).values()\n"
        "    else:\n"
        "        sf.study(given, tempfile.mkdtemp() + '/r.parquet', workers=workers)\n"
        "    took, own = time.perf_counter() - start, time.process_time() - own\n"
        "    children = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "    print(took, own, children.ru_utime + children.ru_stime)\n"
    )
    rows = []
    script = Path(os.environ.get("TMPDIR", "/tmp")) / f"stochfuse-second-worker-{os.getpid()}.py"
    script.write_text(code)
    for what, given in (("sampling", runs), ("study", study)):
        found = []
        for workers in (1, 2):
            arguments = [sys.executable, str(script), what, json.dumps(given), str(workers)]
            done = subprocess.run(arguments, capture_output=True, text=True, check=True)
            took, own, children = map(float, done.stdout.split())
            found.append((took, own + children / workers))
        (one_took, one_cpu), (two_took, two_cpu) = found
        rows.append(
            (what, f"{one_took:.3g} s", f"{two_took:.3g} s", f"{one_took / two_took:.2f}", f"{one_cpu / two_cpu:.2f}")
        )
    script.unlink()
    return rows


def as_markdown(rows: list[tuple[str, ...]]) -> str:
    """Return rows of a table for the handbook."""
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.growth", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two sizes each: only that it runs")
    parser.add_argument("--markdown", action="store_true", help="print tables for the handbook")
    parser.add_argument("--longest", type=float, default=LONGEST, metavar="SECONDS", help="of a point of a series")
    parser.add_argument("--largest", action="store_true", help="the largest scenario of each method in 60 s and 4 GB")
    parser.add_argument("--workers", action="store_true", help="what a second worker is worth; wants a quiet machine")
    parser.add_argument("--only", default="", metavar="WORD", help="only work with this word in its name")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        return one(given.one)
    if given.largest:
        title, headings = "Largest within 60 s and 4 GB", ("work", "largest", "CPU time", "memory", "what ends it")
        rows = list(largest(given.quick, given.only))
    elif given.workers:
        title, headings = "Two workers against one", ("work", "one", "two", "times faster", "by CPU time")
        rows = second_worker(given.quick)
    else:
        title = "How cost grows, one thread"
        headings = ("work", "what grows", "CPU time", "exponent of time", "of memory", "theory, time")
        rows = []
        for series in ALL:
            if given.only in named(series.asked, series.key):
                rows.append(grown(series, given.longest, given.quick))
                print(as_markdown(rows[-1:]), file=sys.stderr, flush=True)  # who ends it early has what there is
    if given.markdown:
        print(as_markdown([headings, ("---",) * len(headings), *rows]))
    else:
        from tests.benchmarks.__main__ import show

        show(title, headings, rows)


if __name__ == "__main__":
    if os.environ.get("OMP_NUM_THREADS") != "1":  # libraries read it when they are loaded: begin again
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        os.execve(
            sys.executable, [sys.executable, "-m", "tests.benchmarks.growth", *sys.argv[1:]], {**os.environ, **threads}
        )
    main()
