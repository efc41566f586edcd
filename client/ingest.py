"""Frame upload over a WebSocket, with one acknowledged binary message (`client.wire.framing`) per frame.

The retry policy is the same as over HTTP. If the connection is lost, the client reconnects and resends the frame.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any
from urllib.parse import quote

import httpx
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from client.batches import RETRIED_STATUSES, SendingBatch
from client.calls import Call, NewFrame
from client.calls.frames import OnRefusal
from client.errors import ServiceError, error_of
from client.retries import Retries
from client.sdk import Client
from client.wire import CameraReceipt, FrameReceipt, IngestAnswer, frame_chunks

ANSWER_S = 130.0
"""Maximum time in seconds to wait for an acknowledgement."""


class IngestSocket:
    """WebSocket connection of one sender to a scene; not thread-safe.

    Close it after use, or use it as a context manager.

    Args:
        client: client that provides the address, token, timeouts and `on_retry` callback.
        scene: scene id.
        on_refusal: what a frame does to the rest of its batch if its content is refused; see `calls.put_frames`.

    >>> n = client.scene(open_scene).next_frame
    >>> with IngestSocket(client, open_scene) as socket:
    ...     whole = socket.put_frame(n, pictures)
    ...     parts = [socket.put_camera(n + 1, camera, pictures[camera]) for camera in ("c0", "c1")]
    >>> whole.index == n, [part.absent for part in parts]
    (True, [['c1'], []])
    """

    def __init__(self, client: Client, scene: str, on_refusal: OnRefusal = "skip") -> None:
        self._client = client
        base = "ws" + client.url.removeprefix("http")
        self._address = f"{base}/v1/scenes/{quote(scene, safe='')}/ingest?on_refusal={on_refusal}"
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()

    def __enter__(self) -> IngestSocket:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection."""
        self._stack.close()
        self._connection = None

    def put_frame(
        self,
        index: int,
        images: Mapping[str, bytes],
        masks: Mapping[str, bytes] | None = None,
        time: float | None = None,
    ) -> FrameReceipt:
        """Sends a frame with the images of all cameras; see `Client.put_frame`."""
        receipt = self._send_one(frame_chunks(index, images, masks, time))
        assert isinstance(receipt, FrameReceipt)
        return receipt

    def put_frames(self, frames: Sequence[NewFrame]) -> list[IngestAnswer]:
        """Sends a batch of frames in one message and returns one answer per frame; see `Client.put_frames`."""
        sending = SendingBatch(frames)
        while sending.left:
            chunks = [chunk for frame in sending.left for chunk in frame.chunks()]
            time.sleep(sending.record(self._send(chunks, len(sending.left), refusals=True)))
        return sending.answers

    def put_camera(
        self, index: int, camera: str, image: bytes, mask: bytes | None = None, time: float | None = None
    ) -> CameraReceipt:
        """Sends one camera's image of a frame; see `Client.put_camera`."""
        masks = {} if mask is None else {camera: mask}
        receipt = self._send_one(frame_chunks(index, {camera: image}, masks, time, part=True))
        assert isinstance(receipt, CameraReceipt)
        return receipt

    def _send_one(self, chunks: list[bytes]) -> FrameReceipt | CameraReceipt:
        receipt = self._send(chunks, 1)[0].receipt
        assert receipt is not None
        return receipt

    def _send(self, chunks: list[bytes], count: int, *, refusals: bool = False) -> list[IngestAnswer]:
        """Sends a message, repeating it while its first frame must be retried, and returns its `count` answers.

        Raises:
            ServiceError: the first frame was refused. With `refusals`, this applies only to refusals that are retried.
            ServiceUnreachable: the service did not respond.
        """
        call: Call[Any] = Call("PUT", self._address, lambda response: None)
        client = self._client
        retries = Retries(call, client.url, busy=client.busy_timeout, outage=client.outage, on_retry=client.on_retry)
        while True:
            wait: float | None
            try:
                answers = self._exchange(chunks, count)
            except InvalidStatus as error:
                refusal = error.response
                wait = retries.after_response(
                    httpx.Response(
                        refusal.status_code, headers=dict(refusal.headers.raw_items()), content=bytes(refusal.body)
                    )
                )
            except (OSError, TimeoutError, ConnectionClosed, InvalidHandshake) as error:
                self.close()
                lost = httpx.ReadError(str(error))
                lost.__cause__ = error
                wait = retries.after_connection_error(lost)
            else:
                first = answers[0]
                if first.receipt is not None or (refusals and first.status not in RETRIED_STATUSES):
                    return answers
                wait = retries.after_response(_as_response(first))
            if wait is None:
                raise ServiceError(error_of(_as_response(answers[0])).problem)
            time.sleep(wait)

    def _exchange(self, chunks: list[bytes], count: int) -> list[IngestAnswer]:
        if self._connection is None:
            token = self._client.token
            self._connection = self._stack.enter_context(
                connect(
                    self._address,
                    additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                    compression=None,  # images are already compressed
                    close_timeout=2,
                )
            )
        self._connection.send(iter(chunks))
        return [IngestAnswer.model_validate_json(self._connection.recv(timeout=ANSWER_S)) for _ in range(count)]


def _as_response(answer: IngestAnswer) -> httpx.Response:
    """Returns the equivalent HTTP response, so that the same retry policy applies."""
    problem = {} if answer.problem is None else answer.problem.model_dump(mode="json", exclude_none=True)
    headers = {} if answer.retry_after is None else {"Retry-After": str(answer.retry_after)}
    return httpx.Response(answer.status, headers=headers, json=problem)
