"""Links from packet logs and other files: counts, intervals, memory, what is unknown, and bad input."""

from __future__ import annotations

import gzip
import json
import random
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta, chi2_contingency

import stochfuse as sf
from stochfuse.errors import ScenarioError, UsageError
from stochfuse.scenario.links import read_links
from tests.cli.command import run, strict_json

DATA = Path(__file__).parents[3] / "shared" / "data"
there = pytest.mark.skipif(not DATA.exists(), reason="shared data are not here")


def written(folder, text, name="log.csv"):
    path = folder / name
    path.write_text(text) if isinstance(text, str) else path.write_bytes(text)
    return path


def log_of(rows):
    return "seq,sender,receiver,received\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)


@there
@pytest.mark.parametrize("name", [pytest.param("noise-0dbm", marks=pytest.mark.slow), "noise-minus5dbm"])
def test_a_real_log_is_counted(name):
    path = DATA / "orbit" / f"{name}.csv"
    sent, received = defaultdict(set), defaultdict(set)
    for line in path.read_text().splitlines()[1:]:
        seq, sender, receiver, got, _ = line.split(",")
        sent[receiver, sender].add(seq)
        if got == "1":
            received[receiver, sender].add(seq)
    found = read_links(path)
    assert len(found.nodes) == 8
    for i, receiver in enumerate(found.nodes):
        for j, sender in enumerate(found.nodes):
            if i == j:
                assert np.isnan(found.link[i, j])
                continue
            n, s = len(sent[receiver, sender]), len(received[receiver, sender])
            assert (found.sent[i, j], found.received[i, j]) == (n, s)
            assert found.link[i, j] == s / n
            low, high = beta.ppf([0.025, 0.975], s + 0.5, n - s + 0.5)
            assert found.low[i, j] == pytest.approx(low, rel=1e-9, abs=1e-12)
            assert found.high[i, j] == pytest.approx(high, rel=1e-9)


def test_nodes_are_in_the_order_that_a_reader_expects(tmp_path):
    names = ["a10", "a2", "a²", "a", "007", "10", f"{'9' * 5000}"]
    rows = [(k, "hub", name, 1) for name in names for k in range(2)]
    found = read_links(written(tmp_path, log_of(rows)))
    assert list(found.nodes) == ["007", "10", "9" * 5000, "a", "a2", "a10", "a²", "hub"]


@there
def test_a_mercator_log_is_counted_without_its_rubbish():
    rows = [line.split(",") for line in (DATA / "mercator" / "euratech.csv").read_text().splitlines()]
    head, rows = rows[0], rows[1:]
    at = {name: head.index(name) for name in head}
    good = [row for row in rows if row[at["crc"]] == "1" and row[at["expected"]] == "1"]
    packets, sent = defaultdict(set), {}
    for row in good:
        packets[row[at["mac"]], row[at["srcmac"]]].add((row[at["transctr"]], row[at["pkctr"]]))
        sent[row[at["srcmac"]], row[at["transctr"]]] = int(row[at["txnumpk"]])
    found = read_links(DATA / "mercator" / "euratech.csv")
    for i, receiver in enumerate(found.nodes):
        for j, sender in enumerate(found.nodes):
            if i != j:
                n = sum(count for (who, _), count in sent.items() if who == sender)
                assert found.sent[i, j] == n
                assert found.received[i, j] == len(packets[receiver, sender])
    assert f"{len(rows) - len(good)} rows that are no packets" in found.notes[0]


