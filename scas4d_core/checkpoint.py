"""Checkpoints, from which an interrupted scene continues.

A checkpoint contains everything that the next update needs in addition to the committed state. On
the CPU, a scene that is resumed after a crash therefore produces bit-identical results.

The newest commits in a ``History`` each have a file ``checkpoint_<index>.npz`` next to the file of
the frame. A frame is committed when its file is renamed. The checkpoint is written, synced and
renamed before. Every newly committed frame therefore has a checkpoint, and a checkpoint without a
frame is ignored. The second newest checkpoint is kept in case the newest state or checkpoint is
damaged.

Some data is not stored in checkpoints. Constant data (exposures, presence of masks) is in the
report of the first frame. Clusters and neighbours are rebuilt, and a digest shows whether they have
changed.
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
from scas4d_core.captures.images import decode_image
from scas4d_core.effects.switches import Switches, decode_switches, encode_switches
from scas4d_core.engines.views import TrainingView
from scas4d_core.errors import message_of
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.robust.outliers import Past
from scas4d_core.storage.frame_files import checkpoint_file, checkpoint_of
from scas4d_core.storage.history import NEWEST_KEPT, History, HistoryError
from scas4d_core.storage.npz import LARGE, PACKED, PACKED_INDEX, pack_arrays, read_npz, unpack_arrays, write_npz
from scas4d_core.update.parts import Arrays
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion


class CheckpointError(ValueError):
    """Raised if a checkpoint is missing or damaged. The message names the file and the problem."""


@dataclass(frozen=True, eq=False)
class CarryOver:
    """State that one update passes to the next, in addition to the Gaussians Θ.

    Attributes:
        motion: motion of the last update, or None if the next update is a cold start.
        labels: [N] bool, true for Gaussians that have moved at least once; None in scenes with
            masks, and before the first motion.
        seen: views with which the images of the next frame are compared to detect motion, in scenes
            without masks. These are the views of the last accepted frame in unchanged lighting.
            Until the first motion, the views are kept while frames are skipped, so that slow
            motion accumulates. Empty in other scenes.
        structure: digest of the clusters and neighbours for which ``motion`` is valid.
        past: statistics of the scene and its cameras over the previous frames.
        shown: checksum of each camera's image in the last accepted frame
            (``robust.checks.fingerprints``).
        switches: on/off state of each effect for the next update.
        effects: arrays that each effect carries over, keyed by effect name.
    """

    motion: Motion | None = None
    labels: NDArray[np.bool_] | None = None
    seen: Sequence[TrainingView] = field(default_factory=tuple)
    structure: int = 0
    past: Past = field(default_factory=Past)
    shown: Mapping[str, int] = field(default_factory=dict)
    switches: Switches = field(default_factory=dict)
    effects: Mapping[str, Arrays] = field(default_factory=dict)

    def snapshot(self) -> CarryOver:
        """Returns a copy that later updates do not change.

        Only the arrays of effects are copied, because everything else is replaced, never changed.
        """
        effects = {name: {key: array.copy() for key, array in own.items()} for name, own in self.effects.items()}
        return replace(self, effects=effects)

    def after(
        self,
        result: UpdateResult,
        past: Past,
        time: float,
        views: Sequence[TrainingView] | None,
        shown: Mapping[str, int],
    ) -> CarryOver:
        """Returns the carry-over for the next frame.

        If the current frame was rejected, ``seen`` and ``shown`` do not change.

        Args:
            result: update result of the current frame.
            past: statistics that include the current frame.
            time: time of the current frame in seconds.
            views: views of the cameras that are not excluded, or None if the scene does not detect
                motion from images.
            shown: checksum of each camera's image in the current frame.
        """
        carried = replace(
            self,
            motion=result.motion,
            past=replace(past, fitted=time) if result.outcome.learnt else past,
            effects=result.carried,
        )
        if result.outcome.rejected:
            return carried
        # Images under a changed lighting are no reference for motion. If nothing has moved yet, the
        # reference views are kept, because slow motion is only visible over several frames.
        resting = self.labels is None and result.outcome is FrameOutcome.UNCHANGED and bool(self.seen)
        if views is not None and result.exposure == 1.0 and not resting:
            carried = replace(carried, seen=[view for view in views if view.name not in result.trace.left_out])
        return replace(carried, shown=shown)


class Checkpoints:
    """The checkpoints in the directory of a history.

    Only the process that appends to the history may use this class.

    Args:
        directory: directory of the history.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     checkpoints = Checkpoints(Path(folder))
    ...     checkpoints.save(4, CarryOver(labels=np.array([True, False])))
    ...     checkpoints.load(4, factory=None).labels  # no factory is needed, because no images are stored
    ...     checkpoints.indices()
    array([ True, False])
    [4]
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def save(self, index: int, carry_over: CarryOver) -> None:
        """Writes the state that frame ``index`` passes to the next frame.

        This method must be called before the frame is committed. The checkpoint includes the images of
        ``carry_over.seen``, as image files where these are known, and otherwise as pixels.
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
            arrays[f"seen.{view.name}"] = view.pixels if view.file is None else np.frombuffer(view.file, np.uint8)
        small = {name: array for name, array in arrays.items() if np.asarray(array).nbytes < LARGE}
        large = {name: array for name, array in arrays.items() if name not in small}
        # The list of names distinguishes arrays that were lost from arrays that were never written.
        write_npz(self._file(index), {**large, **pack_arrays({**small, "names": np.array(sorted(arrays))})})

    def load(self, index: int, factory: ViewFactory) -> CarryOver:
        """Reads the state that frame ``index`` passed to the next frame.

        Args:
            index: index of the frame.
            factory: factory that creates views from the stored images.

        Raises:
            CheckpointError: if the checkpoint is missing or damaged.
        """
        file = self._file(index)
        try:
            arrays = read_npz(file)
            if not {PACKED, PACKED_INDEX} <= arrays.keys():
                raise ValueError(f"{file.name}: missing arrays: {PACKED}, {PACKED_INDEX}")
            arrays |= unpack_arrays({name: arrays.pop(name) for name in (PACKED, PACKED_INDEX)})
            names = {str(name) for name in arrays.pop("names")}
            missing = names ^ set(arrays)
            if missing:
                raise ValueError(f"{file.name}: missing or unexpected arrays: {', '.join(sorted(missing))}")
            pictures = {name[5:]: _image(array) for name, array in arrays.items() if name.startswith("seen.")}
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
        """Removes all checkpoints except those of the newest commits.

        This method must be called after a commit.

        Args:
            committed: indices of the committed frames, in ascending order.
        """
        kept = set(committed[-NEWEST_KEPT:])
        for index in self.indices():
            if index not in kept:
                self._file(index).unlink(missing_ok=True)

    def indices(self) -> list[int]:
        """Returns the indices of all frames that have a checkpoint, in ascending order."""
        listed = (checkpoint_of(file.name) for file in self.directory.iterdir())
        return sorted(index for index in listed if index is not None)

    def _file(self, index: int) -> Path:
        return self.directory / checkpoint_file(index)


def _image(array: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the image [H, W, 3] that a checkpoint contains as an image file [B] or as pixels [H, W, 3]."""
    return decode_image(array.data) if array.ndim == 1 else array


