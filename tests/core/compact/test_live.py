"""Records of the newest states for viewers that follow, fall behind or join late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.compact import CompactReader, FileError, LiveEncoder
from scas4d_core.compact.encoder import KEY_EVERY
from scas4d_core.compact.records import RecordKind
from tests.core.compact.test_files import BORN_AT, FRAMES, HEAD, TRUE, near, write


def fed(frames: tuple[int, ...] = FRAMES) -> LiveEncoder:
    encoder = LiveEncoder(HEAD)
    for index in frames:
        encoder.add(index, *TRUE[index])
    return encoder


def test_a_viewer_of_every_frame_has_the_same_file_as_the_writer(tmp_path: Path) -> None:
    encoder, received, last = LiveEncoder(HEAD), b"", None
    for index in FRAMES:
        encoder.add(index, *TRUE[index])
        received += encoder.records_after(last)
        last = index
    write(tmp_path / "a.s4d", close=False).abandon()
    assert received == (tmp_path / "a.s4d").read_bytes()


@pytest.mark.parametrize("missed", [1, 3, KEY_EVERY + 2])
def test_a_viewer_that_falls_behind_decodes_the_newest_state_bit_for_bit(tmp_path: Path, missed: int) -> None:
    every, some = tmp_path / "every.s4d", tmp_path / "some.s4d"
    write(every, close=False).abandon()
    with some.open("wb") as file:
        encoder, last = LiveEncoder(HEAD), None
        for number, index in enumerate(FRAMES):
            encoder.add(index, *TRUE[index])
            if number % (missed + 1) == 0 or index == FRAMES[-1]:
                file.write(encoder.records_after(last))
                last = index
    with CompactReader(some) as reader, CompactReader(every) as all_frames:
        near(reader, FRAMES[-1])
        found, true = reader.state(FRAMES[-1]), all_frames.state(FRAMES[-1])
        for name in ("means", "factors", "rotations", "colours", "retired", "ids"):
            assert np.array_equal(getattr(found, name), getattr(true, name)), name


def test_a_late_viewer_gets_a_header_the_births_and_the_last_key_frame(tmp_path: Path) -> None:
    (tmp_path / "late.s4d").write_bytes(fed().records_after(None))
    with CompactReader(tmp_path / "late.s4d") as reader:
        near(reader, FRAMES[-1])
        kinds = [record.kind for record in reader._records]
        assert kinds[:2] == [RecordKind.HEAD, RecordKind.BORN]
        assert kinds.count(RecordKind.KEY) == 1
        assert len(reader.frames) <= KEY_EVERY + 1  # the first state, and those from the key frame on
        assert {FRAMES[0], BORN_AT} <= {record.frame for record in reader._births}


def test_only_the_frames_since_the_last_key_are_kept() -> None:
    encoder = fed()
    assert len(encoder._states) <= KEY_EVERY


def test_a_frame_that_cannot_follow_is_refused() -> None:
    encoder = fed()
    with pytest.raises(FileError, match="cannot follow frame"):
        encoder.add(FRAMES[0], *TRUE[FRAMES[0]])
