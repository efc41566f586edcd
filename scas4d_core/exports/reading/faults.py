"""Converts exceptions from damaged, truncated or foreign files to one-sentence errors that name the file."""

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
"""Exceptions that a malicious or damaged export can cause, because numbers in the file control offsets and sizes."""


@contextmanager
def translate_read_errors(name: str) -> Iterator[None]:
    """Converts exceptions raised while reading a file to an ``InputError``.

    Args:
        name: name of the file, used in the error message.

    Raises:
        InputError: if the file cannot be read.

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
