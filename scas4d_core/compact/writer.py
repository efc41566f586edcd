"""Writes a compact file, frame by frame; what is written can be read at once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.birth_code import encode_born
from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.frame_code import encode, errors_of
from scas4d_core.compact.head import Head
from scas4d_core.compact.index import footer, index_body
from scas4d_core.compact.planes import pack
from scas4d_core.compact.records import FileError, Kind, Record, parse_head, record_bytes
from scas4d_core.gaussians import Gaussians

KEY_EVERY = 8
"""Frames from a key to the next: a reader decodes at most so many for one."""


class CompactWriter:
    """Writes the states of a scene to a new file.

    Args:
        path: of the file, which must not exist. head: what holds for all frames. key_every: frames from key to key.

    Attributes:
        errors: the largest error of each attribute so far, in the units of ``Bounds``.

    Raises:
        FileExistsError: the file exists.

    >>> from tempfile import TemporaryDirectory
    >>> from scas4d_core.cameras import WorldFrame
    >>> from scas4d_core.compact import CompactReader
    >>> state = Gaussians.of_points(np.random.default_rng(0).normal(size=(300, 3)), radius=0.1)
    >>> moved = state.replace(means=state.means + np.float32([0, 0, 1]))
    >>> with TemporaryDirectory() as folder:
    ...     with CompactWriter(f"{folder}/a.s4d", Head(WorldFrame(np.zeros(3)))) as writer:
    ...         errors = [writer.add(index, 0.1 * index, each) for index, each in enumerate((state, moved))]
    ...     with CompactReader(f"{folder}/a.s4d") as reader:
    ...         found = reader.state(1).means - reader.state(0).means
    >>> found.mean(axis=0).round(2)[2]
    np.float32(1.0)
    """

    def __init__(self, path: Path | str, head: Head, key_every: int = KEY_EVERY) -> None:
        if key_every < 1:
            raise FileError(f"key_every is {key_every}; give 1 or more")
        self.path = Path(path)
        self.head = head
        self.errors: dict[str, float] = {}
        self._key_every = key_every
        self._file: BinaryIO = self.path.open("xb")
        self._records: list[Record] = []
        self._born: Columns | None = None
        self._clusters = Clusters(np.zeros(0, np.int64))
        self._last: Columns | None = None
        self._since_key = 0
        self._append(record_bytes(Kind.HEAD, head.text()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()

    def add(self, index: int, time: float, state: Gaussians) -> Mapping[str, float]:
        """Writes the state of a frame; returns its largest error by attribute.

        Args:
            index: above that of every frame before. time: seconds. state: the Gaussians of the frame before, in their
                order, and after them those that are born in this one, with their ids.

        Raises:
            FileError: the frame cannot follow those before.
        """
        last = self._records[-1].frame
        if index <= last:
            raise FileError(f"{self.path.name}: frame {index} cannot follow frame {last}; add frames in rising order")
        known = 0 if self._born is None else len(self._born)
        if len(state) < known or (self._born is not None and not np.array_equal(state.ids[:known], self._born.ids)):
            raise FileError(
                f"{self.path.name}: frame {index} has other Gaussians than frame {last}; they are never removed"
            )
        if not len(state):
            raise FileError(f"{self.path.name}: frame {index} has no Gaussian; begin with a frame that has some")
        for name in ("means", "factors", "rotations", "colours"):
            wrong = np.flatnonzero(~np.isfinite(getattr(state, name)).reshape(len(state), -1).all(axis=1))
            if len(wrong):
                raise FileError(
                    f"{self.path.name}: frame {index}: {len(wrong)} Gaussians have {name} that are not finite, rows "
                    f"{wrong[:5].tolist()}; leave the frame out, or mend them"
                )
        first = self._born is None
        if len(state) > known:
            self._bear(index, time, state, known)
        born, before = self._born, self._last
        assert born is not None
        if before is not None and len(before) < len(born):
            before = before.joined(born.after(len(before)))
        self._since_key += 1
        key = before is None or self._since_key >= self._key_every
        reference = born if key or before is None else before
        if first:  # the state that was just told
            self._last, self._since_key = born, 0
            return self._noted(errors_of(born, Columns.of(state)))
        coded = encode(reference, Columns.of(state), self._clusters, self.head.bounds)
        if key:
            self._since_key = 0
        self._append(record_bytes(Kind.KEY if key else Kind.DELTA, coded.body, index, time))
        self._last = coded.decoded
        return self._noted(coded.errors)

    def add_parts(self, index: int, labels: NDArray[np.integer]) -> None:
        """Writes the part of each Gaussian, as it is seen from a frame on.

        Args:
            labels: [N], −1 for none.
        """
        values = np.asarray(labels, np.int64)
        self._append(record_bytes(Kind.PARTS, len(values).to_bytes(4, "little") + pack(values + 1), index))

    def close(self) -> None:
        """Writes the index. A file without it is read all the same, after a look at each record."""
        if self._file.closed:
            return
        body = index_body(self._records, json.dumps({"errors": self.errors}).encode())
        offset = self._file.tell()
        self._file.write(record_bytes(Kind.INDEX, body) + footer(offset))
        self._file.close()

    def _bear(self, index: int, time: float, state: Gaussians, known: int) -> None:
        """Writes the Gaussians that are not known yet."""
        born = state.rows(np.arange(known, len(state)))
        if self._born is None:
            clusters = Clusters.of(state)
        else:
            clusters = Clusters(self._clusters.nearest(self._born, born))
            born = born.replace(gloss=None, environment=None)  # those born later are dull
        body, decoded = encode_born(Columns.of(born), clusters, self.head.bounds)
        self._append(record_bytes(Kind.BORN, len(born).to_bytes(4, "little") + body, index, time))
        self._born = decoded if self._born is None else self._born.joined(decoded)
        self._clusters = clusters if not known else self._clusters.joined(clusters.labels)

    def _noted(self, errors: Mapping[str, float]) -> Mapping[str, float]:
        for name, value in errors.items():
            self.errors[name] = max(value, self.errors.get(name, 0.0))
        return errors

    def _append(self, data: bytes) -> None:
        offset = self._file.tell()
        self._file.write(data)
        self._file.flush()
        self._records.append(parse_head(data, 0, self.path.name).at(offset))
