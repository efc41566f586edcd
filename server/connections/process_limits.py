"""Settings of the process for many connections: freed memory that is retained, and open files.

The module also determines how much sent data a peer has not acknowledged.
"""

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
RETAINED_BYTES = 32 << 20
"""Maximum number of bytes of freed memory that glibc retains."""
OTHER_FILES = 256
"""Number of open files besides connections: pipes to scene processes, journals and temporary files."""
FILES_EACH = 2
"""Number of open files per connection: its socket, and the record file of an upload."""


def retain_freed_memory() -> None:
    """Configures glibc to retain up to `RETAINED_BYTES` of freed memory.

    Sockets are read in blocks of 256 kB. By default, glibc requests new memory from the kernel for each block, which
    takes longer than filling the block. This function has no effect with other C libraries.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, RETAINED_BYTES)
        mallopt(M_TRIM_THRESHOLD, RETAINED_BYTES)


def raise_open_file_limit(asked: int) -> int:
    """Raises the limit on open files to allow `asked` connections, as far as the system permits.

    Returns:
        The number of connections that the limit allows, at most `asked`. A service that has run out of file descriptors
        cannot respond to any client.
    """
    if not UNIX:
        return asked
    needed = asked * FILES_EACH + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    if soft != unlimited and soft < needed:
        with contextlib.suppress(OSError, ValueError):  # the kernel has its own limit
            resource.setrlimit(resource.RLIMIT_NOFILE, (needed if hard == unlimited else min(needed, hard), hard))
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return asked if soft == unlimited else max(1, min(asked, (soft - OTHER_FILES) // FILES_EACH))


def unread_bytes(transport: asyncio.Transport) -> int:
    """Returns the number of bytes that were written but not acknowledged.

    This includes the buffer of the transport and, on systems that report it, of the kernel. The kernel accepts data in
    batches of up to a megabyte. Between two batches, the transport's buffer alone does not reveal whether a slow peer
    is reading.
    """
    unread = transport.get_write_buffer_size()
    socket = transport.get_extra_info("socket")
    if unread and UNIX and socket is not None:
        with contextlib.suppress(OSError, ValueError):
            unread += struct.unpack("i", fcntl.ioctl(socket.fileno(), termios.TIOCOUTQ, bytes(4)))[0]
    return unread
