"""Writes a sequence as a compact 4D file (``scas4d_core.compact``), which preserves the ids and the moving flags."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from scas4d_core.cameras import Rig, WorldFrame
from scas4d_core.compact import CompactWriter, FileError, FileHeader
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import AtomicWriter, translate_write_errors
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.part_motion import part_labels

Colour = tuple[float, float, float]


class CompactSequence(AtomicWriter):
    """Writer of a compact 4D file, frame by frame. ``finish`` gives the file its final name.

    Args:
        path: path of the file; an existing file is replaced.
        world: transform from the user's world to the internal world.
        rig: rig in the user's world, or None.
        labels: [N] part label of each Gaussian (negative for none), or None to store no parts.
        frames_per_second: nominal frame rate, or None.
        background: background colour, RGB in [0, 1].

    Raises:
        InputError: if the file cannot be written.

    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from scas4d_core.compact import CompactReader
    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     sequence = CompactSequence(f"{folder}/a.s4d", WorldFrame(np.zeros(3)), labels=np.array([0, 1]))
    ...     sequence.add(7, 0.5, state)
    ...     sequence.finish()
    ...     with CompactReader(f"{folder}/a.s4d") as reader:
    ...         list(reader.frames), reader.parts()
    ([7], array([0, 1]))
    """

    def __init__(
        self,
        path: Path | str,
        world: WorldFrame,
        rig: Rig | None = None,
        labels: NDArray[Any] | None = None,
        frames_per_second: float | None = None,
        background: Colour = (0.0, 0.0, 0.0),
    ) -> None:
        self._head = FileHeader(world, background=background, rig=rig, frames_per_second=frames_per_second)
        self._labels = labels
        self._latest = -1
        self._count = 0
        super().__init__(path)

    def _open(self, stack: ExitStack, beside: Path) -> None:
        self._writer = stack.enter_context(CompactWriter(beside, self._head))

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame, given its index, its time in seconds, and its state in the internal world.

        Raises:
            InputError: if the frame cannot follow the previous frames, has non-finite values, or
                cannot be written.
        """
        with translate_write_errors(self.path):
            try:
                self._writer.add(index, time, gaussians)
            except FileError as error:
                fault, _, remedy = str(error).partition("; ")
                raise InputError(fault, remedy) from error
        self._latest, self._count = index, len(gaussians)

    def finish(self) -> None:
        """Completes the file and renames it to its final name."""
        if self._labels is not None and self._count:
            with translate_write_errors(self.path):
                self._writer.add_parts(self._latest, part_labels(self._labels, self._count))
        super().finish()
