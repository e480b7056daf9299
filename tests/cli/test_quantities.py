"""Quantities and bursty links on the command line, as a user meets them."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest

import stochfuse as sf
from tests.cli.command import run, strict_json
from tests.oracles.strategies import mapping

BURST = {"good_to_bad": 0.1, "bad_to_good": 0.3, "good": 0.98, "bad": 0.1}


def test_claimed_and_actual_side_by_side(tmp_path):
    done = run("predict", "--method", "naive", "--quantity", "claimed,actual,consistency", "--steps", "3", "--link", "0.5,1",
               "--plot", str(tmp_path / "a.png"))  # fmt: skip
    assert done.stdout.startswith(
        "Expected claimed posterior covariance: variance of x [no unit given]\n"
        "Expected actual posterior error covariance: variance of x [no unit given]\n"
        "Posterior consistency, actual / claimed (> 1: overconfident): variance of x\n"
        "thesis-transient: 3 agents, ad-hoc; every agent alike\n"
    )
    assert "   µ   k   claimed   actual   consistency\n" in done.stdout
    assert "   1   3    9.0522   30.471        3.3662\n" in done.stdout
    assert (
        "warning: overconfident: the actual variance of x is up to 3.37 times the claimed one (µ = 1, step 3)"
        in done.stderr
    )
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_no_warning_where_claims_hold():
    assert "overconfident" not in run("predict", "--method", "general", "--quantity", "actual", "--steps", "3").stderr
    assert "overconfident" not in run("predict", "--method", "naive", "--steps", "3").stderr  # nobody asked


def test_json_of_several_quantities():
    out = strict_json(run("predict", "--method", "general", "--quantity", "actual,optimal,bias", "--steps", "2",
                          "--link", "0.25", "--format", "json").stdout)  # fmt: skip
    assert (out["quantity"], list(out["quantities"])) == ("actual", ["actual", "optimal", "bias"])
    assert out["values"] == out["quantities"]["actual"]["values"]
    assert out["quantities"]["optimal"]["nature"] == "exact"
    s = sf.load_scenario(steps=2)
    for quantity, found in out["quantities"].items():
        np.testing.assert_allclose(found["values"], sf.predict(s, [0.25], "general", quantity).values())


@pytest.mark.parametrize("quantity", ["claimed", "actual", "optimal", "consistency", "bias", "rms"])
@pytest.mark.parametrize("method", ["simplified", "general", "optimal", "naive", "monte-carlo"])
def test_every_quantity_of_every_method(method, quantity):
    out = strict_json(run("predict", "--method", method, "--quantity", quantity, "--steps", "2", "--link", "0.3",
                          "--format", "json").stdout)  # fmt: skip
    assert out["quantity"] == ("optimal" if (method, quantity) == ("optimal", "claimed") else quantity)
    assert np.isfinite(out["values"]).all()
    expected = {"simplified": "approximate", "monte-carlo": "sampled"}.get(method, "exact")
    if quantity == "optimal" and method == "simplified":
        expected = "exact"
    assert out["meta"]["nature"] == expected


def test_csv_of_several_quantities():
    done = run(
        "predict",
        "--method",
        "general",
        "--quantity",
        "claimed,rms",
        "--steps",
        "2",
        "--link",
        "0.3",
        "--format",
        "csv",
    )
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert [(row["quantity"], row["step"]) for row in rows] == [
        ("claimed", "1"),
        ("claimed", "2"),
        ("rms", "1"),
        ("rms", "2"),
    ]


def test_compare_actual():
    out = strict_json(run("compare", "--steps", "2", "--link", "0.5", "--quantity", "actual", "--methods",
                          "general,naive,optimal,monte-carlo", "--format", "json").stdout)  # fmt: skip
    assert out["quantity"] == "actual"
    assert out["methods"]["optimal"]["difference"][0][1] < 0 < out["methods"]["naive"]["difference"][0][1]


def test_bursty_links(tmp_path):
    source = mapping(
        1, 25, 1, 100, 100, 2, 3, case=[{"name": "bursts", "burst": BURST}, {"name": "none", "link": 0.76}]
    )
    path = tmp_path / "bursts.json"
    path.write_text(json.dumps(source))
    done = run("predict", str(path), "--method", "optimal", "--format", "json")
    out = strict_json(done.stdout)
    np.testing.assert_allclose(out["link"], [0.76, 0.76])
    assert out["values"][0][0] == pytest.approx(out["values"][1][0])  # one step alone knows no bursts
    assert out["values"][0][2] > out["values"][1][2]
    error = run("predict", str(path), code=2).stderr
    assert "method simplified: it does not take bursty links (network.burst): it averages after every step" in error
    error = run("messages", str(path), code=2).stderr
    assert "message load does not take bursty links (network.burst)" in error
    assert run("predict", str(path), "--link", "0.5").returncode == 0  # an option overrides the file


def test_bad_bursts(tmp_path):
    def problems(**network):
        path = tmp_path / "bad.json"
        path.write_text(json.dumps(mapping(1, 25, 1, 100, 100, 2, 3, **network)))
        return run("scenario", "check", str(path), code=2).stderr

    error = problems(burst={"good_to_bad": 1.5, "bad_to_good": -1})
    assert "network.burst.good_to_bad: expected a probability, got 1.5" in error
    assert "network.burst.bad_to_good: expected a probability, got -1" in error
    assert "network.burst: expected either a link probability or a burst, got both" in problems(burst=BURST, link=0.5)
    assert "network.burst.bad_to_good: expected a value, got nothing" in problems(burst={"good_to_bad": 0.1})
    assert "network.burst.goood: expected a known key" in problems(burst=BURST | {"goood": 1})
    error = problems(burst={"good_to_bad": 0, "bad_to_good": 0})
    assert (
        "network.burst: expected good_to_bad or bad_to_good above 0, so that the share of good steps is known" in error
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--quantity", "truth"], "--quantity: expected one or several of claimed, actual, optimal, consistency, bias, rms, got 'truth'"),
        (["--quantity", "claimed,claimed"], "--quantity: expected different ones, got claimed,claimed"),
        (["--quantity", "rms", "--metric", "det"], "quantity rms: expected metric trace, max-eig, var:STATE, std:STATE"),
        (
            ["--quantity", "rms", "--method", "general", "--steps", "2", "--statistic", "derivative"],
            "derivative: expected metric trace or var:STATE of quantity claimed or actual, or the bias of one state",
        ),
    ],
)  # fmt: skip
def test_wrong_requests(arguments, message):
    done = run("predict", *arguments, code=2)
    assert message in done.stderr
    assert done.stdout == ""


def test_bursty_links_are_not_asked_backwards(tmp_path):
    path = tmp_path / "bursts.json"
    path.write_text(json.dumps(mapping(1, 25, 1, 100, 100, 2, 3, burst=BURST)))
    for question in (["--target", "30"], ["--sensitivity"], ["--gain"]):
        assert "network.burst: expected links without memory" in run("solve", str(path), *question, code=2).stderr


def test_what_is_the_same_is_not_shown_twice(tmp_path):
    error = run("predict", "--method", "optimal", "--quantity", "claimed,optimal", code=2).stderr
    assert "quantity: with method optimal the claimed covariance is the optimal one; expected one of them" in error
    error = run("compare", "--quantity", "optimal", code=2).stderr
    assert "quantity: expected one that depends on the method; the optimum is the same for all" in error


def test_titles_say_what_µ_does_not(tmp_path):
    for network, text in (
        ({"burst": BURST}, "ad-hoc, bursty links; "),
        ({"link": 0.5, "delay": [0.5, 0.5]}, "ad-hoc, delays; "),
    ):
        path = tmp_path / "network.json"
        path.write_text(json.dumps(mapping(1, 25, 1, 100, 100, 2, 2, **network)))
        assert text in run("predict", str(path), "--method", "optimal").stdout


def test_notes_do_not_depend_on_the_order():
    for quantities in ("bias,actual", "actual,bias"):
        done = run("predict", "thesis-steady", "--method", "general", "--steps", "2", "--quantity", quantities)
        assert "the scenario has no known initial error (initial.error)" in done.stderr
    assert "quantity actual is its true error" in run("predict", "--method", "naive", "--steps", "2").stderr
