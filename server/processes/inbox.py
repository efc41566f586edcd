"""Messages from the service to a worker, received by a thread, so that they arrive while a frame is being updated."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from server.messages import DecodeAhead, FrameReady, Stop


class Inbox:
    """Queue of messages, filled by a thread.

    Args:
        connection: connection to the service.
        on_decode_ahead: function called in the thread with a frame to decode in advance.

    Attributes:
        failed: error passed to `fail`, or None.
    """

    def __init__(self, connection: Connection[Any, Any], on_decode_ahead: Callable[[FrameReady], None]) -> None:
        self._connection = connection
        self._on_decode_ahead = on_decode_ahead
        self._messages: queue.Queue[Any] = queue.Queue()
        self._stopped = threading.Event()
        self.failed: BaseException | None = None

    def start(self) -> None:
        """Starts to receive."""
        threading.Thread(target=self._receive, daemon=True, name="inbox").start()

    @property
    def waiting(self) -> bool:
        """Whether a message is waiting."""
        return not self._messages.empty()

    def next(self, seconds: float | None = None) -> Any:
        """Returns the next message; waits for it, at most the given time if there is one.

        Raises:
            TimeoutError: no message arrived in time.
            EOFError, OSError: the service is gone.
            Exception: an error passed to `fail`.
        """
        try:
            message = self._messages.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        if isinstance(message, BaseException):
            raise message
        return message

    def wait_for_stop(self, seconds: float) -> bool:
        """Waits for the given time and returns whether the service asked the worker to stop or is gone."""
        return self._stopped.wait(seconds)

    def fail(self, error: BaseException) -> None:
        """Makes `next` raise an error once all earlier messages are handled."""
        self.failed = error
        self._messages.put(error)

    def _receive(self) -> None:
        while True:
            try:
                message = self._connection.recv()
            except (EOFError, OSError) as error:
                self._stopped.set()
                self._messages.put(error)
                return
            if isinstance(message, DecodeAhead):
                self._on_decode_ahead(message.frame)
                continue
            if isinstance(message, Stop):
                self._stopped.set()
            self._messages.put(message)
