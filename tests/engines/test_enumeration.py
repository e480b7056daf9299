"""The enumeration: merging changes nothing, polynomials, distributions, limits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.engines import enumeration
from stochfuse.estimators.local_fusion_graph import LocalFusionGraph
from stochfuse.estimators.naive import NaiveFusion
from stochfuse.estimators.progress import Progress, listening
from stochfuse.estimators.protocol import FusionRule
from stochfuse.kalman.metrics import metric
from stochfuse.prediction import general
from stochfuse.scenario.scenario import link_rows
from tests.benchmarks import literal
from tests.oracles import strategies, textbook
from tests.oracles.many import outcomes


@st.composite
def networks(draw):
    """Small random networks whose plain enumeration is affordable."""
    architecture = draw(st.sampled_from(["ad-hoc", "broadcast", "cyclic"]))
    agents = draw(st.integers(2, 3 if architecture == "ad-hoc" else 4))
    most = {("ad-hoc", 2): 4, ("ad-hoc", 3): 2, ("broadcast", 4): 3, ("cyclic", 4): 3}.get((architecture, agents), 4)
    delay = draw(st.sampled_from([[1.0], [1.0], [0.6, 0.4], [0.0, 1.0]]))
    steps = draw(st.integers(2, most if delay == [1.0] else min(most, 3)))
    if agents * (agents - 1) * steps > 12 and delay != [1.0]:
        delay = [1.0]
    rng = np.random.default_rng(draw(strategies.seeds))
    F, Q, H, R, P0 = strategies.model(rng, 1, 1)
    kind = draw(st.sampled_from(["equal", "matrix", "per-step"]))
    link = {
        "equal": lambda: float(rng.uniform()),
        "matrix": lambda: (rng.uniform(size=(agents, agents)) * (rng.uniform(size=(agents, agents)) < 0.8)).tolist(),
        "per-step": lambda: rng.uniform(size=steps).tolist(),
    }[kind]()
    if architecture == "broadcast" and kind == "matrix":
        link = np.broadcast_to(rng.uniform(size=agents), (agents, agents)).tolist()
    source = strategies.mapping(F, Q, H, R, P0, agents, steps, architecture=architecture, link=link, delay=delay)
    source["initial"]["correlation"] = draw(st.sampled_from(["independent", "shared"]))
    if draw(st.booleans()):
        source["agent"] = [{"R": (R * (1 + i % 2)).tolist()} for i in range(agents)]
    return sf.Scenario.from_mapping(source)


@given(networks(), st.sampled_from(["local-fusion-graph", "naive"]))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
def test_merging_states_changes_no_later_answer(scenario, estimator):
    rows = link_rows(scenario)
    merged, plain = (outcomes(scenario, rows, estimator, plain=p) for p in (False, True))
    np.testing.assert_allclose(merged.covariance(), plain.covariance(), rtol=1e-12)


def test_against_the_benchmarks_plain_enumeration():
    plain = literal.general(25.0, 100.0, 100.0, 3, 0.3, 2)
    values = sf.predict(sf.load_scenario(steps=2), [0.3], method="general").values()[0]
    np.testing.assert_allclose(values, plain, rtol=1e-13)


def test_merged_graphs_are_few():
    """15, 389, 11,335 for three agents ad hoc, 4, 19, 98, 522 broadcast."""
    cases = {"ad-hoc": [1, 15, 389], "broadcast": [1, 4, 19, 98, 522], "cyclic": [1, 4, 24, 176, 1376]}
    for architecture, states in cases.items():
        scenario = sf.load_scenario(architecture=architecture, steps=len(states) + 1)
        assert outcomes(scenario, link_rows(scenario)).structure.states == states


@pytest.mark.parametrize("estimator", ["local-fusion-graph", "naive"])
@pytest.mark.parametrize(
    ("architecture", "steps", "more"),
    [
        ("ad-hoc", 4, {}),
        ("broadcast", 5, {"initial": {"correlation": "shared"}}),
        ("cyclic", 5, {}),
        ("ad-hoc", 3, {"agent": True}),
    ],
)
@pytest.mark.parametrize("errors", [False, True])
def test_many_states_at_a_time_are_those_one_by_one(monkeypatch, architecture, steps, more, errors, estimator):
    rng = np.random.default_rng(steps)
    made = strategies.mapping(*strategies.model(rng, 1, 1), 3, steps, architecture=architecture, link=0.4)
    made["initial"] |= more.get("initial", {})
    if "agent" in more:
        made["agent"] = [{"R": (np.array(made["model"]["R"]) * (1 + (i > 0))).tolist()} for i in range(3)]
    scenario = sf.Scenario.from_mapping(made)
    monkeypatch.setattr(enumeration, "TOGETHER", 7)
    monkeypatch.setattr(enumeration, "AT_A_TIME", 1000)
    arrays = outcomes(scenario, link_rows(scenario), estimator, errors=errors)
    general._kept.cache_clear()
    monkeypatch.setattr(FusionRule, "together", lambda *_: None)
    for rule in (LocalFusionGraph, NaiveFusion):
        monkeypatch.delattr(rule, "together")
    single = outcomes(scenario, link_rows(scenario), estimator, errors=errors)
    # a few ties are left apart, here or there
    assert np.all(np.array(arrays.structure.states) <= 1.01 * np.array(single.structure.states))
    for quantity in ("claimed", "actual") if errors else ("claimed",):
        expected = single.covariance(quantity=quantity)
        np.testing.assert_allclose(arrays.covariance(quantity=quantity), expected, rtol=1e-12)
    general._kept.cache_clear()


@pytest.mark.parametrize(("architecture", "agents", "steps"), [("ad-hoc", 4, 2), ("broadcast", 5, 3), ("cyclic", 5, 3)])
def test_more_agents_against_the_plain_enumeration(architecture, agents, steps):
    rng = np.random.default_rng(agents)
    F, Q, H, R, P0 = strategies.model(rng, 2, 2)
    scenario = sf.Scenario.from_mapping(
        strategies.mapping(F, Q, H, R, P0, agents, steps, architecture=architecture, link=0.3)
    )
    rows = link_rows(scenario)
    merged, plain = (outcomes(scenario, rows, plain=p) for p in (False, True))
    np.testing.assert_allclose(merged.covariance()[0, :, 0], plain.covariance()[0, :, 0], rtol=1e-11)


def test_certain_exchanges_leave_fewer_states_than_before():
    # after a step in which all hear all, nothing that the optimum knows tells the outcomes before it apart
    network = {"agents": 2, "steps": 4, "link": [0.5, 1.0, 0.5, 1.0]}
    one = {"model": {"F": 1, "H": 1, "Q": 1, "R": 1}, "initial": {"P": 1}, "network": network}
    found = sf.predict(one, method="general", estimator="optimal")
    np.testing.assert_allclose(found.values(), sf.predict(one, method="optimal").values(), rtol=1e-12)


def test_coefficients_count_outcomes_by_arrivals():
    """A_c is the sum over outcomes with exactly c arrivals: with P = 1 everywhere it would be a binomial coefficient."""
    scenario = sf.load_scenario(agents=2, steps=2)
    found = outcomes(scenario, link_rows(scenario))
    A = found.coefficients(2)[:, 0, 0]
    by_count = np.zeros(5)
    model = (np.eye(1), np.full((1, 1), 25.0), [(np.eye(1), np.full((1, 1), 100.0))] * 2, np.full((1, 1), 100.0))
    for _, history in textbook.histories(2, 2, "ad-hoc", np.full((2, 2, 2), 0.5)):
        network = textbook.FusionNetwork(*model, np.zeros((1, 1)), np.zeros((2, 2, 1, 1)), history)
        arrivals = sum(map(len, history))
        by_count[arrivals] += np.mean([network.covariance(i, 2) for i in range(2)])
    np.testing.assert_allclose(A, by_count, rtol=1e-14)


def test_derivative_against_high_precision():
    scenario = sf.load_scenario(steps=4)
    found = outcomes(scenario, link_rows(scenario, [0.0, 0.2, 0.9, 1.0]))
    for step in (1, 2, 4):
        A = [mp.mpf(a) for a in found.coefficients(step)[:, 0, 0].tolist()]
        with mp.workdps(50):
            L = len(A) - 1
            f = lambda µ, A=A, L=L: mp.fsum(a * µ**c * (1 - µ) ** (L - c) for c, a in enumerate(A))  # noqa: E731
            exact = [float(mp.diff(f, µ)) for µ in (0.0, 0.2, 0.9, 1.0)]
        np.testing.assert_allclose(found.derivative()[:, step - 1, 0, 0, 0], exact, rtol=1e-9)


@pytest.fixture(scope="module")
def every_history():
    """Covariance of agent 1 at step 2 in every history of three agents, with the history's probability at µ = 0.3."""
    model = (np.eye(1), np.full((1, 1), 25.0), [(np.eye(1), np.full((1, 1), 100.0))] * 3, np.full((1, 1), 100.0))
    pairs = [
        (p, textbook.FusionNetwork(*model, np.zeros((1, 1)), np.zeros((2, 3, 1, 1)), h).covariance(0, 2).item())
        for p, h in textbook.histories(3, 2, "ad-hoc", np.full((2, 3, 3), 0.3))
    ]
    return np.array(pairs).T


