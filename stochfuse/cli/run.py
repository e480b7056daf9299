"""`stochfuse run`: the estimators on data, beside what was predicted."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.options import (
    NETWORK,
    OUTPUT,
    RARE,
    SCENARIO,
    WORK,
    Changes,
    DigitsOption,
    FormatOption,
    MetricOption,
    PlotOption,
    Reported,
    ScenarioArgument,
    check_files,
    chosen_format,
    completed,
    estimator_names,
    option,
    pairs,
    tell,
    write_report,
)
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import CRITERIA, ESTIMATORS, LFG

if TYPE_CHECKING:
    from stochfuse.data.run import RunResult

EXAMPLES = (
    "stochfuse run my.toml --measurements z.csv --arrivals heard.csv --truth x.csv",
    "stochfuse run my.toml --measurements z.csv --link 0.5 --estimator optimal",
)
EstimatorsOption = Annotated[
    str | None,
    option(
        f"One or several: {', '.join(ESTIMATORS[:3])}, … (stochfuse methods); default: the scenario's, else {LFG}.",
        WORK,
        "--estimator",
        metavar="LIST",
        autocompletion=completed(ESTIMATORS),
    ),
]
CriterionOption = Annotated[
    str,
    option(
        f"intersections: what the weights minimise, {', '.join(CRITERIA)}; default: det.", WORK + RARE, metavar="NAME"
    ),
]


def run(
    scenario: ScenarioArgument = "thesis-transient",
    measurements: Annotated[
        str | None, option("CSV, Parquet or - (standard input): run, step, agent, z1, z2, …", SCENARIO, metavar="FILE")
    ] = None,
    arrivals: Annotated[
        str | None,
        option(
            "What arrived: run, step, receiver, sender, sent_step, or a packet log; default: drawn from the links.",
            SCENARIO, metavar="FILE",
        ),
    ] = None,
    truth: Annotated[
        str | None, option("True states: run, step, agent, states by name.", SCENARIO, metavar="FILE")
    ] = None,
    initial: Annotated[
        str | None,
        option(
            "First estimates: run, agent, states; default: initial.csv beside the measurements, else initial.x.",
            SCENARIO + RARE, metavar="FILE",
        ),
    ] = None,
    columns: Annotated[
        str | None, option("The files' names of columns: z1=range,step=k.", SCENARIO + RARE, metavar="OURS=THEIRS")
    ] = None,
    changes: Changes = Changes(),
    seed: Annotated[int, option("Of arrivals that are drawn; default: 1.", NETWORK, min=0, metavar="N")] = 1,
    estimator: EstimatorsOption = None,
    criterion: CriterionOption = "det",
    metric: MetricOption = None,
    covariance: Annotated[
        bool, option("Write covariances too, cov:STATE:STATE.", OUTPUT + RARE, "--covariance")
    ] = False,
    format: FormatOption = None,
    output: Annotated[
        Path | None, option("Write the estimates there: .csv or .parquet.", OUTPUT, "--output", "-o", metavar="FILE")
    ] = None,
    plot: PlotOption = None,
    digits: DigitsOption = 5,
    page: Reported = Reported(),
) -> None:  # fmt: skip
    """Run estimators on measurements; show realised, claimed and predicted errors, and whether claims are consistent.

    Sensors by name are measured by their true functions: the filters are extended ones.
    """
    from stochfuse.data.records import read_records
    from stochfuse.data.run import Way, run_records
    from stochfuse.data.writing import EstimatesFile
    from stochfuse.kalman.metrics import metric as metric_of

    if measurements is None:
        raise UsageError("--measurements: expected a file of measurements, got none")
    names = None if estimator is None else estimator_names(estimator)
    files = [file for file in (measurements, arrivals, truth, initial) if file is not None]
    if [*files, scenario].count("-") > 1:
        raise UsageError("expected at most one file on standard input, got - for several")
    check_estimates(output)
    check_files(output, plot, scenario, *files)
    page.check(output, plot, scenario, *files)
    given, links = changes.of(scenario)
    first = initial or beside(measurements)
    records = read_records(given, measurements, arrivals, truth, first, pairs("--columns", columns))
    chosen = metric_of(metric or given.metric or "trace", given.model)
    way = Way(names or (given.estimator or LFG,), one_link(links), seed, criterion)
    writing: Any = nullcontext()
    if output is not None:
        writing = EstimatesFile(output, records.scenario, truth=truth is not None, covariance=covariance)
    elif covariance:
        raise UsageError("--covariance: expected --output FILE to write them to")
    with writing as file:
        found = run_records(records, chosen, way, None if file is None else file.write)
    show(found, format, plot, digits, page)


def show(found: RunResult, format: str | None, plot: Path | None, digits: int, page: Reported = Reported()) -> None:
    """Write a run's notes, report and figure."""
    from stochfuse.report.plot import save
    from stochfuse.report.runs import run_report

    report = run_report(found, digits)
    said = tell(f"note: {note}" for note in (*found.notes, *(suspicion.text for suspicion in found.suspicions)))
    if plot is not None and report.draw is not None:
        save(report.draw, plot)
    write_report(report, chosen_format(format, None), None)
    page.write(report, found.scenario.to_mapping(), said)


def one_link(links: list[float] | None) -> float | None:
    """Return the one link probability that was asked for, if any."""
    if links is not None and len(links) > 1:
        raise UsageError(f"--link: expected one link probability, got {len(links)}")
    return None if links is None else links[0]


def check_estimates(output: Path | None) -> None:
    """Raise UsageError early if estimates can never be written to a file."""
    from stochfuse.report.table import check_writable

    check_writable(output, (".csv", ".parquet"))


def beside(measurements: str) -> str | None:
    """Return the file of first estimates that lies beside simulated measurements, if there is one."""
    from stochfuse.data.writing import FIRST

    path = Path(measurements).parent / FIRST
    if measurements == "-" or not path.is_file():
        return None
    typer.echo(f"note: first estimates from {path}", err=True)
    return str(path)
