"""Ingest rate over the loopback interface, over HTTP and over a WebSocket.

Both are measured alternately in one run, because a disk's speed drifts. The scene is paused, so only ingest is
measured: receiving, checking the structure of each image, hashing, writing, syncing and acknowledging.
"""

from __future__ import annotations

import http.client
import io
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from PIL import Image
from websockets.sync.client import connect

from client.cli.scores import Column, Row, markdown
from client.wire import FRAME_MEDIA_TYPE, IngestAnswer, frame_chunks
from scas4d_core.cameras import Camera, Rig
from studies.running.process import Service, StudyError

UNANSWERED = 2
"""Number of messages in flight on the WebSocket."""


def jpeg(side: int, seed: int) -> bytes:
    """Creates a JPEG of noise with ``side`` × ``side`` pixels, which takes about 0.6 bytes per pixel."""
    noise = np.random.default_rng(seed).integers(0, 256, (side, side, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "JPEG", quality=75)
    return file.getvalue()


def noise_rig(cameras: int, side: int) -> Rig:
    """Creates a rig of placeholder cameras in a row, with square images of ``side`` pixels."""
    k = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
    placed_cameras = []
    for number in range(cameras):
        pose = np.eye(4)
        pose[:3, 3] = (number / cameras, 0, 3)
        placed_cameras.append(Camera(f"c{number}", k, pose, side, side))
    return Rig(tuple(placed_cameras))


def measure(folder: Path, *, frames: int, cameras: int, side: int, rounds: int, senders: int) -> dict[str, list[float]]:
    """Measures the rates over HTTP and over a WebSocket, alternating between them, in MB per second and round.

    For the arguments, see ``scripts/bench ingest --help``.

    Raises:
        StudyError: the service refused a frame.
    """
    rig = noise_rig(cameras, side)
    pictures = [jpeg(side, seed) for seed in range(cameras)]
    records = [{name: pictures[(k + turn) % cameras] for k, name in enumerate(rig.names)} for turn in range(2)]
    megabytes = frames * sum(map(len, pictures)) / 1e6
    shutil.rmtree(folder, ignore_errors=True)
    service = Service(folder / "data", {"SCAS4D_MAX_BODY_MB": "1000"})
    service.data.mkdir(parents=True)
    service.start()
    try:
        scene = service.create(rig, {}, ingest={"queue_frames": 10_000, "keep_frames": {}})
        service.http.post(f"/v1/scenes/{scene}/pause").raise_for_status()
        rates: dict[str, list[float]] = {"HTTP": [], "WebSocket": []}
        for number in range(2 * (rounds + 1)):
            first = number * frames
            if number % 2:
                rates["HTTP"].append(megabytes / _ingest(service, scene, records, first, frames, senders))
            else:
                rates["WebSocket"].append(megabytes / _socket(service, scene, records, first, frames))
        return {name: values[1:] for name, values in rates.items()}  # the first warms up caches and connections
    finally:
        service.stop()
        shutil.rmtree(folder, ignore_errors=True)


def _ingest(
    service: Service, scene: str, records: Sequence[dict[str, bytes]], first: int, frames: int, senders: int
) -> float:
    """Returns the seconds until all frames are acknowledged, sent over several connections in rotation."""
    connections = [http.client.HTTPConnection("127.0.0.1", service.port) for _ in range(senders)]
    faults: list[str] = []

    def send(turn: int) -> None:
        for index in range(first + turn, first + frames, senders):
            chunks = frame_chunks(index, records[index % len(records)])
            headers = {"Content-Type": FRAME_MEDIA_TYPE, "Content-Length": str(sum(map(len, chunks)))}
            while True:
                connections[turn].request("PUT", f"/v1/scenes/{scene}/frames/{index}", iter(chunks), headers)
                answer = connections[turn].getresponse()
                text = answer.read()
                if answer.status == 202:
                    break
                if answer.status != 409:  # the previous frame has not begun: its sender is behind
                    faults.append(f"frame {index}: {answer.status} {text[:300]!r}")
                    return

    threads = [threading.Thread(target=send, args=(turn,)) for turn in range(senders)]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
        time.sleep(0.002)  # staggered, in the order in which frames are accepted
    for thread in threads:
        thread.join()
    took = time.perf_counter() - began
    for connection in connections:
        connection.close()
    if faults:
        raise StudyError("; ".join(faults))
    return took


def _socket(service: Service, scene: str, records: Sequence[dict[str, bytes]], first: int, frames: int) -> float:
    """Returns the seconds until all frames are acknowledged over one WebSocket.

    At most `UNANSWERED` messages are in flight.
    """
    faults: list[str] = []
    room = threading.Semaphore(UNANSWERED)

    def hear() -> None:
        for _ in range(frames):
            answer = IngestAnswer.model_validate_json(socket.recv(timeout=60))
            if answer.status != 202:
                faults.append(f"frame {answer.index}: {answer.status} {answer.problem}")
            room.release()

    address = f"ws://127.0.0.1:{service.port}/v1/scenes/{scene}/ingest"
    with connect(address, compression=None) as socket:
        listener = threading.Thread(target=hear)
        began = time.perf_counter()
        listener.start()
        for index in range(first, first + frames):
            room.acquire()
            socket.send(iter(frame_chunks(index, records[index % len(records)])))
        listener.join()
        took = time.perf_counter() - began
    if faults:
        raise StudyError("; ".join(faults))
    return took


def page(rates: Mapping[str, Sequence[float]], *, frames: int, cameras: int, side: int, senders: int) -> str:
    """Formats the rates as a Markdown table, with a description of the frames."""
    rows: list[Row] = [{"name": name, "all": values, "median": median(values)} for name, values in rates.items()]
    for row in rows:
        row["all"] = ", ".join(f"{value:.0f}" for value in row["all"])
    columns = (Column("transport", "name"), Column("median, MB/s", "median", ".0f"), Column("rounds, MB/s", "all"))
    return (
        f"{frames} frames of {cameras} JPEGs of {len(jpeg(side, 0)) / 1e6:.1f} MB per round and transport; HTTP over "
        f"{senders} connections, one WebSocket with {UNANSWERED} messages unanswered\n\n{markdown(rows, columns)}"
    )
