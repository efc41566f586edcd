"""States of a history in memory that are moved to scratch files: the same bits, and no memory."""

from __future__ import annotations

import errno
import gc
import os
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from histories import filled, same, state

from scas4d_core.gaussians import PER_FRAME
from scas4d_core.storage import scratch_frames
from scas4d_core.storage.history import History

FRAME_BYTES = 4 * (3 + 9 + 4 + 3 + 1)
"""Of a Gaussian in a frame: place, factors, rotation, colour, label."""


def test_states_are_the_same_bits_and_the_history_goes_on(tmp_path: Path) -> None:
    history = filled(History())
    history.move_to_scratch(tmp_path)
    assert list(tmp_path.iterdir()) == []  # it has no name: nothing is left, however the process ends
    history.append(40, 2.0, state(40))
    history.move_to_scratch(tmp_path)
    for t in (0, 3, 8, 3, 7):
        assert same(history.gaussians(2 * t), state(t))
    assert same(history.newest, state(40))
    for name in PER_FRAME:
        stack = history.stacked(name, [4, 0, 16, 40])
        assert np.array_equal(stack, np.stack([state(t).arrays()[name] for t in (2, 0, 8, 40)]))
    history.save(tmp_path / "copy")
    assert same(History.load(tmp_path / "copy").gaussians(6), state(3))
    assert history.truncate(12) == [14, 16, 40]
    assert same(history.newest, state(6))


@pytest.mark.slow
def test_a_frame_costs_no_memory_any_more(tmp_path: Path) -> None:
    count, frames = 20_000, 12
    one = state(0, count)
    tracemalloc.start()
    try:
        peaks = []
        for aside in (False, True):
            history = History()
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            for index in range(frames):
                history.append(index, index / 30, one)
                if aside:
                    history.move_to_scratch(tmp_path)
            peaks.append((tracemalloc.get_traced_memory()[0] - before) / (count * FRAME_BYTES))
            del history
            gc.collect()
    finally:
        tracemalloc.stop()
    assert peaks[0] == pytest.approx(frames, abs=0.5)
    assert peaks[1] == pytest.approx(2, abs=0.5)


def test_without_room_states_stay_in_memory_and_room_is_asked_for_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    history, asked = filled(History()), []

    def full(**_: object) -> None:
        asked.append(1)
        raise OSError("no space left on device")

    monkeypatch.setattr(scratch_frames, "TemporaryFile", full)
    for _ in range(3):
        history.move_to_scratch(tmp_path)
    assert same(history.gaussians(6), state(3))
    assert asked == [1]


def test_empty_arrays_and_many_readers(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [
        {"a": rng.normal(size=(50, 3)), "none": np.zeros((0, 4), np.float32), "one": np.array(k)} for k in range(40)
    ]
    scratch = scratch_frames.ScratchFile(tmp_path)
    aside = [scratch.store(frame) for frame in frames]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda k: dict(aside[k % 40]), range(400)))
    for k, one in enumerate(found):
        assert all(np.array_equal(one[name], frames[k % 40][name]) for name in one)
        assert one["none"].shape == (0, 4)


def test_a_history_on_disk_has_no_use_for_it(tmp_path: Path) -> None:
    history = filled(History(tmp_path / "states"))
    history.move_to_scratch(tmp_path)
    assert same(history.gaussians(6), state(3))
    assert [path.name for path in tmp_path.iterdir()] == ["states"]


def test_the_older_states_of_a_long_history_are_aside_by_themselves() -> None:
    """A run of any length in one process takes no more memory than a short one."""
    count, frames = 5_000, 4 * scratch_frames.IN_MEMORY
    one, report = state(0, count), {"loss": [0.5] * 200}
    history = History()
    tracemalloc.start()
    try:
        sizes = {}
        for index in range(frames):
            history.append(index, index / 30, one, report | {"index": index})
            sizes[index] = tracemalloc.get_traced_memory()[0] / (count * FRAME_BYTES)
    finally:
        tracemalloc.stop()
    assert sizes[frames - 1] - sizes[scratch_frames.IN_MEMORY] < 2
    assert [history.report(index)["index"] for index in (0, 1, 20, frames - 1)] == [0, 1, 20, frames - 1]
    assert same(history.gaussians(5), one)
    assert history.truncate(5) == list(range(6, frames))
    history.append(6, 6.0, one, {"index": 7})
    assert history.report(6)["index"] == 7


def test_a_disk_that_fills_up_loses_no_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system takes a part of what it is given, and refuses the next."""
    room, write = [3 * 4096 + 100], os.pwrite

    def little(file: int, data: bytes, at: int) -> int:
        if room[0] <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = write(file, data[: min(len(data), room[0], 1000)], at)
        room[0] -= count
        return count

    monkeypatch.setattr(scratch_frames.os, "pwrite", little)
    history = History()
    for index in range(3 * scratch_frames.IN_MEMORY):
        history.append(index, index / 30, state(index), {"index": index})
    assert room[0] <= 0
    for index in range(3 * scratch_frames.IN_MEMORY):
        assert same(history.gaussians(index), state(index))
        assert history.report(index) == {"index": index}


def test_places_of_states_that_are_deleted_are_used_again(tmp_path: Path) -> None:
    history, sizes = History(), []
    for index in range(200):
        history.append(index, index / 30, state(0), {"index": index})
        history.retain(last=20)
        sizes.append(0 if history._scratch is None else history._scratch._end)
    assert sizes[-1] == sizes[60] > 0
    assert [history.report(index)["index"] for index in history.indices] == [0, *range(180, 200)]
    assert same(history.gaussians(185), state(0))


def test_a_file_that_was_cut_is_an_error() -> None:
    scratch = scratch_frames.ScratchFile(None)
    aside = scratch.store({"a": np.arange(4000.0)})
    os.ftruncate(scratch._file.fileno(), 8000)
    assert "a" in aside  # known without the file
    assert "b" not in aside
    with pytest.raises(OSError, match="at byte 8000"):
        aside["a"]
