"""Columns of tables: every kind of file gives the same, with and without pyarrow, and says where something is wrong."""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from stochfuse.data import columns, tables
from stochfuse.data.columns import LABEL, NUMBER, TEXT, WHOLE, ColumnField, ColumnsError, read_columns
from stochfuse.errors import StochfuseError

FIELDS = (
    ColumnField("run", LABEL),
    ColumnField("agent", TEXT),
    ColumnField("step", WHOLE, 1),
    ColumnField("z1"),
    ColumnField("note", TEXT, required=False, blank=True),
    ColumnField("nees", NUMBER, 0, required=False, blank=True),
    ColumnField("P", free=True, required=False),
)


@pytest.fixture(params=["pyarrow", "csv"])
def parser(request, monkeypatch):
    """With pyarrow, and as if it were not installed."""
    if request.param == "csv":
        monkeypatch.setattr(tables, "_arrow", lambda module: None)
    return request.param


def written(tmp_path: Path, text: str | bytes, name: str = "t.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def plain(found: columns.Columns) -> dict[str, list]:
    """All columns as lists, texts as such."""
    texts = {name: [None if c < 0 else names[c] for c in codes] for name, (codes, names) in found.text.items()}
    numbers = {name: [None if v != v else v for v in values.tolist()] for name, values in found.number.items()}
    return texts | numbers


TABLE = (
    "# made by hand\nrun,Agent,step, z1 ,note,nees,P\n\n"
    '7,base,1,0.5,"far, away",,1e3\n'
    '7, rover ,2,-1.25,"said ""no""",0.25,nan\n'
    "# pause\n\n8,base,1,+3,,12,-inf\n"
)


def test_a_csv_is_what_pythons_own_reader_says(tmp_path, parser):
    rows = [row for row in csv.reader(io.StringIO(TABLE)) if row and not row[0].startswith("#")]
    by_hand = {name.strip(): list(cells) for name, cells in zip(rows[0], zip(*rows[1:], strict=True), strict=True)}
    found = read_columns(written(tmp_path, TABLE), FIELDS)
    assert plain(found) == {
        "agent": [cell.strip() for cell in by_hand["Agent"]],
        "note": [cell or None for cell in by_hand["note"]],
        "run": [7, 7, 8],
        "step": [1, 2, 1],
        "z1": [float(cell) for cell in by_hand["z1"]],
        "nees": [None, 0.25, 12.0],
        "P": [1000.0, None, -np.inf],
    }
    assert [found.at(i) for i in range(3)] == [f"{tmp_path}/t.csv, line {n}" for n in (4, 5, 8)]
    assert found.at(2, "z1").endswith("line 8, column 'z1'")
    assert found.number["step"].dtype == np.int64
    assert found.blank["nees"].tolist() == [True, False, False]
    assert "P" not in found.blank
    assert (len(found), "run" in found, "note" in found, "R" in found) == (3, True, True, False)


def test_every_kind_of_table_gives_the_same(tmp_path, parser, monkeypatch):
    pandas, pa, pq = (pytest.importorskip(m) for m in ("pandas", "pyarrow", "pyarrow.parquet"))
    made = {
        "run": [3, 3, 10],
        "agent": ["b", "a", "b"],
        "step": [1, 2, 1],
        "z1": [0.5, 1.0, -2.0],
        "note": [None, "x", None],
        "nees": [0.25, None, 4.0],
    }
    text = "run;agent;step;z1;note;nees\n3;b;1;0.5;;0.25\n3;a;2;1.0;x;\n10;b;1;-2.0;;4.0\n"
    records = [dict(zip(made, row, strict=True)) for row in zip(*made.values(), strict=True)]
    pq.write_table(pa.table(made), tmp_path / "t.parquet")
    monkeypatch.setattr(sys, "stdin", io.StringIO(text.replace(";", "\t")))
    sources = [
        written(tmp_path, text),
        written(tmp_path, b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(), "crlf.csv"),
        written(tmp_path, text.replace("\n", "\r"), "cr.csv"),
        "-",
        written(tmp_path, json.dumps(made), "columns.json"),
        written(tmp_path, " " + json.dumps({"results": records}), "records.json"),
        str(tmp_path / "t.parquet"),
        made,
        {name: np.array(column) for name, column in made.items()},
        pandas.DataFrame(made),
        pandas.DataFrame(made).convert_dtypes(),
        pandas.DataFrame(made).astype({"agent": "category"}),
    ]
    found = [plain(read_columns(source, FIELDS)) for source in sources]
    assert found[0] == {**made, "nees": [0.25, None, 4.0]}
    assert all(each == found[0] for each in found[1:])


def test_places_in_tables_that_are_no_text(tmp_path):
    pandas, pa, pq = (pytest.importorskip(m) for m in ("pandas", "pyarrow", "pyarrow.parquet"))
    made = {"step": [1, 2, 0]}
    pq.write_table(pa.table(made), tmp_path / "t.parquet")
    wanted = (ColumnField("step", WHOLE, 1),)
    for source, where in (
        (tmp_path / "t.parquet", r"t\.parquet, record 3"),
        (written(tmp_path, json.dumps(made), "t.json"), r"t\.json, record 3"),
        (made, "arrays, row 2"),
        (pandas.DataFrame(made), "data frame, row 2"),
    ):
        with pytest.raises(ColumnsError, match=where + ", column 'step': expected a whole number of at least 1, got 0"):
            read_columns(source, wanted)


def test_runs_may_have_names(tmp_path, parser):
    found = read_columns(written(tmp_path, "run\nnorth 1\n12\nnorth 1\n"), FIELDS[:1])
    assert plain(found) == {"run": ["north 1", "12", "north 1"]}
    with pytest.raises(ColumnsError, match=r"line 3, column 'run': expected a whole number, got 'north'"):
        read_columns(written(tmp_path, "run\n12\nnorth\n"), FIELDS[:1])


@pytest.mark.slow
def test_blocks_make_up_the_whole(tmp_path, parser, monkeypatch):
    """Blocks that end anywhere, with lines left out here and there."""
    rng = np.random.default_rng(1)
    z = rng.normal(size=500).round(3)
    lines = ["run,agent,step,z1"]
    numbers = []
    for i, value in enumerate(z):
        lines += ["# a remark"] * (rng.random() < 0.1) + [""] * (rng.random() < 0.1)
        lines.append(f"{i // 7},a{i % 3},{1 + i % 7},{value}")
        numbers.append(len(lines))
    path = written(tmp_path, "\n".join(lines))
    whole = read_columns(path, FIELDS)
    for block in (1, 37, 1000):
        monkeypatch.setattr(tables, "BLOCK", block)
        joined = read_columns(path, FIELDS)
        assert plain(joined) == plain(whole)
        assert [joined.line(i) for i in range(500)] == numbers
    assert np.array_equal(whole.number["z1"], z)
    assert plain(whole)["agent"] == [f"a{i % 3}" for i in range(500)]


def test_renamed(tmp_path, parser):
    path = written(tmp_path, "k,Who,z1,y\n1,a,2,3\n")
    found = read_columns(path, [ColumnField("step", WHOLE), ColumnField("agent", TEXT), ColumnField("z1")], {"step": "K", "agent": "Who", "z1": "y"})  # fmt: skip
    assert plain(found) == {"step": [1], "agent": ["a"], "z1": [3.0]}
    assert found.skipped == ("z1",)
    with pytest.raises(ColumnsError, match=r"t\.csv: no column 'Wo' \(did you mean 'Who'\?\), to be used as 'agent'; the columns are k, Who, z1, y"):  # fmt: skip
        read_columns(path, [ColumnField("agent", TEXT)], {"agent": "Wo"})
    with pytest.raises(ColumnsError, match=r"columns: unknown column 'stop' \(did you mean 'step'\?\); expected step"):
        read_columns(path, [ColumnField("step", WHOLE)], {"stop": "k"})


def test_fields_may_depend_on_the_headings(tmp_path):
    path = written(tmp_path, "step,z1,z2,other\n1,2,3,4\n")
    found = read_columns(
        path, lambda names: [ColumnField("step", WHOLE), *(ColumnField(n) for n in names if n.startswith("z"))]
    )
    assert plain(found) == {"step": [1], "z1": [2.0], "z2": [3.0]}


def test_resolution(tmp_path, parser):
    path = written(tmp_path, "a,b,c\n1.25,3,1e-3\n1.5,2,0.1\n")
    found = read_columns(path, [ColumnField(n) for n in "abc"])
    assert [found.resolution(n) for n in "abc"] == [0.005, 0.5, 0.0]


HEAD = "run,agent,step,z1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty; expected columns run, agent, step, z1, note, nees, P"),
        ("\n# nothing\n", "empty; expected columns"),
        ("[]", "empty; expected columns"),
        (HEAD, "no rows under the headings run, agent, step, z1; expected columns run, agent"),
        (HEAD + "1,a,1,abc\n", "line 2, column 'z1': expected a number, got 'abc'"),
        (HEAD + "1,a,1,\n", "line 2, column 'z1': expected a number, got ''"),
        (HEAD + "1,a,1,nan\n", "line 2, column 'z1': expected a number, got 'nan'"),
        (HEAD + "1,a,1,2\n\n1,a,2,inf\n", "line 4, column 'z1': expected a number, got 'inf'"),
        (HEAD + "1,a,1.5,3\n", r"line 2, column 'step': expected a whole number of at least 1, got '1\.5'"),
        (HEAD + "1,a,0,3\n", "line 2, column 'step': expected a whole number of at least 1, got '0'"),
        (HEAD + "1, ,1,3\n", "line 2, column 'agent': expected a text, got ' '"),
        (HEAD + "1,a,1\n", "line 2: expected 4 cells, got 3"),
        (HEAD + "1,a,1,2\n1,a,1,2,9\n", "line 3: expected 4 cells, got 5"),
        (HEAD + '1,"a,1,2\n', "line 2: expected quotation marks in pairs, got '1,\"a,1,2'"),
        (HEAD.replace("z1", "P") + "1,a,1,xyz\n", "column 'z1' is missing from run, agent, step, P"),
        (HEAD.replace("z1", "z1,nees") + "1,a,1,2,-1\n", "line 2, column 'nees': expected a number of at least 0, got '-1'"),
        (HEAD.replace("z1", "z1,P") + "1,a,1,2,xyz\n", "line 2, column 'P': expected a number, got 'xyz'"),
        (HEAD.replace("z1", "z1,P") + "1,a,1,2,\n", "line 2, column 'P': expected a number, got ''"),
        (HEAD.replace("step", "stepp") + "1,a,1,2\n", r"column 'step' is missing from run, agent, stepp, z1 \(did you mean 'stepp'\?\)"),
        ("run,run,step\n1,1,1\n", "a column is named twice: run, run, step"),
        (b"run,agent,step,z1\n1,\xff,1,2\n", r"not a text file in UTF-8 \(byte 20\)"),
        ('[{"run": 1, "agent": "a", "step": 1, "z1": true}]', "record 1, column 'z1': expected a number, got True"),
        ('[{"run": 1, "agent": "a", "step": 1, "z1": null}]', "record 1, column 'z1': expected a number, got None"),
        ('[{"run": 1, "agent": "a", "step": 1, "z1": [2]}]', r"record 1, column 'z1': expected a number, got \[2\]"),
        ('[{"run": 1, "step": 1}, {"run": 1}]', "record 2: expected keys run, step, got run"),
        ("[7]", "record 1: expected an object, got 7"),
        ('{"run": [1], "step": [1, 2]}', "expected lists of one length, one per column, got {'run': 1, 'step': 2}"),
        ('{"run": 1}', "expected lists of one length"),
        ('{"run": ', "not valid JSON"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(text, message, tmp_path, parser):
    with pytest.raises(ColumnsError, match=message):
        read_columns(written(tmp_path, text), FIELDS)


def test_sources_that_are_none(tmp_path):
    with pytest.raises(ColumnsError, match=r"gone\.csv: no such file"):
        read_columns(tmp_path / "gone.csv", FIELDS)
    with pytest.raises(ColumnsError, match="cannot be read: Is a directory"):
        read_columns(tmp_path, FIELDS)
    with pytest.raises(ColumnsError, match="expected a file, got nothing"):
        read_columns("", FIELDS)
    with pytest.raises(ColumnsError, match="expected a file, a mapping of names to arrays or a data frame with columns, got int"):  # fmt: skip
        read_columns(7, FIELDS)
    with pytest.raises(ColumnsError, match=r"arrays: expected arrays of one length, got \{'a': 1, 'b': 2\}"):
        read_columns({"a": [1], "b": [1, 2]}, FIELDS)
    with pytest.raises(ColumnsError, match="arrays, column 'a': expected an array of one axis, got ndarray"):
        read_columns({"a": np.ones((2, 2))}, FIELDS)
    with pytest.raises(ColumnsError, match="unknown column 'colour'; expected a"):
        read_columns({"a": [1], "colour": [1]}, [ColumnField("a")], others=False)


def test_parquet_that_is_none(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    with pytest.raises(ColumnsError, match=r"t\.parquet: not a Parquet file"):
        read_columns(written(tmp_path, "run\n1\n", "t.parquet"), FIELDS)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(StochfuseError, match=r"t\.parquet: Parquet needs pyarrow: pip install 'stochfuse\[study\]'"):
        read_columns(tmp_path / "t.parquet", FIELDS)
