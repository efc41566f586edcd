"""Errors of a history: what cannot be extended or read, what is damaged, and what is of another format."""

from __future__ import annotations


class HistoryError(ValueError):
    """A history that cannot be extended or read; the message names the frame or file, the fault and the remedy."""


class OtherFormatError(HistoryError):
    """Files of another format than this scas4d reads; they stay as they are."""


class UnreadableFrameError(HistoryError):
    """A frame that is not in the history, or whose file is damaged."""


class DamagedFrameError(UnreadableFrameError):
    """A frame whose file is damaged, in contrast to one that was deleted."""


def other_format(what: str, written: int | None, read: int) -> OtherFormatError:
    """The refusal of files of another format.

    Args:
        what: is of that format. written: it, None where the files name none. read: the format that is read.

    >>> str(other_format("states, a folder,", 3, 1))[:54]
    'states, a folder, has format 3; this scas4d reads form'
    """
    known = "names no format" if written is None else f"has format {written}"
    return OtherFormatError(
        f"{what} {known}; this scas4d reads format {read}: "
        "use the scas4d that wrote it, or reconstruct the scene again from its pictures"
    )
