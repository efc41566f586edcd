"""Worker process, which owns a scene's `Reconstruction`: decodes frames, runs updates, commits and reports them."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from client.wire import Budget
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.captures.images import ImageError, decode_image, decode_mask
from scas4d_core.errors import message_of
from scas4d_core.storage.history import History, HistoryError
from scas4d_core.storage.npz import read_npz
from server.messages import (
    ChangeRetention,
    FrameCommitted,
    FrameFailedInWorker,
    FrameReady,
    Progressed,
    Ready,
    RecomputeState,
    RepairFiles,
    ResumeFailed,
    SceneSpec,
    StatesRetained,
    Stop,
    WaitingForDisk,
)
from server.processes.kernels import wait_for_first, wait_for_updates
from server.processes.placement import end_with_parent
from server.processes.state_compactor import StateCompactor
from server.repair import repairs
from server.repair.repairs import repair_at_start
from server.storage.disk import lock_states, no_room
from server.storage.frame_store import FrameDamage, has_record, read_pictures
from server.storage.ledger import frame_identity

if TYPE_CHECKING:
    from scas4d_core.reconstruction import Reconstruction

PROGRESS_EVERY_S = 0.2
"""Minimum interval in seconds between progress messages."""
NICE = 5
"""Niceness increment of the worker, so that requests and views have priority over updates (see docs/viewer.md)."""
STALL_S, LONGEST_STALL_S = 1.0, 30.0
"""Initial and maximum delay in seconds between attempts to commit a frame while the disk is full."""

log = logging.getLogger("scas4d.worker")


def main(spec: SceneSpec, connection: Connection[Any, Any]) -> None:
    """Entry point of the worker process, which runs until it is asked to stop or the service exits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the service decides when to stop
    os.nice(NICE)
    end_with_parent()
    lock = lock_states(spec.folder)
    worker = Worker(spec, connection)
    try:
        if worker.resume():
            while not isinstance(message := worker.next(), Stop):
                match message:
                    case FrameReady():
                        worker.handle_frame(message)
                    case ChangeRetention():
                        worker.set_retention(message)
                    case RepairFiles():
                        worker.repair(message)
                    case RecomputeState():
                        worker.recompute(message)
    except (EOFError, OSError) as error:
        if no_room(error):
            raise
    except _Stopped:
        pass
    # Threads of numerical libraries can hang at exit, so skip the cleanup; all relevant data is on disk.
    logging.shutdown()
    if lock is not None:
        lock.release()
    os._exit(0)


class _Stopped(Exception):
    """Exception that signals that the worker was asked to stop while waiting for disk space."""


