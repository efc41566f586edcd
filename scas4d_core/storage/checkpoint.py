"""What an update needs beside Θ_{t−1}, on disk: a scene whose process died goes on as if nothing had happened.

Beside the frames of a ``History`` lies one ``checkpoint_<index>.npz`` for each of its newest commits. It is written,
synced and renamed *before* the frame's own rename, which is the commit: a committed frame has its checkpoint, and a
checkpoint without its frame is as good as not there. The one before the newest is kept as well, for the case that the
newest state or checkpoint is damaged. What never changes (exposures, whether there are masks) is in the report of the
first frame; clusters and neighbours are built again from the first frame, and a digest says whether they are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.frame import Frame
from scas4d_core.errors import message_of
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.solve_frame import Outcome
from scas4d_core.storage.frame_files import checkpoint_file, checkpoint_of
from scas4d_core.storage.history import NEWEST_KEPT
from scas4d_core.storage.npz import read_npz, write_npz
from scas4d_core.update.views import TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion

FORMAT = 2
"""Of a checkpoint's file; another one is refused."""


class CheckpointError(ValueError):
    """A checkpoint that is missing or damaged: the message names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Carried:
    """What one update leaves to the next beside Θ.

    Attributes:
        motion: that was found, or None where the next update starts cold.
        labels: [N] what has been seen to move, in scenes without masks; None until something has.
        seen: views of the last frame that was believed, in scenes without masks: the next are compared with them.
        structure: digest of the clusters and neighbours that the motion belongs to.
        past: what is usual for the scene and its cameras.
        shown: fingerprint of each picture of the last frame that was believed (``repeats``).
    """

    motion: Motion | None = None
    labels: NDArray[np.bool_] | None = None
    seen: Sequence[TrainingView] = field(default_factory=tuple)
    structure: int = 0
    past: Past = field(default_factory=Past)
    shown: Mapping[str, int] = field(default_factory=dict)

    def after(
        self, outcome: Outcome, time: float, views: Sequence[TrainingView] | None, shown: Mapping[str, int]
    ) -> Carried:
        """What the next frame leaves in turn; of pictures that were not believed nothing is kept.

        Args:
            outcome: of that frame. time: its, seconds.
            views: that it was updated with, or None in scenes with masks. shown: fingerprints of its pictures.
        """
        learnt = outcome.fresh and not outcome.stood
        past = replace(outcome.past, fitted=time) if learnt else outcome.past
        carried = replace(self, motion=outcome.motion, past=past)
        if not outcome.fresh:
            return carried
        if views is not None and outcome.exposure == 1.0:  # what another light changes has not moved
            seen = [view for view in views if view.name not in outcome.updated.left_out]
            carried = replace(carried, seen=seen)
        return replace(carried, shown=shown)


class Checkpoints:
    """The checkpoints in the directory of a history; for the process that appends to it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def save(self, index: int, carried: Carried) -> None:
        """Writes what frame ``index`` leaves to the next; before the frame is committed.

        Without masks that includes the pictures of the frame, 3 bytes a pixel.
        """
        arrays: dict[str, Any] = {"format": np.int64(FORMAT), "structure": np.int64(carried.structure)}
        if carried.motion is not None:
            arrays |= _packed(carried.motion)
        arrays |= {f"past.{name}": array for name, array in carried.past.arrays().items()}
        arrays |= {
            "shown.names": np.array(list(carried.shown), np.str_),
            "shown.prints": np.array(list(carried.shown.values()), np.int64),
        }
        if carried.labels is not None:
            arrays["labels"] = carried.labels
        for view in carried.seen:
            levels = np.rint(255 * view.target[:3]).astype(np.uint8)  # they were 8 bit: exact
            arrays[f"seen.{view.name}"] = np.moveaxis(levels, 0, -1)
        # A name that went missing by damage must not read as something that was never there.
        arrays["names"] = np.array(sorted(arrays))
        write_npz(self._file(index), arrays)

    def load(self, index: int, factory: ViewFactory) -> Carried:
        """What frame ``index`` left.

        Args:
            factory: of the scene; makes views of the pictures.

        Raises:
            CheckpointError: it is not there, damaged, or of another format.
        """
        file = self._file(index)
        try:
            arrays = read_npz(file)
            names = {str(name) for name in arrays.pop("names")}
            missing = names ^ set(arrays)
            if missing:
                raise ValueError(f"{file.name}: {', '.join(sorted(missing))} went missing")
            if int(arrays["format"]) != FORMAT:
                raise ValueError(f"{file.name}: format {int(arrays['format'])}, this version reads {FORMAT}")
            pictures = {name[5:]: array for name, array in arrays.items() if name.startswith("seen.")}
            seen = factory.views(Frame(index, 0.0, pictures, {}), {}, use_masks=False) if pictures else ()
            motion = _unpacked(arrays) if "motion.seconds" in arrays else None
            past = Past.of_arrays({name[5:]: array for name, array in arrays.items() if name.startswith("past.")})
            shown = dict(zip(arrays["shown.names"].tolist(), arrays["shown.prints"].tolist(), strict=True))
            return Carried(motion, arrays.get("labels"), seen, int(arrays["structure"]), past, shown)
        except FileNotFoundError:
            raise CheckpointError(f"{file.name} is missing") from None
        except (ValueError, KeyError, TypeError) as error:
            raise CheckpointError(message_of(error)) from error

    def clean(self, committed: Sequence[int]) -> None:
        """Removes the checkpoints of all but the newest commits; after a commit.

        Args:
            committed: indices of the frames committed, rising.
        """
        kept = set(committed[-NEWEST_KEPT:])
        for index in self.indices():
            if index not in kept:
                self._file(index).unlink(missing_ok=True)

    def indices(self) -> list[int]:
        """Frames that have a checkpoint, rising."""
        found = (checkpoint_of(file.name) for file in self.directory.iterdir())
        return sorted(index for index in found if index is not None)

    def _file(self, index: int) -> Path:
        return self.directory / checkpoint_file(index)


def _packed(motion: Motion) -> dict[str, Any]:
    """The fields of a motion as arrays: numbers, arrays, and lists of arrays."""
    packed: dict[str, Any] = {}
    for item in fields(motion):
        value = getattr(motion, item.name)
        if isinstance(value, list):
            packed[f"motion.{item.name}.count"] = np.int64(len(value))
            packed |= {f"motion.{item.name}.{k}": array for k, array in enumerate(value)}
        else:
            packed[f"motion.{item.name}"] = value
    return packed


def _unpacked(arrays: dict[str, NDArray[Any]]) -> Motion:
    values: dict[str, Any] = {}
    for item in fields(Motion):
        name = f"motion.{item.name}"
        if f"{name}.count" in arrays:
            values[item.name] = [arrays[f"{name}.{k}"] for k in range(int(arrays[f"{name}.count"]))]
        else:
            array = arrays[name]
            values[item.name] = array if array.ndim else array.item()
    return Motion(**values)
