"""Compaction: older states go to chunks, and everything reads them as before, after any stop and any damage."""

from __future__ import annotations

import contextlib
import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import Bounds, CompactReader, CompactWriter, FileHeader
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.frame_code import errors_of
from scas4d_core.gaussians import PER_FRAME, UNBORN, Gaussians
from scas4d_core.storage import compaction as compaction_module
from scas4d_core.storage.chunks import chunk_of
from scas4d_core.storage.compaction import Compaction
from scas4d_core.storage.history import DamagedFrameError, History, UnreadableFrameError

COUNT, EXACT, BORN_AT, RETIRED_AT = 30, 6, 9, 14


def head() -> FileHeader:
    return FileHeader(WorldFrame(np.zeros(3)))


def filled(folder: Path, count: int = COUNT) -> History:
    """A history with a gap, births and a retirement."""
    rng = np.random.default_rng(5)
    history = History(folder)
    state = Gaussians.of_points(rng.uniform(-1, 1, (300, 3)), 0.02, rng.uniform(size=(300, 3)))
    for index in (0, 1, *range(3, count)):
        state = state.replace(means=state.means + rng.normal(0, 0.01, state.means.shape).astype(np.float32))
        if index == BORN_AT:
            born = Gaussians.of_points(rng.uniform(-1, 1, (20, 3)), 0.02)
            state = state.concatenate(born.replace(ids=np.full(20, UNBORN)))
        if index == RETIRED_AT:
            state = state.retire([4, 305])
        history.append(index, index / 10, state, report={"frame": index, "loss": [0.1 * index]})
        state = history.gaussians(index)
    return history


@pytest.fixture(autouse=True)
def _short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compaction_module, "CHUNK_FRAMES", 10)


@pytest.fixture(scope="module")
def true(tmp_path_factory: pytest.TempPathFactory) -> History:
    return filled(tmp_path_factory.mktemp("true") / "states")


def compacted(history: History, exact: int = EXACT) -> list[int]:
    moving = Compaction(history, head, exact)
    moved = []
    while (index := moving.step()) is not None:
        moved.append(index)
    moving.close()
    return moved


def same(history: History, true: History, exact: set[int]) -> None:
    assert history.indices == true.indices
    assert history.times.tolist() == true.times.tolist()
    assert history.count == true.count
    limits = Bounds().record()
    for index in true.indices:
        state, wanted = history.gaussians(index), true.gaussians(index)
        assert history.report(index) == true.report(index)
        if index in exact:
            assert all(np.array_equal(array, wanted.arrays()[name]) for name, array in state.arrays().items())
        else:
            errors = errors_of(Columns.of(state), Columns.of(wanted))
            assert all(value <= 1.001 * limits[name] for name, value in errors.items()), (index, errors)
            assert not np.array_equal(state.means, wanted.means)
        assert np.array_equal(state.ids, wanted.ids)
        assert np.array_equal(state.own_opacities, wanted.own_opacities)
        assert np.array_equal(state.retired, wanted.retired)


def names(history: History) -> list[str]:
    assert history.directory is not None
    return sorted(path.name for path in history.directory.iterdir())


def made_again(history: History, true: History, index: int) -> None:
    arrays = {name: true.gaussians(index).arrays()[name] for name in PER_FRAME}
    history.replace(index, true.time(index), arrays, {"recomputed": True})


