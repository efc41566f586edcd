"""Reads all that a scene has on disk again, slowly, and compares it with its checksums: damage is found before it is
needed.

One file after the other, a piece at a time in a thread, with pauses that keep to the rate of the settings; while a
frame is at work, to a quarter of it. Pages that were read for this alone are given back to the system.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from client.wire import FrameState
from scas4d_core.errors import told
from scas4d_core.storage.frame_files import (
    FIRST_COPY,
    FIXED_COPY,
    FIXED_FILE,
    FrameFiles,
    checkpoint_file,
    checkpoint_of,
)
from scas4d_core.storage.history import FRAMES_KEPT
from scas4d_core.storage.npz import verified
from server.health import metrics
from server.processes.messages import SceneSpec
from server.repair.damage import DamageKind, DamageLog
from server.storage.definition import Definition, check_definition, write_definition
from server.storage.frame_store import checked
from server.storage.journal import Journal, checked_journal
from server.storage.ledger import Ledger

AT_WORK = 0.25
"""Share of the rate while a frame is at work."""
FACTS_WEIGH = 8
"""A byte of the journal, which is many small records, takes so many times the processor time of one of an array."""
LOOK_S = 5.0
"""Whether the journal has its name is looked at so often."""

log = logging.getLogger("scas4d.server")


@dataclass(frozen=True)
class Scrubbed:
    """What a scrub reads, and whom it tells.

    Attributes:
        noticed: told of files of the states' folder, by name with the reason. at_work: whether a frame is.
    """

    definition: Definition
    spec: SceneSpec
    ledger: Ledger
    journal: Journal
    damage: DamageLog
    noticed: Callable[[Mapping[str, str]], None]
    at_work: Callable[[], bool]


class Scrub:
    """Of one scene.

    Args:
        mb_per_second: 0: never. pause_seconds: before each pass.
    """

    def __init__(self, scene: Scrubbed, mb_per_second: float, pause_seconds: float) -> None:
        self._scene = scene
        self._bytes_per_second = 1e6 * mb_per_second
        self._pause = pause_seconds

    async def run(self) -> None:
        """Pass after pass, until it is cancelled."""
        while True:
            left = self._pause
            while left > 0 or self._bytes_per_second == 0:
                await asyncio.sleep(min(left, LOOK_S) if left > 0 else LOOK_S)
                left -= LOOK_S
                self._scene.journal.look()
            try:
                await self.once()
            except Exception:  # a scrub that fails is no fault of the scene
                log.exception("scene %s cannot be scrubbed", self._scene.spec.folder.name)

    async def once(self) -> None:
        """One pass over everything."""
        await self._definition()
        await self._journal()
        await self._states()
        await self._points()
        await self._frames()

    async def _read(self, pieces: Iterator[int], weight: int = 1) -> str | None:
        """Reads a file to its end; what is wrong with it, None: nothing."""
        try:
            while (size := await asyncio.to_thread(next, pieces, None)) is not None:
                metrics.SCRUBBED.inc(size)
                rate = self._bytes_per_second * (AT_WORK if self._scene.at_work() else 1.0)
                await asyncio.sleep(weight * size / rate)
        except (OSError, ValueError) as error:
            return "gone" if isinstance(error, FileNotFoundError) else told(error)
        return None

    async def _definition(self) -> None:
        scene = self._scene
        fault = await asyncio.to_thread(check_definition, scene.spec.folder)
        if fault is None:
            return
        with contextlib.suppress(OSError):  # the next pass tries again
            await asyncio.to_thread(write_definition, scene.spec.folder, scene.definition)
            scene.damage.say(DamageKind.DEFINITION, f"{fault}; it was written again")

    async def _journal(self) -> None:
        journal = self._scene.journal
        journal.look()
        file, good = journal.place
        fault = await self._read(checked_journal(journal.path, good), FACTS_WEIGH)
        if fault is not None and fault != "gone" and journal.place[0] == file:  # else it was written anew meanwhile
            journal.renew(f"{journal.path.name} is damaged ({fault})")

    async def _states(self) -> None:
        scene, folder = self._scene, self._scene.spec.states
        committed = list(scene.ledger.committed)
        if not committed:
            return
        for name in (FIXED_FILE, FIXED_COPY, FIRST_COPY):
            await self._state(folder / name, lambda: True)
        listed = await asyncio.to_thread(_checkpoints, folder)
        for name in listed:
            await self._state(folder / name, lambda: False)
        newest = checkpoint_file(scene.ledger.committed[-1])
        if listed and not scene.at_work() and not await asyncio.to_thread((folder / newest).exists):
            scene.noticed({newest: f"{newest} is gone"})
        files = FrameFiles(folder)
        for index in reversed(committed):
            await self._state(files.path(index), partial(scene.ledger.committed.__contains__, index))
            if index not in committed[-FRAMES_KEPT:]:
                await asyncio.to_thread(_forget, files.path(index))

    async def _state(self, path: Path, expected: Callable[[], bool]) -> None:
        """One file; `expected`: whether it is damage that it is not there."""
        fault = await self._read(verified(path))
        if fault == "gone" and expected():
            self._scene.noticed({path.name: f"{path.name} is gone"})
        elif fault is not None and fault != "gone":
            self._scene.noticed({path.name: fault})

    async def _points(self) -> None:
        path = self._scene.spec.points
        fault = await self._read(verified(path))
        if fault is None or fault == "gone":
            return
        used = "the first frame is committed, and needs it no more" if self._scene.ledger.committed else "put it again"
        self._scene.damage.say(DamageKind.POINTS, f"{fault}; {used}", lasting=True)

    async def _frames(self) -> None:
        scene = self._scene
        names = [(entry.index, name) for entry in scene.ledger.frames.held() for name in entry.files]
        for index, name in names:
            fault = await self._read(checked(scene.spec.frames, name))
            await asyncio.to_thread(_forget, scene.spec.frames / name)
            entry = scene.ledger.frames.get(index)
            if fault is None or entry is None or name not in entry.files:  # deleted meanwhile
                continue
            what = "it is set aside when its turn comes"
            if entry.state == FrameState.COMMITTED:
                what = "its state is not touched by that"
            said = f"frame {index}: its record in the frame log is damaged: {fault}; {what}"
            scene.damage.say(DamageKind.FRAME, said, lasting=True)


def _checkpoints(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in os.scandir(folder) if checkpoint_of(entry.name) is not None)
    except FileNotFoundError:
        return []


def _forget(path: Path) -> None:
    """Gives the pages of a file back to the system: nobody else is about to read them."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
