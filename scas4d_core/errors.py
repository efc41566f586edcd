"""Errors with a fault and a remedy, and error messages without local paths. Standard library only."""

from __future__ import annotations

import os
import re

_PATH = re.compile(r"(?<![\w.:/])/(?:[^\s'\"<>|:;,()\[\]]+/)*[^\s'\"<>|:;,()\[\]/]*")
"""Matches an absolute path within a sentence. URLs such as ``http://…`` do not match because they do not begin with a
slash.
"""


class InputError(ValueError):
    """An unusable input. The message is "fault; remedy".

    Attributes:
        fault: what is wrong, including the value. remedy: what to give instead, or "".
    """

    def __init__(self, fault: str, remedy: str = "") -> None:
        super().__init__(f"{fault}; {remedy}" if remedy else fault)
        self.fault, self.remedy = fault, remedy


def without_paths(text: str) -> str:
    """Shortens each absolute path on this machine to its last component; ``/v1/scenes`` is unchanged.

    >>> without_paths("cannot read /usr/share/scenes/a.npz of /v1/scenes/a")
    'cannot read a.npz of /v1/scenes/a'
    """
    return _PATH.sub(_last_part, text)


def message_of(error: BaseException) -> str:
    """Returns an error's message without paths; an ``OSError`` gives only the system's text.

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
    """A frame that cannot be processed; the state is unchanged."""
