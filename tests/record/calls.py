"""The calls: scenarios as mappings, requests from Python through public names, and command lines."""

from __future__ import annotations

import io
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import stochfuse as sf

PRESETS = ("beacon-map", "cooperative-pnt", "cv-2d", "fcs-demo", "gps-ins", "parallel-filters", "thesis-steady", "thesis-transient")  # fmt: skip
METHODS = ("simplified", "general", "naive", "optimal", "monte-carlo")
ESTIMATORS = (
    "local-fusion-graph", "naive", "optimal", "covariance-intersection", "split-ci", "blender", "joint-blender",
    "equivalent-measurement", "independent-measurements", "lwin", "itns", "stand-alone",
)  # fmt: skip
QUANTITIES = ("claimed", "actual", "optimal", "consistency", "bias", "rms")
LINKS = [0.0, 0.3, 1.0]


def scalar(agents: int = 3, steps: int = 3, **more: Any) -> dict[str, Any]:
    network = {"agents": agents, "steps": steps, **more.pop("network", {})}
    model = {"F": 0.95, "H": 1.0, "Q": 2.0, "R": 5.0, **more.pop("model", {})}
    return {"model": model, "initial": {"P": 10.0, **more.pop("initial", {})}, "network": network, **more}


def planar(agents: int = 3, steps: int = 3, **more: Any) -> dict[str, Any]:
    model = {"F": [[1, 0.5], [0, 0.9]], "H": [[1, 0]], "Q": [[0.2, 0.1], [0.1, 0.3]], "R": 2.0}
    given = more.pop("model", {})
    initial = {"P": [[4, 1], [1, 3]], **more.pop("initial", {})}
    return {**scalar(agents, steps, **more), "model": {**model, **given}, "initial": initial}


BURST = {"good_to_bad": 0.2, "bad_to_good": 0.4, "good": 0.9, "bad": 0.1}
MATRIX = [[0, 0.2, 0.7], [0.9, 0, 0.4], [0.5, 0.1, 0]]
SCENARIOS: dict[str, dict[str, Any]] = {
    "scalar": scalar(),
    "scalar shared": scalar(initial={"correlation": "shared"}),
    "scalar error": scalar(initial={"error": [3.0]}),
    "broadcast": scalar(network={"architecture": "broadcast"}),
    "cyclic": scalar(4, 4, network={"architecture": "cyclic"}),
    "delay": scalar(2, 3, network={"delay": [0.6, 0.3, 0.1]}),
    "delay two": planar(2, 4, network={"delay": 1}),
    "burst": scalar(2, 3, network={"link": 0.5, "burst": BURST} | {"link": None}),
    "masked": planar(3, 3, network={"hears": [[2], [1, 3], [2]]}),
    "matrix": planar(3, 3, network={"link": MATRIX}),
    "links per step": scalar(3, 3, network={"link": [0.1, 0.5, 0.9]}),
    "cases": scalar(3, 3, network={"case": [{"name": "bad", "link": 0.2}, {"name": "uneven", "link": MATRIX}]}),
    "unlike": scalar(agent=[{"R": 2.0}, {}, {"R": 9.0}]),
    "unlike H": planar(agent=[{"H": [[1, 0], [0, 1]], "R": [[1, 0.2], [0.2, 2]]}, {}, {}]),
    "unlike matrix": planar(3, 2, agent=[{"R": 1.0}, {}, {}], network={"link": MATRIX}),
    "per step": scalar(2, 3, model={"F": [[[1.0]], [[0.8]], [[1.1]]], "Q": [[[1.0]], [[2.0]], [[3.0]]], "R": [[[1.0]], [[4.0]], [[2.0]]]}),
    "planar": planar(),
    "planar error": planar(initial={"error": [1.0, -2.0]}),
    "planar shared": planar(2, 4, initial={"correlation": "shared"}),
    "correlated": planar(3, 3, noise={"correlation": 0.4}),
    "disturbed": scalar(2, 3, noise={"correlation": 0.3, "disturbance": 0.5}),
    "singular Q": planar(model={"Q": [[0, 0], [0, 0.5]]}),
    "singular P": planar(initial={"P": [[1, 0], [0, 0]]}),
    "input": planar(2, 3, model={"B": [[1], [0.5]], "u": [2.0]}, initial={"P": [[4, 1], [1, 3]], "x": [1.0, 2.0]}),
    "one agent": planar(1, 4),
    "alone": scalar(1, 3),
    "five cyclic": scalar(5, 3, network={"architecture": "cyclic"}),
}  # fmt: skip
SCENARIOS["burst"]["network"].pop("link")