@there
def test_ratios_are_averaged_and_have_an_interval_only_with_numbers(tmp_path):
    path = DATA / "k7" / "grenoble.k7"
    ratios = defaultdict(list)
    for line in path.read_text().splitlines()[2:]:
        _, src, dst, _, _, pdr, _ = line.split(",")
        ratios[dst, src].append(float(pdr))
    found = read_links(path)
    assert found.sent is None
    assert np.isnan(found.low).all()
    for (dst, src), values in ratios.items():
        i, j = found.nodes.index(dst), found.nodes.index(src)
        assert found.link[i, j] == pytest.approx(np.mean(values), rel=1e-12)
    zipped = written(tmp_path, gzip.compress(path.read_bytes()), "grenoble.k7.gz")
    np.testing.assert_array_equal(read_links(zipped).link, found.link)
    counted = read_links(path, sent=100)
    i, j = found.nodes.index("4"), found.nodes.index("0")
    assert counted.sent[i, j] == 100 * len(ratios["4", "0"])
    assert 0 < counted.low[i, j] < counted.link[i, j] <= counted.high[i, j] <= 1
    result = strict_json(run("links", path, "--format", "json").stdout)
    assert result["low"] is result["high"] is result["sent"] is None


def test_received_packets_alone_tell_what_was_sent_where_a_counter_wraps(tmp_path):
    numbers = [65530 + k for k in range(20)]
    got = [k for k in range(20) if k not in (3, 7, 8)]
    rows = [f"{numbers[k] % 65536},a,b" for k in got] + [f"{numbers[k] % 65536},a,c" for k in (0, 19)]
    rows += [rows[4], rows[4]]  # heard again, and late
    random.Random(1).shuffle(rows)
    times = {f"{number % 65536}": k for k, number in enumerate(numbers)}
    text = "seq,sender,receiver,time\n" + "".join(f"{row},{times[row.split(',')[0]]}\n" for row in rows)
    found = read_links(written(tmp_path, text))
    b, c, a = (found.nodes.index(node) for node in "bca")
    assert (found.received[b, a], found.sent[b, a]) == (17, 20)
    assert (found.received[c, a], found.sent[c, a]) == (2, 20)
    assert ("b", "c") in found.unknown
    assert any("each is counted once" in note for note in found.notes)


def test_a_log_of_all_packets_without_a_loss_is_doubted(tmp_path):
    rows = [f"{k},a,b,{int(k > 0)}\n" for k in range(4)]
    for some, doubted in ((rows, False), (rows[1:], True)):
        found = read_links(written(tmp_path, "seq,sender,receiver,received\n" + "".join(some)))
        assert (
            any("no packet of the log is lost; if it has those that arrived alone" in n for n in found.notes) == doubted
        )


def test_who_listened_and_heard_nothing_is_zero_and_who_never_listened_unknown(tmp_path):
    text = "seq,sender,receiver\n" + "".join(f"{k},a,b\n{k},b,c\n{k},c,b\n" for k in range(10))
    found = read_links(written(tmp_path, text))
    a, b, c = (found.nodes.index(node) for node in "abc")
    assert (found.received[c, a], found.sent[c, a]) == (0, 10)
    assert found.link[c, a] == 0.0
    assert np.isnan(found.link[a, b])
    result = strict_json(run("links", written(tmp_path, text), "--format", "json").stdout)
    assert result["link"][a][b] is None
    assert result["link"][c][a] == 0.0
    assert " ? " in run("links", written(tmp_path, text)).stdout
    assert "nothing is known of b to a" in run("links", written(tmp_path, text)).stderr


def chain(rng, n, p, r, good=1.0, bad=0.0):
    state, out = True, []
    for _ in range(n):
        state = rng.random() >= p if state else rng.random() < r
        out.append(int(rng.random() < (good if state else bad)))
    return out


