"""Encodes the states of a scene as records of a compact file, one frame after the other, without a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.birth_code import encode_born
from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.encoder_state import EncoderState
from scas4d_core.compact.frame_code import encode, errors_of
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.records import (
    FileError,
    Record,
    RecordKind,
    checksum_bytes,
    note_bytes,
    parse_head,
    record_bytes,
)
from scas4d_core.gaussians import Gaussians

ERRORS = "errors"
"""Key under which a note stores the largest errors of its frame."""
KEY_EVERY = 8
"""Interval between key frames, and thus the maximum number of states decoded to access one frame."""


class FrameEncoder:
    """Encoder of the states of a scene, one frame after the other.

    Args:
        head: header of the file.
        name: name of the file, used in error messages.
        key_every: interval between key frames.
        clustered: see ``CompactWriter``.

    Raises:
        FileError: if ``key_every`` is less than 1.
    """

    def __init__(self, head: FileHeader, name: str, key_every: int = KEY_EVERY, *, clustered: bool = True) -> None:
        if key_every < 1:
            raise FileError(f"key_every must be at least 1; got {key_every}")
        self.head = head
        self._name = name
        self._key_every = key_every
        self._clustered = clustered
        self._born: Columns | None = None
        self._clusters = Clusters(np.zeros(0, np.int64))
        self._last: Columns | None = None
        self._since_key = 0
        self._opacities: NDArray[np.float32] | None = None
        """Exact opacities of all Gaussians so far, or None if unknown."""
        self._record = Record(RecordKind.HEAD, -1, 0.0, 0, 0, 0)
        """The record of the last state."""

    @classmethod
    def resume(cls, state: EncoderState, name: str, key_every: int = KEY_EVERY) -> FrameEncoder:
        """Resumes encoding after the last state of a file."""
        encoder = cls(state.head, name, key_every)
        encoder._record, encoder._since_key = state.record, state.since_key
        encoder._born, encoder._clusters, encoder._last = state.born, state.clusters, state.state
        return encoder

    @property
    def last_frame(self) -> int:
        """Index of the last frame, or −1 if there is none."""
        return self._record.frame

    @property
    def count(self) -> int:
        """Number of Gaussians so far."""
        return 0 if self._born is None else len(self._born)

    def encode(
        self, index: int, time: float, state: Gaussians, note: Mapping[str, Any] | None = None
    ) -> tuple[list[bytes], Mapping[str, float]]:
        """Encodes the state of a frame; returns its records in order, and the largest error of each attribute.

        See ``CompactWriter.add`` for the arguments and errors.
        """
        self._check(index, state)
        note_bytes(note or {})
        columns, before = Columns.of(state), self._last
        self._opacities = columns.opacities.copy() if self._opacities is None else self._opacities
        records = (
            [] if before is not None and len(state) == len(before) else [(RecordKind.BORN, self._add_newborn(columns))]
        )
        born = self._born
        assert born is not None
        if before is None:
            decoded = born
            errors: Mapping[str, float] = errors_of(born, columns)
        else:
            if len(before) < len(born):
                before = before.concatenate(born.from_row(len(before)))
            key = self._since_key + 1 >= self._key_every
            self._since_key = 0 if key else self._since_key + 1
            coded = encode(born if key else before, columns, self._clusters, self.head.bounds)
            reference = (
                b"" if key else checksum_bytes(self._record)
            )  # lets a reader detect a mismatched reference state
            records.append((RecordKind.KEY if key else RecordKind.DELTA, reference + coded.body))
            decoded, errors = coded.decoded, coded.errors
        if note is not None:
            records.insert(0, (RecordKind.NOTE, note_bytes({**note, ERRORS: dict(errors)})))
        encoded = [record_bytes(kind, body, index, time) for kind, body in records]
        self._record, self._last = parse_head(encoded[-1], 0, self._name), decoded
        return encoded, errors

    def _check(self, index: int, state: Gaussians) -> None:
        """Rejects a state that cannot follow the previous ones, before anything is written."""
        last, name = self._record.frame, self._name
        if index <= last:
            raise FileError(f"{name}: frame {index} cannot follow frame {last}; add frames in ascending order")
        if not len(state):
            raise FileError(f"{name}: frame {index} has no Gaussians; start with a frame that contains Gaussians")
        if (born := self._born) is not None:
            known = len(born)
            if len(state) < known or not np.array_equal(state.ids[:known], born.ids):
                raise FileError(f"{name}: frame {index} lacks Gaussians of frame {last}; do not remove or reorder any")
            if self._opacities is not None and not np.array_equal(state.own_opacities[:known], self._opacities):
                raise FileError(f"{name}: frame {index} changes opacities from frame {last}; they are fixed at birth")
            if _glossy(state.gloss) != (0 if born.gloss is None else born.gloss.shape[1]):
                raise FileError(
                    f"{name}: frame {index} has gloss for {_glossy(state.gloss)} Gaussians, unlike the first frame"
                )
        for field in ("means", "factors", "rotations", "colours", "own_opacities", "gloss"):
            if (array := getattr(state, field)) is None or np.isfinite(array).all():
                continue
            wrong = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))
            raise FileError(
                f"{name}: frame {index}: {len(wrong)} Gaussians have non-finite {field}, rows "
                f"{wrong[:5].tolist()}; omit the frame, or fix these Gaussians"
            )

    def _add_newborn(self, state: Columns) -> bytes:
        """Registers the newborn Gaussians of a state; returns the body of their birth record."""
        if self._last is None:
            born = state
            clusters = Clusters.of(state.gaussians()) if self._clustered else Clusters(np.zeros(len(state), np.int64))
        else:
            born = state.from_row(len(self._last))
            clusters = Clusters(self._clusters.nearest(self._last, born))
        body, decoded = encode_born(born, clusters, self.head.bounds)
        self._born = decoded if self._born is None else self._born.concatenate(decoded)
        self._clusters = self._clusters.concatenate(clusters.labels)
        self._opacities = state.opacities.copy()
        return len(born).to_bytes(4, "little") + body


def _glossy(gloss: NDArray[np.float32] | None) -> int:
    return 0 if gloss is None else len(gloss)
