"""Message load: against pedigrees kept as plain sets, over every history and sampled, and against table 3."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from itertools import product
from math import comb
from time import perf_counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import stochfuse as sf
from stochfuse.cli.app import app
from stochfuse.kalman.metrics import metric
from stochfuse.questions.messages import accuracy, in_bytes, like_agents, message_load, node_bytes
from stochfuse.report import messages as reports
from stochfuse.report.plot import save
from stochfuse.scenario.network import uniform_rows
from stochfuse.scenario.scenario import link_rows
from stochfuse.thesis.bench import ARCHITECTURES, TABLE_3, Bench
from tests.oracles.strategies import probabilities
from tests.oracles.textbook import histories

UNEQUAL = [[0, 0.3, 0], [0.6, 0, 0.8], [0, 0.5, 0]]
SUBNETS = [[0, 0.9, 0.4], [0.9, 0, 0.4], [0.5, 0.5, 0]]
BROADCAST = [[0, 0.3, 0.8], [0.6, 0, 0.8], [0.6, 0.3, 0]]


def scenario(architecture="ad-hoc", agents=3, steps=12, **network):
    mapping = sf.load_scenario().to_mapping()
    mapping["network"] = {"agents": agents, "steps": steps, "architecture": architecture, **network}
    return sf.Scenario.from_mapping(mapping)


def new_nodes(n, history):
    """Numbers of new nodes [step][agent], pedigrees as sets of (agent, step)."""
    pedigree = [set() for _ in range(n)]
    out = []
    for k, messages in enumerate(history, start=1):
        for i in range(n):
            pedigree[i].add((i, k))
        after = [set(nodes) for nodes in pedigree]
        for sender, receiver, _ in messages:
            after[receiver] |= pedigree[sender]
        out.append([len(after[i] - pedigree[i]) for i in range(n)])
        pedigree = after
    return out


def every_history(n, steps, architecture, link):
    """Distribution of the load of both rules, (rule, steps, agents, sizes)."""
    out = np.zeros((2, steps, n, (n - 1) * steps + 1))
    for probability, history in histories(n, steps, architecture, link):
        for k, (messages, loads) in enumerate(zip(history, new_nodes(n, history), strict=True)):
            for i, load in enumerate(loads):
                out[0, k, i, load] += probability
                out[1, k, i, sum(receiver == i for _, receiver, _ in messages)] += probability
    return out


@pytest.mark.parametrize(
    ("architecture", "n", "steps", "link"),
    [
        ("ad-hoc", 2, 5, 0.3),
        ("ad-hoc", 3, 2, 0.6),
        ("ad-hoc", 3, 3, UNEQUAL),
        ("ad-hoc", 3, 2, SUBNETS),
        ("ad-hoc", 3, 2, [[[0, 0.1, 0.9], [0.2, 0, 1.0], [0.4, 0.6, 0]], UNEQUAL]),
        ("ad-hoc", 3, 2, [0.2, 0.7]),
        ("broadcast", 3, 4, 0.4),
        ("broadcast", 3, 4, BROADCAST),
        ("broadcast", 4, 3, 0.25),
        ("cyclic", 3, 4, 0.4),
        ("cyclic", 4, 3, 0.75),
        ("cyclic", 3, 3, [[[0, p, 0], [0, 0, 0.5], [p / 2, 0, 0]] for p in (0.9, 0.3, 0.6)]),
    ],
)
def test_every_history(architecture, n, steps, link):
    given = scenario(architecture, n, steps, link=link)
    array = np.asarray(link, dtype=float)
    matrix = array[:, None, None] if array.ndim == 1 else array
    expected = every_history(n, steps, architecture, np.broadcast_to(matrix, (steps, n, n)))
    for rule, by_agent in zip(("local-fusion-graph", "naive"), expected, strict=True):
        load = message_load(given, rule=rule)
        assert load.nature == "exact"
        for i in range(n):
            found = load.by_step(i + 1)[0]
            np.testing.assert_allclose(found, by_agent[:, i, : found.shape[1]], atol=1e-14)
            assert by_agent[:, i, found.shape[1] :].sum() == 0
        np.testing.assert_allclose(load.by_step()[0], by_agent.mean(axis=1)[:, : found.shape[1]], atol=1e-14)


def forward_chain(n, steps, link):
    """Load distributions [step][size] of agent 1, ad hoc, by the joint chain of who knows which latest node."""
    states = {tuple(tuple(0 for _ in range(n)) for _ in range(n)): 1.0}
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    out = []
    for k in range(1, steps + 1):
        following, loads = defaultdict(float), defaultdict(float)
        for state, weight in states.items():
            known = [[k if i == j else state[i][j] for j in range(n)] for i in range(n)]
            for arrived in product([False, True], repeat=len(pairs)):
                after = [list(row) for row in known]
                p = weight
                for (i, j), came in zip(pairs, arrived, strict=True):
                    p *= link if came else 1 - link
                    if came:
                        after[i] = [max(a, b) for a, b in zip(after[i], known[j], strict=True)]
                following[tuple(map(tuple, after))] += p
                loads[sum(after[0]) - sum(known[0])] += p
        states = following
        out.append(loads)
    return out


@pytest.mark.slow
def test_the_backward_walk_is_the_joint_chain():
    expected = forward_chain(3, 4, 0.35)
    found = message_load(scenario(steps=4), 0.35).by_step()[0]
    for k, loads in enumerate(expected):
        np.testing.assert_allclose(found[k], [loads[size] for size in range(9)], atol=1e-13)


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
def test_simulated_pedigrees(architecture):
    """Three agents, twelve steps, by a simulator of its own; all moments within four standard errors."""
    rng, n, steps, runs, link = np.random.default_rng(7), 3, 12, 1500, 0.25
    drawn = np.empty((runs, steps, n))
    for run in range(runs):
        if architecture == "cyclic":
            history = [{((i + 1) % n, i, k) for i in range(n) if rng.random() < link} for k in range(steps)]
        elif architecture == "broadcast":
            history = [
                {(j, i, k) for j in range(n) if rng.random() < link for i in range(n) if i != j} for k in range(steps)
            ]
        else:
            history = [
                {(j, i, k) for j in range(n) for i in range(n) if i != j and rng.random() < link} for k in range(steps)
            ]
        drawn[run] = new_nodes(n, history)
    load = message_load(scenario(architecture), link).between(6, 12)
    seen = drawn[:, 5:]
    for values, exact in (
        (seen, load.mean()),
        (seen**2, load.mean() ** 2 + load.std() ** 2),
        *((seen <= size, load.cdf()[:, size]) for size in (0, 1, 2, 4, 8, 12)),
    ):
        by_run = values.mean(axis=(1, 2))
        assert abs(by_run.mean() - exact[0]) < 4 * by_run.std(ddof=1) / np.sqrt(runs)


@given(st.integers(1, 9), probabilities, st.sampled_from(["ad-hoc", "broadcast"]))
@settings(deadline=None, max_examples=40)
def test_first_step_is_binomial(n, link, architecture):
    """(40) and, of the Local Fusion Graph at every step, (41)."""
    given = scenario(architecture, n, 4)
    first = [comb(n - 1, m) * link**m * (1 - link) ** (n - 1 - m) for m in range(n)]
    for rule in ("local-fusion-graph", "naive"):
        load = message_load(given, link, rule)
        np.testing.assert_allclose(load.by_step()[0, 0, :n], first, atol=1e-12)
        np.testing.assert_allclose(load.by_step()[0, :, 0], (1 - link) ** (n - 1), atol=1e-12)
    np.testing.assert_allclose(load.mean(), (n - 1) * link, atol=1e-12)  # naive
    assert load.maximum()[0] <= n - 1


@given(st.integers(2, 6), st.lists(probabilities, min_size=1, max_size=4), st.sampled_from(ARCHITECTURES))
@settings(deadline=None, max_examples=40)
def test_invariants(n, link, architecture):
    load = message_load(scenario(architecture, n, 6), link)
    np.testing.assert_allclose(load.probabilities.sum(axis=-1), 1.0, atol=1e-12)
    assert (load.probabilities >= 0).all()
    assert (np.diff(load.cdf(), axis=1) >= 0).all()
    assert (load.mean() <= n - 1 + 1e-12).all()  # nobody can learn more than there is
    for p in (0.0, 0.3, 0.9, 1.0):
        q = load.quantile(p)
        assert (np.take_along_axis(load.cdf(), q[:, None], axis=1)[:, 0] >= p - 1e-12).all()
        below = np.take_along_axis(load.cdf(), np.maximum(q - 1, 0)[:, None], axis=1)[:, 0]
        assert ((below < p) | (q == 0)).all()


def known_in_all(architecture, n, steps, link):
    """Expected number of nodes of others that an agent knows in the end: Σ_t (E[r_t] − 1), handbook: contact chain."""
    distribution, total = {1: 1.0}, 0.0
    for _ in range(steps):
        following = defaultdict(float)
        for r, weight in distribution.items():
            if architecture == "cyclic":
                following[r] += weight * (1 - link if r < n else 1)
                following[min(r + 1, n)] += weight * (link if r < n else 0)
                continue
            joins = 1 - (1 - link) ** r if architecture == "ad-hoc" else link
            for m in range(n - r + 1):
                following[r + m] += weight * comb(n - r, m) * joins**m * (1 - joins) ** (n - r - m)
        distribution = following
        total += sum(weight * (r - 1) for r, weight in distribution.items())
    return total


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize(("n", "steps"), [(6, 9), (25, 6)])
def test_loads_add_up_to_what_is_known(architecture, n, steps):
    """All that was ever learnt is what is known in the end, by the contact chain."""
    link = [0.1, 0.5, 0.9]
    load = message_load(scenario(architecture, n, steps), link)
    known = [known_in_all(architecture, n, steps, µ) for µ in link]
    np.testing.assert_allclose(steps * load.mean(), known, rtol=1e-12)


def test_limits():
    for architecture, first in (("ad-hoc", [2, 2, 2]), ("broadcast", [2, 2, 2]), ("cyclic", [1, 2, 2])):
        load = message_load(scenario(architecture, 3, 3), [0.0, 1.0])
        assert load.maximum().tolist() == [0, 2]
        np.testing.assert_array_equal(load.by_step() @ load.sizes, [[0, 0, 0], first])
        steady = load.between(2, 3)
        assert steady.mean().tolist() == [0, 2]
        assert steady.std().tolist() == [0, 0]
    alone = message_load(scenario(agents=1), 0.5)
    assert alone.mean().tolist() == [0]
    possible = {"ad-hoc": 24, "broadcast": 24, "cyclic": 23}
    for architecture, most in possible.items():
        assert message_load(scenario(architecture), 0.01).maximum().tolist() == [most]


def test_relabelled_agents():
    rng = np.random.default_rng(3)
    link, order = rng.random((4, 4)), np.array([2, 0, 3, 1])
    load = message_load(scenario(agents=4, steps=4), [link])
    moved = message_load(scenario(agents=4, steps=4), [link[order][:, order]])
    for new, old in enumerate(order):
        np.testing.assert_allclose(moved.by_step(new + 1), load.by_step(int(old) + 1), atol=1e-13)


def test_agents_that_are_alike_are_told_together():
    """One group of many, classes of a few and everyone by itself give the same numbers."""
    n = 5
    same = message_load(scenario(agents=n, steps=5), 0.3)
    as_matrix = message_load(scenario(agents=n, steps=5), [np.full((n, n), 0.3)])
    np.testing.assert_allclose(as_matrix.by_step(), same.by_step(), atol=1e-13)
    subnets = np.full((n, n), 0.4)
    subnets[:3, :3] = 0.9
    given = scenario(agents=n, steps=5)
    rows = link_rows(given, [subnets])
    assert like_agents(given.network, rows) == [[0, 1, 2], [3, 4]]
    assert like_agents(given.network, rows, aside=1) == [[0, 2], [3, 4]]
    apart = subnets + 1e-9 * np.arange(n * n).reshape(n, n)
    assert len(like_agents(given.network, link_rows(given, [apart]))) == n
    for agent in (1, 4):
        np.testing.assert_allclose(
            message_load(given, [subnets]).by_step(agent), message_load(given, [apart]).by_step(agent), atol=1e-6
        )
    ring = scenario("cyclic", 4)
    assert like_agents(ring.network, uniform_rows([0.5])) == [[0, 1, 2, 3]]
    assert like_agents(ring.network, uniform_rows([0.5]), aside=0) == [[1], [2], [3]]


def test_sampled_loads():
    given = scenario("ad-hoc", 4, 6)
    link = [0.0, 0.2, 0.6]
    exact, drawn = message_load(given, link), message_load(given, link, method="monte-carlo", runs=900, seed=5)
    assert drawn.nature == "sampled"
    for window in ((1, 6), (3, 3)):
        one, other = exact.between(*window), drawn.between(*window)
        error = other.standard_error()
        assert error[0] == 0
        assert (abs(other.mean() - one.mean()) <= 4 * error).all()
        assert (error[1:] < 0.1).all()
    np.testing.assert_allclose(drawn.sample.mean(axis=(1, 2, 3)), drawn.mean(), rtol=1e-12)
    assert (drawn.maximum() <= exact.maximum()).all()
    again = message_load(given, link[1:], method="monte-carlo", runs=900, seed=5)
    np.testing.assert_array_equal(again.sample, drawn.sample[1:])  # a row does not depend on the others
    assert (message_load(given, 0.2, method="monte-carlo", seed=6).sample != again.sample[:1, :1]).any()
    naive = message_load(given, link, "naive", method="monte-carlo")
    assert naive.nature == "exact"
    assert naive.standard_error() is None
    mixed = message_load(scenario("broadcast", 3, 5), [BROADCAST], method="monte-carlo", runs=2000)
    one = message_load(scenario("broadcast", 3, 5), [BROADCAST])
    for agent in (1, 2, 3):
        assert abs(mixed.mean(agent) - one.mean(agent)) < 4 * mixed.standard_error(agent)


def test_table_3():
    """The published values within what the module says of them."""
    bench = Bench()
    assert set(TABLE_3) == set(ARCHITECTURES)
    for column, published in TABLE_3.items():
        broadcast = "broadcast" if column == "ad-hoc" else column
        needed, stated = bench.table_3(broadcast, (6, 12)), bench.table_3(column, (6, 10))
        assert needed.shape == published.shape == (5, 3)
        within = {"ad-hoc": (0.01, 0.015), "broadcast": (0.01, 0.01), "cyclic": (0.065, 0.075)}[column]
        np.testing.assert_allclose(published[:, 0], needed[:, 0], rtol=within[0])
        np.testing.assert_allclose(published[:, 2], needed[:, 2], rtol=within[1], atol=1e-12)
        assert (needed[:, 1] >= published[:, 1]).all()
        assert stated[1, 1] < published[1, 1]  # at 25 % the steps that the thesis states are too few for its maxima
    # what the ad hoc column is called does not fit
    ours, theirs = bench.table_3("ad-hoc", (6, 12))[1:4, 2], TABLE_3["ad-hoc"][1:4, 2]
    assert (abs(ours / theirs - 1) > 0.07).all()


def test_statements_of_the_thesis():
    """Naive load below 30 % of the Local Fusion Graph's at 25 %, about 75 % at 75 %; 3 nodes suffice for 90 %."""
    given = scenario("broadcast")
    load = message_load(given, [0.25, 0.75]).between(6, 12)
    ratio = message_load(given, [0.25, 0.75], "naive").between(6, 12).mean() / load.mean()
    assert ratio[0] < 0.3
    assert ratio[1] == pytest.approx(0.75, abs=0.01)
    assert load.cdf()[1, 3] == pytest.approx(0.9, abs=0.02)
    assert load.quantile(0.9)[1] == 3


