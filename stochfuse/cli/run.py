"""`stochfuse run`: the estimators on data, beside what was predicted."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stochfuse.cli.options import (
    NETWORK,
    OUTPUT,
    RARE,
    SCENARIO,
    WORK,
    Beside,
    Changes,
    MetricOption,
    ScenarioArgument,
    completed,
    option,
)
from stochfuse.cli.values import named, parse_link, refuse, renamed, tell
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import CRITERIA, ESTIMATORS, LFG

if TYPE_CHECKING:
    from stochfuse.data.run import RunResult, Way
    from stochfuse.scenario.scenario import Scenario

EXAMPLES = (
    "stochfuse run my.toml --measurements z.csv --arrivals heard.csv --truth x.csv",
    "stochfuse run my.toml --measurements z.csv --link 0.5 --estimator optimal",
    "stochfuse run utias --data mrclam --link 0:1:0.25 --estimator split-ci,itns",
)


@dataclass(frozen=True)
class Estimating:
    """Which estimators are run, on which arrivals, and how their errors are measured."""

    case: Annotated[
        str | None, option("Arrivals are drawn from the links of this case.", NETWORK + RARE, metavar="NAME")
    ] = None
    estimator: Annotated[
        str | None,
        option(
            f"One or several: {', '.join(ESTIMATORS[:3])}, … (stochfuse methods), or your own, module:Class; default: "
            f"the scenario's, else {LFG}.", WORK, "--estimator", metavar="LIST", autocompletion=completed(ESTIMATORS),
        ),
    ] = None  # fmt: skip
    criterion: Annotated[
        str,
        option(
            f"intersections: what the weights minimise, {', '.join(CRITERIA)}; default: det.", WORK + RARE,
            metavar="NAME",
        ),
    ] = "det"  # fmt: skip
    metric: MetricOption = None

    @property
    def names(self) -> tuple[str, ...] | None:
        """Names of the estimators, if any are asked for."""
        return None if self.estimator is None else named(self.estimator)

    def way(self, given: Scenario, links: list[float] | None, seed: int) -> Way:
        """Return how records of a scenario are run; links are what --link asks for.

        Raises
        ------
        UsageError
            If there are several links, or a case beside them.
        """
        from stochfuse.data.run import Way

        if self.case is not None and links is not None:
            raise UsageError("--case: expected no --link beside it, got both")
        if links is not None and len(links) > 1:
            raise UsageError(f"--link: expected one link probability, got {len(links)}")
        link = self.case if links is None else links[0]
        return Way(self.names or (given.estimator or LFG,), link, seed, self.criterion)


ROBOTS = "utias"
"""What stands for a scenario where robots' records are run."""


@dataclass(frozen=True)
class RobotOptions:
    """A record of robots that see landmarks and one another."""

    data: Annotated[
        Path | None,
        option(
            f"{ROBOTS}: folder with odometry, sightings, truth and landmarks (.csv).", SCENARIO, "--data",
            metavar="FOLDER",
        ),
    ] = None  # fmt: skip
    landmarks: Annotated[
        int | None, option(f"{ROBOTS}: landmarks that filters may use; default: all.", SCENARIO, min=1, metavar="N")
    ] = None
    until: Annotated[
        float, option(f"{ROBOTS}: seconds to identify noises on; default: 60.", SCENARIO + RARE, metavar="SECONDS")
    ] = 60.0
    runs: Annotated[
        int, option(f"{ROBOTS}: draws of arrivals per link; default: 4.", NETWORK + RARE, min=1, metavar="N")
    ] = 4
    white: Annotated[bool, option(f"{ROBOTS}: take what was identified for white noise.", WORK + RARE, "--white")] = (
        False
    )


