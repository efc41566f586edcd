"""Acceptance of frames that are sent camera by camera.

Such a frame is open until the images of all cameras have arrived, a client closes it, or its deadline passes. This
module also declares frames missing if they never arrived.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Literal

from client.wire import CameraReceipt, FileKind, FrameHead, FrameReceipt, FrameReportModel, FrameState
from server import counters
from server.background import Background, shielded
from server.ingest.acknowledge import Ingest, ReceivedFiles
from server.problems import Problem, count_noun
from server.storage.events import CameraAccepted, FrameMissing, JournalEvent, OpenFrame
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.journal import replay

MAX_FRAMES_AHEAD = 8
"""Maximum number of simultaneously open frames, which limits how far one camera can be ahead of another."""


class OpenFrames:
    """Open frames of one scene.

    Args:
        ingest: the scene's frame ingest.
        background: the scene's background tasks.
    """

    def __init__(self, ingest: Ingest, background: Background) -> None:
        self.ingest = ingest
        self._log = ingest.log
        self._ledger = ingest.ledger
        self._rules = ingest.rules
        self._background = background
        self._overdue: set[int] = set()
        self._deadlines: dict[int, asyncio.TimerHandle] = {}
        for index in self._ledger.open:
            self._set_deadline(index)

    def check_head(self, head: FrameHead, camera: str) -> None:
        """Refuses a single-camera upload early if it would be refused regardless of its content.

        Raises:
            Problem: 409 if the frame is too far ahead or is being sent as a whole; 422 if its time differs from that of
                other cameras; 429 if the queue is full.
        """
        ledger, index = self._ledger, head.index
        if index < ledger.next_frame:
            return
        if self.ingest.is_receiving(index):
            raise Problem(
                409,
                f"frame {index} is already being sent as a whole",
                field="n",
                value=index,
                remedy="wait until it has been received",
            )
        self._admit(head, camera)

    def _admit(self, head: FrameHead, camera: str) -> None:
        ledger, index = self._ledger, head.index
        self.ingest.refuse_if_stopped()
        if index >= ledger.next_frame + MAX_FRAMES_AHEAD:
            if not self.ingest.has_room():
                raise self.ingest.queue_full_problem(index)
            raise self.ingest.gap_problem(index)
        frame = ledger.open.get(index)
        if head.time is not None and frame is not None and frame.time not in (None, head.time):
            raise Problem(
                422,
                f"the time of frame {index} from camera {camera!r} differs from the previous cameras' time",
                field="time",
                value=head.time,
                remedy=f"send {frame.time!r} or no time; the first time sent applies to the frame",
            )

    @shielded
    async def accept(self, head: FrameHead, camera: str, received: ReceivedFiles) -> CameraReceipt:
        """Acknowledges one camera's files of a frame.

        Raises:
            Problem: see `Ingest.accept`; also 409 if the camera sent different content before, or if the frame was
                closed without this file.
        """
        ledger, index, kinds = self._ledger, head.index, received.hashes[camera]
        closed = await self._camera_events_of(index) if index < ledger.next_frame else None
        async with self._log.lock:
            known = ledger.open.get(index)
            if index < ledger.next_frame:
                known = closed or await self._camera_events_of(index)
            before = {} if known is None else known.hashes.get(camera, {})
            if any(before.get(kind, value) != value for kind, value in kinds.items()):
                raise Problem(
                    409,
                    f"camera {camera!r} has already sent different content for frame {index}",
                    field=camera,
                    value=index,
                    remedy="send the next frame; acknowledged frames cannot be changed",
                )
            if not all(kind in before for kind in kinds):
                if index < ledger.next_frame:
                    raise Problem(
                        409,
                        f"frame {index} was closed before this file of camera {camera!r} arrived",
                        field=camera,
                        value=index,
                        remedy=f"send frame {ledger.next_frame}",
                        expected=ledger.next_frame,
                    )
                self._admit(head, camera)
                assert received.file is not None
                await self._log.append(
                    CameraAccepted(index=index, time=head.time, camera=camera, file=received.file, hashes=kinds)
                )
                self._log.pictures.add(received.file, received.size)
                received.kept = True
                counters.INGEST_BYTES.inc(received.size)
                self._set_deadline(index)
        await self.close_due()
        known = await self._camera_events_of(index) if index < ledger.next_frame else ledger.open[index]
        here = known.cameras if known is not None else []
        entry = ledger.frames.get(index)
        return CameraReceipt(
            scene=ledger.scene,
            index=index,
            camera=camera,
            received=here,
            absent=[name for name in self._rules.rig.names if name not in here],
            frame=None if entry is None else self.ingest.receipt_of(index),
        )

    async def _camera_events_of(self, index: int) -> OpenFrame | None:
        """Returns the single-camera uploads of a closed frame, or None if they are unknown."""
        entry = self._ledger.frames[index]
        known = entry.rare_properties.parts
        if known is None and entry.files:
            parts = OpenFrame(index, entry.time)
            try:
                for name in entry.files:
                    pictures = await asyncio.to_thread(read_pictures, self._log.pictures.folder, name)
                    parts.hashes.update(pictures.hashes)
            except FrameDamage:
                return None
            self._ledger.frames.rare_properties(index).parts = known = parts
        if known is None and entry.receipt is not None:  # its images are deleted; the journal has the uploads
            return await asyncio.to_thread(_camera_events_in_journal, self._log.journal.path, index)
        return known

    def _set_deadline(self, index: int) -> None:
        seconds = self._rules.open_frame_seconds
        if seconds is not None and index not in self._deadlines:
            self._deadlines[index] = asyncio.get_running_loop().call_later(seconds, self._is_overdue, index)

    def _is_overdue(self, index: int) -> None:
        self._overdue.add(index)
        self._background.run(self.close_due())

    @shielded
    async def close_due(self) -> None:
        """Closes complete and overdue frames in order, as long as the queue has room."""
        ledger = self._ledger
        async with self._log.lock:
            while (frame := ledger.open.get(ledger.next_frame)) is not None and ledger.fatal is None:
                complete = len(frame.cameras) == len(self._rules.rig)
                if not (complete or frame.index in self._overdue) or not frame.cameras or not self.ingest.has_room():
                    break
                try:
                    await self._close(frame, "complete" if complete else "deadline")
                except Problem:  # the disk is full; the next call will retry
                    break
        self.ingest.updates.begin()

    @shielded
    async def close(self, index: int) -> FrameReceipt:
        """Closes a frame on request with the images received so far; a closed frame gets the same receipt again.

        Raises:
            Problem: 404 if no image has arrived; 409 if an earlier frame is not closed or fewer than the scene's
                minimum number of cameras have sent an image; 429 and 507 as for `Ingest.accept`.
        """
        ledger = self._ledger
        async with self._log.lock:
            if index < ledger.next_frame:
                entry = ledger.frames[index]
                if (known := self.ingest.receipt_of(index)) is None:
                    raise Problem(
                        409,
                        f"frame {index} is {entry.state}: {entry.error}",
                        field="n",
                        value=index,
                        remedy=f"send frame {ledger.next_frame}",
                        expected=ledger.next_frame,
                    )
                return known
            self.ingest.refuse_if_failed()
            frame = ledger.open.get(index)
            if frame is None:
                raise Problem(
                    404,
                    f"no image of frame {index} has been received",
                    field="n",
                    value=index,
                    remedy=f"send its images, or declare it missing; the next frame is {ledger.next_frame}",
                )
            if index > ledger.next_frame:
                raise self.ingest.gap_problem(index)
            least = self._rules.minimum_cameras
            if len(frame.cameras) < least:
                raise Problem(
                    409,
                    f"received images of {count_noun(len(frame.cameras), 'camera')}, but at least {least} are required",
                    field="n",
                    value=index,
                    remedy="send images of more cameras, or declare the frame missing",
                    received=frame.cameras,
                )
            if not self.ingest.has_room():
                raise self.ingest.queue_full_problem(index)
            receipt = await self._close(frame, "request")
        self.ingest.updates.begin()
        return receipt

    async def _close(self, frame: OpenFrame, by: Literal["complete", "request", "deadline"]) -> FrameReceipt:
        """Closes a frame with the uploads received so far; the caller must hold the log's lock."""
        seconds = self.ingest.time_of(frame.index, frame.time)
        hashes = {camera: kinds for camera, kinds in frame.hashes.items() if FileKind.IMAGE in kinds}
        receipt = await self.ingest.acknowledge(frame.index, seconds, hashes, tuple(sorted(frame.files)), by)
        self._forget(frame.index)
        return receipt

    @shielded
    async def declare_missing(self, index: int, reason: str) -> FrameReportModel:
        """Permanently declares the next frame missing; a repeated declaration gets the same response.

        Raises:
            Problem: 409 for a gap, an accepted frame or a failed scene; 507 if the disk is full.
        """
        ledger = self._ledger
        async with self._log.lock:
            if index < ledger.next_frame:
                report = ledger.frames[index].report
                if report.state != FrameState.MISSING:
                    raise Problem(
                        409,
                        f"frame {index} has already been accepted and is {report.state}",
                        field="n",
                        value=index,
                        remedy=f"declare only lost frames as missing; the next frame is {ledger.next_frame}",
                        expected=ledger.next_frame,
                    )
                return report
            self.ingest.refuse_if_failed()
            if index > ledger.next_frame:
                raise self.ingest.gap_problem(index)
            if self.ingest.is_receiving(index):
                raise Problem(
                    409,
                    f"frame {index} is being received",
                    field="n",
                    value=index,
                    remedy="wait until it has been received",
                )
            parts = ledger.open.get(index)
            await self._log.append(FrameMissing(index=index, reason=reason or "declared missing"))
            self._forget(index)
            if parts is not None:
                await self._log.delete_pictures(parts.files)
            report = ledger.frames[index].report
        self.ingest.publish_ended(index)
        await self.close_due()
        return report

    def _forget(self, index: int) -> None:
        """Removes the deadline of a frame that is no longer open."""
        self._overdue.discard(index)
        if (handle := self._deadlines.pop(index, None)) is not None:
            handle.cancel()

    def stop(self) -> None:
        """Cancels all deadlines."""
        for handle in self._deadlines.values():
            handle.cancel()


def _camera_events_in_journal(journal: Path, index: int) -> OpenFrame | None:
    """Returns the single-camera uploads of a closed frame from the journal, or None if there are none.

    This is slow, but only needed if a camera resends a frame whose images were already deleted.
    """
    parts = OpenFrame(index)

    def look(event: JournalEvent) -> None:
        if isinstance(event, CameraAccepted) and event.index == index:
            parts.add(event)

    replay(journal, look)
    return parts if parts.hashes else None
