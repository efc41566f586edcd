"""Errors of a history: frames that cannot be appended or read, damaged files, and unsupported formats."""

from __future__ import annotations


class HistoryError(ValueError):
    """Raised if a history cannot be extended or read. The message names the frame or file and the problem."""


class OtherFormatError(HistoryError):
    """Raised if files have an unsupported format. The files are left unchanged."""


class UnreadableFrameError(HistoryError):
    """Raised if a frame is not in the history, or its file is damaged."""


class DamagedFrameError(UnreadableFrameError):
    """Raised if the file of a frame is damaged rather than deleted."""


def other_format(what: str, written: int | None, read: int) -> OtherFormatError:
    """Returns the error for files of an unsupported format.

    Args:
        what: description of the files.
        written: format of the files, or None if they do not specify one.
        read: supported format.

    >>> str(other_format("state folder a", 3, 1))[:54]
    'state folder a has format 3, but this version of scas4'
    """
    known = "has no format number" if written is None else f"has format {written}"
    return OtherFormatError(
        f"{what} {known}, but this version of scas4d reads format {read}; "
        "use the version that wrote it, or reconstruct the scene again from its images"
    )
