"""Files of a run: what is read of them, and what is said of those that cannot be meant."""

from __future__ import annotations

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.data.records import read_records


def scenario(**more):
    return sf.load_scenario({
        "model": {"F": 1.0, "H": 1.0, "Q": 0.5, "R": 2.0, "states": ["x"]},
        "initial": {"P": 10.0},
        "network": {"agents": 3, "steps": 4, "nodes": ["north", "south", "east"]},
        **more,
    })  # fmt: skip


def two_states(agents=()):
    made = {
        "model": {"F": np.eye(2), "H": np.eye(2), "Q": np.eye(2), "R": np.eye(2), "states": ["x", "v"]},
        "initial": {"P": np.eye(2)},
        "network": {"agents": 2, "steps": 3},
    }
    return sf.load_scenario({**made, "agent": list(agents)} if agents else made)


Z = {"step": [2, 2, 3], "agent": ["south", "1", "3"], "z1": [1.0, 2.0, 3.0]}


def batch(*args, **kwargs):
    records = read_records(*args, **kwargs)
    return records, next(records.batches())


def test_agents_go_by_name_and_by_number_and_rows_come_in_any_order():
    _, found = batch(scenario(), {"step": [3, 2, 2], "agent": ["3", "south", "north"], "z1": [3.0, 1.0, 2.0]})
    assert [z[0, :, 0].tolist() for z in found.z] == [[0, 2.0, 0], [0, 1.0, 0], [0, 0, 3.0]]
    assert found.missed[0].tolist() == [[False] * 3, [False, False, True], [True, True, False]]


def test_what_is_empty_was_missed():
    records, found = batch(scenario(), {"step": [2, 2, 2, 3], "agent": [1, 2, 3, 1], "z1": [1.0, np.nan, None, 2.0]})
    assert found.missed[0, 1].tolist() == [False, True, True]
    assert records.scenario.network.steps == 3


def test_a_record_longer_than_the_scenario_lengthens_it():
    records, found = batch(scenario(), {"step": [9], "agent": [1], "z1": [1.0]})
    assert records.scenario.network.steps == 9
    assert found.z[0].shape == (1, 9, 1)


def test_a_scenario_with_matrices_per_step_is_not_lengthened():
    s = sf.load_scenario({
        "model": {"F": [[[1.0]], [[0.9]]], "H": 1.0, "Q": 0.5, "R": 2.0},
        "initial": {"P": 10.0},
        "network": {"agents": 2, "steps": 2},
    })  # fmt: skip
    with pytest.raises(
        sf.UsageError, match=r"arrays, row 0, column 'step': expected at most the scenario's 2 steps, got 5"
    ):
        read_records(s, {"step": [5], "agent": [1], "z1": [1.0]})


def test_runs_are_sorted_and_told_apart():
    z = {"run": [10, 2, 2], "step": [2, 2, 3], "agent": [1, 1, 1], "z1": [1.0, 2.0, 3.0]}
    records, found = batch(scenario(), z, {"run": [10], "step": [2], "receiver": [1], "sender": [2]})
    assert records.names == ("2", "10")
    assert found.z[0][:, :, 0].tolist() == [[0, 2.0, 3.0], [0, 1.0, 0]]
    assert found.arrivals.heard == [[(1, 2, 4)] * 3, [(1, 2, 4), (3, 2, 4), (1, 2, 4)]]
    for names in (["²", "1"], ["--5", "1"]):  # digits, but no numbers
        assert batch(scenario(), {"run": names, "step": [2, 2], "agent": [1, 1], "z1": [1.0, 2.0]})[0].names == tuple(
            names
        )


def test_files_without_runs_hold_for_all():
    heard = {"run": ["a", "b"], "step": [2, 3], "receiver": [1, 1], "sender": [2, 3]}
    records, found = batch(scenario(), Z, heard, {"step": [2], "x": [7.0]})
    assert records.names == ("a", "b")
    assert found.z[0][:, 1, 0].tolist() == [2.0, 2.0]
    assert found.truth[:, 1, :, 0].tolist() == [[7.0] * 3] * 2
    assert np.isnan(found.truth[:, [0, 2]]).all()


def test_late_messages_keep_the_step_that_they_were_sent_in():
    heard = {"step": [3, 2], "receiver": [1, 2], "sender": [2, 3], "sent_step": [1, None]}
    _, found = batch(scenario(), Z, heard)
    assert found.arrivals.late == {(0, 1): ((0, 2, 1),)}
    assert found.arrivals.heard[0][1] == (1, 6, 4)


def test_a_packet_log_is_one_packet_a_step():
    log = {"seq": [0, 0, 1, 2], "sender": [1, 2, 1, 1], "receiver": [2, 1, 3, 2], "received": [1, 0, 1, 1]}
    records, found = batch(scenario(), Z, log)
    assert found.arrivals.heard[0] == [(1, 3, 4), (1, 2, 5), (1, 3, 4)]
    assert "arrays: a packet log; packet 0 is taken for step 1's" in records.notes


def test_the_same_row_and_the_same_message_count_once():
    z = {"step": [2, 2], "agent": [1, 1], "z1": [1.0, 1.0]}
    heard = {"step": [2, 2, 3], "receiver": [1, 1, 1], "sender": [2, 2, 2], "sent_step": [2, 2, 2]}
    records, found = batch(scenario(), z, heard)
    assert found.arrivals.late == {}
    assert "arrays: 1 rows are there twice, and count once" in records.notes
    assert "arrays: 2 messages came again; the first time counts" in records.notes