@pytest.mark.slow
def test_memory_is_found_where_there_is_some_and_fitted(tmp_path):
    rng = np.random.default_rng(7)
    records = {
        "plain": (rng.random(4000) < 0.6).astype(int),
        "gilbert": chain(rng, 4000, 0.05, 0.2),
        "elliott": chain(rng, 4000, 0.03, 0.05, 0.95, 0.3),
    }
    rows = [(k, "hub", name, got) for name, record in records.items() for k, got in enumerate(record)]
    found = read_links(written(tmp_path, log_of(rows)))
    hub = found.nodes.index("hub")
    for name, record in records.items():
        i = found.nodes.index(name)
        table = np.zeros((2, 2))
        for before, after in pairwise(record):
            table[before, after] += 1
        assert found.memory[i, hub] == pytest.approx(
            chi2_contingency(table, correction=False, lambda_="log-likelihood")[0], rel=1e-9
        )
    assert (found.nodes.index("plain"), hub) not in found.burst
    fit = found.burst[found.nodes.index("gilbert"), hub]
    assert (fit["good"], fit["bad"]) == (1.0, 0.0)
    assert fit["good_to_bad"] == pytest.approx(0.05, abs=0.012)
    assert fit["bad_to_good"] == pytest.approx(0.2, abs=0.04)
    fit = found.burst[found.nodes.index("elliott"), hub]
    assert fit["good"] == pytest.approx(0.95, abs=0.03)
    assert fit["bad"] == pytest.approx(0.3, abs=0.06)
    assert fit["good_to_bad"] == pytest.approx(0.03, abs=0.015)
    assert fit["bad_to_good"] == pytest.approx(0.05, abs=0.025)


def test_delays_are_a_distribution_over_steps(tmp_path):
    rows = ["0,a,b,1,0.0,0.05", "1,a,b,1,1.0,1.12", "2,a,b,1,2.0,2.13", "3,a,b,0,3.0,"]
    path = written(tmp_path, "seq,sender,receiver,received,sent_time,received_time\n" + "\n".join(rows) + "\n")
    assert read_links(path, step=0.1).delay == pytest.approx((1 / 3, 2 / 3))
    assert read_links(path).delay is None


def test_matrices_edge_lists_and_logs_say_the_same(tmp_path):
    link = {("b", "a"): 0.5, ("a", "b"): 0.25, ("c", "a"): 1.0}
    edges = "receiver,sender,link\n" + "".join(f"{r},{s},{µ}\n" for (r, s), µ in link.items())
    matrix = ",a,b,c\n" + "".join(f"{r}," + ",".join(str(link.get((r, s), "")) for s in "abc") + "\n" for r in "abc")
    log = log_of([(k, s, r, int(k < 4 * µ)) for (r, s), µ in link.items() for k in range(4)])
    arrays = [read_links(written(tmp_path, text, f"{i}.csv")).link for i, text in enumerate((edges, matrix, log))]
    np.testing.assert_array_equal(arrays[0], arrays[1])
    np.testing.assert_array_equal(arrays[0], arrays[2])
    renamed = written(tmp_path, log.replace("sender", "src").replace("receiver", "dst"), "r.csv")
    np.testing.assert_array_equal(read_links(renamed, columns={"sender": "src", "receiver": "dst"}).link, arrays[0])


def test_frames_and_parquet_are_logs_too(tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"seq": [1, 2, 3], "sender": "a", "receiver": ["b", "b", "b"], "received": [1, 0, 1]})
    frame.to_parquet(tmp_path / "log.parquet")
    frame.to_csv(tmp_path / "log.csv", index=False)
    for found in (sf.links(frame), sf.links(tmp_path / "log.parquet"), sf.links(tmp_path / "log.csv")):
        assert found.link[1, 0] == pytest.approx(2 / 3)


