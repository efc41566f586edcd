"""Tables, read by the csv module."""

import csv

import numpy as np
import pytest
from export_cases import corner, moving

from scas4d_core.errors import InputError
from scas4d_core.exports.tables import PoseTable, TrackTable
from scas4d_core.gaussians import quaternions_to_matrices


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def filled(table, states):
    for frame, state in enumerate(states):
        table.add(frame + 12, 1_700_000_000.25 + frame / 10, state)
    table.finish()
    return rows_of(table.path)


def numbers(rows, *names):
    return np.array([[float(row[name]) for name in names] for row in rows])


def test_tracks_of_what_moves(tmp_path):
    states = [moving.state(0), moving.state(1).retire([2])]
    rows = filled(TrackTable(tmp_path / "a.csv", corner.WORLD), states)
    assert [(row["frame"], row["id"]) for row in rows] == [
        *(("12", str(k)) for k in range(50, 58)),
        *(("13", str(k)) for k in (50, 51, 53, 54, 55, 56, 57)),
    ]
    truth = np.concatenate([corner.wanted(state).means[state.moving] for state in states])
    np.testing.assert_allclose(numbers(rows, "x", "y", "z"), truth, rtol=1e-10)
    assert [float(row["time"]) for row in rows[7:9]] == [1_700_000_000.25, 1_700_000_000.35]
    assert {row["confidence"] for row in rows} == {""}


def test_tracks_of_some_ids(tmp_path):
    rows = filled(TrackTable(tmp_path / "a.csv", corner.WORLD, ids=[59, 51]), [moving.state(0).retire([1])])
    assert [row["id"] for row in rows] == ["59"]  # Gaussian 51 is absent
    table = TrackTable(tmp_path / "b.csv", corner.WORLD, ids=[7, 59])
    table.add(12, 0.0, moving.state(0))
    with pytest.raises(InputError, match=r"unknown Gaussian ids \[7\]"):
        table.finish()
    table.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_poses_carry_the_parts(tmp_path):
    states = [moving.state(frame) for frame in range(3)]
    rows = filled(PoseTable(tmp_path / "a.csv", corner.WORLD, moving.LABELS), states)
    assert [(row["frame"], row["part"]) for row in rows] == [(str(f), str(p)) for f in (12, 13, 14) for p in (0, 1)]
    start = corner.wanted(states[0]).means
    shifts = numbers(rows, "tx", "ty", "tz").reshape(3, 2, 3)
    turns = quaternions_to_matrices(numbers(rows, "qw", "qx", "qy", "qz")).reshape(3, 2, 3, 3)
    for frame, state in enumerate(states):
        for part in (0, 1):
            mine = part == moving.LABELS
            carried = (start[mine] - shifts[0, part]) @ turns[frame, part].T + shifts[frame, part]
            np.testing.assert_allclose(carried, corner.wanted(state).means[mine], atol=2e-4)
    assert numbers(rows, "residual").max() < 1e-4


def test_given_up_or_unwritable(tmp_path):
    table = TrackTable(tmp_path / "a.csv", corner.WORLD)
    table.add(0, 0.0, moving.state(0))
    table.discard()
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"out '.*a\.csv' cannot be written"):
        PoseTable(tmp_path / "no" / "a.csv", corner.WORLD, moving.LABELS)
