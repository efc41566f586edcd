"""Checkpoints: the state of an update beside Θ_{t−1}, on disk, and the commit from which a scene is resumed.

A scene whose process died goes on with the same bits.

Beside the frames of a ``History`` lies one ``checkpoint_<index>.npz`` for each of its newest commits. It is written,
synced and renamed *before* the frame's own rename, which is the commit: a committed frame has its checkpoint, and a
checkpoint without its frame does not count. The checkpoint before the newest is kept as well, in case the newest state
or checkpoint is damaged. Facts that never change (exposures, presence of masks) are in the report of the first frame;
clusters and neighbours are built again from the first frame, and a digest shows whether they changed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.frame import Frame
from scas4d_core.effects.switches import Switches, decode_switches, encode_switches
from scas4d_core.engines.views import TrainingView
from scas4d_core.errors import message_of
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.robust.outliers import Past
from scas4d_core.storage.frame_files import checkpoint_file, checkpoint_of
from scas4d_core.storage.history import NEWEST_KEPT, History, HistoryError
from scas4d_core.storage.npz import read_npz, write_npz
from scas4d_core.update.parts import Arrays
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion


class CheckpointError(ValueError):
    """A checkpoint that is missing or damaged: the message names the file and the fault."""


@dataclass(frozen=True, eq=False)
class CarryOver:
    """The state that one update passes to the next beside Θ.

    Attributes:
        motion: the motion found, or None where the next update starts cold.
        labels: [N] the Gaussians that have been seen to move, in scenes without masks; None until some have.
        seen: views of the last frame that was not held, in scenes without masks; the next are compared with them. While
            frames stand as nothing was seen to move, those of the first that was looked at.
        structure: digest of the clusters and neighbours that the motion belongs to.
        past: usual values of the scene and its cameras.
        shown: fingerprint of each picture of the last frame that was not held (``checks``).
        switches: of the effects, for the next update. effects: arrays that they left, by effect.
    """

    motion: Motion | None = None
    labels: NDArray[np.bool_] | None = None
    seen: Sequence[TrainingView] = field(default_factory=tuple)
    structure: int = 0
    past: Past = field(default_factory=Past)
    shown: Mapping[str, int] = field(default_factory=dict)
    switches: Switches = field(default_factory=dict)
    effects: Mapping[str, Arrays] = field(default_factory=dict)

    def after(
        self,
        result: UpdateResult,
        past: Past,
        time: float,
        views: Sequence[TrainingView] | None,
        shown: Mapping[str, int],
    ) -> CarryOver:
        """The carry-over of the next frame; of pictures that were not believed nothing is kept.

        Args:
            result: of that frame. past: after it. time: its, seconds.
            views: that it was updated with, or None in scenes with masks. shown: fingerprints of its pictures.
        """
        carried = replace(
            self,
            motion=result.motion,
            past=replace(past, fitted=time) if result.outcome.learnt else past,
            effects=result.carried,
        )
        if result.outcome.rejected:
            return carried
        # A change of another light is no motion; a motion too small to be seen between two frames adds up.
        resting = self.labels is None and result.outcome is FrameOutcome.UNCHANGED and bool(self.seen)
        if views is not None and result.exposure == 1.0 and not resting:
            carried = replace(carried, seen=[view for view in views if view.name not in result.trace.left_out])
        return replace(carried, shown=shown)


class Checkpoints:
    """Writes and reads the checkpoints in the directory of a history; for the process that appends to it.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     checkpoints = Checkpoints(Path(folder))
    ...     checkpoints.save(4, CarryOver(labels=np.array([True, False])))
    ...     checkpoints.load(4, factory=None).labels  # without pictures no view is made
    ...     checkpoints.indices()
    array([ True, False])
    [4]
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def save(self, index: int, carry_over: CarryOver) -> None:
        """Writes the state that frame ``index`` passes to the next; before the frame is committed.

        Without masks that includes the pictures of the frame, 3 bytes a pixel.
        """
        arrays: dict[str, Any] = {"structure": np.int64(carry_over.structure)}
        if carry_over.motion is not None:
            arrays |= _packed(carry_over.motion)
        arrays |= {f"past.{name}": array for name, array in carry_over.past.arrays().items()}
        arrays |= {
            "shown.names": np.array(list(carry_over.shown), np.str_),
            "shown.prints": np.array(list(carry_over.shown.values()), np.int64),
        }
        if carry_over.labels is not None:
            arrays["labels"] = carry_over.labels
        if carry_over.switches:
            arrays["switches"] = np.array(json.dumps(encode_switches(carry_over.switches)), np.str_)
        for name, given in carry_over.effects.items():
            arrays |= {f"effect.{name}.{key}": array for key, array in given.items()}
        for view in carry_over.seen:
            levels = np.rint(255 * view.target[:3]).astype(np.uint8)  # they were 8 bit: exact
            arrays[f"seen.{view.name}"] = np.moveaxis(levels, 0, -1)
        # An array lost by damage must not read as one that was never written.
        arrays["names"] = np.array(sorted(arrays))
        write_npz(self._file(index), arrays)

    def load(self, index: int, factory: ViewFactory) -> CarryOver:
        """Reads the state that frame ``index`` passed on.

        Args:
            factory: of the scene's views; makes views of the pictures.

        Raises:
            CheckpointError: it is not there, or damaged.
        """
        file = self._file(index)
        try:
            arrays = read_npz(file)
            names = {str(name) for name in arrays.pop("names")}
            missing = names ^ set(arrays)
            if missing:
                raise ValueError(f"{file.name}: {', '.join(sorted(missing))} went missing")
            pictures = {name[5:]: array for name, array in arrays.items() if name.startswith("seen.")}
            seen = factory.views(Frame(index, 0.0, pictures, {}), {}, use_masks=False) if pictures else ()
            motion = _unpacked(arrays) if "motion.seconds" in arrays else None
            past = Past.of_arrays({name[5:]: array for name, array in arrays.items() if name.startswith("past.")})
            shown = dict(zip(arrays["shown.names"].tolist(), arrays["shown.prints"].tolist(), strict=True))
            switches = decode_switches(json.loads(str(arrays["switches"]))) if "switches" in arrays else {}
            labels, structure = arrays.get("labels"), int(arrays["structure"])
            return CarryOver(motion, labels, seen, structure, past, shown, switches, _by_effect(arrays))
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
        listed = (checkpoint_of(file.name) for file in self.directory.iterdir())
        return sorted(index for index in listed if index is not None)

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


