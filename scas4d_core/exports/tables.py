"""Writes tracks and part poses as CSV for spreadsheets and scripts, in the user's world, axes and units.

Times are in seconds. Rows are ordered by frame; a Gaussian or part that is absent from a frame has no row for that
frame. Coordinates have 12 significant digits, because the world's origin may be far away.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.exports.atomic_files import AtomicWriter, translate_write_errors
from scas4d_core.exports.track_rows import check_ids_found
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.part_motion import PartMotion


class _Table(AtomicWriter):
    """A CSV file that is written incrementally under a temporary name."""

    columns: Sequence[str]

    def _open(self, stack: ExitStack, beside: Path) -> None:
        file = stack.enter_context(beside.open("w", newline="", encoding="utf-8"))
        self._rows = csv.writer(file, lineterminator="\n")
        self._rows.writerow(self.columns)

    def write(self, rows: Iterable[Sequence[Any]]) -> None:
        with translate_write_errors(self.path):
            self._rows.writerows(rows)


class TrackTable(_Table):
    """CSV table of the means of Gaussians, written frame by frame.

    The column ``confidence`` is empty, because states have no confidence.

    Args:
        path: path of the file.
        world: transform from the user's world to the internal world.
        ids: ids of the Gaussians to write, or None for the Gaussians that move in each frame.

    Raises:
        InputError: if the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     table = TrackTable(f"{folder}/a.csv", WorldFrame(np.zeros(3)))
    ...     table.add(7, 0.5, Gaussians.of_points([[0, 0, 2]], radius=0.1))
    ...     table.finish()
    ...     print(Path(f"{folder}/a.csv").read_text(), end="")
    frame,time,id,x,y,z,confidence
    7,0.5,0,0,0,2,
    """

    columns = ("frame", "time", "id", "x", "y", "z", "confidence")

    def __init__(self, path: Path | str, world: WorldFrame, ids: ArrayLike | None = None) -> None:
        super().__init__(path)
        self._world = world
        self._ids = None if ids is None else np.unique(np.asarray(ids, np.int64))
        self._found = np.zeros(0 if self._ids is None else len(self._ids), np.bool_)

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame, given its index, its time in seconds, and its state in the internal world."""
        chosen = gaussians.moving if self._ids is None else gaussians.present & np.isin(gaussians.ids, self._ids)
        if self._ids is not None:
            self._found |= np.isin(self._ids, gaussians.ids)
        ids = gaussians.ids[chosen].tolist()
        means = self._world.to_user(gaussians.means[chosen])
        self.write(
            (index, _text(time, 15), identity, *map(_text, mean), "") for identity, mean in zip(ids, means, strict=True)
        )

    def finish(self) -> None:
        """Renames the file to its final name.

        Raises:
            InputError: if one of the given ids is in no frame.
        """
        if self._ids is not None:
            check_ids_found(self._ids, self._found)
        super().finish()


class PoseTable(_Table):
    """CSV table of the rigid motion of parts since the first frame, written frame by frame.

    A point of a part at x in the first frame is at R (x − t₀) + t in a later frame, both in the user's world. Here, t
    is (tx, ty, tz), R is the rotation of the unit quaternion (qw, qx, qy, qz), and t₀ is t in the first frame.
    ``residual`` is the weighted RMS distance between this prediction and the means of the part's Gaussians, in the
    user's units.

    Args:
        path: path of the file.
        world: transform from the user's world to the internal world.
        labels: [N] part label of each Gaussian, negative for none.

    Raises:
        InputError: if the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> state = Gaussians.of_points([[0, 0, 2], [0, 0, 4]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     table = PoseTable(f"{folder}/a.csv", WorldFrame(np.zeros(3)), np.zeros(2, int))
    ...     table.add(0, 0.0, state)
    ...     table.finish()
    ...     print(Path(f"{folder}/a.csv").read_text(), end="")
    frame,time,part,tx,ty,tz,qw,qx,qy,qz,residual
    0,0,0,0,0,3,1,0,0,0,0
    """

    columns = ("frame", "time", "part", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "residual")

    def __init__(self, path: Path | str, world: WorldFrame, labels: NDArray[Any]) -> None:
        super().__init__(path)
        self._world, self._labels = world, labels
        self._motion: PartMotion | None = None

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame, given its index, its time in seconds, and its state in the internal world.

        Raises:
            InputError: if no Gaussian of the first frame belongs to a part.
        """
        if self._motion is None:
            self._motion = PartMotion(self._labels, gaussians, self._world)
        self.write(
            (index, _text(time, 15), pose.part, *map(_text, (*pose.position, *pose.quaternion, pose.residual)))
            for pose in self._motion.poses(gaussians)
        )


def _text(value: float, digits: int = 12) -> str:
    """Formats a number with ``digits`` significant digits; −0 becomes 0."""
    return f"{value:.{digits}g}" if value else "0"
