"""Connections that a client without a token keeps open: an endless header, half-sent headers and stalled uploads."""

from __future__ import annotations

import errno
import selectors
import socket
import time
from dataclasses import dataclass

PIECE = b"a" * (256 << 10)
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: aaaa"
EVERY_S = 0.2


@dataclass
class Hold:
    """One connection that is kept open.

    Attributes:
        connection: the socket.
        first: remaining bytes to send first.
        more: number of header bytes to send after these.
    """

    connection: socket.socket
    first: bytes
    more: int = 0


def upload(path: str) -> bytes:
    """Returns the start of an upload whose body never ends."""
    return (
        (
            f"PUT {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/vnd.scas4d.frame\r\n"
            "Content-Length: 1000000\r\n\r\n"
        ).encode()
        + b"S4DF"
        + bytes(60)
    )


def attack(port: int, path: str, header: int, halves: int, uploads: int, patience: float) -> dict[str, float]:
    """Opens all connections and waits until the service has closed them.

    Args:
        port: service port on the loopback interface.
        path: path of the uploads.
        header: bytes of the endless header; 0 for none.
        halves: number of half-sent headers.
        uploads: number of stalled uploads.
        patience: maximum time to wait, in seconds.

    Returns:
        seconds: time from the first connection until the last one was closed.
        open: number of connections that were not closed.
        sent: bytes of the endless header that the system accepted.
    """
    began = time.monotonic()
    ended, sent = began, 0
    with selectors.DefaultSelector() as waiting:
        # The endless header comes last, because the service closes the oldest connections when it reaches a limit.
        plans = [(HALF, 0)] * halves + [(upload(path), 0)] * uploads + [(HALF, header)] * (header > 0)
        for first, more in plans:
            connection = socket.socket()
            connection.setblocking(False)
            if connection.connect_ex(("127.0.0.1", port)) not in (0, errno.EINPROGRESS):
                connection.close()
                continue
            waiting.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE, Hold(connection, first, more))
        while waiting.get_map() and time.monotonic() - began < patience:
            for key, events in waiting.select(EVERY_S):
                hold: Hold = key.data
                try:
                    if events & selectors.EVENT_WRITE:
                        sent += _send(hold)
                        if not hold.first and hold.more <= 0:
                            waiting.modify(hold.connection, selectors.EVENT_READ, hold)
                    if not events & selectors.EVENT_READ or hold.connection.recv(1 << 16):
                        continue
                except BlockingIOError:
                    continue
                except OSError:
                    pass
                waiting.unregister(hold.connection)
                hold.connection.close()
                ended = time.monotonic()
        left = len(waiting.get_map())
        for key in list(waiting.get_map().values()):
            key.data.connection.close()
    return {"seconds": (time.monotonic() if left else ended) - began, "open": left, "sent": sent}


def _send(hold: Hold) -> int:
    if hold.first:
        hold.first = hold.first[hold.connection.send(hold.first) :]
        return 0
    sent = hold.connection.send(PIECE[: hold.more])
    hold.more -= sent
    return sent
