"""What a live frame costs a viewer in a browser: bytes, and the time from its commit to its picture.

A service commits recorded states at a fixed rate. The page draws them in a headless Chromium on the same machine, so
that one clock serves for both ends.
"""

from __future__ import annotations

import io
import json
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from client.stream import FrameMessage, Stream, finished_frames
from client.wire import FrameState
from client.wire.stream import unpack
from scas4d_core.cameras import Rig
from scas4d_core.compact import CompactReader
from studies.live.main_thread import main_thread_clock
from studies.machine import browser_path, in_words, machine
from studies.running.process import Service, StudyError

CAMERAS = 4
"""Number of cameras; their images are black, because the states are given."""
SIZE = (1280, 800)
PATIENCE_MS = 60_000
WATCH = """() => {
  const now = () => performance.timeOrigin + performance.now();
  window.whole = {};
  window.first = {};
  window.stages = [];
  const [view, latency] = ['view', 'latency'].map((id) => document.getElementById(id));
  const whole = () => { window.whole[view.dataset.frame] ??= now(); };
  new MutationObserver(whole).observe(view, { attributes: true, attributeFilter: ['data-frame'] });
  window.pictures = 0;
  new MutationObserver(() => window.pictures++).observe(view, { attributes: true, attributeFilter: ['data-size'] });
  if (!latency) return;
  const first = () => {
    const [, frame, sent, drawn] = latency.textContent.match(/^Frame (\\d+).* sent (\\d+), drawn (\\d+)$/) ?? [];
    if (frame) window.first[frame] ??= now(), window.stages.push([Number(sent), Number(drawn)]);
  };
  new MutationObserver(first).observe(latency, { childList: true, characterData: true });
}"""


@dataclass(frozen=True)
class ViewerResult:
    """Result of a viewer study.

    Attributes:
        size: bytes that the page received for the states of each frame after the first.
        first_ms: milliseconds from each commit to the first picture of the frame's motion, ascending.
        whole_ms: milliseconds from each commit to the first picture that shows the frame itself, ascending.
        stages_ms: [frames, 2] milliseconds from commit to sending, and from arrival to the first picture.
        frames: number of frames that were committed.
        main_thread_ms: milliseconds of the page's main thread per picture.
    """

    size: float
    first_ms: list[float]
    whole_ms: list[float]
    stages_ms: list[tuple[float, float]]
    frames: int
    main_thread_ms: float


def measure(service: Service, folder: Path, frames: int, fps: float) -> ViewerResult:
    """Measures a new scene on a running service; see `ViewerResult`.

    Args:
        service: service whose workers commit the states of `folder`.
        folder: output folder of `scas4d reconstruct`.
        frames: number of frames.
        fps: frames per second.
    """
    from playwright.sync_api import sync_playwright

    with CompactReader(folder / "states.s4d") as reader:
        rig = reader.head.rig
    if rig is None:
        raise StudyError(f"{folder / 'states.s4d'} has no cameras")
    rig = Rig(rig.cameras[:CAMERAS])
    scene = service.create(rig, {}, frames_per_second=fps)
    images = {camera.name: _black(camera.width, camera.height) for camera in rig.cameras}
    base, commits = str(service.http.base_url).rstrip("/"), dict[int, float]()

    def listen() -> None:
        with Stream(base, scene) as stream:
            stream.subscribe("frames", finished_frames())
            for event in stream:
                if isinstance(event, FrameMessage) and event.report.state == FrameState.COMMITTED:
                    commits.setdefault(event.report.index, time.time())

    threading.Thread(target=listen, daemon=True).start()
    service.put(scene, 0, images, {})
    service.finish(scene, 1)
    received: list[int] = []
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=browser_path(), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(PATIENCE_MS)
        page.on("websocket", lambda socket: socket.on("framereceived", lambda data: _count(data, received)))
        page.on("requestfinished", lambda request: _fetched(request, received))
        page.goto(f"{base}/#scene={scene}")
        page.select_option("#who", "here")
        page.wait_for_function("() => document.getElementById('view').dataset.drawn === 'here'")
        page.evaluate(WATCH)
        received.clear()
        clock = main_thread_clock(page)
        busy, drawn, began = clock(), page.evaluate("window.pictures"), time.monotonic()
        for index in range(1, frames + 1):
            page.wait_for_timeout(max(0.0, 1e3 * (began + index / fps - time.monotonic())))
            service.put(scene, index, images, {})
        page.wait_for_function(f"() => document.getElementById('view').dataset.frame === '{frames}'")
        first, whole, stages, pictures = page.evaluate("[window.first, window.whole, window.stages, window.pictures]")
        spent = (clock() - busy) / max(1, pictures - drawn)
        browser.close()
    service.http.delete(f"/v1/scenes/{scene}")
    return ViewerResult(sum(received) / frames, _delays(first, commits), _delays(whole, commits), stages, frames, spent)


def _black(width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, "JPEG")
    return file.getvalue()


def _count(data: str | bytes, received: list[int]) -> None:
    if isinstance(data, bytes) and json.loads(data[8 : 8 + int.from_bytes(data[4:8], "little")])["type"] == "states":
        received.append(len(unpack(data)[1]))


def _fetched(request: Any, received: list[int]) -> None:
    if "states.s4d" in request.url:
        received.append(request.sizes()["responseBodySize"])


def _delays(drawn: dict[str, float], commits: dict[int, float]) -> list[float]:
    return sorted(
        at - 1e3 * commits[int(index)] for index, at in drawn.items() if index != "0" and int(index) in commits
    )


def run(folder: Path, frames: int, fps: float, work: Path) -> ViewerResult:
    """Starts a service that commits the states of a folder in an emptied folder, and measures it; see `measure`."""
    shutil.rmtree(work, ignore_errors=True)
    (work / "data").mkdir(parents=True)
    states = str((folder / "states").resolve())
    service = Service(work / "data", program=("-m", "studies.live.serve", "--states", states))
    service.start()
    try:
        return measure(service, folder, frames, fps)
    finally:
        service.stop()


def report(result: ViewerResult, fps: float) -> str:
    """Returns the result as a Markdown table."""

    def quantiles(delays: list[float]) -> str:
        if not delays:
            return "–"
        return f"{np.quantile(delays, 0.5):.0f} / {np.quantile(delays, 0.95):.0f} ms ({len(delays)} frames)"

    stages = " / ".join(f"{value:.0f} ms" for value in np.median(result.stages_ms, axis=0)) if result.stages_ms else "–"
    return "\n".join(
        [
            f"{result.frames} frames at {fps:g} per second, drawn by the browser ({in_words(machine())}):",
            "",
            "| figure | value |",
            "|---|---|",
            f"| bytes received per frame | {result.size / 1e3:.1f} kB |",
            f"| commit to the first picture with the frame's motion, p50 / p95 | {quantiles(result.first_ms)} |",
            f"| of which commit to sending, arrival to picture, p50 | {stages} |",
            f"| main thread per picture | {result.main_thread_ms:.1f} ms |",
            f"| commit to the first picture of the frame itself, p50 / p95 | {quantiles(result.whole_ms)} |",
        ]
    )
