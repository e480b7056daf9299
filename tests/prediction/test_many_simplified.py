"""(54) in one batch: item by item the same as one scenario each, a textbook's loop, and what must hold for every batch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import stochfuse as sf
from stochfuse.engines.mean_field import BLOCK
from stochfuse.kalman.checks import covariance_fault
from stochfuse.kalman.packed import sound, upper
from stochfuse.prediction.simplified import averaged, faults
from stochfuse.scenario.system import Noises
from tests.oracles import textbook
from tests.oracles.many import covariances, items_of
from tests.oracles.strategies import covariance, mapping, model, seeds

SHAPES = ((1, 1), (1, 2), (2, 1), (4, 2), (3, 3))


def batch(rng, items, d, p):
    """Links with both ends among them, and noises of every item's own."""
    link = rng.uniform(size=items)
    link[:2] = (0.0, 1.0)[:items]
    Q = np.array([covariance(rng, d) for _ in range(items)])
    R = np.array([covariance(rng, p) + 0.1 * np.eye(p) for _ in range(items)])
    P0 = np.array([covariance(rng, d) + 0.1 * np.eye(d) for _ in range(items)])
    return link, Noises(Q, R, P0)


def one_by_one(source, link, noises):
    """The same by `sf.predict` on a scenario that is made for each item, and the forms used."""
    found = []
    for i, mu in enumerate(link):
        own = {**source, "model": dict(source["model"]), "initial": dict(source["initial"])}
        for table, name, M in (("model", "Q", noises.Q), ("model", "R", noises.R), ("initial", "P", noises.P0)):
            if M is not None:
                own[table][name] = M[i].tolist()
        found.append(sf.predict(sf.Scenario.from_mapping(own), [mu]))
    return np.concatenate([p.covariance for p in found]), {form for p in found for form in p.forms}


def assert_same(source, link, noises):
    """Entries of P may lose five digits against P⁻ before the square-root form takes over, in either."""
    expected, forms = one_by_one(source, link, noises)
    got = covariances(sf.Scenario.from_mapping(source), link, noises)
    assert got.faults == {}
    assert set(got.forms) == forms
    assert got.P.shape == expected.shape
    assert textbook.scaled_error(got.P, expected) < 1e-10
    return got


@pytest.mark.parametrize("agents", [1, 3, 50, 500])
@pytest.mark.parametrize(("d", "p"), SHAPES)
def test_item_by_item(d, p, agents):
    rng = np.random.default_rng(10 * d + p)
    source = mapping(*model(rng, d, p), agents=agents, steps=10 if agents == 3 else 4)
    assert_same(source, *batch(rng, 12, d, p))


@pytest.mark.parametrize("given_noises", ["Q", "R", "P0", "QR", "none"])
@pytest.mark.parametrize(("d", "p"), SHAPES)
def test_noises_that_are_not_given_are_the_scenarios(d, p, given_noises):
    rng = np.random.default_rng(d + p)
    source = mapping(*model(rng, d, p), agents=3, steps=4)
    link, noises = batch(rng, 6, d, p)
    some = Noises(**{name: M for name, M in noises._asdict().items() if name in given_noises})
    assert_same(source, link, some)


@pytest.mark.parametrize("varying", ["F", "H", "FH", "FQHR"])
@pytest.mark.parametrize(("d", "p"), SHAPES)
def test_models_that_vary_by_step(d, p, varying):
    """The batch's noises hold at all steps, also where those of the scenario vary."""
    rng = np.random.default_rng(d * p)
    models = [model(rng, d, p) for _ in range(4)]
    F, Q, H, R = (
        np.array([m[i] for m in models]) if name in varying else models[0][i] for i, name in enumerate("FQHR")
    )
    source = mapping(F, Q, H, R, models[0][4], agents=3, steps=4)
    link, noises = batch(rng, 5, d, p)
    assert_same(source, link, noises)
    assert_same(source, link, Noises(P0=noises.P0))
    assert_same(source, link, Noises(R=noises.R))


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast", "cyclic"])
@pytest.mark.parametrize("correlation", ["independent", "shared"])
def test_networks_and_starts(architecture, correlation):
    rng = np.random.default_rng(1)
    source = mapping(*model(rng, 3, 2), agents=4, steps=3, architecture=architecture)
    source["initial"]["correlation"] = correlation
    assert_same(source, *batch(rng, 8, 3, 2))


