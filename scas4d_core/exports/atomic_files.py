"""Writes files atomically, and imports packages that only some exports need.

This module itself requires only the standard library.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from scas4d_core.errors import InputError, message_of


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path next to ``path``. The file is renamed to ``path`` on success and deleted on error.

    The temporary name keeps the suffix, because some libraries infer the format from it.

    Raises:
        InputError: if the folder or the file cannot be written, or the disk is full.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with atomic_path(f"{folder}/a.txt") as beside:
    ...         written = beside.write_text("whole")
    ...     [file.name for file in Path(folder).iterdir()]
    ['a.txt']
    """
    target = Path(path)
    beside = _beside(target)
    try:
        with translate_write_errors(target):
            yield beside
            beside.replace(target)
    finally:
        with suppress(OSError):  # do not mask the original error
            beside.unlink(missing_ok=True)


class AtomicWriter:
    """Base class of writers whose file appears under its final name once it is complete.

    Args:
        path: path of the file; an existing file is replaced.

    Attributes:
        path: same as the argument.

    Raises:
        InputError: if the folder or the file cannot be written.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        with ExitStack() as stack:
            self._open(stack, stack.enter_context(atomic_path(self.path)))
            self._stack = stack.pop_all()

    def _open(self, stack: ExitStack, beside: Path) -> None:
        """Opens the temporary file ``beside``, and whatever else ``stack`` must close."""
        raise NotImplementedError

    def finish(self) -> None:
        """Completes the file and renames it to its final name."""
        self._stack.close()

    def discard(self) -> None:
        """Deletes the incomplete file."""
        self._stack.__exit__(Exception, Exception("discarded"), None)


def check_writable(path: Path | str) -> None:
    """Creates and removes a file next to ``path``, so that a long export to an unwritable folder fails early.

    Raises:
        InputError: if the folder is not writable.

    >>> check_writable("no_such_folder/a.glb")
    Traceback (most recent call last):
    scas4d_core.errors.InputError: out 'no_such_folder/a.glb' cannot be written (...); use a path in an ...
    """
    target = Path(path)
    with translate_write_errors(target):
        beside = _beside(target)
        beside.touch()
        beside.unlink()


def _beside(target: Path) -> Path:
    return target.with_name(f".part{os.getpid()}-{target.name}")


@contextmanager
def translate_write_errors(path: Path | str) -> Iterator[None]:
    """Converts an ``OSError`` during writing to an ``InputError`` that names the output file."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"out {str(path)!r} cannot be written ({message_of(error)})",
            "use a path in an existing, writable folder on a disk with free space",
        ) from error


def import_optional(name: str, export: str) -> Any:
    """Imports a module that only some exports need, and returns it.

    Args:
        name: name of the module.
        export: name of the export format, for the error message.

    Raises:
        InputError: if the package is not installed; the message includes the command that installs it.

    >>> import_optional("no_such_package", "usd")
    Traceback (most recent call last):
    scas4d_core.errors.InputError: format 'usd' requires the package no_such_package, which is not installed; ...
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"format {export!r} requires the package {name}, which is not installed",
            "run pip install -e '.[exports]' in the project folder",
        ) from error
