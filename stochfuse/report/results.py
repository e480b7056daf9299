"""Results of the Python interface in every form: which report shows what kind of result."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np

from stochfuse.data.crosscheck import Verdict
from stochfuse.data.protocols import ProtocolLoad
from stochfuse.data.robot_run import RobotRun
from stochfuse.data.run import RunResult
from stochfuse.errors import UsageError, needed
from stochfuse.estimators.fusion_graph import FusionGraph
from stochfuse.kalman.metrics import metric
from stochfuse.prediction.compare import Comparison, EstimatorComparison
from stochfuse.prediction.expected_states import ExpectedStates
from stochfuse.prediction.result import Prediction
from stochfuse.prediction.swept import Swept
from stochfuse.questions.critical import Critical
from stochfuse.questions.messages import MessageLoad, SweptLoad
from stochfuse.report import (
    comparisons,
    crosschecks,
    fusion_graph,
    links,
    messages,
    predictions,
    protocols,
    solutions,
    study_figures,
)
from stochfuse.report.critical import critical_report
from stochfuse.report.plot import figure_class
from stochfuse.report.predictions import PredictionView
from stochfuse.report.robots import robot_report
from stochfuse.report.runs import run_report
from stochfuse.report.states import StatesView, states_report
from stochfuse.report.table import Report, to_html, to_text
from stochfuse.scenario.links import Links
from stochfuse.scenario.over import Over
from stochfuse.studies.files import Results

REPORTS: dict[Any, Callable[[Any], Report]] = {
    Critical: critical_report,
    ProtocolLoad: lambda found: protocols.protocol_report(protocols.ProtocolView(found)),
    MessageLoad: lambda found: messages.load_report(messages.LoadView((found,), found)),
    SweptLoad: lambda found: messages.load_report(messages.LoadView((found,), found)),
    Results: lambda found: study_figures.summary_report(found, 5),
    Links: links.links_report,
    RunResult: run_report,
    RobotRun: robot_report,
    Verdict: lambda found: crosschecks.crosscheck_report(crosschecks.CrosscheckView(found)),
}
"""What shows a result that is shown in one way only."""


def report_of(result: Any, of: str | None = None, agent: int | str = "mean") -> Report:
    """Return a result in every form.

    Parameters
    ----------
    of : metric of the covariance; default: the scenario's, else trace.
    agent : "mean", "worst", "best" or a number from 1.
    """
    if type(result) in solutions.SHEETS:
        return solutions.solution_report(solutions.sheet_of(result), result)
    for kind, report in REPORTS.items():
        if isinstance(result, kind):
            return report(result)
    if isinstance(result, ExpectedStates):
        return states_report(StatesView(result, agent))
    scenario = (result if isinstance(result, Prediction | Swept) else result.predictions[0]).scenario
    chosen = metric(of or scenario.metric or "trace", scenario.model)
    if isinstance(result, EstimatorComparison):
        return comparisons.estimator_report(comparisons.EstimatorView(result, chosen, agent))
    if isinstance(result, Comparison):
        views = tuple(PredictionView(p, chosen, agent) for p in result.predictions)
        return comparisons.comparison_report(comparisons.ComparisonView(result, views))
    return predictions.report([_view(result, of, agent)])


def text_of(result: Any, **shown: Any) -> str:
    """Return a result's table as text of any width."""
    return to_text(report_of(result, **shown).table(), width=None)  # type: ignore[arg-type]


def html_of(result: Any) -> str:
    """Return a result's table as HTML."""
    return to_html(report_of(result).table())


def figure_of(result: Any, ax: Any = None, **shown: Any) -> Any:
    """Return a result's figure, or draw a prediction on axes that are given, and return their figure.

    Raises
    ------
    StochfuseError
        If matplotlib is not installed.
    UsageError
        If axes are given for something that needs axes of its own.
    """
    figure_class()
    if ax is None:
        drawing = report_of(result, **shown).draw
        if drawing is None:
            raise UsageError(f"plot: there is no figure of a {type(result).__name__}")
        return drawing()
    if not isinstance(result, Prediction | Swept):
        raise UsageError(f"ax: expected none, a {type(result).__name__} needs axes of its own")
    predictions.draw_on(ax, _view(result, **shown))
    return ax.figure


def graph_text(graph: FusionGraph, agent: int, step: int) -> str:
    """Return a fusion graph's explanation of an estimate in words."""
    return fusion_graph.to_text([graph.explain(agent, step)])


def graph_figure(graph: FusionGraph, agent: int, step: int) -> Any:
    """Return a figure of the graph of an estimate."""
    return fusion_graph.draw(graph, graph.explain(agent, step))


def _view(p: Prediction | Swept, of: str | None = None, agent: int | str = "mean") -> PredictionView:
    return PredictionView(p, metric(of or p.scenario.metric or "trace", p.scenario.model), agent)


