"""Scenes: their states, the door for frames, and the way to their two processes. All on the event loop."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import math
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from client.wire import (
    FrameReceipt,
    FrameReportModel,
    FrameState,
    ProgressModel,
    SceneCreate,
    SceneState,
    SceneStatus,
)
from scas4d_core.cameras import Camera
from scas4d_core.settings import Settings
from server import renderer, worker
from server.frame_files import write_frame
from server.hub import Event, FrameFinished, Hub, SceneChanged
from server.messages import (
    Answer,
    Ask,
    Committed,
    FrameReady,
    Progressed,
    Query,
    Refused,
    SceneSpec,
    SetAside,
    Started,
)
from server.placement import Placement
from server.problems import Problem
from server.settings import ServerSettings

log = logging.getLogger("scas4d.server")


@dataclass
class FrameEntry:
    """What the service knows of a frame."""

    receipt: FrameReceipt
    report: FrameReportModel


def frame_identity(images: Mapping[str, bytes], masks: Mapping[str, bytes], time: float) -> str:
    """SHA-256 over the set of (camera, kind, SHA-256 of the file) and the time."""
    parts = sorted(
        (camera, kind, hashlib.sha256(data).hexdigest())
        for kind, files in (("image", images), ("mask", masks))
        for camera, data in files.items()
    )
    return hashlib.sha256(json.dumps([parts, time]).encode()).hexdigest()


class Scene:
    """One rig, one reconstruction.

    Frames are numbered from 0 without gaps; a frame is acknowledged, waits in a bounded queue, and ends committed
    or set aside.
    """

    def __init__(
        self, id: str, request: SceneCreate, settings: Settings, server: ServerSettings, placement: Placement, hub: Hub
    ) -> None:
        self.id = id
        self.request = request
        self.rig = request.rig.rig()
        self.server = server
        self.created = datetime.now(UTC)
        self.spec = SceneSpec(server.engine, (server.data / "scenes" / id).resolve(), self.rig, settings)
        self.state = SceneState.AWAITING
        self.error: str | None = None
        self.progress: ProgressModel | None = None
        self.points_sha256: str | None = None
        self.frames: dict[int, FrameEntry] = {}
        self.committed: list[int] = []
        self.gaussians: int | None = None
        self.last_seconds = 1.0
        self.door = asyncio.Lock()
        self._finished = 0
        self._asked: dict[int, asyncio.Future[Answer | Refused]] = {}
        self._asks = 0
        self.spec.folder.mkdir(parents=True)
        self._worker = placement.start(worker.main, self.spec, self._from_worker, self._worker_ended)
        self._renderer = placement.start(renderer.main, self.spec, self._from_renderer, self._renderer_ended)
        self._placement = placement
        self._hub = hub

    def _tell(self, event: Event) -> None:
        """Tells who listens to the scene (`server.hub`); called at every change of its status or of a frame."""
        self._hub.publish(self.id, event)

    @property
    def next_frame(self) -> int:
        """The index that the door takes next."""
        return len(self.frames)

    @property
    def queued(self) -> int:
        """Frames acknowledged and not finished."""
        return len(self.frames) - self._finished

    def status(self) -> SceneStatus:
        """The scene as it is now."""
        return SceneStatus(
            id=self.id,
            name=self.request.name,
            state=self.state,
            error=self.error,
            progress=self.progress,
            cameras=list(self.rig.names),
            has_points=self.points_sha256 is not None,
            next_frame=self.next_frame,
            queued=self.queued,
            queue_limit=self.server.queue_frames,
            committed=len(self.committed),
            first_committed=self.committed[0] if self.committed else None,
            last_committed=self.committed[-1] if self.committed else None,
            gaussians=self.gaussians,
            created=self.created.isoformat(),
            settings=self.spec.settings.model_dump(mode="json"),
        )

    def camera(self, name: str) -> Camera:
        """A camera of the rig by name."""
        if name not in self.rig.names:
            raise Problem(
                422,
                f"the rig has no camera {name!r}",
                field="camera",
                value=name,
                remedy=f"name one of {', '.join(self.rig.names)}, or give the camera itself",
            )
        return self.rig[name]

    def committed_frame(self, index: int | None, field: str = "frame") -> int:
        """The index, or the last one for None, checked to be committed."""
        if not self.committed:
            raise Problem(
                409,
                "no frame of this scene is committed yet",
                field=field,
                remedy="wait until `committed` in the scene's status is above 0",
                state=self.state,
            )
        if index is None:
            return self.committed[-1]
        entry = self.frames.get(index)
        if entry is None or entry.report.state != FrameState.COMMITTED:
            raise Problem(
                404,
                f"frame {index} is {entry.report.state if entry else 'not here'}; only committed frames can be read",
                field=field,
                value=index,
                remedy=f"ask for a committed frame, {self.committed[0]} to {self.committed[-1]}",
            )
        return index

    # The door for frames.

    async def take_frame(
        self, index: int, images: Mapping[str, bytes], masks: Mapping[str, bytes], time: float | None
    ) -> FrameReceipt:
        """Acknowledges a frame and queues it; the caller has checked the pictures' structure.

        Raises:
            Problem: 409 for a gap, for other content under a known index and for a failed scene; 429 when the queue is
                full; 422 for a time that does not rise.
        """
        seconds = index / self.request.frames_per_second if time is None else time
        identity = await asyncio.to_thread(frame_identity, images, masks, seconds)
        async with self.door:
            if index < self.next_frame:
                return self._again(index, identity)
            self._admit(index, seconds)
            file = self.spec.folder / "frames" / f"{index:06d}.npz"
            await asyncio.to_thread(write_frame, file, images, masks)
            receipt = FrameReceipt(scene=self.id, index=index, time=seconds, identity=identity)
            report = FrameReportModel(scene=self.id, index=index, time=seconds, state=FrameState.QUEUED)
            self.frames[index] = FrameEntry(receipt, report)
            self._worker.send(FrameReady(index, seconds, file))
            self._tell(SceneChanged())
            return receipt

    def _again(self, index: int, identity: str) -> FrameReceipt:
        known = self.frames[index].receipt
        if known.identity != identity:
            raise Problem(
                409,
                f"frame {index} is known with other content or another time",
                field="n",
                value=index,
                remedy=f"send the next frame, {self.next_frame}; what was acknowledged does not change",
                expected=self.next_frame,
                identity=known.identity,
            )
        return known

    def _admit(self, index: int, seconds: float) -> None:
        if self.state == SceneState.FAILED:
            raise Problem(
                409,
                f"the scene has failed: {self.error}",
                field="id",
                value=self.id,
                remedy="delete the scene and create it anew",
                state=self.state,
            )
        if index > self.next_frame:
            raise Problem(
                409,
                f"frame {index} would leave a gap: frame t is found from frame t−1",
                field="n",
                value=index,
                remedy=f"send frame {self.next_frame} first",
                expected=self.next_frame,
            )
        if self.queued >= self.server.queue_frames:
            wait = min(60, max(1, math.ceil(self.last_seconds)))
            raise Problem(
                429,
                f"{self.queued} frames wait already",
                field="n",
                value=index,
                remedy=f"send the same frame again in {wait} s",
                headers={"Retry-After": str(wait)},
                queued=self.queued,
            )
        before = self.frames[index - 1].receipt.time if index else -math.inf
        if not (math.isfinite(seconds) and seconds > before):
            raise Problem(
                422,
                f"the time of frame {index} is not after that of frame {index - 1}",
                field="time",
                value=seconds,
                remedy=f"give seconds above {before:g}",
            )

    # Messages of the two processes.

    def _from_worker(self, message: Any) -> None:
        match message:
            case Started():
                self.frames[message.index].report.state = FrameState.UPDATING
                self.state = SceneState.UPDATING if self.committed else SceneState.INITIALISING
                self._tell(SceneChanged())
            case Progressed():
                self.progress = ProgressModel(
                    stage=message.stage, done=message.done, total=message.total, detail=message.detail
                )
                self._tell(SceneChanged())
            case Committed():
                self._commit(message)
            case SetAside():
                self._set_aside(message)

    def _commit(self, message: Committed) -> None:
        self._finished += 1
        self._renderer.send(message)
        self.committed.append(message.index)
        self.gaussians = message.gaussians
        self.last_seconds = message.seconds.get("total", self.last_seconds)
        self.progress = None
        report = self.frames[message.index].report
        report.state = FrameState.COMMITTED
        report.dropped_cameras = message.dropped
        report.iterations = message.iterations
        report.seconds = message.seconds
        report.loss = message.loss
        report.psnr = message.psnr if math.isfinite(message.psnr) else None
        report.moving = message.moving
        report.gaussians = message.gaussians
        self.error = None
        if message.dropped:
            self.error = f"frame {message.index} was committed without " + "; ".join(message.dropped.values())
        self.state = SceneState.DEGRADED if message.dropped else SceneState.READY
        self._tell(FrameFinished(report))

    def _set_aside(self, message: SetAside) -> None:
        self._finished += 1
        self.progress = None
        report = self.frames[message.index].report
        report.state = FrameState.SET_ASIDE
        report.error = message.reason
        report.dropped_cameras = message.dropped
        self.error = f"frame {message.index} was set aside: {message.reason}"
        self.state = SceneState.FAILED if message.fatal else SceneState.DEGRADED
        self._tell(FrameFinished(report))
        log.warning("scene %s: %s", self.id, self.error)

    def _worker_ended(self, reason: str) -> None:
        self.state = SceneState.FAILED
        self.error = f"the worker is gone: {reason}"
        self.progress = None
        self._tell(SceneChanged())
        log.error("scene %s: %s", self.id, self.error)

    # Questions about what is committed.

    async def ask(self, query: Query) -> Answer:
        """The reader process's answer.

        Raises:
            Problem: 422 where the query cannot be answered, 503 where it takes too long, 500 for a fault of the reader.
        """
        self._asks += 1
        number = self._asks
        future: asyncio.Future[Answer | Refused] = asyncio.get_running_loop().create_future()
        self._asked[number] = future
        self._renderer.send(Ask(number, query))
        try:
            answer = await asyncio.wait_for(future, self.server.answer_seconds)
        except TimeoutError:
            raise Problem(
                503,
                f"no answer within {self.server.answer_seconds:g} s",
                remedy="ask for less at once, or again later",
                headers={"Retry-After": "5"},
            ) from None
        finally:
            self._asked.pop(number, None)
        if isinstance(answer, Refused):
            remedy = "the log of the service says more" if answer.fault else "change what the sentence names"
            raise Problem(500 if answer.fault else 422, answer.detail, remedy=remedy)
        return answer

    def _from_renderer(self, message: Answer | Refused) -> None:
        future = self._asked.get(message.number)
        if future is not None and not future.done():
            future.set_result(message)

    def _renderer_ended(self, reason: str) -> None:
        # It holds nothing that is not on disk: what was asked fails, and a new one takes over.
        log.error("scene %s: the reader is gone: %s", self.id, reason)
        self._refuse_all(f"the reader is gone: {reason}")
        self._renderer = self._placement.start(renderer.main, self.spec, self._from_renderer, self._renderer_ended)

    def _refuse_all(self, reason: str) -> None:
        """Nobody is left to answer what was asked."""
        for number, future in self._asked.items():
            if not future.done():
                future.set_result(Refused(number, reason, fault=True))

    async def stop(self) -> None:
        """Ends both processes."""
        seconds = self.server.stop_seconds
        await asyncio.gather(self._worker.stop(seconds), self._renderer.stop(seconds))
        self._refuse_all("the scene has ended")


class Scenes:
    """All scenes of the service, by id."""

    def __init__(self, server: ServerSettings, placement: Placement, hub: Hub) -> None:
        self.server = server
        self.placement = placement
        self.hub = hub
        self.by_id: dict[str, Scene] = {}

    def create(self, request: SceneCreate, settings: Settings) -> Scene:
        """A new scene with its processes started."""
        if len(self.by_id) >= self.server.max_scenes:
            raise Problem(
                429,
                f"{len(self.by_id)} scenes run already",
                field="SCAS4D_MAX_SCENES",
                value=self.server.max_scenes,
                remedy="delete a scene, or raise the limit",
                headers={"Retry-After": "60"},
            )
        scene = Scene(secrets.token_hex(6), request, settings, self.server, self.placement, self.hub)
        self.by_id[scene.id] = scene
        return scene

    def __getitem__(self, id: str) -> Scene:
        scene = self.by_id.get(id)
        if scene is None:
            raise Problem(404, f"no scene {id!r}", field="id", value=id, remedy="GET /v1/scenes lists the scenes")
        return scene

    async def delete(self, id: str) -> None:
        """Ends the scene's processes and removes its folder."""
        scene = self[id]
        del self.by_id[id]
        self.hub.close(id, "the scene was deleted")
        await scene.stop()
        await asyncio.to_thread(shutil.rmtree, scene.spec.folder, ignore_errors=True)

    async def stop(self) -> None:
        """Ends all processes; the folders stay."""
        await asyncio.gather(*(scene.stop() for scene in self.by_id.values()))
