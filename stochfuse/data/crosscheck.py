"""Is a simulator right?  Its results against the prediction, cell by cell and as a whole.

A cell is a quantity, a link probability, a step and a group of like agents.  Values of like agents in one run are
averaged first, so that the runs of a cell are independent, and

    z = (mean − expected) / √(se² + se_expected²)

is nearly standard normal if the simulator is right.  What is expected, of claimed covariances, errors, squared errors
and NEES, is said in `stochfuse.data.expected`; se_expected is 0 but for sampled predictions.  The simulator's standard
error is the sample's; where the law of a value is known, its deviation takes the place of the sample's, so that
outcomes too rare to have been seen are reckoned with.

Where runs are few or outcomes are rare the tails are far from normal.  There Chernoff's bound takes the place of
the normal tail, p ≤ 2 exp(−runs · sup_θ [θ·mean − log E exp(θ·value of one agent)]), which holds for any number of
runs and any dependence between the agents.  (Where the law is not known or estimated: Student's t, too.)

Two tests share the level α, Bonferroni's way:

    the smallest p, corrected for the number of cells (finds an error anywhere)
    all cells together: Hotelling's T² over the cells of a link, over links by Fisher's method (finds a small error
    everywhere); only of cells with enough runs for it, and not where only means are given

The simulator disagrees if either does, or if it says what cannot be (a negative covariance).  Digits that the file does
not give are never held against it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import erfc, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

from stochfuse.data.causes import Cause, causes_of
from stochfuse.data.columns import Labels
from stochfuse.data.expected import Expectations, Expected, Family, families_of, knows
from stochfuse.data.results import Observed, ResultsError, SimulatorResults, dense, read_results
from stochfuse.errors import StochfuseError, UsageError, nearest
from stochfuse.kalman.metrics import Metric
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.predict import predict
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.network import LinkRows, stacked_rows
from stochfuse.scenario.registry import ESTIMATORS, GENERAL, LFG, MONTE_CARLO
from stochfuse.scenario.result import Result
from stochfuse.scenario.scenario import Scenario, ScenarioLike, link_rows, load_scenario

ALPHA = 0.001
NORMAL, ENOUGH_RUNS, SKEWED = 0.3, 200, 0.1
"""Largest correction of the normal tail for skewness with which it is used; least runs, largest skewness for T²."""
ROUNDING = 1e-9
"""Relative difference that is rounding, besides that of the digits in the file."""
MOST_TOGETHER = 1500
"""Cells of a link whose correlations are worked out; of more, as many spread over all of them."""


class Cell(NamedTuple):
    """One quantity, link probability, step and group of agents.

    Parameters
    ----------
    link : text as in the file.
    row : row of the prediction.
    step : number from 1.
    agents : agents averaged, from 1.
    runs : independent runs.
    mean, error : the simulator's mean and its standard error.
    expected : prediction.
    z, p : z-score, and p-value corrected for the number of cells.
    agrees : whether p is above its share of α.
    quantity : "claimed", "bias", "actual" (mean squared error) or "nees".
    metric : in which sense; "nees" of the NEES.
    column : of the file.
    expected_error : standard error of what is expected, 0 where it is not sampled.
    """

    link: str
    row: int
    step: int
    agents: tuple[int, ...]
    runs: int
    mean: float
    error: float
    expected: float
    z: float
    p: float
    agrees: bool
    quantity: str = "claimed"
    metric: str = "trace"
    column: str = "covariance"
    expected_error: float = 0.0


class Block(NamedTuple):
    """Cells of one link, whose runs are the same.

    Parameters
    ----------
    cells : their places among a verdict's cells.
    correlation : (cells, cells) of what their z-scores are made of, mean less expected.
    """

    cells: tuple[int, ...]
    correlation: np.ndarray


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
    blocks: tuple[Block, ...] = ()
    evidence: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()


def crosscheck(
    results: Any,
    scenario: ScenarioLike = "thesis-transient",
    *,
    method: str | None = None,
    estimator: str | None = None,
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
    estimator : what the simulated agents do with what arrives; default: the scenario's, else local-fusion-graph.
    metric : what columns are of that do not say it; default: the scenario's, else trace.
    alpha : probability that a right simulator is called wrong.
    columns : names that the file has for columns, by those of `read_results`.
    link : link probability, for results without a column of it.
    causes : whether to look for what would explain a disagreement, which takes some seconds.
    **settings : as for `predict`.

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
    prediction, unknown = _predicted(read, given, rows, method, {"estimator": estimator, **settings})
    read = replace(read, observed=tuple(o for o in read.observed if o.column not in unknown))
    said += [f"column {name} is not compared: {why}" for name, why in unknown.items()]
    again = None
    unsaid = [f for f in _families(read, prediction, chosen)[0] if not knows(prediction, f)]
    if unsaid:
        whose = prediction.estimator if prediction.estimator in ESTIMATORS else estimator or given.estimator or LFG
        asked = {name: settings[name] for name in ("runs", "seed", "workers", "criterion") if name in settings}
        again = predict(given, rows, MONTE_CARLO, "actual", estimator=whose, **asked)
        what = " and ".join(dict.fromkeys("NEES" if f.quantity == "nees" else f.metric for f in unsaid))
        said.append(
            f"method {prediction.method} knows averages only: the {what} expected is sampled, {again.meta['runs']} "
            f"runs of estimator {whose}"
        )
    verdict = check_results(read, prediction, chosen, alpha, again)
    verdict = replace(verdict, notes=(*said, *verdict.notes))
    return replace(verdict, causes=causes_of(verdict, rows)) if causes else verdict


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
    if settings["estimator"] is None and found.method == GENERAL:
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
            raw += (_of_means if results.run is None else _of_runs)(results, who, against, some)
    if not raw and not results.evidence:
        raise ResultsError(f"{results.source}: nothing to compare: every value is empty")
    order = [family.column + family.quantity for family in families]
    raw.sort(key=lambda j: (j.cell.row, order.index(j.cell.column + j.cell.quantity)))
    blocks = _blocks(raw)
    together = _together(raw, blocks)
    level = alpha / 2 if together is not None else alpha
    cells = [j.cell._replace(p=min(1.0, j.cell.p * len(raw)), agrees=j.cell.p * len(raw) > level) for j in raw]
    largest = min((cell.p for cell in cells), default=1.0)
    return Verdict(
        agrees=largest > level and (together is None or together > level) and not results.evidence,
        alpha=alpha,
        cells=cells,
        p_largest=largest,
        p_together=together,
        consistency=_consistency(results),
        results=results,
        prediction=prediction,
        metric=metric,
        blocks=blocks,
        evidence=results.evidence,
        notes=tuple(notes),
    )


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
    return int(text) if text.isdigit() else 0


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


class Judged(NamedTuple):
    """A cell and what it was made of.

    Parameters
    ----------
    cell : with p of its own, not yet corrected.
    skewness : of the mean.
    runs : (runs of the link,) average over the agents in every run, not-a-number where there is none; None of means.
    drawn : what is expected in every run of a sample, or None.
    """

    cell: Cell
    skewness: float | None = None
    runs: np.ndarray | None = None
    drawn: np.ndarray | None = None


class _Gathered(NamedTuple):
    """A link's values, brought together once.

    Parameters
    ----------
    averages : a family each, (groups, steps, runs), average over the agents; not-a-number where there is none.
    single : a family each, (groups, steps), deviation of the values of single agents.
    number : a family each, (groups, steps), of values.
    agents : (groups, steps, agents) who was seen.
    """

    averages: list[np.ndarray]
    single: list[np.ndarray]
    number: list[np.ndarray]
    agents: np.ndarray


def _gathered(
    results: SimulatorResults, row: int, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> _Gathered:
    groups, steps, agents = prediction.by_group.shape[2], len(prediction.steps), len(prediction.group_of)
    here: Any = slice(None) if len(results.links) == 1 else np.flatnonzero(results.link.codes == row)
    cell, seen = results.step[here] - 1, np.zeros((groups * steps, agents), dtype=bool)
    if who is not None:
        agent = who[here] - 1
        cell = cell + prediction.group_of[agent] * steps
        seen = np.bincount(cell * agents + agent, minlength=seen.size).reshape(seen.shape) > 0
    run = dense(_runs(results)[here])
    width = int(run.max()) + 1
    key, size = cell * width + run, groups * steps * width
    averages, single, number = [], [], []
    for family in families:
        values, k, c = family.values[here], key, cell
        missing = np.isnan(values)
        if missing.any():
            values, k, c = values[~missing], key[~missing], cell[~missing]
        count, each = np.bincount(k, minlength=size), np.bincount(c, minlength=groups * steps)
        with np.errstate(invalid="ignore", divide="ignore"):
            averages.append((np.bincount(k, values, size) / count).reshape(groups, steps, width))
            values = values - (np.bincount(c, values, groups * steps) / each)[c]
            spread = np.sqrt(np.bincount(c, values**2, groups * steps) / (each - 1))
        single.append(spread.reshape(groups, steps))
        number.append(each.reshape(groups, steps))
    return _Gathered(averages, single, number, seen.reshape(groups, steps, agents))


def _runs(results: SimulatorResults) -> np.ndarray:
    return results.run if results.run is not None else np.zeros(0, dtype=np.int64)


def _members(prediction: Prediction, group: int) -> tuple[int, ...]:
    return tuple((np.flatnonzero(prediction.group_of == group) + 1).tolist())


def _of_runs(
    results: SimulatorResults, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> list[Judged]:
    found = [_gathered(results, row, who, prediction, families) for row in range(len(results.links))]
    expectations, judged = Expectations(prediction, families), []
    for group, step in np.ndindex(*found[0].number[0].shape):
        if not any(each[group, step] for link in found for each in link.number):
            continue
        expected = expectations.at(step + 1, group)
        for row, link in enumerate(found):
            whose = tuple((np.flatnonzero(link.agents[group, step]) + 1).tolist()) or _members(prediction, group)
            for i, family in enumerate(families):
                runs = link.averages[i][group, step]
                values = runs[~np.isnan(runs)]
                if len(values) < 2:
                    if len(values) and not results.evidence:
                        where = f"{results.source}: link {results.links[row]}, step {step + 1}"
                        raise ResultsError(f"{where}: expected at least 2 runs, got 1")
                    continue
                share = _share(float(values.std(ddof=1)), float(link.single[i][group, step]), len(values),
                               int(link.number[i][group, step]))  # fmt: skip
                cell = _cell(results.links[row], row, step + 1, whose, family)
                cell = cell._replace(runs=len(values), mean=float(values.mean()), error=float(values.std(ddof=1)))
                judged.append(_judged(cell, family, expected[i], share)._replace(runs=runs))
                if judged[-1].skewness is None:
                    judged[-1] = judged[-1]._replace(skewness=_skewness(values))
    return judged


def _of_means(
    results: SimulatorResults, who: np.ndarray | None, prediction: Prediction, families: Sequence[Family]
) -> list[Judged]:
    counts = results.count if results.count is not None else np.zeros(0, dtype=np.int64)
    group_of = np.zeros(len(counts), dtype=int) if who is None else prediction.group_of[who - 1]
    expectations, judged = Expectations(prediction, families), []
    for step in np.unique(results.step).tolist():
        for group in np.unique(group_of[results.step == step]).tolist():
            expected = expectations.at(step, group)
            for place in np.flatnonzero((results.step == step) & (group_of == group)).tolist():
                whose = _members(prediction, group) if who is None else (int(who[place]),)
                row = int(results.link.codes[place])
                for family, each in zip(families, expected, strict=True):
                    if np.isnan(family.values[place]):
                        continue
                    std = np.nan if family.std is None else float(family.std[place])
                    if np.isnan(std) and (each.deviation is None or not each.exact):
                        name = "std" if family.std is not None or len(families) == 1 else f"std:{family.column}"
                        raise ResultsError(
                            f"{results.at(place, name)}: expected a number, since method {prediction.method} does not "
                            "know the spread over the outcomes"
                        )
                    cell = _cell(results.links[row], row, step, whose, family)
                    cell = cell._replace(runs=int(counts[place]), mean=float(family.values[place]), error=std)
                    judged.append(_judged(cell, family, each, 1.0))
    return judged


def _cell(link: str, row: int, step: int, agents: tuple[int, ...], family: Family) -> Cell:
    return Cell(link, row, step, agents, 0, 0, 0, 0, 0, 0, True, family.quantity, family.metric, family.column)


def _share(averaged: float, single: float, runs: int, values: int) -> float:
    """By how much the average over a run's like agents varies less than one agent: only a large sample says."""
    if runs < ENOUGH_RUNS or not single > 0:
        return 1.0
    return float(np.clip(averaged / single, sqrt(runs / values), 1.0))