def frame_of(result: Any, **shown: Any) -> Any:
    """Return a result's records as a tidy pandas DataFrame, a number a row, with everything that says what it is."""
    pandas = needed("pandas", "data")
    if isinstance(result, Results):
        return pandas.read_parquet(result.path) if result.path.suffix == ".parquet" else pandas.read_csv(result.path)
    if isinstance(result, Links):  # nodes' names stay names, whatever they look like ("1", "NA")
        names = dict.fromkeys(links.NAMES, str)
        text = io.StringIO(report_of(result).csv())
        return pandas.read_csv(text, converters=names, keep_default_na=False, na_values=[""])
    frame = pandas.read_csv(io.StringIO(report_of(result, **shown).csv()))
    over = _over(result)
    if over is not None:
        frame = frame.rename(columns={key.title: key.name for key in over.keys})
    if isinstance(result, Prediction) and "faults" in result.meta:
        frame.insert(0, "item", [item for item in range(len(result.link)) for _ in result.steps])
        for name, column in _noise_columns(result).items():
            frame[name] = column[frame["item"]]
    return frame


def _noise_columns(p: Prediction) -> dict[str, np.ndarray]:
    """Noises of items that have their own: Q, R, P, or their entries Q[1,2], the upper half of each matrix."""
    out = {}
    for name, M in zip(("Q", "R", "P"), p.noises or (), strict=False):
        if M is not None:
            d = M.shape[-1]
            upper = [(i, j) for i in range(d) for j in range(i, d)]
            out |= {name if d == 1 else f"{name}[{i + 1},{j + 1}]": M[:, i, j] for i, j in upper}
    return out


def arrays_of(result: Any) -> Any:
    """Return covariances as an xarray.DataArray with named axes, of several predictions one along a further axis.

    Axes are link (or case), step, agent, row and column; of a bias there is no column.  Of links it is a Dataset, its
    axes receiver and sender.
    """
    xarray = needed("xarray", "data")
    if isinstance(result, Prediction | Swept):
        return _array(xarray, result)
    if isinstance(result, Links):
        return xarray.Dataset(**links.arrays(result))
    if isinstance(result, Comparison | EstimatorComparison):
        axis = "method" if isinstance(result, Comparison) else "estimator"
        names = result.methods if isinstance(result, Comparison) else result.estimators
        arrays = [_array(xarray, p) for p in result.predictions]
        return xarray.concat(arrays, needed("pandas", "data").Index(names, name=axis), combine_attrs="drop_conflicts")
    return frame_of(result).to_xarray()


def _over(result: Any) -> Over | None:
    """What was swept, or None."""
    first = result.predictions[0] if isinstance(result, Comparison | EstimatorComparison) else result
    return first.over if isinstance(first, Swept | SweptLoad) else None


def _array(xarray: Any, p: Prediction | Swept) -> Any:
    return _of_points(xarray, p) if isinstance(p, Swept) else _of_one(xarray, p)


def _of_points(xarray: Any, p: Swept) -> Any:
    """Arrays of all points along an axis per key; those of points with one link along no other."""
    index, first = needed("pandas", "data").Index, "link" if p.cases is None else "case"
    each = len(p.link) // len(p.over.points)
    points = [_rows_of_point(xarray, p, k, each, first) for k in range(len(p.over.points))]
    for key in reversed(p.over.keys):
        n, named = len(key.values), index(key.values, name=key.name)
        points = [
            xarray.concat(points[i : i + n], named, join="outer", combine_attrs="drop_conflicts")
            for i in range(0, len(points), n)
        ]
        for array in points:
            array[key.name].attrs["units"] = key.unit
    return points[0]


def _rows_of_point(xarray: Any, p: Swept, point: int, each: int, first: str) -> Any:
    """Rows of one point, along the links if there are several."""
    together = len(p.parts) < len(p.over.points)
    array = _of_one(xarray, p.parts[0 if together else point])
    array = array.isel({first: slice(each * point, each * (point + 1))}) if together else array
    if each == 1:
        return array.isel({first: 0})
    if first == "link" and len({tuple(row) for row in p.link.reshape(-1, each)}) > 1:
        # links that differ from point to point are no axis
        return array.rename({"link": "row"}).assign_coords(row=range(each), link=("row", array["link"].values))
    return array


def _of_one(xarray: Any, p: Prediction) -> Any:
    values, states = p.by_group[:, :, p.group_of], list(p.scenario.model.states)
    first = ("link", p.link) if p.cases is None else ("case", list(p.cases))
    axes = [first, ("step", p.steps), ("agent", range(1, len(p.group_of) + 1)), ("row", states), ("column", states)]
    if p.quantity == "bias":
        values, axes = values[..., 0], axes[:-1]
    coords: dict[str, Any] = {name: list(labels) for name, labels in axes}
    if p.cases is not None:
        coords["link"] = ("case", p.link)
    attrs = {
        "quantity": p.quantity,
        "method": p.method,
        "estimator": p.estimator,
        "nature": p.nature,
        "stage": p.stage,
        "scenario": p.scenario.name,
        "units": ", ".join(unit or "1" for unit in p.scenario.model.units),
        "states": ", ".join(states),
    }
    return xarray.DataArray(values, coords, [name for name, _ in axes], name=f"{p.quantity}_covariance", attrs=attrs)