def scenario(name: str) -> Any:
    if name in PRESETS:
        return sf.load_scenario(name)
    return sf.Scenario.from_mapping(SCENARIOS[name])


def command(*words: str) -> Any:
    """What a command writes to standard output: JSON read back, else lines of cells."""
    from stochfuse.cli import main

    out = io.StringIO()
    with mock.patch.object(sys, "argv", ["stochfuse", *words]), redirect_stdout(out), redirect_stderr(io.StringIO()):
        try:
            main()
        except SystemExit as end:
            if end.code not in (0, None):
                raise RuntimeError(f"exit {end.code}") from None
    text = out.getvalue()
    try:
        return json.loads(text)
    except ValueError:
        return [line.split(",") for line in text.splitlines()]


def many(name: str, **arrays: Any) -> Any:
    """Many scenarios in one call: today's door, or that of 0.1."""
    if hasattr(sf, "predict_many"):
        return sf.predict_many(scenario(name), **arrays).covariance
    from stochfuse.model import Noises

    from stochfuse import batches

    asked = {key: arrays.get(key) for key in ("Q", "R", "P")}
    method, quantity = arrays.get("method", "simplified"), arrays.get("quantity", "claimed")
    found = batches.predict(scenario(name), arrays["link"], Noises(*asked.values()), method, [quantity])
    return found.predictions[0].covariance


def _predictions() -> Iterator[tuple[str, Callable[[], Any]]]:
    def shown(name: str, method: str, quantity: str, of: str = "trace", agent: Any = "mean", **settings: Any) -> Any:
        s = scenario(name)
        own = s.network.link is not None or s.network.cases or s.network.burst is not None
        p = sf.predict(s, None if own else LINKS, method, quantity, **settings)
        return {"values": p.values(of, agent), "covariance": p.covariance, "nature": p.nature}

    for name, method in product([*SCENARIOS, *PRESETS], METHODS):
        more = {"runs": 60, "control": "none"} if method == "monte-carlo" else {}
        for quantity in ("claimed", "actual"):
            yield f"predict {name} {method} {quantity}", lambda a=(name, method, quantity), m=more: shown(*a, **m)
    for name, quantity in product(("scalar error", "planar error", "unlike", "matrix"), QUANTITIES):
        for method in METHODS[:4]:
            yield f"quantity {name} {method} {quantity}", lambda a=(name, method, quantity): shown(*a)
    for name, estimator in product([*SCENARIOS, "beacon-map", "cooperative-pnt", "parallel-filters"], ESTIMATORS):
        for method, more in (("general", {}), ("monte-carlo", {"runs": 40, "control": "none"})):
            label = f"estimator {name} {estimator} {method}"
            quantity = "actual" if method == "general" else "claimed"
            yield label, lambda a=(name, method, quantity), e=estimator, m=more: shown(*a, estimator=e, **m)
    metrics = ("det", "max-eig", "var:x1", "std:x2", "rms:x1,x2")
    for of, agent in product(metrics, ("mean", "worst", "best", 2)):
        yield f"metric {of} {agent}", lambda o=of, a=agent: shown("unlike H", "general", "actual", o, a)
    for criterion, estimator in product(("det", "trace", "max-eig"), ("covariance-intersection", "split-ci")):
        yield (
            f"criterion {criterion} {estimator}",
            lambda c=criterion, e=estimator: shown("planar", "general", "claimed", estimator=e, criterion=c),
        )
    statistics = ("variance", "std", "quantile:0.9", "at-most:4", "derivative")
    for name, statistic in product(("scalar", "planar", "masked", "delay", "unlike", "cyclic"), statistics):
        for agent in ("mean", 1):

            def statistic_of(n: str = name, s: str = statistic, a: Any = agent) -> Any:
                return sf.predict(scenario(n), [0.3, 0.8], "general").statistic(s, "trace", a)

            yield f"statistic {name} {statistic} {agent}", statistic_of
    yield "polynomial", lambda: sf.predict(scenario("planar"), LINKS, "general").outcomes.coefficients(3)
    yield "steady", lambda: sf.predict(scenario("planar"), LINKS, steady=True).steady_values()
    yield "prune", lambda: shown("scalar", "general", "claimed", max_graphs=5, prune=True)