def test_step_one_is_not_measured():
    records, found = batch(scenario(), {"step": [1, 2], "agent": [1, 1], "z1": [5.0, 1.0]})
    assert "arrays: 1 measurements of step 1 are not used: estimates begin there" in records.notes
    assert found.z[0][0, :, 0].tolist() == [0.0, 1.0]


def test_part_of_the_truth_says_what_is_known():
    records = read_records(
        two_states(), {"step": [2], "agent": [1], "z1": [1.0], "z2": [2.0]}, truth={"step": [2], "v": [3.0]}
    )
    assert records.known.tolist() == [1]
    assert "arrays: nothing is known of x: NEES is that of v" in records.notes


def test_columns_may_have_other_names():
    _, found = batch(
        scenario(),
        {"k": [2], "who": ["east"], "range": [4.0]},
        {"k": [2], "to": [1], "sender": [3]},
        columns={"step": "k", "agent": "who", "z1": "range", "receiver": "to"},
    )
    assert found.z[2][0, 1, 0] == 4.0
    assert found.arrivals.heard[0][1] == (5, 2, 4)
    with pytest.raises(sf.UsageError, match=r"columns: unknown column 'stepp' \(did you mean 'step'\?\)"):
        read_records(scenario(), Z, columns={"stepp": "k"})


BAD = [
    (
        {"step": [2], "agent": [4], "z1": [1.0]},
        r"row 0, column 'agent': expected an agent from 1 to 3, or north, south, east, got '4'",
    ),
    ({"step": [2], "agent": ["nort"], "z1": [1.0]}, r"got 'nort' \(did you mean 'north'\?\)"),
    ({"step": [0], "agent": [1], "z1": [1.0]}, r"column 'step': expected a whole number of at least 1, got 0"),
    ({"step": [2], "agent": [1], "z1": [np.inf]}, r"column 'z1': expected a finite number or nothing, got inf"),
    (
        {"step": [2, 2], "agent": [1, 1], "z1": [1.0, 2.0]},
        r"row 1: expected one row for each run, step and agent, got another than in row 0",
    ),
    ({"step": [2], "agent": [1]}, r"column 'z1' is missing"),
]


@pytest.mark.parametrize(("z", "message"), BAD)
def test_measurements_that_cannot_be_meant(z, message):
    with pytest.raises(sf.UsageError, match=message):
        read_records(scenario(), z)


def test_components_are_all_there_or_none():
    with pytest.raises(sf.UsageError, match="column 'z1': expected all of z1, z2 and no more, or none, got z1"):
        read_records(two_states(), {"step": [2], "agent": [1], "z1": [1.0], "z2": [None]})
    with pytest.raises(sf.UsageError, match="expected all of z1, z2 and no more, or none, got z2"):
        read_records(two_states(), {"step": [2], "agent": [1], "z1": [None], "z2": [1.0]})


def test_an_agent_without_a_sensor_measures_nothing():
    s = two_states([{"sensor": False}, {}])
    with pytest.raises(sf.UsageError, match="column 'agent': expected an agent with a sensor, got '1' without one"):
        read_records(s, {"step": [2], "agent": [1], "z1": [1.0], "z2": [1.0]})


ODD = [
    (
        {"step": [2], "receiver": [1], "sender": [1]},
        "column 'receiver': expected another agent than the sender, got '1'",
    ),
    (
        {"step": [2], "receiver": [1], "sender": [2], "sent_step": [3]},
        "column 'sent_step': expected a step up to 2, got 3",
    ),
    ({"step": [2], "receiver": [1], "sender": ["west"]}, "column 'sender': expected an agent from 1 to 3"),
]


@pytest.mark.parametrize(("heard", "message"), ODD)
def test_arrivals_that_cannot_be_meant(heard, message):
    with pytest.raises(sf.UsageError, match=message):
        read_records(scenario(), Z, heard)


def test_truth_and_runs_that_do_not_fit():
    with pytest.raises(sf.UsageError, match="truth: expected states as columns, some of x; got step, y"):
        read_records(scenario(), Z, truth={"step": [2], "y": [1.0]})
    with pytest.raises(sf.UsageError, match="row 1, column 'run': run '2' is not in arrays; expected the same runs"):
        read_records(
            scenario(),
            {"run": [1], **{k: v[:1] for k, v in Z.items()}},
            truth={"run": [1, 2], "step": [2, 2], "x": [0, 0]},
        )
    with pytest.raises(sf.UsageError, match="arrays: expected a first estimate of every agent, got none of agent 2"):
        read_records(scenario(), Z, first={"agent": [1, 3], "x": [0.0, 0.0]})


def test_links_that_the_scenario_does_not_have_are_told():
    s = scenario(network={"agents": 3, "steps": 4, "architecture": "cyclic"})
    records = read_records(s, {"step": [2], "agent": [1], "z1": [1.0]}, {"step": [2], "receiver": [1], "sender": [3]})
    assert "arrays: 1 messages came over links that the scenario does not have" in records.notes


def test_a_csv_names_its_line(tmp_path):
    path = tmp_path / "z.csv"
    path.write_text("step,agent,z1\n2,north,1.5\n2,nobody,1\n")
    with pytest.raises(sf.UsageError, match=r"z\.csv, line 3, column 'agent': expected an agent from 1 to 3"):
        read_records(scenario(), path)
