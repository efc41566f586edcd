"""Export of a scene's committed frames to a compact 4D file."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from scas4d_core.compact import CompactWriter, FileError, FileHeader
from scas4d_core.first_frame.calibration.report import effective_rig
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.part_labels import resize_labels


def compact_head(spec: SceneSpec, history: History) -> FileHeader:
    """Returns the header of compact files of a scene: world frame, rig, background and frame rate.

    If the calibration was refined in the first frame, the rig has the refined calibration.
    """
    return FileHeader(
        spec.rig.world_frame(spec.settings.scene.metres_per_unit),
        background=history.background,
        rig=effective_rig(spec.rig, history.first_report),
        frames_per_second=spec.frames_per_second,
        metadata={"scene": spec.folder.name},
    )


def write_compact(
    file: Path, history: History, asked: Sequence[int], head: FileHeader, labels: NDArray[Any] | None
) -> int:
    """Writes committed frames to a compact file, reading one state at a time.

    Frames that retention has deleted in the meantime are skipped. If the scene already stores the first frame in a
    compact file, records of that file are copied bit for bit. The output may then also contain earlier frames, on which
    the requested ones depend, and it ends where the stored file ends.

    Args:
        file: path of the output; an existing file is replaced.
        history: the scene's committed states.
        asked: indices of the requested frames in ascending order.
        head: header for the output.
        labels: [N] part label of each Gaussian, or None.

    Returns:
        The index of the last frame in the output.

    Raises:
        HistoryError: none of the frames exists any more, or one cannot be read.
    """
    file.unlink(missing_ok=True)
    frames = [index for index in asked if index in history] or list(asked[:1])
    last = _copied(file, history, frames)
    if last is None:
        frames = list(takewhile(lambda index: index == frames[0] or not history.is_compacted(index), frames))
        with CompactWriter(file, head, clustered=len(frames) > 1) as writer:
            for index in frames:
                writer.add(index, history.time(index), history.gaussians(index))
            last = frames[-1]
            _add_parts(writer, history, last, labels)
    else:
        with CompactWriter.resume(file) as writer:
            _add_parts(writer, history, last, labels)
    return last


def _copied(file: Path, history: History, frames: Sequence[int]) -> int | None:
    """Copies frames from the scene's own compact file that contains the first requested frame.

    Returns:
        The index of the last frame that was copied, or None if there is no such compact file or the
        file is damaged.
    """
    if history.files is None or not history.is_compacted(frames[0]):
        return None
    try:
        with file.open("wb") as copy:
            return history.files.chunks.reader(frames[0]).copy_records(frames[0], frames[-1], copy)[-1]
    except (FileError, FileNotFoundError):  # the caller reads the states one by one and finds the damage
        file.unlink(missing_ok=True)
        return None


def _add_parts(writer: CompactWriter, history: History, last: int, labels: NDArray[Any] | None) -> None:
    if labels is not None:
        writer.add_parts(last, resize_labels(labels, len(history.gaussians(last))))
