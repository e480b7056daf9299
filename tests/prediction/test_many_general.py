"""Batches of the general formulation and of the optimum against the same scenarios one by one."""

from __future__ import annotations

import tracemalloc
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.engines import contact_chain, enumeration
from stochfuse.prediction import general, optimal
from stochfuse.prediction.quantities import matrix
from stochfuse.scenario.system import Noises
from tests.oracles import strategies
from tests.oracles.many import averaged as batch

QUANTITIES = ("claimed", "actual", "bias", "rms")
ITEMS = 5
LINK = np.array([0.0, 1.0, 0.37, 0.8, 0.05])


def source(d=1, p=1, agents=3, steps=3, shared=False, error=True, more=None, **network):
    """A scenario file's mapping, with a model that depends on the dimensions alone."""
    rng = np.random.default_rng(100 * d + p)
    made = strategies.mapping(*strategies.model(rng, d, p), agents, steps, **network)
    made["initial"] |= {"correlation": "shared"} if shared else {}
    made["initial"] |= {"error": (3 * rng.normal(size=d)).tolist()} if error else {}
    return made | (more or {})


UNLIKE = {"agent": [{"R": 0.5}, {}, {"R": 2.0}]}
CASES = {
    "scalar, ad hoc": source(architecture="ad-hoc"),
    "scalar, shared start": source(shared=True, steps=4, agents=2, architecture="ad-hoc"),
    "two states, broadcast, shared start": source(2, 1, shared=True, steps=4, architecture="broadcast"),
    "three states, cyclic": source(3, 2, agents=4, architecture="cyclic"),
    "four states, ad hoc": source(4, 2, agents=3, steps=3, architecture="ad-hoc"),
    "no initial error": source(2, 2, agents=2, steps=4, error=False, architecture="ad-hoc"),
    "delays": source(2, 1, agents=2, steps=3, architecture="ad-hoc", delay=[0.5, 0.3, 0.2]),
    "masked": source(2, 1, agents=3, steps=3, architecture="ad-hoc", hears=[[2], [1, 3], [2]]),
    "one agent": source(2, 1, agents=1, steps=3),
    "one step": source(2, 1, agents=3, steps=1, shared=True),
    "correlated noises": source(2, 1, agents=3, steps=3, architecture="broadcast", more={"noise": {"correlation": 0.4}}),
    "unlike agents": source(agents=3, steps=3, architecture="ad-hoc", more=UNLIKE),
    "F without an inverse": source(2, 1, more={}) | {"model": source(2, 1)["model"] | {"F": [[1, 1], [0, 0]]}},
}  # fmt: skip


def noises_of(made, seed=0, items=ITEMS):
    """Random noises of a scenario's dimensions; no R where sensors differ."""
    rng, model = np.random.default_rng(seed), made["model"]
    d, p = np.atleast_2d(model["F"]).shape[0], np.atleast_2d(model["H"]).shape[0]
    stack = {size: [strategies.covariance(rng, size) + 0.2 * np.eye(size) for _ in range(2 * items)] for size in {d, p}}
    Q, P0 = np.array(stack[d][:items]), np.array(stack[d][items:])
    Q[0] *= 0.0 if np.linalg.matrix_rank(model["F"]) == d else 1.0
    return Noises(Q, None if "agent" in made else rng.uniform(0.1, 5, (items, 1, 1)) * np.array(stack[p][:items]), P0)


def item(made, noises, i):
    """The scenario of one item, as a user writes it."""
    Q, R, P0 = (None if M is None else M[i].tolist() for M in noises)
    model = made["model"] | ({} if Q is None else {"Q": Q}) | ({} if R is None else {"R": R})
    initial = made["initial"] | ({} if P0 is None else {"P": P0})
    return sf.Scenario.from_mapping(made | {"model": model, "initial": initial})


def by_agent(found, quantity):
    """A batch's moment per agent, (items, steps, agents, …)."""
    return matrix(quantity, found.moments)[:, :, found.group_of]


