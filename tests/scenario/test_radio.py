"""Link probabilities from radio and geometry: closed forms in 50 digits, sampled fades, and scenarios that use them."""

from __future__ import annotations

import copy
import csv
import io
import itertools
import json
import re
import tomllib
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpmath import mp, mpf

import stochfuse as sf
from stochfuse.scenario.radio import Radio, distances, links_between
from stochfuse.scenario.scenario import parse, preset_names, read_text
from tests.cli.command import run, strict_json

DATA = Path(__file__).parents[3] / "shared" / "data"
BUDGET = {"transmit_power": 17.3, "gain": 1.9, "exponent": 2.7, "reference_distance": 3.0, "reference_loss": 54.4,
          "sensitivity": -91.2}  # fmt: skip
FADING = {
    "none": Radio(**BUDGET),
    "rayleigh": Radio(**BUDGET, fading="rayleigh"),
    "shadowing": Radio(**BUDGET, fading="shadowing", shadowing=6.5),
}
CELL = [[0.0, 0.0], [180.0, 0.0], [90.0, 150.0], [420.0, 60.0]]
PATHS = [[[0, 0], [0, 0], [0, 0]], [[100, 0], [200, 0], [400, 0]], [[0, 150], [0, 100], [0, 50]]]


def exact(radio, distance):
    """µ in 50 digits, from powers in mW."""
    with mp.workdps(50):
        b = {key: mpf(value) for key, value in radio._asdict().items() if key != "fading"}
        ratio = max(mpf(distance) / b["reference_distance"], mpf(1))
        mean = 10 ** ((b["transmit_power"] + b["gain"] - b["reference_loss"]) / 10) / ratio ** b["exponent"]
        least = 10 ** (b["sensitivity"] / 10)
        if radio.fading == "rayleigh":
            return mp.exp(-least / mean)
        if radio.fading == "shadowing":
            return mp.erfc(-(10 * mp.log10(mean / least)) / b["shadowing"] / mp.sqrt(2)) / 2
        return mpf(mean >= least)


@pytest.mark.parametrize("fading", FADING)
def test_closed_forms_in_50_digits(fading):
    radio = FADING[fading]
    d = np.concatenate([[0.0], np.geomspace(1e-6, 1e9, 600)])
    found = radio.link(d)
    assert ((found >= 0) & (found <= 1)).all()
    for distance, µ in zip(d.tolist(), found.tolist(), strict=True):
        right = exact(radio, distance)
        assert abs(µ - right) < 3e-15
        if right > 1e-290:
            # dB are known to some 1e-14; the tail of the normal distribution makes the most of it
            assert abs(µ - right) < 3e-12 * right


@pytest.mark.parametrize("fading", FADING)
def test_limits_near_and_far(fading):
    radio = FADING[fading]
    strong = radio._replace(transmit_power=200.0)
    assert strong.link(0.0) == pytest.approx(1.0, abs=1e-15)
    assert radio.link(1e30) == 0.0
    # nearer than the reference distance the loss is the reference loss
    assert radio.received(0.0) == radio.received(3.0) == pytest.approx(17.3 + 1.9 - 54.4)
    assert (np.diff(radio.link(np.geomspace(3.0, 1e5, 500))) <= 0).all()
    assert (np.diff(strong._replace(transmit_power=1e99).link(np.geomspace(1e-9, 1e99, 50))) <= 0).all()


