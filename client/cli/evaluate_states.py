"""`scas4d evaluate --states`: scores stored states on a capture's test cameras and ground truth.

Nothing is reconstructed; the states of a compact file, or of an export with Gaussian ids, are rendered as stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from client.cli.evaluate import DEFAULT_OPTIONS, TRAINING, Report, score_sequence, score_tables, summary
from client.cli.scores import Row, Store
from client.exports.sources import Source, of_path
from client.importers.open_source import CaptureOptions
from client.progress import Bars
from scas4d_core.captures import Capture
from scas4d_core.errors import InputError
from scas4d_core.gaussians import UNBORN, Gaussians
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from scas4d_core.storage.history import History

SHOWN = (0, 1, -1)
"""Indices of the frames whose comparison images are saved; negative indices count from the end."""


def evaluate_states(
    source: Path,
    folder: Path,
    out: Path,
    *,
    options: CaptureOptions = DEFAULT_OPTIONS,
    frames: int | None = None,
    rate: float | None = None,
    image_scale: float = 1.0,
    report: Report = print,
) -> Row:
    """Scores stored states, prints the table, and writes the row, per-frame lines, images and table.md to `out`.

    Args:
        source: compact file, folder that contains one, or export with Gaussian ids.
        folder: capture folder.
        out: output folder.
        options: options for reading the capture.
        frames: maximum number of frames to score; None for all.
        rate: frame rate of numbered files; None for the default of 30.
        image_scale: scale of the images to compare with, as in the reconstruction.
        report: callback that receives each printed line.

    Raises:
        InputError: the source cannot be read, or has no frames in common with the capture.
        CaptureError: the capture cannot be read.
    """
    if not source.exists():
        raise InputError(
            f"states {str(source)!r} does not exist", "use a .s4d file, or an export with ids (see docs/exports.md)"
        )
    states = of_path(source, rate)
    truth = options.open(folder, image_scale=image_scale)
    unseen = truth.full_test_rig is not None
    truth = truth if unseen else truth.with_training_as_test()
    for remark in [*states.of.remarks, *([] if states.of.damage is None else [states.of.damage])]:
        report(remark)
    if not unseen:
        report("no test cameras: scoring the training cameras instead (use --test to hold some out)")
    row = _measure(states, truth, Store(out), frames, report)
    row["preset"] = source.name
    row["measured_on"] = "test cameras" if unseen else TRAINING
    row["changes"] = "" if unseen else TRAINING
    Store(out).put(row)
    table = score_tables([row])
    (out / "table.md").write_text(table + "\n")
    report(table)
    return row


def scale_of(changes: Mapping[str, Any]) -> float:
    """Returns the image scale of changed settings, which must not change any other setting.

    >>> scale_of({"scene": {"image_scale": 0.5}}), scale_of({})
    (0.5, 1.0)
    >>> scale_of({"update": {"iterations": 50}})
    Traceback (most recent call last):
    scas4d_core.errors.InputError: set 'update' has no effect with --states; use only scene.image_scale
    """
    scene = changes.get("scene", {})
    others = [name for name in changes if name != "scene"] + [
        f"scene.{name}" for name in scene if name != "image_scale"
    ]
    if others:
        raise InputError(f"set {others[0]!r} has no effect with --states", "use only scene.image_scale")
    return Settings.model_validate(changes).scene.image_scale


def _measure(found: Source, truth: Capture, store: Store, frames: int | None, report: Report) -> Row:
    # Imported lazily: these load the kernels, which the command line alone does not need.
    from scas4d_core.engines.limits import rig_limits
    from scas4d_core.metrics.evaluation import measure_pictures
    from scas4d_core.query.committed import CommittedScene
    from scas4d_core.storage.history import History

    given, last = found.of, truth.frame_count - 1
    chosen = [index for index in given.frames if index <= last][:frames]
    if not chosen:
        raise InputError(
            f"{found.name} starts at frame {given.frames[0]}, but the capture ends at frame {last}"
            if given.frames
            else f"{found.name} has no frames",
            "use states of this capture",
        )
    world, history = given.head.world, History()
    limits = rig_limits(Settings().scene.near, world, truth.rig.cameras)
    scene = CommittedScene(history, world, limits)
    key = f"{truth.name}-{found.name}"
    store.start_frames(key)
    lines: list[Row] = []
    with Bars(Console(stderr=True)) as bars:
        for index, time, state in given.states(chosen[0], chosen[-1]):
            history.append(index, time, _with_ids(state, history), {"background": list(given.head.background)})
            history.move_to_scratch(store.folder)
            scores, by_camera = measure_pictures(scene, truth, index)
            line: Row = {"index": index, **scores}
            store.put_frame(key, {**line, "cameras": by_camera})
            lines.append(line)
            bars("frames", len(lines), len(chosen))
            report(f"    frame {index:3d}/{chosen[-1]}  {line['psnr']:6.2f} dB")
    row: Row = {
        "key": key,
        "capture": truth.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "gaussians": history.count,
        "moving": int(history.newest.moving.sum()),
        "psnr_first": lines[0]["psnr"],
        **summary(lines),
    }
    row.pop("alarms", None)  # stored states have no alarms
    return row | score_sequence(scene, truth, chosen, SHOWN, store.folder / "pictures" / key)


def _with_ids(state: Gaussians, history: History) -> Gaussians:
    """Returns the state with ids assigned by the history. Rows keep their order, so the file's ids are not needed."""
    if not len(history):
        return state
    known = history.ids
    return state.replace(ids=np.concatenate([known, np.full(len(state) - len(known), UNBORN, np.int64)]))