def test_three_agents_twelve_steps_take_no_second():
    start = perf_counter()
    load = message_load(scenario(), np.linspace(0, 1, 101))
    assert perf_counter() - start < 1.0
    assert load.probabilities.shape == (101, 12, 1, 25)


def test_subnets_of_eight_and_two():
    load = message_load(sf.load_scenario("fcs-demo"))
    assert load.group_of.tolist() == [0] * 8 + [1] * 2
    drawn = message_load(sf.load_scenario("fcs-demo"), method="monte-carlo", runs=300)
    for agent in (1, 10):
        assert (abs(load.mean(agent) - drawn.mean(agent)) <= 4 * drawn.standard_error(agent) + 1e-12).all()


def test_naive_loads_of_many_agents():
    load = message_load(scenario(agents=200, steps=3), [0.0, 0.3], "naive")
    np.testing.assert_allclose(load.mean(), [0, 199 * 0.3])
    np.testing.assert_allclose(load.std(), [0, np.sqrt(199 * 0.3 * 0.7)])
    assert load.maximum().tolist() == [0, 199]


def test_bytes():
    given = sf.load_scenario("cv-2d", steps=4)
    assert node_bytes(4) == 8 * (4 + 10) + 8
    load, naive = message_load(given, [0.5, 1.0]), message_load(given, [0.5, 1.0], "naive")
    plain, headed = in_bytes(load, naive), in_bytes(load, naive, header=20)
    np.testing.assert_allclose(plain.mean, 120 * load.mean())
    np.testing.assert_allclose(headed.mean - plain.mean, 20 * 2 * np.array([0.5, 1.0]))  # two senders
    assert headed.maximum.tolist() == [8 * 120 + 40, 2 * 120 + 40]


