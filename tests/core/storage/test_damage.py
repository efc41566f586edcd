"""Flipped bits in the files of a history: each is noticed, or all that is read is what was written."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from histories import filled, same, state

from scas4d_core.checkpoint import Checkpoints
from scas4d_core.errors import message_of, without_paths
from scas4d_core.storage.faults import DamagedFrameError
from scas4d_core.storage.frame_files import FIRST_COPY, FIXED_COPY, FIXED_FILE
from scas4d_core.storage.history import History, HistoryError
from scas4d_core.storage.npz import read_npz, verify, write_npz


def small_state():
    arrays = {name: array for name, array in state(1, 2).arrays().items() if name not in ("ids", "opacities")}
    return {**arrays, "time": np.float64(0.5), "report": np.frombuffer(b'{"psnr": 30.0}', np.uint8)}


def small_checkpoint():
    """Every kind of array that a checkpoint holds: text, flags, empty ones, numbers, another order."""
    return {
        "format": np.int64(2),
        "names": np.array(["format", "labels"]),
        "labels": np.array([True, False]),
        "shown.names": np.array([], np.str_),
        "seen.c0": np.asfortranarray(np.arange(12, dtype=np.uint8).reshape(2, 2, 3)),
    }


FILES = {"state": small_state, "checkpoint": small_checkpoint, "fixed": lambda: {"ids": np.arange(3)}}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILES)
def test_every_flipped_byte_is_noticed_or_harmless(tmp_path, kind):
    file, written = tmp_path / "file.npz", FILES[kind]()
    write_npz(file, written)
    verify(file)
    content = file.read_bytes()
    noticed, said = 0, set()
    for at in range(len(content)):
        for bit in {1 << at % 8, 1 << (at + 3) % 8}:
            flipped = bytearray(content)
            flipped[at] ^= bit
            file.write_bytes(flipped)
            try:
                found = read_npz(file)
            except ValueError as error:
                said.add(str(error))
                noticed += 1
                continue
            if found.keys() != written.keys():  # the comment was cut off and a name changed: two bits
                pytest.fail(f"byte {at}, bit {bit}: {sorted(found)}")
            for name, array in written.items():
                assert found[name].dtype == np.asarray(array).dtype
                assert np.array_equal(found[name], array), (at, bit, name)
    assert not [text for text in said if str(tmp_path) in text]
    values = sum(np.asarray(array).nbytes for array in written.values())
    assert noticed > 2 * values  # every bit of a value at least


@pytest.mark.parametrize("kind", FILES)
def test_a_scrub_finds_what_reading_finds(tmp_path, kind):
    file = tmp_path / "file.npz"
    write_npz(file, FILES[kind]())
    content = file.read_bytes()
    for at in range(0, len(content), 7):
        flipped = bytearray(content)
        flipped[at] ^= 1 << at % 8
        file.write_bytes(flipped)
        try:
            verify(file)
        except ValueError:
            continue
        read_npz(file)


def test_a_file_without_checksums_is_refused(tmp_path):
    file = tmp_path / "file.npz"
    with file.open("wb") as opened:
        np.savez(opened, **small_state())
    for read in (verify, read_npz):
        with pytest.raises(
            ValueError, match=r"^file\.npz is damaged or is not an npz file \(ValueError: the file has no checksums"
        ):
            read(file)


def test_more_arrays_than_have_room_for_checksums_are_refused(tmp_path):
    with pytest.raises(ValueError, match="too many arrays for one file"):
        write_npz(tmp_path / "file.npz", {f"{'array' * 10}-{k}": np.zeros(1) for k in range(2000)})
    assert not list(tmp_path.iterdir())


def test_numpy_reads_the_members(tmp_path):
    write_npz(tmp_path / "file.npz", small_state())
    with np.load(tmp_path / "file.npz") as file:
        assert set(file.files) == set(small_state())
        assert json.loads(file.zip.comment)["blake2b"].keys() == small_state().keys()


@pytest.mark.parametrize(
    ("lost", "how"), [(name, how) for name in (FIXED_FILE, "frame_000000.npz") for how in ("gone", "flipped", "empty")]
)
def test_what_every_frame_needs_is_read_from_its_copy_and_mended(tmp_path, lost, how):
    filled(History(tmp_path), 4)
    whole = (tmp_path / lost).read_bytes()
    damage(tmp_path / lost, how)
    reader = History.load(tmp_path)
    assert reader.indices == [0, 2, 4, 6]
    assert same(reader.gaussians(0), state(0))
    assert reader.report(0) == {}
    assert lost in reader.pop_faults()
    assert reader.pop_faults() == {}
    writer = History.open(tmp_path)
    assert list(writer.repair_fixed()) == [lost]
    assert (tmp_path / lost).read_bytes() == whole
    assert writer.repair_fixed() == {}
    reader.refresh()
    assert same(reader.gaussians(0), state(0))


@pytest.mark.parametrize("lost", [FIXED_COPY, FIRST_COPY])
@pytest.mark.parametrize("how", ["gone", "flipped"])
def test_copies_are_made_again(tmp_path, lost, how):
    filled(History(tmp_path), 3)
    whole = (tmp_path / lost).read_bytes()
    damage(tmp_path / lost, how)
    writer = History.open(tmp_path)
    assert list(writer.repair_fixed()) == [lost]
    assert (tmp_path / lost).read_bytes() == whole


def test_a_copy_of_a_first_frame_that_was_never_committed_counts_for_nothing(tmp_path):
    filled(History(tmp_path), 1)
    (tmp_path / "frame_000000.npz").unlink()
    history = History.open(tmp_path)
    assert history.indices == []
    filled(history, 2)
    assert History.load(tmp_path).indices == [0, 2]


def damage(file, how):
    if how == "gone":
        file.unlink()
        return
    content = bytearray(file.read_bytes())
    content[200] ^= 4  # within the first array
    file.write_bytes(content if how == "flipped" else b"")


def test_a_damaged_state_is_left_out_until_another_file_is_there(tmp_path):
    writer = filled(History(tmp_path), 6)
    reader = History.load(tmp_path)
    content = (tmp_path / "frame_000004.npz").read_bytes()
    damage(tmp_path / "frame_000004.npz", "flipped")
    reader.refresh()
    assert 4 in reader.indices  # its time can be read
    with pytest.raises(DamagedFrameError, match=r"^frame_000004\.npz is damaged"):
        reader.gaussians(4)
    assert list(reader.pop_faults()) == ["frame_000004.npz"]
    assert reader.refresh() == ([], [])
    assert reader.indices == [0, 2, 6, 8, 10]
    with pytest.raises(DamagedFrameError, match="frame 4 cannot be read"):
        reader.stacked("means", [0, 4])
    assert writer.rewrite(4) is True
    assert (tmp_path / "frame_000004.npz").read_bytes() == content
    assert reader.refresh((4,)) == ([4], [])
    assert reader.indices == [0, 2, 4, 6, 8, 10]
    assert same(reader.gaussians(4), state(2))
    assert not writer.rewrite(2)  # too old to be in memory
    damage(tmp_path / "frame_000002.npz", "flipped")
    arrays = state(7).arrays()
    writer.replace(2, 1 / 30, arrays, {"recomputed": True})
    assert reader.refresh((2,)) == ([2], [])
    assert same(reader.gaussians(2), state(7).replace(opacities=state(0).opacities))
    assert reader.report(2) == {"recomputed": True}
    with pytest.raises(HistoryError, match="frame 10 cannot be replaced"):
        writer.replace(10, 9.0, arrays, {})


def test_a_state_that_somebody_deleted_is_told(tmp_path):
    filled(History(tmp_path), 6)
    reader = History.load(tmp_path)
    (tmp_path / "frame_000004.npz").unlink()
    with pytest.raises(HistoryError, match="frame 4 is not in the history"):
        reader.gaussians(4)
    assert reader.pop_faults() == {"frame_000004.npz": "frame_000004.npz is missing"}


def test_no_message_has_a_path(tmp_path):
    folder = tmp_path / "states"
    filled(History(folder), 3)
    for name in ("fixed.npz", "fixed.copy.npz"):
        (folder / name).write_bytes(b"no zip")
    said = []
    for call in (
        lambda: History.load(folder),
        lambda: History.load(tmp_path / "none"),
        lambda: History(folder),
        lambda: Checkpoints(folder).load(4, None),
        lambda: verify(folder / "fixed.npz"),
    ):
        with pytest.raises(ValueError, match=r"\w") as caught:
            call()
        said.append(message_of(caught.value))
    assert not [text for text in said if str(tmp_path) in text]
    shutil.rmtree(folder)


def test_paths_are_taken_out_of_foreign_messages(tmp_path):
    assert message_of(OSError(28, "No space left on device", f"{tmp_path}/a.npz")) == "No space left on device"
    assert without_paths(f"cannot open '{tmp_path}/a b.npz': {tmp_path}/x/y.npz").count(str(tmp_path)) == 0
    assert without_paths("GET /v1/scenes/abc, http://host/tmp/x, 3/4, a/b") == (
        "GET /v1/scenes/abc, http://host/tmp/x, 3/4, a/b"
    )
    assert message_of(ValueError(f"<_io.BufferedReader name='{tmp_path}/f'>")) == "<_io.BufferedReader name='f'>"


def test_as_many_cameras_as_a_rig_may_have_are_checked_too(tmp_path):
    """The comment of a zip has 65,535 bytes: checksums are shortened rather than left out."""
    file = tmp_path / "file.npz"
    pictures = {f"seen.{'camera' * 12}-{k}": np.full((2, 2), k, np.uint16) for k in range(640)}
    write_npz(file, pictures)
    verify(file)
    assert np.array_equal(read_npz(file)[f"seen.{'camera' * 12}-7"], pictures[f"seen.{'camera' * 12}-7"])
    content = file.read_bytes()
    assert b"blake2b" in content
    at = content.index(b"'shape': (2, 2)")  # in the header of an array: the CRC of its values is never compared
    file.write_bytes(content[:at] + b"'shape': (1, 2)" + content[at + 15 :])
    with pytest.raises(ValueError, match="damaged"):
        read_npz(file)