def test_distribution_over_outcomes(every_history):
    probability, P = every_history
    p = sf.predict(sf.load_scenario(steps=2), [0.3], method="general")
    mean = probability @ P
    assert p.values()[0, 1] == pytest.approx(mean, rel=1e-13)
    assert p.statistic("variance")[0, 1] == pytest.approx(probability @ (P - mean) ** 2, rel=1e-12)
    assert p.statistic("std")[0, 1] == pytest.approx(np.sqrt(probability @ (P - mean) ** 2), rel=1e-12)
    for limit in (20.0, 25.0, 30.0, 40.0, 60.0):
        assert p.statistic(f"at-most:{limit}")[0, 1] == pytest.approx(probability[limit + 1e-9 >= P].sum(), abs=1e-13)
    order = np.argsort(P)
    for level in (0.0, 0.1, 0.5, 0.9, 1.0):
        reached = np.cumsum(probability[order]) >= level - 1e-12
        assert p.statistic(f"quantile:{level}")[0, 1] == pytest.approx(P[order][reached.argmax()], rel=1e-12)
    spread = p.outcomes.distribution(metric("trace", p.scenario.model), 2)
    assert spread.probability.sum() == pytest.approx(1, abs=1e-14)
    assert spread.mean()[0] == pytest.approx(mean, rel=1e-13)


