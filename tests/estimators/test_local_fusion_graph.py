"""The Local Fusion Graph: the thesis' worked example equation by equation, and the architectures with formulas of their own."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import ScenarioError
from stochfuse.estimators.fusion_graph import FusionGraph, History, Message, load_history
from stochfuse.report import fusion_graph as report
from stochfuse.report.plot import save
from tests.oracles import strategies, textbook


@pytest.fixture(scope="module")
def example():
    """The worked example of section 2.4 with a random matrix model: the graph, its estimates, and the textbook's."""
    rng = np.random.default_rng(24)
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    records = rng.normal(size=(4, 3, 1, 1))
    history = load_history()
    per_step = [set() for _ in range(4)]
    for m in history.messages:
        per_step[m.arrives - 1].add((m.sender - 1, m.receiver - 1, m.sent))
    oracle = textbook.FusionNetwork(F, Q, [(H, R)] * 3, P0, np.zeros((2, 1)), records, per_step)
    graph = FusionGraph(history)
    scenario = sf.Scenario.from_mapping(strategies.mapping(F, Q, H, R, P0, agents=3, steps=4))
    return graph, graph.estimates(scenario, records[..., 0]), oracle


def phi(oracle, *nodes, at):
    """Sum of local information, each brought forward by itself: the Φ(I)_k of the thesis."""
    return [
        sum(part) for part in zip(*(oracle.graph.bring(oracle.locals[i - 1, k], k, at) for i, k in nodes), strict=True)
    ]


def bring(oracle, pair, since, until):
    return oracle.graph.bring(tuple(pair), since, until)


def combine(*signed):
    return [sum(sign * pair[part] for sign, pair in signed) for part in (0, 1)]


def the_thesis(oracle):
    """Information pairs of every fused estimate, written down from equations (12)–(20)."""
    fused = {
        (i, 1): phi(oracle, *nodes, at=1)
        for i, nodes in {1: [(1, 1), (2, 1)], 2: [(2, 1), (3, 1)], 3: [(3, 1), (2, 1)]}.items()
    }
    two_one = bring(oracle, phi(oracle, (2, 1), at=1), 1, 2)
    fused[1, 2] = fused[3, 2] = combine((1, phi(oracle, (1, 2), (3, 2), at=2)), (-1, two_one))  # (12)
    fused[2, 2] = phi(oracle, (2, 2), at=2)
    both_one = phi(oracle, (2, 1), (3, 1), at=1)  # (14), the fused estimate of agent 2 at k1
    fused[1, 3] = combine((1, phi(oracle, (1, 3), (2, 2), at=3)), (-1, bring(oracle, both_one, 1, 3)))  # (13), (15)
    pair_13 = bring(oracle, combine((1, phi(oracle, (1, 2), (3, 2), at=2)), (-1, two_one)), 2, 3)
    pair_12 = pair_23 = triple = bring(oracle, both_one, 1, 3)
    fused[2, 3] = fused[3, 3] = combine(  # (16)
        (1, phi(oracle, (1, 3), (2, 3), (3, 3), at=3)), (-1, pair_12), (-1, pair_13), (-1, pair_23), (1, triple)
    )
    shared = bring(oracle, fused[1, 3], 3, 4)  # {(1,k3), (2,k2)} fused at k3
    pair_23 = bring(oracle, fused[2, 3], 3, 4)
    fused[1, 4] = combine(  # (17)
        (1, phi(oracle, (1, 4), (2, 4), (3, 4), at=4)), (-1, shared), (-1, shared), (-1, pair_23), (1, shared)
    )
    fused[2, 4] = combine((1, phi(oracle, (2, 4), (3, 4), at=4)), (-1, pair_23))  # (18)
    late = phi(oracle, (2, 2), at=4)
    fused[3, 4] = combine(  # (19), which is (20): the late message cancels
        (1, phi(oracle, (2, 4), (3, 4), at=4)), (1, late), (-1, pair_23), (-1, late), (-1, late), (1, late)
    )
    return fused


