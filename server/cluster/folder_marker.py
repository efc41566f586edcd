"""Marker file of a service in its data folder.

The marker lets a node verify that it sees the shared folder and not a local folder at the same path.
"""

from __future__ import annotations

import time
from pathlib import Path

from scas4d_core.storage.npz import open_atomically
from server.storage.fencing import PART

MARKER_NAME = ".service"
VISIBLE_S = 10.0
"""Maximum time in seconds for a new file to become visible; NFS shows new files to other machines with a delay."""


def write_marker(data: Path, word: str) -> None:
    """Writes the marker of the service identified by `word` to the data folder. Blocks."""
    with open_atomically(data / MARKER_NAME, data / f"{MARKER_NAME}{PART}") as file:
        file.write(word.encode())


def has_marker(data: Path, word: str) -> bool:
    """Returns whether this machine sees the marker of the service identified by `word`. Blocks.

    Waits up to `VISIBLE_S` for the marker to become visible.
    """
    return wait_for_content(data / MARKER_NAME, word)


def wait_for_content(path: Path, word: str) -> bool:
    """Returns whether a file's content is `word`, waiting up to `VISIBLE_S` for it to become visible. Blocks."""
    until = time.monotonic() + VISIBLE_S
    while True:
        try:
            if path.read_text() == word:
                return True
        except OSError:
            pass
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