def test_statistics_are_certain_where_nothing_is_left_to_chance():
    p = sf.predict(sf.load_scenario(steps=3), [0.0, 1.0], method="general")
    assert (p.statistic("variance") == 0).all()
    np.testing.assert_allclose(p.statistic("quantile:0.5"), p.values(), rtol=1e-12)
    assert (p.statistic("at-most:1000") == 1).all()


def test_statistics_in_blocks_of_rows(monkeypatch):
    p = sf.predict(sf.load_scenario(steps=3), np.linspace(0, 1, 7), method="general")
    whole = p.statistic("quantile:0.7"), p.statistic("variance")
    monkeypatch.setattr("stochfuse.prediction.general.MOST_PROBABILITIES", 2000)
    np.testing.assert_array_equal(p.statistic("quantile:0.7"), whole[0])
    np.testing.assert_allclose(p.statistic("variance"), whole[1], rtol=1e-13)


def test_unlike_agents_have_statistics_of_their_own():
    source = strategies.mapping(1, 25, 1, 100, 100, 2, 2, link=0.5)
    source["agent"] = [{"R": 50}, {"R": 100}]
    p = sf.predict(sf.Scenario.from_mapping(source), method="general")
    one, two = (p.statistic("variance", agent=a)[0, 1] for a in (1, 2))
    assert one != two
    worst, best = (p.statistic("variance", agent=a)[0, 1] for a in ("worst", "best"))
    assert (worst, best) == (max(one, two), min(one, two))
    mixture = p.outcomes.distribution(metric("trace", p.scenario.model), 2, [0, 1])
    assert mixture.mean()[0] == pytest.approx(p.values()[0, 1], rel=1e-13)


