"""Is a simulator right?  Its results against the prediction, cell by cell and as a whole.

What is expected of claimed covariances, errors, squared errors and NEES is said in `stochfuse.data.expected`, how each
cell is judged in `stochfuse.data.cells`.  Two tests share the level α, Bonferroni's way:

    the smallest p, corrected for the number of cells (finds an error anywhere)
    all cells together (finds a small error everywhere), `stochfuse.data.together`; only of cells with enough runs for
    it, and not where only means are given

The simulator disagrees if either does, or if it says what cannot be (a negative covariance).  Digits that the file does
not give are never held against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stochfuse.data.causes import Cause, causes_of
from stochfuse.data.cells import Cell, Judged, of_means, of_runs
from stochfuse.data.columns import Labels
from stochfuse.data.expected import Family, families_of, knows
from stochfuse.data.results import Observed, ResultsError, SimulatorResults, read_results
from stochfuse.data.together import LinkCells, blocks_of, together
from stochfuse.errors import StochfuseError, UsageError, nearest
from stochfuse.kalman.metrics import Metric
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.method import ShownPart
from stochfuse.prediction.predict import predict
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.network import LinkRows, stacked_rows
from stochfuse.scenario.registry import BROADCAST_PRIOR, GENERAL, LFG, MONTE_CARLO
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, ScenarioLike, link_rows, load_scenario

ALPHA = 0.001
WITH_ERROR = (
    "the scenario has a known initial error (initial.error): errors, squared errors and NEES are expected with what is "
    "left of it; leave it out of the scenario if the simulator starts without"
)


@dataclass(frozen=True, eq=False, repr=False)
class Verdict(Result):
    """The crosscheck's outcome.

    Parameters
    ----------
    agrees : whether neither test rejects at its share of α, and nothing is said that cannot be.
    alpha : probability that a right simulator is called wrong.
    cells : one per quantity, link probability, step and group.
    p_largest : p-value of the largest |z|, corrected for the number of cells.
    p_together : p-value of all cells together, or None where there are too few runs for it, or only means.
    consistency : per link text, mean squared error over mean claimed covariance, where errors are given.
    blocks : per link, how its cells hang together; empty where only means are given.
    evidence : what the file says that cannot be, in words.
    notes : what the reader should know, one sentence each.
    causes : what would explain a disagreement, the likeliest first; see `stochfuse.data.causes`.
    results : what was checked.
    prediction : what it was checked against.
    metric : of columns that name none.
    """

    agrees: bool
    alpha: float
    cells: list[Cell]
    p_largest: float
    p_together: float | None
    consistency: Mapping[str, float]
    results: SimulatorResults
    prediction: Prediction
    metric: Metric
    blocks: tuple[LinkCells, ...] = ()
    evidence: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()


def crosscheck(
    results: Any,
    scenario: ScenarioLike = "thesis-transient",
    *,
    method: str | None = None,
    metric: str | None = None,
    alpha: float = ALPHA,
    columns: Mapping[str, str] | None = None,
    link: Any = None,
    causes: bool = True,
    **settings: Any,
) -> Verdict:
    """Check a simulator's results against the prediction.

    Parameters
    ----------
    results : what `read_results` takes (a file, a data frame, a mapping of names to arrays), or gives.
    scenario : what is simulated: from `load_scenario`, a preset's name, a path, or a mapping.
    method : how to average over what arrives, as for `predict`; default: the exact engine that takes estimator and
        scenario, else sampling.
    metric : what columns are of that do not say it; default: the scenario's, else trace.
    alpha : probability that a right simulator is called wrong.
    columns : names that the file has for columns, by those of `read_results`.
    link : link probability, for results without a column of it.
    causes : whether to look for what would explain a disagreement, which takes some seconds.
    **settings : as for `predict`; estimator is what the simulated agents do with what arrives, by default the
        scenario's, else local-fusion-graph.

    Returns
    -------
    Verdict

    Raises
    ------
    ResultsError
        If the results are malformed; names line and column.
    UsageError
        If they do not fit the scenario, or the scenario not the method.

    Examples
    --------
    Two agents that measure once and always hear each other have R / 2, here 50 of 100.

    >>> import stochfuse as sf
    >>> s = sf.load_scenario("thesis-transient", agents=2)
    >>> found = {"run": [1, 2, 3], "step": [1, 1, 1], "link": [1.0, 1.0, 1.0], "covariance": [50.0, 50.0, 50.0]}
    >>> sf.crosscheck(found, s).agrees
    True
    >>> sf.crosscheck(found | {"covariance": [55.0, 55.0, 55.0]}, s).agrees
    False
    """
    if not 0 < alpha < 1:
        raise UsageError(f"alpha: expected a probability between 0 and 1, got {alpha:g}")
    read = results if isinstance(results, SimulatorResults) else read_results(results, columns)
    given = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    last = int(read.step.max())
    if last > given.network.steps:
        row = int(read.step.argmax())
        raise ResultsError(
            f"{read.at(row, 'step')}: expected at most the scenario's {given.network.steps} steps, got {last}; see "
            "--steps"
        )
    given = given.until(last)
    chosen = metric_of(metric or given.metric or "trace", given.model)
    rows, said = rows_of(read, given, link)
    asked_for = settings.get("estimator")
    settings = {"shown": ShownPart(metrics=(chosen,), agent="worst"), **settings}
    prediction, unknown = _predicted(read, given, rows, method, settings)
    read = replace(read, observed=tuple(o for o in read.observed if o.column not in unknown))
    said += [f"column {name} is not compared: {why}" for name, why in unknown.items()]
    again = None
    unsaid = [f for f in _families(read, prediction, chosen)[0] if not knows(prediction, f)]
    if unsaid:
        whose = prediction.estimator if prediction.estimator != BROADCAST_PRIOR else asked_for or given.estimator or LFG
        kept = ("runs", "seed", "workers", "criterion", "control", "precision", "at_most", "shown")
        asked = {name: settings[name] for name in kept if name in settings}
        again = predict(given, rows, MONTE_CARLO, "actual", estimator=whose, exact_first=False, **asked)
        what = " and ".join(dict.fromkeys("NEES" if f.quantity == "nees" else f.metric for f in unsaid))
        said.append(
            f"method {prediction.method} knows averages only: the {what} expected is sampled, {again.meta['runs']} "
            f"runs of estimator {whose}"
        )
    verdict, judged = _compared(read, prediction, chosen, alpha, again)
    verdict = replace(verdict, notes=(*said, *verdict.notes))
    return replace(verdict, causes=causes_of(verdict, judged, rows)) if causes else verdict


def _predicted(
    results: SimulatorResults, scenario: Scenario, rows: LinkRows, method: str | None, settings: Mapping[str, Any]
) -> tuple[Prediction, dict[str, str]]:
    """The prediction of what the results have values of; and columns that it knows nothing of, with the reason."""
    given = {name: value for name, value in settings.items() if value is not None}
    if method is None:
        given.setdefault("estimator", scenario.estimator or LFG)
    errors = [o.column for o in results.observed if o.kind != "covariance"]
    # without a method the exact engine that takes the estimator, else sampling, is found
    free = replace(scenario, method=None) if method is None else scenario
    try:
        found = predict(free, rows, method, "actual" if errors else "claimed", **given)
    except StochfuseError as error:
        # a column of errors was once a remark: it does not keep covariances from being checked
        if not errors or set(errors) != {"error"} or len(results.observed) == 1:
            raise
        return predict(free, rows, method, "claimed", **given), {"error": str(error)}
    if settings.get("estimator") is None and found.method == GENERAL:
        # nobody asked for another engine
        found = replace(found, notes=tuple(note for note in found.notes if not note.endswith(f"--method {GENERAL}")))
    return found, {}


def rows_of(results: SimulatorResults, scenario: Scenario, link: Any = None) -> tuple[LinkRows, list[str]]:
    """Return rows of the prediction for a file's link probabilities or names of cases, and what to say of them.

    Raises
    ------
    UsageError
        If they are neither, or a link probability is given besides.
    """
    links, cases = results.links, dict(scenario.network.cases)
    if link is not None and (links != [""] or np.size(link) > 1):
        raise UsageError("--link: expected one link probability, for a file without a column 'link'")
    if links == [""]:
        rows = link_rows(scenario, link)
        if len(rows.link) > 1:
            raise ResultsError(
                f"{results.source}: expected a column 'link', since the scenario has no link of its own; or --link"
            )
        return rows, []
    if all(name in cases for name in links):
        return stacked_rows(tuple(links), [cases[name] for name in links], scenario.network), []
    values = []
    for code, name in enumerate(links):
        try:
            value = float(name)
        except ValueError:
            value = -1.0
        if not 0 <= value <= 1:
            where = results.at(int((results.link.codes == code).argmax()), "link")
            known = f", or a case ({', '.join(cases)})" if cases else ""
            raise ResultsError(f"{where}: expected a probability between 0 and 1{known}, got '{name}'")
        values.append(value)
    own = scenario.network.link is not None or cases
    said = ["the file's link probabilities are taken for all links; the scenario's own are not used"] if own else []
    return link_rows(scenario, values), said


def check_results(
    results: SimulatorResults,
    prediction: Prediction,
    metric: Metric,
    alpha: float = ALPHA,
    sampled: Prediction | None = None,
) -> Verdict:
    """Compare a simulator's results with a prediction.

    Parameters
    ----------
    results : from `read_results`.
    prediction : with one row for each of `results.links`, in their order, and steps up to the largest; of quantity
        "actual" where there are errors, squared errors or a NEES to compare.
    metric : what a column "covariance" or "squared_error" holds.
    alpha : probability that a right simulator is called wrong.
    sampled : what to compare a NEES with where the prediction knows averages only.

    Returns
    -------
    Verdict

    Raises
    ------
    UsageError
        If the results do not fit the prediction.
    """
    return _compared(results, prediction, metric, alpha, sampled)[0]


def _compared(
    results: SimulatorResults, prediction: Prediction, metric: Metric, alpha: float, sampled: Prediction | None
) -> tuple[Verdict, list[Judged]]:
    """The verdict, without causes, and its cells with the runs behind them."""
    if not 0 < alpha < 1:
        raise UsageError(f"alpha: expected a probability between 0 and 1, got {alpha:g}")
    who = _agents(results, prediction)
    families, notes = _families(results, prediction, metric)
    known = [f for f in families if sampled is None or knows(prediction, f)]
    others = [f for f in families if sampled is not None and not knows(prediction, f)]
    if sampled is None and any(f.quantity == "nees" and not knows(prediction, f) for f in families):
        raise UsageError(
            f"column 'nees': expected a method that lists outcomes, or a sampled prediction besides, got method "
            f"{prediction.method}"
        )
    raw: list[Judged] = []
    for against, some in ((prediction, known), (sampled, others)):
        if against is not None and some:
            raw += (of_means if results.run is None else of_runs)(results, who, against, some)
    if not raw and not results.evidence:
        raise ResultsError(f"{results.source}: nothing to compare")
    order = [family.column + family.quantity for family in families]
    raw.sort(key=lambda j: (j.cell.row, order.index(j.cell.column + j.cell.quantity)))
    blocks = blocks_of(raw)
    all_cells = together(raw, blocks)
    level = alpha / 2 if all_cells is not None else alpha
    cells = [j.cell._replace(p=min(1.0, j.cell.p * len(raw)), agrees=j.cell.p * len(raw) > level) for j in raw]
    largest = min((cell.p for cell in cells), default=1.0)
    verdict = Verdict(
        agrees=largest > level and (all_cells is None or all_cells > level) and not results.evidence,
        alpha=alpha,
        cells=cells,
        p_largest=largest,
        p_together=all_cells,
        consistency=_consistency(results),
        results=results,
        prediction=prediction,
        metric=metric,
        blocks=blocks,
        evidence=results.evidence,
        notes=tuple(notes),
    )
    return verdict, raw


def _agents(results: SimulatorResults, prediction: Prediction) -> np.ndarray | None:
    """Number of every row's agent, from 1; None: not given."""
    agents, names = len(prediction.group_of), prediction.scenario.network.names
    if results.agent is None:
        if prediction.by_group.shape[2] > 1:
            raise ResultsError(f"{results.source}: the agents differ: expected a column 'agent', got none")
        return None
    if isinstance(results.agent, Labels):
        numbers = [names.index(name) + 1 if name in names else _whole(name) for name in results.agent.names]
        for code, (name, number) in enumerate(zip(results.agent.names, numbers, strict=True)):
            if not 1 <= number <= agents:
                row, known = int((results.agent.codes == code).argmax()), f"1 to {agents}"
                known += f" or one of {', '.join(names)}" if names else ""
                raise ResultsError(f"{results.at(row, 'agent')}: expected {known}, got '{name}'{nearest(name, names)}")
        return np.array(numbers)[results.agent.codes]
    if results.agent.max() > agents:
        first = int((results.agent > agents).argmax())
        raise ResultsError(f"{results.at(first, 'agent')}: expected 1 to {agents}, got {results.agent[first]}")
    return results.agent


