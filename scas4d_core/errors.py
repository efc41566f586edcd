"""Errors that state a problem and its remedy, and error messages without local paths.

This module requires only the standard library.
"""

from __future__ import annotations

import os
import re

_PATH = re.compile(r"(?<![\w.:/])/(?:[^\s'\"<>|:;,()\[\]]+/)*[^\s'\"<>|:;,()\[\]/]*")
"""Matches an absolute path within a sentence. URLs such as ``http://…`` do not match because they do not begin with a
slash.
"""


class InputError(ValueError):
    """Raised if input is unusable. The message has the form "fault; remedy".

    Attributes:
        fault: description of the problem, including the rejected value.
        remedy: description of the input to provide instead; may be empty.
    """

    def __init__(self, fault: str, remedy: str = "") -> None:
        super().__init__(f"{fault}; {remedy}" if remedy else fault)
        self.fault, self.remedy = fault, remedy


def exact(number: float) -> str:
    """Returns a number in the shortest decimal form that gives the same number when it is entered.

    >>> exact(30.0), exact(1e-05), exact(1048576), exact(1764363600.25)
    ('30', '1e-05', '1048576', '1764363600.25')
    """
    short = f"{number:g}"
    if float(short) == number and "e+" not in short:
        return short
    return repr(number).removesuffix(".0")


def without_paths(text: str) -> str:
    """Replaces each absolute path in a text by the last component of the path.

    A path counts as a local path if its first component is a folder of this machine. Other paths,
    such as the URL path ``/v1/scenes``, are kept.

    >>> without_paths("cannot read /usr/share/scenes/a.npz of /v1/scenes/a")
    'cannot read a.npz of /v1/scenes/a'
    """
    return _PATH.sub(_last_part, text)


def message_of(error: BaseException) -> str:
    """Returns the message of an error without local paths.

    For an ``OSError``, the result is the error text of the operating system. For an error without a
    message, the result is the name of its class.

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
    """Raised if a frame cannot be processed. The state of the scene does not change."""
