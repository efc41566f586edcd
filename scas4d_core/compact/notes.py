"""Notes on frames: JSON, which says beside a state how it came about."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from scas4d_core.compact.planes import PlaneError, deflated, inflated

COUNT_BYTES = 4
LONGEST = 1 << 24
"""Bytes of a note's text at most: what a damaged file asks for must not fill the memory."""


def note_bytes(note: Mapping[str, Any]) -> bytes:
    """The body of a note: u32 bytes of the text, then the text as a zstandard frame.

    Args:
        note: JSON values.

    Raises:
        ValueError: it is no JSON, or longer than 16 MB.

    >>> read_note(note_bytes({"psnr": 36.5}))
    {'psnr': 36.5}
    """
    text = json.dumps(dict(note), allow_nan=False).encode()
    if len(text) > LONGEST:
        raise ValueError(f"a note of {len(text)} bytes is too long; {LONGEST} are the most")
    return len(text).to_bytes(COUNT_BYTES, "little") + deflated(text)


def read_note(body: bytes) -> dict[str, Any]:
    """The note in a body.

    Raises:
        PlaneError: there is none.
    """
    size = int.from_bytes(body[:COUNT_BYTES], "little")
    if len(body) <= COUNT_BYTES or size > LONGEST:
        raise PlaneError(f"a note of {size} bytes in {len(body)}")
    try:
        note = json.loads(inflated(body[COUNT_BYTES:], size))
    except (ValueError, RecursionError) as error:
        raise PlaneError(f"the note is no JSON ({error})") from None
    if not isinstance(note, dict):
        raise PlaneError("the note is no JSON object")
    return note