def _whole(text: str) -> int:
    return int(text) if text.isdecimal() else 0


def _families(results: SimulatorResults, prediction: Prediction, metric: Metric) -> tuple[list[Family], list[str]]:
    """What is compared, and what is to be said of what is not."""
    families, notes = [], []
    for observed in results.observed:
        if observed.kind != "covariance" and not prediction.with_actual:
            if observed.column != "error":
                raise UsageError(f"column '{observed.column}': expected a prediction of quantity actual, got claimed")
            notes.append("column error is not compared: the prediction is of claimed covariances")
            continue
        sense = _sense(results, observed, prediction, metric)
        families += families_of(observed, sense, means=results.run is None)
    bias = prediction.moments.bias
    if any(family.noisy for family in families) and bias is not None and bias.any():
        notes.append(WITH_ERROR)
    return families, notes


def _sense(results: SimulatorResults, observed: Observed, prediction: Prediction, metric: Metric) -> Metric:
    """The metric that a column is of."""
    model, of = prediction.scenario.model, observed.of
    where = f"{results.source}, column '{observed.column}'"
    if observed.kind == "error":
        if not of and len(model.states) > 1:
            raise ResultsError(
                f"{where}: expected a name for every state ({', '.join(f'error:{s}' for s in model.states)}), or "
                "squared_error"
            )
        if of and of not in model.states:
            raise ResultsError(
                f"{where}: no state '{of}'{nearest(of, model.states)}; the states are {', '.join(model.states)}"
            )
        return metric_of(f"var:{of or next(iter(model.states))}", model)
    every = f"rms:{','.join(model.states)}"
    try:
        sense = metric_of(every if of == "rms" else of, model) if of else metric
    except UsageError as error:
        raise ResultsError(f"{where}: {error}") from None
    if observed.kind == "squared_error" and sense.name in ("det", "max-eig"):
        raise ResultsError(
            f"{where}: expected metric trace, var:STATE or rms:STATE,STATE,… as in squared_error:trace, got "
            f"'{sense.name}'"
        )
    if observed.kind == "squared_error" and sense.name.startswith("std:"):
        return metric_of(f"var:{sense.names}", model)
    return sense


def _consistency(results: SimulatorResults) -> dict[str, float]:
    """Mean squared error over mean claimed covariance of every link, of the first pair of columns that say both."""
    claims = {o.of: o.values for o in results.observed if o.kind == "covariance"}
    squares = {o.of: o.values for o in results.observed if o.kind == "squared_error"}
    squares |= {o.of: o.values**2 for o in results.observed if o.column == "error"}
    both = [of for of in claims if of in squares and results.run is not None]
    out = {}
    for code, link in enumerate(results.links if both else ()):
        claimed, squared = claims[both[0]], squares[both[0]]
        here = (results.link.codes == code) & ~np.isnan(squared) & ~np.isnan(claimed)
        if here.any():
            out[link] = float(squared[here].mean() / claimed[here].mean())
    return out