@pytest.mark.parametrize(("d", "p"), SHAPES)
def test_a_textbooks_loop(d, p):
    """The printed form with inverses: nothing of this package but the batch itself."""
    rng = np.random.default_rng(d + 7 * p)
    F, Q, H, R, P0 = model(rng, d, p)
    link, noises = batch(rng, 10, d, p)
    for shared in (False, True):
        source = mapping(F, Q, H, R, P0, agents=4, steps=4)
        source["initial"]["correlation"] = "shared" if shared else "independent"
        got = covariances(sf.Scenario.from_mapping(source), link, noises)
        for i, mu in enumerate(link):
            Q, R, P0 = (np.asarray(M)[i] for M in noises)
            expected = textbook.simplified_literal(F, Q, H, R, P0, 4, mu, 4, shared)
            assert textbook.scaled_error(got.P[i], expected) < 1e-9


@pytest.mark.parametrize(("d", "p"), [(2, 1), (4, 2), (3, 3)])
def test_precise_sensors_beside_coarse_ones_in_one_batch(d, p):
    """Items that cancel in measurement space are done again in square-root form, the others are not."""
    rng = np.random.default_rng(d)
    source = mapping(*model(rng, d, p), agents=3, steps=4)
    link, noises = batch(rng, 12, d, p)
    np.asarray(noises.R)[::3] *= 1e-13
    np.asarray(noises.P0)[1::6] *= 1e10
    np.asarray(noises.Q)[2] = 0.0
    got = assert_same(source, link, noises)
    assert got.forms == ("measurement-space", "square-root")
    benign = np.array([2, 4, 5, 8, 10, 11])
    alone = covariances(sf.Scenario.from_mapping(source), link[benign], noises.take(benign))
    assert alone.forms == ("measurement-space",)
    np.testing.assert_allclose(got.P[benign], alone.P, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("d", [1, 2])
def test_more_items_than_a_block(d):
    rng = np.random.default_rng(2)
    F, Q, H, R, P0 = model(rng, d, 1)
    items = 2 * BLOCK + 100
    scale = 10.0 ** rng.uniform(-2, 2, size=(3, items, 1, 1))
    noises = Noises(Q * scale[0], R * scale[1], P0 * scale[2])
    np.asarray(noises.R)[BLOCK + 5] = 1e-14
    link = rng.uniform(size=items)
    source = mapping(F, Q, H, R, P0, agents=3, steps=3)
    got = covariances(sf.Scenario.from_mapping(source), link, noises)
    assert got.P.shape == (items, 3, d, d)
    assert got.faults == {}
    some = np.array([0, BLOCK - 1, BLOCK, BLOCK + 5, 2 * BLOCK, items - 1])
    expected, _ = one_by_one(source, link[some], noises.take(some))
    assert textbook.scaled_error(got.P[some], expected) < 1e-11


@given(seeds, st.sampled_from(SHAPES), st.integers(1, 5))
def test_the_order_of_the_items_does_not_matter(seed, shape, agents):
    rng = np.random.default_rng(seed)
    scenario = sf.Scenario.from_mapping(mapping(*model(rng, *shape), agents=agents, steps=3))
    link, noises = batch(rng, 7, *shape)
    order = rng.permutation(7)
    plain, permuted = covariances(scenario, link, noises), covariances(scenario, link[order], noises.take(order))
    assert textbook.scaled_error(permuted.P, plain.P[order]) < 1e-12


@given(seeds, st.sampled_from(SHAPES), st.integers(2, 6))
def test_limits_no_link_is_the_kalman_filter_and_full_link_has_all_measurements(seed, shape, agents):
    rng = np.random.default_rng(seed)
    d, p = shape
    F, Q, H, R, P0 = model(rng, d, p)
    _, noises = batch(rng, 4, d, p)
    scenario = sf.Scenario.from_mapping(mapping(F, Q, H, R, P0, agents=agents, steps=3))
    for mu, together in ((0.0, 1), (1.0, agents)):
        got = covariances(scenario, np.full(4, mu), noises).P
        for i in range(4):
            Q, R, P0 = (np.asarray(M)[i] for M in noises)
            P = P0 / together
            for k in range(3):
                if k:
                    P = textbook.kalman_update(textbook.kalman_predict(P, F, Q), H, R / together)
                assert textbook.scaled_error(got[i, k], P) < 1e-8


@given(seeds, st.sampled_from(SHAPES), st.floats(1.5, 100.0))
def test_more_noise_never_helps_and_units_do_not_matter(seed, shape, more):
    rng = np.random.default_rng(seed)
    d, p = shape
    scenario = sf.Scenario.from_mapping(mapping(*model(rng, d, p), agents=3, steps=3))
    link, noises = batch(rng, 5, d, p)
    got = covariances(scenario, link, noises).P
    scaled = covariances(scenario, link, Noises(*(more * np.asarray(M) for M in noises))).P
    np.testing.assert_allclose(scaled, more * got, rtol=1e-9, atol=1e-12 * np.abs(scaled).max())
    for name in Noises._fields:
        worse = covariances(scenario, link, noises._replace(**{name: more * getattr(noises, name)})).P
        sd = np.sqrt(np.diagonal(worse, axis1=-2, axis2=-1))
        assert np.linalg.eigvalsh((worse - got) / (sd[..., None] * sd[..., None, :])).min() > -1e-9


def test_results_are_symmetric_and_singular_ones_are_no_fault():
    """Q = 0 and P(k0) of rank one, or zero: semi-definite to the end, and rounding of it is not called indefinite."""
    rng = np.random.default_rng(4)
    for d, p in ((2, 1), (4, 2), (3, 3)):
        source = mapping(*model(rng, d, p), agents=3, steps=20)
        link, noises = batch(rng, 40, d, p)
        np.asarray(noises.Q)[:] = 0.0
        np.asarray(noises.P0)[:] = [covariance(rng, d, rank=i % d) for i in range(40)]
        got = covariances(sf.Scenario.from_mapping(source), link, noises)
        assert got.faults == {}
        assert covariance_fault(got.P) is None
        np.testing.assert_array_equal(got.P, np.swapaxes(got.P, -1, -2))


@pytest.mark.parametrize("d", [2, 3])
def test_growth_beyond_floating_point_names_the_item_and_the_first_step(d):
    """P grows by 1e80 a step where nothing is measured, from 1e100 or little."""
    source = mapping(1e40 * np.eye(d), np.eye(d), np.eye(1, d), 1.0, np.eye(d), agents=2, steps=5)
    P0 = np.eye(d) * np.array([1.0, 1e-20, 1e100, 1.0])[:, None, None]
    R = np.array([1e250, 1.0, 1e300, 1.0])[:, None, None]
    got = covariances(sf.Scenario.from_mapping(source), np.full(4, 0.5), Noises(R=R, P0=P0))
    assert got.faults == {
        item: f"the covariance at step {step} is not finite: it grows beyond floating point"
        for item, step in {0: 5, 2: 4, 3: 5}.items()
    }
    for step in range(1, 6):
        expected = [item for item, first in {0: 5, 2: 4, 3: 5}.items() if step >= first]
        assert np.flatnonzero(~np.isfinite(got.P[:, step - 1]).all(axis=(1, 2))).tolist() == expected


def test_a_ratio_beyond_floating_point_is_a_fault_and_not_zero():
    """R/2 is left of a prior of 1e320, which factors can carry; a ratio of 1e334 to R = 1e-14 nothing can."""
    source = mapping(1e40, 1.0, 1.0, 1.0, 1.0, agents=2, steps=2)
    noises = Noises(R=np.array([[[1e20]], [[1e250]], [[1e-14]]]), P0=np.full((3, 1, 1), 1e240))
    got = covariances(sf.Scenario.from_mapping(source), np.ones(3), noises)
    assert got.faults == {2: "the covariance at step 2 is not finite: it grows beyond floating point"}
    np.testing.assert_allclose(got.P[:2, 1, 0, 0], [0.5e20, 0.5e250], rtol=1e-12)


def test_a_noise_that_is_singular_to_rounding_harms_its_own_item_only():
    rng = np.random.default_rng(5)
    scenario = sf.Scenario.from_mapping(mapping(*model(rng, 2, 2), agents=2, steps=3))
    link, noises = batch(rng, 9, 2, 2)
    plain = covariances(scenario, link, noises)
    np.asarray(noises.R)[[0, 3, 8]] = [[1.0, 1.0 + 1e-15], [1.0 + 1e-15, 1.0]]
    got = covariances(scenario, link, noises)
    why = "R: expected a positive definite matrix, got one that is singular to rounding"
    assert got.faults == dict.fromkeys((0, 3, 8), why)
    others = [1, 2, 4, 5, 6, 7]
    np.testing.assert_array_equal(got.P[others], plain.P[others])


def test_an_ill_conditioned_item_is_a_fault_that_says_how_many_digits_are_left():
    """Noises of condition 1e12: the Cholesky factor of R knows their difference to 1e-4 only."""
    R = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.3, 0.3 * (1 - 1e-12)], [0.3 * (1 - 1e-12), 0.3]]])
    source = mapping(1.0, 1.0, [[1.0], [1.1]], np.eye(2), 1.0, agents=2, steps=2)
    got = covariances(sf.Scenario.from_mapping(source), np.full(2, 0.5), Noises(R=R))
    assert got.faults == {
        1: "ill-conditioned: rounding may reach a relative 3e-04, in units of the standard deviations"
    }


