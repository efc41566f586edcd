"""A reconstruction that commits recorded states, so that a study of viewers has real motion at any frame rate.

Ingest, decoding, commits, durability and messages are those of the service.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.rig.sequence import ping_pong
from scas4d_core import reconstruction
from scas4d_core.captures import Frame
from scas4d_core.storage.history import Defer, History


class Playback:
    """Reconstruction whose states are those of a folder, played back and forth.

    Args:
        recorded: the recorded states.
        history: history of the scene.
    """

    recorded: Path

    def __init__(self, recorded: History, history: History) -> None:
        self._recorded, self._history = recorded, history

    @classmethod
    def start(cls, rig: Any, frame: Frame, settings: Any, *, history: History, defer: Defer, **_: Any) -> Playback:
        """Commits the first state."""
        playback = cls(History.load(cls.recorded), history)
        playback.step(frame, defer=defer)
        return playback

    def step(self, frame: Frame, *, defer: Defer, **_: Any) -> None:
        """Commits the state of a frame."""
        indices = self._recorded.indices
        index = indices[ping_pong(len(self._history), len(indices))]
        report: Mapping[str, Any] = {**self._recorded.report(index), "index": frame.index, "time": frame.time}
        self._history.append(frame.index, frame.time, self._recorded.gaussians(index), report, defer=defer)

    def set_budget(self, **_: Any) -> None:
        """Does nothing: the states are given."""


def install(recorded: Path) -> None:
    """Makes this process commit the states of a folder."""
    Playback.recorded = recorded
    setattr(reconstruction, "Reconstruction", Playback)  # noqa: B010
