"""Acceptance of frames in order: admission, journalling and acknowledgement. Acknowledged frames are on disk."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

from client.wire import FrameHead, FrameReceipt, FrameState, SceneCreate, SceneState
from scas4d_core.cameras import Rig, minimum_cameras
from scas4d_core.frame_times import ROWS, time_warnings
from server import counters
from server.background import shielded
from server.hub import Publisher
from server.keep_up import queue_limit
from server.problems import Problem, count_noun
from server.settings import ServerSettings
from server.storage.events import ClosedBy, FramesSkipped, Hashes
from server.storage.frame_table import RECORD_LOST
from server.storage.ledger import SceneLog, frame_identity
from server.updates.updates import Updates

T = TypeVar("T")

log = logging.getLogger("scas4d.server")

MAX_SOCKETS = 64
"""Maximum number of WebSockets that send frames to one scene; clients may use one per camera."""
MAX_RETRY_S = 60.0
"""Maximum retry delay in seconds that is sent to clients; longer predictions are unreliable."""
PAUSED_RETRY_S = 5.0
"""Retry delay in seconds for a paused scene, since the time of resumption cannot be predicted."""


@dataclass(eq=False)
class ReceivedFiles:
    """Received files of a whole frame or of one camera.

    `file` is the name of their record on disk, or None if they were only hashed for comparison with a known frame.
    """

    hashes: Hashes
    file: str | None
    size: int
    kept: bool = False
    """Whether an event references the record, which must then be kept."""


@dataclass(frozen=True, eq=False)
class IngestRules:
    """Rules for accepting frames of a scene, with the service's defaults filled in.

    Attributes:
        rig: the scene's rig.
        frames_per_second: frame rate used to compute the time of a frame if the client does not send it.
        queue_frames: maximum number of acknowledged but unfinished frames.
        when_full: whether a full queue refuses the next frame or skips the waiting frames.
        minimum_cameras: minimum number of cameras per frame.
        open_frame_seconds: seconds from the first upload until a frame sent camera by camera is closed; None for no
            deadline.
    """

    rig: Rig
    frames_per_second: float
    queue_frames: int
    when_full: Literal["refuse", "skip"]
    minimum_cameras: int
    open_frame_seconds: float | None

    @classmethod
    def of(cls, request: SceneCreate, settings: ServerSettings) -> IngestRules:
        """Returns the rules in a request to create a scene, with missing values taken from the service's settings."""
        rig, ingest = request.rig.rig(), request.ingest
        return cls(
            rig,
            request.frames_per_second,
            queue_frames=queue_limit(ingest, settings.queue_frames),
            when_full=ingest.when_full,
            minimum_cameras=minimum_cameras(len(rig), ingest.minimum_cameras),
            open_frame_seconds=ingest.open_frame_seconds,
        )