def test_older_states_are_read_from_chunks_by_all(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    other = History.load(tmp_path / "states")
    kept = other.gaussians(5)
    moved = compacted(history)
    exact = {0, *true.indices[-EXACT:]}
    assert moved == [index for index in true.indices if index not in exact]
    same(history, true, exact)
    same(History.load(tmp_path / "states"), true, exact)
    assert np.array_equal(other.gaussians(5).means, kept.means)  # in its memory still
    same(other, true, exact)  # it knew the files before they went
    files = [name for name in names(history) if chunk_of(name) is not None]
    assert len(files) == 3
    assert sum(name.startswith("frame_") for name in names(history)) == 1 + EXACT
    assert not history.pop_faults()
    assert np.isnan(history.stacked("means", [5, 20], np.array([310]))[0]).all()
    assert history.lives([history.ids[4]])[0].retired == (RETIRED_AT,)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a process that stops closes nothing
def test_a_stop_anywhere_loses_nothing_and_changes_no_byte(tmp_path: Path, true: History) -> None:
    """A stop after each write, sync and removal; what goes on with it ends with the same files."""
    filled(tmp_path / "whole")
    whole = History.load(tmp_path / "whole")
    compacted(whole)
    wanted = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    exact = {0, *true.indices[-EXACT:]}
    for seed, stops in enumerate((3, 4, 11, 12, 13, 23, 40)):
        folder = tmp_path / f"stop{seed}"
        history = filled(folder)
        calls = 0

        class Stop(BaseException):
            pass

        def stopping(function: Any, stops: int = stops, stop: type[BaseException] = Stop) -> Any:
            def called(*args: Any, **kwargs: Any) -> Any:
                nonlocal calls
                calls += 1
                if calls == stops:
                    raise stop
                return function(*args, **kwargs)

            return called

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(CompactWriter, "_append", stopping(CompactWriter._append))
            patched.setattr(CompactWriter, "sync", stopping(CompactWriter.sync))
            patched.setattr(Path, "unlink", stopping(Path.unlink))
            with pytest.raises(Stop):
                compacted(history)
        again = History.open(folder)
        assert again.indices == true.indices
        compacted(again)
        same(again, true, exact)
        found = {path.name: path.read_bytes() for path in folder.iterdir()}
        assert found.keys() == wanted.keys()
        assert [name for name in found if found[name] != wanted[name]] == [], stops


def test_a_state_is_written_by_another_thread_while_frames_are_appended(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    later = history.truncate(true.indices[-3])
    moving = Compaction(history, head, EXACT)
    due = moving.begin()
    assert due is not None
    with ThreadPoolExecutor(1) as thread:
        written = thread.submit(moving.write, due)
        for index in later:
            state = true.gaussians(index)
            history.append(index, true.time(index), state, report=true.report(index))
        assert moving.finish(due, written.result)
    assert not history.files.path(due.index).exists()
    while moving.step() is not None:
        pass
    moving.close()
    same(history, true, {0, *true.indices[-EXACT:]})


def test_a_full_disk_loses_nothing_and_is_tried_again(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    moving = Compaction(history, head, EXACT)
    for _ in range(4):
        moving.step()
    with pytest.MonkeyPatch.context() as patched:

        def full(self: CompactWriter) -> None:
            raise OSError(errno.ENOSPC, "no space")

        patched.setattr(CompactWriter, "sync", full)
        for _ in range(2):
            with pytest.raises(OSError, match="no space"):
                moving.step()
    while moving.step() is not None:
        pass
    moving.close()
    same(history, true, {0, *true.indices[-EXACT:]})
    held = [index for chunk in history.files.chunks.known.values() for index in chunk.frames]
    assert held == [index for index in true.indices[1:-EXACT]]  # each once


def damage_state(history: History, index: int) -> None:
    """Changes a bit of a frame's state within its chunk."""
    chunk = history.files.chunks.of(index)
    assert chunk is not None
    data = bytearray(chunk.path.read_bytes())
    place = next(one for one in history.files.chunks.reader(index)._states if one.frame == index)
    data[place.offset + place.size // 2] ^= 16
    chunk.path.write_bytes(data)


def test_a_damaged_chunk_hides_only_what_needs_it(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    damage_state(history, 6)
    reader = History.load(tmp_path / "states")
    readable = []
    for index in true.indices:
        with contextlib.suppress(DamagedFrameError):
            reader.gaussians(index)
            readable.append(index)
    hidden = set(true.indices) - set(readable)
    assert 6 in hidden
    assert max(hidden) <= 9
    assert len(hidden) <= 8
    assert all("frame 6" in reader.damaged[index] for index in hidden)
    assert set(reader.pop_faults()) == {f"frame_{index:06d}.npz" for index in hidden}
    assert reader.files.fault(6)
    assert reader.files.fault(4) is None
    # Made again, a frame has a file of its own, and that is read.
    assert history.files.fault(7)
    made_again(history, true, 7)
    assert np.array_equal(History.load(tmp_path / "states").gaussians(7).means, true.gaussians(7).means)
    assert History.load(tmp_path / "states").report(7) == {"recomputed": True}


def test_a_frame_whose_file_and_chunk_are_damaged_is_reported(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    made_again(history, true, 6)
    history.files.path(6).write_bytes(b"damaged")
    assert np.allclose(History.load(tmp_path / "states").gaussians(6).means, true.gaussians(6).means, atol=0.01)
    damage_state(history, 6)
    reader = History.load(tmp_path / "states")
    with pytest.raises(DamagedFrameError):
        reader.gaussians(6)
    assert "frame_000006.npz" in reader.pop_faults()


def test_a_chunk_that_is_gone_takes_its_frames_and_no_others(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    chunk = history.files.chunks.of(5)
    assert chunk is not None
    chunk.path.unlink()
    with pytest.raises(UnreadableFrameError):
        history.gaussians(5)
    again = History.open(tmp_path / "states")
    assert again.indices == [index for index in true.indices if index not in chunk.frames]


def test_retention_deletes_chunks_whole(tmp_path: Path) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    reader = History.load(tmp_path / "states")
    assert reader.gaussians(5) is not None
    assert history.retain(last=27) == []
    gone = history.retain(last=14)
    assert gone == [1, 3, 4, 5, 6, 7, 8, 9, 10, 11]
    assert history.indices == History.load(tmp_path / "states").indices
    assert 1 not in history
    assert reader.refresh(gone) == ([], gone)  # a reader that is told so notices
    with pytest.raises(UnreadableFrameError):
        reader.gaussians(5)
    assert history.retain(size_bytes=1) == list(range(12, COUNT - 2))
    assert history.indices == [0, COUNT - 2, COUNT - 1] == History.load(tmp_path / "states").indices
    assert not [name for name in names(history) if chunk_of(name) is not None]


def test_a_frame_made_again_goes_with_the_chunk_that_had_it(tmp_path: Path, true: History) -> None:
    for again in (1, 6, 11):
        folder = tmp_path / f"{again}"
        history = filled(folder)
        compacted(history)
        made_again(history, true, again)
        assert history.retain(last=27) == []
        assert history.retain(last=14) == [1, 3, 4, 5, 6, 7, 8, 9, 10, 11]
        assert History.load(folder).indices == history.indices == [0, *range(12, COUNT)]


def test_files_that_a_power_cut_brings_back_go_again(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    files = {index: history.files.path(index).read_bytes() for index in (5, 6, 20)}
    compacted(history)
    known = history.gaussians(6).means
    for index, data in files.items():
        history.files.path(index).write_bytes(data)
    again = History.open(tmp_path / "states")
    assert compacted(again) == []
    assert np.array_equal(again.gaussians(6).means, known)
    same(again, true, {0, *true.indices[-EXACT:]})


def test_no_file_goes_before_the_disk_has_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each frame: its record is written, the chunk is synced, and only then its own file goes; after a stop, too."""
    history = filled(tmp_path / "states")
    told: list[str] = []
    fsync, unlink = os.fsync, Path.unlink

    def synced(descriptor: int) -> None:
        told.append(f"sync {Path(os.readlink(f'/proc/self/fd/{descriptor}')).name}")
        fsync(descriptor)

    def gone(self: Path, missing_ok: bool = False) -> None:
        if self.name.startswith("frame_"):
            told.append(f"unlink {self.name}")
        unlink(self, missing_ok=missing_ok)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "unlink", gone)
    compacted(history)
    for place, what in enumerate(told):
        if what.startswith("unlink"):
            assert told[place - 1].startswith("sync states_"), told[: place + 1]
    files = {index: history.files.path(index) for index in (5,)}
    files[5].write_bytes(b"left by a stop before the sync")
    told.clear()
    compacted(History.open(tmp_path / "states"))
    assert told[:3] == ["sync states_000001.s4d", "sync states", "unlink frame_000005.npz"]


def test_a_disk_that_cannot_read_is_damage_and_no_crash(
    tmp_path: Path, true: History, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = filled(tmp_path / "states")
    compacted(history)

    def broken(self: CompactReader, *args: Any) -> Any:
        raise OSError(errno.EIO, "Input/output error")

    reader = History.load(tmp_path / "states")
    with monkeypatch.context() as patched:
        patched.setattr(CompactReader, "state", broken)
        with pytest.raises(DamagedFrameError, match="Input/output"):
            reader.gaussians(5)
    with monkeypatch.context() as patched:
        patched.setattr(CompactReader, "__init__", broken)
        found = History.open(tmp_path / "states")
        assert found.indices == [0, *true.indices[-EXACT:]]
        assert len(found.damaged_chunks) == 3
        assert compacted(found) == []


def test_the_sizes_of_frames_in_a_chunk_are_those_of_its_file(tmp_path: Path) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    for chunk in history.files.chunks.known.values():
        taken = sum(chunk.sizes)
        assert 0 <= chunk.path.stat().st_size - taken < 2000  # the index


def test_what_was_committed_is_taken_back_out_of_a_chunk(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    compacted(history)
    again = History.open(tmp_path / "states")
    again.truncate(after=16)
    assert again.indices == [index for index in true.indices if index <= 16]
    last = History.open(tmp_path / "states")
    assert last.indices == again.indices
    state = last.gaussians(16)
    last.append(17, 1.7, state, report={"again": True})
    assert compacted(last, exact=2) == []
    limits = Bounds().record()
    for index in last.indices[1:-1]:
        assert last.report(index)["frame"] == index
        errors = errors_of(Columns.of(last.gaussians(index)), Columns.of(true.gaussians(index)))
        assert all(value <= 1.001 * limits[name] for name, value in errors.items())
        assert np.array_equal(last.gaussians(index).retired, true.gaussians(index).retired)
    for index in range(18, 22):
        last.append(index, index / 10, last.gaussians(index - 1), report={"frame": index})
    assert compacted(last, exact=2) == [17, 18, 19]


def test_other_bounds_begin_another_chunk(tmp_path: Path) -> None:
    history = filled(tmp_path / "states")
    moving = Compaction(history, head, EXACT)
    for _ in range(3):
        moving.step()
    moving.close()
    finer = Compaction(history, lambda: FileHeader(WorldFrame(np.zeros(3)), Bounds(position=0.01)), EXACT)
    assert finer.step() == 5
    finer.close()
    chunk = history.files.chunks.of(5)
    assert chunk is not None
    assert chunk.first == 5
    assert history.files.chunks.reader(5).head.bounds.position == 0.01
    assert history.files.chunks.reader(4).is_closed


def test_a_frame_that_cannot_be_told_stays_exact(tmp_path: Path, true: History) -> None:
    history = filled(tmp_path / "states")
    path = history.files.path(8)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 8
    path.write_bytes(data)
    history = History.open(tmp_path / "states")
    moved = compacted(history)
    assert 8 not in moved
    assert path.exists()
    assert moved[-1] == true.indices[-EXACT - 1]
