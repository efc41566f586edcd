"""What a worker still writes after another has its scene is never read, at whichever moment it goes on."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import CompactWriter, FileHeader
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import History
from server.storage import fencing
from server.storage.disk import FolderLock, lock_states
from server.storage.fencing import FencingError, begin_epoch, current_epoch, epochs, remove_earlier_epochs, repair_link
from server.storage.layout import SceneFolder, epoch_folder

STATE = Gaussians.of_points(np.random.default_rng(0).normal(size=(20, 3)), radius=0.1)


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    return SceneFolder(tmp_path).worker_lock


@pytest.fixture
def states(tmp_path: Path, lock: Path) -> Path:
    """States of a scene: epoch 0 has frames 0 and 1, and is read."""
    states = tmp_path / "states"
    assert begin_epoch(states, lock) == 0
    history = History.open(epoch_folder(states, 0))
    for index in (0, 1):
        history.append(index, float(index), moved(index))
    return states


def moved(index: int, by: float = 1.0) -> Gaussians:
    return STATE.replace(means=STATE.means + np.float32(by * index))


def frames(states: Path) -> list[int]:
    return list(History.load(states).indices)


def test_the_next_epoch_has_what_was_committed_and_is_read(states: Path, lock: Path) -> None:
    assert current_epoch(states) == 0
    assert begin_epoch(states, lock) == 1
    assert current_epoch(states) == 1
    assert states.is_symlink()
    assert states.resolve() == epoch_folder(states, 1)
    assert frames(states) == frames(epoch_folder(states, 0)) == [0, 1]


def test_what_the_old_worker_writes_is_not_read(states: Path, lock: Path) -> None:
    """It commits a frame, and one again with other bits, before the new worker has committed anything and after."""
    old = History.open(epoch_folder(states, 0))
    begin_epoch(states, lock)
    old.append(2, 2.0, moved(2, by=9.0))
    assert frames(states) == [0, 1]
    History.open(epoch_folder(states, 1)).append(2, 2.0, moved(2))
    old.append(3, 3.0, moved(3, by=9.0))
    read = History.load(states)
    assert read.indices == [0, 1, 2]
    assert np.array_equal(read.gaussians(2).means, moved(2).means)


def test_a_reader_goes_on_over_the_change(states: Path, lock: Path) -> None:
    reader = History.load(states)
    begin_epoch(states, lock)
    History.open(epoch_folder(states, 1)).append(2, 2.0, moved(2))
    assert remove_earlier_epochs(states, 1) == ["states.0"]
    reader.refresh()
    assert reader.indices == [0, 1, 2]
    assert np.array_equal(reader.gaussians(0).means, moved(0).means)


def test_a_compact_file_that_is_written_is_copied_and_a_whole_one_linked(states: Path, lock: Path) -> None:
    old = epoch_folder(states, 0)
    head = FileHeader(WorldFrame(np.zeros(3)))
    with CompactWriter(old / "states_000000.s4d", head) as writer:
        writer.add(0, 0.0, STATE)
    growing = CompactWriter(old / "states_000120.s4d", head)
    growing.add(120, 4.0, STATE)
    size = growing.path.stat().st_size
    new = epoch_folder(states, begin_epoch(states, lock))
    growing.add(121, 4.1, moved(1))
    growing.close()
    assert (new / "states_000120.s4d").stat().st_size == size
    assert (new / "states_000000.s4d").samefile(old / "states_000000.s4d")
    assert not (new / "states_000120.s4d").samefile(old / "states_000120.s4d")


def test_a_frame_that_moves_meanwhile_is_not_lost(states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old worker compacts while its folder is linked: frames are in a compact file before their own files go."""
    old, link = epoch_folder(states, 0), os.link
    calls = []

    def moving(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 1:
            (old / "states_000000.s4d").write_bytes(b"has both")
            for index in (0, 1):
                (old / f"frame_{index:06}.npz").unlink()
        link(source, target)

    monkeypatch.setattr(fencing.os, "link", moving)
    folder = epoch_folder(states, begin_epoch(states, lock))
    assert (folder / "states_000000.s4d").read_bytes() == b"has both"
    assert not list(states.parent.glob("*.part"))


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_commit_meanwhile_is_taken_over_whole(
    states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """The old worker commits a frame, and compacts one that is linked already, or is not yet."""
    old, link = epoch_folder(states, 0), os.link
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
    folder = epoch_folder(states, begin_epoch(states, lock))
    assert sorted(os.listdir(folder)) == sorted(os.listdir(old))
    assert not (folder / "frame_000000.npz").exists()


def test_files_that_keep_vanishing_are_a_fault(states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(source: Path, target: Path) -> None:
        raise FileNotFoundError(source)

    monkeypatch.setattr(fencing.os, "link", gone)
    with pytest.raises(FencingError, match=r"states\.0 kept changing"):
        begin_epoch(states, lock)
    assert current_epoch(states) == 0
    assert sorted(path.name for path in states.parent.glob("states*")) == ["states", "states.0"]


def test_a_full_disk_leaves_nothing_behind(states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(fencing.os, "link", full)
    monkeypatch.setattr(fencing, "_copy", full)
    with pytest.raises(OSError, match="No space left"):
        begin_epoch(states, lock)
    assert current_epoch(states) == 0
    assert sorted(path.name for path in states.parent.iterdir()) == ["states", "states.0"]


def test_a_link_that_cannot_be_moved_leaves_all_as_it_was(
    states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, target: Path) -> Path:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(OSError, match="Input/output"):
        begin_epoch(states, lock)
    monkeypatch.undo()
    assert current_epoch(states) == 0
    assert sorted(path.name for path in states.parent.iterdir()) == ["states", "states.0"]
    assert begin_epoch(states, lock) == 1
    assert frames(states) == [0, 1]


def test_workers_that_end_before_they_work_do_not_fill_the_disk(states: Path, lock: Path) -> None:
    """Sweeping waits for a worker that works."""
    for _ in range(3 * fencing.MAX_REMAINING):
        begin_epoch(states, lock)
    assert len(epochs(states)) == fencing.MAX_REMAINING
    assert max(epochs(states)) == current_epoch(states)
    assert frames(states) == [0, 1]


def test_a_folder_that_is_read_stays_where_the_disk_does_not_say_that_the_link_was_moved(
    states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(folder: Path) -> None:
        if current_epoch(states) == 1:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(fencing, "sync_folder", fails)
    with pytest.raises(OSError, match="Input/output"):
        begin_epoch(states, lock)
    assert frames(states) == [0, 1]


def test_links_that_were_never_moved_go_at_the_next_beginning_and_not_while_one_is_made(
    states: Path, lock: Path
) -> None:
    left = states.with_name(".states.0a1b.link")
    left.symlink_to("states.0")
    remove_earlier_epochs(states, 0)
    assert left.is_symlink()
    begin_epoch(states, lock)
    assert not left.is_symlink()


def test_without_links_files_are_copied(states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: Path, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(fencing.os, "link", refused)
    folder = epoch_folder(states, begin_epoch(states, lock))
    assert frames(folder) == [0, 1]
    assert not (folder / "frame_000000.npz").samefile(epoch_folder(states, 0) / "frame_000000.npz")


def test_a_folder_of_one_machine_becomes_that_of_epoch_0(tmp_path: Path, lock: Path) -> None:
    states = tmp_path / "states"
    History.open(states).append(0, 0.0, STATE)
    assert current_epoch(states) is None
    assert begin_epoch(states, lock) == 1
    assert frames(states) == frames(epoch_folder(states, 0)) == [0]


def test_a_local_worker_that_is_at_work_still_is_waited_for(
    tmp_path: Path, lock: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It writes by the path `states`: as a link, that would be the folder of the next worker."""
    states = tmp_path / "states"
    History.open(states).append(0, 0.0, STATE)
    held = FolderLock(lock, wait=False)
    held.write("4711\n")
    monkeypatch.setattr(fencing, "LOCK_WAIT_S", 0.1)
    with pytest.raises(FencingError, match=r"process 4711\) is still running"):
        begin_epoch(states, lock)
    assert not states.is_symlink()
    monkeypatch.setattr(fencing, "LOCK_WAIT_S", 60)
    threading.Timer(0.2, held.release).start()
    assert begin_epoch(states, lock) == 1
    assert frames(states) == [0]


def test_a_stop_between_renaming_and_linking_loses_nothing(tmp_path: Path, lock: Path) -> None:
    states = tmp_path / "states"
    History.open(states).append(0, 0.0, STATE)
    states.rename(epoch_folder(states, 0))
    repair_link(states)
    assert current_epoch(states) == 0
    assert frames(states) == [0]
    repair_link(tmp_path / "states_2")
    assert not (tmp_path / "states_2").exists()


def test_the_link_decides_not_the_highest_number(states: Path, lock: Path) -> None:
    """A stop came before the link was moved: that epoch has committed nothing."""
    epoch_folder(states, 7).mkdir()
    assert begin_epoch(states, lock) == 8
    assert frames(states) == [0, 1]


def test_states_that_are_gone_are_not_begun_anew(states: Path, lock: Path) -> None:
    shutil.rmtree(epoch_folder(states, 0))
    (states.parent / "states.3").mkdir()
    os.remove(states)
    states.symlink_to("states.3")
    os.rmdir(states.parent / "states.3")
    with pytest.raises(FencingError, match=r"states\.3 is missing; put it back"):
        begin_epoch(states, lock)


def test_a_deleted_scene_does_not_come_back(states: Path, lock: Path) -> None:
    shutil.rmtree(states.parent)
    with pytest.raises(FileNotFoundError):
        begin_epoch(states, lock)
    assert not states.parent.exists()


def test_two_services_cannot_both_have_an_epoch(states: Path, lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both choose the same number; the second finds a folder, and an empty one it must not replace."""
    folders = fencing._folders
    monkeypatch.setattr(fencing, "_folders", lambda states: [one for one in folders(states) if one[1] < 1])
    assert begin_epoch(states, lock) == 1
    for name in os.listdir(epoch_folder(states, 1)):
        if not name.startswith("."):
            os.remove(epoch_folder(states, 1) / name)
    with pytest.raises(FencingError, match=r"another service started states\.1"):
        begin_epoch(states, lock)


def test_sweeping_leaves_later_epochs_and_other_reconstructions(states: Path, lock: Path) -> None:
    begin_epoch(states, lock)
    other = states.with_name("states_2.0")
    shutil.copytree(epoch_folder(states, 0), other)
    for name in ("states.0.abcd.part", "states.2.abcd.part"):
        (states.parent / name).mkdir()
    assert remove_earlier_epochs(states, 1) == ["states.0", "states.0.abcd.part"]
    assert other.is_dir()
    assert frames(states) == [0, 1]


def test_parts_of_an_epoch_are_none_of_its_folders(states: Path) -> None:
    (states.parent / "states.4.abcd.part").mkdir()
    assert sorted(epochs(states)) == [0]


def test_a_worker_with_an_epoch_does_not_wait_for_one_that_stopped(tmp_path: Path, lock: Path) -> None:
    held = lock_states(SceneFolder(tmp_path))
    assert held is not None
    assert lock_states(SceneFolder(tmp_path, epoch=1)) is None  # with a lock it would wait for ever
    assert int(lock.read_text()) == os.getpid()
    assert [path.name for path in tmp_path.iterdir()] == [lock.name]
    held.release()


def test_what_reconstructions_before_left_is_found_with_its_epochs(states: Path) -> None:
    from server.storage.events import ReconstructionBegun

    event = ReconstructionBegun.model_construct(number=1, points=None)
    names = [path.name for path in SceneFolder(states.parent).leftovers(event)]
    assert names == ["states", "states.0"]
