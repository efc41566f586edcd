"""Export process, which writes committed frames to a file in an exchange format at low priority."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import InputError, message_of, without_paths
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import DamagedFrameError, History, HistoryError
from server.messages import DamageFound, ExportProgressed, ExportSpec
from server.processes.background_job import run_job
from server.processes.compact_answers import compact_head
from server.processes.placement import use_one_thread
from server.storage.disk import free_bytes, no_room

RESERVE_BYTES = 500_000_000
"""Free disk space in bytes that exports leave for scenes, enough for about a thousand frames."""

WRITTEN_TWICE = ("usd", "tapvid-mv")
"""Formats that are written to temporary files first, and copied at the end."""

log = logging.getLogger("scas4d.exporter")


class DiskReserveError(RuntimeError):
    """Error for an export that would use disk space reserved for scenes."""


def main(spec: ExportSpec, connection: Connection[Any, Any]) -> None:
    """Entry point of the process: runs one export; the service stops the process if the export is cancelled."""

    def log_and_explain(error: Exception) -> str:
        known = isinstance(error, InputError | HistoryError | DiskReserveError) or no_room(error)
        log.warning("scene %s: an export failed: %s", spec.scene.folder.name, error, exc_info=not known)
        return explain(error)

    run_job(partial(_export, spec, connection), connection, log_and_explain)


def explain(error: Exception) -> str:
    """Returns a user-facing explanation of why an export failed, without local file paths.

    >>> explain(InputError("parts: no Gaussian belongs to one", "ask for the parts"))
    'parts: no Gaussian belongs to one; ask for the parts'
    """
    if isinstance(error, DiskReserveError) or no_room(error):
        return f"the disk is full ({message_of(error)}); export fewer frames, or choose a smaller format"
    if isinstance(error, DamagedFrameError):
        return f"{message_of(error)}; try again later; the service repairs the file if possible"
    if isinstance(error, HistoryError):
        return (
            f"{message_of(error)}: the state was deleted during the export by the retention rules or a restart of "
            "its reconstruction; export later frames, or keep more states (keep_states)"
        )
    if isinstance(error, InputError):
        return without_paths(str(error))
    return f"{type(error).__name__}: {message_of(error)}"


def size_of(folder: Path) -> int:
    """Returns the total size in bytes of all files under a folder."""
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def _export(spec: ExportSpec, connection: Connection[Any, Any]) -> None:
    from scas4d_core.exports import export_sequence, format_of  # imported lazily: only this process needs it
    from scas4d_core.exports.formats import WITH_PARTS

    history: History | None = None
    wanted = format_of(spec.format)
    labels: NDArray[np.int64] | None = None
    folder = spec.file.parent
    try:
        if wanted.needs_parts or spec.format in WITH_PARTS:
            from server.processes.reader_process import QueryReader  # imported lazily: it loads the image encoders

            renderer = QueryReader(spec.scene)
            history = renderer.history
            if history.newest.moving.any():
                labels = renderer.labels(None)
            elif wanted.needs_parts:
                raise InputError(
                    "this scene has no moving Gaussians and therefore no parts", "export it in another format"
                )
        else:
            history = History.load(spec.scene.folder.states, only=(spec.first, *spec.frames))
            use_one_thread()
        if spec.ids is not None:
            history.known_rows(spec.ids)  # an unknown id is an error before the first frame is written
        head = compact_head(spec.scene, history)

        def progress(_: int, done: int) -> None:
            connection.send(ExportProgressed(done, size_of(folder)))
            twice = size_of(folder) if spec.format in WRITTEN_TWICE else 0
            if (free := free_bytes(folder) - twice) < RESERVE_BYTES:
                raise DiskReserveError(
                    f"{free / 1e6:.0f} MB are free, but {RESERVE_BYTES / 1e6:.0f} MB are reserved for frames"
                )

        export_sequence(
            _states(history, spec.frames),
            spec.format,
            spec.file,
            world=head.world,
            rig=head.rig,
            parts=labels,
            ids=spec.ids,
            frames_per_second=head.frames_per_second,
            background=head.background,
            progress=progress,
        )
    finally:
        if history is not None and (faults := history.pop_faults()):
            connection.send(DamageFound(faults))


def _states(history: History, frames: tuple[int, ...]) -> Iterator[tuple[int, float, Gaussians]]:
    """Yields index, time and Gaussians of each frame, reading one state at a time."""
    for index in frames:
        yield index, history.time(index), history.gaussians(index)