def _questions() -> Iterator[tuple[str, Callable[[], Any]]]:
    for name in ("scalar", "planar", "unlike", "matrix", "broadcast", "masked", "correlated"):
        yield (
            f"compare {name}",
            lambda n=name: [
                p.values() for p in sf.compare(scenario(n), [0.4], methods=("simplified", "general")).predictions
            ],
        )
        yield f"steady state {name}", lambda n=name: sf.steady_state(scenario(n), [0.2, 0.9]).P
        yield f"messages {name}", lambda n=name: sf.message_load(scenario(n), [0.2, 0.9]).between(1, 3).mean("mean")
        yield (
            f"messages naive {name}",
            lambda n=name: sf.message_load(scenario(n), [0.2, 0.9], "naive").between(1, 3).mean("mean"),
        )
        for method in ("simplified", "general", "optimal"):
            yield (
                f"sensitivity {name} {method}",
                lambda n=name, m=method: (
                    sf.sensitivity(scenario(n), None if n == "matrix" else [0.5], method=m).derivative
                ),
            )
            yield (
                f"gain {name} {method}",
                lambda n=name, m=method: vars(sf.share_of_gain(scenario(n), method=m))["share"],
            )
            for target in (3.0, 5.0):
                yield (
                    f"least link {name} {method} {target}",
                    lambda n=name, m=method, t=target: sf.least_link(scenario(n), t, method=m).link,
                )
    yield "agents needed", lambda: sf.agents_needed(scenario("scalar"), 3.0, 0.5).agents
    for name in ("scalar", "unlike", "planar", "input"):
        z = np.random.default_rng(0).normal(size=(4, 1))
        yield (
            f"states {name}",
            lambda n=name, r=z: sf.predict_states(scenario(n), r[: scenario(n).network.steps], [0.3, 0.9]).x,
        )
    for q, step in product((None, 25), (1, 2, 3)):
        yield (
            f"derive simplified {q} {step}",
            lambda q=q, k=step: [str(e) for e in [sf.derive_simplified(2, k, q, 100, 100).closed()]] if q else 0.0,
        )
    for estimator in ("local-fusion-graph", "naive", "optimal"):
        yield (
            f"derive general {estimator}",
            lambda e=estimator: float(sf.derive_general(2, 3, 25, 100, 100, estimator=e).polynomial().eval(0.25)),
        )
    yield "derive optimal", lambda: float(sf.derive_optimal(3, 4, 25, 100, 100).polynomial().eval(0.25))

    def estimates() -> Any:
        graph = sf.FusionGraph(sf.load_history("thesis-example"))
        s = sf.load_scenario(agents=3, steps=4)
        return [e.P for _, e in sorted(graph.estimates(s).items())]

    yield "fusion graph", estimates
    rng = np.random.default_rng(3)
    eye = np.eye(2)
    for name, method in product(
        ("planar", "planar shared", "masked", "delay two"), ("simplified", "general", "naive", "optimal")
    ):
        arrays = {
            "link": np.array([0.0, 0.4, 1.0, 0.4]),
            "Q": rng.uniform(0.1, 2, (4, 1, 1)) * eye,
            "R": rng.uniform(0.5, 3, (4, 1, 1)),
            "P": rng.uniform(1, 9, (4, 1, 1)) * eye,
        }
        for given in (("Q", "R", "P"), ("R",), ("P",)):
            some = {key: value for key, value in arrays.items() if key in (*given, "link")}
            yield f"many {name} {method} {given}", lambda n=name, m=method, a=some: many(n, method=m, **a)


