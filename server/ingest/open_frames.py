"""Frames whose cameras send one by one: open until all are in, until they are closed on request, or at a deadline."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from client.wire import FileKind, FrameHead, FrameReceipt, PartReceipt
from server.health import metrics
from server.ingest.admission import Admission
from server.ingest.upload import Received
from server.problems import Problem, counted
from server.storage.events import FrameAccepted, JournalEvent, PartAccepted
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.journal import replay
from server.storage.ledger import OpenFrame, frame_identity

if TYPE_CHECKING:
    from server.scene.scene import Scene

OPEN_FRAMES = 8
"""Frames that cameras may be sending at a time: how far one camera may be ahead of another."""


class OpenFrames:
    """The open frames of one scene.

    Args:
        scene: their scene. rules: of its door. append: puts events on disk and into the ledger.
    """

    def __init__(self, scene: Scene, rules: Admission, append: Callable[..., Awaitable[None]]) -> None:
        self._scene = scene
        self.rules = rules
        self._append = append
        self._overdue: set[int] = set()
        self._deadlines: dict[int, asyncio.TimerHandle] = {}
        for index in scene.ledger.open:
            self._set_deadline(index)

    def expects(self, head: FrameHead, camera: str) -> None:
        """Refuses a part that will be refused, whatever it holds.

        Raises:
            Problem: 409 for a frame too far ahead, 422 for its time, 429 where nothing can be taken.
        """
        scene, index = self._scene, head.index
        if index < scene.next_frame:
            return
        self.rules.refuse_if_failed()
        if index >= scene.next_frame + OPEN_FRAMES:
            if not self.rules.room():
                raise self.rules.full(index)
            raise self.rules.gap(index)
        frame = scene.ledger.open.get(index)
        if head.time is not None:
            self.rules.check_time(index, head.time)
            if frame is not None and frame.time is not None and frame.time != head.time:
                raise Problem(
                    422,
                    f"camera {camera!r} gives frame {index} another time than the cameras before it",
                    field="time",
                    value=head.time,
                    remedy=f"give {frame.time!r}, or none: the first time given is the frame's",
                )

    async def take(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        """See `Ingest.take_part`."""
        scene, index, kinds = self._scene, head.index, received.hashes[camera]
        closed = await self._parts_of(index) if index < scene.next_frame else None
        async with scene.door:
            known = scene.ledger.open.get(index)
            if index < scene.next_frame:
                known = closed or await self._parts_of(index)
            before = {} if known is None else known.hashes.get(camera, {})
            if any(before.get(kind, value) != value for kind, value in kinds.items()):
                raise Problem(
                    409,
                    f"camera {camera!r} has sent other content for frame {index}",
                    field=camera,
                    value=index,
                    remedy="what was acknowledged does not change; send the next frame",
                )
            if not all(kind in before for kind in kinds):
                if index < scene.next_frame:
                    raise Problem(
                        409,
                        f"frame {index} was closed without this of camera {camera!r}",
                        field=camera,
                        value=index,
                        remedy=f"send frame {scene.next_frame}",
                        expected=scene.next_frame,
                    )
                self.expects(head, camera)
                assert received.file is not None
                event = PartAccepted(index=index, time=head.time, camera=camera, file=received.file, hashes=kinds)
                await self._append(event)
                scene.held.add(received.file, received.size)
                received.kept = True
                metrics.INGEST_BYTES.inc(received.size)
                self._set_deadline(index)
        await self.close_due()
        known = await self._parts_of(index) if index < scene.next_frame else scene.ledger.open[index]
        here = known.cameras if known is not None else []
        entry = scene.frames.get(index)
        return PartReceipt(
            scene=scene.id,
            index=index,
            camera=camera,
            received=here,
            absent=[name for name in scene.rig.names if name not in here],
            frame=None if entry is None else entry.receipt,
        )

    async def _parts_of(self, index: int) -> OpenFrame | None:
        """What a closed frame consists of; None where its pictures are gone or it never had any."""
        entry = self._scene.frames[index]
        known = entry.note.parts
        if known is None and entry.files:
            parts = OpenFrame(index, entry.time)
            try:
                for name in entry.files:
                    pictures = await asyncio.to_thread(read_pictures, self._scene.spec.frames, name)
                    parts.hashes.update(pictures.hashes)
            except FrameDamage:
                return None
            self._scene.frames.note(index).parts = known = parts
        if known is None and entry.receipt is not None:  # its pictures are deleted; what they were is known
            return await asyncio.to_thread(_parts_told, self._scene.spec.journal, index)
        return known

    def _set_deadline(self, index: int) -> None:
        seconds = self._scene.rules.part_seconds
        if seconds is not None and index not in self._deadlines:
            self._deadlines[index] = asyncio.get_running_loop().call_later(seconds, self._is_overdue, index)

    def _is_overdue(self, index: int) -> None:
        self._overdue.add(index)
        self._scene.background(self._scene.ingest.close_what_can_be())

    async def close_due(self) -> None:
        """Closes frames, in order, whose cameras are all in or whose deadline is over, while there is room for them."""
        scene = self._scene
        async with scene.door:
            while (frame := scene.ledger.open.get(scene.next_frame)) is not None and scene.ledger.fatal is None:
                complete = len(frame.cameras) == len(scene.rig)
                if not (complete or frame.index in self._overdue) or not frame.cameras or not self.rules.room():
                    break
                try:
                    await self._close(frame, "complete" if complete else "deadline")
                except Problem:  # the disk is full: the next occasion tries again
                    break
        scene.work()

    async def close(self, index: int) -> FrameReceipt:
        """See `Ingest.close`."""
        scene = self._scene
        async with scene.door:
            if index < scene.next_frame:
                receipt = scene.frames[index].receipt
                if receipt is None:
                    raise self.rules.never_taken(index)
                return receipt
            self.rules.refuse_if_failed()
            frame = scene.ledger.open.get(index)
            if frame is None:
                raise Problem(
                    404,
                    f"nothing of frame {index} is here",
                    field="n",
                    value=index,
                    remedy=f"send its pictures, or declare it missing; the next frame is {scene.next_frame}",
                )
            if index > scene.next_frame:
                raise self.rules.gap(index)
            if len(frame.cameras) < scene.minimum_cameras:
                raise Problem(
                    409,
                    f"{counted(len(frame.cameras), 'camera')} of at least {scene.minimum_cameras} sent a picture",
                    field="n",
                    value=index,
                    remedy="send those of more cameras, or declare the frame missing",
                    received=frame.cameras,
                )
            if not self.rules.room():
                raise self.rules.full(index)
            receipt = await self._close(frame, "request")
        scene.work()
        return receipt

    async def _close(self, frame: OpenFrame, by: Literal["complete", "request", "deadline"]) -> FrameReceipt:
        """Makes a frame of its parts; the door is held."""
        scene = self._scene
        seconds = self.rules.time_of(frame.index, frame.time)
        hashes = {camera: kinds for camera, kinds in frame.hashes.items() if FileKind.IMAGE in kinds}
        identity = frame_identity(hashes, seconds)
        event = FrameAccepted(
            index=frame.index, time=seconds, identity=identity, files=tuple(sorted(frame.files)), closed_by=by
        )
        await self._append(*self.rules.skips(frame.index), event)
        self.forget(frame.index)
        metrics.FRAMES.labels("acknowledged").inc()
        receipt = scene.frames[frame.index].receipt
        assert receipt is not None
        return receipt

    def forget(self, index: int) -> None:
        """The frame is not open any more."""
        self._overdue.discard(index)
        if (handle := self._deadlines.pop(index, None)) is not None:
            handle.cancel()

    def stop(self) -> None:
        """No deadline comes any more."""
        for handle in self._deadlines.values():
            handle.cancel()


def _parts_told(journal: Path, index: int) -> OpenFrame | None:
    """What the journal says that a frame was closed from: slow, for who sends again what was deleted long ago."""
    parts = OpenFrame(index)

    def look(event: JournalEvent) -> None:
        if isinstance(event, PartAccepted) and event.index == index:
            parts.add(event)

    replay(journal, look)
    return parts if parts.hashes else None
