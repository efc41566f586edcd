"""Part labels of a scene, stored next to the states so that each part keeps its label over time.

A part is a group of Gaussians that move together. There is one file per requested number of parts.
If a file is lost or damaged, the labels are recomputed and the parts are renumbered by size.
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
    """Returns labels that are truncated or extended to `count` Gaussians.

    Gaussians without a label get the label -1. New Gaussians are always appended to the existing
    ones, so the labels of the existing Gaussians keep their positions.
    """
    return np.concatenate([labels, np.full(max(0, count - len(labels)), -1, labels.dtype)])[:count]


@dataclass(frozen=True, eq=False)
class StoredLabels:
    """Part labels [N] and the index of the newest frame used to compute them."""

    labels: NDArray[np.int64]
    frame: int


class PartLabels:
    """Part labels of one scene for each requested number of parts.

    The number None stands for a number of parts that is chosen automatically.

    Args:
        folder: folder of the label files; created on demand.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[int | None, StoredLabels] = {}

    def of(self, reader: CommittedScene, history: History, count: int | None) -> NDArray[np.int64]:
        """Returns the part label of each Gaussian [N], computed from all committed states.

        The labels are recomputed only after a new frame has been committed.

        Raises:
            ValueError: see ``CommittedScene.parts``.
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
            log.warning("cannot read %s (%s); renumbering the parts", file, error)
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
        except OSError as error:  # a full disk must not fail the query; only the numbering after a restart is lost
            log.warning("cannot write %s (%s); parts will be renumbered after a restart", file, error)
            with contextlib.suppress(OSError):
                beside.unlink()