class Worker:
    """Worker of one scene.

    It responds to every frame with `FrameCommitted` or `FrameFailedInWorker`, unless the process exits.
    """

    def __init__(self, spec: SceneSpec, connection: Connection[Any, Any]) -> None:
        self.spec = spec
        self.connection = connection
        self._pictures = spec.folder.frames
        self.states: History | None = None
        self.reconstruction: Reconstruction | None = None
        self._progress_at = 0.0
        self._budget = Budget()
        self._compiled = False  # whether the kernels of updates are compiled
        self._write_seconds: float | None = None
        self._publish_seconds = 0.0
        self._later: deque[Any] = deque()
        self._compacting = StateCompactor(spec)

    def resume(self) -> bool:
        """Resumes from the committed states and reports them; returns False if that fails."""
        try:
            self.states = history = History.open(self.spec.folder.states)
            undone: tuple[int, ...] = ()
            faults: tuple[str, ...] = ()
            if history.indices:
                from scas4d_core.reconstruction import Reconstruction  # imported lazily: not needed by the service

                wait_for_updates(self.spec.settings, None)
                self._compiled = True
                self.reconstruction = Reconstruction.resume(
                    self.spec.rig, self.spec.settings, history, held=lambda index: has_record(self._pictures, index)
                )
                if self.reconstruction.resumed is not None:
                    undone = tuple(self.reconstruction.resumed.undone)
                    faults = tuple(self.reconstruction.resumed.faults)
                faults += tuple(repair_at_start(history))
            report = history.report(history.indices[-1]) if history.indices else {}
            self.connection.send(Ready(tuple(history.indices), dict(history.damaged), report, undone, faults))
        except (HistoryError, ValueError) as error:  # damaged data raises ValueError
            log.exception("scene %s: cannot resume from the committed states", self.spec.folder.name)
            self.connection.send(ResumeFailed(f"{type(error).__name__}: {message_of(error)}"))
            return False
        return True

    def handle_frame(self, message: FrameReady) -> None:
        """Reconstructs and commits one frame; retries while the disk is full."""
        stall = STALL_S
        while True:
            try:
                done = self.finish(message)
                began = time.perf_counter()
                self.connection.send(done)
                self._publish_seconds += time.perf_counter() - began
                return
            except Exception as error:  # a full disk can surface as another error, such as one from closing a zip file
                if not no_room(error):
                    raise
                log.warning("scene %s: cannot commit frame %d yet: %s", self.spec.folder.name, message.index, error)
                self.connection.send(WaitingForDisk(message.index, message_of(error), stall))
            self._await_room(stall)
            stall = min(2 * stall, LONGEST_STALL_S)

    def next(self) -> Any:
        """Waits for the next message, compacting states in the meantime, and returns it.

        Messages that arrived while a frame was waiting for disk space come first.
        """
        if self.states is not None and len(self.states) > (self.spec.retention.exact_states or len(self.states)):
            self._compacting.compact_while_idle(self.states, lambda: bool(self._later) or self.connection.poll(0))
        return self._later.popleft() if self._later else self.connection.recv()

    def _await_room(self, seconds: float) -> None:
        """Waits for `seconds` and queues incoming messages; only `Stop` ends the wait early.

        Raises:
            _Stopped: the service asked the worker to stop.
        """
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and self.connection.poll(left):
            message = self.connection.recv()
            if isinstance(message, Stop):
                raise _Stopped
            self._later.append(message)

    def finish(self, message: FrameReady) -> FrameCommitted | FrameFailedInWorker:
        """Reconstructs and commits a frame, and returns the outcome to report.

        Raises:
            OSError: the disk is full, and nothing was committed.
        """
        dropped: dict[str, str] = {}
        began = time.perf_counter()
        try:
            frame, dropped = decode(self.spec.rig, message, read(self._pictures, message))
            least = self.spec.minimum_cameras
            if len(frame.images) < least:
                reason = f"usable images: {len(frame.images)} (the scene requires at least {least})"
                return FrameFailedInWorker(message.index, reason, dropped)
            return self.reconstruct(frame, dropped, message.budget, began)
        except FrameDamage as error:
            return FrameFailedInWorker(message.index, f"its record in the frame log is damaged: {error}", dropped)
        except Exception as error:  # any failure in the core must be reported, and the service must keep running
            if no_room(error):
                raise
            log.exception("scene %s: error in frame %d", self.spec.folder.name, message.index)
            # Without a first frame the scene cannot continue.
            first = self.reconstruction is None
            return FrameFailedInWorker(
                message.index, f"{type(error).__name__}: {message_of(error)}", dropped, fatal=first
            )

    def set_retention(self, message: ChangeRetention) -> None:
        """Applies new retention rules and reports the deleted states."""
        self.spec = replace(self.spec, retention=message.rules)
        self._compacting.set_rules(message.rules)
        self.connection.send(StatesRetained(tuple(self.retain())))

    def repair(self, message: RepairFiles) -> None:
        """Checks and repairs damaged files, and reports the outcome for each."""
        assert self.states is not None
        for mended in repairs.repair_files(self.states, self.reconstruction, message):
            self.connection.send(mended)

    def recompute(self, message: RecomputeState) -> None:
        """Recomputes a damaged state from its images and reports the outcome."""
        assert self.states is not None
        frame = message.frame

        def pictures() -> tuple[Frame, dict[str, str]]:
            return decode(self.spec.rig, frame, read(self._pictures, frame))

        for mended in repairs.recompute_state(self.spec, self.states, message, pictures):
            self.connection.send(mended)

    def reconstruct(self, frame: Frame, dropped: dict[str, str], budget: Budget, began: float) -> FrameCommitted:
        """Runs the first frame or an update and commits the result.

        Args:
            frame: frame with decoded images and masks.
            dropped: reason for each camera that was left out, keyed by camera name.
            budget: budget of an update; not used for the first frame.
            began: value of `time.perf_counter()` before decoding.
        """
        assert self.states is not None
        if self.reconstruction is None:
            from scas4d_core.reconstruction import Reconstruction

            wait_for_first(self.spec.settings, self.spec.folder.points.exists(), self.connection)
            self.reconstruction = Reconstruction.start(
                self.spec.rig,
                frame,
                self.spec.settings,
                points=self.points(),
                progress=self.progress,
                history=self.states,
                dropped=dropped,
                started=began,
            )
        else:
            if not self._compiled:
                began += wait_for_updates(self.spec.settings, self.connection)  # compilation does not count
                self._compiled = True
            if budget != self._budget:
                self.reconstruction.set_budget(**budget.model_dump())
                self._budget = budget
            notes = {
                "budget": budget.model_dump(),
                "write_seconds": self._write_seconds,
                "publish_seconds": self._publish_seconds,
            }
            report = self.reconstruction.step(frame, dropped=dropped, notes=notes, started=began)
            self._write_seconds = max(0.0, time.perf_counter() - began - sum(report.seconds.values()))
        ended = time.perf_counter()
        committed = self.states.report(frame.index)
        self._publish_seconds = time.perf_counter() - ended
        return FrameCommitted(frame.index, committed, tuple(self.retain()))

    def retain(self) -> list[int]:
        """Deletes old states according to the retention rules and returns their indices; failures are retried later."""
        assert self.states is not None
        rule = self.spec.retention.keep_states
        last, size = (None if value is None else max(1, value) for value in (rule.last, rule.bytes))
        return self.states.retain(last=last, size_bytes=size)

    def points(self) -> InitialPoints | None:
        """Returns the initial point cloud, or None if none was uploaded before the first frame."""
        if not self.spec.folder.points.exists():
            return None
        arrays = read_npz(self.spec.folder.points)
        return InitialPoints(arrays["positions"], arrays["colours"], arrays.get("foreground"))

    def progress(self, progress: Any) -> None:
        """Sends progress at most once per `PROGRESS_EVERY_S`, and always at the end of a stage."""
        now = time.monotonic()
        if now - self._progress_at >= PROGRESS_EVERY_S or progress.done >= progress.total:
            self._progress_at = now
            detail = {name: float(value) for name, value in progress.detail.items()}
            self.connection.send(Progressed(progress.stage, int(progress.done), int(progress.total), detail))