def test_an_indefinite_result_is_a_fault():
    P = np.zeros((3, 2, 2, 5))
    P[...] = np.eye(2)[..., None]
    P[1:, 0, 1, 2] = P[1:, 1, 0, 2] = 1.2
    P[2, 0, 0, 3] = -1e-3
    P[2, 0, 0, 4] = np.nan
    P[0, :, :, 1] = 1.0
    assert faults(P) == {
        2: "expected a covariance at step 2, got an indefinite one (smallest eigenvalue, scaled to unit variances, -0.2)",
        3: "expected a covariance at step 3, got a variance of -0.001 on the diagonal",
        4: "the covariance at step 3 is not finite: it grows beyond floating point",
    }


@given(seeds, st.integers(1, 5), st.sampled_from([0.0, 1e-13, 1e-10, 0.9e-9, 1.1e-9, 1e-7, 1e-3, 1.0]))
def test_the_cheap_check_is_the_exact_one(seed, d, depth):
    """Matrices whose smallest eigenvalue, scaled to unit variances, is about −depth, in unlike units."""
    rng = np.random.default_rng(seed)
    P = np.array([covariance(rng, d, rank=max(1, d - 1)) for _ in range(20)])
    sd = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    v = rng.normal(size=(20, d, 1))
    P -= depth * rng.uniform(0.5, 1.5, size=(20, 1, 1)) * sd[..., None] * (v @ np.swapaxes(v, 1, 2)) * sd[:, None]
    units = 10.0 ** rng.integers(-8, 8, size=d)
    P *= units[:, None] * units
    with np.errstate(all="ignore"):
        exact = np.array([covariance_fault(M) is None for M in P])
    assert (sound(upper(P), d) <= exact).all() or depth in (0.9e-9, 1.1e-9)
    assert set(faults(np.moveaxis(P, 0, -1)[None])) == set(np.flatnonzero(~exact).tolist())


