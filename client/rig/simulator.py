"""Simulation of a live camera rig, which sends a capture from disk to the service."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from client.errors import ServiceError, ServiceUnreachable
from client.left_out import LeftOut
from client.retries import Retry
from client.rig.delivery import Delivery, Lateness
from client.rig.pace import Pace
from client.rig.sender import OnMessage, Requests, Sender, Sockets
from client.rig.sequence import Sequence
from client.sdk import Client
from client.wire import IngestSettings, SceneStatus
from client.wire.base import MAX_NAME, escaped
from scas4d_core.captures import Capture

PROGRESS_S = 0.2
"""Minimum interval in seconds between two requests for the progress while frames are sent."""

OnProgress = Callable[[str, int, int], None]
"""Progress callback, called with (stage, done, total)."""


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
    batch: int = 1,
    preset: str = "scas4d",
    settings: Mapping[str, Any] | None = None,
    ingest: IngestSettings | None = None,
    nodes: Mapping[str, str] | None = None,
    on_progress: OnProgress | None = None,
    on_message: OnMessage | None = None,
) -> Delivery:
    """Creates a scene, sends its point cloud and all frames at the given pace, and waits until the last is finished.

    Cameras whose image cannot be used are left out, and so are frames with fewer usable images than the scene requires.
    A scene that was created here is deleted if an error occurs before its first frame is accepted.

    The rig's clock starts when the first frame is finished. Service restarts are tolerated within the client's outage
    timeout. Sending then continues with the frame that the service expects.

    Args:
        source: capture whose training cameras are sent, at the resolution of the files. The service scales the images
            if `settings` requests it.
        client: client that sends the requests.
        scene: id of an existing scene to continue from its next frame; None to create a new scene.
        name: name for a new scene; None for the name of the source.
        pace: pace of the rig; None to send as fast as the service accepts frames. Timestamps always come from the
            capture.
        frames: total number of frames in the scene; None for all frames, or for no limit with `loop`.
        start: capture index of the scene's frame 0.
        loop: whether to run back and forth through the capture until `frames` is reached or the push is interrupted.
        per_camera: whether each camera sends its own images over its own connection.
        websocket: whether to use a WebSocket (one per camera with `per_camera`) instead of HTTP requests.
        batch: maximum number of frames per request; each frame is captured at its time, then all are sent. Not with
            `per_camera`.
        preset: settings preset name.
        settings: nested settings that override the preset.
        ingest: rules for accepting frames in a new scene; None for the defaults.
        nodes: labels that a cluster node must have in order to run a new scene.
        on_progress: receives the stages of frame 0, then "frames" with the number of finished frames.
        on_message: receives messages about outages, lost frames and the frame at which sending continues.

    Returns:
        The id and status of the scene, the delays and the lost frames.

    Raises:
        ValueError: `batch` is invalid.
        CaptureError: no frame of the capture has enough usable images.
        ServiceError, ServiceUnreachable: a request failed.
        RuntimeError: the scene failed, or its cameras differ from the capture's.

    >>> from client.importers.open_source import open_source
    >>> delivery = push(open_source(folder), client, frames=2)
    >>> delivery.status.committed
    2
    >>> client.delete_scene(delivery.scene)
    """
    if batch < 1 or (batch > 1 and per_camera):
        raise ValueError(f"batch must be at least 1, and 1 with per_camera; got {batch}")
    on_progress = on_progress or (lambda stage, done, total: None)
    on_message = on_message or (lambda sentence: None)
    sequence = Sequence(source, start=start, loop=loop)
    with ExitStack() as stack:
        stack.callback(sequence.close)
        count = min(frames or len(sequence), len(sequence))
        if scene is None:
            left_out = LeftOut(source.full_rig, None if ingest is None else ingest.minimum_cameras)
            sequence.first_usable(left_out)  # before the scene is created
            status = client.create_scene(
                source.full_rig,
                name=escaped(source.name)[:MAX_NAME] if name is None else name,
                preset=preset,
                settings=settings,
                frames_per_second=source.fps,
                ingest=ingest,
                nodes=nodes,
            )
            stack.enter_context(_delete_if_empty(client, status.id, on_message))
            if source.points is not None and start == 0:
                client.put_points(status.id, source.points)
        else:
            status = client.scene(scene)
            _check_cameras(status, source)
            left_out = LeftOut(source.full_rig, status.ingest.minimum_cameras)
            on_message(f"scene {scene} continues with frame {status.next_frame}")
        delivery = Delivery(status.id, left_out)
        way = Sockets(client, status.id) if websocket else Requests(client, status.id)
        stack.callback(way.close)
        sender = Sender(client, way, sequence, pace or Pace(), delivery, on_message, per_camera, batch)
        stack.callback(sender.close)
        stack.enter_context(_record_retries(client, delivery.lateness, on_message))
        is_first = status.next_frame == 0
        asked = -math.inf
        try:
            for index in sender.send_all(status.next_frame, count):
                if is_first and index not in delivery.lost:
                    is_first = False
                    _follow(client, status.id, index, count, on_progress)
                    sender.start_clock()
                elif time.monotonic() >= asked + PROGRESS_S:
                    asked = time.monotonic()
                    on_progress("frames", _finished(client.scene(status.id)), count)
            delivery.lateness.ended = time.monotonic()
            # Lost frames count as finished immediately, so wait for the last frame that was sent.
            last = next((index for index in reversed(range(count)) if index not in delivery.lost), 0)
            _follow(client, status.id, last, count, on_progress)
        except KeyboardInterrupt:  # how users stop an endless loop
            if is_first and scene is None:
                raise
            on_message("interrupted")
            delivery.lateness.ended = delivery.lateness.ended or time.monotonic()
        delivery.status = client.scene(status.id)
        on_progress("frames", _finished(delivery.status), count)
    return delivery


@contextmanager
def _record_retries(client: Client, lateness: Lateness, on_message: OnMessage) -> Iterator[None]:
    """Context manager that records the client's waiting times and reports the start of an outage."""
    before, lock, is_out = client.on_retry, threading.Lock(), False

    def on_retry(retry: Retry) -> None:
        nonlocal is_out
        with lock:  # the threads of several cameras may wait at the same time
            if retry.reason == "busy":
                lateness.busy += retry.seconds
                lateness.busy_count += 1
            else:
                lateness.outage += retry.seconds
                lateness.outage_count += 1
                if not is_out:
                    on_message(f"the service is unavailable ({retry.detail}); retrying")
            is_out = retry.reason == "outage"
        if before is not None:
            before(retry)

    client.on_retry = on_retry
    try:
        yield
    finally:
        client.on_retry = before


