"""`stochfuse crosscheck`: a simulator's results against the prediction, with a verdict."""

from __future__ import annotations

from typing import Annotated

import typer

from stochfuse.cli.options import (
    SHOWN,
    WORK,
    Averaging,
    Changes,
    EstimatorOption,
    MetricOption,
    Reported,
    ScenarioArgument,
    choice,
    option,
)
from stochfuse.cli.values import renamed, tell
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import GENERAL, METHODS, MONTE_CARLO, SIMPLIFIED

EXAMPLES = (
    "stochfuse crosscheck results.csv",
    "stochfuse crosscheck means.json my.toml --method naive --alpha 0.01",
    "stochfuse crosscheck r.parquet my.toml --estimator split-ci --plot check.png",
    "stochfuse crosscheck runs.csv --columns covariance=P_trace,link=mu",
)


def crosscheck(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="CSV, JSON or Parquet, - for standard input: columns run, agent, step, link and values; or means: "
            "agent, step, link, values, count, std.",
        ),
    ],
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    columns: Annotated[
        str | None, option("FILE's own names: covariance=P_trace,link=mu.", SHOWN, metavar="OURS=THEIRS")
    ] = None,
    method: Annotated[
        str | None,
        choice(
            METHODS,
            f"Prediction to check against: {', '.join(METHODS)}; default: general, or what takes estimator and "
            "scenario.",
            WORK,
        ),
    ] = None,
    estimator: EstimatorOption = None,
    metric: MetricOption = None,
    alpha: Annotated[
        float, option("Probability to call a right simulator wrong; default: 0.001.", SHOWN, metavar="P")
    ] = 0.001,
    averaging: Averaging = Averaging(),
    to: Reported = Reported(),
) -> None:
    """Compare a simulator's results with the prediction; exit 1 if they disagree.

    Values: covariance (claimed, as the metric says; default: trace) or covariance:METRIC, squared_error,
    error:STATE (signed), nees; one or several. The verdict corrects for the number of cells.
    """
    from stochfuse.data.crosscheck import crosscheck as check
    from stochfuse.data.results import read_results
    from stochfuse.report import crosschecks

    to.check(file, scenario)
    settings = averaging.settings([GENERAL, MONTE_CARLO] if method is None else [method], estimator=estimator)
    if not 0 < alpha < 1:
        raise UsageError(f"--alpha: expected a probability between 0 and 1, got {alpha:g}")
    if file == scenario == "-":
        raise UsageError("FILE and SCENARIO: expected at most one of them on standard input, got - for both")
    results = read_results(file, renamed(columns))
    chosen, link = changes.of(scenario)
    verdict = check(results, chosen, method=method, metric=metric, alpha=alpha, link=link, **settings)
    shown = crosschecks.CrosscheckView(verdict, to.digits)
    notes = [*verdict.prediction.notes, *verdict.notes]
    if method == SIMPLIFIED:
        notes.append("the simplified formulation is approximate: a right simulator differs from it")
    for code, ratio in verdict.consistency.items():
        where = f" at µ = {code}" if code else ""
        notes.append(f"mean squared error{where} is {ratio:.3g} times the mean claimed covariance")
    said, report = tell(f"note: {note}" for note in notes), crosschecks.crosscheck_report(shown)
    to.write(report)
    said += tell(f"evidence: {text}" for text in verdict.evidence)
    said += tell(() if verdict.agrees else ["the results disagree with the prediction"])
    to.send(report, chosen.to_mapping(), said)
    if not verdict.agrees:
        raise typer.Exit(1)
