"""`scas4d demo`: starts a service, streams a capture through it, and saves images."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from client import pictures, rig
from client.cli.extras import need_server
from client.errors import ServiceError, ServiceUnreachable
from client.progress import Bars, console
from client.sdk import Client
from scas4d_core.captures import Capture

POLL_S = 0.5
"""Interval in seconds at which the service's readiness is polled."""
PREPARING = "preparing the kernels"


@contextmanager
def running_service(data: Path, log: Path, port: int = 8000) -> Iterator[str]:
    """Runs a service on the loopback interface and yields its URL.

    The service listens on `port`, or on any free port if `port` is taken. The very first start compiles the kernels for
    the first frame, so there is no timeout as long as the process is alive.

    Raises:
        RuntimeError: the service exited or could not become ready; the message contains the reason and the log path.
        ModuleNotFoundError: the service is not installed.
    """

    def stop(*_: object) -> NoReturn:
        raise SystemExit(128 + signal.SIGTERM)  # so that the service is stopped, too

    need_server()
    port = port if _free(port) else _free(0)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:
        command = [sys.executable, "-m", "client.cli.main", "serve", "--port", str(port), "--data", str(data)]
        before = signal.signal(signal.SIGTERM, stop)
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    try:
        url = f"http://127.0.0.1:{port}"
        total = 1
        with Bars() as bars:
            while (left := _compile_progress(url, log, process.pid)) is not None:
                if process.poll() is not None:
                    raise RuntimeError(f"the service exited: {_last_log_line(log)}; see the log at {log}")
                done, total = left
                bars(PREPARING, done, total)
                time.sleep(POLL_S)
            bars(PREPARING, total, total)
        yield url
    finally:
        signal.signal(signal.SIGTERM, before)
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _free(port: int) -> int:
    """Returns the port if it is free (for 0, any free port), else 0."""
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return 0
        return int(probe.getsockname()[1])


def _compile_progress(url: str, log: Path, process: int) -> tuple[int, int] | None:
    """Returns the numbers of compiled and total kernels, or None once the service is ready.

    Returns (0, 1) while the numbers are unknown, or if another process responds: it took the port in the meantime, and
    the service is about to exit.
    """
    try:
        with Client(url, token=_token(), outage=0) as client:
            if client.live().process != process:
                return 0, 1
            client.ready()
    except ServiceUnreachable:
        return 0, 1
    except ServiceError as error:
        said = error.problem.model_extra or {}
        if said.get("warming_up") or said.get("recovering"):  # the service becomes ready on its own
            return int(said.get("kernels_compiled", 0)), int(said.get("kernels", 1))
        raise RuntimeError(f"the service failed to become ready: {error}; see the log at {log}") from None
    return None


def _token() -> str | None:
    """Returns the access token from the environment variable that the service also reads."""
    return os.environ.get("SCAS4D_TOKEN")


def _last_log_line(log: Path) -> str:
    """Returns the last human-readable line of a log whose other lines are JSON."""
    said = [line for line in log.read_text(errors="replace").splitlines() if line and not line.startswith("{")]
    return said[-1].removeprefix("scas4d: ") if said else "no reason was logged"


def run(capture: Capture, url: str, out: Path, *, frames: int | None, preset: str, settings: Mapping[str, Any]) -> str:
    """Streams a capture through the service at `url`, saves renders and returns the scene's id.

    `out` receives ground truth | render | difference images for each frame and test camera, and the depth and parts of
    the last frame. Without test cameras, one training camera is used.
    """
    name = f"demo of {capture.name}"
    with Client(url, token=_token()) as client:
        for earlier in client.scenes():
            if earlier.name == name:  # old demo scenes would count towards the service's scene limit
                client.delete_scene(earlier.id)
        with Bars() as bars:
            delivery = rig.push(
                capture, client, name=name, frames=frames, preset=preset, settings=settings, on_progress=bars
            )
        status = client.scene(delivery.scene)
        if status.last_committed is None:
            raise RuntimeError(f"no frame was committed: {status.error}")
        _report(client, status.id, status.next_frame)
        scores = save_views(capture, client, status.id, status.next_frame, out)
    mean = np.mean(scores[1:]) if len(scores) > 1 else scores[0]
    kind = "held-out test" if capture.full_test_rig is not None else "training"
    console.print(f"{kind} cameras: frame 0 {scores[0]:.2f} dB, mean over the updates {mean:.2f} dB PSNR")
    return status.id


def _report(client: Client, id: str, frames: int) -> None:
    """Prints a line with timings, and a line for each failed frame."""
    reports = [client.frame(id, index) for index in range(frames)]
    for report in reports:
        if report.state != "committed":
            console.print(f"[red]frame {report.index} failed: {report.error}")
    done = [report for report in reports if report.state == "committed"]
    first, updates = done[0], [report.seconds["total"] for report in done[1:]]
    later = f", updates {np.median(updates):.2f} s each (median of {len(updates)})" if updates else ""
    console.print(f"frame {first.index} took {first.seconds['total']:.1f} s{later}; {first.gaussians} Gaussians")


def save_views(capture: Capture, client: Client, id: str, frames: int, out: Path) -> list[float]:
    """Saves comparison images of every committed frame and returns the mean PSNR over the cameras for each frame."""
    cameras = capture.full_test_rig.cameras if capture.full_test_rig is not None else capture.full_rig.cameras[:1]
    scores = []
    with Bars() as bars:
        for index in range(frames):
            if client.frame(id, index).state != "committed":
                continue
            truth = capture.test_frame(index) if capture.full_test_rig is not None else capture.frame(index)
            by_camera = []
            for camera in cameras:
                render = client.render(id, camera, index)
                true = truth.images[camera.name]
                by_camera.append(pictures.psnr(true, render))
                pictures.save(out / f"camera_{camera.name}" / f"{index:06d}.png", pictures.comparison(true, render))
            scores.append(float(np.mean(by_camera)))
            bars("pictures", index + 1, frames)
        bars("depth and parts", 0, 1)
        try:
            views = client.render_arrays(id, cameras[0], None, kinds=["depth", "parts"])
        except ServiceError as error:
            console.print(f"[red]cannot render depth and parts: {error}")
        else:
            pictures.save(out / "depth.png", pictures.depth_to_grey(views["depth"]))
            pictures.save(out / "parts.png", pictures.colour_labels(views["parts"]))
            bars("depth and parts", 1, 1)
    return scores