def test_accuracy_is_averaged_over_the_same_steps():
    given, link = scenario(steps=3), [0.25, 1.0]
    m = metric("trace", given.model)
    for rule, method in (("local-fusion-graph", "general"), ("naive", "naive")):
        load = message_load(given, link, rule).between(2, 3)
        found = accuracy(load, link, metric=m)
        np.testing.assert_allclose(found.values, sf.predict(given, link, method, "actual").values()[:, 1:].mean(axis=1))
        assert found.error is None
        drawn = accuracy(load, link, metric=m, method="monte-carlo", runs=400)
        assert (abs(drawn.values - found.values) <= 4 * drawn.error + 1e-9).all()


def view(kind="moments", link=(0.25, 0.75), method="exact", header=None, given=None):
    given = given or scenario(steps=3)
    loads = tuple(message_load(given, link, rule, method=method) for rule in ("local-fusion-graph", "naive"))
    m = metric("trace", given.model)
    beside = tuple(accuracy(load, link, metric=m, method=method) for load in loads if kind == "accuracy")
    return reports.LoadView(loads, loads[1], kind, header=header, accuracies=beside, metric=m)


def test_tables():
    table = reports.load_table(view(header=10))
    assert table.title[0].startswith("Message load: nodes new to an agent in all messages of a step, each counted once")
    assert table.title[1].endswith("3 agents, ad-hoc; every agent alike; steps 1 to 3")
    assert table.title[2].endswith("; exact")
    assert "B: bytes; 24 a node" in table.title[4]
    assert table.columns[:5] == ("LFG mean", "LFG std", "LFG max", "LFG mean B", "LFG max B")
    assert table.rows[0][-5:] == ("0.50000", "0.61237", "2", "17.000", "68")
    sampled = reports.load_table(view(method="monte-carlo"))
    assert "sampled, 1,000 runs, seed 1; ± one standard error" in sampled.title[2]
    assert " ±" in sampled.rows[0][1]
    assert sampled.title[-1].endswith("the largest load drawn")
    sizes = reports.load_table(view("cdf"))
    assert sizes.keys == ("rule", "nodes")
    assert sizes.columns == ("µ = 0.25", "µ = 0.75")
    assert [row[:2] for row in sizes.rows] == [("LFG", str(m)) for m in range(7)] + [
        ("naive", str(m)) for m in range(3)
    ]
    assert reports.load_table(view("distribution")).rows[0][2:] == ("0.56250", "0.062500")
    both = reports.load_table(view("accuracy"))
    assert both.columns == ("LFG load", "LFG actual", "naive load", "naive actual")
    assert both.title[-1].endswith("averaged over steps 1 to 3")
    assert "at most one standard error" in reports.load_table(view("accuracy", method="monte-carlo")).title[-1]