def test_rows_and_polynomials_agree():
    """Beside a row of unequal links a matrix of equal ones is summed row by row, alone as a polynomial."""
    scenario = sf.load_scenario(steps=3, agents=3)
    polynomial = sf.predict(scenario, [0.2, 0.7], method="general")
    equal = np.stack([np.full((3, 3), µ) for µ in (0.2, 0.7)])
    unequal = np.random.default_rng(0).uniform(size=(1, 3, 3))
    rows = sf.predict(scenario, np.concatenate([equal, unequal]), method="general")
    np.testing.assert_allclose(rows.covariance[:2], polynomial.covariance, rtol=1e-13)
    np.testing.assert_allclose(rows.statistic("std")[:2], polynomial.statistic("std"), rtol=1e-10)
    alone = sf.predict(scenario, equal, method="general")
    np.testing.assert_allclose(alone.outcomes.coefficients(2), polynomial.outcomes.coefficients(2), rtol=1e-14)
    with pytest.raises(sf.UsageError, match="a polynomial in µ: expected one link probability for all links"):
        rows.outcomes.coefficients(2)


def test_polynomial_with_delays():
    scenario = sf.Scenario.from_mapping(strategies.mapping(1, 25, 1, 100, 100, 2, 3, delay=[0.5, 0.5]))
    found = sf.predict(scenario, [0.3], method="general").outcomes
    values = found.covariance(np.linspace(0, 1, 5))[:, :, 0, 0, 0]
    one_by_one = sf.predict(scenario, np.linspace(0, 1, 5), method="general").values()
    np.testing.assert_allclose(values, one_by_one, rtol=1e-14)
    assert len(found.coefficients(3)) == 7


@given(st.floats(0.05, 0.95), strategies.seeds)
@settings(max_examples=15, deadline=None)
def test_change_of_coordinates(link, seed):
    """x → T x turns every covariance into T P Tᵀ."""
    rng = np.random.default_rng(seed)
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    T = rng.normal(size=(2, 2)) + 2 * np.eye(2)
    Tinv = np.linalg.inv(T)
    one = sf.Scenario.from_mapping(strategies.mapping(F, Q, H, R, P0, 3, 2, link=link))
    two = sf.Scenario.from_mapping(
        strategies.mapping(T @ F @ Tinv, T @ Q @ T.T, H @ Tinv, R, T @ P0 @ T.T, 3, 2, link=link)
    )
    P, moved = (sf.predict(s, method="general").covariance for s in (one, two))
    np.testing.assert_allclose(moved, T @ P @ T.T, rtol=1e-7, atol=1e-9)


@given(strategies.seeds)
@settings(max_examples=10, deadline=None)
def test_relabelled_agents(seed):
    """Agents in another order: the same answers in that order."""
    rng = np.random.default_rng(seed)
    µ, R = rng.uniform(size=(3, 3)), rng.uniform(50, 150, 3)
    order = rng.permutation(3)

    def scenario(µ, R):
        source = strategies.mapping(1, 25, 1, 100, 100, 3, 2, link=µ.tolist())
        source["agent"] = [{"R": float(r)} for r in R]
        return sf.predict(sf.Scenario.from_mapping(source), method="general")

    p, q = scenario(µ, R), scenario(µ[order][:, order], R[order])
    for new, old in enumerate(order):
        np.testing.assert_allclose(q.of_agent(new + 1), p.of_agent(int(old) + 1), rtol=1e-12)


class Recorder(Progress):
    def __init__(self):
        self.told, self.steps = [], []

    def expect(self, outcomes, graphs):
        self.told.append((outcomes, graphs))

    def advance(self, what, done, total):
        self.steps.append((what, done, total))


