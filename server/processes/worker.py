"""Worker process, which owns a scene's `Reconstruction`: decodes frames, runs updates, commits and reports them."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from client.wire import Budget
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.errors import message_of
from scas4d_core.storage.history import Defer, History, HistoryError, run_now
from scas4d_core.storage.npz import read_npz
from server.messages import (
    ChangeRetention,
    FrameCommitted,
    FrameFailedInWorker,
    FrameReady,
    FrameSolved,
    Progressed,
    Ready,
    RecomputeState,
    RepairFiles,
    ResumeFailed,
    SceneSpec,
    StatesRetained,
    Stop,
)
from server.processes.commits import CommitWriter, PendingCommit
from server.processes.decoder import FrameDecoder
from server.processes.inbox import Inbox
from server.processes.kernels import wait_for_first, wait_for_updates
from server.processes.placement import end_with_parent
from server.processes.state_compactor import StateCompactor
from server.repair import repairs
from server.repair.repairs import repair_at_start
from server.storage.disk import lock_states, no_room
from server.storage.frame_store import FrameDamage, has_record

if TYPE_CHECKING:
    from scas4d_core.reconstruction import Reconstruction

PROGRESS_EVERY_S = 0.2
"""Minimum interval in seconds between progress messages."""
NICE = 5
"""Niceness increment of the worker, so that requests and views have priority over updates (see docs/viewer.md)."""
IDLE_CHECK_S = 0.005
"""Interval in seconds at which the worker checks whether a commit is on disk."""
STOP_S = 2.0
"""Seconds that a worker waits for the last commit when it is asked to stop; a full disk may take longer."""

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
            worker.inbox.start()
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
            worker.finish_commit()
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
        self._sending = threading.Lock()
        self._decoder = FrameDecoder(spec.rig, self._pictures)
        self.inbox = Inbox(connection, self._decoder.begin)
        self._commits = CommitWriter(self.send, self.inbox.fail, spec.folder.name)
        self._compacting = StateCompactor(spec)

    def resume(self) -> bool:
        """Resumes from the committed states and reports them; returns False if that fails."""
        try:
            self.states = history = History.open(self.spec.folder.states)
            faults: tuple[str, ...] = ()
            if history.indices:
                from scas4d_core.reconstruction import Reconstruction  # imported lazily: not needed by the service

                wait_for_updates(self.spec.settings, None)
                self._compiled = True
                self.reconstruction = Reconstruction.resume(
                    self.spec.rig, self.spec.settings, history, held=lambda index: has_record(self._pictures, index)
                )
                if self.reconstruction.resumed is not None:
                    faults = tuple(self.reconstruction.resumed.faults)
                faults += tuple(repair_at_start(history))
            report = history.report(history.indices[-1]) if history.indices else {}
            self.send(Ready(tuple(history.indices), dict(history.damaged), report, faults))
        except (HistoryError, ValueError) as error:  # damaged data raises ValueError
            log.exception("scene %s: cannot resume from the committed states", self.spec.folder.name)
            self.send(ResumeFailed(f"{type(error).__name__}: {message_of(error)}"))
            return False
        return True

    def send(self, message: Any) -> None:
        """Sends a message to the service; may be called from several threads."""
        with self._sending:
            self.connection.send(message)

    def handle_frame(self, message: FrameReady) -> None:
        """Reconstructs one frame and starts to commit it.

        Raises:
            _Stopped: the service asked the worker to stop while the previous commit was waiting for disk space.
        """
        done = self.finish(message)
        self._await_commit()
        if isinstance(done, FrameFailedInWorker):
            self.send(done)
            return
        self.send(FrameSolved(message.index))  # before the commit is reported
        self._commits.put(done)

    def next(self) -> Any:
        """Waits for the next message and returns it.

        In the meantime, files of old states are deleted, and one is compacted by a thread.
        """
        while True:
            idle = self._commits.wait(0)
            if idle:
                self._commits.delete_files()
            if self.states is not None and len(self.states) > (self.spec.retention.exact_states or len(self.states)):
                # A commit that is being written has priority, because compaction also waits for the disk.
                self._compacting.compact(self.states, lambda: self.inbox.waiting or not self._commits.wait(0))
            try:
                return self.inbox.next(None if idle and not self._compacting.at_work else IDLE_CHECK_S)
            except TimeoutError:
                continue

    def finish_commit(self) -> None:
        """Waits until the last commit is on disk, or, if that takes too long, leaves the frame to the next worker."""
        self._commits.wait(STOP_S)
        self._compacting.wait(STOP_S)

    def _await_commit(self) -> None:
        """Waits until the previous commit is on disk.

        Raises:
            _Stopped: the service asked the worker to stop.
        """
        while not self._commits.wait(IDLE_CHECK_S):
            if self.inbox.failed is not None:
                raise self.inbox.failed
            if self.inbox.wait_for_stop(0) and not self._commits.wait(STOP_S):
                raise _Stopped

    def finish(self, message: FrameReady) -> PendingCommit | FrameFailedInWorker:
        """Reconstructs a frame and returns its commit, or the reason why there is none."""
        done = self._reconstruct_or_fail(message)
        if isinstance(done, PendingCommit):  # an error from here on ends the worker: its state is ahead of the files
            assert self.states is not None
            deleted = self.retain(done.deletions.append)
            done.message = FrameCommitted(message.index, self.states.report(message.index), tuple(deleted))
        return done

    def _reconstruct_or_fail(self, message: FrameReady) -> PendingCommit | FrameFailedInWorker:
        dropped: dict[str, str] = {}
        began = time.perf_counter()
        try:
            frame, dropped = self._decoder.decode(message)
            least = self.spec.minimum_cameras
            if len(frame.images) < least:
                reason = f"usable images: {len(frame.images)} (the scene requires at least {least})"
                return FrameFailedInWorker(message.index, reason, dropped)
            return self.reconstruct(frame, dropped, message.budget, began)
        except FrameDamage as error:
            return FrameFailedInWorker(message.index, f"its record in the frame log is damaged: {error}", dropped)
        except Exception as error:  # any failure in the core must be reported, and the service must keep running
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
        self._await_commit()
        self.send(StatesRetained(tuple(self.retain())))

    def repair(self, message: RepairFiles) -> None:
        """Checks and repairs damaged files, and reports the outcome for each."""
        assert self.states is not None
        self._await_commit()
        self._compacting.wait()
        for mended in repairs.repair_files(self.states, self.reconstruction, message):
            self.send(mended)

    def recompute(self, message: RecomputeState) -> None:
        """Recomputes a damaged state from its images and reports the outcome."""
        assert self.states is not None
        self._await_commit()
        self._compacting.wait()

        def pictures() -> tuple[Frame, dict[str, str]]:
            return self._decoder.decode(message.frame)

        for mended in repairs.recompute_state(self.spec, self.states, message, pictures):
            self.send(mended)

    def reconstruct(self, frame: Frame, dropped: dict[str, str], budget: Budget, began: float) -> PendingCommit:
        """Runs the first frame or an update and returns its commit, which is not written yet.

        Args:
            frame: frame with decoded images and masks.
            dropped: reason for each camera that was left out, keyed by camera name.
            budget: budget of an update; not used for the first frame.
            began: value of `time.perf_counter()` before decoding.
        """
        assert self.states is not None
        commit = PendingCommit(frame.index)
        if self.reconstruction is None:
            from scas4d_core.reconstruction import Reconstruction

            wait_for_first(self.spec.settings, self.spec.folder.points.exists(), self.send)
            self.reconstruction = Reconstruction.start(
                self.spec.rig,
                frame,
                self.spec.settings,
                points=self.points(),
                progress=self.progress,
                history=self.states,
                dropped=dropped,
                started=began,
                defer=commit.writes.append,
            )
        else:
            if not self._compiled:
                began += wait_for_updates(self.spec.settings, self.send)  # compilation does not count
                self._compiled = True
            if budget != self._budget:
                self.reconstruction.set_budget(**budget.model_dump(exclude={"keep_up_fps"}))
                self._budget = budget
            notes = {
                "budget": budget.model_dump(),
                "write_seconds": self._commits.write_seconds,
                "publish_seconds": self._commits.publish_seconds,
            }
            self.reconstruction.step(
                frame,
                dropped=dropped,
                notes=notes,
                started=began,
                defer=commit.writes.append,
                defer_cleanup=commit.cleanups.append,
            )
        return commit

    def retain(self, defer: Defer = run_now) -> list[int]:
        """Deletes old states according to the retention rules and returns their indices.

        `defer` is called with a function that deletes the files.
        """
        assert self.states is not None
        rule = self.spec.retention.keep_states
        last, size = (None if value is None else max(1, value) for value in (rule.last, rule.bytes))

        def delete_later(delete: Callable[[], None]) -> None:
            defer(lambda: self._delete(delete))

        if last is not None or size is not None:  # states that are being moved cannot be deleted
            self._compacting.wait()
        return self.states.retain(last=last, size_bytes=size, defer=delete_later)

    def _delete(self, delete: Callable[[], None]) -> None:
        self._compacting.wait()
        delete()

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
            self.send(Progressed(progress.stage, int(progress.done), int(progress.total), detail))
