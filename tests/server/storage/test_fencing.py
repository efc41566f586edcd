"""What a worker still writes after another has its scene is never read, at whichever moment it goes on."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import CompactWriter, Head
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import History
from server.storage import fencing
from server.storage.disk import alone
from server.storage.fencing import FencingError, epoch_folder, epochs, found_epoch, publish, sweep, take_over
from server.storage.layout import SceneFolder

STATE = Gaussians.of_points(np.random.default_rng(0).normal(size=(20, 3)), radius=0.1)


@pytest.fixture
def states(tmp_path: Path) -> Path:
    """States of a scene: epoch 3 has frames 0 and 1, and is read."""
    states = tmp_path / "states"
    history = History.open(take_over(states, 3, None))
    for index in (0, 1):
        history.append(index, float(index), moved(index))
    publish(states, 3)
    return states


def moved(index: int, by: float = 1.0) -> Gaussians:
    return STATE.replace(means=STATE.means + np.float32(by * index))


def frames(states: Path) -> list[int]:
    return list(History.load(states).indices)


def test_the_next_epoch_has_what_was_committed(states: Path) -> None:
    folder = take_over(states, 4, 3)
    assert folder == epoch_folder(states, 4)
    assert frames(folder) == frames(states) == [0, 1]
    assert found_epoch(states) == 3
    publish(states, 4)
    assert found_epoch(states) == 4
    assert states.is_symlink()


def test_what_the_old_worker_writes_is_not_read(states: Path) -> None:
    """It commits a frame, and one again with other bits: neither shows, before the link is changed or after."""
    old = History.open(epoch_folder(states, 3))
    take_over(states, 4, 3)
    new = History.open(epoch_folder(states, 4))
    publish(states, 4)
    old.append(2, 2.0, moved(2, by=9.0))
    new.append(2, 2.0, moved(2))
    old.append(3, 3.0, moved(3, by=9.0))
    read = History.load(states)
    assert read.indices == [0, 1, 2]
    assert np.array_equal(read.gaussians(2).means, moved(2).means)


def test_a_reader_goes_on_over_the_change(states: Path) -> None:
    reader = History.load(states)
    take_over(states, 4, 3)
    History.open(epoch_folder(states, 4)).append(2, 2.0, moved(2))
    publish(states, 4)
    assert sweep(states, 4) == ["states.3"]
    reader.refresh()
    assert reader.indices == [0, 1, 2]
    assert np.array_equal(reader.gaussians(0).means, moved(0).means)


def test_a_compact_file_that_is_written_is_copied_and_a_whole_one_linked(states: Path) -> None:
    old = epoch_folder(states, 3)
    head = Head(WorldFrame(np.zeros(3)))
    with CompactWriter(old / "states_000000.s4d", head) as writer:
        writer.add(0, 0.0, STATE)
    growing = CompactWriter(old / "states_000120.s4d", head)
    growing.add(120, 4.0, STATE)
    size = growing.path.stat().st_size
    new = take_over(states, 4, 3)
    growing.add(121, 4.1, moved(1))
    growing.close()
    assert (new / "states_000120.s4d").stat().st_size == size
    assert (new / "states_000000.s4d").samefile(old / "states_000000.s4d")
    assert not (new / "states_000120.s4d").samefile(old / "states_000120.s4d")


def test_a_frame_that_moves_meanwhile_is_not_lost(states: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old worker compacts while its folder is linked: frames are in a compact file before their own files go."""
    old, link = epoch_folder(states, 3), os.link
    calls = []

    def moving(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 1:
            (old / "states_000000.s4d").write_bytes(b"has both")
            for index in (0, 1):
                (old / f"frame_{index:06}.npz").unlink()
        link(source, target)

    monkeypatch.setattr(fencing.os, "link", moving)
    folder = take_over(states, 4, 3)
    assert (folder / "states_000000.s4d").read_bytes() == b"has both"
    assert not list(states.parent.glob("*.part"))


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_commit_meanwhile_is_taken_over_whole(states: Path, monkeypatch: pytest.MonkeyPatch, place: int) -> None:
    """The old worker commits a frame, and compacts one that is linked already, or is not yet."""
    old, link = epoch_folder(states, 3), os.link
    (old / "checkpoint_000001.npz").touch()
    calls = []

    def working(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 1 + place:
            for name in ("checkpoint_000002.npz", "frame_000002.npz", "states_000000.s4d"):
                (old / name).write_bytes(b"new")
            (old / "frame_000000.npz").unlink()
        link(source, target)

    monkeypatch.setattr(fencing.os, "link", working)
    folder = take_over(states, 4, 3)
    assert sorted(os.listdir(folder)) == sorted(os.listdir(old))
    assert not (folder / "frame_000000.npz").exists()


def test_files_that_keep_vanishing_are_a_fault(states: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(source: Path, target: Path) -> None:
        raise FileNotFoundError(source)

    monkeypatch.setattr(fencing.os, "link", gone)
    with pytest.raises(FencingError, match=r"states\.3 kept changing"):
        take_over(states, 4, 3)
    assert sorted(epochs(states)) == [3]


def test_without_links_files_are_copied(states: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: Path, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(fencing.os, "link", refused)
    folder = take_over(states, 4, 3)
    assert frames(folder) == [0, 1]
    assert not (folder / "frame_000000.npz").samefile(states / "frame_000000.npz")


def test_a_folder_of_one_machine_becomes_that_of_epoch_0(tmp_path: Path) -> None:
    states = tmp_path / "states"
    History.open(states).append(0, 0.0, STATE)
    assert found_epoch(states) == 0
    assert states.is_symlink()
    assert frames(states) == [0]
    assert found_epoch(tmp_path / "states_2") is None


def test_a_stop_between_renaming_and_linking_loses_nothing(tmp_path: Path) -> None:
    states = tmp_path / "states"
    History.open(states).append(0, 0.0, STATE)
    states.rename(epoch_folder(states, 0))
    assert found_epoch(states) == 0
    assert frames(states) == [0]


def test_the_link_decides_not_the_highest_number(states: Path) -> None:
    """A worker that took over and was given up before it could say so has committed nothing."""
    take_over(states, 7, 3)
    assert found_epoch(states) == 3
    assert sorted(epochs(states)) == [3, 7]


def test_two_workers_of_one_epoch_cannot_both_have_it(states: Path) -> None:
    take_over(states, 4, 3)
    with pytest.raises(OSError, match="not empty"):
        take_over(states, 4, 3)


def test_a_link_that_comes_late_does_not_go_back(states: Path) -> None:
    take_over(states, 4, 3)
    take_over(states, 5, 3)
    publish(states, 5)
    publish(states, 4)
    assert found_epoch(states) == 5


def test_sweeping_leaves_later_epochs_and_other_reconstructions(states: Path) -> None:
    take_over(states, 4, 3)
    other = states.with_name("states_2.1")
    shutil.copytree(epoch_folder(states, 3), other)
    (states.parent / "states.2.abcd.part").mkdir()
    publish(states, 4)
    assert sweep(states, 4) == ["states.2.abcd.part", "states.3"]
    assert other.is_dir()


def test_a_worker_with_an_epoch_does_not_wait_for_one_that_stopped(tmp_path: Path) -> None:
    folder = SceneFolder(tmp_path)
    held = alone(SceneFolder(tmp_path, epoch=0), None)
    lock = alone(SceneFolder(tmp_path, epoch=1), 0)  # with the lock of the other it would wait for ever
    assert int(folder.worker_lock.read_text()) == os.getpid()
    assert sorted(epochs(folder.states)) == [0, 1]
    held.release()
    lock.release()


def test_what_reconstructions_before_left_is_found_with_its_epochs(states: Path) -> None:
    from server.storage.events import ReconstructionBegun

    event = ReconstructionBegun.model_construct(number=1, points=None)
    names = [path.name for path in SceneFolder(states.parent).leftovers(event)]
    assert names == ["states", "states.3"]