def _lines() -> Iterator[tuple[str, Callable[[], Any]]]:
    lines = [f"predict {p} --steps 2 --format json" for p in PRESETS]
    lines += [f"predict {p} --steps 2 --format csv --link 0.5" for p in PRESETS]
    lines += [
        f"predict --method {m} --steps 3 --quantity {q} --format json{' --runs 50' * (m == METHODS[-1])}"
        for m in METHODS
        for q in QUANTITIES
    ]
    lines += [
        f"predict --architecture {a} --method {m} --steps 3 --format json --link 0:1:0.25"
        for a in ("ad-hoc", "broadcast", "cyclic")
        for m in METHODS[:4]
    ]
    lines += [
        f"compare --steps 3 --link 0.5 --methods {m} --format json"
        for m in ("simplified,general", "general,naive,optimal")
    ]
    lines += [
        f"compare {p} --estimator {e} --link 0.5 --steps 2 --runs 20 --format json"
        for p, e in (
            ("thesis-transient", "local-fusion-graph,naive,split-ci,blender"),
            ("beacon-map", "split-ci,lwin,itns"),
            ("parallel-filters", "blender,joint-blender"),
        )
    ]
    lines += [
        "solve --target 30 --method general --steps 4 --quantity actual --format json",
        "solve --target 30 --format json", "solve --target 25 --method optimal --steps 3 --format json",
        "solve --sensitivity --agents 4 --architecture cyclic --method optimal --link 0.5 --steps 3 --format json",
        "solve --agents-needed --target 20 --link 0.5 --format json", "solve --gain --format json",
        "solve --steady --target 25 --format json", "solve --steady --format json",
        "messages --steps 8 --from-step 4 --format json", "messages --steps 6 --distribution --format json",
        "messages --steps 6 --cdf --rule naive --format json", "messages --steps 4 --bytes --format json",
        "messages --steps 3 --accuracy --link 0.5 --format json", "messages --method monte-carlo --runs 200 --steps 5 --format json",
        "derive simplified --agents 2 --step 2 --q 25 --r 100 --p0 100 --format json",
        "derive general --agents 2 --step 2 --q 25 --r 100 --p0 100 --format json",
        "derive optimal --agents 3 --step 3 --q 25 --r 100 --p0 100 --format json",
        "derive naive --agents 2 --step 3 --format json", "derive simplified --agents 3 --step 2 --format json",
        "graph --agent 3 --step 4 --format json", "graph --format json --scenario thesis-transient",
        "reproduce --format json", "reproduce figure-19 --format json", "reproduce figure-52 --format json",
        "reproduce figure-26 --format json", "reproduce table-2 --format json", "reproduce figure-33 --format csv",
        "scenario list", "scenario schema", "scenario check fcs-demo",
    ]  # fmt: skip
    lines += [f"scenario show {p}" for p in PRESETS]
    for line in lines:
        # 0.1 had no control for its samples
        plain = ["--control", "none"] if "--runs" in line and not line.startswith("messages") else []
        yield line, partial(command, *line.split(), *plain)


STUDY = """
schema = "stochfuse.study/1"
scenario = "{scenario}"
[vary]
"network.link" = [0.0, 0.3, 1.0]
"model.R" = [1.0, 50.0]
{vary}
[predict]
{predict}
[report]
quantity = {quantity}
"""


def _files() -> Iterator[tuple[str, Callable[[], Any]]]:
    def study(scenario: str, vary: str, predict: str, quantity: str) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "s.toml"
            path.write_text(STUDY.format(scenario=scenario, vary=vary, predict=predict, quantity=quantity))
            command("study", str(path), "--output", str(Path(folder) / "r.csv"), "--format", "json")
            return [line.split(",") for line in (Path(folder) / "r.csv").read_text().splitlines()]

    studies = [
        ("thesis-transient", "method = ['simplified', 'general', 'optimal', 'naive']", "", '["claimed"]'),
        ("cv-2d", "'network.steps' = [2, 3]", "method = 'general'", '["claimed", "actual", "messages"]'),
        ("thesis-steady", "estimator = ['covariance-intersection', 'split-ci']", "method = 'general'", '["actual"]'),
        (
            "thesis-transient",
            "'network.steps' = [2, 3]",
            "method = 'monte-carlo'\nruns = 30\ncontrol = 'none'",
            '["claimed"]',
        ),
        ("thesis-transient", "'initial.P' = [1.0, 100.0]", "method = 'simplified'", '["claimed", "rms"]'),
    ]
    for i, parts in enumerate(studies):
        yield f"study {i}", lambda p=parts: study(*p)

    def crosscheck(method: str, shift: float) -> Any:
        rng = np.random.default_rng(5)
        rows = ["run,agent,step,link,covariance"]
        values = sf.predict(scenario("thesis-transient"), [0.5], method).values()[0]
        rows += [
            f"{r},{a},{k + 1},0.5,{v * shift * (1 + 0.2 * rng.normal()):.9g}"
            for r in range(20)
            for a in (1, 2, 3)
            for k, v in enumerate(values)
        ]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "r.csv"
            path.write_text("\n".join(rows))
            from stochfuse.cli import main

            out = io.StringIO()
            words = ["stochfuse", "crosscheck", str(path), "thesis-transient", "--method", method, "--format", "json"]
            quiet = redirect_stderr(io.StringIO())
            with mock.patch.object(sys, "argv", words), redirect_stdout(out), quiet, suppress(SystemExit):
                main()  # its exit status is the verdict
            return json.loads(out.getvalue().replace(str(path), "r.csv"))

    for method, shift in product(("general", "simplified"), (1.0, 1.3)):
        yield f"crosscheck {method} {shift}", lambda m=method, s=shift: crosscheck(m, s)


def calls() -> dict[str, Callable[[], Any]]:
    """Every call by its name."""
    return dict([*_predictions(), *_questions(), *_lines(), *_files()])