def assert_close(got, wanted, tolerance=1e-12):
    scale = np.abs(wanted).max(axis=(-2, -1), keepdims=True)
    assert got.shape == wanted.shape
    assert (np.abs(got - wanted) <= tolerance * scale).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["general", "naive", "optimal"])
@pytest.mark.parametrize("case", CASES)
def test_a_batch_is_its_items(case, method):
    made = CASES[case]
    if case == "correlated noises" and method == "optimal":
        pytest.skip("the optimum takes independent noises only")
    scenario, noises = sf.Scenario.from_mapping(made), noises_of(made)
    plain, whole = (batch(method, scenario, LINK, noises, errors=errors) for errors in (False, True))
    assert plain.moments[1:] == (None, None, None)
    for i in range(ITEMS):
        p = sf.predict(item(made, noises, i), [LINK[i]], method, quantity="rms")
        for quantity in QUANTITIES:
            wanted = matrix(quantity, p.moments)[0][:, p.group_of]
            assert_close(by_agent(whole, quantity)[i], wanted)
        claimed = sf.predict(item(made, noises, i), [LINK[i]], method)
        assert_close(by_agent(plain, "claimed")[i], claimed.by_group[0][:, claimed.group_of])
        if method == "optimal":
            # with every link down or up a single item has fewer paths
            assert claimed.meta["paths"] <= whole.meta["paths"]
            assert not np.any(whole.meta["relative_bound"])
        elif 0 < LINK[i] < 1:  # of links that differ, a single item leaves out what cannot happen
            assert plain.meta["graphs"] == claimed.meta["graphs"]
            assert plain.meta["outcomes"] == claimed.meta["outcomes"]


def test_the_names_of_quantities_are_those_of_predict():
    made = CASES["scalar, ad hoc"]
    noises = noises_of(made)
    found = batch("general", sf.Scenario.from_mapping(made), LINK, noises, errors=True)
    for quantity in QUANTITIES:
        wanted = sf.predict(item(made, noises, 2), [LINK[2]], "general", quantity).by_group[0]
        assert_close(matrix(quantity, found.moments)[2], wanted)


@pytest.mark.parametrize("kept", [{"Q"}, {"R"}, {"P0"}, set(), {"Q", "P0"}])
@pytest.mark.parametrize("method", ["general", "optimal"])
def test_noises_that_the_scenario_has_itself(kept, method):
    made = CASES["two states, broadcast, shared start"]
    noises = Noises(**{name: M for name, M in noises_of(made)._asdict().items() if name in kept})
    found = batch(method, sf.Scenario.from_mapping(made), LINK, noises, errors=True)
    for i in range(ITEMS):
        p = sf.predict(item(made, noises, i), [LINK[i]], method, quantity="rms")
        for quantity in QUANTITIES:
            assert_close(matrix(quantity, found.moments)[i], matrix(quantity, p.moments)[0])


def test_the_best_fusion_by_outcomes():
    made = CASES["two states, broadcast, shared start"]
    noises, scenario = noises_of(made), sf.Scenario.from_mapping(made)
    found = batch("general", scenario, LINK, noises, estimator="optimal", errors=True).moments
    for quantity in QUANTITIES:
        wanted = matrix(quantity, batch("optimal", scenario, LINK, noises, errors=True).moments)
        assert_close(matrix(quantity, found), wanted, 1e-10)


def test_matrices_per_step():
    made, steps = source(2, 1, steps=3, architecture="broadcast"), 3
    rng = np.random.default_rng(4)
    for name in ("F", "Q", "H", "R"):
        M = np.array(made["model"][name])
        made["model"][name] = [(M * s).tolist() for s in rng.uniform(0.5, 1.5, steps)]
    scenario, noises = sf.Scenario.from_mapping(made), noises_of(source(2, 1))
    for some in (noises._replace(R=None), noises._replace(Q=None)):
        for method in ("general", "optimal"):
            found = batch(method, scenario, LINK, some, errors=True)
            p = sf.predict(item(made, some, 3), [LINK[3]], method, quantity="rms")
            for quantity in QUANTITIES:
                assert_close(matrix(quantity, found.moments)[3], matrix(quantity, p.moments)[0])


