"""Sleep of idle scenes. A sleeping scene has no processes and no slot until a request wakes it.

Only the status of a sleeping scene is in memory. To wake the scene, the service reads the scene's
folder as after a crash.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Coroutine, Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from client.wire import SceneStatus
from server.keep_up import queue_limit
from server.problems import Problem, count_noun
from server.scene.scene import Scene
from server.scene.status_cache import read_status_cache
from server.settings import ServerSettings
from server.storage.layout import SceneFolder

GRACE_S = 30.0
"""Time in seconds that a scene keeps its slot after its last use, because its rig may be about to send a frame."""
CHECK_S = 5.0
"""Maximum interval in seconds between checks for idle scenes; checks are more frequent if `sleep_seconds` is short."""


@dataclass(frozen=True, slots=True)
class SleepingScene:
    """Sleeping scene, with the data that is available without waking it.

    Attributes:
        id: scene ID.
        created: creation time of the scene.
        status: status recorded when the scene fell asleep, or read from disk.
    """

    id: str
    created: datetime
    status: SceneStatus


class Transitions(dict[str, asyncio.Task[None]]):
    """Tasks that put scenes to sleep or wake them, keyed by scene ID; at most one per scene."""

    def begin(self, id: str, coroutine: Coroutine[Any, Any, None]) -> None:
        """Starts a transition of a scene, which continues even if the caller is cancelled."""

        async def turn() -> None:
            try:
                await coroutine
            finally:
                del self[id]  # before the task is done, because waiting callers check immediately afterwards

        self[id] = asyncio.create_task(turn())

    async def end(self, id: str) -> None:
        """Waits for a scene's transition to end, if there is one, and re-raises its exception."""
        if (task := self.get(id)) is not None:
            await asyncio.shield(task)


def check_interval(settings: ServerSettings) -> float | None:
    """Returns the seconds between checks for idle scenes, or None if scenes never fall asleep on their own."""
    return min(CHECK_S, settings.sleep_seconds / 2) or None


def idle_scenes(scenes: Iterable[Scene], settings: ServerSettings) -> list[Scene]:
    """Returns the scenes that have been idle long enough to fall asleep.

    Archived scenes may fall asleep earlier than other scenes.
    """
    now = time.monotonic()
    return [scene for scene in scenes if now - scene.used >= _idle_limit(scene, settings.sleep_seconds) and scene.idle]


def was_awake(used: float, settings: ServerSettings) -> bool:
    """Returns whether a scene would still be awake if the service had kept running.

    `used` is the time of its last use, in seconds since the epoch.
    """
    return settings.sleep_seconds == 0 or time.time() - used < settings.sleep_seconds


def status_if_still_asleep(folder: SceneFolder, settings: ServerSettings) -> SceneStatus | None:
    """Returns the cached status of a scene that should stay asleep after a restart of the service, otherwise None.

    Blocks.
    """
    if folder.journal.exists() and was_awake(folder.journal.stat().st_mtime, settings):
        return None
    if (status := read_status_cache(folder)) is None:
        return None
    return status.model_copy(update={"queue_limit": queue_limit(status.ingest, settings.queue_frames)})


def _idle_limit(scene: Scene, seconds: float) -> float:
    return min(GRACE_S, seconds) if scene.ledger.edited.archived else seconds


def scene_to_put_to_sleep(scenes: Iterable[Scene], settings: ServerSettings) -> Scene:
    """Returns the least recently used idle scene, whose slot can be given to another scene.

    Raises:
        Problem: 429 if no scene has been idle for `GRACE_S`, or if scenes never fall asleep on
            their own.
    """
    here = [scene for scene in scenes if scene.has_place]
    grace = min(GRACE_S, settings.sleep_seconds)
    now = time.monotonic()
    idle = [scene for scene in here if grace and scene.idle and now - scene.used >= grace]
    if idle:
        return min(idle, key=lambda scene: scene.used)
    raise Problem(
        429,
        f"{count_noun(len(here), 'scene')} awake (maximum {settings.max_scenes}), and none is idle",
        field="SCAS4D_MAX_SCENES",
        value=settings.max_scenes,
        remedy="try again when one is idle (no queued frames, viewers or senders), put one to sleep "
        "(POST /v1/scenes/ID/sleep), delete one, or raise SCAS4D_MAX_SCENES",
        headers={"Retry-After": "10"},
    )


def cannot_wake_problem(id: str, reason: str) -> Problem:
    """Returns the 503 problem for an unreadable scene, which stays asleep because the fault may be temporary."""
    remedy = "fix the scene's folder in the data folder, then try again"
    return Problem(503, f"the scene cannot be read: {reason}", field="id", value=id, remedy=remedy)