def test_text_is_read_without_pyarrow_too(tmp_path, monkeypatch):
    path = written(tmp_path, log_of([(k, s, r, int(k % 3 > 0)) for s in "abc" for r in "abc" if s != r for k in range(9)]))  # fmt: skip
    matrix = written(tmp_path, "\ufeff,a,b\n\na,1,0.25\nb,0.5,1\n", "matrix.csv")
    torn = written(tmp_path, "seq,sender,receiver,received\n1,a,b,1\n2,a,b\n", "torn.csv")
    before = [read_links(each) for each in (path, matrix)]
    for module in ("pyarrow", "pyarrow.csv", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    for one, each in zip(before, (path, matrix), strict=True):
        again = read_links(each)
        assert (again.nodes, again.burst) == (one.nodes, one.burst)
        np.testing.assert_array_equal(again.link, one.link)
    with pytest.raises(UsageError, match=r"torn\.csv, line 3: expected 4 columns, got 3"):
        read_links(torn)
    with pytest.raises(
        sf.StochfuseError, match=r"Parquet files of links need pyarrow: pip install 'stochfuse\[study\]'"
    ):
        read_links(tmp_path / "log.parquet")


PACKETS = {"seq": [1, 2, 3, 1, 2], "sender": ["1", "1", "1", "NA", "NA"], "receiver": ["NA", "NA", "NA", "1", "1"], "received": [True, False, True, True, True]}  # fmt: skip
FRAMES = {
    "mapping": lambda: PACKETS,
    "arrays": lambda: {name: np.array(column) for name, column in PACKETS.items()},
    "pandas": lambda: pytest.importorskip("pandas").DataFrame(PACKETS),
    "pandas, nullable": lambda: pytest.importorskip("pandas").DataFrame(PACKETS).convert_dtypes(),
    "pandas, categories": lambda: pytest.importorskip("pandas").DataFrame(PACKETS).astype({"sender": "category"}),
    "pyarrow": lambda: pytest.importorskip("pyarrow").table(PACKETS),
    "polars": lambda: pytest.importorskip("polars").DataFrame(PACKETS),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_every_kind_of_frame_is_read_alike(kind):
    found = sf.links(FRAMES[kind]())
    assert found.nodes == ("1", "NA")
    assert found.received.tolist() == [[0, 2], [2, 0]]
    assert found.sent.tolist() == [[0, 2], [3, 0]]


def test_frames_may_be_edge_lists_and_matrices_too():
    pandas = pytest.importorskip("pandas")
    edges = sf.links(PACKETS).to_dataframe()
    matrix = edges.pivot(index="receiver", columns="sender", values="link")
    renamed = edges.rename(columns={"receiver": "to"})
    for found in (sf.links(edges), sf.links(matrix), sf.links(renamed, columns={"receiver": "to"})):
        assert found.nodes == ("1", "NA")
        assert found.link[1, 0] == pytest.approx(2 / 3)
        assert found.hears == [[2], [1]]
    assert sf.links(pandas.DataFrame([[1.0, 0.5], [0.2, 1.0]])).nodes == ("1", "2")
    with pytest.raises(sf.UsageError, match=r"line 3, column 'a': expected a probability between 0 and 1, got '1.5'"):
        sf.links(pandas.DataFrame([[0, 0.5], [1.5, 0]], ["a", "b"], ["a", "b"]))


@pytest.mark.parametrize("zone", [None, "UTC"])
def test_delays_come_from_times_of_a_frame(zone):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(PACKETS)
    frame["sent_time"] = pandas.date_range("2024-01-01", periods=5, freq="s", tz=zone)
    frame["received_time"] = frame["sent_time"] + pandas.to_timedelta([0.5, 0.1, 2.5, 0.2, 0.9], unit="s")
    frame.loc[1, "received_time"] = pandas.NaT
    assert sf.links(frame, step=1.0).delay == (0.75, 0.0, 0.25)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (5, "links: expected a path, or a table with columns by name, got int"),
        ({"seq": [1, 2], "sender": ["a"]}, "links: expected columns of one length, got 2 of seq, 1 of sender"),
        ({"seq": [1]}, "table: expected columns seq, sender, receiver, received"),
        ({"seq": [1], "sender": [None], "receiver": ["b"]}, "line 2, column 'sender': expected a name, got nothing"),
    ],
)
def test_tables_that_are_no_links(table, message):
    with pytest.raises(sf.UsageError, match=message):
        sf.links(table)


MODEL = "[model]\nF=1\nH=1\nQ=1\nR=4\n[initial]\nP=9\n"