def test_worked_example_equations_7_to_20(example):
    _, estimates, oracle = example
    for (agent, step), (y, Y) in the_thesis(oracle).items():
        P = np.linalg.inv(Y)
        np.testing.assert_allclose(estimates[agent, step].P, P, rtol=1e-11)
        np.testing.assert_allclose(estimates[agent, step].x, P @ y, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(oracle.covariance(agent - 1, step), P, rtol=1e-11)
    np.testing.assert_allclose(estimates[2, 4].P, estimates[3, 4].P, rtol=1e-13)  # (18) and (20)


@pytest.mark.parametrize(
    ("nodes", "common"),
    [
        ([(1, 2), (3, 2)], [(2, 1)]),  # figure 7, (12)
        ([(1, 3), (2, 2)], [(2, 1), (3, 1)]),  # figure 9, (13)
        ([(1, 3), (2, 3)], [(2, 1), (3, 1)]),  # figure 10
        ([(2, 3), (3, 3)], [(2, 1), (3, 1)]),
        ([(1, 3), (3, 3)], [(1, 2), (3, 2)]),
        ([(1, 3), (2, 3), (3, 3)], [(2, 1), (3, 1)]),  # figure 11
        ([(1, 4), (2, 4)], [(1, 3), (2, 2)]),  # figure 13
        ([(1, 4), (3, 4)], [(1, 3), (2, 2)]),
        ([(2, 4), (3, 4)], [(1, 3), (2, 3), (3, 3)]),
        ([(1, 4), (2, 4), (3, 4)], [(1, 3), (2, 2)]),
        ([(2, 4), (2, 2)], [(2, 2)]),  # figure 14
        ([(3, 4), (2, 2)], [(2, 2)]),
        ([(2, 4), (2, 2), (3, 4)], [(2, 2)]),
        ([(1, 1), (3, 1)], []),
    ],
)
def test_common_sets_of_the_worked_example(example, nodes, common):
    assert example[0].common(nodes) == tuple(common)


def test_information_graph_of_figure_2_equations_4_to_8():
    """Cyclic pattern of figure 2: what agents 1 and 2 have in common at k4 is {(1,k2), (2,k3)}, and of those {(1,k1), (2,k1)}."""
    messages = tuple(Message(j, i, k, k) for k in range(1, 5) for i, j in ((1, 2), (2, 3), (3, 1)))
    graph = FusionGraph(History(3, 4, messages))
    assert graph.common([(1, 4), (2, 4)]) == ((2, 3), (1, 2))
    assert graph.common([(1, 2), (2, 3)]) == ((1, 1), (2, 1))  # (7)
    removed = [t for t in graph.explain(1, 4).terms if t.shared_by]
    assert [(t.coefficient, t.nodes, t.since, t.until) for t in removed] == [(-1, ((2, 3), (1, 2)), 3, 4)]  # (8)
    parts = {(p.coefficient, p.nodes, p.since, p.until) for p in removed[0].parts}
    assert parts == {(1, ((1, 2),), 2, 3), (1, ((2, 3),), 3, 3), (-1, ((1, 1), (2, 1)), 1, 3)}  # (8), (10)


def test_an_explanation_says_what_was_removed_with_which_sign_from_when(example):
    explained = example[0].explain(3, 4)
    assert explained.fused == ((2, 4), (3, 4))
    assert explained.superseded == ((2, 2),)
    own, other, removed = explained.terms
    assert (own.coefficient, own.nodes, other.coefficient, other.nodes) == (1, ((2, 4),), 1, ((3, 4),))
    assert (removed.coefficient, removed.nodes) == (-1, ((1, 3), (2, 3), (3, 3)))
    assert (removed.since, removed.until) == (3, 4)
    assert removed.shared_by == (((2, 4), (3, 4)),)
    text = report.to_text([explained])
    assert "  (2,k2) arrived too, but was known already: it changes nothing" in text
    assert (
        "  - {(1,k3), (2,k3), (3,k3)} fused at k3 and brought forward from k3 to k4; common to {(2,k4), (3,k4)}" in text
    )


def test_every_explanation_adds_up_to_the_estimate(example):
    """Evaluate the terms recursively with the textbook's local estimates."""
    graph, estimates, oracle = example

    def value(terms, at):
        total = 0.0
        for term in terms:
            pair = (
                value(term.parts, term.since) if term.parts else oracle.locals[term.nodes[0][0] - 1, term.nodes[0][1]]
            )
            total = total + term.coefficient * np.hstack(
                bring(oracle, [np.atleast_2d(p) for p in _split(pair)], term.since, at)
            )
        return total

    def _split(pair):
        return (pair[:, :1], pair[:, 1:]) if isinstance(pair, np.ndarray) else pair

    for agent, step in itertools.product((1, 2, 3), (1, 2, 3, 4)):
        y, Y = _split(value(graph.explain(agent, step).terms, step))
        np.testing.assert_allclose(np.linalg.inv(Y), estimates[agent, step].P, rtol=1e-11)
        np.testing.assert_allclose(np.linalg.solve(Y, y), estimates[agent, step].x, rtol=1e-9, atol=1e-12)


def complete(agents, steps, senders):
    return History(
        agents,
        steps,
        tuple(Message(j, i, k, k) for k in range(1, steps + 1) for i in range(1, agents + 1) for j in senders(i)),
    )


def network(kind, agents, steps):
    if kind == "broadcast":
        return complete(agents, steps, lambda i: [j for j in range(1, agents + 1) if j != i])
    if kind == "cyclic":
        return complete(agents, steps, lambda i: [i % agents + 1])
    return complete(agents, steps, lambda i: [])


@pytest.mark.parametrize(
    ("kind", "agents"),
    [(kind, n) for kind in ("broadcast", "stand-alone") for n in (2, 3, 4)]
    + [("cyclic", 3)],  # (34) is for rings of three
)
def test_full_rate_architectures_match_their_own_formulas(kind, agents):
    """Broadcast (28)–(31), cyclic (32)–(38), stand-alone Kalman filters: covariance and state of unlike agents."""
    rng, steps = np.random.default_rng(0), 6
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    sensors = [(H * (1 + 0.1 * i), R * (1 + i)) for i in range(agents)]
    records, x0 = rng.normal(size=(steps, agents, 1, 1)), rng.normal(size=(2, 1))
    source = strategies.mapping(F, Q, H, R, P0, agents=agents, steps=steps)
    source["agent"] = [{"H": h.tolist(), "R": r.tolist()} for h, r in sensors]
    source["initial"]["x"] = x0[:, 0].tolist()
    estimates = FusionGraph(network(kind, agents, steps)).estimates(sf.Scenario.from_mapping(source), records[..., 0])
    expected = getattr(textbook, f"full_rate_{kind.replace('-', '_')}")(F, Q, sensors, P0, x0, records)
    for (agent, step), estimate in estimates.items():
        x, P = expected[agent - 1, step]
        np.testing.assert_allclose(estimate.P, P, rtol=1e-9)
        np.testing.assert_allclose(estimate.x, x, rtol=1e-8, atol=1e-10)


def test_indefinite_claims_are_refused():
    """In several dimensions the rules of appendix A can take more for common than there is; the textbook agrees."""
    rng, steps = np.random.default_rng(3), 5
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    sensors = [(H * (1 + 0.1 * i), R * (1 + i)) for i in range(3)]
    oracle = textbook.FusionNetwork(
        F,
        Q,
        sensors,
        P0,
        np.zeros((2, 1)),
        np.zeros((steps, 3, 1, 1)),
        [{((i + 1) % 3, i, k) for i in range(3)} for k in range(1, 6)],
    )
    assert np.linalg.eigvalsh(oracle.covariance(0, 5))[0] < -1
    source = strategies.mapping(F, Q, H, R, P0, agents=3, steps=steps, architecture="cyclic", link=1)
    source["agent"] = [{"H": h.tolist(), "R": r.tolist()} for h, r in sensors]
    scenario = sf.Scenario.from_mapping(source)
    message = "at step 5 the information claimed in some outcome is not positive definite"
    with pytest.raises(sf.NoAnswerError, match=message):
        FusionGraph(network("cyclic", 3, steps)).estimates(scenario)
    for method in ("general", "monte-carlo"):
        with pytest.raises(sf.NoAnswerError, match=message):
            sf.predict(scenario, method=method, runs=10)


def test_shared_start_is_a_common_ancestor_of_everything():
    graph = FusionGraph(network("broadcast", 3, 3), shared=True)
    assert graph.common([(1, 1), (2, 1)]) == ((0, 1),)
    estimates = graph.estimates(sf.load_scenario(agents=3, steps=3))
    assert estimates[1, 1].P.item() == pytest.approx(100, rel=1e-14)
    source = {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100, "correlation": "shared"}}
    source["network"] = {"agents": 3, "steps": 3, "link": 1}
    shared = sf.predict(sf.Scenario.from_mapping(source)).values()[0]  # at µ = 1 (54) is broadcast fusion
    np.testing.assert_allclose([estimates[2, k].P.item() for k in (1, 2, 3)], shared, rtol=1e-13)


