"""Rate and latency of a live scene with the null engine, over HTTP from another process.

The rate is that of commits while the queue is never empty. The latency runs from the last byte of a frame to the event
that announces its commit, and is measured with an empty queue.
"""

from __future__ import annotations

import io
import shutil
import statistics
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from client.rig.sequence import ping_pong
from client.stream import FrameMessage, Stream, finished_frames
from client.wire import FrameState
from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture
from studies.machine import in_words, machine
from studies.running.process import Service, StudyError

JPEG_QUALITY = 90
NOISE = 1.5
"""Standard deviation of the sensor noise, in levels of 255."""
DIFFERENT_FRAMES = 8
"""Number of different frames, which are played back and forth."""
SETTINGS = {"static": {"iterations": 2000}, "update": {"skip_tolerance": -1}}
"""Settings of the scene: a short fit of frame 0, and no skipped updates, because the scene is still."""
SHORTEST_WAIT_S = 0.005
"""Minimum time between two attempts to send a frame. A sender that asks more often takes time from the service."""
FIRST = 2
"""Number of frames before the measurement: the first frame and the first update, which are slower."""


@dataclass(frozen=True)
class LiveResult:
    """Result of a live run.

    Attributes:
        rate: committed frames per second.
        latency_ms: milliseconds from the last byte to the commit event, per frame, ascending.
        stages_ms: mean milliseconds of each stage of an update.
    """

    rate: float
    latency_ms: list[float]
    stages_ms: dict[str, float]

    def quantile(self, share: float) -> float:
        """Returns a quantile of the latency in milliseconds."""
        return float(np.quantile(self.latency_ms, share))


def noisy_frames(capture: Capture, rig: Rig, count: int, seed: int = 0) -> list[dict[str, bytes]]:
    """Returns `count` frames as JPEG files, keyed by camera: the first frame of a capture with sensor noise.

    The null engine cannot follow motion. A still scene looks to the other stages like a scene that was followed.
    """
    rng = np.random.default_rng(seed)
    images = {}
    for camera in rig.cameras:
        with Image.open(io.BytesIO(capture.encoded_image(0, camera.name))) as picture:
            images[camera.name] = np.asarray(picture.convert("RGB").resize((camera.width, camera.height)), np.float32)
    return [
        {name: _jpeg(image + rng.normal(0, NOISE, image.shape)) for name, image in images.items()} for _ in range(count)
    ]


def _jpeg(levels: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8)).save(file, "JPEG", quality=JPEG_QUALITY)
    return file.getvalue()


def measure(
    service: Service,
    rig: Rig,
    capture: Capture,
    frames: Sequence[Mapping[str, bytes]],
    settings: Mapping[str, Any],
    count: int,
) -> LiveResult:
    """Measures a running service on a new scene.

    Args:
        service: the service.
        rig: cameras of the scene.
        capture: capture that provides the initial points.
        frames: encoded images, played back and forth.
        settings: scene settings.
        count: number of frames for each of the two measurements.
    """
    scene = service.create(rig, settings, ingest={"queue_frames": 8, "keep_frames": {"last": 50}})
    if capture.points is not None:
        service.put_points(scene, capture.points)
    commits: dict[int, float] = {}
    base = str(service.http.base_url)

    def listen() -> None:
        with Stream(base, scene) as stream:
            stream.subscribe("frames", finished_frames())
            for event in stream:
                if isinstance(event, FrameMessage) and event.report.state == FrameState.COMMITTED:
                    commits[event.report.index] = time.monotonic()

    threading.Thread(target=listen, daemon=True).start()
    for index in range(FIRST):
        _put(service, scene, index, frames)
        service.finish(scene, index + 1)
    last = FIRST + count
    for index in range(FIRST, last):
        _put(service, scene, index, frames)
    service.finish(scene, last, every=0.5)
    times = [commits[index] for index in range(FIRST, last) if index in commits]
    if len(times) < count:
        raise StudyError(f"{count - len(times)} commits were not announced")
    reports = [service.frame(scene, index) for index in range(FIRST, last)]
    stages = {
        name: 1e3 * statistics.fmean(report.seconds.get(name, 0.0) for report in reports)
        for name in reports[-1].seconds
    }
    latency = []
    for index in range(last, last + count):
        _put(service, scene, index, frames)
        sent = time.monotonic()
        while index not in commits:
            time.sleep(0.0005)
        latency.append(1e3 * (commits[index] - sent))
    service.http.delete(f"/v1/scenes/{scene}")
    return LiveResult((count - 1) / (times[-1] - times[0]), sorted(latency), stages)


def _put(service: Service, scene: str, index: int, frames: Sequence[Mapping[str, bytes]]) -> None:
    while True:
        answer = service.put(scene, index, frames[ping_pong(index, len(frames))], {})
        if answer.is_success:
            return
        if answer.status_code != 429:
            raise StudyError(answer.text)
        time.sleep(max(SHORTEST_WAIT_S, answer.json()["retry_after_seconds"]))


def run(capture: Capture, rig: Rig, count: int, work: Path) -> LiveResult:
    """Starts a service with the null engine in an emptied folder and measures it; see `measure`."""
    shutil.rmtree(work, ignore_errors=True)
    (work / "data").mkdir(parents=True)
    service = Service(work / "data", program=("-m", "studies.live.serve"))
    service.start()
    try:
        return measure(service, rig, capture, noisy_frames(capture, rig, DIFFERENT_FRAMES), SETTINGS, count)
    finally:
        service.stop()


def report(rig: Rig, result: LiveResult) -> str:
    """Returns the result as a Markdown table."""
    camera = rig.cameras[0]
    stages = ", ".join(f"{name} {value:.0f}" for name, value in result.stages_ms.items())
    return "\n".join(
        [
            f"Null engine, {len(rig)} cameras of {camera.width}×{camera.height} as JPEG, over HTTP "
            f"({in_words(machine())}):",
            "",
            "| figure | value |",
            "|---|---|",
            f"| committed frames per second, queue never empty | {result.rate:.1f} |",
            f"| last byte to commit event, queue empty, p50 / p95 | {result.quantile(0.5):.0f} / "
            f"{result.quantile(0.95):.0f} ms |",
            f"| mean time of each stage, in ms | {stages} |",
        ]
    )