def network(**settings):
    return {**mapping(1.0, 1.0, 1.0, 1.0, 1.0, agents=3, steps=3, **settings)}


@pytest.mark.parametrize(
    "source",
    [
        network() | {"agent": [{}, {"R": 2.0}, {}]},
        network(hears=[[2], [1, 3], [2]]),
        network() | {"agent": [{}, {"sensor": False}, {"H": 2.0}]},
    ],
)
def test_unlike_agents_and_masks_are_items_too(source):
    """Agents that are not alike go through the noises one by one; the answers are those of one scenario each."""
    link, noises = np.array([0.1, 0.5, 0.9]), Noises(Q=np.array([[[1.0]], [[2.0]], [[1.0]]]))
    scenario = sf.Scenario.from_mapping(source)
    got = averaged(scenario.system, items_of(scenario, link, noises))
    for i, mu in enumerate(link):
        own = {**source, "model": {**source["model"], "Q": noises.Q[i].tolist()}}
        alone = sf.predict(sf.Scenario.from_mapping(own), [mu])
        np.testing.assert_allclose(got.moments.P[i][:, got.group_of], alone.by_group[0][:, alone.group_of], rtol=1e-12)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (network(delay=[0.5, 0.5]), r"method simplified: it is derived without delay \(thesis 4.2\)"),
        (network() | {"noise": {"correlation": 0.5}}, "expected independent measurement noises"),
    ],
)
def test_what_one_scenario_is_refused_for_many_are(source, message):
    with pytest.raises(sf.UsageError, match=message):
        covariances(sf.Scenario.from_mapping(source), np.array([0.5]), Noises())


