"""Accepts frames: admits them in order, journals them, acknowledges them. An acknowledged frame is on disk."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from client.wire import FrameHead, FrameReceipt, FrameState, SceneCreate, SceneState
from scas4d_core.cameras import Rig
from server import counters
from server.hub import Publisher
from server.problems import Problem, counted
from server.settings import ServerSettings
from server.storage.events import FrameAccepted, FramesSkipped, Hashes
from server.storage.frame_table import LOST
from server.storage.ledger import SceneLog, frame_identity
from server.updates.updates import Updates

T = TypeVar("T")

MOST_SOCKETS = 64
"""WebSockets that send frames to one scene: one a camera where each has a sender of its own."""
LONGEST_S = 60.0
"""Seconds that a sender is asked to wait at most: a prediction further ahead is a guess."""
PAUSED_S = 5.0
"""A sender to a paused scene asks again after so long: nobody knows when a person resumes it."""


@dataclass(eq=False)
class Received:
    """Files of a frame, or of one camera, on disk. `file` is None where they were only compared with a known frame."""

    hashes: Hashes
    file: str | None
    size: int
    kept: bool = False
    """An event names the record: it must not be removed."""


@dataclass(frozen=True, eq=False)
class IngestRules:
    """Rules by which a scene accepts frames, the service's defaults filled in.

    Attributes:
        frames_per_second: gives a frame without a time its time. queue_frames: frames acknowledged and not finished, at
            most. when_full: refuse the next frame, or skip those that wait. minimum_cameras: that a frame needs.
        part_seconds: a frame sent camera by camera is closed so long after its first part; None: never.
    """

    rig: Rig
    frames_per_second: float
    queue_frames: int
    when_full: Literal["refuse", "skip"]
    minimum_cameras: int
    part_seconds: float | None

    @classmethod
    def of(cls, request: SceneCreate, settings: ServerSettings) -> IngestRules:
        """Takes the rules from the request of a scene, and what it leaves open from the settings of the service."""
        rig, ingest = request.rig.rig(), request.ingest
        least = ingest.minimum_cameras
        return cls(
            rig,
            request.frames_per_second,
            queue_frames=ingest.queue_frames or settings.queue_frames,
            when_full=ingest.when_full,
            minimum_cameras=-(-len(rig) // 2) if least is None else min(least, len(rig)),
            part_seconds=ingest.part_seconds,
        )


class Ingest:
    """Admits and acknowledges the frames of one scene, one at a time; uploads arrive side by side.

    Args:
        log, rules, publisher: of the scene.
        updates: of the scene; they begin with the frames that are accepted here.
        can_begin: called before the first frame is accepted; raises Problem where the scene cannot begin.
    """

    def __init__(
        self,
        log: SceneLog,
        rules: IngestRules,
        updates: Updates,
        publisher: Publisher,
        *,
        can_begin: Callable[[], None],
    ) -> None:
        self.log = log
        self.ledger = log.ledger
        self.rules = rules
        self.updates = updates
        self._publisher = publisher
        self._can_begin = can_begin
        self._sockets = 0
        self._coming: dict[int, asyncio.Event] = {}
        """Whole frames that are being received, and the event of their end: the next may arrive meanwhile."""

    def join(self) -> None:
        """Counts one more WebSocket that sends frames; to be followed by `leave` when it ends.

        Raises:
            Problem: 429, as many send as may.
        """
        if self._sockets >= MOST_SOCKETS:
            raise Problem(
                429,
                f"{counted(self._sockets, 'WebSocket')} send frames to this scene already",
                field="id",
                value=self.ledger.scene,
                remedy="close another one, or send over HTTP",
                headers={"Retry-After": "5"},
            )
        self._sockets += 1

    def leave(self) -> None:
        """Counts a WebSocket that has ended."""
        self._sockets -= 1

    # Whole frames.

    def expects(self, head: FrameHead) -> bool:
        """Returns whether a whole frame has to be written; False for a known one, whose content is only compared.

        Raises:
            Problem: the frame will be refused, whatever it holds.
        """
        next_frame = self.ledger.next_frame
        if head.index < next_frame:
            return False
        awaited = next_frame
        while awaited in self._coming:
            awaited += 1
        if head.index == next_frame:
            self.admit(head.index, self.time_of(head.index, head.time))
        elif head.index > awaited:
            raise self.gap(head.index)
        else:  # the frames before it are arriving: it is checked when they are here
            self.refuse_if_it_cannot_go_on()
        return True

    def is_coming(self, index: int) -> bool:
        """True while the whole frame is being received."""
        return index in self._coming

    def coming(self, index: int) -> None:
        """Notes that the frame is being received, until `came`."""
        self._coming.setdefault(index, asyncio.Event())

    def came(self, index: int) -> None:
        """Notes that the frame is accepted or refused."""
        if (event := self._coming.pop(index, None)) is not None:
            event.set()

    async def accept(self, head: FrameHead, received: Received) -> FrameReceipt:
        """Acknowledges a frame whose pictures are on disk, and queues it; a known frame gets its receipt again.

        Raises:
            Problem: 409 for a gap, for other content under a known index and for a failed scene; 422 for a time that
                does not rise; 429 when the queue is full; 507 when the disk is.
        """
        while (before := self._coming.get(head.index - 1)) is not None and head.index > self.ledger.next_frame:
            await before.wait()
        return await uncancelled(self._accept(head, received))

    async def _accept(self, head: FrameHead, received: Received) -> FrameReceipt:
        seconds = self.time_of(head.index, head.time)
        identity = frame_identity(received.hashes, seconds)
        async with self.log.lock:
            if head.index < self.ledger.next_frame:
                return self._known(head.index, identity)
            self.admit(head.index, seconds)
            if received.file is None:  # the frame was known when it arrived, and a scene forgets none
                raise AssertionError(f"frame {head.index} was not written")
            event = FrameAccepted(index=head.index, time=seconds, identity=identity, files=(received.file,))
            receipt = await self.acknowledge(event)
            self.log.pictures.add(received.file, received.size)
            received.kept = True
            counters.INGEST_BYTES.inc(received.size)
        self.updates.begin()
        return receipt

    async def acknowledge(self, event: FrameAccepted) -> FrameReceipt:
        """Journals a frame, and those that are skipped for it; the log's lock is held.

        Raises:
            Problem: 507.
        """
        skipped = self._skipped_for(event.index)
        await self.log.append(*skipped, event)
        for index in (index for one in skipped for index in one.frames):
            self.ended(index)
        counters.FRAMES.labels("acknowledged").inc()
        if self.ledger.frames[event.index].finished:  # it comes before the first frame
            self.ended(event.index)
        receipt = self.ledger.frames[event.index].receipt
        assert receipt is not None
        return receipt

    def ended(self, index: int) -> None:
        """Publishes that a frame has ended without the worker: it was skipped, is missing, or comes too early."""
        self._publisher.finished(self.ledger.frames[index].report)

    # Rules: they change nothing.

    def time_of(self, index: int, time: float | None) -> float:
        """Returns the seconds of a frame: as given, or by the scene's frame rate."""
        return index / self.rules.frames_per_second if time is None else time

    def admit(self, index: int, seconds: float) -> None:
        """Refuses a frame that cannot be the next."""
        self.refuse_if_it_cannot_go_on()
        if index != self.ledger.next_frame:
            raise self.gap(index)
        if index in self.ledger.open:
            raise Problem(
                409,
                f"frame {index} is being sent camera by camera",
                field="n",
                value=index,
                remedy=f"send the other cameras, or close it: POST /v1/scenes/{self.ledger.scene}/frames/{index}/close",
                received=self.ledger.open[index].cameras,
            )
        self.check_time(index, seconds)
        if not self.has_room():
            raise self.full(index)

    def refuse_if_it_cannot_go_on(self) -> None:
        """Refuses any frame of a scene that cannot begin, 422, or has failed or is archived, 409."""
        if self.ledger.next_frame == 0:
            self._can_begin()
        self.refuse_if_failed()
        if self.ledger.edited.archived:
            raise Problem(
                409,
                "the scene is archived",
                field="id",
                value=self.ledger.scene,
                remedy='take that back: PATCH /v1/scenes/ID with {"archived": false}, or scas4d scenes restore ID',
            )

    def refuse_if_failed(self) -> None:
        """Refuses, 409, what is asked of a scene that has failed."""
        if self.ledger.fatal is not None:
            raise Problem(
                409,
                f"the scene has failed: {self.ledger.fatal}",
                field="id",
                value=self.ledger.scene,
                remedy="begin its reconstruction anew: PUT …/reconstructions/"
                f"{self.ledger.reconstruction + 1}, or delete the scene and create it anew",
                state=SceneState.FAILED,
            )

    def gap(self, index: int) -> Problem:
        """Makes the answer to a frame that is not the next: 409, with the expected index."""
        expected = self.ledger.next_frame
        return Problem(
            409,
            f"frame {index} would leave a gap: frame t is found from frame t−1",
            field="n",
            value=index,
            remedy=f"send frame {expected} first, or declare it missing: POST …/frames/{expected}/missing",
            expected=expected,
        )

    def check_time(self, index: int, seconds: float) -> None:
        """Refuses a time that is not after the last one: 422."""
        before = self.ledger.last_time()
        if not (math.isfinite(seconds) and (before is None or seconds > before)):
            raise Problem(
                422,
                f"the time of frame {index} is not after that of the frame before it",
                field="time",
                value=seconds,
                remedy="give finite seconds" if before is None else f"give seconds above {before:g}",
            )

    def has_room(self) -> bool:
        """True where the queue accepts one more frame, if need be by skipping others."""
        if self.ledger.unfinished < self.rules.queue_frames:
            return True
        return self.rules.when_full == "skip" and bool(self._skippable())

    def full(self, index: int) -> Problem:
        """Makes the answer of a full queue: 429, with the predicted time until the frame at work ends.

        ``Retry-After`` holds whole seconds, the document's ``retry_after_seconds`` the same unrounded.
        """
        ledger = self.ledger
        if ledger.paused:
            seconds, remedy = PAUSED_S, f"let the scene go on: POST /v1/scenes/{ledger.scene}/resume"
        else:
            seconds = min(self.updates.clock.remaining(), LONGEST_S)
            remedy = f"send the same frame again in {counted(math.ceil(seconds), 'second')}"
        return Problem(
            429,
            f"{counted(ledger.unfinished, 'frame')} of at most {self.rules.queue_frames} wait already"
            + (" and the scene is paused" if ledger.paused else ""),
            field="n",
            value=index,
            remedy=remedy,
            headers={"Retry-After": str(max(1, math.ceil(seconds)))},
            queued=ledger.unfinished,
            retry_after_seconds=round(seconds, 3),
        )

    def _skipped_for(self, index: int) -> list[FramesSkipped]:
        """Returns the event that skips waiting frames to make room for a frame, where the queue is full."""
        if self.ledger.unfinished < self.rules.queue_frames:
            return []
        return [FramesSkipped(frames=self._skippable(), by=index)]

    def _skippable(self) -> tuple[int, ...]:
        """Lists the waiting frames; not the one that somebody asked to begin with."""
        ledger = self.ledger
        asked_for = None if ledger.begun is None or ledger.committed else ledger.begun.index
        return tuple(index for index in ledger.waiting() if index != asked_for)

    def _known(self, index: int, identity: str) -> FrameReceipt:
        """Returns the receipt of a known frame, if it has the same content.

        Raises:
            Problem: 409, it has not.
        """
        entry = self.ledger.frames[index]
        receipt = entry.receipt
        if receipt is not None and receipt.identity == identity:
            return receipt
        known = "known with other content or another time"
        if receipt is None:
            missing = entry.state == FrameState.MISSING
            known = "declared missing" if missing else f"{entry.state}: {entry.error or LOST}"
        raise Problem(
            409,
            f"frame {index} is {known}",
            field="n",
            value=index,
            remedy=f"send the next frame, {self.ledger.next_frame}; an acknowledged frame does not change",
            expected=self.ledger.next_frame,
            identity=entry.identity,
        )


async def uncancelled(coroutine: Coroutine[Any, Any, T]) -> T:
    """Runs to the end even where the caller is cancelled: the ledger must not stay behind the journal."""
    return await asyncio.shield(asyncio.ensure_future(coroutine))
