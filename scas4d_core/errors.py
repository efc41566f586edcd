"""Errors that state a problem and its remedy, and error messages without local paths. No third-party dependencies."""

from __future__ import annotations

import os
import re

_PATH = re.compile(r"(?<![\w.:/])/(?:[^\s'\"<>|:;,()\[\]]+/)*[^\s'\"<>|:;,()\[\]/]*")
"""Matches an absolute path within a sentence. URLs such as ``http://…`` do not match because they do not begin with a
slash.
"""


class InputError(ValueError):
    """Raised for unusable input; the message is "fault; remedy".

    Attributes:
        fault: description of the problem, including the value.
        remedy: what to provide instead; may be empty.
    """

    def __init__(self, fault: str, remedy: str = "") -> None:
        super().__init__(f"{fault}; {remedy}" if remedy else fault)
        self.fault, self.remedy = fault, remedy


def without_paths(text: str) -> str:
    """Shortens each absolute path on this machine to its last component; URL paths such as ``/v1/scenes`` are kept.

    >>> without_paths("cannot read /usr/share/scenes/a.npz of /v1/scenes/a")
    'cannot read a.npz of /v1/scenes/a'
    """
    return _PATH.sub(_last_part, text)


def message_of(error: BaseException) -> str:
    """Returns an error's message without paths, or only the system's error text for an ``OSError``.

    >>> message_of(OSError(28, "No space left on device", "/usr/share/a.npz"))
    'No space left on device'
    >>> message_of(KeyError())
    'KeyError'
    """
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return without_paths(str(error)) or type(error).__name__


def _last_part(found: re.Match[str]) -> str:
    path = found[0]
    first = path.split("/", 2)[1]
    if not first or not os.path.isdir(f"/{first}"):
        return path
    return path.rstrip("/").rsplit("/", 1)[-1]


class StepError(ValueError):
    """Raised if a frame cannot be processed; the state is unchanged."""