def test_agents_with_states_of_their_own_are_refused():
    with pytest.raises(sf.UsageError, match="expected agents that track one state by one model"):
        covariances(sf.load_scenario("cooperative-pnt"), np.array([0.5]), Noises())


def test_many_scenarios_in_one_call():
    """`sf.predict_many`: numbers for multiples of the identity, a fault where an item has no answer."""
    s = sf.load_scenario("cv-2d", steps=4)
    rng = np.random.default_rng(0)
    link, R = rng.uniform(size=6), rng.uniform(1.0, 100.0, size=6)
    P = np.array([covariance(rng, 4) + np.eye(4) for _ in range(6)])
    for method in ("simplified", "general", "optimal"):
        p = sf.predict_many(s, link, R=R, P=P, method=method)
        assert p.covariance.shape == (6, 4, 4, 4)
        source = s.to_mapping()
        source["model"]["R"], source["initial"]["P"] = float(R[3]), P[3].tolist()
        alone = sf.predict(sf.Scenario.from_mapping(source), [link[3]], method)
        np.testing.assert_allclose(p.covariance[3], alone.covariance[0], rtol=1e-11, atol=1e-12)
    one = sf.predict_many(s, R=R, link=[0.5])
    assert one.covariance.shape == (6, 4, 4, 4)
    growing = sf.Scenario.from_mapping(
        mapping(1e40 * np.eye(2), np.eye(2), np.eye(1, 2), 1.0, np.eye(2), agents=2, steps=4)
    )
    p = sf.predict_many(growing, [0.5, 0.5], R=[1.0, 1e300], P=[1e-20, 1e100])
    assert list(p.meta["faults"]) == [1]
    assert np.isnan(p.covariance[1]).all()
    assert np.isfinite(p.covariance[0]).all()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"Q": np.zeros((3, 2, 2))}, r"Q: expected an array of shape \(items, 1, 1\), or \(items,\), got \(3, 2, 2\)"),
        ({"R": [1.0, 0.0]}, "R: expected covariances, got a variance of 0 on the diagonal"),
        ({"P": [1.0, -1.0]}, "P: expected covariances, got a variance of -1 on the diagonal"),
        ({"link": [0.1, 0.2], "R": [1.0, 2.0, 3.0]}, "link: expected 3 items, as many as the other arrays have, got 2"),
        ({"R": [1.0, 2.0]}, "link: expected one link probability per item, since the scenario has none of its own"),
        ({"Q": "much"}, "Q: expected an array of shape"),
        ({"link": [0.5, 1.5]}, "link: expected probabilities between 0 and 1, got 1.5"),
    ],
)
def test_arrays_that_do_not_fit_are_named(arrays, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.predict_many(sf.load_scenario(), **arrays)
