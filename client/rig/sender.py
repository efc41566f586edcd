"""Sends the rig simulator's frames on schedule over HTTP or WebSockets, either whole or per camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

from client.calls import NewFrame
from client.errors import FrameGap, InvalidRequest, TooLarge, error_of_problem
from client.ingest import IngestSocket
from client.rig.delivery import Delivery
from client.rig.pace import Pace
from client.rig.sequence import EncodedFrame, Sequence
from client.sdk import Client
from client.wire import IngestAnswer

OnMessage = Callable[[str], None]


class Requests:
    """Transport that sends frames as HTTP requests."""

    def __init__(self, client: Client, scene: str) -> None:
        self._client = client
        self._scene = scene

    def frame(self, index: int, files: EncodedFrame) -> None:
        """Sends a whole frame."""
        self._client.put_frame(self._scene, index, files.images, files.masks, time=files.time)

    def batch(self, frames: list[NewFrame]) -> list[IngestAnswer]:
        """Sends several frames in one request."""
        return self._client.put_frames(self._scene, frames, on_refusal="stop")

    def camera(self, index: int, name: str, files: EncodedFrame) -> None:
        """Sends one camera's image and mask."""
        mask = files.masks.get(name)
        self._client.put_camera(self._scene, index, name, files.images[name], mask, time=files.time)

    def close(self) -> None:
        """Does nothing, because this object owns no connection."""


class Sockets:
    """Transport that sends frames over WebSockets: one for whole frames, or one per camera."""

    def __init__(self, client: Client, scene: str) -> None:
        self._client = client
        self._scene = scene
        self._sockets: dict[str, IngestSocket] = {}

    def frame(self, index: int, files: EncodedFrame) -> None:
        """Sends a whole frame."""
        self._of("").put_frame(index, files.images, files.masks, time=files.time)

    def batch(self, frames: list[NewFrame]) -> list[IngestAnswer]:
        """Sends several frames in one message."""
        return self._of("").put_frames(frames)

    def camera(self, index: int, name: str, files: EncodedFrame) -> None:
        """Sends one camera's image and mask over the camera's own socket."""
        self._of(name).put_camera(index, name, files.images[name], files.masks.get(name), time=files.time)

    def close(self) -> None:
        """Closes the sockets."""
        for socket in self._sockets.values():
            socket.close()

    def _of(self, sender: str) -> IngestSocket:
        # Each camera has at most one image in flight, so no two threads call this with the same name.
        if sender not in self._sockets:
            self._sockets[sender] = IngestSocket(self._client, self._scene, on_refusal="stop")
        return self._sockets[sender]


