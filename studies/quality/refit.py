"""``scripts/bench refit``: upper bound on the quality of updates, obtained by fitting a later frame like frame 0.

A later frame is reconstructed from scratch, with the same settings and effects, and measured on the test cameras. The
updates score lower at that frame if they miss changes that no effect models, or if they have lost quality over the
frames. Their scores are read from the rows of ``scripts/bench targets`` in the same folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from client.cli.evaluate import DEFAULT_OPTIONS, Report, settings_record
from client.cli.scores import Column, Row, Store
from client.importers.open_source import CaptureOptions
from scas4d_core.captures import Capture
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.warm_up import compile_in_processes
from studies.captures import open_measured
from studies.quality.settings import settings_of
from studies.rows import RowStudy

COLUMNS = (
    Column("capture", "capture"),
    Column("frame", "frame", "d"),
    Column("from scratch dB", "psnr"),
    Column("fg dB", "psnr_foreground"),
    Column("updates dB", "psnr_update"),
    Column("below", "below", "+.2f"),
    Column("Gaussians", "gaussians", ",d"),
    Column("s", "seconds", ".0f"),
)


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    frame: int = -1,
    changes: Sequence[str] = (),
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> list[Row]:
    """Fits a frame of each capture from scratch, prints the table and writes it to ``out/refit.md``.

    For the arguments, see ``scripts/bench refit --help``. A second call for the same folder resumes the study.

    Returns:
        One row per capture.

    Raises:
        ValueError: a capture does not have the frame, or a setting is unknown.
    """
    compile_in_processes()
    study, store = RowStudy(out, "refit", COLUMNS, again=again, report=report), Store(out)
    settings = settings_of("scas4d", None, 0, changes)
    for folder in captures:
        capture = open_measured(folder, options, use_points=False)
        if not -capture.frame_count <= frame < capture.frame_count:
            raise ValueError(f"{capture.name} has no frame {frame}; use 0 to {capture.frame_count - 1}")
        index = range(capture.frame_count)[frame]
        row = study.add(
            f"{capture.name}-{index}",
            (settings_record(settings, ()), *options.changed.items()),
            partial(_measured, capture, index, settings),
            lambda row: f"{row['capture']}, frame {row['frame']}: {row['psnr']:.2f} dB",
        )
        row |= _beside(row, settings, store)
    return study.finish()


def _measured(capture: Capture, index: int, settings: Settings) -> Row:
    """Fits a frame independently of all others and returns its row."""
    from scas4d_core.metrics.evaluation import measure_pictures

    scene = Reconstruction.start(capture.rig, capture.frame(index), settings, points=capture.points)
    scores, _ = measure_pictures(scene, capture.scaled(settings.scene.image_scale), index)
    assert scene.report is not None
    return {
        "capture": capture.name,
        "frame": index,
        "gaussians": len(scene.history.first),
        "seconds": sum(scene.report.seconds.values()),
        **scores,
        "settings": settings_record(settings, ()),
    }


def _beside(row: Row, settings: Settings, store: Store) -> Row:
    """Returns the PSNR of the updates at the same frame and its difference from the fit, if available."""
    wanted = settings_record(settings, ())
    for other in store.rows():
        frames = other.get("psnr_by_frame", [])
        same = other.get("capture") == row["capture"] and other.get("settings") == wanted
        if same and row["frame"] < len(frames):
            update = frames[row["frame"]]
            return {"psnr_update": update, "below": update - row["psnr"]}
    return {}
