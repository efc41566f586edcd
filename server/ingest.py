"""The door of a scene for frames: what is taken, in which order, and what is answered. Acknowledged means on disk."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any, TypeVar

from client.wire import FileKind, FrameHead, FrameReceipt, FrameReportModel, FrameState, PartReceipt
from server import metrics
from server.disk import full_disk, no_room
from server.facts import Fact, Missing, PartTaken, Paused, Skipped, Taken
from server.frame_store import FrameDamage, read_pictures, remove
from server.ledger import OpenFrame, frame_identity
from server.problems import Problem
from server.upload import Received

if TYPE_CHECKING:
    from server.scene import Scene

T = TypeVar("T")

OPEN_FRAMES = 8
"""Frames that cameras may be sending at a time: how far one camera may be ahead of another."""


class Ingest:
    """Takes frames into a scene's ledger, the journal first. One at a time; uploads come in side by side."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._coming: dict[int, asyncio.Event] = {}
        """Whole frames that are being received, and the event of their end: the next may come in meanwhile."""
        self._overdue: set[int] = set()
        self._deadlines: dict[int, asyncio.TimerHandle] = {}
        for index in scene.ledger.open:
            self._set_deadline(index)

    # Whole frames.

    def time_of(self, index: int, time: float | None) -> float:
        """Seconds of a frame: as given, or by the scene's frame rate."""
        return index / self._scene.request.frames_per_second if time is None else time

    def expects(self, head: FrameHead) -> bool:
        """Whether a whole frame is worth writing: False for one that is known, whose content is only compared.

        Raises:
            Problem: it will be refused, whatever it holds.
        """
        ledger = self._scene.ledger
        if head.index < ledger.next_frame:
            return False
        awaited = ledger.next_frame
        while awaited in self._coming:
            awaited += 1
        if head.index == ledger.next_frame:
            self._admit(head.index, self.time_of(head.index, head.time))
        elif head.index > awaited:
            raise self._gap(head.index)
        else:  # those before it are just coming in: it is judged when they are here
            self._refuse_if_failed()
        return True

    def coming(self, index: int) -> asyncio.Event:
        """The frame is being received; to be set, and forgotten by `came`, when it is taken or refused."""
        return self._coming.setdefault(index, asyncio.Event())

    def came(self, index: int) -> None:
        """The frame is taken or refused."""
        if (event := self._coming.pop(index, None)) is not None:
            event.set()

    async def take(self, head: FrameHead, received: Received) -> FrameReceipt:
        """Acknowledges a frame whose pictures are on disk, and queues it; or answers as the first time.

        Raises:
            Problem: 409 for a gap, for other content under a known index and for a failed scene; 422 for a time that
                does not rise; 429 when the queue is full; 507 when the disk is.
        """
        while (before := self._coming.get(head.index - 1)) is not None and head.index > self._scene.next_frame:
            await before.wait()
        return await _whole(self._take(head, received))

    async def _take(self, head: FrameHead, received: Received) -> FrameReceipt:
        scene = self._scene
        seconds = self.time_of(head.index, head.time)
        identity = frame_identity(received.hashes, seconds)
        async with scene.door:
            if head.index < scene.next_frame:
                return self._again(head.index, identity)
            self._admit(head.index, seconds)
            if received.file is None:  # it was known when it came, and is not any more: a scene forgets nothing
                raise AssertionError(f"frame {head.index} was not written")
            fact = Taken(index=head.index, time=seconds, identity=identity, files=(received.file,))
            await self._append(*self._skips(head.index), fact)
            scene.sizes[received.file] = received.size
            received.kept = True
            metrics.INGEST_BYTES.inc(received.size)
            metrics.FRAMES.labels("acknowledged").inc()
            receipt = scene.frames[head.index].receipt
            assert receipt is not None
        scene.work()
        return receipt

    def _again(self, index: int, identity: str) -> FrameReceipt:
        entry = self._scene.frames[index]
        if entry.receipt is None or entry.receipt.identity != identity:
            state = entry.report.state
            known = "known with other content or another time"
            if entry.receipt is None:
                known = "declared missing" if state == FrameState.MISSING else f"set aside: {entry.report.error}"
            raise Problem(
                409,
                f"frame {index} is {known}",
                field="n",
                value=index,
                remedy=f"send the next frame, {self._scene.next_frame}; what was acknowledged does not change",
                expected=self._scene.next_frame,
                identity=entry.report.identity,
            )
        return entry.receipt

    def _admit(self, index: int, seconds: float | None) -> None:
        """Refuses a frame that cannot be the next; `seconds` None leaves its time unjudged."""
        scene = self._scene
        self._refuse_if_failed()
        if index != scene.next_frame:
            raise self._gap(index)
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
            self._check_time(index, seconds)
        if not self._room():
            raise self._full(index)

    def _refuse_if_failed(self) -> None:
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

    def _gap(self, index: int) -> Problem:
        expected = self._scene.next_frame
        return Problem(
            409,
            f"frame {index} would leave a gap: frame t is found from frame t−1",
            field="n",
            value=index,
            remedy=f"send frame {expected} first, or declare it missing: POST …/frames/{expected}/missing",
            expected=expected,
        )

    def _check_time(self, index: int, seconds: float) -> None:
        before = self._scene.ledger.last_time()
        if not (math.isfinite(seconds) and (before is None or seconds > before)):
            raise Problem(
                422,
                f"the time of frame {index} is not after that of the frame before it",
                field="time",
                value=seconds,
                remedy="give finite seconds" if before is None else f"give seconds above {before:g}",
            )

    def _room(self) -> bool:
        """Whether the queue takes one more, if need be by skipping."""
        scene = self._scene
        if scene.queued < scene.queue_limit:
            return True
        return scene.rules.when_full == "skip" and bool(scene.ledger.waiting())

    def _full(self, index: int) -> Problem:
        scene = self._scene
        wait = min(60, max(1, math.ceil(scene.last_seconds)))
        return Problem(
            429,
            f"{scene.queued} frames wait already",
            field="n",
            value=index,
            remedy=f"send the same frame again in {wait} s",
            headers={"Retry-After": str(wait)},
            queued=scene.queued,
        )

    def _skips(self, index: int) -> list[Fact]:
        """What has to be skipped to make room for a frame."""
        scene = self._scene
        if scene.queued < scene.queue_limit:
            return []
        return [Skipped(frames=tuple(scene.ledger.waiting()), by=index)]

    # Frames camera by camera.

    def expects_part(self, head: FrameHead, camera: str) -> None:
        """Refuses a part that will be refused, whatever it holds.

        Raises:
            Problem: 409 for a frame too far ahead, 422 for its time, 429 where nothing can be taken.
        """
        scene, index = self._scene, head.index
        if index < scene.next_frame:
            return
        self._refuse_if_failed()
        if index in self._coming:
            raise Problem(409, f"frame {index} is being sent whole", field="n", value=index, remedy="wait for its end")
        if index >= scene.next_frame + OPEN_FRAMES:
            if not self._room():
                raise self._full(index)
            raise self._gap(index)
        frame = scene.ledger.open.get(index)
        if head.time is not None:
            self._check_time(index, head.time)
            if frame is not None and frame.time is not None and frame.time != head.time:
                raise Problem(
                    422,
                    f"camera {camera!r} gives frame {index} another time than the cameras before it",
                    field="time",
                    value=head.time,
                    remedy=f"give {frame.time!r}, or none: the first time given is the frame's",
                )

    async def take_part(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        """Acknowledges one camera's files of a frame.

        Raises:
            Problem: as `take`; 409 for other content than the camera has sent before, and for a part of a frame that
                was closed without it.
        """
        return await _whole(self._take_part(head, camera, received))

    async def _take_part(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        scene, index, kinds = self._scene, head.index, received.hashes[camera]
        async with scene.door:
            known = await self._parts_of(index) if index < scene.next_frame else scene.ledger.open.get(index)
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
                self.expects_part(head, camera)
                assert received.file is not None
                fact = PartTaken(index=index, time=head.time, camera=camera, file=received.file, hashes=kinds)
                await self._append(fact)
                scene.sizes[received.file] = received.size
                received.kept = True
                metrics.INGEST_BYTES.inc(received.size)
                self._set_deadline(index)
        await self.close_what_can_be()
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
        if entry.parts is None and entry.files:
            parts = OpenFrame(index, entry.report.time)
            try:
                for name in entry.files:
                    pictures = await asyncio.to_thread(read_pictures, self._scene.spec.frames, name)
                    parts.hashes.update(pictures.hashes)
            except FrameDamage:
                return None
            entry.parts = parts
        return entry.parts

    def _set_deadline(self, index: int) -> None:
        seconds = self._scene.rules.part_seconds
        if seconds is not None and index not in self._deadlines:
            self._deadlines[index] = asyncio.get_running_loop().call_later(seconds, self._is_overdue, index)

    def _is_overdue(self, index: int) -> None:
        self._overdue.add(index)
        self._scene.background(self.close_what_can_be())

    async def close_what_can_be(self) -> None:
        """Closes frames, in order, whose cameras are all in or whose deadline is over, while there is room for them."""
        await _whole(self._close_what_can_be())

    async def _close_what_can_be(self) -> None:
        scene = self._scene
        async with scene.door:
            while (frame := scene.ledger.open.get(scene.next_frame)) is not None and scene.ledger.fatal is None:
                complete = len(frame.cameras) == len(scene.rig)
                if not (complete or frame.index in self._overdue) or not frame.cameras or not self._room():
                    break
                try:
                    await self._close(frame, "complete" if complete else "deadline")
                except Problem:  # the disk is full: the next occasion tries again
                    break
        scene.work()

    async def close(self, index: int) -> FrameReceipt:
        """Closes a frame on request, with the cameras that are in. Closed already, it answers as before.

        Raises:
            Problem: 404, nothing of it is here; 409, one before it is not closed, or fewer cameras are in than the
                scene's minimum; 429, 507 as `take`.
        """
        return await _whole(self._close_on_request(index))

    async def _close_on_request(self, index: int) -> FrameReceipt:
        scene = self._scene
        async with scene.door:
            if index < scene.next_frame:
                receipt = scene.frames[index].receipt
                if receipt is None:
                    raise self._never_taken(index)
                return receipt
            self._refuse_if_failed()
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
                raise self._gap(index)
            if len(frame.cameras) < scene.minimum_cameras:
                raise Problem(
                    409,
                    f"{len(frame.cameras)} cameras are in, the scene's minimum is {scene.minimum_cameras}",
                    field="n",
                    value=index,
                    remedy="send more cameras, or declare the frame missing",
                    received=frame.cameras,
                )
            if not self._room():
                raise self._full(index)
            receipt = await self._close(frame, "request")
        scene.work()
        return receipt

    def _never_taken(self, index: int) -> Problem:
        report = self._scene.frames[index].report
        return Problem(
            409,
            f"frame {index} is {report.state}: {report.error}",
            field="n",
            value=index,
            remedy=f"send frame {self._scene.next_frame}",
            expected=self._scene.next_frame,
        )

    async def _close(self, frame: OpenFrame, by: Any) -> FrameReceipt:
        """Makes a frame of its parts; the door is held."""
        scene = self._scene
        seconds = self.time_of(frame.index, frame.time)
        hashes = {camera: kinds for camera, kinds in frame.hashes.items() if FileKind.IMAGE in kinds}
        identity = frame_identity(hashes, seconds)
        fact = Taken(index=frame.index, time=seconds, identity=identity, files=tuple(sorted(frame.files)), closed_by=by)
        await self._append(*self._skips(frame.index), fact)
        self._forget_deadline(frame.index)
        metrics.FRAMES.labels("acknowledged").inc()
        receipt = scene.frames[frame.index].receipt
        assert receipt is not None
        return receipt

    def _forget_deadline(self, index: int) -> None:
        self._overdue.discard(index)
        if (handle := self._deadlines.pop(index, None)) is not None:
            handle.cancel()

    # Frames that never come, and the pause.

    async def declare_missing(self, index: int, reason: str) -> FrameReportModel:
        """Declares the next frame missing, for ever; declared already, it answers the same.

        Raises:
            Problem: 409 for a gap, for a frame that was taken, and for a failed scene; 507 when the disk is full.
        """
        return await _whole(self._declare_missing(index, reason))

    async def _declare_missing(self, index: int, reason: str) -> FrameReportModel:
        scene = self._scene
        async with scene.door:
            if index < scene.next_frame:
                report = scene.frames[index].report
                if report.state != FrameState.MISSING:
                    raise Problem(
                        409,
                        f"frame {index} is {report.state}: it was taken",
                        field="n",
                        value=index,
                        remedy=f"only frames that never came can be missing; the next is {scene.next_frame}",
                        expected=scene.next_frame,
                    )
                return report
            self._refuse_if_failed()
            if index > scene.next_frame:
                raise self._gap(index)
            if index in self._coming:
                raise Problem(
                    409, f"frame {index} is just coming in", field="n", value=index, remedy="wait for its end"
                )
            parts = scene.ledger.open.get(index)
            await self._append(Missing(index=index, reason=reason or "declared missing"))
            self._forget_deadline(index)
            if parts is not None:
                for name in parts.files:
                    scene.sizes.pop(name, None)
                await asyncio.to_thread(remove, scene.spec.frames, parts.files)
            report = scene.frames[index].report
        scene.finished(report)
        await self.close_what_can_be()
        return report

    async def pause(self, paused: bool) -> None:
        """The scene reconstructs nothing more, or goes on; stays so over a restart."""

        async def change() -> None:
            async with self._scene.door:
                if self._scene.ledger.paused != paused:
                    await self._append(Paused(paused=paused))

        await _whole(change())

    async def _append(self, *facts: Fact) -> None:
        """Facts on disk, then in the ledger."""
        try:
            await self._scene.journal.append(*facts)
        except OSError as error:
            if not no_room(error):
                raise
            raise full_disk(error) from None
        for fact in facts:
            self._scene.ledger.apply(fact)
            if isinstance(fact, Skipped):
                for index in fact.frames:
                    self._scene.finished(self._scene.frames[index].report)

    def stop(self) -> None:
        """No deadline comes any more."""
        for handle in self._deadlines.values():
            handle.cancel()


async def _whole(coroutine: Coroutine[Any, Any, T]) -> T:
    """Runs to its end even where whoever asked is gone: the ledger must not stay behind the journal."""
    return await asyncio.shield(asyncio.ensure_future(coroutine))
