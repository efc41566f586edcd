"""The rig simulator: a capture on disk, sent as a rig would send it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from client.retries import Retry
from client.rig.delivery import Delivery, Lateness
from client.rig.pace import Pace
from client.rig.sender import OnMessage, Requests, Sender, Sockets
from client.rig.sequence import Sequence
from client.sdk import Client
from client.wire import IngestSettings, SceneStatus
from scas4d_core.captures import Capture

OnProgress = Callable[[str, int, int], None]
"""(stage, done, total)."""


def push(
    source: Capture,
    client: Client,
    *,
    scene: str | None = None,
    name: str | None = None,
    pace: Pace | None = None,
    frames: int | None = None,
    start: int = 0,
    loop: bool = False,
    per_camera: bool = False,
    websocket: bool = False,
    preset: str = "scas4d",
    settings: Mapping[str, Any] | None = None,
    ingest: IngestSettings | None = None,
    nodes: Mapping[str, str] | None = None,
    on_progress: OnProgress | None = None,
    on_message: OnMessage | None = None,
) -> Delivery:
    """Creates a scene, sends its cloud and every frame in order and in time, and waits until the last is finished.

    The clock of a rig starts when frame 0 is finished. A restart of the service is waited out for as long as the
    client waits for an outage, and what it says comes next is sent next.

    Args:
        source: its training cameras are sent, at the size of the files. The service scales, if `settings` say so.
        client: of the service.
        scene: id of a scene to go on with, from its next frame; a new one where None.
        name: of a new scene; that of the source where None.
        pace: of the rig; as fast as the service takes them where None. The times of the frames are those of the capture
            either way.
        frames: how many the scene shall have; all where None, or without end with `loop`.
        start: the frame of the capture that is frame 0 of the scene.
        loop: go back and forth through the capture until `frames`, or until it is interrupted.
        per_camera: every camera sends its own pictures, over a connection of its own.
        websocket: send over a WebSocket (one for each camera with `per_camera`) instead of requests.
        preset: named settings.
        settings: what differs from the preset, nested.
        ingest: how the scene takes frames.
        nodes: labels that a node of the cluster must have for a new scene.
        on_progress: hears of progress: the stages of frame 0, then "frames" with the number finished.
        on_message: hears sentences: outages, frames that were lost, where it goes on.

    Raises:
        ServiceError, ServiceUnreachable: as by the client.
        RuntimeError: the scene failed, or has other cameras than the capture.

    >>> from client.importers.open_source import open_source
    >>> delivery = push(open_source(folder), client, frames=2)
    >>> delivery.status.committed
    2
    >>> client.delete_scene(delivery.scene)
    """
    on_progress = on_progress or (lambda stage, done, total: None)
    on_message = on_message or (lambda sentence: None)
    sequence = Sequence(source, start=start, loop=loop)
    with ExitStack() as stack:
        stack.callback(sequence.close)
        count = min(frames or len(sequence), len(sequence))
        if scene is None:
            status = client.create_scene(
                source.full_rig,
                name=source.name if name is None else name,
                preset=preset,
                settings=settings,
                frames_per_second=source.fps,
                ingest=ingest,
                nodes=nodes,
            )
            if source.points is not None and start == 0:
                client.put_points(status.id, source.points)
        else:
            status = client.scene(scene)
            _check_cameras(status, source)
            on_message(f"scene {scene} goes on with frame {status.next_frame}")
        delivery = Delivery(status.id)
        way = Sockets(client, status.id) if websocket else Requests(client, status.id)
        stack.callback(way.close)
        sender = Sender(client, way, sequence, pace or Pace(), delivery, on_message, per_camera)
        stack.callback(sender.close)
        stack.enter_context(_record_retries(client, delivery.lateness, on_message))
        try:
            for index in sender.send_all(status.next_frame, count):
                if index == 0:
                    _follow(client, status.id, 0, count, on_progress)
                    sender.start_clock()
                else:
                    on_progress("frames", _finished(client.scene(status.id)), count)
            delivery.lateness.ended = time.monotonic()
            # A frame that was lost is finished at once, those before it are not.
            last = next((index for index in reversed(range(count)) if index not in delivery.lost), 0)
            _follow(client, status.id, last, count, on_progress)
        except KeyboardInterrupt:  # how a loop without end is ended
            on_message("interrupted")
            delivery.lateness.ended = delivery.lateness.ended or time.monotonic()
        delivery.status = client.scene(status.id)
        on_progress("frames", _finished(delivery.status), count)
    return delivery


class _record_retries:
    """Counts what the client waits for, and says when an outage begins."""

    def __init__(self, client: Client, lateness: Lateness, on_message: OnMessage) -> None:
        self._client = client
        self._lateness = lateness
        self._on_message = on_message
        self._before = client.on_retry
        self._out = False
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._client.on_retry = self._hear

    def __exit__(self, *_: object) -> None:
        self._client.on_retry = self._before

    def _hear(self, retry: Retry) -> None:
        with self._lock:  # cameras of their own wait at the same time
            if retry.reason == "busy":
                self._lateness.busy += retry.seconds
                self._lateness.busy_count += 1
            else:
                self._lateness.outage += retry.seconds
                self._lateness.outage_count += 1
                if not self._out:
                    self._on_message(f"the service cannot be used ({retry.detail}); trying on")
            self._out = retry.reason == "outage"
        if self._before is not None:
            self._before(retry)


def _check_cameras(status: SceneStatus, source: Capture) -> None:
    if set(status.cameras) != set(source.full_rig.names):
        raise RuntimeError(
            f"scene {status.id} has the cameras {', '.join(status.cameras)}, {source.name} has "
            f"{', '.join(source.full_rig.names)}; continue with the capture that the scene started with"
        )


def _follow(client: Client, id: str, index: int, count: int, on_progress: OnProgress) -> None:
    """Reports progress until a frame is finished."""
    for status in client.watch(id, index):
        if status.state == "failed":
            raise RuntimeError(f"scene {id} failed: {status.error}")
        if status.progress is not None:
            on_progress(status.progress.stage, status.progress.done, status.progress.total)
        elif index == 0 and not _finished(status):
            waits = f"starting the scene: {status.error}" if status.error else "starting the scene"
            on_progress(waits, 0, 1)
        else:
            on_progress("frames", _finished(status), count)


def _finished(status: SceneStatus) -> int:
    """Frames of which nothing more will happen."""
    return status.next_frame - status.queued