class Ingest:
    """Admission and acknowledgement of one scene's frames, one at a time; uploads may run concurrently.

    Args:
        log: the scene's journal, ledger and frame log.
        rules: rules for accepting frames.
        updates: scheduler of the scene's updates, triggered when a frame is accepted.
        publisher: publisher of the scene's events.
        can_begin: function called before the first frame is accepted; raises `Problem` if the scene cannot start.
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
        self._warns_of_times = False
        self._receiving: dict[int, asyncio.Event] = {}
        """Complete frames that are being received, each with an event that is set at the end of the transfer.

        The next frame may start to arrive before then.
        """

    def add_socket(self) -> None:
        """Registers a WebSocket that sends frames; call `remove_socket` when it closes.

        Raises:
            Problem: 429 if the maximum number of WebSockets is reached.
        """
        if self._sockets >= MAX_SOCKETS:
            raise Problem(
                429,
                f"this scene already has the maximum of {count_noun(self._sockets, 'WebSocket')} for sending frames",
                field="id",
                value=self.ledger.scene,
                remedy="close one of them, or send frames over HTTP",
                headers={"Retry-After": "5"},
            )
        self._sockets += 1

    def remove_socket(self) -> None:
        """Unregisters a WebSocket that has closed."""
        self._sockets -= 1

    # Complete frames.

    def needs_files(self, head: FrameHead) -> bool:
        """Returns whether a complete frame must be written to disk; a known frame is only compared.

        Raises:
            Problem: the frame would be refused regardless of its content.
        """
        next_frame = self.ledger.next_frame
        if head.index < next_frame:
            return False
        awaited = next_frame
        while awaited in self._receiving:
            awaited += 1
        if head.index == next_frame:
            self.admit(head.index)
        elif head.index > awaited:
            raise self.gap_problem(head.index)
        else:  # earlier frames are still arriving; this frame is checked after them
            self.refuse_if_stopped()
        return True

    def is_receiving(self, index: int) -> bool:
        """Returns whether the frame is being received as a whole."""
        return index in self._receiving

    def begin_receiving(self, index: int) -> None:
        """Marks the frame as being received until `end_receiving` is called."""
        self._receiving.setdefault(index, asyncio.Event())

    def end_receiving(self, index: int) -> None:
        """Marks the frame as accepted or refused and wakes up the next frame, if it is waiting."""
        if (event := self._receiving.pop(index, None)) is not None:
            event.set()

    @shielded
    async def accept(self, head: FrameHead, received: ReceivedFiles) -> FrameReceipt:
        """Acknowledges and queues a frame whose images are on disk; a known frame gets the same receipt again.

        Raises:
            Problem: 409 for a gap, different content under a known index, or a failed scene; 429 if the queue is full;
                507 if the disk is full.
        """
        while (before := self._receiving.get(head.index - 1)) is not None and head.index > self.ledger.next_frame:
            await before.wait()
        seconds = self.time_of(head.index, head.time)
        async with self.log.lock:
            if head.index < self.ledger.next_frame:
                return self._existing_receipt(head.index, received.hashes, seconds)
            self.admit(head.index)
            if received.file is None:  # only known frames have no file, and a scene never forgets them
                raise AssertionError(f"frame {head.index} was not written")
            receipt = await self.acknowledge(head.index, seconds, received.hashes, (received.file,), "whole")
            self.log.pictures.add(received.file, received.size)
            received.kept = True
            counters.INGEST_BYTES.inc(received.size)
        self.updates.begin()
        return receipt

    async def acknowledge(
        self, index: int, sent: float, hashes: Hashes, files: tuple[str, ...], closed_by: ClosedBy
    ) -> FrameReceipt:
        """Journals a frame and any frames skipped to make room for it; the caller must hold the log's lock.

        Args:
            index: index of the frame.
            sent: time of the frame in seconds, as returned by `time_of`.
            hashes: digests of its files.
            files: names of its records in the frame log.
            closed_by: reason why the frame is closed.

        Raises:
            Problem: 507 if the disk is full.
        """
        event = self.ledger.accepted_event(index, sent, hashes, files, self.rules.frames_per_second, closed_by)
        skipped = self._skip_event(index)
        await self.log.append(*skipped, event)
        for ended in (ended for one in skipped for ended in one.frames):
            self.publish_ended(ended)
        counters.FRAMES.labels("acknowledged").inc()
        self.updates.latencies.receive(index)
        if self.ledger.frames[index].finished:  # the frame precedes the first frame of the reconstruction
            self.publish_ended(index)
        receipt = self.receipt_of(index)
        assert receipt is not None
        if receipt.warnings and not self._warns_of_times:
            log.warning("scene %s: %s", self.ledger.scene, "; ".join(receipt.warnings))
        self._warns_of_times = bool(receipt.warnings)
        return receipt

    def receipt_of(self, index: int) -> FrameReceipt | None:
        """Returns the receipt of a closed frame with the warnings about its time, or None if it has no receipt."""
        receipt = self.ledger.frames[index].receipt
        if receipt is None:
            return None
        warnings = time_warnings(self.ledger.times_before(index + 1, ROWS), self.rules.frames_per_second)
        return receipt.model_copy(update={"warnings": warnings})

    def publish_ended(self, index: int) -> None:
        """Publishes a frame that ended without an update: skipped, missing, or before the first reconstructed frame."""
        self._publisher.publish_frame(self.ledger.frames[index].report)

    # Rules. These methods do not change any state.

    def time_of(self, index: int, time: float | None) -> float:
        """Returns the sent time if there is one, otherwise the time in seconds that follows from the frame rate."""
        return index / self.rules.frames_per_second if time is None else time

    def index_at(self, time: float | None) -> int:
        """Returns the index of the known frame that was sent with this time, or the next free index.

        Raises:
            Problem: 422 if there is no time, without which a repeated frame cannot be recognised.
        """
        if time is None:
            raise Problem(
                422,
                "a frame without its own index needs a time",
                field="time",
                value="null",
                remedy="send the time of every frame in seconds, or use numbering=given",
            )
        known = self.ledger.frames.index_at(time)
        return self.ledger.next_frame if known is None else known

    def admit(self, index: int) -> None:
        """Raises `Problem` if a frame cannot be accepted as the next one."""
        self.refuse_if_stopped()
        if index != self.ledger.next_frame:
            raise self.gap_problem(index)
        if index in self.ledger.open:
            raise Problem(
                409,
                f"frame {index} is being sent camera by camera",
                field="n",
                value=index,
                remedy="send the other cameras' images, or close the frame: "
                f"POST /v1/scenes/{self.ledger.scene}/frames/{index}/close",
                received=self.ledger.open[index].cameras,
            )
        if not self.has_room():
            raise self.queue_full_problem(index)

    def refuse_if_stopped(self) -> None:
        """Raises `Problem` if the scene cannot start (422), has failed or is archived (409)."""
        if self.ledger.next_frame == 0:
            self._can_begin()
        self.refuse_if_failed()
        if self.ledger.edited.archived:
            raise Problem(
                409,
                "the scene is archived",
                field="id",
                value=self.ledger.scene,
                remedy='unarchive it: PATCH /v1/scenes/ID with {"archived": false}, or scas4d scenes restore ID',
            )

    def refuse_if_failed(self) -> None:
        """Raises `Problem` (409) if the scene has failed."""
        if self.ledger.fatal is not None:
            raise Problem(
                409,
                f"the scene has failed: {self.ledger.fatal}",
                field="id",
                value=self.ledger.scene,
                remedy="restart its reconstruction: PUT …/reconstructions/"
                f"{self.ledger.reconstruction + 1}, or delete and recreate the scene",
                state=SceneState.FAILED,
            )

    def gap_problem(self, index: int) -> Problem:
        """Returns the 409 problem for a frame that is not the next one, with the expected index."""
        expected = self.ledger.next_frame
        return Problem(
            409,
            f"received frame {index}, but expected frame {expected}; frames must arrive without gaps",
            field="n",
            value=index,
            remedy=f"send frame {expected} first, or declare it missing: POST …/frames/{expected}/missing",
            expected=expected,
        )

    def has_room(self) -> bool:
        """Returns whether the queue accepts another frame, skipping others if necessary."""
        if self.ledger.unfinished < self.rules.queue_frames:
            return True
        return self.rules.when_full == "skip" and bool(self._skippable())

    def queue_full_problem(self, index: int) -> Problem:
        """Returns the 429 problem for a full queue, with the predicted time until the current update ends.

        ``Retry-After`` is in whole seconds; ``retry_after_seconds`` in the body has millisecond precision.
        """
        ledger = self.ledger
        if ledger.paused:
            seconds, remedy = PAUSED_RETRY_S, f"resume the scene: POST /v1/scenes/{ledger.scene}/resume"
        else:
            seconds = min(self.updates.clock.remaining(), MAX_RETRY_S)
            remedy = f"send the same frame again in {count_noun(math.ceil(seconds), 'second')}"
        return Problem(
            429,
            f"the queue is full: {count_noun(ledger.unfinished, 'frame')} waiting (maximum {self.rules.queue_frames})"
            + (", and the scene is paused" if ledger.paused else ""),
            field="n",
            value=index,
            remedy=remedy,
            headers={"Retry-After": str(max(1, math.ceil(seconds)))},
            queued=ledger.unfinished,
            retry_after_seconds=round(seconds, 3),
        )

    def _skip_event(self, index: int) -> list[FramesSkipped]:
        """Returns the event that skips waiting frames in favour of frame `index`, or none if the queue has room."""
        if self.ledger.unfinished < self.rules.queue_frames:
            return []
        return [FramesSkipped(frames=self._skippable(), by=index)]

    def _skippable(self) -> tuple[int, ...]:
        """Returns the waiting frames, except the first frame of a reconstruction if it was requested explicitly."""
        ledger = self.ledger
        asked_for = None if ledger.begun is None or ledger.committed else ledger.begun.index
        return tuple(index for index in ledger.waiting() if index != asked_for)

    def _existing_receipt(self, index: int, hashes: Hashes, sent: float) -> FrameReceipt:
        """Returns the receipt of a known frame with the same content and the same sent time.

        Raises:
            Problem: 409 if the content differs or the frame has no receipt.
        """
        entry = self.ledger.frames[index]
        receipt, times = self.receipt_of(index), entry.times
        same = times is not None and times.sent == sent and entry.identity == frame_identity(hashes, times.time)
        if receipt is not None and same:
            return receipt
        known = "already stored with different content or a different time"
        if receipt is None:
            missing = entry.state == FrameState.MISSING
            known = "declared missing" if missing else f"{entry.state}: {entry.error or RECORD_LOST}"
        raise Problem(
            409,
            f"frame {index} is {known}",
            field="n",
            value=index,
            remedy=f"send the next frame ({self.ledger.next_frame}); acknowledged frames cannot be changed",
            expected=self.ledger.next_frame,
            identity=entry.identity,
        )
