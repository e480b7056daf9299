"""The methods by the names that users ask for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stochfuse.engines import precision as conditioning
from stochfuse.engines.precision import PROMISED, lost
from stochfuse.errors import UsageError
from stochfuse.kalman.metrics import Moments
from stochfuse.prediction import simplified
from stochfuse.prediction.quantities import QUANTITIES
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.network import LinkRows
from stochfuse.scenario.registry import CRITERIA, ESTIMATORS, METHODS
from stochfuse.scenario.scenario import Scenario, link_rows

MOST_GRAPHS = 100_000
RUNS, SEED = 1000, 1
LFG = "local-fusion-graph"
SELF_CONSISTENT = (
    "the simplified formulation takes for granted that agents share the broadcast prior and nothing else: by its own "
    "assumptions the actual covariance is the claimed one; for what is true see method general"
)


@dataclass(frozen=True)
class Settings:
    """How a method goes about its work.

    Parameters
    ----------
    estimator : what the agents do with what arrives (general and monte-carlo), one of `ESTIMATORS`, see
        `stochfuse.estimators.making`.
    max_graphs : general, naive: different graphs that may be carried from step to step.
    prune : general, naive: leave the least likely graphs out where there are more, instead of giving up.
    runs, seed : monte-carlo: independent runs per link probability, and the seed.
    workers : monte-carlo: processes; default: one for small samples, else one per processor.
    criterion : covariance-intersection, split-ci: what the weights minimise, "det", "trace" or "max-eig",
        in each fusion by itself: over several steps that need not be the least.
    progress : told how far long work is, see `stochfuse.engines.enumeration.Progress`.
    """

    estimator: str = "local-fusion-graph"
    max_graphs: int = MOST_GRAPHS
    prune: bool = False
    runs: int = RUNS
    seed: int = SEED
    workers: int | None = None
    criterion: str = "det"
    progress: Any = None


NAIVE = "naive fusion counts shared information again and believes it; quantity actual is its true error"
CENTRE = (
    "what agents measure themselves reaches the centre of ITNS without a link, only agreement between them depends on "
    "the links: not to be compared with the optimum of what arrived"
)
NO_ERROR = "the scenario has no known initial error (initial.error): the bias is 0, the RMS error that of the noise"


def predict(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | LinkRows | None = None,
    method: str | None = None,
    quantity: str = "claimed",
    *,
    steady: bool = False,
    **settings: Any,
) -> Prediction:
    """Predict the expected fused covariance against link probability.

    Parameters
    ----------
    scenario : from `load_scenario`.
    link : link probabilities, one row of the result each; an array of shape (rows, agents, agents) gives a matrix µ_ij
        (receiver, sender) per row.  Default: the scenario's cases, else its link, else 0, 0.25, 0.5, 0.75 and 1.
    method : default: what the scenario asks for (report.method), else simplified; one of
        "simplified", thesis (50)–(54), approximate (mean field);
        "general", thesis (44)–(49), exact: every outcome, its common information found by the Local Fusion Graph;
        "naive", the same with naive fusion (42)/(43);
        "optimal", the best that any linear fusion could do with what arrived, by the contact chain (theory section 6);
        "monte-carlo", sampled.
    quantity : one of
        "claimed", the covariance that the fusion rule itself reports;
        "actual", the covariance that its error truly has;
        "optimal", the best that any linear fusion could do with what arrived, whatever the method;
        "consistency", actual / claimed, more than 1 where the rule is overconfident;
        "bias", what is left of the scenario's known initial error (initial.error);
        "rms", the root of the mean squared error, noise and bias (theory section 7).
    steady : also solve for the steady state (simplified).
    **settings : see `Settings`.

    Returns
    -------
    Prediction

    Raises
    ------
    UsageError
        If the request does not fit the scenario.
    NoAnswerError
        If a steady state is asked for and there is none.
    """
    method = method or scenario.method or "simplified"
    choose("method", method, METHODS)
    choose("quantity", quantity, QUANTITIES)
    unknown = set(settings) - set(Settings.__dataclass_fields__)
    if unknown:
        raise TypeError(f"predict() got an unexpected keyword argument '{sorted(unknown)[0]}'")
    how = Settings(**{"estimator": scenario.estimator or LFG, "runs": scenario.runs or RUNS, **settings})
    choose("estimator", how.estimator, ESTIMATORS)
    choose("criterion", how.criterion, CRITERIA)
    if steady and method != "simplified":
        raise UsageError(f"steady: expected method simplified, got {method}")
    if steady and quantity != "claimed":
        raise UsageError(f"steady: expected quantity claimed, got {quantity}")
    rows = link_rows(scenario, link)
    if quantity == "optimal":
        method, how = ("monte-carlo" if method == "monte-carlo" else "optimal"), replace(how, estimator="optimal")
    errors = quantity not in ("claimed", "optimal")
    make: dict[str, Callable[[], dict[str, Any]]] = {
        "simplified": lambda: _simplified(scenario, rows, errors),
        "general": lambda: _enumerated(scenario, rows, how, how.estimator, errors),
        "naive": lambda: _enumerated(scenario, rows, how, "naive", errors),
        "optimal": lambda: _optimal(scenario, rows, errors),
        "monte-carlo": lambda: _sampled(scenario, rows, how, errors),
    }
    parts = make[method]()
    if parts.get("estimator") == "itns" and not scenario.own:
        parts["notes"] = (*parts["notes"], CENTRE)
    if quantity in ("bias", "rms") and scenario.error is None:
        parts["notes"] = (*parts["notes"], NO_ERROR)
    prediction = Prediction(
        scenario=scenario,
        method=method,
        quantity="optimal" if method == "optimal" and quantity == "claimed" else quantity,
        stage="posterior",
        link=rows.means(scenario.network),
        cases=rows.names,
        steps=np.arange(1, scenario.network.steps + 1),
        **parts,
    )
    if not steady:
        return prediction
    from stochfuse.prediction.steady_state import steady_state

    fixed = steady_state(scenario, rows)
    return prediction.with_steady(fixed.P, fixed.bound)


def predict_several(
    scenario: Scenario,
    link: Sequence[float] | np.ndarray | float | LinkRows | None,
    method: str | None,
    quantities: Sequence[str],
    **settings: Any,
) -> list[Prediction]:
    """Predict several quantities, with no more work than the hardest of them needs; see `predict`."""
    method = method or scenario.method or "simplified"
    apart = [q for q in quantities if q == "optimal" and method != "optimal"]
    together = [q for q in quantities if q not in apart]
    if method == "optimal" and {"claimed", "optimal"} <= set(together):
        raise UsageError(
            "quantity: with method optimal the claimed covariance is the optimal one; expected one of them"
        )
    # the moments of the actual error contain what is claimed; bias and rms have more to note
    hardest = max(together, key=("claimed", "optimal", "actual", "consistency", "bias", "rms").index, default=None)
    found = {q: predict(scenario, link, method, q, **settings) for q in apart}
    if hardest is not None:
        common = predict(scenario, link, method, hardest, **settings)
        found |= {q: common if q == hardest else common.shown_as(q) for q in together}
    return [found[q] for q in quantities]


def _simplified(scenario: Scenario, rows: LinkRows, errors: bool) -> dict[str, Any]:
    result = simplified.covariances(scenario, rows)
    moments, notes = Moments(result.P), simplified.departures(scenario, rows)
    if "square-root" in result.forms or conditioning.ill_noise(scenario):
        notes += _rounding(simplified.reach_of_rounding(scenario, rows))
    if errors:
        from stochfuse.prediction.states import mean_error

        # one agent of each group stands for all of it
        first = np.unique(result.group_of, return_index=True)[1]
        moments = Moments.of(result.P, result.P, mean_error(scenario, rows)[:, :, first])
        notes.append(SELF_CONSISTENT)
    return {
        "nature": "approximate",
        "moments": moments,
        "group_of": result.group_of,
        "forms": result.forms,
        "notes": tuple(notes),
    }


def _rounding(reach: np.ndarray) -> list[str]:
    """Say how far rounding may reach in some row of the simplified formulation, where that is too far."""
    far = lost(reach)
    return [conditioning.told(float(reach[far].max()))] if far.any() else []


def _enumerated(scenario: Scenario, rows: LinkRows, how: Settings, estimator: str, errors: bool) -> dict[str, Any]:
    from stochfuse.prediction.general import outcomes

    if how.max_graphs < 1:
        raise UsageError(f"max_graphs: expected a whole number of at least 1, got {how.max_graphs}")
    found = outcomes(
        scenario,
        rows,
        estimator,
        errors=errors,
        max_graphs=how.max_graphs,
        prune=how.prune,
        criterion=how.criterion,
        progress=how.progress,
    )
    left_out = float(found.left_out.max())
    notes = [] if errors or estimator != "naive" else [NAIVE]
    if left_out > 1e-12:
        row, step = np.unravel_index(found.left_out.argmax(), found.left_out.shape)
        notes.append(
            f"outcomes of probability up to {left_out:.2g} (at µ = {rows.means(scenario.network)[row]:g}, step "
            f"{step + 1}) are "
            "left out; what is shown holds given one of the others"
        )
    moments, reach = found.moments(), found.rounding
    notes += conditioning.notes(reach)
    return {
        "nature": "exact" if left_out <= 1e-12 and reach <= PROMISED else "approximate",
        "moments": moments,
        "group_of": group_of(found.groups),
        "estimator": estimator,
        "notes": tuple(notes),
        "outcomes": found,
        "meta": {
            "outcomes": found.structure.outcomes[-1],
            "graphs": found.structure.states,
            "left_out": found.left_out.tolist(),
        },
    }


def _optimal(scenario: Scenario, rows: LinkRows, errors: bool) -> dict[str, Any]:
    from stochfuse.prediction.optimal import optimum

    found, groups = optimum(scenario, rows)
    bound = float(found.bound.max())
    notes = [f"the optimum is proved to lie within a relative {bound:.0e} of the value shown"] if bound else []
    notes += conditioning.notes(found.rounding)
    moments = Moments(found.P)
    if errors:
        if found.bias is None:
            raise UsageError(
                "the optimum is only enclosed in bounds: expected quantity optimal, or fewer agents or steps"
            )
        # what the optimum claims is what it achieves
        moments = Moments(found.P, found.P, found.bias, found.square)
    return {
        "nature": "approximate" if found.rounding > PROMISED else "bound" if bound else "exact",
        "moments": moments,
        "group_of": group_of(groups),
        "estimator": "optimal",
        "notes": tuple(notes),
        "meta": {"paths": found.paths, "relative_bound": found.bound.tolist()},
    }


def _sampled(scenario: Scenario, rows: LinkRows, how: Settings, errors: bool) -> dict[str, Any]:
    from stochfuse.prediction.sampled import sampled

    found = sampled(
        scenario,
        rows,
        how.estimator,
        errors=errors,
        runs=how.runs,
        seed=how.seed,
        workers=how.workers,
        criterion=how.criterion,
        progress=how.progress,
    )
    return {
        "nature": "sampled",
        "notes": (),
        "moments": found.moments(),
        "group_of": group_of(found.groups),
        "estimator": how.estimator,
        "sampled": found,
        "meta": {"runs": how.runs, "seed": how.seed},
    }


def group_of(groups: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Index of every agent among groups of agents."""
    index = np.zeros(sum(map(len, groups)), dtype=int)
    for group, agents in enumerate(groups):
        index[list(agents)] = group
    return index


def choose(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise UsageError if a value is not one of the choices."""
    if value not in choices:
        raise UsageError(f"{name}: expected one of {', '.join(choices)}, got '{value}'")