@contextmanager
def _delete_if_empty(client: Client, scene: str, on_message: OnMessage) -> Iterator[None]:
    """Context manager that deletes a new scene after an error if no frame of it has been accepted."""
    try:
        yield
    except BaseException as error:
        checked = False
        if not isinstance(error, ServiceUnreachable):  # which has been retried long enough
            with suppress(ServiceError, ServiceUnreachable):
                status = client.scene(scene)
                if status.next_frame == status.missing:
                    client.delete_scene(scene)
                checked = True
        if not checked:
            on_message(f"scene {scene} may be empty; if so: scas4d scenes delete {scene}")
        raise


def _check_cameras(status: SceneStatus, source: Capture) -> None:
    if set(status.cameras) != set(source.full_rig.names):
        raise RuntimeError(
            f"scene {status.id} has the cameras {', '.join(status.cameras)}, but {source.name} has "
            f"{', '.join(source.full_rig.names)}; continue with the capture that the scene started with"
        )


def _follow(client: Client, id: str, index: int, count: int, on_progress: OnProgress) -> None:
    """Reports progress until a frame is finished."""
    for status in client.watch(id, index):
        if status.state == "failed":
            raise RuntimeError(f"scene {id} failed: {status.error}")
        if status.progress is not None:
            on_progress(status.progress.stage, status.progress.done, status.progress.total)
        elif status.queued and not status.committed:
            waits = f"starting the scene: {status.error}" if status.error else "starting the scene"
            on_progress(waits, 0, 1)
        else:
            on_progress("frames", _finished(status), count)


def _finished(status: SceneStatus) -> int:
    """Returns the number of frames that need no further processing."""
    return status.next_frame - status.queued
