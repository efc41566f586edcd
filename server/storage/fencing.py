"""Fencing of workers with one state folder per epoch, so that writes of an abandoned worker are never read.

A worker on another machine may hang, be presumed dead, and resume after another worker has taken over its scene. File
locks do not work across machines, and checking before each write leaves a race condition. Every worker therefore
commits to its own folder, `states.EPOCH`. Initially, the folder contains hard links to the files that the previous
worker committed. The symbolic link `states` points to the folder of the current worker, and all readers follow it.

The service creates the folder and moves the link before it starts the worker. Anything that the previous worker writes
afterwards ends up in a folder that nobody reads. Only the compact file that is still being written changes in place, so
it is copied instead of linked. The epoch increases with each worker. HBase fences the writers of its logs per folder in
the same way. All functions block.
"""

from __future__ import annotations

import os
import secrets
import shutil
import time
from pathlib import Path

from scas4d_core.compact.index import FOOTER_MAGIC
from scas4d_core.storage.npz import sync_folder
from server.storage.disk import FolderLock
from server.storage.layout import epoch_folder

PART = ".part"
"""Suffix of a folder that is still being filled."""
MARKER_NAME = ".epoch"
"""Name of a file that makes each epoch folder non-empty, so that another rename to the same epoch fails."""
MAX_PASSES = 20
"""Maximum number of attempts to link a folder that keeps changing because its writer is still running."""
MAX_REMAINING = 5
"""Number of epoch folders to keep if successive workers exit before they start their work."""
LOCK_WAIT_S = 10.0
"""Time in seconds to wait for a local worker to exit after its service was killed."""


class FencingError(RuntimeError):
    """Raised if the states of a scene cannot be taken over."""


def epochs(states: Path) -> dict[int, Path]:
    """Returns the complete epoch folders, keyed by epoch in ascending order."""
    by_epoch = {epoch: path for path, epoch in _folders(states) if path.suffix != PART}
    return dict(sorted(by_epoch.items()))


def current_epoch(states: Path) -> int | None:
    """Returns the epoch whose states are read, or None if the folder has no epochs or does not exist."""
    return _epoch_of(states, states.readlink()) if states.is_symlink() else None


def repair_link(states: Path) -> None:
    """Points the link to the newest epoch if the link is missing after an interruption."""
    if not states.exists() and (known := epochs(states)):
        _point_link(states, max(known))


def begin_epoch(states: Path, lock: Path) -> int:
    """Begins the next epoch and returns it; readers then use its folder, which contains all committed states.

    A folder without epochs first becomes epoch 0, after the worker that holds `lock` has exited.

    Args:
        states: path of the scene's states.
        lock: lock file used by workers without an epoch.

    Raises:
        FencingError: the worker that holds `lock` does not exit, the previous folder keeps changing or is missing, or
            another service began the same epoch. The previous epoch stays current.
        OSError: a disk operation failed. The previous epoch stays current unless the link had already moved.
    """
    repair_link(states)
    for link in states.parent.glob(f".{states.name}.*.link"):  # left over from interrupted calls
        link.unlink(missing_ok=True)
    if states.is_dir() and not states.is_symlink():
        _wait_for(lock)
        states.rename(epoch_folder(states, 0))
        _point_link(states, 0)
    before = current_epoch(states)
    epoch = 1 + max((epoch for _, epoch in _folders(states)), default=-1)
    _fill_folder(states, epoch, before)
    try:
        _point_link(states, epoch)
    except OSError:
        if current_epoch(states) != epoch:  # the link may have moved despite the error
            shutil.rmtree(epoch_folder(states, epoch), ignore_errors=True)
        raise
    for early in sorted(epochs(states))[:-MAX_REMAINING]:  # `remove_earlier_epochs` waits for a running worker
        shutil.rmtree(epoch_folder(states, early), ignore_errors=True)
    return epoch


def remove_earlier_epochs(states: Path, epoch: int) -> list[str]:
    """Removes the folders of earlier epochs, complete or not, and returns their names."""
    gone = [path for path, number in _folders(states) if number < epoch]
    for path in gone:
        shutil.rmtree(path, ignore_errors=True)
    return sorted(path.name for path in gone)


