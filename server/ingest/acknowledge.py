"""The door of a scene for frames: what is taken, in which order, and what is answered. Acknowledged means on disk."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any, TypeVar

from client.wire import Budget, FrameHead, FrameReceipt, FrameReportModel, FrameState, PartReceipt
from server.health import metrics
from server.ingest.admission import Admission
from server.ingest.open_frames import OpenFrames
from server.ingest.upload import Received
from server.problems import Problem, counted
from server.storage.disk import full_disk, no_room
from server.storage.events import Budgeted, Fact, Missing, Paused, Skipped, Taken
from server.storage.frame_store import remove
from server.storage.ledger import frame_identity

if TYPE_CHECKING:
    from server.scene.scene import Scene

T = TypeVar("T")

MOST_SOCKETS = 64
"""WebSockets that send frames to one scene: one a camera where each has a sender of its own."""


class Ingest:
    """Takes frames into a scene's ledger, the journal first. One at a time; uploads come in side by side."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.rules = Admission(scene)
        self._open = OpenFrames(scene, self.rules, self._append)
        self._sockets = 0
        self._coming: dict[int, asyncio.Event] = {}
        """Whole frames that are being received, and the event of their end: the next may come in meanwhile."""

    def join(self) -> None:
        """One more WebSocket sends frames; to be told `leave` when it ends.

        Raises:
            Problem: 429, as many do as may.
        """
        if self._sockets >= MOST_SOCKETS:
            raise Problem(
                429,
                f"{counted(self._sockets, 'WebSocket')} send frames to this scene already",
                field="id",
                value=self._scene.id,
                remedy="close another one, or send over HTTP",
                headers={"Retry-After": "5"},
            )
        self._sockets += 1

    def leave(self) -> None:
        """A WebSocket has ended."""
        self._sockets -= 1

    def time_of(self, index: int, time: float | None) -> float:
        """Seconds of a frame: as given, or by the scene's frame rate."""
        return self.rules.time_of(index, time)

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
            self.rules.admit(head.index, self.rules.time_of(head.index, head.time))
        elif head.index > awaited:
            raise self.rules.gap(head.index)
        else:  # those before it are just coming in: it is judged when they are here
            self.rules.refuse_if_failed()
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
        return await whole(self._take(head, received))

    async def _take(self, head: FrameHead, received: Received) -> FrameReceipt:
        scene = self._scene
        seconds = self.rules.time_of(head.index, head.time)
        identity = frame_identity(received.hashes, seconds)
        async with scene.door:
            if head.index < scene.next_frame:
                return self.rules.again(head.index, identity)
            self.rules.admit(head.index, seconds)
            if received.file is None:  # it was known when it came, and is not any more: a scene forgets nothing
                raise AssertionError(f"frame {head.index} was not written")
            fact = Taken(index=head.index, time=seconds, identity=identity, files=(received.file,))
            await self._append(*self.rules.skips(head.index), fact)
            scene.held.add(received.file, received.size)
            received.kept = True
            metrics.INGEST_BYTES.inc(received.size)
            metrics.FRAMES.labels("acknowledged").inc()
            receipt = scene.frames[head.index].receipt
            assert receipt is not None
        scene.work()
        return receipt

    def expects_part(self, head: FrameHead, camera: str) -> None:
        """Refuses a part that will be refused, whatever it holds.

        Raises:
            Problem: 409 for a frame too far ahead or that is being sent whole, 422 for its time, 429 where nothing can
                be taken.
        """
        index = head.index
        if index >= self._scene.next_frame and index in self._coming:
            raise Problem(409, f"frame {index} is being sent whole", field="n", value=index, remedy="wait for its end")
        self._open.expects(head, camera)

    async def take_part(self, head: FrameHead, camera: str, received: Received) -> PartReceipt:
        """Acknowledges one camera's files of a frame.

        Raises:
            Problem: as `take`; 409 for other content than the camera has sent before, and for a part of a frame that
                was closed without it.
        """
        return await whole(self._open.take(head, camera, received))

    async def close_what_can_be(self) -> None:
        """Closes frames, in order, whose cameras are all in or whose deadline is over, while there is room for them."""
        await whole(self._open.close_due())

    async def close(self, index: int) -> FrameReceipt:
        """Closes a frame on request, with the cameras that are in. Closed already, it answers as before.

        Raises:
            Problem: 404, nothing of it is here; 409, one before it is not closed, or fewer cameras are in than the
                scene's minimum; 429, 507 as `take`.
        """
        return await whole(self._open.close(index))

    async def declare_missing(self, index: int, reason: str) -> FrameReportModel:
        """Declares the next frame missing, for ever; declared already, it answers the same.

        Raises:
            Problem: 409 for a gap, for a frame that was taken, and for a failed scene; 507 when the disk is full.
        """
        return await whole(self._declare_missing(index, reason))

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
            self.rules.refuse_if_failed()
            if index > scene.next_frame:
                raise self.rules.gap(index)
            if index in self._coming:
                raise Problem(
                    409, f"frame {index} is just coming in", field="n", value=index, remedy="wait for its end"
                )
            parts = scene.ledger.open.get(index)
            await self._append(Missing(index=index, reason=reason or "declared missing"))
            self._open.forget(index)
            if parts is not None:
                scene.held.discard(parts.files)
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

        await whole(change())

    async def budget(self, budget: Budget) -> None:
        """Another budget from the first frame on that is not begun; none begins while that is written down.

        Raises:
            Problem: 409 for a failed scene, 507 when the disk is full.
        """

        async def change() -> None:
            scene = self._scene
            async with scene.door:
                self.rules.refuse_if_failed()
                if scene.ledger.budgets[-1][1] == budget:
                    return
                with scene.no_frame_begins():
                    await self._append(Budgeted(index=scene.ledger.begins_next(), budget=budget))

        await whole(change())

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
        self._open.stop()


async def whole(coroutine: Coroutine[Any, Any, T]) -> T:
    """Runs to its end even where whoever asked is gone: the ledger must not stay behind the journal."""
    return await asyncio.shield(asyncio.ensure_future(coroutine))
