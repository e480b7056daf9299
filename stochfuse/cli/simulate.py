"""`stochfuse simulate`: truth, measurements, arrivals and estimates, as files and beside the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from stochfuse.cli.options import OUTPUT, RARE, WORK, Beside, Changes, ScenarioArgument, option
from stochfuse.cli.run import Estimating, show
from stochfuse.cli.values import check_files, tell
from stochfuse.errors import UsageError

EXAMPLES = (
    "stochfuse simulate thesis-steady --link 0.5 --steps 4 --runs 200 -o folder",
    "stochfuse simulate two-radars --link 0.5 --steps 20 --estimator stand-alone",
)


@dataclass(frozen=True)
class Files(Beside):
    """A report on standard output, and what was drawn in a folder."""

    output: Annotated[
        Path | None,
        option(
            "Folder for measurements.csv, arrivals.csv, truth.csv, initial.csv and estimates.csv.",
            OUTPUT, "--output", "-o", metavar="FOLDER",
        ),
    ] = None  # fmt: skip
    force: Annotated[bool, option("Replace such files in the folder.", OUTPUT + RARE, "--force")] = False

    def check(self, *inputs: str | None) -> None:
        """See `Listed.check`."""
        if self.output is not None and self.output.exists() and not self.output.is_dir():
            raise UsageError(f"--output: expected a folder, got the file {self.output}")
        check_files(inputs, None, self.plot, self.report)


def simulate(
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    runs: Annotated[int, option("Independent runs; default: 1.", WORK, min=1, metavar="N")] = 1,
    seed: Annotated[int, option("Of all random numbers; default: 1.", WORK, min=0, metavar="N")] = 1,
    estimating: Estimating = Estimating(),
    to: Files = Files(),
) -> None:
    """Draw truth, measurements and arrivals, run estimators on them, and lay their errors beside the prediction.

    Sensors by name measure by their true functions, and the filters are extended ones: the realised error says how
    far the linearisation of a prediction carries.
    """
    from stochfuse.data.simulate import simulate as simulated

    to.check(scenario)
    given, links = changes.of(scenario)
    way, metric = estimating.way(given, links, seed), estimating.metric
    found = simulated(
        given, runs, estimator=way.estimators, link=way.link, criterion=way.criterion, metric=metric, seed=seed,
        folder=to.output, force=to.force,
    )  # fmt: skip
    show(found, to)
    if to.output is not None:
        files = " ".join(f"--{name} {to.output / f'{name}.csv'}" for name in ("measurements", "arrivals", "truth"))
        tell([f"note: written to {to.output}: run the same with {files}"])