def test_double_counting():
    """Common prior 1 and one unit measurement each: naively fused 1/4 is claimed, rightly 1/3."""
    source = {"model": {"F": 1, "H": 1, "Q": 0, "R": 1}, "initial": {"P": 1, "correlation": "shared"}}
    source["network"] = {"agents": 2, "steps": 2, "link": [0, 1]}
    scenario = sf.Scenario.from_mapping(source)
    assert sf.predict(scenario, method="naive").values()[0, 1] == pytest.approx(1 / 4, rel=1e-14)
    assert sf.predict(scenario, method="general").values()[0, 1] == pytest.approx(1 / 3, rel=1e-14)


def test_dot_and_json_name_every_node_and_edge(example):
    graph = example[0]
    dot = report.to_dot(graph, graph.explain(3, 4))
    edges = json.loads(json.dumps(report.to_mapping(graph, [], None)))["edges"]
    assert [[2, 2], [1, 4]] in edges
    assert dot.count("->") == len([e for e in edges if e[1] != [1, 4]]) + 3  # two into the fusion in time, one late
    assert "n2_2 -> fused [style=dashed];" in dot
    assert dot.count('fillcolor="#f4b183"') == 3
    assert "n1_4" not in dot  # agent 1's last estimate is not in agent 3's pedigree


