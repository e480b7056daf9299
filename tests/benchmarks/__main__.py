"""Print every ratio that the project promises, measured in this run, beside its bound."""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import stochfuse as sf
from tests.agreement.test_accuracy import CASES
from tests.benchmarks import chain, growth, intersection, kernel, literal, sampling, studies
from tests.oracles import textbook
from tests.oracles.strategies import mapping

HERE = Path(__file__).parent
LINK = np.linspace(0, 1, 1001)
LINKS = {"'gps-ins'": [round(0.1 * i, 1) for i in range(11)]}
"""Link probabilities of the cases that are not measured at 0.5."""


def medians(
    *functions: Callable[[], object], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Median seconds of each function, measured in turns, so that drift of the machine hits all alike."""
    times: list[list[float]] = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(rounds):
        for function, record in zip(functions, times, strict=True):
            start = clock()
            function()
            record.append(clock() - start)
    return [statistics.median(record) for record in times]


def against_literal(name: str, case: str, agents: int, steps: int, bound: str, rounds: int) -> tuple[str, ...]:
    given = CASES[case]
    scenario = sf.Scenario.from_mapping(mapping(*given, agents=agents, steps=steps))
    got, plain = sf.predict(scenario, LINK).covariance, literal.simplified(*given, agents, LINK, steps)
    difference = textbook.scaled_error(got, plain)
    mine, baseline = medians(
        lambda: sf.predict(scenario, LINK), lambda: literal.simplified(*given, agents, LINK, steps), rounds=rounds
    )
    return (
        name,
        f"{baseline * 1e3:.4g} ms",
        f"{mine * 1e3:.4g} ms",
        f"{baseline / mine:.1f}",
        bound,
        f"{difference:.0e}",
    )


def many_agents(preset: str, rounds: int) -> tuple[str, ...]:
    few, many = (sf.load_scenario(preset, agents=n, steps=5) for n in (1_000, 100_000))
    cost_few, cost_many = medians(lambda: sf.predict(few, LINK), lambda: sf.predict(many, LINK), rounds=rounds)
    name = f"{preset}: n = 100,000 against n = 1,000"
    return name, f"{cost_few * 1e3:.4g} ms", f"{cost_many * 1e3:.4g} ms", f"{cost_many / cost_few:.2f}", "≤ 3", ""


def start_up(rounds: int) -> list[tuple[str, ...]]:
    def run(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)

    commands = [
        ("--help against a bare Typer app's --help", [str(HERE / "bare_help.py"), "--help"], ["--help"]),
        ("predict against a bare Typer app with numpy and a rich table", [str(HERE / "bare_predict.py")], ["predict"]),
    ]
    rows = []
    for name, bare, arguments in commands:
        baseline, mine = medians(run(*bare), run("-m", "stochfuse", *arguments), rounds=rounds)
        rows.append((name, f"{baseline * 1e3:.4g} ms", f"{mine * 1e3:.4g} ms", f"{mine / baseline:.2f}", "≤ 1.4", ""))
    return rows


def accuracy() -> list[tuple[str, str]]:
    rows = []
    for name, given in CASES.items():
        scenario = sf.Scenario.from_mapping(mapping(*given, agents=10, steps=3))
        prediction = sf.predict(scenario, [0.1, 0.5, 1.0])
        exact = [textbook.simplified_mpmath(*given, 10, mu, 3) for mu in (0.1, 0.5, 1.0)]
        worst = max(textbook.scaled_error(P, E) for P, E in zip(prediction.covariance, exact, strict=True))
        rows.append((name, ", ".join(prediction.forms), f"{worst:.0e}"))
    return rows


def enumeration(steps: int) -> tuple[str, ...]:
    scenario = sf.load_scenario(steps=steps)
    start = time.perf_counter()
    plain = literal.general(25.0, 100.0, 100.0, 3, 0.5, steps)
    baseline = time.perf_counter() - start
    (mine,) = medians(lambda: sf.predict(scenario, [0.5], "general"), rounds=5)
    difference = np.abs(sf.predict(scenario, [0.5], "general").values()[0] / plain - 1).max()
    name = f"three agents ad hoc, {steps} steps: merged against plain enumeration"
    return name, f"{baseline:.4g} s", f"{mine:.4g} s", f"{baseline / mine:.0f}", "≥ 20", f"{difference:.0e}"


def absolute(quick: bool) -> list[tuple[str, ...]]:
    """Seconds of the cases that have a bound in seconds, each in a process of its own, and the memory it took."""
    work = [
        ("ad hoc, 4 steps", "steps=4", "'general'", "1 s"),
        ("ad hoc, 5 steps (2^30 outcomes)", "steps=5", "'general'", "20 s, 2 GB"),
        ("broadcast, 7 steps", "steps=7, architecture='broadcast'", "'general'", "20 s"),
        ("cyclic, 7 steps", "steps=7, architecture='cyclic'", "'general'", "20 s"),
        ("Monte Carlo, ad hoc, 5 steps, 50,000 runs", "", "'monte-carlo', runs=50_000, workers=2", "4 s"),
        ("GPS/INS, 100 s, 11 µ, 100 runs, claimed and actual", "'gps-ins'", "quantity='actual'", "10 s"),
    ]
    rows = []
    for name, scenario, method, bound in work[:1] if quick else work:
        code = (
            "import resource, time, stochfuse as sf; start = time.perf_counter(); "
            f"sf.predict(sf.load_scenario({scenario}), {LINKS.get(scenario, [0.5])}, {method}).values(); "
            "print(time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        seconds, megabytes = map(float, done.stdout.split())
        rows.append((name, f"{seconds:.3g} s", f"{megabytes:.0f} MB", bound))
    return rows


def show(title: str, headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    table = Table(*headings, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    Console(width=130).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one round each: only that they run")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw cost against agents, steps, states and points (two files)"
    )
    given = parser.parse_args()
    quick = given.quick
    rounds = 1 if quick else 7
    rows = [
        against_literal("1001 µ × 100 steps × 50 agents, 4 states", "benign", 50, 4 if quick else 100, "≥ 60", rounds),
        against_literal("1001 µ × 5 steps × 3 agents, 4 states", "benign", 3, 5, "≥ 15", 3 * rounds),
        against_literal(
            "1001 µ × 100 steps × 50 agents, scalar", "scalar benign", 50, 4 if quick else 100, "≥ 20", rounds
        ),
        against_literal("1001 µ × 5 steps × 3 agents, scalar", "scalar benign", 3, 5, "≥ 20", 3 * rounds),
    ]
    show(
        "Against the vectorised literal form (54), in one run",
        ("work", "literal", "stochfuse", "times faster", "bound", "largest scaled difference"),
        rows,
    )
    rows = [many_agents("thesis-transient", rounds), many_agents("cv-2d", rounds)]
    show("Cost against the number of agents, 1001 µ × 5 steps", ("work", "few", "many", "ratio", "bound", ""), rows)
    if quick:  # at full length it wants one thread: python -m tests.benchmarks.kernel
        title, rows = kernel.at_the_limit(own=False, quick=True)
        show(title, ("way", "time", "over stochfuse's"), rows)
        print("".join(f"{name} is not installed and was left out\n" for name in kernel.absent()))
    show(
        "Covariance intersection of 4×4 pairs, in one run; error in ω against the root of the derivative",
        intersection.HEADINGS,
        intersection.report(quick),
    )
    show(
        "Enumeration against plain enumeration, in one run",
        ("work", "plain", "stochfuse", "times faster", "bound", "largest relative difference"),
        [enumeration(2 if quick else 3)],
    )
    show("Three agents: seconds here", ("work", "time", "memory", "bound"), absolute(quick))
    show(
        "Contact chain and message load: seconds here",
        ("work", "time", "bound of the value", "promised"),
        chain.promised(quick),
    )
    grown = chain.growth(quick)
    show(
        "Contact chain, one µ: cost against n and k",
        ("", "first", "last", "slope of the upper half"),
        growth.slopes(grown),
    )
    if given.plot:
        chain.plot(grown, given.plot)
    show("Sampling, CPU time, in one run", sampling.HEADINGS, sampling.ratios(quick))
    show("Sampling of large networks", sampling.HEADINGS_OF_LARGE, sampling.large(quick))
    show("Studies, in processes of their own", studies.HEADINGS, studies.promised(quick))
    costs = studies.growth(quick)
    for title, found in costs.items():
        show(f"{title}: cost", ("", "first", "last", "slope of the upper half"), growth.slopes(found))
    if given.plot:
        studies.plot(costs, given.plot.with_stem(given.plot.stem + "-studies"))
    show(
        "Start-up, wall time", ("command", "bare app", "stochfuse", "ratio", "bound", ""), start_up(1 if quick else 21)
    )
    show(
        "Accuracy for 10 agents and 3 steps against 60 digits, entrywise in the states' own standard deviations (bound 1e-9)",
        ("case", "form chosen", "worst error"),
        accuracy(),
    )


if __name__ == "__main__":
    main()
