"""Committed frames of a scene as a compact 4D file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from scas4d_core.compact import CompactWriter, Head
from scas4d_core.storage.history import History
from server.processes.messages import SceneSpec


def compact_head(spec: SceneSpec, history: History) -> Head:
    """Returns what holds for all states of a scene: its world, its rig and its background."""
    world = spec.rig.world_frame(spec.settings.scene.metres_per_unit)
    return Head(world, background=history.background, rig=spec.rig, remark={"scene": spec.folder.name})


def write_compact(file: Path, history: History, frames: Iterable[int], head: Head, labels: NDArray[Any] | None) -> None:
    """Writes committed frames, each read when it is its turn.

    Args:
        file: replaced where it is there. frames: rising. labels: [N] part of each Gaussian, or None.

    Raises:
        HistoryError: a frame cannot be read.
    """
    file.unlink(missing_ok=True)
    with CompactWriter(file, head) as writer:
        last = -1
        for last in frames:
            writer.add(last, history.time(last), history.gaussians(last))
        if labels is not None:
            writer.add_parts(last, labels)
