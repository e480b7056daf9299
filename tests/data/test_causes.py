"""What is wrong with a simulator: planted mistakes are named, honest simulators are not accused."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.causes import Cause, diagnose, independent_runs, summary
from stochfuse.data.cells import Cell
from stochfuse.data.crosscheck import check_results
from stochfuse.data.mistakes import MISTAKES
from stochfuse.data.results import read_results
from stochfuse.data.supposed import LinkMeans
from stochfuse.kalman.metrics import metric
from stochfuse.scenario.scenario import link_rows
from tests.cli.command import run as command
from tests.cli.command import strict_json
from tests.data.simulators import SCENARIO, naive, table
from tests.oracles.faulty_simulators import Ways, World, faulty, simulate, trace

WALK = World(F=1.0, H=1.0, Q=25.0, R=100.0, P0=100.0, agents=2, steps=3)
MOVING = World(
    F=((1, 1), (0, 1)), H=((1.0, 0.0),), Q=((0.25, 0.5), (0.5, 1.0)), R=((30.0,),), P0=((100.0, 0), (0, 10.0)),
    agents=2, steps=3,
)  # fmt: skip
SHARED = World(F=0.9, H=1.0, Q=10.0, R=40.0, P0=60.0, agents=2, steps=4, shared=True)
THREE = World(F=1.0, H=1.0, Q=25.0, R=60.0, P0=100.0, agents=3, steps=2)
PLANTED = (
    "prior-for-posterior", "step-off-by-one", "measured-at-step-1", "nothing-removed", "not-brought-forward",
    "own-message-lost", "delay-of-one", "one-minus-link", "squared-link", "wrong-link", "deviation-for-variance",
    "three-sigma", "sum-for-mean", "noise-for-covariance", "Q-scaled", "R-scaled", "P-scaled",
    "process-noise-left-out", "local-for-fused", "not-fed-back", "links-drawn-once", "bursts",
    "silent-at-step-1", "pair-drawn-once", "shared-start", "independent-start", "F-transposed", "wrong-architecture", "dependent-runs",
)  # fmt: skip


def columns(world, fault, links, runs, seed=0, errors=False):
    """A file's columns."""
    parts = []
    for place, µ in enumerate(links):
        P, e = faulty(world, fault, µ, runs, seed=100 * seed + place, errors=errors)
        run, step, agent = (i.ravel() for i in np.indices(P.shape))
        part = {"run": run, "step": step + 1, "agent": agent + 1, "link": np.full(P.size, µ), "covariance": P.ravel()}
        parts.append(part | ({"squared_error": (e**2).sum(axis=-1).ravel()} if errors else {}))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@cache
def scenario(world):
    return sf.load_scenario(world.source())


def found(world, fault, links=(0.3, 0.8), runs=1000, seed=0, errors=False, **settings):
    """The verdict on a planted mistake."""
    return sf.crosscheck(columns(world, fault, links, runs, seed, errors), scenario(world), **settings)


@pytest.mark.parametrize("fault", ["one-minus-link", "own-message-lost", "deviation-for-variance", "R-scaled"])
def test_planted_mistakes_are_named_first(fault):
    verdict = found(WALK, fault)
    assert not verdict.agrees
    first = verdict.causes[0]
    assert (first.cause, first.explains, first.of) == (fault, True, (fault,))
    assert first.p > 0.001
    assert first.remaining < 4
    assert "explains all but p = " in first.text


def test_an_estimated_factor_is_near_the_planted_one():
    first = found(WALK, "R-scaled", links=(0.4,)).causes[0]
    assert first.estimate == pytest.approx(0.7, abs=0.02)
    assert "the measurement noise R is 0.7" in first.text


def test_an_honest_simulator_is_accused_of_nothing():
    verdict = found(WALK, "honest")
    assert verdict.agrees
    assert verdict.causes == ()


def test_what_is_the_same_is_said_of_both():
    """Nothing removed and naive fusion are two names of one simulator."""
    verdict = found(WALK, "nothing-removed", links=(0.6,))
    assert [c.cause for c in verdict.causes[:2]] == ["nothing-removed", "naive-for-graph"]
    assert all(c.explains for c in verdict.causes[:2])
    assert summary(verdict.causes).startswith(
        "likely cause: nothing-removed explains the numbers; so does naive-for-graph"
    )


def test_two_mistakes_at_once():
    P, _ = simulate(WALK, 0.3, 1000, 5, Ways(r=0.7))
    run, step, agent = (i.ravel() for i in np.indices(trace(P).shape))
    rows = {"run": run, "step": step + 1, "agent": agent + 1, "link": np.full(run.size, 0.3)}
    first = sf.crosscheck(rows | {"covariance": np.sqrt(trace(P)).ravel()}, scenario(WALK)).causes[0]
    assert (first.cause, first.explains) == ("deviation-for-variance+R-scaled", True)
    assert first.of == ("deviation-for-variance", "R-scaled")
    assert first.estimate == pytest.approx(0.7, abs=0.02)
    assert "two faults: " in first.text