class Sender:
    """Sender of all frames of a sequence at the configured pace."""

    def __init__(
        self,
        client: Client,
        way: Requests | Sockets,
        sequence: Sequence,
        pace: Pace,
        delivery: Delivery,
        on_message: OnMessage,
        per_camera: bool,
        batch: int = 1,
    ) -> None:
        self._client = client
        self._way = way
        self._sequence = sequence
        self._pace = pace
        self._delivery = delivery
        self._on_message = on_message
        self._batch = batch
        names = sequence.source.full_rig.names
        self._cameras = ThreadPoolExecutor(max_workers=len(names), thread_name_prefix="camera") if per_camera else None
        self.start_clock()

    def start_clock(self) -> None:
        """Starts or restarts the clock, so that the next frame is due now."""
        self._began = time.monotonic()
        self._sent = 0
        self._delivery.lateness.began = self._began
        self._delivery.lateness.before = len(self._delivery.lateness.late)

    def send_all(self, first: int, count: int) -> Iterator[int]:
        """Sends frames in order and yields each index once it is acknowledged or lost.

        If the service expects a different index, sending continues from that index.
        """
        index = first
        while index < count:
            last = self._last_of_batch(index, count)
            due = [self._await(frame) for frame in range(index, last + 1)]
            try:
                if last > index:
                    self._send_batch(index, last)
                else:
                    self._send(index)
            except FrameGap as gap:
                if gap.expected == index:
                    raise
                self._on_message(f"the service expects frame {gap.expected} next, not {index}; continuing from there")
                index = gap.expected
                continue
            period = 1 / self._pace.fps if self._pace.fps else 0.0
            self._delivery.lateness.late += [time.monotonic() - moment - period for moment in due]
            yield from range(index, last + 1)
            index = last + 1

    def _last_of_batch(self, index: int, count: int) -> int:
        """Returns the last frame to send together with frame `index`.

        Lost frames and the first frame that is not lost are sent on their own.
        """
        last = index
        if index > len(self._delivery.lost) and self._cameras is None and not self._pace.drops(index):
            while last + 1 < min(index + self._batch, count) and not self._pace.drops(last + 1):
                last += 1
        return last

    def _send_batch(self, first: int, last: int) -> None:
        frames: list[NewFrame] = []
        for index in range(first, last + 1):
            files = self._sequence.files(index)
            if files.unusable:  # a batch contains only frames with the images of all cameras
                self._send_frames(frames)
                frames = []
                self._send_files(index, files)
            else:
                frames.append(NewFrame(index, files.images, files.masks, files.time))
        self._send_frames(frames)

    def _send_frames(self, frames: list[NewFrame]) -> None:
        """Sends frames in batches. A frame that is refused is sent alone, without the images that are refused."""
        while frames:
            problems = [(n, answer.problem) for n, answer in enumerate(self._way.batch(frames)) if answer.problem]
            if not problems:
                return
            refused, problem = problems[0]  # the batch stops here, so the frames after it were not accepted
            error = error_of_problem(problem)
            if not isinstance(error, InvalidRequest | TooLarge):
                raise error
            index = frames[refused].index
            self._send_files(index, self._sequence.files(index))
            frames = frames[refused + 1 :]

    def _await(self, index: int) -> float:
        """Waits until the frame is due and returns its due time."""
        due = self._began + (self._sent / self._pace.fps if self._pace.fps else 0.0)
        self._sent += 1
        time.sleep(max(0.0, due + self._pace.delay(index) - time.monotonic()))
        return due

    def _send(self, index: int) -> None:
        if self._cameras is None and self._pace.drops(index):
            self._lose(index, "lost by the rig simulator")
            self._on_message(f"frame {index}: lost by the rig, declared missing")
            return
        self._send_files(index, self._sequence.files(index))

    def _send_files(self, index: int, files: EncodedFrame) -> None:
        """Sends a frame without the images that cannot be used or are lost, or declares it missing."""
        left_out = self._delivery.left_out
        while not left_out.is_too_much(files.unusable):
            try:
                self._send_usable(index, files)
                break
            except (InvalidRequest, TooLarge) as refusal:
                name = (refusal.problem.field or "").removeprefix("mask.")
                if name not in files.images:
                    raise
                files = files.without(name, f"refused by the service: {refusal.problem.detail}")
                if left_out.is_too_much(files.unusable):
                    raise
        else:
            self._lose(index, "too few of its images can be used")
        for message in left_out.record(index, files.unusable):
            self._on_message(message)

    def _send_usable(self, index: int, files: EncodedFrame) -> None:
        if self._cameras is None and not files.unusable:
            self._way.frame(index, files)
            return
        sending = [name for name in files.images if self._cameras is None or not self._pace.drops(index, name)]
        if len(sending) < self._delivery.left_out.minimum:
            self._lose(index, "lost by the rig simulator")
            self._on_message(f"frame {index}: lost by the rig, declared missing")
            return
        send = map if self._cameras is None else self._cameras.map
        list(send(lambda name: self._send_camera(index, name, files), sending))
        if len(sending) < len(files.images):
            lost = ", ".join(name for name in files.images if name not in sending)
            self._on_message(f"frame {index}: the rig lost the images of {lost}; closed without them")
        if len(sending) < len(self._sequence.source.full_rig):
            self._client.close_frame(self._delivery.scene, index)

    def _send_camera(self, index: int, name: str, files: EncodedFrame) -> None:
        time.sleep(self._pace.delay(index, name))
        self._way.camera(index, name, files)

    def _lose(self, index: int, reason: str) -> None:
        self._client.declare_missing(self._delivery.scene, index, reason=reason)
        self._delivery.lost.append(index)

    def close(self) -> None:
        """Stops the threads."""
        if self._cameras is not None:
            self._cameras.shutdown(wait=True, cancel_futures=True)