Picture = NDArray[np.uint8]

DECODERS = 8
"""Maximum number of cameras to decode in parallel; each needs memory for two copies of its image meanwhile."""


@dataclass(frozen=True)
class Encoded:
    """Encoded images and masks of a frame, keyed by camera; `faults` has a sentence for each unreadable record."""

    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    faults: list[str]


def read(folder: Path, message: FrameReady) -> Encoded:
    """Reads the files of a frame from the frame log.

    Raises:
        FrameDamage: the single record that contains the whole frame is damaged.
    """
    contents = Encoded({}, {}, [])
    for name in message.files:
        try:
            pictures = read_pictures(folder, name)
        except FrameDamage as error:
            if len(message.files) == 1:
                raise
            contents.faults.append(f"a record in the frame log is damaged: {error}")
            continue
        if len(message.files) == 1 and frame_identity(pictures.hashes, message.time) != message.identity:
            raise FrameDamage(f"{name}: its images differ from the acknowledged ones")
        contents.images.update(pictures.images)
        contents.masks.update(pictures.masks)
    return contents


def decode(rig: Rig, message: FrameReady, encoded: Encoded) -> tuple[Frame, dict[str, str]]:
    """Decodes a frame; returns it and the reason for each camera that was left out. Cameras are decoded in parallel."""
    with ThreadPoolExecutor(max_workers=min(DECODERS, os.cpu_count() or 1)) as pool:
        decoded = list(pool.map(lambda camera: _pictures_of(camera, encoded), rig.cameras))
    images, masks, dropped = {}, {}, {}
    # In the order of the rig, not of arrival, so that equal images give bit-identical results.
    for camera, pictures in zip(rig.cameras, decoded, strict=True):
        if isinstance(pictures, str):
            dropped[camera.name] = pictures
            continue
        images[camera.name], mask = pictures
        if mask is not None:
            masks[camera.name] = mask
    return Frame(message.index, message.time, images, masks), dropped


def _pictures_of(camera: Camera, encoded: Encoded) -> tuple[Picture, Picture | None] | str:
    """Returns a camera's image and mask, if any, or the reason for leaving the camera out."""
    name, size = camera.name, (camera.width, camera.height)
    if name not in encoded.images:
        return "; ".join(encoded.faults) or f"camera {name!r} had not sent an image when the frame was closed"
    try:
        image = decode_image(bytes(encoded.images[name]), size=size, name=f"image of camera {name!r}")
        if name not in encoded.masks:
            return image, None
        return image, decode_mask(bytes(encoded.masks[name]), size=size, name=f"mask of camera {name!r}")
    except ImageError as error:
        return str(error)
