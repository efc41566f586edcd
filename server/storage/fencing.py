"""Folders of states by epoch: what a worker still writes after it was given up is never read.

A worker on another machine may stop, be taken for dead, and go on once another has its scene. File locks do not reach
over machines, and a look before each write leaves a gap. So every worker commits to a folder of its own,
`states.EPOCH`: it begins with links to the files that the one before has committed, and `states` is a symbolic link to
that of the worker that has the scene. Readers read through the link. No file is changed in place but the compact file
that is being written, which is copied. Epochs rise by one with each worker; HBase fences writers of its logs by their
folder, too. Blocking.
"""

from __future__ import annotations

import os
import secrets
import shutil
import threading
from pathlib import Path

from scas4d_core.compact.index import FOOTER_MAGIC
from scas4d_core.storage.npz import sync_folder

PART = ".part"
"""Ends the name of a folder that is not whole."""
_PUBLISHING = threading.Lock()
"""One service at most has a data folder; its threads may come late."""
PASSES = 20
"""Times that a folder is linked which changes meanwhile: whoever writes to it is at work still."""


class FencingError(RuntimeError):
    """The states of a scene cannot be taken over."""


def epoch_folder(states: Path, epoch: int) -> Path:
    """Folder of an epoch.

    >>> epoch_folder(Path("a/states"), 3).name
    'states.3'
    """
    return states.with_name(f"{states.name}.{epoch}")


def epochs(states: Path) -> dict[int, Path]:
    """Folders of epochs that are whole, in rising order."""
    found = {_epoch_of(path): path for path in states.parent.glob(f"{states.name}.*") if path.is_dir()}
    return {epoch: found[epoch] for epoch in sorted(found) if epoch >= 0}


def found_epoch(states: Path) -> int | None:
    """The epoch whose states are the scene's; a folder of an earlier version becomes that of epoch 0.

    Returns:
        None where there are no states.
    """
    if states.is_symlink():
        if states.is_dir():
            return _epoch_of(states.readlink())
    elif states.is_dir():
        states.rename(epoch_folder(states, 0))
    elif states.exists():
        raise FencingError(f"{states.name} is neither a folder nor a link to one")
    if not (known := epochs(states)):
        return None
    publish(states, newest := max(known))  # a stop came between the renaming above and its link
    return newest


def take_over(states: Path, epoch: int, before: int | None) -> Path:
    """Makes the folder of an epoch, with all that is committed in that of the epoch before; None: with nothing.

    Whoever writes to the latter does so for nothing from now on.

    Raises:
        FencingError: that folder kept changing.
    """
    folder = epoch_folder(states, epoch)
    beside = folder.with_name(f"{folder.name}.{secrets.token_hex(4)}{PART}")
    for _ in range(PASSES):
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        if before is None or _linked(epoch_folder(states, before), beside):
            break
    else:
        shutil.rmtree(beside, ignore_errors=True)
        raise FencingError(f"{states.name}.{before} kept changing while it was taken over")
    sync_folder(beside)
    beside.rename(folder)
    sync_folder(folder.parent)
    return folder


def publish(states: Path, epoch: int) -> None:
    """Has the states of an epoch read from now on, in one step; never those of an earlier one again."""
    with _PUBLISHING:
        if not (states.is_symlink() and states.is_dir() and _epoch_of(states.readlink()) > epoch):
            _point(states, epoch)


def _point(states: Path, epoch: int) -> None:
    beside = states.with_name(f".{states.name}.link")
    beside.unlink(missing_ok=True)
    beside.symlink_to(epoch_folder(states, epoch).name)
    beside.replace(states)
    sync_folder(states.parent)


def sweep(states: Path, epoch: int) -> list[str]:
    """Removes the folders of earlier epochs, whole or not; returns their names."""
    removed = []
    for path in states.parent.glob(f"{states.name}.*"):
        number = path.name.removeprefix(f"{states.name}.").partition(".")[0]
        if number.isdecimal() and int(number) < epoch and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
            removed.append(path.name)
    return sorted(removed)


def _epoch_of(path: Path) -> int:
    """−1 for another name."""
    number = path.name.rpartition(".")[2]
    return int(number) if number.isdecimal() else -1


def _linked(source: Path, target: Path) -> bool:
    """Links all files of a folder into another; False where the folder has changed meanwhile.

    Its worker may be at work: a frame that it moves to a compact file, or commits, must be seen whole.
    """
    names = _names(source)
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