def _skewness(values: np.ndarray) -> float:
    """Skewness of the mean of a sample."""
    deviation = values - values.mean()
    variance = float((deviation**2).mean())
    return float((deviation**3).mean()) / variance**1.5 / sqrt(len(values)) if variance > 0 else 0.0


def _judged(cell: Cell, family: Family, expected: Expected, share: float) -> Judged:
    """Complete a cell that comes with the sample's standard deviation of a run in the place of the standard error."""
    row, runs, wanted = cell.row, cell.runs, float(expected.mean[cell.row])
    deviation, known = cell.error, expected.deviation is not None
    if expected.deviation is not None:
        law = share * float(expected.deviation[row])
        # what the law leaves open, noise that is not normal and outcomes that a sample missed, the sample may show
        safe = expected.exact and not (family.noisy and runs >= ENOUGH_RUNS)
        deviation = law if safe or np.isnan(cell.error) else max(law, cell.error)
    own, other = deviation / sqrt(runs), expected.error(row)
    error, difference = float(np.hypot(own, other)), cell.mean - wanted
    given = family.resolution + ROUNDING * abs(wanted)
    beyond = float(np.copysign(max(0.0, abs(difference) - given), difference))
    z = beyond / error if error > 0 else 0.0 if beyond == 0 else float(np.copysign(np.inf, beyond))
    p = erfc(abs(z) / sqrt(2)) if expected.exact else 2.0 * float(stdtr(runs - 1, -abs(z)))
    skewness = None if expected.skewness is None else abs(float(expected.skewness[row])) / sqrt(runs)
    if skewness and 0 < abs(z) < np.inf and skewness * abs(z) ** 3 / 6 > NORMAL and (expected.exact or family.noisy):
        shift = max(0.0, abs(beyond) - 2.0 * other)
        if expected.law is not None:
            p = max(p, expected.law(row).tail(wanted + float(np.copysign(shift, beyond)), runs))
    done = cell._replace(expected=wanted, error=own, z=z, p=p, expected_error=other)
    drawn = None if expected.drawn is None else expected.drawn[row]
    return Judged(done, skewness if known else None, None, drawn)


