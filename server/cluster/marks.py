"""The mark of a service in its data folder: by it a node knows that it sees the same folder, not one of its own."""

from __future__ import annotations

import time
from pathlib import Path

from scas4d_core.storage.npz import open_atomically
from server.storage.fencing import PART

MARK = ".service"
SEEN_S = 10.0
"""NFS shows a new file to other machines after a few seconds."""


def mark(data: Path, word: str) -> None:
    """Marks the folder as that of the service whose word it is. Blocking."""
    with open_atomically(data / MARK, data / f"{MARK}{PART}") as file:
        file.write(word.encode())


def is_marked(data: Path, word: str) -> bool:
    """True where this machine sees that service's mark. Blocking: waits for it."""
    return appears(data / MARK, word)


def appears(path: Path, word: str) -> bool:
    """True once a file holds a word, which may take until this machine sees what another wrote. Blocking."""
    until = time.monotonic() + SEEN_S
    while True:
        try:
            if path.read_text() == word:
                return True
        except OSError:
            pass
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