def test_a_scenario_takes_its_links_from_a_file_beside_it(tmp_path):
    (tmp_path / "sub").mkdir()
    written(
        tmp_path / "sub", log_of([(k, s, r, int(k < 7)) for s in "xyz" for r in "xyz" if s != r for k in range(10)])
    )
    path = written(tmp_path / "sub", MODEL + '[network]\nsteps=3\nlink={file="log.csv"}\nnodes=["z","x"]\n', "s.toml")
    s = sf.load_scenario(path)
    assert s.network.agents == 2
    np.testing.assert_allclose(s.network.link, [[0, 0.7], [0.7, 0]])
    same = sf.load_scenario({**s.to_mapping()})
    np.testing.assert_array_equal(sf.predict(same).values(), sf.predict(s).values())
    np.testing.assert_allclose(
        sf.predict(s).values(),
        sf.predict(sf.load_scenario({**s.to_mapping(), "network": {"agents": 2, "steps": 3, "link": 0.7}})).values(),
    )


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ('link={file="none.csv"}', "network.link.file: expected a file of links, got"),
        ('link={file="log.csv"}\nnodes=["z","q"]', "expected some of x, y, z, got 'q'"),
        ('link={file="log.csv"}\nagents=2', "network.agents: expected 3, the nodes of log.csv, got 2"),
        ('link={file="some.csv"}', "nothing known of a to b"),
    ],
)
def test_links_that_do_not_fit_a_scenario(tmp_path, network, message):
    written(tmp_path, log_of([(k, s, r, 1) for s in "xyz" for r in "xyz" if s != r for k in range(3)]))
    written(tmp_path, "receiver,sender,link\na,b,0.5\n", "some.csv")
    path = written(tmp_path, MODEL + f"[network]\nsteps=3\n{network}\n", "s.toml")
    assert message in run("scenario", "check", path, code=2).stderr


def test_delays_that_are_written_sum_to_one(tmp_path):
    rows = "".join(f"{k},{s},{r},1,{k},{k + k % 3 + 0.5}\n" for s, r in ("ab", "ba") for k in range(9))
    log = written(tmp_path, "seq,sender,receiver,received,sent_time,received_time\n" + rows)
    run("links", log, "--step", "1", "--write", tmp_path / "net.toml")
    path = written(tmp_path, MODEL + (tmp_path / "net.toml").read_text(), "s.toml")
    assert sf.load_scenario(path).network.delay == (1 / 3, 1 / 3, 1 / 3)


def test_a_network_that_is_written_can_be_predicted(tmp_path):
    log = written(
        tmp_path,
        log_of(
            [
                (k, s, r, int(k % 3 > 0))
                for s in "abc"
                for r in "abc"
                if s != r and (s, r) != ("a", "c")
                for k in range(9)
            ]
        ),
    )
    run("links", log, "--write", tmp_path / "net.toml")
    path = written(tmp_path, MODEL + (tmp_path / "net.toml").read_text(), "s.toml")
    s = sf.load_scenario(path)
    assert s.network.link[0, 1] == pytest.approx(2 / 3, abs=1e-6)
    assert not s.network.hears[2, 0]
    run("predict", path, "--steps", "2")