def _wait_for(lock: Path) -> None:
    until = time.monotonic() + LOCK_WAIT_S
    while True:
        try:
            FolderLock(lock, wait=False).release()
            return
        except BlockingIOError:
            if time.monotonic() > until:
                raise FencingError(
                    f"a worker of an earlier service (process {lock.read_text().strip() or 'unknown'}) is still "
                    "running; stop it"
                ) from None
            time.sleep(0.05)


def _fill_folder(states: Path, epoch: int, before: int | None) -> None:
    """Creates the folder of an epoch with all committed files of the epoch `before`.

    If `before` is None, the folder contains no committed files.
    """
    folder = epoch_folder(states, epoch)
    beside = folder.with_name(f"{folder.name}.{secrets.token_hex(4)}{PART}")
    try:
        for _ in range(MAX_PASSES):
            shutil.rmtree(beside, ignore_errors=True)
            beside.mkdir()  # no parents: a scene that is deleted concurrently must not reappear
            (beside / MARKER_NAME).touch()
            if before is None or _link_all(epoch_folder(states, before), beside):
                break
        else:
            raise FencingError(f"{states.name}.{before} kept changing during the takeover")
        sync_folder(beside)
        try:
            beside.rename(folder)
        except OSError:
            if folder.exists():
                raise FencingError(f"another service started {folder.name}; only one may use a data folder") from None
            raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    sync_folder(folder.parent)


def _point_link(states: Path, epoch: int) -> None:
    beside = states.with_name(f".{states.name}.{secrets.token_hex(4)}.link")
    try:
        beside.symlink_to(epoch_folder(states, epoch).name)
        beside.replace(states)
    finally:
        beside.unlink(missing_ok=True)
    sync_folder(states.parent)


def _folders(states: Path) -> list[tuple[Path, int]]:
    """Returns the epoch folders, complete or not, with their epochs."""
    folders = [(path, _epoch_of(states, path)) for path in states.parent.glob(f"{states.name}.*") if path.is_dir()]
    return [(path, epoch) for path, epoch in folders if epoch is not None]


def _epoch_of(states: Path, path: Path) -> int | None:
    """Returns the epoch of a folder, complete or not, or None if the name is not that of an epoch folder."""
    number = path.name.removeprefix(f"{states.name}.").partition(".")[0]
    return int(number) if number.isdecimal() else None


def _link_all(source: Path, target: Path) -> bool:
    """Links all files of a folder into another folder. Compact files without an index are copied.

    The worker of the source folder may still be running. The operation must not miss a frame that
    the worker commits or moves to a compact file in the meantime.

    Returns:
        False if the source folder changed during the operation, otherwise True.
    """
    try:
        names = _names(source)
    except FileNotFoundError:
        raise FencingError(
            f"{source.name} is missing; put it back, or remove the link to it to continue without its states"
        ) from None
    for name in names:
        try:
            if name.endswith(".s4d") and not _is_closed(source / name):
                _copy(source / name, target / name)
            else:
                _link(source / name, target / name)
        except FileNotFoundError:
            return False
    return names == _names(source)


def _names(folder: Path) -> list[str]:
    """Returns the names of finished files, compact files last.

    This order loses no frame, because a frame is added to a compact file before its own file is removed.
    """
    names = [name for name in os.listdir(folder) if not name.startswith(".")]
    return sorted(names, key=lambda name: (name.endswith(".s4d"), name))


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:  # the file system does not support hard links
        _copy(source, target)


def _copy(source: Path, target: Path) -> None:
    with source.open("rb") as given, target.open("xb") as made:
        shutil.copyfileobj(given, made)
        made.flush()
        os.fsync(made.fileno())


def _is_closed(chunk: Path) -> bool:
    """Returns whether a compact file ends with its index, after which the file is never changed."""
    with chunk.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(FOOTER_MAGIC)))
        return file.read() == FOOTER_MAGIC
