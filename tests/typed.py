# pyright: strict
"""The public interface as a type checker sees it in its strictest mode: nothing here is of unknown type.

Not a test to be run: `pyright` reads it in CI.
"""

from __future__ import annotations

import numpy as np

import stochfuse as sf

scenario: sf.Scenario = sf.load_scenario("thesis-transient", steps=3)
prediction = sf.predict(scenario, link=[0.0, 0.5], method="general")
covariance: np.ndarray = prediction.covariance[0]
values: np.ndarray = prediction.values("trace", "mean")
swept = sf.predict(scenario, over={"model.Q": [1, 2]})
many = sf.predict_many(scenario, link=np.array([0.1, 0.2]))
comparison = sf.compare(scenario, [0.5])
estimators = sf.compare_estimators(scenario, [0.5], estimators=["naive", "stand-alone"])
least: float = sf.least_link(scenario, 30.0).link
value: float = sf.least_value(scenario, 30.0, "model.R", (50, 200), 0.5).at
agents: int = sf.agents_needed(scenario, 30.0, 0.5).agents
critical = sf.critical(scenario)
worth = sf.sensitivity(scenario, 0.5)
share = sf.share_of_gain(scenario, [0.5])
load = sf.message_load(scenario, [0.5])
steady = sf.steady_state(scenario, [0.5])
states = sf.predict_states(scenario, [0.5])
form = sf.derive_general(agents=2, step=2, q=25, r=100, p0=100)
verdict: sf.Verdict = sf.crosscheck("results.csv", scenario)
record: sf.RunResult = sf.simulate(scenario, 10, link=0.5)
found: sf.RunResult = sf.run(scenario, "measurements.csv")
try:
    sf.predict(scenario, link=2.0)
except sf.UsageError as error:
    print(error)
except sf.ScenarioError as error:
    print([problem.path for problem in error.problems])
except sf.NoAnswerError as error:
    print(error.items)