def test_what_nothing_explains_is_said():
    data = columns(WALK, "honest", (0.5,), 1000)
    data["covariance"] = data["covariance"] * np.array([1.0, 1.3, 0.8])[data["step"] - 1]
    causes = sf.crosscheck(data, scenario(WALK)).causes
    assert causes
    assert not any(c.explains for c in causes)
    assert summary(causes).startswith(f"none of the {len(MISTAKES) + 2} known mistakes explains the numbers; nearest ")


def test_means_alone_will_do():
    P, _ = faulty(WALK, "one-minus-link", 0.3, 4000)
    rows = {"step": [1, 2, 3], "link": [0.3] * 3, "covariance": P.mean(axis=(0, 2)), "count": [4000] * 3}
    first = sf.crosscheck(rows, scenario(WALK)).causes[0]
    assert (first.cause, first.explains) == ("one-minus-link", True)


@pytest.mark.slow
def test_what_begins_late_is_looked_at():
    """Right for eleven steps, then 1.3 times too large."""
    s = sf.load_scenario(WALK.source(), steps=14)
    means = sf.predict(s, [0.5], "simplified").values()[0] * np.where(np.arange(1, 15) < 12, 1.0, 1.3)
    rows = {"step": np.arange(1, 15), "link": [0.5] * 14, "covariance": means, "std": 0.3 * means, "count": [4000] * 14}
    causes = sf.crosscheck(rows, s, method="simplified").causes
    assert not any(c.explains for c in causes)
    assert {(c.until, c.last) for c in causes} == {(12, 14)}
    assert "explains the numbers of steps up to 12 (of 14); nearest" in summary(causes)


@pytest.mark.slow
def test_what_explains_the_first_steps_is_tried_on_all():
    """R of what is measured a quarter of what the filters are told: their claims are right."""
    data = table(partial(naive, noise=0.25), [0.5], 2000, np.random.default_rng(0))
    some = {name: data[name] for name in ("run", "agent", "step", "link", "squared_error", "covariance")}
    verdict = sf.crosscheck(some, sf.load_scenario(SCENARIO), estimator="naive")
    first = verdict.causes[0]
    assert (first.cause, first.explains) == ("R-scaled", True)
    assert first.estimate == pytest.approx(0.25, rel=0.1)
    assert "(in the truth alone)" in first.text
    assert (first.until, first.scope) == (first.last, "")


@pytest.mark.slow
def test_claims_of_one_simulator_and_errors_of_another():
    """What shows in the claims alone explains nothing when the errors are another simulator's."""
    data = columns(WALK, "honest", (0.3, 0.8), 2000, errors=True)
    data["squared_error"] = columns(WALK, "shared-start", (0.3, 0.8), 2000, seed=3, errors=True)["squared_error"]
    verdict = sf.crosscheck(data, scenario(WALK))
    assert not verdict.agrees
    assert "shared-start" not in [c.cause for c in verdict.causes if c.explains]


def test_errors_are_looked_at_too():
    """A filter that is not told of the process noise claims too little."""
    verdict = found(WALK, "shared-start", links=(0.6,), errors=True)
    assert verdict.causes[0].cause == "shared-start"


def test_runs_that_repeat_are_seen():
    """White noise has no dependence; every run twice, a period, and runs that are all alike have."""
    noise = np.random.default_rng(1).normal(size=(2000, 3))
    assert independent_runs(noise) is None
    assert independent_runs(np.repeat(noise[:1000], 2, axis=0)) == pytest.approx(1000, rel=0.1)
    assert independent_runs(np.tile(noise[:100], (20, 1))) == pytest.approx(100, rel=0.2)
    assert independent_runs(np.ones((50, 2))) == 1
    assert independent_runs(np.ones((50, 2)), vary=False) is None
    assert independent_runs(noise[:10]) is None


def test_a_cause_is_a_record():
    first = found(WALK, "one-minus-link", links=(0.3,)).causes[0]
    assert isinstance(first, Cause)
    assert set(first._asdict()) >= {"cause", "explains", "p"}
    assert first.estimate is None


def test_the_door_takes_cells_of_ones_own():
    s = scenario(WALK)
    prediction, rows = sf.predict(s, [0.5], "general"), link_rows(s, [0.5])
    expected = prediction.values("trace")[0]
    cells = tuple(
        Cell("0.5", 0, k + 1, (1, 2), 1000, 2 * float(expected[k]), 0.01, float(expected[k])) for k in range(3)
    )
    assert diagnose(prediction, rows, []) == ()
    first = diagnose(prediction, rows, [LinkMeans("0.5", 0, cells)])[0]
    assert first.cause == "sum-for-mean"
    assert "(the sum over agents)" in first.text


