"""The public names, each listed once: what type checkers read, and what `stochfuse/__init__.py` loads from."""

from typing import Any

from stochfuse import fusion as fusion
from stochfuse import kalman as kalman
from stochfuse import thesis as thesis
from stochfuse.data.agent import Agent as Agent
from stochfuse.data.agent import Start as Start
from stochfuse.data.crosscheck import Verdict as Verdict
from stochfuse.data.crosscheck import check_results as check_results
from stochfuse.data.crosscheck import crosscheck as crosscheck
from stochfuse.data.messages import MessageProtocol as MessageProtocol
from stochfuse.data.protocols import ProtocolLoad as ProtocolLoad
from stochfuse.data.protocols import protocol_load as protocol_load
from stochfuse.data.results import read_results as read_results
from stochfuse.data.robot_run import RobotRun as RobotRun
from stochfuse.data.robot_run import run_robots as run_robots
from stochfuse.data.run import RunResult as RunResult
from stochfuse.data.run import run as run
from stochfuse.data.simulate import simulate as simulate
from stochfuse.errors import MessageError as MessageError
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

__version__: str
scenario: Room

def shown(name: str, *args: Any, **kwargs: Any) -> Any: ...
