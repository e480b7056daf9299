"""What stands in for the optimum: its expectation against every outcome, and against what is drawn."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.engines import heard
from stochfuse.engines.contact_sample import sample_optimum
from stochfuse.engines.heard import Heard
from stochfuse.scenario.scenario import link_rows
from tests.engines.test_contact_sample import CASES

UNEVEN = [[0, 0.9, 0.2], [0.3, 0, 0.6], [0.5, 0.1, 0]]
CV = {"F": [[1, 1], [0, 1]], "H": [[1, 0]], "Q": [[0.25, 0.5], [0.5, 1]], "R": 900}
MODELS = {
    "scalar": {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}},
    "scalar with an error": {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100, "error": -30.0}},
    "two states": {"model": CV, "initial": {"P": [[10000, 0], [0, 100]], "error": [50.0, 3.0]}},
    "common start": {"model": CV, "initial": {"P": [[10000, 0], [0, 100]], "correlation": "shared"}},
}


@pytest.mark.parametrize("cut", [heard.CUT, 0.08])
@pytest.mark.parametrize("model", MODELS)
def test_expectation_is_that_over_every_outcome(model, cut, monkeypatch):
    """Every set of arrivals of three agents in every step, gone through one by one."""
    monkeypatch.setattr(heard, "CUT", cut)
    source = {**MODELS[model], "agent": [{}, {"R": 400}, {"R": 25}]}
    scenario = sf.Scenario.from_mapping(source | {"network": {"agents": 3, "steps": 3, "link": UNEVEN}})
    found = Heard(scenario.system, link_rows(scenario))
    assert max(some.window for some in found.alike) == 3
    numbers, weights = [], []
    for agent in range(3):
        others = [j for j in range(3) if j != agent]
        of_step = [
            (1 + sum(came), np.prod([p if c else 1 - p for c, p in zip(came, np.array(UNEVEN)[agent, others], strict=True)]))
            for came in product((0, 1), repeat=2)
        ]  # fmt: skip
        chosen = list(product(of_step, repeat=3))
        numbers.append([[m for m, _ in steps] for steps in chosen])
        weights.append([np.prod([w for _, w in steps]) for steps in chosen])
    P, x = found.of(np.array(numbers).transpose(1, 2, 0)[None])
    mean = found.expected()
    w = np.array(weights)
    np.testing.assert_allclose(np.einsum("ir,rkiab->kiab", w, P[0]), mean.P[0], rtol=1e-12)
    np.testing.assert_allclose(mean.actual, mean.P)
    if x is None:
        assert mean.bias is None
    else:
        np.testing.assert_allclose(np.einsum("ir,rkiab->kiab", w, x[0]), mean.bias[0], rtol=1e-12)
        square = P[0] + x[0] @ np.swapaxes(x[0], -1, -2)
        np.testing.assert_allclose(np.einsum("ir,rkiab->kiab", w, square), mean.square[0], rtol=1e-12)


@pytest.mark.parametrize("name", [name for name in CASES if name != "words"])
def test_expectation_is_the_mean_of_what_is_drawn(name):
    """Whatever becomes of messages and measurements: by the numbers that were heard in outcomes drawn."""
    scenario = sf.Scenario.from_mapping(CASES[name])
    links = link_rows(scenario)
    drawn, found = sample_optimum(scenario.system, links, 1500, 2, workers=1), Heard(scenario.system, links)
    P, _ = found.of(drawn.heard)
    np.testing.assert_allclose(P[:, :, 0], drawn.P[:, :, 0], rtol=1e-12)  # at step 1 it is the optimum
    mean = found.expected().P
    error = np.maximum(P.std(axis=1) / np.sqrt(1500), 1e-12 * np.abs(mean).max())
    z = (P.mean(axis=1) - mean) / error
    assert np.abs(z).max() < 4.7
    assert (z**2).mean() < 2.5
