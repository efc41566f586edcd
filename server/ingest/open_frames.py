"""Accepts frames camera by camera: open until all cameras are in, until closed on request, or until a deadline.

A frame that never came is declared missing here too.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Literal

from client.wire import FileKind, FrameHead, FrameReceipt, FrameReportModel, FrameState, PartReceipt
from server import counters
from server.background import Background
from server.ingest.acknowledge import Ingest, Received, uncancelled
from server.problems import Problem, counted
from server.storage.events import FrameAccepted, FrameMissing, JournalEvent, OpenFrame, PartAccepted
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.journal import replay
from server.storage.ledger import frame_identity

AHEAD = 8
"""Frames that may be open at a time: so far may one camera be ahead of another."""


class OpenFrames:
    """The open frames of one scene.

    Args:
        ingest, background: of the scene.
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

    def expects(self, head: FrameHead, camera: str) -> None:
        """Refuses a part that will be refused, whatever it holds.

        Raises:
            Problem: 409 for a frame too far ahead or that is being sent whole, 422 for its time, 429 where nothing can
                be accepted.
        """
        ledger, index = self._ledger, head.index
        if index < ledger.next_frame:
            return
        if self.ingest.is_coming(index):
            raise Problem(409, f"frame {index} is being sent whole", field="n", value=index, remedy="wait for its end")
        self._admit(head, camera)

    def _admit(self, head: FrameHead, camera: str) -> None:
        ledger, index = self._ledger, head.index
        self.ingest.refuse_if_it_cannot_go_on()
        if index >= ledger.next_frame + AHEAD:
            if not self.ingest.has_room():
                raise self.ingest.full(index)
            raise self.ingest.gap(index)
        frame = ledger.open.get(index)
        if head.time is not None:
            self.ingest.check_time(index, head.time)
            if frame is not None and frame.time is not None and frame.time != head.time:
                raise Problem(
                    422,
                    f"camera {camera!r} gives frame {index} another time than the cameras before it",
                    field="time",
                    value=head.time,
                    remedy=f"give {frame.time!r}, or none: the first time given is the frame's",
                )

    async def accept(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        """Acknowledges one camera's files of a frame.

        Raises:
            Problem: as `Ingest.accept`; 409 for other content than the camera has sent before, and for a part of a
                frame that was closed without it.
        """
        return await uncancelled(self._accept(head, camera, received))

    async def _accept(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        ledger, index, kinds = self._ledger, head.index, received.hashes[camera]
        closed = await self._parts_of(index) if index < ledger.next_frame else None
        async with self._log.lock:
            known = ledger.open.get(index)
            if index < ledger.next_frame:
                known = closed or await self._parts_of(index)
            before = {} if known is None else known.hashes.get(camera, {})
            if any(before.get(kind, value) != value for kind, value in kinds.items()):
                raise Problem(
                    409,
                    f"camera {camera!r} has sent other content for frame {index}",
                    field=camera,
                    value=index,
                    remedy="send the next frame; an acknowledged frame does not change",
                )
            if not all(kind in before for kind in kinds):
                if index < ledger.next_frame:
                    raise Problem(
                        409,
                        f"frame {index} was closed without this of camera {camera!r}",
                        field=camera,
                        value=index,
                        remedy=f"send frame {ledger.next_frame}",
                        expected=ledger.next_frame,
                    )
                self._admit(head, camera)
                assert received.file is not None
                await self._log.append(
                    PartAccepted(index=index, time=head.time, camera=camera, file=received.file, hashes=kinds)
                )
                self._log.pictures.add(received.file, received.size)
                received.kept = True
                counters.INGEST_BYTES.inc(received.size)
                self._set_deadline(index)
        await self._close_due()
        known = await self._parts_of(index) if index < ledger.next_frame else ledger.open[index]
        here = known.cameras if known is not None else []
        entry = ledger.frames.get(index)
        return PartReceipt(
            scene=ledger.scene,
            index=index,
            camera=camera,
            received=here,
            absent=[name for name in self._rules.rig.names if name not in here],
            frame=None if entry is None else entry.receipt,
        )

    async def _parts_of(self, index: int) -> OpenFrame | None:
        """Returns the parts of a closed frame; None where its pictures are gone or it never had any."""
        entry = self._ledger.frames[index]
        known = entry.note.parts
        if known is None and entry.files:
            parts = OpenFrame(index, entry.time)
            try:
                for name in entry.files:
                    pictures = await asyncio.to_thread(read_pictures, self._log.pictures.folder, name)
                    parts.hashes.update(pictures.hashes)
            except FrameDamage:
                return None
            self._ledger.frames.note(index).parts = known = parts
        if known is None and entry.receipt is not None:  # its pictures are deleted; the journal still has its parts
            return await asyncio.to_thread(_parts_in_journal, self._log.journal.path, index)
        return known

    def _set_deadline(self, index: int) -> None:
        seconds = self._rules.part_seconds
        if seconds is not None and index not in self._deadlines:
            self._deadlines[index] = asyncio.get_running_loop().call_later(seconds, self._is_overdue, index)

    def _is_overdue(self, index: int) -> None:
        self._overdue.add(index)
        self._background.run(self.close_due())

    async def close_due(self) -> None:
        """Closes frames, in order, whose cameras are all in or whose deadline is over, while there is room for them."""
        await uncancelled(self._close_due())

    async def _close_due(self) -> None:
        ledger = self._ledger
        async with self._log.lock:
            while (frame := ledger.open.get(ledger.next_frame)) is not None and ledger.fatal is None:
                complete = len(frame.cameras) == len(self._rules.rig)
                if not (complete or frame.index in self._overdue) or not frame.cameras or not self.ingest.has_room():
                    break
                try:
                    await self._close(frame, "complete" if complete else "deadline")
                except Problem:  # the disk is full: the next occasion tries again
                    break
        self.ingest.updates.begin()

    async def close(self, index: int) -> FrameReceipt:
        """Closes a frame on request, with the cameras that are in. A closed frame gets its receipt again.

        Raises:
            Problem: 404, nothing of it is here; 409, one before it is not closed, or fewer cameras are in than the
                scene's minimum; 429, 507 as `Ingest.accept`.
        """
        return await uncancelled(self._close_asked(index))

    async def _close_asked(self, index: int) -> FrameReceipt:
        ledger = self._ledger
        async with self._log.lock:
            if index < ledger.next_frame:
                entry = ledger.frames[index]
                if (known := entry.receipt) is None:
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
                    f"nothing of frame {index} is here",
                    field="n",
                    value=index,
                    remedy=f"send its pictures, or declare it missing; the next frame is {ledger.next_frame}",
                )
            if index > ledger.next_frame:
                raise self.ingest.gap(index)
            least = self._rules.minimum_cameras
            if len(frame.cameras) < least:
                raise Problem(
                    409,
                    f"{counted(len(frame.cameras), 'camera')} of at least {least} sent a picture",
                    field="n",
                    value=index,
                    remedy="send those of more cameras, or declare the frame missing",
                    received=frame.cameras,
                )
            if not self.ingest.has_room():
                raise self.ingest.full(index)
            receipt = await self._close(frame, "request")
        self.ingest.updates.begin()
        return receipt

    async def _close(self, frame: OpenFrame, by: Literal["complete", "request", "deadline"]) -> FrameReceipt:
        """Makes a frame of its parts; the log's lock is held."""
        seconds = self.ingest.time_of(frame.index, frame.time)
        hashes = {camera: kinds for camera, kinds in frame.hashes.items() if FileKind.IMAGE in kinds}
        identity, files = frame_identity(hashes, seconds), tuple(sorted(frame.files))
        event = FrameAccepted(index=frame.index, time=seconds, identity=identity, files=files, closed_by=by)
        receipt = await self.ingest.acknowledge(event)
        self._forget(frame.index)
        return receipt

    async def declare_missing(self, index: int, reason: str) -> FrameReportModel:
        """Declares the next frame missing, for ever; a frame declared before gets the same answer.

        Raises:
            Problem: 409 for a gap, for a frame that was accepted, and for a failed scene; 507 when the disk is full.
        """
        return await uncancelled(self._declare_missing(index, reason))

    async def _declare_missing(self, index: int, reason: str) -> FrameReportModel:
        ledger = self._ledger
        async with self._log.lock:
            if index < ledger.next_frame:
                report = ledger.frames[index].report
                if report.state != FrameState.MISSING:
                    raise Problem(
                        409,
                        f"frame {index} is {report.state}: it was accepted",
                        field="n",
                        value=index,
                        remedy=f"only frames that never came can be missing; the next is {ledger.next_frame}",
                        expected=ledger.next_frame,
                    )
                return report
            self.ingest.refuse_if_failed()
            if index > ledger.next_frame:
                raise self.ingest.gap(index)
            if self.ingest.is_coming(index):
                raise Problem(
                    409, f"frame {index} is just coming in", field="n", value=index, remedy="wait for its end"
                )
            parts = ledger.open.get(index)
            await self._log.append(FrameMissing(index=index, reason=reason or "declared missing"))
            self._forget(index)
            if parts is not None:
                await self._log.delete_pictures(parts.files)
            report = ledger.frames[index].report
        self.ingest.ended(index)
        await self._close_due()
        return report

    def _forget(self, index: int) -> None:
        """Removes the deadline of a frame that is not open any more."""
        self._overdue.discard(index)
        if (handle := self._deadlines.pop(index, None)) is not None:
            handle.cancel()

    def stop(self) -> None:
        """Cancels the deadlines."""
        for handle in self._deadlines.values():
            handle.cancel()


def _parts_in_journal(journal: Path, index: int) -> OpenFrame | None:
    """Reads the parts of a closed frame from the journal: slow, for a camera that repeats a frame deleted long ago."""
    parts = OpenFrame(index)

    def look(event: JournalEvent) -> None:
        if isinstance(event, PartAccepted) and event.index == index:
            parts.add(event)

    replay(journal, look)
    return parts if parts.hashes else None
