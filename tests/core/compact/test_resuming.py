"""Compact files that are gone on with after a stop, copied in part, and annotated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.compact import CompactReader, CompactWriter, DamagedFileError, FileError
from scas4d_core.compact.planes import PlaneError
from scas4d_core.compact.records import note_bytes, read_note
from tests.core.compact.test_files import BORN_AT, FRAMES, HEAD, TRUE, near


def written(path: Path, frames: tuple[int, ...] = FRAMES) -> CompactWriter:
    writer = CompactWriter(path, HEAD)
    for index in frames:
        writer.add(index, *TRUE[index], note={"frame": index})
    return writer


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "a.s4d"
    written(path).close()
    return path


def test_a_file_cut_anywhere_is_gone_on_with_to_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    with CompactReader(whole) as reader:
        first_state = reader._states[0].end
    for cut in np.random.default_rng(3).integers(first_state, len(data) - 8, 25).tolist():
        path = tmp_path / f"{cut}.s4d"
        path.write_bytes(data[:cut])
        with CompactReader(path) as reader:
            if reader.is_closed:
                continue
            known = reader.frames
        with CompactWriter.resume(path) as writer:
            for index in FRAMES[len(known) :]:
                writer.add(index, *TRUE[index], note={"frame": index})
        with CompactReader(path) as reader:
            assert reader.frames == list(FRAMES)
            near(reader, FRAMES[-1])
        assert path.read_bytes() == data, cut


def test_what_has_no_state_or_is_whole_or_damaged_is_not_gone_on_with(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="start a new file"):
        CompactWriter.resume(whole)
    head = tmp_path / "head.s4d"
    CompactWriter(head, HEAD).close()
    head.write_bytes(head.read_bytes()[:-60])
    with pytest.raises(FileError, match="no state"):
        CompactWriter.resume(head)
    damaged = tmp_path / "damaged.s4d"
    data = bytearray(whole.read_bytes()[:-200])
    with CompactReader(whole) as reader:
        data[reader._states[4].offset + 5] ^= 4
    damaged.write_bytes(data)
    with CompactWriter.resume(damaged) as writer:  # the key after it is whole: what is told from there on is, too
        assert writer.head.bounds == HEAD.bounds
    data[reader._states[-1].offset + 5] ^= 4
    damaged.write_bytes(data)
    with pytest.raises(DamagedFileError, match="is damaged"):
        CompactWriter.resume(damaged)


@pytest.mark.parametrize(("first", "last"), [(0, 2), (5, 9), (14, 23), (20, 20), (0, 99)])
def test_a_copy_of_some_frames_has_their_bits(first: int, last: int, whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "copy.s4d"
    with CompactReader(whole) as reader, path.open("wb") as file:
        listed = reader.copy_records(first, last, file)
        file.close()
        with CompactReader(path) as copy:
            wanted = [index for index in FRAMES if first <= index <= last]
            assert copy.frames == listed
            assert set(wanted) <= set(listed)
            assert len(listed) <= len(wanted) + 8
            for index in wanted:
                for name, array in reader.state(index).arrays().items():
                    assert np.array_equal(array, copy.state(index).arrays()[name]), name
            assert copy.count == (290 if wanted[-1] >= BORN_AT else 250)


def test_a_copy_is_gone_on_with_and_a_copy_of_nothing_refused(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "copy.s4d"
    with CompactReader(whole) as reader, path.open("wb") as file:
        reader.copy_records(10, 12, file)
        with pytest.raises(FileError, match="no frames from 3 to 4"):
            reader.copy_records(3, 4, file)
    with CompactWriter.resume(path) as writer:
        writer.add(13, *TRUE[13])
    with CompactReader(path) as reader:
        near(reader, 13)
        assert reader.note(10) == {}


def test_notes_are_read_back_and_damage_is_told(whole: Path, tmp_path: Path) -> None:
    with CompactReader(whole) as reader:
        assert [reader.note(index)["frame"] for index in FRAMES] == list(FRAMES)
        worst = max(reader.note(index)["errors"]["position"] for index in FRAMES)
        assert worst == reader.about["errors"]["position"]
        assert reader.note(3) == {}
        place = reader._notes[7]
    data = bytearray(whole.read_bytes())
    data[place.offset + 1] ^= 1
    path = tmp_path / "damaged.s4d"
    path.write_bytes(data)
    with CompactReader(path) as reader:
        near(reader, 7)
        with pytest.raises(DamagedFileError, match="note record of frame 7"):
            reader.note(7)


@pytest.mark.parametrize("body", [b"", b"\x05\x00\x00\x00", b"\xff\xff\xff\xffabc", note_bytes({})[:-1]])
def test_a_body_that_is_no_note_is_refused(body: bytes) -> None:
    with pytest.raises(PlaneError):
        read_note(body)


def test_a_note_that_is_no_json_writes_nothing(tmp_path: Path) -> None:
    with CompactWriter(tmp_path / "a.s4d", HEAD) as writer:
        with pytest.raises(ValueError, match="JSON"):
            writer.add(0, *TRUE[0], note={"loss": float("nan")})
        writer.add(0, *TRUE[0], note={"loss": 0.5})
    with CompactReader(tmp_path / "a.s4d") as reader:
        assert reader.note(0)["loss"] == 0.5


def test_a_tail_of_zeros_is_cut_off(whole: Path, tmp_path: Path) -> None:
    """What a power cut leaves: the length of the file was written, its last bytes were not."""
    with CompactReader(whole) as reader:
        end = reader._states[-3].end
    path = tmp_path / "zeros.s4d"
    path.write_bytes(whole.read_bytes()[:end] + bytes(5000))
    with CompactReader(path) as reader:
        assert reader.damage is None
        assert reader.frames == list(FRAMES[:-2])
    with CompactWriter.resume(path) as writer:
        for index in FRAMES[-2:]:
            writer.add(index, *TRUE[index], note={"frame": index})
    assert path.read_bytes() == whole.read_bytes()


def test_a_copy_ends_before_what_is_damaged(whole: Path, tmp_path: Path) -> None:
    with CompactReader(whole) as reader:
        place = next(one for one in reader._states if one.frame == 9)
    data = bytearray(whole.read_bytes())
    data[place.offset + 9] ^= 2
    damaged, path = tmp_path / "damaged.s4d", tmp_path / "copy.s4d"
    damaged.write_bytes(data)
    with CompactReader(damaged) as reader, path.open("wb") as file:
        assert reader.copy_records(7, 20, file)[-1] == 8
        file.close()
        with CompactReader(path) as copy:
            near(copy, 8)
        with path.open("wb") as file, pytest.raises(DamagedFileError):
            reader.copy_records(9, 20, file)
