"""`stochfuse predict`: expected covariance against link probability."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stochfuse.cli.options import (
    Architecture,
    Format,
    FormatOption,
    OutputOption,
    ScenarioArgument,
    chosen_format,
    parse_link,
)

if TYPE_CHECKING:
    from stochfuse.report.predictions import View


class Method(StrEnum):
    """Methods of prediction."""

    simplified = "simplified"


class Quantity(StrEnum):
    """Quantities predicted."""

    claimed = "claimed"


def predict(
    scenario: ScenarioArgument = "thesis-transient",
    agents: Annotated[int | None, typer.Option(min=1, help="Number of agents.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Number of time steps.")] = None,
    link: Annotated[
        str | None,
        typer.Option(
            metavar="SPEC", help="Link probabilities, for all links alike: 0.5, 0.2,0.5 or 0:1:0.25 (both ends)."
        ),
    ] = None,
    q: Annotated[float | None, typer.Option(help="Process noise variance Q (times the identity).")] = None,
    r: Annotated[
        float | None,
        typer.Option(help="Measurement noise variance R (times the identity), of agents without their own."),
    ] = None,
    p0: Annotated[
        float | None, typer.Option(help="Variance of the initial estimates P(k0) (times the identity).")
    ] = None,
    architecture: Annotated[Architecture | None, typer.Option(help="Who may hear whom.")] = None,
    method: Annotated[Method, typer.Option(help="How to average over which messages arrive.")] = Method.simplified,
    quantity: Annotated[Quantity, typer.Option(help="Which covariance.")] = Quantity.claimed,
    metric: Annotated[
        str | None,
        typer.Option(
            help="trace, det, max-eig, var:STATE, std:STATE or rms:STATE,STATE; default: the scenario's, else trace."
        ),
    ] = None,
    agent: Annotated[
        str,
        typer.Option(metavar="N", help="Whose covariance where agents differ: mean, worst, best or an agent's number."),
    ] = "mean",
    normalise: Annotated[bool, typer.Option("--normalise", help="Relative to link probability 0.")] = False,
    steady: Annotated[
        bool, typer.Option("--steady", help="Add the steady state, P = g(P), with a proved bound.")
    ] = False,
    digits: Annotated[int, typer.Option(min=1, max=17, help="Significant digits in tables.")] = 5,
    format: FormatOption = None,
    output: OutputOption = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Also draw a figure: .png, .svg or .pdf.")] = None,
) -> None:
    """Tabulate the expected fused covariance against link probability.

    Without a scenario: the thesis' transient one. Options override the scenario.
    """
    from stochfuse.errors import UsageError
    from stochfuse.methods import predict as run
    from stochfuse.metrics import metric as metric_of
    from stochfuse.report.export import PLOT_SUFFIXES, check_writable
    from stochfuse.report.predictions import View
    from stochfuse.scenario import load_scenario

    check_writable(output)
    check_writable(plot, PLOT_SUFFIXES)
    if plot is not None and output is not None and plot.resolve() == output.resolve():
        raise UsageError(f"--output and --plot: expected different files, got {output} for both")
    links = None if link is None else parse_link(link)
    given = load_scenario(
        scenario,
        agents=agents,
        steps=steps,
        architecture=architecture.value if architecture else None,
        q=q,
        r=r,
        p0=p0,
        uniform_link=links is not None,
    )
    chosen = metric_of(metric or given.metric or "trace", given.model)
    prediction = run(given, links, method.value, quantity.value, steady=steady)
    baseline = run(given, [0.0], method.value, quantity.value, steady=steady) if normalise else None
    view = View(prediction, chosen, int(agent) if agent.isdigit() else agent, baseline, digits)
    _warn(view)
    if plot is not None:
        from stochfuse.report.plot import plot_prediction

        plot_prediction(view, plot)
    _write(view, chosen_format(format, output), output)


def _warn(view: View) -> None:
    for note in view.prediction.notes:
        typer.echo(f"note: {note}", err=True)
    if view.metric.mixed and not view.baseline:
        names = ", ".join(f"{n} [{u}]" for n, u in zip(*_states(view), strict=True))
        typer.echo(f"note: {view.metric.name} adds up different units ({names}); see --metric", err=True)
    bound = view.prediction.steady_bound
    if bound is not None:
        worst = bound.max()
        if worst < 1:
            typer.echo(
                f"note: the steady state is proved to lie within a relative {worst:.0e} of the value shown", err=True
            )
        else:
            typer.echo(
                "note: the steady state's residual is at rounding level, but no bound on it could be proved", err=True
            )


def _states(view: View) -> tuple[tuple[str, ...], tuple[str, ...]]:
    model = view.prediction.scenario.model
    return model.states, model.units


def _write(view: View, format: str, output: Path | None) -> None:
    from stochfuse.report import predictions, table
    from stochfuse.report.export import terminal_width, to_json, write_text

    if format == Format.csv.value:
        text = predictions.predict_csv(view)
    elif format == Format.json.value:
        text = to_json(predictions.predict_json(view))
    else:
        text = table.render(predictions.predict_table(view), format, terminal_width())
    write_text(text, output)
