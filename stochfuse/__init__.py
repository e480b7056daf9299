"""stochfuse: how good a fused estimate will be, as a function of the link probability.

    >>> import stochfuse as sf
    >>> s = sf.load_scenario("thesis-transient")
    >>> p = sf.predict(s, link=[0, 0.25, 0.5])
    >>> p.covariance.shape                     # link, step, state, state
    (3, 5, 1, 1)

`sf.kalman` and `sf.fusion` are doors to the filter's equations and to the rules of fusion for arrays of one's own,
`sf.thesis` to what the thesis found.
Names are loaded when first used, so that the command line starts without what it does not need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from stochfuse.data.crosscheck import Verdict as Verdict
    from stochfuse.data.crosscheck import check_results as check_results
    from stochfuse.data.crosscheck import crosscheck as crosscheck
    from stochfuse.data.results import read_results as read_results
    from stochfuse.data.robot_run import RobotRun as RobotRun
    from stochfuse.data.robot_run import run_robots as run_robots
    from stochfuse.data.run import RunResult as RunResult
    from stochfuse.data.run import run as run
    from stochfuse.data.simulate import simulate as simulate
    from stochfuse.errors import NoAnswerError as NoAnswerError
    from stochfuse.errors import ScenarioError as ScenarioError
    from stochfuse.errors import StochfuseError as StochfuseError
    from stochfuse.errors import UsageError as UsageError
    from stochfuse.estimators.fusion_graph import FusionGraph as FusionGraph
    from stochfuse.estimators.fusion_graph import load_history as load_history
    from stochfuse.prediction.compare import Comparison as Comparison
    from stochfuse.prediction.compare import compare as compare
    from stochfuse.prediction.compare import compare_estimators as compare_estimators
    from stochfuse.prediction.expected_states import ExpectedStates as ExpectedStates
    from stochfuse.prediction.expected_states import expected_states as expected_states
    from stochfuse.prediction.predict import predict as predict
    from stochfuse.prediction.predict import predict_many as predict_many
    from stochfuse.prediction.result import Prediction as Prediction
    from stochfuse.prediction.states import predict_states as predict_states
    from stochfuse.prediction.steady_state import steady_state as steady_state
    from stochfuse.prediction.swept import Swept as Swept
    from stochfuse.questions.agents_needed import AgentsNeeded as AgentsNeeded
    from stochfuse.questions.agents_needed import agents_needed as agents_needed
    from stochfuse.questions.critical import Critical as Critical
    from stochfuse.questions.critical import critical as critical
    from stochfuse.questions.least_link import LeastLink as LeastLink
    from stochfuse.questions.least_link import least_link as least_link
    from stochfuse.questions.least_value import LeastValue as LeastValue
    from stochfuse.questions.least_value import least_value as least_value
    from stochfuse.questions.messages import MessageLoad as MessageLoad
    from stochfuse.questions.messages import message_load as message_load
    from stochfuse.questions.sensitivity import Sensitivity as Sensitivity
    from stochfuse.questions.sensitivity import sensitivity as sensitivity
    from stochfuse.questions.sensitivity import share_of_gain as share_of_gain
    from stochfuse.scenario import Room
    from stochfuse.scenario.adapters import from_networkx as from_networkx
    from stochfuse.scenario.adapters import from_stonesoup as from_stonesoup
    from stochfuse.scenario.known_links import links as links
    from stochfuse.scenario.scenario import Scenario as Scenario
    from stochfuse.scenario.scenario import load_scenario as load_scenario
    from stochfuse.studies.running import study as study
    from stochfuse.symbolic.general import derive_general as derive_general
    from stochfuse.symbolic.optimal import derive_optimal as derive_optimal
    from stochfuse.symbolic.simplified import derive_simplified as derive_simplified

    scenario: Room

_HOME = {
    "AgentsNeeded": "questions.agents_needed",
    "Comparison": "prediction.compare",
    "Critical": "questions.critical",
    "ExpectedStates": "prediction.expected_states",
    "FusionGraph": "estimators.fusion_graph",
    "LeastLink": "questions.least_link",
    "LeastValue": "questions.least_value",
    "MessageLoad": "questions.messages",
    "NoAnswerError": "errors",
    "Prediction": "prediction.result",
    "RobotRun": "data.robot_run",
    "RunResult": "data.run",
    "Scenario": "scenario.scenario",
    "ScenarioError": "errors",
    "Sensitivity": "questions.sensitivity",
    "StochfuseError": "errors",
    "Swept": "prediction.swept",
    "UsageError": "errors",
    "Verdict": "data.crosscheck",
    "agents_needed": "questions.agents_needed",
    "check_results": "data.crosscheck",
    "compare": "prediction.compare",
    "compare_estimators": "prediction.compare",
    "critical": "questions.critical",
    "crosscheck": "data.crosscheck",
    "derive_general": "symbolic.general",
    "derive_optimal": "symbolic.optimal",
    "derive_simplified": "symbolic.simplified",
    "expected_states": "prediction.expected_states",
    "from_networkx": "scenario.adapters",
    "from_stonesoup": "scenario.adapters",
    "least_link": "questions.least_link",
    "least_value": "questions.least_value",
    "links": "scenario.known_links",
    "load_history": "estimators.fusion_graph",
    "load_scenario": "scenario.scenario",
    "message_load": "questions.messages",
    "predict": "prediction.predict",
    "predict_many": "prediction.predict",
    "predict_states": "prediction.states",
    "read_results": "data.results",
    "run": "data.run",
    "run_robots": "data.robot_run",
    "sensitivity": "questions.sensitivity",
    "share_of_gain": "questions.sensitivity",
    "simulate": "data.simulate",
    "steady_state": "prediction.steady_state",
    "study": "studies.running",
}

__all__ = [
    "AgentsNeeded",
    "Comparison",
    "Critical",
    "ExpectedStates",
    "FusionGraph",
    "LeastLink",
    "LeastValue",
    "MessageLoad",
    "NoAnswerError",
    "Prediction",
    "RobotRun",
    "RunResult",
    "Scenario",
    "ScenarioError",
    "Sensitivity",
    "StochfuseError",
    "Swept",
    "UsageError",
    "Verdict",
    "__version__",
    "agents_needed",
    "check_results",
    "compare",
    "compare_estimators",
    "critical",
    "crosscheck",
    "derive_general",
    "derive_optimal",
    "derive_simplified",
    "expected_states",
    "from_networkx",
    "from_stonesoup",
    "least_link",
    "least_value",
    "links",
    "load_history",
    "load_scenario",
    "message_load",
    "predict",
    "predict_many",
    "predict_states",
    "read_results",
    "run",
    "run_robots",
    "scenario",
    "sensitivity",
    "share_of_gain",
    "simulate",
    "steady_state",
    "study",
]


def __getattr__(name: str) -> Any:
    if name in ("fusion", "kalman", "scenario", "thesis"):
        return import_module(f"stochfuse.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'stochfuse' has no attribute '{name}'")
    return getattr(import_module(f"stochfuse.{_HOME[name]}"), name)


def shown(name: str, *args: Any, **kwargs: Any) -> Any:
    """Call a function of `stochfuse.report.results`: the door through which a result reaches what shows it."""
    return getattr(import_module("stochfuse.report.results"), name)(*args, **kwargs)


def __dir__() -> list[str]:
    return __all__
