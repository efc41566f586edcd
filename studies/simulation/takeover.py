"""Worst cases at the start of an epoch: workers commit between its steps, or the service ends between them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random
from unittest import mock

from scas4d_core.storage.npz import sync_folder
from server.storage import fencing
from server.storage.layout import SceneFolder
from studies.simulation.record import FrameRecord

HURRIED = 0.5
"""Probability that a scene's worker commits between two steps, which is far higher than without intervention."""


class _Interrupted(Exception):
    """Raised to end the service during the start of an epoch."""


class Takeovers:
    """Inserts other actions whenever `begin_epoch` syncs a folder.

    There are three such moments: the folder of linked states has no name yet, the folder has a name but the link has
    not moved, and the link has moved.
    """

    def __init__(self, record: FrameRecord, random: Random) -> None:
        self._record, self._random = record, random
        self._left: int | None = None

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Enables the actions within the context."""
        with mock.patch.object(fencing, "sync_folder", self._sync):
            yield

    def interrupt(self, folder: SceneFolder) -> None:
        """Ends the service during the start of an epoch of the scene, at one of these moments."""
        self._left = self._random.randrange(3)
        with suppress(_Interrupted):
            fencing.begin_epoch(folder.states, folder.worker_lock)
        self._left = None

    def _sync(self, folder: Path) -> None:
        part = folder.name.endswith(fencing.PART)
        if self._left == 0:
            if part:  # a killed service does not clean up
                folder.with_name(folder.name.replace(fencing.PART, f".left{fencing.PART}")).mkdir()
            raise _Interrupted
        if self._left is not None:
            self._left -= 1
        scene = folder.parent.name if part else folder.name
        for work in tuple(self._record.works.get(scene, ())):
            if self._random.random() < HURRIED:
                work.hurry()
        sync_folder(folder)
