"""Where the processes of a scene run. A placement starts a process, carries its messages, and notices its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

Entry = Callable[..., None]
"""Called in the process as entry(spec, connection); `connection` has recv and send of a multiprocessing Connection."""


class Ended(str):
    """Why a process is gone, as a sentence; `exit_code` as in multiprocessing: −N for signal N, None where unknown."""

    exit_code: int | None

    def __new__(cls, exit_code: int | None) -> Ended:
        """The sentence for an exit code."""
        self = super().__new__(cls, f"its process ended by itself (exit code {exit_code})")
        self.exit_code = exit_code
        return self


class Process(Protocol):
    """A running process of a scene."""

    def send(self, message: Any) -> None:
        """Posts a message and returns at once; messages to a process that has ended are dropped."""

    async def stop(self, seconds: float) -> None:
        """Asks it to end, waits, then ends it."""


class Placement(Protocol):
    """Starts processes."""

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[Ended], None]
    ) -> Process:
        """Starts a process.

        Args:
            entry: what runs there; a module-level function.
            spec: its first argument; has to pickle.
            on_message: called on the event loop with every message it sends.
            on_end: called on the event loop once, with the reason, when it has ended without being asked to.
        """
