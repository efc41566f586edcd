"""Runs a service in a separate process that can be killed, and sends it the requests that studies need."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx

from client.calls import put_points
from client.wire import FRAME_MEDIA_TYPE, FrameReportModel, RigModel, SceneStatus, frame_chunks
from scas4d_core.cameras import Rig
from scas4d_core.captures import InitialPoints
from server.storage.layout import DataFolder

START_S, PATIENCE_S = 600.0, 900.0
EVERY_S = 0.05


class StudyError(RuntimeError):
    """Raised if the service does not behave as the study requires."""


def wait_until(done: Callable[[], bool], fault: str, seconds: float = PATIENCE_S) -> None:
    """Waits until a condition holds.

    Raises:
        StudyError: the condition does not hold within ``seconds``; the message is ``fault``.
    """
    until = time.monotonic() + seconds
    while not done():
        if time.monotonic() > until:
            raise StudyError(fault)
        time.sleep(EVERY_S)


class Service:
    """A service process on one data folder. It can be killed and started again.

    Args:
        data: the service's data folder.
        environment: additional environment variables, such as SCAS4D_TOKEN.
        program: arguments of Python that start the service; the port is added.
    """

    def __init__(
        self,
        data: Path,
        environment: Mapping[str, str] | None = None,
        program: Sequence[str] = ("-m", "client.cli.main", "serve"),
    ) -> None:
        self.data = data
        self._program = [sys.executable, *program]
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        token = (environment or {}).get("SCAS4D_TOKEN")
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=60, headers=headers)
        own = {"SCAS4D_DATA": str(data), "SCAS4D_WARM_UP": "false", "SCAS4D_LOG_LEVEL": "error"}
        self._environment = {**os.environ, **own, **(environment or {})}
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Process id of the service."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Starts the service and waits until it is ready.

        Raises:
            StudyError: the service ended, or was not ready in time.
        """
        with (self.data.parent / f"{self.data.name}.log").open("ab") as log:
            self._process = subprocess.Popen(
                [*self._program, "--port", str(self.port)], env=self._environment, stdout=log, stderr=log
            )
        until = time.monotonic() + START_S
        while True:
            with contextlib.suppress(httpx.TransportError):
                if self.http.get("/health/ready").status_code == 200:
                    return
            if self._process.poll() is not None or time.monotonic() > until:
                raise StudyError(f"the service did not start; see {self.data.name}.log next to its folder")
            time.sleep(EVERY_S)

    def kill(self) -> None:
        """Kills the service with `kill -9` if it is running."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def stop(self) -> None:
        """Closes the connection, stops the service with SIGTERM and waits until it has ended."""
        self.http.close()
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(60)
            self._process = None

    def worker_pid(self, scene: str) -> int | None:
        """Returns the process id of a scene's worker, or None if no worker is running."""
        try:
            pid = int(DataFolder(self.data).scene(scene).worker_lock.read_text())
            os.kill(pid, 0)
        except (OSError, ValueError):
            return None
        return pid

    def create(self, rig: Rig, settings: Mapping[str, Any], **more: Any) -> str:
        """Creates a scene and returns its id.

        Args:
            rig: cameras of the scene.
            settings: scene settings.
            more: additional fields of the request, such as ``ingest``.

        Raises:
            StudyError: the service refused the request.
        """
        body = {"rig": RigModel.of(rig).model_dump(mode="json"), "settings": settings, **more}
        answer = self.http.post("/v1/scenes", json=body)
        if answer.status_code != 201:
            raise StudyError(answer.text)
        return str(answer.json()["id"])

    def put_points(self, scene: str, points: InitialPoints) -> None:
        """Sends the initial points of a scene.

        Raises:
            StudyError: the service refused the points.
        """
        call = put_points(scene, points)
        answer = self.http.request(call.method, call.path, **call.arguments)
        if not answer.is_success:
            raise StudyError(answer.text)

    def put(self, scene: str, index: int, images: Mapping[str, bytes], masks: Mapping[str, bytes]) -> httpx.Response:
        """Sends one frame without retries and returns the response."""
        body = b"".join(frame_chunks(index, images, masks))
        return self.http.put(
            f"/v1/scenes/{scene}/frames/{index}", content=body, headers={"Content-Type": FRAME_MEDIA_TYPE}
        )

    def status(self, scene: str) -> SceneStatus:
        """Returns the status of a scene."""
        return SceneStatus.model_validate_json(self.http.get(f"/v1/scenes/{scene}").content)

    def frame(self, scene: str, index: int) -> FrameReportModel:
        """Returns the report of a frame."""
        return FrameReportModel.model_validate_json(self.http.get(f"/v1/scenes/{scene}/frames/{index}").content)

    def deaths(self, scene: str) -> int:
        """Returns the number of worker deaths recorded in a scene's journal."""
        return DataFolder(self.data).scene(scene).journal.read_bytes().count(b'"type":"worker_died"')

    def finish(self, scene: str, frames: int, every: float = EVERY_S) -> SceneStatus:
        """Waits until ``frames`` frames are finished and returns the status of the scene.

        Args:
            scene: scene id.
            frames: number of frames to wait for.
            every: polling interval in seconds.

        Raises:
            StudyError: the scene failed, or the frames were not finished in time.
        """
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            status = self.status(scene)
            if status.next_frame >= frames and status.queued == 0:
                return status
            if status.state == "failed":
                raise StudyError(f"the scene failed: {status.error}")
            time.sleep(every)
        raise StudyError(f"timed out after {PATIENCE_S:g} s while waiting for frames to finish")
