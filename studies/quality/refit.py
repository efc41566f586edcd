"""``scripts/bench refit``: upper bound on the quality of updates, obtained by fitting a later frame like frame 0.

A later frame is reconstructed from scratch, with the same settings and effects, and measured on the test cameras. The
updates score lower at that frame if they miss changes that no effect models, or if they have lost quality over the
frames. Their scores are read from the rows of ``scripts/bench quality`` in the same folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from client.cli.evaluate import DEFAULT_OPTIONS, Report, settings_record
from client.cli.scores import Column, Row, Store, digest, kept_row, markdown
from client.importers.open_source import CaptureOptions
from scas4d_core.captures import Capture
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.warm_up import compile_in_processes
from studies.captures import open_measured
from studies.machine import core_version, machine
from studies.quality.settings import settings_of

COLUMNS = (
    Column("capture", "capture"),
    Column("frame", "frame", "d"),
    Column("seed", "seed", "d"),
    Column("cloud", "cloud"),
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
    preset: str = "scas4d",
    seeds: Sequence[int] = (0,),
    points: bool = False,
    changes: Sequence[str] = (),
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> list[Row]:
    """Fits a frame of each capture from scratch, prints the table and writes it to ``out/refit.md``.

    Args:
        captures: capture folders.
        out: quality study folder; a second call resumes the study.
        frame: frame to fit; negative numbers count from the end.
        preset: settings preset.
        seeds: seeds for the fit; every seed is measured.
        points: whether to start from the point cloud of the capture's first frame, instead of the images alone.
        changes: changes to the settings, such as ``"effects.direction=off"``.
        again: whether to repeat fits that ``out`` already contains.
        options: options for reading the captures.
        report: callback that prints progress messages.

    Returns:
        One row per capture and seed.

    Raises:
        ValueError: a capture does not have the frame, or a setting is unknown.
    """
    store, rows = Store(out), list[Row]()
    compile_in_processes()
    for folder in captures:
        for seed in seeds:
            settings = settings_of(preset, None, seed, changes)
            row = _refitted(folder, store.folder / "refit", frame, settings, seed, points, again, options)
            rows.append(row | _beside(row, settings, preset, store))
            report(f"{row['capture']}, frame {row['frame']}, seed {seed}: {row['psnr']:.2f} dB")
    table = markdown(rows, COLUMNS)
    (store.folder / "refit.md").write_text(table + "\n")
    report(table)
    return rows


def _refitted(
    folder: Path,
    rows: Path,
    frame: int,
    settings: Settings,
    seed: int,
    points: bool,
    again: bool,
    options: CaptureOptions,
) -> Row:
    """Returns the row of one frame, fitting the frame if the row is missing."""
    capture = open_measured(folder, options, use_points=points)
    index = range(capture.frame_count)[frame] if -capture.frame_count <= frame < capture.frame_count else None
    if index is None:
        raise ValueError(f"{capture.name} has no frame {frame}; use 0 to {capture.frame_count - 1}")
    key = f"{capture.name}-{index}-s{seed}-{digest(settings_record(settings, ()), points, *options.changed.items())}"
    return kept_row(
        rows / f"{key}.json", lambda: {"key": key, "seed": seed, **_measured(capture, index, settings)}, again=again
    )


def _measured(capture: Capture, index: int, settings: Settings) -> Row:
    """Fits a frame independently of all others and returns its row."""
    from scas4d_core.metrics.evaluation import measure_pictures

    scene = Reconstruction.start(capture.rig, capture.frame(index), settings, points=capture.points)
    scores, _ = measure_pictures(scene, capture.scaled(settings.scene.image_scale), index)
    assert scene.report is not None
    return {
        "capture": capture.name,
        "frame": index,
        "cloud": "given" if capture.points is not None else "from the images",
        "gaussians": len(scene.history.first),
        "seconds": sum(scene.report.seconds.values()),
        **scores,
        "settings": settings_record(settings, ()),
        "core": core_version(),
        "machine": machine(),
    }


def _beside(row: Row, settings: Settings, preset: str, store: Store) -> Row:
    """Returns the PSNR of the updates at the same frame and its difference from the fit, if available."""
    wanted = settings_record(settings, ())
    for other in store.rows():
        frames = other.get("psnr_by_frame", [])
        same = other.get("capture") == row["capture"] and other.get("settings") == wanted
        if same and other.get("preset") == preset and row["frame"] < len(frames):
            update = frames[row["frame"]]
            return {"psnr_update": update, "below": update - row["psnr"]}
    return {}
