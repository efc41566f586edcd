"""Part labels of a scene by number of parts, kept beside the states so that a part keeps its label.

They are a derived thing: a lost or damaged file means that labels are numbered anew, by size.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.storage.history import History

if TYPE_CHECKING:
    from scas4d_core.query.committed import CommittedScene

log = logging.getLogger("scas4d.renderer")


def resize_labels(labels: NDArray[Any], count: int) -> NDArray[Any]:
    """Returns labels for so many Gaussians: those born since have none, and rows only ever come at the end."""
    return np.concatenate([labels, np.full(max(0, count - len(labels)), -1, labels.dtype)])[:count]


@dataclass(frozen=True, eq=False)
class StoredLabels:
    """Labels [N] and the newest frame that they were found from."""

    labels: NDArray[np.int64]
    frame: int


class PartLabels:
    """The labels of one scene by count; None is the count that is chosen.

    Args:
        folder: where they are kept; made when needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[int | None, StoredLabels] = {}

    def of(self, reader: CommittedScene, history: History, count: int | None) -> NDArray[np.int64]:
        """Returns [N] labels from all committed states; they are computed once for each newest frame.

        Raises:
            ValueError: as ``CommittedScene.parts``.
        """
        newest = history.indices[-1]
        known = self._known.get(count) or self._read(count)
        if known is None or known.frame != newest:
            before = None
            if known is not None and len(known.labels) == np.count_nonzero(history.born_at <= known.frame):
                before = resize_labels(known.labels, history.count)
            known = StoredLabels(reader.parts(count, before), newest)
            self._write(count, known)
        self._known[count] = known
        return known.labels

    def _file(self, count: int | None) -> Path:
        return self._folder / f"{'chosen' if count is None else count}.npz"

    def _read(self, count: int | None) -> StoredLabels | None:
        file = self._file(count)
        try:
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
                return StoredLabels(arrays["labels"].astype(np.int64), int(arrays["frame"]))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            log.warning("%s cannot be read (%s): parts get new numbers", file, error)
            return None

    def _write(self, count: int | None, known: StoredLabels) -> None:
        arrays: dict[str, Any] = {"labels": known.labels.astype(np.int16), "frame": np.int64(known.frame)}
        file = self._file(count)
        beside = file.with_name(f".{file.name}.{secrets.token_hex(4)}.part")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with beside.open("wb") as opened:
                np.savez(opened, **arrays)
            beside.replace(file)
        except OSError as error:  # a full disk costs the numbering after a restart, not the answer
            log.warning("%s cannot be written (%s): after a restart parts get new numbers", file, error)
            with contextlib.suppress(OSError):
                beside.unlink()
