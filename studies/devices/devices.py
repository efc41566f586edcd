"""Updates the same frames on both devices, from the same states, and compares images and tracks.

Without a GPU, the GPU kernels run on the CPU device of NVIDIA Warp.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from client.cli.scores import Column, Row, markdown
from scas4d_core.captures import Capture
from scas4d_core.engines.choose import WARP_DEVICE, Device, gpu_fault, warp_device
from scas4d_core.metrics.evaluation import measure_pictures, measure_tracks
from scas4d_core.presets import preset
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from studies.captures import open_measured
from studies.quality.first_frame import continued

DEVICES: tuple[Device, ...] = ("cpu", "gpu")


@dataclass(frozen=True)
class DeviceRow:
    """Comparison of the two devices on one frame.

    Attributes:
        capture: capture name.
        index: frame index.
        psnr: mean PSNR on the test cameras in dB, keyed by device.
        distance: median distance between the positions of the same moving Gaussian on both devices, divided by the
            extent of the scene.
        tracks: median track error up to this frame, in percent of the extent, keyed by device; empty without ground
            truth.
    """

    capture: str
    index: int
    psnr: dict[Device, float]
    distance: float
    tracks: dict[Device, float]

    @property
    def difference(self) -> float:
        """PSNR on the GPU minus PSNR on the CPU, in dB."""
        return self.psnr["gpu"] - self.psnr["cpu"]


def use_cpu_without_gpu() -> str:
    """Maps device "gpu" to Warp's CPU device if there is no GPU, and returns a description of the device in use.

    Raises:
        SystemExit: NVIDIA Warp is not installed.
    """
    if warp_device() != "cpu" and gpu_fault() is None:
        return "a GPU"
    os.environ[WARP_DEVICE] = "cpu"
    if (fault := gpu_fault()) is not None:
        raise SystemExit(f"scripts/bench devices: {fault}; run in the checkout: scripts/setup dev")
    return "the CPU device of NVIDIA Warp"


def compare(
    folder: Path, scale: float = 0.25, frames: int = 5, iterations: int = 10, static: int = 600, apart: bool = False
) -> list[DeviceRow]:
    """Updates a capture on both devices and returns a row for each updated frame.

    Every update starts from the state that the CPU has committed, so that the row shows the difference that one update
    causes. Otherwise, rounding differences grow from frame to frame, because each update continues the last motion.

    Args:
        folder: capture folder.
        scale: image scale.
        frames: number of updates.
        iterations: iterations per update.
        static: iterations of frame 0, which is fitted on the CPU.
        apart: whether each device continues from its own states instead.
    """
    capture = open_measured(folder, image_scale=scale)
    changes = {
        "static": {"iterations": static, "seconds": None},
        "update": {"iterations": iterations, "stop_gain": 0},
    }
    settings: dict[Device, Settings] = {device: preset("scas4d", {**changes, "device": device}) for device in DEVICES}
    rows, last = list[DeviceRow](), min(frames, capture.frame_count - 1)
    with TemporaryDirectory() as place:
        folders: dict[Device, Path] = {device: Path(place) / device for device in DEVICES}
        scenes: dict[Device, Reconstruction] = {}
        scenes["cpu"] = Reconstruction.start(
            capture.rig, capture.frame(0), settings["cpu"], points=capture.points, history=History.open(folders["cpu"])
        )
        extent = capture.extent or float(np.ptp(scenes["cpu"].history.gaussians(0).means, axis=0).max())
        for index in range(1, last + 1):
            if index == 1 or not apart:
                scenes["gpu"] = continued(folders["cpu"], folders["gpu"], capture.rig, settings["gpu"])
            for scene in scenes.values():
                scene.step(capture.frame(index))
            psnr = {device: measure_pictures(scene, capture, index)[0]["psnr"] for device, scene in scenes.items()}
            row = DeviceRow(
                capture.name, index,
                psnr={device: value if value is not None else float("nan") for device, value in psnr.items()},
                distance=float(np.median(distances(scenes, index))) / extent,
                tracks=track_errors(scenes, capture, index),
            )  # fmt: skip
            rows.append(row)
    return rows


def track_errors(scenes: dict[Device, Reconstruction], capture: Capture, last: int) -> dict[Device, float]:
    """Returns the median track error over all frames in percent of the extent, keyed by device.

    The result is empty without ground truth.
    """
    if capture.ground_truth is None:
        return {}
    scores = {device: measure_tracks(scene, capture, range(last + 1)) for device, scene in scenes.items()}
    medians = {device: score.get("track_3d_median") for device, score in scores.items()}
    return {device: median for device, median in medians.items() if median is not None}


def distances(scenes: dict[Device, Reconstruction], index: int) -> NDArray[np.float64]:
    """Returns the distance in metres between the two positions of each moving Gaussian that both states contain.

    Returns a single 0 if there are none.
    """
    mine, true = (scenes[device].history.gaussians(index) for device in ("gpu", "cpu"))
    _, here, there = np.intersect1d(mine.ids[mine.moving], true.ids[true.moving], return_indices=True)
    away: NDArray[np.float64] = np.linalg.norm(
        mine.means[mine.moving][here].astype(np.float64) - true.means[true.moving][there], axis=1
    )
    return away if len(away) else np.zeros(1)


COLUMNS = (
    Column("capture", "capture"),
    Column("updates", "updates", "d"),
    Column("PSNR on the CPU, dB", "psnr"),
    Column("GPU minus CPU, dB", "difference", "+.3f"),
    Column("worst frame", "worst", "+.3f"),
    Column("distance, % of the extent", "distance", ".4f"),
    Column("track error, GPU minus CPU, worst frame", "tracks", "+.4f"),
)


def table(rows: Sequence[DeviceRow]) -> str:
    """Formats the rows of one or more captures as a Markdown table, with one line per capture."""
    lines: list[Row] = []
    for name in dict.fromkeys(row.capture for row in rows):
        own = [row for row in rows if row.capture == name]
        differences = [row.difference for row in own]
        tracks = [row.tracks["gpu"] - row.tracks["cpu"] for row in own if len(row.tracks) == len(DEVICES)]
        lines.append(
            {
                "capture": name,
                "updates": len(own),
                "psnr": float(np.mean([row.psnr["cpu"] for row in own])),
                "difference": float(np.mean(differences)),
                "worst": max(differences, key=abs),
                "distance": 100 * max(row.distance for row in own),
                "tracks": max(tracks, key=abs, default=None),
            }
        )
    return markdown(lines, COLUMNS)