def _by_effect(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Arrays]:
    """The arrays of effects, by effect and name, of those in a file."""
    effects: dict[str, Arrays] = {}
    for key, array in arrays.items():
        kind, _, rest = key.partition(".")
        if kind == "effect":
            effect, _, name = rest.partition(".")
            effects.setdefault(effect, {})[name] = array
    return effects


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


def cold_start(history: History, index: int, masked: bool) -> CarryOver:
    """The carry-over of a committed frame as far as the history has it: labels learnt, switches, arrays of effects.

    Args:
        masked: whether the scene has masks.

    Raises:
        HistoryError: the frame cannot be read.
    """
    moving = history.gaussians(index).foreground > 0.5
    first, newest = history.effects(history.indices[0]), history.effects(index)
    effects = {name: {**first.get(name, {}), **newest.get(name, {})} for name in (*first, *newest)}
    return CarryOver(
        labels=None if masked or moving.all() else moving,
        switches=decode_switches(history.report(index).get("effects", {})),
        effects=effects,
    )


class ResumeError(ValueError):
    """A history from which no scene can be resumed; the message names the damage."""


@dataclass(frozen=True)
class ResumePoint:
    """The commit from which a scene was resumed.

    Attributes:
        index: of the commit.
        undone: committed frames after it that were taken back; each has to be given again, or is lost.
        faults: a sentence for each file that could not be used; empty after an ordinary end.
        cold: true where the state is whole and its checkpoint is not: the next update starts without a motion, and the
            scene is no longer bit-identical to one that was not disturbed.
    """

    index: int
    undone: list[int]
    faults: list[str]
    cold: bool


def find_commit(
    history: History, checkpoints: Checkpoints, factory: ViewFactory, held: Callable[[int], bool]
) -> tuple[int, CarryOver | None, list[str]]:
    """Finds the commit to resume from: its index, its checkpoint (None: a cold start), and the damage that was found.

    Args:
        history, checkpoints: of the scene. factory: of its views.
        held: true for a committed frame whose pictures can be given again.

    Raises:
        ResumeError: no state can be read.
    """
    faults = list(history.damaged.values())
    whole: list[int] = []
    carry_over: CarryOver | None = None
    for index in reversed(history.indices):
        try:
            history.gaussians(index)
            history.report(index)
            whole.append(index)
            carry_over = checkpoints.load(index, factory)
            break
        except (HistoryError, CheckpointError) as error:
            faults.append(str(error))
            if index not in checkpoints.indices() and whole:
                break  # too old to have a checkpoint: no commit before it has one either
    if not whole:
        raise ResumeError("no state can be read: " + "; ".join(faults))
    later = sorted({*history.indices, *history.damaged})
    if carry_over is None or not all(held(index) for index in later if index > whole[-1]):
        return whole[0], None, faults
    return whole[-1], carry_over, faults
