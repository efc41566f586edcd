import os

import numpy as np
import pytest
from histories import filled, same, state

from scas4d_core.storage.frame_files import FrameFiles
from scas4d_core.storage.history import PER_FRAME, History, HistoryError


@pytest.mark.parametrize("on_disk", [False, True])
def test_gives_back_what_was_committed(tmp_path, on_disk):
    history = filled(History(tmp_path / "h" if on_disk else None))
    assert history.indices == list(range(0, 18, 2))
    np.testing.assert_allclose(history.times, np.arange(9) / 30)
    for t in (0, 8, 3, 0, 5, 1, 2, 4):
        assert same(history.gaussians(2 * t), state(t))
    for name in PER_FRAME:
        stack = history.stacked(name, [4, 0, 16])
        assert np.array_equal(stack, np.stack([state(t).arrays()[name] for t in (2, 0, 8)]))


def test_load_save_and_go_on(tmp_path):
    filled(History()).save(tmp_path / "copy")
    history = History.load(tmp_path / "copy")
    history.append(40, 2.0, state(40))
    again = History.load(tmp_path / "copy")
    assert again.indices == [*range(0, 18, 2), 40]
    assert again.time(40) == 2.0
    assert same(again.gaussians(40), state(40))
    assert same(again.gaussians(6), state(3))


def test_history_on_disk_does_not_hold_every_frame(tmp_path):
    history = filled(History(tmp_path))
    for index in history.indices:
        history.gaussians(index)
    assert len(history._frames) <= 4
    assert history.indices[-1] in history._frames


def test_the_callers_arrays_stay_the_callers():
    theta = state(0)
    history = History()
    history.append(0, 0.0, theta)
    theta.means[:] = 99
    assert same(history.gaussians(0), state(0))


def test_an_interrupted_write_leaves_the_history_as_it_was(tmp_path, monkeypatch):
    history = filled(History(tmp_path), 2)

    def torn(handle):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", torn)
    with pytest.raises(OSError, match="disk full"):
        history.append(9, 1.0, state(9))
    monkeypatch.undo()
    assert history.indices == [0, 2]
    assert sorted(f.name for f in tmp_path.glob("frame*")) == ["frame_000000.npz", "frame_000002.npz"]
    assert not list(tmp_path.glob(".*"))
    history.append(9, 1.0, state(9))
    assert same(History.load(tmp_path).gaussians(9), state(9))


def test_damage_is_found_and_the_file_named(tmp_path):
    filled(History(tmp_path), 3)
    file = tmp_path / "frame_000002.npz"
    content = bytearray(file.read_bytes())
    content[200] ^= 1  # within the data of the first array, means
    file.write_bytes(content)
    with pytest.raises(HistoryError, match=r"frame_000002\.npz"):
        History.load(tmp_path).gaussians(2)


def test_refusals_name_what_is_wrong(tmp_path):
    history = filled(History(tmp_path), 2)
    with pytest.raises(HistoryError, match="frame 2 is not after frame 2"):
        history.append(2, 0.0, state(2))
    with pytest.raises(HistoryError, match="ids differ"):
        history.append(3, 0.0, state(3).replace(ids=np.arange(7)))
    with pytest.raises(HistoryError, match="means has 6 rows; expected 7"):
        history.append(3, 0.0, state(3).replace(means=np.zeros((6, 3), np.float32)))
    with pytest.raises(HistoryError, match="frame 7 is not in the history; committed frames: 0 to 2"):
        history.gaussians(7)
    with pytest.raises(HistoryError, match="not stored per frame"):
        history.stacked("ids")
    with pytest.raises(HistoryError, match="already contains a history"):
        History(tmp_path)
    with pytest.raises(HistoryError, match="contains no history"):
        History.load(tmp_path / "elsewhere")


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_report_is_part_of_the_commit(tmp_path, on_disk):
    history = History(tmp_path / "h" if on_disk else None)
    report = {"psnr": 31.5, "seconds": {"render": 0.1 + 0.2}, "dropped": {"c1": "kaputt, 8×8"}, "error": None}
    history.append(3, 0.0, state(0), report)
    history.append(4, 0.1, state(1))
    assert (history.report(3), history.report(4)) == (report, {})
    history.report(3)["psnr"] = 0
    assert history.report(3) == report
    if on_disk:
        assert History.load(tmp_path / "h").report(3) == report
        history.save(tmp_path / "copy")
        assert History.load(tmp_path / "copy").report(3) == report
    for wrong in ({"loss": float("nan")}, {"array": np.zeros(3)}):
        with pytest.raises(HistoryError, match=r"frame 5: the report is not valid JSON"):
            history.append(5, 0.2, state(2), wrong)
    assert history.indices == [3, 4]


