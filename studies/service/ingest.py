"""Ingest rate over the loopback interface, compared with plain fsynced writes of the same records.

All rates are measured alternately in one run, because a disk's speed drifts and heavy writing slows later writes. A
record contains the encoded images of one frame. The scene is paused, so only ingest is measured: receiving, checking
the structure of each image, hashing, writing, syncing and acknowledging.
"""

from __future__ import annotations

import http.client
import io
import os
import shutil
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from websockets.sync.client import connect

from client.wire import FRAME_MEDIA_TYPE, IngestAnswer, frame_chunks
from scas4d_core.cameras import Camera, Rig
from studies.running.process import Service, StudyError

TARGET = 0.8
UNANSWERED = 2


@dataclass(frozen=True)
class IngestTimes:
    """Rates in megabytes per second, with one value per round.

    Attributes:
        plain: rates of plain writes.
        ingest: rates over HTTP.
        socket: rates over a WebSocket.
    """

    plain: list[float]
    ingest: list[float]
    socket: list[float]

    def share(self, ingest: Sequence[float]) -> float:
        """Returns the median over all rounds of the ratio of ``ingest`` to plain writes."""
        return statistics.median(took / plain for took, plain in zip(ingest, self.plain, strict=True))


def jpeg(size_bytes: int, seed: int, side: int = 1024) -> bytes:
    """Creates a JPEG of noise with the highest quality that fits into ``size_bytes``.

    Raises:
        StudyError: even the lowest quality does not fit.
    """
    rng = np.random.default_rng(seed)
    picture = Image.fromarray(rng.integers(0, 256, (side, side, 3), dtype=np.uint8))
    best = b""
    low, high = 1, 100
    while low <= high:
        quality = (low + high) // 2
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=quality)
        if file.tell() <= size_bytes:
            best, low = file.getvalue(), quality + 1
        else:
            high = quality - 1
    if not best:
        raise StudyError(f"an image of {side}x{side} pixels does not fit in {size_bytes} bytes")
    return best


def noise_rig(cameras: int, side: int = 1024) -> Rig:
    """Creates a rig of placeholder cameras in a row, with square images of ``side`` pixels."""
    k = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
    placed_cameras = []
    for number in range(cameras):
        pose = np.eye(4)
        pose[:3, 3] = (number / cameras, 0, 3)
        placed_cameras.append(Camera(f"c{number}", k, pose, side, side))
    return Rig(tuple(placed_cameras))


def measure(folder: Path, *, frames: int, cameras: int, size_bytes: int, rounds: int, senders: int) -> IngestTimes:
    """Measures the rates of plain writes, of HTTP and of a WebSocket, alternating between them in each round.

    Args:
        folder: folder on the disk to measure.
        frames: number of frames per round.
        cameras: number of cameras of the rig.
        size_bytes: size of one JPEG in bytes.
        rounds: number of rounds; a further round warms up.
        senders: number of HTTP connections.

    Raises:
        StudyError: the service refused a frame.
    """
    rig = noise_rig(cameras)
    pictures = [jpeg(size_bytes, seed) for seed in range(cameras)]
    records = [{name: pictures[(k + turn) % cameras] for k, name in enumerate(rig.names)} for turn in range(2)]
    folder.mkdir(parents=True, exist_ok=True)
    plain_folder = folder / f"plain-{os.getpid()}"
    service = Service(folder / f"ingest-{os.getpid()}", {"SCAS4D_MAX_BODY_MB": "1000"})
    service.data.mkdir()
    service.start()
    try:
        scene = service.create(rig, {}, ingest={"queue_frames": 10_000, "keep_frames": {}})
        service.http.post(f"/v1/scenes/{scene}/pause").raise_for_status()
        bodies = [b"".join(record.values()) for record in records]
        megabytes = frames * len(bodies[0]) / 1e6
        ways: list[Callable[[int], float]] = [
            lambda first: _plain(plain_folder, bodies, frames, first),
            lambda first: _ingest(service, scene, records, first, frames, senders),
            lambda first: _socket(service, scene, records, first, frames),
        ]
        seconds: list[list[float]] = [[], [], []]
        first = 0
        for number in range(rounds + 1):
            for turn in range(3):
                way = (turn + number) % 3
                took = ways[way](first)
                first += frames if way else 0
                if number:  # the first round warms up caches, connections and the thread pool
                    seconds[way].append(megabytes / took)
        return IngestTimes(*seconds)
    finally:
        service.stop()
        shutil.rmtree(plain_folder, ignore_errors=True)
        shutil.rmtree(service.data, ignore_errors=True)


def _plain(folder: Path, bodies: Sequence[bytes], frames: int, first: int) -> float:
    """Returns the seconds to write and sync each record to a new file, because overwriting files is faster."""
    folder.mkdir(exist_ok=True)
    began = time.perf_counter()
    for number in range(first, first + frames):
        handle = os.open(folder / str(number), os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        view = memoryview(bodies[number % len(bodies)])
        while view:
            view = view[os.write(handle, view) :]
        os.fsync(handle)
        os.close(handle)
    return time.perf_counter() - began


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


def page(measured: IngestTimes, *, frames: int, cameras: int, size_bytes: int, senders: int) -> str:
    """Formats the rates as a Markdown table, with a description of the frames and the verdict."""
    shares = [f"{100 * measured.share(took):.0f}%" for took in (measured.ingest, measured.socket)]
    rows = "\n".join(
        f"| {number + 1} | {plain:.0f} | {ingest:.0f} | {100 * ingest / plain:.0f}% "
        f"| {socket:.0f} | {100 * socket / plain:.0f}% |"
        for number, (plain, ingest, socket) in enumerate(
            zip(measured.plain, measured.ingest, measured.socket, strict=True)
        )
    )
    verdict = "reached" if measured.share(measured.ingest) >= TARGET else "missed"
    return (
        f"{frames} frames of {cameras} JPEGs of {size_bytes / 1e6:g} MB per round and transport; "
        f"HTTP over {senders} connections, one WebSocket with {UNANSWERED} messages unanswered\n\n"
        "| round | plain fsynced writes, MB/s | HTTP, MB/s | share | WebSocket, MB/s | share |\n"
        f"|---|---|---|---|---|---|\n{rows}\n\n"
        f"Median shares {shares[0]} and {shares[1]}, target {100 * TARGET:.0f}% (HTTP): {verdict}."
    )
