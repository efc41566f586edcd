"""Encodes the newest states of a running scene for any number of viewers, each state once.

The records that a viewer receives, joined in order, are a compact file.
"""

from __future__ import annotations

import secrets
from operator import itemgetter

from scas4d_core.compact.encoder import FrameEncoder
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.records import RecordKind, parse_head, record_bytes
from scas4d_core.gaussians import Gaussians


class LiveEncoder:
    """Encoder of the newest states of a scene.

    It keeps the newborn Gaussians of all frames, and the states since the last key frame.

    Args:
        head: header of the records.

    Attributes:
        name: random name of this encoder; states of different encoders cannot continue each other.

    >>> import numpy as np
    >>> from scas4d_core.cameras import WorldFrame
    >>> state = Gaussians.of_points(np.random.default_rng(0).normal(size=(300, 3)), radius=0.1)
    >>> encoder = LiveEncoder(FileHeader(WorldFrame(np.zeros(3))))
    >>> encoder.add(0, 0.0, state)
    >>> encoder.add(1, 0.1, state.replace(means=state.means + np.float32([0, 0, 1])))
    >>> len(encoder.records_after(None)) > 10 * len(encoder.records_after(0))
    True
    """

    def __init__(self, head: FileHeader) -> None:
        self.name = secrets.token_hex(4)
        self._head = record_bytes(RecordKind.HEAD, head.text())
        self._encoder = FrameEncoder(head, "live states")
        self._births: list[tuple[int, bytes]] = []
        self._states: list[tuple[int, bytes]] = []

    @property
    def last_frame(self) -> int:
        """Index of the last frame, or −1 if there is none."""
        return self._encoder.last_frame

    def add(self, index: int, time: float, state: Gaussians) -> None:
        """Encodes the state of a frame.

        Args:
            index: frame index, greater than all previous ones.
            time: time in seconds.
            state: Gaussians of the previous frame in the same order, followed by newborn ones with new ids.

        Raises:
            FileError: if the frame cannot follow the previous frames.
        """
        records, _ = self._encoder.encode(index, time, state)
        for record in records:
            kind = parse_head(record, 0, self.name).kind
            if kind is RecordKind.KEY:
                self._states.clear()
            (self._births if kind is RecordKind.BORN else self._states).append((index, record))

    def records_after(self, frame: int | None) -> bytes:
        """Returns the records that a viewer needs to decode the last state.

        Args:
            frame: last state of this encoder that the viewer has, or None for a new viewer, which gets the header
                first. A viewer without the last key frame gets that key frame and the states after it.
        """
        known = -1 if frame is None else frame
        in_order = sorted((*self._births, *self._states), key=itemgetter(0))  # stable: births before the state
        records = [record for index, record in in_order if index > known]
        return b"".join([self._head, *records] if frame is None else records)