def test_csv_and_json_carry_the_same():
    shown = view("distribution")
    load = shown.loads[0]
    lines = reports.load_csv(shown).splitlines()
    assert len(lines) == 1 + 2 * 7 + 2 * 3
    assert [float(line.split(",")[-2]) for line in lines[1:8]] == load.distribution()[0].tolist()
    result = json.loads(json.dumps(reports.load_json(view(header=8)), allow_nan=False))
    assert result["schema"] == "stochfuse.messages/1"
    one = result["rules"]["local-fusion-graph"]
    np.testing.assert_array_equal(one["by_step"], load.by_step())
    np.testing.assert_array_equal(one["cdf"], load.cdf())
    assert one["nature"] == "exact"
    assert one["bytes"]["node"] == 24
    moments = reports.load_csv(view()).splitlines()[1].split(",")
    assert [float(cell) for cell in moments[7:10]] == [one["mean"][0], one["std"][0], one["max"][0]]
    compared = reports.load_json(view("accuracy"))["rules"]["naive"]["accuracy"]
    assert (compared["nature"], compared["quantity"], compared["method"]) == ("exact", "actual", "naive")
    cells = reports.load_csv(view("accuracy", method="monte-carlo")).splitlines()[1].split(",")
    assert cells[12] == "monte-carlo"
    assert float(cells[-1]) > 0


