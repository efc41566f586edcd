"""Committed frames of a scene as a compact 4D file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from scas4d_core.compact import CompactWriter, Head
from scas4d_core.first_frame.calibration.record import in_use
from scas4d_core.storage.history import History
from server.processes.messages import SceneSpec
from server.processes.part_labels import fitted


def compact_head(spec: SceneSpec, history: History) -> Head:
    """Returns what holds for all states of a scene: its world, the rig in use, its background and its rate."""
    return Head(
        spec.rig.world_frame(spec.settings.scene.metres_per_unit),
        background=history.background,
        rig=in_use(spec.rig, history.first_report),
        frames_per_second=spec.frames_per_second,
        remark={"scene": spec.folder.name},
    )


def write_compact(file: Path, history: History, asked: Sequence[int], head: Head, labels: NDArray[Any] | None) -> None:
    """Writes committed frames, each read when it is its turn; those that retention has deleted since are left out.

    Args:
        file: replaced where it is there. asked: frames, rising. labels: [N] part of each Gaussian, or None.

    Raises:
        HistoryError: none of the frames is there any more, or one cannot be read.
    """
    file.unlink(missing_ok=True)
    frames = [index for index in asked if index in history] or asked[:1]
    with CompactWriter(file, head, clustered=len(frames) > 1) as writer:
        for index in frames:
            writer.add(index, history.time(index), history.gaussians(index))
        if labels is not None:
            writer.add_parts(frames[-1], fitted(labels, len(history.gaussians(frames[-1]))))