@given(st.permutations(range(ITEMS)), st.sampled_from(["general", "naive", "optimal"]), st.booleans())
@settings(max_examples=25, deadline=None)
def test_permuted_items_have_permuted_results(order, method, errors):
    made = CASES["two states, broadcast, shared start"]
    scenario, noises = sf.Scenario.from_mapping(made), noises_of(made)
    found = batch(method, scenario, LINK, noises, errors=errors)
    permuted = batch(method, scenario, LINK[order], noises.take(np.array(order)), errors=errors)
    for M, N in zip(found.moments, permuted.moments, strict=True):
        if M is not None:
            assert_close(N, M[order], 1e-14)


@pytest.mark.parametrize("errors", [False, True])
def test_blocks_and_repeated_noises_change_nothing(monkeypatch, errors):
    made = CASES["two states, broadcast, shared start"]
    scenario, few = sf.Scenario.from_mapping(made), noises_of(made)
    of = np.random.default_rng(1).integers(ITEMS, size=40)
    link, noises = np.random.default_rng(2).uniform(size=40), few.take(of)
    runs = [partial(batch, method, scenario, link, noises, errors=errors) for method in ("general", "optimal")]
    whole = [run() for run in runs]
    monkeypatch.setattr(general, "BLOCK", 20_000)
    monkeypatch.setattr(general, "CHUNK", 500)
    monkeypatch.setattr(optimal, "BLOCK", 200)
    monkeypatch.setattr(enumeration, "LISTED", 50)
    monkeypatch.setattr(general, "HELD", 1000)
    monkeypatch.setattr(general, "HELD", 100)
    general._kept.cache_clear()
    for run, found in zip(runs, whole, strict=True):
        for M, N in zip(found.moments, run().moments, strict=True):
            assert (M is None) == (N is None)
            if M is not None:
                assert_close(N, M, 1e-13)
    general._kept.cache_clear()
    alone = [batch("general", scenario, link[[i]], noises.take([i]), errors=errors) for i in range(0, 40, 4)]
    np.testing.assert_allclose(whole[0].rounding[::4], [a.rounding[0] for a in alone], rtol=1e-9)


@pytest.mark.parametrize("method", ["general", "naive", "optimal"])
def test_memory_is_bounded(method):
    """A table of items × items would take 3 GB."""
    made = source(agents=2, steps=3)
    scenario, items = sf.Scenario.from_mapping(made), 20_000
    noises = Noises(R=np.linspace(1, 2, items)[:, None, None])
    link = np.linspace(0, 1, items)
    batch(method, scenario, link[:2], noises.take(slice(0, 2)))
    tracemalloc.start()
    found = batch(method, scenario, link, noises)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64e6
    assert_close(found.moments.P[777], sf.predict(item(made, noises, 777), [link[777]], method).by_group[0])


def indefinite():
    """A network in which the rules of appendix A take more for common than there is, for the scenario's own noises."""
    rng = np.random.default_rng(3)
    F, Q, H, R, P0 = strategies.model(rng, 2, 1)
    made = strategies.mapping(F, Q, H, R, P0, 3, 5, architecture="cyclic")
    made["agent"] = [{"H": (H * (1 + 0.1 * i)).tolist(), "R": (R * (1 + i)).tolist()} for i in range(3)]
    return made, Noises(Q=np.array([0.1 * np.eye(2), Q]), P0=np.array([np.eye(2), P0]))


def test_an_item_without_an_answer():
    made, noises = indefinite()
    scenario, link = sf.Scenario.from_mapping(made), np.array([0.5, 0.5])
    message = "at step 5 the information claimed in some outcome is not positive definite"
    with pytest.raises(sf.NoAnswerError, match=message):
        sf.predict(item(made, noises, 1), [0.5], "general")
    with pytest.raises(sf.NoAnswerError, match=message):
        batch("general", scenario, link, noises)
    fine = batch("general", scenario, link[:1], noises.take(slice(0, 1)))
    p = sf.predict(item(made, noises, 0), [0.5], "general")
    assert_close(by_agent(fine, "claimed")[0], p.by_group[0][:, p.group_of])


