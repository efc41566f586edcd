"""Resources of the process for many connections: freed memory that is kept, and open files."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import struct

try:
    import fcntl
    import resource
    import termios
except ImportError:  # on Windows
    UNIX = False
else:
    UNIX = True

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 32 << 20
OTHER_FILES = 256
"""Open beside connections: pipes of the scenes' processes, journals, what a library needs for a moment."""
FILES_EACH = 2
"""Files of a connection: its socket, and the record that an upload is written to."""


def keep_freed_memory() -> None:
    """Has glibc keep what is freed, up to `KEPT_BYTES`.

    A socket is read in pieces of 256 kB, for which it would otherwise ask the kernel for fresh memory each time: that
    takes longer than to fill it. Elsewhere nothing happens.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


def room_for_connections(asked: int) -> int:
    """Raises the limit on open files as far as `asked` connections need it, and the system lets it.

    Returns:
        How many connections there is room for, at most `asked`: a service without a free file cannot answer anybody.
    """
    if not UNIX:
        return asked
    needed = asked * FILES_EACH + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    if soft != unlimited and soft < needed:
        with contextlib.suppress(OSError, ValueError):  # the kernel has a limit of its own
            resource.setrlimit(resource.RLIMIT_NOFILE, (needed if hard == unlimited else min(needed, hard), hard))
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return asked if soft == unlimited else max(1, min(asked, (soft - OTHER_FILES) // FILES_EACH))


def unread_bytes(transport: asyncio.Transport) -> int:
    """Returns bytes that were written and not acknowledged: the transport's and, on systems that count them, the
    kernel's. The kernel takes more in lumps of up to a megabyte, between which a slow reader would look like none.
    """
    unread = transport.get_write_buffer_size()
    socket = transport.get_extra_info("socket")
    if unread and UNIX and socket is not None:
        with contextlib.suppress(OSError, ValueError):
            unread += struct.unpack("i", fcntl.ioctl(socket.fileno(), termios.TIOCOUTQ, bytes(4)))[0]
    return unread