def test_work_is_announced_before_it_starts():
    recorder = Recorder()
    with listening(recorder):
        sf.predict(sf.load_scenario(architecture="cyclic", steps=6), [0.5], method="general")
    ((number, graphs),) = recorder.told
    assert number == 2**18
    assert 1000 < graphs < 3000  # 1376 in the end
    assert recorder.steps[-1][1] == recorder.steps[-1][2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "settings", "message"),
    [
        ({"steps": 4}, {"max_graphs": 20}, r"1.68e\+07 outcomes make about \d+ different graphs, more than --max-graphs 20: raise it, leave the least likely out with --prune, or use --method optimal or --method monte-carlo"),
        ({"steps": 9}, {}, r"1.8e\+16 outcomes make about \d+ different graphs, more than --max-graphs 100000"),
        ({"agents": 6, "steps": 2}, {}, r"one exchange of 6 agents has 1.07e\+09 outcomes, .*too many to list"),
        ({"agents": 5, "steps": 3}, {}, r"one exchange of 5 agents has 1.05e\+06 outcomes, .*too many to list"),
        ({"agents": 20, "steps": 1}, {}, "one exchange of 20 agents, ad-hoc, has 2.380 outcomes, too many to go through: use --method"),
        ({"agents": 100_000, "steps": 1}, {"prune": True}, "one exchange of 100000 agents, ad-hoc, has 2.9999900000 outcomes"),
        ({"steps": 4}, {"max_graphs": 1, "prune": True}, "--max-graphs 1: too few to keep an outcome for every row"),
    ],
)  # fmt: skip
def test_too_much_is_refused_with_the_alternatives(network, settings, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict(sf.load_scenario(**network), [0.0, 1.0], method="general", **settings)


def test_exactly_as_many_graphs_as_are_allowed():
    assert sf.predict(sf.load_scenario(steps=3), [0.5], method="general", max_graphs=15).nature == "exact"
    with pytest.raises(sf.UsageError, match="about 15 different graphs, more than --max-graphs 14"):
        sf.predict(sf.load_scenario(steps=3), [0.5], method="general", max_graphs=14)


def test_many_agents_of_whom_few_are_linked():
    """The linked ones as if they were alone, the others as if they heard nobody."""
    link = np.zeros((45, 45))
    link[:4, :4] = [[0, 0.3, 0, 0.8], [0, 0, 0.6, 0], [0.5, 0, 0, 0], [0, 0.2, 0, 0]]
    many, few = (
        sf.predict(sf.load_scenario(agents=n, steps=3), [link[:n, :n]], method="general").by_group for n in (45, 4)
    )
    np.testing.assert_allclose(many[:, :, :4], few, rtol=1e-12)
    alone = sf.predict(sf.load_scenario(agents=1, steps=3), method="general").by_group
    np.testing.assert_allclose(many[0, :, 4], alone[0, :, 0], rtol=1e-12)


def test_more_than_seven_agents():
    """Too many to look for relabellings, and alike all the same; step 1 in closed form."""
    p = sf.predict(sf.load_scenario(agents=9, steps=1), [0.3], method="general")
    assert p.alike
    assert p.values()[0, 0] == pytest.approx(100 * (1 - 0.7**9) / (9 * 0.3), rel=1e-13)
    ring, few = (
        sf.predict(sf.load_scenario(agents=n, steps=2, architecture="cyclic"), [0.5], method="general") for n in (8, 5)
    )
    np.testing.assert_allclose(ring.values(), few.values(), rtol=1e-13)  # two steps do not reach around either ring


@pytest.mark.parametrize(
    ("P0", "R", "Q", "steps"),
    [
        (1e9, 1e-9, 0, 3),
        (1e9, 1e-10, 0, 3),
        (1e6, 1e-10, 0, 6),
        (1e8, 1e-8, 1e-8, 4),
        (1e10, 1e-10, 0, 3),
        (1e-9, 1e9, 1, 4),
    ],
)
@pytest.mark.parametrize("link", [0.0, 0.4, 1.0])
def test_ill_conditioned_matrix_models(P0, R, Q, steps, link):
    """Two agents with a constant-velocity model, against the plain enumeration in 60 digits, entrywise."""
    F, H = [[1, 1], [0, 1]], [[1, 0]]
    source = strategies.mapping(F, np.eye(2) * Q, H, R, P0 * np.eye(2), 2, steps, link=link)
    got = sf.predict(sf.Scenario.from_mapping(source), method="general").covariance[0]
    if link in (0.0, 1.0):
        expected = textbook.simplified_mpmath(F, np.eye(2) * Q, H, R, P0 * np.eye(2), 2, link, steps)
        assert textbook.scaled_error(got, expected) < 1e-9
    else:
        plain = outcomes(sf.Scenario.from_mapping(source), link_rows(sf.Scenario.from_mapping(source)), plain=True)
        assert textbook.scaled_error(got, plain.covariance()[0, :, 0]) < 1e-7


def test_quantiles_of_values_without_probability():
    p = sf.predict(sf.load_scenario(steps=2), [0.0, 1e-7, 1 - 1e-7, 1.0], method="general")
    lowest, highest = p.statistic("quantile:0"), p.statistic("quantile:1")
    np.testing.assert_allclose(lowest[:, 1], [500 / 9, 500 / 27, 500 / 27, 700 / 33], rtol=1e-12)
    np.testing.assert_allclose(highest[:, 1], [500 / 9, 500 / 9, 500 / 9, 700 / 33], rtol=1e-12)


def test_uneven_broadcast_is_refused():
    uneven = np.array([[[0, 0.9, 0.9], [0.1, 0, 0.9], [0.1, 0.2, 0]]])
    with pytest.raises(sf.UsageError, match="expected equal probabilities in each column"):
        sf.predict(sf.load_scenario(architecture="broadcast"), uneven, method="general")


def test_a_polynomial_is_not_made_up():
    found = sf.predict(
        sf.Scenario.from_mapping(strategies.mapping(1, 25, 1, 100, 100, 3, 3, link=[0.1, 0.2, 0.3])), method="general"
    ).outcomes
    with pytest.raises(sf.UsageError, match="a polynomial in µ: expected one link probability"):
        found.covariance(np.array([0.9]))


def test_pruning_reports_what_was_left_out():
    scenario, link = sf.load_scenario(steps=4), [0.05, 0.5, 0.95]
    exact = sf.predict(scenario, link, method="general")
    pruned = sf.predict(scenario, link, method="general", max_graphs=60, prune=True)
    left_out = pruned.outcomes.left_out
    assert pruned.nature == "approximate"
    assert (left_out[:, :2] <= 1e-15).all()
    assert (left_out[:, 3] > 0).all()
    assert left_out.max() < 0.8
    assert f"outcomes of probability up to {left_out.max():.2g} (at µ = 0.5, step 4) are left out" in pruned.notes[0]
    # what is left out can shift the mean by no more than its probability times the largest covariance
    assert (np.abs(pruned.values() - exact.values()) <= left_out * exact.values().max() + 1e-10).all()
    complete = sf.predict(scenario, link, method="general", max_graphs=400, prune=True)
    assert complete.nature == "exact"
    np.testing.assert_allclose(complete.values(), exact.values(), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"P0": 0}, sf.UsageError, "initial.P: expected an invertible covariance for the Local Fusion Graph, got a singular one"),
        ({"F": 0, "Q": 0}, sf.UsageError, "expected an invertible model.F, or a model.Q that fills what it leaves out, got a singular prediction"),
    ],
)  # fmt: skip
def test_models_without_common_information(change, error, message):
    given = {"F": 1, "Q": 25, "H": 1, "R": 100, "P0": 100} | change
    source = strategies.mapping(**given, agents=2, steps=3, link=0.5)
    with pytest.raises(error, match=message):
        sf.predict(sf.Scenario.from_mapping(source), method="general")
