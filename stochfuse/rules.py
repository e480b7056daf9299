"""The estimators by the names that users ask for: what each is made of, for a scenario.

local-fusion-graph        common information removed by the graph (thesis chapter 2)
naive                     estimates added up, nothing removed, (42)/(43)
optimal                   the best that any linear fusion could do with what arrived (theory section 6)
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from stochfuse.estimators import Made
from stochfuse.estimators.local_fusion_graph import LocalFusionGraph
from stochfuse.estimators.naive import NaiveFusion
from stochfuse.estimators.optimal import OptimalFusion
from stochfuse.information import InformationClaims, Ledger, Sources, evaluate
from stochfuse.scenario import Scenario
from stochfuse.sources import error_sources, sources_of

SUMS: dict[str, Any] = {
    "local-fusion-graph": LocalFusionGraph,
    "naive": NaiveFusion,
    "optimal": OptimalFusion,
}
"""Estimators whose estimates are sums of information."""


def make(
    scenario: Scenario,
    name: str,
    relabellings: Sequence[tuple[int, ...]] | None = None,
    *,
    errors: bool = False,
    records: np.ndarray | None = None,
) -> Made:
    """Make an estimator for a scenario.

    Parameters
    ----------
    name : one of `stochfuse.methods.ESTIMATORS`.
    relabellings : permutations of the agents that change nothing; None if nobody may change places.
    errors : whether noise footprints are carried along, see `stochfuse.sources`.
    records : measurements (steps, agents, p) where states are wanted, for estimators of sums of information.

    Raises
    ------
    UsageError
        If the estimator is not one for such a scenario.
    """
    everyone = tuple(range(scenario.network.agents))
    # records tell like agents apart; footprints only say whose noise is whose
    labels = everyone if errors or records is not None else scenario.sensor_of
    ledger = Ledger(scenario.sensor_of if errors else None)
    shared = scenario.correlation == "shared"
    estimator = SUMS[name](ledger, labels, shared=shared, relabellings=relabellings)
    sources = error_sources(scenario) if errors else sources_of(scenario, records)
    return Made(estimator, partial(_claims, ledger, sources))


def _claims(ledger: Ledger, sources: Sources) -> InformationClaims:
    return InformationClaims(evaluate(ledger, sources))
