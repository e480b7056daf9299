"""stochfuse: how good a fused estimate will be, as a function of the link probability.

    >>> import stochfuse as sf
    >>> s = sf.load_scenario("thesis-transient")
    >>> p = sf.predict(s, link=[0, 0.25, 0.5])
    >>> p.covariance.shape                     # link, step, state, state
    (3, 5, 1, 1)

Names are loaded when first used, so that the command line starts without what it does not need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from stochfuse.comparison import Comparison as Comparison
    from stochfuse.comparison import compare as compare
    from stochfuse.comparison import compare_estimators as compare_estimators
    from stochfuse.crosscheck import check_results as check_results
    from stochfuse.errors import NoAnswerError as NoAnswerError
    from stochfuse.errors import ScenarioError as ScenarioError
    from stochfuse.errors import StochfuseError as StochfuseError
    from stochfuse.errors import UsageError as UsageError
    from stochfuse.fusion_graph import FusionGraph as FusionGraph
    from stochfuse.fusion_graph import load_history as load_history
    from stochfuse.inverse.agents_needed import AgentsNeeded as AgentsNeeded
    from stochfuse.inverse.agents_needed import agents_needed as agents_needed
    from stochfuse.inverse.least_link import LeastLink as LeastLink
    from stochfuse.inverse.least_link import least_link as least_link
    from stochfuse.inverse.sensitivity import Sensitivity as Sensitivity
    from stochfuse.inverse.sensitivity import sensitivity as sensitivity
    from stochfuse.inverse.sensitivity import share_of_gain as share_of_gain
    from stochfuse.messages import MessageLoad as MessageLoad
    from stochfuse.messages import message_load as message_load
    from stochfuse.methods import predict as predict
    from stochfuse.prediction import Prediction as Prediction
    from stochfuse.questions import steady_state as steady_state
    from stochfuse.results import read_results as read_results
    from stochfuse.scenario import Scenario as Scenario
    from stochfuse.scenario import load_scenario as load_scenario
    from stochfuse.states import predict_states as predict_states
    from stochfuse.studies.running import study as study
    from stochfuse.symbolic import derive_simplified as derive_simplified
    from stochfuse.symbolic_general import derive_general as derive_general
    from stochfuse.symbolic_optimal import derive_optimal as derive_optimal

_HOME = {
    "AgentsNeeded": "inverse.agents_needed",
    "Comparison": "comparison",
    "FusionGraph": "fusion_graph",
    "LeastLink": "inverse.least_link",
    "MessageLoad": "messages",
    "NoAnswerError": "errors",
    "Prediction": "prediction",
    "Scenario": "scenario",
    "ScenarioError": "errors",
    "Sensitivity": "inverse.sensitivity",
    "StochfuseError": "errors",
    "UsageError": "errors",
    "agents_needed": "inverse.agents_needed",
    "check_results": "crosscheck",
    "compare": "comparison",
    "compare_estimators": "comparison",
    "derive_general": "symbolic_general",
    "derive_optimal": "symbolic_optimal",
    "derive_simplified": "symbolic",
    "least_link": "inverse.least_link",
    "load_history": "fusion_graph",
    "load_scenario": "scenario",
    "message_load": "messages",
    "predict": "methods",
    "predict_states": "states",
    "read_results": "results",
    "sensitivity": "inverse.sensitivity",
    "share_of_gain": "inverse.sensitivity",
    "steady_state": "questions",
    "study": "studies.running",
}

__all__ = [
    "AgentsNeeded",
    "Comparison",
    "FusionGraph",
    "LeastLink",
    "MessageLoad",
    "NoAnswerError",
    "Prediction",
    "Scenario",
    "ScenarioError",
    "Sensitivity",
    "StochfuseError",
    "UsageError",
    "__version__",
    "agents_needed",
    "check_results",
    "compare",
    "compare_estimators",
    "derive_general",
    "derive_optimal",
    "derive_simplified",
    "least_link",
    "load_history",
    "load_scenario",
    "message_load",
    "predict",
    "predict_states",
    "read_results",
    "sensitivity",
    "share_of_gain",
    "steady_state",
    "study",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'stochfuse' has no attribute '{name}'")
    return getattr(import_module(f"stochfuse.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