def test_a_graph_explains_and_draws_itself(example):
    graph = example[0]
    assert graph.text(1, 4) == report.to_text([graph.explain(1, 4)])
    title = graph.plot(agent=1, step=4).axes[0].get_title()
    assert title == "Local fusion graph of agent 1 after step 4"


def test_a_history_may_be_a_mapping():
    given = {"agents": 2, "steps": 1, "message": [{"from": 2, "to": 1, "sent": 1}]}
    assert load_history(given).messages == (Message(2, 1, 1, 1),)
    with pytest.raises(ScenarioError, match="agents: expected a whole number of at least 1, got nothing"):
        load_history({"steps": 1})


def test_figure_of_a_graph(example, tmp_path):
    graph = example[0]
    figure = report.draw(graph, graph.explain(1, 4))
    texts = {t.get_text() for t in figure.axes[0].texts}
    assert {"1,1", "2,2", "3,4", "1,4f"} <= texts
    save(lambda: figure, tmp_path / "graph.svg")
    assert "<svg" in (tmp_path / "graph.svg").read_text()


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({"steps": 2}, "agents: expected a whole number of at least 1, got nothing"),
        ({"agents": 2, "steps": 0}, "steps: expected a whole number of at least 1, got 0"),
        ({"agents": 2, "steps": 2, "message": [{"from": 1, "to": 2}]}, r"message\[1\].sent: expected a whole number, got nothing"),
        ({"agents": 2, "steps": 2, "message": [{"from": 1, "to": 3, "sent": 1}]}, r"message\[1\].to: expected a whole number from 1 to 2, got 3"),
        ({"agents": 2, "steps": 2, "message": [{"from": 1, "to": 1, "sent": 1}]}, r"message\[1\].to: expected another agent than the sender, got 1"),
        ({"agents": 2, "steps": 2, "message": [{"from": 1, "to": 2, "sent": 2, "arrives": 1}]}, r"arrives: expected a step from 2 on, when it is sent, got 1"),
        ({"agents": 2, "steps": 2, "message": [{"from": 1, "to": 2, "sent": 1, "when": 1}]}, r"message\[1\].when: expected one of from, to, sent, arrives"),
        ({"agents": 2, "steps": 2, "message": 7}, "message: expected a list of messages"),
        ({"agents": 2, "steps": 2, "message": [7]}, r"message\[1\]: expected a table"),
        ({"agents": 2, "steps": 2, "colour": 7}, "colour: expected one of schema, agents, steps, message"),
        ({"agents": 2, "steps": 2, "schema": "x"}, "schema: expected \"stochfuse.history/1\", got 'x'"),
        ({"agents": 10_000, "steps": 10_000}, "agents and steps: expected at most 2000 nodes"),
    ],
)  # fmt: skip
def test_bad_histories(source, message):
    with pytest.raises(sf.ScenarioError, match=message):
        History.from_mapping(source)


def test_a_graph_needs_agents_that_track_one_state():
    graph = FusionGraph(load_history("thesis-example"))
    parallel = sf.load_scenario("parallel-filters", agents=3, steps=4, uniform_link=True)
    with pytest.raises(
        sf.UsageError, match=r"estimator local-fusion-graph: expected one model for all agents, got par"
    ):
        graph.estimates(parallel)


def test_requests_outside_a_history(example):
    graph = example[0]
    with pytest.raises(sf.UsageError, match="agent: expected a whole number from 1 to 3, got 4"):
        graph.explain(4, 1)
    with pytest.raises(sf.UsageError, match="step: expected a whole number from 1 to 4, got 9"):
        graph.explain(1, 9)
    with pytest.raises(sf.UsageError, match="scenario: expected 3 agents and at least 4 steps, got 2 and 5"):
        graph.estimates(sf.load_scenario(agents=2))
    with pytest.raises(
        sf.UsageError, match=r"measurements: expected shape \(steps, agents, p\) = \(4, 3, p\), got \(4,\)"
    ):
        graph.estimates(sf.load_scenario(), np.zeros(4))
    with pytest.raises(sf.ScenarioError, match="no history of that name"):
        load_history("nothing-like-it")
