"""What a scene's door takes next, and how it refuses what it does not take."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from client.wire import FrameReceipt, FrameState
from server.problems import Problem, counted
from server.storage.events import FramesSkipped, JournalEvent
from server.storage.frame_table import LOST

if TYPE_CHECKING:
    from server.scene.scene import Scene

LONGEST_S = 60.0
"""The longest that a sender is told to wait: a prediction that far ahead is a guess."""
PAUSED_S = 5.0
"""A sender to a paused scene asks again after so long: nothing tells when a person lets it go on."""


class Admission:
    """The rules of one scene's door. Nothing here changes anything."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def time_of(self, index: int, time: float | None) -> float:
        """Seconds of a frame: as given, or by the scene's frame rate."""
        return index / self._scene.request.frames_per_second if time is None else time

    def again(self, index: int, identity: str) -> FrameReceipt:
        """The receipt of a frame that is known, if it has the same content; else 409."""
        entry = self._scene.frames[index]
        receipt = entry.receipt
        if receipt is None or receipt.identity != identity:
            state = entry.state
            known = "known with other content or another time"
            if receipt is None:
                known = "declared missing" if state == FrameState.MISSING else f"{state}: {entry.error or LOST}"
            raise Problem(
                409,
                f"frame {index} is {known}",
                field="n",
                value=index,
                remedy=f"send the next frame, {self._scene.next_frame}; what was acknowledged does not change",
                expected=self._scene.next_frame,
                identity=entry.identity,
            )
        return receipt

    def admit(self, index: int, seconds: float | None) -> None:
        """Refuses a frame that cannot be the next; `seconds` None leaves its time unjudged."""
        scene = self._scene
        self.refuse_if_failed()
        if index != scene.next_frame:
            raise self.gap(index)
        if index in scene.ledger.open:
            raise Problem(
                409,
                f"frame {index} is being sent camera by camera",
                field="n",
                value=index,
                remedy=f"send the other cameras, or close it: POST /v1/scenes/{scene.id}/frames/{index}/close",
                received=scene.ledger.open[index].cameras,
            )
        if seconds is not None:
            self.check_time(index, seconds)
        if not self.room():
            raise self.full(index)

    def refuse_if_failed(self) -> None:
        """409 for a scene that cannot go on."""
        scene = self._scene
        if scene.ledger.fatal is not None:
            raise Problem(
                409,
                f"the scene has failed: {scene.ledger.fatal}",
                field="id",
                value=scene.id,
                remedy="delete the scene and create it anew",
                state=scene.state,
            )

    def gap(self, index: int) -> Problem:
        """409 with the index expected."""
        expected = self._scene.next_frame
        return Problem(
            409,
            f"frame {index} would leave a gap: frame t is found from frame t−1",
            field="n",
            value=index,
            remedy=f"send frame {expected} first, or declare it missing: POST …/frames/{expected}/missing",
            expected=expected,
        )

    def check_time(self, index: int, seconds: float) -> None:
        """422 for a time that is not after the last one."""
        before = self._scene.ledger.last_time()
        if not (math.isfinite(seconds) and (before is None or seconds > before)):
            raise Problem(
                422,
                f"the time of frame {index} is not after that of the frame before it",
                field="time",
                value=seconds,
                remedy="give finite seconds" if before is None else f"give seconds above {before:g}",
            )

    def room(self) -> bool:
        """Whether the queue takes one more, if need be by skipping."""
        scene = self._scene
        if scene.queued < scene.queue_limit:
            return True
        return scene.rules.when_full == "skip" and bool(scene.ledger.waiting())

    def full(self, index: int) -> Problem:
        """429: how long until the frame at work ends and one that waits takes its place.

        ``Retry-After`` holds whole seconds, the document's ``retry_after_seconds`` the same unrounded.
        """
        scene = self._scene
        if scene.ledger.paused:
            seconds, remedy = PAUSED_S, f"let the scene go on: POST /v1/scenes/{scene.id}/resume"
        else:
            seconds = min(scene.clock.remaining(), LONGEST_S)
            remedy = f"send the same frame again in {counted(math.ceil(seconds), 'second')}"
        return Problem(
            429,
            f"{counted(scene.queued, 'frame')} of at most {scene.queue_limit} wait already"
            + (" and the scene is paused" if scene.ledger.paused else ""),
            field="n",
            value=index,
            remedy=remedy,
            headers={"Retry-After": str(max(1, math.ceil(seconds)))},
            queued=scene.queued,
            retry_after_seconds=round(seconds, 3),
        )

    def skips(self, index: int) -> list[JournalEvent]:
        """What has to be skipped to make room for a frame."""
        scene = self._scene
        if scene.queued < scene.queue_limit:
            return []
        return [FramesSkipped(frames=tuple(scene.ledger.waiting()), by=index)]

    def never_taken(self, index: int) -> Problem:
        """409 for a frame that is finished and never had pictures."""
        entry = self._scene.frames[index]
        return Problem(
            409,
            f"frame {index} is {entry.state}: {entry.error}",
            field="n",
            value=index,
            remedy=f"send frame {self._scene.next_frame}",
            expected=self._scene.next_frame,
        )
