"""Memory of the service and a scene's worker over thousands of frames, sent as fast as the null engine takes them.

A take of this length is kept: its states are moved to compact files, and only images are deleted. Memory that grows
with the number of frames therefore shows up as a difference between the first and the last tenth of the run.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from client.rig.sequence import ping_pong
from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture
from studies.live.live import DIFFERENT_FRAMES, FIRST, noisy_frames
from studies.machine import in_words, machine
from studies.running.process import Service, StudyError

SETTINGS = {"static": {"iterations": 500, "max_gaussians": 2000}, "update": {"skip_tolerance": -1}}
"""Settings of the scene: a short fit of frame 0, and no skipped updates, because the scene is still."""
RULES = {"queue_frames": 16, "keep_frames": {"last": 50}}
"""Ingest rules of the scene. All states are kept."""
TARGET = 1.02
"""Target: largest ratio of the median memory in the last tenth to that in the first tenth."""
NAMES = ("service", "worker", "memory", "own")
"""Attributes of a row that the table contains."""
AGAIN_S = 0.005
"""Delay in seconds before a frame that was refused because the queue is full is sent again."""


@dataclass(frozen=True)
class Row:
    """Memory at one moment.

    Attributes:
        frame: number of committed frames.
        seconds: time since the first row.
        service: resident memory of the service in MB.
        worker: resident memory of the scene's worker in MB.
        service_own: part of `service` that is not backed by files, in MB.
        worker_own: part of `worker` that is not backed by files, in MB.
        data: size of the data folder in MB.
    """

    frame: int
    seconds: float
    service: float
    worker: float
    service_own: float
    worker_own: float
    data: float

    @property
    def memory(self) -> float:
        """Resident memory of service and worker in MB."""
        return self.service + self.worker

    @property
    def own(self) -> float:
        """Part of `memory` that is not backed by files, in MB."""
        return self.service_own + self.worker_own


def run(
    capture: Capture, rig: Rig, count: int, work: Path, every: int = 100, echo: Callable[[Row], None] = lambda row: None
) -> list[Row]:
    """Sends frames to a service with the null engine in an emptied folder, and returns the rows.

    Each row is also appended to ``rows.jsonl`` in the folder.

    Args:
        capture: capture that provides the images and initial points.
        rig: cameras of the scene.
        count: number of frames.
        work: folder for the data folder, rows and log; its contents are deleted.
        every: number of frames per row.
        echo: callback that receives each new row.
    """
    shutil.rmtree(work, ignore_errors=True)
    (work / "data").mkdir(parents=True)
    service = Service(work / "data", program=("-m", "studies.live.serve"))
    service.start()
    try:
        frames = noisy_frames(capture, rig, DIFFERENT_FRAMES)
        scene = service.create(rig, SETTINGS, ingest=RULES)
        if capture.points is not None:
            service.put_points(scene, capture.points)
        rows: list[Row] = []
        began = 0.0
        for index in range(count):
            while not (answer := service.put(scene, index, frames[ping_pong(index, len(frames))], {})).is_success:
                if answer.status_code != 429:
                    raise StudyError(answer.text)
                time.sleep(AGAIN_S)
            if index < FIRST or index == count - 1:
                service.finish(scene, index + 1)
                began = began or time.monotonic()
            if index >= FIRST and (index % every == 0 or index == count - 1):
                worker = service.worker_pid(scene)
                if worker is None:
                    raise StudyError("the worker is not running")
                (service_mb, service_own), (worker_mb, worker_own) = memory_mb(service.pid), memory_mb(worker)
                row = Row(
                    service.status(scene).committed,
                    time.monotonic() - began,
                    service_mb,
                    worker_mb,
                    service_own,
                    worker_own,
                    _size(service.data) / 1e6,
                )
                with (work / "rows.jsonl").open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
                rows.append(row)
                echo(row)
        status = service.status(scene)
        if status.committed != count:
            raise StudyError(f"{status.committed} of {count} frames are committed")
        return rows
    finally:
        service.stop()


def _size(folder: Path) -> int:
    """Returns the size of all files in a folder in bytes, without those deleted in the meantime."""
    size = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            size += path.stat().st_size
    return size


def memory_mb(pid: int) -> tuple[float, float]:
    """Returns the resident memory of a process, and the part of it that is not backed by files, in 10⁶ bytes."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    values = {name: int(value.split()[0]) for name, _, value in (line.partition(":") for line in lines[1:])}
    return values["Rss"] * 1024 / 1e6, values["Anonymous"] * 1024 / 1e6


def growth(rows: Sequence[Row], name: str = "memory") -> float:
    """Returns the ratio of the median memory in the last tenth of the rows to that in the first tenth."""
    tenth = max(1, len(rows) // 10)
    first, last = (statistics.median(getattr(row, name) for row in part) for part in (rows[:tenth], rows[-tenth:]))
    return float(last / first)


def report(rig: Rig, rows: Sequence[Row]) -> str:
    """Returns the result as a Markdown table."""
    camera, last = rig.cameras[0], rows[-1]
    tenth = max(1, len(rows) // 10)
    lines = [
        f"Null engine, {len(rig)} cameras of {camera.width}×{camera.height} as JPEG, {last.frame} frames at "
        f"{(last.frame - FIRST) / last.seconds:.1f} per second, {last.data:.0f} MB on disk ({in_words(machine())}):",
        "",
        "| frames | service, MB | worker, MB | together, MB | not backed by files, MB |",
        "|---|---|---|---|---|",
    ]
    for start in range(0, len(rows), tenth):
        part = rows[start : start + tenth]
        middle = [statistics.median(getattr(row, name) for row in part) for name in NAMES]
        lines.append(f"| {part[0].frame} to {part[-1].frame} | {' | '.join(f'{value:.1f}' for value in middle)} |")
    lines += [
        "",
        f"Last tenth over first tenth: {growth(rows):.3f} (target: at most {TARGET}); not backed by files: "
        f"{growth(rows, 'own'):.3f}.",
    ]
    return "\n".join(lines)
