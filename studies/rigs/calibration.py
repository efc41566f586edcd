"""``scripts/bench calibration``: what frame 0 reports about faulty rigs, and the benefit of refining them.

Faults are added to the calibration, but the images do not change. Test cameras keep their calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from client.cli.evaluate import Report, settings_record
from client.cli.scores import Column, Row, markdown
from client.importers.open_source import open_source
from scas4d_core.cameras import Camera, Rig
from scas4d_core.first_frame.calibration.matches import Matches, match_by_appearance
from scas4d_core.first_frame.calibration.refine import refine_rig
from scas4d_core.first_frame.calibration.residuals import measure_residuals
from scas4d_core.metrics.evaluation import measure_pictures
from scas4d_core.posed_pictures import collect_views
from scas4d_core.reconstruction import Reconstruction
from studies.quality.settings import settings_of
from studies.rows import RowStudy

FAULTS = (
    ("across", 1.0), ("down", 1.0), ("across", 2.0), ("down", 2.0), ("across", 4.0), ("down", 4.0), ("centre", 2.0),
    ("focal", 0.01),
)  # fmt: skip
"""Faults of one camera at a time, as pairs of kind and size; see ``faulty``."""
MEASURED = (
    Column("capture", "capture"),
    Column("fault", "fault"),
    Column("residual, px", "residual"),
    Column("named", "named"),
    Column("others named", "others", "d"),
)
RIGS = (("right", 0.0), ("one", 2.0), ("one", 4.0), ("all", 1.0), ("all", 2.0), ("all", 4.0))
"""Faulty rigs for fitting frame 0: one camera rotated horizontally by this many pixels, or all cameras randomly."""
FITTED = (
    Column("capture", "capture"),
    Column("rig", "rig"),
    Column("as given", "given", ".2f"),
    Column("refined", "refined", ".2f"),
    Column("accepted", "accepted"),
    Column("seconds", "seconds", ".1f"),
)


def faulty(camera: Camera, kind: str, size: float) -> Camera:
    """Returns a camera with a fault in its calibration.

    Args:
        camera: camera whose calibration is changed.
        kind: "across" and "down" rotate the camera by ``size`` pixels; "centre" shifts its principal point by ``size``
            pixels; "focal" increases its focal length by the fraction ``size``.
        size: size of the fault.
    """
    lens, pose = camera.intrinsics.copy(), camera.world_to_camera.copy()
    if kind in ("across", "down"):
        turn = [0.0, size / camera.fx, 0.0] if kind == "across" else [size / camera.fy, 0.0, 0.0]
        pose[:3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3]
    elif kind == "centre":
        lens[0, 2] += size
    else:
        lens[[0, 1], [0, 1]] *= 1 + size
    return Camera(camera.name, lens, pose, camera.width, camera.height)


def faulty_rig(rig: Rig, way: str, pixels: float, seed: int = 7) -> Rig:
    """Returns a rig with one or all cameras rotated; see ``RIGS``."""
    rng, cameras = np.random.default_rng(seed), []
    for index, camera in enumerate(rig.cameras):
        across, down = (
            rng.normal(size=2) * pixels / 2**0.5 if way == "all" else (pixels * (way == "one" and index == 3), 0)
        )
        cameras.append(faulty(faulty(camera, "across", across), "down", down))
    return Rig(tuple(cameras))


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    fit: bool = True,
    changes: Sequence[str] = (),
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Measures each capture, prints two tables and writes them to ``out/calibration.md``.

    For the arguments, see ``scripts/bench calibration --help``. A second call for the same folder resumes the study.

    Returns:
        The rows of both tables.
    """
    measured_rows: list[Row] = []
    study = RowStudy(out, "calibration", FITTED, again=again, report=report)
    settings = settings_record(settings_of("scas4d", None, 0, changes), ())
    for folder in captures:
        capture = open_source(folder)
        matches = match_by_appearance(collect_views(capture.rig, dict(capture.frame(0).images), {}))
        measured_rows += _measured(capture.name, matches)
        report(f"{capture.name}, as given: {refine_rig(capture.rig, matches).text}")
        for way, pixels in RIGS if fit and capture.test_rig is not None else ():
            known = {"capture": capture.name, "rig": f"{way} {pixels:g}", "settings": settings}
            study.add(
                f"{folder.resolve().name}-{way}-{pixels:g}",
                (settings, way, pixels),
                partial(_fitted, known, folder, faulty_rig(capture.rig, way, pixels), changes),
                lambda row: f"{row['capture']}, {row['rig']}: {row['given']:.2f} dB, refined {row['refined']:.2f} dB",
            )
    tables = ((measured_rows, MEASURED), (study.rows, FITTED))
    study.write("\n\n".join(markdown(rows, columns) for rows, columns in tables if rows))
    return [*measured_rows, *study.rows]


def _measured(name: str, matches: Matches) -> list[Row]:
    """Returns one row with the residuals of the given rig, and one per fault, added to each camera in turn."""
    given, off = measure_residuals(matches)
    known = np.array([fit.pixels for fit in given.values()])
    rows: list[Row] = [_told_row(name, "none", known, f"{len(off)} of {len(known)}", 0)]
    if np.isnan(known).all():
        return rows
    for kind, size in FAULTS:
        own, named, others = [], 0, 0
        for camera in matches.cameras:
            cameras = [faulty(c, kind, size) if c is camera else c for c in matches.cameras]
            fit, off = measure_residuals(matches.with_cameras(cameras))
            own.append(fit[camera.name].pixels)
            named += camera.name in off
            others += len(set(off) - {camera.name})
        rows.append(_told_row(name, f"{kind} {size:g}", np.array(own), f"{named} of {len(own)}", others))
    return rows


def _told_row(capture: str, fault: str, residual: NDArray[np.float64], named: str, others: int) -> Row:
    known = residual[np.isfinite(residual)]
    few = f", {len(residual) - len(known)} not measured" if len(known) < len(residual) else ""
    text = f"{known.min():.2f} to {known.max():.2f}, median {np.median(known):.2f}" if len(known) else "–"
    return {"capture": capture, "fault": fault, "residual": text + few, "named": named, "others": others}


def _fitted(known: Row, folder: Path, rig: Rig, changes: Sequence[str]) -> Row:
    """Returns the PSNR of the test cameras in frame 0, with the given and with the refined rig."""
    capture, row = open_source(folder), known
    for refine in (False, True):
        settings = settings_of("scas4d", None, 0, [*changes, f"static.refine_calibration={str(refine).lower()}"])
        scene = Reconstruction.start(rig, capture.frame(0), settings, points=capture.points)
        tests = open_source(folder, image_scale=settings.scene.image_scale)
        row["refined" if refine else "given"] = measure_pictures(scene, tests, 0)[0]["psnr"]
        assert scene.report is not None
        if scene.report.calibration is not None and (refined := scene.report.calibration.refined) is not None:
            row |= {"accepted": "yes" if refined.accepted else "no", "said": refined.text}
            row["seconds"] = scene.report.seconds["calibration"]
    return row