def test_an_item_with_a_request_that_does_not_fit():
    made = source(2, 1, agents=2)
    scenario, noises, link = sf.Scenario.from_mapping(made), noises_of(made), LINK
    singular = noises._replace(P0=noises.P0 * np.array([1, 1, 0, 1, 1])[:, None, None])
    with pytest.raises(sf.UsageError, match=r"initial\.P: expected an invertible covariance"):
        batch("general", scenario, link, singular)
    flat = sf.Scenario.from_mapping(made | {"model": made["model"] | {"F": [[1, 1], [0, 0]]}})
    without = noises._replace(Q=noises.Q * np.array([1, 1, 0, 1, 1])[:, None, None] + np.eye(2) * [[[1], [0]]])
    without.Q[2] = 0.0
    with pytest.raises(sf.UsageError, match="the covariance predicted for step 2 is singular"):
        batch("general", flat, link, without)
    # the scenario's own covariance is of no account where every item has another
    vague = sf.Scenario.from_mapping(made | {"initial": {"P": [[0, 0], [0, 0]]}})
    np.testing.assert_array_equal(
        batch("general", vague, link, noises).moments.P, batch("general", scenario, link, noises).moments.P
    )
    with pytest.raises(sf.UsageError, match="more than --max-graphs 2"):
        batch("general", sf.load_scenario(steps=4), link, Noises(), max_graphs=2)
    with pytest.raises(sf.UsageError, match="estimator local-fusion-graph: expected agents that track one state"):
        batch("general", sf.load_scenario("cooperative-pnt"), link, Noises())
    with pytest.raises(sf.UsageError, match="the optimum: expected agents that track one state"):
        batch("optimal", sf.load_scenario("cooperative-pnt"), link, Noises())
    with pytest.raises(sf.UsageError, match="coefficients on noises, expected at most 20000"):
        batch("general", sf.load_scenario("cv-2d", steps=1000), link, Noises(), errors=True)
    with pytest.raises(sf.UsageError, match=r"1\.72e\+361 outcomes make about \d\.\d\de\+\d+ different graphs"):
        batch("general", sf.load_scenario(steps=200), link, Noises())
    correlated = sf.Scenario.from_mapping(CASES["correlated noises"])
    with pytest.raises(sf.UsageError, match="the optimum: expected independent measurement noises"):
        batch("optimal", correlated, link, noises_of(CASES["correlated noises"]))


def disturbed():
    return source(more={"noise": {"correlation": 0.2, "disturbance": np.eye(3).tolist()}})


@pytest.mark.parametrize(
    ("made", "method", "settings"),
    [
        (source(), "general", {"estimator": "covariance-intersection"}),
        (source(2, 1, agents=2), "general", {"estimator": "split-ci"}),
        (disturbed(), "general", {"errors": True}),
        (source(2, 1, agents=3, steps=5), "optimal", {}),
    ],
)
def test_what_cannot_be_side_by_side_goes_one_set_of_noises_after_the_other(made, method, settings, monkeypatch):
    if method == "optimal":
        monkeypatch.setattr(contact_chain, "MOST_PATHS", 10)
    noises = noises_of(made)
    found = batch(method, sf.Scenario.from_mapping(made), LINK, noises, **settings)
    more = {k: v for k, v in settings.items() if k != "errors"}
    p = sf.predict(item(made, noises, 3), [LINK[3]], method, "actual" if "errors" in settings else "claimed", **more)
    assert_close(by_agent(found, p.quantity if "errors" in settings else "claimed")[3], p.by_group[0][:, p.group_of])


def test_unlike_sensors_have_no_common_noise():
    scenario = sf.Scenario.from_mapping(CASES["unlike agents"])
    with pytest.raises(sf.UsageError, match="R: expected like sensors to have a noise of the item's own"):
        sf.predict_many(scenario, LINK, R=np.linspace(1, 2, ITEMS), method="general")


