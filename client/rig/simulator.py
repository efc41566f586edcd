"""The rig simulator: a capture on disk, sent as a rig would send it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from client.sdk import Client
from client.wire import SceneStatus
from scas4d_core.captures import Capture

Told = Callable[[str, int, int], None]
"""(stage, done, total)."""


def push(
    capture: Capture,
    client: Client,
    *,
    fps: float | None = None,
    frames: int | None = None,
    preset: str = "scas4d",
    settings: Mapping[str, Any] | None = None,
    told: Told | None = None,
) -> SceneStatus:
    """Creates a scene, sends its cloud and every frame in order, and waits until the last is finished.

    Args:
        capture: opened with image_scale 1; the files go as they are. The service scales, if `settings` say so.
        client: of the service.
        fps: frames a second to send at most; None sends as fast as the service takes them. The times of the frames are
            those of the capture either way.
        frames: how many to send; all where None.
        preset: named settings.
        settings: what differs from the preset, nested.
        told: hears of progress: the stages of frame 0, then "frames" with the number finished.

    Returns:
        The scene's status after the last frame.

    Raises:
        ServiceError: the service refused.
        RuntimeError: the scene failed.
    """
    told = told or (lambda stage, done, total: None)
    count = min(frames or capture.frame_count, capture.frame_count)
    scene = client.create_scene(
        capture.full_rig, name=capture.name, preset=preset, settings=settings, frames_per_second=capture.fps
    )
    if capture.points is not None:
        client.put_points(scene.id, capture.points)
    began = time.monotonic()
    for index in range(count):
        if fps:
            time.sleep(max(0.0, began + index / fps - time.monotonic()))
        images = {name: capture.encoded(index, name) for name in capture.full_rig.names}
        found = {name: capture.encoded_mask(index, name) for name in capture.full_rig.names}
        masks = {name: mask for name, mask in found.items() if mask is not None}
        # The service takes masks of all cameras or of none.
        masks = masks if len(masks) == len(images) else {}
        client.put_frame(scene.id, index, images, masks, time=index / capture.fps)
        if index == 0:
            _follow(client, scene.id, 0, count, told)
        else:
            told("frames", _finished(client.scene(scene.id)), count)
    _follow(client, scene.id, count - 1, count, told)
    return client.scene(scene.id)


def _follow(client: Client, id: str, index: int, count: int, told: Told) -> None:
    """Tells of progress until a frame is finished."""
    for status in client.watch(id, index):
        if status.state == "failed":
            raise RuntimeError(f"scene {id} failed: {status.error}")
        if status.progress is not None:
            told(status.progress.stage, status.progress.done, status.progress.total)
        elif status.state in ("awaiting_first_frame", "initialising"):
            told("starting, compiling kernels", 0, 1)
        else:
            told("frames", _finished(status), count)


def _finished(status: SceneStatus) -> int:
    """Frames committed or set aside."""
    return status.next_frame - status.queued