@pytest.mark.parametrize("kind", reports.KINDS)
def test_figures(kind, tmp_path):
    figure = reports.draw(view(kind))
    assert len(figure.axes[0].get_legend_handles_labels()[1]) == (4 if kind in ("cdf", "distribution") else 2)
    save(reports.load_report(view(kind)).draw, tmp_path / "load.svg")
    assert (tmp_path / "load.svg").stat().st_size > 1000


def test_figure_of_cases_is_against_the_step():
    figure = reports.draw(view(given=sf.load_scenario("fcs-demo"), link=None))
    assert figure.axes[0].get_xlabel() == "step k"
    assert len(figure.axes[0].lines) == 2 * 6


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: message_load(scenario(), 0.5, "guess"),
            "rule: expected one of local-fusion-graph, naive, got 'guess'",
        ),
        (lambda: message_load(scenario(), 0.5, method="guess"), "method: expected one of exact, monte-carlo"),
        (lambda: message_load(scenario(), 0.5, runs=1), "runs: expected a whole number of at least 2, got 1"),
        (lambda: message_load(scenario(), 0.5, seed=-1), "seed: expected a whole number of at least 0, got -1"),
        (lambda: message_load(scenario(delay=1), 0.5), "network.delay: expected none for message loads"),
        (
            lambda: message_load(scenario(agents=9, steps=3), [np.random.default_rng(1).random((9, 9))]),
            "the exact walk for 9 agents passes .* states or more for each of 1 link .*: use --method monte-carlo, fewer agents",
        ),
        (lambda: message_load(scenario(agents=200), 0.5), "the exact walk for 200 agents passes 20100 states or more"),
        (
            lambda: message_load(scenario(agents=10, steps=12), 0.5, method="monte-carlo", runs=1_000_000),
            r"are 1.2e\+08 values; expected at most 1e\+08",
        ),
        (
            lambda: message_load(scenario(agents=100), 0.5, method="monte-carlo", runs=10_000),
            "runs: 10000 runs .* are 1.19e.11 updates of what an agent knows of another; expected at most 2e",
        ),
        (lambda: message_load(scenario(), 0.5).between(3, 13), "window: expected steps from 1 to 12, .*, got 3 to 13"),
        (
            lambda: message_load(scenario(), 0.5).quantile(1.5),
            "quantile: expected a probability between 0 and 1, got 1.5",
        ),
        (lambda: message_load(scenario(), 0.5).mean(4), "agent: expected mean or a number from 1 to 3, got '4'"),
        (
            lambda: in_bytes(message_load(scenario(), 0.5), message_load(scenario(), 0.5, "naive"), header=-1),
            "header: expected a number of bytes of at least 0, got -1",
        ),
        (
            lambda: accuracy(message_load(scenario(), 0.5), 0.5, max_graphs=10),
            "accuracy of local-fusion-graph: .* different graphs",
        ),
    ],
)
def test_bad_requests(call, message):
    with pytest.raises(sf.UsageError, match=message):
        call()