def test_disturbances_without_noises_of_their_own():
    made = disturbed()
    noises = noises_of(made)._replace(R=None)
    found = batch("general", sf.Scenario.from_mapping(made), LINK, noises, errors=True)
    p = sf.predict(item(made, noises, 3), [LINK[3]], "general", quantity="actual")
    assert_close(by_agent(found, "actual")[3], p.by_group[0][:, p.group_of])


def test_numbers_beyond_floating_point():
    made = source(agents=2, steps=3)
    made["model"]["F"] = 1e10
    scenario = sf.Scenario.from_mapping(made)
    noises = Noises(Q=np.array([1.0, 1e308])[:, None, None], R=np.full((2, 1, 1), 1e307), P0=np.full((2, 1, 1), 1e300))
    with np.errstate(all="ignore"):
        p = sf.predict_many(scenario, [0.5, 0.5], noises.Q, noises.R, noises.P0, method="optimal")
    assert list(p.meta["faults"]) == [0, 1]
    assert "grows beyond" in p.meta["faults"][1] or "not finite" in p.meta["faults"][1]


KINDS = [
    source(agents=2, steps=3),
    source(agents=2, steps=3, shared=True),
    source(2, 1, agents=2, steps=3),
    source(agents=3, steps=3, architecture="broadcast"),
    source(agents=3, steps=3, architecture="cyclic"),
    source(agents=3, steps=2, architecture="cyclic"),
    source(agents=2, steps=3, delay=[0.5, 0.5]),
    source(agents=3, steps=2, hears=[[2], [1], [1]]),
    source(agents=3, steps=2, hears=[[3], [1], [1]]),
    source(agents=3, steps=3, architecture="broadcast", more={"agent": [{}, {}, {"R": 2.0}]}),
    source(agents=3, steps=3, architecture="broadcast", more={"agent": [{}, {"R": 2.0}, {}]}),
    source(agents=3, steps=3, architecture="broadcast", more={"noise": {"correlation": [[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]}}),
]  # fmt: skip


@pytest.mark.slow
@given(st.lists(st.tuples(st.sampled_from(range(len(KINDS))), st.sampled_from(["general", "naive", "optimal"]), st.booleans()), min_size=2, max_size=12))  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_what_is_kept_of_one_scenario_is_not_taken_for_another(asked):
    for kind, method, errors in asked:
        if method == "optimal" and "noise" in KINDS[kind]:
            continue
        made = KINDS[kind]
        noises = noises_of(made, seed=len(asked) + kind, items=2)
        found = batch(method, sf.Scenario.from_mapping(made), LINK[2:4], noises, errors=errors)
        p = sf.predict(item(made, noises, 1), [LINK[3]], method, quantity="rms" if errors else "claimed")
        for quantity in QUANTITIES if errors else ["claimed"]:
            assert_close(by_agent(found, quantity)[1], matrix(quantity, p.moments)[0][:, p.group_of])


def test_outcomes_are_gone_through_once():
    made = source(2, 2, agents=3, steps=3, architecture="broadcast")
    general._kept.cache_clear()
    for seed in range(4):
        batch("general", sf.Scenario.from_mapping(made), LINK, noises_of(made, seed))
    assert general._kept.cache_info()[:2] == (3, 1)
    for agents in range(1, general.KEPT + 3):
        batch("general", sf.load_scenario(agents=agents, architecture="cyclic", steps=1), LINK, Noises())
    assert general._kept.cache_info().currsize == general.KEPT


def test_different_claims_that_share_their_first_number():
    """Two sums whose first random numbers happen to be equal are told by the second."""
    view = enumeration.FusedSet(
        np.array([[0, 1, -1]]), ((1, np.array([0, 1, 2])), (1, np.array([2, 2, 2]))), np.arange(3), np.eye(3), []
    )
    signatures = np.array([[7, 1], [7, 2], [0, 0]], dtype=np.uint64)
    order, starts = enumeration.different(enumeration._keys(view, slice(None), signatures))
    assert len(starts) == 3
    assert sorted(order.tolist()) == [0, 1, 2]
