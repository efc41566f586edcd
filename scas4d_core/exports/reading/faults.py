"""Errors of files that are damaged, cut, or none of ours: they end as one sentence with the file's name."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

from scas4d_core.errors import InputError, message_of

FAULTS = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, MemoryError, OSError, EOFError,
    struct.error, zipfile.BadZipFile,
)  # fmt: skip
"""Exceptions that reading a hostile or damaged export can raise: its own numbers say where to read, and how much."""


@contextmanager
def translate_read_errors(name: str) -> Iterator[None]:
    """Takes what goes wrong for a fault of the file.

    Args:
        name: of the file, for the message.

    Raises:
        InputError: it cannot be read.

    >>> with translate_read_errors("a.glb"):
    ...     {}["accessors"]
    Traceback (most recent call last):
    scas4d_core.errors.InputError: a.glb cannot be read (KeyError: 'accessors'); export it again
    """
    try:
        yield
    except InputError:
        raise
    except FAULTS as error:
        raise InputError(
            f"{name} cannot be read ({type(error).__name__}: {message_of(error)})", "export it again"
        ) from None
