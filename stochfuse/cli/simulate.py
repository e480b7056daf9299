"""`stochfuse simulate`: truth, measurements, arrivals and estimates, as files and beside the prediction."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stochfuse.cli.options import (
    OUTPUT,
    RARE,
    WORK,
    Changes,
    DigitsOption,
    FormatOption,
    MetricOption,
    PlotOption,
    ScenarioArgument,
    check_files,
    named,
    option,
)
from stochfuse.cli.run import CaseOption, CriterionOption, EstimatorsOption, one_link, show
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import LFG

EXAMPLES = (
    "stochfuse simulate thesis-steady --link 0.5 --steps 4 --runs 200 -o folder",
    "stochfuse simulate two-radars --link 0.5 --steps 20 --estimator stand-alone",
)


def simulate(
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    runs: Annotated[int, option("Independent runs; default: 1.", WORK, min=1, metavar="N")] = 1,
    seed: Annotated[int, option("Of all random numbers; default: 1.", WORK, min=0, metavar="N")] = 1,
    case: CaseOption = None,
    estimator: EstimatorsOption = None,
    criterion: CriterionOption = "det",
    metric: MetricOption = None,
    format: FormatOption = None,
    output: Annotated[
        Path | None,
        option(
            "Folder for measurements.csv, arrivals.csv, truth.csv, initial.csv and estimates.csv.",
            OUTPUT, "--output", "-o", metavar="FOLDER",
        ),
    ] = None,
    force: Annotated[bool, option("Replace such files in the folder.", OUTPUT + RARE, "--force")] = False,
    plot: PlotOption = None,
    digits: DigitsOption = 5,
) -> None:  # fmt: skip
    """Draw truth, measurements and arrivals, run estimators on them, and lay their errors beside the prediction.

    Sensors by name measure by their true functions, and the filters are extended ones: the realised error says how
    far the linearisation of a prediction carries.
    """
    from stochfuse.data.simulate import simulate as simulated

    names = None if estimator is None else named(estimator)
    if output is not None and output.exists() and not output.is_dir():
        raise UsageError(f"--output: expected a folder, got the file {output}")
    check_files(None, plot, scenario)
    given, links = changes.of(scenario)
    way = {
        "estimator": names or (given.estimator or LFG,),
        "link": one_link(links, case),
        "seed": seed,
        "criterion": criterion,
    }
    found = simulated(given, runs, metric=metric, folder=output, force=force, **way)
    show(found, format, plot, digits)
    if output is not None:
        files = " ".join(f"--{name} {output / f'{name}.csv'}" for name in ("measurements", "arrivals", "truth"))
        typer.echo(f"note: written to {output}: run the same with {files}", err=True)