BAD = {
    "no such file": (None, "no such file"),
    "empty": ("", "expected links, got an empty file"),
    "Latin-1": ("seq,sender,receiver,received\n1,M\xfcller,b,1\n".encode("latin-1"), "line 2: expected text in UTF-8"),
    "codes": (log_of([(1, "a", "b", 1), (2, "a", "b", 7)]), "line 3, column 'received': expected 0 or 1, got '7'"),
    "negative": (log_of([(-1, "a", "b", 1)]), "line 2, column 'seq': expected a number of at least 0"),
    "itself": (log_of([(1, "a", "a", 1)]), "line 2, column 'receiver': expected another node than the sender, got 'a'"),
    "not a number": (log_of([("x", "a", "b", 1)]), "line 2, column 'seq': expected a whole number, got 'x'"),
    "NaN": (log_of([("nan", "a", "b", 1)]), "line 2, column 'seq': expected a whole number, got nothing"),
    "nobody": (log_of([(1, "", "b", 1)]), "line 2, column 'sender': expected a name, got nothing"),
    "columns": ("a,b\n1,2\n", "expected columns seq, sender, receiver, received"),
    "rows": ("seq,sender,receiver,received\n1,a,b,1,5\n", "line 2: expected 4 columns, got 5"),
    "twice": ("receiver,sender,link\na,b,0.5\na,b,0.6\n", "line 3, column 'link': expected each link once"),
    "probability": (
        "receiver,sender,link\na,b,1.5\n",
        "line 2, column 'link': expected a probability between 0 and 1, got '1.5'",
    ),
    "long line": ("x" * 3_000_000, "line 1: expected a line of headings"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files_get_one_message(tmp_path, kind):
    content, message = BAD[kind]
    path = tmp_path / "log.csv" if content is None else written(tmp_path, content)
    stderr = run("links", path, code=2).stderr
    assert message in stderr
    assert stderr.count("\n") == 1
    assert "expected a file, got a directory" in run("links", tmp_path, code=2).stderr


def mutations(count, seed):
    rng = random.Random(seed)
    base = log_of([(k, s, r, rng.randint(0, 1)) for s in "abc" for r in "abc" if s != r for k in range(4)])
    marks = [
        *"0123456789ab",
        ",",
        "\n",
        '"',
        "-",
        "9" * 30,
        "nan",
        "é",
        "\x00",
        " ",
        "1e5",
        ";",
        "inf",
        "",
        "\ufeff",
        "\r\n",
        "seq",
        "'",
    ]
    for _ in range(count):
        text = base
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(text) + 1)
            text = text[:at] + rng.choice(marks) + text[at + rng.choice((0, 1, 1, 1, 6)) :]
        yield text


def check_mutations(tmp_path, count, seed):
    answered, messages = 0, []
    for text in mutations(count, seed):
        path = written(tmp_path, text)
        try:
            found = read_links(path)
        except sf.UsageError as error:
            messages.append(str(error))
        else:
            answered += 1
            assert ((found.link >= 0) | np.isnan(found.link)).all()
    assert not any("\n" in message for message in messages)
    assert 0.05 * count < answered < 0.95 * count


def test_mutated_logs_give_an_answer_or_one_message(tmp_path):
    check_mutations(tmp_path, 400, 1)


@pytest.mark.slow
def test_many_mutated_logs_give_an_answer_or_one_message(tmp_path):
    check_mutations(tmp_path, 10_000, 2)


def test_the_figure_is_drawn(tmp_path):
    path = written(tmp_path, log_of([(k, s, r, int(k % 2)) for s in "abc" for r in "abc" if s != r for k in range(4)]))
    run("links", path, "--plot", tmp_path / "links.png")
    assert (tmp_path / "links.png").read_bytes().startswith(b"\x89PNG")


def test_a_scenario_names_the_columns_of_its_file(tmp_path):
    (tmp_path / "log.csv").write_text(
        "n,tx,rx,ok\n" + "".join(f"{k},{s},{r},{k % 2}\n" for k in range(6) for s, r in ("ab", "ba"))
    )
    scenario = {"model": {"F": 1, "H": 1, "Q": 25, "R": 100}, "initial": {"P": 100}}
    text = json.dumps(
        scenario
        | {
            "network": {
                "steps": 2,
                "link": {
                    "file": "log.csv",
                    "columns": {"seq": "n", "sender": "tx", "receiver": "rx", "received": "ok"},
                },
            }
        }
    )
    (tmp_path / "s.json").write_text(text)
    assert np.array_equal(sf.load_scenario(tmp_path / "s.json").network.link, [[0, 0.5], [0.5, 0]])
    for wrong, said in (('"oks"', "log.csv has no column 'oks'"), ("3", r"network\.link\.columns\.received: expected")):
        (tmp_path / "s.json").write_text(text.replace('"ok"', wrong))
        with pytest.raises(ScenarioError, match=said):
            sf.load_scenario(tmp_path / "s.json")
    (tmp_path / "none.csv").write_text("seq,sender,receiver,received\n")
    with pytest.raises(UsageError, match=r"none\.csv: expected packets, got no rows"):
        sf.links(tmp_path / "none.csv")
