"""Numbers from the literature, to their printed digits (published numbers)."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf

TABLE_54 = {
    0.0: ("100", "55.556", "44.615", "41.043", "39.775"),
    0.25: ("77.083", "42.571", "34.853", "32.616", "31.920"),
    0.5: ("58.333", "32.941", "27.881", "26.609", "26.271"),
    0.75: ("43.750", "26.029", "22.924", "22.259", "22.112"),
    1.0: ("33.333", "21.212", "19.365", "19.033", "18.972"),
}


@pytest.mark.parametrize("architecture", ["ad-hoc", "broadcast"])
@pytest.mark.parametrize("link", TABLE_54)
def test_simplified_formulation_of_the_thesis_scenario(link, architecture):
    values = sf.predict(sf.load_scenario("thesis-transient", architecture=architecture), [link]).values()[0]
    for value, printed in zip(values, TABLE_54[link], strict=True):
        digits = len(printed.partition(".")[2])
        assert f"{value:.{digits}f}" == printed


TABLE_49 = {
    ("ad-hoc", 0.25): ("77.08333", "39.37944", "31.68171", "29.9007"),
    ("ad-hoc", 0.5): ("58.33333", "29.83547", "25.52113", "24.81763"),
    ("ad-hoc", 0.75): ("43.75", "24.51826", "21.96258", "21.51761"),
    ("broadcast", 0.25): ("77.08333", "39.70478", "32.05569", "30.22397", "29.84359"),
    ("broadcast", 0.5): ("58.33333", "30.31415", "25.81867", "25.01889", "24.89674"),
    ("broadcast", 0.75): ("43.75", "24.72526", "22.0427", "21.58531", "21.50537"),
    ("cyclic", 0.25): ("87.5", "46.13638", "36.64332", "33.92131", "33.17008"),
    ("cyclic", 0.5): ("75", "38.08235", "30.76495", "29.21189", "28.98359"),
    ("cyclic", 0.75): ("62.5", "31.34155", "26.62183", "25.9707", "25.88323"),
    ("cyclic", 1.0): ("50", "25.86207", "23.95098", "23.6054", "23.42564"),
}


@pytest.mark.parametrize(("architecture", "link"), TABLE_49)
def test_general_formulation_of_the_thesis_scenario(architecture, link):
    printed = TABLE_49[architecture, link]
    scenario = sf.load_scenario("thesis-transient", architecture=architecture, steps=len(printed))
    values = sf.predict(scenario, [link], method="general").values()[0]
    for value, text in zip(values, printed, strict=True):
        assert value == pytest.approx(float(text), abs=5.1e-6)


def test_two_scalar_filters_without_exchange():
    """F = Q = R = 1, P0 = 1: P = 2/3, 5/8, 13/21 after one, two, three updates."""
    source = {
        "model": {"F": 1, "H": 1, "Q": 1, "R": 1},
        "initial": {"P": 1},
        "network": {"agents": 2, "steps": 4, "link": 0},
    }
    values = sf.predict(sf.Scenario.from_mapping(source)).values()[0]
    np.testing.assert_allclose(values, [1, 2 / 3, 5 / 8, 13 / 21], rtol=1e-15)


@pytest.mark.parametrize("agents", [2, 3, 50, 5000])
def test_step_one_in_closed_form(agents):
    link = np.array([0.001, 0.25, 0.5, 1.0])
    values = sf.predict(sf.load_scenario(agents=agents), link).values()[:, 0]
    np.testing.assert_allclose(values, 100 * (1 - (1 - link) ** agents) / (agents * link), rtol=1e-12)


def test_presets_are_those_of_the_thesis():
    transient, steady = sf.load_scenario("thesis-transient"), sf.load_scenario("thesis-steady")
    for s, P0 in ((transient, 100.0), (steady, 45.0)):
        assert s.P0.tolist() == [[P0]]
        assert (s.model.F.item(), s.model.Q.item(), s.sensors[0].H.item(), s.sensors[0].R.item()) == (1, 25, 1, 100)
        assert (s.network.agents, s.network.steps, s.correlation) == (3, 5, "independent")
    assert transient.error is not None
    assert transient.error.tolist() == [[-1000.0]]
    assert steady.error is None


def test_fcs_demo_has_the_measured_rates():
    """Thesis table 1: intra-subnet 95 % (69 to 100), inter-subnet 68 % (0 to 100), network 85 % (74 to 96)."""
    network = sf.load_scenario("fcs-demo").network
    assert network.link is not None
    intra = np.zeros((10, 10), dtype=bool)
    intra[:8, :8] = intra[8:, 8:] = True
    off = ~np.eye(10, dtype=bool)
    assert set(network.link[intra & off]) == {0.95}
    assert set(network.link[~intra]) == {0.68}
    cases = dict(network.cases)
    assert set(cases["all links at minimum"][intra & off]) == {0.69}
    assert set(cases["all links at minimum"][~intra]) == {0.0}
    assert [float(cases[f"network {name}"]) for name in ("minimum", "average", "maximum")] == [0.74, 0.85, 0.96]
    assert float(cases["all links at maximum"]) == 1.0
    assert network.link[off].mean() == pytest.approx(0.854, abs=5e-4)  # the measured network average, 85 %
