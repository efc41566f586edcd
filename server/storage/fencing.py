"""Folders of states by epoch: what a worker still writes after it was given up is never read.

A worker on another machine may stop, be taken for dead, and go on once another has its scene. File locks do not reach
over machines, and a look before each write leaves a gap. So every worker commits to a folder of its own,
`states.EPOCH`: it begins with links to the files that the one before has committed, and `states` is a symbolic link to
that of the worker that has the scene. The service makes the folder and moves the link before it starts the worker, so
whatever the one before writes from then on is in a folder that nobody reads. Readers read through the link. No file is
changed in place but the compact file that is being written, which is copied. Epochs rise with each worker; HBase fences
writers of its logs by their folder, too. Blocking.
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
"""Ends the name of a folder that is not whole."""
MARK = ".epoch"
"""A file in each folder of an epoch: a folder that has it cannot be replaced by another of the same epoch."""
PASSES = 20
"""Times that a folder is linked which changes meanwhile: its writer is still at work."""
MOST_KEPT = 5
"""Folders of epochs that are kept while worker after worker ends before it works."""
LOCAL_S = 10.0
"""A worker of this machine whose service was killed ends within so long."""


class FencingError(RuntimeError):
    """The states of a scene cannot be taken over."""


def epochs(states: Path) -> dict[int, Path]:
    """Folders of epochs that are whole, in rising order."""
    by_epoch = {epoch: path for path, epoch in _folders(states) if path.suffix != PART}
    return dict(sorted(by_epoch.items()))


def epoch_read(states: Path) -> int | None:
    """The epoch whose states are read; None: the folder has none, or there is no folder."""
    return _epoch_of(states, states.readlink()) if states.is_symlink() else None


def heal(states: Path) -> None:
    """Has the newest epoch read where a stop came between a renaming and its link."""
    if not states.exists() and (known := epochs(states)):
        _point(states, max(known))


def begin_epoch(states: Path, lock: Path) -> int:
    """Begins the next epoch: its folder has all that is committed, and is what is read from now on; returns it.

    A folder without epochs becomes that of epoch 0 first, once the worker that holds `lock` has ended.

    Args:
        states: of the scene. lock: of a worker without an epoch.

    Raises:
        FencingError: that worker does not end, the folder before keeps changing or is gone, or another service began
            the same epoch. OSError: the disk does not do. Nothing is changed then.
    """
    heal(states)
    for link in states.parent.glob(f".{states.name}.*.link"):  # that were never moved
        link.unlink(missing_ok=True)
    if states.is_dir() and not states.is_symlink():
        _wait_for(lock)
        states.rename(epoch_folder(states, 0))
        _point(states, 0)
    before = epoch_read(states)
    epoch = 1 + max((epoch for _, epoch in _folders(states)), default=-1)
    _take_over(states, epoch, before)
    try:
        _point(states, epoch)
    except OSError:
        if epoch_read(states) != epoch:  # the link may have moved, and the disk not say so
            shutil.rmtree(epoch_folder(states, epoch), ignore_errors=True)
        raise
    for early in sorted(epochs(states))[:-MOST_KEPT]:  # `sweep` waits for a worker that works
        shutil.rmtree(epoch_folder(states, early), ignore_errors=True)
    return epoch


def sweep(states: Path, epoch: int) -> list[str]:
    """Removes the folders of earlier epochs, whole or not; returns their names."""
    gone = [path for path, number in _folders(states) if number < epoch]
    for path in gone:
        shutil.rmtree(path, ignore_errors=True)
    return sorted(path.name for path in gone)


def _wait_for(lock: Path) -> None:
    until = time.monotonic() + LOCAL_S
    while True:
        try:
            FolderLock(lock, wait=False).release()
            return
        except BlockingIOError:
            if time.monotonic() > until:
                raise FencingError(
                    f"a worker of an earlier service (process {lock.read_text().strip() or 'unknown'}) does not end; "
                    "end it"
                ) from None
            time.sleep(0.05)


def _take_over(states: Path, epoch: int, before: int | None) -> None:
    """Makes the folder of an epoch, with all that is committed in that of the epoch before; None: with nothing."""
    folder = epoch_folder(states, epoch)
    beside = folder.with_name(f"{folder.name}.{secrets.token_hex(4)}{PART}")
    try:
        for _ in range(PASSES):
            shutil.rmtree(beside, ignore_errors=True)
            beside.mkdir()  # without parents: a scene that is deleted meanwhile does not come back
            (beside / MARK).touch()
            if before is None or _linked(epoch_folder(states, before), beside):
                break
        else:
            raise FencingError(f"{states.name}.{before} kept changing while it was taken over")
        sync_folder(beside)
        try:
            beside.rename(folder)
        except OSError:
            if folder.exists():
                raise FencingError(f"another service began {folder.name}; one has a data folder") from None
            raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    sync_folder(folder.parent)


def _point(states: Path, epoch: int) -> None:
    beside = states.with_name(f".{states.name}.{secrets.token_hex(4)}.link")
    try:
        beside.symlink_to(epoch_folder(states, epoch).name)
        beside.replace(states)
    finally:
        beside.unlink(missing_ok=True)
    sync_folder(states.parent)


def _folders(states: Path) -> list[tuple[Path, int]]:
    """Folders of epochs, whole or not, with their epochs."""
    folders = [(path, _epoch_of(states, path)) for path in states.parent.glob(f"{states.name}.*") if path.is_dir()]
    return [(path, epoch) for path, epoch in folders if epoch is not None]


def _epoch_of(states: Path, path: Path) -> int | None:
    """The epoch of a folder, whole or not; None for another name."""
    number = path.name.removeprefix(f"{states.name}.").partition(".")[0]
    return int(number) if number.isdecimal() else None


def _linked(source: Path, target: Path) -> bool:
    """Links all files of a folder into another; False where the folder has changed meanwhile.

    Its worker may be at work: a frame that it moves to a compact file, or commits, must be seen whole.
    """
    try:
        names = _names(source)
    except FileNotFoundError:
        raise FencingError(
            f"{source.name} is gone, which is read; put it back, or remove the link to it to go on without"
        ) from None
    for name in names:
        try:
            if name.endswith(".s4d") and not _closed(source / name):
                _copy(source / name, target / name)
            else:
                _link(source / name, target / name)
        except FileNotFoundError:
            return False
    return names == _names(source)


def _names(folder: Path) -> list[str]:
    """Files but those that are being written; compact files last: a frame is in one before its own file goes."""
    names = [name for name in os.listdir(folder) if not name.startswith(".")]
    return sorted(names, key=lambda name: (name.endswith(".s4d"), name))


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:  # a file system without hard links
        _copy(source, target)


def _copy(source: Path, target: Path) -> None:
    with source.open("rb") as given, target.open("xb") as made:
        shutil.copyfileobj(given, made)
        made.flush()
        os.fsync(made.fileno())


def _closed(chunk: Path) -> bool:
    """True for a compact file that has its index: nothing is written to it any more."""
    with chunk.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(FOOTER_MAGIC)))
        return file.read() == FOOTER_MAGIC
