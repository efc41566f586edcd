"""The process that owns a scene's `Reconstruction`: decodes frames, steps, commits, reports."""

from __future__ import annotations

import logging
import os
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.captures.images import ImageError, decode_image, decode_mask
from scas4d_core.history import History
from server.engine import Reconstruction, load_engine
from server.frame_files import read_frame
from server.messages import Committed, FrameReady, Progressed, SceneSpec, SetAside, Started, Stop

PROGRESS_EVERY_S = 0.2

log = logging.getLogger("scas4d.worker")


def main(spec: SceneSpec, connection: Connection[Any, Any]) -> None:
    """Runs until told to stop, or until the service is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the service says when to stop
    worker = Worker(spec, connection)
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            break
        if isinstance(message, Stop):
            break
        worker.take(message)
    # Numerical libraries keep threads that can hang at exit, and all that matters is on disk.
    logging.shutdown()
    os._exit(0)


class Worker:
    """One scene. Every frame ends as `Committed` or `SetAside`."""

    def __init__(self, spec: SceneSpec, connection: Connection[Any, Any]) -> None:
        self.spec = spec
        self.connection = connection
        self.engine = load_engine(spec.engine)
        self.states = History(spec.states)
        self.reconstruction: Reconstruction | None = None
        self.fault = ""
        self._progress_at = 0.0

    def take(self, message: FrameReady) -> None:
        """Reconstructs one frame."""
        if self.fault:  # frames that waited behind a first frame that failed: none of them is a first frame
            message.file.unlink(missing_ok=True)
            self.connection.send(SetAside(message.index, self.fault, fatal=True))
            return
        self.connection.send(Started(message.index))
        dropped: dict[str, str] = {}
        try:
            frame, dropped = self.decode(message)
            if not frame.images:
                self.connection.send(SetAside(message.index, "no camera's picture could be decoded", dropped))
                return
            self.connection.send(self.reconstruct(frame, dropped))
        except Exception as error:  # whatever the engine raises, the service goes on and says so
            log.exception("scene %s, frame %d", self.spec.folder.name, message.index)
            reason = f"{type(error).__name__}: {error}"
            if self.reconstruction is None:  # without a first frame there is nothing to go on from
                self.fault = f"frame {message.index} could not be reconstructed: {reason}"
            self.connection.send(SetAside(message.index, reason, dropped, fatal=bool(self.fault)))
        finally:
            message.file.unlink(missing_ok=True)

    def decode(self, message: FrameReady) -> tuple[Frame, dict[str, str]]:
        """The frame, and the cameras left out of it with the reason."""
        encoded, encoded_masks = read_frame(message.file)
        images, masks, dropped = {}, {}, {}
        for name, data in encoded.items():
            camera = self.spec.rig[name]
            size = (camera.width, camera.height)
            try:
                image = decode_image(data, size=size, name=f"image of camera {name!r}")
                if name in encoded_masks:
                    masks[name] = decode_mask(encoded_masks[name], size=size, name=f"mask of camera {name!r}")
                images[name] = image
            except ImageError as error:
                dropped[name] = str(error)
        return Frame(message.index, message.time, images, masks), dropped

    def reconstruct(self, frame: Frame, dropped: dict[str, str]) -> Committed:
        """Runs the first frame or an update, and commits."""
        began = time.perf_counter()
        if self.reconstruction is None:
            reconstruction = self.engine.start(
                self.spec.rig,
                frame,
                self.spec.settings,
                points=self.points(),
                progress=self.progress,
                history=self.states,
            )
            state = self.states.gaussians(frame.index)
            self.reconstruction = reconstruction
            seconds = {"total": time.perf_counter() - began}
            return Committed(
                frame.index,
                frame.time,
                iterations=self.spec.settings.static.iterations,
                seconds=seconds,
                loss=[],
                psnr=float("nan"),
                moving=int(state.moving.sum()),
                gaussians=len(state),
                dropped=dropped,
            )
        report = self.reconstruction.step(frame)
        return Committed(
            frame.index,
            frame.time,
            iterations=report.iterations,
            seconds={**report.seconds, "total": time.perf_counter() - began},
            loss=[float(value) for value in report.loss],
            psnr=float(report.psnr),
            moving=report.moving,
            gaussians=report.gaussians,
            dropped=dropped,
        )

    def points(self) -> InitialPoints | None:
        """The initial cloud that was put before the first frame."""
        if not self.spec.points.exists():
            return None
        with np.load(self.spec.points, allow_pickle=False) as file:
            foreground = file["foreground"] if "foreground" in file.files else None
            return InitialPoints(file["positions"], file["colours"], foreground)

    def progress(self, progress: Any) -> None:
        """Passes progress on, a few times a second at most, and the end of a stage always."""
        now = time.monotonic()
        if now - self._progress_at >= PROGRESS_EVERY_S or progress.done >= progress.total:
            self._progress_at = now
            detail = {name: float(value) for name, value in progress.detail.items()}
            self.connection.send(Progressed(progress.stage, int(progress.done), int(progress.total), detail))