def _blocks(judged: Sequence[Judged]) -> tuple[Block, ...]:
    """Cells of every link and how they hang together."""
    found = []
    for row in sorted({j.cell.row for j in judged if j.runs is not None}):
        cells = [i for i, j in enumerate(judged) if j.cell.row == row]
        if len(cells) > MOST_TOGETHER:
            cells = [cells[i] for i in np.unique(np.linspace(0, len(cells) - 1, MOST_TOGETHER).astype(int))]
        found.append(Block(tuple(cells), _correlation([judged[i] for i in cells])))
    return tuple(found)


def _correlation(judged: Sequence[Judged]) -> np.ndarray:
    """Correlations of mean less expected, of the runs and samples that cells share."""
    total = np.zeros((len(judged), len(judged)))
    for rows, errors in (
        ([j.runs for j in judged], [j.cell.error for j in judged]),
        ([j.drawn for j in judged], [j.cell.expected_error for j in judged]),
    ):
        for shape in {row.shape for row in rows if row is not None}:
            there = [(i, row) for i, row in enumerate(rows) if row is not None and row.shape == shape]
            some = [i for i, _ in there]
            X = np.stack([row for _, row in there])
            X = X - np.nanmean(X, axis=1, keepdims=True)
            X[np.isnan(X)] = 0.0
            length = np.sqrt((X**2).sum(axis=1))
            scale = np.array([errors[i] for i in some]) / np.where(length > 0, length, 1.0)
            X *= scale[:, None]
            total[np.ix_(some, some)] += X @ X.T
    deviation = np.sqrt(np.diag(total))
    deviation[deviation == 0] = 1.0
    correlation = total / np.outer(deviation, deviation)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def _together(judged: Sequence[Judged], blocks: Sequence[Block]) -> float | None:
    """Hotelling's T² of every link's cells, over links by Fisher's method; None if there are too few runs for it."""
    by_link = []
    for block in blocks:
        fit = [place for place, i in enumerate(block.cells) if _fit(judged[i])]
        if not fit:
            continue
        some = [judged[block.cells[place]] for place in fit]
        z = np.array([j.cell.z for j in some])
        values, vectors = np.linalg.eigh(block.correlation[np.ix_(fit, fit)])
        # directions that hardly vary are rounding
        firm = values > 1e-6
        components = (vectors.T @ z)[firm] / np.sqrt(values[firm])
        n = min(min(j.cell.runs, j.cell.runs if j.drawn is None else len(j.drawn)) for j in some)
        d = int(firm.sum())
        if n - d >= ENOUGH_RUNS / 2:
            by_link.append(float(fdtrc(d, n - d, float((components**2).sum()) * (n - d) / (d * (n - 1)))))
    if not by_link:
        return None
    return float(chdtrc(2 * len(by_link), -2.0 * float(np.log(np.maximum(by_link, 1e-300)).sum())))


def _fit(judged: Judged) -> bool:
    """Whether a cell's mean is near enough to normal."""
    cell, values = judged.cell, judged.runs
    if values is None or cell.runs < ENOUGH_RUNS or abs(judged.skewness or 0.0) >= SKEWED or not np.isfinite(cell.z):
        return False
    return bool(np.nanstd(values) > ROUNDING * abs(np.nanmean(values))) and cell.error > 0


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
