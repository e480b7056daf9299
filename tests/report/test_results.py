"""Results at the prompt, in notebooks, as pandas and xarray: labelled, short, and equal to the arrays."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf

MINE = {
    "model": {"F": np.array([[1.0, 1.0], [0.0, 1.0]]), "H": np.array([[1.0, 0.0]]), "Q": np.eye(2) * np.float64(0.1), "R": np.float32(4), "states": ("x", "v"), "units": ["m", "m/s"]},
    "initial": {"P": np.diag([9.0, 1.0])},
    "network": {"agents": np.int64(3), "steps": 3},
}  # fmt: skip

RESULTS = {
    "prediction": lambda: sf.predict(MINE, [0, 0.5]),
    "optimum": lambda: sf.predict(MINE, [0, 0.5], "optimal"),
    "sampled": lambda: sf.predict(MINE, [0.5], "monte-carlo", runs=20),
    "cases": lambda: sf.predict(sf.load_scenario("fcs-demo", steps=2)),
    "many": lambda: sf.predict_many(MINE, link=np.linspace(0, 1, 7)),
    "comparison": lambda: sf.compare(MINE, [0.5], ["general", "simplified"]),
    "estimators": lambda: sf.compare_estimators(MINE, [0.5], ["naive", "split-ci"]),
    "least link": lambda: sf.least_link(MINE, 7.0),
    "agents": lambda: sf.agents_needed("thesis-transient", 25.0, 0.5),
    "sensitivity": lambda: sf.sensitivity(MINE, 0.5),
    "gain": lambda: sf.share_of_gain(MINE, [0.5]),
    "load": lambda: sf.message_load(MINE, [0.5]),
    "links": lambda: sf.links({"seq": [1, 2, 3], "sender": ["1"] * 3, "receiver": ["NA"] * 3, "received": [1, 0, 1]}),
    "run": lambda: sf.simulate(MINE, 20, link=0.5, estimator=["naive", "optimal"]),
    "states": lambda: sf.expected_states(MINE, np.ones((3, 3, 1)), [0, 0.5], "general"),
    "verdict": lambda: sf.crosscheck(
        {"link": [0.5], "step": [1], "covariance": [7.0], "count": [100]}, MINE, causes=False
    ),
    "study": lambda path: sf.study({"vary": {"network.link": [0, 0.5, 1]}}, path / "study.parquet"),
}


@pytest.fixture(scope="module", params=RESULTS)
def result(request, tmp_path_factory):
    make = RESULTS[request.param]
    return make(tmp_path_factory.mktemp("study")) if request.param == "study" else make()


def test_at_the_prompt_it_is_one_short_line(result):
    assert len(repr(result)) < 400
    assert "\n" not in repr(result)
    assert repr(result).startswith(type(result).__name__)


def test_other_results_are_short_too():
    for other in (
        sf.load_scenario("gps-ins"),
        sf.steady_state("thesis-steady", [0.5]),
        sf.least_link(MINE, 7.0).question,
    ):
        assert len(repr(other)) < 400


def test_in_a_notebook_it_is_a_table(result):
    html = result._repr_html_()
    assert html.count("<table>") == html.count("</table>") >= 1
    assert html.count("<tr>") > 1


def test_as_a_frame_it_is_tidy(result):
    frame = result.to_dataframe()
    assert len(frame)
    assert frame.columns.is_unique


def test_it_can_be_drawn(result):
    from matplotlib.figure import Figure

    assert isinstance(result.plot(), Figure)


def test_frames_hold_the_values():
    p = sf.predict(MINE, [0, 0.5])
    frame = p.to_dataframe(of="std:x")
    wide = frame.pivot(index="link", columns="step", values="value")
    np.testing.assert_array_equal(wide.to_numpy(), p.values("std:x"))
    assert set(frame["quantity"]) == {"claimed"}
    assert set(frame["unit"]) == {"m"}


def test_many_parameter_sets_have_their_parameters_beside_them():
    R, Q = np.array([1.0, 2.0, 3.0]), np.array([np.eye(2), [[2, 0.5], [0.5, 1]], 3 * np.eye(2)])
    frame = sf.predict_many(MINE, link=[0.1, 0.2, 0.3], R=R, Q=Q).to_dataframe()
    np.testing.assert_array_equal(frame["R"], R[frame["item"]])
    np.testing.assert_array_equal(frame["Q[1,2]"], Q[:, 0, 1][frame["item"]])
    assert "P" not in frame


def test_many_parameter_sets_are_told_apart_and_lost_ones_stay():
    R = np.array([4.0, 0.0, 9.0])
    with pytest.raises(sf.UsageError):
        sf.predict_many(MINE, link=[0.5, 0.5, 0.5], R=R)
    frame = sf.predict_many(MINE, link=[0.1, 0.5, 0.9]).to_dataframe()
    assert list(frame["item"]) == [0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_arrays_have_named_axes():
    for kind in ("claimed", "actual", "rms"):
        p = sf.predict(MINE, [0, 0.5], "general", kind)
        x = p.to_xarray()
        assert x.dims == ("link", "step", "agent", "row", "column")
        np.testing.assert_array_equal(x.sel(agent=2, row="x", column="v"), p.of_agent(2)[..., 0, 1])
        assert x.attrs["quantity"] == kind
        assert x.attrs["units"] == "m, m/s"
        assert x.attrs["nature"] == "exact"
    cases = sf.predict(sf.load_scenario("fcs-demo", steps=2))
    assert cases.to_xarray().dims[0] == "case"
    assert list(cases.to_xarray().case.values) == list(cases.cases)


def test_several_predictions_have_one_axis_more():
    x = sf.compare(MINE, [0.5], ["general", "simplified"]).to_xarray()
    assert list(x.method.values) == ["general", "simplified"]
    y = sf.compare_estimators(MINE, [0.5], ["naive", "split-ci"]).to_xarray()
    assert y.sizes["estimator"] == 2


def test_a_file_keeps_everything(tmp_path):
    import xarray

    x = sf.predict(MINE, [0, 0.5]).to_xarray()
    x.to_netcdf(tmp_path / "x.nc")
    with xarray.open_dataarray(tmp_path / "x.nc") as back:
        xarray.testing.assert_identical(x, back.load())


def test_a_missing_library_is_named_with_the_line_that_installs_it(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr("stochfuse.errors.import_module", missing)
    with pytest.raises(sf.StochfuseError, match=r"this needs xarray: pip install 'stochfuse\[data\]'"):
        sf.predict(MINE, [0.5]).to_xarray()


def test_links_keep_the_names_of_nodes():
    links = RESULTS["links"]()
    frame, arrays = links.to_dataframe(), links.to_xarray()
    assert frame[["receiver", "sender", "sent", "received"]].to_numpy().tolist() == [["NA", "1", 3, 2]]
    assert float(arrays.link.sel(receiver="NA", sender="1")) == frame.link[0] == pytest.approx(2 / 3)
    assert float(arrays.link.isnull().sum()) == 3
    assert list(arrays.sender.values) == ["1", "NA"]


def test_axes_of_ones_own():
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    figure = sf.predict(MINE, [0, 0.5, 1]).plot(ax=axes)
    assert figure is axes.figure
    assert axes.lines
    with pytest.raises(sf.UsageError, match="ax: expected none, a LeastLink needs axes of its own"):
        sf.least_link(MINE, 7.0).plot(ax=axes)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: sf.predict(5), sf.UsageError, "scenario: expected a preset's name, a path, or a mapping with a file's keys, got int"),
        (lambda: sf.predict(MINE, runz=5), TypeError, "unexpected keyword argument 'runz' .did you mean 'runs'"),
        (lambda: sf.predict(MINE, method="simplifed"), sf.UsageError, "method: expected one of .* got 'simplifed' .did you mean 'simplified'"),
        (lambda: sf.predict(MINE, "half"), sf.UsageError, "link: expected link probabilities"),
        (lambda: sf.sensitivity(MINE, "general"), sf.UsageError, "link: expected a probability, a 3×3 matrix of them .*, got 'general'$"),
        (lambda: sf.least_link(MINE, "low"), sf.UsageError, "target: expected a finite number of at least 0, got 'low'"),
        (lambda: sf.agents_needed(MINE, 3.0, "half"), sf.UsageError, "link: expected a probability between 0 and 1, got half"),
        (lambda: sf.load_scenario(MINE, agnets=3), TypeError, "unexpected keyword argument 'agnets' .did you mean 'agents'"),
        (lambda: sf.load_scenario({**MINE, "netwrk": {}}), sf.ScenarioError, "netwrk: expected a known key, got an unknown one, 'netwrk' .did you mean 'network'"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_what_takes_a_list_takes_an_array():
    plain = sf.predict(sf.load_scenario(MINE), [0.0, 0.5]).values()
    for link in (np.array([0.0, 0.5]), (0.0, 0.5), np.array([0.0, 0.5], dtype=np.float32)):
        np.testing.assert_array_equal(sf.predict(MINE, link).values(), plain)
    np.testing.assert_array_equal(sf.predict(MINE, np.float64(0.5)).values()[0], plain[1])
