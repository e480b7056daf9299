"""`stochfuse crosscheck`: a simulator's results against the prediction, with a verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import (
    SHOWN,
    WORK,
    Changes,
    Graphs,
    MetricOption,
    ScenarioArgument,
    Unplotted,
    choice,
    option,
    settings_for,
)
from stochfuse.errors import UsageError
from stochfuse.scenario.registry import GENERAL, NAIVE, SIMPLIFIED

if TYPE_CHECKING:
    from stochfuse.questions.results import SimulatorResults
    from stochfuse.scenario.network import LinkRows
    from stochfuse.scenario.scenario import Scenario

AGAINST = (GENERAL, SIMPLIFIED, NAIVE)
EXAMPLES = ("stochfuse crosscheck results.csv", "stochfuse crosscheck means.json my.toml --method naive --alpha 0.01")


def crosscheck(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="CSV or JSON, - for standard input: columns run, agent, step, link, covariance and optionally "
            "error; or means: agent, step, link, covariance, count, std.",
        ),
    ],
    scenario: ScenarioArgument = "thesis-transient",
    changes: Changes = Changes(),
    method: Annotated[
        str,
        choice(AGAINST, f"Prediction to check against: {', '.join(AGAINST)} (approximate); default: general.", WORK),
    ] = GENERAL,
    metric: MetricOption = None,
    alpha: Annotated[
        float,
        option(
            "Probability that a right simulator is called wrong, over all cells; default: 0.001.", SHOWN, metavar="P"
        ),
    ] = 0.001,
    graphs: Graphs = Graphs(),
    to: Unplotted = Unplotted(),
) -> None:
    """Compare a simulator's results with the prediction; exit 0 if they agree, 1 if they do not.

    The column covariance holds the claimed covariance after fusion, as the metric says (default: trace). Per cell a
    z-score; the verdict corrects for the number of cells.
    """
    from stochfuse.kalman.metrics import metric as metric_of
    from stochfuse.prediction.predict import predict
    from stochfuse.questions.crosscheck import check_results
    from stochfuse.questions.results import read_results
    from stochfuse.report import crosschecks
    from stochfuse.report.predictions import PredictionView

    to.check(file, scenario)
    settings = settings_for([method], **graphs._asdict())
    if not 0 < alpha < 1:
        raise UsageError(f"--alpha: expected a probability between 0 and 1, got {alpha:g}")
    if file == scenario == "-":
        raise UsageError("FILE and SCENARIO: expected at most one of them on standard input, got - for both")
    results = read_results(file)
    last = int(results.step.max())
    given, links = changes.of(scenario)
    if last > given.network.steps:
        raise UsageError(
            f"{results.at(int(results.step.argmax()))}, column 'step': expected at most the scenario's "
            f"{given.network.steps} steps, got {last}; see --steps"
        )
    given = given.until(last)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    prediction = predict(given, _rows(results, given, links), method, **settings)
    verdict = check_results(results, prediction, chosen, alpha)
    shown = crosschecks.CrosscheckView(results, PredictionView(prediction, chosen, digits=to.digits), verdict)
    for note in prediction.notes:
        typer.echo(f"note: {note}", err=True)
    if method == SIMPLIFIED:
        typer.echo("note: the simplified formulation is approximate: a right simulator differs from it", err=True)
    for link, ratio in verdict.consistency.items():
        where = f" at µ = {link}" if link else ""
        typer.echo(
            f"note: column error{where}: mean squared error is {ratio:.3g} times the mean claimed covariance (not "
            "part of the verdict)",
            err=True,
        )
    to.write(crosschecks.crosscheck_report(shown))
    if not verdict.agrees:
        typer.echo("the results disagree with the prediction", err=True)
        raise typer.Exit(1)


def _rows(results: SimulatorResults, scenario: Scenario, asked: list[float] | None) -> LinkRows:
    """Rows of the prediction for the file's link probabilities or names of cases."""
    from stochfuse.questions.results import ResultsError
    from stochfuse.scenario.network import stacked_rows
    from stochfuse.scenario.scenario import link_rows

    links, cases = results.links, dict(scenario.network.cases)
    if asked is not None and (links != [""] or len(asked) > 1):
        raise UsageError("--link: expected one link probability, for a file without a column 'link'")
    if links == [""]:
        rows = link_rows(scenario, asked)
        if len(rows.link) > 1:
            raise ResultsError(
                f"{results.source}: expected a column 'link', since the scenario has no link of its own; or --link"
            )
        return rows
    if all(link in cases for link in links):
        return stacked_rows(tuple(links), [cases[link] for link in links], scenario.network)
    values = []
    for link in links:
        try:
            value = float(link)
        except ValueError:
            value = -1.0
        if not 0 <= value <= 1:
            where = results.at(int((results.link == link).argmax()))
            known = f", or a case ({', '.join(cases)})" if cases else ""
            raise ResultsError(f"{where}, column 'link': expected a probability between 0 and 1{known}, got '{link}'")
        values.append(value)
    if scenario.network.link is not None or cases:
        typer.echo(
            "note: the file's link probabilities are taken for all links; the scenario's own are not used", err=True
        )
    return link_rows(scenario, values)