def run(*arguments, code=0):
    done = subprocess.run([sys.executable, "-m", "stochfuse", "messages", *arguments], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.slow
def test_command():
    done = run("--steps", "12", "--from-step", "6", "--architecture", "broadcast", "--link", "0.25,0.5")
    assert done.stderr == ""
    assert "0.25     1.8237    2.8837        24      0.50000     0.61237           2" in done.stdout
    shown = json.loads(run("--steps", "2", "--accuracy", "--header", "4", "--link", "0.5", "--format", "json").stdout)
    assert shown["meta"]["header_bytes"] == 4
    assert shown["rules"]["naive"]["accuracy"]["values"]
    sampled = run("--agents", "4", "--method", "monte-carlo", "--runs", "50", "--rule", "local-fusion-graph")
    assert "note: the maximum of a sample is no bound" in sampled.stderr
    assert "naive" not in sampled.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--step", "9"], "--step: expected a step from 1 to 5 (see --steps), got 9"),
        (["--step", "2", "--from-step", "2"], "--step: expected without --from-step"),
        (["--cdf", "--distribution"], "--cdf: expected without --distribution"),
        (["--cdf", "--bytes"], "--cdf: expected neither --bytes nor --header"),
        (["--quantity", "claimed"], "--quantity: expected --accuracy"),
        (["--runs", "9"], "--runs: expected method monte-carlo, got exact"),
        (["--agent", "worst"], "agent: expected mean or a number from 1 to 3, got 'worst'"),
    ],
)
def test_wrong_usage(arguments, message):
    done = CliRunner().invoke(app, ["messages", *arguments])
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stdout == ""