def test_of_nees_alone_a_mistake_that_says_nothing_of_it_explains_nothing():
    """Two agents that always hear each other keep the optimum, whose NEES is χ² of two states: here its half."""
    runs, steps = 300, 2
    nees = np.random.default_rng(5).chisquare(2, runs * steps) / 2.0
    run, step = np.divmod(np.arange(runs * steps), steps)
    verdict = sf.crosscheck(
        {"run": run, "step": step + 1, "link": np.ones(runs * steps), "nees": nees}, scenario(MOVING)
    )
    assert not verdict.agrees
    first, *others = verdict.causes
    assert (first.cause, first.explains) == ("nees-per-state", True)
    assert not any(cause.explains for cause in others if cause.cause == "not-brought-forward")


@pytest.mark.slow
def test_the_command_line_names_causes(tmp_path):
    """Expected at µ = 0.75 and sent as those of µ = 0.25."""
    rows = [(1, 43.9), (2, 24.6), (3, 22.0)]
    file = tmp_path / "means.csv"
    file.write_text("link,step,covariance,count\n" + "".join(f"0.25,{k},{P},900\n" for k, P in rows))
    done = command("crosscheck", file, code=1, env={"COLUMNS": "200"})
    assert "likely cause: one-minus-link explains the numbers" in done.stdout
    assert "one-minus-link: µ is the probability of a loss; explains all but p = " in done.stdout
    assert "the results disagree with the prediction" in done.stderr
    causes = strict_json(command("crosscheck", file, "--format", "json", code=1).stdout)["causes"]
    assert causes[0]["cause"] == "one-minus-link"
    assert causes[0]["explains"] is True
    assert 0.001 < causes[0]["p"] <= 1
    assert [c["explains"] for c in causes] == sorted((c["explains"] for c in causes), reverse=True)


def test_unlike_agents_may_be_swapped():
    world = World(F=1.0, H=1.0, Q=25.0, R=100.0, P0=100.0, agents=2, steps=3, sensors=(None, 25.0))
    verdict = found(world, "agents-swapped", links=(0.4,))
    assert verdict.causes[0].cause == "agents-swapped"
    assert "(2, 1 in the place of 1 to 2)" in verdict.causes[0].text


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["own-message-lost", "one-minus-link", "delay-of-one", "not-fed-back"])
def test_planted_mistakes_of_naive_fusion(fault):
    world = World(F=1.0, H=1.0, Q=25.0, R=100.0, P0=100.0, agents=3, steps=3, naive=True)
    first = found(world, fault, links=(0.4,), runs=1500, estimator="naive").causes[0]
    assert (first.cause, first.explains) == (fault, True)


@pytest.mark.slow
def test_planted_mistakes_in_several_scenarios():
    """At least 17 of 20 are named first wherever they show at all; in all of it, nine of ten."""
    named, lines = {}, []
    for name, world, links, errors in (
        ("walk", WALK, (0.3, 0.8), False),
        ("moving", MOVING, (0.4, 0.7), True),
        ("shared", SHARED, (0.5,), False),
        ("three", THREE, (0.25, 0.6), False),
    ):
        for fault in PLANTED:
            verdict = found(world, fault, links, runs=2000, seed=1, errors=errors)
            if not verdict.agrees:
                first = verdict.causes[0].cause if verdict.causes else "-"
                named.setdefault(fault, []).append(first == fault)
                lines.append(f"{name:8} {fault:24} {first}")
    table = "\n".join(lines)
    always = [fault for fault, firsts in named.items() if all(firsts)]
    every = [first for firsts in named.values() for first in firsts]
    print(f"\n{table}\nnamed first: {np.mean(every):.0%} of {len(every)}; always: {len(always)} of {len(named)}")
    assert len(named) >= 20, table
    assert len(always) >= 0.85 * len(named), table
    assert np.mean(every) >= 0.9, table


@pytest.mark.slow
def test_honest_simulators_are_not_accused():
    """200 of them at the level 0.001: with more than one alarm the level would be wrong (1.8 %)."""
    world = World(F=1.0, H=1.0, Q=25.0, R=100.0, P0=100.0, agents=2, steps=2)
    s = scenario(world)
    prediction, m = sf.predict(s, [0.3, 0.8], "general"), metric("trace", s.model)
    verdicts = [
        check_results(read_results(columns(world, "honest", (0.3, 0.8), 300, seed)), prediction, m)
        for seed in range(200)
    ]
    assert sum(not v.agrees for v in verdicts) <= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [None, "prior-for-posterior", "process-noise-left-out", "one-minus-link", "own-message-lost", "deviation-for-variance"],
)  # fmt: skip
def test_a_simulator_written_with_stone_soup(fault):
    pytest.importorskip("stonesoup")
    from tests.oracles import stonesoup_simulator

    parts = [stonesoup_simulator.simulate(400, µ, seed=3, fault=fault) for µ in (0.3, 0.7)]
    data = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    verdict = sf.crosscheck(data, sf.load_scenario(stonesoup_simulator.SCENARIO), estimator="naive")
    assert verdict.agrees == (fault is None)
    assert [c.cause for c in verdict.causes[:1]] == ([] if fault is None else [fault])