def test_without_fading_it_is_a_step_at_the_sensitivity():
    radio = Radio(transmit_power=20.0, reference_loss=40.0, sensitivity=-60.0, exponent=2.0)
    np.testing.assert_array_equal(radio.link([99.99, 100.0, 100.01]), [1.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("fading", "drawn"),
    [
        ("shadowing", lambda radio, d, rng, n: radio.received(d) + rng.normal(0.0, radio.shadowing, n)),
        # the envelope of two normal quadratures, as power
        (
            "rayleigh",
            lambda radio, d, rng, n: radio.received(d) + 10 * np.log10((rng.normal(size=(2, n)) ** 2).mean(0)),
        ),
    ],
)
def test_drawn_fades_reach_the_sensitivity_as_often(fading, drawn):
    rng, n, radio = np.random.default_rng(5), 200_000, FADING[fading]
    for d in (20.0, 200.0, 400.0, 600.0, 1500.0):
        µ = float(radio.link(d))
        share = (drawn(radio, d, rng, n) >= radio.sensitivity).mean()
        assert abs(share - µ) < 4 * np.sqrt(max(µ * (1 - µ), 1 / n) / n)


@given(st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 3), min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_links_are_symmetric_and_go_with_the_agents(places, random):
    places = [np.array(place) for place in places]
    for radio in FADING.values():
        link = links_between(radio, places)
        np.testing.assert_array_equal(link, link.T)
        order = random.sample(range(len(places)), len(places))
        np.testing.assert_array_equal(links_between(radio, [places[i] for i in order]), link[np.ix_(order, order)])


def test_distances_are_those_of_the_school():
    found = distances([np.array([0.0, 0.0]), np.array([[3.0, 4.0], [6.0, 8.0]])])
    np.testing.assert_array_equal(found, [[[0, 5], [5, 0]], [[0, 10], [10, 0]]])
    assert distances([np.zeros(3), np.array([2.0, 3.0, 6.0])])[0, 1] == 7.0


def scenario(positions, fading="shadowing", **network):
    radio = {**BUDGET, "fading": fading} | ({"shadowing": 6.5} if fading == "shadowing" else {})
    return {
        "model": {"F": 1, "H": 1, "Q": 25, "R": 100},
        "initial": {"P": 100},
        "network": {"agents": len(positions), "steps": 3, "radio": radio, **network},
        "agent": [{"position": place} for place in positions],
    }


def written_out(source):
    """The same scenario with its links as a matrix, or one per step, worked out in 50 digits."""
    network = source["network"]
    radio = Radio(**network["radio"])
    places = [np.array(table["position"], float) for table in source["agent"]]
    steps = network["steps"]

    def matrix(k):
        at = [place if place.ndim == 1 else place[k] for place in places]
        return [
            [0.0 if i == j else float(exact(radio, np.sqrt(((a - b) ** 2).sum()))) for j, b in enumerate(at)]
            for i, a in enumerate(at)
        ]

    link = [matrix(k) for k in range(steps)] if any(p.ndim == 2 for p in places) else matrix(0)
    other = {key: value for key, value in network.items() if key != "radio"}
    return {**{k: v for k, v in source.items() if k != "agent"}, "network": {**other, "link": link}}


@pytest.mark.parametrize("fading", FADING)
@pytest.mark.parametrize("positions", [CELL, PATHS], ids=["places", "paths"])
@pytest.mark.parametrize(
    "how",
    [{"method": "simplified"}, {"method": "optimal"}, {"method": "general", "estimator": "naive"},
     {"method": "monte-carlo", "runs": 20}],
    ids=lambda how: how["method"],
)  # fmt: skip
@pytest.mark.parametrize("architecture", ["ad-hoc", "cyclic"])
def test_a_radio_predicts_what_its_matrix_does(fading, positions, how, architecture):
    source = scenario(positions[:3], fading, architecture=architecture, steps=2)
    p, q = (sf.predict(made, **how) for made in (source, written_out(source)))
    np.testing.assert_allclose(p.covariance, q.covariance, rtol=1e-14, atol=0)


def test_masks_delays_and_cases_go_with_a_radio():
    source = scenario(CELL, hears=[[2], [1, 3], [2], [3]], delay=[0.5, 0.5])
    source["network"]["case"] = [{"name": "by radio"}, {"name": "by hand", "link": 0.5}]
    p, q = (sf.predict(made, method="optimal") for made in (source, written_out(source)))
    assert p.cases == ("by radio", "by hand")
    np.testing.assert_allclose(p.covariance, q.covariance, rtol=1e-14)
    assert abs(p.values()[0] - p.values()[1]).max() > 1e-3


def test_what_was_written_is_kept():
    source = scenario(PATHS)
    made = sf.load_scenario(source)
    assert made.to_mapping()["network"]["radio"] == source["network"]["radio"]
    assert "link" not in made.to_mapping()["network"]
    np.testing.assert_array_equal(sf.load_scenario(made.to_mapping()).network.link, made.network.link)
    np.testing.assert_array_equal(made.until(2).network.link, made.network.link[:2])
    np.testing.assert_array_equal(sf.load_scenario(made.until(2).to_mapping()).network.link, made.network.link[:2])


def test_defaults_are_free_space_from_one_metre_without_fading():
    source = scenario(CELL)
    source["network"]["radio"] = {"transmit_power": 0, "reference_loss": 40, "sensitivity": -85}
    link = sf.load_scenario(source).network.link  # 45 dB: 178 m
    expected = np.array([[0, 0, 1, 0], [0, 0, 1, 0], [1, 1, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_array_equal(link, expected)


def test_cooperative_measurements_and_a_radio_share_the_places():
    source = sf.load_scenario("cooperative-pnt").to_mapping()
    radio = {"transmit_power": 33, "reference_loss": 40, "exponent": 2.2, "sensitivity": -80, "fading": "rayleigh"}
    source["network"] |= {"radio": radio, "steps": 3}
    made, plain = sf.load_scenario(source), written_out({**source, "agent": source["agent"]})
    plain["agent"] = source["agent"]
    how = {"method": "monte-carlo", "estimator": "lwin", "runs": 10}
    np.testing.assert_allclose(
        sf.predict(made, **how).covariance, sf.predict(sf.load_scenario(plain), **how).covariance, rtol=1e-14
    )
    assert 0.01 < made.network.link[0][0, 1] < 1


def changed(change):
    source = copy.deepcopy(scenario(CELL[:3], steps=2))
    change(source, source["network"], source["network"]["radio"], source["agent"])
    return source


BAD = [
    (lambda s, n, r, a: n.update(link=0.5), "network.radio: expected either a link probability or a radio, got both"),
    (lambda s, n, r, a: n.update(burst={"good_to_bad": 0.1, "bad_to_good": 0.5}),
     "network.burst: expected either a radio or a burst, got both"),
    (lambda s, n, r, a: r.pop("transmit_power"), "network.radio.transmit_power: expected a value, got nothing"),
    (lambda s, n, r, a: r.update(sensitivity="low"), "network.radio.sensitivity: expected a number, got 'low'"),
    (lambda s, n, r, a: r.update(sensitivity=float("nan")), "network.radio.sensitivity: expected a number, got a value that"),
    (lambda s, n, r, a: r.update(exponent=0), "network.radio.exponent: expected a number above 0, got 0"),
    (lambda s, n, r, a: r.update(reference_distance=-1.0),
     "network.radio.reference_distance: expected a number above 0, got -1.0"),
    (lambda s, n, r, a: r.update(power=3), "network.radio.power: expected a known key, got an unknown one, 'power'"),
    (lambda s, n, r, a: r.update(fading="rice"),
     "network.radio.fading: expected one of \"none\", \"rayleigh\", \"shadowing\", got 'rice'"),
    (lambda s, n, r, a: r.pop("shadowing"),
     'network.radio.shadowing: expected a standard deviation in dB, since fading = "shadowing", got nothing'),
    (lambda s, n, r, a: r.update(fading="rayleigh"),
     'network.radio.shadowing: expected nothing beside fading = "rayleigh", got 6.5'),
    (lambda s, n, r, a: r.update(shadowing=0), "network.radio.shadowing: expected a number above 0, got 0"),
    (lambda s, n, r, a: n.update(radio=5), "network.radio: expected a table, got 5"),
    (lambda s, n, r, a: s.pop("agent"),
     "agent: expected one [[agent]] table with a position for each of the 3 agents, since network.radio is given, got nothing"),
    (lambda s, n, r, a: n.update(agents=2), "agent: expected one [[agent]] table for each of the 2 agents, got 3"),
    (lambda s, n, r, a: a[1].pop("position"),
     "agent[2].position: expected a place in m, since network.radio is given, got nothing"),
    (lambda s, n, r, a: a[1].update(position=[1, 2, 3]),
     "agent[2].position: expected a list of 2 numbers, or one such list per step, got [1, 2, 3]"),
    (lambda s, n, r, a: a[0].update(position=[1, 2, 3, 4]),
     "agent[1].position: expected 1 to 3 coordinates in m, or one such list per step, got [1, 2, 3, 4]"),
    (lambda s, n, r, a: a[1].update(position=7),
     "agent[2].position: expected a list of 2 numbers, or one such list per step, got 7"),
    (lambda s, n, r, a: a[2].update(position=[[1, 2]]),
     "agent[3].position: expected one list for each of the 2 steps, got 1 lists"),
    (lambda s, n, r, a: a[2].update(position=[1, "x"]), "agent[3].position: expected a list of coordinates"),
    (lambda s, n, r, a: n.update(architecture="broadcast"),
     'network.radio: expected equal probabilities in each column (a broadcast is heard by all or by none), or '
     'network.architecture "ad-hoc", got unequal ones'),
    (lambda s, n, r, a: n.update(nodes=["a", "b"]), "network.nodes: expected 3 names, one for each agent, got 2"),
    (lambda s, n, r, a: n.update(nodes=["a", "b", "a"]), "network.nodes[3]: expected a name of its own, got 'a'"),
    (lambda s, n, r, a: a[1].update(name=" "), "agent[2].name: expected a name, not empty, got ' '"),
    (lambda s, n, r, a: a[1].update(name="a\nb"), "agent[2].name: expected printable text, got 'a\\nb'"),
    (lambda s, n, r, a: a[1].update(name=4), "agent[2].name: expected text, got 4"),
    (lambda s, n, r, a: (a[0].update(name="x"), a[2].update(name="x")), "agent[3].name: expected a name of its own, got 'x'"),
    (lambda s, n, r, a: a[1].update(name="3"), "agent[3].name: expected a name of its own, got '3'"),
    (lambda s, n, r, a: (n.update(nodes=["a", "b", "c"]), a[1].update(name="c")),
     "agent[2].name: expected 'b' as in network.nodes, or nothing, got 'c'"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BAD, ids=[message[:50] for _, message in BAD])
def test_each_kind_of_mistake_has_its_message(change, message):
    with pytest.raises(sf.ScenarioError, match=re.escape(message)) as caught:
        sf.load_scenario(changed(change))
    assert str(caught.value).count("\n") == 1


def test_one_message_names_all_that_is_wrong():
    def change(s, n, r, a):
        r.update(exponent=-1, fading="x")
        a[0].pop("position")
        n["case"] = [{"name": "inherits"}]

    with pytest.raises(sf.ScenarioError) as caught:
        sf.load_scenario(changed(change))
    paths = [problem.path for problem in caught.value.problems]
    assert paths == ["network.radio.fading", "network.radio.exponent", "agent[1].position"]


def test_a_place_that_is_wrong_is_told_once():
    source = sf.load_scenario("cooperative-pnt").to_mapping()
    source["network"]["radio"] = {"transmit_power": 33, "reference_loss": 40, "sensitivity": -80}
    del source["agent"][0]["position"]
    source["agent"][3]["position"] = [1]
    with pytest.raises(sf.ScenarioError) as caught:
        sf.load_scenario(source)
    assert sorted(problem.path for problem in caught.value.problems) == ["agent[1].position", "agent[4].position"]


def test_names_of_agents():
    source = scenario(CELL[:3])
    assert sf.load_scenario(source).network.names == ()
    source["agent"][1]["name"] = "b"
    assert sf.load_scenario(source).network.names == ("1", "b", "3")
    source["network"]["nodes"] = ["a", "b", "c"]
    assert sf.load_scenario(source).network.names == ("a", "b", "c")


def test_names_choose_the_nodes_of_a_file(tmp_path):
    (tmp_path / "links.csv").write_text("receiver,sender,link\n" + "".join(
        f"{r},{s},{µ}\n" for µ, (r, s) in zip((0.1, 0.2, 0.3, 0.4, 0.5, 0.6), itertools.permutations("abc", 2), strict=True)))  # fmt: skip
    text = 'model={F=1,H=1,Q=1,R=4}\ninitial={P=9}\nnetwork={steps=2,agents=2,link={file="links.csv"}}\n'
    (tmp_path / "s.toml").write_text(text + '[[agent]]\nname="c"\n[[agent]]\nname="a"\n')
    s = sf.load_scenario(tmp_path / "s.toml")
    assert s.network.names == ("c", "a")
    assert (s.network.link[0, 1], s.network.link[1, 0]) == (0.5, 0.2)
    assert "nodes" in run("scenario", "show", tmp_path / "s.toml", "--json").stdout
    (tmp_path / "study.toml").write_text('scenario="s.toml"\n[vary]\n"model.R"=[1.0,4.0]\n')
    run("study", tmp_path / "study.toml", "-o", tmp_path / "out.csv")


def test_another_link_takes_the_radios_place():
    source = scenario(CELL, steps=2)
    p = sf.predict(sf.load_scenario(source, uniform_link=True), [0.5])
    plain = {key: value for key, value in source.items() if key != "agent"}
    plain["network"] = {"agents": 4, "steps": 2, "link": 0.5}
    np.testing.assert_array_equal(p.covariance, sf.predict(plain).covariance)
    assert "radio" not in p.scenario.to_mapping()["network"]
    shown = strict_json(run("predict", "road-5", "--link", "0.5", "--steps", "3", "--format", "json").stdout)
    assert shown["link"] == [0.5]
    assert (
        "radio"
        in strict_json(run("predict", "road-5", "--steps", "3", "--format", "json").stdout)["scenario"]["network"]
    )
    assert (
        "agent: expected one [[agent]] table for each of the 3 agents, got 5"
        in run("predict", "road-5", "--agents", "3", code=2).stderr
    )
    assert (
        "expected one list for each of the 21 steps, got 20" in run("predict", "road-5", "--steps", "21", code=2).stderr
    )


def test_a_study_varies_what_the_radio_is():
    plan = {"scenario": scenario(CELL[:3], steps=2), "vary": {"network.radio.exponent": [2.0, 3.5]}}
    found = {
        row["network.radio.exponent"]: row for row in csv.DictReader(io.StringIO(studied(plan))) if row["step"] == "2"
    }
    for exponent, row in found.items():
        source = scenario(CELL[:3], steps=2)
        source["network"]["radio"]["exponent"] = float(exponent)
        assert float(row["claimed.trace"]) == pytest.approx(sf.predict(source).values()[0, -1], rel=1e-12)
    assert len(found) == 2
    both = {**plan, "vary": {"network.link": [0.5]}}
    assert "0.5" in studied(both)


def studied(plan):
    with TemporaryDirectory() as folder:
        (Path(folder) / "plan.json").write_text(json.dumps(plan))
        run("study", Path(folder) / "plan.json", "-o", Path(folder) / "out.csv")
        return (Path(folder) / "out.csv").read_text()


# ---- stochfuse links SCENARIO


def saved(folder, source, name="s.json"):
    (folder / name).write_text(json.dumps(source))
    return folder / name


def test_links_of_a_scenario_as_json(tmp_path):
    source = scenario(PATHS)
    found = strict_json(run("links", saved(tmp_path, source), "--format", "json").stdout)
    assert found["schema"] == "stochfuse.links/1"
    assert found["nodes"] == ["1", "2", "3"]
    assert found["sent"] is found["received"] is found["low"] is found["high"] is None
    right = written_out(source)["network"]["link"]
    for step, matrix in zip(found["link"], right, strict=True):
        for i, j in itertools.product(range(3), repeat=2):
            if i == j:
                assert step[i][j] is None
            else:
                assert step[i][j] == pytest.approx(matrix[i][j], abs=1e-14)
    still = strict_json(run("links", saved(tmp_path, scenario(CELL)), "--format", "json").stdout)
    assert np.shape(still["link"]) == (4, 4)
    assert still["steps"] is None
    assert still["positions"] == CELL
    few = strict_json(run("links", "road-5", "--nodes", "E,A", "--format", "json").stdout)
    whole = strict_json(run("links", "road-5", "--format", "json").stdout)
    assert few["nodes"] == ["E", "A"]
    assert few["link"][4][0][1] == whole["link"][4][4][0]
    assert few["positions"] == [whole["positions"][4], whole["positions"][0]]


def test_links_of_matrices_numbers_bursts_and_cases(tmp_path):
    def shown(**network):
        source = {key: value for key, value in scenario(CELL[:3]).items() if key != "agent"}
        path = saved(tmp_path, {**source, "network": {"agents": 3, "steps": 2, **network}})
        return strict_json(run("links", path, "--format", "json").stdout)

    assert shown(link=0.5)["link"] == [[None, 0.5, 0.5], [0.5, None, 0.5], [0.5, 0.5, None]]
    assert shown(link=[0.5, 0.25])["link"][1][0] == [None, 0.25, 0.25]
    assert shown(link=0.5, architecture="cyclic")["link"] == [[None, 0.5, 0.0], [0.0, None, 0.5], [0.5, 0.0, None]]
    assert shown(link=0.5, hears=[[2], [], [1, 2]])["link"] == [[None, 0.5, 0.0], [0.0, None, 0.0], [0.5, 0.5, None]]
    bursty = shown(burst={"good_to_bad": 0.1, "bad_to_good": 0.3})
    assert bursty["link"][0][1] == pytest.approx(0.75)
    assert bursty["burst"][0][1] == {"good_to_bad": 0.1, "bad_to_good": 0.3, "good": 1.0, "bad": 0.0}
    assert bursty["burst"][1][1] is None
    cases = shown(case=[{"name": "a", "link": 0.1}, {"name": "b", "link": 0.9}])
    assert [case["name"] for case in cases["cases"]] == ["a", "b"]
    assert cases["cases"][1]["link"][2][0] == 0.9
    assert cases["link"] == cases["cases"][0]["link"]


def test_links_as_table_and_csv():
    text = run("links", "road-5", "--at", "2,last").stdout
    assert "step 2\n" in text
    assert "step 20\n" in text
    assert "step 1\n" not in text
    assert "the same both ways; distance in m; sensitivity -85 dBm" in text
    assert max(map(len, text.splitlines())) <= 80
    rows = list(csv.DictReader(io.StringIO(run("links", "road-5", "--format", "csv").stdout)))
    assert len(rows) == 20 * 20
    s = sf.load_scenario("road-5")
    for row in rows[::37]:
        i, j = (s.network.names.index(row[key]) for key in ("receiver", "sender"))
        assert float(row["link"]) == s.network.link[int(row["step"]) - 1, i, j]
    orbit = strict_json(run("links", "orbit-8", "--format", "json").stdout)
    assert orbit["sent"][0][1] == 300
    assert orbit["low"][0][1] < orbit["link"][0][1] < orbit["high"][0][1]
    assert "cyclic: every agent hears the next one only" in run("links", "-", input=json.dumps(
        scenario(CELL, architecture="cyclic"))).stderr  # fmt: skip


@pytest.mark.parametrize("name", ["road-5", "orbit-8", "fcs-demo", "s.json"])
def test_a_network_that_is_written_predicts_the_same(tmp_path, name):
    source = sf.load_scenario(name).to_mapping() if name != "s.json" else scenario(
        CELL, architecture="cyclic", delay=[0.25, 0.75])  # fmt: skip
    if name == "s.json":
        saved(tmp_path, source)
    run("links", name, "--write", tmp_path / "network.toml", cwd=tmp_path)
    network = tomllib.loads((tmp_path / "network.toml").read_text())["network"]
    assert network["steps"] == source["network"]["steps"]
    same = {**source, "network": network}
    if name == "s.json":
        del same["agent"]
    how = {"method": "optimal"} if name == "s.json" else {"method": "simplified"}
    p, q = (sf.predict(made, **how) for made in (source, same))
    assert p.cases == q.cases
    np.testing.assert_allclose(p.covariance, q.covariance, rtol=1e-14)


def test_links_that_a_scenario_has_not():
    assert "thesis-transient: expected links (network.link" in run("links", "thesis-transient", code=2).stderr
    assert "--columns: expected a file of links to go with it" in run(
        "links", "road-5", "--columns", "seq=n", code=2).stderr  # fmt: skip
    assert "--at: expected a scenario to go with it" in run("links", "log.csv", "--at", "1", code=2).stderr
    assert "--at: expected steps from 1 to 20" in run("links", "road-5", "--at", "21", code=2).stderr
    assert "nodes: expected some of A, B, C, D, E, got 'F'" in run("links", "road-5", "--nodes", "F", code=2).stderr
    with pytest.raises(sf.UsageError, match="sent: expected a file of links to go with it, got a scenario"):
        sf.links("road-5", sent=3)


def test_links_from_python():
    made = sf.load_scenario(scenario(CELL))
    for source in (made, made.to_mapping()):
        np.testing.assert_array_equal(np.nan_to_num(sf.links(source).link), made.network.link)
    assert sf.links("orbit-8").nodes[0] == "3-2"


# ---- presets


@pytest.mark.skipif(not DATA.exists(), reason="shared data are not here")
@pytest.mark.parametrize(("preset", "name"), [("orbit-8", "noise-minus5dbm"), ("orbit-8-noisy", "noise-0dbm")])
def test_orbit_8_is_what_was_counted(preset, name):
    sent, received = Counter(), Counter()
    with (DATA / "orbit" / f"{name}.csv").open() as file:
        for row in csv.DictReader(file):
            sent[row["receiver"], row["sender"]] += 1
            received[row["receiver"], row["sender"]] += int(row["received"])
    network = sf.load_scenario(preset).network
    assert network.counts is not None
    assert set(network.names) == {node for pair in sent for node in pair}
    for (i, receiver), (j, sender) in itertools.permutations(enumerate(network.names), 2):
        assert [counts[i, j] for counts in network.counts] == [sent[receiver, sender], received[receiver, sender]]
        assert network.link[i, j] == received[receiver, sender] / sent[receiver, sender]
    assert {tuple(place) for place in np.array(network.places).tolist()} == {
        tuple(map(float, node.split("-"))) for node in network.names
    }


def test_road_5_has_the_radio_that_its_comment_says():
    radio = sf.load_scenario("road-5").network.radio
    for d in (180.0, 300.0, 600.0, 1000.0):
        # WINNER+ B1, line of sight beyond the break point, antennas 1.5 m high, 5.9 GHz
        loss = 40 * np.log10(d) + 7.56 - 2 * 17.3 * np.log10(1.5) + 2.7 * np.log10(5.9)
        assert radio.received(d) == pytest.approx(23 - loss, abs=0.1)
    assert abs(radio.reference_distance - 4 * 1.5 * 1.5 * 5.9e9 / 299_792_458) < 0.5
    assert radio.link(310.0) == pytest.approx(0.95, abs=0.01)
    assert radio.link(410.0) == pytest.approx(0.5, abs=0.02)
    assert radio.link(540.0) == pytest.approx(0.05, abs=0.01)
    link = sf.links("road-5").link
    far = (link < 0.01).any(axis=0) & (link > 0.99).any(axis=0)
    assert far.sum() >= 8  # in and out of reach


def test_presets_say_how_likely_a_message_is_in_one_way_only():
    for name in preset_names():
        network = parse(*read_text(name))["network"]
        assert sum(key in network for key in ("link", "radio", "burst")) <= 1


# ---- figures


def labels(figure):
    """Boxes of the agents' names, by axes."""
    figure.draw_without_rendering()
    return [[text.get_window_extent() for text in axes.texts] for axes in figure.axes]


@pytest.mark.parametrize("name", ["road-5", "orbit-8", pytest.param("fcs-demo", marks=pytest.mark.slow)])
def test_names_in_the_figure_cover_neither_each_other_nor_the_agents(name):
    from stochfuse.report.network_figure import draw_network

    found = sf.links(name)
    figure = draw_network(found, (1, 20) if found.varies else (1,))
    for axes, boxes in zip(figure.axes, labels(figure), strict=True):
        assert len(boxes) == len(found.nodes)
        for one, other in itertools.combinations(boxes, 2):
            assert not one.overlaps(other)
        frame = axes.get_window_extent()
        dots = axes.transData.transform(
            np.array([line.get_xydata()[0] for line in axes.lines if line.get_zorder() == 5])
        )
        for box in boxes:
            assert frame.x0 <= box.x0
            assert box.x1 <= frame.x1
            assert not box.count_contains(dots)


def without_places(**network):
    source = {key: value for key, value in scenario(CELL[:2]).items() if key != "agent"}
    return {**source, "network": {"agents": 2, "steps": 2, **network}}


SLOW = pytest.mark.slow
DRAWN = [
    scenario([[0, 0, 10], [[0, 100, 500]] * 3]),
    without_places(link=[0.2, 0.8]),
    pytest.param(scenario([[0, 0]]), marks=SLOW),
    pytest.param(scenario([[5, 5], [5, 5]]), marks=SLOW),
    pytest.param(without_places(link=0.3), marks=SLOW),
]


@pytest.mark.parametrize("source", DRAWN, ids=["in space", "per step", "one agent", "at one place", "alike"])
def test_figures_are_drawn(tmp_path, source):
    run("links", saved(tmp_path, source), "--plot", tmp_path / "links.png")
    assert (tmp_path / "links.png").read_bytes().startswith(b"\x89PNG")