def test_a_reader_sees_what_the_writer_did_and_opens_only_what_is_new(tmp_path, monkeypatch):
    writer = filled(History(tmp_path), 3)
    reader = History.load(tmp_path)
    opened = []
    load = np.load
    monkeypatch.setattr(np, "load", lambda file, **given: opened.append(file.name) or load(file, **given))
    assert reader.refresh() == ([], [])
    assert opened == []
    writer.append(8, 1.0, state(8), {"psnr": 30.0})
    writer.append(9, 1.5, state(9))
    assert reader.indices == [0, 2, 4]
    assert reader.refresh() == ([8, 9], [])
    assert len(opened) == 2
    assert reader.time(9) == 1.5
    assert reader.report(8) == {"psnr": 30.0}
    assert same(reader.gaussians(8), state(8))
    assert writer.retain(last=2) == [2, 4]
    assert reader.refresh() == ([], [2, 4])
    assert reader.indices == writer.indices == [0, 8, 9]
    assert same(reader.gaussians(0), state(0))
    # Taken back and made anew, a frame is a new one: nothing of the old stays in memory.
    reader.gaussians(9)
    assert writer.truncate(8) == [9]
    writer.append(9, 1.6, state(10))
    assert reader.refresh() == ([9], [])
    assert reader.time(9) == 1.6
    assert same(reader.gaussians(9), state(10))


def test_a_reader_that_is_told_what_changed_looks_at_nothing_else(tmp_path, monkeypatch):
    writer = filled(History(tmp_path), 4)
    reader = History.load(tmp_path)
    alone = History.load(tmp_path, only=(2, 5))
    assert alone.indices == [2]
    assert same(alone.gaussians(2), state(1))
    monkeypatch.setattr(FrameFiles, "list_stamps", None)  # the directory is not looked through
    writer.append(8, 1.0, state(8))
    assert writer.retain(last=2) == [2, 4]
    assert reader.refresh((8, 2)) == ([8], [2])
    assert reader.indices == [0, 4, 6, 8]
    assert reader.refresh((4, 8, 99)) == ([], [4])
    assert reader.indices == writer.indices
    writer.truncate(6)
    writer.append(7, 0.9, state(7))
    assert reader.refresh((7, 8)) == ([7], [8])
    assert reader.indices == [0, 6, 7]
    # A frame between known ones comes to its place.
    between = History.load(tmp_path, only=(0, 7))
    assert between.refresh((6,)) == ([6], [])
    assert between.indices == [0, 6, 7]


def test_a_reader_that_asks_for_what_was_just_deleted_is_told(tmp_path):
    writer = filled(History(tmp_path), 6)
    reader = History.load(tmp_path)
    writer.retain(last=2)
    with pytest.raises(HistoryError, match="frame 4 is not in the history; committed frames: 0 to 10"):
        reader.gaussians(4)
    with pytest.raises(HistoryError, match="frame 2 is not in the history"):
        reader.stacked("means", [0, 2])


@pytest.mark.parametrize("on_disk", [False, True])
def test_retention_by_number_and_size(tmp_path, on_disk):
    def fresh(name):
        return filled(History(tmp_path / name if on_disk else None), 8)

    history = fresh("all")
    assert history.retain() == []
    assert len(history) == 8
    assert fresh("many").retain(last=100) == []
    history = fresh("three")
    assert history.retain(last=3) == [2, 4, 6, 8]
    assert history.retain(last=3) == []
    assert history.indices == [0, 10, 12, 14]
    np.testing.assert_allclose(history.times, np.array([0, 5, 6, 7]) / 30)
    assert same(history.gaussians(10), state(5))
    for index in (2, 8):
        with pytest.raises(HistoryError, match="not in the history"):
            history.gaussians(index)
    # The first and the newest two stay whatever the rule says.
    assert fresh("one").retain(last=1) == [2, 4, 6, 8, 10]
    assert fresh("byte").retain(size_bytes=1) == [2, 4, 6, 8, 10]
    history = fresh("size")
    sizes = history._stamps
    assert history.retain(size_bytes=sum(size for size, _ in sizes.values()) - sizes[2][0] - 1) == [2, 4]
    history.append(99, 9.0, state(9))
    for wrong in ({"last": 0}, {"size_bytes": -5}):
        with pytest.raises(HistoryError, match="must be at least 1, or None to keep all"):
            history.retain(**wrong)
    if on_disk:
        assert History.load(tmp_path / "size").indices == [0, *range(6, 16, 2), 99]
        assert len(list((tmp_path / "size").iterdir())) == 3 + 7


def test_retention_on_small_histories_deletes_nothing():
    for count in range(4):
        history = filled(History(), count)
        assert history.retain(last=1, size_bytes=1) == []
        assert len(history) == count


def test_a_damaged_frame_is_left_out_and_can_be_made_again(tmp_path):
    filled(History(tmp_path), 4)
    for index, content in ((2, b""), (6, b"PK\x03\x04 no zip")):
        (tmp_path / f"frame_{index:06d}.npz").write_bytes(content)
    history = History.open(tmp_path)
    assert history.indices == [0, 4]
    assert list(history.damaged) == [2, 6]
    with pytest.raises(HistoryError, match=r"frame 6 cannot be read: .*frame_000006\.npz"):
        history.gaussians(6)
    history.append(6, 0.5, state(3))
    assert same(History.load(tmp_path).gaussians(6), state(3))
    assert list(History.load(tmp_path).damaged) == [2]
    assert history.truncate(0) == [2, 4, 6]
    assert History.load(tmp_path).indices == [0]


def test_open_makes_or_loads_and_clears_what_was_cut_short(tmp_path):
    folder = tmp_path / "states"
    assert len(History.open(folder)) == 0
    filled(History.open(folder), 2)
    (folder / ".frame_000004.npz.123.part").write_bytes(b"half")
    assert History.open(folder).indices == [0, 2]
    assert not list(folder.glob(".*"))