def _packed(motion: Motion) -> dict[str, Any]:
    """Returns the fields of a motion as arrays and numbers, keyed by name.

    A field that is a list is stored as its length and one entry per element.
    """
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
    """Returns the arrays of effects in a checkpoint, keyed by effect name and array name."""
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
    """Returns the carry-over of a committed frame without its checkpoint.

    Labels, switches and committed arrays of effects are rebuilt from the state and its report. The
    other fields have their default values.

    Args:
        history: history of the scene.
        index: index of the committed frame.
        masked: whether the scene has masks.

    Raises:
        HistoryError: if the frame cannot be read.
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
    """Raised if no scene can be resumed from a history; the message describes the damage."""


@dataclass(frozen=True)
class ResumePoint:
    """The commit from which a scene was resumed.

    Attributes:
        index: frame index of the commit.
        undone: indices of later committed frames that were rolled back. These frames are lost
            unless they are sent again.
        faults: one sentence per problem that was found; empty after a normal shutdown.
        cold: whether the next update starts without motion, because the checkpoint is not usable.
            The results are then not bit-identical to those of an uninterrupted scene.
    """

    index: int
    undone: list[int]
    faults: list[str]
    cold: bool


def find_commit(
    history: History, checkpoints: Checkpoints, factory: ViewFactory, held: Callable[[int], bool]
) -> tuple[int, CarryOver | None, list[str]]:
    """Finds the commit from which an interrupted scene continues.

    The result is the newest commit whose state and checkpoint are intact, if the images of all
    later frames can be sent again. Otherwise, the result is the newest commit whose state is
    intact, without its checkpoint.

    Args:
        history: history of the scene.
        checkpoints: checkpoints of the scene.
        factory: factory that creates views from stored images.
        held: function that returns whether the images of a committed frame can be sent again.

    Returns:
        The index of the commit, its carry-over (None for a cold start), and one sentence per fault
        that was found.

    Raises:
        ResumeError: if no state can be read.
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
                break  # older commits have no checkpoints either
    if not whole:
        raise ResumeError("no state can be read: " + "; ".join(faults))
    later = sorted({*history.indices, *history.damaged})
    if carry_over is None or not all(held(index) for index in later if index > whole[-1]):
        return whole[0], None, faults
    return whole[-1], carry_over, faults
