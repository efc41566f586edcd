"""An HTTP connection whose bodies are handed on as they come, and memory that is not given back between two pieces."""

from __future__ import annotations

import contextlib
import ctypes

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 32 << 20


class Connection(HttpToolsProtocol):
    """uvicorn's own, without its two copies of a body: a frame is some 30 MB, and each costs what reading it does."""

    def on_body(self, body: bytes) -> None:
        """Takes a piece of a body."""
        if not self.cycle.body:
            # Nothing waits: `+=` to bytes that are empty is the piece itself, and so is `bytes` of it.
            self.cycle.body = b""  # type: ignore[assignment]
        super().on_body(body)


def keep_freed_memory() -> None:
    """Tells glibc to keep what is freed, up to `KEPT_BYTES`.

    A socket is read in pieces of 256 kB, for which it would otherwise ask the kernel for fresh memory each time: that
    takes longer than to fill it. Elsewhere nothing happens.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
