"""Sleep: idle scenes give up their processes and their place, and are woken by the next request.

A scene that is asleep is its status in memory and its folder on disk. Waking reads the folder, as after a crash.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Coroutine, Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from client.wire import SceneStatus
from server.problems import Problem, count_noun
from server.scene.scene import Scene
from server.scene.status_cache import read_status_cache
from server.settings import ServerSettings
from server.storage.layout import SceneFolder

GRACE_S = 30.0
"""A scene that was used so lately does not make room for another one: a rig may send a frame in a moment."""
CHECK_S = 5.0
"""Seconds between looks for scenes that have been idle for long enough; more often where they sleep sooner."""


@dataclass(frozen=True, slots=True)
class SleepingScene:
    """A scene that is asleep, as far as it is known without waking it.

    Attributes:
        status: as it was when it fell asleep, or as it was found on disk.
    """

    id: str
    created: datetime
    status: SceneStatus


class Transitions(dict[str, asyncio.Task[None]]):
    """Scenes that are falling asleep or waking, by id: each is at one turn at a time."""

    def begin(self, id: str, coroutine: Coroutine[Any, Any, None]) -> None:
        """Begins a turn; the caller may leave meanwhile."""

        async def turn() -> None:
            try:
                await coroutine
            finally:
                del self[id]  # before the task is done: who waits for it looks again at once

        self[id] = asyncio.create_task(turn())

    async def end(self, id: str) -> None:
        """Waits for the end of a scene's turn, where it is at one; raises what that raises."""
        if (task := self.get(id)) is not None:
            await asyncio.shield(task)


def check_interval(settings: ServerSettings) -> float | None:
    """Seconds between looks for scenes that may fall asleep; None: none ever does by itself."""
    return min(CHECK_S, settings.sleep_seconds / 2) or None


def idle_scenes(scenes: Iterable[Scene], settings: ServerSettings) -> list[Scene]:
    """Lists the scenes that have been idle for long enough; archived ones are at once."""
    now = time.monotonic()
    return [scene for scene in scenes if now - scene.used >= _idle_limit(scene, settings.sleep_seconds) and scene.idle]


def was_awake(used: float, settings: ServerSettings) -> bool:
    """True for a scene that would be awake had the service not been away; `used`: seconds since the epoch."""
    return settings.sleep_seconds == 0 or time.time() - used < settings.sleep_seconds


def status_if_still_asleep(folder: SceneFolder, settings: ServerSettings) -> SceneStatus | None:
    """Returns the status on the card of a scene that would have slept on had the service not been away. Blocking."""
    if folder.journal.exists() and was_awake(folder.journal.stat().st_mtime, settings):
        return None
    if (status := read_status_cache(folder)) is None:
        return None
    return status.model_copy(update={"queue_limit": status.ingest.queue_frames or settings.queue_frames})


def _idle_limit(scene: Scene, seconds: float) -> float:
    return min(GRACE_S, seconds) if scene.ledger.edited.archived else seconds


def scene_to_put_to_sleep(scenes: Iterable[Scene], settings: ServerSettings) -> Scene:
    """Returns the scene that makes room for another one: of those that are idle, the one used least lately.

    Raises:
        Problem: 429, none is.
    """
    here = [scene for scene in scenes if scene.has_place]
    grace = min(GRACE_S, settings.sleep_seconds)
    now = time.monotonic()
    idle = [scene for scene in here if grace and scene.idle and now - scene.used >= grace]
    if idle:
        return min(idle, key=lambda scene: scene.used)
    raise Problem(
        429,
        f"{count_noun(len(here), 'scene')} of at most {settings.max_scenes} are awake, and none of them is idle",
        field="SCAS4D_MAX_SCENES",
        value=settings.max_scenes,
        remedy="ask again when one is: nothing waits in it, and no page or sender is connected to it; put one to sleep "
        "(POST /v1/scenes/ID/sleep), delete one, or raise SCAS4D_MAX_SCENES",
        headers={"Retry-After": "10"},
    )


def cannot_wake_problem(id: str, reason: str) -> Problem:
    """Makes the answer, 503, for a scene whose folder cannot be read: it sleeps on, as the disk may be what fails."""
    remedy = "look after the scene's folder in the data folder, then ask again"
    return Problem(503, f"the scene cannot be read: {reason}", field="id", value=id, remedy=remedy)