@dataclass(frozen=True)
class EstimatesOptions(Beside):
    """A report on standard output, and the estimates in a file."""

    output: Annotated[
        Path | None, option("Write the estimates there: .csv or .parquet.", OUTPUT, "--output", "-o", metavar="FILE")
    ] = None
    covariance: Annotated[bool, option("Write covariances too, cov:STATE:STATE.", OUTPUT + RARE, "--covariance")] = (
        False
    )

    def check(self, *inputs: str | None) -> None:
        """See `Listed.check`."""
        from stochfuse.report.table import check_writable

        check_writable(self.output, (".csv", ".parquet"))
        super().check(*inputs)


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
    estimates: Annotated[
        str | None,
        option(
            "Of filters of your own, to be judged: run, step, agent, states by name, var:STATE, cov:STATE:STATE.",
            SCENARIO, metavar="FILE",
        ),
    ] = None,
    initial: Annotated[
        str | None,
        option(
            "First estimates: run, agent, states; default: initial.csv beside the measurements, else initial.x.",
            SCENARIO + RARE, metavar="FILE",
        ),
    ] = None,
    columns: Annotated[
        str | None,
        option("The files' names of columns: z1=range,x=east|x_hat.", SCENARIO + RARE, metavar="OURS=THEIRS"),
    ] = None,
    changes: Changes = Changes(),
    robots: RobotOptions = RobotOptions(),
    seed: Annotated[int, option("Of arrivals that are drawn; default: 1.", NETWORK, min=0, metavar="N")] = 1,
    estimating: Estimating = Estimating(),
    to: EstimatesOptions = EstimatesOptions(),
) -> None:  # fmt: skip
    """Run estimators on measurements; show realised, claimed and predicted errors, and whether claims are consistent.

    Sensors by name are measured by their true functions: the filters are extended ones.
    """
    from stochfuse.data.records import read_records
    from stochfuse.data.run import run_records
    from stochfuse.data.writing import EstimatesFile
    from stochfuse.kalman.metrics import metric as metric_of

    names, metric = estimating.names, estimating.metric
    if scenario == ROBOTS:
        others = {
            "measurements": measurements, "arrivals": arrivals, "truth": truth, "estimates": estimates,
            "initial": initial, "columns": columns, "output": to.output,
            "criterion": None if estimating.criterion == "det" else estimating.criterion,
            "case": estimating.case, "covariance": to.covariance, **vars(replace(changes, link=None)),
        }  # fmt: skip
        check_robots(robots, others, metric)
        to.check()
        show_robots(robots, changes.link, names, seed, to)
        return
    if robots != RobotOptions():
        raise UsageError(f"--data, --landmarks, --until, --runs, --white: expected with {ROBOTS} alone, got {scenario}")
    if measurements is None:
        raise UsageError("--measurements: expected a file of measurements, got none")
    files = [file for file in (measurements, arrivals, truth, estimates, initial) if file is not None]
    if [*files, scenario].count("-") > 1:
        raise UsageError("expected at most one file on standard input, got - for several")
    to.check(scenario, *files)
    given, links = changes.of(scenario)
    first = initial or beside(measurements)
    theirs = {ours: names.split("|") for ours, names in renamed(columns, "OURS=THEIRS").items()}
    records = read_records(given, measurements, arrivals, truth, first, theirs, estimates)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    way = estimating.way(given, links, seed)
    writing: Any = nullcontext()
    if to.output is not None:
        writing = EstimatesFile(to.output, records.scenario, truth=truth is not None, covariance=to.covariance)
    elif to.covariance:
        raise UsageError("--covariance: expected --output FILE to write them to")
    with writing as file:
        found = run_records(records, chosen, way, None if file is None else file.write)
    show(found, to)


def check_robots(robots: RobotOptions, others: Mapping[str, object], metric: str | None) -> None:
    """Raise UsageError if an option does not go with a record of robots, or its folder is not given."""
    if robots.data is None:
        raise UsageError(f"--data: expected a folder with a record of robots, as {ROBOTS} needs one, got none")
    flags = {f"--{name}": value for name, value in others.items()}
    refuse(flags, f"a scenario, got {ROBOTS}, whose record is all in --data")
    if metric not in (None, "rms:x,y"):
        raise UsageError(f"--metric: expected rms:x,y with {ROBOTS}, got {metric}")


def show_robots(robots: RobotOptions, link: str | None, names: tuple[str, ...] | None, seed: int, to: Beside) -> None:
    """Run estimators on a record of robots, and write the report."""
    from stochfuse.data.robot_filters import ESTIMATORS as TAKEN
    from stochfuse.data.robot_run import run_robots
    from stochfuse.report.robots import robot_report

    links = parse_link("0:1:0.25" if link is None else link)
    found = run_robots(
        str(robots.data), links, names or TAKEN, runs=robots.runs, seed=seed, landmarks=robots.landmarks,
        until=robots.until, noises="white" if robots.white else "identified",
    )  # fmt: skip
    report = robot_report(found, min(to.digits, 3))
    to.write(report)
    to.send(report, {})


def show(found: RunResult, to: Beside) -> None:
    """Write a run's notes, report and figure."""
    from stochfuse.report.runs import run_report

    report = run_report(found, to.digits)
    said = tell(f"note: {note}" for note in (*found.notes, *(suspicion.text for suspicion in found.suspicions)))
    to.write(report)
    to.send(report, found.scenario.to_mapping(), said)


def beside(measurements: str) -> str | None:
    """Return the file of first estimates that lies beside simulated measurements, if there is one."""
    from stochfuse.data.writing import FIRST

    path = Path(measurements).parent / FIRST
    if measurements == "-" or not path.is_file():
        return None
    typer.echo(f"note: first estimates from {path}", err=True)
    return str(path)
