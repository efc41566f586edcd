"""Files of another format are refused by name, and stay as they are."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from box_scene import make_box

from scas4d_core.cameras import WorldFrame
from scas4d_core.checkpoint import CarryOver, CheckpointError, Checkpoints, find_commit
from scas4d_core.compact import CompactWriter, FileHeader, FormatError
from scas4d_core.compact import head as head_module
from scas4d_core.storage import frame_files
from scas4d_core.storage.chunks import chunk_file
from scas4d_core.storage.faults import HistoryError, OtherFormatError
from scas4d_core.storage.history import History
from scas4d_core.storage.npz import pack_arrays, read_npz, unpack_arrays, write_npz
from scas4d_core.update.view_factory import ViewFactory

FRAMES = 3


def written(folder: Path, frames: int = FRAMES) -> History:
    history = History(folder)
    for index in range(frames):
        history.append(index, 0.1 * index, make_box(), report={"psnr": 30.0})
    return history


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def with_format(folder: Path, written: int | None) -> None:
    """Both copies of the file that names the format of the folder, with another one or none."""
    for name in (frame_files.FIXED_FILE, frame_files.FIXED_COPY):
        arrays = read_npz(folder / name)
        del arrays["format"]
        write_npz(folder / name, arrays if written is None else {**arrays, "format": np.int64(written)})


@pytest.mark.parametrize("frames", [0, FRAMES])
@pytest.mark.parametrize(
    ("format_", "said"),
    [(7, "state folder states has format 7, but this version of scas4d reads format 1; use the version"),
     (None, "state folder states has no format number, but this version of scas4d reads format 1; use the version")],
)  # fmt: skip
def test_a_folder_of_states_of_another_format(format_: int | None, said: str, frames: int, tmp_path: Path) -> None:
    folder = tmp_path / "states"
    written(folder)
    for index in range(frames, FRAMES):
        (folder / frame_files.frame_file(index)).unlink()
    (folder / frame_files.FIRST_COPY).unlink()
    with_format(folder, format_)
    (folder / ".frame_000009.npz.1.part").write_bytes(b"of a process that died")
    before = contents(folder)
    for opened in (History.load, History.open):
        with pytest.raises(OtherFormatError, match=said):
            opened(folder)
    assert contents(folder) == before


def test_the_format_is_read_from_the_copy_where_the_file_is_damaged(tmp_path: Path) -> None:
    written(tmp_path / "states")
    with_format(tmp_path / "states", 7)
    (tmp_path / "states" / frame_files.FIXED_FILE).write_bytes(b"")
    with pytest.raises(HistoryError, match="has format 7"):
        History.load(tmp_path / "states")
    written(tmp_path / "ours")
    (tmp_path / "ours" / frame_files.FIXED_FILE).write_bytes(b"")
    assert History.load(tmp_path / "ours").indices == list(range(FRAMES))


def test_a_mended_folder_has_its_format(tmp_path: Path) -> None:
    history = written(tmp_path / "states")
    (tmp_path / "states" / frame_files.FIXED_FILE).unlink()
    assert frame_files.FIXED_FILE in history.repair_fixed()
    (tmp_path / "states" / frame_files.FIXED_COPY).unlink()
    assert History.load(tmp_path / "states").indices == list(range(FRAMES))


@pytest.mark.parametrize("missing", ["structure", "names"])
def test_a_checkpoint_that_lost_an_array_is_damaged(missing: str, tmp_path: Path) -> None:
    folder = tmp_path / "states"
    history, checkpoints = written(folder), Checkpoints(folder)
    factory: ViewFactory = None  # type: ignore[assignment]  # no checkpoint here has pictures
    for index in (FRAMES - 2, FRAMES - 1):
        checkpoints.save(index, CarryOver())
    file = folder / frame_files.checkpoint_file(FRAMES - 1)
    arrays = unpack_arrays(read_npz(file))
    del arrays[missing]
    write_npz(file, pack_arrays(arrays))
    with pytest.raises(CheckpointError, match=missing):
        checkpoints.load(FRAMES - 1, factory)
    index, carried, faults = find_commit(history, checkpoints, factory, lambda index: True)
    assert (index, carried is not None, len(faults)) == (FRAMES - 2, True, 1)  # the checkpoint before is used


def test_a_compact_file_of_another_version_among_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "states"
    written(folder)
    with monkeypatch.context() as patched:
        patched.setattr(head_module, "VERSION", 4)
        with CompactWriter(folder / chunk_file(1), FileHeader(WorldFrame(np.zeros(3)))) as writer:
            writer.add(1, 0.1, make_box())
        assert json.loads(FileHeader(WorldFrame(np.zeros(3))).text())["version"] == 4
    before = contents(folder)
    with pytest.raises(
        OtherFormatError, match=r"states_000001\.s4d.* version 4, but this version of scas4d reads version 1; use"
    ):
        History.load(folder)
    assert contents(folder) == before
    shutil.rmtree(folder)


def test_a_compact_file_of_another_version_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scas4d_core.compact import CompactReader

    path = tmp_path / "states.s4d"
    with monkeypatch.context() as patched:
        patched.setattr(head_module, "VERSION", 4)
        with CompactWriter(path, FileHeader(WorldFrame(np.zeros(3)))) as writer:
            writer.add(0, 0.0, make_box())
    with pytest.raises(FormatError, match=r"states\.s4d has compact 4D format version 4"):
        CompactReader(path)
